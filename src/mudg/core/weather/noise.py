"""Hashes and value noise of world places: the same numbers for every camera and frame.

Twins of ``hash_bits``, ``hash01`` and ``noise2`` in native/city_math.h, so that the generated city can show the same
puddles and patches of snow.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

Hashes = NDArray[np.uint32]
_QUANTILE_SIDE = 192
_QUANTILE_STEP = 0.73


def _u32(values: ArrayLike) -> Hashes:
    return np.asarray(values).astype(np.int64).astype(np.uint32)


def mix_bits(h: Hashes) -> Hashes:
    """A hash u32[...] whose every bit depends on all bits of ``h``."""
    h = h ^ (h >> np.uint32(16))
    h = h * np.uint32(0x7FEB352D)
    h = h ^ (h >> np.uint32(15))
    h = h * np.uint32(0x846CA68B)
    return h ^ (h >> np.uint32(16))


def hash_bits(a: ArrayLike, b: ArrayLike, c: ArrayLike, d: ArrayLike | None = None) -> Hashes:
    """Hash u32[...] of three or four integers (arrays broadcast)."""
    with np.errstate(over="ignore"):
        h = mix_bits(
            (_u32(a) * np.uint32(0x9E3779B1))
            ^ (_u32(b) * np.uint32(0x85EBCA77) + np.uint32(0x165667B1))
            ^ (_u32(c) * np.uint32(0xC2B2AE3D))
        )
        return h if d is None else mix_bits(h + _u32(d) * np.uint32(0x27D4EB2F))


def unit(h: Hashes) -> NDArray[np.float64]:
    """Numbers f64[...] in [0, 1) of hashes."""
    return (h >> np.uint32(8)).astype(np.float64) * (1.0 / 16777216.0)


def noise2(x: NDArray[np.floating], y: NDArray[np.floating], seed: int) -> NDArray[np.float64]:
    """Smooth value noise f64[...] in [0, 1] of a plane; its grid is 1 wide."""
    ix, iy = np.floor(x).astype(np.int64), np.floor(y).astype(np.int64)
    fx, fy = x - ix, y - iy
    fx, fy = fx * fx * (3 - 2 * fx), fy * fy * (3 - 2 * fy)
    a, b = unit(hash_bits(ix, iy, seed)), unit(hash_bits(ix + 1, iy, seed))
    c, d = unit(hash_bits(ix, iy + 1, seed)), unit(hash_bits(ix + 1, iy + 1, seed))
    return a + (b - a) * fx + (c - a) * fy + (a - b - c + d) * fx * fy


def patches(x: NDArray[np.floating], y: NDArray[np.floating], size_m: float, seed: int) -> NDArray[np.float64]:
    """Two octaves of value noise f64[...] in [0, 1] over world x and y in metres; patches are about ``size_m`` wide."""
    return 0.7 * noise2(x / size_m, y / size_m, seed) + 0.3 * noise2(2.7 * x / size_m, 2.7 * y / size_m, seed + 1)


def patch_threshold(share: float, seed: int) -> float:
    """The level that ``patches`` exceeds on this share of a large area, 0 to 1. Measured on a fixed grid of places."""
    if share <= 0 or share >= 1:
        return 2.0 if share <= 0 else -1.0
    at = np.arange(_QUANTILE_SIDE) * _QUANTILE_STEP
    x, y = np.meshgrid(at, at)
    return float(np.quantile(patches(x, y, 1.0, seed), 1 - share))


def smoothstep(low: float, high: float, v: Any) -> Any:
    """0 below ``low``, 1 above ``high``, smooth between."""
    t = np.clip((v - low) / (high - low), 0, 1)
    return t * t * (3 - 2 * t)
