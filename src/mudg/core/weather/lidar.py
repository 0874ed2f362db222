"""What fog and rain take from and add to a LiDAR sweep.

Fog (Hahner et al. 2021): the hard return of a surface falls by ``exp(-2 alpha r)``; water droplets near the sensor
return a soft pulse; the stronger of the two is recorded. Rain (Goodin et al. 2019): power ``rho / r^2 exp(-0.02 R^0.6
r)`` and range noise. Powers are relative: only ratios count, and the sensor's threshold is set by the range at which it
still sees a surface of 10 % reflectance in clear air.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mudg.base import seeds
from mudg.base.palette import UNLABELLED
from mudg.base.types import SweepPoints
from mudg.base.weather_settings import WeatherSettings

Array = NDArray[np.float64]

BACKSCATTER = 0.046
"""Backscattered share per metre of fog, times the visibility in metres."""
PULSE_M = 3.0
"""Half-power pulse length as a distance: 20 ns of light, there and back."""
SOFT_JITTER_M = 0.3
CROSS_FROM_M, CROSS_TO_M = 0.9, 1.0
"""The receiver sees nothing of the beam before the first distance, and all of it after the second."""
THRESHOLD = 0.1 / math.pi / 90.0**2
"""Least power that is detected, in units of ``reflectance / pi / r^2``: 10 % reflectance in clear air at 90 m."""
LOST, HARD, SOFT = 0, 1, 2


@dataclass(frozen=True, slots=True, eq=False)
class BeamReturns:
    """A sweep in bad weather, for the same N beams.

    Args:
        range_m: f64[N]; of soft returns the place in the fog; where nothing returned the range that was given.
        intensity: f64[N], received power against a white surface in clear air, times r^2: attenuated reflectance.
        kind: u8[N]: 0 lost, 1 the surface, 2 fog.
    """

    range_m: Array
    intensity: Array
    kind: NDArray[np.uint8]


def _pulse(x: Array) -> Array:
    """Shape of the pulse over the distance x behind its front: sin^2 over twice the half-power length."""
    return np.where((x >= 0) & (x <= 2 * PULSE_M), np.sin(math.pi * x / (2 * PULSE_M)) ** 2, 0.0)


def soft_response(visibility_m: float, reach_m: float = 60.0, step_m: float = 0.02) -> tuple[Array, Array]:
    """Power of the fog alone by recorded distance, in the units of ``THRESHOLD``.

    ``beta_b`` times the integral over r' of ``exp(-2 alpha r') / r'^2`` x crossover x pulse, by the midpoint rule; the
    pulse is centred on the recorded distance and scaled so that a surface at r returns ``reflectance / pi / r^2``.

    Returns:
        Distances f64[M] in metres and powers f64[M].
    """
    alpha = math.log(20.0) / visibility_m
    r = (np.arange(int(reach_m / step_m), dtype=np.float64) + 0.5) * step_m
    density = np.exp(-2 * alpha * r) / r**2 * np.clip((r - CROSS_FROM_M) / (CROSS_TO_M - CROSS_FROM_M), 0, 1)
    shape = _pulse((np.arange(int(2 * PULSE_M / step_m), dtype=np.float64) + 0.5) * step_m)
    power = np.convolve(density, shape, mode="same") * step_m
    return r, BACKSCATTER / visibility_m * power


def in_fog(range_m: Array, reflectance: Array, visibility_m: float, seed: int) -> BeamReturns:
    """A sweep in fog. Only beams that hit a surface are known: beams into the sky stay without return.

    Args:
        range_m: f64[N] to the surface, metres.
        reflectance: f64[N] of the surface times the cosine of incidence, 0 to 1.
        visibility_m: meteorological optical range.
        seed: of the jitter of soft returns.
    """
    range_m, reflectance = np.asarray(range_m, np.float64), np.asarray(reflectance, np.float64)
    alpha = math.log(20.0) / visibility_m
    hard = reflectance / math.pi / range_m**2 * np.exp(-2 * alpha * range_m)
    distances, powers = soft_response(visibility_m)
    best = np.maximum.accumulate(powers)  # the strongest fog nearer than the surface
    place = np.maximum.accumulate(np.where(powers >= best, np.arange(len(powers)), 0))
    index = np.clip(np.searchsorted(distances, range_m) - 1, 0, len(distances) - 1)
    soft = best[index]
    kind = np.where(np.maximum(hard, soft) < THRESHOLD, LOST, np.where(soft > hard, SOFT, HARD)).astype(np.uint8)
    jitter = seeds.numpy_rng(seed, len(range_m), "soft returns").normal(0, SOFT_JITTER_M, len(range_m))
    near = np.clip(distances[place[index]] + jitter, np.minimum(CROSS_FROM_M, range_m), range_m)
    shown = np.where(kind == SOFT, near, range_m)
    power = np.where(kind == SOFT, soft, hard)
    return BeamReturns(shown, np.where(kind == LOST, 0.0, power * math.pi * range_m**2), kind)


def in_rain(range_m: Array, reflectance: Array, mm_h: float, seed: int) -> BeamReturns:
    """A sweep in rain of a rate in mm/h: weaker and lost returns, and noise of the range. Arguments as of
    ``in_fog``."""
    range_m, reflectance = np.asarray(range_m, np.float64), np.asarray(reflectance, np.float64)
    share = np.exp(-0.02 * mm_h**0.6 * range_m) if mm_h > 0 else np.ones_like(range_m)
    kept = reflectance / math.pi / range_m**2 * share >= THRESHOLD
    sigma = 0.02 * range_m * (1 - math.exp(-mm_h)) ** 2
    noise = seeds.numpy_rng(seed, len(range_m), "rain range").normal(0, 1, len(range_m)) * sigma
    return BeamReturns(
        np.where(kept, np.maximum(range_m + noise, 0.1), range_m),
        np.where(kept, reflectance * share, 0.0),
        np.where(kept, HARD, LOST).astype(np.uint8),
    )


def sweep_in_weather(points: SweepPoints, weather: WeatherSettings, seed: int) -> tuple[SweepPoints, NDArray[np.uint8]]:
    """A sweep as it would have been in fog and rain.

    The recorded intensity is taken as reflectance times the cosine of incidence, 0 to 1: sensors whose intensity means
    something else need it converted first. Snow in the air is not modelled.

    Args:
        points: in the LiDAR's frame, recorded in clear air.
        weather: fog and rain of it.
        seed: another for every sweep.

    Returns:
        The points that return, moved along their beams, and for each 1 = surface, 2 = fog, u8[N].
    """
    xyz = points.xyz.astype(np.float64)
    distance = np.maximum(np.linalg.norm(xyz, axis=1), 1e-3)
    beams = xyz / distance[:, None]
    shown, intensity = distance, points.intensity.astype(np.float64)
    kind = np.full(len(xyz), HARD, np.uint8)
    if weather.fog is not None:
        fog = in_fog(shown, intensity, weather.fog.visibility_m, seed)
        shown, intensity, kind = fog.range_m, fog.intensity, fog.kind
    if weather.rain is not None:
        # fog that returned stands near the sensor and is recorded as it is
        rain = in_rain(shown, intensity, weather.rain.mm_h, seed)
        hard = kind == HARD
        shown, intensity = np.where(hard, rain.range_m, shown), np.where(hard, rain.intensity, intensity)
        kind = np.where(hard, rain.kind, kind).astype(np.uint8)
    kept = kind != LOST
    classes = (
        None if points.classes is None else np.where(kind == SOFT, UNLABELLED, points.classes).astype(np.uint8)[kept]
    )
    moved = (beams * shown[:, None]).astype(np.float32)[kept]
    result = SweepPoints(moved, np.clip(intensity, 0, 1).astype(np.float32)[kept], points.dt_s[kept], classes)
    return result, kind[kept]
