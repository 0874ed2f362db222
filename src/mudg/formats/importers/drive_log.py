"""The one writer of imported scenes, and logs whose sensors run on their own clocks.

Every importer ends in ``write_scene``: it says in a ``SceneContent`` what is small (cameras, vehicle path, notes), and
turns one item after another (a frame, an image, a sweep) into ``SceneImage`` and ``SceneSweep`` when they are written.

Formats whose sensors run on their own clocks fill a ``DriveLog`` instead: every image and sweep with its own time and
pose in the map's frame, nothing decoded yet. ``write_log`` chooses frames, moves the world to the first vehicle pose,
and writes the scene. Frames are counted by one camera, the reference: frame n is its n-th image in time order.
Everything else that was recorded nearer to that image than to its neighbours belongs to frame n. ``--frames`` and the
held-out split go by this number.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Final, Generic, Literal, TypeVar

import numpy as np
from numpy.typing import NDArray

from mudg.base import log, types
from mudg.base.errors import InputError, UsageError
from mudg.base.types import Camera, EgoPath, Scene, Source, SweepPoints, Track, View
from mudg.formats.importers.box_tracks import REACH_S, BoxTimes, clip_track, reach_images, turned_back
from mudg.formats.importers.common import (
    ImportOptions,
    check_motion,
    for_each,
    gap_problem,
    holdout_split,
    nearest_index,
    origin_note,
    world_from_first,
)
from mudg.formats.importers.images import ImageFit, Lens, fit_images, image_notes
from mudg.scene import motion
from mudg.scene.clouds import FLOAT32_SPACING_M, at_sensor, float32_spacing_m
from mudg.scene.write import SceneWriter

Matrix = NDArray[np.float64]
Item = TypeVar("Item")
Tracks = tuple[Sequence[Track], Sequence[str]]
"""Tracks, and notes about them."""

_EGO_MARGIN_S: Final = 0.6


# --- any scene ------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, eq=False)
class SceneImage:
    """One image on its way into a scene.

    Args:
        camera: its name in the scene.
        number: of its frame; the id becomes ``<camera>/<number>``.
        time_s: seconds of the scene's clock.
        world_from_cam: f64[4, 4].
        image: path or bytes of the recorded file.
        where: for errors; empty = the path.
        labels: see ``SceneWriter.add_label``; in the scene's size.
        moment: images of one moment are held out together; None = the number.
    """

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
    """A scene that is ready to be written: all that is small, and how to get the rest.

    Args:
        name: the scene's id.
        source: data set, licence and notes, which are logged.
        fits: by the cameras' scene names, in the order of the scene.
        items: what is converted one by one: frames, images, sweeps; may be a generator (``total`` says how many then).
        convert: an item to its images and sweeps; called from several threads if ``workers`` > 1.
        item_name: what an item is called, put before the place of an error.
        ego: the vehicle's path in the scene's world and clock.
        tracks: called after the last item: tracks in the world and clock of the scene, and notes about them.
    """

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
    """Write a scene at ``out``.

    Points at a sensor's own place (``scene.returns``) are left out, and headings of boxes that flip by 180 degrees are
    turned back; both are counted in the scene's notes.

    Images whose size is kept are copied byte for byte, after a check that they are complete and of their camera's size.
    At most two items per worker are in memory, beside the few that wait for the disk.

    Raises:
        InputError: an item is missing or damaged, or what is written contradicts itself. Nothing is left at ``out``.
    """
    dataset = content.source.dataset
    types.foreign_name(content.name, f"{dataset}: name of the log")
    moments: list[tuple[int, str]] = []
    rows: dict[str, list[tuple[int, int, float]]] = {}
    """Sensor -> of each sweep, rows without a return, all rows, and how far apart float32 numbers are at its farthest
    point."""

    def convert(item: Item) -> None:
        for part in content.convert(item):
            if isinstance(part, SceneSweep):
                sweep_id = f"{part.sensor}/{part.number:06d}"
                points = _without_zeros(part, content.ego)
                counts = points.no_returns, points.no_returns + len(points.xyz), float32_spacing_m(points.xyz)
                rows.setdefault(part.sensor, []).append(counts)
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
        title = f"importing {dataset}"
        for_each(
            content.items, convert, title=title, total=content.total, workers=options.workers, name=content.item_name
        )
        found, notes = content.tracks()
        tracks, turned = turned_back(found)
        notes = [*notes, *turned, *_row_notes(rows)]
        _log_notes(dataset, notes)
        writer.add_notes(notes)
        for track in tracks:
            writer.add_track(track)
        writer.set_ego(content.ego)
        groups: dict[int, list[str]] = {}
        for moment, frame_id in sorted(moments):
            groups.setdefault(moment, []).append(frame_id)
        writer.set_split(holdout_split(list(groups.values()), options.test_every))
        return writer.finish()


def _without_zeros(sweep: SceneSweep, ego: EgoPath) -> SweepPoints:
    """The points of a sweep without those at the sensor's own place, which are counted."""
    points = sweep.points
    zeros = at_sensor(points, sweep.time_s, sweep.world_from_lidar, ego)
    if not zeros.any():
        return points
    classes = None if points.classes is None else points.classes[~zeros]
    no_returns = points.no_returns + int(zeros.sum())
    return SweepPoints(points.xyz[~zeros], points.intensity[~zeros], points.dt_s[~zeros], classes, no_returns)


def _row_notes(rows: Mapping[str, Sequence[tuple[int, int, float]]]) -> list[str]:
    """Notes about beams without a return, and about points so far away that float32 rounds them."""
    notes = []
    for sensor, counts in sorted(rows.items()):
        without, total = sum(one[0] for one in counts), sum(one[1] for one in counts)
        if without:
            notes.append(
                f"{sensor}: {without} of {total} points ({without / total:.1%}) mark beams without a return and were"
                " left out"
            )
        spacing_m = max(one[2] for one in counts)
        if spacing_m > FLOAT32_SPACING_M:
            log.warn(
                f"{sensor}: points reach so far from the sensor that float32 rounds them to {spacing_m * 1e3:.3g} mm; "
                "are they in the sensor's frame?"
            )
    return notes


def _log_notes(dataset: str, notes: Iterable[str]) -> None:
    for note in notes:
        log.info(f"{dataset}: {note}")


# --- sensors on their own clocks ------------------------------------------------------------------


@dataclass(frozen=True, slots=True, eq=False)
class ImageRecord:
    """One recorded image: ``map_from_cam`` f64[4, 4] at its own time. ``read``: its bytes, where it is no file of its
    own; ``place`` names it then, for errors, and ``path`` is the file that holds it."""

    camera: str
    time_s: float
    map_from_cam: Matrix
    path: Path
    read: Callable[[], bytes] | None = None
    place: str = ""


@dataclass(frozen=True, slots=True, eq=False)
class SweepRecord:
    """One LiDAR sweep: ``map_from_lidar`` f64[4, 4] at its time; ``read`` loads the points when they are wanted.
    ``place`` as above."""

    sensor: str
    time_s: float
    map_from_lidar: Matrix
    path: Path
    read: Callable[[], SweepPoints]
    place: str = ""


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

    Args:
        name: name of the log; becomes the scene's id.
        cameras: by scene name, in the order of the scene.
        reference: the camera that counts frames.
        images, sweeps: in any order; times in seconds on one clock.
        tracks: boxes in the map's frame.
        ego: the vehicle's path in the map's frame.
        source: data set, licence and notes.
        where: folder, for messages.
        optics: by scene name; cameras that are not named are rectified.
        box_times: ``sweeps``: keys of tracks are the times of the sweeps in which people saw the boxes; ``own``: the
            boxes' own.
    """

    name: str
    cameras: Mapping[str, Camera]
    reference: str
    images: Sequence[ImageRecord]
    sweeps: Sequence[SweepRecord]
    tracks: Sequence[Track]
    ego: EgoPath
    source: Source
    where: str
    optics: Mapping[str, CameraOptics] = field(default_factory=dict)
    box_times: Literal["sweeps", "own"] = "sweeps"


def write_log(drive: DriveLog, out: Path, options: ImportOptions) -> Scene:
    """Write the chosen frames of ``drive`` as a scene at ``out``.

    Tracks reach 0.05 s beyond their boxes, so that images at their ends are covered. Boxes of moving objects are
    brought to the sweeps' times (``box_times``), unless ``untwist`` is ``no``: then every sweep counts as one moment,
    without point times, and boxes stay as drawn.

    Raises:
        UsageError: no frame lies in the chosen range.
        InputError: a file is missing or damaged; poses, times and units contradict each other. Nothing is left at
            ``out``.
    """
    check_motion(drive.ego, drive.where)
    chosen = _outside_gaps(_without_missing(_choose_frames(drive, options), options), drive, options)
    records = sorted((*chosen.images, *chosen.sweeps), key=lambda record: record.time_s)
    start_s, end_s = records[0].time_s, records[-1].time_s
    numbers = _numbers_in_time_order(records)
    ego = _ego_between(drive.ego, start_s, end_s, drive.where)
    world_from_map = world_from_first(ego.world_from_ego[0])
    optics = {name: drive.optics.get(name, CameraOptics(camera)) for name, camera in drive.cameras.items()}
    fits = {name: fit_images(drive.cameras[name], options, one.lens) for name, one in optics.items()}
    labels = {name: {} if one.ego is None else {"ego": fits[name].ids(one.ego)} for name, one in optics.items()}
    within = (start_s - REACH_S, end_s + REACH_S)
    seen = BoxTimes([track for track in drive.tracks if clip_track(track, *within) is not None])
    notes = [*drive.source.notes, *image_notes(fits), origin_note(ego.world_from_ego[0])]
    if options.untwist == "no":
        notes.append("sweeps count as moments: point times are left out")
    if options.frames is not None:
        notes.append(f"frames {options.frames[0]} to {options.frames[1] - 1} of camera {drive.reference}")

    def convert(record: ImageRecord | SweepRecord) -> Iterable[SceneImage | SceneSweep]:
        time_s, where = record.time_s - start_s, _place(record)
        if isinstance(record, ImageRecord):
            pose, moment = world_from_map @ record.map_from_cam, chosen.images[record]
            image = record.path if record.read is None else record.read()
            yield SceneImage(record.camera, numbers[record], time_s, pose, image, where, labels[record.camera], moment)
            return
        points = record.read()
        if options.untwist == "no":
            points = replace(points, dt_s=np.zeros_like(points.dt_s))
        if drive.box_times == "sweeps":
            seen.observe(record.time_s, record.map_from_lidar, points)
        pose = world_from_map @ record.map_from_lidar
        yield SceneSweep(record.sensor, numbers[record], time_s, pose, points, where)

    def tracks() -> Tracks:
        kept = [clip_track(reach_images(track), start_s, end_s) for track in seen.at_sweep_times()]
        return [
            replace(t, times_s=t.times_s - start_s, world_from_object=world_from_map @ t.world_from_object)
            for t in kept
            if t is not None
        ], ()

    path = EgoPath(ego.times_s - start_s, world_from_map @ ego.world_from_ego)
    source = replace(drive.source, notes=tuple(notes))
    content = SceneContent(drive.name, source, fits, records, convert, _place, path, tracks)
    return write_scene(content, out, options)


def _place(record: ImageRecord | SweepRecord) -> str:
    return record.place or str(record.path)


def _sensor_of(record: ImageRecord | SweepRecord) -> str:
    return record.camera if isinstance(record, ImageRecord) else record.sensor


def _numbers_in_time_order(records: Sequence[ImageRecord | SweepRecord]) -> dict[ImageRecord | SweepRecord, int]:
    """Number of each record, counted per sensor from 0."""
    counts: dict[str, int] = {}
    numbers = {}
    for record in records:
        numbers[record] = counts.get(_sensor_of(record), 0)
        counts[_sensor_of(record)] = numbers[record] + 1
    return numbers


@dataclass(frozen=True, slots=True, eq=False)
class _Chosen:
    """Images -> the frame number each belongs to; and sweeps."""

    images: Mapping[ImageRecord, int]
    sweeps: Sequence[SweepRecord]


def _choose_frames(drive: DriveLog, options: ImportOptions) -> _Chosen:
    check_sensor_times(drive)
    lacking = [name for name in drive.cameras if not any(image.camera == name for image in drive.images)]
    if lacking:
        what, got = "a camera has no images in this log", ", ".join(lacking)
        remedy = "unpack the archives with its images, or choose others with --cameras"
        raise InputError(what, where=drive.where, got=got, expected="images of every chosen camera", remedy=remedy)
    reference_s = np.sort([image.time_s for image in drive.images if image.camera == drive.reference])
    first, end = options.frames if options.frames is not None else (0, len(reference_s))
    if first >= len(reference_s):
        expected = f"frames 0 to {len(reference_s) - 1} ({len(reference_s)} images of {drive.reference})"
        raise UsageError("no frame lies in the chosen range", where="--frames", got=f"{first}:{end}", expected=expected)

    def numbered(records: Sequence[Any]) -> list[tuple[Any, int]]:
        nearest = nearest_index(reference_s, np.array([record.time_s for record in records])).tolist()
        return [(record, n) for record, n in zip(records, nearest, strict=True) if first <= n < end]

    return _Chosen(dict(numbered(drive.images)), [sweep for sweep, _ in numbered(drive.sweeps)])


def _without_missing(chosen: _Chosen, options: ImportOptions) -> _Chosen:
    """Refuse files that are not there, or leave them out and say so."""
    absent = {record: record.path for record in (*chosen.images, *chosen.sweeps) if not record.path.is_file()}
    if not absent:
        return chosen
    by_sensor: dict[str, list[Path]] = {}
    for record, path in absent.items():
        by_sensor.setdefault(_sensor_of(record), []).append(path)
    lacks = "; ".join(f"{sensor} lacks {len(paths)} (first: {paths[0].name})" for sensor, paths in by_sensor.items())
    if not options.skip_missing or not set(chosen.images) - set(absent):
        what = "files that the log names are missing"
        expected = f"all {len(chosen.images) + len(chosen.sweeps)} images and sweeps of the chosen frames"
        remedy = "unpack the missing archives, choose frames with --frames FIRST:END, or add --skip-missing"
        raise InputError(what, where=str(next(iter(absent.values()))), got=lacks, expected=expected, remedy=remedy)
    log.warn(f"left out files that are missing: {lacks}")
    images = {image: number for image, number in chosen.images.items() if image not in absent}
    return _Chosen(images, [sweep for sweep in chosen.sweeps if sweep not in absent])


def _outside_gaps(chosen: _Chosen, drive: DriveLog, options: ImportOptions) -> _Chosen:
    """Refuse records in gaps of the vehicle's path, or leave them out and say so."""
    guessed = {
        record: gap for record in (*chosen.images, *chosen.sweeps) if (gap := motion.gap_at(drive.ego, record.time_s))
    }
    if not guessed:
        return chosen
    record, gap = next(iter(guessed.items()))
    if not options.skip_missing or not set(chosen.images) - set(guessed):
        raise gap_problem(gap, record.time_s, _place(record))
    log.warn(f"left out {len(guessed)} images and sweeps in gaps of the vehicle's path; the first: {gap}")
    images = {image: number for image, number in chosen.images.items() if image not in guessed}
    return _Chosen(images, [sweep for sweep in chosen.sweeps if sweep not in guessed])


def check_sensor_times(drive: DriveLog) -> None:
    """Refuse two images or sweeps of one sensor at one time."""
    times: dict[str, list[float]] = {}
    for record in (*drive.images, *drive.sweeps):
        times.setdefault(_sensor_of(record), []).append(record.time_s)
    for sensor, values in times.items():
        steps = np.diff(np.sort(values))
        if len(steps) and steps.min() <= 0:
            what, where = "two records of one sensor have the same time", f"{drive.where}: {sensor}"
            got = f"{np.sort(values)[int(steps.argmin())]:.6f} s"
            raise InputError(what, where=where, got=got, expected="a time of its own for every image and sweep")


def _ego_between(ego: EgoPath, start_s: float, end_s: float, where: str) -> EgoPath:
    inside = (ego.times_s >= start_s - _EGO_MARGIN_S) & (ego.times_s <= end_s + _EGO_MARGIN_S)
    if not inside.any():
        raise InputError("no vehicle pose lies in the time of the chosen frames", where=where)
    return EgoPath(ego.times_s[inside], ego.world_from_ego[inside])
