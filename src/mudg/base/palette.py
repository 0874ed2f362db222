"""The 19 Cityscapes train ids and the colour table used by the published system.

Source: Cityscapes train-id order; colours of the published checkpoints, whose semantic videos are made of them.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

CLASSES: Final = tuple(
    "road,sidewalk,building,wall,fence,pole,traffic light,traffic sign,vegetation,terrain,sky,person,rider,car,truck,"
    "bus,train,motorcycle,bicycle".split(",")
)
ID: Final = {name: index for index, name in enumerate(CLASSES)}
UNLABELLED: Final = 255
DYNAMIC_IDS: Final = tuple(ID[n] for n in ("person", "rider", "car", "truck", "bus", "train", "motorcycle", "bicycle"))


def _table(colors: str) -> NDArray[np.uint8]:
    """Colours as #RRGGBB, without the #, as u8[19, 3] that cannot be written to."""
    return np.frombuffer(bytes.fromhex(colors), np.uint8).reshape(-1, 3)


COLORS: Final = _table(
    "ff7832 ffc0cb ffff00 0096f5 00ffff ff7f00 ff0000 fff096 873c00 a020f0 ff00ff 8b8989 4b004b 96f050 e6e6fa "
    "00af00 00ff7f de9ba1 8c3e45"
)
DISPLAY_COLORS: Final = _table(
    "804080 f423e8 464646 66669c be9999 999999 faaa1e dcdc00 6b8e23 98fb98 4682b4 dc143c ff0000 00008e 000046 "
    "003c64 005064 0000e6 770b20"
)


def other_ids(ids: NDArray[np.integer]) -> list[int]:
    """The first eight values that are neither a class nor ``UNLABELLED``."""
    return np.setdiff1d(ids, [*range(len(CLASSES)), UNLABELLED])[:8].tolist()


def encode(ids: NDArray[np.integer], colors: NDArray[np.uint8] = COLORS) -> NDArray[np.uint8]:
    """Class ids ``[...]`` to colours ``u8[..., 3]``; ids outside 0..18 (unlabelled) become black."""
    table = np.zeros((256, 3), np.uint8)
    table[: len(colors)] = colors
    return table[np.asarray(ids).astype(np.uint8)]


def decode(
    rgb: NDArray[np.number], colors: NDArray[np.uint8] = COLORS
) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
    """Nearest palette colour (Euclidean) of colours ``[..., 3]`` in 0..255: ids ``u8[...]`` and margin ``f32[...]``,
    the distance to the second nearest minus that to the nearest colour (0 = ambiguous)."""
    flat = np.asarray(rgb, np.float32).reshape(-1, 3)
    distance = np.linalg.norm(flat[:, None, :] - colors[None].astype(np.float32), axis=-1)
    nearest_two = np.partition(distance, 1, axis=1)[:, :2]
    shape = np.asarray(rgb).shape[:-1]
    return distance.argmin(1).astype(np.uint8).reshape(shape), (nearest_two[:, 1] - nearest_two[:, 0]).reshape(shape)
