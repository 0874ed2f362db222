"""One key frame of nuScenes described by an ``info.json``: images and sweep beside it, matrices instead of tables.

The file is the usual per-frame record of detection code bases, written as JSON: per camera ``cam2img``, ``cam2ego`` and ``lidar2cam``,
``ego2global``, ``lidar2ego``, and boxes (centre, length, width, height, yaw) in the LiDAR's axes.
"""

from __future__ import annotations

import json
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from mudg.base import log, store
from mudg.base.errors import InputError
from mudg.base.geometry import invert, yaw_matrix
from mudg.base.types import EgoPath, Scene, Source
from mudg.data.importers import common, drive_log
from mudg.data.importers.drive_log import DriveLog, ImageRecord, SweepRecord
from mudg.data.importers.images import image_size
from mudg.data.importers.info_frames import Size, info_record, info_tracks
from mudg.data.importers.layout import chosen_cameras, folder_contents, path_inside, refuse_options
from mudg.data.importers.nuscenes.sensors import CAMERAS, LICENCE, SENSOR, camera_from_intrinsics, read_scan
from mudg.data.importers.options import ImportOptions

Matrix = NDArray[np.float64]
_MAX_RECOGNISED_BYTES: Final = 16 * 1024 * 1024


def looks_like_info_frame(source: Path) -> bool:
    """Whether ``source/info.json`` says that it describes nuScenes."""
    path = source / "info.json"
    if not path.is_file() or path.stat().st_size > _MAX_RECOGNISED_BYTES:
        return False
    try:
        meta = json.loads(store.read_bytes(path))["metainfo"]
    except (ValueError, RecursionError, KeyError, TypeError, OSError):
        return False
    return isinstance(meta, dict) and str(meta.get("dataset", meta.get("DATASET", ""))).lower() == "nuscenes"


def import_info_frame(source: Path, out: Path, options: ImportOptions) -> Scene:
    """Import the one frame that ``source/info.json`` describes.

    Raises:
        UsageError: a sequence was named: there is none.
        InputError: the record is incomplete, or an image or the sweep is missing or damaged.
    """
    path = source / "info.json"
    if not path.is_file():
        raise InputError("no nuScenes tables found", where=str(source), got=folder_contents(source),
            expected="v1.0-mini, v1.0-trainval or v1.0-test with scene.json and sample_data.json",
            remedy="give the folder that holds v1.0-*, samples and sweeps")  # fmt: skip
    refuse_options(options, "single-frame nuScenes", "sequence")
    expected = "metainfo.categories and data_list[0] with images, lidar_points, ego2global and instances"
    with info_record(path, expected) as record:
        drive = _drive_log(source, record["metainfo"], record["data_list"][0], options)
    log.info(f"nuscenes: one frame from {path}")
    return drive_log.write_log(drive, out, options)


def _drive_log(source: Path, meta: dict[str, Any], sample: dict[str, Any], options: ImportOptions) -> DriveLog:
    where = str(source / "info.json")
    map_from_ego = common.rigid_pose(sample["ego2global"], f"{where}: ego2global")
    lidar = sample["lidar_points"]
    map_from_lidar = map_from_ego @ common.rigid_pose(lidar["lidar2ego"], f"{where}: lidar2ego")
    names = {raw: name for raw, name in CAMERAS.items() if raw in sample["images"]}
    chosen = {names[raw]: raw for raw in chosen_cameras(names, options, where, tuple(CAMERAS))}
    cameras, images = {}, []
    for name, raw in chosen.items():
        item = sample["images"][raw]
        image_path = path_inside(source, item["img_path"], f"{where}: {raw}")
        cameras[name] = camera_from_intrinsics(name, image_size(image_path), item["cam2img"], f"{where}: {raw}.cam2img")
        # lidar2cam holds the vehicle's motion between the two moments, which cam2ego alone does not
        lidar_from_cam = invert(common.rigid_pose(item["lidar2cam"], f"{where}: {raw}.lidar2cam"))
        images.append(ImageRecord(name, 0.0, map_from_lidar @ lidar_from_cam, image_path))
    scan = path_inside(source, lidar["lidar_path"], f"{where}: lidar_path")
    sweeps = [SweepRecord(SENSOR, 0.0, map_from_lidar, scan, partial(read_scan, scan))]

    def shape(values: list[float]) -> tuple[Size, Matrix]:
        x, y, z, length, width, height, yaw = values
        return (length, width, height), map_from_lidar @ yaw_matrix(yaw, (x, y, z))

    labels = {int(number): str(name) for name, number in meta["categories"].items()}
    tracks = info_tracks(sample.get("instances", []), labels, where, shape)
    notes = ("one key frame: images and sweep, up to 0.05 s apart, count as one moment",)
    origin, ego = Source("nuscenes", LICENCE, None, notes), EgoPath(np.zeros(1), map_from_ego[None])
    return DriveLog(source.resolve().name, cameras, next(iter(chosen)), images, sweeps, tracks, ego, origin, where)
