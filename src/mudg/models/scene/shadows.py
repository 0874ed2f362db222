"""The shadow of what stood in a box, found by its darkness on the ground, and taken away.

On a grid of the ground, a cell is dark that has clearly less light than lit ground of its class about it. Dark cells are the object's
shadow if they lie behind it in one direction, that of the light, with no lit cell between. They get the colours of the lit ground
around, continued, and keep a little of their texture.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
import torch
from numpy.typing import NDArray
from scipy import ndimage
from scipy.spatial import KDTree

from mudg.base import geometry
from mudg.core.table import Table
from mudg.core.weather.tone import LUMINANCE
from mudg.models.scene.edited import display_of, linear_of
from mudg.models.scene.initial import SH_C0
from mudg.models.scene.model import SceneModel

Array = NDArray[np.float64]
Rows = NDArray[np.bool_]
CELL_M: Final = 0.25
REACH: Final = 2.0
"""How far from the box its shadow is looked for, as a share of its height."""
DIRECTIONS: Final = 24
AROUND_M: Final = 2.5
LIT_QUANTILE: Final = 0.7
"""Of the ground around, this share is at most as bright as lit ground is."""
DARK: Final = 0.65
"""A cell in shadow has less than this share of the light of lit ground within `AROUND_M`."""
EDGE_CELLS: Final = 2
TEXTURE: Final = 1.3
"""Within a shadow, a Gaussian becomes at most this much brighter or darker than those around it."""
LEAST_ROWS: Final = 24
LEAST_PX: Final = 0.05
"""A cell of which views show less than this is not known."""
SOURCE_M: Final = 0.6
"""Colours are continued from cells of this side,"""
SOURCES: Final = 160
"""from this many of them,"""
BRIGHT: Final = 1.25
"""but not from those that are brighter than the `AROUND` about them by this factor, which are markings, nor from shadows."""
AROUND: Final = 40


def colors_of(model: SceneModel) -> Array:
    """Display values f64[N, 3] of every Gaussian, without what depends on the direction of view."""
    return 0.5 + SH_C0 * model.table["sh_dc"].detach().cpu().numpy()[:, 0].astype(np.float64)


def continued(xy: Array, places: Array, colors: Array, weights: Array) -> tuple[Array, NDArray[np.int64]]:
    """Colours of ground continued smoothly to other places.

    Args:
        xy: f64[C, 2] where colours are asked for. places: f64[M, 2]; colors: f64[M, 3] of the ground that is known; weights: how much of
            it is seen, f64[M].

    Returns:
        Colours f64[C, 3], and the nearest known place i64[C].
    """
    _, owner = np.unique(np.floor(places / SOURCE_M).astype(np.int64), axis=0, return_inverse=True)
    owner = owner.ravel()
    total = np.bincount(owner, weights)
    mean = lambda values: np.bincount(owner, weights * values) / total  # noqa: E731
    centres = np.column_stack([mean(places[:, axis]) for axis in (0, 1)])
    middles = np.column_stack([mean(colors[:, channel]) for channel in (0, 1, 2)])
    bright = middles @ LUMINANCE
    near = KDTree(centres).query(centres, min(AROUND, len(centres)))[1].reshape(len(centres), -1)
    usual, lit = np.quantile(bright[near], [0.5, LIT_QUANTILE], axis=1)
    plain = (bright <= BRIGHT * np.maximum(usual, lit / BRIGHT)) & (bright >= lit / BRIGHT)
    plain |= not plain.any()
    centres, middles = centres[plain], middles[plain]
    apart, near = KDTree(centres).query(xy, min(SOURCES, len(centres)))
    apart, near = apart.reshape(len(xy), -1), near.reshape(len(xy), -1)
    weight = 1 / (apart**2 + SOURCE_M**2) ** 1.5
    found = (weight[..., None] * middles[near]).sum(1) / weight.sum(1)[:, None]
    return found, np.asarray(KDTree(places).query(xy)[1], np.int64)


@dataclass(frozen=True, slots=True, eq=False)
class _Cells:
    """A grid of square cells of `CELL_M` on the ground: the place f64[2] of its first corner, and how many cells it has."""

    low: Array
    shape: tuple[int, int]

    @classmethod
    def around(cls, poses: Array, reach_m: float) -> _Cells:
        low = np.floor((poses[:, :2, 3].min(0) - reach_m) / CELL_M) * CELL_M
        count = np.ceil((poses[:, :2, 3].max(0) + reach_m - low) / CELL_M).astype(int)
        return cls(low, (int(count[0]), int(count[1])))

    def centres(self) -> Array:
        """Places f64[X * Y, 2]."""
        return self.low + (np.stack(np.meshgrid(*map(np.arange, self.shape), indexing="ij"), -1).reshape(-1, 2) + 0.5) * CELL_M

    def below(self, size_m: tuple[float, float, float], poses: Array) -> Rows:
        """Cells bool[X, Y] below boxes."""
        centres, half = self.centres(), np.array(size_m[:2]) / 2
        found = np.zeros(len(centres), bool)
        for pose in poses:
            yaw = geometry.yaw_of(pose)
            turn = np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
            found |= (np.abs((centres - pose[:2, 3]) @ turn) <= half).all(1)
        return found.reshape(self.shape)

    def at(self, xy: Array, cells: Rows) -> Rows:
        """Which places f64[N, 2] lie in chosen cells."""
        index = np.floor((xy - self.low) / CELL_M).astype(np.int64)
        inside = ((index >= 0) & (index < self.shape)).all(1)
        found = np.zeros(len(xy), bool)
        found[inside] = cells[tuple(index[inside].T)]
        return found

    def of(self, values: Array, xy: Array) -> Array:
        """Values f64[X, Y] of the cells in which places f64[N, 2] lie."""
        return values[tuple(np.floor((xy - self.low) / CELL_M).astype(np.int64).T)]

    def light(self, xy: Array, luminance: Array, weights: Array) -> Array:
        """Weighted mean luminance f64[X, Y] of the places near each cell; NaN where there are none."""
        index = np.floor((xy - self.low) / CELL_M).astype(np.int64)
        flat = np.ravel_multi_index(tuple(index.T), self.shape)
        sums = [np.bincount(flat, values, int(np.prod(self.shape))).reshape(self.shape) for values in (weights, weights * luminance)]
        total, shown = (ndimage.gaussian_filter(values, 0.7, truncate=2.0) for values in sums)
        return np.where(total > LEAST_PX, shown / np.maximum(total, 1e-12), np.nan)


def shaded_cells(light: Array, below: Rows, reach_m: float) -> Rows:
    """Cells bool[X, Y] of the shadow of what stood on some: those darker than lit ground about them that lie behind it, and behind
    each other, in one direction: the one in which there are most.

    Args:
        light: luminance f64[X, Y] in linear light, NaN = not known. below: where it stood, bool[X, Y].
    """
    known = np.isfinite(light)
    size = 2 * round(AROUND_M / CELL_M) + 1
    lit = ndimage.generic_filter(np.where(known, light, np.nan), _upper, size=size, mode="constant", cval=np.nan)
    dark = known & (light < DARK * lit)
    best = below & dark
    for angle in np.arange(DIRECTIONS) * 2 * np.pi / DIRECTIONS:
        away = np.array([np.cos(angle), np.sin(angle)])
        found, front = below & dark, below
        for step in range(1, round(reach_m / CELL_M) + 1):
            by = np.round(away * step).astype(int) - np.round(away * (step - 1)).astype(int)
            front = np.roll(front, by, (0, 1)) & (dark | below)  # the border is farther away than any shadow reaches
            found = found | (front & dark)
        best = found if found.sum() > best.sum() else best
    return best


def _upper(values: Array) -> float:
    values = values[np.isfinite(values)]
    return float(np.quantile(values, LIT_QUANTILE)) if len(values) else np.nan


def brightened(
    model: SceneModel, size_m: tuple[float, float, float], poses: Array, ground: Mapping[int, Rows], weights: Array
) -> SceneModel:
    """A copy without the shadow of what stood in boxes; the model itself where none is found.

    Args:
        poses: world_from_box f64[V, 4, 4]. ground: rows bool[N] of each class of ground. weights: pixels that views show of each, f64[N].
    """
    means = model.table["means"].detach().cpu().numpy().astype(np.float64)[:, :2]
    shown = colors_of(model)
    luminance = linear_of(shown) @ LUMINANCE
    reach = REACH * size_m[2]
    cells = _Cells.around(poses, reach + AROUND_M + float(np.linalg.norm(size_m[:2])) / 2)
    below = cells.below(size_m, poses)
    here = cells.at(means, np.ones(cells.shape, bool))
    changed = model.table["sh_dc"].detach().clone()
    for rows in ground.values():
        near = rows & here & (weights > 0)
        if near.sum() < LEAST_ROWS:
            continue
        light = cells.light(means[near], luminance[near], weights[near])
        found = shaded_cells(light, below, reach)
        wide: Rows = np.asarray(ndimage.binary_dilation(found, iterations=EDGE_CELLS), np.bool_)
        shaded = np.flatnonzero(rows & cells.at(means, wide))
        lit = near & ~cells.at(means, wide | below)
        if not len(shaded) or lit.sum() < LEAST_ROWS:
            continue
        target = linear_of(continued(means[shaded], means[lit], shown[lit], weights[lit])[0])
        usual = cells.of(light, means[shaded])
        usual = np.where(np.isfinite(usual), usual, luminance[shaded])  # what no view shows has no texture
        texture = (luminance[shaded] / np.maximum(usual, 1e-4)).clip(1 / TEXTURE, TEXTURE)
        darker = luminance[shaded] < target @ LUMINANCE / TEXTURE
        values = ((display_of(target * texture[:, None]) - 0.5) / SH_C0)[darker]
        changed[torch.from_numpy(shaded[darker]).to(model.device), 0] = torch.from_numpy(values).to(changed)
    columns = {name: value.detach() for name, value in model.table.columns.items()}
    return replace(model, table=Table({**columns, "sh_dc": changed}, dict(model.table.labels)), facts=dict(model.facts))
