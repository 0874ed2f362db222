"""A single KITTI frame described by ``info.json``; the folder holds the image and the scan that the record names.

Boxes are rectified camera 0, bottom centre, length, height, width, turn about the camera's y axis.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from mudg.base import log
from mudg.base.geometry import invert
from mudg.base.types import EgoPath, Scene, Source
from mudg.data.importers.common import rigid_pose
from mudg.data.importers.drive_log import SceneContent, SceneImage, SceneSweep, write_scene
from mudg.data.importers.images import fit_images, image_notes, image_size
from mudg.data.importers.info_frames import Size, info_record, info_tracks
from mudg.data.importers.kitti import LICENCE
from mudg.data.importers.kitti.boxes import rect0_from_box
from mudg.data.importers.kitti.calib import KittiCalibration
from mudg.data.importers.kitti.scans import SENSOR, read_scan
from mudg.data.importers.layout import chosen_cameras, path_inside, refuse_options
from mudg.data.importers.options import ImportOptions

LABELS: Final = ("pedestrian", "cyclist", "car", "van", "truck", "person_sitting", "tram", "misc")
_CAMERA: Final = "CAM2"


def import_info_frame(source: Path, out: Path, options: ImportOptions) -> Scene:
    """Import the one frame that ``source/info.json`` describes.

    Raises:
        UsageError: an option that a single frame has no use for.
        InputError: the record is incomplete, or image or scan is missing or damaged.
    """
    where = str(source / "info.json")
    refuse_options(options, "single-frame KITTI", "frames", "sequence", "poses", "boxes")
    chosen_cameras({_CAMERA: "front"}, options, where, (_CAMERA,))
    with info_record(source / "info.json", "data_list[0] with images.CAM2, lidar_points and instances") as record:
        sample = record["data_list"][0]
        camera_record = sample["images"][_CAMERA]
        image = path_inside(source, camera_record["img_path"], f"{where}: img_path")
        scan = path_inside(source, sample["lidar_points"]["lidar_path"], f"{where}: lidar_path")
        projection = np.array(camera_record["cam2img"], np.float64)[:3]
        rect0_from_velo = rigid_pose(camera_record["lidar2cam"], f"{where}: lidar2cam")
        velo_from_rect0 = invert(rect0_from_velo)

        def shape(values: list[float]) -> tuple[Size, NDArray[np.float64]]:
            x, y, z, length, height, width, turn = values
            return (length, width, height), velo_from_rect0 @ rect0_from_box((x, y, z), height, turn)

        tracks = info_tracks(sample.get("instances", []), dict(enumerate(LABELS)), where, shape)
    calibration = KittiCalibration({2: projection}, rect0_from_velo, None, where)
    fit = fit_images(calibration.camera(2, "front", *image_size(image)), options)
    world_from_velo = np.eye(4)

    def convert(number: int) -> Iterable[SceneImage | SceneSweep]:
        yield SceneImage("front", number, 0.0, calibration.velo_from_cam(2), image)
        yield SceneSweep(SENSOR, number, 0.0, world_from_velo, read_scan(scan), str(scan))

    log.info(f"kitti: one frame from {where}")
    notes = ("single frame: nothing moves, the world is the velodyne's frame", *image_notes({"front": fit}))
    content = SceneContent(
        source.resolve().name, Source("kitti", LICENCE, None, notes), {"front": fit}, (0,), convert,
        lambda _: str(source), EgoPath(np.zeros(1), world_from_velo[None]), tracks=lambda: (tracks, ()),
    )  # fmt: skip
    return write_scene(content, out, options)
