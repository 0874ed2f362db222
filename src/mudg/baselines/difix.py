"""The fit of ``difix``: Difix3D (Wu et al. 2025), a scene that learns from its own renders beside the path, repaired.

Published, and here: renders at poses that move towards the wanted ones step by step (``benchmarks/chain.py``) are
repaired in one pass of a network that sees the render and a recorded image; of the steps that may use them, three in
ten learn from one, with weight 0.3. Different here (``docs/baselines.md``): the network is our diffusion model; objects
have boxes, as in ``street_gaussians``. Left out: the repair of what the finished scene shows.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Final

from mudg.gaussians.recipes import Recipe
from mudg.gaussians.settings import FitConfig

PROBABILITY: Final = 0.3
COLOR_WEIGHT: Final = 0.3
SSIM_SHARE: Final = 0.2


class RepairRecipe(Recipe):
    """See the module's text."""

    def used(self, config: FitConfig) -> FitConfig:
        """See ``Recipe``. Only the colour of repaired renders counts."""
        virtual = replace(
            config.virtual,
            probability=PROBABILITY,
            continued_probability=PROBABILITY,
            color_weight=COLOR_WEIGHT,
            ssim_weight=SSIM_SHARE,
            perceptual_weight=0.0,
            depth_weight=0.0,
            lidar_weight=0.0,
            semantic_weight=0.0,
            gaussians=0,
        )
        return replace(config, virtual=virtual)
