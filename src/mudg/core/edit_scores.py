"""What an edit did to renders, where no truth of the edited drive exists: the edited render against the unedited one of the same view."""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from torch import Tensor

from mudg.core.weather.tone import LUMA

SAME: Final = 1.5 / 255
"""Colours of 8 bits that differ by more than this differ by more than one step."""


def changed_pixels(edited: Tensor, unedited: Tensor) -> NDArray[np.bool_]:
    """Where colours f32[3, H, W] in [0, 1] differ by more than 1/255 in a channel, bool[H, W]."""
    return ((edited - unedited).abs().amax(0) > SAME).numpy()


def gradient_correlation(edited: Tensor, unedited: Tensor) -> float | None:
    """Correlation of luminance gradients of two images f32[3, H, W]: [-1, 1], higher is better, 1 = every edge in its place with the same
    relative strength; a change of brightness or contrast of the whole image leaves it at 1. None where an image has no gradients.
    """
    pair = [_gradients(image.numpy()) for image in (edited, unedited)]
    scale = math.sqrt(float((pair[0] ** 2).sum()) * float((pair[1] ** 2).sum()))
    return float((pair[0] * pair[1]).sum()) / scale if scale > 0 else None


def _gradients(rgb: NDArray[np.float32]) -> NDArray[np.float64]:
    """Sobel derivatives f64[2, H, W] of the brightness along columns and rows."""
    luminance = np.tensordot(LUMA, rgb, 1)
    return np.stack([ndimage.sobel(luminance, axis=axis, mode="nearest") for axis in (1, 0)])


def mask_counts(a: NDArray[np.bool_], b: NDArray[np.bool_]) -> tuple[int, int]:
    """Pixels in both masks bool[H, W], and in either: intersection over union, to be pooled over views."""
    return int((a & b).sum()), int((a | b).sum())
