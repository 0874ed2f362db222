"""Waymo Open Dataset importer: format 1 (one TFRecord file per log) and format 2 (Parquet files by component).

What becomes what:

=========== ============================================================================================================
images      five cameras (``front``, ``front_left``, ``front_right``, ``side_left``, ``side_right``), rectified; the
            view is the one of the middle column's exposure
labels      panoptic labels, where an image has them: ``semantics``, ``instance``, ``sky``, ``ego``
scans       five LiDARs (``lidar_top``, ``lidar_front``, ...), both returns, at the frame's pose; ``dt_s`` for the top
            one
boxes       3D boxes as tracks, carried to the moment of the frame's pose (``tracks``)
world       z up, origin and x axis at the vehicle's pose of the first imported frame; the offset stands in the scene's
            notes
time        seconds since the first imported frame's timestamp
=========== ============================================================================================================

A frame's timestamp is when the top LiDAR began its turn; the frame's pose belongs to the middle of the turn. Its time
is that of the image recorded with the same pose (the front camera's).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from mudg.base import log
from mudg.base.errors import InputError, UsageError
from mudg.base.geometry import transform_points, yaw_matrix, yaw_of
from mudg.base.types import EgoPath, Scene, Source
from mudg.formats.importers import common
from mudg.formats.importers.common import ImportOptions, LogFiles
from mudg.formats.importers.drive_log import SceneContent, SceneImage, SceneSweep, write_scene
from mudg.formats.importers.images import ImageFit, fit_images
from mudg.formats.importers.waymo import records as tracks
from mudg.formats.importers.waymo import sensors
from mudg.formats.importers.waymo.logs import REQUIRED, ParquetLog, TfrecordLog
from mudg.formats.importers.waymo.records import (
    CAMERAS,
    TOP,
    FrameContent,
    FrameRecord,
    LaserScan,
    Matrix,
    Moment,
    TimedBoxes,
    WaymoLog,
)

LICENCE: Final = "Waymo Dataset License Agreement for Non-Commercial Use (non-commercial; attribution)"
DOUBTFUL_PROJECTION_PX: Final = 30.0
"""Our projections of points differ from the recorded ones by a few pixels; a median above this gives a warning."""

_SAME_POSE: Final = 1e-6
_CLOCK_FRAMES: Final = 3
_MOMENT_FRAMES: Final = 4
_SUFFIX: Final = ".tfrecord"


def looks_like_waymo(source: Path) -> bool:
    """Whether ``source`` is a TFRecord file, a folder of such files, or a folder of format-2 components."""
    if source.is_file():
        return source.suffix == _SUFFIX
    return source.is_dir() and (
        any((source / name).is_dir() for name in ("camera_image", "lidar_box"))
        or next(source.glob(f"*{_SUFFIX}"), None) is not None
    )


def import_waymo(source: Path, out: Path, options: ImportOptions) -> Scene:
    """Import a Waymo log into the scene directory ``out``; see the module text for what is understood. Raises
    UsageError: several logs and none was chosen, or an option that this format cannot honour. InputError: something is
    missing, damaged or contradictory; nothing is left at ``out``.

    Args:
        source: a TFRecord file, a folder of them, or a folder with the component folders of format 2.
        out: scene directory to make.
        options: ``sequence`` chooses a log where there are several, by its name or a part of it.
    """
    _refuse_options(options)
    waymo = open_log(source, options)
    frames, notes = _usable_frames(waymo, options)
    cameras = _chosen_cameras(waymo, options, source)
    plan = _plan(waymo, frames, cameras, options, notes)
    moment, note = _moment_of_boxes(waymo, frames, plan)
    notes += [note] if note else []
    found, track_notes = tracks.build_tracks([plan.timed_boxes(frame, moment) for frame in frames])
    notes += track_notes
    check = _check_projections(waymo, frames, cameras, plan)
    notes += [check] if check else []
    numbers = {frame.number: index for index, frame in enumerate(frames)}

    def items() -> Iterator[tuple[FrameRecord, FrameContent]]:
        return ((frame, waymo.read(frame, cameras)) for frame in frames)

    def convert(item: tuple[FrameRecord, FrameContent]) -> Iterator[SceneImage | SceneSweep]:
        return _converted(plan, item[0], item[1], numbers[item[0].number])

    path = EgoPath(np.array([plan.pose_s(f) for f in frames]), np.stack([plan.world_from_vehicle(f) for f in frames]))
    origin = Source("waymo", LICENCE, None, tuple(notes))
    content = SceneContent(
        waymo.name,
        origin,
        plan.fits,
        items(),
        convert,
        lambda item: item[0].where,
        path,
        lambda: (found, ()),
        len(frames),
    )
    return write_scene(content, out, options)


def _refuse_options(options: ImportOptions) -> None:
    common.refuse_options(options, "Waymo", "poses", "boxes")
    if options.untwist == "no":
        what = "Waymo scans cannot be left twisted"
        expected = "auto or yes: points carry the pose they were measured at"
        raise UsageError(what, where="--untwist", got="no", remedy="leave it out", expected=expected)


def files_of_waymo(source: Path, options: ImportOptions) -> LogFiles:
    """The chosen log's record file, or its tables."""
    record, segment = _find(source, options)
    return LogFiles((record,) if record is not None else tuple(sorted(source.glob(f"*/{segment}.parquet"))))


# --- finding the log ------------------------------------------------------------------------------


def open_log(source: Path, options: ImportOptions) -> WaymoLog:
    """The log that ``source`` and ``options.sequence`` name, its facts read and checked. Raises UsageError: there are
    several, and none or more than one was meant. InputError: there is none, or it is damaged."""
    record, segment = _find(source, options)
    return TfrecordLog(record, options.frames) if record is not None else ParquetLog(source, segment, options.frames)


def _find(source: Path, options: ImportOptions) -> tuple[Path | None, str]:
    """The record file of the chosen log, or None and the name of its tables."""
    if source.is_file():
        return source, ""
    if not source.is_dir():
        raise InputError("Waymo log does not exist", where=str(source), expected="a TFRecord file or a folder")
    records = {path.stem: path for path in sorted(source.glob(f"*{_SUFFIX}"))}
    segments = records or sorted({path.stem for name in REQUIRED for path in (source / name).glob("*.parquet")})
    if not segments:
        expected = f"*{_SUFFIX} files, or component folders: {', '.join(REQUIRED)}"
        raise InputError("no Waymo log found", where=str(source), got=common.folder_contents(source), expected=expected)
    matching = [name for name in segments if name == options.sequence] or [n for n in segments if options.sequence in n]
    name = common.the_only(matching, matching or list(segments), options, source, "log")
    return records.get(name), name


def _chosen_cameras(waymo: WaymoLog, options: ImportOptions, source: Path) -> list[str]:
    recorded = {name for frame in waymo.frames for name in frame.shots}
    there = {name: name for name in CAMERAS.values() if name in recorded}
    if not there:
        what, got = "the log has no images", f"{len(waymo.frames)} frames with poses and boxes only"
        remedy = "take the files with camera and LiDAR data"
        raise InputError(what, where=str(source), expected="images of the cameras", got=got, remedy=remedy)
    chosen = common.chosen_cameras(there, options, str(source), tuple(there))
    lacking = [name for name in chosen if name not in waymo.cameras]
    if lacking:
        what, got = "cameras have images and no calibration", ", ".join(lacking)
        expected = ", ".join(waymo.cameras) or "a calibration for each"
        raise InputError(what, where=str(source), got=got, expected=expected, remedy="choose others with --cameras")
    return chosen


def _usable_frames(waymo: WaymoLog, options: ImportOptions) -> tuple[list[FrameRecord], list[str]]:
    """Frames that have what the others have, and notes."""
    cameras = {name for frame in waymo.frames for name in frame.shots}
    cameras = cameras & set(options.cameras) if options.cameras else cameras
    lasers = sorted({name for frame in waymo.frames for name in frame.lasers})
    without = [name for name in lasers if name not in waymo.lasers]
    if without:
        what, expected = "LiDARs have scans and no calibration", ", ".join(waymo.lasers) or "a calibration for each"
        raise InputError(what, where=waymo.frames[0].where, got=", ".join(without), expected=expected)
    complete, missing = [], []
    for frame in waymo.frames:
        lack = sorted(cameras - set(frame.shots)) + [f"LiDAR {name}" for name in lasers if name not in frame.lasers]
        (missing if lack else complete).append((frame, lack))
    if missing and not options.skip_missing:
        frame, lack = missing[0]
        got = f"no {', '.join(lack)}" + (f"; {len(missing)} frames in all" if len(missing) > 1 else "")
        expected, remedy = "what the other frames have", "choose frames with --frames FIRST:END, or add --skip-missing"
        raise InputError("frame lacks images or scans", where=frame.where, got=got, expected=expected, remedy=remedy)
    if not complete:
        what = "no frame is complete"
        raise InputError(what, where=waymo.frames[0].where, got=f"the first has no {', '.join(missing[0][1])}")
    notes = [f"Waymo Open Dataset, {waymo.form}" + (f"; {waymo.conditions}" if waymo.conditions else "")]
    if missing:
        notes.append(
            f"frames {', '.join(str(frame.number) for frame, _ in missing[:8])} lack images or scans and were left out"
        )
    if not lasers:
        log.warn("waymo: no range images found: the scene has images only, and there is nothing to fuse")
        notes.append("no range images: images and boxes only")
    return [frame for frame, _ in complete], notes


# --- time, world, cameras -------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, eq=False)
class _Plan:
    """What is known before the bulky parts are read.

    Args:
        world_from_global: f64[4, 4].
        start_us: zero of the scene's clock, microseconds of the epoch.
        turn: when the columns of the top LiDAR were measured.
        middle_s: frame number -> seconds after the frame's timestamp to which the frame's pose belongs.
        fits: camera name -> what happens to its images.
    """

    waymo: WaymoLog
    world_from_global: Matrix
    start_us: int
    turn: sensors.TurnClock
    middle_s: Mapping[int, float]
    fits: Mapping[str, ImageFit]

    def pose_s(self, frame: FrameRecord) -> float:
        """Time of the frame's pose, and so of its sweeps."""
        return (frame.timestamp_us - self.start_us) / 1e6 + self.middle_s[frame.number]

    def world_from_vehicle(self, frame: FrameRecord) -> Matrix:
        """The vehicle at the frame's pose."""
        return self.world_from_global @ frame.global_from_vehicle

    def dt_s(self, frame: FrameRecord, turn: NDArray[np.float64]) -> NDArray[np.float64]:
        """Seconds after ``pose_s`` at parts of the top LiDAR's turn (0..1)."""
        return self.turn.after_timestamp_s(turn) - self.middle_s[frame.number]

    def taken(self, frame: FrameRecord, camera: str) -> tuple[Matrix, float]:
        """Where an image was taken (world from camera, f64[4, 4]), and when in the scene's clock."""
        pose, time_s = sensors.middle_of_exposure(frame.shots[camera])
        world_from_cam = self.world_from_global @ pose @ sensors.vehicle_from_cam(self.waymo.cameras[camera])
        return world_from_cam, time_s - self.start_us / 1e6

    def timed_boxes(self, frame: FrameRecord, moment: Moment) -> TimedBoxes:
        """The frame's boxes with the times for which they hold."""
        late = np.zeros(len(frame.boxes))
        if moment == "start":
            late -= self.middle_s[frame.number]
        elif moment == "seen":
            late = self.seen_s(frame) - self.middle_s[frame.number]
        times = [sensors.middle_of_exposure(shot)[1] - self.start_us / 1e6 for shot in frame.shots.values()]
        images_s = (min(times), max(times)) if times else None
        return TimedBoxes(self.pose_s(frame), self.world_from_vehicle(frame), frame.boxes, late, frame.where, images_s)

    def seen_s(self, frame: FrameRecord) -> NDArray[np.float64]:
        """When the top LiDAR looked at each box, seconds after the timestamp; without one, the moment of the frame's
        pose."""
        if TOP not in frame.lasers or not frame.boxes:
            return np.full(len(frame.boxes), self.middle_s[frame.number])
        centres = np.array([box.centre for box in frame.boxes])
        return self.turn.after_timestamp_s(sensors.turn_of_direction(centres, self.waymo.lasers[TOP]))


def _plan(
    waymo: WaymoLog, frames: Sequence[FrameRecord], cameras: Sequence[str], options: ImportOptions, notes: list[str]
) -> _Plan:
    first = frames[0]
    start_us = first.timestamp_us
    common.seconds([f.timestamp_us for f in frames], "us", f"{waymo.name}, from frame {first.number}", start_us)
    place = first.global_from_vehicle[:3, 3]
    yaw = yaw_of(first.global_from_vehicle)
    world_from_global = yaw_matrix(-yaw)
    world_from_global[:3, 3] = -(world_from_global[:3, :3] @ place)
    x, y, z = (float(v) for v in place)
    notes.append(
        f"the world's origin is ({x!r}, {y!r}, {z!r}) in the data set's world, its x axis turned by {yaw!r} rad"
    )
    turn = _measure_turn(waymo, frames)
    if turn.measured:
        notes.append(
            f"the top LiDAR's turns begin {turn.start_s * 1e3:.1f} ms after the timestamp and take"
            f" {turn.duration_s * 1e3:.1f} ms"
        )
    middles = {frame.number: _pose_moment(frame, turn) for frame in frames}
    assumed = sum(not exact for _, exact in middles.values())
    if assumed:
        notes.append(f"the pose of {assumed} frames is no image's: taken to belong to the middle of the LiDAR's turn")
    fits: dict[str, ImageFit] = {}
    for name in cameras:
        camera, lens = sensors.recorded_camera(waymo.cameras[name], first.shots[name])
        fits[name] = fit_images(camera, options, lens)
        notes += [fits[name].note] if fits[name].note else []
    rolling = sorted({waymo.cameras[name].direction for name, fit in fits.items() if fit.camera.readout_s > 0})
    if rolling:
        ways = ", ".join(sensors.DIRECTIONS[d] if 0 <= d < len(sensors.DIRECTIONS) else f"code {d}" for d in rolling)
        notes.append(f"shutters roll {ways}; a view is that of the middle of the exposure")
    return _Plan(
        waymo, world_from_global, start_us, turn, {number: value for number, (value, _) in middles.items()}, fits
    )


def _pose_moment(frame: FrameRecord, turn: sensors.TurnClock) -> tuple[float, bool]:
    """When the vehicle was at the frame's pose, in seconds after the frame's timestamp, and whether that was recorded.

    An image with the same pose has its time. Without one, the middle of the LiDAR's turn is assumed.
    """
    for shot in frame.shots.values():
        if np.abs(shot.global_from_vehicle - frame.global_from_vehicle).max() < _SAME_POSE:
            return shot.pose_time_s - frame.timestamp_us / 1e6, True
    return float(turn.after_timestamp_s(np.array(0.5))), False


def _measure_turn(waymo: WaymoLog, frames: Sequence[FrameRecord]) -> sensors.TurnClock:
    """The top LiDAR's timing, from the frames during which the vehicle moved most."""
    moved = [
        (float(np.linalg.norm(after.global_from_vehicle[:3, 3] - before.global_from_vehicle[:3, 3])), index + 1)
        for index, (before, after) in enumerate(zip(frames[1:-1], frames[2:], strict=True))
        if TOP in before.lasers
    ]
    turns = []
    for index in sorted(index for _, index in sorted(moved, reverse=True)[:_CLOCK_FRAMES]):
        shots = [shot for frame in frames[index - 1 : index + 2] for shot in frame.shots.values()]
        path = {shot.pose_time_s: shot.global_from_vehicle[:3, 3] for shot in shots}
        times = np.array(sorted(path))
        poses = waymo.pixel_poses(frames[index])
        if poses is not None:
            places = np.stack([path[time] for time in times])
            found = sensors.measure_turn(poses, frames[index].timestamp_us / 1e6, times, places)
            turns += [found] if found is not None else []
    return sensors.median_clock(turns)


def _moment_of_boxes(waymo: WaymoLog, frames: Sequence[FrameRecord], plan: _Plan) -> tuple[Moment, str]:
    """For which moment the boxes of this log hold, by the points in the boxes of its fast objects; and a note."""
    boxes = [plan.timed_boxes(frame, "pose") for frame in frames]
    fast = [
        {box_id: v for box_id, v in speeds.items() if np.linalg.norm(v) >= tracks.FAST_M_S}
        for speeds in tracks.velocities(boxes)
    ]
    order = sorted(range(len(frames)), key=lambda index: -len(fast[index]))[:_MOMENT_FRAMES]
    counts = np.zeros(len(tracks.MOMENTS), np.int64)
    for index in sorted(order):
        frame = frames[index]
        if not fast[index] or TOP not in frame.lasers:
            continue
        points = _points(plan, frame, TOP, waymo.read(frame, ()).scans[TOP])
        xyz = transform_points(waymo.lasers[TOP].vehicle_from_lidar, points.xyz)
        seen = plan.turn.after_timestamp_s(points.turn)
        rotation = plan.world_from_vehicle(frame)[:3, :3]
        for box, late in zip(frame.boxes, plan.seen_s(frame), strict=True):
            if box.id in fast[index]:
                velocity = fast[index][box.id] @ rotation
                counts += tracks.points_inside(box, velocity, xyz, seen, float(late), plan.middle_s[frame.number])
    if not counts.any():
        return ("seen" if any(TOP in frame.lasers for frame in frames) else "pose"), ""
    moment = tracks.choose_moment(counts)
    texts = {"seen": "when the LiDAR passes them", "start": "at the timestamp", "pose": "at the frame's pose"}
    tallies = ", ".join(f"{count} {texts[name]}" for name, count in zip(tracks.MOMENTS, counts, strict=True))
    return moment, f"boxes hold {texts[moment]} (points that lie in boxes of fast objects if they do: {tallies})"


# --- writing --------------------------------------------------------------------------------------


def _converted(plan: _Plan, frame: FrameRecord, content: FrameContent, index: int) -> Iterator[SceneImage | SceneSweep]:
    for name, fit in plan.fits.items():
        where = f"{frame.where}: image of camera {name}"
        labels: dict[str, NDArray[Any]] = {}
        if name in content.panoptic:
            panoptic = content.panoptic[name]
            ids = sensors.panoptic_ids(panoptic, fit.recorded, f"{where}: panoptic label")
            labels = sensors.panoptic_labels(fit.ids(ids), panoptic.divisor)
        pose, time_s = plan.taken(frame, name)
        yield SceneImage(name, index, time_s, pose, content.images[name], where, labels)
    for name, scan in content.scans.items():
        points, where = _points(plan, frame, name, scan), f"frame {frame.number}: LiDAR {name}"
        late_s = plan.dt_s(frame, points.turn) if name == TOP else np.zeros(len(points.turn))
        pose = plan.world_from_vehicle(frame) @ plan.waymo.lasers[name].vehicle_from_lidar
        sweep = sensors.sweep_points(points, late_s)
        yield SceneSweep(f"lidar_{name}", index, plan.pose_s(frame), pose, sweep, where)
        if points.without_pose:
            log.info(f"waymo: {where}: {points.without_pose} points have no pose and were left out")


def _points(plan: _Plan, frame: FrameRecord, name: str, scan: LaserScan) -> sensors.ScanPoints:
    return sensors.points_of_scan(
        scan, plan.waymo.lasers[name], frame.global_from_vehicle, f"{frame.where}: LiDAR {name}"
    )


def _check_projections(waymo: WaymoLog, frames: Sequence[FrameRecord], cameras: Sequence[str], plan: _Plan) -> str:
    """Compare our projections of the first frame's points with those recorded; a note, empty if there are none."""
    frame = frames[0]
    if not frame.lasers:
        return ""
    shots = {name: (waymo.cameras[name], sensors.middle_of_exposure(frame.shots[name])[0]) for name in cameras}
    errors: dict[str, list[NDArray[np.float64]]] = {}
    for name, scan in waymo.read(frame, (), projections=True).scans.items():
        found = sensors.projection_errors(
            _points(plan, frame, name, scan), scan, waymo.lasers[name], frame.global_from_vehicle, shots
        )
        for camera, off in found.items():
            errors.setdefault(camera, []).append(off)
    medians = {camera: float(np.median(np.concatenate(off))) for camera, off in errors.items()}
    if not medians:
        return ""
    texts = ", ".join(f"{camera} {median:.1f} px" for camera, median in medians.items())
    if max(medians.values()) > DOUBTFUL_PROJECTION_PX:
        log.warn(
            f"waymo: points do not fall where the log says they do ({texts}, median); are calibrations and poses of"
            " this log?"
        )
    return f"points fall where the log says they do, up to (median, first frame): {texts}"
