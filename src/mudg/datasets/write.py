"""``mudg dataset``: labelled views of reconstructions in the format of a data set; and ``mudg render --layers``.

Every view becomes its files and a record, so that an interrupted run goes on with the next view; what a format keeps
in one file (COCO's annotations, lists of splits) is made of the records at the end. ``OUT/provenance.jsonl`` has a line
per image: run, edits, split, trajectory, pose, trust and objects.
"""

from __future__ import annotations

import dataclasses
import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, cast

import numpy as np

from mudg.base import log, store
from mudg.base.errors import ResourceError, UsageError
from mudg.base.memory import in_words
from mudg.base.run_folder import RunDir
from mudg.base.types import Scene, View
from mudg.datasets import coco, kitti, nuscenes, py123d
from mudg.datasets.samples import LabelledView, Labeller
from mudg.datasets.settings import DatasetConfig
from mudg.editing.render import trajectories
from mudg.editing.runs import find_run, scene_at
from mudg.editing.script import EditScript
from mudg.editing.settings import RenderConfig
from mudg.scene.read import read_scene
from mudg.sim.lidar import mounted
from mudg.sim.session import Instant, Layer, Session

Record = Mapping[str, Any]
PNG_BYTES: Final = 2.2
"""Bytes per pixel of a rendered PNG with its labels, measured on generated cities (1.6 to 2.0)."""
SWEEP_BYTES: Final = 2_000_000
"""Bytes of a sweep of about 100,000 returns."""
RECORDS: Final = "records"


@dataclass(frozen=True)
class Format:
    """How a data set is written: the ``layers`` that it needs and patterns of its ``files``. ``view`` writes the files
    of a view below the work folder and returns what the whole needs to know of it; ``whole`` writes the files of the
    whole from these records, in the order of the views. ``one_sweep``: a sweep belongs to all cameras of a moment, not
    to each. ``check`` refuses what cannot be written on this machine. ``scratch``: folders that do not stay."""

    layers: tuple[Layer, ...]
    files: tuple[str, ...]
    view: Callable[[Path, LabelledView], dict[str, Any]]
    whole: Callable[[Path, Sequence[Record]], None]
    one_sweep: bool = False
    check: Callable[[], object] = lambda: None
    scratch: tuple[str, ...] = ()


FORMATS: Final[Mapping[str, Format]] = {
    "kitti": Format(("rgb",), kitti.FILES, kitti.write_view, kitti.write_whole),
    "kitti-tracking": Format(("rgb",), kitti.TRACKING_FILES, kitti.write_tracked, kitti.write_sequences),
    "coco": Format(("rgb", "classes", "instances"), coco.FILES, coco.write_view, coco.write_whole),
    "nuscenes": Format(("rgb",), nuscenes.FILES, nuscenes.write_view, nuscenes.write_whole, True),
    "py123d": Format(("rgb",), py123d.FILES, py123d.write_view, py123d.write_whole, True, py123d.library, ("samples",)),
}


@dataclass(frozen=True, slots=True)
class LabelledDrive:
    """A reconstruction whose views are wanted. ``name``: unlike that of other drives of the data set. ``run``,
    ``scene``, ``edits``: as for ``Session``. ``split``: train or val. ``path``: file of a camera path that stands for
    the shifts. ``provenance``: kept with every image."""

    name: str
    run: Path
    scene: Path | None = None
    edits: Path | None = None
    split: str = "train"
    path: Path | None = None
    provenance: Record = dataclasses.field(default_factory=dict)

    def views(self, config: DatasetConfig) -> list[tuple[str, View]]:
        """Names and views, trajectory by trajectory. UsageError: a camera, LiDAR or path that its log does not have, or
        a fit without its log."""
        scene = self.log()
        if config.lidar:
            mounted(scene, config.lidar)
        named = {name: getattr(config, name) for name in ("shifts_m", "width_px", "fov_deg")}
        chosen = RenderConfig(cameras=config.cameras or tuple(scene.cameras), **named)
        return [
            (f"{path.name}/{index:06d}", view)
            for path in trajectories(scene, chosen, self.path)
            for index, view in enumerate(path.views)
            if index % config.every == 0
        ]

    def log(self) -> Scene:
        """Its log."""
        scene = self.scene or find_run(self.run).scene
        if scene is None:
            what, remedy = "labels need the log that a fit belongs to", "give the folder of a run, or --scene"
            raise UsageError(what, where=str(self.run), remedy=remedy)
        return read_scene(scene_at(scene))

    def labeller(self, config: DatasetConfig) -> Labeller:
        """What makes its labelled views."""
        return Labeller(Session(self.run, self.edits, self.scene, config.device), config.lidar)


def write_dataset(name: str, config: DatasetConfig, drives: Sequence[LabelledDrive], work: RunDir) -> dict[str, Any]:
    """Fill a folder with the views of drives."""
    views = {drive.name: drive.views(config) for drive in drives}
    require_disk([view for rows in views.values() for _, view in rows], config, work.path)
    records, counts = [], dict[str, int]()
    with log.task(f"dataset {name}", sum(map(len, views.values()))) as bar:
        for record in _written(FORMATS[name], config, drives, views, work.path):
            records.append(record)
            for label in record["about"]["labels"]:
                counts[label] = counts.get(label, 0) + 1
            bar.advance()
    FORMATS[name].whole(work.path, records)
    lines = [store.json_text(record["about"], None) for record in records]
    store.write_text(work.path / "provenance.jsonl", "\n".join(lines) + "\n")
    for scratch in (RECORDS, *FORMATS[name].scratch):
        shutil.rmtree(work.path / scratch)
    return {"format": name, "images": len(records), "objects": dict(sorted(counts.items()))}


def _written(
    chosen: Format,
    config: DatasetConfig,
    drives: Sequence[LabelledDrive],
    views: Mapping[str, Sequence[tuple[str, View]]],
    folder: Path,
) -> Iterator[Record]:
    """Records of all views in order; those that are missing are made."""
    number, sequences = -1, dict[tuple[str, str], int]()
    for drive in drives:
        labeller: Labeller | None = None
        cameras = list(dict.fromkeys(view.camera.name for _, view in views[drive.name]))
        for title, view in views[drive.name]:
            number += 1
            sequence = (drive.name, title.partition("/")[0])
            sequences[sequence] = sequences.get(sequence, -1) + 1
            place = {"number": number, "sequence": list(sequences).index(sequence), "frame": sequences[sequence]}
            path = folder / RECORDS / f"{number:06d}.json"
            if not path.is_file():
                labeller = labeller or drive.labeller(config)
                swept = not chosen.one_sweep or view.camera.name == cameras[0]
                labelled = labeller.label(title, view, chosen.layers, swept=swept).wanted(config)
                labelled = dataclasses.replace(labelled, drive=drive.name, **place)
                made = chosen.view(folder, labelled)
                store.write_json(path, {**made, "split": drive.split, "about": about(labelled, drive)})
            yield store.read_json(path)


def require_disk(views: Sequence[View], config: DatasetConfig, folder: Path) -> None:
    """Say what will be written; ResourceError where the disk does not hold it."""
    size = int(sum(view.camera.width * view.camera.height for view in views) * PNG_BYTES)
    size += SWEEP_BYTES * len(views) if config.lidar else 0
    free = shutil.disk_usage(folder).free
    log.info(f"dataset: {len(views)} images, about {in_words(size)}; {in_words(free)} are free")
    if not views:
        raise UsageError("no view is left", where="--every", remedy="choose a smaller number")
    if size > free:
        what, remedy = "the disk is too small for the data set", "choose another --out, a smaller --width-px or --every"
        raise ResourceError(what, where=str(folder), expected=in_words(size), got=in_words(free), remedy=remedy)


def about(view: LabelledView, drive: LabelledDrive) -> dict[str, Any]:
    """Where an image comes from, and how far it can be trusted."""
    return {
        "image": f"{view.number:06d}",
        **drive.provenance,
        "drive": drive.name,
        "split": drive.split,
        "view": view.name,
        "camera": view.view.camera.name,
        "time_s": view.view.time_s,
        "world_from_camera": view.view.world_from_cam.tolist(),
        "trust": view.trust.record(),
        "lidar": None if view.sweep is None else view.sweep.name,
        "labels": [box.label for box in view.boxes],
        "objects": [box.record() for box in view.boxes],
    }


# --- mudg render --layers -------------------------------------------------------------------------
# OUT/layers/<trajectory>/layers.json            objects by number; per view its file, time, pose, trust and boxes
# OUT/layers/<trajectory>/000000.safetensors     arrays as in ``CameraReply.layers``
# OUT/layers/<trajectory>/000000_instances.png   u16; 000000_normals.png: u8, (n + 1) / 2, black without a surface


def write_layers(
    config: RenderConfig, scene: Path, model: Path, script: EditScript | None, path: Path | None, out: Path
) -> list[str]:
    """Draw the layers of all views that ``mudg render`` draws; returns names of the trajectories. Views that an
    interrupted run wrote are kept."""
    loaded = read_scene(scene)
    labeller = Labeller(Session(model, script, loaded, config.device))
    paths = trajectories(loaded, config, path)
    with log.task("render layers", sum(len(one) for one in paths)) as bar:
        for one in paths:
            folder = out / "layers" / one.name
            files = [folder / f"{number:06d}.json" for number in range(len(one))]
            for file, view, later in zip(files, one.views, [*one.views[1:], None], strict=True):
                if not file.is_file():
                    store.write_json(file, _write_layers_of(labeller, config, view, later, file))
                bar.advance()
            objects = {str(number): name for number, name in enumerate(labeller.names, 1)}
            whole = {"schema": 1, "objects": objects, "views": [store.read_json(file) for file in files]}
            store.write_json(folder / "layers.json", whole)
            for file in files:
                file.unlink()
    return [one.name for one in paths]


def _write_layers_of(
    labeller: Labeller, config: RenderConfig, view: View, later: View | None, file: Path
) -> dict[str, Any]:
    """Files of a view, beside ``file``; returns what the index says of it."""
    layers = cast("list[Layer]", [layer for layer in config.layers if layer != "motion" or later is not None])
    motion_to = None if later is None else Instant(later.time_s, later.world_from_cam)
    labelled = labeller.label(file.stem, view, layers, motion_to=motion_to)
    arrays = {layer: np.ascontiguousarray(labelled.layers[layer]) for layer in layers}
    store.write_safetensors(file.with_suffix(".safetensors"), arrays)
    if "instances" in arrays:
        store.write_image(file.with_name(f"{file.stem}_instances.png"), arrays["instances"])
    if "normals" in arrays:
        toward = np.nan_to_num(np.round(127.5 * (arrays["normals"] + 1)), nan=0.0)
        store.write_image(file.with_name(f"{file.stem}_normals.png"), toward.astype(np.uint8))
    return {
        "file": f"{file.stem}.safetensors",
        "layers": layers,
        "camera": dataclasses.asdict(view.camera),
        "time_s": view.time_s,
        "world_from_camera": view.world_from_cam.tolist(),
        "trust": labelled.trust.record(),
        "boxes": [
            {**box.record(), "number": box.number, "amodal_px": box.amodal_px, "visible_px": box.visible_px}
            for box in labelled.boxes
        ],
    }
