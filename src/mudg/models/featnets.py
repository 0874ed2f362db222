"""Feature extractors for perceptual comparison: a fixed filter bank, the shipped codec's network, the trunk of LPIPS.

By default fits use the filter bank and scores the codec.

Each takes an image and returns a list of feature maps. ``FilterBank`` needs no weights; it follows what is known of early vision
(Gabor-like energy at several scales and orientations, divisive contrast normalisation, opponent colours):

* opponent colours: luminance and two chroma axes, compared on blurred images only (the eye resolves colour coarsely);
* per scale (1, 1/2, 1/4 of the size): first-derivative responses in four orientations, divided by the local contrast, so that
  a weak texture in shadow counts as much as a strong one in the sun;
* the responses' *energy*, pooled over a few pixels: two images of the same texture that are misaligned by a
  pixel are close, where L1 sees two different images and answers with blur.

The bank is differentiable, deterministic, and costs about as much as SSIM.
"""

from __future__ import annotations

import threading
from collections.abc import Mapping
from typing import Final

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from mudg.base.errors import InputError
from mudg.core.metrics import Pair
from mudg.core.native_ops import box_mean
from mudg.core.perceptual import lpips_distance, unit_features
from mudg.models.mdm.codec import PatchCodec

OPPONENT: Final = ((0.299, 0.587, 0.114), (0.5, -0.5, 0.0), (0.25, 0.25, -0.5))


class FilterBank(nn.Module):
    """Fixed multi-scale features of an image ``[3, H, W]`` in [0, 1].

    Args:
        scales: number of octaves; the image must be at least ``4 * 2**scales`` pixels in each direction.

    Returns (from ``forward``):
        Per scale one tensor ``[C, h, w]``: normalised signed derivatives (2), their pooled energy (4 orientations) and the
        blurred opponent colours (3); C = 9.
    """

    CONTRAST_FLOOR: Final = 0.02

    def __init__(self, scales: int = 3) -> None:
        super().__init__()
        self.scales = scales
        smooth, slope = torch.tensor([1.0, 2.0, 1.0]) / 4, torch.tensor([-1.0, 0.0, 1.0]) / 2
        along_x, along_y = torch.outer(smooth, slope), torch.outer(slope, smooth)
        self.register_buffer("opponent", torch.tensor(OPPONENT).view(3, 3, 1, 1))
        self.register_buffer("derivative", torch.stack([along_x, along_y])[:, None])

    def forward(self, rgb: Tensor) -> list[Tensor]:
        """Feature maps of one image, finest scale first."""
        colors = F.conv2d(rgb[None], self.opponent.to(rgb.dtype))
        features = []
        for scale in range(self.scales):
            features.append(self._features(colors)[0])
            if scale + 1 < self.scales:
                colors = F.avg_pool2d(colors, 2, ceil_mode=True, count_include_pad=False)
        return features

    def _features(self, colors: Tensor) -> Tensor:
        padded = F.pad(colors[:, :1], (1, 1, 1, 1), mode="replicate")
        slope = F.conv2d(padded, self.derivative.to(colors.dtype))
        power = (slope**2).sum(1, keepdim=True)
        contrast = torch.sqrt(box_mean(power, 7) + self.CONTRAST_FLOOR**2)
        dx, dy = slope[:, :1] / contrast, slope[:, 1:] / contrast
        diagonal, antidiagonal = (dx + dy) * 0.5**0.5, (dx - dy) * 0.5**0.5
        energy = box_mean(torch.cat([dx, dy, diagonal, antidiagonal], 1) ** 2, 5)
        amplitude = torch.sqrt(energy + 1e-4)
        return torch.cat([0.5 * dx, 0.5 * dy, amplitude, 4.0 * box_mean(colors, 5)], 1)


class CodecFeatures(nn.Module):
    """Features of an image ``[3, H, W]`` in [0, 1]: activations of the codec's decoder network on the image's own code.

    The codec's encoder is one linear map of 2x2 pixels; what the codec has learned about images lies in the decoder network, which
    was trained to restore what the code lost. Its stages (the first convolution and each residual block) are the features, for
    the image at full, half and quarter size. Depth and classes are withheld, as in a part of the codec's training.

    Returns (from ``forward``):
        Per size, largest first, and per stage one tensor ``[C, h, w]``.
    """

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


class LpipsFeatures(nn.Module):
    """The AlexNet trunk of LPIPS 0.1 (Zhang et al. 2018) and its weights per channel, from tensors under the usual names.

    Args:
        state: ``net.slice{1..5}.{0,3,6,8,10}.{weight,bias}`` and ``lin{0..4}.model.1.weight``, as the lpips package names
            them; other entries are left alone.
        where: file name for errors.

    Raises:
        InputError: a tensor is missing or has another shape.
    """

    LAYERS: Final = ((0, 64, 3, 11, 4, 2), (3, 192, 64, 5, 1, 2), (6, 384, 192, 3, 1, 1), (8, 256, 384, 3, 1, 1), (10, 256, 256, 3, 1, 1))
    """Place in the trunk, channels out and in, kernel, stride, padding."""
    POOLED: Final = (1, 2)
    """Layers before which 3x3 maxima are taken at every second place."""
    SHIFT: Final = (-0.030, -0.088, -0.188)
    SCALE: Final = (0.458, 0.448, 0.450)
    SMALLEST_PX: Final = 31

    def __init__(self, state: Mapping[str, Tensor], where: str = "LPIPS weights") -> None:
        super().__init__()
        self.register_buffer("shift", torch.tensor(self.SHIFT).view(1, 3, 1, 1))
        self.register_buffer("scale", torch.tensor(self.SCALE).view(1, 3, 1, 1))
        for stage, (place, out, into, size, _, _) in enumerate(self.LAYERS):
            named = f"net.slice{stage + 1}.{place}"
            self.register_buffer(f"kernel{stage}", _tensor(state, f"{named}.weight", (out, into, size, size), where))
            self.register_buffer(f"bias{stage}", _tensor(state, f"{named}.bias", (out,), where))
            weights = _tensor(state, f"lin{stage}.model.1.weight", (1, out, 1, 1), where).flatten()
            self.register_buffer(f"weights{stage}", weights)

    @property
    def channel_weights(self) -> list[Tensor]:
        """Weights per channel, by stage."""
        return [self.get_buffer(f"weights{stage}") for stage in range(len(self.LAYERS))]

    def forward(self, rgb: Tensor) -> list[Tensor]:
        """Features ``[C, h, w]`` of the five stages of an image ``[3, H, W]`` in [0, 1], at least 31 pixels a side."""
        if min(rgb.shape[-2:]) < self.SMALLEST_PX:
            size = f"{rgb.shape[-1]}x{rgb.shape[-2]}"
            raise InputError("an image is too small for LPIPS", expected=f"{self.SMALLEST_PX} pixels a side", got=size)
        x = (rgb[None].clamp(0, 1) * 2 - 1 - self.shift) / self.scale
        features = []
        for stage, (_, _, _, _, stride, padding) in enumerate(self.LAYERS):
            x = F.max_pool2d(x, 3, 2) if stage in self.POOLED else x
            kernel, bias = self.get_buffer(f"kernel{stage}"), self.get_buffer(f"bias{stage}")
            x = F.relu(F.conv2d(x, kernel, bias, stride, padding))
            features.append(x[0])
        return features


def _tensor(state: Mapping[str, Tensor], name: str, shape: tuple[int, ...], where: str) -> Tensor:
    found = state.get(name)
    if found is None or tuple(found.shape) != shape:
        got = "missing" if found is None else str(tuple(found.shape))
        raise InputError("LPIPS weights are incomplete or of another network", where=f"{where}: {name}", expected=str(shape), got=got)
    return found.float()


class PerceptualDistance:
    """``lpips_distance`` of a pair's colours in the features of a network; threads may call it.

    The same truth is compared with one method after another: each thread keeps its features until another truth comes. Pairs come on the
    CPU; what is compared goes to the device of the network here, and the number comes back.
    """

    def __init__(self, features: nn.Module, weights: list[Tensor] | None = None, device: torch.device | None = None) -> None:
        self._device = device or torch.device("cpu")
        self._features = features.to(self._device)
        self._weights = None if weights is None else [weight.to(self._device) for weight in weights]
        self._known = threading.local()

    def __call__(self, pair: Pair) -> float | None:
        """The distance, or None where colour is missing."""
        if pair.rgb is None or pair.truth_rgb is None:
            return None
        with torch.no_grad():
            if getattr(self._known, "image", None) is not pair.truth_rgb:
                self._known.features = unit_features(self._features(pair.truth_rgb.to(self._device)))
                self._known.image = pair.truth_rgb
            made, mask = self._features(pair.rgb.to(self._device)), None if pair.mask is None else pair.mask.to(self._device)
            distance = lpips_distance(made, self._known.features, mask, self._weights, over_weight=True)
            return float(distance)
