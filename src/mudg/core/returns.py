"""What beams meet in a cloud of LiDAR returns, as seen from one place.

Directions stand in for beams: of the returns that lie around a beam, those of the first surface are joined by a plane,
and the beam's range is where it meets that plane. In the tangent plane of a beam inverse depth is affine on planes, so
the plane is a weighted straight-line fit, exact on roads that a beam grazes. LiDARsim (Manivasagam et al. 2020) meets
discs made of the same returns; discs of a noisy surface hide each other, and the nearest wins.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

Floats = NDArray[np.float64]
NEIGHBOURS: Final = 12
REACH_RAD: Final = float(np.radians(0.8))
"""Returns farther from a beam than this do not tell what it meets."""
ONE_PLANE: Final = 0.02
"""Mean relative error of a plane above which the returns around a beam may lie on two surfaces,"""
LAYER_GAP: Final = 0.04
"""if two of them, next to each other in depth, differ by at least this share."""
NEARER: Final = 1.3
"""The front surface is met unless its nearest return is this much farther from the beam than the back one's."""
HELD: Final = 0.001
"""How much slopes are held towards 0, as a share of the weights."""
OUTLIER: Final = 0.01
"""Relative error at which a return counts half."""
BEHIND: Final = 1.2
"""A beam that was lost this far behind a surface says nothing about it."""


@dataclass(frozen=True, slots=True, eq=False)
class Returns:
    """Returns of one sweep in one frame, and beams that were lost.

    Args:
        xyz: f64[N, 3] metres. seen_from: f64[3], where the sensor was. intensity: f32[N] in [0, 1], NaN where a beam
            was lost.
    """

    xyz: Floats
    seen_from: Floats
    intensity: NDArray[np.float32]

    def __len__(self) -> int:
        return len(self.xyz)

    def taken(self, rows: NDArray[np.integer] | NDArray[np.bool_]) -> Returns:
        """Some of them."""
        return Returns(self.xyz[rows], self.seen_from, self.intensity[rows])


@dataclass(frozen=True, slots=True, eq=False)
class Met:
    """What B beams met.

    Args:
        range_m: f64[B], NaN where no return is within reach. facing: f64[B], cosine between beam and surface.
        nearest_rad: f64[B], angle to the nearest return, infinite where there is none. spacing_rad: f64[B], the middle
            angle to the neighbours. one_sided: f64[B] in [0, 1], how much they lie to one side of the beam.
        heard, lost: f64[B], how many returns and lost beams are around, each counted by its angle. intensity: f64[B].
        nearest: i64[B], number of the return that counts most, -1: none.
    """

    range_m: Floats
    facing: Floats
    nearest_rad: Floats
    spacing_rad: Floats
    one_sided: Floats
    heard: Floats
    lost: Floats
    intensity: Floats
    nearest: NDArray[np.int64]

    @classmethod
    def nothing(cls, count: int) -> Met:
        """Beams that met nothing."""
        nan, none = (np.full((4, count), value) for value in (np.nan, np.inf))
        heard, lost, light = np.zeros((3, count))
        return cls(nan[0], nan[1], none[0], none[1], nan[2], heard, lost, light, np.full(count, -1))

    def put(self, own: NDArray[np.int64], part: Met) -> None:
        """Write what some of the beams met."""
        for name in self.__dataclass_fields__:
            getattr(self, name)[own] = getattr(part, name)


def first_surface(beams: Floats, xyz: Floats, intensity: Floats, trust: Floats) -> Met:
    """What beams meet first.

    Args:
        beams: unit directions f64[B, 3] from the origin. xyz: returns f64[N, 3] in the same frame, none at the origin.
        intensity: f64[N], NaN where a beam was lost. trust: f64[N], how much each counts.
    """
    heard = np.flatnonzero(np.isfinite(intensity))
    met = _surface(beams, xyz[heard], intensity[heard], trust[heard])
    met.nearest[:] = np.where(met.nearest >= 0, np.append(heard, -1)[met.nearest], -1)
    silent = np.isnan(intensity)
    if silent.any():
        met.lost[:] = _lost(beams, xyz[silent], trust[silent], met)
    return met


def _lost(beams: Floats, xyz: Floats, trust: Floats, met: Met) -> Floats:
    """Lost beams around beams f64[B], each counted by its angle for the spacing of the returns."""
    away = np.sqrt(np.einsum("ij,ij->i", xyz, xyz))  # faster than norm
    count = min(NEIGHBOURS, len(xyz))
    query = KDTree(xyz / away[:, None], balanced_tree=False, compact_nodes=False).query
    gaps, rows = (
        np.asarray(a).reshape(len(beams), count)
        for a in query(beams, count, distance_upper_bound=REACH_RAD, workers=-1)
    )
    known = np.isfinite(gaps)
    rows = np.where(known, rows, 0)
    spacing = np.where(np.isfinite(met.spacing_rad), met.spacing_rad, REACH_RAD / 2)[:, None]
    with np.errstate(invalid="ignore"):
        behind = away[rows] > BEHIND * met.range_m[:, None] + 1
    near = np.exp(-0.5 * (np.where(known, gaps, 0) / spacing) ** 2) * trust[rows]
    return np.where(known & ~behind, near, 0.0).sum(1)


def _surface(beams: Floats, xyz: Floats, intensity: Floats, trust: Floats) -> Met:
    found = Met.nothing(len(beams))
    if len(xyz) < NEIGHBOURS or not len(beams):
        return found
    away = np.sqrt(np.einsum("ij,ij->i", xyz, xyz))  # faster than norm
    directions = xyz / away[:, None]
    tree = KDTree(directions, balanced_tree=False, compact_nodes=False)
    gaps, rows = map(np.asarray, tree.query(beams, NEIGHBOURS, distance_upper_bound=REACH_RAD, workers=-1))
    own = np.flatnonzero(np.isfinite(gaps[:, 0]))
    if not len(own):
        return found
    known = np.isfinite(gaps[own])
    rows = np.where(known, rows[own], 0)
    x, y, z = _in_frames_of(beams[own], directions[rows])
    inverse = np.where(known, 1 / (away[rows] * z), 0.0)
    x, y = x / z, y / z
    off = np.where(known, np.hypot(x, y), np.inf)
    spacing = np.maximum(np.nanmedian(np.where(known, off, np.nan), axis=1), 1e-6)
    u, v = x / spacing[:, None], y / spacing[:, None]
    near = np.where(known, np.exp(-0.5 * (u * u + v * v)), 0.0) * trust[rows]
    one_sided = np.hypot((near * u).sum(1), (near * v).sum(1)) / np.maximum((near * np.hypot(u, v)).sum(1), 1e-12)
    plane, error = _plane(u, v, inverse, near)
    rough = (near * error).sum(1) / near.sum(1) > ONE_PLANE
    weights = near * _front(inverse, known, off, rough)
    weights_now = weights / (1 + (error / OUTLIER) ** 2) ** (~rough[:, None])
    for _ in range(2):
        plane, error = _plane(u, v, inverse, weights_now + 1e-12)
        weights_now = weights / (1 + (error / OUTLIER) ** 2)
    plane, _ = _plane(u, v, inverse, weights_now + 1e-12)
    counts = weights_now > 1e-6
    low = np.where(counts, inverse, np.inf).min(1)
    high = np.where(counts, inverse, 0.0).max(1)
    at = np.where(np.isfinite(low), plane[:, 0].clip(0.9 * low, 1.1 * high), plane[:, 0])
    slope = np.hypot(plane[:, 1], plane[:, 2]) / spacing
    total = np.maximum(weights_now.sum(1), 1e-300)
    part = Met(
        1 / at,
        at / np.hypot(at, slope),
        np.asarray(gaps[own, 0], np.float64),
        spacing,
        one_sided,
        near.sum(1),
        np.zeros(len(own)),
        (weights_now * intensity[rows]).sum(1) / total,
        rows[np.arange(len(rows)), weights_now.argmax(1)],
    )
    found.put(own, part)
    return found


def _in_frames_of(beams: Floats, directions: Floats) -> tuple[Floats, Floats, Floats]:
    """Directions f64[B, k, 3] in frames whose z axis is the beam f64[B, 3]: x, y, z f64[B, k]."""
    helper = np.where(np.abs(beams[:, 2:]) < 0.9, [[0.0, 0.0, 1.0]], [[1.0, 0.0, 0.0]])
    right = np.cross(helper, beams)
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    up = np.cross(beams, right)
    axes = (right, up, beams)
    x, y, z = (np.einsum("bki,bi->bk", directions, axis) for axis in axes)
    return x, y, z


def _plane(u: Floats, v: Floats, inverse: Floats, weights: Floats) -> tuple[Floats, Floats]:
    """Inverse depth as value and slopes f64[B, 3] by weighted least squares, slopes slightly held towards 0, and the
    relative error f64[B, k] of every return."""
    total = weights.sum(1)
    sums = lambda values: (weights * values).sum(1)
    su, sv, suu, suv, svv = sums(u), sums(v), sums(u * u) + HELD * total, sums(u * v), sums(v * v) + HELD * total
    sq, squ, sqv = sums(inverse), sums(inverse * u), sums(inverse * v)
    # Cramer's rule for the symmetric 3x3 system
    a, b, c = suu * svv - suv * suv, suv * sv - su * svv, su * suv - suu * sv
    determinant = total * a + su * b + sv * c
    d, e, f = total * svv - sv * sv, su * sv - total * suv, total * suu - su * su
    value = (a * sq + b * squ + c * sqv) / determinant
    along_u, along_v = (b * sq + d * squ + e * sqv) / determinant, (c * sq + e * squ + f * sqv) / determinant
    found = np.stack([value, along_u, along_v], 1)
    error = np.abs(value[:, None] + along_u[:, None] * u + along_v[:, None] * v - inverse)
    return found, np.where(inverse > 0, error / np.maximum(inverse, 1e-12), 0.0)


def _front(inverse: Floats, known: NDArray[np.bool_], off: Floats, rough: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Which neighbours bool[B, k] belong to the surface that is met: all, or where two surfaces lie behind each other
    those of one."""
    order = np.argsort(-np.where(known, inverse, -1.0), axis=1, kind="stable")
    ordered = np.take_along_axis(inverse, order, 1)
    both = np.take_along_axis(known, order, 1)[:, 1:]
    gaps = np.where(both, ordered[:, :-1] / np.where(both, ordered[:, 1:], 1.0) - 1, -1.0)
    last = np.take_along_axis(ordered, gaps.argmax(1)[:, None], 1)
    front = known & (inverse >= last)
    back = known & ~front
    nearest_front, nearest_back = (np.where(side, off, np.inf).min(1) for side in (front, back))
    met = np.where((nearest_front <= NEARER * nearest_back + 1e-4)[:, None], front, back)
    return np.where((rough & (gaps.max(1) > LAYER_GAP))[:, None], met, known)
