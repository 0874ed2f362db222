"""Collects the static objects along the streets and keeps the corridor of the shifted cameras free."""

from __future__ import annotations

from typing import Final

from mudg.base import seeds
from mudg.city.config import CityConfig
from mudg.city.layout import StreetPlan

# records ------------------------------------------------------------------------------------------
#
# Records: one row of numbers per object of the city. The native library makes shapes and materials from them.


COLUMNS: Final = 28

# kinds of objects; the same numbers stand in native/city_world.h
BUILDING, TREE, HEDGE, LAMP, SIGN, SIGNAL, WALL, FENCE, POLE, BIN, BENCH = range(1, 12)
SHELTER, HILL, BUSH = range(12, 15)
BOLLARD, MOTORBIKE, PLANTER, PART = range(16, 20)
CAR, VAN, TRUCK, BUS, PEDESTRIAN, CYCLIST, TANKER = range(50, 57)

LABELS: Final = {
    CAR: "car",
    VAN: "car",
    TRUCK: "truck",
    BUS: "bus",
    PEDESTRIAN: "pedestrian",
    CYCLIST: "cyclist",
    TANKER: "truck",
}

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


# furnisher ----------------------------------------------------------------------------------------


KERB_M = 0.13
RENDER_COLORS: tuple[Color, ...] = (
    (0.52, 0.46, 0.36),
    (0.60, 0.56, 0.48),
    (0.42, 0.42, 0.41),
    (0.62, 0.52, 0.36),
    (0.36, 0.30, 0.25),
    (0.55, 0.38, 0.28),
    (0.34, 0.38, 0.42),
    (0.66, 0.62, 0.57),
    (0.48, 0.30, 0.22),
    (0.55, 0.50, 0.30),
    (0.30, 0.36, 0.30),
)
BRICK_COLORS: tuple[Color, ...] = ((0.30, 0.13, 0.085), (0.36, 0.19, 0.12), (0.24, 0.12, 0.09), (0.42, 0.30, 0.20))
LEAF_COLORS: tuple[Color, ...] = (
    (0.085, 0.15, 0.035),
    (0.11, 0.17, 0.04),
    (0.06, 0.115, 0.03),
    (0.15, 0.17, 0.045),
    (0.20, 0.13, 0.03),
)
CLEARANCE_M = 1.0


class Furnisher(Draws):
    """Collects the records of static objects; keeps the corridor of the shifted cameras free."""

    def __init__(self, config: CityConfig, plan: StreetPlan) -> None:
        super().__init__(config.seed, "city furniture")
        self.plan = plan
        self.rows: list[list[float]] = []
        self.reach = config.shift_margin_m + CLEARANCE_M
        self._from_s, self._to_s = -2.5, plan.drive_length + 4.5

    def pick(self, items: tuple[Color, ...], spread: float = 0.15) -> Color:
        """One of the colours, a little lighter or darker."""
        k = self.uniform(1 - spread, 1 + spread)
        r, g, b = items[int(self.rng.integers(len(items)))]
        return (r * k, g * k, b * k)

    def blocked(self, s: float, u: float, along: float, across: float) -> bool:
        """Would something of half extents (along, across) at (s, u) stand in the corridor of the shifted cameras?"""
        inside = self._from_s - along < s < self._to_s + along
        return inside and abs(u - self.plan.ego_u) < self.reach + across

    def free_u(self, s: float, u: float, along: float, across: float, side: int, limit: float) -> float | None:
        """``u``, moved outwards if the corridor needs it; None when there is no room before ``limit`` (|u| of a
        wall)."""
        if self.blocked(s, u, along, across):
            u = self.plan.ego_u + side * (self.reach + across + 0.05)
        return u if abs(u) + across < abs(limit) else None

    def near_crossing(self, s: float, margin: float) -> bool:
        """Is ``s`` within ``margin`` metres of the crossing street?"""
        crossing = self.plan.crossing
        return crossing is not None and abs(s - crossing.s) < crossing.half_width + margin

    def place(
        self,
        kind: int,
        place: tuple[float, float],
        turn: float,
        size: tuple[float, float, float],
        rgb: Color,
        rgb2: Color = (0.5, 0.5, 0.5),
        parameters: tuple[float, ...] = (),
        z: float = KERB_M,
    ) -> None:
        """Add an object at street coordinates (s, u); ``turn`` is its heading relative to the street."""
        x, y, heading = self.plan.line.point(*place)
        self.rows.append(record(kind, (x, y, z), heading + turn, size, self.seed(), rgb, rgb2, parameters))


def plant_tree(f: Furnisher, s: float, u: float, garden: bool = False) -> None:
    """A tree at street coordinates; gardens also have conifers."""
    draw = float(f.rng.random())
    habit = 2.0 if garden and draw < 0.15 else (1.0 if draw > 0.9 else 0.0)
    height = f.uniform(6.0, 11.0) if habit == 0 else f.uniform(7, 12)
    radius = height * f.uniform(0.24, 0.32) if habit == 0 else f.uniform(1.0, 1.7)
    cell = f.uniform(0.20, 0.27) * (1 + 0.05 * max(0.0, height - 7))
    f.place(
        TREE,
        (s, u),
        f.uniform(0, 6.28),
        (1.0, 1.0, height),
        f.pick(LEAF_COLORS),
        (0.13, 0.10, 0.075),
        (radius, f.uniform(0.45, 0.72), habit, cell, f.uniform(0.11, 0.2)),
    )
