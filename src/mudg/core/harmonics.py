"""Spherical harmonics of colours in a turned frame.

A colour is the sum of harmonics of the direction from the camera to a Gaussian. Where the harmonics belong to a frame that is turned
against the world, evaluating them with the direction turned into that frame is the same as evaluating turned coefficients with the
direction in the world: functions of one degree mix among themselves, by an orthogonal matrix. So every renderer draws them without
knowing of frames.
"""

from __future__ import annotations

import functools
from typing import Final

import numpy as np
import torch
from torch import Tensor

from mudg.core.raster.torch_twin import sh_basis

_DIRECTIONS: Final = 32


def mixing(rotation: Tensor, degree: int) -> Tensor:
    """How coefficients of degree 1 to ``degree`` mix when their frame is turned.

    Args:
        rotation: world_from_frame [3, 3], on the CPU.
        degree: 1 to 3.

    Returns:
        f32[K - 1, K - 1], K = (degree + 1)^2, orthogonal: coefficients of the world = matrix @ coefficients of the frame.
    """
    directions, blocks = _samples(degree)
    found = sh_basis(directions @ rotation.detach().double(), degree)  # what the frame sees of each direction
    return torch.block_diag(*(solve @ found[:, first : first + len(solve)] for first, solve in blocks)).float()


@functools.lru_cache(maxsize=4)
def _samples(degree: int) -> tuple[Tensor, tuple[tuple[int, Tensor], ...]]:
    """Directions f64[D, 3] evenly spread, and for every degree its first function and what finds coefficients from values."""
    at = np.arange(_DIRECTIONS) + 0.5
    z, angle = 1 - 2 * at / _DIRECTIONS, np.pi * (1 + 5**0.5) * at
    directions = torch.from_numpy(np.column_stack([np.sqrt(1 - z * z) * np.cos(angle), np.sqrt(1 - z * z) * np.sin(angle), z]))
    values = sh_basis(directions, degree)
    blocks = [(band * band, torch.linalg.pinv(values[:, band * band : (band + 1) ** 2])) for band in range(1, degree + 1)]
    return directions, tuple(blocks)


def turned(rest: Tensor, matrix: Tensor) -> Tensor:
    """Coefficients [n, K - 1, 3] of a frame as those of the world (``mixing``); differentiable in ``rest``."""
    return torch.einsum("ij,njc->nic", matrix, rest)
