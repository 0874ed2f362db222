"""The simulator's server, asked by the message classes of a public client (carla-driver-interface) and by our own."""

from __future__ import annotations

import io
import math
import threading
import time
import urllib.request
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
import pytest
from PIL import Image
from refusals import refused
from test_edit import toy

from mudg.base import geometry
from mudg.base.errors import ResourceError, UsageError
from mudg.base.types import Camera, Scene
from mudg.scene.motion import Road
from mudg.sim import CameraRequest, Instant, Pinhole, Session, wire
from mudg.sim.drive import BicycleState, Drive
from mudg.sim.pilots import DriverView, PlanPilot, Policy
from mudg.sim.server import serving
from mudg.sim.settings import ServeConfig

grpc = pytest.importorskip("grpc", reason="grpcio is not installed (extra sim)")
NAME = "toy"
POSE = geometry.yaw_matrix(0.0, (0.0, 0.0, 1.5)) @ geometry.invert(geometry.CAM_FROM_EGO_AXES)


@pytest.fixture(scope="module")
def session() -> Session:
    return Session(toy())


@pytest.fixture(scope="module")
def address(session: Session) -> Iterator[str]:
    with serving(session, NAME, ServeConfig()) as (address, _):
        yield address


@pytest.fixture(scope="module")
def client_messages() -> Any:
    """Classes that somebody else generated from the public definition."""
    return pytest.importorskip("carla_driver_interface._proto.sensorsim_pb2", reason="no public client is installed")


def call(address: str, method: str, request: Any, reply: Any, service: str = wire.SERVICES[0], **options: Any) -> Any:
    with grpc.insecure_channel(address, options=[("grpc.max_receive_message_length", 2**26)]) as channel:
        ask = channel.unary_unary(
            f"/{service}/{method}",
            request_serializer=lambda one: one if isinstance(one, bytes) else one.SerializeToString(),
            response_deserializer=reply.FromString,
        )
        return ask(request, timeout=60, **options)


def refusal(address: str, method: str, request: Any, **options: Any) -> tuple[str, str]:
    with pytest.raises(grpc.RpcError) as error:
        call(address, method, request, wire.messages().Empty, **options)
    return error.value.code().name, error.value.details()


def picture_request(types: Any, objects: dict[str, np.ndarray] | None = None, **fields: Any) -> Any:
    """A request as AlpaSim makes it, in any classes that have its fields."""
    request = types.RGBRenderRequest(
        scene_id=NAME, resolution_h=48, resolution_w=64, frame_start_us=500_000, frame_end_us=500_000, image_format=1
    )
    lens = request.camera_intrinsics.opencv_pinhole_param
    lens.focal_length_x = lens.focal_length_y = 50.0
    lens.principal_point_x, lens.principal_point_y = 32.0, 24.0
    request.camera_intrinsics.resolution_w, request.camera_intrinsics.resolution_h = 64, 48
    request.camera_intrinsics.shutter_type = 5
    write_poses(request.sensor_pose, POSE)
    for name, pose in (objects or {}).items():
        write_poses(request.dynamic_objects.add(track_id=name).pose_pair, pose)
    for name, value in fields.items():
        setattr(request, name, value)
    return request


def write_poses(pair: Any, matrix: np.ndarray) -> None:
    """A pose that is that of the start and of the end."""
    for message in (pair.start_pose, pair.end_pose):
        message.vec.x, message.vec.y, message.vec.z = matrix[:3, 3]
        message.quat.w, message.quat.x, message.quat.y, message.quat.z = geometry.quaternion_from_matrix(matrix)


def decoded(content: bytes) -> np.ndarray:
    return np.asarray(Image.open(io.BytesIO(content)))


@pytest.mark.parametrize("service", wire.SERVICES)
def test_a_public_clients_request_gets_the_sessions_picture(
    service: str, address: str, session: Session, client_messages: Any
) -> None:
    car = session.objects(0.5)["car-1"]
    request = picture_request(client_messages, {"car-1": car, "parked-9": car})
    reply = call(address, "render_rgb", request, client_messages.RGBRenderReturn, service)
    optics, at = Pinhole(64, 48, 50.0, 50.0, 32.0, 24.0), Instant(0.5, POSE, {"car-1": car})
    direct = session.render([CameraRequest(optics=optics, start=at)])[0].layers["rgb"].astype(int)
    assert np.abs(decoded(reply.image_bytes).astype(int) - direct).max() <= 2  # poses are float32 on the wire
    empty = call(address, "render_rgb", picture_request(client_messages), client_messages.RGBRenderReturn, service)
    assert np.abs(decoded(empty.image_bytes).astype(int) - direct).max() > 50  # not listed: absent


def test_a_batch_answers_every_camera_and_says_which_one_failed(address: str, client_messages: Any) -> None:
    batch = client_messages.BatchRGBRenderRequest()
    batch.items.add(camera_name="front", request=picture_request(client_messages))
    batch.items.add(camera_name="lost", request=picture_request(client_messages, scene_id="elsewhere"))
    batch.items.add(camera_name="jpeg", request=picture_request(client_messages, image_format=2, image_quality=95))
    reply = call(address, "batch_render_rgb", batch, client_messages.BatchRGBRenderReturn)
    assert [(one.camera_name, one.success) for one in reply.items] == [("front", True), ("lost", False), ("jpeg", True)]
    assert "no such scene" in reply.items[1].error_message
    front, jpeg = (decoded(reply.items[k].result.image_bytes).astype(int) for k in (0, 2))
    assert np.abs(front - jpeg).mean() < 4


def test_a_sweep_comes_with_its_points_in_both_forms(address: str, session: Session, client_messages: Any) -> None:
    request = client_messages.LidarRenderRequest(scene_id=NAME, frame_start_us=500_000, frame_end_us=600_000)
    request.lidar_config.lidar_type = 1
    write_poses(request.sensor_pose, geometry.yaw_matrix(0.0, (0.0, 0.0, 1.8)))
    reply = call(address, "render_lidar", request, client_messages.LidarRenderReturn)
    points = np.frombuffer(reply.point_xyzs_buffer, "<f4").reshape(-1, 3)
    assert reply.num_points == len(points) > 1000
    assert np.array_equal(points.reshape(-1), np.array(reply.point_xyzs, np.float32))
    assert len(np.frombuffer(reply.point_intensities_buffer, "<f4")) == len(points)
    assert (points[:, 0] > 0).all() and np.abs(np.arctan2(points[:, 1], points[:, 0])).max() <= math.radians(60) + 1e-6
    assert np.quantile(points[:, 2], 0.5) == pytest.approx(-1.8, abs=0.3)  # mostly the ground


def test_what_there_is_is_listed(address: str, tmp_path: Any) -> None:
    types = wire.messages()
    version = call(address, "get_version", types.Empty(), types.VersionId)
    assert version.version_id.startswith("mudg-") and version.grpc_api_version.minor > 0
    assert list(call(address, "get_available_scenes", types.Empty(), types.AvailableScenesReturn).scene_ids) == [NAME]
    assert call(address, "get_loaded_scenes", types.Empty(), types.LoadedScenesReturn).scenes[0].scene_id == NAME
    assert not call(address, "get_available_ego_masks", types.Empty(), types.AvailableEgoMasksReturn).ego_mask_metadata
    assert call(address, "Check", types.HealthRequest(), types.HealthReply, wire.HEALTH).status == 1


def test_cameras_stand_on_the_rig_where_the_log_has_them(toy_log: Scene, session: Session) -> None:
    types = wire.messages()
    with serving(Session(session.model, scene=toy_log), NAME, ServeConfig()) as (address, _):
        request = types.SceneRequest(scene_id=NAME)
        (camera,) = call(address, "get_available_cameras", request, types.AvailableCamerasReturn).available_cameras
        (path,) = call(
            address, "get_available_trajectories", request, types.AvailableTrajectoriesReturn
        ).available_trajectories
    frame = toy_log.frames[0]
    ego = toy_log.ego.pose_at(frame.view.time_s)
    place = (geometry.invert(ego) @ frame.view.world_from_cam)[:3, 3]
    vec, lens = camera.rig_to_camera.vec, camera.intrinsics.opencv_pinhole_param
    assert [vec.x, vec.y, vec.z] == pytest.approx(place.tolist(), abs=1e-5)
    assert (lens.focal_length_x, camera.intrinsics.resolution_w) == (frame.view.camera.fx, frame.view.camera.width)
    assert [p.timestamp_us for p in path.trajectory.poses] == [round(t * 1e6) for t in toy_log.ego.times_s]


@pytest.fixture
def toy_log(tmp_path: Any) -> Scene:
    import toy_views

    from mudg.scene.read import read_scene

    return read_scene(toy_views.write_scene(tmp_path / "scene"))


@pytest.mark.parametrize(
    ("change", "status", "words"),
    [
        ({"scene_id": "x" * 500}, "NOT_FOUND", "no such scene"),
        ({"resolution_w": 10**6, "resolution_h": 10**6}, "INVALID_ARGUMENT", "image size"),
        ({"image_format": 5}, "INVALID_ARGUMENT", "image_format"),
        ({"image_format": 2, "image_quality": math.nan}, "INVALID_ARGUMENT", "image_quality"),
        ({"frame_start_us": 900_000}, "INVALID_ARGUMENT", "span of time"),
        ({"frame_end_us": 2**63}, "INVALID_ARGUMENT", "span of time"),
        ({"insert_ego_mask": True}, "INVALID_ARGUMENT", "ego masks"),
    ],
)
def test_requests_that_cannot_be_drawn_are_refused_in_words(
    change: dict[str, Any], status: str, words: str, address: str
) -> None:
    code, why = refusal(address, "render_rgb", picture_request(wire.messages(), **change))
    assert code == status and words in why


def test_poses_and_lenses_that_are_none_are_refused(address: str) -> None:
    types = wire.messages()
    request = picture_request(types)
    request.sensor_pose.end_pose.vec.x = math.nan
    assert refusal(address, "render_rgb", request)[0] == "INVALID_ARGUMENT"
    request = picture_request(types, {"car-1": np.eye(4)})
    request.dynamic_objects[0].pose_pair.start_pose.quat.w = 7.0
    assert "car-1" in refusal(address, "render_rgb", request)[1]
    request = picture_request(types)
    request.camera_intrinsics.ClearField("opencv_pinhole_param")
    assert "expected a pinhole" in refusal(address, "render_rgb", request)[1]
    request = picture_request(types)
    request.camera_intrinsics.bivariate_windshield_model_param.reference_poly = 1
    assert "windshield" in refusal(address, "render_rgb", request)[1]
    request = picture_request(types, dict.fromkeys(map(str, range(20_000)), np.eye(4)))
    assert "dynamic_objects" in refusal(address, "render_rgb", request)[1]
    code, _ = refusal(address, "render_rgb", b"\xff\xff\xff no message")
    assert code in ("INTERNAL", "UNKNOWN")
    assert call(address, "get_version", types.Empty(), types.VersionId).version_id  # it is still there


def test_messages_larger_than_the_bound_are_refused(session: Session, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("mudg.sim.server.MESSAGE_MB", 1)
    with serving(session, NAME, ServeConfig()) as (address, _):
        assert refusal(address, "render_rgb", b"x" * 2_000_000)[0] == "RESOURCE_EXHAUSTED"


def test_sixteen_clients_at_once_get_equal_bytes(address: str, session: Session) -> None:
    request, types = picture_request(wire.messages(), {"car-1": session.objects(0.5)["car-1"]}), wire.messages()
    with ThreadPoolExecutor(16) as pool:
        jobs = [pool.submit(call, address, "render_rgb", request, types.RGBRenderReturn) for _ in range(48)]
        assert len({job.result().image_bytes for job in jobs}) == 1


def test_more_requests_than_may_wait_are_refused_at_once(session: Session, monkeypatch: pytest.MonkeyPatch) -> None:
    types, gate = wire.messages(), threading.Event()
    render = Session.render
    monkeypatch.setattr(Session, "render", lambda self, requests: (gate.wait(30), render(self, requests))[1])
    monkeypatch.setattr("mudg.sim.server.WAITING", 2)
    with serving(session, NAME, ServeConfig()) as (address, _), ThreadPoolExecutor(8) as pool:
        ask = (call, address, "render_rgb", picture_request(types), types.RGBRenderReturn)
        jobs = [pool.submit(*ask) for _ in range(6)]
        until = time.monotonic() + 30
        while sum(job.done() for job in jobs) < 4 and time.monotonic() < until:
            time.sleep(0.02)
        ended = [job.exception() for job in jobs if job.done()]
        gate.set()
        assert [error.code().name for error in ended] == ["RESOURCE_EXHAUSTED"] * 4  # two of six may wait


def test_a_token_is_asked_for_and_needed_beyond_loopback(session: Session) -> None:
    types, secret = wire.messages(), "a-secret-of-some-length"
    with pytest.raises(UsageError, match="--token"), serving(session, NAME, ServeConfig(host="0.0.0.0")):
        pass
    with serving(session, NAME, ServeConfig(token=secret)) as (address, _):
        assert refusal(address, "get_version", types.Empty())[0] == "UNAUTHENTICATED"
        wrong = [("authorization", "Bearer something-else-entirely")]
        assert refusal(address, "get_version", types.Empty(), metadata=wrong)[0] == "UNAUTHENTICATED"
        right = [("authorization", f"Bearer {secret}")]
        assert call(address, "get_version", types.Empty(), types.VersionId, metadata=right).version_id


def test_metrics_count_what_was_asked(session: Session) -> None:
    types = wire.messages()
    with serving(session, NAME, ServeConfig(metrics_port=0)) as (address, pages):
        call(address, "get_version", types.Empty(), types.VersionId)
        refusal(address, "render_rgb", picture_request(types, scene_id="other"))
        with urllib.request.urlopen(f"http://{pages}/metrics", timeout=10) as answer:
            text = answer.read().decode()
    assert 'mudg_requests_total{method="get_version",status="OK"} 1' in text
    assert 'mudg_requests_total{method="render_rgb",status="NOT_FOUND"} 1' in text


def test_a_port_that_is_taken_is_said(address: str, session: Session) -> None:
    taken = ServeConfig(port=int(address.rpartition(":")[2]))
    with pytest.raises(ResourceError, match="cannot listen"), serving(session, NAME, taken):
        pass


# -- policies --------------------------------------------------------------------------------------


def test_a_public_policy_drives_fifty_steps_on_pictures_of_our_server(address: str, client_messages: Any) -> None:
    """carla-driver-interface's route follower, over gRPC in both directions; it follows the route to within 0.2 m."""
    server = pytest.importorskip("carla_driver_interface.server", reason="no public policy is installed")
    policies = pytest.importorskip("carla_driver_interface.policies.route_follower")
    camera = Camera("front", 64, 48, 50.0, 50.0, 32.0, 24.0)
    mount = geometry.yaw_matrix(0.0, (1.4, 0.0, 1.5)) @ geometry.invert(geometry.CAM_FROM_EGO_AXES)
    road = Road(np.stack([geometry.yaw_matrix(0.0, (x, 0.0, 0.0)) for x in np.arange(-5.0, 80.0)]))
    drive = Drive(road, {}, BicycleState(0.0, 1.0, 0.1, 4.0), 0.5)
    follower = policies.RouteFollowerPolicy(cruise_speed_mps=8.0)
    pictures = []
    with server.serving(follower) as port, Policy(f"localhost:{port}", "front", camera, mount, NAME) as policy:
        assert "carla-driver-interface" in policy.version
        pilot = PlanPilot(policy)
        for _ in range(50):
            request = picture_request(client_messages)
            write_poses(request.sensor_pose, drive.pose @ mount)
            reply = call(address, "render_rgb", request, client_messages.RGBRenderReturn)
            rgb = np.asarray(Image.open(io.BytesIO(reply.image_bytes)))
            pictures.append(rgb)
            motion, blank = drive.motion, np.full(rgb.shape[:2], np.inf, np.float32)
            now = (drive.time_s, 0.1, motion.speed_mps, motion.steer_rad, road.route(drive.pose), drive.pose)
            drive.step(pilot.drive(DriverView(*now, camera, mount, rgb, blank, np.zeros(rgb.shape[:2], np.uint8))), 0.1)
    assert len(pictures) == 50
    assert np.abs(pictures[0].astype(int) - pictures[-1]).max() > 20
    assert abs(drive.motion.y_m) < 0.2
    assert drive.motion.speed_mps == pytest.approx(8.0, abs=0.5)


def test_a_policy_that_is_not_there_is_named() -> None:
    camera = Camera("front", 64, 48, 50.0, 50.0, 32.0, 24.0)
    refused("did not answer", Policy, "127.0.0.1:9", "front", camera, np.eye(4))
