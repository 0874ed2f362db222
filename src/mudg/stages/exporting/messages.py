"""A log as messages over time: files of Foxglove and rerun, bags of ROS 2."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from mudg.base import log, store
from mudg.base.run_folder import RunDir, VerbOutput
from mudg.base.types import Scene
from mudg.base.versions import version
from mudg.data.exporters import ros2
from mudg.data.exporters.foxglove import DIALECT, FoxgloveMessages
from mudg.data.exporters.log_records import LogRecords
from mudg.data.exporters.mcap import McapBlocks
from mudg.data.exporters.rerun_file import package, write_rerun
from mudg.data.scene import read_points
from mudg.data.scene.files import open_files
from mudg.data.splats.cloud import SplatScene

SUFFIXES: Final = {"mcap": ".mcap", "rerun": ".rrd", "ros2": ""}
"""Formats, and the suffix of their file; none: a folder."""
BAG: Final = VerbOutput("export", 1, (ros2.METADATA, ros2.FILE))


@dataclass(frozen=True, slots=True, eq=False)
class Told:
    """What is told over time: the records of a log, and Gaussians where the format shows them; either may be None."""

    records: LogRecords | None
    splats: SplatScene | None = None

    @property
    def summary(self) -> str:
        """What there is, for people."""
        parts = []
        if self.records is not None:
            parts.append(f"{len(self.records.scene.frames)} pictures, {len(self.records.scene.sweeps)} sweeps")
        if self.splats is not None:
            parts.append(f"{sum(len(node.cloud) for node in self.splats.nodes)} Gaussians")
        return ", ".join(parts)


def records_of(scene: Scene, fused: Any = None) -> LogRecords:
    """The records of a scene on disk; pictures and points are read when they are asked for."""
    files = open_files(scene.root)
    return LogRecords(scene, lambda frame: files.read(frame.image.path), lambda sweep: read_points(scene, sweep), fused)


def refuse_missing(name: str) -> None:
    """ResourceError if the package of a format is not installed."""
    if name == "rerun":
        package()


def write_file(name: str, told: Told, out: Path) -> Path:
    """Write a log as one file: ``mcap`` or ``rerun``."""
    if name == "rerun":
        title = told.records.scene.id if told.records is not None else "scene"
        write_rerun(out, told.records, told.splats, title)
    elif told.records is not None:
        store.write_blocks(out, McapBlocks(FoxgloveMessages(told.records), f"mudg {version()}", DIALECT))
    log.info(f"export: {told.summary}, {out.stat().st_size / 1e6:.2f} MB in {out}")
    return out


def write_bag(records: LogRecords, folder: RunDir) -> Path:
    """Write a log as a bag of ROS 2."""
    if folder.complete:
        return folder.reused()
    try:
        blocks = McapBlocks(ros2.Ros2Messages(records), f"mudg {version()}", ros2.dialect())
        store.write_blocks(folder.path / ros2.FILE, blocks)
    except KeyboardInterrupt:
        folder.pause()
        raise
    store.atomic_write(folder.path / ros2.METADATA, ros2.metadata(blocks.topics, blocks.span))
    size = (folder.path / ros2.FILE).stat().st_size
    count = sum(number for _, number in blocks.topics.values())
    folder.finish({"format": "ros2", "messages": count})
    log.info(f"export: {Told(records).summary}, {count} messages, {size / 1e6:.2f} MB in {folder.path}")
    return folder.path
