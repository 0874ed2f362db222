"""A whole drive: what all its frames share, and one call per image."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from mudg.base.errors import InputError
from mudg.base.types import View
from mudg.base.weather_settings import Conditions
from mudg.core.weather.apply import Weathered, apply
from mudg.core.weather.gbuffer import (
    BufferRules,
    OccluderMap,
    Surroundings,
    estimate_surroundings,
    from_render,
    sun_visibility,
    world_points,
)
from mudg.core.weather.relight import target_light
from mudg.core.weather.tone import ToneCurve, curve_of

Image = NDArray[np.float32]
LEAST_POINTS = 2
"""Pixels that a cell of the height map needs, so that single wrong depths do not stand in the air."""


@dataclass(frozen=True, slots=True, eq=False)
class ShownView:
    """What a camera shows: view, display values f32[H, W, 3] in [0, 1], camera z f32[H, W] (not finite or 0 in the sky), train ids
    u8[H, W]."""

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
