"""The image-token resampler: from all tokens of the image tower to 16 tokens for each of 16 frames.

Learned queries read from the image's tokens and from each other, layer by layer (Perceiver: Jaegle et al.; its use in video:
Alayrac et al., "Flamingo"). Queries belong to frames, so the number of frames is part of the weights.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from mudg.models.published.clip import attend


@dataclass(frozen=True)
class ResamplerConfig:
    """Sizes; the defaults are the published ones (48,787,456 parameters)."""

    width: int = 1024
    layers: int = 4
    head_width: int = 64
    heads: int = 12
    tokens: int = 16
    """Tokens per frame."""
    frames: int = 16
    image_width: int = 1280
    context_width: int = 1024
    feed_factor: int = 4


class ReadingAttention(nn.Module):
    """Attention of the queries over image tokens and queries together."""

    def __init__(self, config: ResamplerConfig) -> None:
        super().__init__()
        inner = config.heads * config.head_width
        self.heads = config.heads
        self.norm_image, self.norm_queries = nn.LayerNorm(config.width), nn.LayerNorm(config.width)
        self.query = nn.Linear(config.width, inner, bias=False)
        self.key_value = nn.Linear(config.width, 2 * inner, bias=False)
        self.out = nn.Linear(inner, config.width, bias=False)

    def forward(self, image: Tensor, queries: Tensor) -> Tensor:
        """`image` [B,M,C], `queries` [B,N,C] -> [B,N,C]."""
        image, queries = self.norm_image(image), self.norm_queries(queries)
        key, value = self.key_value(torch.cat([image, queries], 1)).chunk(2, -1)
        return self.out(attend(self.query(queries), key, value, self.heads))


class ResamplerLayer(nn.Module):
    """Attention and a feed-forward part, each around a residual."""

    def __init__(self, config: ResamplerConfig) -> None:
        super().__init__()
        hidden = config.feed_factor * config.width
        self.attention = ReadingAttention(config)
        self.feed = nn.Sequential(
            nn.LayerNorm(config.width), nn.Linear(config.width, hidden, bias=False), nn.GELU(),
            nn.Linear(hidden, config.width, bias=False),
        )  # fmt: skip

    def forward(self, image: Tensor, queries: Tensor) -> Tensor:
        queries = queries + self.attention(image, queries)
        return queries + self.feed(queries)


class Resampler(nn.Module):
    """The resampler (see the module text)."""

    def __init__(self, config: ResamplerConfig) -> None:
        super().__init__()
        self.config = config
        self.queries = nn.Parameter(torch.zeros(1, config.frames * config.tokens, config.width))
        self.enter = nn.Linear(config.image_width, config.width)
        self.layers = nn.ModuleList(ResamplerLayer(config) for _ in range(config.layers))
        self.leave = nn.Linear(config.width, config.context_width)
        self.norm = nn.LayerNorm(config.context_width)

    def forward(self, features: Tensor) -> Tensor:
        """Features of the image tower [B,257,image_width] -> image tokens [B,frames,tokens,context_width]."""
        image = self.enter(features)
        queries = self.queries.expand(len(features), -1, -1)
        for layer in self.layers:
            queries = layer(image, queries)
        return self.norm(self.leave(queries)).unflatten(1, (self.config.frames, self.config.tokens))
