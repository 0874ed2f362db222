"""KITTI-360 importer: one drive of the data set's folder (docs/formats/kitti360.md). World: z up, origin and x at the
vehicle (the GPS/IMU) of the first imported frame. All sensors of a frame share the velodyne's time stamp.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, Final
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

from mudg.base import log, store
from mudg.base.errors import InputError
from mudg.base.geometry import from_rotation_translation, invert
from mudg.base.palette import UNLABELLED
from mudg.base.types import EgoPath, Scene, Source, Track
from mudg.formats.importers import common
from mudg.formats.importers.common import ImportOptions, LogFiles, name_table
from mudg.formats.importers.drive_log import BoxTracks, SceneContent, SceneImage, SceneSweep, write_scene
from mudg.formats.importers.images import ImageFit, fit_images, image_notes, image_size
from mudg.formats.importers.kitti import (
    SENSOR,
    KittiBox,
    line_numbers,
    pose_entry,
    read_lines,
    read_number_table,
    read_scan,
    read_timestamps,
    rotation_entry,
    table_entry,
    xml_elements,
    xml_number,
)
from mudg.formats.unknown_fields import note_unknown
from mudg.scene.labels import decode_grey
from mudg.scene.motion import GAP_M

# boxes --------------------------------------------------------------------------------------------
#
# OpenCV-style matrices in XML. An object's ``transform`` maps its ``vertices`` (a unit cube) to the world and holds the
# size as scale. Static objects have ``timestamp`` -1 and a window of frames; moving ones have an entry per frame.
_IDS: Final = """car: 13; truck: 14; trailer: 15; caravan: 16; motorcycle: 17; bicycle: 18; person: 19; rider: 20;
    train: 33; bus: 34; unknown vehicle: 36"""
LABEL_OF_ID: Final = {int(number): name for number, name in name_table(_IDS).items()}
"""The annotation tool's class numbers (``semanticId``) of what can move. Source: the label table (kittiId)."""
LABEL_OF: Final = name_table(
    """car: car; truck: truck; bus: bus; caravan: caravan; trailer: trailer; train: train;
    motorcycle: motorcycle; bicycle: bicycle; pedestrian: person, pedestrian; cyclist: rider;
    vehicle: unknown vehicle"""
)
"""Classes that become tracks -> the labels of this package. Buildings, poles, vegetation and ground are no tracks."""
_OFFICIAL: Final = frozenset(
    """index label category semanticId semanticId_orig instanceId timestamp start_frame end_frame dynamic dynamicSeq
    dynamicIdx dynamicIndex level_min level_max color transform vertices faces""".split()
)
"""Fields of the data set's objects, read or not."""
VEHICLES: Final = frozenset(("car", "truck", "bus", "caravan", "trailer", "train", "motorcycle", "bicycle"))
_MAX_SHEAR: Final = 0.05


def read_boxes(path: Path, left_out: Counter[str]) -> Iterator[tuple[KittiBox, tuple[int, int]]]:
    """Boxes of the classes in ``LABEL_OF`` in an XML file, one by one (``frame`` -1: an object that stands), each with
    the first and last frame of the part of the drive it was drawn in; ``left_out`` is filled with what is not read
    (``that are not cuboids``) and how often."""
    for number, item in enumerate(xml_elements(path, 1)):
        where = f"{path}: object {number} ({item.tag})"
        if item.find("transform") is None:
            continue
        note_unknown(path.name, [field.tag for field in item], _OFFICIAL)
        if item.find("semanticId") is not None:
            label = LABEL_OF_ID.get(xml_number(item, "semanticId", where, int), "")
        else:  # words are told apart by capital letters only
            label = re.sub("([A-Z])", r" \1", item.findtext("label", "").strip()).lower().strip()
        if label not in LABEL_OF:
            left_out["of classes that do not move"] += 1
            continue
        frame = xml_number(item, "timestamp", where, int)
        shape = _shape(_matrix(item, "transform", where), _matrix(item, "vertices", where), label, where)
        if shape is None:
            left_out["that are not cuboids"] += 1
            continue
        size_m, pose = shape
        window = (0, 2**31) if frame < 0 else (frame, frame)
        if item.find("start_frame") is not None:
            window = xml_number(item, "start_frame", where, int), xml_number(item, "end_frame", where, int)
        if item.find("instanceId") is not None and item.find("semanticId") is not None:
            name = "-".join(str(xml_number(item, key, where, int)) for key in ("semanticId", "instanceId"))
        elif frame >= 0 and item.find("dynamicSeq") is not None:
            name = f"d-{xml_number(item, 'dynamicSeq', where, int)}"
        else:
            name = f"i-{xml_number(item, 'index', where, int)}"
        yield KittiBox(frame, name, label, size_m, pose), window


def _matrix(item: ElementTree.Element, key: str, where: str) -> Matrix:
    node = item.find(key)
    if node is None:
        raise InputError(f"box has no {key}", where=where)
    where = f"{where}.{key}"
    rows, columns = (xml_number(node, side, where, int) for side in ("rows", "cols"))
    if min(rows, columns) < 1:
        raise InputError("matrix has no size", where=where, got=f"{rows} x {columns}", expected="rows and columns")
    return line_numbers(node.findtext("data", ""), (rows * columns,), where, "matrix").reshape(rows, columns)


def _shape(
    transform: Matrix, vertices: Matrix, label: str, where: str
) -> tuple[tuple[float, float, float], Matrix] | None:
    """Size and pose of the box, or None if it is sheared. The axis that stands upright becomes z. Of the others, the
    first becomes x, for vehicles the longer one: which of them the annotation tool called x does not matter."""
    if transform.shape != (4, 4) or vertices.shape[1] != 3 or np.abs(transform[3] - [0, 0, 0, 1]).max() > 1e-6:
        got = f"transform {transform.shape} ending {transform[-1].tolist()}, vertices {vertices.shape}"
        raise InputError("box is not a 4x4 transform of 3-D vertices", where=where, got=got)
    low, high = vertices.min(0), vertices.max(0)
    scale = np.linalg.norm(transform[:3, :3], axis=0)
    sizes = scale * (high - low)
    if (sizes <= 0).any():
        raise InputError("box size is not positive", where=where, got=str(sizes.tolist()))
    axes = transform[:3, :3] / scale
    if max(abs(axes[:, a] @ axes[:, b]) for a, b in ((0, 1), (0, 2), (1, 2))) > _MAX_SHEAR:
        return None
    up = int(np.abs(axes[2]).argmax())
    first, second = (index for index in range(3) if index != up)
    if label in VEHICLES and sizes[second] > sizes[first]:
        first, second = second, first
    z = axes[:, up] * (1 if axes[2, up] > 0 else -1)
    x = axes[:, first] - z * (axes[:, first] @ z)
    x /= np.linalg.norm(x)
    rotation = np.stack([x, np.cross(z, x), z], 1)
    centre = transform[:3, :3] @ ((low + high) / 2) + transform[:3, 3]
    return (float(sizes[first]), float(sizes[second]), float(sizes[up])), from_rotation_translation(rotation, centre)


# calib --------------------------------------------------------------------------------------------
#
# Rectified cameras and the LiDAR, all on the vehicle. The data set's vehicle frame is that of the GPS/IMU: x forward, y
# right, z down. The ego frame here is the same point, y to the left and z up.
IMU_FROM_EGO: Final = np.diag([1.0, -1.0, -1.0, 1.0])


def read_calibration(folder: Path) -> tuple[dict[str, Matrix], Matrix]:
    """Poses f64[4, 4] on the vehicle of the rectified cameras ``image_00``, ``image_01`` and of the velodyne."""
    path, perspective = folder / "calib_cam_to_pose.txt", folder / "perspective.txt"
    table, rectified = read_number_table(path), read_number_table(perspective)
    imu_from_camera = {n: pose_entry(table, (n,), path) for n in CAMERAS if n == "image_00" or n in table}
    path = folder / "calib_cam_to_velo.txt"
    numbers = line_numbers(store.read_text(path).replace("\n", " "), (12,), str(path), "calibration")
    velo_from_camera = common.rigid_pose(numbers.reshape(3, 4), str(path))
    ego_from_camera = {
        name: invert(IMU_FROM_EGO) @ pose @ invert(rotation_entry(rectified, (f"R_rect_{name[-2:]}",), perspective))
        for name, pose in imu_from_camera.items()
    }
    return ego_from_camera, invert(IMU_FROM_EGO) @ imu_from_camera["image_00"] @ invert(velo_from_camera)


def _fit(path: Path, camera: str, size: tuple[int, int], options: ImportOptions) -> ImageFit:
    """How images of ``camera`` (``image_00``), of ``size`` (width, height), become those of the scene's."""
    table, entry = read_number_table(path), f"S_rect_{camera[-2:]}"
    projection = table_entry(table, (f"P_rect_{camera[-2:]}",), (3, 4), path)
    declared = tuple(int(side) for side in table_entry(table, (entry,), (2,), path))
    if size != declared:
        what, expected = "images do not have the size that the calibration is for", f"{declared[0]}x{declared[1]}"
        got, remedy = f"{size[0]}x{size[1]}", "use the images as the data set ships them"
        raise InputError(what, where=f"{path}: {entry}", expected=expected, got=got, remedy=remedy)
    where = f"{path}: P_rect_{camera[-2:]}"
    return fit_images(common.pinhole_camera(CAMERAS[camera], size, projection[:, :3], where), options)


# importer -----------------------------------------------------------------------------------------
Matrix = NDArray[np.float64]
LICENCE: Final = "CC BY-NC-SA 3.0 (KITTI-360: Liao, Xie, Geiger; attribution, non-commercial, share-alike)"
CAMERAS: Final = {"image_00": "front", "image_01": "front_stereo"}
FRAME_PERIOD_S: Final = 0.1
_TRAIN_IDS: Final = dict(zip((7, 8, 11, 12, 13, 17, *range(19, 29), 31, 32, 33), range(19), strict=True))
_TRAIN_IDS.update({34: 2, 35: 4, 37: 5})
"""The data set's class ids -> Cityscapes train ids (garage = building, gate = fence, small pole = pole); others
unlabelled."""
_LAST_ID: Final = 44


def looks_like_kitti360(source: Path) -> bool:
    """Whether ``source`` is the data set's folder, or a drive's in its ``data_2d_raw``."""
    if not source.is_dir():
        return False
    root = source.absolute().parent.parent if source.absolute().parent.name == "data_2d_raw" else source
    return (root / "data_2d_raw").is_dir() and (root / "calibration" / "calib_cam_to_pose.txt").is_file()


def files_of_kitti360(source: Path, options: ImportOptions) -> LogFiles:
    """The calibration and the parts of the chosen drive."""
    root, drive = _find(source, options)
    parts = [root / "calibration", *(root / name / drive for name in ("data_2d_raw", "data_3d_raw", "data_poses"))]
    parts += [root / "data_2d_semantics" / "train" / drive, *_box_files(root, drive)]
    return LogFiles(tuple(part for part in parts if part.exists()))


def _find(source: Path, options: ImportOptions) -> tuple[Path, str]:
    """The data set's folder and the drive."""
    if source.absolute().parent.name == "data_2d_raw":
        return source.absolute().parent.parent, source.absolute().name
    raw, wanted = source / "data_2d_raw", options.sequence
    drives = {path.name: path.name for path in (sorted(raw.iterdir()) if raw.is_dir() else ()) if path.is_dir()}
    fits = lambda drive: drive == wanted or drive.removesuffix("_sync").endswith(f"_{wanted}")
    expected = "data_2d_raw, data_poses and calibration in the data set's folder"
    return source, common.the_only(drives, options, raw, "KITTI-360 drive", expected, fits)


def _box_files(root: Path, drive: str) -> list[Path]:
    """Where boxes may be, the better first."""
    return [root / "data_3d_bboxes" / name / f"{drive}.xml" for name in ("train_full", "train")]


def import_kitti360(source: Path, out: Path, options: ImportOptions) -> Scene:
    """Import one drive of the data set's folder, or ``data_2d_raw/<drive>`` in it. ``options.sequence``: the drive
    (``2013_05_28_drive_0000_sync``, or ``0000``)."""
    root, drive = _find(source, options)
    images_folder, raw_folder = root / "data_2d_raw" / drive, root / "data_3d_raw" / drive
    ego_from_camera, ego_from_velo = read_calibration(root / "calibration")
    images = {n: common.numbered_files(images_folder / n / "data_rect", (".png", ".jpg")) for n in CAMERAS}
    available = {name: ours for name, ours in CAMERAS.items() if images[name] and name in ego_from_camera}
    chosen = common.chosen_cameras(available, options, str(images_folder), tuple(CAMERAS))
    scans = common.numbered_files(raw_folder / "velodyne_points" / "data", (".bin",))
    streams = {**{name: images[name] for name in chosen}, **({SENSOR: scans} if scans else {})}
    notes: list[str] = []
    clock = _clock(raw_folder / "velodyne_points", images_folder / "image_00", streams, notes)
    poses = options.poses or root / "data_poses" / drive / "poses.txt"
    if not poses.is_file():
        remedy = "download the data set's vehicle poses"
        raise InputError("no vehicle poses found", where=str(poses), expected="poses.txt", remedy=remedy)
    ego = common.mended_path(_read_motion(poses, clock), notes)
    placed = {name: [n for n in found if _has_pose(ego, clock[n])] for name, found in streams.items()}
    frames = common.complete_frames(placed, options, str(root), "kitti360")
    begin, end = options.frames or (0, 2**63)
    lost = {n for found in streams.values() for n in found if begin <= n < end}.difference(*placed.values())
    if lost:
        notes.append(f"frames without a pose or time stamp were left out: {common.number_ranges(sorted(lost))}")
    start_s = float(clock[frames[0]])
    first = common.pose_near(ego, clock[frames[0]])
    world_from_source = common.world_from_first(first)
    notes.append(common.origin_note(first))
    scene_s = common.seconds(clock[frames], "s", f"{root}: timestamps of {drive}", start_s)
    ego = EgoPath(ego.times_s - start_s, world_from_source @ ego.world_from_ego)
    calibration = root / "calibration" / "perspective.txt"
    fits = {CAMERAS[n]: _fit(calibration, n, image_size(images[n][frames[0]]), options) for n in chosen}
    untwist = bool(scans) and options.untwist != "no"
    if not scans:
        log.warn("kitti360: no scans found: the scene has images only, and there is nothing to fuse")
    elif untwist:
        notes.append("scans untwisted: clockwise turn of 0.1 s, forward at the frame's moment")
    notes += image_notes(fits)
    notes.append(f"source frames {frames[0]} to {frames[-1]} are frames 0 to {len(frames) - 1} here")
    boxes = options.boxes or common.first_file(*_box_files(root, drive))
    tracks = _read_tracks(boxes, dict(zip(frames, scene_s, strict=True)), world_from_source, notes)

    def world_from_velo(time_s: float) -> Matrix:
        return common.pose_near(ego, time_s) @ ego_from_velo

    def convert(index: int) -> Iterable[SceneImage | SceneSweep]:
        number, time_s = frames[index], float(scene_s[index])
        for name in chosen:
            world_from_cam = common.pose_near(ego, time_s) @ ego_from_camera[name]
            path, semantics = images[name][number], root / "data_2d_semantics" / "train" / drive / name
            labels = _labels(semantics, f"{number:010d}.png", fits[CAMERAS[name]])
            yield SceneImage(CAMERAS[name], index, time_s, world_from_cam, path, str(path), labels)
        if number in scans:
            points = read_scan(scans[number])
            if untwist:  # a point at azimuth a was measured a / 2 pi turns before the frame's moment
                azimuth = np.arctan2(points.xyz[:, 1], points.xyz[:, 0])
                dt_s = (-azimuth / (2 * np.pi) * FRAME_PERIOD_S).astype(np.float32)
                points = replace(points, xyz=common.deskew(points.xyz, dt_s, world_from_velo, time_s), dt_s=dt_s)
            yield SceneSweep(SENSOR, index, time_s, world_from_velo(time_s), points, str(scans[number]))

    origin = Source("kitti360", LICENCE, None, tuple(notes))
    path = EgoPath(scene_s, np.stack([common.pose_near(ego, float(time_s)) for time_s in scene_s]))
    items = range(len(frames))
    content = SceneContent(
        drive, origin, fits, items, convert, lambda n: f"frame {frames[n]}", path, lambda: (tracks, ())
    )
    return write_scene(content, out, options)


# --- time and motion ------------------------------------------------------------------------------


def _clock(
    velodyne: Path, camera: Path, streams: Mapping[str, Mapping[int, Path]], notes: list[str]
) -> NDArray[np.float64]:
    """Seconds by frame number, NaN where there is no stamp: the velodyne's, else camera 0's, else 10 Hz."""
    last = max(max(found) for found in streams.values())
    for folder, files in ((velodyne, streams.get(SENSOR, {})), (camera, streams.get("image_00", {}))):
        if (folder / "timestamps.txt").is_file():
            stamps = read_timestamps(folder / "timestamps.txt", list(files), last)
            times = np.full(max(last, *stamps, 0) + 1, np.nan)
            times[list(stamps)] = list(stamps.values())
            return times
    notes.append("no timestamps in the source: 10 Hz assumed")
    return np.arange(last + 1, dtype=np.float64) * FRAME_PERIOD_S


def _read_motion(path: Path, clock: NDArray[np.float64]) -> EgoPath:
    """The vehicle at the frames that have a pose, in the data set's world and clock."""
    numbers, poses, before = [], [], -1
    for index, line in read_lines(path).items():
        where = f"{path}: line {index + 1}"
        row = line_numbers(line, (13,), where, "pose")
        number = int(row[0])
        if number != row[0] or number <= before:
            what = "first column is not a list of growing frame numbers"
            raise InputError(what, where=where, got=f"{row[0]:g}", remedy="is the file of another kind?")
        before = number
        if number < len(clock) and np.isfinite(clock[number]):
            numbers.append(number)
            poses.append(common.rigid_pose(row[1:].reshape(3, 4), where))
    if not poses:
        what = "no pose belongs to a frame"
        raise InputError(what, where=str(path), expected=f"frame numbers up to {len(clock) - 1}")
    times = clock[numbers]
    if (np.diff(times) <= 0).any():
        frame = numbers[int(np.flatnonzero(np.diff(times) <= 0)[0]) + 1]
        raise InputError("timestamps do not increase", where=f"{path}: frame {frame}")
    return EgoPath(times, np.stack(poses) @ IMU_FROM_EGO)


def _has_pose(ego: EgoPath, time_s: float) -> bool:
    """Whether there is a pose at a time (not NaN), or the vehicle moved less than ``GAP_M`` between those around it."""
    if not np.isfinite(time_s):
        return False
    after = int(np.searchsorted(ego.times_s, time_s))
    if after < len(ego.times_s) and ego.times_s[after] - time_s < 1e-9:
        return True
    if after in (0, len(ego.times_s)):
        return False
    moved = ego.world_from_ego[after, :3, 3] - ego.world_from_ego[after - 1, :3, 3]
    return bool(np.linalg.norm(moved) < GAP_M)


# --- labels and boxes -----------------------------------------------------------------------------


def _labels(folder: Path, name: str, fit: ImageFit) -> dict[str, NDArray[Any]]:
    """Semantics and their confidence, where the data set has them."""
    path = folder / "semantic" / name
    if not path.is_file():
        return {}
    ids = decode_grey(store.read_bytes(path), str(path), (8, 16))
    if ids.dtype != np.uint8 or (ids[ids != UNLABELLED] > _LAST_ID).any():
        what = "semantic image holds ids that do not exist"
        raise InputError(what, where=str(path), expected=f"0..{_LAST_ID}, 8 bits")
    table = np.full(256, UNLABELLED, np.uint8)
    table[list(_TRAIN_IDS)] = list(_TRAIN_IDS.values())
    labels: dict[str, NDArray[Any]] = {"semantics": fit.ids(table[ids])}
    path = folder / "confidence" / name
    if path.is_file():
        grey = decode_grey(store.read_bytes(path), str(path), (8, 16))
        scale = np.float32(255 if grey.dtype == np.uint8 else 65535)
        labels["semantics_confidence"] = fit.ids(grey.astype(np.float32) / scale)
    return labels


def _read_tracks(
    path: Path | None, time_of: Mapping[int, float], world_from_source: Matrix, notes: list[str]
) -> list[Track]:
    """Tracks within the imported frames: moving boxes at their frames, standing ones over their windows."""
    if path is None:
        notes.append("no boxes found: everything counts as static")
        return []
    notes.append(f"boxes from {path.parent.name}/{path.name}")
    numbers = np.array(sorted(time_of))
    tracks = BoxTracks(str(path), LABEL_OF)
    left_out: Counter[str] = Counter()
    outside = 0
    standing: dict[str, tuple[KittiBox, list[int]]] = {}
    moving: dict[str, set[int]] = {}

    def add(name: str, box: KittiBox, frame: int) -> None:
        pose, still = world_from_source @ box.pose, box.frame < 0
        tracks.add(name, tracks.label_of(box.label), time_of[frame], box.size_m, pose, standing=still)

    for box, (first, last) in read_boxes(path, left_out):
        if box.frame < 0:
            inside = numbers[(numbers >= first) & (numbers <= last)].tolist()
            outside += not inside
            if inside:
                standing.setdefault(box.track, (box, []))[1].extend((inside[0], inside[-1]))
            continue
        seen = moving.setdefault(box.track, set())
        if box.frame in seen:  # the parts of a drive overlap; the data set's own reader keeps one box, too
            left_out["that an object has twice in a frame"] += 1
        elif box.frame in time_of:
            seen.add(box.frame)
            add(box.track, box, box.frame)
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
