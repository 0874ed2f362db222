"""What a score is about: trajectories with the methods that have them, and what the methods are held against."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from mudg.base.errors import InputError
from mudg.base.types import Frame, Observation, Scene, Track, View
from mudg.core import metrics
from mudg.data.observations import ObservationSet, list_observation_sets, read_observations
from mudg.stages.config import ScoreConfig
from mudg.stages.score_truth import SAME_PLACE_M, SAME_TIME_S, Truth, apart_m
from mudg.stages.scoring.facts import FactMaker

_NAME: Final = re.compile(r"(?P<camera>.+?)_(?:recorded|shift(?P<shift>[+-]\d+(?:\.\d+)?))(?P<more>.*)")

Baseline = Callable[[View], Observation]
PairDistance = Callable[[metrics.Pair], float | None]


@dataclass(frozen=True)
class ScoredTrajectory:
    """One trajectory to score.

    Args:
        name: trajectory name. camera: its camera. shift_m: 0 = the recorded path, None = neither it nor a plain shift.
        views: at the common size. frames: the recorded frame of each view on the recorded path, else None.
        sets, indices: the methods that have it, and which of their views stand beside ``views``.
    """

    name: str
    camera: str
    shift_m: float | None
    views: tuple[View, ...]
    frames: tuple[Frame | None, ...]
    sets: Mapping[str, ObservationSet]
    indices: Mapping[str, tuple[int, ...]]

    def counted(self, held_out: frozenset[str]) -> list[int]:
        """The views that count. Recorded training frames were seen by the fit and do not; views off the path never were."""
        return [n for n, frame in enumerate(self.frames) if frame is None or frame.id in held_out]

    def record(self) -> dict[str, Any]:
        """The trajectory as JSON values."""
        camera = self.views[0].camera
        return {
            "name": self.name, "camera": self.camera, "shift_m": self.shift_m, "views": len(self.views), "width": camera.width,
            "height": camera.height, "methods": list(self.sets), "indices": {m: list(i) for m, i in self.indices.items()},
        }  # fmt: skip


@dataclass(frozen=True)
class Reference:
    """What every method is compared with, and how.

    Args:
        truth, baseline: of any view. held_out: ids of the recorded frames that count.
        distances: what computes the rows of the table that need weights, at ``distance_views`` views of a trajectory (0 = all).
        facts: makes what is known of views beside their true image. vehicles: numbers in instance maps, and their tracks.
    """

    truth: Truth
    baseline: Baseline | None
    held_out: frozenset[str]
    error_pictures: bool
    distances: Mapping[str, PairDistance]
    distance_views: int
    facts: FactMaker
    vehicles: tuple[tuple[int, Track], ...]


def trajectories_of(config: ScoreConfig, scene: Scene, methods: Mapping[str, Path]) -> list[ScoredTrajectory]:
    """The trajectories that some method has, by camera and distance.

    Raises:
        InputError: there are none, or methods disagree about a trajectory's views.
    """
    sets = {
        method: {name: read_observations(path) for name, path in list_observation_sets(folder).items()}
        for method, folder in methods.items()
    }
    names = sorted({name for found in sets.values() for name in found}, key=_order)
    if not names:
        raise InputError("none of the folders holds rendered views", where=", ".join(str(p) for p in methods.values()),
            expected="output of mudg render or mudg synthesize")  # fmt: skip
    return [
        _matched(config, scene, name, {m: found[name] for m, found in sets.items() if name in found}) for name in names
    ]


def _order(name: str) -> tuple[str, float, str]:
    found = _NAME.fullmatch(name)
    return (found["camera"], float(found["shift"] or 0), name) if found else (name, 1e9, name)


def _matched(config: ScoreConfig, scene: Scene, name: str, sets: Mapping[str, ObservationSet]) -> ScoredTrajectory:
    """Match the methods' views by time; keep those that all have, so that all are scored on the same ones."""
    times = {m: np.array([v.time_s for v in found.views]) for m, found in sets.items()}
    indices: dict[str, list[int]] = {m: [] for m in sets}
    views: list[View] = []
    for view in next(iter(sets.values())).views:
        nearest = {m: int(np.argmin(np.abs(t - view.time_s))) for m, t in times.items() if len(t)}
        if len(nearest) < len(sets) or any(abs(times[m][i] - view.time_s) > SAME_TIME_S for m, i in nearest.items()):
            continue
        for method, index in nearest.items():
            distance_m = apart_m(sets[method].views[index], view)
            if distance_m > SAME_PLACE_M:
                raise InputError("two methods rendered the same trajectory from different positions",
                                 where=f"{name}: {method}, view {index}", got=f"{distance_m:.3f} m apart")  # fmt: skip
            indices[method].append(index)
        camera = scene.cameras.get(view.camera.name, view.camera)
        width = config.width_px or camera.width
        views.append(view.resized(width, max(1, round(camera.height * width / camera.width))))
    if not views:
        raise InputError("the methods have no view in common", where=name, got=", ".join(sets))
    found = _NAME.fullmatch(name)
    shift_m = float(found["shift"] or 0.0) if found is not None and not found["more"] else None
    camera_name = views[0].camera.name
    frames = tuple(_frame_of(scene, camera_name, view) if shift_m == 0.0 else None for view in views)
    return ScoredTrajectory(
        name, camera_name, shift_m, tuple(views), frames, sets, {m: tuple(i) for m, i in indices.items()}
    )


def _frame_of(scene: Scene, camera: str, view: View) -> Frame | None:
    return next((f for f in scene.frames_of(camera) if abs(f.view.time_s - view.time_s) <= SAME_TIME_S), None)
