"""The fit of ``pvg``: Periodic Vibration Gaussians (Chen et al. 2023), a dynamic street without boxes.

Published, and here: the two equations of ``baselines/pvg.py``; temporal smoothing; the losses and weights below;
children of split Gaussians at other times of their parent's life. Different here (``docs/baselines.md``): a panorama
for the sky's cube map, starting points with the colours of the photographs, our filling of what LiDAR does not reach,
no limits on size that grow with the distance, no growing image sizes. Published lengths are those of scenes of
`SCENE_UNIT_M`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import ClassVar, Final

import numpy as np
import torch
from torch import Tensor

from mudg.base import log, seeds
from mudg.core import losses
from mudg.gaussians.model import SceneModel
from mudg.gaussians.nodes import NodeRows, StaticNode
from mudg.gaussians.recipes import SCENE_UNIT_M, DrawnView, Recipe
from mudg.gaussians.settings import FitConfig
from mudg.gaussians.start import FitStart, frame_seconds
from mudg.gaussians.views import TrainView

# vibration ----------------------------------------------------------------------------------------
#
# Every Gaussian has a peak time ``tau``, a life span ``beta`` and a velocity ``v``. At the time t, with the cycle l,
#
#     mean(t)    = mean + v sin(2 pi (t - tau) / l) l / (2 pi)
#     opacity(t) = opacity exp(-(t - tau)^2 / (2 beta^2)),   nothing where the factor is at most 0.05
#
# What stands still has a long life span and no velocity; what moves is either carried by its velocity or drawn by
# Gaussians that show one after the other. Times are counted in units of 50 frames (a frame is 0.02), 0 in the middle of
# the log, as published.
#
# Columns: ``tau`` [N], ``log_beta`` [N] (natural logarithm), ``velocity`` [N, 3] metres per unit of time.

FRAME: Final = 0.02
"""A frame in units of time."""
CYCLE: Final = 0.2
LEAST_FACTOR: Final = 0.05
SHRINK: Final = 1.6
"""The life span of children of a late split is this much shorter."""


class VibrationNode(StaticNode):
    """The whole world as vibrating Gaussians. ``middle_s``: seconds; time 0. ``frame_s``: seconds between frames.
    ``early``: difference D between the time that is drawn and the time whose state is drawn, in units of time; the
    state at t - D is carried by D times the average velocity (temporal smoothing, while fitting)."""

    kind = "vibration"
    facts = ("name", "middle_s", "frame_s")
    short_life = 0.01
    early = 0.0

    def __init__(self, name: str, middle_s: float, frame_s: float) -> None:
        super().__init__(name)
        self.middle_s, self.frame_s = float(middle_s), float(frame_s)

    def time_of(self, time_s: float) -> float:
        """Seconds to units of time."""
        return (time_s - self.middle_s) / self.frame_s * FRAME

    def at_time(self, rows: NodeRows, time_s: float) -> NodeRows | None:
        tau, beta, velocity = rows.own["tau"], rows.own["log_beta"].exp(), rows.own["velocity"]
        since = self.time_of(time_s) - self.early - tau
        factor = torch.exp(-(since**2) / (2 * beta**2))
        swing = torch.sin(since * (2 * math.pi / CYCLE)) * (CYCLE / (2 * math.pi))
        means = rows.means + velocity * swing[:, None]
        if self.early:
            means = means + average_velocity(velocity, beta) * self.early
        return replace(rows, means=means, opacity=rows.opacity * factor * (factor > LEAST_FACTOR))

    def born_later(self, columns: Mapping[str, Tensor], noise: Tensor, late: bool) -> dict[str, Tensor]:
        """Children of split rows: each at another time of its parent's life, where the parent would be then. ``noise``:
        standard normal ``[n]``. ``late``: whether the life span shrinks too (the second half of densification)."""
        beta = columns["log_beta"].exp()
        later = beta * noise
        moved = columns["means"] + average_velocity(columns["velocity"], beta) * later[:, None]
        shorter = math.log(SHRINK) * (beta >= self.short_life) if late else torch.zeros_like(beta)
        return {**columns, "means": moved, "tau": columns["tau"] + later, "log_beta": columns["log_beta"] - shorter}


def average_velocity(velocity: Tensor, beta: Tensor) -> Tensor:
    """``v exp(-beta / (2 l))`` [N, 3], metres per unit of time: what lives long has a swing, but goes nowhere."""
    return velocity * torch.exp(-beta / (2 * CYCLE))[:, None]


def starting_columns(count: int, tau: Tensor, duration: float) -> dict[str, Tensor]:
    """Columns of Gaussians that have not learnt to move: ``tau`` [count] and ``duration`` in units of time."""
    beta = math.sqrt(0.1 * max(duration, FRAME))
    return {"tau": tau.float(), "log_beta": torch.full((count,), math.log(beta)), "velocity": torch.zeros(count, 3)}


# pvg ----------------------------------------------------------------------------------------------

SMOOTHING_PROBABILITY: Final = 0.5
SMOOTHING_FRAMES: Final = 3.0
"""The width of the interval that the difference of times is drawn from, in frames."""
LIDAR_WEIGHT, SKY_WEIGHT, ENTROPY_WEIGHT, SMOOTH_WEIGHT, VELOCITY_WEIGHT = 0.1, 0.05, 0.05, 0.001, 0.01
FILLED_SPAN: Final = 1.2
"""Points without a time of their own start at times spread over this many durations of the log."""


class VibrationRecipe(Recipe):
    """See the module's text."""

    last_densified: ClassVar[float] = 0.5

    def start(self, given: FitStart) -> SceneModel:
        """See ``Recipe``. Of the fused cloud only the cameras' colours are used."""
        (points, time_s), config = given.timed_points(), given.config
        times = {frame.view.time_s for frame in given.scene.frames}
        node = VibrationNode("background", (min(times) + max(times)) / 2, frame_seconds(given.scene))
        duration = FRAME * (len(times) - 1)
        random = seeds.numpy_rng(config.seed, 0, "start times").random(len(time_s))
        drawn = (random - 0.5) * FILLED_SPAN * duration
        measured = (time_s - node.middle_s) / node.frame_s * FRAME
        tau = torch.from_numpy(np.where(np.isnan(time_s), drawn, measured))
        columns = points.columns(given.classes, config.sh_degree) | starting_columns(len(tau), tau, duration)
        log.info(f"start: {len(tau)} vibrating Gaussians")
        return given.world_model(node, columns)

    def drawn_model(self, model: SceneModel, view: TrainView, step: int, config: FitConfig) -> SceneModel:
        """See ``Recipe``: at every second step or so, the state of another time, carried to the view's."""
        rng = seeds.numpy_rng(config.seed, step, "temporal smoothing")
        if rng.random() >= SMOOTHING_PROBABILITY:
            return model
        early = SMOOTHING_FRAMES * (rng.random() - 0.5) * FRAME
        return model.with_nodes(tuple(node.with_values(early=early) for node in model.nodes))

    def terms(self, drawn: DrawnView) -> dict[str, Tensor]:
        """See ``Recipe``. The velocity is averaged over Gaussians by what they show of themselves at the time
        (published: over pixels)."""
        view, alpha, inverse = drawn.view, drawn.render.alpha, drawn.inverse_depth
        terms = {
            "entropy": ENTROPY_WEIGHT * losses.opacity_entropy(alpha),
            "smooth": SMOOTH_WEIGHT * losses.edge_aware(inverse, view.rgb),
            "velocity": VELOCITY_WEIGHT * mean_velocity(drawn),
        }
        if view.sky is not None:
            terms["sky"] = SKY_WEIGHT * losses.empty_sky(alpha, view.sky)
        return terms | drawn.lidar_term(LIDAR_WEIGHT)


def mean_velocity(drawn: DrawnView) -> Tensor:
    """Mean absolute component of the average velocities, in scene units per unit of time, weighted by the opacity of
    the moment."""
    table, weight = drawn.model.table, drawn.gaussians.opacity.detach()
    speed = average_velocity(table["velocity"], table["log_beta"].exp()).abs().mean(1)
    return (speed * weight).sum() / weight.sum().clamp_min(1e-9) / SCENE_UNIT_M
