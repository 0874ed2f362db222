"""Importers: dataset logs in their own formats -> scene directories. The table below is the only place that lists them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path

from mudg.base.types import Scene
from mudg.data.importers.options import ImportOptions

Importer = Callable[[Path, Path, ImportOptions], Scene]


def _kitti(source: Path, out: Path, options: ImportOptions) -> Scene:
    from mudg.data.importers.kitti import import_kitti

    return import_kitti(source, out, options)


IMPORTERS: Mapping[str, Importer] = {
    "kitti": _kitti,
}
"""Format name -> importer ``(source, out, options) -> Scene``; each loads its code when called."""
