"""A script carried out: on a fitted scene, on fused clouds, on what a scene says of boxes and of the vehicle; with the
objects, the light and the weather that it brings.

An object of a fitted scene is a file of its own, one safetensors file with the description as JSON in its header:

    means f32[n, 3]  quats f32[n, 4]  log_scales f32[n, 3]  logits f32[n]  sh_dc f32[n, 1, 3]   raw, in the frame of the
    box; class_ids u8[n] (255 = unknown)   certainty f16[n], if it is known
    header "mudg_asset": {schema, label, size_m, light_rgb, seen_deg, origin}"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path
from typing import Annotated, Any, Final, Literal, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image
from pydantic import Field
from scipy.spatial import KDTree

from mudg.base import geometry, log, store
from mudg.base.errors import InputError, UsageError
from mudg.base.palette import CLASSES, UNLABELLED
from mudg.base.processes import one_torch_thread
from mudg.base.records import Number, StrictRecord, parse_record
from mudg.base.run_folder import ResultFile
from mudg.base.types import EgoPath, FusedCloud, Observation, PointCloud, Scene, Track, View
from mudg.base.weather_settings import Conditions
from mudg.core import trajectory
from mudg.core.edit import HeightMap, Motion
from mudg.core.fusion import points_in_box
from mudg.core.weather import ShownView, drive_facts, edited_view
from mudg.diffusion.condition import InWeather
from mudg.editing import model as edited
from mudg.editing import plan as plans
from mudg.editing.model import GROUND_CLASSES, Asset, linear_of
from mudg.editing.plan import Actor, EditPlan, EditWorld
from mudg.editing.runs import RunParts, find_run
from mudg.editing.script import EditScript, conditions_of
from mudg.gaussians.model import SceneModel
from mudg.gaussians.nodes import RigidNode, SkyNode
from mudg.gaussians.rendering import raster_of, render_view
from mudg.gaussians.start import SH_C0
from mudg.gaussians.storage import load_model
from mudg.gaussians.views import resized_view
from mudg.scene.read import decode_image, read_scene

EGO_FACT: Final = "edited_ego"
"""Fact of a fitted scene that was edited by itself: the vehicle's path, keys as rows [time, 16 numbers of the pose]."""
CUT_SHADOW: Final = 0.6
"""Strength of the contact shadow of what was cut out of the background."""
SIDE_VIEWS: Final = 16
"""Views that say which sides of objects the recording did not show, at most."""
MOST_NAMED: Final = 4
"""More objects than these are counted in a message."""
Thing = TypeVar("Thing")


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
        model = edited.noted(model, views).without_nodes([name for name in removed if name in closed])
        model = edited.without_traces(model, hidden, views)
    sides = tuple(name for name in sides if close and name in model.node_names())
    if sides:
        seen_from = views_of([plan.before.actors[name] for name in sides], plan.views)
        model = edited.with_closed_sides(model, sides, seen_from)
    return model


def left_behind(model: SceneModel, plan: EditPlan) -> tuple[tuple[str, ...], ...]:
    """Ids of what a plan cuts out of the background, of what it removes, of those behind which the street is closed,
    and of those whose sides are closed."""
    without_nodes = sorted({*plan.changes, *plan.removed} - set(model.node_names()))
    closed = sorted(plan.closed & set(plan.before.actors)) if plan.views else []
    return tuple(without_nodes), tuple(plan.removed), tuple(closed), tuple(sorted(plan.sides))


def _some(names: Sequence[str]) -> str:
    return ", ".join(names) if len(names) <= MOST_NAMED else f"{len(names)} objects"


def edited_model(
    model: SceneModel, plan: EditPlan, sky: Path | None = None, street: SceneModel | None = None
) -> SceneModel:
    """A fitted scene with a plan carried out. ``sky``: panorama of the plan's ``sky``. ``street``: what ``street_left``
    made of the scene before."""
    model = street_left(model, plan) if street is None else street
    nodes = list(model.nodes)
    for index, node in enumerate(nodes):
        if isinstance(node, RigidNode) and node.name in plan.changes:
            nodes[index] = edited.node_along(node, plan.changed(node.name, edited.motion_of(node)))
    model = replace(model, nodes=tuple(nodes), facts=dict(model.facts))
    for name, insertion in plan.inserted.items():
        actor = plan.after.actors[name]
        model = edited.with_asset(model, insertion.asset, name, actor.motion, actor.label)
        if insertion.shadow > 0:
            model = edited.with_shadow(model, name, insertion.shadow)
    if sky is not None and plan.sky is not None:
        model = replace(model, sky=_panorama(sky, plan.sky.yaw_deg, model))
    if plan.erased:
        gone = edited.still_rows(model)
        gone[gone] = _erased(plan, model.table["means"].detach().cpu().numpy()[gone])
        model = edited.without_rows(model, gone)
    model.sort_rows()
    return model


def _erased(plan: EditPlan, xyz: NDArray[np.floating]) -> NDArray[np.bool_]:
    """Which points f[N, 3] of the street the plan takes away."""
    places, gone = np.asarray(xyz, np.float64), np.zeros(len(xyz), bool)
    if balls := [ball for edit in plan.erased for ball in edit.balls or ()]:
        centers, radii = np.split(np.array(balls), [3], axis=1)
        gone[list(set(chain.from_iterable(KDTree(places).query_ball_point(centers, radii[:, 0]))))] = True
    for box in (edit.keep for edit in plan.erased if edit.keep is not None):
        world_from_box = geometry.yaw_matrix(math.radians(box.yaw_deg), box.center)
        local = geometry.transform_points(geometry.invert(world_from_box), places)
        gone |= (np.abs(local) > np.array(box.size_m) / 2).any(1)
    return gone


def spread(things: Sequence[Thing], most: int = edited.MOST_VIEWS) -> list[Thing]:
    """At most so many of some things, evenly."""
    which = np.unique(np.linspace(0, len(things) - 1, min(most, len(things))).round().astype(int))
    return [things[int(index)] for index in which] if things else []


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


def hidden_by(actor: Actor, views: Sequence[View]) -> edited.Hidden:
    """An object and the views at whose times it is there, at most `MOST_VIEWS`."""
    there = [view for view in views if actor.motion.pose_at(view.time_s) is not None]
    there.sort(key=lambda view: view.time_s)
    return edited.Hidden(actor.size_m, actor.motion, actor.moves, tuple(spread(there)))


def _cut_out(model: SceneModel, names: Sequence[str], plan: EditPlan) -> SceneModel:
    """A copy with objects of their own for what stands in boxes. What the fit does not show is named, if it is only to
    be removed. UsageError: an object that is to be moved does not show in the fit."""
    missing: dict[str, str] = {}
    for name in names:
        actor = plan.before.actors[name]
        try:
            if actor.moves:
                what = "this object has no Gaussians of its own in the fit: the recording hardly saw it"
                raise UsageError(what, where=f"track {name!r}", remedy="leave it out of the script")
            cut = edited.cut_out(model, _track(name, actor))
        except UsageError as problem:
            if name not in plan.removed:
                raise
            missing[name] = problem.what
            continue
        model = cut if name in plan.removed else edited.with_shadow(cut, name, CUT_SHADOW)
    if missing:
        each = "they have no Gaussians of their own, and none are in their boxes"
        why = next(iter(missing.values())) if len(missing) == 1 else each
        log.info(f"edit: {_some(list(missing))}: not in the fit: {why}")
    return model


def _panorama(path: Path, yaw_deg: float, model: SceneModel) -> SkyNode:
    """A sky from an image of all directions: longitude across, growing to the right as one looks at it; zenith in the
    top row."""
    rows = 256 if model.sky is None else model.sky.rows
    rgb = decode_image(store.read_bytes(path), str(path))
    height, width = rgb.shape[:2]
    if width != 2 * height:
        what, got = "a panorama of the sky is twice as wide as it is high", f"{width}x{height}"
        raise InputError(what, where=str(path), got=got)
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
    objects |= {name: asset_points(insertion.asset) for name, insertion in plan.inserted.items()}
    if plan.erased:
        static = some_points(static, ~_erased(plan, static.xyz))
    return FusedCloud(static, objects, cloud.colors)


def some_points(points: PointCloud, rows: NDArray[np.bool_]) -> PointCloud:
    """Those of a cloud's points that a mask bool[N] chooses."""
    ids = None if points.semantics is None else points.semantics[rows]
    return PointCloud(points.xyz[rows], points.rgb[rows], points.frame, ids)


def _cut_points(static: PointCloud, track: Track) -> tuple[PointCloud, PointCloud]:
    """The static cloud without what stands in a box, and that, in the frame of the box."""
    pose = track.world_from_object[len(track.times_s) // 2]
    local = geometry.transform_points(geometry.invert(pose), static.xyz.astype(np.float64))
    low = local[:, 2] < -track.size_m[2] / 2 + edited.CUT_FLOOR_M
    ground = low if static.semantics is None else np.isin(static.semantics, GROUND_CLASSES)
    inside = points_in_box(local, track.size_m, edited.CUT_MARGIN_M, -edited.CUT_MARGIN_M) & ~ground
    own = some_points(replace(static, xyz=local.astype(np.float32), frame="object"), inside)
    return some_points(static, ~inside), own


def asset_points(asset: Asset) -> PointCloud:
    """The solid Gaussians of an asset as coloured points."""
    solid = torch.sigmoid(asset.columns["logits"]).numpy() > edited.SOLID_OPACITY
    rgb = (0.5 + SH_C0 * asset.columns["sh_dc"].numpy()[:, 0]).clip(0, 1)
    ids = np.where(asset.class_ids < 0, 255, asset.class_ids).astype(np.uint8)
    shown = (rgb[solid] * 255 + 0.5).astype(np.uint8)
    return PointCloud(asset.columns["means"].numpy()[solid], shown, "object", ids[solid])


def ground_of(cloud: FusedCloud | None, model: SceneModel | None) -> HeightMap | None:
    """Height map of the ground: of the fused points of ground classes, else of the fitted Gaussians; None where there
    are neither."""
    xyz = np.zeros((0, 3), np.float32)
    if cloud is not None and cloud.static.semantics is not None:
        xyz = cloud.static.xyz[np.isin(cloud.static.semantics, GROUND_CLASSES)]
    xyz = edited.ground_points(model) if model is not None and not len(xyz) else xyz
    return HeightMap.from_points(xyz) if len(xyz) else None


# -- what a scene says -----------------------------------------------------------------------------


def edited_scene(scene: Scene, plan: EditPlan) -> Scene:
    """A scene with other boxes, another path of the vehicle and other poses of its frames; its files stay what they
    are."""
    same = {track.id: track for track in scene.tracks if track.id not in {*plan.changes, *plan.inserted}}
    actors = plan.after.actors.items()
    scene = replace(scene, tracks=tuple(same[name] if name in same else _track(name, one) for name, one in actors))
    return scene if not plan.moves_ego or plan.after.ego is None else with_ego(scene, plan.after.ego)


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
        what, where = "the vehicle has no pose at the time of a frame", f"camera {view.camera.name}"
        raise InputError(what, where=where, got=f"{view.time_s} s")
    return View(view.camera, new @ geometry.invert(old) @ view.world_from_cam, view.time_s)


def scene_seen_by(scene: Scene, facts: Mapping[str, Any]) -> Scene:
    """The scene on the vehicle's path that an edited fit asks for; itself if it asks for none."""
    if EGO_FACT not in facts:
        return scene
    rows = np.asarray(facts[EGO_FACT], np.float64)
    return with_ego(scene, Motion.recorded(rows[:, 0], rows[:, 1:].reshape(-1, 4, 4)))


def _track(name: str, actor: Actor) -> Track:
    return Track(name, actor.label, np.array(actor.size_m), actor.motion.times_s, actor.motion.poses)


# -- a script carried out ---------------------------------------------------------------------------

FACT = "edits"
"""Fact of an edited fitted scene: the script, its digest, and what its checks found."""


@dataclass(frozen=True, slots=True, eq=False)
class EditedDrive:
    """What a script made of a drive. ``plan``: what was done. ``scene``, ``cloud``: edited; None where they were not
    given. ``notes``: what the reader should know, each with ``kind``, ids, numbers and a sentence ``text``."""

    script: EditScript
    plan: EditPlan
    scene: Scene | None
    cloud: FusedCloud | None
    notes: list[dict[str, Any]]

    def model(self, model: SceneModel, keep_ego: bool = False, street: SceneModel | None = None) -> SceneModel:
        """A fitted scene of this drive, edited. ``keep_ego``: note the vehicle's new path in the scene's facts, for
        those who know the recorded path alone. ``street``: what ``street_left`` made of it before."""
        sky = None if self.plan.sky is None else self.script.path_of(self.plan.sky.image)
        made = edited_model(model, self.plan, sky, street)
        facts = {**made.facts, FACT: {"script": self.script.canonical(), "notes": self.notes}}
        if keep_ego and self.plan.moves_ego and self.plan.after.ego is not None:
            ego = self.plan.after.ego
            facts[EGO_FACT] = np.column_stack([ego.times_s, ego.poses.reshape(-1, 16)]).tolist()
        return replace(made, facts=facts)


def carry_out(
    script: EditScript, model: SceneModel | None, scene: Scene | None = None, cloud: FusedCloud | None = None
) -> EditedDrive:
    """Carry out a script on a drive, but for its fitted scenes (``EditedDrive.model``). ``model``: a fit of the drive:
    its objects are those that a script can name where there is no scene; its ground where there is no cloud. None: only
    scene and cloud are wanted. InputError: something in the script that cannot be done here."""
    if model is not None and conditions_of(script.canonical()) is not None and not model.classes:
        what = "weather and light need the classes of surfaces, and this scene was fitted without"
        remedy = "fit a scene with labels (`mudg annotate` makes them), or take them out of the script"
        raise InputError(what, where="weather, light", remedy=remedy)
    ground = ground_of(cloud, model)
    world = EditWorld.of_model(model, ground) if scene is None else EditWorld.of_scene(scene, ground)
    closes = scene is not None and scene.source.recipe is None  # a city has exact pictures of what an object hid
    from_run = lambda source: asset_from(find_run(script.path_of(source.run)), source.id)
    asset = lambda source: from_run(source) if source.file is None else read_asset(script.path_of(source.file))
    plan = plans.plan_edits(script, world, asset, closes)
    plan.views = () if scene is None else tuple(frame.view for frame in scene.frames)
    if model is not None:
        take_light(plan, model)
    if scene is None and plan.closed:
        names, why = sorted(plan.closed), "what recorded views show of it is not known (give --scene)"
        text = f"the street behind {', '.join(names)} stays as it was fitted: {why}"
        plan.notes.append({"kind": "street not closed", "ids": names, "text": text})
    made = None if scene is None else edited_scene(scene, plan)
    views = tuple([frame.view for frame in s.frames] if s else [] for s in (scene, made))
    seldom, plan.sides = plans.shown_sides(plan, *views)
    notes = [*plan.notes, *plans.collisions(plan), *seldom]
    for note in notes:
        log.warn(f"edit: {note['text']}")
    return EditedDrive(script, plan, made, None if cloud is None else edited_cloud(cloud, plan), notes)


# -- objects as files --------------------------------------------------------------------------------

HEADER: Final = "mudg_asset"
_SHAPES: Final = {"means": (3,), "quats": (4,), "log_scales": (3,), "logits": (), "sh_dc": (1, 3)}
Size = Annotated[float, Field(gt=0, allow_inf_nan=False)]


class AssetHeader(StrictRecord):
    """Description of an asset file."""

    schema_: Literal[2] = Field(alias="schema")
    label: str
    size_m: Annotated[list[Size], Field(min_length=3, max_length=3)]
    light_rgb: Annotated[list[Number], Field(min_length=3, max_length=3)] | None
    seen_deg: list[Number]
    origin: str


def write_asset_from(parts: RunParts, name: str, file: ResultFile) -> dict[str, Any]:
    """Write one object of a fit, or of a run, to a file; returns what it is. UsageError where there is no such
    object."""
    asset = asset_from(parts, name)
    write_asset(file.path, asset)
    log.info(f"asset: {name} ({asset.label}, {len(asset)} Gaussians, seen from {len(asset.seen_rad)} directions)")
    return {"id": name}


def asset_from(parts: RunParts, name: str) -> Asset:
    """An object of a run, with the sides from which its scene shows it; those that it never shows are closed."""
    model = load_model(parts.model)
    if parts.scene is None:
        return edited.asset_of(model, name)
    recorded = read_scene(parts.scene)
    return complete_asset(model, name, [frame.view for frame in recorded.frames])


@one_torch_thread()
def complete_asset(model: SceneModel, name: str, views: Sequence[View]) -> Asset:
    """An object of a fitted scene, with the sides from which views show it; the others are closed
    (``editing/model.py``)."""
    node = model.dynamic_object(name)
    actor = Actor(node.label, (node.size_m[0], node.size_m[1], node.size_m[2]), edited.motion_of(node))
    closed = edited.with_closed_sides(model, [name], views_of([actor], views))
    return edited.asset_of(closed, name, plans.sides_seen(actor, views).tolist(), light_rgb=surface_light(model, views))


def write_asset(path: Path, asset: Asset) -> None:
    """Write an asset file."""
    arrays = {key: asset.columns[key].numpy() for key in _SHAPES}
    arrays["class_ids"] = np.where(asset.class_ids < 0, UNLABELLED, asset.class_ids).astype(np.uint8)
    if asset.certainty is not None:
        arrays["certainty"] = asset.certainty.astype(np.float16)
    header = {
        "schema": 2,
        "label": asset.label,
        "size_m": list(asset.size_m),
        "origin": asset.origin,
        "light_rgb": None if asset.light_rgb is None else asset.light_rgb.tolist(),
        "seen_deg": [round(float(np.degrees(a)), 2) for a in asset.seen_rad],
    }
    store.write_safetensors(path, arrays, {HEADER: store.json_text(header, indent=None)})


def read_asset(path: Path) -> Asset:
    """Read an asset file. InputError: it is missing, damaged, or no asset."""
    content = store.read_bytes(path)
    arrays = store.parse_safetensors(content, str(path))
    text = store.safetensors_metadata(content, str(path)).get(HEADER)
    if text is None:
        raise InputError("this file is no asset", where=str(path), expected="a file written by `mudg asset export`")
    facts = store.parse_json(text, f"{path}: header")
    header = parse_record(AssetHeader, facts, f"{path}: header: ")
    count = len(arrays["means"]) if "means" in arrays else 0
    wanted = {**{key: (count, *shape) for key, shape in _SHAPES.items()}, "class_ids": (count,)}
    for name, shape in wanted.items():
        kind = np.uint8 if name == "class_ids" else np.float32
        if name not in arrays or arrays[name].shape != shape or arrays[name].dtype != kind or not count:
            got = f"{arrays[name].dtype} {arrays[name].shape}" if name in arrays else "nothing"
            what, expected = f"tensor {name!r} of an asset has the wrong form", f"{kind.__name__} {shape}"
            raise InputError(what, where=str(path), expected=expected, got=got)
        if not np.isfinite(arrays[name]).all():
            raise InputError(f"tensor {name!r} of an asset holds values that are not finite", where=str(path))
    ids, known = arrays["class_ids"].astype(np.int64), arrays.get("certainty")
    length, width, height = header.size_m
    return Asset(
        {key: torch.from_numpy(arrays[key].copy()) for key in _SHAPES},
        np.where(ids < len(CLASSES), ids, -1),
        None if known is None or known.shape != (count,) else known.astype(np.float32),
        header.label,
        (length, width, height),
        None if header.light_rgb is None else np.array(header.light_rgb, np.float64),
        tuple(float(a) for a in np.radians(header.seen_deg)),
        header.origin,
    )


# -- light of the street -----------------------------------------------------------------------------

LIGHT_VIEWS: Final = 8
LIGHT_WIDTH_PX: Final = 160


def surface_light(model: SceneModel, views: Sequence[View]) -> NDArray[np.float64] | None:
    """Mean light f64[3] of the surfaces that a fitted scene shows, linear: of all pixels but sky, in some recorded
    views, drawn small. None without views, or where they show nothing."""
    total, count = np.zeros(3), 0
    for view in spread(views, LIGHT_VIEWS):
        small = resized_view(view, min(LIGHT_WIDTH_PX, view.camera.width))
        seen = render_view(model, small, raster_of(model))
        if seen.depth is not None:
            surface = seen.rgb[:, seen.depth[0] > 0].numpy().astype(np.float64)
            total, count = total + linear_of(surface).sum(1), count + surface.shape[1]
    return total / count if count else None


def take_light(plan: EditPlan, model: SceneModel) -> None:
    """Give a plan's new objects the light of the street. ``plan``: with the views of the recording. ``model``: the
    fitted scene to be edited."""
    wanting = [name for name, insertion in plan.inserted.items() if insertion.match_light]
    here = surface_light(model, plan.views) if wanting else None
    unknown = []
    for name in wanting:
        asset = plan.inserted[name].asset
        unknown += [name] if here is None or asset.light_rgb is None else []
        plan.inserted[name] = replace(plan.inserted[name], asset=edited.matched_light(asset, here), match_light=False)
    if unknown:
        why = "for the light of one of the two streets is not known"
        how = "it takes recorded views: give --scene; export assets with --scene"
        text = f"{', '.join(unknown)}: the colours stay as they were recorded, {why} ({how})"
        plan.notes.append({"kind": "light not matched", "ids": unknown, "text": text})


# -- weather and light of other times --------------------------------------------------------------

WITNESSES: Final = 8
"""Recorded views by which the light of a drive is estimated, spread over cameras and time."""
SEED: Final = 0
"""Drops and flakes are functions of place, time and this seed: the same in every render of a drive."""
Drawer = Callable[[View], Observation]


def drawer(model: SceneModel) -> Drawer:
    """What draws views of a fitted scene."""
    return functools.partial(render_view, model, raster=raster_of(model))


def weather_of(draw: Drawer, conditions: Conditions, scene: Scene) -> InWeather:
    """Weather for all views of a drive, with its light and ground. ``draw``: the views as they are, with depth and
    classes. ``scene``: its recorded views tell the light of the drive, its path how fast the cameras are. InputError:
    views without depth or classes."""
    views = sorted((frame.view for frame in scene.frames), key=lambda view: (view.time_s, view.camera.name))
    witnesses = [_shown(draw(view)) for view in spread(views, WITNESSES)]
    return InWeather(conditions, drive_facts(witnesses), SEED, functools.partial(trajectory.velocity, scene.ego))


def in_weather(draw: Drawer, how: InWeather) -> Drawer:
    """What draws a view with the colours of other weather or light; depth, classes and confidence stay as they are.
    ``draw``: the views as they are, with depth and classes."""

    def drawn(view: View) -> Observation:
        seen = draw(view)
        rgb = edited_view(_shown(seen), how.settings, how.seed, how.drive, how.velocity_at(view.time_s))
        return replace(seen, rgb=torch.from_numpy(np.ascontiguousarray(rgb.transpose(2, 0, 1), np.float32)).clamp(0, 1))

    return drawn


def _shown(seen: Observation) -> ShownView:
    if seen.depth is None or seen.semantics is None:
        what, got = "weather and light need depth and classes of every view", "views without them"
        remedy = "fit a scene with labels, or take weather and light out of the script"
        raise InputError(what, where=seen.source, got=got, remedy=remedy)
    depth = seen.depth[0].nan_to_num(0.0).numpy().astype(np.float32)
    return ShownView(seen.view, seen.rgb.permute(1, 2, 0).numpy(), depth, seen.semantics.numpy().astype(np.uint8))
