"""The one writer of imported scenes: every importer ends in ``write_scene``. Formats whose sensors run on their own
clocks fill a ``DriveLog``, whose frame n is the n-th image of its first camera and what was recorded nearest to it.
"""

from __future__ import annotations

import itertools
from array import array
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Final, Generic, Literal, TypeVar

import numpy as np
from numpy.typing import NDArray

from mudg.base import log, types
from mudg.base.errors import InputError, UsageError
from mudg.base.geometry import (
    from_rotation_translation,
    invert,
    matrix_from_quaternion,
    quaternion_from_matrix,
    slerp,
    transform_points,
)
from mudg.base.types import Camera, EgoPath, Scene, Source, SweepPoints, Track, View, foreign_name
from mudg.formats.importers import common
from mudg.formats.importers.common import ImportOptions
from mudg.formats.importers.images import ImageFit, Lens, fit_images, image_notes
from mudg.scene import motion
from mudg.scene.clouds import at_sensor
from mudg.scene.write import SceneWriter

Matrix = NDArray[np.float64]
Item = TypeVar("Item")
Tracks = tuple[Sequence[Track], Sequence[str]]
"""Tracks, and notes about them."""

_EGO_MARGIN_S: Final = 0.6


# --- any scene ------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, eq=False)
class SceneImage:
    """One image on its way into a scene, as ``<camera>/<number>``, at a time of the scene's clock. ``where``: for
    errors; empty = the path. ``labels``: see ``SceneWriter.add_label``; in the scene's size. Images of one ``moment``
    (None = the number) are held out together."""

    camera: str
    number: int
    time_s: float
    world_from_cam: Matrix
    image: Path | bytes
    where: str = ""
    labels: Mapping[str, NDArray[Any]] = field(default_factory=dict)
    moment: int | None = None


@dataclass(frozen=True, slots=True, eq=False)
class SceneSweep:
    """One LiDAR sweep on its way into a scene; as ``SceneImage``. ``where`` names it when it has no points."""

    sensor: str
    number: int
    time_s: float
    world_from_lidar: Matrix
    points: SweepPoints
    where: str = ""


@dataclass(frozen=True, slots=True, eq=False)
class SceneContent(Generic[Item]):
    """A scene that is ready to be written. Tracks and ``ego`` are in its world and clock.

    ``name``: the scene's id. ``source``: its notes are logged. ``fits``: by the cameras' scene names, in the order of
    the scene. ``items``: what is converted one by one; may be a generator (``total`` says how many then). ``convert``:
    an item to its images and sweeps; called from several threads if ``workers`` > 1. ``item_name``: put before the
    place of an error. ``tracks``: called after the last item: tracks, and notes about them."""

    name: str
    source: Source
    fits: Mapping[str, ImageFit]
    items: Iterable[Item]
    convert: Callable[[Item], Iterable[SceneImage | SceneSweep]]
    item_name: Callable[[Item], str]
    ego: EgoPath
    tracks: Callable[[], Tracks] = lambda: ((), ())
    total: int | None = None


def write_scene(content: SceneContent[Item], out: Path, options: ImportOptions) -> Scene:
    """Write a scene at ``out``. Points at a sensor's own place are left out, and headings of boxes that flip by 180
    degrees turned back; the scene's notes count both. At most two items per worker are in memory, beside the few that
    wait for the disk. Raises InputError: an item is missing or damaged, or what is written contradicts itself. Nothing
    is left at ``out``."""
    dataset = content.source.dataset
    types.foreign_name(content.name, f"{dataset}: name of the log")
    moments: list[tuple[int, str]] = []
    lost: dict[str, list[tuple[int, int]]] = {}
    """Sensor -> rows without a return, and all rows, of its sweeps."""

    def convert(item: Item) -> None:
        for part in content.convert(item):
            if isinstance(part, SceneSweep):
                sweep_id, points = f"{part.sensor}/{part.number:06d}", part.points
                zeros = at_sensor(points, part.time_s, part.world_from_lidar, content.ego)
                if zeros.any():
                    classes = None if points.classes is None else points.classes[~zeros]
                    xyz, intensity, dt_s = (values[~zeros] for values in (points.xyz, points.intensity, points.dt_s))
                    points = SweepPoints(xyz, intensity, dt_s, classes, points.no_returns + int(zeros.sum()))
                lost.setdefault(part.sensor, []).append((points.no_returns, points.no_returns + len(points.xyz)))
                if len(points.xyz) == 0:
                    log.warn(f"{dataset}: {part.where or sweep_id} has no points")
                writer.add_sweep(sweep_id, part.sensor, part.time_s, part.world_from_lidar, points)
                continue
            fit, frame_id = content.fits[part.camera], f"{part.camera}/{part.number:06d}"
            image = fit.image(part.image, part.where)
            writer.add_frame(frame_id, View(fit.camera, part.world_from_cam, part.time_s), image, part.labels)
            moments.append((part.number if part.moment is None else part.moment, frame_id))

    _log_notes(dataset, content.source.notes)
    with SceneWriter(out, content.name, content.source) as writer:
        for fit in content.fits.values():
            writer.add_camera(fit.camera)
        total = content.total or (len(content.items) if isinstance(content.items, Sequence) else 0)
        common.for_each(content.items, convert, f"importing {dataset}", total, options.workers, content.item_name)
        tracks, notes = content.tracks()
        tracks, turned = turned_back(tracks)
        notes = [*notes, *turned]
        for sensor, counts in sorted(lost.items()):
            without, total = (sum(numbers) for numbers in zip(*counts, strict=True))
            if without:
                share = f"{without} of {total} points ({without / total:.1%})"
                notes.append(f"{sensor}: {share} mark beams without a return and were left out")
        _log_notes(dataset, notes)
        writer.add_notes(notes)
        for track in tracks:
            writer.add_track(track)
        writer.set_ego(content.ego)
        groups: dict[int, list[str]] = {}
        for moment, frame_id in sorted(moments):
            groups.setdefault(moment, []).append(frame_id)
        writer.set_split(common.holdout_split(list(groups.values()), options.test_every))
        return writer.finish()


def _log_notes(dataset: str, notes: Iterable[str]) -> None:
    for note in notes:
        log.info(f"{dataset}: {note}")


# --- sensors on their own clocks ------------------------------------------------------------------


@dataclass(frozen=True, slots=True, eq=False)
class ImageRecord:
    """One recorded image, its pose f64[4, 4] at its own time. ``read``: its bytes, where it is no file of its own;
    ``place`` names it then, for errors, and ``path`` is the file that holds it."""

    sensor: str
    time_s: float
    map_from_sensor: Matrix
    path: Path
    read: Callable[[], bytes] | None = None
    place: str = ""


@dataclass(frozen=True, slots=True, eq=False)
class SweepRecord:
    """One LiDAR sweep, as ``ImageRecord``; ``read`` loads the points when they are wanted."""

    sensor: str
    time_s: float
    map_from_sensor: Matrix
    path: Path
    read: Callable[[], SweepPoints]
    place: str = ""


Record = ImageRecord | SweepRecord


@dataclass(frozen=True, slots=True, eq=False)
class CameraOptics:
    """What a camera's images need besides its intrinsics: ``lens``, if they are not rectified, and where they show the
    recording vehicle, ``ego`` bool[H, W] of the recorded size."""

    recorded: Camera
    lens: Lens | None = None
    ego: NDArray[np.bool_] | None = None


@dataclass(frozen=True, slots=True, eq=False)
class DriveLog:
    """What a reader found, in the frame of the data set's map.

    ``name``: the scene's id. ``cameras``: by scene name; the first one counts frames. ``images``, ``sweeps``: in any
    order; times in seconds on one clock. ``where``: for messages. ``optics``: by scene name; other cameras are
    rectified. ``box_times``: ``sweeps``: keys of tracks are the times of the sweeps in which people saw the boxes;
    ``own``: the boxes' own."""

    name: str
    cameras: Mapping[str, Camera]
    images: Sequence[ImageRecord]
    sweeps: Sequence[SweepRecord]
    tracks: Sequence[Track]
    ego: EgoPath
    source: Source
    where: str
    optics: Mapping[str, CameraOptics] = field(default_factory=dict)
    box_times: Literal["sweeps", "own"] = "sweeps"


def write_log(drive: DriveLog, out: Path, options: ImportOptions) -> Scene:
    """Write the chosen frames of ``drive`` as a scene at ``out``. Boxes of moving objects are brought to the sweeps'
    times, unless ``untwist`` is ``no``: then every sweep counts as one moment, and boxes stay as drawn. Raises
    UsageError: no frame lies in the chosen range. InputError: a file is missing or damaged; poses, times and units
    contradict each other. Nothing is left at ``out``."""
    common.check_motion(drive.ego, drive.where)
    chosen = _outside_gaps(_without_missing(_choose_frames(drive, options), options), drive, options)
    records = sorted(chosen, key=lambda record: record.time_s)
    start_s, end_s = records[0].time_s, records[-1].time_s
    counts = {record.sensor: itertools.count() for record in records}
    numbers = {record: next(counts[record.sensor]) for record in records}
    near = (drive.ego.times_s >= start_s - _EGO_MARGIN_S) & (drive.ego.times_s <= end_s + _EGO_MARGIN_S)
    if not near.any():
        raise InputError("no vehicle pose lies in the time of the chosen frames", where=drive.where)
    ego = EgoPath(drive.ego.times_s[near], drive.ego.world_from_ego[near])
    world_from_map = common.world_from_first(ego.world_from_ego[0])
    optics = {name: drive.optics.get(name, CameraOptics(camera)) for name, camera in drive.cameras.items()}
    fits = {name: fit_images(drive.cameras[name], options, one.lens) for name, one in optics.items()}
    labels = {name: {} if one.ego is None else {"ego": fits[name].ids(one.ego)} for name, one in optics.items()}
    within = (start_s - REACH_S, end_s + REACH_S)
    seen = BoxTimes([track for track in drive.tracks if clip_track(track, *within) is not None])
    notes = [*drive.source.notes, *image_notes(fits), common.origin_note(ego.world_from_ego[0])]
    if options.untwist == "no":
        notes.append("sweeps count as moments: point times are left out")
    if options.frames is not None:
        notes.append(f"frames {options.frames[0]} to {options.frames[1] - 1} of camera {next(iter(drive.cameras))}")

    def convert(record: Record) -> Iterable[SceneImage | SceneSweep]:
        sensor, number, time_s, where = record.sensor, numbers[record], record.time_s - start_s, _place(record)
        pose = world_from_map @ record.map_from_sensor
        if isinstance(record, ImageRecord):
            image = record.path if record.read is None else record.read()
            yield SceneImage(sensor, number, time_s, pose, image, where, labels[sensor], chosen[record])
            return
        points = record.read()
        if options.untwist == "no":
            points = replace(points, dt_s=np.zeros_like(points.dt_s))
        if drive.box_times == "sweeps":
            seen.observe(record.time_s, record.map_from_sensor, points)
        yield SceneSweep(sensor, number, time_s, pose, points, where)

    def tracks() -> Tracks:
        clipped = [clip_track(reach_images(track), start_s, end_s) for track in seen.at_sweep_times()]
        return [
            replace(t, times_s=t.times_s - start_s, world_from_object=world_from_map @ t.world_from_object)
            for t in clipped
            if t is not None
        ], ()

    path = EgoPath(ego.times_s - start_s, world_from_map @ ego.world_from_ego)
    source = replace(drive.source, notes=tuple(notes))
    content = SceneContent(drive.name, source, fits, records, convert, _place, path, tracks)
    return write_scene(content, out, options)


def _place(record: Record) -> str:
    return record.place or str(record.path)


def _choose_frames(drive: DriveLog, options: ImportOptions) -> dict[Record, int]:
    """The chosen images and sweeps -> the frame number each belongs to."""
    times: dict[str, list[float]] = {}
    for record in (*drive.images, *drive.sweeps):
        times.setdefault(record.sensor, []).append(record.time_s)
    for sensor, values in times.items():
        steps = np.diff(np.sort(values))
        if len(steps) and steps.min() <= 0:
            what, where = "two records of one sensor have the same time", f"{drive.where}: {sensor}"
            got = f"{np.sort(values)[int(steps.argmin())]:.6f} s"
            raise InputError(what, where=where, got=got, expected="a time of its own for every image and sweep")
    lacking = [name for name in drive.cameras if not any(image.sensor == name for image in drive.images)]
    if lacking:
        what, got = "a camera has no images in this log", ", ".join(lacking)
        remedy = "unpack the archives with its images, or choose others with --cameras"
        raise InputError(what, where=drive.where, got=got, expected="images of every chosen camera", remedy=remedy)
    reference = next(iter(drive.cameras))
    reference_s = np.sort([image.time_s for image in drive.images if image.sensor == reference])
    first, end = options.frames if options.frames is not None else (0, len(reference_s))
    if first >= len(reference_s):
        expected = f"frames 0 to {len(reference_s) - 1} ({len(reference_s)} images of {reference})"
        raise UsageError("no frame lies in the chosen range", where="--frames", got=f"{first}:{end}", expected=expected)
    records = [*drive.images, *drive.sweeps]
    nearest = common.nearest_index(reference_s, np.array([record.time_s for record in records])).tolist()
    return {record: number for record, number in zip(records, nearest, strict=True) if first <= number < end}


def _without_missing(chosen: dict[Record, int], options: ImportOptions) -> dict[Record, int]:
    """Refuse files that are not there, or leave them out and say so."""
    absent = {record: record.path for record in chosen if not record.path.is_file()}
    if not absent:
        return chosen
    by_sensor: dict[str, list[Path]] = {}
    for record, path in absent.items():
        by_sensor.setdefault(record.sensor, []).append(path)
    lacks = "; ".join(f"{sensor} lacks {len(paths)} (first: {paths[0].name})" for sensor, paths in by_sensor.items())
    left = {record: number for record, number in chosen.items() if record not in absent}
    if not options.skip_missing or not any(isinstance(record, ImageRecord) for record in left):
        what = "files that the log names are missing"
        expected = f"all {len(chosen)} images and sweeps of the chosen frames"
        remedy = "unpack the missing archives, choose frames with --frames FIRST:END, or add --skip-missing"
        raise InputError(what, where=str(next(iter(absent.values()))), got=lacks, expected=expected, remedy=remedy)
    log.warn(f"left out files that are missing: {lacks}")
    return left


def _outside_gaps(chosen: dict[Record, int], drive: DriveLog, options: ImportOptions) -> dict[Record, int]:
    """Refuse records in gaps of the vehicle's path, or leave them out and say so."""
    guessed = {record: gap for record in chosen if (gap := motion.gap_at(drive.ego, record.time_s))}
    if not guessed:
        return chosen
    record, gap = next(iter(guessed.items()))
    left = {record: number for record, number in chosen.items() if record not in guessed}
    if not options.skip_missing or not any(isinstance(record, ImageRecord) for record in left):
        raise common.gap_problem(gap, record.time_s, _place(record))
    log.warn(f"left out {len(guessed)} images and sweeps in gaps of the vehicle's path; the first: {gap}")
    return left


# --- when a box was seen --------------------------------------------------------------------------
#
# A turning sensor meets an object some time before or after the sweep's stamp, and people draw the box around points as
# the beams met them: it belongs to the mean time of the points inside it (0.8 m at 10 m/s and 0.08 s), and is moved by
# the track's velocity to the stamp, where points, too, are brought by their ``dt_s``.
MOVES_M: Final = 1.0
"""A track whose box's centre visits a region of a longer diagonal moves; other boxes stay as they were drawn."""
REACH_S: Final = 0.05
"""Half a turn of a 10 Hz sensor; cameras look at most this far from the sweep they belong to."""
_GROWTH_M: Final = 0.1
_SAME_S: Final = 1e-3


class BoxTimes:
    """Mean point time of every box of every moving track, collected while sweeps pass by in any order. ``tracks``: as
    annotated; keys at sweep times. ``observe`` may be called from several threads, once per sweep."""

    def __init__(self, tracks: Sequence[Track]) -> None:
        self._tracks = tuple(tracks)
        spreads = [np.ptp(track.world_from_object[:, :3, 3], axis=0) for track in self._tracks]
        self._moving = [i for i, spread in enumerate(spreads) if np.linalg.norm(spread) > MOVES_M]
        self._late_s: dict[tuple[int, int], float] = {}

    def observe(self, time_s: float, map_from_lidar: Matrix, points: SweepPoints) -> None:
        """Note the mean ``dt_s`` of the points inside each box that is annotated at this sweep's time."""
        if not np.any(points.dt_s):
            return
        lidar_from_map = invert(map_from_lidar)
        order = np.argsort(points.xyz[:, 0])  # once a sweep: each box then looks at a slice of it only
        xyz, dt_s = points.xyz[order], points.dt_s[order]
        x, y = np.ascontiguousarray(xyz[:, 0]), np.ascontiguousarray(xyz[:, 1])
        for index in self._moving:
            track = self._tracks[index]
            key = int(np.searchsorted(track.times_s, time_s - _SAME_S))
            if key == len(track.times_s) or track.times_s[key] > time_s + _SAME_S:
                continue
            lidar_from_box = lidar_from_map @ track.world_from_object[key]
            half = track.size_m / 2 + _GROWTH_M
            reach = float(np.linalg.norm(half))
            center_x, center_y = float(lidar_from_box[0, 3]), float(lidar_from_box[1, 3])
            first, end = np.searchsorted(x, [np.float32(center_x - reach), np.float32(center_x + reach)])
            near = first + np.flatnonzero(np.abs(y[first:end] - np.float32(center_y)) < reach)
            inside = (np.abs(transform_points(invert(lidar_from_box), xyz[near])) < half).all(1)
            if inside.any():
                self._late_s[index, key] = float(dt_s[near[inside]].mean(dtype=np.float64))

    def at_sweep_times(self) -> list[Track]:
        """The tracks with boxes at their stamps, in the order given. Boxes without points inside take the delay of the
        track's neighbouring boxes."""
        tracks = list(self._tracks)
        for index in self._moving:
            track = tracks[index]
            known = [key for key in range(len(track.times_s)) if (index, key) in self._late_s]
            if not known:
                continue
            times = track.times_s
            late_s = np.interp(times, times[known], [self._late_s[index, key] for key in known])
            poses = track.world_from_object.copy()
            poses[:, :3, 3] -= _track_velocity(times, late_s, poses[:, :3, 3]) * late_s[:, None]
            tracks[index] = replace(track, world_from_object=poses)
        return tracks


def _track_velocity(times_s: NDArray[np.float64], late_s: NDArray[np.float64], places: Matrix) -> Matrix:
    """Velocity at each key, f64[T, 3] m/s: a place filed under t was taken at t + late. Steps that these delays nearly
    cancel (an object crosses the seam where the turn begins) tell no velocity and are left out."""
    steps_s = np.diff(times_s + late_s)
    telling = steps_s > 0.5 * np.diff(times_s)
    if not telling.any():
        return np.zeros_like(places)
    between = ((times_s[1:] + times_s[:-1]) / 2)[telling]
    speeds = np.diff(places, axis=0)[telling] / steps_s[telling, None]
    return np.stack([np.interp(times_s, between, speeds[:, axis]) for axis in range(3)], 1)


def reach_images(track: Track) -> Track:
    """The track with a key ``REACH_S`` before its first and one after its last box, by the velocity of the nearest two:
    images are taken a little before or after the sweep they belong to."""
    times, poses = track.times_s, track.world_from_object
    before, after = poses[0].copy(), poses[-1].copy()
    if len(times) > 1:
        before[:3, 3] -= (poses[1, :3, 3] - poses[0, :3, 3]) / (times[1] - times[0]) * REACH_S
        after[:3, 3] += (poses[-1, :3, 3] - poses[-2, :3, 3]) / (times[-1] - times[-2]) * REACH_S
    times, poses = np.r_[times[0] - REACH_S, times, times[-1] + REACH_S], np.stack([before, *poses, after])
    return replace(track, times_s=times, world_from_object=poses)


def clip_track(track: Track, start_s: float, end_s: float) -> Track | None:
    """The keys of a track that matter from ``start_s`` to ``end_s``: those inside and one beyond each end; None if it
    is not there then."""
    if track.times_s[-1] < start_s - 1e-6 or track.times_s[0] > end_s + 1e-6:
        return None
    first = max(0, int(np.searchsorted(track.times_s, start_s + 1e-6)) - 1)
    last = min(len(track.times_s), int(np.searchsorted(track.times_s, end_s - 1e-6)) + 1)
    return replace(track, times_s=track.times_s[first:last], world_from_object=track.world_from_object[first:last])


# --- boxes of many frames -> tracks ---------------------------------------------------------------
MAX_GAP_S: Final = 0.55
"""A moving object that is not seen for longer than this is split: interpolating across would invent its path."""
MAX_SIDE_M: Final = 100.0
LONGER_THAN_WIDE: Final = frozenset(("car", "van", "bus", "vehicle"))
"""Labels whose boxes are longer than wide in every data set (a truck's cab may be a box of its own)."""
_ROW: Final = 17  # time, delay, size, pose
_MIN_STEP_S: Final = 0.05
_SAME_TIME_S: Final = 1e-4
_NAMED: Final = 5
Speeds = Callable[[NDArray[np.float64], Matrix, Sequence[NDArray[np.intp]]], Matrix]
"""Times f64[n] at which an object was measured, its places f64[n, 3], the pieces of its track (indices) -> velocities
f64[n, 3] m/s."""


def box_size(length: Any, width: Any, height: Any, where: str) -> tuple[float, float, float]:
    """Length, width, height as finite positive metres, or an InputError."""
    try:
        size = (float(length), float(width), float(height))
    except (TypeError, ValueError) as error:
        raise InputError("box size is not made of numbers", where=where, got=str(error)) from error
    if not all(np.isfinite(side) and 0 < side <= MAX_SIDE_M for side in size):
        what = "box size makes no sense"
        expected = f"length, width and height in metres, above 0 and at most {MAX_SIDE_M:g}"
        raise InputError(what, where=where, expected=expected, got=f"length {length}, width {width}, height {height}")
    return size


class BoxTracks:
    """Collects boxes in any order; ``tracks`` puts them together. ``where``: file or folder of the boxes. ``labels``:
    the data set's class -> the label here; other classes keep the last part (after a dot) of their name in lower case,
    and are named in the notes. ``max_gap_s``: an object that is not seen for longer is split."""

    def __init__(self, where: str, labels: Mapping[str, str], max_gap_s: float = MAX_GAP_S) -> None:
        self._where, self._labels, self._max_gap_s = where, labels, max_gap_s
        self._rows: dict[str, array] = {}
        self._labels_of: dict[str, Counter[str]] = {}
        self._may_move: set[str] = set()
        self._unknown: Counter[str] = Counter()

    def __len__(self) -> int:
        return len(self._rows)

    def label_of(self, category: str) -> str:
        """The label of a class; unknown ones are counted. InputError for a name above 200 bytes."""
        if category in self._labels:
            return self._labels[category]
        foreign_name(category, f"{self._where}: class of a box")
        self._unknown[category] += 1
        return category.rsplit(".", 1)[-1].strip().lower().replace(" ", "_") or "unknown"

    def add(
        self,
        track: str,
        label: str,
        time_s: float,
        size_m: tuple[float, float, float],
        world_from_box: Matrix,
        standing: bool = False,
        late_s: float = 0.0,
        where: str = "",
    ) -> None:
        """Add one box of the object ``track``, f64[4, 4], x forward, y left, z up, origin in the centre; ``size_m``:
        length, width, height. ``label``: of ``label_of``; the track takes its commonest one. ``standing``: the data set
        says with every box of the object that it does not move in the whole log. ``late_s``: how long after ``time_s``
        the box was measured; it is moved there with the object's velocity. Raises InputError: the size is not positive
        or absurd, or the id is longer than 200 bytes."""
        foreign_name(track, f"{where or self._where}: id of an object")
        size = box_size(*size_m, where=where or f"{self._where}: object {track} ({label})")
        if not standing:
            self._may_move.add(track)
        self._labels_of.setdefault(track, Counter())[label] += 1
        row = (time_s, late_s, *size, *world_from_box[:3].ravel().tolist())
        self._rows.setdefault(track, array("d")).extend(row)

    def tracks(
        self, speeds: Speeds | None = None, images_s: Mapping[float, tuple[float, float]] | None = None
    ) -> tuple[list[Track], list[str]]:
        """All tracks in the order of their first boxes, and notes. The size is the median over the track. What stands
        gets one pose (median place, mean heading) from its first to its last moment. What may move is split where it is
        not seen for more than ``max_gap_s``: ``7``, ``7.1``, ... ``speeds``: how velocities are found; None = from the
        neighbouring boxes of a piece. ``images_s``: time of a box -> times of the first and last image that show the
        object, which a track reaches to. Raises InputError: two boxes at one moment; length and width are swapped."""
        tracks: list[Track] = []
        split = 0
        for name, numbers in self._rows.items():
            rows = np.frombuffer(numbers, np.float64).reshape(-1, _ROW)
            rows = rows[np.argsort(rows[:, 0], kind="stable")]
            times = rows[:, 0]
            if (np.diff(times) <= 0).any():
                at = float(times[int(np.flatnonzero(np.diff(times) <= 0)[0])])
                what, where = "an object has two boxes at one moment", f"{self._where}: object {name}"
                raise InputError(what, where=where, got=f"time {at:.3f} s of the log", remedy="are two logs mixed?")
            size = np.median(rows[:, 2:5], axis=0)
            label = self._labels_of[name].most_common(1)[0][0]
            poses = np.tile(np.eye(4), (len(rows), 1, 1))
            poses[:, :3] = rows[:, 5:].reshape(-1, 3, 4)
            if name not in self._may_move:
                poses, _ = motion.unflipped(times, poses, motion.MOST_TURN_RAD_S)
                mean = quaternion_from_matrix(poses[0])  # running slerp from the first on
                for count, pose in enumerate(poses[1:], start=2):
                    mean = slerp(mean, quaternion_from_matrix(pose), 1 / count)
                first, last = float(times[0]), float(times[-1])
                if images_s is not None:
                    start, end = images_s[first][0], images_s[last][1]
                    first = start if start < first - _SAME_TIME_S else first
                    last = end if end > last + _SAME_TIME_S else last
                ends = np.array([first, last] if last - first > _SAME_TIME_S else [first])
                pose = from_rotation_translation(matrix_from_quaternion(mean), np.median(poses[:, :3, 3], axis=0))
                tracks.append(Track(name, label, size, ends, np.stack([pose] * len(ends))))
                continue
            pieces = np.split(np.arange(len(rows)), np.flatnonzero(np.diff(times) > self._max_gap_s) + 1)
            split += len(pieces) > 1
            velocity = (speeds or neighbour_speeds)(times + rows[:, 1], poses[:, :3, 3], pieces)
            poses[:, :3, 3] -= velocity * rows[:, 1:2]
            for part, piece in enumerate(pieces):
                keys = times[piece], poses[piece]
                if images_s is not None:
                    ends_s = images_s[float(times[piece[0]])][0], images_s[float(times[piece[-1]])][1]
                    keys = _reaching(*keys, velocity[piece], ends_s)
                tracks.append(Track(f"{name}.{part}" if part else name, label, size, *keys))
        vehicles = [track for track in tracks if track.label in LONGER_THAN_WIDE]
        wide = [track for track in vehicles if track.size_m[1] > track.size_m[0]]
        if vehicles and 2 * len(wide) > len(vehicles):
            what, expected = "length and width of boxes are swapped", "vehicles longer than wide"
            example = f"{wide[0].label} {wide[0].id}: {wide[0].size_m[0]:.2f} m long, {wide[0].size_m[1]:.2f} m wide"
            got = f"{len(wide)} of {len(vehicles)} are wider than long, e.g. {example}"
            remedy = "check the order in which the sizes were written"
            raise InputError(what, where=self._where, expected=expected, got=got, remedy=remedy)
        tracks.sort(key=lambda track: float(track.times_s[0]))
        notes = []
        if split:
            notes.append(f"{split} tracks are not seen for more than {self._max_gap_s:g} s and were split there")
        if self._unknown:
            some = ", ".join(f"{label!r} ({count} boxes)" for label, count in sorted(self._unknown.items())[:8])
            notes.append(f"classes that are not known here keep their names: {some}")
        return tracks, notes


def turned_back(tracks: Sequence[Track]) -> tuple[list[Track], list[str]]:
    """The tracks with headings that flip by 180 degrees turned back, and a note about those that were; see
    ``motion.unflipped``."""
    mended, names = [], []
    for track in tracks:
        poses, turned = motion.unflipped(track.times_s, track.world_from_object, motion.most_turn_rad_s(track.label))
        mended.append(replace(track, world_from_object=poses) if len(turned) else track)
        if len(turned):
            names.append(f"{track.id} at {track.times_s[turned[0]]:.2f} s ({len(turned)} of {len(poses)} keys)")
    some = ", ".join(names[:_NAMED]) + (f", ... ({len(names)} in all)" if len(names) > _NAMED else "")
    return mended, [f"headings that flip by 180 degrees were turned back: {some}"] if names else []


def neighbour_speeds(measured_s: NDArray[np.float64], places: Matrix, pieces: Sequence[NDArray[np.intp]]) -> Matrix:
    """Velocities of an object's boxes, f64[n, 3]: from the neighbours on both sides within each of the ``pieces`` of
    its track, or from the one there is."""
    velocity = np.zeros_like(places)
    for piece in pieces:
        numbers, times, at = np.arange(len(piece)), measured_s[piece], places[piece]
        before, after = np.maximum(numbers - 1, 0), np.minimum(numbers + 1, len(piece) - 1)
        span = times[after] - times[before]
        speeds = (at[after] - at[before]) / np.maximum(span, _MIN_STEP_S)[:, None]
        short = span < _MIN_STEP_S  # two measurements at nearly one moment, at an end: go by the neighbour
        speeds[short] = speeds[np.where(before == numbers, after, before)][short]
        velocity[piece] = speeds
    return velocity


def _reaching(
    times_s: NDArray[np.float64], poses: Matrix, velocity: Matrix, ends_s: tuple[float, float]
) -> tuple[NDArray[np.float64], Matrix]:
    """Keys with one more at each of ``ends_s`` that lies outside of them."""
    start_s, end_s = ends_s[0] - times_s[0], ends_s[1] - times_s[-1]
    if start_s < -_SAME_TIME_S:
        times_s, poses = np.concatenate([ends_s[:1], times_s]), np.concatenate([poses[:1], poses])
        poses[0, :3, 3] += velocity[0] * start_s
    if end_s > _SAME_TIME_S:
        times_s, poses = np.concatenate([times_s, ends_s[1:]]), np.concatenate([poses, poses[-1:]])
        poses[-1, :3, 3] += velocity[-1] * end_s
    return times_s, poses
