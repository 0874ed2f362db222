"""What a log's own sweeps tell a simulated LiDAR: where surfaces are, how bright they return, and which beams are lost.

The returns of all sweeps but those of held-out frames are one cloud per rigid part of the world (``scene/beams.py``).
A beam meets the first surface of that cloud (``core/returns.py``). Each return has two learnt columns beside its place:
the intensity measured there, and how many beams were lost there; a beam has their weighted means. Whether it returns
is a logistic regression of the loss, range, incidence, and how well the returns around it cover it, learnt from sweeps
whose returns are not in the cloud. Where the log measured nothing, the Gaussians answer (``sim/lidar.py``).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from mudg.base import geometry, log
from mudg.base.errors import UsageError
from mudg.base.types import Scene, Sweep
from mudg.core.returns import Met, Returns, first_surface
from mudg.core.rows import Rows
from mudg.scene.beams import WORLD, Beams, beams_of, moving_tracks, placed, returns_of, training_sweeps, with_silent

Floats = NDArray[np.float64]
Gone = Callable[[Floats], NDArray[np.bool_]]
Trusted = tuple[int, Sweep, float]
MOST_LOOKS: Final = 8
"""Sweeps that tell where the sensor looks and where it is blind."""
NEAREST: Final = 8
"""Sweeps that beams meet at once."""
HALF: Final = 0.7
AGE_M_S: Final = 1.0
FEW: Final = 0.2
MOST_TESTED: Final = 2
"""Sweeps that the regression learns from."""
SECTORS: Final = 8
"""Parts of a sweep whose beams and returns are looked at together."""
MARGIN_RAD: Final = 0.03
ROUNDS: Final = 12
DAMPING: Final = 1e-3
CERTAIN: Final = 1e-6
THROUGH_M: Final = 0.3
"""A beam goes through a surface if it ends this far, and 5 %, behind it."""
UNDECIDED: Final = 0.2
"""Weight of beams that says nothing."""
HIDDEN_SHARE: Final = 0.95
"""A surface is hidden from a station that meets another one nearer than this share of its distance."""
GONE_M: Final = 0.3
"""A return belongs to the background that an edit took away if the nearest Gaussian, at most this far, is gone."""


@dataclass(frozen=True, slots=True, eq=False)
class FieldOfView:
    """Where a sensor looks: sines of its lowest and highest elevation, and which degrees of azimuth bool[360]."""

    low: float
    high: float
    azimuths: NDArray[np.bool_]

    @classmethod
    def of(cls, directions: Floats) -> FieldOfView:
        """Where it has returns, directions f64[N, 3]."""
        azimuths = np.bincount(cls._degree(directions), minlength=360) > 0
        return cls(float(directions[:, 2].min(initial=1.0)), float(directions[:, 2].max(initial=-1.0)), azimuths)

    @staticmethod
    def _degree(directions: Floats) -> NDArray[np.int64]:
        return np.floor(np.degrees(np.arctan2(directions[:, 1], directions[:, 0]))).astype(np.int64) % 360

    def holds(self, directions: Floats) -> NDArray[np.bool_]:
        """Which directions f64[N, 3] it looks in."""
        level = (directions[:, 2] >= self.low) & (directions[:, 2] <= self.high)
        return level & self.azimuths[self._degree(directions)]


class Blind:
    """Where a sensor loses beams whatever is there, as behind the vehicle's own body: log-odds by direction, f64[72, 90]
    of 5 degrees of azimuth and 2 of elevation."""

    def __init__(self, odds: Floats) -> None:
        self._odds = odds

    @classmethod
    def of(cls, sweeps: Sequence[Beams]) -> Blind:
        """Of beams of many sweeps."""
        counts = np.zeros((2, 72 * 90))
        for beams in sweeps:
            for kind, own in enumerate((beams.returned, ~beams.returned)):
                counts[kind] += np.bincount(cls._cell(beams.directions[own]), minlength=72 * 90)
        return cls(np.log((counts[1] + 1) / (counts[0] + 1)))

    @staticmethod
    def _cell(directions: Floats) -> NDArray[np.int64]:
        azimuth = np.degrees(np.arctan2(directions[:, 1], directions[:, 0])) / 5
        elevation = np.degrees(np.arcsin(directions[:, 2].clip(-1, 1))) / 2
        return np.floor(azimuth + 36).astype(np.int64).clip(0, 71) * 90 + np.floor(elevation + 45).astype(
            np.int64
        ).clip(0, 89)

    def of_directions(self, directions: Floats) -> Floats:
        """Log-odds f64[N] of directions f64[N, 3]."""
        return self._odds[self._cell(directions)]


@dataclass(frozen=True, slots=True, eq=False)
class SweepReturns:
    """What a sweep measured: its beams, and returns and lost beams by what they belong to."""

    beams: Beams
    parts: Mapping[str, Returns]


class LogReturns:
    """What the sweeps of a log's sensor tell. They are read when they are asked for.

    Args:
        scene: the log. sweeps: those that may be learnt from. gone: which places f64[N, 3] of the world an edit took
            away.
    """

    def __init__(self, scene: Scene, sweeps: Sequence[Sweep], gone: Gone | None = None) -> None:
        self._scene, self.sweeps, self._gone = scene, tuple(sweeps), gone
        self._tracks = {track.id: track for track in moving_tracks(scene)}
        self._read: dict[str, SweepReturns] = {}
        self._rows: Rows | None = None
        self.names = (WORLD, *self._tracks)
        self.weights: Floats | None = None
        self.tested = _evenly(self.sweeps[1:-1], MOST_TESTED) if len(self.sweeps) >= 4 else ()
        others = [sweep for sweep in self.sweeps if sweep not in self.tested]
        own = [self.of(sweep).beams for sweep in _evenly(others, MOST_LOOKS)]
        looks = np.concatenate([beams.directions[beams.returned] for beams in own])
        self.field = FieldOfView.of(looks)
        self.blind = Blind.of(own)

    def of(self, sweep: Sweep) -> SweepReturns:
        """What one sweep measured."""
        if sweep.id not in self._read:
            heard = beams_of(self._scene, sweep)
            self._rows = self._rows or Rows.of(heard.directions * heard.range_m[:, None])
            beams = with_silent(heard, self._rows)
            parts = returns_of(self._scene, sweep, beams)
            if self._gone is not None:
                parts[WORLD] = parts[WORLD].taken(~self._gone(parts[WORLD].xyz))
            self._read[sweep.id] = SweepReturns(beams, parts)
        return self._read[sweep.id]

    def poses(self, time_s: float, known: Mapping[str, Floats]) -> dict[str, Floats]:
        """Poses of all objects at a time: those that are known, else those of the tracks."""
        found = {name: track.pose_at(time_s) for name, track in self._tracks.items()}
        return {name: pose for name, pose in found.items() if pose is not None} | dict(known)

    def meet(
        self,
        directions: Floats,
        world_from_sensor: Floats,
        time_s: float,
        poses: Mapping[str, Floats],
        without: str = "",
    ) -> Met:
        """What beams f64[B, 3] of the sensor meet in the nearest sweeps; where those measured nothing, in others.
        ``nearest`` of the answer numbers ``names``; -1: nothing.

        Args:
            without: id of a sweep that is left out.
        """
        near, far = self._chosen(world_from_sensor, time_s, poses, without)
        met = self._meet(near, directions, world_from_sensor, poses)
        own = np.flatnonzero(np.isnan(met.range_m))
        if len(own) and far:
            other = self._meet(far, directions[own], world_from_sensor, poses)
            other.lost[:] += met.lost[own]
            met.put(own, other)
        return met

    def _chosen(
        self, world_from_sensor: Floats, time_s: float, poses: Mapping[str, Floats], without: str
    ) -> tuple[list[Trusted], list[Trusted]]:
        """Per part of the world the sweeps that were taken nearest to the sensor's place and time, and others, evenly
        chosen, each with its trust."""
        near, far = list[Trusted](), list[Trusted]()
        sweeps = [sweep for sweep in self.sweeps if sweep.id != without]
        for number, name in enumerate(self.names):
            if name != WORLD and name not in poses:
                continue
            here = poses.get(name, np.eye(4))
            place = geometry.invert(here) @ world_from_sensor[:, 3] if name else world_from_sensor[:, 3]
            apart = []
            for sweep in sweeps:
                there = np.eye(4) if name == WORLD else self._tracks[name].pose_at(sweep.time_s)
                if there is not None:
                    away = geometry.invert(there) @ sweep.world_from_lidar[:, 3] - place
                    apart.append(
                        (float(np.linalg.norm(away[:3])) + AGE_M_S * abs(sweep.time_s - time_s), len(apart), sweep)
                    )
            order = [sweep for _, _, sweep in sorted(apart)]
            rest = order[NEAREST:]
            near += [(number, sweep, HALF ** (k / 2)) for k, sweep in enumerate(order[:NEAREST])]
            far += [(number, sweep, 1.0) for sweep in _evenly(rest, NEAREST)]
        return near, far

    def _meet(
        self, chosen: Sequence[Trusted], directions: Floats, world_from_sensor: Floats, poses: Mapping[str, Floats]
    ) -> Met:
        """What beams meet in parts of sweeps."""
        found, empty = Met.nothing(len(directions)), Returns(np.zeros((0, 3)), np.zeros(3), np.zeros(0, np.float32))
        parts = [
            (self.names[number], self.of(sweep).parts.get(self.names[number], empty)) for number, sweep, _ in chosen
        ]
        if not parts:
            return found
        sizes = [len(part) for _, part in parts]
        owner, trust = (
            np.repeat(column, sizes) for column in ([number for number, _, _ in chosen], [t for _, _, t in chosen])
        )
        intensity = np.concatenate([part.intensity for _, part in parts])
        xyz, numbers = placed(parts, poses, world_from_sensor[:3, 3])
        turn = world_from_sensor[:3, :3]
        local = np.stack([xyz[:, 0] * a + xyz[:, 1] * b + xyz[:, 2] * c for a, b, c in turn.T], 1)  # faster than @
        aside = np.hypot(local[:, 0], local[:, 1]) * np.cos(np.pi / SECTORS + MARGIN_RAD)
        around = np.arctan2(directions[:, 1], directions[:, 0]) / (2 * np.pi) + 0.5
        sector = np.floor(around * SECTORS).astype(np.int64).clip(0, SECTORS - 1)
        for k in np.unique(sector):
            own, middle = np.flatnonzero(sector == k), (k + 0.5) / SECTORS * 2 * np.pi - np.pi
            near = np.flatnonzero(np.cos(middle) * local[:, 0] + np.sin(middle) * local[:, 1] >= aside)
            rows = numbers[near]
            part = first_surface(directions[own], local[near], intensity[rows], trust[rows])
            part.nearest[:] = np.where(part.nearest >= 0, np.append(owner[rows], -1)[part.nearest], -1)
            found.put(own, part)
        return found

    def features(self, directions: Floats, met: Met) -> Floats:
        """What decides whether a beam returns, f64[B, 8]: 1, log-odds of the loss around, and of that in this direction
        of the sensor, range / 100 m, incidence, how far the nearest return is for the spacing, the spacing (log, units
        of 0.2 degrees), one-sidedness."""
        loss = np.log((met.lost + FEW) / (met.heard + FEW))
        with np.errstate(invalid="ignore", divide="ignore"):
            near = np.where(np.isfinite(met.spacing_rad), met.nearest_rad / met.spacing_rad, 1.0)
            spacing = np.log(np.where(np.isfinite(met.spacing_rad), met.spacing_rad, 0.01) / np.radians(0.2))
        columns = (
            loss,
            self.blind.of_directions(directions),
            met.range_m / 100,
            met.facing,
            near,
            spacing,
            met.one_sided,
        )
        return np.nan_to_num(np.stack([np.ones(len(loss)), *columns], 1))

    def returns(self, directions: Floats, met: Met) -> NDArray[np.bool_]:
        """Which beams return."""
        seen = np.isfinite(met.range_m)
        return seen if self.weights is None else seen & (self.features(directions, met) @ self.weights > 0)

    def contradicts(
        self, places: Floats, world_from_sensor: Floats, time_s: float, poses: Mapping[str, Floats]
    ) -> NDArray[np.bool_]:
        """Which surfaces at places f64[N, 3] in the world cannot be there: the recorded sensor nearest to the simulated
        one had them in its field and met nothing before them."""
        if not len(places):
            return np.zeros(0, bool)
        stations = np.stack([sweep.world_from_lidar for sweep in self.sweeps])
        apart = np.linalg.norm(stations[:, :3, 3] - world_from_sensor[:3, 3], axis=1)
        station = stations[apart.argmin()]
        local = geometry.transform_points(geometry.invert(station), places)
        away = np.maximum(np.linalg.norm(local, axis=1), 1e-6)
        met = self.meet(local / away[:, None], station, time_s, poses)
        hidden = np.isfinite(met.range_m) & (met.range_m < HIDDEN_SHARE * away)
        return ~hidden & self.field.holds(local / away[:, None])


def learn_returns(scene: Scene, sensor: str = "", gone: Gone | None = None) -> LogReturns | None:
    """What the sweeps of a log's sensor tell, those of held-out frames left out; None without sweeps. The same log
    gives the same numbers.

    Args:
        sensor: empty: the log's first. Others lie centimetres beside it, and their intensity means something else.
        gone: which places f64[N, 3] of the world an edit took away.

    Raises:
        UsageError: the log has no such sensor.
    """
    known = list(dict.fromkeys(sweep.sensor for sweep in scene.sweeps))
    if sensor and sensor not in known:
        raise UsageError("the log has no such LiDAR", expected=", ".join(known) or "none", got=sensor[:80])
    sweeps = tuple(sweep for sweep in training_sweeps(scene) if sweep.sensor == (sensor or known[0]))
    if not sweeps:
        return None
    log.info(f"LiDAR: surfaces, intensity and lost beams from {len(sweeps)} sweeps of {sweeps[0].sensor}")
    returns = LogReturns(scene, sweeps, gone)
    if returns.tested:
        returns.weights = _regression(*_samples(returns.tested, returns))
    return returns


def _evenly(sweeps: Sequence[Sweep], most: int) -> tuple[Sweep, ...]:
    at = np.unique(np.linspace(0, len(sweeps) - 1, min(most, len(sweeps))).round().astype(int))
    return tuple(sweeps[k] for k in at)


def _samples(sweeps: Sequence[Sweep], returns: LogReturns) -> tuple[Floats, NDArray[np.bool_]]:
    """Features of the beams of sweeps, met in the others, and which returned."""
    rows, answers = list[Floats](), list[NDArray[np.bool_]]()
    for sweep in sweeps:
        beams = returns.of(sweep).beams
        for share, own in beams.parts(SECTORS):
            time_s = beams.time_s(share)
            met = returns.meet(beams.directions[own], beams.pose(share), time_s, returns.poses(time_s, {}), sweep.id)
            seen = np.isfinite(met.range_m)
            rows.append(returns.features(beams.directions[own], met)[seen])
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
    """Which places f64[N, 3] belong to what an edit took out of the background; None: it took nothing.

    Args:
        before, after: places of the background's Gaussians f64[N, 3].
    """
    rows = lambda block: np.ascontiguousarray(block).view([("", block.dtype)] * 3).reshape(-1)
    gone = ~np.isin(rows(before), rows(after))
    if not gone.any():
        return None
    tree = KDTree(before)

    def chosen(places: Floats) -> NDArray[np.bool_]:
        away, nearest = tree.query(places, workers=-1)
        return (away <= GONE_M) & gone[nearest]

    return chosen
