"""Points into views: z-buffered sparse colour, depth and validity.

Used for LiDAR depth targets and for the diffusion model's condition. The pinhole model and the pixel grid are those of
``base.geometry.project``; tests hold the two together.

The published system paints objects over the background in a second pass; here both are composed by depth, so a car
behind a wall stays behind it. A far point that shines through the gaps of a sparsely sampled near surface is removed by
a second z-buffer in which every point is a square of ``occluder_m`` metres (``ProjectConfig.occluder_m``).
"""

from __future__ import annotations

import ctypes
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from mudg import native
from mudg.base import log
from mudg.base.errors import InputError, UsageError
from mudg.base.types import Camera, FusedCloud, PointCloud, View

_EMPTY: Final = np.uint64(0xFFFFFFFFFFFFFFFF)
_MAX_POINTS: Final = 2**31 - 1


@dataclass(frozen=True, kw_only=True)
class ProjectConfig:
    """How a fused cloud is drawn."""

    static_splat_px: float = 1.0
    """Side of the square that a static point covers, pixels (published: 2.5)."""
    object_splat_px: float = 1.0
    """The same for points of moving objects (published: 4)."""
    near_m: float = 0.1
    """Nearest depth drawn, metres."""
    far_m: float = 200.0
    """Farthest depth drawn, metres."""
    occluder_m: float = 0.0
    """Side of the square, metres, with which points hide what lies behind them; 0 switches the test off."""
    occluder_max_px: float = 9.0
    """Upper limit of that square, pixels."""
    occlusion_slack_m: float = 0.3
    """A pixel is hidden when it is farther than the occluder by this much ..."""
    occlusion_slack_ratio: float = 0.1
    """... plus this share of the occluder's depth."""

    def __post_init__(self) -> None:
        if not 0 < self.near_m < self.far_m:
            raise UsageError(
                "depth limits are out of order", expected="0 < near_m < far_m", got=f"{self.near_m}, {self.far_m}"
            )
        for name in ("static_splat_px", "object_splat_px", "occluder_max_px"):
            if not 0 < getattr(self, name) <= 1000:
                raise UsageError(f"{name} is out of range", expected="> 0 and <= 1000 px", got=str(getattr(self, name)))


@dataclass(frozen=True, slots=True, eq=False)
class SparseView:
    """A projected cloud.

    Args:
        color: f32[3, H, W] in [0, 1], 0 where not valid.
        depth: f32[1, H, W] camera z in metres, 0 where not valid.
        valid: bool[1, H, W].
        index: i32[H, W] number of the point seen (static points first, then the objects in order), -1 = none.
    """

    color: Tensor
    depth: Tensor
    valid: Tensor
    index: Tensor


@dataclass(frozen=True, slots=True, eq=False)
class _Layer:
    """Points of one rigid frame: xyz f32[N, 3], its pose in the world, and the splat side in pixels."""

    xyz: NDArray[np.float32]
    world_from_points: NDArray[np.float64]
    splat_px: float


def project_points(
    xyz: NDArray[np.float32],
    rgb: NDArray[np.uint8] | None,
    view: View,
    *,
    splat_px: float = 1.0,
    near_m: float = 0.1,
    far_m: float = 200.0,
) -> SparseView:
    """Draw world points into a view; the nearest wins, equal depths go to the lower index.

    Args:
        xyz: f32[N, 3] world metres; points that are not finite are not drawn.
        rgb: u8[N, 3], or None: colour stays 0.
        splat_px: side of the square of pixels that a point covers.
    """
    if xyz.ndim != 2 or xyz.shape[1] != 3:
        raise InputError("points have the wrong shape", expected="[N, 3]", got=str(xyz.shape))
    config = ProjectConfig(static_splat_px=splat_px, near_m=near_m, far_m=far_m)
    return _draw([_Layer(xyz, np.eye(4), splat_px)], None if rgb is None else [rgb], view, config)


def project_cloud(
    cloud: FusedCloud,
    world_from_object: Mapping[str, NDArray[np.float64]],
    view: View,
    config: ProjectConfig | None = None,
) -> SparseView:
    """Draw a fused cloud, its objects placed at the given poses, composed by depth.

    Args:
        cloud: the static world and one cloud per object in its box frame.
        world_from_object: track id -> f64[4, 4] at the view's time; objects without a pose are absent.
    """
    config = config or ProjectConfig()
    layers = [_Layer(cloud.static.xyz, np.eye(4), config.static_splat_px)]
    colors: list[NDArray[np.uint8]] = [cloud.static.rgb]
    for name, points in drawn_objects(cloud, world_from_object):
        layers.append(_Layer(points.xyz, world_from_object[name], config.object_splat_px))
        colors.append(points.rgb)
    return _draw(layers, colors, view, config)


def drawn_objects(
    cloud: FusedCloud, world_from_object: Mapping[str, NDArray[np.float64]]
) -> list[tuple[str, PointCloud]]:
    """The object clouds that have a pose, in the order in which ``SparseView.index`` counts them."""
    return [(name, points) for name, points in cloud.objects.items() if name in world_from_object]


def _draw(
    layers: Sequence[_Layer], colors: Sequence[NDArray[np.uint8]] | None, view: View, config: ProjectConfig
) -> SparseView:
    camera = view.camera
    total = sum(len(layer.xyz) for layer in layers)
    if total > _MAX_POINTS:
        raise InputError("too many points for one view", expected=f"<= {_MAX_POINTS}", got=str(total))
    depth, index = _zbuffer(layers, view, config, metres=0.0)
    if config.occluder_m > 0:
        nearest, _ = _zbuffer(layers, view, config, metres=config.occluder_m)
        hidden = depth > nearest * (1 + config.occlusion_slack_ratio) + config.occlusion_slack_m
        depth[hidden], index[hidden] = 0.0, -1
    color = np.zeros((3, camera.height, camera.width), np.float32)
    first = 0
    for rgb in colors or ():
        _paint(index, rgb, first, color)
        first += len(rgb)
    return SparseView(
        torch.from_numpy(color),
        torch.from_numpy(depth)[None],
        torch.from_numpy(index >= 0)[None],
        torch.from_numpy(index),
    )


def _zbuffer(
    layers: Sequence[_Layer], view: View, config: ProjectConfig, metres: float
) -> tuple[NDArray[np.float32], NDArray[np.int32]]:
    """Depth f32[H, W] (0 = none) and point index i32[H, W] (-1 = none)."""
    keys = np.full((view.camera.height, view.camera.width), _EMPTY)
    library = native.library()
    if library is None:
        log.info_once(f"projecting points with numpy, slowly: {native.status()}")
    first = 0
    for layer in layers:
        if len(layer.xyz):
            cam_from_points = (view.cam_from_world @ layer.world_from_points)[:3].astype(np.float32)
            limit = max(config.occluder_max_px, layer.splat_px)
            arguments = (np.ascontiguousarray(layer.xyz, np.float32), first, cam_from_points, view.camera,
                         (layer.splat_px, metres, limit), (config.near_m, config.far_m), keys)  # fmt: skip
            if library is None:
                _draw_numpy(*arguments)
            else:
                _draw_native(library, *arguments)
            first += len(layer.xyz)
    if library is not None:
        depth, index = np.empty(keys.shape, np.float32), np.empty(keys.shape, np.int32)
        library.mudg_zbuffer_resolve(_at(keys), ctypes.c_int64(keys.size), _at(depth), _at(index))
        return depth, index
    seen = keys != _EMPTY
    depth = np.where(seen, (keys >> np.uint64(32)).astype(np.uint32), np.uint32(0)).view(np.float32)
    return depth, np.where(seen, (keys & np.uint64(0xFFFFFFFF)).astype(np.int64), -1).astype(np.int32)


def _at(array: NDArray[np.generic]) -> ctypes.c_void_p:
    return ctypes.c_void_p(array.ctypes.data)


def _paint(index: NDArray[np.int32], rgb: NDArray[np.uint8], first: int, color: NDArray[np.float32]) -> None:
    """Write the colours of points first .. first + len(rgb) into ``color`` f32[3, H, W] where they are seen."""
    library = native.library()
    if library is not None:
        table = np.ascontiguousarray(rgb)
        library.mudg_zbuffer_color(
            _at(index),
            ctypes.c_int64(index.size),
            _at(table),
            ctypes.c_int64(first),
            ctypes.c_int64(len(table)),
            _at(color),
        )
        return
    mine = (index >= first) & (index < first + len(rgb))
    color[:, mine] = (rgb[index[mine] - first].astype(np.float32) / np.float32(255)).T


def _draw_native(
    library: ctypes.CDLL, xyz: NDArray[np.float32], first: int, cam_from_points: NDArray[np.float32], camera: Camera,
    splat: tuple[float, float, float], limits_m: tuple[float, float], keys: NDArray[np.uint64],
) -> None:  # fmt: skip
    intrinsics = np.array([camera.fx, camera.fy, camera.cx, camera.cy], np.float32)
    matrix = np.ascontiguousarray(cam_from_points)
    real = ctypes.c_float
    library.mudg_zbuffer_draw(
        _at(xyz), ctypes.c_int64(len(xyz)), ctypes.c_uint32(first), _at(matrix), _at(intrinsics),
        ctypes.c_int(camera.width), ctypes.c_int(camera.height), real(splat[0]), real(splat[1]), real(splat[2]),
        real(limits_m[0]), real(limits_m[1]), _at(keys),
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
