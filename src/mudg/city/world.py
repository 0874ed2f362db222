"""A generated city with exact truth at any view and time of its log. Without the native library, building a world
raises ResourceError naming the remedy (there is no slow twin)."""

from __future__ import annotations

import copy
import ctypes
import functools
import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mudg import native
from mudg.base import geometry, seeds
from mudg.base.config import build, to_dict
from mudg.base.errors import InputError, ResourceError, UsageError
from mudg.base.palette import ID
from mudg.base.types import Camera, EgoPath, Observation, Source, SweepPoints, Track, View
from mudg.city import layout as rec
from mudg.city import sensors
from mudg.city.config import CityConfig
from mudg.city.furnish import furnish
from mudg.city.layout import Array, StreetPlan, plan_streets
from mudg.city.light import draw_photos, lamp_places, light_numbers, weather_numbers
from mudg.city.traffic import PosedObject, ego_keys, key_times, plan_traffic

# native --------------------------------------------------------------------------------------------

_P, _I, _L, _U = ctypes.c_void_p, ctypes.c_int, ctypes.c_int64, ctypes.c_uint32
_F64, _F32, _U8, _I32 = (np.ctypeslib.ndpointer(kind, flags="C") for kind in ("f8", "f4", "u1", "i4"))
_SIGNATURES: tuple[tuple[str, Any, list[Any]], ...] = (
    ("number_counts", _I, [_I]),
    ("create", _P, [_F64, _L, _F64, _L, _F64, _L, _F64, _L, _F64, _F64, _I]),
    ("destroy", None, [_P]),
    ("set_texture", _I, [_P, _I, _F32, _I, _I, ctypes.c_float]),
    ("set_weather", _I, [_P, _F64, _F64, _L]),
    ("planes", _I, [_P, _F64, _F64, _F64, _I, _I, _F64, _F32]),
    ("shape_count", _L, [_P]),
    ("render", _I, [_P, _F64, _F64, _F64, _I, _I, _F64, _I, _U, _F32, _F32, _U8, _I32]),
    ("sweep", _I, [_P, _F64, _I, _F64, _F64, _I, _F64, _I, _F64, _F64, _F64, _U, _F32, _F32, _U8, _I32]),
    ("street", None, [_P, _F64, _L, _F64]),
)


@functools.cache
def library() -> ctypes.CDLL:
    """The native library with the city's signatures set. ResourceError when there is none."""
    lib = native.require("rendering the city")
    for name, result, arguments in _SIGNATURES:
        function = getattr(lib, f"mudg_city_{name}")
        function.argtypes, function.restype = arguments, result
    return lib


def _f64(array: Any) -> Array:
    return np.ascontiguousarray(array, np.float64)


Truth = tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.uint8], NDArray[np.int32]]


class CityHandle:
    """Owns one native world."""

    def __init__(self, records: Array, plan: StreetPlan, road: Array, light: Array, seed: int) -> None:
        self._lib = library()
        line = _f64(np.stack([plan.line.s, plan.line.x, plan.line.y, plan.line.heading], 1))
        records, marks, walks, road, light = map(_f64, (records, plan.marks, plan.crosswalks, road, light))
        got = (len(road), len(light), records.shape[1])
        expected = tuple(self._lib.mudg_city_number_counts(which) for which in range(3))
        if got != expected:
            what = "the native library belongs to another version of the city"
            raise ResourceError(what, expected=str(got), got=str(expected), remedy="build it again")
        tables = [part for table in (records, line, marks, walks) for part in (table, len(table))]
        self._handle = self._lib.mudg_city_create(*tables, road, light, seed & 0x7FFFFFFF)
        if not self._handle:
            raise ResourceError("not enough memory to build the city")
        self.shape_count = int(self._lib.mudg_city_shape_count(self._handle))

    def set_texture(self, slot: int, rgb: NDArray[np.float32], metres: float) -> None:
        """Give a surface or the sky a photograph f32[H, W, 3]; before anything is rendered."""
        pixels = np.ascontiguousarray(rgb, np.float32)
        self._call("set_texture", "for a texture of", slot, pixels, pixels.shape[1], pixels.shape[0], metres)

    def set_weather(self, numbers: Array, lamps: Array) -> None:
        """Wet ground, snow and lamps f64[N, 3]; before anything is rendered. Numbers as in native/city_weather.cpp."""
        self._call("set_weather", "for the lamps of", _f64(numbers), _f64(lamps), len(lamps))

    def _call(self, name: str, purpose: str, *arguments: Any) -> None:
        if getattr(self._lib, f"mudg_city_{name}")(self._handle, *arguments):
            raise ResourceError(f"not enough memory {purpose} the city")

    def __del__(self) -> None:
        if getattr(self, "_handle", None):
            self._lib.mudg_city_destroy(self._handle)
            self._handle = None

    def render(
        self, objects: tuple[Array, Array], camera: Camera, world_from_cam: Array, supersample: int, noise_key: int
    ) -> Truth:
        """rgb f32[H, W, 3] in [0, 1], depth f32[H, W] (+inf in the sky), semantics u8[H, W], instance i32[H, W].
        ``objects``: poses f64[objects, 4] and phases."""
        truth, intrinsics = _empty(camera.height, camera.width), _f64(camera.intrinsics)
        view = (*map(_f64, objects), intrinsics, camera.width, camera.height, _f64(world_from_cam))
        self._call("render", "to render", *view, supersample, noise_key & 0xFFFFFFFF, *truth)
        return truth

    def sweep(
        self,
        objects: tuple[Array, Array],
        beams: tuple[Array, Array],
        world_from_lidar: Array,
        fractions: Array,
        settings: tuple[float, float, float, float],
        key: int,
    ) -> Truth:
        """World points f32[C, B, 3], intensity f32[C, B] (negative: no return), semantics u8[C, B], instance i32[C, B]
        for C columns and B beams. ``objects``: poses f64[knots, objects, 4] and phases. ``beams``: elevations and
        azimuths. ``world_from_lidar``: f64[C, 3, 4]."""
        (poses, phases), (elevations, azimuths) = map(_f64, objects), map(_f64, beams)
        points, rest = _empty(len(azimuths), len(elevations)), map(_f64, (world_from_lidar, fractions, settings))
        scan = (elevations, len(elevations), azimuths, len(azimuths), *rest, key & 0xFFFFFFFF)
        self._call("sweep", "to scan", poses, len(poses), phases, *scan, *points)
        return points

    def street(self, xy: Array) -> Array:
        """Per world point [N, 2]: street coordinates s, u and signed distance to the kerb (negative on the road)."""
        xy = _f64(xy).reshape(-1, 2)
        out = np.empty((len(xy), 3), np.float64)
        self._lib.mudg_city_street(self._handle, xy, len(xy), out)
        return out


def _empty(*shape: int) -> Truth:
    """Arrays for the native library to fill."""
    first, second = np.empty((*shape, 3), np.float32), np.empty(shape, np.float32)
    return first, second, np.empty(shape, np.uint8), np.empty(shape, np.int32)


# world ---------------------------------------------------------------------------------------------

DATASET = "mudg procedural city"
GENERATOR_VERSION = 1
FAR_BELOW_M = 1000.0
"""How far below the street what was taken away stands: nobody sees it there, and it shades nothing."""


@dataclass(frozen=True, slots=True, eq=False)
class CityTruth:
    """Exact truth at a view. ``rgb``: f32[H, W, 3], display values in [0, 1], averaged over the pixel. Of the ray
    through the pixel's centre: ``depth`` f32[H, W], camera z in metres, +inf in the sky; ``semantics`` u8[H, W],
    Cityscapes train ids; ``instance`` i32[H, W], id of a vehicle or person (see ``CityWorld.tracks``), 0 = none."""

    rgb: NDArray[np.float32]
    depth: NDArray[np.float32]
    semantics: NDArray[np.uint8]
    instance: NDArray[np.int32]

    @property
    def rgb_u8(self) -> NDArray[np.uint8]:
        """u8[H, W, 3]."""
        return (self.rgb * 255.0 + 0.5).astype(np.uint8)

    @property
    def sky(self) -> NDArray[np.bool_]:
        """bool[H, W]: no depth here."""
        return ~np.isfinite(self.depth)


@dataclass(frozen=True, slots=True, eq=False)
class CitySweep:
    """One turn of the LiDAR with its truth. ``points`` are in the LiDAR frame at ``time_s``, compensated for the motion
    of the recording vehicle (each point was measured at ``time_s + dt_s``; moving objects are where they were then).
    ``semantics`` u8[N] and ``instance`` i32[N] belong to the points."""

    time_s: float
    world_from_lidar: Array
    points: SweepPoints
    semantics: NDArray[np.uint8]
    instance: NDArray[np.int32]


class CityWorld:
    """The world of one configuration. Immutable; ``render`` may be called from several threads. ResourceError: the
    native library is missing."""

    def __init__(self, config: CityConfig) -> None:
        self.config = config
        self.plan: StreetPlan = plan_streets(config)
        self.light_name, light = light_numbers(config)
        self._ego_times, self._ego_poses = ego_keys(config, self.plan)
        self.objects: tuple[PosedObject, ...] = tuple(plan_traffic(config, self.plan, self._ego_times, self._ego_poses))
        self.key_times_s = key_times(config)
        """Times f64[K] of the keys of all objects."""
        rows = furnish(config, self.plan) + [m.row for m in self.objects]
        self.lamps: Array = lamp_places(rows)
        no_keys = np.zeros((len(self.key_times_s), 0, 4))
        self._keys = np.stack([m.keys for m in self.objects], 1) if self.objects else no_keys
        self._gaits = np.array([m.gait_rad_per_s for m in self.objects], np.float64)
        self._gait_starts = seeds.numpy_rng(config.seed, 0, "city gait").uniform(0, 2 * np.pi, len(self.objects))
        road, seed = _road_numbers(config, self.plan), seeds.key(config.seed, 0, "city surfaces")
        self._handle = CityHandle(np.array(rows, np.float64), self.plan, road, light, seed)
        for slot, rgb, metres in draw_photos(Path(config.textures), config.seed) if config.textures else ():
            self._handle.set_texture(slot, rgb, metres)
        numbers = weather_numbers(config)
        if numbers is not None:
            self._handle.set_weather(numbers, self.lamps)
        self._cameras = sensors.cameras(config)
        self._mounts = sensors.ego_from_camera(config)
        self._ego_path = EgoPath(self._ego_times, self._ego_poses)

    @classmethod
    def from_source(cls, source: Source) -> CityWorld:
        """Rebuild the world a scene was recorded in, bit for bit, from the recipe in its ``source``. InputError: the
        source holds no recipe of this generator."""
        recipe = source.recipe
        if recipe is None or "city" not in recipe:
            what = "the scene was not generated, so there is no exact truth"
            raise InputError(what, where="source.recipe", got=source.dataset)
        if recipe.get("generator_version") != GENERATOR_VERSION:
            what, where = "the scene was made by another version of the generator", "source.recipe.generator_version"
            got = str(recipe.get("generator_version"))
            raise InputError(what, where=where, expected=str(GENERATOR_VERSION), got=got, remedy="generate it again")
        if not isinstance(recipe["city"], Mapping):
            what = "the recipe of a generated city is no object"
            raise InputError(what, where="source.recipe.city", got=str(recipe["city"]))
        try:
            return cls(build(CityConfig, recipe["city"], "source.recipe.city"))
        except UsageError as error:  # nobody asked for these settings: a file states them
            what, remedy = error.what, "generate it again"
            raise InputError(what, where=error.where, expected=error.expected, got=error.got, remedy=remedy) from error

    def rearranged(self, keys: Mapping[str, Array | None]) -> CityWorld:
        """The same world, light and shadows included, with some vehicles or people elsewhere or gone. ``keys``: track
        id -> x, y, z of the point on the ground below the box's centre, yaw f64[K, 4] at ``key_times_s``; None: not
        there."""
        moved, known = self._keys.copy(), [track.id for track in self.tracks()]
        for track_id, values in keys.items():
            if track_id not in known:
                raise UsageError("the city has no such object", expected=", ".join(known), got=track_id)
            index = known.index(track_id)
            if values is None:
                moved[:, index, 2] = -FAR_BELOW_M
            else:
                moved[:, index] = values
        other = copy.copy(self)
        other._keys = moved
        return other

    def source(self) -> Source:
        """What a scene of this world records about its origin."""
        recipe: Mapping[str, Any] = {"city": to_dict(self.config), "generator_version": GENERATOR_VERSION}
        return Source(DATASET, "CC0-1.0", recipe, (f"generated city, light: {self.light_name}",))

    def describe(self) -> str:
        """One line about what was drawn."""
        plan, moving = self.plan, sum(m.moving for m in self.objects)
        return (
            f"{'urban' if plan.urban else 'suburban'}, {self.light_name}, {len(plan.forward_lanes)}+"
            f"{len(plan.backward_lanes)} lanes, {'no' if plan.crossing is None else 'a'} crossing,"
            f" {plan.drive_length:.0f} m of drive, {moving} moving and {len(self.objects) - moving} standing objects,"
            f" {self._handle.shape_count} shapes"
        )

    @property
    def span_s(self) -> tuple[float, float]:
        """First and last time that can be rendered."""
        return float(self.key_times_s[0]), float(self.key_times_s[-1])

    def frame_time(self, index: int) -> float:
        """Time of a frame in seconds."""
        return index / self.config.rate_hz

    def cameras(self) -> dict[str, Camera]:
        """The recorded cameras."""
        return {name: self._cameras[name] for name in self.config.cameras}

    def ego_path(self) -> EgoPath:
        """Poses of the vehicle, four keys per frame and half a frame beyond both ends; what ``pose_at`` interpolates is
        the truth the LiDAR was simulated with."""
        return self._ego_path

    def tracks(self) -> tuple[Track, ...]:
        """Boxes of all vehicles and people, parked ones with a constant pose. The number in the id is the instance id.
        Truth between keys is exactly ``Track.pose_at``."""
        tracks = []
        for number, posed in enumerate(self.objects, 1):
            label, half = rec.LABELS[int(posed.row[0])], posed.size[2] / 2
            poses = np.stack([geometry.yaw_matrix(float(yaw), (x, y, z + half)) for x, y, z, yaw in posed.keys])
            tracks.append(Track(f"{label}-{number:03d}", label, np.array(posed.size), self.key_times_s, poses))
        return tuple(tracks)

    def instance_of(self, track_id: str) -> int:
        """Instance id of a track."""
        return int(track_id.rsplit("-", 1)[1])

    def frame_views(self, camera: str) -> tuple[View, ...]:
        """The recorded views of a camera, one per frame."""
        if camera not in self._cameras:
            raise UsageError("the city has no such camera", expected=", ".join(self._cameras), got=camera)
        recorded, mount, times = self._cameras[camera], self._mounts[camera], range(self.config.n_frames)
        return tuple(View(recorded, self.frame_pose(t) @ mount, t) for t in map(self.frame_time, times))

    def frame_pose(self, time_s: float) -> Array:
        """world_from_ego f64[4, 4] of the recording vehicle; UsageError outside the log."""
        pose = self._ego_path.pose_at(time_s)
        if pose is None:
            raise _outside(self._ego_times, f"{time_s}")
        return pose

    def _objects_at(self, *times_s: float, phase_s: float | None = None) -> tuple[Array, Array]:
        """x, y, z, yaw f64[T, objects, 4] between the keys, as Track.pose_at interpolates; and the phases of their
        gaits, at the first time unless another is given."""
        times, keys, wanted = self.key_times_s, self._keys, np.array(times_s)
        first, last = self.span_s
        if wanted.min() < first - 1e-6 or wanted.max() > last + 1e-6:
            raise _outside(times, f"{wanted.min()}..{wanted.max()}")
        at = np.clip((wanted - first) * self.config.rate_hz, 0, len(times) - 1)
        nearest = np.rint(at)
        at = np.where(np.abs(at - nearest) < 1e-6 * self.config.rate_hz, nearest, at)
        before = np.minimum(at.astype(int), len(times) - 2)
        u = (at - before)[:, None, None]
        phases = self._gait_starts + self._gaits * (times_s[0] if phase_s is None else phase_s)
        return keys[before] + u * (keys[before + 1] - keys[before]), phases

    def markings(self, view: View, truth: CityTruth) -> NDArray[np.bool_]:
        """Pixels bool[H, W] whose centre shows paint on the road, exactly: without the blur of a pixel and without
        wear. ``truth``: what ``render`` gave for this view."""
        rows, columns = np.nonzero((truth.semantics == ID["road"]) & ~truth.sky)
        xyz = geometry.unproject(view, np.stack([columns, rows], 1) + 0.5, truth.depth[rows, columns])
        mask = np.zeros(truth.semantics.shape, bool)
        if len(xyz):
            mask[rows, columns] = rec.painted(self.plan, self._handle.street(xyz[:, :2]), xyz[:, :2])
        return mask

    def beyond_kerb_m(self, xy: Array) -> Array:
        """Distance f64[N] of places f64[N, 2] from the kerb, metres; negative on the road."""
        return self._handle.street(xy)[:, 2]

    def lane_lines(self) -> list[Array]:
        """Road lines, road edges and crosswalks as a map has them: lines f64[N, 3] in the world, metres."""
        return rec.lane_lines(self.plan)

    def render(self, view: View, *, supersample: int | None = None, sensor_noise: bool = False) -> CityTruth:
        """Truth at any view whose time lies in ``span_s``. ``supersample``: rays per pixel and axis; None: the
        configuration's. ``sensor_noise``: add the camera noise of a recorded image; the same view gives the same noise.
        UsageError: time outside the log, or a camera with distortion or a rolling shutter."""
        camera = view.camera
        if camera.readout_s != 0 or any(camera.distortion):
            raise UsageError("the city renders undistorted global-shutter cameras", where=f"camera {camera.name!r}")
        noise_key = 0
        if sensor_noise:
            noise_key = seeds.key(self.config.seed, round(view.time_s * 1e4), f"city noise {camera.name}") | 1
        per_axis = self.config.supersample if supersample is None else supersample
        if not 1 <= per_axis <= 8:
            raise UsageError("supersample must lie in 1..8", got=str(per_axis))
        objects = self._objects_at(view.time_s)
        return CityTruth(*self._handle.render(objects, camera, view.world_from_cam, per_axis, noise_key))

    def observation(self, view: View, truth: CityTruth | None = None) -> Observation:
        """Noise-free truth as torch tensors; depth is 0 (= none) in the sky, everything may be used. ``truth``: what
        ``render`` gave for this view already."""
        import torch

        truth = truth or self.render(view)
        rgb = torch.from_numpy(truth.rgb).permute(2, 0, 1).contiguous()
        depth = torch.from_numpy(np.where(truth.sky, np.float32(0), truth.depth))[None]
        semantics = torch.from_numpy(truth.semantics.astype(np.int64))
        ones = torch.ones((1, *semantics.shape))
        return Observation(view, rgb, depth, semantics, ones, ones.bool(), "recorded", "city truth")

    def render_rolling(self, view: View, readout_s: float, strips: int = 8) -> CityTruth:
        """The image of a rolling shutter: vehicle and objects move while the rows are read, the middle row at the
        view's time, in strips of one time each. Times beyond the log's span keep the pose of its end."""
        camera, parts = view.camera, []
        mount = geometry.invert(self.frame_pose(view.time_s)) @ view.world_from_cam
        edges = np.linspace(0, camera.height, min(strips, camera.height) + 1).round().astype(int)
        first, last = max(self.span_s[0], float(self._ego_times[0])), min(self.span_s[1], float(self._ego_times[-1]))
        for top, bottom in zip(edges[:-1].tolist(), edges[1:].tolist(), strict=True):
            at = view.time_s + readout_s * ((top + bottom) / 2 / camera.height - 0.5)
            at = min(max(at, first), last)
            strip, pose = replace(camera, cy=camera.cy - top, height=bottom - top), self.frame_pose(at) @ mount
            parts.append(self._handle.render(self._objects_at(at), strip, pose, self.config.supersample, 0))
        rgb, depth, semantics, instance = zip(*parts, strict=True)
        return CityTruth(*map(np.concatenate, (rgb, depth, semantics, instance)))

    def ranges(self, places: Array, directions: Array, times_s: Array) -> tuple[Array, Array]:
        """Exact range f64[N] in metres and intensity f64[N] of single beams without noise; NaN: nothing returns (glass
        and weak surfaces lose beams as in a sweep). ``places``, ``directions``: f64[N, 3] in the world, of length 1.
        ``times_s``: f64[N]; limbs of people keep their pose of the middle."""
        first, last = (float(np.clip(end, *self.span_s)) for end in (times_s.min(), times_s.max()))
        middle = (first + last) / 2
        share = ((times_s - first) / (last - first)).clip(0, 1) if last > first else np.zeros(len(times_s))
        # neighbours fire apart, so that no two share their candidates
        turns = np.asarray(0.1 * (np.arange(len(times_s)) % 6), np.float64)
        cos, sin, zero = np.cos(turns), np.sin(turns), np.zeros(len(turns))
        back = np.stack([cos, sin, zero, -sin, cos, zero, zero, zero, zero + 1], 1).reshape(-1, 3, 3)
        # rotations whose x axis is the direction
        helper = np.where(np.abs(directions[:, 2:]) < 0.9, [[0.0, 0.0, 1.0]], [[1.0, 0.0, 0.0]])
        left = np.cross(helper, directions)
        left /= np.linalg.norm(left, axis=1, keepdims=True)
        axes = np.stack([directions, left, np.cross(directions, left)], 2)
        poses = np.concatenate([axes @ back, places[:, :, None]], 2)
        objects, settings = (
            self._objects_at(first, middle, last, phase_s=middle),
            (self.config.lidar_range_m, 0, 0, 0.55),
        )
        key = seeds.key(self.config.seed, round(middle * 1e6), "exact beams")
        xyz, intensity, _, _ = self._handle.sweep(objects, (np.zeros(1), turns), poses, share, settings, key)
        returned = intensity[:, 0] >= 0
        range_m, light = np.full(len(times_s), np.nan), np.full(len(times_s), np.nan)
        range_m[returned] = np.linalg.norm(xyz[returned, 0].astype(np.float64) - places[returned], axis=1)
        light[returned] = intensity[returned, 0]
        return range_m, light

    def lidar_sweep(self, index: int, scan: sensors.LidarScan | None = None) -> CitySweep:
        """The sweep around the time of frame ``index``: it starts and ends half a turn away from it, looking backwards.
        Vehicle and objects move during the turn; the limbs of people keep their pose of the middle. ``scan``: another
        LiDAR than the configuration's; with a delay, points and pose are what a log has whose clock is wrong by it."""
        config = self.config
        if not 0 <= index < config.n_frames:
            raise UsageError("there is no such sweep", expected=f"0..{config.n_frames - 1}", got=str(index))
        time_s, period, azimuths = self.frame_time(index), 1.0 / config.rate_hz, sensors.lidar_azimuths(config)
        offsets = (np.arange(len(azimuths)) + 0.5) / len(azimuths) * period - period / 2
        scan = scan or sensors.LidarScan(sensors.ego_from_lidar(), sensors.lidar_elevations(config))
        mount, knots = scan.ego_from_lidar, np.array([time_s - period / 2, time_s, time_s + period / 2])
        time_s += scan.delay_s
        knots = np.clip(knots + scan.delay_s, *self.span_s)
        world_from_lidar = self.frame_pose(time_s) @ mount
        columns = _interpolated_poses(self._ego_times, self._ego_poses, time_s + offsets) @ mount
        settings = (config.lidar_range_m, config.lidar_noise_m, config.lidar_dropout, 0.55)
        fractions, key = (offsets + period / 2) / period, seeds.key(config.seed, index, f"city lidar{scan.name}")
        objects, beams = self._objects_at(*knots, phase_s=time_s), (scan.elevations_rad, azimuths)
        found = self._handle.sweep(objects, beams, columns[:, :3], fractions, settings, key)
        xyz, intensity, semantics, instance = found
        hit = intensity >= 0
        lidar_from_world = geometry.invert(world_from_lidar)
        world = xyz[hit].astype(np.float64)
        local = np.einsum("ij,nj->ni", lidar_from_world[:3, :3], world) + lidar_from_world[:3, 3]
        dt_s = np.broadcast_to(offsets[:, None], hit.shape)[hit]
        points = SweepPoints(local.astype(np.float32), intensity[hit], dt_s.astype(np.float32))
        if scan.delay_s:
            time_s -= scan.delay_s
            world_from_lidar = self.frame_pose(time_s) @ mount
        return CitySweep(time_s, world_from_lidar, points, semantics[hit], instance[hit])


def _outside(times: Array, got_s: str) -> UsageError:
    expected = f"{times[0]:.3f}..{times[-1]:.3f} s"
    return UsageError("time lies outside the log", expected=expected, got=f"{got_s} s")


def _interpolated_poses(times: Array, poses: Array, at: Array) -> Array:
    """``geometry.pose_at`` for many times f64[N, 4, 4]: slerp and straight line between neighbouring keys."""
    before = np.clip(np.searchsorted(times, at, side="right") - 1, 0, len(times) - 2)
    out = np.empty((len(at), 4, 4))
    for i in np.unique(before):
        rows = before == i
        u = (at[rows] - times[i]) / (times[i + 1] - times[i])
        q0, q1 = geometry.quaternion_from_matrix(poses[i]), geometry.quaternion_from_matrix(poses[i + 1])
        q1 = q1 if float(q0 @ q1) >= 0 else -q1
        angle = math.acos(min(1.0, float(q0 @ q1)))
        if angle < 1e-6:
            q = q0 + u[:, None] * (q1 - q0)
        else:
            q = (np.sin((1 - u) * angle)[:, None] * q0 + np.sin(u * angle)[:, None] * q1) / math.sin(angle)
        w, x, y, z = q.T
        turns = [
            *(1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
            *(2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
            *(2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
        ]
        out[rows, :3, :3] = np.stack(turns, 1).reshape(-1, 3, 3)
        out[rows, :3, 3] = (1 - u)[:, None] * poses[i][:3, 3] + u[:, None] * poses[i + 1][:3, 3]
        out[rows, 3] = (0, 0, 0, 1)
    return out


def _road_numbers(config: CityConfig, plan: StreetPlan) -> Array:
    """Numbers of the road in the order of ``RoadNumber`` in native/city.cpp."""
    rng = seeds.numpy_rng(config.seed, 0, "city ground")
    cross = [0.0] * 10
    if (c := plan.crossing) is not None:
        cross = [1.0, c.s, c.x, c.y, c.yaw, c.half_width, c.corner, c.start, c.end, c.sidewalk]
    grey = rng.uniform(0.045, 0.11)
    warm = rng.uniform(-0.06, 0.06)
    asphalt = grey * np.array([1 + warm, 1.0, 1 - warm])
    stone = rng.uniform(0.17, 0.32)
    pale = rng.uniform(-0.04, 0.10)
    sidewalk = stone * np.array([1 + pale, 1.0, 1 - pale])
    greens = np.array([[0.075, 0.12, 0.03], [0.10, 0.135, 0.035], [0.15, 0.145, 0.05], [0.06, 0.10, 0.03]])
    terrain = greens[rng.integers(4)] * rng.uniform(0.85, 1.2)
    line, pad = plan.line, 75.0
    bounds = [line.x.min() - pad, line.y.min() - pad, line.x.max() + pad, line.y.max() + pad]
    edges = ("left", "right", "sidewalk_left", "sidewalk_right", "paved_left", "paved_right", "park_left", "park_right")
    grounds = [*asphalt, *sidewalk, *(sidewalk * rng.uniform(0.9, 1.2)), *terrain]
    wear = [rng.uniform(0.5, 1.6), rng.uniform(0.0, 1.0), rng.uniform(0.0, 1.0), float(rng.random() < 0.3)]
    texture = float((seeds.key(config.seed, 0, "city ground texture") & 0x7FFFFFFF) % 1_000_000)
    numbers = [*(getattr(plan, edge) for edge in edges), *cross, plan.lane_width, texture, *grounds, *wear]
    return np.array([*numbers, *np.floor(bounds)], np.float64)
