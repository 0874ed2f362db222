"""An edited scene on disk: its images, labels and LiDAR sweeps show the edits, so that every step takes it like a recorded one.

Images keep their recorded pixels where a fitted scene renders the same with and without the edits; the rest comes from the render of
the edited one. Where the vehicle drives another path or through another street all pixels do.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from mudg.base import log, seeds
from mudg.base.palette import DYNAMIC_IDS, ID
from mudg.base.types import Frame, FusedCloud, Observation, Scene
from mudg.core.pictures import to_bytes
from mudg.core.weather.lidar import SOFT, sweep_in_weather
from mudg.data.scene import SceneWriter, read_image, read_label, read_points
from mudg.models.scene.model import SceneModel
from mudg.stages.config.edit import EditConfig
from mudg.stages.editing.plan import EditPlan
from mudg.stages.editing.swept import SweptCounts, edited_points
from mudg.stages.editing.weathered import SEED
from mudg.stages.fitting.rendering import raster_of, render_view

NOTE: Final = "edited: parts of the images are renders of a fitted scene"
CHANGED_ABOVE: Final = 4 / 255
"""Pixels whose renders with and without the edits differ by less than this, 0 to 1, stay as recorded or rendered."""
GROWN_PX: Final = 2
"""The rest is grown by this much: a render fades out beyond what differs clearly."""
KEPT_LABELS: Final = ("semantics", "depth", "sky", "dynamic")
"""Labels that a changed image keeps; others speak of the recording."""
RENDERED: Final = "rendered"


@dataclass(frozen=True, slots=True, eq=False)
class EditedImages:
    """Makes images of an edited drive.

    Args:
        before, after: a fitted scene without and with the edits.
        whole: every pixel is rendered: the vehicle drives another path, or through another street.
    """

    before: SceneModel
    after: SceneModel
    config: EditConfig
    whole: bool
    repaired: Mapping[str, Iterator[Observation]] | None = None
    """By camera: views of its frames in order, repaired by a diffusion model."""

    def of(self, recorded: NDArray[np.uint8], frame: Frame) -> tuple[NDArray[np.uint8], NDArray[np.bool_], Observation]:
        """The image u8[H, W, 3] of a frame, which of its pixels [H, W] are rendered, and the render."""
        raster = raster_of(self.before, self.config.raster)
        made = render_view(self.after, frame.view, raster) if self.repaired is None else next(self.repaired[frame.view.camera.name])
        if self.whole:
            return to_bytes(made.rgb), np.ones(recorded.shape[:2], bool), made
        usual = render_view(self.before, frame.view, raster)
        changed = ((made.rgb - usual.rgb).abs().amax(0) > CHANGED_ABOVE).numpy()
        changed = np.asarray(ndimage.binary_dilation(changed, iterations=GROWN_PX), bool) if changed.any() else changed
        return np.where(changed[..., None], to_bytes(made.rgb), recorded), changed, made


@dataclass(frozen=True, slots=True, eq=False)
class DriveChange:
    """What is to be written.

    Args:
        plan: what was done. scene: with the edited boxes, path and poses (``apply.edited_scene``). cloud: edited.
    """

    plan: EditPlan
    scene: Scene
    cloud: FusedCloud


def write_edited_scene(scene: Scene, drive: DriveChange, images: EditedImages, root: Path) -> SweptCounts:
    """Write a scene whose files show the edits; returns what became of LiDAR returns.

    Args:
        scene: as recorded.
    """
    edited, counts = drive.scene, SweptCounts()
    source = replace(scene.source, recipe=None, notes=(*scene.source.notes, NOTE))
    with SceneWriter(root, scene.id, source) as writer:
        for camera in scene.cameras.values():
            writer.add_camera(camera)
        for number, sweep in enumerate(scene.sweeps if drive.plan.background is None else ()):  # another street was not measured from here
            points, became = edited_points(read_points(scene, sweep), sweep, drive.plan, drive.cloud)
            if drive.plan.weather_of_beams is not None:
                there, seed = len(points.xyz), seeds.key(SEED, number, "LiDAR in weather")
                points, kinds = sweep_in_weather(points, drive.plan.weather_of_beams, seed)
                became = replace(became, lost=there - len(kinds), droplets=int((kinds == SOFT).sum()))
            counts = counts.plus(became)
            writer.add_sweep(sweep.id, sweep.sensor, sweep.time_s, sweep.world_from_lidar, points)
        for track in edited.tracks:
            writer.add_track(track)
        writer.set_ego(edited.ego)
        writer.set_split(scene.split)
        for old, new in log.progress(list(zip(scene.frames, edited.frames, strict=True)), len(scene.frames), "editing images"):
            image, changed, made = images.of(read_image(scene, old), new)
            if not changed.any():
                writer.copy_frame(scene, old)
            else:
                writer.add_frame(new.id, new.view, image, _labels(scene, old, changed, made))
        writer.finish()
    return counts


def _labels(scene: Scene, frame: Frame, changed: NDArray[np.bool_], made: Observation) -> dict[str, NDArray[Any]]:
    """Labels of a changed image: those of the render where it is rendered."""
    found = {name: read_label(scene, frame, name) for name in KEPT_LABELS if name in frame.labels}
    ours = {RENDERED: changed | read_label(scene, frame, RENDERED) if RENDERED in frame.labels else changed}
    if made.semantics is None or made.depth is None:
        return ours
    ids = made.semantics.numpy().astype(np.uint8)
    rendered = {
        "semantics": ids, "sky": ids == ID["sky"], "dynamic": np.isin(ids, DYNAMIC_IDS),
        "depth": np.nan_to_num(made.depth[0].numpy(), nan=np.inf),
    }  # fmt: skip
    return ours | {name: np.where(changed, rendered[name].astype(old.dtype), old) for name, old in found.items()}
