"""Views of an edited scene in which a diffusion model repairs what the edits touched, and nothing else.

1. Touched are the pixels whose renders with and without the edits differ, near the boxes of what was removed, moved or
   put in; and the ground about them where recorded photographs of other moments show it brighter: a shadow that stayed.
2. The model's condition is that of the edited drive (``editing/recorded.py``): points of removed objects are gone,
   those of moved ones moved; photographs do not count where such objects or their shadows were; the renders are those
   of the edited scene. What the photographs determined behind something that is gone (certainty of the render) stays as
   rendered.
3. The sample begins from the edited render. Untouched pixels stay at it at every step; touched ones are free from the
   noise level on that belongs to their kind (``HarmonizeConfig.uncovered``, ``.objects``).
4. Guard: where the model shows a road user in place of one that was removed, or none where one was put, the render
  stays.
5. The generated pixels are pasted into the render with a soft edge that lies inside the touched pixels: every other
  pixel keeps its bits.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
import torch
from numpy.typing import NDArray
from scipy import ndimage
from torch import Tensor
from torch.nn import functional

from mudg.base.errors import UsageError
from mudg.base.palette import DYNAMIC_IDS
from mudg.base.types import FusedCloud, Observation, Photo, Scene, Track, Trajectory, View
from mudg.diffusion import views as loading
from mudg.diffusion.condition import GROUND_IDS, ConditionRules, determined
from mudg.diffusion.inputs import ConditionSources
from mudg.diffusion.published import is_published, window_of
from mudg.diffusion.requests import StartClip
from mudg.diffusion.settings import HarmonizeConfig, SynthesizeConfig
from mudg.diffusion.synthesize import JobInputs, view_maker
from mudg.diffusion.views import EDITED_IMAGES_PER_VIEW, ViewMaker, recorded_images
from mudg.editing import recorded as records
from mudg.editing.apply import FACT, EditedDrive
from mudg.editing.plan import EditPlan
from mudg.editing.recorded import EditedImages, boxes_mask, ground_mask, others, touched_boxes, vacated_at
from mudg.gaussians.model import SceneModel
from mudg.gaussians.rendering import FAR_M, raster_of, render_planes, render_view
from mudg.scene.read import read_scene

DYNAMIC: Final = torch.tensor(sorted(DYNAMIC_IDS), dtype=torch.uint8)
FEATHER_PX: Final = 3
"""Generated pixels fade into the render over this many pixels, inside of what the edit touches."""
BRIGHTER: Final = 0.02
"""Ground that other moments show brighter than the render by this, 0 to 1, lay in a shadow."""
CONTACT_REACH: Final = 0.2
"""The ground this far about a new place of an object, as a share of its height, is its contact shadow and no longer
what was uncovered."""
SHARE_PER_M: Final = 1.0
SHARES: Final = 0.5, 2.0
"""The last repair: a generated view counts as much as its confidence times its metres from the recorded path, with
these bounds, beside 1 for the render."""
OVERLAP: Final = 2
"""Frames that windows share."""
PUBLISHED_OVERLAP: Final = 8
"""The same for published-type models."""


def settings_of(config: HarmonizeConfig, device: str) -> SynthesizeConfig:
    """How the model of a configuration samples. UsageError: a published-type model is to leave a render part of the
    way: it makes its clips from noise alone."""
    for name, value in {"uncovered": config.uncovered, "objects": config.objects}.items():
        if 0 < value < 1 and is_published(config.model):
            what = "a published-type model makes views from noise: it cannot stay near a render"
            raise UsageError(what, where=f"--harmonize.{name}", expected="0 or 1", got=f"{value:g}")
    own = {name: getattr(config, name) for name in ("model", "steps", "precision", "seed")}
    return SynthesizeConfig(**own, device=device, processes=1)


def check_as_recorded(fitted: SceneModel, where: str) -> None:
    """UsageError if the Gaussians are of an edited drive: photographs may still show what was removed."""
    if FACT in fitted.facts:
        what, expected = "only a fit of the drive as it was recorded can be repaired", "Gaussians made by fit"
        got, remedy = "Gaussians of an edited drive", "leave it out"
        raise UsageError(what, where=where, expected=expected, got=got, remedy=remedy)


def check_paths(config: HarmonizeConfig, frames: Mapping[str, int]) -> None:
    """UsageError for what a published-type model cannot do with paths of so many frames, by name, before anything is
    written."""
    settings_of(config, "cpu")
    for name, count in frames.items() if is_published(config.model) else ():
        if count < (window := window_of(config.model)):
            what = "a path is too short for a published-type model, whose clips have a fixed number of frames"
            expected, remedy = f"at least {window} frames", "harmonise with a small model"
            raise UsageError(what, where=name, expected=expected, got=str(count), remedy=remedy)


DrawPair = Callable[[View], tuple[Observation, Observation]]
"""Renders of a view without and with the edits."""


@dataclass(frozen=True, slots=True, eq=False)
class Touched:
    """Pixels bool[H,W] of a view that edits touch, by kind: `objects` that were moved or put in, with their shadows;
    `uncovered`: what such and removed objects stood before; `shaded`: ground where a recorded shadow may have
    stayed."""

    objects: Tensor
    uncovered: Tensor
    shaded: Tensor

    @property
    def any(self) -> Tensor:
        """All of them."""
        return self.objects | self.uncovered | self.shaded


@dataclass(frozen=True, slots=True, eq=False)
class EditedSources:
    """What the diffusion model is told of an edited drive. ``fitted``: its fitted scene. ``cloud``: edited clouds,
    without what was left behind (``cleared_cloud``). ``tracks``: edited boxes. ``photos``: recorded images with the
    pixels marked that do not show the edited drive."""

    fitted: SceneModel
    plan: EditPlan
    cloud: FusedCloud
    tracks: Sequence[Track]
    photos: Sequence[Photo]

    @classmethod
    def of(cls, drive: EditedDrive, fitted: SceneModel, recorded: Scene) -> EditedSources:
        """Of a script that was carried out on a scene with its clouds; ``fitted``: edited, ``recorded``: as it was."""
        if drive.scene is None or drive.cloud is None:
            what = "the diffusion model needs the fused clouds of the drive"
            raise UsageError(what, remedy="give --fused, as `mudg fuse` wrote it")
        plan, cloud = drive.plan, records.cleared_cloud(drive.cloud, drive.plan)
        photos = records.photos_of_edited(recorded_images(recorded, SynthesizeConfig()), plan)
        return cls(fitted, plan, cloud, drive.scene.tracks, photos)


def touched_pixels(plan: EditPlan, view: View, pictures: tuple[Observation, Observation]) -> Touched:
    """What edits touch in a view, of which there are renders without and with the edits."""
    usual, made = pictures
    before, after = (touched_boxes(plan, view.time_s, when) for when in ("before", "after"))
    differs = ((made.rgb - usual.rgb).abs().amax(0) > records.CHANGED_ABOVE).numpy()
    if differs.any():
        differs = np.asarray(ndimage.binary_dilation(differs, iterations=records.GROWN_PX), bool)
    old_ground, new_box, new_ground = ground_mask(view, before), boxes_mask(view, after), ground_mask(view, after)
    near = new_box | ground_mask(view, after, CONTACT_REACH)
    uncovered = differs & (boxes_mask(view, before) | old_ground) & ~near
    objects = differs & (near | new_ground) & ~uncovered
    ids = torch.full(made.rgb.shape[1:], 255) if made.semantics is None else made.semantics
    shaded = old_ground & torch.isin(ids, GROUND_IDS.long()).numpy() & ~new_box & ~uncovered & ~objects
    return Touched(*(torch.from_numpy(mask) for mask in (objects, uncovered, shaded)))


def soft_edge(mask: NDArray[np.bool_]) -> Tensor:
    """Weights f32[H,W]: 0 outside of a mask, growing to 1 over `FEATHER_PX` pixels inside."""
    inner = ndimage.distance_transform_edt(mask)
    return torch.from_numpy(np.clip(np.asarray(inner) / (FEATHER_PX + 1), 0, 1).astype(np.float32))


def start_clip(renders: Sequence[Observation], freedom: Sequence[Tensor], size: tuple[int, int]) -> StartClip:
    """Renders, of whatever size, as the clip of height and width ``size`` that a sample begins from; ``freedom``
    f32[H,W] of them."""
    area = lambda x: functional.interpolate(x, size=size, mode="area")
    picked = lambda x: functional.interpolate(x, size=size, mode="nearest-exact")
    unknown = torch.full_like(renders[0].rgb[0], 255)
    depth = [torch.full_like(unknown, FAR_M)[None] if r.depth is None else r.depth.nan_to_num(FAR_M) for r in renders]
    ids = [unknown if r.semantics is None else r.semantics.float() for r in renders]
    return StartClip(
        area(torch.stack([r.rgb for r in renders])),
        picked(torch.stack(depth)),
        picked(torch.stack(ids)[:, None]).to(torch.uint8),
        functional.adaptive_max_pool2d(torch.stack(list(freedom))[:, None].float(), size),
    )


def guarded(touched: Touched, render: Observation, generated: Observation, other_boxes: NDArray[np.bool_]) -> Tensor:
    """Pixels bool[H,W] of `touched` whose generated class agrees with the edits: no road user came back where one was
    removed (but for those whose `other_boxes` bool[H,W] are there), and none vanished where the render has one."""
    if render.semantics is None or generated.semantics is None:
        return touched.any
    there, wanted = (torch.isin(seen.semantics, DYNAMIC.long()) for seen in (generated, render))
    back = (touched.uncovered | touched.shaded) & there & ~torch.from_numpy(other_boxes)
    gone = touched.objects & wanted & ~there
    return touched.any & ~back & ~gone


def pasted(render: Observation, generated: Observation, weight: Tensor) -> Observation:
    """The render with generated colours of weight f32[H,W]; depth and classes are the generated ones where these weigh
    more than half. Where the weight is 0 every value keeps its bits."""
    inside, most = weight > 0, weight > 0.5
    rgb = torch.where(inside, torch.lerp(render.rgb, generated.rgb, weight), render.rgb)

    def chosen(mine: Tensor | None, theirs: Tensor | None) -> Tensor | None:
        return mine if mine is None or theirs is None else torch.where(most, theirs.to(mine.dtype), mine)

    return replace(
        render,
        rgb=rgb.clamp(0, 1) if bool(inside.any()) else rgb,
        depth=chosen(render.depth, generated.depth),
        semantics=chosen(render.semantics, generated.semantics),
        confidence=torch.where(most, generated.confidence, render.confidence),
    )


class Harmoniser:
    """Repairs the views of an edited scene, window after window along a path."""

    def __init__(
        self, sources: EditedSources, config: HarmonizeConfig, size: tuple[int, int], device: str = "auto"
    ) -> None:
        """``size``: width and height of the views."""
        settings = loading.check_config(settings_of(config, device), fitted=not is_published(config.model))
        self._sources, self._config = sources, config
        model = loading.load_any(settings)
        self._overlap, alone = PUBLISHED_OVERLAP if model.points_alone else OVERLAP, model.points_alone
        width, height = model.image_size(*size, 0)
        rules = ConditionRules(width, height, *size, images_per_view=EDITED_IMAGES_PER_VIEW, published=alone)
        render, vacated = functools.partial(render_planes, sources.fitted), vacated_at(sources.plan)
        shown = ConditionSources(sources.cloud, sources.tracks, sources.photos, rules, render, vacated)
        self._maker = ViewMaker(model, shown, settings, None if alone else self._start_at)
        self._parts: dict[int, tuple[Observation, Touched]] = {}
        """Renders of the window that is being made, by the number of their view, and what edits touch in them."""

    def _start_at(self, views: Sequence[View]) -> StartClip:
        """The renders of the window that is being made, at the size that the model works at."""
        size, config = (views[0].camera.height, views[0].camera.width), self._config
        renders, touched = zip(*self._parts.values(), strict=True)
        freedom = [config.uncovered * (t.uncovered | t.shaded) + config.objects * t.objects for t in touched]
        return start_clip(renders, freedom, size)

    def along(self, views: Sequence[View], draw: DrawPair) -> Iterator[Observation]:
        """The views of a path, in order, with the touched pixels repaired. Nothing is generated for a window that edits
        do not touch."""

        def touched(span: range) -> bool:
            before = self._parts
            self._parts = {i: before[i] if i in before else self._part(views[i], draw) for i in span}
            return any(bool((touched.objects | touched.uncovered).any()) for _, touched in self._parts.values())

        self._parts, spans = {}, self._maker.spans(len(views), self._overlap)
        for number, fresh, made in self._maker.along(views, spans, wanted=touched):
            for i in fresh:
                render, area = self._parts[i]
                yield render if made is None else self._repaired(render, area, made[2][i - spans[number].start])

    def _part(self, view: View, draw: DrawPair) -> tuple[Observation, Touched]:
        usual, made = draw(view)
        touched = touched_pixels(self._sources.plan, view, (usual, made))
        if not bool(touched.uncovered.any()):
            return made, touched
        sure = determined(render_planes(self._sources.fitted, view), ~touched.any)
        return made, replace(touched, uncovered=touched.uncovered & ~sure)

    def _repaired(self, render: Observation, touched: Touched, generated: Observation) -> Observation:
        brighter = (generated.rgb - render.rgb).mean(0).numpy()
        lit = touched.shaded & torch.from_numpy(ndimage.uniform_filter(brighter, 5) > BRIGHTER)
        objects = touched.objects & (self._config.objects > 0)
        touched = replace(touched, shaded=lit & (self._config.uncovered > 0), objects=objects)
        boxes = boxes_mask(render.view, others(self._sources.plan, render.view.time_s))
        kept = guarded(touched, render, generated, boxes) & generated.mask[0]
        return pasted(render, generated, soft_edge(kept.numpy()))


def repairing(images: EditedImages, drive: EditedDrive, recorded: Scene) -> EditedImages:
    """The same with every image of an edited run repaired, camera by camera. ``recorded``: the scene as it was; the
    views are those of the edited one."""
    raster, edited = raster_of(images.before, images.config.raster), drive.scene or recorded
    sources, config = EditedSources.of(drive, images.after, recorded), images.config.harmonize

    def draw(view: View) -> tuple[Observation, Observation]:
        return render_view(images.before, view, raster), render_view(images.after, view, raster)

    made = {}
    for name in edited.cameras:
        if views := [frame.view for frame in edited.frames if frame.view.camera.name == name]:
            size = views[0].camera.width, views[0].camera.height
            made[name] = Harmoniser(sources, config, size, images.config.device).along(views, draw)
    return replace(images, repaired=made)


class RepairedViews:
    """Draws the views of paths repaired, one path at a time and in order; any other view as the renders show it."""

    def __init__(self, harmoniser: Harmoniser, draw: DrawPair) -> None:
        self._harmoniser, self._draw = harmoniser, draw
        self._left: Iterator[tuple[View, Observation]] = iter(())
        self._views: tuple[View, ...] = ()

    def follow(self, path: Trajectory) -> None:
        """Views of this path come next."""
        self._views = path.views
        self._left = zip(path.views, self._harmoniser.along(path.views, self._draw))

    def __call__(self, view: View) -> Observation:
        """The view; of a path that is followed, repaired."""
        if not any(view is own for own in self._views):
            return self._draw(view)[1]
        return next(made for own, made in self._left if own is view)


# -- the last repair --------------------------------------------------------------------------------


class RenderMixer:
    """Views of a fit, each mixed with what the diffusion model makes of it.

    The model makes the view once more, from the fused points, the photographs and the render, and says how sure it is.
    What it makes of a view does not depend on other views: in windows of a path they come out the same to 58 dB.
    Near the recorded path the render counts for more, since photographs of the same places made it; away from there
    the generated view does (`SHARE_PER_M`).

    Args:
        inputs: folders of the scene, its clouds and the fit.

    Raises:
        UsageError: a published-type model, which makes clips of many frames from noise, or one that uses no renders.
    """

    def __init__(self, inputs: JobInputs, config: HarmonizeConfig, device: str) -> None:
        if is_published(config.model):
            what, expected = "a published-type model uses no renders and cannot repair them", "a small model"
            raise UsageError(what, where="--harmonize.model", expected=expected, got=config.model)
        self._settings = loading.check_config(settings_of(config, device), fitted=True)
        self._inputs, self._model = inputs, loading.load_any(self._settings)
        self._maker: tuple[tuple[int, int], ViewMaker] | None = None
        recorded = read_scene(inputs.scene)
        self._paths = [
            np.array([frame.view.world_from_cam[:3, 3] for frame in recorded.frames_of(name)])
            for name in recorded.cameras
        ]

    def __call__(self, view: View, render: Observation) -> Observation:
        """The view, from its render, which has its depth."""
        size = view.camera.width, view.camera.height
        if self._maker is None or self._maker[0] != size:
            self._maker = size, view_maker(self._settings, self._inputs, [view], self._model, None)
        off_m = min(off_path_m(view.world_from_cam[:3, 3], path) for path in self._paths)
        share = min(max(SHARE_PER_M * off_m, SHARES[0]), SHARES[1])
        return mixed(render, self._maker[1].make([view], 0, None)[2][0], share)


def off_path_m(place: NDArray[np.float64], path: NDArray[np.float64]) -> float:
    """Metres from a place f64[3] to a path f64[N,3] of straight pieces."""
    along = np.diff(path, axis=0, append=path[-1:])
    at = ((place - path) * along).sum(1) / np.maximum((along**2).sum(1), 1e-12)
    return float(np.linalg.norm(place - path - at.clip(0, 1)[:, None] * along, axis=1).min())


def mixed(render: Observation, generated: Observation, share: float) -> Observation:
    """The mean of a render and of the generated view with ``share`` times its confidence as weight, colour and depth;
    depth that only one of them has is taken from it. Classes and confidence are the render's."""
    weight = share * generated.confidence * generated.mask
    mean = lambda a, b: (a + weight * b) / (1 + weight)
    depth = render.depth
    if depth is not None and generated.depth is not None:
        known = torch.isfinite(depth)
        depth = torch.where(known & torch.isfinite(generated.depth), mean(depth, generated.depth), depth)
        depth = torch.where(known, depth, generated.depth)
    return replace(render, rgb=mean(render.rgb, generated.rgb).clamp(0, 1), depth=depth)
