"""Importers: dataset logs in their own formats -> scene directories. This is the only place that lists them.

A format is one module with ``import_<format>(source, out, options) -> Scene``, ``looks_like_<format>(source) -> bool``
and, where folders hold many logs, ``files_of_<format>(source, options) -> LogFiles``; its name in ``FORMATS`` and a case in
``_module``. Modules are loaded when their format is first asked for.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from types import ModuleType
from typing import Any, Final

from mudg.base.types import Scene
from mudg.data.importers.layout import LogFiles
from mudg.data.importers.options import ImportOptions

Importer = Callable[[Path, Path, ImportOptions], Scene]
Recogniser = Callable[[Path], bool]

FORMATS: Final = (
    "kitti360",  # before kitti: a drive's folder has image_00 in both
    "waymo", "nuscenes", "argoverse2", "pandaset", "nuplan", "dgp", "custom", "kitti",
)  # fmt: skip
"""Names of the formats, in the order in which a folder is asked whether it looks like one."""


def _module(name: str) -> ModuleType:
    match name:
        case "kitti360":
            from mudg.data.importers.kitti360 import importer as module
        case "waymo":
            from mudg.data.importers.waymo import importer as module
        case "nuscenes":
            from mudg.data.importers.nuscenes import importer as module
        case "argoverse2":
            from mudg.data.importers import argoverse2 as module
        case "pandaset":
            from mudg.data.importers.pandaset import importer as module
        case "nuplan":
            from mudg.data.importers.nuplan import importer as module
        case "dgp":
            from mudg.data.importers import dgp as module
        case "custom":
            from mudg.data.importers.custom import importer as module
        case "kitti":
            from mudg.data.importers.kitti import importer as module
        case _:
            raise KeyError(name)
    return module


def _call(kind: str, name: str, *arguments: Any) -> Any:
    """``<kind>_<name>(*arguments)`` of the format's module."""
    return getattr(_module(name), f"{kind}_{name}")(*arguments)


def files_of(name: str, source: Path, options: ImportOptions) -> LogFiles:
    """What identifies the log that format ``name`` would import from ``source``; nothing large is read.

    Raises:
        UsageError: several logs and none was chosen. InputError: none is there.
    """
    return LogFiles((source,)) if name == "custom" else _call("files_of", name, source, options)


IMPORTERS: Final[Mapping[str, Importer]] = {name: partial(_call, "import", name) for name in FORMATS}
"""Format name -> importer ``(source, out, options) -> Scene``."""

RECOGNISERS: Final[Mapping[str, Recogniser]] = {name: partial(_call, "looks_like", name) for name in FORMATS}
"""Format name -> whether a folder or file looks like it (by names of files, a few bytes at most). The first that says yes wins."""
