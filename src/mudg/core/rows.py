"""Rows of a LiDAR, found in its returns.

A row turns about the sensor's axis, which leans against the axes that a log gives, and starts above their origin, in
two blocks of lasers at two heights. Elevations are sharp about the right axis and height: those make the sum of squares
of their histogram greatest.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage, optimize, signal

Floats = NDArray[np.float64]
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
    """Rows of a sensor.

    Args:
        turn: f64[3, 3], rows-from-sensor rotation. heights_m: where the lower and the upper block start, along the
            axis. split_deg: elevation between the blocks. elevations_deg: f64[R], rising.
    """

    turn: Floats
    heights_m: tuple[float, float]
    split_deg: float
    elevations_deg: Floats

    @classmethod
    def of(cls, xyz: Floats, like: Rows | None = None) -> Rows:
        """The rows of returns f64[N, 3] in the sensor's frame; none where elevations have no peaks.

        Args:
            like: of another sweep of the sensor; axis and heights are taken from it.
        """
        if like is not None:
            return (
                cls._with_peaks(xyz, like.turn, like.heights_m, like.split_deg)[0] if len(like.elevations_deg) else like
            )
        some = xyz[:: max(1, len(xyz) // MOST_RETURNS)]
        blur = lambda lean: -_sharpness(_angles(some @ _turn(lean).T)[1])
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


def _sharpness(elevation_deg: Floats) -> float:
    return float((_histogram(elevation_deg) ** 2).sum())
