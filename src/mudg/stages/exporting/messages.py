"""A log over time: files of Foxglove and rerun, bags of ROS 2, recordings of NCore."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from mudg.base import log, store
from mudg.base.types import Scene
from mudg.base.versions import version
from mudg.data import ncore as ncore_package
from mudg.data.exporters import ncore, ros2
from mudg.data.exporters.foxglove import DIALECT, FoxgloveMessages
from mudg.data.exporters.log_records import LogRecords
from mudg.data.exporters.mcap import McapBlocks
from mudg.data.exporters.rerun_file import package, write_rerun
from mudg.data.scene import read_points
from mudg.data.scene.files import open_files
from mudg.data.splats.cloud import SplatScene

SUFFIXES: Final = {"mcap": ".mcap", "rerun": ".rrd", "ros2": "", "ncore": ""}
"""Formats, and the suffix of their file; none: a folder."""
FOLDERS: Final = {"ros2": (1, (ros2.METADATA, ros2.FILE)), "ncore": (1, ncore.FILES)}
"""Formats that are folders: version and files of each."""


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
    elif name == "ncore":
        ncore_package.package()


def write_log(name: str, told: Told, out: Path) -> dict[str, int]:
    """Write a log as one file, ``mcap`` or ``rerun``; returns its size."""
    if name == "rerun":
        title = told.records.scene.id if told.records is not None else "scene"
        write_rerun(out, told.records, told.splats, title)
    elif told.records is not None:
        store.write_blocks(out, McapBlocks(FoxgloveMessages(told.records), f"mudg {version()}", DIALECT))
    size = out.stat().st_size
    log.info(f"export: {told.summary}, {size / 1e6:.2f} MB")
    return {"bytes": size}


def write_messages(name: str, records: LogRecords, out: Path) -> dict[str, Any]:
    """Write a log as a folder, ``ros2`` or ``ncore``; returns a summary."""
    content, summary = _bag(records, out) if name == "ros2" else _recording(records, out)
    told = "".join(f", {count} {what}" for what, count in summary.items())
    log.info(f"export: {Told(records).summary}{told}, {content.stat().st_size / 1e6:.2f} MB in {out}")
    return {"format": name, **summary}


def _bag(records: LogRecords, folder: Path) -> tuple[Path, dict[str, int]]:
    """A bag of ROS 2: its largest file, and what to say of it."""
    blocks = McapBlocks(ros2.Ros2Messages(records), f"mudg {version()}", ros2.dialect())
    store.write_blocks(folder / ros2.FILE, blocks)
    store.atomic_write(folder / ros2.METADATA, ros2.metadata(blocks.topics, blocks.span))
    return folder / ros2.FILE, {"messages": sum(number for _, number in blocks.topics.values())}


def _recording(records: LogRecords, folder: Path) -> tuple[Path, dict[str, int]]:
    """A recording of NCore."""
    rolling = [name for name, camera in records.scene.cameras.items() if camera.readout_s > 0]
    if rolling:
        log.warn(f"export: a scene does not know which way the shutters of {', '.join(rolling)} roll; ncore says downwards")
    return ncore.write_ncore(folder, records)[0], {"boxes": len(records.scene.tracks)}
