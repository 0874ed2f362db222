"""Simulated LiDAR sweeps against recorded and exact ones. Truth is the range of every beam: on the recorded path, of
the beams that the held-out sweep fired; in a generated city beside it, exact and without noise. The row ``nearest`` is
the nearest recorded sweep that was not held out, moved by poses and boxes."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from mudg.base.errors import InputError
from mudg.base.types import Scene
from mudg.city.world import CityWorld
from mudg.scene.beams import Beams, beams_of, held_out, moving_tracks, placed, returns_of, training_sweeps, with_silent
from mudg.scene.observations import SimulatedSweep, SweepSet, read_sweep_sets

Floats = NDArray[np.float64]
MATCH_RAD: Final = float(np.radians(0.4))
"""A moved point answers a beam within this angle."""
SLICES: Final = 8
NEAREST: Final = "nearest"


@dataclass(frozen=True, slots=True, eq=False)
class Measured:
    """Range and intensity of all beams of a sweep, f64[B]; NaN: nothing returned."""

    range_m: Floats
    intensity: Floats


class SweepScores:
    """Sums of one row of the table."""

    def __init__(self) -> None:
        self._range: list[Floats] = []
        self._intensity: list[Floats] = []
        self._chamfer: list[float] = []
        self._counts = np.zeros(3)

    def add(self, directions: Floats, simulated: Measured, true: Measured) -> None:
        """Add a sweep."""
        here, there = np.isfinite(simulated.range_m), np.isfinite(true.range_m)
        both = here & there
        self._counts += (both.sum(), here.sum(), there.sum())
        self._range.append(np.abs(simulated.range_m - true.range_m)[both])
        difference = np.abs(simulated.intensity - true.intensity)[both]
        self._intensity.append(difference[np.isfinite(difference)])
        if here.any() and there.any():
            a, b = (directions[own] * one.range_m[own, None] for own, one in ((here, simulated), (there, true)))
            ways = (KDTree(y).query(x, workers=-1)[0].mean() for x, y in ((a, b), (b, a)))
            self._chamfer.append(float(np.mean(list(ways))))

    def values(self) -> dict[str, float | None]:
        """The numbers; None where nothing was measured."""
        both, here, there = self._counts
        mean = lambda values: float(np.mean(values)) if len(values) else None
        errors = np.concatenate([*self._range, np.zeros(0)])
        return {
            "median_range_m": float(np.median(errors)) if len(errors) else None,
            "chamfer_m": mean(self._chamfer),
            "f1": float(2 * both / (here + there)) if here + there else None,
            "intensity": mean(np.concatenate([*self._intensity, np.zeros(0)])),
        }


def sweep_scores(scene: Scene, methods: Mapping[str, Path]) -> list[dict[str, Any]]:
    """Rows of all simulated sweeps that the methods' folders hold: method, trajectory, shift and numbers; empty where
    there are none."""
    sets = {name: found for name, folder in methods.items() if (found := read_sweep_sets(folder))}
    if not sets:
        return []
    world = None if scene.source.recipe is None else CityWorld.from_source(scene.source)
    nearest, rows = NearestSweep(scene), list[dict[str, Any]]()
    trajectories = {name: one for found in sets.values() for name, one in found.items()}
    for trajectory, example in sorted(trajectories.items(), key=lambda item: (item[1].shift_m, item[0])):
        sums, count = defaultdict[str, SweepScores](SweepScores), 0
        for number, method in enumerate(name for name, found in sets.items() if trajectory in found):
            one = sets[method][trajectory]
            for sweep, beams, true in _judged(scene, world, one):
                arrays, returned = one.arrays(sweep), Measured(*np.full((2, len(beams)), np.nan))
                beam = arrays["beam"]
                returned.range_m[beam], returned.intensity[beam] = arrays["range_m"][beam], arrays["intensity"]
                sums[method].add(beams.directions, returned, true)
                if number == 0:
                    count += 1
                    sums[NEAREST].add(beams.directions, nearest.answer(example.sensor, beams), true)
        order = sorted(sums, key=lambda name: name == NEAREST)
        head = {"trajectory": trajectory, "shift_m": example.shift_m, "sweeps": count}
        rows += [{"method": name, **head, "values": sums[name].values()} for name in order]
    return rows


def _judged(
    scene: Scene, world: CityWorld | None, sweeps: SweepSet
) -> Iterator[tuple[SimulatedSweep, Beams, Measured]]:
    """The sweeps of a set that there is truth for."""
    recorded, counted = {sweep.id: sweep for sweep in scene.sweeps}, held_out(scene)
    for sweep in sweeps.sweeps:
        if sweep.id not in counted and (counted or sweeps.shift_m == 0):
            continue
        arrays = sweeps.arrays(sweep)
        nan = np.full(len(arrays["share"]), np.nan)
        times = (sweep.start_s, sweep.end_s)
        directions, share = arrays["directions"].astype(np.float64), arrays["share"].astype(np.float64)
        beams = Beams(directions, share, nan, nan, sweep.start, sweep.end, *times)
        if sweeps.shift_m == 0 and sweep.own_beams and sweep.id in recorded:
            true = with_silent(beams_of(scene, recorded[sweep.id]))
            if len(true) != len(beams):
                what, where = "a simulated sweep has other beams than the recorded one", str(sweeps.folder / sweep.file)
                remedy = "render it again with this version"
                raise InputError(what, where=where, expected=str(len(true)), got=str(len(beams)), remedy=remedy)
            yield sweep, beams, Measured(true.range_m, true.intensity)
        elif world is not None:
            places, directions = np.zeros((len(beams), 3)), np.zeros((len(beams), 3))
            for moment in np.unique(share):
                own, pose = np.flatnonzero(share == moment), beams.pose(float(moment))
                places[own], directions[own] = pose[:3, 3], beams.directions[own] @ pose[:3, :3].T
            directions /= np.linalg.norm(directions, axis=1, keepdims=True)
            fired_s = sweep.start_s + share * (sweep.end_s - sweep.start_s)
            yield sweep, beams, Measured(*world.ranges(places, directions, fired_s))


class NearestSweep:
    """The recorded sweep that answers for others: the nearest in time, moved."""

    def __init__(self, scene: Scene) -> None:
        self._scene = scene
        self._tracks = {track.id: track for track in moving_tracks(scene)}
        self._sweeps = training_sweeps(scene)

    def answer(self, sensor: str, beams: Beams) -> Measured:
        """What it measures along beams. A sweep at the beams' own time does not answer."""
        middle = beams.time_s(0.5)
        others = [s for s in self._sweeps if s.sensor == sensor and abs(s.time_s - middle) > 1e-3]
        near = sorted(others, key=lambda sweep: (abs(sweep.time_s - middle), sweep.time_s))
        parts = [own for sweep in near[:1] for own in returns_of(self._scene, sweep).items()]
        intensity = np.concatenate([*(part.intensity for _, part in parts), np.zeros(0)])
        found = Measured(np.full(len(beams), np.nan), np.full(len(beams), np.nan))
        for share, own in beams.parts(SLICES):
            pose, poses = beams.pose(share), {}
            for name, track in self._tracks.items():
                if (at := track.pose_at(beams.time_s(share))) is not None:
                    poses[name] = at
            xyz, numbers = placed(parts, poses, pose[:3, 3])
            local = np.stack([xyz[:, 0] * a + xyz[:, 1] * b + xyz[:, 2] * c for a, b, c in pose[:3, :3].T], 1)
            row = nearest_points(beams.directions[own], local)
            hit = row >= 0
            found.range_m[own[hit]] = np.linalg.norm(local[row[hit]], axis=1)
            found.intensity[own[hit]] = intensity[numbers[row[hit]]]
        return found


def nearest_points(beams: Floats, xyz: Floats) -> NDArray[np.int64]:
    """The point that answers each beam, the nearest in angle, i64[B]; -1: none is near."""
    if not len(xyz) or not len(beams):
        return np.full(len(beams), -1)
    units = xyz / np.linalg.norm(xyz, axis=1)[:, None]
    gaps, rows = KDTree(units).query(beams, distance_upper_bound=MATCH_RAD, workers=-1)
    return np.where(np.isfinite(gaps), rows, -1).astype(np.int64)
