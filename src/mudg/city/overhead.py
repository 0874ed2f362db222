"""What stands above a LiDAR's field of view: crowns over the road, bare trees, bridges, gantries, wires, arms, taller
buildings.

Only in cities with ``overhead`` > 0. Nothing comes lower than `CLEARANCE_M` above the corridor of the shifted cameras.
"""

from __future__ import annotations

import math

from mudg.city import objects as rec
from mudg.city.layout import AHEAD_M
from mudg.city.objects import KERB_M, LEAF_COLORS, RENDER_COLORS, Color, Furnisher, record

CLEARANCE_M = 4.0
BUILDING, WALL, FENCE, POLE, SIGN_CLASS, VEGETATION = 2, 3, 4, 5, 7, 8  # Cityscapes train ids
# materials; the same numbers stand in native/city_world.h
PLAIN, BARK, METAL, BRICK, SIGN, CONCRETE = 0, 3, 4, 10, 12, 19
GREYS: tuple[Color, ...] = ((0.36, 0.35, 0.33), (0.24, 0.24, 0.24), (0.45, 0.43, 0.39), (0.30, 0.27, 0.23))
METALS: tuple[Color, ...] = (
    (0.35, 0.36, 0.37),
    (0.05, 0.06, 0.06),
    (0.04, 0.10, 0.07),
    (0.16, 0.17, 0.2),
    (0.20, 0.10, 0.06),
)
Point = tuple[float, float, float]


class Overhead:
    """Adds what stands above; positions are street coordinates (s, u) and heights over the road."""

    def __init__(self, furnisher: Furnisher, amount: float) -> None:
        self.f, self.amount = furnisher, amount
        self.end = furnisher.plan.drive_length + AHEAD_M - 60

    def kerb(self, side: int) -> float:
        """|u| of the kerb."""
        return abs(self.f.plan.kerb(side))

    def foot(self, s: float, side: int, beyond_m: float, half: float) -> float | None:
        """u of something that stands on the sidewalk, out of the corridor; None where it would stand on the crossing
        street."""
        f, crossing = self.f, self.f.plan.crossing
        if crossing is not None and f.near_crossing(s, crossing.corner + half + 1.0):
            return None
        return f.free_u(s, side * (self.kerb(side) + beyond_m), half, half, side, side * (self.kerb(side) + 12.0))

    def cylinder(self, start: Point, end: Point, width_m: float, rgb: Color, looks: tuple[int, int]) -> None:
        """A round bar between two places (s, u, z); ``looks`` = class and material."""
        (x0, y0, _), (x1, y1, _) = self.f.plan.line.point(*start[:2]), self.f.plan.line.point(*end[:2])
        row = record(
            rec.PART,
            (x0, y0, start[2]),
            0.0,
            (1.0, width_m, 1.0),
            self.f.seed(),
            rgb,
            rgb,
            (1.0, float(looks[0]), float(looks[1]), x1 - x0, y1 - y0, end[2] - start[2]),
        )
        self.f.rows.append(row)

    def box(self, place: Point, size: Point, rgb: Color, looks: tuple[int, int], turn: float = 0.0) -> None:
        """A box with its centre at (s, u, z); ``size`` along the street, across it and upwards."""
        self.f.place(
            rec.PART, place[:2], turn, size, rgb, parameters=(0.0, float(looks[0]), float(looks[1])), z=place[2]
        )

    def board(self, place: Point, width_m: float, height_m: float, rgb: Color, ink: Color, turn: float) -> None:
        """A sign with letters that faces ``turn`` relative to the street."""
        self.f.place(
            rec.PART,
            place[:2],
            turn,
            (0.1, width_m, height_m),
            rgb,
            ink,
            (0.0, float(SIGN_CLASS), float(SIGN)),
            z=place[2],
        )

    def wire(self, start: Point, end: Point, sag_m: float, width_m: float) -> None:
        """A hanging wire in six straight pieces."""
        tone = self.f.uniform(0.01, 0.05)
        last = start
        for i in range(1, 7):
            k = i / 6
            drop = 4 * sag_m * k * (1 - k)
            at = tuple(a + k * (b - a) for a, b in zip(start, end, strict=True))
            here = (at[0], at[1], at[2] - drop)
            self.cylinder(last, here, width_m, (tone, tone, tone), (POLE, METAL))
            last = here


def add_overhead(f: Furnisher, amount: float) -> None:
    """Add what stands above the LiDAR to the records of a furnisher, in proportion to ``amount`` (0 to 1)."""
    o = Overhead(f, amount)
    _raise_buildings(f, amount)
    for side in (-1, 1):
        if f.chance(0.75 * amount):
            _avenue(o, side)
        if f.chance(0.35 * amount):
            _bare_trees(o, side)
        if f.chance(0.8 * amount):
            _tall_lamps(o, side)
    if f.chance(0.45 * amount):
        for _ in range(1 + int(f.chance(0.4))):
            _bridge(o, f.uniform(12, f.plan.drive_length + 70))
    if f.chance(0.45 * amount):
        _gantry(o, f.uniform(14, f.plan.drive_length + 60))
    if f.chance(0.55 * amount):
        _cross_wires(o)
    if f.chance(0.5 * amount):
        _pole_line(o, 1 if f.chance(0.5) else -1)
    for _ in range(2):
        if f.chance(0.5 * amount):
            _signal_arm(o, f.uniform(12, f.plan.drive_length + 50))
    if f.chance(0.3 * amount):
        _banner(o, f.uniform(15, f.plan.drive_length + 50))


def _raise_buildings(f: Furnisher, amount: float) -> None:
    """Some buildings of the rows get more floors: facades that fill the image up to its upper edge."""
    tall_street = f.chance(0.5)
    for row in f.rows:
        if row[0] == rec.BUILDING and row[7] > 7.5 and f.chance((0.7 if tall_street else 0.25) * amount):
            row[7] += int(f.rng.integers(1, 9)) * row[16]


def _avenue(o: Overhead, side: int) -> None:
    """Old trees whose crowns meet over the road, dense or with holes."""
    f = o.f
    spacing, density = f.uniform(7, 15), f.uniform(0.15, 0.8)
    leaves, size = f.pick(LEAF_COLORS, 0.3), f.uniform(0.8, 1.25)
    s = -15 + f.uniform(0, spacing)
    while s < min(o.end, f.plan.drive_length + 90):
        u = o.foot(s, side, 0.9, 0.45)
        if u is not None and f.chance(0.85):
            height, radius = size * f.uniform(11, 16), size * f.uniform(4.2, 7.0)
            k = f.uniform(0.8, 1.2)
            rgb = (leaves[0] * k, leaves[1] * k, leaves[2] * k)
            f.place(
                rec.TREE,
                (s, u),
                f.uniform(0, 6.28),
                (1.0, 1.0, height),
                rgb,
                (0.10, 0.08, 0.06),
                (radius, density * f.uniform(0.8, 1.2), 0.0, f.uniform(0.3, 0.42), f.uniform(0.18, 0.34)),
            )
        s += spacing * f.uniform(0.85, 1.2)


def _bare_trees(o: Overhead, side: int) -> None:
    """Trees without leaves: trunks, boughs and twigs against the sky."""
    f = o.f
    for _ in range(int(f.rng.integers(2, 6))):
        s = f.uniform(4, f.plan.drive_length + 50)
        u = o.foot(s, side, 1.0, 0.4)
        if u is None:
            continue
        height = f.uniform(7, 13)
        tone = f.uniform(0.05, 0.13)
        bark = (tone * 1.15, tone, tone * 0.85)
        fork = (s, u, 0.33 * height)
        o.cylinder((s, u, 0.0), fork, f.uniform(0.25, 0.5), bark, (VEGETATION, BARK))
        for i in range(6):
            angle = 1.05 * i + f.uniform(-0.3, 0.3)
            out, up = f.uniform(0.14, 0.28) * height, f.uniform(0.2, 0.42) * height
            bough = (s + out * math.cos(angle), u + out * math.sin(angle), fork[2] + up)
            o.cylinder(fork, bough, f.uniform(0.09, 0.16), bark, (VEGETATION, BARK))
            for _ in range(4):
                turn, reach = angle + f.uniform(-1.2, 1.2), f.uniform(0.1, 0.2) * height
                twig = (
                    bough[0] + reach * math.cos(turn),
                    bough[1] + reach * math.sin(turn),
                    bough[2] + f.uniform(0.0, 0.2) * height,
                )
                o.cylinder(bough, twig, f.uniform(0.03, 0.06), bark, (VEGETATION, BARK))


def _tall_lamps(o: Overhead, side: int) -> None:
    f = o.f
    s, step, tone = -10 + f.uniform(0, 25), f.uniform(22, 38), f.uniform(0.03, 0.4)
    height, reach = f.uniform(8, 12), f.uniform(2.5, 4.5)
    while s < o.end:
        u = o.foot(s, side, 0.5, 0.3)
        if u is not None:
            f.place(
                rec.LAMP, (s, u), -side * math.pi / 2, (0.2, 0.2, height), (tone, tone, tone), parameters=(reach, 0.0)
            )
        s += step


def _bridge(o: Overhead, s: float) -> None:
    """A bridge or a short underpass across the road."""
    f = o.f
    if f.plan.crossing is not None and f.near_crossing(s, 12.0):
        return
    low, deck, along = f.uniform(4.6, 6.8), f.uniform(0.7, 1.8), f.uniform(4, 22)
    stone = f.chance(0.3)
    rgb = f.pick(GREYS) if not stone else f.pick(((0.28, 0.16, 0.11), (0.34, 0.29, 0.22)))
    looks = (BUILDING, BRICK if stone else (METAL if f.chance(0.2) else CONCRETE))
    x, y, heading = f.plan.line.point(s, 0.0)
    turn = f.uniform(-0.25, 0.25)
    f.rows.append(
        record(
            rec.PART,
            (x, y, low + deck / 2),
            heading + turn,
            (along, 90.0, deck),
            f.seed(),
            rgb,
            rgb,
            (0.0, float(looks[0]), float(looks[1])),
        )
    )
    f.rows.append(
        record(
            rec.PART,
            (x, y, 0.0),
            heading + turn,
            (0.02, 0.02, 0.02),
            f.seed(),
            rgb,
            rgb,
            (0.0, float(looks[0]), float(looks[1]), 0, 0, 0, along / 2, 40.0, f.uniform(0.35, 0.7)),
        )
    )
    c, n = math.cos(heading + turn), math.sin(heading + turn)
    solid, girders = f.chance(0.5), int(f.rng.integers(0, 4))
    edge = f.pick(METALS)
    for end in (-1, 1):
        at = (x + end * c * along / 2, y + end * n * along / 2)
        high = f.uniform(0.9, 1.4)
        if solid:
            f.rows.append(
                record(
                    rec.PART,
                    (*at, low + deck + high / 2),
                    heading + turn,
                    (0.25, 90.0, high),
                    f.seed(),
                    rgb,
                    rgb,
                    (0.0, float(WALL), float(looks[1])),
                )
            )
        else:
            f.rows.append(
                record(
                    rec.FENCE,
                    (*at, low + deck),
                    heading + turn + math.pi / 2,
                    (70.0, 0.05, high),
                    f.seed(),
                    edge,
                    parameters=(float(f.chance(0.4)), 0.14, 0.04),
                )
            )
    for i in range(girders):
        at = ((i + 0.5) / girders - 0.5) * along
        f.rows.append(
            record(
                rec.PART,
                (x + c * at, y + n * at, low - 0.25),
                heading + turn,
                (0.4, 90.0, 0.5),
                f.seed(),
                edge,
                edge,
                (0.0, float(looks[0]), float(PLAIN)),
            )
        )
    walls = f.chance(0.5)
    for side in (-1, 1):
        u = max(o.kerb(side) + f.plan.sidewalk(side), f.reach + abs(f.plan.ego_u) + 0.6) + 0.4
        if walls:
            o.box((s, side * (u + 1.5), low / 2), (along * 0.98, 3.0, low), rgb, (WALL, looks[1]))
        else:
            for k in (-0.35, 0.35):
                o.box((s + k * along, side * (u + 0.5), low / 2), (1.0, 1.0, low), rgb, (BUILDING, looks[1]))
    if f.chance(0.4):
        o.board(
            (s - along / 2 - 0.2, f.plan.ego_u, low + 0.5 * deck),
            3.0,
            min(0.9, deck),
            (0.72, 0.6, 0.05),
            (0.03, 0.03, 0.03),
            math.pi,
        )


def _gantry(o: Overhead, s: float) -> None:
    """A frame across the road with direction signs over the lanes."""
    f = o.f
    right, left = (o.foot(s, side, 0.7, 0.4) for side in (-1, 1))
    if right is None or left is None:
        return
    height, metal = f.uniform(5.6, 7.2), f.pick(METALS)
    for u in (right, left):
        o.cylinder((s, u, 0.0), (s, u, height + 0.8), f.uniform(0.25, 0.45), metal, (POLE, METAL))
    for z in (height, height + 0.8):
        o.cylinder((s, right, z), (s, left, z), 0.22, metal, (POLE, METAL))
    rgb, ink = ((0.02, 0.08, 0.35), (0.8, 0.8, 0.8)) if f.chance(0.5) else ((0.02, 0.20, 0.09), (0.8, 0.8, 0.8))
    if f.chance(0.2):
        rgb, ink = (0.75, 0.75, 0.73), (0.03, 0.03, 0.03)
    lanes = [*f.plan.forward_lanes, *f.plan.backward_lanes]
    for u in lanes:
        if f.chance(0.75):
            turn = math.pi if u in f.plan.forward_lanes else 0.0
            o.board(
                (s - 0.3 if turn else s + 0.3, u, height + 0.4),
                f.uniform(2.0, 3.0),
                f.uniform(1.2, 2.2),
                rgb,
                ink,
                turn,
            )


def _cross_wires(o: Overhead) -> None:
    """Wires across the street with lamps or signals hung on some, and two along it as over a tramway."""
    f = o.f
    height, step, hung = f.uniform(6.0, 9.0), f.uniform(14, 32), int(f.rng.integers(0, 3))
    tram = f.chance(0.4)
    places = []
    s = f.uniform(3, 15)
    while s < min(o.end, f.plan.drive_length + 80):
        ends = [side * (o.kerb(side) + f.plan.sidewalk(side) + 0.3) for side in (-1, 1)]
        o.wire(
            (s, ends[0], height + 0.6),
            (s + f.uniform(-1, 1), ends[1], height + 0.6),
            f.uniform(0.3, 0.9),
            f.uniform(0.02, 0.05),
        )
        if hung == 1:
            middle = 0.5 * (ends[0] + ends[1])
            o.box((s, middle, height - 0.5), (0.7, 0.35, 0.2), (0.4, 0.4, 0.39), (POLE, METAL))
        places.append(s)
        s += step
    if tram:
        for u in (f.plan.ego_u, f.plan.ego_u + 3.2):
            for a, b in zip(places[:-1], places[1:], strict=True):
                o.wire((a, u, height), (b, u, height), 0.15, 0.025)


def _pole_line(o: Overhead, side: int) -> None:
    """Wooden or concrete poles with bundles of wires along the street, some to the houses."""
    f = o.f
    step, height, tone = f.uniform(22, 34), f.uniform(8, 11), f.uniform(0.08, 0.3)
    wires = [(f.uniform(-0.9, 0.9), f.uniform(0.2, 1.8)) for _ in range(int(f.rng.integers(2, 7)))]
    tops: list[tuple[float, float]] = []
    s = -25 + f.uniform(0, 20)
    while s < o.end:
        u = o.foot(s, side, 0.6, 0.3)
        if u is not None:
            f.place(rec.POLE, (s, u), 0.0, (0.28, 0.28, height), (tone, tone * 0.8, tone * 0.6), parameters=(1.0,))
            tops.append((s, u))
        s += step
    for a, b in zip(tops[:-1], tops[1:], strict=True):
        if b[0] - a[0] < 1.6 * step:
            for across, below in wires:
                o.wire(
                    (a[0], a[1] + across, height - below),
                    (b[0], b[1] + across, height - below),
                    f.uniform(0.3, 0.9),
                    0.03,
                )
    for s, u in tops:
        if f.chance(0.35):
            far = -side * (o.kerb(-side) + f.plan.sidewalk(-side) + 2.0)
            o.wire((s, u, height - 0.5), (s + f.uniform(-4, 4), far, f.uniform(5.5, 7.5)), 0.5, 0.03)


def _signal_arm(o: Overhead, s: float) -> None:
    """Signals on an arm over the lanes, facing the traffic."""
    f = o.f
    side = -1 if f.chance(0.75) else 1
    u = o.foot(s, side, 0.6, 0.3)
    if u is None:
        return
    tone = f.uniform(0.03, 0.4)
    f.place(
        rec.SIGNAL,
        (s, u),
        math.pi if side < 0 else 0.0,
        (0.3, 0.3, f.uniform(5.6, 6.6)),
        (tone, tone, tone),
        parameters=(f.uniform(4.5, 8.5), float(f.rng.integers(0, 3))),
        z=KERB_M,
    )


def _banner(o: Overhead, s: float) -> None:
    """A banner or a string of lamps across the street."""
    f = o.f
    ends = [side * (o.kerb(side) + f.plan.sidewalk(side) + 0.3) for side in (-1, 1)]
    height = f.uniform(6.0, 8.0)
    o.wire((s, ends[0], height + 0.7), (s, ends[1], height + 0.7), 0.2, 0.03)
    rgb = f.pick(((0.5, 0.05, 0.05), (0.7, 0.7, 0.68), (0.05, 0.2, 0.45), *RENDER_COLORS[:2]))
    o.box((s, f.plan.ego_u, height), (0.03, f.uniform(4, 8), f.uniform(0.7, 1.3)), rgb, (BUILDING, PLAIN))
