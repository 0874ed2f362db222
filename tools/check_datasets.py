"""Have data sets of `mudg dataset` read by programs of others.

    python tools/check_datasets.py RUN --out FOLDER [--lidar hdl64]

RUN: folder of a finished `mudg run` or `mudg demo`. FOLDER gets the data sets and, in `readers`, an environment for
each reader, made with pip: nuscenes-devkit, pycocotools, pykitti and py123d, the last with mudg beside it.

Prints one line per format; the exit code is the number of failures.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import venv
from pathlib import Path

from mudg.base import store

READERS = {
    "coco": ("pycocotools==2.0.11", "numpy"),
    "nuscenes": ("nuscenes-devkit==1.2.0",),
    "kitti-tracking": ("pykitti==0.3.1", "opencv-python-headless"),
    "py123d": ("py123d==0.7.0",),
}
"""Format -> packages of its reader."""

OF_COCO = """
import json, sys
from pycocotools.coco import COCO
folder = sys.argv[1]
read = COCO(folder + "/annotations/instances.json")
assert read.getImgIds() and read.getAnnIds()
assert all(read.annToMask(one).sum() == one["area"] for one in read.anns.values())
print(len(read.getImgIds()), "images,", len(read.anns), "masks")
"""
OF_NUSCENES = """
import sys
import numpy as np
from nuscenes.nuscenes import NuScenes
from nuscenes.utils.data_classes import LidarPointCloud
from nuscenes.utils.geometry_utils import points_in_box
read = NuScenes("v1.0-mini", sys.argv[1], verbose=False)
inside = told = 0
for sample in read.sample:
    for channel, data in sample["data"].items():
        path, boxes, _ = read.get_sample_data(data)
        if channel != "LIDAR_TOP":
            continue
        points = LidarPointCloud.from_file(path).points
        for box in boxes:
            inside += points_in_box(box, points[:3]).sum()
            told += read.get("sample_annotation", box.token)["num_lidar_pts"]
assert told == 0 or abs(inside - told) <= 0.02 * told, (inside, told)
print(len(read.scene), "scenes,", len(read.sample), "samples,", len(read.sample_annotation), "boxes,",
      inside, "returns in them")
"""
OF_TRACKING = """
import sys
import numpy as np
import pykitti
from pykitti.utils import load_oxts_packets_and_poses, load_velo_scan, read_calib_file
folder = sys.argv[1]
read = pykitti.tracking(folder, "0000")
images, poses = list(read.cam2), [one.T_w_imu for one in load_oxts_packets_and_poses([folder + "/oxts/0000.txt"])]
off = max(np.abs(pose[:3, :3] @ pose[:3, :3].T - np.eye(3)).max() for pose in poses)
assert len(images) == len(poses) and off < 1e-9
calibration = read_calib_file(folder + "/calib/0000.txt")
points = sum(len(load_velo_scan(file)) for file in read.velo_files)
assert calibration["P2"].size == calibration["Tr_velo_cam"].size == 12
way = np.linalg.norm(poses[-1][:3, 3] - poses[0][:3, 3])
print(len(images), "images of sequence 0000,", round(float(way), 2), "m,", points, "returns")
"""
OF_123D = """
import sys
from py123d.api.scene.arrow.arrow_scene_builder import ArrowSceneBuilder
from py123d.api.scene.scene_filter import SceneFilter
from py123d.common.execution.sequential_executor import SequentialExecutor
builder = ArrowSceneBuilder(sys.argv[1] + "/logs", sys.argv[1])
scenes = builder.get_scenes(SceneFilter(iteration_threshold=1000000), SequentialExecutor())
images = boxes = points = 0
for scene in scenes:
    for index in range(scene.number_of_iterations):
        images += sum(scene.get_camera_at_iteration(index, one) is not None for one in scene.available_camera_ids)
        boxes += len(scene.get_box_detections_se3_at_iteration(index).box_detections)
        points += sum(len(scene.get_lidar_at_iteration(index, one).xyz) for one in scene.available_lidar_ids)
assert scenes and images
print(len(scenes), "logs,", images, "images,", boxes, "boxes,", points, "returns")
"""
PROGRAMS = {"coco": OF_COCO, "nuscenes": OF_NUSCENES, "kitti-tracking": OF_TRACKING, "py123d": OF_123D}


def main() -> int:
    """Write and read; returns the number of failures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--lidar", default="hdl64")
    given = parser.parse_args()
    failures = 0
    for name, packages in READERS.items():
        reader, out = environment(given.out / "readers" / name, packages), given.out / name
        lidar = () if name == "coco" else ("--lidar", given.lidar)
        words = ("dataset", name, given.run, "--shifts-m", "0", "2", "--every", "4", *lidar, "--out", out)
        with_mudg = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
        program = reader if name == "py123d" else sys.executable
        done = subprocess.run(
            [program, "-m", "mudg", *words], env=with_mudg, capture_output=True, text=True, check=False
        )
        if not done.returncode:
            clean = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"}
            words = (reader, "-c", PROGRAMS[name], out)
            done = subprocess.run(words, env=clean, capture_output=True, text=True, check=False)
        said = (done.stderr if done.returncode else done.stdout).strip().splitlines() or [""]
        print(f"{name} by {packages[0]}: {'failed: ' if done.returncode else ''}{said[-1]}", flush=True)
        failures += bool(done.returncode)
    return failures


def environment(folder: Path, packages: tuple[str, ...]) -> str:
    """The interpreter of an environment with packages; it is made if it is not there."""
    python, done = folder / "bin" / "python", folder / "packages.json"
    if not done.is_file() or store.read_json(done) != list(packages):
        venv.create(folder, with_pip=True, clear=True)
        subprocess.run([python, "-m", "pip", "install", "-q", *packages], check=True, stderr=subprocess.DEVNULL)
        store.write_json(done, list(packages))
    return str(python)


if __name__ == "__main__":
    sys.exit(main())
