"""The latent code of the small models (`PatchCodec`): 2x2 pixel patches, a principal component basis for colour, an
exact basis for log depth, class shares, and a small convolutional decoder that puts back what the basis lost."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import torch
from torch import Tensor, nn
from torch.nn import functional

from mudg.base import palette
from mudg.base.errors import UsageError

Modality = Literal["rgb", "depth", "semantics"]
MODALITIES: tuple[Modality, ...] = ("rgb", "depth", "semantics")
CLASSES = len(palette.CLASSES)
SHIPPED = Path(__file__).resolve().parents[1] / "assets" / "mdm_small"
"""Folder of the diffusion model whose codec stands for all shipped ones."""


@dataclass(frozen=True)
class CodecConfig:
    """How depth is coded, and the size of the decoder."""

    near_m: float = 2.0
    """Depths below are coded as this one."""
    far_m: float = 100.0
    """Depths beyond, and the sky, are coded as this one."""
    decoder_width: int = 32
    decoder_blocks: int = 3

    def __post_init__(self) -> None:
        if not 0 < self.near_m < self.far_m:
            raise UsageError("depth range of the codec is empty", got=f"{self.near_m} .. {self.far_m} m")


@dataclass(frozen=True)
class Decoded:
    """Pixels again: rgb f32[..,3,H,W] in [0,1], depth f32[..,1,H,W] m, semantics i64[..,H,W]."""

    rgb: Tensor
    depth: Tensor
    semantics: Tensor


def depth_to_code(depth_m: Tensor, config: CodecConfig) -> Tensor:
    """Depth in metres to [-1, 1]: its logarithm between near and far."""
    span = math.log(config.far_m / config.near_m)
    return torch.log(depth_m.clamp(config.near_m, config.far_m) / config.near_m) * (2.0 / span) - 1.0


def code_to_depth(code: Tensor, config: CodecConfig) -> Tensor:
    """Inverse of `depth_to_code`; codes outside [-1, 1] are clamped."""
    share = (code.clamp(-1.0, 1.0) + 1.0) * 0.5
    return config.near_m * torch.exp(share * math.log(config.far_m / config.near_m))


class ChannelNorm(nn.LayerNorm):
    """Layer norm over channels of a map [N,C,H,W] that is stored channels-last."""

    def forward(self, x: Tensor) -> Tensor:
        return super().forward(x.permute(0, 2, 3, 1)).permute(0, 3, 1, 2)


def temporal_shift(x: Tensor, frames: int, share: int = 8) -> Tensor:
    """Move 1/share of the channels one frame later and as many one frame earlier; ends keep their own. `x` [B*T,C,h,w].
    The following convolution then mixes neighbouring frames at no cost (Lin et al., "TSM")."""
    n, c, h, w = x.shape
    if frames == 1:
        return x
    k = c // share
    y = x.permute(0, 2, 3, 1).unflatten(0, (n // frames, frames))
    late = torch.cat([y[:, :1, ..., :k], y[:, :-1, ..., :k]], 1)
    early = torch.cat([y[:, 1:, ..., k : 2 * k], y[:, -1:, ..., k : 2 * k]], 1)
    return torch.cat([late, early, y[..., 2 * k :]], -1).flatten(0, 1).permute(0, 3, 1, 2)


class DecoderBlock(nn.Module):
    """norm - temporal shift - conv - SiLU - conv around a residual."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.norm = ChannelNorm(width)
        self.conv1 = nn.Conv2d(width, width, 3, padding=1)
        self.conv2 = nn.Conv2d(width, width, 3, padding=1)
        nn.init.zeros_(self.conv2.weight)

    def forward(self, x: Tensor, frames: int = 1) -> Tensor:
        """[N,width,h,w] -> the same; `frames` neighbouring ones belong together."""
        return x + self.conv2(functional.silu(self.conv1(temporal_shift(self.norm(x), frames))))


class PatchCodec(nn.Module):
    """Codec of the embedded model: linear 2x2 patches, 4 channels for colour and depth, class shares for semantics. The
    colour basis is fitted once by `fit_color`; the decoder is trained by the `learn` verb on the three latents
    together, so that edges agree between modalities; a missing modality is fed as zeros (it is trained with such
    omissions). Depth keeps all four patch values, so its linear part loses nothing."""

    factor = 2
    rgb_mean: Tensor
    rgb_basis: Tensor
    rgb_scale: Tensor
    depth_basis: Tensor
    depth_scale: Tensor

    def __init__(self, config: CodecConfig) -> None:
        super().__init__()
        self.config = config
        self.channels: dict[Modality, int] = {"rgb": 4, "depth": 4, "semantics": CLASSES}
        self.register_buffer("rgb_mean", torch.zeros(12))
        self.register_buffer("rgb_basis", torch.eye(12)[:, :4].contiguous())
        self.register_buffer("rgb_scale", torch.ones(4))
        haar = torch.tensor([[1.0, 1, 1, 1], [1, -1, 1, -1], [1, 1, -1, -1], [1, -1, -1, 1]]) / 2
        self.register_buffer("depth_basis", haar)
        self.register_buffer("depth_scale", torch.tensor([1.0, 0.2, 0.2, 0.2]))
        self.register_buffer("palette", torch.from_numpy(palette.COLORS.copy()).float() / 127.5 - 1.0)  # not read
        width = config.decoder_width
        inside = sum(self.channels.values())
        outside = 12 + 4 + 4 * CLASSES
        self.enter = nn.Conv2d(inside, width, 3, padding=1)
        self.blocks = nn.ModuleList(DecoderBlock(width) for _ in range(config.decoder_blocks))
        self.leave = nn.Conv2d(width, outside, 1)
        nn.init.zeros_(self.leave.weight)
        nn.init.zeros_(self.leave.bias)

    # linear parts ---------------------------------------------------------------------------------

    @torch.no_grad()
    def fit_color(self, rgb: Tensor) -> None:
        """Fit the colour basis (principal components of 2x2 patches) on images f32[N,3,H,W] in [0,1]. The two detail
        channels are scaled down by a further 1.5, so that they do not take a quarter of the loss."""
        patches = functional.pixel_unshuffle(rgb.double() * 2 - 1, 2).permute(0, 2, 3, 1).flatten(0, 2)
        mean = patches.mean(0)
        values, vectors = torch.linalg.eigh((patches - mean).T @ (patches - mean) / len(patches))
        basis = vectors[:, -4:].flip(1)
        basis = basis * torch.where(basis.sum(0) < 0, -1.0, 1.0)
        deviation = values[-4:].flip(0).clamp(min=1e-6).sqrt()
        self.rgb_mean.copy_(mean)
        self.rgb_basis.copy_(basis)
        self.rgb_scale.copy_(deviation * torch.tensor([1.0, 1.2, 1.5, 1.5], dtype=torch.float64))

    @torch.no_grad()
    def fit_depth(self, depth_m: Tensor) -> None:
        """Fit the scale of the depth channels on depth maps f32[N,1,H,W] in metres."""
        code = functional.pixel_unshuffle(depth_to_code(depth_m.double(), self.config), 2)
        z = torch.einsum("nchw,ck->nkhw", code, self.depth_basis.double())
        deviation = z.std((0, 2, 3)).clamp(min=1e-3)
        self.depth_scale.copy_(deviation * torch.tensor([1.0, 1.5, 1.5, 1.5], dtype=torch.float64))

    def encode_rgb(self, rgb: Tensor) -> Tensor:
        """f32[..,3,H,W] in [0,1] -> latent [..,4,H/2,W/2], about unit variance."""
        patches = functional.pixel_unshuffle(rgb * 2 - 1, 2)
        z = torch.einsum("...chw,ck->...khw", patches - self.rgb_mean.view(12, 1, 1), self.rgb_basis)
        return z / self.rgb_scale.view(4, 1, 1)

    def encode_depth(self, depth_m: Tensor) -> Tensor:
        """f32[..,1,H,W] metres -> latent [..,4,H/2,W/2]; exact up to the clamp to [near, far]."""
        patches = functional.pixel_unshuffle(depth_to_code(depth_m, self.config), 2)
        return torch.einsum("...chw,ck->...khw", patches, self.depth_basis) / self.depth_scale.view(4, 1, 1)

    def linear_depth_code(self, depth_m: Tensor) -> Tensor:
        """Depth in metres as the code in [-1,1] that `decode_raw` gives back."""
        return depth_to_code(depth_m, self.config)

    def encode_semantics(self, ids: Tensor) -> Tensor:
        """i64[..,H,W] -> latent [..,19,H/2,W/2]: the share of each class among a patch's labelled pixels, times 2,
        minus its mean over classes; a patch without labels is all zero."""
        return self.shares_to_latent(semantic_shares(ids))

    @staticmethod
    def shares_to_latent(shares: Tensor) -> Tensor:
        """Class shares [..,19,h,w] (sum 1, or 0 where unlabelled) -> centred latent of the same shape."""
        return 2.0 * (shares - shares.mean(-3, keepdim=True))

    # decoding -------------------------------------------------------------------------------------

    def decode_raw(self, latents: dict[Modality, Tensor]) -> tuple[Tensor, Tensor, Tensor]:
        """Decode latents [N,C,h,w] to rgb in [-1,1] [N,3,H,W], depth code [N,1,H,W] and class scores [N,19,H,W]. Not
        clamped; what training of the decoder differentiates."""
        x = torch.cat([latents[m] for m in MODALITIES], 1).contiguous(memory_format=torch.channels_last)
        x = self.enter(x)
        for block in self.blocks:
            x = block(x)
        d_rgb, d_depth, d_scores = self.leave(functional.silu(x)).float().split([12, 4, 4 * CLASSES], 1)
        with torch.autocast(x.device.type, enabled=False):  # half precision would cost a percent of depth
            rgb = torch.einsum("nkhw,ck->nchw", latents["rgb"].float() * self.rgb_scale.view(4, 1, 1), self.rgb_basis)
            scaled = latents["depth"].float() * self.depth_scale.view(4, 1, 1)
            depth = torch.einsum("nkhw,ck->nchw", scaled, self.depth_basis)
        rgb = functional.pixel_shuffle(rgb + self.rgb_mean.view(12, 1, 1) + 0.2 * d_rgb, 2)
        depth = functional.pixel_shuffle(depth + 0.05 * d_depth, 2)
        scores = functional.pixel_shuffle(d_scores, 2)
        return rgb, depth, scores + 4.0 * functional.interpolate(latents["semantics"].float(), scale_factor=2.0)

    def decode(self, latents: dict[Modality, Tensor]) -> Decoded:
        """Pixels of latents [..,C,h,w] of all modalities, with the same leading axes."""
        lead = latents["rgb"].shape[:-3]
        rgb, depth, scores = self.decode_raw({m: z.reshape(-1, *z.shape[-3:]) for m, z in latents.items()})
        made = (((rgb + 1) / 2).clamp(0, 1), code_to_depth(depth, self.config), scores.argmax(1))
        return Decoded(*(x.reshape(*lead, *x.shape[1:]) for x in made))


def semantic_shares(ids: Tensor, factor: int = 2) -> Tensor:
    """Share of each class among the labelled pixels of every factor x factor patch. `ids` i64[..,H,W] ->
    f32[..,19,H/factor,W/factor]; sums to 1 over classes, to 0 where nothing is labelled."""
    lead = ids.shape[:-2]
    cells = functional.pixel_unshuffle(ids.clamp(min=0, max=CLASSES).reshape(-1, 1, *ids.shape[-2:]), factor)
    counts = torch.zeros(len(cells), CLASSES + 1, *cells.shape[-2:], device=ids.device)
    for place in range(factor**2):
        counts.scatter_add_(1, cells[:, place : place + 1], torch.ones_like(counts[:, :1]))
    share = counts[:, :CLASSES]
    return (share / share.sum(1, keepdim=True).clamp(min=1.0)).reshape(*lead, CLASSES, *cells.shape[-2:])
