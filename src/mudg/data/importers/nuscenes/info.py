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
from mudg.base.types import EgoPath, Scene, Source, Track
from mudg.data.importers import common, drive_log
from mudg.data.importers.box_tracks import box_size, check_sides
from mudg.data.importers.drive_log import DriveLog, ImageRecord, SweepRecord
from mudg.data.importers.layout import chosen_cameras, path_inside, refuse_options
from mudg.data.importers.nuscenes.importer import CAMERAS, LICENCE, SENSOR, camera_from_intrinsics, read_scan
from mudg.data.importers.options import ImportOptions
from mudg.data.scene import decode_image

Matrix = NDArray[np.float64]
_MAX_RECOGNISED_BYTES: Final = 16 * 1024 * 1024


def looks_like_info_frame(source: Path) -> bool:
    """Whether ``source/info.json`` says that it describes nuScenes."""
    path = source / "info.json"
    if not path.is_file() or path.stat().st_size > _MAX_RECOGNISED_BYTES:
        return False
    try:
        meta = json.loads(path.read_bytes())["metainfo"]
    except (ValueError, KeyError, TypeError, OSError):
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
        inside = ", ".join(sorted(entry.name for entry in source.iterdir())[:10]) or "nothing"
        raise InputError(
            "no nuScenes tables found",
            where=str(source),
            expected="v1.0-mini, v1.0-trainval or v1.0-test with scene.json and sample_data.json",
            got=inside,
            remedy="give the folder that holds v1.0-*, samples and sweeps",
        )
    where = str(path)
    refuse_options(options, "single-frame nuScenes", "sequence")
    try:
        record = json.loads(
            store.read_bytes(path)
        )  # unknown velocities are NaN there; what is used is checked to be finite
        drive = _drive_log(source, record["metainfo"], record["data_list"][0], where, options)
    except (KeyError, IndexError, TypeError, ValueError, RecursionError) as error:
        raise InputError(
            "frame record is malformed or incomplete",
            where=where,
            got=repr(error),
            expected="metainfo.categories and data_list[0] with images, lidar_points, ego2global and instances",
        ) from error
    log.info(f"nuscenes: one frame from {where}")
    return drive_log.write_log(drive, out, options)


def _drive_log(
    source: Path, meta: dict[str, Any], sample: dict[str, Any], where: str, options: ImportOptions
) -> DriveLog:
    map_from_ego = common.rigid_pose(sample["ego2global"], f"{where}: ego2global")
    lidar = sample["lidar_points"]
    map_from_lidar = map_from_ego @ common.rigid_pose(lidar["lidar2ego"], f"{where}: lidar2ego")
    names = {raw: name for raw, name in CAMERAS.items() if raw in sample["images"]}
    chosen = {names[raw]: raw for raw in chosen_cameras(names, options, where, tuple(CAMERAS))}
    cameras, images = {}, []
    for name, raw in chosen.items():
        item = sample["images"][raw]
        image_path = path_inside(source, item["img_path"], f"{where}: {raw}")
        height, width = decode_image(store.read_bytes(image_path), str(image_path)).shape[:2]
        cameras[name] = camera_from_intrinsics(name, width, height, item["cam2img"], f"{where}: {raw}.cam2img")
        # lidar2cam holds the vehicle's motion between the two moments, which cam2ego alone does not
        lidar_from_cam = invert(common.rigid_pose(item["lidar2cam"], f"{where}: {raw}.lidar2cam"))
        images.append(ImageRecord(name, 0.0, map_from_lidar @ lidar_from_cam, image_path))
    scan = path_inside(source, lidar["lidar_path"], f"{where}: lidar_path")
    sweeps = [SweepRecord(SENSOR, 0.0, map_from_lidar, scan, partial(read_scan, scan))]
    ego = EgoPath(np.zeros(1), map_from_ego[None])
    tracks = _tracks(meta, sample.get("instances", []), map_from_lidar, where)
    notes = ("one key frame: images and sweep, up to 0.05 s apart, count as one moment",)
    origin = Source("nuscenes", LICENCE, None, notes)
    return DriveLog(source.resolve().name, cameras, next(iter(chosen)), images, sweeps, tracks, ego, origin, where)


def _tracks(meta: dict[str, Any], instances: list[dict[str, Any]], map_from_lidar: Matrix, where: str) -> list[Track]:
    """One track with one key per box; boxes of no category (-1) are left out."""
    names = {int(number): str(name) for name, number in meta["categories"].items()}
    tracks = []
    for index, item in enumerate(instances):
        if int(item["bbox_label_3d"]) < 0:
            continue
        here = f"{where}: instances[{index}]"
        if int(item["bbox_label_3d"]) not in names:
            raise InputError(
                "box has a class that metainfo.categories lacks", where=here, got=str(item["bbox_label_3d"]),
                expected=", ".join(f"{number} ({name})" for number, name in names.items())[:200],
            )  # fmt: skip
        x, y, z, length, width, height, yaw = (float(value) for value in item["bbox_3d"])
        size = box_size(length, width, height, here)
        if not np.isfinite([x, y, z, yaw]).all():
            raise InputError("box is not finite", where=here, got=str(item["bbox_3d"]))
        pose = map_from_lidar @ yaw_matrix(yaw, (x, y, z))
        tracks.append(Track(str(index), names[int(item["bbox_label_3d"])], np.array(size), np.zeros(1), pose[None]))
    check_sides(tracks, where)
    return tracks
