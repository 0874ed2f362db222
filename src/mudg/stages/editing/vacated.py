"""Where recorded photographs do not show an edited drive: the boxes of what was removed, moved or put in, and the ground about them.

The ground about a box holds its shadow. The direction of the sun is not known on a recorded log, so as much as the box is high counts on
every side: other photographs show that ground without it.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from mudg.base import geometry, log
from mudg.base.errors import InputError
from mudg.base.types import FusedCloud, Photo, Scene, View
from mudg.core.ground import HeightMap
from mudg.data.clips.condition import ray_directions
from mudg.data.clips.vacated import Vacated, VacatedAt
from mudg.data.edits import EditScript
from mudg.models.scene.edited import GROUND_CLASSES
from mudg.models.scene.model import SceneModel
from mudg.models.scene.uncovered import FLOOR_M, STRAY_M
from mudg.stages.editing.apply import edited_cloud, edited_scene
from mudg.stages.editing.carried import carry_out, opener
from mudg.stages.editing.plan import Actor, Background, EditPlan, EditSources, EditWorld, plan_edits
from mudg.stages.editing.weathered import conditions_of

Box = tuple[NDArray[np.float64], NDArray[np.float64]]
"""Pose world_from_box f64[4, 4] and size f64[3] in metres."""
Boxes = Sequence[Box]
SHADOW_REACH: Final = 1.0
"""Shadows are looked for this far about a box, as a share of its height."""
SLAB_M: Final = 0.1
"""Thickness of the ground about a box that is drawn."""
BOX_GROWTH_M: Final = 0.2
SAME_M: Final = 1e-3
FARTHEST_GROUND_M: Final = 80.0
"""Nothing is known of how the ground goes on farther away."""


@dataclass(frozen=True, slots=True, eq=False)
class DriveOfEdits:
    """A drive as the diffusion model is to see it: what was planned, the edited scene, clouds and fit (None where there is none)."""

    plan: EditPlan
    scene: Scene
    cloud: FusedCloud
    model: SceneModel | None


def drive_of_edits(script: EditScript, scene: Scene, cloud: FusedCloud, model: SceneModel | None, *, told: bool = False) -> DriveOfEdits:
    """Carry out a script on a scene and its clouds, and on its fit where there is one.

    Args:
        told: warn of what the script says and the conditions do not show.

    Raises:
        InputError: something in the script that cannot be done here.
    """
    if told and conditions_of(script.canonical()) is not None:
        log.info("generated views show no weather and light (that takes --fitted and a published-type model); `mudg render` does")
    if model is not None:
        drive = carry_out(script, model, scene, cloud)
        return DriveOfEdits(drive.plan, drive.scene or scene, cleared_cloud(drive.cloud or cloud, drive.plan), drive.model(model))
    xyz = cloud.static.xyz
    xyz = xyz[:0] if cloud.static.semantics is None else xyz[np.isin(cloud.static.semantics, GROUND_CLASSES)]
    world = EditWorld.of_scene(scene, HeightMap.from_points(xyz) if len(xyz) else None)
    plan = plan_edits(script, world, EditSources(opener(script), _no_background))
    return DriveOfEdits(plan, edited_scene(scene, plan), cleared_cloud(edited_cloud(cloud, plan), plan), None)


def _no_background(name: str) -> Background:
    raise InputError("points alone cannot get another background", where="run", got=name, remedy="give a fit (--fitted)")


def photos_of_edited(photos: Iterable[Photo], plan: EditPlan) -> list[Photo]:
    """Recorded photographs with the pixels marked that do not show the edited drive."""
    return [replace(photo, usable=_usable(photo, plan)) for photo in photos]


def _usable(photo: Photo, plan: EditPlan) -> NDArray[np.bool_] | None:
    height, width = photo.rgb.shape[:2]
    view = photo.view if photo.view.camera.width == width else photo.view.resized(width, height)
    touched = [box for when in ("before", "after") for box in touched_boxes(plan, photo.view.time_s, when)]
    covered = _hidden_by(view, touched, plan)
    usable = ~covered if photo.usable is None else photo.usable & ~covered
    return None if usable.all() else usable


def _hidden_by(view: View, boxes: Boxes, plan: EditPlan) -> NDArray[np.bool_]:
    """Bool[H, W]: inside the outlines of boxes or on the ground about them, but not where another moving object stands in front, nor on
    that ground where one stands anywhere."""
    if not boxes:
        return np.zeros((view.camera.height, view.camera.width), bool)
    ahead = lambda box: float((view.cam_from_world @ box[0])[2, 3])  # noqa: E731
    rest, nearest = others(plan, view.time_s), min(map(ahead, boxes))
    covered = boxes_mask(view, boxes) | (ground_mask(view, boxes) & ~boxes_mask(view, rest))
    return covered & ~boxes_mask(view, [box for box in rest if ahead(box) < nearest])


def touched_boxes(plan: EditPlan, time_s: float, when: str) -> list[Box]:
    """Poses world_from_box f64[4, 4] and sizes f64[3] of what a plan removes, moves or puts in, where it is not the same at this time
    `before` and `after` the edits. An object on its recorded place is left out."""
    found = []
    for name in dict.fromkeys((*plan.removed, *plan.changes, *plan.inserted)):
        old, new = (_pose(world.actors.get(name), time_s) for world in (plan.before, plan.after))
        kept = name in plan.changes and name not in plan.inserted
        if kept and old is not None and new is not None and np.abs(old - new).max() < SAME_M:
            continue
        actor, pose = (plan.before.actors.get(name), old) if when == "before" else (plan.after.actors.get(name), new)
        if actor is not None and pose is not None:
            found.append((pose, np.asarray(actor.size_m, np.float64)))
    return found


def vacated_at(plan: EditPlan) -> VacatedAt:
    """Where, in a view of the edited drive, something stood in the recording and stands no more, its shadow included."""

    def found(view: View) -> Vacated:
        before, after = (touched_boxes(plan, view.time_s, when) for when in ("before", "after"))
        shown = boxes_mask(view, after)
        mask = _hidden_by(view, before, plan) & ~shown
        ground = np.full(mask.shape, np.nan, np.float32)
        for pose, size in before:
            depth = _plane_depth(view, pose, size)
            ground = np.where(boxes_mask(view, [(pose, size)]) | ground_mask(view, [(pose, size)]), np.fmin(ground, depth), ground)
        stood = mask & boxes_mask(view, before)
        return Vacated(*(torch.from_numpy(plane) for plane in (mask, ground, shown, stood)))

    return found


def _plane_depth(view: View, pose: NDArray[np.float64], size: NDArray[np.float64]) -> NDArray[np.float32]:
    """Depth f32[H, W] of the plane below a box, NaN where the ray does not meet it within `FARTHEST_GROUND_M`."""
    rays = np.stack([axis.numpy() for axis in ray_directions(view)], -1).astype(np.float64)
    normal, foot = pose[:3, 2], pose[:3, 3] - pose[:3, 2] * size[2] / 2
    falls = rays @ normal
    depth = np.where(falls < -1e-4, (foot - view.center_world) @ normal / np.minimum(falls, -1e-4), np.nan)
    return np.where((depth > 0) & (depth < FARTHEST_GROUND_M), depth, np.nan).astype(np.float32)


def cleared_cloud(cloud: FusedCloud, plan: EditPlan) -> FusedCloud:
    """Edited clouds without what boxes that were too small left behind of removed and moved objects along their recorded paths: static
    points in the grown boxes that are not ground."""
    static = cloud.static
    stray = np.zeros(len(static), bool)
    low_of = np.zeros(len(static), bool) if static.semantics is None else np.isin(static.semantics, GROUND_CLASSES)
    for name in dict.fromkeys((*plan.removed, *plan.changes)):
        actor = plan.before.actors[name]
        for pose in actor.motion.poses if actor.moves else ():
            local = geometry.transform_points(geometry.invert(pose), static.xyz.astype(np.float64))
            half = np.asarray(actor.size_m) / 2
            inside = (np.abs(local[:, :2]) <= half[:2] + STRAY_M).all(1) & (local[:, 2] <= half[2] + STRAY_M)
            stray |= inside & (local[:, 2] > FLOOR_M - half[2])
    kept = ~(stray & ~low_of)
    part = lambda values: None if values is None else values[kept]  # noqa: E731
    return replace(cloud, static=replace(static, xyz=static.xyz[kept], rgb=static.rgb[kept], semantics=part(static.semantics)))


def others(plan: EditPlan, time_s: float) -> list[Box]:
    """Poses and sizes of the moving objects that a plan leaves alone."""
    touched = {*plan.removed, *plan.changes, *plan.inserted}
    found = [(actor, _pose(actor, time_s)) for name, actor in plan.after.actors.items() if name not in touched and actor.moves]
    return [(pose, np.asarray(actor.size_m, np.float64)) for actor, pose in found if pose is not None]


def _pose(actor: Actor | None, time_s: float) -> NDArray[np.float64] | None:
    return None if actor is None else actor.motion.pose_at(time_s)


def boxes_mask(view: View, boxes: Boxes) -> NDArray[np.bool_]:
    """Bool[H, W]: inside the outline of a box, grown a little."""
    return outlines(view, [(pose, size + BOX_GROWTH_M) for pose, size in boxes])


def ground_mask(view: View, boxes: Boxes, reach: float = SHADOW_REACH) -> NDArray[np.bool_]:
    """Bool[H, W]: ground below and about a box, as far as `reach` times its height, where its shadow may lie; what stands there is not
    told apart."""
    slabs = []
    for pose, size in boxes:
        about_m = 2 * reach * size[2]
        flat = pose @ geometry.yaw_matrix(0.0, (0.0, 0.0, -size[2] / 2))
        slabs.append((flat, np.array([size[0] + about_m, size[1] + about_m, SLAB_M])))
    return outlines(view, slabs)


def outlines(view: View, boxes: Boxes) -> NDArray[np.bool_]:
    """Bool[H, W]: inside the outline of a box."""
    covered = np.zeros((view.camera.height, view.camera.width), bool)
    for pose, size in boxes:
        hull = geometry.box_hull(view, pose, size)  # of what lies ahead: a box beside the camera does not cover the whole image
        if hull is not None:
            canvas = Image.new("1", (view.camera.width, view.camera.height))
            outline = [(float(x), float(y)) for x, y in hull.points[hull.vertices] - 0.5]
            ImageDraw.Draw(canvas).polygon(outline, fill=1, outline=1)
            covered |= np.array(canvas, bool)
    return covered
