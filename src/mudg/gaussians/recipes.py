"""What a published method does beyond the common loop of ``gaussians/fit.py``: its start, its own losses, what each
step renders.

A recipe is a class with the methods of ``Recipe``, which itself adds nothing, and one row in ``recipes.RECIPES``.
"""

from __future__ import annotations

import pkgutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import ClassVar, Final

from torch import Tensor

from mudg.base.errors import UsageError
from mudg.base.types import FusedCloud, Gaussians, Render, Scene
from mudg.core.raster.rasterize import RasterConfig
from mudg.gaussians.model import SceneModel
from mudg.gaussians.schedule import LAST_DENSIFIED, PUBLISHED_STEPS
from mudg.gaussians.settings import FitConfig
from mudg.gaussians.start import start_model
from mudg.gaussians.views import StoredView, TrainView

SCENE_UNIT_M = 10.0
"""Published weights and rates belong to scenes whose unit is this long."""


@dataclass(frozen=True, eq=False)
class DrawnView:
    """What a step drew of a recorded view, for the terms of a recipe.

    Args:
        model: as it was drawn (``Recipe.drawn_model``). step: from 1.
    """

    model: SceneModel
    gaussians: Gaussians
    render: Render
    view: TrainView
    step: int
    config: FitConfig
    raster: RasterConfig

    @property
    def published_step(self) -> float:
        """The step of the published length that this one stands for."""
        return self.step * PUBLISHED_STEPS / self.config.iterations


class Recipe:
    """A method that is the common loop and nothing else.

    ``own_weights``: settings of ``loss`` that are its own, published ones.
    """

    own_weights: ClassVar[tuple[str, ...]] = ()
    unfit: ClassVar[tuple[str, ...]] = ()
    """Settings, ``group.field``, that mean nothing to the method and must keep their defaults."""
    last_densified: ClassVar[float] = LAST_DENSIFIED
    """Share of the run after which it adds no more Gaussians by gradients."""

    def check(self, config: FitConfig, continues: bool) -> None:
        """Refuse settings that the method cannot follow.

        Raises:
            UsageError: naming the setting.
        """

    def used(self, config: FitConfig) -> FitConfig:
        """The settings with those put in that the method fixes."""
        return config

    def common(self, config: FitConfig) -> FitConfig:
        """The settings of the common loss terms: those that the method replaces weigh nothing."""
        if not self.own_weights:
            return config
        return replace(config, loss=replace(config.loss, **dict.fromkeys(self.own_weights, 0.0)))

    def start(
        self, scene: Scene, fused: FusedCloud, views: Sequence[StoredView], classes: tuple[int, ...], config: FitConfig
    ) -> SceneModel:
        """The model that the fit starts from."""
        return start_model(scene, fused, views, classes, config)

    def drawn_model(self, model: SceneModel, view: TrainView, step: int, config: FitConfig) -> SceneModel:
        """The model as a step draws it; it shares all parameters with ``model``."""
        return model

    def terms(self, drawn: DrawnView) -> dict[str, Tensor]:
        """Weighted loss terms of the method, beside the common ones."""
        return {}


class OwnRecipe(Recipe):
    """A recipe with rules about settings: common to all that are not the common loop."""

    def check(self, config: FitConfig, continues: bool) -> None:
        """See ``Recipe``."""
        default = FitConfig()
        if continues:
            raise UsageError(f"{config.method} cannot go on with a finished fit", remedy="leave out --start-from")
        for name in (*self.unfit, *(f"loss.{weight}" for weight in self.own_weights)):
            group, _, field = name.partition(".")
            given, usual = (getattr(getattr(of, group), field) for of in (config, default))
            if given != usual:
                reason = (
                    "has published weights of its own"
                    if group == "loss" and field in self.own_weights
                    else "knows nothing of it"
                )
                raise UsageError(
                    f"{config.method} {reason}",
                    where=name,
                    expected=str(usual),
                    got=str(given),
                    remedy="leave the setting out, or choose --method street_gaussians",
                )
        if config.densify.kind == "mcmc":
            raise UsageError(
                f"{config.method} densifies by gradients", where="densify.kind", expected="gradient or none", got="mcmc"
            )


BOX_SETTINGS = ("poses.learn", "objects.deformable", "objects.mirror_start", "loss.object_weight")
"""Settings about dynamic objects, which methods without boxes do not know."""


class StaticRecipe(OwnRecipe):
    """``gs3d``: the common loop, without dynamic objects."""

    unfit: ClassVar[tuple[str, ...]] = BOX_SETTINGS


# the recipe of every method that is fitted --------------------------------------------------------


RECIPES: Final[Mapping[str, str]] = {
    "gs3d": "mudg.gaussians.recipes:StaticRecipe",
    "bezier": "mudg.baselines.bezier:BezierRecipe",
    "omnire": "mudg.baselines.omnire:OmniRecipe",
    "pvg": "mudg.baselines.pvg:VibrationRecipe",
    "s3gaussian": "mudg.baselines.s3gaussian:FieldRecipe",
}
"""Of published methods that are fitted to recorded views alone: where their class is, imported when it is needed."""
SUPERVISED: Final[Mapping[str, str]] = {"difix": "mudg.baselines.difix:RepairRecipe"}


def recipe_of(method: str) -> Recipe:
    """What a method does beyond the common loop."""
    home = RECIPES.get(method) or SUPERVISED.get(method)
    return Recipe() if home is None else pkgutil.resolve_name(home)()
