"""What is installed: versions that results were made with, and importers of other packages. Read from package metadata,
so that nothing heavy is imported.

Other packages offer importers as entry points of the group ``mudg.plugins``, named ``importer.NAME``. Their code is
imported only when you ask for its name.
"""

from __future__ import annotations

import functools
import os
import platform
from typing import TYPE_CHECKING, Any, Final

from mudg.base.errors import UsageError

if TYPE_CHECKING:
    from importlib.metadata import EntryPoint

GROUP: Final = "mudg.plugins"
_KIND: Final = "importer."


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


def plugins() -> dict[str, EntryPoint]:
    """Names of importers that installed packages offer, in order, and where their code is."""
    from importlib.metadata import entry_points  # 14 ms

    offered = sorted(entry_points(group=GROUP), key=lambda point: point.name)
    return {point.name.removeprefix(_KIND): point for point in offered if point.name.startswith(_KIND)}


def origin(point: EntryPoint) -> str:
    """Where the code is, for people: ``module:name of package version``."""
    package = f" of {point.dist.name} {point.dist.version}" if point.dist else ""
    return f"{point.value}{package}"


def load_plugin(name: str) -> Any:
    """The object behind a name of ``plugins``, else KeyError. UsageError: its code cannot be imported."""
    point = plugins()[name]
    try:
        return point.load()
    except (ImportError, AttributeError) as error:
        what = f"the importer {name} of another package cannot be loaded"
        remedy = "mend or uninstall the package that offers it"
        raise UsageError(what, where=origin(point), got=f"{type(error).__name__}: {error}", remedy=remedy) from error
