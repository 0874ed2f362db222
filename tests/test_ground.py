"""The ground plane, and the map of what is reachable from the driven path: known streets, tilted, noisy, with and
without kerbs."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from mudg.base.geometry import yaw_matrix
from mudg.labels.evidence import CELL_M, distance_to_path, driven_path, fit_ground, ground_near, map_ground

KERB_AT_M = 4.0


def street(
    rng: np.random.Generator, kerb_m: float = 0.12, slope: tuple[float, float] = (0.0, 0.0), count: int = 60_000
) -> tuple[NDArray[np.float32], NDArray[np.float64]]:
    """Returns of a straight street along x, sidewalks from 4 m on both sides, walls at 9 m; and the path along its
    middle."""
    flat = np.c_[rng.uniform(-30, 30, count), rng.uniform(-9, 9, count)]
    z = np.where(np.abs(flat[:, 1]) > KERB_AT_M, kerb_m, 0) + rng.normal(0, 0.015, count)
    wall = np.c_[rng.uniform(-30, 30, count // 4), np.full(count // 4, 9.0), rng.uniform(0, 6, count // 4)]
    xyz = np.concatenate([np.c_[flat, z], wall])
    xyz[:, 2] += xyz[:, :2] @ slope
    x = np.arange(-10.0, 10, 0.5)
    return xyz.astype(np.float32), np.c_[x, np.zeros_like(x), x * slope[0]]


@pytest.mark.parametrize("slope", [(0.0, 0.0, -1.7), (0.05, -0.03, 0.4), (-0.12, 0.02, 2.0)])
def test_ground_plane_is_found_among_walls_and_noise(slope: tuple[float, float, float]) -> None:
    rng = np.random.default_rng(0)
    flat = rng.uniform(-30, 30, (6000, 2))
    ground = np.c_[flat, flat @ slope[:2] + slope[2] + rng.normal(0, 0.02, 6000)]
    wall = np.c_[np.full(3000, 12.0), rng.uniform(-20, 20, 3000), rng.uniform(0, 8, 3000) + 12 * slope[0] + slope[2]]
    plane = fit_ground(np.concatenate([ground, wall]).astype(np.float32), np.zeros((3, 3)))
    assert plane is not None and np.abs(plane - slope).max() < 0.02


def test_no_ground_is_no_plane_and_no_path_or_returns_no_map() -> None:
    assert fit_ground(np.zeros((0, 3), np.float32), np.zeros((1, 3))) is None
    cliff = np.random.default_rng(0).uniform(0, 30, (4000, 3))
    cliff[:, 2] = 1.5 * cliff[:, 0]
    assert fit_ground(cliff, np.array([[15.0, 15, 0]])) is None
    xyz, path = street(np.random.default_rng(9))
    assert map_ground(xyz[:0], path, path[0]) is None and map_ground(xyz, path[:0], path[0]) is None


def test_ground_is_found_at_the_end_of_a_long_drive() -> None:
    xyz, path = street(np.random.default_rng(3))
    behind = path[:1] - np.c_[np.arange(500.0, 0, -5), np.zeros((100, 2))]
    here = path[0]
    near, long = ground_near(xyz, path, here), ground_near(xyz, np.concatenate([behind, path]), here)
    assert near is not None and long == pytest.approx(near)


def test_distance_to_path_goes_on_beyond_its_ends_and_along_the_heading_of_what_stood() -> None:
    path = np.c_[np.arange(0, 10, 0.5), np.zeros(20), np.zeros(20)]
    points = np.array([[5.0, 3, 9], [40, -4, 0], [-30, 2, 0]])
    assert np.abs(distance_to_path(points, path) - [3, 4, 2]).max() < 0.3
    assert distance_to_path(points, path[:1])[1] == pytest.approx(np.hypot(40, 4))
    pose = yaw_matrix(np.pi / 2, (3.0, 4.0, 1.0))
    path = driven_path(np.stack([pose, pose]))
    assert distance_to_path(np.array([[3.0, 59, 0], [8, 5, 0]]), path) == pytest.approx([0, 5], abs=0.3)
    moved = np.stack([pose, yaw_matrix(0, (9.0, 4.0, 1.0))])
    assert (driven_path(moved) == moved[:, :3, 3]).all() and len(driven_path(np.zeros((0, 4, 4)))) == 0


@pytest.mark.parametrize("slope", [(0.0, 0.0), (0.06, -0.02)])
def test_the_road_is_joined_to_the_path_and_the_sidewalk_is_not(slope: tuple[float, float]) -> None:
    xyz, path = street(np.random.default_rng(5), slope=slope)
    ground = map_ground(xyz, path, path[0])
    places = np.random.default_rng(6).uniform((-25, -8.5), (25, 8.5), (4000, 2))
    places = np.c_[places, places @ slope + np.where(np.abs(places[:, 1]) > KERB_AT_M, 0.12, 0)]
    reachable, _, raised = ground.under(places)
    from_kerb = np.abs(places[:, 1]) - KERB_AT_M
    assert reachable[from_kerb < -2 * CELL_M].mean() > 0.98 and reachable[from_kerb > 2 * CELL_M].mean() < 0.02
    beyond = (from_kerb > 2 * CELL_M) & (from_kerb < 2)
    assert np.median(raised[beyond]) == pytest.approx(0.12, abs=0.05 + 3 * abs(slope[1]))
    assert np.median(raised[from_kerb < -3]) < 0.06


def test_without_a_kerb_all_is_joined_and_walls_are_no_ground() -> None:
    xyz, path = street(np.random.default_rng(7), kerb_m=0.0)
    ground = map_ground(xyz, path, path[0])
    assert ground is not None and ground.under(np.array([[5.0, 7, 0], [-20, -7, 0]]))[0].all()
    reachable, _, raised = ground.under(np.array([[5.0, 7, 3], [500, 0, 0], [np.nan, 0, 0]]))
    assert not reachable.any() and (raised == 0).all()


def test_a_vehicle_that_stood_and_sees_no_ground_around_it_is_joined_to_what_it_sees() -> None:
    xyz, path = street(np.random.default_rng(8))
    here = path[:1]
    seen = xyz[np.linalg.norm(xyz[:, :2] - here[:, :2], axis=1) > 3.5]
    ground = map_ground(seen, here, here[0])
    reachable, _, _ = ground.under(np.array([[here[0, 0] + 8, 0.5, 0], [here[0, 0] + 8, 6.5, 0.12]]))
    assert reachable.tolist() == [True, False]


def test_a_lowered_kerb_joins_a_sidewalk_but_not_directly() -> None:
    xyz, path = street(np.random.default_rng(11))
    lowered = (np.abs(xyz[:, 0] - 10) < 1.5) & (xyz[:, 1] > 0) & (xyz[:, 2] < 0.5)
    xyz[lowered, 2] = np.clip(xyz[lowered, 1] - KERB_AT_M, 0, 2).astype(np.float32) * 0.06
    ground = map_ground(xyz, path, path[0])
    far, at_it, other_side, road = np.array([[-12, 6, 0.12], [10, 4.6, 0.04], [-12, -6, 0.12], [-12, 3, 0]], float)
    reachable, direct, _ = ground.under(np.stack([far, at_it, other_side, road]))
    assert reachable.tolist() == [True, True, False, True] and direct.tolist() == [False, True, False, True]
