"""Skeleton of an importer: `mudg ingest my_log RECORDING SCENE` (docs/extend/importer.md).

It reads the recording that docs/examples/convert_my_log.py describes. Change what reads files; keep what is returned.
"""

import csv
import json
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from mudg.base.types import Camera, EgoPath, Scene, Source, SweepPoints, Track
from mudg.formats.importers import ImportOptions
from mudg.formats.importers.common import pose_from_quaternion, rigid_pose
from mudg.formats.importers.drive_log import CameraOptics, DriveLog, ImageRecord, SweepRecord, write_log
from mudg.formats.importers.images import brown_conrady


def import_log(source: Path, out: Path, options: ImportOptions) -> Scene:
    """Write the scene directory `out`. `write_log` chooses frames, rectifies, moves the origin, checks and writes."""
    sensors = json.loads((source / "sensors.json").read_text())
    poses = rows(source / "poses.csv")
    times_s = np.array([seconds(row["time_ns"]) for row in poses])
    world_from_ego = np.stack([pose(row, f"{source / 'poses.csv'}: row {n}") for n, row in enumerate(poses)])
    ego = EgoPath(times_s, world_from_ego)
    cameras = {name: camera(name, values) for name, values in sensors.items() if "K" in values}
    optics = {  # a camera that is not named here has rectified images, which are copied byte for byte
        name: CameraOptics(cameras[name], brown_conrady(*sensors[name]["D"]))
        for name in cameras
        if any(sensors[name]["D"])
    }
    images, sweeps = [], []
    for name, values in sensors.items():
        ego_from_sensor = rigid_pose(values["ego_from_sensor"], f"sensors.json: {name}")
        for path in sorted((source / ("images" if name in cameras else "lidar") / name).iterdir()):
            time_s = seconds(path.stem)
            if (world_from_ego_then := ego.pose_at(time_s)) is None:
                continue  # before the first or after the last pose of the vehicle
            world_from_sensor = world_from_ego_then @ ego_from_sensor
            if name in cameras:
                images.append(ImageRecord(name, time_s, world_from_sensor, path))
            else:
                sweeps.append(SweepRecord(name, time_s, world_from_sensor, path, partial(points, path)))
    about = Source("my_log", "own recording", None, ())
    boxes = tracks(source / "boxes.csv")
    drive = DriveLog("my-log", cameras, images, sweeps, boxes, ego, about, str(source), optics, "own")
    return write_log(drive, out, options)  # "own": boxes are where objects are at the box's time, not at a sweep's


def rows(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def seconds(time_ns: str) -> float:
    return int(time_ns) % 10**15 / 1e9  # 64-bit floats keep microseconds of eleven days, not nanoseconds since 1970


def pose(row: Mapping[str, str], where: str) -> np.ndarray:
    wxyz = [float(row[key]) for key in ("qw", "qx", "qy", "qz")]
    return pose_from_quaternion(wxyz, [float(row[key]) for key in "xyz"], where)


def camera(name: str, values: Mapping[str, Any]) -> Camera:
    (fx, _, cx), (_, fy, cy), _ = values["K"]
    return Camera(
        name, values["width"], values["height"], fx, fy, cx + 0.5, cy + 0.5
    )  # mudg: the first pixel's centre is (0.5, 0.5)


def points(path: Path) -> SweepPoints:
    """Points in the LiDAR's own frame, metres; intensity in [0, 1]; seconds relative to the sweep."""
    table = np.load(path).astype(np.float32)
    return SweepPoints(table[:, :3], table[:, 3] / 255, table[:, 4])


def tracks(path: Path) -> list[Track]:
    """Boxes: centres in the world, x forward, y left, z up; metres."""
    found: dict[str, list[dict[str, str]]] = {}
    for row in rows(path) if path.is_file() else []:
        found.setdefault(row["track"], []).append(row)
    made = []
    for name, of_track in found.items():
        size_m = np.array([float(of_track[0][key]) for key in ("length", "width", "height")])
        world_from_object = np.tile(np.eye(4), (len(of_track), 1, 1))
        for matrix, row in zip(world_from_object, of_track, strict=True):
            cos, sin = np.cos(float(row["yaw"])), np.sin(float(row["yaw"]))
            matrix[:2, :2] = [[cos, -sin], [sin, cos]]
            matrix[:3, 3] = [float(row[key]) for key in "xyz"]
        times_s = np.array([seconds(row["time_ns"]) for row in of_track])
        made.append(Track(name, of_track[0]["class"], size_m, times_s, world_from_object))
    return made
