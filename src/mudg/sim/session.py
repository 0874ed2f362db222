"""One reconstruction that answers sensor requests. A reply depends on its request alone (no clock, no files): equal
requests get equal bytes, in any order. The world is that of the log: metres, z up. Objects are those that the fit has
Gaussians of; parked vehicles belong to the background unless an edit script takes them out."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Final, Literal, Protocol, Self, TypeVar, get_args

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray

from mudg.base import geometry
from mudg.base.errors import InputError, UsageError
from mudg.base.palette import UNLABELLED
from mudg.base.types import Camera, Gaussians, Observation, Scene, Shutter, View
from mudg.core.pictures import to_bytes
from mudg.core.raster.rasterize import MAX_EXTRA_CHANNELS, drawing_device, rasterize
from mudg.diffusion.views import JobInputs
from mudg.editing.apply import carry_out
from mudg.editing.render import RenderMixer, check_as_recorded
from mudg.editing.runs import find_run, scene_at
from mudg.editing.script import EditScript, read_edits
from mudg.gaussians.model import SceneModel, compose
from mudg.gaussians.nodes import NodeRows, RigidNode, StaticNode
from mudg.gaussians.rendering import COVERED, RenderedCondition, raster_of, render_condition, rows_of
from mudg.gaussians.storage import load_model
from mudg.scene.read import read_scene
from mudg.sim.optics import Face, Optics, Pinhole, bilinear, faces_of, nearest, rays_of, rays_per_radian
from mudg.sim.returns import LogReturns, learn_returns, places_gone

Layer = Literal["rgb", "depth", "distance", "classes", "instances", "normals", "confidence", "motion"]
LAYERS: Final[tuple[Layer, ...]] = get_args(Layer)
CERTAIN: Final = 0.2
"""Certainty from which on the recording determines a pixel."""
STRIPS: Final = 8
"""Parts of an image with a rolling shutter, each drawn at the pose of its middle row or column."""
LARGEST_M: Final = 1e6
Matrix = NDArray[np.float64]
Reply = TypeVar("Reply", covariant=True)


class SensorRequest(Protocol[Reply]):
    """What a sensor asks of a session."""

    def answer(self, session: Session) -> Reply:
        """The measurement."""
        ...


@dataclass(frozen=True, slots=True, eq=False)
class Instant:
    """Where a sensor and the objects are. ``time_s``: on the scene's clock. ``world_from_sensor``: f64[4, 4].
    ``objects``: poses world-from-box f64[4, 4] by object; an object that is not listed is absent. None: as recorded."""

    time_s: float
    world_from_sensor: Matrix
    objects: Mapping[str, Matrix] | None = None

    def __post_init__(self) -> None:
        if not np.isfinite(self.time_s):
            raise UsageError("the time of a request is not finite", where="time_s", got=str(self.time_s))
        object.__setattr__(self, "world_from_sensor", _pose(self.world_from_sensor, "world_from_sensor"))
        if self.objects is not None:
            poses = {name: _pose(pose, f"objects: {name[:60]!r}") for name, pose in self.objects.items()}
            object.__setattr__(self, "objects", poses)

    def towards(self, end: Instant, share: float) -> Instant:
        """The moment at a share of the way to ``end``; objects are there that are there at both ends."""
        objects = None
        if self.objects is not None and end.objects is not None:
            objects = {
                name: geometry.interpolate_pose(pose, end.objects[name], share)
                for name, pose in self.objects.items()
                if name in end.objects
            }
        pose = geometry.interpolate_pose(self.world_from_sensor, end.world_from_sensor, share)
        return Instant(self.time_s + share * (end.time_s - self.time_s), pose, objects)


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class CameraRequest:
    """A picture that a camera would take. ``optics``: lens and size. ``start``, ``end``: of the exposure; ``end`` None:
    the same moment. ``shutter``: ``global`` draws the middle of the exposure; else the direction in which rows or
    columns are read. ``layers``: of ``LAYERS``. ``colors_of``: a camera of the log whose colours the picture has;
    empty: the first one. ``motion_to``: the later moment that the layer ``motion`` leads to."""

    optics: Optics
    start: Instant
    end: Instant | None = None
    shutter: Shutter = "global"
    layers: tuple[Layer, ...] = ("rgb",)
    colors_of: str = ""
    motion_to: Instant | None = None

    def __post_init__(self) -> None:
        unknown = [layer for layer in self.layers if layer not in LAYERS]
        if unknown or not self.layers:
            raise UsageError("no such layer", where="layers", expected=", ".join(LAYERS), got=", ".join(unknown))
        if self.shutter not in get_args(Shutter):
            raise UsageError("no such shutter", expected=", ".join(get_args(Shutter)), got=str(self.shutter))
        if ("motion" in self.layers) != (self.motion_to is not None):
            raise UsageError("the layer motion needs a later moment, and no other one does", where="motion_to")

    def answer(self, session: Session) -> CameraReply:
        """See ``SensorRequest``."""
        return session.picture(self)


@dataclass(frozen=True, slots=True)
class Trust:
    """How far the recording supports a view. ``determined``: share of the pixels, [0, 1], that photographs and LiDAR
    determine; sky above the horizon is left out, and what shows no surface below the horizon counts as undetermined.
    ``distance_m``, ``angle_deg``: to the recorded camera whose place and direction are nearest (10 m count as 90
    degrees); NaN without a log."""

    determined: float
    distance_m: float
    angle_deg: float

    def record(self) -> dict[str, float | None]:
        """As JSON values."""
        return {name: None if np.isnan(value) else round(value, 4) for name, value in asdict(self).items()}


@dataclass(frozen=True, slots=True, eq=False)
class CameraReply:
    """A simulated picture. ``layers`` by name: ``rgb`` u8[H, W, 3]; ``depth`` f32[H, W] camera z and ``distance``
    f32[H, W] along the ray, metres, NaN where there is no surface; ``classes`` u8[H, W] train ids, 255 = none;
    ``instances`` u16[H, W], 1 + index into ``objects``, 0 = none; ``normals`` f32[H, W, 3] in the camera's frame,
    towards the camera, NaN where there is no surface; ``confidence`` f32[H, W] in [0, 1]; ``motion`` f32[H, W, 2],
    pixels to the right and down to where the surface is at ``motion_to``, NaN where there is none or it leaves the
    lens. ``objects``: names for ``instances``."""

    layers: Mapping[str, NDArray[Any]]
    objects: tuple[str, ...]
    trust: Trust

    def finite(self) -> dict[str, NDArray[Any]]:
        """The layers without NaN: 0 in normals, else infinity."""
        found = dict(self.layers)
        for name in (name for name, layer in found.items() if layer.dtype.kind == "f"):
            missing = np.float32(0.0 if name == "normals" else np.inf)
            found[name] = np.where(np.isnan(found[name]), missing, found[name])
        return found


class Posed(StaticNode):
    """A dynamic object where a caller puts it. Within its box it is as at the nearest time of its own track."""

    def __init__(self, node: RigidNode, pose: Matrix, time_s: float) -> None:
        super().__init__(node.name)
        self.time_s = float(np.clip(time_s, node.times_s[0], node.times_s[-1]))
        own = node.pose_matrix(self.time_s)
        self.node = node if own is None else node.moved(geometry.invert(own) @ pose)

    def at_time(self, rows: NodeRows, time_s: float) -> NodeRows | None:
        """See ``StaticNode``."""
        return self.node.at_time(rows, self.time_s)

    def linked(self, nodes: Sequence[StaticNode | RigidNode]) -> Self:
        """See ``StaticNode``."""
        self.node = self.node.linked(nodes)
        return self


class Absent(StaticNode):
    """A dynamic object that a caller did not list."""

    def at_time(self, rows: NodeRows, time_s: float) -> NodeRows | None:
        """None."""
        return None


Planes = tuple[RenderedCondition, NDArray[np.int32] | None]
"""A pinhole view of the scene, and its instances i32[H, W] (None: not asked for)."""


class Session:
    """A fitted scene that answers sensor requests. ``run``: folder of ``mudg run``, ``mudg demo`` or ``mudg fit``, or a
    model in memory. ``edits``: an edit script, or its file, to carry out before. ``scene``: the log that the fit
    belongs to; a folder of a run has its own. ``device``: where pictures are drawn: ``auto``, ``cpu``, ``cuda``,
    ``cuda:N``. ``repair``: let the diffusion model make every picture once more, and mix both by its confidence, as
    ``mudg render --repair`` (about half a second a picture). Needs the folder of a run, and requests with a pinhole,
    one moment, and the objects as recorded.

    InputError: no fitted scene, or edits that cannot be carried out. ResourceError: no such device. UsageError: repairs
    without the clouds of a run, or of an edited one."""

    def __init__(
        self,
        run: str | Path | SceneModel,
        edits: str | Path | EditScript | None = None,
        scene: Scene | str | Path | None = None,
        device: str = "auto",
        repair: bool = False,
    ) -> None:
        parts = None if isinstance(run, SceneModel) else find_run(Path(run))
        self._mixer = None
        if repair:
            if parts is None or parts.scene is None or parts.fused is None or edits is not None:
                what, expected = "pictures cannot be repaired here", "the folder of a finished mudg run, without edits"
                raise UsageError(what, where="repair", expected=expected)
            self._mixer = RenderMixer(JobInputs(parts.scene, parts.fused, parts.model), device=device)
        if parts is not None:
            scene = scene if scene is not None else parts.scene
            run = load_model(parts.model)
        if repair:
            check_as_recorded(run, "repair")
        if isinstance(scene, str | Path):
            scene = read_scene(scene_at(Path(scene)))
        self._gone = None
        if edits is not None:
            script, before = edits if isinstance(edits, EditScript) else read_edits(edits), _background(run)
            run = carry_out(script, run, scene).model(run, keep_ego=True)
            self._gone = places_gone(before, _background(run))
        self._returns: dict[str, LogReturns | None] = {}
        self.scene: Scene | None = scene
        self.model = run.to(drawing_device(device, "sim"))
        self._nodes = {node.name: node for node in self.model.nodes if isinstance(node, RigidNode)}
        self._last: tuple[tuple[float, dict[str, bytes] | None], SceneModel, Gaussians] | None = None
        frames = () if scene is None else scene.frames
        self._recorded = np.stack([frame.view.world_from_cam for frame in frames]) if frames else np.zeros((0, 4, 4))

    @property
    def cameras(self) -> dict[str, Camera]:
        """Cameras of the log, by name; none without a log."""
        return {} if self.scene is None else dict(self.scene.cameras)

    def mounts(self) -> dict[str, Matrix]:
        """Poses vehicle-from-camera f64[4, 4] of the log's cameras, by their first frames of which the log knows the
        vehicle's pose."""
        found: dict[str, Matrix] = {}
        for frame in () if self.scene is None else self.scene.frames:
            ego = self.ego_pose(frame.view.time_s)
            if frame.view.camera.name not in found and ego is not None:
                found[frame.view.camera.name] = geometry.invert(ego) @ frame.view.world_from_cam
        return found

    @property
    def time_range_s(self) -> tuple[float, float]:
        """First and last time of the log, or of the objects' tracks, seconds; (0, 0) if there is neither."""
        times = [frame.view.time_s for frame in self.scene.frames] if self.scene is not None else []
        times += [float(t) for node in self._nodes.values() for t in node.times_s[[0, -1]] if self.scene is None]
        return (min(times), max(times)) if times else (0.0, 0.0)

    def objects(self, time_s: float) -> dict[str, Matrix]:
        """Recorded poses world-from-box f64[4, 4] of the objects that are there at a time."""
        poses = {name: node.pose_matrix(time_s) for name, node in self._nodes.items()}
        return {name: pose for name, pose in poses.items() if pose is not None}

    def sizes_m(self) -> dict[str, tuple[float, ...]]:
        """Length, width and height of every object, metres."""
        return {name: node.size_m for name, node in self._nodes.items()}

    def ego_pose(self, time_s: float) -> Matrix | None:
        """Recorded pose world-from-vehicle f64[4, 4] at a time; None outside the log."""
        return None if self.scene is None else self.scene.ego.pose_at(time_s)

    def log_returns(self, sensor: str = "") -> LogReturns | None:
        """What the sweeps of a LiDAR of the log (empty: its first) tell about surfaces, intensity and lost beams,
        learnt at the first call (half a minute); None without a log or its sweeps. UsageError: the log has no such
        LiDAR."""
        if sensor not in self._returns and self.scene is not None and self.scene.sweeps:
            self._returns[sensor] = learn_returns(self.scene, sensor, self._gone)
        return self._returns.get(sensor)

    def render(self, requests: Iterable[SensorRequest[Reply]]) -> list[Reply]:
        """What cameras and LiDARs measure, in the order of the requests. UsageError: an object that the scene does not
        have."""
        return [request.answer(self) for request in requests]

    # -- a moment ----------------------------------------------------------------------------------

    def at(self, moment: Instant) -> SceneModel:
        """The scene with its objects where the moment puts them; it shares all Gaussians. UsageError: an object that
        the scene does not have."""
        if moment.objects is None:
            return self.model
        if unknown := sorted(set(moment.objects) - set(self._nodes)):
            expected = ", ".join(sorted(self._nodes)) or "none: nothing moves in this scene"
            what, got = "the reconstruction has no such object", ", ".join(unknown)[:200]
            raise UsageError(what, where="objects", expected=expected, got=got)
        nodes = list[StaticNode | RigidNode]()
        for node in self.model.nodes:
            pose = moment.objects.get(node.name)
            if isinstance(node, RigidNode):
                node = Absent(node.name) if pose is None else Posed(node, pose, moment.time_s)
            nodes.append(node)
        return self.model.with_nodes(tuple(nodes))

    def _composed_at(self, moment: Instant) -> tuple[SceneModel, Gaussians]:
        """The scene at a moment and its Gaussians in the world; the last ones are kept for other sensors of it."""
        poses = None if moment.objects is None else {name: pose.tobytes() for name, pose in moment.objects.items()}
        if self._last is None or self._last[0] != (moment.time_s, poses):
            model = self.at(moment)
            with torch.no_grad():
                self._last = (moment.time_s, poses), model, compose(model, moment.time_s)
        return self._last[1:]

    def poses(self, moment: Instant) -> dict[str, Matrix]:
        """Poses of the objects that are there at a moment."""
        return self.objects(moment.time_s) if moment.objects is None else dict(moment.objects)

    def pinhole(self, view: View, moment: Instant, instances: bool = False) -> Planes:
        """A pinhole view of the scene at a moment; ``view.time_s`` is that of the moment."""
        model, gaussians = self._composed_at(moment)
        raster = raster_of(model)
        seen = render_condition(model, view, raster, gaussians)
        if not instances:
            return seen, None
        owner = {node.name: index for index, node in enumerate(model.nodes)}
        names = sorted(self._nodes)
        shape = tuple(seen.alpha.shape)
        weights, first = torch.zeros((0, *shape)), torch.zeros(0, dtype=torch.int64)
        inside = [k for k, name in enumerate(names) if self._reaches(view, name, moment)]
        for begin in range(0, len(inside), MAX_EXTRA_CHANNELS):
            chosen = inside[begin : begin + MAX_EXTRA_CHANNELS]
            marks = torch.stack([(gaussians.node == owner[names[k]]).float() for k in chosen], 1)
            drawn = rasterize(replace(gaussians, extra=marks), view, raster).extra
            if drawn is not None:
                weights = torch.cat([weights, drawn.detach().cpu()])
                first = torch.cat([first, torch.tensor(chosen)])
        found = np.zeros(shape, np.int32)
        if len(weights):
            most, which = weights.max(0)
            own = (most > 1 - weights.sum(0)) & (most >= COVERED / 2)
            found = torch.where(own, first[which] + 1, 0).numpy().astype(np.int32)
        return seen, found

    def alone(self, view: View, moment: Instant, name: str) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Alpha f32[H, W] and depth f32[H, W] in metres of one object drawn alone; alpha is 0 where it is absent."""
        model, gaussians = self._composed_at(moment)
        owner = next(index for index, node in enumerate(model.nodes) if node.name == name)
        rows = gaussians.node == owner
        if not rows.any() or not self._reaches(view, name, moment):
            nothing = np.zeros((view.camera.height, view.camera.width), np.float32)
            return nothing, nothing
        with torch.no_grad():
            drawn = rasterize(rows_of(gaussians, rows), view, raster_of(model))
        return drawn.alpha[0].cpu().numpy(), drawn.depth[0].cpu().numpy()

    def _reaches(self, view: View, name: str, moment: Instant) -> bool:
        """Whether any corner of an object's box may lie in a view."""
        pose = self.poses(moment).get(name)
        if pose is None:
            return False
        box = geometry.box_corners(1.2 * np.asarray(self._nodes[name].size_m))
        corners = geometry.transform_points(view.cam_from_world @ pose, box)
        if (corners[:, 2] <= 0.1).any():
            return bool((corners[:, 2] > 0).any())
        u, v = geometry.pinhole(view.camera.intrinsics, *corners.T)
        return bool(u.max() > 0 and v.max() > 0 and u.min() < view.camera.width and v.min() < view.camera.height)

    # -- a picture ---------------------------------------------------------------------------------

    def picture(self, request: CameraRequest) -> CameraReply:
        """What a camera sees. UsageError: an object that the scene does not have, or a picture that the session cannot
        repair."""
        width, height = request.optics.width, request.optics.height
        plain = request.optics.camera if isinstance(request.optics, Pinhole) else None
        if self._mixer is not None and (plain is None or request.end is not None or request.start.objects is not None):
            what = "this picture cannot be repaired"
            expected = "a pinhole without distortion, one moment, and the objects as recorded"
            raise UsageError(what, where="CameraRequest", expected=expected, remedy="open a session without repair")
        name = request.colors_of or next(iter(self.cameras), "sim")
        rays, canvas = rays_of(request.optics), Canvas(width, height)
        wants_instances = "instances" in request.layers or "motion" in request.layers
        for rows, columns, moment in _parts(request, width, height):
            pose, part = moment.world_from_sensor, rays[rows, columns]
            if plain is not None:
                shape = part.shape[:2]
                cx, cy = plain.cx - columns.start, plain.cy - rows.start
                camera = Camera(name, shape[1], shape[0], plain.fx, plain.fy, cx, cy)
                view = View(camera, pose, moment.time_s)
                seen, instances = self.pinhole(view, moment, wants_instances)
                seen = seen if self._mixer is None else _repaired(self._mixer, view, seen)
                canvas.take((rows, columns), (seen, instances), part)
                continue
            for face in faces_of(part, rays_per_radian(rays), name):
                planes = self.pinhole(face.view(pose, moment.time_s), moment, wants_instances)
                canvas.sample((rows, columns), planes, face)
        middle = request.start if request.end is None else request.start.towards(request.end, 0.5)
        made: dict[Layer, Callable[[], NDArray[Any]]] = {
            "rgb": lambda: to_bytes(torch.from_numpy(canvas.rgb)),
            "depth": lambda: (canvas.distance * rays[..., 2]).astype(np.float32),
            "distance": lambda: canvas.distance,
            "classes": lambda: canvas.classes,
            "instances": lambda: canvas.instances.astype(np.uint16),
            "confidence": lambda: canvas.certainty,
            "normals": lambda: normals_of(rays * canvas.distance[..., None]),
            "motion": lambda: self._motion(canvas, request, rays, middle),
        }
        layers = {layer: made[layer]() for layer in request.layers}
        trust = self._trust(canvas, middle, rays @ middle.world_from_sensor[2, :3])
        return CameraReply(layers, tuple(sorted(self._nodes)), trust)

    def _motion(self, canvas: Canvas, request: CameraRequest, rays: Matrix, now: Instant) -> NDArray[np.float32]:
        later = request.motion_to
        flow = np.full((*canvas.distance.shape, 2), np.nan, np.float32)
        plain = request.optics.camera if isinstance(request.optics, Pinhole) else None
        if plain is None or later is None:
            raise UsageError("the layer motion is drawn for pinhole cameras without distortion", where="optics")
        points = geometry.transform_points(now.world_from_sensor, (rays * canvas.distance[..., None]).reshape(-1, 3))
        owner, here, there = canvas.instances.reshape(-1), self.poses(now), self.poses(later)
        for index, name in enumerate(sorted(self._nodes)):
            own = owner == index + 1
            if own.any():
                moved = there[name] @ geometry.invert(here[name]) if name in there else np.full((4, 4), np.nan)
                points[own] = geometry.transform_points(moved, points[own])
        x, y, z = geometry.transform_points(geometry.invert(later.world_from_sensor), points).T
        with np.errstate(divide="ignore", invalid="ignore"):
            u, v = geometry.pinhole(plain.intrinsics, x, y, z)
        rows, columns = np.divmod(np.arange(len(points)), plain.width)
        seen = (z > 0) & np.isfinite(u + v)
        flow.reshape(-1, 2)[seen] = np.stack([u - columns - 0.5, v - rows - 0.5], 1)[seen]
        return flow

    def _trust(self, canvas: Canvas, middle: Instant, upwards: Matrix) -> Trust:
        solid = np.isfinite(canvas.distance)
        with np.errstate(invalid="ignore"):
            below = upwards < 0
        counted = (solid | below) & np.isfinite(upwards)
        sure = solid & (canvas.certainty > CERTAIN)
        share = float(sure.sum() / counted.sum()) if counted.any() else 1.0
        if not len(self._recorded):
            return Trust(share, float("nan"), float("nan"))
        away = np.linalg.norm(self._recorded[:, :3, 3] - middle.world_from_sensor[:3, 3], axis=1)
        cosine = (self._recorded[:, :3, 2] @ middle.world_from_sensor[:3, 2]).clip(-1, 1)
        angle = np.degrees(np.arccos(cosine))
        best = int((away / 10 + angle / 90).argmin())
        return Trust(share, float(away[best]), float(angle[best]))


class Canvas:
    """The layers of a picture while its parts are drawn."""

    def __init__(self, width: int, height: int) -> None:
        shape = (height, width)
        self.rgb = np.zeros((3, *shape), np.float32)
        self.distance = np.full(shape, np.nan, np.float32)
        self.classes = np.full(shape, UNLABELLED, np.uint8)
        self.certainty = np.zeros(shape, np.float32)
        self.instances = np.zeros(shape, np.int32)

    def take(self, where: tuple[slice, slice], planes: Planes, rays: Matrix) -> None:
        """A part that was drawn pixel by pixel."""
        seen, instances = planes
        self.rgb[:, *where] = seen.rgb.numpy()
        self.distance[where] = seen.depth.numpy() / rays[..., 2]
        self.classes[where] = seen.semantics.numpy()
        self.certainty[where] = seen.sure().numpy()
        if instances is not None:
            self.instances[where] = instances

    def sample(self, where: tuple[slice, slice], planes: Planes, face: Face) -> None:
        """Pixels of a part that lie in a face of the cube: colours between pixels, all else of the nearest one."""
        rows, columns = np.divmod(face.pixels, where[1].stop - where[1].start)
        place, (seen, instances) = (rows + where[0].start, columns + where[1].start), planes
        self.rgb[:, *place] = bilinear(seen.rgb.numpy(), face.uv)
        self.distance[place] = face.surface(seen.depth.numpy())[0]
        self.classes[place] = nearest(seen.semantics.numpy(), face.uv)
        self.certainty[place] = nearest(seen.sure().numpy(), face.uv)
        if instances is not None:
            self.instances[place] = nearest(instances, face.uv)


def _repaired(mixer: RenderMixer, view: View, rendered: RenderedCondition) -> RenderedCondition:
    """A rendered view with colour and depth mixed with what the diffusion model makes of it."""
    everywhere = torch.ones_like(rendered.depth, dtype=torch.bool)[None]
    shown = view, rendered.rgb, rendered.depth[None], None
    mixed = mixer(view, Observation(*shown, everywhere.float(), everywhere, "virtual", "mudg_s"))
    depth = rendered.depth if mixed.depth is None else mixed.depth[0]
    return replace(rendered, rgb=mixed.rgb, depth=depth)


def _background(model: SceneModel) -> Matrix:
    """Places f64[N, 3] of the Gaussians that stand still."""
    return model.table["means"].detach()[: model.counts()[0]].cpu().numpy().astype(np.float64)


def _pose(value: ArrayLike, where: str) -> Matrix:
    """A rigid pose f64[4, 4], at most ``LARGEST_M`` from the origin."""
    pose = np.array(value, np.float64)
    problem = geometry.rigid_problem(pose)
    if problem is None and np.abs(pose[:3, 3]).max() > LARGEST_M:
        problem = f"farther than {LARGEST_M:.0f} m from the origin"
    if problem:
        raise InputError("a pose of a request is not rigid", where=where, expected="a rigid 4x4 in metres", got=problem)
    return pose


def _parts(request: CameraRequest, width: int, height: int) -> list[tuple[slice, slice, Instant]]:
    """Rows and columns that are drawn together, and the moment of each: strips where the shutter rolls."""
    start, end = request.start, request.end
    everything = (slice(0, height), slice(0, width))
    if end is None:
        return [(*everything, start)]
    if request.shutter == "global":
        return [(*everything, start.towards(end, 0.5))]
    across = request.shutter in ("left_to_right", "right_to_left")
    length = width if across else height
    edges = np.unique(np.linspace(0, length, min(STRIPS, length) + 1).round().astype(int))
    found = []
    for first, last in zip(edges[:-1].tolist(), edges[1:].tolist(), strict=True):
        share = (first + last) / 2 / length
        share = 1 - share if request.shutter in ("bottom_to_top", "right_to_left") else share
        part = slice(first, last)
        rows, columns = (everything[0], part) if across else (part, everything[1])
        found.append((rows, columns, start.towards(end, share)))
    return found


def normals_of(points: Matrix) -> NDArray[np.float32]:
    """Unit normals f32[H, W, 3] of a surface seen as points f64[H, W, 3] in the camera's frame, towards the camera; NaN
    where a pixel or both of its neighbours in a row or column have no surface. Of two neighbours the nearer one
    counts, so that edges stay sharp."""
    sides = []
    for axis in (1, 0):
        step = np.diff(points, axis=axis)
        gap = np.full_like(np.take(points, [0], axis), np.nan)
        before, after = np.concatenate([gap, step], axis), np.concatenate([step, gap], axis)
        sizes = [np.nan_to_num(np.linalg.norm(v, axis=-1), nan=np.inf) for v in (before, after)]
        sides.append(np.where((sizes[0] < sizes[1])[..., None], before, after))
    with np.errstate(invalid="ignore", divide="ignore"):
        normal = np.cross(sides[1], sides[0])
        normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
        away = (normal * points).sum(-1) > 0
    return np.where(away[..., None], -normal, normal).astype(np.float32)
