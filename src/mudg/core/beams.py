"""What laser beams meet: surfaces of points, boxes, the ground. All in the frame of the sensor, beams from its origin."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import KDTree

from mudg.base import geometry
from mudg.core.ground import HeightMap

Array = NDArray[np.float64]
SMALLEST_M, LARGEST_M = 0.03, 0.15
"""A point of a surface stands for a ball: as far as to its neighbours, within these limits."""
NEIGHBOURS: Final = 4
SURFACE_M: Final = 0.1
"""A beam meets the surface in the mean of what it passes within this distance behind the first ball."""
GROUND_STEP_M: Final = 0.2
_PAIRS: Final = 4_000_000


def ball_sizes(xyz: Array) -> Array:
    """Radii f64[N] of the balls that points f64[N, 3] of a surface stand for, metres."""
    if len(xyz) <= NEIGHBOURS:
        return np.full(len(xyz), LARGEST_M)
    apart = KDTree(xyz).query(xyz, NEIGHBOURS + 1)[0][:, -1]
    return np.asarray(apart, np.float64).clip(SMALLEST_M, LARGEST_M)


def met_points(beams: Array, xyz: Array, sizes: Array) -> tuple[Array, NDArray[np.int64]]:
    """Where beams meet a surface of points.

    Args:
        beams: unit directions f64[B, 3]. xyz: f64[N, 3]. sizes: radii f64[N] (``ball_sizes``).

    Returns:
        Range f64[B] metres, infinite where a beam meets nothing, and the first point that it meets i64[B] (-1: none).
    """
    ranges, first = np.full(len(beams), np.inf), np.full(len(beams), -1)
    if not len(xyz) or not len(beams):
        return ranges, first
    square, step = (xyz**2).sum(1), max(1, _PAIRS // len(xyz))
    for begin in range(0, len(beams), step):
        along = beams[begin : begin + step] @ xyz.T
        met = (square - along**2 <= sizes**2) & (along > 0)
        distance = np.where(met, along, np.inf)
        nearest = distance.min(1)
        near = met & (along <= nearest[:, None] + SURFACE_M)
        count = near.sum(1)
        mean = np.where(near, along, 0.0).sum(1) / np.maximum(count, 1)
        ranges[begin : begin + step] = np.where(count > 0, mean, np.inf)
        first[begin : begin + step] = np.where(count > 0, distance.argmin(1), -1)
    return ranges, first


def met_box(beams: Array, sensor_from_box: Array, size_m: ArrayLike) -> Array:
    """Range f64[B] at which beams enter a box, metres; infinite where they miss it. A sensor within the box enters at 0."""
    half = np.asarray(size_m, np.float64) / 2
    origin = geometry.invert(sensor_from_box)[:3, 3]
    directions = beams @ sensor_from_box[:3, :3]
    with np.errstate(divide="ignore", invalid="ignore"):
        ends = np.stack([(-half - origin) / directions, (half - origin) / directions])
    ends = np.where(np.isnan(ends), np.array([-np.inf, np.inf])[:, None, None], ends)  # along a face
    enter, leave = ends.min(0).max(1), ends.max(0).min(1)
    return np.where((leave >= enter) & (leave > 0), np.maximum(enter, 0.0), np.inf)


def met_ground(beams: Array, world_from_sensor: Array, ground: HeightMap, from_m: Array, within_m: float) -> Array:
    """Range f64[B] at which beams meet known ground, metres; infinite where they do not.

    Args:
        from_m: range f64[B] behind which the ground is looked for, ``within_m`` far.
    """
    if not len(beams):
        return np.zeros(0)
    steps = np.arange(0.0, within_m + GROUND_STEP_M, GROUND_STEP_M)
    ranges = from_m[:, None] + steps
    places = world_from_sensor[:3, 3] + ranges[..., None] * (beams @ world_from_sensor[:3, :3].T)[:, None]
    heights = ground.height(places[..., :2].reshape(-1, 2)).reshape(ranges.shape)
    above = places[..., 2] - heights
    with np.errstate(invalid="ignore"):
        passes = (above[:, :-1] > 0) & (above[:, 1:] <= 0)
        share = above[:, :-1] / (above[:, :-1] - above[:, 1:])
    at = passes.argmax(1)
    rows = np.arange(len(beams))
    return np.where(passes.any(1), ranges[rows, at] + share[rows, at] * GROUND_STEP_M, np.inf)
