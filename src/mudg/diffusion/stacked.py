"""A batch of conditions as tensors of one shape, with what a condition lacks filled in."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

import torch
from torch import Tensor
from torch.nn import functional

from mudg.base import palette
from mudg.base.types import Condition, RenderPlanes
from mudg.diffusion.network import shares

NO_RENDER = -1.0
"""Coverage that stands for: there is no render."""


@dataclass(frozen=True)
class Stacked:
    """The tensors of conditions of one shape [B,T,..]; what a condition lacks is filled in: none warped, its own colour
    as backdrop, unknown classes, no render. Masks are f32."""

    color: Tensor
    depth: Tensor
    valid: Tensor
    warped: Tensor
    backdrop: Tensor
    ids: Tensor
    backdrop_ids: Tensor
    renders: RenderPlanes

    @classmethod
    def of(cls, batch: Sequence[Condition]) -> Stacked:
        """Of conditions of one shape."""
        unknown = torch.full_like(batch[0].valid, palette.UNLABELLED, dtype=torch.uint8)
        renders = [_no_render(c) if c.renders is None else c.renders for c in batch]
        return cls(
            *(torch.stack([getattr(c, name) for c in batch]) for name in ("color", "depth")),
            torch.stack([c.valid for c in batch]).float(),
            torch.stack([torch.zeros_like(c.valid) if c.warped is None else c.warped for c in batch]).float(),
            torch.stack([c.color if c.backdrop is None else c.backdrop for c in batch]),
            torch.stack([unknown if c.semantics is None else c.semantics for c in batch]),
            torch.stack([unknown if c.backdrop_semantics is None else c.backdrop_semantics for c in batch]),
            RenderPlanes(*(torch.stack([getattr(r, f.name) for r in renders]) for f in fields(RenderPlanes))),
        )


def cell_means(mask: Tensor, factor: int) -> Tensor:
    """Mean over the pixels of each cell, f32[B,T,1,H,W] -> f32[B,T,1,h,w]."""
    return functional.avg_pool2d(mask.flatten(0, 1), factor).unflatten(0, mask.shape[:2])


def cell_shares(ids: Tensor) -> Tensor:
    """Share of each class in each cell, u8[B,T,1,H,W] -> f32[B,T,19,h,w]."""
    return shares(ids.flatten(0, 1)).unflatten(0, ids.shape[:2])


def _no_render(condition: Condition) -> RenderPlanes:
    """The planes that stand for: there is no render."""
    nothing = torch.zeros_like(condition.depth)
    unknown = torch.full_like(condition.valid, palette.UNLABELLED, dtype=torch.uint8)
    return RenderPlanes(condition.color, condition.depth, nothing + NO_RENDER, nothing, unknown)
