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


def _kitti360(source: Path, out: Path, options: ImportOptions) -> Scene:
    from mudg.data.importers.kitti360 import import_kitti360

    return import_kitti360(source, out, options)


def _looks_like_kitti360(source: Path) -> bool:
    from mudg.data.importers.kitti360 import looks_like_kitti360

    return looks_like_kitti360(source)


def _pandaset(source: Path, out: Path, options: ImportOptions) -> Scene:
    from mudg.data.importers.pandaset import import_pandaset

    return import_pandaset(source, out, options)


def _looks_like_pandaset(source: Path) -> bool:
    from mudg.data.importers.pandaset import looks_like_pandaset

    return looks_like_pandaset(source)


def _nuplan(source: Path, out: Path, options: ImportOptions) -> Scene:
    from mudg.data.importers.nuplan import import_nuplan

    return import_nuplan(source, out, options)


def _looks_like_nuplan(source: Path) -> bool:
    from mudg.data.importers.nuplan import looks_like_nuplan

    return looks_like_nuplan(source)


def _custom(source: Path, out: Path, options: ImportOptions) -> Scene:
    from mudg.data.importers.custom import import_custom

    return import_custom(source, out, options)


def _looks_like_custom(source: Path) -> bool:
    from mudg.data.importers.custom import looks_like_custom

    return looks_like_custom(source)


IMPORTERS: Mapping[str, Importer] = {
    "custom": _custom,
    "kitti": _kitti,
    "kitti360": _kitti360,
    "pandaset": _pandaset,
    "nuplan": _nuplan,
}
"""Format name -> importer ``(source, out, options) -> Scene``."""

RECOGNISERS: Mapping[str, Recogniser] = {
    "kitti360": _looks_like_kitti360,  # before kitti: a drive's folder has image_00 in both
    "pandaset": _looks_like_pandaset,
    "nuplan": _looks_like_nuplan,
    "custom": _looks_like_custom,
    "kitti": _looks_like_kitti,
    "nuscenes": _looks_like_nuscenes,
    "argoverse2": _looks_like_argoverse2,
    "dgp": _looks_like_dgp,
}
"""Format name -> whether a folder or file looks like it (by names of files, a few bytes at most). The first that says yes wins."""
