"""A simulated LiDAR. Each slice of a sweep is drawn at the pose and time of its middle, then its beams are placed by
their own poses. With a log, a beam meets the surface that the log's sweeps measured, with its intensity, or is lost as
beams were lost there (``sim/returns.py``); where they measured nothing, and without a log, it meets the Gaussians."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Final, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import Field

from mudg.base import geometry, log, seeds, store
from mudg.base.errors import UsageError
from mudg.base.palette import UNLABELLED
from mudg.base.records import Number, StrictRecord, parse_record
from mudg.base.types import Scene, Sweep, SweepPoints
from mudg.base.weather_settings import WeatherSettings
from mudg.core.trajectory import ego_left_world, trajectory_name
from mudg.core.weather.air import SOFT, sweep_in_weather
from mudg.editing.script import EditScript
from mudg.editing.settings import RenderConfig
from mudg.scene.beams import Beams, beams_of, with_silent
from mudg.scene.observations import SWEEPS_INDEX, SimulatedSweep, SweepSet, write_index
from mudg.scene.read import read_scene
from mudg.sim.optics import faces_of, nearest
from mudg.sim.returns import LogReturns
from mudg.sim.session import Instant, Session

Floats = NDArray[np.float64]
SLICES: Final = 8
"""Parts of a turn, each drawn at the pose of its middle."""
AXES: Final = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])
"""Rotation sensor-from-camera: a LiDAR looks along x, y is left, z up."""
MOST_BEAMS: Final = 4_000_000
COARSE: Final = 0.5
"""Size of the views where the log's sweeps tell most ranges, as a share of those without a log."""
MOST_MOMENTS: Final = 4096
"""Beams of more moments than these are carried to the end of the sweep by the nearest of so many."""


@dataclass(frozen=True, slots=True, eq=False)
class BeamTable:
    """The beams of one sweep, in firing order. ``directions``: unit vectors f64[B, 3] in the sensor's frame (x forward,
    y left, z up). ``ring``: u16[B], row of the sensor. ``share``: f64[B] in [0, 1], when in the sweep a beam is fired.
    ``range_m``: nearest and farthest distance that is measured, metres."""

    directions: Floats
    ring: NDArray[np.uint16]
    share: Floats
    range_m: tuple[float, float] = (0.5, 120.0)

    def __post_init__(self) -> None:
        count = len(self.directions)
        if not 0 < count <= MOST_BEAMS or self.directions.shape != (count, 3):
            raise UsageError("no beams", where="directions", expected=f"1 to {MOST_BEAMS} rows of 3", got=str(count))
        if self.ring.shape != (count,) or self.share.shape != (count,):
            raise UsageError("ring and share have other lengths than the beams", expected=str(count))
        if not np.isfinite(self.directions).all() or not ((self.share >= 0) & (self.share <= 1)).all():
            raise UsageError("a beam is not finite, or is fired outside the sweep", where="directions, share")
        if not 0 <= self.range_m[0] < self.range_m[1] < np.inf:
            raise UsageError("the nearest range is not below the farthest", where="range_m", got=str(self.range_m))

    @classmethod
    def spinning(
        cls,
        elevations_deg: ArrayLike,
        azimuth_step_deg: float,
        range_m: tuple[float, float] = (0.5, 120.0),
        clockwise: bool = True,
    ) -> BeamTable:
        """A sensor that turns once, from backwards to backwards. ``elevations_deg``: of the rows, degrees above the
        horizon. ``azimuth_step_deg``: between firings of one row."""
        elevations = np.radians(np.asarray(elevations_deg, np.float64).reshape(-1))
        if not (np.isfinite(azimuth_step_deg) and 0.01 <= azimuth_step_deg <= 90):
            expected = "0.01 to 90 degrees"
            raise UsageError("no such step", where="azimuth_step_deg", expected=expected, got=str(azimuth_step_deg))
        columns = round(360 / azimuth_step_deg)
        if columns * len(elevations) > MOST_BEAMS:
            got = f"{columns} columns of {len(elevations)} rows"
            raise UsageError("too many beams", where="azimuth_step_deg", expected=f"at most {MOST_BEAMS}", got=got)
        share = (np.arange(columns) + 0.5) / columns
        azimuth = (np.pi * (1 - 2 * share) * (1 if clockwise else -1))[:, None]
        level, up = np.cos(elevations)[None], np.tile(np.sin(elevations), (columns, 1))
        away = np.stack([np.cos(azimuth) * level, np.sin(azimuth) * level, up], -1)
        ring = np.tile(np.arange(len(elevations), dtype=np.uint16), columns)
        return cls(away.reshape(-1, 3), ring, np.repeat(share, len(elevations)), range_m)


def forward(
    elevations_deg: NDArray[np.float64], field_deg: float, step_deg: float, range_m: tuple[float, float]
) -> BeamTable:
    """A LiDAR that sweeps a field ahead of it from left to right."""
    turn = BeamTable.spinning(elevations_deg, step_deg, range_m)
    inside = np.abs(np.degrees(np.arctan2(turn.directions[:, 1], turn.directions[:, 0]))) <= field_deg / 2
    if not inside.any():
        what, expected = "the field of view is narrower than a step", f"at least {step_deg:g} degrees"
        raise UsageError(what, where="field_deg", expected=expected, got=f"{field_deg:g}")
    share = turn.share[inside]
    share = (share - share.min()) / max(float(np.ptp(share)), 1e-9)
    return BeamTable(turn.directions[inside], turn.ring[inside], share, range_m)


HDL64: Final = np.concatenate([np.linspace(-24.33, -8.83, 32), np.linspace(-8.33, 2.0, 32)])
TABLES: Final[dict[str, Callable[[], BeamTable]]] = {
    "pandar128": lambda: BeamTable.spinning(np.linspace(-25.0, 15.0, 128), 0.2, (0.3, 200.0)),
    "at128": lambda: forward(np.linspace(-12.7, 12.7, 128), 120.0, 0.1, (0.5, 200.0)),
    "hdl64": lambda: BeamTable.spinning(HDL64, 0.17, (0.9, 120.0)),
    "vlp16": lambda: BeamTable.spinning(np.linspace(-15.0, 15.0, 16), 0.2, (0.5, 100.0)),
}
"""Name -> beams. Rows of pandar128 and at128 are evenly spread here."""


class TableFile(StrictRecord):
    """A turning sensor, or one that sweeps a field ahead of it."""

    elevations_deg: Annotated[list[Number], Field(min_length=1, max_length=512)]
    azimuth_step_deg: Number
    range_m: Annotated[list[Number], Field(min_length=2, max_length=2)] = [0.5, 120.0]
    field_deg: Annotated[Number, Field(gt=0)] = 360.0
    direction: Literal["clockwise", "anticlockwise"] = "clockwise"


def read_table(path: Path) -> BeamTable:
    """The table in a JSON file (docs/simulator.md). InputError: no such file, or fields that make no sense. UsageError:
    numbers that no sensor has."""
    found = parse_record(TableFile, store.read_json(path), str(path))
    elevations, limits = np.array(found.elevations_deg), (found.range_m[0], found.range_m[1])
    if found.field_deg < 360:
        return forward(elevations, found.field_deg, found.azimuth_step_deg, limits)
    return BeamTable.spinning(elevations, found.azimuth_step_deg, limits, found.direction == "clockwise")


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class LidarRequest:
    """A sweep that a LiDAR would take. ``beams``: what is fired. ``start``, ``end``: of the sweep; ``end`` None: all at
    one moment. ``weather``: fog and rain that take from and add to it, or None. ``seed``: of the noise of weather.
    ``focal_px``: pixels per radian of the views that are sampled. ``like``: the LiDAR of the log that it resembles:
    what that one measured counts. Empty: the log's first."""

    beams: BeamTable
    start: Instant
    end: Instant | None = None
    weather: WeatherSettings | None = None
    seed: int = 0
    focal_px: float = 700.0
    like: str = ""

    def answer(self, session: Session) -> LidarReply:
        """The sweep. Beams into the sky, beyond the range or into what the recording never saw return nothing."""
        return _sweep(session, self)


@dataclass(frozen=True, slots=True, eq=False)
class LidarReply:
    """A simulated sweep: the beams that returned. ``beam``: i64[N], their numbers in the table. ``range_m``: f32[N]
    from the sensor at the moment of the beam, metres. ``xyz``: f32[N, 3] metres, in the sensor's frame at the end of
    the sweep. ``dt_s``: f32[N], seconds after the end. ``intensity``: f32[N] in [0, 1]: as the log's sweeps measured it
    there; elsewhere how well the surface faces the beam, times 0.5. ``classes``: u8[N] train ids, 255 = none.
    ``instances``: u16[N], 1 + index into ``objects``, 0 = none. ``surface_m``: f32[B] of all beams of the table: range
    of what each meets, also where it is lost; NaN: nothing. ``facing``: f32[B], how well that surface faces the beam,
    [0, 1]."""

    beam: NDArray[np.int64]
    range_m: NDArray[np.float32]
    xyz: NDArray[np.float32]
    dt_s: NDArray[np.float32]
    intensity: NDArray[np.float32]
    ring: NDArray[np.uint16]
    classes: NDArray[np.uint8]
    instances: NDArray[np.uint16]
    objects: tuple[str, ...]
    surface_m: NDArray[np.float32]
    facing: NDArray[np.float32]

    def arrays(self, beams: BeamTable) -> dict[str, NDArray[Any]]:
        """What a file of sweeps holds (``scene/observations.py``)."""
        kept = {name: getattr(self, name) for name in ("xyz", "dt_s", "classes", "ring", "facing")}
        kept |= {"intensity": self.intensity.astype(np.float32), "beam": self.beam.astype(np.int64)}
        fired = {name: getattr(beams, name).astype(np.float32) for name in ("directions", "share")}
        return {**kept, **fired, "range_m": self.surface_m}


def _sweep(session: Session, request: LidarRequest) -> LidarReply:
    beams, start, end = request.beams, request.start, request.end or request.start
    hits, known = Hits(len(beams.share)), session.log_returns(request.like)
    focal_px = request.focal_px * (1.0 if known is None else COARSE)
    edges = np.linspace(0, 1, (SLICES if request.end is not None else 1) + 1)
    for first, last in zip(edges[:-1], edges[1:], strict=True):
        own = np.flatnonzero((beams.share >= first) & ((beams.share < last) | (last == 1)))
        if len(own):
            moment = start.towards(end, (first + last) / 2)
            _draw(session, moment, beams.directions[own] @ AXES, own, focal_px, hits)
            if known is not None:
                _meet(session, known, moment, beams.directions[own], own, hits)
    near, far = beams.range_m
    with np.errstate(invalid="ignore"):
        within = (hits.distance >= near) & (hits.distance <= far)
    kept = np.flatnonzero(within & ~hits.lost)
    points = (beams.directions[kept] * hits.distance[kept][:, None]).astype(np.float32)
    intensity, classes, fog = hits.intensity[kept], hits.classes[kept], np.zeros(len(kept), bool)
    if request.weather is not None:
        numbers = np.arange(len(kept), dtype=np.float32)
        seed = seeds.key(request.seed, round(end.time_s * 1e6), "simulated LiDAR")
        clear = SweepPoints(points, intensity, numbers, classes)
        changed, kind = sweep_in_weather(clear, request.weather, seed)
        rows = changed.dt_s.astype(np.int64)
        kept, points, intensity, fog = kept[rows], changed.xyz, changed.intensity, kind == SOFT
        classes = hits.classes[kept] if changed.classes is None else changed.classes
    share = beams.share[kept]
    xyz = points if request.end is None else _carried(points, share, start, end)
    dt_s = ((share - 1) * (end.time_s - start.time_s)).astype(np.float32)
    instances = np.where(fog, 0, hits.instances[kept]).astype(np.uint16)
    returned = (kept, np.linalg.norm(points, axis=1), xyz, dt_s, intensity, beams.ring[kept], classes, instances)
    surface_m = np.where(within, hits.distance, np.nan).astype(np.float32)
    return LidarReply(*returned, tuple(sorted(session.sizes_m())), surface_m, hits.facing)


class Hits:
    """What every beam of a sweep met."""

    def __init__(self, count: int) -> None:
        self.distance = np.full(count, np.nan)
        self.facing = np.zeros(count, np.float32)
        self.intensity = np.zeros(count, np.float32)
        self.lost = np.zeros(count, bool)
        self.classes = np.full(count, UNLABELLED, np.uint8)
        self.instances = np.zeros(count, np.uint16)


def _draw(session: Session, moment: Instant, rays: Floats, own: NDArray[np.int64], focal_px: float, hits: Hits) -> None:
    """Draw a slice of a sweep; ``rays`` f64[n, 3] in camera axes."""
    world_from_camera = moment.world_from_sensor @ geometry.from_rotation_translation(AXES, (0.0, 0.0, 0.0))
    for face in faces_of(rays, focal_px):
        seen, instances = session.pinhole(face.view(world_from_camera, moment.time_s), moment, instances=True)
        target = own[face.pixels]
        hits.distance[target], hits.facing[target] = face.surface(seen.depth.numpy())
        hits.intensity[target] = 0.5 * hits.facing[target]
        hits.classes[target] = nearest(seen.semantics.numpy(), face.uv)
        if instances is not None:
            hits.instances[target] = nearest(instances, face.uv)


def _meet(
    session: Session, known: LogReturns, moment: Instant, beams: Floats, own: NDArray[np.int64], hits: Hits
) -> None:
    """Let beams of a slice meet what the log's sweeps measured, unless they meet an object before it that no sweep
    measured."""
    poses = session.poses(moment)
    poses = known.poses(moment.time_s) | poses if moment.objects is None else poses
    met = known.meet(beams, moment.world_from_sensor, moment.time_s, poses)
    names = sorted(session.sizes_m())
    bare = np.array([False, *(name not in known.names for name in names)])
    with np.errstate(invalid="ignore"):
        before = bare[hits.instances[own]] & ~(hits.distance[own] >= met.range_m)
    seen = np.isfinite(met.range_m) & ~before
    chosen = own[seen]
    hits.distance[chosen], hits.facing[chosen] = met.range_m[seen], met.facing[seen]
    hits.intensity[chosen] = met.intensity[seen].clip(0, 1)
    hits.lost[chosen] = ~known.returns(beams, met)[seen]
    number = np.array([1 + names.index(name) if name in names else 0 for name in known.names], np.uint16)
    hits.instances[chosen] = number[met.nearest[seen]]
    other = own[np.isfinite(hits.distance[own]) & ~seen & (hits.instances[own] == 0)]
    ends = beams[np.searchsorted(own, other)] * hits.distance[other][:, None]
    places = geometry.transform_points(moment.world_from_sensor, ends)
    hits.distance[other[known.contradicts(places, moment.world_from_sensor, moment.time_s, poses)]] = np.nan


def _carried(points: NDArray[np.float32], share: Floats, start: Instant, end: Instant) -> NDArray[np.float32]:
    """Points f32[n, 3] in the frames of their moments, in that of the end."""
    carried = np.empty_like(points)
    end_from_world = geometry.invert(end.world_from_sensor)
    if len(np.unique(share)) > MOST_MOMENTS:  # beams that are fired one by one
        share = np.round(share * MOST_MOMENTS) / MOST_MOMENTS
    order = np.argsort(share, kind="stable")
    for own in np.split(order, np.flatnonzero(np.diff(share[order])) + 1) if len(order) else ():
        pose = geometry.interpolate_pose(start.world_from_sensor, end.world_from_sensor, float(share[own[0]]))
        carried[own] = geometry.transform_points(end_from_world @ pose, points[own])
    return carried


# -- sweeps of a whole log: ``mudg render --lidar`` ---
# OUT/lidar/<sensor>_recorded/, OUT/lidar/<sensor>_shift+3.0/   see ``scene/observations.py``


@dataclass(frozen=True, slots=True, eq=False)
class WantedSweeps:
    """What is to be written: the sensor whose mounting and times count, and a table of beams; None: its own beams."""

    sensor: str
    beams: BeamTable | None
    name: str


def wanted_sweeps(name: str, scene: Scene) -> WantedSweeps:
    """What ``--lidar`` asks for: a sensor of the scene, the name of a table, or a JSON file. UsageError: none of them,
    or a scene without sweeps. InputError: a malformed file."""
    sensors = list(dict.fromkeys(sweep.sensor for sweep in scene.sweeps))
    if not sensors:
        what, remedy = "the log has no LiDAR sweeps to take poses and times from", "leave --lidar out"
        raise UsageError(what, where="--lidar", got=name, remedy=remedy)
    if name in sensors:
        return WantedSweeps(name, None, name)
    if name in TABLES:
        return WantedSweeps(sensors[0], TABLES[name](), name)
    if name.endswith(".json"):
        return WantedSweeps(sensors[0], read_table(Path(name)), Path(name).stem)
    expected = f"a sensor of the scene ({', '.join(sensors)}), {', '.join(TABLES)}, or a JSON file of beams"
    raise UsageError("no such LiDAR", where="--lidar", expected=expected, got=name)


MountedLidar = tuple[WantedSweeps, BeamTable, NDArray[np.float64]]


def mounted(scene: Scene, lidar: str) -> MountedLidar:
    """A LiDAR by name: what is wanted, its beams, and vehicle-from-LiDAR f64[4, 4], of the first sweep of the sensor
    for which the log has a pose of the vehicle. UsageError: no such LiDAR, or no pose of the vehicle."""
    wanted = wanted_sweeps(lidar, scene)
    for sweep in (one for one in scene.sweeps if one.sensor == wanted.sensor):
        ego = scene.ego.pose_at(sweep.time_s)
        if ego is not None:
            beams = own_table(beams_of(scene, sweep)) if wanted.beams is None else wanted.beams
            return wanted, beams, geometry.invert(ego) @ sweep.world_from_lidar
    what = "a LiDAR needs the poses of the vehicle at its sweeps"
    raise UsageError(what, where="--lidar", got=f"none for {wanted.sensor}", remedy="leave --lidar out")


def simulate_log(config: RenderConfig, scene: Path, model: Path, script: EditScript | None, out: Path) -> list[str]:
    """``write_sweeps`` of a fitted scene on disk, edited if there is a script."""
    return write_sweeps(config, scene, Session(model, script, scene, config.device), out)


def write_sweeps(config: RenderConfig, scene: Path, session: Session, out: Path) -> list[str]:
    """Simulate every sweep of the log ``scene`` at every shift; returns names of the trajectories. Sweeps that an
    interrupted run wrote are kept."""
    loaded = read_scene(scene)
    wanted = wanted_sweeps(config.lidar, loaded)
    sweeps = [sweep for sweep in loaded.sweeps if sweep.sensor == wanted.sensor]
    names = []
    with log.task("render LiDAR", len(sweeps) * len(config.shifts_m)) as bar:
        for shift_m in config.shifts_m:
            name = trajectory_name(wanted.name, shift_m or None)
            folder, records = out / "lidar" / name, []
            for number, sweep in enumerate(sweeps):
                beams, start, end = _place(loaded, sweep, shift_m, wanted.beams)
                file = folder / f"{number:06d}.safetensors"
                if not file.is_file():
                    reply = session.render([LidarRequest(beams=beams, start=start, end=end, like=wanted.sensor)])[0]
                    store.write_safetensors(file, reply.arrays(beams))
                poses = (start.world_from_sensor, end.world_from_sensor, start.time_s, end.time_s)
                records.append(SimulatedSweep(sweep.id, wanted.beams is None, *poses, file.name))
                bar.advance()
            if not (folder / SWEEPS_INDEX).is_file():
                write_index(SweepSet(folder, name, wanted.sensor, shift_m, tuple(records)))
            names.append(name)
    return names


def _place(scene: Scene, sweep: Sweep, shift_m: float, table: BeamTable | None) -> tuple[BeamTable, Instant, Instant]:
    """Beams, start and end of a sweep that is taken where a recorded one was, moved to the left."""
    own, moved = beams_of(scene, sweep), np.zeros(3)
    if shift_m:
        first, last = float(scene.ego.times_s[0]), float(scene.ego.times_s[-1])
        ego = scene.ego.pose_at(min(max(sweep.time_s, first), last))
        moved = shift_m * ego_left_world(sweep.world_from_lidar if ego is None else ego)
    start, end = own.start.copy(), own.end.copy()
    start[:3, 3] += moved
    end[:3, 3] += moved
    return own_table(own) if table is None else table, Instant(own.start_s, start), Instant(own.end_s, end)


def own_table(beams: Beams) -> BeamTable:
    """The beams of a recorded sweep, those that returned nothing included."""
    full, reach = with_silent(beams), float(beams.range_m.max(initial=100.0))
    return BeamTable(full.directions, np.zeros(len(full), np.uint16), full.share, (0.0, 1.05 * reach))
