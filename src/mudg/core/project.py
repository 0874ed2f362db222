"""Points into views: the z-buffer, which points a camera sees, and sparse colour and depth of clouds. The pinhole model
and the pixel grid are those of ``base.geometry.project``."""

from __future__ import annotations

import ctypes
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from scipy import ndimage
from torch import Tensor

from mudg import native
from mudg.base import log
from mudg.base.errors import InputError, UsageError
from mudg.base.palette import UNLABELLED
from mudg.base.types import Camera, FusedCloud, View, check_shape

# zbuffer: the nearest point of every pixel, native or, operation for operation the same, in numpy --------


_EMPTY: Final = np.uint64(0xFFFFFFFFFFFFFFFF)


@dataclass(frozen=True, slots=True, eq=False)
class PointLayer:
    """Points f32[N, 3] of one rigid frame of pose f64[4, 4], each covering a square of side ``splat_px`` pixels; those
    that are not finite are not drawn."""

    xyz: NDArray[np.float32]
    world_from_points: NDArray[np.float64]
    splat_px: float = 1.0


@dataclass(frozen=True, slots=True)
class DrawLimits:
    """Depth range in metres, and squares that grow with nearness: side ``splat_m`` metres (0 = do not grow), at most
    ``most_px``."""

    near_m: float = 0.1
    far_m: float = 200.0
    splat_m: float = 0.0
    most_px: float = 9.0


def draw_points(
    layers: Sequence[PointLayer], view: View, limits: DrawLimits
) -> tuple[NDArray[np.float32], NDArray[np.int32]]:
    """Depth f32[H, W] in metres (0 = none) and index i32[H, W] of the nearest point of every pixel, over all layers (-1
    = none). Equal depths go to the lower index."""
    camera, first = view.camera, 0
    keys = np.full((camera.height, camera.width), _EMPTY)
    library = native.library()
    if library is None:
        log.info_once(f"projecting points with numpy, slowly: {native.status()}")
    for layer in layers:
        if not len(layer.xyz):
            continue
        xyz = np.ascontiguousarray(layer.xyz, np.float32)
        cam_from_points = np.ascontiguousarray((view.cam_from_world @ layer.world_from_points)[:3], np.float32)
        splat = layer.splat_px, limits.splat_m, max(limits.most_px, layer.splat_px)
        if library is None:
            _draw_numpy(xyz, first, cam_from_points, camera, splat, (limits.near_m, limits.far_m), keys)
        else:
            intrinsics = np.array(camera.intrinsics, np.float32)
            points = (pointer(xyz), ctypes.c_int64(len(xyz)), ctypes.c_uint32(first), pointer(cam_from_points))
            size = map(ctypes.c_int, (camera.width, camera.height))
            numbers = map(ctypes.c_float, (*splat, limits.near_m, limits.far_m))
            library.mudg_zbuffer_draw(*points, pointer(intrinsics), *size, *numbers, pointer(keys))
        first += len(xyz)
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


def _draw_numpy(
    xyz: NDArray[np.float32],
    first: int,
    cam_from_points: NDArray[np.float32],
    camera: Camera,
    splat: tuple[float, float, float],
    limits_m: tuple[float, float],
    keys: NDArray[np.uint64],
) -> None:
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


# visible ------------------------------------------------------------------------------------------
# A scanner stands elsewhere than the camera and sees past things that hide what lies behind them. A point is hidden if
# something clearly nearer lies around it in the image. Points are sparse, so that is looked for within a reach.


@dataclass(frozen=True, kw_only=True)
class HidingRule:
    """When a point counts as hidden.

    Args:
        ratio, slack_m: a point is hidden if farther than ``nearer * (1 + ratio) + slack_m``.
        sides: which depths within reach are ``nearer``. "any": the nearest, for surfaces that fill the space between
            their points. "opposite": nearer ones on two opposite sides, above and below or left and right, the farther
            of the two: a surface seen through a gap is hidden, what lies beside an edge is not.
        reach_px: (horizontal, vertical) distance within which nearer points are looked for; those of an image when the
            angle between beams is not given, and at least this far when it is.
        reach_beams: (horizontal degrees, vertical share of the angle between beams): reach that follows from the
            scanner; 0 = none.
        inside: the reach that follows from the scanner ends a pixel short of the next beam.
        widen: "opposite": how far across its direction a side is looked at, as a share of the other direction's reach,
            at least a pixel; 0 = not at all.
    """

    ratio: float
    slack_m: float
    sides: Literal["any", "opposite"] = "any"
    reach_px: tuple[int, int] = (0, 0)
    reach_beams: tuple[float, float] = (0.0, 0.0)
    inside: bool = False
    widen: tuple[float, float] = (0.0, 0.0)

    def reach(self, camera: Camera, gap_deg: float) -> tuple[int, int]:
        """Horizontal and vertical reach in pixels, for an angle ``gap_deg`` between beams (0 = unknown)."""
        across = round(float(np.deg2rad(self.reach_beams[0])) * camera.fx)
        along = round(float(np.deg2rad(self.reach_beams[1] * gap_deg)) * camera.fy)
        return max(self.reach_px[0], across - self.inside), max(self.reach_px[1], along - self.inside)

    def hides(self, nearer: NDArray[np.floating], depth: NDArray[np.floating]) -> NDArray[np.bool_]:
        """Whether depths ``nearer`` hide depths ``depth`` (metres, any one shape)."""
        return depth > nearer * (1 + self.ratio) + self.slack_m


RULES: Final[Mapping[str, HidingRule]] = {
    "sweep": HidingRule(
        ratio=0.075,
        slack_m=0.32,
        sides="opposite",
        reach_px=(1, 1),
        reach_beams=(0.23, 1.0),
        inside=True,
        widen=(0.5, 0.15),
    ),
    "condition": HidingRule(ratio=0.176, slack_m=0.59, sides="opposite", reach_px=(3, 3)),
    "colour": HidingRule(ratio=0.053, slack_m=0.21, reach_beams=(0.1, 0.6)),
    "drawn": HidingRule(ratio=0.1, slack_m=0.3),
}
"""sweep: returns beside an image: for labels, dense depth, the depth a fit learns from, and that renders are scored
against. condition: fused clouds drawn for the diffusion model. colour: standing things that keep an image from
colouring a point. drawn: points drawn as squares of a size in metres, which then need no reach (``core.project``)."""


def visible_depth(
    view: View,
    xyz_world: NDArray[np.floating],
    rule: HidingRule,
    *,
    gap_deg: float = 0.0,
    near_m: float = 0.5,
    far_m: float = 200.0,
) -> NDArray[np.float32]:
    """The nearest point of ``xyz_world [N, 3]`` of every pixel, without the hidden ones; f32[H, W] metres, NaN = none.
    InputError: points have the wrong shape. ``gap_deg``: largest angle between neighbouring beams, for rules whose
    reach follows from it."""
    check_shape(xyz_world, "visible_depth: points", (None, 3))
    layer = PointLayer(np.ascontiguousarray(xyz_world, np.float32), np.eye(4))
    depth, index = draw_points([layer], view, DrawLimits(near_m, far_m))
    depth[index < 0] = np.inf
    hidden = hidden_pixels(depth, rule, rule.reach(view.camera, gap_deg))
    return np.where((index >= 0) & ~hidden, depth, np.float32(np.nan))


def hidden_pixels(depth: NDArray[np.float32], rule: HidingRule, reach: tuple[int, int]) -> NDArray[np.bool_]:
    """Which measured pixels of a depth map f32[H, W] (infinite = none) others of it hide, bool[H, W]; ``reach`` in
    pixels."""
    known = np.isfinite(depth)
    nearer = nearer_depth(depth, rule, reach)
    hidden = np.zeros(depth.shape, bool)
    hidden[known] = rule.hides(nearer[known], depth[known])
    return hidden


def seen_pixels(depth: NDArray[np.float32], valid: NDArray[np.bool_], rule: HidingRule) -> NDArray[np.bool_]:
    """Valid pixels of a depth map f32[H, W] that others of it do not hide by a rule whose reach is in pixels, bool[H,
    W]."""
    return valid & ~hidden_pixels(np.where(valid, depth, np.float32(np.inf)), rule, rule.reach_px)


def nearer_depth(nearest: NDArray[np.float32], rule: HidingRule, reach: tuple[int, int]) -> NDArray[np.float32]:
    """Depth that may hide each cell, f32[h, w], infinite = none; ``nearest`` f32[h, w], and ``reach`` in its cells."""
    if rule.sides == "any":
        found = nearest
        for axis, cells in ((0, reach[1]), (1, reach[0])):
            if cells:
                found = _minimum(found, 2 * cells + 1, axis, 0)
        return found
    found = np.full(nearest.shape, np.inf, np.float32)
    for axis, cells, share, other in ((0, reach[1], rule.widen[0], reach[0]), (1, reach[0], rule.widen[1], reach[1])):
        if cells == 0:
            continue
        across = max(1, int(share * other)) if share else 0
        wide = _minimum(nearest, 2 * across + 1, 1 - axis, 0) if across else nearest
        before, after = (_minimum(wide, cells + 1, axis, shift) for shift in (cells // 2, -((cells + 1) // 2)))
        found = np.minimum(found, np.maximum(before, after))
    return found


def _minimum(values: NDArray[np.float32], size: int, axis: int, shift: int) -> NDArray[np.float32]:
    """Running minimum over ``size`` cells along an axis, the window moved by ``shift``; nothing lies beyond the
    edge."""
    found = ndimage.minimum_filter1d(values, size, axis=axis, origin=shift, mode="constant", cval=np.inf)
    return np.asarray(found, np.float32)


# project ------------------------------------------------------------------------------------------
# The published system paints objects over the background in a second pass; here both are composed by depth, so a car
# behind a wall stays behind it.


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
    """Side of the squares, metres, of a second z-buffer that hides what shines through the gaps of a sparsely sampled
    near surface; 0 switches the test off."""
    occluder_max_px: float = 9.0
    """Upper limit of that square, pixels."""

    def __post_init__(self) -> None:
        if not 0 < self.near_m < self.far_m:
            what, got = "depth limits are out of order", f"{self.near_m}, {self.far_m}"
            raise UsageError(what, expected="0 < near_m < far_m", got=got)
        for name in ("static_splat_px", "object_splat_px", "occluder_max_px"):
            if not 0 < getattr(self, name) <= 1000:
                raise UsageError(f"{name} is out of range", expected="> 0 and <= 1000 px", got=str(getattr(self, name)))


@dataclass(frozen=True, slots=True, eq=False)
class ProjectedPoints:
    """A projected cloud: ``rgb`` f32[3, H, W] in [0, 1] and ``depth`` f32[H, W] camera z in metres, 0 where no point is
    drawn; ``valid`` bool[H, W]; ``moving`` bool[H, W], points of objects; ``semantics`` u8[H, W] (255 = unknown)."""

    rgb: Tensor
    depth: Tensor
    valid: Tensor
    moving: Tensor
    semantics: Tensor


def project_cloud(
    cloud: FusedCloud,
    world_from_object: Mapping[str, NDArray[np.float64] | None],
    view: View,
    config: ProjectConfig = ProjectConfig(),
    *,
    hide: bool = False,
) -> ProjectedPoints:
    """Draw a fused cloud, its objects at poses f64[4, 4] by track (those without one are absent), composed by depth, in
    the colours of the view's camera. ``hide``: points that shine through gaps between nearer ones (rule ``condition``)
    are not valid."""
    camera = view.camera
    clouds, layers = [cloud.static], [PointLayer(cloud.static.xyz, np.eye(4), config.static_splat_px)]
    for name, points in cloud.objects.items():
        if (pose := world_from_object.get(name)) is not None:
            clouds.append(points)
            layers.append(PointLayer(points.xyz, pose, config.object_splat_px))
    if (total := sum(map(len, clouds))) > _MAX_POINTS:
        raise InputError("too many points for one view", expected=f"<= {_MAX_POINTS}", got=str(total))
    depth, index = draw_points(layers, view, DrawLimits(config.near_m, config.far_m))
    if config.occluder_m > 0:
        limits = DrawLimits(config.near_m, config.far_m, config.occluder_m, config.occluder_max_px)
        nearest, _ = draw_points(layers, view, limits)
        hidden = RULES["drawn"].hides(nearest, depth)
        depth[hidden], index[hidden] = 0.0, -1
    color, first, library = np.zeros((3, camera.height, camera.width), np.float32), 0, native.library()
    for points in clouds:
        table, count = np.ascontiguousarray(points.rgb), ctypes.c_int64
        if library is not None:
            size, numbers = count(index.size), (count(first), count(len(table)))
            library.mudg_zbuffer_color(pointer(index), size, pointer(table), *numbers, pointer(color))
        else:
            mine = (index >= first) & (index < first + len(table))
            color[:, mine] = (table[index[mine] - first].astype(np.float32) / np.float32(255)).T
        first += len(table)
    drawn, valid = torch.from_numpy(color), index >= 0
    rgb = cloud.colors.image_of(camera.name, drawn)
    rgb = drawn if rgb is drawn else rgb.clamp(0, 1) * torch.from_numpy(valid)
    unknown = np.uint8(UNLABELLED)
    ids = [np.full(len(c), unknown) if c.semantics is None else c.semantics for c in clouds]
    semantics = np.append(np.concatenate(ids), unknown)[index]  # index -1 finds the appended one
    valid = seen_pixels(depth, valid, RULES["condition"]) if hide else valid
    moving = (index >= len(cloud.static)) & valid
    return ProjectedPoints(rgb, *map(torch.from_numpy, (depth, valid, moving, semantics)))
