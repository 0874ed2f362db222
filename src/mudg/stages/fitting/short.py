"""Settings of short fits: good enough to learn from what a fit gets wrong, in a few seconds."""

from __future__ import annotations

from mudg.stages.config import FitConfig
from mudg.stages.config.fit import DensifyConfig, StartConfig

MOST_GAUSSIANS, VOXEL_M = 40_000, 0.25
"""Gaussians at most, and the cubes of which each starts one, metres."""
WIDTHS = 2
"""Photographs are fitted at this many times the width of the clips that the renders are for."""


def short_fit(iterations: int, clip_width_px: int, camera_width_px: int, seed: int, device: str = "cpu") -> FitConfig:
    """A fit to recorded views alone, for renders in the conditions of clips `clip_width_px` wide."""
    return FitConfig(
        method="street_gaussians", iterations=iterations, width_px=min(WIDTHS * clip_width_px, camera_width_px), seed=seed,
        device=device, preview_every=1_000_000, densify=DensifyConfig(max_gaussians=MOST_GAUSSIANS),
        start=StartConfig(gaussians=MOST_GAUSSIANS, voxel_m=VOXEL_M),
    )  # fmt: skip
