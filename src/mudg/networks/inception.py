"""FID's feature extractor: the Inception-v3 network of the TensorFlow release of 2015, which differs from
torchvision's. How an image is brought to 299x299 is part of the definition, too; five rules are in use
(``ResizeRule``)."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Final, Literal, NamedTuple, get_args

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor

from mudg.base.errors import InputError
from mudg.core.pictures import bilinear_from_corner, resize_bicubic
from mudg.networks.folders import NORM, ScoreNetwork

SIDE_PX: Final = 299
WIDTH: Final = 2048
CLASSES: Final = 1008
KNOWN_SHA256: Final = "6726825d0af5f729cebd5821db510b11b1cfad8faad88a03f1befd49fb9129b2"
"""Hash of the published file, ``pt_inception-2015-12-05-6726825d.pth``."""

ResizeRule = Literal["pytorch-fid", "tf1", "clean", "tm", "neurad"]
"""How an image u8[H, W, 3] becomes f32[3, 299, 299]; the aspect is not kept by any.

* pytorch-fid: bilinear, half-pixel centres, no antialiasing; 2 x / 255 - 1.
* tf1: bilinear, pixel k of the result at k * in / out, no antialiasing; (x - 128) / 128, as the other rules. TTUR,
  torch-fidelity.
* clean: bicubic with antialiasing, clipped to 0..255, not rounded. clean-fid.
* tm: bilinear with antialiasing. torchmetrics.
* neurad: Pillow's bicubic on 8 bits. neurad-studio.
"""
RULES: Final[tuple[ResizeRule, ...]] = get_args(ResizeRule)


class _Unit(NamedTuple):
    """A convolution with its norm: name, channels out, kernel, stride, and whether padding keeps the size."""

    name: str
    out: int
    size: tuple[int, int]
    stride: int
    same: bool


_AVERAGE, _MAXIMUM, _MAXIMUM_HALF = "average", "maximum", "maximum, every second place"
_Branch = tuple[_Unit | str | tuple[_Unit, ...], ...]
"""Units and pools in order; a tuple of units at the end reads the same input and is concatenated."""


def _unit(name: str, out: int, size: int | tuple[int, int] = 1, stride: int = 1) -> _Unit:
    """A convolution with its norm; padded to keep the size unless it takes every second place."""
    return _Unit(name, out, (size, size) if isinstance(size, int) else size, stride, stride == 1)


def _chain(name: str, *layers: tuple[int, int | tuple[int, int]]) -> tuple[_Unit, ...]:
    """Units NAME_1, NAME_2, ...: channels out and kernel of each."""
    return tuple(_unit(f"{name}_{number}", out, size) for number, (out, size) in enumerate(layers, 1))


def _block_a(pool: int) -> tuple[_Branch, ...]:
    return (
        (_unit("branch1x1", 64),),
        _chain("branch5x5", (48, 1), (64, 5)),
        _chain("branch3x3dbl", (64, 1), (96, 3), (96, 3)),
        (_AVERAGE, _unit("branch_pool", pool)),
    )


def _block_c(width: int) -> tuple[_Branch, ...]:
    flat, tall = (1, 7), (7, 1)
    return (
        (_unit("branch1x1", 192),),
        _chain("branch7x7", (width, 1), (width, flat), (192, tall)),
        _chain("branch7x7dbl", (width, 1), (width, tall), (width, flat), (width, tall), (192, flat)),
        (_AVERAGE, _unit("branch_pool", 192)),
    )


def _block_e(pool: str) -> tuple[_Branch, ...]:
    ends = (("a", (1, 3)), ("b", (3, 1)))
    return (
        (_unit("branch1x1", 320),),
        (_unit("branch3x3_1", 384), tuple(_unit(f"branch3x3_2{k}", 384, s) for k, s in ends)),
        (*_chain("branch3x3dbl", (448, 1), (384, 3)), tuple(_unit(f"branch3x3dbl_3{k}", 384, s) for k, s in ends)),
        (pool, _unit("branch_pool", 192)),
    )


_STEM: Final[tuple[_Unit | str, ...]] = (
    _Unit("Conv2d_1a_3x3", 32, (3, 3), 2, False),
    _Unit("Conv2d_2a_3x3", 32, (3, 3), 1, False),
    _Unit("Conv2d_2b_3x3", 64, (3, 3), 1, True),
    _MAXIMUM_HALF,
    _Unit("Conv2d_3b_1x1", 80, (1, 1), 1, False),
    _Unit("Conv2d_4a_3x3", 192, (3, 3), 1, False),
    _MAXIMUM_HALF,
)
"""Convolutions and pools from the image on."""

_BLOCKS: Final[dict[str, tuple[_Branch, ...]]] = {
    "Mixed_5b": _block_a(32),
    **dict.fromkeys(("Mixed_5c", "Mixed_5d"), _block_a(64)),
    "Mixed_6a": (
        (_unit("branch3x3", 384, 3, 2),),
        (*_chain("branch3x3dbl", (64, 1), (96, 3)), _unit("branch3x3dbl_3", 96, 3, 2)),
        (_MAXIMUM_HALF,),
    ),
    "Mixed_6b": _block_c(128),
    **dict.fromkeys(("Mixed_6c", "Mixed_6d"), _block_c(160)),
    "Mixed_6e": _block_c(192),
    "Mixed_7a": (
        (_unit("branch3x3_1", 192), _unit("branch3x3_2", 320, 3, 2)),
        (*_chain("branch7x7x3", (192, 1), (192, (1, 7)), (192, (7, 1))), _unit("branch7x7x3_4", 192, 3, 2)),
        (_MAXIMUM_HALF,),
    ),
    "Mixed_7b": _block_e(_AVERAGE),
    "Mixed_7c": _block_e(_MAXIMUM),
}


def tensor_shapes() -> dict[str, tuple[int, ...]]:
    """Name -> shape of all 472 tensors that a weight file must hold, in the network's order."""
    shapes: dict[str, tuple[int, ...]] = {}
    for name, into, (_, out, size, _, _) in _units():
        shapes[f"{name}.conv.weight"] = (out, into, *size)
        shapes |= {f"{name}.bn.{leaf}": (out,) for leaf in NORM}
    return {**shapes, "fc.weight": (CLASSES, WIDTH), "fc.bias": (CLASSES,)}


def _units() -> Iterator[tuple[str, int, _Unit]]:
    """Full name, channels in, and unit of every convolution, in order."""
    width = 3
    for step in _STEM:
        if not isinstance(step, str):
            yield step.name, width, step
            width = step.out
    for block, branches in _BLOCKS.items():
        total = 0
        for branch in branches:
            inner = width
            for step in branch:
                if isinstance(step, str):
                    continue
                group = (step,) if isinstance(step, _Unit) else step
                for unit in group:
                    yield f"{block}.{unit.name}", inner, unit
                inner = sum(unit.out for unit in group)
            total += inner
        width = total


class InceptionFeatures(ScoreNetwork):
    """The network from the tensors of ``tensor_shapes``; counts of batches are left alone."""

    def __init__(self, state: Mapping[str, Tensor], where: str = "Inception weights") -> None:
        network = "FID's Inception (pt_inception-2015-12-05-6726825d.pth; torchvision's is another network)"
        super().__init__(state, tensor_shapes(), where, network)
        self._units = {name: unit for name, _, unit in _units()}

    def forward(self, images: Tensor) -> Tensor:
        """Features of FID, the average over all places: ``[n, 3, 299, 299]`` from ``prepared`` -> ``[n, 2048]``."""
        if images.shape[1:] != (3, SIDE_PX, SIDE_PX):
            expected = f"[n, 3, {SIDE_PX}, {SIDE_PX}]"
            raise InputError("FID's network takes images of one size", expected=expected, got=str(tuple(images.shape)))
        x = images
        for step in _STEM:
            x = _pooled(step, x) if isinstance(step, str) else self._convolved(step.name, x)
        for block in _BLOCKS:
            x = self.block(block, x)
        return x.mean((2, 3))

    def block(self, name: str, x: Tensor) -> Tensor:
        """One of the blocks Mixed_5b to Mixed_7c: ``[n, C, h, w]`` -> ``[n, C', h', w']``."""
        return torch.cat([self._branch(name, branch, x) for branch in _BLOCKS[name]], 1)

    def _branch(self, block: str, branch: _Branch, x: Tensor) -> Tensor:
        for step in branch:
            if isinstance(step, str):
                x = _pooled(step, x)
            elif isinstance(step, _Unit):
                x = self._convolved(f"{block}.{step.name}", x)
            else:
                x = torch.cat([self._convolved(f"{block}.{unit.name}", x) for unit in step], 1)
        return x

    def _convolved(self, name: str, x: Tensor) -> Tensor:
        _, _, (tall, wide), stride, same = self._units[name]
        padding = (tall // 2, wide // 2) if same else 0
        return self.normed(F.conv2d(x, self.tensor(f"{name}.conv.weight"), None, stride, padding), name)


def _pooled(kind: str, x: Tensor) -> Tensor:
    if kind == _AVERAGE:
        return F.avg_pool2d(x, 3, 1, 1, count_include_pad=False)
    return F.max_pool2d(x, 3, 2) if kind == _MAXIMUM_HALF else F.max_pool2d(x, 3, 1, 1)


# ---- images in ----


def prepared(rgb: NDArray[np.uint8], rule: ResizeRule) -> Tensor:
    """An image u8[H, W, 3] as f32[3, 299, 299], in about [-1, 1], by one of the five rules."""
    if rule == "neurad":
        return (_planes(resize_bicubic(rgb, SIDE_PX, SIDE_PX)) - 128) / 128
    image, size = _planes(rgb)[None], (SIDE_PX, SIDE_PX)
    if rule == "pytorch-fid":
        return F.interpolate(image / 255, size=size, mode="bilinear", align_corners=False)[0] * 2 - 1
    if rule == "tf1":
        image = bilinear_from_corner(image, SIDE_PX)
    elif rule == "clean":
        image = F.interpolate(image, size=size, mode="bicubic", align_corners=False, antialias=True).clamp(0, 255)
    else:
        image = F.interpolate(image, size=size, mode="bilinear", align_corners=False, antialias=True)
    return (image[0] - 128) / 128


def _planes(rgb: NDArray[np.uint8]) -> Tensor:
    return torch.from_numpy(np.array(rgb)).permute(2, 0, 1).float()
