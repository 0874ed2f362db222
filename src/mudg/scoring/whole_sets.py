"""What compares whole sets of views after they have been scored one by one: distances of images and clips, detectors,
and anchors."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from mudg.base import log
from mudg.base.errors import InputError
from mudg.base.types import Scene
from mudg.core.pictures import to_bytes
from mudg.editing.settings import ScoreConfig
from mudg.scene.observations import ObservationSet, read_observations
from mudg.scoring import detections, sets
from mudg.scoring.detections import BoxDetections, LaneDetections, ViewImages
from mudg.scoring.facts import ANCHORED, Reference, ScoredTrajectory
from mudg.scoring.sets import ImageSet, TrajectorySets
from mudg.scoring.tables import SET_SIZES

BASELINE: Final = "nearest_fill"
Rows = Sequence[dict[str, Any]]
ENTRIES: Final = {"distributions": "distribution", "videos": "video"}
"""Entry of metrics.json that says how numbers were made -> that of a result with their sizes, where it differs."""


@dataclass(frozen=True)
class SetScores:
    """What is computed of whole sets, as far as its weights or files were given. ``comparisons``: entry of metrics.json
    -> what compares images or clips. ``detected``: metric -> entry of a result, and what holds detections against the
    truth."""

    comparisons: Mapping[str, sets.SetComparison]
    video_features: sets.VideoFeatures | None
    detected: Mapping[str, tuple[str, BoxDetections | LaneDetections]]

    def add_to(self, results: Rows, trajectories: Sequence[ScoredTrajectory], reference: Reference, out: Path) -> None:
        """Add to the results what compares whole sets of views."""
        if not self.records():
            return
        with log.task("features", len(results)) as bar:
            for trajectory in trajectories:
                rows = [row for row in results if row["trajectory"] == trajectory.name]
                bar.update(trajectory.name)
                self._add(trajectory, rows, reference, out)
                bar.advance(len(rows))

    def _add(self, trajectory: ScoredTrajectory, rows: Rows, reference: Reference, out: Path) -> None:
        counted, every = trajectory.counted(reference.held_out), range(len(trajectory.views))
        for name, comparison in self.comparisons.items():
            images = _sets_of(trajectory, reference, out, counted if name == "distributions" else every)
            of_video = () if name in ENTRIES else (counted, trajectory.views)
            _add_named(rows, ENTRIES.get(name, name), comparison.of(images, *of_video))
        if self.video_features is not None:
            methods = [row["method"] for row in rows]
            _add_named(rows, "video_features", self.video_features.of(trajectory.name, trajectory.camera, methods))
        for metric, (entry, source) in self.detected.items():
            _add_detected(rows, metric, entry, source, trajectory, counted, reference)

    def records(self) -> dict[str, Any]:
        """How the numbers were made, by entry of metrics.json."""
        found = {name: comparison.record() for name, comparison in self.comparisons.items()}
        if self.video_features is not None:
            found["video_features"] = self.video_features.record()
        if self.detected:
            found["detections"] = {metric: source.record() for metric, (_, source) in self.detected.items()}
        return found


def set_scores_of(config: ScoreConfig, scene: Scene, out: Path) -> SetScores:
    """What the given weights and files allow to compute. InputError: a file is missing, damaged, or holds another
    network, or the log has no lane lines."""
    makers = {
        "distributions": (config.fid_weights, sets.distributions_of),
        "videos": (config.fvd_weights, sets.videos_of),
        "dinov2": (config.dino_weights, sets.dino_of),
        "clip": (config.clip_weights, sets.clip_of),
    }
    comparisons = {name: make(config, scene, out) for name, (weights, make) in makers.items() if weights}
    features = sets.VideoFeatures(Path(config.video_features)) if config.video_features else None
    detected: dict[str, tuple[str, BoxDetections | LaneDetections]] = {}
    if config.detections:
        detected["nta_iou"] = ("nta", BoxDetections(scene, Path(config.detections), config.as_published))
    if config.lanes:
        detected["ntl_iou"] = ("ntl", LaneDetections(scene, Path(config.lanes)))
    return SetScores(comparisons, features, detected)


def anchors_of(results: Rows, trajectories: Sequence[ScoredTrajectory], reference: Reference) -> list[dict[str, Any]]:
    """What stands beside a metric's values on a trajectory: the same of the true images (``truth``), of the recorded
    images at their own views (``recorded``), and of ``nearest_fill``. Taken out of the results."""
    found = []
    for trajectory in trajectories:
        rows = [row for row in results if row["trajectory"] == trajectory.name]
        anchors: dict[str, dict[str, float]] = {}
        for row in rows:
            for name, value in row.pop("truth", {}).items():
                anchors.setdefault(name, {})["truth"] = value
            for name, own in row.pop("anchors", {}).items():
                anchors.setdefault(name, {}).update(own)
        recorded = reference.facts.recorded(trajectory.camera) if set(ANCHORED) & anchors.keys() else {}
        for name in recorded.keys() & anchors.keys():
            anchors[name]["recorded"] = recorded[name]
        for row in rows:
            if row["method"] == BASELINE:
                for name, own in anchors.items():
                    if not isinstance(row["values"].get(name), str):
                        own[BASELINE] = row["values"][name]
        found += [{"trajectory": trajectory.name, "metric": name, **own} for name, own in sorted(anchors.items())]
    return found


def _sets_of(trajectory: ScoredTrajectory, reference: Reference, out: Path, counted: Sequence[int]) -> TrajectorySets:
    """The images at the counted views of a trajectory whose views have been scored and written."""

    def chosen(views: ObservationSet, indices: Sequence[int]) -> ImageSet:
        return ImageSet(len(counted), lambda number: views.rgb_u8(indices[counted[number]]))

    def true_image(number: int) -> NDArray[np.uint8]:
        place = counted[number]
        true = reference.truth.at_view(trajectory.views[place], trajectory.frames[place], trajectory.name)
        if true is None:
            raise InputError("a view has no ground truth", where=f"{trajectory.name}, view {place}")
        return to_bytes(true.seen.rgb)

    methods = {name: chosen(found, trajectory.indices[name]) for name, found in trajectory.sets.items()}
    every = range(len(trajectory.views))
    if reference.baseline is not None:
        methods = {BASELINE: chosen(read_observations(out / BASELINE / trajectory.name), every), **methods}
    truth = None
    if reference.truth.exact and trajectory.shift_m != 0.0:
        if reference.truth.stored:
            truth = ImageSet(len(counted), true_image)
        else:
            truth = chosen(read_observations(out / "truth" / trajectory.name), every)
    camera = trajectory.views[0].camera
    return TrajectorySets(trajectory.name, trajectory.camera, camera.width, camera.height, methods, truth)


def _add_named(rows: Rows, entry: str, found: Mapping[str, dict[str, Any] | str]) -> None:
    """Values of several metrics by method, and what stands beside them, into the results of one trajectory."""
    for row in rows:
        of = found[row["method"]]
        row["values"] |= dict(of["values"]) if not isinstance(of, str) else dict.fromkeys(SET_SIZES[entry], of)
        if not isinstance(of, str) and "n" in of:
            row[entry] = {name: value for name, value in of.items() if name != "values"}


def _add_detected(
    rows: Rows,
    metric: str,
    entry: str,
    source: BoxDetections | LaneDetections,
    trajectory: ScoredTrajectory,
    counted: Sequence[int],
    reference: Reference,
) -> None:
    """NTA-IoU or NTL-IoU into the results of one trajectory, with its anchors."""
    views = tuple(trajectory.views[n] for n in counted)
    frames = reference.facts.frames_of(trajectory.camera)
    recorded = f"{detections.RECORDED}/{trajectory.camera}"
    there = {
        "truth": ViewImages(f"{detections.TRUTH}/{trajectory.name}", tuple(counted), views),
        "recorded": ViewImages(recorded, tuple(range(len(frames))), tuple(frame.view for frame in frames)),
    }
    beside = {name: value["value"] for name, images in there.items() if not isinstance(value := source.of(images), str)}
    for row in rows:
        indices = trajectory.indices.get(row["method"], tuple(range(len(trajectory.views))))
        images = ViewImages(f"{row['method']}/{trajectory.name}", tuple(indices[n] for n in counted), views)
        value = source.of(images)
        row["values"][metric] = value if isinstance(value, str) else value["value"]
        row.setdefault("anchors", {})[metric] = beside
        if isinstance(value, str):
            continue
        row[entry] = {k: v for k, v in value.items() if k != "value"}
        if isinstance(source, LaneDetections):
            row[entry]["against_detector"] = source.against(images, there["truth"])
