"""Facts about views beside their true image: LiDAR points, vehicles, markings; and the trajectories to score."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from mudg.base import geometry
from mudg.base.errors import InputError
from mudg.base.palette import ID, UNLABELLED
from mudg.base.types import Frame, Observation, Scene, Track, View
from mudg.core import metrics, street_scores
from mudg.core.fusion import STATIC
from mudg.core.metrics import LaneFacts, ViewFacts
from mudg.core.street_scores import VEHICLE_LABELS, visible_agents
from mudg.editing.settings import ScoreConfig
from mudg.labels.evidence import driven_path, ground_near
from mudg.labels.inputs import box_outline
from mudg.scene.observations import ObservationSet, list_observation_sets, read_observations
from mudg.scene.read import read_image
from mudg.scoring.truth import SAME_PLACE_M, SAME_TIME_S, LogPoints, Truth, ViewTruth, apart_m


def vehicles_of(scene: Scene) -> tuple[tuple[int, Track], ...]:
    """Number in the instance maps of a generated city, and track, of every vehicle; none of a recorded log."""
    if scene.source.recipe is None:
        return ()
    return tuple((int(t.id.rsplit("-", 1)[1]), t) for t in scene.tracks if t.label in VEHICLE_LABELS)


class FactMaker:
    """Makes the facts of views; threads may call."""

    def __init__(self, scene: Scene) -> None:
        self._scene = scene
        self._points = LogPoints(scene)
        self._vehicles = vehicles_of(scene)
        self._path = driven_path(scene.ego.world_from_ego)

    def of(self, view: View, truth: ViewTruth | None) -> ViewFacts:
        """What is known of a view; ``truth``: its exact or recorded truth, if there is one."""
        near = (f for f in self.frames_of(view.camera.name) if abs(f.view.time_s - view.time_s) <= SAME_TIME_S)
        frame = next(near, None)  # what the view's camera recorded at its time
        points = self._points.truth_at(view, frame)
        if truth is not None and truth.instance is not None:
            agents, seen, lanes = visible_agents(view, self._vehicles, truth.instance), truth.seen, None
            if truth.marking is not None and seen.semantics is not None and seen.depth is not None:
                depth = seen.depth[0].numpy()
                road = (seen.semantics.numpy() == ID["road"]) & (depth > 0) & (depth < street_scores.LANE_FAR_M)
                marking = truth.marking & road
                lanes = LaneFacts(road, marking, street_scores.lane_band(marking), seen.rgb.numpy(), exact=True)
            return ViewFacts(points, agents, lanes, truth.instance)
        return ViewFacts(points, None, None if frame is None else self._carried_lanes(view, frame))

    def frames_of(self, camera: str) -> tuple[Frame, ...]:
        """The recorded frames of a camera; none if the scene lacks it."""
        return self._scene.frames_of(camera) if camera in self._scene.cameras else ()

    def _carried_lanes(self, view: View, frame: Frame) -> LaneFacts | None:
        """Markings of a recorded image where the ground shows them in another view. Without LiDAR there is no
        ground."""
        points = self._points.around(view.time_s)
        if points is None:
            return None
        plane = ground_near(points.xyz[points.owner == STATIC], self._path, view.center_world)
        if plane is None:
            return None
        places = street_scores.plane_points(view, plane)
        rgb = np.asarray(read_image(self._scene, frame)).transpose(2, 0, 1) / np.float32(255)
        colors, shown = street_scores.seen_from(frame.view, rgb, places)
        free = np.asarray(~self._boxes(frame.view))[None].astype(np.float32)
        beside = (geometry.transform_points(view.cam_from_world, places.reshape(-1, 3))[:, 0]).reshape(shown.shape)
        with np.errstate(invalid="ignore"):
            road = shown & (np.abs(beside) < street_scores.NTL_BESIDE_M) & ~self._boxes(view)
        road &= street_scores.seen_from(frame.view, free, places)[0][0] > 0.99
        marking = street_scores.bright_stripes(colors, road)
        band = street_scores.lane_band(marking) & road
        return LaneFacts(road, marking, band, colors.astype(np.float32), exact=False)

    def _boxes(self, view: View) -> NDArray[np.bool_]:
        """Outlines of all tracked boxes, bool[H, W]."""
        mask = np.zeros((view.camera.height, view.camera.width), bool)
        for track in self._scene.tracks:
            pose = track.pose_at(view.time_s)
            outline = None if pose is None else box_outline(view, pose, track.size_m)
            mask = mask if outline is None else mask | outline
        return mask


def known_of(facts: ViewFacts) -> set[str]:
    """What the facts of a view hold, as ``MetricRow.needs`` names it."""
    names = {"views"}
    if facts.points is not None and (facts.points.depth > 0).any():
        names.add("LiDAR points")
        if (facts.points.classes[facts.points.depth > 0] != UNLABELLED).any():
            names.add("classes of points")
    if facts.agents:
        names.add("exact vehicles")
    if facts.lanes is not None and facts.lanes.band.any():
        names |= {"markings", "exact markings"} if facts.lanes.exact else {"markings"}
    return names


# -- trajectories ----------------------------------------------------------------------------------
_NAME: Final = re.compile(r"(?P<camera>.+?)_(?:recorded|shift(?P<shift>[+-]\d+(?:\.\d+)?))(?P<more>.*)")

Baseline = Callable[[View], Observation]
PairDistance = Callable[[metrics.Pair], float | None]


@dataclass(frozen=True)
class ScoredTrajectory:
    """One trajectory to score. ``name``: trajectory name. ``camera``: its camera. ``shift_m``: 0 = the recorded path,
    None = neither it nor a plain shift. ``views``: at the common size. ``frames``: the recorded frame of each view on
    the recorded path, else None. ``sets``, ``indices``: the methods that have it, and which of their views stand beside
    ``views``."""

    name: str
    camera: str
    shift_m: float | None
    views: tuple[View, ...]
    frames: tuple[Frame | None, ...]
    sets: Mapping[str, ObservationSet]
    indices: Mapping[str, tuple[int, ...]]

    def counted(self, held_out: frozenset[str]) -> list[int]:
        """The views that count. Recorded training frames were seen by the fit and do not; views off the path never
        were."""
        return [n for n, frame in enumerate(self.frames) if frame is None or frame.id in held_out]

    def record(self) -> dict[str, Any]:
        """The trajectory as JSON values."""
        camera, indices = self.views[0].camera, {m: list(i) for m, i in self.indices.items()}
        names = {"name": self.name, "camera": self.camera, "shift_m": self.shift_m}
        sizes = {"views": len(self.views), "width": camera.width, "height": camera.height}
        return {**names, **sizes, "methods": list(self.sets), "indices": indices}


@dataclass(frozen=True)
class Reference:
    """What every method is compared with, and how. ``truth``, ``baseline``: of any view. ``held_out``: ids of the
    recorded frames that count. ``distances``: what computes the rows of the table that need weights, at
    ``distance_views`` views of a trajectory (0 = all). ``facts``: makes what is known of views beside their true image.
    ``vehicles``: numbers in instance maps, and their tracks."""

    truth: Truth
    baseline: Baseline | None
    held_out: frozenset[str]
    error_pictures: bool
    distances: Mapping[str, PairDistance]
    distance_views: int
    facts: FactMaker
    vehicles: tuple[tuple[int, Track], ...]


def trajectories_of(config: ScoreConfig, scene: Scene, methods: Mapping[str, Path]) -> list[ScoredTrajectory]:
    """The trajectories that some method has, by camera and distance. InputError: there are none, or methods disagree
    about a trajectory's views."""

    def order(name: str) -> tuple[str, float, str]:
        found = _NAME.fullmatch(name)
        return (found["camera"], float(found["shift"] or 0), name) if found else (name, 1e9, name)

    read = lambda folder: {n: read_observations(path) for n, path in list_observation_sets(folder).items()}
    sets = {method: read(folder) for method, folder in methods.items()}
    names = sorted({name for found in sets.values() for name in found}, key=order)
    if not names:
        where, expected = ", ".join(map(str, methods.values())), "output of mudg render or mudg synthesize"
        raise InputError("none of the folders holds rendered views", where=where, expected=expected)
    having = {name: {m: found[name] for m, found in sets.items() if name in found} for name in names}
    return [_matched(config, scene, name, of) for name, of in having.items()]


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
                what, where = "two methods rendered the same trajectory from different positions", f"{name}: {method}"
                raise InputError(what, where=f"{where}, view {index}", got=f"{distance_m:.3f} m apart")
            indices[method].append(index)
        camera = scene.cameras.get(view.camera.name, view.camera)
        width = config.width_px or camera.width
        views.append(view.resized(width, max(1, round(camera.height * width / camera.width))))
    if not views:
        raise InputError("the methods have no view in common", where=name, got=", ".join(sets))
    found = _NAME.fullmatch(name)
    shift_m = float(found["shift"] or 0.0) if found is not None and not found["more"] else None
    camera_name = views[0].camera.name
    frames = scene.frames_of(camera_name) if shift_m == 0.0 else ()
    at = lambda view: next((f for f in frames if abs(f.view.time_s - view.time_s) <= SAME_TIME_S), None)
    kept = {method: tuple(own) for method, own in indices.items()}
    return ScoredTrajectory(name, camera_name, shift_m, tuple(views), tuple(map(at, views)), sets, kept)
