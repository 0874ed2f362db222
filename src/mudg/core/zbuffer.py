"""The z-buffer of points: the nearest point of every pixel, native or, operation for operation the same, in numpy."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from mudg import native
from mudg.base import log
from mudg.base.types import Camera, View

_EMPTY: Final = np.uint64(0xFFFFFFFFFFFFFFFF)


@dataclass(frozen=True, slots=True, eq=False)
class PointLayer:
    """Points of one rigid frame.

    Args:
        xyz: f32[N, 3]; points that are not finite are not drawn. world_from_points: pose f64[4, 4] of their frame.
        splat_px: side of the square of pixels that a point covers.
    """

    xyz: NDArray[np.float32]
    world_from_points: NDArray[np.float64]
    splat_px: float = 1.0


@dataclass(frozen=True, slots=True)
class DrawLimits:
    """Depth range in metres, and squares that grow with nearness: side ``splat_m`` metres (0 = do not grow), at most ``most_px``."""

    near_m: float = 0.1
    far_m: float = 200.0
    splat_m: float = 0.0
    most_px: float = 9.0


def draw_points(
    layers: Sequence[PointLayer], view: View, limits: DrawLimits
) -> tuple[NDArray[np.float32], NDArray[np.int32]]:
    """Depth f32[H, W] in metres (0 = none) and index i32[H, W] of the nearest point of every pixel, over all layers (-1 = none).

    Equal depths go to the lower index.
    """
    keys = np.full((view.camera.height, view.camera.width), _EMPTY)
    library = native.library()
    if library is None:
        log.info_once(f"projecting points with numpy, slowly: {native.status()}")
    first = 0
    for layer in layers:
        if len(layer.xyz):
            cam_from_points = (view.cam_from_world @ layer.world_from_points)[:3].astype(np.float32)
            limit = max(limits.most_px, layer.splat_px)
            arguments = (np.ascontiguousarray(layer.xyz, np.float32), first, cam_from_points, view.camera,
                         (layer.splat_px, limits.splat_m, limit), (limits.near_m, limits.far_m), keys)  # fmt: skip
            if library is None:
                _draw_numpy(*arguments)
            else:
                _draw_native(library, *arguments)
            first += len(layer.xyz)
    if library is not None:
        depth, index = np.empty(keys.shape, np.float32), np.empty(keys.shape, np.int32)
        library.mudg_zbuffer_resolve(pointer(keys), ctypes.c_int64(keys.size), pointer(depth), pointer(index))
        return depth, index
    seen = keys != _EMPTY
    depth = np.where(seen, (keys >> np.uint64(32)).astype(np.uint32), np.uint32(0)).view(np.float32)
    return depth, np.where(seen, (keys & np.uint64(0xFFFFFFFF)).astype(np.int64), -1).astype(np.int32)


def pointer(array: NDArray[np.generic]) -> ctypes.c_void_p:
    """Address of an array's first element, for the native library."""
    return ctypes.c_void_p(array.ctypes.data)


def _draw_native(
    library: ctypes.CDLL, xyz: NDArray[np.float32], first: int, cam_from_points: NDArray[np.float32], camera: Camera,
    splat: tuple[float, float, float], limits_m: tuple[float, float], keys: NDArray[np.uint64],
) -> None:  # fmt: skip
    intrinsics = np.array([camera.fx, camera.fy, camera.cx, camera.cy], np.float32)
    matrix = np.ascontiguousarray(cam_from_points)
    real = ctypes.c_float
    library.mudg_zbuffer_draw(
        pointer(xyz), ctypes.c_int64(len(xyz)), ctypes.c_uint32(first), pointer(matrix), pointer(intrinsics),
        ctypes.c_int(camera.width), ctypes.c_int(camera.height), real(splat[0]), real(splat[1]), real(splat[2]),
        real(limits_m[0]), real(limits_m[1]), pointer(keys),
    )  # fmt: skip


def _draw_numpy(
    xyz: NDArray[np.float32], first: int, cam_from_points: NDArray[np.float32], camera: Camera,
    splat: tuple[float, float, float], limits_m: tuple[float, float], keys: NDArray[np.uint64],
) -> None:  # fmt: skip
    """The native loop in numpy, operation for operation in float32, so that both give the same bits."""
    f = np.float32
    x, y, z = xyz.T
    r, t = cam_from_points[:, :3], cam_from_points[:, 3]
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        cam = [((r[i, 0] * x + r[i, 1] * y) + r[i, 2] * z) + t[i] for i in range(3)]
        depth = cam[2]
        u = f(camera.fx) * cam[0] / depth + f(camera.cx)
        v = f(camera.fy) * cam[1] / depth + f(camera.cy)
        side = np.full(len(xyz), f(splat[0]))
        if splat[1] > 0:
            side = f(camera.fx) * f(splat[1]) / depth
            side = np.where(side < f(splat[0]), f(splat[0]), side)
            side = np.where(side > f(splat[2]), f(splat[2]), side)
        keep = (depth >= f(limits_m[0])) & (depth <= f(limits_m[1]))
        keep &= (u > -side) & (v > -side) & (u < camera.width + side) & (v < camera.height + side)
    u, v, side, depth = u[keep], v[keep], side[keep], depth[keep]
    key = (depth.view(np.uint32).astype(np.uint64) << np.uint64(32)) | (np.flatnonzero(keep) + first).astype(np.uint64)

    def span(center: NDArray[np.float32], size: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        low = np.floor(center - f(0.5) * side - f(0.5)).astype(np.int64) + 1
        high = np.floor(center + f(0.5) * side - f(0.5)).astype(np.int64)
        return np.maximum(low, 0), np.minimum(high, size - 1)

    left, right = span(u, camera.width)
    top, bottom = span(v, camera.height)
    flat = keys.reshape(-1)
    for dy in range(int((bottom - top).max(initial=-1)) + 1):
        for dx in range(int((right - left).max(initial=-1)) + 1):
            inside = (top + dy <= bottom) & (left + dx <= right)
            np.minimum.at(flat, (top[inside] + dy) * camera.width + left[inside] + dx, key[inside])
