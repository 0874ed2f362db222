"""``log.json``, the index of a log in the neutral layout, as checked records. The layout is docs/custom_format.md.

As in ``scene/schema.py``, the parser takes ``complain``: the importer raises at the first problem, ``mudg doctor`` collects all.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Final, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, WrapValidator

from mudg.base import store
from mudg.base.errors import InputError
from mudg.base.records import Number, StrictRecord, checked_by, named_by, parse_record, place
from mudg.base.types import Camera, EgoPath, Ref, Source, Track
from mudg.data.importers import common
from mudg.data.importers.images import Lens, brown_conrady, equidistant
from mudg.data.scene import schema

Matrix = NDArray[np.float64]
INDEX: Final = "log.json"
FORMAT: Final = "mudg-log"
VERSION: Final = 1
LENSES: Final = {"brown_conrady": (brown_conrady, (4, 5, 8)), "equidistant": (equidistant, (4,))}
"""Distortion models and how many coefficients they take."""


# --- what log.json may hold ---------------------------------------------------------------------------------------------


class QuaternionEntry(StrictRecord):
    """A pose as a unit quaternion and a translation in metres."""

    wxyz: list[Number]
    xyz_m: list[Number]


def _pose(value: Any, numbers: Any) -> Matrix:
    """3 or 4 rows of 4 numbers (or 12 or 16 numbers), or ``{"wxyz": [...], "xyz_m": [...]}``, as f64[4, 4]."""
    if isinstance(value, dict):
        entry = parse_record(QuaternionEntry, value, "")
        return common.pose_from_quaternion(entry.wxyz, entry.xyz_m, "")
    try:
        rows = schema.sixteen_numbers(value)
    except InputError as problem:
        expected = '3 or 4 rows of 4 numbers, or {"wxyz": [w, x, y, z], "xyz_m": [x, y, z]}'
        raise InputError("pose is of no known form", got=problem.got, expected=expected) from problem
    return common.rigid_pose(np.array(numbers(rows)).reshape(4, 4), "")


def _time(value: Any, number: Any) -> Any:
    """A time in the log's unit: whole numbers stay whole."""
    number(value)
    if isinstance(value, int) and abs(value) >= 1 << 62:
        raise InputError("time makes no sense", got=str(value)[:40])
    return value


Pose = Annotated[list[Number], WrapValidator(checked_by(_pose))]
"""Rigid, f64[4, 4]."""
Time = Annotated[Number, WrapValidator(checked_by(_time))]


class DistortionEntry(StrictRecord):
    """A lens."""

    model: Literal["brown_conrady", "equidistant"]
    coefficients: list[Number]


class LogCameraEntry(StrictRecord):
    """A camera; ``cx`` and ``cy`` count from ``pixel_centre``."""

    width: int
    height: int
    fx: Number
    fy: Number
    cx: Number
    cy: Number
    ego_from_camera: Pose
    distortion: DistortionEntry | None = None
    pixel_centre: Number = 0.0
    readout_s: Number = 0.0


class LogLidar(StrictRecord):
    """A LiDAR: where it sits, which fields of its clouds mean what, and whether its sweeps are motion-compensated.

    Args:
        intensity_field: empty = clouds have no intensities.
        intensity_max: intensities are divided by it.
        time_field: empty = clouds have no times; else ``time_unit`` is their unit.
        time_from: whether times of points count from the sweep's time or on the log's clock.
    """

    ego_from_sensor: Pose = Field(alias="ego_from_lidar")
    motion_compensated: bool
    intensity_field: str = "intensity"
    intensity_max: Annotated[Number, Field(gt=0)] = 1.0
    time_field: str = ""
    time_unit: common.TimeUnit | None = None
    time_from: Literal["sweep", "log"] = "sweep"


class EgoPoseEntry(StrictRecord):
    """One pose of the vehicle."""

    time: Time
    world_from_ego: Pose


class LogImageEntry(StrictRecord):
    """One image."""

    camera: str
    time: Time
    file: schema.FileRef
    world_from_camera: Pose | None = None


class LogCloudEntry(StrictRecord):
    """One cloud."""

    lidar: str
    time: Time
    file: schema.FileRef


class BoxEntry(StrictRecord):
    """One box of a track."""

    time: Time
    world_from_object: Pose


class LogTrackEntry(StrictRecord):
    """One track."""

    id: str
    label: str = Field(alias="class")
    size_m: schema.BoxSize
    boxes: list[BoxEntry]


class LogIndex(StrictRecord):
    """The top of ``log.json``; the records of its lists and tables are checked one by one."""

    format: str
    version: int
    name: schema.Name
    licence: str
    time_unit: common.TimeUnit
    cameras: dict[str, Any]
    ego: list[Any]
    images: list[Any]
    dataset: str = "custom"
    lidars: dict[str, Any] = {}
    sweeps: list[Any] = []
    tracks: list[Any] = []


# --- what a log holds -------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, eq=False)
class LogCamera:
    """A camera as recorded, its lens (None = rectified images), and where it sits on the vehicle."""

    camera: Camera
    lens: Lens | None
    ego_from_sensor: Matrix


@dataclass(frozen=True, slots=True, eq=False)
class LogItem:
    """One image or cloud: its sensor and where that sits, seconds since the start, file, its own pose if the log gives one."""

    kind: Literal["image", "cloud"]
    sensor: str
    ego_from_sensor: Matrix
    time_s: float
    file: Ref
    world_from_sensor: Matrix | None = None


class LogClock(NamedTuple):
    """Where seconds count from: the first vehicle pose, in the log's own unit, ``units_per_s`` units per second."""

    unit: common.TimeUnit
    start: float
    units_per_s: int


@dataclass(frozen=True, slots=True, eq=False)
class CustomLog:
    """A parsed ``log.json``. Seconds count from the first vehicle pose; the world's origin is that pose's place.

    ``origin_m`` f64[3] was taken from every position. Images and sweeps are in time order per sensor.
    """

    root: Path
    name: str
    source: Source
    cameras: Mapping[str, LogCamera]
    lidars: Mapping[str, LogLidar]
    ego: EgoPath
    images: tuple[LogItem, ...]
    sweeps: tuple[LogItem, ...]
    tracks: tuple[Track, ...]
    clock: LogClock
    origin_m: NDArray[np.float64]


# --- parsing ------------------------------------------------------------------------------------------------------------


def read_log(root: Path, complain: schema.Complain = schema.raise_first) -> CustomLog:
    """Parse ``root/log.json``.

    Args:
        complain: called with each problem; a record with a problem is left out.

    Raises:
        InputError: the frame of the file or the vehicle's path is wrong, or ``complain`` raised.
    """
    where = str(root / INDEX)
    top = _parse_index(schema.parse_object(store.read_bytes(root / INDEX), where), where)
    cameras = schema.parse_table(top.cameras, f"{where}: cameras", _parse_camera, complain)
    lidars = schema.parse_table(top.lidars, f"{where}: lidars", _parse_lidar, complain)
    if not cameras:
        expected = "at least one camera by name"
        complain(InputError("the log has no cameras", where=f"{where}: cameras", expected=expected))
    if not top.ego:
        raise InputError("the log has no vehicle poses", where=f"{where}: ego", expected="at least one")
    path = schema.parse_each(
        top.ego, f"{where}: ego", lambda value, at: parse_record(EgoPoseEntry, value, at), schema.raise_first
    )
    clock = LogClock(top.time_unit, path[0].time, common.UNITS_PER_SECOND[top.time_unit])
    poses = np.stack([entry.world_from_ego for entry in path])
    origin_m = poses[0, :3, 3].copy()
    poses[:, :3, 3] -= origin_m
    ego = EgoPath(common.seconds([entry.time for entry in path], clock.unit, f"{where}: ego", clock.start), poses)
    reader = _LogReader(where, clock, origin_m, complain)
    images = reader.items("images", top.images, LogImageEntry, top.cameras, cameras)
    sweeps = reader.items("sweeps", top.sweeps, LogCloudEntry, top.lidars, lidars)
    tracks = reader.tracks(top.tracks)
    notes = ["read from the neutral layout"]
    if np.abs(origin_m).max() > 0:
        coordinates = ", ".join(f"{value:.3f}" for value in origin_m)
        notes.append(f"world origin moved to the first vehicle position, ({coordinates}) in the log")
    source = Source(top.dataset, top.licence, None, tuple(notes))
    return CustomLog(
        root, top.name, source, cameras, lidars, ego, tuple(images), tuple(sweeps), tuple(tracks), clock, origin_m
    )


def _parse_index(value: dict[str, Any], where: str) -> LogIndex:
    found = value.get("format"), value.get("version")
    if found != (FORMAT, VERSION):
        what = "this is not the index of a log in the neutral layout"
        expected = f'"format": "{FORMAT}", "version": {VERSION}'
        raise InputError(what, where=where, expected=expected, got=f"{found[0]!r}, {found[1]!r}"[:80])
    return parse_record(LogIndex, value, f"{where}: ")


def _parse_camera(name: str, value: object, where: str) -> LogCamera:
    entry = parse_record(LogCameraEntry, value, where)
    if entry.pixel_centre not in (0.0, 0.5):
        expected = "0 (the middle of the top-left pixel is (0, 0), as in OpenCV) or 0.5"
        where, got = place(where, "pixel_centre"), f"{entry.pixel_centre:g}"
        raise InputError("pixel centre makes no sense", where=where, expected=expected, got=got)
    coefficients = entry.distortion.coefficients if entry.distortion is not None else []
    plain = {key: getattr(entry, key) for key in ("width", "height", "fx", "fy", "readout_s")}
    middle = {key: getattr(entry, key) + 0.5 - entry.pixel_centre for key in ("cx", "cy")}
    camera = schema.parse_camera(name, {**plain, **middle, "distortion": coefficients}, where)
    return LogCamera(camera, _lens(entry.distortion, place(where, "distortion")), np.asarray(entry.ego_from_camera))


def _lens(entry: DistortionEntry | None, where: str) -> Lens | None:
    if entry is None:
        return None
    make, counts = LENSES[entry.model]
    if len(entry.coefficients) not in counts:
        expected, got = " or ".join(str(count) for count in counts), str(len(entry.coefficients))
        what = "distortion model takes another number of coefficients"
        raise InputError(what, where=place(where, "coefficients"), expected=expected, got=got)
    return make(*entry.coefficients) if any(entry.coefficients) else None


def _parse_lidar(name: str, value: object, where: str) -> LogLidar:
    schema.check_name(name, where)
    lidar = parse_record(LogLidar, value, where)
    if bool(lidar.time_field) != (lidar.time_unit is not None):
        expected = f"time_field, and time_unit: one of {', '.join(common.UNITS_PER_SECOND)}"
        raise InputError("times of points need their field and its unit", where=where, expected=expected)
    return lidar


class _LogReader:
    """Parses records that depend on the log's clock and origin."""

    def __init__(self, where: str, clock: LogClock, origin_m: NDArray[np.float64], complain: schema.Complain) -> None:
        self.where, self.clock, self.origin_m, self.complain = where, clock, origin_m, complain

    def seconds(self, times: list[Any], where: str) -> NDArray[np.float64]:
        """Seconds since the start, checked."""
        return common.seconds(times, self.clock.unit, where, self.clock.start)

    def in_scene(self, pose: Any) -> Matrix:
        """A pose in the log's world, moved to the scene's."""
        moved = np.array(pose)
        moved[:3, 3] -= self.origin_m
        return moved

    def items(
        self,
        kind: str,
        values: list[Any],
        entry_type: type[LogImageEntry] | type[LogCloudEntry],
        declared: Iterable[str],
        usable: Mapping[str, LogCamera] | Mapping[str, LogLidar],
    ) -> list[LogItem]:
        """Images or sweeps in time order per sensor; a sensor whose times are wrong is complained about and left out.

        Args:
            kind: ``images`` or ``sweeps``.
            declared: names of all sensors of the log.
            usable: those that were parsed; records of others are left out.
        """
        names = tuple(declared)
        key, item_kind = ("camera", "image") if entry_type is LogImageEntry else ("lidar", "cloud")

        def parse(value: object, where: str) -> tuple[str, Any]:
            entry = parse_record(entry_type, value, where)
            sensor = getattr(entry, key)
            if sensor not in names:
                what, expected = f"record names a {key} that the log does not have", ", ".join(names)
                expected = expected or f"an entry in {key}s"
                raise InputError(what, where=place(where, key), expected=expected, got=sensor[:80])
            return sensor, entry

        entries = schema.parse_each(values, f"{self.where}: {kind}", parse, self.complain)
        found: list[LogItem] = []
        for name, parsed in usable.items():
            own = [entry for sensor, entry in entries if sensor == name]
            where = f"{self.where}: {kind} of {name}"
            if not own:
                self.complain(InputError(f"{name} has no {kind}", where=where, remedy=f"add them, or remove {name}"))
                continue
            try:
                times = self.seconds([entry.time for entry in own], where).tolist()
            except InputError as problem:
                self.complain(problem)
                continue
            mounted = np.asarray(parsed.ego_from_sensor)
            for entry, time_s in zip(own, times, strict=True):
                pose = getattr(entry, "world_from_camera", None)
                placed = None if pose is None else self.in_scene(pose)
                found.append(LogItem(item_kind, name, mounted, time_s, Ref(entry.file), placed))
        return found

    def tracks(self, values: list[Any]) -> list[Track]:
        """Tracked boxes."""

        def parse(value: object, where: str) -> Track:
            entry = parse_record(LogTrackEntry, value, where)
            times_s = self.seconds([box.time for box in entry.boxes], place(where, "boxes"))
            poses = [self.in_scene(box.world_from_object) for box in entry.boxes]
            with named_by(where):
                return Track(entry.id, entry.label, np.array(entry.size_m), times_s, np.reshape(poses, (-1, 4, 4)))

        tracks = schema.parse_each(values, f"{self.where}: tracks", parse, self.complain)
        for twice in schema.repeated(track.id for track in tracks):
            self.complain(InputError("two tracks have one id", where=f"{self.where}: tracks", got=twice))
        return tracks
