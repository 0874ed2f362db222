"""nuScenes sensors: cameras from their intrinsics, and ``LIDAR_TOP`` files with the time of every point."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from mudg.base.errors import InputError
from mudg.base.types import Camera, SweepPoints
from mudg.data.importers.clouds import read_float_rows

LICENCE: Final = "CC BY-NC-SA 4.0 and the nuScenes terms of use (Motional; attribution, non-commercial, share-alike)"
CAMERAS: Final[Mapping[str, str]] = {
    "CAM_FRONT": "front", "CAM_FRONT_LEFT": "front_left", "CAM_FRONT_RIGHT": "front_right", "CAM_BACK": "back",
    "CAM_BACK_LEFT": "back_left", "CAM_BACK_RIGHT": "back_right",
}  # fmt: skip
SENSOR: Final = "lidar_top"
TURN_PERIOD_S: Final = 0.05
BEAMS: Final = 32
_FIRST_AZIMUTH_RAD: Final = np.deg2rad(-177.0)
"""Where a turn begins, in the LiDAR's axes (x right, y forward)."""
_OWN_VEHICLE_M: Final = ((-1.05, 1.05), (-2.2, 3.1), (-2.2, 0.5))
"""The recording car in the LiDAR's axes: x right, y forward, z up."""


def camera_from_intrinsics(name: str, size: tuple[int, int], intrinsics: Any, where: str) -> Camera:
    """A camera from the release's 3x3 intrinsics, whose pixel centres are whole numbers: half a pixel is added here."""
    try:
        k = np.array(intrinsics, np.float64)
    except (TypeError, ValueError) as error:
        raise InputError("intrinsics are not numbers", where=where, got=str(error)) from error
    off = k[[0, 1, 2, 2, 2], [1, 0, 0, 1, 2]] - [0, 0, 0, 0, 1] if k.shape == (3, 3) else np.array([np.nan])
    if not np.isfinite(k).all() or not (np.abs(off) < 1e-6).all():
        raise InputError("intrinsics are malformed", where=where, expected="[[fx, 0, cx], [0, fy, cy], [0, 0, 1]]",
            got=str(intrinsics)[:120])  # fmt: skip
    return Camera(name, *size, k[0, 0], k[1, 1], k[0, 2] + 0.5, k[1, 2] + 0.5)


def read_scan(path: Path) -> SweepPoints:
    """A ``LIDAR_TOP`` file: float32 rows x, y, z, intensity (0..255), ring; LiDAR axes x right, y forward, z up.

    Returns of the recording vehicle are dropped, and beams without a return, which are counted; intensity becomes 0..1.

    Raises:
        InputError: cut off, not finite, or rings that no 32-beam sensor has.
    """
    rows, returns = read_float_rows(path, 5, "sweep")
    rings = rows[returns, 4]
    if len(rings) and ((rings < 0) | (rings >= BEAMS) | (rings != np.round(rings))).any():
        raise InputError("fifth value of the points is no ring number", where=str(path),
            expected=f"whole numbers 0 to {BEAMS - 1}", got=f"{rings.min():g} to {rings.max():g}",
            remedy="is this a file of another sensor or format?")  # fmt: skip
    dt_s = point_times(rows[:, :3], rows[:, 4])
    own = np.ones(len(rows), bool)
    for axis, (low, high) in enumerate(_OWN_VEHICLE_M):
        own &= (rows[:, axis] > low) & (rows[:, axis] < high)
    chosen = returns & ~own
    xyz, intensity = np.ascontiguousarray(rows[chosen, :3]), (rows[chosen, 3] / 255).clip(0, 1).astype(np.float32)
    return SweepPoints(xyz, intensity, dt_s[chosen], no_returns=int((~returns).sum()))


def point_times(xyz: NDArray[np.float32], rings: NDArray[np.float32]) -> NDArray[np.float32]:
    """When each point was measured, f32[N] seconds relative to the end of the turn (-0.05..0).

    By column where all 32 returns of every column are there in firing order, else by azimuth.
    """
    columns = len(rings) // BEAMS
    if columns > 1 and len(rings) == columns * BEAMS and (rings.reshape(-1, BEAMS) == np.arange(BEAMS)).all():
        fraction = (np.arange(len(rings)) // BEAMS + 1) / columns
    else:
        azimuth = np.arctan2(xyz[:, 1].astype(np.float64), xyz[:, 0].astype(np.float64))
        fraction = np.mod(_FIRST_AZIMUTH_RAD - azimuth, 2 * np.pi) / (2 * np.pi)
    return ((fraction - 1) * TURN_PERIOD_S).astype(np.float32)
