"""Seconds of the small diffusion model: one network pass, one decoding, one whole clip of eight frames, on one thread.

OMP_NUM_THREADS=1 python bench/mdm.py [--model embedded] [--steps 2] [--profile]
"""

from __future__ import annotations

import argparse
import resource
import time
from collections.abc import Callable

import numpy as np
import torch

from mudg.base.types import Camera, Condition, View
from mudg.diffusion import model_files
from mudg.diffusion.requests import SampleRequest


def seconds(work: Callable[[], object], repeats: int = 3) -> float:
    """Least processor seconds of a few calls, after one to warm up."""
    work()
    best = float("inf")
    for _ in range(repeats):
        start = time.process_time()
        work()
        best = min(best, time.process_time() - start)
    return best


def made_up_condition(frames: int, height: int, width: int) -> Condition:
    """A random condition; only its size matters here."""
    generator = torch.Generator().manual_seed(0)
    camera = Camera("front", width, height, float(width), float(width), width / 2, height / 2)
    views = tuple(View(camera, np.eye(4), 0.1 * t) for t in range(frames))
    rgb = torch.rand(frames, 3, height, width, generator=generator)
    depth = 3 + 60 * torch.rand(frames, 1, height, width, generator=generator)
    seen = torch.rand(frames, 1, height, width, generator=generator) > 0.4
    return Condition(views, rgb, depth, seen, rgb[0], seen, rgb)


def main() -> None:
    """Print a small table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--model", default="embedded")
    parser.add_argument("--steps", type=int, default=2)
    parser.add_argument("--profile", action="store_true", help="also where the time of a clip goes (bfloat16)")
    options = parser.parse_args()
    torch.set_num_threads(1)
    model = model_files.load(options.model)
    height = (
        max(1, round((model.config.area_px / 1.5) ** 0.5 / model.config.pixel_multiple)) * model.config.pixel_multiple
    )
    width = model.config.area_px // height
    condition = made_up_condition(model.config.window, height, width)
    latents = model.sample(condition, SampleRequest(1)).latents
    encoded = model.encode_condition(condition)
    print(  # noqa: T201
        f"{sum(p.numel() for p in model.parameters()) / 1e6:.1f} M parameters, {model.config.window} frames of"
        f" {width}x{height}"
    )
    for bf16 in (False, True):
        with torch.no_grad(), torch.autocast("cpu", torch.bfloat16, enabled=bf16):
            if model.refiner is None:
                decode = seconds(lambda: model.codec.decode(latents))
            else:
                decode = seconds(lambda: model.refine(latents, encoded.pixels, model.config.window))
        one = seconds(lambda bf16=bf16: model.sample(condition, SampleRequest(1, bf16=bf16)))
        more = seconds(lambda bf16=bf16: model.sample(condition, SampleRequest(options.steps, bf16=bf16)))
        pass_s = (more - one) / max(1, options.steps - 1)
        name = "bfloat16" if bf16 else "float32"
        print(  # noqa: T201
            f"{name:9s} pass {pass_s:.3f} s  decoding {decode:.3f} s  clip of {options.steps} steps {more:.2f} s (CPU)"
        )
    if options.profile:
        with torch.profiler.profile(activities=[torch.profiler.ProfilerActivity.CPU]) as profile:
            model.sample(condition, SampleRequest(options.steps, bf16=True))
        rows = profile.key_averages().table(sort_by="self_cpu_time_total", row_limit=12, max_name_column_width=40)
        print(rows)  # noqa: T201
    peak_gb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
    print(f"largest memory of this process {peak_gb:.2f} GB")  # noqa: T201


if __name__ == "__main__":
    main()
