"""Metrics of one view, or of neighbouring views, that need more than a true image: LiDAR points, exact boxes, markings
and motion.

``metrics.ViewFacts`` is what is known of a view beside its true image. The metrics are accumulators as in
``core/metrics.py``.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, Final, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from mudg.core import street_scores
from mudg.core.lidar import PointTruth
from mudg.core.metrics import (
    ExactMotion,
    Metric,
    Neighbours,
    Pair,
    Pooled,
    Segmentation,
    change_of,
    confusion,
    depth_error,
    depth_errors,
    frame_mean,
)
from mudg.core.street_scores import agent_ious

POINT_PARTS: Final = ("", "static", "dynamic")


# ---- LiDAR points --------------------------------------------------------------------------------


def _chosen(points: PointTruth, part: str) -> NDArray[np.bool_]:
    known = points.depth > 0
    return known & (points.dynamic if part == "dynamic" else ~points.dynamic) if part else known


def _point_depth(part: str) -> Callable[[Pair], Any]:
    def of(pair: Pair) -> Any:
        points = None if pair.facts is None else pair.facts.points
        if points is None or pair.depth is None:
            return None
        chosen = _allowed(torch.from_numpy(_chosen(points, part))[None], pair.mask)
        return depth_errors(pair.depth, torch.from_numpy(points.depth)[None], chosen)

    return of


def _allowed(chosen: Tensor, mask: Tensor | None) -> Tensor:
    return chosen if mask is None else chosen & mask


_POINT_DEPTHS: Final = {part: _point_depth(part) for part in POINT_PARTS}


def decibels(source: Callable[[Pair], tuple[float, int] | None]) -> Pooled:
    """PSNR, at most 100 dB, from squared errors pooled over all views: ``source`` gives their sum and number."""
    return Pooled(source, finish=lambda mean: min(100.0, -10 * math.log10(max(mean, 1e-12))))


def _point_color(part: str) -> Callable[[Pair], tuple[float, int] | None]:
    def of(pair: Pair) -> tuple[float, int] | None:
        points = None if pair.facts is None else pair.facts.points
        if points is None or pair.rgb is None or not points.colored.any():
            return None
        chosen = _allowed(torch.from_numpy(_chosen(points, part) & points.colored)[None], pair.mask)[0]
        true = torch.from_numpy(points.color[chosen.numpy()].T).float() / 255
        apart = (pair.rgb[:, chosen].clamp(0, 1) - true).double()
        return float(apart.square().sum()), apart.numel()

    return of


_POINT_COLORS: Final = {part: _point_color(part) for part in POINT_PARTS}


def _carried_classes(pair: Pair) -> Tensor | None:
    points = None if pair.facts is None else pair.facts.points
    if points is None or pair.semantics is None:
        return None
    true = torch.from_numpy(np.where(points.depth > 0, points.classes, 255).astype(np.int64))
    return confusion(pair.semantics, true, pair.mask)


# ---- vehicles and markings -----------------------------------------------------------------------


class AgentIou:
    """Mean of ``box_scores.agent_ious`` over all vehicles of all views."""

    def __init__(self) -> None:
        self.source = _agents_of
        self.values: list[float] = []

    def add(self, measured: list[float] | None) -> None:
        """Add the vehicles of one view."""
        self.values += measured or []

    def value(self) -> float | None:
        """[0, 1], or None without a vehicle."""
        return sum(self.values) / len(self.values) if self.values else None


def _agents_of(pair: Pair) -> list[float] | None:
    agents = None if pair.facts is None else pair.facts.agents
    return None if agents is None or pair.semantics is None else agent_ious(agents, pair.semantics.numpy())


class LaneIou:
    """IoU of the markings that a fixed rule finds with the exact ones, both on the true road within 40 m, 2 pixels of
    tolerance, pooled."""

    def __init__(self) -> None:
        self.source = _lanes_of
        self._sums = np.zeros(4)

    def add(self, measured: NDArray[np.float64] | None) -> None:
        """Add one view."""
        if measured is not None:
            self._sums += measured

    def value(self) -> float | None:
        """[0, 1], or None where no marking was to be seen or found."""
        return float(self._sums[0] / self._sums[1]) if self._sums[1] else None

    def mean_of_classes(self) -> float | None:
        """(IoU of the rest of the road + IoU of markings) / 2, times 100."""
        if not self._sums[1] or not self._sums[3]:
            return None
        return 50.0 * float(self._sums[0] / self._sums[1] + self._sums[2] / self._sums[3])


def _lanes_of(pair: Pair) -> NDArray[np.float64] | None:
    """Tolerant hits and union of markings, and the same of the rest of the road, f64[4] in pixels."""
    lanes = None if pair.facts is None else pair.facts.lanes
    if lanes is None or pair.rgb is None or not lanes.exact:
        return None
    found = street_scores.bright_stripes(pair.rgb.numpy(), lanes.road)
    rest, true_rest = lanes.road & ~found, lanes.road & ~lanes.marking
    markings = street_scores.tolerant_iou(found, lanes.marking)
    return np.array([*markings, (rest & true_rest).sum(), (rest | true_rest).sum()], np.float64)


def _lane_edges(pair: Pair) -> float | None:
    lanes = None if pair.facts is None else pair.facts.lanes
    if lanes is None or pair.rgb is None or not lanes.band.any():
        return None
    rows = street_scores.rows_of(lanes.band, 1)
    made, true = (
        street_scores.edges_of(street_scores.gray_of(rgb[:, rows])) for rgb in (pair.rgb.numpy(), lanes.reference)
    )
    return street_scores.edge_correlation(made, true, lanes.band[rows])


def _lane_colors(pair: Pair) -> tuple[float, int] | None:
    lanes = None if pair.facts is None else pair.facts.lanes
    if lanes is None or pair.rgb is None or not lanes.band.any():
        return None
    apart = pair.rgb[:, torch.from_numpy(lanes.band)].clamp(0, 1).numpy() - lanes.reference[:, lanes.band]
    return float((apart.astype(np.float64) ** 2).sum()), apart.size


# ---- neighbouring views --------------------------------------------------------------------------


def temporal_flickering() -> Neighbours:
    """(255 - mean |frame - next frame|) / 255 on 8 bits, mean over neighbouring frames: VBench's measure, meant for
    videos that stand still. A moving camera lowers it, also that of the truth; a blurred video has a high one."""
    return Neighbours(_bytes_of, _steadiness)


def _steadiness(frames: tuple[Tensor, Tensor]) -> tuple[float, int]:
    before, frame = frames
    if before.shape != frame.shape:
        return 0.0, 0
    total = sum(int((a.short() - b).abs().sum()) for a, b in zip(before, frame, strict=True))
    return (255.0 - total / frame.numel()) / 255.0, 1


def _bytes_of(pair: Pair) -> Tensor | None:
    return None if pair.rgb is None else torch.stack([(c.clamp(0, 1) * 255).round().byte() for c in pair.rgb])


def warp_error(motion: ExactMotion) -> Neighbours:
    """Mean absolute difference of colour, of 1, between a surface in one frame and the same surface in the next,
    pooled; surfaces that are hidden in either frame do not count. motion: shared by the methods on a trajectory."""
    return change_of(motion, lambda _before, _pair, where: int(where.same.sum()))


# ---- the table -----------------------------------------------------------------------------------

EVERY_VIEW: Final = ("temporal_flickering", "warp_error")
"""Metrics that want all views of a trajectory, in order."""


def _at_points(part: str) -> dict[str, Callable[[], Metric]]:
    """What is computed at LiDAR points: all, or the static or dynamic ones."""
    fields: tuple[Literal["abs_rel", "rmse_m", "delta1"], ...] = ("abs_rel", "rmse_m", "delta1")
    errors = {f"lidar_{field}": partial(depth_error, field, _POINT_DEPTHS[part]) for field in fields}
    return {**errors, "lidar_psnr": partial(decibels, _POINT_COLORS[part])}


FACTS: Final[Mapping[str, Callable[[], Metric]]] = {
    **_at_points(""),
    "agreement": lambda: Segmentation("miou", _carried_classes),
    "agent_iou": AgentIou,
    "lane_iou": LaneIou,
    "lane_correlation": lambda: frame_mean(_lane_edges),
    "lane_psnr": lambda: decibels(_lane_colors),
    "temporal_flickering": temporal_flickering,
}
"""Rows of ``metrics.METRICS`` that are computed from ``ViewFacts`` or from neighbouring views; the warp error needs a
motion besides."""
PARTS: Final[Mapping[str, Callable[[], Metric]]] = {
    f"{name}_{part}": build for part in ("static", "dynamic") for name, build in _at_points(part).items()
}
"""The same for static points and for points of dynamic objects; beside the table, in ``points`` of a result."""


def build_facts(motion: ExactMotion) -> dict[str, Metric]:
    """A fresh accumulator for every row of ``FACTS`` and ``PARTS``, and for the warp error."""
    return {**{name: build() for name, build in (*FACTS.items(), *PARTS.items())}, "warp_error": warp_error(motion)}


def details(metrics: Mapping[str, Metric]) -> dict[str, Any]:
    """What stands beside the table for a method: ``points`` by part, number of ``agents``, ``lane_mean_of_classes``."""
    values = {name: metrics[name].value() for name in PARTS if name in metrics}
    found: dict[str, Any] = {}
    if any(value is not None for value in values.values()):
        found["points"] = {name: None if value is None else round(value, 6) for name, value in values.items()}
    agents, lanes = metrics.get("agent_iou"), metrics.get("lane_iou")
    if isinstance(agents, AgentIou) and agents.values:
        found["agents"] = len(agents.values)
    mean = lanes.mean_of_classes() if isinstance(lanes, LaneIou) else None
    return {**found, **({} if mean is None else {"lane_mean_of_classes": round(mean, 4)})}
