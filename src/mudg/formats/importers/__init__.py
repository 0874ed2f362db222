"""Importers: dataset logs in their own formats -> scene directories. This is the only place that lists them.

A format is one module, or a folder with ``importer.py``. It has ``import_<format>(source, out, options) -> Scene``,
``looks_like_<format>(source) -> bool`` and, where folders hold many logs, ``files_of_<format>(source, options) ->
LogFiles``; its name in ``FORMATS`` and a case in ``_functions``. Modules are loaded when their format is first asked
for.

An importer raises UsageError where a folder holds several logs and none was chosen, or where there is no such log or
camera; InputError where something is missing, malformed or contradictory: nothing is left at ``out`` then.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path

from mudg.base.plugins import load_plugin, plugins
from mudg.base.types import Scene
from mudg.formats.importers.common import ImportOptions, LogFiles, foreign_numbers
from mudg.formats.unknown_fields import named_once

Importer = Callable[[Path, Path, ImportOptions], Scene]
Recogniser = Callable[[Path], bool]
Finder = Callable[[Path, ImportOptions], LogFiles]

FORMATS = tuple("kitti360 waymo nuscenes argoverse2 pandaset nuplan dgp ncore custom kitti".split())
"""Names of the formats, in the order in which a folder is asked whether it looks like one: a drive of KITTI-360 has
image_00 as one of KITTI."""


def _whole_source(source: Path, _options: ImportOptions) -> LogFiles:
    return LogFiles((source,))


def _functions(name: str) -> tuple[Recogniser, Importer, Finder]:
    """``looks_like_<name>``, ``import_<name>`` and ``files_of_<name>``."""
    match name:
        case "kitti360":
            from mudg.formats.importers.kitti360 import files_of_kitti360, import_kitti360, looks_like_kitti360

            return looks_like_kitti360, import_kitti360, files_of_kitti360
        case "waymo":
            from mudg.formats.importers.waymo.importer import files_of_waymo, import_waymo, looks_like_waymo

            return looks_like_waymo, import_waymo, files_of_waymo
        case "nuscenes":
            from mudg.formats.importers.nuscenes import files_of_nuscenes, import_nuscenes, looks_like_nuscenes

            return looks_like_nuscenes, import_nuscenes, files_of_nuscenes
        case "argoverse2":
            from mudg.formats.importers.argoverse2 import files_of_argoverse2, import_argoverse2, looks_like_argoverse2

            return looks_like_argoverse2, import_argoverse2, files_of_argoverse2
        case "pandaset":
            from mudg.formats.importers.pandaset import files_of_pandaset, import_pandaset, looks_like_pandaset

            return looks_like_pandaset, import_pandaset, files_of_pandaset
        case "nuplan":
            from mudg.formats.importers.nuplan import files_of_nuplan, import_nuplan, looks_like_nuplan

            return looks_like_nuplan, import_nuplan, files_of_nuplan
        case "dgp":
            from mudg.formats.importers.dgp import files_of_dgp, import_dgp, looks_like_dgp

            return looks_like_dgp, import_dgp, files_of_dgp
        case "ncore":
            from mudg.formats.importers.ncore import files_of_ncore, import_ncore, looks_like_ncore

            return looks_like_ncore, import_ncore, files_of_ncore
        case "custom":
            from mudg.formats.importers.custom import import_custom, looks_like_custom

            return looks_like_custom, import_custom, _whole_source
        case "kitti":
            from mudg.formats.importers.kitti import files_of_kitti, import_kitti, looks_like_kitti

            return looks_like_kitti, import_kitti, files_of_kitti
        case _:
            return (lambda source: False), load_plugin("importer", name), _whole_source


def import_log(name: str, source: Path, out: Path, options: ImportOptions) -> Scene:
    """Import a log as one of ``known_formats``.

    Raises:
        UsageError: another package offers the format, and its code cannot be loaded. InputError: the log is malformed.
    """
    with foreign_numbers(), named_once():
        return _functions(name)[1](source, out, options)


def known_formats() -> tuple[str, ...]:
    """``FORMATS``, and those of other packages, which are used only when they are named."""
    return (*FORMATS, *(name for name in plugins("importer") if name not in FORMATS))


def _looks_like(name: str, source: Path) -> bool:
    return _functions(name)[0](source)


def files_of(name: str, source: Path, options: ImportOptions) -> LogFiles:
    """What identifies the log that format ``name`` would import from ``source``; nothing large is read. Raises
    UsageError: several logs and none was chosen. InputError: none is there."""
    return _functions(name)[2](source, options)


IMPORTERS: Mapping[str, Importer] = {name: partial(import_log, name) for name in FORMATS}
"""Format name -> importer ``(source, out, options) -> Scene``."""

RECOGNISERS: Mapping[str, Recogniser] = {name: partial(_looks_like, name) for name in FORMATS}
"""Format name -> whether a folder or file looks like it (by names of files, a few bytes at most). The first that says
yes wins."""
