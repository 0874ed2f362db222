"""The effect vector: weather and light that a view is to have, in eight numbers, as the diffusion model's condition holds it."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from mudg.base.weather_settings import Conditions

EFFECTS: Final = ("cloud", "fog", "rain", "snow", "wet", "puddle", "cover", "night")
"""Names of the numbers, each from 0 (as recorded) to 1: overcast sky, fog, falling rain and snow, wet ground, its share under standing
water, snow cover, night (dusk: a half)."""

HALF_FOG_M: Final = 100.0
"""Visibility in metres at which fog counts a half; rates of falling rain and snow, mm/h, that do."""
HALF_RAIN_MM_H: Final = 10.0
HALF_SNOW_MM_H: Final = 2.0
DUSK: Final = 0.5


def effect_vector(conditions: Conditions | None) -> tuple[float, ...] | None:
    """The effect vector of weather and light; None where they ask for nothing of it. Seasons and exposure have no part in it."""
    if conditions is None:
        return None
    weather, light = conditions.weather, conditions.light.time
    rain = 0.0 if weather.rain is None else weather.rain.mm_h
    falling, cover = (0.0, 0.0) if weather.snow is None else (weather.snow.mm_h, weather.snow.cover)
    vector = (
        float(light == "overcast"),
        0.0 if weather.fog is None else HALF_FOG_M / (HALF_FOG_M + weather.fog.visibility_m),
        rain / (HALF_RAIN_MM_H + rain),
        falling / (HALF_SNOW_MM_H + falling),
        weather.wet,
        weather.wet and weather.puddles,
        cover,
        {"night": 1.0, "dusk": DUSK}.get(light, 0.0),
    )
    return vector if any(vector) else None
