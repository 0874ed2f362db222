"""A generated city written as a log of a data set: something to try or to measure an importer on.

    python bench/write_log.py FORMAT FOLDER --small              seconds; tiny images of two cameras
    python bench/write_log.py FORMAT FOLDER [--frames 6]         the sensors and image sizes of the data set
    python bench/ingest_cost.py FORMAT FOLDER

FORMAT is one of kitti360, pandaset, nuplan, custom, recording (what docs/examples/convert_my_log.py reads) and, with
``--small`` only, waymo, nuscenes, argoverse2 (argoverse2 needs pyarrow). The logs are written by the writers of
``tests/``; cameras that the city's car lacks show another camera's images.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))

import roundtrip
from write_custom import write_log, write_recording
from write_kitti360 import write_kitti360
from write_nuplan import write_nuplan
from write_nuscenes import write_nuscenes
from write_pandaset import write_pandaset

from mudg.base import log
from mudg.base.types import Scene, Track
from mudg.city import sensors
from mudg.city.logs import write_city

DISTORTION = (-0.356, 0.171, -0.0003, -0.0002, -0.05)
PANDASET = {
    "front_camera": "front",
    "front_left_camera": "front_left",
    "front_right_camera": "front",
    "left_camera": "front_left",
    "right_camera": "front",
    "back_camera": "front_left",
}
NUPLAN = {f"CAM_{name}": ("front", "front_left")[k % 2] for k, name in enumerate("F0 L0 L1 L2 R0 R1 R2 B0".split())}


def write_av2(truth: Scene, folder: Path) -> None:
    """Argoverse 2; imported late, because it needs pyarrow."""
    import write_av2

    write_av2.write_av2(truth, folder)


def write_waymo(truth: Scene, folder: Path) -> None:
    """Format 1 of Waymo: one TFRecord file."""
    import write_waymo

    made = write_waymo.log_of(truth, truth.tracks, beams=sensors.lidar_elevations(roundtrip.SMALL), columns=240)
    write_waymo.write_tfrecord(made, folder / f"segment-{made.name}_with_camera_labels.tfrecord")


def write_raw(truth: Scene, folder: Path) -> None:
    """A recording as a vehicle may store it: folders of images and clouds, tables of poses and boxes."""
    write_recording(truth, folder / "drive")


SMALL_WRITERS: dict[str, Callable[[Scene, Path], object]] = {
    "kitti360": write_kitti360,
    "pandaset": write_pandaset,
    "nuplan": write_nuplan,
    "custom": write_log,
    "waymo": write_waymo,
    "nuscenes": write_nuscenes,
    "argoverse2": write_av2,
    "recording": write_raw,
}


def write_small(name: str, folder: Path, frames: int) -> int:
    """The log of the importers' tests: two cameras of 96x64 pixels, 16 beams. Returns its number of boxes per frame."""
    with tempfile.TemporaryDirectory() as city:
        truth = roundtrip.small_log(Path(city) / "city", n_frames=frames)
        SMALL_WRITERS[name](truth, folder)
    return len(truth.tracks)


def write_full(name: str, folder: Path, frames: int) -> int:
    """The log with the sensors and image sizes of the data set. Returns its number of boxes per frame."""
    config = replace(
        roundtrip.SMALL, n_frames=frames, width=1920, height=1080, lidar_beams=64, lidar_azimuth_step_deg=0.13
    )
    if name == "kitti360":
        config = replace(config, width=1408, height=376, lidar_azimuth_step_deg=0.18)
    if name == "custom":
        config = replace(config, width=960, height=640)
    if name == "recording":
        config = replace(config, width=384, height=256, lidar_azimuth_step_deg=0.2)
    with tempfile.TemporaryDirectory() as city:
        truth = write_city(config, Path(city) / "city")
        times = np.array([sweep.time_s for sweep in truth.sweeps])
        keys = {track: [track.pose_at(float(time)) for time in times] for track in truth.tracks}
        tracks = tuple(
            Track(track.id, track.label, track.size_m, times, np.stack(poses))
            for track, poses in keys.items()
            if all(pose is not None for pose in poses)
        )
        truth = replace(truth, tracks=tracks)
        if name == "kitti360":
            write_kitti360(truth, folder)
        elif name == "pandaset":
            write_pandaset(truth, folder, cameras=PANDASET, suffix=".jpg", point_times=True)
        elif name == "custom":
            write_log(truth, folder, ".pcd")
        elif name == "recording":
            write_raw(truth, folder)
        else:
            write_nuplan(truth, folder, cameras=NUPLAN, distortion=DISTORTION, jpeg=True)
    return len(tracks)


def main() -> None:
    """Write one log."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("format", choices=tuple(SMALL_WRITERS))
    parser.add_argument("folder", type=Path)
    parser.add_argument("--frames", type=int, default=6)
    parser.add_argument("--small", action="store_true")
    options = parser.parse_args()
    if not options.small and options.format not in ("kitti360", "pandaset", "nuplan", "custom", "recording"):
        parser.error(f"{options.format} is written with --small only (bench/sensor_logs.py, bench/waymo.py measure it)")
    log.set_quiet(True)
    options.folder.mkdir(parents=True, exist_ok=True)
    boxes = (write_small if options.small else write_full)(options.format, options.folder, options.frames)
    sys.stdout.write(f"{options.format}: {options.frames} frames, {boxes} boxes each, in {options.folder}\n")


if __name__ == "__main__":
    main()
