"""Surfaces in other weather and light: wet ground, puddles, snow cover, and overcast, dusk and night.

Wet ground is darker (Lagarde 2013: the pores of asphalt fill with water) and mirrors by Fresnel's law for water, ``F =
0.02 + 0.98 (1 - cos)^5``. Standing water mirrors sharply, a film on rough asphalt weakly and blurred upwards. Puddles
and patches of snow are value noise of world places, the same in every frame and camera.

A photograph holds reflected light only, so an albedo is estimated first: light divided by the irradiance of the
recorded sun and sky. What that assumes: surfaces are matt; the recorded light is known (``Surroundings``); and where a
shadow lies is known (``GBuffer.sunlit``) or can be guessed from brightness, which fails where dark and bright materials
of one class mix. Glass, puddles and lamps of the recording keep their recorded look, scaled.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from mudg.base import geometry
from mudg.base.palette import ID
from mudg.base.types import View
from mudg.base.weather_settings import LightSettings
from mudg.core.weather.air import noise_seed, patch_threshold, patches, smoothstep
from mudg.core.weather.gbuffer import (
    GBuffer,
    Surroundings,
    places_within_pixels,
    rises,
    sky_share,
    world_points,
    world_rays,
)

Array = NDArray[np.float64]
Plane = NDArray[np.float32]
Image = NDArray[np.float32]

# camera response ----------------------------------------------------------------------------------

LUMINANCE = np.array([0.2126, 0.7152, 0.0722])
"""Brightness of linear light."""


def srgb_encode(light: NDArray[np.floating]) -> Image:
    """Display values in [0, 1] of linear light, IEC 61966-2-1, clipped."""
    x = np.clip(light, 0, 1)
    return np.where(x <= 0.0031308, 12.92 * x, 1.055 * x ** (1 / 2.4) - 0.055).astype(np.float32)


def srgb_decode(display: NDArray[np.floating]) -> Image:
    """Linear light of sRGB display values in [0, 1]."""
    x = np.clip(display, 0, 1)
    return np.where(x <= 0.04045, x / 12.92, ((x + 0.055) / 1.055) ** 2.4).astype(np.float32)


# wet ground ---------------------------------------------------------------------------------------


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
    """Linear light f32[H, W, 3] with road and sidewalk wet by 0 to 1, the share ``puddles`` of them under standing
    water."""
    ground = np.isin(gbuffer.classes, _WET_IDS) & ~gbuffer.sky & (gbuffer.normal[..., 2] > _LEVEL)
    water = np.zeros(ground.shape)
    places = places_within_pixels(view, gbuffer, ground)
    water[ground] = wet * np.mean([puddle_mask(p[:, :2], puddles, seed) for p in places], axis=0)
    mirror = screen_mirror(gbuffer, view, surroundings)
    share = fresnel(-rises(view))
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


# relight ------------------------------------------------------------------------------------------


GROUND_ALBEDO = np.array([0.36, 0.34, 0.31])
LEAST_ALBEDO, MOST_ALBEDO = 0.01, 0.9
_CLASS_SPREAD = 0.35
_TYPICAL_SPREAD = 0.5
_PAINT_WEIGHT = 0.2  # vehicles and signs have any albedo: the image says little
TYPICAL_ALBEDO = {
    ID["road"]: 0.085,
    ID["sidewalk"]: 0.23,
    ID["building"]: 0.25,
    ID["vegetation"]: 0.09,
    ID["terrain"]: 0.12,
}
"""What decides whether all of a class is dark material in the sun or bright material in shadow."""

# Night: irradiance 1 (times pi) stands for 50 lux.
BEAM_COLOR = np.array([1.0, 0.95, 0.85])
BEAM_POWER = 400.0
"""20,000 candela."""
BEAM_CUT_DEG = -1.0
BEAM_SIDE_M = 0.65
BEAM_WIDTH_DEG = 14.0
NIGHT_SKY = 0.012
NIGHT_LEVEL = 0.55
_LIT_IDS = (ID["traffic light"],)


def irradiance(
    normal: NDArray[np.floating], openness: NDArray[np.floating], sunlit: NDArray[np.floating], light: Surroundings
) -> Array:
    """Irradiance over pi f64[..., 3] of surfaces: sun where it reaches, sky by the normal, and light from the ground
    below."""
    facing = np.maximum(normal @ light.sun_direction, 0) * sunlit
    bounce = (0.30 * light.ambient + 0.22 * max(float(light.sun_direction[2]), 0.0) * light.sun) * GROUND_ALBEDO
    up = (0.5 + 0.5 * normal[..., 2])[..., None]
    sky = bounce + (light.ambient - bounce) * up
    return facing[..., None] * light.sun + sky * sky_share(openness)[..., None]


def refined_sunlit(gbuffer: GBuffer, light: Surroundings, given: Plane, trust: float = 2.0) -> Plane:
    """Where the recorded sun reaches, f32[H, W], from a first guess and the image.

    Each pixel is explained twice, lit and in shadow. The albedo of its class, halfway between typical and found, and
    the guess, blurred by a pixel or two as shadows of a height map are, decide between the two. Surfaces that face away
    from the sun are in shadow. ``given``: first guess, 0 to 1; ``trust``: log odds that the blurred guess is right
    where it is certain.
    """
    ones, zeros = np.ones_like(given), np.zeros_like(given)
    lit_level, shade_level = (irradiance(gbuffer.normal, gbuffer.openness, s, light).mean(-1) for s in (ones, zeros))
    value = np.log(np.maximum(gbuffer.color.mean(-1), 1e-4))
    as_lit, as_shade = value - np.log(np.maximum(lit_level, 1e-4)), value - np.log(np.maximum(shade_level, 1e-4))
    prior = trust * (2 * ndimage.gaussian_filter(given, 1.5) - 1)
    typical = np.log(np.array([TYPICAL_ALBEDO.get(n, np.nan) for n in range(256)]))[gbuffer.classes]
    first = ((as_shade - typical) ** 2 - (as_lit - typical) ** 2) / (2 * _TYPICAL_SPREAD**2)
    lit = 1 / (1 + np.exp(-np.clip(prior + np.nan_to_num(first), -30, 30)))
    for _ in range(3):
        odds = prior.copy()
        for number in np.unique(gbuffer.classes[~gbuffer.sky]):
            of_class = (gbuffer.classes == number) & ~gbuffer.sky
            albedo = np.where(lit > 0.5, as_lit, as_shade)[of_class]
            middle = np.median(albedo)
            if number in TYPICAL_ALBEDO:
                middle = (middle + np.log(TYPICAL_ALBEDO[number])) / 2
            spread = max(1.4826 * float(np.median(np.abs(albedo - middle))), _CLASS_SPREAD)
            weight = 1.0 if number in TYPICAL_ALBEDO else _PAINT_WEIGHT
            evidence = (as_shade[of_class] - middle) ** 2 - (as_lit[of_class] - middle) ** 2
            odds[of_class] += weight * evidence / (2 * spread**2)
        lit = 1 / (1 + np.exp(-np.clip(odds, -30, 30)))
    facing = gbuffer.normal @ light.sun_direction > 0.02
    return np.where(facing & ~gbuffer.sky, lit, 0).astype(np.float32)


def sunlit_of(gbuffer: GBuffer, light: Surroundings) -> Plane:
    """The given plane, refined by the image; without one, brightness alone decides."""
    if float(light.sun.max()) < 1e-3:
        return np.zeros(gbuffer.depth.shape, np.float32)
    if gbuffer.sunlit is None:
        return refined_sunlit(gbuffer, light, np.full(gbuffer.depth.shape, 0.5, np.float32), 0.0)
    return refined_sunlit(gbuffer, light, gbuffer.sunlit)


def albedo_of(gbuffer: GBuffer, light: Surroundings, sunlit: Plane) -> Array:
    """Albedo f64[H, W, 3]: light over irradiance, between ``LEAST_ALBEDO`` and ``MOST_ALBEDO``; 0 in the sky.

    An albedo of more than four times the median of its class, or less than a quarter, is taken halfway back to that
    limit (in logarithms): there the estimate of light is wrong more often than the surface is special.
    """
    raw = gbuffer.color / np.maximum(irradiance(gbuffer.normal, gbuffer.openness, sunlit, light), 1e-4)
    albedo = np.clip(raw, LEAST_ALBEDO, MOST_ALBEDO)
    for number in np.unique(gbuffer.classes[~gbuffer.sky]):
        of_class = (gbuffer.classes == number) & ~gbuffer.sky
        logs = np.log(albedo[of_class])
        middle = np.median(logs, axis=0)
        limited = np.clip(logs, middle - np.log(4), middle + np.log(4))
        albedo[of_class] = np.exp((logs + limited) / 2)
    albedo[gbuffer.sky] = 0
    return albedo


def ground_level(light: Surroundings) -> float:
    """Irradiance over pi of level ground, half of it in the sun: what automatic exposure follows."""
    return float((light.ambient + 0.5 * light.sun * max(float(light.sun_direction[2]), 0.0)).mean())


def target_light(recorded: Surroundings, settings: LightSettings) -> Surroundings:
    """The light that settings name, in the unit of the recorded one, as a camera with automatic exposure shows it:
    ground as bright as recorded under an overcast sky, half as bright at dusk; at night 50 lux stand for
    ``NIGHT_LEVEL`` of the recorded light."""
    level = ground_level(recorded)
    azimuth, elevation = np.radians(settings.sun_azimuth_deg), np.radians(settings.sun_elevation_deg)
    low_sun = np.array([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)])
    zero, upright = np.zeros(3), np.array([0.0, 0.0, 1.0])

    def light(scale: float, sky: tuple[Array, Array, Array], sun: Array, direction: Array) -> Surroundings:
        horizon, zenith, ambient = (scale * part for part in sky)
        return Surroundings(horizon, zenith, ambient, scale * sun, direction, 0.9 * horizon, recorded.ground_z_m)

    if settings.time == "overcast":
        grey = np.array([0.97, 1.0, 1.04])
        return light(level, (1.05 * grey, 0.9 * grey, grey), zero, upright)
    if settings.time == "dusk":
        sun = np.array([2.6, 1.45, 0.68]) * 0.8 * float(smoothstep(-2.0, 6.0, settings.sun_elevation_deg))
        sky = np.array([1.05, 0.68, 0.45]), np.array([0.2, 0.27, 0.5]), np.array([0.4, 0.42, 0.56])
        plain = light(1.0, sky, sun, low_sun)
        return light(0.5 * level / ground_level(plain), sky, sun, low_sun)
    if settings.time == "night":
        dark = NIGHT_SKY * np.array([0.8, 0.85, 1.0])
        return light(NIGHT_LEVEL * level, (2.5 * dark * np.array([1.3, 1.0, 0.7]), 0.6 * dark, dark), zero, upright)
    return recorded


def headlight(xyz: Array, normal: NDArray[np.floating], vehicle: Array) -> Array:
    """Irradiance over pi f64[N, 3] of two dipped headlights at world places f64[N, 3]. ``vehicle``: world_from_lights
    f64[4, 4], x forward, z up, origin between the two lights."""
    total = np.zeros(len(xyz))
    for side in (-1, 1):
        lamp = vehicle[:3, 3] + side * BEAM_SIDE_M * vehicle[:3, 1]
        to = xyz - lamp
        d = np.maximum(np.linalg.norm(to, axis=1), 0.5)
        x, y, z = (to @ vehicle[:3, :3]).T
        across, up = np.degrees(np.arctan2(y, x)), np.degrees(np.arcsin(np.clip(z / d, -1, 1)))
        beam = np.exp(-((across / BEAM_WIDTH_DEG) ** 2)) * (
            1 - 0.98 * smoothstep(BEAM_CUT_DEG - 0.5, BEAM_CUT_DEG + 0.5, up)
        )
        beam *= np.exp(-((np.minimum(up - BEAM_CUT_DEG, 0) / 9.0) ** 2)) * (x > 0)
        facing = np.maximum(-(normal * to).sum(1) / d, 0)
        total += BEAM_POWER * beam * facing / d**2
    return total[:, None] * BEAM_COLOR


def relit(
    gbuffer: GBuffer, view: View, recorded: Surroundings, target: Surroundings, point_lights: Array | None = None
) -> Image:
    """The image under another light: linear light f32[H, W, 3]; the sky is the target's gradient. ``new_sunlit`` of the
    G-buffer says where the new sun reaches. ``point_lights``: irradiance over pi f64[H, W, 3] of lamps, added."""
    sunlit = sunlit_of(gbuffer, recorded)
    new_sunlit = gbuffer.new_sunlit if gbuffer.new_sunlit is not None else np.ones_like(sunlit)
    new = irradiance(gbuffer.normal, gbuffer.openness, new_sunlit, target)
    if point_lights is not None:
        new = new + point_lights
    light = albedo_of(gbuffer, recorded, sunlit) * new
    kept = np.isin(gbuffer.classes, _LIT_IDS)[..., None] & (gbuffer.color > 0.5)
    light = np.where(kept, gbuffer.color, light)
    sky = gbuffer.sky
    light[sky] = sky_light(target, rises(view)[sky])
    return light.astype(np.float32)


def headlights(gbuffer: GBuffer, view: View, ground_z_m: float) -> Array:
    """Irradiance over pi f64[H, W, 3] of the headlights of a vehicle whose forward camera this is: below it, 0.65 m
    above the road, along its axis. Nothing casts shadows."""
    forward = view.world_from_cam[:3, 2] * np.array([1.0, 1.0, 0.0])
    x = forward / max(float(np.linalg.norm(forward)), 1e-6)
    vehicle = np.eye(4)
    vehicle[:3, :3] = np.stack([x, np.cross([0.0, 0.0, 1.0], x), [0.0, 0.0, 1.0]], 1)
    vehicle[:3, 3] = (*(view.center_world + 1.0 * x)[:2], ground_z_m + 0.65)
    out = np.zeros(gbuffer.color.shape)
    solid = ~gbuffer.sky
    out[solid] += headlight(world_points(view, gbuffer.depth)[solid], gbuffer.normal[solid], vehicle)
    # single normals at kerbs are wrong now and then, and a headlight shows every one
    calm = ndimage.median_filter(out, (3, 3, 1))
    return np.where(gbuffer.ground[..., None], calm, out)


def glow(color: Image, share: float = 0.06, sigma_px: float = 4.0) -> Image:
    """Light f32[H, W, 3] with a soft halo about what is brighter than the sensor's white."""
    excess = np.maximum(color - 1, 0)
    spread = sum(ndimage.gaussian_filter(excess, (s, s, 0)) for s in (sigma_px, 3 * sigma_px))
    return (color + share * spread).astype(np.float32)
