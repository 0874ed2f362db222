"""Views in other weather or light, and what the published system is given of them: points and a reference image, edited before they are
brought to the network's size. Geometry and classes stay."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np
import torch
from torch import Tensor

from mudg.base import palette
from mudg.base.types import View
from mudg.base.weather_settings import Conditions
from mudg.core import weather
from mudg.core.project import ProjectedPoints
from mudg.core.weather import DriveFacts, ShownView
from mudg.data.clips.condition import RenderAt

SKY: Final = palette.ID["sky"]


@dataclass(frozen=True, eq=False)
class InWeather:
    """Weather for the views of a drive: settings, light and ground of the drive, seed of drops and patches, and the velocity of the
    cameras at a time."""

    settings: Conditions
    drive: DriveFacts
    seed: int
    velocity_at: Callable[[float], tuple[float, float, float]]

    def image(self, view: View, rgb: Tensor, depth: Tensor, ids: Tensor) -> Tensor:
        """Colours f32[3,H,W] in this weather, from depth f32[1,H,W] and classes u8[1,H,W]; sky has no depth."""
        metres = torch.where(ids == SKY, torch.zeros_like(depth), depth)[0].numpy().astype(np.float32)
        shown = ShownView(view, rgb.permute(1, 2, 0).numpy(), metres, ids[0].numpy())
        made, _ = weather.edited_view(shown, self.settings, self.seed, self.drive, self.velocity_at(view.time_s))
        return torch.from_numpy(np.ascontiguousarray(made.transpose(2, 0, 1), np.float32)).clamp(0, 1)


@dataclass(frozen=True, eq=False)
class WeatheredPoints:
    """Points and recorded images of a drive in weather, with the surfaces of a fitted scene between the points and behind the images."""

    how: InWeather
    render_at: RenderAt

    def points(self, view: View, seen: ProjectedPoints) -> Tensor:
        """Colours f32[3,H,W] of projected points in this weather, each at its own distance; meaningless where there are none."""
        shown = self.render_at(view)
        ids = torch.where(seen.valid & (shown.semantics == SKY), palette.UNLABELLED, shown.semantics)
        depth = torch.where(seen.valid, seen.depth, shown.depth)
        return self.how.image(view, torch.where(seen.valid, seen.rgb, shown.color), depth, ids.to(torch.uint8))

    def photo(self, view: View, rgb: Tensor) -> Tensor:
        """A recorded image f32[3,H,W] in this weather."""
        shown = self.render_at(view)
        return self.how.image(view, rgb, shown.depth, shown.semantics)
