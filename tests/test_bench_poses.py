"""The bench of poses: what it disturbs, what it takes as an error, what it reports."""

import math

import numpy as np
import pytest

from mudg.base import geometry
from mudg.base.types import Track
from mudg.benchmarks import cities as bench_poses
from mudg.benchmarks.cities import NOISE_M, NOISE_RAD, disturbed, pose_errors


def tracks(count: int = 6, keys: int = 60) -> tuple[Track, ...]:
    times = 0.1 * np.arange(keys)
    path = np.stack([geometry.yaw_matrix(0.1 * t, (5 * t, 0.2 * t * t, 1.0)) for t in times])
    return tuple(Track(f"car-{n:03d}", "car", [4.0, 2.0, 1.5], times, path) for n in range(count))


def moves(kind: str) -> list[np.ndarray]:
    return [
        geometry.invert(a.world_from_object) @ b.world_from_object
        for a, b in zip(tracks(), disturbed(tracks(), kind, 0))
    ]


@pytest.mark.parametrize("kind", ["noise", "drift", "offset"])
def test_disturbances_have_the_size_they_say(kind):
    found = moves(kind)
    yaws = np.array([[geometry.yaw_of(m) for m in one] for one in found])
    places = np.stack([one[:, :3, 3] for one in found])
    few = kind != "noise"  # drift and offsets hold few independent draws
    assert places.std() == pytest.approx(NOISE_M, rel=0.35 if few else 0.05)
    assert yaws.std() == pytest.approx(NOISE_RAD, rel=0.6 if few else 0.1)
    steps = np.abs(np.diff(places, axis=1)).mean() / NOISE_M
    assert steps > 1.0 if kind == "noise" else steps < 0.3 if kind == "drift" else steps == pytest.approx(0, abs=1e-9)


def test_a_constant_motion_in_the_box_frame_is_no_error_and_the_rest_is():
    truth = tracks(1)[0].world_from_object
    shifted = truth @ geometry.yaw_matrix(0.3, (0.5, -0.2, 0.1))
    assert pose_errors(truth, shifted) == pytest.approx((0, 0), abs=1e-9)
    absolute = pose_errors(truth, shifted, free=False)
    assert absolute == pytest.approx((math.sqrt(0.25 + 0.04 + 0.01), 0.3), abs=1e-9)
    sway = np.stack([geometry.yaw_matrix(0.02 * (-1) ** n, (0.1 * (-1) ** n, 0, 0)) for n in range(60)])
    position_m, yaw_rad = pose_errors(truth, truth @ geometry.yaw_matrix(0.3) @ sway)
    assert position_m == pytest.approx(0.1, rel=1e-2) and yaw_rad == pytest.approx(0.02, rel=1e-3)


def test_the_summary_pools_keys_and_says_what_was_recovered():
    one = {
        "keys": 10,
        **{
            f"{when}{how}_{unit}": 0.2 if when == "before" else 0.1
            for when in ("before", "after")
            for how in ("", "_absolute")
            for unit in ("m", "rad")
        },
    }
    rows = [{"boxes": "noise", "poses": "learnt", "objects": [one, {**one, "keys": 30}], "psnr_moving": 20.0}]
    (found,) = bench_poses.summary(rows)
    assert found["recovered_m"] == pytest.approx(0.5)
    assert found["keys"] == 40
    text = bench_poses.table({"cities": [1], "iterations": 3, "summary": [found]})
    assert "| noise | learnt | 2 | 0.200 | 0.100 | 50% |" in text


def test_lists_do_not_meet():
    assert not set(bench_poses.LISTS["development"]) & set(bench_poses.LISTS["reported"])
