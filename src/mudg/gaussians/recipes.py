"""What a published method does beyond the common loop of ``gaussians/fit.py``: its start, its own losses, what each
step renders.

A recipe is a class with the methods of ``Recipe``, which itself adds nothing, and one row in ``RECIPES``.
"""

from __future__ import annotations

import math
import pkgutil
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from operator import attrgetter
from typing import ClassVar, Final

from torch import Tensor

from mudg.base.errors import UsageError
from mudg.base.types import Gaussians, Render
from mudg.core import losses
from mudg.core.raster.rasterize import RasterConfig
from mudg.gaussians.model import SceneModel
from mudg.gaussians.schedule import LAST_DENSIFIED, PUBLISHED_STEPS
from mudg.gaussians.settings import UNFIT, WEIGHTS, FitConfig
from mudg.gaussians.start import FitStart
from mudg.gaussians.views import TrainView

SCENE_UNIT_M = 10.0
"""Published weights and rates belong to scenes whose unit is this long."""
SKY_M = 900.0 * SCENE_UNIT_M
LIDAR_DECAY_STEPS = 8000.0


@dataclass(frozen=True, eq=False)
class DrawnView:
    """What a step drew of a recorded view, for the terms of a recipe. ``model``: as it was drawn
    (``Recipe.drawn_model``). ``step``: from 1."""

    model: SceneModel
    gaussians: Gaussians
    render: Render
    view: TrainView
    step: int
    config: FitConfig
    raster: RasterConfig

    @cached_property
    def inverse_depth(self) -> Tensor:
        """Of the render, per scene unit; the sky at ``SKY_M``."""
        return losses.inverse_depth(self.render.depth, self.render.alpha, SKY_M) * SCENE_UNIT_M

    def lidar_term(self, weight: float) -> dict[str, Tensor]:
        """The error of inverse depth at LiDAR points, whose weight decays; empty without points."""
        if (lidar := self.view.lidar) is None:
            return {}
        error = losses.sparse_inverse_depth(self.inverse_depth, lidar.pixel, lidar.depth_m / SCENE_UNIT_M)
        published_step = self.step * PUBLISHED_STEPS / self.config.iterations
        return {"lidar": weight * math.exp(-published_step / LIDAR_DECAY_STEPS) * error}


class Recipe:
    """A method that is the common loop and nothing else."""

    last_densified: ClassVar[float] = LAST_DENSIFIED
    """Share of the run after which it adds no more Gaussians by gradients."""

    def check(self, config: FitConfig, continues: bool) -> None:
        """Refuse settings that the method cannot follow. UsageError: naming the setting."""
        unfit, weights, usual = UNFIT.get(config.method, ()), WEIGHTS.get(config.method, ()), FitConfig()
        if continues and config.method in RECIPES:
            raise UsageError(f"{config.method} cannot go on with a finished fit", remedy="leave out --start-from")
        for name in (*unfit, *weights):
            expected, got = (str(attrgetter(name)(one)) for one in (usual, config))
            if got != expected:
                reason = "knows nothing of it" if name in unfit else "has published weights of its own"
                remedy = "leave the setting out, or choose --method street_gaussians"
                raise UsageError(f"{config.method} {reason}", where=name, expected=expected, got=got, remedy=remedy)

    def used(self, config: FitConfig) -> FitConfig:
        """The settings with those put in that the method fixes."""
        return config

    def common(self, config: FitConfig) -> FitConfig:
        """The settings of the common loss terms: those that the method replaces weigh nothing."""
        weights = [name.removeprefix("loss.") for name in WEIGHTS.get(config.method, ())]
        return replace(config, loss=replace(config.loss, **dict.fromkeys(weights, 0.0))) if weights else config

    def start(self, given: FitStart) -> SceneModel:
        """The model that the fit starts from."""
        return given.model()

    def drawn_model(self, model: SceneModel, view: TrainView, step: int, config: FitConfig) -> SceneModel:
        """The model as a step draws it; it shares all parameters with ``model``."""
        return model

    def terms(self, drawn: DrawnView) -> dict[str, Tensor]:
        """Weighted loss terms of the method, beside the common ones."""
        return {}


REPAIRED: Final = {
    "probability": 0.3,
    "continued_probability": 0.3,
    "color_weight": 0.3,
    "ssim_weight": 0.2,
    "gaussians": 0,
    **dict.fromkeys(("perceptual_weight", "depth_weight", "lidar_weight", "semantic_weight"), 0.0),
}
"""Settings of ``virtual`` that ``difix`` fixes: three in ten steps learn from the colour of a repaired render."""


class RepairRecipe(Recipe):
    """The fit of ``difix``: Difix3D (Wu et al. 2025), a scene that learns from its own renders beside the path,
    repaired.

    Published, and here: renders at poses that move towards the wanted ones step by step (``benchmarks/chain.py``) are
    repaired in one pass of a network that sees the render and a recorded image. Different here (``docs/baselines.md``):
    the network is our diffusion model; objects have boxes, as in ``street_gaussians``. Left out: the repair of what the
    finished scene shows."""

    def used(self, config: FitConfig) -> FitConfig:
        return replace(config, virtual=replace(config.virtual, **REPAIRED))


RECIPES: Final[Mapping[str, str]] = {
    "gs3d": "mudg.gaussians.recipes:Recipe",
    "bezier": "mudg.baselines.bezier:BezierRecipe",
    "omnire": "mudg.baselines.omnire:OmniRecipe",
    "pvg": "mudg.baselines.pvg:VibrationRecipe",
    "s3gaussian": "mudg.baselines.s3gaussian:FieldRecipe",
}
"""Of published methods that are fitted to recorded views alone: where their class is, imported when it is needed."""


def recipe_of(method: str) -> Recipe:
    """What a method does beyond the common loop."""
    if method in RECIPES:
        return pkgutil.resolve_name(RECIPES[method])()
    return RepairRecipe() if method == "difix" else Recipe()
