"""Conditions of which parts are switched off, for measuring what each part brings.

The small diffusion model was trained on whole conditions (at times without classes or renders). A condition without points or without
recorded images is therefore outside of what it has seen: such a measurement says what the trained model makes of the rest, not what
a model trained without that part would make.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import torch

from mudg.base.errors import UsageError
from mudg.base.types import Condition, FusedCloud, Photo, Track, View
from mudg.data.clips.condition import ConditionRules, RenderAt, WarpSource, build_conditions
from mudg.data.clips.near_points import NearSweeps, near_condition
from mudg.data.clips.vacated import VacatedAt
from mudg.data.clips.weathered import InWeather, WeatheredPoints

ConditionParts = Literal["full", "reference", "points", "concat", "freevs", "repair"]
"""full: the whole condition. reference: the nearest recorded image alone, put up far away. points: colour and depth of the points alone,
without recorded images and renders. concat: points and that image, without anything warped by depth, and without renders. repair:
renders of a fit and that image, without anything measured. Of published-type models reference and points leave out the other; concat
shows the image in frame 0, beside the points, and not in the image tokens."""


COVERED = 0.5
"""Opacity above which a render covers a pixel."""


@dataclass(frozen=True, slots=True)
class ConditionSources:
    """What conditions of a scene are made of: its clouds and tracks, recorded images, rules, renders of a fit, and the log's
    sweeps, where they are needed; of an edited drive also where something stood that is not there any more, and,
    for published-type models, its weather."""

    cloud: FusedCloud
    tracks: Sequence[Track]
    recorded: Sequence[Photo]
    rules: ConditionRules
    render_at: RenderAt | None = None
    near: NearSweeps | None = None
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
    if parts == "freevs":
        if sources.near is None:
            raise UsageError("this condition needs the sweeps of the log", got=parts)
        condition = near_condition(sources.near, views, rules)
        return condition, condition
    if parts == "full":
        how, render_at = sources.weather, sources.render_at
        recolor = WeatheredPoints(how, render_at) if rules.published and how is not None and render_at is not None else None
        return build_conditions(cloud, tracks, views, recorded, rules, kept, render_at, sources.vacated_at, recolor=recolor)
    if parts == "repair":
        return _of_renders(sources, views, kept)
    if rules.published:
        whole = build_conditions(cloud, tracks, views, recorded, rules, kept)[0]
        if parts == "reference":
            whole = replace(whole, valid=torch.zeros_like(whole.valid), measured=None)
        else:
            whole = replace(whole, reference_in="frame" if parts == "concat" else "nowhere")
        return whole, whole
    points = build_conditions(cloud, tracks, views, recorded, replace(rules, warp=False), kept)
    if parts == "points":
        return points
    images = build_conditions(cloud, tracks, views, recorded, replace(rules, images_per_view=1), kept)
    small, fine = (_with_backdrop(a, b, rules, parts) for a, b in zip(points, images, strict=True))
    return small, fine


def _of_renders(
    sources: ConditionSources, views: Sequence[View], kept: dict[int, WarpSource]
) -> tuple[Condition, Condition]:
    """Renders in the place of points, none of them measured, and the nearest recorded image. Where a render covers a pixel it counts as a
    recorded image that was warped there: it is the picture that is repaired."""
    if sources.render_at is None:
        raise UsageError("this condition needs renders of a fitted scene", got="repair")
    rules, static = replace(sources.rules, images_per_view=1), sources.cloud.static
    labels = None if static.semantics is None else static.semantics[:0]
    empty = FusedCloud(replace(static, xyz=static.xyz[:0], rgb=static.rgb[:0], semantics=labels), {}, sources.cloud.colors)
    made = build_conditions(empty, (), views, sources.recorded, rules, kept, sources.render_at)

    def bare(given: Condition) -> Condition:
        shown = given.renders
        if shown is None:
            raise UsageError("this condition needs renders of a fitted scene", got="repair")
        return replace(
            given, color=shown.color, depth=shown.depth, semantics=shown.semantics, valid=torch.zeros_like(given.valid),
            warped=shown.alpha > COVERED,
        )  # fmt: skip

    small, fine = (bare(given) for given in made)
    return small, fine


def _with_backdrop(points: Condition, images: Condition, rules: ConditionRules, parts: ConditionParts) -> Condition:
    """The points with the backdrop of the images, or that backdrop alone."""
    given = replace(points, backdrop=images.backdrop, backdrop_semantics=images.backdrop_semantics)
    if parts == "concat" or images.backdrop is None:
        return given
    return replace(
        given, color=images.backdrop, semantics=images.backdrop_semantics, valid=torch.zeros_like(points.valid),
        depth=torch.full_like(points.depth, rules.far_m),
    )  # fmt: skip
