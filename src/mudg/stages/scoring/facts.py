"""Facts about views beside their true image: LiDAR points, vehicles, markings; and what recorded images score on them."""

from __future__ import annotations

from typing import Final

import numpy as np
import torch
from numpy.typing import NDArray

from mudg.base import geometry
from mudg.base.palette import ID, UNLABELLED
from mudg.base.types import Frame, Scene, Track, View
from mudg.core import lane_scores
from mudg.core.box_scores import VEHICLE_LABELS, visible_agents
from mudg.core.fusion import STATIC
from mudg.core.metrics import Pair
from mudg.core.view_facts import LaneFacts, ViewFacts
from mudg.core.view_metrics import AgentIou, LaneIou
from mudg.data.city import CityWorld
from mudg.data.city.world import CityTruth
from mudg.data.scene import read_image, read_label
from mudg.models.labels.ground import driven_path, ground_near
from mudg.models.labels.inputs import box_outline
from mudg.stages.score_truth import SAME_TIME_S, ViewTruth
from mudg.stages.scoring.log_points import LogPoints

ANCHORED: Final = ("agent_iou", "lane_iou")
"""Metrics that are also shown for the recorded images at recorded views."""


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
        self._anchors: dict[str, dict[str, float]] = {}

    def of(self, view: View, truth: ViewTruth | None) -> ViewFacts:
        """What is known of a view; ``truth``: its exact or recorded truth, if there is one."""
        frame = self._frame_at(view)
        points = self._points.truth_at(view, frame)
        if truth is not None and truth.instance is not None:
            return ViewFacts(
                points, visible_agents(view, self._vehicles, truth.instance), exact_lanes(truth), truth.instance
            )
        return ViewFacts(points, None, None if frame is None else self._carried_lanes(view, frame))

    def recorded(self, camera: str) -> dict[str, float]:
        """What the recorded images of a camera score at their own views, by metric; empty where exact truth is missing there."""
        if camera not in self._anchors:
            self._anchors[camera] = self._recorded(camera) if self._scene.source.recipe is not None else {}
        return self._anchors[camera]

    def frames_of(self, camera: str) -> tuple[Frame, ...]:
        """The recorded frames of a camera; none if the scene lacks it."""
        return self._scene.frames_of(camera) if camera in self._scene.cameras else ()

    def _frame_at(self, view: View) -> Frame | None:
        """The image that the view's camera recorded at its time."""
        return next(
            (f for f in self.frames_of(view.camera.name) if abs(f.view.time_s - view.time_s) <= SAME_TIME_S), None
        )

    def _carried_lanes(self, view: View, frame: Frame) -> LaneFacts | None:
        """Markings of a recorded image where the ground shows them in another view. Without LiDAR there is no ground."""
        points = self._points.around(view.time_s)
        if points is None:
            return None
        plane = ground_near(points.xyz[points.owner == STATIC], self._path, view.center_world)
        if plane is None:
            return None
        places = lane_scores.plane_points(view, plane)
        rgb = np.asarray(read_image(self._scene, frame)).transpose(2, 0, 1) / np.float32(255)
        colors, shown = lane_scores.seen_from(frame.view, rgb, places)
        free = np.asarray(~self._boxes(frame.view))[None].astype(np.float32)
        beside = (geometry.transform_points(view.cam_from_world, places.reshape(-1, 3))[:, 0]).reshape(shown.shape)
        with np.errstate(invalid="ignore"):
            road = shown & (np.abs(beside) < lane_scores.NTL_BESIDE_M) & ~self._boxes(view)
        road &= lane_scores.seen_from(frame.view, free, places)[0][0] > 0.99
        marking = lane_scores.bright_stripes(colors, road)
        band = lane_scores.lane_band(marking) & road
        return LaneFacts(road, marking, band, colors.astype(np.float32), exact=False)

    def _boxes(self, view: View) -> NDArray[np.bool_]:
        """Outlines of all tracked boxes, bool[H, W]."""
        mask = np.zeros((view.camera.height, view.camera.width), bool)
        for track in self._scene.tracks:
            pose = track.pose_at(view.time_s)
            outline = None if pose is None else box_outline(view, pose, track.size_m)
            mask = mask if outline is None else mask | outline
        return mask

    def _recorded(self, camera: str) -> dict[str, float]:
        found: dict[str, AgentIou | LaneIou] = {"agent_iou": AgentIou(), "lane_iou": LaneIou()}
        world = CityWorld.from_source(self._scene.source)
        for frame in self._scene.frames_of(camera):
            if not {"depth", "semantics", "instance"} <= frame.labels.keys():
                return {}
            seen = recorded_truth(self._scene, frame)
            pair = recorded_pair(frame.view, seen, world, self._vehicles)
            for metric in found.values():
                metric.add(metric.source(pair))  # type: ignore[arg-type]
        values = {name: metric.value() for name, metric in found.items()}
        return {name: round(value, 6) for name, value in values.items() if value is not None}


def recorded_truth(scene: Scene, frame: Frame) -> CityTruth:
    """A recorded image of a generated city with its exact labels."""
    depth, ids, instance = (read_label(scene, frame, name) for name in ("depth", "semantics", "instance"))
    rgb = (np.asarray(read_image(scene, frame)) / np.float32(255)).astype(np.float32)
    return CityTruth(rgb, np.asarray(depth, np.float32), np.asarray(ids, np.uint8), np.asarray(instance, np.int32))


def recorded_pair(view: View, seen: CityTruth, world: CityWorld, vehicles: tuple[tuple[int, Track], ...]) -> Pair:
    """A recorded image of a generated city held against the exact truth of its own view."""
    rgb, ids = torch.from_numpy(seen.rgb).permute(2, 0, 1), torch.from_numpy(seen.semantics.astype(np.int64))
    road = (seen.semantics == ID["road"]) & (seen.depth < lane_scores.LANE_FAR_M)
    marking = world.markings(view, seen) & road
    lanes = LaneFacts(road, marking, lane_scores.lane_band(marking), rgb.numpy(), exact=True)
    facts = ViewFacts(agents=visible_agents(view, vehicles, seen.instance), lanes=lanes)
    return Pair(rgb, None, ids, rgb, None, None, ids, view=view, facts=facts)


def exact_lanes(truth: ViewTruth) -> LaneFacts | None:
    """Markings of a view with exact truth."""
    seen = truth.seen
    if truth.marking is None or seen.semantics is None or seen.depth is None:
        return None
    depth = seen.depth[0].numpy()
    road = (seen.semantics.numpy() == ID["road"]) & (depth > 0) & (depth < lane_scores.LANE_FAR_M)
    marking = truth.marking & road
    return LaneFacts(road, marking, lane_scores.lane_band(marking), seen.rgb.numpy(), exact=True)


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
