"""Times the rasteriser: forward + backward to all parameters on street-like scenes, per backend variant and phase.

    python bench/bench_raster.py                        # one thread, every instruction set this processor has
    python bench/bench_raster.py --threads 2 --sizes 50000:480x320 --torch

Variants are interleaved within one run, so that a busy machine hits all of them alike. With one thread the processor
time of this process is measured (it does not count what others take), else wall time. Medians; milliseconds.
"""

from __future__ import annotations

import argparse
import json
import statistics
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from mudg import native
from mudg.base.errors import UsageError
from mudg.base.types import Camera, Gaussians, View
from mudg.core import raster_cpu
from mudg.core.raster import RasterConfig, rasterize

DEFAULT_SIZES = ("10000:480x320", "50000:480x320", "200000:480x320", "50000:960x640", "200000:960x640")


def street(count: int, width: int, height: int, channels: int, seed: int = 0) -> tuple[Gaussians, View]:
    """Ground, house fronts, cars, trees and a far backdrop; sizes follow the spacing, opacities look trained. SH degree 3."""
    rng = np.random.default_rng(seed)

    def spread(low: float, high: float, n: int) -> np.ndarray:
        return np.exp(rng.uniform(np.log(low), np.log(high), n))

    ground, front, car, tree = (int(share * count) for share in (0.35, 0.33, 0.15, 0.12))
    sky = count - ground - front - car - tree
    z = spread(2.5, 90, ground)
    parts = [np.stack([rng.uniform(-1, 1, ground) * np.minimum(14, 4 + 0.9 * z), 1.6 + 0.03 * rng.standard_normal(ground), z], 1)]
    z = spread(5, 90, front)
    side = rng.choice([-1, 1], front) * (11 + 0.45 * np.floor(3 * np.sin(0.15 * z)) + 0.05 * rng.standard_normal(front))
    parts.append(np.stack([side, rng.uniform(-9, 1.6, front), z], 1))
    place = np.stack([rng.uniform(-8, 8, 14), np.full(14, 0.85), spread(6, 60, 14)], 1)[rng.integers(0, 14, car)]
    face = rng.uniform(-1, 1, (car, 3))
    axis = rng.integers(0, 3, car)
    face[np.arange(car), axis] = np.sign(face[np.arange(car), axis])
    parts.append(place + face * [0.9, 0.75, 2.2])
    place = np.stack([rng.choice([-1, 1], 20) * rng.uniform(7, 10, 20), np.full(20, -2.0), spread(8, 70, 20)], 1)
    parts.append(place[rng.integers(0, 20, tree)] + rng.standard_normal((tree, 3)) * [0.8, 1.2, 0.8])
    yaw, pitch = rng.uniform(-0.9, 0.9, sky), rng.uniform(-0.02, 0.7, sky)
    parts.append(150 * np.stack([np.sin(yaw) * np.cos(pitch), -np.sin(pitch), np.cos(yaw) * np.cos(pitch)], 1))
    xyz = np.concatenate(parts)[rng.permutation(count)]

    distance, _ = cKDTree(xyz).query(xyz, k=4)
    spacing = np.sqrt((distance[:, 1:] ** 2).mean(1)).clip(1e-3, 6)
    scales = 0.8 * spacing[:, None] * np.exp(0.45 * rng.standard_normal((count, 3)))
    scales[np.arange(count), rng.integers(0, 3, count)] *= 0.35
    opacity = np.where(rng.random(count) < 0.45, rng.uniform(0.5, 0.995, count), spread(0.02, 0.5, count))
    sh = 0.12 * rng.standard_normal((count, 16, 3))
    sh[:, 0] = (rng.random((count, 3)) - 0.5) / 0.2820948
    values = (xyz, rng.standard_normal((count, 4)), scales, opacity, sh, rng.standard_normal((count, channels)))
    leaves = [torch.tensor(value, dtype=torch.float32).requires_grad_() for value in values]
    camera = Camera("front", width, height, 0.9 * width, 0.909 * width, width / 2 + 3.3, height / 2 - 2.1)
    return Gaussians(*leaves, node=torch.zeros(count, dtype=torch.int32)), View(camera, np.eye(4), 0.0)


def once(gaussians: Gaussians, view: View, config: RasterConfig, upstream: list[Tensor]) -> None:
    """One forward and backward pass."""
    out = rasterize(gaussians, view, config)
    images = [out.rgb, out.depth, out.alpha, *([] if out.extra is None else [out.extra])]
    torch.autograd.backward(images, upstream)
    for name in ("means", "quats", "scales", "opacity", "sh", "extra"):
        tensor = getattr(gaussians, name)
        if tensor is not None:
            tensor.grad = None


def instruction_sets() -> list[str]:
    """Those this processor can run, best first."""
    found = []
    for name in ("avx512", "avx2", "portable"):
        try:
            native.set_isa(name)
        except UsageError:
            continue
        found.append(name)
    return found


def measure(size: str, channels: int, repeats: int, with_torch: bool, clock: Callable[[], float]) -> list[dict[str, Any]]:
    """Rows of the table for one scene."""
    count, shape = size.split(":")
    width, height = (int(side) for side in shape.split("x"))
    gaussians, view = street(int(count), width, height, channels)
    generator = torch.Generator().manual_seed(1)
    upstream = [torch.randn(c, height, width, generator=generator) for c in (3, 1, 1, *([channels] if channels else []))]
    variants = instruction_sets()
    times: dict[str, list[float]] = {name: [] for name in variants}
    phases: dict[str, list[dict[str, float]]] = {name: [] for name in variants}
    for turn in range(repeats + 1):  # the first turn warms up
        for name in variants:
            native.set_isa(name)
            started = clock()
            once(gaussians, view, RasterConfig(backend="cpu"), upstream)
            if turn:
                times[name].append(1e3 * (clock() - started))
                phases[name].append(raster_cpu.last_statistics())
    native.set_isa("")
    rows: list[dict[str, Any]] = []
    best = statistics.median(times[variants[0]])
    for name in variants:
        middle = statistics.median(times[name])
        shares = {p: round(1e3 * statistics.median(run[p] for run in phases[name]), 2) for p in raster_cpu.PHASES}
        rows.append({"scene": size, "variant": name, "ms": round(middle, 1), "ratio": round(middle / best, 2), "phases_ms": shares})
    if with_torch:
        started = clock()
        once(gaussians, view, RasterConfig(backend="torch"), upstream)
        taken = 1e3 * (clock() - started)
        rows.append({"scene": size, "variant": "torch", "ms": round(taken, 1), "ratio": round(taken / best, 2), "phases_ms": {}})
    return rows


def say(line: str) -> None:
    """One line of the result, at once."""
    sys.stdout.write(line + "\n")
    sys.stdout.flush()


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--sizes", nargs="+", default=DEFAULT_SIZES, help="COUNT:WIDTHxHEIGHT")
    parser.add_argument("--channels", type=int, default=8, help="feature channels besides RGB and depth")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--repeats", type=int, default=9)
    parser.add_argument("--torch", action="store_true", help="time the plain torch backend, too (slow)")
    parser.add_argument("--json", type=Path, help="write the rows to this file")
    options = parser.parse_args()
    native.require("this benchmark")
    native.set_threads(options.threads)
    torch.set_num_threads(options.threads)
    clock = time.process_time if options.threads == 1 else time.perf_counter
    say(native.status())
    say(f"forward + backward, {4 + options.channels} channels, {options.threads} thread(s), median of {options.repeats}, ms")
    table = []
    for size in options.sizes:
        for row in measure(size, options.channels, options.repeats, options.torch, clock):
            table.append(row)
            shares = "  ".join(f"{name} {value}" for name, value in row["phases_ms"].items())
            say(f"{row['scene']:>16}  {row['variant']:<9}{row['ms']:>9}  x{row['ratio']:<6} {shares}")
    if options.json:
        options.json.write_text(json.dumps(table, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
