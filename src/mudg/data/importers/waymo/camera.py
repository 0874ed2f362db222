"""Waymo cameras: where a view is, what its lens does, and which classes its panoptic labels hold.

The shutters roll from left to right within some 45 ms; scenes know one pose per image. That pose is the vehicle's at the
moment the middle column was exposed: the recorded one, up to a few milliseconds older or newer, carried on with the recorded
velocity.
"""

from __future__ import annotations

import io
from collections.abc import Mapping
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from PIL import Image, UnidentifiedImageError
from scipy.spatial.transform import Rotation

from mudg.base.errors import InputError
from mudg.base.geometry import CAM_FROM_EGO_AXES, invert, transform_points
from mudg.base.palette import ID, UNLABELLED
from mudg.base.types import Camera
from mudg.data.importers.images import Lens, brown_conrady
from mudg.data.importers.waymo.lidar import Points
from mudg.data.importers.waymo.records import (
    CAMERAS,
    CameraCalibration,
    CameraShot,
    LaserCalibration,
    LaserScan,
    Matrix,
    Panoptic,
)

MAX_POSE_SHIFT_S: Final = 0.05
DIRECTIONS: Final = ("in an unknown direction", "downwards", "left to right", "upwards", "right to left", "not at all")
"""How a camera reads its image, by the data set's number."""

GLOBAL_SHUTTER: Final = 5
EGO_CLASS: Final = 1
SKY_CLASS: Final = 25
TRAIN_IDS: Final[Mapping[int, int]] = {
    2: ID["car"], 3: ID["truck"], 4: ID["bus"], 5: ID["truck"], 6: ID["bicycle"], 7: ID["motorcycle"], 9: ID["person"],
    10: ID["rider"], 11: ID["rider"], 15: ID["pole"], 17: ID["traffic sign"], 18: ID["traffic light"], 19: ID["building"],
    20: ID["road"], 21: ID["road"], 22: ID["road"], 23: ID["sidewalk"], 24: ID["vegetation"], 25: ID["sky"],
}  # fmt: skip
"""Class of a camera segmentation label -> train id. A cyclist is labelled together with the bicycle; other large vehicles count as
trucks. Without a counterpart, so unlabelled: undefined, own vehicle, trailer, bird, animal, cone, carried object, other ground,
other things."""


def recorded_camera(calibration: CameraCalibration, shot: CameraShot) -> tuple[Camera, Lens | None]:
    """The camera as recorded, and its lens (None where the coefficients are all zero)."""
    fx, fy, cx, cy, *coefficients = calibration.intrinsic
    camera = Camera(
        calibration.name, calibration.width, calibration.height, fx, fy, cx, cy, tuple(coefficients),
        0.0 if calibration.direction == GLOBAL_SHUTTER else readout_s(shot),
    )  # fmt: skip
    return camera, brown_conrady(*coefficients) if any(coefficients) else None


def readout_s(shot: CameraShot) -> float:
    """Time between the exposure of the first column and of the last one."""
    return max(0.0, shot.done_s - shot.trigger_s - shot.shutter_s) if shot.done_s else 0.0


def middle_of_exposure(shot: CameraShot) -> tuple[Matrix, float]:
    """Vehicle pose f64[4, 4] in the global frame when the middle column was exposed, and this time in seconds of the epoch.

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


def panoptic_ids(label: Panoptic, camera: Camera, where: str) -> NDArray[np.int32]:
    """Values of a panoptic label, i32[H, W]: class * divisor + instance.

    Raises:
        InputError: no 16-bit PNG of the camera's size, or no divisor.
    """
    if label.divisor < 1:
        raise InputError(
            "panoptic label has no divisor", where=where, expected="a positive number", got=str(label.divisor)
        )
    try:
        with Image.open(io.BytesIO(label.png), formats=("PNG",)) as image:
            if image.size != (camera.width, camera.height) or not image.mode.startswith("I"):
                raise InputError(
                    "panoptic label is not a 16-bit image of its camera's size", where=where,
                    expected=f"{camera.width}x{camera.height}, 16 bits",
                    got=f"{image.width}x{image.height}, mode {image.mode}",
                )  # fmt: skip
            return np.array(image).astype(np.int32)
    except (UnidentifiedImageError, OSError, SyntaxError, ValueError) as error:
        raise InputError("panoptic label cannot be decoded (is it cut off?)", where=where, got=str(error)) from error


def panoptic_labels(ids: NDArray[np.int32], divisor: int) -> dict[str, NDArray[Any]]:
    """Labels of one image: ``semantics`` u8[H, W] train ids, ``instance`` i32[H, W], ``sky`` and ``ego`` bool[H, W].

    An instance is called class * divisor + number, 0 where there is none: it means the same thing in this one image only.
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
    points: Points,
    scan: LaserScan,
    laser: LaserCalibration,
    global_from_vehicle: Matrix,
    cameras: Mapping[str, tuple[CameraCalibration, Matrix]],
) -> dict[str, NDArray[np.float64]]:
    """How far our projections of a scan lie from those recorded with it, in pixels of the recorded images.

    The recorded ones follow the rolling shutter, ours hold for the middle column, so while the vehicle moves some pixels are
    normal; wrong calibrations, poses or conversions show as hundreds.

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
            for number, name in CAMERAS.items():
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
