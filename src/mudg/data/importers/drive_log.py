"""Logs whose sensors run on their own clocks: what a reader finds, put in order and written as a scene.

A format's reader fills a ``DriveLog``: every image and sweep with its own time and pose in the map's frame, nothing decoded
yet. ``write_log`` chooses frames, moves the world to the first vehicle pose, and streams images and sweeps into a scene,
one at a time.

Frames are counted by one camera, the reference: frame n is its n-th image in time order. Everything else that was
recorded nearer to that image than to its neighbours belongs to frame n. ``--frames`` and the held-out split go by this number.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from mudg.base import log
from mudg.base.errors import InputError, UsageError
from mudg.base.geometry import from_rotation_translation, yaw_matrix, yaw_of
from mudg.base.types import Camera, EgoPath, Scene, Source, SweepPoints, Track, View
from mudg.data.importers.box_times import REACH_S, BoxTimes, clip_track, reach_images
from mudg.data.importers.common import for_each
from mudg.data.importers.images import fit_images
from mudg.data.importers.layout import refuse_options
from mudg.data.importers.options import ImportOptions, holdout_split
from mudg.data.scene import SceneWriter
from mudg.data.scene.schema import ref_problem

Matrix = NDArray[np.float64]

MAX_SPEED_M_S: Final = 100.0
_SPEED_OVER_S: Final = 0.05
_LEAST_UPRIGHT: Final = 0.5
_DRIVES_M_S: Final = 1.0
_LEAST_ALONG: Final = 0.8
_EGO_MARGIN_S: Final = 0.6
_EPOCH_S: Final = (1e8, 4.1e9)
"""Seconds since 1970 that a recording may carry: 1973 to 2099."""
_MAX_LOG_S: Final = 4 * 3600.0


@dataclass(frozen=True, slots=True, eq=False)
class ImageRecord:
    """One recorded image: ``map_from_cam`` f64[4, 4] at its own time."""

    camera: str
    time_s: float
    map_from_cam: Matrix
    path: Path


@dataclass(frozen=True, slots=True, eq=False)
class SweepRecord:
    """One LiDAR sweep: ``map_from_lidar`` f64[4, 4] at its time; ``read`` loads the points when they are wanted."""

    sensor: str
    time_s: float
    map_from_lidar: Matrix
    path: Path
    read: Callable[[], SweepPoints]


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


def write_log(drive: DriveLog, out: Path, options: ImportOptions) -> Scene:
    """Write the chosen frames of ``drive`` as a scene at ``out``.

    Tracks reach 0.05 s beyond their boxes, so that images at their ends are covered. Boxes of moving objects are brought to
    the sweeps' times (``box_times``), unless ``untwist`` is ``no``: then every sweep
    counts as one moment, without point times, and boxes stay as drawn.

    Images whose size is kept are copied byte for byte, after a check that they are whole and of their camera's size. At most two
    images or sweeps per worker are in memory, beside the few that wait for the disk.

    Raises:
        UsageError: no frame lies in the chosen range.
        InputError: a file is missing or damaged; poses, times and units contradict each other. Nothing is left at ``out``.
    """
    check_motion(drive.ego, drive.where)
    chosen = _without_missing(_choose_frames(drive, options), options)
    records = sorted((*chosen.images, *chosen.sweeps), key=lambda record: record.time_s)
    start_s, end_s = records[0].time_s, records[-1].time_s
    ids = _ids_in_time_order(records)
    ego = _ego_between(drive.ego, start_s, end_s, drive.where)
    world_from_map = world_from_first(ego.world_from_ego[0])
    fits = {name: fit_images(camera, options) for name, camera in drive.cameras.items()}
    notes = [*drive.source.notes, *(fit.words for fit in fits.values() if fit.words)]
    within = (start_s - REACH_S, end_s + REACH_S)
    seen = BoxTimes([track for track in drive.tracks if clip_track(track, *within) is not None])
    if options.untwist == "no":
        notes.append("sweeps count as moments: point times are left out")
    if options.frames is not None:
        notes.append(f"frames {options.frames[0]} to {options.frames[1] - 1} of camera {drive.reference}")
    for note in notes:
        log.info(f"{drive.source.dataset}: {note}")
    source = Source(drive.source.dataset, drive.source.licence, drive.source.recipe, tuple(notes))
    with SceneWriter(out, drive.name, source) as writer:
        for fit in fits.values():
            writer.add_camera(fit.camera)

        def convert(record: ImageRecord | SweepRecord) -> None:
            time_s = record.time_s - start_s
            if isinstance(record, ImageRecord):
                fit = fits[record.camera]
                view = View(fit.camera, world_from_map @ record.map_from_cam, time_s)
                writer.add_frame(ids[record], view, fit.image(record.path, str(record.path)))
                return
            points = record.read()
            if options.untwist == "no":
                points = SweepPoints(points.xyz, points.intensity, np.zeros_like(points.dt_s))
            seen.see(record.time_s, record.map_from_lidar, points)
            if len(points.xyz) == 0:
                log.warn(f"{drive.source.dataset}: {record.path} has no points")
            writer.add_sweep(ids[record], record.sensor, time_s, world_from_map @ record.map_from_lidar, points)

        title = f"importing {drive.source.dataset}"
        for_each(records, convert, title=title, workers=options.workers, name=lambda record: str(record.path))
        for track in seen.at_sweep_times():
            kept = clip_track(reach_images(track), start_s, end_s)
            if kept is not None:
                poses = world_from_map @ kept.world_from_object
                writer.add_track(replace(kept, times_s=kept.times_s - start_s, world_from_object=poses))
        writer.set_ego(EgoPath(ego.times_s - start_s, world_from_map @ ego.world_from_ego))
        moments: dict[int, list[str]] = {}
        for image, moment in zip(chosen.images, chosen.image_moments, strict=True):
            moments.setdefault(moment, []).append(ids[image])
        writer.set_split(holdout_split([moments[m] for m in sorted(moments)], options.test_every))
        return writer.finish()


def _ids_in_time_order(records: Sequence[ImageRecord | SweepRecord]) -> dict[ImageRecord | SweepRecord, str]:
    """``<sensor>/<number>``, counted per sensor from 0."""
    counts: dict[str, int] = {}
    ids = {}
    for record in records:
        sensor = record.camera if isinstance(record, ImageRecord) else record.sensor
        counts[sensor] = counts.get(sensor, -1) + 1
        ids[record] = f"{sensor}/{counts[sensor]:06d}"
    return ids


# --- choosing -------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, eq=False)
class _Chosen:
    """Images with the frame number each belongs to, and sweeps."""

    images: Sequence[ImageRecord]
    image_moments: Sequence[int]
    sweeps: Sequence[SweepRecord]


def _choose_frames(drive: DriveLog, options: ImportOptions) -> _Chosen:
    check_sensor_times(drive)
    lacking = [name for name in drive.cameras if not any(image.camera == name for image in drive.images)]
    if lacking:
        raise InputError(
            "a camera has no images in this log",
            where=drive.where,
            got=", ".join(lacking),
            expected="images of every chosen camera",
            remedy="unpack the archives with its images, or choose others with --cameras",
        )
    reference_s = np.sort([image.time_s for image in drive.images if image.camera == drive.reference])
    first, end = options.frames if options.frames is not None else (0, len(reference_s))
    if first >= len(reference_s):
        raise UsageError(
            "no frame lies in the chosen range",
            where="--frames",
            expected=f"frames 0 to {len(reference_s) - 1} ({len(reference_s)} images of {drive.reference})",
            got=f"{first}:{end}",
        )
    image_moments = nearest_index(reference_s, np.array([image.time_s for image in drive.images]))
    sweep_moments = nearest_index(reference_s, np.array([sweep.time_s for sweep in drive.sweeps]))
    kept = [i for i, moment in enumerate(image_moments) if first <= moment < end]
    return _Chosen(
        [drive.images[i] for i in kept],
        [int(image_moments[i]) for i in kept],
        [sweep for sweep, moment in zip(drive.sweeps, sweep_moments, strict=True) if first <= moment < end],
    )


def nearest_index(sorted_times_s: NDArray[np.float64], times_s: NDArray[np.float64]) -> NDArray[np.intp]:
    """Index into increasing ``sorted_times_s`` f64[n] of the nearest for each of ``times_s`` f64[m]; halfway goes to the earlier."""
    return np.searchsorted((sorted_times_s[1:] + sorted_times_s[:-1]) / 2, times_s)


def _without_missing(chosen: _Chosen, options: ImportOptions) -> _Chosen:
    """Refuse files that are not there, or leave them out and say so."""
    absent = [r for r in (*chosen.images, *chosen.sweeps) if not r.path.is_file()]
    if not absent:
        return chosen
    by_sensor: dict[str, list[Path]] = {}
    for record in absent:
        by_sensor.setdefault(record.camera if isinstance(record, ImageRecord) else record.sensor, []).append(
            record.path
        )
    words = "; ".join(f"{sensor} lacks {len(paths)} (first: {paths[0].name})" for sensor, paths in by_sensor.items())
    if not options.skip_missing or not set(chosen.images) - set(absent):
        raise InputError(
            "files that the log names are missing",
            where=str(absent[0].path),
            got=words,
            expected=f"all {len(chosen.images) + len(chosen.sweeps)} images and sweeps of the chosen frames",
            remedy="unpack the missing archives, choose frames with --frames FIRST:END, or add --skip-missing",
        )
    log.warn(f"left out files that are missing: {words}")
    gone = set(absent)
    kept = [i for i, image in enumerate(chosen.images) if image not in gone]
    return _Chosen(
        [chosen.images[i] for i in kept],
        [chosen.image_moments[i] for i in kept],
        [sweep for sweep in chosen.sweeps if sweep not in gone],
    )


def refuse_untwist(options: ImportOptions, dataset: str, where: str) -> None:
    """Refuse ``--untwist yes``, ``--poses`` and ``--boxes`` for a data set that brings its own and compensates its sweeps."""
    if options.untwist == "yes":
        raise UsageError(
            f"sweeps of {dataset} are already compensated for the vehicle's motion",
            where=where,
            got="--untwist yes",
            remedy="leave --untwist out",
        )
    refuse_options(options, dataset, "poses", "boxes")


def path_inside(root: Path, name: Any, where: str) -> Path:
    """A file below ``root`` from a name in a foreign table; absolute names and ``..`` are refused."""
    problem = ref_problem(name)
    if problem is not None:
        raise InputError(
            f"file name {problem}", where=where, got=repr(name)[:120], expected="a relative path inside the log"
        )
    return root / name


# --- poses and times ------------------------------------------------------------------------------------------------


def world_from_first(map_from_ego: Matrix) -> Matrix:
    """The world whose origin is the first vehicle pose, its x axis along the first heading, its z axis the map's."""
    return yaw_matrix(-yaw_of(map_from_ego)) @ from_rotation_translation(np.eye(3), -map_from_ego[:3, 3])


def check_epoch(stamps: NDArray[np.integer], per_second: int, where: str) -> None:
    """Refuse integer time stamps that are not since 1970 in the unit ``per_second`` (10**6 = microseconds)."""
    unit = {10**6: "microseconds", 10**9: "nanoseconds"}[per_second]
    outside = (stamps < _EPOCH_S[0] * per_second) | (stamps > _EPOCH_S[1] * per_second)
    if outside.any():
        raise InputError(
            "time stamp is in another unit",
            where=where,
            expected=f"{unit} since 1970",
            got=f"{int(stamps[outside][0])}",
            remedy=f"convert the stamps to {unit}",
        )
    if len(stamps) and int(stamps.max()) - int(stamps.min()) > _MAX_LOG_S * per_second:
        raise InputError(
            "time stamps of one log span more than hours",
            where=where,
            got=f"{int(stamps.min())} to {int(stamps.max())}",
            expected=f"{unit}, all of one recording",
            remedy="are records of another log, or of another unit, mixed in?",
        )


def check_sensor_times(drive: DriveLog) -> None:
    """Refuse two images or sweeps of one sensor at one time."""
    times: dict[str, list[float]] = {}
    for image in drive.images:
        times.setdefault(image.camera, []).append(image.time_s)
    for sweep in drive.sweeps:
        times.setdefault(sweep.sensor, []).append(sweep.time_s)
    for sensor, values in times.items():
        steps = np.diff(np.sort(values))
        if len(steps) and steps.min() <= 0:
            raise InputError(
                "two records of one sensor have the same time",
                where=f"{drive.where}: {sensor}",
                got=f"{np.sort(values)[int(steps.argmin())]:.6f} s",
                expected="a time of its own for every image and sweep",
            )


def check_motion(ego: EgoPath, where: str) -> None:
    """Refuse a vehicle that drives impossibly fast or lies on its side or slides: units or the order of values are wrong then."""
    upright = float(np.median(ego.world_from_ego[:, 2, 2]))
    if upright < _LEAST_UPRIGHT:
        raise InputError(
            "the vehicle does not stand upright",
            where=where,
            expected="vehicle and map with z up",
            got=f"its z axis rises by {upright:.2f} per metre",
            remedy="check the order of quaternions (w, x, y, z) and the axes",
        )
    if len(ego.times_s) < 2:
        return
    # over a twentieth of a second at least: pose noise over less is no speed
    later = np.minimum(np.searchsorted(ego.times_s, ego.times_s + _SPEED_OVER_S), len(ego.times_s) - 1)
    pairs = np.flatnonzero(ego.times_s[later] - ego.times_s >= _SPEED_OVER_S)
    first, last = (pairs, later[pairs]) if len(pairs) else (np.array([0]), np.array([len(ego.times_s) - 1]))
    steps = ego.world_from_ego[last, :3, 3] - ego.world_from_ego[first, :3, 3]
    speed = np.linalg.norm(steps, axis=1) / (ego.times_s[last] - ego.times_s[first])
    at = int(speed.argmax())
    if speed[at] > MAX_SPEED_M_S:
        raise InputError(
            "the vehicle moves impossibly fast",
            where=where,
            got=f"{speed[at]:.0f} m/s, {ego.times_s[first[at]] - ego.times_s[0]:.3f} s after its first pose",
            expected=f"under {MAX_SPEED_M_S:.0f} m/s",
            remedy="check the units of times and translations, and that all poses are of one log",
        )
    drives = speed > _DRIVES_M_S
    if drives.any():
        forward = np.einsum("ni,ni->n", ego.world_from_ego[first[drives], :3, 0], steps[drives])
        along = float(np.median(np.abs(forward) / np.linalg.norm(steps[drives], axis=1)))  # reversing is driving, too
        if along < _LEAST_ALONG:
            raise InputError(
                "the vehicle does not drive where it looks",
                where=where,
                expected="vehicle axes x forward, y left, z up",
                got=f"it moves {np.rad2deg(np.arccos(along)):.0f} degrees off its x axis",
                remedy="check the order of quaternions (w, x, y, z) and the axes",
            )


def ego_path(stamps_s: Sequence[float], poses: Sequence[Matrix]) -> EgoPath:
    """Vehicle path in time order; of poses at one time (within a microsecond) the first is kept."""
    times = np.asarray(stamps_s, np.float64)
    order = np.argsort(times, kind="stable")
    kept = order[np.r_[True, np.diff(times[order]) > 1e-6]]
    return EgoPath(times[kept], np.stack([poses[i] for i in kept]))


def _ego_between(ego: EgoPath, start_s: float, end_s: float, where: str) -> EgoPath:
    inside = (ego.times_s >= start_s - _EGO_MARGIN_S) & (ego.times_s <= end_s + _EGO_MARGIN_S)
    if not inside.any():
        raise InputError("no vehicle pose lies in the time of the chosen frames", where=where)
    return EgoPath(ego.times_s[inside], ego.world_from_ego[inside])
