"""The features by which a render is compared with a virtual view: fixed filters, or LPIPS."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import torch
from torch import Tensor, nn

from mudg.base.errors import UsageError
from mudg.base.weights import read_checkpoint
from mudg.core import losses
from mudg.core.losses import lpips_distance, unit_features
from mudg.gaussians.settings import VirtualConfig
from mudg.networks.featnets import FilterBank, LpipsFeatures, LpipsInput, LpipsTrunk

Perception = Callable[[Tensor, Tensor, Tensor], Tensor]
"""Render ``[3, H, W]`` and target ``[3, H, W]`` in [0, 1], weight ``[1, H, W]`` -> distance, differentiable in the
render."""


def perception_of(config: VirtualConfig, device: torch.device | None = None) -> Perception:
    """The distance that ``config.perception`` names, of images on a device (None: the CPU). UsageError: LPIPS without a
    file of its weights. InputError: the file holds something else."""
    if config.perception == "filters":
        return _compared(FilterBank().to(device), losses.feature_distance)
    if not config.lpips_weights:
        what, remedy = "LPIPS needs a weight file", "set virtual.lpips_weights"
        raise UsageError(what, where="virtual.perception lpips", remedy=remedy)
    trunk = lpips_network(config.lpips_weights).to(device)
    distance = lambda render, target, weight: lpips_distance(
        render, unit_features(target), weight, trunk.channel_weights
    )
    return _compared(trunk, distance)


def lpips_network(weights: str, trunk: LpipsTrunk = "alex", given: LpipsInput = "correct") -> LpipsFeatures:
    """A network of LPIPS with the weights of a file; InputError if that holds something else."""
    return LpipsFeatures(read_checkpoint(Path(weights)), weights, trunk, given)


def _compared(features: nn.Module, distance: Callable[[list[Tensor], list[Tensor], Tensor], Tensor]) -> Perception:
    def compare(render: Tensor, target: Tensor, weight: Tensor) -> Tensor:
        with torch.no_grad():
            wanted = features(target)
        return distance(features(render), wanted, weight)

    return compare
