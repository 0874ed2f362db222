"""DINOv2 image features (Oquab et al. 2023), from tensors under the names of the published files.

A plain vision transformer with patches of 14 pixels and a scale on every residual; sizes follow from the tensors
(ViT-S/14: 384 values an image, ViT-B/14: 768, ViT-L/14: 1024). Position embeddings are those of 37 x 37 patches; images
of 224 pixels have 16 x 16, and the embeddings are resized as the published code does it: bicubic by the factor (16 +
0.1) / 37. Other packages pass the size instead of the factor, which gives slightly different features.
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
from mudg.core.pictures import resize_bicubic
from mudg.networks.folders import checked_state

SIDE_PX: Final = 224
PATCH_PX: Final = 14
HEAD_WIDTH: Final = 64
EPSILON: Final = 1e-6
OFFSET: Final = 0.1
MEAN: Final = (0.485, 0.456, 0.406)
DEVIATION: Final = (0.229, 0.224, 0.225)
NAMES: Final = {(384, 12): "ViT-S/14", (768, 12): "ViT-B/14", (1024, 24): "ViT-L/14"}


def tensor_shapes(width: int, blocks: int, places: int = 37 * 37, feed: int = 0) -> dict[str, tuple[int, ...]]:
    """Name -> shape of the tensors of a network; ``feed``: width of the hidden layer (0 = 4 ``width``)."""
    feed = feed or 4 * width
    shapes: dict[str, tuple[int, ...]] = {
        "cls_token": (1, 1, width),
        "pos_embed": (1, places + 1, width),
        "patch_embed.proj.weight": (width, 3, PATCH_PX, PATCH_PX),
        "patch_embed.proj.bias": (width,),
    }
    for number in range(blocks):
        block = f"blocks.{number}"
        for name in ("norm1", "norm2"):
            shapes |= {f"{block}.{name}.weight": (width,), f"{block}.{name}.bias": (width,)}
        sides = {"attn.qkv": (3 * width, width), "attn.proj": (width, width), "mlp.fc1": (feed, width)}
        for name, (out, into) in {**sides, "mlp.fc2": (width, feed)}.items():
            shapes |= {f"{block}.{name}.weight": (out, into), f"{block}.{name}.bias": (out,)}
        shapes |= {f"{block}.{name}.gamma": (width,) for name in ("ls1", "ls2")}
    return {**shapes, "norm.weight": (width,), "norm.bias": (width,)}


class DinoFeatures(nn.Module):
    """The network, always in evaluation mode.

    Args:
        state: the tensors of ``tensor_shapes``; ``mask_token`` is left alone, anything else is refused.
        where: file name for errors.

    Raises:
        InputError: a tensor is missing, has another shape, holds values that are not finite, or is unknown.
    """

    def __init__(self, state: Mapping[str, Tensor], where: str = "DINOv2 weights") -> None:
        super().__init__()
        places, first = state.get("pos_embed"), state.get("blocks.0.mlp.fc1.weight")
        if places is None or first is None or places.dim() != 3 or places.shape[2] % HEAD_WIDTH:
            what, expected = "these are not the weights of a DINOv2 network", "pos_embed, blocks.0, ..."
            remedy = "use dinov2_vits14_pretrain.pth or dinov2_vitl14_pretrain.pth, not those with registers, nor ViT-g"
            raise InputError(what, where=where, expected=expected, got=", ".join(list(state)[:5]), remedy=remedy)
        self.width = int(places.shape[2])
        numbers = [name.split(".")[1] for name in state if name.startswith("blocks.")]
        self.blocks = 1 + max(int(number) for number in numbers if number.isdigit())
        wanted = tensor_shapes(self.width, self.blocks, int(places.shape[1]) - 1, int(first.shape[0]))
        for name, value in checked_state(state, wanted, where, "DINOv2", lambda name: name == "mask_token").items():
            self.register_buffer(name.replace(".", "/"), value)

    @property
    def name(self) -> str:
        """Name of the network by its size."""
        return NAMES.get((self.width, self.blocks), f"a network of {self.blocks} blocks of {self.width}")

    def forward(self, images: Tensor) -> Tensor:
        """Features ``[n, width]``: normed class token of prepared images ``[n, 3, H, W]``, sides in 14s."""
        return self._norm("norm", self.tokens(images))[:, 0]

    def tokens(self, images: Tensor) -> Tensor:
        """Tokens ``[n, 1 + patches, width]`` after the last block, before the last norm."""
        x = F.conv2d(images, self._of("patch_embed/proj/weight"), self._of("patch_embed/proj/bias"), stride=PATCH_PX)
        rows, columns = x.shape[-2:]
        x = torch.cat([self._of("cls_token").expand(len(x), -1, -1), x.flatten(2).transpose(1, 2)], 1)
        x = x + self.positions(rows, columns)
        for number in range(self.blocks):
            block = f"blocks/{number}"
            x = x + self._attended(block, self._norm(f"{block}/norm1", x)) * self._of(f"{block}/ls1/gamma")
            hidden = F.gelu(self._linear(f"{block}/mlp/fc1", self._norm(f"{block}/norm2", x)))
            x = x + self._linear(f"{block}/mlp/fc2", hidden) * self._of(f"{block}/ls2/gamma")
        return x

    def positions(self, rows: int, columns: int) -> Tensor:
        """Position embeddings ``[1, 1 + rows * columns, width]``."""
        known = self._of("pos_embed")
        side = round((known.shape[1] - 1) ** 0.5)
        if (rows, columns) == (side, side):
            return known
        grid = known[:, 1:].reshape(1, side, side, -1).permute(0, 3, 1, 2)
        factors = (rows + OFFSET) / side, (columns + OFFSET) / side
        grid = F.interpolate(grid, scale_factor=factors, mode="bicubic", antialias=False)
        return torch.cat([known[:, :1], grid.permute(0, 2, 3, 1).flatten(1, 2)], 1)

    def _attended(self, block: str, x: Tensor) -> Tensor:
        joined = self._linear(f"{block}/attn/qkv", x)
        query, key, value = joined.unflatten(-1, (3, -1, HEAD_WIDTH)).permute(2, 0, 3, 1, 4)
        mixed = F.scaled_dot_product_attention(query, key, value).transpose(1, 2).flatten(2)
        return self._linear(f"{block}/attn/proj", mixed)

    def _linear(self, name: str, x: Tensor) -> Tensor:
        return F.linear(x, self._of(f"{name}/weight"), self._of(f"{name}/bias"))

    def _norm(self, name: str, x: Tensor) -> Tensor:
        return F.layer_norm(x, (self.width,), self._of(f"{name}/weight"), self._of(f"{name}/bias"), EPSILON)

    def _of(self, name: str) -> Tensor:
        return self.get_buffer(name)


def prepared(rgb: NDArray[np.uint8]) -> Tensor:
    """An image u8[H, W, 3] as f32[3, 224, 224]: Pillow's bicubic on 8 bits (aspect not kept), then ImageNet's mean and
    deviation, as dgm-eval does it."""
    image = torch.from_numpy(np.array(resize_bicubic(rgb, SIDE_PX, SIDE_PX))).permute(2, 0, 1).float() / 255
    mean, deviation = (torch.tensor(values).view(3, 1, 1) for values in (MEAN, DEVIATION))
    return (image - mean) / deviation
