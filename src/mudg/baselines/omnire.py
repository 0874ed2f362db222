"""The fit of ``omnire``: OmniRe (Chen et al. 2024) without body models.

Published, and here: rigid nodes for vehicles, nodes deformed by one network with an embedding per object for people and
cyclists, which begins after a tenth of the run; the weight of LiDAR depth. Left out: SMPL bodies. Different
(``docs/baselines.md``): everything else is ``street_gaussians``, with its sky, start and densification; the network is
small unless asked for.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Final, Self

import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor

from mudg.base import seeds
from mudg.core.table import Table
from mudg.gaussians.model import SceneModel
from mudg.gaussians.nodes import DeformableNode, NodeRows, RigidNode, StaticNode
from mudg.gaussians.recipes import DrawnView, Recipe
from mudg.gaussians.settings import FitConfig
from mudg.gaussians.start import FitStart
from mudg.gaussians.views import TrainView

# networks -----------------------------------------------------------------------------------------


@dataclass(frozen=True)
class FlatNetwork:
    """A small network whose numbers lie in one row, a column ``[1, P]`` of a ``Table``: layers of these widths, with
    ReLU between them. ``leading``: also a ReLU before the first layer."""

    widths: tuple[int, ...]
    leading: bool = False

    @property
    def numbers(self) -> int:
        """Weights and biases in all."""
        return sum((before + 1) * after for before, after in zip(self.widths, self.widths[1:]))

    def start(self, generator: torch.Generator, silent: bool = True) -> Tensor:
        """Starting values ``[1, P]``: uniform for ReLU (He et al. 2015), biases 0; ``silent``: the last layer 0, so
        that the output is."""
        parts = []
        for place, (before, after) in enumerate(zip(self.widths, self.widths[1:])):
            last = silent and place == len(self.widths) - 2
            weights = (torch.rand(after * before, generator=generator) * 2 - 1) * math.sqrt(6 / before)
            parts += [weights * 0.0 if last else weights, torch.zeros(after)]
        return torch.cat(parts)[None]

    def __call__(self, flat: Tensor, values: Tensor) -> Tensor:
        """Output ``[n, last]`` for inputs ``[n, first]``."""
        found, offset = torch.relu(values) if self.leading else values, 0
        for place, (before, after) in enumerate(zip(self.widths, self.widths[1:])):
            weights = flat[0, offset : offset + before * after].view(after, before)
            bias = flat[0, offset + before * after : offset + (before + 1) * after]
            found = F.linear(torch.relu(found) if place else found, weights, bias)
            offset += (before + 1) * after
        return found


def waves(values: Tensor, octaves: int, first: float = math.pi) -> Tensor:
    """Values ``[n, c]`` with sine and cosine of them times 1, 2, 4, ... ``first``: ``[n, c (1 + 2 octaves)]``."""
    scaled = torch.cat([values * (first * 2**octave) for octave in range(octaves)], 1)
    return torch.cat([values, torch.sin(scaled), torch.cos(scaled)], 1)


# deformed -----------------------------------------------------------------------------------------
#
# Within its box every Gaussian of such an object moves by ``network(x, t, z)``: its place in the box, the time, and
# what tells the object from others, an embedding that is learnt. One network serves all objects of a scene; it is a
# node without Gaussians.

EMBEDDING: Final = 16
PLACE_OCTAVES, TIME_OCTAVES = 4, 4
INPUTS: Final = 3 * (1 + 2 * PLACE_OCTAVES) + (1 + 2 * TIME_OCTAVES) + EMBEDDING


class DeformationField(StaticNode):
    """The network that deforms, and the embeddings of its objects.

    Its table: ``network`` [1, P] (``FlatNetwork``) and ``embeddings`` [1, K, 16]. ``span_s``: first and last time of
    the log, seconds. ``layers``, ``width``: of the network."""

    kind = "deformation"
    facts = ("name", "span_s", "layers", "width")
    learnt: Table

    def __init__(self, name: str, span_s: tuple[float, float], layers: int, width: int, learnt: Table) -> None:
        super().__init__(name)
        first, last = map(float, span_s)
        self.span_s, self.layers, self.width, self.learnt = (first, last), int(layers), int(width), learnt
        self.network = network_of(self.layers, self.width)

    @classmethod
    def fresh(
        cls, span_s: tuple[float, float], layers: int, width: int, objects: int, run_seed: int
    ) -> DeformationField:
        """A field that moves nothing yet."""
        generator = seeds.torch_generator(run_seed, 0, "deformation field")
        network = network_of(layers, width).start(generator)
        embeddings = torch.randn(1, objects, EMBEDDING, generator=generator)
        return cls("deformation field", span_s, layers, width, Table({"network": network, "embeddings": embeddings}))

    def displacement(self, place: Tensor, time_s: float, instance: int) -> Tensor:
        """How far Gaussians move at a time, ``[n, 3]`` metres in the frame of the box. ``place``: ``[n, 3]``, -1 to 1
        within the box. ``instance``: number of the object's embedding."""
        first, last = self.span_s
        moment = place.new_full((1, 1), 2 * (time_s - first) / max(last - first, 1e-6) - 1)
        same = torch.cat([waves(moment, TIME_OCTAVES), self.learnt["embeddings"][:, instance]], 1)
        return self.network(
            self.learnt["network"], torch.cat([waves(place, PLACE_OCTAVES), same.expand(len(place), -1)], 1)
        )


def network_of(layers: int, width: int) -> FlatNetwork:
    """The network of a field: ``layers`` hidden layers of a width."""
    return FlatNetwork((INPUTS, *[width] * layers, 3))


class DeformedNode(RigidNode):
    """A tracked object whose Gaussians also move within its box as a ``DeformationField`` of the same scene says.

    ``instance``: number of its embedding. Without a field (before the scene is put together, or where it ``rests``) it
    is rigid.
    """

    kind = "deformed"
    instance: int = 0
    field: DeformationField | None = None
    rests: bool = False

    @classmethod
    def of_rigid(cls, node: RigidNode, instance: int) -> DeformedNode:
        """The same object, deformed."""
        offsets = Table({name: node.offsets[name].detach() for name in ("shift", "yaw")})
        made = cls(node.name, node.label, node.size_m, node.times_s, node.world_from_object, offsets, node.learn_pose)
        made.instance = instance
        return made

    def linked(self, nodes: Sequence[StaticNode | RigidNode]) -> Self:
        field = next((node for node in nodes if isinstance(node, DeformationField)), None)
        return self if field is self.field else self.with_values(field=field)

    def at_time(self, rows: NodeRows, time_s: float) -> NodeRows | None:
        if self.field is None or self.rests or len(rows.means) == 0 or self.keys_around(time_s) is None:
            return super().at_time(rows, time_s)
        moved = self.field.displacement(self.place_in_box(rows.means), time_s, self.instance)
        return super().at_time(replace(rows, means=rows.means + moved), time_s)

    def moved(self, object_from_new: NDArray[Any]) -> Self:
        return super().moved(object_from_new).with_values(instance=self.instance, field=self.field)

    def state(self) -> tuple[dict[str, Any], dict[str, Tensor]]:
        facts, tensors = super().state()
        return facts | {"instance": self.instance}, tensors

    @classmethod
    def from_state(cls, facts: Mapping[str, Any], tensors: Mapping[str, Tensor]) -> Self:
        """Inverse of ``state``; the scene links the field."""
        return super().from_state(facts, tensors).with_values(instance=int(facts["instance"]))


# fit ----------------------------------------------------------------------------------------------

RIGID_SHARE: Final = 0.1
"""Share of the run before the network joins (published: 3000 of 30,000 steps)."""
LAYERS, WIDTH = 4, 64
"""Hidden layers of the network, and their width (published: 8 of 256)."""
LIDAR_WEIGHT: Final = 0.01
"""Of the mean absolute difference of depth, per metre."""


class OmniRecipe(Recipe):
    """See the module's text."""

    last_densified: ClassVar[float] = 0.5

    def start(self, given: FitStart) -> SceneModel:
        model, config = given.model(), given.config
        limbed = [node for node in model.nodes if isinstance(node, DeformableNode)]
        if not limbed:
            return model
        times = [frame.view.time_s for frame in given.scene.frames]
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
        resting = (node.with_values(rests=True) if isinstance(node, DeformedNode) else node for node in model.nodes)
        return model.with_nodes(tuple(resting))

    def terms(self, drawn: DrawnView) -> dict[str, Tensor]:
        if (lidar := drawn.view.lidar) is None:
            return {}
        return {"lidar": LIDAR_WEIGHT * (drawn.render.depth.reshape(-1)[lidar.pixel] - lidar.depth_m).abs().mean()}
