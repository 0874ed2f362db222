"""Simulated LiDAR sweeps against recorded and exact ones.

Truth is the range of every beam: on the recorded path, of the beams that the held-out sweep fired; in a generated city
beside it, exact and without noise. Rows besides the methods, all without the held-out sweeps:

* ``constant``: a method's surfaces with the rules that need no learning: every beam that meets something returns, and
  intensity is half the cosine of incidence.
* ``nearest``: the nearest recorded sweep, moved by poses and boxes.
* ``fused``: the sweeps around it, moved likewise, projected into the beams, the first surface kept.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from mudg.base.errors import InputError
from mudg.base.types import Scene, Sweep
from mudg.city.world import CityWorld
from mudg.scene.beams import Beams, beams_of, held_out, moving_tracks, placed, returns_of, training_sweeps, with_silent
from mudg.scene.observations import SimulatedSweep, SweepSet, read_sweep_sets

Floats = NDArray[np.float64]
MATCH_RAD: Final = float(np.radians(0.4))
"""A moved point answers a beam within this angle."""
SLICES: Final = 8
FUSED: Final = 8
"""Sweeps that are fused, the nearest in time."""
CANDIDATES: Final = 12
SAME_SURFACE: Final = 0.03
SAME_SURFACE_M: Final = 0.1
CONSTANT_INTENSITY: Final = 0.5


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
    others, rows = OtherSweeps(scene), list[dict[str, Any]]()
    trajectories = {name: one for found in sets.values() for name, one in found.items()}
    for trajectory, example in sorted(trajectories.items(), key=lambda item: (item[1].shift_m, item[0])):
        sums, count = defaultdict[str, SweepScores](SweepScores), 0
        for number, method in enumerate(name for name, found in sets.items() if trajectory in found):
            one = sets[method][trajectory]
            for sweep, beams, true in _judged(scene, world, one):
                arrays, returned = one.arrays(sweep), Measured(*np.full((2, len(beams)), np.nan))
                beam = arrays["beam"]
                returned.range_m[beam], returned.intensity[beam] = arrays["range_m"][beam], arrays["intensity"]
                plain = Measured(arrays["range_m"].astype(np.float64), CONSTANT_INTENSITY * arrays["facing"])
                rows_of = {method: returned, f"{method}: constant": plain}
                if number == 0:
                    count += 1
                    rows_of |= others.answers(example.sensor, beams)
                for name, made in rows_of.items():
                    sums[name].add(beams.directions, made, true)
        order = sorted(sums, key=lambda name: name in ("nearest", "fused"))
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
            yield sweep, beams, _exact(world, beams)


def _exact(world: CityWorld, beams: Beams) -> Measured:
    """What the beams meet in a generated city."""
    places, directions = np.zeros((len(beams), 3)), np.zeros((len(beams), 3))
    for share in np.unique(beams.share):
        own, pose = np.flatnonzero(beams.share == share), beams.pose(float(share))
        places[own], directions[own] = pose[:3, 3], beams.directions[own] @ pose[:3, :3].T
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    return Measured(*world.ranges(places, directions, beams.start_s + beams.share * (beams.end_s - beams.start_s)))


# other sweeps, moved ------------------------------------------------------------------------------


class OtherSweeps:
    """Recorded sweeps that answer for others: the nearest one, and several fused."""

    def __init__(self, scene: Scene) -> None:
        self._scene = scene
        self._tracks = {track.id: track for track in moving_tracks(scene)}
        self._sweeps = training_sweeps(scene)

    def answers(self, sensor: str, beams: Beams) -> dict[str, Measured]:
        """By name of the row. A sweep at the beams' own time does not answer."""
        middle = beams.time_s(0.5)
        own = [sweep for sweep in self._sweeps if sweep.sensor == sensor]
        near = sorted(own, key=lambda sweep: (abs(sweep.time_s - middle), sweep.time_s))
        near = [sweep for sweep in near if abs(sweep.time_s - middle) > 1e-3]
        return {"nearest": self._answer(near[:1], beams, 1), "fused": self._answer(near[:FUSED], beams, CANDIDATES)}

    def _answer(self, sweeps: Sequence[Sweep], beams: Beams, candidates: int) -> Measured:
        parts = [own for sweep in sweeps for own in returns_of(self._scene, sweep).items()]
        intensity = np.concatenate([*(part.intensity for _, part in parts), np.zeros(0)])
        found = Measured(np.full(len(beams), np.nan), np.full(len(beams), np.nan))
        for share, own in beams.parts(SLICES):
            pose, poses = beams.pose(share), {}
            for name, track in self._tracks.items():
                at = track.pose_at(beams.time_s(share))
                if at is not None:
                    poses[name] = at
            xyz, numbers = placed(parts, poses, pose[:3, 3])
            local = np.stack([xyz[:, 0] * a + xyz[:, 1] * b + xyz[:, 2] * c for a, b, c in pose[:3, :3].T], 1)
            row = first_points(beams.directions[own], local, candidates)
            hit = row >= 0
            found.range_m[own[hit]] = np.linalg.norm(local[row[hit]], axis=1)
            found.intensity[own[hit]] = intensity[numbers[row[hit]]]
        return found


def first_points(beams: Floats, xyz: Floats, candidates: int) -> NDArray[np.int64]:
    """The point that answers each beam, i64[B]; -1: none is near. Of ``candidates`` points around a beam those of the
    first surface count, and of them the one that is nearest in angle."""
    if not len(xyz) or not len(beams):
        return np.full(len(beams), -1)
    away = np.linalg.norm(xyz, axis=1)
    count = min(candidates, len(xyz))
    found = KDTree(xyz / away[:, None]).query(beams, count, distance_upper_bound=MATCH_RAD, workers=-1)
    gaps, rows = (np.asarray(block).reshape(len(beams), count) for block in found)
    known = np.isfinite(gaps)
    depth = np.where(known, away[np.where(known, rows, 0)], np.inf)
    first = depth.min(1)
    with np.errstate(invalid="ignore"):
        front = known & (depth <= (first * (1 + SAME_SURFACE) + SAME_SURFACE_M)[:, None])
    best = np.where(front, gaps, np.inf).argmin(1)
    at = np.arange(len(beams))
    return np.where(front[at, best], rows[at, best], -1).astype(np.int64)
