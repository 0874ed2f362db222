"""The KL autoencoder of the published model: images to latents of 1/8 the size and back.

A convolutional encoder gives mean and log-variance of a Gaussian over 4 latent channels; a decoder inverts it (Rombach
et al., "High-resolution image synthesis with latent diffusion models"). Colour, depth and semantics all pass as
three-channel images in [-1, 1]: depth as its linear code repeated three times, classes as colours of the published
palette. No 8-bit step.

As a codec it has the members that `networks/codec.py` asks for; frames go through a few at a time.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor, nn
from torch.nn import functional

from mudg.base import palette
from mudg.networks.codec import Decoded, Modality

GROUPS = 32
LATENT_SCALE = 0.18215
"""Factor from autoencoder latents to those the diffusion model sees, which have about unit variance."""


@dataclass(frozen=True)
class AutoencoderConfig:
    """Sizes of the autoencoder; the defaults are the published ones (83,653,863 parameters)."""

    width: int = 128
    multipliers: tuple[int, ...] = (1, 2, 4, 4)
    blocks: int = 2
    latent_channels: int = 4
    far_m: float = 100.0
    """Depths are coded linearly from 0 to this distance; the sky is this far."""
    posterior: Literal["sample", "mean"] = "sample"
    """What encoding gives: a draw from the posterior, as in the published training and inference, or its mean."""


class Block(nn.Module):
    """norm - swish - conv, twice, around a residual."""

    def __init__(self, inside: int, outside: int) -> None:
        super().__init__()
        self.norm1 = nn.GroupNorm(GROUPS, inside, eps=1e-6)
        self.conv1 = nn.Conv2d(inside, outside, 3, padding=1)
        self.norm2 = nn.GroupNorm(GROUPS, outside, eps=1e-6)
        self.conv2 = nn.Conv2d(outside, outside, 3, padding=1)
        self.skip = nn.Conv2d(inside, outside, 1) if inside != outside else nn.Identity()

    def forward(self, x: Tensor) -> Tensor:
        """[N,inside,h,w] -> [N,outside,h,w]."""
        h = self.conv1(functional.silu(self.norm1(x)))
        return self.skip(x) + self.conv2(functional.silu(self.norm2(h)))


class CellAttention(nn.Module):
    """Single-head self-attention over the cells of a map."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.norm = nn.GroupNorm(GROUPS, width, eps=1e-6)
        self.query, self.key, self.value, self.out = (nn.Conv2d(width, width, 1) for _ in range(4))

    def forward(self, x: Tensor) -> Tensor:
        """[N,C,h,w] -> the same."""
        normed = self.norm(x)
        q, k, v = (
            layer(normed).flatten(2).transpose(1, 2).unsqueeze(1) for layer in (self.query, self.key, self.value)
        )
        mixed = functional.scaled_dot_product_attention(q, k, v)[:, 0]
        return x + self.out(mixed.transpose(1, 2).unflatten(2, x.shape[2:]))


class CoderMiddle(nn.Module):
    """block - attention - block."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.block1, self.attention, self.block2 = Block(width, width), CellAttention(width), Block(width, width)

    def forward(self, x: Tensor) -> Tensor:
        """[N,C,h,w] -> the same."""
        return self.block2(self.attention(self.block1(x)))


class Level(nn.Module):
    """The blocks of one resolution and the convolution that leaves it (`scale`)."""

    def __init__(self, inside: int, outside: int, blocks: int, scale: nn.Module | None) -> None:
        super().__init__()
        self.blocks = nn.ModuleList(Block(inside if n == 0 else outside, outside) for n in range(blocks))
        self.scale = scale


class Encoder(nn.Module):
    """Image [N,3,H,W] in [-1,1] -> [N,2*latent,H/8,W/8]."""

    def __init__(self, config: AutoencoderConfig) -> None:
        super().__init__()
        width, top = config.width, len(config.multipliers) - 1
        self.enter = nn.Conv2d(3, width, 3, padding=1)
        self.down = nn.ModuleList()
        inside = width
        for level, multiplier in enumerate(config.multipliers):
            outside = multiplier * width
            shrink = nn.Conv2d(outside, outside, 3, stride=2) if level < top else None
            self.down.append(Level(inside, outside, config.blocks, shrink))
            inside = outside
        self.middle = CoderMiddle(inside)
        self.norm = nn.GroupNorm(GROUPS, inside, eps=1e-6)
        self.leave = nn.Conv2d(inside, 2 * config.latent_channels, 3, padding=1)

    def forward(self, x: Tensor) -> Tensor:
        h = self.enter(x)
        for level in self.down:
            for block in level.blocks:
                h = block(h)
            if level.scale is not None:
                h = level.scale(functional.pad(h, (0, 1, 0, 1)))
        return self.leave(functional.silu(self.norm(self.middle(h))))


class Decoder(nn.Module):
    """Latent [N,latent,h,w] -> image [N,3,8h,8w], about [-1,1]."""

    def __init__(self, config: AutoencoderConfig) -> None:
        super().__init__()
        inside = config.multipliers[-1] * config.width
        self.enter = nn.Conv2d(config.latent_channels, inside, 3, padding=1)
        self.middle = CoderMiddle(inside)
        levels = []
        for level in reversed(range(len(config.multipliers))):
            outside = config.multipliers[level] * config.width
            grow = nn.Conv2d(outside, outside, 3, padding=1) if level > 0 else None
            levels.insert(0, Level(inside, outside, config.blocks + 1, grow))
            inside = outside
        self.up = nn.ModuleList(levels)
        self.norm = nn.GroupNorm(GROUPS, inside, eps=1e-6)
        self.leave = nn.Conv2d(inside, 3, 3, padding=1)

    def forward(self, z: Tensor) -> Tensor:
        h = self.middle(self.enter(z))
        for level in reversed(self.up):
            for block in level.blocks:
                h = block(h)
            if level.scale is not None:
                h = level.scale(functional.interpolate(h, scale_factor=2.0, mode="nearest"))
        return self.leave(functional.silu(self.norm(h)))


class Autoencoder(nn.Module):
    """The codec (see the module text)."""

    def __init__(self, config: AutoencoderConfig) -> None:
        super().__init__()
        self.config = config
        self.factor = 2 ** (len(config.multipliers) - 1)
        self.encoder, self.decoder = Encoder(config), Decoder(config)
        self.to_moments = nn.Conv2d(2 * config.latent_channels, 2 * config.latent_channels, 1)
        self.from_latent = nn.Conv2d(config.latent_channels, config.latent_channels, 1)

    @property
    def dtype(self) -> torch.dtype:
        """Number format of the weights."""
        return self.to_moments.weight.dtype

    # images and latents ---------------------------------------------------------------------------

    def moments(self, image: Tensor) -> tuple[Tensor, Tensor]:
        """Mean and log-variance, each [N,4,H/8,W/8], of images [N,3,H,W] in [-1,1]; not scaled."""
        mean, log_variance = self.to_moments(self.encoder(image.to(self.dtype))).float().chunk(2, 1)
        return mean, log_variance.clamp(-30.0, 20.0)

    def encode(self, image: Tensor, generator: torch.Generator | None = None, frames_at_once: int = 1) -> Tensor:
        """Scaled latent f32[..,4,H/8,W/8] of images [..,3,H,W] in [-1,1].

        With a generator a draw from the posterior (noise made on the generator's device), without one its mean.
        """
        lead = image.shape[:-3]
        parts = []
        for part in image.reshape(-1, *image.shape[-3:]).split(frames_at_once):
            mean, log_variance = self.moments(part)
            if generator is not None:
                draw = torch.randn(mean.shape, generator=generator, device=generator.device)
                mean = mean + (0.5 * log_variance).exp() * draw.to(mean)
            parts.append(mean)
        z = torch.cat(parts) * LATENT_SCALE
        return z.reshape(*lead, *z.shape[1:])

    def decode_image(self, z: Tensor, frames_at_once: int = 1) -> Tensor:
        """Images f32[..,3,H,W], about [-1,1], of scaled latents [..,4,H/8,W/8], a few frames at a time."""
        lead = z.shape[:-3]
        flat = (z.reshape(-1, *z.shape[-3:]) / LATENT_SCALE).to(self.dtype)
        image = torch.cat([self.decoder(self.from_latent(part)).float() for part in flat.split(frames_at_once)])
        return image.reshape(*lead, *image.shape[1:])

    # modalities -----------------------------------------------------------------------------------

    def depth_image(self, depth_m: Tensor) -> Tensor:
        """Depth [..,1,H,W] metres -> image [..,3,H,W]: 0..100 m to [-1,1], three times."""
        code = depth_m.clamp(0.0, self.config.far_m) * (2.0 / self.config.far_m) - 1.0
        return code.expand(*depth_m.shape[:-3], 3, *depth_m.shape[-2:])

    def semantic_image(self, ids: Tensor) -> Tensor:
        """Train ids i64[..,H,W] -> palette colours [..,3,H,W] in [-1,1]; unlabelled pixels are black."""
        table = torch.zeros(256, 3)
        table[: len(palette.COLORS)] = torch.from_numpy(palette.COLORS.copy()).float()
        return (table.to(ids.device)[ids.clamp(0, 255)] / 127.5 - 1.0).movedim(-1, -3)

    def decode(self, latents: dict[Modality, Tensor], frames_at_once: int = 1) -> Decoded:
        """Pixels of scaled latents [..,4,h,w] of all modalities.

        Depth is the mean of the three channels; a class is the nearest palette colour.
        """
        images = {m: self.decode_image(z, frames_at_once).clamp(-1.0, 1.0) for m, z in latents.items()}
        depth = (images["depth"].mean(-3, keepdim=True).clamp(-1.0, 1.0) + 1.0) * 0.5 * self.config.far_m
        return Decoded((images["rgb"] + 1) / 2, depth, nearest_class(images["semantics"]))

    def decode_rgb(self, z: Tensor, frames_at_once: int = 1) -> Tensor:
        """Colour f32[..,3,H,W] in [0,1] of its scaled latents."""
        return (self.decode_image(z, frames_at_once).clamp(-1.0, 1.0) + 1) / 2


def nearest_class(image: Tensor) -> Tensor:
    """Class i64[..,H,W] of palette images [..,3,H,W] in [-1,1]."""
    table = torch.from_numpy(palette.COLORS.copy()).float().to(image.device) / 127.5 - 1.0
    frames = image.reshape(-1, *image.shape[-3:])
    ids = [torch.cdist(frame.flatten(1).T.contiguous(), table).argmin(1) for frame in frames]
    return torch.stack(ids).reshape(*image.shape[:-3], *image.shape[-2:])
