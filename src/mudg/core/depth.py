"""Dense depth without learned weights: generated depth brought to measurements, and sparse measurements completed under
the guidance of an image."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Final, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from scipy import ndimage, sparse
from scipy.spatial import KDTree
from torch import Tensor

from mudg.base.errors import InputError
from mudg.base.geometry import pixel_rays
from mudg.base.types import View, check_shape

# align --------------------------------------------------------------------------------------------
# ``fit_depth`` starts from metres that are nearly right; ``fit_affine`` from any numbers that grow with depth, or with
# its inverse.


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
    """measured = scale * generated + shift_m in one frame, f64 numbers; `residual`: median of |aligned / measured - 1|
    after it and `residual_before`: before it (both over the measured pixels; NaN without any); `used`: whether it was
    applied."""

    scale: float
    shift_m: float
    residual: float
    residual_before: float
    used: bool


def fit_depth(depth: Tensor, measured: Tensor, valid: Tensor, rounds: int = 12) -> DepthFit:
    """Scale and shift of one frame by iteratively reweighted least squares. InputError: shapes differ.

    depth, measured: [1,H,W] metres; valid: bool[1,H,W], where `measured` holds. Residuals are relative to the measured
    depth and weighted with Tukey's function at 4.7 times their robust spread, starting from the median ratio, so that
    wrongly painted surfaces do not pull.
    """
    check_shape(measured, "fit_depth: measured depth", tuple(depth.shape))
    check_shape(valid, "fit_depth: mask", tuple(depth.shape))
    known = valid & torch.isfinite(depth) & torch.isfinite(measured) & (measured > 0)
    x, y = _exactly(depth[known]), _exactly(measured[known])
    off = (x / y - 1).abs().median() if len(x) else x.new_tensor(float("nan"))
    if len(x) < MIN_POINTS:
        return DepthFit(1.0, 0.0, float(off), float(off), False)
    rows = torch.stack([x / y, 1 / y], 1)
    found = torch.stack([(y / x.clamp(min=0.1)).median(), x.new_zeros(())])  # a start that outliers do not move
    found = _reweighted(rows, found, rounds)
    still = (((found[0] * x + found[1]) / y) - 1).abs().median()
    # all four numbers leave the device at once
    scale, shift, before, after = torch.stack([*found, off, still]).cpu().tolist()
    used = MIN_SCALE <= scale <= MAX_SCALE and after < before
    return DepthFit(scale, shift, after if used else before, before, used)


def _exactly(x: Tensor) -> Tensor:
    """The numbers in float64, where they are if their device has it."""
    return (x.cpu() if x.device.type == "mps" else x).double()


def _reweighted(rows: Tensor, found: Tensor, rounds: int) -> Tensor:
    """`rows` f64[N,2] @ result f64[2] near 1, by least squares reweighted with Tukey's function, from a start
    `found`."""
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
    """scale * value + shift is depth in metres, or its inverse (`space`); `residual`: median of |fitted / measured
    depth - 1| over `points` points (NaN without a fit); `used`: whether the fit is to be believed."""

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

    Errors count relative to the measured depth. The start is the line through two of the points that has the least
    median error (Rousseeuw, "Least median of squares regression", 1984; pairs half the range of values apart, chosen
    without chance), so up to nearly half of the points may be wrong; then least squares reweighted with Tukey's
    function, as in `fit_depth`. InputError: shapes differ, or there is no such space.
    """
    check_shape(values, "fit_affine: values", (None,))
    check_shape(measured, "fit_affine: measured depth", tuple(values.shape))
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
    """Of lines through two rows [x / goal, 1 / goal], rising ones, the one of least median error f64[2]; None: none
    rises."""
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


# complete -----------------------------------------------------------------------------------------
# The unknown is the logarithm of depth at every pixel, so that all errors count relative to the distance. A sparse
# linear system pulls it to the measurements and asks neighbouring pixels to differ as a plane would:
#
# 1. Every measurement gets a plane in inverse depth (planes of the world are planes there) from neighbours of like
#    depth.
# 2. Every pixel takes over the plane of its nearest measurement. It gives the start, and the difference to expect
#    between two pixels. Far from measurements planes fade to constant depth: facades and trunks stand upright.
# 3. Differences across image edges count little. After a first solve, differences that are far off what was expected
#    count less still (iteratively reweighted least squares), so that steps in depth settle on edges of the image.
# 4. Sky lies at a fixed distance and takes no part.


SKY_M: Final = 100.0
"""Depth given to the sky, and aimed at beyond the scanner's reach, metres."""
NEAR_M, FAR_M = 0.5, 200.0
"""Limits of the result, metres."""
_DATA_WEIGHT, _BEYOND_WEIGHT = 0.3, 0.02
"""Pull of a measurement, and towards the sky beyond the scanner's reach, beside 1 for two pixels of one colour."""
_COLOR_SCALE: Final = 8.0
"""Colour difference (root of the summed squares, 0..255) that lowers the weight of a pair to 1/e."""
_EDGE_FLOOR: Final = 0.002
"""Weight that the strongest image edge leaves."""
_STEP_SCALE, _OUTLIER_SCALE = 0.02, 0.03
"""Deviations in the logarithm from which a pair, and a measurement, count half."""
_ROUNDS, _ITERATIONS = 3, 60
"""Solves, each but the first reweighted, and conjugate-gradient steps of each."""
_TOLERANCE: Final = 1e-4
_NEIGHBOURS: Final = 10
"""Measurements that a plane is fitted to."""
_PLANE_FADE_PX: Final = 12.0
"""Distance from its measurement over which a plane fades to constant depth."""
_STRETCH: Final = 3.0
"""Beams of a scanner lie farther apart than the points of one beam: neighbours shall come from several beams."""


@dataclass(frozen=True, slots=True, eq=False)
class DenseDepth:
    """``depth`` f32[H, W] metres, finite everywhere if anything was measured, else NaN outside the sky; ``confidence``
    f32[H, W] in 0..1."""

    depth: NDArray[np.float32]
    confidence: NDArray[np.float32]


def beyond_reach(
    view: View, measured: NDArray[np.float32], highest_rad: float, *, gap_deg: float = 0.6
) -> NDArray[np.bool_]:
    """Where the scanner looked and nothing came back: what is there is far, if it is not glass; bool[H, W].

    Only near the horizon and up to the elevation ``highest_rad`` of the highest beam: below, the road would answer, and
    windows of cars are what is silent. ``measured``: f32[H, W] metres, NaN = none; ``gap_deg``: largest angle between
    neighbouring beams.
    """
    known = np.isfinite(measured)
    if not known.any():
        return np.zeros(measured.shape, bool)
    elevation = ray_elevation(view)
    silent = ndimage.distance_transform_edt(~known) > 1.5 * np.deg2rad(gap_deg) * view.camera.fy
    return silent & (elevation > -0.02) & (elevation < highest_rad - np.deg2rad(gap_deg))


def ray_elevation(view: View) -> NDArray[np.float32]:
    """Elevation of each pixel's ray above the horizontal plane, radians, f32[H, W]."""
    x, y = pixel_rays(view.camera)
    up = view.world_from_cam[2, :3]
    rise = up[0] * x[None] + up[1] * y[:, None] + up[2]
    return np.arcsin(rise / np.sqrt(1 + x[None] ** 2 + y[:, None] ** 2)).astype(np.float32)


def complete_depth(
    rgb: NDArray[np.uint8],
    measured: NDArray[np.float32],
    sky: NDArray[np.bool_] | None = None,
    beyond: NDArray[np.bool_] | None = None,
) -> DenseDepth:
    """Fill a sparse depth map f32[H, W] in metres (NaN where nothing was measured), guided by its image u8[H, W, 3].
    ``sky``, and ``beyond`` where the scanner looked and nothing came back (``beyond_reach``): bool[H, W], or None for
    nowhere. InputError: shapes differ, or a measurement is not positive."""
    shape = measured.shape
    sky = np.zeros(shape, bool) if sky is None else sky
    beyond = np.zeros(shape, bool) if beyond is None else beyond & ~sky
    check_shape(rgb, "complete_depth: image", (*shape, 3))
    check_shape(sky, "complete_depth: sky", shape)
    check_shape(beyond, "complete_depth: beyond", shape)
    known = np.isfinite(measured) & ~sky
    if (measured[known] <= 0).any():
        got = str(float(measured[known].min()))
        raise InputError("measured depth is not positive", where="complete_depth", got=got)
    depth = np.full(shape, np.nan, np.float32)
    confidence = np.zeros(shape, np.float32)
    depth[sky], confidence[sky] = SKY_M, 0.8
    if not known.any():
        return DenseDepth(depth, confidence)
    found: Any = ndimage.distance_transform_edt(~known, return_indices=True)
    away_px, owner = found
    planes = _fit_planes(known, measured)
    start, right, down = _expected(planes, owner, away_px)
    beyond &= ~known
    start[beyond] = np.log(SKY_M)
    goal = np.full(shape, np.log(SKY_M), np.float32)
    goal[known] = np.log(measured[known])
    pull = np.where(known, np.float32(_DATA_WEIGHT), np.where(beyond, np.float32(_BEYOND_WEIGHT), np.float32(0)))
    weights = []  # of the pairs to the right [H, W-1] and below [H-1, W]
    for axis in (1, 0):
        step = np.sqrt((np.diff(rgb.astype(np.float32), axis=axis) ** 2).sum(2))
        weights.append(np.maximum(np.exp(-step / _COLOR_SCALE), _EDGE_FLOOR).astype(np.float32))
    solved = _solve(start, ((right, weights[0]), (down, weights[1])), pull, goal, sky)
    solved = np.clip(solved, np.log(NEAR_M), np.log(FAR_M))
    depth[~sky] = np.exp(solved)[~sky]
    confidence[~sky] = _confidence(solved, goal[owner[0], owner[1]], away_px, sky)[~sky]
    return DenseDepth(depth, confidence)


def _fit_planes(known: NDArray[np.bool_], measured: NDArray[np.float32]) -> NDArray[np.float32]:
    """Plane of each measurement in inverse depth: f32[3, H, W] with inverse depth, and its change per pixel to the
    right and downwards relative to it; zero outside ``known``."""
    row, column = np.nonzero(known)
    planes = np.zeros((3, *known.shape), np.float32)
    inverse = 1 / measured[known].astype(np.float64)
    planes[0, row, column] = inverse
    count = min(_NEIGHBOURS + 1, len(row))
    if count < 4:
        return planes
    at = np.c_[column, row].astype(np.float64)
    stretched = at * (_STRETCH, 1.0)
    nearest: Any = KDTree(stretched).query(stretched, count)
    near = nearest[1][:, 1:]  # the first is the point itself
    du, dv = at[near, 0] - at[:, :1], at[near, 1] - at[:, 1:]
    change = inverse[near] / inverse[:, None] - 1
    slope = np.zeros((2, len(row)))
    ridge = np.array([2.0, 2.0])  # squared pixels: keeps the slope small where neighbours do not span a plane
    for scale in (0.3, 0.1, 0.03):  # neighbours on other surfaces lose their say
        off = change - slope[0, :, None] * du - slope[1, :, None] * dv
        w = 1 / (1 + (off / scale) ** 2) ** 2
        uu, vv, uv = (w * du * du).sum(1) + ridge[0], (w * dv * dv).sum(1) + ridge[1], (w * du * dv).sum(1)
        ru, rv = (w * du * change).sum(1), (w * dv * change).sum(1)
        det = uu * vv - uv * uv
        slope = np.stack([(vv * ru - uv * rv) / det, (uu * rv - uv * ru) / det])
    planes[1:, row, column] = np.clip(slope, -0.15, 0.15)
    return planes


def _expected(
    planes: NDArray[np.float32], owner: NDArray[np.intp], away_px: NDArray[np.float64]
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
    """Start of the solve and the differences to expect to the right [H, W-1] and below [H-1, W], in the logarithm of
    depth."""
    inverse, slope_u, slope_v = (plane[owner[0], owner[1]] for plane in planes)
    rows, columns = np.indices(away_px.shape)
    du, dv = (columns - owner[1]).astype(np.float32), (rows - owner[0]).astype(np.float32)
    rows_measured = np.flatnonzero((away_px == 0).any(1))
    usual_px = float(np.quantile(away_px[rows_measured[0] : rows_measured[-1] + 1], 0.9))
    fade = np.exp(-np.maximum(away_px - max(6.0, 1.5 * usual_px), 0) / _PLANE_FADE_PX).astype(np.float32)
    slope_v = slope_v * fade
    ratio = np.clip(1 + slope_u * du + slope_v * dv, 0.7, 1.4)
    start = (-np.log(inverse * ratio)).astype(np.float32)
    relative_u, relative_v = -slope_u / ratio, -slope_v / ratio
    right = 0.5 * (relative_u[:, 1:] + relative_u[:, :-1])
    down = 0.5 * (relative_v[1:] + relative_v[:-1])
    return start, right, down


def _solve(
    start: NDArray[np.float32],
    neighbours: tuple[tuple[NDArray[np.float32], NDArray[np.float32]], ...],
    pull: NDArray[np.float32],
    goal: NDArray[np.float32],
    sky: NDArray[np.bool_],
) -> NDArray[np.float32]:
    """Logarithm of depth f32[H, W]: reweighted least squares over all pixels but the sky. ``neighbours``: differences
    to expect, and weights, of the pairs to the right and below."""
    number = np.cumsum(~sky.ravel()).reshape(sky.shape) - 1
    pairs = []
    for here, there, (g, w) in zip((np.s_[:, :-1], np.s_[:-1]), (np.s_[:, 1:], np.s_[1:]), neighbours):
        both = ~sky[here] & ~sky[there]
        pairs.append((number[here][both], number[there][both], g[both], w[both]))
    first, second, g, w0 = (np.concatenate(part) for part in zip(*pairs, strict=True))
    data0, goal, x, size = pull[~sky], goal[~sky], start[~sky].copy(), int((~sky).sum())
    for turn in range(_ROUNDS):
        w, data = w0, data0
        if turn:
            off = np.abs(x - goal)
            scale = max(_OUTLIER_SCALE, 4 * float(np.median(off[data0 > 0])))  # not all can be outliers
            data = data0 / (1 + (off / scale) ** 2)
            w = w0 / (1 + ((x[second] - x[first] - g) / _STEP_SCALE) ** 2)
        at_pairs = [np.bincount(end, w, size).astype(np.float32) for end in (first, second)]
        diagonal = data + at_pairs[0] + at_pairs[1] + 1e-6
        slope = w * g
        right_side = data * goal + np.bincount(second, slope, size) - np.bincount(first, slope, size) + 1e-6 * x
        upper = sparse.csr_matrix((-w, (first, second)), shape=(size, size), dtype=np.float32)
        matrix = (upper + upper.T + sparse.diags(diagonal, dtype=np.float32)).tocsr()
        x = _conjugate_gradients(matrix, right_side.astype(np.float32), x, (1 / diagonal).astype(np.float32))
    out = np.zeros(sky.shape, np.float32)
    out[~sky] = x
    return out


def _conjugate_gradients(
    matrix: sparse.csr_matrix,
    right_side: NDArray[np.float32],
    start: NDArray[np.float32],
    inverse_diagonal: NDArray[np.float32],
) -> NDArray[np.float32]:
    """Solve a symmetric positive definite system with Jacobi's preconditioner, from a start, in ``_ITERATIONS`` steps
    or until the preconditioned residual has fallen to ``_TOLERANCE`` of its start."""
    x = start.copy()
    residual = right_side - matrix @ x
    z = inverse_diagonal * residual
    direction = z.copy()
    energy = float(residual @ z)
    limit = energy * _TOLERANCE**2
    for _ in range(_ITERATIONS):
        if energy <= limit or energy <= 0:
            break
        moved = matrix @ direction
        step = np.float32(energy / float(direction @ moved))
        x += step * direction
        residual -= step * moved
        z = inverse_diagonal * residual
        fresh = float(residual @ z)
        direction *= np.float32(fresh / energy)
        direction += z
        energy = fresh
    return x


def _confidence(
    solved: NDArray[np.float32], nearest: NDArray[np.float32], away_px: NDArray[np.float64], sky: NDArray[np.bool_]
) -> NDArray[np.float32]:
    """exp(-e / 0.05) of the expected relative error e.

    e grows with the distance to the nearest measurement, with the difference to it, and with the steps of the solution
    around the pixel (where depth is steep, half a pixel is much). Its four numbers are a least-squares fit on generated
    cities.
    """
    around = np.where(sky, np.float32(np.log(SKY_M)), solved)
    steps = ndimage.maximum_filter(around, 5) - ndimage.minimum_filter(around, 5)
    error = 0.002 + 0.0009 * np.minimum(away_px, 100) + 0.13 * np.abs(solved - nearest) + 0.05 * np.minimum(steps, 1)
    return np.exp(-error / 0.05).astype(np.float32)
