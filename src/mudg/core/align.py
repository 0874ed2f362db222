"""Bringing generated depth to the scale of what was measured: one scale and one shift per frame, robustly."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from mudg.base.errors import InputError

MIN_POINTS = 50
"""With fewer measured pixels a frame is left as it is."""
MIN_SCALE, MAX_SCALE = 0.2, 5.0
"""A fit outside this range is no alignment but a failure; the frame is left as it is."""


@dataclass(frozen=True, slots=True)
class DepthFit:
    """measured = scale * generated + shift_m in one frame, f64 numbers; `residual`: median of |aligned / measured - 1| after it
    and `residual_before`: before it (both over the measured pixels; NaN without any); `used`: whether it was applied."""

    scale: float
    shift_m: float
    residual: float
    residual_before: float
    used: bool


def fit_depth(depth: Tensor, measured: Tensor, valid: Tensor, rounds: int = 12) -> DepthFit:
    """Scale and shift of one frame by iteratively reweighted least squares.

    depth, measured  [1,H,W] metres; valid bool[1,H,W]: where `measured` holds. Residuals are relative to the measured depth
    and weighted with Tukey's function at 4.7 times their robust spread, starting from the median ratio, so that wrongly
    painted surfaces do not pull.

    Raises:
        InputError: shapes differ.
    """
    if depth.shape != measured.shape or depth.shape != valid.shape:
        raise InputError("depth, measured depth and its mask differ in shape",
                         got=f"{tuple(depth.shape)}, {tuple(measured.shape)}, {tuple(valid.shape)}")  # fmt: skip
    known = valid & torch.isfinite(depth) & torch.isfinite(measured) & (measured > 0)
    x, y = depth[known].double(), measured[known].double()
    if len(x) == 0:
        return DepthFit(1.0, 0.0, float("nan"), float("nan"), False)
    before = float((x / y - 1).abs().median())
    if len(x) < MIN_POINTS:
        return DepthFit(1.0, 0.0, before, before, False)
    rows = torch.stack([x / y, 1 / y], 1)
    found = torch.stack([(y / x.clamp(min=0.1)).median(), x.new_zeros(())])  # a start that outliers do not move
    for _ in range(rounds):
        error = (rows @ found - 1).abs()
        reach = 4.685 * max(1.4826 * float(error.median()), 1e-6)
        weight = (1 - (error / reach).square()).clamp(min=0).square()
        normal = rows.T @ (weight[:, None] * rows)
        normal = normal + 1e-9 * normal.diagonal().mean() * torch.eye(2, dtype=torch.float64)
        found = torch.linalg.solve(normal, rows.T @ weight)
    scale, shift = found.tolist()
    after = float((((scale * x + shift) / y) - 1).abs().median())
    used = MIN_SCALE <= scale <= MAX_SCALE and after < before
    return DepthFit(scale, shift, after if used else before, before, used)


def align_depth(depth: Tensor, measured: Tensor, valid: Tensor) -> tuple[Tensor, list[DepthFit]]:
    """Each frame of depth [T,1,H,W] metres brought to its measured pixels (see `fit_depth`); not below 0.1 m.

    Returns the aligned depth and the fits. A frame whose fit is not used is returned as it is.
    """
    fits = [fit_depth(d, m, v) for d, m, v in zip(depth, measured, valid, strict=True)]
    frames = [(f.scale * d + f.shift_m).clamp(min=0.1) if f.used else d for d, f in zip(depth, fits)]
    return torch.stack(frames), fits
