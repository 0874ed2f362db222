"""LiDAR returns for an image: points of the sweeps around it, dynamic objects standing where they are at the image's time."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mudg.base import geometry
from mudg.base.types import Frame, Scene, Sweep
from mudg.core.fusion import STATIC, FusionRules, SweepShots, judge_track, largest_beam_gap, separate
from mudg.data.scene import read_points

MAX_GAP_S = 2.0
"""Sweeps farther in time than this from an image do not help: what moves without a track has gone elsewhere."""


@dataclass(frozen=True, slots=True, eq=False)
class Returns:
    """``xyz_world`` f32[N, 3] metres; largest angle between neighbouring beams, and elevation of the highest beam."""

    xyz_world: NDArray[np.float32]
    beam_gap_deg: float
    highest_rad: float


@dataclass(frozen=True, slots=True, eq=False)
class _Separated:
    """Static points of a sweep in the world, those of each dynamic object in its frame, and the sweep's beams."""

    static: NDArray[np.float32]
    owned: dict[int, NDArray[np.float32]]
    gap_deg: float
    highest_rad: float


class NearbyReturns:
    """Points of the ``sweeps`` sweeps of each LiDAR that are nearest in time to an image; sweeps are read once."""

    def __init__(self, scene: Scene, sweeps: int) -> None:
        self._scene, self._count = scene, sweeps
        self._rules = FusionRules()
        moving = [n for n, track in enumerate(scene.tracks) if judge_track(track, self._rules).moving]
        self.moving = frozenset(moving)
        """Numbers of the scene's tracks that move."""
        self._dynamic_tracks = [scene.tracks[n] for n in moving]
        self._sensors: dict[str, list[Sweep]] = {}
        for sweep in scene.sweeps:
            self._sensors.setdefault(sweep.sensor, []).append(sweep)
        self._kept: dict[str, _Separated] = {}

    def of(self, frame: Frame) -> Returns:
        """Static points and dynamic objects as they stand at the frame's time; no points where no sweep is near."""
        time_s = frame.view.time_s
        chosen = [s for sweeps in self._sensors.values() for s in nearest_sweeps(sweeps, time_s, self._count)]
        ids = {sweep.id for sweep in chosen}
        self._kept = {key: value for key, value in self._kept.items() if key in ids}
        parts = [np.zeros((0, 3), np.float32)]
        known = [self._separated(sweep) for sweep in chosen]
        for sweep in known:
            parts.append(sweep.static)
            parts += list(self._dynamic_points_at(time_s, sweep.owned))
        gap = min((sweep.gap_deg for sweep in known), default=0.6)
        return Returns(np.concatenate(parts), gap, max((sweep.highest_rad for sweep in known), default=0.0))

    def _dynamic_points_at(self, time_s: float, owned: dict[int, NDArray[np.float32]]) -> Iterator[NDArray[np.float32]]:
        for index, xyz_object in owned.items():
            pose = self._dynamic_tracks[index].pose_at(time_s)
            if pose is not None:
                yield geometry.transform_points(pose, xyz_object).astype(np.float32)

    def _separated(self, sweep: Sweep) -> _Separated:
        if sweep.id not in self._kept:
            points = read_points(self._scene, sweep)
            shots = SweepShots(sweep.time_s, sweep.world_from_lidar, points, ())
            owner, owned = separate(shots, self._dynamic_tracks, self._rules)
            world = geometry.transform_points(sweep.world_from_lidar, points.xyz).astype(np.float32)
            self._kept[sweep.id] = _Separated(
                world[owner == STATIC], owned, largest_beam_gap(points.xyz), _highest(sweep, world)
            )
        return self._kept[sweep.id]


def nearest_sweeps(sweeps: Sequence[Sweep], time_s: float, count: int) -> list[Sweep]:
    """The ``count`` sweeps nearest in time, none farther than ``MAX_GAP_S``, in the order of their times."""
    near = sorted((s for s in sweeps if abs(s.time_s - time_s) <= MAX_GAP_S), key=lambda s: abs(s.time_s - time_s))
    return sorted(near[:count], key=lambda s: s.time_s)


def _highest(sweep: Sweep, world: NDArray[np.float32]) -> float:
    """Elevation of the highest beam, radians: all but a few stray returns lie below it."""
    if len(world) < 100:
        return 0.0
    ray = world - sweep.world_from_lidar[:3, 3].astype(np.float32)
    elevation = np.arctan2(ray[:, 2], np.hypot(ray[:, 0], ray[:, 1]))
    return float(np.quantile(elevation, 0.998))
