"""Logs of the Waymo Open Dataset: format 1 (a TFRecord file of ``Frame`` messages) and format 2 (a folder per component
with one Parquet file per log). Opening one keeps what is small; ``read`` gives images, labels and scans of a frame.
Whatever is damaged or contradictory is an ``InputError``.

Poses are f64[4, 4]. ``global`` is the data set's own world, tens of kilometres from the car. Its camera frame is x
forward, y left, z up.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any, BinaryIO, Final, Self

import numpy as np
from numpy.typing import NDArray

from mudg.base import log, store
from mudg.base.errors import InputError
from mudg.base.geometry import CAM_FROM_EGO_AXES, yaw_matrix
from mudg.formats.importers.common import arrow_files, require_columns, rigid_pose, unpacked
from mudg.formats.unknown_fields import note_unknown

Matrix = NDArray[np.float64]
Numbers = Sequence[float] | NDArray[np.float64]

CAMERAS: Final[Mapping[int, str]] = {1: "front", 2: "front_left", 3: "front_right", 4: "side_left", 5: "side_right"}
LASERS: Final[Mapping[int, str]] = {1: "top", 2: "front", 3: "side_left", 4: "side_right", 5: "rear"}
LABELS: Final[Mapping[int, str]] = {1: "vehicle", 2: "pedestrian", 3: "sign", 4: "cyclist"}
"""Numbers of the data set -> names. Sensors of other numbers are left out; boxes are called ``type_9``."""
TOP: Final = "top"
MAX_UNPACKED_BYTES: Final = 128 * 1024 * 1024
"""A range image of the top LiDAR has 3 MB; what unpacks to more than this is refused."""
MAX_CLOCK_GAP_S: Final = 1.0


WaymoBox = tuple[str, str, Matrix, tuple[float, float, float]]
"""Id and label of a box of a frame, its centre and heading in the vehicle, and length, width, height in metres."""


@dataclass(frozen=True, slots=True, eq=False)
class CameraCalibration:
    """A camera: ``intrinsic`` is f_u, f_v, c_u, c_v (pixels, the image's left edge is 0), k1, k2, p1, p2, k3;
    ``direction`` the data set's number of how its shutter rolls."""

    intrinsic: tuple[float, ...]
    vehicle_from_camera: Matrix
    width: int
    height: int
    direction: int

    @classmethod
    def of(cls, name: str, intrinsic: Numbers, extrinsic: Numbers, image: Sequence[int], where: str) -> Self:
        """From the numbers of either format; ``image``: width, height and the direction of the shutter."""
        where, values = f"{where}: calibration of camera {name}", tuple(float(value) for value in intrinsic)
        if len(values) != 9 or not np.isfinite(values).all():
            raise InputError("intrinsics are incomplete", where=where, expected="9 finite numbers", got=str(values))
        return cls(values, _transform(extrinsic, where), *image)

    def vehicle_from_cam(self) -> Matrix:
        """Camera axes of this package (x right, y down, z forward) to the vehicle, f64[4, 4]."""
        return self.vehicle_from_camera @ CAM_FROM_EGO_AXES.T


@dataclass(frozen=True, slots=True, eq=False)
class LaserCalibration:
    """A LiDAR: beam ``inclinations`` in radians from the lowest up, or () where they are even between ``limits``."""

    inclinations: tuple[float, ...]
    limits: tuple[float, float]
    vehicle_from_lidar: Matrix

    @classmethod
    def of(cls, name: str, beams: Numbers, limits: tuple[float, float], extrinsic: Numbers, where: str) -> Self:
        """From the numbers of either format."""
        where, beams = f"{where}: calibration of LiDAR {name}", tuple(float(value) for value in beams)
        if not np.isfinite(beams or limits).all() or not (beams or limits[0] < limits[1]):
            got = str(beams or limits)
            raise InputError("beam inclinations make no sense", where=where, expected="radians", got=got)
        return cls(beams, limits, _transform(extrinsic, where))

    def inclination_of_rows(self, rows: int, where: str) -> NDArray[np.float64]:
        """Inclination of every row of a range image, f64[rows] radians; the top row looks highest."""
        if not self.inclinations:
            low, high = self.limits
            return high - (np.arange(rows, dtype=np.float64) + 0.5) * ((high - low) / rows)
        if len(self.inclinations) != rows:
            what = "range image does not have a row for every beam"
            expected = f"{len(self.inclinations)} rows (calibration of the LiDAR)"
            raise InputError(what, where=where, expected=expected, got=f"{rows} rows")
        return np.array(self.inclinations)[::-1]


@dataclass(frozen=True, slots=True, eq=False)
class CameraShot:
    """When and where an image was taken. ``global_from_vehicle``: at ``pose_time_s``, seconds of the epoch.
    ``velocity``: linear m/s and angular rad/s, both in the global frame, f64[6]; None if not recorded. ``shutter_s``,
    ``trigger_s``, ``done_s``: exposure of a column, start of the exposure and end of the readout; 0 if not recorded."""

    global_from_vehicle: Matrix
    pose_time_s: float
    velocity: NDArray[np.float64] | None
    shutter_s: float
    trigger_s: float
    done_s: float


@dataclass(frozen=True, slots=True, eq=False)
class FrameRecord:
    """The facts of a frame that fit into memory for a whole log. ``number``: place in the log. ``timestamp_us``: of the
    epoch, when the top LiDAR began its turn. ``global_from_vehicle``: what boxes and compensated points refer to, not
    the pose at that time. ``shots``: by camera with an image. ``lasers``: those with a range image."""

    number: int
    timestamp_us: int
    global_from_vehicle: Matrix
    shots: Mapping[str, CameraShot]
    lasers: tuple[str, ...]
    boxes: tuple[WaymoBox, ...]
    where: str

    def __post_init__(self) -> None:
        """Refuse images far from the frame's time, and two images or scans of one sensor."""
        if len(set(self.lasers)) < len(self.lasers):
            raise InputError("frame has two scans of one LiDAR", where=self.where, got=", ".join(self.lasers))
        for name, shot in self.shots.items():
            where, exposure_s = f"{self.where}: image of camera {name}", shot.done_s - shot.trigger_s
            times = (shot.pose_time_s, *((shot.trigger_s, shot.done_s) if shot.done_s else ()))
            if not max(abs(time - self.timestamp_us / 1e6) for time in times) <= MAX_CLOCK_GAP_S:
                what, got = "image and frame are not of one time", ", ".join(f"{time!r}" for time in times)
                expected = f"seconds within {MAX_CLOCK_GAP_S} s of the frame's {self.timestamp_us} microseconds"
                remedy = "are the units seconds (images) and microseconds (frames)?"
                raise InputError(what, where=where, expected=expected, got=got, remedy=remedy)
            if shot.done_s and not 0 <= shot.shutter_s <= exposure_s < MAX_CLOCK_GAP_S:
                what, got = "exposure times contradict each other", f"{shot.shutter_s:g} and {exposure_s:g}"
                expected = "0 <= shutter <= readout end - trigger, seconds"
                raise InputError(what, where=where, expected=expected, got=got)


@dataclass(frozen=True, slots=True, eq=False)
class LaserScan:
    """One turn of a LiDAR. ``returns``: range images f32[H, W, 4], range in metres (not above 0: none), intensity,
    elongation, no-label flag. ``poses``: of the top LiDAR's pixels at their time, f32[H, W, 6], roll, pitch, yaw, x, y,
    z of global from vehicle."""

    returns: Sequence[NDArray[np.float32]]
    poses: NDArray[np.float32] | None = None


@dataclass(frozen=True, slots=True, eq=False)
class FrameContent:
    """The bulky parts of a frame: JPEG bytes and panoptic labels (divisor, 16-bit PNG of class * divisor + instance) by
    camera, scans by LiDAR."""

    images: Mapping[str, bytes]
    panoptic: Mapping[str, tuple[int, bytes]]
    scans: Mapping[str, LaserScan]


# --- facts from the numbers of either format ------------------------------------------------------


def _transform(values: Numbers, where: str) -> Matrix:
    """A rigid motion from its sixteen numbers, row by row."""
    if len(values) != 16:
        raise InputError("transform is incomplete", where=where, expected="16 numbers", got=str(len(values)))
    return rigid_pose(np.asarray(values, np.float64).reshape(4, 4), where)


def _box(box_id: str, kind: int, values: Numbers, where: str) -> WaymoBox:
    """``kind``: number of the class. ``values``: x, y, z, length, width, height, heading."""
    x, y, z, length, width, height, heading = (float(value) for value in values)
    if not box_id:
        raise InputError("box has no id", where=where)
    pose = rigid_pose(yaw_matrix(heading, (x, y, z)), f"{where}: box {box_id}")
    return box_id, LABELS.get(kind, f"type_{kind}"), pose, (length, width, height)


def _by_camera(shots: Sequence[tuple[str, CameraShot]], where: str) -> dict[str, CameraShot]:
    """The images of a frame; two of one camera are refused."""
    if len(found := dict(shots)) < len(shots):
        raise InputError("frame has two images of one camera", where=where, got=", ".join(name for name, _ in shots))
    return found


def range_image(packed: bytes | memoryview, channels: int, where: str) -> NDArray[np.float32]:
    """A zlib-packed matrix of floats as f32[H, W, channels], of at most ``MAX_UNPACKED_BYTES``."""
    content = unpacked(zlib.decompressobj(), packed, MAX_UNPACKED_BYTES, "range image", where)
    values = parse_message(content, MATRIX_FLOAT, where)
    return _shaped(values["data"], values.get("shape", {}).get("dims", ()), channels, where)


def _shaped(data: NDArray[Any], dims: Sequence[int] | NDArray[np.integer], channels: int, where: str) -> NDArray[Any]:
    """``data`` [H * W * channels] as [H, W, channels], if its declared shape says so."""
    shape = tuple(int(n) for n in dims)
    if len(shape) != 3 or min(shape) < 1 or shape[2] != channels or int(np.prod(shape)) != len(data):
        what, expected = "range image has the wrong shape", f"[rows, columns, {channels}], as many values as that"
        raise InputError(what, where=where, expected=expected, got=f"{list(shape)} with {len(data)} values")
    return data.reshape(shape)


# --- protocol-buffer messages by a table of the fields that are wanted; no generated code -----------------------------
#
# A message is a row of fields, each a key (number and wire type, a varint) and a value. All that is not listed is
# skipped by its wire type. Values of bytes fields are views of the input: nothing large is copied.
#
# Source: the protocol-buffer encoding guide; the field numbers of the Waymo Open Dataset's published descriptions.
_VARINT, _BYTES = 0, 2
_FIXED: Final = {1: 8, 5: 4}
_WIRE: Final = {"int": _VARINT, "ints": _VARINT, "double": 1, "doubles": 1, "float": 5, "floats": 5}
_DTYPE: Final = {"double": "<f8", "doubles": "<f8", "float": "<f4", "floats": "<f4"}
_REPEATED: Final = ("ints", "doubles", "floats", "messages")
_MAX_FIELDS: Final = 4_000_000


class Message:
    """A message description: ``name number kind, ...``. A kind is bytes, text, message, int, double, float, or the
    plural of one, which is repeated. ``inner``: descriptions of the fields that are messages. ``passed``: numbers of
    official fields that are not kept."""

    def __init__(self, title: str, fields: str, passed: str = "", **inner: Message) -> None:
        rows = (row.split() for row in fields.split(","))
        self.fields = {int(number): (name, kind, inner.get(name)) for name, number, kind in rows}
        self.title, self.passed = title, frozenset(map(int, passed.split()))


def parse_message(data: bytes | memoryview, message: Message, where: str) -> dict[str, Any]:
    """The wanted fields of a message by name. Missing ones are left out, but repeated ones are always there: lists of
    dictionaries, or arrays f64, f32 or i64 [n]. Bytes are ``memoryview``. The last one wins where a single field stands
    twice. Raises InputError: cut off, a wire type that does not fit, or text that is not UTF-8."""

    def broken(place: int, got: str) -> InputError:
        what, expected = "message cannot be decoded", "a protocol-buffer message of the Waymo Open Dataset"
        here, remedy = f"{where}: {message.title}, byte {place}", "is this a file of another data set, or of motions?"
        return InputError(what, where=here, expected=expected, got=got, remedy=remedy)

    values: dict[str, Any] = {name: [] for name, kind, _ in message.fields.values() if kind in _REPEATED}
    for start, number, wire, raw in _fields(memoryview(data), broken):
        if number not in message.fields:
            if number not in message.passed:
                note_unknown(f"{message.title} messages", (f"field {number}",), frozenset())
            continue
        name, kind, inner = message.fields[number]
        expected, value = _WIRE.get(kind, _BYTES), raw
        packed = wire == _BYTES and kind in _REPEATED
        if wire != expected and not packed:
            raise broken(start, f"field {name} ({number}) has wire type {wire}, not {expected}")
        if inner is not None:
            value = parse_message(raw, inner, where)
        elif kind in _DTYPE:
            if len(raw) % np.dtype(_DTYPE[kind]).itemsize:
                raise broken(start, f"field {name} holds {len(raw)} bytes, no multiple of its numbers")
            value = np.frombuffer(raw, _DTYPE[kind])
            value = value if kind in _REPEATED else value[0].item()
        elif kind == "ints":
            found, place = [] if packed else [raw], 0
            while packed and place < len(raw):
                one, place = _varint(raw, place, broken)
                found.append(one)
            value = np.array(found, np.uint64).view(np.int64)
        elif kind == "int":
            value = raw - (raw >> 63 << 64)
        elif kind == "text":
            try:
                value = bytes(raw).decode("utf-8")
            except UnicodeDecodeError as error:
                raise broken(start, f"field {name} is no text") from error
        if kind in _REPEATED:
            values[name].append(value)
        else:
            values[name] = value
    for name, kind, _ in message.fields.values():
        if kind in _REPEATED and kind != "messages":
            parts, none = values[name], np.zeros(0, _DTYPE.get(kind, "<i8"))
            values[name] = parts[0] if len(parts) == 1 else np.concatenate([none, *parts])
    return values


def _fields(view: memoryview, broken: Callable[[int, str], InputError]) -> Iterator[tuple[int, int, int, Any]]:
    """Place, number, wire type and raw value (an int, or a view) of every field."""
    place = count = 0
    while place < len(view):
        start, count = place, count + 1
        key, place = _varint(view, place, broken)
        number, wire = key >> 3, key & 7
        if number == 0 or count > _MAX_FIELDS:
            raise broken(start, "field number 0" if number == 0 else f"more than {_MAX_FIELDS} fields")
        if wire == _VARINT:
            raw, place = _varint(view, place, broken)
        else:
            if wire != _BYTES and wire not in _FIXED:
                raise broken(place, f"wire type {wire}")
            size, place = _varint(view, place, broken) if wire == _BYTES else (_FIXED[wire], place)
            if size > len(view) - place:
                raise broken(place, f"a field of {size} bytes where {len(view) - place} are left")
            raw, place = view[place : place + size], place + size
        yield start, number, wire, raw


def _varint(view: memoryview, start: int, broken: Callable[[int, str], InputError]) -> tuple[int, int]:
    """A number, and the place behind it."""
    value = 0
    for count, byte in enumerate(view[start : start + 10]):
        value |= (byte & 0x7F) << 7 * count
        if byte < 0x80:
            return value & 0xFFFFFFFFFFFFFFFF, start + count + 1
    many = len(view) - start >= 10
    raise broken(start, "a number of more than ten bytes" if many else "it ends inside a number")


_TRANSFORM = Message("Transform", "values 1 doubles")
CONTEXT: Final = Message(
    "Context",
    "name 1 text, cameras 2 messages, lasers 3 messages",
    "4",
    cameras=Message(
        "CameraCalibration",
        "name 1 int, intrinsic 2 doubles, extrinsic 3 message, width 4 int, height 5 int, direction 6 int",
        extrinsic=_TRANSFORM,
    ),
    lasers=Message(
        "LaserCalibration",
        "name 1 int, inclinations 2 doubles, inclination_min 3 double, inclination_max 4 double, extrinsic 5 message",
        extrinsic=_TRANSFORM,
    ),
)
_VELOCITY: Final = "v_x 1 float, v_y 2 float, v_z 3 float, w_x 4 double, w_y 5 double, w_z 6 double"
_CAMERA_IMAGE = Message(
    "CameraImage",
    "name 1 int, image 2 bytes, pose 3 message, velocity 4 message, pose_time_s 5 double, shutter_s 6 double, "
    "trigger_s 7 double, done_s 8 double, panoptic 10 message",
    pose=_TRANSFORM,
    velocity=Message("Velocity", _VELOCITY),
    panoptic=Message("CameraSegmentationLabel", "divisor 1 int, png 2 bytes", "3 4 5"),
)
_RANGE_IMAGE = Message("RangeImage", "ranges 2 bytes, poses 4 bytes", "1 3 5 6")
_BOX = Message(
    "Box", "x 1 double, y 2 double, z 3 double, width 4 double, length 5 double, height 6 double, heading 7 double"
)
FRAME: Final = Message(
    "Frame",
    "context 1 bytes, timestamp_us 2 int, pose 3 message, images 4 messages, lasers 5 messages, labels 6 messages",
    "7 8 9 10 11",
    pose=_TRANSFORM,
    images=_CAMERA_IMAGE,
    lasers=Message(
        "Laser", "name 1 int, return1 2 message, return2 3 message", return1=_RANGE_IMAGE, return2=_RANGE_IMAGE
    ),
    labels=Message("Label", "box 1 message, type 3 int, id 4 text", "2 5 6 7 8 9 10 11 12 13", box=_BOX),
)
MATRIX_FLOAT: Final = Message(
    "MatrixFloat", "data 1 floats, shape 2 message", shape=Message("MatrixShape", "dims 1 ints")
)


# --- format 1: records of a TFRecord file ---------------------------------------------------------
#
# A record: u64 length, u32 masked CRC32C of these eight bytes, the payload, u32 masked CRC32C of the payload, all
# little-endian. A mask turns the sum by 15 bits to the right and adds a constant.
#
# Source: TensorFlow's documentation of the format; CRC32C is the Castagnoli polynomial of RFC 3720.
MAX_RECORD_BYTES: Final = 512 * 1024 * 1024
"""Real frames have 3 to 8 MB; what declares more than this is refused before any memory is taken."""
_HEADER_BYTES: Final = 12
_FOOTER_BYTES: Final = 4
SPARSE_MULTIPLES: Final = ((5685, (1362, 426, 0)), (290, (136, 113, 107, 32, 0)))
"""Multiples of the CRC32C polynomial with few terms, as (degree, lower exponents): x^5685 + x^1362 + x^426 + 1, and one
of degree 290. Squaring a polynomial over GF(2) six times multiplies its exponents by 64, so each is also a multiple
whose terms lie whole 64-bit words apart: a word may be removed by adding it to the words that many places further
on."""
_TABLE: Final = list(range(256))
for _ in range(8):
    _TABLE[:] = [(value >> 1) ^ (0x82F63B78 if value & 1 else 0) for value in _TABLE]


def crc32c(data: bytes | memoryview) -> int:
    """CRC-32C of ``data``, 0 .. 2^32 - 1. Long data is first folded: leading words are added (exclusive or) to later
    ones, where a sparse multiple of the polynomial says that the remainder stays the same. That needs three additions a
    word and runs at memory speed in numpy; the two kilobytes that are left go through the usual table."""
    rest, crc = bytes(data), 0xFFFFFFFF
    if len(data) >= 64:
        padded = np.zeros(-len(data) % 8 + len(data), np.uint8)  # zeros in front change nothing
        padded[-len(data) :] = np.frombuffer(data, np.uint8)
        padded[-len(data) :][:4] ^= 0xFF  # the start value is in the data now
        words, start = padded.view("<u8"), 0
        for degree, lower in SPARSE_MULTIPLES:
            while (left := len(words) - start - degree) > 0:
                size = min(degree - lower[0], left)
                leading = words[start : start + size]
                for exponent in lower:
                    place = start + degree - exponent
                    words[place : place + size] ^= leading
                start += size
        rest, crc = words[start:].tobytes(), 0
    for byte in rest:
        crc = _TABLE[(crc ^ byte) & 0xFF] ^ (crc >> 8)
    return crc ^ 0xFFFFFFFF


def masked_crc32c(data: bytes | memoryview) -> int:
    """The checksum as TFRecord files store it."""
    crc = crc32c(data)
    return (((crc >> 15) | (crc << 17)) + 0xA282EAD8) & 0xFFFFFFFF


def record_places(path: Path) -> Iterator[tuple[str, int, int]]:
    """What the records of a file are called in messages, offset and length of their payloads, in order; only headers
    are read, and their checksums compared."""
    try:
        with store.open_file(path) as file:
            size, offset, number = file.seek(0, 2), 0, 0
            while offset < size:
                where = f"{path}: record {number} at byte {offset}"
                file.seek(offset)
                length = _payload_bytes(file.read(_HEADER_BYTES), path, where, size - offset, first=number == 0)
                yield where, offset + _HEADER_BYTES, length
                offset, number = offset + _HEADER_BYTES + length + _FOOTER_BYTES, number + 1
    except OSError as error:
        raise InputError("TFRecord file cannot be read", where=str(path), got=str(error)) from error


def _payload_bytes(header: bytes, path: Path, where: str, left: int, *, first: bool) -> int:
    """Length of a record's payload by its header, of ``left`` bytes to the end of the file."""
    if len(header) < _HEADER_BYTES:
        raise _cut_off(where, f"{len(header)} of {_HEADER_BYTES} header bytes")
    length, crc = struct.unpack("<QI", header)
    if masked_crc32c(header[:8]) != crc:
        if not first:
            expected = "a length that fits its checksum"
            raise InputError("record header is damaged", where=where, expected=expected, remedy="copy the file again")
        packed = header[:2] == b"\x1f\x8b"
        what, got = "file is compressed" if packed else "file is not a TFRecord", f"{left} bytes starting {header!r}"
        remedy = "unpack it with gunzip" if packed else "is it a download page, a placeholder, or of another format?"
        raise InputError(what, where=str(path), expected="a record's length and its checksum", got=got, remedy=remedy)
    if length > MAX_RECORD_BYTES:
        what = "record declares a length that no frame has"
        raise InputError(what, where=where, expected=f"at most {MAX_RECORD_BYTES} bytes", got=f"{length} bytes")
    if _HEADER_BYTES + length + _FOOTER_BYTES > left:
        raise _cut_off(where, f"{left - _HEADER_BYTES} of {length + _FOOTER_BYTES} bytes")
    return length


def read_payload(file: BinaryIO, where: str, offset: int, length: int) -> bytes:
    """The payload of a record, its checksum compared."""
    file.seek(offset)
    content = file.read(length + _FOOTER_BYTES)
    if len(content) != length + _FOOTER_BYTES:
        raise _cut_off(where, f"{len(content)} of {length + _FOOTER_BYTES} bytes")
    payload, (crc,) = content[:length], struct.unpack("<I", content[length:])
    if masked_crc32c(payload) != crc:
        what = "record is damaged: its bytes do not fit their checksum"
        got = f"{masked_crc32c(payload):#010x} over {length} bytes"
        remedy = "copy the file again, or choose other frames with --frames FIRST:END"
        raise InputError(what, where=where, expected=f"checksum {crc:#010x}", got=got, remedy=remedy)
    return payload


def _cut_off(where: str, got: str) -> InputError:
    what = "TFRecord file is cut off"
    return InputError(what, where=where, expected="a whole record", got=got, remedy="copy the file again")


class TfrecordLog:
    """A TFRecord file. Opening it reads the ``wanted`` records (first, end; None: all) once, compares their checksums
    and keeps what is small."""

    form = "v1 TFRecord"

    def __init__(self, path: Path, wanted: tuple[int, int] | None = None) -> None:
        self._path = path
        first, end = wanted or (0, None)
        places = list(islice(record_places(path), first, end))
        if not places:
            expected = "records" + (f" {first} to {end - 1}" if end is not None else "")
            raise InputError("no frames to import", where=str(path), expected=expected, got="none")
        self._places = dict(enumerate(places, first))
        self.frames: list[FrameRecord] = []
        with store.open_file(path) as file, log.task("checking records", len(places)) as bar:
            for number, place in self._places.items():
                message = parse_message(read_payload(file, *place), FRAME, place[0])
                self._read_context(message.get("context", b""), place[0])
                self.frames.append(_frame_of_message(message, number, place[0]))
                bar.advance()

    def _read_context(self, content: bytes | memoryview, where: str) -> None:
        """The name and calibrations of the first record; the other records repeat them."""
        context = parse_message(content, CONTEXT, where)
        name = str(context.get("name", ""))
        if self.frames:
            if name not in ("", self.name):
                raise InputError("the file mixes two logs", where=where, expected=self.name, got=name)
            return
        self.name = name or self._path.stem
        self.cameras: dict[str, CameraCalibration] = {}
        for camera, item in _named(context["cameras"], CAMERAS):
            image = item.get("width", 0), item.get("height", 0), item.get("direction", 0)
            pose = _sixteen(item, "extrinsic")
            self.cameras[camera] = CameraCalibration.of(camera, item["intrinsic"], pose, image, where)
        self.lasers: dict[str, LaserCalibration] = {}
        for laser, item in _named(context["lasers"], LASERS):
            limits = item.get("inclination_min", np.nan), item.get("inclination_max", np.nan)
            pose = _sixteen(item, "extrinsic")
            self.lasers[laser] = LaserCalibration.of(laser, item["inclinations"], limits, pose, where)

    def read(self, frame: FrameRecord, cameras: Sequence[str]) -> FrameContent:
        """The bulky parts of a frame, for the chosen cameras."""
        with store.open_file(self._path) as file:
            message = parse_message(read_payload(file, *self._places[frame.number]), FRAME, frame.where)
        items = {name: item for name, item in _named(message["images"], CAMERAS) if name in cameras}
        labels = {name: item.get("panoptic", {}) for name, item in items.items()}
        panoptic = {name: (one.get("divisor", 0), bytes(one["png"])) for name, one in labels.items() if one.get("png")}
        scans = {}
        for name, item in _named(message["lasers"], LASERS):
            if name in frame.lasers:
                where, parts = f"{frame.where}: LiDAR {name}", (item["return1"], item.get("return2", {}))
                returns = [range_image(part["ranges"], 4, where) for part in parts if part.get("ranges")]
                poses = parts[0].get("poses")
                scans[name] = LaserScan(returns, range_image(poses, 6, f"{where}: pixel poses") if poses else None)
        return FrameContent({name: bytes(item.get("image", b"")) for name, item in items.items()}, panoptic, scans)


def _named(items: Sequence[dict[str, Any]], names: Mapping[int, str]) -> Iterator[tuple[str, dict[str, Any]]]:
    """Messages of sensors with their names; sensors of other numbers are passed over."""
    return ((names[item["name"]], item) for item in items if item.get("name", 0) in names)


def _sixteen(message: dict[str, Any], key: str) -> NDArray[np.float64]:
    return message.get(key, {}).get("values", np.zeros(0))


def _frame_of_message(message: dict[str, Any], number: int, where: str) -> FrameRecord:
    shots, boxes = [], []
    for name, item in _named(message["images"], CAMERAS):
        if "image" in item:
            velocity = item.get("velocity")
            if velocity is not None:
                velocity = np.array([velocity.get(key, 0.0) for key in ("v_x", "v_y", "v_z", "w_x", "w_y", "w_z")])
            pose = _transform(_sixteen(item, "pose"), f"{where}: image of camera {name}: pose")
            times = (item.get(key, 0.0) for key in ("shutter_s", "trigger_s", "done_s"))
            shots.append((name, CameraShot(pose, item.get("pose_time_s", 0.0), velocity, *times)))
    for item in message["labels"]:
        box = item.get("box", {})
        values = [box.get(key, np.nan) for key in ("x", "y", "z", "length", "width", "height")]
        boxes.append(_box(item.get("id", ""), item.get("type", 0), [*values, box.get("heading", 0.0)], where))
    lasers = [name for name, item in _named(message["lasers"], LASERS) if item.get("return1", {}).get("ranges")]
    time_us, pose = message.get("timestamp_us", 0), _transform(_sixteen(message, "pose"), f"{where}: pose")
    return FrameRecord(number, time_us, pose, _by_camera(shots, where), tuple(lasers), tuple(boxes), where)


# --- format 2: a folder per component (``camera_image``, ``lidar``, ...) with one Parquet file per log ----------------
#
# Rows are read one at a time and in the order of the file, so that memory stays at one page of a column; the keys of
# all rows are read first and tell which row belongs to which frame.
_NAMES: Final = "segment_context_name frame_timestamp_micros camera_name laser_name laser_object_id".split()
_SEGMENT, _TIME, _CAMERA, _LASER, _OBJECT = (f"key.{name}" for name in _NAMES)
_KEYS: Final = (_SEGMENT, _TIME, _CAMERA, _LASER, _OBJECT, "index", "__index_level_0__")
"""Columns that every table may have; the last two are the index of pandas."""
_INTRINSIC: Final = tuple(f"intrinsic.{name}" for name in "f_u f_v c_u c_v k1 k2 p1 p2 k3".split())
_SPEEDS: Final = tuple(f"velocity.{kind}_velocity.{axis}" for kind in ("linear", "angular") for axis in "xyz")
_EXPOSURE: Final = tuple(
    f"rolling_shutter_params.{name}" for name in ("shutter", "camera_trigger_time", "camera_readout_done_time")
)
_CUBOID: Final = (*(f"box.{part}.{axis}" for part in ("center", "size") for axis in "xyz"), "box.heading")
_RETURNS: Final = [f"range_image_return{number}.{part}" for number in (1, 2) for part in ("values", "shape")]
_BEAMS: Final = "beam_inclination.min beam_inclination.max beam_inclination.values".split()
_LENS: Final = ("extrinsic.transform", "width", "height", "rolling_shutter_direction", *_INTRINSIC)
_LABELLED: Final = """panoptic_label panoptic_label_divisor sequence_id num_cameras_covered
    instance_id_to_global_id_mapping.local_instance_ids instance_id_to_global_id_mapping.global_instance_ids
    instance_id_to_global_id_mapping.is_tracked""".split()
_OF_BOX: Final = """type num_lidar_points_in_box num_top_lidar_points_in_box speed.x speed.y speed.z acceleration.x
    acceleration.y acceleration.z difficulty_level.detection difficulty_level.tracking""".split()
OFFICIAL: Final[Mapping[str, tuple[str, Sequence[str]]]] = {
    "camera_image": ("CameraImage", ("image", "pose.transform", "pose_timestamp", *_SPEEDS, *_EXPOSURE)),
    "camera_calibration": ("CameraCalibration", _LENS),
    "camera_segmentation": ("CameraSegmentationLabel", _LABELLED),
    "lidar": ("LiDAR", _RETURNS),
    "lidar_box": ("LiDARBox", (*_CUBOID, *_OF_BOX)),
    "lidar_calibration": ("LiDARCalibration", ("extrinsic.transform", *_BEAMS)),
    "lidar_pose": ("LiDARPose", _RETURNS[:2]),
    "vehicle_pose": ("VehiclePose", ("world_from_vehicle.transform",)),
}
"""Folders that are read -> name of the component, and its columns, read or not. Source: the data set's published
components."""
REQUIRED: Final = ("camera_image", "camera_calibration", "vehicle_pose")
"""Components without which there is no scene."""


class ParquetLog:
    """One log of a format-2 folder. Opening it reads all small tables and the keys of the large ones. ``root``: folder
    with the component folders. ``segment``: name of the log, that of its files. ``wanted``: frames (first, end) in the
    order of time; None: all. ResourceError: pyarrow is not installed."""

    form = "v2 Parquet"

    def __init__(self, root: Path, segment: str, wanted: tuple[int, int] | None = None) -> None:
        self._root, self.name = root, segment
        self.cameras = dict(_cameras(self._need("camera_calibration")))
        self._images, vehicle = self._need("camera_image"), self._need("vehicle_pose")
        self._labels, self._lidar = self._table("camera_segmentation"), self._table("lidar")
        self.lasers: dict[str, LaserCalibration] = {}
        self._poses: ParquetTable | None = None
        if self._lidar is not None:  # without pixel poses the scans of a moving vehicle would be twisted
            self.lasers, self._poses = dict(_lasers(self._need("lidar_calibration"))), self._need("lidar_pose")
        self.frames = self._frames(vehicle, wanted)

    def read(self, frame: FrameRecord, cameras: Sequence[str]) -> FrameContent:
        """The bulky parts of a frame, for the chosen cameras. Reading frames in the order of time is fastest."""
        time, shown, labels, scans = frame.timestamp_us, self._images, self._labels, {}
        images = {name: bytes(shown.value(n, "image")) for name, n in shown.rows(time, _CAMERA, CAMERAS, cameras)}
        panoptic = {}
        if labels is not None:
            for name, row in labels.rows(time, _CAMERA, CAMERAS, cameras):
                divisor, png = labels.value(row, "panoptic_label_divisor"), labels.value(row, "panoptic_label")
                panoptic[name] = int(divisor), bytes(png)
        if self._lidar is not None and self._poses is not None:
            rows = dict(self._poses.rows(time, _LASER, LASERS))
            for name, row in self._lidar.rows(time, _LASER, LASERS):
                found = [self._lidar.image(row, f"range_image_return{n}", 4) for n in (1, 2)]
                top = name == TOP and TOP in rows
                poses = self._poses.image(rows[TOP], "range_image_return1", 6) if top else None
                if name == TOP and poses is None:
                    what, where = "frame has no pixel poses", f"{frame.where}: lidar_pose"
                    raise InputError(what, where=where, expected="a row for the top LiDAR")
                scans[name] = LaserScan([image for image in found if image is not None], poses)
        return FrameContent(images, panoptic, scans)

    def _frames(self, vehicle: ParquetTable, wanted: tuple[int, int] | None) -> list[FrameRecord]:
        where, transform, poses = str(vehicle.path), "world_from_vehicle.transform", {}
        for _, row in vehicle.records((_SEGMENT, _TIME), (transform,)):
            if row[_SEGMENT] != self.name:
                raise InputError("the file holds other logs", where=where, expected=self.name, got=str(row[_SEGMENT]))
            if int(row[_TIME]) in poses:
                raise InputError("the table has a frame twice", where=f"{where}: {_TIME}", got=str(row[_TIME]))
            poses[int(row[_TIME])] = row[transform]
        chosen = list(enumerate(sorted(poses)))[slice(*wanted) if wanted else slice(None)]
        if not chosen:
            what, expected = "no frames to import", f"frames {wanted}"
            raise InputError(what, where=where, got=f"{len(poses)} frames", expected=expected)
        shots, boxes, frames = self._shots(), self._boxes(), []
        for number, time in chosen:
            here = f"{self._root}: {self.name}, frame {number}"
            lasers = [] if self._lidar is None else [name for name, _ in self._lidar.rows(time, _LASER, LASERS)]
            pose, taken = _transform(poses[time], f"{here}: pose"), _by_camera(shots.get(time, ()), here)
            frames.append(FrameRecord(number, time, pose, taken, tuple(lasers), tuple(boxes.get(time, ())), here))
        return frames

    def _shots(self) -> dict[int, list[tuple[str, CameraShot]]]:
        shots: dict[int, list[tuple[str, CameraShot]]] = {}
        names, optional = ("pose.transform", "pose_timestamp"), (*_EXPOSURE, *_SPEEDS)
        for where, row in self._images.records((_TIME, _CAMERA), names, optional):
            if row[_CAMERA] in CAMERAS:
                speeds = [row[name] for name in _SPEEDS]
                velocity = None if None in speeds else np.array(speeds, np.float64)
                exposure = (float(row[name] or 0.0) for name in _EXPOSURE)
                pose = _transform(row["pose.transform"], where)
                shot = CameraShot(pose, float(row["pose_timestamp"]), velocity, *exposure)
                shots.setdefault(int(row[_TIME]), []).append((CAMERAS[row[_CAMERA]], shot))
        return shots

    def _boxes(self) -> dict[int, list[WaymoBox]]:
        table, boxes = self._table("lidar_box"), {}
        if table is not None:
            for where, row in table.records((_TIME, _OBJECT), ("type", *_CUBOID)):
                box = _box(str(row[_OBJECT]), row["type"], [row[name] for name in _CUBOID], where)
                boxes.setdefault(int(row[_TIME]), []).append(box)
        return boxes

    def _table(self, component: str) -> ParquetTable | None:
        path = self._root / component / f"{self.name}.parquet"
        return ParquetTable(path, component) if path.is_file() else None

    def _need(self, component: str) -> ParquetTable:
        table = self._table(component)
        if table is None:
            what, expected = "a component of the log is missing", f"{component}/{self.name}.parquet"
            raise InputError(what, where=str(self._root), expected=expected, remedy="download it beside the others")
        return table


WaymoLog = TfrecordLog | ParquetLog


def _cameras(table: ParquetTable) -> Iterator[tuple[str, CameraCalibration]]:
    required, direction = (*_INTRINSIC, "extrinsic.transform", "width", "height"), "rolling_shutter_direction"
    for where, row in table.records((_CAMERA,), required, (direction,)):
        if row[_CAMERA] in CAMERAS:
            name, image = CAMERAS[row[_CAMERA]], (int(row["width"]), int(row["height"]), int(row[direction] or 0))
            intrinsic, pose = [row[n] for n in _INTRINSIC], row["extrinsic.transform"]
            yield name, CameraCalibration.of(name, intrinsic, pose, image, where)


def _lasers(table: ParquetTable) -> Iterator[tuple[str, LaserCalibration]]:
    low, high, beams = _BEAMS
    for where, row in table.records((_LASER,), ("extrinsic.transform", low, high), (beams,)):
        if row[_LASER] in LASERS:
            name, limits = LASERS[row[_LASER]], (float(row[low]), float(row[high]))
            yield name, LaserCalibration.of(name, row[beams] or (), limits, row["extrinsic.transform"], where)


class ParquetTable:
    """The Parquet file of a component, whose columns go by their short names: whole columns of small values, or single
    large values row by row."""

    def __init__(self, path: Path, component: str) -> None:
        self.path = path
        title, columns = OFFICIAL[component]
        self._prefix = f"[{title}Component]."
        with arrow_files(path):
            from pyarrow.parquet import ParquetFile

            self._file = ParquetFile(
                store.regular(path), buffer_size=1 << 20, pre_buffer=False, page_checksum_verification=True
            )
        self._names = tuple(self._file.schema_arrow.names)
        note_unknown(f"{component}/*.parquet", self._names, frozenset((*_KEYS, *map(self._full, columns))))
        counts = [self._file.metadata.row_group(n).num_rows for n in range(self._file.num_row_groups)]
        self._starts = np.concatenate([[0], np.cumsum(counts, dtype=np.int64)])
        self._by_time: dict[int, list[tuple[str, int]]] | None = None
        self._streams: dict[tuple[str, ...], tuple[int, Iterator[Any]]] = {}

    def _full(self, name: str) -> str:
        return name if name in _KEYS else self._prefix + name

    def records(
        self, keys: Sequence[str], names: Sequence[str], optional: Sequence[str] = ()
    ) -> Iterator[tuple[str, dict[str, Any]]]:
        """Place and plain values of every row; None may stand in the ``optional`` columns only."""
        chosen = (*keys, *names, *optional)
        full = list(map(self._full, chosen))
        require_columns(full, self._names, self.path)
        with arrow_files(self.path):
            found = self._file.read(columns=full)
            columns = [found.column(name).to_pylist() for name in full]
        for index, row in enumerate(zip(*columns, strict=True)):
            if None in row[: len(keys) + len(names)]:
                got = chosen[row.index(None)]
                raise InputError("table has an empty value", where=f"{self.path}: row {index}", got=got)
            yield f"{self.path}: row {index}", dict(zip(chosen, row, strict=True))

    def rows(
        self, timestamp_us: int, sensor: str, names: Mapping[int, str], chosen: Sequence[str] | None = None
    ) -> list[tuple[str, int]]:
        """Names and rows of the ``chosen`` sensors (None: all) in one frame, in the order of the file."""
        if self._by_time is None:
            self._by_time = {}
            for index, (_, row) in enumerate(self.records((_TIME, sensor), ())):
                if row[sensor] in names:
                    self._by_time.setdefault(int(row[_TIME]), []).append((names[row[sensor]], index))
        return [one for one in self._by_time.get(timestamp_us, []) if chosen is None or one[0] in chosen]

    def value(self, row: int, name: str) -> Any:
        """One value as a plain one (bytes, number, list)."""
        value = self._row(row, (name,)).column(0)[0].as_py()
        if value is None:
            raise InputError("table has an empty value", where=f"{self.path}: row {row}", got=name)
        return value

    def image(self, row: int, name: str, channels: int) -> NDArray[np.float32] | None:
        """A range image [H, W, channels] kept as values and shape; None where it is not recorded."""
        found = self._row(row, (f"{name}.values", f"{name}.shape"))
        values, shape = found.column(0)[0], found.column(1)[0]
        if not values.is_valid or not shape.is_valid or len(values) == 0:
            return None
        data = values.values.to_numpy(zero_copy_only=False)
        return _shaped(data, shape.as_py(), channels, f"{self.path}: row {row}, {name}")

    def _row(self, row: int, names: tuple[str, ...]) -> Any:
        """One row of some columns. Going forward goes on where the last call stopped; going back starts a row group
        anew."""
        columns = list(map(self._full, names))
        require_columns(columns, self._names, self.path)
        next_row, stream = self._streams.get(names, (-1, iter(())))
        group = int(np.searchsorted(self._starts, row, side="right")) - 1
        with arrow_files(self.path):
            if next_row > row or next_row < self._starts[group]:
                groups = list(range(group, self._file.num_row_groups))
                stream = self._file.iter_batches(batch_size=1, row_groups=groups, columns=columns, use_threads=False)
                next_row = int(self._starts[group])
            batch = None
            while next_row <= row:
                batch = next(stream)
                next_row += 1
        self._streams[names] = (next_row, stream)
        if batch is None or batch.num_rows != 1:
            raise InputError("table has fewer rows than it declares", where=f"{self.path}: row {row}")
        return batch.select(columns)
