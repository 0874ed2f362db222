"""The LiDAR points of a log, for truth at views that no camera recorded."""

from __future__ import annotations

import threading
from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from mudg.base import geometry, palette
from mudg.base.types import Frame, Scene, Sweep, Track, View
from mudg.core import points_seen
from mudg.core.fusion import STATIC, FusionRules, SweepShots, judge_track, largest_beam_gap, separate
from mudg.core.pictures import resize_nearest
from mudg.core.points_seen import OwnedPoints, PointTruth, ShownFrame
from mudg.data.scene import read_image, read_label, read_points
from mudg.stages.labelling.points import nearest_sweeps
from mudg.stages.score_truth import SAME_SWEEP_S

MERGED_SWEEPS: Final = 6
"""Sweeps of each LiDAR whose points tell what the shown cameras saw."""
KEPT_SWEEPS: Final = 96


class LogPoints:
    """The LiDAR points of a log; threads may ask. The sweeps asked for last are kept."""

    def __init__(self, scene: Scene) -> None:
        self.scene = scene
        self._rules = FusionRules()
        self.dynamic: tuple[Track, ...] = tuple(t for t in scene.tracks if judge_track(t, self._rules).moving)
        self._sensors: dict[str, list[Sweep]] = {}
        for sweep in scene.sweeps:
            self._sensors.setdefault(sweep.sensor, []).append(sweep)
        self._kept: dict[str, OwnedPoints] = {}
        self._lock = threading.Lock()

    def of_moment(self, time_s: float) -> OwnedPoints | None:
        """Points of the sweep of each LiDAR that was taken with an image, or None without one."""
        near = [nearest_sweeps(sweeps, time_s, 1) for sweeps in self._sensors.values()]
        return self._merged([s for found in near for s in found if abs(s.time_s - time_s) <= SAME_SWEEP_S])

    def around(self, time_s: float, count: int = MERGED_SWEEPS) -> OwnedPoints | None:
        """Points of the ``count`` sweeps of each LiDAR that are nearest in time, or None where none is near."""
        return self._merged([s for sweeps in self._sensors.values() for s in nearest_sweeps(sweeps, time_s, count)])

    def placed(self, points: OwnedPoints, time_s: float) -> NDArray[np.float32]:
        """Where points are at a moment, f32[N, 3] in the world; NaN where their object has no box then."""
        return points_seen.placed(points, self.dynamic, time_s)

    def colors(
        self, frame: Frame, points: OwnedPoints, world: NDArray[np.float32]
    ) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
        """Colours u8[N + 1, 3] that points have in a recorded image, and where it shows them (``points_seen.carried``)."""
        return points_seen.carried(frame.view, read_image(self.scene, frame), world, points.gap_deg)

    def truth_at(self, view: View, frame: Frame | None) -> PointTruth | None:
        """What the points of the sweeps taken with a view say about it; None without such sweeps.

        Args:
            frame: the recorded image of that time, which gives the points' colours and classes, or None.
        """
        points = self.of_moment(view.time_s)
        if points is None or not len(points.xyz):
            return None
        world = self.placed(points, view.time_s)
        depth, index = points_seen.visible(view, world, points.gap_deg)
        color, colored = np.zeros((len(world) + 1, 3), np.uint8), np.zeros(len(world) + 1, bool)
        ids = np.append(points.ids, np.uint8(palette.UNLABELLED))
        if frame is not None:
            color, colored = self.colors(frame, points, world)
            if "semantics" in frame.labels and (ids == palette.UNLABELLED).all():
                label = np.asarray(read_label(self.scene, frame, "semantics"), np.uint8)
                camera = frame.view.camera
                label = resize_nearest(label, camera.height, camera.width)
                values, known = points_seen.carried(frame.view, label, world, points.gap_deg)
                ids = np.where(known, values, np.uint8(palette.UNLABELLED))
        dynamic = np.append(points.owner != STATIC, False)[index]
        return PointTruth(depth, dynamic, color[index], colored[index], ids[index])

    def _merged(self, sweeps: Sequence[Sweep]) -> OwnedPoints | None:
        if not sweeps:
            return None
        parts = [self._read(sweep) for sweep in sweeps]
        joined = [np.concatenate([getattr(part, name) for part in parts]) for name in ("xyz", "owner", "ids")]
        return OwnedPoints(*joined, gap_deg=min(part.gap_deg for part in parts))

    def _read(self, sweep: Sweep) -> OwnedPoints:
        kept = self._kept.get(sweep.id)
        if kept is None:
            points = read_points(self.scene, sweep)
            owner, owned = separate(
                SweepShots(sweep.time_s, sweep.world_from_lidar, points, ()), self.dynamic, self._rules
            )
            xyz = geometry.transform_points(sweep.world_from_lidar, points.xyz).astype(np.float32)
            for number, local in owned.items():
                xyz[owner == number] = local
            ids = points.classes
            known = np.full(len(xyz), palette.UNLABELLED, np.uint8) if ids is None else ids
            kept = OwnedPoints(xyz, owner, known, largest_beam_gap(points.xyz))
            with self._lock:
                while len(self._kept) >= KEPT_SWEEPS:
                    del self._kept[next(iter(self._kept))]
                self._kept[sweep.id] = kept
        return kept


def shown_frame(scene: Scene, frame: Frame, rgb: NDArray[np.uint8]) -> ShownFrame | None:
    """A frame with its dense depth, or None if it has no label of that kind."""
    if "depth" not in frame.labels:
        return None
    depth = read_label(scene, frame, "depth")
    return ShownFrame(
        frame.view, np.where(np.isfinite(depth), depth, np.inf).astype(np.float32), points_seen.blurred(rgb)
    )
