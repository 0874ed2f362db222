"""What a log's own sweeps tell a simulated LiDAR: where surfaces are, how bright they return, and which beams are lost.
Every rigid part of the world is met in the sweeps that were taken nearest to it in place and time (``scene/beams.py``),
then in others; held-out frames are left out. Lost beams are part of the cloud (``core/returns.py``)."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from mudg.base import geometry, log
from mudg.base.errors import UsageError
from mudg.base.types import Scene, Sweep
from mudg.core.returns import Met, Returns, Rows, first_surface
from mudg.editing.apply import spread
from mudg.scene.beams import WORLD, Beams, beams_of, moving_tracks, placed, returns_of, training_sweeps, with_silent

Floats = NDArray[np.float64]
Gone = Callable[[Floats], NDArray[np.bool_]]
"""Which places f64[N, 3] an edit took away."""
Chosen = tuple[int, Sweep, float]
"""Number of a part of the world, a sweep that measured it, and how much its returns count."""
NEAREST: Final = 8
"""Sweeps of a part that beams meet at once."""
TRUST: Final = 0.7
"""A return counts this share of one of the sweep that was taken next nearer."""
AGE_M_S: Final = 1.0
"""A second between sweeps is worth so many metres."""
MOST_LOOKS: Final = 8
"""Sweeps that tell where the sensor looks."""
CELL_DEG: Final = np.array([5.0, 2.0])
"""Azimuth and elevation of the directions that are told apart."""
FEW: Final = 0.2
"""Beams that say nothing."""
MOST_TESTED: Final = 2
"""Sweeps that the regression learns from."""
SECTORS: Final = 8
"""Parts of a sweep whose beams and returns are looked at together."""
MARGIN_RAD: Final = 0.03
ROUNDS: Final = 12
DAMPING: Final = 1e-3
CERTAIN: Final = 1e-6
HIDDEN_SHARE: Final = 0.95
"""A surface is hidden from a station that meets another one nearer than this share of its distance."""
GONE_M: Final = 0.3
"""A return belongs to the background that an edit took away if the nearest Gaussian, at most this far, is gone."""


class Looks:
    """Where a sensor looks, and where it loses beams whatever is there, as behind the vehicle's own body. ``sweeps``:
    beams of some of its sweeps."""

    def __init__(self, sweeps: Sequence[Beams]) -> None:
        shape = tuple((np.array([360, 180]) / CELL_DEG).astype(int))
        counts = np.zeros((2, *shape))
        for beams in sweeps:
            for kind, own in enumerate((beams.returned, ~beams.returned)):
                np.add.at(counts[kind], self._cells(beams.directions[own]), 1)
        self._odds = np.log((counts[1] + 1) / (counts[0] + 1)).clip(0)
        self._azimuths, levels = (counts[0].sum(axis) > 0 for axis in (1, 0))
        self._levels = np.logical_or.accumulate(levels) & np.logical_or.accumulate(levels[::-1])[::-1]

    @staticmethod
    def _cells(directions: Floats) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        x, y, z = directions.T
        angles = np.degrees([np.arctan2(y, x), np.arcsin(z.clip(-1, 1))]) + [[180.0], [90.0]]
        azimuth, elevation = np.floor(angles * 0.999999 / CELL_DEG[:, None]).astype(np.int64)
        return azimuth, elevation

    def hold(self, directions: Floats) -> NDArray[np.bool_]:
        """Which directions f64[N, 3] it looks in."""
        azimuth, elevation = self._cells(directions)
        return self._azimuths[azimuth] & self._levels[elevation]

    def loss(self, directions: Floats) -> Floats:
        """Log-odds f64[N] that a beam is lost; 0 where most return."""
        return self._odds[self._cells(directions)]


class LogReturns:
    """What the sweeps of a log's sensor tell. They are read when they are asked for. ``scene``: the log. ``sweeps``: of
    the sensor, that may be learnt from. ``gone``: what an edit took away of the world."""

    def __init__(self, scene: Scene, sweeps: Sequence[Sweep], gone: Gone | None = None) -> None:
        self._scene, self.sweeps, self._gone = scene, tuple(sweeps), gone
        self._tracks = {track.id: track for track in moving_tracks(scene)}
        self.names = (WORLD, *self._tracks)
        self._times_s = np.array([sweep.time_s for sweep in sweeps])
        self._stations = np.stack([sweep.world_from_lidar for sweep in sweeps])
        self._read: dict[str, tuple[Beams, dict[str, Returns]]] = {}
        self._rows: Rows | None = None
        self._seen_from: dict[str, Floats] = {}
        tested = spread(self.sweeps[1:-1], MOST_TESTED) if len(sweeps) >= 4 else ()
        others = [sweep for sweep in self.sweeps if sweep not in tested]
        self.looks = Looks([self.measured(sweep)[0] for sweep in spread(others, MOST_LOOKS)])
        self.weights = _regression(*_samples(tested, self)) if tested else None
        """Of ``features``; None: too little to learn from, and a beam returns where it meets something."""

    def measured(self, sweep: Sweep) -> tuple[Beams, dict[str, Returns]]:
        """Beams of a sweep, and by name of the part its returns and lost beams."""
        if sweep.id not in self._read:
            beams = beams_of(self._scene, sweep)
            self._rows = self._rows or Rows.of(beams.directions * beams.range_m[:, None])
            beams = with_silent(beams, self._rows)
            parts = returns_of(self._scene, sweep, beams)
            if self._gone is not None:
                parts[WORLD] = parts[WORLD].taken(~self._gone(parts[WORLD].xyz))
            self._read[sweep.id] = beams, parts
        return self._read[sweep.id]

    def poses(self, time_s: float) -> dict[str, Floats]:
        """Poses of all objects at a time."""
        poses = {name: track.pose_at(time_s) for name, track in self._tracks.items()}
        return {name: pose for name, pose in poses.items() if pose is not None}

    def meet(
        self, beams: Floats, station: Floats, time_s: float, poses: Mapping[str, Floats], without: Sweep | None = None
    ) -> Met:
        """What beams f64[B, 3] of the sensor meet; ``nearest`` numbers ``names``, -1: nothing. ``station``:
        world-from-sensor f64[4, 4]. ``poses``: world-from-box of the objects. ``without``: a sweep not to meet."""
        near, far = self._nearest(station, time_s, poses, without)
        met = self._meet(near, beams, station, poses)
        rest = np.flatnonzero(np.isnan(met.range_m))
        if len(rest):
            met.put(rest, self._meet(far, beams[rest], station, poses))
        return met

    def _nearest(
        self, station: Floats, time_s: float, poses: Mapping[str, Floats], without: Sweep | None
    ) -> tuple[list[Chosen], list[Chosen]]:
        """Per part of the world the sweeps taken nearest to a station, seen from that part; others, evenly chosen."""
        near, far = list[Chosen](), list[Chosen]()
        for number, name in enumerate(self.names):
            if name == WORLD or name in poses:
                place = station[:3, 3] if name == WORLD else (geometry.invert(poses[name]) @ station)[:3, 3]
                apart = np.linalg.norm(self._places(name) - place, axis=1) + AGE_M_S * np.abs(self._times_s - time_s)
                order = (k for k in np.argsort(apart, kind="stable") if np.isfinite(apart[k]))
                sweeps = [self.sweeps[k] for k in order if self.sweeps[k] is not without]
                near += [(number, sweep, TRUST**k) for k, sweep in enumerate(sweeps[:NEAREST])]
                far += [(number, sweep, 1.0) for sweep in spread(sweeps[NEAREST:], NEAREST)]
        return near, far

    def _places(self, name: str) -> Floats:
        """Where the sensor was at its sweeps f64[S, 3], in the frame of a part; NaN: that was not there."""
        if name == WORLD:
            return self._stations[:, :3, 3]
        if name not in self._seen_from:
            poses = (self._tracks[name].pose_at(time_s) for time_s in self._times_s)
            seen = [
                np.full(4, np.nan) if a is None else geometry.invert(a) @ b[:, 3]
                for a, b in zip(poses, self._stations, strict=True)
            ]
            self._seen_from[name] = np.stack(seen)[:, :3]
        return self._seen_from[name]

    def _meet(self, chosen: Sequence[Chosen], beams: Floats, station: Floats, poses: Mapping[str, Floats]) -> Met:
        """What beams meet in parts of sweeps."""
        met, owner, trust, parts = Met.nothing(len(beams)), list[int](), list[float](), list[tuple[str, Returns]]()
        for number, sweep, share in chosen:
            name = self.names[number]
            if (part := self.measured(sweep)[1].get(name)) is not None:
                owner, trust, parts = [*owner, number], [*trust, share], [*parts, (name, part)]
        if not parts:
            return met
        sizes = [len(part) for _, part in parts]
        owners, trusts = np.repeat(owner, sizes), np.repeat(trust, sizes)
        intensity = np.concatenate([part.intensity for _, part in parts])
        xyz, numbers = placed(parts, poses, station[:3, 3])
        local = xyz @ station[:3, :3]
        aside = np.hypot(local[:, 0], local[:, 1]) * np.cos(np.pi / SECTORS + MARGIN_RAD)
        around = np.arctan2(beams[:, 1], beams[:, 0]) / (2 * np.pi) + 0.5
        sector = np.floor(around * SECTORS).astype(np.int64).clip(0, SECTORS - 1)
        for k in np.unique(sector):
            own, middle = np.flatnonzero(sector == k), (k + 0.5) / SECTORS * 2 * np.pi - np.pi
            near = np.flatnonzero(np.cos(middle) * local[:, 0] + np.sin(middle) * local[:, 1] >= aside)
            rows = numbers[near]
            part = first_surface(beams[own], local[near], intensity[rows], trusts[rows])
            part.nearest[:] = np.where(part.nearest >= 0, np.append(owners[rows], -1)[part.nearest], -1)
            met.put(own, part)
        return met

    def features(self, beams: Floats, met: Met) -> Floats:
        """What decides whether a beam returns, f64[B, 8]: 1, log-odds of the loss around, and in its direction of the
        sensor, range / 100 m, incidence, how far the nearest return is for the spacing, the spacing (log, units of
        0.2 degrees), one-sidedness."""
        loss, direction = np.log((met.lost + FEW) / (met.heard + FEW)), self.looks.loss(beams)
        with np.errstate(invalid="ignore", divide="ignore"):
            near = np.where(np.isfinite(met.spacing_rad), met.nearest_rad / met.spacing_rad, 1.0)
            spacing = np.log(np.where(np.isfinite(met.spacing_rad), met.spacing_rad, 0.01) / np.radians(0.2))
        columns = (np.ones(len(loss)), loss, direction, met.range_m / 100, met.facing, near, spacing, met.one_sided)
        return np.nan_to_num(np.stack(columns, 1))

    def returns(self, beams: Floats, met: Met) -> NDArray[np.bool_]:
        """Which beams return: by a logistic regression of `features`, learnt from sweeps met without themselves."""
        seen = np.isfinite(met.range_m)
        return seen if self.weights is None else seen & (self.features(beams, met) @ self.weights > 0)

    def contradicts(
        self, places: Floats, world_from_sensor: Floats, time_s: float, poses: Mapping[str, Floats]
    ) -> NDArray[np.bool_]:
        """Which surfaces at places f64[N, 3] in the world cannot be there: the recorded sensor nearest to the simulated
        one had them in its field and met nothing before them."""
        if not len(places):
            return np.zeros(0, bool)
        apart = np.linalg.norm(self._stations[:, :3, 3] - world_from_sensor[:3, 3], axis=1)
        station = self._stations[apart.argmin()]
        local = geometry.transform_points(geometry.invert(station), places)
        away = np.maximum(np.linalg.norm(local, axis=1), 1e-6)
        met = self.meet(local / away[:, None], station, time_s, poses)
        hidden = np.isfinite(met.range_m) & (met.range_m < HIDDEN_SHARE * away)
        return ~hidden & self.looks.hold(local / away[:, None])


def learn_returns(scene: Scene, sensor: str = "", gone: Gone | None = None) -> LogReturns | None:
    """What the sweeps of a log's sensor tell, those of held-out frames left out; None without sweeps. The same log
    gives the same numbers. ``sensor``: empty: the log's first. Others lie centimetres beside it, and their intensity
    means something else. ``gone``: what an edit took away of the world. UsageError: the log has no such sensor."""
    known = list(dict.fromkeys(sweep.sensor for sweep in scene.sweeps))
    if sensor and sensor not in known:
        raise UsageError("the log has no such LiDAR", expected=", ".join(known) or "none", got=sensor[:80])
    sweeps = tuple(sweep for sweep in training_sweeps(scene) if sweep.sensor == (sensor or known[0]))
    if not sweeps:
        return None
    log.info(f"LiDAR: surfaces, intensity and lost beams from {len(sweeps)} sweeps of {sweeps[0].sensor}")
    return LogReturns(scene, sweeps, gone)


def _samples(sweeps: Sequence[Sweep], returns: LogReturns) -> tuple[Floats, NDArray[np.bool_]]:
    """Features of the beams of sweeps, met in the others, and which returned."""
    rows, answers = list[Floats](), list[NDArray[np.bool_]]()
    for sweep in sweeps:
        beams = returns.measured(sweep)[0]
        for share, own in beams.parts(SECTORS):
            time_s, directions = beams.time_s(share), beams.directions[own]
            met = returns.meet(directions, beams.pose(share), time_s, returns.poses(time_s), sweep)
            seen = np.isfinite(met.range_m)
            rows.append(returns.features(directions, met)[seen])
            answers.append(beams.returned[own][seen])
    return np.concatenate(rows), np.concatenate(answers)


def _regression(features: Floats, answers: NDArray[np.bool_]) -> Floats | None:
    """Weights of the logistic regression by Newton's method, slightly held towards 0; None where all beams returned or
    none."""
    if not 0 < answers.sum() < len(answers):
        return None
    weights, held = np.zeros(features.shape[1]), DAMPING * len(answers) * np.eye(features.shape[1])
    for _ in range(ROUNDS):
        odds = 1 / (1 + np.exp(-(features @ weights).clip(-30, 30)))
        slope = features.T @ (answers - odds) - held @ weights
        curve = (features * (odds * (1 - odds) + CERTAIN)[:, None]).T @ features + held
        weights = weights + np.linalg.solve(curve, slope)
    return weights


def places_gone(before: Floats, after: Floats) -> Gone | None:
    """Which places f64[N, 3] belong to what an edit took out of the background; None: it took nothing. ``before``,
    ``after``: places of the background's Gaussians f64[N, 3]."""
    rows = lambda block: np.ascontiguousarray(block).view([("", block.dtype)] * 3).reshape(-1)
    gone = ~np.isin(rows(before), rows(after))
    if not gone.any():
        return None
    tree = KDTree(before)

    def chosen(places: Floats) -> NDArray[np.bool_]:
        away, nearest = tree.query(places, workers=-1)
        return (away <= GONE_M) & gone[nearest]

    return chosen
