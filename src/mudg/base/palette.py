"""The 19 Cityscapes train ids and the colour table used by the published system.

Source: Cityscapes train-id order; colours of the published checkpoints, whose semantic videos are made of them.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

CLASSES: Final = (
    "road",
    "sidewalk",
    "building",
    "wall",
    "fence",
    "pole",
    "traffic light",
    "traffic sign",
    "vegetation",
    "terrain",
    "sky",
    "person",
    "rider",
    "car",
    "truck",
    "bus",
    "train",
    "motorcycle",
    "bicycle",
)
ID: Final = {name: index for index, name in enumerate(CLASSES)}
UNLABELLED: Final = 255
DYNAMIC_IDS: Final = tuple(ID[n] for n in ("person", "rider", "car", "truck", "bus", "train", "motorcycle", "bicycle"))

COLORS: Final[NDArray[np.uint8]] = np.array(
    [
        [255, 120, 50],
        [255, 192, 203],
        [255, 255, 0],
        [0, 150, 245],
        [0, 255, 255],
        [255, 127, 0],
        [255, 0, 0],
        [255, 240, 150],
        [135, 60, 0],
        [160, 32, 240],
        [255, 0, 255],
        [139, 137, 137],
        [75, 0, 75],
        [150, 240, 80],
        [230, 230, 250],
        [0, 175, 0],
        [0, 255, 127],
        [222, 155, 161],
        [140, 62, 69],
    ],
    dtype=np.uint8,
)
COLORS.setflags(write=False)

DISPLAY_COLORS: Final[NDArray[np.uint8]] = np.array(
    [
        [128, 64, 128],
        [244, 35, 232],
        [70, 70, 70],
        [102, 102, 156],
        [190, 153, 153],
        [153, 153, 153],
        [250, 170, 30],
        [220, 220, 0],
        [107, 142, 35],
        [152, 251, 152],
        [70, 130, 180],
        [220, 20, 60],
        [255, 0, 0],
        [0, 0, 142],
        [0, 0, 70],
        [0, 60, 100],
        [0, 80, 100],
        [0, 0, 230],
        [119, 11, 32],
    ],
    dtype=np.uint8,
)
DISPLAY_COLORS.setflags(write=False)


def encode(ids: NDArray[np.integer], colors: NDArray[np.uint8] = COLORS) -> NDArray[np.uint8]:
    """Class ids ``[...]`` to colours ``u8[..., 3]``; ids outside 0..18 (unlabelled) become black."""
    table = np.zeros((256, 3), np.uint8)
    table[: len(colors)] = colors
    return table[np.asarray(ids).astype(np.uint8)]


def decode(
    rgb: NDArray[np.number], colors: NDArray[np.uint8] = COLORS
) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
    """Nearest palette colour (Euclidean).

    Args:
        rgb: ``[..., 3]`` colours in 0..255, any numeric dtype.
        colors: the palette.

    Returns:
        ids ``u8[...]`` and margin ``f32[...]`` = distance to the second nearest minus distance to the nearest colour
        (0 = ambiguous).
    """
    flat = np.asarray(rgb, np.float32).reshape(-1, 3)
    distance = np.linalg.norm(flat[:, None, :] - colors[None].astype(np.float32), axis=-1)
    nearest_two = np.partition(distance, 1, axis=1)[:, :2]
    shape = np.asarray(rgb).shape[:-1]
    return distance.argmin(1).astype(np.uint8).reshape(shape), (nearest_two[:, 1] - nearest_two[:, 0]).reshape(shape)
