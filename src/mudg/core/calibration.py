"""Cameras of a log against each other and against LiDAR: maps between their colours, and a test of their
calibration."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from itertools import combinations
from typing import Final

import numpy as np
from numpy.typing import NDArray

from mudg.base import geometry
from mudg.base.geometry import transform_points
from mudg.base.types import SAME_COLORS, CameraColors, ColorMap, View

# colours ------------------------------------------------------------------------------------------
# Cameras of a rig overlap little at one moment, but the front camera sees what the side cameras pass a little later. So
# every point is looked up in images of several moments. Photographs differ for other reasons too, so a map is used only
# where it explains a good part of the difference.


TRIM_DEVIATIONS: Final = 2.5
FEWEST_PAIRS: Final = 200
LEAST_CORRELATION: Final = 0.8
LEAST_GAIN: Final = 0.1
"""A map is used if it lowers the mean difference of colours by this share ..."""
LEAST_CHANGE: Final = 0.015
"""... and changes colours by this much, of 1, on average."""

Seen = Mapping[str, tuple[NDArray[np.integer], NDArray[np.uint8]]]
"""What cameras saw of one set of points: camera -> (numbers of points i64[n], their colours there u8[n, 3])."""


def color_map(given: NDArray[np.uint8], wanted: NDArray[np.uint8]) -> ColorMap:
    """The affine map per channel from colours u8[N, 3] to those of another camera, by trimmed orthogonal least squares:
    both sides are photographs, as noisy as each other, and plain least squares would find too little contrast.

    Six rounds, the first a guess from medians; each leaves out pairs that are farther than ``TRIM_DEVIATIONS`` robust
    standard deviations from the last line. The identity where there are fewer than ``FEWEST_PAIRS`` pairs.
    """
    usable = ((given > 4) & (given < 251) & (wanted > 4) & (wanted < 251)).all(1)
    x, y = given[usable] / 255.0, wanted[usable] / 255.0
    if len(x) < FEWEST_PAIRS:
        return ColorMap(pairs=len(x))
    gains, offsets = [], []
    for a, b in zip(x.T, y.T):
        gain, offset = 1.0, float(np.median(b) - np.median(a))
        for _ in range(5):
            error = np.abs(b - gain * a - offset)
            kept = error <= TRIM_DEVIATIONS * 1.4826 * max(float(np.median(error)), 1e-3)
            gain, offset = _line(a[kept], b[kept])
        gains.append(round(float(gain), 5))
        offsets.append(round(float(offset), 5))
    return ColorMap((gains[0], gains[1], gains[2]), (offsets[0], offsets[1], offsets[2]), len(x))


def _line(x: NDArray[np.float64], y: NDArray[np.float64]) -> tuple[float, float]:
    """Gain and offset of the line y = gain x + offset from which points are least far. Where the two are loosely
    correlated, so that no line stands out, the gain alone: the ratio of the means."""
    (xx, xy), (_, yy) = np.cov(x, y)
    if xy < LEAST_CORRELATION * math.sqrt(xx * yy) or xy <= 0:
        return float(y.mean() / x.mean()), 0.0
    gain = float((yy - xx + np.hypot(yy - xx, 2 * xy)) / (2 * xy))
    return gain, float(y.mean() - gain * x.mean())


def match_cameras(cameras: Iterable[str], seen: Iterable[Seen]) -> CameraColors:
    """The maps of those cameras whose colours differ to the first one's, along the pairs of cameras that share the most
    points of ``seen``: sets of points, each with what the cameras saw of it. A camera that shares too few points with
    the others keeps its colours, as if they were common ones."""
    names = tuple(cameras)
    given: dict[tuple[str, str], list[tuple[NDArray[np.uint8], NDArray[np.uint8]]]] = {}
    for points in seen:
        for a, b in combinations([name for name in names if name in points], 2):
            _, mine, theirs = np.intersect1d(points[a][0], points[b][0], assume_unique=True, return_indices=True)
            if len(mine):
                given.setdefault((a, b), []).append((points[a][1][mine], points[b][1][theirs]))
    pairs = {edge: tuple(np.concatenate(column) for column in zip(*parts)) for edge, parts in given.items()}
    reached: dict[str, ColorMap] = {names[0]: ColorMap()} if names else {}
    while True:
        edges = [
            (len(colors[0]), edge)
            for edge, colors in pairs.items()
            if (edge[0] in reached) != (edge[1] in reached) and len(colors[0]) >= FEWEST_PAIRS
        ]
        if not edges:
            break
        a, b = max(edges)[1]
        known, new = (a, b) if a in reached else (b, a)
        of = dict(zip((a, b), pairs[a, b]))
        reached[new] = _useful(color_map(of[new], of[known]), of[new], of[known]).then(reached[known])
    maps = {name: one for name, one in reached.items() if (one.gain, one.offset) != ((1.0,) * 3, (0.0,) * 3)}
    return CameraColors(names[0], maps) if maps else SAME_COLORS


def _useful(found: ColorMap, given: NDArray[np.uint8], wanted: NDArray[np.uint8]) -> ColorMap:
    """The map, or the identity where it does not explain enough of the difference (see ``LEAST_GAIN`` and
    ``LEAST_CHANGE``)."""
    same = ColorMap(pairs=found.pairs)
    if min(found.gain) <= 0.2 or max(found.gain) >= 5:
        return same
    x, y = given / 255.0, wanted / 255.0
    mapped = x * np.array(found.gain) + np.array(found.offset)
    before, after, change = (float(np.abs(e).mean()) for e in (x - y, mapped - y, mapped - x))
    return found if after <= (1 - LEAST_GAIN) * before and change >= LEAST_CHANGE else same


# edges --------------------------------------------------------------------------------------------
# Where a near surface ends before a far one, the image nearly always has an edge too. With the right calibration the
# near side of such jumps of depth falls on image edges more often than with the camera turned by a degree; so the mean
# edge strength under the jumps, as a function of a small extra turn, has its peak at no turn. Nothing is fitted.
#
# After J. Levinson and S. Thrun, Automatic online calibration of cameras and lasers, RSS 2013. Their scan-line
# neighbours are replaced by the nearest directions in a row, so that clouds need no ring numbers.


Floats = NDArray[np.float64]

TURNS_DEG: Final = (-2.0, -1.5, -1.0, -0.5, 0.0, 0.5, 1.0, 1.5, 2.0)
"""Extra turns tried, about the camera's vertical axis and about its horizontal one."""
MIN_JUMPS: Final = 150
"""Fewer depth jumps in all images of a camera say nothing."""
MIN_CONTRAST: Final = 0.06
"""The peak must stand out from the median by this share of it, else the images have too few edges, or too many."""
RIGHT_FROM: Final = 0.7
LARGEST_RIGHT_TURN_DEG: Final = 0.75
MIN_SIGMAS: Final = 1.5
"""A turn fits better than the given pose if the gain is this many of its standard errors: with few edges some turn
always leads."""
_CLUSTER_DEG: Final = 2.0
"""Jumps of one image within this much of azimuth are of one contour, mostly; they count as one observation."""
_JUMP_RATIO: Final = 0.12
_JUMP_M: Final = 0.6
_MAX_RANGE_M: Final = 60.0
_NEIGHBOURS: Final = 4
_ROW_PREFERENCE: Final = 4.0
_BLUR_DEG: Final = 0.2
_SLACK: Final = 0.05


@dataclass(frozen=True, slots=True)
class EdgeAlignment:
    """How well depth edges fall on image edges.

    ``score``: 1 = no turn fits better, 0 = no better than the median turn, below 0 = worse. ``best_turn_deg``: the turn
    that fits best, about the camera's y axis (right +) and its x axis (up +), by ``sigmas`` of its standard errors
    better than the given pose. ``contrast``: how far the peak stands out, as a share of the median. ``jumps``: depth
    jumps seen. ``verdict``: ``right``; ``doubtful`` if a turn inside the range tried fits clearly better; ``unknown``
    if edges do not tell.
    """

    score: float
    best_turn_deg: tuple[float, float]
    contrast: float
    jumps: int
    verdict: str
    sigmas: float = 0.0


def depth_jumps(xyz_lidar: NDArray[np.floating]) -> NDArray[np.intp]:
    """Indices of points [N, 3] (LiDAR frame, metres) beside which, in their row of the scan, the range jumps away from
    the sensor."""
    from scipy.spatial import KDTree

    xyz = np.asarray(xyz_lidar, np.float64)
    distance = np.linalg.norm(xyz, axis=1)
    usable = np.flatnonzero(distance > 1.0)
    if len(usable) <= _NEIGHBOURS:
        return usable[:0]
    xyz, distance = xyz[usable], distance[usable]
    azimuth = np.arctan2(xyz[:, 1], xyz[:, 0])
    elevation = np.arcsin(np.clip(xyz[:, 2] / distance, -1, 1))
    direction = np.stack([azimuth, _ROW_PREFERENCE * elevation], 1)
    apart, near = (np.asarray(found) for found in KDTree(direction).query(direction, _NEIGHBOURS + 1))
    step = np.median(apart[:, 1])
    behind = distance[near[:, 1:]] - distance[:, None]
    behind[apart[:, 1:] > 3 * step] = 0
    jump = behind.max(1) > np.maximum(_JUMP_M, _JUMP_RATIO * distance)
    return usable[jump & (distance < _MAX_RANGE_M)]


def edge_map(rgb: NDArray[np.uint8], blur_px: float) -> Floats:
    """Edge strength f64[H, W] of u8[H, W, 3]: gradient length, compressed so that one bright border does not outweigh
    all others, and spread by ``blur_px``."""
    from scipy.ndimage import gaussian_filter, sobel

    grey = gaussian_filter(rgb.astype(np.float64).mean(2), 1.0)
    strength = np.hypot(sobel(grey, 0), sobel(grey, 1))
    strength = strength / (strength + np.percentile(strength, 75) + 1e-6)
    return gaussian_filter(strength, blur_px)


def edge_alignment(shots: Iterable[tuple[View, NDArray[np.uint8], Floats, NDArray[np.floating]]]) -> EdgeAlignment:
    """Compare the given pose of a camera with slightly turned ones. ``shots``: for some images of one camera: view,
    image u8[H, W, 3], world_from_lidar f64[4, 4] of the sweep of that moment, and its points [N, 3] in the LiDAR
    frame."""
    parts: list[Floats] = []
    jumps = 0
    for view, rgb, world_from_lidar, xyz_lidar in shots:
        camera = view.camera
        edges = edge_map(rgb, max(0.5, np.deg2rad(_BLUR_DEG) * camera.fx))
        cam_from_lidar = view.cam_from_world @ world_from_lidar
        # points in the image or a little beside it: a neighbour of one in the image may lie outside
        x, y, z = transform_points(cam_from_lidar, xyz_lidar).T
        u, v = geometry.pinhole(camera.intrinsics, x, y, np.maximum(z, 1e-6))
        slack = _SLACK * max(camera.width, camera.height)
        beside = (u > -slack) & (u < camera.width + slack) & (v > -slack) & (v < camera.height + slack)
        around = np.asarray(xyz_lidar, np.float64)[(z > 1.0) & beside]
        xyz = transform_points(cam_from_lidar, around[depth_jumps(around)])
        sums, count = _turned_sums(edges, xyz, view)
        parts.append(sums)
        jumps += count
    return _judge(np.concatenate(parts, 1) if jumps else np.zeros((len(TURNS_DEG) ** 2, 0)), jumps)


def _turned_sums(edges: Floats, xyz_cam: Floats, view: View) -> tuple[Floats, int]:
    """Sums of edge strength under the points f64[turns, clusters] and the number of points; only those that stay in the
    image at all turns count."""
    camera = view.camera
    turned = [(_turn(about_y, about_x) @ xyz_cam.T) for about_y in TURNS_DEG for about_x in TURNS_DEG]
    places = [geometry.pinhole(camera.intrinsics, x, y, z.clip(1e-6)) for x, y, z in turned]
    u, v = (np.array(side) for side in zip(*places))
    inside = ((u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)).all(0)
    u, v = u[:, inside].astype(int), v[:, inside].astype(int)
    azimuth = np.rad2deg(np.arctan2(xyz_cam[inside, 0], xyz_cam[inside, 2]))
    first, cluster = np.unique(np.floor(azimuth / _CLUSTER_DEG), return_inverse=True)
    sums = [np.bincount(cluster, strength, len(first)) for strength in edges[v, u]]
    return np.array(sums, np.float64).reshape(len(places), len(first)), int(inside.sum())


def _turn(about_y_deg: float, about_x_deg: float) -> Floats:
    a, b = np.deg2rad(about_y_deg), np.deg2rad(about_x_deg)
    about_y = np.array([[np.cos(a), 0, np.sin(a)], [0, 1, 0], [-np.sin(a), 0, np.cos(a)]])
    about_x = np.array([[1, 0, 0], [0, np.cos(b), -np.sin(b)], [0, np.sin(b), np.cos(b)]])
    return about_y @ about_x


def _judge(sums: Floats, jumps: int) -> EdgeAlignment:
    """Verdict from the sums f64[turns, clusters] of all images."""
    if jumps == 0:
        return EdgeAlignment(0.0, (0.0, 0.0), 0.0, 0, "unknown")
    side = len(TURNS_DEG)
    mean = sums.sum(1) / jumps
    given, best = side * side // 2, int(mean.argmax())
    median, peak = float(np.median(mean)), float(mean[best])
    contrast = (peak - median) / max(median, 1e-9)
    score = (float(mean[given]) - median) / max(peak - median, 1e-12)
    turn = (TURNS_DEG[best // side], TURNS_DEG[best % side])
    gains = sums[best] - sums[given]
    sigmas = float(gains.sum() / max(np.sqrt((gains**2).sum()), 1e-12))
    # a maximum at the end of the range is a slope: edges get more towards there, whatever the pose
    inside = max(abs(angle) for angle in turn) < TURNS_DEG[-1]
    verdict = "unknown"
    if jumps >= MIN_JUMPS and contrast >= MIN_CONTRAST:
        if score >= RIGHT_FROM and np.hypot(*turn) <= LARGEST_RIGHT_TURN_DEG:
            verdict = "right"
        elif inside and sigmas >= MIN_SIGMAS:
            verdict = "doubtful"
    return EdgeAlignment(score, turn, contrast, jumps, verdict, sigmas)
