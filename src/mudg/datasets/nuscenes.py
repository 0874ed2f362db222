"""nuScenes: every table of a release ``v1.0-mini``, and the images and sweeps of its samples. A path is a scene.

Tokens are hashes of what they name. Poses are those of the log's world; the paths of a drive follow each other by an
hour each, because tools sort scenes by their time. There is no map: its mask is one black pixel. ``splits.json`` lists
the scenes of each split.
Source: the schema page of nuScenes (Caesar et al. 2020).
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from mudg.base import geometry, store
from mudg.datasets.samples import DatasetPlace, LabelledView
from mudg.formats.importers.nuscenes import CAMERAS

RELEASE: Final = "v1.0-mini"
FILES: Final = (
    "samples/*/*.png",
    "samples/*/*.bin",
    "splits.json",
    f"{RELEASE}/*.json",
    "maps/*.png",
    "provenance.jsonl",
)
LIDAR: Final = "LIDAR_TOP"
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


def write_view(folder: Path, target: DatasetPlace, view: LabelledView) -> Row:
    """The image of a sample and, if it has one, its sweep, and what the tables need to know of them."""
    camera = view.view.camera
    channel = CHANNELS.get(camera.name, f"CAM_{camera.name.upper()}")
    ending, index = view.name.removeprefix(f"{camera.name}_").split("/")
    ending = f"{target.drive}-{ending}"
    name = f"samples/{channel}/mudg__{ending}__{channel}__{index}.png"
    store.write_image(folder / name, view.layers["rgb"])
    intrinsics = [[camera.fx, 0, camera.cx - 0.5], [0, camera.fy, camera.cy - 0.5], [0, 0, 1]]
    boxes = [
        {
            "id": box.track_id,
            "label": box.label,
            "category": CATEGORIES.get(box.label, OTHER),
            **pose_row(box.world_from_box),
            "size": [box.size_m[1], box.size_m[0], box.size_m[2]],
            "visible": None if math.isnan(box.occlusion) else 1 - box.occlusion,
            "returns": box.returns,
        }
        for box in view.boxes
    ]
    mount = (
        {"rotation": [1.0, 0.0, 0.0, 0.0], "translation": [0.0, 0.0, 0.0]}
        if view.mount is None
        else pose_row(view.mount)
    )
    pose = view.view.world_from_cam if view.mount is None else view.view.world_from_cam @ geometry.invert(view.mount)
    size = {"width": camera.width, "height": camera.height}
    facts = {
        "drive": target.drive,
        "scene": ending,
        "index": index,
        "channel": channel,
        "filename": name,
        "time_us": _micros(view.view.time_s),
    }
    whole = {**facts, **size, "ego": pose_row(pose), "mount": {**mount, "camera_intrinsic": intrinsics}, "boxes": boxes}
    if view.sweep is not None:
        whole["sweep"] = f"samples/{LIDAR}/mudg__{ending}__{LIDAR}__{index}.pcd.bin"
        whole["lidar"] = {**pose_row(view.sweep.vehicle_from_lidar), "camera_intrinsic": []}
        reply = view.sweep.reply
        rows = np.column_stack([reply.xyz, 255 * reply.intensity, reply.ring]).astype("<f4")
        store.write_blocks(folder / whole["sweep"], [rows.tobytes()])
    return whole


def write_whole(folder: Path, records: Sequence[Mapping[str, Any]]) -> None:
    """The tables."""
    tables: dict[str, list[Row]] = {name: [] for name in ("attribute", "scene", "sample", "sample_data", "ego_pose")}
    mounts = {(record["drive"], record["channel"]): record["mount"] for record in records}
    mounts |= {(record["drive"], LIDAR): record["lidar"] for record in records if "lidar" in record}
    kind = lambda channel: "lidar" if channel == LIDAR else "camera"
    tables["sensor"] = [
        {"token": token("sensor", channel), "channel": channel, "modality": kind(channel)}
        for channel in dict.fromkeys(channel for _, channel in mounts)
    ]
    tables["calibrated_sensor"] = [
        {"token": token("mount", drive, channel), "sensor_token": token("sensor", channel), **mount}
        for (drive, channel), mount in mounts.items()
    ]
    names = sorted({CATEGORIES[label] for label in CATEGORIES} | {OTHER})
    tables["category"] = [
        {"token": token("category", name), "name": name, "description": "", "index": i} for i, name in enumerate(names)
    ]
    levels = [(str(i + 1), level) for i, (_, level) in enumerate(VISIBLE)]
    tables["visibility"] = [{"token": number, "level": level, "description": ""} for number, level in levels]
    drives = list(dict.fromkeys(record["drive"] for record in records))
    log = {"vehicle": "mudg", "date_captured": "2017-07-14", "location": "mudg"}
    tables["log"] = [{"token": token("log", drive), "logfile": drive, **log} for drive in drives]
    logs = [row["token"] for row in tables["log"]]
    tables["map"] = [
        {"token": token("map"), "log_tokens": logs, "category": "semantic_prior", "filename": "maps/none.png"}
    ]
    scenes = {f"scene-{record['scene']}": record["split"] for record in records}
    splits = {split: [name for name, own in scenes.items() if own == split] for split in dict.fromkeys(scenes.values())}
    store.write_json(folder / "splits.json", splits)
    store.write_image(folder / "maps" / "none.png", np.zeros((1, 1, 3), np.uint8))
    annotations: dict[tuple[str, str], list[Row]] = {}
    for number, scene in enumerate(dict.fromkeys(record["scene"] for record in records)):
        later = number * HOUR_US
        of_scene = [{**one, "time_us": one["time_us"] + later} for one in records if one["scene"] == scene]
        indices = sorted({record["index"] for record in of_scene})
        samples = ["", *(token("sample", scene, index) for index in indices), ""]
        ends = {"first_sample_token": samples[1], "last_sample_token": samples[-2], "nbr_samples": len(indices)}
        drive = of_scene[0]["drive"]
        about = {"name": f"scene-{scene}", "description": f"path {scene}", "log_token": token("log", drive)}
        tables["scene"].append({"token": token("scene", scene), **about, **ends})
        for at, index in enumerate(indices, 1):
            views = [record for record in of_scene if record["index"] == index]
            chain = {"prev": samples[at - 1], "next": samples[at + 1]}
            row = {"token": samples[at], "timestamp": views[0]["time_us"], "scene_token": token("scene", scene)}
            tables["sample"].append({**row, **chain})
            for record, channel, filename in _files(views):
                own = token("data", filename)
                tables["ego_pose"].append({"token": own, "timestamp": record["time_us"], **record["ego"]})
                data = {"token": own, "sample_token": samples[at], "ego_pose_token": own, "is_key_frame": True}
                data |= {"calibrated_sensor_token": token("mount", drive, channel), "timestamp": record["time_us"]}
                image = channel != LIDAR
                data |= {"fileformat": "png" if image else "pcd", "filename": filename}
                data |= {"width": record["width"] if image else 0, "height": record["height"] if image else 0}
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
                returns = max(box["returns"] for box in boxes)
                row |= {"num_lidar_pts": returns, "num_radar_pts": 0, "category": boxes[0]["category"]}
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


def _files(records: Sequence[Mapping[str, Any]]) -> Iterator[tuple[Mapping[str, Any], str, str]]:
    """Every file of samples: the record that it belongs to, its channel and name."""
    for record in records:
        yield record, record["channel"], record["filename"]
        if "sweep" in record:
            yield record, LIDAR, record["sweep"]


def _data_token(records: Sequence[Mapping[str, Any]], channel: str, indices: Sequence[str], at: int) -> str:
    """Token of the same sensor's file at another index; empty beyond the ends."""
    if not 0 <= at < len(indices):
        return ""
    files = _files([one for one in records if one["index"] == indices[at]])
    names = [filename for _, own, filename in files if own == channel]
    return token("data", names[0]) if names else ""


def _micros(time_s: float) -> int:
    return START_US + round(time_s * 1e6)


def pose_row(pose: NDArray[np.float64]) -> Row:
    """A pose as translation and rotation (w, x, y, z)."""
    return {"translation": pose[:3, 3].tolist(), "rotation": geometry.quaternion_from_matrix(pose).tolist()}
