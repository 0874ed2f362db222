"""Boxes of many frames -> tracks: labels, plausible sizes, keys in time order, splits where a box is not seen."""

from __future__ import annotations

from array import array
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from mudg.base.errors import InputError
from mudg.base.geometry import (
    from_rotation_translation,
    invert,
    matrix_from_quaternion,
    quaternion_from_matrix,
    slerp,
    transform_points,
)
from mudg.base.types import SweepPoints, Track, foreign_name
from mudg.scene import motion

# box times ----------------------------------------------------------------------------------------
#
# When a box was seen: annotated boxes of moving objects are brought to their sweep's time.
#
# A turning sensor meets an object some time before or after the sweep's time stamp. Sweeps that are compensated for the
# vehicle's motion still show a moving object where it was when the beams met it, and people draw its box around these
# points: the box belongs to the mean time of the points inside it, not to the stamp it is filed under. At 10 m/s and
# 0.08 s that is 0.8 m. Each such box is moved by the track's velocity to the stamp, where points, too, are brought by
# their ``dt_s``.
#
# Images are taken a little before or after the sweep they belong to; ``reach_images`` lets a track cover those at its
# ends.


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
            poses[:, :3, 3] -= _velocity_box_times(times, late_s, poses[:, :3, 3]) * late_s[:, None]
            tracks[index] = Track(track.id, track.label, track.size_m, times, poses)
        return tracks


def _velocity_box_times(times_s: NDArray[np.float64], late_s: NDArray[np.float64], places: Matrix) -> Matrix:
    """Velocity at each key, f64[T, 3] m/s: a place filed under t was taken at t + late.

    Steps that these delays nearly cancel (an object crosses the seam where the turn begins) tell no velocity and are
    left out.
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
    """The track with a key ``REACH_S`` before its first and one after its last box, made with the velocity of the
    nearest two.

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
    """The keys of a track that matter from ``start_s`` to ``end_s``: those inside and one beyond each end; None if it
    is not there then."""
    if track.times_s[-1] < start_s - 1e-6 or track.times_s[0] > end_s + 1e-6:
        return None
    first = max(0, int(np.searchsorted(track.times_s, start_s + 1e-6)) - 1)
    last = min(len(track.times_s), int(np.searchsorted(track.times_s, end_s - 1e-6)) + 1)
    return Track(track.id, track.label, track.size_m, track.times_s[first:last], track.world_from_object[first:last])


# box tracks ---------------------------------------------------------------------------------------


Matrix = NDArray[np.float64]
MAX_GAP_S: Final = 0.55
"""A moving object that is not seen for longer than this is split: interpolating across would invent its path."""
MAX_SIDE_M: Final = 100.0
LONGER_THAN_WIDE: Final = frozenset(("car", "van", "bus", "vehicle"))
"""Labels whose boxes are longer than wide in every data set (a truck's cab may be a box of its own)."""
_ROW: Final = 17  # time, delay, size, pose
_MIN_STEP_S: Final = 0.05
_SAME_TIME_S: Final = 1e-4
_NAMED: Final = 5
Speeds = Callable[[NDArray[np.float64], Matrix, Sequence[NDArray[np.intp]]], Matrix]
"""Times f64[n] at which an object was measured, its places f64[n, 3], the pieces of its track (indices) -> velocities
f64[n, 3] m/s."""


def box_size(length: Any, width: Any, height: Any, where: str) -> tuple[float, float, float]:
    """Length, width, height as finite positive metres, or an InputError."""
    try:
        size = (float(length), float(width), float(height))
    except (TypeError, ValueError) as error:
        raise InputError("box size is not made of numbers", where=where, got=str(error)) from error
    if not all(np.isfinite(side) and 0 < side <= MAX_SIDE_M for side in size):
        what = "box size makes no sense"
        expected = f"length, width and height in metres, above 0 and at most {MAX_SIDE_M:g}"
        raise InputError(what, where=where, expected=expected, got=f"length {length}, width {width}, height {height}")
    return size


@dataclass(slots=True)
class _Member:
    labels: dict[str, int] = field(default_factory=dict)
    rows: array = field(default_factory=lambda: array("d"))
    standing: bool = False


class BoxTracks:
    """Collects boxes in any order, 136 bytes each; ``tracks`` puts them together.

    Args:
        where: the file or folder the boxes come from, for messages.
        labels: the data set's class -> the label here (``car``, ``pedestrian``, ...). Other classes keep the last part
            (after a dot) of their name in lower case, and are named once in the notes.
        max_gap_s: an object that is not seen for longer than this is split.
    """

    def __init__(self, where: str, labels: Mapping[str, str], max_gap_s: float = MAX_GAP_S) -> None:
        self._where, self._labels, self._max_gap_s = where, labels, max_gap_s
        self._members: dict[str, _Member] = {}
        self._unknown: dict[str, int] = {}

    def __len__(self) -> int:
        return len(self._members)

    def label_of(self, category: str) -> str:
        """The label of a class of the data set; classes that are not known are counted. InputError for a name above 200
        bytes."""
        if category in self._labels:
            return self._labels[category]
        foreign_name(category, f"{self._where}: class of a box")
        self._unknown[category] = self._unknown.get(category, 0) + 1
        return category.rsplit(".", 1)[-1].strip().lower().replace(" ", "_") or "unknown"

    def add(
        self,
        track: str,
        label: str,
        time_s: float,
        size_m: tuple[float, float, float],
        world_from_box: Matrix,
        standing: bool = False,
        late_s: float = 0.0,
        where: str = "",
    ) -> None:
        """Add one box.

        Args:
            track: the object's id, the same in all frames.
            label: its label (``label_of``). The track takes its commonest one.
            time_s: when, seconds of the scene's clock.
            size_m: length, width, height.
            world_from_box: f64[4, 4], x forward, y left, z up, origin in the centre.
            standing: the data set says that the object does not move in the whole log. It must say so with every box of
                the object.
            late_s: how long after ``time_s`` the box was measured (a turning LiDAR reaches it at its own time). The
                track's key stands at ``time_s``, moved there with the object's velocity.
            where: file and record, for messages.

        Raises:
            InputError: the size is not positive or absurd, or the id is longer than 200 bytes.
        """
        foreign_name(track, f"{where or self._where}: id of an object")
        size = box_size(*size_m, where=where or f"{self._where}: object {track} ({label})")
        member = self._members.setdefault(track, _Member())
        member.labels[label] = member.labels.get(label, 0) + 1
        member.standing = standing and (member.standing or not member.rows)
        member.rows.extend((time_s, late_s, *size, *world_from_box[:3].ravel().tolist()))

    def tracks(
        self, speeds: Speeds | None = None, images_s: Mapping[float, tuple[float, float]] | None = None
    ) -> tuple[list[Track], list[str]]:
        """All tracks in the order of their first boxes, and notes for people.

        The size is the median over the track. What stands gets one pose (median place, mean heading) from its first to
        its last moment. What may move is split where it is not seen for more than ``max_gap_s``: ``7``, ``7.1``, ...

        Args:
            speeds: how velocities are found; None = from the neighbouring boxes of a piece.
            images_s: time of a box -> times of the first and last image that show the object; a track reaches from the
                first image of its first box to the last one of its last. None = from box to box.

        Raises:
            InputError: an object has two boxes at one moment; length and width are swapped.
        """
        tracks: list[Track] = []
        split = 0
        for name, member in self._members.items():
            rows = np.frombuffer(member.rows, np.float64).reshape(-1, _ROW)
            rows = rows[np.argsort(rows[:, 0], kind="stable")]
            times = rows[:, 0]
            if (np.diff(times) <= 0).any():
                at = float(times[int(np.flatnonzero(np.diff(times) <= 0)[0])])
                what, where = "an object has two boxes at one moment", f"{self._where}: object {name}"
                raise InputError(what, where=where, got=f"time {at:.3f} s of the log", remedy="are two logs mixed?")
            size = np.median(rows[:, 2:5], axis=0)
            label = max(member.labels, key=lambda name: member.labels[name])
            poses = np.tile(np.eye(4), (len(rows), 1, 1))
            poses[:, :3] = rows[:, 5:].reshape(-1, 3, 4)
            if member.standing:
                poses, _ = motion.unflipped(times, poses, motion.MOST_TURN_RAD_S)
                ends = _ends(times, images_s)
                tracks.append(Track(name, label, size, ends, np.stack([_mean_pose(poses)] * len(ends))))
                continue
            pieces = np.split(np.arange(len(rows)), np.flatnonzero(np.diff(times) > self._max_gap_s) + 1)
            split += len(pieces) > 1
            velocity = (speeds or neighbour_speeds)(times + rows[:, 1], poses[:, :3, 3], pieces)
            poses[:, :3, 3] -= velocity * rows[:, 1:2]
            for part, piece in enumerate(pieces):
                keys = times[piece], poses[piece]
                if images_s is not None:
                    ends_s = images_s[float(times[piece[0]])][0], images_s[float(times[piece[-1]])][1]
                    keys = _reaching(*keys, velocity[piece], ends_s)
                tracks.append(Track(f"{name}.{part}" if part else name, label, size, *keys))
        check_sides(tracks, self._where)
        tracks.sort(key=lambda track: float(track.times_s[0]))
        return tracks, self._notes(split)

    def _notes(self, split: int) -> list[str]:
        notes = []
        if split:
            notes.append(f"{split} tracks are not seen for more than {self._max_gap_s:g} s and were split there")
        if self._unknown:
            notes.append(unknown_classes(self._unknown))
        return notes


def turned_back(tracks: Sequence[Track]) -> tuple[list[Track], list[str]]:
    """The tracks with headings that flip by 180 degrees turned back, and a note about those that were; see
    ``motion.unflipped``."""
    mended, names = [], []
    for track in tracks:
        poses, turned = motion.unflipped(track.times_s, track.world_from_object, motion.most_turn_rad_s(track.label))
        mended.append(replace(track, world_from_object=poses) if len(turned) else track)
        if len(turned):
            names.append(f"{track.id} at {track.times_s[turned[0]]:.2f} s ({len(turned)} of {len(poses)} keys)")
    some = ", ".join(names[:_NAMED]) + (f", ... ({len(names)} in all)" if len(names) > _NAMED else "")
    return mended, [f"headings that flip by 180 degrees were turned back: {some}"] if names else []


def unknown_classes(counts: Mapping[str, int]) -> str:
    """A note about classes of boxes that the format does not document, by their number of boxes."""
    some = ", ".join(f"{label!r} ({count} boxes)" for label, count in sorted(counts.items())[:8])
    return f"classes that are not known here keep their names: {some}"


def check_sides(tracks: Sequence[Track], where: str) -> None:
    """Refuse a log in which most vehicles are wider than long: length and width were read in the wrong order."""
    vehicles = [track for track in tracks if track.label in LONGER_THAN_WIDE]
    wide = [track for track in vehicles if track.size_m[1] > track.size_m[0]]
    if vehicles and 2 * len(wide) > len(vehicles):
        length, width, _ = wide[0].size_m
        raise InputError(
            "length and width of boxes are swapped",
            where=where,
            expected="vehicles longer than wide",
            got=(
                f"{len(wide)} of {len(vehicles)} are wider than long, e.g. {wide[0].label} {wide[0].id}: "
                f"{length:.2f} m long, {width:.2f} m wide"
            ),
            remedy="check the order in which the sizes were written",
        )


def neighbour_speeds(measured_s: NDArray[np.float64], places: Matrix, pieces: Sequence[NDArray[np.intp]]) -> Matrix:
    """Velocities of an object's boxes, f64[n, 3], by their neighbours within each of the ``pieces`` of its track."""
    return np.concatenate([_velocity(measured_s[piece], places[piece]) for piece in pieces])


def _velocity(measured_s: NDArray[np.float64], places: Matrix) -> Matrix:
    """Velocity at each measurement, f64[n, 3]: from the neighbours on both sides, or from the one there is."""
    if len(places) < 2:
        return np.zeros_like(places)
    before, after = np.maximum(np.arange(len(places)) - 1, 0), np.minimum(np.arange(len(places)) + 1, len(places) - 1)
    span = measured_s[after] - measured_s[before]
    velocity = (places[after] - places[before]) / np.maximum(span, _MIN_STEP_S)[:, None]
    short = span < _MIN_STEP_S  # two measurements at nearly one moment, at an end: go by the neighbour
    velocity[short] = velocity[np.where(before == np.arange(len(places)), after, before)][short]
    return velocity


def _reaching(
    times_s: NDArray[np.float64], poses: Matrix, velocity: Matrix, ends_s: tuple[float, float]
) -> tuple[NDArray[np.float64], Matrix]:
    """Keys with one more at each of ``ends_s`` that lies outside of them."""
    start_s, end_s = ends_s[0] - times_s[0], ends_s[1] - times_s[-1]
    if start_s < -_SAME_TIME_S:
        times_s, poses = np.concatenate([ends_s[:1], times_s]), np.concatenate([poses[:1], poses])
        poses[0, :3, 3] += velocity[0] * start_s
    if end_s > _SAME_TIME_S:
        times_s, poses = np.concatenate([times_s, ends_s[1:]]), np.concatenate([poses, poses[-1:]])
        poses[-1, :3, 3] += velocity[-1] * end_s
    return times_s, poses


def _ends(times_s: NDArray[np.float64], images_s: Mapping[float, tuple[float, float]] | None) -> NDArray[np.float64]:
    """First and last moment of what stands; one if they are the same. ``images_s`` as in ``BoxTracks.tracks``."""
    first, last = float(times_s[0]), float(times_s[-1])
    if images_s is not None:
        start, end = images_s[first][0], images_s[last][1]
        first, last = (start if start < first - _SAME_TIME_S else first), (end if end > last + _SAME_TIME_S else last)
    return np.array([first, last] if last - first > _SAME_TIME_S else [first])


def _mean_pose(poses: Matrix) -> Matrix:
    """Median place and mean rotation (running slerp from the first on) of poses of one standing object."""
    mean = quaternion_from_matrix(poses[0])
    for count, pose in enumerate(poses[1:], start=2):
        mean = slerp(mean, quaternion_from_matrix(pose), 1 / count)
    return from_rotation_translation(matrix_from_quaternion(mean), np.median(poses[:, :3, 3], axis=0))
