"""What a fitted scene shows at some views, as the diffusion model's condition holds it. Imports no torch."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING

from mudg.base import checks

if TYPE_CHECKING:
    import torch
    from torch import Tensor


@dataclass(frozen=True, slots=True, eq=False)
class RenderPlanes:
    """What a fitted scene shows at T views (or at one view, without the leading dimension).

    Args:
        color: f32[T, 3, H, W] in [0, 1], sky included.
        depth: f32[T, 1, H, W] metres; meaningless where ``alpha`` is small.
        alpha: f32[T, 1, H, W] in [0, 1]: coverage by Gaussians.
        certainty: f32[T, 1, H, W] in [0, 1]: how far the photographs determined what is shown; never above ``alpha``.
        semantics: u8[T, 1, H, W] class ids; 255 = unknown.
    """

    color: Tensor
    depth: Tensor
    alpha: Tensor
    certainty: Tensor
    semantics: Tensor

    def __post_init__(self) -> None:
        lead, (h, w) = tuple(self.color.shape[:-3]), tuple(self.color.shape[-2:])
        one = (*lead, 1, h, w)
        checks.check_tensors(self, color=(*lead, 3, h, w), depth=one, alpha=one, certainty=one, semantics=one)

    def to(self, device: torch.device) -> RenderPlanes:
        """The same planes on a device."""
        return self.map(lambda x: x.to(device))

    def map(self, change: Callable[[Tensor], Tensor]) -> RenderPlanes:
        """The planes with ``change`` applied to each, for example a crop or a mirror image."""
        return RenderPlanes(*(change(getattr(self, f.name)) for f in fields(self)))
