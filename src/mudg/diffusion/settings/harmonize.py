"""Settings of harmonising: what a diffusion model may change in the views of an edited scene."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar, Literal

from mudg.base.config import setting, settings


@settings
class HarmonizeConfig:
    """Where and how far a diffusion model changes the views of an edited scene."""

    RETIRED: ClassVar[Mapping[str, tuple[str, Any]]] = {
        "weather_any_model": ("seed", False),
        "changed_above": ("seed", 4 / 255),
        "feather_px": ("seed", 3),
        "images_per_view": ("seed", 24),
        "keep_classes": ("seed", True),
    }

    on: bool = False
    """Let the diffusion model repair what an edit script changed. Needs the fused clouds."""
    model: str = "embedded"
    """Diffusion model: "embedded" or "embedded-tiny", both shipped with the package, or a model folder written by learn
    or convert. Published-type models make views from noise: they take strengths of 0 and 1, and paths of at least 16
    frames."""
    steps: int = setting(default=2, ge=1, le=1000)
    """Denoising steps. Use 50 for published-type models."""
    uncovered: float = setting(default=1.0, ge=0, le=1)
    """How far the model may leave the render where something stood before, its shadow included: share of the noise
    schedule, 0 (it stays) to 1."""
    objects: float = setting(default=0.0, ge=0, le=1)
    """The same for objects that were moved or put in, and their shadows; 0 leaves all of them as rendered."""
    weather: float = setting(default=0.0, ge=0, le=1)
    """The same for every pixel of a view in other weather or light; 0 leaves it as the formulas of the edit make it.
    For published-type models alone, whose points and reference are edited."""
    seed: int = 0
    """Seed of the noise."""
    precision: Literal["auto", "float32", "bfloat16", "float16"] = "auto"
    """Number format of the diffusion model, as for synthesize."""
