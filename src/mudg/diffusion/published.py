"""The published multi-modal diffusion model, full size: the same thing as `MDM`, of other parts.

One pass per modality, told apart by a label; v-prediction with classifier-free guidance. Where model and paper differ
the defaults follow the released weights (docs/research/published.md).
"""

from __future__ import annotations

import contextlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional

from mudg.base import palette, seeds
from mudg.base.errors import InputError, UsageError
from mudg.base.types import Clip, Condition
from mudg.core import noise
from mudg.core.depth import DepthFit, align_depth
from mudg.core.noise import Schedule, ScheduleConfig
from mudg.diffusion.model import BatchPart, Losses
from mudg.diffusion.published_network import (
    Autoencoder,
    AutoencoderConfig,
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
        return self.codec.factor * 2 ** (len(self.net.multipliers) - 1)


@dataclass(frozen=True)
class PublishedLatents:
    """A batch of conditions as the network wants them. planes f32[B,T,8,h,w]: latents of the colour and the depth
    condition; features [B,257,D] image tower's output for the reference and grey [1,257,D] for a mid-grey image (the
    absent reference); seen f32[B,T,1,h,w] share of the cell that was seen."""

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
    """The model (see the module text). The caption's embedding is a buffer: the text tower is not part of it. `split`
    says how its work is cut into pieces."""

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

    def check_clip(self, frames: int, height: int, width: int) -> None:
        """UsageError unless the model can make clips of this image size and exactly this many frames."""
        check_image_size(height, width, self.config.pixel_multiple)
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
        `PublishedLatents`). generator: noise of the autoencoder's posterior; needed unless the configuration names its
        mean. known: colour f32[k,3,H,W] in [0,1] generated for the first k frames by the window before: they replace
        the sparse colour there (of every clip), frame 0 excepted."""
        batch = [condition] if isinstance(condition, Condition) else list(condition)
        color, depth, valid, reference = (
            torch.stack([getattr(c, name) for c in batch]).to(self.device)
            for name in ("color", "depth", "valid", "reference")
        )
        valid = valid.float()
        self.check_clip(color.shape[1], *color.shape[-2:])
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
        with torch.no_grad():
            features = self.image(torch.cat([shown, torch.zeros_like(reference[:1])]))
        return PublishedLatents(planes, features[:-1], features[-1:], self._share_of_cells(seen))

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
            what = "encoding draws from the posterior and needs a generator"
            raise UsageError(what, where="PublishedMDM", remedy='or use posterior = "mean"')
        return generator

    # network --------------------------------------------------------------------------------------

    def predict(
        self, x: Tensor, planes: Tensor, t: Tensor, names: Sequence[Modality], text: Tensor, tokens: Tensor
    ) -> Tensor:
        """Velocity f32[N,T,4,h,w] of noisy latents `x` of the same shape, modality `names[n]` each, at steps `t`
        i64[N]. planes [N,T,8,h,w]; text [N,77,D]; tokens [N,T,16,D]."""
        inputs = torch.cat([x, planes], 2).to(self.dtype)
        label = torch.tensor([LABELS[m] for m in names], device=inputs.device)
        fps = torch.full_like(t, self.config.fps)
        return self.net(inputs, t, label, fps, text.to(self.dtype), tokens.to(self.dtype)).float()

    # training -------------------------------------------------------------------------------------

    def loss(self, clips: Sequence[Clip], part: BatchPart) -> Losses:
        """`velocity_loss` of clips of one size; all that is drawn comes from `part`, the autoencoder's posterior clip
        by clip. InputError: the clips' condition is not the published one."""
        encoded, truths, dropout = [], [], ContextDropout.for_reference(part.reference_dropout)
        with torch.no_grad():
            for number, clip in enumerate(clips, part.first):
                if clip.condition.warped is not None and bool(clip.condition.warped.any()):
                    what = "the training clips show warped images in their condition"
                    remedy = "give another folder of clips; they are made anew"
                    expected = "points alone, as the published-type model is given"
                    raise InputError(what, where=f"step {part.step}", expected=expected, remedy=remedy)
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
        truth: latents of `encode_truth`, each [B,T,4,h,w]. encoded: where the reference is left out the image tokens go
        grey, as in the released code. known: f32[B,T,1,h,w] share of the cell whose truth is known; a modality not
        named is known everywhere. first, batch_clips: number of the first of these clips in the batch of a training
        step, and clips of that batch (0 = just these). What is drawn for a clip, from the generator, does not depend on
        how the batch is divided.

        Returns a term for each modality that any clip of the batch shows, so that all parts have the same terms; the
        mean over equal parts is the mean over the clips that show it."""
        count = encoded.planes.shape[0]
        batch_clips, own = batch_clips or count, slice(first, first + count)
        steps = noise.stratified_steps(batch_clips, len(self.schedule), generator)
        u = torch.rand(batch_clips, generator=generator, dtype=torch.float64)
        limits = torch.tensor(list(MODALITY_SHARES.values()), dtype=torch.float64).cumsum(0)[:-1]
        drawn = [list(MODALITY_SHARES)[int(n)] for n in torch.bucketize(u, limits, right=True)]
        u = torch.rand(batch_clips, generator=generator)
        no_reference = (u >= dropout.text) & (u < dropout.text + dropout.both + dropout.reference)
        no_text = u < dropout.text + dropout.both
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

    def trained_part(self) -> nn.ModuleDict:
        """What training changes, by attribute name: the denoising network and the resampler of the image tokens."""
        return nn.ModuleDict({"net": self.net, "image_tokens": self.image_tokens})

    def temporal_parameters(self, which: Literal["transformers", "all"]) -> set[str]:
        """Names in `trained_part` of the parameters that mix frames: of the temporal transformers inside the blocks,
        which the published second stage froze; or of `all` temporal layers, as its text says."""
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
        model's device. Steps run from the noisiest one down. Of frames whose latents are known, the decoded colour
        takes the place of the sparse colour: the published way to continue a video. Depth and semantics are not
        continued. Without `align`, depth is what the model says."""
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
        """Draw some modalities in one batch; returns their latents [T,4,h,w] and how much the first's still changed
        [T,1,h,w]. `tokens` [2,T,16,D]: with the reference and without. Every modality has its own stream of noise."""
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
        """The denoiser for `names` in one batch: velocity with classifier-free guidance."""
        guidance = GUIDANCE if request.guidance is None else request.guidance
        rescale = GUIDANCE_RESCALE if request.guidance_rescale is None else request.guidance_rescale
        count, both = len(names), slice(0, 1 if guidance == 1 else 2)  # 0: with caption and reference, 1: without
        halves = [both] if self.split.guidance_together or guidance == 1 else [slice(0, 1), slice(1, 2)]

        def passed(x: Tensor, t: int, half: slice) -> Sequence[Tensor]:
            text, seen = (told[half].repeat_interleave(count, 0) for told in (self.text, tokens))
            n = len(text)
            planes, at = encoded.planes.expand(n, -1, -1, -1, -1), torch.full((n,), t, device=x.device)
            wanted = names * (n // count)
            return self.predict(x.repeat(n // count, 1, 1, 1, 1), planes, at, wanted, text, seen).split(count)

        def velocity(x: Tensor, t: int) -> Tensor:
            found = [one for half in halves for one in passed(x, t, half)]
            return found[0] if guidance == 1 else noise.guide(found[0], found[1], guidance, rescale)

        return velocity


# memory plan --------------------------------------------------------------------------------------
#
# How much memory the model needs, and how to cut its work to fit. The needs were counted once, on torch's meta device:
# what an eager pass holds at its worst moment, with fused attention, which stores no scores. All of it grows linearly
# with the image. Not counted: the device's own context and the workspace of convolutions; `RESERVE_BYTES` stands for
# them.


RESERVE_BYTES = 1_000_000_000
CUTS = ((True, True), (True, False), (False, True), (False, False))
"""(modalities together, guidance together), fastest first."""
FRAMES_AT_ONCE = (16, 8, 4, 2, 1)


def meta_model(config: PublishedConfig, dtype: torch.dtype) -> PublishedMDM:
    """The model without memory behind its weights."""
    with torch.device("meta"):
        return PublishedMDM(config).to(dtype).eval()


class Needs(NamedTuple):
    """What the parts of the work take at the model's own size, in bytes: weights; activations of the denoising network
    for one latent video; activations of the autoencoder for one frame; what a clip holds beside them (condition,
    latents, decoded images)."""

    parameters: int
    one_video: int
    one_frame: int
    clip: int


def needs_of(config: PublishedConfig, bytes_per_value: int) -> Needs:
    """The needs of a model whose weights and activations take 2 (bfloat16) or 4 (float32) bytes a number. Activations
    are those of the published network and its 16 frames."""
    model = meta_model(config, torch.bfloat16 if bytes_per_value == 2 else torch.float32)
    pixels = config.height * config.width
    return Needs(
        sum(x.numel() * x.element_size() for x in (*model.parameters(), *model.buffers())),
        one_video=bytes_per_value * (2512 * pixels + 8_332_160),
        one_frame=bytes_per_value * 12289 * pixels // 16,
        clip=(692 + bytes_per_value) * pixels + bytes_per_value * 1_182_208,
    )


def choose(needs: Needs, budget_bytes: int, *, guidance: bool = True) -> tuple[WorkSplit, int]:
    """The fastest way to cut the work of one clip that fits the budget, or the thriftiest if none does, and its peak in
    bytes: what stays, the worst moment of all, and the reserve."""
    ways, stays = [], needs.parameters + needs.clip + RESERVE_BYTES
    for together in CUTS:
        videos = needs.one_video * (len(MODALITIES) if together[0] else 1) * (2 if together[1] and guidance else 1)
        frames = next((n for n in FRAMES_AT_ONCE if needs.one_frame * n <= budget_bytes - stays), 1)
        ways.append((WorkSplit(*together, frames), stays + max(videos, needs.one_frame * frames)))
    return next((way for way in ways if way[1] <= budget_bytes), ways[-1])
