"""``mudg dataset``: labelled views of a reconstruction in the format of a data set.

Every view becomes its files and a record, so that an interrupted run goes on with the next view; what a format keeps
in one file (COCO's annotations, lists of splits) is made of the records at the end. ``OUT/provenance.jsonl`` has a line
per image: run, edits, trajectory, pose, trust and objects.
"""

from __future__ import annotations

import dataclasses
import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from mudg.base import geometry, log, store
from mudg.base.errors import ResourceError, UsageError
from mudg.base.memory import in_words
from mudg.base.run_folder import RunDir
from mudg.base.types import Trajectory, View
from mudg.datasets import coco, kitti, nuscenes
from mudg.datasets.samples import LabelledView, Labeller, ObjectBox
from mudg.datasets.settings import DatasetConfig
from mudg.sim.session import Layer, Session

Record = Mapping[str, Any]
PNG_BYTES: Final = 2.2
"""Bytes per pixel of a rendered PNG with its labels, measured on generated cities (1.6 to 2.0)."""
RECORDS: Final = "records"


@dataclass(frozen=True)
class Format:
    """How a data set is written.

    Args:
        layers: that it needs. files: patterns of what it writes. view: writes the files of a view below the work folder
            and returns what the whole needs to know of it. whole: writes the files of the whole from the records, in
            the order of the views.
    """

    layers: tuple[Layer, ...]
    files: tuple[str, ...]
    view: Callable[[Path, int, LabelledView], dict[str, Any]]
    whole: Callable[[Path, Sequence[Record]], None]


FORMATS: Final[Mapping[str, Format]] = {
    "kitti": Format(("rgb",), kitti.FILES, kitti.write_view, kitti.write_whole),
    "coco": Format(("rgb", "classes", "instances"), coco.FILES, coco.write_view, coco.write_whole),
    "nuscenes": Format(("rgb",), nuscenes.FILES, nuscenes.write_view, nuscenes.write_whole),
}


def write_dataset(
    name: str, config: DatasetConfig, session: Session, provenance: Record, work: RunDir
) -> dict[str, Any]:
    """Fill a folder. ``provenance``: where the views come from, kept with every image."""
    chosen, labeller = FORMATS[name], Labeller(session)
    views = views_of(labeller, config)
    require_disk(views, work.path)
    counts: dict[str, int] = {}
    records = []
    with log.task(f"dataset {name}", len(views)) as bar:
        for number, (title, view) in enumerate(views):
            path = work.path / RECORDS / f"{number:06d}.json"
            if not path.is_file():
                labelled = wanted(labeller.label(title, view, chosen.layers), config)
                made = chosen.view(work.path, number, labelled)
                store.write_json(path, {**made, "about": about(number, labelled, provenance)})
            records.append(store.read_json(path))
            for label in records[-1]["about"]["labels"]:
                counts[label] = counts.get(label, 0) + 1
            bar.advance()
    chosen.whole(work.path, records)
    lines = [store.json_text(record["about"], None) for record in records]
    store.write_text(work.path / "provenance.jsonl", "\n".join(lines) + "\n")
    shutil.rmtree(work.path / RECORDS)
    return {"format": name, "images": len(records), "objects": dict(sorted(counts.items()))}


def views_of(labeller: Labeller, config: DatasetConfig) -> list[tuple[str, View]]:
    """Names and views, trajectory by trajectory."""
    cameras = config.cameras or tuple(labeller.scene.cameras)
    paths: list[Trajectory] = labeller.paths(cameras, config.shifts_m, config.width_px)
    return [
        (f"{path.name}/{index:06d}", view)
        for path in paths
        for index, view in enumerate(path.views)
        if index % config.every == 0
    ]


def require_disk(views: Sequence[tuple[str, View]], folder: Path) -> None:
    """Say what will be written; ResourceError where the disk does not hold it."""
    size = int(sum(view.camera.width * view.camera.height for _, view in views) * PNG_BYTES)
    free = shutil.disk_usage(folder).free
    log.info(f"dataset: {len(views)} images, about {in_words(size)}; {in_words(free)} are free")
    if not views:
        raise UsageError("no view is left", where="--every", remedy="choose a smaller number")
    if size > free:
        what, remedy = "the disk is too small for the data set", "choose another --out, a smaller --width-px or --every"
        raise ResourceError(what, where=str(folder), expected=in_words(size), got=in_words(free), remedy=remedy)


def wanted(view: LabelledView, config: DatasetConfig) -> LabelledView:
    """A view with the objects that the settings do not leave out."""
    keep = lambda box: box.pixels >= config.least_pixels and box.seen_from_deg <= config.farthest_seen_deg
    return dataclasses.replace(view, boxes=tuple(box for box in view.boxes if box.pixels and keep(box)))


def about(number: int, view: LabelledView, provenance: Record) -> dict[str, Any]:
    """Where an image comes from, and how far it can be trusted."""
    trust = {
        name: None if np.isnan(value) else round(value, 4) for name, value in dataclasses.asdict(view.trust).items()
    }
    return {
        "image": f"{number:06d}",
        **provenance,
        "view": view.name,
        "camera": view.view.camera.name,
        "time_s": view.view.time_s,
        "world_from_camera": view.view.world_from_cam.tolist(),
        "trust": trust,
        "labels": [box.label for box in view.boxes],
        "objects": [object_record(box) for box in view.boxes],
    }


def object_record(box: ObjectBox) -> dict[str, Any]:
    """An object as JSON values."""
    return {
        "id": box.track_id,
        "label": box.label,
        "position_world_m": box.world_from_box[:3, 3].tolist(),
        "yaw_world_rad": geometry.yaw_of(box.world_from_box),
        "size_m": list(box.size_m),
        "pixels": box.pixels,
        "occlusion": None if np.isnan(box.occlusion) else round(box.occlusion, 4),
        "truncation": round(box.truncation, 4),
        "seen_from_deg": round(box.seen_from_deg, 2),
    }
