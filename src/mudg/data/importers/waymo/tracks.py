"""Boxes per frame -> tracks in the world, and the question for which moment a box holds.

The points of a frame were measured over a tenth of a second, in which a car drives two metres. A box drawn around points holds where
its object was when the LiDAR passed it; a description of the data set speaks of the frame's start instead. So the log is asked: under
which of the ``Moment`` do most points near fast objects lie inside their boxes? Each box is then carried, with its object's own
speed, to the moment that all of the frame's points are given for.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from mudg.base.errors import InputError
from mudg.base.geometry import yaw_matrix
from mudg.base.types import Track
from mudg.data.importers.box_tracks import BoxTracks
from mudg.data.importers.waymo.records import Matrix, WaymoBox

Moment = Literal["seen", "start", "pose"]
"""A box holds when the LiDAR looked at its object, at the frame's timestamp, or at the moment of the frame's pose."""

MOMENTS: Final[tuple[Moment, ...]] = ("seen", "start", "pose")
FAST_M_S: Final = 3.0
_CLEAR_GAIN: Final = 1.05
_FLOOR_M: Final = 0.3

_SPEED_REACH: Final = 2
"""A speed is the slope of a straight line through so many boxes before and after."""


@dataclass(frozen=True, slots=True, eq=False)
class TimedBoxes:
    """The boxes of one frame.

    Args:
        time_s: moment the frame's points are given for.
        world_from_vehicle: f64[4, 4] at this moment.
        late_s: for each box, seconds after ``time_s`` for which it holds.
        where: file and record, for errors.
        images_s: times of the frame's first and last image, which need the objects where they were then.
    """

    time_s: float
    world_from_vehicle: Matrix
    boxes: Sequence[WaymoBox]
    late_s: NDArray[np.float64]
    where: str
    images_s: tuple[float, float] | None = None


def build_tracks(frames: Sequence[TimedBoxes]) -> tuple[list[Track], list[str]]:
    """Tracks, and notes about what was done to them.

    A track begins with the first image of its first frame and ends with the last image of its last one: some hundredths of a
    second are added to either end with the object's velocity, or else images at the ends would lack the object.

    Raises:
        InputError: a box without an id, two boxes of one id in a frame, a class that changes, or length and width are swapped.
    """
    tracks = BoxTracks(frames[0].where if frames else "", {})
    labels: dict[str, str] = {}
    for frame in frames:
        seen: set[str] = set()
        for box, late in zip(frame.boxes, frame.late_s, strict=True):
            if not box.id or box.id in seen:
                raise InputError("frame has two boxes of one object" if box.id else "box has no id", where=frame.where,
                    got=repr(box.id))  # fmt: skip
            seen.add(box.id)
            if labels.setdefault(box.id, box.label) != box.label:
                raise InputError("the class of an object changes", where=f"{frame.where}: object {box.id}",
                    expected=labels[box.id], got=box.label)  # fmt: skip
            # a track's name begins with no sign, as the data set's random ids may
            name = box.id if box.id[0].isalnum() else f"t{box.id}"
            pose = frame.world_from_vehicle @ yaw_matrix(box.heading, box.centre)
            tracks.add(name, box.label, frame.time_s, box.size_m, pose, late_s=float(late), where=frame.where)
    images_s = {frame.time_s: frame.images_s or (frame.time_s, frame.time_s) for frame in frames}
    found, notes = tracks.tracks(_line_speeds, images_s)
    unknown = sum(track.label == "unknown" for track in found)
    if unknown:
        notes.append(f"{unknown} boxes have a class that is not known and are called unknown")
    return found, notes


def _line_speeds(times_s: NDArray[np.float64], xyz: NDArray[np.float64], _pieces: object) -> NDArray[np.float64]:
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


def points_inside(
    box: WaymoBox,
    velocity_vehicle: NDArray[np.float64],
    xyz_vehicle: NDArray[np.float64],
    seen_s: NDArray[np.float64],
    late_s: float,
    middle_s: float,
) -> NDArray[np.int64]:
    """How many points lie inside a box if it holds at each of ``MOMENTS``, i64[3].

    Args:
        velocity_vehicle: of the object, f64[3] m/s along the vehicle's axes.
        xyz_vehicle, seen_s: points f64[N, 3] and when each was measured, seconds after the frame's timestamp f64[N].
        late_s: seconds after the frame's timestamp at which the LiDAR looked at the box.
        middle_s: moment of the frame's pose, seconds after the timestamp.
    """
    reach = max(box.size_m) / 2 + float(np.linalg.norm(velocity_vehicle)) * 0.2
    near = np.arange(len(xyz_vehicle))
    for axis in range(3):  # one axis after the other: most points cost one comparison
        near = near[np.abs(xyz_vehicle[near, axis] - box.centre[axis]) <= reach]
    offset = xyz_vehicle[near] - box.centre
    counts = np.zeros(len(MOMENTS), np.int64)
    turn = yaw_matrix(box.heading)[:3, :3]
    half = np.array(box.size_m) / 2
    for index, held_s in enumerate((late_s, 0.0, middle_s)):
        local = (offset - (seen_s[near, None] - held_s) * velocity_vehicle) @ turn
        counts[index] = ((np.abs(local) <= half) & (local[:, 2:] > _FLOOR_M - half[2])).all(1).sum()
    return counts


def choose_moment(counts: NDArray[np.int64]) -> Moment:
    """The moment under which most points lie inside their boxes, sums i64[3]; ``seen`` unless another is clearly better."""
    best = int(counts.argmax())
    return MOMENTS[best] if counts[best] > _CLEAR_GAIN * counts[0] else MOMENTS[0]


def velocities(frames: Sequence[TimedBoxes]) -> list[dict[str, NDArray[np.float64]]]:
    """Velocity of every box in the world by id, f64[3] m/s, for each frame: between the frames beside it; zero for single boxes."""
    centres = [{box.id: (frame.world_from_vehicle @ [*box.centre, 1.0])[:3] for box in frame.boxes} for frame in frames]
    found: list[dict[str, NDArray[np.float64]]] = []
    for index, here in enumerate(centres):
        before, after = max(0, index - 1), min(len(frames) - 1, index + 1)
        speeds = {}
        for box_id, centre in here.items():
            first = before if box_id in centres[before] else index
            last = after if box_id in centres[after] else index
            span = frames[last].time_s - frames[first].time_s
            way = centres[last].get(box_id, centre) - centres[first].get(box_id, centre)
            speeds[box_id] = way / span if span > 0 else np.zeros(3)
        found.append(speeds)
    return found
