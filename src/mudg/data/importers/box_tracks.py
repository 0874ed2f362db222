"""Boxes of many frames -> tracks: one place for what every format with tracked boxes needs."""

from __future__ import annotations

from array import array
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Final

import numpy as np
from numpy.typing import NDArray

from mudg.base import log
from mudg.base.errors import InputError
from mudg.base.geometry import from_rotation_translation, matrix_from_quaternion, quaternion_from_matrix, slerp
from mudg.base.types import Track

Matrix = NDArray[np.float64]
MAX_GAP_S: Final = 0.55
"""A moving object that is not seen for longer than this is split: interpolating across would invent its path."""
MAX_SIDE_M: Final = 100.0
_LONGER_THAN_WIDE: Final = frozenset(("car", "van", "truck", "bus", "trailer", "vehicle", "caravan", "tram", "train"))
_ROW: Final = 17  # time, delay, size, pose
_MIN_STEP_S: Final = 0.05


@dataclass(slots=True)
class _Member:
    label: str
    rows: array = field(default_factory=lambda: array("d"))
    standing: bool = False


class BoxTracks:
    """Collects boxes in any order, 136 bytes each; ``tracks`` puts them together.

    Args:
        where: the file or folder the boxes come from, for messages.
        words: the data set's class -> the product's word (``car``, ``pedestrian``, ...). Other classes keep their name in
            lower case, and are named once in the notes.
    """

    def __init__(self, where: str, words: Mapping[str, str]) -> None:
        self._where, self._words = where, words
        self._members: dict[str, _Member] = {}
        self._unknown: dict[str, int] = {}

    def __len__(self) -> int:
        return len(self._members)

    def add(
        self,
        track: str,
        label: str,
        time_s: float,
        size_m: tuple[float, float, float],
        world_from_box: Matrix,
        standing: bool = False,
        late_s: float = 0.0,
    ) -> None:
        """Add one box.

        Args:
            track: the object's id, the same in all frames.
            label: the data set's class.
            time_s: when, seconds of the scene's clock.
            size_m: length, width, height.
            world_from_box: f64[4, 4], x forward, y left, z up, origin in the centre.
            standing: the data set says that the object does not move in the whole log.
            late_s: how long after ``time_s`` the box was measured (a turning LiDAR reaches it at its own time). The track's key
                stands at ``time_s``, moved there with the object's velocity.

        Raises:
            InputError: the size is not positive or absurd.
        """
        if not all(np.isfinite(size_m)) or min(size_m) <= 0 or max(size_m) > MAX_SIDE_M:
            raise InputError(
                "box size makes no sense",
                where=f"{self._where}: object {track} ({label})",
                expected=f"length, width and height in metres, above 0 and at most {MAX_SIDE_M:g}",
                got=", ".join(f"{side:g}" for side in size_m),
            )
        member = self._members.get(track)
        if member is None:
            member = self._members[track] = _Member(self._word(label))
        member.standing = standing
        member.rows.extend((time_s, late_s, *size_m, *world_from_box[:3].ravel().tolist()))

    def _word(self, label: str) -> str:
        if label not in self._words:
            self._unknown[label] = self._unknown.get(label, 0) + 1
        return self._words.get(label, label.strip().lower().replace(" ", "_") or "unknown")

    def tracks(self) -> tuple[list[Track], list[str]]:
        """All tracks, and notes for people.

        The size is the median over the track. What stands gets one pose (median place, mean heading) from its first to its last
        moment. What may move is split where it is not seen for more than ``MAX_GAP_S``: ``7``, ``7.1``, ...

        Raises:
            InputError: an object has two boxes at one moment.
        """
        tracks: list[Track] = []
        split = 0
        for name, member in self._members.items():
            rows = np.frombuffer(member.rows, np.float64).reshape(-1, _ROW)
            rows = rows[np.argsort(rows[:, 0], kind="stable")]
            times = rows[:, 0]
            if (np.diff(times) <= 0).any():
                at = float(times[int(np.flatnonzero(np.diff(times) <= 0)[0])])
                raise InputError(
                    "an object has two boxes at one moment",
                    where=f"{self._where}: object {name}",
                    got=f"time {at:.3f} s of the log",
                    remedy="are two logs mixed?",
                )
            size = np.median(rows[:, 2:5], axis=0)
            poses = np.tile(np.eye(4), (len(rows), 1, 1))
            poses[:, :3] = rows[:, 5:].reshape(-1, 3, 4)
            if member.standing:
                ends = times[[0, -1]] if len(times) > 1 else times
                tracks.append(Track(name, member.label, size, ends, np.stack([_mean_pose(poses)] * len(ends))))
                continue
            pieces = np.split(np.arange(len(rows)), np.flatnonzero(np.diff(times) > MAX_GAP_S) + 1)
            split += len(pieces) > 1
            for piece in pieces:
                poses[piece, :3, 3] -= _velocity(times[piece] + rows[piece, 1], poses[piece, :3, 3]) * rows[piece, 1:2]
            tracks += [
                Track(f"{name}.{part}" if part else name, member.label, size, times[piece], poses[piece])
                for part, piece in enumerate(pieces)
            ]
        return tracks, self._notes(split, tracks)

    def _notes(self, split: int, tracks: list[Track]) -> list[str]:
        notes = []
        long = [track for track in tracks if track.label in _LONGER_THAN_WIDE]
        wide = [track for track in long if track.size_m[1] > 1.3 * track.size_m[0]]
        if len(wide) * 2 > len(long):
            notes.append(
                f"{len(wide)} of {len(long)} vehicles are wider than long (first: {wide[0].id}): "
                "length and width may be swapped in the source"
            )
            log.warn(f"{self._where}: {notes[-1]}")
        if split:
            notes.append(f"{split} tracks are not seen for more than {MAX_GAP_S} s and were split there")
        if self._unknown:
            some = ", ".join(f"{label!r} ({count})" for label, count in sorted(self._unknown.items())[:8])
            notes.append(f"classes that are not known here keep their names: {some}")
        return notes


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


def _mean_pose(poses: Matrix) -> Matrix:
    """Median place and mean rotation (running slerp from the first on) of poses of one standing object."""
    mean = quaternion_from_matrix(poses[0])
    for count, pose in enumerate(poses[1:], start=2):
        mean = slerp(mean, quaternion_from_matrix(pose), 1 / count)
    return from_rotation_translation(matrix_from_quaternion(mean), np.median(poses[:, :3, 3], axis=0))
