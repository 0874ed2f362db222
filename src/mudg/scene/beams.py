"""Beams of recorded sweeps: where each was fired and what it measured, which of them returned nothing, and the returns
of many sweeps as one cloud per rigid part of the world."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from mudg.base import geometry
from mudg.base.types import EgoPath, Scene, Sweep, SweepPoints, Track
from mudg.core.fusion import STATIC, FusionRules, SweepShots, judge_track, separate
from mudg.core.returns import Returns, Rows
from mudg.scene.read import read_points, sweeps_beside

Floats = NDArray[np.float64]
WORLD: Final = ""
"""Name of what stands still, beside the ids of tracks."""
MOMENTS: Final = 64
"""Parts of a sweep whose beams share a pose."""
SAME_MOMENT_S: Final = 0.06
"""A sweep belongs to the frames that were taken this near in time."""


@dataclass(frozen=True, slots=True, eq=False)
class Beams:
    """Beams of a sweep. ``directions``: unit vectors f64[B, 3] in the sensor's frame when each is fired. ``share``:
    f64[B] in [0, 1], when. ``range_m``: f64[B], NaN: nothing returned. ``intensity``: f64[B], NaN likewise. ``start``,
    ``end``: world-from-sensor f64[4, 4]. ``start_s``, ``end_s``: on the scene's clock."""

    directions: Floats
    share: Floats
    range_m: Floats
    intensity: Floats
    start: Floats
    end: Floats
    start_s: float
    end_s: float

    def __len__(self) -> int:
        return len(self.share)

    @property
    def returned(self) -> NDArray[np.bool_]:
        """Which returned, bool[B]."""
        return np.isfinite(self.range_m)

    def parts(self, count: int) -> list[tuple[float, NDArray[np.int64]]]:
        """Consecutive parts: middle share, and numbers of the beams; those without any are left out."""
        if self.start_s == self.end_s:
            return [(0.0, np.arange(len(self)))]
        part = np.minimum((self.share * count).astype(np.int64), count - 1)
        rows = ((k, np.flatnonzero(part == k)) for k in range(count))
        return [((k + 0.5) / count, own) for k, own in rows if len(own)]

    def pose(self, share: float) -> Floats:
        """World-from-sensor at a share of the sweep."""
        return geometry.interpolate_pose(self.start, self.end, share)

    def time_s(self, share: float) -> float:
        """Time at a share of the sweep."""
        return self.start_s + share * (self.end_s - self.start_s)


def sensor_pose(ego: EgoPath, sweep: Sweep, time_s: float) -> Floats:
    """World-from-sensor at a time about the sweep's; outside the path it stays at the path's end."""
    first, last = float(ego.times_s[0]), float(ego.times_s[-1])
    poses = [ego.pose_at(min(max(at, first), last)) for at in (sweep.time_s, time_s)]
    if poses[0] is None or poses[1] is None:
        return sweep.world_from_lidar
    return poses[1] @ geometry.invert(poses[0]) @ sweep.world_from_lidar


def beams_of(scene: Scene, sweep: Sweep) -> Beams:
    """The beams of a sweep that returned, in the order of its points."""
    points = read_points(scene, sweep)
    dt_s, xyz = points.dt_s.astype(np.float64), points.xyz.astype(np.float64)
    first, last = (float(dt_s.min()), float(dt_s.max())) if len(dt_s) else (0.0, 0.0)
    turns = last - first > 1e-6
    share = (dt_s - first) / (last - first) if turns else np.zeros(len(dt_s))
    start, end = (sensor_pose(scene.ego, sweep, sweep.time_s + at) for at in (first, last))
    times = (sweep.time_s + first, sweep.time_s + (last if turns else first))
    empty = np.zeros(len(xyz))
    found = Beams(xyz, share, empty, points.intensity.astype(np.float64), start, end, *times)
    own = xyz.copy()
    for at, rows in found.parts(MOMENTS):
        own[rows] = geometry.transform_points(geometry.invert(found.pose(at)) @ sweep.world_from_lidar, xyz[rows])
    away = np.linalg.norm(own, axis=1)
    directions = own / np.maximum(away, 1e-9)[:, None]
    return Beams(directions, share, away, found.intensity, start, end, *times)


def with_silent(beams: Beams, like: Rows | None = None) -> Beams:
    """The same and, behind them, the beams that returned nothing: gaps in the sensor's rows. Where there are no rows,
    nothing is added. ``like``: rows of another sweep of the sensor."""
    xyz = beams.directions * beams.range_m[:, None]
    rows = Rows.of(xyz, like)
    if len(rows.elevations_deg) < 2 or len(beams) < 100:
        return beams
    azimuth, elevation, away = rows.angles(xyz)
    row = rows.number(elevation)
    order = np.lexsort((azimuth, row))
    gap, same = np.diff(azimuth[order]), np.diff(row[order]) == 0
    usual = same & (gap > np.radians(0.01))
    if not usual.any():
        return beams
    step = float(np.median(gap[usual]))
    rate = float(np.median(np.diff(beams.share[order])[usual] / gap[usual]))
    # a post at either end of every row: the row's other end, a turn away, or a step outside the field
    ends = np.flatnonzero(~np.r_[False, same]), np.flatnonzero(~np.r_[same, False])
    first, last = (order[own] for own in ends)
    whole = np.ptp(azimuth) > np.radians(355)
    if whole:
        post = azimuth[first] + 2 * np.pi
        left, right, begin, end = last, first, azimuth[last], post
    else:
        low, high = np.full(len(first), azimuth.min() - step), np.full(len(last), azimuth.max() + step)
        left, right = np.r_[first, last], np.r_[first, last]
        begin, end = np.r_[low, azimuth[last]], np.r_[azimuth[first], high]
    left, right = np.r_[order[:-1][same], left], np.r_[order[1:][same], right]
    begin, gap = np.r_[azimuth[order[:-1][same]], begin], np.r_[gap[same], end - begin]
    count = (np.rint(gap / step) - 1).clip(0).astype(np.int64)
    at = np.repeat(np.arange(len(gap)), count)
    part = (np.arange(len(at)) - np.repeat(np.cumsum(count) - count, count) + 1) / (count[at] + 1)
    nearness = (1 - part) / away[left[at]] + part / away[right[at]]
    turned = begin[at] + part * gap[at]
    share = beams.share[left[at]] + rate * (turned - azimuth[left[at]])
    points = rows.points(turned, rows.elevations_deg[row[left[at]]], 1 / nearness)
    nan, away = np.full(len(at), np.nan), np.linalg.norm(points, axis=1, keepdims=True)
    more = {"directions": points / away, "share": share % 1.0 if whole and rate else share.clip(0, 1)}
    more |= {"range_m": nan, "intensity": nan}
    return replace(beams, **{name: np.concatenate([getattr(beams, name), one]) for name, one in more.items()})


# which sweeps -------------------------------------------------------------------------------------


def held_out(scene: Scene) -> frozenset[str]:
    """Ids of the sweeps of held-out frames: of every sensor the one nearest in time to each of them."""
    frames = scene.frames_in("test")
    return frozenset(sweep.id for frame in frames for sweep in sweeps_beside(scene, frame, SAME_MOMENT_S))


def training_sweeps(scene: Scene) -> tuple[Sweep, ...]:
    """The sweeps that may be learnt from."""
    gone = held_out(scene)
    return tuple(sweep for sweep in scene.sweeps if sweep.id not in gone)


# returns of many sweeps ---------------------------------------------------------------------------


def moving_tracks(scene: Scene) -> tuple[Track, ...]:
    """Tracks of objects that move."""
    return tuple(track for track in scene.tracks if judge_track(track, FusionRules()).moving)


def returns_of(scene: Scene, sweep: Sweep, silent: Beams | None = None) -> dict[str, Returns]:
    """Returns of a sweep by what they belong to: ``WORLD`` in the world, moving tracks each in the frame of its box.
    ``silent``: the sweep's beams (``with_silent``). Those without a return stand, without intensity, as far away as the
    return nearest in angle."""
    points, tracks, place = read_points(scene, sweep), moving_tracks(scene), sweep.world_from_lidar[:3, 3]
    xyz, dt_s, intensity = points.xyz, points.dt_s, points.intensity
    if silent is not None and not silent.returned.all():
        ends, times = _silent_ends(sweep, silent)
        xyz, dt_s = np.concatenate([xyz, ends]), np.concatenate([dt_s, times])
        intensity = np.concatenate([intensity, np.full(len(ends), np.nan, np.float32)])
    shots = SweepShots(sweep.time_s, sweep.world_from_lidar, SweepPoints(xyz, intensity, dt_s), ())
    owner, owned = separate(shots, tracks, FusionRules())
    still = owner == STATIC
    world = geometry.transform_points(sweep.world_from_lidar, xyz[still].astype(np.float64))
    parts = {WORLD: Returns(world, place, intensity[still])}
    for number, own in owned.items():
        pose = tracks[number].pose_at(sweep.time_s)
        if pose is not None:
            seen_from = geometry.transform_points(geometry.invert(pose), place[None])[0]
            parts[tracks[number].id] = Returns(own.astype(np.float64), seen_from, intensity[owner == number])
    return parts


def _silent_ends(sweep: Sweep, beams: Beams) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Where beams without a return may have ended, f32[n, 3] in the sweep's frame, and when, f32[n]."""
    heard = beams.returned
    rows = KDTree(beams.directions[heard]).query(beams.directions[~heard])[1]
    away = beams.range_m.copy()
    away[~heard] = beams.range_m[heard][rows]
    ends = beams.directions * away[:, None]
    for share, own in beams.parts(MOMENTS):
        ends[own] = geometry.transform_points(geometry.invert(sweep.world_from_lidar) @ beams.pose(share), ends[own])
    times = beams.start_s + beams.share * (beams.end_s - beams.start_s) - sweep.time_s
    return ends[~heard].astype(np.float32), times[~heard].astype(np.float32)


def placed(
    parts: Sequence[tuple[str, Returns]], poses: Mapping[str, Floats], origin: Floats
) -> tuple[Floats, NDArray[np.int64]]:
    """Returns where their objects are, without those that were seen from behind: places f64[N, 3] relative to the
    origin f64[3] in the world's axes, and numbers i64[N] among all returns of ``parts``. ``parts``: with the name of
    what they belong to. ``poses``: world-from-box of the objects; parts of others are left out."""
    xyz, numbers, first = [np.zeros((0, 3))], [np.zeros(0, np.int64)], 0
    for name, part in parts:
        if name == WORLD or name in poses:
            points, seen_from = part.xyz, part.seen_from
            if name != WORLD:
                points = geometry.transform_points(poses[name], points)
                seen_from = geometry.transform_points(poses[name], seen_from[None])[0]
            away = points - origin
            square = np.einsum("ij,ij->i", away, away)
            shown = (square > 0.25) & (square > away @ (seen_from - origin))  # towards the sensor of both
            xyz.append(away[shown])
            numbers.append(first + np.flatnonzero(shown))
        first += len(part)
    return np.concatenate(xyz), np.concatenate(numbers)
