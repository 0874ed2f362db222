"""Waymo logs of format 1: one TFRecord file with a ``Frame`` message per record; read one record at a time.

Layout of a record: u64 length, u32 masked CRC32C of these eight bytes, the payload, u32 masked CRC32C of the payload,
all little-endian. A mask turns the sum by 15 bits to the right and adds a constant.

Source: TensorFlow's documentation of the format; CRC32C is the Castagnoli polynomial of RFC 3720.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any, BinaryIO, Final

import numpy as np
from numpy.typing import NDArray

from mudg.base import log, store
from mudg.base.errors import InputError
from mudg.formats.importers.common import arrow_files, require_columns
from mudg.formats.importers.waymo import records
from mudg.formats.importers.waymo.records import CAMERAS, CONTEXT, FRAME, LASERS, FrameRecord, LaserScan, parse_message
from mudg.formats.unknown_fields import note_unknown

MAX_RECORD_BYTES: Final = 512 * 1024 * 1024
"""Real frames have 3 to 8 MB; what declares more than this is refused before any memory is taken."""

_HEADER_BYTES: Final = 12
_FOOTER_BYTES: Final = 4
_MASK_DELTA: Final = 0xA282EAD8
_POLYNOMIAL_REFLECTED: Final = 0x82F63B78

SPARSE_MULTIPLES: Final = ((5685, (1362, 426, 0)), (290, (136, 113, 107, 32, 0)))
"""Multiples of the CRC32C polynomial with few terms, as (degree, lower exponents): x^5685 + x^1362 + x^426 + 1, and one
of degree 290. Squaring a polynomial over GF(2) six times multiplies its exponents by 64, so each is also a multiple
whose terms lie whole 64-bit words apart: a word may be removed by adding it to the words that many places further
on."""


# --- checksums ------------------------------------------------------------------------------------


_TABLE: Final = list(range(256))
for _ in range(8):
    _TABLE[:] = [(value >> 1) ^ (_POLYNOMIAL_REFLECTED if value & 1 else 0) for value in _TABLE]


def crc32c(data: bytes | memoryview) -> int:
    """CRC-32C of ``data``, 0 .. 2^32 - 1.

    Long data is first folded: leading words are added (exclusive or) to later ones, where a sparse multiple of the
    polynomial says that the remainder stays the same. That needs three additions a word and runs at memory speed in
    numpy; the two kilobytes that are left go through the usual table.
    """
    count = len(data)
    if count < 64:
        return _through_table(data, 0xFFFFFFFF) ^ 0xFFFFFFFF
    padding = -count % 8
    padded = np.zeros(padding + count, np.uint8)  # zeros in front change nothing once the start value is in the data
    padded[padding:] = np.frombuffer(data, np.uint8)
    padded[padding : padding + 4] ^= 0xFF
    words = padded.view("<u8")
    start = 0
    for degree, lower in SPARSE_MULTIPLES:
        step = degree - lower[0]
        while (left := len(words) - start - degree) > 0:
            size = min(step, left)
            leading = words[start : start + size]
            for exponent in lower:
                place = start + degree - exponent
                words[place : place + size] ^= leading
            start += size
    return _through_table(words[start:].tobytes(), 0) ^ 0xFFFFFFFF


def _through_table(data: bytes | memoryview, crc: int) -> int:
    table = _TABLE
    for byte in bytes(data):
        crc = table[(crc ^ byte) & 0xFF] ^ (crc >> 8)
    return crc


def masked_crc32c(data: bytes | memoryview) -> int:
    """The checksum as TFRecord files store it."""
    crc = crc32c(data)
    return (((crc >> 15) | (crc << 17)) + _MASK_DELTA) & 0xFFFFFFFF


# --- records of a file ----------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class RecordPlace:
    """Where a record lies: its number, the byte offset of its header, and the length of its payload."""

    number: int
    offset: int
    length: int


def record_places(path: Path) -> Iterator[RecordPlace]:
    """The records of a file in order; only headers are read, and their checksums compared. Raises InputError: not a
    TFRecord file, cut off, a damaged header, or a length that no record has."""
    try:
        with store.open_file(path) as file:
            size = file.seek(0, 2)
            offset, number = 0, 0
            while offset < size:
                file.seek(offset)
                place = _read_header(file, path, number, offset, size)
                yield place
                offset += _HEADER_BYTES + place.length + _FOOTER_BYTES
                number += 1
    except OSError as error:
        raise InputError("TFRecord file cannot be read", where=str(path), got=str(error)) from error


def _read_header(file: BinaryIO, path: Path, number: int, offset: int, size: int) -> RecordPlace:
    where = _where(path, number, offset)
    header = file.read(_HEADER_BYTES)
    if len(header) < _HEADER_BYTES:
        raise _cut_off(where, f"{len(header)} of {_HEADER_BYTES} header bytes")
    length, crc = struct.unpack("<QI", header)
    if masked_crc32c(header[:8]) != crc:
        if number:
            expected = "a length that fits its checksum"
            raise InputError("record header is damaged", where=where, expected=expected, remedy="copy the file again")
        packed = header[:2] == b"\x1f\x8b"
        what, got = "file is compressed" if packed else "file is not a TFRecord", f"{size} bytes starting {header!r}"
        remedy = "unpack it with gunzip" if packed else "is it a download page, a placeholder, or of another format?"
        raise InputError(what, where=str(path), expected="a record's length and its checksum", got=got, remedy=remedy)
    if length > MAX_RECORD_BYTES:
        what = "record declares a length that no frame has"
        raise InputError(what, where=where, expected=f"at most {MAX_RECORD_BYTES} bytes", got=f"{length} bytes")
    if offset + _HEADER_BYTES + length + _FOOTER_BYTES > size:
        raise _cut_off(where, f"{size - offset - _HEADER_BYTES} of {length + _FOOTER_BYTES} bytes")
    return RecordPlace(number, offset, length)


def read_record(file: BinaryIO, path: Path, place: RecordPlace) -> bytes:
    """The payload of a record, its checksum compared. Raises InputError: cut off since the headers were read, or
    damaged."""
    where = _where(path, place.number, place.offset)
    file.seek(place.offset + _HEADER_BYTES)
    content = file.read(place.length + _FOOTER_BYTES)
    if len(content) != place.length + _FOOTER_BYTES:
        raise _cut_off(where, f"{len(content)} of {place.length + _FOOTER_BYTES} bytes")
    payload = content[: place.length]
    (crc,) = struct.unpack("<I", content[place.length :])
    if masked_crc32c(payload) != crc:
        what = "record is damaged: its bytes do not fit their checksum"
        got = f"{masked_crc32c(payload):#010x} over {place.length} bytes"
        remedy = "copy the file again, or choose other frames with --frames FIRST:END"
        raise InputError(what, where=where, expected=f"checksum {crc:#010x}", got=got, remedy=remedy)
    return payload


def _where(path: Path, number: int, offset: int) -> str:
    return f"{path}: record {number} at byte {offset}"


def _cut_off(where: str, got: str) -> InputError:
    what = "TFRecord file is cut off"
    return InputError(what, where=where, expected="a whole record", got=got, remedy="copy the file again")


# --- the log --------------------------------------------------------------------------------------


class TfrecordLog:
    """A TFRecord file. Opening it reads the wanted records once, compares all their checksums and keeps what is small.
    Raises InputError: the file or a wanted record is damaged, or no Waymo frame. ``path``: the file. ``wanted``: record
    numbers (first, end) to keep, or None."""

    form = "v1 TFRecord"

    def __init__(self, path: Path, wanted: tuple[int, int] | None = None) -> None:
        self._path = path
        self._places: dict[int, RecordPlace] = {}
        first, end = wanted or (0, None)
        places = list(islice(record_places(path), first, end))
        if not places:
            expected = "records" + (f" {first} to {end - 1}" if end is not None else "")
            raise InputError("no frames to import", where=str(path), expected=expected, got="none")
        frames: list[FrameRecord] = []
        context = b""
        with store.open_file(path) as file, log.task("checking records", len(places)) as bar:
            for place in places:
                where = f"{path}: record {place.number} at byte {place.offset}"
                message = parse_message(read_record(file, path, place), FRAME, where)
                if not frames:
                    context = bytes(message.get("context", b""))
                    self._read_context(context, where)
                elif bytes(message.get("context", b"")) != context:
                    self._compare_context(bytes(message.get("context", b"")), where)
                frames.append(_frame_record(message, place.number, where))
                self._places[place.number] = place
                bar.advance()
        self.frames: Sequence[FrameRecord] = frames

    def _read_context(self, content: bytes, where: str) -> None:
        context = parse_message(content, CONTEXT, where)
        self.name = str(context.get("name", "")) or self._path.stem
        cameras, lasers = _named(context["cameras"], CAMERAS), _named(context["lasers"], LASERS)
        self.cameras: Mapping[str, records.CameraCalibration]
        self.cameras = {name: _camera(name, item, where) for name, item in cameras}
        self.lasers: Mapping[str, records.LaserCalibration] = {name: _laser(name, item, where) for name, item in lasers}
        stats = context.get("stats", {})
        self.conditions = ", ".join(stats[key] for key in ("time_of_day", "weather", "location") if stats.get(key))

    def _compare_context(self, content: bytes, where: str) -> None:
        """Statistics may differ from frame to frame; the log and its calibrations may not."""
        context = parse_message(content, CONTEXT, where)
        if str(context.get("name", "")) not in ("", self.name):
            raise InputError("the file mixes two logs", where=where, expected=self.name, got=context["name"])
        for name, item in _named(context["cameras"], CAMERAS):
            if _camera(name, item, where) != self.cameras.get(name):
                raise InputError("a camera's calibration changes within the log", where=f"{where}: camera {name}")

    def read(self, frame: FrameRecord, cameras: Sequence[str]) -> records.FrameContent:
        """The bulky parts of a frame; see ``WaymoLog``."""
        message = self._message(frame)
        images: dict[str, bytes] = {}
        panoptic: dict[str, records.Panoptic] = {}
        for name, item in _named(message["images"], CAMERAS):
            if name in cameras:
                images[name] = bytes(item.get("image", b""))
                label = item.get("panoptic", {})
                if label.get("png"):
                    panoptic[name] = records.Panoptic(label.get("divisor", 0), bytes(label["png"]))
        scans = {
            name: _scan(item, f"{frame.where}: LiDAR {name}")
            for name, item in _named(message["lasers"], LASERS)
            if _has_ranges(item)
        }
        return records.FrameContent(images, panoptic, scans)

    def pixel_poses(self, frame: FrameRecord) -> NDArray[np.float32] | None:
        """Poses of the top LiDAR's pixels f32[H, W, 6]; see ``WaymoLog``."""
        for name, item in _named(self._message(frame)["lasers"], LASERS):
            if name == records.TOP and item.get("return1", {}).get("poses"):
                return records.float_image(item["return1"]["poses"], 6, f"{frame.where}: pixel poses")
        return None

    def _message(self, frame: FrameRecord) -> dict[str, Any]:
        with store.open_file(self._path) as file:
            return parse_message(read_record(file, self._path, self._places[frame.number]), FRAME, frame.where)


def _named(items: Sequence[dict[str, Any]], names: Mapping[int, str]) -> Iterator[tuple[str, dict[str, Any]]]:
    """Messages of sensors with their names; sensors of other numbers are passed over."""
    return ((names[item["name"]], item) for item in items if item.get("name", 0) in names)


def _has_ranges(laser: dict[str, Any]) -> bool:
    return bool(laser.get("return1", {}).get("ranges"))


def _sixteen(message: dict[str, Any], key: str) -> NDArray[np.float64]:
    return message.get(key, {}).get("values", np.zeros(0))


def _camera(name: str, item: dict[str, Any], where: str) -> records.CameraCalibration:
    image = item.get("width", 0), item.get("height", 0), item.get("direction", 0)
    return records.camera_of(name, item["intrinsic"], _sixteen(item, "extrinsic"), image, where)


def _laser(name: str, item: dict[str, Any], where: str) -> records.LaserCalibration:
    limits = item.get("inclination_min", np.nan), item.get("inclination_max", np.nan)
    return records.laser_of(name, item["inclinations"], limits, _sixteen(item, "extrinsic"), where)


def _shot(item: dict[str, Any], where: str) -> records.CameraShot:
    velocity, pose = item.get("velocity"), records.transform_of(_sixteen(item, "pose"), f"{where}: pose")
    if velocity is not None:
        velocity = np.array([velocity.get(key, 0.0) for key in records.VELOCITY])
    times = (item.get(key, 0.0) for key in ("shutter_s", "trigger_s", "done_s"))
    return records.CameraShot(pose, item.get("pose_time_s", 0.0), velocity, *times)


def _frame_record(message: dict[str, Any], number: int, where: str) -> FrameRecord:
    timestamp_us = message.get("timestamp_us", 0)
    images = [(name, item) for name, item in _named(message["images"], CAMERAS) if item.get("image")]
    shots = ((name, _shot(item, f"{where}: image of camera {name}")) for name, item in images)
    shots = records.by_name(shots, timestamp_us, where)
    lasers = records.each_once([name for name, item in _named(message["lasers"], LASERS) if _has_ranges(item)], where)
    boxes = []
    for item in message["labels"]:
        box = item.get("box", {})
        values = [box.get(key, np.nan) for key in ("x", "y", "z", "length", "width", "height")]
        boxes.append(records.box_of(item.get("id", ""), item.get("type", 0), [*values, box.get("heading", 0.0)], where))
    pose = records.transform_of(_sixteen(message, "pose"), f"{where}: pose")
    return FrameRecord(number, timestamp_us, pose, shots, lasers, tuple(boxes), where)


def _scan(item: dict[str, Any], where: str) -> LaserScan:
    parts = [item[key] for key in ("return1", "return2") if item.get(key, {}).get("ranges")]
    returns = [records.float_image(part["ranges"], 4, where) for part in parts]
    packed = item["return1"].get("poses")
    return LaserScan(returns, records.float_image(packed, 6, f"{where}: pixel poses") if packed else None)


# --- format 2: a folder per component (``camera_image``, ``lidar``, ...) with one Parquet file per log ----------------
#
# Rows are read one at a time and in the order of the file, so that memory stays at one page of a column; the keys of
# all rows are read first and tell which row belongs to which frame.
_SEGMENT: Final = "key.segment_context_name"
_TIME: Final = "key.frame_timestamp_micros"
_CAMERA: Final = "key.camera_name"
_LASER: Final = "key.laser_name"
_OBJECT: Final = "key.laser_object_id"
_INTRINSIC: Final = ("f_u", "f_v", "c_u", "c_v", "k1", "k2", "p1", "p2", "k3")


def _component(title: str, names: str = "", **parts: str) -> tuple[str, tuple[str, ...]]:
    """Title and columns of a component: plain ``names``, and those of the parts ``part.name``."""
    inner = (f"{part}.{name}" for part, within in parts.items() for name in within.split())
    return f"{title}Component", (*names.split(), *inner)


_VELOCITY: Final = tuple(f"velocity.{kind}_velocity.{axis}" for kind in ("linear", "angular") for axis in "xyz")
_EXPOSURE: Final = tuple(
    f"rolling_shutter_params.{name}" for name in ("shutter", "camera_trigger_time", "camera_readout_done_time")
)
_BOX: Final = (*(f"box.{part}.{axis}" for part in ("center", "size") for axis in "xyz"), "box.heading")
_STREAM_BYTES: Final = 1 << 20
_TWO_RETURNS: Final = {"range_image_return1": "values shape", "range_image_return2": "values shape"}
OFFICIAL: Final[Mapping[str, tuple[str, tuple[str, ...]]]] = {
    "camera_image": _component(
        "CameraImage", " ".join(("image pose.transform pose_timestamp", *_VELOCITY, *_EXPOSURE))
    ),
    "camera_calibration": _component(
        "CameraCalibration",
        "extrinsic.transform width height rolling_shutter_direction",
        intrinsic=" ".join(_INTRINSIC),
    ),
    "camera_segmentation": _component(
        "CameraSegmentationLabel",
        "panoptic_label panoptic_label_divisor sequence_id num_cameras_covered",
        instance_id_to_global_id_mapping="local_instance_ids global_instance_ids is_tracked",
    ),
    "lidar": _component("LiDAR", **_TWO_RETURNS),
    "lidar_box": _component(
        "LiDARBox",
        " ".join(("type num_lidar_points_in_box num_top_lidar_points_in_box", *_BOX)),
        speed="x y z",
        acceleration="x y z",
        difficulty_level="detection tracking",
    ),
    "lidar_calibration": _component("LiDARCalibration", "extrinsic.transform", beam_inclination="min max values"),
    "lidar_pose": _component("LiDARPose", range_image_return1="values shape"),
    "stats": _component(
        "Stats", "time_of_day location weather", lidar_object_counts="types counts", camera_object_counts="types counts"
    ),
    "vehicle_pose": _component("VehiclePose", "world_from_vehicle.transform"),
}
"""Folders that are read -> name of the component, and its columns, read or not. Source: the data set's published
components."""
_KEYS: Final = (_SEGMENT, _TIME, _CAMERA, _LASER, _OBJECT, "index", "__index_level_0__")
"""Columns that every table may have; the last two are the index of pandas."""

REQUIRED: Final = ("camera_image", "camera_calibration", "vehicle_pose")
"""Components without which there is no scene."""


class ParquetLog:
    """One log of a format-2 folder. Opening it reads all small tables and the keys of the large ones. Raises
    InputError: a component is missing, or a table is damaged or contradictory. ResourceError: pyarrow is not installed.
    ``root``: folder with the component folders. ``segment``: name of the log, that of its files. ``wanted``: frames
    (first, end) in the order of time, or None."""

    form = "v2 Parquet"

    def __init__(self, root: Path, segment: str, wanted: tuple[int, int] | None = None) -> None:
        self._root, self.name = root, segment
        self.cameras: Mapping[str, records.CameraCalibration] = dict(_cameras(self._need("camera_calibration")))
        self._images, self._vehicle = self._need("camera_image"), self._need("vehicle_pose")
        self._lidar, self._poses = self._table("lidar"), self._table("lidar_pose")
        self._labels = self._table("camera_segmentation")
        calibration = self._table("lidar_calibration") if self._lidar is None else self._need("lidar_calibration")
        self.lasers: Mapping[str, records.LaserCalibration] = {} if calibration is None else dict(_lasers(calibration))
        if self._lidar is not None and self._poses is None:
            what = "the top LiDAR's pixel poses are missing"
            remedy = "download the component: without it the scans of a moving vehicle are twisted"
            raise InputError(what, where=str(root), expected=f"lidar_pose/{segment}.parquet", remedy=remedy)
        self.frames: Sequence[FrameRecord] = self._frames(wanted)
        self.conditions = self._conditions()

    def read(self, frame: FrameRecord, cameras: Sequence[str]) -> records.FrameContent:
        """The bulky parts of a frame; see ``WaymoLog``. Reading frames in the order of time is fastest."""
        time = frame.timestamp_us
        images = {
            name: bytes(self._images.value(row, "[CameraImageComponent].image"))
            for name, row in self._images.rows(time, _CAMERA, CAMERAS)
            if name in cameras
        }
        panoptic: dict[str, records.Panoptic] = {}
        for name, row in self._labels.rows(time, _CAMERA, CAMERAS) if self._labels is not None else ():
            if name in cameras and self._labels is not None:
                column = "[CameraSegmentationLabelComponent].panoptic_label"
                png, divisor = self._labels.value(row, column), self._labels.value(row, f"{column}_divisor")
                panoptic[name] = records.Panoptic(int(divisor), bytes(png))
        scans: dict[str, LaserScan] = {}
        if self._lidar is not None:
            for name, row in self._lidar.rows(time, _LASER, LASERS):
                if name in frame.lasers:
                    scans[name] = self._scan(self._lidar, frame, name, row)
        return records.FrameContent(images, panoptic, scans)

    def pixel_poses(self, frame: FrameRecord) -> NDArray[np.float32] | None:
        """Poses of the top LiDAR's pixels f32[H, W, 6]; see ``WaymoLog``."""
        if self._poses is not None:
            for name, row in self._poses.rows(frame.timestamp_us, _LASER, LASERS):
                if name == records.TOP:
                    return self._poses.image(row, "[LiDARPoseComponent].range_image_return1", 6)
        return None

    def _scan(self, lidar: ParquetTable, frame: FrameRecord, name: str, row: int) -> LaserScan:
        found = [lidar.image(row, f"[LiDARComponent].range_image_return{n}", 4) for n in (1, 2)]
        poses = self.pixel_poses(frame) if name == records.TOP else None
        if name == records.TOP and poses is None:
            what = "frame has no pixel poses"
            raise InputError(what, where=f"{frame.where}: lidar_pose", expected="a row for the top LiDAR")
        return LaserScan([image for image in found if image is not None], poses)

    # --- facts ------------------------------------------------------------------------------------

    def _frames(self, wanted: tuple[int, int] | None) -> list[FrameRecord]:
        where, column = str(self._vehicle.path), "[VehiclePoseComponent].world_from_vehicle.transform"
        table = self._vehicle.columns((_SEGMENT, _TIME, column))
        others = {str(name) for name in table[_SEGMENT]} - {self.name}
        if others:
            what = "the file holds other logs"
            raise InputError(what, where=where, expected=self.name, got=", ".join(sorted(others)[:4]))
        poses = {int(time): pose for time, pose in zip(table[_TIME], table[column], strict=True)}
        twice = len(table[_TIME]) - len(poses)
        if twice:
            raise InputError("the table has a frame twice", where=f"{where}: {_TIME}", got=f"{twice} times")
        chosen = list(enumerate(sorted(poses)))[slice(*wanted) if wanted else slice(None)]
        if not chosen:
            what = "no frames to import"
            raise InputError(what, where=where, got=f"{len(poses)} frames", expected=f"frames {wanted}")
        shots, boxes = self._shots(), self._boxes()
        frames = []
        for number, time in chosen:
            here = f"{self._root}: {self.name}, frame {number}"
            lasers = [] if self._lidar is None else [name for name, _ in self._lidar.rows(time, _LASER, LASERS)]
            pose, found = records.transform_of(poses[time], here), records.by_name(shots.get(time, ()), time, here)
            names = records.each_once(lasers, here)
            frames.append(FrameRecord(number, time, pose, found, names, tuple(boxes.get(time, ())), here))
        return frames

    def _shots(self) -> dict[int, list[tuple[str, records.CameraShot]]]:
        shots: dict[int, list[tuple[str, records.CameraShot]]] = {}
        names, optional = ("pose.transform", "pose_timestamp"), (*_EXPOSURE, *_VELOCITY)
        for where, row in self._images.records("CameraImageComponent", (_TIME, _CAMERA), names, optional):
            if row[_CAMERA] in CAMERAS:
                speeds = [row[name] for name in _VELOCITY]
                velocity = None if None in speeds else np.array(speeds, np.float64)
                exposure = (float(row[name] or 0.0) for name in _EXPOSURE)
                pose = records.transform_of(row["pose.transform"], where)
                shot = records.CameraShot(pose, float(row["pose_timestamp"]), velocity, *exposure)
                shots.setdefault(int(row[_TIME]), []).append((CAMERAS[row[_CAMERA]], shot))
        return shots

    def _boxes(self) -> dict[int, list[records.WaymoBox]]:
        table, boxes = self._table("lidar_box"), {}
        if table is not None:
            for where, row in table.records("LiDARBoxComponent", (_TIME, _OBJECT), ("type", *_BOX)):
                box = records.box_of(str(row[_OBJECT]), row["type"], [row[name] for name in _BOX], where)
                boxes.setdefault(int(row[_TIME]), []).append(box)
        return boxes

    def _conditions(self) -> str:
        table = self._table("stats")
        if table is None:
            return ""
        names = tuple(f"[StatsComponent].{name}" for name in ("time_of_day", "weather", "location"))
        found = table.columns((), optional=names)
        return ", ".join(str(found[name][0]) for name in names if found[name] and found[name][0])

    def _table(self, component: str) -> ParquetTable | None:
        path = self._root / component / f"{self.name}.parquet"
        if not path.is_file():
            return None
        table, (prefix, columns) = ParquetTable(path), OFFICIAL[component]
        known = frozenset((*_KEYS, *(f"[{prefix}].{name}" for name in columns)))
        note_unknown(f"{component}/*.parquet", table.names, known)
        return table

    def _need(self, component: str) -> ParquetTable:
        table = self._table(component)
        if table is None:
            what, expected = "a component of the log is missing", f"{component}/{self.name}.parquet"
            raise InputError(what, where=str(self._root), expected=expected, remedy="download it beside the others")
        return table


def _cameras(table: ParquetTable) -> Iterator[tuple[str, records.CameraCalibration]]:
    names, direction = [f"intrinsic.{name}" for name in _INTRINSIC], "rolling_shutter_direction"
    required = (*names, "extrinsic.transform", "width", "height")
    for where, row in table.records("CameraCalibrationComponent", (_CAMERA,), required, (direction,)):
        if row[_CAMERA] in CAMERAS:
            name, image = CAMERAS[row[_CAMERA]], (int(row["width"]), int(row["height"]), int(row[direction] or 0))
            yield name, records.camera_of(name, [row[n] for n in names], row["extrinsic.transform"], image, where)


def _lasers(table: ParquetTable) -> Iterator[tuple[str, records.LaserCalibration]]:
    low, high, beams = (f"beam_inclination.{name}" for name in ("min", "max", "values"))
    required = ("extrinsic.transform", low, high)
    for where, row in table.records("LiDARCalibrationComponent", (_LASER,), required, (beams,)):
        if row[_LASER] in LASERS:
            name, limits = LASERS[row[_LASER]], (float(row[low]), float(row[high]))
            yield name, records.laser_of(name, row[beams] or (), limits, row["extrinsic.transform"], where)


# --- tables ---------------------------------------------------------------------------------------


class ParquetTable:
    """A Parquet file: whole columns of small values, or single large values row by row. Raises InputError: not a
    Parquet file, damaged, or a column is missing. ResourceError: pyarrow is not installed."""

    def __init__(self, path: Path) -> None:
        self.path = path
        with arrow_files(path):
            from pyarrow.parquet import ParquetFile

            self._file = ParquetFile(
                store.regular(path), buffer_size=_STREAM_BYTES, pre_buffer=False, page_checksum_verification=True
            )
        self.names: tuple[str, ...] = tuple(self._file.schema_arrow.names)
        counts = [self._file.metadata.row_group(n).num_rows for n in range(self._file.num_row_groups)]
        self._starts = np.concatenate([[0], np.cumsum(counts, dtype=np.int64)])
        self._by_time: dict[str, dict[int, list[tuple[str, int]]]] = {}
        self._streams: dict[tuple[str, ...], tuple[int, Iterator[Any]]] = {}

    def records(
        self, component: str, keys: Sequence[str], names: Sequence[str], optional: Sequence[str] = ()
    ) -> Iterator[tuple[str, dict[str, Any]]]:
        """Place and plain values of every row: ``keys``, and columns of the component under their short ``names``."""
        full = {name: f"[{component}].{name}" for name in (*names, *optional)}
        table = self.columns((*keys, *(full[name] for name in names)), [full[name] for name in optional])
        columns = {**{key: table[key] for key in keys}, **{name: table[column] for name, column in full.items()}}
        for index, row in enumerate(zip(*columns.values(), strict=True)):
            yield f"{self.path}: row {index}", dict(zip(columns, row, strict=True))

    def columns(self, names: Sequence[str], optional: Sequence[str] = ()) -> dict[str, list[Any]]:
        """Whole columns as lists of plain values; None may stand in the ``optional`` ones only."""
        require_columns((*names, *optional), self.names, self.path)
        with arrow_files(self.path):
            found = self._file.read(columns=[*names, *optional])
            empty = [name for name in names if found.column(name).null_count]
            values = {name: found.column(name).to_pylist() for name in (*names, *optional)}
        if empty:
            row = values[empty[0]].index(None)
            raise InputError("table has an empty value", where=f"{self.path}: row {row}", got=", ".join(empty))
        return values

    def rows(self, timestamp_us: int, sensor: str, names: Mapping[int, str]) -> list[tuple[str, int]]:
        """Sensor names and rows of one frame, in the order of the file."""
        if sensor not in self._by_time:
            keys = self.columns((_TIME, sensor))
            by_time: dict[int, list[tuple[str, int]]] = {}
            for row, (time, number) in enumerate(zip(keys[_TIME], keys[sensor], strict=True)):
                if number in names:
                    by_time.setdefault(int(time), []).append((names[number], row))
            self._by_time[sensor] = by_time
        return self._by_time[sensor].get(timestamp_us, [])

    def value(self, row: int, column: str) -> Any:
        """One value as a plain one (bytes, number, list)."""
        value = self._row(row, (column,)).column(0)[0].as_py()
        if value is None:
            raise InputError("table has an empty value", where=f"{self.path}: row {row}", got=column)
        return value

    def image(self, row: int, prefix: str, channels: int) -> NDArray[np.float32] | None:
        """A range image [H, W, channels] kept as values and shape; None where it is not recorded."""
        found = self._row(row, (f"{prefix}.values", f"{prefix}.shape"))
        values, shape = found.column(0)[0], found.column(1)[0]
        if not values.is_valid or not shape.is_valid or len(values) == 0:
            return None
        data = values.values.to_numpy(zero_copy_only=False)
        return records.shaped(data, shape.as_py(), channels, f"{self.path}: row {row}, {prefix}")

    def _row(self, row: int, names: tuple[str, ...]) -> Any:
        """One row of some columns. Going forward goes on where the last call stopped; going back starts a row group
        anew."""
        require_columns(names, self.names, self.path)
        next_row, stream = self._streams.get(names, (-1, iter(())))
        group = int(np.searchsorted(self._starts, row, side="right")) - 1
        with arrow_files(self.path):
            if next_row > row or next_row < self._starts[group]:
                groups = list(range(group, self._file.num_row_groups))
                columns = list(names)
                stream = self._file.iter_batches(batch_size=1, row_groups=groups, columns=columns, use_threads=False)
                next_row = int(self._starts[group])
            batch = None
            while next_row <= row:
                batch = next(stream)
                next_row += 1
        self._streams[names] = (next_row, stream)
        if batch is None or batch.num_rows != 1:
            raise InputError("table has fewer rows than it declares", where=f"{self.path}: row {row}")
        return batch.select(list(names))
