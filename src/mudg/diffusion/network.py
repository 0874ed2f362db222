"""The networks of the small models: the denoiser `UNet`, the `Refiner` from latents to pixels, the `Finisher` to the
camera's size. `MDMConfig` is all that distinguishes one model from another.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from functools import partial
from typing import Self

import torch
from torch import Tensor, nn
from torch.nn import functional

from mudg.base import palette
from mudg.base.errors import UsageError
from mudg.base.types import Clip, Condition, RenderPlanes
from mudg.core.noise import ScheduleConfig
from mudg.networks.codec import (
    CLASSES,
    MODALITIES,
    ChannelNorm,
    CodecConfig,
    DecoderBlock,
    Modality,
    PatchCodec,
    temporal_shift,
)

COPY_SCORE = 6.0
"""What a class given by the condition adds to its score when the gate is open."""


@dataclass(frozen=True, kw_only=True)
class MDMConfig:
    """Everything that fixes a model's function except its weights. What `LearnConfig` states has its default there
    alone."""

    codec: CodecConfig = CodecConfig()
    schedule: ScheduleConfig = ScheduleConfig()
    patch: int
    """Latent cells per side of one network cell."""
    widths: tuple[int, ...]
    blocks: tuple[int, ...]
    spatial_attention: tuple[bool, ...]
    temporal_attention: tuple[bool, ...]
    head_width: int = 32
    embed_width: int = 192
    refine_widths: tuple[int, ...]
    """Channels of the refiner (see `Refiner`) at the latent resolution and at half of it; empty = no refiner."""
    refine_blocks: tuple[int, ...]
    window: int
    """Frames per clip the model was made for; other numbers work, only this one is tested."""
    area_px: int
    """Pixels per frame that the model was trained at."""
    shared_noise: float = 0.3
    """Share of the noise variance common to all frames, in training and sampling."""
    renders: bool = False
    """Whether the condition may hold renders of a fitted scene."""
    finish_widths: tuple[int, ...] = ()
    """Channels of the finisher at half and at a quarter of the camera's resolution; empty = no finisher."""
    finish_blocks: tuple[int, ...] = ()

    def __post_init__(self) -> None:
        levels = {len(self.widths), len(self.blocks), len(self.spatial_attention), len(self.temporal_attention)}
        if len(levels) != 1:
            what = "widths, blocks and attention switches must have one entry per level"
            raise UsageError(what, got=f"{sorted(levels)}")
        attended = zip(self.widths, self.spatial_attention, self.temporal_attention)
        if any((spatial or temporal) and width % self.head_width for width, spatial, temporal in attended):
            raise UsageError("a width is no multiple of the attention head width", got=f"{self.widths}")
        for name in ("refine", "finish"):
            widths, blocks = getattr(self, f"{name}_widths"), getattr(self, f"{name}_blocks")
            if (len(widths), len(blocks)) not in ((0, 0), (2, 2)):
                raise UsageError(f"{name}_widths and {name}_blocks have two entries each, or none", got=str(widths))
        if self.finish_widths and not (self.refine_widths and self.renders):
            raise UsageError(
                "a finisher needs a refiner before it, and renders", got=f"renders {self.renders}, {self.refine_widths}"
            )

    @property
    def pixel_multiple(self) -> int:
        """Image sides must be multiples of this many pixels."""
        return 2 * self.patch * 2 ** (len(self.widths) - 1)


# denoiser -----------------------------------------------------------------------------------------


def sinusoid(t: Tensor, width: int) -> Tensor:
    """[cos, sin] features f32[N,width] of `t` [N], frequencies 10000^(-i / (width/2))."""
    half = width // 2
    frequencies = torch.exp(-math.log(10000.0) * torch.arange(half, device=t.device) / half)
    angles = t.float()[:, None] * frequencies
    return torch.cat([angles.cos(), angles.sin()], 1)


def attend(q: Tensor, k: Tensor, v: Tensor) -> Tensor:
    """Softmax attention of `q` [..,N,C] over `k`, `v` [..,M,C] -> [..,N,C]. In training as two matrix products (on CPUs
    the backward pass of the fused kernel costs several times more at these sizes), otherwise through the fused kernel,
    which never stores the N x M scores."""
    if torch.is_grad_enabled():
        scores = (q * q.shape[-1] ** -0.5) @ k.transpose(-1, -2)
        return scores.softmax(-1).to(v.dtype) @ v
    return functional.scaled_dot_product_attention(q, k, v)


class UNetBlock(nn.Module):
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
        nn.init.zeros_(self.conv2.bias)

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


class UNetStage(nn.Module):
    """One residual block and the attentions that its level has."""

    def __init__(self, inside: int, outside: int, config: MDMConfig, level: int) -> None:
        super().__init__()
        self.block = UNetBlock(inside, outside, config.embed_width)
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
    """The denoising network of the small models: a U of `UNetStage`s over the cells of a patched latent video."""

    def __init__(self, config: MDMConfig, planes_in: int, planes_out: int) -> None:
        super().__init__()
        widths, embed, area = config.widths, config.embed_width, config.patch**2
        self.patch = config.patch
        self.time = nn.Sequential(nn.Linear(64, embed), nn.SiLU(), nn.Linear(embed, embed))
        # of label 0: all modalities at once
        self.label = nn.Sequential(nn.Linear(64, embed), nn.SiLU(), nn.Linear(embed, embed))
        self.enter = nn.Conv2d(planes_in * area, widths[0], 1)
        width, skips = widths[0], [widths[0]]
        self.down, self.shrink = nn.ModuleList(), nn.ModuleList()
        for level, outside in enumerate(widths):
            stages = nn.ModuleList()
            for _ in range(config.blocks[level]):
                stages.append(UNetStage(width, outside, config, level))
                width = outside
                skips.append(width)
            self.down.append(stages)
            if level + 1 < len(widths):
                self.shrink.append(nn.Conv2d(width, widths[level + 1], 2, stride=2))
                width = widths[level + 1]
                skips.append(width)
        self.middle = UNetStage(width, width, config, len(widths) - 1)
        self.up, self.grow = nn.ModuleList(), nn.ModuleList()
        for level in reversed(range(len(widths))):
            stages = nn.ModuleList()
            for _ in range(config.blocks[level] + 1):
                stages.append(UNetStage(width + skips.pop(), widths[level], config, level))
                width = widths[level]
            self.up.append(stages)
            if level:
                self.grow.append(nn.Conv2d(width, 4 * widths[level - 1], 1))
                width = widths[level - 1]
        self.norm = ChannelNorm(width)
        self.leave = nn.Conv2d(width, planes_out * area, 1)
        nn.init.zeros_(self.leave.weight)
        nn.init.zeros_(self.leave.bias)

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


# refiner ------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class PixelPlanes:
    """Tensors of the same pixels."""

    def map(self, change: Callable[[Tensor], Tensor]) -> Self:
        """The same with ``change`` applied to every tensor."""
        planes = (getattr(self, f.name) for f in fields(self))
        return type(self)(*(None if x is None else change(x) for x in planes))

    def crop(self, rows: slice, columns: slice) -> Self:
        """A rectangle of pixels."""
        return self.map(lambda x: x[..., rows, columns])


NO_RENDER = -1.0
"""Coverage that stands for: there is no render."""


@dataclass(frozen=True)
class Stacked:
    """The tensors of conditions of one shape [B,T,..]; what a condition lacks is filled in: none warped, its own colour
    as backdrop, unknown classes, no render. Masks are f32."""

    color: Tensor
    depth: Tensor
    valid: Tensor
    warped: Tensor
    backdrop: Tensor
    ids: Tensor
    backdrop_ids: Tensor
    renders: RenderPlanes

    @classmethod
    def of(cls, batch: Sequence[Condition]) -> Stacked:
        """Of conditions of one shape."""
        unknown = torch.full_like(batch[0].valid, palette.UNLABELLED, dtype=torch.uint8)
        nothing = torch.zeros_like(batch[0].depth)
        no_render = lambda c: RenderPlanes(c.color, c.depth, nothing + NO_RENDER, nothing, unknown)
        renders = [no_render(c) if c.renders is None else c.renders for c in batch]
        return cls(
            *(torch.stack([getattr(c, name) for c in batch]) for name in ("color", "depth")),
            torch.stack([c.valid for c in batch]).float(),
            torch.stack([torch.zeros_like(c.valid) if c.warped is None else c.warped for c in batch]).float(),
            torch.stack([c.color if c.backdrop is None else c.backdrop for c in batch]),
            torch.stack([unknown if c.semantics is None else c.semantics for c in batch]),
            torch.stack([unknown if c.backdrop_semantics is None else c.backdrop_semantics for c in batch]),
            RenderPlanes(*(torch.stack([getattr(r, f.name) for r in renders]) for f in fields(RenderPlanes))),
        )


@dataclass(frozen=True)
class ConditionPixels(PixelPlanes):
    """The condition at pixel resolution: color, backdrop f32[N,3,H,W] in [-1,1]; depth_code f32[N,1,H,W]; valid, warped
    f32[N,1,H,W]; ids, backdrop_ids u8[N,1,H,W], 255 = unknown. N = clips times frames. For models that use renders also
    render f32[N,3,H,W] in [-1,1], render_code f32[N,1,H,W] (depth), alpha, certainty f32[N,1,H,W] (alpha -1: no
    renders), render_ids u8[N,1,H,W]."""

    color: Tensor
    backdrop: Tensor
    depth_code: Tensor
    valid: Tensor
    warped: Tensor
    ids: Tensor
    backdrop_ids: Tensor
    render: Tensor | None = None
    render_code: Tensor | None = None
    alpha: Tensor | None = None
    certainty: Tensor | None = None
    render_ids: Tensor | None = None

    @classmethod
    def of(cls, given: Stacked, codec: PatchCodec, renders: bool) -> ConditionPixels:
        """What refiner and finisher see of a batch of conditions."""
        code, pixels = codec.linear_depth_code, [given.color * 2 - 1, given.backdrop * 2 - 1]
        pixels += [code(given.depth), given.valid, given.warped, given.ids, given.backdrop_ids]
        if renders:
            shown = given.renders
            pixels += [shown.color * 2 - 1, code(shown.depth), shown.alpha, shown.certainty, shown.semantics]
        return cls(*(x.flatten(0, 1) for x in pixels))


@dataclass(frozen=True)
class Refined:
    """Pixels: rgb f32[N,3,H,W] in [-1,1], depth code f32[N,1,H,W], class scores f32[N,19,H,W] (none of them clamped),
    and the expected absolute error of rgb as its logarithm f32[N,1,H,W]."""

    rgb: Tensor
    depth_code: Tensor
    scores: Tensor
    log_error: Tensor


def one_hot(ids: Tensor) -> Tensor:
    """u8[N,1,H,W] -> f32[N,19,H,W]; all zero where unknown."""
    places = torch.arange(CLASSES, dtype=torch.uint8, device=ids.device).view(1, -1, 1, 1)
    return (ids == places).float()


def shares(ids: Tensor) -> Tensor:
    """Share of each class among all 2x2 pixels of a cell, u8[N,1,H,W] -> f32[N,19,H/2,W/2]; unknown pixels count for
    none."""
    return functional.avg_pool2d(one_hot(ids), 2)


def joined(planes: list[Tensor], dtype: torch.dtype) -> Tensor:
    """Planes [N,C,h,w] in one tensor of a type. The list is emptied: they are large, and nothing else needs them."""
    whole = torch.cat([plane.to(dtype) for plane in planes], 1)
    planes.clear()
    return whole


class CellNet(nn.Module):
    """What refiner and finisher have in common: residual blocks on cells of 2x2 pixels, around others on cells of 4x4.
    inside, outside: channels that go in and come out, per cell of 2x2 pixels. widths: channels in the outer and the
    inner blocks; blocks: how many before and after, and within. reach: side of the first convolution, cells."""

    def __init__(self, inside: int, outside: int, widths: tuple[int, int], blocks: tuple[int, int], reach: int) -> None:
        super().__init__()
        fine, coarse = widths
        self.enter = nn.Conv2d(inside, fine, reach, padding=reach // 2)
        self.before = nn.ModuleList(DecoderBlock(fine) for _ in range(blocks[0]))
        self.shrink = nn.Conv2d(fine, coarse, 2, stride=2)
        self.middle = nn.ModuleList(DecoderBlock(coarse) for _ in range(blocks[1]))
        self.grow = nn.Conv2d(coarse, 4 * fine, 1)
        self.join = nn.Conv2d(2 * fine, fine, 1)
        self.after = nn.ModuleList(DecoderBlock(fine) for _ in range(blocks[0]))
        self.norm = ChannelNorm(fine)
        self.leave = nn.Conv2d(fine, outside, 1)

    def pixels(self, planes: Tensor, frames: int) -> Tensor:
        """[N,inside,h,w] -> f32[N,outside/4,2h,2w]; `frames` neighbouring ones belong together."""
        planes = planes.contiguous(memory_format=torch.channels_last)
        x = self.enter(planes)
        del planes  # they are large
        for block in self.before:
            x = block(x, frames)
        y = self.shrink(x)
        for block in self.middle:
            y = block(y, frames)
        y = functional.pixel_shuffle(self.grow(y), 2)
        x = self.join(torch.cat([x, y], 1).contiguous(memory_format=torch.channels_last))
        for block in self.after:
            x = block(x, frames)
        return functional.pixel_shuffle(self.leave(functional.silu(self.norm(x))).float(), 2)


class Refiner(CellNet):
    """From latents and condition to pixels, once per clip, after the last denoising step. The latent code has a quarter
    of the image's places and loses texture; the condition has all of it wherever something was seen. For every pixel
    this states how much of the condition's colour, depth and class to take over, what to add, and how wrong the colour
    will probably be. `widths`: channels at the latent resolution and at half of it; `blocks`: residual blocks there.
    With `renders` it also reads what a fitted scene shows."""

    SIZES = (12, 4, 4, 4, 4, 4 * CLASSES, 4, 4, 4)
    """Outputs: colour to add, gates of the condition's colour and backdrop, depth to add, gate of depth, scores to add,
    gates of the condition's classes and the backdrop's, logarithm of the error."""
    STARTS = (0.0, -1.0, -4.0, 0.0, -1.0, 0.0, 0.0, -4.0, -2.5)
    """Their values before training."""
    RENDER_SIZES, RENDER_STARTS = (4, 4, 4), (-4.0, -4.0, -4.0)
    """Further outputs with `renders`: gates of its colour, depth and classes."""
    RENDER_PLANES = 12 + 4 + 4 + 4 + CLASSES

    def __init__(self, channels: int, widths: tuple[int, int], blocks: tuple[int, int], renders: bool = False) -> None:
        sizes = self.SIZES + (self.RENDER_SIZES if renders else ())
        inside = channels + 12 + 4 + 12 + 12 + 4 + 4 + 4 + 2 * CLASSES + (self.RENDER_PLANES if renders else 0)
        super().__init__(inside, sum(sizes), widths, blocks, reach=3)
        self.renders, self.sizes = renders, sizes
        self.reset()

    def take_back(self, class_weights: Tensor) -> None:
        """Undo what class weights f32[19] in the loss did to the scores: each class loses the logarithm of its
        weight."""
        first = sum(self.SIZES[:5])
        with torch.no_grad():
            bias = self.leave.bias[first : first + 4 * CLASSES]
            bias -= class_weights.log().repeat_interleave(4).to(bias.device)

    def reset(self) -> None:
        """Output that adds nothing and copies little, whatever the other weights are."""
        with torch.no_grad():
            self.leave.weight.zero_()
            starts = self.STARTS + (self.RENDER_STARTS if self.renders else ())
            parts = [torch.full((size,), start) for size, start in zip(self.sizes, starts)]
            self.leave.bias.copy_(torch.cat(parts))

    def forward(
        self, codec: PatchCodec, latents: dict[Modality, Tensor], condition: ConditionPixels, frames: int
    ) -> Refined:
        """`latents` [N,C,h,w] of all modalities (N = clips times frames, frames innermost) -> pixels."""
        rgb, depth, scores = codec.decode_raw(latents)
        fold = lambda x: functional.pixel_unshuffle(x, 2)
        seen = [condition.color, condition.backdrop, condition.depth_code, condition.valid, condition.warped]
        planes = [*(latents[m] for m in MODALITIES), *map(fold, (rgb, depth, *seen))]
        planes += [shares(condition.ids), shares(condition.backdrop_ids)]
        if self.renders:
            planes += map(fold, (condition.render, condition.render_code, condition.alpha, condition.certainty))
            planes.append(shares(condition.render_ids))
        out = self.pixels(joined(planes, rgb.dtype), frames)
        parts = out.split([size // 4 for size in self.sizes], 1)
        more, take, take_far, deeper, take_depth, more_scores, take_ids, take_far_ids, log_error, *of_render = parts
        if self.renders:
            take_render, take_code, take_render_ids = (gate.sigmoid() for gate in of_render)
            rgb = rgb + take_render * (condition.render - rgb)
            depth = depth + take_code * condition.alpha.clamp(min=0) * (condition.render_code - depth)
            scores = scores + COPY_SCORE * take_render_ids * one_hot(condition.render_ids)
        rgb = rgb + take.sigmoid() * (condition.color - rgb)
        rgb = rgb + take_far.sigmoid() * (condition.backdrop - rgb) + 0.2 * more
        depth = depth + take_depth.sigmoid() * (condition.depth_code - depth) + 0.05 * deeper
        copied = take_ids.sigmoid() * one_hot(condition.ids) + take_far_ids.sigmoid() * one_hot(condition.backdrop_ids)
        return Refined(rgb, depth, scores + more_scores + COPY_SCORE * copied, log_error)


@dataclass(frozen=True)
class PixelTruth(PixelPlanes):
    """What the refiner should give: rgb f32[N,3,H,W] in [-1,1], depth code f32[N,1,H,W], ids i64[N,H,W] (255 =
    unlabelled); depth_known f32[N,1,H,W]: 1 where the depth is true, 0 where it only fills a gap."""

    rgb: Tensor
    depth_code: Tensor
    ids: Tensor
    depth_known: Tensor

    @classmethod
    def of(cls, clips: Sequence[Clip], codec: PatchCodec) -> PixelTruth:
        """For clips or patches of one size."""
        rgb, depth, weight, ids = (
            torch.cat([getattr(clip, name) for clip in clips]) for name in ("rgb", "depth", "depth_weight", "semantics")
        )
        return cls(rgb * 2 - 1, codec.linear_depth_code(depth), ids, weight)


# finisher -----------------------------------------------------------------------------------------


TILE_PX = 320
"""Longest side of a tile's core."""
STRIDE_PX = 4
"""Pixels per cell of the coarser level; borders of tiles are multiples of it."""
DETAIL_APART = 0.12
"""Difference of colour, of [-1, 1], from which on a warped image lends no detail."""
LEAST_SHARE = 1e-3
"""Share of the unlikeliest class, so that its logarithm is finite."""


@dataclass(frozen=True)
class Made(PixelPlanes):
    """A generated clip, or a finished one: rgb f32[N,3,H,W] in [-1,1], depth_code f32[N,1,H,W], ids u8[N,1,H,W],
    log_error f32[N,1,H,W]: logarithm of the expected absolute error of rgb."""

    rgb: Tensor
    depth_code: Tensor
    ids: Tensor
    log_error: Tensor

    def enlarged(self, size: tuple[int, int], rows: tuple[int, int], columns: tuple[int, int]) -> Made:
        """The clip enlarged to `size` (height, width), of that only the rectangle rows x columns, which may reach
        beyond its borders: colour and error bilinearly, depth and class from the nearest pixel."""
        y = (torch.arange(*rows, device=self.rgb.device) + 0.5) * (2.0 / size[0]) - 1.0
        x = (torch.arange(*columns, device=self.rgb.device) + 0.5) * (2.0 / size[1]) - 1.0
        grid = torch.stack(torch.meshgrid(x, y, indexing="xy"), -1).expand(len(self.rgb), -1, -1, -1)
        sampled = partial(functional.grid_sample, grid=grid, padding_mode="border", align_corners=False)
        smooth = sampled(torch.cat([self.rgb.float(), self.log_error.float()], 1), mode="bilinear")
        sharp = sampled(torch.cat([self.depth_code.float(), self.ids.float()], 1), mode="nearest")
        return Made(smooth[:, :3], sharp[:, :1], sharp[:, 1:].to(torch.uint8), smooth[:, 3:])


@dataclass(frozen=True)
class Finished:
    """As `Made`, with classes as sources u8[N,S,1,H,W] and how much each of them counts, weights f32[N,S,H,W], which
    sum to 1."""

    rgb: Tensor
    depth_code: Tensor
    sources: Tensor
    weights: Tensor
    log_error: Tensor

    def shares(self, frames: slice = slice(None)) -> Tensor:
        """Share of each class f32[N,19,H,W]; they sum to at most 1."""
        weights, sources = self.weights[frames], self.sources[frames]
        shares = weights[:, :1] * one_hot(sources[:, 0])
        for k in range(1, weights.shape[1]):
            shares = torch.addcmul(shares, weights[:, k : k + 1], one_hot(sources[:, k]))
        return shares

    def ids(self) -> Tensor:
        """The class with the largest share u8[N,1,H,W]; frame by frame, for the shares of all are large. (``max`` finds
        the first of several equal ones, as ``argmax`` does, in half of the time.)"""
        shares = (self.shares(slice(n, n + 1)) for n in range(len(self.weights)))
        return torch.cat([one.max(1, keepdim=True).indices.to(torch.uint8) for one in shares])


class Finisher(CellNet):
    """From an enlarged clip and the condition at the camera's size to a clip of that size. For every pixel it states
    how much to take of each source, what colour to add, and how wrong it will probably be. It is small, so that a
    full-size image costs about as much as the clip it comes from. `widths`: channels at half and at a quarter of the
    resolution; `blocks`: residual blocks there (`CellNet`)."""

    SOURCES = 4
    """Of colour: the enlarged clip, images warped in, the backdrop, the render. Of depth and class: the clip, the
    measured or warped, the backdrop's class (no depth), the render's."""
    SIZES = (4 * SOURCES, 4 * (SOURCES - 1), 4 * SOURCES, 12, 4)
    """Outputs: shares of the sources of colour, depth and class; colour to add; change of the logarithm of the
    error."""
    STARTS = (2.0, 0.0, -2.0, 0.0), (2.0, 0.0, -2.0), (2.0, 0.0, -2.0, 0.0)
    """Logits of the shares before training."""
    PLANES = 4 * (4 * 3 + 3 + 4 + 1) + 3 + 1
    """Inputs: four colours, three depths, four masks and the error, each as the four pixels of a cell; whether the
    other classes are that of the clip; the scale."""

    def __init__(self, widths: tuple[int, int], blocks: tuple[int, int]) -> None:
        super().__init__(self.PLANES, sum(self.SIZES), widths, blocks, reach=1)
        self.reset()

    @property
    def margin_px(self) -> int:
        """More than what a pixel of the result depends on at either side; a multiple of `STRIDE_PX`."""
        return 8 * (len(self.before) + len(self.middle)) + STRIDE_PX

    def reset(self) -> None:
        """Output that takes most of what was generated and adds nothing, whatever the other weights are."""
        starts = [torch.tensor(part).repeat_interleave(4) for part in self.STARTS]
        with torch.no_grad():
            self.leave.weight.zero_()
            self.leave.bias.copy_(torch.cat([*starts, torch.zeros(16)]))

    def forward(self, generated: Made, condition: ConditionPixels, frames: int, scale: Tensor) -> Finished:
        """Finish clips (N = clips times frames, frames innermost). generated: the generated clip, enlarged to the size
        of `condition`; sides are multiples of `STRIDE_PX`. scale: f32[N], how many times smaller the clip was."""
        colors = torch.stack([generated.rgb, condition.color, condition.backdrop, condition.render], 1)
        depths = torch.stack([generated.depth_code, condition.depth_code, condition.render_code], 1)
        ids = torch.stack([generated.ids, condition.ids, condition.backdrop_ids, condition.render_ids], 1)
        masks = [condition.valid, condition.warped, condition.alpha, condition.certainty]
        fold = lambda x: functional.pixel_unshuffle(x, 2)
        agree = (ids[:, 1:] == ids[:, :1]).float().flatten(1, 2)
        planes = [*map(fold, (colors.flatten(1, 2), depths.flatten(1, 2), *masks, generated.log_error))]
        planes.append(functional.avg_pool2d(agree, 2))
        planes.append(scale.log2().view(-1, 1, 1, 1).expand(-1, 1, *planes[0].shape[-2:]))
        out = self.pixels(joined(planes, colors.dtype), frames)
        of_color, of_depth, of_class, more, change = out.split([size // 4 for size in self.SIZES], 1)
        rgb = (of_color.softmax(1).unsqueeze(2) * colors).sum(1) + 0.2 * more
        depth = (of_depth.softmax(1).unsqueeze(2) * depths).sum(1)
        return Finished(rgb, depth, ids, of_class.softmax(1), generated.log_error + change)


def class_scores(finished: Finished) -> Tensor:
    """Logarithms of the class shares f32[N,19,H,W], for a cross-entropy."""
    return finished.shares().clamp(min=LEAST_SHARE).log()


def with_detail(rgb: Tensor, condition: ConditionPixels) -> Tensor:
    """Finished colours f32[N,3,H,W] in [-1,1] with the finest structure of the images warped in (the difference from
    the mean of 3x3 pixels) in place of their own, where the two agree but for that: the more, the better they agree.
    What is learned by squared error is blurred where it is unsure; a warped photograph is not."""
    coarse = lambda x: functional.avg_pool2d(functional.pad(x, (1, 1, 1, 1), mode="replicate"), 3, 1)
    mine, theirs = coarse(rgb), coarse(condition.color)
    apart = (mine - theirs).abs().amax(1, keepdim=True)
    weight = (1 - apart / DETAIL_APART).clamp(0, 1) * condition.warped
    return rgb + weight * ((condition.color - theirs) - (rgb - mine))


# tiles --------------------------------------------------------------------------------------------


def spans(length: int, longest: int = TILE_PX) -> list[tuple[int, int]]:
    """Cut 0..length into about equal pieces, none longer than `longest`, with borders at multiples of `STRIDE_PX`."""
    count = -(-length // max(longest, STRIDE_PX))
    borders = [round(number * length / count / STRIDE_PX) * STRIDE_PX for number in range(count)] + [length]
    return [(first, last) for first, last in zip(borders, borders[1:], strict=False) if first < last]


def finish_in_tiles(
    finisher: Finisher,
    generated: Made,
    size: Sequence[int],
    crop: Callable[[slice, slice], ConditionPixels],
    tile_px: int = TILE_PX,
    *,
    detail: bool = False,
) -> Made:
    """Finish one clip at any size. generated: the clip as generated, [N,..,h,w]. size: height and width that are
    wanted. crop: makes a rectangle, rows x columns, of the clip's condition at that size; asked tile by tile. tile_px:
    longest side of a tile's core; memory depends on it, the result does not. detail: colours get the finest structure
    of what was warped in (`with_detail`)."""
    frames, small, device = len(generated.rgb), generated.rgb.shape[-2:], generated.rgb.device
    scale = torch.full((frames,), (size[0] * size[1] / (small[0] * small[1])) ** 0.5, device=device)
    margin = finisher.margin_px
    empty = lambda c, kind=torch.float32: torch.empty(frames, c, *size, dtype=kind, device=device)
    whole = Made(empty(3), empty(1), empty(1, torch.uint8), empty(1))
    for top, bottom in spans(size[0], tile_px):
        for left, right in spans(size[1], tile_px):
            rows, columns = (
                (max(0, first - margin), min(length, last + margin))
                for first, last, length in ((top, bottom, size[0]), (left, right, size[1]))
            )
            bare = crop(slice(*rows), slice(*columns))
            wide = (0, -bare.color.shape[-1] % STRIDE_PX, 0, -bare.color.shape[-2] % STRIDE_PX)
            part = bare.map(lambda x, wide=wide: functional.pad(x.float(), wide, mode="replicate").to(x.dtype))
            reach = (rows[0], rows[0] + part.color.shape[-2]), (columns[0], columns[0] + part.color.shape[-1])
            found = finisher(generated.enlarged((size[0], size[1]), *reach), part, frames, scale)
            rgb = found.rgb[..., : rows[1] - rows[0], : columns[1] - columns[0]]
            rgb = with_detail(rgb, bare) if detail else rgb
            core = (..., slice(top - rows[0], bottom - rows[0]), slice(left - columns[0], right - columns[0]))
            target = (..., slice(top, bottom), slice(left, right))
            whole.rgb[target], whole.depth_code[target] = rgb[core], found.depth_code[core]
            whole.ids[target] = found.ids()[core]
            whole.log_error[target] = found.log_error[core]
    return whole
