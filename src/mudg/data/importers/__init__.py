"""Importers: dataset logs in their own formats -> scene directories. ``FORMATS`` is the only place that lists them.

A format is one module ``<format>.py`` with ``import_<format>(source, out, options) -> Scene`` and
``looks_like_<format>(source) -> bool``, and its name in ``FORMATS``. Modules are loaded when they are asked.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

from mudg.base.types import Scene
from mudg.data.importers.options import ImportOptions

Importer = Callable[[Path, Path, ImportOptions], Scene]
Recogniser = Callable[[Path], bool]

FORMATS = (
    "kitti360",  # before kitti: a drive's folder has image_00 in both
    "waymo", "nuscenes", "argoverse2", "pandaset", "nuplan", "dgp", "custom", "kitti",
)  # fmt: skip
"""Names of the formats, in the order in which a folder is asked whether it looks like one."""


def _function(name: str, purpose: str) -> Callable[..., Any]:
    """``import_<name>`` or ``looks_like_<name>``; ``name`` is always one of ``FORMATS``, never text from a file."""
    return getattr(importlib.import_module(f"{__name__}.{name}"), f"{purpose}_{name}")


def _import(name: str, source: Path, out: Path, options: ImportOptions) -> Scene:
    return _function(name, "import")(source, out, options)


def _looks_like(name: str, source: Path) -> bool:
    return _function(name, "looks_like")(source)


IMPORTERS: Mapping[str, Importer] = {name: partial(_import, name) for name in FORMATS}
"""Format name -> importer ``(source, out, options) -> Scene``."""

RECOGNISERS: Mapping[str, Recogniser] = {name: partial(_looks_like, name) for name in FORMATS}
"""Format name -> whether a folder or file looks like it (by names of files, a few bytes at most). The first that says yes wins."""
