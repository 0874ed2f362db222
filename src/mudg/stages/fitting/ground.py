"""The ground, held where it is under virtual views: what a generated view says about its colours counts, what it says about its shape
does not."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from mudg.base import log
from mudg.base.types import Gaussians
from mudg.models.scene.edited import GROUND_CLASSES
from mudg.models.scene.model import SceneModel


def ground_rows(model: SceneModel) -> Tensor:
    """Bool[N]: the Gaussians of the background whose most probable class is a ground class; none without classes."""
    if not model.classes:
        return torch.zeros(len(model.table), dtype=torch.bool, device=model.device)
    ground = torch.tensor([number in GROUND_CLASSES for number in model.classes], device=model.device)
    return ground[model.table["semantics"].detach().argmax(1)] & (model.table.labels["node"] == 0)


def ground_held(model: SceneModel, gaussians: Gaussians) -> Gaussians:
    """The same Gaussians of ``model``; positions, rotations and scales of the ground pass no gradient on. Values stay the same."""
    rows = ground_rows(model)[:, None]

    def held(column: Tensor) -> Tensor:
        return torch.where(rows, column.detach(), column)

    return replace(gaussians, means=held(gaussians.means), quats=held(gaussians.quats), scales=held(gaussians.scales))


def warn_without_ground(model: SceneModel) -> None:
    """Say that there is no ground to hold, where the model has no class of it."""
    if not set(model.classes) & set(GROUND_CLASSES):
        log.warn("virtual.hold_ground holds nothing: no label of the scene says what is ground")
