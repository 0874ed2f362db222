"""Street plan of the city: centreline, lanes, kerbs, crossing street, markings; and the drive along it."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from mudg.base import seeds
from mudg.city.config import CityConfig

Array = NDArray[np.float64]

STEP_M = 0.5
BEHIND_M = 90.0
AHEAD_M = 190.0
MARK_SOLID, MARK_DASHED, MARK_DOUBLE, MARK_HATCHED = range(4)


@dataclass(frozen=True, slots=True, eq=False)
class Centreline:
    """Main street: ``s`` metres along, world ``x``, ``y``, ``heading`` radians; evenly spaced samples."""

    s: Array
    x: Array
    y: Array
    heading: Array

    def to_world(self, s: Array | float, u: Array | float) -> tuple[Array, Array, Array]:
        """World x, y and heading of street coordinates (``u`` metres to the left of the centreline)."""
        x, y = np.interp(s, self.s, self.x), np.interp(s, self.s, self.y)
        heading = np.interp(s, self.s, self.heading)
        return x - np.sin(heading) * u, y + np.cos(heading) * u, heading

    def point(self, s: float, u: float) -> tuple[float, float, float]:
        """The same for one point, without array overhead; ``s`` is clamped to the street."""
        at = min(max((s - float(self.s[0])) / STEP_M, 0.0), len(self.s) - 1.001)
        i = int(at)
        x, y, heading = (float(of[i] + (at - i) * (of[i + 1] - of[i])) for of in (self.x, self.y, self.heading))
        return x - np.sin(heading) * u, y + np.cos(heading) * u, heading

    def line(self, s: Array, u: Array) -> Array:
        """World places f64[N, 3] of street coordinates on the ground."""
        x, y, _ = self.to_world(s, u)
        return np.stack([x, y, np.zeros(len(s))], 1)


@dataclass(frozen=True, slots=True, eq=False)
class Crossing:
    """A straight street through (x, y) with heading ``yaw``; (a, b) = along and left of it; ``a`` in [start, end]."""

    s: float
    x: float
    y: float
    yaw: float
    half_width: float
    sidewalk: float
    corner: float
    start: float
    end: float

    def has_arm(self, side: int) -> bool:
        """Whether the street goes on to the left (+1) or right (-1) of the main street."""
        return self.end > 0 if side > 0 else self.start < 0

    def to_world(self, a: float, b: float) -> tuple[float, float]:
        """World x, y of crossing coordinates."""
        c, n = np.cos(self.yaw), np.sin(self.yaw)
        return self.x + c * a - n * b, self.y + n * a + c * b

    def of_world(self, xy: Array) -> tuple[Array, Array]:
        """Crossing coordinates of places f64[N, 2] in the world."""
        c, n = np.cos(self.yaw), np.sin(self.yaw)
        dx, dy = xy[:, 0] - self.x, xy[:, 1] - self.y
        return c * dx + n * dy, -n * dx + c * dy


@dataclass(frozen=True, slots=True, eq=False)
class StreetPlan:
    """Everything about the streets that other parts of the generator need. Lateral positions are street coordinates."""

    line: Centreline
    urban: bool
    lane_width: float
    forward_lanes: tuple[float, ...]
    backward_lanes: tuple[float, ...]
    ego_u: float
    left: float
    right: float
    park_left: float
    park_right: float
    sidewalk_left: float
    sidewalk_right: float
    paved_left: bool
    paved_right: bool
    crossing: Crossing | None
    marks: Array  # [k, 6] u, half width, period, dash, kind, yellow
    crosswalks: Array  # [c, 3] start, length, on the crossing street
    drive_s: Array  # street position of the vehicle at drive_times_s
    drive_times_s: Array
    drive_length: float

    def kerb(self, side: int) -> float:
        """Distance of the kerb from the centreline; side +1 left, -1 right."""
        return abs(self.left if side > 0 else self.right)

    def sidewalk(self, side: int) -> float:
        """Width of the sidewalk."""
        return self.sidewalk_left if side > 0 else self.sidewalk_right

    def front(self, side: int) -> float:
        """Distance of the sidewalk's far edge from the centreline."""
        return self.kerb(side) + self.sidewalk(side)

    def ego_s(self, times_s: Array | float) -> Array:
        """Street position of the recording vehicle."""
        return np.interp(times_s, self.drive_times_s, self.drive_s)


def plan_streets(config: CityConfig) -> StreetPlan:
    """Draw the street plan of a configuration."""
    rng = seeds.numpy_rng(config.seed, 0, "city streets")
    urban = config.style == "urban" or (config.style == "auto" and rng.random() < 0.6)
    times, drive_s = _drive(rng, config)
    drive_length = float(np.interp((config.n_frames - 1) / config.rate_hz, times, drive_s))
    lane = float(rng.uniform(3.2, 3.6))
    lanes = _lanes(rng, urban)
    half, park_left, park_right = lanes.median / 2, lanes.park_left, lanes.park_right
    forward_u = tuple(-(half + (i + 0.5) * lane) for i in range(lanes.forward))
    backward_u = tuple(half + (i + 0.5) * lane for i in range(lanes.backward))
    left = half + lanes.backward * lane + park_left + (rng.uniform(0.3, 0.6) if not park_left else 0.0)
    right = -(half + lanes.forward * lane + park_right + (rng.uniform(0.3, 1.0) if not park_right else 0.0))
    ego_u = forward_u[lanes.ego]
    line = _centreline(rng, drive_length, ego_u, urban)
    walks = [float(rng.uniform(2.6, 5.2)) if urban else float(rng.uniform(1.7, 3.2)) for _ in range(2)]
    crossing = _crossing(rng, config, line, drive_length, urban)
    marks = _paint(rng, lanes, lane, (left, right))
    crosswalks = _crosswalks(rng, (left, right), crossing)
    paved = [urban or rng.random() < 0.1 for _ in range(2)]
    street = (line, urban, lane, forward_u, backward_u, ego_u, float(left), float(right), park_left, park_right)
    return StreetPlan(*street, *walks, *paved, crossing, marks, crosswalks, drive_s, times, drive_length)


def _drive(rng: np.random.Generator, config: CityConfig) -> tuple[Array, Array]:
    """Street position over time: a mean speed with smooth changes, braking or pulling away in some logs."""
    duration = (config.n_frames - 1) / config.rate_hz
    times = np.arange(-20, int(round((duration + 1.0) * 20)) + 1) * 0.05
    mean = rng.uniform(4.5, 11.5)
    wave = rng.uniform(0.05, 0.25) * np.sin(2 * np.pi * times / rng.uniform(4, 9) + rng.uniform(0, 6.28))
    trend = rng.choice([0.0, -0.35, 0.35], p=[0.5, 0.25, 0.25]) * np.clip(times / max(duration, 1.0), 0, 1)
    speed = np.maximum(mean * (1 + wave + trend), 0.5)
    s = np.concatenate([[0.0], np.cumsum(0.5 * (speed[1:] + speed[:-1]) * 0.05)])
    return times, s - np.interp(0.0, times, s)


@dataclass(frozen=True, slots=True)
class _Lanes:
    """Lanes in either direction, width of the median, lane of the vehicle, widths of the parking bands."""

    forward: int
    backward: int
    median: float
    ego: int
    park_left: float
    park_right: float


def _lanes(rng: np.random.Generator, urban: bool) -> _Lanes:
    park = float(rng.uniform(2.1, 2.4))
    kind = rng.choice(5, p=[0.3, 0.3, 0.22, 0.06, 0.12] if urban else [0.12, 0.2, 0.38, 0.28, 0.02])
    if kind == 0:  # two lanes each way, driving on the outer one
        return _Lanes(2, int(rng.integers(1, 3)), 0.0, 1, park * (rng.random() < 0.7), 0.0)
    if kind == 1:  # wide median, driving on the inner lane, cars parked on both sides
        return _Lanes(2, int(rng.integers(1, 3)), float(rng.uniform(2.9, 3.4)), 0, park * (rng.random() < 0.7), park)
    if kind == 2:  # one lane each way with a painted median
        return _Lanes(1, 1, float(rng.uniform(2.9, 3.4)), 0, park * (rng.random() < 0.8), 0.0)
    if kind == 3:  # plain two-lane street
        return _Lanes(1, 1, 0.0, 0, park, 0.0)
    return _Lanes(3, 0, 0.0, 1, park, park)  # one-way street


def _centreline(rng: np.random.Generator, drive_length: float, ego_u: float, urban: bool) -> Centreline:
    s = np.arange(-BEHIND_M, drive_length + AHEAD_M + STEP_M, STEP_M)
    heading = np.zeros_like(s)
    if rng.random() > 0.2:
        shortest = 75.0 if urban else 55.0
        for _ in range(2):
            wavelength = rng.uniform(shortest, 170.0)
            amplitude = rng.uniform(-1, 1) * min(0.42, wavelength / 160.0)
            phase = rng.uniform(0, 2 * np.pi)
            heading += amplitude * np.sin(s / wavelength + phase)
    heading -= np.interp(0.0, s, heading)
    x = np.concatenate([[0.0], np.cumsum(0.5 * (np.cos(heading[1:]) + np.cos(heading[:-1])) * STEP_M)])
    y = np.concatenate([[0.0], np.cumsum(0.5 * (np.sin(heading[1:]) + np.sin(heading[:-1])) * STEP_M)])
    # the vehicle starts at the world's origin, looking along x
    return Centreline(s, x - np.interp(0.0, s, x), y - np.interp(0.0, s, y) - ego_u, heading)


def _crossing(
    rng: np.random.Generator, config: CityConfig, line: Centreline, drive_length: float, urban: bool
) -> Crossing | None:
    wanted = rng.random() < (0.75 if urban else 0.55)
    if config.crossing == "no" or (config.crossing == "auto" and not wanted):
        return None
    s = drive_length + float(rng.uniform(20, 42)) if rng.random() < 0.7 else float(rng.uniform(15, 15 + drive_length))
    x, y, heading = line.point(s, 0.0)
    half, arms = float(rng.uniform(3.4, 5.6)), rng.random()
    start, end = 0.0 if arms < 0.2 else -160.0, 0.0 if 0.2 <= arms < 0.4 else 160.0
    yaw = float(heading + np.pi / 2 + rng.uniform(-0.12, 0.12))
    walk, corner = float(rng.uniform(1.8, 3.2)), float(rng.uniform(3, 6))
    return Crossing(s, float(x), float(y), yaw, half, walk, corner, start, end)


def _paint(rng: np.random.Generator, lanes: _Lanes, width: float, kerbs: tuple[float, float]) -> Array:
    """Lines along the main street, f64[k, 6]; see ``StreetPlan.marks``."""
    median = lanes.median
    yellow = float(rng.random() < 0.45)
    half = float(rng.uniform(0.055, 0.08))
    period, dash = float(rng.uniform(6, 12)), float(rng.uniform(2.4, 4.0))
    rows = [[-(median / 2 + i * width), half, period, dash, MARK_DASHED, 0.0] for i in range(1, lanes.forward)]
    rows += [[median / 2 + i * width, half, period, dash, MARK_DASHED, 0.0] for i in range(1, lanes.backward)]
    if lanes.backward and median > 0:
        rows += [[side * median / 2, half, 1.0, 1.0, MARK_SOLID, yellow] for side in (-1, 1)]
        if rng.random() < 0.7:
            rows.append([0.0, median / 2 - 0.15, 3.2, 0.55, MARK_HATCHED, yellow])
    elif lanes.backward:
        rows.append([0.0, half, period, dash, float(rng.choice([MARK_DOUBLE, MARK_DASHED, MARK_SOLID])), yellow])
    edge = rng.random() < 0.6
    for kerb, park in zip(kerbs, (lanes.park_left, lanes.park_right), strict=True):
        inner = abs(kerb) - park
        if park and rng.random() < 0.7:
            rows.append([np.sign(kerb) * inner, half, 2.0, 1.0, MARK_DASHED, 0.0])
        elif not park and edge:
            rows.append([np.sign(kerb) * (inner - 0.25), half, 1.0, 1.0, MARK_SOLID, 0.0])
    return np.array(rows, np.float64).reshape(-1, 6)


def _crosswalks(rng: np.random.Generator, kerbs: tuple[float, float], crossing: Crossing | None) -> Array:
    """f64[c, 3]; see ``StreetPlan.crosswalks``."""
    left, right = kerbs
    length = float(rng.uniform(2.8, 4.0))
    if crossing is None:
        walks = [[float(rng.uniform(14, 55)), length, 0.0]] if rng.random() < 0.6 else []
        return np.array(walks, np.float64).reshape(-1, 3)
    clear = crossing.corner * 0.6 + 1.0
    gap = crossing.half_width + crossing.corner * 0.6 + 1.0
    walks = [[crossing.s - gap - length, length, 0.0], [crossing.s + gap, length, 0.0]]
    walks += [[left + clear, length, 1.0]] * crossing.has_arm(1)
    walks += [[right - clear - length, length, 1.0]] * crossing.has_arm(-1)
    return np.array(walks, np.float64)


# paint --------------------------------------------------------------------------------------------
#
# Where paint lies on the streets, exactly: at any point of the ground, and as lines for scores that want a map. The
# rules are those of ``native/city_ground.cpp``, without its blur over the footprint of a pixel and without wear.

_BAR_PERIOD_M: Final = 1.1
_BAR_MIDDLE_M: Final = 0.3
_BAR_HALF_M: Final = 0.27
_STOP_M: Final = 1.5
_STOP_HALF_M: Final = 0.2
_DOUBLE_M: Final = 0.15


def painted(plan: StreetPlan, street: Array, xy: Array) -> NDArray[np.bool_]:
    """Whether points of the road carry paint, bool[N]. ``street``: s, u and distance to the kerb f64[N, 3] of the
    points (``CityHandle.street``). ``xy``: the points f64[N, 2] in the world."""
    s, u = street[:, 0], street[:, 1]
    crossing, a, b = plan.crossing, u, u
    paint = in_cross = cut = np.zeros(len(xy), bool)
    if crossing is not None:
        a, b = crossing.of_world(xy)
        in_cross = (u > plan.left) | (u < plan.right)
        cut = in_cross | (np.abs(b) < crossing.half_width + 0.6)
    for start, length, on_cross in plan.crosswalks:
        here = in_cross if on_cross and crossing is not None else np.ones(len(xy), bool)
        along, across = (a if on_cross else s) - start, b if on_cross else u
        near = here & (along > -2.2) & (along < length + 2.2)
        if not on_cross:
            cut = cut | near
        bars = np.abs((across / _BAR_PERIOD_M) % 1.0 * _BAR_PERIOD_M - _BAR_MIDDLE_M) < _BAR_HALF_M
        bars &= (along > 0) & (along < length)
        paint = paint | (near & (bars | _stop_line(plan, along, across, length, bool(on_cross))))
    paint = paint | (~cut & _marks(plan, s, u))
    if crossing is not None:
        to_edge = np.where(a > 0, a - plan.left, -a + plan.right)
        paint |= in_cross & (to_edge > 7.0) & (np.abs(b) < 0.07) & _dashed(a, 6.0, 3.0)
    return paint & (street[:, 2] < 0)


def _stop_line(plan: StreetPlan, along: Array, across: Array, length: float, on_cross: bool) -> NDArray[np.bool_]:
    """Stop lines for traffic that comes towards a crossing."""
    right = across < 0
    line = np.where(right, -99.0 if on_cross else -_STOP_M, length + _STOP_M)
    half = np.where(right, -plan.right, plan.left)
    if on_cross and plan.crossing is not None:
        half = plan.crossing.half_width
    return (np.abs(across) < half - 0.4) & (np.abs(along - line) < _STOP_HALF_M)


def _marks(plan: StreetPlan, s: Array, u: Array) -> NDArray[np.bool_]:
    """Lines along the main street."""
    paint = np.zeros(len(s), bool)
    for place, half, period, dash, kind, _ in plan.marks:
        off = u - place
        found = np.abs(np.abs(off) - _DOUBLE_M if kind == MARK_DOUBLE else off) < half
        if kind in (MARK_HATCHED, MARK_DASHED):
            found &= _dashed(s + 0.7 * off if kind == MARK_HATCHED else s, period, dash)
        paint |= found
    return paint


def _dashed(along: Array, period: float, dash: float) -> NDArray[np.bool_]:
    return np.abs((along / period) % 1.0 * period - 0.5 * dash) < 0.5 * dash


# ---- as a map has it -----------------------------------------------------------------------------


def lane_lines(plan: StreetPlan) -> list[Array]:
    """Road lines, road edges and the long sides of crosswalks as lines f64[N, 3] on the road, metres in the world. As
    in a map, a dashed line is one line, and nothing is left out where a crossing street begins."""
    along = np.arange(plan.line.s[0], plan.line.s[-1], STEP_M)
    lines = [plan.line.line(along, np.full(len(along), u)) for u in (*plan.marks[:, 0], plan.left, plan.right)]
    for start, length, on_cross in plan.crosswalks:
        for edge in (start, start + length):
            if on_cross and plan.crossing is not None:
                across = np.arange(-plan.crossing.half_width, plan.crossing.half_width, STEP_M)
                places = np.array([plan.crossing.to_world(edge, b) for b in across])
                lines.append(np.c_[places, np.zeros(len(places))])
            elif not on_cross:
                across = np.arange(plan.right, plan.left, STEP_M)
                lines.append(plan.line.line(np.full(len(across), edge), across))
    return lines


# records ------------------------------------------------------------------------------------------
#
# One row of numbers per object of the city. The native library makes shapes and materials from them.

COLUMNS: Final = 28

# kinds of objects; the same numbers stand in native/city_world.h
BUILDING, TREE, HEDGE, LAMP, SIGN, SIGNAL, WALL, FENCE, POLE, BIN, BENCH = range(1, 12)
SHELTER, HILL, BUSH = range(12, 15)
BOLLARD, MOTORBIKE, PLANTER, PART = range(16, 20)
CAR, VAN, TRUCK, BUS, PEDESTRIAN, CYCLIST, TANKER = range(50, 57)

LABELS: Final = dict(
    zip((CAR, VAN, TRUCK, BUS, PEDESTRIAN, CYCLIST, TANKER), "car car truck bus pedestrian cyclist truck".split())
)

Color = tuple[float, float, float]
Size = tuple[float, float, float]
Place = tuple[float, float]
Form = tuple[float, ...]
GREY: Final = (0.5, 0.5, 0.5)


def record(kind: int, xyz: Size, yaw: float, size: Size, seed: int, *rgb: Color, form: Form = ()) -> list[float]:
    """One row: position (metres, world), heading (radians), size (length, width, height in metres), up to two linear
    colours, up to 12 parameters whose meaning depends on the kind (see native/city_build.cpp), public instance id (0 =
    none)."""
    first, second = (*rgb, GREY, GREY)[:2]
    padded = (*form, *(0.0,) * (12 - len(form)))
    return [float(kind), *xyz, yaw, *size, float(seed), *first, *second, *padded, 0.0]


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

    def side(self, left: float = 0.5) -> int:
        """Left (+1), with this probability, or right (-1)."""
        return 1 if self.chance(left) else -1

    def along(self, start: float, end: float, step: Callable[[], float]) -> Iterator[float]:
        """Places from ``start`` to before ``end``; each step is drawn after what its place draws."""
        while start < end:
            yield start
            start += step()


# furnisher ----------------------------------------------------------------------------------------

KERB_M = 0.13


def colors(*lines: str) -> tuple[Color, ...]:
    """Linear colours, red green blue each, by commas."""
    rows = [one.split() for line in lines for one in line.split(",")]
    return tuple((float(red), float(green), float(blue)) for red, green, blue in rows)


RENDER_COLORS = colors(
    "0.52 0.46 0.36, 0.60 0.56 0.48, 0.42 0.42 0.41, 0.62 0.52 0.36, 0.36 0.30 0.25, 0.55 0.38 0.28",
    "0.34 0.38 0.42, 0.66 0.62 0.57, 0.48 0.30 0.22, 0.55 0.50 0.30, 0.30 0.36 0.30",
)
BRICK_COLORS: tuple[Color, ...] = ((0.30, 0.13, 0.085), (0.36, 0.19, 0.12), (0.24, 0.12, 0.09), (0.42, 0.30, 0.20))
LEAF_COLORS = colors("0.085 0.15 0.035, 0.11 0.17 0.04, 0.06 0.115 0.03, 0.15 0.17 0.045, 0.20 0.13 0.03")
TRUNK: Final = (0.13, 0.10, 0.075)
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
        self, kind: int, place: Place, turn: float, size: Size, *rgb: Color, form: Form = (), z: float = KERB_M
    ) -> None:
        """Add an object at street coordinates (s, u); ``turn`` is its heading relative to the street."""
        x, y, heading = self.plan.line.point(*place)
        self.rows.append(record(kind, (x, y, z), heading + turn, size, self.seed(), *rgb, form=form))


def plant_tree(f: Furnisher, s: float, u: float, garden: bool = False) -> None:
    """A tree at street coordinates; gardens also have conifers."""
    draw = float(f.rng.random())
    habit = 2.0 if garden and draw < 0.15 else (1.0 if draw > 0.9 else 0.0)
    height = f.uniform(6.0, 11.0) if habit == 0 else f.uniform(7, 12)
    radius = height * f.uniform(0.24, 0.32) if habit == 0 else f.uniform(1.0, 1.7)
    cell = f.uniform(0.20, 0.27) * (1 + 0.05 * max(0.0, height - 7))
    turn, leaves, crown = f.uniform(0, 6.28), f.pick(LEAF_COLORS), (radius, f.uniform(0.45, 0.72), habit, cell)
    form = (*crown, f.uniform(0.11, 0.2))
    f.place(TREE, (s, u), turn, (1.0, 1.0, height), leaves, TRUNK, form=form)
