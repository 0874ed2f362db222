"""Renders of a fitted scene as the diffusion model's condition holds them."""

from __future__ import annotations

import torch

from mudg.base.renders import RenderPlanes
from mudg.base.types import View
from mudg.models.scene.model import SceneModel
from mudg.stages.fitting.rendering import render_condition

FAR_M = 1000.0
"""Depth of the sky and of what the scene does not cover."""


def render_planes(model: SceneModel, view: View) -> RenderPlanes:
    """What a fitted scene, on any device, shows at a view: on the CPU, without the leading dimension. In the sky coverage and certainty
    are 0; a scene fitted by a version that measured no certainty counts as half certain wherever it covers."""
    seen = render_condition(model, view)
    solid = torch.isfinite(seen.depth)
    alpha = torch.where(solid, seen.alpha, 0.0)
    certainty = 0.5 * alpha if seen.certainty is None else torch.where(solid, seen.certainty, 0.0).clamp(max=alpha)
    depth = seen.depth.nan_to_num(FAR_M).clamp(max=FAR_M)
    return RenderPlanes(seen.rgb, *(x.clamp(min=0)[None] for x in (depth, alpha, certainty)), seen.semantics[None])
