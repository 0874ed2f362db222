"""Settings of ``mudg fit --method emernerf``."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

from pydantic import Field
from pydantic.dataclasses import dataclass

from mudg.base.config import STRICT

GridSizes = tuple[int, int, int, int, int]


@dataclass(frozen=True, kw_only=True, config=STRICT)
class RadianceConfig:
    """Method emernerf: sizes and samples. A grid is five numbers: levels, features per level, cells along an axis of the coarsest
    and of the finest level, and log2 of the largest number of entries per level."""

    RETIRED: ClassVar[Mapping[str, tuple[str, Any]]] = {
        "error_share": ("proposal_samples", 0.25), "near_m": ("static_grid", 0.1), "far_m": ("static_grid", 1000.0), "appearance": ("", 16),
        "rate": ("", 0.01), "weight_decay": ("", 1e-5), "proposals_every": ("", 5), "sky_weight": ("", 0.001), "lidar_weight": ("", 1.0),
        "sight_weight": ("", 0.1), "sight_start": ("", 0.08), "sight_least_m": ("", 0.6), "dynamic_weight": ("", 0.002),
        "shadow_weight": ("", 0.01), "cycle_weight": ("", 0.01),
    }  # fmt: skip

    rays: int = Field(default=512, ge=1)
    """Pixels per step."""
    lidar_rays: int = Field(default=256, ge=1)
    """LiDAR rays per step."""
    proposal_samples: tuple[int, int] = (64, 32)
    """Samples per ray of the two proposal rounds."""
    samples: int = Field(default=32, ge=2)
    """Samples per ray of the fields."""
    static_grid: GridSizes = (8, 2, 16, 1024, 17)
    """Grid of the static field, in space."""
    dynamic_grid: GridSizes = (8, 2, 8, 256, 17)
    """Grid of the dynamic field, in space and time. Levels with more places than entries share them: 32 cells along each of four axes are
    a million places."""
    flow_grid: GridSizes = (8, 2, 8, 128, 15)
    """Grid of the flow field, in space and time."""
    first_proposal_grid: GridSizes = (5, 1, 16, 128, 16)
    """Grid of the first proposal network, in space."""
    second_proposal_grid: GridSizes = (5, 1, 16, 512, 16)
    """Grid of the second proposal network, in space."""
    width: int = Field(default=32, ge=1)
    """Width of the networks and of their features."""
    proposal_width: int = Field(default=16, ge=1)
    """Width of the proposal networks."""
