"""The recipe of every method that is fitted."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

from mudg.stages.fitting.pvg import VibrationRecipe
from mudg.stages.fitting.recipe import Recipe

RECIPES: Final[Mapping[str, Recipe]] = {"pvg": VibrationRecipe()}
COMMON: Final = Recipe()


def recipe_of(method: str) -> Recipe:
    """What a method does beyond the common loop."""
    return RECIPES.get(method, COMMON)
