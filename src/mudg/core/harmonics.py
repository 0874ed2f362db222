"""Quaternions in torch, and real spherical harmonics of colours, with their exact rotation: the basis of Gaussian
splatting (Kerbl et al. 2023), bands 0 to 3, in each m = -l .. l with the factor (-1)^m (Condon-Shortley). A colour is
``0.5 + basis @ coefficients``."""

from __future__ import annotations

import functools
from typing import Any, Final

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

# quaternions (w, x, y, z) in torch, differentiable. ``base.geometry`` has their numpy form in float64 -----------------


def left_product_matrix(quat: Tensor) -> Tensor:
    """``[4, 4]`` matrix L with ``L @ p == quat * p`` (Hamilton product, w x y z)."""
    w, x, y, z = quat.unbind()
    return torch.stack([w, -x, -y, -z, x, w, -z, y, y, z, w, -x, z, -y, x, w]).view(4, 4)


def rotation_matrix(quat: Tensor) -> Tensor:
    """Rotation ``[3, 3]`` of a quaternion ``[4]``, normalised here."""
    return rotation_of_unit(quat / quat.norm())


def rotation_of_unit(quat: Tensor) -> Tensor:
    """Rotations ``[..., 3, 3]`` of unit quaternions ``[..., 4]``."""
    w, x, y, z = quat.unbind(-1)
    rows = (
        *(1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        *(2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        *(2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )
    return torch.stack(rows, -1).unflatten(-1, (3, 3))


def slerp(quat0: Tensor, quat1: Tensor, u: float) -> Tensor:
    """Spherical interpolation of unit quaternions ``[4]`` along the shorter arc, differentiable in both."""
    cosine = (quat0 * quat1).sum()
    if cosine.item() < 0:
        quat1, cosine = -quat1, -cosine
    if cosine.item() > 1 - 1e-6:  # nearly equal: the chord is the arc, and arccos has no gradient there
        mixed = (1 - u) * quat0 + u * quat1
        return mixed / mixed.norm()
    angle = torch.arccos(cosine)
    return (torch.sin((1 - u) * angle) * quat0 + torch.sin(u * angle) * quat1) / torch.sin(angle)


def rotate(quats: Tensor, vectors: Tensor) -> Tensor:
    """Rotate ``[n, 3]`` vectors by ``[n, 4]`` quaternions, normalised here."""
    unit = torch.nn.functional.normalize(quats, dim=1)
    w, axis = unit[:, :1], unit[:, 1:]
    cross = torch.linalg.cross(axis, vectors)
    return vectors + 2 * (w * cross + torch.linalg.cross(axis, cross))


# sh -----------------------------------------------------------------------------------------------


C0: Final = 0.28209479177387814
"""Value of the constant band: a colour of degree 0 is ``0.5 + C0 * f_dc``."""

Array = NDArray[np.float64]


def degree_of(coefficients: int) -> int:
    """Degree of harmonics with so many coefficients: 1, 4, 9 or 16."""
    return {1: 0, 4: 1, 9: 2, 16: 3}[coefficients]


def basis_rows(x: Any, y: Any, z: Any, degree: int) -> list[Any]:
    """Values of the (degree + 1)^2 harmonics at unit directions, given by their coordinates: arrays or tensors."""
    cos2, sin2 = x * x - y * y, 2 * x * y
    rows = [C0 + 0 * x]
    if degree >= 1:
        rows += [-0.4886025119029199 * y, 0.4886025119029199 * z, -0.4886025119029199 * x]
    if degree >= 2:
        rows += [0.5462742152960396 * sin2, -1.0925484305920792 * y * z, 0.31539156525252005 * (3 * z * z - 1)]
        rows += [-1.0925484305920792 * x * z, 0.5462742152960396 * cos2]
    if degree >= 3:
        cos3, sin3 = x * cos2 - y * sin2, x * sin2 + y * cos2
        c = 0.4570457994644658 * (1 - 5 * z * z)
        rows += [-0.5900435899266435 * sin3, 1.445305721320277 * z * sin2, c * y]
        rows += [0.3731763325901154 * z * (5 * z * z - 3), c * x, 1.445305721320277 * z * cos2]
        rows += [-0.5900435899266435 * cos3]
    return rows


def basis(directions: Array, degree: int) -> Array:
    """Values f64[N, (degree + 1)^2] at unit directions [N, 3]."""
    return np.stack(basis_rows(*np.asarray(directions, np.float64).T, degree=degree), 1)


def rotated(coefficients: NDArray[np.float32], rotation: Array) -> NDArray[np.float32]:
    """Coefficients that look from ``rotation @ d`` as the given ones look from ``d``. ``coefficients``: f32[N, (degree
    + 1)^2, 3]. rotation: f64[3, 3]."""
    degree = degree_of(coefficients.shape[1])
    turned = np.array(coefficients, np.float32)
    for band in range(1, degree + 1):
        rows = slice(band**2, (band + 1) ** 2)
        mixed = band_rotation(rotation, band)
        turned[:, rows] = np.einsum("ij,njc->nic", mixed, coefficients[:, rows].astype(np.float64))
    return turned


def band_rotation(rotation: Array, band: int) -> Array:
    """The orthogonal matrix f64[2 band + 1, 2 band + 1] by which a rotation f64[3, 3] mixes the coefficients of one
    band.

    A rotated harmonic is a sum of harmonics of its band, so its values at a few directions determine the sum: exact but
    for rounding.
    """
    directions, inverse = _probes(band)
    rows = slice(band**2, (band + 1) ** 2)
    return inverse @ basis(directions @ np.asarray(rotation, np.float64), band)[:, rows]


@functools.cache
def _probes(band: int) -> tuple[Array, Array]:
    """Well-spread directions [M, 3] and the inverse of a band's values there, [2 band + 1, M]."""
    directions = spiral(24)
    return directions, np.asarray(np.linalg.pinv(basis(directions, band)[:, band**2 : (band + 1) ** 2]), np.float64)


def spiral(count: int) -> Array:
    """Directions f64[count, 3] that cover the sphere evenly (Fibonacci's spiral)."""
    index = np.arange(count) + 0.5
    z, longitude = 1 - 2 * index / count, np.pi * (1 + 5**0.5) * index
    radius = np.sqrt(1 - z * z)
    return np.stack([radius * np.cos(longitude), radius * np.sin(longitude), z], 1)


# colours whose harmonics belong to a frame that is turned against the world ---------------------------
# Functions of one band mix among themselves, by an orthogonal matrix: turned coefficients are those of the world, and
# renderers need not know of frames.


def mixing(rotation: Tensor, degree: int) -> Tensor:
    """How coefficients of degree 1 to ``degree`` mix when their frame is turned by world_from_frame [3, 3] (on the
    CPU): f32[K - 1, K - 1], K = (degree + 1)^2, orthogonal, takes those of the frame to those of the world."""
    turn = rotation.detach().double().numpy()
    return torch.block_diag(*(torch.from_numpy(band_rotation(turn, band)) for band in range(1, degree + 1))).float()


def turned(rest: Tensor, matrix: Tensor) -> Tensor:
    """Coefficients [n, K - 1, 3] of a frame as those of the world (``mixing``); differentiable in ``rest``."""
    return torch.einsum("ij,njc->nic", matrix, rest)
