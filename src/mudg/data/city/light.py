"""Sun, sky, weather and camera response of a generated city."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mudg.base import seeds
from mudg.data.city.config import CityConfig


def light_numbers(config: CityConfig) -> tuple[str, NDArray[np.float64]]:
    """The chosen light and its numbers, in the order of ``LightNumber`` in native/city.cpp."""
    rng = seeds.numpy_rng(config.seed, 0, "city light")
    name = config.light
    pick = rng.choice(["day", "overcast", "dusk"], p=[0.62, 0.24, 0.14])
    if name == "auto":
        name = str(pick)
    azimuth = rng.uniform(0, 2 * np.pi)
    tint = rng.uniform(0.96, 1.04, 3)
    if name == "day":
        elevation = np.deg2rad(rng.uniform(18, 62))
        sun = np.array([3.3, 3.05, 2.65]) * rng.uniform(0.85, 1.15)
        zenith, horizon = np.array([0.20, 0.40, 0.86]) * rng.uniform(0.8, 1.1), np.array([0.66, 0.80, 0.98])
        ambient, cloud = np.array([0.78, 0.88, 1.06]) * rng.uniform(0.85, 1.15), np.array([1.25, 1.25, 1.27])
        cloudiness, haze, night, exposure = rng.uniform(0.0, 0.95), rng.uniform(400, 1600), 0.0, rng.uniform(0.50, 0.72)
    elif name == "overcast":
        elevation = np.deg2rad(rng.uniform(30, 60))
        sun = np.array([0.30, 0.30, 0.30]) * rng.uniform(0.0, 1.0)
        zenith, horizon = np.array([0.80, 0.84, 0.92]) * rng.uniform(0.8, 1.1), np.array([1.02, 1.04, 1.08])
        ambient, cloud = np.array([1.0, 1.03, 1.1]) * rng.uniform(0.9, 1.1), np.array([0.86, 0.87, 0.90])
        cloudiness, haze, night, exposure = rng.uniform(0.6, 1.1), rng.uniform(350, 1400), 0.05, rng.uniform(0.75, 1.0)
    else:
        elevation = np.deg2rad(rng.uniform(3.0, 9.0))
        azimuth = rng.uniform(0.35, 2 * np.pi - 0.35)
        sun = np.array([2.6, 1.45, 0.68]) * rng.uniform(0.5, 1.1)
        zenith, horizon = np.array([0.20, 0.27, 0.50]) * rng.uniform(0.8, 1.2), np.array([1.05, 0.68, 0.45])
        ambient, cloud = np.array([0.40, 0.42, 0.56]) * rng.uniform(0.85, 1.2), np.array([0.86, 0.58, 0.50])
        cloudiness, haze, night, exposure = rng.uniform(0.1, 0.8), rng.uniform(250, 900), 0.6, rng.uniform(0.85, 1.25)
    direction = [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)]
    numbers = [
        *direction, *sun, *zenith, *horizon, *ambient, *cloud, *tint, cloudiness, haze, night, exposure,
        rng.uniform(0.95, 1.08), rng.uniform(0.85, 1.08), rng.uniform(0.003, 0.009), rng.uniform(0.05, 0.3), 0.0035,
    ]  # fmt: skip
    return name, np.array(numbers, np.float64)
