"""KITTI importer: raw drives, odometry and tracking sequences, single object frames.

What is read (the parts that are there are found by looking, and each choice is logged):

=========== =============================================================================================
images      ``image_02/data``, ``image_02``, ``image_2``, or ``image_02/<sequence>``
scans       ``velodyne_points/data``, ``velodyne``, or ``velodyne/<sequence>``
calibration ``calib.txt``, ``calib/<frame or sequence>.txt``, or the day's ``calib_*_to_*.txt`` here or one folder up
poses       ``oxts/data`` (raw) or ``oxts/<sequence>.txt``; ``poses.txt``; ``poses_velo.txt``; ``poses_cam0.txt``; also
            in ``derived/``
boxes       ``tracklet_labels.xml``; ``label_02.txt`` or ``label_02/<sequence>.txt``, also in ``derived/``;
            ``label_2/<frame>.txt``
times       ``timestamps.txt`` per sensor, ``times.txt``; without them 10 Hz is assumed, and said
=========== =============================================================================================

Frames. World: z up, origin and x axis at the first ego pose. The ego frame is the IMU where there is GPS/IMU data, else
the velodyne. Camera ``image_02`` is called ``front``.

Scans of raw drives are distorted by the vehicle's motion. They are untwisted here when poses come from GPS/IMU packets:
the sensor turns counter-clockwise in 0.1 s and faces forward at the scan's time, so a point at azimuth a was measured a
/ 2 pi turns later, and ``dt_s`` says so. The odometry, tracking and object benchmarks document their scans as
compensated; those keep ``dt_s`` = 0.
"""

from __future__ import annotations

from collections.abc import Container, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from mudg.base import log
from mudg.base.errors import InputError, UsageError
from mudg.base.geometry import invert
from mudg.base.types import EgoPath, Scene, Source, Track
from mudg.formats.importers import common, kitti_files
from mudg.formats.importers.common import ImportOptions, LogFiles
from mudg.formats.importers.drive_log import SceneContent, SceneImage, SceneSweep, write_scene
from mudg.formats.importers.images import fit_images, image_notes, image_size
from mudg.formats.importers.kitti_files import SENSOR, TURN_PERIOD_S, KittiCalibration, read_scan, untwist_scan

Matrix = NDArray[np.float64]
LICENCE: Final = "CC BY-NC-SA 3.0 (KITTI: Geiger, Lenz, Stiller, Urtasun; attribution, non-commercial, share-alike)"
FRAME_PERIOD_S: Final = 0.1
CAMERA_NAMES: Final = {"image_02": "front", "image_03": "front_stereo", "image_00": "grey", "image_01": "grey_stereo"}


@dataclass(frozen=True, slots=True)
class KittiFiles:
    """The files of one recording."""

    images: Mapping[str, Mapping[int, Path]]
    """Scene camera name -> frame number -> file."""
    numbers: Mapping[str, int]
    """Scene camera name -> KITTI camera number."""
    scans: Mapping[int, Path]
    """Frame number -> file; may be empty."""
    folder: Path
    """Its ``derived`` is searched, too."""
    single: bool
    """One frame of the object benchmark, without a clock or motion."""


@dataclass(frozen=True, slots=True)
class _Clock:
    """Seconds since the first frame, which is ``start_s`` in the source: ``image_s`` by camera and frame, ``scan_s`` by
    frame; ``measured``: whether there are time stamps at all."""

    image_s: Mapping[str, Mapping[int, float]]
    scan_s: Mapping[int, float]
    start_s: float
    measured: bool


@dataclass(frozen=True, slots=True)
class _Recording:
    """The frames of one recording that are imported, with their calibration and times."""

    files: KittiFiles
    frames: Sequence[int]
    calibration: KittiCalibration
    clock: _Clock


@dataclass(frozen=True, slots=True, eq=False)
class _VeloMotion:
    """How the vehicle moved: ego path, ego-from-velodyne f64[4, 4], and whether scans are to be untwisted with it."""

    ego: EgoPath
    ego_from_velo: Matrix
    untwist: bool

    def velo_at(self, time_s: float) -> Matrix:
        """World from velodyne, f64[4, 4]."""
        return common.pose_near(self.ego, time_s) @ self.ego_from_velo


def looks_like_kitti(source: Path) -> bool:
    """Whether ``source`` is the folder of a KITTI drive, sequence or training set."""
    return any((source / name).is_dir() for name in ("image_02", "image_2", "image_00", "velodyne_points"))


def import_kitti(source: Path, out: Path, options: ImportOptions) -> Scene:
    """Import one recording; see the module text for what is understood."""
    if not source.is_dir():
        raise InputError("KITTI folder does not exist", where=str(source), expected="a folder")
    files = find_files(source, options)
    stamps = _read_stamps(files, options)
    frames = _choose_frames(files, stamps, options)
    notes: list[str] = []
    calibration = _find_calibration(files, frames, options)
    clock = _make_clock(files, stamps, frames, notes)
    recording = _Recording(files, frames, calibration, clock)
    motion = _find_motion(recording, options, notes)
    frames = _with_poses(recording, motion, options)
    recording = replace(recording, frames=frames)
    world_from_velo = {n: motion.velo_at(clock.scan_s[n]) for n in frames}
    tracks, track_notes = _find_tracks(recording, world_from_velo, motion, options)
    notes += track_notes
    if frames != list(range(len(frames))):
        notes.append(f"source frames {frames[0]} to {frames[-1]} are frames 0 to {len(frames) - 1} here")
    fits = {}
    for name, paths in files.images.items():
        camera = calibration.camera(files.numbers[name], name, *image_size(paths[frames[0]]))
        fits[name] = fit_images(camera, options)

    def convert(index: int) -> Iterable[SceneImage | SceneSweep]:
        number = frames[index]
        for name, found in files.images.items():
            time_s = clock.image_s[name][number]
            world_from_cam = motion.velo_at(time_s) @ calibration.velo_from_cam(files.numbers[name])
            yield SceneImage(name, index, time_s, world_from_cam, found[number])
        if number in files.scans:
            path, time_s = files.scans[number], clock.scan_s[number]
            points = untwist_scan(read_scan(path), motion.velo_at, time_s) if motion.untwist else read_scan(path)
            yield SceneSweep(SENSOR, index, time_s, world_from_velo[number], points, str(path))

    origin = Source("kitti", LICENCE, None, (*notes, *image_notes(fits)))
    name, items = source.resolve().name, range(len(frames))
    content = SceneContent(
        name, origin, fits, items, convert, lambda n: f"frame {frames[n]}", motion.ego, lambda: (tracks, ())
    )
    return write_scene(content, out, options)


def files_of_kitti(source: Path, options: ImportOptions) -> LogFiles:
    """The folder, with the calibration and poses beside it; of a folder with many sequences or frames only what is
    chosen."""
    beside = sorted(p for p in (*source.parent.glob("calib_*.txt"), *_odometry_poses(source)) if p.is_file())
    wanted, number = options.sequence, int(options.sequence) if options.sequence.isdigit() else -1
    paths = sorted(source.glob("*/*")) if wanted else ()
    chosen = [p for p in paths if p.stem == wanted or (p.stem.isdigit() and int(p.stem) == number)]
    if not chosen:
        return LogFiles((source, *beside))
    here = [path for path in sorted(source.iterdir()) if path.is_file() or path.name == "derived"]
    return LogFiles((*chosen, *here, *beside))


# --- finding files --------------------------------------------------------------------------------


def find_files(source: Path, options: ImportOptions) -> KittiFiles:
    """Images and scans of one recording below ``source``."""
    single = (source / "image_2").is_dir() and (source / "calib").is_dir() and not (source / "times.txt").is_file()
    sequence = "" if single else options.sequence
    images: dict[str, dict[int, Path]] = {}
    for folder in CAMERA_NAMES:
        short = folder.replace("_0", "_")
        for candidate in (source / folder / "data", source / folder / sequence, source / short / sequence):
            found = common.numbered_files(candidate, (".png", ".jpg", ".jpeg"))
            if found:
                images[folder] = found
                break
    if not images:
        _refuse_without_images(source, options)
    usual = "image_02" if "image_02" in images else next(iter(images))
    chosen = common.chosen_cameras({folder: CAMERA_NAMES[folder] for folder in images}, options, str(source), (usual,))
    scans: dict[int, Path] = {}
    for candidate in (source / "velodyne_points" / "data", source / "velodyne" / sequence):
        scans = scans or common.numbered_files(candidate, (".bin",))
    wanted = {CAMERA_NAMES[folder]: images[folder] for folder in chosen}
    return KittiFiles(wanted, {CAMERA_NAMES[folder]: int(folder[-1]) for folder in chosen}, scans, source, single)


def _refuse_without_images(source: Path, options: ImportOptions) -> None:
    folders = (path for name in ("image_02", "image_2") for path in (source / name).glob("*/"))
    sequences = sorted(path.name for path in folders if path.name != "data")
    if sequences:
        what, expected = "the folder holds several sequences", "--sequence with one of " + ", ".join(sequences[:12])
        raise UsageError(what, where=str(source), expected=expected, got=options.sequence or "none chosen")
    what, expected = "no KITTI images found", "image_02/data, image_02 or image_2 with numbered PNG files"
    remedy = "give the folder of one drive, sequence or training set"
    raise InputError(what, where=str(source), got=common.folder_contents(source), expected=expected, remedy=remedy)


def _choose_frames(files: KittiFiles, stamps: Mapping[str, Mapping[int, float]], options: ImportOptions) -> list[int]:
    """Frame numbers to import: those of all chosen cameras and scans that have a time stamp, where there are any."""
    if files.single:
        return [_single_frame(files, options)]
    streams = {**files.images, **({SENSOR: files.scans} if files.scans else {})}
    recorded = set().union(*streams.values())
    stamped = {f"timestamps of {name}": recorded - (set(streams[name]) - set(times)) for name, times in stamps.items()}
    frames = common.complete_frames({**streams, **stamped}, options, str(files.folder), "kitti")
    if not files.scans:
        log.warn("kitti: no scans found: the scene has images only, and there is nothing to fuse")
    return frames


def _single_frame(files: KittiFiles, options: ImportOptions) -> int:
    numbers = list(next(iter(files.images.values())))
    if options.sequence.isdigit() and int(options.sequence) in numbers:
        numbers = [int(options.sequence)]
    if options.frames is not None:
        numbers = [n for n in numbers if options.frames[0] <= n < options.frames[1]]
    if len(numbers) != 1:
        what, where = "an object-benchmark folder holds unrelated frames; a scene is one of them", str(files.folder)
        got = f"{len(numbers)} frames: {common.number_ranges(numbers)}"
        raise UsageError(what, where=where, expected="--sequence with one frame number, e.g. 000008", got=got)
    if files.scans and numbers[0] not in files.scans:
        raise InputError("frame has no scan", where=str(files.folder / "velodyne"), expected=f"{numbers[0]:06d}.bin")
    return numbers[0]


def _find_calibration(files: KittiFiles, frames: Sequence[int], options: ImportOptions) -> KittiCalibration:
    folder = files.folder
    path = common.first_file(
        folder / "calib.txt",
        *([folder / "calib" / f"{frames[0]:06d}.txt"] if files.single else []),
        *([folder / "calib" / f"{options.sequence}.txt"] if options.sequence else []),
    )
    if path is not None:
        log.info(f"kitti: calibration from {path}")
        return kitti_files.read_calibration_text(path)
    for day in (folder, folder.parent):
        if (day / "calib_cam_to_cam.txt").is_file():
            log.info(f"kitti: calibration from {day}/calib_*.txt")
            return kitti_files.read_calibration_day(day)
    expected = "calib.txt, or calib_cam_to_cam.txt and calib_velo_to_cam.txt here or one folder up"
    remedy = "download the day's calibration archive and unpack it beside the drive"
    raise InputError("no calibration found", where=str(folder), expected=expected, remedy=remedy)


# --- time and motion ------------------------------------------------------------------------------


def _read_stamps(files: KittiFiles, options: ImportOptions) -> dict[str, dict[int, float]]:
    """The source's times in seconds by camera or LiDAR and frame; nothing where a camera has none."""
    shared = files.folder / "times.txt"
    folders = {name: next(path.parent for path in found.values()) for name, found in files.images.items()}
    paths = {
        name: common.first_file(folder.parent / "timestamps.txt", folder / "timestamps.txt", shared)
        for name, folder in folders.items()
    }
    if files.single or None in paths.values():
        return {}
    streams = dict(files.images)
    if files.scans:
        paths[SENSOR] = common.first_file(files.folder / "velodyne_points" / "timestamps.txt", shared, *paths.values())
        streams[SENSOR] = files.scans
    first, end = options.frames or (0, 2**63)
    stamps = {}
    for name, path in paths.items():
        wanted = [n for n in streams[name] if first <= n < end]
        if path is not None:
            stamps[name] = kitti_files.read_timestamps(path, list(streams[name]), max(wanted, default=-1))
    return stamps


def _make_clock(
    files: KittiFiles, stamps: Mapping[str, Mapping[int, float]], frames: Sequence[int], notes: list[str]
) -> _Clock:
    """The recording's clock: measured, or 10 Hz from the first frame on, which is noted."""
    if not stamps:
        if not files.single:
            notes.append("no timestamps in the source: 10 Hz assumed, image and scan of a frame at one moment")
        assumed = {n: (n - frames[0]) * FRAME_PERIOD_S for n in frames}
        return _Clock(dict.fromkeys(files.images, assumed), assumed, 0.0, False)
    chosen = {name: {n: times[n] for n in frames} for name, times in stamps.items()}
    for stream, times in chosen.items():
        common.seconds(list(times.values()), "s", f"{files.folder}: {stream}")
    scan_s = chosen.get(SENSOR, next(iter(chosen.values())))
    start_s = scan_s[frames[0]]
    since_start = {name: {n: t - start_s for n, t in times.items()} for name, times in chosen.items()}
    return _Clock(since_start, {n: t - start_s for n, t in scan_s.items()}, start_s, True)


def _with_poses(recording: _Recording, motion: _VeloMotion, options: ImportOptions) -> list[int]:
    """Frames whose image and scan lie where the vehicle's path is known; others are refused, or left out."""
    clock, reach_s = recording.clock, TURN_PERIOD_S / 2 if motion.untwist else 0.0
    placed = []
    for n in recording.frames:
        times = [*(found[n] for found in clock.image_s.values()), clock.scan_s[n] - reach_s, clock.scan_s[n] + reach_s]
        if not options.skip_missing or all(common.has_pose(motion.ego, time_s) for time_s in times):
            placed.append(n)
    lost = sorted({*recording.frames} - {*placed})
    if not placed:
        motion.velo_at(clock.scan_s[lost[0]])  # says what is wrong
        raise InputError("no frame has a vehicle pose", where=str(recording.files.folder))
    if lost:
        log.warn(f"kitti: left out frames without a vehicle pose: {common.number_ranges(lost)}")
    return placed


def _find_motion(recording: _Recording, options: ImportOptions, notes: list[str]) -> _VeloMotion:
    """The vehicle's motion from GPS/IMU packets, else from a pose file."""
    if options.poses is not None and not options.poses.exists():
        raise InputError("pose file does not exist", where=str(options.poses))
    files, frames, calibration = recording.files, recording.frames, recording.calibration
    packets = _find_packets(files, options)
    if packets is None:
        ego = _ego_from_file(recording, options, notes)
        ego_from_velo, untwist = np.eye(4), options.untwist == "yes"
    else:
        if calibration.velo_from_imu is None:
            what, where = "calibration does not tell where the IMU is", calibration.source
            expected = "calib_imu_to_velo.txt or Tr_imu_to_velo"
            raise InputError(what, where=where, expected=expected, remedy="add it, or give a pose file with --poses")
        log.info(f"kitti: poses from GPS/IMU packets in {packets}")
        notes.append("poses from GPS/IMU packets")
        ego = _ego_from_packets(packets, frames, recording.clock, options)
        raw_scans = any(path.parent.name == "data" for path in files.scans.values())
        ego_from_velo = invert(calibration.velo_from_imu)
        untwist = options.untwist == "yes" or (options.untwist == "auto" and raw_scans)
    ego = common.mended_path(ego, options, notes)
    untwist = untwist and len(frames) > 1
    if untwist:
        notes.append("scans untwisted: counter-clockwise turn of 0.1 s, forward at the scan's time")
    return _VeloMotion(ego, ego_from_velo, untwist)


def _ego_from_file(recording: _Recording, options: ImportOptions, notes: list[str]) -> EgoPath:
    """The velodyne's path at the scans; the world is the velodyne of the first frame."""
    frames, folder = recording.frames, recording.files.folder
    names = ("poses_velo.txt", "poses.txt", "poses_cam0.txt")
    found = [parent / name for parent in (folder, folder / "derived") for name in names]
    path = options.poses or common.first_file(*found, *_odometry_poses(folder))
    if path is None and len(frames) == 1:
        return EgoPath(np.array([recording.clock.scan_s[frames[0]]]), np.eye(4)[None])
    if path is None:
        expected = "oxts/data, poses.txt, derived/poses_velo.txt or --poses FILE"
        remedy = "without poses the frames of a moving vehicle cannot be put into one world"
        raise InputError("no vehicle poses found", where=str(folder), expected=expected, remedy=remedy)
    log.info(f"kitti: poses from {path}")
    notes.append(f"poses from {path.name}")
    poses, sensor = kitti_files.read_pose_file(path, frames)
    known = _known(frames, poses, "pose file lacks frames", path, options)
    stacked = np.stack([poses[n] for n in known])
    if sensor == "cam0":
        rect0_from_velo = recording.calibration.rect0_from_velo
        stacked = invert(rect0_from_velo) @ stacked @ rect0_from_velo
    notes.append(common.origin_note(stacked[0]))
    return EgoPath(np.array([recording.clock.scan_s[n] for n in known]), invert(stacked[0]) @ stacked)


def _known(frames: Sequence[int], there: Container[int], what: str, path: Path, options: ImportOptions) -> list[int]:
    """The frames that are ``there``; lost ones are refused unless frames may be left out."""
    missing = [n for n in frames if n not in there]
    if missing and (not options.skip_missing or len(missing) == len(frames)):
        where, remedy = str(path), "copy them, choose frames with --frames FIRST:END, or add --skip-missing"
        raise InputError(what, where=where, got=f"nothing for frames {common.number_ranges(missing)}", remedy=remedy)
    return [n for n in frames if n in there]


def _find_packets(files: KittiFiles, options: ImportOptions) -> Path | None:
    """GPS/IMU packets: a folder, or the sequence's file."""
    folder = options.poses or files.folder / "oxts" / "data"
    if options.poses is not None or folder.is_dir():
        return folder if folder.is_dir() else None
    return common.first_file(files.folder / "oxts" / f"{options.sequence}.txt") if options.sequence else None


def _odometry_poses(source: Path) -> tuple[Path, ...]:
    """``poses/07.txt`` beside ``sequences/07``."""
    return (source.parent.parent / "poses" / f"{source.name}.txt",) if source.parent.name == "sequences" else ()


def _ego_from_packets(path: Path, frames: Sequence[int], clock: _Clock, options: ImportOptions) -> EgoPath:
    packets = kitti_files.read_packets(path, frames)
    _known(frames, packets, "GPS/IMU packets are missing", path, options)
    times_file = path.parent / "timestamps.txt"
    numbers = list(packets)
    if clock.measured and times_file.is_file():
        measured = kitti_files.read_timestamps(times_file, numbers, numbers[-1])
        numbers = _known(numbers, measured, "GPS/IMU packets have no timestamps", times_file, options)
        times = np.array([measured[n] for n in numbers]) - clock.start_s
    else:
        times = np.interp(numbers, frames, [clock.scan_s[n] for n in frames])
    later = np.r_[True, np.diff(np.maximum.accumulate(times)) > 0]
    poses = kitti_files.poses_from_packets(np.stack([packets[n] for n in numbers]), str(path))
    return EgoPath(times[later], poses[later])


# --- boxes and cameras ----------------------------------------------------------------------------


def _find_tracks(
    recording: _Recording, world_from_velo: Mapping[int, Matrix], motion: _VeloMotion, options: ImportOptions
) -> tuple[list[Track], list[str]]:
    """Tracks and notes; no box file is no tracks."""
    files, frames = recording.files, recording.frames
    here, derived = files.folder, files.folder / "derived"
    if options.boxes is not None and not options.boxes.is_file():
        raise InputError("box file does not exist", where=str(options.boxes))
    object_label = here / "label_2" / f"{frames[0]:06d}.txt"
    found = options.boxes or common.first_file(
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
        boxes = kitti_files.read_tracklets(found)
    else:
        is_object = files.single and (options.boxes is not None or found == object_label)
        frame = frames[0] if is_object else None
        boxes = kitti_files.read_label_text(found, recording.calibration.rect0_from_velo, frame)
    velo_at = motion.velo_at if motion.untwist else None
    tracks, notes = kitti_files.build_tracks(boxes, world_from_velo, recording.clock.scan_s, str(found), velo_at)
    return tracks, [f"boxes from {found.name}", *notes]
