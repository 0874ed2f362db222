"""What a result was made with. Read from package metadata, so that nothing heavy is imported."""

from __future__ import annotations

import functools
import os
import platform
from typing import Any


def version() -> str:
    """Version of this package, or ``0+unknown`` when it runs uninstalled."""
    from importlib import metadata  # late: it takes a sixth of what --help takes

    try:
        return metadata.version("mudg")
    except metadata.PackageNotFoundError:
        return "0+unknown"


@functools.cache
def environment() -> dict[str, Any]:
    """Versions and machine facts that results may depend on. Holds no host name, user name or path. Looked up once:
    metadata is parsed anew at every question."""
    from importlib import metadata

    packages = {}
    for name in ("torch", "numpy", "scipy", "pillow", "safetensors", "av"):
        try:
            packages[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            packages[name] = "missing"
    return {
        "mudg": version(),
        "python": platform.python_version(),
        "system": platform.system(),
        "machine": platform.machine(),
        "cpu_count": os.cpu_count(),
        "packages": packages,
    }
