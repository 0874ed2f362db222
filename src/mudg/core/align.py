"""Bringing generated depth to the scale of what was measured: one scale and one shift per frame, robustly.

``fit_depth`` starts from metres that are nearly right; ``fit_affine`` from any numbers that grow with depth, or with its inverse.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import torch
from torch import Tensor

from mudg.base.errors import InputError

MIN_POINTS = 50
"""With fewer measured pixels a frame is left as it is."""
MIN_SCALE, MAX_SCALE = 0.2, 5.0
"""A fit outside this range is no alignment but a failure; the frame is left as it is."""
MAX_RESIDUAL = 0.25
"""An affine fit that leaves half of the points off by more than this share of their depth is no alignment."""

Space = Literal["depth", "disparity"]
"""What a network's numbers are, up to scale and shift: depth, or inverse depth."""

_SEARCH_POINTS, _SEARCH_PAIRS = 4096, 256


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
    x, y = _exactly(depth[known]), _exactly(measured[known])
    if len(x) == 0:
        return DepthFit(1.0, 0.0, float("nan"), float("nan"), False)
    off = (x / y - 1).abs().median()
    if len(x) < MIN_POINTS:
        before = float(off)
        return DepthFit(1.0, 0.0, before, before, False)
    rows = torch.stack([x / y, 1 / y], 1)
    found = torch.stack([(y / x.clamp(min=0.1)).median(), x.new_zeros(())])  # a start that outliers do not move
    found = _reweighted(rows, found, rounds)
    still = (((found[0] * x + found[1]) / y) - 1).abs().median()
    scale, shift, before, after = torch.stack([*found, off, still]).cpu().tolist()  # all four numbers leave the device at once
    used = MIN_SCALE <= scale <= MAX_SCALE and after < before
    return DepthFit(scale, shift, after if used else before, before, used)


def _exactly(x: Tensor) -> Tensor:
    """The numbers in float64, where they are if their device has it."""
    return (x.cpu() if x.device.type == "mps" else x).double()


def _reweighted(rows: Tensor, found: Tensor, rounds: int) -> Tensor:
    """`rows` f64[N,2] @ result f64[2] near 1, by least squares reweighted with Tukey's function, from a start `found`."""
    for _ in range(rounds):
        error = (rows @ found - 1).abs()
        reach = 4.685 * (1.4826 * error.median()).clamp(min=1e-6)
        weight = (1 - (error / reach).square()).clamp(min=0).square()
        normal = rows.T @ (weight[:, None] * rows)
        normal = normal + 1e-9 * normal.diagonal().mean() * torch.eye(2, dtype=torch.float64, device=rows.device)
        found = torch.linalg.solve(normal, rows.T @ weight)
    return found


@dataclass(frozen=True, slots=True)
class AffineFit:
    """scale * value + shift is depth in metres, or its inverse (`space`); `residual`: median of |fitted / measured depth - 1|
    over `points` points (NaN without a fit); `used`: whether the fit is to be believed."""

    space: Space
    scale: float
    shift: float
    residual: float
    points: int
    used: bool

    def depth(self, values: Tensor, near_m: float, far_m: float) -> Tensor:
        """Metres for numbers of any shape, within the limits; what lies at infinity or beyond it is at `far_m`."""
        fitted = self.scale * values + self.shift
        if self.space == "disparity":
            fitted = 1 / fitted.clamp(min=1 / far_m)
        return fitted.clamp(near_m, far_m)


def fit_affine(values: Tensor, measured: Tensor, space: Space, rounds: int = 12) -> AffineFit:
    """Scale and shift that take a network's numbers to measured depth, by trimmed least squares.

    values, measured  [N] numbers of the network, and metres, at the same pixels.

    Errors count relative to the measured depth. The start is the line through two of the points that has the least median error
    (Rousseeuw, "Least median of squares regression", 1984; pairs half the range of values apart, chosen without chance), so up to
    nearly half of the points may be wrong; then least squares reweighted with Tukey's function, as in `fit_depth`.

    Raises:
        InputError: shapes differ, or there is no such space.
    """
    if values.shape != measured.shape or values.ndim != 1:
        raise InputError("values and measured depth differ in shape", where="fit_affine", expected="[N] and [N]",
            got=f"{tuple(values.shape)}, {tuple(measured.shape)}")  # fmt: skip
    if space not in ("depth", "disparity"):
        raise InputError("there is no such space", where="fit_affine", expected="depth or disparity", got=str(space))
    known = torch.isfinite(values) & torch.isfinite(measured) & (measured > 0)
    x, z = values[known].double(), measured[known].double()
    none = AffineFit(space, 1.0, 0.0, float("nan"), len(x), False)
    if len(x) < MIN_POINTS or float(x.max() - x.min()) <= 1e-9 * float(x.abs().max()):
        return none
    middle, spread = x.median(), x.max() - x.min()
    goal = z if space == "depth" else 1 / z
    rows = torch.stack([(x - middle) / spread / goal, 1 / goal], 1)
    start = _least_median(rows)
    if start is None:
        return none
    found = _reweighted(rows, start, rounds)
    scale = float(found[0] / spread)
    fit = AffineFit(space, scale, float(found[1] - found[0] * middle / spread), 0.0, len(x), scale > 0)
    residual = float((fit.depth(x, 0.0, float("inf")) / z - 1).abs().median())
    return replace(fit, residual=residual, used=fit.used and residual < MAX_RESIDUAL)


def _least_median(rows: Tensor) -> Tensor | None:
    """Of lines through two rows [x / goal, 1 / goal], rising ones, the one of least median error f64[2]; None: none rises."""
    order = (rows[:, 0] / rows[:, 1]).argsort(stable=True)
    rows = rows[order[torch.linspace(0, len(rows) - 1, min(len(rows), _SEARCH_POINTS)).long()]]
    half = len(rows) // 2
    first = torch.linspace(0, half - 1, min(half, _SEARCH_PAIRS)).long()
    (a, b), (c, d) = rows[first].unbind(1), rows[first + half].unbind(1)
    size = a * d - b * c
    lines = torch.stack([(d - b) / size, (a - c) / size], 1)  # both rows answer 1
    lines = lines[torch.isfinite(lines).all(1) & (lines[:, 0] > 0)]
    if len(lines) == 0:
        return None
    return lines[int((lines @ rows.T - 1).abs().median(1).values.argmin())]


def align_depth(depth: Tensor, measured: Tensor, valid: Tensor) -> tuple[Tensor, list[DepthFit]]:
    """Each frame of depth [T,1,H,W] metres brought to its measured pixels (see `fit_depth`); not below 0.1 m.

    Returns the aligned depth and the fits. A frame whose fit is not used is returned as it is.
    """
    fits = [fit_depth(d, m, v) for d, m, v in zip(depth, measured, valid, strict=True)]
    frames = [(f.scale * d + f.shift_m).clamp(min=0.1) if f.used else d for d, f in zip(depth, fits)]
    return torch.stack(frames), fits
