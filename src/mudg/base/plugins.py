"""Importers of other packages: entry points of the group ``mudg.plugins``, named ``importer.NAME``.

Names are read from package metadata; a package's code is imported only when you ask for its name.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

from mudg.base.errors import UsageError

if TYPE_CHECKING:
    from importlib.metadata import EntryPoint

GROUP: Final = "mudg.plugins"
_KIND: Final = "importer."


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
