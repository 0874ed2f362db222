"""Cameras and images of a log for programs that train on them: nerfstudio's ``transforms.json``, and a binary COLMAP
model with one rig. Images that the rig took at one time and whose poses agree with it are one frame; any other image is
a frame by itself, so that every image has exactly its own pose.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator, Mapping
from pathlib import PurePosixPath
from typing import Final

import numpy as np
from numpy.typing import NDArray

from mudg.base import geometry, store
from mudg.base.types import Frame, PointCloud, Scene
from mudg.formats.splats import ply
from mudg.scene.read import open_files

# names and bytes of a log's pictures for data sets of cameras -------------------------------------


def picture_names(scene: Scene) -> dict[str, str]:
    """Frame id -> ``images/CAMERA/NUMBER.ending``."""
    return {frame.id: f"images/{frame.id}{PurePosixPath(frame.image.path).suffix}" for frame in scene.frames}


def pictures(scene: Scene) -> Iterator[tuple[str, bytes]]:
    """Name and bytes of every picture as the scene holds it."""
    files, names = open_files(scene.root), picture_names(scene)
    for frame in scene.frames:
        yield names[frame.id], files.read(frame.image.path)


# nerfstudio ---------------------------------------------------------------------------------------

FLIP: Final = np.diag([1.0, -1.0, -1.0, 1.0])
POINTS: Final = "points.ply"


def nerfstudio_files(scene: Scene, points: PointCloud | None = None) -> dict[str, bytes]:
    """All files but the pictures, which stand at ``picture_names``."""
    names, frames = picture_names(scene), []
    for frame in scene.frames:
        view, camera = frame.view, frame.view.camera
        pose = (view.world_from_cam @ FLIP).tolist()
        lens = {"fl_x": camera.fx, "fl_y": camera.fy, "cx": camera.cx, "cy": camera.cy}
        lens |= {"w": camera.width, "h": camera.height, **dict.fromkeys(("k1", "k2", "p1", "p2"), 0.0)}
        frames.append({"file_path": names[frame.id], "transform_matrix": pose, "time": view.time_s, **lens})
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


# colmap -------------------------------------------------------------------------------------------

PINHOLE: Final = 1
CAMERA: Final = 0
AGREE: Final = 1e-6
"""Metres (and entries of rotations) by which poses of one frame may differ from those of its rig."""
FOLDER: Final = "sparse/0"

Matrix = NDArray[np.float64]


def sensors_from_rig(scene: Scene) -> dict[str, Matrix]:
    """Pose of every camera in the rig, whose frame is that of the first camera: from the first image of each and the
    vehicle's path."""
    cam_from_ego = {}
    for frame in scene.frames:
        name = frame.view.camera.name
        if name not in cam_from_ego:
            pose = scene.ego.pose_at(frame.view.time_s)
            cam_from_ego[name] = frame.view.cam_from_world @ (np.eye(4) if pose is None else pose)
    first = next(iter(cam_from_ego.values()), np.eye(4))
    return {name: pose @ geometry.invert(first) for name, pose in cam_from_ego.items()}


def rig_frames(scene: Scene, sensors: Mapping[str, Matrix]) -> list[tuple[Matrix, list[Frame]]]:
    """Rig-from-world f64[4, 4] and the images that it explains, by frame of the rig, in order of time."""
    found: list[tuple[Matrix, list[Frame]]] = []
    for frame in sorted(scene.frames, key=lambda one: one.view.time_s):
        pose = geometry.invert(sensors[frame.view.camera.name]) @ frame.view.cam_from_world
        last_pose, last = found[-1] if found else (pose, [])
        together = last and abs(last[0].view.time_s - frame.view.time_s) < 1e-6
        free = together and frame.view.camera.name not in {other.view.camera.name for other in last}
        if free and np.abs(last_pose - pose).max() < AGREE:
            last.append(frame)
        else:
            found.append((pose, [frame]))
    return found


def colmap_files(scene: Scene, points: PointCloud | None = None) -> dict[str, bytes]:
    """The files of the model; pictures stand at ``picture_names``, below the folder ``images``."""
    cameras = {name: index + 1 for index, name in enumerate(scene.cameras)}
    images = {frame.id: index + 1 for index, frame in enumerate(scene.frames)}
    names = {id_: name.removeprefix("images/") for id_, name in picture_names(scene).items()}
    sensors = sensors_from_rig(scene)
    lens = [
        struct.pack("<IiQQ4d", cameras[c.name], PINHOLE, c.width, c.height, *c.intrinsics)
        for c in scene.cameras.values()
    ]
    taken = []
    for frame in scene.frames:
        pose = (*_pose(frame.view.cam_from_world), cameras[frame.view.camera.name])
        taken.append(struct.pack("<I7dI", images[frame.id], *pose) + names[frame.id].encode() + bytes(9))
    rig = b""
    if sensors:
        first, *others = sensors
        rig = struct.pack("<IIiI", 1, len(sensors), CAMERA, cameras[first])
        rig += b"".join(struct.pack("<iIB7d", CAMERA, cameras[name], 1, *_pose(sensors[name])) for name in others)
    moments = [
        struct.pack("<II7dI", index + 1, 1, *_pose(rig_from_world), len(frames))
        + b"".join(struct.pack("<iIQ", CAMERA, cameras[f.view.camera.name], images[f.id]) for f in frames)
        for index, (rig_from_world, frames) in enumerate(rig_frames(scene, sensors))
    ]
    cloud = np.zeros(
        0 if points is None else len(points),
        [("id", "<u8"), ("xyz", "<f8", 3), ("rgb", "u1", 3), ("error", "<f8"), ("track", "<u8")],
    )
    if points is not None:
        cloud["id"], cloud["xyz"], cloud["rgb"] = np.arange(1, len(points) + 1), points.xyz, points.rgb
    parts = {"cameras.bin": lens, "images.bin": taken, "rigs.bin": [rig] if rig else [], "frames.bin": moments}
    files = {name: struct.pack("<Q", len(entries)) + b"".join(entries) for name, entries in parts.items()}
    files["points3D.bin"] = struct.pack("<Q", len(cloud)) + cloud.tobytes()
    return {f"{FOLDER}/{name}": content for name, content in files.items()}


def _pose(matrix: Matrix) -> list[float]:
    """Quaternion w x y z and translation."""
    return [*geometry.quaternion_from_matrix(matrix).tolist(), *matrix[:3, 3].tolist()]
