"""From latents to pixels with the condition in view: the last, pixel-level part of the small diffusion model.

The latent code has a quarter of the image's places and loses texture, one axis of hue and whatever is one pixel wide; the
condition has all of it wherever something was seen. The refiner reads both and states, for every pixel, how much of the
condition's colour, depth and class to take over, what to add, and how wrong the colour will probably be. It runs once per
clip, after the last denoising step, and is trained together with the denoiser, on what the denoiser makes.

All maps are held at the latent resolution, the 2x2 pixels of a cell as channels (`functional.pixel_unshuffle`).
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn import functional

from mudg.models.mdm.codec import CLASSES, MODALITIES, ChannelNorm, DecoderBlock, Modality, PatchCodec

COPY_SCORE = 6.0
"""What a class given by the condition adds to its score when the gate is open."""


@dataclass(frozen=True)
class ConditionPixels:
    """The condition at pixel resolution: color, backdrop f32[N,3,H,W] in [-1,1]; depth_code f32[N,1,H,W]; valid, warped
    f32[N,1,H,W]; ids, backdrop_ids u8[N,1,H,W], 255 = unknown. N = clips times frames."""

    color: Tensor
    backdrop: Tensor
    depth_code: Tensor
    valid: Tensor
    warped: Tensor
    ids: Tensor
    backdrop_ids: Tensor

    def crop(self, rows: slice, columns: slice) -> ConditionPixels:
        """A rectangle of pixels."""
        return ConditionPixels(*(x[..., rows, columns] for x in self.parts()))

    def parts(self) -> tuple[Tensor, ...]:
        """All tensors in the order of the fields."""
        return (self.color, self.backdrop, self.depth_code, self.valid, self.warped, self.ids, self.backdrop_ids)


@dataclass(frozen=True)
class Refined:
    """Pixels: rgb f32[N,3,H,W] in [-1,1], depth code f32[N,1,H,W], class scores f32[N,19,H,W] (none of them clamped), and the
    expected absolute error of rgb as its logarithm f32[N,1,H,W]."""

    rgb: Tensor
    depth_code: Tensor
    scores: Tensor
    log_error: Tensor


def one_hot(ids: Tensor) -> Tensor:
    """u8[N,1,H,W] -> f32[N,19,H,W]; all zero where unknown."""
    places = torch.arange(CLASSES, dtype=torch.uint8, device=ids.device).view(1, -1, 1, 1)
    return (ids == places).float()


def shares(ids: Tensor) -> Tensor:
    """Share of each class among all 2x2 pixels of a cell, u8[N,1,H,W] -> f32[N,19,H/2,W/2]; unknown pixels count for none."""
    return functional.avg_pool2d(one_hot(ids), 2)


class Refiner(nn.Module):
    """See the module text. `widths`: channels at the latent resolution and at half of it; `blocks`: residual blocks there."""

    SIZES = (12, 4, 4, 4, 4, 4 * CLASSES, 4, 4, 4)
    """Outputs: colour to add, gates of the condition's colour and backdrop, depth to add, gate of depth, scores to add,
    gates of the condition's classes and the backdrop's, logarithm of the error."""
    STARTS = (0.0, -1.0, -4.0, 0.0, -1.0, 0.0, 0.0, -4.0, -2.5)
    """Their values before training."""

    def __init__(self, channels: int, widths: tuple[int, int], blocks: tuple[int, int]) -> None:
        super().__init__()
        fine, coarse = widths
        inside = channels + 12 + 4 + 12 + 12 + 4 + 4 + 4 + 2 * CLASSES
        self.enter = nn.Conv2d(inside, fine, 3, padding=1)
        self.before = nn.ModuleList(DecoderBlock(fine) for _ in range(blocks[0]))
        self.shrink = nn.Conv2d(fine, coarse, 2, stride=2)
        self.middle = nn.ModuleList(DecoderBlock(coarse) for _ in range(blocks[1]))
        self.grow = nn.Conv2d(coarse, 4 * fine, 1)
        self.join = nn.Conv2d(2 * fine, fine, 1)
        self.after = nn.ModuleList(DecoderBlock(fine) for _ in range(blocks[0]))
        self.norm = ChannelNorm(fine)
        self.leave = nn.Conv2d(fine, sum(self.SIZES), 1)
        self.reset()

    def take_back(self, class_weights: Tensor) -> None:
        """Undo what class weights f32[19] in the loss did to the scores: each class loses the logarithm of its weight."""
        first = sum(self.SIZES[:5])
        with torch.no_grad():
            self.leave.bias[first : first + 4 * CLASSES] -= class_weights.log().repeat_interleave(4)  # type: ignore[index]

    def reset(self) -> None:
        """Output that adds nothing and copies little, whatever the other weights are."""
        with torch.no_grad():
            self.leave.weight.zero_()
            parts = [torch.full((size,), start) for size, start in zip(self.SIZES, self.STARTS)]
            self.leave.bias.copy_(torch.cat(parts))  # type: ignore[union-attr]

    def forward(
        self, codec: PatchCodec, latents: dict[Modality, Tensor], given: ConditionPixels, frames: int
    ) -> Refined:
        """`latents` [N,C,h,w] of all modalities (N = clips times frames, frames innermost) -> pixels."""
        rgb, depth, scores = codec.decode_raw(latents)
        fold = lambda x: functional.pixel_unshuffle(x, 2)  # noqa: E731
        seen = [given.color, given.backdrop, given.depth_code, given.valid, given.warped]
        planes = [*(latents[m] for m in MODALITIES), fold(rgb), fold(depth), *(fold(x) for x in seen), shares(given.ids),
                  shares(given.backdrop_ids)]  # fmt: skip
        x = self.enter(torch.cat([p.to(rgb.dtype) for p in planes], 1).contiguous(memory_format=torch.channels_last))
        for block in self.before:
            x = block(x, frames)
        y = self.shrink(x)
        for block in self.middle:
            y = block(y, frames)
        y = functional.pixel_shuffle(self.grow(y), 2)
        x = self.join(torch.cat([x, y], 1).contiguous(memory_format=torch.channels_last))
        for block in self.after:
            x = block(x, frames)
        out = functional.pixel_shuffle(self.leave(functional.silu(self.norm(x))).float(), 2)
        more, take, take_far, deeper, take_depth, more_scores, take_ids, take_far_ids, log_error = out.split(
            [size // 4 for size in self.SIZES], 1
        )
        rgb = rgb + take.sigmoid() * (given.color - rgb)
        rgb = rgb + take_far.sigmoid() * (given.backdrop - rgb) + 0.2 * more
        depth = depth + take_depth.sigmoid() * (given.depth_code - depth) + 0.05 * deeper
        scores = scores + more_scores + COPY_SCORE * (
            take_ids.sigmoid() * one_hot(given.ids) + take_far_ids.sigmoid() * one_hot(given.backdrop_ids)
        )  # fmt: skip
        return Refined(rgb, depth, scores, log_error)


@dataclass(frozen=True)
class PixelTruth:
    """What the refiner should give: rgb f32[N,3,H,W] in [-1,1], depth code f32[N,1,H,W], ids i64[N,H,W] (255 = unlabelled);
    depth_known f32[N,1,H,W]: 1 where the depth is true, 0 where it only fills a gap."""

    rgb: Tensor
    depth_code: Tensor
    ids: Tensor
    depth_known: Tensor

    def crop(self, rows: slice, columns: slice) -> PixelTruth:
        """A rectangle of pixels."""
        return PixelTruth(*(x[..., rows, columns] for x in (self.rgb, self.depth_code, self.ids, self.depth_known)))
