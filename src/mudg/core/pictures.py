"""Pictures of results: sizes, bytes and colour maps. Every resizing and every colour map of the package is here."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor


def error_image(rgb: Tensor, truth: Tensor) -> np.ndarray:
    """Mean absolute colour error as a picture u8[H, W, 3]: black = equal, through red to white = 0.35 or more."""
    error = ((rgb.clamp(0, 1) - truth).abs().mean(0) / 0.35).clamp(0, 1).numpy()
    channels = (np.clip(error * 2.2, 0, 1), np.clip(error * 2.2 - 0.8, 0, 1), np.clip(error * 3.2 - 2.2, 0, 1))
    return (np.stack(channels, -1) * 255).round().astype(np.uint8)


def to_bytes(rgb: Tensor) -> np.ndarray:
    """Colour f32[3, H, W] in [0, 1] as a picture u8[H, W, 3]."""
    return (rgb.clamp(0, 1) * 255).round().byte().permute(1, 2, 0).numpy()


def resize_rgb(rgb: Tensor, height: int, width: int) -> Tensor:
    """Colour f32[3, H, W] to another size, bilinear with antialiasing; unchanged if the size is right already."""
    if rgb.shape[-2:] == (height, width):
        return rgb
    return torch.nn.functional.interpolate(rgb[None], size=(height, width), mode="bilinear", antialias=True)[0]


def resize_nearest(values: Tensor, height: int, width: int) -> Tensor:
    """Depth, labels or masks [C, H, W] to another size by the nearest pixel centre; nothing is mixed."""
    if values.shape[-2:] == (height, width):
        return values
    rows = ((torch.arange(height) + 0.5) * values.shape[-2] / height).long()
    columns = ((torch.arange(width) + 0.5) * values.shape[-1] / width).long()
    return values[:, rows][:, :, columns]
