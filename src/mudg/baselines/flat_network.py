"""Small fully connected networks whose numbers lie in one row, so that they are a column ``[1, P]`` of a ``Table``."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor


@dataclass(frozen=True)
class FlatNetwork:
    """Layers of these widths, from the input to the output, with ReLU between them.

    Args:
        widths: at least two. leading: also a ReLU before the first layer.
    """

    widths: tuple[int, ...]
    leading: bool = False

    @property
    def numbers(self) -> int:
        """Weights and biases in all."""
        return sum((before + 1) * after for before, after in zip(self.widths, self.widths[1:]))

    def start(self, generator: torch.Generator, silent: bool = True) -> Tensor:
        """Starting values ``[1, P]``: uniform for ReLU (He et al. 2015), biases 0; ``silent``: the last layer 0, so
        that the output is."""
        parts = []
        for place, (before, after) in enumerate(zip(self.widths, self.widths[1:])):
            last = silent and place == len(self.widths) - 2
            weights = (torch.rand(after * before, generator=generator) * 2 - 1) * math.sqrt(6 / before)
            parts += [weights * 0.0 if last else weights, torch.zeros(after)]
        return torch.cat(parts)[None]

    def __call__(self, flat: Tensor, values: Tensor) -> Tensor:
        """Output ``[n, last]`` for inputs ``[n, first]``."""
        found, offset = torch.relu(values) if self.leading else values, 0
        for place, (before, after) in enumerate(zip(self.widths, self.widths[1:])):
            weights = flat[0, offset : offset + before * after].view(after, before)
            bias = flat[0, offset + before * after : offset + (before + 1) * after]
            found = F.linear(torch.relu(found) if place else found, weights, bias)
            offset += (before + 1) * after
        return found


def waves(values: Tensor, octaves: int) -> Tensor:
    """Values ``[n, c]`` with sine and cosine of their 1, 2, 4, ... pi fold: ``[n, c (1 + 2 octaves)]``."""
    scaled = torch.cat([values * (math.pi * 2**octave) for octave in range(octaves)], 1)
    return torch.cat([values, torch.sin(scaled), torch.cos(scaled)], 1)
