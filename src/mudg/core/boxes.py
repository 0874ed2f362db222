"""Boxes of road users against each other and against cameras: do they collide, and which sides were ever seen?"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]


def overlap_m(poses_a: Array, size_a: ArrayLike, poses_b: Array, size_b: ArrayLike) -> Array:
    """How deep pairs of boxes overlap, f64[T] metres: the shortest way that parts them; negative: the gap along the best axis.

    Separating axes of two boxes: three faces of each and the nine cross products of their edges (Gottschalk et al., 1996).

    Args:
        poses_a, poses_b: world_from_box f64[T, 4, 4], origin in the centre of the box. size_a, size_b: length, width, height.
    """
    half_a, half_b = np.asarray(size_a, np.float64) / 2, np.asarray(size_b, np.float64) / 2
    edges_a, edges_b = np.swapaxes(poses_a[:, :3, :3], 1, 2), np.swapaxes(poses_b[:, :3, :3], 1, 2)
    crossed = np.cross(edges_a[:, :, None], edges_b[:, None]).reshape(len(poses_a), 9, 3)
    length = np.linalg.norm(crossed, axis=-1, keepdims=True)
    parallel = length[..., 0] < 1e-6
    axes = np.concatenate([edges_a, edges_b, crossed / np.maximum(length, 1e-6)], 1)
    between = np.abs(np.einsum("tkj,tj->tk", axes, poses_b[:, :3, 3] - poses_a[:, :3, 3]))
    reach = sum(
        np.einsum("tke,e->tk", np.abs(np.einsum("tkj,tej->tke", axes, edges)), half)
        for edges, half in ((edges_a, half_a), (edges_b, half_b))
    )
    overlap = reach - between
    overlap[:, 6:][parallel] = np.inf  # parallel edges give no axis of their own
    return overlap.min(1)


def azimuths(world_from_box: Array, places: Array) -> Array:
    """From which side places f64[N, 3] look at boxes f64[N, 4, 4]: angle from the box's front, counter-clockwise, radians."""
    toward = places - world_from_box[:, :3, 3]
    local = np.einsum("nji,nj->ni", world_from_box[:, :3, :3], toward)
    return np.arctan2(local[:, 1], local[:, 0])


def angle_to_nearest(asked: Array, seen: Array) -> Array:
    """Angle f64[N] radians from each asked direction f64[N] to the nearest seen one f64[M]; pi where nothing was seen."""
    if not len(seen):
        return np.full(len(asked), np.pi)
    apart = np.abs(asked[:, None] - seen[None])
    return np.minimum(apart % (2 * np.pi), 2 * np.pi - apart % (2 * np.pi)).min(1)
