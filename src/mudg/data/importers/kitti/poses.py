"""KITTI vehicle poses: GPS/IMU packets (``oxts``), odometry pose files, velodyne pose files; and the clocks beside them."""

from __future__ import annotations

import datetime
import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mudg.base import log, store
from mudg.base.errors import InputError
from mudg.base.geometry import from_rotation_translation, yaw_matrix, yaw_of
from mudg.data.importers.common import rigid_pose

Matrix = NDArray[np.float64]
EARTH_RADIUS_M = 6378137.0
_OXTS_VALUES = 30


def read_lines(path: Path) -> dict[int, str]:
    """The lines of a text file by their number, from 0. An empty one is a record that is missing: it is left out, and keeps its number."""
    return {number: line for number, line in enumerate(store.read_text(path).splitlines()) if line.strip()}


def line_numbers(line: str, counts: Sequence[int], where: str, what: str) -> NDArray[np.float64]:
    """The numbers of one line; their count must be one of ``counts``."""
    try:
        numbers = np.array([float(text) for text in line.split()])
    except ValueError as error:
        raise InputError(f"{what}: a value is not a number", where=where, got=line.strip()[:80]) from error
    if len(numbers) not in counts:
        raise InputError(f"{what}: wrong number of values", where=where, expected=" or ".join(str(c) for c in counts),
            got=str(len(numbers)), remedy="is the file cut off, or of another format?")  # fmt: skip
    if not np.isfinite(numbers).all():
        raise InputError(f"{what}: a value is not finite", where=where, got=line.strip()[:80],
            expected="finite numbers")  # fmt: skip
    return numbers


def read_pose_file(path: Path, frame_numbers: Sequence[int]) -> tuple[dict[int, Matrix], str]:
    """Poses by frame number, and which sensor they are of.

    Two forms are told apart by the numbers in a line: 12 = KITTI odometry, row-major 3x4 of rectified camera 0, line k
    for frame number k (or, in a file that has just one line per frame, for the k-th frame); 13 = frame number, then
    row-major 3x4 of the velodyne in a z-up world. An empty line is a frame without a pose.

    Returns:
        Poses f64[4, 4] by frame number, and ``"cam0"`` or ``"velo"``.
    """
    lines = read_lines(path)
    if not lines:
        raise InputError("pose file is empty", where=str(path), expected="one pose a line")
    rows = {n: line_numbers(line, (12, 13), f"{path}: line {n + 1}", "pose") for n, line in lines.items()}
    widths, count = {len(row) for row in rows.values()}, max(rows) + 1
    if len(widths) != 1:
        raise InputError("pose file mixes two forms", where=str(path), expected="12 or 13 numbers in every line")
    if widths == {13}:
        poses = {int(row[0]): row[1:] for row in rows.values()}
        if len(poses) != len(rows) or any(number != row[0] for number, row in zip(poses, rows.values(), strict=True)):
            raise InputError("first column is not a list of distinct frame numbers", where=str(path))
    elif count > max(frame_numbers):
        poses = rows
    elif len(rows) == count == len(frame_numbers):
        poses = dict(zip(frame_numbers, rows.values(), strict=True))
        if frame_numbers[-1] - frame_numbers[0] >= count:
            log.warn(f"kitti: {path} has a line for each of the {count} frames: line k is taken for the k-th of them, gaps or not")
    else:
        expected = f"{len(frame_numbers)} (one per frame) or at least {max(frame_numbers) + 1} (one per frame number)"
        raise InputError("pose file does not cover the frames", where=str(path), got=f"{count} lines",
            expected=expected)  # fmt: skip
    sensor = "velo" if widths == {13} else "cam0"
    return {n: rigid_pose(row.reshape(3, 4), f"{path}: pose of frame {n}") for n, row in poses.items()}, sensor


def read_packets(path: Path, frames: Sequence[int]) -> dict[int, NDArray[np.float64]]:
    """GPS/IMU packets f64[30] by frame number, from the first to the last of ``frames``; empty files and lines are missing packets.

    Args:
        path: a folder with one file per frame (raw data), or one file with a line per frame (tracking).
    """
    if path.is_dir():
        found = {int(file.stem): file for file in path.iterdir() if file.stem.isdigit() and file.suffix == ".txt"}
        wheres = {n: str(file) for n, file in sorted(found.items()) if frames[0] <= n <= frames[-1]}
        texts = {n: list(read_lines(found[n]).values()) for n in wheres}
        lines = {n: text[0] for n, text in texts.items() if text}
    else:
        lines = {n: line for n, line in read_lines(path).items() if frames[0] <= n <= frames[-1]}
        wheres = {n: f"{path}: line {n + 1}" for n in lines}
    return {n: line_numbers(line, (_OXTS_VALUES,), wheres[n], "GPS/IMU packet") for n, line in lines.items()}


def poses_from_packets(packets: NDArray[np.float64], where: str) -> Matrix:
    """World-from-IMU poses f64[n, 4, 4] of GPS/IMU packets f64[n, 30].

    Latitude and longitude are projected as Mercator, scaled at the first packet's latitude, so that distances near the
    start are true; roll, pitch and yaw turn about x, y and z in that order. World: the first position is the origin, x
    along the first heading, z against gravity.
    """
    if (np.abs(packets[:, 0]) > 89).any() or (np.abs(packets[:, 1]) > 180).any():
        raise InputError("latitude or longitude is out of range", where=where, expected="degrees")
    latitude, longitude = np.deg2rad(packets[:, 0]), np.deg2rad(packets[:, 1])
    scale = np.cos(latitude[0])
    east = scale * EARTH_RADIUS_M * longitude
    north = scale * EARTH_RADIUS_M * np.log(np.tan(np.pi / 4 + latitude / 2))
    positions = np.stack([east, north, packets[:, 2]], 1)
    poses = np.stack(
        [
            from_rotation_translation(_roll_pitch_yaw(*packet[3:6]), position - positions[0])
            for packet, position in zip(packets, positions, strict=True)
        ]
    )
    return yaw_matrix(-yaw_of(poses[0])) @ poses


def _roll_pitch_yaw(roll: float, pitch: float, yaw: float) -> Matrix:
    cr, sr, cp, sp = np.cos(roll), np.sin(roll), np.cos(pitch), np.sin(pitch)
    about_x = np.array([[1, 0, 0], [0, cr, -sr], [0, sr, cr]])
    about_y = np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]])
    return yaw_matrix(yaw)[:3, :3] @ about_y @ about_x


def read_timestamps(path: Path, numbers: Sequence[int], last: int) -> dict[int, float]:
    """Seconds by number: plain seconds, or ``2011-09-26 13:02:25.964389445`` (nanoseconds kept; seconds of the epoch).

    Line k is number k, and an empty line a number without a stamp. A file without empty lines that is too short for that, but has just one
    line per recorded file, counts those instead.

    Args:
        numbers: of the recorded files, increasing.
        last: the highest number that is needed.

    Raises:
        InputError: no times, or too few.
    """
    lines = read_lines(path)
    stamps = {number: _stamp(line, f"{path}: line {number + 1}") for number, line in lines.items()}
    count = len(store.read_text(path).splitlines())
    if count > last:
        return stamps
    if len(stamps) == max(stamps, default=-1) + 1 == len(numbers) > 0:
        log.warn(f"kitti: {path} has a line for each of the {len(numbers)} files: line k is taken for the k-th of them, gaps or not")
        return dict(zip(numbers, stamps.values(), strict=True))
    raise InputError("timestamps do not cover the frames", where=str(path), got=f"{count} lines, {len(numbers)} files",
        expected=f"at least {last + 1} lines (line k = frame k, empty where it is missing), or one per file",
        remedy="is the file cut off?")  # fmt: skip


def _stamp(line: str, where: str) -> float:
    match = re.fullmatch(r"(\d{4}-\d\d-\d\d \d\d:\d\d:\d\d)(\.\d{1,12})?", line.strip())
    if match is None:
        return float(line_numbers(line, (1,), where, "timestamp")[0])
    try:
        second = datetime.datetime.strptime(match[1], "%Y-%m-%d %H:%M:%S").replace(tzinfo=datetime.UTC)
    except ValueError as error:
        raise InputError("timestamp is no date", where=where, got=line.strip()) from error
    return second.timestamp() + float(match[2] or 0)
