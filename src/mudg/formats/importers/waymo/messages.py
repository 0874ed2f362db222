"""Reading protocol-buffer messages by a table of the fields that are wanted; no generated code.

A message is a row of fields, each a key (number and wire type, a varint) and a value. ``Message`` lists what to keep;
all else is skipped by its wire type. Values of bytes fields are views of the input: nothing large is copied.

Source: the protocol-buffer encoding guide; the field numbers of the Waymo Open Dataset's published message
descriptions.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Final, Literal

import numpy as np
from numpy.typing import NDArray

from mudg.base.errors import InputError
from mudg.formats.unknown_fields import note_unknown

Kind = Literal["int", "float", "double", "bytes", "text", "message", "doubles", "floats", "ints", "messages"]

_VARINT, _FIXED64, _BYTES, _FIXED32 = 0, 1, 2, 5
_WIRE: Final[Mapping[Kind, int]] = {
    "int": _VARINT,
    "ints": _VARINT,
    "double": _FIXED64,
    "doubles": _FIXED64,
    "float": _FIXED32,
    "floats": _FIXED32,
    "bytes": _BYTES,
    "text": _BYTES,
    "message": _BYTES,
    "messages": _BYTES,
}
_DTYPE: Final[Mapping[Kind, str]] = {"doubles": "<f8", "floats": "<f4"}
_MAX_FIELDS: Final = 4_000_000


@dataclass(frozen=True, slots=True)
class Field:
    """A field to keep: its name, what it holds, and for messages their description. Plural kinds are repeated."""

    name: str
    kind: Kind
    message: Message | None = None


@dataclass(frozen=True, slots=True)
class Message:
    """A message description: its name, for errors; field number -> field; and numbers of the data set's fields that are
    not kept."""

    name: str
    fields: Mapping[int, Field]
    passed: frozenset[int] = frozenset()


def parse_message(data: bytes | memoryview, message: Message, where: str) -> dict[str, Any]:
    """The wanted fields of a message.

    Args:
        data: the encoded message.
        message: what to keep.
        where: file and record, for errors.

    Returns:
        Field name -> value. Missing fields are left out, but repeated ones are always there: lists of dictionaries, or
        arrays f64, f32 or i64 [n]. Bytes are ``memoryview``. The last one wins where a single field stands twice.

    Raises:
        InputError: cut off, a wire type that does not fit, or text that is not UTF-8.
    """
    reader = _MessageReader(data, message, where)
    values: dict[str, Any] = {}
    parts: dict[int, list[Any]] = {
        n: [] for n, f in message.fields.items() if f.kind in ("doubles", "floats", "ints", "messages")
    }
    for start, number, wire, raw in reader.fields():
        field = message.fields.get(number)
        if field is None:
            if number not in message.passed:
                note_unknown(f"{message.name} messages", (f"field {number}",), frozenset())
            continue
        packed = wire == _BYTES and field.kind in ("doubles", "floats", "ints")
        if wire != _WIRE[field.kind] and not packed:
            expected = _WIRE[field.kind]
            raise reader.broken(start, f"field {field.name} ({number}) has wire type {wire}, not {expected}")
        value = reader.decode(field, raw, packed, start)
        if number in parts:
            parts[number].append(value)
        else:
            values[field.name] = value
    for number, found in parts.items():
        field = message.fields[number]
        values[field.name] = found if field.kind == "messages" else _concatenated(field.kind, found)
    return values


class _MessageReader:
    """The fields of one message; what is wrong is said with its name and the byte."""

    def __init__(self, data: bytes | memoryview, message: Message, where: str) -> None:
        self._view, self._message, self._where = memoryview(data), message, where
        self._place = 0

    def broken(self, place: int, got: str) -> InputError:
        where = f"{self._where}: {self._message.name}, byte {place}"
        expected = "a protocol-buffer message of the Waymo Open Dataset"
        remedy = "is this a file of another data set, or of the motion data?"
        return InputError("message cannot be decoded", where=where, expected=expected, got=got, remedy=remedy)

    def fields(self) -> Iterator[tuple[int, int, int, Any]]:
        """Place, number, wire type and raw value (an int, or a view) of every field."""
        seen = 0
        while self._place < len(self._view):
            start, key = self._place, self._varint()
            seen += 1
            if key >> 3 == 0 or seen > _MAX_FIELDS:
                raise self.broken(start, "field number 0" if key >> 3 == 0 else f"more than {_MAX_FIELDS} fields")
            yield start, key >> 3, key & 7, self._value(key & 7)

    def _varint(self) -> int:
        start, value, shift = self._place, 0, 0
        for place in range(start, len(self._view)):
            byte = self._view[place]
            value |= (byte & 0x7F) << shift
            if byte < 0x80:
                self._place = place + 1
                return value & 0xFFFFFFFFFFFFFFFF
            shift += 7
            if shift > 63:
                raise self.broken(start, "a number of more than ten bytes")
        raise self.broken(start, "it ends inside a number")

    def _value(self, wire: int) -> Any:
        if wire == _VARINT:
            return self._varint()
        if wire not in (_BYTES, _FIXED32, _FIXED64):
            raise self.broken(self._place, f"wire type {wire}")
        length = self._varint() if wire == _BYTES else 4 if wire == _FIXED32 else 8
        left = len(self._view) - self._place
        if length > left:
            raise self.broken(self._place, f"a field of {length} bytes where {left} are left")
        self._place += length
        return self._view[self._place - length : self._place]

    def decode(self, field: Field, raw: Any, packed: bool, start: int) -> Any:
        """The value of a field from its raw one."""
        if field.message is not None:
            return parse_message(raw, field.message, self._where)
        if field.kind in _DTYPE:
            size = np.dtype(_DTYPE[field.kind]).itemsize
            if len(raw) % size:
                raise self.broken(start, f"field {field.name} holds {len(raw)} bytes, no multiple of {size}")
            return np.frombuffer(raw, _DTYPE[field.kind])
        if field.kind == "ints" and packed:
            return unpack_varints(raw, f"{self._where}: {self._message.name}.{field.name}")
        if field.kind in ("int", "ints"):
            value = raw - (1 << 64) if raw >= 1 << 63 else raw
            return np.array([value]) if field.kind == "ints" else value
        if field.kind == "text":
            try:
                return bytes(raw).decode("utf-8")
            except UnicodeDecodeError as error:
                raise self.broken(start, f"field {field.name} is no text") from error
        return raw if field.kind == "bytes" else struct.unpack("<d" if field.kind == "double" else "<f", raw)[0]


def _concatenated(kind: Kind, found: list[NDArray[Any]]) -> NDArray[Any]:
    if len(found) == 1:
        return found[0]
    return np.concatenate(found) if found else np.zeros(0, _DTYPE.get(kind, np.int64))


def unpack_varints(data: bytes | memoryview, where: str) -> NDArray[np.int64]:
    """A row of varints, all at once: i64[n]; negative numbers take ten bytes each.

    Raises:
        InputError: the last number is cut off, or one is longer than ten bytes.
    """
    codes = np.frombuffer(data, np.uint8)
    if len(codes) == 0:
        return np.zeros(0, np.int64)
    last = np.flatnonzero(codes < 0x80)
    if len(last) == 0 or last[-1] != len(codes) - 1:
        raise InputError("packed numbers are cut off", where=where)
    first = np.r_[0, last[:-1] + 1]
    lengths = last - first + 1
    if lengths.max() > 10:
        raise InputError("a packed number has more than ten bytes", where=where)
    if lengths.max() == 1:
        return codes.astype(np.int64)
    shift = (np.arange(len(codes)) - np.repeat(first, lengths)).astype(np.uint64) * np.uint64(7)
    return np.add.reduceat((codes & np.uint8(0x7F)).astype(np.uint64) << shift, first).view(np.int64)


# --- the messages of the data set -----------------------------------------------------------------


def _message(title: str, /, *passed: int, **fields: tuple[Any, ...]) -> Message:
    """A description from fields by name: number, kind and, for messages, their description. ``passed``: numbers of
    official fields that are not kept."""
    return Message(title, {number: Field(field, *kind) for field, (number, *kind) in fields.items()}, frozenset(passed))


_TRANSFORM = _message("Transform", values=(1, "doubles"))
_CAMERA_CALIBRATION = _message(
    "CameraCalibration",
    name=(1, "int"),
    intrinsic=(2, "doubles"),
    extrinsic=(3, "message", _TRANSFORM),
    width=(4, "int"),
    height=(5, "int"),
    direction=(6, "int"),
)
_LASER_CALIBRATION = _message(
    "LaserCalibration",
    name=(1, "int"),
    inclinations=(2, "doubles"),
    inclination_min=(3, "double"),
    inclination_max=(4, "double"),
    extrinsic=(5, "message", _TRANSFORM),
)
_STATS = _message("Stats", 1, 5, time_of_day=(2, "text"), location=(3, "text"), weather=(4, "text"))
CONTEXT: Final = _message(
    "Context",
    name=(1, "text"),
    cameras=(2, "messages", _CAMERA_CALIBRATION),
    lasers=(3, "messages", _LASER_CALIBRATION),
    stats=(4, "message", _STATS),
)
_VELOCITY = _message(
    "Velocity",
    v_x=(1, "float"),
    v_y=(2, "float"),
    v_z=(3, "float"),
    w_x=(4, "double"),
    w_y=(5, "double"),
    w_z=(6, "double"),
)
_PANOPTIC = _message("CameraSegmentationLabel", 3, 4, 5, divisor=(1, "int"), png=(2, "bytes"))
_CAMERA_IMAGE = _message(
    "CameraImage",
    name=(1, "int"),
    image=(2, "bytes"),
    pose=(3, "message", _TRANSFORM),
    velocity=(4, "message", _VELOCITY),
    pose_time_s=(5, "double"),
    shutter_s=(6, "double"),
    trigger_s=(7, "double"),
    done_s=(8, "double"),
    panoptic=(10, "message", _PANOPTIC),
)
_RANGE_IMAGE = _message("RangeImage", 1, 5, 6, ranges=(2, "bytes"), projections=(3, "bytes"), poses=(4, "bytes"))
_LASER = _message("Laser", name=(1, "int"), return1=(2, "message", _RANGE_IMAGE), return2=(3, "message", _RANGE_IMAGE))
_BOX = _message(
    "Box",
    x=(1, "double"),
    y=(2, "double"),
    z=(3, "double"),
    width=(4, "double"),
    length=(5, "double"),
    height=(6, "double"),
    heading=(7, "double"),
)
_LABEL = _message("Label", 2, 5, 6, 7, 8, 9, 10, 11, 12, 13, box=(1, "message", _BOX), type=(3, "int"), id=(4, "text"))
FRAME: Final = _message(
    "Frame",
    7,
    8,
    9,
    10,
    11,
    context=(1, "bytes"),
    timestamp_us=(2, "int"),
    pose=(3, "message", _TRANSFORM),
    images=(4, "messages", _CAMERA_IMAGE),
    lasers=(5, "messages", _LASER),
    labels=(6, "messages", _LABEL),
)
_SHAPE = _message("MatrixShape", dims=(1, "ints"))
MATRIX_FLOAT: Final = _message("MatrixFloat", data=(1, "floats"), shape=(2, "message", _SHAPE))
MATRIX_INT: Final = _message("MatrixInt32", data=(1, "ints"), shape=(2, "message", _SHAPE))
