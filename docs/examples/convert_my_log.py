"""Template: turn a recording of your own into the neutral layout that `mudg ingest` reads (docs/custom_format.md).

    python convert_my_log.py RECORDING OUT && mudg doctor OUT && mudg ingest OUT SCENE

Change the functions below to read what you have. As it stands it reads a recording of this form:

    sensors.json            {"front": {"width", "height", "K": 3x3, "D": [k1, k2, p1, p2, k3], "ego_from_sensor": 4x4},
                            "top": {...}}
    poses.csv               time_ns, x, y, z, qx, qy, qz, qw      vehicle in the world, metres
    images/front/<time_ns>.png
    lidar/top/<time_ns>.npy       float32 [N, 5]: x, y, z, intensity 0..255, seconds after <time_ns>
    boxes.csv               time_ns, track, class, length, width, height, x, y, z, yaw      centres in the world
"""

import csv
import json
import math
import shutil
import sys
from pathlib import Path

import numpy as np


def main(recording: Path, out: Path) -> None:
    sensors = json.loads((recording / "sensors.json").read_text())
    log = {
        "format": "mudg-log",
        "version": 1,
        "name": "my-log",
        "licence": "own recording",
        "time_unit": "ns",
        "cameras": {name: camera(values) for name, values in sensors.items() if "K" in values},
        "lidars": {name: lidar(values) for name, values in sensors.items() if "K" not in values},
        "ego": [ego_pose(row) for row in rows(recording / "poses.csv")],
        "images": [],
        "sweeps": [],
        "tracks": tracks(recording / "boxes.csv"),
    }
    for name in log["cameras"]:
        for path in sorted((recording / "images" / name).iterdir(), key=lambda path: int(path.stem)):
            target = f"images/{name}/{path.name}"
            (out / target).parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(path, out / target)
            log["images"].append({"camera": name, "time": int(path.stem), "file": target})
    for name in log["lidars"]:
        for path in sorted((recording / "lidar" / name).iterdir(), key=lambda path: int(path.stem)):
            target = f"lidar/{name}/{path.stem}.npz"
            points = np.load(path)
            (out / target).parent.mkdir(parents=True, exist_ok=True)
            np.savez(out / target, xyz=points[:, :3], intensity=points[:, 3], seconds=points[:, 4])
            log["sweeps"].append({"lidar": name, "time": int(path.stem), "file": target})
    (out / "log.json").write_text(json.dumps(log, indent=1))


def rows(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as handle:
        return list(csv.DictReader(handle))


def camera(values: dict) -> dict:
    (fx, _, cx), (_, fy, cy), _ = values["K"]
    pinhole = {"width": values["width"], "height": values["height"], "fx": fx, "fy": fy, "cx": cx, "cy": cy}
    return {
        **pinhole,
        "distortion": {"model": "brown_conrady", "coefficients": values["D"]},  # leave out if images are rectified
        "ego_from_camera": values["ego_from_sensor"],  # camera axes: x right, y down, z forward
    }


def lidar(values: dict) -> dict:
    return {
        "ego_from_lidar": values["ego_from_sensor"],
        "intensity_max": 255,
        "motion_compensated": True,  # false: points are moved to the sweep's time with the times below
        "time_field": "seconds",
        "time_unit": "s",
        "time_from": "sweep",
    }


def ego_pose(row: dict[str, str]) -> dict:
    wxyz = [float(row[key]) for key in ("qw", "qx", "qy", "qz")]  # mind the order: w first
    return {"time": int(row["time_ns"]), "world_from_ego": {"wxyz": wxyz, "xyz_m": [float(row[key]) for key in "xyz"]}}


def tracks(path: Path) -> list[dict]:
    found: dict[str, dict] = {}
    for row in rows(path) if path.is_file() else []:
        half = float(row["yaw"]) / 2
        size = [float(row[key]) for key in ("length", "width", "height")]
        pose = {"wxyz": [math.cos(half), 0, 0, math.sin(half)], "xyz_m": [float(row[key]) for key in "xyz"]}
        track = found.setdefault(row["track"], {"id": row["track"], "class": row["class"], "size_m": size, "boxes": []})
        track["boxes"].append({"time": int(row["time_ns"]), "world_from_object": pose})
    return list(found.values())


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
