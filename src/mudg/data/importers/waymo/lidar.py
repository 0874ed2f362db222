"""Range images -> points, and when each column of the top LiDAR was measured.

A range image has a row per beam (the highest first) and a column per step of the turn. Column 0 looks backwards, the middle
column along the vehicle's x axis, and time runs with the columns: the sensor turns clockwise seen from above (the side-left
camera is triggered before the front one, the side-right one after). Azimuth is counter-clockwise in the LiDAR's own frame,
whose x axis may point anywhere; the heading of that frame is taken off.

Source: the message description and the conversion documented with the data set.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from mudg.base.errors import InputError
from mudg.base.types import SweepPoints
from mudg.data.importers.waymo.records import LaserCalibration, LaserScan, Matrix

TURN_S: Final = 0.1
_MIN_MOTION_M: Final = 0.3
_MAX_FIT_ERROR_S: Final = 0.004
_CLOCK_ERROR_S: Final = 0.0025
_MIN_ROWS_SHARE: Final = 0.05


@dataclass(frozen=True, slots=True, eq=False)
class Points:
    """Points of one turn in the LiDAR's frame at the frame's pose, where each came from in the range images, and how many
    were left out because no pose was recorded for their pixel.

    Args:
        xyz: f64[N, 3] metres.
        intensity: f32[N] as recorded, from 0 on without a limit.
        turn: f64[N], part of the turn (0..1) after which the point was measured.
        pixel: i64[N], index into the flattened range image; ``image`` i64[N] says which return.
    """

    xyz: NDArray[np.float64]
    intensity: NDArray[np.float32]
    turn: NDArray[np.float64]
    pixel: NDArray[np.int64]
    image: NDArray[np.int64]
    without_pose: int


def points_of_scan(scan: LaserScan, laser: LaserCalibration, global_from_vehicle: Matrix, where: str) -> Points:
    """All points of a scan, first returns and then second ones.

    Where pixels have poses of their own (top LiDAR), a point is carried from where the vehicle was when it was measured to
    where the vehicle was at the frame's pose. The other LiDARs are recorded as if all was measured at the frame's pose.

    Raises:
        InputError: shapes that contradict each other, or values that are not finite.
    """
    shape = scan.returns[0].shape[:2]
    if any(image.shape[:2] != shape for image in (*scan.returns, *scan.projections)) or (
        scan.poses is not None and scan.poses.shape[:2] != shape
    ):
        raise InputError("range images of one scan differ in size", where=where, expected=str(list(shape)))
    rows, columns = shape
    inclination = laser.beam_inclinations(rows, where)
    turn = (np.arange(columns) + 0.5) / columns
    azimuth = np.pi - 2 * np.pi * turn - heading_of(laser)
    parts: list[tuple[NDArray, ...]] = []
    without_pose = 0
    for index, image in enumerate(scan.returns):
        pixel = np.flatnonzero(image[..., 0].reshape(-1) > 0)
        values = image.reshape(-1, image.shape[2])[pixel, :2]
        if not np.isfinite(values).all():
            raise InputError(
                "range image holds values that are not finite", where=f"{where}: return {index + 1}",
                got=f"{int((~np.isfinite(values).all(1)).sum())} of {len(values)} points",
            )  # fmt: skip
        row, column = np.divmod(pixel, columns)
        reach = values[:, 0].astype(np.float64)
        flat = reach * np.cos(inclination)[row]
        xyz = np.stack(
            [flat * np.cos(azimuth)[column], flat * np.sin(azimuth)[column], reach * np.sin(inclination)[row]], 1
        )
        if scan.poses is not None:
            poses = scan.poses.reshape(-1, 6)[pixel]
            known = np.isfinite(poses).all(1) & (poses != 0).any(1)
            without_pose += int((~known).sum())
            pixel, values, column, xyz, poses = pixel[known], values[known], column[known], xyz[known], poses[known]
            xyz = _carried(xyz, poses.astype(np.float64), laser.vehicle_from_lidar, global_from_vehicle)
        parts.append((xyz, values[:, 1], turn[column], pixel, np.full(len(pixel), index)))
    xyz, intensity, turns, pixels, images = (np.concatenate(column) for column in zip(*parts, strict=True))
    return Points(xyz, intensity, turns, pixels, images, without_pose)


def heading_of(laser: LaserCalibration) -> float:
    """Angle of the LiDAR's x axis in the vehicle, radians counter-clockwise from forward."""
    return float(np.arctan2(laser.vehicle_from_lidar[1, 0], laser.vehicle_from_lidar[0, 0]))


def turn_of_direction(xyz_vehicle: NDArray[np.float64], laser: LaserCalibration) -> NDArray[np.float64]:
    """Part of the turn (0..1) at which the LiDAR looks towards points f64[N, 3] of the vehicle frame."""
    offset = xyz_vehicle[:, :2] - laser.vehicle_from_lidar[:2, 3]
    return (0.5 - np.arctan2(offset[:, 1], offset[:, 0]) / (2 * np.pi)) % 1.0


def _carried(
    xyz: NDArray[np.float64], poses: NDArray[np.float64], vehicle_from_lidar: Matrix, global_from_vehicle: Matrix
) -> NDArray[np.float64]:
    """Points of the LiDAR's frame, each with the pose (roll, pitch, yaw, x, y, z) of its moment, to the frame's moment.

    Rotations are about z, then y, then x of the vehicle. Positions are taken relative to the frame's pose first: they are
    tens of kilometres, and their differences centimetres.
    """
    x, y, z = (xyz @ vehicle_from_lidar[:3, :3].T + vehicle_from_lidar[:3, 3]).T
    (cr, cp, cy), (sr, sp, sy) = np.cos(poses[:, :3].T), np.sin(poses[:, :3].T)
    y, z = cr * y - sr * z, sr * y + cr * z
    x, z = cp * x + sp * z, cp * z - sp * x
    x, y = cy * x - sy * y, sy * x + cy * y
    moved = np.stack([x, y, z], 1) + (poses[:, 3:] - global_from_vehicle[:3, 3])
    in_vehicle = moved @ global_from_vehicle[:3, :3]
    return (in_vehicle - vehicle_from_lidar[:3, 3]) @ vehicle_from_lidar[:3, :3]


def sweep_points(points: Points, dt_s: NDArray[np.float64]) -> SweepPoints:
    """Points as a sweep holds them. Intensity has no limit in the data set; tanh, as is customary, brings it to 0..1."""
    intensity = np.tanh(np.maximum(points.intensity.astype(np.float64), 0))
    return SweepPoints(points.xyz.astype(np.float32), intensity.astype(np.float32), dt_s.astype(np.float32))


# --- time -----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class TurnClock:
    """When the columns of the top LiDAR are measured: ``start_s`` after the frame's timestamp the turn begins, and lasts
    ``duration_s``. ``measured``: found by comparing pixel poses with the vehicle's path; else the nominal turn."""

    start_s: float = 0.0
    duration_s: float = TURN_S
    measured: bool = False

    def after_timestamp_s(self, turn: NDArray[np.float64]) -> NDArray[np.float64]:
        """Seconds after the frame's timestamp for parts of the turn (0..1)."""
        return self.start_s + turn * self.duration_s


def measure_turn(
    poses: NDArray[np.float32], timestamp_s: float, path_times_s: NDArray[np.float64], path_xyz: NDArray[np.float64]
) -> tuple[float, float] | None:
    """Start (after the timestamp) and duration of a turn from where the vehicle was when each column was measured.

    Args:
        poses: f32[H, W, 6], pixel poses of the frame.
        timestamp_s: of the frame.
        path_times_s, path_xyz: f64[T], f64[T, 3]: places of the vehicle at known times around the frame, in time order.

    Returns:
        Seconds, or None where the vehicle moves too little, or its path does not explain the columns.
    """
    known = (poses != 0).any(2) & np.isfinite(poses).all(2)
    columns = np.flatnonzero(known.sum(0) >= max(1, _MIN_ROWS_SHARE * len(known)))
    if len(columns) < 10 or len(path_times_s) < 3:
        return None
    places = np.stack([poses[known[:, c], c, 3:].astype(np.float64).mean(0) for c in columns])
    direction = path_xyz[-1] - path_xyz[0]
    length = float(np.linalg.norm(direction))
    if length < _MIN_MOTION_M:
        return None
    direction /= length
    along_path = (path_xyz - path_xyz[0]) @ direction
    along = (places - path_xyz[0]) @ direction
    inside = (along >= along_path[0]) & (along <= along_path[-1])
    if (np.diff(along_path) <= 0).any() or np.ptp(along) < _MIN_MOTION_M or inside.sum() < 10:
        return None
    times = np.interp(along[inside], along_path, path_times_s) - timestamp_s
    turn = (columns[inside] + 0.5) / poses.shape[1]
    duration, start = np.polyfit(turn, times, 1)
    error = float(np.sqrt(np.mean((start + duration * turn - times) ** 2)))
    if error > _MAX_FIT_ERROR_S or not 0.5 * TURN_S < abs(duration) < 2 * TURN_S:
        return None
    return float(start), float(duration)


def median_clock(turns: Sequence[tuple[float, float]]) -> TurnClock:
    """The clock of a log from the turns that could be measured.

    Where they agree with the nominal turn within what the measurement can tell, and without any, it is the nominal one.
    """
    if not turns:
        return TurnClock()
    start, duration = (float(value) for value in np.median(np.array(turns), axis=0))
    if max(abs(start), abs(start + duration - TURN_S)) <= _CLOCK_ERROR_S:
        return TurnClock()
    return TurnClock(start, duration, True)
