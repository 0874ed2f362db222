"""nuScenes: every table of a release ``v1.0-mini``, and the images of its samples. Every path is a scene of its own.

Tokens are hashes of what they name. Poses are those of the log's world; the paths of a drive follow each other by an
hour each, because tools sort scenes by their time. There is no LiDAR and no map: the map's mask is one black pixel.
Source: the schema page of nuScenes (Caesar et al. 2020).
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from mudg.base import geometry, store
from mudg.datasets.samples import LabelledView
from mudg.formats.importers.nuscenes import CAMERAS

RELEASE: Final = "v1.0-mini"
FILES: Final = ("samples/*/*.png", f"{RELEASE}/*.json", "maps/*.png", "provenance.jsonl")
START_US: Final = 1_500_000_000_000_000
HOUR_US: Final = 3_600_000_000
CHANNELS: Final = {name: channel for channel, name in CAMERAS.items()}
CATEGORIES: Final = {
    **dict.fromkeys(("car", "van", "vehicle"), "vehicle.car"),
    "truck": "vehicle.truck",
    "bus": "vehicle.bus.rigid",
    "trailer": "vehicle.trailer",
    "motorcycle": "vehicle.motorcycle",
    **dict.fromkeys(("bicycle", "cyclist", "rider", "bicyclist"), "vehicle.bicycle"),
    **dict.fromkeys(("pedestrian", "person", "adult"), "human.pedestrian.adult"),
    "child": "human.pedestrian.child",
}
OTHER: Final = "movable_object.debris"
VISIBLE: Final = ((0.4, "v0-40"), (0.6, "v40-60"), (0.8, "v60-80"), (1.01, "v80-100"))
"""Visible shares below which a level ends, and its name."""
Row = dict[str, Any]


def token(*words: object) -> str:
    """32 hexadecimal digits that follow from what is named."""
    return hashlib.sha256(" ".join(map(str, words)).encode()).hexdigest()[:32]


def write_view(folder: Path, number: int, view: LabelledView) -> Row:
    """The image of a sample, and what the tables need to know of it."""
    camera = view.view.camera
    channel = CHANNELS.get(camera.name, f"CAM_{camera.name.upper()}")
    ending, index = view.name.removeprefix(f"{camera.name}_").split("/")
    name = f"samples/{channel}/mudg__{ending}__{channel}__{index}.png"
    store.write_image(folder / name, view.layers["rgb"])
    intrinsics = [[camera.fx, 0, camera.cx - 0.5], [0, camera.fy, camera.cy - 0.5], [0, 0, 1]]
    boxes = [
        {
            "id": box.track_id,
            "category": CATEGORIES.get(box.label, OTHER),
            **_pose(box.world_from_box),
            "size": [box.size_m[1], box.size_m[0], box.size_m[2]],
            "visible": None if math.isnan(box.occlusion) else 1 - box.occlusion,
        }
        for box in view.boxes
    ]
    mount = (
        {"rotation": [1.0, 0.0, 0.0, 0.0], "translation": [0.0, 0.0, 0.0]} if view.mount is None else _pose(view.mount)
    )
    pose = view.view.world_from_cam if view.mount is None else view.view.world_from_cam @ geometry.invert(view.mount)
    size = {"width": camera.width, "height": camera.height}
    facts = {
        "scene": ending,
        "index": index,
        "channel": channel,
        "filename": name,
        "time_us": _micros(view.view.time_s),
    }
    return {**facts, **size, "ego": _pose(pose), "mount": {**mount, "camera_intrinsic": intrinsics}, "boxes": boxes}


def write_whole(folder: Path, records: Sequence[Mapping[str, Any]]) -> None:
    """The tables."""
    tables: dict[str, list[Row]] = {name: [] for name in ("attribute", "scene", "sample", "sample_data", "ego_pose")}
    sensors = {record["channel"]: record["mount"] for record in records}
    channel_row = lambda channel: {"token": token("sensor", channel), "channel": channel, "modality": "camera"}
    tables["sensor"] = [channel_row(channel) for channel in sensors]
    tables["calibrated_sensor"] = [
        {"token": token("mount", channel), "sensor_token": token("sensor", channel), **mount}
        for channel, mount in sensors.items()
    ]
    names = sorted({CATEGORIES[label] for label in CATEGORIES} | {OTHER})
    tables["category"] = [
        {"token": token("category", name), "name": name, "description": "", "index": i} for i, name in enumerate(names)
    ]
    levels = [(str(i + 1), level) for i, (_, level) in enumerate(VISIBLE)]
    tables["visibility"] = [{"token": number, "level": level, "description": ""} for number, level in levels]
    tables["log"] = [
        {"token": token("log"), "logfile": "mudg", "vehicle": "mudg", "date_captured": "2017-07-14", "location": "mudg"}
    ]
    tables["map"] = [
        {"token": token("map"), "log_tokens": [token("log")], "category": "semantic_prior", "filename": "maps/none.png"}
    ]
    store.write_image(folder / "maps" / "none.png", np.zeros((1, 1, 3), np.uint8))
    annotations: dict[tuple[str, str], list[Row]] = {}
    for number, scene in enumerate(dict.fromkeys(record["scene"] for record in records)):
        later = number * HOUR_US
        of_scene = [{**one, "time_us": one["time_us"] + later} for one in records if one["scene"] == scene]
        indices = sorted({record["index"] for record in of_scene})
        samples = ["", *(token("sample", scene, index) for index in indices), ""]
        ends = {"first_sample_token": samples[1], "last_sample_token": samples[-2], "nbr_samples": len(indices)}
        about = {"name": f"scene-{scene}", "description": f"path {scene}", "log_token": token("log")}
        tables["scene"].append({"token": token("scene", scene), **about, **ends})
        for at, index in enumerate(indices, 1):
            views = [record for record in of_scene if record["index"] == index]
            chain = {"prev": samples[at - 1], "next": samples[at + 1]}
            row = {"token": samples[at], "timestamp": views[0]["time_us"], "scene_token": token("scene", scene)}
            tables["sample"].append({**row, **chain})
            for record in views:
                own, channel = token("data", record["filename"]), record["channel"]
                tables["ego_pose"].append({"token": own, "timestamp": record["time_us"], **record["ego"]})
                data = {"token": own, "sample_token": samples[at], "ego_pose_token": own, "is_key_frame": True}
                data |= {"calibrated_sensor_token": token("mount", channel), "timestamp": record["time_us"]}
                data |= {"fileformat": "png", "filename": record["filename"]}
                data |= {"width": record["width"], "height": record["height"]}
                beside = {
                    way: _data_token(of_scene, channel, indices, at - 1 + step)
                    for way, step in (("prev", -1), ("next", 1))
                }
                tables["sample_data"].append({**data, **beside})
            seen: dict[str, list[Row]] = {}
            for box in (box for record in views for box in record["boxes"]):
                seen.setdefault(box["id"], []).append(box)
            for name, boxes in seen.items():
                visible = [box["visible"] for box in boxes if box["visible"] is not None]
                level = next(str(i + 1) for i, (end, _) in enumerate(VISIBLE) if max(visible, default=1.0) < end)
                place = {key: boxes[0][key] for key in ("translation", "rotation", "size")}
                row = {"token": token("box", scene, index, name), "sample_token": samples[at], **place}
                row |= {
                    "instance_token": token("instance", scene, name),
                    "visibility_token": level,
                    "attribute_tokens": [],
                }
                row |= {"num_lidar_pts": 0, "num_radar_pts": 0, "category": boxes[0]["category"]}
                annotations.setdefault((scene, name), []).append(row)
    tables["instance"], tables["sample_annotation"] = [], []
    for (scene, name), rows in annotations.items():
        whole = {"token": token("instance", scene, name), "category_token": token("category", rows[0]["category"])}
        ends = {"first_annotation_token": rows[0]["token"], "last_annotation_token": rows[-1]["token"]}
        tables["instance"].append({**whole, "nbr_annotations": len(rows), **ends})
        chain = ["", *(row["token"] for row in rows), ""]
        for at, row in enumerate(rows, 1):
            kept = {key: value for key, value in row.items() if key != "category"}
            tables["sample_annotation"].append({**kept, "prev": chain[at - 1], "next": chain[at + 1]})
    for table, rows in tables.items():
        store.write_json(folder / RELEASE / f"{table}.json", rows)


def _data_token(records: Sequence[Mapping[str, Any]], channel: str, indices: Sequence[str], at: int) -> str:
    """Token of the same camera's image at another index; empty beyond the ends."""
    if not 0 <= at < len(indices):
        return ""
    names = [one["filename"] for one in records if one["channel"] == channel and one["index"] == indices[at]]
    return token("data", names[0]) if names else ""


def _micros(time_s: float) -> int:
    return START_US + round(time_s * 1e6)


def _pose(pose: Any) -> Row:
    return {"translation": pose[:3, 3].tolist(), "rotation": geometry.quaternion_from_matrix(pose).tolist()}
