"""The multi-modal diffusion model: from a sparse, projected point cloud to dense colour, depth and semantic video.

Read from the bottom up: `MDM` holds the codec, the noise schedule and the denoising network, and has three things to do,
`encode_condition`, `loss` and `sample`. The network is in `models.unet`, the step from latents to pixels in
`models.refine`. `MDMConfig` is all that distinguishes one model from another.

The network's input is, per latent cell, [noisy latent | latent of the colour condition | latent of the depth condition],
12 channels in the published model, with optional mask planes after them. What it denoises is chosen by the modality label
(colour 0, semantics 1, depth 500, as published), or, with `joint`, all modalities at once.

Layouts: conditions and samples [T,C,H,W] of one clip; inside the model [B,T,C,h,w], with (h, w) the latent size; inside
the UNet [B*T,C,h,w] stored channels-last.
"""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import torch
from torch import Tensor, nn
from torch.nn import functional

from mudg.base import palette, seeds, store
from mudg.base.errors import InputError, IntegrityError, UsageError
from mudg.base.types import Clip, Condition
from mudg.core import losses, noise
from mudg.core.align import DepthFit, align_depth
from mudg.core.noise import Schedule, ScheduleConfig
from mudg.models.mdm.codec import (
    CLASSES,
    MODALITIES,
    CodecConfig,
    Decoded,
    Modality,
    build_codec,
    code_to_depth,
    semantic_shares,
)  # fmt: skip
from mudg.models.mdm.refine import ConditionPixels, PixelTruth, Refined, Refiner, shares
from mudg.models.mdm.unet import TemporalAttention, UNet

SKY = palette.ID["sky"]
LABELS: dict[Modality, int] = {"rgb": 0, "semantics": 1, "depth": 500}
"""Modality labels of the published checkpoints; fed through a sinusoid like a time step."""

SHOWN_LABEL_JOINT = 0


@dataclass(frozen=True)
class MDMConfig:
    """Everything that fixes a model's function except its weights."""

    codec: CodecConfig = CodecConfig()
    schedule: ScheduleConfig = ScheduleConfig()
    joint: bool = True
    """One pass denoises all modalities together; otherwise one pass per modality, told apart by its label."""
    head: Literal["x0", "v"] = "x0"
    """Meaning of the network's output."""
    copy_condition: bool = True
    """x0 head only: the output is added to the condition's own latent, times a gate that the network predicts."""
    backdrop: bool = True
    """Four more input channels: a recorded image carried over as if far away; it can be copied like the condition."""
    mask_planes: Literal["none", "valid", "valid_image"] = "valid_image"
    """Extra input planes: none (12 channels, published), where points were seen, and where a recorded image was warped."""
    reference: Literal["first_frame", "warped", "concatenated", "none"] = "warped"
    """first_frame: the dense reference replaces frame 0 of the colour condition (published); warped: the condition
    builder has already warped recorded images into every frame; concatenated: four more planes hold its latent in every
    frame; none: it is not used."""
    patch: int = 2
    """Latent cells per side of one network cell."""
    widths: tuple[int, ...] = (64, 128, 224)
    blocks: tuple[int, ...] = (1, 1, 2)
    spatial_attention: tuple[bool, ...] = (False, True, True)
    temporal_attention: tuple[bool, ...] = (False, False, True)
    head_width: int = 32
    embed_width: int = 192
    given_classes: bool = True
    """The condition's classes (255 = unknown) are read, and can be copied. Without: 20 input planes fewer."""
    refine_widths: tuple[int, ...] = (64, 128)
    """Channels of the refiner (see `models.refine`) at the latent resolution and at half of it; empty = no refiner."""
    refine_blocks: tuple[int, ...] = (2, 3)
    window: int = 8
    """Frames per clip the model was made for; other numbers work, only this one is tested."""
    area_px: int = 192 * 128
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
        if self.joint is False and self.codec.semantics_code != "palette":
            raise UsageError(
                "separate passes need all modalities in the same latent shape",
                expected="codec.semantics_code = palette",
                got=self.codec.semantics_code,
            )
        if self.backdrop and not self.copy_condition:
            raise UsageError("a backdrop is only used together with copy_condition")
        if self.given_classes and not (self.joint and self.copy_condition and self.codec.semantics_code == "shares"):
            raise UsageError("given classes are only read by a joint model with class shares that copies its condition")
        if (len(self.refine_widths), len(self.refine_blocks)) not in ((0, 0), (2, 2)):
            raise UsageError(
                "refine_widths and refine_blocks have two entries each, or none", got=str(self.refine_widths)
            )
        if self.refine_widths and not (self.joint and self.head == "x0" and self.codec.semantics_code == "shares"):
            raise UsageError("a refiner needs a joint model with an x0 head and class shares")
        if self.head == "v" and (self.copy_condition or self.codec.semantics_code != "palette"):
            raise UsageError("a v head can neither copy the condition nor give class scores", expected="head = x0")

    @property
    def pixel_multiple(self) -> int:
        """Image sides must be multiples of this many pixels."""
        return 2 * self.patch * 2 ** (len(self.widths) - 1)


def config_to_dict(config: MDMConfig) -> dict[str, Any]:
    """Plain JSON values of a configuration."""
    return dataclasses.asdict(config)


def config_from_dict(values: Mapping[str, Any], where: str = "model configuration") -> MDMConfig:
    """Inverse of `config_to_dict`; unknown or missing keys are an InputError that names them."""

    def strict(cls: Any, given: Any, path: str) -> dict[str, Any]:
        known = {f.name for f in dataclasses.fields(cls)}
        if not isinstance(given, Mapping) or set(given) != known:
            names = set(given) if isinstance(given, Mapping) else set()
            raise InputError(
                "a model configuration has other fields than this version knows",
                where=f"{where}: {path}",
                expected=", ".join(sorted(known)),
                got="missing " + ", ".join(sorted(known - names)) + "; unknown " + ", ".join(sorted(names - known)),
            )
        return {k: tuple(v) if isinstance(v, list) else v for k, v in given.items()}

    top = strict(MDMConfig, values, "top")
    top["codec"] = CodecConfig(**strict(CodecConfig, top["codec"], "codec"))
    top["schedule"] = ScheduleConfig(**strict(ScheduleConfig, top["schedule"], "schedule"))
    try:
        return MDMConfig(**top)
    except TypeError as error:
        raise InputError("a model configuration has a value of a wrong type", where=where, got=str(error)) from error


# model ----------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Encoded:
    """A batch of conditions as the network wants them.

    planes f32[B,T,8+backdrop+masks+classes,h,w]; copy: latents of the condition [B,T,4,h,w] for colour and depth, class
    shares [B,T,19,h,w] for semantics; backdrop: as copy, of the backdrop's colour, or None; seen: share of the cell that is
    trustworthy, [B,T,1,h,w] in [0,1], per modality; pixels: the condition at pixel resolution, [B*T,..].
    """

    planes: Tensor
    copy: dict[Modality, Tensor]
    backdrop: Tensor | None
    seen: dict[Modality, Tensor]
    pixels: ConditionPixels


@dataclass(frozen=True)
class Sample:
    """A generated clip.

    rgb f32[T,3,H,W] in [0,1]; depth f32[T,1,H,W] metres; semantics i64[T,H,W]; confidence f32[T,1,H,W] in [0,1]; modalities not asked
    for are None. `latents`: modality -> [T,C,h,w], to be handed to the next window as `known`.
    """

    rgb: Tensor | None
    depth: Tensor | None
    semantics: Tensor | None
    confidence: Tensor
    latents: dict[Modality, Tensor] = field(repr=False)
    depth_fits: tuple[DepthFit, ...] = ()
    """One per frame: how depth was brought to the measured scale; empty if that was not asked for."""


@dataclass(frozen=True)
class BatchPart:
    """Clips number `first` and following of the `count` clips of a training step. Whatever training draws for a clip depends on
    (seed, step, its number), and not on how the step's batch is divided."""

    seed: int
    step: int
    first: int
    count: int


@dataclass(frozen=True)
class LossSettings:
    """What a training run says about the loss.

    class_weights      f32[19], weights of the classes in the cross-entropy; None = all 1
    refined_share      share of each side of the image on which the refiner is trained at a step
    reference_dropout  share of the clips that go without their reference; only of models that leave it out themselves
    """

    class_weights: Tensor | None = None
    refined_share: float = 1.0
    reference_dropout: float = 0.2


@dataclass(frozen=True)
class Truth:
    """Encoded truth of a batch: latents [B,T,C,h,w]; class shares [B,T,19,h,w]; depth_known f32[B,T,1,h,w], share of the cell with
    valid depth; and all of it at pixel resolution."""

    latents: dict[Modality, Tensor]
    shares: Tensor
    depth_known: Tensor
    pixels: PixelTruth


@dataclass(frozen=True)
class Losses:
    """Loss of a batch: `total` scalar with gradient; `terms` the weighted parts as floats."""

    total: Tensor
    terms: dict[str, float]


TRUSTED_ERROR = 0.08
"""Expected error of the colour (of 1) at which the confidence is 1/e; models with a refiner."""

COPY_BIAS = 4.0
"""Start value of the copy gates' logits where the cell is seen (minus this for the backdrop); 0 where it is not."""

LOSS_SHARES: dict[Modality, float] = {"rgb": 1.0, "depth": 1.0, "semantics": 0.3}
"""Weights of the modalities in the joint loss."""


class MDM(nn.Module):
    """The multi-modal diffusion model (see the module text). Weights are random until `load` or `learn` sets them."""

    def __init__(self, config: MDMConfig) -> None:
        super().__init__()
        self.config = config
        self.codec = build_codec(config.codec)
        self.schedule = Schedule(config.schedule)
        self.passes: tuple[tuple[Modality, ...], ...] = (
            (MODALITIES,) if config.joint else tuple((m,) for m in MODALITIES)
        )
        masks = {"none": 0, "valid": 1, "valid_image": 2}[config.mask_planes] * self.codec.factor**2
        noisy = sum(self.codec.channels[m] for m in self.passes[0])
        self.gates = (
            (2 if config.copy_condition else 0) + (1 if config.backdrop else 0) + (1 if config.given_classes else 0)
        )
        concatenated = 4 if config.reference == "concatenated" else 0
        planes = noisy + 8 + (4 if config.backdrop else 0) + masks + concatenated + (CLASSES + 1 if config.given_classes else 0)
        self.net = UNet(config, planes, noisy + self.gates).to(memory_format=torch.channels_last)
        self.refiner: Refiner | None = None
        if config.refine_widths:
            (fine, coarse), (outer, inner) = config.refine_widths, config.refine_blocks
            self.refiner = Refiner(noisy, (fine, coarse), (outer, inner)).to(memory_format=torch.channels_last)

    # inputs -----------------------------------------------------------------------------------------------------------

    def check_size(self, height: int, width: int) -> None:
        """UsageError unless an image of this size fits the network's strides."""
        multiple = self.config.pixel_multiple
        if height % multiple or width % multiple or height < multiple or width < multiple:
            raise UsageError(
                "image size does not fit the diffusion model",
                expected=f"multiples of {multiple} pixels",
                got=f"{width}x{height}",
            )

    def encode_condition(self, condition: Condition | Sequence[Condition]) -> Encoded:
        """Latents and mask planes of one clip's condition, or of several of the same shape (see `Encoded`).

        A condition without warped images, backdrop or classes counts as one with none warped, its own colour as backdrop, and
        unknown classes.
        """
        batch = [condition] if isinstance(condition, Condition) else list(condition)
        color, depth, valid, reference = (
            torch.stack([getattr(c, name) for c in batch]) for name in ("color", "depth", "valid", "reference")
        )
        warped = torch.stack([torch.zeros_like(c.valid) if c.warped is None else c.warped for c in batch])
        backdrop = torch.stack([c.color if c.backdrop is None else c.backdrop for c in batch])
        unknown = torch.full_like(batch[0].valid, palette.UNLABELLED, dtype=torch.uint8)
        ids = torch.stack([unknown if c.semantics is None else c.semantics for c in batch])
        backdrop_ids = torch.stack([unknown if c.backdrop_semantics is None else c.backdrop_semantics for c in batch])
        self.check_size(*color.shape[-2:])
        valid, warped = valid.float(), warped.float()
        if self.config.reference == "first_frame":
            color = torch.cat([reference[:, None], color[:, 1:]], 1)
            warped = torch.cat([torch.ones_like(warped[:, :1]), warped[:, 1:]], 1)
        copy: dict[Modality, Tensor] = {"rgb": self.codec.encode_rgb(color), "depth": self.codec.encode_depth(depth)}
        factor = self.codec.factor
        masks = {"none": [], "valid": [valid], "valid_image": [valid, warped]}[self.config.mask_planes]
        far = self.codec.encode_rgb(backdrop) if self.config.backdrop else None
        planes = [
            copy["rgb"],
            copy["depth"],
            *([] if far is None else [far]),
            *(functional.pixel_unshuffle(m, factor) for m in masks),
        ]
        if self.config.reference == "concatenated":
            planes.append(self.codec.encode_rgb(reference)[:, None].expand(-1, color.shape[1], -1, -1, -1))
        pool = lambda m: functional.avg_pool2d(m.flatten(0, 1), factor).unflatten(0, m.shape[:2])  # noqa: E731
        seen: dict[Modality, Tensor] = {"rgb": pool(torch.maximum(valid, warped)), "depth": pool(valid)}
        if self.config.given_classes:
            copy["semantics"] = shares(ids.flatten(0, 1)).unflatten(0, ids.shape[:2])
            seen["semantics"] = copy["semantics"].sum(2, keepdim=True)
            planes += [copy["semantics"], seen["semantics"]]
        depth_code = self.codec.linear_depth_code(depth)
        pixels = (color * 2 - 1, backdrop * 2 - 1, depth_code, valid, warped, ids, backdrop_ids)
        return Encoded(torch.cat(planes, 2), copy, far, seen, ConditionPixels(*(x.flatten(0, 1) for x in pixels)))

    # network ----------------------------------------------------------------------------------------------------------

    def predict(
        self, x: dict[Modality, Tensor], encoded: Encoded, t: Tensor
    ) -> tuple[dict[Modality, Tensor], Tensor | None]:
        """One pass of the network over the modalities in `x` (noisy latents [B,T,C,h,w]) at steps `t` i64[B].

        Returns the network's statement per modality (x0, or v with a v head), and the log-shares of the classes
        [B,T,19,h,w] if semantics were among them and are coded as shares.
        """
        names = tuple(x)
        sizes = [x[m].shape[2] for m in names]
        label = torch.full_like(t, SHOWN_LABEL_JOINT if len(names) > 1 else LABELS[names[0]])
        out = self.net(torch.cat([*x.values(), encoded.planes], 2), t, label)
        gates = None
        if self.config.copy_condition:
            out, gates = out.split([sum(sizes), self.gates], 2)
        stated = dict(zip(names, out.split(sizes, 2)))
        if gates is not None:
            for channel, m in enumerate(("rgb", "depth")):
                if m in stated:
                    gate = (gates[:, :, channel : channel + 1] + COPY_BIAS * encoded.seen[m]).sigmoid()
                    stated[m] = stated[m] + gate * encoded.copy[m]
            if encoded.backdrop is not None and "rgb" in stated:
                gate = (gates[:, :, 2:3] - COPY_BIAS * encoded.seen["rgb"]).sigmoid()
                stated["rgb"] = stated["rgb"] + gate * encoded.backdrop
            if "semantics" in encoded.copy and "semantics" in stated:
                stated["semantics"] = stated["semantics"] + 4.0 * gates[:, :, -1:].sigmoid() * encoded.copy["semantics"]
        log_shares = None
        if "semantics" in stated and self.config.codec.semantics_code == "shares":
            log_shares = stated["semantics"].log_softmax(2)
            stated["semantics"] = self.codec.shares_to_latent(log_shares.exp())
        return stated, log_shares

    # training ---------------------------------------------------------------------------------------------------------

    def loss(self, clips: Sequence[Clip], part: BatchPart, settings: LossSettings) -> Losses:
        """Denoising loss of clips of one size; all that is drawn comes from `part`.

        x0 head: squared error of x0 (depth: Huber) times 1 + SNR clipped to [1, 5], which is the v-loss with a clip; cross-entropy
        for class shares. v head: squared error of v. Steps are stratified over the batch. Where depth is not valid it has no part.
        With a refiner its terms are added, and their gradient reaches the denoiser.
        """
        with torch.no_grad():
            encoded = self.encode_condition([clip.condition for clip in clips])
            truth = self.encode_truth(clips)
        generator = seeds.torch_generator(part.seed, part.step, "noise")
        steps = noise.stratified_steps(part.count, len(self.schedule), generator)
        t = steps[part.first : part.first + len(clips)].to(truth.shares.device)
        weight = noise.loss_weight(self.schedule, t).view(-1, 1, 1, 1, 1)
        everywhere = torch.ones_like(weight)
        total: Tensor | float = 0.0
        terms: dict[str, float] = {}
        for names in self._drawn_passes(generator):
            eps = {m: self._clip_noise(truth.latents[m], generator.initial_seed(), part.first, m) for m in names}
            x = {m: self.schedule.add_noise(truth.latents[m], eps[m], t) for m in names}
            stated, log_shares = self.predict(x, encoded, t)
            for m in names:
                if m == "semantics" and log_shares is not None:
                    error = losses.share_cross_entropy(log_shares, truth.shares, settings.class_weights)
                elif self.config.head == "v":
                    velocity = self.schedule.velocity(truth.latents[m], eps[m], t)
                    error = losses.latent_error(stated[m], velocity, truth.depth_known if m == "depth" else everywhere)
                elif m == "depth":
                    error = losses.latent_depth_error(stated[m], truth.latents[m], weight, truth.depth_known)
                else:
                    error = losses.latent_error(stated[m], truth.latents[m], weight)
                terms[m] = float(error.detach())
                total = total + LOSS_SHARES[m] * error
            if self.refiner is not None:
                errors = self._refiner_terms(stated, encoded, truth.pixels, part, settings)
                terms |= {name: float(error.detach()) for name, error in errors.items()}
                total = total + sum(errors.values())
        return Losses(total, terms)  # type: ignore[arg-type]

    forward = loss
    """What `DistributedDataParallel` calls, to exchange gradients behind it."""

    def encode_truth(self, clips: Sequence[Clip]) -> Truth:
        """What `loss` compares with."""
        rgb, depth, valid, ids = (
            torch.stack([getattr(clip, name) for clip in clips]) for name in ("rgb", "depth", "depth_valid", "semantics")
        )
        known = valid.float().flatten(0, 1)
        latents: dict[Modality, Tensor] = {
            "rgb": self.codec.encode_rgb(rgb), "depth": self.codec.encode_depth(depth),
            "semantics": self.codec.encode_semantics(ids),
        }  # fmt: skip
        code = self.codec.linear_depth_code(depth)
        pixels = PixelTruth((rgb * 2 - 1).flatten(0, 1), code.flatten(0, 1), ids.flatten(0, 1), known)
        cells = functional.avg_pool2d(known, self.codec.factor).unflatten(0, valid.shape[:2])
        return Truth(latents, semantic_shares(ids), cells, pixels)

    def _clip_noise(self, like: Tensor, seed: int, first: int, name: str) -> Tensor:
        """Noise shaped `like` [B,T,C,h,w], clip by clip from seeds of their own: that of clip `first + i` depends on nothing else."""
        shape = (1, *like.shape[1:])
        draws = [
            noise.video_noise(shape, seeds.torch_generator(seed, first + i, name), self.config.shared_noise)
            for i in range(len(like))
        ]
        return torch.cat(draws).to(like.device)

    def _refiner_terms(
        self, stated: dict[Modality, Tensor], encoded: Encoded, truth: PixelTruth, part: BatchPart, settings: LossSettings
    ) -> dict[str, Tensor]:
        """Weighted terms of the pixel loss in a rectangle of the image; depth in the sky counts threefold."""
        frames, (h, w) = encoded.planes.shape[1], encoded.planes.shape[-2:]
        cells = self._refined_window(part, settings.refined_share, h, w)
        latents: dict[Modality, Tensor] = {m: z[..., cells[0], cells[1]].flatten(0, 1) for m, z in stated.items()}
        factor, codec = self.codec.factor, self.config.codec
        tall, wide = (slice(s.start * factor, s.stop * factor) for s in cells)
        made, truth = self.refine(latents, encoded.pixels.crop(tall, wide), frames), truth.crop(tall, wide)
        log_per_code = math.log(codec.far_m / codec.near_m) / 2 if codec.depth_code == "log" else 1.0
        counted = (1.0 + 2.0 * (truth.ids == SKY).unsqueeze(1)) * truth.depth_known
        error = made.rgb - truth.rgb
        return {
            "pixel_rgb": losses.image_error(error, square=2.0, gradient=0.5),
            "pixel_depth": losses.depth_code_error(made.depth_code, truth.depth_code, counted, log_per_code),
            "pixel_semantics": 0.2 * losses.class_error(made.scores, truth.ids, settings.class_weights),
            "pixel_error": 0.05 * losses.stated_error(made.log_error, error),
        }

    @staticmethod
    def _refined_window(part: BatchPart, share: float, height: int, width: int) -> tuple[slice, slice]:
        """Rows and columns of latent cells on which the refiner is trained at a step: a share of each side, anywhere."""
        rng = seeds.numpy_rng(part.seed, part.step, "refined window")
        spans = []
        for cells in (height, width):
            size = min(cells, max(8, round(cells * share / 8) * 8))
            start = 2 * int(rng.integers((cells - size) // 2 + 1))
            spans.append(slice(start, start + size))
        return spans[0], spans[1]

    def refine(self, latents: dict[Modality, Tensor], given: ConditionPixels, frames: int) -> Refined:
        """Pixels from latents [N,C,h,w] of all modalities and the condition (see `models.refine`)."""
        if self.refiner is None:
            raise UsageError("this model has no refiner", where="MDM.refine")
        return self.refiner(self.codec, latents, given, frames)

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

    def _drawn_passes(self, generator: torch.Generator) -> Sequence[tuple[Modality, ...]]:
        """Joint: the one pass. Separate: one modality per batch, colour half of the time, as published."""
        if self.config.joint:
            return self.passes
        u = float(torch.rand((), generator=generator))
        return [self.passes[0 if u < 0.5 else 1 if u < 0.75 else 2]]

    def condition_latents(self, condition: Condition) -> dict[Modality, Tensor]:
        """The condition as latents [T,C,h,w] of all modalities, to `start` from; classes that are not given are all alike."""
        encoded = self.encode_condition(condition)
        latents = {m: encoded.copy[m][0] for m in ("rgb", "depth")}
        unknown = torch.full_like(condition.valid[:, 0], 255, dtype=torch.long)
        ids = unknown if condition.semantics is None else condition.semantics[:, 0].long()
        return {**latents, "semantics": self.codec.encode_semantics(ids)}  # type: ignore[dict-item]

    # sampling ---------------------------------------------------------------------------------------------------------

    @torch.no_grad()
    def sample(
        self,
        condition: Condition,
        *,
        steps: int = 2,
        seed: int = 0,
        index: int = 0,
        sampler: str = "ddim",
        eta: float = 1.0,
        modalities: Sequence[Modality] = MODALITIES,
        n_samples: int = 1,
        known: Mapping[Modality, Tensor] | None = None,
        start: Mapping[Modality, Tensor] | None = None,
        strength: float = 1.0,
        align: bool = True,
        bf16: bool = False,
    ) -> Sample:
        """Generate one clip.

        condition   T views; H and W multiples of `config.pixel_multiple`
        steps       denoiser passes (per modality unless joint); 1 is the regression of the clip on its condition
        seed, index all noise is drawn from (seed, index): same in, same out
        sampler     a row of `noise.SAMPLERS`
        known       latents [k,C,h,w] of the clip's first k frames, from the previous window: they are kept
        start       latents [T,C,h,w] of all modalities to start from instead of pure noise, for example of the condition
                    (`condition_latents`) or of a render; `strength` in (0, 1] is the share of the schedule that is run
        n_samples   > 1: the first sample is returned, the spread of all lowers the confidence
        align       bring each frame's depth to the measured scale first (`core.align`)
        bf16        run the network in bfloat16

        Measured depth (`condition.valid`) replaces generated depth.
        """
        check_request(sampler, modalities)
        encoded = self.encode_condition(condition)
        passes = self.passes if self.config.joint else tuple((m,) for m in MODALITIES if m in modalities)
        drawn: list[dict[Modality, Tensor]] = []
        change = torch.zeros_like(encoded.seen["rgb"])
        for number in range(n_samples):
            latents: dict[Modality, Tensor] = {}
            for names in passes:
                part, moved = self._denoise(encoded, names, steps, seeds.key(seed, index * 64 + number, "sample"), sampler,
                                            eta, known, start, strength, bf16)  # fmt: skip
                latents |= part
                change = torch.maximum(change, moved)
            drawn.append(latents)
        if n_samples > 1:
            stacked = torch.stack([d.get("rgb", next(iter(d.values()))) for d in drawn])
            change = stacked.std(0).mean(2, keepdim=True) * 2
        latents = {m: z[0] for m, z in drawn[0].items()}
        with torch.autocast("cpu", torch.bfloat16, enabled=bf16):
            if self.refiner is None:
                decoded = self.codec.decode({m: z for m, z in latents.items() if m in modalities})
                confidence = confidence_of(encoded.seen["rgb"][0], change[0], self.codec.factor)
            else:
                decoded, error = self._decode_refined(latents, encoded.pixels)
                confidence = torch.exp(-error / TRUSTED_ERROR)
                if n_samples > 1:
                    confidence = confidence * functional.interpolate(torch.exp(-2.0 * change[0]), size=confidence.shape[-2:])
        depth, ids = decoded.depth, decoded.semantics
        fits: list[DepthFit] = []
        if depth is not None:
            if align:
                depth, fits = align_depth(depth, condition.depth, condition.valid)
            confidence = confidence * depth_agreement(depth, condition)
            depth = settle_depth(depth, condition, self.config.codec.far_m)
        wanted = lambda m, x: x if m in modalities else None  # noqa: E731
        return Sample(
            wanted("rgb", decoded.rgb), wanted("depth", depth), wanted("semantics", ids), confidence, latents, tuple(fits)
        )

    def _decode_refined(self, latents: dict[Modality, Tensor], given: ConditionPixels) -> tuple[Decoded, Tensor]:
        """Pixels of one clip through the refiner, and the expected error of the colour f32[T,1,H,W] in [0,1]."""
        made = self.refine(latents, given, next(iter(latents.values())).shape[0])
        best = made.scores.softmax(1).topk(2, dim=1)
        margin = best.values[:, :1] - best.values[:, 1:]
        depth = code_to_depth(made.depth_code, self.config.codec)
        rgb = ((made.rgb + 1) / 2).clamp(0, 1)
        return Decoded(rgb, depth, best.indices[:, 0], margin), made.log_error.clamp(-6, 1).exp() / 2

    def _denoise(
        self,
        encoded: Encoded,
        names: tuple[Modality, ...],
        steps: int,
        noise_seed: int,
        sampler: str,
        eta: float,
        known: Mapping[Modality, Tensor] | None,
        start: Mapping[Modality, Tensor] | None,
        strength: float,
        bf16: bool,
    ) -> tuple[dict[Modality, Tensor], Tensor]:
        """Run the sampler for the modalities of one pass; returns latents [1,T,C,h,w] and the change over the late steps."""
        lead = encoded.planes.shape[:2]
        cell = encoded.planes.shape[-2:]
        sizes = [self.codec.channels[m] for m in names]
        generator = torch.Generator().manual_seed(noise_seed)
        shape = (*lead, sum(sizes), *cell)
        draw = lambda: noise.video_noise(shape, generator, self.config.shared_noise)  # noqa: E731
        estimates: list[Tensor] = []
        indices = noise.trailing_steps(len(self.schedule), steps)
        begin = draw()
        if start is not None:
            indices = noise.partial_steps(indices, len(self.schedule), strength)
            given = torch.cat([start[m] for m in names], 1)[None]
            begin = self.schedule.add_noise(given, begin, torch.full((lead[0],), indices[0]))
        elif strength != 1.0:
            raise UsageError("strength needs something to start from", got=str(strength), remedy="strength = 1")

        def denoise(x: Tensor, t: int) -> Tensor:
            stated, _ = self.predict(dict(zip(names, x.split(sizes, 2))), encoded, torch.full((lead[0],), t))
            out = torch.cat([stated[m].float() for m in names], 2)
            if known and self.config.head == "x0":
                kept = torch.cat([known[m] for m in names], 1)
                out = torch.cat([kept[None], out[:, kept.shape[0] :]], 1)
            return out

        def watch(number: int, x0: Tensor) -> None:
            if 2 * number >= len(indices) - 1:
                estimates.append(x0[:, :, : sizes[0]])

        with torch.autocast("cpu", torch.bfloat16, enabled=bf16):  # around all steps: the weights are converted once
            x = noise.SAMPLERS[sampler](
                denoise, begin, self.schedule, indices, prediction=self.config.head, eta=eta, draw=draw, on_step=watch
            )
        moved = torch.stack([(e - x[:, :, : sizes[0]]).abs().mean(2, keepdim=True) for e in estimates]).mean(0)
        return dict(zip(names, x.split(sizes, 2))), moved


def check_request(sampler: str, modalities: Sequence[str]) -> None:
    """UsageError unless there is such a sampler and at least one modality is asked for, all of them known."""
    if sampler not in noise.SAMPLERS:
        raise UsageError("unknown sampler", expected=", ".join(noise.SAMPLERS), got=sampler)
    if not modalities or any(m not in MODALITIES for m in modalities):
        raise UsageError("unknown or no modality", expected=", ".join(MODALITIES), got=str(list(modalities)))


def confidence_of(seen: Tensor, change: Tensor, factor: int) -> Tensor:
    """How far a generated pixel can be trusted, f32[T,1,H,W] in [0,1].

    seen    [T,1,h,w] share of the latent cell that was measured or warped from a recorded image
    change  [T,1,h,w] how much the colour latent still moved in the later half of sampling (or its spread over samples)
    factor  pixels per cell

    The product of a coverage term (1 where seen, 0.35 far from anything seen, smoothed over 5 cells) and exp(-2 change).
    """
    near = functional.avg_pool2d(seen, 5, stride=1, padding=2, count_include_pad=False)
    coverage = 0.35 + 0.65 * torch.maximum(seen, near)
    value = coverage * torch.exp(-2.0 * change)
    return functional.interpolate(value, scale_factor=float(factor)).clamp(0.0, 1.0)


def depth_agreement(depth: Tensor, condition: Condition, reach_px: int = 2) -> Tensor:
    """How far generated depth f32[T,1,H,W] agrees with what was measured nearby, f32[T,1,H,W] in [0.2, 1].

    exp(-5 |log(generated / measured)|) at measured pixels, carried over to the pixels within `reach_px` as the mean of
    those there; 1 where nothing was measured nearby. Where a surface was painted at a wrong distance, its colour is not to
    be trusted either.
    """
    seen = condition.valid.float()
    ratio = (depth.clamp(min=0.1) / condition.depth.clamp(min=0.1)).log().abs()
    agrees = torch.exp(-5.0 * ratio).clamp(min=0.2)
    window = 2 * reach_px + 1
    pool = lambda x: functional.avg_pool2d(x, window, stride=1, padding=reach_px, count_include_pad=True)  # noqa: E731
    near = pool(seen)
    return torch.where(near > 0, pool(agrees * seen) / near.clamp(min=1e-6), torch.ones_like(near))


def settle_depth(depth: Tensor, condition: Condition, far_m: float) -> Tensor:
    """Generated depth with measured depth put in wherever a point was seen, f32[T,1,H,W] metres, at most `far_m`.

    The condition's points have passed a visibility test, so they are taken as they are.
    """
    return torch.where(condition.valid, condition.depth, depth).clamp(max=far_m)


# files ----------------------------------------------------------------------------------------------------------------

MODEL_FILE = "model.json"
_ASSETS = Path(__file__).resolve().parents[2] / "assets"
EMBEDDED: dict[str, Path] = {"embedded": _ASSETS / "mdm_small", "embedded-tiny": _ASSETS / "mdm_tiny"}
"""Models that come with the package, by the names that stand for their folders."""
PART_BYTES = 15 * 1024 * 1024
"""Weights are split into files of at most this size."""


def save(model: MDM, folder: Path, card: str, facts: Mapping[str, Any]) -> None:
    """Write a model as fp16 safetensors in parts, `model.json` (configuration, sha256 of the parts, facts) and MODEL_CARD.md."""
    parts: list[dict[str, Tensor]] = [{}]
    size = 0
    for name, value in model.state_dict().items():
        half = value.half() if value.is_floating_point() else value
        if size + half.nbytes > PART_BYTES and parts[-1]:
            parts.append({})
            size = 0
        parts[-1][name] = half.contiguous()
        size += half.nbytes
    files = {}
    for number, part in enumerate(parts):
        name = f"weights_{number:02d}.safetensors"
        store.write_safetensors(folder / name, part)
        files[name] = store.sha256_file(folder / name)
    store.write_text(folder / "MODEL_CARD.md", card)
    store.write_json(
        folder / MODEL_FILE, {"schema": 1, "config": config_to_dict(model.config), "files": files, "facts": dict(facts)}
    )


def folder_of(path: Path | str) -> Path:
    """The folder that a name of `EMBEDDED` stands for; any other text is a folder itself."""
    return EMBEDDED.get(str(path), Path(path))


def load(path: Path | str = "embedded") -> MDM:
    """Read a model folder written by `save`; the names of `EMBEDDED` stand for those shipped with the package.

    Raises:
        InputError: no model there, other fields or other weights than the configuration implies.
        IntegrityError: a weight file does not match its recorded hash.
    """
    folder = folder_of(path)
    where = folder / MODEL_FILE
    if not where.is_file():
        raise InputError("no diffusion model here", where=str(folder), expected=f"a file {MODEL_FILE}")
    content = store.parse_json(json.dumps(store.read_json(where)), str(where))
    if not isinstance(content, dict) or content.get("schema") != 1 or not isinstance(content.get("files"), dict):
        raise InputError("not a model description of this version", where=str(where))
    model = MDM(config_from_dict(content.get("config", {}), str(where)))
    state: dict[str, Tensor] = {}
    for name, digest in content["files"].items():
        file = folder / Path(name).name
        if not file.is_file() or store.sha256_file(file) != digest:
            raise IntegrityError(
                "a weight file is missing or altered", where=str(file), expected=f"sha256 {digest[:16]}..."
            )
        state |= {k: torch.from_numpy(v.copy()) for k, v in store.read_safetensors(file).items()}
    wanted = model.state_dict()
    wrong = sorted(set(wanted) ^ set(state)) or [k for k in wanted if wanted[k].shape != state[k].shape]
    if wrong:
        raise InputError("weights do not fit the configuration", where=str(folder), got=", ".join(wrong[:6]))
    model.load_state_dict({k: v.to(wanted[k].dtype) for k, v in state.items()})
    return model.eval()


def same_denoiser(one: MDMConfig, other: MDMConfig) -> bool:
    """Whether two networks differ at most in what `extended` can add, and in the size they were trained at."""
    plain: dict[str, Any] = {"given_classes": False, "refine_widths": (), "refine_blocks": (), "area_px": 0}
    return dataclasses.replace(one, **plain) == dataclasses.replace(other, **plain)


def extended(before: MDM, config: MDMConfig) -> MDM:
    """A model of `config` with the weights of `before`, whose inputs and outputs are the first of its own.

    Weights of further inputs and outputs are 0, so that the denoiser starts as the same function; a refiner is taken over
    if `before` has one of the same shape. For continuing the training of an earlier, plainer model.

    Raises:
        UsageError: the two differ in more than `given_classes`, the refiner and the size trained at.
    """
    if not same_denoiser(before.config, config):
        raise UsageError(
            "the model to continue from is of another kind", expected=str(config), got=str(before.config),
            remedy="give its widths, blocks, attention, patch and window",
        )  # fmt: skip
    model = MDM(config)
    state = model.state_dict()
    for name, old in before.state_dict().items():
        if name not in state or (name.startswith("refiner.") and state[name].shape != old.shape):
            continue
        new = torch.zeros_like(state[name]) if name.startswith("net.") else state[name]
        new[tuple(slice(0, size) for size in old.shape)] = old
        state[name] = new
    model.load_state_dict(state)
    return model


def facts(path: Path | str) -> dict[str, Any]:
    """The facts (recipe, scores) that `save` was given for a model folder or "embedded"."""
    content = store.read_json(folder_of(path) / MODEL_FILE)
    return dict(content.get("facts", {}))


def digest(path: Path | str) -> str:
    """Digest of a model's description, which holds the hashes of its weights."""
    return store.digest(folder_of(path) / MODEL_FILE)


__all__ = [
    "CLASSES", "EMBEDDED", "LABELS", "MDM", "MODALITIES", "Encoded", "Losses", "MDMConfig", "Sample", "UNet", "config_from_dict",
    "config_to_dict", "load", "save",
]  # fmt: skip
