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


SMALL_RADIANCE = {
    "radiance__rays": 48,
    "radiance__lidar_rays": 24,
    "radiance__proposal_samples": (16, 12),
    "radiance__samples": 8,
    "radiance__static_grid": (3, 2, 4, 16, 10),
    "radiance__dynamic_grid": (3, 2, 4, 16, 10),
    "radiance__flow_grid": (2, 2, 4, 8, 9),
    "radiance__first_proposal_grid": (2, 1, 4, 8, 9),
    "radiance__second_proposal_grid": (2, 1, 4, 16, 9),
    "radiance__width": 8,
    "radiance__proposal_width": 8,
}
"""A radiance field of the smallest networks."""
