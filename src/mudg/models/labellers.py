"""Labels for images that came without any: what LiDAR, tracked boxes and plain colour can tell, and how sure it is.

``geometry`` holds no parameters and needs no download. It knows few classes and says 255 (unlabelled) where it cannot tell:

* **road**: ground points (near a plane fitted to the LiDAR) and the image between and below them. Sidewalks are flat as well
  and are called road; far beside the path with less confidence. Green ground is **terrain**.
* **car, truck, bus, train, person, rider, ...**: tracked boxes projected into the image where nothing nearer stands.
* **sky**: bright or blue, smooth, above the horizon, joined to the top of the image, and without LiDAR returns.
* **vegetation**: what rises from the ground, or stands above the horizon, and is green.
* **building**: any other such thing. It means "something static that stands", not architecture.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.spatial import ConvexHull, QhullError, cKDTree

from mudg.base import geometry
from mudg.base.palette import ID, UNLABELLED
from mudg.base.types import Track, View
from mudg.core.fusion import FusionRules, hidden_points, points_in_box, standing_points

TRAIN_ID_OF: Final[Mapping[str, int]] = {
    "car": ID["car"], "van": ID["car"], "vehicle": ID["car"], "misc": ID["car"], "truck": ID["truck"], "bus": ID["bus"],
    "tram": ID["train"], "train": ID["train"], "person": ID["person"], "pedestrian": ID["person"],
    "person_sitting": ID["person"], "cyclist": ID["rider"], "rider": ID["rider"], "motorcycle": ID["motorcycle"],
    "motorcyclist": ID["rider"], "bicycle": ID["bicycle"],
}  # fmt: skip
"""Class of a tracked box by its label; labels not listed here are not painted."""

GAP_DEG: Final = 0.6
"""Beams of a turning LiDAR are at most this far apart; between two returns closer than this the surface goes on."""
GROUND_M: Final = 0.2
NEAR_ROAD_M: Final = 4.0
_GRASS: Final = 6.0
_THIN: Final = (ID["person"], ID["rider"], ID["bicycle"], ID["motorcycle"])


@dataclass(frozen=True, slots=True, eq=False)
class LabelInput:
    """What a labeller is given for one image.

    Args:
        view: camera and pose.
        rgb: u8[H, W, 3].
        xyz_world: f32[N, 3] metres: LiDAR returns of static things and of things as they stand at the image's time.
        tracks: tracked boxes.
        path_world: f64[M, 3], places of the vehicle.
    """

    view: View
    rgb: NDArray[np.uint8]
    xyz_world: NDArray[np.float32]
    tracks: Sequence[Track]
    path_world: NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class Labels:
    """``semantics`` u8[H, W] train ids, 255 = cannot tell; ``confidence`` f32[H, W] in 0..1; ``sky`` bool[H, W];
    ``depth`` f32[H, W] metres with NaN = unknown, and ``depth_confidence`` f32[H, W] in 0..1."""

    semantics: NDArray[np.uint8]
    confidence: NDArray[np.float32]
    sky: NDArray[np.bool_]
    depth: NDArray[np.float32]
    depth_confidence: NDArray[np.float32]


@dataclass(frozen=True, slots=True, eq=False)
class _Returns:
    """LiDAR returns that the image sees: rows and columns, depth, height above ground, distance to the path, all [n]."""

    row: NDArray[np.intp]
    column: NDArray[np.intp]
    depth_m: NDArray[np.float32]
    height_m: NDArray[np.float32]
    beside_m: NDArray[np.float32]
    xyz_world: NDArray[np.float32]


def label_by_geometry(given: LabelInput) -> Labels:
    """Label one image from LiDAR, boxes and colour; see the module text. Works, with less, without LiDAR or boxes."""
    height, width = given.rgb.shape[:2]
    ground = fit_ground(given.xyz_world, given.path_world)
    returns = _visible_returns(given, ground)
    gap_px = max(1.5, np.deg2rad(GAP_DEG) * given.view.camera.fy)
    away_px, nearest = _nearest_return(returns, (height, width))
    elevation = ray_elevation(given.view)
    sky = find_sky(given.rgb, elevation, away_px, gap_px)
    semantics = np.full((height, width), UNLABELLED, np.uint8)
    confidence = np.zeros((height, width), np.float32)
    if nearest is not None:
        _paint_returns(semantics, confidence, returns, nearest, away_px, gap_px, _greenness(given.rgb))
        _paint_road_below(semantics, confidence)
    standing = (semantics == UNLABELLED) & (elevation > 0) & ~sky
    green = _greenness(given.rgb) > 0
    semantics[standing] = np.where(green[standing], ID["vegetation"], ID["building"])
    confidence[standing] = 0.3
    semantics[sky], confidence[sky] = ID["sky"], 0.8
    depth = np.full((height, width), np.nan, np.float32) if nearest is None else returns.depth_m[nearest]
    for track in _far_to_near(given):
        _paint_box(semantics, confidence, track, given.view, returns, depth)
    sky &= semantics == ID["sky"]
    depth[sky] = np.nan
    depth_confidence = np.where(np.isfinite(depth), np.exp(-away_px / gap_px), 0).astype(np.float32)
    return Labels(semantics, confidence, sky, depth, depth_confidence)


LABELLERS: Mapping[str, Callable[[LabelInput], Labels]] = {"geometry": label_by_geometry}
"""Name -> labeller of one image."""


# --- ground and returns ---------------------------------------------------------------------------------------------


def fit_ground(
    xyz_world: NDArray[np.floating], path_world: NDArray[np.float64], reach_m: float = 40.0
) -> NDArray[np.float64] | None:
    """Ground plane z = a x + b y + c around the path, f64[3], or None with too few points to tell.

    Starts from the lowest returns of 2 m cells (their lower half by height), then least squares on what lies within
    0.5, 0.3 and 0.2 m of the plane. A slope above 20 percent is not believed.
    """
    if len(xyz_world) < 50 or len(path_world) == 0:
        return None
    xyz = np.asarray(xyz_world, np.float64)
    centre = path_world.mean(0)
    xyz = xyz[(np.abs(xyz[:, :2] - centre[:2]) < reach_m).all(1)]
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
        near = support[np.abs(support[:, 2] - _plane_z(plane, support)) < band_m]
        if len(near) < 10:
            return None
        design = np.c_[near[:, :2], np.ones(len(near))]
        plane = np.linalg.lstsq(design, near[:, 2], rcond=None)[0]
    return plane if np.hypot(plane[0], plane[1]) < 0.2 else None


def _plane_z(plane: NDArray[np.float64], xyz: NDArray[np.floating]) -> NDArray[np.float64]:
    return xyz[:, 0] * plane[0] + xyz[:, 1] * plane[1] + plane[2]


def _visible_returns(given: LabelInput, ground: NDArray[np.float64] | None) -> _Returns:
    camera = given.view.camera
    uv, z = geometry.project(given.view, given.xyz_world)
    with np.errstate(invalid="ignore"):
        inside = (z > 0.5) & (uv >= 0).all(1) & (uv[:, 0] < camera.width) & (uv[:, 1] < camera.height)
    xyz, uv, z = given.xyz_world[inside], uv[inside], z[inside].astype(np.float32)
    xyz_cam = geometry.transform_points(given.view.cam_from_world, xyz).astype(np.float32)
    seen = (
        ~hidden_points(xyz_cam, standing_points(xyz), given.view, 0.4, FusionRules(occlusion_relative=0.08))
        if len(xyz)
        else np.zeros(0, bool)
    )
    xyz, uv, z = xyz[seen], uv[seen], z[seen]
    height = (
        (xyz[:, 2] - _plane_z(ground, xyz)).astype(np.float32)
        if ground is not None
        else np.full(len(xyz), np.inf, np.float32)
    )
    beside = distance_to_path(xyz, given.path_world).astype(np.float32)
    return _Returns(uv[:, 1].astype(np.intp), uv[:, 0].astype(np.intp), z, height, beside, xyz)


def distance_to_path(xyz_world: NDArray[np.floating], path_world: NDArray[np.float64]) -> NDArray[np.float64]:
    """Horizontal distance of points ``[N, 3]`` to the driven path, gone on straight for 80 m at both ends; metres f64[N].

    A path shorter than half a metre has no direction; then it is the distance to its first place.
    """
    if len(path_world) == 0 or len(xyz_world) == 0:
        return np.zeros(len(xyz_world))
    far = np.flatnonzero(np.linalg.norm(path_world[:, :2] - path_world[0, :2], axis=1) > 0.5)
    if len(far) == 0:
        return np.linalg.norm(xyz_world[:, :2] - path_world[0, :2], axis=1)
    forward = path_world[far[0], :2] - path_world[0, :2]
    back = np.flatnonzero(np.linalg.norm(path_world[:, :2] - path_world[-1, :2], axis=1) > 0.5)[-1]
    onward = path_world[-1, :2] - path_world[back, :2]
    reach = np.arange(80.0, 0, -2.0)[:, None]
    before = path_world[0, :2] - reach * forward / np.linalg.norm(forward)
    after = path_world[-1, :2] + reach[::-1] * onward / np.linalg.norm(onward)
    line = np.concatenate([before, path_world[:, :2], after])
    return cKDTree(line).query(xyz_world[:, :2])[0]


def _nearest_return(returns: _Returns, shape: tuple[int, int]) -> tuple[NDArray[np.float32], NDArray[np.intp] | None]:
    """Distance in pixels to the nearest return f32[H, W], and which it is; infinitely far without returns."""
    if len(returns.row) == 0:
        return np.full(shape, np.inf, np.float32), None
    which = np.full(shape, -1, np.intp)
    order = np.argsort(-returns.depth_m, kind="stable")
    which[returns.row[order], returns.column[order]] = order
    away, index = ndimage.distance_transform_edt(which < 0, return_indices=True)
    return away.astype(np.float32), which[index[0], index[1]]


def ray_elevation(view: View) -> NDArray[np.float32]:
    """Elevation of each pixel's ray above the horizontal plane, radians, f32[H, W]."""
    camera = view.camera
    x = (np.arange(camera.width) + 0.5 - camera.cx) / camera.fx
    y = (np.arange(camera.height) + 0.5 - camera.cy) / camera.fy
    up = view.world_from_cam[2, :3]
    rise = up[0] * x[None] + up[1] * y[:, None] + up[2]
    return np.arcsin(rise / np.sqrt(1 + x[None] ** 2 + y[:, None] ** 2)).astype(np.float32)


# --- painting -------------------------------------------------------------------------------------------------------


def _paint_returns(
    semantics: NDArray[np.uint8], confidence: NDArray[np.float32], returns: _Returns, nearest: NDArray[np.intp],
    away_px: NDArray[np.float32], gap_px: float, greenness: NDArray[np.float32],
) -> None:  # fmt: skip
    """Each pixel within a beam's gap of a return takes what the return stands for."""
    is_ground = np.abs(returns.height_m) < GROUND_M + 0.005 * returns.depth_m
    covered = away_px <= gap_px
    ground_here = is_ground[nearest] & covered
    beside = returns.beside_m[nearest]
    semantics[ground_here] = np.where(greenness[ground_here] > _GRASS, ID["terrain"], ID["road"])
    closeness = 1 - 0.5 * away_px / gap_px
    confidence[ground_here] = (np.where(beside < NEAR_ROAD_M, 0.9, 0.5) * closeness)[ground_here]
    standing = covered & ~ground_here
    semantics[standing] = np.where(greenness[standing] > 0, ID["vegetation"], ID["building"])
    confidence[standing] = 0.5 * closeness[standing]


def _paint_road_below(semantics: NDArray[np.uint8], confidence: NDArray[np.float32]) -> None:
    """The part of the image below the lowest beam is road where the lowest label above it is road."""
    height = semantics.shape[0]
    labelled = semantics != UNLABELLED
    last = height - 1 - labelled[::-1].argmax(0)
    columns = np.flatnonzero(labelled.any(0))
    columns = columns[semantics[last[columns], columns] == ID["road"]]
    below = np.zeros(semantics.shape, bool)
    below[:, columns] = np.arange(height)[:, None] > last[columns][None]
    semantics[below] = ID["road"]
    confidence[below] = 0.5


def _far_to_near(given: LabelInput) -> list[Track]:
    here = given.view.center_world
    present = [(track, track.pose_at(given.view.time_s)) for track in given.tracks if track.label in TRAIN_ID_OF]
    placed = [(float(np.linalg.norm(pose[:3, 3] - here)), track) for track, pose in present if pose is not None]
    return [track for _, track in sorted(placed, key=lambda item: -item[0])]


def _paint_box(
    semantics: NDArray[np.uint8], confidence: NDArray[np.float32], track: Track, view: View, returns: _Returns, depth: NDArray[np.float32]
) -> None:  # fmt: skip
    """Paint a tracked box: surely where returns lie in it, less surely in the rest of its outline; not behind nearer things."""
    pose = track.pose_at(view.time_s)
    if pose is None:
        return
    outline = box_outline(view, pose, track.size_m)
    if outline is None:
        return
    reach = max(1, round(float(np.deg2rad(GAP_DEG)) * view.camera.fy / 2))
    rows, columns = (_span(outline.any(axis), reach) for axis in (1, 0))
    outline, depth, semantics, confidence = (m[rows, columns] for m in (outline, depth, semantics, confidence))
    half_diagonal = float(np.linalg.norm(track.size_m)) / 2
    middle = float((view.cam_from_world @ pose)[2, 3])
    in_front = np.isfinite(depth) & (depth < middle - half_diagonal)
    near = np.flatnonzero(np.abs(returns.depth_m - middle) <= half_diagonal + 0.5)
    local = geometry.transform_points(geometry.invert(pose), returns.xyz_world[near])
    inside = near[points_in_box(local, track.size_m, 0.1, 0.1)]
    sure = np.zeros((view.camera.height, view.camera.width), bool)
    sure[returns.row[inside], returns.column[inside]] = True
    sure = _at_edges_too(ndimage.binary_closing, sure[rows, columns], reach) & outline
    if len(inside) == 0 and np.isfinite(depth).any():
        return  # the LiDAR sees around there and nothing is in the box: it is hidden, or empty
    label = TRAIN_ID_OF[track.label]
    road_before_it = (semantics == ID["road"]) & (confidence > 0.4) & (depth < middle + half_diagonal)
    fill = outline & ~in_front & ~road_before_it
    if label in _THIN and len(inside):
        fill &= ndimage.binary_dilation(sure, iterations=max(1, reach // 2))  # they fill little of their boxes
    semantics[fill], confidence[fill] = label, 0.5
    semantics[sure], confidence[sure] = label, 0.9


def _span(present: NDArray[np.bool_], margin: int) -> slice:
    """From the first to the last true entry, and ``margin`` more on either side."""
    at = np.flatnonzero(present)
    return slice(max(0, int(at[0]) - margin), int(at[-1]) + margin + 1)


def box_outline(
    view: View, world_from_box: NDArray[np.float64], size_m: NDArray[np.float64]
) -> NDArray[np.bool_] | None:
    """Convex outline of a projected box bool[H, W], cut at the camera's near plane; None if it lies outside the image."""
    camera = view.camera
    signs = np.array([[i, j, k] for i in (-1, 1) for j in (-1, 1) for k in (-1, 1)]) / 2
    corners = geometry.transform_points(view.cam_from_world @ world_from_box, signs * size_m)
    corners = _clipped_corners(corners)
    if corners is None:
        return None
    uv = np.c_[
        camera.fx * corners[:, 0] / corners[:, 2] + camera.cx, camera.fy * corners[:, 1] / corners[:, 2] + camera.cy
    ]
    if (uv.max(0) < 0).any() or uv[:, 0].min() > camera.width or uv[:, 1].min() > camera.height:
        return None
    try:
        hull = ConvexHull(np.clip(uv, -1e5, 1e5))
    except QhullError:
        return None
    u, v = np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5
    mask = np.ones((camera.height, camera.width), bool)
    for a, b, c in hull.equations:
        mask &= a * u[None] + b * v[:, None] + c <= 0
    return mask if mask.any() else None


def _clipped_corners(corners: NDArray[np.float64], near_m: float = 0.3) -> NDArray[np.float64] | None:
    """Corners of a box cut at the near plane: those in front, and where its edges cross the plane."""
    front = corners[:, 2] >= near_m
    if not front.any():
        return None
    points = [corners[front]]
    for i in range(8):
        for j in (i ^ 1, i ^ 2, i ^ 4):
            if front[i] and not front[j]:
                u = (near_m - corners[i, 2]) / (corners[j, 2] - corners[i, 2])
                points.append(corners[i : i + 1] + u * (corners[j : j + 1] - corners[i : i + 1]))
    return np.concatenate(points)


# --- colour ---------------------------------------------------------------------------------------------------------


def _greenness(rgb: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Positive where a smoothed pixel is green rather than red or blue, or the dark mottled colour of leaves; f32[H, W]."""
    smooth = ndimage.uniform_filter(rgb.astype(np.float32), (5, 5, 1))
    red, green, blue = smooth[..., 0], smooth[..., 1], smooth[..., 2]
    return green - np.maximum(red * 0.97, blue * 1.04) - 1.5


def find_sky(
    rgb: NDArray[np.uint8], elevation: NDArray[np.float32], away_px: NDArray[np.float32], gap_px: float
) -> NDArray[np.bool_]:
    """Sky mask bool[H, W]: above the horizon, without returns, bright or blue, smooth, joined to the top of the image.

    Args:
        rgb: u8[H, W, 3].
        elevation: of the rays, radians, f32[H, W].
        away_px: distance to the nearest LiDAR return f32[H, W].
        gap_px: sky is looked for farther from returns than this, and then grown up to them where it looks the same.
    """
    candidates = (elevation > 0) & (away_px > gap_px)
    if not candidates.any():
        return candidates
    smooth = ndimage.uniform_filter(rgb.astype(np.float32), (3, 3, 1))
    blueness = smooth[..., 2] - smooth[..., 0]
    score = smooth.max(2) + 1.5 * np.clip(blueness, 0, 60)
    threshold = _two_group_threshold(score[candidates])
    rough = ndimage.gaussian_gradient_magnitude(smooth.mean(2), 1.0) > 20
    looks_so = (score > threshold) & (blueness > -25) & ~rough
    sky = _at_edges_too(ndimage.binary_opening, candidates & looks_so)
    pieces, _ = ndimage.label(sky)
    top = np.flatnonzero(candidates.any(1))[0]
    joined = np.unique(pieces[top : top + 3])
    large = np.flatnonzero(np.bincount(pieces.ravel()) > 0.002 * sky.size)
    keep = np.union1d(joined, large)
    sky = np.isin(pieces, keep[keep > 0])
    if not sky.any():
        return sky
    sky = _at_edges_too(ndimage.binary_closing, sky) & candidates
    free = (elevation > 0) & (away_px > 1.5)
    return ndimage.binary_dilation(sky, iterations=int(np.ceil(gap_px)) + 1, mask=free & (looks_so | sky))


def _at_edges_too(
    morphology: Callable[..., NDArray[np.bool_]], mask: NDArray[np.bool_], reach_px: int = 1
) -> NDArray[np.bool_]:
    """Opening or closing by a square, the image going on beyond its edges as it ends there."""
    grown = reach_px + 1
    padded = morphology(np.pad(mask, grown, mode="edge"), np.ones((3, 3), bool), iterations=reach_px)
    return padded[grown:-grown, grown:-grown]


def _two_group_threshold(values: NDArray[np.float32]) -> float:
    """The level that splits values into two groups of least inner variance; at least a modest brightness of 90."""
    counts, edges = np.histogram(values, 128)
    centers = (edges[:-1] + edges[1:]) / 2
    below = np.cumsum(counts)[:-1].astype(np.float64)
    above = counts.sum() - below
    sum_below = np.cumsum(counts * centers)[:-1]
    mean_below = sum_below / np.maximum(below, 1)
    mean_above = ((counts * centers).sum() - sum_below) / np.maximum(above, 1)
    between = below * above * (mean_above - mean_below) ** 2
    best = int(between.argmax())
    if mean_above[best] - mean_below[best] < 40:  # one group only: all sky if bright, none if dark
        return 90.0 if centers[int(counts.argmax())] > 150 else float("inf")
    return max(float(edges[best + 1]), 90.0)
