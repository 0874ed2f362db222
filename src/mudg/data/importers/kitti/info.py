"""A single KITTI frame described by ``info.json``: the annotation record of common detection tool boxes, written as JSON.

The folder holds the image and the scan that the record names. Boxes are rectified camera 0, bottom centre, length,
height, width, turn about the camera's y axis.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, Final

import numpy as np

from mudg.base import log, store
from mudg.base.errors import InputError
from mudg.base.geometry import from_rotation_translation, invert
from mudg.base.types import EgoPath, Scene, Source, View
from mudg.data.importers.common import rigid_rotation
from mudg.data.importers.drive_log import path_inside
from mudg.data.importers.images import fit_images
from mudg.data.importers.kitti import boxes as kitti_boxes
from mudg.data.importers.kitti.calib import KittiCalibration
from mudg.data.importers.layout import chosen_cameras, refuse_options
from mudg.data.importers.options import ImportOptions
from mudg.data.scene import SceneWriter, decode_image

LABELS: Final = ("pedestrian", "cyclist", "car", "van", "truck", "person_sitting", "tram", "misc")
_CAMERA: Final = "CAM2"


def import_info_frame(source: Path, out: Path, options: ImportOptions) -> Scene:
    """Import the one frame that ``source/info.json`` describes.

    Raises:
        UsageError: an option that a single frame has no use for.
        InputError: the record is incomplete, or image or scan is missing or damaged.
    """
    from mudg.data.importers.kitti.importer import LICENCE, SENSOR, read_scan

    where = str(source / "info.json")
    refuse_options(options, "single-frame KITTI", "frames", "sequence", "poses", "boxes")
    chosen_cameras({_CAMERA: "front"}, options, where, (_CAMERA,))
    record = store.read_json(source / "info.json")
    try:
        sample = record["data_list"][0]
        image_record, lidar = sample["images"][_CAMERA], sample["lidar_points"]
        image_path, scan_path = (
            path_inside(source, image_record["img_path"], f"{where}: img_path"),
            path_inside(source, lidar["lidar_path"], f"{where}: lidar_path"),
        )
        projection = np.array(image_record["cam2img"], np.float64)[:3]
        rect0_from_velo = np.array(image_record["lidar2cam"], np.float64)
        rect0_from_velo = from_rotation_translation(
            rigid_rotation(rect0_from_velo[:3, :3], f"{where}: lidar2cam"), rect0_from_velo[:3, 3]
        )
        calibration = KittiCalibration({2: projection}, rect0_from_velo, None, where)
        boxes = _boxes(sample.get("instances", []), rect0_from_velo, where)
    except (KeyError, IndexError, TypeError, ValueError) as error:
        raise InputError("frame record is incomplete", where=where, got=repr(error),
                         expected="data_list[0] with images.CAM2, lidar_points and instances") from error  # fmt: skip
    height, width = decode_image(store.read_bytes(image_path), str(image_path)).shape[:2]
    fit = fit_images(calibration.camera(2, "front", width, height), options)
    world_from_velo = np.eye(4)
    tracks, _ = kitti_boxes.build_tracks(boxes, {0: world_from_velo}, {0: 0.0}, where)
    log.info(f"kitti: one frame from {where}")
    notes = ("single frame: nothing moves, the world is the velodyne's frame", *([fit.words] if fit.words else []))
    with SceneWriter(out, source.resolve().name, Source("kitti", LICENCE, None, notes)) as writer:
        writer.add_camera(fit.camera)
        view = View(fit.camera, world_from_velo @ calibration.velo_from_cam(2), 0.0)
        writer.add_frame("front/000000", view, fit.image(image_path))
        writer.add_sweep(f"{SENSOR}/000000", SENSOR, 0.0, world_from_velo, read_scan(scan_path))
        for track in tracks:
            writer.add_track(track)
        writer.set_ego(EgoPath(np.zeros(1), world_from_velo[None]))
        return writer.finish()


def _boxes(instances: list[dict[str, Any]], rect0_from_velo: np.ndarray, where: str) -> list[kitti_boxes.KittiBox]:
    velo_from_rect0 = invert(rect0_from_velo)
    boxes = []
    for index, item in enumerate(instances):
        if int(item["bbox_label_3d"]) < 0:
            continue
        x, y, z, length, height, width, turn = (float(value) for value in item["bbox_3d"])
        if min(length, height, width) <= 0 or not np.isfinite([x, y, z, turn]).all():
            raise InputError("box makes no sense", where=f"{where}: instances[{index}]", got=str(item["bbox_3d"]))
        number = int(item["bbox_label_3d"])
        if number >= len(LABELS):
            raise InputError("box has a class that does not exist", where=f"{where}: instances[{index}]",
                             got=str(number), expected=f"0 to {len(LABELS) - 1}, or -1 for none")  # fmt: skip
        label = LABELS[number]
        pose = velo_from_rect0 @ kitti_boxes.rect0_from_box((x, y, z), height, turn)
        left, top, right, bottom = (float(value) for value in item["bbox"])
        boxes.append(kitti_boxes.KittiBox(0, index, label, (length, width, height), pose, (left, top, right, bottom)))
    return boxes
