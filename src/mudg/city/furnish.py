"""Static surroundings of the streets: buildings, gardens, walls, fences, the crossing street and the background."""

from __future__ import annotations

import math

from mudg.city import layout as rec
from mudg.city.config import CityConfig
from mudg.city.layout import LEAF_COLORS, RENDER_COLORS, TRUNK, Color, Form, Furnisher, Place, Size, colors, record

# overhead -----------------------------------------------------------------------------------------
#
# What stands above a LiDAR's field of view, in cities with ``overhead`` > 0. Nothing comes lower than 4 m above the
# corridor of the shifted cameras.

BUILDING, WALL, FENCE, POLE, SIGN_CLASS, VEGETATION = 2, 3, 4, 5, 7, 8  # Cityscapes train ids
# materials; the same numbers stand in native/city_world.h
PLAIN, BARK, METAL, BRICK, SIGN, CONCRETE = 0, 3, 4, 10, 12, 19
GREYS: tuple[Color, ...] = ((0.36, 0.35, 0.33), (0.24, 0.24, 0.24), (0.45, 0.43, 0.39), (0.30, 0.27, 0.23))
METALS = colors("0.35 0.36 0.37, 0.05 0.06 0.06, 0.04 0.10 0.07, 0.16 0.17 0.2, 0.20 0.10 0.06")
DARK: Color = (0.03, 0.03, 0.03)
Point = tuple[float, float, float]


def _end(f: Furnisher, most_m: float = math.inf) -> float:
    """Where things along the street end; at most so far beyond the drive."""
    return min(f.plan.drive_length + rec.AHEAD_M - 60, f.plan.drive_length + most_m)


def _across(f: Furnisher) -> list[float]:
    """u of the right and the left wall of houses."""
    return [side * (f.plan.front(side) + 0.3) for side in (-1, 1)]


def _foot(f: Furnisher, s: float, side: int, beyond_m: float, half: float) -> float | None:
    """u of something that stands on the sidewalk, out of the corridor; None where it would stand on the crossing
    street."""
    crossing, kerb = f.plan.crossing, f.plan.kerb(side)
    if crossing is not None and f.near_crossing(s, crossing.corner + half + 1.0):
        return None
    return f.free_u(s, side * (kerb + beyond_m), half, half, side, side * (kerb + 12.0))


def _cylinder(f: Furnisher, start: Point, end: Point, width_m: float, rgb: Color, looks: tuple[int, int]) -> None:
    """A round bar between two places (street coordinates s, u, and height over the road); ``looks``: class and
    material."""
    (x0, y0, _), (x1, y1, _) = f.plan.line.point(*start[:2]), f.plan.line.point(*end[:2])
    form = (1, *looks, x1 - x0, y1 - y0, end[2] - start[2])
    f.rows.append(record(rec.PART, (x0, y0, start[2]), 0.0, (1.0, width_m, 1.0), f.seed(), rgb, rgb, form=form))


def _box(f: Furnisher, place: Point, size: Size, rgb: Color, looks: tuple[int, int]) -> None:
    """A box with its centre at (s, u, z); ``size`` along the street, across it and upwards."""
    f.place(rec.PART, place[:2], 0.0, size, rgb, form=(0, *looks), z=place[2])


def _board(f: Furnisher, place: Point, width_m: float, height_m: float, rgb: Color, ink: Color, turn: float) -> None:
    """A sign with letters that faces ``turn`` relative to the street."""
    f.place(rec.PART, place[:2], turn, (0.1, width_m, height_m), rgb, ink, form=(0, SIGN_CLASS, SIGN), z=place[2])


def _wire(f: Furnisher, start: Point, end: Point, sag_m: float, width_m: float) -> None:
    """A hanging wire in six straight pieces."""
    tone, last = f.uniform(0.01, 0.05), start
    for i in range(1, 7):
        k = i / 6
        s, u, z = (a + k * (b - a) for a, b in zip(start, end, strict=True))
        here = (s, u, z - 4 * sag_m * k * (1 - k))
        _cylinder(f, last, here, width_m, (tone, tone, tone), (POLE, METAL))
        last = here


def add_overhead(f: Furnisher, amount: float) -> None:
    """Add what stands above the LiDAR to the records of a furnisher, in proportion to ``amount`` (0 to 1)."""
    tall_street = f.chance(0.5)
    for row in f.rows:  # some buildings get more floors: facades that fill the image up to its upper edge
        if row[0] == rec.BUILDING and row[7] > 7.5 and f.chance((0.7 if tall_street else 0.25) * amount):
            row[7] += int(f.rng.integers(1, 9)) * row[16]
    for side in (-1, 1):
        for share, line in ((0.75, _avenue), (0.35, _bare_trees), (0.8, _tall_lamps)):
            if f.chance(share * amount):
                line(f, side)
    above = ((0.45, _bridges), (0.45, _gantry), (0.55, _cross_wires), (0.5, _pole_line))
    for share, build in (*above, (0.5, _signal_arm), (0.5, _signal_arm), (0.3, _banner)):
        if f.chance(share * amount):
            build(f)


def _avenue(f: Furnisher, side: int) -> None:
    """Old trees whose crowns meet over the road, dense or with holes."""
    spacing, density = f.uniform(7, 15), f.uniform(0.15, 0.8)
    leaves, size = f.pick(LEAF_COLORS, 0.3), f.uniform(0.8, 1.25)
    for s in f.along(-15 + f.uniform(0, spacing), _end(f, 90), lambda: spacing * f.uniform(0.85, 1.2)):
        u = _foot(f, s, side, 0.9, 0.45)
        if u is not None and f.chance(0.85):
            height, radius, k = size * f.uniform(11, 16), size * f.uniform(4.2, 7.0), f.uniform(0.8, 1.2)
            rgb, turn = (leaves[0] * k, leaves[1] * k, leaves[2] * k), f.uniform(0, 6.28)
            crown = (radius, density * f.uniform(0.8, 1.2), 0.0, f.uniform(0.3, 0.42), f.uniform(0.18, 0.34))
            f.place(rec.TREE, (s, u), turn, (1.0, 1.0, height), rgb, (0.10, 0.08, 0.06), form=crown)


def _bare_trees(f: Furnisher, side: int) -> None:
    """Trees without leaves: trunks, boughs and twigs against the sky."""
    wood = (VEGETATION, BARK)
    for _ in range(int(f.rng.integers(2, 6))):
        s = f.uniform(4, f.plan.drive_length + 50)
        u = _foot(f, s, side, 1.0, 0.4)
        if u is None:
            continue
        height, tone = f.uniform(7, 13), f.uniform(0.05, 0.13)
        bark, fork = (tone * 1.15, tone, tone * 0.85), (s, u, 0.33 * height)
        _cylinder(f, (s, u, 0.0), fork, f.uniform(0.25, 0.5), bark, wood)
        for i in range(6):
            angle = 1.05 * i + f.uniform(-0.3, 0.3)
            out, up = f.uniform(0.14, 0.28) * height, f.uniform(0.2, 0.42) * height
            bough = (s + out * math.cos(angle), u + out * math.sin(angle), fork[2] + up)
            _cylinder(f, fork, bough, f.uniform(0.09, 0.16), bark, wood)
            for _ in range(4):
                turn, reach = angle + f.uniform(-1.2, 1.2), f.uniform(0.1, 0.2) * height
                x, y = bough[0] + reach * math.cos(turn), bough[1] + reach * math.sin(turn)
                twig = (x, y, bough[2] + f.uniform(0.0, 0.2) * height)
                _cylinder(f, bough, twig, f.uniform(0.03, 0.06), bark, wood)


def _tall_lamps(f: Furnisher, side: int) -> None:
    start, step, tone = -10 + f.uniform(0, 25), f.uniform(22, 38), f.uniform(0.03, 0.4)
    size, reach = (0.2, 0.2, f.uniform(8, 12)), f.uniform(2.5, 4.5)
    for s in f.along(start, _end(f), lambda: step):
        u = _foot(f, s, side, 0.5, 0.3)
        if u is not None:
            f.place(rec.LAMP, (s, u), -side * math.pi / 2, size, (tone, tone, tone), form=(reach, 0.0))


def _bridges(f: Furnisher) -> None:
    """One or two bridges or short underpasses across the road."""
    for _ in range(1 + int(f.chance(0.4))):
        s = f.uniform(12, f.plan.drive_length + 70)
        if not f.near_crossing(s, 12.0):
            _bridge(f, s)


def _bridge(f: Furnisher, s: float) -> None:
    low, deck, along = f.uniform(4.6, 6.8), f.uniform(0.7, 1.8), f.uniform(4, 22)
    stone = f.chance(0.3)
    rgb = f.pick(GREYS) if not stone else f.pick(((0.28, 0.16, 0.11), (0.34, 0.29, 0.22)))
    looks = (BUILDING, BRICK if stone else (METAL if f.chance(0.2) else CONCRETE))
    x, y, heading = f.plan.line.point(s, 0.0)
    yaw = heading + f.uniform(-0.25, 0.25)
    c, n = math.cos(yaw), math.sin(yaw)

    def part(off: float, z: float, size: Size, rgb: Color, form: Form) -> None:
        """Something that runs across the road, ``off`` metres along it from the middle of the bridge."""
        place = (x + c * off, y + n * off, z)
        f.rows.append(record(rec.PART, place, yaw, size, f.seed(), rgb, rgb, form=form))

    part(0.0, low + deck / 2, (along, 90.0, deck), rgb, (0, *looks))
    seed, shade = f.seed(), (0, *looks, 0, 0, 0, along / 2, 40.0, f.uniform(0.35, 0.7))
    f.rows.append(record(rec.PART, (x, y, 0.0), yaw, (0.02, 0.02, 0.02), seed, rgb, rgb, form=shade))
    solid, girders, edge = f.chance(0.5), int(f.rng.integers(0, 4)), f.pick(METALS)
    for end in (-1, 1):
        at, high = (x + end * c * along / 2, y + end * n * along / 2), f.uniform(0.9, 1.4)
        if solid:
            place, form = (*at, low + deck + high / 2), (0, WALL, looks[1])
            f.rows.append(record(rec.PART, place, yaw, (0.25, 90.0, high), f.seed(), rgb, rgb, form=form))
        else:
            place, seed, bars = (*at, low + deck), f.seed(), (float(f.chance(0.4)), 0.14, 0.04)
            f.rows.append(record(rec.FENCE, place, yaw + math.pi / 2, (70.0, 0.05, high), seed, edge, form=bars))
    for i in range(girders):
        part(((i + 0.5) / girders - 0.5) * along, low - 0.25, (0.4, 90.0, 0.5), edge, (0, looks[0], PLAIN))
    walls = f.chance(0.5)
    for side in (-1, 1):
        u = max(f.plan.front(side), f.reach + abs(f.plan.ego_u) + 0.6) + 0.4
        if walls:
            _box(f, (s, side * (u + 1.5), low / 2), (along * 0.98, 3.0, low), rgb, (WALL, looks[1]))
        else:
            for k in (-0.35, 0.35):
                _box(f, (s + k * along, side * (u + 0.5), low / 2), (1.0, 1.0, low), rgb, (BUILDING, looks[1]))
    if f.chance(0.4):
        place = (s - along / 2 - 0.2, f.plan.ego_u, low + 0.5 * deck)
        _board(f, place, 3.0, min(0.9, deck), (0.72, 0.6, 0.05), DARK, math.pi)


def _gantry(f: Furnisher) -> None:
    """A frame across the road with direction signs over the lanes."""
    s = f.uniform(14, f.plan.drive_length + 60)
    right, left = (_foot(f, s, side, 0.7, 0.4) for side in (-1, 1))
    if right is None or left is None:
        return
    height, metal = f.uniform(5.6, 7.2), f.pick(METALS)
    for u in (right, left):
        _cylinder(f, (s, u, 0.0), (s, u, height + 0.8), f.uniform(0.25, 0.45), metal, (POLE, METAL))
    for z in (height, height + 0.8):
        _cylinder(f, (s, right, z), (s, left, z), 0.22, metal, (POLE, METAL))
    rgb, ink = (0.02, 0.08, 0.35) if f.chance(0.5) else (0.02, 0.20, 0.09), (0.8, 0.8, 0.8)
    if f.chance(0.2):
        rgb, ink = (0.75, 0.75, 0.73), DARK
    for u in (*f.plan.forward_lanes, *f.plan.backward_lanes):
        if f.chance(0.75):
            turn = math.pi if u in f.plan.forward_lanes else 0.0
            place = (s - 0.3 if turn else s + 0.3, u, height + 0.4)
            _board(f, place, f.uniform(2.0, 3.0), f.uniform(1.2, 2.2), rgb, ink, turn)


def _cross_wires(f: Furnisher) -> None:
    """Wires across the street with lamps or signals hung on some, and two along it as over a tramway."""
    height, step, hung = f.uniform(6.0, 9.0), f.uniform(14, 32), int(f.rng.integers(0, 3))
    tram, (right, left), places = f.chance(0.4), _across(f), []
    for s in f.along(f.uniform(3, 15), _end(f, 80), lambda: step):
        far = (s + f.uniform(-1, 1), left, height + 0.6)
        _wire(f, (s, right, height + 0.6), far, f.uniform(0.3, 0.9), f.uniform(0.02, 0.05))
        if hung == 1:
            middle = (s, 0.5 * (right + left), height - 0.5)
            _box(f, middle, (0.7, 0.35, 0.2), (0.4, 0.4, 0.39), (POLE, METAL))
        places.append(s)
    for u in (f.plan.ego_u, f.plan.ego_u + 3.2) if tram else ():
        for a, b in zip(places[:-1], places[1:], strict=True):
            _wire(f, (a, u, height), (b, u, height), 0.15, 0.025)


def _pole_line(f: Furnisher) -> None:
    """Wooden or concrete poles with bundles of wires along the street, some to the houses."""
    side, step, height, tone = f.side(), f.uniform(22, 34), f.uniform(8, 11), f.uniform(0.08, 0.3)
    wires = [(f.uniform(-0.9, 0.9), f.uniform(0.2, 1.8)) for _ in range(int(f.rng.integers(2, 7)))]
    tops: list[Place] = []
    for s in f.along(-25 + f.uniform(0, 20), _end(f), lambda: step):
        u = _foot(f, s, side, 0.6, 0.3)
        if u is not None:
            f.place(rec.POLE, (s, u), 0.0, (0.28, 0.28, height), (tone, tone * 0.8, tone * 0.6), form=(1.0,))
            tops.append((s, u))
    for a, b in zip(tops[:-1], tops[1:], strict=True):
        if b[0] - a[0] < 1.6 * step:
            for across, below in wires:
                start, end = ((at[0], at[1] + across, height - below) for at in (a, b))
                _wire(f, start, end, f.uniform(0.3, 0.9), 0.03)
    for s, u in tops:
        if f.chance(0.35):
            far = -side * (f.plan.front(-side) + 2.0)
            _wire(f, (s, u, height - 0.5), (s + f.uniform(-4, 4), far, f.uniform(5.5, 7.5)), 0.5, 0.03)


def _signal_arm(f: Furnisher) -> None:
    """Signals on an arm over the lanes, facing the traffic."""
    s, side = f.uniform(12, f.plan.drive_length + 50), -f.side(0.75)
    u = _foot(f, s, side, 0.6, 0.3)
    if u is None:
        return
    tone = f.uniform(0.03, 0.4)
    size, arm = (0.3, 0.3, f.uniform(5.6, 6.6)), (f.uniform(4.5, 8.5), float(f.rng.integers(0, 3)))
    f.place(rec.SIGNAL, (s, u), math.pi if side < 0 else 0.0, size, (tone, tone, tone), form=arm)


def _banner(f: Furnisher) -> None:
    """A banner or a string of lamps across the street."""
    s, (right, left), height = f.uniform(15, f.plan.drive_length + 50), _across(f), f.uniform(6.0, 8.0)
    _wire(f, (s, right, height + 0.7), (s, left, height + 0.7), 0.2, 0.03)
    rgb = f.pick(((0.5, 0.05, 0.05), (0.7, 0.7, 0.68), (0.05, 0.2, 0.45), *RENDER_COLORS[:2]))
    _box(f, (s, f.plan.ego_u, height), (0.03, f.uniform(4, 8), f.uniform(0.7, 1.3)), rgb, (BUILDING, PLAIN))


# objects on the sidewalks: trees, lamps, poles, signs, bins, benches, bollards --------------------


class Sidewalk:
    """One sidewalk of the main street; ``side`` +1 left, -1 right."""

    def __init__(self, f: Furnisher, side: int) -> None:
        plan = f.plan
        self.f, self.side, self.front, self.width = f, side, plan.front(side), plan.sidewalk(side)
        self.end = plan.drive_length + rec.AHEAD_M - 40
        self.corner = (plan.crossing.corner + 2.0) if plan.crossing else 0.0
        self.facing_street = -side * math.pi / 2  # local +x towards the road
        self.facing_back = 0.0 if side < 0 else math.pi

    def put(
        self, kind: int, place: Place, across: float, turn: float, size: Size, *rgb: Color, form: Form = ()
    ) -> None:
        """Place an object of half width ``across`` unless it stands in a crossing or there is no room beside the
        corridor. ``place``: metres along the street and from the kerb."""
        f, side, (s, from_kerb) = self.f, self.side, place
        if f.near_crossing(s, self.corner + across):
            return
        limit = side * (self.front - 0.1)
        u = f.free_u(s, side * (f.plan.kerb(side) + from_kerb), max(across, 0.3), across, side, limit)
        if u is not None:
            f.place(kind, (s, u), turn, size, *rgb, form=form)


def furnish_sidewalk(f: Furnisher, side: int) -> None:
    """Everything on one sidewalk."""
    walk = Sidewalk(f, side)
    _street_trees(walk)
    _lamps(walk)
    if not f.plan.urban and f.chance(0.7) and side < 0:  # wooden poles
        for s in f.along(-20 + f.uniform(0, 25), walk.end, lambda: 28):
            size = (0.26, 0.26, f.uniform(7.5, 9.0))
            walk.put(rec.POLE, (s, walk.width - 0.5), 0.15, 0, size, (0.16, 0.11, 0.075), form=(1.0,))
    for _ in range(int(f.rng.integers(4, 9))):
        _sign(walk, f.uniform(4, f.plan.drive_length + 75))
    for _ in range(int(f.rng.integers(2, 7))):
        _furniture(walk, f.uniform(0, f.plan.drive_length + 70))
    if f.plan.urban and f.chance(0.35):
        s, step = f.uniform(0, 40), f.uniform(1.4, 2.2)
        for i in range(int(f.rng.integers(5, 14))):
            walk.put(rec.BOLLARD, (s + i * step, 0.4), 0.1, 0, (0.12, 0.12, 0.95), (0.03, 0.03, 0.035))


def _street_trees(walk: Sidewalk) -> None:
    f, side = walk.f, walk.side
    if not f.chance(0.7 if f.plan.urban else 0.8):
        return
    spacing = f.uniform(8, 16)
    for s in f.along(-20 + f.uniform(0, spacing), walk.end, lambda: spacing * f.uniform(0.9, 1.1)):
        if f.chance(0.85) and not f.near_crossing(s, walk.corner + 2):
            u = f.free_u(s, side * (f.plan.kerb(side) + 0.9), 0.5, 0.35, side, side * (walk.front - 0.4))
            if u is not None:
                rec.plant_tree(f, s, u)


def _lamps(walk: Sidewalk) -> None:
    f = walk.f
    spacing = f.uniform(18, 32)
    start, tone = -25 + f.uniform(0, spacing), f.uniform(0.03, 0.35)
    old_style = float(f.plan.urban and f.chance(0.25))
    height = f.uniform(3.4, 4.4) if old_style else f.uniform(6.5, 9)
    for s in f.along(start, walk.end, lambda: spacing):
        size, reach = (0.2, f.uniform(0.11, 0.17), height), f.uniform(1.2, 2.4)
        rgb = (tone, tone, tone * 1.03)
        walk.put(rec.LAMP, (s, 0.5), 0.15, walk.facing_street, size, rgb, form=(reach, old_style))


def _furniture(walk: Sidewalk, s: float) -> None:
    f = walk.f
    what = float(f.rng.random())
    if what < 0.3:
        size = (0.45, 0.5, f.uniform(0.9, 1.3))
        rgb = f.pick(((0.03, 0.09, 0.05), (0.05, 0.07, 0.16), (0.09, 0.09, 0.09), (0.2, 0.16, 0.02)))
        walk.put(rec.BIN, (s, 0.6), 0.3, walk.facing_street, size, rgb)
    elif what < 0.5:
        walk.put(rec.BENCH, (s, walk.width * 0.7), 0.35, walk.facing_back, (1.7, 0.5, 0.9), (0.2, 0.1, 0.05))
    elif what < 0.7 and f.plan.urban:
        rgb = (0.4, 0.39, 0.37)
        walk.put(rec.PLANTER, (s, walk.width - 0.8), 0.4, 0, (1.4, 0.6, 0.5), rgb, f.pick(LEAF_COLORS))
    elif what < 0.85:
        turn = f.uniform(-0.3, 0.3) + (math.pi if f.chance(0.5) else 0)
        rgb = f.pick(((0.4, 0.02, 0.02), (0.02, 0.02, 0.03), (0.05, 0.1, 0.35)))
        walk.put(rec.MOTORBIKE, (s, 0.75), 0.4, turn, (2.0, 0.7, 1.1), rgb)
    elif walk.width > 3.0:
        rgb = f.pick(((0.5, 0.1, 0.1), (0.1, 0.3, 0.5)))
        walk.put(rec.SHELTER, (s, 1.5), 0.9, walk.facing_back, (3.6, 1.5, 2.5), rgb)


def _sign(walk: Sidewalk, s: float) -> None:
    f = walk.f
    towards = math.pi if walk.side < 0 else 0.0  # right-hand signs face the traffic that drives along +s
    draw = float(f.rng.random())
    if draw < 0.3:
        mask, size, motif, rgb = 1, f.uniform(0.30, 0.38), float(f.rng.integers(0, 3)), (0.7, 0.7, 0.7)
    elif draw < 0.6:
        mask, rgb = (2, (0.7, 0.7, 0.7)) if draw < 0.5 else (6, (0.7, 0.45, 0.03))
        size, motif = f.uniform(0.36, 0.44), 0.0
    elif draw < 0.7:
        mask, size, motif, rgb = 3, 0.38, 0.0, (0.5, 0.02, 0.03)
    else:
        mask, size, motif = 0, f.uniform(0.28, 0.4), 1.0
        rgb = ((0.02, 0.08, 0.35), (0.03, 0.22, 0.10), (0.72, 0.72, 0.7))[int(f.rng.integers(3))]
    width = size * f.uniform(1.6, 2.6) if mask == 0 else 0.0
    ink = (0.75, 0.75, 0.74) if rgb[0] < 0.5 else DARK
    place, board = (s, f.uniform(0.35, 0.7)), (0.1, width, f.uniform(2.1, 2.7))
    walk.put(rec.SIGN, place, 0.3, towards, board, rgb, ink, form=(mask, size, float(f.chance(0.25)), motif))


# furnish ------------------------------------------------------------------------------------------


def furnish(config: CityConfig, plan: rec.StreetPlan) -> list[list[float]]:
    """Records of everything static."""
    f = Furnisher(config, plan)
    for side in (-1, 1):
        _building_row(f, side)
        furnish_sidewalk(f, side)
    if plan.crossing is not None:
        _crossing_surroundings(f, plan.crossing)
    _background(f)
    if config.overhead > 0:
        add_overhead(f, config.overhead)
    return f.rows


def _facade(f: Furnisher, shop: bool) -> tuple[float, ...]:
    bay, modern = f.uniform(2.2, 4.0), f.chance(0.3)
    width = f.uniform(0.6, 0.85) if modern else f.uniform(0.32, 0.55)
    window = f.uniform(1.6, 2.1) if modern else f.uniform(1.3, 1.8)
    sill = f.uniform(0.45, 0.8) if modern else f.uniform(0.75, 1.0)
    floor, ground = f.uniform(2.9, 3.5), f.uniform(3.6, 4.6) if shop else f.uniform(2.9, 3.4)
    return (bay, floor, ground, width, sill, window, f.uniform(0.12, 0.28), float(shop))


def _building(f: Furnisher, start: Place, end: Place, side: int, depth: float) -> None:
    """A building whose front runs between two places in the world; ``side`` +1 = it stands to the left of that
    direction."""
    (x0, y0), (x1, y1), urban = start, end, f.plan.urban
    length, yaw = math.hypot(x1 - x0, y1 - y0), math.atan2(y1 - y0, x1 - x0)
    nx, ny = -math.sin(yaw) * side, math.cos(yaw) * side
    cx, cy = 0.5 * (x0 + x1) + nx * depth / 2, 0.5 * (y0 + y1) + ny * depth / 2
    brick = f.chance(0.35)
    shop = urban and f.chance(0.55)
    if urban:
        height = f.uniform(8, 14) if f.chance(0.45) else f.uniform(13, 28)
        gable = height < 12 and f.chance(0.35)
    else:
        height, gable = f.uniform(3.3, 6.8), f.chance(0.85)
    facade = _facade(f, shop)
    floors = max(1, round((height - facade[2]) / facade[1]))
    height = facade[2] + floors * facade[1] + (0.2 if gable else 0.7)
    if not urban and f.chance(0.4):
        height = facade[2] + 0.25
    wall = f.pick(rec.BRICK_COLORS if brick else RENDER_COLORS)
    trim = f.pick(((0.62, 0.60, 0.56), (0.45, 0.43, 0.40), (0.30, 0.29, 0.28), (0.70, 0.69, 0.67)))
    front = (*facade, float(gable), float(urban and f.chance(0.35)), float(brick))
    yaw_out = yaw if side > 0 else yaw + math.pi  # local -y faces the street
    size = (length, depth, height)
    f.rows.append(record(rec.BUILDING, (cx, cy, 0.0), yaw_out, size, f.seed(), wall, trim, form=front))


def _building_row(f: Furnisher, side: int) -> None:
    plan, line = f.plan, f.plan.line
    s, front = -60.0 + f.uniform(0, 8), plan.front(side)
    while s < plan.drive_length + rec.AHEAD_M - 25:
        length = f.uniform(9, 26) if plan.urban else f.uniform(8, 14)
        if f.near_crossing(s + length / 2, length / 2 + (plan.crossing.sidewalk if plan.crossing else 0) + 1.0):
            s += 2.0
            continue
        setback = f.uniform(3.5, 8.0) if not plan.urban else f.uniform(*((0.0, 0.6) if f.chance(0.75) else (0.6, 3.0)))
        u = side * (front + setback + 0.012 * length)
        if f.blocked(s + length / 2, u, length / 2, 0.3):
            u = plan.ego_u + side * (f.reach + 0.6)
        if f.chance(0.1 if plan.urban else 0.12):
            _green_lot(f, side, s, length)
        else:
            start, end = line.point(s, u)[:2], line.point(s + length, u)[:2]
            _building(f, start, end, side, f.uniform(9, 13) if plan.urban else f.uniform(7, 10))
            if not plan.urban or setback > 1.5:
                _front_garden(f, side, s, length, setback)
        s += length + ((0.02 if f.chance(0.7) else f.uniform(1, 4)) if plan.urban else f.uniform(3, 9))


def _front_garden(f: Furnisher, side: int, s: float, length: float, setback: float) -> None:
    front = f.plan.front(side)
    middle, u = s + length / 2, side * (front + 0.25)
    if f.blocked(middle, u, length / 2 + 2, 0.4):
        return
    draw, extent = float(f.rng.random()), length + (0 if f.plan.urban else 2.0)
    if draw < 0.3:
        height = f.uniform(0.8, 1.6)
        size, rgb = (extent, f.uniform(0.6, 0.9), height), f.pick(LEAF_COLORS[:3])
        f.place(rec.HEDGE, (middle, u + side * 0.2), 0, size, rgb, form=(0, 0, 0, 0.17))
    elif draw < 0.55:
        brick = f.chance(0.5)
        rgb, size = f.pick(rec.BRICK_COLORS if brick else RENDER_COLORS), (extent, 0.24, f.uniform(0.6, 1.5))
        f.place(rec.WALL, (middle, u), 0, size, rgb, (0.5, 0.49, 0.46), form=(float(brick),))
    elif draw < 0.9:
        _fence(f, middle, u, extent)
    if setback > 3.0:
        for _ in range(int(f.rng.integers(0, 3))):
            bush, size = side * (front + f.uniform(1.2, setback - 0.8)), f.uniform(0.9, 1.7)
            place, turn = (s + f.uniform(0.5, length - 0.5), bush), f.uniform(0, 3)
            sizes, rgb = (size, size, size * f.uniform(0.7, 1.1)), f.pick(LEAF_COLORS)
            f.place(rec.BUSH, place, turn, sizes, rgb, form=(0, 0, 0, 0.15), z=0.08)
        if f.chance(0.5) and setback > 4:
            rec.plant_tree(f, s + f.uniform(1, length - 1), side * (front + setback * 0.5), garden=True)


def _fence(f: Furnisher, s: float, u: float, length: float) -> None:
    style = int(f.rng.integers(0, 3))
    color = (DARK, (0.25, 0.26, 0.26), (0.30, 0.18, 0.09))[style]
    if style == 0 and f.chance(0.4):
        color = (0.6, 0.6, 0.58)
    bars = (float(style), *((0.16, 0.09) if f.chance(0.35) else (0.13, 0.025)))
    f.place(rec.FENCE, (s, u), 0, (length, 0.05, f.uniform(0.9, 1.8)), color, form=bars)


def _green_lot(f: Furnisher, side: int, s: float, length: float) -> None:
    middle, front = s + length / 2, f.plan.front(side)
    u = side * (front + 0.3)
    if not f.blocked(middle, u, length / 2, 0.4):
        if f.chance(0.5):
            _fence(f, middle, u, length)
        else:
            brick = f.chance(0.5)
            size, rgb = (length, 0.26, f.uniform(1.0, 2.3)), f.pick(rec.BRICK_COLORS if brick else RENDER_COLORS)
            f.place(rec.WALL, (middle, u), 0, size, rgb, (0.5, 0.49, 0.46), form=(float(brick),))
    for _ in range(int(length / 5)):
        rec.plant_tree(f, s + f.uniform(0, length), side * (front + f.uniform(2.5, 12)), garden=True)


def _crossing_surroundings(f: Furnisher, crossing: rec.Crossing) -> None:
    plan, edge = f.plan, crossing.half_width + crossing.sidewalk
    for arm in (-1, 1):
        if not crossing.has_arm(arm):  # a T-junction: buildings go on along the closed side
            half, u = edge + 0.9, arm * (plan.front(arm) + (0.4 if plan.urban else 5.0))
            start, end = (plan.line.point(crossing.s + off, u)[:2] for off in (-half, half))
            if not f.blocked(crossing.s, u, half, 0.3):
                _building(f, start, end, arm, 11.0)
            continue
        for side in (-1, 1):
            a = plan.front(arm) + (14 if plan.urban else 19) + f.uniform(0, 3)
            while a < 120:
                length = f.uniform(9, 22) if plan.urban else f.uniform(8, 13)
                b = side * (edge + (f.uniform(0.2, 0.8) if plan.urban else f.uniform(3.5, 6)))
                start, end = crossing.to_world(arm * a, b), crossing.to_world(arm * (a + length), b)
                _building(f, start, end, side * arm, f.uniform(9, 12))
                if f.chance(0.5):
                    place = (*crossing.to_world(arm * (a + 2), side * (crossing.half_width + 0.9)), rec.KERB_M)
                    size, seed, rgb = (1, 1, f.uniform(6, 9)), f.seed(), f.pick(LEAF_COLORS)
                    crown = (f.uniform(1.8, 2.5), 0.6, 0.0, 0.27, 0.15)
                    f.rows.append(record(rec.TREE, place, 0.0, size, seed, rgb, TRUNK, form=crown))
                a += length + (0.05 if plan.urban else f.uniform(3, 8))
        # something closes the view
        _block(f, crossing.to_world(arm * 125.0, 0.0), crossing.yaw + arm * -math.pi / 2, (40, 12, f.uniform(9, 16)))
    if plan.urban or f.chance(0.3):
        _signals(f, crossing)


def _block(f: Furnisher, xy: Place, yaw: float, size: Size) -> None:
    """A plain building at a place in the world."""
    seed, rgb, front = f.seed(), f.pick(RENDER_COLORS), (*_facade(f, False), 0.0, 0.0, 0.0)
    f.rows.append(record(rec.BUILDING, (*xy, 0), yaw, size, seed, rgb, (0.6, 0.58, 0.55), form=front))


def _signals(f: Furnisher, crossing: rec.Crossing) -> None:
    plan, lit = f.plan, float(f.rng.integers(0, 3))
    gap, tone = crossing.half_width + crossing.corner * 0.6 + 1.6, f.uniform(0.03, 0.3)
    rgb = (tone, tone, tone)
    for side, along, towards in ((-1, -gap, math.pi), (-1, gap + 4, math.pi), (1, gap, 0.0), (1, -gap - 4, 0.0)):
        s, kerb = crossing.s + along, plan.kerb(side)
        u = f.free_u(s, side * (kerb + 0.6), 0.5, 0.4, side, side * plan.front(side))
        if u is None:
            continue
        arm = f.uniform(2.5, 4.5) if f.chance(0.5) and not f.blocked(s, u - side * 4, 1.0, 1.0) else 0.0
        # the mast arm of local +y reaches over the road on the driver's side
        size = (0.3, 0.3, f.uniform(3.4, 3.8) if not arm else 5.6)
        f.place(rec.SIGNAL, (s, u), towards, size, rgb, form=(arm, lit))
    for arm in (-1, 1):
        a = arm * (plan.kerb(arm) + crossing.corner * 0.6 + 1.0)
        if crossing.has_arm(arm) and not f.blocked(crossing.s, a, 1.0, crossing.half_width + 1.5):
            place = (*crossing.to_world(a, arm * (crossing.half_width + 0.7)), rec.KERB_M)
            facing, size, form = crossing.yaw + (0.0 if arm > 0 else math.pi), (0.3, 0.3, 3.5), (0.0, 2.0 - lit)
            f.rows.append(record(rec.SIGNAL, place, facing, size, f.seed(), rgb, form=form))


def _background(f: Furnisher) -> None:
    """Taller blocks behind the first row, a wood or a block at the end of the street, hills at the horizon."""
    plan = f.plan
    end = plan.drive_length + rec.AHEAD_M - 22
    x, y, heading = plan.line.point(end, 0)
    if plan.urban:
        place = (x + 8 * math.cos(heading), y + 8 * math.sin(heading))
        _block(f, place, heading - math.pi / 2, (60, 12, f.uniform(12, 24)))
    for i in range(14):
        u, size = (i - 6.5) * 7.0 + f.uniform(-2, 2), f.uniform(9, 16)
        place, rgb, crown = (end + f.uniform(16, 30), u), f.pick(LEAF_COLORS[:4]), (size * 0.34, 0.8, 0.0, 0.6, 0.25)
        f.place(rec.TREE, place, 0, (1, 1, size), rgb, TRUNK, form=crown, z=0.0)
    for side in (-1, 1) if plan.urban or f.chance(0.4) else ():
        for _ in range(int(f.rng.integers(2, 7))):
            s, u = f.uniform(20, end), side * f.uniform(38, 75)
            if f.near_crossing(s, 16):
                continue
            size = (f.uniform(12, 24), f.uniform(12, 20), f.uniform(20, 48))
            rgb, front = f.pick(RENDER_COLORS), (*_facade(f, False), 0.0, 0.0, 0.0)
            f.place(rec.BUILDING, (s, u), 0 if side > 0 else math.pi, size, rgb, form=front, z=0.0)
    for i in range(8):
        angle, distance, height = heading + (i - 3.5) * 0.42, f.uniform(260, 480), f.uniform(10, 42)
        place = (x + distance * math.cos(angle), y + distance * math.sin(angle), -2.0)
        yaw, size, seed = f.uniform(0, 3), (f.uniform(160, 320), f.uniform(120, 220), height), f.seed()
        form = (float(height > 14),)
        f.rows.append(record(rec.HILL, place, yaw, size, seed, f.pick(LEAF_COLORS[:3]), form=form))
