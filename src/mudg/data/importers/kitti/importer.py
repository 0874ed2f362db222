"""KITTI importer: raw drives, odometry and tracking sequences, single object frames.

What is read (the parts that are there are found by looking, and each choice is said aloud):

=========== =============================================================================================
images      ``image_02/data``, ``image_02``, ``image_2``, or ``image_02/<sequence>``
scans       ``velodyne_points/data``, ``velodyne``, or ``velodyne/<sequence>``
calibration ``calib.txt``, ``calib/<frame or sequence>.txt``, or the day's ``calib_*_to_*.txt`` here or one folder up
poses       ``oxts/data`` (raw) or ``oxts/<sequence>.txt``; ``poses.txt``; ``poses_velo.txt``; ``poses_cam0.txt``; also in ``derived/``
boxes       ``tracklet_labels.xml``; ``label_02.txt`` or ``label_02/<sequence>.txt``, also in ``derived/``; ``label_2/<frame>.txt``
times       ``timestamps.txt`` per sensor, ``times.txt``; without them 10 Hz is assumed, and said
=========== =============================================================================================

Frames. World: z up, origin and x axis at the first ego pose. The ego frame is the IMU where there is GPS/IMU data, else
the velodyne. Camera ``image_02`` is called ``front``.

Scans of raw drives are distorted by the vehicle's motion. They are untwisted here when poses come from GPS/IMU packets: the
sensor turns counter-clockwise in 0.1 s and faces forward at the scan's time, so a point at azimuth a was measured a / 2 pi
turns later, and ``dt_s`` says so. The odometry, tracking and object benchmarks document their scans as compensated; those
keep ``dt_s`` = 0.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from mudg.base import log, store
from mudg.base.errors import InputError, UsageError
from mudg.base.geometry import invert, transform_points
from mudg.base.types import EgoPath, Scene, Source, SweepPoints, Track, View
from mudg.data.importers.clouds import read_float_rows
from mudg.data.importers.common import for_each, pose_near, seconds
from mudg.data.importers.images import ImageFit, fit_images
from mudg.data.importers.kitti import boxes as kitti_boxes
from mudg.data.importers.kitti import poses as kitti_poses
from mudg.data.importers.kitti.calib import KittiCalibration, read_calibration_day, read_calibration_text
from mudg.data.importers.layout import LogFiles, chosen_cameras, numbered_files, some_numbers, whole_frames
from mudg.data.importers.options import ImportOptions, holdout_split
from mudg.data.scene import SceneWriter, decode_image

Matrix = NDArray[np.float64]
FRAME_PERIOD_S: Final = 0.1
SENSOR: Final = "velodyne"
LICENCE: Final = "CC BY-NC-SA 3.0 (KITTI: Geiger, Lenz, Stiller, Urtasun; attribution, non-commercial, share-alike)"
CAMERA_NAMES: Final = {"image_02": "front", "image_03": "front_stereo", "image_00": "grey", "image_01": "grey_stereo"}
_TURN_STEPS: Final = 36


@dataclass(frozen=True, slots=True)
class KittiFiles:
    """What was found where.

    Args:
        images: scene camera name -> frame number -> file.
        numbers: scene camera name -> KITTI camera number.
        scans: frame number -> file; may be empty.
        folders: folders searched for poses, boxes and times, nearest first.
        single: one frame of the object benchmark, without a clock or motion.
    """

    images: Mapping[str, Mapping[int, Path]]
    numbers: Mapping[str, int]
    scans: Mapping[int, Path]
    folders: tuple[Path, ...]
    single: bool


def looks_like_kitti(source: Path) -> bool:
    """Whether ``source`` is the folder of a KITTI drive, sequence, training set or single frame."""
    if not source.is_dir():
        return False
    if any((source / name).is_dir() for name in ("image_02", "image_2", "image_00", "velodyne_points")):
        return True
    record = source / "info.json"
    if not record.is_file() or not any(path.suffix == ".bin" for path in source.iterdir()):
        return False
    with record.open("rb") as handle:
        return b'"CAM2"' in handle.read(1 << 16)


def import_kitti(source: Path, out: Path, options: ImportOptions) -> Scene:
    """Import a KITTI recording into the scene directory ``out``; see the module text for what is understood.

    Raises:
        UsageError: the folder holds several recordings and none was chosen.
        InputError: something is missing, malformed or contradictory; nothing is left at ``out``.
    """
    if not source.is_dir():
        raise InputError("KITTI folder does not exist", where=str(source), expected="a folder")
    if (source / "info.json").is_file() and not any((source / name).is_dir() for name in ("image_02", "image_2")):
        from mudg.data.importers.kitti.info import import_info_frame

        return import_info_frame(source, out, options)
    files = find_files(source, options)
    frames = _choose_frames(files, options, source)
    notes: list[str] = []
    calibration = _find_calibration(source, files, frames, options)
    clock = _Clock.find(files, frames, notes)
    motion = _find_motion(files, frames, clock, calibration, options, notes)
    world_from_velo = {n: motion.velo_at(clock.scan_s[n]) for n in frames}
    tracks, track_notes = _find_tracks(files, frames, calibration, world_from_velo, clock, options, motion)
    notes += track_notes
    if frames != list(range(len(frames))):
        notes.append(f"source frames {frames[0]} to {frames[-1]} are frames 0 to {len(frames) - 1} here")
    fits = _fit_cameras(files, calibration, frames, options)
    notes += [fit.words for fit in fits.values() if fit.words]
    for note in notes:
        log.info(f"kitti: {note}")
    origin = Source("kitti", LICENCE, None, tuple(notes))
    with SceneWriter(out, source.resolve().name, origin) as writer:
        for fit in fits.values():
            writer.add_camera(fit.camera)

        def convert(item: tuple[int, int]) -> None:
            index, number = item
            for name, fit in fits.items():
                time_s = clock.image_s[name][number]
                view = View(fit.camera, motion.velo_at(time_s) @ calibration.velo_from_cam(files.numbers[name]), time_s)
                writer.add_frame(f"{name}/{index:06d}", view, fit.image(files.images[name][number]))
            if number in files.scans:
                points = read_scan(files.scans[number])
                if motion.untwist:
                    points = untwist_scan(points, motion.velo_at, clock.scan_s[number])
                writer.add_sweep(f"{SENSOR}/{index:06d}", SENSOR, clock.scan_s[number], world_from_velo[number], points)

        for_each(
            list(enumerate(frames)), convert, workers=options.workers, title="importing KITTI",
            name=lambda item: f"frame {item[1]}",
        )  # fmt: skip
        for track in tracks:
            writer.add_track(track)
        writer.set_ego(motion.ego)
        moments = [[f"{name}/{index:06d}" for name in fits] for index in range(len(frames))]
        writer.set_split(holdout_split(moments, options.test_every))
        return writer.finish()


def files_of_kitti(source: Path, options: ImportOptions) -> LogFiles:
    """The folder, with the calibration and poses beside it; of a folder with many sequences or frames only what is chosen."""
    beside = [*source.parent.glob("calib_*.txt"), *_odometry_poses(source)]
    beside = [path for path in beside if path.is_file()]
    wanted = options.sequence
    number = int(wanted) if wanted.isdigit() else -1
    chosen = [
        path
        for path in (sorted(source.glob("*/*")) if wanted else ())
        if path.stem == wanted or (path.stem.isdigit() and int(path.stem) == number)
    ]
    if not chosen:
        return LogFiles((source, *sorted(beside)))
    here = [path for path in sorted(source.iterdir()) if path.is_file() or path.name == "derived"]
    return LogFiles((*chosen, *here, *sorted(beside)))


# --- finding files --------------------------------------------------------------------------------------------------


def find_files(source: Path, options: ImportOptions) -> KittiFiles:
    """Find images and scans of one recording below ``source``."""
    single = (source / "image_2").is_dir() and (source / "calib").is_dir() and not (source / "times.txt").is_file()
    sequence = "" if single else options.sequence
    images: dict[str, dict[int, Path]] = {}
    numbers: dict[str, int] = {}
    for folder, name in CAMERA_NAMES.items():
        short = folder.replace("_0", "_")
        for candidate in (source / folder / "data", source / folder / sequence, source / short / sequence):
            found = numbered_files(candidate, (".png", ".jpg", ".jpeg"))
            if found:
                images[name], numbers[name] = found, int(folder[-1])
                break
    if not images:
        _refuse_without_images(source, sequence)
    folder_of = {name: f"image_0{number}" for name, number in numbers.items()}
    usual = folder_of.get("front", next(iter(folder_of.values())))
    chosen = chosen_cameras({folder: name for name, folder in folder_of.items()}, options, str(source), (usual,))
    wanted = [CAMERA_NAMES[folder] for folder in chosen]
    scans: dict[int, Path] = {}
    for candidate in (source / "velodyne_points" / "data", source / "velodyne" / sequence):
        scans = scans or numbered_files(candidate, (".bin",))
    folders = (source, source / "derived")
    return KittiFiles(
        {name: images[name] for name in wanted}, {name: numbers[name] for name in wanted}, scans, folders, single
    )


def _refuse_without_images(source: Path, sequence: str) -> None:
    sequences = sorted(
        p.name
        for folder in ("image_02", "image_2")
        if (source / folder).is_dir()
        for p in (source / folder).iterdir()
        if p.is_dir() and p.name != "data"
    )
    if sequences:
        raise UsageError("the folder holds several sequences", where=str(source),
                         expected="--sequence with one of " + ", ".join(sequences[:12]),
                         got=sequence or "none chosen")  # fmt: skip
    inside = sorted(p.name for p in source.iterdir())[:12]
    raise InputError("no KITTI images found", where=str(source),
                     expected="image_02/data, image_02 or image_2 with numbered PNG files",
                     got=", ".join(inside) or "an empty folder",
                     remedy="give the folder of one drive, sequence or training set")  # fmt: skip


def _choose_frames(files: KittiFiles, options: ImportOptions, source: Path) -> list[int]:
    """Frame numbers to import: those of all chosen cameras and scans."""
    if files.single:
        return [_single_frame(files, options, source)]
    streams = {**files.images, **({SENSOR: files.scans} if files.scans else {})}
    frames = whole_frames(streams, options, str(source), "kitti")
    if not files.scans:
        log.warn("kitti: no scans found: the scene has images only, and there is nothing to fuse")
    return frames


def _single_frame(files: KittiFiles, options: ImportOptions, source: Path) -> int:
    numbers = list(next(iter(files.images.values())))
    if options.sequence.isdigit() and int(options.sequence) in numbers:
        numbers = [int(options.sequence)]
    if options.frames is not None:
        numbers = [n for n in numbers if options.frames[0] <= n < options.frames[1]]
    if len(numbers) != 1:
        raise UsageError("an object-benchmark folder holds unrelated frames; a scene is one of them", where=str(source),
                         expected="--sequence with one frame number, e.g. 000008",
                         got=f"{len(numbers)} frames: {some_numbers(numbers)}")  # fmt: skip
    if files.scans and numbers[0] not in files.scans:
        raise InputError("frame has no scan", where=str(source / "velodyne"), expected=f"{numbers[0]:06d}.bin")
    return numbers[0]


def _find_calibration(
    source: Path, files: KittiFiles, frames: Sequence[int], options: ImportOptions
) -> KittiCalibration:
    candidates = [source / "calib.txt"]
    if files.single:
        candidates.append(source / "calib" / f"{frames[0]:06d}.txt")
    if options.sequence:
        candidates.append(source / "calib" / f"{options.sequence}.txt")
    for candidate in candidates:
        if candidate.is_file():
            log.info(f"kitti: calibration from {candidate}")
            return read_calibration_text(candidate)
    for folder in (source, source.parent):
        if (folder / "calib_cam_to_cam.txt").is_file():
            log.info(f"kitti: calibration from {folder}/calib_*.txt")
            return read_calibration_day(folder)
    raise InputError("no calibration found", where=str(source),
                     expected="calib.txt, or calib_cam_to_cam.txt and calib_velo_to_cam.txt here or one folder up",
                     remedy="download the day's calibration archive and unpack it beside the drive")  # fmt: skip


# --- time and motion ------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class _Clock:
    """Seconds since the first frame: ``image_s`` by camera and frame, ``scan_s`` by frame."""

    image_s: dict[str, dict[int, float]]
    scan_s: dict[int, float]
    start_s: float
    measured: bool

    @classmethod
    def find(cls, files: KittiFiles, frames: Sequence[int], notes: list[str]) -> _Clock:
        source = files.folders[0]
        common = source / "times.txt"
        image_folders = {name: next(p.parent for p in found.values()) for name, found in files.images.items()}
        image_files = {
            name: _first_file(folder.parent / "timestamps.txt", folder / "timestamps.txt", common)
            for name, folder in image_folders.items()
        }
        scan_file = _first_file(source / "velodyne_points" / "timestamps.txt", common) if files.scans else None
        if files.single or any(path is None for path in image_files.values()):
            if not files.single:
                notes.append("no timestamps in the source: 10 Hz assumed, image and scan of a frame at one moment")
            assumed = {n: (n - frames[0]) * FRAME_PERIOD_S for n in frames}
            return cls({name: dict(assumed) for name in files.images}, assumed, 0.0, False)
        image_s = {name: _times_of(path, frames) for name, path in image_files.items() if path is not None}
        first_camera = next(iter(image_s))
        scan_s = _times_of(scan_file, frames) if scan_file is not None else dict(image_s[first_camera])
        start = scan_s[frames[0]]
        for stream, times in (*image_s.items(), (SENSOR, scan_s)):
            values = np.array([times[n] for n in frames])
            if (np.diff(values) <= 0).any():
                at = frames[int(np.flatnonzero(np.diff(values) <= 0)[0]) + 1]
                raise InputError("timestamps do not increase", where=f"{source}: {stream}, frame {at}",
                                 expected="seconds, increasing",
                                 remedy="is the file of another recording, or in another unit?")  # fmt: skip
            seconds(values, "s", f"{source}: {stream}")
        return cls(
            {name: {n: t - start for n, t in times.items()} for name, times in image_s.items()},
            {n: t - start for n, t in scan_s.items()},
            start,
            True,
        )


def _first_file(*candidates: Path) -> Path | None:
    return next((path for path in candidates if path.is_file()), None)


def _times_of(path: Path, frames: Sequence[int]) -> dict[int, float]:
    times = kitti_poses.read_timestamps(path)
    if len(times) <= max(frames):
        raise InputError("timestamps do not cover the frames", where=str(path),
                         expected=f"at least {max(frames) + 1} lines (line k = frame k)", got=f"{len(times)} lines",
                         remedy="is the file cut off?")  # fmt: skip
    return {n: times[n] for n in frames}


@dataclass(frozen=True, slots=True, eq=False)
class _Motion:
    """How the vehicle moved: ego path, ego-from-velodyne f64[4, 4], and whether scans are to be untwisted with it."""

    ego: EgoPath
    ego_from_velo: Matrix
    untwist: bool

    def velo_at(self, time_s: float) -> Matrix:
        """World-from-velodyne at a time."""
        return pose_near(self.ego, time_s) @ self.ego_from_velo


def _find_motion(
    files: KittiFiles,
    frames: Sequence[int],
    clock: _Clock,
    calibration: KittiCalibration,
    options: ImportOptions,
    notes: list[str],
) -> _Motion:
    if options.poses is not None and not options.poses.exists():
        raise InputError("pose file does not exist", where=str(options.poses))
    packets = _find_packets(files, options)
    several = len(frames) > 1
    if packets is not None:
        if calibration.velo_from_imu is None:
            raise InputError("calibration does not tell where the IMU is", where=calibration.source,
                             expected="calib_imu_to_velo.txt or Tr_imu_to_velo",
                             remedy="add it, or give a pose file with --poses")  # fmt: skip
        log.info(f"kitti: poses from GPS/IMU packets in {packets}")
        notes.append("poses from GPS/IMU packets")
        raw_scans = any(path.parent.name == "data" for path in files.scans.values())
        untwist = several and (options.untwist == "yes" or (options.untwist == "auto" and raw_scans))
        motion = _Motion(_ego_from_packets(packets, frames, clock), invert(calibration.velo_from_imu), untwist)
    else:
        ego = EgoPath(
            np.array([clock.scan_s[n] for n in frames]), _poses_from_file(files, frames, calibration, options, notes)
        )
        motion = _Motion(ego, np.eye(4), several and options.untwist == "yes")
    if motion.untwist:
        notes.append("scans untwisted: counter-clockwise turn of 0.1 s, forward at the scan's time")
    return motion


def _poses_from_file(
    files: KittiFiles, frames: Sequence[int], calibration: KittiCalibration, options: ImportOptions, notes: list[str]
) -> Matrix:
    """World-from-velodyne f64[n, 4, 4]; the world is the velodyne of the first frame."""
    names = ("poses_velo.txt", "poses.txt", "poses_cam0.txt")
    found = [folder / name for folder in files.folders for name in names]
    path = options.poses or _first_file(*found, *_odometry_poses(files.folders[0]))
    if path is None and len(frames) == 1:
        return np.eye(4)[None]
    if path is None:
        raise InputError(
            "no vehicle poses found", where=str(files.folders[0]),
            expected="oxts/data, poses.txt, derived/poses_velo.txt or --poses FILE",
            remedy="without poses the frames of a moving vehicle cannot be put into one world",
        )  # fmt: skip
    log.info(f"kitti: poses from {path}")
    notes.append(f"poses from {path.name}")
    poses, sensor = kitti_poses.read_pose_file(path, frames)
    missing = [n for n in frames if n not in poses]
    if missing:
        raise InputError("pose file lacks frames", where=str(path), got=f"no pose for frames {some_numbers(missing)}",
                         remedy="choose frames with --frames FIRST:END, or give another file with --poses")  # fmt: skip
    stacked = np.stack([poses[n] for n in frames])
    if sensor == "cam0":
        stacked = invert(calibration.rect0_from_velo) @ stacked @ calibration.rect0_from_velo
    return invert(stacked[0]) @ stacked


def _find_packets(files: KittiFiles, options: ImportOptions) -> Path | None:
    """GPS/IMU packets: a folder, or the sequence's file."""
    if options.poses is not None:
        return options.poses if options.poses.is_dir() else None
    folder = files.folders[0] / "oxts" / "data"
    if folder.is_dir():
        return folder
    return _first_file(files.folders[0] / "oxts" / f"{options.sequence}.txt") if options.sequence else None


def _odometry_poses(source: Path) -> tuple[Path, ...]:
    """``poses/07.txt`` beside ``sequences/07``."""
    return (source.parent.parent / "poses" / f"{source.name}.txt",) if source.parent.name == "sequences" else ()


def _ego_from_packets(path: Path, frames: Sequence[int], clock: _Clock) -> EgoPath:
    packets = kitti_poses.read_packets(path, frames)
    numbers = list(packets)
    times_file = path.parent / "timestamps.txt"
    if clock.measured and times_file.is_file():
        measured = _times_of(times_file, numbers)
        times = np.array([measured[n] for n in numbers]) - clock.start_s
    else:
        times = np.interp(numbers, frames, [clock.scan_s[n] for n in frames])
    later = np.r_[True, np.diff(np.maximum.accumulate(times)) > 0]
    poses = kitti_poses.poses_from_packets(np.stack(list(packets.values())), str(path))
    return EgoPath(times[later], poses[later])


# --- boxes and scans ------------------------------------------------------------------------------------------------


def _find_tracks(
    files: KittiFiles,
    frames: Sequence[int],
    calibration: KittiCalibration,
    world_from_velo: Mapping[int, Matrix],
    clock: _Clock,
    options: ImportOptions,
    motion: _Motion,
) -> tuple[list[Track], list[str]]:
    """Tracks and notes; no box file is no tracks."""
    here, derived = files.folders[0], files.folders[1]
    if options.boxes is not None and not options.boxes.is_file():
        raise InputError("box file does not exist", where=str(options.boxes))
    object_label = here / "label_2" / f"{frames[0]:06d}.txt"
    found = options.boxes or _first_file(
        here / "tracklet_labels.xml",
        here / "label_02.txt",
        *([here / "label_02" / f"{options.sequence}.txt"] if options.sequence else []),
        derived / "tracklet_labels.xml",
        derived / "label_02.txt",
        *([object_label] if files.single else []),
    )
    if found is None:
        return [], ["no boxes found: everything counts as static"]
    log.info(f"kitti: boxes from {found}")
    if found.suffix == ".xml":
        boxes = kitti_boxes.read_tracklets(found)
    else:
        is_object = files.single and (options.boxes is not None or found == object_label)
        boxes = kitti_boxes.read_label_text(found, calibration.rect0_from_velo, frames[0] if is_object else None)
    tracks, notes = kitti_boxes.build_tracks(
        boxes, world_from_velo, clock.scan_s, str(found), motion.velo_at if motion.untwist else None
    )
    return tracks, [f"boxes from {found.name}", *notes]


def read_scan(path: Path) -> SweepPoints:
    """A velodyne scan: float32 rows x, y, z, reflectance (0..1). Rows at the origin (no return) are dropped.

    Raises:
        InputError: cut off, or values that are not finite.
    """
    rows = read_float_rows(path, 4)
    if len(rows) == 0:
        log.warn(f"kitti: {path} has no points")
    rows = rows[np.any(rows[:, :3] != 0, axis=1)]
    return SweepPoints(np.ascontiguousarray(rows[:, :3]), np.clip(rows[:, 3], 0, 1), np.zeros(len(rows), np.float32))


def untwist_scan(points: SweepPoints, velo_at: Callable[[float], Matrix], time_s: float) -> SweepPoints:
    """Bring the points of a turning sensor to one moment; see the module text for the timing.

    The vehicle's pose is taken at 37 moments of the turn and points in between are blended linearly.
    """
    azimuth = np.arctan2(points.xyz[:, 1], points.xyz[:, 0])
    dt_s = np.asarray(kitti_boxes.azimuth_delay_s(azimuth), np.float32)
    velo_from_world = invert(velo_at(time_s))
    moments = np.linspace(-0.5, 0.5, _TURN_STEPS + 1) * kitti_boxes.TURN_PERIOD_S
    corrections = [velo_from_world @ velo_at(time_s + float(moment)) for moment in moments]
    place = (dt_s / kitti_boxes.TURN_PERIOD_S + 0.5) * _TURN_STEPS
    step = np.clip(place.astype(int), 0, _TURN_STEPS - 1)
    xyz = points.xyz.copy()
    for index in range(_TURN_STEPS):
        chosen = step == index
        if chosen.any():
            weight = (place[chosen] - index)[:, None]
            before = transform_points(corrections[index], points.xyz[chosen])
            after = transform_points(corrections[index + 1], points.xyz[chosen])
            xyz[chosen] = before + weight * (after - before)
    return SweepPoints(xyz, points.intensity, dt_s)


def _fit_cameras(
    files: KittiFiles, calibration: KittiCalibration, frames: Sequence[int], options: ImportOptions
) -> dict[str, ImageFit]:
    fits = {}
    for name, found in files.images.items():
        first = found[frames[0]]
        height, width = decode_image(store.read_bytes(first), str(first)).shape[:2]
        fits[name] = fit_images(calibration.camera(files.numbers[name], name, width, height), options)
    return fits
