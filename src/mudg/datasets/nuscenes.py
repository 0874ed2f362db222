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
from mudg.datasets.samples import LabelledView
from mudg.formats.importers.nuscenes import CAMERAS

RELEASE: Final = "v1.0-mini"
FILES: Final = (*"samples/*/*.png samples/*/*.bin splits.json maps/*.png provenance.jsonl".split(), f"{RELEASE}/*.json")
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
NOWHERE: Final = {"translation": [0.0, 0.0, 0.0], "rotation": [1.0, 0.0, 0.0, 0.0]}
Row = dict[str, Any]


def token(*words: object) -> str:
    """32 hexadecimal digits that follow from what is named."""
    return hashlib.sha256(" ".join(map(str, words)).encode()).hexdigest()[:32]


def write_view(folder: Path, view: LabelledView) -> Row:
    """The image of a sample and, if it has one, its sweep, and what the tables need to know of them."""
    camera = view.view.camera
    channel = CHANNELS.get(camera.name, f"CAM_{camera.name.upper()}")
    ending, index = view.name.removeprefix(f"{camera.name}_").split("/")
    ending = f"{view.drive}-{ending}"
    name = f"samples/{channel}/mudg__{ending}__{channel}__{index}.png"
    store.write_image(folder / name, view.layers["rgb"])
    intrinsics = [[camera.fx, 0, camera.cx - 0.5], [0, camera.fy, camera.cy - 0.5], [0, 0, 1]]
    boxes = []
    for box in view.boxes:
        about = {"id": box.track_id, "label": box.label, "category": CATEGORIES.get(box.label, OTHER)}
        about |= {**pose_row(box.world_from_box), "size": [box.size_m[1], box.size_m[0], box.size_m[2]]}
        visible = None if math.isnan(box.occlusion) else 1 - box.occlusion
        boxes.append({**about, "visible": visible, "returns": box.returns})
    mount = NOWHERE if view.mount is None else pose_row(view.mount)
    pose = view.view.world_from_cam if view.mount is None else view.view.world_from_cam @ geometry.invert(view.mount)
    time_us = START_US + round(view.view.time_s * 1e6)
    whole: Row = {"drive": view.drive, "scene": ending, "index": index, "channel": channel, "filename": name}
    whole |= {"time_us": time_us, "width": camera.width, "height": camera.height, "ego": pose_row(pose)}
    whole |= {"mount": {**mount, "camera_intrinsic": intrinsics}, "boxes": boxes}
    if view.sweep is not None:
        whole["sweep"] = f"samples/{LIDAR}/mudg__{ending}__{LIDAR}__{index}.pcd.bin"
        whole["lidar"] = {**pose_row(view.sweep.vehicle_from_lidar), "camera_intrinsic": []}
        reply = view.sweep.reply
        rows = np.column_stack([reply.xyz, 255 * reply.intensity, reply.ring]).astype("<f4")
        store.write_blocks(folder / whole["sweep"], [rows.tobytes()])
    return whole


def write_whole(folder: Path, records: Sequence[Mapping[str, Any]]) -> None:
    """The tables."""
    mounts = {(record["drive"], record["channel"]): record["mount"] for record in records}
    mounts |= {(record["drive"], LIDAR): record["lidar"] for record in records if "lidar" in record}
    names = sorted({*CATEGORIES.values(), OTHER})
    log = {"vehicle": "mudg", "date_captured": "2017-07-14", "location": "mudg"}
    logs = {drive: token("log", drive) for drive in dict.fromkeys(record["drive"] for record in records)}
    none = {"category": "semantic_prior", "filename": "maps/none.png"}
    kind = lambda channel: "lidar" if channel == LIDAR else "camera"
    tables: dict[str, list[Row]] = {
        "attribute": [],
        "sensor": [
            {"token": token("sensor", channel), "channel": channel, "modality": kind(channel)}
            for channel in dict.fromkeys(channel for _, channel in mounts)
        ],
        "calibrated_sensor": [
            {"token": token("mount", drive, channel), "sensor_token": token("sensor", channel), **mount}
            for (drive, channel), mount in mounts.items()
        ],
        "category": [
            {"token": token("category", name), "name": name, "description": "", "index": number}
            for number, name in enumerate(names)
        ],
        "visibility": [
            {"token": str(number), "level": level, "description": ""} for number, (_, level) in enumerate(VISIBLE, 1)
        ],
        "log": [{"token": one, "logfile": drive, **log} for drive, one in logs.items()],
        "map": [{"token": token("map"), "log_tokens": list(logs.values()), **none}],
        **{name: [] for name in ("scene", "sample", "sample_data", "ego_pose", "instance", "sample_annotation")},
    }
    splits: dict[str, list[str]] = {}
    for number, scene in enumerate(dict.fromkeys(record["scene"] for record in records)):
        later = number * HOUR_US
        of_scene = [{**one, "time_us": one["time_us"] + later} for one in records if one["scene"] == scene]
        splits.setdefault(of_scene[0]["split"], []).append(f"scene-{scene}")
        _add_scene(tables, scene, of_scene)
    store.write_json(folder / "splits.json", splits)
    store.write_image(folder / "maps" / "none.png", np.zeros((1, 1, 3), np.uint8))
    for table, rows in tables.items():
        store.write_json(folder / RELEASE / f"{table}.json", rows)


def _add_scene(tables: Mapping[str, list[Row]], scene: str, records: Sequence[Mapping[str, Any]]) -> None:
    """The rows of a scene, which are chained in order of time: samples, files by channel, boxes by object."""
    drive, samples, files = records[0]["drive"], list[Row](), dict[str, list[Row]]()
    annotations: dict[str, list[Row]] = {}
    categories: dict[str, str] = {}
    for index in sorted({record["index"] for record in records}):
        views, sample = [record for record in records if record["index"] == index], token("sample", scene, index)
        row = {"token": sample, "timestamp": views[0]["time_us"], "scene_token": token("scene", scene)}
        samples.append(row)
        for record, channel, filename in _files(views):
            own, image = token("data", filename), channel != LIDAR
            tables["ego_pose"].append({"token": own, "timestamp": record["time_us"], **record["ego"]})
            row = {"token": own, "sample_token": sample, "ego_pose_token": own, "is_key_frame": True}
            row |= {"calibrated_sensor_token": token("mount", drive, channel), "timestamp": record["time_us"]}
            row |= {"fileformat": "png" if image else "pcd", "filename": filename}
            row |= {"width": record["width"] if image else 0, "height": record["height"] if image else 0}
            tables["sample_data"].append(row)
            files.setdefault(channel, []).append(row)
        seen: dict[str, list[Row]] = {}
        for box in (box for record in views for box in record["boxes"]):
            seen.setdefault(box["id"], []).append(box)
        for name, boxes in seen.items():
            visible = max((box["visible"] for box in boxes if box["visible"] is not None), default=1.0)
            level = next(str(number) for number, (end, _) in enumerate(VISIBLE, 1) if visible < end)
            row = {"token": token("box", scene, index, name), "sample_token": sample}
            row |= {key: boxes[0][key] for key in ("translation", "rotation", "size")}
            row |= {"instance_token": token("instance", scene, name), "visibility_token": level, "attribute_tokens": []}
            row |= {"num_lidar_pts": max(box["returns"] for box in boxes), "num_radar_pts": 0}
            annotations.setdefault(name, []).append(row)
            categories.setdefault(name, boxes[0]["category"])
    for rows in (samples, *files.values(), *annotations.values()):
        for row, before, after in zip(rows, [None, *rows[:-1]], [*rows[1:], None], strict=True):
            row["prev"], row["next"] = ("" if other is None else other["token"] for other in (before, after))
    ends = {"first_sample_token": samples[0]["token"], "last_sample_token": samples[-1]["token"]}
    about = {"name": f"scene-{scene}", "description": f"path {scene}", "log_token": token("log", drive)}
    tables["scene"].append({"token": token("scene", scene), **about, **ends, "nbr_samples": len(samples)})
    tables["sample"].extend(samples)
    for name, rows in annotations.items():
        own = {"token": token("instance", scene, name), "category_token": token("category", categories[name])}
        ends = {"first_annotation_token": rows[0]["token"], "last_annotation_token": rows[-1]["token"]}
        tables["instance"].append({**own, "nbr_annotations": len(rows), **ends})
        tables["sample_annotation"].extend(rows)


def _files(records: Sequence[Mapping[str, Any]]) -> Iterator[tuple[Mapping[str, Any], str, str]]:
    """Every file of samples: the record that it belongs to, its channel and name."""
    for record in records:
        yield record, record["channel"], record["filename"]
        if "sweep" in record:
            yield record, LIDAR, record["sweep"]


def pose_row(pose: NDArray[np.float64]) -> Row:
    """A pose as translation and rotation (w, x, y, z)."""
    return {"translation": pose[:3, 3].tolist(), "rotation": geometry.quaternion_from_matrix(pose).tolist()}
