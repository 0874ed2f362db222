"""Sides of a vehicle that no view showed: they are closed with flat Gaussians that continue the colours of what was seen.

Who follows a car records its rear. Turned, or seen from another lane, its flanks are holes through which the street shows. So the two
flanks of a vehicle are covered with Gaussians wherever it has none: as far out as it reaches at that height, in the colours that it, or
its mirror image, has at that height. What recorded views would show of them is taken away again: there the recording knows better.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import Final

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import KDTree

from mudg.base.types import View
from mudg.core.raster.rasterize import RasterConfig
from mudg.models.scene.edited import GROUND_CLASSES, SOLID_OPACITY, classes_of_rows
from mudg.models.scene.initial import SH_C0
from mudg.models.scene.model import SceneModel
from mudg.models.scene.nodes import SYMMETRIC_LABELS, RigidNode
from mudg.models.scene.shadows import colors_of
from mudg.models.scene.uncovered import most_shown, with_copies, without_rows

Array = NDArray[np.float64]
CLOSED_LABELS: Final = SYMMETRIC_LABELS - {"motorcycle"}
CABIN_LABELS: Final = frozenset({"car", "vehicle"})
"""Labels of vehicles whose upper part is shorter than the lower: the others are boxes."""
CABIN_FROM: Final = 0.55
"""The upper part begins at this share of the height."""
STEP_M: Final = 0.12
SPREAD: Final = 0.6
"""Standard deviation of a Gaussian, in steps."""
FLOOR_M: Final = 0.2
"""So far up a vehicle is open to the road."""
GAP_M: Final = 0.25
"""A side has a gap where no Gaussian is within this distance."""
AROUND_M: Final = 0.1
SAME_HEIGHT_M: Final = 0.15
INSET_M: Final = 0.05
WIDTH_QUANTILE: Final = 0.9
LEAST_ROWS: Final = 8
LIKE: Final = 32
"""A colour is the median of those of this many Gaussians, the nearest,"""
ALIKE: Final = (0.3, 0.3, 3.0)
"""where a metre along, across and up counts so much."""
OPACITY: Final = 0.95
SHOWN_PX: Final = 0.01
"""What a recorded view shows more of than this is not hidden."""


def with_closed_sides(model: SceneModel, names: Collection[str], views: Sequence[View], raster: RasterConfig) -> SceneModel:
    """A copy in which some vehicles have flanks where the recording showed none; other objects stay as they are.

    Args:
        model: with the objects on their recorded paths. names: of objects. views: recorded ones, from which nothing new is to be seen.
    """
    first = len(model.table)
    for name in names:
        node = model.dynamic_object(name)
        if type(node) is RigidNode and node.label in CLOSED_LABELS:
            model = _with_flanks(model, node)
    if len(model.table) == first:
        return model
    made = torch.arange(len(model.table), device=model.device) >= first
    seen = made & (_most_shown(model, views, raster) > SHOWN_PX)
    model = without_rows(model, seen.cpu().numpy())
    model.sort_rows()
    return model


def _most_shown(model: SceneModel, views: Sequence[View], raster: RasterConfig) -> torch.Tensor:
    """As `most_shown`, of rows that need not be sorted by node yet: f32[N]."""
    order = torch.argsort(model.table.labels["node"], stable=True)
    ordered = without_rows(model, np.zeros(len(model.table), bool))
    ordered.sort_rows()
    shown = torch.zeros(len(order), device=model.device)
    shown[order] = most_shown(ordered, views, raster)[0]
    return shown


def _with_flanks(model: SceneModel, node: RigidNode) -> SceneModel:
    """With rows more, the last ones, where the flanks of a vehicle have gaps."""
    length, width, height = node.size_m
    half = np.array([length, width, height]) / 2
    rows = np.flatnonzero((model.table.labels["node"] == model.nodes.index(node)).cpu().numpy())
    there = torch.from_numpy(rows).to(model.device)
    places = model.table["means"].detach()[there].cpu().numpy().astype(np.float64)
    own = torch.sigmoid(model.table["logits"].detach()[there]).cpu().numpy() > SOLID_OPACITY
    own &= (np.abs(places) <= half + AROUND_M).all(1) & ~np.isin(classes_of_rows(model)[rows], GROUND_CLASSES)
    if own.sum() < LEAST_ROWS:
        return model
    rows, places = rows[own], places[own]
    flanks = _flanks(places, half, node.label in CABIN_LABELS)
    flanks = flanks[KDTree(places).query(flanks)[0] > GAP_M] if len(flanks) else flanks
    if not len(flanks):
        return model
    both = np.concatenate([places, places * [1, -1, 1]]) * ALIKE
    near = KDTree(both).query(flanks * ALIKE, min(LIKE, len(both)))[1] % len(rows)
    color, count = np.median(colors_of(model)[rows][near], 1), len(flanks)
    return with_copies(model, rows[near[:, 0]], {
        "means": flanks, "quats": np.tile([1.0, 0, 0, 0], (count, 1)),
        "log_scales": np.tile(np.log([SPREAD * STEP_M, 0.02, SPREAD * STEP_M]), (count, 1)),
        "logits": np.full(count, np.log(OPACITY / (1 - OPACITY))), "sh_dc": ((color - 0.5) / SH_C0)[:, None],
    })  # fmt: skip


def _flanks(places: Array, half: Array, cabin: bool) -> Array:
    """Places f64[M, 3] on a grid over both flanks of a vehicle, in the frame of its box.

    Args:
        places: f64[N, 3] of its Gaussians, which say how wide it is at each height. half: of the size of its box. cabin: a car, of the
            usual shape; else a box.
    """
    found = []
    for z in np.arange(FLOOR_M + STEP_M / 2, 2 * half[2] - 0.02, STEP_M) - half[2]:
        level = np.abs(places[np.abs(places[:, 2] - z) < SAME_HEIGHT_M, 1])
        wide = float(np.quantile(level, WIDTH_QUANTILE)) if len(level) > LEAST_ROWS else 0.9 * half[1]
        up = (z / half[2] + 1) / 2 - CABIN_FROM
        rear, front = (-half[0], half[0]) if up < 0 or not cabin else (half[0] * (0.5 * up - 0.8), half[0] * (0.4 - 0.7 * up))
        along = np.arange(rear + STEP_M / 2, front, STEP_M)
        side = np.full(len(along), min(wide, half[1]) - INSET_M)
        found += [np.column_stack([along, sign * side, np.full(len(along), z)]) for sign in (-1, 1)]
    return np.concatenate(found) if found else np.zeros((0, 3))
