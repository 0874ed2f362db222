"""Objects with poses: moving, waiting and parked vehicles, pedestrians, cyclists; and the recording vehicle."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mudg.base import geometry, seeds
from mudg.city import layout as rec
from mudg.city.config import CityConfig
from mudg.city.layout import KERB_M, Color, Crossing, Draws, Size, StreetPlan, colors, record
from mudg.city.sensors import pitch_rotation

Array = NDArray[np.float64]

PAINTS = colors(
    "0.62 0.62 0.62, 0.70 0.70 0.69, 0.018 0.018 0.02, 0.05 0.052 0.056, 0.16 0.165 0.17, 0.32 0.33 0.34",
    "0.30 0.018 0.018, 0.02 0.05 0.20, 0.05 0.10 0.24, 0.16 0.12 0.08, 0.03 0.09 0.06, 0.42 0.18 0.03",
    "0.50 0.42 0.05",
)
BUS_COLORS = colors("0.45 0.03 0.03, 0.55 0.42 0.03, 0.6 0.6 0.58, 0.03 0.16 0.30, 0.05 0.25 0.12")
BUS_TRIM = (0.6, 0.6, 0.58)
CARS = (((4.4, 4.9), (1.40, 1.48)), ((3.7, 4.3), (1.45, 1.55)), ((4.3, 4.8), (1.62, 1.78)), ((4.5, 4.9), (1.45, 1.53)))
"""Lengths and heights of each style, metres."""
PAINT_WEIGHTS = np.array([4, 4, 3, 3, 3, 3, 2, 1.5, 1.5, 1, 0.7, 0.5, 0.3])
KEY_MARGIN_S = 0.5
RIG_BOX = (-1.2, 3.2)  # where cameras may sit along the vehicle, with clearance, metres
CLEARANCE_M = 0.9


@dataclass(frozen=True, slots=True, eq=False)
class PosedObject:
    """One posed object: its record (pose columns unused), keys f64[T, 4] = x, y, z of the ground point and yaw."""

    row: list[float]
    keys: Array
    gait_rad_per_s: float
    moving: bool

    @property
    def size(self) -> tuple[float, float, float]:
        """Length, width, height in metres."""
        return (self.row[5], self.row[6], self.row[7])


def key_times(config: CityConfig) -> Array:
    """Times of the pose keys: the frame times and a margin on both sides."""
    margin = max(1, math.ceil(KEY_MARGIN_S * config.rate_hz))
    return np.arange(-margin, config.n_frames + margin) / config.rate_hz


def ego_keys(config: CityConfig, plan: StreetPlan) -> tuple[Array, Array]:
    """Times and world_from_ego f64[T, 4, 4] of the recording vehicle, four keys per frame; the ego frame lies on the
    ground below the vehicle. The first frame's pose is the identity."""
    rng = seeds.numpy_rng(config.seed, 0, "city ego")
    per_frame, margin = 4, 2
    times = np.arange(-margin, (config.n_frames - 1) * per_frame + margin + 1) / (config.rate_hz * per_frame)
    s = plan.ego_s(times)
    wander = rng.uniform(0.05, 0.25) * np.sin(s / rng.uniform(12, 25))
    x, y, heading = plan.line.to_world(s, plan.ego_u + wander)
    heading = heading + np.gradient(wander, s)
    heading -= np.interp(0.0, times, heading)
    bump = rng.uniform(0.5, 1.0, 3) * np.array([0.012, 0.006, 0.006])
    rate = rng.uniform(0.9, 2.2, 3) * 2 * np.pi
    poses = np.empty((len(times), 4, 4))
    for i, t in enumerate(times):
        z, pitch, roll = bump * np.sin(rate * t) * np.clip(abs(t) * 2, 0, 1)
        c, n = math.cos(roll), math.sin(roll)
        attitude = pitch_rotation(pitch) @ np.array([[1, 0, 0], [0, c, -n], [0, n, c]])
        poses[i] = geometry.yaw_matrix(float(heading[i]), (x[i], y[i], z))
        poses[i, :3, :3] = poses[i, :3, :3] @ attitude
    poses[margin] = np.eye(4)
    return times, poses


class TrafficPlanner(Draws):
    """Proposes objects and keeps those that collide neither with each other nor with the shifted cameras."""

    def __init__(self, config: CityConfig, plan: StreetPlan, ego_times: Array, ego_poses: Array) -> None:
        super().__init__(config.seed, "city traffic")
        self.config, self.plan = config, plan
        self.times = key_times(config)
        self.objects: list[PosedObject] = []
        frames = np.arange(config.n_frames) / config.rate_hz
        at_frames = np.rint((frames - ego_times[0]) * config.rate_hz * 4).astype(int)
        self._ego_xy = ego_poses[at_frames, :2, 3]
        self._ego_yaw = np.arctan2(ego_poses[at_frames, 1, 0], ego_poses[at_frames, 0, 0])
        self._frame_key = int(np.rint(-self.times[0] * config.rate_hz)) + np.arange(config.n_frames)
        self._paths = np.zeros((0, len(self.times), 2))  # of all kept objects
        self._radii = np.zeros(0)
        self.duration_s = (config.n_frames - 1) / config.rate_hz

    def add(self, row: list[float], keys: Array, gait: float = 0.0, moving: bool = True) -> bool:
        """Keep the object unless it collides; returns whether it was kept."""
        half_l, half_w = row[5] / 2, row[6] / 2
        if self._meets_cameras(keys, half_l, half_w) or self._meets_others(keys, half_l, half_w):
            return False
        row = row[:-1] + [float(len(self.objects) + 1)]
        self.objects.append(PosedObject(row, keys, gait, moving))
        self._paths = np.concatenate([self._paths, keys[None, :, :2]])
        self._radii = np.append(self._radii, math.hypot(half_l, half_w))
        return True

    def _meets_cameras(self, keys: Array, half_l: float, half_w: float) -> bool:
        at = keys[self._frame_key]
        dx, dy = (at[:, :2] - self._ego_xy).T
        c, s = np.cos(self._ego_yaw), np.sin(self._ego_yaw)
        x, y = c * dx + s * dy, -s * dx + c * dy
        turn = at[:, 3] - self._ego_yaw
        ex = np.abs(np.cos(turn)) * half_l + np.abs(np.sin(turn)) * half_w
        ey = np.abs(np.sin(turn)) * half_l + np.abs(np.cos(turn)) * half_w
        reach = self.config.shift_margin_m + CLEARANCE_M
        return bool(((x + ex > RIG_BOX[0]) & (x - ex < RIG_BOX[1]) & (np.abs(y) < reach + ey)).any())

    def _meets_others(self, keys: Array, half_l: float, half_w: float) -> bool:
        radius = math.hypot(half_l, half_w)
        gap = keys[None, :, :2] - self._paths
        all_near = gap[..., 0] ** 2 + gap[..., 1] ** 2 < (radius + self._radii[:, None]) ** 2
        for index in np.flatnonzero(all_near.any(1)):
            other, near = self.objects[index], all_near[index]
            a, b = keys[near], other.keys[near]
            # separating axes of both rectangles
            separated = np.zeros(len(a), bool)
            for yaw in (a[:, 3], b[:, 3]):
                for turn in (0.0, math.pi / 2):
                    ax, ay = np.cos(yaw + turn), np.sin(yaw + turn)
                    distance = np.abs(ax * (b[:, 0] - a[:, 0]) + ay * (b[:, 1] - a[:, 1]))
                    reach = 0.25
                    for keys_k, hl, hw in ((a, half_l, half_w), (b, other.size[0] / 2, other.size[1] / 2)):
                        cos, sin = np.cos(keys_k[:, 3]), np.sin(keys_k[:, 3])
                        reach = reach + hl * np.abs(ax * cos + ay * sin) + hw * np.abs(-ax * sin + ay * cos)
                    separated |= distance > reach
            if not separated.all():
                return True
        return False

    def vehicle(self, allow_big: bool = True) -> list[float]:
        """Record of a random vehicle."""
        paint = PAINTS[int(self.rng.choice(len(PAINTS), p=PAINT_WEIGHTS / PAINT_WEIGHTS.sum()))]
        seed = self.seed()
        if self.config.overhead > 0 and self.chance((0.3 if allow_big else 0.08) * self.config.overhead):
            return self.tall_vehicle(seed, paint)
        draw = float(self.rng.random())
        if draw < 0.10:
            size = (self.uniform(5.0, 6.2), self.uniform(1.95, 2.1), self.uniform(2.1, 2.6))
            return posed(rec.VAN, size, seed, PAINTS[1] if self.chance(0.6) else paint)
        if allow_big and draw < 0.17:
            size = (self.uniform(6.5, 9.0), 2.45, self.uniform(3.0, 3.7))
            return posed(rec.TRUCK, size, seed, paint, self.box_color(0.6))
        if allow_big and draw < 0.21:
            body = BUS_COLORS[int(self.rng.integers(5))]
            return posed(rec.BUS, (self.uniform(10.5, 12), 2.5, 3.1), seed, body, BUS_TRIM)
        style = int(self.rng.choice(4, p=[0.3, 0.32, 0.24, 0.14]))
        length, height = ([self.uniform(*spans[axis]) for spans in CARS][style] for axis in (0, 1))
        return posed(rec.CAR, (length, self.uniform(1.74, 1.88), height), seed, paint, form=(float(style),))

    def tall_vehicle(self, seed: int, paint: Color) -> list[float]:
        """Record of a lorry, tanker or bus of full height."""
        kind, box = float(self.rng.random()), self.box_color(0.5)
        if kind < 0.5:
            return posed(rec.TRUCK, (self.uniform(7.0, 15.0), 2.5, self.uniform(3.6, 4.0)), seed, paint, box)
        if kind < 0.65:
            steel, size = self.uniform(0.3, 0.6), (self.uniform(8.0, 13.0), 2.5, self.uniform(3.3, 3.7))
            return posed(rec.TANKER, size, seed, paint, (steel,) * 3 if self.chance(0.6) else box)
        body = BUS_COLORS[int(self.rng.integers(5))]
        height = self.uniform(4.1, 4.4) if self.chance(0.35) else self.uniform(3.1, 3.5)
        return posed(rec.BUS, (self.uniform(10.5, 12), 2.5, height), seed, body, BUS_TRIM)

    def box_color(self, white: float) -> Color:
        """A colour of a lorry's box; ``white``: with this probability."""
        if self.chance(white):
            return PAINTS[1]
        return (self.uniform(0.05, 0.5), self.uniform(0.05, 0.4), self.uniform(0.05, 0.5))

    def cloth(self) -> Color:
        """A colour of clothing: mostly muted."""
        grey, strength = self.uniform(0.01, 0.3), self.uniform(0.1, 0.8)
        r, g, b = (grey + strength * (self.uniform(0.005, 0.45) - grey) for _ in range(3))
        return (r, g, b)

    def pedestrian(self, speed: float) -> list[float]:
        """Record of a random pedestrian."""
        coat, (r, g, b), height, seed = self.cloth(), self.cloth(), self.uniform(1.55, 1.9), self.seed()
        gait, legs = (min(0.5, 0.33 * speed), float(self.chance(0.3))), (0.4 * r, 0.4 * g, 0.4 * b)
        return posed(rec.PEDESTRIAN, (0.85, 0.65, height), seed, coat, legs, form=gait)

    def stand(self, row: list[float], x: float, y: float, yaw: float) -> None:
        """Keep an object that stands on the road, unless it collides."""
        self.add(row, np.tile([x, y, 0.0, yaw], (len(self.times), 1)), moving=False)

    def along_street(self, s: Array, u: Array | float, direction: int, z: float = 0.0) -> Array:
        """Keys of an object that follows the main street; direction -1 = against it."""
        x, y, heading = self.plan.line.to_world(s, u)
        return np.stack([x, y, np.full(len(s), z), heading + (0.0 if direction > 0 else math.pi)], 1)


def posed(kind: int, size: Size, seed: int, *rgb: Color, form: rec.Form = ()) -> list[float]:
    """Record of an object whose pose comes from its keys."""
    return record(kind, (0, 0, 0), 0, size, seed, *rgb, form=form)


def plan_traffic(config: CityConfig, plan: StreetPlan, ego_times: Array, ego_poses: Array) -> list[PosedObject]:
    """All posed objects of a world; their public id is their position + 1."""
    t = TrafficPlanner(config, plan, ego_times, ego_poses)
    if config.traffic <= 0:
        return []
    if plan.crossing is not None:
        _turning(t, plan.crossing)
    _lead(t)
    _lanes(t)
    if plan.crossing is not None:
        _crossing_traffic(t, plan.crossing)
    _cyclists(t)
    _parked(t)
    _pedestrians(t)
    return t.objects


def _lead(t: TrafficPlanner) -> None:
    """A car ahead in the own lane, at the own speed, gently closing or opening."""
    ego_s = t.plan.ego_s(t.times)
    gap = t.uniform(9, 20)
    for _ in range(int(1 + 2 * t.config.traffic)):
        if t.chance(0.85):
            drift = t.uniform(-0.5, 0.8)
            row = t.vehicle()
            s = ego_s + gap + row[5] / 2 + drift * t.times
            t.add(row, t.along_street(s, t.plan.ego_u + t.uniform(-0.2, 0.2), 1))
        gap += t.uniform(12, 30)
    s = ego_s - t.uniform(9, 16)
    t.add(t.vehicle(), t.along_street(s, t.plan.ego_u, 1))


def _lanes(t: TrafficPlanner) -> None:
    ego_s = t.plan.ego_s(t.times)
    density = max(0.5, t.config.traffic)
    for u in t.plan.forward_lanes:
        if u == t.plan.ego_u:
            continue
        start, drift = t.uniform(-25, 8), t.uniform(-1.2, 1.2)
        for s in t.along(start, 80, lambda: t.uniform(10, 24) / density):
            if t.chance(0.6 * min(1.0, t.config.traffic)):
                t.add(t.vehicle(), t.along_street(ego_s + s + drift * t.times, u + t.uniform(-0.2, 0.2), 1))
    for u in t.plan.backward_lanes:
        speed, start = t.uniform(6, 12), t.uniform(-30, 10)
        for s in t.along(start, t.plan.drive_length + 170, lambda: t.uniform(9, 38) / density):
            if t.chance(0.7):
                t.add(t.vehicle(), t.along_street(s - speed * t.times, u + t.uniform(-0.25, 0.25), -1))


def _follow(points: Array, start: float, speed: float, times: Array) -> Array:
    """Keys of an object that follows a polyline [n, 2], at ``start`` metres at time 0."""
    step = np.hypot(*np.diff(points, axis=0).T)
    length = np.concatenate([[0.0], np.cumsum(step)])
    at = np.clip(start + speed * times, 0.0, length[-1] - 1e-3)
    ways = (at, np.minimum(at + 0.8, length[-1]), np.maximum(at - 0.8, 0.0))
    xy, ahead, back = (np.stack([np.interp(way, length, points[:, k]) for k in range(2)], 1) for way in ways)
    direction = ahead - back
    return np.column_stack([xy, np.zeros(len(times)), np.unwrap(np.arctan2(direction[:, 1], direction[:, 0]))])


def _turning(t: TrafficPlanner, crossing: Crossing) -> None:
    """A car that turns from the crossing street into the main street, under way in the middle of the log."""
    plan = t.plan
    for _ in range(2):
        arm = 1 if crossing.end > 0 and (crossing.start >= 0 or t.chance(0.5)) else -1
        towards_ego = t.chance(0.55) and bool(plan.backward_lanes)
        u = plan.backward_lanes[-1] if towards_ego else plan.forward_lanes[-1]
        b = arm * crossing.half_width * 0.5  # inbound traffic keeps right
        start, corner, inbound = (np.array(crossing.to_world(a, b)) for a in (arm * 60.0, u, u + arm * 7.0))
        s_out = crossing.s + (-1 if towards_ego else 1) * np.arange(7.0, 90.0, 1.0)
        out = plan.line.line(s_out, np.full(len(s_out), u))[:, :2]
        f = np.linspace(0, 1, 24)[:, None]  # a quadratic curve with both tangents through the corner
        bend = (1 - f) ** 2 * inbound + 2 * f * (1 - f) * corner + f**2 * out[0]
        path = np.concatenate([start[None], bend, out[1:]])
        speed = t.uniform(4.0, 6.0)
        at_middle = float(np.hypot(*(inbound - start))) + t.uniform(0, 10)
        if t.add(t.vehicle(allow_big=False), _follow(path, at_middle - speed * t.duration_s / 2, speed, t.times)):
            return


def _crossing_traffic(t: TrafficPlanner, crossing: Crossing) -> None:
    for arm in (-1, 1):
        if not crossing.has_arm(arm):
            continue
        kerb, lane = t.plan.kerb(arm), arm * crossing.half_width * 0.5
        a = kerb + crossing.corner * 0.6 + 7.5
        for _ in range(2):
            if t.chance(0.6):  # waiting at the line
                row = t.vehicle(allow_big=False)
                t.stand(row, *crossing.to_world(arm * (a + row[5] / 2), lane), crossing.yaw + math.pi * (arm > 0))
            a += t.uniform(6, 8)
        speed, offset = t.uniform(4, 8), t.uniform(10, 40)
        xy = np.array([crossing.to_world(float(v), -lane) for v in arm * (offset + speed * t.times)])
        yaw = crossing.yaw + math.pi * (arm < 0)
        if offset + speed * t.times[0] > kerb:
            t.add(t.vehicle(), np.column_stack([xy, np.zeros(len(xy)), np.full(len(xy), yaw)]))


def _cyclists(t: TrafficPlanner) -> None:
    ego_s = t.plan.ego_s(t.times)
    for _ in range(int(2 + t.config.traffic)):
        clothes = t.cloth()
        row = posed(rec.CYCLIST, (1.8, 0.62, 1.78), t.seed(), clothes, (0.03, 0.03, 0.05))
        speed = t.uniform(3.5, 6.0)
        if t.chance(0.6) or not t.plan.backward_lanes:
            u = t.plan.right + t.plan.park_right + 0.6
            s = t.uniform(8, 40) + speed * t.times
            if t.chance(0.5):
                s = ego_s + t.uniform(8, 26) + t.uniform(-1, 0.5) * t.times
            keys = t.along_street(s, u, 1)
        else:
            s = t.uniform(20, 60) + 0.5 * t.plan.drive_length - speed * t.times
            keys = t.along_street(s, t.plan.left - t.plan.park_left - 0.6, -1)
        t.add(row, keys, gait=7.0)


def _parked(t: TrafficPlanner) -> None:
    plan, crossing = t.plan, t.plan.crossing
    walks = [(start, length) for start, length, on_cross in plan.crosswalks if on_cross < 0.5]
    for side, band in ((1, plan.park_left), (-1, plan.park_right)):
        if band <= 0:
            continue
        s = -30 + t.uniform(0, 6)
        while s < plan.drive_length + 110:
            row = t.vehicle(allow_big=False)
            half = row[5] / 2
            clear = crossing is None or abs(s + half - crossing.s) > crossing.half_width + crossing.corner + 6
            walk = any(start - 5 < s + half < start + length + 5 for start, length in walks)
            if clear and not walk and t.chance(0.72 * min(1.0, t.config.traffic)):
                u = side * (plan.kerb(side) - 0.18 - row[6] / 2 - t.uniform(0, 0.15))
                against = bool(side > 0 and plan.backward_lanes)
                x, y, heading = plan.line.point(s + half, u)
                t.stand(row, x, y, heading + math.pi * against + t.uniform(-0.02, 0.02))
            s += row[5] + t.uniform(0.7, 1.6)


def _pedestrians(t: TrafficPlanner) -> None:
    plan, crossing = t.plan, t.plan.crossing
    for _ in range(int(round((10 if plan.urban else 5) * t.config.traffic))):
        speed = t.uniform(0.9, 1.6) if t.chance(0.85) else 0.0
        direction, side = t.side(), t.side()
        s = t.uniform(4, plan.drive_length + 45) + direction * speed * t.times
        u = side * (plan.kerb(side) + t.uniform(0.5, max(0.7, plan.sidewalk(side) - 0.6)))
        if crossing is not None and (np.abs(s - crossing.s) < crossing.half_width + crossing.corner).any():
            continue
        reach = t.config.shift_margin_m + 1.1
        if abs(u - plan.ego_u) < reach:  # walk further out where the shifted cameras pass
            u = plan.ego_u + side * reach
            if abs(u) > plan.front(side) - 0.4:
                continue
        keys = t.along_street(s, u, direction, z=KERB_M)
        if speed == 0.0:
            keys[:, 3] += t.uniform(0, 2 * math.pi)
        t.add(t.pedestrian(speed), keys, gait=2 * math.pi * speed / 1.45, moving=speed > 0)
    for start, length, on_cross in plan.crosswalks:  # somebody crosses the street
        if on_cross > 0.5 or not t.chance(0.7):
            continue
        for _ in range(2):
            speed, side = t.uniform(1.1, 1.5), t.side()
            u = t.uniform(-1, 1) * 4.0 + side * speed * (t.times - t.duration_s / 2)
            s = np.full(len(t.times), start + t.uniform(0.3, length - 0.3))
            x, y, heading = plan.line.to_world(s, u)
            on_walk = (u > plan.left) | (u < plan.right)
            keys = np.stack([x, y, np.where(on_walk, KERB_M, 0.0), heading + side * math.pi / 2], 1)
            t.add(t.pedestrian(speed), keys, gait=2 * math.pi * speed / 1.45)
