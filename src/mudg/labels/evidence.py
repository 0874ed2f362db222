"""Measured facts about each pixel, from LiDAR, calibration, driven path and boxes, as input planes for a segmentation
network.

Unlike colours, these numbers mean the same in a generated city and in a recorded log: height above the ground, distance
to the camera and to the driven path, whether a kerb lies between, surface orientation, roughness of the returns,
distance to the nearest return, elevation of the ray, and the tracked boxes that contain the pixel.

Depth is filled from the returns at the size of the given view, also in the sky; ``away_deg`` says how far the nearest
return is.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from mudg.base.palette import ID
from mudg.core.depth import beyond_reach, complete_depth, ray_elevation
from mudg.core.project import RULES as HIDING_RULES
from mudg.core.project import visible_depth
from mudg.labels.ground import above_plane, beside_path, map_ground
from mudg.labels.inputs import LabelInput, far_to_near, surface_points

BOX_GROUPS: Final = (("car",), ("truck",), ("bus", "train"), ("person",), ("rider", "motorcycle", "bicycle"))
"""Classes of boxes that share a plane."""
GROUP_OF: Final[Mapping[int, int]] = {ID[name]: n for n, names in enumerate(BOX_GROUPS) for name in names}
"""Number of the group of each class that boxes have."""
PLANES: Final = (
    *(
        "height, fine",
        "height",
        "log depth",
        "distance to a return",
        "upwards",
        "beside the path",
        "elevation",
        "silent",
    ),
    *("roughness", "measured at all", "reachable from the path", "raised"),
)
"""Planes that ``encode`` makes, before one for each of ``BOX_GROUPS``."""
PLANE_COUNT: Final = len(PLANES) + len(BOX_GROUPS)
NO_PATH_M: Final = 60.0
_MAX_BOXES: Final = 250
_OUTLINE: Final = 0.4
"""Plane of a box where only its outline is known, beside 1 where the surface lies in it."""


@dataclass(frozen=True, slots=True, eq=False)
class Evidence:
    """Measured facts per pixel; where there are no returns at all, ``depth_m`` is NaN and what follows from it is 0.

    Args:
        height_m: above the ground plane f32[H, W] (0 where no plane was found).
        depth_m: dense camera z f32[H, W].
        away_deg: angle to the nearest return f32[H, W], at most 90.
        upwards: upward part of the surface's normal f32[H, W], 0..1.
        beside_m: horizontal distance to the driven path f32[H, W].
        elevation_rad: of the pixel's ray above the horizontal f32[H, W].
        reachable: bool[H, W], ground that is reached from the driven path without a step.
        direct: bool[H, W], and that without much of a detour (not given to the network).
        raised_m: above the lowest ground within 3 m f32[H, W], 0 where it is no ground.
        silent: bool[H, W], the scanner looked, above the road, and nothing came back.
        rough: spread of the logarithm of measured depth around a local plane f32[H, W].
        box: u8[H, W], 1 + place in ``box_labels`` of the nearest box seen here, 0 = none.
        in_box: bool[H, W], the surface lies in that box; else the pixel is only in its outline.
        box_labels: i64[N] train ids of the boxes.
    """

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
    view, gap_deg = inputs.view, inputs.beam_gap_deg
    measured = visible_depth(view, inputs.xyz_world, HIDING_RULES["sweep"], gap_deg=gap_deg)
    known = np.isfinite(measured)
    shape = measured.shape
    elevation = ray_elevation(view)
    zero, none = np.zeros(shape, np.float32), np.zeros(shape, bool)
    if not known.any():
        unknown, boxes = np.full(shape, np.nan, np.float32), _boxes(inputs, None, measured, known)
        return Evidence(zero, unknown, zero + 90, zero, zero, none, none, zero, elevation, none, zero, *boxes)
    away_px = np.asarray(ndimage.distance_transform_edt(~known), np.float32)
    beyond = beyond_reach(view, measured, inputs.highest_rad, gap_deg=gap_deg)
    depth = complete_depth(inputs.rgb, measured, None, beyond).depth
    xyz = surface_points(view, depth)
    ground = map_ground(inputs.xyz_world, inputs.path_world, view.center_world)
    height = zero if ground is None else np.clip(above_plane(ground.plane, xyz), -60, 60).astype(np.float32)
    under = (none, none, zero) if ground is None else ground.under(xyz)
    beside = beside_path(xyz, inputs.path_world, 2) if len(inputs.path_world) else np.full(shape, NO_PATH_M, np.float32)
    away_deg = np.minimum(np.rad2deg(away_px / view.camera.fy), 90).astype(np.float32)
    rough = _roughness(measured, gap_deg, view.camera.fy)
    seen = (height, depth, away_deg, _upwards(xyz), beside, *under, elevation, beyond, rough)
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


def _upwards(xyz: NDArray[np.float32]) -> NDArray[np.float32]:
    right, down = np.gradient(xyz, axis=1), np.gradient(xyz, axis=0)
    normal = np.cross(right, down)
    return (np.abs(normal[..., 2]) / np.maximum(np.linalg.norm(normal, axis=2), 1e-9)).astype(np.float32)


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
    its outline.

    A box without a return in it is left out where there are returns at all: it is hidden, or empty.
    """
    view = inputs.view
    box, in_box = np.zeros(depth.shape, np.uint8), np.zeros(depth.shape, bool)
    labels: list[int] = []
    for placed in far_to_near(inputs)[-_MAX_BOXES:]:
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
