"""Times the rasteriser: forward + backward to all parameters on street-like scenes, per backend variant and phase.

    python bench/raster.py                              # one thread, every instruction set this processor has
    python bench/raster.py --threads 2 --sizes 50000:480x320 --torch
    python bench/raster.py --sizes 50000:480x320 --roofline
    python bench/raster.py --check                      # against bench/raster_ratios.json, exit code 1 on a regression
    python bench/raster.py --first-call                 # import and first picture, in a fresh process

Variants are interleaved within one run, so that a busy machine hits all of them alike. With one thread the processor
time of this process is measured (it does not count what others take), else wall time; the library's own clock, which
times the phases, does the same. Medians; milliseconds.
"""

from __future__ import annotations

import argparse
import ctypes
import json
import statistics
import subprocess
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
from mudg.core.raster import cpu as raster_cpu
from mudg.core.raster.rasterize import RasterConfig, rasterize

RATIOS = Path(__file__).with_name("raster_ratios.json")
CHECK_SIZES = ("20000:480x320", "100000:480x320")
DEFAULT_SIZES = ("10000:480x320", "50000:480x320", "200000:480x320", "50000:960x640", "200000:960x640")


def street(count: int, width: int, height: int, channels: int, seed: int = 0) -> tuple[Gaussians, View]:
    """Ground, house fronts, cars, trees and a far backdrop; sizes follow the spacing, opacities look trained. SH degree
    3."""
    rng = np.random.default_rng(seed)

    def spread(low: float, high: float, n: int) -> np.ndarray:
        return np.exp(rng.uniform(np.log(low), np.log(high), n))

    ground, front, car, tree = (int(share * count) for share in (0.35, 0.33, 0.15, 0.12))
    sky = count - ground - front - car - tree
    z = spread(2.5, 90, ground)
    parts = [
        np.stack(
            [rng.uniform(-1, 1, ground) * np.minimum(14, 4 + 0.9 * z), 1.6 + 0.03 * rng.standard_normal(ground), z], 1
        )
    ]
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


def measure(
    size: str, channels: int, repeats: int, with_torch: bool, clock: Callable[[], float]
) -> list[dict[str, Any]]:
    """Rows of the table for one scene."""
    count, shape = size.split(":")
    width, height = (int(side) for side in shape.split("x"))
    gaussians, view = street(int(count), width, height, channels)
    generator = torch.Generator().manual_seed(1)
    upstream = [
        torch.randn(c, height, width, generator=generator) for c in (3, 1, 1, *([channels] if channels else []))
    ]
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
        counts = {k: int(phases[name][-1][k]) for k in ("visible", "entries", "pairs", "context_bytes")}
        rows.append(
            {
                "scene": size,
                "variant": name,
                "ms": round(middle, 1),
                "ratio": round(middle / best, 2),
                "phases_ms": shares,
                "counts": counts,
            }
        )
    if with_torch:
        started = clock()
        once(gaussians, view, RasterConfig(backend="torch"), upstream)
        taken = 1e3 * (clock() - started)
        rows.append(
            {
                "scene": size,
                "variant": "torch",
                "ms": round(taken, 1),
                "ratio": round(taken / best, 2),
                "phases_ms": {},
                "counts": {},
            }
        )
    return rows


def scaling(size: str, channels: int, repeats: int) -> tuple[float, float]:
    """Milliseconds with one and with two threads, wall time, in turn; medians."""
    count, shape = size.split(":")
    width, height = (int(side) for side in shape.split("x"))
    gaussians, view = street(int(count), width, height, channels)
    upstream = [torch.ones(c, height, width) for c in (3, 1, 1, *([channels] if channels else []))]
    times: dict[int, list[float]] = {1: [], 2: []}
    for turn in range(repeats + 1):
        for threads, taken in times.items():
            native.set_threads(threads)
            started = time.perf_counter()
            once(gaussians, view, RasterConfig(backend="cpu"), upstream)
            if turn:
                taken.append(1e3 * (time.perf_counter() - started))
    return statistics.median(times[1]), statistics.median(times[2])


def say(line: str) -> None:
    """One line of the result, at once."""
    sys.stdout.write(line + "\n")
    sys.stdout.flush()


# ---- roofline ------------------------------------------------------------------------------------


def peak_flops(rounds: int = 20_000_000) -> float:
    """Multiply-adds in registers on one thread, operations per second of processor time."""
    library = native.require("measuring the peak")
    library.mudg_peak_multiply_add.restype = ctypes.c_double
    sink = ctypes.c_float(0.999)
    best = 0.0
    for _ in range(3):
        started = time.process_time()
        operations = library.mudg_peak_multiply_add(ctypes.c_int64(rounds), ctypes.byref(sink))
        best = max(best, operations / (time.process_time() - started))
    return best


def bandwidth(megabytes: int = 256) -> float:
    """Bytes per second, read plus written, of copying an array that fits into no cache of one core."""
    source = np.ones(megabytes << 18, np.float32)
    target = np.zeros_like(source)
    best = 0.0
    for _ in range(5):
        started = time.process_time()
        np.copyto(target, source)
        best = max(best, 2 * source.nbytes / (time.process_time() - started))
    return best


def roofline(row: dict[str, Any], size: str, channels: int, flops: float, bytes_per_s: float) -> list[str]:
    """What each phase does, counted by hand per blended (Gaussian, 4x4 block) pair or per Gaussian, beside what it
    took."""
    count, width, height = int(size.split(":")[0]), *(int(side) for side in size.split(":")[1].split("x"))
    pairs, entries, visible = (row["counts"][name] for name in ("pairs", "entries", "visible"))
    planes, pixel_bytes = 4 + channels, 4 * width * height
    row_bytes, record_bytes = 4 * (8 + planes), 4 * (8 + planes)
    gaussian_bytes = 4 * (3 + 4 + 3 + 1)
    # Per pixel of a block: alpha 24; blending 5 and 2 per channel; backward 18 and 4 per channel, moments 8.
    work = {
        "project": (count * 330 + visible * 96, count * gaussian_bytes + visible * (192 + row_bytes) + 8 * entries),
        "blend": (16 * pairs * (24 + 5 + 2 * planes), entries * (12 + row_bytes) + (planes + 1) * pixel_bytes),
        "blend_backward": (
            16 * pairs * (24 + 18 + 4 * planes + 8),
            entries * (12 + row_bytes + record_bytes) + (planes + 1) * pixel_bytes,
        ),
        "project_backward": (
            visible * 900 + entries * 40,
            entries * record_bytes + visible * (2 * 192 + row_bytes) + 2 * count * gaussian_bytes + 192 * count,
        ),
    }
    lines = []
    for name, (operations, moved) in work.items():
        bound = 1e3 * max(operations / flops, moved / bytes_per_s)
        which = "arithmetic" if operations / flops > moved / bytes_per_s else "memory"
        taken = row["phases_ms"][name]
        lines.append(
            f"  {name:<17}{1e-9 * operations:7.2f} Gflop {1e-6 * moved:7.1f} MB  bound {bound:6.2f} ms ({which}), "
            f"took {taken:6.2f} ms = {bound / taken:4.0%} of the roofline"
        )
    return lines


# ---- regression check ----------------------------------------------------------------------------


def check(rows: list[dict[str, Any]]) -> list[str]:
    """Where the rows left the committed ratios; empty if nowhere."""
    stored, problems = json.loads(RATIOS.read_text(encoding="utf-8")), []
    for row in rows:
        wanted = stored["scenes"].get(row["scene"], {}).get(row["variant"])
        if wanted is None:
            continue
        where = f"{row['scene']} {row['variant']}"
        if row["ratio"] > wanted["ratio"] * (1 + stored["ratio_tolerance"]):
            problems.append(f"{where}: {row['ratio']} times the best variant, stored {wanted['ratio']}")
        total = sum(row["phases_ms"].values())
        for phase, share in wanted["shares"].items():
            now = row["phases_ms"][phase] / total
            if now > share + stored["share_tolerance"]:
                problems.append(f"{where}: {phase} takes {now:.0%} of the time, stored {share:.0%}")
    return problems


def store_ratios(rows: list[dict[str, Any]]) -> None:
    """Writes the ratios of this run as the ones to compare with."""
    scenes: dict[str, Any] = {}
    for row in rows:
        total = sum(row["phases_ms"].values())
        shares = {name: round(value / total, 3) for name, value in row["phases_ms"].items()}
        scenes.setdefault(row["scene"], {})[row["variant"]] = {"ratio": row["ratio"], "shares": shares}
    RATIOS.write_text(
        json.dumps({"ratio_tolerance": 0.25, "share_tolerance": 0.1, "scenes": scenes}, indent=1) + "\n",
        encoding="utf-8",
    )


FIRST_CALL = """
import time
began = time.perf_counter()
import torch
torch_s = time.perf_counter() - began
began = time.perf_counter()
import numpy as np
from mudg.base.types import Camera, Gaussians, View
from mudg.core.raster import RasterConfig, rasterize
n = 50000
g = Gaussians(torch.rand(n, 3) + torch.tensor([-0.5, -0.5, 3.0]), torch.rand(n, 4),
              torch.full((n, 3), 0.01), torch.full((n,), 0.5), torch.zeros(n, 16, 3), None,
              torch.zeros(n, dtype=torch.int32))
rasterize(g, View(Camera("front", 480, 320, 400.0, 400.0, 240.0, 160.0), np.eye(4), 0.0))
first_s = time.perf_counter() - began
print(f"import torch {torch_s:.2f} s; import of the rasteriser and the first picture {first_s:.2f} s")
"""


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--sizes", nargs="+", default=DEFAULT_SIZES, help="COUNT:WIDTHxHEIGHT")
    parser.add_argument("--channels", type=int, default=8, help="feature channels besides RGB and depth")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--repeats", type=int, default=9)
    parser.add_argument("--torch", action="store_true", help="time the plain torch backend, too (slow)")
    parser.add_argument("--roofline", action="store_true", help="compare the best variant with this processor's limits")
    parser.add_argument("--check", action="store_true", help="compare ratios with raster_ratios.json")
    parser.add_argument("--store", action="store_true", help="write raster_ratios.json from this run")
    parser.add_argument("--scaling", action="store_true", help="one against two threads, in turn, nothing else")
    parser.add_argument("--first-call", action="store_true", help="time import and first picture, nothing else")
    parser.add_argument("--json", type=Path, help="write the rows to this file")
    options = parser.parse_args()
    native.require("this benchmark")
    if options.first_call:
        say(
            subprocess.run(
                [sys.executable, "-c", FIRST_CALL], capture_output=True, text=True, check=True
            ).stdout.strip()
        )
        return
    if options.scaling:
        torch.set_num_threads(1)
        for size in options.sizes:
            one, two = scaling(size, options.channels, options.repeats)
            say(f"{size:>16}  1 thread {one:7.1f} ms  2 threads {two:7.1f} ms  {one / two:.2f} times as fast")
        return
    if options.check or options.store:
        options.sizes = CHECK_SIZES
    native.set_threads(options.threads)
    torch.set_num_threads(options.threads)
    clock = time.process_time if options.threads == 1 else time.perf_counter
    say(native.status())
    say(
        f"forward + backward, {4 + options.channels} channels, {options.threads} thread(s), median of"
        f" {options.repeats}, ms"
    )
    table = []
    flops, bytes_per_s = (peak_flops(), bandwidth()) if options.roofline else (0.0, 0.0)
    if options.roofline:
        say(f"one core: {1e-9 * flops:.0f} Gflop/s multiply-add, {1e-9 * bytes_per_s:.1f} GB/s copy (read + write)")
    for size in options.sizes:
        for row in measure(size, options.channels, options.repeats, options.torch, clock):
            table.append(row)
            shares = "  ".join(f"{name} {value}" for name, value in row["phases_ms"].items())
            say(f"{row['scene']:>16}  {row['variant']:<9}{row['ms']:>9}  x{row['ratio']:<6} {shares}")
        if options.roofline:
            best = next(row for row in table if row["scene"] == size)
            say(f"  {best['counts']}")
            for line in roofline(best, size, options.channels, flops, bytes_per_s):
                say(line)
    if options.store:
        store_ratios(table)
    if options.check:
        problems = check(table)
        for problem in problems:
            say(f"REGRESSION {problem}")
        say("ratios hold" if not problems else f"{len(problems)} regressions")
        sys.exit(1 if problems else 0)
    if options.json:
        options.json.write_text(json.dumps(table, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
