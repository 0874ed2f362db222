"""CLIP's image embedding (Radford et al. 2021) for scores: ViT-L/14 at 336 pixels, from tensors under either of the
names in use.

Another tower than that of the published diffusion model (``networks/clip.py``): it has the quick GELU, the last norm
and the projection. Sizes follow from the tensors.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor, nn

from mudg.base.errors import InputError
from mudg.networks.clip import DEVIATION, MEAN
from mudg.networks.folders import checked_state

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
        x = F.conv2d(images, self.get_buffer("visual/conv1/weight"), stride=self.patch).flatten(2).transpose(1, 2)
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
        joined = F.linear(x, self.get_buffer(f"{path}weight"), self.get_buffer(f"{path}bias"))
        query, key, value = joined.unflatten(-1, (3, -1, HEAD_WIDTH)).permute(2, 0, 3, 1, 4)
        mixed = F.scaled_dot_product_attention(query, key, value).transpose(1, 2).flatten(2)
        return self._linear(f"{block}/attn/out_proj", mixed)

    def _linear(self, name: str, x: Tensor) -> Tensor:
        return F.linear(x, self.get_buffer(f"visual/{name}/weight"), self.get_buffer(f"visual/{name}/bias"))

    def _norm(self, name: str, x: Tensor) -> Tensor:
        weight, bias = (self.get_buffer(f"visual/{name}/{leaf}") for leaf in ("weight", "bias"))
        return F.layer_norm(x, (self.width,), weight, bias, EPSILON)


def prepared(rgb: NDArray[np.uint8], side: int = 336) -> Tensor:
    """An image u8[H, W, 3] as f32[3, side, side]: bicubic without antialiasing (aspect not kept), then CLIP's mean and
    deviation."""
    image = torch.from_numpy(np.array(rgb)).permute(2, 0, 1).float()[None] / 255
    image = F.interpolate(image, size=(side, side), mode="bicubic", align_corners=False)[0]
    mean, deviation = (torch.tensor(values).view(3, 1, 1) for values in (MEAN, DEVIATION))
    return (image - mean) / deviation
