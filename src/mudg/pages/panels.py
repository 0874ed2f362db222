"""Panels of a video: several methods' views of one moment side by side, one row per modality."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from mudg.base.types import Observation
from mudg.core.pictures import class_colors, depth_colors, error_image, resize_nearest, resize_rgb, to_bytes
from mudg.pages.page import FAR_M, NEAR_M

BLANK: Final = 24
"""Grey value of a panel that a method does not produce."""


def panel_size(camera_width: int, camera_height: int, widest: int) -> tuple[int, int]:
    """Width and height of a panel, both even: at most ``widest``, in the camera's proportions."""
    width = min(widest, camera_width) // 2 * 2
    return width, max(2, round(camera_height * width / camera_width) // 2 * 2)


def panel_grid(
    views: Mapping[str, Observation | None], rows: Sequence[str], size: tuple[int, int], truth: Observation | None
) -> NDArray[np.uint8]:
    """One picture u8[rows * height, columns * width, 3] of one moment; what a method lacks stays grey.

    Args:
        views: column -> what it shows. rows: of ``rgb``, ``depth``, ``semantics``, ``error``.
        size: width and height of a panel, pixels. truth: what colour errors are measured against; its own column has none.
    """
    width, height = size
    grid = np.full((height * len(rows), width * len(views), 3), BLANK, np.uint8)
    true_rgb = None if truth is None else resize_rgb(truth.rgb, height, width).clamp(0, 1)
    for x, seen in enumerate(views.values()):
        if seen is None:
            continue
        against = None if seen is truth else true_rgb
        for y, row in enumerate(rows):
            picture = _panel(seen, row, size, against)
            if picture is not None:
                grid[y * height : (y + 1) * height, x * width : (x + 1) * width] = picture
    return grid


def _panel(seen: Observation, row: str, size: tuple[int, int], true_rgb: Tensor | None) -> NDArray[np.uint8] | None:
    width, height = size
    if row == "depth":
        return (
            None
            if seen.depth is None
            else depth_colors(resize_nearest(seen.depth, height, width)[0].numpy(), NEAR_M, FAR_M)
        )
    if row == "semantics":
        return None if seen.semantics is None else class_colors(resize_nearest(seen.semantics, height, width).numpy())
    rgb = resize_rgb(seen.rgb, height, width)
    if row == "error":
        return None if true_rgb is None else error_image(rgb, true_rgb)
    return to_bytes(rgb)
