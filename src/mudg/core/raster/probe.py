"""How fast this machine is at the moment: a fraction of a second of the work that fits consist of."""

from __future__ import annotations

import time
from dataclasses import replace
from typing import Final, NamedTuple

import numpy as np
import torch

from mudg.base import seeds
from mudg.base.types import Camera, Gaussians, View
from mudg.core.raster.rasterize import RasterConfig, rasterize

GAUSSIANS, WIDTH, HEIGHT = 20_000, 240, 160
REFERENCE_S: Final = 0.0108
"""Seconds of one pass, forward and backward, on one undisturbed core of the machine on which `steps/cost.py`
was measured."""


def scene() -> tuple[Gaussians, View]:
    """Made-up surfaces in front of a camera; always the same."""
    rng = seeds.numpy_rng(0, 0, "speed of the machine")
    z = np.exp(rng.uniform(np.log(3.0), np.log(80.0), GAUSSIANS))
    means = np.stack([rng.uniform(-0.6, 0.6, GAUSSIANS) * z, rng.uniform(-0.4, 0.4, GAUSSIANS) * z, z], 1)
    scales = z[:, None] * np.exp(rng.uniform(np.log(0.002), np.log(0.01), (GAUSSIANS, 3)))
    f32 = lambda values: torch.from_numpy(np.asarray(values, np.float32))  # noqa: E731
    quats = torch.zeros(GAUSSIANS, 4)
    quats[:, 0] = 1
    gaussians = Gaussians(
        means=f32(means),
        quats=quats,
        scales=f32(scales),
        opacity=f32(rng.uniform(0.3, 0.95, GAUSSIANS)),
        sh=f32(rng.normal(0, 0.5, (GAUSSIANS, 1, 3))),
        extra=f32(rng.normal(0, 1, (GAUSSIANS, 8))),
        node=torch.zeros(GAUSSIANS, dtype=torch.int32),
    )
    return gaussians, View(Camera("probe", WIDTH, HEIGHT, 200.0, 200.0, WIDTH / 2, HEIGHT / 2), np.eye(4), 0.0)


class Speed(NamedTuple):
    """Speed of a core as a share of the reference's: undisturbed, and with what other programs leave of it now."""

    now: float
    idle: float


def speed(passes: int = 12) -> Speed:
    """Measure the speed of a core of this machine, by the processor time of one thread: other programs at work hardly
    change that."""
    gaussians, view = scene()
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        one_pass(gaussians, view)
        began_s, began_processor_s = time.perf_counter(), time.process_time()
        for _ in range(passes):
            one_pass(gaussians, view)
        processor_s, seconds = time.process_time() - began_processor_s, time.perf_counter() - began_s
    finally:
        torch.set_num_threads(before)
    return Speed(REFERENCE_S * passes / max(seconds, processor_s), REFERENCE_S * passes / processor_s)


def one_pass(gaussians: Gaussians, view: View) -> None:
    """Draw and differentiate, on the CPU."""
    means = gaussians.means.clone().requires_grad_(True)
    colors = gaussians.sh.clone().requires_grad_(True)
    drawn = rasterize(replace(gaussians, means=means, sh=colors), view, RasterConfig(backend="auto"))
    (drawn.rgb.square().mean() + drawn.depth.mean()).backward()
