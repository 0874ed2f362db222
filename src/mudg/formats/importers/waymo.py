"""Waymo Open Dataset importer: format 1 (one TFRecord file per log) and format 2 (Parquet files by component). What
becomes what, and when it holds: docs/formats/waymo.md, docs/reference/formats.md. A frame's timestamp is when the
top LiDAR began its turn, its pose belongs to the middle of the turn, as does the image recorded with the same pose."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from mudg.base import log
from mudg.base.errors import InputError
from mudg.base.palette import ID, UNLABELLED
from mudg.base.types import Camera, EgoPath, Scene, Shutter, Source, SweepPoints
from mudg.formats.importers import common
from mudg.formats.importers.common import ImportOptions, LogFiles
from mudg.formats.importers.drive_log import BoxTracks, SceneContent, SceneImage, SceneSweep, Tracks, write_scene
from mudg.formats.importers.images import ImageFit, Lens, brown_conrady, fit_images, image_notes
from mudg.formats.importers.waymo_logs import (
    CAMERAS,
    LABELS,
    REQUIRED,
    TOP,
    CameraCalibration,
    CameraShot,
    FrameContent,
    FrameRecord,
    LaserCalibration,
    LaserScan,
    Matrix,
    ParquetLog,
    TfrecordLog,
    WaymoLog,
)
from mudg.scene.labels import decode_grey

LICENCE: Final = "Waymo Dataset License Agreement for Non-Commercial Use (non-commercial; attribution)"
TURN_S: Final = 0.1
"""Duration of the top LiDAR's turn, which begins at the frame's timestamp."""
MAX_POSE_SHIFT_S: Final = 0.05
_SAME_POSE: Final = 1e-6
_SUFFIX: Final = ".tfrecord"
_GLOBAL_SHUTTER: Final = 5
_SHUTTERS: Final[Sequence[Shutter]] = ("global", "top_to_bottom", "left_to_right", "bottom_to_top", "right_to_left")
"""How a camera reads its image, by the data set's number; others are unknown."""
_EGO_CLASS: Final = 1
_SKY_CLASS: Final = 25
_TRAIN_IDS: Final[Mapping[int, int]] = {
    int(number): ID[name]
    for number, name in common.name_table(
        """car: 2; truck: 3, 5; bus: 4; bicycle: 6; motorcycle: 7; person: 9; rider: 10, 11; pole: 15; traffic sign: 17;
        traffic light: 18; building: 19; road: 20, 21, 22; sidewalk: 23; vegetation: 24; sky: 25"""
    ).items()
}
"""Class of a camera segmentation label -> train id. A cyclist is labelled together with the bicycle; other large
vehicles count as trucks. Without a counterpart, so unlabelled: undefined, own vehicle, trailer, bird, animal, cone,
carried object, other ground, other things."""


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
    common.refuse_options(options, "Waymo", "poses", "boxes", "untwist")
    record, segment = _find(source, options)
    waymo = TfrecordLog(record, options.frames) if record is not None else ParquetLog(source, segment, options.frames)
    there = {name: name for name in CAMERAS.values() if any(name in frame.shots for frame in waymo.frames)}
    cameras = common.chosen_cameras(there, options, str(source), tuple(CAMERAS.values()))
    lasers = sorted({name for frame in waymo.frames for name in frame.lasers})
    if without := [*({*cameras} - {*waymo.cameras}), *({*lasers} - {*waymo.lasers})]:
        got, expected = ", ".join(sorted(without)), f"those of {', '.join((*waymo.cameras, *waymo.lasers))}"
        raise InputError("sensors have data and no calibration", where=str(source), got=got, expected=expected)
    streams = {name: [frame.number for frame in waymo.frames if name in frame.shots] for name in cameras}
    streams |= {f"LiDAR {name}": [f.number for f in waymo.frames if name in f.lasers] for name in lasers}
    complete = set(common.complete_frames(streams, options, str(source), "waymo"))
    frames = [frame for frame in waymo.frames if frame.number in complete]
    if not lasers:
        log.warn("waymo: no range images found: the scene has images only, and there is nothing to fuse")
    plan = _Plan(waymo, frames, cameras, options)
    tracks, track_notes = plan.tracks()
    origin = Source("waymo", LICENCE, None, (*plan.notes, *track_notes))
    items = ((index, frame, waymo.read(frame, cameras)) for index, frame in enumerate(frames))
    path = EgoPath(np.array([plan.pose_s(f) for f in frames]), np.stack([plan.world_from_vehicle(f) for f in frames]))
    convert, item_name, found = (lambda item: plan.converted(*item)), (lambda item: item[1].where), (tracks, ())
    return write_scene(
        SceneContent(waymo.name, origin, plan.fits, items, convert, item_name, path, lambda: found, len(frames)),
        out,
        options,
    )


def files_of_waymo(source: Path, options: ImportOptions) -> LogFiles:
    """The chosen log's record file, or its tables."""
    record, segment = _find(source, options)
    return LogFiles((record,) if record is not None else tuple(sorted(source.glob(f"*/{segment}.parquet"))))


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


# --- time, world, cameras -------------------------------------------------------------------------


class _Plan:
    """What is known before the bulky parts are read. ``start_us``: zero of the scene's clock, microseconds of the
    epoch. ``middle_s``: frame number -> seconds after the frame's timestamp to which its pose belongs: those of the
    image with the same pose, else the middle of the turn."""

    def __init__(
        self, waymo: WaymoLog, frames: Sequence[FrameRecord], cameras: Sequence[str], options: ImportOptions
    ) -> None:
        self.waymo, self.frames, first = waymo, frames, frames[0]
        self.start_us, self.world_from_global = first.timestamp_us, common.world_from_first(first.global_from_vehicle)
        where = f"{waymo.name}, from frame {first.number}"
        common.seconds([frame.timestamp_us for frame in frames], "us", where, self.start_us)
        self.middle_s = dict.fromkeys((frame.number for frame in frames), TURN_S / 2)
        posed = {}
        for frame in frames:
            for shot in reversed([*frame.shots.values()]):
                if np.abs(shot.global_from_vehicle - frame.global_from_vehicle).max() < _SAME_POSE:
                    posed[frame.number] = shot.pose_time_s - frame.timestamp_us / 1e6
        self.middle_s |= posed
        self.fits: dict[str, ImageFit] = {}
        for name in cameras:
            camera, lens = recorded_camera(name, waymo.cameras[name], first.shots[name])
            self.fits[name] = fit_images(camera, options, lens)
        notes = [f"Waymo Open Dataset, {waymo.form}", common.origin_note(first.global_from_vehicle)]
        self.notes = [*notes, *image_notes(self.fits)]
        if not any(frame.lasers for frame in frames):
            self.notes.append("no range images: images and boxes only")
        if assumed := len(frames) - len(posed):
            words = "frames is no image's: taken to belong to the middle of the LiDAR's turn"
            self.notes.append(f"the pose of {assumed} {words}")
        if any(fit.camera.readout_s > 0 for fit in self.fits.values()):
            self.notes.append("shutters roll; a view is that of the middle of the exposure")

    def pose_s(self, frame: FrameRecord) -> float:
        """Time of the frame's pose, and so of its sweeps."""
        return (frame.timestamp_us - self.start_us) / 1e6 + self.middle_s[frame.number]

    def world_from_vehicle(self, frame: FrameRecord) -> Matrix:
        """The vehicle at the frame's pose."""
        return self.world_from_global @ frame.global_from_vehicle

    def converted(self, index: int, frame: FrameRecord, content: FrameContent) -> Iterator[SceneImage | SceneSweep]:
        """The images, labels and scans of a frame."""
        for name, fit in self.fits.items():
            where = f"{frame.where}: image of camera {name}"
            labels = {}
            if name in content.panoptic:
                labels = panoptic_labels(*content.panoptic[name], fit, f"{where}: panoptic label")
            pose, time_s = middle_of_exposure(frame.shots[name])
            pose = self.world_from_global @ pose @ self.waymo.cameras[name].vehicle_from_cam()
            yield SceneImage(name, index, time_s - self.start_us / 1e6, pose, content.images[name], where, labels)
        for name, scan in content.scans.items():
            laser, where = self.waymo.lasers[name], f"{frame.where}: LiDAR {name}"
            middle_s = self.middle_s[frame.number] if name == TOP else None
            points = points_of_scan(scan, laser, frame.global_from_vehicle, middle_s, where)
            pose = self.world_from_vehicle(frame) @ laser.vehicle_from_lidar
            yield SceneSweep(f"lidar_{name}", index, self.pose_s(frame), pose, points, where)

    def tracks(self) -> Tracks:
        """Tracks from the first image of their first frame to the last image of their last one: some hundredths of a
        second are added to either end with the object's velocity, or else images there would lack the object."""
        tracks = BoxTracks(self.frames[0].where, {label: label for label in LABELS.values()})
        images_s: dict[float, tuple[float, float]] = {}
        for frame in self.frames:
            time_s, middle_s = self.pose_s(frame), self.middle_s[frame.number]
            taken_s = [middle_of_exposure(shot)[1] - self.start_us / 1e6 for shot in frame.shots.values()] or [time_s]
            images_s[time_s] = min(taken_s), max(taken_s)
            for box_id, label, vehicle_from_box, size_m in frame.boxes:
                late_s = 0.0
                if TOP in frame.lasers:
                    place = vehicle_from_box[:2, 3] - self.waymo.lasers[TOP].vehicle_from_lidar[:2, 3]
                    turn = (0.5 - np.arctan2(place[1], place[0]) / (2 * np.pi)) % 1.0
                    late_s = float(turn * TURN_S - middle_s)
                # a track's name begins with no sign, as the data set's random ids may
                name, where = box_id if box_id[0].isalnum() else f"t{box_id}", f"{frame.where}: object {box_id}"
                pose = self.world_from_vehicle(frame) @ vehicle_from_box
                tracks.add(name, tracks.label_of(label), time_s, size_m, pose, late_s=late_s, where=where)
        return tracks.tracks(images_s=images_s)


# --- LiDARs ---------------------------------------------------------------------------------------
#
# A range image has a row per beam (the highest first) and a column per step of the turn. Column 0 looks backwards, the
# middle column along the vehicle's x axis, and time runs with the columns: the sensor turns clockwise seen from above
# (the side-left camera is triggered before the front one, the side-right one after). Azimuth is counter-clockwise in
# the LiDAR's own frame, whose x axis may point anywhere; the heading of that frame is taken off.


def points_of_scan(
    scan: LaserScan, laser: LaserCalibration, global_from_vehicle: Matrix, middle_s: float | None, where: str
) -> SweepPoints:
    """All points of a scan at the frame's pose, first returns and then second ones.

    Where pixels have poses of their own (top LiDAR), a point is carried from where the vehicle was when it was measured
    to where it was at the frame's pose; those without one are left out, and counted. The other LiDARs are recorded as
    if all was measured at the frame's pose. ``middle_s``: when that was, in seconds after the turn began; None: no
    times. Intensity, which has no limit, is brought to 0..1 by tanh, as is customary."""
    images = (*scan.returns, *([] if scan.poses is None else [scan.poses]))
    rows, columns = scan.returns[0].shape[:2]
    if any(image.shape[:2] != (rows, columns) for image in images):
        raise InputError("range images of one scan differ in size", where=where, expected=f"[{rows}, {columns}]")
    inclination = laser.inclination_of_rows(rows, where)
    turn = (np.arange(columns) + 0.5) / columns
    heading = float(np.arctan2(laser.vehicle_from_lidar[1, 0], laser.vehicle_from_lidar[0, 0]))
    azimuth = np.pi - 2 * np.pi * turn - heading
    late_s = np.zeros(columns) if middle_s is None else turn * TURN_S - middle_s
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
        xyz = np.c_[flat * np.cos(azimuth)[column], flat * np.sin(azimuth)[column], reach * np.sin(inclination)[row]]
        if scan.poses is not None:
            poses = scan.poses.reshape(-1, 6)[pixel]
            known = np.isfinite(poses).all(1) & (poses != 0).any(1)
            without_pose += int((~known).sum())
            values, column, poses = values[known], column[known], poses[known].astype(np.float64)
            xyz = _carried(xyz[known], poses, laser.vehicle_from_lidar, global_from_vehicle)
        intensity = np.tanh(np.maximum(values[:, 1].astype(np.float64), 0))
        parts.append((xyz, intensity, late_s[column]))
    xyz, intensity, dt_s = (np.concatenate(part).astype(np.float32) for part in zip(*parts, strict=True))
    return SweepPoints(xyz, intensity, dt_s, no_returns=without_pose)


def _carried(
    xyz: NDArray[np.float64], poses: NDArray[np.float64], vehicle_from_lidar: Matrix, global_from_vehicle: Matrix
) -> NDArray[np.float64]:
    """Points of the LiDAR's frame, each with the pose (roll, pitch, yaw, x, y, z) of its moment, to the frame's moment.

    Rotations are about z, then y, then x of the vehicle. Positions are taken relative to the frame's pose first: they
    are tens of kilometres, and their differences centimetres."""
    x, y, z = (xyz @ vehicle_from_lidar[:3, :3].T + vehicle_from_lidar[:3, 3]).T
    (cr, cp, cy), (sr, sp, sy) = np.cos(poses[:, :3].T), np.sin(poses[:, :3].T)
    y, z = cr * y - sr * z, sr * y + cr * z
    x, z = cp * x + sp * z, cp * z - sp * x
    x, y = cy * x - sy * y, sy * x + cy * y
    moved = np.stack([x, y, z], 1) + (poses[:, 3:] - global_from_vehicle[:3, 3])
    in_vehicle = moved @ global_from_vehicle[:3, :3]
    return (in_vehicle - vehicle_from_lidar[:3, 3]) @ vehicle_from_lidar[:3, :3]


# --- cameras --------------------------------------------------------------------------------------
#
# The cameras' shutters roll from left to right within some 45 ms; scenes know one pose per image. That pose is the
# vehicle's at the moment the middle column was exposed: the recorded one, up to a few milliseconds older or newer,
# carried on with the recorded velocity. Source: the message description and the data set's conversion.


def recorded_camera(name: str, calibration: CameraCalibration, shot: CameraShot) -> tuple[Camera, Lens | None]:
    """The camera as recorded, and its lens (None where the coefficients are all zero). The read-out is the time between
    the exposure of the first column and of the last one."""
    fx, fy, cx, cy, *coefficients = calibration.intrinsic
    rolls = shot.done_s and calibration.direction != _GLOBAL_SHUTTER
    readout_s = max(0.0, shot.done_s - shot.trigger_s - shot.shutter_s) if rolls else 0.0
    size = calibration.width, calibration.height
    shutter = _SHUTTERS[calibration.direction] if 0 < calibration.direction < len(_SHUTTERS) else "global"
    camera = Camera(name, *size, fx, fy, cx, cy, tuple(coefficients), readout_s, shutter)
    return camera, brown_conrady(*coefficients) if any(coefficients) else None


def middle_of_exposure(shot: CameraShot) -> tuple[Matrix, float]:
    """Vehicle pose f64[4, 4] in the global frame when the middle column was exposed, and this time in seconds of the
    epoch. Without recorded exposure times or velocity, or where the two are far apart, pose and time are those
    recorded."""
    middle = (shot.trigger_s + shot.done_s) / 2
    late = middle - shot.pose_time_s
    if shot.velocity is None or not shot.done_s or abs(late) > MAX_POSE_SHIFT_S:
        return shot.global_from_vehicle, shot.pose_time_s
    pose = shot.global_from_vehicle.copy()
    pose[:3, :3] = Rotation.from_rotvec(shot.velocity[3:] * late).as_matrix() @ pose[:3, :3]
    pose[:3, 3] += shot.velocity[:3] * late
    return pose, middle


def panoptic_labels(divisor: int, png: bytes, fit: ImageFit, where: str) -> dict[str, NDArray[Any]]:
    """Labels of one image by a 16-bit PNG of class * divisor + instance: ``semantics`` u8[H, W] train ids, ``instance``
    i32[H, W], ``sky`` and ``ego`` bool[H, W]. An instance is called as in the PNG, 0 where there is none: it means the
    same thing in this image only."""
    ids = fit.ids(decode_grey(png, where, (16,)).astype(np.int32))
    if divisor < 1:
        what, expected = "panoptic label has no divisor", "a positive number"
        raise InputError(what, where=where, expected=expected, got=str(divisor))
    classes, numbers = np.divmod(ids, divisor)
    table = np.full(256, UNLABELLED, np.uint8)
    table[list(_TRAIN_IDS)] = list(_TRAIN_IDS.values())
    return {
        "semantics": table[np.clip(classes, 0, 255)],
        "instance": np.where(numbers > 0, ids, 0).astype(np.int32),
        "sky": classes == _SKY_CLASS,
        "ego": classes == _EGO_CLASS,
    }
