"""Finding the maps between the colours of a log's cameras, from points that two of them saw.

Cameras of a rig overlap little at one moment, but the front camera sees what the side cameras pass a little later. So every point
is looked up in images of several moments. Photographs differ for other reasons too (reflections, shadows of the vehicle, poses), so
a map is used only where it explains a good part of the difference.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from itertools import combinations
from typing import Final

import numpy as np
from numpy.typing import NDArray

from mudg.base.camera_colors import SAME_COLORS, CameraColors, ColorMap

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
    """The affine map per channel from colours u8[N, 3] to those of another camera, by trimmed orthogonal least squares: both sides are
    photographs, as noisy as each other, and plain least squares would find too little contrast.

    Six rounds, the first a guess from medians; each leaves out pairs that are farther than ``TRIM_DEVIATIONS`` robust standard
    deviations from the last line. The identity where there are fewer than ``FEWEST_PAIRS`` pairs.
    """
    usable = ((given > 4) & (given < 251) & (wanted > 4) & (wanted < 251)).all(1)
    x, y = given[usable] / 255.0, wanted[usable] / 255.0
    if len(x) < FEWEST_PAIRS:
        return ColorMap(pairs=len(x))
    gains, offsets = [], []
    for channel in range(3):
        a, b = x[:, channel], y[:, channel]
        gain, offset = 1.0, float(np.median(b) - np.median(a))
        for _ in range(5):
            error = np.abs(b - gain * a - offset)
            kept = error <= TRIM_DEVIATIONS * 1.4826 * max(float(np.median(error)), 1e-3)
            gain, offset = _line(a[kept], b[kept])
        gains.append(round(float(gain), 5))
        offsets.append(round(float(offset), 5))
    return ColorMap((gains[0], gains[1], gains[2]), (offsets[0], offsets[1], offsets[2]), len(x))


def _line(x: NDArray[np.float64], y: NDArray[np.float64]) -> tuple[float, float]:
    """Gain and offset of the line y = gain x + offset from which points are least far. Where the two are loosely correlated, so that no
    line stands out, the gain alone: the ratio of the means."""
    (xx, xy), (_, yy) = np.cov(x, y)
    if xy < LEAST_CORRELATION * math.sqrt(xx * yy) or xy <= 0:
        return float(y.mean() / x.mean()), 0.0
    gain = float((yy - xx + np.hypot(yy - xx, 2 * xy)) / (2 * xy))
    return gain, float(y.mean() - gain * x.mean())


def match_cameras(cameras: Iterable[str], seen: Iterable[Seen]) -> CameraColors:
    """The maps of all cameras to the first one's colours, along the pairs of cameras that share the most points.

    Args:
        cameras: names, the one whose colours become the common ones first.
        seen: sets of points, each with what the cameras saw of it.

    Returns:
        Maps of the cameras whose colours differ. A camera that shares too few points with the others keeps its colours, as if they
        were common ones.
    """
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
        edges = [(len(colors[0]), edge) for edge, colors in pairs.items()
                 if (edge[0] in reached) != (edge[1] in reached) and len(colors[0]) >= FEWEST_PAIRS]  # fmt: skip
        if not edges:
            break
        a, b = max(edges)[1]
        known, new = (a, b) if a in reached else (b, a)
        of = dict(zip((a, b), pairs[a, b]))
        reached[new] = _useful(color_map(of[new], of[known]), of[new], of[known]).then(reached[known])
    maps = {
        name: found
        for name, found in reached.items()
        if found.gain != (1.0, 1.0, 1.0) or found.offset != (0.0, 0.0, 0.0)
    }
    return CameraColors(names[0], maps) if maps else SAME_COLORS


def _useful(found: ColorMap, given: NDArray[np.uint8], wanted: NDArray[np.uint8]) -> ColorMap:
    """The map, or the identity where it does not explain enough of the difference (see ``LEAST_GAIN`` and ``LEAST_CHANGE``)."""
    same = ColorMap(pairs=found.pairs)
    if min(found.gain) <= 0.2 or max(found.gain) >= 5:
        return same
    x, y = given / 255.0, wanted / 255.0
    mapped = x * np.array(found.gain) + np.array(found.offset)
    before, after, change = (float(np.abs(e).mean()) for e in (x - y, mapped - y, mapped - x))
    return found if after <= (1 - LEAST_GAIN) * before and change >= LEAST_CHANGE else same
