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


def _nuscenes(source: Path, out: Path, options: ImportOptions) -> Scene:
    from mudg.data.importers.nuscenes import import_nuscenes

    return import_nuscenes(source, out, options)


def _looks_like_nuscenes(source: Path) -> bool:
    from mudg.data.importers.nuscenes import looks_like_nuscenes

    return looks_like_nuscenes(source)


def _argoverse2(source: Path, out: Path, options: ImportOptions) -> Scene:
    from mudg.data.importers.argoverse2 import import_argoverse2

    return import_argoverse2(source, out, options)


def _looks_like_argoverse2(source: Path) -> bool:
    from mudg.data.importers.argoverse2 import looks_like_argoverse2

    return looks_like_argoverse2(source)


def _dgp(source: Path, out: Path, options: ImportOptions) -> Scene:
    from mudg.data.importers.dgp import import_dgp

    return import_dgp(source, out, options)


def _looks_like_dgp(source: Path) -> bool:
    from mudg.data.importers.dgp import looks_like_dgp

    return looks_like_dgp(source)


IMPORTERS: Mapping[str, Importer] = {
    "kitti": _kitti,
    "nuscenes": _nuscenes,
    "argoverse2": _argoverse2,
    "dgp": _dgp,
}
"""Format name -> importer ``(source, out, options) -> Scene``."""

RECOGNISERS: Mapping[str, Recogniser] = {
    "kitti": _looks_like_kitti,
    "nuscenes": _looks_like_nuscenes,
    "argoverse2": _looks_like_argoverse2,
    "dgp": _looks_like_dgp,
}
"""Format name -> whether a folder or file looks like it (by names of files, a few bytes at most). The first that says yes wins."""
