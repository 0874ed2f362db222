"""nuPlan importer: one log (a ``.db`` file) with its sensor blobs, or one scene (up to 20 s) of it. What is read,
and how: docs/formats/nuplan.md, docs/reference/formats.md. ``sensor_blobs`` is looked for beside the database and up
to four folders above it."""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, Final
from urllib.parse import quote

import numpy as np
from numpy.typing import NDArray

from mudg.base import log, store
from mudg.base.errors import InputError, UsageError
from mudg.base.geometry import invert, yaw_matrix
from mudg.base.plain_pickle import NUMPY_MAKERS, Maker, as_list, read_pickle
from mudg.base.types import Camera, EgoPath, Scene, Source, SweepPoints, foreign_name
from mudg.formats.importers import common
from mudg.formats.importers.clouds import read_cloud
from mudg.formats.importers.common import ImportOptions, LogFiles, name_table
from mudg.formats.importers.drive_log import (
    BoxTracks,
    CameraOptics,
    DriveLog,
    ImageRecord,
    SweepRecord,
    Tracks,
    write_log,
)
from mudg.formats.importers.images import brown_conrady
from mudg.formats.unknown_fields import note_unknown
from mudg.scene.clouds import near_places
from mudg.scene.schema import ref_problem

Matrix = NDArray[np.float64]
LICENCE: Final = "CC BY-NC-SA 4.0 with the nuPlan dataset licence (Motional; attribution, non-commercial, share-alike)"
CAMERAS: Final = name_table(
    """front: CAM_F0; front_left: CAM_L0; front_right: CAM_R0; side_left: CAM_L1; side_right: CAM_R1;
    back_left: CAM_L2; back_right: CAM_R2; back: CAM_B0"""
)
SENSOR: Final = "merged"
LABELS: Final = name_table(
    """vehicle: vehicle; bicycle: bicycle; pedestrian: pedestrian; traffic_cone: traffic_cone;
    barrier: barrier; sign: czone_sign; generic_object: generic_object"""
)
IMAGE_DELAY_US: Final = 16_667
"""From an image's time stamp to the middle of its read-out. The data set's schema does not tell; reconstructions of it
found this."""
_MARGIN_US: Final = 100_000
_REACH_US: Final = 60_000
_SQLITE: Final = b"SQLite format 3\0"

# database -----------------------------------------------------------------------------------------
#
# One SQLite database per log, opened read-only, the schema checked before the first question.
# Names of tables and columns are literal here. Nothing from the file becomes part of a query, a path outside the sensor
# blobs, or code: calibration columns are pickles, read by ``plain_pickle``.
SCHEMA: Final[Mapping[str, tuple[str, ...]]] = {
    "log": ("token", "logfile", "location"),
    "ego_pose": ("token", "timestamp", "x", "y", "z", "qw", "qx", "qy", "qz"),
    "camera": ("token", "channel", "translation", "rotation", "intrinsic", "distortion", "width", "height"),
    "image": ("token", "camera_token", "filename_jpg", "timestamp"),
    "lidar": ("token", "channel", "translation", "rotation"),
    "lidar_pc": ("token", "ego_pose_token", "lidar_token", "scene_token", "filename", "timestamp"),
    "lidar_box": ("lidar_pc_token", "track_token", "x", "y", "z", "width", "length", "height", "yaw"),
    "track": ("token", "category_token"),
    "category": ("token", "name"),
    "scene": ("token", "name"),
}
"""Tables and columns that are read."""
_XYZ: Final = ("x", "y", "z")
OFFICIAL: Final[Mapping[str, frozenset[str]]] = {
    "log": frozenset({"vehicle_name", "date", "timestamp", "map_version"}),
    "ego_pose": frozenset(
        {"log_token", "epsg", *(f"{name}{axis}" for name in ("v", "acceleration_", "angular_rate_") for axis in _XYZ)}
    ),
    "camera": frozenset({"log_token", "model"}),
    "image": frozenset({"next_token", "prev_token", "ego_pose_token"}),
    "lidar": frozenset({"log_token", "model"}),
    "lidar_pc": frozenset({"next_token", "prev_token"}),
    "lidar_box": frozenset({"token", "next_token", "prev_token", "vx", "vy", "vz", "confidence"}),
    "track": frozenset({"width", "length", "height"}),
    "category": frozenset({"description"}),
    "scene": frozenset({"log_token", "goal_ego_pose_token", "roadblock_ids"}),
    "scenario_tag": frozenset(),
    "traffic_light_status": frozenset(),
}
"""Tables of the published schema, and those of their columns that are not read."""
_MAX_CELL_BYTES: Final = 1024 * 1024
"""Calibrations are the longest values, of a few hundred bytes."""
_MAX_TOKEN_BYTES: Final = 64
_MAX_NUMBERS: Final = 64
_DATA_TYPES: Final = "nuplan.database.common.data_types"
_MAKERS: Final[Mapping[str, Maker | None]] = {
    **NUMPY_MAKERS,
    **dict.fromkeys(f"{_DATA_TYPES}.{name}" for name in ("Translation", "Rotation", "CameraIntrinsic")),
}


class NuplanLog:
    """An open log. Make one with ``open_log``."""

    def __init__(self, path: Path, connection: sqlite3.Connection) -> None:
        self.path = path
        self._connection = connection

    def rows(self, question: str, values: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
        """Rows of a literal question, one by one; damage is an InputError."""
        try:
            # a delegated cursor would be closed after the database when a question is left unfinished
            for row in self._connection.execute(question, values):  # noqa: UP028
                yield row
        except (sqlite3.Error, OverflowError, UnicodeDecodeError) as error:
            what = "log database is damaged"
            raise InputError(what, where=str(self.path), got=str(error)[:200], remedy="copy the file again") from error

    def check(self) -> None:
        """Refuse a database that is not a nuPlan log."""
        rows = self.rows("SELECT name, sql FROM sqlite_master WHERE type = 'table'")
        tables = {str(name): str(sql) for name, sql in rows}
        for table, columns in SCHEMA.items():
            if table not in tables or tables[table].upper().startswith("CREATE VIRTUAL"):
                what, got = f"database has no table {table!r}", ", ".join(sorted(tables)) or "no tables"
                remedy = "is it a nuPlan log (v1.1)?"
                raise InputError(what, where=str(self.path), expected=", ".join(SCHEMA), got=got, remedy=remedy)
            there = [str(row[1]) for row in self.rows(f"PRAGMA table_info({table})")]
            common.require_columns(columns, there, f"{self.path}: {table}")
            note_unknown(f"the table {table}", there, OFFICIAL[table].union(columns))
        note_unknown("the database", [name for name in tables if not name.startswith("sqlite_")], frozenset(OFFICIAL))

    def name(self) -> str:
        """The log's name, e.g. ``2021.05.12.22.00.38_veh-35_01008_01518``."""
        for (name,) in self.rows("SELECT logfile FROM log"):
            name = text_of(name, f"{self.path}: log.logfile")
            problem = "has folders in it" if "/" in name else ref_problem(name)
            if problem is not None:
                what = f"log's name {problem}"
                raise InputError(what, where=f"{self.path}: log.logfile", got=repr(name), expected="a folder's name")
            return name
        raise InputError("log has no name", where=f"{self.path}: log.logfile")

    def cameras(self) -> dict[bytes, tuple[str, Camera, Matrix]]:
        """Token -> channel, camera as recorded, and place on the vehicle f64[4, 4]."""
        found = {}
        for token, channel, *values in self.rows(
            "SELECT token, channel, translation, rotation, intrinsic, distortion, width, height FROM camera"
        ):
            channel = text_of(channel, f"{self.path}: camera.channel")
            where = f"{self.path}: camera {channel}"
            matrix = np.array(self._numbers(values[2], f"{where}.intrinsic", 9)).reshape(3, 3)
            size = _whole(values[4], f"{where}.width"), _whole(values[5], f"{where}.height")
            lens = () if values[3] is None else tuple(self._numbers(values[3], f"{where}.distortion", 5))
            name = CAMERAS.get(channel, channel)
            camera = common.pinhole_camera(name, size, matrix.tolist(), f"{where}.intrinsic", lens)
            found[token_of(token, f"{where}.token")] = channel, camera, self._pose(values[0], values[1], where)
        return found

    def lidars(self) -> dict[bytes, Matrix]:
        """Token -> place on the vehicle f64[4, 4]."""
        found = {}
        for token, channel, place, turn in self.rows("SELECT token, channel, translation, rotation FROM lidar"):
            where = f"{self.path}: lidar {text_of(channel, f'{self.path}: lidar.channel')}"
            found[token_of(token, f"{where}.token")] = self._pose(place, turn, where)
        return found

    def clouds(self, scene: str, blobs: Path) -> Iterator[tuple[bytes, int, bytes, Path, Matrix | None]]:
        """Token, time (us), LiDAR's token, file below ``blobs`` and vehicle pose (None if it is missing) of the point
        clouds in order of time, of one scene or (empty name) of all."""
        for token, time_us, lidar, file, pose_token, *pose in self.rows(
            "SELECT p.token, p.timestamp, p.lidar_token, p.filename, e.token, e.x, e.y, e.z, e.qw, e.qx, e.qy, e.qz "
            "FROM lidar_pc AS p LEFT JOIN ego_pose AS e ON e.token = p.ego_pose_token "
            "LEFT JOIN scene AS s ON s.token = p.scene_token WHERE ? = '' OR s.name = ? ORDER BY p.timestamp",
            (scene, scene),
        ):
            token = token_of(token, f"{self.path}: lidar_pc.token")
            where = f"{self.path}: lidar_pc {token.hex()}"
            path, lidar = common.path_inside(blobs, file, where), token_of(lidar, f"{where}.lidar_token")
            found = None if pose_token is None else self._ego(pose, where)
            yield token, self._time(time_us, "lidar_pc"), lidar, path, found

    def ego_poses(self, first_us: int, last_us: int) -> tuple[NDArray[np.int64], Matrix]:
        """Times (us) and poses f64[n, 4, 4] of the vehicle from ``first_us`` to ``last_us``; doubled times once."""
        times, poses = [], []
        for time_us, *pose in self.rows(
            "SELECT timestamp, x, y, z, qw, qx, qy, qz FROM ego_pose WHERE timestamp BETWEEN ? AND ? ORDER BY 1",
            (first_us, last_us),
        ):
            time_us = self._time(time_us, "ego_pose")
            if not times or time_us > times[-1]:
                times.append(time_us)
                poses.append(self._ego(pose, f"{self.path}: ego_pose at {time_us}"))
        return np.array(times, np.int64), np.array(poses).reshape(-1, 4, 4)

    def images(self, first_us: int, last_us: int, blobs: Path) -> Iterator[tuple[bytes, Path, int]]:
        """Camera token, file below ``blobs``, and time (us), in order of time."""
        for camera, file, time_us in self.rows(
            "SELECT camera_token, filename_jpg, timestamp FROM image WHERE timestamp BETWEEN ? AND ? ORDER BY 3",
            (first_us, last_us),
        ):
            time_us = self._time(time_us, "image")
            where = f"{self.path}: image at {time_us}"
            yield token_of(camera, f"{where}: camera_token"), common.path_inside(blobs, file, where), time_us

    def boxes(self, first_us: int, last_us: int) -> Iterator[tuple[bytes, str, str, tuple[float, ...]]]:
        """Cloud, track, class, and x y z yaw length width height (metres, radians, the log's world) of all boxes of a
        span. One pass over the table: the databases need not have an index of boxes by cloud."""
        for cloud, track, label, *numbers in self.rows(
            "SELECT p.token, b.track_token, c.name, b.x, b.y, b.z, b.yaw, b.length, b.width, b.height FROM lidar_pc AS"
            " p JOIN lidar_box AS b ON b.lidar_pc_token = p.token LEFT JOIN track AS t ON t.token = b.track_token LEFT"
            " JOIN category AS c ON c.token = t.category_token WHERE p.timestamp BETWEEN ? AND ?",
            (first_us, last_us),
        ):
            track = token_of(track, f"{self.path}: lidar_box.track_token").hex()
            where = f"{self.path}: lidar_box of track {track}"
            if label is None:
                what, expected = "box names a track or class that is not there", "tokens of track and category"
                raise InputError(what, where=where, expected=expected, remedy="copy the file again")
            label = text_of(label, f"{self.path}: category.name")
            yield token_of(cloud, where), track, label, tuple(_finite(number, where) for number in numbers)

    def scenes(self) -> list[str]:
        """Names of the scenes (pieces of up to 20 s)."""
        rows = self.rows("SELECT name FROM scene ORDER BY name")
        return [text_of(name, f"{self.path}: scene.name") for (name,) in rows]

    def _time(self, value: Any, table: str) -> int:
        return _whole(value, f"{self.path}: {table}.timestamp")

    def _ego(self, row: list[Any], where: str) -> Matrix:
        x, y, z, *wxyz = (_finite(number, where) for number in row)
        return common.pose_from_quaternion(wxyz, (x, y, z), where)

    def _pose(self, translation: Any, rotation: Any, where: str) -> Matrix:
        xyz = self._numbers(translation, f"{where}.translation", 3)
        return common.pose_from_quaternion(self._numbers(rotation, f"{where}.rotation", 4), xyz, where)

    def _numbers(self, blob: Any, where: str, count: int) -> list[float]:
        """Numbers of a pickled list, or list of lists, row by row."""
        if not isinstance(blob, bytes):
            raise InputError("calibration is no pickled list", where=where, got=type(blob).__name__)
        flat: list[float] = []
        for item in as_list(read_pickle(blob, where, _MAKERS), where)[:_MAX_NUMBERS]:
            flat += [_finite(value, where) for value in (item if isinstance(item, list | tuple) else [item])]
        if len(flat) != count:
            what = "calibration has the wrong number of values"
            raise InputError(what, where=where, expected=str(count), got=str(len(flat)))
        return flat


def token_of(value: Any, where: str) -> bytes:
    """A token: 1 to 64 bytes. InputError otherwise: SQLite columns may hold values of any type."""
    if not isinstance(value, bytes) or not 0 < len(value) <= _MAX_TOKEN_BYTES:
        got = f"{len(value)} bytes" if isinstance(value, bytes | str) else repr(value)[:40]
        what, expected = "token is no short blob", f"1 to {_MAX_TOKEN_BYTES} bytes"
        remedy = "is it a nuPlan log (v1.1)? copy the file again"
        raise InputError(what, where=where, expected=expected, got=f"{type(value).__name__}, {got}", remedy=remedy)
    return value


def text_of(value: Any, where: str) -> str:
    """A name: a text of 1 to 200 bytes."""
    if not isinstance(value, str) or not value:
        what = "name is no text"
        raise InputError(what, where=where, expected="a text", got=type(value).__name__ if value else repr(value))
    return foreign_name(value, where)


def _whole(value: Any, where: str) -> int:
    if isinstance(value, float) and value.is_integer():
        value = int(value)
    if not isinstance(value, int):
        raise InputError("value is no whole number", where=where, got=repr(value)[:40])
    return value


def _finite(value: Any, where: str) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not np.isfinite(value):
        raise InputError("value is not a finite number", where=where, got=repr(value)[:40])
    return float(value)


@contextmanager
def open_log(path: Path) -> Iterator[NuplanLog]:
    """Open a log database read-only and check its schema. Raises InputError: missing, not SQLite, damaged, or another
    schema."""
    if not path.is_file():
        raise InputError("log database does not exist", where=str(path), expected="a .db file")
    connection = None
    try:
        address = f"file:{quote(str(path.resolve()))}?mode=ro&immutable=1"
        connection = sqlite3.connect(address, uri=True, check_same_thread=False)
        connection.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, _MAX_CELL_BYTES)
        connection.execute("PRAGMA trusted_schema = OFF")
        connection.execute("PRAGMA cell_size_check = ON")
        opened = NuplanLog(path, connection)
        opened.check()
        yield opened
    except sqlite3.Error as error:
        what, remedy = "file is not a readable SQLite database", "is it cut off, or still packed?"
        raise InputError(what, where=str(path), got=str(error), expected="a nuPlan log (.db)", remedy=remedy) from error
    finally:
        if connection is not None:
            connection.close()


# importer -----------------------------------------------------------------------------------------


def looks_like_nuplan(source: Path) -> bool:
    """Whether ``source`` is a log database, or a folder that holds some."""
    if source.is_file():
        return _is_database(source)
    return source.is_dir() and any(_is_database(path) for path in _databases(source)[:1])


def _is_database(path: Path) -> bool:
    if path.suffix != ".db":
        return False
    with store.open_file(path) as handle:
        return handle.read(len(_SQLITE)) == _SQLITE


def _databases(folder: Path) -> list[Path]:
    patterns = ("*.db", "splits/*/*.db", "nuplan-v1.1/splits/*/*.db")
    return sorted(path for pattern in patterns for path in folder.glob(pattern))


def import_nuplan(source: Path, out: Path, options: ImportOptions) -> Scene:
    """Import one log, a ``.db`` file or one of a folder of them, or one scene of it. ``options.sequence``: the log's
    name (where ``source`` is a folder), a scene's name, or ``LOG/SCENE``; ``cameras`` default to all eight."""
    common.refuse_options(options, "nuPlan", "poses", "boxes", "untwist")
    path, scene = _find(source, options)
    with open_log(path) as opened:
        return write_log(_drive(opened, scene, options), out, options)


def _find(source: Path, options: ImportOptions) -> tuple[Path, str]:
    """The database, and the name of a scene or an empty text."""
    if source.is_file():
        log_name, _, scene = options.sequence.rpartition("/")
        if log_name and log_name != source.stem:
            raise UsageError("the file is another log", where=str(source), expected=source.stem, got=log_name)
        return source, "" if scene == source.stem else scene
    databases, (log_name, _, scene) = {path.stem: path for path in _databases(source)}, options.sequence.partition("/")
    if len(databases) == 1 and log_name not in databases and not scene:
        return next(iter(databases.values())), log_name
    expected = "*.db here or in splits/*"
    return common.the_only(databases, replace(options, sequence=log_name), source, "nuPlan log", expected), scene


def files_of_nuplan(source: Path, options: ImportOptions) -> LogFiles:
    """The log's database, and which sensor blobs there are."""
    path, _ = _find(source, options)
    blobs = _sensor_blobs(path, path.stem)
    return LogFiles((path,), tuple(sorted((blobs / path.stem).iterdir())) if blobs is not None else ())


def _sensor_blobs(path: Path, name: str) -> Path | None:
    """The folder ``sensor_blobs`` that holds this log, beside the database or up to four folders above it."""
    found = (folder / "sensor_blobs" for folder in path.resolve().parents[:5])
    return next((folder for folder in found if (folder / name).is_dir()), None)


def _drive(opened: NuplanLog, scene: str, options: ImportOptions) -> DriveLog:
    """What the database tells; no image or cloud is opened."""
    name, where, notes = opened.name(), str(opened.path), list[str]()
    log.info(f"nuplan: {where}")
    blobs = _sensor_blobs(opened.path, name)
    if blobs is None:
        expected = f"sensor_blobs/{name} beside the database or up to four folders above it"
        remedy = "download the camera and LiDAR blobs of this log; the database alone holds no images"
        raise InputError("sensor blobs of the log were not found", where=where, expected=expected, remedy=remedy)
    if scene and scene not in opened.scenes():
        what = "the log has no such scene"
        raise UsageError(what, where=where, got=scene, expected=", ".join(opened.scenes()[:12]) or "no scenes")
    clouds = list(opened.clouds(scene, blobs))
    if not clouds:
        raise InputError("no clouds to import", where=where, expected="rows of lidar_pc", got=scene or "the whole log")
    times_us = [time_us for _, time_us, *_ in clouds]
    start_us, end_us = times_us[0] - _REACH_US, times_us[-1] + _REACH_US
    seconds = common.seconds(times_us, "us", f"{where}: lidar_pc.timestamp", start_us)
    ego_us, poses = opened.ego_poses(start_us - _MARGIN_US, end_us + _MARGIN_US)
    if not len(ego_us):
        what, expected = "no vehicle poses at the time of the clouds", "microseconds, as lidar_pc.timestamp"
        remedy = "are the two in different units?"
        raise InputError(what, where=f"{where}: ego_pose.timestamp", expected=expected, remedy=remedy)
    ego = EgoPath(common.seconds(ego_us, "us", f"{where}: ego_pose.timestamp", start_us), poses)
    ego = common.mended_path(ego, notes)
    by_token = opened.cameras()
    folders = {channel for channel, _, _ in by_token.values() if (blobs / name / channel).is_dir()}
    available = {channel: ours for channel, ours in CAMERAS.items() if channel in folders}
    chosen = common.chosen_cameras(available, options, f"{where}: camera", tuple(CAMERAS))
    cameras = {camera.name: camera for channel in chosen for other, camera, _ in by_token.values() if other == channel}
    lenses = {name: brown_conrady(*one.distortion) if any(one.distortion) else None for name, one in cameras.items()}
    images = []
    for token, file, time_us in opened.images(start_us, end_us, blobs):
        channel, camera, mount = by_token.get(token, ("", None, np.eye(4)))
        time_s = (time_us + IMAGE_DELAY_US - start_us) / 1e6
        if camera is not None and channel in chosen and not (options.skip_missing and not common.has_pose(ego, time_s)):
            pose = common.pose_near(ego, time_s, where=str(file))
            images.append(ImageRecord(camera.name, time_s, pose @ mount, file, place=str(file)))
    lidars, sweeps = opened.lidars(), []
    without = [token.hex() for token, *_, pose in clouds if pose is None]
    if without and not options.skip_missing:
        what, got = "point cloud has no vehicle pose", f"{len(without)} of {len(clouds)} clouds have none"
        where, remedy = f"{where}: lidar_pc {without[0]}.ego_pose_token", "add --skip-missing"
        raise InputError(what, where=where, expected="a token of ego_pose", got=got, remedy=remedy)
    notes += [f"{len(without)} clouds without a vehicle pose were left out"] if without else []
    for (token, _, lidar, file, pose), time_s in zip(clouds, seconds.tolist(), strict=True):
        if lidar not in lidars:
            what, where = "point cloud is of a LiDAR that is not there", f"{where}: lidar_pc {token.hex()}"
            raise InputError(what, where=where, got=lidar.hex())
        if pose is not None:
            places = [(invert(lidars[lidar]) @ other)[:3, 3] for other in lidars.values()]
            read = partial(_read_points, file, places)
            sweeps.append(SweepRecord(SENSOR, time_s, pose @ lidars[lidar], file, read))
    tracks, track_notes = _tracks(
        opened, dict(zip((token for token, *_ in clouds), seconds.tolist(), strict=True)), times_us
    )
    notes.append(f"image poses {IMAGE_DELAY_US / 1e6:.4f} s after the time stamps: the middle of the read-out")
    return DriveLog(
        name=f"{name}_{scene}" if scene else name,
        cameras=cameras,
        images=images,
        sweeps=sweeps,
        tracks=tracks,
        ego=ego,
        source=Source("nuplan", LICENCE, None, (*notes, *track_notes)),
        where=where,
        optics={name: CameraOptics(camera, lenses[name]) for name, camera in cameras.items()},
    )


def _tracks(opened: NuplanLog, time_of: Mapping[bytes, float], times_us: Sequence[int]) -> Tracks:
    """Tracks in the log's world from the boxes of clouds (token -> seconds), and notes."""
    tracks = BoxTracks(f"{opened.path}: lidar_box", LABELS)
    for token, track, label, (x, y, z, yaw, *size) in opened.boxes(times_us[0], times_us[-1]):
        if token in time_of:
            length, width, height = size
            pose = yaw_matrix(yaw, (x, y, z))
            tracks.add(track, tracks.label_of(label), time_of[token], (length, width, height), pose)
    return tracks.tracks()


def _read_points(path: Path, places: Sequence[Matrix]) -> SweepPoints:
    """A merged cloud; zeros of the LiDARs that were merged lie at their ``places``, f64[3] each."""
    cloud = read_cloud(path)
    intensity = cloud.fields.get("intensity", np.zeros(len(cloud.xyz)))
    returns = ~near_places(cloud.xyz, places)
    xyz = cloud.xyz[returns].astype(np.float32)
    grey = common.unit_intensity(intensity[returns], 255, f"{path}: intensity")
    no_returns = cloud.missing + int((~returns).sum())
    return SweepPoints(xyz, grey, np.zeros(len(xyz), np.float32), no_returns=no_returns)
