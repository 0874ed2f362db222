"""The last stage of the small models: from what was generated to the camera's resolution.

The denoiser and the refiner work on some 25,000 pixels per frame; a camera has up to a hundred times as many. The
`Finisher` reads the enlarged clip and the condition at the new size: images warped in, measured depth, renders of a
fitted scene. For every pixel it states how much to take of each (colour, depth and class in the same way), what colour
to add, and how wrong the colour will probably be. It is small, so that a full-size image costs about as much as the
clip it comes from.

`finish_in_tiles` bounds the memory: every tile is computed with a margin that is wider than the receptive field, and
only its core is kept, so the result equals that of one pass over the whole image.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Protocol

import torch
from torch import Tensor
from torch.nn import functional

from mudg.diffusion.network import CellNet, ConditionPixels, joined, one_hot

TILE_PX = 320
"""Longest side of a tile's core."""
STRIDE_PX = 4
"""Pixels per cell of the coarser level; borders of tiles are multiples of it."""
DETAIL_APART = 0.12
"""Difference of colour, of [-1, 1], from which on a warped image lends no detail."""
LEAST_SHARE = 1e-3
"""Share of the unlikeliest class, so that its logarithm is finite."""


@dataclass(frozen=True)
class Made:
    """A generated clip, or a finished one: rgb f32[N,3,H,W] in [-1,1], depth_code f32[N,1,H,W], ids u8[N,1,H,W],
    log_error f32[N,1,H,W]: logarithm of the expected absolute error of rgb."""

    rgb: Tensor
    depth_code: Tensor
    ids: Tensor
    log_error: Tensor

    def crop(self, rows: slice, columns: slice) -> Made:
        """A rectangle of pixels."""
        return Made(*(getattr(self, f.name)[..., rows, columns] for f in fields(self)))

    def enlarged(self, size: tuple[int, int], rows: tuple[int, int], columns: tuple[int, int]) -> Made:
        """The clip enlarged to `size` (height, width), of that only the rectangle rows x columns, which may reach
        beyond its borders: colour and error bilinearly, depth and class from the nearest pixel."""
        grid = sampling_grid(size, rows, columns, self.rgb)
        smooth = _sampled(torch.cat([self.rgb.float(), self.log_error.float()], 1), grid, "bilinear")
        sharp = _sampled(torch.cat([self.depth_code.float(), self.ids.float()], 1), grid, "nearest")
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

    @property
    def shares(self) -> Tensor:
        """Share of each class f32[N,19,H,W]; they sum to at most 1."""
        return _shares(self.weights, self.sources)

    def ids(self) -> Tensor:
        """The class with the largest share u8[N,1,H,W]; frame by frame, for the shares of all are large.

        (``max`` finds the first of several equal ones, as ``argmax`` does, in half of the time.)
        """
        most = (
            _shares(w[None], s[None]).max(1, keepdim=True).indices
            for w, s in zip(self.weights, self.sources, strict=True)
        )
        return torch.cat([one.to(torch.uint8) for one in most])


def _shares(weights: Tensor, sources: Tensor) -> Tensor:
    shares = weights[:, :1] * one_hot(sources[:, 0])
    for k in range(1, weights.shape[1]):
        shares = torch.addcmul(shares, weights[:, k : k + 1], one_hot(sources[:, k]))
    return shares


def sampling_grid(size: tuple[int, int], rows: tuple[int, int], columns: tuple[int, int], like: Tensor) -> Tensor:
    """Where the pixels of a rectangle of an image of `size` lie in another image of the same view, for `grid_sample`:
    f32[N,h,w,2]."""
    y = (torch.arange(*rows, device=like.device) + 0.5) * (2.0 / size[0]) - 1.0
    x = (torch.arange(*columns, device=like.device) + 0.5) * (2.0 / size[1]) - 1.0
    return torch.stack(torch.meshgrid(x, y, indexing="xy"), -1).expand(len(like), -1, -1, -1)


def _sampled(image: Tensor, grid: Tensor, mode: str) -> Tensor:
    return functional.grid_sample(image, grid, mode=mode, padding_mode="border", align_corners=False)


class Finisher(CellNet):
    """See the module text. `widths`: channels at half and at a quarter of the resolution; `blocks`: residual blocks
    there (`CellNet`)."""

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

    def forward(self, made: Made, given: ConditionPixels, frames: int, scale: Tensor) -> Finished:
        """Finish clips (N = clips times frames, frames innermost).

        Args:
            made: the generated clip, enlarged to the size of `given`; sides are multiples of `STRIDE_PX`.
            scale: f32[N], how many times smaller the clip was.
        """
        colors = torch.stack([made.rgb, given.color, given.backdrop, given.render], 1)
        depths = torch.stack([made.depth_code, given.depth_code, given.render_code], 1)
        ids = torch.stack([made.ids, given.ids, given.backdrop_ids, given.render_ids], 1)
        masks = [given.valid, given.warped, given.alpha, given.certainty]
        fold = lambda x: functional.pixel_unshuffle(x, 2)  # noqa: E731
        agree = (ids[:, 1:] == ids[:, :1]).float().flatten(1, 2)
        planes = [
            fold(colors.flatten(1, 2)),
            fold(depths.flatten(1, 2)),
            *(fold(m) for m in masks),
            fold(made.log_error),
        ]
        planes.append(functional.avg_pool2d(agree, 2))
        planes.append(scale.log2().view(-1, 1, 1, 1).expand(-1, 1, *planes[0].shape[-2:]))
        out = self.pixels(joined(planes, colors.dtype), frames)
        of_color, of_depth, of_class, more, change = out.split([size // 4 for size in self.SIZES], 1)
        rgb = (of_color.softmax(1).unsqueeze(2) * colors).sum(1) + 0.2 * more
        depth = (of_depth.softmax(1).unsqueeze(2) * depths).sum(1)
        return Finished(rgb, depth, ids, of_class.softmax(1), made.log_error + change)


def class_scores(finished: Finished) -> Tensor:
    """Logarithms of the class shares f32[N,19,H,W], for a cross-entropy."""
    return finished.shares.clamp(min=LEAST_SHARE).log()


def with_detail(rgb: Tensor, given: ConditionPixels) -> Tensor:
    """Finished colours f32[N,3,H,W] in [-1,1] with the finest structure of the images warped in (the difference from
    the mean of 3x3 pixels) in place of their own, where the two agree but for that: the more, the better they agree.
    What is learned by squared error is blurred where it is unsure; a warped photograph is not."""
    coarse = lambda x: functional.avg_pool2d(functional.pad(x, (1, 1, 1, 1), mode="replicate"), 3, 1)  # noqa: E731
    mine, theirs = coarse(rgb), coarse(given.color)
    apart = (mine - theirs).abs().amax(1, keepdim=True)
    weight = (1 - apart / DETAIL_APART).clamp(0, 1) * given.warped
    return rgb + weight * ((given.color - theirs) - (rgb - mine))


# tiles --------------------------------------------------------------------------------------------


def spans(length: int, longest: int = TILE_PX) -> list[tuple[int, int]]:
    """Cut 0..length into pieces of about equal size, none longer than `longest` (up to `STRIDE_PX`), with borders at
    multiples of `STRIDE_PX`."""
    count = -(-length // max(longest, STRIDE_PX))
    borders = [round(number * length / count / STRIDE_PX) * STRIDE_PX for number in range(count)] + [length]
    return [(first, last) for first, last in zip(borders, borders[1:], strict=False) if first < last]


class PixelSource(Protocol):
    """The condition of a clip at the size that is wanted, of which one rectangle at a time is asked."""

    @property
    def grid(self) -> tuple[int, int, int]:
        """N, H, W."""
        ...

    def crop(self, rows: slice, columns: slice) -> ConditionPixels:
        """A rectangle of pixels."""
        ...


def finish_in_tiles(
    finisher: Finisher, made: Made, given: PixelSource, tile_px: int = TILE_PX, *, detail: bool = False
) -> Made:
    """Finish one clip at the size of its condition `given` [N,..,H,W], whatever that is.

    Args:
        made: the clip as generated, [N,..,h,w].
        tile_px: longest side of a tile's core; memory depends on it, the result does not.
        detail: colours get the finest structure of what was warped in (`with_detail`).
    """
    frames, *size = given.grid
    small, device = made.rgb.shape[-2:], made.rgb.device
    scale = torch.full((frames,), (size[0] * size[1] / (small[0] * small[1])) ** 0.5, device=device)
    margin = finisher.margin_px
    whole = Made(
        *(
            torch.empty(frames, c, *size, dtype=t, device=device)
            for c, t in ((3, torch.float32), (1, torch.float32), (1, torch.uint8), (1, torch.float32))
        )
    )
    for top, bottom in spans(size[0], tile_px):
        for left, right in spans(size[1], tile_px):
            rows, columns = (
                (max(0, first - margin), min(length, last + margin))
                for first, last, length in ((top, bottom, size[0]), (left, right, size[1]))
            )
            bare = given.crop(slice(*rows), slice(*columns))
            part = _padded(bare)
            reach = (rows[0], rows[0] + part.color.shape[-2]), (columns[0], columns[0] + part.color.shape[-1])
            found = finisher(made.enlarged((size[0], size[1]), *reach), part, frames, scale)
            rgb = found.rgb[..., : rows[1] - rows[0], : columns[1] - columns[0]]
            rgb = with_detail(rgb, bare) if detail else rgb
            core = (..., slice(top - rows[0], bottom - rows[0]), slice(left - columns[0], right - columns[0]))
            target = (..., slice(top, bottom), slice(left, right))
            whole.rgb[target], whole.depth_code[target] = rgb[core], found.depth_code[core]
            whole.ids[target] = found.ids()[core]
            whole.log_error[target] = found.log_error[core]
    return whole


def _padded(given: ConditionPixels) -> ConditionPixels:
    """The condition with sides that are multiples of `STRIDE_PX`: its last row and column are repeated."""
    height, width = given.color.shape[-2:]
    below, right = -height % STRIDE_PX, -width % STRIDE_PX
    if not (below or right):
        return given
    return given.map(lambda x: functional.pad(x.float(), (0, right, 0, below), mode="replicate").to(x.dtype))
