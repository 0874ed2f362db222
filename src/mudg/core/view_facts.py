"""What is known of a view beside its true image: worked out once, and read by the metrics of every method."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mudg.core.box_scores import VisibleAgent
from mudg.core.points_seen import PointTruth


@dataclass(frozen=True, slots=True, eq=False)
class LaneFacts:
    """Road markings of a view.

    Args:
        road: bool[H, W], where they are looked for. marking, band: bool[H, W], where they are, and the band around them.
        reference: colours f32[3, H, W] in [0, 1]: the true image, or the recorded one carried over by the ground plane.
        exact: ``marking`` is the truth, not what a rule found in the reference.
    """

    road: NDArray[np.bool_]
    marking: NDArray[np.bool_]
    band: NDArray[np.bool_]
    reference: NDArray[np.float32]
    exact: bool


@dataclass(frozen=True, slots=True, eq=False)
class ViewFacts:
    """Facts about a view, each None where it is not known.

    Args:
        points: what LiDAR points say. agents: vehicles that count. lanes: markings.
        instance: i32[H, W], number of the object that each pixel shows, 0 = none.
    """

    points: PointTruth | None = None
    agents: tuple[VisibleAgent, ...] | None = None
    lanes: LaneFacts | None = None
    instance: NDArray[np.int32] | None = None
