"""KITTI importer: raw drives, odometry and tracking sequences, single object frames (docs/reference/formats.md). World:
z up, origin and x at the first ego pose; the ego frame is the IMU where there is GPS/IMU data, else the velodyne.
"""

from __future__ import annotations

import datetime
import re
from collections.abc import Callable, Container, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

from mudg.base import log, store
from mudg.base.errors import InputError, UsageError
from mudg.base.geometry import from_rotation_translation, invert, yaw_matrix, yaw_of
from mudg.base.types import Camera, EgoPath, Scene, Source, SweepPoints, Track
from mudg.formats.importers import common
from mudg.formats.importers.clouds import read_float_rows
from mudg.formats.importers.common import (
    ImportOptions,
    LogFiles,
    blend_motion,
    numbered_files,
    rigid_pose,
    rigid_rotation,
    unit_intensity,
)
from mudg.formats.importers.drive_log import BoxTracks, SceneContent, SceneImage, SceneSweep, box_size, write_scene
from mudg.formats.importers.images import fit_images, image_notes, image_size
from mudg.formats.unknown_fields import note_unknown

Matrix = NDArray[np.float64]

# scans --------------------------------------------------------------------------------------------
#
# The sensor turns counter-clockwise in 0.1 s and faces forward at the scan's time: a point at azimuth a is a / 2 pi
# turns later. The benchmarks document their scans as compensated.
SENSOR: Final = "velodyne"
TURN_PERIOD_S: Final = 0.1
_TURN_STEPS: Final = 36


def read_scan(path: Path) -> SweepPoints:
    """A velodyne scan: float32 rows x, y, z, reflectance (0..1). Beams without a return are left out and counted."""
    rows, returns = read_float_rows(path, 4)
    xyz, dt_s = np.ascontiguousarray(rows[returns, :3]), np.zeros(int(returns.sum()), np.float32)
    intensity = unit_intensity(rows[returns, 3], 1, path, "divide the reflectance by its largest value, often 255")
    return SweepPoints(xyz, intensity, dt_s, no_returns=int((~returns).sum()))


def untwist_scan(points: SweepPoints, velo_at: Callable[[float], Matrix], time_s: float) -> SweepPoints:
    """Bring the points of a turning sensor to one moment, ``time_s``: points in the sensor's frame then, with the
    seconds after it at which they were measured. ``velo_at``: world-from-velodyne f64[4, 4] at a time; asked at 37
    moments of the turn, between which points are blended."""
    azimuth = np.arctan2(points.xyz[:, 1], points.xyz[:, 0])
    dt_s = np.asarray(azimuth / (2 * np.pi) * TURN_PERIOD_S, np.float32)
    velo_from_world = invert(velo_at(time_s))
    moments_s = np.linspace(-0.5, 0.5, _TURN_STEPS + 1) * TURN_PERIOD_S
    corrections = [velo_from_world @ velo_at(time_s + float(moment)) for moment in moments_s]
    place = (dt_s / TURN_PERIOD_S + 0.5) * _TURN_STEPS
    return replace(points, xyz=blend_motion(points.xyz, corrections, place), dt_s=dt_s)


# calib --------------------------------------------------------------------------------------------
_NUMBERED = tuple(
    f"{name}_{number:02d}" for name in ("S", "K", "D", "R", "T", "S_rect", "R_rect", "P_rect") for number in range(4)
)
_TEXT = frozenset(
    "P0 P1 P2 P3 R0_rect R_rect Tr Tr_velo_to_cam Tr_velo_cam Tr_imu_to_velo Tr_imu_velo calib_time".split()
)
_OFFICIAL: Mapping[str, frozenset[str]] = {
    "calib_cam_to_cam.txt": frozenset({"calib_time", "corner_dist", *_NUMBERED}),
    "calib_velo_to_cam.txt": frozenset({"calib_time", "R", "T", "delta_f", "delta_c"}),
    "calib_imu_to_velo.txt": frozenset({"calib_time", "R", "T"}),
    "perspective.txt": frozenset({"calib_time", "corner_dist", *_NUMBERED}),
    "calib_cam_to_pose.txt": frozenset({"image_00", "image_01", "image_02", "image_03"}),
}
"""Entries of the data sets' files, read or not; any other file is the calibration text of an object, a sequence or a
drive."""


@dataclass(frozen=True, slots=True, eq=False)
class KittiCalibration:
    """Calibration of one recording; poses are f64[4, 4]. ``projections``: camera number -> P f64[3, 4], pixels from
    rectified camera 0. ``velo_from_imu``: None if the source does not say."""

    projections: dict[int, Matrix]
    rect0_from_velo: Matrix
    velo_from_imu: Matrix | None
    source: str

    def camera(self, number: int, name: str, width: int, height: int) -> Camera:
        """Pinhole intrinsics of the rectified camera ``number``."""
        where = f"{self.source}: P{number}"
        return common.pinhole_camera(name, (width, height), self._projection(number)[:, :3], where)

    def velo_from_cam(self, number: int) -> Matrix:
        """Velodyne from rectified camera ``number``, f64[4, 4]; rectified cameras differ by a translation only."""
        projection = self._projection(number)
        shift = np.linalg.solve(projection[:, :3], projection[:, 3])
        return invert(from_rotation_translation(np.eye(3), shift) @ self.rect0_from_velo)

    def _projection(self, number: int) -> Matrix:
        if number not in self.projections:
            got = ", ".join(f"P{n}" for n in self.projections) or "no projection matrices"
            raise InputError(f"calibration does not tell camera {number}", where=self.source, got=got)
        return self.projections[number]


def read_number_table(path: Path) -> dict[str, NDArray[np.float64]]:
    """``key: numbers`` lines of a KITTI text file; lines whose value is not numbers (dates) are left out. The colon is
    optional (some benchmark files leave it out for ``R_rect`` and ``Tr_velo_cam``)."""
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
            what = "calibration holds a value that is not finite"
            raise InputError(what, where=f"{path}: {match[1]}", got=match[2][:80])
        table[match[1]] = numbers
    return table


def table_entry(
    table: Mapping[str, NDArray[np.float64]], keys: tuple[str, ...], shape: tuple[int, ...], where: object
) -> Matrix:
    """The first entry of ``keys`` that the table has, as an array of ``shape``."""
    key = next((key for key in keys if key in table), None)
    if key is None:
        what, expected = f"calibration lacks {keys[0]}", " or ".join(keys)
        remedy = "use the calibration file that belongs to this recording"
        raise InputError(what, where=str(where), expected=expected, got=", ".join(table) or "no entries", remedy=remedy)
    if table[key].size != np.prod(shape):
        what, got = "calibration entry has the wrong number of values", f"{table[key].size}"
        raise InputError(what, where=f"{where}: {key}", expected=f"{np.prod(shape)} numbers", got=got)
    return table[key].reshape(shape)


def pose_entry(table: Mapping[str, NDArray[np.float64]], keys: tuple[str, ...], path: Path) -> Matrix:
    """The pose f64[4, 4] of an entry of 12 numbers."""
    return rigid_pose(table_entry(table, keys, (3, 4), path), f"{path}: {keys[0]}")


def rotation_entry(table: Mapping[str, NDArray[np.float64]], keys: tuple[str, ...], path: Path) -> Matrix:
    """The rotation of an entry of 9 numbers, as a pose f64[4, 4]."""
    rotation = rigid_rotation(table_entry(table, keys, (3, 3), path), f"{path}: {keys[0]}")
    return from_rotation_translation(rotation, np.zeros(3))


def _projections(table: Mapping[str, NDArray[np.float64]], name: str, path: Path) -> dict[int, Matrix]:
    return {n: table_entry(table, (f"{name}{n}",), (3, 4), path) for n in range(4) if f"{name}{n}" in table}


def read_calibration_text(path: Path) -> KittiCalibration:
    """Object, tracking or odometry calibration: P0..P3, R0_rect (odometry: none), Tr_velo_to_cam, Tr_imu_to_velo."""
    table = read_number_table(path)
    rectify, imu_keys = ("R0_rect", "R_rect"), ("Tr_imu_to_velo", "Tr_imu_velo")
    rect0_from_velo = pose_entry(table, ("Tr_velo_to_cam", "Tr_velo_cam", "Tr"), path)
    if table.keys() & rectify:
        rect0_from_velo = rotation_entry(table, rectify, path) @ rect0_from_velo
    velo_from_imu = pose_entry(table, imu_keys, path) if table.keys() & imu_keys else None
    return KittiCalibration(_projections(table, "P", path), rect0_from_velo, velo_from_imu, str(path))


def read_calibration_day(folder: Path) -> KittiCalibration:
    """Raw-data calibration of one day: ``calib_cam_to_cam.txt``, ``calib_velo_to_cam.txt``,
    ``calib_imu_to_velo.txt``."""
    path, imu_path = folder / "calib_cam_to_cam.txt", folder / "calib_imu_to_velo.txt"
    table = read_number_table(path)
    rect0_from_velo = rotation_entry(table, ("R_rect_00",), path) @ _pose_file(folder / "calib_velo_to_cam.txt")
    velo_from_imu = _pose_file(imu_path) if imu_path.is_file() else None
    return KittiCalibration(_projections(table, "P_rect_0", path), rect0_from_velo, velo_from_imu, str(folder))


def _pose_file(path: Path) -> Matrix:
    """Rotation ``R`` and translation ``T`` of a raw-data file as a pose f64[4, 4]."""
    table = read_number_table(path)
    pose = rotation_entry(table, ("R",), path)
    pose[:3, 3] = table_entry(table, ("T",), (3,), path)
    return pose


# poses --------------------------------------------------------------------------------------------
EARTH_RADIUS_M = 6378137.0
_OXTS_VALUES = 30


def read_lines(path: Path) -> dict[int, str]:
    """The lines of a text file by their number, from 0. An empty one is a record that is missing: it is left out, and
    keeps its number."""
    return {number: line for number, line in enumerate(store.read_text(path).splitlines()) if line.strip()}


def line_numbers(line: str, counts: Sequence[int], where: str, what: str) -> NDArray[np.float64]:
    """The numbers of one line; their count must be one of ``counts``."""
    try:
        numbers = np.array([float(text) for text in line.split()])
    except ValueError as error:
        raise InputError(f"{what}: a value is not a number", where=where, got=line.strip()[:80]) from error
    if len(numbers) not in counts:
        what, expected = f"{what}: wrong number of values", " or ".join(str(c) for c in counts)
        remedy = "is the file cut off, or of another format?"
        raise InputError(what, where=where, expected=expected, got=str(len(numbers)), remedy=remedy)
    if not np.isfinite(numbers).all():
        what = f"{what}: a value is not finite"
        raise InputError(what, where=where, got=line.strip()[:80], expected="finite numbers")
    return numbers


def read_pose_file(path: Path, frame_numbers: Sequence[int]) -> tuple[dict[int, Matrix], str]:
    """Poses f64[4, 4] by frame number, and which sensor they are of: ``cam0`` or ``velo``.

    Two forms are told apart by the numbers in a line: 12 = KITTI odometry, row-major 3x4 of rectified camera 0, line k
    for frame number k (or, in a file that has just one line per frame, for the k-th frame); 13 = frame number, then
    row-major 3x4 of the velodyne in a z-up world. An empty line is a frame without a pose."""
    rows = {n: line_numbers(line, (12, 13), f"{path}: line {n + 1}", "pose") for n, line in read_lines(path).items()}
    if not rows:
        raise InputError("pose file is empty", where=str(path), expected="one pose a line")
    widths = {len(row) for row in rows.values()}
    if len(widths) != 1:
        raise InputError("pose file mixes two forms", where=str(path), expected="12 or 13 numbers in every line")
    poses, count = rows, max(rows) + 1
    if widths == {12} and count <= max(frame_numbers):
        if not len(rows) == count == len(frame_numbers):
            what, got = "pose file does not cover the frames", f"{count} lines"
            expected = f"{len(frame_numbers)} (one per frame) or at least {max(frame_numbers) + 1} (one per number)"
            raise InputError(what, where=str(path), got=got, expected=expected)
        poses = _by_rank(path, frame_numbers, rows, frame_numbers[-1] - frame_numbers[0] >= count)
    if widths == {13}:
        poses = {int(row[0]): row[1:] for row in rows.values()}
        if len(poses) != len(rows) or any(number != row[0] for number, row in zip(poses, rows.values(), strict=True)):
            raise InputError("first column is not a list of distinct frame numbers", where=str(path))
    sensor = "velo" if widths == {13} else "cam0"
    return {n: rigid_pose(row.reshape(3, 4), f"{path}: pose of frame {n}") for n, row in poses.items()}, sensor


def read_packets(path: Path, frames: Sequence[int]) -> dict[int, NDArray[np.float64]]:
    """GPS/IMU packets f64[30] by frame number, from the first to the last of ``frames``: from a folder with a file per
    frame (raw data), or one file with a line per frame (tracking). Empty files and lines are missing packets."""
    if path.is_dir():
        found = numbered_files(path, (".txt",)).items()
        texts = {n: [*read_lines(file).values()] for n, file in found if frames[0] <= n <= frames[-1]}
        lines, wheres = {n: text[0] for n, text in texts.items() if text}, {n: str(file) for n, file in found}
    else:
        lines = {n: line for n, line in read_lines(path).items() if frames[0] <= n <= frames[-1]}
        wheres = {n: f"{path}: line {n + 1}" for n in lines}
    return {n: line_numbers(line, (_OXTS_VALUES,), wheres[n], "GPS/IMU packet") for n, line in lines.items()}


def poses_from_packets(packets: NDArray[np.float64], where: str) -> Matrix:
    """World-from-IMU poses f64[n, 4, 4] of GPS/IMU packets f64[n, 30]. Latitude and longitude are projected as
    Mercator, scaled at the first packet's latitude, so that distances near the start are true; roll, pitch and yaw turn
    about x, y and z in that order. World: the first position is the origin, x along the first heading, z up."""
    if (np.abs(packets[:, 0]) > 89).any() or (np.abs(packets[:, 1]) > 180).any():
        raise InputError("latitude or longitude is out of range", where=where, expected="degrees")
    latitude, longitude = np.deg2rad(packets[:, 0]), np.deg2rad(packets[:, 1])
    scale = np.cos(latitude[0])
    east = scale * EARTH_RADIUS_M * longitude
    north = scale * EARTH_RADIUS_M * np.log(np.tan(np.pi / 4 + latitude / 2))
    positions = np.stack([east, north, packets[:, 2]], 1)
    poses = []
    for (roll, pitch, yaw), place in zip(packets[:, 3:6], positions - positions[0], strict=True):
        cr, sr, cp, sp = np.cos(roll), np.sin(roll), np.cos(pitch), np.sin(pitch)
        about_x = np.array([[1, 0, 0], [0, cr, -sr], [0, sr, cr]])
        about_y = np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]])
        poses.append(from_rotation_translation(yaw_matrix(yaw)[:3, :3] @ about_y @ about_x, place))
    return yaw_matrix(-yaw_of(poses[0])) @ np.stack(poses)


def read_timestamps(path: Path, numbers: Sequence[int], last: int) -> dict[int, float]:
    """Seconds by number: plain seconds, or ``2011-09-26 13:02:25.964389445`` (nanoseconds kept; seconds of the epoch).
    Line k is number k, and an empty line a number without a stamp. A file without empty lines that is too short for
    that, but has just one line per recorded file, counts those instead. ``numbers``: of the recorded files, increasing.
    ``last``: the highest number that is needed."""
    stamps = {number: _stamp(line, f"{path}: line {number + 1}") for number, line in read_lines(path).items()}
    count = len(store.read_text(path).splitlines())
    if count > last:
        return stamps
    if len(stamps) == max(stamps, default=-1) + 1 == len(numbers) > 0:
        return _by_rank(path, numbers, stamps, True)
    what, got = "timestamps do not cover the frames", f"{count} lines, {len(numbers)} files"
    expected = f"at least {last + 1} lines (line k = frame k, empty where it is missing), or one per file"
    raise InputError(what, where=str(path), got=got, expected=expected, remedy="is the file cut off?")


def _by_rank(path: Path, numbers: Sequence[int], values: Mapping[int, Any], gaps: bool) -> dict[int, Any]:
    """The lines of a file that has just one for each of the ``numbers``."""
    if gaps:
        words = f"{path} has a line for each of the {len(numbers)} frames"
        log.warn(f"kitti: {words}: line k is taken for the k-th of them, gaps or not")
    return dict(zip(numbers, values.values(), strict=True))


def _stamp(line: str, where: str) -> float:
    match = re.fullmatch(r"(\d{4}-\d\d-\d\d \d\d:\d\d:\d\d)(\.\d{1,12})?", line.strip())
    if match is None:
        return float(line_numbers(line, (1,), where, "timestamp")[0])
    try:
        second = datetime.datetime.strptime(match[1], "%Y-%m-%d %H:%M:%S").replace(tzinfo=datetime.UTC)
    except ValueError as error:
        raise InputError("timestamp is no date", where=where, got=line.strip()) from error
    return second.timestamp() + float(match[2] or 0)


# boxes --------------------------------------------------------------------------------------------
_CHUNK: Final = 1 << 20
LABELS: Final = frozenset(
    ("car", "van", "truck", "pedestrian", "person_sitting", "person (sitting)", "person", "cyclist", "tram", "misc")
)
"""Classes of the benchmarks, in lower case."""
_TRACKLET = frozenset({"objectType", "h", "w", "l", "first_frame", "poses", "finished"})
_TRACKLET_POSE = frozenset(
    """tx ty tz rx ry rz state occlusion occlusion_kf truncation amt_occlusion amt_occlusion_kf amt_border_l
    amt_border_r amt_border_kf""".split()
)
"""Fields of the data set's tracklets, read or not."""


@dataclass(frozen=True, slots=True, eq=False)
class KittiBox:
    """One annotated box. ``track``: its name; object labels count lines. ``label``: lower-case class, e.g. ``car``.
    ``size_m``: length, width, height. ``pose``: box frame (x forward, y left, z up, origin in the centre) to the
    velodyne, or to the world of KITTI-360, f64[4, 4]."""

    frame: int
    track: str
    label: str
    size_m: tuple[float, float, float]
    pose: Matrix


def read_label_text(path: Path, rect0_from_velo: Matrix, frame: int | None = None) -> list[KittiBox]:
    """Boxes of a tracking label file (17 columns and optionally a score), or, with the number of its ``frame``, of an
    object label file (15). They are given in rectified camera 0; ``DontCare`` regions are left out."""
    velo_from_rect0 = invert(rect0_from_velo)
    boxes = []
    skip = 2 if frame is None else 0
    for index, line in read_lines(path).items():
        columns, where = line.split(), f"{path}: line {index + 1}"
        label = columns.pop(skip) if len(columns) > skip else ""
        if label == "DontCare":
            continue
        values = line_numbers(" ".join(columns), (14 + skip, 15 + skip), where, "label").tolist()
        number, track = (frame, index) if frame is not None else values[:2]
        if number % 1 or track % 1:
            raise InputError("number of a frame or track is not whole", where=where, got=line)
        height, width, length, x, y, z, turn = values[skip + 7 : skip + 14]
        size_m = box_size(length, width, height, where)
        # bottom centre (y down), and the turn about the camera's y axis
        c, s = np.cos(turn), np.sin(turn)
        rotation = np.array([(c, 0.0, -s), (s, 0.0, c), (0.0, -1.0, 0.0)]).T
        pose = velo_from_rect0 @ from_rotation_translation(rotation, np.array([x, y - height / 2, z]))
        boxes.append(KittiBox(int(number), str(int(track)), label.lower(), size_m, pose))
    return boxes


def xml_elements(path: Path, depth: int) -> Iterator[ElementTree.Element]:
    """The elements of an XML file that lie ``depth`` below the top one, each freed after use. A file that declares
    entities or another encoding is refused."""
    parser = ElementTree.XMLPullParser(("start", "end"))
    open_elements: list[ElementTree.Element] = []
    tail = b""
    try:
        with store.open_file(path) as handle:
            while chunk := handle.read(_CHUNK):
                # entities can blow a small file up; other encodings could hide them from this look
                content, head = tail + chunk, b"" if tail else chunk[:200].lower()
                other = b"encoding" in head and b"utf-8" not in head and b"ascii" not in head
                if other or b"<!ENTITY" in content or b"\0" in content:
                    what = "box file declares entities or another encoding, which the data set's files do not"
                    raise InputError(what, where=str(path), remedy="use the file from the data set")
                tail = chunk[-16:]
                parser.feed(chunk)
                events: Iterator[Any] = parser.read_events()
                for event, element in events:
                    if event == "start":
                        open_elements.append(element)
                        continue
                    open_elements.pop()
                    if len(open_elements) == depth:
                        yield element
                        open_elements[-1].clear()
        parser.close()
    except ElementTree.ParseError as error:
        raise InputError("box file is not valid XML (is it cut off?)", where=str(path), got=str(error)) from error


def read_tracklets(path: Path) -> list[KittiBox]:
    """Boxes of a raw-data ``tracklet_labels.xml``: velodyne frame, bottom centre, turn about z."""
    boxes = []
    for track, item in enumerate(item for item in xml_elements(path, 2) if item.tag == "item"):
        where = f"{path}: tracklet {track}"
        note_unknown(path.name, [field.tag for field in item], _TRACKLET)
        length, width, height = (xml_number(item, key, where) for key in ("l", "w", "h"))
        size_m = box_size(length, width, height, where)
        first = int(xml_number(item, "first_frame", where))
        label = (item.findtext("objectType") or "").strip().lower()
        for step, pose in enumerate(item.findall("./poses/item")):
            here = f"{where} pose {step}"
            note_unknown(path.name, [field.tag for field in pose], _TRACKLET_POSE)
            tx, ty, tz, rz = (xml_number(pose, key, here) for key in ("tx", "ty", "tz", "rz"))
            boxes.append(KittiBox(first + step, str(track), label, size_m, yaw_matrix(rz, (tx, ty, tz + height / 2))))
    return boxes


def xml_number(element: ElementTree.Element, key: str, where: str, kind: type[int] | type[float] = float) -> Any:
    """A field as a finite number, or as a whole one for ``int``."""
    text = element.findtext(key)
    try:
        value = kind(text or "")
        if kind is float and not np.isfinite(value):
            raise ValueError("not finite")
    except ValueError as error:
        what = f"field {key!r} is missing or no {'finite' if kind is float else 'whole'} number"
        raise InputError(what, where=where, got=repr(text)) from error
    return value


def build_tracks(
    boxes: Sequence[KittiBox],
    world_from_velo: Mapping[int, Matrix],
    times_s: Mapping[int, float],
    where: str,
    velo_at: Callable[[float], Matrix] | None = None,
) -> tuple[list[Track], list[str]]:
    """Tracks in the world from boxes per frame, in the order of their numbers, and notes (splits, boxes left out).
    ``world_from_velo``, ``times_s``: pose of the velodyne f64[4, 4] and time of the scan, seconds, by frame number;
    boxes of other frames are left out. ``velo_at``: pose of the velodyne at any time, when boxes were drawn into scans
    that were still twisted: each box then belongs to the moment its azimuth was measured, and is moved to the scan's
    time with the track's velocity."""
    collected = BoxTracks(where, {label: label for label in LABELS})
    outside = 0
    for box in boxes:
        if box.frame not in world_from_velo:
            outside += 1
            continue
        time_s, pose, late_s = times_s[box.frame], world_from_velo[box.frame], 0.0
        if velo_at is not None:
            x, y = box.pose[:2, 3]
            late_s = float(np.arctan2(y, x)) / (2 * np.pi) * TURN_PERIOD_S
            pose = velo_at(time_s + late_s)
        label, here = collected.label_of(box.label), f"{where}: track {box.track}, frame {box.frame}"
        collected.add(box.track, label, time_s, box.size_m, pose @ box.pose, late_s=late_s, where=here)
    found, notes = collected.tracks(_speeds)
    if outside:
        notes.insert(0, f"{outside} boxes lie in frames that were not imported and were left out")
    return sorted(found, key=lambda track: [int(part) for part in track.id.split(".")]), notes


def _speeds(measured_s: NDArray[np.float64], places: Matrix, pieces: Sequence[NDArray[np.intp]]) -> Matrix:
    """Velocities f64[n, 3] by second-order differences within each piece of a track; 0 where it is one box."""
    velocity = np.zeros_like(places)
    for piece in pieces:
        if len(piece) > 1:
            velocity[piece] = np.gradient(places[piece], measured_s[piece], axis=0)
    return velocity


# importer -----------------------------------------------------------------------------------------
Stamps = Mapping[str, Mapping[int, float]]
"""Camera or LiDAR -> frame number -> seconds."""
LICENCE: Final = "CC BY-NC-SA 3.0 (KITTI: Geiger, Lenz, Stiller, Urtasun; attribution, non-commercial, share-alike)"
FRAME_PERIOD_S: Final = 0.1
CAMERA_NAMES: Final = {"image_02": "front", "image_03": "front_stereo", "image_00": "grey", "image_01": "grey_stereo"}


def looks_like_kitti(source: Path) -> bool:
    """Whether ``source`` is the folder of a KITTI drive, sequence or training set."""
    return any((source / name).is_dir() for name in ("image_02", "image_2", "image_00", "velodyne_points"))


def files_of_kitti(source: Path, options: ImportOptions) -> LogFiles:
    """The folder, with the calibration and poses beside it; of a folder with many sequences or frames only what is
    chosen."""
    beside = sorted(p for p in (*source.parent.glob("calib_*.txt"), *_odometry_poses(source)) if p.is_file())
    wanted, number = options.sequence, int(options.sequence) if options.sequence.isdigit() else -1
    paths = sorted(source.glob("*/*")) if wanted else ()
    chosen = [p for p in paths if p.stem == wanted or (p.stem.isdigit() and int(p.stem) == number)]
    if not chosen:
        return LogFiles((source, *beside))
    here = [path for path in sorted(source.iterdir()) if path.is_file() or path.name == "derived"]
    return LogFiles((*chosen, *here, *beside))


def _odometry_poses(source: Path) -> tuple[Path, ...]:
    """``poses/07.txt`` beside ``sequences/07``."""
    return (source.parent.parent / "poses" / f"{source.name}.txt",) if source.parent.name == "sequences" else ()


def import_kitti(source: Path, out: Path, options: ImportOptions) -> Scene:
    """Import one recording; see the module text for what is understood."""
    drive = _Recording(source, options)
    frames, notes = drive.frames, drive.notes
    world_from_velo = {n: drive.velo_at(drive.scan_s[n]) for n in frames}
    tracks = drive.read_tracks(world_from_velo)
    if frames != list(range(len(frames))):
        notes.append(f"source frames {frames[0]} to {frames[-1]} are frames 0 to {len(frames) - 1} here")
    fits = {}
    for name, paths in drive.images.items():
        camera = drive.calibration.camera(drive.numbers[name], name, *image_size(paths[frames[0]]))
        fits[name] = fit_images(camera, options)

    def convert(index: int) -> Iterable[SceneImage | SceneSweep]:
        number = frames[index]
        for name, found in drive.images.items():
            time_s = drive.image_s[name][number]
            world_from_cam = drive.velo_at(time_s) @ drive.calibration.velo_from_cam(drive.numbers[name])
            yield SceneImage(name, index, time_s, world_from_cam, found[number])
        if number in drive.scans:
            path, time_s = drive.scans[number], drive.scan_s[number]
            points = untwist_scan(read_scan(path), drive.velo_at, time_s) if drive.untwist else read_scan(path)
            yield SceneSweep(SENSOR, index, time_s, world_from_velo[number], points, str(path))

    origin = Source("kitti", LICENCE, None, (*notes, *image_notes(fits)))
    name, items = source.resolve().name, range(len(frames))
    content = SceneContent(
        name, origin, fits, items, convert, lambda n: f"frame {frames[n]}", drive.ego, lambda: (tracks, ())
    )
    return write_scene(content, out, options)


class _Recording:
    """The files of one recording and what they tell, read in the order of the constructor.

    ``images``: scene camera name -> frame number -> file, ``numbers``: its KITTI number; ``scans`` may be empty.
    ``single``: one frame of the object benchmark, without a clock or motion. ``frames``: the numbers that are imported.
    ``image_s`` by camera and frame and ``scan_s`` by frame: seconds since the first frame, which is ``start_s`` in the
    source. ``untwist``: whether scans are to be untwisted with the vehicle's path ``ego``."""

    def __init__(self, folder: Path, options: ImportOptions) -> None:
        self.folder, self.options = folder, options
        self.notes: list[str] = []
        benchmark = (folder / "image_2").is_dir() and (folder / "calib").is_dir()
        self.single = benchmark and not (folder / "times.txt").is_file()
        self._find_files()
        stamps = self._read_stamps()
        self.frames = [self._single_frame()] if self.single else self._complete_frames(stamps)
        self.calibration = self._read_calibration()
        self._set_clock(stamps)
        if options.poses is not None and not options.poses.exists():
            raise InputError("pose file does not exist", where=str(options.poses))
        self._set_motion()
        self._leave_out_unplaced()

    def velo_at(self, time_s: float) -> Matrix:
        """World from velodyne, f64[4, 4]."""
        return common.pose_near(self.ego, time_s) @ self.ego_from_velo

    # --- files and frames ---

    def _find_files(self) -> None:
        sequence, where = "" if self.single else self.options.sequence, str(self.folder)
        images: dict[str, dict[int, Path]] = {}
        for folder in CAMERA_NAMES:
            names = (f"{folder}/data", f"{folder}/{sequence}", f"{folder.replace('_0', '_')}/{sequence}")
            found = [numbered_files(self.folder / name, (".png", ".jpg", ".jpeg")) for name in names]
            if any(found):
                images[folder] = next(files for files in found if files)
        if not images:
            folders = (path for name in ("image_02", "image_2") for path in (self.folder / name).glob("*/"))
            sequences = sorted(path.name for path in folders if path.name != "data")
            if sequences:
                what, got = "the folder holds several sequences", self.options.sequence or "none chosen"
                expected = "--sequence with one of " + ", ".join(sequences[:12])
                raise UsageError(what, where=where, expected=expected, got=got)
            what, expected = "no KITTI images found", "image_02/data, image_02 or image_2 with numbered PNG files"
            remedy, got = "give the folder of one drive, sequence or training set", common.folder_contents(self.folder)
            raise InputError(what, where=where, got=got, expected=expected, remedy=remedy)
        usual = "image_02" if "image_02" in images else next(iter(images))
        available = {folder: CAMERA_NAMES[folder] for folder in images}
        chosen = common.chosen_cameras(available, self.options, where, (usual,))
        self.images = {CAMERA_NAMES[folder]: images[folder] for folder in chosen}
        self.numbers = {CAMERA_NAMES[folder]: int(folder[-1]) for folder in chosen}
        scans = numbered_files(self.folder / "velodyne_points" / "data", (".bin",))
        self.scans = scans or numbered_files(self.folder / "velodyne" / sequence, (".bin",))
        self._streams = {**self.images, **({SENSOR: self.scans} if self.scans else {})}

    def _single_frame(self) -> int:
        numbers, options = list(next(iter(self.images.values()))), self.options
        if options.sequence.isdigit() and int(options.sequence) in numbers:
            numbers = [int(options.sequence)]
        if options.frames is not None:
            numbers = [n for n in numbers if options.frames[0] <= n < options.frames[1]]
        if len(numbers) != 1:
            what, where = "an object-benchmark folder holds unrelated frames; a scene is one of them", str(self.folder)
            got = f"{len(numbers)} frames: {common.number_ranges(numbers)}"
            raise UsageError(what, where=where, expected="--sequence with one frame number, e.g. 000008", got=got)
        if self.scans and numbers[0] not in self.scans:
            where = str(self.folder / "velodyne")
            raise InputError("frame has no scan", where=where, expected=f"{numbers[0]:06d}.bin")
        return numbers[0]

    def _complete_frames(self, stamps: Stamps) -> list[int]:
        """The frames that all chosen cameras and scans have, with a time stamp where there are any."""
        streams, recorded = self._streams, set().union(*self._streams.values())
        stamped = {
            f"timestamps of {name}": recorded - (set(streams[name]) - set(times)) for name, times in stamps.items()
        }
        frames = common.complete_frames({**streams, **stamped}, self.options, str(self.folder), "kitti")
        if not self.scans:
            log.warn("kitti: no scans found: the scene has images only, and there is nothing to fuse")
        return frames

    def _read_calibration(self) -> KittiCalibration:
        name = f"{self.frames[0]:06d}" if self.single else self.options.sequence
        path = common.first_file(self.folder / "calib.txt", self.folder / "calib" / f"{name}.txt")
        if path is not None:
            return read_calibration_text(path)
        for day in (self.folder, self.folder.parent):
            if (day / "calib_cam_to_cam.txt").is_file():
                return read_calibration_day(day)
        expected = "calib.txt, or calib_cam_to_cam.txt and calib_velo_to_cam.txt here or one folder up"
        remedy = "download the day's calibration archive and unpack it beside the drive"
        raise InputError("no calibration found", where=str(self.folder), expected=expected, remedy=remedy)

    # --- time ---

    def _read_stamps(self) -> Stamps:
        """The source's times; nothing where a camera has none."""
        shared = self.folder / "times.txt"
        paths: dict[str, Path | None] = {}
        for name, found in self.images.items():
            folder = next(iter(found.values())).parent
            paths[name] = common.first_file(folder.parent / "timestamps.txt", folder / "timestamps.txt", shared)
        files = [path for path in paths.values() if path is not None]
        if self.single or len(files) < len(paths):
            return {}
        if self.scans:
            paths[SENSOR] = common.first_file(self.folder / "velodyne_points" / "timestamps.txt", shared, *files)
        first, end = self.options.frames or (0, 2**63)
        stamps = {}
        for name, path in paths.items():
            numbers = list(self._streams[name])
            last = max((n for n in numbers if first <= n < end), default=-1)
            if path is not None:
                stamps[name] = read_timestamps(path, numbers, last)
        return stamps

    def _set_clock(self, stamps: Stamps) -> None:
        """The recording's clock: measured, or 10 Hz from the first frame on, which is noted."""
        self.start_s, self._measured = 0.0, bool(stamps)
        if not stamps:
            if not self.single:
                self.notes.append("no timestamps in the source: 10 Hz assumed, image and scan of a frame at one moment")
            self.scan_s = {n: (n - self.frames[0]) * FRAME_PERIOD_S for n in self.frames}
            self.image_s = dict.fromkeys(self.images, self.scan_s)
            return
        chosen = {name: {n: times[n] for n in self.frames} for name, times in stamps.items()}
        for stream, times in chosen.items():
            common.seconds(list(times.values()), "s", f"{self.folder}: {stream}")
        scan_s = chosen.get(SENSOR, next(iter(chosen.values())))
        self.start_s = scan_s[self.frames[0]]
        self.image_s = {name: {n: t - self.start_s for n, t in times.items()} for name, times in chosen.items()}
        self.scan_s = self.image_s.get(SENSOR) or next(iter(self.image_s.values()))

    # --- motion ---

    def _set_motion(self) -> None:
        """The vehicle's motion from GPS/IMU packets (a folder, or the sequence's file), else from a pose file."""
        self.ego_from_velo, self.untwist = np.eye(4), self.options.untwist == "yes"
        oxts, poses = self.folder / "oxts", self.options.poses
        packets = poses or oxts / "data"
        if poses is None and not packets.is_dir():
            packets = oxts / f"{self.options.sequence}.txt"
        if not (packets.is_dir() or (poses is None and packets.is_file())):
            ego = self._ego_from_file()
        else:
            velo_from_imu, where = self.calibration.velo_from_imu, self.calibration.source
            if velo_from_imu is None:
                what, expected = "calibration does not tell where the IMU is", "calib_imu_to_velo.txt or Tr_imu_to_velo"
                remedy = "add it, or give a pose file with --poses"
                raise InputError(what, where=where, expected=expected, remedy=remedy)
            self.notes.append("poses from GPS/IMU packets")
            ego = self._ego_from_packets(packets)
            raw_scans = any(path.parent.name == "data" for path in self.scans.values())
            self.ego_from_velo = invert(velo_from_imu)
            self.untwist |= self.options.untwist == "auto" and raw_scans
        self.ego = common.mended_path(ego, self.notes)
        self.untwist &= len(self.frames) > 1
        if self.untwist:
            self.notes.append("scans untwisted: counter-clockwise turn of 0.1 s, forward at the scan's time")

    def _ego_from_file(self) -> EgoPath:
        """The velodyne's path at the scans; the world is the velodyne of the first frame."""
        frames, folder = self.frames, self.folder
        names = ("poses_velo.txt", "poses.txt", "poses_cam0.txt")
        found = [parent / name for parent in (folder, folder / "derived") for name in names]
        path = self.options.poses or common.first_file(*found, *_odometry_poses(folder))
        if path is None and len(frames) == 1:
            return EgoPath(np.array([self.scan_s[frames[0]]]), np.eye(4)[None])
        if path is None:
            expected = "oxts/data, poses.txt, derived/poses_velo.txt or --poses FILE"
            remedy = "without poses the frames of a moving vehicle cannot be put into one world"
            raise InputError("no vehicle poses found", where=str(folder), expected=expected, remedy=remedy)
        self.notes.append(f"poses from {path.name}")
        poses, sensor = read_pose_file(path, frames)
        known = self._known(frames, poses, "pose file lacks frames", path)
        stacked = np.stack([poses[n] for n in known])
        if sensor == "cam0":
            rect0_from_velo = self.calibration.rect0_from_velo
            stacked = invert(rect0_from_velo) @ stacked @ rect0_from_velo
        self.notes.append(common.origin_note(stacked[0]))
        return EgoPath(np.array([self.scan_s[n] for n in known]), invert(stacked[0]) @ stacked)

    def _ego_from_packets(self, path: Path) -> EgoPath:
        packets = read_packets(path, self.frames)
        self._known(self.frames, packets, "GPS/IMU packets are missing", path)
        times_file = path.parent / "timestamps.txt"
        numbers = list(packets)
        if self._measured and times_file.is_file():
            measured = read_timestamps(times_file, numbers, numbers[-1])
            numbers = self._known(numbers, measured, "GPS/IMU packets have no timestamps", times_file)
            times = np.array([measured[n] for n in numbers]) - self.start_s
        else:
            times = np.interp(numbers, self.frames, [self.scan_s[n] for n in self.frames])
        later = np.r_[True, np.diff(np.maximum.accumulate(times)) > 0]
        poses = poses_from_packets(np.stack([packets[n] for n in numbers]), str(path))
        return EgoPath(times[later], poses[later])

    def _known(self, frames: Sequence[int], there: Container[int], what: str, path: Path) -> list[int]:
        """The frames that are ``there``; lost ones are refused unless frames may be left out."""
        missing = [n for n in frames if n not in there]
        if missing and (not self.options.skip_missing or len(missing) == len(frames)):
            got = f"nothing for frames {common.number_ranges(missing)}"
            remedy = "copy them, choose frames with --frames FIRST:END, or add --skip-missing"
            raise InputError(what, where=str(path), got=got, remedy=remedy)
        return [n for n in frames if n in there]

    def _leave_out_unplaced(self) -> None:
        """Keep the frames whose image and scan lie where the vehicle's path is known; if frames may not be left out,
        whoever asks for a pose refuses the others."""
        if not self.options.skip_missing:
            return
        reach_s = TURN_PERIOD_S / 2 if self.untwist else 0.0
        lost = []
        for n in self.frames:
            times = [*(found[n] for found in self.image_s.values()), self.scan_s[n] - reach_s, self.scan_s[n] + reach_s]
            if not all(common.has_pose(self.ego, time_s) for time_s in times):
                lost.append(n)
        if len(lost) == len(self.frames):
            self.velo_at(self.scan_s[lost[0]])  # says what is wrong
            raise InputError("no frame has a vehicle pose", where=str(self.folder))
        if lost:
            log.warn(f"kitti: left out frames without a vehicle pose: {common.number_ranges(lost)}")
            self.frames = [n for n in self.frames if n not in lost]

    # --- boxes ---

    def read_tracks(self, world_from_velo: Mapping[int, Matrix]) -> list[Track]:
        """Tracks, told of in ``notes``; no box file is no tracks."""
        folder, boxes_file = self.folder, self.options.boxes
        if boxes_file is not None and not boxes_file.is_file():
            raise InputError("box file does not exist", where=str(boxes_file))
        names = ("tracklet_labels.xml", "label_02.txt", f"label_02/{self.options.sequence}.txt")
        paths = [*(folder / name for name in names), *(folder / "derived" / name for name in names[:2])]
        object_label = folder / "label_2" / f"{self.frames[0]:06d}.txt"
        found = boxes_file or common.first_file(*paths, *([object_label] if self.single else []))
        if found is None:
            self.notes.append("no boxes found: everything counts as static")
            return []
        if found.suffix == ".xml":
            boxes = read_tracklets(found)
        else:
            frame = self.frames[0] if self.single and found in (boxes_file, object_label) else None
            boxes = read_label_text(found, self.calibration.rect0_from_velo, frame)
        velo_at = self.velo_at if self.untwist else None
        tracks, notes = build_tracks(boxes, world_from_velo, self.scan_s, str(found), velo_at)
        self.notes += [f"boxes from {found.name}", *notes]
        return tracks
