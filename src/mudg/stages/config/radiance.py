"""Settings of ``mudg fit --method emernerf``."""

from __future__ import annotations

from pydantic import Field
from pydantic.dataclasses import dataclass

from mudg.base.config import STRICT

GridSizes = tuple[int, int, int, int, int]


@dataclass(frozen=True, kw_only=True, config=STRICT)
class RadianceConfig:
    """Method emernerf: sizes, samples and losses. A grid is five numbers: levels, features per level, cells along an axis of the coarsest
    and of the finest level, and log2 of the largest number of entries per level."""

    rays: int = Field(default=512, ge=1)
    """Pixels per step."""
    lidar_rays: int = Field(default=256, ge=1)
    """LiDAR rays per step."""
    error_share: float = Field(default=0.25, ge=0, le=1)
    """Share of the pixels that are drawn where the colour error was large, 0 to 1."""
    proposal_samples: tuple[int, int] = (64, 32)
    """Samples per ray of the two proposal rounds."""
    samples: int = Field(default=32, ge=2)
    """Samples per ray of the fields."""
    near_m: float = Field(default=0.1, gt=0)
    """Distance of the nearest sample, in metres."""
    far_m: float = Field(default=1000.0, gt=200)
    """Distance of the farthest sample, in metres, above 200."""
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
    appearance: int = Field(default=16, ge=1)
    """Numbers that describe the appearance of a camera."""
    rate: float = Field(default=0.01, gt=0)
    """Learning rate after the warm-up, which is the first tenth; a third of it after 1/4, 1/2, 3/4 and 9/10 of the iterations each."""
    weight_decay: float = Field(default=1e-5, ge=0)
    """Weight decay of Adam, added to the gradient."""
    proposals_every: int = Field(default=5, ge=1)
    """After the first tenth the proposal networks learn at every n-th step only."""
    sky_weight: float = Field(default=0.001, ge=0)
    """Weight of the sky's opacity (cross-entropy), where the sky is labelled."""
    lidar_weight: float = Field(default=1.0, ge=0)
    """Weight of the LiDAR range (squared, as a share of 80 m)."""
    sight_weight: float = Field(default=0.1, ge=0)
    """Weight of the line of sight: empty before the LiDAR point, dense at it."""
    sight_start: float = Field(default=0.08, ge=0, le=1)
    """Share of the iterations before the line of sight counts, 0 to 1."""
    sight_least_m: float = Field(default=0.6, gt=0)
    """Half width of a surface in the line of sight at the end, in metres; it begins at 6 m (published: 2.5)."""
    dynamic_weight: float = Field(default=0.002, ge=0)
    """Weight of the mean density of the dynamic field; it grows from 0 to this between a tenth and half of the iterations (published:
    0.01, at once)."""
    shadow_weight: float = Field(default=0.01, ge=0)
    """Weight of the squared shadow."""
    cycle_weight: float = Field(default=0.01, ge=0)
    """Weight of the flow's consistency there and back."""
