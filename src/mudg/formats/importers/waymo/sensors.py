"""Waymo sensors: range images as points, when the top LiDAR's columns were measured, where a view is, and panoptic
classes.

A range image has a row per beam (the highest first) and a column per step of the turn. Column 0 looks backwards, the
middle column along the vehicle's x axis, and time runs with the columns: the sensor turns clockwise seen from above
(the side-left camera is triggered before the front one, the side-right one after). Azimuth is counter-clockwise in the
LiDAR's own frame, whose x axis may point anywhere; the heading of that frame is taken off.

The cameras' shutters roll from left to right within some 45 ms; scenes know one pose per image. That pose is the
vehicle's at the moment the middle column was exposed: the recorded one, up to a few milliseconds older or newer,
carried on with the recorded velocity.

Source: the message description and the conversion documented with the data set.
"""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from PIL import Image, UnidentifiedImageError
from scipy.spatial.transform import Rotation

from mudg.base.errors import InputError
from mudg.base.geometry import CAM_FROM_EGO_AXES, invert, transform_points
from mudg.base.palette import ID, UNLABELLED
from mudg.base.types import Camera, SweepPoints
from mudg.formats.importers.images import Lens, brown_conrady
from mudg.formats.importers.waymo import records
from mudg.formats.importers.waymo.records import CameraCalibration, LaserCalibration, Matrix

TURN_S: Final = 0.1
_MIN_MOTION_M: Final = 0.3
_MAX_FIT_ERROR_S: Final = 0.004
_CLOCK_ERROR_S: Final = 0.0025
_MIN_ROWS_SHARE: Final = 0.05
MAX_POSE_SHIFT_S: Final = 0.05
DIRECTIONS: Final = ("in an unknown direction", "downwards", "left to right", "upwards", "right to left", "not at all")
"""How a camera reads its image, by the data set's number."""

GLOBAL_SHUTTER: Final = 5
EGO_CLASS: Final = 1
SKY_CLASS: Final = 25
TRAIN_IDS: Final[Mapping[int, int]] = {
    2: ID["car"],
    3: ID["truck"],
    4: ID["bus"],
    5: ID["truck"],
    6: ID["bicycle"],
    7: ID["motorcycle"],
    9: ID["person"],
    10: ID["rider"],
    11: ID["rider"],
    15: ID["pole"],
    17: ID["traffic sign"],
    18: ID["traffic light"],
    19: ID["building"],
    20: ID["road"],
    21: ID["road"],
    22: ID["road"],
    23: ID["sidewalk"],
    24: ID["vegetation"],
    25: ID["sky"],
}
"""Class of a camera segmentation label -> train id. A cyclist is labelled together with the bicycle; other large
vehicles count as trucks. Without a counterpart, so unlabelled: undefined, own vehicle, trailer, bird, animal, cone,
carried object, other ground, other things."""


# --- range images ---------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, eq=False)
class ScanPoints:
    """Points of one turn in the LiDAR's frame at the frame's pose, where each came from in the range images, and how
    many were left out because no pose was recorded for their pixel.

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


def points_of_scan(
    scan: records.LaserScan, laser: LaserCalibration, global_from_vehicle: Matrix, where: str
) -> ScanPoints:
    """All points of a scan, first returns and then second ones.

    Where pixels have poses of their own (top LiDAR), a point is carried from where the vehicle was when it was measured
    to where the vehicle was at the frame's pose. The other LiDARs are recorded as if all was measured at the frame's
    pose. Raises InputError: shapes that contradict each other, or values that are not finite."""
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
            what = "range image holds values that are not finite"
            got = f"{int((~np.isfinite(values).all(1)).sum())} of {len(values)} points"
            raise InputError(what, where=f"{where}: return {index + 1}", got=got)
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
    return ScanPoints(xyz, intensity, turns, pixels, images, without_pose)


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

    Rotations are about z, then y, then x of the vehicle. Positions are taken relative to the frame's pose first: they
    are tens of kilometres, and their differences centimetres.
    """
    x, y, z = (xyz @ vehicle_from_lidar[:3, :3].T + vehicle_from_lidar[:3, 3]).T
    (cr, cp, cy), (sr, sp, sy) = np.cos(poses[:, :3].T), np.sin(poses[:, :3].T)
    y, z = cr * y - sr * z, sr * y + cr * z
    x, z = cp * x + sp * z, cp * z - sp * x
    x, y = cy * x - sy * y, sy * x + cy * y
    moved = np.stack([x, y, z], 1) + (poses[:, 3:] - global_from_vehicle[:3, 3])
    in_vehicle = moved @ global_from_vehicle[:3, :3]
    return (in_vehicle - vehicle_from_lidar[:3, 3]) @ vehicle_from_lidar[:3, :3]


def sweep_points(points: ScanPoints, dt_s: NDArray[np.float64]) -> SweepPoints:
    """Points as a sweep holds them. Intensity has no limit in the data set; tanh, as is customary, brings it to
    0..1."""
    intensity = np.tanh(np.maximum(points.intensity.astype(np.float64), 0))
    return SweepPoints(points.xyz.astype(np.float32), intensity.astype(np.float32), dt_s.astype(np.float32))


# --- time -----------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class TurnClock:
    """When the columns of the top LiDAR are measured: ``start_s`` after the frame's timestamp the turn begins, and
    lasts ``duration_s``. ``measured``: found by comparing pixel poses with the vehicle's path; else the nominal
    turn."""

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


# --- cameras --------------------------------------------------------------------------------------


def recorded_camera(calibration: CameraCalibration, shot: records.CameraShot) -> tuple[Camera, Lens | None]:
    """The camera as recorded, and its lens (None where the coefficients are all zero)."""
    fx, fy, cx, cy, *coefficients = calibration.intrinsic
    camera = Camera(
        calibration.name,
        calibration.width,
        calibration.height,
        fx,
        fy,
        cx,
        cy,
        tuple(coefficients),
        0.0 if calibration.direction == GLOBAL_SHUTTER else readout_s(shot),
    )
    return camera, brown_conrady(*coefficients) if any(coefficients) else None


def readout_s(shot: records.CameraShot) -> float:
    """Time between the exposure of the first column and of the last one."""
    return max(0.0, shot.done_s - shot.trigger_s - shot.shutter_s) if shot.done_s else 0.0


def middle_of_exposure(shot: records.CameraShot) -> tuple[Matrix, float]:
    """Vehicle pose f64[4, 4] in the global frame when the middle column was exposed, and this time in seconds of the
    epoch.

    Without recorded exposure times or velocity, or where the two are far apart, pose and time are those recorded.
    """
    middle = (shot.trigger_s + shot.done_s) / 2 if shot.done_s else shot.pose_time_s
    late = middle - shot.pose_time_s
    if shot.velocity is None or not shot.done_s or abs(late) > MAX_POSE_SHIFT_S:
        return shot.global_from_vehicle, shot.pose_time_s
    pose = shot.global_from_vehicle.copy()
    pose[:3, :3] = Rotation.from_rotvec(shot.velocity[3:] * late).as_matrix() @ pose[:3, :3]
    pose[:3, 3] += shot.velocity[:3] * late
    return pose, middle


def vehicle_from_cam(calibration: CameraCalibration) -> Matrix:
    """Camera axes of this package (x right, y down, z forward) to the vehicle, f64[4, 4]."""
    return calibration.vehicle_from_camera @ CAM_FROM_EGO_AXES.T


def panoptic_ids(label: records.Panoptic, camera: Camera, where: str) -> NDArray[np.int32]:
    """Values of a panoptic label, i32[H, W]: class * divisor + instance. Raises InputError: no 16-bit PNG of the
    camera's size, or no divisor."""
    if label.divisor < 1:
        what = "panoptic label has no divisor"
        raise InputError(what, where=where, expected="a positive number", got=str(label.divisor))
    try:
        with Image.open(io.BytesIO(label.png), formats=("PNG",)) as image:
            if image.size != (camera.width, camera.height) or not image.mode.startswith("I"):
                what = "panoptic label is not a 16-bit image of its camera's size"
                got = f"{image.width}x{image.height}, mode {image.mode}"
                raise InputError(what, where=where, expected=f"{camera.width}x{camera.height}, 16 bits", got=got)
            return np.array(image).astype(np.int32)
    except (UnidentifiedImageError, Image.DecompressionBombError, OSError, SyntaxError, ValueError) as error:
        raise InputError("panoptic label cannot be decoded (is it cut off?)", where=where, got=str(error)) from error


def panoptic_labels(ids: NDArray[np.int32], divisor: int) -> dict[str, NDArray[Any]]:
    """Labels of one image: ``semantics`` u8[H, W] train ids, ``instance`` i32[H, W], ``sky`` and ``ego`` bool[H, W].

    An instance is called class * divisor + number, 0 where there is none: it means the same thing in this one image
    only.
    """
    classes, numbers = np.divmod(ids, divisor)
    table = np.full(256, UNLABELLED, np.uint8)
    table[list(TRAIN_IDS)] = list(TRAIN_IDS.values())
    return {
        "semantics": table[np.clip(classes, 0, 255)],
        "instance": np.where(numbers > 0, ids, 0).astype(np.int32),
        "sky": classes == SKY_CLASS,
        "ego": classes == EGO_CLASS,
    }


def projection_errors(
    points: ScanPoints,
    scan: records.LaserScan,
    laser: LaserCalibration,
    global_from_vehicle: Matrix,
    cameras: Mapping[str, tuple[CameraCalibration, Matrix]],
) -> dict[str, NDArray[np.float64]]:
    """How far our projections of a scan lie from those recorded with it, in pixels of the recorded images.

    The recorded ones follow the rolling shutter, ours hold for the middle column, so while the vehicle moves some
    pixels are normal; wrong calibrations, poses or conversions show as hundreds.

    Args:
        points, scan, laser: a scan with projections, and its points.
        global_from_vehicle: pose that the points are given for.
        cameras: name -> calibration and the vehicle's pose in the global frame at the middle of the exposure.

    Returns:
        Camera name -> distances f64[n], for cameras with points.
    """
    xyz_vehicle = transform_points(laser.vehicle_from_lidar, points.xyz)
    errors: dict[str, NDArray[np.float64]] = {}
    for index, projections in enumerate(scan.projections):
        chosen = points.image == index
        recorded = projections.reshape(-1, 6)[points.pixel[chosen]]
        for half in (recorded[:, :3], recorded[:, 3:]):
            for number, name in records.CAMERAS.items():
                if name not in cameras or not (here := half[:, 0] == number).any():
                    continue
                calibration, pose = cameras[name]
                cam_from_vehicle = invert(pose @ vehicle_from_cam(calibration)) @ global_from_vehicle
                uv = _recorded_pixels(calibration, transform_points(cam_from_vehicle, xyz_vehicle[chosen][here]))
                off = np.linalg.norm(uv - (half[here, 1:] + 0.5), axis=1)
                errors[name] = np.concatenate([errors.get(name, np.zeros(0)), off])
    return errors


def _recorded_pixels(calibration: CameraCalibration, xyz_cam: NDArray[np.float64]) -> NDArray[np.float64]:
    """Pixels f64[N, 2] of the recorded (distorted) image; infinite behind the camera."""
    fx, fy, cx, cy, *coefficients = calibration.intrinsic
    z = np.where(xyz_cam[:, 2:] > 0.1, xyz_cam[:, 2:], np.nan)
    uv = brown_conrady(*coefficients)(xyz_cam[:, :2] / z) * [fx, fy] + [cx, cy]
    return np.where(np.isfinite(uv), uv, np.inf)
