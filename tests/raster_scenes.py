"""Gaussians, cameras and comparisons for the tests of the rasterizers."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from mudg.base import geometry
from mudg.base.types import Camera, Gaussians, Render, View

GROUPS = ("means", "quats", "scales", "opacity", "sh", "extra")
IMAGES = ("rgb", "depth", "alpha", "extra")
Parameters = dict[str, Tensor]


def view_of(width: int = 50, height: int = 37) -> View:
    """A camera that is neither centred nor aligned with the world."""
    turn = geometry.matrix_from_quaternion([0.97, 0.05, -0.1, 0.08])
    pose = geometry.from_rotation_translation(turn, [0.3, -0.2, 0.1])
    return View(Camera("front", width, height, 0.9 * width, 0.93 * width, 0.53 * width, 0.47 * height), pose, 0.0)


def axis_view(width: int, height: int, focal: float = 20.0) -> View:
    """Looks along world z; the optical axis hits a pixel centre for odd sizes."""
    return View(Camera("front", width, height, focal, focal, width / 2, height / 2), np.eye(4), 0.0)


def cloud(
    count: int, seed: int = 0, degree: int = 3, channels: int = 5, dtype: torch.dtype = torch.float32
) -> Parameters:
    """A cloud in front of `view_of`, with large, small, flat, faint and nearly opaque Gaussians, some behind the
    camera, some beside the image."""
    rng = np.random.default_rng(seed)
    z = np.exp(rng.uniform(np.log(1.5), np.log(40), count)) * np.where(rng.random(count) < 0.08, -1, 1)
    xyz = np.stack([z * rng.uniform(-0.7, 0.7, count), z * rng.uniform(-0.6, 0.6, count), z], 1)
    scales = np.abs(z)[:, None] * np.exp(rng.uniform(np.log(0.004), np.log(0.12), (count, 3)))
    scales[::7, 0] *= 0.02
    values = {
        "means": xyz,
        "quats": rng.standard_normal((count, 4)),
        "scales": scales,
        "opacity": np.where(rng.random(count) < 0.4, rng.uniform(0.6, 0.998, count), rng.uniform(0.01, 0.5, count)),
        "sh": 0.3 * rng.standard_normal((count, (degree + 1) ** 2, 3)),
        "extra": rng.standard_normal((count, channels)),
    }
    return {name: torch.tensor(value, dtype=torch.float32).to(dtype) for name, value in values.items()}


def gaussians_of(p: Parameters) -> Gaussians:
    node = torch.zeros(len(p["means"]), dtype=torch.int32, device=p["means"].device)
    return Gaussians(**{"extra": None, **p}, node=node)


def leaves_of(p: Parameters, dtype: torch.dtype = torch.float32) -> Parameters:
    return {name: value.detach().to(dtype).clone().requires_grad_() for name, value in p.items()}


def weighted(out: Render, weights: dict[str, Tensor]) -> Tensor:
    return torch.stack([(getattr(out, name) * weight.to(out.rgb)).sum() for name, weight in weights.items()]).sum()


def outside_band(got: Render, want: Render, seed: int = 0) -> tuple[dict[str, Tensor], dict[str, float]]:
    """Random weights of all images, and the largest error of each over its largest value, without the band.

    A pixel on the very edge of the alpha cut or of the stopping rule may fall to either side: such pixels (the band)
    may be at most 0.5 % and are left out of the rest.
    """
    errors = {}
    for name in IMAGES:
        mine, exact = getattr(got, name).detach().double(), getattr(want, name).detach().double()
        errors[name] = ((mine - exact).abs() / exact.abs().max()).amax(0)
    band = torch.stack(list(errors.values())).amax(0) > 1e-5
    assert band.double().mean() < 0.005
    generator = torch.Generator().manual_seed(seed)
    weights = {n: torch.randn(getattr(got, n).shape, generator=generator) * ~band for n in IMAGES}
    return weights, {name: float(error[~band].max()) for name, error in errors.items()}
