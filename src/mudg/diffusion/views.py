"""Windows of generated views: the condition of each, its sample, and the observations made of it.

Whoever generates along a path (``synthesize``, repairs of edited views) asks a `ViewMaker` for the windows `along` it.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from mudg.base import log, palette
from mudg.base.devices import NETWORK_KINDS, choose_device
from mudg.base.errors import ResourceError, UsageError
from mudg.base.types import Condition, Frame, Observation, Photo, Scene, View
from mudg.core.raster.cpu import release_memory
from mudg.diffusion import memory_plan, model_files, published
from mudg.diffusion.condition import PreparedImages
from mudg.diffusion.inputs import ConditionParts, ConditionSources, conditions_of
from mudg.diffusion.memory_plan import half_format
from mudg.diffusion.model import MDM
from mudg.diffusion.published import PublishedMDM, WorkSplit, is_published
from mudg.diffusion.requests import GeneratedClip, SampleRequest, generated
from mudg.diffusion.settings import SynthesizeConfig
from mudg.networks.codec import Modality
from mudg.scene.labels import read_label, read_trusted_classes
from mudg.scene.read import read_image

# the diffusion model that a synthesize configuration names, of whichever kind, ready to sample ----


FEW_STEPS = 20
DiffusionModel = MDM | PublishedMDM


def check_config(config: SynthesizeConfig, fitted: bool, *, weather: bool = False) -> SynthesizeConfig:
    """The configuration with its device chosen, and the number of processes that its model wants; without reading
    weights of a published-type model.

    Args:
        fitted: whether a fitted scene is given too. weather: and tells the distances by which views are brought into
            other weather.

    Raises:
        UsageError: a setting that does not apply to this kind of model, or to the device. InputError: no such model.
        ResourceError: no such device.
    """
    device = choose_device(config.device, "diffusion model", NETWORK_KINDS)
    if device.type != "cpu" and config.processes > 1:
        raise UsageError(
            f"on {device} one process makes all trajectories",
            where="--processes",
            expected="0 or 1",
            got=str(config.processes),
            remedy="leave it out, or give --device cpu",
        )
    config = replace(config, device=str(device))
    half_of(config)
    full_size = is_published(config.model)
    if not full_size:
        MDM.check_request(request_of(config))
    if full_size and fitted and not weather:
        raise UsageError(
            "a published-type model uses a fitted scene for weather and light of --edits only",
            where="--fitted",
            remedy="leave it out",
        )
    repairs = config.condition == "repair"
    if repairs and not (fitted or full_size):
        raise UsageError(
            "this condition is made of renders of a fitted scene",
            where="--condition",
            got="repair",
            remedy="give the folder of a finished fit as --fitted",
        )
    if full_size and repairs:
        raise UsageError(
            "a published-type model does not know this condition",
            where="--condition",
            expected="full, reference, points, concat",
            got="repair",
            remedy="leave it out, or choose another --model",
        )
    if config.condition != "full" and fitted and not repairs:
        raise UsageError(
            "parts of the condition cannot be switched off here",
            where="--condition",
            expected="full",
            got="--fitted: renders are left out of such a condition",
            remedy="leave out --condition or --fitted",
        )
    if full_size:
        return replace(config, processes=config.processes or 1)  # one copy of a large model in memory
    if config.memory_budget_gb:
        what = "this setting applies to published-type models only"
        raise UsageError(what, where="--memory-budget-gb", remedy="leave it out")
    model = model_files.load(config.model)  # fails now rather than in every process
    if fitted and not model.config.renders:
        raise UsageError(
            "this model was not trained with renders of a fitted scene",
            where="--fitted",
            got=config.model,
            remedy="leave it out, or choose another --model",
        )
    return config


def request_of(config: SynthesizeConfig, bf16: bool = False) -> SampleRequest:
    """What a configuration asks of the model for every window; the window's own number and known frames are to be put
    in."""
    return SampleRequest(
        config.steps,
        config.seed,
        eta=config.eta,
        guidance=config.guidance,
        guidance_rescale=config.guidance_rescale,
        align=config.align_depth,
        bf16=bf16,
    )


def half_of(config: SynthesizeConfig) -> torch.dtype | None:
    """The half precision that a configuration's model computes in, None for float32. Published-type models bear
    float16."""
    device = choose_device(config.device, "diffusion model", NETWORK_KINDS)
    return half_format(config.precision, device, float16=is_published(config.model))


def load_any(config: SynthesizeConfig) -> DiffusionModel:
    """The model of a configuration.

    On another device than the CPU a published-type model has its weights in the number format that `precision` says.
    Its work is cut to fit `memory_budget_gb`, or, without one, what is free on a CUDA device.

    Raises:
        ResourceError: it does not fit however it is cut, or no such device.
    """
    device = choose_device(config.device, "diffusion model", NETWORK_KINDS)
    if not is_published(config.model):
        return model_files.load(config.model).to(device)
    if config.steps < FEW_STEPS:
        log.warn(
            f"synthesize: the published model was trained for 50 denoising steps, but --steps is {config.steps}"
            " (recommended: --steps 50)"
        )
    half = half_of(config)
    dtype = None if device.type == "cpu" else half or torch.float32
    model = published.load(Path(config.model), dtype=dtype)
    model.split = WorkSplit(frames_at_once=1)
    free_gb = torch.cuda.mem_get_info(device)[0] / 1e9 if device.type == "cuda" else 0.0
    budget_gb = config.memory_budget_gb or free_gb  # 0: unknown
    if budget_gb:
        model.split = _choose_split(model, config, budget_gb, 4 if half is None else 2)
    tower = model.image
    if model.split.offload:
        model.image = torch.nn.Identity()
    model.to(device).image = tower
    return model


def _choose_split(model: PublishedMDM, config: SynthesizeConfig, budget_gb: float, bytes_per_value: int) -> WorkSplit:
    """How the model's work is cut to fit a memory budget in GB."""
    split, peak_bytes = memory_plan.choose(
        memory_plan.needs_of(model.config, bytes_per_value),
        int(budget_gb * 1e9),
        guidance=config.guidance != 1,
        offload=(False,) if config.device == "cpu" else (False, True),
    )
    if peak_bytes > budget_gb * 1e9:
        raise ResourceError(
            "the model does not fit into the memory budget, however its work is split",
            where="--memory-budget-gb" if config.memory_budget_gb else f"free memory of --device {config.device}",
            expected=f">= {peak_bytes / 1e9:.1f} GB",
            got=f"{budget_gb:.4g} GB",
            remedy="use the 320x512 model, or bfloat16",
        )
    log.info(
        f"synthesize: modalities {'together' if split.modalities_together else 'one by one'}, guidance "
        f"{'together' if split.guidance_together else 'in two passes'}, {split.frames_at_once} frames per decoding, "
        f"image tower {'on the CPU' if split.offload else 'kept'}, "
        f"about {peak_bytes / 1e9:.1f} GB at most"
    )
    return split


# views --------------------------------------------------------------------------------------------


SKY = palette.ID["sky"]
EDITED_IMAGES_PER_VIEW = 24
"""Recorded images tried per view of an edited drive: what an object hid at one moment others show."""


def source_of(condition: ConditionParts) -> str:
    """The method that views made from a condition belong to. Of repaired renders only the colour counts."""
    return "difix" if condition == "repair" else "mudg_r"


def windows(frames: int, window: int, overlap: int) -> list[range]:
    """Frame ranges of the windows: all `frames` covered, each sharing at least `overlap` with the one before, the last
    one ending at the last frame. Fewer frames than a window give one short window.

    Raises:
        UsageError: the overlap leaves no new frame per window.
    """
    if overlap >= window:
        raise UsageError("the overlap is as long as a window", expected=f"overlap < {window}", got=str(overlap))
    if frames <= window:
        return [range(frames)]
    starts = list(range(0, frames - window, window - overlap)) + [frames - window]
    return [range(start, start + window) for start in starts]


def recorded_images(scene: Scene, config: SynthesizeConfig) -> list[Photo]:
    """Recorded images that may be warped in, of all cameras, with the classes that may be given."""
    frames = scene.frames_in("train")
    classes = lambda frame: read_trusted_classes(scene, frame) if config.given_classes else None
    return [
        Photo(frame.view, read_image(scene, frame), classes(frame), recorded_pixels(scene, frame)) for frame in frames
    ]


def recorded_pixels(scene: Scene, frame: Frame) -> NDArray[np.bool_] | None:
    """Which pixels bool[H, W] of a frame a camera recorded; None = all. Frames of an edited drive say which are
    rendered."""
    return ~read_label(scene, frame, "rendered") if "rendered" in frame.labels else None


class ViewMaker:
    """Conditions, samples and observations of one scene at one size.

    Args:
        images: recorded images that were prepared before, for views of this size; None: none.
    """

    def __init__(
        self,
        model: DiffusionModel,
        sources: ConditionSources,
        config: SynthesizeConfig,
        images: PreparedImages | None = None,
    ) -> None:
        if not sources.recorded:
            log.warn("synthesize: no recorded image is available; holes are filled with the nearest point's colour")
        self._model, self._given, self._full_size = model, sources, config.full_size
        self._parts: ConditionParts = config.condition
        self._images = PreparedImages() if images is None else images
        self._request = request_of(config, half_of(config) == torch.bfloat16)

    def sized(self, view: View) -> View:
        """The view at the size that is written."""
        return view if self._full_size else view.resized(self._given.rules.width, self._given.rules.height)

    def spans(self, frames: int, overlap: int) -> list[range]:
        """The windows of a path of so many frames (see `windows`)."""
        window = self._model.config.window
        return windows(frames, window, min(overlap, window - 1))

    def along(
        self,
        views: Sequence[View],
        spans: Sequence[range],
        first: int = 0,
        tail: Mapping[Modality, Tensor] | None = None,
    ) -> Iterator[tuple[int, range, tuple[GeneratedClip, Condition, list[Observation]]]]:
        """The windows of a path one after another; each continues the one before.

        Args:
            first, tail: number of the window to begin with, and the latents of the one before, of an interrupted run.

        Returns, of each: its number, its frames that are in none before, and what `make` gives.
        """
        done = spans[first - 1].stop if first else 0
        for number in range(first, len(spans)):
            span = spans[number]
            shared = done - span.start
            known = {m: z[-shared:] for m, z in tail.items()} if shared and tail else None
            made = self.make([views[i] for i in span], number, known)
            yield number, range(done, span.stop), made
            done, tail = span.stop, made[0].latents
            del made  # before the next window is made

    def make(
        self, views: Sequence[View], number: int, known: dict[Modality, Tensor] | None
    ) -> tuple[GeneratedClip, Condition, list[Observation]]:
        """Sample window `number` at `views`; `known` latents [k,C,h,w] fix its first k frames."""
        condition, fine = conditions_of(self._given, self._parts, views, self._images)
        release_memory()  # of renders for the condition: the model needs more than they do
        request = replace(self._request, index=number, known=known)
        sample, made, made_views = self._generated(condition, fine, views, request)
        usable = torch.ones_like(made.confidence, dtype=torch.bool)
        if self._model.points_alone and not recorded_at_pose(views[0], self._given.recorded):
            usable[0] = False
        trust = made.confidence * usable
        source, nothing = source_of(self._parts), [None] * len(made_views)
        depth, ids = (nothing, nothing) if self._parts == "repair" else (made.depth, made.semantics)
        planes = zip(made_views, made.rgb, depth, ids, trust, usable, strict=True)
        return sample, condition, [Observation(*one, "virtual", source) for one in planes]

    def _generated(
        self, condition: Condition, fine: Condition, views: Sequence[View], request: SampleRequest
    ) -> tuple[GeneratedClip, GeneratedClip, tuple[View, ...]]:
        """The clip at the size the model works at; it and its views at the size that is written, without depth in the
        sky."""
        model = self._model
        if self._full_size and isinstance(model, MDM) and model.finisher is not None:
            sample, finished = model.sampled_and_finished(condition, fine, request)
            return sample, without_sky_depth(finished, fine), tuple(views)
        sample = generated(model, condition, request)
        made = without_sky_depth(sample, condition)
        if not self._full_size:
            return sample, made, condition.views
        size = views[0].camera.height, views[0].camera.width
        conditions = None if model.points_alone else (condition, fine)
        return sample, enlarge(made, size, conditions), tuple(views)


def without_sky_depth(clip: GeneratedClip, condition: Condition) -> GeneratedClip:
    """The clip with NaN for the depth of what is classed as sky and was not measured."""
    sky = (clip.semantics == SKY).unsqueeze(1) & ~condition.measurement.valid
    return replace(clip, depth=torch.where(sky, torch.nan, clip.depth))


def recorded_at_pose(view: View, recorded: Sequence[Photo]) -> bool:
    """Whether a recorded image was taken where `view` is (to 5 cm and 10 mrad).

    The published model puts the reference, as it was recorded, into frame 0 of a window. On a shifted trajectory that
    frame is a picture from another place, and must not be used as if it were one from there.
    """
    moves = (image.view.cam_from_world @ view.world_from_cam for image in recorded)
    return any(np.linalg.norm(m[:3, 3]) < 0.05 and np.abs(m[:3, :3] - np.eye(3)).max() < 0.01 for m in moves)


def enlarge(
    clip: GeneratedClip, size: tuple[int, int], conditions: tuple[Condition, Condition] | None
) -> GeneratedClip:
    """A clip at the size (height, width): colour bicubic, depth f32[T,1,h,w] (NaN = none) and classes nearest,
    confidence bilinear.

    With the clip's condition and the same at the new size, detail is put back: in colour by `add_detail`; the fine
    measured depth where it is within a tenth of the generated one; and the fine class where the clip has it in that
    pixel or beside it.
    """
    nearest = lambda x: functional.interpolate(x, size=size, mode="nearest-exact")
    depth, ids = nearest(clip.depth), nearest(clip.semantics.unsqueeze(1).float())[:, 0].long()
    if conditions is None:
        rgb = functional.interpolate(clip.rgb, size=size, mode="bicubic", align_corners=False).clamp(0, 1)
    else:
        small, fine = conditions
        rgb = add_detail(clip.rgb, small, fine)
        close = fine.valid & ((fine.depth - depth).abs() < 0.1 * depth)
        depth = torch.where(close, fine.depth, depth)
        if fine.semantics is not None:
            ids = finer_classes(ids, clip.semantics, fine.semantics)
    trust = functional.interpolate(clip.confidence, size=size, mode="bilinear", align_corners=False)
    return replace(clip, rgb=rgb, depth=depth, semantics=ids, confidence=trust)


def finer_classes(enlarged: Tensor, generated: Tensor, given: Tensor) -> Tensor:
    """Classes i64[T,H,W]: those of `given` u8[T,1,H,W] where `generated` i64[T,h,w] has that class in the pixel or one
    beside it, else `enlarged` i64[T,H,W]. The outline is the given one; what is there, the model has decided."""
    size = enlarged.shape[-2:]
    around = functional.pad(generated.unsqueeze(1).float(), (1, 1, 1, 1), mode="replicate")
    height, width = generated.shape[-2:]
    wanted, there = given.float(), torch.zeros_like(given, dtype=torch.bool)
    for row in range(3):
        for column in range(3):
            beside = around[..., row : row + height, column : column + width]
            there |= functional.interpolate(beside, size=size, mode="nearest-exact") == wanted
    return torch.where(there[:, 0], given[:, 0].long(), enlarged)


def add_detail(rgb: Tensor, small: Condition, full: Condition) -> Tensor:
    """Enlarge generated colour f32[T,3,h,w] to the size of `full`, with the detail that the warped images have there.

    Where the generated colour agrees with the small condition, the finer structure of the full condition (its
    difference from its own reduced copy) is added; the weight falls with the disagreement, to nothing at a difference
    of 0.12.
    """
    size = full.color.shape[-2:]
    larger = lambda x: functional.interpolate(x, size=size, mode="bicubic", align_corners=False)
    reduced = functional.interpolate(full.color, size=rgb.shape[-2:], mode="area")
    detail = full.color - larger(reduced)
    apart = torch.maximum((rgb - small.color).abs(), (rgb - reduced).abs()).amax(1, keepdim=True)
    seen = small.valid if small.warped is None else small.valid | small.warped
    weight = (1 - functional.max_pool2d(apart, 3, stride=1, padding=1) / 0.12).clamp(0, 1) * seen
    weight = functional.interpolate(weight, size=size, mode="bilinear", align_corners=False)
    return (larger(rgb) + weight * detail).clamp(0, 1)
