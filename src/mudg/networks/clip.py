"""The OpenCLIP ViT-H/14 towers of the published model, frozen (Radford et al., Cherti et al.). Text: the last block but
one, after the final norm, all 77 tokens. Image: all 257 tokens after the last block, without final norm and projection.
The model only ever saw one caption and the empty one, so their tokens are written down here."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn import functional

from mudg.base.errors import UsageError

CAPTION = "A photo a of driving scene."
"""The caption of every training clip; its word order is part of what the model knows."""
TEXT_TOKENS = 77
CAPTION_IDS = (49406, 320, 1125, 320, 539, 4161, 3562, 269, 49407)
EMPTY_IDS = (49406, 49407)
"""Token ids of the published caption and of the empty one."""
MEAN, DEVIATION = (0.48145466, 0.4578275, 0.40821073), (0.26862954, 0.26130258, 0.27577711)
"""Statistics of the colours in 0..1 that CLIP's image towers were trained with."""
MAX_ATTENTION_BATCH = 32768
"""Attention over more sequences than this is done in parts: GPU kernels have a limit of 65535."""


def attend(query: Tensor, key: Tensor, value: Tensor, heads: int, causal: bool = False) -> Tensor:
    """Softmax attention of `query` [N,L,C] over `key`, `value` [N,M,C] with C split into `heads` -> [N,L,C]."""
    q, k, v = (x.unflatten(-1, (heads, -1)).transpose(1, 2) for x in (query, key, value))
    parts = list(zip(*(x.split(MAX_ATTENTION_BATCH) for x in (q, k, v))))
    mixed = [functional.scaled_dot_product_attention(*part, is_causal=causal) for part in parts]
    return (mixed[0] if len(mixed) == 1 else torch.cat(mixed)).transpose(1, 2).flatten(2)


@dataclass(frozen=True)
class TowerConfig:
    """Sizes of one tower."""

    width: int
    layers: int
    heads: int
    feed_factor: int = 4


TEXT_TOWER = TowerConfig(width=1024, layers=24, heads=16)
IMAGE_TOWER = TowerConfig(width=1280, layers=32, heads=16)


def padded_tokens(ids: tuple[int, ...]) -> Tensor:
    """Token ids as the text tower reads them, i64[77]."""
    return torch.tensor(ids + (0,) * (TEXT_TOKENS - len(ids)))


class TowerBlock(nn.Module):
    """norm - attention, norm - feed-forward, each around a residual."""

    def __init__(self, config: TowerConfig) -> None:
        super().__init__()
        width = config.width
        self.heads = config.heads
        self.norm1, self.norm2 = nn.LayerNorm(width), nn.LayerNorm(width)
        self.query_key_value = nn.Linear(width, 3 * width)
        self.out = nn.Linear(width, width)
        self.feed_in = nn.Linear(width, config.feed_factor * width)
        self.feed_out = nn.Linear(config.feed_factor * width, width)

    def forward(self, x: Tensor, causal: bool) -> Tensor:
        """[N,L,C] -> the same; `causal`: a token sees itself and what stands before it."""
        query, key, value = self.query_key_value(self.norm1(x)).chunk(3, -1)
        x = x + self.out(attend(query, key, value, self.heads, causal))
        return x + self.feed_out(functional.gelu(self.feed_in(self.norm2(x))))


class TextTower(nn.Module):
    """Caption ids -> one vector per token."""

    def __init__(self, config: TowerConfig = TEXT_TOWER, vocabulary: int = 49408) -> None:
        super().__init__()
        self.tokens = nn.Embedding(vocabulary, config.width)
        self.places = nn.Parameter(torch.zeros(TEXT_TOKENS, config.width))
        self.blocks = nn.ModuleList(TowerBlock(config) for _ in range(config.layers))
        self.norm = nn.LayerNorm(config.width)

    def forward(self, ids: Tensor) -> Tensor:
        """i64[N,77] -> [N,77,C], from the last block but one."""
        x = self.tokens(ids) + self.places
        for block in list(self.blocks)[:-1]:
            x = block(x, causal=True)
        return self.norm(x)


class ImageTower(nn.Module):
    """Images -> one vector per patch of 14x14 pixels, and one for the whole."""

    def __init__(self, config: TowerConfig = IMAGE_TOWER, patch: int = 14, side: int = 224) -> None:
        super().__init__()
        self.side = side
        self.patches = nn.Conv2d(3, config.width, patch, stride=patch, bias=False)
        self.whole = nn.Parameter(torch.zeros(config.width))
        self.places = nn.Parameter(torch.zeros((side // patch) ** 2 + 1, config.width))
        self.norm = nn.LayerNorm(config.width)
        self.blocks = nn.ModuleList(TowerBlock(config) for _ in range(config.layers))

    def forward(self, image: Tensor) -> Tensor:
        """Images f32[N,3,H,W] in [-1,1], any size -> [N,257,C]."""
        x = self.patches(prepare_image(image, self.side).to(self.patches.weight.dtype)).flatten(2).transpose(1, 2)
        x = torch.cat([self.whole.expand(len(x), 1, -1), x], 1) + self.places
        x = self.norm(x)
        for block in self.blocks:
            x = block(x, causal=False)
        return x


def prepare_image(image: Tensor, side: int = 224) -> Tensor:
    """Images f32[N,3,H,W] in [-1,1] squashed to side x side, in the tower's units of colour. Where the image shrinks it
    is blurred first (Gaussian of deviation (factor - 1) / 2 pixels per axis, reflected at the border), then read off
    bicubically with the corner pixels' centres kept in place."""
    image = image.float()
    factors = (image.shape[-2] / side, image.shape[-1] / side)
    if max(factors) > 1:
        for axis, factor in zip((-2, -1), factors):
            image = _blur(image, max((factor - 1) / 2, 0.001), axis)
    image = functional.interpolate(image, size=(side, side), mode="bicubic", align_corners=True)
    mean, deviation = (torch.tensor(v, device=image.device).view(3, 1, 1) for v in (MEAN, DEVIATION))
    return ((image + 1) / 2 - mean) / deviation


def _blur(image: Tensor, deviation: float, axis: int) -> Tensor:
    """Gaussian blur along one axis with an odd kernel of about four deviations."""
    taps = int(max(4 * deviation, 3))
    taps += 1 - taps % 2
    place = torch.arange(taps, device=image.device) - taps // 2
    kernel = torch.exp(-(place**2) / (2 * deviation**2))
    kernel = (kernel / kernel.sum()).view((1, 1, -1, 1) if axis == -2 else (1, 1, 1, -1))
    half = taps // 2
    if half >= image.shape[axis]:
        raise UsageError("an image is too narrow to be shrunk", where="clip.prepare_image", got=str(tuple(image.shape)))
    padded = functional.pad(image, (0, 0, half, half) if axis == -2 else (half, half, 0, 0), mode="reflect")
    return functional.conv2d(padded, kernel.expand(image.shape[1], 1, -1, -1), groups=image.shape[1])
