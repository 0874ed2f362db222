"""Metrics of one view, or of neighbouring views, that need more than a true image: LiDAR points, exact boxes, markings
and motion.

``view_facts.ViewFacts`` is what is known of a view beside its true image. The metrics are accumulators as in
``core/metrics.py``.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from mudg.base import geometry
from mudg.base.errors import InputError
from mudg.base.types import Track
from mudg.core import metrics as flicker
from mudg.core import street_scores
from mudg.core.lidar import PointTruth
from mudg.core.metrics import CLASS_COUNT, FrameMean, Metric, Pair, confusion, depth_errors, iou_of, neighbour_of
from mudg.core.street_scores import agent_ious

POINT_PARTS: Final = ("", "static", "dynamic")
PointField = Literal["abs_rel", "rmse_m", "delta1"]


# ---- LiDAR points --------------------------------------------------------------------------------


def _chosen(points: PointTruth, part: str) -> NDArray[np.bool_]:
    known = points.depth > 0
    return known & (points.dynamic if part == "dynamic" else ~points.dynamic) if part else known


class PointDepth:
    """Depth errors at the pixels that show a LiDAR point, pooled.

    Args:
        field: which error. part: all points, or the static or dynamic ones.
    """

    def __init__(self, field: PointField, part: str = "") -> None:
        self._field, self._part = field, part
        self.source = _POINT_DEPTHS[part]
        self._sum, self._pixels = 0.0, 0

    def add(self, measured: Any) -> None:
        """Add the errors of one view."""
        if measured is not None and measured.pixels:
            number = {"abs_rel": measured.abs_rel, "rmse_m": measured.rmse_m**2, "delta1": measured.delta1}[self._field]
            self._sum += number * measured.pixels
            self._pixels += measured.pixels

    def value(self) -> float | None:
        """The error over all points so far, or None without any."""
        mean = self._sum / self._pixels if self._pixels else None
        return math.sqrt(mean) if mean is not None and self._field == "rmse_m" else mean


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


class Decibels:
    """PSNR from squared errors pooled over all views: ``source`` gives their sum and number."""

    def __init__(self, source: Callable[[Pair], tuple[float, int] | None]) -> None:
        self.source = source
        self._sum, self._count = 0.0, 0

    def add(self, measured: tuple[float, int] | None) -> None:
        """Add the squared errors of one view."""
        if measured is not None:
            self._sum += measured[0]
            self._count += measured[1]

    def value(self) -> float | None:
        """dB, at most 100; None where nothing counted."""
        return min(100.0, -10 * math.log10(max(self._sum / self._count, 1e-12))) if self._count else None


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


class Agreement:
    """Mean IoU of a method's classes with those that LiDAR points carry from the recorded image."""

    def __init__(self) -> None:
        self.source = _carried_classes
        self._counts = torch.zeros(CLASS_COUNT, CLASS_COUNT + 1, dtype=torch.int64)

    def add(self, measured: Tensor | None) -> None:
        """Add the confusion counts of one view."""
        if measured is not None:
            self._counts += measured

    def value(self) -> float | None:
        """Mean over the classes that occur, or None."""
        ious = iou_of(self._counts)
        return sum(ious.values()) / len(ious) if ious else None


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


@dataclass(frozen=True)
class LaneCounts:
    """Tolerant hits and union of markings, and the same of the rest of the road, in pixels."""

    hits: float
    union: float
    rest_hits: float
    rest_union: float


class LaneIou:
    """IoU of the markings that a fixed rule finds with the exact ones, both on the true road within 40 m, 2 pixels of
    tolerance, pooled."""

    def __init__(self) -> None:
        self.source = _lanes_of
        self._sums = np.zeros(4)

    def add(self, measured: LaneCounts | None) -> None:
        """Add one view."""
        if measured is not None:
            self._sums += (measured.hits, measured.union, measured.rest_hits, measured.rest_union)

    def value(self) -> float | None:
        """[0, 1], or None where no marking was to be seen or found."""
        return float(self._sums[0] / self._sums[1]) if self._sums[1] else None

    def mean_of_classes(self) -> float | None:
        """(IoU of the rest of the road + IoU of markings) / 2, times 100."""
        if not self._sums[1] or not self._sums[3]:
            return None
        return 50.0 * float(self._sums[0] / self._sums[1] + self._sums[2] / self._sums[3])


def _lanes_of(pair: Pair) -> LaneCounts | None:
    lanes = None if pair.facts is None else pair.facts.lanes
    if lanes is None or pair.rgb is None or not lanes.exact:
        return None
    found = street_scores.bright_stripes(pair.rgb.numpy(), lanes.road)
    hits, union = street_scores.tolerant_iou(found, lanes.marking)
    rest, true_rest = lanes.road & ~found, lanes.road & ~lanes.marking
    return LaneCounts(hits, union, float((rest & true_rest).sum()), float((rest | true_rest).sum()))


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


class TemporalFlickering:
    """(255 - mean |frame - next frame|) / 255 on 8 bits, mean over neighbouring frames: VBench's measure, meant for
    videos that stand still. A moving camera lowers it, also that of the truth; a blurred video has a high one."""

    def __init__(self) -> None:
        self.source = _bytes_of
        self._before: Tensor | None = None
        self._sum, self._pairs = 0.0, 0

    def add(self, measured: Tensor | None) -> None:
        """Add the next frame."""
        before, self._before = self._before, measured
        if before is not None and measured is not None and before.shape == measured.shape:
            total = sum(int((a.short() - b).abs().sum()) for a, b in zip(before, measured, strict=True))
            self._sum += (255.0 - total / measured.numel()) / 255.0
            self._pairs += 1

    def value(self) -> float | None:
        """(0, 1], 1 = all frames are equal; None with fewer than two."""
        return self._sum / self._pairs if self._pairs else None


def _bytes_of(pair: Pair) -> Tensor | None:
    return None if pair.rgb is None else torch.stack([(c.clamp(0, 1) * 255).round().byte() for c in pair.rgb])


class ExactMotion:
    """Where surfaces of one view are in the next: by true depth and poses, vehicles by their boxes. The last answer is
    kept.

    Args:
        tracks: number in the instance map and track of every vehicle.
    """

    def __init__(self, tracks: Sequence[tuple[int, Track]]) -> None:
        self._tracks = tracks
        self._known: tuple[Tensor, Tensor, flicker.PixelMotion] | None = None

    def between(self, before: Pair, pair: Pair) -> flicker.PixelMotion | None:
        """For two neighbouring views with exact depth, classes and instances; else None."""
        if before.truth_depth is None or pair.truth_depth is None or before.view is None or pair.view is None:
            return None
        known = self._known
        if known is not None and known[0] is before.truth_depth and known[1] is pair.truth_depth:
            return known[2]
        ids, instance = before.truth_semantics, None if before.facts is None else before.facts.instance
        if ids is None or pair.truth_semantics is None:
            return None
        frames = [_true_frame(p) for p in (before, pair)]
        moved: dict[int, Tensor] = {}
        if instance is not None:
            for number, track in self._tracks:
                first, last = track.pose_at(before.view.time_s), track.pose_at(pair.view.time_s)
                if first is not None and last is not None:
                    moved[number] = torch.from_numpy(last @ geometry.invert(first))
        numbers = None if instance is None else torch.from_numpy(instance.astype(np.int64))
        motion = flicker.pixel_motion(frames[0], frames[1], moved, numbers)
        self._known = before.truth_depth, pair.truth_depth, motion
        return motion


def _true_frame(pair: Pair) -> flicker.TrueFrame:
    depth, ids, view = pair.truth_depth, pair.truth_semantics, pair.view
    if depth is None or ids is None or view is None:
        raise InputError("exact motion needs depth, classes and the view")
    return flicker.TrueFrame.of(view, torch.where(torch.isfinite(depth) & (depth > 0), depth, 1000.0), ids)


class WarpError:
    """Mean absolute difference of colour, of 1, between a surface in one frame and the same surface in the next,
    pooled. Surfaces are followed by exact motion; those that are hidden in either frame do not count.

    Args:
        motion: shared by the methods on a trajectory.
    """

    def __init__(self, motion: ExactMotion) -> None:
        self.source = neighbour_of
        self._motion = motion
        self._before: Pair | None = None
        self._sum, self._pixels = 0.0, 0

    def add(self, measured: Pair) -> None:
        """Add the next frame."""
        before, self._before = self._before, measured
        if before is None or before.rgb is None or measured.rgb is None:
            return
        motion = self._motion.between(before, measured)
        if motion is not None:
            self._sum += flicker.change(before.rgb.clamp(0, 1), measured.rgb.clamp(0, 1), motion)
            self._pixels += int(motion.same.sum())

    def value(self) -> float | None:
        """[0, 1], or None without two frames that show the same surface."""
        return self._sum / self._pixels if self._pixels else None


# ---- the table -----------------------------------------------------------------------------------

EVERY_VIEW: Final = ("temporal_flickering", "warp_error")
"""Metrics that want all views of a trajectory, in order."""
FACTS: Final[Mapping[str, Callable[[], Metric]]] = {
    "lidar_abs_rel": lambda: PointDepth("abs_rel"),
    "lidar_rmse_m": lambda: PointDepth("rmse_m"),
    "lidar_delta1": lambda: PointDepth("delta1"),
    "lidar_psnr": lambda: Decibels(_POINT_COLORS[""]),
    "agreement": Agreement,
    "agent_iou": AgentIou,
    "lane_iou": LaneIou,
    "lane_correlation": lambda: FrameMean(_lane_edges),
    "lane_psnr": lambda: Decibels(_lane_colors),
    "temporal_flickering": TemporalFlickering,
}
"""Rows of ``metrics.METRICS`` that are computed from ``ViewFacts`` or from neighbouring views; the warp error needs a
motion besides."""
PARTS: Final[Mapping[str, Callable[[], Metric]]] = {
    f"{name}_{part}": build
    for part in ("static", "dynamic")
    for name, build in (
        ("lidar_abs_rel", lambda part=part: PointDepth("abs_rel", part)),
        ("lidar_rmse_m", lambda part=part: PointDepth("rmse_m", part)),
        ("lidar_delta1", lambda part=part: PointDepth("delta1", part)),
        ("lidar_psnr", lambda part=part: Decibels(_POINT_COLORS[part])),
    )
}
"""The same for static points and for points of dynamic objects; beside the table, in ``points`` of a result."""


def build_facts(motion: ExactMotion) -> dict[str, Metric]:
    """A fresh accumulator for every row of ``FACTS`` and ``PARTS``, and for the warp error."""
    return {**{name: build() for name, build in (*FACTS.items(), *PARTS.items())}, "warp_error": WarpError(motion)}


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
