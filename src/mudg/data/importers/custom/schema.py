"""``log.json``, the index of a log in the neutral layout, into checked words. The layout is docs/custom_format.md.

As in ``scene_schema``, the parser takes ``complain``: the importer raises at the first problem, ``mudg doctor`` collects all.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from mudg.base import store
from mudg.base.errors import InputError
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


@dataclass(frozen=True, slots=True, eq=False)
class LogCamera:
    """A camera as recorded, its lens (None = rectified images), and where it sits on the vehicle."""

    camera: Camera
    lens: Lens | None
    ego_from_camera: Matrix


@dataclass(frozen=True, slots=True, eq=False)
class LogLidar:
    """A LiDAR: where it sits, which fields of its clouds mean what, and whether its sweeps are motion-compensated.

    Args:
        intensity_field: empty = clouds have no intensities.
        intensity_max: intensities are divided by it.
        times_per_s: units per second of the field ``time_field``; 0 = clouds have no times.
        absolute: times count from the log's clock, not from the sweep's time.
    """

    name: str
    ego_from_lidar: Matrix
    compensated: bool
    intensity_field: str
    intensity_max: float
    time_field: str
    times_per_s: int
    absolute: bool


@dataclass(frozen=True, slots=True, eq=False)
class LogImage:
    """One image: its camera's name, seconds since the start, file, its own pose if the log gives one."""

    camera: str
    time_s: float
    file: Ref
    world_from_camera: Matrix | None


@dataclass(frozen=True, slots=True, eq=False)
class LogSweep:
    """One cloud: its LiDAR's name, seconds since the start, file."""

    lidar: str
    time_s: float
    file: Ref


@dataclass(frozen=True, slots=True, eq=False)
class CustomLog:
    """A parsed ``log.json``. Seconds count from the first vehicle pose; the world's origin is that pose's place.

    ``start`` is that first time in the log's own unit, ``units_per_s`` units per second, ``origin_m`` what was taken from every
    position. Images and sweeps are in time order per sensor.
    """

    root: Path
    name: str
    source: Source
    cameras: Mapping[str, LogCamera]
    lidars: Mapping[str, LogLidar]
    ego: EgoPath
    images: tuple[LogImage, ...]
    sweeps: tuple[LogSweep, ...]
    tracks: tuple[Track, ...]
    start: float
    units_per_s: int
    origin_m: NDArray[np.float64]


def read_log(root: Path, complain: schema.Complain = schema.raise_first) -> CustomLog:
    """Parse ``root/log.json``.

    Args:
        complain: called with each problem; a record with a problem is left out.

    Raises:
        InputError: the frame of the file or the vehicle's path is wrong, or ``complain`` raised.
    """
    where = str(root / INDEX)
    top = _top(schema.parse_object(store.read_bytes(root / INDEX), where), where)
    unit = top.text("time_unit")
    if unit not in common.UNITS_PER_SECOND:
        raise InputError(
            "unit of time is not known",
            where=top.at("time_unit"),
            expected=", ".join(common.UNITS_PER_SECOND),
            got=unit[:40],
        )
    reader = _Reader(where, unit, complain)
    cameras = reader.table(top, "cameras", reader.camera)
    lidars = reader.table(top, "lidars", reader.lidar)
    if not cameras:
        complain(InputError("the log has no cameras", where=top.at("cameras"), expected="at least one camera by name"))
    ego = reader.ego(top.items("ego"))
    images = reader.images(top.items("images"), cameras)
    sweeps = reader.sweeps(top.items("sweeps") if "sweeps" in top else [], lidars)
    tracks = reader.tracks(top.items("tracks") if "tracks" in top else [])
    notes = ["read from the neutral layout"]
    if np.abs(reader.origin_m).max() > 0:
        notes.append(f"world origin moved to the first vehicle position, {_place(reader.origin_m)} in the log")
    source = Source(top.text("dataset") if "dataset" in top else "custom", top.text("licence"), None, tuple(notes))
    return CustomLog(
        root, top.name("name"), source, cameras, lidars, ego, tuple(images), tuple(sweeps), tuple(tracks),
        reader.start, common.UNITS_PER_SECOND[unit], reader.origin_m,
    )  # fmt: skip


def _place(xyz: NDArray[np.float64]) -> str:
    return f"({', '.join(f'{value:.3f}' for value in xyz)})"


def _top(value: dict[str, Any], where: str) -> schema.Record:
    if value.get("format") != FORMAT or value.get("version") != VERSION:
        raise InputError(
            "this is not the index of a log in the neutral layout", where=where,
            expected=f'"format": "{FORMAT}", "version": {VERSION}',
            got=f"{value.get('format')!r}, {value.get('version')!r}"[:80],
        )  # fmt: skip
    required = ("format", "version", "name", "licence", "time_unit", "cameras", "ego", "images")
    return schema.Record(value, where, required, ("dataset", "lidars", "sweeps", "tracks"))


class _Reader:
    """Records of one log; knows the unit of time, and after ``ego`` the start and origin."""

    def __init__(self, where: str, unit: Any, complain: schema.Complain) -> None:
        self.where, self.unit, self.complain = where, unit, complain
        self.start: float = 0
        self.origin_m = np.zeros(3)
        self.declared: dict[str, tuple[str, ...]] = {}

    # sensors

    def table(self, top: schema.Record, key: str, parse: Any) -> dict[str, Any]:
        """Named records; one with a problem is complained about and left out."""
        value = top.raw(key) if key in top else {}
        if not isinstance(value, dict):
            raise InputError(
                "field is not a table", where=top.at(key), expected='{"name": {...}}', got=type(value).__name__
            )
        self.declared[key] = tuple(value)
        found = {}
        for name, item in value.items():
            try:
                schema.check_name(name, f"{self.where}: {key}.{name}")
                found[name] = parse(name, item, f"{self.where}: {key}.{name}")
            except InputError as problem:
                self.complain(problem)
        return found

    def camera(self, name: str, value: object, where: str) -> LogCamera:
        """One camera."""
        required = ("width", "height", "fx", "fy", "cx", "cy", "ego_from_camera")
        record = schema.Record(value, where, required, ("distortion", "pixel_centre", "readout_s"))
        centre = record.number("pixel_centre") if "pixel_centre" in record else 0.0
        if centre not in (0.0, 0.5):
            raise InputError(
                "pixel centre makes no sense", where=record.at("pixel_centre"),
                expected="0 (the middle of the top-left pixel is (0, 0), as in OpenCV) or 0.5", got=f"{centre:g}",
            )  # fmt: skip
        lens, coefficients = _lens(record)
        plain = {key: record.raw(key) for key in ("width", "height", "fx", "fy", "readout_s") if key in record}
        middle = {key: record.number(key) + 0.5 - centre for key in ("cx", "cy")}
        camera = schema.camera_from_json(name, {**plain, **middle, "distortion": coefficients}, where)
        return LogCamera(camera, lens, pose(record.raw("ego_from_camera"), record.at("ego_from_camera")))

    def lidar(self, name: str, value: object, where: str) -> LogLidar:
        """One LiDAR."""
        optional = ("intensity_field", "intensity_max", "time_field", "time_unit", "time_from")
        record = schema.Record(value, where, ("ego_from_lidar", "motion_compensated"), optional)
        compensated = record.raw("motion_compensated")
        if not isinstance(compensated, bool):
            raise InputError(
                "field is neither true nor false", where=record.at("motion_compensated"), got=repr(compensated)[:40]
            )
        peak = record.number("intensity_max") if "intensity_max" in record else 1.0
        if peak <= 0:
            raise InputError("largest intensity must be positive", where=record.at("intensity_max"), got=f"{peak:g}")
        unit = record.text("time_unit") if "time_unit" in record else ""
        time_from = record.text("time_from") if "time_from" in record else "sweep"
        if ("time_field" in record) != ("time_unit" in record) or (unit and unit not in common.UNITS_PER_SECOND):
            raise InputError(
                "times of points need their field and its unit", where=where, got=unit,
                expected=f"time_field, and time_unit: one of {', '.join(common.UNITS_PER_SECOND)}",
            )  # fmt: skip
        if time_from not in ("sweep", "log"):
            raise InputError(
                "points' clock is not known", where=record.at("time_from"), expected="sweep or log", got=time_from[:40]
            )
        return LogLidar(
            name, pose(record.raw("ego_from_lidar"), record.at("ego_from_lidar")), compensated,
            record.text("intensity_field") if "intensity_field" in record else "intensity", peak,
            record.text("time_field") if "time_field" in record else "",
            common.UNITS_PER_SECOND[unit] if unit else 0, time_from == "log",
        )  # fmt: skip

    # what moves

    def ego(self, items: list[Any]) -> EgoPath:
        """The vehicle's path; sets the start of time and the origin of the world. Problems are raised: all else hangs on it."""
        where = f"{self.where}: ego"
        if not items:
            raise InputError("the log has no vehicle poses", where=where, expected="at least one")
        records = [schema.Record(v, f"{where}[{i}]", ("time", "world_from_ego")) for i, v in enumerate(items)]
        times = [_time(record, "time") for record in records]
        poses = np.stack([pose(r.raw("world_from_ego"), r.at("world_from_ego")) for r in records])
        self.start, self.origin_m = times[0], poses[0, :3, 3].copy()
        poses[:, :3, 3] -= self.origin_m
        return EgoPath(common.seconds(times, self.unit, where, self.start), poses)

    def world_pose(self, value: object, where: str) -> Matrix:
        """A pose in the log's world, moved to the scene's."""
        matrix = pose(value, where)
        matrix[:3, 3] -= self.origin_m
        return matrix

    def _each(self, key: str, items: list[Any], parse: Any) -> list[Any]:
        found = []
        for index, item in enumerate(items):
            try:
                found.append(parse(item, f"{self.where}: {key}[{index}]"))
            except InputError as problem:
                self.complain(problem)
        return found

    def _timed(self, kind: str, records: list[Any], sensor: int, names: Mapping[str, Any]) -> list[tuple[Any, float]]:
        """Records with seconds, sensor by sensor; a sensor whose times are wrong is complained about and left out."""
        found = []
        for name in names:
            own = [record for record in records if record[sensor] == name]
            where = f"{self.where}: {kind} of {name}"
            if not own:
                self.complain(InputError(f"{name} has no {kind}", where=where, remedy=f"add them, or remove {name}"))
                continue
            try:
                times = common.seconds([record[0] for record in own], self.unit, where, self.start)
            except InputError as problem:
                self.complain(problem)
                continue
            found += list(zip(own, times.tolist(), strict=True))
        return found

    def images(self, items: list[Any], cameras: Mapping[str, LogCamera]) -> list[LogImage]:
        """Images in time order per camera."""

        def parse(value: object, where: str) -> tuple[float, str, Ref, Matrix | None]:
            record = schema.Record(value, where, ("camera", "time", "file"), ("world_from_camera",))
            name = _known(record, "camera", self.declared["cameras"])
            own = None
            if "world_from_camera" in record:
                own = self.world_pose(record.raw("world_from_camera"), record.at("world_from_camera"))
            return _time(record, "time"), name, record.ref("file"), own

        records = self._each("images", items, parse)
        timed = self._timed("images", records, 1, cameras)
        return [LogImage(name, time_s, file, own) for (_, name, file, own), time_s in timed]

    def sweeps(self, items: list[Any], lidars: Mapping[str, LogLidar]) -> list[LogSweep]:
        """Sweeps in time order per LiDAR."""

        def parse(value: object, where: str) -> tuple[float, str, Ref]:
            record = schema.Record(value, where, ("lidar", "time", "file"))
            return _time(record, "time"), _known(record, "lidar", self.declared["lidars"]), record.ref("file")

        timed = self._timed("sweeps", self._each("sweeps", items, parse), 1, lidars)
        return [LogSweep(name, time_s, file) for (_, name, file), time_s in timed]

    def tracks(self, items: list[Any]) -> list[Track]:
        """Tracked boxes."""

        def parse(value: object, where: str) -> Track:
            record = schema.Record(value, where, ("id", "class", "size_m", "boxes"))
            boxes = [
                schema.Record(box, f"{record.at('boxes')}[{index}]", ("time", "world_from_object"))
                for index, box in enumerate(record.items("boxes"))
            ]
            times = [_time(box, "time") for box in boxes]
            json = {
                "id": record.text("id"), "label": record.text("class"), "size_m": record.raw("size_m"),
                "times_s": common.seconds(times, self.unit, record.at("boxes"), self.start).tolist() if times else [],
                "world_from_object": [
                    self.world_pose(box.raw("world_from_object"), box.at("world_from_object")).reshape(-1).tolist()
                    for box in boxes
                ],
            }  # fmt: skip
            return schema.track_from_json(json, where)

        tracks = self._each("tracks", items, parse)
        ids = [track.id for track in tracks]
        for twice in sorted({i for i in ids if ids.count(i) > 1}):
            self.complain(InputError("two tracks have one id", where=f"{self.where}: tracks", got=twice))
        return tracks


def pose(value: object, where: str) -> Matrix:
    """A pose: 3 or 4 rows of 4 numbers (or 12 or 16 numbers), or ``{"wxyz": [...], "xyz_m": [...]}``; f64[4, 4]."""
    if isinstance(value, dict):
        record = schema.Record(value, where, ("wxyz", "xyz_m"))
        numbers = [
            [schema.finite_number(n, f"{record.at(key)}[{i}]") for i, n in enumerate(record.items(key))]
            for key in ("wxyz", "xyz_m")
        ]
        return common.pose_from_quaternion(numbers[0], numbers[1], where)
    rows: Any = value
    if isinstance(value, list) and len(value) in (12, 16):
        rows = [value[n : n + 4] for n in range(0, len(value), 4)]
    if not isinstance(rows, list) or not all(isinstance(row, list) and len(row) == 4 for row in rows):
        raise InputError(
            "pose is of no known form", where=where, got=repr(value)[:80],
            expected='3 or 4 rows of 4 numbers, or {"wxyz": [w, x, y, z], "xyz_m": [x, y, z]}',
        )  # fmt: skip
    return common.rigid_pose([[schema.finite_number(number, where) for number in row] for row in rows], where)


def _lens(record: schema.Record) -> tuple[Lens | None, list[float]]:
    if "distortion" not in record:
        return None, []
    inner = schema.Record(record.raw("distortion"), record.at("distortion"), ("model", "coefficients"))
    model = inner.text("model")
    if model not in LENSES:
        raise InputError(
            "distortion model is not known", where=inner.at("model"), expected=", ".join(LENSES), got=model[:40]
        )
    make, counts = LENSES[model]
    items = inner.items("coefficients")
    if len(items) not in counts:
        raise InputError(
            "distortion model takes another number of coefficients", where=inner.at("coefficients"),
            expected=" or ".join(str(count) for count in counts), got=str(len(items)),
        )  # fmt: skip
    numbers = [schema.finite_number(n, f"{inner.at('coefficients')}[{i}]") for i, n in enumerate(items)]
    return (make(*numbers) if any(numbers) else None), numbers


def _time(record: schema.Record, key: str) -> Any:
    """A time in the log's unit: whole numbers stay whole."""
    value = record.raw(key)
    schema.finite_number(value, record.at(key))
    if isinstance(value, int) and abs(value) >= 1 << 62:
        raise InputError("time makes no sense", where=record.at(key), got=str(value)[:40])
    return value


def _known(record: schema.Record, key: str, names: tuple[str, ...]) -> str:
    name = record.text(key)
    if name not in names:
        raise InputError(
            f"record names a {key} that the log does not have", where=record.at(key),
            expected=", ".join(names) or f"an entry in {key}s", got=name[:80],
        )  # fmt: skip
    return name
