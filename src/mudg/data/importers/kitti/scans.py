"""KITTI velodyne scans: reading, and how the sensor turns while the vehicle drives.

The sensor turns counter-clockwise in 0.1 s and faces forward at the scan's time, so a point at azimuth a was measured a / 2 pi
turns later.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from mudg.base.geometry import invert
from mudg.base.types import SweepPoints
from mudg.data.importers.clouds import read_float_rows
from mudg.data.importers.common import blend_motion

Matrix = NDArray[np.float64]
SENSOR: Final = "velodyne"
TURN_PERIOD_S: Final = 0.1
_TURN_STEPS: Final = 36


def read_scan(path: Path) -> SweepPoints:
    """A velodyne scan: float32 rows x, y, z, reflectance (0..1). Beams without a return are left out and counted.

    Raises:
        InputError: cut off, or values that are not finite.
    """
    rows, returns = read_float_rows(path, 4)
    rows = rows[returns]
    dt_s = np.zeros(len(rows), np.float32)
    no_returns = int((~returns).sum())
    return SweepPoints(np.ascontiguousarray(rows[:, :3]), np.clip(rows[:, 3], 0, 1), dt_s, no_returns=no_returns)


def azimuth_delay_s(azimuth_rad: float | NDArray[np.floating]) -> float | NDArray[np.floating]:
    """When the sensor looks to ``azimuth_rad`` (counter-clockwise from forward, -pi..pi), seconds after looking forward."""
    return azimuth_rad / (2 * np.pi) * TURN_PERIOD_S


def untwist_scan(points: SweepPoints, velo_at: Callable[[float], Matrix], time_s: float) -> SweepPoints:
    """Bring the points of a turning sensor to one moment; see the module text for the timing.

    Args:
        points: as measured.
        velo_at: world-from-velodyne f64[4, 4] at a time; asked at 37 moments of the turn, points in between are blended.
        time_s: the scan's time.

    Returns:
        Points in the sensor's frame at ``time_s``, with the seconds after it at which they were measured.
    """
    azimuth = np.arctan2(points.xyz[:, 1], points.xyz[:, 0])
    dt_s = np.asarray(azimuth_delay_s(azimuth), np.float32)
    velo_from_world = invert(velo_at(time_s))
    moments_s = np.linspace(-0.5, 0.5, _TURN_STEPS + 1) * TURN_PERIOD_S
    corrections = [velo_from_world @ velo_at(time_s + float(moment)) for moment in moments_s]
    place = (dt_s / TURN_PERIOD_S + 0.5) * _TURN_STEPS
    return replace(points, xyz=blend_motion(points.xyz, corrections, place), dt_s=dt_s)
