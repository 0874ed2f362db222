"""The interface that the two diffusion models share: requests, generated clips, and their confidence.

`MDM` (`diffusion/model.py`) and `PublishedMDM` (`diffusion/published.py`) have the same methods: `check_clip`,
`image_size`, and `sample`, which makes a `GeneratedClip` from a condition and a `SampleRequest`, both on the model's
device.

Conditions are made on the CPU, and clips are used there: `generated` is the border to the model's device. It takes a
clip's condition over once and brings back the finished clip; in between only noise, drawn on the CPU so that it is the
same for every device, and latents of the window before go over.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields, replace
from typing import Any, Protocol

import torch
from torch import Tensor
from torch.nn import functional

from mudg.base.errors import UsageError
from mudg.base.types import Condition
from mudg.core import noise
from mudg.core.depth import DepthFit
from mudg.core.noise import Denoise, Prediction, Schedule
from mudg.networks.codec import Modality


@dataclass(frozen=True, eq=False)
class SampleRequest:
    """How one clip is to be generated.

    Args:
        steps: denoiser passes; 1 is the regression of the clip on its condition. The published kind needs one pass for
            each modality, and twice as many with guidance.
        seed, index: all noise is drawn from (seed, index): same in, same out.
        eta: noise added between steps, 0 to 1 (None = 1).
        guidance: published kind: weight of the guided over the unguided prediction; 1 = none (None = the model's own).
        guidance_rescale: published kind: share of the guided prediction whose spread is pulled back (None = the model's
            own).
        known: modality -> latents [k,C,h,w] of the clip's first k frames, from the previous window.
        align: bring each frame's depth to the measured scale (`core.align`).
        bf16: run the networks in bfloat16.
    """

    steps: int
    seed: int = 0
    index: int = 0
    eta: float | None = None
    guidance: float | None = None
    guidance_rescale: float | None = None
    known: Mapping[Modality, Tensor] | None = field(default=None, repr=False)
    align: bool = True
    bf16: bool = False


@dataclass(frozen=True, eq=False)
class GeneratedClip:
    """A generated clip.

    rgb f32[T,3,H,W] in [0,1]; depth f32[T,1,H,W] metres; semantics i64[T,H,W]; confidence f32[T,1,H,W] in [0,1].
    `latents`: modality -> [T,C,h,w], to be handed to the next window as `known`. `depth_fits`: one per frame, how depth
    was brought to the measured scale; empty without `SampleRequest.align`. `log_error`: of small models with a refiner,
    logarithm of the expected absolute error of colour codes (-1 to 1) f32[T,1,H,W], for `MDM.finish`.
    """

    rgb: Tensor
    depth: Tensor
    semantics: Tensor
    confidence: Tensor
    latents: dict[Modality, Tensor] = field(repr=False)
    depth_fits: tuple[DepthFit, ...] = ()
    log_error: Tensor | None = field(default=None, repr=False)

    def to(self, device: torch.device) -> GeneratedClip:
        """The same clip with its tensors on a device."""
        own = {f.name: x.to(device) for f in fields(self) if isinstance(x := getattr(self, f.name), Tensor)}
        return replace(self, **own, latents={m: z.to(device) for m, z in self.latents.items()})


# the border to the device -------------------------------------------------------------------------


class Sampling(Protocol):
    """What `generated` asks of a model."""

    @property
    def device(self) -> torch.device:
        """Where the weights lie."""
        ...

    def sample(self, condition: Condition, request: SampleRequest) -> GeneratedClip:
        """Generate one clip."""
        ...


CPU = torch.device("cpu")


def generated(model: Sampling, condition: Condition, request: SampleRequest) -> GeneratedClip:
    """A clip generated on the model's device; condition and clip are on the CPU."""
    return model.sample(condition.to(model.device), request).to(CPU)


def check_image_size(height: int, width: int, multiple: int) -> None:
    """UsageError unless both sides are positive multiples of `multiple` pixels, as the network's strides need."""
    if height % multiple or width % multiple or min(height, width) < multiple:
        raise UsageError(
            "image size does not fit the diffusion model",
            expected=f"multiples of {multiple} pixels",
            got=f"{width}x{height}",
        )


def sized_to_width(width_px: int, aspect: float, multiple: int) -> tuple[int, int]:
    """Width and height in multiples of `multiple`, about `width_px` wide, of about this aspect (width / height)."""
    width = max(multiple, round(width_px / multiple) * multiple)
    return width, max(multiple, round(width / aspect / multiple) * multiple)


def sized_to_area(area_px: int, aspect: float, multiple: int) -> tuple[int, int]:
    """Width and height in multiples of `multiple`, of about this area and this aspect (width / height).

    Of the candidates the one with the least distortion of aspect plus half the deviation of area, both as logarithms,
    wins.
    """
    best, chosen = math.inf, (multiple, multiple)
    for rows in range(1, 64):
        for columns in range(1, 128):
            w, h = columns * multiple, rows * multiple
            cost = abs(math.log(w / h / aspect)) + 0.5 * abs(math.log(w * h / area_px))
            if cost < best:
                best, chosen = cost, (w, h)
    return chosen


def denoised(
    denoise: Denoise,
    draw: Callable[[], Tensor],
    schedule: Schedule,
    request: SampleRequest,
    prediction: Prediction,
    **settings: Any,
) -> tuple[Tensor, list[Tensor]]:
    """Sample with DDIM from fresh noise.

    Args:
        denoise: the network at one step. draw: makes noise of the sample's shape.
        prediction: what the network states. settings: further settings of the sampler that the model fixes.

    Returns:
        The sample, and the estimates of it in the later half of the steps.
    """
    indices = noise.trailing_steps(len(schedule), request.steps)
    estimates: list[Tensor] = []

    def watched(x: Tensor, t: int) -> Tensor:
        stated = denoise(x, t)
        if 2 * indices.index(t) >= len(indices) - 1:
            estimates.append(noise.x0_and_eps(x, stated, schedule.alpha[t], schedule.sigma[t], prediction)[0])
        return stated

    settings |= {"prediction": prediction, "eta": 1.0 if request.eta is None else request.eta, "draw": draw}
    return noise.ddim(watched, draw(), schedule, indices, **settings), estimates


# confidence ---------------------------------------------------------------------------------------


def mean_change(estimates: list[Tensor], last: Tensor) -> Tensor:
    """How much a latent [..,C,h,w] still changed on the way to `last`: mean over channels and estimates, [..,1,h,w]."""
    return torch.stack([(e - last).abs().mean(-3, keepdim=True) for e in estimates]).mean(0)


def confidence_of(seen: Tensor, change: Tensor, factor: int) -> Tensor:
    """How far a generated pixel can be trusted, f32[T,1,H,W] in [0,1].

    Args:
        seen: [T,1,h,w] share of the latent cell that was measured or warped from a recorded image.
        change: [T,1,h,w] how much the colour latent still changed in the later half of sampling (or its spread over
            samples).
        factor: pixels per cell.

    The product of a coverage term (1 where seen, 0.35 far from anything seen, smoothed over 5 cells) and exp(-2
    change).
    """
    near = functional.avg_pool2d(seen, 5, stride=1, padding=2, count_include_pad=False)
    coverage = 0.35 + 0.65 * torch.maximum(seen, near)
    value = coverage * torch.exp(-2.0 * change)
    return functional.interpolate(value, scale_factor=float(factor)).clamp(0.0, 1.0)


def depth_agreement(depth: Tensor, condition: Condition, slack_px: int = 0) -> Tensor:
    """How far generated depth f32[T,1,H,W] agrees with what was measured nearby, f32[T,1,H,W] in [0.2, 1].

    exp(-5 |log(generated / measured)|) at measured pixels, carried over to the pixels within 2 pixels as the mean of
    those there; 1 where nothing was measured nearby. Where a surface was painted at a wrong distance, its colour is not
    to be trusted either.

    Args:
        slack_px: a measurement agrees with every depth between the least and the greatest of the pixels so near. For
            measurements of a finer grid than the image's, which lie anywhere in a pixel: near the horizon, and at
            edges, depth changes within one.
    """
    pool = lambda x: functional.avg_pool2d(x, 5, stride=1, padding=2, count_include_pad=True)
    top = lambda x: functional.max_pool2d(x, 2 * slack_px + 1, stride=1, padding=slack_px)
    points, agreement = condition.measurement, torch.empty_like(depth)
    for number, (made, measured, valid) in enumerate(zip(depth, points.depth, points.valid, strict=True)):
        seen = valid.float()  # one frame at a time: they may be large
        made, measured = made.clamp(min=0.1), measured.clamp(min=0.1)
        ratio = torch.maximum((-top(-made) / measured).log(), -(top(made) / measured).log()).clamp(min=0)
        agrees = torch.exp(-5.0 * ratio).clamp(min=0.2)
        near = pool(seen)
        agreement[number] = torch.where(near > 0, pool(agrees * seen) / near.clamp(min=1e-6), torch.ones_like(near))
    return agreement


def settle_depth(depth: Tensor, condition: Condition, far_m: float) -> Tensor:
    """Generated depth with measured depth put in wherever a point was seen, f32[T,1,H,W] metres, at most `far_m`.

    The condition's points have passed a visibility test, so they are taken as they are.
    """
    points = condition.measurement
    return torch.where(points.valid, points.depth, depth).clamp(max=far_m)
