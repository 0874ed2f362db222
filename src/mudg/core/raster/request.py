"""What the raster backends receive, and how they put the pictures of several views together."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mudg.base.types import Gaussians, RasterTrace, Render, View

if TYPE_CHECKING:
    from mudg.core.raster.rasterize import RasterConfig


@dataclass(frozen=True, slots=True)
class Request:
    """A checked call of ``core.raster.rasterize``.

    Args:
        views: one or more, all of one image size.
        batched: whether the result has a leading view dimension (always so for more than one view).
        backgrounds: one colour [3] (or None, black) per view.
        poses: world_from_cam [4, 4] per view, or None where the view's own is meant.
    """

    gaussians: Gaussians
    views: tuple[View, ...]
    batched: bool
    config: RasterConfig
    sh_degree: int
    backgrounds: tuple[Tensor | None, ...]
    poses: tuple[Tensor | None, ...]
    absgrad: bool

    def pose(self, index: int) -> Tensor:
        """world_from_cam of one view, [4, 4]."""
        given = self.poses[index]
        return torch.from_numpy(self.views[index].world_from_cam.copy()) if given is None else given


@dataclass(frozen=True, slots=True)
class Drawn:
    """One view: rgb [3, H, W], depth [1, H, W], alpha [1, H, W], extra [C, H, W] or None, radii i32[N, 2]."""

    rgb: Tensor
    depth: Tensor
    alpha: Tensor
    extra: Tensor | None
    radii: Tensor


def harmonics(gaussians: Gaussians) -> Tensor:
    """All spherical harmonics in one tensor, [N, K, 3]; a copy if they are kept in two."""
    return gaussians.sh if gaussians.sh_rest is None else torch.cat([gaussians.sh, gaussians.sh_rest], 1)


def trace_leaves(request: Request, like: Tensor, requires_grad: bool) -> tuple[Tensor, tuple[Tensor, ...]]:
    """The leaf ``means2d`` of the trace ([N, 2], or [V, N, 2] for a batch), and the part of it that belongs to each
    view."""
    count, views = len(request.gaussians), len(request.views)
    if not request.batched:
        leaf = torch.zeros(count, 2, dtype=like.dtype, device=like.device, requires_grad=requires_grad)
        return leaf, (leaf,)
    leaf = torch.zeros(views, count, 2, dtype=like.dtype, device=like.device, requires_grad=requires_grad)
    return leaf, leaf.unbind(0)


def joined(request: Request, drawn: Sequence[Drawn], means2d: Tensor, absolute: Tensor | None) -> Render:
    """The Render of all views; ``absolute`` is shaped like ``means2d``."""
    first = drawn[0]
    if not request.batched:
        trace = RasterTrace(means2d, first.radii, first.radii[:, 0] > 0, absolute)
        return Render(rgb=first.rgb, depth=first.depth, alpha=first.alpha, extra=first.extra, trace=trace)
    radii = torch.stack([one.radii for one in drawn])
    features = [one.extra for one in drawn if one.extra is not None]
    return Render(
        rgb=torch.stack([one.rgb for one in drawn]),
        depth=torch.stack([one.depth for one in drawn]),
        alpha=torch.stack([one.alpha for one in drawn]),
        extra=torch.stack(features) if features else None,
        trace=RasterTrace(means2d, radii, radii[..., 0] > 0, absolute),
    )
