"""Skeleton of a method: Street Gaussians whose Gaussians are pressed flat (docs/extend/method.md)."""

from typing import ClassVar

from torch import Tensor

from mudg.gaussians.recipes import DrawnView, Recipe

WEIGHT = 10.0  # per metre


class FlatRecipe(Recipe):
    """The common fit, and one loss term: the mean of the smallest axis of all Gaussians, metres."""

    last_densified: ClassVar[float] = 0.5  # share of the run after which no Gaussians are added

    def terms(self, drawn: DrawnView) -> dict[str, Tensor]:
        """Weighted loss terms beside the common ones, for one recorded view."""
        return {"flat": WEIGHT * drawn.gaussians.scales.min(1).values.mean()}
