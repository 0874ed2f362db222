"""Settings of single methods, beside those of every fit."""

from __future__ import annotations

from typing import Literal

from mudg.base.config import setting, settings
from mudg.gaussians.settings import FitConfig


@settings
class RadianceConfig:
    """Method emernerf (``baselines/emernerf.py``)."""

    size: Literal["small", "published", "tiny"] = "small"
    """emernerf: sizes of the networks, and numbers of rays and samples (docs/baselines.md)."""


@settings
class MethodConfig(FitConfig):
    """Settings of every fit, and those of single methods."""

    radiance: RadianceConfig = setting(default_factory=RadianceConfig)
