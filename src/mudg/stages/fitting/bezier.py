"""The fit of ``bezier``: BezierGS (Ma et al. 2025), tracked objects on learnt Bezier curves.

Published, and here: the curves of ``models/scene/bezier.py`` with their learning rates, and the losses and weights below. The loss of
curves that agree is our reading of it: a Gaussian keeps its distance from the centre of its object. Left out: the velocity of
the background, which here has no curves. Everything else is ``street_gaussians``.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import ClassVar, Final

import numpy as np
import torch
from torch import Tensor

from mudg.base import seeds
from mudg.base.palette import DYNAMIC_IDS
from mudg.base.types import FusedCloud, Scene
from mudg.core import losses, native_ops
from mudg.core.raster.rasterize import rasterize
from mudg.core.table import Table
from mudg.models.scene.bezier import BezierNode, distance_change
from mudg.models.scene.model import SceneModel
from mudg.models.scene.nodes import NodeRows, RigidNode
from mudg.stages.config import FitConfig
from mudg.stages.fitting.objects import boxes_in_view, objects_only
from mudg.stages.fitting.recipe import SCENE_UNIT_M, DrawnView, OwnRecipe
from mudg.stages.fitting.start import start_model
from mudg.stages.fitting.views import StoredView

LIDAR_WEIGHT, LIDAR_DECAY_STEPS = 1.0, 8000.0
SMOOTH_WEIGHT, OBJECTS_WEIGHT, CONSISTENCY_WEIGHT = 0.1, 0.1, 0.01
SSIM_SHARE: Final = 0.2
SKY_M: Final = 900.0 * SCENE_UNIT_M


class BezierRecipe(OwnRecipe):
    """See the module's text."""

    own_weights: ClassVar[tuple[str, ...]] = ("lidar_weight",)
    unfit: ClassVar[tuple[str, ...]] = ("poses.learn", "objects.deformable", "loss.object_weight")

    def start(
        self, scene: Scene, fused: FusedCloud, views: Sequence[StoredView], classes: tuple[int, ...], config: FitConfig
    ) -> SceneModel:
        """See ``Recipe``."""
        model = start_model(scene, fused, views, classes, config)
        columns = {name: value.detach() for name, value in model.table.columns.items()}
        table = Table(columns | {"curve": torch.zeros(len(model.table), 4, 3)}, model.table.labels)
        nodes = tuple(BezierNode.of_rigid(node) if isinstance(node, RigidNode) else node for node in model.nodes)
        return replace(model, table=table, nodes=nodes)

    def terms(self, drawn: DrawnView) -> dict[str, Tensor]:
        """See ``Recipe``."""
        render, view = drawn.render, drawn.view
        inverse = losses.inverse_depth(render.depth, render.alpha, SKY_M) * SCENE_UNIT_M
        terms = {"smooth": SMOOTH_WEIGHT * losses.edge_aware(inverse, view.rgb)}
        if view.lidar is not None and len(view.lidar.pixel):
            weight = LIDAR_WEIGHT * math.exp(-drawn.published_step / LIDAR_DECAY_STEPS)
            terms["lidar"] = weight * losses.sparse_inverse_depth(
                inverse, view.lidar.pixel, view.lidar.depth_m / SCENE_UNIT_M
            )
        if len(drawn.model.nodes) > 1:
            if view.channels is not None:
                terms["objects"] = OBJECTS_WEIGHT * objects_alone(drawn, view.channels)
            terms["consistency"] = CONSISTENCY_WEIGHT * consistency(drawn)
        return terms


def objects_alone(drawn: DrawnView, channels: Tensor) -> Tensor:
    """Colour of the objects by themselves and the difference of their opacity from the mask: pixels of a dynamic class in a box."""
    model, view = drawn.model, drawn.view
    number_of = [channel for channel, train_id in enumerate(model.classes) if train_id in DYNAMIC_IDS]
    mask = boxes_in_view(model, view.view).to(channels.device, non_blocking=True)
    mask = mask & torch.isin(channels, torch.tensor(number_of).to(channels.device))[None] & view.mask
    alone = rasterize(objects_only(drawn.gaussians), view.view, drawn.raster)
    return native_ops.photometric(alone.rgb, view.rgb * mask, SSIM_SHARE) + (alone.alpha - mask.float()).abs().mean()


def consistency(drawn: DrawnView) -> Tensor:
    """Mean over the Gaussians of objects of how much their distance from the centre, at the time of the view, differs from that at
    another time (drawn from seed and step)."""
    model, time_s = drawn.model, drawn.view.view.time_s
    table, counts = model.table, model.counts()
    other = float(seeds.numpy_rng(drawn.config.seed, drawn.step, "other time").random())
    total, rows = table["curve"].new_zeros(()), 0
    starts = np.cumsum([0, *counts])
    for node, start, count in zip(model.nodes, starts, counts):
        if isinstance(node, BezierNode) and count and node.keys_around(time_s) is not None:
            part = slice(int(start), int(start) + count)
            given = NodeRows(table["means"][part], table["quats"][part], table["logits"][part], table["sh_dc"][part],
                             {"curve": table["curve"][part]})  # fmt: skip
            total, rows = total + distance_change(node, given, (float(node.path.tau_at(time_s)), other)), rows + count
    return total / max(1, rows)
