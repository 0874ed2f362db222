"""Quaternions (w, x, y, z) in torch, differentiable. ``base.geometry`` has their numpy form in float64."""

from __future__ import annotations

import torch
from torch import Tensor


def left_product_matrix(quat: Tensor) -> Tensor:
    """``[4, 4]`` matrix L with ``L @ p == quat * p`` (Hamilton product, w x y z)."""
    w, x, y, z = quat.unbind()
    return torch.stack([w, -x, -y, -z, x, w, -z, y, y, z, w, -x, z, -y, x, w]).view(4, 4)


def rotation_matrix(quat: Tensor) -> Tensor:
    """Rotation ``[3, 3]`` of a quaternion ``[4]``, normalised here."""
    w, x, y, z = (quat / quat.norm()).unbind()
    return torch.stack(
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
         2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
         2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)]
    ).view(3, 3)  # fmt: skip


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
