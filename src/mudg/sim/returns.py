"""What a log's own sweeps tell a simulated LiDAR: where surfaces are, how bright they return, and which beams are lost.

The returns of all sweeps but those of held-out frames are one cloud per rigid part of the world (``scene/beams.py``).
A beam meets the first surface of that cloud (``core/returns.py``). Each return has two learnt columns beside its place:
the intensity measured there, and how many beams were lost there; a beam has their weighted means. Whether it returns
is a logistic regression of the loss, range, incidence, and how well the returns around it cover it, learnt from sweeps
whose returns are not in the cloud. Where the log measured nothing, the Gaussians answer (``sim/lidar.py``).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from mudg.base import geometry, log
from mudg.base.errors import UsageError
from mudg.base.types import Scene, Sweep, Track
from mudg.core.returns import Met, Returns, first_surface
from mudg.scene.beams import WORLD, beams_of, moving_tracks, placed, returns_of, training_sweeps, with_silent

Floats = NDArray[np.float64]
MOST_SILENT: Final = 4
"""Sweeps of which the lost beams are followed, evenly chosen."""
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


@dataclass(frozen=True, slots=True, eq=False)
class LogReturns:
    """Returns of a log.

    Args:
        parts: by object, and ``WORLD``. tracks: of the objects. weights: of the regression (``features``); None: too
            little to learn from, and a beam returns where it meets something.
        stations: world-from-sensor f64[S, 4, 4] of the sweeps. field: of the sensor.
    """

    parts: Mapping[str, Returns]
    tracks: Mapping[str, Track]
    weights: Floats | None
    stations: Floats
    field: FieldOfView

    def poses(self, time_s: float, known: Mapping[str, Floats]) -> dict[str, Floats]:
        """Poses of all objects at a time: those that are known, else those of the tracks."""
        found = {name: track.pose_at(time_s) for name, track in self.tracks.items()}
        return {name: pose for name, pose in found.items() if pose is not None} | dict(known)

    def meet(self, directions: Floats, world_from_sensor: Floats, poses: Mapping[str, Floats]) -> Met:
        """What beams f64[B, 3] of the sensor meet; ``rows`` number all returns of ``parts``."""
        xyz, numbers = placed(self.parts, poses, world_from_sensor[:3, 3])
        turn = world_from_sensor[:3, :3]
        local = np.stack([xyz[:, 0] * a + xyz[:, 1] * b + xyz[:, 2] * c for a, b, c in turn.T], 1)  # faster than @
        found, aside = (
            Met.nothing(len(directions)),
            np.hypot(local[:, 0], local[:, 1]) * np.cos(np.pi / SECTORS + MARGIN_RAD),
        )
        around = np.arctan2(directions[:, 1], directions[:, 0]) / (2 * np.pi) + 0.5
        sector = np.floor(around * SECTORS).astype(np.int64).clip(0, SECTORS - 1)
        for k in np.unique(sector):
            own, middle = np.flatnonzero(sector == k), (k + 0.5) / SECTORS * 2 * np.pi - np.pi
            near = np.flatnonzero(np.cos(middle) * local[:, 0] + np.sin(middle) * local[:, 1] >= aside)
            part = first_surface(directions[own], local[near])
            if len(near):
                part.rows[:] = numbers[near[part.rows]]
            found.put(own, part)
        return found

    def column(self, name: str) -> Floats:
        """A column of all returns: ``intensity``, ``loss``, ``count``."""
        return np.concatenate([getattr(part, name) for part in self.parts.values()])

    def owners(self) -> NDArray[np.int64]:
        """Number of its part in ``parts``, of all returns."""
        return np.repeat(np.arange(len(self.parts)), [len(part) for part in self.parts.values()])

    def features(self, met: Met) -> Floats:
        """What decides whether a beam returns, f64[B, 7]: 1, log-odds of the loss, range / 100 m, incidence, how far
        the nearest return is for the spacing, the spacing (log, units of 0.2 degrees), one-sidedness."""
        loss = met.mean(self.column("loss")).clip(0.01, 0.99)
        with np.errstate(invalid="ignore", divide="ignore"):
            near = np.where(np.isfinite(met.spacing_rad), met.nearest_rad / met.spacing_rad, 1.0)
            spacing = np.log(np.where(np.isfinite(met.spacing_rad), met.spacing_rad, 0.01) / np.radians(0.2))
        columns = (np.log(loss / (1 - loss)), met.range_m / 100, met.facing, near, spacing, met.one_sided)
        return np.nan_to_num(np.stack([np.ones(len(loss)), *columns], 1))

    def returns(self, met: Met) -> NDArray[np.bool_]:
        """Which beams return."""
        seen = np.isfinite(met.range_m)
        return seen if self.weights is None else seen & (self.features(met) @ self.weights > 0)

    def contradicts(self, places: Floats, world_from_sensor: Floats, poses: Mapping[str, Floats]) -> NDArray[np.bool_]:
        """Which surfaces at places f64[N, 3] in the world cannot be there: the recorded sensor nearest to the simulated
        one had them in its field and met nothing before them."""
        if not len(places):
            return np.zeros(0, bool)
        apart = np.linalg.norm(self.stations[:, :3, 3] - world_from_sensor[:3, 3], axis=1)
        station = self.stations[apart.argmin()]
        local = geometry.transform_points(geometry.invert(station), places)
        away = np.maximum(np.linalg.norm(local, axis=1), 1e-6)
        met = self.meet(local / away[:, None], station, poses)
        hidden = np.isfinite(met.range_m) & (met.range_m < HIDDEN_SHARE * away)
        return ~hidden & self.field.holds(local / away[:, None])

    def without(self, gone: Callable[[Floats], NDArray[np.bool_]]) -> LogReturns:
        """Without those returns of the world at places f64[N, 3] that are gone."""
        if WORLD not in self.parts:
            return self
        kept = self.parts[WORLD].taken(~gone(self.parts[WORLD].xyz))
        return replace(self, parts={**self.parts, WORLD: kept})


def learn_returns(scene: Scene, sensor: str = "") -> LogReturns | None:
    """What the sweeps of a log's sensor tell, those of held-out frames left out; None without sweeps. The same log
    gives the same numbers.

    Args:
        sensor: empty: the log's first. Others lie centimetres beside it, and their intensity means something else.

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
    tracks = {track.id: track for track in moving_tracks(scene)}
    looks = np.concatenate([beams_of(scene, sweep).directions for sweep in _evenly(sweeps, MOST_SILENT)])
    own = (tracks, None, np.stack([sweep.world_from_lidar for sweep in sweeps]), FieldOfView.of(looks))
    tested = _evenly(sweeps[1:-1], MOST_TESTED) if len(sweeps) >= 4 else ()
    weights = None
    if tested:
        rest = tuple(sweep for sweep in sweeps if sweep not in tested)
        trial = _with_losses(scene, rest, LogReturns(_averaged(scene, rest), *own))
        weights = _regression(*_samples(scene, tested, trial))
    return replace(_with_losses(scene, sweeps, LogReturns(_averaged(scene, sweeps), *own)), weights=weights)


def _averaged(scene: Scene, sweeps: Sequence[Sweep]) -> dict[str, Returns]:
    return {name: part.averaged() for name, part in returns_of(scene, sweeps).items()}


def _evenly(sweeps: Sequence[Sweep], most: int) -> tuple[Sweep, ...]:
    at = np.unique(np.linspace(0, len(sweeps) - 1, min(most, len(sweeps))).round().astype(int))
    return tuple(sweeps[k] for k in at)


def _with_losses(scene: Scene, sweeps: Sequence[Sweep], returns: LogReturns) -> LogReturns:
    """The same with ``Returns.missed``: every beam of some of these sweeps that was lost counts, by weight, at the
    returns that it met. Returns that more beams went through than met are traces of what moved; they are left out."""
    chosen = _evenly(sweeps, MOST_SILENT)
    sizes = [len(part) for part in returns.parts.values()]
    missed, met_here, gone_through = (np.zeros(sum(sizes)) for _ in range(3))
    for sweep in chosen:
        beams = with_silent(beams_of(scene, sweep))
        for share, own in beams.parts(SECTORS):
            met = returns.meet(beams.directions[own], beams.pose(share), returns.poses(beams.time_s(share), {}))
            away, surface = beams.range_m[own], met.range_m
            with np.errstate(invalid="ignore"):
                kinds = (np.isnan(away), away <= 1.05 * surface + THROUGH_M, away > 1.05 * surface + THROUGH_M)
            for sums, kind in zip((missed, met_here, gone_through), kinds, strict=True):
                sums += np.bincount(met.rows[kind].reshape(-1), met.weights[kind].reshape(-1), len(sums))
    missed *= len(sweeps) / max(1, len(chosen))
    parts, first = {}, 0
    for name, part in returns.parts.items():
        own = slice(first, first + len(part))
        parts[name] = part.with_missed(missed[own]).taken(gone_through[own] <= met_here[own] + UNDECIDED)
        first += len(part)
    return replace(returns, parts=parts)


def _samples(scene: Scene, sweeps: Sequence[Sweep], returns: LogReturns) -> tuple[Floats, NDArray[np.bool_]]:
    """Features of the beams of sweeps that are not in the cloud, and which returned."""
    rows, answers = [np.zeros((0, 7))], [np.zeros(0, bool)]
    for sweep in sweeps:
        beams = with_silent(beams_of(scene, sweep))
        for share, own in beams.parts(SECTORS):
            met = returns.meet(beams.directions[own], beams.pose(share), returns.poses(beams.time_s(share), {}))
            seen = np.isfinite(met.range_m)
            rows.append(returns.features(met)[seen])
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


def places_gone(before: Floats, after: Floats) -> Callable[[Floats], NDArray[np.bool_]] | None:
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
