"""Input, options and output of every depth network."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from mudg.core.depth import Space


@dataclass(frozen=True, slots=True, eq=False)
class DepthInput:
    """Input of a depth network for one image.

    Args:
        rgb: u8[H, W, 3].
        measured: f32[H, W] metres, visible LiDAR returns, NaN where there is none.
        filled: f32[H, W] metres, the returns filled along the image (``core.complete``); NaN where unknown.
        sky: bool[H, W].
    """

    rgb: NDArray[np.uint8]
    measured: NDArray[np.float32]
    filled: NDArray[np.float32]
    sky: NDArray[np.bool_]


@dataclass(frozen=True, slots=True, eq=False)
class Prediction:
    """``values`` f32[H, W]: depth or inverse depth (``space``) up to scale and shift."""

    values: NDArray[np.float32]
    space: Space

    @classmethod
    def resized(cls, values: Tensor, given: DepthInput, space: Space, least: float | None = None) -> Prediction:
        """From a network's values f32[1, 1, h, w], at the size of the image and at least ``least``."""
        found = functional.interpolate(values, size=given.rgb.shape[:2], mode="bilinear", align_corners=False)
        return cls((found if least is None else found.clamp(min=least))[0, 0].cpu().numpy(), space)


@dataclass(frozen=True, slots=True)
class DepthOptions:
    """Options of networks that denoise; others do not use them.

    Args:
        guided: Marigold: LiDAR steers every denoising step, instead of aligning the result only.
        steps: denoising steps; 0 = the folder's own number, or 50 where LiDAR steers.
    """

    guided: bool = True
    steps: int = 0


PLAIN: Final = DepthOptions()
DepthNetwork = Callable[[DepthInput], Prediction]
