"""Types refuse what cannot be and name the place."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch

from mudg.base import palette, seeds
from mudg.base.errors import InputError
from mudg.base.types import (
    Camera,
    Clip,
    Condition,
    EgoPath,
    Gaussians,
    Observation,
    PointCloud,
    Ref,
    Scene,
    Source,
    Sweep,
    SweepPoints,
    Track,
    View,
)

CAMERA = Camera("front", 8, 6, 5.0, 5.0, 4.0, 3.0)
VIEW = View(CAMERA, np.eye(4), 0.0)


@pytest.mark.parametrize(
    ("field", "value", "word"),
    [
        ("fx", 0.0, "focal"),
        ("fy", -1.0, "focal"),
        ("width", 0, "size"),
        ("cx", float("nan"), "finite"),
        ("cx", 1e4, "principal"),
        ("readout_s", -1.0, "readout"),
    ],
)
def test_camera_refuses(field: str, value: float, word: str) -> None:
    with pytest.raises(InputError, match=word):
        dataclasses.replace(CAMERA, **{field: value})


def test_view_refuses_nan_and_copies_its_pose() -> None:
    with pytest.raises(InputError, match="front"):
        View(CAMERA, np.full((4, 4), np.nan), 0.0)
    pose = np.eye(4)
    view = View(CAMERA, pose, 0.0)
    pose[0, 3] = 7
    assert view.world_from_cam[0, 3] == 0
    with pytest.raises(ValueError, match="read-only"):
        view.world_from_cam[0, 3] = 1


def test_track_refuses_unsorted_times_and_flat_boxes() -> None:
    poses = np.stack([np.eye(4), np.eye(4)])
    with pytest.raises(InputError, match="increasing"):
        Track("a", "car", np.ones(3), np.array([1.0, 1.0]), poses)
    with pytest.raises(InputError, match="positive"):
        Track("a", "car", np.array([1.0, 0, 1]), np.array([0.0, 1.0]), poses)
    with pytest.raises(InputError, match="at least one"):
        Track("a", "car", np.ones(3), np.zeros(0), np.zeros((0, 4, 4)))


def test_a_pose_that_is_not_rigid_is_named_with_owner_field_and_place() -> None:
    good, mirrored = np.eye(4), np.diag([1.0, -1.0, 1.0, 1.0])
    makers = {
        "view of 'front': world_from_cam": lambda: View(CAMERA, mirrored, 0.0),
        "sweep 'top/1': world_from_lidar": lambda: Sweep("top/1", "top", 0.0, 2 * good, Ref("a")),
        "track 'a': world_from_object[1]": lambda: Track("a", "car", np.ones(3), [0.0, 1.0], [good, mirrored]),
        "ego path: world_from_ego[2]": lambda: EgoPath([0.0, 1.0, 2.0], [good, good, np.full((4, 4), np.nan)]),
    }
    for where, make in makers.items():
        with pytest.raises(InputError, match="not a rigid motion") as caught:
            make()
        assert caught.value.where == where
    with pytest.raises(InputError, match="do not pair up"):
        EgoPath([0.0, 1.0], [good])


def test_point_arrays_are_checked() -> None:
    with pytest.raises(InputError, match="rgb"):
        PointCloud(np.zeros((3, 3), np.float32), np.zeros((2, 3), np.uint8), "world")
    with pytest.raises(InputError, match="xyz"):
        SweepPoints(np.zeros((3, 3)), np.zeros(3, np.float32), np.zeros(3, np.float32))


def test_tensor_types_check_shapes() -> None:
    t, h, w = 2, 6, 8
    condition = Condition(
        (VIEW, VIEW),
        torch.zeros(t, 3, h, w),
        torch.zeros(t, 1, h, w),
        torch.zeros(t, 1, h, w, dtype=torch.bool),
        torch.zeros(3, h, w),
    )
    Clip(
        condition,
        torch.zeros(t, 3, h, w),
        torch.zeros(t, 1, h, w),
        torch.ones(t, 1, h, w, dtype=torch.bool),
        torch.zeros(t, h, w, dtype=torch.long),
    )
    with pytest.raises(InputError, match="clip.depth"):
        Clip(
            condition,
            torch.zeros(t, 3, h, w),
            torch.zeros(t, 3, h, w),
            torch.ones(t, 1, h, w, dtype=torch.bool),
            torch.zeros(t, h, w, dtype=torch.long),
        )
    with pytest.raises(InputError, match="observation.rgb"):
        Observation(
            VIEW,
            torch.zeros(3, 5, 8),
            None,
            None,
            torch.ones(1, 6, 8),
            torch.ones(1, 6, 8, dtype=torch.bool),
            "virtual",
            "x",
        )
    n = 3
    with pytest.raises(InputError, match="gaussians.quats"):
        Gaussians(
            torch.zeros(n, 3),
            torch.zeros(n, 3),
            torch.zeros(n, 3),
            torch.zeros(n),
            torch.zeros(n, 1, 3),
            None,
            torch.zeros(n),
        )


def test_scene_look_ups_name_what_there_is() -> None:
    ego = EgoPath(np.array([0.0]), np.eye(4)[None])
    scene = Scene("s", "/nowhere", {"front": CAMERA}, (), (), (), ego, {}, Source("x", "y"))
    with pytest.raises(InputError, match="front"):
        scene.frames_of("rear")
    with pytest.raises(InputError, match="track"):
        scene.track("7")
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
    assert len(keys) == 75
    assert seeds.key(1, 23, "a") != seeds.key(12, 3, "a")
    assert seeds.numpy_rng(3, 4, "x").random() == seeds.numpy_rng(3, 4, "x").random()
    a = torch.randn(4, generator=seeds.torch_generator(3, 4, "x"))
    b = torch.randn(4, generator=seeds.torch_generator(3, 4, "x"))
    assert torch.equal(a, b)
