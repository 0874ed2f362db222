"""All effects on one view, in the order in which light takes them: surfaces, then light, then air, then the camera."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from mudg.base.errors import InputError
from mudg.base.types import View
from mudg.base.weather_settings import (
    Conditions,
    FogSettings,
    LightSettings,
    RainSettings,
    SnowSettings,
    WeatherSettings,
)
from mudg.core.weather import air, ground
from mudg.core.weather import light as relight
from mudg.core.weather.gbuffer import (
    BufferRules,
    GBuffer,
    OccluderMap,
    Surroundings,
    estimate_surroundings,
    euclidean_range,
    from_render,
    sun_visibility,
    world_points,
    world_rays,
)
from mudg.core.weather.light import ToneCurve, curve_of, in_season, target_light

Array = NDArray[np.float64]
Plane = NDArray[np.float32]
Image = NDArray[np.float32]


@dataclass(frozen=True, slots=True, eq=False)
class Weathered:
    """An edited view.

    Args:
        color: f32[H, W, 3] linear light.
        confidence: f32[H, W] in [0, 1]: how far known physics and what was seen determine it.
    """

    color: Image
    confidence: Plane

    def display(self, tone: ToneCurve) -> Image:
        """Display values f32[H, W, 3] in [0, 1]."""
        return tone.encode(self.color)


def apply(
    gbuffer: GBuffer,
    settings: Conditions,
    view: View,
    time_s: float,
    seed: int,
    surroundings: Surroundings | None = None,
) -> Weathered:
    """Weather and light on one view. The same arguments give the same result; frames and cameras agree with each other.

    Args:
        gbuffer: what the view shows as recorded.
        settings: weather, light and shutter. Defaults change nothing.
        view: camera and pose.
        time_s: moment of falling drops and flakes, on the scene's clock (``view.time_s`` is not used).
        seed: run seed; puddles, patches of snow and drops follow from it.
        surroundings: light and ground of the drive; None = estimated from this view alone, so frames may differ a
            little.
    """
    view = View(view.camera, view.world_from_cam, time_s)
    light = surroundings if surroundings is not None else estimate_surroundings([(view, gbuffer)])
    weather, confidence = settings.weather, np.ones(gbuffer.depth.shape, np.float32)
    if weather.recorded_visibility_m > 0:
        gbuffer, confidence = _without_haze(gbuffer, view, weather.recorded_visibility_m, light)
    if settings.season is not None:
        gbuffer = in_season(gbuffer, view, settings.season, seed)
    if settings.light.time != "as_recorded":
        gbuffer, light, sure = _in_new_light(gbuffer, view, light, settings.light)
        confidence = confidence * sure
    if weather.wet > 0:
        color, sure = ground.wet_ground(gbuffer, view, light, weather.wet, weather.puddles, seed)
        gbuffer, confidence = replace(gbuffer, color=color), confidence * sure
    if weather.snow is not None and weather.snow.cover > 0:
        gbuffer, sure = _snowed(gbuffer, view, light, weather.snow, seed)
        confidence = confidence * sure
    color, share = _through_air(gbuffer, view, light, weather)
    confidence = confidence * share + (1 - share)
    color = _with_particles(color, gbuffer, view, light, settings, seed)
    if settings.light.time == "night":
        color = relight.glow(color)
    color = color * np.float32(2.0**settings.light.exposure_ev)
    return Weathered(color.astype(np.float32), confidence.astype(np.float32))


def _air_path(gbuffer: GBuffer, view: View, ground_z_m: float) -> tuple[Array, Array, float]:
    """Range f64[H, W], sine of elevation f64[H, W] and the camera's height above the ground."""
    rays, length = world_rays(view)
    return euclidean_range(view, gbuffer.depth), rays[..., 2] / length, float(view.center_world[2]) - ground_z_m


def _without_haze(gbuffer: GBuffer, view: View, visibility_m: float, light: Surroundings) -> tuple[GBuffer, Plane]:
    """Surfaces without the haze of the recording's day; the sky stays. Confidence is what had come through."""
    share = np.exp(-air.extinction(visibility_m) * euclidean_range(view, gbuffer.depth))
    sky = gbuffer.sky
    clear = np.where(sky[..., None], gbuffer.color, air.unveiled(gbuffer.color, share, light.airlight))
    return replace(gbuffer, color=clear.astype(np.float32)), np.where(sky, 1, share).astype(np.float32)


def _in_new_light(
    gbuffer: GBuffer, view: View, light: Surroundings, settings: LightSettings
) -> tuple[GBuffer, Surroundings, Plane]:
    target = relight.target_light(light, settings)
    lamps, scale = None, relight.NIGHT_LEVEL * relight.ground_level(light)
    if settings.time == "night":
        lamps = scale * relight.night_lights(gbuffer, view, target, settings)
    color, sure = relight.relit(gbuffer, view, light, target, lamps)
    if settings.time == "night" and settings.lamps and light.lamps is not None:
        color[relight.lamp_heads(gbuffer, view, light.lamps)] = scale * relight.LAMP_RADIANCE * relight.LAMP_COLOR
    # what was given for the recorded light is none for the new one
    return replace(gbuffer, color=color, sunlit=gbuffer.new_sunlit, mirror=None), target, sure


def _snowed(gbuffer: GBuffer, view: View, light: Surroundings, snow: SnowSettings, seed: int) -> tuple[GBuffer, Plane]:
    cover = ground.snow_cover(gbuffer, view, snow.cover, seed)
    if light.path is not None and snow.tracks < 1:
        road = gbuffer.ground
        tracks = ground.wheel_tracks(world_points(view, gbuffer.depth)[road][:, :2], light.path)
        cover[road] *= (1 - (1 - snow.tracks) * tracks).astype(np.float32)
    white = ground.snow_light(gbuffer, light, relight.sunlit_of(gbuffer, light))
    color = gbuffer.color + (white - gbuffer.color) * cover[..., None]
    return replace(gbuffer, color=color.astype(np.float32)), 1 - 0.3 * cover


def _through_air(gbuffer: GBuffer, view: View, light: Surroundings, weather: WeatherSettings) -> tuple[Image, Plane]:
    """Fog, or the haze of the recording again, and the veil of distant rain and snow; and the share of light that comes
    through."""
    distance, rise, height = _air_path(gbuffer, view, light.ground_z_m)
    share = np.ones(distance.shape)
    if weather.fog is not None:
        share = air.transmittance(distance, rise, height, weather.fog)
    elif weather.recorded_visibility_m > 0:
        share = np.where(gbuffer.sky, 1.0, np.exp(-air.extinction(weather.recorded_visibility_m) * distance))
    falling = FogSettings(top_m=1000.0)  # below the clouds
    path = air.optical_depth(distance, rise, height, falling) / air.extinction(falling.visibility_m)
    for fall, extinction in ((weather.rain, air.rain_extinction), (weather.snow, air.snow_extinction)):
        if fall is not None and fall.mm_h > 0:  # level rays have no end
            share = share * np.exp(-extinction(fall.mm_h) * np.maximum(path - fall.reach_m, 0))
    return air.veiled(gbuffer.color, share, light.airlight), share.astype(np.float32)


def _with_particles(
    color: Image, gbuffer: GBuffer, view: View, light: Surroundings, settings: Conditions, seed: int
) -> Image:
    """Drops and flakes near the camera, one by one."""
    kinds: list[tuple[RainSettings | SnowSettings, list[air.ParticleSize], Array, str]] = []
    if settings.weather.rain is not None:
        rain = settings.weather.rain
        kinds.append((rain, air.rain_sizes(rain.mm_h), air.DROP_LIGHT * light.ambient, "rain"))
    if settings.weather.snow is not None:
        snow = settings.weather.snow
        kinds.append(
            (snow, air.snow_sizes(snow.mm_h), ground.SNOW_COLOR * (light.ambient + 0.25 * light.sun), "flakes")
        )
    for fall, sizes, radiance, purpose in kinds:
        what = air.Falling(sizes, fall.wind_m_s, fall.reach_m, settings.response.shutter_s, purpose)
        depth = air.falling(view, gbuffer.depth, what, gbuffer.camera_velocity, seed)
        color = air.veiled(color, np.exp(-depth), radiance)
    return color


# a whole drive: what all its frames share, and one call per image ---------------------------------


LEAST_POINTS = 2
"""Pixels that a cell of the height map needs, so that single wrong depths do not stand in the air."""


@dataclass(frozen=True, slots=True, eq=False)
class ShownView:
    """What a camera shows: view, display values f32[H, W, 3] in [0, 1], camera z f32[H, W] (not finite or 0 in the
    sky), train ids u8[H, W]."""

    view: View
    rgb: Image
    depth: NDArray[np.float32]
    classes: NDArray[np.uint8]


@dataclass(frozen=True, slots=True, eq=False)
class DriveFacts:
    """What all frames of a drive share.

    Args:
        surroundings: its light.
        heights: height map for shadows and snow; None = by class alone.
        smooth_px: smoothing of normals, ``BufferRules.smooth_px``.
    """

    surroundings: Surroundings
    heights: OccluderMap | None = None
    smooth_px: int = 2


def drive_facts(
    shown: Iterable[ShownView], tone: ToneCurve, path: NDArray[np.float64] | None = None, cell_m: float = 0.4
) -> DriveFacts:
    """Light and height map of a drive from some of its views; a few of each camera, spread over the drive, are enough.

    Args:
        shown: views with depth and classes.
        tone: the camera's response.
        path: x, y, yaw of the recording vehicle f64[N, 3], for wheel tracks in snow.
        cell_m: side of the height map's cells.
    """
    pairs = [(s.view, from_render(s.view, tone.decode(s.rgb), s.depth, s.classes)) for s in shown]
    if not pairs:
        raise InputError("light is estimated from views", where="shown", got="none")
    points = [world_points(view, buffer.depth)[~buffer.sky] for view, buffer in pairs]
    around = replace(estimate_surroundings(pairs), path=path)
    xyz = np.concatenate(points)
    return DriveFacts(around, OccluderMap.from_points(xyz, cell_m, least=LEAST_POINTS) if len(xyz) else None)


def edited_view(
    shown: ShownView,
    settings: Conditions,
    seed: int,
    drive: DriveFacts,
    velocity: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> tuple[Image, Weathered]:
    """One image in other weather or light.

    Args:
        shown: the image, its depth and classes.
        settings: weather, light and camera response.
        seed: run seed.
        drive: from ``drive_facts``, the same for all images.
        velocity: of the camera, metres per second along the world's axes: it tilts the streaks of drops.

    Returns:
        Display values f32[H, W, 3] and the linear light with its confidence.
    """
    tone, around, view = curve_of(settings.response), drive.surroundings, shown.view
    gbuffer = from_render(
        view, tone.decode(shown.rgb), shown.depth, shown.classes, BufferRules(drive.heights, drive.smooth_px)
    )
    gbuffer = replace(gbuffer, camera_velocity=velocity)
    if drive.heights is not None:
        goal = target_light(around, settings.light)
        gbuffer = replace(
            gbuffer,
            sunlit=sun_visibility(gbuffer, view, drive.heights, around.sun_direction),
            new_sunlit=sun_visibility(gbuffer, view, drive.heights, goal.sun_direction),
        )
    result = apply(gbuffer, settings, view, view.time_s, seed, around)
    return result.display(tone), result
