"""Made-up weights under the names of FID's network, for tests: no published numbers, but every layer takes part."""

from __future__ import annotations

import math

import torch

from mudg.networks import inception


def state(seed: int = 0) -> dict[str, torch.Tensor]:
    """All 472 tensors; activations keep their size through the network."""
    generator = torch.Generator().manual_seed(seed)
    made = {}
    for name, shape in inception.tensor_shapes().items():
        noise = torch.randn(shape, generator=generator)
        if name.endswith("conv.weight"):
            noise *= math.sqrt(2 / math.prod(shape[1:]))
        elif name.endswith("running_var"):
            noise = 0.5 + 1.5 * torch.rand(shape, generator=generator)
        elif name.endswith("bn.weight"):
            noise = 1 + 0.1 * noise
        elif not name.startswith("fc"):
            noise *= 0.1
        made[name] = noise
    return made
