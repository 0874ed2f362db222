"""Processor time per frame and peak memory of the importers that have no real log to measure on.

A generated city is written as a log of the format, with the sensors and sizes of the data set (writers of ``tests/``), then
imported by a process of its own. Peak memory is that of the whole process, interpreter and libraries included; ``empty``
is a process that imports nothing but the same code.

python bench/import_logs.py [--frames 6] [--workers 1] [kitti360 pandaset nuplan]
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
from dataclasses import replace
from pathlib import Path

HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(HERE.parent / "tests"))

import roundtrip  # noqa: E402
from write_kitti360 import write_kitti360  # noqa: E402
from write_nuplan import write_nuplan  # noqa: E402
from write_pandaset import write_pandaset  # noqa: E402

from mudg.base import log  # noqa: E402
from mudg.data.city import write_city  # noqa: E402

BEND = (-0.356, 0.171, -0.0003, -0.0002, -0.05)
PANDASET = {"front_camera": "front", "front_left_camera": "front_left", "front_right_camera": "front",
            "left_camera": "front_left", "right_camera": "front", "back_camera": "front_left"}  # fmt: skip
NUPLAN = {f"CAM_{name}": ("front", "front_left")[k % 2] for k, name in enumerate("F0 L0 L1 L2 R0 R1 R2 B0".split())}
MEASURE = """
import sys, time
from pathlib import Path
from mudg.base import log
from mudg.data.importers import IMPORTERS
from mudg.data.importers.options import ImportOptions
log.set_quiet(True)
name, source, out, workers = sys.argv[1:]
start, wall = time.process_time(), time.monotonic()
frames = sum(sweep.sensor in ("velodyne", "pandar64", "merged") for sweep in IMPORTERS[name](Path(source), Path(out), ImportOptions(
    workers=int(workers))).sweeps) if source else 1
peak = next(line for line in open("/proc/self/status") if line.startswith("VmHWM"))  # getrusage would count the parent's
print(time.process_time() - start, time.monotonic() - wall, frames, int(peak.split()[1]) / 1024)
"""


def measured(name: str, source: str, out: Path, workers: int) -> tuple[float, float, float]:
    """Processor seconds and wall seconds per frame, and peak MiB, of one import."""
    words = [sys.executable, "-c", MEASURE, name, source, str(out), str(workers)]
    done = subprocess.run(words, check=True, capture_output=True, text=True)
    cpu_s, wall_s, frames, peak_mib = (float(word) for word in done.stdout.split())
    return cpu_s / frames, wall_s / frames, peak_mib


def main() -> None:
    """Write, import, print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("formats", nargs="*", default=["kitti360", "pandaset", "nuplan"])
    parser.add_argument("--frames", type=int, default=6)
    parser.add_argument("--workers", type=int, default=1)
    options = parser.parse_args()
    log.set_quiet(True)
    large = replace(roundtrip.SMALL, n_frames=options.frames, width=1920, height=1080, lidar_beams=64)
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder)
        for name in options.formats:
            size = {"width": 1408, "height": 376, "lidar_azimuth_step_deg": 0.18} if name == "kitti360" else {
                "lidar_azimuth_step_deg": 0.13
            }  # fmt: skip
            truth = write_city(replace(large, **size), root / f"{name} city")
            times = [sweep.time_s for sweep in truth.sweeps]
            tracks = [t for t in truth.tracks if all(t.pose_at(time) is not None for time in times)]
            truth = replace(truth, tracks=tuple(tracks))
            if name == "kitti360":
                source = write_kitti360(truth, root / name)
            elif name == "pandaset":
                source = write_pandaset(truth, root / name, cameras=PANDASET, suffix=".jpg", point_times=True)
            else:
                source = write_nuplan(truth, root / name, cameras=NUPLAN, distortion=BEND, jpeg=True)
            _, _, empty = measured(name, "", root, 1)
            cpu_s, wall_s, peak = measured(name, str(source), root / f"{name} scene", options.workers)
            sys.stdout.write(
                f"{name:9s} {options.frames} frames, {len(tracks)} boxes each: {cpu_s:.2f} s of processor a frame "
                f"({wall_s:.2f} s of wall, {options.workers} workers), peak {peak:.0f} MiB (empty {empty:.0f})\n"
            )
            sys.stdout.flush()


if __name__ == "__main__":
    main()
