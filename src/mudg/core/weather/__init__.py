"""Weather and light as pure functions of a G-buffer, in linear light. Models, sources and assumptions:
docs/weather.md."""

from mudg.core.weather.apply import DriveFacts, ShownView, Weathered, apply, drive_facts, edited_view
from mudg.core.weather.gbuffer import (
    BufferRules,
    GBuffer,
    OccluderMap,
    Surroundings,
    estimate_surroundings,
    from_render,
    mirror_view,
    sun_visibility,
)
from mudg.core.weather.light import FilmicResponse, ToneCurve, curve_of

__all__ = [
    "BufferRules",
    "DriveFacts",
    "FilmicResponse",
    "GBuffer",
    "OccluderMap",
    "ShownView",
    "Surroundings",
    "ToneCurve",
    "Weathered",
    "apply",
    "curve_of",
    "drive_facts",
    "edited_view",
    "estimate_surroundings",
    "from_render",
    "mirror_view",
    "sun_visibility",
]
