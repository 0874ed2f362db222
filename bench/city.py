"""Processor times of the generated city: world build, frames, sweeps. Prints a table; nothing is written.

python bench/city.py [--threads 1] [--seeds 6]
"""

from __future__ import annotations

import argparse
import statistics
import sys
import time
from collections.abc import Callable

from mudg import native
from mudg.city.config import CityConfig
from mudg.city.world import CityWorld


def milliseconds(action: Callable[[], object], repeats: int) -> float:
    """Median processor time in milliseconds (wall time is what other programs leave)."""
    times = []
    for _ in range(repeats):
        start = time.process_time()
        action()
        times.append((time.process_time() - start) * 1e3)
    return statistics.median(times)


def main() -> None:
    """Measure some seeds and print medians and maxima over them."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--seeds", type=int, default=6)
    parser.add_argument("--repeats", type=int, default=5)
    options = parser.parse_args()
    native.set_threads(options.threads)
    sys.stdout.write(native.status() + "\n")
    rows: dict[str, list[float]] = {}
    for seed in range(options.seeds):
        config = CityConfig(seed=seed, n_frames=16)
        rows.setdefault("world build", []).append(milliseconds(lambda c=config: CityWorld(c), options.repeats))
        world = CityWorld(config)
        for name in ("front", "front_left"):
            view = world.frame_views(name)[8]
            for width, height in ((192, 128), (480, 320), (960, 640)):
                small = view.resized(width, height)
                took = milliseconds(lambda w=world, v=small: w.render(v, supersample=2), options.repeats)
                rows.setdefault(f"{width}x{height}, 4 rays per pixel", []).append(took)
            one = milliseconds(lambda w=world, v=view: w.render(v, supersample=1), options.repeats)
            rows.setdefault("480x320, 1 ray per pixel", []).append(one)
        rows.setdefault("sweep 64 x 1800", []).append(milliseconds(lambda w=world: w.lidar_sweep(8), options.repeats))
    sys.stdout.write(
        f"{'':28s} {'median ms':>10s} {'max ms':>10s}   ({options.threads} threads, {options.seeds} seeds)\n"
    )
    for name, values in rows.items():
        sys.stdout.write(f"{name:28s} {statistics.median(values):10.1f} {max(values):10.1f}\n")


if __name__ == "__main__":
    main()
