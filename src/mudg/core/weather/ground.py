"""Wet ground, puddles and snow cover.

Wet ground is darker (Lagarde 2013: the pores of asphalt fill with water) and mirrors by Fresnel's law for water, ``F =
0.02 + 0.98 (1 - cos)^5``. Standing water mirrors sharply, a film on rough asphalt weakly and blurred upwards. Puddles
and patches of snow are value noise of world places, the same in every frame and camera.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from mudg.base import geometry, seeds
from mudg.base.palette import ID
from mudg.base.types import View
from mudg.core.weather.air import patch_threshold, patches, smoothstep
from mudg.core.weather.gbuffer import GBuffer, Surroundings, places_within_pixels, sky_share, world_points, world_rays

Array = NDArray[np.float64]
Plane = NDArray[np.float32]
Image = NDArray[np.float32]

WET_DARKENING = 0.4
"""Share of its light that a fully wet asphalt keeps."""
FILM_GLOSS = 0.25
"""Share of Fresnel's reflection that a wet film on rough asphalt shows as a mirror."""
FILM_TILT = 0.01
"""Standard deviation of the slope of the film: it blurs what is mirrored."""
PUDDLE_M = 2.5
SNOW_PATCH_M = 1.5
SNOW_COLOR = np.array([0.98, 0.99, 1.02]) * 0.9
TREE_COVER = 0.6
_WET_IDS = (ID["road"], ID["sidewalk"])
_BARE_IDS = (ID["sky"], ID["person"], ID["rider"])
_LEVEL = 0.8
_TRACE_FROM_M, _TRACE_TO_M, _TRACE_STEPS = 0.3, 90.0, 48


def noise_seed(seed: int, purpose: str) -> int:
    """A seed of value noise, 0 to a million, for a purpose."""
    return seeds.key(seed, 0, purpose) % 1_000_000


def fresnel(cosine: NDArray[np.floating]) -> Array:
    """Share of light that water mirrors, by the cosine between ray and normal (Schlick's form, n = 1.33)."""
    return 0.02 + 0.98 * (1 - np.clip(np.asarray(cosine, np.float64), 0, 1)) ** 5


def puddle_mask(xy: Array, share: float, seed: int) -> Array:
    """Standing water f64[...] in [0, 1] at world places [..., 2] of the ground; ``share`` of a large area is under
    water."""
    noise = noise_seed(seed, "puddles")
    level = patch_threshold(share, noise)
    return smoothstep(level - 0.02, level + 0.02, patches(xy[..., 0], xy[..., 1], PUDDLE_M, noise))


def sky_light(surroundings: Surroundings, rise: NDArray[np.floating]) -> Array:
    """Radiance f64[..., 3] of a clear sky by the sine of the elevation, from horizon to zenith."""
    up = 1 - np.exp(-3.2 * np.maximum(rise, 0))
    return surroundings.horizon + (surroundings.zenith - surroundings.horizon) * up[..., None]


def screen_mirror(gbuffer: GBuffer, view: View, surroundings: Surroundings) -> Image:
    """What level ground mirrors, found in the image itself, linear light f32[H, W, 3]; 0 beside the ground.

    Rays are followed from the ground in steps that grow with distance, until they pass behind a surface by less than a
    step. Rays that leave the image see what stands at its edge there, or else the sky's gradient.
    """
    wet = np.isin(gbuffer.classes, _WET_IDS) & ~gbuffer.sky
    mirror = np.zeros_like(gbuffer.color)
    rays, length = world_rays(view)
    direction = (rays / length[..., None])[wet] * np.array([1.0, 1.0, -1.0])
    start = world_points(view, gbuffer.depth)[wet]
    turn = view.world_from_cam[:3, :3]
    camera = view.camera
    height, width = gbuffer.depth.shape
    solid = np.where(gbuffer.ground, np.inf, gbuffer.depth)  # ground is not mirrored in ground

    def project(p: Array) -> tuple[Array, Array, Array]:
        x, y, z = (p @ turn).T
        u, v = geometry.pinhole(camera.intrinsics, x, y, np.where(z > 1e-3, z, np.nan))
        return u, v, z

    def behind(rows: NDArray[np.intp], t: Array) -> tuple[NDArray[np.bool_], Array]:
        u, v, z = project(start[rows] + t[:, None] * direction[rows] - view.center_world)
        inside = (u >= 0) & (u < width) & (v >= 0) & (v < height)
        d = np.full(len(rows), np.inf)
        d[inside] = solid[v[inside].astype(np.int64), u[inside].astype(np.int64)]
        return inside & (z > d), z - d

    steps = np.geomspace(_TRACE_FROM_M, _TRACE_TO_M, _TRACE_STEPS)
    hit = np.full(len(start), np.nan)
    for before, t in zip(np.concatenate([[0.0], steps[:-1]]), steps, strict=True):
        rows = np.flatnonzero(np.isnan(hit))
        passed, gap = behind(rows, np.full(len(rows), t))
        rows = rows[passed & (gap < 2 * (t - before) + 0.3)]
        low, high = np.full(len(rows), before), np.full(len(rows), t)
        for _ in range(5):
            middle = (low + high) / 2
            past = behind(rows, middle)[0]
            low, high = np.where(past, low, middle), np.where(past, middle, high)
        hit[rows] = high
    met = start + np.nan_to_num(hit)[:, None] * direction - view.center_world
    u, v, z = project(np.where(np.isnan(hit)[:, None], direction, met))
    light = sky_light(surroundings, direction[:, 2])
    at = (np.clip(np.nan_to_num(v) - 0.5, 0, height - 1), np.clip(np.nan_to_num(u) - 0.5, 0, width - 1))
    shown = (z > 0) & ~gbuffer.ground[at[0].astype(np.int64), at[1].astype(np.int64)]
    for channel in range(3):
        plane, places = gbuffer.color[..., channel], (at[0][shown], at[1][shown])
        light[shown, channel] = ndimage.map_coordinates(plane, places, order=1, mode="nearest")
    mirror[wet] = light
    return mirror


def wet_ground(
    gbuffer: GBuffer, view: View, surroundings: Surroundings, wet: float, puddles: float, seed: int
) -> Image:
    """Linear light f32[H, W, 3] with wet road and sidewalk.

    Args:
        gbuffer, view, surroundings: what is shown, dry.
        wet: wetness, 0 to 1.
        puddles: share of the wet ground under standing water.
        seed: of the places of puddles.
    """
    ground = np.isin(gbuffer.classes, _WET_IDS) & ~gbuffer.sky & (gbuffer.normal[..., 2] > _LEVEL)
    water = np.zeros(ground.shape)
    places = places_within_pixels(view, gbuffer, ground)
    water[ground] = wet * np.mean([puddle_mask(p[:, :2], puddles, seed) for p in places], axis=0)
    mirror = screen_mirror(gbuffer, view, surroundings)
    rays, length = world_rays(view)
    share = fresnel(-rays[..., 2] / length)
    film = (wet - water) * FILM_GLOSS * share * ground
    pool = water * share * ground
    # a film blurs along the columns, little across; only pixels of the ground count
    blur = (2 * FILM_TILT * view.camera.fy, 0.3 * FILM_TILT * view.camera.fy)
    weight = np.maximum(ndimage.gaussian_filter(ground.astype(np.float32), blur), 1e-6)[..., None]
    sums = [ndimage.gaussian_filter(np.where(ground, mirror[..., c], 0), blur) for c in range(3)]
    blurred = (np.stack(sums, -1) / weight).astype(np.float32)
    dark = np.where(ground, 1 - wet * (1 - WET_DARKENING), 1.0)
    light = gbuffer.color * (dark * (1 - film - pool))[..., None] + blurred * film[..., None] + mirror * pool[..., None]
    return light.astype(np.float32)


# --- snow -----------------------------------------------------------------------------------------


def snow_weight(
    xyz: Array, normal: NDArray[np.floating], openness: NDArray[np.floating], cover: float, seed: int
) -> Array:
    """Cover f64[...] in [0, 1] of surfaces by place, normal and visible share of the sky, whatever their class.

    ``smoothstep(0.3, 0.8, n_z)`` times a patch of noise times ``smoothstep(0.2, 0.7, openness)``; ``cover`` is the
    share of open level ground.
    """
    noise = noise_seed(seed, "snow")
    level = patch_threshold(cover, noise)
    patch = smoothstep(level - 0.06, level + 0.06, patches(xyz[..., 0], xyz[..., 1], SNOW_PATCH_M, noise))
    return smoothstep(0.3, 0.8, normal[..., 2]) * smoothstep(0.2, 0.7, openness) * patch


def snow_cover(gbuffer: GBuffer, view: View, cover: float, seed: int) -> Plane:
    """Cover f32[H, W] in [0, 1] of all surfaces: none on people and in the sky, less in trees."""
    weight = np.zeros(gbuffer.depth.shape, np.float32)
    solid = ~gbuffer.sky & ~np.isin(gbuffer.classes, _BARE_IDS)
    places = places_within_pixels(view, gbuffer, solid)
    weight[solid] = np.mean(
        [snow_weight(p, gbuffer.normal[solid], gbuffer.openness[solid], cover, seed) for p in places], axis=0
    )
    return weight * np.where(gbuffer.classes == ID["vegetation"], np.float32(TREE_COVER), np.float32(1))


def snow_light(gbuffer: GBuffer, surroundings: Surroundings, sunlit: Plane) -> Array:
    """Linear light f64[H, W, 3] of snow on the surfaces: albedo 0.9, slightly blue, under sky and sun."""
    facing = np.maximum(gbuffer.normal @ surroundings.sun_direction, 0) * sunlit
    sky = sky_share(gbuffer.openness)[..., None] * surroundings.ambient
    return SNOW_COLOR * (sky + facing[..., None] * surroundings.sun)
