"""Times the point z-buffer: points into one view. Wall time and processor time, medians, milliseconds.

python bench/project.py --points 2000000 --size 960x640 --threads 2
"""

from __future__ import annotations

import argparse
import statistics
import sys
import time

import numpy as np

from mudg import native
from mudg.base.types import Camera, FusedCloud, PointCloud, View
from mudg.core.project import ProjectConfig, project_cloud


def street_points(count: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Points of a street in front of an OpenCV camera at the origin, in no order, about half of them in view."""
    rng = np.random.default_rng(seed)
    z = rng.uniform(-20, 100, count)
    side = rng.choice([-9.0, 9.0], count) + 0.1 * rng.standard_normal(count)
    ground = rng.random(count) < 0.5
    x = np.where(ground, rng.uniform(-9, 9, count), side)
    y = np.where(ground, 1.6, rng.uniform(-8, 1.6, count))
    return np.stack([x, y, z], 1).astype(np.float32), rng.integers(0, 256, (count, 3), dtype=np.uint8)


def say(line: str) -> None:
    """One line of the result, at once."""
    sys.stdout.write(line + "\n")
    sys.stdout.flush()


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--points", type=int, default=2_000_000)
    parser.add_argument("--size", default="960x640")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--repeats", type=int, default=9)
    options = parser.parse_args()
    native.require("this benchmark")
    native.set_threads(options.threads)
    say(native.status())
    width, height = (int(side) for side in options.size.split("x"))
    view = View(Camera("front", width, height, 0.9 * width, 0.9 * width, width / 2, height / 2), np.eye(4), 0.0)
    xyz, rgb = street_points(options.points)
    cloud = FusedCloud(PointCloud(xyz, rgb, "world"), {})
    cases = {
        "one pixel": ProjectConfig(),
        "2.5 pixels": ProjectConfig(static_splat_px=2.5),
        "one pixel, occlusion test": ProjectConfig(occluder_m=0.2),
    }
    for name, config in cases.items():
        wall, busy = [], []
        for _ in range(options.repeats + 1):
            started, worked = time.perf_counter(), time.process_time()
            seen = project_cloud(cloud, {}, view, config)
            wall.append(1e3 * (time.perf_counter() - started))
            busy.append(1e3 * (time.process_time() - worked))
        share = float(seen.valid.float().mean())
        say(
            f"{options.points} points, {options.size}, {options.threads} threads, {name}: "
            f"wall {statistics.median(wall[1:]):.1f}, processor {statistics.median(busy[1:]):.1f}, covered {share:.2f}"
        )


if __name__ == "__main__":
    main()
