"""What laser beams meet, and LiDAR points as sparse truth at any view. Points in the boxes of dynamic objects travel
with their box; all others stand still."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import ndimage
from scipy.spatial import KDTree

from mudg.base import geometry
from mudg.base.types import Track, View
from mudg.core.edit import HeightMap
from mudg.core.fusion import STATIC
from mudg.core.project import RULES, DrawLimits, PointLayer, draw_points, hidden_pixels

# beams --------------------------------------------------------------------------------------------
# Surfaces of points, boxes, the ground, in the frame of the sensor, beams from its origin.


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
    """Where beams (unit directions f64[B, 3]) meet a surface of points f64[N, 3] of radii f64[N] (``ball_sizes``):
    range f64[B] metres, infinite where a beam meets nothing, and the first point that it meets i64[B] (-1: none)."""
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
    """Range f64[B] at which beams enter a box, metres; infinite where they miss it. A sensor within the box enters at
    0."""
    half = np.asarray(size_m, np.float64) / 2
    origin = geometry.invert(sensor_from_box)[:3, 3]
    directions = beams @ sensor_from_box[:3, :3]
    with np.errstate(divide="ignore", invalid="ignore"):
        ends = np.stack([(-half - origin) / directions, (half - origin) / directions])
    ends = np.where(np.isnan(ends), np.array([-np.inf, np.inf])[:, None, None], ends)  # along a face
    enter, leave = ends.min(0).max(1), ends.max(0).min(1)
    return np.where((leave >= enter) & (leave > 0), np.maximum(enter, 0.0), np.inf)


def met_ground(beams: Array, world_from_sensor: Array, ground: HeightMap, from_m: Array, within_m: float) -> Array:
    """Range f64[B] at which beams meet known ground, metres; infinite where they do not. ``from_m``: range f64[B]
    behind which the ground is looked for, ``within_m`` far."""
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


# points seen --------------------------------------------------------------------------------------


NEAR_M: Final = 0.5
DEPTH_LIMIT_M: Final = 80.0
SPREAD_SHARE: Final = 0.03
"""A pixel takes the answer of the nearest point within this share of the image's width."""


@dataclass(frozen=True, slots=True, eq=False)
class OwnedPoints:
    """Points f32[N, 3] metres, static ones in the world, others in the frame of their object, its number ``owner``
    i32[N] among the dynamic tracks (or STATIC), train ids u8[N] (255 = unknown), and the largest angle between
    neighbouring beams."""

    xyz: NDArray[np.float32]
    owner: NDArray[np.int32]
    ids: NDArray[np.uint8]
    gap_deg: float

    def taken(self, chosen: NDArray[np.integer]) -> OwnedPoints:
        """Some of the points, by their numbers."""
        return OwnedPoints(self.xyz[chosen], self.owner[chosen], self.ids[chosen], self.gap_deg)


@dataclass(frozen=True, slots=True, eq=False)
class PointTruth:
    """What LiDAR points say about a view: depth f32[H, W] in metres of the point that a pixel shows (0 = none), whether
    it belongs to a dynamic object, its colour u8[H, W, 3] in the recorded image of that time where that image shows it,
    too (``colored``), and its class u8[H, W] in the image's labels (255 = none or not shown there)."""

    depth: NDArray[np.float32]
    dynamic: NDArray[np.bool_]
    color: NDArray[np.uint8]
    colored: NDArray[np.bool_]
    classes: NDArray[np.uint8]


def placed(points: OwnedPoints, dynamic: Sequence[Track], time_s: float) -> NDArray[np.float32]:
    """Where points are at a moment, f32[N, 3] in the world; NaN where their object (of ``dynamic``) has no box then."""
    world = points.xyz.copy()
    for number in np.unique(points.owner[points.owner != STATIC]):
        rows = points.owner == number
        pose = dynamic[number].pose_at(time_s)
        world[rows] = np.nan if pose is None else geometry.transform_points(pose, points.xyz[rows])
    return world


def visible(view: View, world: NDArray[np.float32], gap_deg: float) -> tuple[NDArray[np.float32], NDArray[np.int32]]:
    """Depth f32[H, W] (0 = none) and number i32[H, W] (-1 = none) of the point that each pixel shows, hidden ones left
    out (the rule ``sweep`` of ``core/project.py``)."""
    depth, index = draw_points([PointLayer(world, np.eye(4))], view, DrawLimits(NEAR_M, DEPTH_LIMIT_M))
    rule = RULES["sweep"]
    found = np.where(index >= 0, depth, np.float32(np.inf))
    shown = (index >= 0) & ~hidden_pixels(found, rule, rule.reach(view.camera, gap_deg))
    return np.where(shown, depth, np.float32(0)), np.where(shown, index, np.int32(-1))


def pixels_of(
    view: View, world: NDArray[np.floating]
) -> tuple[NDArray[np.bool_], NDArray[np.intp], NDArray[np.intp], NDArray[np.float32]]:
    """Which points bool[N] fall into a view, and of these row, column and depth in metres."""
    uv, z = geometry.project(view, world)
    with np.errstate(invalid="ignore"):
        inside = (z > NEAR_M) & (uv >= 0).all(1) & (uv[:, 0] < view.camera.width) & (uv[:, 1] < view.camera.height)
    column, row = np.floor(uv[inside]).astype(np.intp).T
    return inside, row, column, z[inside].astype(np.float32)


def carried(
    recorded: View, image: NDArray[np.uint8], world: NDArray[np.float32], gap_deg: float
) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
    """What an image u8[H, W, ...] (colours or classes) shows at points f32[N, 3]: its pixels' values u8[N + 1, ...],
    and which points it shows, bool[N + 1]. The last entry is that of no point (index -1 of ``visible``)."""
    _, index = visible(recorded, world, gap_deg)
    rows, columns = np.nonzero(index >= 0)
    values = np.zeros((len(world) + 1, *image.shape[2:]), np.uint8)
    known = np.zeros(len(world) + 1, bool)
    numbers = index[rows, columns]
    values[numbers], known[numbers] = image[rows, columns], True
    return values, known


# ---- what other cameras saw ----------------------------------------------------------------------


@dataclass(frozen=True, slots=True, eq=False)
class ShownFrame:
    """A shown frame: dense depth f32[H, W] metres (infinite where unknown), and its photograph u8[H, W, 3],
    ``blurred``."""

    view: View
    depth: NDArray[np.float32]
    rgb: NDArray[np.uint8]

    def sees(self, world: NDArray[np.float32]) -> tuple[NDArray[np.intp], NDArray[np.uint8]]:
        """Numbers of the points f32[N, 3] that it shows, and their colours u8[n, 3] there: they fall into the image and
        are not behind its dense depth (rule ``drawn`` of ``core/project.py``)."""
        inside, row, column, z = pixels_of(self.view, world)
        clear = ~RULES["drawn"].hides(self.depth[row, column], z)
        return np.flatnonzero(inside)[clear], self.rgb[row[clear], column[clear]]


def blurred(rgb: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """A photograph u8[H, W, 3] averaged over 5x5 pixels, so that a point that is a pixel off has about its colour."""
    for axis in (0, 1):
        rgb = np.asarray(ndimage.uniform_filter1d(rgb, 5, axis=axis, mode="nearest"), np.uint8)
    return rgb


def seen_by(
    place: Callable[[OwnedPoints, float], NDArray[np.float32]],
    points: OwnedPoints,
    shown: Sequence[ShownFrame],
    time_s: float,
) -> tuple[NDArray[np.bool_], NDArray[np.uint8]]:
    """Which points bool[N] some shown frame of any time saw, and the colour u8[N, 3] that they had there: frames near
    ``time_s`` are asked first. ``place(points, time)`` says where points are."""
    seen, colors = np.zeros(len(points.xyz), bool), np.zeros((len(points.xyz), 3), np.uint8)
    for frame in sorted(shown, key=lambda frame: abs(frame.view.time_s - time_s)):
        left = np.flatnonzero(~seen)
        if not len(left):
            break
        found, shown_there = frame.sees(place(points.taken(left), frame.view.time_s))
        seen[left[found]], colors[left[found]] = True, shown_there
    return seen, colors


def spread(
    answers: NDArray[np.bool_], rows: NDArray[np.intp], columns: NDArray[np.intp], shape: tuple[int, int]
) -> NDArray[np.bool_]:
    """A mask bool[H, W] from answers bool[N] at pixels: each pixel takes that of the nearest point, if one lies within
    ``SPREAD_SHARE`` of the width; else False."""
    mask, known = np.zeros(shape, bool), np.zeros(shape, bool)
    known[rows, columns], mask[rows, columns] = True, answers
    if not known.any():
        return mask
    row, column = np.asarray(ndimage.distance_transform_edt(~known, return_distances=False, return_indices=True))
    here_row, here_column = np.indices(shape)
    return mask[row, column] & (np.hypot(row - here_row, column - here_column) <= max(2.0, SPREAD_SHARE * shape[1]))
