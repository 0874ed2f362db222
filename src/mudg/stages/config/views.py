"""Settings of ``mudg render`` and ``mudg score``."""

from __future__ import annotations

from typing import Literal

from pydantic import Field
from pydantic.dataclasses import dataclass

from mudg.base.config import STRICT


@dataclass(frozen=True, kw_only=True, config=STRICT)
class RenderConfig:
    """Render a fitted scene on recorded and shifted trajectories."""

    cameras: tuple[str, ...] = ("front",)
    """Cameras to render. Names that the scene lacks are an error; empty = the first camera."""
    shifts_m: tuple[float, ...] = (0.0, 2.0, -2.0, 3.0, -3.0, 4.0, -4.0)
    """Lateral shifts, metres, positive to the left of the direction of travel; 0 = the recorded drive."""
    height_m: float = 0.0
    """Added to the height of shifted cameras."""
    yaw_deg: float = 0.0
    """Turn of shifted cameras about the vertical, counter-clockwise from above."""
    width_px: int = Field(default=0, ge=0)
    """Image width (0 = as recorded)."""
    remove_tracks: tuple[str, ...] = ()
    """Moving objects to leave out."""
    sky_below_alpha: float = Field(default=0.5, ge=0, le=1)
    """Pixels covered less than this are sky: no depth, semantics sky."""
    video: bool = True
    """Also write a video per trajectory."""
    fps: float = Field(default=10.0, gt=0)
    """Pictures per second of the videos."""
    raster: Literal["auto", "cpu", "torch", "gsplat"] = "auto"
    """Backend of the renderer; auto takes the fastest there is and says which."""


@dataclass(frozen=True, kw_only=True, config=STRICT)
class ScoreConfig:
    """Score renders and generated views against truth where it exists."""

    width_px: int = Field(default=0, ge=0)
    """Width at which everything is compared; the height follows (0 = the size of the scene's camera)."""
    baseline: bool = True
    """Also score the sparse condition with its holes filled by the nearest point: the bar a model has to clear."""
    perceptual_views: int = Field(default=8, ge=0)
    """At so many views of every trajectory, evenly spread, also the perceptual distance, which costs more than all other metrics
    together (0 = never)."""
    lpips_weights: str = ""
    """Safetensors file with LPIPS weights (AlexNet, version 0.1, the lpips package's names), for LPIPS at the same views (empty = not
    computed)."""
    error_pictures: bool = True
    """Write one picture of the colour error for the middle view of every trajectory."""
