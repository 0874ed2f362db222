"""Where x, y and z of a file point: three letters of Left, Right, Up, Down, Forward and Back, as seen along the road.

``RDF`` is x right, y down, z forward. The axes of this program are ``FLU``.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

_WAYS: Final = {
    "F": ("forward", (1.0, 0.0, 0.0)), "B": ("back", (-1.0, 0.0, 0.0)), "L": ("left", (0.0, 1.0, 0.0)),
    "R": ("right", (0.0, -1.0, 0.0)), "U": ("up", (0.0, 0.0, 1.0)), "D": ("down", (0.0, 0.0, -1.0)),
}  # fmt: skip
WORLD: Final = "FLU"
VERTICAL: Final = {"z": WORLD, "-z": "FRD", "x": "UFL", "-x": "DFR", "-y": "RDF"}
"""Axes of which only the vertical one is known; where forward is, is chosen. ``y`` alone is ambiguous: programs that mean down write it."""


def known(axes: str) -> bool:
    """Whether three letters name three directions at right angles."""
    return len(axes) == 3 and all(letter in _WAYS for letter in axes) and abs(np.linalg.det(world_from_axes(axes))) > 0.5


def world_from_axes(axes: str) -> NDArray[np.float64]:
    """f64[3, 3], columns are the axes of a file in those of this program; of determinant -1 where they are left-handed."""
    return np.array([_WAYS[letter][1] for letter in axes]).T


def in_words(axes: str) -> str:
    """``RDF`` as *x right, y down, z forward*."""
    return ", ".join(f"{axis} {_WAYS[letter][0]}" for axis, letter in zip("xyz", axes))
