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

import io
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from PIL import Image, UnidentifiedImageError
from scipy.spatial.transform import Rotation

from mudg.base import log
from mudg.base.errors import InputError, UsageError
from mudg.base.geometry import CAM_FROM_EGO_AXES, transform_points, yaw_matrix, yaw_of
from mudg.base.palette import ID, UNLABELLED
from mudg.base.types import Camera, EgoPath, Scene, Shutter, Source, SweepPoints
from mudg.formats.importers import common
from mudg.formats.importers.common import ImportOptions, LogFiles
from mudg.formats.importers.drive_log import SceneContent, SceneImage, SceneSweep, write_scene
from mudg.formats.importers.images import ImageFit, Lens, brown_conrady, fit_images
from mudg.formats.importers.waymo import records
from mudg.formats.importers.waymo.logs import REQUIRED, ParquetLog, TfrecordLog
from mudg.formats.importers.waymo.records import CAMERAS, TOP, FrameRecord, LaserCalibration, Matrix, WaymoLog

LICENCE: Final = "Waymo Dataset License Agreement for Non-Commercial Use (non-commercial; attribution)"
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
    """Import a TFRecord file, one of a folder of them, or a log of a folder with the component folders of format 2.
    ``options.sequence``: a log's name or a part of it."""
    common.refuse_options(options, "Waymo", "poses", "boxes")
    if options.untwist == "no":
        what = "Waymo scans cannot be left twisted"
        expected = "auto or yes: points carry the pose they were measured at"
        raise UsageError(what, where="--untwist", got="no", remedy="leave it out", expected=expected)
    waymo = open_log(source, options)
    frames, notes = _usable_frames(waymo, options)
    cameras = _chosen_cameras(waymo, options, source)
    plan = _plan(waymo, frames, cameras, options, notes)
    moment, note = _moment_of_boxes(waymo, frames, plan)
    notes += [note] if note else []
    found, track_notes = records.build_tracks([plan.timed_boxes(frame, moment) for frame in frames])
    notes += track_notes
    numbers = {frame.number: index for index, frame in enumerate(frames)}

    items = ((frame, waymo.read(frame, cameras)) for frame in frames)

    def convert(item: tuple[FrameRecord, records.FrameContent]) -> Iterator[SceneImage | SceneSweep]:
        return _converted(plan, item[0], item[1], numbers[item[0].number])

    path = EgoPath(np.array([plan.pose_s(f) for f in frames]), np.stack([plan.world_from_vehicle(f) for f in frames]))
    origin = Source("waymo", LICENCE, None, tuple(notes))
    fits, tracks, total = plan.fits, lambda: (found, ()), len(frames)
    content = SceneContent(waymo.name, origin, fits, items, convert, lambda item: item[0].where, path, tracks, total)
    return write_scene(content, out, options)


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
    records = {path.stem: path for path in sorted(source.glob(f"*{_SUFFIX}"))}
    tables = sorted({path.stem for name in REQUIRED for path in (source / name).glob("*.parquet")})
    wanted, found = options.sequence, {name: (path, name) for name, path in records.items()}
    found = found or {name: (None, name) for name in tables}
    if wanted in found:
        return found[wanted]
    expected = f"*{_SUFFIX} files, or component folders: {', '.join(REQUIRED)}"
    return common.the_only(found, options, source, "Waymo log", expected, lambda name: wanted in name)


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
        some = ", ".join(str(frame.number) for frame, _ in missing[:8])
        notes.append(f"frames {some} lack images or scans and were left out")
    if not lasers:
        log.warn("waymo: no range images found: the scene has images only, and there is nothing to fuse")
        notes.append("no range images: images and boxes only")
    return [frame for frame, _ in complete], notes


# --- time, world, cameras -------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, eq=False)
class _Plan:
    """What is known before the bulky parts are read."""

    waymo: WaymoLog
    world_from_global: Matrix
    start_us: int
    """Zero of the scene's clock, microseconds of the epoch."""
    turn: TurnClock
    middle_s: Mapping[int, float]
    """Frame number -> seconds after the frame's timestamp to which the frame's pose belongs."""
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
        pose, time_s = middle_of_exposure(frame.shots[camera])
        world_from_cam = self.world_from_global @ pose @ vehicle_from_cam(self.waymo.cameras[camera])
        return world_from_cam, time_s - self.start_us / 1e6

    def timed_boxes(self, frame: FrameRecord, moment: records.Moment) -> records.TimedBoxes:
        """The frame's boxes with the times for which they hold."""
        late = np.zeros(len(frame.boxes))
        if moment == "start":
            late -= self.middle_s[frame.number]
        elif moment == "seen":
            late = self.seen_s(frame) - self.middle_s[frame.number]
        times = [middle_of_exposure(shot)[1] - self.start_us / 1e6 for shot in frame.shots.values()]
        images_s = (min(times), max(times)) if times else None
        return records.TimedBoxes(
            self.pose_s(frame), self.world_from_vehicle(frame), frame.boxes, late, frame.where, images_s
        )

    def seen_s(self, frame: FrameRecord) -> NDArray[np.float64]:
        """When the top LiDAR looked at each box, seconds after the timestamp; without one, the moment of the pose."""
        if TOP not in frame.lasers or not frame.boxes:
            return np.full(len(frame.boxes), self.middle_s[frame.number])
        centres = np.array([box.centre for box in frame.boxes])
        return self.turn.after_timestamp_s(turn_of_direction(centres, self.waymo.lasers[TOP]))


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
    place = f"({x!r}, {y!r}, {z!r})"
    notes.append(f"the world's origin is {place} in the data set's world, its x axis turned by {yaw!r} rad")
    turn = _measure_turn(waymo, frames)
    if turn.measured:
        start, duration = f"{turn.start_s * 1e3:.1f} ms", f"{turn.duration_s * 1e3:.1f} ms"
        notes.append(f"the top LiDAR's turns begin {start} after the timestamp and take {duration}")
    middles = {frame.number: _pose_moment(frame, turn) for frame in frames}
    assumed = sum(not exact for _, exact in middles.values())
    if assumed:
        notes.append(f"the pose of {assumed} frames is no image's: taken to belong to the middle of the LiDAR's turn")
    fits: dict[str, ImageFit] = {}
    for name in cameras:
        camera, lens = recorded_camera(waymo.cameras[name], first.shots[name])
        fits[name] = fit_images(camera, options, lens)
        notes += [fits[name].note] if fits[name].note else []
    rolling = sorted({waymo.cameras[name].direction for name, fit in fits.items() if fit.camera.readout_s > 0})
    if rolling:
        ways = ", ".join(DIRECTIONS[d] if 0 <= d < len(DIRECTIONS) else f"code {d}" for d in rolling)
        notes.append(f"shutters roll {ways}; a view is that of the middle of the exposure")
    middle_s = {number: value for number, (value, _) in middles.items()}
    return _Plan(waymo, world_from_global, start_us, turn, middle_s, fits)


def _pose_moment(frame: FrameRecord, turn: TurnClock) -> tuple[float, bool]:
    """When the vehicle was at the frame's pose, in seconds after the frame's timestamp, and whether that was recorded:
    an image with the same pose has its time. Without one, the middle of the LiDAR's turn is assumed."""
    for shot in frame.shots.values():
        if np.abs(shot.global_from_vehicle - frame.global_from_vehicle).max() < _SAME_POSE:
            return shot.pose_time_s - frame.timestamp_us / 1e6, True
    return float(turn.after_timestamp_s(np.array(0.5))), False


def _measure_turn(waymo: WaymoLog, frames: Sequence[FrameRecord]) -> TurnClock:
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
            found = measure_turn(poses, frames[index].timestamp_us / 1e6, times, places)
            turns += [found] if found is not None else []
    return median_clock(turns)


def _moment_of_boxes(waymo: WaymoLog, frames: Sequence[FrameRecord], plan: _Plan) -> tuple[records.Moment, str]:
    """For which moment the boxes of this log hold, by the points in the boxes of its fast objects; and a note."""
    boxes = [plan.timed_boxes(frame, "pose") for frame in frames]
    fast = [
        {box_id: v for box_id, v in speeds.items() if np.linalg.norm(v) >= records.FAST_M_S}
        for speeds in records.velocities(boxes)
    ]
    order = sorted(range(len(frames)), key=lambda index: -len(fast[index]))[:_MOMENT_FRAMES]
    counts = np.zeros(len(records.MOMENTS), np.int64)
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
                counts += records.points_inside(box, velocity, xyz, seen, float(late), plan.middle_s[frame.number])
    if not counts.any():
        return ("seen" if any(TOP in frame.lasers for frame in frames) else "pose"), ""
    moment = records.choose_moment(counts)
    texts = {"seen": "when the LiDAR passes them", "start": "at the timestamp", "pose": "at the frame's pose"}
    tallies = ", ".join(f"{count} {texts[name]}" for name, count in zip(records.MOMENTS, counts, strict=True))
    return moment, f"boxes hold {texts[moment]} (points that lie in boxes of fast objects if they do: {tallies})"


# --- writing --------------------------------------------------------------------------------------


def _converted(
    plan: _Plan, frame: FrameRecord, content: records.FrameContent, index: int
) -> Iterator[SceneImage | SceneSweep]:
    for name, fit in plan.fits.items():
        where = f"{frame.where}: image of camera {name}"
        labels: dict[str, NDArray[Any]] = {}
        if name in content.panoptic:
            panoptic = content.panoptic[name]
            ids = panoptic_ids(panoptic, fit.recorded, f"{where}: panoptic label")
            labels = panoptic_labels(fit.ids(ids), panoptic.divisor)
        pose, time_s = plan.taken(frame, name)
        yield SceneImage(name, index, time_s, pose, content.images[name], where, labels)
    for name, scan in content.scans.items():
        points, where = _points(plan, frame, name, scan), f"frame {frame.number}: LiDAR {name}"
        late_s = plan.dt_s(frame, points.turn) if name == TOP else np.zeros(len(points.turn))
        pose = plan.world_from_vehicle(frame) @ plan.waymo.lasers[name].vehicle_from_lidar
        sweep = sweep_points(points, late_s)
        yield SceneSweep(f"lidar_{name}", index, plan.pose_s(frame), pose, sweep, where)
        if points.without_pose:
            log.info(f"waymo: {where}: {points.without_pose} points have no pose and were left out")


def _points(plan: _Plan, frame: FrameRecord, name: str, scan: records.LaserScan) -> ScanPoints:
    return points_of_scan(scan, plan.waymo.lasers[name], frame.global_from_vehicle, f"{frame.where}: LiDAR {name}")


# --- sensors --------------------------------------------------------------------------------------
#
# A range image has a row per beam (the highest first) and a column per step of the turn. Column 0 looks backwards, the
# middle column along the vehicle's x axis, and time runs with the columns: the sensor turns clockwise seen from above
# (the side-left camera is triggered before the front one, the side-right one after). Azimuth is counter-clockwise in
# the LiDAR's own frame, whose x axis may point anywhere; the heading of that frame is taken off.
#
# The cameras' shutters roll from left to right within some 45 ms; scenes know one pose per image. That pose is the
# vehicle's at the moment the middle column was exposed: the recorded one, up to a few milliseconds older or newer,
# carried on with the recorded velocity. Source: the message description and the data set's conversion.
TURN_S: Final = 0.1
_MIN_MOTION_M: Final = 0.3
_MAX_FIT_ERROR_S: Final = 0.004
_CLOCK_ERROR_S: Final = 0.0025
_MIN_ROWS_SHARE: Final = 0.05
MAX_POSE_SHIFT_S: Final = 0.05
DIRECTIONS: Final = ("in an unknown direction", "downwards", "left to right", "upwards", "right to left", "not at all")
"""How a camera reads its image, by the data set's number."""
SHUTTERS: Final[Mapping[int, Shutter]] = {
    1: "top_to_bottom",
    2: "left_to_right",
    3: "bottom_to_top",
    4: "right_to_left",
}
"""The same as scenes say it; what is not here is unknown."""
GLOBAL_SHUTTER: Final = 5
EGO_CLASS: Final = 1
SKY_CLASS: Final = 25
TRAIN_IDS: Final[Mapping[int, int]] = {
    int(number): ID[name]
    for number, name in common.name_table(
        """car: 2; truck: 3, 5; bus: 4; bicycle: 6; motorcycle: 7; person: 9; rider: 10, 11; pole: 15; traffic sign: 17;
        traffic light: 18; building: 19; road: 20, 21, 22; sidewalk: 23; vegetation: 24; sky: 25"""
    ).items()
}
"""Class of a camera segmentation label -> train id. A cyclist is labelled together with the bicycle; other large
vehicles count as trucks. Without a counterpart, so unlabelled: undefined, own vehicle, trailer, bird, animal, cone,
carried object, other ground, other things."""


# --- range images ---------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, eq=False)
class ScanPoints:
    """Points of one turn in the LiDAR's frame at the frame's pose."""

    xyz: NDArray[np.float64]
    """f64[N, 3] metres."""
    intensity: NDArray[np.float32]
    """f32[N] as recorded, from 0 on without a limit."""
    turn: NDArray[np.float64]
    """f64[N], part of the turn (0..1) after which the point was measured."""
    without_pose: int
    """Points that were left out because no pose was recorded for their pixel."""


def points_of_scan(
    scan: records.LaserScan, laser: LaserCalibration, global_from_vehicle: Matrix, where: str
) -> ScanPoints:
    """All points of a scan, first returns and then second ones. Where pixels have poses of their own (top LiDAR), a
    point is carried from where the vehicle was when it was measured to where the vehicle was at the frame's pose. The
    other LiDARs are recorded as if all was measured at the frame's pose. Raises InputError: shapes that contradict each
    other, or values that are not finite."""
    shape = scan.returns[0].shape[:2]
    poses_of = [] if scan.poses is None else [scan.poses]
    if any(image.shape[:2] != shape for image in (*scan.returns, *poses_of)):
        raise InputError("range images of one scan differ in size", where=where, expected=str(list(shape)))
    rows, columns = shape
    inclination = laser.beam_inclinations(rows, where)
    turn = (np.arange(columns) + 0.5) / columns
    azimuth = np.pi - 2 * np.pi * turn - heading_of(laser)
    parts: list[tuple[NDArray, ...]] = []
    without_pose = 0
    for index, image in enumerate(scan.returns):
        pixel = np.flatnonzero(image[..., 0].reshape(-1) > 0)
        values = image.reshape(-1, image.shape[2])[pixel, :2]
        if not np.isfinite(values).all():
            what = "range image holds values that are not finite"
            got = f"{int((~np.isfinite(values).all(1)).sum())} of {len(values)} points"
            raise InputError(what, where=f"{where}: return {index + 1}", got=got)
        row, column = np.divmod(pixel, columns)
        reach = values[:, 0].astype(np.float64)
        flat = reach * np.cos(inclination)[row]
        xyz = np.stack(
            [flat * np.cos(azimuth)[column], flat * np.sin(azimuth)[column], reach * np.sin(inclination)[row]], 1
        )
        if scan.poses is not None:
            poses = scan.poses.reshape(-1, 6)[pixel]
            known = np.isfinite(poses).all(1) & (poses != 0).any(1)
            without_pose += int((~known).sum())
            values, column, poses = values[known], column[known], poses[known].astype(np.float64)
            xyz = _carried(xyz[known], poses, laser.vehicle_from_lidar, global_from_vehicle)
        parts.append((xyz, values[:, 1], turn[column]))
    xyz, intensity, turns = (np.concatenate(column) for column in zip(*parts, strict=True))
    return ScanPoints(xyz, intensity, turns, without_pose)


def heading_of(laser: LaserCalibration) -> float:
    """Angle of the LiDAR's x axis in the vehicle, radians counter-clockwise from forward."""
    return float(np.arctan2(laser.vehicle_from_lidar[1, 0], laser.vehicle_from_lidar[0, 0]))


def turn_of_direction(xyz_vehicle: NDArray[np.float64], laser: LaserCalibration) -> NDArray[np.float64]:
    """Part of the turn (0..1) at which the LiDAR looks towards points f64[N, 3] of the vehicle frame."""
    offset = xyz_vehicle[:, :2] - laser.vehicle_from_lidar[:2, 3]
    return (0.5 - np.arctan2(offset[:, 1], offset[:, 0]) / (2 * np.pi)) % 1.0


def _carried(
    xyz: NDArray[np.float64], poses: NDArray[np.float64], vehicle_from_lidar: Matrix, global_from_vehicle: Matrix
) -> NDArray[np.float64]:
    """Points of the LiDAR's frame, each with the pose (roll, pitch, yaw, x, y, z) of its moment, to the frame's moment.

    Rotations are about z, then y, then x of the vehicle. Positions are taken relative to the frame's pose first: they
    are tens of kilometres, and their differences centimetres.
    """
    x, y, z = (xyz @ vehicle_from_lidar[:3, :3].T + vehicle_from_lidar[:3, 3]).T
    (cr, cp, cy), (sr, sp, sy) = np.cos(poses[:, :3].T), np.sin(poses[:, :3].T)
    y, z = cr * y - sr * z, sr * y + cr * z
    x, z = cp * x + sp * z, cp * z - sp * x
    x, y = cy * x - sy * y, sy * x + cy * y
    moved = np.stack([x, y, z], 1) + (poses[:, 3:] - global_from_vehicle[:3, 3])
    in_vehicle = moved @ global_from_vehicle[:3, :3]
    return (in_vehicle - vehicle_from_lidar[:3, 3]) @ vehicle_from_lidar[:3, :3]


def sweep_points(points: ScanPoints, dt_s: NDArray[np.float64]) -> SweepPoints:
    """Points as a sweep holds them; tanh, as is customary, brings intensity, which has no limit, to 0..1."""
    intensity = np.tanh(np.maximum(points.intensity.astype(np.float64), 0))
    return SweepPoints(points.xyz.astype(np.float32), intensity.astype(np.float32), dt_s.astype(np.float32))


# --- time -----------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class TurnClock:
    """When the columns of the top LiDAR are measured: ``start_s`` after the frame's timestamp the turn begins, and
    lasts ``duration_s``. ``measured``: found by comparing pixel poses with the vehicle's path; else the nominal
    turn."""

    start_s: float = 0.0
    duration_s: float = TURN_S
    measured: bool = False

    def after_timestamp_s(self, turn: NDArray[np.float64]) -> NDArray[np.float64]:
        """Seconds after the frame's timestamp for parts of the turn (0..1)."""
        return self.start_s + turn * self.duration_s


def measure_turn(
    poses: NDArray[np.float32], timestamp_s: float, path_times_s: NDArray[np.float64], path_xyz: NDArray[np.float64]
) -> tuple[float, float] | None:
    """Start (after the timestamp) and duration of a turn from where the vehicle was when each column was measured.

    Args:
        poses: f32[H, W, 6], pixel poses of the frame.
        timestamp_s: of the frame.
        path_times_s, path_xyz: f64[T], f64[T, 3]: places of the vehicle at known times around the frame, in time order.

    Returns:
        Seconds, or None where the vehicle moves too little, or its path does not explain the columns.
    """
    known = (poses != 0).any(2) & np.isfinite(poses).all(2)
    columns = np.flatnonzero(known.sum(0) >= max(1, _MIN_ROWS_SHARE * len(known)))
    if len(columns) < 10 or len(path_times_s) < 3:
        return None
    places = np.stack([poses[known[:, c], c, 3:].astype(np.float64).mean(0) for c in columns])
    direction = path_xyz[-1] - path_xyz[0]
    length = float(np.linalg.norm(direction))
    if length < _MIN_MOTION_M:
        return None
    direction /= length
    along_path = (path_xyz - path_xyz[0]) @ direction
    along = (places - path_xyz[0]) @ direction
    inside = (along >= along_path[0]) & (along <= along_path[-1])
    if (np.diff(along_path) <= 0).any() or np.ptp(along) < _MIN_MOTION_M or inside.sum() < 10:
        return None
    times = np.interp(along[inside], along_path, path_times_s) - timestamp_s
    turn = (columns[inside] + 0.5) / poses.shape[1]
    duration, start = np.polyfit(turn, times, 1)
    error = float(np.sqrt(np.mean((start + duration * turn - times) ** 2)))
    if error > _MAX_FIT_ERROR_S or not 0.5 * TURN_S < abs(duration) < 2 * TURN_S:
        return None
    return float(start), float(duration)


def median_clock(turns: Sequence[tuple[float, float]]) -> TurnClock:
    """The clock of a log from the turns that could be measured.

    Where they agree with the nominal turn within what the measurement can tell, and without any, it is the nominal one.
    """
    if not turns:
        return TurnClock()
    start, duration = (float(value) for value in np.median(np.array(turns), axis=0))
    if max(abs(start), abs(start + duration - TURN_S)) <= _CLOCK_ERROR_S:
        return TurnClock()
    return TurnClock(start, duration, True)


# --- cameras --------------------------------------------------------------------------------------


def recorded_camera(calibration: records.CameraCalibration, shot: records.CameraShot) -> tuple[Camera, Lens | None]:
    """The camera as recorded, and its lens (None where the coefficients are all zero)."""
    fx, fy, cx, cy, *coefficients = calibration.intrinsic
    name, width, height = calibration.name, calibration.width, calibration.height
    readout = 0.0 if calibration.direction == GLOBAL_SHUTTER else readout_s(shot)
    shutter = SHUTTERS.get(calibration.direction, "global")
    camera = Camera(name, width, height, fx, fy, cx, cy, tuple(coefficients), readout, shutter)
    return camera, brown_conrady(*coefficients) if any(coefficients) else None


def readout_s(shot: records.CameraShot) -> float:
    """Time between the exposure of the first column and of the last one."""
    return max(0.0, shot.done_s - shot.trigger_s - shot.shutter_s) if shot.done_s else 0.0


def middle_of_exposure(shot: records.CameraShot) -> tuple[Matrix, float]:
    """Vehicle pose f64[4, 4] in the global frame when the middle column was exposed, and this time in seconds of the
    epoch.

    Without recorded exposure times or velocity, or where the two are far apart, pose and time are those recorded.
    """
    middle = (shot.trigger_s + shot.done_s) / 2 if shot.done_s else shot.pose_time_s
    late = middle - shot.pose_time_s
    if shot.velocity is None or not shot.done_s or abs(late) > MAX_POSE_SHIFT_S:
        return shot.global_from_vehicle, shot.pose_time_s
    pose = shot.global_from_vehicle.copy()
    pose[:3, :3] = Rotation.from_rotvec(shot.velocity[3:] * late).as_matrix() @ pose[:3, :3]
    pose[:3, 3] += shot.velocity[:3] * late
    return pose, middle


def vehicle_from_cam(calibration: records.CameraCalibration) -> Matrix:
    """Camera axes of this package (x right, y down, z forward) to the vehicle, f64[4, 4]."""
    return calibration.vehicle_from_camera @ CAM_FROM_EGO_AXES.T


def panoptic_ids(label: records.Panoptic, camera: Camera, where: str) -> NDArray[np.int32]:
    """Values of a panoptic label, i32[H, W]: class * divisor + instance. Raises InputError: no 16-bit PNG of the
    camera's size, or no divisor."""
    if label.divisor < 1:
        what = "panoptic label has no divisor"
        raise InputError(what, where=where, expected="a positive number", got=str(label.divisor))
    try:
        with Image.open(io.BytesIO(label.png), formats=("PNG",)) as image:
            if image.size != (camera.width, camera.height) or not image.mode.startswith("I"):
                what = "panoptic label is not a 16-bit image of its camera's size"
                got = f"{image.width}x{image.height}, mode {image.mode}"
                raise InputError(what, where=where, expected=f"{camera.width}x{camera.height}, 16 bits", got=got)
            return np.array(image).astype(np.int32)
    except (UnidentifiedImageError, Image.DecompressionBombError, OSError, SyntaxError, ValueError) as error:
        raise InputError("panoptic label cannot be decoded (is it cut off?)", where=where, got=str(error)) from error


def panoptic_labels(ids: NDArray[np.int32], divisor: int) -> dict[str, NDArray[Any]]:
    """Labels of one image: ``semantics`` u8[H, W] train ids, ``instance`` i32[H, W], ``sky`` and ``ego`` bool[H, W].

    An instance is called class * divisor + number, 0 where there is none: it means the same thing in this one image
    only.
    """
    classes, numbers = np.divmod(ids, divisor)
    table = np.full(256, UNLABELLED, np.uint8)
    table[list(TRAIN_IDS)] = list(TRAIN_IDS.values())
    return {
        "semantics": table[np.clip(classes, 0, 255)],
        "instance": np.where(numbers > 0, ids, 0).astype(np.int32),
        "sky": classes == SKY_CLASS,
        "ego": classes == EGO_CLASS,
    }
