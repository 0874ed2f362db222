"""Types refuse what cannot be and name the place."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch
from refusals import refused

from mudg.base import palette, seeds, types
from mudg.base.errors import UsageError
from mudg.base.types import Camera, EgoPath, Observation, PointCloud, SweepPoints, Track, View

CAMERA = Camera("front", 8, 6, 5.0, 5.0, 4.0, 3.0)
VIEW = View(CAMERA, np.eye(4), 0.0)


REFUSED = "fx 0 focal,fy -1 focal,width 0 size,cx nan finite,cx 1e4 principal,readout_s -1 readout"


@pytest.mark.parametrize("case", REFUSED.split(","))
def test_camera_refuses(case: str) -> None:
    field, value, word = case.split()
    refused(word, dataclasses.replace, CAMERA, **{field: float(value)})


def test_view_refuses_nan_and_copies_its_pose() -> None:
    refused("front", View, CAMERA, np.full((4, 4), np.nan), 0.0)
    pose = np.eye(4)
    view = View(CAMERA, pose, 0.0)
    pose[0, 3] = 7
    assert view.world_from_cam[0, 3] == 0
    with pytest.raises(ValueError, match="read-only"):
        view.world_from_cam[0, 3] = 1


def test_tracks_points_and_tensors_of_other_shapes_are_refused() -> None:
    poses = np.stack([np.eye(4), np.eye(4)])
    refused("increasing", Track, "a", "car", np.ones(3), np.array([1.0, 1.0]), poses)
    refused("positive", Track, "a", "car", np.array([1.0, 0, 1]), np.array([0.0, 1.0]), poses)
    refused("at least one", Track, "a", "car", np.ones(3), np.zeros(0), np.zeros((0, 4, 4)))
    refused("rgb", PointCloud, np.zeros((3, 3), np.float32), np.zeros((2, 3), np.uint8), "world")
    refused("xyz", SweepPoints, np.zeros((3, 3)), np.zeros(3, np.float32), np.zeros(3, np.float32))
    zeros = torch.zeros
    color, one, known = zeros(2, 3, 6, 8), zeros(2, 1, 6, 8), torch.ones(2, 1, 6, 8, dtype=torch.bool)
    condition = types.Condition((VIEW, VIEW), color, one, known, zeros(3, 6, 8))
    classes = zeros(2, 6, 8, dtype=torch.long)
    types.Clip(condition, color, one, known, classes)
    refused("clip.depth", types.Clip, condition, color, color, known, classes)
    shown = (zeros(3, 5, 8), None, None, torch.ones(1, 6, 8), known[0], "virtual", "x")
    refused("observation.rgb", Observation, VIEW, *shown)
    refused("gaussians.quats", types.Gaussians, *[zeros(3, 3)] * 3, zeros(3), zeros(3, 1, 3), None, zeros(3))


def test_a_pose_that_is_not_rigid_is_named_with_owner_field_and_place() -> None:
    good, mirrored = np.eye(4), np.diag([1.0, -1.0, 1.0, 1.0])
    makers = {
        "view of 'front': world_from_cam": lambda: View(CAMERA, mirrored, 0.0),
        "sweep 'top/1': world_from_lidar": lambda: types.Sweep("top/1", "top", 0.0, 2 * good, types.Ref("a")),
        "track 'a': world_from_object[1]": lambda: Track("a", "car", np.ones(3), [0.0, 1.0], [good, mirrored]),
        "ego path: world_from_ego[2]": lambda: EgoPath([0.0, 1.0, 2.0], [good, good, np.full((4, 4), np.nan)]),
    }
    for where, make in makers.items():
        assert refused("not a rigid motion", make).where == where
    refused("do not pair up", EgoPath, [0.0, 1.0], [good])


def test_scene_look_ups_name_what_there_is() -> None:
    ego = EgoPath(np.array([0.0]), np.eye(4)[None])
    scene = types.Scene("s", "/nowhere", {"front": CAMERA}, (), (), (), ego, {}, types.Source("x", "y"))
    refused("front", scene.frames_of, "rear")
    refused("track", scene.track, "7")
    with pytest.raises(TypeError):
        scene.cameras["rear"] = CAMERA


def test_palette_round_trip_and_margin() -> None:
    ids = np.arange(19, dtype=np.uint8).reshape(1, 19)
    back, margin = palette.decode(palette.encode(ids))
    np.testing.assert_array_equal(back, ids)
    assert margin.min() == pytest.approx(50.5, abs=0.1)  # road and pole, the closest pair of the published table
    assert tuple(palette.encode(np.array([0, 18, 255]))[0]) == (255, 120, 50)
    assert tuple(palette.encode(np.array([255]))[0]) == (0, 0, 0)
    assert len(set(map(tuple, palette.COLORS.tolist()))) == 19


def test_seeds_depend_on_every_argument_and_repeat() -> None:
    keys = {seeds.key(r, s, p) for r in range(5) for s in range(5) for p in ("view", "noise", "n")}
    assert len(keys) == 75 and seeds.key(1, 23, "a") != seeds.key(12, 3, "a")
    assert seeds.numpy_rng(3, 4, "x").random() == seeds.numpy_rng(3, 4, "x").random()
    a = torch.randn(4, generator=seeds.torch_generator(3, 4, "x"))
    b = torch.randn(4, generator=seeds.torch_generator(3, 4, "x"))
    assert torch.equal(a, b)


def test_a_camera_of_a_field_of_view_sees_just_that_angle() -> None:
    camera = Camera.from_fov("a", 640, 480, 90.0)
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == pytest.approx((320.0, 320.0, 320.0, 240.0))
    for wrong in (0.0, 180.0, float("nan")):
        refused("field of view", Camera.from_fov, "a", 640, 480, wrong, raises=UsageError)
