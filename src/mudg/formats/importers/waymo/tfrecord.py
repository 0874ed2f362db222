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
from mudg.formats.importers.waymo import records
from mudg.formats.importers.waymo.messages import CONTEXT, FRAME, parse_message
from mudg.formats.importers.waymo.records import CAMERAS, LASERS, FrameRecord, LaserScan

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


def _make_table() -> tuple[int, ...]:
    table = []
    for value in range(256):
        for _ in range(8):
            value = (value >> 1) ^ (_POLYNOMIAL_REFLECTED if value & 1 else 0)
        table.append(value)
    return tuple(table)


_TABLE: Final = _make_table()


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
    """The records of a file in order; only headers are read, and their checksums compared.

    Raises:
        InputError: not a TFRecord file, cut off, a damaged header, or a length that no record has.
    """
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
    """The payload of a record, its checksum compared.

    Raises:
        InputError: cut off since the headers were read, or damaged.
    """
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

    Args:
        path: the file.
        wanted: record numbers (first, end) to keep, or None.

    Raises:
        InputError: the file or a wanted record is damaged, or no Waymo frame.
    """

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
        self.cameras: Mapping[str, records.CameraCalibration] = {
            name: _camera(name, item, where) for name, item in cameras
        }
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

    def read(self, frame: FrameRecord, cameras: Sequence[str], *, projections: bool = False) -> records.FrameContent:
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
            name: _scan(item, f"{frame.where}: LiDAR {name}", projections)
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
    velocity = item.get("velocity")
    return records.CameraShot(
        records.transform_of(_sixteen(item, "pose"), f"{where}: pose"),
        item.get("pose_time_s", 0.0),
        None if velocity is None else np.array([velocity.get(key, 0.0) for key in records.VELOCITY]),
        item.get("shutter_s", 0.0),
        item.get("trigger_s", 0.0),
        item.get("done_s", 0.0),
    )


def _frame_record(message: dict[str, Any], number: int, where: str) -> FrameRecord:
    timestamp_us = message.get("timestamp_us", 0)
    images = [(name, item) for name, item in _named(message["images"], CAMERAS) if item.get("image")]
    shots = records.by_name(
        ((name, _shot(item, f"{where}: image of camera {name}")) for name, item in images), timestamp_us, where
    )
    lasers = records.each_once([name for name, item in _named(message["lasers"], LASERS) if _has_ranges(item)], where)
    boxes = []
    for item in message["labels"]:
        box = item.get("box", {})
        values = [box.get(key, np.nan) for key in ("x", "y", "z", "length", "width", "height")]
        boxes.append(records.box_of(item.get("id", ""), item.get("type", 0), [*values, box.get("heading", 0.0)], where))
    pose = records.transform_of(_sixteen(message, "pose"), f"{where}: pose")
    return FrameRecord(number, timestamp_us, pose, shots, lasers, tuple(boxes), where)


def _scan(item: dict[str, Any], where: str, projections: bool) -> LaserScan:
    parts = [item[key] for key in ("return1", "return2") if item.get(key, {}).get("ranges")]
    returns = [records.float_image(part["ranges"], 4, where) for part in parts]
    packed = item["return1"].get("poses")
    poses = records.float_image(packed, 6, f"{where}: pixel poses") if packed else None
    found: list[NDArray[np.int64]] = []
    if projections and all(part.get("projections") for part in parts):
        found = [records.int_image(part["projections"], 6, f"{where}: camera projections") for part in parts]
    return LaserScan(returns, poses, found)
