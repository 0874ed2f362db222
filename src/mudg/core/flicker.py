"""How restless a video is: what static surfaces change from frame to frame, against what they change in the truth."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from mudg.base import palette

MOVABLE = tuple(palette.ID[n] for n in ("person", "rider", "car", "truck", "bus", "train", "motorcycle", "bicycle"))


def flicker(
    made: Tensor, truth: Tensor, depth: Tensor, ids: Tensor, world_from_cam: Tensor, intrinsics: Tensor
) -> float:
    """Change of static surfaces from one frame to the next in `made`, over that in `truth` (1 = as calm as the truth).

    Arguments as for `changes`. NaN for one frame or without such pixels.
    """
    pairs = changes(made, truth, depth, ids, world_from_cam, intrinsics)
    of_truth = sum(t for _, t in pairs)
    return sum(m for m, _ in pairs) / of_truth if of_truth > 0 else math.nan


def changes(
    made: Tensor, truth: Tensor, depth: Tensor, ids: Tensor, world_from_cam: Tensor, intrinsics: Tensor
) -> list[tuple[float, float]]:
    """Summed absolute change of static surfaces between each frame and the next, in `made` and in `truth`.

    made, truth f32[T,3,H,W]; depth f32[T,1,H,W] metres and ids i64[T,H,W] are true; world_from_cam f64[T,4,4]; intrinsics f64[T,4].
    Every pixel of a class that cannot move is carried by its true depth into the next frame and compared with what is
    there (bilinear), if the same surface is seen there (depths within 3 %).
    """
    height, width = truth.shape[-2:]
    rows, columns = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")
    static = ~torch.isin(ids, torch.tensor(MOVABLE)) & (depth[:, 0] < 90.0)
    pairs = []
    for t in range(len(truth) - 1):
        fx, fy, cx, cy = intrinsics[t].float()
        z = depth[t, 0]
        points = torch.stack([(columns - cx) / fx * z, (rows - cy) / fy * z, z, torch.ones_like(z)])
        pose = (torch.linalg.inv(world_from_cam[t + 1]) @ world_from_cam[t]).float()
        x, y, ahead, _ = torch.einsum("ij,jhw->ihw", pose, points)
        fx, fy, cx, cy = intrinsics[t + 1].float()
        there = torch.stack([(fx * x / ahead + cx) * (2 / width) - 1, (fy * y / ahead + cy) * (2 / height) - 1], -1)[
            None
        ]
        look = lambda image, mode, grid=there: torch.nn.functional.grid_sample(  # noqa: E731
            image[None], grid, mode=mode, align_corners=False)[0]  # fmt: skip
        within = (there.abs() < 1).all(-1)[0] & (ahead > 0.5)
        same = within & static[t] & ((look(depth[t + 1], "nearest")[0] / ahead - 1).abs() < 0.03)
        pairs.append(
            tuple(float((look(v[t + 1], "bilinear") - v[t]).abs().mean(0)[same].double().sum()) for v in (made, truth))
        )
    return pairs
