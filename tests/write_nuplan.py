"""A log as a nuPlan database with sensor blobs, written after the published schema; independent of the importer."""

from __future__ import annotations

import hashlib
import io
import pickle
import sqlite3
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from roundtrip import mounts
from scipy.spatial.transform import Rotation

from mudg.base.geometry import yaw_matrix, yaw_of
from mudg.base.types import Scene
from mudg.scene.read import read_image, read_points

LOG = "2021.05.12.22.00.38_veh-35_01008_01518"
EPOCH_US = 1_620_857_890_123_456
IMAGE_DELAY_US = 16_667
SOURCE_FROM_WORLD = yaw_matrix(0.8, (331_200.0, 4_690_300.0, 12.5))
CAMERA_OF = {"front": "CAM_F0", "front_left": "CAM_L0"}
TABLES = """
CREATE TABLE log (
    token BLOB PRIMARY KEY, vehicle_name, date, timestamp INTEGER, logfile VARCHAR(64), location, map_version);
CREATE TABLE ego_pose (
    token BLOB PRIMARY KEY, timestamp INTEGER, x FLOAT, y FLOAT, z FLOAT, qw FLOAT, qx FLOAT, qy FLOAT,
    qz FLOAT, vx FLOAT, vy FLOAT, vz FLOAT, epsg INTEGER, log_token BLOB);
CREATE TABLE camera (
    token BLOB PRIMARY KEY, log_token BLOB, channel VARCHAR(64), model, translation BLOB, rotation BLOB,
    intrinsic BLOB, distortion BLOB, width INTEGER, height INTEGER);
CREATE TABLE image (token BLOB PRIMARY KEY, next_token BLOB, prev_token BLOB, ego_pose_token BLOB, camera_token BLOB,
    filename_jpg VARCHAR(128), timestamp INTEGER);
CREATE TABLE lidar (
    token BLOB PRIMARY KEY, log_token BLOB, channel VARCHAR(64), model, translation BLOB, rotation BLOB);
CREATE TABLE lidar_pc (token BLOB PRIMARY KEY, next_token BLOB, prev_token BLOB, ego_pose_token BLOB, lidar_token BLOB,
    scene_token BLOB, filename VARCHAR(128), timestamp INTEGER);
CREATE TABLE lidar_box (token BLOB PRIMARY KEY, lidar_pc_token BLOB, track_token BLOB, next_token BLOB, prev_token BLOB,
    x FLOAT, y FLOAT, z FLOAT, width FLOAT, length FLOAT, height FLOAT, vx FLOAT, vy FLOAT, vz FLOAT, yaw FLOAT,
    confidence FLOAT);
CREATE TABLE track (token BLOB PRIMARY KEY, category_token BLOB, width FLOAT, length FLOAT, height FLOAT);
CREATE TABLE category (token BLOB PRIMARY KEY, name VARCHAR(64), description TEXT);
CREATE TABLE scene (token BLOB PRIMARY KEY, log_token BLOB, name TEXT, goal_ego_pose_token BLOB, roadblock_ids TEXT);
"""


def token(*words: object) -> bytes:
    """Eight bytes, the same for the same words."""
    return hashlib.sha256(repr(words).encode()).digest()[:8]


def wxyz(pose: NDArray[np.float64]) -> list[float]:
    """Rotation as the data set's quaternion."""
    x, y, z, w = Rotation.from_matrix(pose[:3, :3]).as_quat().tolist()
    return [w, x, y, z]


def pcd(xyz: NDArray[np.floating], intensity: NDArray[np.floating]) -> bytes:
    """A merged cloud: x y z intensity ring lidar_info, binary, with bytes behind the end as the data set has them."""
    layout = [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("intensity", "u1"), ("ring", "u1"), ("lidar_info", "<i4")]
    rows = np.zeros(len(xyz), layout)
    for axis, name in enumerate("xyz"):
        rows[name] = xyz[:, axis]
    rows["intensity"] = np.round(intensity * 255)
    header = (
        "# .PCD v0.7 - Point Cloud Data file format\nVERSION 0.7\nFIELDS x y z intensity ring lidar_info\nSIZE 4 4 4 1"
        f" 1 4\nTYPE F F F U U I\nCOUNT 1 1 1 1 1 1\nWIDTH {len(xyz)}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS"
        f" {len(xyz)}\nDATA binary\n"
    )
    return header.encode() + rows.tobytes() + b"\0" * 32


def write_nuplan(
    truth: Scene,
    root: Path,
    *,
    distortion: Sequence[float] = (0.0,) * 5,
    jpeg: bool = False,
    cameras: Mapping[str, str] | None = None,
) -> Path:
    """``root/splits/mini/<log>.db`` and ``root/sensor_blobs``; two scenes of the log. Returns the database."""
    database = root / "splits" / "mini" / f"{LOG}.db"
    database.parent.mkdir(parents=True)
    blobs = root / "sensor_blobs" / LOG
    connection = sqlite3.connect(database)
    connection.executescript(TABLES)

    def add(table: str, columns: str, *values: object) -> None:
        marks = ", ".join("?" * len(values))
        connection.execute(f"INSERT INTO {table} ({columns}) VALUES ({marks})", values)

    add("log", "token, logfile, location, timestamp", token("log"), LOG, "here", EPOCH_US)
    add("category", "token, name", token("vehicle"), "vehicle")
    for name in ("scene-0000", "scene-0001"):
        add("scene", "token, log_token, name", token(name), token("log"), name)
    for time_s, pose in zip(truth.ego.times_s, truth.ego.world_from_ego, strict=True):
        pose, time_us = SOURCE_FROM_WORLD @ pose, us(float(time_s))
        values = token("ego", time_us), time_us, *pose[:3, 3].tolist(), *wxyz(pose)
        add("ego_pose", "token, timestamp, x, y, z, qw, qx, qy, qz", *values)
    placed = mounts(truth)
    mount = placed[truth.sweeps[0].sensor]
    place = pickle.dumps(mount[:3, 3].tolist()), pickle.dumps(wxyz(mount))
    add("lidar", "token, channel, translation, rotation", token("lidar"), "MergedPointCloud", *place)
    for channel, name in (cameras or {channel: name for name, channel in CAMERA_OF.items()}).items():
        camera, frames = truth.cameras[name], truth.frames_of(name)
        mount = placed[name]
        k = [[camera.fx, 0.0, camera.cx - 0.5], [0.0, camera.fy, camera.cy - 0.5], [0.0, 0.0, 1.0]]
        place = pickle.dumps(mount[:3, 3].tolist()), pickle.dumps(wxyz(mount))
        lens = pickle.dumps(k), pickle.dumps(list(distortion))
        columns = "token, channel, width, height, translation, rotation, intrinsic, distortion"
        add("camera", columns, token(channel), channel, camera.width, camera.height, *place, *lens)
        (blobs / channel).mkdir(parents=True)
        for index, frame in enumerate(frames):
            time_us = us(frame.view.time_s)
            file = f"{LOG}/{channel}/{token(channel, index).hex()}.jpg"
            buffer = io.BytesIO()
            Image.fromarray(read_image(truth, frame)).save(buffer, "JPEG" if jpeg else "PNG", quality=95, subsampling=0)
            (root / "sensor_blobs" / file).write_bytes(buffer.getvalue())
            tokens = token("image", channel, index), token(channel), token("ego", time_us)
            columns = "token, camera_token, ego_pose_token, filename_jpg, timestamp"
            add("image", columns, *tokens, file, time_us - IMAGE_DELAY_US)
    for track in truth.tracks:
        add("track", "token, category_token", token(track.id), token("vehicle"))
    (blobs / "MergedPointCloud").mkdir(parents=True)
    for index, sweep in enumerate(truth.sweeps):
        time_us, cloud = us(sweep.time_s), token("cloud", index)
        file = f"{LOG}/MergedPointCloud/{cloud.hex()}.pcd"
        points = read_points(truth, sweep)
        (root / "sensor_blobs" / file).write_bytes(pcd(points.xyz, points.intensity))
        tokens = cloud, token("ego", time_us), token("lidar"), token("scene-0000" if index < 3 else "scene-0001")
        columns = "token, ego_pose_token, lidar_token, scene_token, filename, timestamp"
        add("lidar_pc", columns, *tokens, file, time_us)
        for track in truth.tracks:
            pose = track.pose_at(sweep.time_s)
            assert pose is not None
            pose = SOURCE_FROM_WORLD @ pose
            tokens = token("box", track.id, index), cloud, token(track.id)
            columns = "token, lidar_pc_token, track_token, x, y, z, yaw, length, width, height, confidence"
            add("lidar_box", columns, *tokens, *pose[:3, 3].tolist(), yaw_of(pose), *track.size_m.tolist(), 0.9)
    connection.commit()
    connection.close()
    return database


def us(time_s: float) -> int:
    """Time of the log's clock."""
    return EPOCH_US + round(time_s * 1e6)
