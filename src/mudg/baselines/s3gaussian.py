"""The fit of ``s3gaussian``: S3Gaussian (Huang et al. 2024), a dynamic street without boxes, moved by a field of place
and time.

Published, and here: the field of ``baselines/s3gaussian.py``, a static first stage, losses and weights below, no sky.
Left out: the head that imitates features of a vision network. Different (``docs/baselines.md``): changes of colour of
the constant band only; planes are small unless asked for; the field is asked only for Gaussians near the frustum. Terms
are divided by 1.2, since the common colour term has weights of sum 1 and the published one L1 + 0.2 (1 - SSIM).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, replace
from typing import Any, ClassVar, Final

import numpy as np
import torch
from torch import Tensor

from mudg.base import log, seeds
from mudg.base.types import View
from mudg.baselines.omnire import FlatNetwork
from mudg.core import losses
from mudg.core.grids import TIME, PlaneSizes, look_up
from mudg.core.table import Table
from mudg.gaussians.model import SceneModel
from mudg.gaussians.nodes import NodeRows, StaticNode
from mudg.gaussians.recipes import DrawnView, Recipe
from mudg.gaussians.schedule import FIELD_STEPS
from mudg.gaussians.settings import FitConfig
from mudg.gaussians.start import FitStart
from mudg.gaussians.views import TrainView

# hexplane -----------------------------------------------------------------------------------------
#
# The field lies in six planes (xy, xz, yz and xt, yt, zt) of several sizes. A Gaussian at x, y, z and the time t takes
# from each the bilinear value at its place; the six values are multiplied, those of the sizes joined. A linear layer
# and two small networks turn them into a displacement and a change of colour:
#
#     mean(t) = mean + dx(x, y, z, t)        colour(t) = colour + dc(x, y, z, t)
#
# Rows outside the box of the field keep still.

FRUSTUM_MARGIN: Final = 1.3
"""A Gaussian may be moved this much further than the edge of the image, as a share of half the image, plus
`NEAR_MARGIN_M`."""
NEAR_MARGIN_M: Final = 5.0
SPACE_START: Final = (0.1, 0.5)
"""Planes of space start between these."""
SHORT_GAIN: Final = (sum(SPACE_START) / 2) ** -3
"""Factor that makes the product of three such planes about 1."""


class HexPlaneNode(StaticNode):
    """The whole world as Gaussians that a field moves.

    Its table: ``planes`` [1, P], all planes one after the other, and ``plane_network`` [1, Q]. ``low``, ``high``:
    corners of the field's box: x, y, z in metres, t in seconds. ``gain``: factor on the features (published: 1). rests:
    the world without the field. view: the field is asked for Gaussians in and around its frustum only; None: for
    all."""

    kind = "hexplane"
    learnt: Table

    def __init__(
        self,
        name: str,
        low: Sequence[float],
        high: Sequence[float],
        sizes: PlaneSizes,
        learnt: Table,
        gain: float = 1.0,
    ) -> None:
        super().__init__(name)
        self.low, self.high = tuple(map(float, low)), tuple(map(float, high))
        self.sizes, self.learnt, self.gain, self.rests = sizes, learnt, float(gain), False
        self.view: View | None = None
        head = FlatNetwork((sizes.width, sizes.width, 3), leading=True)
        self.networks = FlatNetwork((sizes.features * sizes.levels, sizes.width)), head, head

    @classmethod
    def fresh(
        cls, low: Sequence[float], high: Sequence[float], sizes: PlaneSizes, run_seed: int, gain: float = 1.0
    ) -> HexPlaneNode:
        """A field that moves nothing yet: planes of space between 0.1 and 0.5, planes of time 1."""
        least, most = SPACE_START
        generator = seeds.torch_generator(run_seed, 0, "hexplane")
        drawn = lambda shape: torch.rand(shape, generator=generator).flatten() * (most - least) + least
        planes = [torch.ones(shape).flatten() if TIME in axes else drawn(shape) for axes, shape in sizes.shapes]
        node = cls("background", low, high, sizes, Table({"planes": torch.zeros(1, 1)}), gain)
        trunk, *heads = node.networks
        network = [trunk.start(generator, silent=False), *(head.start(generator) for head in heads)]
        node.learnt = Table({"planes": torch.cat(planes)[None], "plane_network": torch.cat(network, 1)})
        return node

    def planes(self) -> Iterator[tuple[tuple[int, int], Tensor]]:
        """Axes and numbers ``[second axis, first axis, features]`` of every plane, level by level."""
        return self.sizes.planes(self.learnt["planes"][0])

    def features(self, places: Tensor) -> Tensor:
        """What the planes say at places ``[n, 4]``, -1 to 1 along x, y, z, t, times the gain: ``[n, features *
        levels]``."""
        return self.gain * look_up(places, self.learnt["planes"][0], self.sizes)

    def changes(self, means: Tensor, time_s: float) -> tuple[Tensor, Tensor]:
        """Displacement ``[n, 3]`` m and change of colour ``[n, 3]`` of Gaussians at ``means`` [n, 3] at a time."""
        low, high = (means.new_tensor(corner) for corner in (self.low, self.high))
        places = 2 * (torch.cat([means, means.new_full((len(means), 1), time_s)], 1) - low) / (high - low) - 1
        flat, found, offset = self.learnt["plane_network"], [], 0
        for network in self.networks:
            found.append(flat[:, offset : offset + network.numbers])
            offset += network.numbers
        trunk, move, color = self.networks
        hidden = trunk(found[0], self.features(places))
        return move(found[1], hidden), color(found[2], hidden)

    def asked(self, means: Tensor) -> Tensor:
        """Rows i64[m] that the field may change: in its box, and near the frustum of the view if there is one."""
        with torch.no_grad():
            low, high = (means.new_tensor(corner[:3]) for corner in (self.low, self.high))
            inside = ((means >= low) & (means <= high)).all(1)
            if self.view is not None:
                inside &= _near_frustum(self.view, means)
            return inside.nonzero()[:, 0]

    def at_time(self, rows: NodeRows, time_s: float) -> NodeRows | None:
        if self.rests:
            return rows
        asked = self.asked(rows.means)
        moved, colored = self.changes(rows.means[asked], time_s)
        means, colors = rows.means.index_add(0, asked, moved), rows.sh_dc.index_add(0, asked, colored[:, None])
        return replace(rows, means=means, sh_dc=colors)

    def state(self) -> tuple[dict[str, Any], dict[str, Tensor]]:
        facts = {"name": self.name, "low": list(self.low), "high": list(self.high), "gain": self.gain}
        return {**facts, **asdict(self.sizes)}, self.learnt.state()

    @classmethod
    def from_state(cls, facts: Mapping[str, Any], tensors: Mapping[str, Tensor]) -> HexPlaneNode:
        """Inverse of ``state``."""
        sizes = PlaneSizes(**{name: int(facts[name]) for name in PlaneSizes.__dataclass_fields__})
        learnt, gain = Table.from_state(tensors), float(facts["gain"])
        return cls(str(facts["name"]), facts["low"], facts["high"], sizes, learnt, gain)


def _near_frustum(view: View, means: Tensor) -> Tensor:
    """Bool[N]: in the view, or not far from it."""
    camera, pose = view.camera, means.new_tensor(view.cam_from_world)
    x, y, z = (means @ pose[:3, :3].T + pose[:3, 3]).unbind(1)
    ahead = z.clamp_min(0)
    across = max(camera.cx, camera.width - camera.cx) / camera.fx * FRUSTUM_MARGIN
    down = max(camera.cy, camera.height - camera.cy) / camera.fy * FRUSTUM_MARGIN
    margin = NEAR_MARGIN_M
    return (z > -margin) & (x.abs() < ahead * across + margin) & (y.abs() < ahead * down + margin)


def plane_smoothness(node: HexPlaneNode) -> tuple[Tensor, Tensor, Tensor]:
    """Three scalars, sums over planes: mean squared second differences of the planes of space (both axes) and of time
    (along the time), and the mean |1 - value| of the planes of time."""
    space = time = flat = node.learnt["planes"].new_zeros(())
    for axes, plane in node.planes():
        if TIME in axes:
            time = time + _bending(plane, 0)
            flat = flat + (1 - plane).abs().mean()
        else:
            space = space + _bending(plane, 0) + _bending(plane, 1)
    return space, time, flat


def _bending(plane: Tensor, dim: int) -> Tensor:
    bent = torch.diff(plane, n=2, dim=dim)  # of two cells, nothing
    return bent.square().mean() if bent.numel() else bent.sum()


# fit ----------------------------------------------------------------------------------------------

STATIC_SHARE: Final = 5 / 55
"""Share of the run before the field joins (published: 5000 steps, then 50,000)."""
SSIM_SHARE: Final = 0.2
LIDAR_WEIGHT, LIDAR_SPAN_M = 0.5, 80.0
MOVE_WEIGHT, COLOR_WEIGHT = 0.001, 0.001
SPACE_WEIGHT, TIME_WEIGHT, FLAT_WEIGHT = 1e-4, 0.01, 1e-4
SIZES: Final = PlaneSizes(features=8, levels=2, space=64, time=25, width=64)
"""Of the planes and networks (published: 32 features, 4 levels)."""
FRAMES_PER_CELL: Final = 2
"""Frames of a cell of time (published: 25 cells for 50 frames): what lies between two shown frames must not have one of
its own."""
BOX_MARGIN: Final = 0.02
"""The box of the field is that of the LiDAR points, grown by this share."""


class FieldRecipe(Recipe):
    """See the module's text."""

    last_densified: ClassVar[float] = 0.5

    def common(self, config: FitConfig) -> FitConfig:
        return replace(config, loss=replace(config.loss, lidar_weight=0.0, ssim_weight=SSIM_SHARE / (1 + SSIM_SHARE)))

    def start(self, given: FitStart) -> SceneModel:
        """See ``Recipe``. Of the fused cloud only the cameras' colours are used."""
        (points, time_s), config = given.timed_points(), given.config
        measured = points.xyz[~np.isnan(time_s)].astype(np.float64)
        low, high = measured.min(0), measured.max(0)
        margin = BOX_MARGIN * (high - low) + 0.1
        times = [frame.view.time_s for frame in given.scene.frames]
        first, last = min(times), max(max(times), min(times) + 1e-3)
        sizes = replace(SIZES, time=max(2, min(SIZES.time, len(set(times)) // FRAMES_PER_CELL)))
        gain = SHORT_GAIN if config.iterations < FIELD_STEPS else 1.0
        node = HexPlaneNode.fresh([*(low - margin), first], [*(high + margin), last], sizes, config.seed, gain)
        columns = points.columns(given.classes, config.sh_degree)
        numbers = node.learnt["planes"].numel()
        log.info(f"start: {len(time_s)} Gaussians, {numbers} numbers in {sizes.levels} x 6 planes")
        return given.world_model(node, columns)

    def drawn_model(self, model: SceneModel, view: TrainView, step: int, config: FitConfig) -> SceneModel:
        """See ``Recipe``: at first nothing moves; then what is near the frustum."""
        changes = {"rests": True} if step <= STATIC_SHARE * config.iterations else {"view": view.view}
        return model.with_nodes(tuple(node.with_values(**changes) for node in model.nodes))

    def terms(self, drawn: DrawnView) -> dict[str, Tensor]:
        terms: dict[str, Tensor] = {}
        lidar, whole = drawn.view.lidar, 1 + SSIM_SHARE
        if lidar is not None:
            error = losses.sparse_squared_depth(drawn.render.depth, lidar.pixel, lidar.depth_m, LIDAR_SPAN_M)
            terms["lidar"] = LIDAR_WEIGHT / whole * error
        node = drawn.model.nodes[0]
        if isinstance(node, HexPlaneNode) and not node.rests:
            table, (space, time, flat) = drawn.model.table, plane_smoothness(node)
            terms["move"] = MOVE_WEIGHT / whole * (drawn.gaussians.means - table["means"]).abs().mean()
            terms["recolor"] = COLOR_WEIGHT / whole * (drawn.gaussians.sh - table["sh_dc"]).abs().mean()
            terms["planes"] = (SPACE_WEIGHT * space + TIME_WEIGHT * time + FLAT_WEIGHT * flat) / whole
        return terms
