"""Fog and haze: Koschmieder's law in linear light, ``L = L0 t + A (1 - t)`` with transmittance t and airlight A.

Extinction is 3.0 / visibility, as contrast falls to 5 % at the meteorological optical range. Distances are along the ray, not camera z.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mudg.base.weather_settings import FogSettings

Array = NDArray[np.float64]

LEAST_SHARE = 0.05
"""Haze is removed down to this transmittance: what is behind more of it cannot be recovered."""


def extinction(visibility_m: float) -> float:
    """Extinction per metre of a meteorological optical range in metres (5 % contrast: ln 20 = 3.0)."""
    return 3.0 / visibility_m


def optical_depth(range_m: Array, rise: Array, height_m: float, fog: FogSettings) -> Array:
    """Optical depth f64[...] along rays.

    Args:
        range_m: distance along the ray, metres; infinite in the sky.
        rise: sine of the ray's elevation.
        height_m: of the camera above the ground.
        fog: density and its height.
    """
    beta = extinction(fog.visibility_m)
    if fog.height_m > 0:
        h = fog.height_m
        with np.errstate(invalid="ignore", over="ignore"):
            x = np.clip(range_m * rise / h, -60, 60)
            x = np.where(np.isnan(x), 0, x)
            path = np.where(np.abs(x) < 1e-6, range_m, -np.expm1(-x) * h / np.where(np.abs(rise) < 1e-12, 1e-12, rise))
        return beta * np.exp(-height_m / h) * path
    # uniform below the top: the part of the ray that runs there
    with np.errstate(divide="ignore", invalid="ignore"):
        crossing = np.where(rise == 0, np.inf, (fog.top_m - height_m) / rise)
        below = height_m < fog.top_m
        inside = (
            np.where(rise > 0, np.minimum(range_m, crossing), range_m)
            if below
            else np.where(rise < 0, np.maximum(range_m - crossing, 0), 0.0)
        )
    return beta * inside


def transmittance(range_m: Array, rise: Array, height_m: float, fog: FogSettings) -> Array:
    """Share of the light of a surface that reaches the camera, f64[...] in [0, 1]."""
    return np.exp(-np.minimum(optical_depth(range_m, rise, height_m, fog), 700.0))


def veiled(color: NDArray[np.floating], share: Array, airlight: Array) -> NDArray[np.float32]:
    """Linear light f32[..., 3] behind air that lets the share [...] through and adds airlight f64[3] for the rest."""
    t = share[..., None]
    return (color * t + airlight * (1 - t)).astype(np.float32)


def unveiled(color: NDArray[np.floating], share: Array, airlight: Array) -> NDArray[np.float32]:
    """Inverse of ``veiled``, not below black; a share under ``LEAST_SHARE`` counts as that."""
    t = np.maximum(share, LEAST_SHARE)[..., None]
    return np.maximum((color - airlight * (1 - t)) / t, 0).astype(np.float32)
