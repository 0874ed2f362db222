"""``mudg render --lidar``: simulated sweeps on the recorded path and beside it.

OUT/lidar/<sensor>_recorded/, OUT/lidar/<sensor>_shift+3.0/   see ``scene/sweep_sets.py``
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mudg.base import geometry, log, store
from mudg.base.errors import UsageError
from mudg.base.types import Scene, Sweep
from mudg.core.trajectory import ego_left_world, trajectory_name
from mudg.editing.script import EditScript
from mudg.editing.settings import RenderConfig
from mudg.scene.beams import Beams, beams_of, with_silent
from mudg.scene.read import read_scene
from mudg.scene.sweep_sets import INDEX, SimulatedSweep, SweepSet, write_index
from mudg.sim.lidar import BeamTable, LidarReply, LidarRequest
from mudg.sim.session import Instant, Session
from mudg.sim.tables import TABLES, read_table

Place = tuple[BeamTable, Instant, Instant]


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
                start, end = (_without(session, moment, config.remove_tracks) for moment in (start, end))
                file = folder / f"{number:06d}.safetensors"
                if not file.is_file():
                    reply = session.render([LidarRequest(beams=beams, start=start, end=end, like=wanted.sensor)])[0]
                    store.write_safetensors(file, _arrays(beams, reply))
                poses = (start.world_from_sensor, end.world_from_sensor, start.time_s, end.time_s)
                records.append(SimulatedSweep(sweep.id, wanted.beams is None, *poses, file.name))
                bar.advance()
            if not (folder / INDEX).is_file():
                write_index(SweepSet(folder, name, wanted.sensor, shift_m, tuple(records)))
            names.append(name)
    return names


def _without(session: Session, moment: Instant, removed: tuple[str, ...]) -> Instant:
    """A moment without some objects."""
    if not removed:
        return moment
    objects = {name: pose for name, pose in session.objects(moment.time_s).items() if name not in removed}
    return Instant(moment.time_s, moment.world_from_sensor, objects)


def _place(scene: Scene, sweep: Sweep, shift_m: float, table: BeamTable | None) -> Place:
    """Beams, start and end of a sweep that is taken where a recorded one was, moved to the left."""
    own = beams_of(scene, sweep)
    moved = np.zeros(3)
    if shift_m:
        first, last = float(scene.ego.times_s[0]), float(scene.ego.times_s[-1])
        ego = scene.ego.pose_at(min(max(sweep.time_s, first), last))
        moved = shift_m * ego_left_world(sweep.world_from_lidar if ego is None else ego)
    poses = [pose.copy() for pose in (own.start, own.end)]
    for pose in poses:
        pose[:3, 3] += moved
    table = own_table(own) if table is None else table
    return table, Instant(own.start_s, poses[0]), Instant(own.end_s, poses[1])


def own_table(beams: Beams) -> BeamTable:
    """The beams of a recorded sweep, those that returned nothing included."""
    full, reach = with_silent(beams), float(beams.range_m.max(initial=100.0))
    return BeamTable(full.directions, np.zeros(len(full), np.uint16), full.share, (0.0, 1.05 * reach))


def _arrays(beams: BeamTable, reply: LidarReply) -> dict[str, Any]:
    return {
        "xyz": reply.xyz,
        "intensity": reply.intensity.astype(np.float32),
        "dt_s": reply.dt_s,
        "classes": reply.classes,
        "ring": reply.ring,
        "beam": reply.beam.astype(np.int64),
        "directions": beams.directions.astype(np.float32),
        "share": beams.share.astype(np.float32),
        "range_m": reply.surface_m,
        "facing": reply.facing,
    }
