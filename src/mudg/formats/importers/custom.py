"""Importer and checker of logs in the neutral layout (docs/custom_format.md), for recordings that no other importer
reads."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Final, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, WrapValidator

from mudg.base import log, store
from mudg.base.errors import InputError, MudgError, UsageError
from mudg.base.records import Number, StrictRecord, checked_by, named_by, parse_record, place
from mudg.base.types import EgoPath, Frame, Ref, Scene, Shutter, Source, Sweep, SweepPoints, Track, View
from mudg.formats.importers import common
from mudg.formats.importers.clouds import Cloud, read_cloud
from mudg.formats.importers.common import ImportOptions
from mudg.formats.importers.drive_log import CameraOptics, SceneContent, SceneImage, SceneSweep, write_scene
from mudg.formats.importers.images import brown_conrady, equidistant, fit_images, image_notes
from mudg.scene import check as scene_check
from mudg.scene import schema
from mudg.scene.check import Finding
from mudg.scene.read import decode_image

Matrix = NDArray[np.float64]
INDEX: Final = "log.json"
FORMAT: Final = "mudg-log"
VERSION: Final = 1
LENSES: Final = {"brown_conrady": (brown_conrady, (4, 5, 8)), "equidistant": (equidistant, (4,))}
"""Distortion models and how many coefficients they take."""


# --- what log.json may hold (docs/custom_format.md) -----------------------------------------------


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
    shutter: Shutter = "global"


class LogLidar(StrictRecord):
    """A LiDAR: where it sits, which fields of its clouds mean what, and whether its sweeps are motion-compensated."""

    ego_from_sensor: Pose = Field(alias="ego_from_lidar")
    motion_compensated: bool
    intensity_field: str = "intensity"
    """Empty = clouds have no intensities."""
    intensity_max: Annotated[Number, Field(gt=0)] = 1.0
    """Intensities are divided by it."""
    time_field: str = ""
    """Empty = clouds have no times."""
    time_unit: common.TimeUnit | None = None
    time_from: Literal["sweep", "log"] = "sweep"
    """Whether times of points count from the sweep's time or on the log's clock."""


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


# --- what a log holds -----------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, eq=False)
class LogItem:
    """One image or cloud, seconds since the start, with its own pose if the log gives one."""

    kind: Literal["image", "cloud"]
    sensor: str
    ego_from_sensor: Matrix
    time_s: float
    file: Ref
    world_from_sensor: Matrix | None = None

    def pose(self, ego: EgoPath) -> Matrix:
        """World-from-sensor f64[4, 4]: its own, else by the vehicle's path."""
        if self.world_from_sensor is not None:
            return self.world_from_sensor
        return common.pose_near(ego, self.time_s) @ self.ego_from_sensor


@dataclass(frozen=True, slots=True, eq=False)
class CustomLog:
    """A parsed ``log.json``. Seconds count from the first vehicle pose, which is at ``start`` in the log's own unit;
    that pose's place is the world's origin. Images and sweeps are in time order per sensor."""

    root: Path
    name: str
    source: Source
    cameras: Mapping[str, CameraOptics]
    lidars: Mapping[str, LogLidar]
    ego: EgoPath
    images: tuple[LogItem, ...]
    sweeps: tuple[LogItem, ...]
    tracks: tuple[Track, ...]
    start: float
    units_per_s: int

    def file(self, record: LogItem) -> Path:
        """The file of a record, which no link may lead out of the log."""
        path = self.root / record.file.path
        if not path.resolve().is_relative_to(self.root.resolve()):
            raise InputError("a link leads out of the log", where=str(path), expected="a file inside the log")
        return path

    def read_sweep(self, sweep: LogItem, options: ImportOptions) -> SweepPoints:
        """The points of a sweep, motion-compensated to its time. Raises InputError: no points, or they contradict what
        the log declares of their fields."""
        lidar, path = self.lidars[sweep.sensor], self.file(sweep)
        cloud = read_cloud(path, known=(lidar.intensity_field, lidar.time_field))
        if len(cloud.xyz) == 0:
            remedy = "export it again, or take the sweep out of log.json"
            raise InputError("cloud has no points", where=str(path), expected="at least one return", remedy=remedy)
        dt_s = self._delays(cloud, sweep, path)
        intensity, name = np.zeros(len(cloud.xyz), np.float32), lidar.intensity_field
        if name:
            there = f"log.json: lidars.{sweep.sensor}"
            remedy = f"name the field in {there}.intensity_field; an empty text if there is none"
            values = np.nan_to_num(cloud.field(name, "intensity", path, remedy).astype(np.float64))
            remedy = f"give the largest possible value in {there}.intensity_max (often 255)"
            intensity = common.unit_intensity(values, lidar.intensity_max, path, remedy)
        points = SweepPoints(cloud.xyz.astype(np.float32), intensity, dt_s, no_returns=cloud.missing)
        if options.untwist == "no" or (options.untwist == "auto" and lidar.motion_compensated):
            return points
        if not lidar.time_field:
            what = "sweeps are not motion-compensated, and their points have no times"
            where, expected = f"{self.root / INDEX}: lidars.{sweep.sensor}", "time_field and time_unit"
            remedy = "name the field with the time of each point, or add --untwist no"
            raise InputError(what, where=where, expected=expected, remedy=remedy)
        lidar_at = lambda time_s: common.pose_near(self.ego, time_s) @ sweep.ego_from_sensor
        return replace(points, xyz=common.deskew(points.xyz, points.dt_s, lidar_at, sweep.time_s))

    def _delays(self, cloud: Cloud, sweep: LogItem, path: Path) -> NDArray[np.float32]:
        """Seconds of each point relative to the sweep's time; 0 where clouds have no times."""
        lidar = self.lidars[sweep.sensor]
        if not lidar.time_field or lidar.time_unit is None:
            return np.zeros(len(cloud.xyz), np.float32)
        values, per_second = cloud.field(lidar.time_field, "times", path), common.UNITS_PER_SECOND[lidar.time_unit]
        if lidar.time_from == "log":
            # whole numbers are subtracted before they are scaled: nanoseconds of the epoch keep their digits
            values = values.astype(np.int64) if values.dtype.kind == "u" else values
            start = self.start * per_second
            start = start // self.units_per_s if isinstance(start, int) else start / self.units_per_s
            dt_s = (values - np.asarray(start, values.dtype)).astype(np.float64) / per_second - sweep.time_s
        else:
            dt_s = values.astype(np.float64) / per_second
        if not np.isfinite(dt_s).all() or np.abs(dt_s).max() > MAX_DELAY_S:
            expected, got = f"within {MAX_DELAY_S:g} s", f"up to {np.abs(dt_s).max():.3g} s"
            what = "times of points are far from their sweep's"
            remedy = "check time_unit and time_from of the LiDAR in log.json"
            raise InputError(what, where=str(path), expected=expected, got=got, remedy=remedy)
        return dt_s.astype(np.float32)


# --- parsing --------------------------------------------------------------------------------------


def read_log(root: Path, complain: schema.Complain = schema.raise_first) -> CustomLog:
    """Parse ``root/log.json``. ``complain`` is called with each problem, as in ``scene/schema.py``; a record with a
    problem is left out. InputError: the frame of the file or the vehicle's path is wrong, or ``complain`` raised."""
    where = str(root / INDEX)
    value = schema.parse_object(store.read_bytes(root / INDEX), where)
    stated = value.get("format"), value.get("version")
    if stated != (FORMAT, VERSION):
        what = "this is not the index of a log in the neutral layout"
        expected = f'"format": "{FORMAT}", "version": {VERSION}'
        raise InputError(what, where=where, expected=expected, got=f"{stated[0]!r}, {stated[1]!r}"[:80])
    top = parse_record(LogIndex, value, f"{where}: ")
    placed = schema.parse_table(top.cameras, f"{where}: cameras", _parse_camera, complain)
    lidars = schema.parse_table(top.lidars, f"{where}: lidars", _parse_lidar, complain)
    if not placed:
        expected = "at least one camera by name"
        complain(InputError("the log has no cameras", where=f"{where}: cameras", expected=expected))
    if not top.ego:
        raise InputError("the log has no vehicle poses", where=f"{where}: ego", expected="at least one")
    path = schema.parse_each(top.ego, f"{where}: ego", partial(parse_record, EgoPoseEntry), schema.raise_first)
    origin_m = np.array(path[0].world_from_ego)[:3, 3]

    def seconds(records: Iterable[Any], where: str) -> NDArray[np.float64]:
        """Times of one sensor's records since the first vehicle pose."""
        return common.seconds([record.time for record in records], top.time_unit, where, path[0].time)

    def in_scene(pose: Any) -> Matrix:
        """A pose in the log's world, moved to the scene's."""
        moved = np.array(pose)
        moved[:3, 3] -= origin_m
        return moved

    def items(name: str, key: str, entry_type: type[LogImageEntry | LogCloudEntry], mounts: Mapping[str, Any]) -> Any:
        """``images`` or ``sweeps`` in time order per sensor; a sensor whose times are wrong is complained about and
        left out."""
        declared = getattr(top, f"{key}s")

        def parse(value: object, where: str) -> Any:
            entry = parse_record(entry_type, value, where)
            sensor = getattr(entry, key)
            if sensor not in declared:
                what, expected = f"record names a {key} that the log does not have", ", ".join(declared)
                expected = expected or f"an entry in {key}s"
                raise InputError(what, where=place(where, key), expected=expected, got=sensor[:80])
            return entry

        entries = schema.parse_each(getattr(top, name), f"{where}: {name}", parse, complain)
        records: list[LogItem] = []
        for sensor, mount in mounts.items():
            own, here = [entry for entry in entries if getattr(entry, key) == sensor], f"{where}: {name} of {sensor}"
            if not own:
                remedy = f"add them, or remove {sensor}"
                complain(InputError(f"{sensor} has no {name}", where=here, remedy=remedy))
                continue
            try:
                times = seconds(own, here).tolist()
            except InputError as problem:
                complain(problem)
                continue
            kind, mount = "image" if key == "camera" else "cloud", np.asarray(mount)
            for entry, time_s in zip(own, times, strict=True):
                pose = getattr(entry, "world_from_camera", None)
                pose = None if pose is None else in_scene(pose)
                records.append(LogItem(kind, sensor, mount, time_s, Ref(entry.file), pose))
        return tuple(records)

    def parse_track(value: object, where: str) -> Track:
        entry = parse_record(LogTrackEntry, value, where)
        times_s = seconds(entry.boxes, place(where, "boxes"))
        poses = [in_scene(box.world_from_object) for box in entry.boxes]
        with named_by(where):
            return Track(entry.id, entry.label, np.array(entry.size_m), times_s, np.reshape(poses, (-1, 4, 4)))

    poses = np.stack([in_scene(entry.world_from_ego) for entry in path])
    ego = EgoPath(seconds(path, f"{where}: ego"), poses)
    images = items("images", "camera", LogImageEntry, {name: mount for name, (_, mount) in placed.items()})
    sweeps = items("sweeps", "lidar", LogCloudEntry, {name: one.ego_from_sensor for name, one in lidars.items()})
    tracks = schema.parse_each(top.tracks, f"{where}: tracks", parse_track, complain)
    for twice in schema.repeated(track.id for track in tracks):
        complain(InputError("two tracks have one id", where=f"{where}: tracks", got=twice))
    notes = ["read from the neutral layout"]
    if np.abs(origin_m).max() > 0:
        coordinates = ", ".join(f"{value:.3f}" for value in origin_m)
        notes.append(f"world origin moved to the first vehicle position, ({coordinates}) in the log")
    source = Source(top.dataset, top.licence, None, tuple(notes))
    units_per_s = common.UNITS_PER_SECOND[top.time_unit]
    cameras = {name: optics for name, (optics, _) in placed.items()}
    parts = cameras, lidars, ego, images, sweeps, tuple(tracks), path[0].time, units_per_s
    return CustomLog(root, top.name, source, *parts)


def _parse_camera(name: str, value: object, where: str) -> tuple[CameraOptics, Matrix]:
    """A camera as recorded, with its lens, and where it sits on the vehicle."""
    entry = parse_record(LogCameraEntry, value, where)
    if entry.pixel_centre not in (0.0, 0.5):
        expected = "0 (the middle of the top-left pixel is (0, 0), as in OpenCV) or 0.5"
        where, got = place(where, "pixel_centre"), f"{entry.pixel_centre:g}"
        raise InputError("pixel centre makes no sense", where=where, expected=expected, got=got)
    coefficients = entry.distortion.coefficients if entry.distortion is not None else []
    plain = {key: getattr(entry, key) for key in ("width", "height", "fx", "fy", "readout_s", "shutter")}
    middle = {key: getattr(entry, key) + 0.5 - entry.pixel_centre for key in ("cx", "cy")}
    camera = schema.parse_camera(name, {**plain, **middle, "distortion": coefficients}, where)
    lens = None
    if entry.distortion is not None:
        make, counts = LENSES[entry.distortion.model]
        if len(coefficients) not in counts:
            expected, got = " or ".join(str(count) for count in counts), str(len(coefficients))
            what, where = "distortion model takes another number of coefficients", place(where, "distortion")
            raise InputError(what, where=place(where, "coefficients"), expected=expected, got=got)
        lens = make(*coefficients) if any(coefficients) else None
    return CameraOptics(camera, lens), np.asarray(entry.ego_from_camera)


def _parse_lidar(name: str, value: object, where: str) -> LogLidar:
    schema.check_name(name, where)
    lidar = parse_record(LogLidar, value, where)
    if bool(lidar.time_field) != (lidar.time_unit is not None):
        expected = f"time_field, and time_unit: one of {', '.join(common.UNITS_PER_SECOND)}"
        raise InputError("times of points need their field and its unit", where=where, expected=expected)
    return lidar


# --- importer -------------------------------------------------------------------------------------
MAX_DELAY_S: Final = 1.0
Numbered = tuple[int, LogItem]
"""A record and its number, counted per sensor in time order."""


def looks_like_custom(source: Path) -> bool:
    """Whether ``source`` is a folder with the index of a log in the neutral layout."""
    index = source / INDEX
    if not index.is_file():
        return False
    with store.open_file(index) as handle:
        return b'"mudg-log"' in handle.read(4096)


def import_custom(source: Path, out: Path, options: ImportOptions) -> Scene:
    """Import a log in the neutral layout into the scene directory ``out``."""
    common.refuse_options(options, "neutral-layout", "sequence", "poses", "boxes")
    log_read, notes = read_log(source), []
    content = _chosen(replace(log_read, ego=common.mended_path(log_read.ego, notes)), options)
    fits = {name: fit_images(c.recorded, options, c.lens) for name, c in content.cameras.items()}
    moments = _moments(content.images)
    as_scene(content, schema.raise_first)  # records without a pose are refused before anything is read

    def convert(item: Numbered) -> Iterator[SceneImage | SceneSweep]:
        number, record = item
        about = record.sensor, number, record.time_s, record.pose(content.ego)
        if record.kind == "image":
            yield SceneImage(*about, content.file(record), moment=moments[record])
        else:
            yield SceneSweep(*about, content.read_sweep(record, options))

    origin = replace(content.source, notes=(*content.source.notes, *notes, *image_notes(fits)))
    items, tracks = [*_numbered(content.images), *_numbered(content.sweeps)], lambda: (content.tracks, ())
    whole = SceneContent(content.name, origin, fits, items, convert, _id_of, content.ego, tracks)
    return write_scene(whole, out, options)


def _id_of(item: Numbered) -> str:
    return f"{item[1].sensor}/{item[0]:06d}"


def _moments(records: Sequence[LogItem]) -> dict[LogItem, int]:
    """Record -> number of the record of the first one's sensor that is nearest in time."""
    if not records:
        return {}
    clock = np.array([record.time_s for record in records if record.sensor == records[0].sensor])
    numbers = common.nearest_index(clock, np.array([record.time_s for record in records]))
    return dict(zip(records, numbers.tolist(), strict=True))


def _chosen(content: CustomLog, options: ImportOptions) -> CustomLog:
    """The chosen cameras, frames and files. ``frames`` counts images of the log's first one; the rest goes by time."""
    there = {name: name for name in content.cameras}
    names = common.chosen_cameras(there, options, str(content.root / INDEX), tuple(there))
    images = [image for image in content.images if image.sensor in names]
    sweeps = list(content.sweeps)
    if options.frames is not None:
        count = sum(image.sensor == names[0] for image in images)
        if options.frames[0] >= count:
            expected, got = f"0:{count}", str(options.frames)
            raise UsageError("no frames in this range", where="--frames", expected=expected, got=got)
        chosen = {record for record, n in _moments([*images, *sweeps]).items() if n in range(*options.frames)}
        images, sweeps = ([record for record in records if record in chosen] for records in (images, sweeps))
    if options.skip_missing:
        images, sweeps = _usable(content, images), _usable(content, sweeps)
    cameras = {name: content.cameras[name] for name in names}
    return replace(content, cameras=cameras, images=tuple(images), sweeps=tuple(sweeps))


def _usable(content: CustomLog, records: list[LogItem]) -> list[LogItem]:
    """Records whose file is there and whose pose is known."""
    found = [record for record in records if (content.root / record.file.path).is_file()]
    if len(found) < len(records):
        log.warn(f"custom: left out {len(records) - len(found)} records whose {records[0].kind} is missing")
    placed = [r for r in found if r.world_from_sensor is not None or common.has_pose(content.ego, r.time_s)]
    if len(placed) < len(found):
        times = [r.time_s for r in found if r not in placed]
        without = f"{len(times)} records of kind {records[0].kind} without a vehicle pose"
        log.warn(f"custom: left out {without}, from {min(times):.3f} to {max(times):.3f} s")
    return placed


def _numbered(records: Sequence[LogItem]) -> list[Numbered]:
    counts = {record.sensor: itertools.count() for record in records}
    return [(next(counts[record.sensor]), record) for record in records]


# --- checking -------------------------------------------------------------------------------------


def check_log(source: Path) -> list[Finding]:
    """Everything that is wrong or odd about a log in the neutral layout, worst first; every file is read."""
    findings: list[Finding] = []

    def complain(problem: MudgError) -> None:
        findings.append(scene_check.finding_of(problem, str(source)))

    try:
        content = read_log(source, complain)
    except MudgError as problem:
        complain(problem)
        return scene_check.worst_first(findings)
    scene, images, sweeps = as_scene(content, complain)
    findings.extend(scene_check.check_records(scene))

    def check_image(frame: Frame, image: LogItem) -> Iterator[Finding]:
        path = content.file(image)
        pixels = decode_image(store.read_bytes(path), str(path), frame.view.camera)
        yield from scene_check.check_image(frame, pixels)

    def check_sweep(sweep: Sweep, cloud: LogItem) -> Iterator[Finding]:
        points = content.read_sweep(cloud, ImportOptions())
        if points.no_returns:
            marked = f"{points.no_returns} of {points.no_returns + len(points.xyz)} points mark beams without a return"
            yield Finding("note", f"sweep {sweep.id}", f"{marked}; ingest leaves them out")
        yield from scene_check.check_points(scene, sweep, points)

    with log.task("checking images and sweeps", len(images) + len(sweeps)) as bar:
        for check in (*map(check_image, scene.frames, images), *map(check_sweep, scene.sweeps, sweeps)):
            findings.extend(scene_check.collected(check, str(source)))
            bar.advance()
    return scene_check.worst_first(findings)


def as_scene(content: CustomLog, complain: schema.Complain) -> tuple[Scene, list[LogItem], list[LogItem]]:
    """The log as a scene whose references are files of the log: nothing is copied; and the records of its frames and
    sweeps. Records without a pose are complained about and left out. Cameras are as recorded."""
    frames: dict[LogItem, Frame] = {}
    sweeps: dict[LogItem, Sweep] = {}
    for item in (*_numbered(content.images), *_numbered(content.sweeps)):
        record, name = item[1], _id_of(item)
        try:
            pose = record.pose(content.ego)
            if record.kind == "image":
                view = View(content.cameras[record.sensor].recorded, pose, record.time_s)
                frames[record] = Frame(name, view, record.file)
            else:
                sweeps[record] = Sweep(name, record.sensor, record.time_s, pose, record.file)
        except InputError as problem:
            complain(problem.located(f"{record.kind} {record.file.path}"))
    groups: dict[int, list[str]] = {}
    for record, moment in _moments(list(frames)).items():
        groups.setdefault(moment, []).append(frames[record].id)
    split = common.holdout_split([groups[moment] for moment in sorted(groups)], ImportOptions().test_every)
    cameras = {name: one.recorded for name, one in content.cameras.items()}
    parts = tuple(frames.values()), tuple(sweeps.values()), content.tracks, content.ego, split, content.source
    return Scene(content.name, str(content.root), cameras, *parts), list(frames), list(sweeps)
