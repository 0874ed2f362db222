"""KITTI calibration text, both forms: the object/tracking/odometry ``calib.txt`` and the three files of a raw-data day.

KITTI counts pixels from the centre of the top-left pixel; this package from its corner. So 0.5 is added to the principal
point here, once.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mudg.base import store
from mudg.base.errors import InputError
from mudg.base.geometry import from_rotation_translation, invert
from mudg.base.types import Camera
from mudg.data.importers.common import rigid_pose, rigid_rotation
from mudg.data.unknown_fields import note_unknown

Matrix = NDArray[np.float64]
PIXEL_CENTRE_PX = 0.5
_NUMBERED = tuple(f"{name}_{number:02d}" for name in ("S", "K", "D", "R", "T", "S_rect", "R_rect", "P_rect") for number in range(4))
_TEXT = frozenset({
    "P0", "P1", "P2", "P3", "R0_rect", "R_rect", "Tr", "Tr_velo_to_cam", "Tr_velo_cam", "Tr_imu_to_velo", "Tr_imu_velo", "calib_time",
})  # fmt: skip
_OFFICIAL: Mapping[str, frozenset[str]] = {
    "calib_cam_to_cam.txt": frozenset({"calib_time", "corner_dist", *_NUMBERED}),
    "calib_velo_to_cam.txt": frozenset({"calib_time", "R", "T", "delta_f", "delta_c"}),
    "calib_imu_to_velo.txt": frozenset({"calib_time", "R", "T"}),
    "perspective.txt": frozenset({"calib_time", "corner_dist", *_NUMBERED}),
    "calib_cam_to_pose.txt": frozenset({"image_00", "image_01", "image_02", "image_03"}),
}
"""Entries of the data sets' files, read or not; any other file is the calibration text of an object, a sequence or a drive."""


@dataclass(frozen=True, slots=True, eq=False)
class KittiCalibration:
    """Calibration of one recording.

    Args:
        projections: camera number -> P f64[3, 4]: pixels from rectified camera 0.
        rect0_from_velo: rectified camera 0 from velodyne, f64[4, 4].
        velo_from_imu: velodyne from IMU f64[4, 4], or None if the source does not say.
        source: the files read, for messages.
    """

    projections: dict[int, Matrix]
    rect0_from_velo: Matrix
    velo_from_imu: Matrix | None
    source: str

    def camera(self, number: int, name: str, width: int, height: int) -> Camera:
        """Pinhole intrinsics of the rectified camera ``number``."""
        return pinhole_camera(self._projection(number), name, (width, height), f"{self.source}: P{number}")

    def cam_from_rect0(self, number: int) -> Matrix:
        """Rectified camera ``number`` from rectified camera 0: a translation only."""
        projection = self._projection(number)
        return from_rotation_translation(np.eye(3), np.linalg.solve(projection[:, :3], projection[:, 3]))

    def velo_from_cam(self, number: int) -> Matrix:
        """Velodyne from rectified camera ``number``, f64[4, 4]."""
        return invert(self.cam_from_rect0(number) @ self.rect0_from_velo)

    def _projection(self, number: int) -> Matrix:
        if number not in self.projections:
            raise InputError(f"calibration does not tell camera {number}", where=self.source,
                got=", ".join(f"P{n}" for n in self.projections) or "no projection matrices")  # fmt: skip
        return self.projections[number]


def pinhole_camera(projection: Matrix, name: str, size: tuple[int, int], where: str) -> Camera:
    """The rectified pinhole camera of a KITTI projection matrix.

    Args:
        projection: f64[3, 4]; pixels are counted from the centre of the top-left one.
        name: of the camera in the scene.
        size: width and height in pixels.
        where: for messages.

    Raises:
        InputError: skew, another last row than 0 0 1, or a focal length that is not positive.
    """
    if abs(projection[0, 1]) > 1e-6 or abs(projection[2, 2] - 1) > 1e-6:
        raise InputError("projection matrix is not of a rectified pinhole camera", where=where,
            expected="no skew, last row 0 0 1", got=str(projection[:, :3].tolist()))  # fmt: skip
    fx, fy, cx, cy = (float(projection[index]) for index in ((0, 0), (1, 1), (0, 2), (1, 2)))
    if fx <= 0 or fy <= 0:
        raise InputError("focal length is not positive", where=where, expected="pixels, about 700 for KITTI",
            got=f"fx={fx:g}, fy={fy:g}", remedy="check the calibration file")  # fmt: skip
    return Camera(name, *size, fx, fy, cx + PIXEL_CENTRE_PX, cy + PIXEL_CENTRE_PX)


def read_number_table(path: Path) -> dict[str, NDArray[np.float64]]:
    """``key: numbers`` lines of a KITTI text file; lines whose value is not numbers (dates) are left out.

    The colon after the key is optional (some benchmark files leave it out for ``R_rect`` and ``Tr_velo_cam``).
    """
    table: dict[str, NDArray[np.float64]] = {}
    for line in store.read_text(path).splitlines():
        match = re.match(r"\s*([A-Za-z][\w]*)\s*:?\s+(.*)$", line)
        if match is None:
            continue
        note_unknown(path.name, (match[1],), _OFFICIAL.get(path.name, _TEXT))
        try:
            numbers = np.array([float(text) for text in match[2].split()])
        except ValueError:
            continue
        if not np.isfinite(numbers).all():
            raise InputError("calibration holds a value that is not finite", where=f"{path}: {match[1]}",
                got=match[2][:80])  # fmt: skip
        table[match[1]] = numbers
    return table


def table_entry(
    table: Mapping[str, NDArray[np.float64]], keys: tuple[str, ...], shape: tuple[int, ...], where: object
) -> Matrix:
    """The first entry of ``keys`` that the table has, as an array of ``shape``.

    Raises:
        InputError: there is none of them, or it has another number of values.
    """
    key = next((key for key in keys if key in table), None)
    if key is None:
        raise InputError(f"calibration lacks {keys[0]}", where=str(where), expected=" or ".join(keys),
            got=", ".join(table) or "no entries", remedy="use the calibration file that belongs to this recording")  # fmt: skip
    if table[key].size != np.prod(shape):
        raise InputError("calibration entry has the wrong number of values", where=f"{where}: {key}",
            expected=f"{np.prod(shape)} numbers", got=f"{table[key].size}", remedy="is the file cut off?")  # fmt: skip
    return table[key].reshape(shape)


def read_calibration_text(path: Path) -> KittiCalibration:
    """Object, tracking or odometry calibration: P0..P3, R0_rect (odometry: none), Tr_velo_to_cam, Tr_imu_to_velo."""
    table = read_number_table(path)
    projections = {n: table_entry(table, (f"P{n}",), (3, 4), path) for n in range(4) if f"P{n}" in table}
    rectify, rectify_keys, imu_keys = np.eye(3), ("R0_rect", "R_rect"), ("Tr_imu_to_velo", "Tr_imu_velo")
    if any(key in table for key in rectify_keys):
        rectify = rigid_rotation(table_entry(table, rectify_keys, (3, 3), path), f"{path}: R0_rect")
    velo_to_cam = table_entry(table, ("Tr_velo_to_cam", "Tr_velo_cam", "Tr"), (3, 4), path)
    velo_to_cam = rigid_pose(velo_to_cam, f"{path}: Tr_velo_to_cam")
    velo_from_imu = None
    if any(key in table for key in imu_keys):
        velo_from_imu = rigid_pose(table_entry(table, imu_keys, (3, 4), path), f"{path}: Tr_imu_to_velo")
    rect0_from_velo = from_rotation_translation(rectify, np.zeros(3)) @ velo_to_cam
    return KittiCalibration(projections, rect0_from_velo, velo_from_imu, str(path))


def read_calibration_day(folder: Path) -> KittiCalibration:
    """Raw-data calibration of one day: ``calib_cam_to_cam.txt``, ``calib_velo_to_cam.txt``, ``calib_imu_to_velo.txt``."""
    path = folder / "calib_cam_to_cam.txt"
    table = read_number_table(path)
    projections = {n: table_entry(table, (f"P_rect_0{n}",), (3, 4), path) for n in range(4) if f"P_rect_0{n}" in table}
    rectify = rigid_rotation(table_entry(table, ("R_rect_00",), (3, 3), path), f"{path}: R_rect_00")
    rect0_from_velo = from_rotation_translation(rectify, np.zeros(3)) @ _pose_file(folder / "calib_velo_to_cam.txt")
    imu_path = folder / "calib_imu_to_velo.txt"
    velo_from_imu = _pose_file(imu_path) if imu_path.is_file() else None
    return KittiCalibration(projections, rect0_from_velo, velo_from_imu, str(folder))


def _pose_file(path: Path) -> Matrix:
    """Rotation ``R`` and translation ``T`` of a raw-data file as a pose f64[4, 4]."""
    table = read_number_table(path)
    rotation = rigid_rotation(table_entry(table, ("R",), (3, 3), path), f"{path}: R")
    return from_rotation_translation(rotation, table_entry(table, ("T",), (3,), path))
