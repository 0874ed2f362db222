"""The OpenCLIP ViT-H/14 towers of the published model, frozen (Radford et al., Cherti et al.). Text: the last block but
one, after the final norm, all 77 tokens. Image: all 257 tokens after the last block, without final norm and projection.
The model only ever saw one caption and the empty one, so their tokens are written down here."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional

from mudg.base.errors import InputError, UsageError
from mudg.networks.folders import checked_state

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
    """Images f32[N,3,H,W] in [-1,1] squashed to side x side, in the tower's units of colour.

    Where the image shrinks it is blurred first (Gaussian of deviation (factor - 1) / 2 pixels per axis, reflected at
    the border), then read off bicubically with the corner pixels' centres kept in place.
    """
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


# the tower of the scores (Radford et al. 2021) --------------------------------------------------------
#
# ViT-L/14 at 336 pixels, from tensors under either of the names in use: with the quick GELU, the last norm and the
# projection. Sizes follow from the tensors.

HEAD_WIDTH: Final = 64
EPSILON: Final = 1e-5
_BLOCK: Final = tuple(
    zip(
        "ln_1 ln_2 attn.out_proj mlp.c_fc mlp.c_proj".split(),
        "layer_norm1 layer_norm2 self_attn.out_proj mlp.fc1 mlp.fc2".split(),
    )
)
_FIXED: Final = (
    ("visual.class_embedding", "vision_model.embeddings.class_embedding"),
    ("visual.positional_embedding", "vision_model.embeddings.position_embedding.weight"),
    ("visual.conv1.weight", "vision_model.embeddings.patch_embedding.weight"),
    *(
        (f"visual.{a}.{leaf}", f"vision_model.{b}.{leaf}")
        for a, b in (("ln_pre", "pre_layrnorm"), ("ln_post", "post_layernorm"))
        for leaf in ("weight", "bias")
    ),
)
"""OpenAI's name, and that of the transformers package."""


def with_openai_names(state: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """The image tower of a file under OpenAI's names; text tower, scales and tables of places are left out."""
    if not any(name.startswith("vision_model.") for name in state):
        return {name: value for name, value in state.items() if name.startswith("visual.")}
    found = {ours: state[theirs] for ours, theirs in _FIXED if theirs in state}
    if "visual_projection.weight" in state:
        found["visual.proj"] = state["visual_projection.weight"].T
    layers = "vision_model.encoder.layers."
    for number in sorted({int(name.removeprefix(layers).split(".")[0]) for name in state if name.startswith(layers)}):
        ours, theirs = f"visual.transformer.resblocks.{number}", f"{layers}{number}"
        for leaf in ("weight", "bias"):
            for a, b in _BLOCK:
                if f"{theirs}.{b}.{leaf}" in state:
                    found[f"{ours}.{a}.{leaf}"] = state[f"{theirs}.{b}.{leaf}"]
            parts = [state.get(f"{theirs}.self_attn.{part}_proj.{leaf}") for part in "qkv"]
            if all(part is not None for part in parts):
                found[f"{ours}.attn.in_proj_{leaf}"] = torch.cat([part for part in parts if part is not None])
    return found


def tensor_shapes(width: int, blocks: int, patch: int, places: int, out: int) -> dict[str, tuple[int, ...]]:
    """OpenAI's name -> shape of the tensors of an image tower."""
    shapes: dict[str, tuple[int, ...]] = {
        "visual.class_embedding": (width,),
        "visual.positional_embedding": (places + 1, width),
        "visual.conv1.weight": (width, 3, patch, patch),
        "visual.proj": (width, out),
    }
    for name in ("ln_pre", "ln_post", *(f"transformer.resblocks.{n}.ln_{k}" for n in range(blocks) for k in (1, 2))):
        shapes |= {f"visual.{name}.weight": (width,), f"visual.{name}.bias": (width,)}
    for number in range(blocks):
        block = f"visual.transformer.resblocks.{number}"
        shapes |= {f"{block}.attn.in_proj_weight": (3 * width, width), f"{block}.attn.in_proj_bias": (3 * width,)}
        for name, rows, columns in (("attn.out_proj", 1, 1), ("mlp.c_fc", 4, 1), ("mlp.c_proj", 1, 4)):
            rows, columns = rows * width, columns * width
            shapes |= {f"{block}.{name}.weight": (rows, columns), f"{block}.{name}.bias": (rows,)}
    return shapes


class ClipImageFeatures(nn.Module):
    """The tower with its projection, always in evaluation mode.

    Args:
        state: tensors of a whole CLIP model or of its image tower, under OpenAI's names or those of the transformers
            package.
        where: file name for errors.

    Raises:
        InputError: a tensor is missing, has another shape, holds values that are not finite, or is unknown.
    """

    def __init__(self, state: Mapping[str, Tensor], where: str = "CLIP weights") -> None:
        super().__init__()
        found = with_openai_names(state)
        needed = ("positional_embedding", "conv1.weight", "proj")
        places, kernel, projection = (found.get(f"visual.{name}") for name in needed)
        if places is None or kernel is None or projection is None or kernel.shape[0] % HEAD_WIDTH:
            got = ", ".join(list(state)[:5])
            expected = "visual.* as OpenAI names them, or vision_model.* and visual_projection.weight"
            raise InputError("these are not the weights of a CLIP image tower", where=where, got=got, expected=expected)
        self.width, self.patch, self.out = int(kernel.shape[0]), int(kernel.shape[-1]), int(projection.shape[-1])
        self.side = round((len(places) - 1) ** 0.5) * self.patch
        self.blocks = len({name.split(".")[3] for name in found if name.startswith("visual.transformer.resblocks.")})
        wanted = tensor_shapes(self.width, self.blocks, self.patch, len(places) - 1, self.out)
        for name, value in checked_state(found, wanted, where, "CLIP", lambda _: False).items():
            self.register_buffer(name.replace(".", "/"), value)

    @property
    def name(self) -> str:
        """Name of the tower by its size."""
        kind = "ViT-L" if (self.width, self.blocks) == (1024, 24) else f"{self.blocks} blocks of {self.width}"
        return f"{kind}/{self.patch} at {self.side}"

    def forward(self, images: Tensor) -> Tensor:
        """Embeddings ``[n, out]``, not brought to length 1, of prepared images ``[n, 3, side, side]``."""
        x = (
            functional.conv2d(images, self.get_buffer("visual/conv1/weight"), stride=self.patch)
            .flatten(2)
            .transpose(1, 2)
        )
        x = torch.cat([self.get_buffer("visual/class_embedding").expand(len(x), 1, -1), x], 1)
        x = self._norm("ln_pre", x + self.get_buffer("visual/positional_embedding"))
        for number in range(self.blocks):
            block = f"transformer/resblocks/{number}"
            x = x + self._attended(block, self._norm(f"{block}/ln_1", x))
            hidden = self._linear(f"{block}/mlp/c_fc", self._norm(f"{block}/ln_2", x))
            x = x + self._linear(f"{block}/mlp/c_proj", hidden * torch.sigmoid(1.702 * hidden))
        return self._norm("ln_post", x[:, 0]) @ self.get_buffer("visual/proj")

    def _attended(self, block: str, x: Tensor) -> Tensor:
        path = f"visual/{block}/attn/in_proj_"
        joined = functional.linear(x, self.get_buffer(f"{path}weight"), self.get_buffer(f"{path}bias"))
        query, key, value = joined.unflatten(-1, (3, -1, HEAD_WIDTH)).permute(2, 0, 3, 1, 4)
        mixed = functional.scaled_dot_product_attention(query, key, value).transpose(1, 2).flatten(2)
        return self._linear(f"{block}/attn/out_proj", mixed)

    def _linear(self, name: str, x: Tensor) -> Tensor:
        return functional.linear(x, self.get_buffer(f"visual/{name}/weight"), self.get_buffer(f"visual/{name}/bias"))

    def _norm(self, name: str, x: Tensor) -> Tensor:
        weight, bias = (self.get_buffer(f"visual/{name}/{leaf}") for leaf in ("weight", "bias"))
        return functional.layer_norm(x, (self.width,), weight, bias, EPSILON)


def prepared(rgb: NDArray[np.uint8], side: int = 336) -> Tensor:
    """An image u8[H, W, 3] as f32[3, side, side]: bicubic without antialiasing (aspect not kept), then CLIP's mean and
    deviation."""
    image = torch.from_numpy(np.array(rgb)).permute(2, 0, 1).float()[None] / 255
    image = functional.interpolate(image, size=(side, side), mode="bicubic", align_corners=False)[0]
    mean, deviation = (torch.tensor(values).view(3, 1, 1) for values in (MEAN, DEVIATION))
    return (image - mean) / deviation
