"""The multi-modal diffusion model: from a sparse, projected point cloud to dense colour, depth and semantic video.

Layouts: conditions and samples [T,C,H,W] of one clip; inside the model [B,T,C,h,w], with (h, w) the latent size; inside
the UNet [B*T,C,h,w] stored channels-last.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Literal

import torch
from torch import Tensor, nn
from torch.nn import functional

from mudg.base import memory, palette, seeds
from mudg.base.errors import UsageError
from mudg.base.types import Clip, Condition, FinePatch
from mudg.core import losses, noise
from mudg.core.depth import align_depth
from mudg.core.noise import Schedule
from mudg.diffusion.network import (
    ConditionPixels,
    Finisher,
    Made,
    MDMConfig,
    PixelTruth,
    Refined,
    Refiner,
    Stacked,
    TemporalAttention,
    UNet,
    class_scores,
    finish_in_tiles,
    shares,
)
from mudg.diffusion.requests import (
    CPU,
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
)
from mudg.networks.codec import CLASSES, MODALITIES, Decoded, Modality, PatchCodec, code_to_depth, semantic_shares

SKY = palette.ID["sky"]


# model --------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class ConditionLatents:
    """A batch of conditions as the network wants them. planes f32[B,T,CONDITION_PLANES,h,w]; copy: latents of the
    condition [B,T,4,h,w] for colour and depth, class shares [B,T,19,h,w] for semantics; backdrop: as copy, of the
    backdrop's colour; seen: share of the cell that is trustworthy, [B,T,1,h,w] in [0,1], per modality; pixels: the
    condition at pixel resolution, [B*T,..]. render: of models that use renders, latents of their colour and depth
    [B,T,4,h,w], and certainty: [B,T,1,h,w]."""

    planes: Tensor
    copy: dict[Modality, Tensor]
    backdrop: Tensor
    seen: dict[Modality, Tensor]
    pixels: ConditionPixels
    render: dict[Modality, Tensor] = field(default_factory=dict)
    certainty: Tensor | None = None


@dataclass(frozen=True)
class BatchPart:
    """Clips number `first` and following of the `count` clips of a training step. Whatever training draws for a clip
    depends on (seed, step, its number), and not on how the step's batch is divided."""

    seed: int
    step: int
    first: int
    count: int
    class_weights: Tensor | None = None
    """Weights f32[19] of the classes in the cross-entropy (None = all 1)."""
    refined_share: float = 1.0
    """Share of each side of the image on which the refiner is trained."""
    reference_dropout: float = 0.2
    """Share of the clips that go without their reference image (published kind)."""

    def refined_window(self, height: int, width: int) -> tuple[slice, slice]:
        """Rows and columns of latent cells on which the refiner is trained: a share of each side, anywhere."""
        rng = seeds.numpy_rng(self.seed, self.step, "refined window")
        spans = []
        for cells in (height, width):
            size = min(cells, max(8, round(cells * self.refined_share / 8) * 8))
            start = 2 * int(rng.integers((cells - size) // 2 + 1))
            spans.append(slice(start, start + size))
        return spans[0], spans[1]


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
"""Planes of a condition: latents of colour, depth and backdrop, two masks at pixel resolution, class shares and their
sum."""
GATES = 4
"""Outputs that say how much of the condition is copied: its colour, its depth, the backdrop's colour, its classes."""
RENDER_PLANES = 2 * 4 + 2 + CLASSES + 1
"""Further planes of models that use renders: latents of their colour and depth, coverage and certainty, class shares
and their sum."""
RENDER_GATES = 2
"""Their further outputs: how much of the render's colour and of its depth is copied."""
SURROUNDINGS = 8
"""Latent cells beside a patch that are refined with it in training. What lies farther away changes the losses by 1e-4
of their value."""
LOSS_SHARES: dict[Modality, float] = {"rgb": 1.0, "depth": 1.0, "semantics": 0.3}
"""Weights of the modalities in the joint loss."""


class MDM(nn.Module):
    """Codec, noise schedule and denoising network, and what may follow them, refiner and finisher. The network's input
    is, per latent cell, the noisy latents of all modalities and `ConditionLatents.planes`. It states the clean latents
    of all modalities at once, and may copy the condition's own."""

    points_alone = False
    """The condition is filled, and recorded images are warped into it."""

    def __init__(self, config: MDMConfig) -> None:
        super().__init__()
        self.config = config
        self.codec = PatchCodec(config.codec)
        self.schedule = Schedule(config.schedule)
        noisy = sum(self.codec.channels.values())
        further = (RENDER_PLANES, RENDER_GATES) if config.renders else (0, 0)
        self.net = UNet(config, noisy + CONDITION_PLANES + further[0], noisy + GATES + further[1])
        self.net.to(memory_format=torch.channels_last)
        self.refiner: Refiner | None = None
        if config.refine_widths:
            self.refiner = Refiner(noisy, config.refine_widths, config.refine_blocks, config.renders)
            self.refiner.to(memory_format=torch.channels_last)
        self.finisher: Finisher | None = None
        if config.finish_widths:
            self.finisher = Finisher(config.finish_widths, config.finish_blocks).to(memory_format=torch.channels_last)

    @property
    def device(self) -> torch.device:
        """Where the weights lie."""
        return self.codec.rgb_mean.device

    # inputs ---------------------------------------------------------------------------------------

    def check_clip(self, frames: int, height: int, width: int) -> None:
        """UsageError unless the model can make clips of this image size; any number of frames will do."""
        del frames
        check_image_size(height, width, self.config.pixel_multiple)

    def encode_condition(self, condition: Condition | Sequence[Condition]) -> ConditionLatents:
        """Latents and mask planes of one clip's condition, or of several of the same shape (see `ConditionLatents`). A
        condition without warped images, backdrop or classes counts as one with none warped, its own colour as backdrop,
        and unknown classes."""
        given = Stacked.of([condition] if isinstance(condition, Condition) else list(condition))
        color, depth, valid, warped, ids = given.color, given.depth, given.valid, given.warped, given.ids
        check_image_size(*color.shape[-2:], self.config.pixel_multiple)
        factor = self.codec.factor
        copy: dict[Modality, Tensor] = {
            "rgb": self.codec.encode_rgb(color),
            "depth": self.codec.encode_depth(depth),
            "semantics": cell_shares(ids),
        }
        seen: dict[Modality, Tensor] = {
            "rgb": cell_means(torch.maximum(valid, warped), factor),
            "depth": cell_means(valid, factor),
            "semantics": copy["semantics"].sum(2, keepdim=True),
        }
        far = self.codec.encode_rgb(given.backdrop)
        masks = (functional.pixel_unshuffle(m, factor) for m in (valid, warped))
        planes = [copy["rgb"], copy["depth"], far, *masks, copy["semantics"], seen["semantics"]]
        pixels = ConditionPixels.of(given, self.codec, self.config.renders)
        if not self.config.renders:
            return ConditionLatents(torch.cat(planes, 2), copy, far, seen, pixels)
        shown = given.renders
        render: dict[Modality, Tensor] = {
            "rgb": self.codec.encode_rgb(shown.color),
            "depth": self.codec.encode_depth(shown.depth),
        }
        classes, certainty = cell_shares(shown.semantics), cell_means(shown.certainty, factor)
        alpha = cell_means(shown.alpha, factor)
        planes += [render["rgb"], render["depth"], alpha, certainty, classes, classes.sum(2, keepdim=True)]
        return ConditionLatents(torch.cat(planes, 2), copy, far, seen, pixels, render, certainty)

    # network --------------------------------------------------------------------------------------

    def predict(
        self, x: dict[Modality, Tensor], encoded: ConditionLatents, t: Tensor
    ) -> tuple[dict[Modality, Tensor], Tensor]:
        """One pass of the network over the noisy latents `x` [B,T,C,h,w] of all modalities at steps `t` i64[B]. Returns
        the clean latents it states, and the log-shares of the classes [B,T,19,h,w]."""
        sizes = [x[m].shape[2] for m in MODALITIES]
        given = torch.cat([*(x[m] for m in MODALITIES), encoded.planes], 2)
        out, gates = self.net(given, t).split([sum(sizes), GATES + (RENDER_GATES if encoded.render else 0)], 2)
        copy_rgb, copy_depth, copy_far, copy_classes, *copy_render = gates.split(1, 2)
        rgb, depth, classes = out.split(sizes, 2)
        if encoded.certainty is not None:
            opening = COPY_BIAS * (2 * encoded.certainty - 2)
            rgb = rgb + (copy_render[0] + opening).sigmoid() * encoded.render["rgb"]
            depth = depth + (copy_render[1] + opening).sigmoid() * encoded.render["depth"]
        rgb = rgb + (copy_rgb + COPY_BIAS * encoded.seen["rgb"]).sigmoid() * encoded.copy["rgb"]
        depth = depth + (copy_depth + COPY_BIAS * encoded.seen["depth"]).sigmoid() * encoded.copy["depth"]
        rgb = rgb + (copy_far - COPY_BIAS * encoded.seen["rgb"]).sigmoid() * encoded.backdrop
        log_shares = (classes + 4.0 * copy_classes.sigmoid() * encoded.copy["semantics"]).log_softmax(2)
        return {"rgb": rgb, "depth": depth, "semantics": self.codec.shares_to_latent(log_shares.exp())}, log_shares

    # training -------------------------------------------------------------------------------------

    def loss(self, clips: Sequence[Clip], part: BatchPart) -> Losses:
        """Denoising loss of clips of one size; all that is drawn comes from `part`. Squared error of x0 (depth: Huber)
        times 1 + SNR clipped to [1, 5], which is the v-loss with a clip; cross-entropy for class shares. Steps are
        stratified over the batch. Where depth is not valid it has no part. With a refiner its terms are added, and
        their gradient reaches the denoiser."""
        with torch.no_grad():
            encoded = self.encode_condition([clip.condition for clip in clips])
            rgb, depth, ids = (torch.stack([getattr(c, name) for c in clips]) for name in ("rgb", "depth", "semantics"))
            latents: dict[Modality, Tensor] = {
                "rgb": self.codec.encode_rgb(rgb),
                "depth": self.codec.encode_depth(depth),
                "semantics": self.codec.encode_semantics(ids),
            }
            pixels, shares = PixelTruth.of(clips, self.codec), semantic_shares(ids)
            known = functional.avg_pool2d(pixels.depth_known, self.codec.factor).unflatten(0, rgb.shape[:2])
        generator = seeds.torch_generator(part.seed, part.step, "noise")
        steps = noise.stratified_steps(part.count, len(self.schedule), generator)
        t = steps[part.first : part.first + len(clips)].to(shares.device)
        weight = noise.loss_weight(self.schedule, t).view(-1, 1, 1, 1, 1)
        eps = {}
        for m, z in latents.items():  # clip by clip: that of a clip depends on its number alone
            draws = (seeds.torch_generator(generator.initial_seed(), part.first + i, m) for i in range(len(z)))
            own = [noise.video_noise((1, *z.shape[1:]), draw, self.config.shared_noise) for draw in draws]
            eps[m] = torch.cat(own).to(z.device)
        x = {m: self.schedule.add_noise(latents[m], eps[m], t) for m in MODALITIES}
        stated, log_shares = self.predict(x, encoded, t)
        errors = {
            "rgb": losses.latent_error(stated["rgb"], latents["rgb"], weight),
            "depth": losses.latent_depth_error(stated["depth"], latents["depth"], weight, known),
            "semantics": losses.share_cross_entropy(log_shares, shares, part.class_weights),
        }
        terms = {m: float(error.detach()) for m, error in errors.items()}
        total = sum(LOSS_SHARES[m] * errors[m] for m in MODALITIES)
        if self.refiner is not None:
            cells = part.refined_window(*encoded.planes.shape[-2:])
            made = {m: z[..., cells[0], cells[1]].flatten(0, 1) for m, z in stated.items()}
            cut = [slice(s.start * self.codec.factor, s.stop * self.codec.factor) for s in cells]
            refined = self.refine(made, encoded.pixels.crop(*cut), rgb.shape[1])
            errors = self._pixel_terms(refined, pixels.crop(*cut), part, "pixel")
            errors |= self._finisher_terms(stated, encoded, clips, part)
            terms |= {name: float(error.detach()) for name, error in errors.items()}
            total = total + sum(errors.values())
        return Losses(total, terms)

    forward = loss
    """What `DistributedDataParallel` calls, to exchange gradients behind it."""

    def _finisher_terms(
        self, stated: dict[Modality, Tensor], encoded: ConditionLatents, clips: Sequence[Clip], part: BatchPart
    ) -> dict[str, Tensor]:
        """Weighted terms of the finisher on the patches that the clips have; denoiser and refiner learn nothing from
        them."""
        patches = [(number, clip.fine) for number, clip in enumerate(clips) if clip.fine is not None]
        if self.finisher is None or not patches:
            return {}
        frames = stated["rgb"].shape[1]
        with torch.no_grad():
            enlarged = [self._enlarged(stated, encoded, number, patch) for number, patch in patches]
            made = Made(*(torch.cat([getattr(m, f.name) for m in enlarged]) for f in fields(Made)))
            given = ConditionPixels.of(Stacked.of([patch.clip.condition for _, patch in patches]), self.codec, True)
            truth = PixelTruth.of([patch.clip for _, patch in patches], self.codec)
            scales = [float(patch.scale) for _, patch in patches]
            scale = torch.tensor(scales, device=made.rgb.device).repeat_interleave(frames)
        done = self.finisher(made, given, frames, scale)
        found = Refined(done.rgb, done.depth_code, class_scores(done), done.log_error)
        return self._pixel_terms(found, truth, part, "fine")

    def _enlarged(
        self, stated: dict[Modality, Tensor], encoded: ConditionLatents, number: int, patch: FinePatch
    ) -> Made:
        """What denoiser and refiner make of the patch of clip `number`, at the patch's size. Only its surroundings are
        refined."""
        frames, cells = stated["rgb"].shape[1], stated["rgb"].shape[-2:]
        factor, own = self.codec.factor, slice(number, number + 1)
        starts, sides = (patch.row, patch.column), (side // patch.scale for side in patch.clip.rgb.shape[-2:])
        around = []
        for start, side, count in zip(starts, sides, cells, strict=True):
            first = max(0, start // factor - SURROUNDINGS)
            last = min(count, -(-(start + side) // factor) + SURROUNDINGS)
            around.append(slice(first - first % 2, last + last % 2))  # the refiner's inner blocks take whole pairs
        tall, wide = (slice(cut.start * factor, cut.stop * factor) for cut in around)
        latents = {m: z[own, ..., around[0], around[1]].flatten(0, 1) for m, z in stated.items()}
        pixels = encoded.pixels.map(lambda x: x[number * frames : (number + 1) * frames]).crop(tall, wide)
        small = self._made(self.refine(latents, pixels, frames))
        size = (tall.stop - tall.start) * patch.scale, (wide.stop - wide.start) * patch.scale
        top, left = (patch.row - tall.start) * patch.scale, (patch.column - wide.start) * patch.scale
        return small.enlarged(size, (top, top + patch.clip.rgb.shape[-2]), (left, left + patch.clip.rgb.shape[-1]))

    def _made(self, refined: Refined) -> Made:
        """What the finisher starts from."""
        ids = refined.scores.argmax(1, keepdim=True).to(torch.uint8)
        return Made(refined.rgb, refined.depth_code, ids, refined.log_error)

    def _pixel_terms(self, refined: Refined, truth: PixelTruth, part: BatchPart, name: str) -> dict[str, Tensor]:
        """Weighted terms of refined pixels; depth in the sky counts threefold."""
        codec = self.config.codec
        log_per_code = math.log(codec.far_m / codec.near_m) / 2
        counted = (1.0 + 2.0 * (truth.ids == SKY).unsqueeze(1)) * truth.depth_known
        error = refined.rgb - truth.rgb
        return {
            f"{name}_rgb": losses.image_error(error, square=2.0, gradient=0.5),
            f"{name}_depth": losses.depth_code_error(refined.depth_code, truth.depth_code, counted, log_per_code),
            f"{name}_semantics": 0.2 * losses.class_error(refined.scores, truth.ids, part.class_weights),
            f"{name}_error": 0.05 * losses.stated_error(refined.log_error, error),
        }

    def refine(self, latents: dict[Modality, Tensor], condition: ConditionPixels, frames: int) -> Refined:
        """Pixels from latents [N,C,h,w] of all modalities and the condition (see `network.py`)."""
        if self.refiner is None:
            raise UsageError("this model has no refiner", where="MDM.refine")
        return self.refiner(self.codec, latents, condition, frames)

    def trained_part(self) -> nn.ModuleDict:
        """What training changes once the codec is fixed, by attribute name: the denoiser and, if there are any, refiner
        and finisher."""
        parts = {"net": self.net, "refiner": self.refiner, "finisher": self.finisher}
        return nn.ModuleDict({name: part for name, part in parts.items() if part is not None})

    def temporal_parameters(self, which: Literal["transformers", "all"]) -> set[str]:
        """Names in `trained_part` of the parameters that mix frames. There are none besides those of the attentions."""
        del which
        layers = [x for x in self.trained_part().named_modules() if isinstance(x[1], TemporalAttention)]
        return {f"{owner}.{name}" for owner, layer in layers for name, _ in layer.named_parameters()}

    # sampling -------------------------------------------------------------------------------------

    @staticmethod
    def check_request(request: SampleRequest) -> None:
        """UsageError for a setting that does not apply to this kind of model."""
        if request.guidance is not None or request.guidance_rescale is not None:
            what, got = "only published-type models have guidance", f"{request.guidance}, {request.guidance_rescale}"
            raise UsageError(what, where="guidance, guidance_rescale", got=got, remedy="leave them out")

    def image_size(self, width: int, height: int, width_px: int = 0) -> tuple[int, int]:
        """Width and height the model works at for a camera of width x height: about the area it was trained at, or
        about `width_px` wide, in the camera's aspect."""
        aspect, multiple = width / height, self.config.pixel_multiple
        if width_px:
            return sized_to_width(width_px, aspect, multiple)
        return sized_to_area(self.config.area_px, aspect, multiple)

    @torch.no_grad()
    def sample(self, condition: Condition, request: SampleRequest) -> GeneratedClip:
        """Generate one clip (see `SampleRequest`). Condition and clip are on the model's device. The condition has T
        views; H and W are multiples of `config.pixel_multiple`. Frames of which `request.known` has latents keep them.
        Measured depth (`condition.valid`) replaces generated depth."""
        self.check_request(request)
        encoded = self.encode_condition(condition)
        drawn, change = self._denoise(encoded, request)
        latents, log_error = {m: z[0] for m, z in drawn.items()}, None
        with torch.autocast(self.device.type, torch.bfloat16, enabled=request.bf16):
            if self.refiner is None:
                decoded = self.codec.decode(latents)
                confidence = confidence_of(encoded.seen["rgb"][0], change[0], self.codec.factor)
            else:
                pixels = encoded.pixels
                del encoded  # its planes are large
                made = self._made(self.refine(latents, pixels, len(condition.views)))
                decoded, log_error = self._decoded(made), made.log_error
                confidence = torch.exp(-_expected_error(log_error) / TRUSTED_ERROR)
        depth, fits = decoded.depth, []
        if request.align:
            depth, fits = align_depth(depth, condition.depth, condition.valid)
        confidence = confidence * depth_agreement(depth, condition)
        depth = settle_depth(depth, condition, self.config.codec.far_m)
        return GeneratedClip(decoded.rgb, depth, decoded.semantics, confidence, latents, tuple(fits), log_error)

    @torch.no_grad()
    def finish(self, clip: GeneratedClip, fine: Condition, *, bf16: bool = False) -> GeneratedClip:
        """A generated clip at the size of `fine`, the same views' condition at the camera's resolution (any size).
        Measured depth replaces generated depth, as in `sample`; latents and depth fits stay those of the clip.
        UsageError: the model has no finisher, or `clip` does not come from `sample`."""
        if self.finisher is None or clip.log_error is None:
            raise UsageError("this model has no finisher, or the clip is another model's", where="MDM.finish")
        code = self.codec.linear_depth_code(clip.depth)
        made = Made(clip.rgb * 2 - 1, code, clip.semantics.unsqueeze(1).to(torch.uint8), clip.log_error)

        def crop(rows: slice, columns: slice) -> ConditionPixels:
            """What the finisher reads of the condition, made tile by tile: all of it is large."""
            part = fine.cropped(rows, columns)
            memory.rest_mapped()
            return ConditionPixels.of(Stacked.of([part]), self.codec, True)

        with torch.autocast(self.device.type, torch.bfloat16, enabled=bf16):
            made = finish_in_tiles(self.finisher, made, fine.color.shape[-2:], crop, detail=True)
        decoded = self._decoded(made)
        confidence = torch.exp(-_expected_error(made.log_error) / TRUSTED_ERROR) * depth_agreement(decoded.depth, fine)
        depth = settle_depth(decoded.depth, fine, self.config.codec.far_m)
        own = {"rgb": decoded.rgb, "semantics": decoded.semantics, "log_error": made.log_error}
        return replace(clip, depth=depth, confidence=confidence, **own)

    def sampled_and_finished(
        self, condition: Condition, fine: Condition, request: SampleRequest
    ) -> tuple[GeneratedClip, GeneratedClip]:
        """As `requests.generated`, and the same clip at the size of `fine`, made by the finisher; all on the CPU."""
        clip = self.sample(condition.to(self.device), request)
        finished = self.finish(clip, fine.to(self.device), bf16=request.bf16)
        clip = clip.to(CPU)
        return clip, replace(finished, latents=clip.latents).to(CPU)

    def _decoded(self, generated: Made) -> Decoded:
        """Colour in [0, 1], depth in metres and classes i64[T,H,W] of what the refiner or the finisher made; takes its
        colour over."""
        rgb = generated.rgb.add_(1).div_(2).clamp_(0, 1)
        return Decoded(rgb, code_to_depth(generated.depth_code, self.config.codec), generated.ids[:, 0].long())

    def _denoise(self, encoded: ConditionLatents, request: SampleRequest) -> tuple[dict[Modality, Tensor], Tensor]:
        """Draw a clip; returns latents [1,T,C,h,w] and how much the colour's still changed, [1,T,1,h,w]."""
        lead, cell = encoded.planes.shape[:2], encoded.planes.shape[-2:]
        sizes = [self.codec.channels[m] for m in MODALITIES]
        generator = torch.Generator().manual_seed(seeds.key(request.seed, request.index * 64, "sample"))
        device, shared = encoded.planes.device, self.config.shared_noise
        draw = lambda: noise.video_noise((*lead, sum(sizes), *cell), generator, shared).to(device)
        known = None if request.known is None else torch.cat([request.known[m] for m in MODALITIES], 1)[None].to(device)

        def denoise(x: Tensor, t: int) -> Tensor:
            at = torch.full((lead[0],), t, device=device)
            stated, _ = self.predict(dict(zip(MODALITIES, x.split(sizes, 2))), encoded, at)
            out = torch.cat([stated[m].float() for m in MODALITIES], 2)
            return out if known is None else torch.cat([known, out[:, known.shape[1] :]], 1)

        # around all steps: the weights are converted once
        with torch.autocast(device.type, torch.bfloat16, enabled=request.bf16):
            x, estimates = denoised(denoise, draw, self.schedule, request, "x0")
        color = lambda z: z[:, :, : sizes[0]]
        return dict(zip(MODALITIES, x.split(sizes, 2))), mean_change([color(e) for e in estimates], color(x))


def _expected_error(log_error: Tensor) -> Tensor:
    """Expected absolute error of colour in [0, 1] from the logarithm of that of codes in [-1, 1]."""
    return log_error.clamp(-6, 1).exp() / 2


def cell_means(mask: Tensor, factor: int) -> Tensor:
    """Mean over the pixels of each cell, f32[B,T,1,H,W] -> f32[B,T,1,h,w]."""
    return functional.avg_pool2d(mask.flatten(0, 1), factor).unflatten(0, mask.shape[:2])


def cell_shares(ids: Tensor) -> Tensor:
    """Share of each class in each cell, u8[B,T,1,H,W] -> f32[B,T,19,h,w]."""
    return shares(ids.flatten(0, 1)).unflatten(0, ids.shape[:2])
