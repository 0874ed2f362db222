"""LiDAR points as the truth of ``mudg bench real``: where they are at a moment, which a view shows, and which other cameras saw them.

Points in the boxes of dynamic objects travel with their box; all others stand still.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from mudg.base import geometry, palette
from mudg.base.types import Frame, Scene, Sweep, Track, View
from mudg.core.fusion import STATIC, FusionRules, SweepShots, judge_track, largest_beam_gap, separate
from mudg.core.visible import RULES, hidden_pixels
from mudg.core.zbuffer import DrawLimits, PointLayer, draw_points
from mudg.data.scene import read_label, read_points
from mudg.stages.labelling.points import nearest_sweeps
from mudg.stages.score_truth import SAME_SWEEP_S

NEAR_M: Final = 0.5
DEPTH_LIMIT_M: Final = 80.0
MERGED_SWEEPS: Final = 6
"""Sweeps of each LiDAR whose points tell what the shown cameras saw."""
SPREAD_SHARE: Final = 0.03
"""A pixel takes the answer of the nearest point within this share of the image's width."""


@dataclass(frozen=True, slots=True, eq=False)
class OwnedPoints:
    """Points with what they belong to.

    Args:
        xyz: f32[N, 3] metres, static ones in the world, others in the frame of their object.
        owner: i32[N], number of the object among the dynamic tracks, or STATIC.
        ids: u8[N] train ids, 255 = unknown.
        gap_deg: largest angle between neighbouring beams.
    """

    xyz: NDArray[np.float32]
    owner: NDArray[np.int32]
    ids: NDArray[np.uint8]
    gap_deg: float

    def taken(self, chosen: NDArray[np.integer]) -> OwnedPoints:
        """Some of the points, by their numbers."""
        return OwnedPoints(self.xyz[chosen], self.owner[chosen], self.ids[chosen], self.gap_deg)


class LogPoints:
    """The LiDAR points of a log; sweeps are read once."""

    def __init__(self, scene: Scene) -> None:
        self.scene = scene
        self._rules = FusionRules()
        self.dynamic: tuple[Track, ...] = tuple(t for t in scene.tracks if judge_track(t, self._rules).moving)
        self._sensors: dict[str, list[Sweep]] = {}
        for sweep in scene.sweeps:
            self._sensors.setdefault(sweep.sensor, []).append(sweep)
        self._kept: dict[str, OwnedPoints] = {}

    def of_moment(self, time_s: float) -> OwnedPoints | None:
        """Points of the sweep of each LiDAR that was taken with an image, or None without one."""
        near = [nearest_sweeps(sweeps, time_s, 1) for sweeps in self._sensors.values()]
        return self._merged([s for found in near for s in found if abs(s.time_s - time_s) <= SAME_SWEEP_S])

    def around(self, time_s: float, count: int = MERGED_SWEEPS) -> OwnedPoints | None:
        """Points of the ``count`` sweeps of each LiDAR that are nearest in time, or None where none is near."""
        return self._merged([s for sweeps in self._sensors.values() for s in nearest_sweeps(sweeps, time_s, count)])

    def placed(self, points: OwnedPoints, time_s: float) -> NDArray[np.float32]:
        """Where points are at a moment, f32[N, 3] in the world; NaN where their object has no box then."""
        world = points.xyz.copy()
        for number in np.unique(points.owner[points.owner != STATIC]):
            rows = points.owner == number
            pose = self.dynamic[number].pose_at(time_s)
            world[rows] = np.nan if pose is None else geometry.transform_points(pose, points.xyz[rows])
        return world

    def _merged(self, sweeps: Sequence[Sweep]) -> OwnedPoints | None:
        if not sweeps:
            return None
        parts = [self._read(sweep) for sweep in sweeps]
        joined = [np.concatenate([getattr(part, name) for part in parts]) for name in ("xyz", "owner", "ids")]
        return OwnedPoints(*joined, gap_deg=min(part.gap_deg for part in parts))

    def _read(self, sweep: Sweep) -> OwnedPoints:
        if sweep.id not in self._kept:
            points = read_points(self.scene, sweep)
            owner, owned = separate(
                SweepShots(sweep.time_s, sweep.world_from_lidar, points, ()), self.dynamic, self._rules
            )
            xyz = geometry.transform_points(sweep.world_from_lidar, points.xyz).astype(np.float32)
            for number, local in owned.items():
                xyz[owner == number] = local
            ids = points.classes
            known = np.full(len(xyz), palette.UNLABELLED, np.uint8) if ids is None else ids
            self._kept[sweep.id] = OwnedPoints(xyz, owner, known, largest_beam_gap(points.xyz))
        return self._kept[sweep.id]


def visible(view: View, world: NDArray[np.float32], gap_deg: float) -> tuple[NDArray[np.float32], NDArray[np.int32]]:
    """Depth f32[H, W] (0 = none) and number i32[H, W] (-1 = none) of the point that each pixel shows, hidden ones left out (the rule
    ``sweep`` of ``core/visible.py``)."""
    depth, index = draw_points([PointLayer(world, np.eye(4))], view, DrawLimits(NEAR_M, DEPTH_LIMIT_M))
    rule = RULES["sweep"]
    found = np.where(index >= 0, depth, np.float32(np.inf))
    shown = (index >= 0) & ~hidden_pixels(found, rule, rule.reach(view.camera, gap_deg))
    return np.where(shown, depth, np.float32(0)), np.where(shown, index, np.int32(-1))


def pixels_of(
    view: View, world: NDArray[np.floating]
) -> tuple[NDArray[np.bool_], NDArray[np.intp], NDArray[np.intp], NDArray[np.float32]]:
    """Which points bool[N] fall into a view, and of these row, column and depth in metres."""
    uv, z = geometry.project(view, world)
    with np.errstate(invalid="ignore"):
        inside = (z > NEAR_M) & (uv >= 0).all(1) & (uv[:, 0] < view.camera.width) & (uv[:, 1] < view.camera.height)
    column, row = np.floor(uv[inside]).astype(np.intp).T
    return inside, row, column, z[inside].astype(np.float32)


# ---- what other cameras saw --------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, eq=False)
class ShownFrame:
    """A shown frame: dense depth f32[H, W] metres (infinite where unknown), and its photograph u8[H, W, 3], a little blurred."""

    view: View
    depth: NDArray[np.float32]
    rgb: NDArray[np.uint8]


def shown_frame(scene: Scene, frame: Frame, rgb: NDArray[np.uint8]) -> ShownFrame | None:
    """A frame with its dense depth, or None if it has no label of that kind."""
    if "depth" not in frame.labels:
        return None
    depth = read_label(scene, frame, "depth")
    return ShownFrame(frame.view, np.where(np.isfinite(depth), depth, np.inf).astype(np.float32), blurred(rgb))


def blurred(rgb: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """A photograph u8[H, W, 3] averaged over 5x5 pixels, so that a point that is a pixel off has about its colour."""
    for axis in (0, 1):
        rgb = np.asarray(ndimage.uniform_filter1d(rgb, 5, axis=axis, mode="nearest"), np.uint8)
    return rgb


def seen_by(
    log_points: LogPoints, points: OwnedPoints, shown: Sequence[ShownFrame], time_s: float
) -> tuple[NDArray[np.bool_], NDArray[np.uint8]]:
    """Which points bool[N] some shown frame of any time saw, and the colour u8[N, 3] that they had there.

    A point is seen if it falls into the image and its depth there is not behind the frame's dense depth (rule ``drawn`` of
    ``core/visible.py``). Frames near ``time_s`` are asked first; the first that saw a point gives its colour.
    """
    seen, colors = np.zeros(len(points.xyz), bool), np.zeros((len(points.xyz), 3), np.uint8)
    for frame in sorted(shown, key=lambda frame: abs(frame.view.time_s - time_s)):
        left = np.flatnonzero(~seen)
        if not len(left):
            break
        inside, row, column, z = pixels_of(frame.view, log_points.placed(points.taken(left), frame.view.time_s))
        clear = ~RULES["drawn"].hides(frame.depth[row, column], z)
        found = left[inside][clear]
        seen[found], colors[found] = True, frame.rgb[row[clear], column[clear]]
    return seen, colors


def spread(
    answers: NDArray[np.bool_], rows: NDArray[np.intp], columns: NDArray[np.intp], shape: tuple[int, int]
) -> NDArray[np.bool_]:
    """A mask bool[H, W] from answers bool[N] at pixels: each pixel takes that of the nearest point, if one lies within
    ``SPREAD_SHARE`` of the width; else False."""
    mask, known = np.zeros(shape, bool), np.zeros(shape, bool)
    known[rows, columns], mask[rows, columns] = True, answers
    if not known.any():
        return mask
    row, column = np.asarray(ndimage.distance_transform_edt(~known, return_distances=False, return_indices=True))
    here_row, here_column = np.indices(shape)
    return mask[row, column] & (np.hypot(row - here_row, column - here_column) <= max(2.0, SPREAD_SHARE * shape[1]))
