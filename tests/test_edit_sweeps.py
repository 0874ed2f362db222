"""LiDAR beams of an edited drive: exact where boxes and planes say where they end."""

from __future__ import annotations

import numpy as np

from mudg.base import geometry
from mudg.base.palette import ID
from mudg.base.types import FusedCloud, PointCloud, Sweep, SweepPoints
from mudg.core import lidar
from mudg.core.edit import HeightMap, Motion
from mudg.editing.edit import edited_points
from mudg.editing.plan import Actor, EditPlan, EditWorld, plan_edits
from mudg.editing.script import parse_edits

SIZE = (4.0, 2.0, 1.6)
SENSOR = geometry.yaw_matrix(0.0, (0, 0, 2.0))
WALL_M = 40.0
GROUND = HeightMap(np.array([-2.0, -12.0]), 0.5, np.zeros((94, 48)))


def standing(x: float, y: float = 0.0) -> Actor:
    pose = geometry.yaw_matrix(0.0, (x, y, SIZE[2] / 2))
    return Actor("car", SIZE, Motion.recorded([0.0, 1.0], np.stack([pose, pose])))


def fan() -> np.ndarray:
    azimuth, rise = np.meshgrid(np.radians(np.arange(-20, 20, 0.5)), np.radians(np.arange(-20, 2.1, 0.5)))
    return np.stack([np.cos(rise) * np.cos(azimuth), np.cos(rise) * np.sin(azimuth), np.sin(rise)], -1).reshape(-1, 3)


def exact(boxes: dict[str, Actor]) -> tuple[np.ndarray, np.ndarray]:
    """Range of every beam against the ground z = 0, a wall and boxes, and which of the boxes it meets (-1: none)."""
    directions = fan()
    with np.errstate(divide="ignore"):
        down = np.where(directions[:, 2] < 0, -2.0 / directions[:, 2], np.inf)
    found, owner = np.minimum(down, WALL_M / directions[:, 0]), np.full(len(directions), -1)
    for index, actor in enumerate(boxes.values()):
        hit = lidar.met_box(directions, geometry.invert(SENSOR) @ actor.motion.poses[0], actor.size_m)
        found, owner = np.where(hit < found, hit, found), np.where(hit < found, index, owner)
    return found, owner


def recorded(boxes: dict[str, Actor]) -> SweepPoints:
    ranges, owner = exact(boxes)
    intensity = np.where(owner >= 0, 0.8, 0.2).astype(np.float32)
    classes = np.where(owner >= 0, ID["car"], ID["road"]).astype(np.uint8)
    xyz, dt_s = (fan() * ranges[:, None]).astype(np.float32), np.arange(len(ranges), dtype=np.float32) * 1e-6
    return SweepPoints(xyz, intensity, dt_s, classes)


def shell() -> PointCloud:
    """The surface of a box of `SIZE`, 5 cm apart."""
    axes = [np.linspace(-s / 2, s / 2, round(s / 0.05) + 1) for s in SIZE]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
    on = (np.abs(np.abs(grid) - np.array(SIZE) / 2) < 1e-9).any(1)
    xyz = grid[on].astype(np.float32)
    return PointCloud(xyz, np.zeros((len(xyz), 3), np.uint8), "object", np.full(len(xyz), ID["car"], np.uint8))


def changed(
    boxes: dict[str, Actor], text: str, surfaces: dict[str, PointCloud]
) -> tuple[SweepPoints, SweepPoints, EditPlan]:
    plan = plan_edits(parse_edits(text, "e"), EditWorld(boxes, None, GROUND), lambda source: None)
    points, sweep = recorded(boxes), Sweep("0", "lidar", 0.5, SENSOR, "")
    static = PointCloud(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.uint8), "world")
    return points, edited_points(points, sweep, plan, FusedCloud(static, surfaces)), plan


def test_beams_meet_boxes_points_and_ground_where_geometry_says() -> None:
    pose = geometry.yaw_matrix(0.3, (10, 1, -1.2))
    directions = fan()
    hit = lidar.met_box(directions, pose, SIZE)
    local = geometry.transform_points(geometry.invert(pose), directions[np.isfinite(hit)] * hit[np.isfinite(hit), None])
    assert np.abs((np.abs(local) - np.array(SIZE) / 2).max(1)).max() < 1e-9  # on a face
    surface = geometry.transform_points(pose, shell().xyz.astype(np.float64))
    seen, first = lidar.met_points(directions, surface, lidar.ball_sizes(shell().xyz.astype(np.float64)))
    both = np.isfinite(hit) & np.isfinite(seen)
    assert both.sum() > 0.98 * np.isfinite(hit).sum() and np.median(np.abs(seen[both] - hit[both])) < 0.05
    assert (first[np.isfinite(seen)] >= 0).all()
    down = directions[directions[:, 2] < -0.1]
    way = lidar.met_ground(down, SENSOR, GROUND, np.full(len(down), 1.0), 25.0)
    assert np.allclose(way, -2 / down[:, 2], atol=0.01)
    assert np.isinf(lidar.met_box(directions, geometry.yaw_matrix(0, (-10, 0, 0)), SIZE)).all()  # behind the sensor


def test_beams_that_met_a_removed_object_meet_the_ground_behind_it_or_do_not_come_back() -> None:
    boxes = {"a": standing(10.0), "b": standing(25.0)}
    old, new, _ = changed(boxes, "- remove: {ids: [a]}", {})
    free, owner = exact({"b": boxes["b"]})
    before, met = exact(boxes)
    gone = (met == 0) & (before * -fan()[:, 2] < 2.0 - 0.1)  # the lowest belong to the ground
    order = np.round(new.dt_s / 1e-6).astype(int)
    ranges = np.linalg.norm(new.xyz, axis=1)
    # what lies 0.1 m above the road counts as road
    assert np.abs(ranges - free[order])[~gone[order] | (owner[order] < 0)].max() < 0.6
    assert not (gone[order] & (owner[order] == 0)).any()  # what b would have sent back is not known
    assert np.allclose(new.intensity[gone[order]], 0.2)
    lost = np.setdiff1d(np.arange(len(old.xyz)), order)
    assert len(lost) > 50 and gone[lost].mean() > 0.95 and (gone[order] & (owner[order] < 0)).sum() > 50


def test_beams_meet_a_moved_object_and_lose_what_is_behind_it() -> None:
    boxes = {"a": standing(10.0), "b": standing(25.0)}
    old, new, plan = changed(boxes, "- move: {id: a, along_m: 6, left_m: 2, ground: false}", {"a": shell()})
    truth, owner = exact(dict(plan.after.actors))
    order = np.round(new.dt_s / 1e-6).astype(int)
    error = np.abs(np.linalg.norm(new.xyz, axis=1) - truth[order])
    assert np.quantile(error, 0.97) < 0.1
    on_it = owner[order] == list(plan.after.actors).index("a")
    assert on_it.sum() > 50 and (on_it & (truth[order] < np.linalg.norm(old.xyz[order], axis=1) - 0.1)).any()
    near = on_it & (error < 0.1)
    assert (np.abs(new.intensity[near] - 0.8) < 1e-6).mean() > 0.97 and (new.classes[near] == ID["car"]).mean() > 0.97


def test_what_no_edit_touches_stays_bit_for_bit() -> None:
    boxes = {"a": standing(10.0), "b": standing(25.0, 6.0)}
    old, new, _ = changed(boxes, "- remove: {ids: [b]}", {})
    order = np.round(new.dt_s / 1e-6).astype(int)
    far = np.linalg.norm(old.xyz[order][:, :2] - [25, 6], axis=1) > 3
    for one, other in ((new.xyz, old.xyz), (new.intensity, old.intensity)):
        assert np.array_equal(one[far], other[order][far])
