"""Weather and light as pure functions of a G-buffer, in linear light: all effects on one view, in the order in which
light takes them: surfaces, then light, then air, then the camera. Models, sources and assumptions: docs/weather.md."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from mudg.base.errors import InputError
from mudg.base.types import View
from mudg.base.weather_settings import Conditions, LightSettings, WeatherSettings
from mudg.core.weather import air
from mudg.core.weather import light as relight
from mudg.core.weather.gbuffer import (
    GBuffer,
    OccluderMap,
    Surroundings,
    estimate_surroundings,
    euclidean_range,
    from_render,
    rises,
    sun_visibility,
    world_points,
)

Image = NDArray[np.float32]


def apply(
    gbuffer: GBuffer,
    settings: Conditions,
    view: View,
    time_s: float,
    seed: int,
    surroundings: Surroundings | None = None,
) -> Image:
    """Weather and light on one view as recorded, linear light f32[H, W, 3]. Default settings change nothing. The same
    arguments give the same result; frames and cameras agree with each other.

    ``time_s``: moment of falling drops and flakes, on the scene's clock (``view.time_s`` is not used). Puddles, patches
    of snow and drops follow from ``seed``. ``surroundings``: of the drive; None = estimated from this view alone, so
    frames may differ a little.
    """
    view = View(view.camera, view.world_from_cam, time_s)
    light = surroundings if surroundings is not None else estimate_surroundings([(view, gbuffer)])
    weather = settings.weather
    if weather.recorded_visibility_m > 0:
        # surfaces without the haze of the recording's day; the sky stays
        share = np.exp(-air.extinction(weather.recorded_visibility_m) * euclidean_range(view, gbuffer.depth))
        clear = air.unveiled(gbuffer.color, share, light.airlight)
        gbuffer = replace(gbuffer, color=np.where(gbuffer.sky[..., None], gbuffer.color, clear).astype(np.float32))
    if settings.light.time != "as_recorded":
        gbuffer, light = _in_new_light(gbuffer, view, light, settings.light)
    if weather.wet > 0:
        color = relight.wet_ground(gbuffer, view, light, weather.wet, weather.puddles, seed)
        gbuffer = replace(gbuffer, color=color)
    if weather.snow is not None and weather.snow.cover > 0:
        cover = relight.snow_cover(gbuffer, view, weather.snow.cover, seed)[..., None]
        white = relight.snow_light(gbuffer, light, relight.sunlit_of(gbuffer, light))
        gbuffer = replace(gbuffer, color=(gbuffer.color + (white - gbuffer.color) * cover).astype(np.float32))
    color = _with_particles(_through_air(gbuffer, view, light, weather), gbuffer, view, light, weather, seed)
    if settings.light.time == "night":
        color = relight.glow(color)
    return (color * np.float32(2.0**settings.light.exposure_ev)).astype(np.float32)


def _in_new_light(
    gbuffer: GBuffer, view: View, light: Surroundings, settings: LightSettings
) -> tuple[GBuffer, Surroundings]:
    target, lamps = relight.target_light(light, settings), None
    if settings.time == "night" and settings.headlights:
        level = relight.NIGHT_LEVEL * relight.ground_level(light)
        lamps = level * relight.headlights(gbuffer, view, target.ground_z_m)
    color = relight.relit(gbuffer, view, light, target, lamps)
    # what was given for the recorded light is none for the new one
    return replace(gbuffer, color=color, sunlit=gbuffer.new_sunlit), target


def _through_air(gbuffer: GBuffer, view: View, light: Surroundings, weather: WeatherSettings) -> Image:
    """Light behind fog, or the haze of the recording again, and the veil of distant rain and snow."""
    distance, rise = euclidean_range(view, gbuffer.depth), rises(view)
    height = float(view.center_world[2]) - light.ground_z_m
    share = np.ones(distance.shape)
    if weather.fog is not None:
        share = air.transmittance(distance, rise, height, weather.fog)
    elif weather.recorded_visibility_m > 0:
        share = np.where(gbuffer.sky, 1.0, np.exp(-air.extinction(weather.recorded_visibility_m) * distance))
    path = air.way_below(distance, rise, height, CLOUDS_M)
    for fall, extinction in ((weather.rain, air.rain_extinction), (weather.snow, air.snow_extinction)):
        if fall is not None and fall.mm_h > 0:  # level rays have no end
            share = share * np.exp(-extinction(fall.mm_h) * np.maximum(path - fall.reach_m, 0))
    return air.veiled(gbuffer.color, share, light.airlight)


def _with_particles(
    color: Image, gbuffer: GBuffer, view: View, light: Surroundings, weather: WeatherSettings, seed: int
) -> Image:
    """Drops and flakes near the camera, one by one."""
    rain, snow, velocity = weather.rain, weather.snow, gbuffer.camera_velocity
    if rain is not None and rain.mm_h > 0:
        depth = air.falling(view, gbuffer.depth, air.rain_sizes(rain.mm_h), rain, velocity, seed, "rain")
        color = air.veiled(color, np.exp(-depth), air.DROP_LIGHT * light.ambient)
    if snow is not None and snow.mm_h > 0:
        depth = air.falling(view, gbuffer.depth, air.snow_sizes(snow.mm_h), snow, velocity, seed, "flakes")
        color = air.veiled(color, np.exp(-depth), relight.SNOW_COLOR * (light.ambient + 0.25 * light.sun))
    return color


# a whole drive: what all its frames share, and one call per image ---------------------------------


CLOUDS_M = 1000.0
"""Rain and snow fall below this height."""
LEAST_POINTS = 2
"""Pixels that a cell of the height map needs, so that single wrong depths do not stand in the air."""
CELL_M = 0.4
"""Side of the height map's cells."""
SMOOTH_PX = 2
"""Smoothing of the depth of a fitted scene, ``from_render``."""


@dataclass(frozen=True, slots=True, eq=False)
class ShownView:
    """What a camera shows: view, display values f32[H, W, 3] in [0, 1], camera z f32[H, W] (not finite or 0 in the
    sky), train ids u8[H, W]."""

    view: View
    rgb: Image
    depth: NDArray[np.float32]
    classes: NDArray[np.uint8]


def drive_facts(shown: Iterable[ShownView]) -> Surroundings:
    """Light and height map of a drive from some of its views with depth and classes; a few of each camera, spread over
    the drive, are enough."""
    pairs = [(s.view, from_render(s.view, relight.srgb_decode(s.rgb), s.depth, s.classes)) for s in shown]
    if not pairs:
        raise InputError("light is estimated from views", where="shown", got="none")
    xyz = np.concatenate([world_points(view, buffer.depth)[~buffer.sky] for view, buffer in pairs])
    heights = OccluderMap.from_points(xyz, CELL_M, least=LEAST_POINTS) if len(xyz) else None
    return replace(estimate_surroundings(pairs), heights=heights)


def edited_view(
    shown: ShownView,
    settings: Conditions,
    seed: int,
    drive: Surroundings,
    velocity: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> Image:
    """One image in other weather or light, display values f32[H, W, 3]. ``drive``: from ``drive_facts``, the same for
    all images; ``velocity``: of the camera, metres per second along the world's axes, tilts the streaks of drops."""
    view, heights = shown.view, drive.heights
    gbuffer = from_render(view, relight.srgb_decode(shown.rgb), shown.depth, shown.classes, heights, SMOOTH_PX)
    gbuffer = replace(gbuffer, camera_velocity=velocity)
    if heights is not None:
        suns = (drive.sun_direction, relight.target_light(drive, settings.light).sun_direction)
        sunlit, new_sunlit = (sun_visibility(gbuffer, view, heights, direction) for direction in suns)
        gbuffer = replace(gbuffer, sunlit=sunlit, new_sunlit=new_sunlit)
    return relight.srgb_encode(apply(gbuffer, settings, view, view.time_s, seed, drive))
