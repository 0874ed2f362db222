"""Strict parsing of ``scene.json`` and ``tracks.json`` into the words of ``base/types.py``, and the text they are written as.

Every refusal is an ``InputError`` that names file, record and field, says what was expected and found, and what to do.
The parser takes ``complain``: the reader passes a function that raises at the first problem, ``mudg doctor`` passes one
that collects them all, so that a person sees every mistake of a hand-made scene at once.
"""

from __future__ import annotations

import difflib
import json
import math
import re
from collections.abc import Callable, Iterable, Mapping
from typing import Any, Final, Literal

import numpy as np
from numpy.typing import NDArray

from mudg.base import store
from mudg.base.errors import InputError
from mudg.base.geometry import rigid_problem
from mudg.base.types import Camera, EgoPath, Frame, Ref, Scene, Source, Sweep, Track, View

FORMAT: Final = "mudg-scene"
SCHEMA_VERSION: Final = 1
RIGID_TOLERANCE: Final = 1e-4
MAX_IMAGE_SIDE_PX: Final = 32768

LABEL_NAMES: Final = (
    "depth",
    "semantics",
    "sky",
    "ego",
    "dynamic",
    "instance",
    "semantics_confidence",
    "depth_confidence",
)
"""Labels a frame may carry; see ``scenefile.read_label`` for the array each of them is."""

NAME_PATTERN: Final = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.\-+]{0,63}")
"""Names that become folders: cameras, sensors."""

Complain = Callable[[InputError], None]


def raise_first(problem: InputError) -> None:
    """The strict reader's answer to a problem."""
    raise problem


# --- JSON -----------------------------------------------------------------------------------------------------------


def parse_object(data: bytes, where: str) -> dict[str, Any]:
    """Parse one strict JSON object (no NaN, no duplicate keys, an object at the top); InputError names ``where``."""
    parsed = store.parse_json(data, where)
    if not isinstance(parsed, dict):
        raise InputError(
            "the top of the file is not an object", where=where, expected="{...}", got=type(parsed).__name__
        )
    return parsed


def ref_problem(text: object) -> str | None:
    """Say why ``text`` is no acceptable file reference inside a scene, or return None.

    Accepted: relative POSIX paths of plain components. Refused: absolute paths, ``.``/``..``, empty components,
    backslashes, colons (drive letters, streams), control characters, components ending in a dot or space.
    """
    if not isinstance(text, str) or not text:
        return "is not a non-empty text"
    if len(text) > 400:
        return "is longer than 400 characters"
    if any(ord(character) < 32 or ord(character) == 127 for character in text):
        return "contains control characters"
    if "\\" in text:
        return "contains a backslash (references use forward slashes)"
    if ":" in text:
        return "contains a colon (drive letters and streams are not allowed)"
    if text.startswith("/"):
        return "is absolute (references are relative to the scene)"
    for component in text.split("/"):
        if component in ("", ".", ".."):
            return f"contains the component {component!r}"
        if component[-1] in ". ":
            return f"has the component {component!r} that ends in a dot or space"
    return None


class Record:
    """One JSON object with its place in the file: typed access where each failure names path, record and field."""

    def __init__(self, value: object, where: str, keys: Iterable[str], optional: Iterable[str] = ()) -> None:
        self.where = where
        if not isinstance(value, dict):
            raise InputError("a record is not an object", where=where, expected="{...}", got=type(value).__name__)
        self._fields: Mapping[str, Any] = value
        required = tuple(keys)
        known = (*required, *optional)
        for key in value:
            if key not in known:
                near = difflib.get_close_matches(key, known, 1)
                raise InputError(
                    f"unknown field {key!r}",
                    where=where,
                    expected=f"one of {', '.join(known)}",
                    remedy=f"did you mean {near[0]!r}?" if near else "remove it",
                )
        for key in required:
            if key not in value:
                raise InputError(
                    f"the field {key!r} is missing",
                    where=where,
                    expected=f"{', '.join(required)}",
                    got=", ".join(value) or "an empty object",
                )

    def __contains__(self, key: str) -> bool:
        return key in self._fields

    def at(self, key: str) -> str:
        """Where the field ``key`` stands."""
        return f"{self.where}.{key}"

    def raw(self, key: str) -> Any:
        """The unchecked JSON value."""
        return self._fields[key]

    def text(self, key: str) -> str:
        """A text."""
        value = self._fields[key]
        if not isinstance(value, str):
            raise InputError("field is not a text", where=self.at(key), expected="a text", got=repr(value)[:80])
        return value

    def name(self, key: str) -> str:
        """A text that can be a folder name."""
        value = self.text(key)
        check_name(value, self.at(key))
        return value

    def number(self, key: str) -> float:
        """A finite number."""
        return finite_number(self._fields[key], self.at(key))

    def integer(self, key: str) -> int:
        """A whole number."""
        value = self._fields[key]
        if isinstance(value, bool) or not isinstance(value, int):
            raise InputError(
                "field is not a whole number", where=self.at(key), expected="an integer", got=repr(value)[:80]
            )
        return value

    def ref(self, key: str) -> Ref:
        """A reference to a file inside the scene."""
        return checked_ref(self._fields[key], self.at(key))

    def pose(self, key: str) -> NDArray[np.float64]:
        """A rigid motion f64[4, 4]."""
        return rigid_pose(self._fields[key], self.at(key))

    def items(self, key: str) -> list[Any]:
        """A list."""
        value = self._fields[key]
        if not isinstance(value, list):
            raise InputError("field is not a list", where=self.at(key), expected="[...]", got=type(value).__name__)
        return value


def check_name(value: str, where: str) -> None:
    """Refuse camera, sensor and label folder names that are not plain."""
    if not NAME_PATTERN.fullmatch(value) or value.endswith("."):
        raise InputError(
            "name cannot be a folder name",
            where=where,
            expected="1-64 letters, digits or _ . - + starting with a letter or digit",
            got=repr(value)[:80],
        )


def finite_number(value: object, where: str) -> float:
    """A finite JSON number, else InputError."""
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise InputError("value is not a number", where=where, expected="a number", got=repr(value)[:80])
    try:
        number = float(value)
    except OverflowError:
        number = math.inf
    if not math.isfinite(number):
        raise InputError("value is not finite", where=where, expected="a finite number", got=repr(value)[:80])
    return number


def checked_ref(value: object, where: str) -> Ref:
    """A file reference inside the scene, else InputError."""
    problem = ref_problem(value)
    if problem is not None:
        raise InputError(
            f"file reference {problem}",
            where=where,
            got=repr(value)[:120],
            expected="a relative path inside the scene, e.g. images/front/000000.png",
        )
    return Ref(str(value))


def rigid_pose(value: object, where: str) -> NDArray[np.float64]:
    """A rigid motion given as 3 or 4 rows of 4 numbers, or as 12 or 16 numbers row by row; f64[4, 4]."""
    rows = value
    if isinstance(value, list) and len(value) in (3, 4) and all(isinstance(row, list) for row in value):
        rows = [number for row in value for number in row]
    if not isinstance(rows, list) or len(rows) not in (12, 16):
        raise InputError(
            "pose is not a 3x4 or 4x4 matrix",
            where=where,
            expected="12 or 16 numbers, row by row (world metres)",
            got=_shape_of(value),
        )
    numbers = [finite_number(number, f"{where}[{index}]") for index, number in enumerate(rows)]
    matrix = np.vstack([np.array(numbers[:12]).reshape(3, 4), [0.0, 0.0, 0.0, 1.0]])
    if len(numbers) == 16:
        matrix = np.array(numbers).reshape(4, 4)
    problem = rigid_problem(matrix, RIGID_TOLERANCE)
    if problem is not None:
        raise InputError(
            "pose is not a rigid motion",
            where=where,
            got=problem,
            expected=f"a right-handed rotation (orthonormal within {RIGID_TOLERANCE:g}) and a translation in metres",
            remedy="remove scale or mirroring from the matrix; check row against column order",
        )
    return matrix


def _shape_of(value: object) -> str:
    if isinstance(value, list):
        inner = {len(item) if isinstance(item, list) else 0 for item in value}
        return f"a list of {len(value)}" + (f" lists of length {sorted(inner)}" if inner - {0} else " values")
    return type(value).__name__


def increasing_problem(times_s: NDArray[np.float64]) -> str | None:
    """Say where ``times_s`` stop increasing, or return None."""
    steps = np.diff(times_s)
    bad = np.flatnonzero(~(steps > 0))
    if len(bad) == 0:
        return None
    at = int(bad[0])
    return f"entry {at + 1} ({times_s[at + 1]:.6f} s) does not come after entry {at} ({times_s[at]:.6f} s)"


# --- records --------------------------------------------------------------------------------------------------------


def camera_from_json(name: str, value: object, where: str) -> Camera:
    """Parse and check one camera."""
    check_name(name, where)
    record = Record(value, where, ("width", "height", "fx", "fy", "cx", "cy"), ("distortion", "readout_s"))
    width, height = record.integer("width"), record.integer("height")
    for key, side in (("width", width), ("height", height)):
        if not 1 <= side <= MAX_IMAGE_SIDE_PX:
            raise InputError(
                "image size makes no sense",
                where=record.at(key),
                expected=f"1..{MAX_IMAGE_SIDE_PX} pixels",
                got=str(side),
            )
    fx, fy, cx, cy = (record.number(key) for key in ("fx", "fy", "cx", "cy"))
    distortion: tuple[float, ...] = ()
    if "distortion" in record:
        numbers = record.items("distortion")
        distortion = tuple(finite_number(n, f"{record.at('distortion')}[{i}]") for i, n in enumerate(numbers))
    readout_s = record.number("readout_s") if "readout_s" in record else 0.0
    check_intrinsics((width, height), (fx, fy), (cx, cy), readout_s, where)
    return Camera(name, width, height, fx, fy, cx, cy, distortion, readout_s)


def check_intrinsics(
    size: tuple[int, int], focal: tuple[float, float], centre: tuple[float, float], readout_s: float, where: str
) -> None:
    """Refuse intrinsics (pixels) that no pinhole camera has: before a Camera is made, so that the field can be named."""
    longest = max(size)
    for key, value in zip(("fx", "fy"), focal, strict=True):
        if not math.isfinite(value) or not 0.01 * longest <= value <= 1000 * longest:
            raise InputError(
                "focal length makes no sense",
                where=f"{where}.{key}",
                got=f"{value:g} pixels",
                expected=f"pixels, between {0.01 * longest:g} and {1000 * longest:g} for this image size",
                remedy="give the focal length in pixels, not millimetres, and not zero",
            )
    for key, value, side in zip(("cx", "cy"), centre, size, strict=True):
        if not math.isfinite(value) or not -side <= value <= 2 * side:
            raise InputError(
                "principal point lies far outside the image",
                where=f"{where}.{key}",
                got=f"{value:g} pixels",
                expected=f"pixels, usually near {side / 2:g}",
                remedy="check units and whether the image was cropped",
            )
    if not math.isfinite(readout_s) or not 0 <= readout_s < 1:
        raise InputError(
            "rolling-shutter readout makes no sense",
            where=f"{where}.readout_s",
            expected="0 (global shutter) to 1 s",
            got=f"{readout_s:g}",
        )


def frame_from_json(value: object, where: str, cameras: Mapping[str, Camera]) -> Frame:
    """Parse one frame; its camera must be known."""
    record = Record(value, where, ("id", "camera", "time_s", "world_from_cam", "image"), ("labels",))
    camera_name = record.text("camera")
    if camera_name not in cameras:
        raise InputError(
            f"frame names the camera {camera_name!r}, which the scene does not have",
            where=record.at("camera"),
            expected=f"one of {', '.join(cameras)}",
            got=camera_name,
        )
    frame_id = record.text("id")
    check_frame_id(frame_id, camera_name, record.at("id"))
    view = View(cameras[camera_name], record.pose("world_from_cam"), record.number("time_s"))
    labels: dict[str, Ref] = {}
    if "labels" in record:
        label_record = Record(record.raw("labels"), record.at("labels"), (), LABEL_NAMES)
        labels = {key: label_record.ref(key) for key in LABEL_NAMES if key in label_record}
    return Frame(frame_id, view, record.ref("image"), labels)


def check_frame_id(frame_id: str, camera_name: str, where: str) -> None:
    """A frame id is ``<camera>/<digits>``."""
    if not re.fullmatch(re.escape(camera_name) + r"/[0-9]{1,12}", frame_id):
        raise InputError(
            "frame id does not fit its camera", where=where, expected=f"{camera_name}/000012", got=repr(frame_id)[:80]
        )


def sweep_from_json(value: object, where: str) -> Sweep:
    """Parse one LiDAR sweep record."""
    record = Record(value, where, ("id", "sensor", "time_s", "world_from_lidar", "points"))
    return Sweep(
        record.text("id"),
        record.name("sensor"),
        record.number("time_s"),
        record.pose("world_from_lidar"),
        record.ref("points"),
    )


def track_from_json(value: object, where: str) -> Track:
    """Parse one tracked box."""
    record = Record(value, where, ("id", "label", "size_m", "times_s", "world_from_object"))
    size = np.array([finite_number(n, f"{record.at('size_m')}[{i}]") for i, n in enumerate(record.items("size_m"))])
    if size.shape != (3,) or not ((size > 0) & (size < 200)).all():
        raise InputError(
            "box size makes no sense",
            where=record.at("size_m"),
            expected="[length, width, height] in metres, each above 0 and below 200",
            got=str(size.tolist()),
        )
    times_s, poses = _timed_poses(record, "times_s", "world_from_object")
    return Track(record.text("id"), record.text("label"), size, times_s, poses)


def ego_from_json(value: object, where: str) -> EgoPath:
    """Parse the ego path."""
    record = Record(value, where, ("times_s", "world_from_ego"))
    return EgoPath(*_timed_poses(record, "times_s", "world_from_ego"))


def _timed_poses(record: Record, times_key: str, poses_key: str) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    times = [finite_number(t, f"{record.at(times_key)}[{i}]") for i, t in enumerate(record.items(times_key))]
    items = record.items(poses_key)
    poses = _poses_at_once(items)
    if poses is None:  # something is wrong, or the rows are nested: one by one, so that the place can be named
        poses = np.array([rigid_pose(p, f"{record.at(poses_key)}[{i}]") for i, p in enumerate(items)])
    if not times or len(times) != len(poses):
        raise InputError(
            "times and poses do not pair up",
            where=record.where,
            expected="equally many, at least one",
            got=f"{len(times)} times and {len(poses)} poses",
        )
    times_s = np.array(times)
    problem = increasing_problem(times_s)
    if problem is not None:
        raise InputError(
            "times do not increase",
            where=record.at(times_key),
            expected="seconds, strictly increasing",
            got=problem,
            remedy="sort the poses by time and drop duplicates",
        )
    return times_s, poses


def _poses_at_once(items: list[Any]) -> NDArray[np.float64] | None:
    """Many poses of 12 numbers each, f64[n, 4, 4]; None if anything is not as it should be."""
    numbers = [number for item in items if isinstance(item, list) and len(item) == 12 for number in item]
    if len(numbers) != 12 * len(items) or not all(type(number) in (float, int) for number in numbers):
        return None
    try:
        rows = np.array(numbers, np.float64).reshape(len(items), 3, 4)
    except OverflowError:
        return None
    rotations = rows[:, :, :3]
    error = np.abs(rotations @ np.swapaxes(rotations, 1, 2) - np.eye(3)).max(initial=0.0)
    if not np.isfinite(rows).all() or error > RIGID_TOLERANCE or (np.linalg.det(rotations) < 0).any():
        return None
    poses = np.zeros((len(items), 4, 4))
    poses[:, :3], poses[:, 3, 3] = rows, 1.0
    return poses


def source_from_json(value: object, where: str) -> Source:
    """Parse where the log comes from and under which licence."""
    record = Record(value, where, ("dataset", "licence"), ("recipe", "notes"))
    recipe = record.raw("recipe") if "recipe" in record else None
    if recipe is not None and not isinstance(recipe, dict):
        raise InputError(
            "recipe is not an object", where=record.at("recipe"), expected="{...} or null", got=type(recipe).__name__
        )
    notes = record.items("notes") if "notes" in record else []
    if not all(isinstance(note, str) for note in notes):
        raise InputError("notes are not a list of texts", where=record.at("notes"))
    return Source(record.text("dataset"), record.text("licence"), recipe, tuple(notes))


# --- whole files ----------------------------------------------------------------------------------------------------


def scene_from_json(
    scene_json: dict[str, Any],
    tracks_json: dict[str, Any] | None,
    root: str,
    where: str,
    complain: Complain = raise_first,
) -> Scene:
    """Build a Scene from the two parsed files.

    Args:
        scene_json: content of ``scene.json``.
        tracks_json: content of ``tracks.json``; None when the scene has none.
        root: where the files lie (folder or zip), kept in the Scene.
        where: path of ``scene.json`` for messages.
        complain: called with each problem; raises in the strict reader. A record with a problem is left out.

    Raises:
        InputError: the frame of the file itself is wrong, or ``complain`` raised.
    """
    _check_format(scene_json, FORMAT, where)
    top = Record(
        scene_json,
        where,
        ("format", "schema_version", "id", "source", "cameras", "frames", "ego"),
        ("sweeps", "split", "conventions"),
    )
    if not isinstance(top.raw("cameras"), dict) or not top.raw("cameras"):
        raise InputError("scene has no cameras", where=top.at("cameras"), expected="at least one camera by name")
    cameras = _parse_each(
        top.raw("cameras").items(), lambda key, item: camera_from_json(key, item, f"{where}: cameras.{key}"), complain
    )
    named_cameras = {camera.name: camera for camera in cameras}
    frames = _parse_each(
        enumerate(top.items("frames")),
        lambda index, item: frame_from_json(item, f"{where}: frames[{index}]", named_cameras),
        complain,
    )
    sweep_items = top.items("sweeps") if "sweeps" in top else []
    sweeps = _parse_each(
        enumerate(sweep_items), lambda index, item: sweep_from_json(item, f"{where}: sweeps[{index}]"), complain
    )
    tracks = (
        tracks_from_json(tracks_json, complain, where.replace("scene.json", "tracks.json"))
        if tracks_json is not None
        else ()
    )
    scene = Scene(
        id=top.text("id"),
        root=root,
        cameras=named_cameras,
        frames=tuple(frames),
        sweeps=tuple(sweeps),
        tracks=tuple(tracks),
        ego=ego_from_json(top.raw("ego"), f"{where}: ego"),
        split=_split_from_json(top, frames),
        source=source_from_json(top.raw("source"), f"{where}: source"),
    )
    check_relations(scene, where, complain)
    return scene


def tracks_from_json(tracks_json: dict[str, Any], complain: Complain, where: str) -> tuple[Track, ...]:
    """Parse ``tracks.json``."""
    _check_format(tracks_json, "mudg-tracks", where)
    top = Record(tracks_json, where, ("format", "schema_version", "tracks"))
    return tuple(
        _parse_each(
            enumerate(top.items("tracks")),
            lambda index, item: track_from_json(item, f"{where}: tracks[{index}]"),
            complain,
        )
    )


def _check_format(top: dict[str, Any], name: str, where: str) -> None:
    if top.get("format") != name:
        raise InputError(
            f"this is not a {name} file", where=where, expected=f'"format": "{name}"', got=repr(top.get("format"))[:80]
        )
    if top.get("schema_version") != SCHEMA_VERSION:
        raise InputError(
            "schema version is not one this program reads",
            where=f"{where}: schema_version",
            expected=str(SCHEMA_VERSION),
            got=repr(top.get("schema_version"))[:80],
            remedy="ingest the log again with this version, or use the version that wrote it",
        )


def _parse_each(items: Iterable[tuple[Any, Any]], parse: Callable[[Any, Any], Any], complain: Complain) -> list[Any]:
    parsed = []
    for key, item in items:
        try:
            parsed.append(parse(key, item))
        except InputError as problem:
            complain(problem)
    return parsed


def _split_from_json(top: Record, frames: Iterable[Frame]) -> dict[str, Literal["train", "test"]]:
    frame_ids = [frame.id for frame in frames]
    if "split" not in top:
        return dict.fromkeys(frame_ids, "train")
    split = top.raw("split")
    if not isinstance(split, dict) or not all(value in ("train", "test") for value in split.values()):
        raise InputError(
            "split is not a table of train and test", where=top.at("split"), expected='{"front/000004": "test", ...}'
        )
    return {**dict.fromkeys(frame_ids, "train"), **split}


def check_relations(scene: Scene, where: str, complain: Complain = raise_first) -> None:
    """Checks that span records: frames exist, ids are unique, times increase per sensor, the split names real frames."""
    if not scene.frames:
        complain(InputError("scene has no frames", where=f"{where}: frames", expected="at least one image"))
    for kind, ids in (
        ("frames", [f.id for f in scene.frames]),
        ("sweeps", [s.id for s in scene.sweeps]),
        ("tracks", [t.id for t in scene.tracks]),
    ):
        twice = sorted({i for i in ids if ids.count(i) > 1}) if len(set(ids)) != len(ids) else []
        if twice:
            complain(
                InputError(
                    "an id occurs twice", where=f"{where}: {kind}", got=", ".join(twice[:5]), expected="unique ids"
                )
            )
    times_by_sensor: dict[str, list[float]] = {}
    for frame in scene.frames:
        times_by_sensor.setdefault(f"frames of camera {frame.view.camera.name}", []).append(frame.view.time_s)
    for sweep in scene.sweeps:
        times_by_sensor.setdefault(f"sweeps of sensor {sweep.sensor}", []).append(sweep.time_s)
    for sensor, times in times_by_sensor.items():
        problem = increasing_problem(np.array(times))
        if problem is not None:
            complain(
                InputError(
                    "times do not increase",
                    where=f"{where}: {sensor}",
                    got=problem,
                    expected="seconds, strictly increasing per sensor",
                    remedy="sort the records by time",
                )
            )
    known = {frame.id for frame in scene.frames}
    unknown = [frame_id for frame_id in scene.split if frame_id not in known]
    if unknown:
        complain(
            InputError(
                "split names frames that the scene does not have", where=f"{where}: split", got=", ".join(unknown[:5])
            )
        )


# --- writing --------------------------------------------------------------------------------------------------------


def scene_to_json_text(scene: Scene) -> str:
    """The text of ``scene.json``: one record a line, so that people can read and compare it."""
    head: dict[str, Any] = {
        "format": FORMAT,
        "schema_version": SCHEMA_VERSION,
        "id": scene.id,
        "conventions": "metres, seconds, pixels; world z up; camera x right, y down, z forward; a_from_b row-major 3x4; "
        "the centre of the top-left pixel is (0.5, 0.5)",
        "source": {
            "dataset": scene.source.dataset,
            "licence": scene.source.licence,
            "recipe": scene.source.recipe,
            "notes": list(scene.source.notes),
        },
    }
    lines = [f" {json.dumps(key)}: {_dumps(value)}," for key, value in head.items()]
    cameras = [f"{json.dumps(name)}: {_dumps(_camera_to_json(camera))}" for name, camera in scene.cameras.items()]
    lines.append(' "cameras": {\n  ' + ",\n  ".join(cameras) + "\n },")
    lines.append(' "frames": [' + _record_lines(_frame_to_json(frame) for frame in scene.frames) + "],")
    lines.append(' "sweeps": [' + _record_lines(_sweep_to_json(sweep) for sweep in scene.sweeps) + "],")
    lines.append(' "split": ' + _dumps(dict(scene.split)) + ",")
    lines.append(
        ' "ego": '
        + _dumps(
            {
                "times_s": scene.ego.times_s.tolist(),
                "world_from_ego": [pose_to_json(pose) for pose in scene.ego.world_from_ego],
            }
        )
    )
    return "{\n" + "\n".join(lines) + "\n}\n"


def tracks_to_json_text(tracks: Iterable[Track]) -> str:
    """The text of ``tracks.json``, one track a line."""
    records = (
        {
            "id": track.id,
            "label": track.label,
            "size_m": np.asarray(track.size_m).tolist(),
            "times_s": track.times_s.tolist(),
            "world_from_object": [pose_to_json(pose) for pose in track.world_from_object],
        }
        for track in tracks
    )
    return (
        f'{{\n "format": "mudg-tracks",\n "schema_version": {SCHEMA_VERSION},\n "tracks": ['
        + _record_lines(records)
        + "]\n}\n"
    )


def pose_to_json(pose: NDArray[np.float64]) -> list[float]:
    """A pose as 12 numbers, row by row."""
    return [float(number) for number in np.asarray(pose, np.float64)[:3].reshape(-1)]


def _camera_to_json(camera: Camera) -> dict[str, Any]:
    return {
        "width": camera.width,
        "height": camera.height,
        "fx": camera.fx,
        "fy": camera.fy,
        "cx": camera.cx,
        "cy": camera.cy,
        "distortion": list(camera.distortion),
        "readout_s": camera.readout_s,
    }


def _frame_to_json(frame: Frame) -> dict[str, Any]:
    return {
        "id": frame.id,
        "camera": frame.view.camera.name,
        "time_s": float(frame.view.time_s),
        "world_from_cam": pose_to_json(frame.view.world_from_cam),
        "image": frame.image.path,
        "labels": {name: ref.path for name, ref in frame.labels.items()},
    }


def _sweep_to_json(sweep: Sweep) -> dict[str, Any]:
    return {
        "id": sweep.id,
        "sensor": sweep.sensor,
        "time_s": float(sweep.time_s),
        "world_from_lidar": pose_to_json(sweep.world_from_lidar),
        "points": sweep.points.path,
    }


def _record_lines(records: Iterable[dict[str, Any]]) -> str:
    lines = [_dumps(record) for record in records]
    return "\n  " + ",\n  ".join(lines) + "\n " if lines else ""


def _dumps(value: object) -> str:
    try:
        return json.dumps(value, allow_nan=False)
    except ValueError as error:
        raise InputError(
            "a value that is NaN or infinite cannot be written into a scene",
            where="scene.json",
            got=str(error),
            remedy="check poses and times handed to SceneWriter",
        ) from error
    except TypeError as error:
        raise InputError(
            "a value that JSON cannot hold was handed to SceneWriter",
            where="scene.json",
            got=str(error),
            remedy="give plain numbers, texts, lists and dicts in the source recipe",
        ) from error
