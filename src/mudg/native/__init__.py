"""Loads the optional C++ library of the hot loops. ``MUDG_THREADS``: threads of its loops (default: the processors this
process may use); ``MUDG_NATIVE=off`` leaves it alone; ``MUDG_ISA`` = avx512, avx2 or portable asks for one instruction
set instead of the best one."""

from __future__ import annotations

import contextlib
import ctypes
import json
import os
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

from mudg.base.errors import ResourceError, UsageError

ABI_VERSION: Final = 6
FOLDER: Final = Path(__file__).resolve().parent
LIBRARY_PATH: Final = FOLDER / {"darwin": "libmudg_native.dylib", "win32": "mudg_native.dll"}.get(
    sys.platform, "libmudg_native.so"
)
REMEDY: Final = (
    "install a C++17 compiler (g++ or clang++) or `pip install ziglang`, then reinstall mudg "
    "(in a checkout: python build_backend/mudg_build.py --inplace)"
)

_loaded: ctypes.CDLL | None = None
_problem = ""  # why there is no library; empty until the first attempt


def library() -> ctypes.CDLL | None:
    """The loaded library, or None when it is not installed, switched off or unusable (`status()` says which)."""
    global _loaded, _problem
    if _loaded is None and not _problem:
        _loaded, _problem = _load()
    return _loaded


def require(purpose: str = "this operation") -> ctypes.CDLL:
    """The loaded library. Raises ResourceError, naming the reason and the remedy, when there is none.

    Args:
        purpose: what needs it, for the message.
    """
    found = library()
    if found is None:
        raise ResourceError(f"{purpose} needs the native library", got=_problem, remedy=REMEDY)
    return found


def status() -> str:
    """One line in words: what is in use, or why it is not and how to get it."""
    found = library()
    if found is None:
        return f"native library: not in use ({_problem}). Slow fall-backs are used; to get it, {REMEDY}."
    compiler = _build_info().get("compiler") or "an unknown compiler"
    return f"native library: {isa()} instructions, {threads()} threads, built by {compiler}"


def isa() -> str:
    """Instruction set the kernels run with: avx512, avx2 or portable."""
    return require("naming the instruction set").mudg_isa().decode()


def set_isa(name: str) -> None:
    """Chooses the instruction set ("" = best of this processor). UsageError for one that cannot run here."""
    if require("choosing the instruction set").mudg_set_isa(name.encode()) != 0:
        raise UsageError("this instruction set is not available", expected="avx512, avx2, portable or empty", got=name)


def set_threads(count: int) -> None:
    """Number of threads of the native loops, the calling one included. UsageError below 1."""
    if count < 1:
        raise UsageError("the number of threads must be at least 1", got=str(count))
    require("setting the number of threads").mudg_set_threads(count)


def threads() -> int:
    """Number of threads the native loops use; 1 when there is no library."""
    found = library()
    return 1 if found is None else int(found.mudg_threads())


@contextlib.contextmanager
def one_thread() -> Iterator[None]:
    """One thread of the native loops in this block: threads inside threads only wait for each other."""
    found, before = library(), threads()
    if found is not None:
        found.mudg_set_threads(1)
    try:
        yield
    finally:
        if found is not None:
            found.mudg_set_threads(before)


def default_threads() -> int:
    """MUDG_THREADS, else the number of processors this process may run on. UsageError if MUDG_THREADS is no number."""
    text = os.environ.get("MUDG_THREADS", "").strip()
    if text:
        if not text.isdigit() or int(text) < 1:
            raise UsageError("MUDG_THREADS must be a positive number", got=text)
        return int(text)
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def _load() -> tuple[ctypes.CDLL | None, str]:
    if os.environ.get("MUDG_NATIVE", "").strip().lower() == "off":
        return None, "switched off by MUDG_NATIVE=off"
    if not LIBRARY_PATH.exists():
        return None, str(_build_info().get("reason") or f"{LIBRARY_PATH.name} was not built at installation")
    try:
        found = ctypes.CDLL(str(LIBRARY_PATH))
    except OSError as error:
        return None, f"{LIBRARY_PATH} does not load: {error}"
    found.mudg_abi_version.restype = ctypes.c_int
    version = int(found.mudg_abi_version())
    if version != ABI_VERSION:
        return None, f"{LIBRARY_PATH} has interface version {version}, this package needs {ABI_VERSION}: build it again"
    found.mudg_set_threads.argtypes = [ctypes.c_int]
    found.mudg_threads.restype = ctypes.c_int
    found.mudg_isa.restype = ctypes.c_char_p
    found.mudg_set_isa.argtypes = [ctypes.c_char_p]
    found.mudg_set_threads(default_threads())
    wanted = os.environ.get("MUDG_ISA", "").strip()
    if wanted and found.mudg_set_isa(wanted.encode()) != 0:
        expected = "avx512, avx2, portable"
        raise UsageError("MUDG_ISA names an instruction set that cannot run here", got=wanted, expected=expected)
    return found, ""


def _build_info() -> dict[str, Any]:
    path = FOLDER / "build_info.json"
    if not path.exists():
        return {}
    info = json.loads(path.read_text(encoding="utf-8"))
    return info if isinstance(info, dict) else {}
