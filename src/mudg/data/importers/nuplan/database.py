"""nuPlan log files: one SQLite database per log, opened read-only, the schema checked before the first question.

Names of tables and columns are literal here. Nothing from the file becomes part of a query, a path outside the sensor blobs, or
code: calibration columns are pickles, read by ``plain_pickle``.
"""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final
from urllib.parse import quote

import numpy as np
from numpy.typing import NDArray

from mudg.base.checks import foreign_name
from mudg.base.errors import InputError
from mudg.base.geometry import invert
from mudg.data.importers.columns import require_columns
from mudg.data.importers.common import pose_from_quaternion
from mudg.data.importers.layout import path_inside
from mudg.data.plain_pickle import NUMPY_MAKERS, Maker, as_list, read_pickle
from mudg.data.scene.schema import ref_problem
from mudg.data.unknown_fields import note_unknown

Matrix = NDArray[np.float64]
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
    "ego_pose": frozenset({
        "log_token", "epsg", *(f"{name}{axis}" for name in ("v", "acceleration_", "angular_rate_") for axis in _XYZ),
    }),
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
}  # fmt: skip
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
    """One camera: name in the data set, place on the vehicle f64[4, 4], fx fy cx cy, lens k1 k2 p1 p2 k3, width, height."""

    channel: str
    ego_from_cam: Matrix
    intrinsics: tuple[float, float, float, float]
    distortion: tuple[float, ...]
    size: tuple[int, int]


@dataclass(frozen=True, slots=True)
class NuplanCloud:
    """One point cloud: its token, file, time (us), world-from-lidar f64[4, 4] in the log's world, and where the log's LiDARs sit in the
    cloud's frame, f64[3] each."""

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
            raise InputError("log database is damaged", where=str(self.path), got=str(error)[:200],
                remedy="copy the file again") from error  # fmt: skip

    def check(self) -> None:
        """Refuse a database that is not a nuPlan log."""
        tables = {
            str(name): str(sql) for name, sql in self.rows("SELECT name, sql FROM sqlite_master WHERE type = 'table'")
        }
        for table, columns in SCHEMA.items():
            if table not in tables or tables[table].upper().startswith("CREATE VIRTUAL"):
                raise InputError(f"database has no table {table!r}", where=str(self.path), expected=", ".join(SCHEMA),
                    got=", ".join(sorted(tables)) or "no tables", remedy="is it a nuPlan log (v1.1)?")  # fmt: skip
            there = [str(row[1]) for row in self.rows(f"PRAGMA table_info({table})")]
            require_columns(columns, there, f"{self.path}: {table}")
            note_unknown(f"the table {table}", there, OFFICIAL[table].union(columns))
        note_unknown("the database", [name for name in tables if not name.startswith("sqlite_")], frozenset(OFFICIAL))

    def name(self) -> str:
        """The log's name, e.g. ``2021.05.12.22.00.38_veh-35_01008_01518``."""
        for (name,) in self.rows("SELECT logfile FROM log"):
            name = text_of(name, f"{self.path}: log.logfile")
            problem = "has folders in it" if "/" in name else ref_problem(name)
            if problem is not None:
                raise InputError(f"log's name {problem}", where=f"{self.path}: log.logfile", got=repr(name), expected="a folder's name")
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
                raise InputError("intrinsics are not of a pinhole camera", where=f"{where}.intrinsic",
                    got=str(matrix.tolist()), expected="[[fx, 0, cx], [0, fy, cy], [0, 0, 1]] in pixels")  # fmt: skip
            width, height = (_whole(values[index], f"{where}.{name}") for index, name in ((4, "width"), (5, "height")))
            found[token_of(token, f"{where}.token")] = NuplanCamera(
                channel,
                self._pose(values[0], values[1], where),
                (float(matrix[0, 0]), float(matrix[1, 1]), float(matrix[0, 2]), float(matrix[1, 2])),
                tuple(self._numbers(values[3], f"{where}.distortion", None)),
                (width, height),
            )
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
            path, time_us = path_inside(blobs, file, where), self._time(time_us, "lidar_pc")
            return NuplanCloud(token, path, time_us, self._ego(pose, where) @ mount, places)
        return None

    def ego_poses(self, first_us: int, last_us: int) -> tuple[NDArray[np.int64], Matrix]:
        """Times (us) and poses f64[n, 4, 4] of the vehicle from ``first_us`` to ``last_us``; doubled times once."""
        times, poses = [], []
        for time_us, *pose in self.rows(
            "SELECT timestamp, x, y, z, qw, qx, qy, qz FROM ego_pose WHERE timestamp BETWEEN ? AND ? ORDER BY timestamp",
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
            "SELECT camera_token, filename_jpg, timestamp FROM image WHERE timestamp BETWEEN ? AND ? ORDER BY timestamp",
            (first_us, last_us),
        ):
            time_us = self._time(time_us, "image")
            where = f"{self.path}: image at {time_us}"
            yield token_of(camera, f"{where}: camera_token"), path_inside(blobs, file, where), time_us

    def boxes(self, first_us: int, last_us: int) -> Iterator[tuple[bytes, str, str, tuple[float, ...]]]:
        """Cloud, track, class, and x y z yaw length width height (metres, radians, the log's world) of all boxes of a span.

        One pass over the table: the databases need not have an index of boxes by cloud.
        """
        for cloud, track, label, *numbers in self.rows(
            "SELECT p.token, b.track_token, c.name, b.x, b.y, b.z, b.yaw, b.length, b.width, b.height FROM lidar_pc AS p "
            "JOIN lidar_box AS b ON b.lidar_pc_token = p.token LEFT JOIN track AS t ON t.token = b.track_token "
            "LEFT JOIN category AS c ON c.token = t.category_token WHERE p.timestamp BETWEEN ? AND ?",
            (first_us, last_us),
        ):
            track = token_of(track, f"{self.path}: lidar_box.track_token").hex()
            where = f"{self.path}: lidar_box of track {track}"
            if label is None:
                raise InputError("box names a track or class that is not there", where=where,
                    expected="tokens of track and category", remedy="copy the file again")  # fmt: skip
            label = text_of(label, f"{self.path}: category.name")
            yield token_of(cloud, where), track, label, tuple(_finite(number, where) for number in numbers)

    def scenes(self) -> list[str]:
        """Names of the scenes (pieces of up to 20 s)."""
        return [text_of(name, f"{self.path}: scene.name") for (name,) in self.rows("SELECT name FROM scene ORDER BY name")]

    def _time(self, value: Any, table: str) -> int:
        return _whole(value, f"{self.path}: {table}.timestamp")

    def _ego(self, row: list[Any], where: str) -> Matrix:
        x, y, z, *wxyz = (_finite(number, where) for number in row)
        return pose_from_quaternion(wxyz, (x, y, z), where)

    def _pose(self, translation: Any, rotation: Any, where: str) -> Matrix:
        xyz = self._numbers(translation, f"{where}.translation", 3)
        return pose_from_quaternion(self._numbers(rotation, f"{where}.rotation", 4), xyz, where)

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
            raise InputError("calibration has the wrong number of values", where=where, expected=str(count),
                got=str(len(flat)))  # fmt: skip
        return flat


def token_of(value: Any, where: str) -> bytes:
    """A token: 1 to 64 bytes. InputError otherwise: SQLite columns may hold values of any type."""
    if not isinstance(value, bytes) or not 0 < len(value) <= _MAX_TOKEN_BYTES:
        got = f"{len(value)} bytes" if isinstance(value, bytes | str) else repr(value)[:40]
        raise InputError("token is no short blob", where=where, expected=f"1 to {_MAX_TOKEN_BYTES} bytes",
            got=f"{type(value).__name__}, {got}", remedy="is it a nuPlan log (v1.1)? copy the file again")  # fmt: skip
    return value


def text_of(value: Any, where: str) -> str:
    """A name: a text of 1 to 200 bytes."""
    if not isinstance(value, str) or not value:
        raise InputError("name is no text", where=where, expected="a text", got=type(value).__name__ if value else repr(value))
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
    """Open a log database read-only and check its schema.

    Raises:
        InputError: missing, not SQLite, damaged, or another schema.
    """
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
        raise InputError("file is not a readable SQLite database", where=str(path), got=str(error),
            expected="a nuPlan log (.db)", remedy="is it cut off, or still packed?") from error  # fmt: skip
    finally:
        if connection is not None:
            connection.close()
