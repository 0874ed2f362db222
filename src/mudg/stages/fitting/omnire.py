"""The fit of ``omnire``: OmniRe (Chen et al. 2024) without body models.

Published, and here: rigid nodes for vehicles, nodes deformed by one network with an embedding per object for people and cyclists,
which begins after a tenth of the run; the weight of LiDAR depth. Left out: SMPL bodies. Different (``docs/baselines.md``): everything
else is ``street_gaussians``, with its sky, start and densification; the network is small unless asked for.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import ClassVar, Final

from torch import Tensor

from mudg.base.types import FusedCloud, Scene
from mudg.models.scene.deformed import DeformationField, DeformedNode
from mudg.models.scene.model import SceneModel
from mudg.models.scene.nodes import DeformableNode
from mudg.stages.config import FitConfig
from mudg.stages.fitting.recipe import DrawnView, OwnRecipe
from mudg.stages.fitting.start import start_model
from mudg.stages.fitting.views import StoredView, TrainView

RIGID_SHARE: Final = 0.1
"""Share of the run before the network joins (published: 3000 of 30,000 steps)."""
LAYERS, WIDTH = 4, 64
"""Hidden layers of the network, and their width (published: 8 of 256)."""
LIDAR_WEIGHT: Final = 0.01
"""Of the mean absolute difference of depth, per metre."""


class OmniRecipe(OwnRecipe):
    """See the module's text."""

    own_weights: ClassVar[tuple[str, ...]] = ("lidar_weight",)
    last_densified: ClassVar[float] = 0.5

    def start(
        self, scene: Scene, fused: FusedCloud, views: Sequence[StoredView], classes: tuple[int, ...], config: FitConfig
    ) -> SceneModel:
        """See ``Recipe``."""
        model = start_model(scene, fused, views, classes, config)
        limbed = [node for node in model.nodes if isinstance(node, DeformableNode)]
        if not limbed:
            return model
        times = [frame.view.time_s for frame in scene.frames]
        field = DeformationField.fresh((min(times), max(times)), LAYERS, WIDTH, len(limbed), config.seed)
        nodes = [
            DeformedNode.of_rigid(node, limbed.index(node)) if isinstance(node, DeformableNode) else node
            for node in model.nodes
        ]
        return replace(model, nodes=(*nodes, field))

    def drawn_model(self, model: SceneModel, view: TrainView, step: int, config: FitConfig) -> SceneModel:
        """See ``Recipe``: at first all objects are rigid."""
        if step > RIGID_SHARE * config.iterations:
            return model
        return model.with_nodes(
            tuple(node.resting() if isinstance(node, DeformedNode) else node for node in model.nodes)
        )

    def terms(self, drawn: DrawnView) -> dict[str, Tensor]:
        """See ``Recipe``."""
        lidar = drawn.view.lidar
        if lidar is None or not len(lidar.pixel):
            return {}
        return {"lidar": LIDAR_WEIGHT * (drawn.render.depth.reshape(-1)[lidar.pixel] - lidar.depth_m).abs().mean()}
