"""Conditions of an edited drive where something stood that is not there any more.

No photograph taken then shows what is behind it. Other photographs may, taken earlier or later from elsewhere: they are warped in as
everywhere. What is left is a hole: its colours continue those around it, and nothing in it counts as seen.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import torch
from scipy import ndimage
from torch import Tensor
from torch.nn import functional

from mudg.base import palette
from mudg.base.types import View

if TYPE_CHECKING:
    from mudg.base.renders import RenderPlanes


GROUND_IDS = torch.tensor([palette.ID[name] for name in ("road", "sidewalk", "terrain")], dtype=torch.uint8)
DYNAMIC = torch.tensor(sorted(palette.DYNAMIC_IDS), dtype=torch.uint8)
KNOWN_SHARE = 0.5
"""A render shows what is there where its certainty is at least this share of the usual one of its view."""


@dataclass(frozen=True, slots=True, eq=False)
class Vacated:
    """Where edits changed a view.

    Args:
        mask: pixels bool[H,W] in which something stood that is gone, its shadow included.
        ground: depth f32[H,W] in metres of level ground there, NaN above it.
        shown: pixels bool[H,W] in which objects are new or stand anew.
        stood: pixels bool[H,W] of the mask in which it stood itself.
    """

    mask: Tensor
    ground: Tensor
    shown: Tensor
    stood: Tensor

    def known(self, render: RenderPlanes | None) -> Tensor:
        """Pixels bool[H,W] behind what is gone that other photographs determined: the fit knows what is there. Not in its shadow, which
        a fit knows just as well."""
        return torch.zeros_like(self.stood) if render is None else self.stood & determined(render, ~self.mask)


def determined(render: RenderPlanes, usual: Tensor) -> Tensor:
    """Pixels bool[H,W] that photographs determined about as well as the `usual` ones bool[H,W] of the view, by the median. A longer fit is
    more certain everywhere, so only the share counts."""
    covered = (render.alpha[0] > 0.5) & usual
    if not bool(covered.any()):
        return torch.zeros_like(covered)
    return (render.alpha[0] > 0.5) & (render.certainty[0] >= KNOWN_SHARE * render.certainty[0][covered].median())


VacatedAt = Callable[[View], Vacated]


def ground_behind(depth: Tensor, measured: Tensor, vacated: Vacated) -> Tensor:
    """Depth f32[H,W] in which vacated pixels without a `measured` bool[H,W] surface lie on the ground, where there is some."""
    there = vacated.mask & ~measured & torch.isfinite(vacated.ground)
    return torch.where(there, vacated.ground, depth)


def continued(color: Tensor, ids: Tensor, vacated: Vacated, hole: Tensor) -> tuple[Tensor, Tensor]:
    """Colours f32[3,H,W] and classes u8[H,W] with those of a `hole` bool[H,W] continued smoothly from around it: ground from ground, what
    is above it from what stands there or from the sky, nothing from objects that move."""
    ground, moving = torch.isin(ids, GROUND_IDS), torch.isin(ids, DYNAMIC)
    low = torch.isfinite(vacated.ground)
    for part, given in ((hole & low, ground), (hole & ~low, ~ground & ~moving)):
        source = given & ~hole
        if bool(part.any()) and bool(source.any()):
            filled = _pulled(color[None] * source, source.float()[None, None])[0]
            color, ids = torch.where(part, filled, color), torch.where(part, _nearest(ids, source), ids)
    return color, ids


def _pulled(color: Tensor, weight: Tensor) -> Tensor:
    """Colours where weight is 1, continued where it is 0; `color` [1,C,H,W] is 0 there."""
    if min(color.shape[-2:]) <= 2:
        return color.sum((-2, -1), keepdim=True) / weight.sum((-2, -1), keepdim=True).clamp(min=1e-6) + torch.zeros_like(color)
    pool = lambda x: functional.avg_pool2d(x, 2, ceil_mode=True, count_include_pad=False)  # noqa: E731
    share = pool(weight)
    coarse = pool(color) / share.clamp(min=1e-6)
    coarse = _pulled(coarse * (share > 0), (share > 0).float())
    larger = functional.interpolate(coarse, size=color.shape[-2:], mode="bilinear", align_corners=False)
    return color + (1 - weight) * larger


def _nearest(ids: Tensor, source: Tensor) -> Tensor:
    """Class u8[H,W] of the nearest pixel of `source` bool[H,W], for every pixel."""
    rows, columns = ndimage.distance_transform_edt(~source.numpy(), return_distances=False, return_indices=True)
    return ids[torch.from_numpy(rows.astype(np.int64)), torch.from_numpy(columns.astype(np.int64))]


def uncertain_there(render: RenderPlanes, vacated: Vacated, hole: Tensor, color: Tensor) -> RenderPlanes:
    """A render that claims to know nothing where something stood, but for what other photographs determined, and shows in the hole what the
    condition does."""
    unknown = vacated.mask & ~vacated.known(render)
    certainty = torch.where(unknown, torch.zeros_like(render.certainty), render.certainty)
    return replace(render, color=torch.where(hole, color, render.color), certainty=certainty)
