"""Settings of weather and light for edited drives. Torch-free; ``mudg.core.weather`` applies them.

Names and units are those of an edit script. The defaults change nothing.
"""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from mudg.base.records import StrictRecord

Wind = Annotated[
    tuple[Annotated[float, Field(ge=-40, le=40)], Annotated[float, Field(ge=-40, le=40)]], Field(strict=False)
]
LightTime = Literal["as_recorded", "overcast", "dusk", "night"]


class FogSettings(StrictRecord):
    """Fog, or haze: extinction that is the same up to a height."""

    visibility_m: Annotated[float, Field(ge=5, le=100_000)] = 150.0
    """Meteorological optical range, metres: where contrast falls to 5 %. Fog is below 1000."""
    top_m: Annotated[float, Field(ge=5, le=5000)] = 300.0
    """Upper end of the fog, metres above the ground. It decides how much of the sky is seen."""


class RainSettings(StrictRecord):
    """Falling rain. It does not wet the ground: ``WeatherSettings.wet`` does."""

    mm_h: Annotated[float, Field(ge=0, le=150)] = 10.0
    """Rate, millimetres per hour: 2 is light, 10 heavy, 50 violent."""
    wind_m_s: Wind = (0.0, 0.0)
    """Wind along world x and y, metres per second."""
    reach_m: Annotated[float, Field(ge=1, le=30)] = 8.0
    """Drops nearer than this are drawn one by one; all others are a veil."""


class SnowSettings(StrictRecord):
    """Snow on the ground and falling snow."""

    cover: Annotated[float, Field(ge=0, le=1)] = 0.6
    """Share of open level surfaces that is white."""
    mm_h: Annotated[float, Field(ge=0, le=10)] = 0.0
    """Rate of falling snow as water, millimetres per hour: 1 is moderate, 4 heavy; 0 = none falls."""
    wind_m_s: Wind = (0.5, 0.0)
    """Wind along world x and y, metres per second."""
    reach_m: Annotated[float, Field(ge=1, le=30)] = 8.0
    """Flakes nearer than this are drawn one by one; all others are a veil."""


class WeatherSettings(StrictRecord):
    """Weather of an edited drive."""

    fog: FogSettings | None = None
    """Fog; none = as recorded."""
    recorded_visibility_m: Annotated[float, Field(ge=0, le=1_000_000)] = 0.0
    """Visibility on the day of the recording, metres. That haze is removed before anything else; 0 = it was clear."""
    rain: RainSettings | None = None
    """Falling rain; none = dry."""
    wet: Annotated[float, Field(ge=0, le=1)] = 0.0
    """Wetness of road and sidewalk: darker, and they mirror."""
    puddles: Annotated[float, Field(ge=0, le=1)] = 0.0
    """Share of wet ground under standing water."""
    snow: SnowSettings | None = None
    """Snow; none = none."""


class LightSettings(StrictRecord):
    """Light of an edited drive."""

    time: LightTime = "as_recorded"
    """Light to change to."""
    sun_azimuth_deg: Annotated[float, Field(ge=-360, le=360)] = 0.0
    """Where the dusk sun stands, degrees counter-clockwise from world x."""
    sun_elevation_deg: Annotated[float, Field(ge=-10, le=90)] = 6.0
    """Height of the dusk sun, degrees."""
    headlights: bool = True
    """Headlights of the recording vehicle, at night."""
    exposure_ev: Annotated[float, Field(ge=-10, le=10)] = 0.0
    """Change of exposure, stops."""


class Conditions(StrictRecord):
    """Weather and light of an edited drive."""

    weather: WeatherSettings = Field(default_factory=WeatherSettings)
    """Weather."""
    light: LightSettings = Field(default_factory=LightSettings)
    """Light."""

    @property
    def changes_air_ground_or_light(self) -> bool:
        """Whether fog, rain, snow, wet ground or another light is asked for."""
        weather = self.weather
        rain, snow = weather.rain is not None and weather.rain.mm_h > 0, weather.snow
        snowy = snow is not None and (snow.mm_h > 0 or snow.cover > 0)
        return weather.fog is not None or rain or snowy or weather.wet > 0 or self.light.time != "as_recorded"
