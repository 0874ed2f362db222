"""Rigid motions and the one pinhole projection of the package.

Conventions, stated once:

* Metres, seconds, radians, pixels. World: right-handed, z up. Ego and objects: x forward, y left, z up.
* Camera axes as in OpenCV: x right, y down, z forward. The centre of the top-left pixel is (0.5, 0.5).
* ``a_from_b`` is a 4x4 matrix that maps b-coordinates to a-coordinates. Quaternions are (w, x, y, z).
* Poses are float64 numpy; computation on them happens elsewhere in float32 torch.
* Depth is camera z, not the length of the ray.
* A positive lateral shift is to the left of the direction of travel.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mudg.base.errors import InputError

if TYPE_CHECKING:
    from scipy.spatial import ConvexHull

    from mudg.base.types import Camera, View

Matrix = NDArray[np.float64]

CAM_FROM_EGO_AXES: Matrix = np.array([[0.0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]])
CAM_FROM_EGO_AXES.setflags(write=False)


def rigid_problem(transform: ArrayLike, tolerance: float = 1e-4) -> str | None:
    """Say why ``transform`` is not a rigid 4x4 motion within ``tolerance``, or return None if it is one."""
    matrix = np.asarray(transform)
    if matrix.shape != (4, 4):
        return f"shape {matrix.shape} instead of (4, 4)"
    if not np.issubdtype(matrix.dtype, np.number) or np.iscomplexobj(matrix):
        return f"dtype {matrix.dtype} instead of a real number type"
    if not np.isfinite(matrix).all():
        return "contains NaN or infinity"
    if np.abs(matrix[3] - [0, 0, 0, 1]).max() > tolerance:
        return f"last row is {matrix[3].tolist()} instead of [0, 0, 0, 1]"
    rotation = matrix[:3, :3].astype(np.float64)
    with np.errstate(over="ignore", invalid="ignore"):  # 1e300 is no rotation either
        error = np.abs(rotation @ rotation.T - np.eye(3)).max()
    if not error <= tolerance:
        return f"rotation part is not orthonormal (largest deviation {error:.3g})"
    if np.linalg.det(rotation) < 0:
        return "rotation part is a reflection (determinant -1)"
    return None


def all_rigid(transforms: Matrix, tolerance: float = 1e-4) -> bool:
    """Whether every one of f64[N, 4, 4] is rigid: ``rigid_problem`` for many at once, without the reason."""
    rotation = transforms[:, :3, :3]
    if not np.isfinite(transforms).all() or (np.abs(transforms[:, 3] - [0, 0, 0, 1]) > tolerance).any():
        return False
    with np.errstate(over="ignore", invalid="ignore"):
        error = np.abs(rotation @ np.swapaxes(rotation, 1, 2) - np.eye(3))
    return bool((error <= tolerance).all()) and not (np.linalg.det(rotation) < 0).any()


def from_rotation_translation(rotation: ArrayLike, translation: ArrayLike) -> Matrix:
    """f64[4, 4] from a rotation [3, 3] and a translation [3] in metres."""
    matrix = np.eye(4)
    matrix[:3, :3] = rotation
    matrix[:3, 3] = translation
    return matrix


def invert(transform: Matrix) -> Matrix:
    """Inverse of rigid motions f64[..., 4, 4]."""
    rotation_t = np.swapaxes(transform[..., :3, :3], -1, -2)
    inverse = np.zeros_like(transform, dtype=np.float64)
    inverse[..., :3, :3] = rotation_t
    inverse[..., :3, 3] = -(rotation_t @ transform[..., :3, 3:])[..., 0]
    inverse[..., 3, 3] = 1.0
    return inverse


Floating = TypeVar("Floating", bound=np.floating)


def transform_points(a_from_b: Matrix, xyz_b: NDArray[Floating]) -> NDArray[Floating]:
    """Map points ``[N, 3]`` from frame b to frame a; computed in float64, returned in the dtype of the points."""
    mapped = xyz_b.astype(np.float64) @ a_from_b[:3, :3].T + a_from_b[:3, 3]
    return mapped.astype(xyz_b.dtype)


def quaternion_from_matrix(rotation: ArrayLike) -> Matrix:
    """Unit quaternion f64[4] (w, x, y, z) with w >= 0 of a rotation [3, 3] or a rigid motion [4, 4]."""
    r = np.asarray(rotation, np.float64)[:3, :3]
    x, y, z = np.diag(r)
    four_squares = np.array([1 + x + y + z, 1 + x - y - z, 1 - x + y - z, 1 - x - y + z])
    largest = int(four_squares.argmax())
    products = {
        0: (four_squares[0], r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]),
        1: (r[2, 1] - r[1, 2], four_squares[1], r[0, 1] + r[1, 0], r[0, 2] + r[2, 0]),
        2: (r[0, 2] - r[2, 0], r[0, 1] + r[1, 0], four_squares[2], r[1, 2] + r[2, 1]),
        3: (r[1, 0] - r[0, 1], r[0, 2] + r[2, 0], r[1, 2] + r[2, 1], four_squares[3]),
    }
    q = np.array(products[largest])
    q /= np.linalg.norm(q)
    return -q if q[0] < 0 else q


def matrix_from_quaternion(quaternion: ArrayLike) -> Matrix:
    """Rotation f64[3, 3] of a quaternion (w, x, y, z) of any length. InputError if it is zero or not finite."""
    q = np.asarray(quaternion, np.float64)
    norm = float(np.linalg.norm(q))
    if not np.isfinite(norm) or norm < 1e-12:
        raise InputError("a quaternion of length zero or not finite is no rotation", got=str(q.tolist()))
    w, x, y, z = q / norm
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def slerp(q0: ArrayLike, q1: ArrayLike, u: float) -> Matrix:
    """Spherical interpolation f64[4] of quaternions along the shorter arc; u = 0 gives q0, u = 1 gives q1 or -q1."""
    a = np.asarray(q0, np.float64) / np.linalg.norm(q0)
    b = np.asarray(q1, np.float64) / np.linalg.norm(q1)
    cosine = float(a @ b)
    if cosine < 0:
        b, cosine = -b, -cosine
    if cosine > 1 - 1e-9:
        q = a + u * (b - a)
        return q / np.linalg.norm(q)
    angle = np.arccos(min(cosine, 1.0))
    return (np.sin((1 - u) * angle) * a + np.sin(u * angle) * b) / np.sin(angle)


def interpolate_pose(a_from_b0: Matrix, a_from_b1: Matrix, u: float) -> Matrix:
    """Pose f64[4, 4] at fraction ``u`` in [0, 1] between two rigid poses: slerp of rotation, linear in translation."""
    rotation = matrix_from_quaternion(slerp(quaternion_from_matrix(a_from_b0), quaternion_from_matrix(a_from_b1), u))
    return from_rotation_translation(rotation, (1 - u) * a_from_b0[:3, 3] + u * a_from_b1[:3, 3])


def pose_at(times_s: NDArray[np.float64], poses: Matrix, time_s: float, tolerance_s: float = 1e-6) -> Matrix | None:
    """Interpolate pose keys f64[T, 4, 4] at ``time_s``; exact at the keys, None outside their span."""
    if len(times_s) == 0 or time_s < times_s[0] - tolerance_s or time_s > times_s[-1] + tolerance_s:
        return None
    after = int(np.searchsorted(times_s, time_s))
    for near in (after, after - 1):
        if 0 <= near < len(times_s) and abs(times_s[near] - time_s) <= tolerance_s:
            return poses[near]
    before = after - 1
    u = (time_s - times_s[before]) / (times_s[after] - times_s[before])
    return interpolate_pose(poses[before], poses[after], float(u))


def yaw_matrix(yaw_rad: float, translation: ArrayLike = (0.0, 0.0, 0.0)) -> Matrix:
    """f64[4, 4]: a rotation about z (counter-clockwise seen from above), then a translation in metres."""
    c, s = np.cos(yaw_rad), np.sin(yaw_rad)
    return from_rotation_translation([[c, -s, 0], [s, c, 0], [0, 0, 1]], translation)


def yaw_of(world_from_object: Matrix) -> float:
    """Heading of the x axis in the ground plane, radians, counter-clockwise from world x."""
    return float(np.arctan2(world_from_object[1, 0], world_from_object[0, 0]))


def pinhole(intrinsics: Iterable[Any], x: Any, y: Any, z: Any) -> tuple[Any, Any]:
    """Pixels (u, v) of camera coordinates (arrays or tensors that broadcast, metres, z not 0): ``(fx x / z + cx, fy y /
    z + cy)``. intrinsics: ``Camera.intrinsics``. The one pinhole formula of the package; its twins are the native
    library's and ``core.project``'s, which repeats that one in float32."""
    fx, fy, cx, cy = intrinsics
    return fx * x / z + cx, fy * y / z + cy


def pinhole_ray(intrinsics: Iterable[Any], u: Any, v: Any) -> tuple[Any, Any]:
    """Inverse of ``pinhole`` up to depth: x / z and y / z of pixels (arrays or tensors)."""
    fx, fy, cx, cy = intrinsics
    return (u - cx) / fx, (v - cy) / fy


def pixel_rays(camera: Camera) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """x / z f64[W] of the pixel columns' centres and y / z f64[H] of the rows'."""
    return pinhole_ray(camera.intrinsics, np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)


def project(view: View, xyz_world: NDArray[np.floating]) -> tuple[Matrix, Matrix]:
    """Pinhole projection of world points ``[N, 3]`` in metres, without lens distortion (images are rectified on
    import).

    Returns ``uv`` f64[N, 2] pixels (the top-left pixel spans [0, 1) x [0, 1); NaN for points behind the camera) and
    depth ``z`` f64[N] metres.
    """
    camera = view.camera
    xyz_cam = transform_points(view.cam_from_world, np.asarray(xyz_world, np.float64))
    z = xyz_cam[:, 2]
    in_front = z > 0
    safe_z = np.where(in_front, z, 1.0)
    uv = np.stack(pinhole(camera.intrinsics, xyz_cam[:, 0], xyz_cam[:, 1], safe_z), 1)
    uv[~in_front] = np.nan
    return uv, z


def unproject(view: View, uv_px: NDArray[np.floating], depth_m: NDArray[np.floating]) -> Matrix:
    """Inverse of ``project``: pixels ``[N, 2]`` and depths ``[N]`` (camera z) to world points f64[N, 3]."""
    camera = view.camera
    uv, z = np.asarray(uv_px, np.float64), np.asarray(depth_m, np.float64)
    x, y = pinhole_ray(camera.intrinsics, uv[:, 0], uv[:, 1])
    xyz_cam = np.stack([x * z, y * z, z], 1)
    return transform_points(view.world_from_cam, xyz_cam)


def box_corners(size_m: ArrayLike) -> Matrix:
    """Corners f64[8, 3] of a box in its own frame; the bits of a corner's number: 4 = front, 2 = left, 1 = top."""
    signs = np.array([[i, j, k] for i in (-1, 1) for j in (-1, 1) for k in (-1, 1)]) / 2
    return signs * np.asarray(size_m, np.float64)


def box_hull(view: View, world_from_box: Matrix, size_m: ArrayLike, near_m: float = 0.3) -> ConvexHull | None:
    """Convex outline, in pixels, of what a view shows of a box: of its projected corners, or, of a box cut ``near_m``
    ahead of the camera, also of the points where its edges are cut. None if it lies outside the image."""
    from scipy.spatial import ConvexHull, QhullError  # late: most of what imports this module needs no scipy

    camera = view.camera
    corners = transform_points(view.cam_from_world @ world_from_box, box_corners(size_m))
    front = corners[:, 2] >= near_m
    points = [corners[front]]
    for i in range(8):
        for j in (i ^ 1, i ^ 2, i ^ 4):
            if front[i] and not front[j]:
                u = (near_m - corners[i, 2]) / (corners[j, 2] - corners[i, 2])
                points.append(corners[i : i + 1] + u * (corners[j : j + 1] - corners[i : i + 1]))
    kept = np.concatenate(points)
    uv = np.stack(pinhole(camera.intrinsics, *kept.T), 1)
    if not len(uv) or (uv.max(0) < 0).any() or uv[:, 0].min() > camera.width or uv[:, 1].min() > camera.height:
        return None
    try:
        return ConvexHull(np.clip(uv, -1e5, 1e5))
    except QhullError:
        return None
