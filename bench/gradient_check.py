"""Prints how far the native float32 rasteriser is from the float64 reference, output by output and gradient by
gradient.

    python bench/gradient_check.py

A pixel on the very edge of the alpha cut or of the stopping rule may fall to either side in float32. Such pixels
(outputs off by more than 1e-5 of the largest value) are the boundary band: their share is printed, and they are left
out of the rest.
"""

from __future__ import annotations

import argparse
import sys

import torch
from raster import instruction_sets, street
from torch import Tensor

from mudg import native
from mudg.base.types import Gaussians
from mudg.core.raster.rasterize import RasterConfig, rasterize

IMAGES = ("rgb", "depth", "alpha", "extra")
GROUPS = ("means", "quats", "scales", "opacity", "sh", "extra")


def compare(count: int, width: int, height: int, antialias: bool) -> tuple[float, dict[str, float]]:
    """Share of the boundary band, and for every output the largest relative, for every gradient the relative L2
    error."""
    scene, view = street(count, width, height, 8)
    pose = torch.tensor(view.world_from_cam)
    outputs, leaves, poses = [], [], []
    for backend, dtype in (("cpu", torch.float32), ("torch", torch.float64)):
        parts = {name: getattr(scene, name).detach().to(dtype).requires_grad_() for name in GROUPS}
        own_pose = pose.to(dtype).requires_grad_()
        config = RasterConfig(backend=backend, antialias=antialias)
        outputs.append(
            rasterize(Gaussians(**parts, node=scene.node), view, config, world_from_cam=own_pose, absgrad=True)
        )
        leaves.append(parts)
        poses.append(own_pose)
    mine, exact = outputs
    errors = {}
    for name in IMAGES:
        truth: Tensor = getattr(exact, name).detach()
        errors[name] = ((getattr(mine, name).detach() - truth).abs() / truth.abs().max()).amax(0)
    band = torch.stack(list(errors.values())).amax(0) > 1e-5
    generator = torch.Generator().manual_seed(0)
    weights = {name: torch.randn(getattr(mine, name).shape, generator=generator) * ~band for name in IMAGES}
    for out in outputs:
        torch.stack(
            [(getattr(out, name) * weight.to(out.rgb)).sum() for name, weight in weights.items()]
        ).sum().backward()
    report = {name: float(error[~band].max()) for name, error in errors.items()}
    pairs = {f"d {name}": (leaves[0][name].grad, leaves[1][name].grad) for name in GROUPS}
    pairs["d pose"] = (poses[0].grad, poses[1].grad)
    pairs["d means2d"] = (mine.trace.means2d.grad, exact.trace.means2d.grad)
    pairs["|d means2d|"] = (mine.trace.abs_grad2d, exact.trace.abs_grad2d)
    for name, (got, want) in pairs.items():
        report[name] = float((got.double() - want).norm() / want.norm())
    return float(band.double().mean()), report


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--gaussians", type=int, default=3000)
    parser.add_argument("--size", default="96x64")
    options = parser.parse_args()
    native.require("this check")
    width, height = (int(side) for side in options.size.split("x"))
    for antialias in (False, True):
        columns = {}
        for name in instruction_sets():
            native.set_isa(name)
            band, columns[name] = compare(options.gaussians, width, height, antialias)
            sys.stdout.write(f"{name}, antialias {antialias}: boundary band {band:.3%} of {options.size} pixels\n")
        native.set_isa("")
        rows = [f"| quantity | {' | '.join(columns)} |", f"|---|{'---|' * len(columns)}"]
        rows += [
            f"| {key} | {' | '.join(f'{column[key]:.1e}' for column in columns.values())} |"
            for key in next(iter(columns.values()))
        ]
        sys.stdout.write("\n".join(rows) + "\n")


if __name__ == "__main__":
    main()
