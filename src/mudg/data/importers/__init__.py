"""Importers: dataset logs in their own formats -> scene directories. The two tables below are the only place that lists them.

A format is one module ``<format>.py`` with ``import_<format>(source, out, options) -> Scene`` and
``looks_like_<format>(source) -> bool``, and one row in each table. Rows load their module when called.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path

from mudg.base.types import Scene
from mudg.data.importers.options import ImportOptions

Importer = Callable[[Path, Path, ImportOptions], Scene]
Recogniser = Callable[[Path], bool]


def _kitti(source: Path, out: Path, options: ImportOptions) -> Scene:
    from mudg.data.importers.kitti import import_kitti

    return import_kitti(source, out, options)


def _looks_like_kitti(source: Path) -> bool:
    from mudg.data.importers.kitti import looks_like_kitti

    return looks_like_kitti(source)


def _waymo(source: Path, out: Path, options: ImportOptions) -> Scene:
    from mudg.data.importers.waymo import import_waymo

    return import_waymo(source, out, options)


def _looks_like_waymo(source: Path) -> bool:
    from mudg.data.importers.waymo import looks_like_waymo

    return looks_like_waymo(source)


def _custom(source: Path, out: Path, options: ImportOptions) -> Scene:
    from mudg.data.importers.custom import import_custom

    return import_custom(source, out, options)


def _looks_like_custom(source: Path) -> bool:
    from mudg.data.importers.custom import looks_like_custom

    return looks_like_custom(source)


IMPORTERS: Mapping[str, Importer] = {
    "custom": _custom,
    "kitti": _kitti,
    "waymo": _waymo,
}
"""Format name -> importer ``(source, out, options) -> Scene``."""

RECOGNISERS: Mapping[str, Recogniser] = {
    "custom": _looks_like_custom,
    "kitti": _looks_like_kitti,
    "waymo": _looks_like_waymo,
}
"""Format name -> whether a folder or file looks like it (by names of files, a few bytes at most). The first that says yes wins."""
