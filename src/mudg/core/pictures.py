"""Pictures: every way in which images and label maps change size, and every colour map of the package. Sizes change by
one of four rules, because what was trained and stored with one must not be read with another."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image
from torch import Tensor

from mudg.base import palette
from mudg.base.errors import InputError
from mudg.base.types import Observation

Map = TypeVar("Map", Tensor, NDArray[Any])

# Near = warm, far = cold. Saturated all the way, so that points stand out from the image under them and far is not
# taken for missing.
_DEPTH_STOPS: Final = np.array(
    [[220, 30, 30], [250, 120, 30], [230, 210, 50], [90, 220, 90], [40, 190, 200], [50, 110, 230], [70, 40, 160]],
    np.float64,
)


# ---- sizes ---------------------------------------------------------------------------------------


def resize_area(rgb: NDArray[np.uint8], width: int, height: int) -> NDArray[np.uint8]:
    """Image u8[H, W, 3] or plane u8[H, W] to another size by averaging areas (Pillow's box filter); the same array if
    the size is right already."""
    if rgb.shape[:2] == (height, width):
        return rgb
    return np.array(Image.fromarray(rgb).resize((width, height), Image.Resampling.BOX))


def resize_bicubic(rgb: NDArray[np.uint8], width: int, height: int) -> NDArray[np.uint8]:
    """Image u8[H, W, 3] to another size by Pillow's bicubic filter; always a new array."""
    return np.array(Image.fromarray(rgb).resize((width, height), Image.Resampling.BICUBIC))


def resize_rgb(rgb: Tensor, height: int, width: int) -> Tensor:
    """Colour f32[3, H, W] to another size, bilinear with antialiasing; the same tensor if the size is right already."""
    if rgb.shape[-2:] == (height, width):
        return rgb
    return torch.nn.functional.interpolate(rgb[None], size=(height, width), mode="bilinear", antialias=True)[0]


def bilinear_from_corner(images: Tensor, side: int) -> Tensor:
    """Images f32[n, C, H, W] squashed to ``side`` x ``side``, bilinear as TensorFlow 1 did it: pixel k of the result
    lies at k * in / out, with no half-pixel offset and no antialiasing."""
    for axis in (-2, -1):
        count = images.shape[axis]
        place = torch.arange(side, dtype=torch.float32) * (count / side)
        low = place.floor().long().clamp(max=count - 1)
        high = (low + 1).clamp(max=count - 1)
        share = (place - low).view([-1, 1] if axis == -2 else [-1])
        images = images.index_select(axis, low) * (1 - share) + images.index_select(axis, high) * share
    return images


def resize_nearest(values: Map, height: int, width: int) -> Map:
    """Depth, labels or masks [..., H, W] to another size by the nearest pixel centre; nothing is mixed."""
    if tuple(values.shape[-2:]) == (height, width):
        return values
    rows = ((np.arange(height) + 0.5) * values.shape[-2] / height).astype(int)
    columns = ((np.arange(width) + 0.5) * values.shape[-1] / width).astype(int)
    return values[..., rows[:, None], columns]


def shrink_exact(rgb: NDArray[np.uint8], height: int, width: int) -> NDArray[np.uint8]:
    """Image u8[H, W, 3] to u8[height, width, 3]: each new pixel is the mean over its exact area of the old image.
    InputError: larger than the image."""
    tall, wide = rgb.shape[:2]
    if height > tall or width > wide:
        raise InputError("images are never enlarged", expected=f"at most {wide}x{tall}", got=f"{width}x{height}")
    down = _area_weights(tall, height) @ rgb.reshape(tall, wide * 3).astype(np.float32)
    across = _area_weights(wide, width) @ down.reshape(height, wide, 3).transpose(1, 0, 2).reshape(wide, height * 3)
    return np.rint(across.reshape(width, height, 3).transpose(1, 0, 2)).clip(0, 255).astype(np.uint8)


def _area_weights(old: int, new: int) -> Any:
    """Sparse f32[new, old]: the share of each old pixel in each new one; rows add to 1."""
    from scipy.sparse import csr_matrix

    edges = np.arange(new + 1) * (old / new)
    first = np.floor(edges[:-1] + 1e-9).astype(int)
    last = np.minimum(np.ceil(edges[1:] - 1e-9).astype(int), old)
    rows = np.repeat(np.arange(new), last - first)
    columns = np.concatenate([np.arange(a, b) for a, b in zip(first, last, strict=True)])
    share = np.minimum(columns + 1, edges[rows + 1]) - np.maximum(columns, edges[rows])
    return csr_matrix(((share * new / old).astype(np.float32), (rows, columns)), (new, old))


# ---- colours -------------------------------------------------------------------------------------


def to_bytes(rgb: Tensor) -> NDArray[np.uint8]:
    """Colour f32[3, H, W] in [0, 1] as a picture u8[H, W, 3]."""
    picture = torch.empty(*rgb.shape[1:], len(rgb), dtype=torch.uint8)
    for number, channel in enumerate(rgb.detach()):  # all channels in float32 at once are large at 4K
        picture[..., number] = (channel.clamp(0, 1) * 255).round().byte().cpu()
    return picture.numpy()


def depth_colors(depth_m: NDArray[np.floating], near_m: float = 2.0, far_m: float = 100.0) -> NDArray[np.uint8]:
    """Depth f[...] in metres to colours u8[..., 3], logarithmic from near (warm) to far (cold); no depth is black.

    The one colour map of depth: videos, pages, previews and contact sheets use it. Pictures are for people; nothing
    reads them back.
    """
    known = np.isfinite(depth_m) & (depth_m > 0)
    safe = np.where(known, depth_m, far_m).clip(near_m, far_m)
    along = np.log(safe / near_m) / np.log(far_m / near_m) * (len(_DEPTH_STOPS) - 1)
    index = np.minimum(along.astype(int), len(_DEPTH_STOPS) - 2)
    part = (along - index)[..., None]
    colors = _DEPTH_STOPS[index] * (1 - part) + _DEPTH_STOPS[index + 1] * part
    colors[~known] = 0
    return colors.round().astype(np.uint8)


def class_colors(train_ids: NDArray[np.integer]) -> NDArray[np.uint8]:
    """Train ids [H, W] to the colours people know from Cityscapes, u8[H, W, 3]; unlabelled is black."""
    return palette.encode(train_ids, palette.DISPLAY_COLORS)


def gray(values: NDArray[np.floating]) -> NDArray[np.uint8]:
    """Values [H, W] in [0, 1] (a confidence) as a picture u8[H, W, 3] from black to white."""
    return np.repeat((255 * values.clip(0, 1)).astype(np.uint8)[..., None], 3, 2)


def error_image(rgb: Tensor, truth: Tensor) -> NDArray[np.uint8]:
    """Mean absolute colour error as a picture u8[H, W, 3]: black = equal, through red to white = 0.35 or more."""
    error = ((rgb.clamp(0, 1) - truth).abs().mean(0) / 0.35).clamp(0, 1).numpy()
    channels = (np.clip(error * 2.2, 0, 1), np.clip(error * 2.2 - 0.8, 0, 1), np.clip(error * 3.2 - 2.2, 0, 1))
    return (np.stack(channels, -1) * 255).round().astype(np.uint8)


# ---- panels --------------------------------------------------------------------------------------


def panels_of(observation: Observation) -> list[NDArray[np.uint8]]:
    """Colour, depth and semantics of an observation as pictures of one size (those that exist)."""
    panels = [to_bytes(observation.rgb)]
    if observation.depth is not None:
        panels.append(depth_colors(observation.depth[0].cpu().numpy()))
    if observation.semantics is not None:
        panels.append(class_colors(observation.semantics.cpu().numpy()))
    return panels


def side_by_side(panels: Sequence[NDArray[np.uint8]]) -> NDArray[np.uint8]:
    """Panels u8[H, W, 3] of one height in a row, with white between them. InputError: no panels, or panels of different
    heights."""
    if len({len(panel) for panel in panels}) != 1:
        raise InputError("panels must be of one size, at least one", got=str([panel.shape for panel in panels]))
    white = np.full((len(panels[0]), 2, 3), 255, np.uint8)
    return np.concatenate([part for panel in panels for part in (white, panel)][1:], 1)
