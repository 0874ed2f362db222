"""The rasteriser of a card against the CPU's: images, gradients, and milliseconds of forward + backward.

    python bench/gpu/raster_parity.py --device cuda --out raster.json
    python bench/gpu/raster_parity.py --small --device cpu        # plain torch against the native kernel

Bars: PSNR of every image at least 60 dB, cosine of every gradient at least 0.9999. The exit code is 1 if one is missed.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Sequence
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import torch
from shared import device_of, finish, flags, generator_of, measured

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from raster import street  # the folder above is not a package

from mudg.base.types import Gaussians, Render, View
from mudg.core.raster.rasterize import RasterConfig, rasterize

PSNR_DB, COSINE = 60.0, 0.9999
LEAVES = ("means", "quats", "scales", "opacity", "sh", "extra")
PARITY, SPEED = ["20000:480x320"], ["200000:960x640", "1000000:1920x1280"]


def on(gaussians: Gaussians, device: torch.device) -> Gaussians:
    """A copy on a device, whose leaves collect gradients."""
    moved = {f.name: getattr(gaussians, f.name) for f in fields(gaussians)}
    moved = {
        name: value.detach().to(device) if isinstance(value, torch.Tensor) else value for name, value in moved.items()
    }
    return replace(
        gaussians, **{n: v.requires_grad_() if n in LEAVES and v is not None else v for n, v in moved.items()}
    )


def images_of(render: Render) -> dict[str, torch.Tensor]:
    """The images of a render that have gradients."""
    found = {"rgb": render.rgb, "depth": render.depth, "alpha": render.alpha, "extra": render.extra}
    return {name: image for name, image in found.items() if image is not None}


def drawn(gaussians: Gaussians, view: View, backend: str, upstream: dict[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    """Forward and backward: images, and gradients as `d name`, on the CPU. Gradients are cleared."""
    images = images_of(rasterize(gaussians, view, RasterConfig(backend=backend)))  # one of BACKENDS
    torch.autograd.backward(list(images.values()), [upstream[name].to(image.device) for name, image in images.items()])
    gradients = {f"d {n}": leaf.grad for n in LEAVES if (leaf := getattr(gaussians, n)) is not None}
    for name in LEAVES:
        if (leaf := getattr(gaussians, name)) is not None:
            leaf.grad = None
    return {name: value.detach().cpu() for name, value in {**images, **gradients}.items() if value is not None}


def scene_of(size: str, channels: int) -> tuple[Gaussians, View, dict[str, torch.Tensor]]:
    """A street with COUNT Gaussians at WIDTHxHEIGHT, and gradients of its images."""
    count, shape = size.split(":")
    width, height = map(int, shape.split("x"))
    gaussians, view = street(int(count), width, height, channels)
    generator = generator_of("upstream", torch.device("cpu"))
    sizes = {"rgb": 3, "depth": 1, "alpha": 1, "extra": channels}
    return gaussians, view, {name: torch.randn(c, height, width, generator=generator) for name, c in sizes.items() if c}


def compared(size: str, channels: int, device: torch.device, backend: str) -> list[dict[str, Any]]:
    """A row per image and per gradient."""
    gaussians, view, upstream = scene_of(size, channels)
    ours = drawn(on(gaussians, torch.device("cpu")), view, "cpu", upstream)
    theirs = drawn(on(gaussians, device), view, backend, upstream)
    rows = []
    for name, mine in ours.items():
        other = theirs[name]
        if name.startswith("d "):
            cosine = float(torch.nn.functional.cosine_similarity(mine.flatten().double(), other.flatten().double(), 0))
            rows.append({"what": name, "scene": size, "cosine": cosine, "holds": cosine >= COSINE})
        else:
            error = float(((mine - other) / mine.abs().max().clamp_min(1e-9)).double().square().mean())
            psnr_db = -10 * math.log10(max(error, 1e-20))
            rows.append({"what": name, "scene": size, "psnr_db": psnr_db, "holds": psnr_db >= PSNR_DB})
    return rows


def main(words: Sequence[str] | None = None) -> dict[str, Any]:
    """Read the flags, compare, measure, print."""
    parser = flags(__doc__)
    parser.add_argument("--parity", nargs="+", default=PARITY, metavar="COUNT:WxH")
    parser.add_argument("--speed", nargs="+", default=SPEED, metavar="COUNT:WxH")
    parser.add_argument("--channels", type=int, default=8)
    options = parser.parse_args(words)
    if options.small:
        options.parity, options.speed, options.channels = ["200:48x32"], ["200:48x32"], 2
    device = device_of(options)
    backend = "gsplat" if device.type == "cuda" else "torch"
    rows = [row for size in options.parity for row in compared(size, options.channels, device, backend)]
    for size in options.speed:
        gaussians, view, upstream = scene_of(size, options.channels)
        moved, there = on(gaussians, device), {name: value.to(device) for name, value in upstream.items()}

        def once(moved: Gaussians = moved, view: View = view, there: dict[str, torch.Tensor] = there) -> None:
            images = images_of(rasterize(moved, view, RasterConfig(backend=backend)))
            torch.autograd.backward(list(images.values()), [there[name] for name in images])

        rows.append(
            {"what": "forward + backward", "scene": size, "backend": backend, **measured(once, device, options.repeats)}
        )
    return finish(options, device, rows)


if __name__ == "__main__":
    sys.exit(0 if all(row.get("holds", True) for row in main()["rows"]) else 1)
