"""KITTI's object benchmark: ``image_2``, ``calib``, ``label_2`` and the list of frames.

Camera axes: x right, y down, z forward, which are ours. A view has one camera, so ``P0`` to ``P3`` are equal and
``R0_rect`` is the identity. Source: the development kit's readme (Geiger, Lenz, Urtasun 2012).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from mudg.base import geometry, store
from mudg.base.types import Camera
from mudg.datasets.samples import LabelledView, ObjectBox, clipped

FILES: Final = ("image_2/*.png", "calib/*.txt", "label_2/*.txt", "ImageSets/*.txt", "provenance.jsonl")
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
OCCLUSION: Final = (0.1, 0.5)
"""Shares from which on an object is partly, and largely, occluded."""
VELO_TO_CAM: Final = np.array([[0.0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0]])
"""Without a LiDAR its frame has the camera's origin, x forward, y left, z up."""


def write_view(folder: Path, number: int, view: LabelledView) -> dict[str, Any]:
    """The files of a frame."""
    name = f"{number:06d}"
    store.write_image(folder / "image_2" / f"{name}.png", view.layers["rgb"])
    store.write_text(folder / "calib" / f"{name}.txt", calibration(view.view.camera))
    lines = [label_line(box, view) for box in view.boxes]
    store.write_text(folder / "label_2" / f"{name}.txt", "".join(f"{line}\n" for line in lines))
    return {"name": name}


def write_whole(folder: Path, records: Sequence[Mapping[str, Any]]) -> None:
    """The list of frames: all are of one drive, so they belong to one split."""
    store.write_text(folder / "ImageSets" / "train.txt", "".join(f"{record['name']}\n" for record in records))


def calibration(camera: Camera) -> str:
    """``calib/*.txt``; KITTI's pixel centres are whole numbers, ours halves."""
    projection = [camera.fx, 0, camera.cx - 0.5, 0, 0, camera.fy, camera.cy - 0.5, 0, 0, 0, 1, 0]
    text = lambda values: " ".join(f"{float(value):.12e}" for value in np.ravel(values))
    lines = [f"P{index}: {text(projection)}" for index in range(4)]
    lines += [f"R0_rect: {text(np.eye(3))}", f"Tr_velo_to_cam: {text(VELO_TO_CAM)}"]
    return "\n".join([*lines, f"Tr_imu_to_velo: {text(np.eye(4)[:3])}"]) + "\n"


def label_line(box: ObjectBox, view: LabelledView) -> str:
    """A line of ``label_2``: type, truncation, occlusion, observation angle, rectangle, height, width, length, place of
    the middle of the lower face and turn about the camera's y axis."""
    pose, (length, width, height) = view.view.cam_from_world @ box.world_from_box, box.size_m
    x, y, z = geometry.transform_points(pose, np.array([[0.0, 0.0, -height / 2]]))[0]
    turn = math.atan2(-pose[2, 0], pose[0, 0])
    alpha = (turn - math.atan2(x, z) + math.pi) % (2 * math.pi) - math.pi
    left, top, right, bottom = clipped(box.amodal_px, view.view.camera)
    hidden = 3 if math.isnan(box.occlusion) else sum(box.occlusion >= share for share in OCCLUSION)
    numbers = [alpha, left, top, right - 1, bottom - 1, height, width, length, x, y, z, turn]
    words = [TYPES.get(box.label, "Misc"), f"{box.truncation:.2f}", str(hidden)]
    return " ".join([*words, *(f"{value:.2f}" for value in numbers[:5]), *(f"{value:.4f}" for value in numbers[5:])])
