"""When a box was seen: annotated boxes of moving objects are brought to their sweep's time.

A turning sensor meets an object some time before or after the sweep's time stamp. Sweeps that are compensated for the
vehicle's motion still show a moving object where it was when the beams met it, and people draw its box around these points: the box
belongs to the mean time of the points inside it, not to the stamp it is filed under. At 10 m/s and 0.08 s that is 0.8 m.
Each such box is moved by the track's velocity to the stamp, where points, too, are brought by their ``dt_s``.

Images are taken a little before or after the sweep they belong to; ``reach_images`` lets a track cover those at its ends.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from mudg.base.geometry import invert, transform_points
from mudg.base.types import SweepPoints, Track

Matrix = NDArray[np.float64]

MOVES_M: Final = 1.0
"""A track whose keys lie farther apart than this moves; boxes of others stay as they were drawn."""
REACH_S: Final = 0.05
"""Half a turn of a 10 Hz sensor; cameras look at most this far from the sweep they belong to."""
_GROWTH_M: Final = 0.1
_SAME_S: Final = 1e-3


class BoxTimes:
    """Mean point time of every box of every moving track, collected while sweeps pass by in any order.

    Args:
        tracks: as annotated; keys at sweep times. ``observe`` may be called from several threads, once per sweep.
    """

    def __init__(self, tracks: Sequence[Track]) -> None:
        self._tracks = tuple(tracks)
        self._moving = [i for i, track in enumerate(self._tracks) if _extent_m(track) > MOVES_M]
        self._late_s: dict[tuple[int, int], float] = {}

    def observe(self, time_s: float, map_from_lidar: Matrix, points: SweepPoints) -> None:
        """Note the mean ``dt_s`` of the points inside each box that is annotated at this sweep's time."""
        if not np.any(points.dt_s):
            return
        lidar_from_map = invert(map_from_lidar)
        order = np.argsort(points.xyz[:, 0])  # once a sweep: each box then looks at a slice of it only
        xyz, dt_s = points.xyz[order], points.dt_s[order]
        x, y = np.ascontiguousarray(xyz[:, 0]), np.ascontiguousarray(xyz[:, 1])
        for index in self._moving:
            track = self._tracks[index]
            key = int(np.searchsorted(track.times_s, time_s - _SAME_S))
            if key == len(track.times_s) or track.times_s[key] > time_s + _SAME_S:
                continue
            lidar_from_box = lidar_from_map @ track.world_from_object[key]
            half = track.size_m / 2 + _GROWTH_M
            reach = float(np.linalg.norm(half))
            center_x, center_y = float(lidar_from_box[0, 3]), float(lidar_from_box[1, 3])
            first, end = np.searchsorted(x, [np.float32(center_x - reach), np.float32(center_x + reach)])
            near = first + np.flatnonzero(np.abs(y[first:end] - np.float32(center_y)) < reach)
            inside = (np.abs(transform_points(invert(lidar_from_box), xyz[near])) < half).all(1)
            if inside.any():
                self._late_s[index, key] = float(dt_s[near[inside]].mean(dtype=np.float64))

    def at_sweep_times(self) -> list[Track]:
        """The tracks with boxes at their stamps, in the order given.

        Boxes without points inside take the delay of the track's neighbouring boxes.
        """
        tracks = list(self._tracks)
        for index in self._moving:
            track = tracks[index]
            known = [key for key in range(len(track.times_s)) if (index, key) in self._late_s]
            if not known:
                continue
            times = track.times_s
            late_s = np.interp(times, times[known], [self._late_s[index, key] for key in known])
            poses = track.world_from_object.copy()
            poses[:, :3, 3] -= _velocity(times, late_s, poses[:, :3, 3]) * late_s[:, None]
            tracks[index] = Track(track.id, track.label, track.size_m, times, poses)
        return tracks


def _velocity(times_s: NDArray[np.float64], late_s: NDArray[np.float64], places: Matrix) -> Matrix:
    """Velocity at each key, f64[T, 3] m/s: a place filed under t was taken at t + late.

    Steps that these delays nearly cancel (an object crosses the seam where the turn begins) tell no velocity and are left out.
    """
    steps_s = np.diff(times_s + late_s)
    telling = steps_s > 0.5 * np.diff(times_s)
    if not telling.any():
        return np.zeros_like(places)
    between = ((times_s[1:] + times_s[:-1]) / 2)[telling]
    speeds = np.diff(places, axis=0)[telling] / steps_s[telling, None]
    return np.stack([np.interp(times_s, between, speeds[:, axis]) for axis in range(3)], 1)


def _extent_m(track: Track) -> float:
    """Diagonal of the region that the box's centre visits; 0 for a single key."""
    places = track.world_from_object[:, :3, 3]
    return float(np.linalg.norm(places.max(0) - places.min(0)))


def reach_images(track: Track) -> Track:
    """The track with a key ``REACH_S`` before its first and one after its last box, made with the velocity of the nearest two.

    Without these, objects would be missing in images taken just before the first sweep that shows them.
    """
    times, poses = track.times_s, track.world_from_object
    before, after = poses[0].copy(), poses[-1].copy()
    if len(times) > 1:
        before[:3, 3] -= (poses[1, :3, 3] - poses[0, :3, 3]) / (times[1] - times[0]) * REACH_S
        after[:3, 3] += (poses[-1, :3, 3] - poses[-2, :3, 3]) / (times[-1] - times[-2]) * REACH_S
    times = np.concatenate([[times[0] - REACH_S], times, [times[-1] + REACH_S]])
    return Track(track.id, track.label, track.size_m, times, np.concatenate([before[None], poses, after[None]]))


def clip_track(track: Track, start_s: float, end_s: float) -> Track | None:
    """The keys of a track that matter from ``start_s`` to ``end_s``: those inside and one beyond each end; None if it is not there then."""
    if track.times_s[-1] < start_s - 1e-6 or track.times_s[0] > end_s + 1e-6:
        return None
    first = max(0, int(np.searchsorted(track.times_s, start_s + 1e-6)) - 1)
    last = min(len(track.times_s), int(np.searchsorted(track.times_s, end_s - 1e-6)) + 1)
    return Track(track.id, track.label, track.size_m, track.times_s[first:last], track.world_from_object[first:last])
