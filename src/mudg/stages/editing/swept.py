"""LiDAR sweeps of an edited drive: beams that met what is gone go on, and meet what is new.

The beams of a sweep are those that came back in the recording, from the place of the sensor at the sweep's time. Directions from which
nothing came back (the sky) are not known, so an object in front of the sky gets no returns there.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from typing import Final

import numpy as np
from numpy.typing import NDArray

from mudg.base import geometry
from mudg.base.palette import ID, UNLABELLED
from mudg.base.types import FusedCloud, PointCloud, Sweep, SweepPoints
from mudg.core import beams
from mudg.core.edit import Motion
from mudg.stages.editing.plan import Actor, EditPlan

BOX_MARGIN_M: Final = 0.1
BEHIND_M: Final = 20.0
"""Ground is taken to go on behind a removed object this far; what stands farther behind it is not known."""
ON_GROUND_M: Final = 0.15
LEAST_GROUND: Final = 10
Rows = NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class SweptCounts:
    """What became of returns: ``cleared`` met an object that is gone; of these ``on_ground`` meet the ground behind it; ``on_objects``
    meet an object at its new place, of which ``hidden`` had met something behind it; ``unknown`` do not come back.
    Of those that do, ``lost`` do not in fog or rain, and ``droplets`` come from fog."""

    cleared: int = 0
    on_ground: int = 0
    on_objects: int = 0
    hidden: int = 0
    unknown: int = 0
    lost: int = 0
    droplets: int = 0

    def plus(self, other: SweptCounts) -> SweptCounts:
        """Both together."""
        return SweptCounts(*(getattr(self, f.name) + getattr(other, f.name) for f in fields(self)))

    def record(self) -> dict[str, int]:
        """As JSON values; those of weather where there is some."""
        return {name: value for name, value in asdict(self).items() if value or name not in ("lost", "droplets")}


def edited_points(points: SweepPoints, sweep: Sweep, plan: EditPlan, cloud: FusedCloud) -> tuple[SweepPoints, SweptCounts]:
    """The points of a sweep as the sensor would see the edited drive.

    Args:
        cloud: edited fused clouds: they hold the surfaces of objects, in the frames of their boxes.
    """
    xyz = points.xyz.astype(np.float64)
    ranges = np.linalg.norm(xyz, axis=1)
    usable = ranges > 1e-3
    directions = xyz / np.maximum(ranges, 1e-3)[:, None]
    cleared = np.zeros(len(xyz), bool)
    own: dict[str, Rows] = {}
    for name in dict.fromkeys((*plan.changes, *plan.removed)):
        own[name] = _within(xyz, sweep, plan.before.actors[name])
        cleared |= own[name]
    met = np.where(cleared | ~usable, np.inf, ranges)
    intensity, classes = points.intensity.copy(), None if points.classes is None else points.classes.copy()
    on_ground = _beyond(directions, ranges, np.flatnonzero(cleared & usable), sweep, plan)
    met = np.where(np.isfinite(on_ground), on_ground, met)
    fallen = np.isfinite(on_ground)
    intensity[fallen] = _ground_intensity(points, ranges, met[fallen], sweep, plan)
    if classes is not None:
        classes[fallen] = ID["road"]
    before, taken = met.copy(), np.zeros(len(xyz), bool)
    for name in plan.touched():
        hit, ids = _on_object(directions, sweep, plan.after.actors[name], cloud.objects.get(name))
        nearer = (hit < met) & usable
        met, taken = np.where(nearer, hit, met), taken | nearer
        intensity[nearer] = _object_intensity(points, own, name, sweep, plan)
        if classes is not None:
            classes[nearer] = ids[nearer]
    back = np.isfinite(met) & np.isfinite(intensity)
    changed = back & (fallen | taken)
    made = points.xyz.copy()
    made[changed] = (directions[changed] * met[changed, None]).astype(np.float32)
    counts = SweptCounts(int(cleared.sum()), int((fallen & ~taken & back).sum()), int((taken & back).sum()),
                         int((taken & np.isfinite(before)).sum()), int((usable & ~back).sum()))  # fmt: skip
    kept = back | ~(usable | cleared)
    return SweepPoints(made[kept], intensity[kept], points.dt_s[kept], None if classes is None else classes[kept]), counts


def _pose(motion: Motion, sweep: Sweep) -> NDArray[np.float64] | None:
    """sensor_from_box at a sweep's time."""
    pose = motion.pose_at(sweep.time_s)
    return None if pose is None else geometry.invert(sweep.world_from_lidar) @ pose


def _within(xyz: NDArray[np.float64], sweep: Sweep, actor: Actor) -> Rows:
    """Which points lie on an object: in its box, but not on the ground below it."""
    pose = _pose(actor.motion, sweep)
    if pose is None:
        return np.zeros(len(xyz), bool)
    local, half = geometry.transform_points(geometry.invert(pose), xyz), np.array(actor.size_m) / 2
    return (np.abs(local) <= half + BOX_MARGIN_M).all(1) & (local[:, 2] > BOX_MARGIN_M - half[2])


def _beyond(
    directions: NDArray[np.float64], ranges: NDArray[np.float64], rows: NDArray[np.int64], sweep: Sweep, plan: EditPlan
) -> NDArray[np.float64]:
    """Range of the known ground behind what is gone, f64[N]; infinite where it is not known, or an object of the drive stands before it."""
    found = np.full(len(directions), np.inf)
    if plan.before.ground is None or not len(rows):
        return found
    free = beams.met_ground(directions[rows], sweep.world_from_lidar, plan.before.ground, ranges[rows], BEHIND_M)
    for name, actor in plan.after.actors.items():
        pose = None if name in plan.touched() else _pose(actor.motion, sweep)
        if pose is not None:
            free = np.where(beams.met_box(directions[rows], pose, actor.size_m) < free, np.inf, free)
    found[rows] = free
    return found


def _ground_intensity(
    points: SweepPoints, ranges: NDArray[np.float64], asked: NDArray[np.float64], sweep: Sweep, plan: EditPlan
) -> NDArray[np.float32]:
    """Median intensity of recorded ground at about the same range, f32; NaN where the sweep shows no ground."""
    if plan.before.ground is None or not len(asked):
        return np.zeros(0, np.float32)
    world = geometry.transform_points(sweep.world_from_lidar, points.xyz.astype(np.float64))
    with np.errstate(invalid="ignore"):
        low = np.abs(world[:, 2] - plan.before.ground.height(world[:, :2])) < ON_GROUND_M
    if not low.any():
        return np.full(len(asked), np.nan, np.float32)
    order = np.argsort(ranges[low], kind="stable")
    far, value = ranges[low][order], points.intensity[low][order]
    made = []
    for wanted in asked:
        first, last = np.searchsorted(far, (0.8 * wanted, 1.25 * wanted))
        made.append(np.median(value[first:last] if last - first >= LEAST_GROUND else value))
    return np.array(made, np.float32)


def _on_object(
    directions: NDArray[np.float64], sweep: Sweep, actor: Actor, surface: PointCloud | None
) -> tuple[NDArray[np.float64], NDArray[np.uint8]]:
    """Range at which beams meet an object, f64[N] (infinite: they miss it), and the class there u8[N]. Without points: those of its box."""
    hit = np.full(len(directions), np.inf)
    kind = ID.get(actor.label, UNLABELLED)
    ids = np.full(len(directions), kind, np.uint8)
    pose = _pose(actor.motion, sweep)
    if pose is None:
        return hit, ids
    around = beams.met_box(directions, pose, np.array(actor.size_m) + 2 * beams.LARGEST_M)
    rows = np.flatnonzero(np.isfinite(around))
    if surface is None or not len(surface.xyz):
        hit[rows] = beams.met_box(directions[rows], pose, actor.size_m)
        return hit, ids
    own = surface.xyz.astype(np.float64)
    hit[rows], first = beams.met_points(directions[rows], geometry.transform_points(pose, own), beams.ball_sizes(own))
    if surface.semantics is not None:
        ids[rows] = np.where(first >= 0, surface.semantics[first], kind)
    return hit, ids


def _object_intensity(points: SweepPoints, own: Mapping[str, Rows], name: str, sweep: Sweep, plan: EditPlan) -> float:
    """Median intensity of an object's recorded returns; of a new one: of what else lies in boxes of this sweep, else of all of it."""
    mine = own.get(name)
    if mine is not None and mine.any():
        return float(np.median(points.intensity[mine]))
    xyz = points.xyz.astype(np.float64)
    boxes = [_within(xyz, sweep, actor) for actor in plan.before.actors.values()]
    all_boxes = np.any(boxes, axis=0) if boxes else np.zeros(len(xyz), bool)
    chosen = points.intensity[all_boxes] if all_boxes.any() else points.intensity
    return float(np.median(chosen)) if len(chosen) else float("nan")
