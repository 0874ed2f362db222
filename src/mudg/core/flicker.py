"""How restless a video is: what static surfaces change from frame to frame, against what they change in the truth."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final

import torch
from torch import Tensor

from mudg.base import geometry, palette
from mudg.base.types import View

WHOLE_PIXELS: Final = 2_500_000
"""Images of up to this many pixels are carried in one piece, larger ones in bands of rows."""
BAND_PIXELS: Final = 600_000
MOVABLE = tuple(palette.ID[n] for n in ("person", "rider", "car", "truck", "bus", "train", "motorcycle", "bicycle"))


def flicker(made: Tensor, truth: Tensor, frames: Sequence[TrueFrame]) -> float:
    """Change of static surfaces from one frame to the next in `made`, over that in `truth` (1 = as steady as the truth).

    Arguments as for `changes`. NaN for one frame or without such pixels.
    """
    pairs = changes(made, truth, frames)
    true_change = sum(t for _, t in pairs)
    return sum(m for m, _ in pairs) / true_change if true_change > 0 else math.nan


def changes(made: Tensor, truth: Tensor, frames: Sequence[TrueFrame]) -> list[tuple[float, float]]:
    """Summed absolute change of static surfaces between each frame and the next, in `made` and in `truth`, f32[T,3,H,W] each.

    Every pixel of a class that cannot move is carried by its true depth into the next frame and compared with what is
    there (bilinear), if the same surface is seen there (depths within 3 %).
    """
    pairs = []
    for t in range(len(truth) - 1):
        where = pixel_motion(frames[t], frames[t + 1])
        pairs.append((change(made[t], made[t + 1], where), change(truth[t], truth[t + 1], where)))
    return pairs


@dataclass(frozen=True)
class TrueFrame:
    """Truth of one frame: depth f32[1,H,W] metres, ids i64[H,W], world_from_cam f64[4,4], intrinsics f64[4]: fx, fy, cx, cy."""

    depth: Tensor
    ids: Tensor
    world_from_cam: Tensor
    intrinsics: Tensor

    @classmethod
    def of(cls, view: View, depth: Tensor, ids: Tensor) -> TrueFrame:
        """The frame of a view of this size, with true depth and classes."""
        camera = view.camera
        lens = torch.tensor([camera.fx, camera.fy, camera.cx, camera.cy], dtype=torch.float64)
        return cls(depth, ids, torch.from_numpy(view.world_from_cam.copy()), lens)


@dataclass(frozen=True)
class PixelMotion:
    """Where each pixel of a frame lies in the next one: ``there`` f32[1,H,W,2] in [-1, 1] as `grid_sample` takes it; ``same``
    bool[H,W]: static, and the same surface is seen there."""

    there: Tensor
    same: Tensor


def pixel_motion(
    frame: TrueFrame, following: TrueFrame, moved: Mapping[int, Tensor] | None = None, instance: Tensor | None = None
) -> PixelMotion:
    """Carry every pixel of a frame by its depth into the following one.

    Args:
        moved: how rigid objects move in the world between the two, f64[4, 4] by their number in ``instance`` i64[H, W] of the first
            frame; their pixels are carried with them and count as static ones do.
    """
    height, width = frame.ids.shape
    found = [_motion_of_rows(frame, following, moved, instance, rows) for rows in _bands(height, width)]
    if len(found) == 1:
        return found[0]
    return PixelMotion(torch.cat([part.there for part in found], 1), torch.cat([part.same for part in found]))


def _bands(height: int, width: int) -> list[range]:
    """Rows of an image in pieces that are worked on one after the other."""
    count = height if height * width <= WHOLE_PIXELS else max(1, BAND_PIXELS // width)
    return [range(first, min(height, first + count)) for first in range(0, height, count)]


def _motion_of_rows(
    whole: TrueFrame, following: TrueFrame, moved: Mapping[int, Tensor] | None, instance: Tensor | None, chosen: range
) -> PixelMotion:
    """``pixel_motion`` of some rows of the frame."""
    (height, width), rows_of = whole.ids.shape, slice(chosen.start, chosen.stop)
    frame = replace(whole, depth=whole.depth[:, rows_of], ids=whole.ids[rows_of])
    instance = None if instance is None else instance[rows_of]
    rows, columns = torch.meshgrid(torch.arange(chosen.start, chosen.stop) + 0.5, torch.arange(width) + 0.5, indexing="ij")
    static = ~torch.isin(frame.ids, torch.tensor(MOVABLE)) & (frame.depth[0] < 90.0)
    z = frame.depth[0]
    ray_x, ray_y = geometry.pinhole_ray(frame.intrinsics.float(), columns, rows)
    points = torch.stack([ray_x * z, ray_y * z, z, torch.ones_like(z)])
    pose = (torch.linalg.inv(following.world_from_cam) @ frame.world_from_cam).float()
    carried = torch.einsum("ij,jhw->ihw", pose, points)
    if moved and instance is not None:
        for number in instance.unique().tolist():
            if number in moved:
                own = instance == number
                with_it = (torch.linalg.inv(following.world_from_cam) @ moved[number] @ frame.world_from_cam).float()
                carried[:, own] = with_it @ points[:, own]
                static = static | (own & (frame.depth[0] < 90.0))
    x, y, ahead, _ = carried
    u, v = geometry.pinhole(following.intrinsics.float(), x, y, ahead)
    there = torch.stack([u * (2 / width) - 1, v * (2 / height) - 1], -1)[None]
    within = (there.abs() < 1).all(-1)[0] & (ahead > 0.5)
    depth_there = _sample_at(following.depth, there, "nearest")[0]
    return PixelMotion(there, within & static & ((depth_there / ahead - 1).abs() < 0.03))


def change(frame: Tensor, following: Tensor, where: PixelMotion) -> float:
    """Summed absolute change of colours f32[3,H,W] from a frame to the following one, over the pixels in ``where.same``."""
    total = 0.0
    for band in _bands(*where.same.shape):
        rows = slice(band.start, band.stop)
        apart = (_sample_at(following, where.there[:, rows], "bilinear") - frame[:, rows]).abs().mean(0)
        total += float(apart[where.same[rows]].double().sum())
    return total


def _sample_at(image: Tensor, there: Tensor, mode: str) -> Tensor:
    return torch.nn.functional.grid_sample(image[None], there, mode=mode, align_corners=False)[0]
