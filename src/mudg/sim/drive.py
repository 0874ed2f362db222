"""A vehicle that drives in a scene: how it moves, where the road is, who else is on it, what it runs into and sees. The
world is that of the log (metres, z up); the vehicle's frame is the log's: x forward, y left, z up, its origin taken for
the middle of the rear axle."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from mudg.base import geometry
from mudg.base.errors import InputError, UsageError
from mudg.base.types import Camera, View
from mudg.gaussians.model import compose
from mudg.gaussians.nodes import RigidNode
from mudg.gaussians.views import resized_view
from mudg.scene.motion import Road
from mudg.sim.optics import Pinhole
from mudg.sim.session import CameraReply, CameraRequest, Instant, Layer, Session

Matrix = NDArray[np.float64]
Traffic = Literal["log", "idm"]
SURROUNDINGS: Final = "surroundings"
"""What a vehicle hits that hits no object."""
SOLID_ABOVE_M: Final = (0.4, 1.4)
"""Height above the road between which Gaussians stop a vehicle."""
FEWEST_SOLID: Final = 12
"""Solid Gaussians within its body from which on a vehicle hits the surroundings."""
MARGIN_M: Final = 0.15
"""The body is this much narrower and shorter there, for Gaussians have a size of their own."""


@dataclass(frozen=True, slots=True)
class Car:
    """Size and limits of the vehicle that drives, in metres, seconds and radians. ``overhang_m``: from the rear bumper
    to the rear axle."""

    length_m: float = 4.6
    width_m: float = 1.85
    height_m: float = 1.6
    wheelbase_m: float = 2.8
    overhang_m: float = 0.9
    largest_steer_rad: float = 0.6
    largest_speed_mps: float = 40.0

    def box(self, world_from_vehicle: Matrix) -> Box:
        """Its body at a pose."""
        centre = np.eye(4)
        centre[:3, 3] = (self.length_m / 2 - self.overhang_m, 0, self.height_m / 2)
        return Box(world_from_vehicle @ centre, (self.length_m, self.width_m, self.height_m))


@dataclass(frozen=True, slots=True)
class Controls:
    """What a driver asks for until the next step: acceleration m/s^2 (negative: brakes), steering rate rad/s of the
    front wheels (positive: to the left)."""

    acceleration_mps2: float = 0.0
    steer_rate_radps: float = 0.0


@dataclass(frozen=True, slots=True)
class BicycleState:
    """Where the rear axle is in the plane, and how it moves: metres, radians (0 = along x, positive to the left)."""

    x_m: float
    y_m: float
    heading_rad: float
    speed_mps: float
    steer_rad: float = 0.0

    def after(self, controls: Controls, step_s: float, car: Car) -> BicycleState:
        """The kinematic bicycle after a step: steering first, then a circle's arc of the way that even acceleration
        makes. It does not roll backwards."""
        limit = car.largest_steer_rad
        steer = min(max(self.steer_rad + controls.steer_rate_radps * step_s, -limit), limit)
        speed = min(max(self.speed_mps + controls.acceleration_mps2 * step_s, 0.0), car.largest_speed_mps)
        way = (self.speed_mps + speed) / 2 * step_s
        if speed == 0.0 and controls.acceleration_mps2 < 0:
            way = self.speed_mps**2 / (-2 * controls.acceleration_mps2)
        turn = way * math.tan(steer) / car.wheelbase_m
        chord = way * (math.sin(turn / 2) / (turn / 2) if abs(turn) > 1e-9 else 1.0)
        along = self.heading_rad + turn / 2
        x, y = self.x_m + chord * math.cos(along), self.y_m + chord * math.sin(along)
        return BicycleState(x, y, self.heading_rad + turn, speed, steer)


@dataclass(frozen=True, slots=True, eq=False)
class Box:
    """A body: pose f64[4, 4] of its centre (x forward, z up), and length, width and height in metres."""

    world_from_box: Matrix
    size_m: tuple[float, ...]

    def footprint(self) -> Matrix:
        """Its four corners on the ground f64[4, 2], in turn."""
        half = np.array(self.size_m) / 2
        corners = np.array([[1, 1, 0], [-1, 1, 0], [-1, -1, 0], [1, -1, 0]]) * half
        return geometry.transform_points(self.world_from_box, corners)[:, :2]

    def meets(self, other: Box) -> bool:
        """Whether two bodies overlap: as rectangles from above, by separating axes, and in height."""
        apart = abs(self.world_from_box[2, 3] - other.world_from_box[2, 3])
        if apart >= (self.size_m[2] + other.size_m[2]) / 2:
            return False
        ours, theirs = self.footprint(), other.footprint()
        for corners in (ours, theirs):
            for edge in (corners[1] - corners[0], corners[2] - corners[1]):
                a, b = ours @ edge, theirs @ edge
                if a.max() <= b.min() or b.max() <= a.min():
                    return False
        return True


@dataclass(frozen=True, slots=True)
class Following:
    """The intelligent driver model (Treiber, Hennecke and Helbing 2000): metres and seconds. ``speed_mps``: wished
    for."""

    speed_mps: float
    headway_s: float = 1.5
    gap_m: float = 2.0
    acceleration_mps2: float = 1.5
    braking_mps2: float = 2.0

    def acceleration(self, speed_mps: float, gap_m: float = math.inf, closing_mps: float = 0.0) -> float:
        """Acceleration, at least -8 m/s^2, behind somebody at a gap that closes with a speed."""
        free = 1 - (speed_mps / max(self.speed_mps, 0.1)) ** 4
        hard = 2 * math.sqrt(self.acceleration_mps2 * self.braking_mps2)
        wished = self.gap_m + max(0.0, speed_mps * self.headway_s + speed_mps * closing_mps / hard)
        return max(self.acceleration_mps2 * (free - (wished / max(gap_m, 0.1)) ** 2), -8.0)


@dataclass(slots=True)
class Follower:
    """A road user that keeps to its recorded path and follows whoever is ahead on it."""

    road: Road
    size_m: tuple[float, ...]
    station_m: float
    speed_mps: float
    rule: Following

    def box(self) -> Box:
        """Where it is."""
        return Box(self.road.recorded(self.station_m), self.size_m)

    def ahead(self, others: Mapping[str, tuple[Box, float]]) -> tuple[float, float]:
        """Gap to the nearest body ahead on the path, metres, and how fast it closes; none: infinite."""
        gap, closing = math.inf, 0.0
        for box, speed in others.values():
            station, lateral = self.road.locate(box.world_from_box[:2, 3])
            free = station - self.station_m - (self.size_m[0] + box.size_m[0]) / 2
            beside = abs(lateral) > (self.size_m[1] + box.size_m[1]) / 2 + 0.3
            if beside or station <= self.station_m or free >= gap:
                continue
            along = math.cos(geometry.yaw_of(box.world_from_box) - geometry.yaw_of(self.road.recorded(station)))
            gap, closing = free, self.speed_mps - speed * along
        return gap, closing

    def move(self, others: Mapping[str, tuple[Box, float]], step_s: float) -> None:
        """Drive for a step."""
        speed = max(0.0, self.speed_mps + step_s * self.rule.acceleration(self.speed_mps, *self.ahead(others)))
        self.station_m += (self.speed_mps + speed) / 2 * step_s
        self.speed_mps = speed


@dataclass(frozen=True, slots=True, eq=False)
class RoadUser:
    """A recorded road user: times f64[K] in seconds, poses world-from-box f64[K, 4, 4], and size."""

    times_s: NDArray[np.float64]
    poses: Matrix
    size_m: tuple[float, ...]

    def box_at(self, time_s: float) -> Box | None:
        """Where it was; None outside its track."""
        pose = geometry.pose_at(self.times_s, self.poses, time_s)
        return None if pose is None else Box(pose, self.size_m)

    def speed_at(self, time_s: float) -> float:
        """Its speed around a time, m/s."""
        times = np.clip([time_s - 0.1, time_s + 0.1], self.times_s[0], self.times_s[-1])
        if times[1] <= times[0]:
            return 0.0
        places = [np.array([np.interp(t, self.times_s, self.poses[:, axis, 3]) for axis in (0, 1)]) for t in times]
        return float(np.linalg.norm(places[1] - places[0]) / (times[1] - times[0]))


@dataclass(slots=True)
class Drive:
    """One drive: the vehicle, the other road users, and the clock. ``road``: the recorded path. ``actors``: recorded
    road users by name. ``motion``, ``time_s``: where and when it begins. ``traffic``: ``log``: they move as recorded.
    ``idm``: those that moved by more than a metre keep to their recorded path and follow whoever is ahead, this vehicle
    included, by the intelligent driver model. ``solid``: f32[N, 3] centres of opaque Gaussians that stand still; empty:
    the surroundings stop nobody."""

    road: Road
    actors: Mapping[str, RoadUser]
    motion: BicycleState
    time_s: float
    traffic: Traffic = "log"
    solid: NDArray[np.float32] = field(default_factory=lambda: np.zeros((0, 3), np.float32))
    car: Car = field(default_factory=Car)
    _followers: dict[str, Follower] = field(default_factory=dict, init=False)

    @property
    def pose(self) -> Matrix:
        """World-from-vehicle f64[4, 4]."""
        return self.road.place(self.motion.x_m, self.motion.y_m, self.motion.heading_rad)

    @property
    def progress_m(self) -> float:
        """Arc length of the road at the vehicle."""
        return self.road.locate((self.motion.x_m, self.motion.y_m))[0]

    def boxes(self) -> dict[str, Box]:
        """The other road users that are there."""
        found = {}
        for name, actor in self.actors.items():
            follower = self._follower(name, actor)
            box = actor.box_at(self.time_s) if follower is None else follower.box()
            if box is not None:
                found[name] = box
        return found

    def _follower(self, name: str, actor: RoadUser) -> Follower | None:
        """A road user that drives by itself, from when its track begins."""
        moved = np.linalg.norm(actor.poses[-1, :2, 3] - actor.poses[0, :2, 3]) > 1
        if self.traffic == "log" or not moved or not actor.times_s[0] <= self.time_s:
            return None
        if name not in self._followers and actor.box_at(self.time_s) is not None:
            road, steps = Road(actor.poses), np.diff(actor.times_s)
            speeds = np.linalg.norm(np.diff(actor.poses[:, :2, 3], axis=0), axis=1) / steps
            pose = geometry.pose_at(actor.times_s, actor.poses, self.time_s)
            station = road.locate(pose[:2, 3])[0] if pose is not None else 0.0
            rule = Following(max(float(np.quantile(speeds, 0.9)), 1.0))
            self._followers[name] = Follower(road, actor.size_m, station, actor.speed_at(self.time_s), rule)
        return self._followers.get(name)

    def step(self, controls: Controls, step_s: float) -> None:
        """Everybody moves for a step. UsageError: controls that are no finite numbers."""
        if not (math.isfinite(controls.acceleration_mps2) and math.isfinite(controls.steer_rate_radps)):
            raise UsageError("controls are not finite", where="action", got=str(controls))
        bodies = {"": (self.car.box(self.pose), self.motion.speed_mps)}
        for name, box in self.boxes().items():
            follower = self._followers.get(name)
            speed = self.actors[name].speed_at(self.time_s) if follower is None else follower.speed_mps
            bodies[name] = (box, speed)
        for name, follower in self._followers.items():
            follower.move({other: body for other, body in bodies.items() if other != name}, step_s)
        self.motion = self.motion.after(controls, step_s, self.car)
        self.time_s += step_s

    def collision(self) -> str:
        """Name of the object that the vehicle overlaps, ``SURROUNDINGS``, or empty."""
        body = self.car.box(self.pose)
        for name, box in self.boxes().items():
            if body.meets(box):
                return name
        x, y, z = geometry.transform_points(geometry.invert(self.pose), self.solid).T
        rear = MARGIN_M - self.car.overhang_m
        inside = (x > rear) & (x < rear + self.car.length_m - 2 * MARGIN_M)
        inside &= (abs(y) < self.car.width_m / 2 - MARGIN_M) & (z > SOLID_ABOVE_M[0]) & (z < SOLID_ABOVE_M[1])
        return SURROUNDINGS if inside.sum() >= FEWEST_SOLID else ""


def beginning(pose: Matrix, speed_mps: float, shift_m: float = 0.0) -> BicycleState:
    """The motion of a vehicle that begins at a recorded pose, moved to the left."""
    x, y, _ = geometry.transform_points(pose, np.array([[0.0, shift_m, 0.0]]))[0]
    return BicycleState(float(x), float(y), geometry.yaw_of(pose), speed_mps)


# -- a vehicle in a reconstruction ---

OPAQUE: Final = 0.5
"""Opacity from which on a Gaussian of the surroundings stops a vehicle."""


class Cockpit:
    """A session with a vehicle in it. ``session``: of a run, whose log tells the road. ``cameras``: names of the log's
    cameras (empty: the first one). ``width_px``: of their pictures (0 = as recorded). ``layers``: of
    ``session.LAYERS``, without motion. InputError: a fit without its log, or a log that stands still. UsageError: no
    such camera."""

    def __init__(
        self, session: Session, cameras: str | Sequence[str] = (), width_px: int = 0, layers: Sequence[Layer] = ("rgb",)
    ) -> None:
        if session.scene is None:
            remedy = "give the folder of a run, or scene="
            raise InputError("driving needs the log of a fit, which tells the road", remedy=remedy)
        self.session, self.ego, self.layers = session, session.scene.ego, tuple(layers)
        known, self.mounts, self.cameras = session.mounts(), dict[str, Matrix](), dict[str, Camera]()
        for name in ((cameras,) if isinstance(cameras, str) else tuple(cameras)) or tuple(session.cameras)[:1]:
            if name not in known:
                raise UsageError("no such camera", where="cameras", expected=", ".join(session.cameras), got=name[:60])
            self.mounts[name] = known[name]
            self.cameras[name] = resized_view(View(session.cameras[name], known[name], 0.0), width_px).camera
        self.road = Road(self.ego.world_from_ego)
        self.actors = {}
        for node in session.model.nodes:
            if isinstance(node, RigidNode):
                keys = [(time, pose) for time in node.times_s if (pose := node.pose_matrix(float(time))) is not None]
                times, poses = zip(*keys, strict=True)
                self.actors[node.name] = RoadUser(np.array(times), np.stack(poses), node.size_m)
        begin = session.time_range_s[0]
        still = compose(session.at(Instant(begin, np.eye(4), {})), begin)
        self.solid = still.means[still.opacity > OPAQUE].detach().cpu().numpy()

    def drive(self, time_s: float | None = None, shift_m: float = 0.0, traffic: Traffic = "log") -> Drive:
        """A drive that begins where the recorded vehicle was, moved to the left, at its speed. ``time_s``: None: as
        early as objects and vehicle were recorded. UsageError: a time outside the log."""
        first = max(self.session.time_range_s[0], float(self.ego.times_s[0]))
        begin = first if time_s is None else time_s
        pose = self.ego.pose_at(begin)
        if pose is None:
            span = f"{self.ego.times_s[0]:.2f} to {self.ego.times_s[-1]:.2f} s"
            raise UsageError("the drive begins outside the log", where="time_s", expected=span, got=f"{begin:.2f} s")
        speed = RoadUser(self.ego.times_s, self.ego.world_from_ego, ()).speed_at(begin)
        motion = beginning(pose, speed, shift_m)
        return Drive(self.road, self.actors, motion, begin, traffic, self.solid)

    def see(self, drive: Drive) -> dict[str, CameraReply]:
        """What the cameras see, by name; where road users move as recorded, all that the scene knows."""
        objects = {name: box.world_from_box for name, box in drive.boxes().items()} if drive.traffic != "log" else None
        requests = []
        for name, camera in self.cameras.items():
            lens, start = Pinhole.of(camera), Instant(drive.time_s, drive.pose @ self.mounts[name], objects)
            requests.append(CameraRequest(optics=lens, start=start, layers=self.layers, colors_of=name))
        return dict(zip(self.cameras, self.session.render(requests), strict=True))
