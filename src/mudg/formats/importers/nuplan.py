"""nuPlan importer: one log (a ``.db`` file) with its sensor blobs, or one scene (up to 20 s) of it.

================================================ =======================================================================
``<log>.db``                                     SQLite: poses at 100 Hz, calibration, images, clouds, tracked boxes
``sensor_blobs/<log>/CAM_F0`` ...                eight cameras, JPEG, 10 Hz, distorted (k1 k2 p1 p2 k3)
``sensor_blobs/<log>/MergedPointCloud/*.pcd``    points of five LiDARs in one cloud, 20 Hz
================================================ =======================================================================

``sensor_blobs`` is looked for beside the database and up to four folders above it.

Frames. World: z up, origin and x axis at the vehicle of the first imported cloud (the log's own world lies thousands of
kilometres from its origin). Frame numbers (``--frames``) count the clouds of the log or scene. A moment is an image
time of the cameras; all clouds in between are taken.

Clouds are motion-compensated in the source; ``dt_s`` is 0. Image times are the start of a read-out of about 1/30 s; the
middle row, and with it the pose, belongs 1/60 s later. Boxes come from an offline tracker, at every cloud.
"""

from __future__ import annotations

import itertools
import sqlite3
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final
from urllib.parse import quote

import numpy as np
from numpy.typing import NDArray

from mudg.base import store
from mudg.base.errors import InputError, UsageError
from mudg.base.geometry import invert, yaw_matrix
from mudg.base.plain_pickle import NUMPY_MAKERS, Maker, as_list, read_pickle
from mudg.base.types import Camera, EgoPath, Scene, Source, SweepPoints, Track, foreign_name
from mudg.formats.importers import common
from mudg.formats.importers.clouds import read_cloud
from mudg.formats.importers.common import ImportOptions, LogFiles, name_table
from mudg.formats.importers.drive_log import BoxTracks, SceneContent, SceneImage, SceneSweep, write_scene
from mudg.formats.importers.images import ImageFit, brown_conrady, fit_images, image_notes
from mudg.formats.unknown_fields import note_unknown
from mudg.scene.clouds import near_places
from mudg.scene.schema import ref_problem

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


@dataclass(frozen=True, slots=True)
class NuplanCamera:
    """One camera: place on the vehicle f64[4, 4], fx fy cx cy, lens k1 k2 p1 p2 k3, width and height."""

    channel: str
    ego_from_cam: Matrix
    intrinsics: tuple[float, float, float, float]
    distortion: tuple[float, ...]
    size: tuple[int, int]


@dataclass(frozen=True, slots=True)
class NuplanCloud:
    """One point cloud, posed f64[4, 4] in the log's world; ``places``: of the LiDARs in the cloud's frame, f64[3]."""

    token: bytes
    file: Path
    time_us: int
    world_from_lidar: Matrix
    places: tuple[Matrix, ...]


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

    def cameras(self) -> dict[bytes, NuplanCamera]:
        """Token -> camera."""
        found = {}
        for token, channel, *values in self.rows(
            "SELECT token, channel, translation, rotation, intrinsic, distortion, width, height FROM camera"
        ):
            channel = text_of(channel, f"{self.path}: camera.channel")
            where = f"{self.path}: camera {channel}"
            matrix = np.array(self._numbers(values[2], f"{where}.intrinsic", 9)).reshape(3, 3)
            skewed = abs(matrix[0, 1]) > 1e-6 or np.abs(matrix[2] - [0, 0, 1]).max() > 1e-6
            if skewed or min(matrix[0, 0], matrix[1, 1]) <= 0:
                what, where, got = "intrinsics are not of a pinhole camera", f"{where}.intrinsic", str(matrix.tolist())
                raise InputError(what, where=where, got=got, expected="[[fx, 0, cx], [0, fy, cy], [0, 0, 1]] in pixels")
            size = _whole(values[4], f"{where}.width"), _whole(values[5], f"{where}.height")
            intrinsics = tuple(matrix[[0, 1, 0, 1], [0, 1, 2, 2]].tolist())
            pose, lens = self._pose(*values[:2], where), tuple(self._numbers(values[3], f"{where}.distortion", None))
            found[token_of(token, f"{where}.token")] = NuplanCamera(channel, pose, intrinsics, lens, size)
        return found

    def lidars(self) -> dict[bytes, Matrix]:
        """Token -> place on the vehicle f64[4, 4]."""
        found = {}
        for token, channel, *place in self.rows("SELECT token, channel, translation, rotation FROM lidar"):
            where = f"{self.path}: lidar {text_of(channel, f'{self.path}: lidar.channel')}"
            found[token_of(token, f"{where}.token")] = self._pose(*place, where)
        return found

    def clouds(self, scene: str) -> Iterator[tuple[bytes, int]]:
        """Token and time (us) of the point clouds in order of time, of one scene or (empty name) of all."""
        return (
            (token_of(token, f"{self.path}: lidar_pc.token"), self._time(time_us, "lidar_pc"))
            for token, time_us in self.rows(
                "SELECT p.token, p.timestamp FROM lidar_pc AS p LEFT JOIN scene AS s ON s.token = p.scene_token "
                "WHERE ? = '' OR s.name = ? ORDER BY p.timestamp",
                (scene, scene),
            )
        )

    def cloud(self, token: bytes, ego_from_lidar: Mapping[bytes, Matrix], blobs: Path) -> NuplanCloud | None:
        """One point cloud with its pose; its file lies below ``blobs``. None if the vehicle has no pose then."""
        for lidar, file, time_us, *pose in self.rows(
            "SELECT p.lidar_token, p.filename, p.timestamp, e.x, e.y, e.z, e.qw, e.qx, e.qy, e.qz "
            "FROM lidar_pc AS p JOIN ego_pose AS e ON e.token = p.ego_pose_token WHERE p.token = ?",
            (token,),
        ):
            where = f"{self.path}: lidar_pc {token.hex()}"
            lidar = token_of(lidar, f"{where}.lidar_token")
            if lidar not in ego_from_lidar:
                raise InputError("point cloud is of a LiDAR that is not there", where=where, got=lidar.hex())
            mount = ego_from_lidar[lidar]
            places = tuple((invert(mount) @ other)[:3, 3] for other in ego_from_lidar.values())
            path, time_us = common.path_inside(blobs, file, where), self._time(time_us, "lidar_pc")
            return NuplanCloud(token, path, time_us, self._ego(pose, where) @ mount, places)
        return None

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

    def _numbers(self, blob: Any, where: str, count: int | None) -> list[float]:
        """Numbers of a pickled list, or list of lists, row by row."""
        if blob is None and count is None:
            return []
        if not isinstance(blob, bytes):
            raise InputError("calibration is no pickled list", where=where, got=type(blob).__name__)
        flat: list[float] = []
        for item in as_list(read_pickle(blob, where, _MAKERS), where)[:_MAX_NUMBERS]:
            flat += [_finite(value, where) for value in (item if isinstance(item, list | tuple) else [item])]
        if count is not None and len(flat) != count:
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
_PERIOD_US: Final = 100_000
_SQLITE: Final = b"SQLite format 3\0"


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
        return write_scene(_content(opened, _plan(opened, scene, options), options), out, options)


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


# --- what is imported -----------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class _Shot:
    """One image: camera's channel, file, time (us)."""

    channel: str
    file: Path
    time_us: int


@dataclass(frozen=True, slots=True, eq=False)
class _NuplanPlan:
    """Files, times and poses of an import, before anything large is read: the chosen ``cameras`` by channel, ``clouds``
    and ``moments`` (images of one) in order of time, and the vehicle over the whole span, in the log's world."""

    name: str
    cameras: Mapping[str, NuplanCamera]
    clouds: Sequence[NuplanCloud]
    moments: Sequence[Sequence[_Shot]]
    ego_us: NDArray[np.int64]
    world_from_ego: Matrix
    notes: Sequence[str]


def _plan(opened: NuplanLog, scene: str, options: ImportOptions) -> _NuplanPlan:
    name, where = opened.name(), str(opened.path)
    blobs = _sensor_blobs(opened.path, name)
    if blobs is None:
        expected = f"sensor_blobs/{name} beside the database or up to four folders above it"
        remedy = "download the camera and LiDAR blobs of this log; the database alone holds no images"
        raise InputError("sensor blobs of the log were not found", where=where, expected=expected, remedy=remedy)
    if scene and scene not in opened.scenes():
        what = "the log has no such scene"
        raise UsageError(what, where=where, got=scene, expected=", ".join(opened.scenes()[:12]) or "no scenes")
    every = list(opened.clouds(scene))
    first, end = options.frames or (0, len(every))
    chosen = every[first:end]
    if not chosen:
        raise InputError("no clouds to import", where=where, expected=f"frames 0 to {len(every)}", got=f"{first}:{end}")
    common.seconds(np.array([time_us for _, time_us in chosen]), "us", f"{where}: lidar_pc.timestamp", chosen[0][1])
    notes = [f"clouds {first} to {first + len(chosen) - 1} of {scene or 'the log'}"]
    lidars = opened.lidars()
    placed = {token: opened.cloud(token, lidars, blobs) for token, _ in chosen}
    clouds = [cloud for cloud in placed.values() if cloud is not None]
    if len(clouds) < len(placed):
        without = [token.hex() for token, cloud in placed.items() if cloud is None]
        if not options.skip_missing:
            what, where = "point cloud has no vehicle pose", f"{where}: lidar_pc {without[0]}.ego_pose_token"
            got = f"{len(without)} of {len(placed)} clouds have none"
            remedy = "choose frames with --frames FIRST:END, or add --skip-missing"
            raise InputError(what, where=where, expected="a token of ego_pose", got=got, remedy=remedy)
        notes.append(f"{len(without)} clouds without a vehicle pose were left out")
    lacking = [cloud.file for cloud in clouds if not cloud.file.is_file()]
    if lacking:
        _refuse_missing("point cloud", lacking, len(clouds), options)
        clouds = [cloud for cloud in clouds if cloud.file.is_file()]
        notes.append(f"{len(lacking)} clouds whose files are missing were left out")
    by_token = opened.cameras()
    folders = {camera.channel for camera in by_token.values() if (blobs / name / camera.channel).is_dir()}
    available = {channel: ours for channel, ours in CAMERAS.items() if channel in folders}
    names = common.chosen_cameras(available, options, f"{where}: camera", tuple(CAMERAS))
    cameras = {camera.channel: camera for camera in by_token.values()}
    span = (chosen[0][1] - _REACH_US, chosen[-1][1] + _REACH_US)
    shots = [
        _Shot(by_token[token].channel, file, time_us)
        for token, file, time_us in opened.images(*span, blobs)
        if token in by_token and by_token[token].channel in names
    ]
    moments, moment_notes = _moments(shots, names, options, where)
    ego_us, poses = opened.ego_poses(span[0] - _MARGIN_US, span[1] + _MARGIN_US)
    name, chosen_cameras = f"{name}_{scene}" if scene else name, {channel: cameras[channel] for channel in names}
    return _NuplanPlan(name, chosen_cameras, clouds, moments, ego_us, poses, (*notes, *moment_notes))


def _refuse_missing(what: str, missing: Sequence[Path], total: int, options: ImportOptions) -> None:
    """Refuse missing files, unless that is allowed."""
    if missing and not options.skip_missing:
        what = f"file of a {what} is missing"
        remedy = "download the log's sensor blobs, choose frames with --frames FIRST:END, or add --skip-missing"
        raise InputError(what, where=str(missing[0]), got=f"{len(missing)} of {total} are missing", remedy=remedy)


def _moments(
    shots: Sequence[_Shot], names: Sequence[str], options: ImportOptions, where: str
) -> tuple[list[list[_Shot]], list[str]]:
    """The images of each moment at which all cameras fired, and notes; see ``_by_moment``."""
    groups = _by_moment(shots, names, where)
    missing = [shot.file for group in groups for shot in group if not shot.file.is_file()]
    _refuse_missing("camera image", missing, len(shots), options)
    complete = [{shot.channel for shot in group} == set(names) for group in groups]
    kept = [g for g, full in zip(groups, complete, strict=True) if full and all(s.file.is_file() for s in g)]
    inner = [group for group, full in zip(groups[1:-1], complete[1:-1], strict=True) if not full]
    if inner and not options.skip_missing:
        absent = sorted(set(names) - {shot.channel for shot in inner[0]})
        what, where = "a moment lacks images of some cameras", f"{where}: image at {inner[0][0].time_us}"
        got = f"no {', '.join(absent)}; {len(inner)} such moments"
        remedy = "choose cameras with --cameras, or add --skip-missing"
        raise InputError(what, where=where, got=got, expected="every chosen camera", remedy=remedy)
    if not kept:
        what = "no moment has images of all cameras"
        remedy = "choose cameras with --cameras, or other frames with --frames"
        raise InputError(what, where=where, got=f"{len(shots)} images", expected=", ".join(names), remedy=remedy)
    cut = len(groups) - len(kept)
    return kept, [f"{cut} moments without images of all cameras were left out"] if cut else []


def _by_moment(shots: Sequence[_Shot], names: Sequence[str], where: str) -> list[list[_Shot]]:
    """Images put together by time, in order of time.

    Cameras fire one after another, each at its own part of the period. So an image belongs to the nearest image of the
    camera that has most of them, after its own camera's median delay is taken off. What lies half a period from all is
    alone.
    """
    by_camera = {name: [shot for shot in shots if shot.channel == name] for name in names}
    for name, found in by_camera.items():
        for shot, following in itertools.pairwise(found):
            if shot.time_us == following.time_us:
                what, where = "two images of one camera have the same time", f"{where}: image at {shot.time_us}"
                got = f"{name}: {shot.file.name} and {following.file.name}"
                remedy = "are rows of the table doubled? copy the file again"
                raise InputError(what, where=where, expected="a row for every image", got=got, remedy=remedy)
    leading = max(by_camera.values(), key=len)
    if not leading:
        return []
    beats = np.array([shot.time_us for shot in leading])
    half_us = float(np.median(np.diff(beats))) / 2 if len(beats) > 1 else _PERIOD_US / 2
    groups: dict[int, list[_Shot]] = {index: [] for index in range(len(beats))}
    alone = []
    for found in by_camera.values():
        times = np.array([shot.time_us for shot in found], np.int64)
        late = times - beats[common.nearest_index(beats, times)]
        usual = float(np.median(late[np.abs(late) <= half_us])) if (np.abs(late) <= half_us).any() else 0.0
        for shot, index in zip(found, common.nearest_index(beats, times - usual), strict=True):
            taken = any(other.channel == shot.channel for other in groups[int(index)])
            if taken or abs(shot.time_us - usual - beats[index]) >= half_us:
                alone.append([shot])
            else:
                groups[int(index)].append(shot)
    return sorted([*groups.values(), *alone], key=lambda group: min(shot.time_us for shot in group))


# --- writing --------------------------------------------------------------------------------------


def _content(opened: NuplanLog, plan: _NuplanPlan, options: ImportOptions) -> SceneContent[Any]:
    start_us = plan.clouds[0].time_us if plan.clouds else plan.moments[0][0].time_us
    found: list[str] = []
    ego = common.mended_path(_ego_path(plan, start_us, str(opened.path)), found)
    first = ego.pose_at(0.0)
    if first is None:
        what, where = "vehicle poses do not cover the log", f"{opened.path}: ego_pose"
        expected, remedy = f"a pose at {start_us} us", "are pose and cloud times both in microseconds?"
        raise InputError(what, where=where, expected=expected, got=f"{len(plan.ego_us)} poses near it", remedy=remedy)
    world_from_source = common.world_from_first(first)
    ego = EgoPath(ego.times_s, world_from_source @ ego.world_from_ego)
    fits = {CAMERAS[channel]: _fit(camera, options) for channel, camera in plan.cameras.items()}
    tracks, track_notes = _read_tracks(opened, plan, start_us, world_from_source)
    notes = [*plan.notes, *found, *image_notes(fits), common.origin_note(first)]
    notes.append(f"image poses {IMAGE_DELAY_US / 1e6:.4f} s after the time stamps: the middle of the read-out")

    def taken_s(shot: _Shot) -> float:
        return (shot.time_us + IMAGE_DELAY_US - start_us) / 1e6

    def convert(item: tuple[int, NuplanCloud | Sequence[_Shot]]) -> Iterable[SceneImage | SceneSweep]:
        index, what = item
        if isinstance(what, NuplanCloud):
            time_s, pose = (what.time_us - start_us) / 1e6, world_from_source @ what.world_from_lidar
            yield SceneSweep(SENSOR, index, time_s, pose, _read_points(what.file, what.places), str(what.file))
            return
        for shot in what:
            time_s = taken_s(shot)
            mount = plan.cameras[shot.channel].ego_from_cam
            world_from_cam = common.pose_near(ego, time_s, where=str(shot.file)) @ mount
            yield SceneImage(CAMERAS[shot.channel], index, time_s, world_from_cam, shot.file, str(shot.file))

    moments = list(enumerate(plan.moments))
    if options.skip_missing:
        moments = [one for one in moments if all(common.has_pose(ego, taken_s(shot)) for shot in one[1])]
        if len(moments) < len(plan.moments):
            notes.append(f"{len(plan.moments) - len(moments)} moments without a vehicle pose were left out")
    items = [*enumerate(plan.clouds), *moments]
    source = Source("nuplan", LICENCE, None, (*notes, *track_notes))
    name = lambda item: f"{'cloud' if isinstance(item[1], NuplanCloud) else 'moment'} {item[0]}"
    return SceneContent(plan.name, source, fits, items, convert, name, ego, tracks=lambda: (tracks, ()))


def _read_tracks(
    opened: NuplanLog, plan: _NuplanPlan, start_us: int, world_from_source: Matrix
) -> tuple[list[Track], list[str]]:
    """Tracks in the scene's world and clock from the boxes of the plan's clouds, and notes."""
    tracks = BoxTracks(f"{opened.path}: lidar_box", LABELS)
    time_of = {cloud.token: (cloud.time_us - start_us) / 1e6 for cloud in plan.clouds}
    span = (plan.clouds[0].time_us, plan.clouds[-1].time_us) if plan.clouds else (0, -1)
    for token, track, label, (x, y, z, yaw, length, width, height) in opened.boxes(*span):
        if token in time_of:
            pose = world_from_source @ yaw_matrix(yaw, (x, y, z))
            tracks.add(track, tracks.label_of(label), time_of[token], (length, width, height), pose)
    return tracks.tracks()


def _ego_path(plan: _NuplanPlan, start_us: int, where: str) -> EgoPath:
    """The vehicle in the log's world and the scene's clock."""
    if not len(plan.ego_us):
        what, where = "no vehicle poses at the time of the clouds", f"{where}: ego_pose.timestamp"
        expected = "microseconds, as lidar_pc.timestamp"
        raise InputError(what, where=where, expected=expected, remedy="are the two in different units?")
    return EgoPath(common.seconds(plan.ego_us, "us", f"{where}: ego_pose.timestamp", start_us), plan.world_from_ego)


def _fit(camera: NuplanCamera, options: ImportOptions) -> ImageFit:
    fx, fy, cx, cy = camera.intrinsics
    lens = brown_conrady(*camera.distortion) if any(camera.distortion) else None
    # the calibration counts pixels from the centre of the top-left one, as OpenCV does
    recorded = Camera(CAMERAS[camera.channel], *camera.size, fx, fy, cx + 0.5, cy + 0.5, camera.distortion)
    return fit_images(recorded, options, lens)


def _read_points(path: Path, places: Sequence[Matrix]) -> SweepPoints:
    """A merged cloud; zeros of the LiDARs that were merged lie at their ``places``, f64[3] each."""
    cloud = read_cloud(path)
    intensity = cloud.fields.get("intensity", np.zeros(len(cloud.xyz)))
    returns = ~near_places(cloud.xyz, places)
    xyz = cloud.xyz[returns].astype(np.float32)
    grey = common.unit_intensity(intensity[returns], 255, f"{path}: intensity")
    no_returns = cloud.missing + int((~returns).sum())
    return SweepPoints(xyz, grey, np.zeros(len(xyz), np.float32), no_returns=no_returns)
