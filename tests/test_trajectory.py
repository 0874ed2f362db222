"""Trajectories: which left, exact distances on a curve, side cameras, a standing car."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
from refusals import refused

from mudg.base import geometry
from mudg.base.errors import UsageError
from mudg.base.types import Camera, EgoPath, Frame, Ref, Scene, Source, View
from mudg.core import trajectory

RADIUS_M = 30.0
YAWS = {"front": 0.0, "left": 1.0, "back": math.pi}


def drive(poses: list[np.ndarray], cameras: dict[str, float] = YAWS) -> Scene:
    """A scene without files: cameras mounted 1 m ahead and 1.5 m up, turned left by the given yaw."""
    times = np.arange(len(poses)) * 0.1
    mounted = {name: Camera(name, 64, 48, 50.0, 50.0, 32.0, 24.0) for name in cameras}
    frames = []
    for name, yaw in cameras.items():
        ego_from_cam = geometry.yaw_matrix(yaw, (1.0, 0.0, 1.5)) @ geometry.invert(geometry.CAM_FROM_EGO_AXES)
        for index, pose in enumerate(poses):
            view = View(mounted[name], pose @ ego_from_cam, times[index])
            frames.append(Frame(f"{name}/{index:06d}", view, Ref(f"images/{name}/{index}.png")))
    path = EgoPath(times, np.stack(poses))
    return Scene("drive", ".", mounted, tuple(frames), (), (), path, {}, Source("test", "none"))


def circle(count: int = 20) -> Scene:
    """A left turn of 30 m radius about (0, 30), heading along the tangent."""
    angles = np.linspace(0, 1.2, count)
    return drive([geometry.yaw_matrix(a, (RADIUS_M * math.sin(a), RADIUS_M * (1 - math.cos(a)), 0.3)) for a in angles])


def move(scene: Scene, camera: str, shift_m: float, index: int) -> np.ndarray:
    """How a shift moves a view."""
    views = trajectory.shifted(scene, camera, shift_m).views, trajectory.recorded(scene, camera).views
    return views[0][index].center_world - views[1][index].center_world


@pytest.mark.parametrize("camera", list(YAWS))
@pytest.mark.parametrize("shift_m", [2.0, -2.5])
def test_every_camera_moves_by_the_distance_to_the_left_of_travel(camera, shift_m):
    """Left of a left turn is inside: the radius of the circle shrinks by exactly the shift, at every frame."""
    scene = circle()
    path = scene.ego.world_from_ego[:, :3, 3]
    before, after = trajectory.recorded(scene, camera).views, trajectory.shifted(scene, camera, shift_m).views
    for index, (old, new) in enumerate(zip(before, after)):
        move = new.center_world - old.center_world
        assert np.linalg.norm(move) == pytest.approx(abs(shift_m), abs=1e-12) and move[2] == 0.0
        inside = path[index] + move - (0.0, RADIUS_M, 0.0)
        assert np.hypot(*inside[:2]) == pytest.approx(RADIUS_M - shift_m, abs=1e-9)
        if 0 < index < len(path) - 1:
            tangent = path[index + 1] - path[index - 1]
            assert np.cross(tangent, move)[2] * shift_m > 0  # counter-clockwise of travel = left
            assert abs(tangent @ move) < 1e-3 * np.linalg.norm(tangent) * abs(shift_m)
        assert np.array_equal(new.world_from_cam[:3, :3], old.world_from_cam[:3, :3])


TILT = np.eye(4)
TILT[1:3, 1:3] = [[math.cos(0.2), -math.sin(0.2)], [math.sin(0.2), math.cos(0.2)]]
DRIVES = {
    "a side camera, whose x axis lies along the road": (
        drive([geometry.yaw_matrix(0.0, (float(i), 0.0, 0.0)) for i in range(3)], {"side": math.pi / 2}),
        *("side", 2.0, [0, 2, 0]),
    ),
    "standing": (
        drive([geometry.yaw_matrix(0.7, (5.0, 1.0, 0.0))] * 4),
        *("front", 3.0, [-3 * math.sin(0.7), 3 * math.cos(0.7), 0]),
    ),
    "reversing": (
        drive([geometry.yaw_matrix(0.0, (-float(i), 0.0, 0.0)) for i in range(4)]),
        *("front", 1.0, [0, 1, 0]),
    ),
    "a banked road": (drive([TILT] * 2), "front", 2.0, [0, 2, 0]),
}


@pytest.mark.parametrize("name", DRIVES)
def test_a_shift_goes_to_the_vehicles_left_and_is_level(name):
    scene, camera, shift_m, expected = DRIVES[name]
    assert move(scene, camera, shift_m, 1).tolist() == pytest.approx(expected)


def test_names_and_errors_in_words():
    scene = circle(3)
    paths = (trajectory.recorded(scene, "front"), *(trajectory.shifted(scene, "front", m) for m in (2.0, -4.0)))
    assert [path.name for path in paths] == ["front_recorded", "front_shift+2.0", "front_shift-4.0"]
    assert paths[2].origin == "shifted"
    scene = circle(3)
    refused("no camera named 'rear'", trajectory.recorded, scene, "rear", raises=UsageError)
    refused("shift_m", trajectory.shifted, scene, "front", math.nan, raises=UsageError)
    side = np.eye(4)
    side[:3, :3] = [[1, 0, 0], [0, 0, -1], [0, 1, 0]]
    refused("left axis is vertical", trajectory.shifted, drive([side]), "front", 1.0)
    cut = dataclasses.replace(circle(12), ego=scene.ego)
    refused("no ego pose", trajectory.shifted, cut, "front", 1.0)


def test_poses_while_a_rolling_shutter_reads():
    """10 m/s straight on and 0.04 s of readout: 0.2 m behind and ahead of the view, also at both ends of the drive."""
    scene = drive([geometry.yaw_matrix(0.3, (1.0 * k, 0.0, 0.0)) for k in range(4)])
    for index in (0, 1, 3):
        view = trajectory.recorded(scene, "left").views[index]
        rolling = View(dataclasses.replace(view.camera, readout_s=0.04), view.world_from_cam, view.time_s)
        first, last = trajectory.readout_poses(scene.ego, rolling)
        np.testing.assert_allclose(first[:3, 3], view.center_world - [0.2, 0, 0], atol=1e-12)
        np.testing.assert_allclose(last[:3, 3], view.center_world + [0.2, 0, 0], atol=1e-12)
        np.testing.assert_allclose(first[:3, :3], view.world_from_cam[:3, :3], atol=1e-12)
        still, same = trajectory.readout_poses(scene.ego, view)
        np.testing.assert_allclose(still, view.world_from_cam, atol=1e-12)
        np.testing.assert_allclose(same, view.world_from_cam, atol=1e-12)
    refused("ego pose", trajectory.readout_poses, scene.ego, View(view.camera, view.world_from_cam, 9.0))


def test_a_lane_change_and_a_faster_drive_follow_the_axes_of_the_first_frame():
    """On a circle that begins along x: left is y and ahead is x at the first frame, whatever the heading later."""
    scene = circle()
    before = trajectory.recorded(scene, "left").views
    moves = {"lane+0.1": (0, 0.1, 0), "lane-0.1": (0, -0.1, 0), "speed+0.1": (0.1, 0, 0), "speed-0.25": (-0.25, 0, 0)}
    for name, direction in moves.items():
        path = trajectory.named(scene, "left", name)
        assert (path.name, path.origin) == (f"left_{name}", "shifted")
        for number, (old, new) in enumerate(zip(before, path.views, strict=True)):
            assert np.allclose(new.center_world - old.center_world, np.multiply(number, direction), atol=1e-12)
            assert np.array_equal(new.world_from_cam[:3, :3], old.world_from_cam[:3, :3]) and new.time_s == old.time_s


@pytest.mark.parametrize("name", ["", "up", "up1", "lane+", "lane+1e3", "shift+2", "up+1.", "up+1 "])
def test_a_malformed_path_is_refused(name):
    refused("malformed name of a path", trajectory.named, circle(), "front", name, raises=UsageError)


def test_velocity_is_that_between_poses_and_goes_on_outside() -> None:
    poses = [geometry.yaw_matrix(0.0, (x, 0.0, 0.0)) for x in (0.0, 1.0, 3.0)]
    path = EgoPath(np.array([0.0, 0.1, 0.2]), np.stack(poses))
    for time_s, expected in ((-1.0, 10.0), (0.05, 10.0), (0.15, 20.0), (9.0, 20.0)):
        assert trajectory.velocity(path, time_s) == pytest.approx((expected, 0.0, 0.0))
    alone = EgoPath(np.array([0.0]), np.stack(poses[:1]))
    assert trajectory.velocity(alone, 0.0) == (0.0, 0.0, 0.0)
