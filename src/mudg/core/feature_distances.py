"""Distances between two sets of feature vectors: how far the distribution of generated images is from that of real
ones.

All take two arrays ``[n, d]`` and ``[m, d]`` (rows are images, any real dtype), compute in float64 on the CPU and
return a plain number. Smaller is better everywhere. What the features are decides the name of the number: with those of
``networks/inception.py`` ``frechet_distance`` is FID and ``kernel_distance`` is KID.

All of them depend on the number of rows. The Frechet distance of two small samples of the *same* law is far from 0:
with FID's features and 96 rows about nine tenths of the total variance. Compare only numbers of equal n, and show what
two samples of the truth give beside them. ``kernel_distance`` alone is unbiased.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mudg.base.errors import InputError

Features = NDArray[np.float64]

KID_DEGREE: Final = 3
MIND_DIRECTIONS: Final = 1000
MIND_FACTOR: Final = 3.0
INFINITY_SIZES: Final = 15
CMMD_SIGMA: Final = 10.0
CMMD_FACTOR: Final = 1000.0


def frechet_distance(generated: ArrayLike, real: ArrayLike) -> float:
    """Squared Frechet distance of the Gaussians with the sets' means and covariances (divisor n - 1).

    ``|m1 - m2|^2 + tr S1 + tr S2 - 2 tr (S1 S2)^(1/2)``. The last trace is the nuclear norm of ``A B^T``, where A and B
    are the centred sets over the root of n - 1: exact also for singular covariances (n <= d), with no small number
    added to any diagonal.

    Args:
        generated, real: ``[n, d]`` and ``[m, d]``, n, m >= 2.

    Returns:
        In squared units of the features, [0, inf). 0 for equal means and covariances, up to rounding. Symmetric;
        unchanged by common rotations and translations of all features; multiplied by c^2 when all are multiplied by c.

    Raises:
        InputError: sets of other widths, too few rows, or values that are not finite.
    """
    a, b = _pair(generated, real, 2)
    apart = a.mean(0) - b.mean(0)
    root_a, root_b = _covariance_root(a), _covariance_root(b)
    common = np.linalg.svd(root_a @ root_b.T, compute_uv=False).sum()
    return max(0.0, float(apart @ apart + (root_a**2).sum() + (root_b**2).sum() - 2.0 * common))


def _covariance_root(features: Features) -> Features:
    """R ``[min(n, d), d]`` with R^T R = the covariance of rows."""
    centred = (features - features.mean(0)) / math.sqrt(len(features) - 1)
    return np.asarray(np.linalg.qr(centred, mode="r")) if len(features) > features.shape[1] else centred


def frechet_at_infinity(
    generated: ArrayLike, real: ArrayLike, rng: np.random.Generator, sizes: int = INFINITY_SIZES
) -> float:
    """The Frechet distance extrapolated to endless sets: its bias is nearly linear in 1/N.

    Both sets are reduced to N random rows (without replacement), for ``sizes`` values of N at even distances from half
    of the smaller set to all of it; the distances are regressed on 1/N, and the intercept is returned. Useful from
    about 1000 rows on.

    Args:
        generated, real: ``[n, d]`` and ``[m, d]``, at least twice ``sizes`` rows each.
        rng: chooses the rows. sizes: number of sizes, >= 2.

    Returns:
        In squared units of the features, (-inf, inf): an extrapolation may fall below 0.

    Raises:
        InputError: as ``frechet_distance``.
    """
    a, b = _pair(generated, real, max(4, 2 * sizes))
    most = min(len(a), len(b))
    counts = np.unique(np.linspace(most / 2, most, sizes).round().astype(int))
    found = []
    for count in counts:
        rows_a, rows_b = (rng.choice(len(x), count, replace=False) for x in (a, b))
        found.append(frechet_distance(a[rows_a], b[rows_b]))
    slope_and_start = np.polynomial.polynomial.polyfit(1.0 / counts, found, 1)
    return float(slope_and_start[0])


def kernel_distance(generated: ArrayLike, real: ArrayLike) -> float:
    """Unbiased squared maximum mean discrepancy with the kernel ``(x.y / d + 1)^3`` over all rows; KID on FID's
    features.

    Args:
        generated, real: ``[n, d]`` and ``[m, d]``, n, m >= 2; n and m may differ.

    Returns:
        (-inf, inf), raw (not times 100 or 1000). Its mean over samples of one law is 0, so a single value may be
        negative. Symmetric; unchanged by common rotations of all features.

    Raises:
        InputError: as ``frechet_distance``.
    """
    a, b = _pair(generated, real, 2)
    return _unbiased(_cubic(a, a), _cubic(b, b), _cubic(a, b), np.ones(len(a)), np.ones(len(b)))


def kernel_distance_error(
    generated: ArrayLike, real: ArrayLike, blocks: Sequence[ArrayLike], rng: np.random.Generator, draws: int = 200
) -> float:
    """Standard error of ``kernel_distance`` by a block bootstrap: rows of a block, such as frames of one log, depend on
    each other and are drawn together.

    A row that is drawn twice is never compared with itself: pairs of one row are left out, as in the distance itself.

    Args:
        generated, real: ``[n, d]`` and ``[m, d]``.
        blocks: block number of every row of either set; at least two blocks each.
        rng: draws the blocks. draws: number of resamples, >= 2.

    Returns:
        [0, inf), in units of the distance.

    Raises:
        InputError: as ``frechet_distance``, or block numbers that do not fit the rows.
    """
    a, b = _pair(generated, real, 2)
    groups = []
    for rows, numbers in zip((a, b), blocks, strict=True):
        given = np.asarray(numbers, np.int64)
        names, where = np.unique(given, return_inverse=True)
        if given.shape != (len(rows),) or len(names) < 2:
            raise InputError(
                "blocks do not fit the features",
                expected=f"a number for each of {len(rows)} rows, two blocks or more",
                got=f"{given.size} numbers, {len(names)} blocks",
            )
        groups.append((where, len(names)))
    own_a, own_b, across = _cubic(a, a), _cubic(b, b), _cubic(a, b)
    found = []
    while len(found) < draws:
        weights = [
            np.bincount(rng.integers(count, size=count), minlength=count)[where].astype(float)
            for where, count in groups
        ]
        if all(np.count_nonzero(w) >= 2 for w in weights):
            found.append(_unbiased(own_a, own_b, across, *weights))
    return float(np.std(found, ddof=1))


def _cubic(a: Features, b: Features) -> Features:
    return (a @ b.T / a.shape[1] + 1.0) ** KID_DEGREE


def _unbiased(own_a: Features, own_b: Features, across: Features, a: Features, b: Features) -> float:
    """Unbiased squared discrepancy from kernel matrices and weights of rows; no row is paired with itself."""

    def within(kernel: Features, weights: Features) -> float:
        squares = weights**2
        return float((weights @ kernel @ weights - squares @ np.diag(kernel)) / (weights.sum() ** 2 - squares.sum()))

    return within(own_a, a) + within(own_b, b) - 2.0 * float(a @ across @ b / (a.sum() * b.sum()))


def mind_distance(
    generated: ArrayLike, real: ArrayLike, rng: np.random.Generator, directions: int = MIND_DIRECTIONS
) -> float:
    """MIND: squared 2-Wasserstein distance along random directions, times 3 d (sliced Wasserstein distance).

    Both sets are projected on unit vectors and sorted; the mean over directions and ranks of the squared difference is
    multiplied by 3 d. A larger set is first reduced to the size of the smaller one, to random rows.

    Args:
        generated, real: ``[n, d]`` and ``[m, d]``, n, m >= 1.
        rng: draws rows and directions: the same state and sizes give the same directions. directions: how many.

    Returns:
        In squared units of the features, [0, inf); 0 for equal sets in any order. Symmetric for sets of equal size; 3
        |t|^2 on average over directions when one set is the other moved by t.

    Raises:
        InputError: as ``frechet_distance``.
    """
    a, b = _pair(generated, real, 1)
    width, count = a.shape[1], min(len(a), len(b))
    lines = rng.standard_normal((width, directions))
    lines /= np.linalg.norm(lines, axis=0)
    a, b = (x if len(x) == count else x[rng.choice(len(x), count, replace=False)] for x in (a, b))
    apart = np.sort(a @ lines, axis=0) - np.sort(b @ lines, axis=0)
    return float(MIND_FACTOR * width * (apart**2).mean())


def cmmd_distance(generated: ArrayLike, real: ArrayLike) -> float:
    """CMMD: squared maximum mean discrepancy of directions under a Gaussian kernel of sigma 10, times 1000.

    Rows are brought to length 1 first. Biased: means over full kernel matrices, with their diagonals. Published values
    are of image embeddings of CLIP ViT-L/14 at 336 pixels.

    Args:
        generated, real: ``[n, d]`` and ``[m, d]``, n, m >= 1, no row of length 0.

    Returns:
        [0, 1000 * 2 * (1 - exp(-4 / 200))], that is at most 39.6; 0 for equal sets. Symmetric; unchanged by common
        rotations and by the length of rows.

    Raises:
        InputError: as ``frechet_distance``, or a row of length 0.
    """
    units = []
    for name, features in zip(("generated", "real"), _pair(generated, real, 1), strict=True):
        lengths = np.linalg.norm(features, axis=1, keepdims=True)
        if not lengths.all():
            raise InputError(
                "an embedding of length 0 has no direction", where=f"{name}, row {int(np.argmin(lengths))}"
            )
        units.append(features / lengths)
    a, b = units

    def mean_kernel(x: Features, y: Features) -> float:
        squared = (x**2).sum(1)[:, None] + (y**2).sum(1) - 2.0 * (x @ y.T)
        return float(np.exp(-np.maximum(squared, 0.0) / (2.0 * CMMD_SIGMA**2)).mean())

    return max(0.0, CMMD_FACTOR * (mean_kernel(a, a) + mean_kernel(b, b) - 2.0 * mean_kernel(a, b)))


def _pair(generated: ArrayLike, real: ArrayLike, fewest: int) -> tuple[Features, Features]:
    a, b = (_checked(features, name, fewest) for features, name in ((generated, "generated"), (real, "real")))
    if a.shape[1] != b.shape[1]:
        raise InputError(
            "two sets of features differ in width",
            expected=f"{b.shape[1]} values a row, as the real set",
            got=str(a.shape[1]),
        )
    return a, b


def _checked(features: Any, name: str, fewest: int) -> Features:
    found = np.asarray(features, np.float64)
    if found.ndim != 2 or not found.shape[-1] or len(found) < fewest:
        raise InputError(
            "a set of features has the wrong shape",
            where=f"{name} images",
            expected=f"[n >= {fewest}, d >= 1]",
            got=str(list(found.shape)),
        )
    if not np.isfinite(found).all():
        bad = int(np.flatnonzero(~np.isfinite(found).all(1))[0])
        raise InputError("a set of features holds values that are not finite", where=f"{name} images, row {bad}")
    return found
