"""The recorded path as a road: places by arc length and distance to the left, and the ground beside it."""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mudg.base import geometry
from mudg.base.errors import InputError

Matrix = NDArray[np.float64]
LEAST_STEP_M: Final = 0.2
"""Recorded poses nearer to the last one than this add nothing to a road."""


class Road:
    """The path that was recorded, by arc length; height and tilt of the ground beside it are those of the path.

    Args:
        poses: world-from-vehicle f64[N, 4, 4] along it. Beyond its ends the road goes straight on.

    Raises:
        InputError: the poses do not move by a metre.
    """

    def __init__(self, poses: Matrix) -> None:
        chosen = [0]
        for index in range(1, len(poses)):
            if np.linalg.norm(poses[index, :2, 3] - poses[chosen[-1], :2, 3]) >= LEAST_STEP_M:
                chosen.append(index)
        self.poses = poses[chosen]
        steps = np.linalg.norm(np.diff(self.poses[:, :2, 3], axis=0), axis=1)
        self.stations_m = np.concatenate([[0.0], np.cumsum(steps)])
        if self.length_m < 1:
            what = "the recorded vehicle stands, so there is no road to drive on"
            raise InputError(what, expected="at least 1 m of way", got=f"{self.length_m:.2f} m")

    @property
    def length_m(self) -> float:
        """Length of the recorded path."""
        return float(self.stations_m[-1])

    def recorded(self, station_m: float) -> Matrix:
        """Pose f64[4, 4] of the recorded vehicle at an arc length, straight on beyond the ends."""
        inside = min(max(station_m, 0.0), self.length_m)
        index = min(int(np.searchsorted(self.stations_m, inside, "right")) - 1, len(self.stations_m) - 2)
        share = (inside - self.stations_m[index]) / (self.stations_m[index + 1] - self.stations_m[index])
        pose = geometry.interpolate_pose(self.poses[index], self.poses[index + 1], float(share))
        pose[:3, 3] += (station_m - inside) * pose[:3, 0]
        return pose

    def locate(self, xy: ArrayLike) -> tuple[float, float]:
        """Arc length, and metres to the left of the path, of a place."""
        point, path = np.asarray(xy, np.float64)[:2], self.poses[:, :2, 3]
        along = np.diff(path, axis=0)
        lengths = np.linalg.norm(along, axis=1)
        unit = along / lengths[:, None]
        reach = ((point - path[:-1]) * unit).sum(1)
        low, high = np.zeros(len(reach)), lengths.copy()
        low[0], high[-1] = -np.inf, np.inf
        at = np.clip(reach, low, high)
        foot = path[:-1] + at[:, None] * unit
        nearest = int(np.linalg.norm(point - foot, axis=1).argmin())
        off = point - foot[nearest]
        side = unit[nearest, 0] * off[1] - unit[nearest, 1] * off[0]
        return float(self.stations_m[nearest] + at[nearest]), float(math.copysign(np.linalg.norm(off), side))

    def place(self, x_m: float, y_m: float, heading_rad: float) -> Matrix:
        """World-from-vehicle f64[4, 4] of a vehicle on the ground with its origin there."""
        station, _ = self.locate((x_m, y_m))
        recorded = self.recorded(station)
        up = recorded[:3, 2]
        z = recorded[2, 3] - (up[0] * (x_m - recorded[0, 3]) + up[1] * (y_m - recorded[1, 3])) / up[2]
        ahead = np.array([math.cos(heading_rad), math.sin(heading_rad), 0.0])
        ahead[2] = -(up[0] * ahead[0] + up[1] * ahead[1]) / up[2]
        ahead /= np.linalg.norm(ahead)
        axes = np.stack([ahead, np.cross(up, ahead), up], 1)
        return geometry.from_rotation_translation(axes, (x_m, y_m, z))

    def route(self, pose: Matrix, step_m: float = 2.0) -> Matrix:
        """The next 60 m of road ahead of a vehicle f64[N, 3] in its frame."""
        station, _ = self.locate(pose[:2, 3])
        places = np.stack([self.recorded(ahead)[:3, 3] for ahead in station + np.arange(0.0, 60.0, step_m)])
        return geometry.transform_points(geometry.invert(pose), places)
