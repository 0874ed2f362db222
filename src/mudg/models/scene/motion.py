"""How tracked objects move: the noise of a track, and its smoothest likely version.

A detector puts a box a little wrong at every key, each time anew; a car cannot follow such a path. Two sizes decide: that of the
noise, which the track itself betrays, and that of usual accelerations. The likeliest
path between the two minimises a sum of squares (the Whittaker smoother, on second differences), with a tail for sharp manoeuvres.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

ACCELERATION_M_S2: Final = 2.0
"""Usual acceleration of road users (standard deviation); hard braking is three to four times as much."""
YAW_ACCELERATION_RAD_S2: Final = 0.3
TAIL: Final = 3.0
FEWEST_KEYS: Final = 8
"""Tracks with fewer keys tell nothing about their noise."""


def second_differences(times_s: NDArray[np.float64]) -> NDArray[np.float64]:
    """Matrix f64[K-2, K] that maps values at K key times to their accelerations (per s^2) at the inner keys."""
    count = len(times_s)
    matrix = np.zeros((max(0, count - 2), count))
    for row in range(count - 2):
        before, after = np.diff(times_s[row : row + 3])
        middle = (before + after) / 2
        matrix[row, row : row + 3] = (1 / (before * middle), -(1 / before + 1 / after) / middle, 1 / (after * middle))
    return matrix


def key_noise(times_s: NDArray[np.float64], values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Standard deviation f64[C] of independent noise on the keys ``values`` f64[K, C]; 0 for fewer than `FEWEST_KEYS` keys.

    Third differences are blind to constant acceleration, and the median (Gaussian consistency 0.6745) to single jerks.
    """
    count = len(times_s)
    if count < FEWEST_KEYS:
        return np.zeros(values.shape[1])
    rows = []
    for row in range(count - 3):
        t = times_s[row : row + 4]
        weight = np.array([1 / np.prod([t[i] - t[j] for j in range(4) if j != i]) for i in range(4)])
        rows.append(weight / np.linalg.norm(weight) @ values[row : row + 4])
    return np.median(np.abs(np.stack(rows)), 0) / 0.6745


def motion_weights(accelerations: NDArray[np.float64]) -> NDArray[np.float64]:
    """Weights [M] of the inner keys, from their accelerations f64[M, C] in units of the usual one: 1 and more for even motion.

    Student's t with `TAIL` degrees of freedom instead of a Gaussian: turning into a side street is rare, not impossible.
    """
    return (TAIL + 1) / (TAIL + (accelerations**2).mean(1))


def smoothed(
    times_s: NDArray[np.float64], values: NDArray[np.float64], noise: float, acceleration: float
) -> NDArray[np.float64]:
    """The likeliest values f64[K, C] behind noisy keys, given the size of noise and of acceleration (standard deviations).

    Reweighted least squares, five rounds. Means and straight lines stay as they are. No noise, or fewer than three keys: as given.
    """
    if noise <= 0 or len(times_s) < 3:
        return values.copy()
    difference = second_differences(times_s) * (noise / acceleration)
    weights, found = np.ones(len(difference)), values
    for _ in range(5):
        found = np.linalg.solve(np.eye(len(times_s)) + (difference.T * weights) @ difference, values)
        weights = motion_weights(difference @ found / noise)
    return found
