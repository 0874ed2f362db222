"""KITTI importer: raw drives, odometry and tracking sequences (docs/reference/formats.md). World: z up, origin and x at
the first ego pose; the ego frame is the IMU where there is GPS/IMU data, else the velodyne.
"""

from __future__ import annotations

from collections.abc import Container, Iterable, Mapping, Sequence
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
Stamps = Mapping[str, Mapping[int, float]]
"""Camera or LiDAR -> frame number -> seconds."""
LICENCE: Final = "CC BY-NC-SA 3.0 (KITTI: Geiger, Lenz, Stiller, Urtasun; attribution, non-commercial, share-alike)"
FRAME_PERIOD_S: Final = 0.1
CAMERA_NAMES: Final = {"image_02": "front", "image_03": "front_stereo", "image_00": "grey", "image_01": "grey_stereo"}


def looks_like_kitti(source: Path) -> bool:
    """Whether ``source`` is the folder of a KITTI drive, sequence or training set."""
    return any((source / name).is_dir() for name in ("image_02", "image_2", "image_00", "velodyne_points"))


def files_of_kitti(source: Path, options: ImportOptions) -> LogFiles:
    """The folder, with the calibration and poses beside it; of a folder with many sequences only what is chosen."""
    beside = sorted(p for p in (*source.parent.glob("calib_*.txt"), *_odometry_poses(source)) if p.is_file())
    wanted = options.sequence
    chosen = [path for path in sorted(source.glob("*/*")) if wanted and path.stem == wanted]
    if not chosen:
        return LogFiles((source, *beside))
    here = [path for path in sorted(source.iterdir()) if path.is_file() or path.name == "derived"]
    return LogFiles((*chosen, *here, *beside))


def _odometry_poses(source: Path) -> tuple[Path, ...]:
    """``poses/07.txt`` beside ``sequences/07``."""
    return (source.parent.parent / "poses" / f"{source.name}.txt",) if source.parent.name == "sequences" else ()


def import_kitti(source: Path, out: Path, options: ImportOptions) -> Scene:
    """Import one recording; see the module text for what is understood."""
    drive = _Recording(source, options)
    frames, notes = drive.frames, drive.notes
    world_from_velo = {n: drive.velo_at(drive.scan_s[n]) for n in frames}
    tracks = drive.read_tracks(world_from_velo)
    if frames != list(range(len(frames))):
        notes.append(f"source frames {frames[0]} to {frames[-1]} are frames 0 to {len(frames) - 1} here")
    fits = {}
    for name, paths in drive.images.items():
        camera = drive.calibration.camera(drive.numbers[name], name, *image_size(paths[frames[0]]))
        fits[name] = fit_images(camera, options)

    def convert(index: int) -> Iterable[SceneImage | SceneSweep]:
        number = frames[index]
        for name, found in drive.images.items():
            time_s = drive.image_s[name][number]
            world_from_cam = drive.velo_at(time_s) @ drive.calibration.velo_from_cam(drive.numbers[name])
            yield SceneImage(name, index, time_s, world_from_cam, found[number])
        if number in drive.scans:
            path, time_s = drive.scans[number], drive.scan_s[number]
            points = untwist_scan(read_scan(path), drive.velo_at, time_s) if drive.untwist else read_scan(path)
            yield SceneSweep(SENSOR, index, time_s, world_from_velo[number], points, str(path))

    origin = Source("kitti", LICENCE, None, (*notes, *image_notes(fits)))
    name, items = source.resolve().name, range(len(frames))
    content = SceneContent(
        name, origin, fits, items, convert, lambda n: f"frame {frames[n]}", drive.ego, lambda: (tracks, ())
    )
    return write_scene(content, out, options)


class _Recording:
    """The files of one recording and what they tell, read in the order of the constructor.

    ``images``: scene camera name -> frame number -> file, ``numbers``: its KITTI number; ``scans`` may be empty.
    ``frames``: the numbers that are imported. ``image_s`` by camera and frame and ``scan_s`` by frame: seconds since
    the first frame, which is ``start_s`` in the source. ``untwist``: whether scans are to be untwisted with the
    vehicle's path ``ego``.
    """

    def __init__(self, folder: Path, options: ImportOptions) -> None:
        self.folder, self.options = folder, options
        self.notes: list[str] = []
        self._find_files()
        stamps = self._read_stamps()
        self.frames = self._complete_frames(stamps)
        self.calibration = self._read_calibration()
        self._set_clock(stamps)
        if options.poses is not None and not options.poses.exists():
            raise InputError("pose file does not exist", where=str(options.poses))
        self._set_motion()
        self._leave_out_unplaced()

    def velo_at(self, time_s: float) -> Matrix:
        """World from velodyne, f64[4, 4]."""
        return common.pose_near(self.ego, time_s) @ self.ego_from_velo

    # --- files and frames ---

    def _find_files(self) -> None:
        sequence, where = self.options.sequence, str(self.folder)
        images: dict[str, dict[int, Path]] = {}
        for folder in CAMERA_NAMES:
            names = (f"{folder}/data", f"{folder}/{sequence}", f"{folder.replace('_0', '_')}/{sequence}")
            found = [common.numbered_files(self.folder / name, (".png", ".jpg", ".jpeg")) for name in names]
            if any(found):
                images[folder] = next(files for files in found if files)
        if not images:
            folders = (path for name in ("image_02", "image_2") for path in (self.folder / name).glob("*/"))
            sequences = sorted(path.name for path in folders if path.name != "data")
            if sequences:
                what, got = "the folder holds several sequences", self.options.sequence or "none chosen"
                expected = "--sequence with one of " + ", ".join(sequences[:12])
                raise UsageError(what, where=where, expected=expected, got=got)
            what, expected = "no KITTI images found", "image_02/data, image_02 or image_2 with numbered PNG files"
            remedy, got = "give the folder of one drive, sequence or training set", common.folder_contents(self.folder)
            raise InputError(what, where=where, got=got, expected=expected, remedy=remedy)
        usual = "image_02" if "image_02" in images else next(iter(images))
        available = {folder: CAMERA_NAMES[folder] for folder in images}
        chosen = common.chosen_cameras(available, self.options, where, (usual,))
        self.images = {CAMERA_NAMES[folder]: images[folder] for folder in chosen}
        self.numbers = {CAMERA_NAMES[folder]: int(folder[-1]) for folder in chosen}
        scans = common.numbered_files(self.folder / "velodyne_points" / "data", (".bin",))
        self.scans = scans or common.numbered_files(self.folder / "velodyne" / sequence, (".bin",))
        self._streams = {**self.images, **({SENSOR: self.scans} if self.scans else {})}

    def _complete_frames(self, stamps: Stamps) -> list[int]:
        """The frames that all chosen cameras and scans have, with a time stamp where there are any."""
        streams, recorded = self._streams, set().union(*self._streams.values())
        stamped = {
            f"timestamps of {name}": recorded - (set(streams[name]) - set(times)) for name, times in stamps.items()
        }
        frames = common.complete_frames({**streams, **stamped}, self.options, str(self.folder), "kitti")
        if not self.scans:
            log.warn("kitti: no scans found: the scene has images only, and there is nothing to fuse")
        return frames

    def _read_calibration(self) -> KittiCalibration:
        path = common.first_file(self.folder / "calib.txt", self.folder / "calib" / f"{self.options.sequence}.txt")
        if path is not None:
            return kitti_files.read_calibration_text(path)
        for day in (self.folder, self.folder.parent):
            if (day / "calib_cam_to_cam.txt").is_file():
                return kitti_files.read_calibration_day(day)
        expected = "calib.txt, or calib_cam_to_cam.txt and calib_velo_to_cam.txt here or one folder up"
        remedy = "download the day's calibration archive and unpack it beside the drive"
        raise InputError("no calibration found", where=str(self.folder), expected=expected, remedy=remedy)

    # --- time ---

    def _read_stamps(self) -> Stamps:
        """The source's times; nothing where a camera has none."""
        shared = self.folder / "times.txt"
        paths: dict[str, Path | None] = {}
        for name, found in self.images.items():
            folder = next(iter(found.values())).parent
            paths[name] = common.first_file(folder.parent / "timestamps.txt", folder / "timestamps.txt", shared)
        files = [path for path in paths.values() if path is not None]
        if len(files) < len(paths):
            return {}
        if self.scans:
            paths[SENSOR] = common.first_file(self.folder / "velodyne_points" / "timestamps.txt", shared, *files)
        first, end = self.options.frames or (0, 2**63)
        stamps = {}
        for name, path in paths.items():
            numbers = list(self._streams[name])
            last = max((n for n in numbers if first <= n < end), default=-1)
            if path is not None:
                stamps[name] = kitti_files.read_timestamps(path, numbers, last)
        return stamps

    def _set_clock(self, stamps: Stamps) -> None:
        """The recording's clock: measured, or 10 Hz from the first frame on, which is noted."""
        self.start_s, self._measured = 0.0, bool(stamps)
        if not stamps:
            self.notes.append("no timestamps in the source: 10 Hz assumed, image and scan of a frame at one moment")
            self.scan_s = {n: (n - self.frames[0]) * FRAME_PERIOD_S for n in self.frames}
            self.image_s = dict.fromkeys(self.images, self.scan_s)
            return
        chosen = {name: {n: times[n] for n in self.frames} for name, times in stamps.items()}
        for stream, times in chosen.items():
            common.seconds(list(times.values()), "s", f"{self.folder}: {stream}")
        scan_s = chosen.get(SENSOR, next(iter(chosen.values())))
        self.start_s = scan_s[self.frames[0]]
        self.image_s = {name: {n: t - self.start_s for n, t in times.items()} for name, times in chosen.items()}
        self.scan_s = self.image_s.get(SENSOR) or next(iter(self.image_s.values()))

    # --- motion ---

    def _set_motion(self) -> None:
        """The vehicle's motion from GPS/IMU packets (a folder, or the sequence's file), else from a pose file."""
        self.ego_from_velo, self.untwist = np.eye(4), self.options.untwist == "yes"
        oxts, poses = self.folder / "oxts", self.options.poses
        packets = poses or oxts / "data"
        if poses is None and not packets.is_dir():
            packets = oxts / f"{self.options.sequence}.txt"
        if not (packets.is_dir() or (poses is None and packets.is_file())):
            ego = self._ego_from_file()
        else:
            velo_from_imu, where = self.calibration.velo_from_imu, self.calibration.source
            if velo_from_imu is None:
                what, expected = "calibration does not tell where the IMU is", "calib_imu_to_velo.txt or Tr_imu_to_velo"
                remedy = "add it, or give a pose file with --poses"
                raise InputError(what, where=where, expected=expected, remedy=remedy)
            self.notes.append("poses from GPS/IMU packets")
            ego = self._ego_from_packets(packets)
            raw_scans = any(path.parent.name == "data" for path in self.scans.values())
            self.ego_from_velo = invert(velo_from_imu)
            self.untwist |= self.options.untwist == "auto" and raw_scans
        self.ego = common.mended_path(ego, self.notes)
        self.untwist &= len(self.frames) > 1
        if self.untwist:
            self.notes.append("scans untwisted: counter-clockwise turn of 0.1 s, forward at the scan's time")

    def _ego_from_file(self) -> EgoPath:
        """The velodyne's path at the scans; the world is the velodyne of the first frame."""
        frames, folder = self.frames, self.folder
        names = ("poses_velo.txt", "poses.txt", "poses_cam0.txt")
        found = [parent / name for parent in (folder, folder / "derived") for name in names]
        path = self.options.poses or common.first_file(*found, *_odometry_poses(folder))
        if path is None and len(frames) == 1:
            return EgoPath(np.array([self.scan_s[frames[0]]]), np.eye(4)[None])
        if path is None:
            expected = "oxts/data, poses.txt, derived/poses_velo.txt or --poses FILE"
            remedy = "without poses the frames of a moving vehicle cannot be put into one world"
            raise InputError("no vehicle poses found", where=str(folder), expected=expected, remedy=remedy)
        self.notes.append(f"poses from {path.name}")
        poses, sensor = kitti_files.read_pose_file(path, frames)
        known = self._known(frames, poses, "pose file lacks frames", path)
        stacked = np.stack([poses[n] for n in known])
        if sensor == "cam0":
            rect0_from_velo = self.calibration.rect0_from_velo
            stacked = invert(rect0_from_velo) @ stacked @ rect0_from_velo
        self.notes.append(common.origin_note(stacked[0]))
        return EgoPath(np.array([self.scan_s[n] for n in known]), invert(stacked[0]) @ stacked)

    def _ego_from_packets(self, path: Path) -> EgoPath:
        packets = kitti_files.read_packets(path, self.frames)
        self._known(self.frames, packets, "GPS/IMU packets are missing", path)
        times_file = path.parent / "timestamps.txt"
        numbers = list(packets)
        if self._measured and times_file.is_file():
            measured = kitti_files.read_timestamps(times_file, numbers, numbers[-1])
            numbers = self._known(numbers, measured, "GPS/IMU packets have no timestamps", times_file)
            times = np.array([measured[n] for n in numbers]) - self.start_s
        else:
            times = np.interp(numbers, self.frames, [self.scan_s[n] for n in self.frames])
        later = np.r_[True, np.diff(np.maximum.accumulate(times)) > 0]
        poses = kitti_files.poses_from_packets(np.stack([packets[n] for n in numbers]), str(path))
        return EgoPath(times[later], poses[later])

    def _known(self, frames: Sequence[int], there: Container[int], what: str, path: Path) -> list[int]:
        """The frames that are ``there``; lost ones are refused unless frames may be left out."""
        missing = [n for n in frames if n not in there]
        if missing and (not self.options.skip_missing or len(missing) == len(frames)):
            got = f"nothing for frames {common.number_ranges(missing)}"
            remedy = "copy them, choose frames with --frames FIRST:END, or add --skip-missing"
            raise InputError(what, where=str(path), got=got, remedy=remedy)
        return [n for n in frames if n in there]

    def _leave_out_unplaced(self) -> None:
        """Keep the frames whose image and scan lie where the vehicle's path is known; if frames may not be left out,
        whoever asks for a pose refuses the others."""
        if not self.options.skip_missing:
            return
        reach_s = TURN_PERIOD_S / 2 if self.untwist else 0.0
        lost = []
        for n in self.frames:
            times = [*(found[n] for found in self.image_s.values()), self.scan_s[n] - reach_s, self.scan_s[n] + reach_s]
            if not all(common.has_pose(self.ego, time_s) for time_s in times):
                lost.append(n)
        if len(lost) == len(self.frames):
            self.velo_at(self.scan_s[lost[0]])  # says what is wrong
            raise InputError("no frame has a vehicle pose", where=str(self.folder))
        if lost:
            log.warn(f"kitti: left out frames without a vehicle pose: {common.number_ranges(lost)}")
            self.frames = [n for n in self.frames if n not in lost]

    # --- boxes ---

    def read_tracks(self, world_from_velo: Mapping[int, Matrix]) -> list[Track]:
        """Tracks, told of in ``notes``; no box file is no tracks."""
        folder, boxes_file = self.folder, self.options.boxes
        if boxes_file is not None and not boxes_file.is_file():
            raise InputError("box file does not exist", where=str(boxes_file))
        names = ("tracklet_labels.xml", "label_02.txt", f"label_02/{self.options.sequence}.txt")
        paths = [*(folder / name for name in names), *(folder / "derived" / name for name in names[:2])]
        found = boxes_file or common.first_file(*paths)
        if found is None:
            self.notes.append("no boxes found: everything counts as static")
            return []
        if found.suffix == ".xml":
            boxes = kitti_files.read_tracklets(found)
        else:
            boxes = kitti_files.read_label_text(found, self.calibration.rect0_from_velo)
        velo_at = self.velo_at if self.untwist else None
        tracks, notes = kitti_files.build_tracks(boxes, world_from_velo, self.scan_s, str(found), velo_at)
        self.notes += [f"boxes from {found.name}", *notes]
        return tracks
