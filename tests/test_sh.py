"""Harmonics in numpy: the basis of the rasterisers, and exact rotation."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from mudg.base.geometry import matrix_from_quaternion
from mudg.core import harmonics
from mudg.core.raster.torch_twin import sh_basis


def directions(count: int = 50) -> np.ndarray:
    d = np.random.default_rng(1).normal(size=(count, 3))
    return d / np.linalg.norm(d, axis=1, keepdims=True)


def turn(seed: int) -> np.ndarray:
    return matrix_from_quaternion(np.random.default_rng(seed).normal(size=4))


def test_the_basis_is_that_of_the_rasterisers() -> None:
    d = directions()
    assert np.abs(harmonics.basis(d, 3) - sh_basis(torch.from_numpy(d), 3).numpy()).max() < 1e-9  # measured 1.4e-14


@pytest.mark.parametrize("degree", [1, 2, 3])
def test_rotated_harmonics_look_from_rotated_directions_as_the_old_ones_did(degree: int) -> None:
    rotation, d = turn(degree), directions()
    sh = np.random.default_rng(2).normal(size=(4, (degree + 1) ** 2, 3))
    rows = slice(degree**2, (degree + 1) ** 2)
    before = harmonics.basis(d, degree)[:, rows] @ sh[0, rows]
    mixed = harmonics.band_rotation(rotation, degree) @ sh[0, rows]
    after = harmonics.basis(d @ rotation.T, degree)[:, rows] @ mixed
    assert np.abs(after - before).max() < 1e-12  # float64 rounding
    made = harmonics.rotated(sh.astype(np.float32), rotation)
    seen = np.einsum("dk,nkc->dnc", harmonics.basis(d @ rotation.T, degree), made)
    assert np.abs(seen - np.einsum("dk,nkc->dnc", harmonics.basis(d, degree), sh)).max() < 1e-5


@pytest.mark.parametrize("band", [1, 2, 3])
def test_rotations_of_a_band_are_orthogonal_and_compose(band: int) -> None:
    first, second = turn(7), turn(8)
    one, two, both = (harmonics.band_rotation(r, band) for r in (first, second, second @ first))
    assert np.abs(one @ one.T - np.eye(2 * band + 1)).max() < 1e-12
    assert np.abs(two @ one - both).max() < 1e-12


def test_a_turn_about_z_mixes_opposite_orders_by_its_multiples() -> None:
    for band in (1, 2, 3):
        angle = 0.7
        c, s = np.cos(angle), np.sin(angle)
        made = harmonics.band_rotation(np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]]), band)
        wanted = np.zeros_like(made)
        for m in range(-band, band + 1):
            wanted[m + band, m + band] = np.cos(m * angle)
            if m:
                wanted[m + band, -m + band] = np.sin(-m * angle) if m > 0 else np.sin(abs(m) * angle)
        assert np.abs(made - wanted).max() < 1e-12
