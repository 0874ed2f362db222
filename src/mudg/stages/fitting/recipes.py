"""The recipe of every method that is fitted."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

from mudg.stages.fitting.bezier import BezierRecipe
from mudg.stages.fitting.difix import RepairRecipe
from mudg.stages.fitting.omnire import OmniRecipe
from mudg.stages.fitting.pvg import VibrationRecipe
from mudg.stages.fitting.recipe import Recipe, StaticRecipe
from mudg.stages.fitting.s3gaussian import FieldRecipe

RECIPES: Final[Mapping[str, Recipe]] = {
    "gs3d": StaticRecipe(),
    "bezier": BezierRecipe(),
    "omnire": OmniRecipe(),
    "pvg": VibrationRecipe(),
    "s3gaussian": FieldRecipe(),
}
"""Of published methods that are fitted to recorded views alone."""
SUPERVISED: Final[Mapping[str, Recipe]] = {"difix": RepairRecipe()}
COMMON: Final = Recipe()


def recipe_of(method: str) -> Recipe:
    """What a method does beyond the common loop."""
    return RECIPES.get(method) or SUPERVISED.get(method, COMMON)
