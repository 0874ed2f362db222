"""``mudg serve``: a session behind gRPC, as AlpaSim and NuRec call a renderer. The world is AlpaSim's local frame, the
vehicle's rig the log's vehicle frame; microseconds are those of the scene's clock. Objects that a request does not list
are absent; names without Gaussians of their own (parked vehicles) are passed over: they are background."""

from __future__ import annotations

import contextlib
import hmac
import io
import math
import signal
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from mudg.base import log
from mudg.base.errors import MudgError, ResourceError
from mudg.base.versions import version
from mudg.sim import wire
from mudg.sim.lidar import TABLES, BeamTable, LidarRequest
from mudg.sim.optics import Fisheye, FTheta, Optics, Pinhole
from mudg.sim.session import CameraRequest, Instant, Session
from mudg.sim.settings import ServeConfig
from mudg.sim.wire import matrix_of, pose_of
from mudg.viewer.server import is_loopback, token_for

THREADS: Final = 16
GRACE_S: Final = 5.0
WAITING: Final = 64
"""Most requests at a time; more are refused at once."""
MESSAGE_MB: Final = 64
MOST_OBJECTS: Final = 10_000
LATEST_US: Final = 10**15
LIDARS: Final = {0: "pandar128", 1: "at128"}
"""``LidarSpec.lidar_type`` -> name of the beam table."""


class Refused(Exception):
    """A request that gets a status of gRPC instead of an answer: why, and its name."""

    def __init__(self, why: str, status: str = "INVALID_ARGUMENT") -> None:
        super().__init__(why)
        self.status = status


class Renderer:
    """Answers the requests of the wire; one at a time is drawn, because each uses all processors. ``session``: what is
    rendered. ``name``: id of its scene."""

    def __init__(self, session: Session, name: str) -> None:
        self.session, self.name, self.types = session, name, wire.messages()
        self._drawing = threading.Lock()
        self._beams: dict[int, BeamTable] = {}
        self.passed_over: set[str] = set()

    # -- what there is -----------------------------------------------------------------------------

    def get_version(self, _request: Any) -> Any:
        """Version of this program and of the interface."""
        api = self.types.ApiVersion(major=0, minor=54, patch=0)
        return self.types.VersionId(version_id=f"mudg-{version()}", git_hash="", grpc_api_version=api)

    def get_available_scenes(self, _request: Any) -> Any:
        """The one scene."""
        return self.types.AvailableScenesReturn(scene_ids=[self.name])

    def get_loaded_scenes(self, _request: Any) -> Any:
        """The one scene, loaded."""
        scene = self.types.LoadedScene(scene_id=self.name, loaded_instance_count=1, reusable_instance_count=1)
        return self.types.LoadedScenesReturn(scenes=[scene], loaded_instance_capacity=1)

    def get_available_ego_masks(self, _request: Any) -> Any:
        """None: the recording vehicle is not part of a reconstruction."""
        return self.types.AvailableEgoMasksReturn()

    def get_available_cameras(self, request: Any) -> Any:
        """The log's cameras and where they are mounted."""
        self._check_scene(request)
        mounts, cameras = self.session.mounts(), self.session.cameras
        shown = [wire.available_camera(cameras[name], mount) for name, mount in mounts.items()]
        return self.types.AvailableCamerasReturn(available_cameras=shown)

    def get_available_trajectories(self, request: Any) -> Any:
        """The recorded path of the vehicle."""
        self._check_scene(request)
        made, scene = self.types.AvailableTrajectoriesReturn(), self.session.scene
        if scene is not None:
            poses = made.available_trajectories.add().trajectory.poses
            for time_s, matrix in zip(scene.ego.times_s, scene.ego.world_from_ego, strict=True):
                poses.add(pose=pose_of(matrix), timestamp_us=max(0, round(float(time_s) * 1e6)))
        return made

    # -- what is drawn -----------------------------------------------------------------------------

    def render_rgb(self, request: Any) -> Any:
        """One picture."""
        self._check_scene(request)
        if request.insert_ego_mask:
            raise Refused("insert_ego_mask: this scene has no ego masks (get_available_ego_masks)")
        spec = request.camera_intrinsics
        camera = CameraRequest(
            optics=self._optics(spec, request.resolution_w, request.resolution_h),
            start=self._instant(request, "start"),
            end=self._instant(request, "end"),
            shutter=wire.SHUTTERS.get(spec.shutter_type, "unknown"),  # type: ignore[arg-type]
            colors_of=spec.logical_id if spec.logical_id in self.session.cameras else "",
        )
        with self._drawing:
            rgb = self.session.render([camera])[0].layers["rgb"]
        return self.types.RGBRenderReturn(image_bytes=encoded(rgb, request.image_format, request.image_quality))

    def render_lidar(self, request: Any) -> Any:
        """One sweep: points in the sensor's frame at its end."""
        self._check_scene(request)
        kind = request.lidar_config.lidar_type
        if kind not in LIDARS:
            raise Refused(f"lidar_config.lidar_type: expected one of {list(LIDARS)}, got {kind}")
        beams = self._beams.setdefault(kind, TABLES[LIDARS[kind]]())
        sweep = LidarRequest(beams=beams, start=self._instant(request, "start"), end=self._instant(request, "end"))
        with self._drawing:
            reply = self.session.render([sweep])[0]
        return self.types.LidarRenderReturn(
            point_xyzs=reply.xyz.reshape(-1),
            point_intensities=reply.intensity,
            num_points=len(reply.xyz),
            point_xyzs_buffer=reply.xyz.astype("<f4").tobytes(),
            point_intensities_buffer=reply.intensity.astype("<f4").tobytes(),
        )

    def render_aggregated(self, request: Any) -> Any:
        """Pictures and sweeps, in the order of the request."""
        return self.types.AggregatedRenderReturn(
            rgb_returns=[self.render_rgb(one) for one in request.rgb_requests],
            lidar_returns=[self.render_lidar(one) for one in request.lidar_requests],
        )

    def batch_render_rgb(self, request: Any) -> Any:
        """Pictures by camera name; one that fails says why and leaves the others."""
        made = self.types.BatchRGBRenderReturn()
        for item in request.items:
            one = made.items.add(camera_name=item.camera_name, success=True)
            try:
                one.result.CopyFrom(self.render_rgb(item.request))
            except (MudgError, Refused) as error:
                one.success, one.error_message = False, " ".join(str(error).split())
        return made

    # -- fields ------------------------------------------------------------------------------------

    def _check_scene(self, request: Any) -> None:
        if request.scene_id != self.name:
            what = f"scene_id: there is no such scene; expected {self.name!r}, got {request.scene_id[:200]!r}"
            raise Refused(what, "NOT_FOUND")

    def _instant(self, request: Any, end: str) -> Instant:
        """Sensor and objects at the start or the end of a request."""
        micros, pair = getattr(request, f"frame_{end}_us"), request.sensor_pose
        if micros > LATEST_US or request.frame_start_us > request.frame_end_us:
            got = f"{request.frame_start_us} to {request.frame_end_us}"
            raise Refused(f"frame_start_us, frame_end_us: not a span of time on the scene's clock: {got}")
        if len(request.dynamic_objects) > MOST_OBJECTS:
            raise Refused(f"dynamic_objects: at most {MOST_OBJECTS}, got {len(request.dynamic_objects)}")
        known, objects = self.session.sizes_m(), {}
        for one in request.dynamic_objects:
            if one.track_id in known:
                where = f"dynamic_objects: {one.track_id[:60]!r}"
                objects[one.track_id] = matrix_of(getattr(one.pose_pair, f"{end}_pose"), where)
            elif one.track_id not in self.passed_over and len(self.passed_over) < 1000:
                self.passed_over.add(one.track_id)
                log.info(f"serve: {one.track_id[:60]!r} has no Gaussians of its own; it is part of the background")
        return Instant(micros / 1e6, matrix_of(getattr(pair, f"{end}_pose"), f"sensor_pose.{end}_pose"), objects)

    def _optics(self, spec: Any, width: int, height: int) -> Optics:
        """The lens of a request; a picture of another size than the lens's is scaled."""
        if spec.HasField("bivariate_windshield_model_param"):
            raise Refused("camera_intrinsics: lenses behind a bivariate windshield are not drawn")
        width, height = width or spec.resolution_w, height or spec.resolution_h
        across, down = width / (spec.resolution_w or width or 1), height / (spec.resolution_h or height or 1)
        if spec.HasField("opencv_pinhole_param") or spec.HasField("opencv_fisheye_param"):
            wide = spec.HasField("opencv_fisheye_param")
            lens = spec.opencv_fisheye_param if wide else spec.opencv_pinhole_param
            numbers = (
                *(width, height, lens.focal_length_x * across, lens.focal_length_y * down),
                *(lens.principal_point_x * across, lens.principal_point_y * down, tuple(lens.radial_coeffs)),
            )
            if wide:
                return Fisheye(*numbers, lens.max_angle or math.pi / 2)
            return Pinhole(*numbers, tuple(lens.tangential_coeffs), tuple(lens.thin_prism_coeffs))
        if spec.HasField("ftheta_param"):
            if (across, down) != (1.0, 1.0):
                raise Refused("resolution: a picture through an f-theta lens has the lens's size")
            lens = spec.ftheta_param
            linear = (lens.linear_cde.linear_c, lens.linear_cde.linear_d, lens.linear_cde.linear_e)
            return FTheta(
                *(width, height, lens.principal_point_x, lens.principal_point_y),
                *(tuple(lens.pixeldist_to_angle_poly), tuple(lens.angle_to_pixeldist_poly)),
                "angle_to_pixels" if lens.reference_poly == 2 else "pixels_to_angle",
                lens.max_angle or math.pi / 2,
                linear if lens.HasField("linear_cde") else (1.0, 0.0, 0.0),
            )
        raise Refused("camera_intrinsics: expected a pinhole, fisheye or f-theta lens")


def encoded(rgb: NDArray[np.uint8], image_format: int, quality: float) -> bytes:
    """A picture u8[H, W, 3] as PNG, JPEG (of a quality of 1 to 100, 0 = 95), or three planes of bytes. Refused: another
    format."""
    if image_format == wire.RGB_PLANAR:
        return np.ascontiguousarray(rgb.transpose(2, 0, 1)).tobytes()
    if image_format not in (wire.PNG, wire.JPEG):
        raise Refused(f"image_format: expected PNG (1), JPEG (2) or planes (4), got {image_format}")
    if image_format == wire.JPEG and not 0 <= quality <= 100:
        raise Refused(f"image_quality: expected 1 to 100, got {quality}")
    file = io.BytesIO()
    if image_format == wire.PNG:
        Image.fromarray(rgb).save(file, "PNG", compress_level=1)
    else:
        Image.fromarray(rgb).save(file, "JPEG", quality=round(quality) or 95)
    return file.getvalue()


class Metrics:
    """Counts and times of requests, in Prometheus' text format."""

    def __init__(self) -> None:
        self._lock, self._counts, self._seconds = threading.Lock(), dict[tuple[str, str], int](), dict[str, float]()

    def add(self, method: str, status: str, seconds: float) -> None:
        """Count one request."""
        with self._lock:
            self._counts[method, status] = self._counts.get((method, status), 0) + 1
            self._seconds[method] = self._seconds.get(method, 0.0) + seconds

    def text(self) -> str:
        """All of it."""
        with self._lock:
            rows = ["# TYPE mudg_requests_total counter"]
            rows += [
                f'mudg_requests_total{{method="{m}",status="{s}"}} {n}' for (m, s), n in sorted(self._counts.items())
            ]
            rows += ["# TYPE mudg_request_seconds_total counter"]
            rows += [f'mudg_request_seconds_total{{method="{m}"}} {s:.6f}' for m, s in sorted(self._seconds.items())]
        return "\n".join(rows) + "\n"


def handlers(renderer: Renderer, metrics: Metrics, token: str) -> list[Any]:
    """Handlers of gRPC for all names of the service, and for health."""
    grpc, types = wire.package(), wire.messages()

    def guarded(name: str, work: Callable[[Any], Any]) -> Callable[[Any, Any], Any]:
        def answer(request: Any, context: Any) -> Any:
            began, status = time.perf_counter(), "OK"
            try:
                sent = dict(context.invocation_metadata()).get("authorization", "")
                if token and not hmac.compare_digest(str(sent), f"Bearer {token}"):
                    raise Refused("the metadata authorization: Bearer TOKEN is missing or wrong", "UNAUTHENTICATED")
                if not context.is_active():
                    raise Refused("the client has gone", "CANCELLED")
                return work(request)
            except (Refused, MudgError) as error:
                status, why = getattr(error, "status", "INVALID_ARGUMENT"), " ".join(str(error).split())
                status = "RESOURCE_EXHAUSTED" if isinstance(error, ResourceError) else status
            finally:
                metrics.add(name, status, time.perf_counter() - began)
            context.abort(grpc.StatusCode[status], why[:1000])

        return answer

    def method(name: str, work: Callable[[Any], Any], asks: str, answers: str) -> Any:
        return grpc.unary_unary_rpc_method_handler(
            guarded(name, work), getattr(types, asks).FromString, getattr(types, answers).SerializeToString
        )

    own = {n: method(n, getattr(renderer, n), asks, answers) for n, (asks, answers) in wire.METHODS.items()}
    health = {"Check": method("Check", lambda _: types.HealthReply(status=1), "HealthRequest", "HealthReply")}
    services = {**dict.fromkeys(wire.SERVICES, own), wire.HEALTH: health}
    return [grpc.method_handlers_generic_handler(service, rows) for service, rows in services.items()]


@contextlib.contextmanager
def serving(session: Session, name: str, config: ServeConfig) -> Iterator[tuple[str, str]]:
    """A running server, and its stop: what is being drawn is finished, for at most ``GRACE_S``. Yields addresses
    ``host:port`` of the service and of its metrics (empty: none). UsageError: another address than loopback without a
    token. ResourceError: the address is taken, or grpcio is not installed."""
    grpc, metrics = wire.package(), Metrics()
    token = token_for(config.host, config.token) if config.token or not is_loopback(config.host) else ""
    most = MESSAGE_MB * 2**20
    options = [(f"grpc.max_{way}_message_length", most) for way in ("receive", "send")] + [("grpc.so_reuseport", 0)]
    answers = handlers(Renderer(session, name), metrics, token)
    pool = ThreadPoolExecutor(THREADS, "serve")
    server = grpc.server(pool, handlers=answers, maximum_concurrent_rpcs=WAITING, options=options)
    try:
        port = server.add_insecure_port(f"{config.host}:{config.port}")
    except RuntimeError as error:
        what = f"{config.host}:{config.port}"
        raise ResourceError("cannot listen on this address", where=what, remedy="choose another --port") from error
    pages = _metrics_pages(metrics, config.metrics_port) if config.metrics_port >= 0 else None
    server.start()
    try:
        yield f"{config.host}:{port}", f"127.0.0.1:{pages.server_address[1]}" if pages else ""
    finally:
        server.stop(GRACE_S).wait()
        if pages is not None:
            pages.shutdown()
            pages.server_close()


def _metrics_pages(metrics: Metrics, port: int) -> ThreadingHTTPServer:
    class Page(BaseHTTPRequestHandler):
        timeout = 10.0

        def do_GET(self) -> None:
            body = metrics.text().encode()
            self.send_response(200)
            self.send_header("Content-Type", "text/plain; version=0.0.4")
            self.send_header("Content-Length", str(len(body)))
            self.end_headers()
            self.wfile.write(body)

        def log_message(self, format: str, *args: Any) -> None:
            return

    try:
        pages = ThreadingHTTPServer(("127.0.0.1", port), Page)
    except OSError as error:
        what, where = "cannot listen on this address", f"127.0.0.1:{port}"
        raise ResourceError(what, where=where, remedy="choose another --metrics-port") from error
    threading.Thread(target=pages.serve_forever, name="metrics", daemon=True).start()
    return pages


def serve(config: ServeConfig, run: Path, edits: Path | None, scene: Path | None) -> dict[str, Any]:
    """Serve until the command is interrupted or terminated; returns what was answered."""
    wire.package()
    session = Session(run, edits, scene, config.device)
    name = "" if session.scene is None else session.scene.id
    stop = threading.Event()
    signal.signal(signal.SIGTERM, lambda *_: stop.set())
    with serving(session, name or run.name, config) as (address, pages):
        log.info(f"serve: scene {name or run.name!r} at {address}" + (f", metrics at http://{pages}" if pages else ""))
        with contextlib.suppress(KeyboardInterrupt):
            stop.wait()
        log.info("serve: stopping")
    return {"address": address, "scene": name or run.name, "text": f"served {name or run.name} at {address}"}
