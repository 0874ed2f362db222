"""Input, options and output of every depth network."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from mudg.core.align import Space


@dataclass(frozen=True, slots=True, eq=False)
class DepthInput:
    """What a depth network is given for one image.

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


@dataclass(frozen=True, slots=True)
class DepthOptions:
    """Numbers for networks that denoise; others do not read them.

    Args:
        guided: Marigold: LiDAR steers every denoising step, instead of aligning the result only.
        steps: denoising steps; 0 = the folder's own number, or 50 where LiDAR steers.
    """

    guided: bool = True
    steps: int = 0


PLAIN: Final = DepthOptions()
DepthNetwork = Callable[[DepthInput], Prediction]
