"""KITTI: the object benchmark (``image_2``, ``velodyne``, ``calib``, ``label_2``, lists of frames) and the tracking
benchmark (the same by sequence, with track ids and packets of a GPS/IMU unit).

Camera axes: x right, y down, z forward, which are ours. A view has one camera, so ``P0`` to ``P3`` are equal and
rectification is the identity. The GPS/IMU unit is the vehicle. Sources: the readme files of the development kits
(Geiger, Lenz, Urtasun 2012; Geiger, Lenz, Stiller, Urtasun 2013).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mudg.base import geometry, store
from mudg.datasets.samples import LabelledView, ObjectBox, clipped

FILES: Final = tuple("image_2/*.png velodyne/*.bin calib/*.txt label_2/*.txt ImageSets/*.txt provenance.jsonl".split())
TRACKING_FILES: Final = tuple(
    "image_02/*/*.png velodyne/*/*.bin calib/*.txt label_02/*.txt oxts/*.txt ImageSets/*.txt provenance.jsonl".split()
)
TYPES: Final = {
    **dict.fromkeys(("car", "vehicle"), "Car"),
    "van": "Van",
    "truck": "Truck",
    **dict.fromkeys(("tram", "train"), "Tram"),
    **dict.fromkeys(("pedestrian", "person", "adult", "child"), "Pedestrian"),
    "person_sitting": "Person_sitting",
    **dict.fromkeys(("cyclist", "rider", "bicyclist"), "Cyclist"),
}
"""Label -> KITTI's type; all others are ``Misc``."""
LEVELS: Final = (0.1, 0.5)
"""Shares from which on an object is partly, and largely, occluded, or cut by the image."""
VELO_TO_CAM: Final = geometry.from_rotation_translation(
    np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]]), (0.0, 0.0, 0.0)
)
"""Without a LiDAR its frame has the camera's origin, x forward, y left, z up."""
EARTH_RADIUS_M: Final = 6378137.0
Matrix = NDArray[np.float64]


def write_view(folder: Path, view: LabelledView) -> dict[str, Any]:
    """The files of a frame of the object benchmark."""
    name = f"{view.number:06d}"
    cam_from_velo, velo_from_imu = _write_sensors(folder, "image_2", name, view)
    named = {"R0_rect": np.eye(3), "Tr_velo_to_cam": cam_from_velo[:3], "Tr_imu_to_velo": velo_from_imu[:3]}
    store.write_text(folder / "calib" / f"{name}.txt", calibration(view, named))
    lines = [label_line(box, view, f"{box.truncation:.2f}") for box in view.boxes]
    store.write_text(folder / "label_2" / f"{name}.txt", _text(lines))
    return {"name": name}


def write_whole(folder: Path, records: Sequence[Mapping[str, Any]]) -> None:
    """Lists of frames by split."""
    for split in dict.fromkeys(record["split"] for record in records):
        names = [record["name"] for record in records if record["split"] == split]
        store.write_text(folder / "ImageSets" / f"{split}.txt", _text(dict.fromkeys(names)))


def write_tracked(folder: Path, view: LabelledView) -> dict[str, Any]:
    """The files of a frame of the tracking benchmark; every path is a sequence."""
    sequence = f"{view.sequence:04d}"
    cam_from_velo, velo_from_imu = _write_sensors(folder, "image_02", f"{sequence}/{view.frame:06d}", view)
    named = {"R_rect": np.eye(3), "Tr_velo_cam": cam_from_velo[:3], "Tr_imu_velo": velo_from_imu[:3]}
    lines = [
        f"{view.frame} {box.number} " + label_line(box, view, str(sum(box.truncation >= share for share in LEVELS)))
        for box in view.boxes
    ]
    packet = packet_line(view.view.world_from_cam @ cam_from_velo @ velo_from_imu)
    return {"name": sequence, "calib": calibration(view, named), "lines": lines, "packet": packet}


def write_sequences(folder: Path, records: Sequence[Mapping[str, Any]]) -> None:
    """``calib``, ``label_02`` and ``oxts`` of every sequence, and lists of sequences by split."""
    for sequence in dict.fromkeys(record["name"] for record in records):
        own = [record for record in records if record["name"] == sequence]
        store.write_text(folder / "calib" / f"{sequence}.txt", own[0]["calib"])
        lines = [line for record in own for line in record["lines"]]
        store.write_text(folder / "label_02" / f"{sequence}.txt", _text(lines))
        store.write_text(folder / "oxts" / f"{sequence}.txt", _text(record["packet"] for record in own))
    write_whole(folder, records)


def _text(lines: Any) -> str:
    return "".join(f"{line}\n" for line in lines)


def _write_sensors(folder: Path, images: str, name: str, view: LabelledView) -> tuple[Matrix, Matrix]:
    """Write the image, and x, y, z in metres and the intensity of every return, float32; returns camera-from-velodyne
    and velodyne-from-IMU f64[4, 4]."""
    store.write_image(folder / images / f"{name}.png", view.layers["rgb"])
    mount, sweep = view.mount, view.sweep
    if sweep is not None:
        store.write_blocks(folder / "velodyne" / f"{name}.bin", [sweep.points.tobytes()])
    if mount is None:
        return VELO_TO_CAM, np.eye(4)
    cam_from_velo = VELO_TO_CAM if sweep is None else geometry.invert(mount) @ sweep.vehicle_from_lidar
    return cam_from_velo, geometry.invert(mount @ cam_from_velo)


def calibration(view: LabelledView, named: Mapping[str, ArrayLike]) -> str:
    """A file of ``calib``; KITTI's pixel centres are whole numbers, ours halves."""
    camera = view.view.camera
    projection = [camera.fx, 0, camera.cx - 0.5, 0, 0, camera.fy, camera.cy - 0.5, 0, 0, 0, 1, 0]
    rows = {**{f"P{index}": projection for index in range(4)}, **named}
    return _text(f"{name}: " + " ".join(f"{value:.12e}" for value in np.ravel(row)) for name, row in rows.items())


def label_line(box: ObjectBox, view: LabelledView, truncation: str) -> str:
    """A line of ``label_2``: type, truncation, occlusion, observation angle, rectangle, height, width, length, place of
    the middle of the lower face and turn about the camera's y axis."""
    pose, (length, width, height) = view.view.cam_from_world @ box.world_from_box, box.size_m
    x, y, z = geometry.transform_points(pose, np.array([[0.0, 0.0, -height / 2]]))[0]
    turn = math.atan2(-pose[2, 0], pose[0, 0])
    alpha = (turn - math.atan2(x, z) + math.pi) % (2 * math.pi) - math.pi
    left, top, right, bottom = clipped(box.amodal_px, view.view.camera)
    hidden = 3 if math.isnan(box.occlusion) else sum(box.occlusion >= share for share in LEVELS)
    numbers = [alpha, left, top, right - 1, bottom - 1, height, width, length, x, y, z, turn]
    words = [TYPES.get(box.label, "Misc"), truncation, str(hidden)]
    return " ".join([*words, *(f"{value:.2f}" for value in numbers[:5]), *(f"{value:.4f}" for value in numbers[5:])])


def packet_line(world_from_imu: Matrix) -> str:
    """A packet of 30 numbers: latitude, longitude (degrees; the world's origin is at 0, 0, Mercator), altitude, roll,
    pitch, yaw; velocities, accelerations and what remains are 0."""
    east, north, up = world_from_imu[:3, 3]
    latitude = 2 * math.atan(math.exp(north / EARTH_RADIUS_M)) - math.pi / 2
    turn = world_from_imu[:3, :3]
    angles = (math.atan2(turn[2, 1], turn[2, 2]), -math.asin(min(max(turn[2, 0], -1.0), 1.0)))
    place = (math.degrees(latitude), math.degrees(east / EARTH_RADIUS_M), up)
    values = (*place, *angles, geometry.yaw_of(world_from_imu), *(0.0,) * 24)
    return " ".join(f"{value:.15g}" for value in values)
