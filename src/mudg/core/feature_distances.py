"""Distances between two sets of feature vectors ``generated`` [n, d] and ``real`` [m, d], in float64 on the CPU;
smaller is better. All depend on the number of rows, the unbiased ``kernel_distance`` alone excepted: compare only equal
n. InputError: sets of other widths, too few rows, or values that are not finite."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mudg.base.errors import InputError

Features = NDArray[np.float64]

KID_DEGREE: Final = 3


def frechet_distance(generated: ArrayLike, real: ArrayLike) -> float:
    """Squared Frechet distance of the Gaussians with the sets' means and covariances (divisor n - 1).

    ``|m1 - m2|^2 + tr S1 + tr S2 - 2 tr (S1 S2)^(1/2)``. The last trace is the nuclear norm of ``A B^T``, where A and B
    are the centred sets over the root of n - 1: exact also for singular covariances (n <= d), with no small number
    added to any diagonal. n, m >= 2. In squared units of the features, [0, inf); 0 for equal means and covariances,
    up to rounding. Symmetric; unchanged by common rotations and translations of all features.
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


def kernel_distance(generated: ArrayLike, real: ArrayLike) -> float:
    """Unbiased squared maximum mean discrepancy with the kernel ``(x.y / d + 1)^3`` over all rows; KID on FID's
    features. n, m >= 2; n and m may differ.

    Raw (not times 100 or 1000). Its mean over samples of one law is 0, so a single value may be negative. Symmetric;
    unchanged by common rotations of all features.
    """
    a, b = _pair(generated, real, 2)
    return _unbiased(_cubic(a, a), _cubic(b, b), _cubic(a, b), np.ones(len(a)), np.ones(len(b)))


def kernel_distance_error(
    generated: ArrayLike, real: ArrayLike, blocks: Sequence[ArrayLike], rng: np.random.Generator, draws: int = 200
) -> float:
    """Standard error of ``kernel_distance`` by a block bootstrap: rows of a block, such as frames of one log, depend on
    each other and are drawn together. ``blocks``: block number of every row of either set, at least two blocks each,
    else InputError; ``draws``: number of resamples, >= 2.

    A row that is drawn twice is never compared with itself: pairs of one row are left out, as in the distance itself.
    """
    a, b = _pair(generated, real, 2)
    groups = []
    for rows, numbers in zip((a, b), blocks, strict=True):
        given = np.asarray(numbers, np.int64)
        names, where = np.unique(given, return_inverse=True)
        if given.shape != (len(rows),) or len(names) < 2:
            what, got = "blocks do not fit the features", f"{given.size} numbers, {len(names)} blocks"
            raise InputError(what, expected=f"a number for each of {len(rows)} rows, two blocks or more", got=got)
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


def _pair(generated: ArrayLike, real: ArrayLike, fewest: int) -> tuple[Features, Features]:
    a, b = _checked(generated, "generated", fewest), _checked(real, "real", fewest)
    if a.shape[1] != b.shape[1]:
        what = "two sets of features differ in width"
        raise InputError(what, expected=f"{b.shape[1]} values a row, as the real set", got=str(a.shape[1]))
    return a, b


def _checked(features: Any, name: str, fewest: int) -> Features:
    found = np.asarray(features, np.float64)
    if found.ndim != 2 or not found.shape[-1] or len(found) < fewest:
        what = "a set of features has the wrong shape"
        raise InputError(what, where=f"{name} images", expected=f"[n >= {fewest}, d >= 1]", got=str(list(found.shape)))
    if not np.isfinite(found).all():
        bad = int(np.flatnonzero(~np.isfinite(found).all(1))[0])
        raise InputError("a set of features holds values that are not finite", where=f"{name} images, row {bad}")
    return found
