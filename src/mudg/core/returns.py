"""What beams meet in a cloud of LiDAR returns, seen from one place, and the rows of a sensor, found in its returns."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage, optimize, signal
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
    """Returns f64[N, 3] metres of one sweep in one frame, where the sensor was, and intensities f32[N] in [0, 1], NaN
    where a beam was lost."""

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
    """What B beams met, an entry for each: range (NaN where no return is within reach), cosine between beam and
    surface, angle to the nearest return (infinite where there is none), the middle angle to the neighbours, how much
    they lie to one side of the beam (0 to 1), how many returns and lost beams are around, each counted by its angle,
    intensity, and the number of the return that counts most (-1: none)."""

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


# Directions stand in for beams: of the returns that lie around a beam, those of the first surface are joined by a
# plane, and the beam's range is where it meets that plane. In the tangent plane of a beam inverse depth is affine on
# planes, so the plane is a weighted straight-line fit, exact on roads that a beam grazes.


def first_surface(beams: Floats, xyz: Floats, intensity: Floats, trust: Floats) -> Met:
    """What beams (unit directions f64[B, 3] from the origin) meet first among returns f64[N, 3] in the same frame, none
    at the origin. ``intensity`` f64[N]: NaN where a beam was lost; ``trust`` f64[N]: how much each counts."""
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


# rows of a LiDAR, found in its returns ------------------------------------------------------------------
# A row turns about the sensor's axis, which leans against the axes that a log gives, and starts above their origin, in
# two blocks of lasers at two heights. Elevations are sharp about the right axis and height: those make the sum of
# squares of their histogram greatest.


BIN_DEG: Final = 0.02
MOST_DEG: Final = 60.0
SIGMA_DEG: Final = 0.05
APART_DEG: Final = 0.12
FEWEST: Final = 0.1
"""Least height of a row's peak, as a share of the middle one."""
LEANS: Final = np.arange(-0.04, 0.041, 0.01)
HEIGHTS_M: Final = np.arange(-0.3, 0.305, 0.01)
NEAR_DEG: Final = 0.08
ON_ROWS: Final = 0.8
"""Share of the returns that lie near a row's elevation; sensors with less have no rows."""
MOST_RETURNS: Final = 20_000
"""Returns that axis and heights are found from."""


@dataclass(frozen=True, slots=True, eq=False)
class Rows:
    """Rows of a sensor: rows-from-sensor rotation f64[3, 3], where the lower and the upper block start along the axis,
    elevation between the blocks, and the elevations f64[R] of the rows, rising."""

    turn: Floats
    heights_m: tuple[float, float]
    split_deg: float
    elevations_deg: Floats

    @classmethod
    def of(cls, xyz: Floats, like: Rows | None = None) -> Rows:
        """The rows of returns f64[N, 3] in the sensor's frame; none where elevations have no peaks. ``like``: of
        another sweep of the sensor; axis and heights are taken from it."""
        if like is not None:
            known = len(like.elevations_deg) > 0
            return cls._with_peaks(xyz, like.turn, like.heights_m, like.split_deg)[0] if known else like
        some = xyz[:: max(1, len(xyz) // MOST_RETURNS)]
        blur = lambda lean: -float((_histogram(_angles(some @ _turn(lean).T)[1]) ** 2).sum())
        first = min(((a, b) for a in LEANS for b in LEANS), key=blur)
        simplex = np.add(first, [[0, 0], [0.005, 0], [0, 0.005]])
        turn = _turn(optimize.minimize(blur, first, method="Nelder-Mead", options={"initial_simplex": simplex}).x)
        local = some @ turn.T
        sums = np.cumsum([_histogram(_angles(local - [0, 0, height])[1]) ** 2 for height in HEIGHTS_M], 1)
        above = sums[:, -1:] - sums
        at = int((sums.max(0) + above.max(0)).argmax())
        height = lambda column: float(HEIGHTS_M[column.argmax()])
        whole = height(sums[:, -1])
        one = cls._with_peaks(xyz, turn, (whole, whole), 0.0)
        two = cls._with_peaks(xyz, turn, (height(sums[:, at]), height(above[:, at])), at * BIN_DEG - MOST_DEG)
        found, share = max(one, two, key=lambda pair: pair[1])
        return found if share > ON_ROWS else cls(turn, found.heights_m, 0.0, np.zeros(0))

    @classmethod
    def _with_peaks(
        cls, xyz: Floats, turn: Floats, heights_m: tuple[float, float], split_deg: float
    ) -> tuple[Rows, float]:
        """Rows with these heights, and the share of the returns that lie on them."""
        rows = cls(turn, heights_m, split_deg, np.zeros(0))
        elevation = rows.angles(xyz)[1]
        rows = replace(rows, elevations_deg=peaks(elevation))
        if not len(rows.elevations_deg):
            return rows, 0.0
        return rows, float((np.abs(elevation - rows.elevations_deg[rows.number(elevation)]) < NEAR_DEG).mean())

    def number(self, elevation_deg: Floats) -> NDArray[np.int64]:
        """Number i64[N] of the row that is nearest to each elevation."""
        return np.searchsorted((self.elevations_deg[:-1] + self.elevations_deg[1:]) / 2, elevation_deg)

    def angles(self, xyz: Floats) -> tuple[Floats, Floats, Floats]:
        """Azimuth in radians, elevation in degrees and distance f64[N] of points f64[N, 3], as their rows see them."""
        local = xyz @ self.turn.T
        low, high = (_angles(local - [0, 0, height]) for height in self.heights_m)
        upper = high[1] >= self.split_deg
        azimuth, elevation, away = (np.where(upper, b, a) for a, b in zip(low, high, strict=True))
        return azimuth, elevation, away

    def points(self, azimuth: Floats, elevation_deg: Floats, away: Floats) -> Floats:
        """Points f64[N, 3] in the sensor's frame; the inverse of ``angles``."""
        tilt = np.radians(elevation_deg)
        level = away * np.cos(tilt)
        height = np.where(elevation_deg >= self.split_deg, self.heights_m[1], self.heights_m[0])
        local = np.stack([level * np.cos(azimuth), level * np.sin(azimuth), away * np.sin(tilt) + height], 1)
        return local @ self.turn


def peaks(elevation_deg: Floats) -> Floats:
    """Elevations of a turning sensor's rows, degrees, rising: peaks of how often an elevation occurs."""
    smooth = _histogram(elevation_deg)
    at, shape = signal.find_peaks(smooth, height=0.0, prominence=0.0, distance=APART_DEG / BIN_DEG)
    height = shape["prominences"]
    usual = float(np.median(height[height > 0.2 * smooth.max()])) if len(at) else 0.0
    return (at[height >= FEWEST * usual] + 0.5) * BIN_DEG - MOST_DEG


def _turn(lean: Floats | tuple[float, float]) -> Floats:
    """Rotation that makes the axis (lean, 1) the third one."""
    axis = np.array([*lean, 1.0]) / np.sqrt(1 + lean[0] ** 2 + lean[1] ** 2)
    ahead = np.cross([0.0, 1.0, 0.0], axis)
    ahead /= np.linalg.norm(ahead)
    return np.stack([ahead, np.cross(axis, ahead), axis])


def _angles(xyz: Floats) -> tuple[Floats, Floats, Floats]:
    away = np.linalg.norm(xyz, axis=1)
    tilt = np.degrees(np.arcsin((xyz[:, 2] / np.maximum(away, 1e-9)).clip(-1, 1)))
    return np.arctan2(xyz[:, 1], xyz[:, 0]), tilt, away


def _histogram(elevation_deg: Floats) -> Floats:
    """How many elevations lie in each bin, smooth."""
    counts = np.histogram(elevation_deg, round(2 * MOST_DEG / BIN_DEG), (-MOST_DEG, MOST_DEG))[0]
    return ndimage.gaussian_filter1d(counts.astype(np.float64), SIGMA_DEG / BIN_DEG, mode="constant")
