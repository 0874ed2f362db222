"""Latent codecs: images, depth and semantics to small latent maps and back.

A codec is a module with

    factor                      pixels per latent cell along each axis
    channels                    latent channels of each modality
    encode_rgb(rgb)             f32[..,3,H,W] in [0,1]      -> [..,C,H/f,W/f]
    encode_depth(depth_m)       f32[..,1,H,W] metres        -> [..,C,H/f,W/f]
    encode_semantics(ids)       i64[..,H,W], 255 unlabelled -> [..,C,H/f,W/f]
    decode(latents)             {modality: latent} -> Decoded

`PatchCodec` is the one of the embedded small model: 2x2 pixel patches, a principal component basis for colour, an exact
basis for log depth, class shares for semantics, and a small convolutional decoder that puts back what the basis lost.
The convolutional KL autoencoder of the published model is another row of `CODECS`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal, Protocol

import torch
from torch import Tensor, nn
from torch.nn import functional

from mudg.base import palette
from mudg.base.errors import UsageError

Modality = Literal["rgb", "depth", "semantics"]
MODALITIES: tuple[Modality, ...] = ("rgb", "depth", "semantics")
CLASSES = len(palette.CLASSES)


@dataclass(frozen=True)
class CodecConfig:
    """Which latent codec, and how depth and semantics are coded."""

    kind: Literal["patch", "kl"] = "patch"
    depth_code: Literal["log", "linear"] = "log"
    near_m: float = 2.0
    """Depths below are coded as this one (log code only)."""
    far_m: float = 100.0
    """Depths beyond, and the sky, are coded as this one."""
    semantics_code: Literal["shares", "palette"] = "shares"
    """shares: class shares of a patch, 19 channels, decoded to class scores; palette: the published colour image."""
    decoder_width: int = 32
    decoder_blocks: int = 3

    def __post_init__(self) -> None:
        if not 0 < self.near_m < self.far_m:
            raise UsageError("depth range of the codec is empty", got=f"{self.near_m} .. {self.far_m} m")


@dataclass(frozen=True)
class Decoded:
    """Pixels again: rgb f32[..,3,H,W] in [0,1], depth f32[..,1,H,W] m, semantics i64[..,H,W], margin f32[..,1,H,W].

    `margin` in [0,1] is how clearly the winning class won. A modality that was not given is None.
    """

    rgb: Tensor | None
    depth: Tensor | None
    semantics: Tensor | None
    margin: Tensor | None


class Codec(Protocol):
    """What a diffusion model asks of a codec (see the module text)."""

    config: CodecConfig
    factor: int
    channels: dict[Modality, int]

    def encode_rgb(self, rgb: Tensor) -> Tensor:
        """[...,3,H,W] in [0,1] -> latent [...,C,h,w]."""
        ...

    def encode_depth(self, depth_m: Tensor) -> Tensor:
        """[...,1,H,W] metres -> latent [...,C,h,w]."""
        ...

    def encode_semantics(self, ids: Tensor) -> Tensor:
        """i64[...,H,W] train ids -> latent [...,C,h,w]."""
        ...

    def decode(self, latents: dict[Modality, Tensor]) -> Decoded:
        """Latents [T,C,h,w] of some modalities -> images."""
        ...


def depth_to_code(depth_m: Tensor, config: CodecConfig) -> Tensor:
    """Depth in metres to [-1, 1]: logarithm between near and far, or linear from 0 to far (the published code)."""
    if config.depth_code == "linear":
        return depth_m.clamp(0.0, config.far_m) * (2.0 / config.far_m) - 1.0
    span = math.log(config.far_m / config.near_m)
    return torch.log(depth_m.clamp(config.near_m, config.far_m) / config.near_m) * (2.0 / span) - 1.0


def code_to_depth(code: Tensor, config: CodecConfig) -> Tensor:
    """Inverse of `depth_to_code`; codes outside [-1, 1] are clamped."""
    share = (code.clamp(-1.0, 1.0) + 1.0) * 0.5
    if config.depth_code == "linear":
        return share * config.far_m
    return config.near_m * torch.exp(share * math.log(config.far_m / config.near_m))


class ChannelNorm(nn.LayerNorm):
    """Layer norm over channels of a map [N,C,H,W] that is stored channels-last."""

    def forward(self, x: Tensor) -> Tensor:
        return super().forward(x.permute(0, 2, 3, 1)).permute(0, 3, 1, 2)


def temporal_shift(x: Tensor, frames: int, share: int = 8) -> Tensor:
    """Move 1/share of the channels one frame later and as many one frame earlier; ends keep their own.

    `x` [B*T,C,h,w]. The following convolution then mixes neighbouring frames at no cost (Lin et al., "TSM").
    """
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
    """Codec of the embedded model: linear 2x2 patches, 4 channels for colour and depth, class shares for semantics.

    The colour basis is fitted once by `fit_colour`; the decoder is trained by the `learn` verb on the three latents
    together, so that edges agree between modalities; a missing modality is fed as zeros (it is trained with such
    omissions). Depth keeps all four patch values, so its linear part loses nothing.
    """

    factor = 2
    rgb_mean: Tensor
    rgb_basis: Tensor
    rgb_scale: Tensor
    depth_basis: Tensor
    depth_scale: Tensor

    def __init__(self, config: CodecConfig) -> None:
        super().__init__()
        self.config = config
        semantic = CLASSES if config.semantics_code == "shares" else 4
        self.channels: dict[Modality, int] = {"rgb": 4, "depth": 4, "semantics": semantic}
        self.register_buffer("rgb_mean", torch.zeros(12))
        self.register_buffer("rgb_basis", torch.eye(12)[:, :4].contiguous())
        self.register_buffer("rgb_scale", torch.ones(4))
        haar = torch.tensor([[1.0, 1, 1, 1], [1, -1, 1, -1], [1, 1, -1, -1], [1, -1, -1, 1]]) / 2
        self.register_buffer("depth_basis", haar)
        self.register_buffer("depth_scale", torch.tensor([1.0, 0.2, 0.2, 0.2]))
        self.register_buffer("palette", torch.from_numpy(palette.COLORS.copy()).float() / 127.5 - 1.0)
        width = config.decoder_width
        inside = sum(self.channels.values())
        outside = 12 + 4 + 4 * CLASSES
        self.enter = nn.Conv2d(inside, width, 3, padding=1)
        self.blocks = nn.ModuleList(DecoderBlock(width) for _ in range(config.decoder_blocks))
        self.leave = nn.Conv2d(width, outside, 1)
        nn.init.zeros_(self.leave.weight)
        nn.init.zeros_(self.leave.bias)  # type: ignore[arg-type]

    # linear parts -----------------------------------------------------------------------------------------------------

    @torch.no_grad()
    def fit_colour(self, rgb: Tensor) -> None:
        """Fit the colour basis (principal components of 2x2 patches) on images f32[N,3,H,W] in [0,1].

        The two detail channels are scaled down by a further 1.5, so that they do not take a quarter of the loss.
        """
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
        """i64[..,H,W] -> latent [..,C,H/2,W/2].

        "shares": the share of each class among a patch's labelled pixels, times 2, minus its mean over classes; a patch
        without labels is all zero. "palette": the colours of the published table coded like an image.
        """
        if self.config.semantics_code == "palette":
            image = self.palette[ids.clamp(max=CLASSES - 1)].movedim(-1, -3)  # type: ignore[index]
            return self.encode_rgb((image + 1) / 2)
        return self.shares_to_latent(semantic_shares(ids))

    @staticmethod
    def shares_to_latent(shares: Tensor) -> Tensor:
        """Class shares [..,19,h,w] (sum 1, or 0 where unlabelled) -> centred latent of the same shape."""
        return 2.0 * (shares - shares.mean(-3, keepdim=True))

    # decoding ---------------------------------------------------------------------------------------------------------

    def decode_raw(self, latents: dict[Modality, Tensor]) -> tuple[Tensor, Tensor, Tensor]:
        """Decode latents [N,C,h,w] to rgb in [-1,1] [N,3,H,W], depth code [N,1,H,W] and class scores [N,19,H,W].

        Not clamped; what training of the decoder differentiates. Missing modalities are zeros.
        """
        some = next(iter(latents.values()))
        n, _, h, w = some.shape
        full = {m: latents.get(m, some.new_zeros(n, c, h, w)) for m, c in self.channels.items()}
        x = torch.cat([full[m] for m in MODALITIES], 1).contiguous(memory_format=torch.channels_last)
        x = self.enter(x)
        for block in self.blocks:
            x = block(x)
        d_rgb, d_depth, d_scores = self.leave(functional.silu(x)).float().split([12, 4, 4 * CLASSES], 1)
        with torch.autocast(some.device.type, enabled=False):  # half precision would cost a percent of depth
            rgb = torch.einsum("nkhw,ck->nchw", full["rgb"].float() * self.rgb_scale.view(4, 1, 1), self.rgb_basis)
            depth = torch.einsum(
                "nkhw,ck->nchw", full["depth"].float() * self.depth_scale.view(4, 1, 1), self.depth_basis
            )
        rgb = functional.pixel_shuffle(rgb + self.rgb_mean.view(12, 1, 1) + 0.2 * d_rgb, 2)
        depth = functional.pixel_shuffle(depth + 0.05 * d_depth, 2)
        scores = functional.pixel_shuffle(d_scores, 2)
        if self.config.semantics_code == "shares":
            scores = scores + 4.0 * functional.interpolate(full["semantics"].float(), scale_factor=2.0)
        return rgb, depth, scores

    def decode(self, latents: dict[Modality, Tensor]) -> Decoded:
        """Decode whatever latents [..,C,h,w] are given (same leading axes). See `Decoded`."""
        lead = next(iter(latents.values())).shape[:-3]
        flat: dict[Modality, Tensor] = {m: z.reshape(-1, *z.shape[-3:]) for m, z in latents.items()}
        rgb, depth, scores = self.decode_raw(flat)
        out_rgb = ((rgb + 1) / 2).clamp(0, 1).reshape(*lead, *rgb.shape[1:]) if "rgb" in latents else None
        out_depth = code_to_depth(depth, self.config).reshape(*lead, *depth.shape[1:]) if "depth" in latents else None
        if "semantics" not in latents:
            return Decoded(out_rgb, out_depth, None, None)
        if self.config.semantics_code == "palette":
            z = flat["semantics"].float() * self.rgb_scale.view(4, 1, 1)
            image = torch.einsum("nkhw,ck->nchw", z, self.rgb_basis) + self.rgb_mean.view(12, 1, 1)
            colours = functional.pixel_shuffle(image, 2).permute(0, 2, 3, 1)
            scores = (
                -torch.cdist(colours.flatten(0, 2), self.palette).unflatten(0, colours.shape[:3]).permute(0, 3, 1, 2)
            )  # type: ignore[arg-type]
        best = scores.softmax(1).topk(2, dim=1)
        margin = best.values[:, :1] - best.values[:, 1:]
        size = scores.shape[-2:]
        return Decoded(out_rgb, out_depth, best.indices[:, 0].reshape(*lead, *size), margin.reshape(*lead, 1, *size))


def semantic_shares(ids: Tensor, factor: int = 2) -> Tensor:
    """Share of each class among the labelled pixels of every factor x factor patch.

    `ids` i64[..,H,W] -> f32[..,19,H/factor,W/factor]; sums to 1 over classes, to 0 where nothing is labelled.
    """
    lead = ids.shape[:-2]
    cells = functional.pixel_unshuffle(ids.clamp(min=0, max=CLASSES).reshape(-1, 1, *ids.shape[-2:]), factor)
    counts = torch.zeros(len(cells), CLASSES + 1, *cells.shape[-2:], device=ids.device)
    for place in range(factor**2):
        counts.scatter_add_(1, cells[:, place : place + 1], torch.ones_like(counts[:, :1]))
    share = counts[:, :CLASSES]
    return (share / share.sum(1, keepdim=True).clamp(min=1.0)).reshape(*lead, CLASSES, *cells.shape[-2:])


CODECS: dict[str, type[PatchCodec]] = {"patch": PatchCodec}


def build_codec(config: CodecConfig) -> PatchCodec:
    """The codec that `config.kind` names; UsageError lists what there is."""
    if config.kind not in CODECS:
        raise UsageError(
            f"the latent codec {config.kind!r} is not available in this version",
            expected="one of " + ", ".join(CODECS),
            got=config.kind,
        )
    return CODECS[config.kind](config)
