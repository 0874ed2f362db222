"""Distances of feature sets: closed forms, invariances, and twins written another way."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy import linalg

from mudg.base import seeds
from mudg.base.errors import InputError
from mudg.core import feature_distances as distances


def rows(count: int, width: int, purpose: str) -> np.ndarray:
    rng = seeds.numpy_rng(0, count, purpose)
    return rng.standard_normal((count, width)) @ rng.standard_normal((width, width)) * 0.5 + rng.standard_normal(width)


def rotation(width: int) -> np.ndarray:
    return np.linalg.qr(seeds.numpy_rng(0, width, "rotation").standard_normal((width, width)))[0]


def exactly(mean: np.ndarray, covariance: np.ndarray, count: int) -> np.ndarray:
    """Rows whose sample mean and sample covariance are exactly those given."""
    width = len(mean)
    noise = seeds.numpy_rng(1, count, "noise").standard_normal((count, width))
    noise -= noise.mean(0)
    white = np.linalg.qr(noise)[0] * math.sqrt(count - 1)
    return white @ np.linalg.cholesky(covariance).T + mean


def frechet_by_sqrtm(a: np.ndarray, b: np.ndarray) -> float:
    """The textbook form, with a matrix root."""
    s, t = np.cov(a, rowvar=False), np.cov(b, rowvar=False)
    root = linalg.sqrtm(s @ t)
    return float(((a.mean(0) - b.mean(0)) ** 2).sum() + np.trace(s + t - 2 * root.real))


ALL = {"frechet": distances.frechet_distance, "kernel": distances.kernel_distance}


@pytest.mark.parametrize("name", ALL)
def test_symmetric_and_independent_of_the_order_of_rows(name: str) -> None:
    a, b = rows(40, 6, "a"), rows(40, 6, "b")
    value = ALL[name](a, b)
    assert value > 1e-3 and ALL[name](b, a) == pytest.approx(value, rel=1e-9)
    assert ALL[name](a[::-1], b) == pytest.approx(value, rel=1e-9)
    assert ALL[name](a.astype(np.float32), b.astype(np.float32)) == pytest.approx(value, rel=1e-4)


@pytest.mark.parametrize(("name", "count"), [("frechet", 5), ("frechet", 60)])
def test_a_set_is_0_from_itself(name: str, count: int) -> None:
    a = rows(count, 12, "a") + 3
    assert 0 <= ALL[name](a, a[::-1].copy()) < 1e-9 * (a**2).sum()


def test_frechet_of_known_gaussians_scales_and_moves_as_it_must() -> None:
    one, two = np.diag([4.0, 9.0, 1.0]), np.diag([1.0, 16.0, 1.0])
    a, b = exactly(np.array([1.0, 0, 0]), one, 50), exactly(np.array([0.0, 2, 0]), two, 70)
    # Commuting covariances: |m|^2 + the squared differences of the standard deviations.
    assert distances.frechet_distance(a, b) == pytest.approx(5.0 + 1.0 + 1.0, rel=1e-12)
    a, b = rows(20, 7, "a"), rows(31, 7, "b")
    value = distances.frechet_distance(a, b)
    assert distances.frechet_distance(a + 5, b + 5) == pytest.approx(value, rel=1e-9)
    assert distances.frechet_distance(3 * a, 3 * b) == pytest.approx(9 * value, rel=1e-9)
    assert distances.frechet_distance(a, a + np.r_[2.0, np.zeros(6)]) == pytest.approx(4.0, rel=1e-9)


@pytest.mark.parametrize(("n", "m"), [(200, 150), (9, 200), (200, 9), (12, 12), (13, 12)])
def test_frechet_agrees_with_the_matrix_root(n: int, m: int) -> None:
    a, b = rows(n, 12, "a"), rows(m, 12, "b")
    # The root of a singular product is known to half of the digits only; ours needs no root.
    digits = 1e-9 if min(n, m) > 12 else 1e-5
    assert distances.frechet_distance(a, b) == pytest.approx(frechet_by_sqrtm(a, b), rel=digits)


def kernel_by_loops(a: np.ndarray, b: np.ndarray) -> float:
    def k(x: np.ndarray, y: np.ndarray) -> float:
        return (sum(p * q for p, q in zip(x, y)) / len(x) + 1) ** 3

    n, m = len(a), len(b)
    own_a = sum(k(a[i], a[j]) for i in range(n) for j in range(n) if i != j) / (n * (n - 1))
    own_b = sum(k(b[i], b[j]) for i in range(m) for j in range(m) if i != j) / (m * (m - 1))
    return own_a + own_b - 2 * sum(k(x, y) for x in a for y in b) / (n * m)


def test_kernel_distance_against_loops_by_hand_and_of_one_law() -> None:
    a, b = rows(7, 4, "a"), rows(5, 4, "b")
    assert distances.kernel_distance(a, b) == pytest.approx(kernel_by_loops(a, b), rel=1e-12)
    # d = 1: k(1,1) = 8, k(0,0) = 1, k(0,1) = 1 -> 8 + 1 - 2.
    assert distances.kernel_distance([[1.0], [1.0]], [[0.0], [0.0]]) == pytest.approx(7.0, rel=1e-12)
    found = []
    for draw in range(300):
        rng = seeds.numpy_rng(0, draw, "law")
        found.append(distances.kernel_distance(rng.standard_normal((8, 5)), rng.standard_normal((12, 5))))
    assert min(found) < 0 < max(found)
    assert abs(np.mean(found)) < 3 * np.std(found) / math.sqrt(len(found))


def test_kernel_error_agrees_with_the_spread_of_fresh_samples_and_grows_with_blocks() -> None:
    fresh, found = [], []
    for draw in range(60):
        rng = seeds.numpy_rng(0, draw, "fresh")
        a, b = rng.standard_normal((60, 4)) + 0.8, rng.standard_normal((60, 4))
        fresh.append(distances.kernel_distance(a, b))
        if draw < 6:
            single = (range(60), range(60))
            found.append(distances.kernel_distance_error(a, b, single, seeds.numpy_rng(0, draw, "boot")))
    assert np.mean(found) == pytest.approx(np.std(fresh), rel=0.4)
    rng = seeds.numpy_rng(0, 0, "blocks")
    a, b = (np.repeat(rng.standard_normal((12, 4)), 5, 0) + shift for shift in (0.8, 0.0))  # five equal frames each
    for wrong in ((range(60), range(4)), (range(60), [1] * 60)):
        with pytest.raises(InputError, match="blocks do not fit"):
            distances.kernel_distance_error(a, b, wrong, rng)
    blocks = np.repeat(np.arange(12), 5)
    apart = distances.kernel_distance_error(a, b, (range(60), range(60)), seeds.numpy_rng(0, 0, "boot"))
    assert distances.kernel_distance_error(a, b, (blocks, blocks), seeds.numpy_rng(0, 0, "boot")) > 1.5 * apart


@pytest.mark.parametrize("name", ALL)
def test_what_cannot_be_compared_is_refused(name: str) -> None:
    a = rows(5, 4, "a")
    spoilt = a.copy()
    spoilt[3, 1] = np.nan
    for one, other, said in (
        (a, a[:, :3], "differ in width"),
        (a[:0], a, "wrong shape"),
        (a, a[0], "wrong shape"),
        (a, spoilt, "real images, row 3"),
    ):
        with pytest.raises(InputError, match=said):
            ALL[name](one, other)
