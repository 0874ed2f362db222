"""KITTI calibration text, both forms: the object/tracking/odometry ``calib.txt`` and the three files of a raw-data day.

KITTI counts pixels from the centre of the top-left pixel; this package from its corner. So 0.5 is added to the principal
point here, once.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mudg.base import store
from mudg.base.errors import InputError
from mudg.base.geometry import from_rotation_translation, invert
from mudg.base.types import Camera

Matrix = NDArray[np.float64]
PIXEL_CENTRE_PX = 0.5
_ROTATION_TOLERANCE = 1e-3


@dataclass(frozen=True, slots=True, eq=False)
class KittiCalibration:
    """Calibration of one recording.

    Args:
        projections: camera number -> P f64[3, 4]: pixels from rectified camera 0.
        rect0_from_velo: rectified camera 0 from velodyne, f64[4, 4].
        velo_from_imu: velodyne from IMU, or None if the source does not say.
        source: the files read, for messages.
    """

    projections: dict[int, Matrix]
    rect0_from_velo: Matrix
    velo_from_imu: Matrix | None
    source: str

    def camera(self, number: int, name: str, width: int, height: int) -> Camera:
        """Pinhole intrinsics of the rectified camera ``number``."""
        projection = self._projection(number)
        if abs(projection[0, 1]) > 1e-6 or abs(projection[2, 2] - 1) > 1e-6:
            raise InputError("projection matrix is not of a rectified pinhole camera",
                             where=f"{self.source}: P{number}", expected="no skew, last row 0 0 1",
                             got=str(projection[:, :3].tolist()))  # fmt: skip
        fx, fy = float(projection[0, 0]), float(projection[1, 1])
        if fx <= 0 or fy <= 0:
            raise InputError("focal length is not positive", where=f"{self.source}: P{number}",
                             expected="pixels, about 700 for KITTI", got=f"fx={fx:g}, fy={fy:g}",
                             remedy="check the calibration file")  # fmt: skip
        return Camera(
            name,
            width,
            height,
            fx,
            fy,
            float(projection[0, 2]) + PIXEL_CENTRE_PX,
            float(projection[1, 2]) + PIXEL_CENTRE_PX,
        )

    def cam_from_rect0(self, number: int) -> Matrix:
        """Rectified camera ``number`` from rectified camera 0: a translation only."""
        projection = self._projection(number)
        return from_rotation_translation(np.eye(3), np.linalg.solve(projection[:, :3], projection[:, 3]))

    def velo_from_cam(self, number: int) -> Matrix:
        """Velodyne from rectified camera ``number``."""
        return invert(self.cam_from_rect0(number) @ self.rect0_from_velo)

    def _projection(self, number: int) -> Matrix:
        if number not in self.projections:
            raise InputError(f"calibration does not tell camera {number}", where=self.source,
                             got=", ".join(f"P{n}" for n in self.projections) or "no projection matrices")  # fmt: skip
        return self.projections[number]


def read_number_table(path: Path) -> dict[str, NDArray[np.float64]]:
    """``key: numbers`` lines of a KITTI text file; lines whose value is not numbers (dates) are left out.

    The colon after the key is optional (some benchmark files leave it out for ``R_rect`` and ``Tr_velo_cam``).
    """
    try:
        text = store.read_bytes(path).decode("utf-8")
    except UnicodeDecodeError as error:
        raise InputError("calibration is not a text file", where=str(path), got=str(error)) from error
    table: dict[str, NDArray[np.float64]] = {}
    for line in text.splitlines():
        match = re.match(r"\s*([A-Za-z][\w]*)\s*:?\s+(.*)$", line)
        if match is None:
            continue
        try:
            numbers = np.array([float(word) for word in match[2].split()])
        except ValueError:
            continue
        if not np.isfinite(numbers).all():
            raise InputError("calibration holds a value that is not finite", where=f"{path}: {match[1]}",
                             got=match[2][:80])  # fmt: skip
        table[match[1]] = numbers
    return table


def read_calibration_text(path: Path) -> KittiCalibration:
    """Object, tracking or odometry calibration: P0..P3, R0_rect (odometry: none), Tr_velo_to_cam, Tr_imu_to_velo."""
    table = read_number_table(path)
    where = str(path)
    projections = {n: _shaped(table, (f"P{n}",), (3, 4), where) for n in range(4) if f"P{n}" in table}
    rectify = np.eye(3)
    if any(key in table for key in ("R0_rect", "R_rect")):
        rectify = nearest_rotation(_shaped(table, ("R0_rect", "R_rect"), (3, 3), where), f"{where}: R0_rect")
    velo_to_cam = _rigid(
        _shaped(table, ("Tr_velo_to_cam", "Tr_velo_cam", "Tr"), (3, 4), where), f"{where}: Tr_velo_to_cam"
    )
    imu_keys = ("Tr_imu_to_velo", "Tr_imu_velo")
    velo_from_imu = None
    if any(key in table for key in imu_keys):
        velo_from_imu = _rigid(_shaped(table, imu_keys, (3, 4), where), f"{where}: Tr_imu_to_velo")
    rect0_from_velo = from_rotation_translation(rectify, np.zeros(3)) @ velo_to_cam
    return KittiCalibration(projections, rect0_from_velo, velo_from_imu, where)


def read_calibration_day(folder: Path) -> KittiCalibration:
    """Raw-data calibration of one day: ``calib_cam_to_cam.txt``, ``calib_velo_to_cam.txt``, ``calib_imu_to_velo.txt``."""
    cameras_path = folder / "calib_cam_to_cam.txt"
    cameras = read_number_table(cameras_path)
    projections = {
        n: _shaped(cameras, (f"P_rect_0{n}",), (3, 4), str(cameras_path)) for n in range(4) if f"P_rect_0{n}" in cameras
    }
    rectify = nearest_rotation(
        _shaped(cameras, ("R_rect_00",), (3, 3), str(cameras_path)), f"{cameras_path}: R_rect_00"
    )
    velo_to_cam = _rotation_translation_file(folder / "calib_velo_to_cam.txt")
    imu_path = folder / "calib_imu_to_velo.txt"
    velo_from_imu = _rotation_translation_file(imu_path) if imu_path.is_file() else None
    return KittiCalibration(
        projections, from_rotation_translation(rectify, np.zeros(3)) @ velo_to_cam, velo_from_imu, str(folder)
    )


def _rotation_translation_file(path: Path) -> Matrix:
    table = read_number_table(path)
    rotation = nearest_rotation(_shaped(table, ("R",), (3, 3), str(path)), f"{path}: R")
    return from_rotation_translation(rotation, _shaped(table, ("T",), (3,), str(path)))


def _shaped(table: dict[str, NDArray[np.float64]], keys: tuple[str, ...], shape: tuple[int, ...], where: str) -> Matrix:
    for key in keys:
        if key in table:
            count = int(np.prod(shape))
            if table[key].size != count:
                raise InputError("calibration entry has the wrong number of values", where=f"{where}: {key}",
                                 expected=f"{count} numbers", got=f"{table[key].size}",
                                 remedy="is the file cut off?")  # fmt: skip
            return table[key].reshape(shape)
    raise InputError(f"calibration lacks {keys[0]}", where=where, expected=" or ".join(keys),
                     got=", ".join(table) or "no entries",
                     remedy="use the calibration file that belongs to this recording")  # fmt: skip


def _rigid(matrix: Matrix, where: str) -> Matrix:
    return from_rotation_translation(nearest_rotation(matrix[:, :3], where), matrix[:, 3])


def nearest_rotation(matrix: Matrix, where: str) -> Matrix:
    """The nearest rotation of a matrix that was rounded to text; refuses what was no rotation to begin with."""
    error = float(np.abs(matrix @ matrix.T - np.eye(3)).max())
    if error > _ROTATION_TOLERANCE or np.linalg.det(matrix) < 0:
        raise InputError("calibration rotation is not a rotation", where=where, expected="orthonormal, determinant +1",
                         got=f"largest deviation {error:.3g}, determinant {np.linalg.det(matrix):.3g}")  # fmt: skip
    u, _, vt = np.linalg.svd(matrix)
    return u @ vt
