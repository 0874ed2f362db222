"""What an effect vector (`base.effects`) changes in the small model: parameters of their own beside those of the denoiser and the refiner.

The vector becomes features without any bias, so that a vector of zeros gives zeros. They move the denoiser's time embedding, and behind
every block of denoiser and refiner a layer of low rank, gated by them, adds to what the block states. All of it adds exactly nothing where
the vector is zero, and at the start of training everywhere.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from torch import Tensor, nn
from torch.nn import functional

from mudg.base.effects import EFFECTS
from mudg.models.mdm.codec import ChannelNorm

FEATURES = 64
"""Features that the vector becomes."""
GAIN = 8.0
"""Factor of the features: without it those of fresh weights are small, and the gates hardly open."""


class EffectLayer(nn.Module):
    """Adds to a map what the effect makes of it: norm - conv of `rank` channels - SiLU - gate of the effect - 1x1 conv; and a constant."""

    def __init__(self, inside: int, outside: int, rank: int) -> None:
        super().__init__()
        self.norm = ChannelNorm(inside, elementwise_affine=False)
        self.down = nn.Conv2d(inside, rank, 3, padding=1, bias=False)
        self.shift = nn.Linear(FEATURES, rank, bias=False)
        self.gate = nn.Linear(FEATURES, rank, bias=False)
        self.up = nn.Conv2d(rank, outside, 1, bias=False)
        self.move = nn.Linear(FEATURES, outside, bias=False)

    def forward(self, x: Tensor, features: Tensor) -> Tensor:
        """`x` [N,inside,h,w], `features` [N,FEATURES] -> [N,outside,h,w]."""
        plane = lambda values: values[:, :, None, None]  # noqa: E731
        inner = functional.silu(self.down(self.norm(x)) + plane(self.shift(features)))
        return self.up(inner * plane(self.gate(features))) + plane(self.move(features))


@dataclass(frozen=True, eq=False)
class Tuning:
    """The layers of one network for the effects of a batch: features [N,FEATURES], N = clips times frames."""

    layers: nn.ModuleList
    features: Tensor

    def steps(self) -> Iterator[Tuned]:
        """One after another, in the order of the network's blocks."""
        return (Tuned(layer, self.features) for layer in self.layers)


@dataclass(frozen=True, eq=False)
class Tuned:
    """One layer with the features of a batch."""

    layer: nn.Module
    features: Tensor

    def of(self, x: Tensor) -> Tensor:
        """What the layer makes of a map."""
        return self.layer(x, self.features)


class Effects(nn.Module):
    """All parameters of the effects.

    Args:
        embed: width of the denoiser's time embedding. net, refine: inside and outside of the layers behind its blocks, and the refiner's.
        rank: channels of the layers.
    """

    def __init__(
        self, embed: int, net: Sequence[tuple[int, int]], refine: Sequence[tuple[int, int]], rank: int
    ) -> None:
        super().__init__()
        self.read = nn.Sequential(
            nn.Linear(len(EFFECTS), FEATURES, bias=False),
            nn.SiLU(),
            nn.Linear(FEATURES, FEATURES, bias=False),
            nn.SiLU(),
        )
        self.time = nn.Linear(FEATURES, embed, bias=False)
        self.net = nn.ModuleList(EffectLayer(*sides, rank) for sides in net)
        self.refine = nn.ModuleList(EffectLayer(*sides, rank) for sides in refine)
        self.reset()

    def reset(self) -> None:
        """Effects that change nothing, whatever the other weights are."""
        nn.init.zeros_(self.time.weight)
        for layer in (*self.net, *self.refine):
            nn.init.zeros_(layer.up.weight)  # type: ignore[union-attr,arg-type]
            nn.init.zeros_(layer.move.weight)  # type: ignore[union-attr,arg-type]

    def features(self, vector: Tensor) -> Tensor:
        """[B,8] -> [B,FEATURES]; zeros for zeros."""
        return GAIN * self.read(vector)
