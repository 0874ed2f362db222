"""Spherical harmonics of colours in a turned frame.

A colour is the sum of harmonics of the direction from the camera to a Gaussian. Where the harmonics belong to a frame that is turned
against the world, evaluating them with the direction turned into that frame is the same as evaluating turned coefficients with the
direction in the world: functions of one degree mix among themselves, by an orthogonal matrix (``core/sh.py``). So every renderer draws
them without knowing of frames.
"""

from __future__ import annotations

import torch
from torch import Tensor

from mudg.core.sh import band_rotation


def mixing(rotation: Tensor, degree: int) -> Tensor:
    """How coefficients of degree 1 to ``degree`` mix when their frame is turned.

    Args:
        rotation: world_from_frame [3, 3], on the CPU.
        degree: 1 to 3.

    Returns:
        f32[K - 1, K - 1], K = (degree + 1)^2, orthogonal: coefficients of the world = matrix @ coefficients of the frame.
    """
    turn = rotation.detach().double().numpy()
    return torch.block_diag(*(torch.from_numpy(band_rotation(turn, band)) for band in range(1, degree + 1))).float()


def turned(rest: Tensor, matrix: Tensor) -> Tensor:
    """Coefficients [n, K - 1, 3] of a frame as those of the world (``mixing``); differentiable in ``rest``."""
    return torch.einsum("ij,njc->nic", matrix, rest)
