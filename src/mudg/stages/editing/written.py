"""An edited scene on disk: its images, labels and LiDAR sweeps show the edits, so that every step takes it like a recorded one.

Images keep their recorded pixels where a fitted scene renders the same with and without the edits; the rest comes from the render of
the edited one. Where the vehicle drives another path all pixels do.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from mudg.base import geometry, log
from mudg.base.palette import DYNAMIC_IDS, ID
from mudg.base.types import Frame, Observation, Scene, Sweep, SweepPoints
from mudg.core.pictures import to_bytes
from mudg.data.scene import SceneWriter, read_image, read_label, read_points
from mudg.models.scene.model import SceneModel
from mudg.stages.config.edit import EditConfig
from mudg.stages.editing.plan import EditPlan
from mudg.stages.fitting.rendering import raster_of, render_view

NOTE: Final = "edited: parts of the images are renders of a fitted scene"
BOX_MARGIN_M: Final = 0.1
KEPT_LABELS: Final = ("semantics", "depth", "sky", "dynamic")
"""Labels that a changed image keeps; others speak of the recording."""


@dataclass(frozen=True, slots=True, eq=False)
class EditedImages:
    """Makes images of an edited drive.

    Args:
        before, after: a fitted scene without and with the edits.
    """

    before: SceneModel
    after: SceneModel
    config: EditConfig
    moves_ego: bool

    def of(self, recorded: NDArray[np.uint8], frame: Frame) -> tuple[NDArray[np.uint8], NDArray[np.bool_], Observation]:
        """The image u8[H, W, 3] of a frame, which of its pixels [H, W] are rendered, and the render."""
        raster = raster_of(self.before, self.config.raster)
        made = render_view(self.after, frame.view, raster)
        if self.moves_ego:
            return to_bytes(made.rgb), np.ones(recorded.shape[:2], bool), made
        usual = render_view(self.before, frame.view, raster)
        changed = ((made.rgb - usual.rgb).abs().amax(0) > self.config.changed_above).numpy()
        if self.config.grow_px and changed.any():
            changed = np.asarray(ndimage.binary_dilation(changed, iterations=self.config.grow_px), bool)
        return np.where(changed[..., None], to_bytes(made.rgb), recorded), changed, made


def write_edited_scene(scene: Scene, edited: Scene, plan: EditPlan, images: EditedImages, root: Path) -> None:
    """Write a scene whose files show the edits.

    Args:
        scene: as recorded. edited: with the edited boxes, path and poses (``apply.edited_scene``).
    """
    source = replace(scene.source, recipe=None, notes=(*scene.source.notes, NOTE))
    with SceneWriter(root, scene.id, source) as writer:
        for camera in scene.cameras.values():
            writer.add_camera(camera)
        for sweep in scene.sweeps:
            points = edited_points(read_points(scene, sweep), sweep, plan)
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


def _labels(scene: Scene, frame: Frame, changed: NDArray[np.bool_], made: Observation) -> dict[str, NDArray[Any]]:
    """Labels of a changed image: those of the render where it is rendered."""
    found = {name: read_label(scene, frame, name) for name in KEPT_LABELS if name in frame.labels}
    if made.semantics is None or made.depth is None:
        return {}
    ids = made.semantics.numpy().astype(np.uint8)
    rendered = {
        "semantics": ids, "sky": ids == ID["sky"], "dynamic": np.isin(ids, DYNAMIC_IDS),
        "depth": np.nan_to_num(made.depth[0].numpy(), nan=np.inf),
    }  # fmt: skip
    return {name: np.where(changed, rendered[name].astype(old.dtype), old) for name, old in found.items()}


def edited_points(points: SweepPoints, sweep: Sweep, plan: EditPlan) -> SweepPoints:
    """The points of a sweep: those of removed objects are left out, those of moved ones go with their boxes. New objects have none."""
    gone = np.zeros(len(points.xyz), bool)
    xyz = points.xyz.copy()
    for name in {*plan.changes, *plan.removed}:
        actor = plan.before.actors[name]
        old = actor.motion.pose_at(sweep.time_s)
        if old is None:
            continue
        local = geometry.transform_points(geometry.invert(old) @ sweep.world_from_lidar, points.xyz.astype(np.float64))
        half = np.array(actor.size_m) / 2
        inside = (np.abs(local) <= half + BOX_MARGIN_M).all(1) & (local[:, 2] > BOX_MARGIN_M - half[2])
        new = None if name in plan.removed else plan.after.actors[name].motion.pose_at(sweep.time_s)
        if new is None:
            gone |= inside
        else:
            lidar_from_box = geometry.invert(sweep.world_from_lidar) @ new
            xyz[inside] = geometry.transform_points(lidar_from_box, local[inside]).astype(np.float32)
    kept = ~gone
    classes = None if points.classes is None else points.classes[kept]
    return SweepPoints(xyz[kept], points.intensity[kept], points.dt_s[kept], classes)
