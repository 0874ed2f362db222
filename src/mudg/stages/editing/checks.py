"""What a reader of an edited drive should know: collisions, and sides of objects that the recording hardly saw. With numbers."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from mudg.base import geometry
from mudg.base.types import View
from mudg.core import boxes
from mudg.core.edit import Motion
from mudg.data.edits import EGO
from mudg.stages.editing.plan import Actor, EditPlan, EditWorld

Array = NDArray[np.float64]
STEP_S: Final = 0.1
LEAST_OVERLAP_M: Final = 0.05
EGO_SIZE_M: Final = (4.6, 1.9, 1.6)
EGO_CENTRE_AHEAD_M: Final = 0.7
"""The vehicle as a box: its size, and how far its centre lies ahead of its origin (between that of a rear axle and of a centre)."""
FARTHEST_M: Final = 80.0
SELDOM_RAD: Final = np.radians(30.0)
LEAST_SHARE: Final = 0.05
ANOTHER_SIDE_RAD: Final = np.radians(3.0)
"""From a direction that differs by more than this, a view shows flanks that the recording may not have shown."""


def check(plan: EditPlan, views_before: Sequence[View], views_after: Sequence[View]) -> list[dict[str, Any]]:
    """Notes of a plan and what its checks found, each with ``kind``, ids, numbers and a sentence ``text``.

    Args:
        views_before: recorded views. views_after: the same with the edited path of the vehicle.
    """
    return [*plan.notes, *collisions(plan), *unseen_sides(plan, views_before, views_after)]


def collisions(plan: EditPlan) -> list[dict[str, Any]]:
    """Pairs of boxes that overlap after the edits and did not before, over all times. Pairs that no edit touches are not tried."""
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
            if depth < LEAST_OVERLAP_M or (known and depth <= _deepest(before[name], before[other])[0] + LEAST_OVERLAP_M):
                continue
            found.append({
                "kind": "collision", "ids": [name, other], "overlap_m": round(depth, 3), "at_s": round(at_s, 3),
                "text": f"{name} and {other} overlap by {depth:.2f} m at {at_s:.2f} s",
            })  # fmt: skip
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
    overlap = boxes.overlap_m(a.motion.at(times).poses, a.size_m, b.motion.at(times).poses, b.size_m)
    worst = int(overlap.argmax())
    return float(overlap[worst]), float(times[worst])


def unseen_sides(plan: EditPlan, views_before: Sequence[View], views_after: Sequence[View]) -> list[dict[str, Any]]:
    """Objects that the edited drive shows from directions from which the recording hardly saw them."""
    names = list(plan.after.actors) if plan.moves_ego else plan.touched()
    found = []
    for name in names:
        asked = sides_seen(plan.after.actors[name], views_after)
        if name in plan.inserted:
            seen = np.array(plan.inserted[name].asset.seen_rad)
        else:
            seen = sides_seen(plan.before.actors[name], views_before)
        if not len(asked):
            continue
        if name in plan.inserted and not len(seen):
            text = f"{name}: from which sides its own recording saw it is not known; export it with its scene"
            found.append({"kind": "unknown sides", "ids": [name], "text": text})
            continue
        apart = boxes.angle_to_nearest(asked, seen)
        share = float((apart > SELDOM_RAD).mean())
        if share < LEAST_SHARE:
            continue
        largest = float(np.degrees(apart.max()))
        found.append({
            "kind": "seldom-seen side", "ids": [name], "share": round(share, 3), "largest_deg": round(largest, 1),
            "text": f"{name}: {share:.0%} of its views look at sides that the recording saw from more than 30 degrees away "
                    f"(up to {largest:.0f})" if len(seen) else f"{name}: the recording never shows it",
        })  # fmt: skip
    return found


def shown_anew(plan: EditPlan, views_before: Sequence[View], views_after: Sequence[View]) -> set[str]:
    """Objects of the recording of which some view shows a side that no recorded view shows, from more than `ANOTHER_SIDE_RAD` away,
    because their path or that of the vehicle has changed."""
    found = set()
    for name in plan.before.actors if plan.moves_ego else plan.changes:
        if name not in plan.before.actors or name not in plan.after.actors:
            continue
        asked = sides_seen(plan.after.actors[name], views_after)
        seen = sides_seen(plan.before.actors[name], views_before)
        if len(asked) and len(seen) and boxes.angle_to_nearest(asked, seen).max() > ANOTHER_SIDE_RAD:
            found.add(name)
    return found


def sides_seen(actor: Actor, views: Sequence[View]) -> Array:
    """From which sides views show an object, f64[M] radians from its front; views that do not have its centre in the image are left out."""
    poses, centres = [], []
    for view in views:
        pose = actor.motion.pose_at(view.time_s)
        if pose is None:
            continue
        uv, depth = geometry.project(view, pose[None, :3, 3])
        if 0 < depth[0] < FARTHEST_M and 0 <= uv[0, 0] <= view.camera.width and 0 <= uv[0, 1] <= view.camera.height:
            poses.append(pose)
            centres.append(view.center_world)
    return boxes.azimuths(np.stack(poses), np.stack(centres)) if poses else np.zeros(0)
