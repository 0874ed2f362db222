"""What a view shows, surface by surface: the input of every weather and light effect, and how it is made from a render.

World coordinates have z up; depth is camera z in metres, infinite in the sky.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from mudg.base import geometry
from mudg.base.errors import InputError
from mudg.base.palette import ID, UNLABELLED
from mudg.base.types import View, check_shape

Image = NDArray[np.float32]
Plane = NDArray[np.float32]
Array = NDArray[np.float64]

GROUND_IDS = (ID["road"], ID["sidewalk"], ID["terrain"])
_LEVEL_GROUND, _KERB = np.cos(np.radians(30.0)), np.cos(np.radians(65.0))
KERBS_WITHIN_M = 20.0


@dataclass(frozen=True, slots=True, eq=False)
class GBuffer:
    """Surfaces behind the pixels of one view: linear light ``color`` f32[H, W, 3] >= 0, camera z ``depth`` f32[H, W] in
    metres (+inf in the sky), Cityscapes train ids u8[H, W], unit normals f32[H, W, 3] of the world towards the camera
    (0 in the sky), and the share ``openness`` f32[H, W] of the sky that the surface sees.

    ``sunlit`` f32[H, W]: share of the recorded sun that reaches the surface (None: it is guessed from brightness);
    ``new_sunlit``: the same for the sun to change to (None: everything that faces it is lit); ``camera_velocity``:
    metres per second along the world's axes.
    """

    color: Image
    depth: Plane
    classes: NDArray[np.uint8]
    normal: Image
    openness: Plane
    sunlit: Plane | None = None
    new_sunlit: Plane | None = None
    camera_velocity: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        shape = self.depth.shape
        for name in ("color", "classes", "normal", "openness", "sunlit", "new_sunlit"):
            if (value := getattr(self, name)) is not None:
                check_shape(value, f"G-buffer: {name}", (*shape, 3) if name in ("color", "normal") else shape)

    @property
    def sky(self) -> NDArray[np.bool_]:
        """bool[H, W]: no surface."""
        return ~np.isfinite(self.depth)

    @property
    def ground(self) -> NDArray[np.bool_]:
        """bool[H, W]: road, sidewalk and terrain."""
        return np.isin(self.classes, GROUND_IDS) & ~self.sky


def world_rays(view: View) -> tuple[Array, Array]:
    """Directions f64[H, W, 3] in the world through pixel centres, scaled to camera z = 1, and their lengths f64[H,
    W]."""
    x, y = geometry.pixel_rays(view.camera)
    local = np.stack([*np.broadcast_arrays(x[None, :], y[:, None]), np.ones((len(y), len(x)))], -1)
    return local @ view.world_from_cam[:3, :3].T, np.linalg.norm(local, axis=-1)


def rises(view: View) -> Array:
    """Sine f64[H, W] of the elevation of the rays through pixel centres."""
    rays, length = world_rays(view)
    return rays[..., 2] / length


def world_points(view: View, depth: NDArray[np.floating]) -> Array:
    """World places f64[H, W, 3] of the pixels, metres; not finite in the sky."""
    rays, _ = world_rays(view)
    with np.errstate(invalid="ignore"):
        return view.center_world + rays * depth[..., None].astype(np.float64)


def euclidean_range(view: View, depth: NDArray[np.floating]) -> Array:
    """Distance f64[H, W] from the camera along the ray, metres; depth is camera z. Infinite in the sky."""
    return depth.astype(np.float64) * world_rays(view)[1]


_SUB_PIXELS = ((-0.125, -0.375), (0.375, -0.125), (-0.375, 0.125), (0.125, 0.375))


def places_within_pixels(view: View, gbuffer: GBuffer, where: NDArray[np.bool_]) -> list[Array]:
    """World places f64[N, 3] of four points in each of the N pixels that a mask names, on the planes through the
    surfaces there.

    Patterns of the ground are finer than a pixel a little way off; they are averaged over these.
    """
    rays, _ = world_rays(view)
    normal = gbuffer.normal[where].astype(np.float64)
    middle, depth = rays[where], gbuffer.depth[where].astype(np.float64)
    across, down = view.world_from_cam[:3, 0] / view.camera.fx, view.world_from_cam[:3, 1] / view.camera.fy
    offset = (normal * middle).sum(1)
    found = []
    for du, dv in _SUB_PIXELS:
        ray = middle + du * across + dv * down
        against = (normal * ray).sum(1)
        # grazing: stay at the depth
        scale = np.where(offset * against > 0, offset / np.where(against == 0, 1, against), 1.0)
        found.append(view.center_world + ray * (depth * np.clip(scale, 0.5, 2))[:, None])
    return found


def _smaller_step(w: Array, axis: int) -> Array:
    """Per pixel the smaller of the differences to both neighbours: it does not cross the edge of a surface."""
    ahead = np.diff(w, axis=axis, append=np.take(w, [-1], axis))
    back = np.diff(w, axis=axis, prepend=np.take(w, [0], axis))
    last, first = [slice(None)] * 2, [slice(None)] * 2
    last[axis], first[axis] = slice(-1, None), slice(0, 1)
    ahead[tuple(last)], back[tuple(first)] = np.inf, np.inf
    return np.where(np.abs(ahead) <= np.abs(back), ahead, back)


def normals_from_depth(view: View, depth: NDArray[np.floating], classes: NDArray[np.uint8] | None = None) -> Image:
    """Unit normals f32[H, W, 3] in the world, towards the camera; 0 in the sky.

    The inverse depth of a plane is linear in the pixel, so its gradient gives the normal exactly. At edges the smaller
    of two one-sided differences is taken. With ``classes``, ground that comes out steeper than 30 degrees is taken as
    level, other than kerbs: nearer than ``KERBS_WITHIN_M`` and steeper than 65 degrees.
    """
    camera = view.camera
    w = np.where(np.isfinite(depth) & (depth > 0), 1.0 / np.maximum(depth, 1e-6), 0.0).astype(np.float64)
    if min(w.shape) < 2:
        raise InputError("normals need at least two rows and columns", where="depth", got=str(w.shape))
    du, dv = _smaller_step(w, 1), _smaller_step(w, 0)
    u, v = np.arange(camera.width) + 0.5 - camera.cx, np.arange(camera.height)[:, None] + 0.5 - camera.cy
    local = np.stack([camera.fx * du, camera.fy * dv, w - u * du - v * dv], -1)
    normal = local @ view.world_from_cam[:3, :3].T
    rays, _ = world_rays(view)
    normal *= np.where((normal * rays).sum(-1, keepdims=True) > 0, -1.0, 1.0)
    size = np.linalg.norm(normal, axis=-1, keepdims=True)
    normal = np.where(size > 0, normal / np.maximum(size, 1e-300), 0.0)
    if classes is not None:
        kerb = (normal[..., 2] < _KERB) & (depth < KERBS_WITHIN_M)
        steep = np.isin(classes, GROUND_IDS) & (normal[..., 2] < _LEVEL_GROUND) & ~kerb
        normal[steep] = (0.0, 0.0, 1.0)
    normal[w == 0] = 0
    return normal.astype(np.float32)


def openness_by_class(classes: NDArray[np.uint8], normal: Image) -> Plane:
    """A first estimate of the visible share of the sky, f32[H, W]: the half space above the surface, less under trees,
    for use where there is no height map. A level open surface sees all of it, a wall half."""
    share = 0.5 + 0.5 * normal[..., 2]
    share = np.where(np.isin(classes, (ID["vegetation"], UNLABELLED)), 0.6 * share, share)
    return np.where(classes == ID["sky"], 1.0, share).astype(np.float32)


GROUND_SMOOTHING = 12


def steadied(normal: Image, classes: NDArray[np.uint8], radius: int) -> Image:
    """Unit normals f32[H, W, 3], each the mean of those of its class within a square of ``2 radius + 1`` pixels, on the
    ground of ``GROUND_SMOOTHING`` times that radius: under a low sun a ripple of a few degrees would light and shade
    it. 0 stays 0."""
    if radius == 0:
        return normal
    mean = np.zeros(normal.shape, np.float64)
    for number in np.unique(classes):
        of_class, reach = classes == number, radius * (GROUND_SMOOTHING if number in GROUND_IDS else 1)
        for axis in range(3):
            part = np.where(of_class, normal[..., axis], 0).astype(np.float64)
            mean[..., axis] += of_class * ndimage.uniform_filter(part, 2 * reach + 1, mode="constant")
    size = np.linalg.norm(mean, axis=-1, keepdims=True)
    known = normal.any(-1, keepdims=True)
    return np.where(known & (size > 1e-9), mean / np.maximum(size, 1e-9), 0).astype(np.float32)


def from_render(
    view: View,
    light: Image,
    depth: NDArray[np.floating],
    classes: NDArray[np.uint8],
    heights: OccluderMap | None = None,
    smooth_px: int = 0,
) -> GBuffer:
    """A G-buffer from the planes of a render: linear light f32[H, W, 3], camera z (0, negative or not finite = sky, as
    is everything of that class) and classes u8[H, W].

    Without ``heights``, the height map of the drive, the sky's visibility is a guess by class. ``smooth_px``: radius in
    pixels over which inverse depth (median) and normals (mean, per class) are smoothed: 0 for exact depth, about 2 for
    the depth of a fitted scene.
    """
    sky = ~np.isfinite(depth) | (depth <= 0) | (classes == ID["sky"])
    clean = np.where(sky, np.inf, depth).astype(np.float32)
    calm = clean
    if smooth_px:
        inverse = ndimage.median_filter(1 / clean, 2 * smooth_px + 1)
        calm = np.where(sky | (inverse <= 0), clean, 1 / np.maximum(inverse, 1e-6)).astype(np.float32)
    normal = steadied(normals_from_depth(view, calm, classes), classes, smooth_px)
    openness = openness_by_class(classes, normal)
    if heights is not None:
        points = world_points(view, clean)
        openness = np.ones_like(openness)
        openness[~sky] = heights.openness(points[~sky] + heights.clear_of(normal[~sky]))
    return GBuffer(np.maximum(light, 0).astype(np.float32), clean, classes, normal, openness)


# --- what stands above ----------------------------------------------------------------------------

WHITE_IN_SUN = 1.4
"""Cameras expose so that a white surface in the sun is about at their limit of 1: light that is guessed is no brighter
than this."""
_LIFT_M = 0.35
BRIGHTEST_FOG = 0.8
"""Airlight that is guessed from a sky is no brighter: cameras expose for fog, and a clipped sky says little."""
CLEAR_CELLS = 1.0


def sky_share(openness: NDArray[np.floating]) -> NDArray[np.floating]:
    """Share of the sky's light that arrives, by the openness: what stands in the way reflects much of it again."""
    return 0.75 + 0.25 * openness


@dataclass(frozen=True, slots=True, eq=False)
class OccluderMap:
    """Largest height ``top_m`` f32[rows along y, columns along x] per cell of the ground plane, -inf where nothing is
    known, from the first cell's corner ``x0_m, y0_m`` on. Things are solid down to the ground: below a bridge no sky is
    seen."""

    x0_m: float
    y0_m: float
    cell_m: float
    top_m: NDArray[np.float32]

    @classmethod
    def from_points(cls, xyz: NDArray[np.floating], cell_m: float = 0.5, least: int = 1) -> OccluderMap:
        """The map of world points [N, 3]; cells with fewer than ``least`` points stay unknown."""
        xyz = xyz[np.isfinite(xyz).all(1)]
        if len(xyz) == 0:
            raise InputError("a height map needs points", where="xyz", got="none")
        low = np.floor(xyz[:, :2].min(0) / cell_m) * cell_m
        at = ((xyz[:, :2] - low) / cell_m).astype(np.int64)
        columns, rows = at.max(0) + 1
        if rows * columns > 50_000_000:
            raise InputError("points are spread too far for a height map", where="xyz", got=f"{rows} x {columns} cells")
        top = np.full(rows * columns, -np.inf, np.float32)
        index = at[:, 1] * columns + at[:, 0]
        np.maximum.at(top, index, xyz[:, 2].astype(np.float32))
        top[np.bincount(index, minlength=len(top)) < least] = -np.inf
        return cls(float(low[0]), float(low[1]), cell_m, top.reshape(rows, columns))

    def clear_of(self, normal: NDArray[np.floating]) -> Array:
        """How far places f64[N, 3] are moved along normals [N, 3] before rays start, so that a wall does not stand in
        its own light."""
        return CLEAR_CELLS * self.cell_m * normal.astype(np.float64)

    def at(self, xy: Array) -> Array:
        """Heights f64[...] at world places [..., 2]; -inf outside and where nothing is known."""
        column = np.floor((xy[..., 0] - self.x0_m) / self.cell_m).astype(np.int64)
        row = np.floor((xy[..., 1] - self.y0_m) / self.cell_m).astype(np.int64)
        rows, columns = self.top_m.shape
        inside = (row >= 0) & (row < rows) & (column >= 0) & (column < columns)
        return np.where(inside, self.top_m[np.clip(row, 0, rows - 1), np.clip(column, 0, columns - 1)], -np.inf)

    def free(self, xyz: Array, direction: Array, reach_m: float = 40.0) -> NDArray[np.bool_]:
        """Whether light from a direction f64[3] reaches places [N, 3]: bool[N]. The ray is followed in steps of one
        cell."""
        d = np.asarray(direction, np.float64) / np.linalg.norm(direction)
        flat = float(np.hypot(d[0], d[1]))
        if d[2] <= 0:
            return np.zeros(len(xyz), bool)
        if flat < 1e-6:
            return self.at(xyz[:, :2]) <= xyz[:, 2] + max(_LIFT_M, self.cell_m)
        highest = float(self.top_m.max())
        open_ = np.ones(len(xyz), bool)
        for step in range(1, int(reach_m * flat / self.cell_m) + 2):
            t = step * self.cell_m / flat
            rows = np.flatnonzero(open_ & (xyz[:, 2] + t * d[2] < highest))
            if len(rows) == 0:
                break
            at = xyz[rows] + t * d
            open_[rows[self.at(at[:, :2]) > at[:, 2] + _LIFT_M]] = False
        return open_

    def openness(self, xyz: Array) -> Plane:
        """Free share f32[N] of nine directions at places [N, 3]: straight up, and eight at 60 degrees."""
        turn = np.arange(8) * (np.pi / 4)
        tilted = np.stack([0.5 * np.cos(turn), 0.5 * np.sin(turn), np.full(8, np.sqrt(0.75))], 1)
        directions = np.concatenate([[[0.0, 0.0, 1.0]], tilted])
        return np.mean([self.free(xyz, d) for d in directions], axis=0).astype(np.float32)


def sun_visibility(gbuffer: GBuffer, view: View, heights: OccluderMap, direction: Array) -> Plane:
    """f32[H, W]: 1 where light from a direction f64[3] reaches a surface that faces it, by the height map; 0 in the
    sky."""
    out = np.zeros(gbuffer.depth.shape, np.float32)
    facing = ~gbuffer.sky & (gbuffer.normal @ np.asarray(direction) > 0)
    points = world_points(view, gbuffer.depth)
    start = points[facing] + heights.clear_of(gbuffer.normal[facing])
    out[facing] = heights.free(start, np.asarray(direction, np.float64), 120.0)
    return out


# --- light of a drive -----------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, eq=False)
class Surroundings:
    """Light and ground of a drive, the same for all its frames and cameras.

    Radiances of the sky and of thick fog (``airlight``) are f64[3] linear light; irradiances of the sky (``ambient``)
    and of the sun on a surface that faces it are divided by pi, so that a white level surface in the open shows
    ``ambient + sun * cos``. ``heights``: for shadows and snow (None: by class alone).
    """

    horizon: Array
    zenith: Array
    ambient: Array
    sun: Array
    sun_direction: Array
    airlight: Array
    ground_z_m: float = 0.0
    heights: OccluderMap | None = None


def _quantile_color(colors: Image, share: float, otherwise: Array) -> Array:
    return np.quantile(colors.reshape(-1, 3), share, axis=0).astype(np.float64) if len(colors) else otherwise


def estimate_surroundings(views: Iterable[tuple[View, GBuffer]]) -> Surroundings:
    """Light of a drive from its own images.

    Sky pixels below 20 degrees give the horizon, those above the zenith, and the lowest tenth of them the airlight.
    Without sky, the brightest tenth of everything stands for it. The sky's irradiance is a third horizon and two thirds
    zenith (cosine weights of both bands, rounded). Level ground in light and shadow gives the sun: what the brightest
    ground has beyond the darkest, over the same albedo. Its direction is not found: straight above is assumed.
    The road's height is the median of its pixels.
    """
    low, high, seen, rest, ground, heights = [], [], [], [], [], []
    for view, gbuffer in views:
        up, sky = rises(view), gbuffer.sky
        low.append(gbuffer.color[sky & (up < 0.34)])
        high.append(gbuffer.color[sky & (up >= 0.34)])
        seen.append((up[sky], gbuffer.color[sky]))
        rest.append(gbuffer.color[~sky].reshape(-1, 3))
        road = gbuffer.classes == ID["road"]
        ground.append(gbuffer.color[road])
        heights.append(world_points(view, gbuffer.depth)[road & ~sky][:, 2])
    if not rest:
        raise InputError("light is estimated from views", where="views", got="none")
    brightest = _quantile_color(np.concatenate(rest), 0.9, np.full(3, 0.5))
    horizon = _quantile_color(np.concatenate(low), 0.5, brightest)
    zenith = _quantile_color(np.concatenate(high), 0.5, horizon)
    ambient = horizon / 3 + zenith * 2 / 3
    pixels = np.concatenate(ground)
    dark, bright = (_quantile_color(pixels, share, np.full(3, 0.1)) for share in (0.1, 0.9))
    sun = ambient * np.clip(bright / np.maximum(dark, 1e-4) - 1.6, 0, 5)  # 1.6: texture of asphalt alone
    too_bright = max(float((ambient + sun).mean()) / WHITE_IN_SUN, 1.0)
    ambient, sun = ambient / too_bright, sun / too_bright
    z = np.concatenate(heights)
    ground_z = float(np.median(z)) if len(z) else 0.0
    up, color = (np.concatenate(parts) for parts in zip(*seen, strict=True))
    lowest = color[up <= np.quantile(up, 0.1)] if len(up) else color
    airlight = _quantile_color(lowest, 0.5, horizon)
    airlight = airlight * min(1.0, BRIGHTEST_FOG / max(float(airlight.max()), 1e-6))
    return Surroundings(horizon, zenith, ambient, sun, np.array([0.0, 0.0, 1.0]), airlight, ground_z)
