"""Whether the package gsplat can be used here, and why not. Imports it only in ``load``."""

from __future__ import annotations

import importlib
import importlib.metadata
import importlib.util
import os
import shutil
from pathlib import Path
from types import ModuleType
from typing import Final

import torch

from mudg.base.errors import ResourceError

MINIMUM_VERSION: Final = (1, 5, 3)
_usable = False


def problem() -> str:
    """Why gsplat cannot be used here, or "" if it can."""
    global _usable
    if _usable:
        return ""
    if importlib.util.find_spec("gsplat") is None:
        return "the package gsplat is not installed"
    version = importlib.metadata.version("gsplat")
    numbers = tuple(int(part) for part in version.split("+")[0].split(".")[:3] if part.isdigit())
    if numbers < MINIMUM_VERSION:
        return f"gsplat {version} is older than {'.'.join(map(str, MINIMUM_VERSION))}"
    if not torch.cuda.is_available():
        return "no CUDA device is available"
    reason = "" if compiled_kernels() else _compiler_problem()
    _usable = not reason
    return reason


def compiled_kernels() -> Path | None:
    """The library of kernels that came with gsplat; None if gsplat compiles them when it first draws."""
    spec = importlib.util.find_spec("gsplat")
    folders = [] if spec is None else spec.submodule_search_locations or []
    return next(
        (file for folder in folders for file in sorted(Path(folder).glob("csrc*.*")) if file.suffix in (".so", ".pyd")),
        None,
    )


def nvcc() -> str | None:
    """The CUDA compiler that gsplat would use, looked for where torch looks: CUDA_HOME, CUDA_PATH, PATH, /usr/local/cuda."""
    home = os.environ.get("CUDA_HOME") or os.environ.get("CUDA_PATH")
    named = [Path(home) / "bin" / "nvcc"] if home else []
    found = shutil.which("nvcc")
    places = [*named, *([Path(found)] if found else []), Path("/usr/local/cuda/bin/nvcc")]
    return next((str(place) for place in places if place.is_file()), None)


def _compiler_problem() -> str:
    """What is missing to compile the kernels: gsplat itself would only fail at the first picture."""
    if nvcc() is None:
        return "its kernels are not compiled and there is no CUDA toolkit to compile them (nvcc was not found; set CUDA_HOME)"
    if shutil.which("ninja") is None and importlib.util.find_spec("ninja") is None:
        return "its kernels are not compiled and ninja, which compiles them, is missing (pip install ninja)"
    if not any(shutil.which(name) for name in (os.environ.get("CXX", "c++"), "g++", "clang++", "cl")):
        return "its kernels are not compiled and there is no C++ compiler to compile them"
    return ""


def status() -> str:
    """One line for people: usable here, and where its kernels come from; or why not."""
    reason = problem()
    if reason:
        return f"cannot be used here: {reason}"
    return (
        "its kernels came with it"
        if compiled_kernels()
        else f"{nvcc()} compiles its kernels at the first picture (minutes, once)"
    )


def load() -> ModuleType:
    """The package.

    Raises:
        ResourceError: it cannot be used here.
    """
    reason = problem()
    if reason:
        raise ResourceError("raster backend 'gsplat' is not available", got=reason,
                            remedy="see docs/gsplat.md; pip install 'mudg[gsplat]'")  # fmt: skip
    return importlib.import_module("gsplat")
