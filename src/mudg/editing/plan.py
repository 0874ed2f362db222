"""From a script to what is to happen: every verb in order, on the paths of all road users and of the vehicle. Boxes of
a scene and objects of a fit lie not quite in the same places, for a fit corrects paths: so a plan keeps what is done to
a path as functions, to be applied to either."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from mudg.base import geometry
from mudg.base.errors import InputError, UsageError, nearest
from mudg.base.types import Scene, View
from mudg.core import edit as paths
from mudg.core.edit import Displacement, HeightMap, Motion
from mudg.editing.model import Asset, motion_of
from mudg.editing.script import CONDITIONS, EGO, AssetSource, DisplacingEdit, EditScript, EraseEdit
from mudg.gaussians.model import SceneModel
from mudg.gaussians.nodes import RigidNode

Change = Callable[[Motion], Motion]
OpenAsset = Callable[[AssetSource], Asset]
"""Reads the object that a script names."""


SAME_PLACE_M: Final = 1e-4
MOVING_M: Final = 1.0
"""An object moves if its box gets farther than this from its first place."""


@dataclass(frozen=True, slots=True, eq=False)
class Actor:
    """A road user: class, box size in metres, path of the box's centre."""

    label: str
    size_m: tuple[float, float, float]
    motion: Motion

    @property
    def moves(self) -> bool:
        """Whether its box leaves its place."""
        places = self.motion.poses[:, :3, 3]
        return bool(np.linalg.norm(places - places[0], axis=1).max() > MOVING_M)


@dataclass(frozen=True, slots=True, eq=False)
class EditWorld:
    """What a script can speak of. ``actors``: by id. ``ego``: path of the vehicle, None where only a fitted scene is
    given. ``ground``: None = heights are not known."""

    actors: Mapping[str, Actor]
    ego: Motion | None = None
    ground: HeightMap | None = None

    def pose_of(self, name: str, time_s: float) -> NDArray[np.float64] | None:
        """world_from_box f64[4, 4] of an actor at a time; None where it is not there."""
        return self.actors[name].motion.pose_at(time_s) if name in self.actors else None

    @classmethod
    def of_scene(cls, scene: Scene, ground: HeightMap | None) -> EditWorld:
        """All boxes of a scene and its vehicle."""
        motion = lambda track: Motion.recorded(track.times_s, track.world_from_object)
        actors = {t.id: Actor(t.label, tuple(map(float, t.size_m)), motion(t)) for t in scene.tracks}
        return cls(actors, Motion.recorded(scene.ego.times_s, scene.ego.world_from_ego), ground)

    @classmethod
    def of_model(cls, model: SceneModel, ground: HeightMap | None) -> EditWorld:
        """The objects of a fitted scene."""
        nodes = [node for node in model.nodes if isinstance(node, RigidNode)]
        actors = {node.name: Actor(node.label, tuple(map(float, node.size_m)), motion_of(node)) for node in nodes}
        return cls(actors, None, ground)


@dataclass(frozen=True, slots=True, eq=False)
class Insertion:
    """An object that is put in: what it is; how dark its shadow is; whether it takes the light of the scene."""

    asset: Asset
    shadow: float
    match_light: bool


@dataclass(slots=True, eq=False)
class EditPlan:
    """What a script does. ``before``, ``after``: the world without and with the edits. ``open_asset``: reads the object
    that a script names. ``close_street``: whether the street is closed behind what leaves its place, where a script
    does not say. ``changes``: what is done to the path of an actor of the recording, in order. ``removed``: actors of
    the recording that are gone. ``inserted``: new ones, by id. ``sky``: settings of the last `sky`. ``erased``: what
    parts of the street are taken away. ``notes``: what the reader should know, with numbers. ``views``: recorded ones,
    which say what nobody saw of the street; none where there is no scene. ``closed``: actors without whose traces the
    street is to be shown, if they were recorded (``editing/model.py``). ``sides``: actors whose sides that no view
    showed are closed (``shown_sides``)."""

    before: EditWorld
    after: EditWorld
    open_asset: OpenAsset
    close_street: bool = False
    changes: dict[str, list[Change]] = field(default_factory=dict)
    removed: list[str] = field(default_factory=list)
    inserted: dict[str, Insertion] = field(default_factory=dict)
    sky: Any = None
    erased: list[EraseEdit] = field(default_factory=list)
    notes: list[dict[str, Any]] = field(default_factory=list)
    moves_ego: bool = False
    views: tuple[View, ...] = ()
    closed: set[str] = field(default_factory=set)
    sides: set[str] = field(default_factory=set)

    def changed(self, name: str, motion: Motion) -> Motion:
        """The path of an actor of the recording with all that is done to it."""
        return functools.reduce(lambda now, change: change(now), self.changes.get(name, ()), motion)

    def touched(self) -> tuple[str, ...]:
        """Ids of actors whose path or looks are new."""
        return tuple(dict.fromkeys([*(name for name in self.changes if name in self.after.actors), *self.inserted]))


def plan_edits(script: EditScript, world: EditWorld, open_asset: OpenAsset, close_street: bool = False) -> EditPlan:
    """Carry out a script on paths. InputError: an id that does not exist, or something that cannot be done; the message
    names the line and the verb."""
    plan = EditPlan(world, world, open_asset, close_street)
    for edit in script.edits:
        if edit.verb in CONDITIONS:
            continue
        try:
            _VERBS[edit.verb](plan, edit.settings)
            if isinstance(edit.settings, DisplacingEdit):
                _close(plan, edit.settings.id, edit.settings.close_street)
        except (InputError, UsageError) as told:
            where = f"{edit.where}: {edit.verb}" + (f".{told.where}" if told.where else "")
            raise InputError(told.what, **{**told.fields, "where": where}) from told
    for name in plan.closed & world.actors.keys() & plan.after.actors.keys() - plan.inserted.keys():
        old, new = (of.actors[name].motion.poses for of in (world, plan.after))
        if old.shape == new.shape and np.allclose(old, new, atol=SAME_PLACE_M):
            plan.closed.remove(name)  # it is where it was
    plan.closed &= world.actors.keys()
    return plan


# -- verbs -----------------------------------------------------------------------------------------


def _remove(plan: EditPlan, fields: Any) -> None:
    for name in fields.ids if fields.ids is not None else _chosen(plan.after, fields):
        _actor(plan.after, name)
        plan.inserted.pop(name, None)
        _recorded_goes(plan, name)
        plan.after = replace(plan.after, actors={key: value for key, value in plan.after.actors.items() if key != name})
        _close(plan, name, fields.close_street)


def _close(plan: EditPlan, name: str, asked: bool | None) -> None:
    """Note whether the street is to be closed behind an object; the last edit that says so counts."""
    if name != EGO and (plan.close_street if asked is None else asked):
        plan.closed.add(name)
    elif asked is False:
        plan.closed.discard(name)


def _recorded_goes(plan: EditPlan, name: str) -> None:
    if name in plan.before.actors and name not in plan.removed:
        plan.removed.append(name)
        plan.changes.pop(name, None)


def _chosen(world: EditWorld, fields: Any) -> list[str]:
    """Ids of the objects of a kind."""
    if fields.within_m is not None and world.ego is None:
        what = "the vehicle's path is not known, so nothing is near it"
        raise InputError(what, where="within_m", remedy="give --scene")
    names = []
    for name, actor in world.actors.items():
        if fields.within_m is not None:
            apart = actor.motion.poses[:, None, :2, 3] - world.ego.poses[None, :, :2, 3]
            if np.linalg.norm(apart, axis=-1).min() > fields.within_m:
                continue
        if fields.class_ in (None, actor.label) and fields.moving in (None, actor.moves):
            names.append(name)
    if not names:
        labels = ", ".join(sorted({actor.label for actor in world.actors.values()}))
        got = str(fields.model_dump(exclude_none=True, by_alias=True))
        raise InputError("no object is of this kind", expected=f"class among {labels or 'none'}", got=got)
    return names


def _move(plan: EditPlan, fields: Any) -> None:
    by = Displacement(
        fields.along_m, fields.left_m, fields.up_m, math.radians(fields.yaw_deg), fields.from_s, fields.ramp_s
    )
    _change(plan, fields.id, functools.partial(paths.moved, by=by, ground=plan.after.ground if fields.ground else None))


def _stop(plan: EditPlan, fields: Any) -> None:
    _change(plan, fields.id, functools.partial(paths.stopped, at_s=fields.at_s, brake_m_s2=fields.brake_m_s2))


def _speed(plan: EditPlan, fields: Any) -> None:
    motion = _motion(plan.after, fields.id)
    begin = float(motion.times_s[0]) if fields.from_s is None else max(fields.from_s, float(motion.times_s[0]))
    ahead = max(0.0, (fields.factor - 1) * (float(motion.times_s[-1]) - begin))
    if ahead > 0:
        text = f"{fields.id} goes on straight for {ahead:.1f} s of its recording that do not exist"
        plan.notes.append({"kind": "beyond the recording", "id": fields.id, "seconds": round(ahead, 3), "text": text})
    _change(plan, fields.id, functools.partial(paths.sped, factor=fields.factor, from_s=fields.from_s))


def _lane_change(plan: EditPlan, fields: Any) -> None:
    peak = paths.QUINTIC_PEAK * abs(fields.left_m) / fields.duration_s**2
    if peak > fields.most_lateral_m_s2:
        least = math.sqrt(paths.QUINTIC_PEAK * abs(fields.left_m) / fields.most_lateral_m_s2)
        expected = f"at most {fields.most_lateral_m_s2:g} m/s^2 sideways"
        got = f"{peak:.2f} m/s^2 ({fields.left_m:g} m in {fields.duration_s:g} s)"
        remedy = f"a duration_s of {math.ceil(least * 100) / 100:g} or more, or a larger most_lateral_m_s2"
        raise InputError("the lane change is too sharp", where="duration_s", expected=expected, got=got, remedy=remedy)
    by = {name: getattr(fields, name) for name in ("left_m", "start_s", "duration_s")}
    ground = plan.after.ground if fields.ground else None
    _change(plan, fields.id, functools.partial(paths.lane_changed, **by, ground=ground))


def _path(plan: EditPlan, fields: Any) -> None:
    ground = plan.after.ground if fields.ground else None

    def through(motion: Motion) -> Motion:
        """At the height above the ground that the object had at first."""
        first = motion.poses[0, :3, 3]
        under = float("nan") if ground is None else float(ground.height(first[None, :2])[0])
        floor = first[2] if np.isnan(under) else under
        made = paths.along_points(_points(fields.points), float(first[2] - floor), ground, float(floor))
        return replace(made, source_s=np.clip(made.times_s, motion.times_s[0], motion.times_s[-1]))

    _change(plan, fields.id, through)


def _points(points: list[list[float]]) -> np.ndarray:
    made = np.full((len(points), 4), np.nan)
    for row, point in zip(made, points, strict=True):
        row[: len(point)] = point
    made[:, 3] = np.radians(made[:, 3])
    return made


def _replace(plan: EditPlan, fields: Any) -> None:
    old, asset = _actor(plan.after, fields.id), plan.open_asset(fields.by)
    up = Displacement(up_m=(asset.size_m[2] - old.size_m[2]) / 2)  # wheels stay where they were
    new = Actor(asset.label, asset.size_m, paths.moved(old.motion, up))
    _recorded_goes(plan, fields.id)
    plan.inserted[fields.id] = Insertion(asset, 0.0, fields.match_light)
    plan.after = replace(plan.after, actors={**plan.after.actors, fields.id: new})


def _insert(plan: EditPlan, fields: Any) -> None:
    asset, world = plan.open_asset(fields.asset), plan.after
    label = fields.class_ or asset.label
    numbered = (f"{label}-new{i}" for i in range(1, len(world.actors) + 2))
    name = fields.id or next(name for name in numbered if name not in world.actors)
    if name in world.actors:
        what, remedy = "there is an object of this id already", "give the new one another id"
        raise InputError(what, where="id", got=name, remedy=remedy)
    ground, height = world.ground if fields.ground else None, asset.size_m[2] / 2
    if fields.path is not None:
        points = _points(fields.path)
        if len(points) == 1:
            points = _at_all_times(points[0], world)
        motion = paths.along_points(points, height, ground, _floor(world))
    else:
        motion = _near(world, fields.near, height, ground)
    plan.inserted[name] = Insertion(asset, fields.shadow, fields.match_light)
    plan.after = replace(world, actors={**world.actors, name: Actor(label, asset.size_m, motion)})


def _at_all_times(point: np.ndarray, world: EditWorld) -> np.ndarray:
    """A place with a heading, from the first to the last moment of the drive."""
    motions = [*(actor.motion for actor in world.actors.values()), *([] if world.ego is None else [world.ego])]
    if not motions:
        raise InputError("the times of the drive are not known", remedy="give --scene")
    first, last = min(float(m.times_s[0]) for m in motions), max(float(m.times_s[-1]) for m in motions)
    still = np.tile(point, (2, 1))
    still[:, 0], still[:, 3] = (first, max(last, first + 1e-3)), np.nan_to_num(point[3])
    return still


def _floor(world: EditWorld) -> float:
    """Height of the ground where the map does not know it: below the vehicle, or 0."""
    return 0.0 if world.ego is None else float(np.median(world.ego.poses[:, 2, 3]))


def _near(world: EditWorld, fields: Any, height: float, ground: HeightMap | None) -> Motion:
    """A place relative to somebody, standing still or going with them, wheels on the ground."""
    leader = _motion(world, fields.id)
    by = Displacement(fields.ahead_m, fields.left_m, 0.0, math.radians(fields.yaw_deg))
    placed = paths.moved(leader, by)
    if fields.at_s is not None:
        pose = placed.pose_at(fields.at_s)
        if pose is None:
            got, expected = f"{fields.at_s} s", f"{leader.times_s[0]:.2f}..{leader.times_s[-1]:.2f} s"
            raise InputError("nobody is there at this time", where="near.at_s", got=got, expected=expected)
        points = _at_all_times(np.array([0.0, *pose[:2, 3], geometry.yaw_of(pose)]), world)
    else:
        yaws = np.unwrap([geometry.yaw_of(pose) for pose in placed.poses])
        points = np.column_stack([placed.times_s, placed.poses[:, :2, 3], yaws])
    return paths.along_points(points, height, ground, _floor(world))


_VERBS: Final[dict[str, Callable[[EditPlan, Any], None]]] = {
    "remove": _remove,
    "move": _move,
    "stop": _stop,
    "speed": _speed,
    "lane_change": _lane_change,
    "path": _path,
    "replace": _replace,
    "insert": _insert,
    "sky": lambda plan, fields: setattr(plan, "sky", fields),
    "erase": lambda plan, fields: plan.erased.append(fields),
}


# -- helpers ---------------------------------------------------------------------------------------


def _actor(world: EditWorld, name: str) -> Actor:
    if name in world.actors:
        return world.actors[name]
    near, shown = nearest(name, world.actors), ", ".join(list(world.actors)[:20])
    expected = f"ego, or one of {shown or 'none'}" + (", ..." if len(world.actors) > 20 else "")
    remedy = f"did you mean {near!r}?" if near else "tracks.json of the scene lists them"
    raise InputError("there is no object of this id", where="id", expected=expected, got=name, remedy=remedy)


def _motion(world: EditWorld, name: str) -> Motion:
    if name != EGO:
        return _actor(world, name).motion
    if world.ego is None:
        raise InputError("the path of the vehicle is not known", where="id", got=EGO, remedy="give --scene")
    return world.ego


def _change(plan: EditPlan, name: str, change: Change) -> None:
    made = change(_motion(plan.after, name))
    if name == EGO:
        plan.after, plan.moves_ego = replace(plan.after, ego=made), True
        return
    if name not in plan.inserted:
        plan.changes.setdefault(name, []).append(change)
    plan.after = replace(plan.after, actors={**plan.after.actors, name: replace(plan.after.actors[name], motion=made)})


# -- checks ----------------------------------------------------------------------------------------
Array = NDArray[np.float64]
STEP_S: Final = 0.1
LEAST_OVERLAP_M: Final = 0.05
EGO_SIZE_M: Final = (4.6, 1.9, 1.6)
EGO_CENTRE_AHEAD_M: Final = 0.7
"""The vehicle as a box: its size, and how far its centre lies ahead of its origin (between that of a rear axle and of a
centre)."""
FARTHEST_M: Final = 80.0
SELDOM_RAD: Final = np.radians(30.0)
LEAST_SHARE: Final = 0.05
ANOTHER_SIDE_RAD: Final = np.radians(3.0)
"""From a direction that differs by more than this, a view shows flanks that the recording may not have shown."""


def collisions(plan: EditPlan) -> list[dict[str, Any]]:
    """Pairs of boxes that overlap after the edits and did not before, over all times. Pairs that no edit touches are
    not tried."""
    after, before = _with_ego(plan.after), _with_ego(plan.before)
    touched = [*plan.touched(), *([EGO] if plan.moves_ego else [])]
    found, done = [], set()
    for name in touched:
        for other in after:
            if other == name or frozenset((name, other)) in done:
                continue
            done.add(frozenset((name, other)))
            depth, at_s = _deepest(after[name], after[other])
            known = name in before and other in before and name not in plan.inserted and other not in plan.inserted
            before_m = _deepest(before[name], before[other])[0] if known else -np.inf
            if depth < LEAST_OVERLAP_M or depth <= before_m + LEAST_OVERLAP_M:
                continue
            text = f"{name} and {other} overlap by {depth:.2f} m at {at_s:.2f} s"
            numbers = {"overlap_m": round(depth, 3), "at_s": round(at_s, 3)}
            found.append({"kind": "collision", "ids": [name, other], **numbers, "text": text})
    return found


def _with_ego(world: EditWorld) -> dict[str, Actor]:
    actors = dict(world.actors)
    if world.ego is not None:
        to_centre = geometry.yaw_matrix(0.0, (EGO_CENTRE_AHEAD_M, 0.0, EGO_SIZE_M[2] / 2))
        ego = world.ego
        actors[EGO] = Actor("car", EGO_SIZE_M, Motion(ego.times_s, ego.poses @ to_centre, ego.source_s))
    return actors


def _deepest(a: Actor, b: Actor) -> tuple[float, float]:
    """The deepest overlap of two boxes and its time; (-inf, 0) if they are never there together."""
    first = max(float(a.motion.times_s[0]), float(b.motion.times_s[0]))
    last = min(float(a.motion.times_s[-1]), float(b.motion.times_s[-1]))
    if last < first:
        return -np.inf, 0.0
    times = np.linspace(first, last, max(2, int(np.ceil((last - first) / STEP_S)) + 1))
    ends = (times[:1], times[-1:])
    gap = [np.linalg.norm(a.motion.at(t).poses[0, :3, 3] - b.motion.at(t).poses[0, :3, 3]) for t in ends]
    way = sum(float(actor.motion.travelled_m()[-1]) for actor in (a, b))
    if min(gap) > way + (np.linalg.norm(a.size_m) + np.linalg.norm(b.size_m)) / 2:
        return -np.inf, 0.0  # too far apart to meet
    overlap = paths.overlap_m(a.motion.at(times).poses, a.size_m, b.motion.at(times).poses, b.size_m)
    worst = int(overlap.argmax())
    return float(overlap[worst]), float(times[worst])


def shown_sides(
    plan: EditPlan, views_before: Sequence[View], views_after: Sequence[View]
) -> tuple[list[dict[str, Any]], set[str]]:
    """Notes on objects that the edited drive shows from directions from which the recording hardly saw them; and those
    of the recording of which some view shows a side that no recorded view shows, from more than `ANOTHER_SIDE_RAD`
    away. ``views_before``: recorded views. ``views_after``: the same with the edited path of the vehicle."""
    notes, anew = [], set()
    for name in plan.after.actors if plan.moves_ego else plan.touched():
        asked, insertion = sides_seen(plan.after.actors[name], views_after), plan.inserted.get(name)
        if insertion is None:
            seen = sides_seen(plan.before.actors[name], views_before)
        else:
            seen = np.array(insertion.asset.seen_rad)
        if not len(asked):
            continue
        if insertion is not None and not len(seen):
            text = f"{name}: from which sides its own recording saw it is not known; export it with its scene"
            notes.append({"kind": "unknown sides", "ids": [name], "text": text})
            continue
        apart = paths.angle_to_nearest(asked, seen)
        if insertion is None and len(seen) and apart.max() > ANOTHER_SIDE_RAD:
            anew.add(name)
        share, largest = float((apart > SELDOM_RAD).mean()), float(np.degrees(apart.max()))
        if share >= LEAST_SHARE:
            sides = f"{share:.0%} of its views look at sides that the recording saw from more than 30 degrees away"
            text = f"{name}: {sides} (up to {largest:.0f})" if len(seen) else f"{name}: the recording never shows it"
            numbers = {"share": round(share, 3), "largest_deg": round(largest, 1)}
            notes.append({"kind": "seldom-seen side", "ids": [name], **numbers, "text": text})
    return notes, anew


def sides_seen(actor: Actor, views: Sequence[View]) -> Array:
    """From which sides views show an object, f64[M] radians from its front; views that do not have its centre in the
    image are left out."""
    poses, centres = [], []
    for view in views:
        pose = actor.motion.pose_at(view.time_s)
        if pose is None:
            continue
        uv, depth = geometry.project(view, pose[None, :3, 3])
        if 0 < depth[0] < FARTHEST_M and 0 <= uv[0, 0] <= view.camera.width and 0 <= uv[0, 1] <= view.camera.height:
            poses.append(pose)
            centres.append(view.center_world)
    return paths.azimuths(np.stack(poses), np.stack(centres)) if poses else np.zeros(0)
