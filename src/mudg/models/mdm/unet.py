"""The denoising network of the small models: a U of residual blocks with attention over the cells of a patched latent video.

`UNet` is put together at the end; `Stage` is one block with the attentions of its level. Frames of a clip are told apart by a
free temporal shift of channels in every block, keys and values from frame 0, and temporal attention at the lowest level.
"""

from __future__ import annotations

import math
from typing import Protocol

import torch
from torch import Tensor, nn
from torch.nn import functional

from mudg.models.mdm.codec import ChannelNorm, temporal_shift


class UNetShape(Protocol):
    """What the network reads of a model's configuration (see `MDMConfig`)."""

    patch: int
    widths: tuple[int, ...]
    blocks: tuple[int, ...]
    spatial_attention: tuple[bool, ...]
    temporal_attention: tuple[bool, ...]
    head_width: int
    embed_width: int


def sinusoid(t: Tensor, width: int) -> Tensor:
    """[cos, sin] features f32[N,width] of `t` [N], frequencies 10000^(-i / (width/2))."""
    half = width // 2
    frequencies = torch.exp(-math.log(10000.0) * torch.arange(half, device=t.device) / half)
    angles = t.float()[:, None] * frequencies
    return torch.cat([angles.cos(), angles.sin()], 1)


def attend(q: Tensor, k: Tensor, v: Tensor) -> Tensor:
    """Softmax attention of `q` [..,N,C] over `k`, `v` [..,M,C] -> [..,N,C].

    In training as two matrix products (on CPUs the backward pass of the fused kernel costs several times more at these
    sizes), otherwise through the fused kernel, which never stores the N x M scores.
    """
    if torch.is_grad_enabled():
        scores = (q * q.shape[-1] ** -0.5) @ k.transpose(-1, -2)
        return scores.softmax(-1).to(v.dtype) @ v
    return functional.scaled_dot_product_attention(q, k, v)


class ResBlock(nn.Module):
    """norm - temporal shift - conv - norm scaled and moved by the embedding - SiLU - conv, around a residual."""

    def __init__(self, inside: int, outside: int, embed: int) -> None:
        super().__init__()
        self.norm1 = ChannelNorm(inside)
        self.conv1 = nn.Conv2d(inside, outside, 3, padding=1)
        self.norm2 = ChannelNorm(outside, elementwise_affine=False)
        self.modulate = nn.Linear(embed, 2 * outside)
        self.conv2 = nn.Conv2d(outside, outside, 3, padding=1)
        self.skip = nn.Conv2d(inside, outside, 1) if inside != outside else nn.Identity()
        nn.init.zeros_(self.conv2.weight)
        nn.init.zeros_(self.conv2.bias)  # type: ignore[arg-type]

    def forward(self, x: Tensor, embedding: Tensor, frames: int) -> Tensor:
        """`x` [B*T,inside,h,w], `embedding` [B*T,embed] -> [B*T,outside,h,w]."""
        scale, move = self.modulate(embedding)[:, :, None, None].chunk(2, 1)
        h = self.conv1(temporal_shift(self.norm1(x), frames))
        h = functional.silu(torch.addcmul(move, self.norm2(h), 1 + scale))
        return self.skip(x) + self.conv2(h)


class SpatialAttention(nn.Module):
    """Self-attention over the cells of a frame; keys and values also come from frame 0 of the clip."""

    def __init__(self, width: int, head_width: int) -> None:
        super().__init__()
        self.heads = width // head_width
        self.norm = nn.LayerNorm(width)
        self.query = nn.Linear(width, width)
        self.key_value = nn.Linear(width, 2 * width)
        self.out = nn.Linear(width, width)
        nn.init.zeros_(self.out.weight)
        nn.init.zeros_(self.out.bias)

    def forward(self, x: Tensor, frames: int) -> Tensor:
        """[B*T,C,h,w] -> the same."""
        n, c, height, width = x.shape
        tokens = x.permute(0, 2, 3, 1).reshape(n, height * width, c)
        normed = self.norm(tokens)
        key_value = self.key_value(normed)
        if frames > 1:
            per_clip = key_value.unflatten(0, (n // frames, frames))
            first = per_clip[:, :1].expand(-1, frames, -1, -1)
            key_value = torch.cat([per_clip, first], 2).flatten(0, 1)
        key, value = key_value.chunk(2, -1)
        q, k, v = (y.unflatten(-1, (self.heads, -1)).transpose(1, 2) for y in (self.query(normed), key, value))
        mixed = attend(q, k, v).transpose(1, 2).flatten(2)
        return (tokens + self.out(mixed)).reshape(n, height, width, c).permute(0, 3, 1, 2)


class TemporalAttention(nn.Module):
    """Self-attention over the frames of a clip at each cell."""

    def __init__(self, width: int, head_width: int) -> None:
        super().__init__()
        self.heads = width // head_width
        self.norm = nn.LayerNorm(width)
        self.mix = nn.Linear(width, 3 * width)
        self.out = nn.Linear(width, width)
        nn.init.zeros_(self.out.weight)
        nn.init.zeros_(self.out.bias)

    def forward(self, x: Tensor, frames: int) -> Tensor:
        """[B*T,C,h,w] -> the same."""
        n, c, height, width = x.shape
        y = x.permute(0, 2, 3, 1).reshape(n // frames, frames, height * width, c).transpose(1, 2)
        place = sinusoid(torch.arange(frames, device=x.device), c).to(y.dtype)
        q, k, v = self.mix(self.norm(y) + place).unflatten(-1, (3, self.heads, -1)).movedim(-3, 0)
        q, k, v = (z.transpose(-3, -2).flatten(0, 1) for z in (q, k, v))
        mixed = attend(q, k, v)
        mixed = mixed.unflatten(0, y.shape[:2]).transpose(-3, -2).flatten(-2)
        y = (y + self.out(mixed)).transpose(1, 2).reshape(n, height, width, c)
        return y.permute(0, 3, 1, 2)


class Stage(nn.Module):
    """One residual block and the attentions that its level has."""

    def __init__(self, inside: int, outside: int, config: UNetShape, level: int) -> None:
        super().__init__()
        self.block = ResBlock(inside, outside, config.embed_width)
        spatial, temporal = config.spatial_attention[level], config.temporal_attention[level]
        self.spatial = SpatialAttention(outside, config.head_width) if spatial else None
        self.temporal = TemporalAttention(outside, config.head_width) if temporal else None

    def forward(self, x: Tensor, embedding: Tensor, frames: int) -> Tensor:
        """`x` [B*T,inside,h,w], `embedding` [B*T,embed] -> [B*T,outside,h,w]."""
        x = self.block(x, embedding, frames)
        if self.spatial is not None:
            x = self.spatial(x, frames)
        if self.temporal is not None:
            x = self.temporal(x, frames)
        return x


class UNet(nn.Module):
    """The denoising network of the small models: a U of `Stage`s over the cells of a patched latent video."""

    def __init__(self, config: UNetShape, planes_in: int, planes_out: int) -> None:
        super().__init__()
        widths, embed, area = config.widths, config.embed_width, config.patch**2
        self.patch = config.patch
        self.time = nn.Sequential(nn.Linear(64, embed), nn.SiLU(), nn.Linear(embed, embed))
        self.label = nn.Sequential(nn.Linear(64, embed), nn.SiLU(), nn.Linear(embed, embed))  # of label 0: all modalities at once
        self.enter = nn.Conv2d(planes_in * area, widths[0], 1)
        width, skips = widths[0], [widths[0]]
        self.down, self.shrink = nn.ModuleList(), nn.ModuleList()
        for level, outside in enumerate(widths):
            stages = nn.ModuleList()
            for _ in range(config.blocks[level]):
                stages.append(Stage(width, outside, config, level))
                width = outside
                skips.append(width)
            self.down.append(stages)
            if level + 1 < len(widths):
                self.shrink.append(nn.Conv2d(width, widths[level + 1], 2, stride=2))
                width = widths[level + 1]
                skips.append(width)
        self.middle = Stage(width, width, config, len(widths) - 1)
        self.up, self.grow = nn.ModuleList(), nn.ModuleList()
        for level in reversed(range(len(widths))):
            stages = nn.ModuleList()
            for _ in range(config.blocks[level] + 1):
                stages.append(Stage(width + skips.pop(), widths[level], config, level))
                width = widths[level]
            self.up.append(stages)
            if level:
                self.grow.append(nn.Conv2d(width, 4 * widths[level - 1], 1))
                width = widths[level - 1]
        self.norm = ChannelNorm(width)
        self.leave = nn.Conv2d(width, planes_out * area, 1)
        nn.init.zeros_(self.leave.weight)
        nn.init.zeros_(self.leave.bias)  # type: ignore[arg-type]

    def forward(self, x: Tensor, t: Tensor) -> Tensor:
        """`x` [B,T,planes_in,h,w], `t` i64[B] -> f32 [B,T,planes_out,h,w]."""
        batch, frames = x.shape[:2]
        embedding = self.time(sinusoid(t, 64)) + self.label(sinusoid(torch.zeros_like(t), 64))
        embedding = functional.silu(embedding).repeat_interleave(frames, 0)
        h = functional.pixel_unshuffle(x.flatten(0, 1), self.patch)
        h = self.enter(h.contiguous(memory_format=torch.channels_last))
        skips = [h]
        for level, stages in enumerate(self.down):
            for stage in stages:
                h = stage(h, embedding, frames)
                skips.append(h)
            if level < len(self.shrink):
                h = self.shrink[level](h)
                skips.append(h)
        h = self.middle(h, embedding, frames)
        for index, stages in enumerate(self.up):
            for stage in stages:
                h = stage(torch.cat([h, skips.pop()], 1), embedding, frames)
            if index < len(self.grow):
                h = functional.pixel_shuffle(self.grow[index](h), 2).contiguous(memory_format=torch.channels_last)
        h = self.leave(functional.silu(self.norm(h)))
        return functional.pixel_shuffle(h.float(), self.patch).unflatten(0, (batch, frames))
