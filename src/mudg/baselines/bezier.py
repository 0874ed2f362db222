"""The fit of ``bezier``: BezierGS (Ma et al. 2025), tracked objects on learnt Bezier curves.

Published, and here: the curves of ``baselines/bezier.py`` with their learning rates, and the losses and weights below.
The loss of curves that agree is our reading of it: a Gaussian keeps its distance from the centre of its object. Left
out: the velocity of the background, which here has no curves. Everything else is ``street_gaussians``.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, Final, Self

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from mudg.base import seeds
from mudg.base.palette import DYNAMIC_IDS
from mudg.core import losses, native_ops
from mudg.core.raster.rasterize import rasterize
from mudg.core.table import Table
from mudg.gaussians.model import SceneModel
from mudg.gaussians.nodes import NodeRows, RigidNode
from mudg.gaussians.recipes import DrawnView, Recipe
from mudg.gaussians.rendering import boxes_in_view, objects_only
from mudg.gaussians.start import FitStart

# curves -------------------------------------------------------------------------------------------
#
# The box track of an object becomes a cubic curve of its centre, whose four control points are learnt on; every
# Gaussian has a curve of its own about it, given by four offsets. At a time, ``tau`` the parameter that belongs to it,
#
#     mean(t) = B(tau) (trajectory) + B(tau) (offsets),    offsets = turned place in the box + learnt deviation
#
# ``B`` are the four Bernstein polynomials. The turned place is a curve too: the one closest to what the rotations of
# the boxes make of the place. Gaussians themselves turn with the boxes.
#
# Column: ``curve`` [N, 4, 3] metres in the world, the deviations; 0 and unused for the background.

ROUNDS: Final = 100
"""Rounds of fitting control points and moving every key to the nearest parameter of the curve."""
DEGREE: Final = 3

Array = NDArray[np.float64]


def bernstein(tau: Array) -> Array:
    """The four cubic Bernstein polynomials at parameters [K]: f64[K, 4]."""
    u = np.asarray(tau, np.float64)[..., None]
    return np.concatenate([(1 - u) ** 3, 3 * u * (1 - u) ** 2, 3 * u**2 * (1 - u), u**3], -1)


class BezierPath:
    """A cubic curve through keys, and the parameter that belongs to a time. ``control``: f64[4, 3] metres. ``clock``:
    coefficients of the cubic in time, highest power first, in ``(t - middle_s) / span_s``. ``tau``: parameters of the
    keys f64[K], from those given on. ``error_m``: root mean square distance of the curve from the keys at their
    times."""

    def __init__(self, times_s: Array, positions: Array, tau: Array) -> None:
        for _ in range(ROUNDS):
            nearer = _nearest(control_points(tau, positions), positions, tau)
            settled = np.abs(nearer - tau).max() < 1e-12
            tau = nearer
            if settled:
                break
        self.control, self.tau = control_points(tau, positions), tau
        self.middle_s, self.span_s = float(times_s[0] + times_s[-1]) / 2, span_of(times_s)
        self.clock = np.polyfit((times_s - self.middle_s) / self.span_s, tau, min(DEGREE, len(times_s) - 1))
        self.error_m = float(np.sqrt(((self.at(times_s) - positions) ** 2).sum(1).mean()))

    def tau_at(self, time_s: float | Array) -> Array:
        """Parameters of times."""
        return np.polyval(self.clock, (np.asarray(time_s, np.float64) - self.middle_s) / self.span_s)

    def at(self, time_s: float | Array) -> Array:
        """Positions [..., 3] at times."""
        return bernstein(self.tau_at(time_s)) @ self.control


def span_of(times_s: Array) -> float:
    """Length of a track in seconds; not 0, also of a single key."""
    return max(float(times_s[-1] - times_s[0]), 1e-6)


def fit_path(times_s: Array, positions: Array) -> BezierPath:
    """The curve of a track: from parameters along the chord, and from such in proportion to the time; the better one.
    ``times_s``: f64[K], rising. ``positions``: f64[K, 3] metres."""
    steps = np.linalg.norm(np.diff(positions, axis=0), axis=1)
    even = (times_s - times_s[0]) / span_of(times_s)
    chord = np.concatenate([[0.0], np.cumsum(steps)]) / steps.sum() if steps.sum() > 1e-3 else even
    return min((BezierPath(times_s, positions, start) for start in (even, chord)), key=lambda path: path.error_m)


def control_points(tau: Array, values: Array) -> Array:
    """The four control points [4, c] whose curve comes closest to values [K, c] at parameters [K]; with fewer than four
    keys, those nearest to a straight line."""
    line = values[0] + np.linspace(0, 1, 4)[:, None] * (values[-1] - values[0])
    basis = bernstein(tau)
    return line + np.linalg.lstsq(basis, values - basis @ line, rcond=1e-9)[0]


def _nearest(control: Array, positions: Array, tau: Array) -> Array:
    """One step of Newton's method towards the nearest parameters, kept in [0, 1] and where it comes nearer."""
    first, second = 3 * np.diff(control, axis=0), 6 * np.diff(control, n=2, axis=0)
    u = tau[:, None]
    away = bernstein(tau) @ control - positions
    slope = (1 - u) ** 2 * first[0] + 2 * u * (1 - u) * first[1] + u**2 * first[2]
    bend = (1 - u) * second[0] + u * second[1]
    top, below = (away * slope).sum(1), (slope**2 + away * bend).sum(1)
    moved = np.clip(tau - np.where(below > 1e-9, top / np.maximum(below, 1e-9), 0.0), 0, 1)
    better = ((bernstein(moved) @ control - positions) ** 2).sum(1) < (away**2).sum(1)
    return np.where(better, moved, tau)


class BezierNode(RigidNode):
    """A tracked object on curves. Its own table: ``trajectory`` [1, 4, 3] metres, what the centre's control points
    differ by."""

    kind = "bezier"
    learnt: Table

    def __init__(self, *given: Any, **named: Any) -> None:
        super().__init__(*given, **named)
        self.learnt = Table({"trajectory": torch.zeros(1, 4, 3)})
        self.path = fit_path(self.times_s, self.world_from_object[:, :3, 3])
        turns = self.world_from_object[:, :3, :3].reshape(-1, 9)
        self.turns = control_points(self.path.tau, turns).reshape(4, 3, 3)
        self._curves: dict[float, tuple[Tensor, Tensor, Tensor]] = {}

    @classmethod
    def of_rigid(cls, node: RigidNode) -> BezierNode:
        """The same object on curves; learnt offsets of its boxes are not taken over."""
        return cls(node.name, node.label, node.size_m, node.times_s, node.world_from_object)

    def at_time(self, rows: NodeRows, time_s: float) -> NodeRows | None:
        placement = self._placement(time_s)
        if placement is None:
            return None
        tau = float(self.path.tau_at(time_s))
        weights, _, center = self._at(tau)
        center = center + (weights[:, None] * self.learnt["trajectory"][0]).sum(0)
        means = center + self.offsets_at(rows, tau)
        turned = self._colors_turned(rows.sh_rest, time_s)
        return replace(rows, means=means, quats=rows.quats @ placement[2], sh_rest=turned)

    def offsets_at(self, rows: NodeRows, tau: float) -> Tensor:
        """Where Gaussians are beside the centre of the object at a parameter of the curve, ``[n, 3]`` metres in the
        world."""
        weights, turned, _ = self._at(tau)
        return rows.means.detach() @ turned + torch.einsum("j,njc->nc", weights, rows.own["curve"])

    def _at(self, tau: float) -> tuple[Tensor, Tensor, Tensor]:
        """Weights of the control points [4], what turns places (transposed, [3, 3]) and the track's own centre [3],
        where the rows are; the last few are remembered."""
        if tau not in self._curves:
            if len(self._curves) > 256:
                self._curves.clear()
            weights, device = bernstein(np.array(tau)), self.learnt.device
            parts = (weights, np.einsum("j,jab->ba", weights, self.turns), weights @ self.path.control)
            self._curves[tau] = tuple(torch.from_numpy(np.array(p)).float().to(device) for p in parts)
        return self._curves[tau]

    def to(self, device: torch.device) -> Self:
        return super().to(device).with_values(learnt=self.learnt.to(device), _curves={})

    def moved(self, object_from_new: NDArray[np.float64]) -> Self:
        """See ``RigidNode``; what the curves learnt stays as it is in the world."""
        made = super().moved(object_from_new)
        made.learnt = Table({name: value.detach() for name, value in self.learnt.columns.items()})
        return made

    def state(self) -> tuple[dict[str, Any], dict[str, Tensor]]:
        facts, tensors = super().state()
        return facts, tensors | {f"learnt.{name}": value for name, value in self.learnt.state().items()}

    @classmethod
    def from_state(cls, facts: Mapping[str, Any], tensors: Mapping[str, Tensor]) -> Self:
        """Inverse of ``state``."""
        made = super().from_state(facts, tensors)
        learnt = {key.removeprefix("learnt."): value for key, value in tensors.items() if key.startswith("learnt.")}
        made.learnt = Table.from_state(learnt)
        return made


def distance_change(node: BezierNode, rows: NodeRows, taus: Sequence[float]) -> Tensor:
    """Sum over Gaussians of how much their distance from the object's centre differs at two parameters, metres."""
    first, second = (node.offsets_at(rows, tau).square().sum(1).add(1e-12).sqrt() for tau in taus)
    return (first - second).abs().sum()


# fit ----------------------------------------------------------------------------------------------

LIDAR_WEIGHT, SMOOTH_WEIGHT, OBJECTS_WEIGHT, CONSISTENCY_WEIGHT = 1.0, 0.1, 0.1, 0.01
SSIM_SHARE: Final = 0.2


class BezierRecipe(Recipe):
    """See the module's text."""

    def start(self, given: FitStart) -> SceneModel:
        model = given.model()
        columns = {name: value.detach() for name, value in model.table.columns.items()}
        table = Table(columns | {"curve": torch.zeros(len(model.table), 4, 3)}, model.table.labels)
        nodes = tuple(BezierNode.of_rigid(node) if isinstance(node, RigidNode) else node for node in model.nodes)
        return replace(model, table=table, nodes=nodes)

    def terms(self, drawn: DrawnView) -> dict[str, Tensor]:
        view = drawn.view
        terms = {"smooth": SMOOTH_WEIGHT * losses.edge_aware(drawn.inverse_depth, view.rgb)}
        terms |= drawn.lidar_term(LIDAR_WEIGHT)
        if len(drawn.model.nodes) > 1:
            if view.channels is not None:
                terms["objects"] = OBJECTS_WEIGHT * objects_alone(drawn, view.channels)
            terms["consistency"] = CONSISTENCY_WEIGHT * consistency(drawn)
        return terms


def objects_alone(drawn: DrawnView, channels: Tensor) -> Tensor:
    """Colour of the objects by themselves and the difference of their opacity from the mask: pixels of a dynamic class
    in a box."""
    model, view = drawn.model, drawn.view
    number_of = [channel for channel, train_id in enumerate(model.classes) if train_id in DYNAMIC_IDS]
    mask = boxes_in_view(model, view.view).to(channels.device, non_blocking=True)
    mask = mask & torch.isin(channels, torch.tensor(number_of).to(channels.device))[None] & view.mask
    alone = rasterize(objects_only(drawn.gaussians), view.view, drawn.raster)
    return native_ops.photometric(alone.rgb, view.rgb * mask, SSIM_SHARE) + (alone.alpha - mask.float()).abs().mean()


def consistency(drawn: DrawnView) -> Tensor:
    """Mean over the Gaussians of objects of how much their distance from the centre, at the time of the view, differs
    from that at another time (drawn from seed and step)."""
    model, time_s = drawn.model, drawn.view.view.time_s
    table, counts = model.table, model.counts()
    other = float(seeds.numpy_rng(drawn.config.seed, drawn.step, "other time").random())
    total, count = table["curve"].new_zeros(()), 0
    names = ("means", "quats", "logits", "sh_dc", "curve")
    for node, *parts in zip(model.nodes, *(table[name].split(counts) for name in names)):
        if isinstance(node, BezierNode) and len(parts[0]) and node.keys_around(time_s) is not None:
            rows = NodeRows(*parts[:4], {"curve": parts[4]})
            taus = float(node.path.tau_at(time_s)), other
            total, count = total + distance_change(node, rows, taus), count + len(parts[0])
    return total / max(1, count)
