"""The ground around a vehicle: its plane, and the part that can be reached from the driven path without a step.

A kerb of a decimetre separates a road from a sidewalk better than anything else that a scanner measures, and unlike
colour it is the same in every town. ``map_ground`` finds it from above, in cells of ``CELL_M``.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.spatial import cKDTree

Points = NDArray[np.floating]
Places = NDArray[np.float64]
Mask = NDArray[np.bool_]

NEAR_PATH_M: Final = 30.0
"""The ground plane belongs to the part of the path within this distance of the camera."""
CELL_M: Final = 0.3
REACH_M: Final = 45.0
"""The map goes this far from the camera to each side."""
LOW_M: Final = 0.7
"""Points farther above or below the plane than this are not ground."""
KERB_M: Final = 0.07
"""Heights of neighbouring cells that differ by more than this are a step."""
_KNOWN_M: Final = 2.5
"""A cell farther than this from every return is unknown."""
_TRACK_M: Final = 1.2
"""Ground this near to the path was driven on."""
_BLIND_M: Final = 7.0
"""Around its own vehicle a scanner sees no ground: unknown cells this near to the path's places count as open."""
_DETOUR: Final = (1.2, 3.0)
"""A direct way is at most this many times as long as the straight one, and this many metres."""
_FLOOR_WINDOW_M: Final = 3.0
_STOOD_M: Final = 0.5
"""A path that goes no farther than this shows no direction."""


def fit_ground(xyz_world: Points, path_world: Places) -> Places | None:
    """Ground plane z = a x + b y + c within 40 m of the path's middle, f64[3], or None with too few points to tell.

    Starts from the lowest returns of 2 m cells (their lower half by height), then least squares on what lies within
    0.5, 0.3 and 0.2 m of the plane. A slope above 20 percent is not believed.
    """
    if len(xyz_world) < 50 or len(path_world) == 0:
        return None
    xyz = np.asarray(xyz_world, np.float64)
    centre = path_world.mean(0)
    xyz = xyz[(np.abs(xyz[:, :2] - centre[:2]) < 40.0).all(1)]
    xyz = xyz[:: max(1, len(xyz) // 60_000)]
    cells = np.floor(xyz[:, :2] / 2.0).astype(np.int64)
    key = cells[:, 0] * 1_000_003 + cells[:, 1]
    order = np.lexsort((xyz[:, 2], key))
    lowest = xyz[order[np.flatnonzero(np.r_[True, np.diff(key[order]) != 0])]] if len(order) else xyz
    lowest = lowest[lowest[:, 2] <= np.median(lowest[:, 2])] if len(lowest) else lowest
    if len(lowest) < 10:
        return None
    plane = np.array([0.0, 0.0, float(np.median(lowest[:, 2]))])
    for support, band_m in ((lowest, 0.5), (xyz, 0.3), (xyz, 0.2)):
        near = support[np.abs(above_plane(plane, support)) < band_m]
        if len(near) < 10:
            return None
        design = np.c_[near[:, :2], np.ones(len(near))]
        plane = np.linalg.lstsq(design, near[:, 2], rcond=None)[0]
    return plane if np.hypot(plane[0], plane[1]) < 0.2 else None


def ground_near(xyz_world: Points, path_world: Places, centre_world: Places) -> Places | None:
    """``fit_ground`` for the part of the path near a place: a log is longer than a plane is flat."""
    if len(path_world) == 0:
        return None
    away = np.linalg.norm(path_world[:, :2] - centre_world[:2], axis=1)
    return fit_ground(xyz_world, path_world[away <= max(NEAR_PATH_M, float(away.min()))])


def above_plane(plane: Places, xyz_world: Points) -> Places:
    """Height of points ``[..., 3]`` above a plane of ``fit_ground``, metres."""
    return xyz_world[..., 2] - (xyz_world[..., 0] * plane[0] + xyz_world[..., 1] * plane[1] + plane[2])


def driven_path(world_from_ego: Places) -> Places:
    """Places f64[M, 3] of a vehicle with poses f64[T, 4, 4]; of one that stood, 1 m behind and ahead of it, too."""
    places = world_from_ego[:, :3, 3]
    if len(places) == 0 or np.linalg.norm(places[:, :2] - places[0, :2], axis=1).max() > _STOOD_M:
        return places
    return places[0] + np.array([[-1.0], [0.0], [1.0]]) * world_from_ego[0, :3, 0]


def distance_to_path(xyz_world: Points, path_world: Places) -> Places:
    """Horizontal distance of points ``[N, 2 or 3]`` to the driven path, gone on straight for 80 m at both ends; metres
    f64[N].

    A path shorter than half a metre has no direction (``driven_path`` gives it one); then it is the distance to its
    first place.
    """
    if len(path_world) == 0 or len(xyz_world) == 0:
        return np.zeros(len(xyz_world))
    far = np.flatnonzero(np.linalg.norm(path_world[:, :2] - path_world[0, :2], axis=1) > _STOOD_M)
    if len(far) == 0:
        return np.linalg.norm(xyz_world[:, :2] - path_world[0, :2], axis=1)
    forward = path_world[far[0], :2] - path_world[0, :2]
    back = np.flatnonzero(np.linalg.norm(path_world[:, :2] - path_world[-1, :2], axis=1) > _STOOD_M)[-1]
    onward = path_world[-1, :2] - path_world[back, :2]
    reach = np.arange(80.0, 0, -2.0)[:, None]
    before = path_world[0, :2] - reach * forward / np.linalg.norm(forward)
    after = path_world[-1, :2] + reach[::-1] * onward / np.linalg.norm(onward)
    line = np.concatenate([before, path_world[:, :2], after])
    return cKDTree(line).query(xyz_world[:, :2])[0]


def beside_path(xyz_world: NDArray[np.float32], path_world: Places, step: int) -> NDArray[np.float32]:
    """``distance_to_path`` of the points f32[H, W, 3] of an image, worked out at every ``step``-th pixel; metres f32[H,
    W], infinite where a point is not finite."""
    coarse = xyz_world[::step, ::step]
    beside = np.full(coarse.shape[:2], np.inf, np.float32)
    known = np.isfinite(coarse).all(-1)
    beside[known] = distance_to_path(coarse[known], path_world)
    height, width = xyz_world.shape[:2]
    return beside.repeat(step, 0).repeat(step, 1)[:height, :width]


@dataclass(frozen=True, slots=True, eq=False)
class GroundMap:
    """Ground around a camera from above: cell [i, j] is ``CELL_M`` wide and begins at ``corner_m + CELL_M * (i, j)``.

    Args:
        corner_m: world x and y, f64[2]. plane: of ``fit_ground``, f64[3].
        reachable: bool[N, N], reached from the driven path over known ground without a step.
        direct: bool[N, N], and that without much of a detour: one lowered kerb joins a whole sidewalk, but not
            directly.
        raised_m: f32[N, N], height above the lowest ground within 3 m, 0 where unknown.
    """

    corner_m: Places
    plane: Places
    reachable: Mask
    direct: Mask
    raised_m: NDArray[np.float32]

    def under(self, xyz_world: Points) -> tuple[Mask, Mask, NDArray[np.float32]]:
        """``reachable``, ``direct`` and ``raised_m`` under points ``[..., 3]``; False and 0 where is no ground."""
        place = np.floor(np.nan_to_num((xyz_world[..., :2] - self.corner_m) / CELL_M, nan=-1.0)).astype(np.int64)
        last = len(self.reachable) - 1
        low = (place >= 0).all(-1) & (place <= last).all(-1) & (np.abs(above_plane(self.plane, xyz_world)) < LOW_M)
        i, j = np.moveaxis(np.clip(place, 0, last), -1, 0)
        return self.reachable[i, j] & low, self.direct[i, j] & low, np.where(low, self.raised_m[i, j], np.float32(0))


def map_ground(xyz_world: Points, path_world: Places, centre_world: Places) -> GroundMap | None:
    """Map of the ground within ``REACH_M`` of a place; None without a ground plane.

    Args:
        xyz_world: returns ``[N, 3]``, metres. path_world: places of the vehicle f64[M, 3]. centre_world: f64[3].
    """
    plane = ground_near(xyz_world, path_world, centre_world)
    if plane is None:
        return None
    side = int(2 * REACH_M / CELL_M)
    corner = centre_world[:2] - REACH_M
    height, away_m = _cell_heights(xyz_world, plane, corner, side)
    known = away_m <= _KNOWN_M
    step = ndimage.maximum_filter(height, 3) - ndimage.minimum_filter(height, 3)
    centres = corner + (np.indices((side, side)).reshape(2, -1).T + 0.5) * CELL_M
    beside = distance_to_path(centres, path_world).reshape(side, side)
    behind = cKDTree(path_world[:, :2]).query(centres, distance_upper_bound=_BLIND_M)[0].reshape(side, side)
    passable = (known & (step < KERB_M)) | ((away_m > 2 * CELL_M) & (behind < _BLIND_M) & (step < KERB_M))
    way_m = _way(passable, beside)
    # a step takes a cell from the road, too: neighbours of cells that are reached count as reached
    ways = np.isfinite(way_m), way_m <= _DETOUR[0] * beside + _DETOUR[1]
    reachable, direct = (cells | (_dilated(cells) & known) for cells in ways)
    floor = ndimage.minimum_filter(ndimage.uniform_filter(height, 3), 2 * round(_FLOOR_WINDOW_M / CELL_M) + 1)
    raised = np.where(known, np.maximum(height - floor, 0), 0).astype(np.float32)
    return GroundMap(corner, plane, reachable, direct, raised)


def _way(passable: Mask, beside_m: Places) -> Places:
    """Length of the way from the driven path to each cell over passable ones, metres, infinite where there is none.

    Cells are reached in turns of four and of eight neighbours, which measures lengths to 8 percent.
    """
    reached = passable & (beside_m < _TRACK_M)
    way = np.where(reached, 0.0, np.inf)
    count = idle = 0
    while idle < 2:  # neither four nor eight neighbours bring more
        count += 1
        wider = _dilated(reached, diagonally=count % 2 == 1) & passable
        new = wider & ~reached
        way[new], reached = count * CELL_M, wider
        idle = 0 if new.any() else idle + 1
    return way


def _dilated(mask: Mask, diagonally: bool = False) -> Mask:
    """A mask and the four, or eight, neighbours of its cells."""
    return np.asarray(ndimage.binary_dilation(mask, ndimage.generate_binary_structure(2, 1 + diagonally)), np.bool_)


def _cell_heights(xyz_world: Points, plane: Places, corner_m: Places, side: int) -> tuple[Places, Places]:
    """Height above the plane of each cell, f64[side, side]: the lower quartile of its low points, else that of the
    nearest cell with any; and how far away that is, metres."""
    place = np.floor((xyz_world[:, :2] - corner_m) / CELL_M).astype(np.int64)
    above = above_plane(plane, xyz_world)
    low = (place >= 0).all(1) & (place < side).all(1) & (np.abs(above) < LOW_M)
    key, above = place[low, 0] * side + place[low, 1], above[low]
    order = np.lexsort((above, key))
    key = key[order]
    first = np.flatnonzero(np.r_[True, np.diff(key) != 0]) if len(key) else np.zeros(0, np.int64)
    count = np.diff(np.r_[first, len(key)])
    height = np.zeros(side * side)
    known = np.zeros(side * side, bool)
    height[key[first]], known[key[first]] = above[order][first + count // 4], True
    height, known = height.reshape(side, side), known.reshape(side, side)
    if not known.any():
        return height, np.full(height.shape, np.inf)
    nearest: Any = ndimage.distance_transform_edt(~known, return_distances=False, return_indices=True)
    away = np.asarray(ndimage.distance_transform_edt(~known))
    return ndimage.median_filter(height[tuple(nearest)], 3), away * CELL_M
