"""What a Waymo log holds, whichever form it comes in: calibrations, one record of facts per frame, and the bulky parts
on demand.

Poses and transforms are f64[4, 4]. ``global`` is the data set's own world, which may lie tens of kilometres from the
car. The data set's camera frame is x forward, y left, z up.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Final, Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from mudg.base.errors import InputError
from mudg.base.geometry import yaw_matrix
from mudg.base.types import Track
from mudg.formats.importers.common import rigid_pose
from mudg.formats.importers.drive_log import BoxTracks
from mudg.formats.unknown_fields import note_unknown

Matrix = NDArray[np.float64]
Numbers = Sequence[float] | NDArray[np.float64]

CAMERAS: Final[Mapping[int, str]] = {1: "front", 2: "front_left", 3: "front_right", 4: "side_left", 5: "side_right"}
LASERS: Final[Mapping[int, str]] = {1: "top", 2: "front", 3: "side_left", 4: "side_right", 5: "rear"}
LABELS: Final[Mapping[int, str]] = {1: "vehicle", 2: "pedestrian", 3: "sign", 4: "cyclist"}
"""Numbers of the data set -> names. Whatever has another number is left out (sensors) or called ``unknown`` (boxes)."""

TOP: Final = "top"
VELOCITY: Final = ("v_x", "v_y", "v_z", "w_x", "w_y", "w_z")
MAX_UNPACKED_BYTES: Final = 128 * 1024 * 1024
"""A range image of the top LiDAR has 3 MB; what unpacks to more than this is refused."""

MAX_CLOCK_GAP_S: Final = 1.0


@dataclass(frozen=True, slots=True)
class CameraCalibration:
    """A camera: ``intrinsic`` is f_u, f_v, c_u, c_v (pixels, the image's left edge is 0), k1, k2, p1, p2, k3."""

    name: str
    intrinsic: tuple[float, ...]
    vehicle_from_camera: Matrix = field(compare=False)
    width: int
    height: int
    direction: int


@dataclass(frozen=True, slots=True)
class LaserCalibration:
    """A LiDAR: beam ``inclinations`` in radians from the lowest up, or () where they are even between the two
    limits."""

    name: str
    inclinations: tuple[float, ...]
    inclination_min: float
    inclination_max: float
    vehicle_from_lidar: Matrix = field(compare=False)

    def beam_inclinations(self, rows: int, where: str) -> NDArray[np.float64]:
        """Inclination of every row of a range image, f64[rows] radians; the top row looks highest."""
        if self.inclinations:
            if len(self.inclinations) != rows:
                what = "range image does not have a row for every beam"
                expected = f"{len(self.inclinations)} rows (calibration of LiDAR {self.name})"
                raise InputError(what, where=where, expected=expected, got=f"{rows} rows")
            return np.array(self.inclinations)[::-1]
        step = (self.inclination_max - self.inclination_min) / rows
        return self.inclination_max - (np.arange(rows, dtype=np.float64) + 0.5) * step


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
class WaymoBox:
    """A box in the vehicle frame of its frame: centre, (length, width, height) in metres, heading in radians."""

    id: str
    label: str
    centre: tuple[float, float, float]
    size_m: tuple[float, float, float]
    heading: float


@dataclass(frozen=True, slots=True, eq=False)
class FrameRecord:
    """The facts of a frame that fit into memory for a whole log."""

    number: int
    """Place in the log, counted from 0."""
    timestamp_us: int
    """Microseconds of the epoch at which the top LiDAR began its turn."""
    global_from_vehicle: Matrix
    """The pose that boxes and compensated points refer to; not the pose at ``timestamp_us``."""
    shots: Mapping[str, CameraShot]
    """By camera; those without an image are not listed."""
    lasers: tuple[str, ...]
    """Names of the LiDARs with a range image."""
    boxes: tuple[WaymoBox, ...]
    where: str


@dataclass(frozen=True, slots=True, eq=False)
class LaserScan:
    """One turn of a LiDAR."""

    returns: Sequence[NDArray[np.float32]]
    """Range images f32[H, W, 4]: range in metres (not above 0: none), intensity, elongation, no-label flag."""
    poses: NDArray[np.float32] | None = None
    """Of the top LiDAR's pixels, f32[H, W, 6]: roll, pitch, yaw, x, y, z of global from vehicle at their time."""


@dataclass(frozen=True, slots=True, eq=False)
class Panoptic:
    """A panoptic label: a 16-bit PNG of class * divisor + instance."""

    divisor: int
    png: bytes


@dataclass(frozen=True, slots=True, eq=False)
class FrameContent:
    """The bulky parts of a frame: JPEG bytes and labels by camera name, scans by LiDAR name."""

    images: Mapping[str, bytes]
    panoptic: Mapping[str, Panoptic]
    scans: Mapping[str, LaserScan]


class WaymoLog(Protocol):
    """A log in one of its two forms."""

    name: str
    form: str
    cameras: Mapping[str, CameraCalibration]
    lasers: Mapping[str, LaserCalibration]
    frames: Sequence[FrameRecord]
    conditions: str

    def read(self, frame: FrameRecord, cameras: Sequence[str]) -> FrameContent:
        """The bulky parts of a frame, for the chosen cameras."""
        ...

    def pixel_poses(self, frame: FrameRecord) -> NDArray[np.float32] | None:
        """Poses of the top LiDAR's pixels, or None where there are none."""
        ...


# --- records from the numbers of either form ------------------------------------------------------


def transform_of(values: Numbers, where: str) -> Matrix:
    """A rigid 4x4 from its sixteen numbers, row by row. Raises InputError: another count of numbers, or no rigid
    motion."""
    if len(values) != 16:
        raise InputError("transform is incomplete", where=where, expected="16 numbers", got=str(len(values)))
    return rigid_pose(np.asarray(values, np.float64).reshape(4, 4), where)


def camera_of(
    name: str, intrinsic: Sequence[float], extrinsic: Numbers, image: tuple[int, int, int], where: str
) -> CameraCalibration:
    """A calibration from its numbers; ``image`` is width, height and the direction of the shutter. Raises InputError:
    intrinsics that are not nine finite numbers, or no rigid extrinsics."""
    where, values = f"{where}: calibration of camera {name}", tuple(float(value) for value in intrinsic)
    if len(values) != 9 or not np.isfinite(values).all():
        raise InputError("intrinsics are incomplete", where=where, expected="9 finite numbers", got=str(values))
    return CameraCalibration(name, values, transform_of(extrinsic, where), *image)


def laser_of(
    name: str, beams: Sequence[float], limits: tuple[float, float], extrinsic: Numbers, where: str
) -> LaserCalibration:
    """A calibration from its numbers: inclinations of the beams, or none and their limits, in radians. Raises
    InputError: inclinations that are not finite or not in order, or no rigid extrinsics."""
    where, beams = f"{where}: calibration of LiDAR {name}", tuple(float(value) for value in beams)
    if not np.isfinite(beams or limits).all() or not (beams or limits[0] < limits[1]):
        raise InputError("beam inclinations make no sense", where=where, expected="radians", got=str(beams or limits))
    return LaserCalibration(name, beams, *limits, transform_of(extrinsic, where))


def box_of(box_id: str, number: int, values: Sequence[float], where: str) -> WaymoBox:
    """A box from the number of its class and x, y, z, length, width, height, heading. Raises InputError: numbers that
    are not finite, or a size that is not positive."""
    x, y, z, length, width, height, heading = (float(value) for value in values)
    if not np.isfinite(values).all() or min(length, width, height) <= 0:
        expected = "finite numbers, positive length, width and height"
        got = f"centre {(x, y, z)}, size {(length, width, height)}, heading {heading}"
        raise InputError("box makes no sense", where=f"{where}: box {box_id}", expected=expected, got=got)
    return WaymoBox(box_id, LABELS.get(number, "unknown"), (x, y, z), (length, width, height), heading)


def by_name(shots: Iterable[tuple[str, CameraShot]], timestamp_us: int, where: str) -> dict[str, CameraShot]:
    """The images of one frame by camera, their clock compared with the frame's: seconds and microseconds of one epoch.
    Raises InputError: two images of one camera; times that are not finite, contradict each other, or are more than a
    second off."""
    found: dict[str, CameraShot] = {}
    for name, shot in shots:
        here = f"{where}: image of camera {name}"
        if name in found:
            raise InputError("frame has two images of one camera", where=here)
        times = (shot.pose_time_s, *((shot.trigger_s, shot.done_s) if shot.done_s else ()))
        if not max(abs(time - timestamp_us / 1e6) for time in times) <= MAX_CLOCK_GAP_S:
            what = "image and frame are not of one time"
            expected = f"seconds within {MAX_CLOCK_GAP_S} s of the frame's {timestamp_us} microseconds"
            got = ", ".join(f"{time!r}" for time in times)
            remedy = "are the units seconds (images) and microseconds (frames)?"
            raise InputError(what, where=here, expected=expected, got=got, remedy=remedy)
        if shot.done_s and not 0 <= shot.shutter_s <= shot.done_s - shot.trigger_s < MAX_CLOCK_GAP_S:
            what = "exposure times contradict each other"
            got = f"shutter {shot.shutter_s:g}, trigger to readout end {shot.done_s - shot.trigger_s:g}"
            raise InputError(what, where=here, expected="0 <= shutter <= readout end - trigger, seconds", got=got)
        found[name] = shot
    return found


def each_once(lasers: Sequence[str], where: str) -> tuple[str, ...]:
    """Names of the LiDARs with a scan in one frame; two scans of one are refused."""
    if len(set(lasers)) < len(lasers):
        raise InputError("frame has two scans of one LiDAR", where=where, got=", ".join(lasers))
    return tuple(lasers)


# --- range images ---------------------------------------------------------------------------------


def float_image(packed: bytes | memoryview, channels: int, where: str) -> NDArray[np.float32]:
    """A zlib-packed matrix of floats as f32[H, W, channels]. Raises InputError: damaged, too large, or of another
    shape."""
    unpacker = zlib.decompressobj()
    try:
        content = unpacker.decompress(packed, MAX_UNPACKED_BYTES)
    except zlib.error as error:
        raise InputError("range image cannot be unpacked", where=where, got=str(error)) from error
    if not unpacker.eof:
        cut_off = not unpacker.unconsumed_tail
        what = "range image is cut off" if cut_off else "range image unpacks to more than any has"
        raise InputError(what, where=where, expected=f"at most {MAX_UNPACKED_BYTES} bytes", got=f"{len(content)} bytes")
    values = parse_message(content, MATRIX_FLOAT, where)
    return shaped(values["data"], values.get("shape", {}).get("dims", ()), channels, where)


def shaped(data: NDArray[Any], dims: Sequence[int] | NDArray[np.integer], channels: int, where: str) -> NDArray[Any]:
    """``data`` [H * W * channels] as [H, W, channels], if its declared shape says so."""
    shape = tuple(int(n) for n in dims)
    if len(shape) != 3 or min(shape) < 1 or shape[2] != channels or int(np.prod(shape)) != len(data):
        what, expected = "range image has the wrong shape", f"[rows, columns, {channels}], as many values as that"
        raise InputError(what, where=where, expected=expected, got=f"{list(shape)} with {len(data)} values")
    return data.reshape(shape)


# tracks -------------------------------------------------------------------------------------------
#
# The points of a frame were measured over a tenth of a second, in which a car drives two metres. A box drawn around
# points holds where its object was when the LiDAR passed it; a description of the data set speaks of the frame's start
# instead. So the log is asked: under which of the ``Moment`` do most points near fast objects lie inside their boxes?
# Each box is then carried, with its object's own speed, to the moment that all of the frame's points are given for.
Moment = Literal["seen", "start", "pose"]
"""A box holds when the LiDAR looked at its object, at the frame's timestamp, or at the moment of the frame's pose."""

MOMENTS: Final[tuple[Moment, ...]] = ("seen", "start", "pose")
FAST_M_S: Final = 3.0
_CLEAR_GAIN: Final = 1.05
_FLOOR_M: Final = 0.3

_SPEED_REACH: Final = 2
"""A speed is the slope of a straight line through so many boxes before and after."""


@dataclass(frozen=True, slots=True, eq=False)
class TimedBoxes:
    """The boxes of one frame."""

    time_s: float
    """Moment the frame's points are given for."""
    world_from_vehicle: Matrix
    boxes: Sequence[WaymoBox]
    late_s: NDArray[np.float64]
    """For each box, seconds after ``time_s`` for which it holds."""
    where: str
    images_s: tuple[float, float] | None = None
    """Times of the frame's first and last image, which need the objects where they were then."""


def build_tracks(frames: Sequence[TimedBoxes]) -> tuple[list[Track], list[str]]:
    """Tracks, and notes about what was done to them. A track begins with the first image of its first frame and ends
    with the last image of its last one: some hundredths of a second are added to either end with the object's velocity,
    or else images at the ends would lack the object. Raises InputError: a box without an id, two boxes of one id in a
    frame, a class that changes, or length and width are swapped."""
    tracks = BoxTracks(frames[0].where if frames else "", {})
    labels: dict[str, str] = {}
    for frame in frames:
        seen: set[str] = set()
        for box, late in zip(frame.boxes, frame.late_s, strict=True):
            if not box.id or box.id in seen:
                what = "frame has two boxes of one object" if box.id else "box has no id"
                raise InputError(what, where=frame.where, got=repr(box.id))
            seen.add(box.id)
            if labels.setdefault(box.id, box.label) != box.label:
                what = "the class of an object changes"
                raise InputError(what, where=f"{frame.where}: object {box.id}", expected=labels[box.id], got=box.label)
            # a track's name begins with no sign, as the data set's random ids may
            name = box.id if box.id[0].isalnum() else f"t{box.id}"
            pose = frame.world_from_vehicle @ yaw_matrix(box.heading, box.centre)
            tracks.add(name, box.label, frame.time_s, box.size_m, pose, late_s=float(late), where=frame.where)
    images_s = {frame.time_s: frame.images_s or (frame.time_s, frame.time_s) for frame in frames}
    found, notes = tracks.tracks(_line_speeds, images_s)
    unknown = sum(track.label == "unknown" for track in found)
    if unknown:
        notes.append(f"{unknown} boxes have a class that is not known and are called unknown")
    return found, notes


def _line_speeds(times_s: NDArray[np.float64], xyz: NDArray[np.float64], _pieces: object) -> NDArray[np.float64]:
    """Velocity f64[T, 3] by a straight line through the neighbouring keys; zero where there is one key only.

    Times of neighbouring keys may be equal: an object that passes behind the LiDAR is seen at the end of one turn and
    at once again at the beginning of the next.
    """
    velocity = np.zeros_like(xyz)
    for index in range(len(times_s)):
        near = slice(max(0, index - _SPEED_REACH), index + _SPEED_REACH + 1)
        time = times_s[near] - times_s[near].mean()
        spread = float(time @ time)
        if spread > 1e-4:
            velocity[index] = time @ (xyz[near] - xyz[near].mean(0)) / spread
    return velocity


def points_inside(
    box: WaymoBox,
    velocity_vehicle: NDArray[np.float64],
    xyz_vehicle: NDArray[np.float64],
    seen_s: NDArray[np.float64],
    late_s: float,
    middle_s: float,
) -> NDArray[np.int64]:
    """How many points lie inside a box if it holds at each of ``MOMENTS``, i64[3].

    Args:
        velocity_vehicle: of the object, f64[3] m/s along the vehicle's axes.
        xyz_vehicle, seen_s: points f64[N, 3] and when each was measured, seconds after the frame's timestamp f64[N].
        late_s: seconds after the frame's timestamp at which the LiDAR looked at the box.
        middle_s: moment of the frame's pose, seconds after the timestamp.
    """
    reach = max(box.size_m) / 2 + float(np.linalg.norm(velocity_vehicle)) * 0.2
    near = np.arange(len(xyz_vehicle))
    for axis in range(3):  # one axis after the other: most points cost one comparison
        near = near[np.abs(xyz_vehicle[near, axis] - box.centre[axis]) <= reach]
    offset = xyz_vehicle[near] - box.centre
    counts = np.zeros(len(MOMENTS), np.int64)
    turn = yaw_matrix(box.heading)[:3, :3]
    half = np.array(box.size_m) / 2
    for index, held_s in enumerate((late_s, 0.0, middle_s)):
        local = (offset - (seen_s[near, None] - held_s) * velocity_vehicle) @ turn
        counts[index] = ((np.abs(local) <= half) & (local[:, 2:] > _FLOOR_M - half[2])).all(1).sum()
    return counts


def choose_moment(counts: NDArray[np.int64]) -> Moment:
    """The moment under which most points (i64[3]) lie inside their boxes; ``seen`` unless another is clearly better."""
    best = int(counts.argmax())
    return MOMENTS[best] if counts[best] > _CLEAR_GAIN * counts[0] else MOMENTS[0]


def velocities(frames: Sequence[TimedBoxes]) -> list[dict[str, NDArray[np.float64]]]:
    """World velocity of every box by id, f64[3] m/s, in each frame: from the frames beside it; 0 for single boxes."""
    centres = [{box.id: (frame.world_from_vehicle @ [*box.centre, 1.0])[:3] for box in frame.boxes} for frame in frames]
    found: list[dict[str, NDArray[np.float64]]] = []
    for index, here in enumerate(centres):
        before, after = max(0, index - 1), min(len(frames) - 1, index + 1)
        speeds = {}
        for box_id, centre in here.items():
            first = before if box_id in centres[before] else index
            last = after if box_id in centres[after] else index
            span = frames[last].time_s - frames[first].time_s
            way = centres[last].get(box_id, centre) - centres[first].get(box_id, centre)
            speeds[box_id] = way / span if span > 0 else np.zeros(3)
        found.append(speeds)
    return found


# --- protocol-buffer messages by a table of the fields that are wanted; no generated code -----------------------------
#
# A message is a row of fields, each a key (number and wire type, a varint) and a value. ``Message`` lists what to keep;
# all else is skipped by its wire type. Values of bytes fields are views of the input: nothing large is copied.
#
# Source: the protocol-buffer encoding guide; the field numbers of the Waymo Open Dataset's published descriptions.
Kind = Literal["int", "float", "double", "bytes", "text", "message", "doubles", "floats", "ints", "messages"]

_VARINT, _FIXED64, _BYTES, _FIXED32 = 0, 1, 2, 5
_WIRE: Final[Mapping[Kind, int]] = {
    **dict.fromkeys(("int", "ints"), _VARINT),
    **dict.fromkeys(("double", "doubles"), _FIXED64),
    **dict.fromkeys(("float", "floats"), _FIXED32),
    **dict.fromkeys(("bytes", "text", "message", "messages"), _BYTES),
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
    """A message description; ``passed``: numbers of the data set's fields that are not kept."""

    name: str
    fields: Mapping[int, Field]
    passed: frozenset[int] = frozenset()


def parse_message(data: bytes | memoryview, message: Message, where: str) -> dict[str, Any]:
    """The wanted fields of a message. Raises InputError: cut off, a wire type that does not fit, or text that is not
    UTF-8.

    Args:
        data: the encoded message.
        message: what to keep.
        where: file and record, for errors.

    Returns:
        Field name -> value. Missing fields are left out, but repeated ones are always there: lists of dictionaries, or
        arrays f64, f32 or i64 [n]. Bytes are ``memoryview``. The last one wins where a single field stands twice.
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
        name, kind = message.fields[number].name, message.fields[number].kind
        if kind == "messages" or len(found) == 1:
            values[name] = found if kind == "messages" else found[0]
        else:
            values[name] = np.concatenate(found) if found else np.zeros(0, _DTYPE.get(kind, np.int64))
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

    def varints(self) -> Iterator[int]:
        """Numbers to the end."""
        while self._place < len(self._view):
            yield self._varint()

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
            numbers = _MessageReader(raw, self._message, self._where)
            return np.array(list(numbers.varints()), np.uint64).view(np.int64)
        if field.kind in ("int", "ints"):
            value = raw - (1 << 64) if raw >= 1 << 63 else raw
            return np.array([value]) if field.kind == "ints" else value
        if field.kind == "text":
            try:
                return bytes(raw).decode("utf-8")
            except UnicodeDecodeError as error:
                raise self.broken(start, f"field {field.name} is no text") from error
        return raw if field.kind == "bytes" else struct.unpack("<d" if field.kind == "double" else "<f", raw)[0]


# --- the messages of the data set -----------------------------------------------------------------


def _message(title: str, fields: str, passed: str = "", **inner: Message) -> Message:
    """A description from ``name number kind, ...``; where the name is one of ``inner``, that is its description.
    ``passed``: numbers of official fields that are not kept."""
    rows = (row.split() for row in fields.split(","))
    wanted = {int(number): Field(name, kind, inner.get(name)) for name, number, kind in rows}
    return Message(title, wanted, frozenset(map(int, passed.split())))


_TRANSFORM = _message("Transform", "values 1 doubles")
_CAMERA_CALIBRATION = _message(
    "CameraCalibration",
    "name 1 int, intrinsic 2 doubles, extrinsic 3 message, width 4 int, height 5 int, direction 6 int",
    extrinsic=_TRANSFORM,
)
_LASER_CALIBRATION = _message(
    "LaserCalibration",
    "name 1 int, inclinations 2 doubles, inclination_min 3 double, inclination_max 4 double, extrinsic 5 message",
    extrinsic=_TRANSFORM,
)
CONTEXT: Final = _message(
    "Context",
    "name 1 text, cameras 2 messages, lasers 3 messages, stats 4 message",
    cameras=_CAMERA_CALIBRATION,
    lasers=_LASER_CALIBRATION,
    stats=_message("Stats", "time_of_day 2 text, location 3 text, weather 4 text", "1 5"),
)
_CAMERA_IMAGE = _message(
    "CameraImage",
    "name 1 int, image 2 bytes, pose 3 message, velocity 4 message, pose_time_s 5 double, shutter_s 6 double, "
    "trigger_s 7 double, done_s 8 double, panoptic 10 message",
    pose=_TRANSFORM,
    velocity=_message("Velocity", "v_x 1 float, v_y 2 float, v_z 3 float, w_x 4 double, w_y 5 double, w_z 6 double"),
    panoptic=_message("CameraSegmentationLabel", "divisor 1 int, png 2 bytes", "3 4 5"),
)
_RANGE_IMAGE = _message("RangeImage", "ranges 2 bytes, poses 4 bytes", "1 3 5 6")
_BOX = _message(
    "Box", "x 1 double, y 2 double, z 3 double, width 4 double, length 5 double, height 6 double, heading 7 double"
)
FRAME: Final = _message(
    "Frame",
    "context 1 bytes, timestamp_us 2 int, pose 3 message, images 4 messages, lasers 5 messages, labels 6 messages",
    "7 8 9 10 11",
    pose=_TRANSFORM,
    images=_CAMERA_IMAGE,
    lasers=_message(
        "Laser", "name 1 int, return1 2 message, return2 3 message", return1=_RANGE_IMAGE, return2=_RANGE_IMAGE
    ),
    labels=_message("Label", "box 1 message, type 3 int, id 4 text", "2 5 6 7 8 9 10 11 12 13", box=_BOX),
)
MATRIX_FLOAT: Final = _message(
    "MatrixFloat", "data 1 floats, shape 2 message", shape=_message("MatrixShape", "dims 1 ints")
)
