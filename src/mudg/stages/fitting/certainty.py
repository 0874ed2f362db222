"""How well the photographs constrain every Gaussian of a fitted scene: its certainty.

A render beside the recorded path is right where several photographs saw the same surface and agree about it, and where LiDAR agrees
with its depth. Three sums per Gaussian say so, over recorded views and their pixels, with the blending weight w of the Gaussian:

    views     of each view W / (W + 1), W the sum of w in pixels: the number of photographs that show it
    colour    w |render - photograph| / w, the mean difference of the pixels that it is part of
    depth     w |render - LiDAR| / (LiDAR w), the mean relative difference at the pixels that LiDAR measured

    certainty = views / (views + 1) * c / (c + colour) * d / (d + depth)

The sums are exact: w is the derivative of a rendered feature by the Gaussian's feature, so that one backward pass per view, with an
image in place of the loss's gradient, sums over all pixels at once.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from mudg.base.types import Render
from mudg.core.raster.rasterize import RasterConfig, rasterize
from mudg.models.scene.appearance import Appearance
from mudg.models.scene.model import SceneModel, compose, composite_sky
from mudg.stages.fitting.views import StoredView, TrainView

COLOR_ERROR = 0.02
"""Mean difference of colour, of [0, 1], that halves the certainty."""
DEPTH_ERROR = 0.1
"""Mean relative difference of depth that halves it. Taken for a Gaussian that LiDAR never met."""
ASSUMED_PIXELS = 0.1
"""Weight of that assumption, in pixels with LiDAR."""


@dataclass(frozen=True, eq=False)
class PhotoEvidence:
    """Sums of blending weights per Gaussian, each f32[N], over views and pixels.

    Args:
        views: number of views that show it.
        pixels: weight, in pixels. color: the same, each pixel times the mean difference of its three colours.
        lidar: weight, in pixels with LiDAR. depth: the same, each times its relative difference of depth.
    """

    views: Tensor
    pixels: Tensor
    color: Tensor
    lidar: Tensor
    depth: Tensor

    def certainty(self) -> Tensor:
        """Certainty of every Gaussian f32[N] in [0, 1]; 0 where no view shows it."""
        color = self.color / self.pixels.clamp_min(1e-12)
        depth = (self.depth + ASSUMED_PIXELS * DEPTH_ERROR) / (self.lidar + ASSUMED_PIXELS)
        seen = self.views / (self.views + 1)
        return seen * COLOR_ERROR / (COLOR_ERROR + color) * DEPTH_ERROR / (DEPTH_ERROR + depth)


def certainty_of(
    model: SceneModel,
    views: Sequence[StoredView],
    raster: RasterConfig,
    appearance: Appearance | None = None,
    most: int = 0,
) -> Tensor:
    """Certainty of every Gaussian of a model, f16[N], from recorded views, evenly chosen if there are more than ``most`` (0 = all)."""
    return evidence_of(model, views, raster, appearance, most).certainty().half()


def evidence_of(
    model: SceneModel,
    views: Sequence[StoredView],
    raster: RasterConfig,
    appearance: Appearance | None = None,
    most: int = 0,
) -> PhotoEvidence:
    """What recorded views tell about every Gaussian, those that are left out like the others; see ``certainty_of``."""
    count = min(most or len(views), len(views))
    chosen = np.unique(np.linspace(0, len(views) - 1, count).round().astype(int))
    total = torch.zeros(5, len(model.table))
    for index in chosen:
        sums = weight_sums(model, views[int(index)].as_tensors(), raster, appearance)
        total += torch.cat([(sums[:1] / (sums[:1] + 1)), sums])
    total *= len(views) / len(chosen)
    return PhotoEvidence(*total)


def weight_sums(
    model: SceneModel, view: TrainView, raster: RasterConfig, appearance: Appearance | None = None
) -> Tensor:
    """``[4, N]``: over the pixels of one view, the blending weights of every Gaussian times each of ``difference_images``."""
    with torch.no_grad():
        gaussians = compose(model, view.view.time_s, semantics=False)
        pose = None if appearance is None else appearance.world_from_cam(view.view, view.name)
    features = torch.zeros(len(gaussians), 4, requires_grad=True)
    render = rasterize(replace(gaussians, extra=features), view.view, raster, world_from_cam=pose)
    if render.extra is None:
        raise ValueError("the renderer returned no features")
    images = difference_images(model, render, view, appearance)
    (gradient,) = torch.autograd.grad(render.extra, [features], images)
    return gradient.T


@torch.no_grad()
def difference_images(model: SceneModel, render: Render, view: TrainView, appearance: Appearance | None) -> Tensor:
    """``[4, H, W]``: 1 where the photograph counts, and its difference from the render; 1 where LiDAR measured, and the relative
    difference (at most 1)."""
    rgb = composite_sky(model, view.view, render.rgb, render.alpha)
    rgb = rgb if appearance is None else appearance.colored(rgb, view.name, view.kind)
    used = view.mask[0].float()
    color = (rgb - view.rgb).abs().mean(0) * used
    lidar, depth = torch.zeros_like(used), torch.zeros_like(used)
    if view.lidar is not None and len(view.lidar.pixel):
        pixel, measured = view.lidar.pixel, view.lidar.depth_m
        lidar.view(-1)[pixel] = 1.0
        depth.view(-1)[pixel] = ((render.depth.reshape(-1)[pixel] - measured).abs() / measured).clamp(max=1)
    return torch.stack([used, color, lidar, depth])
