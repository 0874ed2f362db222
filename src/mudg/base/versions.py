"""What a result was made with. Read from package metadata, so that nothing heavy is imported."""

from __future__ import annotations

import functools
import os
import platform
from typing import Any


def installed(package: str) -> str:
    """Version of an installed package; empty where it is missing."""
    from importlib import metadata  # late: it takes a sixth of what --help takes

    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return ""


@functools.cache
def version() -> str:
    """Version of this package, or ``0+unknown`` when it runs uninstalled."""
    return installed("mudg") or "0+unknown"


@functools.cache
def environment() -> dict[str, Any]:
    """Versions and machine facts that results may depend on, without host name, user name or path; looked up once."""
    machine = {"system": platform.system(), "machine": platform.machine(), "cpu_count": os.cpu_count()}
    packages = {
        name: installed(name) or "missing" for name in ("torch", "numpy", "scipy", "pillow", "safetensors", "av")
    }
    return {"mudg": version(), "python": platform.python_version(), **machine, "packages": packages}
