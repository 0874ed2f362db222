"""Writes a scene as an Argoverse 2 log, for round trips; and edits tables for tests of bad input. Needs pyarrow."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from roundtrip import mounts

from mudg.base.geometry import invert, quaternion_from_matrix, transform_points, yaw_matrix
from mudg.base.types import Scene
from mudg.formats.importers.argoverse2 import CAMERAS
from mudg.scene.read import open_files, read_points

START_NS = 315_966_253_572_412_942
CITY_FROM_WORLD = yaw_matrix(-0.7, (5172.6, 2419.1, 66.9))
NAMES = {name: raw for raw, name in CAMERAS.items()}
CATEGORIES = {
    "car": "REGULAR_VEHICLE",
    "van": "REGULAR_VEHICLE",
    "truck": "BOX_TRUCK",
    "bus": "BUS",
    "pedestrian": "PEDESTRIAN",
    "cyclist": "BICYCLIST",
    "bicycle": "BICYCLE",
}
READ_BACK = {"van": "car", "cyclist": "rider"}
"""Classes that come back under another word."""


def nanos(time_s: float) -> int:
    """Time stamp of a scene's time."""
    return START_NS + round(time_s * 1e9)


def write_av2(truth: Scene, folder: Path) -> Path:
    """Write ``truth`` as one log; points are float32 (the data set's are float16)."""
    times = {frame.view.time_s for frame in truth.frames} | {sweep.time_s for sweep in truth.sweeps}
    ego_at = {time_s: truth.ego.pose_at(time_s) for time_s in sorted(times)}
    placed = {NAMES.get(name, "up_lidar"): mount for name, mount in mounts(truth).items()}
    for frame in truth.frames:
        name = NAMES[frame.view.camera.name]
        path = folder / "sensors" / "cameras" / name / f"{nanos(frame.view.time_s)}.png"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(open_files(truth.root).read(frame.image.path))
    for sweep in truth.sweeps:
        points = read_points(truth, sweep)
        xyz = transform_points(invert(ego_at[sweep.time_s]) @ sweep.world_from_lidar, points.xyz)
        columns = {"x": xyz[:, 0], "y": xyz[:, 1], "z": xyz[:, 2], "intensity": points.intensity * 255}
        columns["laser_number"] = np.zeros(len(xyz), np.uint8)
        columns["offset_ns"] = np.round(points.dt_s * 1e9).astype(np.int32)
        write_table(folder / "sensors" / "lidar" / f"{nanos(sweep.time_s)}.feather", columns)
    ego = {"timestamp_ns": [nanos(t) for t in ego_at]} | pose_columns([CITY_FROM_WORLD @ p for p in ego_at.values()])
    write_table(folder / "city_SE3_egovehicle.feather", ego)
    calibration = folder / "calibration"
    sensors = {"sensor_name": list(placed)} | pose_columns(list(placed.values()))
    write_table(calibration / "egovehicle_SE3_sensor.feather", sensors)
    cameras = [truth.cameras[name] for name in truth.cameras]
    intrinsics = {"sensor_name": [NAMES[c.name] for c in cameras]}
    intrinsics |= {"fx_px": [c.fx for c in cameras], "fy_px": [c.fy for c in cameras]}
    intrinsics |= {"cx_px": [c.cx - 0.5 for c in cameras], "cy_px": [c.cy - 0.5 for c in cameras]}
    intrinsics |= {"k1": [-0.24] * len(cameras), "k2": [-0.2] * len(cameras), "k3": [0.3] * len(cameras)}
    intrinsics |= {"width_px": [c.width for c in cameras], "height_px": [c.height for c in cameras]}
    write_table(calibration / "intrinsics.feather", intrinsics)
    write_table(folder / "annotations.feather", _boxes(truth))
    return folder


def _boxes(truth: Scene) -> dict[str, Any]:
    rows: dict[str, list[Any]] = {name: [] for name in ("timestamp_ns", "track_uuid", "category")}
    sizes, poses = [], []
    for sweep in truth.sweeps:
        for track in truth.tracks:
            pose = track.pose_at(sweep.time_s)
            if pose is None:
                continue
            rows["timestamp_ns"].append(nanos(sweep.time_s))
            rows["track_uuid"].append(f"uuid-{track.id}")
            rows["category"].append(CATEGORIES.get(track.label, track.label))
            sizes.append(track.size_m)
            poses.append(invert(truth.ego.pose_at(sweep.time_s)) @ pose)
    size = np.array(sizes).reshape(-1, 3)
    sides = {"length_m": size[:, 0], "width_m": size[:, 1], "height_m": size[:, 2]}
    return rows | sides | pose_columns(poses) | {"num_interior_pts": [3] * len(poses)}


def pose_columns(poses: list[NDArray[np.float64]]) -> dict[str, NDArray[np.float64]]:
    """Columns qw..qz, tx_m..tz_m."""
    q = np.array([quaternion_from_matrix(pose) for pose in poses]).reshape(-1, 4)
    t = np.array([pose[:3, 3] for pose in poses]).reshape(-1, 3)
    names = ("qw", "qx", "qy", "qz", "tx_m", "ty_m", "tz_m")
    return dict(zip(names, np.c_[q, t].T, strict=True))


def write_table(path: Path, columns: dict[str, Any]) -> None:
    """A Feather file."""
    import pyarrow
    from pyarrow import feather

    path.parent.mkdir(parents=True, exist_ok=True)
    feather.write_feather(pyarrow.table({name: pyarrow.array(values) for name, values in columns.items()}), str(path))


def edit(path: Path, change: Callable[[dict[str, Any]], None]) -> None:
    """Change the columns (arrays, writable) of a Feather file in place."""
    from pyarrow import feather

    table = feather.read_table(str(path), memory_map=False)
    columns = {name: table.column(name).to_numpy().copy() for name in table.schema.names}
    change(columns)
    write_table(path, columns)
