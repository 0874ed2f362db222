"""Writes a scene as a nuScenes release, for round trips: tables, samples, sweeps; and edits tables for tests of bad
input."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from roundtrip import mounts

from mudg.base.geometry import quaternion_from_matrix, yaw_matrix
from mudg.base.types import Scene, Track
from mudg.formats.importers.nuscenes import CAMERAS
from mudg.scene.read import open_files, read_points

RELEASE = "v1.0-mini"
START_US = 1_532_402_927_000_000
MAP_FROM_WORLD = yaw_matrix(1.9, (411.3, 1180.9, 0.0))
CHANNELS = {name: raw for raw, name in CAMERAS.items()}
CATEGORIES = {
    "car": "vehicle.car",
    "van": "vehicle.car",
    "truck": "vehicle.truck",
    "bus": "vehicle.bus.rigid",
    "pedestrian": "human.pedestrian.adult",
    "cyclist": "vehicle.bicycle",
    "bicycle": "vehicle.bicycle",
}
"""Truth class -> category; cyclists are bicycles with the attribute cycle.with_rider."""
READ_BACK = {"van": "car"}
"""Classes that the release does not tell apart."""


def token(*words: object) -> str:
    """A token like the release's: 32 hexadecimal digits that follow from ``words``."""
    return hashlib.md5(" ".join(map(str, words)).encode()).hexdigest()


def micros(time_s: float) -> int:
    """Time stamp of a scene's time."""
    return START_US + round(time_s * 1e6)


def pose_row(pose: NDArray[np.float64]) -> dict[str, list[float]]:
    """``rotation`` (w, x, y, z) and ``translation`` of a pose."""
    return {"rotation": quaternion_from_matrix(pose).tolist(), "translation": pose[:3, 3].tolist()}


def write_nuscenes(truth: Scene, root: Path, *, key_every: int = 1) -> Path:
    """Write ``truth`` below ``root``; every ``key_every``-th sweep is a key frame with boxes. Another scene's rows lie
    between. The LiDAR keeps the truth's axes, so that poses can be compared (the release's look along y)."""
    name = "scene-0007"
    tables: dict[str, list[dict[str, Any]]] = {}
    scene = token("scene", name)
    keys = list(truth.sweeps[::key_every])
    samples = {sweep.id: token("sample", name, sweep.id) for sweep in keys}
    chain = ["", *samples.values(), ""]
    tables["scene"] = [
        {"token": token("other"), "name": "scene-0001", "first_sample_token": token("other sample"), "log_token": ""},
        {"token": scene, "name": name, "first_sample_token": chain[1], "description": "cut } and { x", "log_token": ""},
    ]
    tables["sample"] = [{"token": token("other sample"), "timestamp": 5, "scene_token": token("other"), "next": ""}]
    for at, sweep in enumerate(keys, start=1):
        row = {"token": chain[at], "timestamp": micros(sweep.time_s), "prev": chain[at - 1], "next": chain[at + 1]}
        tables["sample"].insert(0, {**row, "scene_token": scene})
    tables["sensor"], tables["calibrated_sensor"] = [], []
    placed = {
        CHANNELS.get(name, "LIDAR_TOP"): (mount, truth.cameras.get(name)) for name, mount in mounts(truth).items()
    }
    for channel, (mount, c) in {**placed, "RADAR_FRONT": (np.eye(4), None)}.items():
        intrinsics = [] if c is None else [[c.fx, 0.0, c.cx - 0.5], [0.0, c.fy, c.cy - 0.5], [0.0, 0.0, 1.0]]
        tables["sensor"].append({"token": token("sensor", channel), "channel": channel, "modality": "camera"})
        row = {"token": token("calibration", channel), "sensor_token": token("sensor", channel)}
        tables["calibrated_sensor"].append({**row, **pose_row(mount), "camera_intrinsic": intrinsics})
    tables["sample_data"], tables["ego_pose"] = [], []
    records = [(CHANNELS[f.view.camera.name], f.view.time_s, f) for f in truth.frames]
    records += [("LIDAR_TOP", sweep.time_s, sweep) for sweep in truth.sweeps]
    records += [("RADAR_FRONT", keys[0].time_s, None)]
    key_times = np.array([sweep.time_s for sweep in keys])
    for channel, time_s, record in records:
        after = int(np.searchsorted(key_times, time_s - 1e-9).clip(0, len(keys) - 1))
        is_key = bool(np.abs(key_times - time_s).min() < 1e-9)
        one = token("data", channel, micros(time_s))
        path = f"{'samples' if is_key else 'sweeps'}/{channel}/n001+0800__{channel}__{micros(time_s)}"
        row = {"token": one, "sample_token": chain[after + 1], "ego_pose_token": one, "is_key_frame": is_key}
        row |= {"calibrated_sensor_token": token("calibration", channel), "timestamp": micros(time_s)}
        row |= {"width": 0, "height": 0, "filename": f"{path}.pcd.bin"}
        if channel in placed and channel != "LIDAR_TOP":
            camera = record.view.camera
            row |= {"width": camera.width, "height": camera.height, "filename": f"{path}.png"}
            _write(root / row["filename"], open_files(truth.root).read(record.image.path))
        elif channel == "LIDAR_TOP":
            write_scan(root / row["filename"], truth, record)
        tables["sample_data"].append(row)
        pose = truth.ego.pose_at(time_s)
        tables["ego_pose"].append({"token": one, "timestamp": micros(time_s), **pose_row(MAP_FROM_WORLD @ pose)})
        if len(tables["sample_data"]) % 3 == 0:
            noise = {**row, "token": token("noise", one), "sample_token": token("other sample"), "ego_pose_token": "x"}
            tables["sample_data"].append(noise)
    _add_boxes(tables, truth.tracks, [(sweep.time_s, samples[sweep.id]) for sweep in keys])
    for table, rows in tables.items():
        _write(root / RELEASE / f"{table}.json", json.dumps(rows, indent=0).encode())
    return root


def _add_boxes(
    tables: dict[str, list[dict[str, Any]]], tracks: tuple[Track, ...], keys: list[tuple[float, str]]
) -> None:
    names = sorted({CATEGORIES.get(track.label, track.label) for track in tracks})
    tables["category"] = [{"token": token("category", name), "name": name} for name in names]
    tables["attribute"] = [{"token": token("ridden"), "name": "cycle.with_rider"}]
    tables["instance"], tables["sample_annotation"] = [], []
    for track in tracks:
        one = token("instance", track.id)
        category = token("category", CATEGORIES.get(track.label, track.label))
        tables["instance"].append({"token": one, "category_token": category})
        length, width, height = track.size_m.tolist()
        ridden = [token("ridden")] if track.label == "cyclist" else []
        for time_s, sample in keys:
            pose = track.pose_at(time_s)
            if pose is not None:
                row = {"token": token("box", track.id, sample), "sample_token": sample, "instance_token": one}
                row |= {"size": [width, length, height], "attribute_tokens": ridden, "num_lidar_pts": 5}
                tables["sample_annotation"].append({**row, **pose_row(MAP_FROM_WORLD @ pose)})


def write_scan(path: Path, truth: Scene, sweep: Any) -> None:
    """A sweep as rows of x, y, z, intensity (0..255), ring; rings are made up, not in the order of columns."""
    points = read_points(truth, sweep)
    rings = np.arange(len(points.xyz))[::-1] % 31
    _write(path, np.c_[points.xyz, points.intensity * 255, rings].astype("<f4").tobytes())


def _write(path: Path, content: bytes) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(content)


def edit(root: Path, table: str, change: Callable[[list[dict[str, Any]]], object]) -> None:
    """Change the rows of a table in place."""
    path = root / RELEASE / f"{table}.json"
    rows = json.loads(path.read_bytes())
    change(rows)
    path.write_text(json.dumps(rows, indent=0))
