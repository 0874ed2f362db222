"""Conditions of which parts are switched off, for measuring what each part brings.

The small diffusion model was trained on whole conditions (at times without classes or renders). A condition without
points or without recorded images is therefore outside of what it has seen: such a measurement says what the trained
model makes of the rest, not what a model trained without that part would make.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Final, Literal, cast

import numpy as np
import torch
from torch import Tensor

from mudg.base import palette
from mudg.base.errors import UsageError
from mudg.base.types import Condition, FusedCloud, Photo, RenderPlanes, Track, View
from mudg.base.weather_settings import Conditions
from mudg.core import weather
from mudg.core.project import ProjectedPoints
from mudg.core.weather import DriveFacts, ShownView
from mudg.diffusion.condition import ConditionRules, RenderAt, VacatedAt, WarpSource, build_conditions

# weathered ----------------------------------------------------------------------------------------
#
# Views in other weather or light, and what the published system is given of them: points and a reference image, edited
# before they are brought to the network's size. Geometry and classes stay.


SKY: Final = palette.ID["sky"]


@dataclass(frozen=True, eq=False)
class InWeather:
    """Weather for the views of a drive: settings, light and ground of the drive, seed of drops and patches, and the
    velocity of the cameras at a time."""

    settings: Conditions
    drive: DriveFacts
    seed: int
    velocity_at: Callable[[float], tuple[float, float, float]]

    def image(self, view: View, rgb: Tensor, depth: Tensor, ids: Tensor) -> Tensor:
        """Colours f32[3,H,W] in this weather, from depth f32[1,H,W] and classes u8[1,H,W]; sky has no depth."""
        metres = torch.where(ids == SKY, torch.zeros_like(depth), depth)[0].numpy().astype(np.float32)
        shown = ShownView(view, rgb.permute(1, 2, 0).numpy(), metres, ids[0].numpy())
        made = weather.edited_view(shown, self.settings, self.seed, self.drive, self.velocity_at(view.time_s))
        return torch.from_numpy(np.ascontiguousarray(made.transpose(2, 0, 1), np.float32)).clamp(0, 1)


@dataclass(frozen=True, eq=False)
class WeatheredPoints:
    """Points and recorded images of a drive in weather, with the surfaces of a fitted scene between the points and
    behind the images."""

    how: InWeather
    render_at: RenderAt

    def points(self, view: View, seen: ProjectedPoints) -> Tensor:
        """Colours f32[3,H,W] of projected points in this weather, each at its own distance; meaningless where there are
        none."""
        shown = self.render_at(view)
        ids = torch.where(seen.valid & (shown.semantics == SKY), palette.UNLABELLED, shown.semantics)
        depth = torch.where(seen.valid, seen.depth, shown.depth)
        return self.how.image(view, torch.where(seen.valid, seen.rgb, shown.color), depth, ids.to(torch.uint8))

    def photo(self, view: View, rgb: Tensor) -> Tensor:
        """A recorded image f32[3,H,W] in this weather."""
        shown = self.render_at(view)
        return self.how.image(view, rgb, shown.depth, shown.semantics)


# with only some of its parts ----------------------------------------------------------------------


ConditionParts = Literal["full", "reference", "points", "concat", "repair"]
"""full: the whole condition. reference: the nearest recorded image alone, put up far away. points: colour and depth of
the points alone, without recorded images and renders. concat: points and that image, without anything warped by depth,
and without renders. repair: renders of a fit and that image, without anything measured. Of published-type models
reference and points leave out the other; concat shows the image in frame 0, beside the points, and not in the image
tokens."""
COVERED = 0.5
"""Opacity above which a render covers a pixel."""


@dataclass(frozen=True, slots=True)
class ConditionSources:
    """What conditions of a scene are made of: its clouds and tracks, recorded images, rules, and renders of a fit, if
    there is one; of an edited drive also where something stood that is not there any more, and, for published-type
    models, its weather."""

    cloud: FusedCloud
    tracks: Sequence[Track]
    recorded: Sequence[Photo]
    rules: ConditionRules
    render_at: RenderAt | None = None
    vacated_at: VacatedAt | None = None
    weather: InWeather | None = None


def conditions_of(
    sources: ConditionSources, parts: ConditionParts, views: Sequence[View], kept: dict[int, WarpSource]
) -> tuple[Condition, Condition]:
    """The model's condition for ``views`` with only some of its parts, and the same on the fine grid.

    Args:
        kept: recorded images that are prepared already (see ``build_conditions``).
    """
    rules = sources.rules
    cloud, tracks, recorded = sources.cloud, sources.tracks, sources.recorded
    if parts == "full":
        how, render_at = sources.weather, sources.render_at
        recolor = (
            WeatheredPoints(how, render_at) if rules.published and how is not None and render_at is not None else None
        )
        return build_conditions(
            cloud, tracks, views, recorded, rules, kept, render_at, sources.vacated_at, recolor=recolor
        )
    if parts == "repair":
        return _of_renders(sources, views, kept)
    if rules.published:
        whole = build_conditions(cloud, tracks, views, recorded, rules, kept)[0]
        if parts == "reference":
            whole = replace(whole, valid=torch.zeros_like(whole.valid), measured=None)
        else:
            whole = replace(whole, reference_in="frame" if parts == "concat" else "nowhere")
        return whole, whole
    bare = replace(rules, warp=False) if parts == "points" else replace(rules, images_per_view=0)
    built = build_conditions(cloud, tracks, views, recorded, bare, kept)
    if parts != "reference":
        return built
    small, fine = (
        replace(
            c,
            color=c.backdrop,
            semantics=c.backdrop_semantics,
            valid=torch.zeros_like(c.valid),
            depth=torch.full_like(c.depth, rules.far_m),
        )
        for c in built
    )
    return small, fine


def _of_renders(
    sources: ConditionSources, views: Sequence[View], kept: dict[int, WarpSource]
) -> tuple[Condition, Condition]:
    """Renders in the place of points, none of them measured, and the nearest recorded image. Where a render covers a
    pixel it counts as a recorded image that was warped there: it is the picture that is repaired."""
    if sources.render_at is None:
        raise UsageError("this condition needs renders of a fitted scene", got="repair")
    rules, static = replace(sources.rules, images_per_view=1), sources.cloud.static
    labels = None if static.semantics is None else static.semantics[:0]
    empty = FusedCloud(
        replace(static, xyz=static.xyz[:0], rgb=static.rgb[:0], semantics=labels), {}, sources.cloud.colors
    )
    built = build_conditions(empty, (), views, sources.recorded, rules, kept, sources.render_at)
    renders = [cast("RenderPlanes", c.renders) for c in built]
    small, fine = (
        replace(
            c,
            color=r.color,
            depth=r.depth,
            semantics=r.semantics,
            valid=torch.zeros_like(c.valid),
            warped=r.alpha > COVERED,
        )
        for c, r in zip(built, renders, strict=True)
    )
    return small, fine
