"""The multi-modal diffusion model: from a sparse, projected point cloud to dense colour, depth and semantic video.

Read from the bottom up: `MDM` holds the codec, the noise schedule and the denoising network, and has three things to do,
`encode_condition`, `loss` and `sample`. The network is in `models.mdm.unet`, the step from latents to pixels in
`models.mdm.refine`, reading and writing in `models.mdm.files`. `MDMConfig` is all that distinguishes one model from another.

The network's input is, per latent cell, [noisy latents of all modalities | colour condition | depth condition | backdrop | masks of
what was seen | classes of the condition]. It states the clean latents of all modalities at once, and may copy the condition's own.

Layouts: conditions and samples [T,C,H,W] of one clip; inside the model [B,T,C,h,w], with (h, w) the latent size; inside
the UNet [B*T,C,h,w] stored channels-last.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import torch
from torch import Tensor, nn
from torch.nn import functional

from mudg.base import palette, seeds
from mudg.base.errors import UsageError
from mudg.base.types import Condition
from mudg.core import noise
from mudg.core.align import align_depth
from mudg.core.noise import Schedule, ScheduleConfig
from mudg.models.diffusion import (
    GeneratedClip,
    SampleRequest,
    check_image_size,
    confidence_of,
    denoised,
    depth_agreement,
    mean_change,
    settle_depth,
    sized_to_area,
    sized_to_width,
)  # fmt: skip
from mudg.models.mdm.codec import (
    CLASSES,
    MODALITIES,
    CodecConfig,
    Decoded,
    Modality,
    PatchCodec,
    code_to_depth,
)  # fmt: skip
from mudg.models.mdm.refine import ConditionPixels, PixelTruth, Refined, Refiner, refine_loss, shares
from mudg.models.mdm.unet import TemporalAttention, UNet

SKY = palette.ID["sky"]


@dataclass(frozen=True, kw_only=True)
class MDMConfig:
    """Everything that fixes a model's function except its weights. What `LearnConfig` states has its default there alone."""

    codec: CodecConfig = CodecConfig()
    schedule: ScheduleConfig = ScheduleConfig()
    patch: int
    """Latent cells per side of one network cell."""
    widths: tuple[int, ...]
    blocks: tuple[int, ...]
    spatial_attention: tuple[bool, ...]
    temporal_attention: tuple[bool, ...]
    head_width: int = 32
    embed_width: int = 192
    refine_widths: tuple[int, ...]
    """Channels of the refiner (see `models.mdm.refine`) at the latent resolution and at half of it; empty = no refiner."""
    refine_blocks: tuple[int, ...]
    window: int
    """Frames per clip the model was made for; other numbers work, only this one is tested."""
    area_px: int
    """Pixels per frame that the model was trained at."""
    shared_noise: float = 0.3
    """Share of the noise variance common to all frames, in training and sampling."""

    def __post_init__(self) -> None:
        levels = {len(self.widths), len(self.blocks), len(self.spatial_attention), len(self.temporal_attention)}
        if len(levels) != 1:
            raise UsageError(
                "widths, blocks and attention switches must have one entry per level", got=f"{sorted(levels)}"
            )
        attended = zip(self.widths, self.spatial_attention, self.temporal_attention)
        if any((spatial or temporal) and width % self.head_width for width, spatial, temporal in attended):
            raise UsageError("a width is no multiple of the attention head width", got=f"{self.widths}")
        if (len(self.refine_widths), len(self.refine_blocks)) not in ((0, 0), (2, 2)):
            raise UsageError(
                "refine_widths and refine_blocks have two entries each, or none", got=str(self.refine_widths)
            )

    @property
    def pixel_multiple(self) -> int:
        """Image sides must be multiples of this many pixels."""
        return 2 * self.patch * 2 ** (len(self.widths) - 1)


# model ----------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class ConditionLatents:
    """A batch of conditions as the network wants them.

    planes f32[B,T,CONDITION_PLANES,h,w]; copy: latents of the condition [B,T,4,h,w] for colour and depth, class shares
    [B,T,19,h,w] for semantics; backdrop: as copy, of the backdrop's colour; seen: share of the cell that is
    trustworthy, [B,T,1,h,w] in [0,1], per modality; pixels: the condition at pixel resolution, [B*T,..].
    """

    planes: Tensor
    copy: dict[Modality, Tensor]
    backdrop: Tensor
    seen: dict[Modality, Tensor]
    pixels: ConditionPixels


@dataclass(frozen=True)
class Losses:
    """Loss of a batch: `total` scalar with gradient; `terms` the weighted parts as floats."""

    total: Tensor
    terms: dict[str, float]


TRUSTED_ERROR = 0.08
"""Expected error of the colour (of 1) at which the confidence is 1/e; models with a refiner."""

COPY_BIAS = 4.0
"""Start value of the copy gates' logits where the cell is seen (minus this for the backdrop); 0 where it is not."""

CONDITION_PLANES = 3 * 4 + 2 * PatchCodec.factor**2 + CLASSES + 1
"""Planes of a condition: latents of colour, depth and backdrop, two masks at pixel resolution, class shares and their sum."""

GATES = 4
"""Outputs that say how much of the condition is copied: its colour, its depth, the backdrop's colour, its classes."""

LOSS_SHARES: dict[Modality, float] = {"rgb": 1.0, "depth": 1.0, "semantics": 0.3}
"""Weights of the modalities in the joint loss."""


class MDM(nn.Module):
    """The multi-modal diffusion model (see the module text). Weights are random until `files.load` or `learn` sets them."""

    points_alone = False
    """The condition is filled, and recorded images are warped into it."""

    def __init__(self, config: MDMConfig) -> None:
        super().__init__()
        self.config = config
        self.codec = PatchCodec(config.codec)
        self.schedule = Schedule(config.schedule)
        noisy = sum(self.codec.channels.values())
        self.net = UNet(config, noisy + CONDITION_PLANES, noisy + GATES).to(memory_format=torch.channels_last)
        self.refiner: Refiner | None = None
        if config.refine_widths:
            (fine, coarse), (outer, inner) = config.refine_widths, config.refine_blocks
            self.refiner = Refiner(noisy, (fine, coarse), (outer, inner)).to(memory_format=torch.channels_last)

    # inputs -----------------------------------------------------------------------------------------------------------

    def check_size(self, height: int, width: int) -> None:
        """UsageError unless an image of this size fits the network's strides."""
        check_image_size(height, width, self.config.pixel_multiple)

    def check_clip(self, frames: int, height: int, width: int) -> None:
        """UsageError unless the model can make clips of this image size; any number of frames will do."""
        del frames
        self.check_size(height, width)

    def encode_condition(self, condition: Condition | Sequence[Condition]) -> ConditionLatents:
        """Latents and mask planes of one clip's condition, or of several of the same shape (see `ConditionLatents`)."""
        batch = [condition] if isinstance(condition, Condition) else list(condition)
        stack = lambda name: torch.stack([getattr(c, name) for c in batch])  # noqa: E731
        warped = torch.stack([torch.zeros_like(c.valid) if c.warped is None else c.warped for c in batch])
        backdrop = torch.stack([c.color if c.backdrop is None else c.backdrop for c in batch])
        unknown = torch.full(batch[0].valid.shape, 255, dtype=torch.uint8)
        ids = torch.stack([unknown if c.semantics is None else c.semantics for c in batch])
        far_ids = torch.stack([unknown if c.backdrop_semantics is None else c.backdrop_semantics for c in batch])
        color, depth, valid, reference = (stack(name) for name in ("color", "depth", "valid", "reference"))
        return self.encode_planes(color, depth, valid, warped, backdrop, reference, ids, far_ids)

    def encode_planes(
        self, color: Tensor, depth: Tensor, valid: Tensor, warped: Tensor, backdrop: Tensor, reference: Tensor, ids: Tensor,
        backdrop_ids: Tensor,
    ) -> ConditionLatents:  # fmt: skip
        """As `encode_condition`, from stacked tensors.

        color, backdrop f32[B,T,3,H,W]; depth f32[B,T,1,H,W] metres; valid, warped bool[B,T,1,H,W]; reference f32[B,3,H,W], used
        only with `reference = "first_frame"`; ids, backdrop_ids u8[B,T,1,H,W], 255 = unknown.
        """
        self.check_size(*color.shape[-2:])
        valid, warped = valid.float(), warped.float()
        factor = self.codec.factor
        pool = lambda m: functional.avg_pool2d(m.flatten(0, 1), factor).unflatten(0, m.shape[:2])  # noqa: E731
        copy: dict[Modality, Tensor] = {
            "rgb": self.codec.encode_rgb(color), "depth": self.codec.encode_depth(depth),
            "semantics": shares(ids.flatten(0, 1)).unflatten(0, ids.shape[:2]),
        }  # fmt: skip
        seen: dict[Modality, Tensor] = {
            "rgb": pool(torch.maximum(valid, warped)), "depth": pool(valid), "semantics": copy["semantics"].sum(2, keepdim=True)
        }  # fmt: skip
        far = self.codec.encode_rgb(backdrop)
        masks = (functional.pixel_unshuffle(m, factor) for m in (valid, warped))
        planes = [copy["rgb"], copy["depth"], far, *masks, copy["semantics"], seen["semantics"]]
        depth_code = self.codec.linear_depth_code(depth)
        pixels = (color * 2 - 1, backdrop * 2 - 1, depth_code, valid, warped, ids, backdrop_ids)
        return ConditionLatents(torch.cat(planes, 2), copy, far, seen, ConditionPixels(*(x.flatten(0, 1) for x in pixels)))

    # network ----------------------------------------------------------------------------------------------------------

    def predict(
        self, x: dict[Modality, Tensor], encoded: ConditionLatents, t: Tensor
    ) -> tuple[dict[Modality, Tensor], Tensor]:
        """One pass of the network over the noisy latents `x` [B,T,C,h,w] of all modalities at steps `t` i64[B].

        Returns the clean latents it states, and the log-shares of the classes [B,T,19,h,w].
        """
        sizes = [x[m].shape[2] for m in MODALITIES]
        out, gates = self.net(torch.cat([*(x[m] for m in MODALITIES), encoded.planes], 2), t).split([sum(sizes), GATES], 2)
        copy_rgb, copy_depth, copy_far, copy_classes = gates.split(1, 2)
        rgb, depth, classes = out.split(sizes, 2)
        rgb = rgb + (copy_rgb + COPY_BIAS * encoded.seen["rgb"]).sigmoid() * encoded.copy["rgb"]
        depth = depth + (copy_depth + COPY_BIAS * encoded.seen["depth"]).sigmoid() * encoded.copy["depth"]
        rgb = rgb + (copy_far - COPY_BIAS * encoded.seen["rgb"]).sigmoid() * encoded.backdrop
        log_shares = (classes + 4.0 * copy_classes.sigmoid() * encoded.copy["semantics"]).log_softmax(2)
        return {"rgb": rgb, "depth": depth, "semantics": self.codec.shares_to_latent(log_shares.exp())}, log_shares

    # training ---------------------------------------------------------------------------------------------------------

    def encode_truth(self, rgb: Tensor, depth: Tensor, semantics: Tensor) -> dict[Modality, Tensor]:
        """Latents of a clip's truth: rgb [B,T,3,H,W], depth [B,T,1,H,W] m, semantics i64[B,T,H,W]."""
        return {
            "rgb": self.codec.encode_rgb(rgb),
            "depth": self.codec.encode_depth(depth),
            "semantics": self.codec.encode_semantics(semantics),
        }

    def loss(
        self,
        truth: dict[Modality, Tensor],
        encoded: ConditionLatents,
        generator: torch.Generator,
        *,
        shares: Tensor | None = None,
        class_weights: Tensor | None = None,
        depth_known: Tensor | None = None,
        pixels: PixelTruth | None = None,
        window: tuple[slice, slice] | None = None,
        first: int = 0,
        whole: int = 0,
    ) -> Losses:
        """Denoising loss of a batch, steps and noise drawn from `generator`.

        truth        latents of `encode_truth`
        shares       class shares [B,T,19,h,w]; needed when semantics are coded as shares
        class_weights  f32[19], weights of the classes in the cross-entropy; None = all 1
        depth_known  f32[B,T,1,h,w] share of the cell with true depth; None = everywhere
        pixels, window  truth at pixel resolution, and the rectangle of latent cells to train the refiner on (None = all);
                     its terms are added, and their gradient reaches the denoiser
        first, whole  these clips are number `first` and following of a batch of `whole` clips (0 = of just these); what is
                     drawn for a clip does not depend on how that batch is divided

        Squared error of x0 (depth: Huber) times 1 + SNR clipped to [1, 5], which is the v-loss with a clip; cross-entropy for class
        shares. Steps are stratified over the batch.
        """
        some = next(iter(truth.values()))
        batch = len(some)
        t = noise.stratified_steps(whole or batch, len(self.schedule), generator)[first : first + batch].to(some.device)
        weight = noise.loss_weight(self.schedule, t).view(-1, 1, 1, 1, 1)
        total: Tensor | float = 0.0
        terms: dict[str, float] = {}
        eps = {m: self._clip_noise(truth[m], generator.initial_seed(), first, m) for m in MODALITIES}
        stated, log_shares = self.predict({m: self.schedule.add_noise(truth[m], eps[m], t) for m in MODALITIES}, encoded, t)
        for m in MODALITIES:
            if m == "semantics":
                if shares is None:
                    raise UsageError("class shares are needed for the semantic loss", where="MDM.loss")
                weighted = shares if class_weights is None else shares * class_weights.view(-1, 1, 1)
                part = -(weighted * log_shares).sum(2).mean()
            elif m == "depth":
                error = functional.huber_loss(stated[m], truth[m], reduction="none", delta=0.2) * 5.0
                known = torch.ones_like(error[:, :, :1]) if depth_known is None else depth_known
                part = (weight * error * known).mean()
            else:
                part = (weight * (stated[m] - truth[m]).square()).mean()
            terms[m] = float(part.detach())
            total = total + LOSS_SHARES[m] * part
        if self.refiner is not None and pixels is not None:
            parts = self._refiner_terms(stated, encoded, pixels, window, class_weights)
            terms |= {name: float(part.detach()) for name, part in parts.items()}
            total = total + sum(parts.values())
        if not isinstance(total, Tensor):
            raise UsageError("nothing to train on", where="MDM.loss")
        return Losses(total, terms)

    def _clip_noise(self, like: Tensor, seed: int, first: int, name: str) -> Tensor:
        """Noise shaped `like` [B,T,C,h,w], clip by clip from seeds of their own: that of clip `first + i` depends on nothing else."""
        shape = (1, *like.shape[1:])
        draws = [
            noise.video_noise(shape, seeds.torch_generator(seed, first + i, name), self.config.shared_noise)
            for i in range(len(like))
        ]
        return torch.cat(draws).to(like.device)

    def _refiner_terms(
        self, stated: dict[Modality, Tensor], encoded: ConditionLatents, truth: PixelTruth, window: tuple[slice, slice] | None,
        class_weights: Tensor | None,
    ) -> dict[str, Tensor]:  # fmt: skip
        frames = encoded.planes.shape[1]
        rows, columns = window or (slice(0, encoded.planes.shape[-2]), slice(0, encoded.planes.shape[-1]))
        latents: dict[Modality, Tensor] = {m: z[..., rows, columns].flatten(0, 1) for m, z in stated.items()}
        factor = self.codec.factor
        tall, wide = (slice(s.start * factor, s.stop * factor) for s in (rows, columns))
        made = self.refine(latents, encoded.pixels.crop(tall, wide), frames)
        codec = self.config.codec
        log_per_code = math.log(codec.far_m / codec.near_m) / 2
        return refine_loss(made, truth.crop(tall, wide), class_weights, log_per_code=log_per_code)

    def refine(self, latents: dict[Modality, Tensor], given: ConditionPixels, frames: int) -> Refined:
        """Pixels from latents [N,C,h,w] of all modalities and the condition (see `models.refine`)."""
        if self.refiner is None:
            raise UsageError("this model has no refiner", where="MDM.refine")
        return self.refiner(self.codec, latents, given, frames)

    def pixel_truth(
        self, rgb: Tensor, depth: Tensor, semantics: Tensor, depth_known: Tensor | None = None
    ) -> PixelTruth:
        """Truth for `loss`: rgb f32[B,T,3,H,W] in [0,1], depth f32[B,T,1,H,W] metres, semantics i64[B,T,H,W], and where the
        depth is true, bool[B,T,1,H,W] (None = everywhere)."""
        code = self.codec.linear_depth_code(depth)
        known = None if depth_known is None else depth_known.float().flatten(0, 1)
        return PixelTruth((rgb * 2 - 1).flatten(0, 1), code.flatten(0, 1), semantics.flatten(0, 1), known)

    def trained_part(self) -> nn.ModuleDict:
        """What training changes once the codec is fixed, by attribute name: the denoiser and, if there is one, the refiner."""
        return nn.ModuleDict({"net": self.net} | ({} if self.refiner is None else {"refiner": self.refiner}))

    def temporal_parameters(self, which: Literal["transformers", "all"]) -> set[str]:
        """Names in `trained_part` of the parameters that mix frames: of the temporal attentions, or of `all` temporal layers.

        This network has no temporal layers with parameters besides its attentions.
        """
        del which
        kinds = {name for name, module in self.trained_part().named_modules() if isinstance(module, TemporalAttention)}
        return {f"{owner}.{name}" for owner in kinds for name, _ in self.trained_part().get_submodule(owner).named_parameters()}

    # sampling ---------------------------------------------------------------------------------------------------------

    @staticmethod
    def check_request(request: SampleRequest) -> None:
        """UsageError for a setting that does not apply to this kind of model, or to the sampler."""
        request.sampler_settings()
        if request.guidance is not None or request.guidance_rescale is not None:
            raise UsageError("only published-type models have guidance", where="guidance, guidance_rescale",
                             got=f"{request.guidance}, {request.guidance_rescale}", remedy="leave them out")  # fmt: skip

    def image_size(self, width: int, height: int, width_px: int = 0) -> tuple[int, int]:
        """Width and height the model works at for a camera of width x height: about the area it was trained at, or about
        `width_px` wide, in the camera's aspect."""
        aspect, multiple = width / height, self.config.pixel_multiple
        if width_px:
            return sized_to_width(width_px, aspect, multiple)
        return sized_to_area(self.config.area_px, aspect, multiple)

    @torch.no_grad()
    def sample(self, condition: Condition, request: SampleRequest) -> GeneratedClip:
        """Generate one clip (see `SampleRequest`).

        The condition has T views; H and W are multiples of `config.pixel_multiple`. Frames of which `request.known` has latents
        keep them. Measured depth (`condition.valid`) replaces generated depth.
        """
        self.check_request(request)
        encoded = self.encode_condition(condition)
        drawn: list[dict[Modality, Tensor]] = []
        change = torch.zeros_like(encoded.seen["rgb"])
        for number in range(request.n_samples):
            latents, moved = self._denoise(encoded, request, number)
            change = torch.maximum(change, moved)
            drawn.append(latents)
        if request.n_samples > 1:
            change = torch.stack([d["rgb"] for d in drawn]).std(0).mean(2, keepdim=True) * 2
        latents = {m: z[0] for m, z in drawn[0].items()}
        with torch.autocast("cpu", torch.bfloat16, enabled=request.bf16):
            if self.refiner is None:
                decoded = self.codec.decode(latents)
                confidence = confidence_of(encoded.seen["rgb"][0], change[0], self.codec.factor)
            else:
                decoded, error = self._decode_refined(latents, encoded.pixels)
                confidence = torch.exp(-error / TRUSTED_ERROR)
                if request.n_samples > 1:
                    confidence = confidence * functional.interpolate(torch.exp(-2.0 * change[0]), size=confidence.shape[-2:])
        depth, fits = decoded.depth, []
        if request.align:
            depth, fits = align_depth(depth, condition.depth, condition.valid)
        confidence = confidence * depth_agreement(depth, condition)
        depth = settle_depth(depth, condition, self.config.codec.far_m)
        return GeneratedClip(decoded.rgb, depth, decoded.semantics, confidence, latents, tuple(fits))

    def _decode_refined(self, latents: dict[Modality, Tensor], given: ConditionPixels) -> tuple[Decoded, Tensor]:
        """Pixels of one clip through the refiner, and the expected error of the colour f32[T,1,H,W] in [0,1]."""
        made = self.refine(latents, given, next(iter(latents.values())).shape[0])
        best = made.scores.softmax(1).topk(2, dim=1)
        margin = best.values[:, :1] - best.values[:, 1:]
        depth = code_to_depth(made.depth_code, self.config.codec)
        rgb = ((made.rgb + 1) / 2).clamp(0, 1)
        return Decoded(rgb, depth, best.indices[:, 0], margin), made.log_error.clamp(-6, 1).exp() / 2

    def _denoise(self, encoded: ConditionLatents, request: SampleRequest, number: int) -> tuple[dict[Modality, Tensor], Tensor]:
        """Draw sample `number` of a clip; returns latents [1,T,C,h,w] and how much the colour's still changed, [1,T,1,h,w]."""
        lead, cell = encoded.planes.shape[:2], encoded.planes.shape[-2:]
        sizes = [self.codec.channels[m] for m in MODALITIES]
        generator = torch.Generator().manual_seed(seeds.key(request.seed, request.index * 64 + number, "sample"))
        draw = lambda: noise.video_noise((*lead, sum(sizes), *cell), generator, self.config.shared_noise)  # noqa: E731
        known = None if request.known is None else torch.cat([request.known[m] for m in MODALITIES], 1)[None]

        def denoise(x: Tensor, t: int) -> Tensor:
            stated, _ = self.predict(dict(zip(MODALITIES, x.split(sizes, 2))), encoded, torch.full((lead[0],), t))
            out = torch.cat([stated[m].float() for m in MODALITIES], 2)
            return out if known is None else torch.cat([known, out[:, known.shape[1] :]], 1)

        with torch.autocast("cpu", torch.bfloat16, enabled=request.bf16):  # around all steps: the weights are converted once
            x, estimates = denoised(denoise, draw, self.schedule, request, "x0")
        color = lambda z: z[:, :, : sizes[0]]  # noqa: E731
        return dict(zip(MODALITIES, x.split(sizes, 2))), mean_change([color(e) for e in estimates], color(x))


def same_denoiser(one: MDMConfig, other: MDMConfig) -> bool:
    """Whether two networks differ at most in their refiners, and in the size they were trained at."""
    without = lambda config: replace(config, refine_widths=(), refine_blocks=(), area_px=0)  # noqa: E731
    return without(one) == without(other)


def with_refiner(before: MDM, config: MDMConfig) -> MDM:
    """A model of `config` with the weights of `before`; a refiner is taken over if `before` has one of the same shape. For
    continuing the training of an earlier, plainer model.

    Raises:
        UsageError: the two differ in more than the refiner and the size trained at.
    """
    if not same_denoiser(before.config, config):
        raise UsageError(
            "the model to continue from is of another kind", expected=str(config), got=str(before.config),
            remedy="give its widths, blocks, attention, patch and window",
        )  # fmt: skip
    model = MDM(config)
    state = model.state_dict()
    kept = {name: old for name, old in before.state_dict().items() if name in state and state[name].shape == old.shape}
    model.load_state_dict({**state, **kept})
    return model
