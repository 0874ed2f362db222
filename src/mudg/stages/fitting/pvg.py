"""The fit of ``pvg``: Periodic Vibration Gaussians (Chen et al. 2023), a dynamic street without boxes.

Published, and here: the two equations of ``models/scene/vibration.py``; temporal smoothing; the losses and weights below; children of
split Gaussians at other times of their parent's life. Different here (``docs/baselines.md``): a panorama for the sky's cube map,
starting points with the colours of the photographs, our filling of what LiDAR does not reach, no limits on size that grow with the
distance, no growing image sizes. Published lengths are those of scenes of `SCENE_UNIT_M`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import ClassVar, Final

import numpy as np
import torch
from torch import Tensor

from mudg.base import log, seeds
from mudg.base.types import FusedCloud, Scene
from mudg.core import losses
from mudg.core.table import Table
from mudg.models.scene.model import SceneModel
from mudg.models.scene.vibration import FRAME, VibrationNode, average_velocity, starting_columns
from mudg.stages.config import FitConfig
from mudg.stages.fitting.recipe import BOX_SETTINGS, SCENE_UNIT_M, DrawnView, OwnRecipe
from mudg.stages.fitting.start import painted_sky
from mudg.stages.fitting.timed import timed_points
from mudg.stages.fitting.views import StoredView, TrainView

SMOOTHING_PROBABILITY: Final = 0.5
SMOOTHING_FRAMES: Final = 3.0
"""The width of the interval that the difference of times is drawn from, in frames."""
LIDAR_WEIGHT, LIDAR_DECAY_STEPS = 0.1, 8000.0
SKY_WEIGHT, ENTROPY_WEIGHT, SMOOTH_WEIGHT, VELOCITY_WEIGHT = 0.05, 0.05, 0.001, 0.01
SKY_M: Final = 900.0 * SCENE_UNIT_M
FILLED_SPAN: Final = 1.2
"""Points without a time of their own start at times spread over this many durations of the log."""


class VibrationRecipe(OwnRecipe):
    """See the module's text."""

    own_weights: ClassVar[tuple[str, ...]] = ("lidar_weight", "sky_weight")
    unfit: ClassVar[tuple[str, ...]] = BOX_SETTINGS
    last_densified: ClassVar[float] = 0.5

    def start(
        self, scene: Scene, fused: FusedCloud, views: Sequence[StoredView], classes: tuple[int, ...], config: FitConfig
    ) -> SceneModel:
        """See ``Recipe``. Of the fused cloud only the cameras' colours are used."""
        node = VibrationNode.of_times([frame.view.time_s for frame in scene.frames])
        found = timed_points(scene, views, classes, config, fused.colors)
        duration = FRAME * (len({frame.view.time_s for frame in scene.frames}) - 1)
        drawn = (
            (seeds.numpy_rng(config.seed, 0, "start times").random(len(found.time_s)) - 0.5) * FILLED_SPAN * duration
        )
        measured = (found.time_s - node.middle_s) / node.frame_s * FRAME
        tau = torch.from_numpy(np.where(np.isnan(found.time_s), drawn, measured))
        columns = found.points.columns(classes, config.sh_degree) | starting_columns(len(tau), tau, duration)
        log.info(f"start: {len(tau)} vibrating Gaussians")
        owner = torch.zeros(len(tau), dtype=torch.int32)
        sky = painted_sky(views, fused.colors)
        return SceneModel(Table(columns, {"node": owner}), (node,), sky, classes, config.sh_degree, colors=fused.colors)

    def drawn_model(self, model: SceneModel, view: TrainView, step: int, config: FitConfig) -> SceneModel:
        """See ``Recipe``: at every second step or so, the state of another time, carried to the view's."""
        rng = seeds.numpy_rng(config.seed, step, "temporal smoothing")
        if rng.random() >= SMOOTHING_PROBABILITY:
            return model
        early = SMOOTHING_FRAMES * (rng.random() - 0.5) * FRAME
        return model.with_nodes(
            tuple(node.smoothed(early) if isinstance(node, VibrationNode) else node for node in model.nodes)
        )

    def terms(self, drawn: DrawnView) -> dict[str, Tensor]:
        """See ``Recipe``. The velocity is averaged over Gaussians by what they show of themselves at the time (published: over pixels)."""
        render, view = drawn.render, drawn.view
        inverse = losses.inverse_depth(render.depth, render.alpha, SKY_M) * SCENE_UNIT_M
        terms = {
            "entropy": ENTROPY_WEIGHT * losses.opacity_entropy(render.alpha),
            "smooth": SMOOTH_WEIGHT * losses.edge_aware(inverse, view.rgb),
            "velocity": VELOCITY_WEIGHT * mean_velocity(drawn),
        }
        if view.sky is not None:
            terms["sky"] = SKY_WEIGHT * losses.empty_sky(render.alpha, view.sky)
        if view.lidar is not None and len(view.lidar.pixel):
            weight = LIDAR_WEIGHT * math.exp(-drawn.published_step / LIDAR_DECAY_STEPS)
            terms["lidar"] = weight * losses.sparse_inverse_depth(
                inverse, view.lidar.pixel, view.lidar.depth_m / SCENE_UNIT_M
            )
        return terms


def mean_velocity(drawn: DrawnView) -> Tensor:
    """Mean absolute component of the average velocities, in scene units per unit of time, weighted by the opacity of the moment."""
    table, weight = drawn.model.table, drawn.gaussians.opacity.detach()
    speed = average_velocity(table["velocity"], table["log_beta"].exp()).abs().mean(1)
    return (speed * weight).sum() / weight.sum().clamp_min(1e-9) / SCENE_UNIT_M
