"""A height map of the ground, from points that lie on it: what a vehicle stands on that is put somewhere else."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from mudg.base.errors import InputError

Array = NDArray[np.float64]
CELL_M: Final = 0.5
REACH_M: Final = 3.0
"""A cell without points takes the height of the nearest one within this distance; farther away nothing is known."""
TILT_M: Final = 2.0
"""The slope is that between places this far to either side: about what a vehicle stands on."""
SMOOTHING_CELLS: Final = 1.5
MOST_CELLS: Final = 50_000_000


@dataclass(frozen=True, slots=True, eq=False)
class HeightMap:
    """Heights on a grid of the horizontal plane.

    Args:
        origin: f64[2], world x and y of the centre of cell (0, 0), metres. cell_m: side of a cell.
        heights: f64[X, Y], world z in metres, smoothed; NaN where no point lies within `REACH_M`.
    """

    origin: Array
    cell_m: float
    heights: Array

    @classmethod
    def from_points(cls, xyz: NDArray[np.floating], cell_m: float = CELL_M) -> HeightMap:
        """Median height per cell, gaps filled from the nearest cell, smoothed.

        Args:
            xyz: [N, 3] world points of the ground, metres.

        Raises:
            InputError: no points, or points that are too far apart for a map.
        """
        points = np.asarray(xyz, np.float64)
        points = points[np.isfinite(points).all(1)]
        if not len(points):
            raise InputError("there is no ground: no point is of class road, sidewalk or terrain",
                remedy="fuse a scene with labels, or leave ground out (ground: false)")  # fmt: skip
        cells = np.floor(points[:, :2] / cell_m).astype(np.int64)
        first = cells.min(0) - int(np.ceil(REACH_M / cell_m))
        shape = cells.max(0) - first + 1 + int(np.ceil(REACH_M / cell_m))
        if shape.prod() > MOST_CELLS:
            raise InputError("the ground spans too large an area", got=f"{shape[0] * cell_m:.0f} x {shape[1] * cell_m:.0f} m")
        flat = (cells[:, 0] - first[0]) * shape[1] + cells[:, 1] - first[1]
        order = np.lexsort((points[:, 2], flat))
        ids, begins, counts = np.unique(flat[order], return_index=True, return_counts=True)
        heights = np.full(int(shape.prod()), np.nan)
        middle = [points[order[begins + at], 2] for at in ((counts - 1) // 2, counts // 2)]
        heights[ids] = (middle[0] + middle[1]) / 2
        return cls((first + 0.5) * cell_m, cell_m, _smoothed(heights.reshape(shape), cell_m))

    def height(self, xy: Array) -> Array:
        """World z f64[N] under places f64[N, 2]; NaN where it is not known."""
        return ndimage.map_coordinates(self.heights, self._at(xy).T, order=1, mode="constant", cval=np.nan)

    def normal(self, xy: Array) -> Array:
        """Unit normals f64[N, 3] of the ground at places f64[N, 2], upwards; vertical where it is not known."""
        slopes = np.stack([self._slope(xy, axis) for axis in (0, 1)], 1)
        normals = np.column_stack([-slopes, np.ones(len(slopes))])
        return normals / np.linalg.norm(normals, axis=1, keepdims=True)

    def _slope(self, xy: Array, axis: int) -> Array:
        """Rise per metre along an axis over `TILT_M` to either side, f64[N]; 0 where not known."""
        step = np.zeros(2)
        step[axis] = TILT_M
        return np.nan_to_num((self.height(xy + step) - self.height(xy - step)) / (2 * TILT_M))

    def _at(self, xy: Array) -> Array:
        return (np.asarray(xy, np.float64) - self.origin) / self.cell_m


def _smoothed(heights: Array, cell_m: float) -> Array:
    """Gaps filled as far as `REACH_M`, then a Gaussian blur that only known cells enter."""
    empty = np.isnan(heights)
    nearest: Any = ndimage.distance_transform_edt(empty, return_distances=False, return_indices=True)
    filled = heights[tuple(nearest)]
    here = np.indices(heights.shape)
    far = np.linalg.norm(nearest - here, axis=0) * cell_m > REACH_M
    weight = ndimage.gaussian_filter((~far).astype(np.float64), SMOOTHING_CELLS)
    blurred = ndimage.gaussian_filter(np.where(far, 0.0, filled), SMOOTHING_CELLS) / np.maximum(weight, 1e-12)
    return np.where(far, np.nan, blurred)
