"""Short settings of a fit for tests."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from mudg.base import config as configuration
from mudg.baselines.settings import MethodConfig
from mudg.gaussians.settings import FitConfig
from mudg.steps.fit import Fit


def fit_config(**changes: Any) -> MethodConfig:
    """A configuration with some fields changed; two underscores stand between a group and its field:
    ``densify__kind="none"``."""
    dotted = {name.replace("__", "."): value for name, value in changes.items()}
    return configuration.load(MethodConfig, overrides=configuration.nested(dotted))


SMALL_RADIANCE = {"radiance__size": "tiny"}
"""A radiance field of the smallest networks."""


def fit_to(world: Mapping[str, Path], out: Path, settings: FitConfig, **more: Any) -> Fit:
    """A fit to the scene and the clouds of a world."""
    return Fit(scene=world["scene"], fused=world["fuse"], out=out, settings=settings, **more)
