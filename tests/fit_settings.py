"""Short settings of a fit for tests."""

from __future__ import annotations

from typing import Any

from mudg.base import config as configuration
from mudg.gaussians.settings import FitConfig


def fit_config(**changes: Any) -> FitConfig:
    """A configuration with some fields changed; two underscores stand between a group and its field:
    ``densify__kind="none"``."""
    dotted = {name.replace("__", "."): value for name, value in changes.items()}
    return configuration.load(FitConfig, overrides=configuration.nested(dotted))


SMALL_RADIANCE = {"radiance__size": "tiny", "radiance__rays": 48, "radiance__lidar_rays": 24}
"""A radiance field of the smallest networks."""
