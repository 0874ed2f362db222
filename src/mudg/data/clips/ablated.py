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

ConditionParts = Literal["full", "reference", "points", "concat", "freevs"]
"""full: the whole condition. reference: the nearest recorded image alone, put up far away. points: colour and depth of the points alone,
without recorded images and renders. concat: points and that image, without anything warped by depth, and without renders."""


@dataclass(frozen=True, slots=True)
class ConditionSources:
    """What conditions of a scene are made of: its clouds and tracks, recorded images, rules, renders of a fit, and the log's
    sweeps, where they are needed; of an edited drive also where something stood that is not there any more."""

    cloud: FusedCloud
    tracks: Sequence[Track]
    recorded: Sequence[Photo]
    rules: ConditionRules
    render_at: RenderAt | None = None
    near: NearSweeps | None = None
    vacated_at: VacatedAt | None = None


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
        return build_conditions(cloud, tracks, views, recorded, rules, kept, sources.render_at, sources.vacated_at)
    points = build_conditions(cloud, tracks, views, recorded, replace(rules, warp=False), kept)
    if parts == "points":
        return points
    images = build_conditions(cloud, tracks, views, recorded, replace(rules, images_per_view=1), kept)
    small, fine = (_with_backdrop(a, b, rules, parts) for a, b in zip(points, images, strict=True))
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
