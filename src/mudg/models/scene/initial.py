"""Starting values of Gaussians: points, thinned and coloured, become rows of the table."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from torch import Tensor

SH_C0: Final = 0.28209479177387814
START_OPACITY: Final = 0.1


def voxel_filter(xyz: NDArray[np.float32], size_m: NDArray[np.floating] | float) -> NDArray[np.int64]:
    """Indices of one point per cube of side ``size_m`` (a number, or one per point, taken to powers of sqrt 2), sorted."""
    if np.isscalar(size_m):
        level, cell = np.zeros(len(xyz), np.int64), np.floor(xyz / float(size_m)).astype(np.int64)  # type: ignore[arg-type]
    else:
        level = np.round(2 * np.log2(np.asarray(size_m, np.float64))).astype(np.int64)
        cell = np.floor(xyz / np.exp2(level / 2)[:, None]).astype(np.int64)
    keys = np.column_stack([level, cell])
    keys = keys - keys.min(0, initial=0)
    spans = keys.max(0, initial=0) + 1
    flat = ((keys[:, 0] * spans[1] + keys[:, 1]) * spans[2] + keys[:, 2]) * spans[3] + keys[:, 3]
    return np.sort(np.unique(flat, return_index=True)[1])


def neighbour_scale(xyz: NDArray[np.float32], smallest_m: float = 0.005, largest_m: float = 1.5) -> NDArray[np.float32]:
    """Root mean square distance to the three nearest other points, f32[N] metres, kept within bounds."""
    if len(xyz) < 4:
        return np.full(len(xyz), 0.1, np.float32)
    distance, _ = cKDTree(xyz).query(xyz, k=4, workers=1)
    return np.sqrt((distance[:, 1:] ** 2).mean(1)).clip(smallest_m, largest_m).astype(np.float32)


def columns_from_points(
    xyz: NDArray[np.float32], rgb: NDArray[np.uint8], semantics: NDArray[np.uint8] | None, classes: Sequence[int],
    sh_degree: int, scale_m: NDArray[np.float32] | None = None,
) -> dict[str, Tensor]:  # fmt: skip
    """Starting columns for ``N`` coloured points: round, colour of the point, class of the point where known.

    Args:
        xyz: f32[N, 3] metres in the node's frame. rgb: u8[N, 3]. semantics: u8[N] train ids (255 = unknown) or None.
        scale_m: f32[N]; default from the three nearest neighbours.
    """
    count = len(xyz)
    scale = neighbour_scale(xyz) if scale_m is None else scale_m
    logits = np.zeros((count, len(classes)), np.float32)
    if semantics is not None:
        for channel, train_id in enumerate(classes):
            logits[semantics == train_id, channel] = 3.0
    quats = np.zeros((count, 4), np.float32)
    quats[:, 0] = 1.0
    columns = {
        "means": torch.from_numpy(np.array(xyz, np.float32)),
        "quats": torch.from_numpy(quats),
        "log_scales": torch.from_numpy(np.log(scale))[:, None].repeat(1, 3),
        "logits": torch.full((count,), float(np.log(START_OPACITY / (1 - START_OPACITY)))),
        "sh_dc": torch.from_numpy((rgb.astype(np.float32) / 255 - 0.5) / SH_C0)[:, None],
        "semantics": torch.from_numpy(logits),
    }
    if sh_degree > 0:
        columns["sh_rest"] = torch.zeros(count, (sh_degree + 1) ** 2 - 1, 3)
    return columns


def box_grid(size_m: Sequence[float], rgb: Sequence[float]) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
    """Points on the surface of a box, for an object that the LiDAR hardly saw: xyz f32[M, 3] in the box frame, one colour."""
    axis = np.linspace(-0.5, 0.5, 12)
    grid = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), -1).reshape(-1, 3)
    surface = grid[(np.abs(grid) > 0.5 - 1e-9).any(1)]
    xyz = (surface * 0.9 * np.asarray(size_m)).astype(np.float32)
    return xyz, np.broadcast_to(np.asarray(rgb, np.uint8), (len(xyz), 3)).copy()
