"""Settings of ``mudg edit``."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar, Literal

from mudg.base.config import setting, settings
from mudg.base.devices import DeviceName
from mudg.diffusion.settings import HarmonizeConfig


@settings
class EditConfig:
    """Change a drive as an edit script says."""

    RETIRED: ClassVar[Mapping[str, tuple[str, Any]]] = {
        "changed_above": ("harmonize", 4 / 255),
        "grow_px": ("harmonize", 2),
    }

    harmonize: HarmonizeConfig = setting(default_factory=HarmonizeConfig)
    """Of a whole run: let the diffusion model repair what the edits touch in its images."""
    raster: Literal["auto", "cpu", "torch", "gsplat"] = "auto"
    """Rasteriser backend. auto picks the fastest one available and prints its name."""
    device: DeviceName = "auto"
    """Device: auto (CUDA if there is one), cpu, cuda, cuda:N."""
