"""KITTI-360 calibration: rectified perspective cameras, fisheye cameras (model of Mei), LiDARs, all on the vehicle.

The data set's vehicle frame is that of the GPS/IMU: x forward, y right, z down. The ego frame here is the same point with y to
the left and z up.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from mudg.base import store
from mudg.base.errors import InputError
from mudg.base.geometry import from_rotation_translation, invert
from mudg.base.types import Camera
from mudg.data.importers.common import rigid_pose, rigid_rotation
from mudg.data.importers.images import ImageFit, brown_conrady, fit_images
from mudg.data.importers.kitti.calib import pinhole_camera, read_number_table, table_entry
from mudg.data.importers.kitti.poses import line_numbers
from mudg.data.importers.options import ImportOptions
from mudg.data.unknown_fields import note_unknown

Matrix = NDArray[np.float64]
IMU_FROM_EGO: Final = np.diag([1.0, -1.0, -1.0, 1.0])
FISHEYES: Final = ("image_02", "image_03")
FISHEYE_VIEW_DEG: Final = 90.0
_FISHEYE_VALUES: Final = (
    "image_width", "image_height", "xi", "k1", "k2", "p1", "p2", "gamma1", "gamma2", "u0", "v0",
)  # fmt: skip
_FISHEYE: Final = frozenset({
    *_FISHEYE_VALUES, "model_type", "camera_name", "mirror_parameters", "distortion_parameters", "projection_parameters",
})  # fmt: skip
"""Entries of the data set's fisheye calibrations."""


@dataclass(frozen=True, slots=True, eq=False)
class Kitti360Calibration:
    """What is fixed on the vehicle.

    Args:
        folder: where it was read.
        ego_from_camera: ``image_00`` .. ``image_03`` -> f64[4, 4]; perspective cameras as rectified.
        ego_from_velo: f64[4, 4].
        velo_from_sick: f64[4, 4], or None if the file is not there.
        imu_from_rect0: the data set's vehicle frame from rectified camera 0, f64[4, 4].
    """

    folder: Path
    ego_from_camera: dict[str, Matrix]
    ego_from_velo: Matrix
    velo_from_sick: Matrix | None
    imu_from_rect0: Matrix

    def fit(self, camera: str, name: str, size: tuple[int, int], options: ImportOptions) -> ImageFit:
        """How images of ``camera`` (``image_02``), of ``size`` (width, height), become images of the scene's ``name``."""
        if camera in FISHEYES:
            return self._fit_fisheye(camera, name, size, options)
        path = self.folder / "perspective.txt"
        table = read_number_table(path)
        projection = table_entry(table, (f"P_rect_{camera[-2:]}",), (3, 4), path)
        declared = table_entry(table, (f"S_rect_{camera[-2:]}",), (2,), path)
        _check_size(size, (int(declared[0]), int(declared[1])), f"{path}: S_rect_{camera[-2:]}")
        return fit_images(pinhole_camera(projection, name, size, f"{path}: P_rect_{camera[-2:]}"), options)

    def _fit_fisheye(self, camera: str, name: str, size: tuple[int, int], options: ImportOptions) -> ImageFit:
        path = self.folder / f"{camera}.yaml"
        values = _read_fisheye(path)
        _check_size(size, (int(values["image_width"]), int(values["image_height"])), f"{path}: image_width")
        xi, bend = values["xi"], tuple(values[key] for key in ("k1", "k2", "p1", "p2"))
        distort = brown_conrady(*bend)

        def lens(xy: Matrix) -> Matrix:
            """Unit sphere, seen from ``xi`` behind its centre, then radial and tangential distortion."""
            length = np.sqrt(1 + (xy**2).sum(1))
            return distort(xy / (1 + xi * length)[:, None])

        recorded = Camera(
            name, *size, values["gamma1"], values["gamma2"], values["u0"] + 0.5, values["v0"] + 0.5, (xi, *bend)
        )  # fmt: skip
        # the focal length at the lens' centre, so that nothing is lost or made up there
        focal = values["gamma1"] / (1 + xi)
        side = max(16, round(2 * focal * np.tan(np.deg2rad(FISHEYE_VIEW_DEG / 2))))
        target = replace(recorded, width=side, height=side, fx=focal, fy=focal, cx=side / 2, cy=side / 2)
        return fit_images(recorded, options, lens, target)


def read_calibration(folder: Path) -> Kitti360Calibration:
    """Read ``calibration/``.

    Raises:
        InputError: a file or entry is missing, or a matrix is not a rigid motion.
    """
    path = folder / "calib_cam_to_pose.txt"
    table = read_number_table(path)
    imu_from_camera = {
        name: rigid_pose(table_entry(table, (name,), (3, 4), path), f"{path}: {name}")
        for name in ("image_00", "image_01", "image_02", "image_03")
        if name == "image_00" or name in table
    }
    imu_from_velo = imu_from_camera["image_00"] @ invert(_rigid_file(folder / "calib_cam_to_velo.txt"))
    perspective = folder / "perspective.txt"
    numbers = read_number_table(perspective)
    for name in ("image_00", "image_01"):
        if name in imu_from_camera:
            where = f"{perspective}: R_rect_{name[-2:]}"
            rectify = rigid_rotation(table_entry(numbers, (f"R_rect_{name[-2:]}",), (3, 3), perspective), where)
            imu_from_camera[name] = imu_from_camera[name] @ from_rotation_translation(rectify.T, np.zeros(3))
    sick = folder / "calib_sick_to_velo.txt"
    ego_from_imu = invert(IMU_FROM_EGO)
    return Kitti360Calibration(
        folder,
        {name: ego_from_imu @ pose for name, pose in imu_from_camera.items()},
        ego_from_imu @ imu_from_velo,
        _rigid_file(sick) if sick.is_file() else None,
        imu_from_camera["image_00"],
    )


def _rigid_file(path: Path) -> Matrix:
    numbers = line_numbers(store.read_text(path).replace("\n", " "), (12,), str(path), "calibration")
    return rigid_pose(numbers.reshape(3, 4), str(path))


def _check_size(size: tuple[int, int], declared: tuple[int, int], where: str) -> None:
    if size != declared:
        raise InputError("images do not have the size that the calibration is for", where=where,
            expected=f"{declared[0]}x{declared[1]}", got=f"{size[0]}x{size[1]}",
            remedy="use the images as the data set ships them")  # fmt: skip


def _read_fisheye(path: Path) -> dict[str, float]:
    """The numbers of an OpenCV-style YAML file by their keys; nesting does not matter, keys are distinct."""
    text = store.read_bytes(path).decode("utf-8", "replace")
    model = re.search(r"^\s*model_type\s*:\s*\"?(\w+)", text, re.MULTILINE)
    if model is None or model[1] != "MEI":
        raise InputError("fisheye calibration is of another camera model", where=str(path), expected="model_type: MEI",
            got=model[1] if model else "no model_type")  # fmt: skip
    note_unknown(path.name, re.findall(r"^\s*(\w+)\s*:", text, re.MULTILINE), _FISHEYE)
    found: dict[str, float] = {}
    for key, value in re.findall(r"^\s*(\w+)\s*:\s*([-+.\deE]+)\s*$", text, re.MULTILINE):
        try:
            found[key] = float(value)
        except ValueError as error:
            raise InputError("fisheye calibration holds no number", where=f"{path}: {key}", got=value[:40]) from error
    missing = [key for key in _FISHEYE_VALUES if key not in found]
    if missing:
        raise InputError("fisheye calibration is incomplete", where=str(path), expected=", ".join(_FISHEYE_VALUES),
            got=f"no {', '.join(missing)}", remedy="is the file cut off?")  # fmt: skip
    if found["xi"] < 0 or found["gamma1"] <= 0 or found["gamma2"] <= 0:
        raise InputError("fisheye calibration makes no sense", where=str(path), expected="xi >= 0, gamma1 and gamma2 > 0",
                         got=f"xi={found['xi']:g}, gamma1={found['gamma1']:g}, gamma2={found['gamma2']:g}")  # fmt: skip
    return found
