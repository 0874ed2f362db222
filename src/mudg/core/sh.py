"""Real spherical harmonics of colours, in numpy: values at directions, and their exact rotation.

The basis is that of Gaussian splatting (Kerbl et al. 2023): bands 0 to 3, in each band m = -l .. l, with the factor (-1)^m
(Condon-Shortley). A colour is ``0.5 + basis @ coefficients``. ``raster/torch_twin.py`` has the same basis in torch.
"""

from __future__ import annotations

import functools
from typing import Final

import numpy as np
from numpy.typing import NDArray

C0: Final = 0.28209479177387814
"""Value of the constant band: a colour of degree 0 is ``0.5 + C0 * f_dc``."""

Array = NDArray[np.float64]


def degree_of(coefficients: int) -> int:
    """Degree of harmonics with so many coefficients: 1, 4, 9 or 16."""
    return {1: 0, 4: 1, 9: 2, 16: 3}[coefficients]


def basis(directions: Array, degree: int) -> Array:
    """Values f64[N, (degree + 1)^2] at unit directions [N, 3]."""
    x, y, z = np.asarray(directions, np.float64).T
    cos2, sin2 = x * x - y * y, 2 * x * y
    rows = [np.full_like(x, C0)]
    if degree >= 1:
        rows += [-0.4886025119029199 * y, 0.4886025119029199 * z, -0.4886025119029199 * x]
    if degree >= 2:
        rows += [0.5462742152960396 * sin2, -1.0925484305920792 * y * z, 0.31539156525252005 * (3 * z * z - 1),
                 -1.0925484305920792 * x * z, 0.5462742152960396 * cos2]  # fmt: skip
    if degree >= 3:
        cos3, sin3 = x * cos2 - y * sin2, x * sin2 + y * cos2
        c = 0.4570457994644658 * (1 - 5 * z * z)
        rows += [-0.5900435899266435 * sin3, 1.445305721320277 * z * sin2, c * y, 0.3731763325901154 * z * (5 * z * z - 3),
                 c * x, 1.445305721320277 * z * cos2, -0.5900435899266435 * cos3]  # fmt: skip
    return np.stack(rows, 1)


def rotated(coefficients: NDArray[np.float32], rotation: Array) -> NDArray[np.float32]:
    """Coefficients that look from ``rotation @ d`` as the given ones look from ``d``.

    Args:
        coefficients: f32[N, (degree + 1)^2, 3]. rotation: f64[3, 3].
    """
    degree = degree_of(coefficients.shape[1])
    turned = np.array(coefficients, np.float32)
    for band in range(1, degree + 1):
        rows = slice(band**2, (band + 1) ** 2)
        turned[:, rows] = np.einsum(
            "ij,njc->nic", band_rotation(rotation, band), coefficients[:, rows].astype(np.float64)
        )
    return turned


def band_rotation(rotation: Array, band: int) -> Array:
    """The orthogonal matrix f64[2 band + 1, 2 band + 1] by which a rotation f64[3, 3] mixes the coefficients of one band.

    A rotated harmonic is a sum of harmonics of its band, so its values at a few directions determine the sum: exact but for rounding.
    """
    directions, inverse = _probes(band)
    rows = slice(band**2, (band + 1) ** 2)
    return inverse @ basis(directions @ np.asarray(rotation, np.float64), band)[:, rows]


@functools.cache
def _probes(band: int) -> tuple[Array, Array]:
    """Well-spread directions [M, 3] (a spiral from pole to pole) and the inverse of a band's values there, [2 band + 1, M]."""
    directions = spiral(24)
    return directions, np.asarray(np.linalg.pinv(basis(directions, band)[:, band**2 : (band + 1) ** 2]), np.float64)


def spiral(count: int) -> Array:
    """Directions f64[count, 3] that cover the sphere evenly (Fibonacci's spiral)."""
    index = np.arange(count) + 0.5
    z, longitude = 1 - 2 * index / count, np.pi * (1 + 5**0.5) * index
    radius = np.sqrt(1 - z * z)
    return np.stack([radius * np.cos(longitude), radius * np.sin(longitude), z], 1)
