"""KITTI-360 importer: one drive of the data set's folder.

========================== =========================================================================================
``calibration/``           cameras, velodyne, SICK (``calib``)
``data_2d_raw/<drive>/``   ``image_00|01/data_rect`` (rectified stereo), ``image_02|03/data_rgb`` (fisheyes)
``data_3d_raw/<drive>/``   ``velodyne_points/data``, ``sick_points/data``, each with ``timestamps.txt``
``data_poses/<drive>/``    ``poses.txt`` (vehicle) or ``cam0_to_world.txt`` (rectified camera 0), for part of the frames
``data_3d_bboxes/``        ``train_full/<drive>.xml``, else ``train/<drive>.xml`` (``boxes``)
``data_2d_semantics/``     ``train/<drive>/image_00|01/semantic`` and ``confidence``, where there are any
========================== =========================================================================================

Frames. World: z up, origin and x axis at the vehicle of the first imported frame (the data set's own world lies kilometres
away). The vehicle is the GPS/IMU. ``image_00`` is called ``front``.

Time. All sensors of a frame share one moment, as the data set's own tools have it: the velodyne's time stamp. Poses are missing
where the vehicle hardly moves; they are interpolated there. Frames before the first and after the last pose are left out.

Scans are distorted by the vehicle's motion; they are untwisted here. The sensor turns clockwise seen from above in 0.1 s and
looks forward at the frame's moment (as the data set's tools have it). Lines of the SICK scanners, about four a frame, become
one sweep per frame.

Fisheye cameras are taken when they are asked for (``--cameras side_left side_right``): rectified to a pinhole camera that
looks along the lens' axis and is 90 degrees wide and high, with the lens' own resolution in its centre.
"""

from __future__ import annotations

import io
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from PIL import Image, UnidentifiedImageError

from mudg.base import log, store
from mudg.base.errors import InputError
from mudg.base.geometry import invert, transform_points
from mudg.base.palette import UNLABELLED
from mudg.base.types import EgoPath, Scene, Source, SweepPoints, Track
from mudg.data.importers import layout
from mudg.data.importers.box_tracks import BoxTracks
from mudg.data.importers.clouds import read_float_rows
from mudg.data.importers.common import (
    deskew,
    mended_path,
    origin_note,
    pose_near,
    rigid_pose,
    seconds,
    world_from_first,
)
from mudg.data.importers.drive_log import SceneContent, SceneImage, SceneSweep, write_scene
from mudg.data.importers.images import ImageFit, image_notes, image_size
from mudg.data.importers.kitti import poses as kitti_poses
from mudg.data.importers.kitti.scans import SENSOR, read_scan
from mudg.data.importers.kitti360.boxes import LABEL_OF, Kitti360Box, read_boxes
from mudg.data.importers.kitti360.calib import IMU_FROM_EGO, Kitti360Calibration, read_calibration
from mudg.data.importers.layout import LogFiles
from mudg.data.importers.options import ImportOptions
from mudg.data.scene.motion import GAP_M

Matrix = NDArray[np.float64]
LICENCE: Final = "CC BY-NC-SA 3.0 (KITTI-360: Liao, Xie, Geiger; attribution, non-commercial, share-alike)"
CAMERAS: Final = {"image_00": "front", "image_01": "front_stereo", "image_02": "side_left", "image_03": "side_right"}
USUAL: Final = ("image_00", "image_01")
SICK: Final = "sick"
FRAME_PERIOD_S: Final = 0.1
_SICK_REACH_S: Final = 0.055
_TRAIN_IDS: Final = {
    7: 0, 8: 1, 11: 2, 12: 3, 13: 4, 17: 5, 19: 6, 20: 7, 21: 8, 22: 9, 23: 10, 24: 11, 25: 12, 26: 13, 27: 14, 28: 15,
    31: 16, 32: 17, 33: 18, 34: 2, 35: 4, 37: 5,
}  # fmt: skip
"""The data set's class ids -> Cityscapes train ids (garage = building, gate = fence, small pole = pole); others unlabelled."""
_LAST_ID: Final = 44


@dataclass(frozen=True, slots=True)
class _Folders:
    """The data set's folder and the drive."""

    root: Path
    drive: str

    def images(self, camera: str) -> Path:
        return self.root / "data_2d_raw" / self.drive / camera / ("data_rect" if camera in USUAL else "data_rgb")

    def raw(self, sensor: str) -> Path:
        return self.root / "data_3d_raw" / self.drive / sensor

    def semantics(self, camera: str, kind: str, number: int) -> Path:
        return self.root / "data_2d_semantics" / "train" / self.drive / camera / kind / f"{number:010d}.png"

    def boxes(self) -> tuple[Path, Path]:
        """Where boxes may be, the better first."""
        folder = self.root / "data_3d_bboxes"
        return folder / "train_full" / f"{self.drive}.xml", folder / "train" / f"{self.drive}.xml"


def looks_like_kitti360(source: Path) -> bool:
    """Whether ``source`` is the data set's folder (``data_2d_raw`` and ``calibration`` in it), or a drive's in ``data_2d_raw``."""
    if not source.is_dir():
        return False
    root = source.absolute().parent.parent if source.absolute().parent.name == "data_2d_raw" else source
    return (root / "data_2d_raw").is_dir() and (root / "calibration" / "calib_cam_to_pose.txt").is_file()


def import_kitti360(source: Path, out: Path, options: ImportOptions) -> Scene:
    """Import one KITTI-360 drive into the scene directory ``out``; see the module text for what is understood.

    Args:
        source: the data set's folder, or ``data_2d_raw/<drive>`` in it.
        out: destination.
        options: ``sequence`` is the drive (``2013_05_28_drive_0000_sync``, or ``0000``); ``cameras`` default to the stereo
            pair; all others are used too.

    Raises:
        UsageError: there are several drives and none was chosen, or an option does not apply.
        InputError: something is missing, malformed or contradictory; nothing is left at ``out``.
    """
    folders = _find(source, options)
    calibration = read_calibration(folders.root / "calibration")
    images = {name: layout.numbered_files(folders.images(name), (".png", ".jpg")) for name in CAMERAS}
    available = {name: ours for name, ours in CAMERAS.items() if images[name] and name in calibration.ego_from_camera}
    chosen = layout.chosen_cameras(available, options, str(folders.root / "data_2d_raw" / folders.drive), USUAL)
    scans = layout.numbered_files(folders.raw("velodyne_points") / "data", (".bin",))
    streams = {**{name: images[name] for name in chosen}, **({SENSOR: scans} if scans else {})}
    notes: list[str] = []
    clock = _clock(folders, streams, notes)
    poses = _find_poses(folders, options)
    notes.append(f"poses from {poses.name}")
    ego = mended_path(_read_motion(poses, calibration, clock), options, notes)
    placed = {name: [n for n in found if _has_pose(ego, clock[n])] for name, found in streams.items()}
    frames = layout.complete_frames(placed, options, str(folders.root), "kitti360")
    notes += _without_pose(streams.values(), placed.values(), options)
    start_s = float(clock[frames[0]])
    first = pose_near(ego, clock[frames[0]])
    world_from_source = world_from_first(first)
    notes.append(origin_note(first))
    scene_s = seconds(clock[frames], "s", f"{folders.root}: timestamps of {folders.drive}", start_s)
    ego = EgoPath(ego.times_s - start_s, world_from_source @ ego.world_from_ego)
    fits = {CAMERAS[n]: calibration.fit(n, CAMERAS[n], image_size(images[n][frames[0]]), options) for n in chosen}
    untwist = bool(scans) and options.untwist != "no"
    if not scans:
        log.warn("kitti360: no scans found: the scene has images only, and there is nothing to fuse")
    elif untwist:
        notes.append("scans untwisted: clockwise turn of 0.1 s, forward at the frame's moment")
    notes += image_notes(fits)
    notes.append(f"source frames {frames[0]} to {frames[-1]} are frames 0 to {len(frames) - 1} here")
    sick = _SickLines.find(folders, calibration, ego, start_s, notes)
    tracks = _read_tracks(folders, options, dict(zip(frames, scene_s, strict=True)), world_from_source, notes)

    def convert(index: int) -> Iterable[SceneImage | SceneSweep]:
        number, time_s = frames[index], float(scene_s[index])
        world_from_ego = pose_near(ego, time_s)
        for name in chosen:
            world_from_cam = world_from_ego @ calibration.ego_from_camera[name]
            path, labels = images[name][number], _labels(folders, name, number, fits[CAMERAS[name]])
            yield SceneImage(CAMERAS[name], index, time_s, world_from_cam, path, str(path), labels)
        if number in scans:
            points = read_scan(scans[number])
            if untwist:
                points = _untwisted(points, ego, calibration, time_s)
            world_from_velo = world_from_ego @ calibration.ego_from_velo
            yield SceneSweep(SENSOR, index, time_s, world_from_velo, points, str(scans[number]))
        if sick is not None:
            yield from sick.sweeps(index, time_s)

    origin = Source("kitti360", LICENCE, None, tuple(notes))
    path = EgoPath(scene_s, np.stack([pose_near(ego, float(time_s)) for time_s in scene_s]))
    content = SceneContent(
        folders.drive, origin, fits, range(len(frames)), convert, lambda index: f"frame {frames[index]}", path,
        tracks=lambda: (tracks, ()),
    )  # fmt: skip
    return write_scene(content, out, options)


def _find(source: Path, options: ImportOptions) -> _Folders:
    if not source.is_dir():
        raise InputError("KITTI-360 folder does not exist", where=str(source), expected="a folder")
    if source.absolute().parent.name == "data_2d_raw":
        return _Folders(source.absolute().parent.parent, source.absolute().name)
    raw = source / "data_2d_raw"
    if not raw.is_dir():
        raise InputError("no KITTI-360 recording found", where=str(source), got=layout.folder_contents(source),
            expected="data_2d_raw, data_poses and calibration in it")  # fmt: skip
    drives = sorted(path.name for path in raw.iterdir() if path.is_dir())
    wanted = options.sequence
    matching = [d for d in drives if not wanted or d == wanted or d.removesuffix("_sync").endswith(f"_{wanted}")]
    return _Folders(source, layout.the_only(matching, drives, options, raw, "drive"))


def files_of_kitti360(source: Path, options: ImportOptions) -> LogFiles:
    """The calibration and the parts of the chosen drive."""
    folders = _find(source, options)
    root, drive = folders.root, folders.drive
    parts = [root / "calibration", *(root / name / drive for name in ("data_2d_raw", "data_3d_raw", "data_poses"))]
    parts += [root / "data_2d_semantics" / "train" / drive, *folders.boxes()]
    return LogFiles(tuple(part for part in parts if part.exists()))


def _without_pose(
    streams: Iterable[Iterable[int]], placed: Iterable[Iterable[int]], options: ImportOptions
) -> list[str]:
    """A note about the frames within ``options.frames`` that some stream has and none could place."""
    first, end = options.frames or (0, 2**63)
    lost = {n for found in streams for n in found if first <= n < end}.difference(*placed)
    return [f"frames without a pose or time stamp were left out: {layout.number_ranges(sorted(lost))}"] if lost else []


# --- time and motion ------------------------------------------------------------------------------------------------


def _clock(folders: _Folders, streams: Mapping[str, Mapping[int, Path]], notes: list[str]) -> NDArray[np.float64]:
    """Seconds by frame number, NaN where there is no stamp: the velodyne's, else camera 0's, else 10 Hz."""
    last = max(max(found) for found in streams.values())
    for path, files in (
        (folders.raw("velodyne_points") / "timestamps.txt", streams.get(SENSOR, {})),
        (folders.root / "data_2d_raw" / folders.drive / "image_00" / "timestamps.txt", streams.get("image_00", {})),
    ):
        if path.is_file():
            return _stamps(path, files, last)
    notes.append("no timestamps in the source: 10 Hz assumed")
    return np.arange(last + 1, dtype=np.float64) * FRAME_PERIOD_S


def _stamps(path: Path, files: Mapping[int, Path], last: int) -> NDArray[np.float64]:
    """Seconds by number, f64[last + 1] or more; NaN where there is no stamp. See ``read_timestamps``."""
    stamps = kitti_poses.read_timestamps(path, list(files), last)
    times = np.full(max(last, *stamps, 0) + 1, np.nan)
    times[list(stamps)] = list(stamps.values())
    return times


def _find_poses(folders: _Folders, options: ImportOptions) -> Path:
    here = folders.root / "data_poses" / folders.drive
    path = layout.first_file(*([options.poses] if options.poses else [here / "poses.txt", here / "cam0_to_world.txt"]))
    if path is None:
        raise InputError("no vehicle poses found", where=str(options.poses or here),
            expected="poses.txt or cam0_to_world.txt", remedy="download the data set's vehicle poses")  # fmt: skip
    return path


def _read_motion(path: Path, calibration: Kitti360Calibration, clock: NDArray[np.float64]) -> EgoPath:
    """The vehicle at the frames that have a pose, in the data set's world and clock."""
    numbers, poses, before = [], [], -1
    for index, line in kitti_poses.read_lines(path).items():
        where = f"{path}: line {index + 1}"
        row = kitti_poses.line_numbers(line, (13, 17), where, "pose")
        number = int(row[0])
        if number != row[0] or number <= before:
            raise InputError("first column is not a list of growing frame numbers", where=where, got=f"{row[0]:g}",
                remedy="is the file of another kind?")  # fmt: skip
        before = number
        if number < len(clock) and np.isfinite(clock[number]):
            pose = rigid_pose(row[1:].reshape(-1, 4), where)
            numbers.append(number)
            poses.append(pose @ (invert(calibration.imu_from_rect0) if len(row) == 17 else np.eye(4)))
    if not poses:
        raise InputError("no pose belongs to a frame", where=str(path),
            expected=f"frame numbers up to {len(clock) - 1}")  # fmt: skip
    times = clock[numbers]
    if (np.diff(times) <= 0).any():
        frame = numbers[int(np.flatnonzero(np.diff(times) <= 0)[0]) + 1]
        raise InputError("timestamps do not increase", where=f"{path}: frame {frame}")
    return EgoPath(times, np.stack(poses) @ IMU_FROM_EGO)


def _has_pose(ego: EgoPath, time_s: float) -> bool:
    """Whether there is a pose at a time, or the vehicle moved less than ``GAP_M`` between the poses around it. NaN: no."""
    if not np.isfinite(time_s):
        return False
    after = int(np.searchsorted(ego.times_s, time_s))
    if after < len(ego.times_s) and ego.times_s[after] - time_s < 1e-9:
        return True
    if after in (0, len(ego.times_s)):
        return False
    moved = ego.world_from_ego[after, :3, 3] - ego.world_from_ego[after - 1, :3, 3]
    return bool(np.linalg.norm(moved) < GAP_M)


def _untwisted(points: SweepPoints, ego: EgoPath, calibration: Kitti360Calibration, time_s: float) -> SweepPoints:
    """A scan as seen at its frame's moment: a point at azimuth a was measured a / 2 pi turns before it."""
    azimuth = np.arctan2(points.xyz[:, 1], points.xyz[:, 0])
    dt_s = (-azimuth / (2 * np.pi) * FRAME_PERIOD_S).astype(np.float32)
    xyz = deskew(points.xyz, dt_s, lambda t: pose_near(ego, t) @ calibration.ego_from_velo, time_s)
    return replace(points, xyz=xyz, dt_s=dt_s)


# --- SICK lines -------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, eq=False)
class _SickLines:
    """Line scans beside the frames: files, their times in the scene's clock, and where the scanner sits."""

    files: Mapping[int, Path]
    times_s: NDArray[np.float64]
    ego_from_sick: Matrix
    ego: EgoPath

    @classmethod
    def find(
        cls, folders: _Folders, calibration: Kitti360Calibration, ego: EgoPath, start_s: float, notes: list[str]
    ) -> _SickLines | None:
        files = layout.numbered_files(folders.raw("sick_points") / "data", (".bin",))
        stamps = folders.raw("sick_points") / "timestamps.txt"
        if not files:
            return None
        if calibration.velo_from_sick is None or not stamps.is_file():
            notes.append("SICK lines were left out: calib_sick_to_velo.txt or their timestamps.txt is missing")
            return None
        times = _stamps(stamps, files, max(files)) - start_s
        return cls(files, times, calibration.ego_from_velo @ calibration.velo_from_sick, ego)

    def sweeps(self, index: int, time_s: float) -> Iterable[SceneSweep]:
        """The lines within half a frame of frame ``index`` as one sweep, brought to that moment; none without lines."""
        pose = pose_near(self.ego, time_s) @ self.ego_from_sick
        parts, delays, no_returns = [], [], 0
        for number in np.flatnonzero(np.abs(self.times_s - time_s) < _SICK_REACH_S):
            late = float(self.times_s[number] - time_s)
            nearer = late >= FRAME_PERIOD_S / 2 or late < -FRAME_PERIOD_S / 2
            if int(number) not in self.files or nearer:
                continue
            line, without = _read_line(self.files[int(number)])
            no_returns += without
            parts.append(transform_points(invert(pose) @ pose_near(self.ego, time_s + late) @ self.ego_from_sick, line))
            delays.append(np.full(len(line), late, np.float32))
        xyz = np.concatenate(parts or [np.zeros((0, 3), np.float32)])
        if len(xyz):
            points = SweepPoints(xyz, np.zeros(len(xyz), np.float32), np.concatenate(delays), no_returns=no_returns)
            yield SceneSweep(SICK, index, time_s, pose, points)


def _read_line(path: Path) -> tuple[NDArray[np.float32], int]:
    """One SICK line f32[N, 3]: pairs of float32 in the scanner's plane (source: the data set's reader); and its beams without a return."""
    pairs, returns = read_float_rows(path, 2, "SICK line", axes=2)
    pairs = pairs[returns]
    return np.stack([np.zeros(len(pairs), np.float32), -pairs[:, 0], pairs[:, 1]], 1), int((~returns).sum())


# --- labels and boxes -------------------------------------------------------------------------------------------------


def _labels(folders: _Folders, camera: str, number: int, fit: ImageFit) -> dict[str, NDArray[Any]]:
    """Semantics and their confidence, where the data set has them."""
    path = folders.semantics(camera, "semantic", number)
    if not path.is_file():
        return {}
    ids = _grey(path)
    if ids.dtype != np.uint8 or (ids[ids != UNLABELLED] > _LAST_ID).any():
        raise InputError("semantic image holds ids that do not exist", where=str(path),
            expected=f"0..{_LAST_ID}, 8 bits")  # fmt: skip
    table = np.full(256, UNLABELLED, np.uint8)
    table[list(_TRAIN_IDS)] = list(_TRAIN_IDS.values())
    labels: dict[str, NDArray[Any]] = {"semantics": fit.ids(table[ids])}
    path = folders.semantics(camera, "confidence", number)
    if path.is_file():
        grey = _grey(path)
        scale = np.float32(255 if grey.dtype == np.uint8 else 65535)
        labels["semantics_confidence"] = fit.ids(grey.astype(np.float32) / scale)
    return labels


def _grey(path: Path) -> NDArray[Any]:
    """A PNG of one channel, u8 or u16 [H, W]."""
    try:
        with Image.open(io.BytesIO(store.read_bytes(path)), formats=("PNG",)) as image:
            if image.mode not in ("L", "P", "I;16", "I"):
                raise InputError("label image is not grey", where=str(path), got=f"mode {image.mode}",
                    expected="8 or 16 bits")  # fmt: skip
            array = np.array(image)
    except (UnidentifiedImageError, Image.DecompressionBombError, OSError, SyntaxError, ValueError, EOFError) as error:
        raise InputError("label image cannot be decoded (is it cut off?)", where=str(path), got=str(error)) from error
    return array if array.dtype == np.uint8 else array.astype(np.uint16)


def _read_tracks(
    folders: _Folders,
    options: ImportOptions,
    time_of: Mapping[int, float],
    world_from_source: Matrix,
    notes: list[str],
) -> list[Track]:
    """Tracks within the imported frames: moving boxes at their frames, standing ones over the window they were drawn in."""
    path = options.boxes or layout.first_file(*folders.boxes())
    if path is None:
        notes.append("no boxes found: everything counts as static")
        return []
    notes.append(f"boxes from {path.parent.name}/{path.name}")
    numbers = np.array(sorted(time_of))
    tracks = BoxTracks(str(path), LABEL_OF)
    left_out: Counter[str] = Counter()
    outside = 0
    standing: dict[str, tuple[Kitti360Box, list[int]]] = {}
    moving: dict[str, set[int]] = {}

    def add(name: str, box: Kitti360Box, frame: int) -> None:
        pose, still = world_from_source @ box.world_from_box, box.frame < 0
        tracks.add(name, tracks.label_of(box.label), time_of[frame], box.size_m, pose, standing=still)

    for box in read_boxes(path, left_out):
        if box.frame < 0:
            inside = numbers[(numbers >= box.window[0]) & (numbers <= box.window[1])]
            outside += not len(inside)
            if len(inside):
                standing.setdefault(box.object_id, (box, []))[1].extend((int(inside[0]), int(inside[-1])))
            continue
        seen = moving.setdefault(box.object_id, set())
        if box.frame in seen:  # the parts of a drive overlap; the data set's own reader keeps one box, too
            left_out["that an object has twice in a frame"] += 1
        elif box.frame in time_of:
            seen.add(box.frame)
            add(box.object_id, box, box.frame)
        else:
            outside += 1
    for name, (box, frames) in standing.items():
        for frame in dict.fromkeys((min(frames), max(frames))):
            add(f"s-{name}" if name in moving else name, box, frame)
    if outside:
        notes.append(f"{outside} boxes lie outside the imported frames and were left out")
    notes += [f"{count} boxes {what} were left out" for what, count in left_out.items()]
    result, track_notes = tracks.tracks()
    notes += track_notes
    return result
