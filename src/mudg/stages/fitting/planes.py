"""Renders of a fitted scene as the diffusion model's condition holds them."""

from __future__ import annotations

import torch

from mudg.base import palette
from mudg.base.types import RenderPlanes, View
from mudg.core.raster.rasterize import RasterConfig
from mudg.models.scene.model import SceneModel
from mudg.stages.fit import NEAR_M, render_view

FAR_M = 1000.0
"""Depth of the sky and of what the scene does not cover."""


def render_planes(model: SceneModel, view: View) -> RenderPlanes:
    """What a fitted scene shows at a view (without the leading dimension)."""
    seen = render_view(model, view, RasterConfig(near_m=NEAR_M))
    shape = (1, *seen.rgb.shape[-2:])
    depth = torch.full(shape, FAR_M) if seen.depth is None else seen.depth.nan_to_num(FAR_M).clamp(max=FAR_M)
    solid = torch.isfinite(seen.depth) if seen.depth is not None else torch.zeros(shape, dtype=torch.bool)
    alpha = torch.where(solid, seen.confidence, 0.0)
    unknown = torch.full(shape, palette.UNLABELLED, dtype=torch.uint8)
    ids = unknown if seen.semantics is None else seen.semantics.to(torch.uint8).reshape(shape)
    return RenderPlanes(seen.rgb, depth, alpha, alpha, ids)
