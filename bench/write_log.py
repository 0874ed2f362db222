"""A generated city written as a log of a data set, with its sensors and image sizes: something to measure an importer on.

    python bench/write_log.py {kitti360,pandaset,nuplan,custom} FOLDER [--frames 6]
    python bench/ingest_cost.py FORMAT FOLDER

The logs are written by the writers of ``tests/``; cameras that the city's car lacks show another camera's images.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))

import roundtrip
from write_custom import write_log
from write_kitti360 import write_kitti360
from write_nuplan import write_nuplan
from write_pandaset import write_pandaset

from mudg.base import log
from mudg.base.types import Track
from mudg.data.city import write_city

DISTORTION = (-0.356, 0.171, -0.0003, -0.0002, -0.05)
PANDASET = {"front_camera": "front", "front_left_camera": "front_left", "front_right_camera": "front",
            "left_camera": "front_left", "right_camera": "front", "back_camera": "front_left"}  # fmt: skip
NUPLAN = {f"CAM_{name}": ("front", "front_left")[k % 2] for k, name in enumerate("F0 L0 L1 L2 R0 R1 R2 B0".split())}


def main() -> None:
    """Write one log."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("format", choices=("kitti360", "pandaset", "nuplan", "custom"))
    parser.add_argument("folder", type=Path)
    parser.add_argument("--frames", type=int, default=6)
    asked = parser.parse_args()
    log.set_quiet(True)
    config = replace(roundtrip.SMALL, n_frames=asked.frames, width=1920, height=1080, lidar_beams=64,
                     lidar_azimuth_step_deg=0.13)  # fmt: skip
    if asked.format == "kitti360":
        config = replace(config, width=1408, height=376, lidar_azimuth_step_deg=0.18)
    if asked.format == "custom":
        config = replace(config, width=960, height=640)
    with tempfile.TemporaryDirectory() as folder:
        truth = write_city(config, Path(folder) / "city")
        times = np.array([sweep.time_s for sweep in truth.sweeps])
        keys = {track: [track.pose_at(float(time)) for time in times] for track in truth.tracks}
        tracks = tuple(
            Track(track.id, track.label, track.size_m, times, np.stack(poses))
            for track, poses in keys.items()
            if all(pose is not None for pose in poses)
        )
        truth = replace(truth, tracks=tracks)
        if asked.format == "kitti360":
            write_kitti360(truth, asked.folder)
        elif asked.format == "pandaset":
            write_pandaset(truth, asked.folder, cameras=PANDASET, suffix=".jpg", point_times=True)
        elif asked.format == "custom":
            write_log(truth, asked.folder, ".pcd")
        else:
            write_nuplan(truth, asked.folder, cameras=NUPLAN, distortion=DISTORTION, jpeg=True)
    sys.stdout.write(f"{asked.format}: {asked.frames} frames, {len(tracks)} boxes each, in {asked.folder}\n")


if __name__ == "__main__":
    main()
