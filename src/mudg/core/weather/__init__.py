"""Weather and light as pure functions of a G-buffer, in linear light. Models, sources and assumptions:
docs/weather.md."""

from mudg.core.weather.apply import DriveFacts, ShownView, apply, drive_facts, edited_view
from mudg.core.weather.gbuffer import (
    GBuffer,
    OccluderMap,
    Surroundings,
    estimate_surroundings,
    from_render,
    sun_visibility,
)

__all__ = [
    "DriveFacts",
    "GBuffer",
    "OccluderMap",
    "ShownView",
    "Surroundings",
    "apply",
    "drive_facts",
    "edited_view",
    "estimate_surroundings",
    "from_render",
    "sun_visibility",
]
