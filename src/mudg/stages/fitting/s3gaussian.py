"""The fit of ``s3gaussian``: S3Gaussian (Huang et al. 2024), a dynamic street without boxes, moved by a field of place and time.

Published, and here: the field of ``models/scene/hexplane.py``, a static first stage, losses and weights below, no sky. Left out: the
head that imitates features of a vision network. Different (``docs/baselines.md``): changes of colour of the constant band only; planes
are small unless asked for; the field is asked only for Gaussians near the frustum. Terms are divided by 1.2, since the common
colour term has weights of sum 1 and the published one L1 + 0.2 (1 - SSIM).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import ClassVar, Final

import numpy as np
import torch
from torch import Tensor

from mudg.base import log
from mudg.base.types import FusedCloud, Scene
from mudg.core import losses
from mudg.core.hex_planes import PlaneSizes
from mudg.core.table import Table
from mudg.models.scene.hexplane import SHORT_GAIN, HexPlaneNode, plane_smoothness
from mudg.models.scene.model import SceneModel
from mudg.stages.config import FitConfig
from mudg.stages.fitting.recipe import BOX_SETTINGS, DrawnView, OwnRecipe
from mudg.stages.fitting.schedule import FIELD_STEPS
from mudg.stages.fitting.timed import timed_points
from mudg.stages.fitting.views import StoredView, TrainView

STATIC_SHARE: Final = 5 / 55
"""Share of the run before the field joins (published: 5000 steps, then 50,000)."""
SSIM_SHARE: Final = 0.2
LIDAR_WEIGHT, LIDAR_SPAN_M = 0.5, 80.0
MOVE_WEIGHT, COLOR_WEIGHT = 0.001, 0.001
SPACE_WEIGHT, TIME_WEIGHT, FLAT_WEIGHT = 1e-4, 0.01, 1e-4
SIZES: Final = PlaneSizes(features=8, levels=2, space=64, time=25, width=64)
"""Of the planes and networks (published: 32 features, 4 levels)."""
FRAMES_PER_CELL: Final = 2
"""Frames of a cell of time (published: 25 cells for 50 frames): what lies between two shown frames must not have one of its own."""
BOX_MARGIN: Final = 0.02
"""The box of the field is that of the LiDAR points, grown by this share."""


class FieldRecipe(OwnRecipe):
    """See the module's text."""

    own_weights: ClassVar[tuple[str, ...]] = ("lidar_weight", "ssim_weight")
    unfit: ClassVar[tuple[str, ...]] = BOX_SETTINGS
    last_densified: ClassVar[float] = 0.5

    def common(self, config: FitConfig) -> FitConfig:
        """See ``Recipe``."""
        return replace(config, loss=replace(config.loss, lidar_weight=0.0, ssim_weight=SSIM_SHARE / (1 + SSIM_SHARE)))

    def start(
        self, scene: Scene, fused: FusedCloud, views: Sequence[StoredView], classes: tuple[int, ...], config: FitConfig
    ) -> SceneModel:
        """See ``Recipe``. Of the fused cloud only the cameras' colours are used."""
        found = timed_points(scene, views, classes, config, fused.colors)
        measured = found.points.xyz[~np.isnan(found.time_s)].astype(np.float64)
        low, high = measured.min(0), measured.max(0)
        margin = BOX_MARGIN * (high - low) + 0.1
        times = [frame.view.time_s for frame in scene.frames]
        first, last = min(times), max(max(times), min(times) + 1e-3)
        sizes = replace(SIZES, time=max(2, min(SIZES.time, len(set(times)) // FRAMES_PER_CELL)))
        gain = SHORT_GAIN if config.iterations < FIELD_STEPS else 1.0
        node = HexPlaneNode.fresh([*(low - margin), first], [*(high + margin), last], sizes, config.seed, gain)
        columns = found.points.columns(classes, config.sh_degree)
        log.info(
            f"start: {len(found.time_s)} Gaussians, {node.learnt['planes'].numel()} numbers in {sizes.levels} x 6 planes"
        )
        owner = torch.zeros(len(found.time_s), dtype=torch.int32)
        return SceneModel(
            Table(columns, {"node": owner}), (node,), None, classes, config.sh_degree, colors=fused.colors
        )

    def drawn_model(self, model: SceneModel, view: TrainView, step: int, config: FitConfig) -> SceneModel:
        """See ``Recipe``: at first nothing moves; then what is near the frustum."""
        rests = step <= STATIC_SHARE * config.iterations
        nodes = (
            (node.resting() if rests else node.seen_by(view.view)) if isinstance(node, HexPlaneNode) else node
            for node in model.nodes
        )
        return model.with_nodes(tuple(nodes))

    def terms(self, drawn: DrawnView) -> dict[str, Tensor]:
        """See ``Recipe``."""
        terms: dict[str, Tensor] = {}
        lidar, whole = drawn.view.lidar, 1 + SSIM_SHARE
        if lidar is not None and len(lidar.pixel):
            terms["lidar"] = (
                LIDAR_WEIGHT
                / whole
                * losses.sparse_squared_depth(drawn.render.depth, lidar.pixel, lidar.depth_m, LIDAR_SPAN_M)
            )
        node = drawn.model.nodes[0]
        if isinstance(node, HexPlaneNode) and not node.rests:
            table, (space, time, flat) = drawn.model.table, plane_smoothness(node)
            terms["move"] = MOVE_WEIGHT / whole * (drawn.gaussians.means - table["means"]).abs().mean()
            terms["recolor"] = COLOR_WEIGHT / whole * (drawn.gaussians.sh - table["sh_dc"]).abs().mean()
            terms["planes"] = (SPACE_WEIGHT * space + TIME_WEIGHT * time + FLAT_WEIGHT * flat) / whole
        return terms
