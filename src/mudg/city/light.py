"""Sun, sky, weather and camera response of a generated city."""

from __future__ import annotations

import functools
import io
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from mudg.base import seeds, store
from mudg.base.errors import InputError
from mudg.city import layout as rec
from mudg.city.config import CityConfig
from mudg.core.weather.air import noise_seed, patch_threshold

Numbers = NDArray[np.float64]
LAMP_POWER: Final = 64.0
"""50 lux at 8 m below a street lamp."""


@dataclass(frozen=True, slots=True, eq=False)
class Sky:
    """Radiances f64[3] of sun, zenith, horizon, ambient light and clouds; share of clouds; elevation of the sun in
    radians."""

    sun: Numbers
    zenith: Numbers
    horizon: Numbers
    ambient: Numbers
    cloud: Numbers
    cloudiness: float
    elevation: float


def _other_sky(rng: np.random.Generator, plain: Sky) -> Sky:
    """The sky of a photograph: often so bright that the camera saturates. Ground and sky are exposed independently."""
    kind = int(rng.choice(7, p=[0.14, 0.22, 0.16, 0.16, 0.16, 0.10, 0.06]))
    bright = rng.uniform(0.9, 2.6)
    warm = 1 + rng.uniform(-0.06, 0.06) * np.array([1.0, 0.0, -1.0])
    if kind == 0:  # as it was, only brighter or darker
        k = rng.uniform(0.7, 1.8)
        return replace(plain, zenith=plain.zenith * k, horizon=plain.horizon * k, cloud=plain.cloud * k)
    if kind == 1:  # white all over, near saturation
        white = np.array([0.97, 1.0, 1.03]) * warm * bright * rng.uniform(1.0, 1.8)
        sun, zenith = plain.sun * rng.uniform(0, 0.15), white * rng.uniform(0.75, 1.05)
        ambient, cloudiness = np.array([0.95, 1.0, 1.06]) * rng.uniform(0.7, 1.3), rng.uniform(0.0, 1.0)
        return Sky(sun, zenith, white, ambient, white * 0.95, cloudiness, plain.elevation)
    if kind == 2:  # graded blue, pale at the horizon
        deep = np.array([rng.uniform(0.08, 0.4), rng.uniform(0.3, 0.62), rng.uniform(0.75, 1.2)])
        zenith, pale = deep * rng.uniform(0.6, 1.3), np.array([0.85, 0.95, 1.05]) * warm * rng.uniform(0.8, 1.8)
        return replace(plain, zenith=zenith, horizon=pale, cloudiness=rng.uniform(0, 0.25))
    if kind == 3:  # scattered bright clouds
        deep = np.array([rng.uniform(0.15, 0.35), rng.uniform(0.4, 0.55), rng.uniform(0.8, 1.1)])
        pale, cloud = np.array([0.8, 0.9, 1.0]) * rng.uniform(0.8, 1.5), np.array([1.0, 1.0, 1.02]) * warm * bright
        return replace(plain, zenith=deep, horizon=pale, cloudiness=rng.uniform(0.35, 1.1), cloud=cloud)
    if kind == 4:  # haze: white below, bluish above
        white = np.array([1.0, 1.0, 1.0]) * warm * bright
        blue = np.array([0.55, 0.72, 0.95]) * bright
        return replace(plain, horizon=white * 1.2, zenith=blue, cloud=white, cloudiness=rng.uniform(0.1, 0.6))
    if kind == 5:  # low sun
        glow = np.array([1.5, rng.uniform(0.7, 1.1), rng.uniform(0.35, 0.8)]) * rng.uniform(0.8, 1.6)
        sun = np.array([2.8, 1.7, 0.9]) * rng.uniform(0.4, 1.0)
        zenith, ambient = np.array([0.25, 0.35, 0.6]) * rng.uniform(0.8, 1.5), np.array([0.55, 0.52, 0.6])
        ambient, clouds = ambient * rng.uniform(0.9, 1.4), glow * rng.uniform(0.5, 0.9)
        return Sky(sun, zenith, glow, ambient, clouds, rng.uniform(0.2, 0.9), float(np.deg2rad(rng.uniform(3, 12))))
    dark = np.array([0.42, 0.46, 0.52]) * rng.uniform(0.6, 1.2)  # before a storm
    horizon, ambient = dark * rng.uniform(1.0, 1.8), np.array([0.75, 0.8, 0.9]) * rng.uniform(0.6, 1.0)
    return Sky(plain.sun * 0.05, dark * 0.8, horizon, ambient, dark * 0.7, rng.uniform(0.6, 1.1), plain.elevation)


def light_numbers(config: CityConfig) -> tuple[str, NDArray[np.float64]]:
    """The chosen light and its numbers, in the order of ``LightNumber`` in native/city.cpp."""
    rng = seeds.numpy_rng(config.seed, 0, "city light")
    name = config.light
    pick = rng.choice(["day", "overcast", "dusk"], p=[0.62, 0.24, 0.14])
    if name == "auto":
        name = str(pick)
    azimuth = rng.uniform(0, 2 * np.pi)
    tint = rng.uniform(0.96, 1.04, 3)
    if name == "night":
        elevation = 1.0
        sun = np.zeros(3)
        zenith, horizon = np.array([0.006, 0.006, 0.0072]), np.array([0.039, 0.0306, 0.0252])
        ambient, cloud = np.array([0.0096, 0.0102, 0.012]), np.array([0.02, 0.02, 0.02])
        cloudiness, haze, night, exposure = rng.uniform(0.0, 0.6), rng.uniform(600, 1600), 1.0, rng.uniform(0.9, 1.3)
    elif name == "day":
        elevation = np.deg2rad(rng.uniform(18, 62))
        sun = np.array([3.3, 3.05, 2.65]) * rng.uniform(0.85, 1.15)
        zenith, horizon = np.array([0.20, 0.40, 0.86]) * rng.uniform(0.8, 1.1), np.array([0.66, 0.80, 0.98])
        ambient, cloud = np.array([0.78, 0.88, 1.06]) * rng.uniform(0.85, 1.15), np.array([1.25, 1.25, 1.27])
        cloudiness, haze, night, exposure = rng.uniform(0.0, 0.95), rng.uniform(400, 1600), 0.0, rng.uniform(0.50, 0.72)
    elif name == "overcast":
        elevation = np.deg2rad(rng.uniform(30, 60))
        sun = np.array([0.30, 0.30, 0.30]) * rng.uniform(0.0, 1.0)
        zenith, horizon = np.array([0.80, 0.84, 0.92]) * rng.uniform(0.8, 1.1), np.array([1.02, 1.04, 1.08])
        ambient, cloud = np.array([1.0, 1.03, 1.1]) * rng.uniform(0.9, 1.1), np.array([0.86, 0.87, 0.90])
        cloudiness, haze, night, exposure = rng.uniform(0.6, 1.1), rng.uniform(350, 1400), 0.05, rng.uniform(0.75, 1.0)
    else:
        elevation = np.deg2rad(rng.uniform(3.0, 9.0))
        azimuth = rng.uniform(0.35, 2 * np.pi - 0.35)
        sun = np.array([2.6, 1.45, 0.68]) * rng.uniform(0.5, 1.1)
        zenith, horizon = np.array([0.20, 0.27, 0.50]) * rng.uniform(0.8, 1.2), np.array([1.05, 0.68, 0.45])
        ambient, cloud = np.array([0.40, 0.42, 0.56]) * rng.uniform(0.85, 1.2), np.array([0.86, 0.58, 0.50])
        cloudiness, haze, night, exposure = rng.uniform(0.1, 0.8), rng.uniform(250, 900), 0.6, rng.uniform(0.85, 1.25)
    if config.skies == "varied":
        plain = Sky(sun, zenith, horizon, ambient, cloud, cloudiness, float(elevation))
        sky = _other_sky(seeds.numpy_rng(config.seed, 0, "city sky"), plain)
        sun, zenith, horizon, ambient, cloud, cloudiness, elevation = (getattr(sky, name) for name in Sky.__slots__)
    if config.fog_visibility_m > 0:
        haze = config.fog_visibility_m / 3.0
    direction = [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)]
    colors = [*direction, *sun, *zenith, *horizon, *ambient, *cloud, *tint]
    camera = [rng.uniform(0.95, 1.08), rng.uniform(0.85, 1.08), rng.uniform(0.003, 0.009), rng.uniform(0.05, 0.3)]
    return name, np.array([*colors, cloudiness, haze, night, exposure, *camera, 0.0035], np.float64)


# weather: wet ground, snow and street lamps, by the same rules as ``mudg.core.weather`` ------------


def weather_numbers(config: CityConfig) -> NDArray[np.float64] | None:
    """Numbers in the order of ``mudg_city_set_weather`` in native/city_weather.cpp; None in a city that needs none."""
    night = config.light == "night"
    if not (config.wet or config.snow_cover or night):
        return None
    puddles, snow = (noise_seed(config.seed, purpose) for purpose in ("puddles", "snow"))
    snow_level = patch_threshold(config.snow_cover, snow) if config.snow_cover else 2.0
    water, lamps = patch_threshold(config.puddles, puddles), LAMP_POWER if night else 0.0
    return np.array([config.wet, water, puddles, snow_level, snow, lamps])


def lamp_places(rows: Sequence[Sequence[float]]) -> NDArray[np.float64]:
    """World places f64[N, 3] of the lights of all street lamps among the city's records."""
    places = []
    for row in rows:
        if int(row[0]) != rec.LAMP:
            continue
        x, y, z, yaw, height, arm, globe = *row[1:5], row[7], row[15], row[16] > 0.5
        out, up = (0.0, 0.2) if globe else (arm + 0.3, 0.36)
        places.append((x + out * math.cos(yaw), y + out * math.sin(yaw), z + height + up))
    return np.array(places, np.float64).reshape(-1, 3)


# photos --------------------------------------------------------------------------------------------
#
# Photographic surfaces and skies for a city, from a folder of the user's: `textures/*.jpg` or `.png` and `sky/*.hdr`.
#
# A surface's photograph multiplies its drawn colour, so only its variation around its own mean is used. Which surface a
# file is for follows from words in its name (`SURFACES`); files that fit none are not used. Panoramas are Radiance HDR;
# what lies below `HORIZON_DEG` in them (trees, houses) is left out and the rest is stretched down to the horizon. The
# same folder and seed give the same city.

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
    panorama. InputError: no such folder, or a file in it cannot be read."""
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
    """Pixels f32[H, W, 3] of a Radiance HDR file with run-length coded RGBE rows, top row first. InputError: another
    format, or the file is cut off."""
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
