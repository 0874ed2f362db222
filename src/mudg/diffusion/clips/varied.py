"""The training distribution that resembles recorded logs: what every generated city and its sensors are drawn from.

One home for it: `draw_city` and `draw_sensors` give, as pure functions of (seed, city number), the generator's
configuration and the faults of the sensors. Default cities (`realism="plain"`) and cities for scoring know nothing of
this.

Cameras have horizontal fields of view of 30 to 120 degrees and five aspect ratios from 4:3 to 3.4:1 (by city number,
all of about the same area). LiDARs are of the kinds that public datasets use, 16 to 128 beams; most see nothing of the
upper third of the image.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Final

import numpy as np

from mudg.base import seeds
from mudg.city.config import CityConfig
from mudg.city.sensors import BoxFaults, CameraFaults, CameraLook, LidarFaults, LidarMount, PoseFaults, SensorFaults

ASPECTS: Final = (1.5, 4 / 3, 16 / 9, 2.4, 3.4)
"""Width over height of the images; city number n has the n-th, counted round."""

LIDARS: Final = (
    (64, -24.8, 2.0),
    (64, -17.6, 2.4),
    (64, -25.0, 15.0),
    (32, -30.0, 10.0),
    (40, -25.0, 7.0),
    (16, -15.0, 15.0),
    (128, -25.0, 15.0),
    (32, -16.0, 8.0),
)
"""Beams and elevation range, degrees."""
LIDAR_SHARES: Final = (0.3, 0.18, 0.12, 0.12, 0.08, 0.06, 0.06, 0.08)


SIDE_CAMERAS: Final = 0.35
"""Share of the cities with two cameras beside the front one."""

MARGIN_M: Final = 4.2
"""Largest lateral shift of a clip, metres. Nearly half of the cities have less, so that lorries may stand right beside
the camera; their clips are shifted by as much less."""


def aspect_of(city: int) -> float:
    """Width over height of a city's images."""
    return ASPECTS[city % len(ASPECTS)]


def sized(width: int, height: int, city: int, multiple: int = 16) -> tuple[int, int]:
    """Size of a city's images: the area of width x height at the city's aspect, in multiples of a number of pixels."""
    aspect = aspect_of(city)
    rows = max(1, round(math.sqrt(width * height / aspect) / multiple))
    columns = max(1, round(rows * aspect))
    return columns * multiple, rows * multiple


def draw_city(
    seed: int, city: int, plain: CityConfig, textures: str = "", side_cameras: float = SIDE_CAMERAS
) -> CityConfig:
    """Configuration of a training city.

    Args:
        seed, city: fix everything.
        plain: seed, length and image size; the rest is drawn here.
        textures: folder of photographs for `CityConfig.textures`; four fifths of the cities use it.
        side_cameras: share of the cities with two cameras beside the front one.
    """
    rng = seeds.numpy_rng(seed, city, "varied city")
    beams, lower, upper = LIDARS[int(rng.choice(len(LIDARS), p=LIDAR_SHARES))]
    beside = rng.random() < side_cameras
    return replace(
        plain,
        rate_hz=float(rng.choice([10.0, 10.0, 10.0, 6.0, 12.0])),
        cameras=("front", "front_left", "front_right") if beside else ("front",),
        hfov_deg=float(rng.choice([rng.uniform(42, 55), rng.uniform(50, 85), rng.uniform(80, 108)], p=[0.2, 0.5, 0.3])),
        rig_variation=1.0,
        lidar_beams=beams,
        lidar_lower_deg=float(lower + rng.uniform(-1, 2)),
        lidar_upper_deg=float(upper + rng.uniform(-1.5, 1)),
        lidar_azimuth_step_deg=float(rng.choice([0.18, 0.2, 0.35]) if beams < 128 else 0.35),
        lidar_range_m=float(rng.choice([60.0, 80.0, 120.0])),
        lidar_noise_m=float(rng.uniform(0.01, 0.04)),
        lidar_dropout=float(rng.uniform(0.02, 0.2)),
        traffic=float(rng.uniform(0.3, 1.8)),
        shift_margin_m=MARGIN_M if rng.random() < 0.55 else float(rng.uniform(1.2, 3.2)),
        overhead=float(rng.choice([0.0, rng.uniform(0.25, 1.0)], p=[0.12, 0.88])),
        skies="varied" if rng.random() < 0.85 else "plain",
        textures=textures if rng.random() < 0.8 else "",
    )


def draw_sensors(seed: int, city: int, config: CityConfig) -> SensorFaults:
    """Looks and faults of the sensors of a training city."""
    rng = seeds.numpy_rng(seed, city, "varied sensors")
    common = 2.0 ** rng.uniform(-0.6, 0.9)
    vignette = float(rng.random() < 0.5) * rng.uniform(0.05, 0.5)
    contrast = float(rng.choice([1.0, rng.uniform(0.85, 1.1), rng.uniform(1.1, 1.7)], p=[0.3, 0.25, 0.45]))
    looks, cameras = {}, {}
    faults = _camera_faults(rng, config.width / 384)
    for name in config.cameras:
        white = np.exp(rng.normal(0, 0.06, 3))
        red, green, blue = (float(v) for v in white / white.mean())
        drifts = rng.random() < 0.6
        looks[name] = CameraLook(
            gain=float(common * 2.0 ** rng.normal(0, 0.18)),
            white=(red, green, blue),
            drift_stops=float(drifts * rng.uniform(0, 0.3)),
            drift_white=float(drifts * rng.uniform(0, 0.05)),
            drift_period_s=float(rng.uniform(1.0, 5.0)),
            drift_phase_rad=float(rng.uniform(0, 6.28)),
            vignette=float(vignette),
            contrast=contrast,
        )
        cameras[name] = faults
    second = None
    if rng.random() < 0.2:
        second = LidarMount(
            (float(rng.uniform(0.5, 2.0)), float(rng.uniform(-0.9, 0.9)), float(rng.uniform(0.8, 2.0))),
            int(rng.choice([16, 32])),
            -20.0,
            float(rng.choice([2.0, 15.0])),
        )
    return SensorFaults(looks, cameras, _lidar_faults(rng), _pose_faults(rng), _box_faults(rng), second)


def _camera_faults(rng: np.random.Generator, scale: float) -> CameraFaults:
    """``scale``: blur in pixels grows with the size of the image."""
    chance = lambda share, value: float(value) if rng.random() < share else 0.0  # noqa: E731
    return CameraFaults(
        noise=float(rng.choice([rng.uniform(0.002, 0.01), rng.uniform(0.01, 0.035)], p=[0.65, 0.35])),
        grain_px=float(rng.uniform(0, 0.9)),
        defocus_px=chance(0.6, rng.uniform(0.2, 1.3) * scale),
        motion_px=chance(0.25, rng.uniform(0.5, 3.0) * scale),
        motion_rad=float(rng.normal(0, 0.3)),
        bloom=chance(0.5, rng.uniform(0.02, 0.25)),
        bloom_px=float(rng.uniform(2, 10) * scale),
        veil=chance(0.25, rng.uniform(0.02, 0.2)),
        jpeg_quality=int(chance(0.6, rng.integers(40, 96))),
        readout_s=chance(0.35, rng.uniform(0.005, 0.035)),
    )


def _lidar_faults(rng: np.random.Generator) -> LidarFaults:
    axis, turn = rng.standard_normal(3), float(rng.random() < 0.65) * rng.uniform(0, 0.5)
    along, shift = rng.standard_normal(3), float(rng.random() < 0.65) * rng.uniform(0, 0.03)
    turns, shifts = axis / np.linalg.norm(axis) * turn, along / np.linalg.norm(along) * shift
    return LidarFaults(
        (float(turns[0]), float(turns[1]), float(turns[2])),
        (float(shifts[0]), float(shifts[1]), float(shifts[2])),
        delay_s=float((rng.random() < 0.4) * rng.uniform(-0.025, 0.025)),
        cut_deg=float(rng.uniform(30, 100)) if rng.random() < 0.2 else 180.0,
        hole_share=float((rng.random() < 0.15) * rng.uniform(0.02, 0.15)),
        dropout=float((rng.random() < 0.3) * rng.uniform(0.05, 0.5)),
    )


def _pose_faults(rng: np.random.Generator) -> PoseFaults:
    has = [float(rng.random() < 0.6) for _ in range(2)]
    return PoseFaults(
        float(has[0] * rng.uniform(0, 0.03)),
        float(has[0] * rng.uniform(0, 0.08)),
        float(has[1] * rng.uniform(0, 0.05)),
        float(has[1] * rng.uniform(0, 0.15)),
    )


def _box_faults(rng: np.random.Generator) -> BoxFaults:
    if rng.random() < 0.25:
        return BoxFaults()
    return BoxFaults(float(rng.uniform(0, 0.15)), float(rng.uniform(0, 2.0)), float(rng.uniform(0, 0.07)))
