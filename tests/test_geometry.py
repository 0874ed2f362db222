"""Rigid motions and the one projection: group axioms as properties, known pixels, inverse."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mudg.base import geometry
from mudg.base.errors import InputError
from mudg.base.types import Camera, View

finite = st.floats(-50, 50, allow_nan=False)
quaternions = st.tuples(*[st.floats(-1, 1)] * 4).filter(lambda q: np.linalg.norm(q) > 0.1)
poses = st.builds(
    lambda q, t: geometry.from_rotation_translation(geometry.matrix_from_quaternion(q), t),
    quaternions,
    st.tuples(finite, finite, finite),
)
CAMERA = Camera("front", 480, 320, 400.0, 410.0, 241.0, 158.5)


@given(poses, poses, poses)
@settings(max_examples=50, deadline=None)
def test_rigid_motions_form_a_group(a: np.ndarray, b: np.ndarray, c: np.ndarray) -> None:
    assert geometry.rigid_problem(a @ b) is None
    np.testing.assert_allclose((a @ b) @ c, a @ (b @ c), atol=1e-9)
    np.testing.assert_allclose(a @ geometry.invert(a), np.eye(4), atol=1e-9)
    np.testing.assert_allclose(geometry.invert(a @ b), geometry.invert(b) @ geometry.invert(a), atol=1e-9)


@given(poses)
@settings(max_examples=100, deadline=None)
def test_quaternion_round_trip(pose: np.ndarray) -> None:
    back = geometry.matrix_from_quaternion(geometry.quaternion_from_matrix(pose))
    np.testing.assert_allclose(back, pose[:3, :3], atol=1e-9)


@given(poses, poses, st.floats(0, 1))
@settings(max_examples=100, deadline=None)
def test_slerp_moves_at_constant_rate_between_both_ends(a: np.ndarray, b: np.ndarray, u: float) -> None:
    q0, q1 = geometry.quaternion_from_matrix(a), geometry.quaternion_from_matrix(b)
    q = geometry.slerp(q0, q1, u)
    assert abs(np.linalg.norm(q) - 1) < 1e-9

    def angle(x: np.ndarray, y: np.ndarray) -> float:
        r = geometry.matrix_from_quaternion(x).T @ geometry.matrix_from_quaternion(y)
        return float(2 * np.arcsin(min(1.0, np.linalg.norm(r - np.eye(3)) / np.sqrt(8))))

    whole = angle(q0, q1)
    if whole < np.pi - 1e-3:
        assert abs(angle(q0, q) - u * whole) < 1e-5 and abs(angle(q, q1) - (1 - u) * whole) < 1e-5
    np.testing.assert_allclose(geometry.matrix_from_quaternion(geometry.slerp(q0, q1, 1.0)), b[:3, :3], atol=1e-7)


def test_slerp_takes_the_shorter_arc_and_a_zero_quaternion_is_refused() -> None:
    q = np.array([np.cos(0.1), np.sin(0.1), 0, 0])
    np.testing.assert_allclose(geometry.slerp([1, 0, 0, 0], -q, 0.5), [np.cos(0.05), np.sin(0.05), 0, 0], atol=1e-12)
    with pytest.raises(InputError):
        geometry.matrix_from_quaternion([0, 0, 0, 0])


def test_known_pixel_and_axes_and_a_resized_camera_keeps_the_rays() -> None:
    world_from_cam = geometry.invert(geometry.CAM_FROM_EGO_AXES)
    view = View(CAMERA, world_from_cam, 0.0)
    uv, z = geometry.project(view, np.array([[10.0, 0, 0], [10, -1, 0], [10, 0, -1], [-5, 0, 0]]))
    np.testing.assert_allclose(z, [10, 10, 10, -5])
    np.testing.assert_allclose(uv[:3], [[241, 158.5], [281, 158.5], [241, 199.5]])
    assert np.isnan(uv[3]).all()
    small = CAMERA.resized(240, 80)
    big, little = View(CAMERA, np.eye(4), 0.0), View(small, np.eye(4), 0.0)
    points = np.array([[1.0, -2, 9], [-3, 1, 20]])
    np.testing.assert_allclose(geometry.project(big, points)[0] * [0.5, 0.25], geometry.project(little, points)[0])


@given(poses, st.lists(st.tuples(st.floats(0, 480), st.floats(0, 320), st.floats(0.5, 80)), min_size=1, max_size=20))
@settings(max_examples=60, deadline=None)
def test_unproject_inverts_project(pose: np.ndarray, pixels: list[tuple[float, float, float]]) -> None:
    view = View(CAMERA, pose, 0.0)
    uvz = np.array(pixels)
    uv, z = geometry.project(view, geometry.unproject(view, uvz[:, :2], uvz[:, 2]))
    np.testing.assert_allclose(uv, uvz[:, :2], atol=1e-6)
    np.testing.assert_allclose(z, uvz[:, 2], atol=1e-8)


def test_pose_at_is_exact_at_keys_interpolates_both_neighbours_and_never_extrapolates() -> None:
    times = np.array([0.0, 1.0, 2.0])
    at = ((0.0, (0, 0, 0)), (0.4, (2, 0, 0)), (1.0, (2, 4, 0)))
    keys = np.stack([geometry.yaw_matrix(*one) for one in at])
    assert geometry.pose_at(times, keys, -0.01) is None and geometry.pose_at(times, keys, 2.01) is None
    np.testing.assert_array_equal(geometry.pose_at(times, keys, 1.0), keys[1])
    middle = geometry.pose_at(times, keys, 1.5)
    np.testing.assert_allclose(middle, geometry.yaw_matrix(0.7, (2, 2, 0)), atol=1e-12)
    assert geometry.yaw_of(middle) == pytest.approx(0.7)


@pytest.mark.parametrize(
    ("matrix", "word"),
    [
        (np.eye(3), "shape"),
        (np.full((4, 4), np.nan), "NaN"),
        (np.diag([1, 1, -1, 1.0]), "reflection"),
        (np.diag([2.0, 2, 2, 1]), "orthonormal"),
        (np.eye(4) + np.eye(4, k=-3), "last row"),
    ],
)
def test_rigid_problem_names_the_fault(matrix: np.ndarray, word: str) -> None:
    assert word in str(geometry.rigid_problem(matrix))
    if matrix.shape == (4, 4):
        assert geometry.all_rigid(np.stack([np.eye(4)] * 3)) and not geometry.all_rigid(np.stack([np.eye(4), matrix]))


def test_hull_of_a_box_is_cut_at_the_near_plane_and_none_beside_the_image() -> None:
    view = View(Camera("c", 100, 80, 60.0, 60.0, 50.0, 40.0), geometry.invert(geometry.CAM_FROM_EGO_AXES), 0.0)
    size_m = [4.0, 2.0, 1.5]
    ahead = geometry.yaw_matrix(0.7, (12.0, 1.0, 0.2))
    hull = geometry.box_hull(view, ahead, size_m)
    uv, _ = geometry.project(view, geometry.transform_points(ahead, geometry.box_corners(size_m)))
    assert hull is not None and len(hull.points) == 8
    assert (hull.equations[:, :2] @ uv.T + hull.equations[:, 2:] < 1e-9).all()  # no corner outside
    cut = geometry.box_hull(view, geometry.yaw_matrix(0.0, (1.0, 0.0, 0.0)), size_m, near_m=0.5)
    assert cut is not None and len(cut.points) == 8  # four corners ahead, four crossings
    assert np.abs(cut.points[4:] - [50, 40]).max() == pytest.approx(60 * 1.0 / 0.5)
    for place in ((-9.0, 0.0, 0.0), (5.0, 80.0, 0.0)):
        assert geometry.box_hull(view, geometry.yaw_matrix(0.0, place), size_m) is None
