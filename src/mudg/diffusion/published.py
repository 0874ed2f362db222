"""The published multi-modal diffusion model, full size: the same thing as `MDM`, of other parts.

    conditions -> latents          autoencoder; frame 0 of the colour condition is the dense reference
    reference  -> image tokens     image tower (`clip`) and resampler, 16 tokens for each of 16 frames
    one pass per modality          v-prediction with classifier-free guidance, told apart by the modality label
    latents    -> pixels           autoencoder

`encode_condition`, `loss` and `sample` mean what they mean in `diffusion/model.py`. Where model and paper differ from
each other the defaults follow the released weights; docs/research/published.md lists the differences.
"""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import torch
from torch import Tensor, nn
from torch.nn import functional

from mudg.base import checkpoint, palette, records, seeds, store, weights
from mudg.base.errors import InputError, UsageError
from mudg.base.types import Clip, Condition
from mudg.core import noise
from mudg.core.depth import DepthFit, align_depth
from mudg.core.noise import Schedule, ScheduleConfig
from mudg.diffusion.model import BatchPart, Losses, LossSettings
from mudg.diffusion.model_files import MODEL_FILE, folder_of, read_description
from mudg.diffusion.published_network import (
    Autoencoder,
    AutoencoderConfig,
    ContextKeys,
    Resampler,
    ResamplerConfig,
    SeededDropout,
    TemporalConv,
    TemporalTransformer,
    VideoUNet,
    VideoUNetConfig,
)
from mudg.diffusion.requests import (
    GeneratedClip,
    SampleRequest,
    check_image_size,
    confidence_of,
    denoised,
    depth_agreement,
    mean_change,
    sized_to_width,
)
from mudg.networks.clip import IMAGE_TOWER, TEXT_TOKENS, TEXT_TOWER, ImageTower, TowerConfig
from mudg.networks.codec import MODALITIES, Modality

LABELS: dict[Modality, int] = {"rgb": 0, "semantics": 1, "depth": 500}
"""Modality labels of the published checkpoints; fed through a sinusoid like a time step."""
GUIDANCE = 7.5
"""Weight of the guided over the unguided velocity, where a request has none; 1 switches guidance off and halves the
work."""
GUIDANCE_RESCALE = 0.7
"""Share of the guided velocity whose spread is pulled back to that of the conditional one."""
MEASURED_SLACK_PX = 1
"""Points are measured on a finer grid than the network's."""
SCALE_ENTRIES = 1400
"""Length of the published table of the dynamic rescale; one entry per noise step is used, the rest repeats the last."""


@dataclass(frozen=True)
class PublishedConfig:
    """Everything that fixes the model's function except its weights. The defaults are the published model at
    576x1024."""

    net: VideoUNetConfig = VideoUNetConfig()
    codec: AutoencoderConfig = AutoencoderConfig()
    image_tokens: ResamplerConfig = ResamplerConfig()
    image: TowerConfig = IMAGE_TOWER
    image_patch: int = 14
    image_side: int = 224
    text: TowerConfig = TEXT_TOWER
    vocabulary: int = 49408
    schedule: ScheduleConfig = ScheduleConfig(base_scale=0.7)
    """A checkpoint's own table of the dynamic rescale wins over base_scale."""
    width: int = 1024
    height: int = 576
    fps: int = 10
    """Frame rate given to the network; the published one never saw another."""

    def __post_init__(self) -> None:
        net, tokens, latent = self.net, self.image_tokens, self.codec.latent_channels
        for what, expected, got in (
            (
                "caption and image tokens must have the width of the network's context",
                f"{net.context_width}, {net.context_width}",
                f"{self.text.width}, {tokens.context_width}",
            ),
            ("image tower and resampler differ in width", str(tokens.image_width), str(self.image.width)),
            (
                "the network must take three latents (noisy, colour, depth) and give one",
                f"{3 * latent} -> {latent}",
                f"{net.channels_in} -> {net.channels_out}",
            ),
        ):
            if expected != got:
                raise UsageError(what, expected=expected, got=got)

    @property
    def window(self) -> int:
        """Frames per clip: exactly this many, the image tokens are made for them."""
        return self.image_tokens.frames

    @property
    def pixel_multiple(self) -> int:
        """Image sides must be multiples of this many pixels."""
        return 2 ** (len(self.codec.multipliers) + len(self.net.multipliers) - 2)


@dataclass(frozen=True)
class PublishedLatents:
    """A batch of conditions as the network wants them.

    planes f32[B,T,8,h,w]: latents of the colour and the depth condition; features [B,257,D] image tower's output for
    the reference and grey [1,257,D] for a mid-grey image (the absent reference); seen f32[B,T,1,h,w] share of the cell
    that was seen.
    """

    planes: Tensor
    features: Tensor
    grey: Tensor
    seen: Tensor


@dataclass(frozen=True)
class WorkSplit:
    """How the work of sampling is cut into pieces, which does not change what is computed."""

    modalities_together: bool = True
    guidance_together: bool = True
    frames_at_once: int = 16
    """Frames per pass of the autoencoder."""
    offload: bool = False
    """Keep the image tower on the CPU, except while it reads a reference."""


@dataclass(frozen=True)
class _Told:
    """What the network is told beside the latents: modality labels i64[N], caption tokens [N,77,D], image tokens
    [N,T,16,D], and keys and values of both in every layer if they are needed more than once."""

    label: Tensor
    text: Tensor
    tokens: Tensor
    keys: list[ContextKeys] | None


@dataclass(frozen=True)
class ContextDropout:
    """Shares of training clips that miss their caption only, caption and reference, or the reference only."""

    text: float = 0.05
    both: float = 0.05
    reference: float = 0.15

    @classmethod
    def for_reference(cls, reference: float) -> ContextDropout:
        """With the reference missing in this share of the clips (0.2: the paper, 0.1: the released code)."""
        both = min(cls.both, reference)
        return cls(cls.text, both, round(min(reference - both, 1 - cls.text - both), 12))


PAPER_DROPOUT = ContextDropout()
"""The reference is missing in 20 % of the clips, as the paper says; the released training code does each of the three
in 5 %."""
MODALITY_SHARES: dict[Modality, float] = {"rgb": 0.5, "semantics": 0.25, "depth": 0.25}
"""How often a training clip shows which modality."""


class PublishedMDM(nn.Module):
    """The model (see the module text). The caption's embedding is a buffer: the text tower is not part of it.

    `split` says how its work is cut into pieces.
    """

    points_alone = True
    """The condition is points, 0 where nothing was seen, and one recorded image, which stands in frame 0."""
    text: Tensor
    scale: Tensor

    def __init__(self, config: PublishedConfig) -> None:
        super().__init__()
        self.config = config
        self.split = WorkSplit()
        self.codec = Autoencoder(config.codec)
        self.net = VideoUNet(config.net)
        self.image = ImageTower(config.image, config.image_patch, config.image_side)
        self.image_tokens = Resampler(config.image_tokens)
        self.schedule = Schedule(config.schedule)
        self.register_buffer("text", torch.zeros(2, TEXT_TOKENS, config.text.width))
        last = self.schedule.scale[-1:].expand(max(0, SCALE_ENTRIES - len(self.schedule)))
        self.register_buffer("scale", torch.cat([self.schedule.scale, last])[:SCALE_ENTRIES])

    def adopt_scale(self) -> None:
        """Take the dynamic rescale from the buffer `scale`. To be called after weights were loaded."""
        self.schedule.scale = self.scale[: len(self.schedule)].float().cpu()

    @property
    def device(self) -> torch.device:
        """Where the weights lie."""
        return self.text.device

    @property
    def dtype(self) -> torch.dtype:
        """Number format of the denoising network."""
        return self.net.leave.weight.dtype

    # inputs ---------------------------------------------------------------------------------------

    def check_size(self, height: int, width: int) -> None:
        """UsageError unless an image of this size fits the network's strides."""
        check_image_size(height, width, self.config.pixel_multiple)

    def check_clip(self, frames: int, height: int, width: int) -> None:
        """UsageError unless the model can make clips of this many frames and this image size."""
        self.check_frames(frames)
        self.check_size(height, width)

    def check_frames(self, frames: int) -> None:
        """UsageError unless a clip has exactly the number of frames that the image tokens are made for."""
        own = self.config.window
        if frames != own:
            raise UsageError(
                "a clip of the published model has a fixed number of frames: its image tokens belong to one frame each",
                where="PublishedMDM",
                expected=f"{own} frames",
                got=f"{frames}",
                remedy=f"use trajectories of at least {own} frames; they are made in windows of that length",
            )

    def encode_condition(
        self,
        condition: Condition | Sequence[Condition],
        generator: torch.Generator | None = None,
        known: Tensor | None = None,
    ) -> PublishedLatents:
        """Latents of the conditions of clips of one shape, and image features of their references (see
        `PublishedLatents`).

        Args:
            generator: noise of the autoencoder's posterior; needed unless the configuration names its mean.
            known: colour f32[k,3,H,W] in [0,1] generated for the first k frames by the window before: they replace the
                sparse colour there (of every clip), frame 0 excepted.
        """
        batch = [condition] if isinstance(condition, Condition) else list(condition)
        color, depth, valid, reference = (
            torch.stack([getattr(c, name) for c in batch]).to(self.device)
            for name in ("color", "depth", "valid", "reference")
        )
        valid = valid.float()
        self.check_size(*color.shape[-2:])
        self.check_frames(color.shape[1])
        # missing is black and 0 m, as in the published training
        color, depth, seen = color * valid, depth * valid, valid
        in_frame, in_tokens = (
            torch.tensor([c.reference_in in uses for c in batch], device=self.device)[:, None, None, None]
            for uses in (("tokens_and_frame", "frame"), ("tokens_and_frame",))
        )
        first, first_seen = torch.where(in_frame, reference, color[:, 0]), torch.where(in_frame, 1.0, seen[:, 0])
        if known is not None:
            color = torch.cat([known.to(color).expand(len(color), -1, -1, -1, -1), color[:, len(known) :]], 1)
            seen = torch.cat([torch.ones_like(seen[:, : len(known)]), seen[:, len(known) :]], 1)
        color = torch.cat([first[:, None], color[:, 1:]], 1)
        seen = torch.cat([first_seen[:, None], seen[:, 1:]], 1)
        generator, images = self._posterior(generator), (color * 2 - 1, self.codec.depth_image(depth))
        planes = torch.cat([self._encode(image, generator) for image in images], 2)
        shown = torch.where(in_tokens, reference * 2 - 1, 0.0)
        features = self._features(torch.cat([shown, torch.zeros_like(reference[:1])]))
        return PublishedLatents(planes, features[:-1], features[-1:], self._share_of_cells(seen))

    def _features(self, images: Tensor) -> Tensor:
        """What the image tower, which lies on the CPU if `split` says so, makes of images on the model's device."""
        if self.split.offload:
            self.image.to(self.device)
        with torch.no_grad():
            features = self.image(images)
        if self.split.offload:
            self.image.to("cpu")
        return features

    def encode_truth(
        self, rgb: Tensor, depth: Tensor, semantics: Tensor, generator: torch.Generator | None = None
    ) -> dict[Modality, Tensor]:
        """Latents of a clip's truth: rgb [B,T,3,H,W] in [0,1], depth [B,T,1,H,W] m (sky = far), semantics
        i64[B,T,H,W]."""
        generator = self._posterior(generator)
        images: dict[Modality, Tensor] = {
            "rgb": rgb * 2 - 1,
            "depth": self.codec.depth_image(depth),
            "semantics": self.codec.semantic_image(semantics),
        }
        return {m: self._encode(image, generator) for m, image in images.items()}

    def _encode(self, image: Tensor, generator: torch.Generator | None) -> Tensor:
        with torch.no_grad():
            return self.codec.encode(image.to(self.device), generator, self.split.frames_at_once)

    def _posterior(self, generator: torch.Generator | None) -> torch.Generator | None:
        if self.config.codec.posterior == "mean":
            return None
        if generator is None:
            raise UsageError(
                "encoding draws from the posterior and needs a generator",
                where="PublishedMDM",
                remedy='or use posterior = "mean"',
            )
        return generator

    # network --------------------------------------------------------------------------------------

    def predict(
        self, x: Tensor, planes: Tensor, t: Tensor, names: Sequence[Modality], text: Tensor, tokens: Tensor
    ) -> Tensor:
        """Velocity f32[N,T,4,h,w] of noisy latents `x` of the same shape, modality `names[n]` each, at steps `t`
        i64[N].

        planes [N,T,8,h,w]; text [N,77,D]; tokens [N,T,16,D].
        """
        return self._velocity(x, planes, t, self._told(names, text, tokens))

    def _told(self, names: Sequence[Modality], text: Tensor, tokens: Tensor, *, ahead: bool = False) -> _Told:
        """What the network is told beside the latents; `ahead`: with keys and values of caption and image tokens, for
        many steps."""
        text, tokens = text.to(self.dtype), tokens.to(self.dtype)
        label = torch.tensor([LABELS[m] for m in names], device=text.device)
        return _Told(label, text, tokens, self.net.context_keys(text, tokens) if ahead else None)

    def _velocity(self, x: Tensor, planes: Tensor, t: Tensor, conditioning: _Told) -> Tensor:
        """As `predict`."""
        inputs = torch.cat([x, planes], 2).to(self.dtype)
        fps = torch.full_like(t, self.config.fps)
        return self.net(
            inputs, t, conditioning.label, fps, conditioning.text, conditioning.tokens, conditioning.keys
        ).float()

    # training -------------------------------------------------------------------------------------

    def loss(self, clips: Sequence[Clip], part: BatchPart, settings: LossSettings) -> Losses:
        """`velocity_loss` of clips of one size; all that is drawn comes from `part`, the autoencoder's posterior clip
        by clip.

        Raises:
            InputError: the clips' condition is not the published one.
        """
        encoded, truths, dropout = [], [], ContextDropout.for_reference(settings.reference_dropout)
        with torch.no_grad():
            for number, clip in enumerate(clips, part.first):
                if clip.condition.warped is not None and bool(clip.condition.warped.any()):
                    raise InputError(
                        "the training clips show warped images in their condition",
                        where=f"step {part.step}",
                        expected="points alone, as the published-type model is given",
                        remedy="give another folder of clips; they are made anew",
                    )
                draws = seeds.torch_generator(part.seed, part.step, f"posterior, clip {number}")
                encoded.append(self.encode_condition(clip.condition, draws))
                truths.append(self.encode_truth(clip.rgb[None], clip.depth[None], clip.semantics[None], draws))
            truth: dict[Modality, Tensor] = {m: torch.cat([one[m] for one in truths]) for m in MODALITIES}
            classes = torch.stack([clip.semantics != palette.UNLABELLED for clip in clips]).unsqueeze(2)
            known: dict[Modality, Tensor] = {
                "depth": self._share_of_cells(torch.stack([clip.depth_weight for clip in clips])),
                "semantics": self._share_of_cells(classes),
            }
        planes, features, seen = (
            torch.cat([getattr(e, name) for e in encoded]) for name in ("planes", "features", "seen")
        )
        return self.velocity_loss(
            truth,
            PublishedLatents(planes, features, encoded[0].grey, seen),
            seeds.torch_generator(part.seed, part.step, "noise"),
            dropout=dropout,
            known=known,
            first=part.first,
            batch_clips=part.count,
        )

    forward = loss
    """What `DistributedDataParallel` calls, to exchange gradients behind it."""

    def _share_of_cells(self, mask: Tensor) -> Tensor:
        """Share f32[B,T,1,h,w] of each latent cell in which bool[B,T,1,H,W] is set."""
        return functional.avg_pool2d(mask.float().flatten(0, 1), self.codec.factor).unflatten(0, mask.shape[:2])

    def velocity_loss(
        self,
        truth: Mapping[Modality, Tensor],
        encoded: PublishedLatents,
        generator: torch.Generator,
        *,
        dropout: ContextDropout = PAPER_DROPOUT,
        known: Mapping[Modality, Tensor] | None = None,
        first: int = 0,
        batch_clips: int = 0,
    ) -> Losses:
        """Mean squared error of the velocity; every clip of the batch shows one modality, drawn by `MODALITY_SHARES`.

        Args:
            truth: latents of `encode_truth`, each [B,T,4,h,w].
            encoded: where the reference is left out the image tokens go grey, as in the released code; frame 0 is as it
                was encoded.
            generator: of all draws: modality, noise step, noise, which context is left out, dropout inside the network.
            known: f32[B,T,1,h,w] share of the cell whose truth is known, of any modality; one not named is known
                everywhere.
            first: number of the first of these clips in the batch of a training step.
            batch_clips: clips of that batch (0 = just these); what is drawn for a clip does not depend on how the batch
                is divided.

        Returns:
            A term for each modality that any clip of the batch shows, so that all parts have the same terms; scaled so
            that the mean over equal parts is the mean over the clips that show it.
        """
        count = encoded.planes.shape[0]
        batch_clips, own = batch_clips or count, slice(first, first + count)
        steps, drawn, no_text, no_reference = self._batch_draws(batch_clips, generator, dropout)
        t, no_text, no_reference = (draw[own].to(self.device) for draw in (steps, no_text, no_reference))
        names = drawn[own]
        x0 = torch.stack([truth[m][n] for n, m in enumerate(names)])
        seed, shape = generator.initial_seed(), (1, *x0.shape[1:])
        draws = [noise.video_noise(shape, seeds.torch_generator(seed, first + n, "noise")) for n in range(count)]
        eps = torch.cat(draws).to(self.device)
        text = torch.where(no_text[:, None, None], self.text[1], self.text[0])
        features = torch.where(no_reference[:, None, None], encoded.grey, encoded.features)
        dropouts = [m for m in self.modules() if isinstance(m, SeededDropout) and m.training]
        for number, layer in enumerate(dropouts):
            layer.seeds = tuple(seeds.key(seed, clip, f"dropout {number}") for clip in range(first, first + count))
        stated = self.predict(
            self.schedule.add_noise(x0, eps, t), encoded.planes, t, names, text, self.image_tokens(features)
        )
        squares = (stated - self.schedule.velocity(x0, eps, t)).square()
        if known:
            everywhere = torch.ones_like(x0[0, :, :1])
            squares = squares * torch.stack([known[m][n] if m in known else everywhere for n, m in enumerate(names)])
        errors = squares.flatten(1).mean(1)
        sums = {
            m: sum(float(e) for e, name in zip(errors.detach(), names) if name == m) for m in MODALITIES if m in drawn
        }
        return Losses(errors.mean(), {m: total * batch_clips / (count * drawn.count(m)) for m, total in sums.items()})

    def _batch_draws(
        self, count: int, generator: torch.Generator, dropout: ContextDropout
    ) -> tuple[Tensor, list[Modality], Tensor, Tensor]:
        """Of the clips of a batch: noise steps i64[N], modalities, and bool[N] each: without the caption, without the
        reference."""
        steps = noise.stratified_steps(count, len(self.schedule), generator)
        u = torch.rand(count, generator=generator, dtype=torch.float64)
        limits = torch.tensor(list(MODALITY_SHARES.values()), dtype=torch.float64).cumsum(0)[:-1]
        names = [list(MODALITY_SHARES)[int(n)] for n in torch.bucketize(u, limits, right=True)]
        u = torch.rand(count, generator=generator)
        no_reference = (u >= dropout.text) & (u < dropout.text + dropout.both + dropout.reference)
        return steps, names, u < dropout.text + dropout.both, no_reference

    def trained_part(self) -> nn.ModuleDict:
        """What training changes, by attribute name: the denoising network and the resampler of the image tokens."""
        return nn.ModuleDict({"net": self.net, "image_tokens": self.image_tokens})

    def temporal_parameters(self, which: Literal["transformers", "all"]) -> set[str]:
        """Names in `trained_part` of the parameters that mix frames.

        Those of the temporal transformers inside the blocks, which is what the published second stage froze; or of
        `all` temporal layers, that after the input convolution and the temporal convolutions included, which is what
        its text says.
        """
        kinds = (TemporalTransformer, TemporalConv) if which == "all" else TemporalTransformer
        layers = [m for m in self.net.modules() if isinstance(m, kinds) and (which == "all" or m is not self.net.first)]
        ids = {id(parameter) for layer in layers for parameter in layer.parameters()}
        return {name for name, parameter in self.trained_part().named_parameters() if id(parameter) in ids}

    # sampling -------------------------------------------------------------------------------------

    def image_size(self, width: int, height: int, width_px: int = 0) -> tuple[int, int]:
        """Width and height the model works at: its own whatever the camera's are, or about `width_px` wide in the same
        aspect."""
        del width, height
        own = self.config
        if not width_px:
            return own.width, own.height
        return sized_to_width(width_px, own.width / own.height, own.pixel_multiple)

    @torch.no_grad()
    def sample(self, condition: Condition, request: SampleRequest) -> GeneratedClip:
        """Generate one clip of exactly `config.window` frames (see `SampleRequest`). Condition and clip are on the
        model's device.

        Steps run from the noisiest one down. Of frames whose latents are known, the decoded colour takes the place of
        the sparse colour: the published way to continue a video. Depth and semantics are not continued. Without
        `align`, depth is what the model says.
        """
        self.check_frames(len(condition.views))
        frames_at_once = self.split.frames_at_once
        half = request.bf16 and self.dtype == torch.float32
        with torch.autocast(self.device.type, torch.bfloat16) if half else contextlib.nullcontext():
            before = None if request.known is None else request.known["rgb"].to(self.device)
            before = None if before is None else self.codec.decode_rgb(before, frames_at_once)
            posterior = seeds.torch_generator(request.seed, request.index, "posterior")
            encoded = self.encode_condition(condition, posterior, before)
            tokens = self.image_tokens(torch.cat([encoded.features, encoded.grey]).to(self.image_tokens.queries.dtype))
            groups = [MODALITIES] if self.split.modalities_together else [(m,) for m in MODALITIES]
            latents: dict[Modality, Tensor] = {}
            changes: list[Tensor] = []
            for names in groups:
                part, moved = self._denoise(encoded, names, tokens, request)
                latents |= part
                changes.append(moved)
            decoded = self.codec.decode(latents, frames_at_once)
        confidence = confidence_of(encoded.seen[0], changes[0], self.codec.factor)
        depth, fits = decoded.depth, list[DepthFit]()
        if request.align:
            points = condition.measurement
            depth, fits = align_depth(depth, points.depth, points.valid)
            confidence = confidence * depth_agreement(depth, condition, MEASURED_SLACK_PX)
        return GeneratedClip(decoded.rgb, depth, decoded.semantics, confidence, latents, tuple(fits))

    def _denoise(
        self, encoded: PublishedLatents, names: tuple[Modality, ...], tokens: Tensor, request: SampleRequest
    ) -> tuple[dict[Modality, Tensor], Tensor]:
        """Draw some modalities in one batch; returns their latents [T,4,h,w] and how much the first's still
        changed [T,1,h,w].

        `tokens` [2,T,16,D]: with the reference and without. Every modality has its own stream of noise.
        """
        _, frames, _, h, w = encoded.planes.shape
        shape = (1, frames, self.config.codec.latent_channels, h, w)
        streams = [seeds.torch_generator(request.seed, request.index * 64, f"sample {m}") for m in names]
        draw = lambda: torch.cat([noise.video_noise(shape, g) for g in streams]).to(self.device)
        velocity = self._guided(encoded, names, tokens, request)
        x, estimates = denoised(velocity, draw, self.schedule, request, "v", last="first_alpha")
        return {m: x[n] for n, m in enumerate(names)}, mean_change([e[0] for e in estimates], x[0])

    def _guided(
        self, encoded: PublishedLatents, names: tuple[Modality, ...], tokens: Tensor, request: SampleRequest
    ) -> noise.Denoise:
        """The denoiser for `names` in one batch: velocity with classifier-free guidance.

        What is the same at every step is computed here, once: the condition's planes, and keys and values of caption
        and image.
        """
        guidance = GUIDANCE if request.guidance is None else request.guidance
        rescale = GUIDANCE_RESCALE if request.guidance_rescale is None else request.guidance_rescale
        count, both = len(names), slice(0, 1 if guidance == 1 else 2)  # 0: with caption and reference, 1: without
        halves = [both] if self.split.guidance_together or guidance == 1 else [slice(0, 1), slice(1, 2)]
        twice = lambda x, half: x[half].repeat_interleave(count, 0)
        told = [
            self._told(names * len(self.text[half]), twice(self.text, half), twice(tokens, half), ahead=True)
            for half in halves
        ]

        def passed(x: Tensor, t: int, about: _Told) -> Tensor:
            n = len(about.label)
            planes, at = encoded.planes.expand(n, -1, -1, -1, -1), torch.full((n,), t, device=x.device)
            return self._velocity(x.repeat(n // count, 1, 1, 1, 1), planes, at, about)

        def velocity(x: Tensor, t: int) -> Tensor:
            found = [half for about in told for half in passed(x, t, about).split(count)]
            return found[0] if guidance == 1 else noise.guide(found[0], found[1], guidance, rescale)

        return velocity


# files --------------------------------------------------------------------------------------------
#
# Folders that hold a published-type diffusion model (see `diffusion/model_files.py` for what is in such a folder).


KIND = "published"


def is_published(path: Path | str) -> bool:
    """Whether a folder holds a published-type model (by its description; a missing one is no)."""
    where = folder_of(path) / MODEL_FILE
    content = store.read_json(where) if where.is_file() else None
    return isinstance(content, dict) and content.get("kind") == KIND


def window_of(path: Path | str) -> int:
    """Frames of a clip of the model in a folder, from its description alone.

    Raises:
        InputError: not such a folder.
    """
    content, where = read_description(Path(path)), str(Path(path) / MODEL_FILE)
    return records.parse_dataclass(PublishedConfig, content.get("config"), f"{where}: config").window


def save(
    folder: Path,
    config: PublishedConfig,
    tensors: Mapping[str, Tensor],
    facts: Mapping[str, Any],
    card: str,
    *,
    dtype: torch.dtype | None = None,
    shard_bytes: int = 1 << 30,
) -> None:
    """Write a model folder under a temporary name and rename it when it is complete.

    Args:
        tensors: everything `PublishedMDM(config).state_dict()` names.
        dtype: number format of the weights (None: as given); the table `scale` stays float32.
    """
    with store.atomic_directory(folder) as partial:
        small = {"scale": tensors["scale"].float()}
        files = checkpoint.write_shards(partial, {n: t for n, t in tensors.items() if n != "scale"}, shard_bytes, dtype)
        store.write_safetensors(partial / "scale.safetensors", small)
        files["scale.safetensors"] = store.sha256_file(partial / "scale.safetensors")
        store.write_text(partial / "MODEL_CARD.md", card)
        description = {"schema": 1, "kind": KIND, "config": dataclasses.asdict(config)}
        store.write_json(partial / MODEL_FILE, {**description, "files": files, "facts": dict(facts)})
        store.sync_tree(partial)


def load(folder: Path, device: torch.device | str = "cpu", dtype: torch.dtype | None = None) -> PublishedMDM:
    """Read a model folder; weights are mapped from the files and converted to `dtype` (None: as stored).

    Raises:
        InputError: not such a folder, or its weights do not fit its configuration. IntegrityError: a file was altered.
    """
    content, where = read_description(folder), str(Path(folder) / MODEL_FILE)
    if content.get("kind") != KIND:
        raise InputError("not a published-type model of this version", where=where, expected=f"schema 1, kind {KIND}")
    with torch.device("meta"), records.understood("a published-type model", where):
        model = PublishedMDM(records.parse_dataclass(PublishedConfig, content.get("config"), f"{where}: config"))
    state = checkpoint.read_shards(Path(folder), content["files"], remedy="convert the checkpoint again")
    weights.match_exactly(state, weights.shapes_of(model), str(folder), "its configuration")
    model.load_state_dict(state, assign=True)
    model.adopt_scale()
    table = model.scale
    model = model.to(device=device, dtype=dtype).eval()
    model.scale = table.to(device)  # exact in any number format: it is part of the schedule
    return model
