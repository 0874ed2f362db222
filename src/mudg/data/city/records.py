"""Records: one row of numbers per object of the city. The native library makes shapes and materials from them."""

from __future__ import annotations

from typing import Final

from mudg.base import seeds

COLUMNS: Final = 28

# kinds of objects; the same numbers stand in native/city_world.h
BUILDING, TREE, HEDGE, LAMP, SIGN, SIGNAL, WALL, FENCE, POLE, BIN, BENCH = range(1, 12)
SHELTER, HILL, BUSH = range(12, 15)
BOLLARD, MOTORBIKE, PLANTER, PART = range(16, 20)
CAR, VAN, TRUCK, BUS, PEDESTRIAN, CYCLIST, TANKER = range(50, 57)

LABELS: Final = {CAR: "car", VAN: "car", TRUCK: "truck", BUS: "bus", PEDESTRIAN: "pedestrian", CYCLIST: "cyclist", TANKER: "truck"}

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
) -> list[float]:
    """One row: position (metres, world), heading (radians), size (length, width, height in metres), linear colours,
    up to 12 parameters whose meaning depends on the kind (see native/city_build.cpp), public instance id (0 = none)."""
    padded = (*parameters, *(0.0,) * (12 - len(parameters)))
    return [float(kind), *xyz, yaw, *size, float(seed), *rgb, *rgb2, *padded, 0.0]


class Draws:
    """Random numbers for one purpose."""

    def __init__(self, seed: int, purpose: str) -> None:
        self.rng = seeds.numpy_rng(seed, 0, purpose)

    def seed(self) -> int:
        """A new seed for one object."""
        return int(self.rng.integers(1, 1 << 24))

    def uniform(self, low: float, high: float) -> float:
        """A uniform number."""
        return low + (high - low) * float(self.rng.random())

    def chance(self, probability: float) -> bool:
        """True with this probability."""
        return float(self.rng.random()) < probability
