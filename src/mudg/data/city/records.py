"""Records: one row of numbers per thing in the city. The native library turns them into shapes and looks."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

COLUMNS: Final = 28

# kinds of things; the same numbers stand in native/city_world.h
BUILDING, TREE, HEDGE, LAMP, SIGN, SIGNAL, WALL, FENCE, POLE, BIN, BENCH = range(1, 12)
SHELTER, HILL, BUSH, GANTRY, BOLLARD, MOTORBIKE, PLANTER = range(12, 19)
CAR, VAN, TRUCK, BUS, PEDESTRIAN, CYCLIST = range(50, 56)

LABELS: Final = {CAR: "car", VAN: "car", TRUCK: "truck", BUS: "bus", PEDESTRIAN: "pedestrian", CYCLIST: "cyclist"}

Color = tuple[float, float, float]


def record(
    kind: int,
    xyz: tuple[float, float, float],
    yaw: float,
    size: tuple[float, float, float],
    seed: int,
    rgb: Color = (0.5, 0.5, 0.5),
    rgb2: Color = (0.5, 0.5, 0.5),
    parameters: tuple[float, ...] = (),
    public_id: int = 0,
) -> list[float]:
    """One row: position (metres, world), heading (radians), size (length, width, height in metres), linear colours,
    up to 12 parameters whose meaning depends on the kind (see native/city_build.cpp), public instance id."""
    padded = (*parameters, *(0.0,) * (12 - len(parameters)))
    return [float(kind), *xyz, yaw, *size, float(seed), *rgb, *rgb2, *padded, float(public_id)]


def to_array(rows: list[list[float]]) -> NDArray[np.float64]:
    """Rows to f64[N, 28]."""
    return np.ascontiguousarray(np.array(rows, np.float64).reshape(-1, COLUMNS))
