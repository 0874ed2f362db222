"""Starting points of methods without boxes: LiDAR points where and when they were measured, coloured by the photographs
of that time.

Nothing here knows tracked boxes or the fused cloud (whose dynamic points lie in boxes): a point of a moving car stays
where its sweep met it. Colours come from training photographs at most half a frame from the sweep, so that a moving
point has the colour of its own moment; points that none of these shows are left out.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor

from mudg.base import geometry, seeds
from mudg.base.camera_colors import CameraColors
from mudg.base.errors import InputError
from mudg.base.types import Scene
from mudg.core.fusion import largest_beam_gap
from mudg.core.project import RULES as HIDING_RULES
from mudg.core.project import visible_depth
from mudg.core.table import Table
from mudg.gaussians.model import SceneModel
from mudg.gaussians.nodes import SkyNode, StaticNode
from mudg.gaussians.settings import FitConfig
from mudg.gaussians.start import StartPoints, fill_unreached, neighbour_scale, thinned, voxel_filter
from mudg.gaussians.views import StoredView
from mudg.scene.read import read_points

SAME_DEPTH = 0.02
"""A point is seen by a camera whose nearest depth at its pixel differs by at most this share."""
MOMENT_FRAMES = 2
"""Frames that share one of the moments by which points are thinned a second time."""
LARGEST_M = 150.0


def timed_points(
    scene: Scene, views: Sequence[StoredView], classes: tuple[int, ...], config: FitConfig, colors: CameraColors
) -> tuple[StartPoints, NDArray[np.float64]]:
    """Starting points of a log, thinned to ``config.start.gaussians``, and what LiDAR did not reach (as in
    ``gaussians/start.py``); and when they were measured, f64[N] seconds, NaN where LiDAR did not reach.

    Half of them are one per cube of space, half one per cube and every few frames, so that what moves has points all
    along its way. InputError: no photograph shows any LiDAR point."""
    xyz, rgb, semantics, time_s = _measured(scene, views, classes, colors)
    if len(xyz) == 0:
        what = "no LiDAR point is seen by a training photograph of its time"
        raise InputError(what, where=scene.root, remedy="check the LiDAR of the scene and --cameras")
    centers = np.stack([stored.view.center_world for stored in views]).astype(np.float32)
    half = replace(config, start=replace(config.start, gaussians=max(50, config.start.gaussians // 2)))
    parts = [thinned(xyz, centers, half), *_by_moment(xyz, time_s, scene, half)]
    chosen = [
        (StartPoints(xyz[rows], rgb[rows], semantics[rows], neighbour_scale(xyz[rows])), time_s[rows]) for rows in parts
    ]
    filled = fill_unreached(views, xyz, classes, colors)
    if filled is not None:
        chosen.append((filled, np.full(len(filled), np.nan)))
    return StartPoints.joined([part for part, _ in chosen]), np.concatenate([times for _, times in chosen])


def world_model(
    node: StaticNode,
    columns: Mapping[str, Tensor],
    classes: tuple[int, ...],
    config: FitConfig,
    colors: CameraColors,
    sky: SkyNode | None = None,
) -> SceneModel:
    """A scene that is one node with these rows, and a sky."""
    table = Table(columns, {"node": torch.zeros(len(columns["means"]), dtype=torch.int32)})
    return SceneModel(table, (node,), sky, classes, config.sh_degree, colors=colors)


def frame_seconds(scene: Scene) -> float:
    """Seconds between frames; 0.1 where there is only one."""
    times = sorted({frame.view.time_s for frame in scene.frames})
    return (times[-1] - times[0]) / (len(times) - 1) if len(times) > 1 else 0.1


def _measured(
    scene: Scene, views: Sequence[StoredView], classes: tuple[int, ...], colors: CameraColors
) -> tuple[NDArray[np.float32], NDArray[np.uint8], NDArray[np.uint8], NDArray[np.float64]]:
    near_s = 0.5 * frame_seconds(scene) + 1e-3
    found: list[tuple[NDArray[np.float32], NDArray[np.uint8], NDArray[np.uint8], NDArray[np.float64]]] = []
    for sweep in scene.sweeps:
        nearest: dict[str, int] = {}
        for index in sorted(range(len(views)), key=lambda index: abs(views[index].view.time_s - sweep.time_s)):
            if abs(views[index].view.time_s - sweep.time_s) <= near_s:
                nearest.setdefault(views[index].view.camera.name, index)
        if not nearest:
            continue
        points = read_points(scene, sweep)
        xyz, gap = geometry.transform_points(sweep.world_from_lidar, points.xyz), largest_beam_gap(points.xyz)
        free = np.ones(len(xyz), bool)
        for index in nearest.values():
            rows, rgb, semantics = _seen(views[index], xyz, gap, classes, colors)
            mine = free[rows]
            rows = rows[mine]
            free[rows] = False
            found.append((xyz[rows], rgb[mine], semantics[mine], sweep.time_s + points.dt_s[rows].astype(np.float64)))
    if not found:
        return np.zeros((0, 3), np.float32), np.zeros((0, 3), np.uint8), np.zeros(0, np.uint8), np.zeros(0)
    xyz, rgb, semantics, time_s = (np.concatenate(column) for column in zip(*found))
    return xyz, rgb, semantics, time_s


def _seen(
    stored: StoredView, xyz: NDArray[np.float32], gap_deg: float, classes: tuple[int, ...], colors: CameraColors
) -> tuple[NDArray[np.int64], NDArray[np.uint8], NDArray[np.uint8]]:
    """Rows of the points that a photograph shows, their common colours and train ids."""
    view, camera = stored.view, stored.view.camera
    uv, z = geometry.project(view, xyz)
    with np.errstate(invalid="ignore"):
        inside = ((uv >= 0) & (uv < (camera.width, camera.height))).all(1) & (z > 0.5) & (z < LARGEST_M)
    rows = np.flatnonzero(inside)
    column, row = uv[rows, 0].astype(int), uv[rows, 1].astype(int)
    nearest = visible_depth(view, xyz, HIDING_RULES["sweep"], gap_deg=gap_deg, far_m=LARGEST_M)[row, column]
    with np.errstate(invalid="ignore"):
        seen = np.abs(nearest - z[rows]) <= SAME_DEPTH * z[rows]
    if stored.mask is not None:
        seen &= stored.mask[row, column]
    rows, row, column = rows[seen], row[seen], column[seen]
    common = colors.bytes_to_common(camera.name, stored.rgb[row, column])
    return rows, common, stored.train_ids(row, column, classes)


def _by_moment(
    xyz: NDArray[np.float32], time_s: NDArray[np.float64], scene: Scene, config: FitConfig
) -> list[NDArray[np.int64]]:
    """Rows, one per cube of space, of every moment; at most the wanted number in all."""
    moment = np.floor((time_s - time_s.min()) / (MOMENT_FRAMES * frame_seconds(scene)) + 1e-6).astype(np.int64)
    parts = []
    for number in np.unique(moment):
        mine = np.flatnonzero(moment == number)
        parts.append(mine[voxel_filter(xyz[mine], 2 * config.start.voxel_m)])
    share = min(1.0, config.start.gaussians / max(1, sum(map(len, parts))))
    chosen = []
    for index, rows in enumerate(parts):
        order = seeds.numpy_rng(config.seed, index, "moment").permutation(len(rows))
        chosen.append(rows[np.sort(order[: max(4, int(share * len(rows)))])])
    return chosen


# ---- networks ------------------------------------------------------------------------------------


@dataclass(frozen=True)
class FlatNetwork:
    """A small network whose numbers lie in one row, a column ``[1, P]`` of a ``Table``: layers of these widths, with
    ReLU between them. ``leading``: also a ReLU before the first layer."""

    widths: tuple[int, ...]
    leading: bool = False

    @property
    def numbers(self) -> int:
        """Weights and biases in all."""
        return sum((before + 1) * after for before, after in zip(self.widths, self.widths[1:]))

    def start(self, generator: torch.Generator, silent: bool = True) -> Tensor:
        """Starting values ``[1, P]``: uniform for ReLU (He et al. 2015), biases 0; ``silent``: the last layer 0, so
        that the output is."""
        parts = []
        for place, (before, after) in enumerate(zip(self.widths, self.widths[1:])):
            last = silent and place == len(self.widths) - 2
            weights = (torch.rand(after * before, generator=generator) * 2 - 1) * math.sqrt(6 / before)
            parts += [weights * 0.0 if last else weights, torch.zeros(after)]
        return torch.cat(parts)[None]

    def __call__(self, flat: Tensor, values: Tensor) -> Tensor:
        """Output ``[n, last]`` for inputs ``[n, first]``."""
        found, offset = torch.relu(values) if self.leading else values, 0
        for place, (before, after) in enumerate(zip(self.widths, self.widths[1:])):
            weights = flat[0, offset : offset + before * after].view(after, before)
            bias = flat[0, offset + before * after : offset + (before + 1) * after]
            found = F.linear(torch.relu(found) if place else found, weights, bias)
            offset += (before + 1) * after
        return found


def waves(values: Tensor, octaves: int) -> Tensor:
    """Values ``[n, c]`` with sine and cosine of their 1, 2, 4, ... pi fold: ``[n, c (1 + 2 octaves)]``."""
    scaled = torch.cat([values * (math.pi * 2**octave) for octave in range(octaves)], 1)
    return torch.cat([values, torch.sin(scaled), torch.cos(scaled)], 1)
