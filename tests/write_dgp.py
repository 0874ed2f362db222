"""Writes a scene as a DGP scene folder, for round trips; and edits its JSON files for tests of bad input."""

from __future__ import annotations

import datetime
import io
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mudg.base.geometry import invert, quaternion_from_matrix, yaw_matrix
from mudg.base.types import Scene
from mudg.scene.read import open_files, read_points

START = datetime.datetime(2019, 6, 27, 16, 30, 25, tzinfo=datetime.UTC)
MAP_FROM_WORLD = yaw_matrix(2.4, (111.4, -2261.3, -12.7))
CLASSES = {0: "Person", 1: "Truck", 2: "Car", 3: "Bus/RV/Caravan", 8: "Bicycle"}
CLASS_OF = {"pedestrian": 0, "truck": 1, "car": 2, "van": 2, "bus": 3, "bicycle": 8, "cyclist": 8}
READ_BACK = {"van": "car", "cyclist": "bicycle"}


def write_dgp(truth: Scene, folder: Path, *, slowed: int = 1) -> Path:
    """Write ``truth`` as a scene; with ``slowed`` = 10, times are written as tenths of a microsecond called
    microseconds."""
    mounts: dict[str, NDArray[np.float64]] = {}
    data, samples = [], []
    for index, sweep in enumerate(truth.sweeps):
        mounts.setdefault("LIDAR", invert(truth.ego.pose_at(sweep.time_s)) @ sweep.world_from_lidar)
        keys = []
        boxes = f"bounding_box_3d/LIDAR/{index}.json"
        write_json(folder / boxes, {"annotations": _boxes(truth, sweep.time_s, sweep.world_from_lidar)})
        cloud = f"point_cloud/LIDAR/{index}.npz"
        points = read_points(truth, sweep)
        buffer = io.BytesIO()
        np.savez_compressed(buffer, data=np.c_[points.xyz, points.intensity].astype(np.float64))
        write(folder / cloud, buffer.getvalue())
        record = {"annotations": {"1": boxes}, "filename": cloud, "point_format": ["X", "Y", "Z", "INTENSITY"]}
        record["pose"] = pose_json(MAP_FROM_WORLD @ sweep.world_from_lidar)
        keys.append(_datum(data, index, "LIDAR", "point_cloud", sweep.time_s, record, slowed))
        for camera in truth.cameras:
            frame = truth.frames_of(camera)[index]
            view, name = frame.view, camera.upper()
            mounts.setdefault(name, invert(truth.ego.pose_at(view.time_s)) @ view.world_from_cam)
            image = f"rgb/{name}/{index}.png"
            write(folder / image, open_files(truth.root).read(frame.image.path))
            record = {
                "annotations": {},
                "channels": 3,
                "filename": image,
                "pose": pose_json(MAP_FROM_WORLD @ view.world_from_cam),
            }
            record |= {"width": view.camera.width, "height": view.camera.height}
            keys.append(_datum(data, index, name, "image", view.time_s, record, slowed))
        samples.append(
            {"calibration_key": "c0ffee", "datum_keys": keys, "id": {"timestamp": stamp(sweep.time_s, slowed)}}
        )
    scene = {"data": data, "samples": samples, "ontologies": {"0": "0n7", "1": "0n7"}, "name": ""}
    write_json(folder / "scene_abc.json", scene)
    write_json(folder / "ontology" / "0n7.json", {"items": [{"id": k, "name": v} for k, v in CLASSES.items()]})
    none = {"fx": 0.0, "fy": 0.0, "cx": 0.0, "cy": 0.0, "skew": 0.0}
    intrinsics = {
        c.name.upper(): {"fx": c.fx, "fy": c.fy, "cx": c.cx - 0.5, "cy": c.cy - 0.5} for c in truth.cameras.values()
    }
    calibration = {"names": list(mounts), "extrinsics": [pose_json(mount) for mount in mounts.values()]}
    calibration["intrinsics"] = [none | intrinsics.get(name, {}) for name in mounts]
    write_json(folder / "calibration" / "c0ffee.json", calibration)
    return folder


def stamp(time_s: float, slowed: int) -> str:
    """ISO text of a scene's time."""
    since = (START - datetime.datetime(1970, 1, 1, tzinfo=datetime.UTC)) + datetime.timedelta(seconds=round(time_s, 6))
    moment = datetime.datetime(1970, 1, 1, tzinfo=datetime.UTC) + since * slowed
    return moment.isoformat(timespec="microseconds").replace("+00:00", "Z")


def _datum(
    data: list[dict[str, Any]], index: int, name: str, kind: str, time_s: float, record: dict[str, Any], slowed: int
) -> str:
    key = f"{name}-{index}"
    identity = {"index": str(index), "name": name, "timestamp": stamp(time_s, slowed)}
    data.append({"datum": {kind: record}, "id": identity, "key": key})
    return key


def _boxes(truth: Scene, time_s: float, world_from_lidar: NDArray[np.float64]) -> list[dict[str, Any]]:
    boxes = []
    for number, track in enumerate(truth.tracks):
        pose = track.pose_at(time_s)
        if pose is None:
            continue
        length, width, height = track.size_m.tolist()
        box = {"length": length, "width": width, "height": height, "pose": pose_json(invert(world_from_lidar) @ pose)}
        boxes.append({"box": box, "class_id": CLASS_OF[track.label], "instance_id": 1000 + number})
    return boxes


def pose_json(pose: NDArray[np.float64]) -> dict[str, dict[str, float]]:
    """A DGP pose."""
    q, t = quaternion_from_matrix(pose).tolist(), pose[:3, 3].tolist()
    return {"rotation": dict(zip(("qw", "qx", "qy", "qz"), q)), "translation": dict(zip("xyz", t))}


def write(path: Path, content: bytes) -> None:
    """Write a file and its folders."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(content)


def write_json(path: Path, value: Any) -> None:
    """Write a JSON file."""
    write(path, json.dumps(value).encode())


def edit(path: Path, change: Callable[[dict[str, Any]], None]) -> None:
    """Change a JSON file in place."""
    record = json.loads(path.read_bytes())
    change(record)
    write_json(path, record)
