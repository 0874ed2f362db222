"""Cameras and images of a log as a nerfstudio data set: ``transforms.json``, pictures, starting points.

Poses are camera-to-world with x right, y up, z back; the world is that of this program, z up.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from mudg.base import store
from mudg.base.types import PointCloud, Scene
from mudg.data.exporters.pictures import picture_names
from mudg.data.splats import ply

FLIP: Final = np.diag([1.0, -1.0, -1.0, 1.0])
POINTS: Final = "points.ply"


def nerfstudio_files(scene: Scene, points: PointCloud | None = None) -> dict[str, bytes]:
    """All files but the pictures, which stand at ``picture_names``."""
    names, frames = picture_names(scene), []
    for frame in scene.frames:
        view, camera = frame.view, frame.view.camera
        frames.append({
            "file_path": names[frame.id], "transform_matrix": (view.world_from_cam @ FLIP).tolist(), "time": view.time_s,
            "fl_x": camera.fx, "fl_y": camera.fy, "cx": camera.cx, "cy": camera.cy, "w": camera.width, "h": camera.height,
            "k1": 0.0, "k2": 0.0, "p1": 0.0, "p2": 0.0,
        })  # fmt: skip
    test = [names[frame.id] for frame in scene.frames if scene.split.get(frame.id) == "test"]
    value = {"camera_model": "OPENCV", "applied_transform": np.eye(4)[:3].tolist(), "frames": frames}
    if test:
        kept = [names[frame.id] for frame in scene.frames if scene.split.get(frame.id) != "test"]
        value |= {"train_filenames": kept, "val_filenames": test, "test_filenames": test}
    files = {}
    if points is not None:
        value["ply_file_path"] = POINTS
        files[POINTS] = points_ply(points)
    return {"transforms.json": (store.json_text(value) + "\n").encode(), **files}


def points_ply(points: PointCloud) -> bytes:
    """Coloured points as a PLY file."""
    rows = np.zeros(len(points), [("xyz", "<f4", 3), ("rgb", "u1", 3)])
    rows["xyz"], rows["rgb"] = points.xyz, points.rgb
    columns = [*(("float", axis) for axis in "xyz"), *(("uchar", color) for color in ("red", "green", "blue"))]
    return ply.header([("vertex", len(points), columns)]) + rows.tobytes()
