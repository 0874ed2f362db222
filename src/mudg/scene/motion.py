"""What keys of poses tell about a motion: gaps between them (a cubic curve says how far off a straight line may be),
headings that flip, jumps and turns that no vehicle makes; and the recorded path as a road."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mudg.base import geometry
from mudg.base.errors import InputError
from mudg.base.types import EgoPath

Matrix = NDArray[np.float64]
Times = NDArray[np.float64]

VEHICLES: Final = frozenset(
    "car van truck bus vehicle trailer towed_object construction_vehicle tram train motorcycle bicycle".split()
)
"""Labels of what drives. These are longer than wide; barriers, signs and people need not be."""
GAP_STEPS: Final = 2.5
GAP_S: Final = 0.25
"""A gap is a step of time above both: so many usual ones, and so many seconds."""
GAP_M: Final = 3.0
"""Over a gap in which the vehicle moved less than this, a straight line is near enough."""
OFF_M: Final = 0.25
LONG_GAP_S: Final = 1.0
NEAR_KEY_S: Final = 0.15
"""In a gap above ``LONG_GAP_S`` nothing is known of what lies farther than this from both of its keys."""
FLIP_DEG: Final = 150.0
MOST_TURN_RAD_S: Final = 2.0
"""Vehicles turn slower than this."""
MOST_WALKER_TURN_RAD_S: Final = 8.0
MOST_JUMP_M_S2: Final = 30.0
_VELOCITY_OVER_S: Final = 0.1
_VELOCITY_WITHIN_S: Final = 1.0
MIN_TURN_DEG: Final = 30.0
"""Smaller turns between two keys may be noise."""
_STEP_M: Final = 0.05
_COURSE_M: Final = 1.0
_ALONG: Final = 0.8
_CLEAR_SHARE: Final = 1 / 3


# --- gaps -----------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Gap:
    """Keys that are missing after key ``key``: for how long, how far the vehicle moved meanwhile, and how far from a
    straight line, as the velocities on either side have it, it may have been."""

    key: int
    start_s: float
    end_s: float
    moved_m: float
    off_m: float

    def __str__(self) -> str:
        return (
            f"no pose for {self.end_s - self.start_s:.2f} s after {self.start_s:.3f} s (key {self.key}), while it moved"
            f" {self.moved_m:.1f} m; a straight line between may be {self.off_m:.2f} m off"
        )


def gaps(times_s: Times, poses: Matrix) -> list[Gap]:
    """The gaps between pose keys f64[T], f64[T, 4, 4] in which something moved by ``GAP_M`` or more."""
    steps = np.diff(times_s)
    if not (steps > GAP_S).any():
        return []
    usual = float(np.sort(steps)[len(steps) // 10])  # not the median: of few keys a gap would be usual
    long = np.flatnonzero(steps > max(GAP_S, GAP_STEPS * usual))
    moved = np.linalg.norm(poses[long + 1, :3, 3] - poses[long, :3, 3], axis=1)
    found = []
    for key, metres in zip(long.tolist(), moved.tolist(), strict=True):
        if metres >= GAP_M:
            off_m = max(_off_m(times_s, poses, key, u) for u in (0.25, 0.5, 0.75))
            found.append(Gap(key, float(times_s[key]), float(times_s[key + 1]), metres, off_m))
    return found


def gap_at(path: EgoPath, time_s: float) -> Gap | None:
    """The gap in which a pose at ``time_s`` would be a guess: in a curve, or far from any key of a long gap; None
    elsewhere."""
    after = int(np.searchsorted(path.times_s, time_s))
    if after in (0, len(path.times_s)) or path.times_s[after] - path.times_s[after - 1] <= GAP_S:
        return None
    gap = next((one for one in gaps(path.times_s, path.world_from_ego) if one.key == after - 1), None)
    if gap is None:
        return None
    share = (time_s - gap.start_s) / (gap.end_s - gap.start_s)
    lost = gap.end_s - gap.start_s > LONG_GAP_S and min(time_s - gap.start_s, gap.end_s - time_s) > NEAR_KEY_S
    return gap if lost or _off_m(path.times_s, path.world_from_ego, gap.key, share) > OFF_M else None


def _off_m(times_s: Times, poses: Matrix, key: int, share: float) -> float:
    """Metres between a cubic curve and a straight line at a part (0..1) of the way from a key to the next."""
    span = float(times_s[key + 1] - times_s[key])
    chord = (poses[key + 1, :3, 3] - poses[key, :3, 3]) / span
    before, after = _velocity(times_s, poses, key, -1), _velocity(times_s, poses, key + 1, 1)
    lead = np.zeros(3) if before is None else before - chord
    trail = np.zeros(3) if after is None else after - chord
    return float(np.linalg.norm(span * (share * (1 - share) ** 2 * lead - share**2 * (1 - share) * trail)))


def _velocity(times_s: Times, poses: Matrix, key: int, way: int) -> Matrix | None:
    """Velocity f64[3] at a key by the keys before (-1) or after (1) it, over a tenth of a second where they are that
    close."""
    other = key + way
    while 0 <= other + way < len(times_s) and abs(times_s[other] - times_s[key]) < _VELOCITY_OVER_S - 1e-9:
        other += way
    if not 0 <= other < len(times_s) or abs(times_s[other] - times_s[key]) > _VELOCITY_WITHIN_S:
        return None
    return (poses[other, :3, 3] - poses[key, :3, 3]) / (times_s[other] - times_s[key])


# --- headings -------------------------------------------------------------------------------------


def turns(times_s: Times, poses: Matrix) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Angle between the x axes of neighbouring keys in radians, and per second: f64[T - 1] each."""
    forward = poses[:, :3, 0]
    angle = np.arccos(np.clip(np.einsum("ni,ni->n", forward[:-1], forward[1:]), -1, 1))
    return angle, angle / np.diff(times_s)


def most_turn_rad_s(label: str) -> float:
    """The fastest turn of something with this label."""
    return MOST_TURN_RAD_S if label in VEHICLES else MOST_WALKER_TURN_RAD_S


def heading_flips(times_s: Times, poses: Matrix, most_rad_s: float) -> NDArray[np.intp]:
    """Keys after which the heading is turned by about 180 degrees at once, faster than ``most_rad_s``; what lies down
    does not count."""
    angle, rate = turns(times_s, poses)
    upright = np.einsum("ni,ni->n", poses[:-1, :3, 2], poses[1:, :3, 2]) > 0.5
    return np.flatnonzero((angle > np.deg2rad(FLIP_DEG)) & (rate > most_rad_s) & upright)


def unflipped(times_s: Times, poses: Matrix, most_rad_s: float) -> tuple[Matrix, NDArray[np.intp]]:
    """Poses with flipped headings turned back, and the keys that were. Headings agree but for their sign. The sign of
    the rarer third or less is wrong; where it is more, the direction of travel decides; where nothing moves either,
    nothing is changed."""
    flips = heading_flips(times_s, poses, most_rad_s)
    if not len(flips):
        return poses, flips
    side = np.ones(len(poses))
    for key in flips:
        side[key + 1 :] *= -1
    rarer = min(int((side > 0).sum()), int((side < 0).sum())) / len(side)
    if rarer <= _CLEAR_SHARE:
        right = np.sign(side.sum())
    else:
        steps = np.diff(poses[:, :3, 3], axis=0)
        length = np.linalg.norm(steps, axis=1)
        moving = length > _STEP_M
        along = float((np.einsum("ni,ni->n", poses[:-1, :3, 0], steps) * side[:-1])[moving].sum())
        if length[moving].sum() < _COURSE_M or abs(along) < _ALONG * length[moving].sum():
            return poses, np.zeros(0, np.intp)
        right = np.sign(along)
    turned = np.flatnonzero(side != right)
    poses = poses.copy()
    poses[turned, :3, :2] *= -1
    return poses, turned


# --- jumps ----------------------------------------------------------------------------------------


def jumps(times_s: Times, poses: Matrix, least_m: float) -> list[tuple[int, float, float]]:
    """Steps between keys that the motion before and after does not explain: key after which it is, metres, and metres
    per second squared, the largest first; those of ``least_m`` and ``MOST_JUMP_M_S2`` on. A step is compared with the
    median velocity of up to two steps on either side: what is left over is the jump."""
    steps_s = np.diff(times_s)
    if len(steps_s) < 3:
        return []
    velocity = np.diff(poses[:, :3, 3], axis=0) / steps_s[:, None]
    found = []
    for key in range(len(steps_s)):
        near = [n for n in range(max(0, key - 2), min(len(steps_s), key + 3)) if n != key]
        off = float(np.linalg.norm(velocity[key] - np.median(velocity[near], axis=0))) * float(steps_s[key])
        if off >= least_m and off / steps_s[key] ** 2 >= MOST_JUMP_M_S2:
            found.append((key, off, off / float(steps_s[key]) ** 2))
    return sorted(found, key=lambda jump: -jump[1])


# the recorded path as a road -----------------------------------------------------------------------

LEAST_STEP_M: Final = 0.2
"""Recorded poses nearer to the last one than this add nothing to a road."""


class Road:
    """The path that was recorded (``poses``: world-from-vehicle f64[N, 4, 4]), by arc length; height and tilt of the
    ground beside it are those of the path. Beyond its ends the road goes straight on. InputError: the poses do not move
    by a metre."""

    def __init__(self, poses: Matrix) -> None:
        chosen = [0]
        for index in range(1, len(poses)):
            if np.linalg.norm(poses[index, :2, 3] - poses[chosen[-1], :2, 3]) >= LEAST_STEP_M:
                chosen.append(index)
        self.poses = poses[chosen]
        steps = np.linalg.norm(np.diff(self.poses[:, :2, 3], axis=0), axis=1)
        self.stations_m = np.concatenate([[0.0], np.cumsum(steps)])
        if self.length_m < 1:
            what = "the recorded vehicle stands, so there is no road to drive on"
            raise InputError(what, expected="at least 1 m of way", got=f"{self.length_m:.2f} m")

    @property
    def length_m(self) -> float:
        """Length of the recorded path."""
        return float(self.stations_m[-1])

    def recorded(self, station_m: float) -> Matrix:
        """Pose f64[4, 4] of the recorded vehicle at an arc length, straight on beyond the ends."""
        inside = min(max(station_m, 0.0), self.length_m)
        index = min(int(np.searchsorted(self.stations_m, inside, "right")) - 1, len(self.stations_m) - 2)
        share = (inside - self.stations_m[index]) / (self.stations_m[index + 1] - self.stations_m[index])
        pose = geometry.interpolate_pose(self.poses[index], self.poses[index + 1], float(share))
        pose[:3, 3] += (station_m - inside) * pose[:3, 0]
        return pose

    def locate(self, xy: ArrayLike) -> tuple[float, float]:
        """Arc length, and metres to the left of the path, of a place."""
        point, path = np.asarray(xy, np.float64)[:2], self.poses[:, :2, 3]
        along = np.diff(path, axis=0)
        lengths = np.linalg.norm(along, axis=1)
        unit = along / lengths[:, None]
        reach = ((point - path[:-1]) * unit).sum(1)
        low, high = np.zeros(len(reach)), lengths.copy()
        low[0], high[-1] = -np.inf, np.inf
        at = np.clip(reach, low, high)
        foot = path[:-1] + at[:, None] * unit
        nearest = int(np.linalg.norm(point - foot, axis=1).argmin())
        off = point - foot[nearest]
        side = unit[nearest, 0] * off[1] - unit[nearest, 1] * off[0]
        return float(self.stations_m[nearest] + at[nearest]), float(math.copysign(np.linalg.norm(off), side))

    def place(self, x_m: float, y_m: float, heading_rad: float) -> Matrix:
        """World-from-vehicle f64[4, 4] of a vehicle on the ground with its origin there."""
        station, _ = self.locate((x_m, y_m))
        recorded = self.recorded(station)
        up = recorded[:3, 2]
        z = recorded[2, 3] - (up[0] * (x_m - recorded[0, 3]) + up[1] * (y_m - recorded[1, 3])) / up[2]
        ahead = np.array([math.cos(heading_rad), math.sin(heading_rad), 0.0])
        ahead[2] = -(up[0] * ahead[0] + up[1] * ahead[1]) / up[2]
        ahead /= np.linalg.norm(ahead)
        axes = np.stack([ahead, np.cross(up, ahead), up], 1)
        return geometry.from_rotation_translation(axes, (x_m, y_m, z))

    def route(self, pose: Matrix, step_m: float = 2.0) -> Matrix:
        """The next 60 m of road ahead of a vehicle f64[N, 3] in its frame."""
        station, _ = self.locate(pose[:2, 3])
        places = np.stack([self.recorded(ahead)[:3, 3] for ahead in station + np.arange(0.0, 60.0, step_m)])
        return geometry.transform_points(geometry.invert(pose), places)
