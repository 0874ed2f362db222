"""Changes of how road users move, as pure functions on the keys of a path, for tracks, the vehicle and nodes of a
fitted scene alike; boxes against each other; and the ground below."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import ndimage
from scipy.interpolate import PchipInterpolator

from mudg.base import geometry
from mudg.base.errors import InputError

# boxes --------------------------------------------------------------------------------------------


def overlap_m(poses_a: Array, size_a: ArrayLike, poses_b: Array, size_b: ArrayLike) -> Array:
    """How deep pairs of boxes overlap, f64[T] metres: the shortest way that parts them; negative: the gap along the
    best axis. Poses are world_from_box f64[T, 4, 4], origin in the centre; sizes length, width, height.

    Separating axes of two boxes: three faces of each and the nine cross products of their edges (Gottschalk et al.,
    1996).
    """
    half_a, half_b = np.asarray(size_a, np.float64) / 2, np.asarray(size_b, np.float64) / 2
    edges_a, edges_b = np.swapaxes(poses_a[:, :3, :3], 1, 2), np.swapaxes(poses_b[:, :3, :3], 1, 2)
    crossed = np.cross(edges_a[:, :, None], edges_b[:, None]).reshape(len(poses_a), 9, 3)
    length = np.linalg.norm(crossed, axis=-1, keepdims=True)
    parallel = length[..., 0] < 1e-6
    axes = np.concatenate([edges_a, edges_b, crossed / np.maximum(length, 1e-6)], 1)
    between = np.abs(np.einsum("tkj,tj->tk", axes, poses_b[:, :3, 3] - poses_a[:, :3, 3]))
    reach = sum(
        np.einsum("tke,e->tk", np.abs(np.einsum("tkj,tej->tke", axes, edges)), half)
        for edges, half in ((edges_a, half_a), (edges_b, half_b))
    )
    overlap = reach - between
    overlap[:, 6:][parallel] = np.inf  # parallel edges give no axis of their own
    return overlap.min(1)


def azimuths(world_from_box: Array, places: Array) -> Array:
    """From which side places f64[N, 3] look at boxes f64[N, 4, 4]: angle from the box's front, counter-clockwise,
    radians."""
    toward = places - world_from_box[:, :3, 3]
    local = np.einsum("nji,nj->ni", world_from_box[:, :3, :3], toward)
    return np.arctan2(local[:, 1], local[:, 0])


def angle_to_nearest(asked: Array, seen: Array) -> Array:
    """Angle f64[N] radians from each asked direction f64[N] to the nearest seen one f64[M]; pi where nothing was
    seen."""
    if not len(seen):
        return np.full(len(asked), np.pi)
    apart = np.abs(asked[:, None] - seen[None])
    return np.minimum(apart % (2 * np.pi), 2 * np.pi - apart % (2 * np.pi)).min(1)


# ground: a height map of what a vehicle stands on that is put somewhere else --------------------------


CELL_M: Final = 0.5
REACH_M: Final = 3.0
"""A cell without points takes the height of the nearest one within this distance; farther away nothing is known."""
TILT_M: Final = 2.0
"""The slope is that between places this far to either side: about what a vehicle stands on."""
SMOOTHING_CELLS: Final = 1.5
MOST_CELLS: Final = 50_000_000


@dataclass(frozen=True, slots=True, eq=False)
class HeightMap:
    """Heights on a grid of the horizontal plane.

    Args:
        origin: f64[2], world x and y of the centre of cell (0, 0), metres. cell_m: side of a cell.
        heights: f64[X, Y], world z in metres, smoothed; NaN where no point lies within `REACH_M`.
    """

    origin: Array
    cell_m: float
    heights: Array

    @classmethod
    def from_points(cls, xyz: NDArray[np.floating], cell_m: float = CELL_M) -> HeightMap:
        """Median height per cell, gaps filled from the nearest cell, smoothed. ``xyz``: [N, 3] world points of the
        ground, metres. InputError: no points, or points that are too far apart for a map."""
        points = np.asarray(xyz, np.float64)
        points = points[np.isfinite(points).all(1)]
        if not len(points):
            what = "there is no ground: no point is of class road, sidewalk or terrain"
            raise InputError(what, remedy="fuse a scene with labels, or leave ground out (ground: false)")
        cells = np.floor(points[:, :2] / cell_m).astype(np.int64)
        first = cells.min(0) - int(np.ceil(REACH_M / cell_m))
        shape = cells.max(0) - first + 1 + int(np.ceil(REACH_M / cell_m))
        if shape.prod() > MOST_CELLS:
            got = f"{shape[0] * cell_m:.0f} x {shape[1] * cell_m:.0f} m"
            raise InputError("the ground spans too large an area", got=got)
        flat = (cells[:, 0] - first[0]) * shape[1] + cells[:, 1] - first[1]
        order = np.lexsort((points[:, 2], flat))
        ids, begins, counts = np.unique(flat[order], return_index=True, return_counts=True)
        heights = np.full(int(shape.prod()), np.nan)
        middle = [points[order[begins + at], 2] for at in ((counts - 1) // 2, counts // 2)]
        heights[ids] = (middle[0] + middle[1]) / 2
        return cls((first + 0.5) * cell_m, cell_m, _smoothed(heights.reshape(shape), cell_m))

    def height(self, xy: Array) -> Array:
        """World z f64[N] under places f64[N, 2]; NaN where it is not known."""
        at = (np.asarray(xy, np.float64) - self.origin) / self.cell_m
        return ndimage.map_coordinates(self.heights, at.T, order=1, mode="constant", cval=np.nan)

    def normal(self, xy: Array) -> Array:
        """Unit normals f64[N, 3] of the ground at places f64[N, 2], upwards; vertical where it is not known."""
        rises = [self.height(xy + step) - self.height(xy - step) for step in TILT_M * np.eye(2)]
        slopes = np.nan_to_num(np.stack(rises, 1) / (2 * TILT_M))
        normals = np.column_stack([-slopes, np.ones(len(slopes))])
        return normals / np.linalg.norm(normals, axis=1, keepdims=True)


def _smoothed(heights: Array, cell_m: float) -> Array:
    """Gaps filled as far as `REACH_M`, then a Gaussian blur that only known cells enter."""
    empty = np.isnan(heights)
    nearest: Any = ndimage.distance_transform_edt(empty, return_distances=False, return_indices=True)
    filled = heights[tuple(nearest)]
    here = np.indices(heights.shape)
    far = np.linalg.norm(nearest - here, axis=0) * cell_m > REACH_M
    weight = ndimage.gaussian_filter((~far).astype(np.float64), SMOOTHING_CELLS)
    blurred = ndimage.gaussian_filter(np.where(far, 0.0, filled), SMOOTHING_CELLS) / np.maximum(weight, 1e-12)
    return np.where(far, np.nan, blurred)


# paths --------------------------------------------------------------------------------------------


Array = NDArray[np.float64]
STEP_S: Final = 0.05
"""Distance of the keys that describe a changed stretch of a path."""
STANDING_M_S: Final = 0.5
"""Slower than this, a road user stands: it has no direction in which it could change lanes."""
QUINTIC_PEAK: Final = 10 / 3**0.5
"""Largest second derivative of ``quintic``."""


@dataclass(frozen=True, slots=True, eq=False)
class Motion:
    """A path: straight lines and slerp between poses world_from_object f64[K, 4, 4] at key times f64[K], strictly
    increasing. ``source_s`` f64[K]: the moment of the recording that each key shows, so that what moves within a box (a
    walking person) can follow when a path is retimed."""

    times_s: Array
    poses: Array
    source_s: Array

    @classmethod
    def recorded(cls, times_s: ArrayLike, poses: Array) -> Motion:
        """A path as it was recorded."""
        times = np.asarray(times_s, np.float64)
        return cls(times, np.asarray(poses, np.float64), times)

    def pose_at(self, time_s: float) -> Array | None:
        """Pose f64[4, 4]; None outside the span."""
        return geometry.pose_at(self.times_s, self.poses, time_s)

    def at(self, times_s: Array) -> Motion:
        """The same path with keys at these times, which lie within its span."""
        inside = np.clip(times_s, self.times_s[0], self.times_s[-1])
        poses = [geometry.pose_at(self.times_s, self.poses, float(t)) for t in inside]
        source_s = np.interp(inside, self.times_s, self.source_s)
        return Motion(times_s, np.stack(poses), source_s)  # type: ignore[arg-type]

    def with_keys_between(self, begin_s: float, end_s: float) -> Motion:
        """The same path with further keys, every `STEP_S` within a stretch."""
        begin, end = max(begin_s, self.times_s[0]), min(end_s, self.times_s[-1])
        if end <= begin:
            return self
        more = np.linspace(begin, end, max(2, int(np.ceil((end - begin) / STEP_S)) + 1))
        return self.at(_merged(self.times_s, more))

    def speed_at(self, time_s: float) -> float:
        """Speed in metres per second, over 0.2 s."""
        before, after = (float(np.clip(time_s + d, self.times_s[0], self.times_s[-1])) for d in (-0.1, 0.1))
        ends = self.at(np.array([before, after])).poses[:, :3, 3] if after > before else np.zeros((2, 3))
        return float(np.linalg.norm(ends[1] - ends[0]) / max(after - before, 1e-9))

    def travelled_m(self) -> Array:
        """Length of the path up to each key, f64[K] metres."""
        steps = np.linalg.norm(np.diff(self.poses[:, :3, 3], axis=0), axis=1)
        return np.concatenate([[0.0], np.cumsum(steps)])


def quintic(s: Array) -> Array:
    """From 0 to 1 with no speed and acceleration at the ends; 0 before, 1 after."""
    u = np.clip(s, 0, 1)
    return u**3 * (10 - 15 * u + 6 * u**2)


# -- where -----------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Displacement:
    """A displacement in the frame of the object: metres ahead, to the left and up, a turn to the left in radians.
    ``from_s``: when it begins (None: it is there at all times); ``ramp_s``: how long it takes to come about."""

    ahead_m: float = 0.0
    left_m: float = 0.0
    up_m: float = 0.0
    yaw_rad: float = 0.0
    from_s: float | None = None
    ramp_s: float = 0.0

    @property
    def matrix(self) -> Array:
        """f64[4, 4] of the whole displacement."""
        return geometry.yaw_matrix(self.yaw_rad, (self.ahead_m, self.left_m, self.up_m))


def moved(motion: Motion, by: Displacement, ground: HeightMap | None = None) -> Motion:
    """A path displaced in the object's own frame; on ``ground``, at the height above it that it had."""
    if by.from_s is None:
        changed = replace(motion, poses=motion.poses @ by.matrix)
        return changed if ground is None else grounded(changed, motion, ground)
    ramp = max(by.ramp_s, 1e-3)
    keyed = motion.with_keys_between(by.from_s, by.from_s + ramp)
    share = quintic((keyed.times_s - by.from_s) / ramp)
    steps = [geometry.yaw_matrix(w * by.yaw_rad, (w * by.ahead_m, w * by.left_m, w * by.up_m)) for w in share]
    changed = replace(keyed, poses=keyed.poses @ np.stack(steps))
    return changed if ground is None else grounded(changed, keyed, ground)


def lane_changed(
    motion: Motion, left_m: float, start_s: float, duration_s: float, ground: HeightMap | None = None
) -> Motion:
    """A path that changes lanes, heading along the new one: offset ``d (10 s^3 - 15 s^4 + 6 s^5)`` to the left of the
    recorded path, ``s = (t - start_s) / duration_s``, with no lateral speed and acceleration at its ends. InputError:
    it begins outside the path, or the road user stands then."""
    first, last = float(motion.times_s[0]), float(motion.times_s[-1])
    if not first <= start_s < last:
        what = "the lane change begins outside the path"
        raise InputError(what, where="start_s", expected=f"{first:.2f}..{last:.2f} s", got=f"{start_s} s")
    speed = motion.speed_at(start_s)
    if speed < STANDING_M_S:
        what, expected = "only what drives can change lanes", f"at least {STANDING_M_S} m/s"
        got = f"{speed:.2f} m/s at {start_s} s"
        raise InputError(what, where="start_s", expected=expected, got=got, remedy="use move to displace what stands")
    keyed = motion.with_keys_between(start_s, start_s + duration_s)
    s = (keyed.times_s - start_s) / duration_s
    u = np.clip(s, 0, 1)
    lateral_m_s = left_m / duration_s * 30 * u**2 * (1 - u) ** 2
    poses = keyed.poses.copy()
    for i, (offset, rate) in enumerate(zip(left_m * quintic(s), lateral_m_s, strict=True)):
        heading = geometry.yaw_of(keyed.poses[i])
        turn = np.arctan2(rate, max(keyed.speed_at(float(keyed.times_s[i])), STANDING_M_S))
        poses[i, :3, :3] = geometry.yaw_matrix(float(turn))[:3, :3] @ keyed.poses[i, :3, :3]
        poses[i, :2, 3] += offset * np.array([-np.sin(heading), np.cos(heading)])
    changed = replace(keyed, poses=poses)
    return changed if ground is None else grounded(changed, keyed, ground)


def grounded(motion: Motion, before: Motion, ground: HeightMap) -> Motion:
    """Set a changed path on the ground: the height above it, and the tilt against it, are those that the path had
    before.

    Keys of both belong together. Where the ground is unknown at either place, a key stays as it is.
    """
    new, old, poses = motion.poses[:, :2, 3], before.poses[:, :2, 3], motion.poses.copy()
    rise, normals, tilted = ground.height(new) - ground.height(old), ground.normal(old), ground.normal(new)
    for i in np.flatnonzero(np.isfinite(rise)):
        poses[i, 2, 3] += rise[i]
        poses[i, :3, :3] = _turn_between(normals[i], tilted[i]) @ poses[i, :3, :3]
    return replace(motion, poses=poses)


def along_points(points: Array, height_m: float, ground: HeightMap | None, floor_m: float = 0.0) -> Motion:
    """A path through places f64[P, 4]: time in seconds, x, y in metres, heading in radians (NaN: along the path); times
    increase, and one point stands. ``height_m``: of the object's origin above the ground; ``floor_m``: height of the
    ground where ``ground`` does not know it."""
    times, xy, yaw = points[:, 0], points[:, 1:3], points[:, 3]
    if len(points) > 1:
        steps = max(2, int(np.ceil((times[-1] - times[0]) / (2 * STEP_S))) + 1)
        keys = _merged(times, np.linspace(times[0], times[-1], steps))
        path = PchipInterpolator(times, xy)
        velocity = path.derivative()(keys)
        along = np.unwrap(np.arctan2(velocity[:, 1], velocity[:, 0]))
        given = np.isfinite(yaw)
        yaw = along if not given.all() else np.interp(keys, times, np.unwrap(yaw))
        xy = path(keys)
    else:
        keys, xy, yaw = times[0] + np.array([0.0, 1e-3]), xy[[0, 0]], np.nan_to_num(yaw)[[0, 0]]
    floor = np.full(len(keys), floor_m) if ground is None else np.nan_to_num(ground.height(xy), nan=floor_m)
    poses = np.stack(
        [geometry.yaw_matrix(float(a), (x, y, z + height_m)) for a, (x, y), z in zip(yaw, xy, floor, strict=True)]
    )
    if ground is not None:
        for pose, normal in zip(poses, ground.normal(xy), strict=True):
            pose[:3, :3] = _turn_between(np.array([0.0, 0, 1]), normal) @ pose[:3, :3]
    return Motion.recorded(keys, poses)


# -- when ------------------------------------------------------------------------------------------


def stopped(motion: Motion, at_s: float, brake_m_s2: float) -> Motion:
    """A path that brakes evenly from ``at_s`` on until it stands; it never goes farther than the recorded one has by
    then. InputError: ``at_s`` lies outside the path."""
    first, last = float(motion.times_s[0]), float(motion.times_s[-1])
    if not first <= at_s <= last:
        expected = f"{first:.2f}..{last:.2f} s"
        raise InputError("it stops outside its path", where="at_s", expected=expected, got=f"{at_s} s")
    keyed, speed = motion.with_keys_between(at_s, last), motion.speed_at(at_s)
    after = keyed.times_s >= at_s
    way = keyed.travelled_m()
    passed = np.minimum(keyed.times_s[after] - at_s, speed / brake_m_s2)
    braked = np.interp(at_s, keyed.times_s, way) + speed * passed - brake_m_s2 / 2 * passed**2
    reached = np.minimum(braked, way[after])
    rising = np.concatenate([[True], np.diff(way[after]) > 1e-9])
    recording = keyed.times_s.copy()
    recording[after] = np.interp(reached, way[after][rising], keyed.times_s[after][rising])
    if speed < 0.1:
        recording[after] = at_s
    return _retimed(motion, keyed.times_s, recording)


def sped(motion: Motion, factor: float, from_s: float | None = None) -> Motion:
    """A path driven at another speed from a moment on. Where it gets ahead of the recording, it goes on straight as at
    its end. ``factor``: > 0; 0.5 is half as fast."""
    first, last = float(motion.times_s[0]), float(motion.times_s[-1])
    begin = first if from_s is None else min(max(from_s, first), last)
    keyed = motion.with_keys_between(begin, last)
    recording = np.where(keyed.times_s < begin, keyed.times_s, begin + factor * (keyed.times_s - begin))
    return _retimed(motion, keyed.times_s, recording)


def _retimed(motion: Motion, times_s: Array, recording_s: Array) -> Motion:
    """The path that is at ``times_s`` where the given one was at ``recording_s``; beyond its end, straight on at its
    last speed."""
    found, last = motion.at(recording_s), float(motion.times_s[-1])
    beyond = np.maximum(recording_s - last, 0)
    if beyond.any() and len(motion.times_s) > 1:
        ends = motion.at(np.array([max(last - 0.2, float(motion.times_s[0])), last])).poses[:, :3, 3]
        velocity = (ends[1] - ends[0]) / min(0.2, last - float(motion.times_s[0]))
        found.poses[:, :3, 3] += beyond[:, None] * velocity
    return Motion(times_s, found.poses, found.source_s)


# -- helpers ---------------------------------------------------------------------------------------


def _merged(a: Array, b: Array) -> Array:
    """Both lists of times as one, increasing; of two that nearly agree the one in ``a`` stays."""
    near = np.abs(a[:, None] - b[None]).min(0) < 1e-4 if len(a) else np.zeros(len(b), bool)
    return np.sort(np.concatenate([a, b[~near]]))


def _turn_between(a: Array, b: Array) -> Array:
    """The smallest rotation f64[3, 3] that takes unit vector ``a`` to ``b``, which are not opposite."""
    axis, cosine = np.cross(a, b), float(a @ b)
    skew = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    return np.eye(3) + skew + skew @ skew / (1 + cosine)
