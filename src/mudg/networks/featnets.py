"""Feature extractors for perceptual comparison, from an image to a list of feature maps: a fixed filter bank (fits),
the shipped codec's network (scores), the trunk of LPIPS."""

from __future__ import annotations

import threading
from collections.abc import Mapping
from typing import Any, Final, Literal, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

from mudg.base.errors import InputError
from mudg.core.losses import lpips_distance, unit_features
from mudg.core.metrics import Pair
from mudg.core.native_ops import box_mean
from mudg.networks.codec import PatchCodec
from mudg.networks.folders import ScoreNetwork

OPPONENT: Final = ((0.299, 0.587, 0.114), (0.5, -0.5, 0.0), (0.25, 0.25, -0.5))


class FilterBank(nn.Module):
    """Fixed features of an image ``[3, H, W]`` in [0, 1] at several scales, octaves apart; it must have at least ``4 *
    2**scales`` pixels in each direction. Per scale one tensor ``[9, h, w]``: normalised signed derivatives (2), their
    pooled energy (4 orientations) and the blurred opponent colours (3)."""

    CONTRAST_FLOOR: Final = 0.02

    def __init__(self, scales: int = 3) -> None:
        super().__init__()
        self.scales = scales
        self.register_buffer("opponent", torch.tensor(OPPONENT))

    def forward(self, rgb: Tensor) -> list[Tensor]:
        """Feature maps of one image, finest scale first."""
        colors = (self.opponent.to(rgb.dtype) @ rgb.flatten(1)).view(1, *rgb.shape)
        features = []
        for scale in range(self.scales):
            features.append(self._features(colors)[0])
            if scale + 1 < self.scales:
                colors = F.avg_pool2d(colors, 2, ceil_mode=True, count_include_pad=False)
        return features

    def _features(self, colors: Tensor) -> Tensor:
        slope: Tensor = _Slope.apply(F.pad(colors[:, :1], (1, 1, 1, 1), mode="replicate"))
        power = (slope**2).sum(1, keepdim=True)
        contrast = torch.sqrt(box_mean(power, 7) + self.CONTRAST_FLOOR**2)
        dx, dy = slope[:, :1] / contrast, slope[:, 1:] / contrast
        diagonal, antidiagonal = (dx + dy) * 0.5**0.5, (dx - dy) * 0.5**0.5
        energy = box_mean(torch.cat([dx, dy, diagonal, antidiagonal], 1) ** 2, 5)
        amplitude = torch.sqrt(energy + 1e-4)
        return torch.cat([0.5 * dx, 0.5 * dy, amplitude, 4.0 * box_mean(colors, 5)], 1)


class _Slope(torch.autograd.Function):
    """Differences along x and y of a plane, smoothed across: ``[1, 1, H + 2, W + 2]`` -> ``[1, 2, H, W]``. The same as
    a convolution with two kernels of 3x3, whose backward pass takes ten times as long for a single channel."""

    @staticmethod
    def forward(ctx: Any, padded: Tensor) -> Tensor:
        plane = padded[0, 0]
        rows = (plane[:-2] + plane[2:]).add_(plane[1:-1], alpha=2)
        columns = (plane[:, :-2] + plane[:, 2:]).add_(plane[:, 1:-1], alpha=2)
        return torch.stack([rows[:, 2:] - rows[:, :-2], columns[2:] - columns[:-2]])[None] / 8

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, upstream: Tensor) -> Tensor:
        across, down = upstream[0] / 8
        height, width = across.shape
        rows, columns = across.new_zeros(height, width + 2), across.new_zeros(height + 2, width)
        rows[:, 2:] += across
        rows[:, :-2] -= across
        columns[2:] += down
        columns[:-2] -= down
        plane = across.new_zeros(height + 2, width + 2)
        for shift, share in ((0, 1), (1, 2), (2, 1)):
            plane[shift : height + shift].add_(rows, alpha=share)
            plane[:, shift : width + shift].add_(columns, alpha=share)
        return plane[None, None]


class CodecFeatures(nn.Module):
    """Features of an image ``[3, H, W]`` in [0, 1]: activations of the codec's decoder network on the image's own code.
    The codec's encoder is one linear map of 2x2 pixels; what the codec has learned about images lies in the decoder
    network, which was trained to restore what the code lost. Its stages (the first convolution and each residual block)
    are the features, for the image at full, half and quarter size: per size, largest first, and per stage one tensor
    ``[C, h, w]``. Depth and classes are withheld, as in a part of the codec's training."""

    SIZES: Final = 3

    def __init__(self, codec: PatchCodec) -> None:
        super().__init__()
        self.codec = codec

    def forward(self, rgb: Tensor) -> list[Tensor]:
        """Features of one image; sides that are no multiple of 8 are padded by repeating their last pixels."""
        height, width = rgb.shape[-2:]
        image = F.pad(rgb[None].clamp(0, 1), (0, -width % 8, 0, -height % 8), mode="replicate")
        features = []
        for _ in range(self.SIZES):
            code = self.codec.encode_rgb(image)
            others = sum(count for modality, count in self.codec.channels.items() if modality != "rgb")
            latent = torch.cat([code, code.new_zeros(1, others, *code.shape[-2:])], 1)
            x = self.codec.enter(latent.contiguous(memory_format=torch.channels_last))  # as the codec's norms want it
            features.append(x[0])
            for block in self.codec.blocks:
                x = block(x)
                features.append(x[0])
            image = F.avg_pool2d(image, 2)
        return features


WHOLE_PIXELS: Final = 2_500_000
"""Larger images (1920 x 1280 is just below) are halved until they have no more, before they are compared in the
features of the codec."""
LpipsTrunk = Literal["alex", "vgg"]
LpipsInput = Literal["correct", "unscaled"]


class _Layer(NamedTuple):
    """A convolution with ReLU: place in the trunk, channels out and in, kernel, stride, padding."""

    place: str
    out: int
    into: int
    size: int = 3
    stride: int = 1
    padding: int = 1


_Stage = tuple[_Layer | int, ...]
"""Convolutions; a number stands for maxima over squares of that side at every second place."""


def _vgg(first: int, channels: tuple[int, ...]) -> tuple[_Layer, ...]:
    """Convolutions from a place of VGG-16 on; ``channels``: in, then out of each."""
    pairs = zip(channels[:-1], channels[1:], strict=True)
    return tuple(_Layer(str(first + 2 * number), out, into) for number, (into, out) in enumerate(pairs))


TRUNKS: Final[dict[LpipsTrunk, tuple[_Stage, ...]]] = {
    "alex": (
        (_Layer("0", 64, 3, 11, 4, 2),),
        (3, _Layer("3", 192, 64, 5, 1, 2)),
        (3, _Layer("6", 384, 192)),
        (_Layer("8", 256, 384),),
        (_Layer("10", 256, 256),),
    ),
    "vgg": (
        _vgg(0, (3, 64, 64)),
        (2, *_vgg(5, (64, 128, 128))),
        (2, *_vgg(10, (128, 256, 256, 256))),
        (2, *_vgg(17, (256, 512, 512, 512))),
        (2, *_vgg(24, (512, 512, 512, 512))),
    ),
}
"""Stages of each network; features are read after each. Places are those of torchvision's networks."""


def lpips_shapes(trunk: LpipsTrunk) -> dict[str, tuple[int, ...]]:
    """Name -> shape of the tensors of a network of LPIPS, as the lpips package names them."""
    shapes: dict[str, tuple[int, ...]] = {}
    for number, stage in enumerate(TRUNKS[trunk]):
        layers = [step for step in stage if isinstance(step, _Layer)]
        for layer in layers:
            named = f"net.slice{number + 1}.{layer.place}"
            shapes[f"{named}.weight"] = (layer.out, layer.into, layer.size, layer.size)
            shapes[f"{named}.bias"] = (layer.out,)
        shapes[f"lin{number}.model.1.weight"] = (1, layers[-1].out, 1, 1)
    return shapes


class LpipsFeatures(ScoreNetwork):
    """A trunk of LPIPS 0.1 (Zhang et al. 2018), AlexNet or VGG-16, and its weights per channel, from tensors as the
    lpips package names them; other entries are left alone. given: correct: colours are brought to [-1, 1] first.
    unscaled: they stay in [0, 1], as in much published code of Gaussian scenes."""

    SHIFT, SCALE = (-0.030, -0.088, -0.188), (0.458, 0.448, 0.450)
    SMALLEST_PX: Final = 31

    def __init__(
        self,
        state: Mapping[str, Tensor],
        where: str = "LPIPS weights",
        trunk: LpipsTrunk = "alex",
        given: LpipsInput = "correct",
    ) -> None:
        super().__init__(state, lpips_shapes(trunk), where, "LPIPS", lambda _: True)
        self.trunk, self.given = trunk, given
        for name, values in (("shift", self.SHIFT), ("scale", self.SCALE)):
            self.register_buffer(name, torch.tensor(values).view(1, 3, 1, 1))

    @property
    def channel_weights(self) -> list[Tensor]:
        """Weights per channel, by stage."""
        return [self.tensor(f"lin{stage}.model.1.weight").flatten() for stage in range(len(TRUNKS[self.trunk]))]

    def forward(self, rgb: Tensor) -> list[Tensor]:
        """Features ``[C, h, w]`` of the stages of an image ``[3, H, W]`` in [0, 1], at least 31 pixels a side."""
        if min(rgb.shape[-2:]) < self.SMALLEST_PX:
            size = f"{rgb.shape[-1]}x{rgb.shape[-2]}"
            raise InputError("an image is too small for LPIPS", expected=f"{self.SMALLEST_PX} pixels a side", got=size)
        x = rgb[None].clamp(0, 1)
        x = ((x * 2 - 1 if self.given == "correct" else x) - self.shift) / self.scale
        features = []
        for number, stage in enumerate(TRUNKS[self.trunk]):
            for step in stage:
                if isinstance(step, int):
                    x = F.max_pool2d(x, step, 2)
                    continue
                name = f"net.slice{number + 1}.{step.place}"
                kernel, bias = self.tensor(f"{name}.weight"), self.tensor(f"{name}.bias")
                x = F.relu(F.conv2d(x, kernel, bias, step.stride, step.padding))
            features.append(x[0])
        return features


def reduced(image: Tensor) -> Tensor:
    """A large image ``[C, H, W]`` brought to at most ``WHOLE_PIXELS`` by halving it, areas averaged."""
    while image.shape[-2] * image.shape[-1] > WHOLE_PIXELS:
        image = F.avg_pool2d(image[None], 2, ceil_mode=True, count_include_pad=False)[0]
    return image


class PerceptualDistance:
    """``lpips_distance`` of a pair's colours in the features of a network; threads may call it. The same truth is
    compared with one method after another: each thread keeps its features until another truth comes. Pairs come on the
    CPU; what is compared goes to the device of the network here, and the number comes back."""

    def __init__(
        self, features: nn.Module, weights: list[Tensor] | None = None, device: torch.device | None = None
    ) -> None:
        self._device = device or torch.device("cpu")
        self._features = features.to(self._device)
        self._weights = None if weights is None else [weight.to(self._device) for weight in weights]
        self._known = threading.local()

    def __call__(self, pair: Pair) -> float | None:
        """The distance, or None where colour is missing."""
        truth, mask = pair.truth_rgb, pair.mask
        if pair.rgb is None or truth is None:
            return None
        made, halves = pair.rgb, isinstance(self._features, CodecFeatures)
        with torch.no_grad():
            if getattr(self._known, "image", None) is not truth:
                image = (reduced(truth) if halves else truth).to(self._device)
                self._known.features = unit_features(self._features(image))
                self._known.image = truth
            if halves:
                made, mask = reduced(made), None if mask is None else reduced(mask.float())
            found = self._features(made.to(self._device))
            mask = None if mask is None else mask.to(self._device)
            return float(lpips_distance(found, self._known.features, mask, self._weights, over_weight=True))
