"""Windows of generated views: the condition of each, its sample, and the observations made of it.

Whoever generates along a path (``synthesize``, repairs of edited views) goes through `windows` and asks a `ViewMaker` for each.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from mudg.base import log, palette
from mudg.base.errors import UsageError
from mudg.base.types import Condition, Frame, Observation, Photo, Scene, View
from mudg.core.raster.cpu import release_memory
from mudg.data.clips.ablated import ConditionParts, ConditionSources, conditions_of
from mudg.data.clips.condition import WarpSource
from mudg.data.clips.stacked import KeptImages
from mudg.data.scene import read_image, read_label, read_trusted_classes
from mudg.models.diffusion import GeneratedClip, SampleRequest, StartClip, generated, generated_and_finished
from mudg.models.mdm.codec import Modality
from mudg.models.mdm.model import MDM
from mudg.stages.config import SynthesizeConfig
from mudg.stages.learning import loading

SOURCE, FREEVS = "mudg_r", "freevs"
COLOR_ALONE = {FREEVS: FREEVS, "repair": "difix"}
"""Conditions of which only the colour counts, and the method that views made from them belong to."""
SKY = palette.ID["sky"]
EDITED_IMAGES_PER_VIEW = 24
"""Recorded images tried per view of an edited drive: what an object hid at one moment others show."""


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
    classes = lambda frame: read_trusted_classes(scene, frame) if config.given_classes else None  # noqa: E731
    return [Photo(frame.view, read_image(scene, frame), classes(frame), recorded_pixels(scene, frame)) for frame in frames]


def recorded_pixels(scene: Scene, frame: Frame) -> NDArray[np.bool_] | None:
    """Which pixels bool[H, W] of a frame a camera recorded; None = all. Frames of an edited drive say which are rendered."""
    return ~read_label(scene, frame, "rendered") if "rendered" in frame.labels else None


class PreparedImages(KeptImages):
    """Images made ready for warping, for all windows and trajectories that a process makes; colours as bytes where that is exact."""

    def __setitem__(self, number: int, image: WarpSource) -> None:
        coarse = (image.rgb * 255).round().clamp(0, 255).to(torch.uint8)
        super().__setitem__(number, replace(image, rgb=coarse) if torch.equal(coarse.float() / 255, image.rgb) else image)

    def __getitem__(self, number: int) -> WarpSource:
        image = super().__getitem__(number)
        return image if image.rgb.is_floating_point() else replace(image, rgb=image.rgb.float() / 255)


StartAt = Callable[[Sequence[View]], StartClip]
"""What a clip of some views, of the size that the model works at, is to stay like."""


class ViewMaker:
    """Conditions, samples and observations of one scene at one size.

    Args:
        start_at: what clips begin from, and how far they may leave it (``StartClip``).
        images: recorded images that were prepared before, for views of this size; None: none.
    """

    def __init__(
        self, model: loading.DiffusionModel, given: ConditionSources, config: SynthesizeConfig, start_at: StartAt | None = None,
        images: PreparedImages | None = None,
    ) -> None:  # fmt: skip
        if not given.recorded:
            log.warn("synthesize: no recorded image is available; holes are filled with the nearest point's colour")
        self._model, self._given, self._full_size = model, given, config.full_size
        self._parts: ConditionParts = config.condition
        self._images = PreparedImages() if images is None else images
        self._request = loading.request_of(config, loading.half_of(config) == torch.bfloat16)
        self._start_at = start_at

    def sized(self, view: View) -> View:
        """The view at the size that is written."""
        return view if self._full_size else view.resized(self._given.rules.width, self._given.rules.height)

    def make(
        self, views: Sequence[View], number: int, known: dict[Modality, Tensor] | None
    ) -> tuple[GeneratedClip, Condition, list[Observation]]:
        """Sample window `number` at `views`; `known` latents [k,C,h,w] fix its first k frames."""
        condition, fine = conditions_of(self._given, self._parts, views, self._images)
        release_memory()  # of renders for the condition: the model needs more than they do
        start = None if self._start_at is None else self._start_at(condition.views)
        request = replace(self._request, index=number, known=known, start=start)
        sample, made, made_views = self._generated(condition, fine, views, request)
        usable = torch.ones_like(made.confidence, dtype=torch.bool)
        if self._model.points_alone and not recorded_at_pose(views[0], self._given.recorded):
            usable[0] = False
        trust = made.confidence * usable
        source, color_alone = COLOR_ALONE.get(self._parts, SOURCE), self._parts in COLOR_ALONE
        observations = [
            Observation(
                view, made.rgb[i], None if color_alone else made.depth[i], None if color_alone else made.semantics[i], trust[i],
                usable[i], "virtual", source,
            )
            for i, view in enumerate(made_views)
        ]  # fmt: skip
        return sample, condition, observations

    def _generated(
        self, condition: Condition, fine: Condition, views: Sequence[View], request: SampleRequest
    ) -> tuple[GeneratedClip, GeneratedClip, tuple[View, ...]]:
        """The clip at the size the model works at; it and its views at the size that is written, without depth in the sky."""
        model = self._model
        if self._full_size and isinstance(model, MDM) and model.finisher is not None and self._parts != FREEVS:
            sample, finished = generated_and_finished(model, condition, fine, request)
            return sample, without_sky_depth(finished, fine), tuple(views)
        sample = generated(model, condition, request)
        made = without_sky_depth(sample, condition)
        if not self._full_size:
            return sample, made, condition.views
        size = views[0].camera.height, views[0].camera.width
        conditions = None if model.points_alone or self._parts == FREEVS else (condition, fine)
        return sample, enlarge(made, size, conditions), tuple(views)


def without_sky_depth(clip: GeneratedClip, condition: Condition) -> GeneratedClip:
    """The clip with NaN for the depth of what is classed as sky and was not measured."""
    sky = (clip.semantics == SKY).unsqueeze(1) & ~condition.measurement.valid
    return replace(clip, depth=torch.where(sky, torch.nan, clip.depth))


def recorded_at_pose(view: View, recorded: Sequence[Photo]) -> bool:
    """Whether a recorded image was taken where `view` is (to 5 cm and 10 mrad).

    The published model puts the reference, as it was recorded, into frame 0 of a window. On a shifted trajectory that frame is a
    picture from another place, and must not be used as if it were one from there.
    """
    for image in recorded:
        moved = image.view.cam_from_world @ view.world_from_cam
        if np.linalg.norm(moved[:3, 3]) < 0.05 and np.abs(moved[:3, :3] - np.eye(3)).max() < 0.01:
            return True
    return False


def enlarge(
    clip: GeneratedClip, size: tuple[int, int], conditions: tuple[Condition, Condition] | None
) -> GeneratedClip:
    """A clip at the size (height, width): colour bicubic, depth f32[T,1,h,w] (NaN = none) and classes nearest, confidence bilinear.

    With the clip's condition and the same at the new size, detail is put back: in colour by `add_detail`; the fine measured depth
    where it is within a tenth of the generated one; and the fine class where the clip has it in that pixel or beside it.
    """
    nearest = lambda x: functional.interpolate(x, size=size, mode="nearest-exact")  # noqa: E731
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


def finer_classes(enlarged: Tensor, made: Tensor, given: Tensor) -> Tensor:
    """Classes i64[T,H,W]: those of `given` u8[T,1,H,W] where `made` i64[T,h,w] has that class in the pixel or one beside it,
    else `enlarged` i64[T,H,W]. The outline is the given one; what is there, the model has decided."""
    size = enlarged.shape[-2:]
    around = functional.pad(made.unsqueeze(1).float(), (1, 1, 1, 1), mode="replicate")
    height, width = made.shape[-2:]
    wanted, there = given.float(), torch.zeros_like(given, dtype=torch.bool)
    for row in range(3):
        for column in range(3):
            beside = around[..., row : row + height, column : column + width]
            there |= functional.interpolate(beside, size=size, mode="nearest-exact") == wanted
    return torch.where(there[:, 0], given[:, 0].long(), enlarged)


def add_detail(rgb: Tensor, small: Condition, full: Condition) -> Tensor:
    """Enlarge generated colour f32[T,3,h,w] to the size of `full`, with the detail that the warped images have there.

    Where the generated colour agrees with the small condition, the finer structure of the full condition (its difference
    from its own reduced copy) is added; the weight falls with the disagreement, to nothing at a difference of 0.12.
    """
    size = full.color.shape[-2:]
    larger = lambda x: functional.interpolate(x, size=size, mode="bicubic", align_corners=False)  # noqa: E731
    reduced = functional.interpolate(full.color, size=rgb.shape[-2:], mode="area")
    detail = full.color - larger(reduced)
    apart = torch.maximum((rgb - small.color).abs(), (rgb - reduced).abs()).amax(1, keepdim=True)
    seen = small.valid if small.warped is None else small.valid | small.warped
    weight = (1 - functional.max_pool2d(apart, 3, stride=1, padding=1) / 0.12).clamp(0, 1) * seen
    weight = functional.interpolate(weight, size=size, mode="bilinear", align_corners=False)
    return (larger(rgb) + weight * detail).clamp(0, 1)
