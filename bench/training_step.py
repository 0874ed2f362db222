"""Times whole training steps of a Gaussian scene with the product's own functions, and says where the time goes.

    python bench/training_step.py --threads 2            # 50,000 Gaussians, 480x320, 12 channels

A step renders a view, forms the L1 + SSIM and LiDAR depth losses (with --class-loss also the semantic one), goes backward,
updates the visible rows with Adam and gathers densification statistics, as `stages/fit.py` does; densification runs every 100
steps, its share is amortised. Wall time; "rasteriser" is what the library's own clock counts in its six phases (processor time
if --threads is 1). torch's own loops get --torch-threads: they are short, and on a busy machine a second thread costs more than
it brings.
"""

from __future__ import annotations

import argparse
import statistics
import sys
import time
from contextlib import contextmanager
from typing import TYPE_CHECKING

import torch
from raster import street

from mudg import native
from mudg.base.types import Render
from mudg.core import losses, native_ops
from mudg.core.raster import cpu as raster_cpu
from mudg.core.raster.rasterize import RasterConfig, rasterize
from mudg.core.table import Table
from mudg.models.scene.densify import DensifySettings, DensifyStats, densify
from mudg.models.scene.model import SceneModel, compose, composite_semantics
from mudg.models.scene.nodes import StaticNode

if TYPE_CHECKING:
    from collections.abc import Iterator

    from torch import Tensor

    from mudg.base.types import View

DENSIFY_EVERY = 100
RATES = {"means": 1.6e-4, "quats": 1e-3, "log_scales": 5e-3, "logits": 5e-2, "sh_dc": 2.5e-3, "sh_rest": 1.25e-4, "semantics": 1e-2}


class Clock:
    """Seconds per part of the present step."""

    def __init__(self) -> None:
        self.parts: dict[str, float] = {}

    @contextmanager
    def part(self, name: str) -> Iterator[None]:
        """Adds the time of the block to a part."""
        began = time.perf_counter()
        yield
        self.parts[name] = self.parts.get(name, 0.0) + time.perf_counter() - began


def model_of(count: int, width: int, height: int, channels: int) -> tuple[SceneModel, View]:
    """The street of the rasteriser's benchmark as a model of one static node."""
    g, view = street(count, width, height, channels)
    if g.extra is None:
        raise ValueError("the training step needs class channels")
    columns = {
        "means": g.means, "quats": g.quats, "log_scales": g.scales.detach().log(), "logits": torch.logit(g.opacity.detach()),
        "sh_dc": g.sh.detach()[:, :1], "sh_rest": g.sh.detach()[:, 1:], "semantics": g.extra,
    }  # fmt: skip
    table = Table({name: value.detach() for name, value in columns.items()}, {"node": torch.zeros(count, dtype=torch.int32)})
    return SceneModel(table, (StaticNode(),), None, tuple(range(channels)), 3), view


class Target:
    """What the model is fitted to: a picture, its classes, and LiDAR depth at one pixel in twenty."""

    def __init__(self, model: SceneModel, view: View) -> None:
        with torch.no_grad():
            truth = rasterize(compose(model, 0.0), view)
        generator = torch.Generator().manual_seed(0)
        self.rgb = (truth.rgb + 0.05 * torch.randn(truth.rgb.shape, generator=generator)).clamp(0, 1)
        self.classes = truth.extra.argmax(0)  # type: ignore[union-attr]  # the model has classes
        pixels = truth.depth.numel()
        self.pixel = torch.randperm(pixels, generator=generator)[: pixels // 20]
        self.depth_m = truth.depth.flatten()[self.pixel].clamp_min(1.0)

    def loss(self, model: SceneModel, render: Render, classes: bool) -> Tensor:
        """Weighted sum of the terms."""
        terms = [
            native_ops.photometric(render.rgb, self.rgb),
            0.1 * losses.sparse_depth(render.depth, self.pixel, self.depth_m),
        ]
        if classes and render.extra is not None:
            terms.append(0.1 * losses.semantic_map(composite_semantics(model, render.extra, render.alpha), self.classes).mean())
        return torch.stack(terms).sum()


def one_step(model: SceneModel, view: View, target: Target, stats: DensifyStats, step: int, classes: bool, clock: Clock) -> None:
    """One training step; densification is the caller's."""
    with clock.part("compose"):
        gaussians = compose(model, 0.0)
    with clock.part("rasterize"):
        render = rasterize(gaussians, view, RasterConfig(backend="cpu"), absgrad=True)
    with clock.part("losses"):
        loss = target.loss(model, render, classes)
    with clock.part("backward"):
        loss.backward()
    with clock.part("adam"):
        model.table.adam_step(step, RATES, native_ops.adam_columns, render.trace.visible)
        model.table.clear_gradients()
    with clock.part("statistics"):
        stats.observe(render.trace, view.camera.width, view.camera.height)


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--gaussians", type=int, default=50_000)
    parser.add_argument("--size", default="480x320")
    parser.add_argument("--channels", type=int, default=8, help="class channels besides RGB and depth")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--steps", type=int, default=40)
    parser.add_argument("--torch-threads", type=int, default=1)
    parser.add_argument("--class-loss", action="store_true", help="learn classes, too (the product does at every third step)")
    options = parser.parse_args()
    native.require("this benchmark")
    native.set_threads(options.threads)
    torch.set_num_threads(options.torch_threads)
    width, height = (int(side) for side in options.size.split("x"))
    model, view = model_of(options.gaussians, width, height, options.channels)
    target, stats = Target(model, view), DensifyStats.zeros(options.gaussians)
    total, inside, parts = [], [], []
    for step in range(1, options.steps + 4):
        clock = Clock()
        began = time.perf_counter()
        one_step(model, view, target, stats, step, options.class_loss, clock)
        taken = time.perf_counter() - began
        if step > 3:
            total.append(taken)
            phases = raster_cpu.last_statistics()
            inside.append(sum(phases[name] for name in raster_cpu.PHASES))
            parts.append(clock.parts)
    settings = DensifySettings(start=1, stop=10**9, every=DENSIFY_EVERY, max_rows=options.gaussians + options.gaussians // 20)
    began = time.perf_counter()
    report = densify(model, stats, DENSIFY_EVERY, settings, 0)
    amortised = (time.perf_counter() - began) / DENSIFY_EVERY
    step_s, raster_s = statistics.fmean(total) + amortised, statistics.fmean(inside)
    lines = [
        native.status(),
        f"{options.gaussians} Gaussians, {options.size}, {4 + options.channels} channels, {options.threads} threads, densify {report}",
        f"{1 / step_s:.1f} it/s (mean step {1e3 * step_s:.1f} ms, median {1e3 * statistics.median(total):.1f} ms)",
        f"rasteriser {1e3 * raster_s:.1f} ms = {raster_s / step_s:.0%}, outside it {1 - raster_s / step_s:.0%}",
        *(f"  {name:<11}{1e3 * statistics.fmean(p[name] for p in parts):7.2f} ms" for name in parts[0]),
        f"  {'densify':<11}{1e3 * amortised:7.2f} ms (amortised over {DENSIFY_EVERY} steps)",
        "  (rasterize and backward contain the rasteriser's phases)",
    ]
    sys.stdout.write("\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
