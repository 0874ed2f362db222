"""The interface that the two diffusion models share: requests, generated clips, and their confidence.

Conditions are made and clips are used on the CPU; `model_files.generated` is the border to the model's device. Noise is
drawn on the CPU, so that it is the same for every device.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, fields, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from mudg.base import log
from mudg.base.devices import SAME_CODE
from mudg.base.errors import UsageError
from mudg.base.types import Condition
from mudg.core import noise
from mudg.core.depth import DepthFit
from mudg.core.noise import Denoise, Prediction, Schedule
from mudg.core.pictures import class_colors, depth_colors, gray, to_bytes
from mudg.diffusion.settings import Precision
from mudg.networks.codec import Modality


@dataclass(frozen=True, eq=False)
class SampleRequest:
    """How one clip is to be generated. steps: denoiser passes; 1 is the regression of the clip on its condition. The
    published kind needs one pass for each modality, and twice as many with guidance. seed, index: all noise is drawn
    from (seed, index): same in, same out. eta: noise added between steps, 0 to 1 (None = 1). guidance,
    guidance_rescale: published kind (None = the model's own): weight of the guided over the unguided prediction (1 =
    none), and share of it whose spread is pulled back. known: modality -> latents [k,C,h,w] of the clip's first k
    frames, from the previous window. align: bring each frame's depth to the measured scale. bf16: run the networks in
    bfloat16."""

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
    """A generated clip. rgb f32[T,3,H,W] in [0,1]; depth f32[T,1,H,W] metres; semantics i64[T,H,W]; confidence
    f32[T,1,H,W] in [0,1]. `latents`: modality -> [T,C,h,w], to be handed to the next window as `known`. `depth_fits`:
    one per frame, how depth was brought to the measured scale; empty without `SampleRequest.align`. `log_error`: of
    small models with a refiner, logarithm of the expected absolute error of colour codes (-1 to 1) f32[T,1,H,W], for
    `MDM.finish`."""

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


def picture_row(
    colors: Iterable[Tensor], depths: Iterable[Tensor], ids: Iterable[Tensor], confidence: Tensor
) -> NDArray[np.uint8]:
    """Images f32[3,H,W], depths f32[1,H,W], classes i64[H,W] and a confidence f32[1,H,W] beside each other."""
    cells = [*map(to_bytes, colors), *(depth_colors(depth[0].numpy()) for depth in depths)]
    cells += [*(class_colors(own.numpy()) for own in ids), gray(confidence[0].numpy())]
    return np.concatenate(cells, 1)


# number formats -----------------------------------------------------------------------------------


CPU = torch.device("cpu")


def half_format(precision: Precision, device: torch.device = CPU, *, float16: bool = False) -> torch.dtype | None:
    """The half precision that convolutions and matrix products run in, None for float32. The choice is announced once.
    "auto" gives bfloat16 on CPUs that multiply in it (measured on Zen 4: a training step takes 0.55 of the time of
    float32, a sample 0.7), and on CUDA devices that have it. On other CUDA devices it gives float16 where `float16`
    says that the network bears its range, else, and on MPS, float32. UsageError: float16 where it does not apply."""
    if precision == "float16" and not (float16 and SAME_CODE.get(device.type, device.type) == "cuda"):
        what = "float16 is for published-type models on CUDA devices"
        got = f"{'a published-type' if float16 else 'another'} model on {device}"
        raise UsageError(what, where="--precision", got=got, remedy="bfloat16, or auto")
    if precision != "auto":
        chosen, reason = {"bfloat16": torch.bfloat16, "float16": torch.float16}.get(precision), f"asked for {precision}"
    elif device.type == "cpu":
        capabilities = getattr(torch.cpu, "get_capabilities", dict)()
        names = {"amx_bf16": "AMX", "avx512_bf16": "AVX-512 BF16"}
        able = [title for name, title in names.items() if capabilities.get(name, False)]
        chosen = torch.bfloat16 if able else None
        reason = f"the CPU has {able[0]}" if able else "the CPU has no bfloat16"
    elif device.type == "cuda":
        has = torch.cuda.get_device_capability(device)[0] >= 8  # what torch would otherwise emulate
        chosen = torch.bfloat16 if has else torch.float16 if float16 else None
        reason = f"{device} has {'' if has else 'no '}bfloat16"
    else:
        chosen, reason = None, f"on {device}"
    name = "float32" if chosen is None else str(chosen).removeprefix("torch.")
    log.info_once(f"diffusion model: {name} ({reason})")
    return chosen


# sizes and steps ----------------------------------------------------------------------------------


def check_image_size(height: int, width: int, multiple: int) -> None:
    """UsageError unless both sides are positive multiples of `multiple` pixels, as the network's strides need."""
    if height % multiple or width % multiple or min(height, width) < multiple:
        what = "image size does not fit the diffusion model"
        raise UsageError(what, expected=f"multiples of {multiple} pixels", got=f"{width}x{height}")


def sized_to_width(width_px: int, aspect: float, multiple: int) -> tuple[int, int]:
    """Width and height in multiples of `multiple`, about `width_px` wide, of about this aspect (width / height)."""
    width = max(multiple, round(width_px / multiple) * multiple)
    return width, max(multiple, round(width / aspect / multiple) * multiple)


def sized_to_area(area_px: int, aspect: float, multiple: int) -> tuple[int, int]:
    """Width and height in multiples of `multiple`, of about this area and this aspect (width / height): with the least
    distortion of aspect plus half the deviation of area, both as logarithms."""
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
    """Sample with DDIM from fresh noise. denoise: the network at one step. draw: makes noise of the sample's shape.
    prediction: what the network states. settings: further settings of the sampler that the model fixes. Returns the
    sample, and the estimates of it in the later half of the steps."""
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
    """How far a generated pixel can be trusted, f32[T,1,H,W] in [0,1]: a coverage term (1 where seen, 0.35 far from
    anything seen, smoothed over 5 cells) times exp(-2 change). seen: [T,1,h,w] share of the latent cell that was
    measured or warped. change: [T,1,h,w] how much the colour latent still changed in the later half of sampling.
    factor: pixels per cell."""
    near = functional.avg_pool2d(seen, 5, stride=1, padding=2, count_include_pad=False)
    coverage = 0.35 + 0.65 * torch.maximum(seen, near)
    value = coverage * torch.exp(-2.0 * change)
    return functional.interpolate(value, scale_factor=float(factor)).clamp(0.0, 1.0)


def depth_agreement(depth: Tensor, condition: Condition, slack_px: int = 0) -> Tensor:
    """How far generated depth f32[T,1,H,W] agrees with what was measured nearby, f32[T,1,H,W] in [0.2, 1]: exp(-5
    |log(generated / measured)|) at measured pixels, carried over to those within 2 pixels as the mean; 1 elsewhere.
    slack_px: a measurement agrees with every depth between the least and the greatest of the pixels so near. For
    measurements of a finer grid than the image's: near the horizon, and at edges, depth changes within a pixel."""
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
    """Generated depth with measured depth put in wherever a point was seen, f32[T,1,H,W] metres, at most `far_m`. The
    condition's points have passed a visibility test, so they are taken as they are."""
    points = condition.measurement
    return torch.where(points.valid, points.depth, depth).clamp(max=far_m)
