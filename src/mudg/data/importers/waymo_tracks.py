"""Boxes per frame -> tracks in the world.

Annotators draw boxes around the points they see, and the points of a frame were measured over a tenth of a second: a box holds
where its object was when the LiDAR passed it. Each box is therefore carried, with its object's own speed, to the moment that all
of the frame's points are given for.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from mudg.base.errors import InputError
from mudg.base.geometry import yaw_matrix
from mudg.base.types import Track
from mudg.data.importers.waymo_log import Matrix, WaymoBox

MAX_GAP_S: Final = 0.55
"""A track that is not seen for longer than this is split: interpolating across would invent its path."""

_SPEED_REACH: Final = 2
"""A speed is the slope of a straight line through so many boxes before and after."""


@dataclass(frozen=True, slots=True, eq=False)
class TimedBoxes:
    """The boxes of one frame.

    Args:
        time_s: moment the frame's points are given for.
        world_from_vehicle: f64[4, 4] at this moment.
        late_s: for each box, seconds after ``time_s`` at which the LiDAR looked at it.
        where: file and record, for errors.
    """

    time_s: float
    world_from_vehicle: Matrix
    boxes: Sequence[WaymoBox]
    late_s: NDArray[np.float64]
    where: str


def build_tracks(frames: Sequence[TimedBoxes]) -> tuple[list[Track], list[str]]:
    """Tracks, and notes about what was done to them.

    Raises:
        InputError: a box without an id, two boxes of one id in a frame, or a class that changes.
    """
    members: dict[str, list[tuple[float, float, Matrix, WaymoBox]]] = {}
    for frame in frames:
        seen: set[str] = set()
        for box, late in zip(frame.boxes, frame.late_s, strict=True):
            if not box.id or box.id in seen:
                raise InputError(
                    "frame has two boxes of one object" if box.id else "box has no id",
                    where=frame.where,
                    got=repr(box.id),
                )
            seen.add(box.id)
            pose = frame.world_from_vehicle @ yaw_matrix(box.heading, box.centre)
            members.setdefault(box.id, []).append((frame.time_s, float(late), pose, box))
    names = _names(members)
    tracks: list[Track] = []
    split = 0
    for box_id, found in members.items():
        labels = sorted({box.label for *_, box in found})
        if len(labels) > 1:
            raise InputError(
                "the class of an object changes", where=f"{frames[0].where}: object {box_id}", got=", ".join(labels)
            )
        times, late = np.array([item[0] for item in found]), np.array([item[1] for item in found])
        poses = np.stack([item[2] for item in found])
        poses[:, :3, 3] -= _velocity(times + late, poses[:, :3, 3]) * late[:, None]
        size = np.median([box.size_m for *_, box in found], axis=0)
        pieces = np.split(np.arange(len(times)), np.flatnonzero(np.diff(times) > MAX_GAP_S) + 1)
        split += len(pieces) > 1
        for part, piece in enumerate(pieces):
            name = f"{names[box_id]}.{part}" if part else names[box_id]
            tracks.append(Track(name, labels[0], size, times[piece], poses[piece]))
    notes = [f"{split} tracks are not seen for more than {MAX_GAP_S} s and were split"] if split else []
    unknown = sum(track.label == "unknown" for track in tracks)
    if unknown:
        notes.append(f"{unknown} boxes have a class that is not known and are called unknown")
    return tracks, notes


def _velocity(times_s: NDArray[np.float64], xyz: NDArray[np.float64]) -> NDArray[np.float64]:
    """Velocity f64[T, 3] by a straight line through the neighbouring keys; zero where there is one key only.

    Times of neighbouring keys may be equal: an object that passes behind the LiDAR is seen at the end of one turn and
    at once again at the beginning of the next.
    """
    velocity = np.zeros_like(xyz)
    for index in range(len(times_s)):
        near = slice(max(0, index - _SPEED_REACH), index + _SPEED_REACH + 1)
        time = times_s[near] - times_s[near].mean()
        spread = float(time @ time)
        if spread > 1e-4:
            velocity[index] = time @ (xyz[near] - xyz[near].mean(0)) / spread
    return velocity


def _names(members: Mapping[str, object]) -> dict[str, str]:
    """Ids as names of tracks; those that begin with a sign, as the data set's random ones may, get a letter in front."""
    return {box_id: box_id if box_id[0].isalnum() else f"t{box_id}" for box_id in members}
