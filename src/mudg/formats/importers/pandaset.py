"""PandaSet importer: one sequence folder (``001``, ``002``, ...) of 80 frames at 10 Hz. What is read, and how its
times, poses and boxes are understood: docs/formats/pandaset.md, docs/reference/formats.md. The tables are read by
``pandas_frame``, which runs nothing of these pickles and needs no pandas."""

from __future__ import annotations

import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from mudg.base import palette, store
from mudg.base.errors import InputError
from mudg.base.geometry import from_rotation_translation, invert, transform_points, yaw_matrix
from mudg.base.plain_pickle import MAX_BYTES, NUMPY_MAKERS, Array, Maker, Name, PickledObject, read_pickle
from mudg.base.records import understood
from mudg.base.types import Camera, EgoPath, Scene, Source, SweepPoints
from mudg.formats.importers import common
from mudg.formats.importers.common import ImportOptions, LogFiles, name_table
from mudg.formats.importers.drive_log import BoxTracks, SceneContent, SceneImage, SceneSweep, Tracks, write_scene
from mudg.formats.importers.images import ImageFit, fit_images, image_notes, image_size
from mudg.formats.unknown_fields import known, note_unknown, note_unknown_within

# pandas frame -------------------------------------------------------------------------------------
#
# Tables that pandas pickled, read as columns of numpy arrays without pandas and without running the pickle.
#
# The forms of pandas 0.2x to 1.2 (which the data set has) and 2.x are understood: a data frame is a manager of blocks,
# each block an array of several columns and the places of these columns. Extension types are refused by name.
_MANAGERS: Final = ("pandas.core.internals.managers.BlockManager", "pandas.core.internals.BlockManager")
MAX_COLUMNS: Final = 1000


def _new_index(kind: Any, entries: Any) -> NDArray[Any] | range:
    if not isinstance(kind, Name) or not isinstance(entries, dict):
        raise ValueError("an index of unknown form")
    if kind.text.endswith("RangeIndex"):
        return range(entries["start"], entries["stop"], entries["step"])
    return _array(entries["data"])


def _slice(start: Any, stop: Any, step: Any) -> slice:
    if not all(part is None or isinstance(part, int) for part in (start, stop, step)):
        raise ValueError("a slice that is not of whole numbers")
    return slice(start, stop, step)


_MAKERS: Final[Mapping[str, Maker | None]] = {
    **NUMPY_MAKERS,
    "pandas.core.frame.DataFrame": None,
    **dict.fromkeys(_MANAGERS),
    "pandas.core.indexes.base._new_Index": _new_index,
    "pandas.core.indexes.base.Index": None,
    **dict.fromkeys(f"pandas.core.indexes.numeric.{kind}Index" for kind in ("Int64", "UInt64", "Float64")),
    "pandas.core.indexes.range.RangeIndex": None,
    "pandas._libs.internals._unpickle_block": lambda values, places, _dimensions: (values, places),
    "builtins.slice": _slice,
}


def read_frame(path: Path) -> dict[str, NDArray[Any]]:
    """Columns of a pickled data frame, gzipped or not, by their names. Raises InputError: missing, cut off, not a data
    frame, or it asks for something that is not plain data."""
    content = store.read_bytes(path)
    return parse_frame(gunzip(content, str(path)) if content[:2] == b"\x1f\x8b" else content, str(path))


def gunzip(content: bytes, where: str) -> bytes:
    """Unpack gzip, not beyond ``MAX_BYTES``. Raises InputError: cut off, damaged, or larger than that."""
    return common.unpacked(zlib.decompressobj(wbits=31), content, MAX_BYTES, "gzip file", where)


def parse_frame(content: bytes, where: str) -> dict[str, NDArray[Any]]:
    """Columns of a pickled data frame; see ``read_frame``."""
    value = read_pickle(content, where, _MAKERS)
    try:
        return _columns_pandas_frame(value)
    except (ValueError, IndexError, KeyError, TypeError, AttributeError, OverflowError, RecursionError) as error:
        what, got = "pickle is not a plain data frame", f"{type(error).__name__}: {error}"[:200]
        expected = "a table of numbers and texts as pandas 0.2x to 1.2 or 2.x writes it"
        remedy = "read it with pandas yourself and write it again with DataFrame.to_pickle of pandas 2"
        raise InputError(what, where=where, expected=expected, got=got, remedy=remedy) from error


def _columns_pandas_frame(frame: Any) -> dict[str, NDArray[Any]]:
    if not isinstance(frame, PickledObject) or frame.name != "pandas.core.frame.DataFrame":
        raise ValueError(f"holds a {getattr(frame, 'name', type(frame).__name__)}")
    manager = frame.state["_mgr"] if "_mgr" in frame.state else frame.state["_data"]
    if manager.name not in _MANAGERS:
        raise ValueError(f"holds a {manager.name}")
    if manager.arguments:
        parts, axes = manager.arguments
    else:
        extra = manager.state[3]["0.14.1"]
        axes, parts = extra["axes"], [(block["values"], block["mgr_locs"]) for block in extra["blocks"]]
    if len(axes[0]) > MAX_COLUMNS:
        raise ValueError(f"a table of {len(axes[0])} columns")
    names, rows = [str(name) for name in axes[0]], len(axes[1])
    columns: dict[str, NDArray[Any]] = {}
    for values, places in parts:
        array = _array(values)
        chosen = np.arange(len(names))[places if isinstance(places, slice) else _array(places)]
        if array.shape != (len(chosen), rows):
            raise ValueError(f"a block of shape {array.shape} for {len(chosen)} columns and {rows} rows")
        for place, column in zip(chosen, array, strict=True):
            columns[names[place]] = column
    if len(columns) != len(names):
        raise ValueError(f"{len(columns)} of {len(names)} columns are there")
    return {name: columns[name] for name in names}


def _array(value: Any) -> NDArray[Any]:
    if isinstance(value, np.ndarray):
        return value
    if not isinstance(value, Array) or value.value is None:
        raise ValueError(f"a column is a {getattr(value, 'name', type(value).__name__)}, not a plain array")
    return value.value


# classes that people gave to PandaSet's points: ``annotations/semseg`` -> train ids of ``base/palette.py`` ------------
CLASS_OF: Final[dict[str, str]] = name_table(
    """vegetation: Vegetation; terrain: Ground; road: Road, Lane Line Marking, Stop Line Marking, Other Road Marking;
    sidewalk: Sidewalk; car: Car; truck: Pickup Truck, Medium-sized Truck, Semi-truck,
        Other Vehicle - Construction Vehicle;
    motorcycle: Motorcycle, Motorized Scooter; bus: Bus; bicycle: Bicycle; train: Train, Trolley, Tram / Subway;
    person: Pedestrian, Pedestrian with Object; traffic sign: Signs, Construction Signs; building: Building;
    : Smoke, Exhaust, Spray or rain, Reflection, Driveway, Towed Object, Other Vehicle - Uncommon,
        Other Vehicle - Pedicab, Emergency Vehicle, Personal Mobility Device, Animals - Bird, Animals - Other, Pylons,
        Cones, Rolling Containers, Road Barriers, Temporary Construction Barriers, Other Static Object"""
)
"""The data set's classes -> classes of ``palette.CLASSES``; empty = unlabelled: none fits (smoke, ghosts, trailers), or
several would (driveways are labelled either way; emergency vehicles are cars and trucks; barriers are walls, fences and
guard rails). Ground is unpaved. Pickup trucks are trucks by definition of Cityscapes, as their boxes here."""


PointClasses = Callable[[int, int], NDArray[np.uint8] | None]


def _point_classes(folder: Path, frames: Sequence[int], options: ImportOptions, notes: list[str]) -> PointClasses:
    """The class tables of the chosen frames in ``annotations/semseg``, as a function of a frame's number and of how
    many points its cloud has: train ids u8[points], 255 where unlabelled; None for a frame without a table."""
    files = _tables(folder, frames, options, "classes of points")
    names = _class_names(folder / "classes.json") if files else {}
    if unknown := sorted(set(names.values()) - set(CLASS_OF)):
        notes.append(f"classes of points that are not known here are unlabelled: {', '.join(unknown[:8])}")
    ids = {number: palette.ID.get(CLASS_OF.get(name, ""), palette.UNLABELLED) for number, name in names.items()}

    def classes(frame: int, points: int) -> NDArray[np.uint8] | None:
        if frame not in files:
            return None
        path, expected = files[frame], f"{points} rows, one for each point of the frame's cloud"
        numbers = common.finite_columns(_columns(path, ("class",), _CLASSES), ("class",), path)[:, 0].astype(np.int64)
        if len(numbers) != points:
            what, remedy = "classes do not fit the points", "is the file of another frame or sequence?"
            got = f"{len(numbers)} rows"
            raise InputError(what, where=f"{path}: class", got=got, expected=expected, remedy=remedy)
        present, where = np.unique(numbers, return_inverse=True)
        return np.array([ids.get(int(number), palette.UNLABELLED) for number in present], np.uint8)[where]

    return classes


def _tables(folder: Path, frames: Sequence[int], options: ImportOptions, what: str) -> dict[int, Path]:
    """Tables by frame number; none at all is allowed, gaps are not."""
    tables = common.numbered_files(folder, (".pkl.gz", ".pkl"))
    lacks = [number for number in frames if number not in tables]
    if tables and lacks and not options.skip_missing:
        remedy = "copy it, choose frames with --frames FIRST:END, or add --skip-missing"
        expected = f"{lacks[0]:02d}.pkl.gz"
        raise InputError(f"a frame has no {what}", where=str(folder), expected=expected, remedy=remedy)
    return tables


def _class_names(path: Path) -> Mapping[int, str]:
    """Number -> name of the data set's classes."""
    where, expected = str(path), '{"1": "Smoke", ...}'
    if not path.is_file():
        remedy = "copy annotations/semseg/classes.json, or leave out annotations/semseg"
        raise InputError("table of class names is missing", where=where, expected=expected, remedy=remedy)
    values: Any = store.read_json(path)
    if not isinstance(values, dict) or not all(str(key).isdigit() and isinstance(values[key], str) for key in values):
        raise InputError("table of class names is malformed", where=where, expected=expected, got=str(values)[:80])
    return {int(key): name for key, name in values.items()}


# importer -----------------------------------------------------------------------------------------
Matrix = NDArray[np.float64]
LICENCE: Final = "CC BY 4.0 (PandaSet: Hesai and Scale AI; attribution)"
CAMERAS: Final = name_table(
    """front: front_camera; front_left: front_left_camera; front_right: front_right_camera; left: left_camera;
    right: right_camera; back: back_camera"""
)
SENSORS: Final = {0: "pandar64", 1: "pandar_gt"}
OFFSET_FROM_FRONT_CAMERA_M: Final = {0: (-0.044, 0.0, 0.039), 1: (0.562, 0.0, -0.263)}
"""Places of the LiDARs from the front camera's centre: forward, left, up. Source: the data set's static calibration."""
LABELS: Final = name_table(
    """car: Car; truck: Pickup Truck, Medium-sized Truck, Semi-truck; trailer: Towed Object;
    motorcycle: Motorcycle, Motorized Scooter; bicycle: Bicycle; bus: Bus; train: Train;
    tram: Trolley, Tram / Subway;
    vehicle: Emergency Vehicle, Other Vehicle - Construction Vehicle, Other Vehicle - Uncommon;
    pedestrian: Pedestrian, Pedestrian with Object; personal_mobility_device: Personal Mobility Device;
    pedicab: Other Vehicle - Pedicab; animal: Animals - Bird, Animals - Other; pylon: Pylons;
    barrier: Road Barriers, Temporary Construction Barriers; traffic_cone: Cones;
    sign: Signs, Construction Signs; container: Rolling Containers"""
)
"""The data set's classes -> labels; pickup trucks count as trucks, as in Cityscapes."""
EXPOSURE_S: Final = -0.01
"""When an image was taken, from its time stamp on, by the places of moving cars in the images of three cameras."""
POSE_S: Final = -0.02
"""Where on the vehicle's path the camera's pose is taken, from its time stamp on, by standing points in the images of
five cameras."""
MAX_POINT_DELAY_S: Final = 0.25
MAX_CAMERA_DELAY_S: Final = 1.0
_MIN_BOX_POINTS: Final = 5
_POINT_COLUMNS: Final = ("x", "y", "z", "i", "t", "d")
_CUBOID_COLUMNS: Final = tuple(
    "uuid label yaw stationary position.x position.y position.z dimensions.x dimensions.y dimensions.z".split()
)
_POINTS, _CUBOIDS, _CLASSES = "lidar/*.pkl.gz", "annotations/cuboids/*.pkl.gz", "annotations/semseg/*.pkl.gz"
OFFICIAL: Final[Mapping[str, frozenset[str]]] = {
    _POINTS: frozenset(_POINT_COLUMNS),
    _CUBOIDS: frozenset((*_CUBOID_COLUMNS, "camera_used", "cuboids.sibling_id", "cuboids.sensor_id")).union(
        f"attributes.{name}" for name in ("object_motion", "rider_status", "pedestrian_behavior", "pedestrian_age")
    ),
    _CLASSES: frozenset({"class"}),
    "intrinsics.json": frozenset({"fx", "fy", "cx", "cy"}),
}
"""Kinds of files -> their fields, read or not."""
_POSE_FIELDS: Final = known("", heading=known("w x y z"), position=known("x y z"))


Cuboid = tuple[int, str, dict[str, Any]]
"""LiDAR of a box (-1: none), its sibling or an empty text, and what ``BoxTracks.add`` wants to know."""


def looks_like_pandaset(source: Path) -> bool:
    """Whether ``source`` is a sequence of PandaSet, or a folder of such sequences."""
    return _is_sequence(source) or bool(_sequences(source))


def _is_sequence(folder: Path) -> bool:
    return (folder / "lidar" / "poses.json").is_file() and any((folder / "camera" / name).is_dir() for name in CAMERAS)


def _sequences(source: Path) -> dict[str, Path]:
    folders = sorted(source.iterdir()) if source.is_dir() else ()
    return {folder.name: folder for folder in folders if folder.name.isdigit() and _is_sequence(folder)}


def import_pandaset(source: Path, out: Path, options: ImportOptions) -> Scene:
    """Import a sequence's folder, or the one that ``options.sequence`` names; ``cameras`` default to all six."""
    common.refuse_options(options, "PandaSet", "poses", "boxes", "untwist")
    folder = _chosen_sequence(source, options)
    cameras = {name: CAMERAS[name] for name in CAMERAS if (folder / "camera" / name).is_dir()}
    chosen = common.chosen_cameras(cameras, options, str(folder), tuple(CAMERAS))
    images = {name: common.numbered_files(folder / "camera" / name, (".jpg", ".jpeg", ".png")) for name in chosen}
    clouds = common.numbered_files(folder / "lidar", (".pkl.gz", ".pkl"))
    frames = common.complete_frames({**images, "lidar": clouds}, options, str(folder), "pandaset")
    notes: list[str] = []
    motion = _Motion(folder, frames, chosen, options, notes)
    fits = {cameras[n]: _fit(folder / "camera" / n, cameras[n], images[n][frames[0]], options) for n in chosen}
    cuboids = _tables(folder / "annotations" / "cuboids", frames, options, "boxes")
    notes.append(f"source frames {frames[0]} to {frames[-1]} are frames 0 to {len(frames) - 1} here")
    notes += image_notes(fits)
    classes = _point_classes(folder / "annotations" / "semseg", frames, options, notes)
    if not cuboids:
        notes.append("no boxes found: everything counts as static")
    boxes: dict[int, list[Cuboid]] = {}
    images_s: dict[float, tuple[float, float]] = {}

    def convert(index: int) -> Iterator[SceneImage | SceneSweep]:
        number = frames[index]
        for name in chosen:
            time_s, pose = float(motion.camera_s[name][index]), motion.world_from_cam[name][index]
            yield SceneImage(cameras[name], index, time_s, pose, images[name][number])
        cloud = _Cloud(clouds[number], motion, index)
        train_ids = classes(number, len(cloud.returns))
        train_ids = None if train_ids is None else train_ids[cloud.returns]
        for d, sensor in SENSORS.items():
            if d == 0 or (cloud.d == d).any():
                pose = motion.world_from_lidar(d, cloud.time_s)
                sweep = cloud.of_sensor(d, invert(pose) @ motion.world_from_source, train_ids)
                yield SceneSweep(sensor, index, cloud.time_s, pose, sweep, str(clouds[number]))
        taken_s = [float(motion.camera_s[name][index]) for name in chosen]
        images_s[cloud.time_s] = min(taken_s), max(taken_s)
        if number in cuboids:
            boxes[index] = _read_cuboids(cuboids[number], cloud, motion)

    def tracks() -> Tracks:
        collected = BoxTracks(str(folder / "annotations" / "cuboids"), LABELS)
        box_notes = _add_boxes(collected, boxes)
        result, track_notes = collected.tracks(images_s=images_s)
        return result, [*box_notes, *track_notes]

    origin, name = Source("pandaset", LICENCE, None, tuple(notes)), folder.resolve().name
    path, numbers = motion.ego(), range(len(frames))
    content = SceneContent(name, origin, fits, numbers, convert, lambda n: f"frame {frames[n]}", path, tracks)
    return write_scene(content, out, options)


def _chosen_sequence(source: Path, options: ImportOptions) -> Path:
    if not options.sequence and _is_sequence(source):
        return source
    expected = "lidar/poses.json and camera/front_camera and so on, here or in numbered folders"
    return common.the_only(_sequences(source), options, source, "PandaSet sequence", expected)


def files_of_pandaset(source: Path, options: ImportOptions) -> LogFiles:
    """The chosen sequence's folder."""
    return LogFiles((_chosen_sequence(source, options),))


# --- poses and times ------------------------------------------------------------------------------


class _Motion:
    """Times and poses, in the scene's world and clock.

    ``world_from_source``: the scene's world from the data set's, f64[4, 4]. ``raw_s``: the data set's time of each
    chosen frame's cloud, ``start_s``: the one that is 0 in the scene. ``path``: the vehicle, x forward, y left, z up,
    at the clouds' times from one before the first chosen frame on. By camera: ``camera_s`` f64[n], when its images
    were taken, and ``world_from_cam`` f64[n, 4, 4]."""

    def __init__(
        self, folder: Path, frames: Sequence[int], cameras: Sequence[str], options: ImportOptions, notes: list[str]
    ) -> None:
        file = folder / "lidar" / "timestamps.json"
        # those of frames that are left out tell where the vehicle was, too
        known = range(max(frames[0] - 1, 0), frames[-1] + 1)
        first = frames[0] - known[0]
        raw_s = _times(file, known)
        self.start_s = float(raw_s[first])
        forward = _poses(folder / "lidar" / "poses.json", known) @ yaw_matrix(np.pi / 2)
        self.world_from_source = common.world_from_first(forward[first])
        notes.append(common.origin_note(forward[first]))
        path = EgoPath(common.seconds(raw_s, "s", str(file), self.start_s), self.world_from_source @ forward)
        self.path = common.mended_path(path, notes)
        self.raw_s = raw_s[[number - known[0] for number in frames]]
        self.camera_s: dict[str, NDArray[np.float64]] = {}
        self.world_from_cam: dict[str, Matrix] = {}
        for name in dict.fromkeys((*cameras, "front_camera")):
            here = folder / "camera" / name
            stamps = here / "timestamps.json"
            times = _times(stamps, frames)
            late = np.abs(times - self.raw_s)
            if late.max() > MAX_CAMERA_DELAY_S:
                what, where = "camera and LiDAR do not share a clock", f"{stamps}: entry {frames[int(late.argmax())]}"
                expected = f"within {MAX_CAMERA_DELAY_S:g} s of lidar/timestamps.json"
                remedy = "are the times in seconds, and of this sequence?"
                raise InputError(what, where=where, expected=expected, got=f"{late.max():.3f} s apart", remedy=remedy)
            stamped_s = common.seconds(times, "s", str(stamps), self.start_s)
            self.camera_s[name] = stamped_s + EXPOSURE_S
            timed = zip(stamped_s, self.world_from_source @ _poses(here / "poses.json", frames), strict=True)
            self.world_from_cam[name] = np.stack(
                [self.ego_at(t + POSE_S) @ invert(self.ego_at(t)) @ p for t, p in timed]
            )
        # places of the LiDARs on the vehicle: where the front camera is, plus the static calibration
        front_s = self.camera_s["front_camera"] - EXPOSURE_S + POSE_S
        timed = zip(front_s, self.world_from_cam["front_camera"], strict=True)
        seen = [transform_points(invert(self.ego_at(t)), pose[None, :3, 3])[0] for t, pose in timed]
        camera = np.median(seen, axis=0)
        self._places = {d: camera + np.array(offset) for d, offset in OFFSET_FROM_FRONT_CAMERA_M.items()}

    def ego_at(self, time_s: float) -> Matrix:
        """The vehicle's pose f64[4, 4]; beyond an end of the path it goes on as it did there."""
        return common.pose_near(self.path, time_s, MAX_CAMERA_DELAY_S + abs(POSE_S), "lidar/poses.json")

    def world_from_lidar(self, d: int, time_s: float) -> Matrix:
        """Pose of a LiDAR, f64[4, 4]."""
        return self.ego_at(time_s) @ from_rotation_translation(np.eye(3), self._places[d])

    def ego(self) -> EgoPath:
        """The vehicle's path from its pose before the first image on; where there is none before, it starts with the
        image."""
        first_s = min(float(times[0]) for times in self.camera_s.values())
        times_s, poses = self.path.times_s, self.path.world_from_ego
        if first_s < times_s[0] - 1e-3:
            poses = np.concatenate([self.ego_at(first_s)[None], poses])
            times_s = np.concatenate([[first_s], times_s])
        return EgoPath(times_s, poses)


def _entries(path: Path, frames: Sequence[int]) -> list[Any]:
    """The entries of a JSON list that belong to ``frames``."""
    values = store.read_json(path)
    if not isinstance(values, list) or len(values) <= frames[-1]:
        got = f"{len(values)} entries" if isinstance(values, list) else type(values).__name__
        expected = f"a list with an entry per frame, at least {frames[-1] + 1}"
        remedy = "is the file cut off, or of another sequence?"
        raise InputError("list does not cover the frames", where=str(path), got=got, expected=expected, remedy=remedy)
    return [values[n] for n in frames]


def _times(path: Path, frames: Sequence[int]) -> NDArray[np.float64]:
    values = _entries(path, frames)
    if not all(isinstance(value, int | float) and not isinstance(value, bool) for value in values):
        raise InputError("timestamps are not numbers", where=str(path), got=str(values)[:80])
    times = np.array(values, np.float64)
    common.seconds(times, "s", str(path))
    common.check_epoch(times, 1, str(path))
    return times


def _poses(path: Path, frames: Sequence[int]) -> Matrix:
    poses = []
    for number, entry in zip(frames, _entries(path, frames), strict=True):
        where = f"{path}: entry {number}"
        with understood("a pose: position x y z (metres) and heading w x y z (quaternion)", where):
            heading = [entry["heading"][key] for key in "wxyz"]
            poses.append(common.pose_from_quaternion(heading, [entry["position"][key] for key in "xyz"], where))
        note_unknown_within(path.name, entry, _POSE_FIELDS)
    return np.stack(poses)


def _fit(folder: Path, name: str, image: Path, options: ImportOptions) -> ImageFit:
    path = folder / "intrinsics.json"
    values = store.read_json(path)
    with understood("intrinsics: fx fy cx cy", str(path)):
        fx, fy, cx, cy = (float(values[key]) for key in ("fx", "fy", "cx", "cy"))
        note_unknown(path.name, values, OFFICIAL[path.name])
    # the data set counts pixels from the centre of the top-left one, as OpenCV does
    return fit_images(Camera(name, *image_size(image), fx, fy, cx + 0.5, cy + 0.5), options)


# --- points ---------------------------------------------------------------------------------------


def _columns(path: Path, names: Sequence[str], kind: str) -> dict[str, NDArray[Any]]:
    frame = read_frame(path)
    common.require_columns(names, frame, path)
    note_unknown(kind, frame, OFFICIAL[kind])
    return frame


class _Cloud:
    """One cloud: ``xyz`` f64[N, 3] in the data set's world, ``intensity`` 0..1, ``dt_s`` seconds from ``time_s`` (of
    the scene's clock, the middle of the turn), ``d`` 0 or 1. Rows of the file without a return, where ``returns``
    bool[M] is False, are left out and counted."""

    def __init__(self, path: Path, motion: _Motion, index: int) -> None:
        frame_s = float(motion.raw_s[index])
        frame = _columns(path, _POINT_COLUMNS, _POINTS)
        self.returns = common.returns_of(frame, path)
        self._without = {d: int((frame["d"][~self.returns] == d).sum()) for d in SENSORS}
        frame = {name: values[self.returns] for name, values in frame.items()}
        columns = {name: common.finite_columns(frame, (name,), path)[:, 0] for name in _POINT_COLUMNS}
        late_s, self.d = columns["t"] - frame_s, columns["d"]
        if len(late_s) and np.abs(late_s).max() > MAX_POINT_DELAY_S:
            what = "points do not belong to their frame's time"
            expected = f"seconds of the epoch within {MAX_POINT_DELAY_S:g} s of lidar/timestamps.json ({frame_s:.3f})"
            got = f"{columns['t'].min():.6g} to {columns['t'].max():.6g}"
            remedy = "is the file of another frame or sequence?"
            raise InputError(what, where=f"{path}: t", expected=expected, got=got, remedy=remedy)
        if not np.isin(self.d, list(SENSORS)).all():
            raise InputError("a point is of a LiDAR that does not exist", where=f"{path}: d", expected="0 or 1")
        turning = late_s[self.d == 0]
        middle_s = float(turning.min() + turning.max()) / 2 if len(turning) else 0.0
        self.time_s, self._dt_s = frame_s - motion.start_s + middle_s, late_s - middle_s
        self._xyz = np.stack([columns[axis] for axis in "xyz"], 1)
        self._intensity = common.unit_intensity(columns["i"], 255, f"{path}: i")
        self._place = (invert(motion.world_from_source) @ motion.world_from_lidar(0, self.time_s))[:2, 3]
        self._azimuths: tuple[NDArray[np.intp], NDArray[np.float64]] | None = None

    def of_sensor(self, d: int, lidar_from_source: Matrix, classes: NDArray[np.uint8] | None) -> SweepPoints:
        """The points of LiDAR ``d`` in its frame."""
        mine = self.d == d
        xyz = transform_points(lidar_from_source, self._xyz[mine]).astype(np.float32)
        intensity, dt_s = (values[mine].astype(np.float32) for values in (self._intensity, self._dt_s))
        return SweepPoints(xyz, intensity, dt_s, None if classes is None else classes[mine], self._without[d])

    def delay_s(self, source_from_box: Matrix, size_m: tuple[float, float, float], sensor: int) -> float:
        """When a box was measured, seconds from the sweep's time: the median of the points inside; with few of them,
        of those of the turning LiDAR within a degree of its direction."""
        centre, reach = source_from_box[:3, 3], float(np.linalg.norm(size_m)) / 2
        near = (np.abs(self._xyz[:, :2] - centre[:2]) < reach).all(1) & (self.d == max(sensor, 0))
        near = np.flatnonzero(near)
        inside = np.abs(transform_points(invert(source_from_box), self._xyz[near])) < np.array(size_m) / 2
        near = near[inside.all(1)]
        if len(near) < _MIN_BOX_POINTS:
            if self._azimuths is None:
                ids = np.flatnonzero(self.d == 0)
                seen = self._xyz[ids, :2] - self._place
                self._azimuths = ids, np.arctan2(seen[:, 1], seen[:, 0])
            ids, azimuth = self._azimuths
            turn = azimuth - np.arctan2(centre[1] - self._place[1], centre[0] - self._place[0])
            near = ids[np.abs((turn + np.pi) % (2 * np.pi) - np.pi) < np.deg2rad(1.0)]
        return float(np.median(self._dt_s[near])) if len(near) else 0.0


# --- boxes ----------------------------------------------------------------------------------------


def _read_cuboids(path: Path, cloud: _Cloud, motion: _Motion) -> list[Cuboid]:
    frame = _columns(path, _CUBOID_COLUMNS, _CUBOIDS)
    centre = common.finite_columns(frame, ("position.x", "position.y", "position.z"), path)
    length_width_height = ("dimensions.y", "dimensions.x", "dimensions.z")
    sizes = common.finite_columns(frame, length_width_height, path).tolist()
    yaw = common.finite_columns(frame, ("yaw",), path)[:, 0]
    ids = frame.get("cuboids.sensor_id", np.full(len(yaw), -1))
    ids = np.where(np.array([one is None or one != one for one in ids], bool), -1, ids)
    sensors = common.finite_columns({"cuboids.sensor_id": ids}, ("cuboids.sensor_id",), path)[:, 0].astype(int)
    siblings = frame.get("cuboids.sibling_id", np.full(len(yaw), "", object))
    rows = []
    for row, sibling in enumerate(siblings):
        box, sensor, size = yaw_matrix(yaw[row] + np.pi / 2, centre[row]), int(sensors[row]), tuple(sizes[row])
        standing = bool(frame["stationary"][row])
        about = {"track": str(frame["uuid"][row]), "label": str(frame["label"][row]), "time_s": cloud.time_s}
        about |= {"size_m": size, "world_from_box": motion.world_from_source @ box, "standing": standing}
        about["late_s"] = 0.0 if standing else cloud.delay_s(box, size, sensor)
        rows.append((sensor, sibling if isinstance(sibling, str) and len(sibling) > 1 else "", about))
    return rows


def _add_boxes(tracks: BoxTracks, boxes: Mapping[int, Sequence[Cuboid]]) -> list[str]:
    """Give the boxes to their tracks, siblings to one; returns notes."""
    one_of: dict[str, str] = {}
    for sensor, sibling, about in (box for index in sorted(boxes) for box in boxes[index]):
        if sibling and sensor in (0, 1):
            turning, solid = (about["track"], sibling) if sensor == 0 else (sibling, about["track"])
            one_of.setdefault(solid, turning)
    doubled = 0
    for index in sorted(boxes):
        kept: dict[str, dict[str, Any]] = {}
        for _, _, about in sorted(boxes[index], key=lambda box: box[0] == 1):
            uuid: str = about["track"]
            name = one_of.get(uuid, uuid)
            doubled += name in kept
            kept.setdefault(name, about)
        for name, about in kept.items():
            tracks.add(**{**about, "track": name, "label": tracks.label_of(about["label"])})
    return [f"{doubled} boxes are second boxes of an object for the other LiDAR and were left out"] if doubled else []
