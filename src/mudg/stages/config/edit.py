"""Settings of ``mudg edit``."""

from __future__ import annotations

from typing import Literal

from pydantic import Field
from pydantic.dataclasses import dataclass

from mudg.base.config import STRICT
from mudg.base.devices import DeviceName
from mudg.stages.config.harmonize import HarmonizeConfig


@dataclass(frozen=True, kw_only=True, config=STRICT)
class EditConfig:
    """Change a drive as an edit script says."""

    changed_above: float = Field(default=4 / 255, ge=0, le=1)
    """Images of an edited run keep the recorded pixels where renders with and without the edits differ by less than this, 0 to 1."""
    grow_px: int = Field(default=2, ge=0)
    """The rest is grown by this many pixels, and comes from the render of the edited scene."""
    harmonize: HarmonizeConfig = Field(default_factory=HarmonizeConfig)
    """Of a whole run: let the diffusion model repair what the edits touch in its images."""
    raster: Literal["auto", "cpu", "torch", "gsplat"] = "auto"
    """Rasteriser backend. auto picks the fastest one available and prints its name."""
    device: DeviceName = "auto"
    """Device: auto (CUDA if there is one), cpu, cuda, cuda:N."""
