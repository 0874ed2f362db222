"""The own vehicle in an image: what stays the same at the bottom of the image while everything else goes by."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from mudg.base import log
from mudg.base.types import Scene
from mudg.data.scene import read_image

FRAMES: Final = 16
MIN_TRAVEL_M: Final = 10.0
MIN_SHARE: Final = 0.002
"""A piece smaller than this share of the image is no bonnet."""


def find_ego(scene: Scene, camera: str) -> NDArray[np.bool_]:
    """Own vehicle in the images of a camera, bool[H, W]; empty (and said so) on a drive too short to tell."""
    frames = scene.frames_of(camera)
    size = (scene.cameras[camera].height, scene.cameras[camera].width)
    steps = np.diff(scene.ego.world_from_ego[:, :3, 3], axis=0)
    travel_m = float(np.linalg.norm(steps, axis=1).sum())
    if len(frames) < 4 or travel_m < MIN_TRAVEL_M:
        log.warn(
            f"camera {camera}: the log is too short to find the own vehicle ({len(frames)} images, {travel_m:.0f} m)"
        )
        return np.zeros(size, bool)
    at = np.unique(np.linspace(0, len(frames) - 1, FRAMES).astype(int))
    return steady_bottom(np.stack([read_image(scene, frames[index]).mean(2) for index in at]))


def steady_bottom(grey: NDArray[np.floating]) -> NDArray[np.bool_]:
    """Pixels joined to the lower edge that vary much less over time than the rest of the lower half.

    Args:
        grey: [N, H, W] images over a drive, 0..255.

    Returns:
        bool[H, W].
    """
    middle = np.median(grey, axis=0)
    spread = ndimage.uniform_filter(np.median(np.abs(grey - middle), axis=0), 3)
    height, width = spread.shape
    limit = 0.35 * float(np.median(spread[height // 2 :]))
    steady = ndimage.binary_opening(np.pad(spread < limit, 2, mode="edge"), np.ones((5, 5), bool))[2:-2, 2:-2]
    steady[: height // 2] = False
    pieces, count = ndimage.label(steady)
    sizes = np.bincount(pieces.ravel(), minlength=count + 1)
    joined = [piece for piece in np.unique(pieces[-1]) if piece and sizes[piece] > MIN_SHARE * height * width]
    return ndimage.binary_fill_holes(np.isin(pieces, joined)) if joined else np.zeros((height, width), bool)
