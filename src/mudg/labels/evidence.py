"""Measured facts about each pixel, from LiDAR, calibration, driven path and boxes, as input planes for a segmentation
network. Unlike colours, these numbers mean the same in a generated city and in a recorded log. Depth is filled from the
returns, also in the sky; ``away_deg`` says how far the nearest return is."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.spatial import cKDTree

from mudg.base.palette import ID
from mudg.core.depth import complete_depth, ray_elevation
from mudg.labels.inputs import LabelInput, surface_points

BOX_GROUPS: Final = (("car",), ("truck",), ("bus", "train"), ("person",), ("rider", "motorcycle", "bicycle"))
"""Classes of boxes that share a plane."""
GROUP_OF: Final[Mapping[int, int]] = {ID[name]: n for n, names in enumerate(BOX_GROUPS) for name in names}
"""Number of the group of each class that boxes have."""
PLANES: Final = (
    *("height, fine", "height", "log depth", "distance to a return", "upwards", "beside the path", "elevation"),
    *("silent", "roughness", "measured at all", "reachable from the path", "raised"),
)
"""Planes that ``encode`` makes, before one for each of ``BOX_GROUPS``."""
PLANE_COUNT: Final = len(PLANES) + len(BOX_GROUPS)
NO_PATH_M: Final = 60.0
_MAX_BOXES: Final = 250
_OUTLINE: Final = 0.4
"""Plane of a box where only its outline is known, beside 1 where the surface lies in it."""


@dataclass(frozen=True, slots=True, eq=False)
class Evidence:
    """Measured facts per pixel [H, W]; where there are no returns at all, ``depth_m`` is NaN and what follows from it
    is 0. ``height_m``: above the ground plane (0 where no plane was found). ``depth_m``: dense camera z. ``away_deg``:
    angle to the nearest return, at most 90. ``upwards``: upward part of the surface's normal, 0..1. ``beside_m``:
    horizontal distance to the driven path. ``reachable``: ground that is reached from the path without a step;
    ``direct``: and that without much of a detour (not given to the network). ``raised_m``: above the lowest ground
    within 3 m, 0 where it is no ground. ``elevation_rad``: of the pixel's ray above the horizontal. ``silent``: the
    scanner looked, above the road, and nothing came back. ``rough``: spread of the logarithm of measured depth around a
    local plane. ``box``: 1 + place in ``box_labels`` (train ids i64[N]) of the nearest box seen here, 0 = none.
    ``in_box``: the surface lies in that box; else the pixel is only in its outline."""

    height_m: NDArray[np.float32]
    depth_m: NDArray[np.float32]
    away_deg: NDArray[np.float32]
    upwards: NDArray[np.float32]
    beside_m: NDArray[np.float32]
    reachable: NDArray[np.bool_]
    direct: NDArray[np.bool_]
    raised_m: NDArray[np.float32]
    elevation_rad: NDArray[np.float32]
    silent: NDArray[np.bool_]
    rough: NDArray[np.float32]
    box: NDArray[np.uint8]
    in_box: NDArray[np.bool_]
    box_labels: NDArray[np.int64]


def gather(inputs: LabelInput) -> Evidence:
    """Facts at every pixel of ``inputs.view``; works, with less, without returns, path or boxes."""
    view, measured = inputs.view, inputs.measured()
    known, shape = np.isfinite(measured), measured.shape
    elevation = ray_elevation(view)
    zero, none = np.zeros(shape, np.float32), np.zeros(shape, bool)
    if not known.any():
        unknown, boxes = np.full(shape, np.nan, np.float32), _boxes(inputs, None, measured, known)
        return Evidence(zero, unknown, zero + 90, zero, zero, none, none, zero, elevation, none, zero, *boxes)
    away_px = np.asarray(ndimage.distance_transform_edt(~known), np.float32)
    beyond = inputs.beyond(measured)
    depth = complete_depth(inputs.rgb, measured, None, beyond).depth
    xyz = surface_points(view, depth)
    normal = np.cross(np.gradient(xyz, axis=1), np.gradient(xyz, axis=0))
    upwards = np.abs(normal[..., 2]) / np.maximum(np.linalg.norm(normal, axis=2), 1e-9)
    ground = map_ground(inputs.xyz_world, inputs.path_world, view.center_world)
    height = zero if ground is None else np.clip(above_plane(ground.plane, xyz), -60, 60).astype(np.float32)
    under = (none, none, zero) if ground is None else ground.under(xyz)
    beside = beside_path(xyz, inputs.path_world, 2) if len(inputs.path_world) else np.full(shape, NO_PATH_M, np.float32)
    away_deg = np.minimum(np.rad2deg(away_px / view.camera.fy), 90).astype(np.float32)
    rough = _roughness(measured, inputs.beam_gap_deg, view.camera.fy)
    seen = (height, depth, away_deg, upwards.astype(np.float32), beside, *under, elevation, beyond, rough)
    return Evidence(*seen, *_boxes(inputs, xyz, depth, known))


def encode(evidence: Evidence) -> NDArray[np.float32]:
    """Facts as planes of about unit size f32[C, H, W], in the order of ``PLANES`` and then ``BOX_GROUPS``."""
    known = np.isfinite(evidence.depth_m)
    depth = np.where(known, evidence.depth_m, 20)
    planes = [
        np.tanh(evidence.height_m / 0.3),
        np.tanh(evidence.height_m / 4),
        np.log(depth / 20) / 1.5,
        np.where(known, np.tanh(evidence.away_deg / 1.5), 1),
        evidence.upwards,
        np.tanh(evidence.beside_m / 12),
        np.clip(evidence.elevation_rad / 0.4, -2, 2),
        evidence.silent,
        np.tanh(evidence.rough / 0.04),
        known,
        evidence.reachable,
        np.tanh(evidence.raised_m / 0.15),
    ]
    group = np.full(256, 255)
    group[1 : 1 + len(evidence.box_labels)] = [GROUP_OF[int(label)] for label in evidence.box_labels]
    group_here = group[evidence.box]
    certainty = np.where(evidence.in_box, 1, _OUTLINE)
    planes += [np.where(group_here == n, certainty, 0) for n in range(len(BOX_GROUPS))]
    return np.stack(planes).astype(np.float32)


# --- the facts ------------------------------------------------------------------------------------


def _roughness(measured: NDArray[np.float32], gap_deg: float, fy_px: float) -> NDArray[np.float32]:
    """Spread of the logarithm of measurements around the plane that fits them best in a window of about four beams."""
    known = np.isfinite(measured)
    reach = max(3, round(2.0 * np.deg2rad(gap_deg) * fy_px))
    value = np.where(known, np.log(np.where(known, measured, 1)), 0)
    rows, columns = np.indices(measured.shape)
    u, v = columns - measured.shape[1] / 2, rows - measured.shape[0] / 2
    mean = lambda x: ndimage.uniform_filter(np.where(known, x, 0).astype(np.float64), 2 * reach + 1)
    count = np.maximum(mean(np.ones_like(value)), 1e-9)
    mu, mv, md = mean(u) / count, mean(v) / count, mean(value) / count
    uu, vv, uv = mean(u * u) / count - mu**2 + 1, mean(v * v) / count - mv**2 + 1, mean(u * v) / count - mu * mv
    ud, vd, dd = mean(u * value) / count - mu * md, mean(v * value) / count - mv * md, mean(value**2) / count - md**2
    det = uu * vv - uv**2
    a, b = (vv * ud - uv * vd) / det, (uu * vd - uv * ud) / det
    left = np.maximum(dd - a * ud - b * vd, 0)
    enough = count * (2 * reach + 1) ** 2 >= 6
    return np.where(enough, np.sqrt(left), 0).astype(np.float32)


def _boxes(
    inputs: LabelInput, xyz: NDArray[np.float32] | None, depth: NDArray[np.float32], known: NDArray[np.bool_]
) -> tuple[NDArray[np.uint8], NDArray[np.bool_], NDArray[np.int64]]:
    """Nearest tracked box of each pixel, see ``Evidence``: where the surface lies in it, or, with nothing nearer, in
    its outline. A box without a return in it is left out where there are returns at all: it is hidden, or empty."""
    view = inputs.view
    box, in_box = np.zeros(depth.shape, np.uint8), np.zeros(depth.shape, bool)
    labels: list[int] = []
    for placed in inputs.far_to_near()[-_MAX_BOXES:]:
        outline = placed.outline(view)
        if outline is None:
            continue
        reach = float(np.linalg.norm(placed.track.size_m)) / 2
        seen = np.nonzero(outline & ~(depth < placed.depth_m(view) - reach))
        if len(seen[0]) == 0:
            continue
        inside = np.zeros(len(seen[0]), bool)
        if xyz is not None:
            inside = placed.contains(xyz[seen])
            if not known[seen][inside].any():
                continue
        labels.append(placed.train_id)
        free = inside | ~in_box[seen]  # what lies in a farther box is not taken by the outline of a nearer one
        box[seen] = np.where(free, len(labels), box[seen])
        in_box[seen] |= inside
    return box, in_box, np.array(labels, np.int64)


# the ground around a vehicle: its plane, and the part that is reached from the path without a step -

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
    0.5, 0.3 and 0.2 m of the plane. A slope above 20 percent is not believed."""
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
    f64[N]. A path shorter than half a metre has no direction (``driven_path`` gives it one); then it is the distance to
    its first place."""
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
    """Ground around a camera from above: cell [i, j] is ``CELL_M`` wide and begins at ``corner_m + CELL_M * (i, j)``
    (world x and y, f64[2]); ``plane`` of ``fit_ground``. Of each cell: whether it is ``reachable`` from the driven path
    over known ground without a step, and that ``direct``, without much of a detour (one lowered kerb joins a whole
    sidewalk, but not directly); and ``raised_m``, its height above the lowest ground within 3 m, 0 where unknown."""

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
    """Map of the ground within ``REACH_M`` of a place f64[3], from returns ``[N, 3]`` and places of the vehicle f64[M,
    3]; None without a ground plane."""
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
    Cells are reached in turns of four and of eight neighbours, which measures lengths to 8 percent."""
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
