"""FVD's feature extractor: I3D trained on Kinetics-400, from tensors under either of the names in use, with epsilon
1e-3 in its norms and TensorFlow's rule SAME of padding. How frames get to 224x224 is part of the definition
(``VideoRule``)."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Final, Literal, NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor

from mudg.base.errors import InputError
from mudg.core.pictures import bilinear_from_corner
from mudg.networks.folders import NORM, ScoreNetwork

SIDE_PX: Final = 224
WIDTH: Final = 400
SHORTEST: Final = 9
"""Fewest frames of a clip that leave two steps after three halvings."""

VideoRule = Literal["videogpt", "google", "stylegan-v"]
"""How a frame u8[H, W, 3] becomes f32[3, 224, 224] in [-1, 1].

* videogpt: the shorter side to 224, bilinear without antialiasing, the other rounded up; the middle is cut out.
* google: squashed to 224x224, bilinear, pixel k of the result at k * in / out. The original FVD.
* stylegan-v: squashed to 224x224, bilinear, half-pixel centres, no antialiasing.
"""


class _Cube(NamedTuple):
    """A convolution with its norm: name, channels in and out, side of the kernel, stride."""

    name: str
    into: int
    out: int
    size: int = 1
    stride: int = 1


class _Pool(NamedTuple):
    """Maxima over time, height and width."""

    size: tuple[int, int, int]
    stride: tuple[int, int, int]


class _Mixed(NamedTuple):
    """Four branches side by side: 1; 1 then 3; 1 then 3; maxima then 1. Channels of b0, b1a, b1b, b2a, b2b, b3b."""

    name: str
    into: int
    widths: tuple[int, int, int, int, int, int]

    def units(self) -> dict[str, _Cube]:
        """The convolutions by branch name."""
        b0, b1a, b1b, b2a, b2b, b3b = self.widths
        rows = (("b0", self.into, b0, 1), ("b1a", self.into, b1a, 1), ("b1b", b1a, b1b, 3))
        rows += (("b2a", self.into, b2a, 1), ("b2b", b2a, b2b, 3), ("b3b", self.into, b3b, 1))
        return {branch: _Cube(f"{self.name}.{branch}", *row) for branch, *row in rows}


_STEPS: Final[tuple[_Cube | _Pool | _Mixed, ...]] = (
    _Cube("Conv3d_1a_7x7", 3, 64, 7, 2),
    _Pool((1, 3, 3), (1, 2, 2)),
    _Cube("Conv3d_2b_1x1", 64, 64),
    _Cube("Conv3d_2c_3x3", 64, 192, 3),
    _Pool((1, 3, 3), (1, 2, 2)),
    _Mixed("Mixed_3b", 192, (64, 96, 128, 16, 32, 32)),
    _Mixed("Mixed_3c", 256, (128, 128, 192, 32, 96, 64)),
    _Pool((3, 3, 3), (2, 2, 2)),
    _Mixed("Mixed_4b", 480, (192, 96, 208, 16, 48, 64)),
    _Mixed("Mixed_4c", 512, (160, 112, 224, 24, 64, 64)),
    _Mixed("Mixed_4d", 512, (128, 128, 256, 24, 64, 64)),
    _Mixed("Mixed_4e", 512, (112, 144, 288, 32, 64, 64)),
    _Mixed("Mixed_4f", 528, (256, 160, 320, 32, 128, 128)),
    _Pool((2, 2, 2), (2, 2, 2)),
    _Mixed("Mixed_5b", 832, (256, 160, 320, 32, 128, 128)),
    _Mixed("Mixed_5c", 832, (384, 192, 384, 48, 128, 128)),
)
_OTHER_NAMES: Final = tuple(
    row.split()
    for row in (
        "batch3d. bn.,conv3d_0c_1x1. logits.,conv3d_1a Conv3d_1a,conv3d_2b Conv3d_2b,conv3d_2c Conv3d_2c,mixed_ Mixed_,"
        "branch_0. b0.,branch_1.0. b1a.,branch_1.1. b1b.,branch_2.0. b2a.,branch_2.1. b2b.,branch_3.1. b3b."
    ).split(",")
)
"""Parts of names in the first layout -> in the second."""


def tensor_shapes() -> dict[str, tuple[int, ...]]:
    """Name in the second layout -> shape of all 287 tensors."""
    shapes: dict[str, tuple[int, ...]] = {}
    for unit in _units():
        shapes[f"{unit.name}.conv3d.weight"] = (unit.out, unit.into, *(unit.size,) * 3)
        shapes |= {f"{unit.name}.bn.{leaf}": (unit.out,) for leaf in NORM}
    return {**shapes, "logits.conv3d.weight": (WIDTH, 1024, 1, 1, 1), "logits.conv3d.bias": (WIDTH,)}


def _units() -> Iterator[_Cube]:
    for step in _STEPS:
        if isinstance(step, _Cube):
            yield step
        elif isinstance(step, _Mixed):
            yield from step.units().values()


class I3DFeatures(ScoreNetwork):
    """The network from the tensors of ``tensor_shapes`` in either layout; counts of batches are left alone."""

    def __init__(self, state: Mapping[str, Tensor], where: str = "I3D weights") -> None:
        super().__init__(with_known_names(state), tensor_shapes(), where, "I3D")

    def forward(self, clips: Tensor) -> Tensor:
        """FVD's features ``[n, 400]``, scores before the softmax, averaged over time, of clips ``[n, 3, T, 224, 224]``
        in [-1, 1], T >= 9."""
        fits = clips.dim() == 5 and clips.shape[1] == 3 and clips.shape[3:] == (SIDE_PX, SIDE_PX)
        if not fits or clips.shape[2] < SHORTEST:
            expected = f"[n, 3, T >= {SHORTEST}, {SIDE_PX}, {SIDE_PX}]"
            raise InputError("FVD's network takes clips of one size", expected=expected, got=str(tuple(clips.shape)))
        x = clips
        for step in _STEPS:
            if isinstance(step, _Cube):
                x = self._convolved(step, x)
            elif isinstance(step, _Pool):
                x = _maxima(x, step)
            else:
                of = {branch: lambda y, unit=unit: self._convolved(unit, y) for branch, unit in step.units().items()}
                pooled = _maxima(x, _Pool((3, 3, 3), (1, 1, 1)))
                parts = of["b0"](x), of["b1b"](of["b1a"](x)), of["b2b"](of["b2a"](x)), of["b3b"](pooled)
                x = torch.cat(parts, 1)
        weight, bias = self.tensor("logits.conv3d.weight"), self.tensor("logits.conv3d.bias")
        return F.conv3d(F.avg_pool3d(x, (2, 7, 7), 1), weight, bias).mean((2, 3, 4))

    def _convolved(self, unit: _Cube, x: Tensor) -> Tensor:
        x = same_padded(x, (unit.size,) * 3, (unit.stride,) * 3)
        return self.normed(F.conv3d(x, self.tensor(f"{unit.name}.conv3d.weight"), None, unit.stride), unit.name)


def same_padded(x: Tensor, size: tuple[int, int, int], stride: tuple[int, int, int]) -> Tensor:
    """``[n, C, T, H, W]`` with zeros around it by TensorFlow's rule SAME: the smaller half lies in front."""
    pads: list[int] = []
    for length, kernel, step in zip(reversed(x.shape[2:]), reversed(size), reversed(stride), strict=True):
        total = max(kernel - (length % step or step), 0)
        pads += [total // 2, total - total // 2]
    return F.pad(x, pads) if any(pads) else x


def _maxima(x: Tensor, pool: _Pool) -> Tensor:
    return F.max_pool3d(same_padded(x, pool.size, pool.stride), pool.size, pool.stride)


def with_known_names(state: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Tensors under the names of ``tensor_shapes``, from either layout; counts of batches are left out."""
    found = {}
    for name, value in state.items():
        for old, new in _OTHER_NAMES:
            name = name.replace(old, new)
        found |= {} if name.endswith("num_batches_tracked") else {name: value}
    return found


def prepared_frame(rgb: NDArray[np.uint8], rule: VideoRule) -> Tensor:
    """A frame u8[H, W, 3] as f32[3, 224, 224] in [-1, 1]."""
    image = torch.from_numpy(np.array(rgb)).permute(2, 0, 1).float()[None] / 255
    if rule == "google":
        return bilinear_from_corner(image, SIDE_PX)[0] * 2 - 1
    height, width = rgb.shape[:2]
    if rule == "stylegan-v":
        size = (SIDE_PX, SIDE_PX)
    else:
        shorter = min(height, width)
        size = (-(-height * SIDE_PX // shorter), -(-width * SIDE_PX // shorter))
    image = F.interpolate(image, size=size, mode="bilinear", align_corners=False)
    top, left = (size[0] - SIDE_PX) // 2, (size[1] - SIDE_PX) // 2
    return image[0, :, top : top + SIDE_PX, left : left + SIDE_PX] * 2 - 1
