"""Recorded classes of LiDAR points where they fall in an image: truth for what labels an image or renders classes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mudg.base.types import Frame, Scene
from mudg.core.fusion import FusionRules, SweepShots, judge_track, points_in_image
from mudg.data.scene.alignment import MAX_GAP_S, sweeps_beside
from mudg.data.scene.read import read_points


@dataclass(frozen=True, slots=True, eq=False)
class ImagePointClasses:
    """Points that an image shows: ``row`` and ``column`` i64[N] of the pixel, ``depth_m`` f32[N] (camera z), ``classes`` u8[N] train
    ids, 255 where people gave the point none."""

    row: NDArray[np.intp]
    column: NDArray[np.intp]
    depth_m: NDArray[np.float32]
    classes: NDArray[np.uint8]


def image_point_classes(scene: Scene, frame: Frame, max_gap_s: float = MAX_GAP_S) -> ImagePointClasses | None:
    """Class of each LiDAR point that ``frame`` shows; None where no sweep beside it has classes.

    The sweep of each LiDAR that is nearest in time is taken. Points of moving boxes stand where they are at the image's time; points behind
    nearer surfaces are left out, by the rules of the fusion. Nothing that ``mudg annotate`` makes is read or changed.

    Args:
        scene: a scene whose log has classes of points (``SweepPoints.classes``).
        frame: one of its images.
        max_gap_s: sweeps farther in time from the image are not used.
    """
    rules = FusionRules()
    dynamic = [track for track in scene.tracks if judge_track(track, rules).moving]
    parts = []
    for sweep in sweeps_beside(scene, frame, max_gap_s):
        points = read_points(scene, sweep)
        if points.classes is None:
            continue
        shots = SweepShots(sweep.time_s, sweep.world_from_lidar, points, ())
        ids, column, row, z = points_in_image(shots, frame.view, dynamic, rules)
        parts.append((row, column, z.astype(np.float32), points.classes[ids]))
    if not parts:
        return None
    return ImagePointClasses(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))
