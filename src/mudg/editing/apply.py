"""A plan carried out: on a fitted scene, on fused clouds, on what a scene says of boxes and of the vehicle."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image

from mudg.base import geometry, log, store
from mudg.base.errors import InputError, UsageError
from mudg.base.types import EgoPath, FusedCloud, PointCloud, Scene, Track, View
from mudg.core.edit import HeightMap, Motion
from mudg.editing import model as edited
from mudg.editing.model import Asset
from mudg.editing.plan import Actor, Background, EditPlan
from mudg.editing.street import MOST_VIEWS, Hidden, noted, with_closed_sides, without_traces
from mudg.gaussians.model import SceneModel
from mudg.gaussians.nodes import RigidNode
from mudg.gaussians.rendering import raster_of
from mudg.gaussians.sky import SkyNode
from mudg.gaussians.start import SH_C0
from mudg.scene.read import decode_image

EGO_FACT: Final = "edited_ego"
"""Fact of a fitted scene that was edited by itself: the vehicle's path, keys as rows [time, 16 numbers of the pose]."""
CUT_SHADOW: Final = 0.6
"""Strength of the contact shadow of what was cut out of the background."""
SIDE_VIEWS: Final = 16
"""Views that say which sides of objects the recording did not show, at most."""
MOST_NAMED: Final = 4
"""More objects than these are counted in a message."""


StreetOf = Callable[[SceneModel, EditPlan], SceneModel]
"""Makes of a fitted scene the one that objects have left: ``street_left``, or something that remembers its results."""


def street_left(model: SceneModel, plan: EditPlan, *, close: bool = True) -> SceneModel:
    """A fitted scene without the objects that a plan removes, with objects of their own for standing ones that it
    moves, and, unless told not to `close` anything, without the traces of those behind which the street is closed and
    with all sides of those that are moved. Depends on `left_behind` alone."""
    without_nodes, removed, closed, sides = left_behind(model, plan)
    model = _cut_out(model, without_nodes, plan)
    removed = tuple(name for name in removed if name in model.node_names())
    model = model.without_nodes([name for name in removed if not (close and name in closed)])
    if closed and close:
        hidden, views = {name: hidden_by(plan.before.actors[name], plan.views) for name in closed}, spread(plan.views)
        log.info(f"edit: the street behind {_some(closed)} is closed from {len(views)} recorded views (close_street)")
        model = noted(model, views, raster_of(model)).without_nodes([name for name in removed if name in closed])
        model = without_traces(model, hidden, views, raster_of(model))
    sides = tuple(name for name in sides if close and name in model.node_names())
    if sides:
        model = with_closed_sides(
            model, sides, views_of([plan.before.actors[name] for name in sides], plan.views), raster_of(model)
        )
    return model


def left_behind(model: SceneModel, plan: EditPlan) -> tuple[tuple[str, ...], ...]:
    """Ids of what a plan cuts out of the background, of what it removes, of those behind which the street is closed,
    and of those whose sides are closed."""
    without_nodes = sorted({*plan.changes, *plan.removed} - set(model.node_names()))
    sides = sorted(plan.sides & set(plan.before.actors)) if plan.views else []
    closed = sorted(plan.closed & set(plan.before.actors)) if plan.views else []
    if plan.background is not None:  # it is gone with the street
        without_nodes, closed = [], []
    return tuple(without_nodes), tuple(plan.removed), tuple(closed), tuple(sides)


def _some(names: Sequence[str]) -> str:
    return ", ".join(names) if len(names) <= MOST_NAMED else f"{len(names)} objects"


def edited_model(
    model: SceneModel, plan: EditPlan, sky: Path | None = None, street_of: StreetOf = street_left
) -> SceneModel:
    """A fitted scene with a plan carried out.

    Args:
        sky: panorama of the plan's ``sky``. street_of: makes the street that objects left, or remembers it.
    """
    model = street_of(model, plan)
    if plan.background is not None:
        other, pose = plan.background
        model = edited.with_background(model, other.model, pose)
        if plan.objects_gain is not None:
            model = edited.with_relit_objects(model, plan.objects_gain)
    kept = {node.name: node for node in model.nodes if isinstance(node, RigidNode)}
    changed = {name: plan.changed(name, edited.motion_of(kept[name])) for name in plan.changes if name in kept}
    model = edited.with_motions(model, changed)
    for name, insertion in plan.inserted.items():
        actor = plan.after.actors[name]
        model = edited.with_asset(model, insertion.asset, name, actor.motion, actor.label)
        if insertion.shadow > 0:
            model = edited.with_shadow(model, name, insertion.shadow, insertion.sun)
    if sky is not None and plan.sky is not None:
        model = replace(model, sky=panorama(sky, plan.sky.yaw_deg, model))
    model.sort_rows()
    return model


def spread(views: Sequence[View], most: int = MOST_VIEWS) -> list[View]:
    """At most so many of some views, evenly."""
    which = np.unique(np.linspace(0, len(views) - 1, min(most, len(views))).round().astype(int))
    return [views[int(index)] for index in which] if views else []


def views_of(actors: Sequence[Actor], views: Sequence[View]) -> list[View]:
    """Views in whose image the middle of one of some actors lies, at most `SIDE_VIEWS`."""
    found = []
    for view in views:
        poses = [pose for actor in actors if (pose := actor.motion.pose_at(view.time_s)) is not None]
        if poses:
            uv, depth = geometry.project(view, np.stack(poses)[:, :3, 3])
            inside = (depth > 0) & (uv >= 0).all(1) & (uv <= [view.camera.width, view.camera.height]).all(1)
            found += [view] if inside.any() else []
    return spread(found, SIDE_VIEWS)


def hidden_by(actor: Actor, views: Sequence[View]) -> Hidden:
    """An object and the views at whose times it is there, at most `MOST_VIEWS`."""
    there = sorted(
        (view for view in views if actor.motion.pose_at(view.time_s) is not None), key=lambda view: view.time_s
    )
    return Hidden(actor.size_m, actor.motion, actor.moves, tuple(spread(there)))


def _cut_out(model: SceneModel, names: Sequence[str], plan: EditPlan) -> SceneModel:
    """A copy with objects of their own for what stands in boxes. What the fit does not show is named, if it is only to
    be removed.

    Raises:
        UsageError: an object that is to be moved does not show in the fit.
    """
    missing: dict[str, str] = {}
    for name in names:
        actor = plan.before.actors[name]
        try:
            if actor.moves:
                raise UsageError(
                    "this object has no Gaussians of its own in the fit: the recording hardly saw it",
                    where=f"track {name!r}",
                    remedy="leave it out of the script",
                )
            cut = edited.cut_out(model, _track(name, actor))
        except UsageError as problem:
            if name not in plan.removed:
                raise
            missing[name] = problem.what
            continue
        model = cut if name in plan.removed else edited.with_shadow(cut, name, CUT_SHADOW)
    if missing:
        why = (
            next(iter(missing.values()))
            if len(missing) == 1
            else "they have no Gaussians of their own, and none are in their boxes"
        )
        log.info(f"edit: {_some(list(missing))}: not in the fit: {why}")
    return model


def panorama(path: Path, yaw_deg: float, model: SceneModel) -> SkyNode:
    """A sky from an image of all directions: longitude across, growing to the right as one looks at it; zenith in the
    top row."""
    rows = 256 if model.sky is None else model.sky.rows
    rgb = decode_image(store.read_bytes(path), str(path))
    height, width = rgb.shape[:2]
    if width != 2 * height:
        raise InputError(
            "a panorama of the sky is twice as wide as it is high", where=str(path), got=f"{width}x{height}"
        )
    small = np.asarray(Image.fromarray(rgb).resize((2 * rows, rows), Image.Resampling.BOX), np.float32) / 255
    turned = np.roll(small[:, ::-1], round(yaw_deg / 360 * 2 * rows), axis=1)  # columns of ``SkyNode`` grow to the left
    sky = SkyNode.uniform(rows)
    sky.table.columns["panorama"].detach().copy_(torch.from_numpy(turned.transpose(2, 0, 1).copy())[None])
    return sky.to(model.device)


# -- clouds ----------------------------------------------------------------------------------------


def edited_cloud(cloud: FusedCloud, plan: EditPlan) -> FusedCloud:
    """Fused clouds with a plan carried out; moved objects need no other points, for these lie in the frame of their
    box."""
    static, objects = cloud.static, dict(cloud.objects)
    standing = {name for name in (*plan.changes, *plan.removed) if not plan.before.actors[name].moves}
    for name in sorted(standing - set(objects)):
        static, objects[name] = _cut_points(static, _track(name, plan.before.actors[name]))
    objects = {name: points for name, points in objects.items() if name not in plan.removed}
    if plan.background is not None:
        static = _other_street(*plan.background)
        objects = {
            name: _relit_points(points, plan.objects_gain) for name, points in objects.items() if name not in standing
        }
    objects |= {name: asset_points(insertion.asset) for name, insertion in plan.inserted.items()}
    return FusedCloud(static, objects, cloud.colors)


def _other_street(other: Background, world_from_other: NDArray[np.float64]) -> PointCloud:
    """The static points of another run at their place in this one.

    Raises:
        UsageError: it has none.
    """
    if other.points is None:
        raise UsageError("the other run has no fused points", remedy="name a folder made by `mudg run`")
    xyz = geometry.transform_points(world_from_other, other.points.xyz.astype(np.float64))
    return replace(other.points, xyz=xyz.astype(np.float32))


def _relit_points(points: PointCloud, gain: NDArray[np.float64] | None) -> PointCloud:
    if gain is None:
        return points
    shown = edited.display_of(edited.linear_of(points.rgb / 255) * gain)
    return replace(points, rgb=np.rint(shown.clip(0, 1) * 255).astype(np.uint8))


def _cut_points(static: PointCloud, track: Track) -> tuple[PointCloud, PointCloud]:
    """The static cloud without what stands in a box, and that, in the frame of the box."""
    pose = track.world_from_object[len(track.times_s) // 2]
    local = geometry.transform_points(geometry.invert(pose), static.xyz.astype(np.float64))
    half = track.size_m / 2 + edited.CUT_MARGIN_M
    inside = (np.abs(local[:, :2]) <= half[:2]).all(1) & (np.abs(local[:, 2]) <= half[2])
    low = local[:, 2] < -track.size_m[2] / 2 + edited.CUT_FLOOR_M
    ground = low if static.semantics is None else np.isin(static.semantics, edited.GROUND_CLASSES)
    inside &= ~ground

    def part(rows: NDArray[np.bool_], xyz: NDArray[np.float32], frame: Any) -> PointCloud:
        return PointCloud(
            xyz[rows], static.rgb[rows], frame, None if static.semantics is None else static.semantics[rows]
        )

    return part(~inside, static.xyz, "world"), part(inside, local.astype(np.float32), "object")


def asset_points(asset: Asset) -> PointCloud:
    """The solid Gaussians of an asset as coloured points."""
    solid = torch.sigmoid(asset.columns["logits"]).numpy() > edited.SOLID_OPACITY
    rgb = (0.5 + SH_C0 * asset.columns["sh_dc"].numpy()[:, 0]).clip(0, 1)
    ids = np.where(asset.class_ids < 0, 255, asset.class_ids).astype(np.uint8)
    return PointCloud(
        asset.columns["means"].numpy()[solid], (rgb[solid] * 255 + 0.5).astype(np.uint8), "object", ids[solid]
    )


def ground_of(cloud: FusedCloud | None, model: SceneModel) -> HeightMap | None:
    """Height map of the ground: of the fused points of ground classes, else of the fitted Gaussians; None where there
    are neither."""
    xyz = np.zeros((0, 3), np.float32)
    if cloud is not None and cloud.static.semantics is not None:
        xyz = cloud.static.xyz[np.isin(cloud.static.semantics, edited.GROUND_CLASSES)]
    xyz = edited.ground_points(model) if not len(xyz) else xyz
    return HeightMap.from_points(xyz) if len(xyz) else None


# -- what a scene says -----------------------------------------------------------------------------


def edited_scene(scene: Scene, plan: EditPlan) -> Scene:
    """A scene with other boxes, another path of the vehicle and other poses of its frames; its files stay what they
    are."""
    tracks = tuple(_track(name, actor) for name, actor in plan.after.actors.items())
    given = {track.id: track for track in scene.tracks}
    tracks = tuple(given[t.id] if t.id in given and t.id not in {*plan.changes, *plan.inserted} else t for t in tracks)
    scene = replace(scene, tracks=tracks)
    if not plan.moves_ego or plan.after.ego is None:
        return scene
    return with_ego(scene, plan.after.ego)


def with_ego(scene: Scene, ego: Motion) -> Scene:
    """A scene whose vehicle drives another path; every camera goes with it."""
    frames = tuple(replace(frame, view=_carried(frame.view, scene.ego, ego)) for frame in scene.frames)
    return replace(scene, ego=EgoPath(ego.times_s, ego.poses), frames=frames)


def _carried(view: View, before: EgoPath, after: Motion) -> View:
    """A view from the same place of the vehicle, on its new path; before its first and after its last key the vehicle
    stands there."""
    time_s = float(np.clip(view.time_s, before.times_s[0], before.times_s[-1]))
    old, new = before.pose_at(time_s), after.pose_at(float(np.clip(time_s, after.times_s[0], after.times_s[-1])))
    if old is None or new is None:
        raise InputError(
            "the vehicle has no pose at the time of a frame", where=f"camera {view.camera.name}", got=f"{view.time_s} s"
        )
    return View(view.camera, new @ geometry.invert(old) @ view.world_from_cam, view.time_s)


def ego_fact(ego: Motion) -> list[list[float]]:
    """A path as JSON values."""
    return np.column_stack([ego.times_s, ego.poses.reshape(-1, 16)]).tolist()


def scene_seen_by(scene: Scene, facts: Mapping[str, Any]) -> Scene:
    """The scene on the vehicle's path that an edited fit asks for; itself if it asks for none."""
    if EGO_FACT not in facts:
        return scene
    rows = np.asarray(facts[EGO_FACT], np.float64)
    return with_ego(scene, Motion.recorded(rows[:, 0], rows[:, 1:].reshape(-1, 4, 4)))


def _track(name: str, actor: Actor) -> Track:
    return Track(name, actor.label, np.array(actor.size_m), actor.motion.times_s, actor.motion.poses)
