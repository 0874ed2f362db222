"""Photographic surfaces and skies for a city, from a folder of the user's: `textures/*.jpg` or `.png` and `sky/*.hdr`.

A surface's photograph multiplies its drawn colour, so only its variation around its own mean is used. Which surface a
file is for follows from words in its name (`SURFACES`); files that fit none are not used. Panoramas are Radiance HDR;
what lies below `HORIZON_DEG` in them (trees, houses) is left out and the rest is stretched down to the horizon. The
same folder and seed give the same city.
"""

from __future__ import annotations

import functools
import io
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from mudg.base import seeds, store
from mudg.base.errors import InputError

Pixels = NDArray[np.float32]

SURFACES: Final[tuple[tuple[str, ...], ...]] = (
    ("asphalt",),
    ("footway", "tile0", "concrete", "cobblestone"),
    ("gras", "ground0"),
    ("plaster", "concrete", "marble", "woodsiding", "composite"),
    ("brick",),
    ("concrete", "plaster"),
    ("wood0", "woodwall", "ground0"),
    ("roofing",),
    ("corrugated", "metal0", "fabric"),
)
"""Words in the names of files, per texture slot of the native library: road, sidewalk, grass, walls, brick, concrete,
bark, roof, cargo."""
METRES: Final = (2.5, 1.6, 2.0, 2.4, 1.2, 2.5, 0.8, 1.6, 2.0)
"""Side of the place that a photograph covers, per slot."""
SKY_SLOT: Final = 9
SIDE_PX: Final = 256
HORIZON_DEG: Final = 28.0
SKY_PX: Final = (512, 96)


def draw_photos(folder: Path, seed: int) -> list[tuple[int, Pixels, float]]:
    """Slot, pixels f32[H, W, 3] and size in metres of the photographs that a city uses; half of the cities also get a
    panorama.

    Raises:
        InputError: no such folder, or a file in it cannot be read.
    """
    if not folder.is_dir():
        what = "there is no such folder of textures"
        raise InputError(what, where=str(folder), expected="textures/*.jpg and sky/*.hdr")
    rng = seeds.numpy_rng(seed, 0, "city photographs")
    files = sorted(p for p in folder.glob("textures/*") if p.suffix.lower() in (".jpg", ".png"))
    found: list[tuple[int, Pixels, float]] = []
    for slot, words in enumerate(SURFACES):
        fitting = [p for p in files if any(word in p.name.lower() for word in words)]
        draw, size = float(rng.random()), float(rng.uniform(0.7, 1.4))
        if fitting and draw < 0.9:
            found.append((slot, surface(fitting[int(draw / 0.9 * len(fitting))]), METRES[slot] * size))
    skies = sorted(folder.glob("sky/*.hdr"))
    draw, turn, level = float(rng.random()), float(rng.random()), float(rng.uniform(0.8, 2.2))
    if skies and draw < 0.55:
        image = panorama(skies[int(draw / 0.55 * len(skies))])
        image = np.roll(image, int(turn * image.shape[1]), 1)
        if turn > 0.5:
            image = image[:, ::-1]
        found.append((SKY_SLOT, np.ascontiguousarray(image * level, np.float32), 1.0))
    return found


@functools.lru_cache(maxsize=64)
def surface(path: Path) -> Pixels:
    """A photograph as albedo relative to its mean, f32[256, 256, 3]: linear light, three quarters of its tint taken
    out."""
    try:
        with Image.open(io.BytesIO(store.read_bytes(path))) as image:
            small = image.convert("RGB").resize((SIDE_PX, SIDE_PX), Image.Resampling.BOX)
    except (Image.DecompressionBombError, OSError, SyntaxError, ValueError) as error:
        raise InputError("a texture cannot be read", where=str(path), got=str(error)) from error
    light = (np.asarray(small, np.float32) / 255) ** 2.2
    mean = light.mean((0, 1))
    tint = (mean / mean.mean()) ** 0.25
    return np.clip(light / np.maximum(mean, 1e-3) * tint, 0.15, 4.0).astype(np.float32)


@functools.lru_cache(maxsize=16)
def panorama(path: Path) -> Pixels:
    """The sky of a panorama f32[96, 512, 3], zenith first, horizon last; median brightness 1, the sun limited to 8."""
    image = radiance(store.read_bytes(path), path)
    upper = image[: round(image.shape[0] * (90 - HORIZON_DEG) / 180)]
    level = float(np.median(upper.mean(-1)))
    upper = np.clip(upper / max(level, 1e-4), 0, 8)
    columns = (np.arange(SKY_PX[0] + 1) * upper.shape[1]) // SKY_PX[0]
    rows = (np.arange(SKY_PX[1] + 1) * upper.shape[0]) // SKY_PX[1]
    summed = np.add.reduceat(np.add.reduceat(upper, rows[:-1], 0), columns[:-1], 1)
    count = np.maximum(np.diff(rows), 1)[:, None, None] * np.maximum(np.diff(columns), 1)[None, :, None]
    return (summed / count).astype(np.float32)


def radiance(content: bytes, path: Path) -> Pixels:
    """Pixels f32[H, W, 3] of a Radiance HDR file with run-length coded RGBE rows, top row first.

    Raises:
        InputError: another format, or the file is cut off.
    """
    problem = functools.partial(InputError, "not a Radiance HDR image", where=str(path))
    head, _, rest = content.partition(b"\n\n")
    size, _, data = rest.partition(b"\n")
    words = size.split()
    if not head.startswith(b"#?") or len(words) != 4 or words[0] != b"-Y" or words[2] != b"+X":
        raise problem(expected="#?RADIANCE with rows from the top (-Y H +X W)")
    height, width = int(words[1]), int(words[3])
    if not (1 <= height <= 1 << 14 and 8 <= width < 1 << 15):
        raise problem(got=f"{width}x{height} pixels")
    rgbe, at = np.empty((height, 4, width), np.uint8), 0
    try:
        for row in range(height):
            if data[at] != 2 or data[at + 1] != 2 or data[at + 2] * 256 + data[at + 3] != width:
                raise problem(expected="run-length coded rows", got=f"row {row}")
            at += 4
            for channel in range(4):
                x = 0
                while x < width:
                    count = data[at]
                    if count > 128:  # a run
                        rgbe[row, channel, x : x + count - 128] = data[at + 1]
                        at, x = at + 2, x + count - 128
                    elif count:
                        rgbe[row, channel, x : x + count] = np.frombuffer(data, np.uint8, count, at + 1)
                        at, x = at + 1 + count, x + count
                    else:
                        raise problem(got=f"an empty run in row {row}")
    except (IndexError, ValueError) as error:
        raise problem(got=f"cut off in row {row}") from error
    scale = np.exp2(rgbe[:, 3].astype(np.float32) - 136)
    return np.where(rgbe[:, 3:4] > 0, rgbe[:, :3] * scale[:, None], 0).transpose(0, 2, 1).astype(np.float32)
