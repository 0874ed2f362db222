"""Settings of ``mudg synthesize``."""

from __future__ import annotations

from typing import Literal

from pydantic import Field
from pydantic.dataclasses import dataclass

from mudg.base.config import STRICT


@dataclass(frozen=True, kw_only=True, config=STRICT)
class SynthesizeConfig:
    """Generate dense RGB, depth and semantics on shifted trajectories with the diffusion model."""

    cameras: tuple[str, ...] = ("front",)
    """Cameras to move sideways. Names that the scene lacks are an error; empty = the first camera."""
    shifts_m: tuple[float, ...] = (2.0, -2.0, 3.0, -3.0, 4.0, -4.0)
    """Lateral shifts, metres, positive to the left of the direction of travel; 0 = the recorded path."""
    model: str = "embedded"
    """"embedded" or "embedded-tiny", shipped with the package, or the folder of a model made by learn."""
    steps: int = Field(default=2, ge=1, le=1000)
    """Denoising steps. More give more texture, and less agreement with the truth pixel by pixel."""
    sampler: Literal["ddim", "dpm_solver"] = "ddim"
    """How the steps are taken. Each costs one pass of the network per step. ddim: first order, with fresh noise between steps.
    dpm_solver: second order and deterministic, for many steps."""
    eta: float | None = Field(default=None, ge=0, le=1)
    """ddim: noise added between steps, 0 = deterministic, 1 = as much as the reverse process has (not given: 1)."""
    samples: int = Field(default=1, ge=1)
    """Samples per clip; the first is kept, the spread of all lowers the confidence. Costs that many times the passes."""
    given_classes: bool = True
    """Let the classes of labelled points and recorded images into the condition, where the scene has labels."""
    label_confidence: float = Field(default=0.5, ge=0, le=1)
    """Labels of recorded images with less confidence than this are not given."""
    align_depth: bool = True
    """Bring generated depth to the scale of the LiDAR points in the same view (scale and shift per frame)."""
    overlap: int = Field(default=2, ge=0)
    """Frames that a window of the model shares with the one before; they are kept, so that the video continues."""
    width_px: int = Field(default=0, ge=0)
    """Width the model works at (0 = about the area it was trained at, in the camera's aspect)."""
    full_size: bool = True
    """Write views at the camera's size, with detail of the warped recorded images put back; otherwise at the model's."""
    held_out_images: bool = False
    """Also warp in recorded images that are held out for scoring."""
    precision: Literal["auto", "float32", "bfloat16"] = "auto"
    """auto: bfloat16 on CPUs with AMX, float32 elsewhere."""
    processes: int = Field(default=0, ge=0)
    """Trajectories made at the same time, one thread each (0 = one per core; one for a published-type model)."""
    guidance: float | None = Field(default=None, ge=1)
    """Published-type models: weight of the guided prediction; 1 = none, at half the work (not given: 7.5)."""
    guidance_rescale: float | None = Field(default=None, ge=0, le=1)
    """Published-type models: how far the spread of the guided prediction is pulled back (not given: 0.7)."""
    memory_budget_gb: float = Field(default=0.0, ge=0)
    """Published-type models: cut the work so that it fits into this memory (0 = do not cut)."""
    seed: int = 0
    """Fixes the noise."""
