"""Short settings of a fit for tests."""

from __future__ import annotations

from typing import Any

from mudg.base import config as configuration
from mudg.baselines.settings import MethodConfig


def fit_config(**changes: Any) -> MethodConfig:
    """A configuration with some fields changed; two underscores stand between a group and its field:
    ``densify__kind="none"``."""
    dotted = {name.replace("__", "."): value for name, value in changes.items()}
    return configuration.load(MethodConfig, overrides=configuration.nested(dotted))


SMALL_RADIANCE = {"radiance__size": "tiny"}
"""A radiance field of the smallest networks."""
