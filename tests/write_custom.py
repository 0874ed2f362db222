"""Writes a scene as a log in the neutral layout, and as the recording that docs/examples/convert_my_log.py reads."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image
from roundtrip import mounts

from mudg.base.geometry import quaternion_from_matrix, yaw_of
from mudg.base.types import Camera, Scene, SweepPoints
from mudg.scene.read import read_image, read_points

START_NS = 1_700_000_000_123_456_789
EAST_M = np.array([512_345.5, 5_403_210.25, 310.0])
"""Where the recording's world lies: coordinates as of a survey grid."""

Edit = Callable[[dict[str, Any]], None]


def ns(time_s: float) -> int:
    """Nanoseconds of the epoch."""
    return START_NS + round(time_s * 1e9)


def pinhole(c: Camera, ego_from_camera: np.ndarray) -> dict[str, Any]:
    """A camera of log.json."""
    entry = {"width": c.width, "height": c.height, "fx": c.fx, "fy": c.fy, "cx": c.cx - 0.5, "cy": c.cy - 0.5}
    return entry | {"ego_from_camera": ego_from_camera.tolist()}


def write_log(scene: Scene, root: Path, suffix: str = ".npz", edit: Edit | None = None) -> Path:
    """The scene in the neutral layout, nanoseconds, far from the origin; ``edit`` changes log.json's content first."""
    sensors = mounts(scene)
    cameras = {name: pinhole(c, sensors[name]) for name, c in scene.cameras.items()}
    lidar = scene.sweeps[0].sensor
    ego = zip(scene.ego.times_s, scene.ego.world_from_ego, strict=True)
    log: dict[str, Any] = {"format": "mudg-log", "version": 1, "name": "round-trip", "licence": "none"}
    log |= {"time_unit": "ns", "cameras": cameras, "images": [], "sweeps": [], "tracks": []}
    log["lidars"] = {lidar: {"ego_from_lidar": sensors[lidar].tolist(), "motion_compensated": True}}
    log["ego"] = [{"time": ns(t), "world_from_ego": far(pose).tolist()} for t, pose in ego]
    for track in scene.tracks:
        keys = zip(track.times_s, track.world_from_object, strict=True)
        boxes = [{"time": ns(t), "world_from_object": far(pose).tolist()} for t, pose in keys]
        entry = {"id": track.id, "class": track.label, "size_m": track.size_m.tolist(), "boxes": boxes}
        log["tracks"].append(entry)
    for frame in scene.frames:
        path = root / "images" / f"{frame.id}.png"
        path.parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(read_image(scene, frame)).save(path)
        entry = {"camera": frame.view.camera.name, "time": ns(frame.view.time_s), "file": f"images/{frame.id}.png"}
        log["images"].append(entry)
    for sweep in scene.sweeps:
        path = root / "lidar" / f"{sweep.id}{suffix}"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(CLOUDS[suffix](read_points(scene, sweep)))
        log["sweeps"].append({"lidar": sweep.sensor, "time": ns(sweep.time_s), "file": f"lidar/{sweep.id}{suffix}"})
    if edit is not None:
        edit(log)
    (root / "log.json").write_text(json.dumps(log))
    return root


def far(pose: np.ndarray) -> np.ndarray:
    """The pose in the recording's world."""
    moved = pose.copy()
    moved[:3, 3] += EAST_M
    return moved


def npz(points: SweepPoints) -> bytes:
    import io

    buffer = io.BytesIO()
    np.savez(buffer, xyz=points.xyz, intensity=points.intensity, t=points.dt_s)
    return buffer.getvalue()


def bin_(points: SweepPoints) -> bytes:
    return np.concatenate([points.xyz, points.intensity[:, None]], 1).astype("<f4").tobytes()


def pcd(points: SweepPoints) -> bytes:
    rows = np.concatenate([points.xyz, points.intensity[:, None]], 1).astype("<f4")
    header = (
        "VERSION 0.7\nFIELDS x y z intensity\nSIZE 4 4 4 4\nTYPE F F F F\nCOUNT 1 1 1 1\n"
        f"WIDTH {len(rows)}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {len(rows)}\nDATA binary\n"
    )
    return header.encode() + rows.tobytes()


def ply(points: SweepPoints) -> bytes:
    rows = np.concatenate([points.xyz, points.intensity[:, None]], 1).astype("<f4")
    header = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(rows)}\n"
    header += "".join(f"property float {name}\n" for name in ("x", "y", "z", "intensity")) + "end_header\n"
    return header.encode() + rows.tobytes()


CLOUDS = {".npz": npz, ".bin": bin_, ".pcd": pcd, ".ply": ply}


def write_recording(scene: Scene, root: Path) -> Path:
    """The scene as a raw recording of the form that the template converter reads."""
    root.mkdir(parents=True)
    sensors = mounts(scene)
    described: dict[str, Any] = {}
    for name, c in scene.cameras.items():
        k = [[c.fx, 0, c.cx - 0.5], [0, c.fy, c.cy - 0.5], [0, 0, 1]]
        described[name] = {"width": c.width, "height": c.height, "ego_from_sensor": sensors[name].tolist()}
        described[name] |= {"D": [0, 0, 0, 0, 0], "K": k}
    lidar = scene.sweeps[0].sensor
    described[lidar] = {"ego_from_sensor": sensors[lidar].tolist()}
    (root / "sensors.json").write_text(json.dumps(described))
    lines = ["time_ns,x,y,z,qx,qy,qz,qw"]
    for time_s, pose in zip(scene.ego.times_s, scene.ego.world_from_ego, strict=True):
        w, *rest = quaternion_from_matrix(pose)
        lines.append(",".join(repr(float(v)) for v in (*far(pose)[:3, 3], *rest, w)))
        lines[-1] = f"{ns(time_s)},{lines[-1]}"
    (root / "poses.csv").write_text("\n".join(lines) + "\n")
    for frame in scene.frames:
        path = root / "images" / frame.view.camera.name / f"{ns(frame.view.time_s)}.png"
        path.parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(read_image(scene, frame)).save(path)
    for sweep in scene.sweeps:
        path = root / "lidar" / sweep.sensor / f"{ns(sweep.time_s)}.npy"
        path.parent.mkdir(parents=True, exist_ok=True)
        points = read_points(scene, sweep)
        np.save(path, np.concatenate([points.xyz, points.intensity[:, None] * 255, points.dt_s[:, None]], 1))
    lines = ["time_ns,track,class,length,width,height,x,y,z,yaw"]
    for track in scene.tracks:
        for time_s, pose in zip(track.times_s, track.world_from_object, strict=True):
            numbers = [*track.size_m, *far(pose)[:3, 3], yaw_of(pose)]
            lines.append(f"{ns(time_s)},{track.id},{track.label}," + ",".join(repr(float(v)) for v in numbers))
    (root / "boxes.csv").write_text("\n".join(lines) + "\n")
    return root
