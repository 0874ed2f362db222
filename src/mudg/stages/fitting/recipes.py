"""The recipe of every method that is fitted."""

from __future__ import annotations

import pkgutil
from collections.abc import Mapping
from typing import Final

from mudg.stages.fitting.recipe import Recipe

RECIPES: Final[Mapping[str, str]] = {
    "gs3d": "mudg.stages.fitting.recipe:StaticRecipe",
    "bezier": "mudg.stages.fitting.bezier:BezierRecipe",
    "omnire": "mudg.stages.fitting.omnire:OmniRecipe",
    "pvg": "mudg.stages.fitting.pvg:VibrationRecipe",
    "s3gaussian": "mudg.stages.fitting.s3gaussian:FieldRecipe",
}
"""Of published methods that are fitted to recorded views alone: where their class is, imported when it is needed."""
SUPERVISED: Final[Mapping[str, str]] = {"difix": "mudg.stages.fitting.difix:RepairRecipe"}


def recipe_of(method: str) -> Recipe:
    """What a method does beyond the common loop."""
    home = RECIPES.get(method) or SUPERVISED.get(method)
    return Recipe() if home is None else pkgutil.resolve_name(home)()
