"""Importers: dataset logs in their own formats -> scene directories. This is the only place that lists them.

A format is one module, or a folder with ``importer.py``. It has ``import_<format>(source, out, options) -> Scene``,
``looks_like_<format>(source) -> bool`` and, where folders hold many logs, ``files_of_<format>(source, options) ->
LogFiles``; and a row in ``_MODULES``. Modules are loaded when their format is first asked for.

An importer raises UsageError where a folder holds several logs and none was chosen, or where there is no such log or
camera; InputError where something is missing, malformed or contradictory: nothing is left at ``out`` then.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

from mudg.base.types import Scene
from mudg.base.versions import load_plugin, plugins
from mudg.formats.importers.common import ImportOptions, LogFiles, foreign_numbers
from mudg.formats.unknown_fields import named_once

Importer = Callable[[Path, Path, ImportOptions], Scene]
Recogniser = Callable[[Path], bool]

_MODULES = {
    "kitti360": "kitti360",
    "waymo": "waymo",
    "nuscenes": "nuscenes",
    "argoverse2": "argoverse2",
    "pandaset": "pandaset",
    "nuplan": "nuplan",
    "ncore": "ncore",
    "custom": "custom",
    "kitti": "kitti",
}
FORMATS = tuple(_MODULES)
"""Names of the formats, in the order in which a folder is asked whether it looks like one: a drive of KITTI-360 has
image_00 as one of KITTI."""


def _function(verb: str, name: str) -> Any:
    """The function ``<verb>_<name>`` of a format's module, None where it has none."""
    module = importlib.import_module(f"{__name__}.{_MODULES[name]}")
    return getattr(module, f"{verb}_{name}", None)


def import_log(name: str, source: Path, out: Path, options: ImportOptions) -> Scene:
    """Import a log as one of ``known_formats``. Raises UsageError: another package offers the format, and its code
    cannot be loaded. InputError: the log is malformed."""
    read = _function("import", name) if name in FORMATS else load_plugin(name)
    with foreign_numbers(), named_once():
        return read(source, out, options)


def known_formats() -> tuple[str, ...]:
    """``FORMATS``, and those of other packages, which are used only when they are named."""
    return (*FORMATS, *(name for name in plugins() if name not in FORMATS))


def files_of(name: str, source: Path, options: ImportOptions) -> LogFiles:
    """What identifies the log that format ``name`` would import from ``source``; nothing large is read. Raises
    UsageError: several logs and none was chosen. InputError: none is there."""
    find = _function("files_of", name) if name in FORMATS else None
    return LogFiles((source,)) if find is None else find(source, options)


IMPORTERS: Mapping[str, Importer] = {name: partial(import_log, name) for name in FORMATS}
"""Format name -> importer ``(source, out, options) -> Scene``."""

RECOGNISERS: Mapping[str, Recogniser] = {
    name: lambda source, name=name: _function("looks_like", name)(source) for name in FORMATS
}
"""Format name -> whether a folder or file looks like it (by names of files, a few bytes at most). The first that says
yes wins."""
