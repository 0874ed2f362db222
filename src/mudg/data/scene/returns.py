"""Beams without a return. Sensors and drivers write them among the points: as (0, 0, 0), as NaN, or with a range of zero.

In a file of points in the sensor's own frame such rows are told by their numbers (``is_return``). Once a format or an importer has moved
points (to the vehicle's frame, to one moment), the zeros lie at the sensor's own place (``at_sensor``), where no real return can be.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from mudg.base.geometry import invert
from mudg.base.types import EgoPath, SweepPoints

LEAST_RANGE_M: Final = 0.05
"""Nearer than this lies the sensor's own housing."""
_MOMENTS: Final = 17
FLOAT32_SPACING_M: Final = 1e-3


def is_return(xyz: NDArray[Any]) -> NDArray[np.bool_]:
    """Rows of coordinates [N, k] that are a return, bool[N]: not all zero, and not all NaN or infinite."""
    return np.any(xyz != 0, axis=1) & np.isfinite(xyz).any(axis=1)


def near_places(xyz: NDArray[Any], places: Iterable[NDArray[np.float64]]) -> NDArray[np.bool_]:
    """Points [N, 3] within 0.05 m of one of some places f64[3], bool[N]."""
    near = np.zeros(len(xyz), bool)
    for place in places:
        near |= ((xyz - place) ** 2).sum(1) < LEAST_RANGE_M**2
    return near


def at_sensor(points: SweepPoints, time_s: float, world_from_lidar: NDArray[np.float64], ego: EgoPath) -> NDArray[np.bool_]:
    """Points within 0.05 m of where the sensor was at the sweep's time or at the point's own, bool[N].

    Args:
        points: in the LiDAR's frame at ``time_s``.
        time_s: of the sweep.
        world_from_lidar: f64[4, 4] at ``time_s``.
        ego: the vehicle, which carries the sensor.
    """
    near = near_places(points.xyz, [np.zeros(3, np.float32)])
    mount = ego.pose_at(time_s)
    if mount is None or not len(points.dt_s) or not points.dt_s.any():
        return near
    first, last = float(ego.times_s[0]), float(ego.times_s[-1])
    moments = np.linspace(float(points.dt_s.min()), float(points.dt_s.max()), _MOMENTS)
    lidar_from_world, ego_from_lidar = invert(world_from_lidar), invert(mount) @ world_from_lidar
    places = np.stack([
        (lidar_from_world @ pose @ ego_from_lidar)[:3, 3] if pose is not None else np.zeros(3)
        for pose in (ego.pose_at(min(max(time_s + float(moment), first), last)) for moment in moments)
    ])  # fmt: skip
    reach = float(np.linalg.norm(places, axis=1).max()) + LEAST_RANGE_M
    close = np.flatnonzero((np.abs(points.xyz) < reach).all(1))  # few: the rest is farther away than the sensor ever was
    place = np.stack([np.interp(points.dt_s[close], moments, places[:, axis]) for axis in range(3)], 1)
    near[close] |= np.linalg.norm(points.xyz[close] - place, axis=1) < LEAST_RANGE_M
    return near


def float32_spacing_m(places: NDArray[Any]) -> float:
    """Distance of neighbouring float32 numbers at the farthest of some finite coordinates, metres."""
    return float(np.spacing(np.float32(np.abs(places).max(initial=0.0))))
