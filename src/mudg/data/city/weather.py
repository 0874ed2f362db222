"""Wet ground, snow and street lamps of a generated city: the numbers its ray caster needs, by the same rules as ``mudg.core.weather``."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mudg.core.weather.gbuffer import Surroundings
from mudg.core.weather.ground import noise_seed
from mudg.core.weather.noise import patch_threshold
from mudg.core.weather.relight import LAMP_POWER
from mudg.core.weather.tone import FilmicResponse
from mudg.data.city import records as rec
from mudg.data.city.config import CityConfig
from mudg.data.city.light import light_numbers


def weather_numbers(config: CityConfig) -> NDArray[np.float64] | None:
    """Numbers in the order of ``mudg_city_set_weather`` in native/city_weather.cpp; None in a city that needs none."""
    night = config.light == "night"
    if not (config.wet or config.snow_cover or night):
        return None
    puddles, snow = (noise_seed(config.seed, purpose) for purpose in ("puddles", "snow"))
    snow_level = patch_threshold(config.snow_cover, snow) if config.snow_cover else 2.0
    return np.array(
        [config.wet, patch_threshold(config.puddles, puddles), puddles, snow_level, snow, LAMP_POWER if night else 0.0]
    )


def lamp_places(rows: Sequence[Sequence[float]]) -> NDArray[np.float64]:
    """World places f64[N, 3] of the lights of all street lamps among the city's records."""
    places = []
    for row in rows:
        if int(row[0]) != rec.LAMP:
            continue
        x, y, z, yaw, height, arm, globe = *row[1:5], row[7], row[15], row[16] > 0.5
        out, up = (0.0, 0.2) if globe else (arm + 0.3, 0.36)
        places.append((x + out * math.cos(yaw), y + out * math.sin(yaw), z + height + up))
    return np.array(places, np.float64).reshape(-1, 3)


@dataclass(frozen=True, slots=True, eq=False)
class CityLight:
    """Exact light and camera of a generated city: what an edit of its images could know at best.

    Args:
        surroundings: sun, sky, airlight and lamps, the road at height 0.
        response: the camera.
        visibility_m: in the haze.
    """

    surroundings: Surroundings
    response: FilmicResponse
    visibility_m: float


def city_light(config: CityConfig, lamps: NDArray[np.float64] | None = None) -> CityLight:
    """The light of a city with a plain sky and no photographs; ``lamps`` are those of ``CityWorld.lamps``."""
    _, n = light_numbers(config)
    direction, sun, zenith, horizon, ambient, _cloud, white = n[:21].reshape(7, 3)
    haze_m, _night, exposure, contrast, saturation, _noise, vignette = n[22:29]
    airlight = 0.875 * horizon + 0.075 * ambient
    around = Surroundings(horizon, zenith, ambient, sun, direction, airlight, 0.0, lamps)
    r, g, b = (float(w) for w in white)
    response = FilmicResponse(float(exposure), (r, g, b), float(saturation), float(contrast), float(vignette))
    return CityLight(around, response, 3.0 * float(haze_m))
