"""Drivers for a closed loop, which answer a `DriverView` with `Controls` at every step: `RoutePilot` knows the road by
its route and keeps its distance to whoever it sees ahead; `EdgePilot` pulls over to the edge of the road that it sees;
`PlanPilot` drives along the plans of a policy, such as `Policy`."""

from __future__ import annotations

import contextlib
import io
import math
import uuid
from dataclasses import dataclass, field
from types import TracebackType
from typing import Any, Final, Protocol, Self

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from scipy.spatial import cKDTree

from mudg.base import geometry
from mudg.base.errors import InputError
from mudg.base.palette import DYNAMIC_IDS, ID
from mudg.base.types import Camera
from mudg.sim import wire
from mudg.sim.drive import Car, Controls, Following, Matrix

STEER_RATE: Final = 0.8
"""Fastest turn of the front wheels, rad/s."""
LEAST_LOOKAHEAD_M: Final = 6.0
FEWEST_PIXELS: Final = 20
"""Pixels of road users in its lane from which on a pilot believes in somebody ahead, or of a road in its width."""
EDGE_M: Final = (12.0, 26.0)
"""Where along the route a pilot looks for the edge of the road: nearer, a camera does not see it."""
EDGE_MARGIN_M: Final = 0.5
"""Room that a pilot leaves between the vehicle and the edge."""


@dataclass(frozen=True, slots=True, eq=False)
class DriverView:
    """What a pilot sees at a step. ``time_s``, ``step_s``: now, and how long its answer holds. ``speed_mps``,
    ``steer_rad``: of the vehicle. ``route``: the road ahead f64[N, 3] in the vehicle's frame, metres (x forward, y
    left, z up). ``pose``: world-from-vehicle f64[4, 4]. ``camera``, ``vehicle_from_camera``: of the pictures. ``rgb``:
    u8[H, W, 3]. ``depth``: f32[H, W] camera z in metres, not finite where there is no surface. ``classes``:
    u8[H, W]."""

    time_s: float
    step_s: float
    speed_mps: float
    steer_rad: float
    route: Matrix
    pose: Matrix
    camera: Camera
    vehicle_from_camera: Matrix
    rgb: NDArray[np.uint8]
    depth: NDArray[np.float32]
    classes: NDArray[np.uint8]

    def points(self, ids: tuple[int, ...]) -> Matrix:
        """Surface points f64[N, 3] of some classes in the vehicle's frame."""
        rows, columns = np.nonzero(np.isin(self.classes, ids) & np.isfinite(self.depth) & (self.depth > 0))
        x, y = geometry.pinhole_ray(self.camera.intrinsics, columns + 0.5, rows + 0.5)
        z = self.depth[rows, columns].astype(np.float64)
        return geometry.transform_points(self.vehicle_from_camera, np.stack([x * z, y * z, z], 1))


class Pilot(Protocol):
    """Who drives."""

    def drive(self, sight: DriverView) -> Controls:
        """What to do until the next step."""
        ...


def stations_of(sight: DriverView) -> Matrix:
    """Arc lengths f64[N] of the points of the route."""
    return np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(sight.route[:, :2], axis=0), axis=1))])


def pursue(target: Matrix, sight: DriverView, car: Car) -> float:
    """Steering rate of pure pursuit (Coulter 1992): the circle through the rear axle and a target f64[2] ahead."""
    x, y = target
    steer = math.atan(car.wheelbase_m * 2 * y / max(x * x + y * y, 1.0))
    steer = min(max(steer, -car.largest_steer_rad), car.largest_steer_rad)
    return min(max((steer - sight.steer_rad) / sight.step_s, -STEER_RATE), STEER_RATE)


@dataclass(slots=True)
class RoutePilot:
    """Follows the route by pure pursuit, and keeps its distance to what it sees ahead by the intelligent driver model.
    ``rule``: how fast, and how near. ``shift_m``: to drive this far to the left of the route. ``car``: the vehicle."""

    rule: Following
    shift_m: float = 0.0
    car: Car = field(default_factory=Car)
    _gap_m: float = math.inf

    def drive(self, sight: DriverView) -> Controls:
        """See ``Pilot``."""
        return Controls(self.accelerate(sight), pursue(self.target(sight), sight, self.car))

    def target(self, sight: DriverView) -> Matrix:
        """Where it aims f64[2]."""
        arc = stations_of(sight)
        reach = max(LEAST_LOOKAHEAD_M, sight.speed_mps) + np.array([0.0, 1.0])
        aim, beyond = np.stack([np.interp(reach, arc, sight.route[:, axis]) for axis in (0, 1)], 1)
        along = (beyond - aim) / max(float(np.linalg.norm(beyond - aim)), 1e-9)
        return aim + self.aim_m(sight) * np.array([-along[1], along[0]])

    def aim_m(self, sight: DriverView) -> float:
        """How far to the left of the route it aims."""
        return self.shift_m

    def accelerate(self, sight: DriverView) -> float:
        """Acceleration by the gap that it sees, and by how that changed."""
        gap, before = self.gap_m(sight), self._gap_m
        closing = (before - gap) / sight.step_s if math.isfinite(before) and math.isfinite(gap) else 0.0
        self._gap_m = gap
        return self.rule.acceleration(sight.speed_mps, gap, min(max(closing, -10.0), 20.0))

    def gap_m(self, sight: DriverView) -> float:
        """Metres from its bumper to road users in its way; infinite where it sees none."""
        points = sight.points(DYNAMIC_IDS)
        target, bumper = self.target(sight), self.car.length_m - self.car.overhang_m
        bend = 2 * target[1] / max(float(target @ target), 1.0)
        way = points[:, 1] - bend * points[:, 0] ** 2 / 2
        ahead = points[(points[:, 0] > bumper) & (abs(way) < self.car.width_m / 2 + 0.2) & (points[:, 2] > 0.2)]
        if len(ahead) < FEWEST_PIXELS:
            return math.inf
        return max(float(np.quantile(ahead[:, 0], 0.02)) - bumper, 0.1)


@dataclass(slots=True)
class EdgePilot(RoutePilot):
    """Pulls over: goes to the side of the route until the edge of the road that it sees, ``shift_m`` at most. Depth and
    classes steer it, not the speed alone. Where they show no edge, it stays on the route."""

    def aim_m(self, sight: DriverView) -> float:
        """See ``RoutePilot``."""
        side = math.copysign(1.0, self.shift_m)
        reach = self.edge_m(sight, side) - self.car.width_m / 2 - EDGE_MARGIN_M
        return side * min(max(reach, 0.0), abs(self.shift_m))

    def edge_m(self, sight: DriverView, side: float) -> float:
        """How far the road reaches to the left (``side`` 1) or right (-1) of the route, at its narrowest ahead; 0
        where none is seen."""
        route, stations = sight.route[:, :2], stations_of(sight)
        ahead = np.gradient(route, axis=0)
        ahead /= np.maximum(np.linalg.norm(ahead, axis=1, keepdims=True), 1e-9)
        points = sight.points((ID["road"],))[:, :2]
        nearest = cKDTree(route).query(points)[1] if len(points) else np.zeros(0, np.int64)
        off = points - route[nearest]
        left = ahead[nearest, 0] * off[:, 1] - ahead[nearest, 1] * off[:, 0]
        looked = np.flatnonzero((stations >= EDGE_M[0]) & (stations <= EDGE_M[1]))
        widths = [side * left[nearest == at] for at in looked]
        return min((float(np.quantile(w, 0.98)) for w in widths if len(w) >= FEWEST_PIXELS), default=0.0)


@dataclass(slots=True)
class PlanPilot:
    """Drives along the plans of a policy. ``policy``: what answers a `DriverView` with a plan f64[N, 4]: seconds from
    now, x and y in metres and heading in radians in the vehicle's frame."""

    policy: Any
    car: Car = field(default_factory=Car)

    def drive(self, sight: DriverView) -> Controls:
        """See ``Pilot``."""
        times, x, y, _ = self.policy.plan(sight).T
        if not len(times):
            return Controls(-3.0, 0.0)
        reach = np.hypot(x, y)
        index = min(int(np.searchsorted(reach, max(LEAST_LOOKAHEAD_M, sight.speed_mps))), len(reach) - 1)
        horizon = min(1.0, float(times[-1]))
        way = float(np.interp(horizon, np.concatenate([[0.0], times]), np.concatenate([[0.0], reach])))
        acceleration = 2 * (way - sight.speed_mps * horizon) / horizon**2
        target = np.array([x[index], y[index]])
        return Controls(min(max(acceleration, -6.0), 3.0), pursue(target, sight, self.car))


# -- a driving policy behind AlpaSim's EgodriverService (``pip install 'mudg[sim]'``) ---
#     with Policy("localhost:50051", "front", camera, mount) as policy:
#         controls = PlanPilot(policy).drive(sight)
#
# Before every plan the policy gets the vehicle's pose and speed, the route ahead and the picture, in the order in which
# AlpaSim's runtime sends them. Replies are read as messages alone; bytes of debugging are never opened.

REVISION: Final = (("carla-driver-interface-contract", "2"),)
"""Says that a camera's pose in the rig is that of its optical frame, as AlpaSim has it."""
TIMEOUT_S: Final = 60.0
QUALITY: Final = 95


class Policy:
    """A session with a policy's server. ``server``: ``HOST:PORT``, or an open gRPC channel. ``name``, ``camera``,
    ``mount``: of the camera whose pictures it gets; mount f64[4, 4]: vehicle-from-camera. ``scene``: name that the
    policy is told. ``seed``: of the policy. ResourceError: grpcio is missing. InputError: no policy answers."""

    def __init__(
        self, server: Any, name: str, camera: Camera, mount: NDArray[np.float64], scene: str = "mudg", seed: int = 0
    ) -> None:
        self._grpc, self._types = wire.package(), wire.messages()
        self._own = isinstance(server, str)
        options = [(f"grpc.max_{way}_message_length", 2**26) for way in ("send", "receive")]
        self._channel = self._grpc.insecure_channel(server, options=options) if self._own else server
        self._name, self._id, self._first_s = name, str(uuid.uuid5(uuid.NAMESPACE_URL, f"{scene} {seed} {name}")), None
        types = self._types
        self.version: str = self._call("get_version", types.Empty()).version_id
        shown = wire.available_camera(camera, mount)
        shown.logical_id = shown.intrinsics.logical_id = name
        vehicle = types.RolloutSpec(vehicle=types.VehicleDefinition(available_cameras=[shown]))
        told = {"debug_info": types.DriveScene(scene_id=scene), "rollout_spec": vehicle}
        request = types.DriveSessionRequest(session_uuid=self._id, random_seed=seed, **told)
        self._call("start_session", request, REVISION)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        with contextlib.suppress(InputError):
            self._call("close_session", self._types.DriveSessionCloseRequest(session_uuid=self._id))
        if self._own:
            self._channel.close()

    def plan(self, sight: DriverView) -> NDArray[np.float64]:
        """The policy's plan f64[N, 4] in the vehicle's frame: seconds from now (positive), x and y in metres, heading
        in radians; no rows: it wants to stop. InputError: the policy failed, or its plan is not one."""
        types, now = self._types, self._micros(sight.time_s)
        at = types.PoseAtTime(pose=wire.pose_of(sight.pose), timestamp_us=now)
        state = types.DynamicState(linear_velocity=types.Vec3(x=sight.speed_mps))
        moved = types.RolloutEgoTrajectory(session_uuid=self._id, trajectory=types.Trajectory(poses=[at]))
        moved.dynamic_states.append(state)
        self._call("submit_egomotion_observation", moved)
        points = [types.Vec3(x=x, y=y, z=z) for x, y, z in sight.route]
        route = types.Route(waypoints=points, timestamp_us=now)
        self._call("submit_route", types.RouteRequest(session_uuid=self._id, route=route))
        file = io.BytesIO()
        Image.fromarray(sight.rgb).save(file, "JPEG", quality=QUALITY)
        span = {"frame_start_us": now, "frame_end_us": now}
        image = types.CameraImage(**span, image_bytes=file.getvalue(), logical_id=self._name)
        self._call("submit_image_observation", types.RolloutCameraImage(session_uuid=self._id, camera_image=image))
        query = self._micros(sight.time_s + sight.step_s)
        reply = self._call("drive", types.DriveRequest(session_uuid=self._id, time_now_us=now, time_query_us=query))
        rows = []
        for one in reply.trajectory.poses:
            pose = geometry.invert(sight.pose) @ wire.matrix_of(one.pose, "the policy's plan")
            rows.append(((one.timestamp_us - now) / 1e6, pose[0, 3], pose[1, 3], geometry.yaw_of(pose)))
        plan = np.array([row for row in rows if row[0] > 0], np.float64).reshape(-1, 4)
        if (np.diff(plan[:, 0]) <= 0).any():
            raise InputError("times of the policy's plan do not increase", where=self.version[:80])
        return np.zeros((0, 4)) if reply.terminate_session else plan

    def _micros(self, time_s: float) -> int:
        """Microseconds since the first sight: a scene's clock may begin anywhere."""
        self._first_s = time_s if self._first_s is None else self._first_s
        return round((time_s - self._first_s) * 1e6)

    def _call(self, method: str, request: Any, metadata: Any = None) -> Any:
        _, reply = wire.DRIVER_METHODS[method]
        ask = self._channel.unary_unary(
            f"/{wire.DRIVER}/{method}",
            request_serializer=lambda message: message.SerializeToString(),
            response_deserializer=getattr(self._types, reply).FromString,
        )
        try:
            return ask(request, timeout=TIMEOUT_S, metadata=metadata)
        except self._grpc.RpcError as error:
            what, got = "the policy's server did not answer", f"{error.code().name}: {error.details()}"[:200]
            raise InputError(what, where=f"{wire.DRIVER}/{method}", got=got) from error
