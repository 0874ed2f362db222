"""Views of a radiance field: observations, and pictures of what it has learnt (depth, what moves, flow)."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from mudg.base import store
from mudg.base.types import Observation, View
from mudg.core.pictures import depth_colors, gray, side_by_side, to_bytes
from mudg.models.radiance.field import RadianceField
from mudg.models.radiance.march import Budget, Rays, colors, march
from mudg.stages.fitting.rendering import COVERED
from mudg.stages.fitting.views import StoredView
from mudg.stages.radiance.rays import view_rays

RAYS_AT_ONCE = 2048
PREVIEW_RAYS = 6000
FULL_FLOW_M = 1.0
"""Flow per time step, in metres, that is drawn in full colour."""


@dataclass(frozen=True, eq=False)
class Seen:
    """A view of a field, on the CPU: rgb ``[3, H, W]``; depth (of the median, along z, metres), opacity and share of what moves ``[H, W]``;
    flow to the next time step ``[3, H, W]`` in metres, of what moves."""

    rgb: Tensor
    depth: Tensor
    opacity: Tensor
    moving: Tensor
    flow: Tensor


@torch.no_grad()
def see(field: RadianceField, view: View, budget: Budget, stride: int = 1) -> Seen:
    """March all pixels of a view, or every ``stride``-th."""
    name = view.camera.name
    rays, z_per_m = view_rays(view, field.extent, field.cameras.index(name) if name in field.cameras else 0, stride)
    parts = [
        _part(field, rays.part(begin, begin + RAYS_AT_ONCE), budget) for begin in range(0, len(rays), RAYS_AT_ONCE)
    ]
    width = -(-view.camera.width // stride)
    every = torch.cat(parts).view(-1, width, 9).permute(2, 0, 1)
    return Seen(every[:3], every[3] * z_per_m.view(-1, width), every[4], every[5], every[6:9])


def _part(field: RadianceField, rays: Rays, budget: Budget) -> Tensor:
    rays = rays.to(field.device)
    marched = march(field, rays, budget)
    moving = marched.dynamic_weights()
    flow = (moving[..., None] * marched.values.flow[:, :3].view(*moving.shape, 3)).sum(1)
    rest = torch.stack([marched.median_m, marched.opacity, moving.sum(1)], 1)
    return torch.cat([colors(field, rays, marched)[0], rest, flow], 1).cpu()


def observe(
    field: RadianceField, view: View, budget: Budget, source: str = ""
) -> Observation:
    """One view as an observation of kind "virtual", without classes; where opacity is below ``COVERED`` there is no depth."""
    seen = see(field, view, budget)
    covered = seen.opacity[None] >= COVERED
    opacity = seen.opacity[None].clamp(0, 1)
    depth = torch.where(covered, seen.depth[None], torch.nan)
    mask = torch.ones_like(covered)
    return Observation(
        view, seen.rgb.clamp(0, 1), depth, None, torch.where(covered, opacity, 1 - opacity), mask, "virtual", source
    )


def write_preview(field: RadianceField, stored: StoredView, budget: Budget, path: Path, whole: bool = False) -> None:
    """A picture of five panels: truth, colour, depth, opacity of what moves, its flow. Coarser than the view unless ``whole``."""
    pixels = stored.view.camera.width * stored.view.camera.height
    stride = 1 if whole else max(1, round((pixels / PREVIEW_RAYS) ** 0.5))
    seen = see(field, stored.view, budget, stride)
    depth = np.where(seen.opacity >= 0.5, seen.depth, np.nan)
    panels = [
        stored.rgb[::stride, ::stride],
        to_bytes(seen.rgb),
        depth_colors(depth),
        gray(seen.moving.numpy()),
        flow_colors(seen.flow.numpy()),
    ]
    store.write_image(path, side_by_side(panels))


def flow_colors(flow: NDArray[np.floating]) -> NDArray[np.uint8]:
    """Flow ``[3, H, W]`` in metres as a picture: the hue is the direction on the ground, black is at rest, bright one metre or more."""
    angle = np.arctan2(flow[1], flow[0])
    strength = np.clip(np.hypot(flow[0], flow[1]) / FULL_FLOW_M, 0, 1)
    hues = [0.5 + 0.5 * np.cos(angle - turn) for turn in (0.0, 2 * np.pi / 3, 4 * np.pi / 3)]
    return (255 * np.stack(hues, -1) * strength[..., None]).round().astype(np.uint8)
