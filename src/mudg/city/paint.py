"""Where paint lies on the streets of the generated city, exactly: at any point of the ground, and as lines for scores
that want a map.

The rules are those of ``native/city_ground.cpp``, without its blur over the footprint of a pixel and without wear.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from mudg.city.layout import MARK_DASHED, MARK_DOUBLE, MARK_HATCHED, Centreline, Crossing, StreetPlan

Array = NDArray[np.float64]

_BAR_PERIOD_M: Final = 1.1
_BAR_MIDDLE_M: Final = 0.3
_BAR_HALF_M: Final = 0.27
_STOP_M: Final = 1.5
_STOP_HALF_M: Final = 0.2
_DOUBLE_M: Final = 0.15
_STEP_M: Final = 0.5


def painted(plan: StreetPlan, street: Array, xy: Array) -> NDArray[np.bool_]:
    """Whether points of the road carry paint, bool[N].

    Args:
        street: s, u and distance to the kerb f64[N, 3] of the points (``CityHandle.street``). xy: the points f64[N, 2]
            in the world.
    """
    s, u = street[:, 0], street[:, 1]
    crossing = plan.crossing
    a, b = (np.zeros(len(xy)), np.zeros(len(xy))) if crossing is None else _cross_coordinates(crossing, xy)
    in_cross = np.zeros(len(xy), bool) if crossing is None else (u > plan.left) | (u < plan.right)
    cut = in_cross if crossing is None else in_cross | (np.abs(b) < crossing.half_width + 0.6)
    paint = np.zeros(len(xy), bool)
    for start, length, on_cross in plan.crosswalks:
        here = in_cross if on_cross and crossing is not None else np.ones(len(xy), bool)
        along, across = (a if on_cross else s) - start, b if on_cross else u
        near = here & (along > -2.2) & (along < length + 2.2)
        if not on_cross:
            cut = cut | near
        bars = np.abs((across / _BAR_PERIOD_M) % 1.0 * _BAR_PERIOD_M - _BAR_MIDDLE_M) < _BAR_HALF_M
        paint |= near & (along > 0) & (along < length) & bars
        paint |= near & _stop_line(plan, along, across, length, bool(on_cross))
    paint |= ~cut & _marks(plan, s, u)
    if crossing is not None:
        to_edge = np.where(a > 0, a - plan.left, -a + plan.right)
        dashes = np.abs((a / 6.0) % 1.0 * 6.0 - 1.5) < 1.5
        paint |= in_cross & (to_edge > 7.0) & (np.abs(b) < 0.07) & dashes
    return paint & (street[:, 2] < 0)


def _stop_line(plan: StreetPlan, along: Array, across: Array, length: float, on_cross: bool) -> NDArray[np.bool_]:
    """Stop lines for traffic that comes towards a crossing."""
    right = across < 0
    line = np.where(right, -_STOP_M, length + _STOP_M)
    if on_cross:
        line = np.where(right, -99.0, length + _STOP_M)
    half = (
        plan.crossing.half_width if on_cross and plan.crossing is not None else np.where(right, -plan.right, plan.left)
    )
    return (np.abs(across) < half - 0.4) & (np.abs(along - line) < _STOP_HALF_M)


def _marks(plan: StreetPlan, s: Array, u: Array) -> NDArray[np.bool_]:
    """Lines along the main street."""
    paint = np.zeros(len(s), bool)
    for place, half, period, dash, kind, _ in plan.marks:
        off = u - place
        if kind == MARK_DOUBLE:
            found = np.abs(np.abs(off) - _DOUBLE_M) < half
        elif kind == MARK_HATCHED:
            found = (np.abs(off) < half) & _dashed(s + 0.7 * off, period, dash)
        else:
            found = np.abs(off) < half
            if kind == MARK_DASHED:
                found &= _dashed(s, period, dash)
        paint |= found
    return paint


def _dashed(along: Array, period: float, dash: float) -> NDArray[np.bool_]:
    return np.abs((along / period) % 1.0 * period - 0.5 * dash) < 0.5 * dash


def _cross_coordinates(crossing: Crossing, xy: Array) -> tuple[Array, Array]:
    c, n = np.cos(crossing.yaw), np.sin(crossing.yaw)
    dx, dy = xy[:, 0] - crossing.x, xy[:, 1] - crossing.y
    return c * dx + n * dy, -n * dx + c * dy


# ---- as a map has it -----------------------------------------------------------------------------


def lane_lines(plan: StreetPlan) -> list[Array]:
    """Road lines, road edges and the long sides of crosswalks as lines f64[N, 3] on the road, metres in the world.

    As in a map, a dashed line is one line, and nothing is left out where a crossing street begins.
    """
    along = np.arange(plan.line.s[0], plan.line.s[-1], _STEP_M)
    lines = [_street_line(plan.line, along, np.full(len(along), u)) for u in (*plan.marks[:, 0], plan.left, plan.right)]
    for start, length, on_cross in plan.crosswalks:
        for edge in (start, start + length):
            if on_cross and plan.crossing is not None:
                across = np.arange(-plan.crossing.half_width, plan.crossing.half_width, _STEP_M)
                places = np.array([plan.crossing.to_world(edge, b) for b in across])
                lines.append(np.c_[places, np.zeros(len(places))])
            elif not on_cross:
                across = np.arange(plan.right, plan.left, _STEP_M)
                lines.append(_street_line(plan.line, np.full(len(across), edge), across))
    return lines


def _street_line(line: Centreline, s: Array, u: Array) -> Array:
    """World places f64[N, 3] of street coordinates."""
    x, y, _ = line.to_world(s, u)
    return np.stack([x, y, np.zeros(len(s))], 1)
