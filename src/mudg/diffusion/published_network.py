"""The networks of the published model: autoencoder, image-token resampler, and the denoiser, a latent-video UNet.

Source: paper of MuDG; architecture of DynamiCrafter (Xing et al.) with a modality label added.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor, nn
from torch.nn import functional

from mudg.base import palette
from mudg.base.errors import UsageError
from mudg.diffusion.network import sinusoid
from mudg.networks.clip import attend
from mudg.networks.codec import Decoded, Modality

# autoencoder --------------------------------------------------------------------------------------
#
# Rombach et al., "High-resolution image synthesis with latent diffusion models". All modalities pass as three-channel
# images in [-1, 1]: depth as its linear code three times, classes as colours of the palette. No 8-bit step.


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

    @property
    def factor(self) -> int:
        """Pixels per latent cell, along each side."""
        return 2 ** (len(self.multipliers) - 1)


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
    """The codec, with the members that `networks/codec.py` asks for: mean and log-variance of a Gaussian over 4 latent
    channels, 1/8 the size, and back."""

    def __init__(self, config: AutoencoderConfig) -> None:
        super().__init__()
        self.config = config
        self.factor = config.factor
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
        """Scaled latent f32[..,4,H/8,W/8] of images [..,3,H,W] in [-1,1]. With a generator a draw from the posterior
        (noise made on the generator's device), without one its mean."""
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
        """Pixels of scaled latents [..,4,h,w] of all modalities. Depth is the mean of the three channels; a class is
        the nearest palette colour."""
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


# resampler ----------------------------------------------------------------------------------------
#
# From all tokens of the image tower to 16 for each of 16 frames: learned queries read from the image's tokens and from
# each other (Perceiver: Jaegle et al.; in video: Alayrac et al., "Flamingo"). The frames are part of the weights.


@dataclass(frozen=True)
class ResamplerConfig:
    """Sizes; the defaults are the published ones (48,787,456 parameters)."""

    width: int = 1024
    layers: int = 4
    head_width: int = 64
    heads: int = 12
    tokens: int = 16
    """Tokens per frame."""
    frames: int = 16
    image_width: int = 1280
    context_width: int = 1024
    feed_factor: int = 4


class ReadingAttention(nn.Module):
    """Attention of the queries over image tokens and queries together."""

    def __init__(self, config: ResamplerConfig) -> None:
        super().__init__()
        inner = config.heads * config.head_width
        self.heads = config.heads
        self.norm_image, self.norm_queries = nn.LayerNorm(config.width), nn.LayerNorm(config.width)
        self.query = nn.Linear(config.width, inner, bias=False)
        self.key_value = nn.Linear(config.width, 2 * inner, bias=False)
        self.out = nn.Linear(inner, config.width, bias=False)

    def forward(self, image: Tensor, queries: Tensor) -> Tensor:
        """`image` [B,M,C], `queries` [B,N,C] -> [B,N,C]."""
        image, queries = self.norm_image(image), self.norm_queries(queries)
        key, value = self.key_value(torch.cat([image, queries], 1)).chunk(2, -1)
        return self.out(attend(self.query(queries), key, value, self.heads))


class ResamplerLayer(nn.Module):
    """Attention and a feed-forward part, each around a residual."""

    def __init__(self, config: ResamplerConfig) -> None:
        super().__init__()
        hidden = config.feed_factor * config.width
        self.attention = ReadingAttention(config)
        self.feed = nn.Sequential(
            nn.LayerNorm(config.width),
            nn.Linear(config.width, hidden, bias=False),
            nn.GELU(),
            nn.Linear(hidden, config.width, bias=False),
        )

    def forward(self, image: Tensor, queries: Tensor) -> Tensor:
        queries = queries + self.attention(image, queries)
        return queries + self.feed(queries)


class Resampler(nn.Module):
    """The image-token resampler."""

    def __init__(self, config: ResamplerConfig) -> None:
        super().__init__()
        self.config = config
        self.queries = nn.Parameter(torch.zeros(1, config.frames * config.tokens, config.width))
        self.enter = nn.Linear(config.image_width, config.width)
        self.layers = nn.ModuleList(ResamplerLayer(config) for _ in range(config.layers))
        self.leave = nn.Linear(config.width, config.context_width)
        self.norm = nn.LayerNorm(config.context_width)

    def forward(self, features: Tensor) -> Tensor:
        """Features of the image tower [B,257,image_width] -> image tokens [B,frames,tokens,context_width]."""
        image = self.enter(features)
        queries = self.queries.expand(len(features), -1, -1)
        for layer in self.layers:
            queries = layer(image, queries)
        return self.norm(self.leave(queries)).unflatten(1, (self.config.frames, self.config.tokens))


# video unet ---------------------------------------------------------------------------------------


@dataclass(frozen=True)
class VideoUNetConfig:
    """Sizes of the network; the defaults are the published ones (1,440,917,060 parameters)."""

    channels_in: int = 12
    channels_out: int = 4
    width: int = 320
    multipliers: tuple[int, ...] = (1, 2, 4, 4)
    blocks: int = 2
    """Residual blocks per level on the way down; one more on the way up."""
    attention: tuple[bool, ...] = (True, True, True, False)
    """Levels with transformers; the middle always has them."""
    head_width: int = 64
    first_heads: int = 8
    context_width: int = 1024
    dropout: float = 0.1

    def __post_init__(self) -> None:
        if len(self.multipliers) != len(self.attention):
            raise UsageError(
                "multipliers and attention need one entry per level", got=f"{self.multipliers}, {self.attention}"
            )
        if self.width % GROUPS:
            what = "the width is no multiple of the normalisation groups"
            raise UsageError(what, expected=f"multiple of {GROUPS}", got=str(self.width))


class SeededDropout(nn.Module):
    """Dropout that draws for each clip from a seed of its own, `seeds`, which the caller sets before a training step: a
    second computation in the backward pass, or in another division of the batch, draws the same."""

    seeds: tuple[int, ...] = ()

    def __init__(self, share: float) -> None:
        super().__init__()
        self.share = share

    def forward(self, x: Tensor) -> Tensor:
        """[B*n,..] -> the same; the first axis holds the clips one after another."""
        if not self.training or self.share == 0:
            return x
        if not self.seeds or len(x) % len(self.seeds):
            what, remedy = "dropout needs a seed for every clip", "call PublishedMDM.loss, or eval()"
            expected = f"a divisor of {len(x)} seeds"
            raise UsageError(what, where="SeededDropout", expected=expected, got=str(len(self.seeds)), remedy=remedy)
        shape = (len(x) // len(self.seeds), *x.shape[1:])
        draws = [
            torch.rand(shape, generator=torch.Generator(x.device).manual_seed(s), device=x.device) for s in self.seeds
        ]
        return x * (torch.cat(draws) >= self.share).to(x) / (1 - self.share)


Context = tuple[Tensor, Tensor]
"""What cross-attention looks at: caption tokens [B,77,D] and image tokens [B*T,16,D]."""


class Attention(nn.Module):
    """Multi-head attention; with `image`, a second attention over image tokens is added before the output
    projection."""

    def __init__(self, width: int, context_width: int, heads: int, image: bool, dropout: float) -> None:
        super().__init__()
        self.heads = heads
        self.query = nn.Linear(width, width, bias=False)
        self.key = nn.Linear(context_width, width, bias=False)
        self.value = nn.Linear(context_width, width, bias=False)
        self.image_key = nn.Linear(context_width, width, bias=False) if image else None
        self.image_value = nn.Linear(context_width, width, bias=False) if image else None
        self.out = nn.Linear(width, width)
        self.dropout = SeededDropout(dropout)

    def forward(self, tokens: Tensor, context: Context | None = None) -> Tensor:
        """`tokens` [N,L,C]; `context` of the same clips, None for self-attention -> [N,L,C]."""
        query = self.query(tokens)
        if context is None:
            return self.dropout(self.out(attend(query, self.key(tokens), self.value(tokens), self.heads)))
        text, image = context
        repeats = len(tokens) // len(text)
        key, value = (layer(text).repeat_interleave(repeats, 0) for layer in (self.key, self.value))
        mixed = attend(query, key, value, self.heads)
        mixed = mixed + attend(query, self.image_key(image), self.image_value(image), self.heads)
        return self.dropout(self.out(mixed))


class GatedFeedForward(nn.Module):
    """Linear - a * GELU(b) - Linear, hidden width four times the outer one (Shazeer, "GLU variants")."""

    def __init__(self, width: int, dropout: float) -> None:
        super().__init__()
        self.enter = nn.Linear(width, 8 * width)
        self.dropout = SeededDropout(dropout)
        self.out = nn.Linear(4 * width, width)

    def forward(self, x: Tensor) -> Tensor:
        """[N,L,C] -> the same."""
        value, gate = self.enter(x).chunk(2, -1)
        return self.out(self.dropout(value * functional.gelu(gate)))


class TransformerBlock(nn.Module):
    """Attention, attention, feed-forward, each after a layer norm and around a residual."""

    def __init__(self, width: int, heads: int, context_width: int | None, dropout: float) -> None:
        super().__init__()
        self.norm1, self.norm2, self.norm3 = nn.LayerNorm(width), nn.LayerNorm(width), nn.LayerNorm(width)
        self.attention1 = Attention(width, width, heads, False, dropout)
        self.attention2 = Attention(width, context_width or width, heads, context_width is not None, dropout)
        self.feed = GatedFeedForward(width, dropout)

    def forward(self, x: Tensor, context: Context | None = None) -> Tensor:
        """`x` [N,L,C] -> the same."""
        x = x + self.attention1(self.norm1(x))
        x = x + self.attention2(self.norm2(x), context)
        return x + self.feed(self.norm3(x))


def _zero(layer: nn.Module) -> nn.Module:
    for value in layer.parameters():
        nn.init.zeros_(value)
    return layer


class SpatialTransformer(nn.Module):
    """Self-attention over the cells of a frame and cross-attention to caption and image tokens."""

    def __init__(self, width: int, config: VideoUNetConfig) -> None:
        super().__init__()
        self.norm = nn.GroupNorm(GROUPS, width, eps=1e-6)
        self.enter = nn.Linear(width, width)
        self.block = TransformerBlock(width, width // config.head_width, config.context_width, config.dropout)
        self.out = _zero(nn.Linear(width, width))

    def forward(self, x: Tensor, context: Context) -> Tensor:
        """`x` [B*T,C,h,w] -> the same."""
        tokens = self.enter(self.norm(x).flatten(2).transpose(1, 2))
        tokens = self.out(self.block(tokens, context))
        return x + tokens.transpose(1, 2).unflatten(2, x.shape[2:])


class TemporalTransformer(nn.Module):
    """Two self-attentions over the frames of a clip, at every cell for itself."""

    def __init__(self, width: int, inner: int, heads: int, dropout: float, convolution: bool = False) -> None:
        super().__init__()
        self.norm = nn.GroupNorm(GROUPS, width, eps=1e-6)
        self.enter = nn.Conv1d(width, inner, 1) if convolution else nn.Linear(width, inner)
        self.block = TransformerBlock(inner, heads, None, dropout)
        self.out = _zero(nn.Conv1d(inner, width, 1) if convolution else nn.Linear(inner, width))

    def forward(self, x: Tensor, frames: int) -> Tensor:
        """[B*T,C,h,w] -> the same. Normalised over all frames of a clip together."""
        n, c, h, w = x.shape
        video = x.unflatten(0, (n // frames, frames)).transpose(1, 2)
        tokens = self.norm(video).permute(0, 3, 4, 2, 1).reshape(-1, frames, c)
        tokens = functional.linear(tokens, self.enter.weight.flatten(1), self.enter.bias)
        tokens = self.block(tokens)
        tokens = functional.linear(tokens, self.out.weight.flatten(1), self.out.bias)
        return x + tokens.reshape(n // frames, h, w, frames, c).permute(0, 3, 4, 1, 2).reshape(n, c, h, w)


class TemporalConv(nn.Module):
    """norm - SiLU - convolution over three neighbouring frames."""

    def __init__(self, width: int, dropout: float) -> None:
        super().__init__()
        self.norm = nn.GroupNorm(GROUPS, width)
        self.dropout = SeededDropout(dropout)
        self.conv = nn.Conv3d(width, width, (3, 1, 1), padding=(1, 0, 0))

    def forward(self, video: Tensor) -> Tensor:
        """[B,C,T,h,w] -> the same."""
        return self.conv(self.dropout(functional.silu(self.norm(video))))


class ResBlock(nn.Module):
    """norm - SiLU - conv, the embedding added, norm - SiLU - conv, around a residual; then four temporal convolutions
    around another."""

    def __init__(self, inside: int, outside: int, embed: int, dropout: float) -> None:
        super().__init__()
        self.norm1 = nn.GroupNorm(GROUPS, inside)
        self.conv1 = nn.Conv2d(inside, outside, 3, padding=1)
        self.embed = nn.Linear(embed, outside)
        self.norm2 = nn.GroupNorm(GROUPS, outside)
        self.dropout = SeededDropout(dropout)
        self.conv2 = _zero(nn.Conv2d(outside, outside, 3, padding=1))
        self.skip = nn.Conv2d(inside, outside, 1) if inside != outside else nn.Identity()
        self.temporal = nn.ModuleList(TemporalConv(outside, dropout if n else 0.0) for n in range(4))
        _zero(self.temporal[-1].conv)

    def forward(self, x: Tensor, embedding: Tensor, frames: int) -> Tensor:
        """`x` [B*T,inside,h,w], `embedding` [B*T,embed] -> [B*T,outside,h,w]."""
        h = self.conv1(functional.silu(self.norm1(x)))
        h = h + self.embed(functional.silu(embedding))[:, :, None, None]
        h = self.conv2(self.dropout(functional.silu(self.norm2(h))))
        h = self.skip(x) + h
        video = h.unflatten(0, (-1, frames)).transpose(1, 2)
        for conv in self.temporal:
            video = conv(video)
        return h + video.transpose(1, 2).flatten(0, 1)


class Stage(nn.Module):
    """One step down or up the U: a plain convolution (`conv`), or a residual block with its transformers, and what
    enlarges after it."""

    def __init__(
        self,
        inside: int,
        outside: int,
        config: VideoUNetConfig,
        *,
        conv_stride: int = 0,
        attention: bool = False,
        grow: bool = False,
    ) -> None:
        super().__init__()
        self.conv = nn.Conv2d(inside, outside, 3, stride=conv_stride, padding=1) if conv_stride else None
        self.res = None if conv_stride else ResBlock(inside, outside, 4 * config.width, config.dropout)
        self.spatial = SpatialTransformer(outside, config) if attention else None
        heads = outside // config.head_width
        self.temporal = TemporalTransformer(outside, outside, heads, config.dropout) if attention else None
        self.grow = nn.Conv2d(outside, outside, 3, padding=1) if grow else None

    def forward(self, x: Tensor, embedding: Tensor, context: Context, frames: int) -> Tensor:
        """`x` [B*T,inside,h,w] -> [B*T,outside,h',w']."""
        if self.conv is not None:
            return self.conv(x)
        if self.res is not None:
            x = self.res(x, embedding, frames)
        if self.spatial is not None and self.temporal is not None:
            x = self.temporal(self.spatial(x, context), frames)
        if self.grow is not None:
            x = self.grow(functional.interpolate(x, scale_factor=2.0, mode="nearest"))
        return x


class Middle(nn.Module):
    """The bottom of the U: residual block, both transformers, residual block."""

    def __init__(self, width: int, config: VideoUNetConfig) -> None:
        super().__init__()
        self.res1 = ResBlock(width, width, 4 * config.width, config.dropout)
        self.spatial = SpatialTransformer(width, config)
        self.temporal = TemporalTransformer(width, width, width // config.head_width, config.dropout)
        self.res2 = ResBlock(width, width, 4 * config.width, config.dropout)

    def forward(self, x: Tensor, embedding: Tensor, context: Context, frames: int) -> Tensor:
        """[B*T,C,h,w] -> the same."""
        x = self.temporal(self.spatial(self.res1(x, embedding, frames), context), frames)
        return self.res2(x, embedding, frames)


def _embedding(width: int) -> nn.Sequential:
    return nn.Sequential(nn.Linear(width, 4 * width), nn.SiLU(), nn.Linear(4 * width, 4 * width))


class VideoUNet(nn.Module):
    """The denoiser. What modulates the residual blocks is time(t) + label(modality) + fps(rate), all through sinusoids.
    Everything except the temporal layers works on frames, [B*T,C,h,w]. A frame sees the others in the convolutions over
    time inside each residual block, in the temporal transformers, and in `first`, one more of these right after the
    input convolution."""

    def __init__(self, config: VideoUNetConfig) -> None:
        super().__init__()
        self.config = config
        width, top = config.width, len(config.multipliers) - 1
        self.time, self.label, self.fps = _embedding(width), _embedding(width), _embedding(width)
        _zero(self.fps[2])
        inner = config.first_heads * config.head_width
        self.first = TemporalTransformer(width, inner, config.first_heads, config.dropout, convolution=True)
        self.down = nn.ModuleList([Stage(config.channels_in, width, config, conv_stride=1)])
        skips, inside = [width], width
        for level, multiplier in enumerate(config.multipliers):
            for _ in range(config.blocks):
                self.down.append(Stage(inside, multiplier * width, config, attention=config.attention[level]))
                inside = multiplier * width
                skips.append(inside)
            if level < top:
                self.down.append(Stage(inside, inside, config, conv_stride=2))
                skips.append(inside)
        self.middle = Middle(inside, config)
        self.up = nn.ModuleList()
        for level in reversed(range(top + 1)):
            outside = config.multipliers[level] * width
            for number in range(config.blocks + 1):
                grow = level > 0 and number == config.blocks
                self.up.append(
                    Stage(inside + skips.pop(), outside, config, attention=config.attention[level], grow=grow)
                )
                inside = outside
        self.norm = nn.GroupNorm(GROUPS, inside)
        self.leave = _zero(nn.Conv2d(inside, config.channels_out, 3, padding=1))

    def forward(self, x: Tensor, t: Tensor, label: Tensor, fps: Tensor, text: Tensor, image: Tensor) -> Tensor:
        """One denoiser pass. x: [B,T,channels_in,h,w], noisy latent, latent of the colour condition, latent of the
        depth condition. t: i64[B] noise step. label: i64[B] modality. fps: i64[B] frames per second. text: [B,77,D]
        caption tokens. image: [B,T,16,D] image tokens of each frame. Returns velocity [B,T,channels_out,h,w]."""
        batch, frames = x.shape[:2]
        wave = lambda value: sinusoid(value, self.config.width).to(x.dtype)
        embedding = self.time(wave(t)) + self.label(wave(label)) + self.fps(wave(fps))
        embedding = embedding.repeat_interleave(frames, 0)
        context = text, image.flatten(0, 1)
        h = x.flatten(0, 1)
        skips = []
        for number, stage in enumerate(self.down):
            h = stage(h, embedding, context, frames)
            if number == 0:
                h = self.first(h, frames)
            skips.append(h)
        h = self.middle(h, embedding, context, frames)
        for stage in self.up:
            h = stage(torch.cat([h, skips.pop()], 1), embedding, context, frames)
        return self.leave(functional.silu(self.norm(h))).unflatten(0, (batch, frames))
