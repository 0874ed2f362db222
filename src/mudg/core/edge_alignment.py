"""Does the LiDAR fit the camera? Depth edges of sweeps against brightness edges of images, at the given and at turned poses.

Where a near surface ends before a far one, the image nearly always has an edge too. With the right calibration the near side
of such jumps falls on image edges more often than with the camera turned by a degree; so the mean edge strength under the
jumps, as a function of a small extra turn, has its peak at no turn. Nothing is fitted and no truth is needed.

Source of the idea: J. Levinson and S. Thrun, Automatic online calibration of cameras and lasers, RSS 2013. Their scan-line
neighbours are replaced by the nearest directions in a row, so that clouds need no ring numbers.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from mudg.base import geometry
from mudg.base.geometry import transform_points
from mudg.base.types import View

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
"""A turn fits better than the given pose if the gain is this many of its standard errors: with few edges some turn always leads."""
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

    Args:
        score: 1 = no turn fits better; 0 = no better than the median turn; below 0 = worse.
        best_turn_deg: the turn that fits best, about the camera's y axis (right +) and its x axis (up +), degrees.
        contrast: how far the peak stands out, as a share of the median.
        jumps: depth jumps seen.
        verdict: ``right``; ``doubtful`` if a turn inside the range tried fits clearly better; ``unknown`` if edges do not tell.
        sigmas: by how many of its standard errors ``best_turn_deg`` fits better than the given pose.
    """

    score: float
    best_turn_deg: tuple[float, float]
    contrast: float
    jumps: int
    verdict: str
    sigmas: float = 0.0


def depth_jumps(xyz_lidar: NDArray[np.floating]) -> NDArray[np.intp]:
    """Indices of points [N, 3] (LiDAR frame, metres) beside which, in their row of the scan, the range jumps away from the sensor."""
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
    """Edge strength f64[H, W] of u8[H, W, 3]: gradient length, compressed so that one bright border does not outweigh all others,
    and spread by ``blur_px``."""
    from scipy.ndimage import gaussian_filter, sobel

    grey = gaussian_filter(rgb.astype(np.float64).mean(2), 1.0)
    strength = np.hypot(sobel(grey, 0), sobel(grey, 1))
    strength = strength / (strength + np.percentile(strength, 75) + 1e-6)
    return gaussian_filter(strength, blur_px)


def edge_alignment(shots: Iterable[tuple[View, NDArray[np.uint8], Floats, NDArray[np.floating]]]) -> EdgeAlignment:
    """Compare the given pose of a camera with slightly turned ones.

    Args:
        shots: for some images of one camera: view, image u8[H, W, 3], world_from_lidar f64[4, 4] of the sweep of that moment, and
            its points [N, 3] in the LiDAR frame.
    """
    parts: list[Floats] = []
    jumps = 0
    for view, rgb, world_from_lidar, xyz_lidar in shots:
        camera = view.camera
        edges = edge_map(rgb, max(0.5, np.deg2rad(_BLUR_DEG) * camera.fx))
        cam_from_lidar = view.cam_from_world @ world_from_lidar
        around = np.asarray(xyz_lidar, np.float64)[_in_sight(transform_points(cam_from_lidar, xyz_lidar), view)]
        xyz = transform_points(cam_from_lidar, around[depth_jumps(around)])
        sums, count = _turned_sums(edges, xyz, view)
        parts.append(sums)
        jumps += count
    return _judge(np.concatenate(parts, 1) if jumps else np.zeros((len(TURNS_DEG) ** 2, 0)), jumps)


def _in_sight(xyz_cam: NDArray[np.floating], view: View) -> NDArray[np.bool_]:
    """Points in the image or a little beside it: a neighbour of one in the image may lie outside."""
    camera = view.camera
    slack = _SLACK * max(camera.width, camera.height)
    z = np.maximum(xyz_cam[:, 2], 1e-6)
    u, v = geometry.pinhole(camera.intrinsics, xyz_cam[:, 0], xyz_cam[:, 1], z)
    beside = (u > -slack) & (u < camera.width + slack) & (v > -slack) & (v < camera.height + slack)
    return (xyz_cam[:, 2] > 1.0) & beside


def _turned_sums(edges: Floats, xyz_cam: Floats, view: View) -> tuple[Floats, int]:
    """Sums of edge strength under the points f64[turns, clusters] and the number of points; only those that stay in the image
    at all turns count."""
    camera = view.camera
    places = []
    for about_y in TURNS_DEG:
        for about_x in TURNS_DEG:
            turned = xyz_cam @ _turn(about_y, about_x).T
            z = turned[:, 2].clip(1e-6)
            places.append(geometry.pinhole(camera.intrinsics, turned[:, 0], turned[:, 1], z))
    u, v = np.array([p[0] for p in places]), np.array([p[1] for p in places])
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
