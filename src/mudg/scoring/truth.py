"""What views are held against (the generated city drawn again, held-out recorded frames, or truth drawn by an earlier
run), what else is known about them, and the trajectories to score.

A folder of truth (``write_truth``) holds one observation folder per trajectory and, beside the observations,
``moving.safetensors``: ``moving`` u8[T, H, W], 1 where a dynamic object is seen, ``instance`` i32[T, H, W], and
``marking`` u8[T, H, W], 1 where there is paint on the road.
"""

from __future__ import annotations

import functools
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from mudg.base import geometry, log, palette, store
from mudg.base.errors import InputError
from mudg.base.types import Frame, Observation, Scene, Sweep, Track, Trajectory, View
from mudg.city import logs as city_logs
from mudg.city.world import CityWorld
from mudg.core import lidar, metrics, street_scores
from mudg.core.fusion import STATIC, FusionRules, SweepShots, judge_track, largest_beam_gap, separate
from mudg.core.lidar import OwnedPoints, PointTruth, ShownFrame
from mudg.core.metrics import LaneFacts, ViewFacts
from mudg.core.pictures import resize_nearest, resize_rgb
from mudg.core.project import RULES as HIDING_RULES
from mudg.core.project import visible_depth
from mudg.core.street_scores import VEHICLE_LABELS, visible_agents
from mudg.core.trajectory import points_as_read
from mudg.editing.settings import ScoreConfig
from mudg.labels.annotate import nearest_sweeps
from mudg.labels.evidence import driven_path, ground_near
from mudg.labels.inputs import box_outline
from mudg.scene.labels import read_label
from mudg.scene.observations import ObservationSet, ObservationWriter, list_observation_sets, read_observations
from mudg.scene.read import read_image, read_points, read_scene

MOVING_FILE: Final = "moving.safetensors"
SAME_SWEEP_S: Final = 0.05
MAX_LIDAR_M: Final = 100.0
SAME_TIME_S: Final = 1e-4
SAME_PLACE_M: Final = 1e-3


@dataclass(frozen=True)
class ViewTruth:
    """The truth at a view, with what is known only of generated cities: ``moving`` bool[1, H, W], true pixels of
    dynamic objects; ``instance`` i32[H, W], number of the object that is seen; ``marking`` bool[H, W], paint on the
    road."""

    seen: Observation
    moving: Tensor | None = None
    instance: NDArray[np.int32] | None = None
    marking: NDArray[np.bool_] | None = None


@dataclass(frozen=True)
class Truth:
    """Where truth comes from: ``at_view(view, frame, trajectory)`` is None where there is none. ``exact``: truth exists
    at every pixel of every view. ``stored``: it lies on disk already and need not be written again."""

    exact: bool
    at_view: Callable[[View, Frame | None, str], ViewTruth | None]
    stored: bool = False


def apart_m(a: View, b: View) -> float:
    """Distance of two cameras, metres."""
    return float(np.linalg.norm(a.center_world - b.center_world))


def truth_of(scene: Scene) -> Truth:
    """Exact truth for a generated city; else the recorded frame a view belongs to."""
    if scene.source.recipe is not None:
        world = CityWorld.from_source(scene.source)
        for frame in scene.frames:
            there, stated = world.ego_path().pose_at(frame.view.time_s), scene.ego.pose_at(frame.view.time_s)
            if there is None or stated is None or not np.allclose(there, stated, atol=1e-3):
                what = "the scene is not the generated city that its recipe names"
                what += ", so its truth would be another street's"
                where, expected = f"{scene.root}: source.recipe, frame {frame.id}", "the path that the recipe makes"
                remedy = "generate the city again; in scenes of other origin, leave the recipe out"
                raise InputError(what, where=where, expected=expected, remedy=remedy)
        moving = np.array(city_logs.moving_instances(world), np.int32)

        def exact(view: View, _frame: Frame | None, _name: str) -> ViewTruth:
            truth = world.render(view)
            dynamic = torch.from_numpy(np.isin(truth.instance, moving))[None]
            return ViewTruth(world.observation(view, truth), dynamic, truth.instance, world.markings(view, truth))

        return Truth(True, exact)
    return Truth(False, lambda view, frame, _name: None if frame is None else ViewTruth(_recorded(scene, frame, view)))


def write_truth(scene: Path, trajectories: Sequence[Trajectory], out: Path) -> None:
    """Draw the truth of a generated city on some trajectories once, for many scores. InputError: the scene was not
    generated."""
    truth = truth_of(read_scene(scene))
    if not truth.exact:
        raise InputError("only a generated city has ground truth at every view", where=str(scene))
    with log.task("truth", sum(map(len, trajectories))) as bar:
        for path in trajectories:
            maps: dict[str, list[NDArray[Any]]] = {"moving": [], "instance": [], "marking": []}
            with ObservationWriter(out / path.name, path.name, "truth", "recorded") as writer:
                for view in path.views:
                    true = truth.at_view(view, None, path.name)
                    own = (true.moving[0].numpy().astype(np.uint8), true.instance, true.marking.astype(np.uint8))
                    for found, value in zip(maps.values(), own, strict=True):
                        found.append(value)
                    if len(maps["moving"]) <= writer.done:
                        writer.skip(view)  # an interrupted run wrote it
                    else:
                        writer.add(true.seen)
                    bar.advance()
            store.write_safetensors(out / path.name / MOVING_FILE, {k: np.stack(v) for k, v in maps.items()})


def stored_truth(folder: Path) -> Truth:
    """Truth that ``write_truth`` left in a folder. A view that it lacks is an InputError."""
    sets = {name: read_observations(path) for name, path in list_observation_sets(folder).items()}
    maps = {name: store.read_safetensors(folder / name / MOVING_FILE) for name in sets}

    def find(view: View, _frame: Frame | None, name: str) -> ViewTruth:
        stored = sets.get(name)
        if stored is None:
            what, got = "the folder of ground truth lacks a trajectory", ", ".join(sets)
            raise InputError(what, where=str(folder), expected=name, got=got)
        index = min(range(len(stored)), key=lambda i: abs(stored.views[i].time_s - view.time_s))
        there = stored.views[index]
        distance_m = apart_m(there, view)
        same_size = (there.camera.width, there.camera.height) == (view.camera.width, view.camera.height)
        if abs(there.time_s - view.time_s) > SAME_TIME_S or distance_m > SAME_PLACE_M or not same_size:
            size = lambda view: f"{view.time_s:.4f} s, {view.camera.width}x{view.camera.height}"
            what, where = "the stored ground truth shows another view", f"{folder / name}, view {index}"
            got = f"{size(there)}, {distance_m:.3f} m apart"
            raise InputError(what, where=where, expected=size(view), got=got)
        own = maps[name]
        moving = torch.from_numpy(own["moving"][index].astype(bool))[None]
        return ViewTruth(stored[index], moving, own["instance"][index], own["marking"][index].astype(bool))

    return Truth(True, find, stored=True)


def _recorded(scene: Scene, frame: Frame, view: View) -> Observation:
    """A recorded frame at the common size, with measured depth and the labels the log came with, never guessed ones."""
    height, width = view.camera.height, view.camera.width

    def label(name: str) -> NDArray[Any] | None:
        # a label with a confidence is a labeller's
        if name not in frame.labels or f"{name}_confidence" in frame.labels:
            return None
        return resize_nearest(read_label(scene, frame, name), height, width)

    ids, dense, ego = label("semantics"), label("depth"), label("ego")
    rgb = resize_rgb(torch.from_numpy(read_image(scene, frame).copy()).permute(2, 0, 1).float() / 255, height, width)
    depth = _lidar_depth(scene, view) if dense is None else torch.from_numpy(dense.copy())[None]
    semantics = None if ids is None else torch.from_numpy(ids.astype(np.int64))
    everywhere = torch.ones(1, height, width)
    mask = everywhere.bool() if ego is None else torch.from_numpy(ego == 0)[None]
    return Observation(view, rgb, depth, semantics, everywhere, mask, "recorded", "camera")


def _lidar_depth(scene: Scene, view: View) -> Tensor | None:
    """Depth f32[1, H, W] of the sweep taken with this frame (NaN where no point fell), or None without such a sweep."""
    sweeps = [s for s in scene.sweeps if abs(s.time_s - view.time_s) <= SAME_SWEEP_S]
    if not sweeps:
        return None
    clouds = [(sweep, read_points(scene, sweep).xyz) for sweep in sweeps]
    placed = [geometry.transform_points(sweep.world_from_lidar, xyz) for sweep, xyz in clouds]
    world = points_as_read(scene, view, np.concatenate(placed).astype(np.float32))
    gap_deg = max(largest_beam_gap(xyz) for _, xyz in clouds)
    return torch.from_numpy(visible_depth(view, world, HIDING_RULES["sweep"], gap_deg=gap_deg, far_m=MAX_LIDAR_M))[None]


# -- the LiDAR points of a log, for truth at views that no camera recorded -------------------------

MERGED_SWEEPS: Final = 6
"""Sweeps of each LiDAR whose points tell what the shown cameras saw."""
KEPT_SWEEPS: Final = 96


class LogPoints:
    """The LiDAR points of a log; threads may ask. The sweeps asked for last are kept."""

    def __init__(self, scene: Scene) -> None:
        self.scene = scene
        self._rules = FusionRules()
        self.dynamic: tuple[Track, ...] = tuple(t for t in scene.tracks if judge_track(t, self._rules).moving)
        self._sweeps = {sweep.id: sweep for sweep in scene.sweeps}
        self._sensors: dict[str, list[Sweep]] = {}
        for sweep in scene.sweeps:
            self._sensors.setdefault(sweep.sensor, []).append(sweep)
        self._sweep_points = functools.lru_cache(KEPT_SWEEPS)(self._read)

    def of_moment(self, time_s: float) -> OwnedPoints | None:
        """Points of the sweep of each LiDAR that was taken with an image, or None without one."""
        near = [nearest_sweeps(sweeps, time_s, 1) for sweeps in self._sensors.values()]
        return self._merged([s for found in near for s in found if abs(s.time_s - time_s) <= SAME_SWEEP_S])

    def around(self, time_s: float) -> OwnedPoints | None:
        """Points of the sweeps of each LiDAR that are nearest in time, or None where none is near."""
        every = (nearest_sweeps(sweeps, time_s, MERGED_SWEEPS) for sweeps in self._sensors.values())
        return self._merged([sweep for sweeps in every for sweep in sweeps])

    def placed(self, points: OwnedPoints, time_s: float) -> NDArray[np.float32]:
        """Where points are at a moment, f32[N, 3] in the world; NaN where their object has no box then."""
        return lidar.placed(points, self.dynamic, time_s)

    def colors(
        self, frame: Frame, points: OwnedPoints, world: NDArray[np.float32]
    ) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
        """Colours u8[N + 1, 3] that points have in a recorded image, and where it shows them
        (``points_seen.carried``)."""
        shown = points_as_read(self.scene, frame.view, world)
        return lidar.carried(frame.view, read_image(self.scene, frame), shown, points.gap_deg)

    def truth_at(self, view: View, frame: Frame | None) -> PointTruth | None:
        """What the points of the sweeps taken with a view say about it; None without such sweeps. ``frame``: the
        recorded image of that time, which gives the points' colours and classes, or None."""
        points = self.of_moment(view.time_s)
        if points is None or not len(points.xyz):
            return None
        world = self.placed(points, view.time_s)
        depth, index = lidar.visible(view, points_as_read(self.scene, view, world), points.gap_deg)
        color, colored = np.zeros((len(world) + 1, 3), np.uint8), np.zeros(len(world) + 1, bool)
        ids = np.append(points.ids, np.uint8(palette.UNLABELLED))
        if frame is not None:
            color, colored = self.colors(frame, points, world)
            if "semantics" in frame.labels and (ids == palette.UNLABELLED).all():
                label = np.asarray(read_label(self.scene, frame, "semantics"), np.uint8)
                camera = frame.view.camera
                label = resize_nearest(label, camera.height, camera.width)
                shown = points_as_read(self.scene, frame.view, world)
                values, known = lidar.carried(frame.view, label, shown, points.gap_deg)
                ids = np.where(known, values, np.uint8(palette.UNLABELLED))
        dynamic = np.append(points.owner != STATIC, False)[index]
        return PointTruth(depth, dynamic, color[index], colored[index], ids[index])

    def _merged(self, sweeps: Sequence[Sweep]) -> OwnedPoints | None:
        if not sweeps:
            return None
        parts = [self._sweep_points(sweep.id) for sweep in sweeps]
        joined = [np.concatenate([getattr(part, name) for part in parts]) for name in ("xyz", "owner", "ids")]
        return OwnedPoints(*joined, gap_deg=min(part.gap_deg for part in parts))

    def _read(self, sweep_id: str) -> OwnedPoints:
        sweep = self._sweeps[sweep_id]
        points = read_points(self.scene, sweep)
        shots = SweepShots(sweep.time_s, sweep.world_from_lidar, points, ())
        owner, owned = separate(shots, self.dynamic, self._rules)
        xyz = geometry.transform_points(sweep.world_from_lidar, points.xyz).astype(np.float32)
        for number, local in owned.items():
            xyz[owner == number] = local
        ids = np.full(len(xyz), palette.UNLABELLED, np.uint8) if points.classes is None else points.classes
        return OwnedPoints(xyz, owner, ids, largest_beam_gap(points.xyz))


def shown_frame(scene: Scene, frame: Frame, rgb: NDArray[np.uint8]) -> ShownFrame | None:
    """A frame with its dense depth, or None if it has no label of that kind."""
    if "depth" not in frame.labels:
        return None
    depth = read_label(scene, frame, "depth")
    return ShownFrame(frame.view, np.where(np.isfinite(depth), depth, np.inf).astype(np.float32), lidar.blurred(rgb))


# -- facts about views beside their true image: LiDAR points, vehicles, markings -------------------


def vehicles_of(scene: Scene) -> tuple[tuple[int, Track], ...]:
    """Number in the instance maps of a generated city, and track, of every vehicle; none of a recorded log."""
    if scene.source.recipe is None:
        return ()
    return tuple((int(t.id.rsplit("-", 1)[1]), t) for t in scene.tracks if t.label in VEHICLE_LABELS)


class FactMaker:
    """Makes the facts of views; threads may call."""

    def __init__(self, scene: Scene) -> None:
        self._scene, self._points, self.vehicles = scene, LogPoints(scene), vehicles_of(scene)
        self._path = driven_path(scene.ego.world_from_ego)

    def of(self, view: View, truth: ViewTruth | None) -> ViewFacts:
        """What is known of a view; ``truth``: its exact or recorded truth, if there is one."""
        near = (f for f in self.frames_of(view.camera.name) if abs(f.view.time_s - view.time_s) <= SAME_TIME_S)
        frame = next(near, None)  # what the view's camera recorded at its time
        points = self._points.truth_at(view, frame)
        if truth is not None and truth.instance is not None:
            agents, seen, lanes = visible_agents(view, self.vehicles, truth.instance), truth.seen, None
            if truth.marking is not None and seen.semantics is not None and seen.depth is not None:
                depth = seen.depth[0].numpy()
                road = (seen.semantics.numpy() == palette.ID["road"]) & (depth > 0) & (depth < street_scores.LANE_FAR_M)
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
            if (pose := track.pose_at(view.time_s)) is not None:
                outline = box_outline(view, pose, track.size_m)
                mask = mask if outline is None else mask | outline
        return mask


def known_of(facts: ViewFacts) -> set[str]:
    """What the facts of a view hold, as ``MetricRow.needs`` names it."""
    names = {"views"}
    if facts.points is not None and (facts.points.depth > 0).any():
        names.add("LiDAR points")
        if (facts.points.classes[facts.points.depth > 0] != palette.UNLABELLED).any():
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
    """One trajectory to score. ``shift_m``: 0 = the recorded path, None = neither it nor a plain shift. ``views``: at
    the common size. ``frames``: the recorded frame of each view on the recorded path, else None. ``sets``, ``indices``:
    of the methods that have it, and which of their views stand beside ``views``."""

    name: str
    camera: str
    shift_m: float | None
    views: tuple[View, ...]
    frames: tuple[Frame | None, ...]
    sets: Mapping[str, ObservationSet]
    indices: Mapping[str, tuple[int, ...]]

    def record(self) -> dict[str, Any]:
        """The trajectory as JSON values."""
        camera, indices = self.views[0].camera, {m: list(i) for m, i in self.indices.items()}
        names = {"name": self.name, "camera": self.camera, "shift_m": self.shift_m}
        sizes = {"views": len(self.views), "width": camera.width, "height": camera.height}
        return {**names, **sizes, "methods": list(self.sets), "indices": indices}


class Reference:
    """What every method is compared with, and how. ``truth``, ``baseline``: of any view. ``distances``: what computes
    the rows of the table that need weights, at ``distance_views`` views of a trajectory (0 = all). ``held_out``: ids of
    the recorded frames that count. ``facts``: makes what is known of views beside their true image."""

    def __init__(
        self,
        config: ScoreConfig,
        scene: Scene,
        truth: Truth,
        baseline: Baseline | None,
        distances: Mapping[str, PairDistance],
    ) -> None:
        self.truth, self.baseline, self.distances = truth, baseline, distances
        self.error_pictures, self.distance_views = config.error_pictures, config.perceptual_views
        self.held_out = frozenset(frame.id for frame in scene.frames_in("test") or scene.frames)
        self.facts = FactMaker(scene)

    def counted(self, trajectory: ScoredTrajectory) -> list[int]:
        """The views that count. Recorded training frames were seen by the fit and do not; views off the path never
        were."""
        return [n for n, frame in enumerate(trajectory.frames) if frame is None or frame.id in self.held_out]


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
