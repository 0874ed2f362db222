"""A driving policy behind AlpaSim's EgodriverService, as a pilot of a drive (``pip install 'mudg[sim]'``).

    with Policy("localhost:50051", "front", camera, mount) as policy:
        controls = PlanPilot(policy).drive(sight)

Before every plan the policy gets the vehicle's pose and speed, the route ahead and the picture, in the order in which
AlpaSim's runtime sends them. Replies are read as messages alone; bytes of debugging are never opened.
"""

from __future__ import annotations

import contextlib
import io
import uuid
from types import TracebackType
from typing import Any, Final, Self

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from mudg.base import geometry
from mudg.base.errors import InputError
from mudg.base.types import Camera
from mudg.sim import wire
from mudg.sim.pilots import DriverView

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
        lens = types.PinholeParam(
            principal_point_x=camera.cx, principal_point_y=camera.cy, focal_length_x=camera.fx, focal_length_y=camera.fy
        )
        spec = types.CameraSpec(
            opencv_pinhole_param=lens,
            logical_id=name,
            resolution_h=camera.height,
            resolution_w=camera.width,
            shutter_type=5,
        )
        shown = types.AvailableCamera(intrinsics=spec, rig_to_camera=wire.pose_of(mount), logical_id=name)
        vehicle = types.RolloutSpec(vehicle=types.VehicleDefinition(available_cameras=[shown]))
        request = types.DriveSessionRequest(
            session_uuid=self._id, random_seed=seed, debug_info=types.DriveScene(scene_id=scene), rollout_spec=vehicle
        )
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
        image = types.CameraImage(
            frame_start_us=now, frame_end_us=now, image_bytes=file.getvalue(), logical_id=self._name
        )
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
