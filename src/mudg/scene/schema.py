"""``scene.json`` and ``tracks.json``: what a record may hold, parsing into the types of ``base/types.py``, and the text
written. Every refusal names file, record and field. ``complain`` takes each problem: the reader raises at the first,
``mudg doctor`` collects them all."""

from __future__ import annotations

import json
import re
from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from typing import Annotated, Any, Final, Literal, TypeVar

import numpy as np
from numpy.typing import NDArray
from pydantic import BeforeValidator, Field

from mudg.base import store
from mudg.base.errors import InputError, short
from mudg.base.records import Number, StrictRecord, after, checked_by, named_by, parse_record, place, refuse_unknown
from mudg.base.types import Camera, EgoPath, Frame, Ref, Scene, Shutter, Source, Sweep, Track, View, increasing_problem

FORMAT: Final = "mudg-scene"
TRACKS_FORMAT: Final = "mudg-tracks"
SCHEMA_VERSION: Final = 1
MAX_IMAGE_SIDE_PX: Final = 32768
MAX_BOX_SIDE_M: Final = 200.0

LABEL_NAMES: Final = tuple(
    "depth semantics sky ego dynamic instance semantics_confidence depth_confidence rendered".split()
)
"""Labels a frame may carry; see ``read_label`` for the array each of them is."""

NAME_PATTERN: Final = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.\-+]{0,63}")
"""Names that become folders: cameras, sensors."""

Complain = Callable[[InputError], None]
Parsed = TypeVar("Parsed")


def raise_first(problem: InputError) -> None:
    """The strict reader's answer to a problem."""
    raise problem


def parse_object(data: bytes, where: str) -> dict[str, Any]:
    """Parse one strict JSON object (no NaN, no duplicate keys, an object at the top); InputError names ``where``."""
    parsed = store.parse_json(data, where)
    if not isinstance(parsed, dict):
        got = type(parsed).__name__
        raise InputError("the top of the file is not an object", where=where, expected="{...}", got=got)
    return parsed


# --- fields ---------------------------------------------------------------------------------------


def ref_problem(text: object) -> str | None:
    """Say why ``text`` is no acceptable file reference inside a scene (a relative POSIX path of plain components), or
    return None."""
    if not isinstance(text, str) or not text:
        return "is not a non-empty text"
    parts = text.split("/")
    problems = (
        (len(text) > 400, "is longer than 400 characters"),
        (any(ord(character) < 32 or ord(character) == 127 for character in text), "contains control characters"),
        ("\\" in text, "contains a backslash (references use forward slashes)"),
        (":" in text, "contains a colon (drive letters and streams are not allowed)"),
        (text.startswith("/"), "is absolute (references are relative to the scene)"),
        *((part in ("", ".", ".."), f"contains the component {part!r}") for part in parts),
        *((part.endswith((".", " ")), f"has the component {part!r} that ends in a dot or space") for part in parts),
    )
    return next((words for wrong, words in problems if wrong), None)


def check_ref(value: str) -> str:
    """A file reference inside the scene, else InputError."""
    problem = ref_problem(value)
    if problem is not None:
        expected = "a relative path inside the folder, e.g. images/front/000000.png"
        raise InputError(f"file reference {problem}", expected=expected, got=repr(value)[:120])
    return value


def check_name(value: str, where: str = "") -> str:
    """A camera or sensor name that can be a folder name, else InputError."""
    if not NAME_PATTERN.fullmatch(value) or value.endswith("."):
        expected = "1-64 letters, digits or _ . - + starting with a letter or digit"
        raise InputError("name cannot be a folder name", where=where, expected=expected, got=repr(value)[:80])
    return value


def check_frame_id(frame_id: str, sensor: str, where: str) -> None:
    """A frame's or sweep's id is ``<sensor>/<digits>``, else InputError."""
    name, _, number = frame_id.rpartition("/")
    if name != sensor or not re.fullmatch("[0-9]{1,12}", number):
        expected, got = f"{sensor}/000012", repr(frame_id)[:80]
        raise InputError("frame id does not fit its camera", where=where, expected=expected, got=got)


def check_box_size(size_m: list[float]) -> list[float]:
    """Length, width and height of a box, else InputError."""
    if len(size_m) != 3 or not all(0 < side < MAX_BOX_SIDE_M for side in size_m):
        expected = f"[length, width, height] in metres, each above 0 and below {MAX_BOX_SIDE_M:g}"
        raise InputError("box size makes no sense", expected=expected, got=str(size_m)[:80])
    return size_m


def sixteen_numbers(value: Any) -> list[Any]:
    """A 3x4 or 4x4 matrix, flat or in rows, as 16 values row by row."""
    numbers = value
    if isinstance(value, list) and len(value) in (3, 4) and all(isinstance(row, list) for row in value):
        numbers = [number for row in value for number in row]
    if not isinstance(numbers, list) or len(numbers) not in (12, 16):
        expected = "12 or 16 numbers, row by row (world metres)"
        raise InputError("pose is not a 3x4 or 4x4 matrix", expected=expected, got=short(repr(value), 80))
    return numbers if len(numbers) == 16 else [*numbers, 0.0, 0.0, 0.0, 1.0]


def _known_labels(value: Any) -> Any:
    refuse_unknown(value if isinstance(value, dict) else (), LABEL_NAMES)
    return value


FileRef = Annotated[str, after(check_ref)]
Name = Annotated[str, after(check_name)]
PoseNumbers = Annotated[list[Number], BeforeValidator(checked_by(sixteen_numbers))]
"""A matrix as 16 finite numbers. Whether it is rigid is checked by the type that is made of it."""
BoxSize = Annotated[list[Number], after(check_box_size)]
LabelRefs = Annotated[dict[str, FileRef], BeforeValidator(checked_by(_known_labels))]


def matrices_of(poses: list[list[float]]) -> NDArray[np.float64]:
    """f64[n, 4, 4] from n ``PoseNumbers``."""
    return np.array(poses, np.float64).reshape(len(poses), 4, 4)


# --- records: those in lists and tables are checked one by one -----------------------------------------


class _CameraEntry(StrictRecord):
    width: int
    height: int
    fx: Number
    fy: Number
    cx: Number
    cy: Number
    distortion: list[Number] = []
    readout_s: Number = 0.0
    shutter: Shutter = "global"


class _FrameEntry(StrictRecord):
    id: str
    camera: str
    time_s: Number
    world_from_cam: PoseNumbers
    image: FileRef
    labels: LabelRefs = {}


class _SweepEntry(StrictRecord):
    id: str
    sensor: Name
    time_s: Number
    world_from_lidar: PoseNumbers
    points: FileRef


class _TrackEntry(StrictRecord):
    id: str
    label: str
    size_m: BoxSize
    times_s: list[Number]
    world_from_object: list[PoseNumbers]


class _EgoEntry(StrictRecord):
    times_s: Annotated[list[Number], Field(min_length=1)]
    world_from_ego: list[PoseNumbers]


class _SourceEntry(StrictRecord):
    dataset: str
    licence: str
    recipe: dict[str, Any] | None = None
    notes: list[str] = []


class _SceneIndex(StrictRecord):
    format: str
    schema_version: int
    id: str
    source: _SourceEntry
    cameras: dict[str, Any]
    frames: list[Any]
    ego: _EgoEntry
    sweeps: list[Any] = []
    split: dict[str, Literal["train", "test"]] = {}
    conventions: Any = None


class _TracksIndex(StrictRecord):
    format: str
    schema_version: int
    tracks: list[Any]


def parse_camera(name: str, value: object, where: str) -> Camera:
    """Parse and check one camera; InputError names ``where`` and the field."""
    check_name(name, where)
    record = parse_record(_CameraEntry, value, where)
    width, height, longest = record.width, record.height, max(record.width, record.height)
    focal = "give the focal length in pixels, not millimetres, and not zero"
    cropped = "check units and whether the image was cropped"
    limits = (
        ("width", "image size makes no sense", 1, MAX_IMAGE_SIDE_PX, ""),
        ("height", "image size makes no sense", 1, MAX_IMAGE_SIDE_PX, ""),
        ("fx", "focal length makes no sense", 0.01 * longest, 1000 * longest, focal),
        ("fy", "focal length makes no sense", 0.01 * longest, 1000 * longest, focal),
        ("cx", "principal point lies far outside the image", -width, 2 * width, cropped),
        ("cy", "principal point lies far outside the image", -height, 2 * height, cropped),
        ("readout_s", "rolling-shutter readout makes no sense", 0, 1, ""),
    )
    for key, what, least, most, remedy in limits:
        value = getattr(record, key)
        if not least <= value <= most:
            expected = f"{least:g} to {most:g} {'s' if key == 'readout_s' else 'pixels'}"
            raise InputError(what, where=place(where, key), expected=expected, got=f"{value:g}", remedy=remedy)
    intrinsics = (record.fx, record.fy, record.cx, record.cy)
    return Camera(name, width, height, *intrinsics, tuple(record.distortion), record.readout_s, record.shutter)


def parse_frame(value: object, where: str, cameras: Mapping[str, Camera]) -> Frame:
    """Parse one frame; its camera must be known."""
    record = parse_record(_FrameEntry, value, where)
    camera = cameras.get(record.camera)
    if camera is None:
        what = f"frame names the camera {record.camera!r}, which the scene does not have"
        expected = f"one of {', '.join(cameras)}"
        raise InputError(what, where=place(where, "camera"), expected=expected, got=record.camera)
    check_frame_id(record.id, camera.name, place(where, "id"))
    with named_by(where):
        view = View(camera, matrices_of([record.world_from_cam])[0], record.time_s)
    labels = {name: Ref(record.labels[name]) for name in LABEL_NAMES if name in record.labels}
    return Frame(record.id, view, Ref(record.image), labels)


def parse_sweep(value: object, where: str) -> Sweep:
    """Parse one LiDAR sweep record."""
    record = parse_record(_SweepEntry, value, where)
    pose = matrices_of([record.world_from_lidar])[0]
    with named_by(where):
        return Sweep(record.id, record.sensor, record.time_s, pose, Ref(record.points))


def parse_track(value: object, where: str) -> Track:
    """Parse one tracked box."""
    record = parse_record(_TrackEntry, value, where)
    size_m, times_s = np.array(record.size_m), np.array(record.times_s)
    with named_by(where):
        return Track(record.id, record.label, size_m, times_s, matrices_of(record.world_from_object))


# --- whole files ----------------------------------------------------------------------------------


def parse_scene(
    scene_json: dict[str, Any],
    tracks_json: dict[str, Any] | None,
    root: str,
    where: str,
    complain: Complain = raise_first,
) -> Scene:
    """Build a Scene from the parsed ``scene.json`` and ``tracks.json`` (None when the scene has none). ``root``: where
    the files lie, kept in the Scene. ``where``: path of ``scene.json`` for messages. ``complain``: called with each
    problem; raises in the strict reader. A record with a problem is left out. Raises InputError: the frame of the file
    itself is wrong, or ``complain`` raised."""
    _check_format(scene_json, FORMAT, where)
    top = parse_record(_SceneIndex, scene_json, f"{where}: ")
    if not top.cameras:
        raise InputError("scene has no cameras", where=f"{where}: cameras", expected="at least one camera by name")
    cameras = parse_table(top.cameras, f"{where}: cameras", parse_camera, complain)
    frames = parse_each(top.frames, f"{where}: frames", lambda value, at: parse_frame(value, at, cameras), complain)
    sweeps = parse_each(top.sweeps, f"{where}: sweeps", parse_sweep, complain)
    tracks: list[Track] = []
    if tracks_json is not None:
        where_tracks = where.replace("scene.json", "tracks.json")
        _check_format(tracks_json, TRACKS_FORMAT, where_tracks)
        listed = parse_record(_TracksIndex, tracks_json, f"{where_tracks}: ").tracks
        tracks = parse_each(listed, f"{where_tracks}: tracks", parse_track, complain)
    with named_by(f"{where}: ego"):
        ego = EgoPath(np.array(top.ego.times_s), matrices_of(top.ego.world_from_ego))
    source = Source(top.source.dataset, top.source.licence, top.source.recipe, tuple(top.source.notes))
    split: dict[str, Literal["train", "test"]] = {**dict.fromkeys((f.id for f in frames), "train"), **top.split}
    scene = Scene(top.id, root, cameras, tuple(frames), tuple(sweeps), tuple(tracks), ego, split, source)
    check_relations(scene, where, complain)
    return scene


def parse_each(
    values: Iterable[Any], where: str, parse: Callable[[Any, str], Parsed], complain: Complain
) -> list[Parsed]:
    """Parse the records of a list at ``where``; one with a problem is complained about and left out."""
    parsed = []
    for index, value in enumerate(values):
        try:
            parsed.append(parse(value, f"{where}[{index}]"))
        except InputError as problem:
            complain(problem)
    return parsed


def parse_table(
    table: Mapping[str, Any], where: str, parse: Callable[[str, Any, str], Parsed], complain: Complain
) -> dict[str, Parsed]:
    """Parse named records at ``where``; one with a problem is complained about and left out."""
    parsed = {}
    for name, value in table.items():
        try:
            parsed[name] = parse(name, value, f"{where}.{name}")
        except InputError as problem:
            complain(problem)
    return parsed


def _check_format(top: dict[str, Any], name: str, where: str) -> None:
    found, version = repr(top.get("format"))[:80], repr(top.get("schema_version"))[:80]
    if top.get("format") != name:
        raise InputError(f"this is not a {name} file", where=where, expected=f'"format": "{name}"', got=found)
    if top.get("schema_version") != SCHEMA_VERSION:
        remedy = "ingest the log again with this version, or use the version that wrote it"
        what, where = "schema version is not one this program reads", f"{where}: schema_version"
        raise InputError(what, where=where, expected=str(SCHEMA_VERSION), got=version, remedy=remedy)


def repeated(names: Iterable[str]) -> list[str]:
    """The names that occur more than once, sorted."""
    return sorted(name for name, count in Counter(names).items() if count > 1)


def check_relations(scene: Scene, where: str, complain: Complain = raise_first) -> None:
    """Checks that span records: frames exist, ids are unique, times increase per sensor, the split names real
    frames."""
    if not scene.frames:
        complain(InputError("scene has no frames", where=f"{where}: frames", expected="at least one image"))
    for kind in ("frames", "sweeps", "tracks"):
        if twice := repeated(record.id for record in getattr(scene, kind)):
            got = ", ".join(twice[:5])
            complain(InputError("an id occurs twice", where=f"{where}: {kind}", got=got, expected="unique ids"))
    times_by_sensor: dict[str, list[float]] = {}
    for frame in scene.frames:
        times_by_sensor.setdefault(f"frames of camera {frame.view.camera.name}", []).append(frame.view.time_s)
    for sweep in scene.sweeps:
        times_by_sensor.setdefault(f"sweeps of sensor {sweep.sensor}", []).append(sweep.time_s)
    for sensor, times in times_by_sensor.items():
        problem = increasing_problem(np.array(times))
        if problem is not None:
            what, expected = "times do not increase", "seconds, strictly increasing per sensor"
            at, remedy = f"{where}: {sensor}", "sort the records by time"
            complain(InputError(what, where=at, got=problem, expected=expected, remedy=remedy))
    known = {frame.id for frame in scene.frames}
    if unknown := [frame_id for frame_id in scene.split if frame_id not in known]:
        what, got = "split names frames that the scene does not have", ", ".join(unknown[:5])
        complain(InputError(what, where=f"{where}: split", got=got))


# --- writing --------------------------------------------------------------------------------------


def scene_to_json_text(scene: Scene) -> str:
    """The text of ``scene.json``: one record a line, so that people can read and compare it."""
    source = scene.source
    head: dict[str, Any] = {
        "format": FORMAT,
        "schema_version": SCHEMA_VERSION,
        "id": scene.id,
        "conventions": (
            "metres, seconds, pixels; world z up; camera x right, y down, z forward; a_from_b row-major 3x4; "
            "the centre of the top-left pixel is (0.5, 0.5)"
        ),
        "source": {key: getattr(source, key) for key in ("dataset", "licence", "recipe")}
        | {"notes": list(source.notes)},
    }
    cameras = [f"{json.dumps(name)}: {_dumps(camera_to_json(camera))}" for name, camera in scene.cameras.items()]
    ego = {"times_s": scene.ego.times_s.tolist(), "world_from_ego": _poses_to_json(scene.ego.world_from_ego)}
    sweeps = (
        {"id": one.id, "sensor": one.sensor, "time_s": one.time_s}
        | {"world_from_lidar": _poses_to_json(one.world_from_lidar[None])[0], "points": one.points.path}
        for one in scene.sweeps
    )
    lines = [
        *(f" {json.dumps(key)}: {_dumps(value)}," for key, value in head.items()),
        ' "cameras": {\n  ' + ",\n  ".join(cameras) + "\n },",
        f' "frames": [{_record_lines(map(_frame_to_json, scene.frames))}],',
        f' "sweeps": [{_record_lines(sweeps)}],',
        f' "split": {_dumps(dict(scene.split))},',
        f' "ego": {_dumps(ego)}',
    ]
    return "{\n" + "\n".join(lines) + "\n}\n"


def tracks_to_json_text(tracks: Iterable[Track]) -> str:
    """The text of ``tracks.json``, one track a line."""
    records = []
    for track in tracks:
        record = {"id": track.id, "label": track.label, "size_m": track.size_m.tolist()}
        poses = _poses_to_json(track.world_from_object)
        records.append({**record, "times_s": track.times_s.tolist(), "world_from_object": poses})
    head = f'"format": "{TRACKS_FORMAT}",\n "schema_version": {SCHEMA_VERSION}'
    return f'{{\n {head},\n "tracks": [{_record_lines(records)}]\n}}\n'


def camera_to_json(camera: Camera) -> dict[str, Any]:
    """A camera without its name; ``parse_camera`` reads it."""
    values = {key: getattr(camera, key) for key in ("width", "height", "fx", "fy", "cx", "cy")}
    rolling = {} if camera.shutter == "global" else {"shutter": camera.shutter}
    return {**values, "distortion": list(camera.distortion), "readout_s": camera.readout_s, **rolling}


def _poses_to_json(poses: NDArray[np.float64]) -> list[list[float]]:
    """f64[n, 4, 4] as n times 12 numbers, row by row."""
    return poses[:, :3].reshape(len(poses), 12).tolist()


def _frame_to_json(frame: Frame) -> dict[str, Any]:
    view = frame.view
    return {
        "id": frame.id,
        "camera": view.camera.name,
        "time_s": view.time_s,
        "world_from_cam": _poses_to_json(view.world_from_cam[None])[0],
        "image": frame.image.path,
        "labels": {name: ref.path for name, ref in frame.labels.items()},
    }


def _record_lines(records: Iterable[dict[str, Any]]) -> str:
    lines = [_dumps(record) for record in records]
    return "\n  " + ",\n  ".join(lines) + "\n " if lines else ""


def _dumps(value: object) -> str:
    try:
        return json.dumps(value, allow_nan=False)
    except (ValueError, TypeError) as error:
        what, remedy = "a value that is NaN or infinite cannot be written into a scene", "check poses and times"
        if isinstance(error, TypeError):
            what, remedy = "a value that JSON cannot hold", "give plain numbers, texts, lists and dicts in the recipe"
        raise InputError(what, where="scene.json", got=str(error), remedy=remedy) from error
