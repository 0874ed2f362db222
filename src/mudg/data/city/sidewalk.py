"""Objects on the sidewalks: trees, lamps, poles, signs, bins, benches, bollards."""

from __future__ import annotations

import math

from mudg.data.city import records as rec
from mudg.data.city.furnisher import LEAF_COLORS, Furnisher, plant_tree
from mudg.data.city.layout import AHEAD_M
from mudg.data.city.records import Color

Size = tuple[float, float, float]


class Sidewalk:
    """One sidewalk of the main street; ``side`` +1 left, -1 right; ``front`` = |u| of the building line."""

    def __init__(self, f: Furnisher, side: int, front: float) -> None:
        plan = f.plan
        self.f, self.side, self.front = f, side, front
        self.kerb = abs(plan.kerb(side))
        self.width = plan.sidewalk(side)
        self.end = plan.drive_length + AHEAD_M - 40
        self.corner = (plan.crossing.corner + 2.0) if plan.crossing else 0.0
        self.facing_street = -side * math.pi / 2  # local +x towards the road
        self.facing_back = 0.0 if side < 0 else math.pi

    def put(
        self, kind: int, place: tuple[float, float], across: float, turn: float, size: Size, rgb: Color,
        rgb2: Color = (0.5, 0.5, 0.5), parameters: tuple[float, ...] = (),
    ) -> None:  # fmt: skip
        """Place an object of half width ``across`` unless it stands in a crossing or there is no room beside the corridor.

        ``place``: metres along the street and from the kerb.
        """
        f, (s, from_kerb) = self.f, place
        if f.near_crossing(s, self.corner + across):
            return
        u = f.free_u(
            s, self.side * (self.kerb + from_kerb), max(across, 0.3), across, self.side, self.side * (self.front - 0.1)
        )
        if u is not None:
            f.place(kind, (s, u), turn, size, rgb, rgb2, parameters)


def furnish_sidewalk(f: Furnisher, side: int, front: float) -> None:
    """Everything on one sidewalk."""
    walk = Sidewalk(f, side, front)
    _street_trees(walk)
    _lamps(walk)
    _wooden_poles(walk)
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
    s = -20 + f.uniform(0, spacing)
    while s < walk.end:
        if f.chance(0.85) and not f.near_crossing(s, walk.corner + 2):
            u = f.free_u(s, side * (walk.kerb + 0.9), 0.5, 0.35, side, side * (walk.front - 0.4))
            if u is not None:
                plant_tree(f, s, u)
        s += spacing * f.uniform(0.9, 1.1)


def _lamps(walk: Sidewalk) -> None:
    f = walk.f
    spacing = f.uniform(18, 32)
    s = -25 + f.uniform(0, spacing)
    tone = f.uniform(0.03, 0.35)
    old_style = float(f.plan.urban and f.chance(0.25))
    height = f.uniform(3.4, 4.4) if old_style else f.uniform(6.5, 9)
    while s < walk.end:
        size = (0.2, f.uniform(0.11, 0.17), height)
        reach = f.uniform(1.2, 2.4)
        rgb = (tone, tone, tone * 1.03)
        walk.put(rec.LAMP, (s, 0.5), 0.15, walk.facing_street, size, rgb, parameters=(reach, old_style))
        s += spacing


def _wooden_poles(walk: Sidewalk) -> None:
    f = walk.f
    if f.plan.urban or not f.chance(0.7) or walk.side > 0:
        return
    s = -20 + f.uniform(0, 25)
    while s < walk.end:
        size = (0.26, 0.26, f.uniform(7.5, 9.0))
        walk.put(rec.POLE, (s, walk.width - 0.5), 0.15, 0, size, (0.16, 0.11, 0.075), parameters=(1.0,))
        s += 28


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
        leaves = f.pick(LEAF_COLORS)
        walk.put(rec.PLANTER, (s, walk.width - 0.8), 0.4, 0, (1.4, 0.6, 0.5), (0.4, 0.39, 0.37), leaves)
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
    elif draw < 0.5:
        mask, size, motif, rgb = 2, f.uniform(0.36, 0.44), 0.0, (0.7, 0.7, 0.7)
    elif draw < 0.6:
        mask, size, motif, rgb = 6, f.uniform(0.36, 0.44), 0.0, (0.7, 0.45, 0.03)
    elif draw < 0.7:
        mask, size, motif, rgb = 3, 0.38, 0.0, (0.5, 0.02, 0.03)
    else:
        mask, size, motif = 0, f.uniform(0.28, 0.4), 1.0
        rgb = ((0.02, 0.08, 0.35), (0.03, 0.22, 0.10), (0.72, 0.72, 0.7))[int(f.rng.integers(3))]
    width = size * f.uniform(1.6, 2.6) if mask == 0 else 0.0
    ink = (0.75, 0.75, 0.74) if rgb[0] < 0.5 else (0.03, 0.03, 0.03)
    walk.put(rec.SIGN, (s, f.uniform(0.35, 0.7)), 0.3, towards, (0.1, width, f.uniform(2.1, 2.7)), rgb, ink,
             (float(mask), size, float(f.chance(0.25)), motif))  # fmt: skip
