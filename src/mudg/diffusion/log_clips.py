"""Training clips from recorded logs: windows of consecutive frames of one camera, seen from where they were recorded.

Truth is what was recorded; the condition is what `synthesize` would build for these views without their own images, and
with a share of the points left out. Points keep the colours that fusing gave them, as in the published system. Held-out
frames of the scene are never read, and no training window shows a moment of a window for scoring.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from mudg.base import geometry, palette, seeds, store
from mudg.base.config import differences
from mudg.base.errors import InputError, UsageError
from mudg.base.types import Clip, Condition, Frame, FusedCloud, Photo, PointCloud, Scene, Sweep, View
from mudg.core.pictures import resize_area, resize_nearest
from mudg.core.project import RULES as HIDING_RULES
from mudg.core.project import DrawLimits, PointLayer, draw_points, seen_pixels
from mudg.diffusion.clips import FAR_M, shard_path, write_shard
from mudg.diffusion.condition import (
    SAME_TIME_S,
    ConditionRules,
    DriveInputs,
    build_conditions,
    filled_depth,
    image_tensor,
)
from mudg.scene.clouds import read_fused
from mudg.scene.labels import photographs, read_label, read_trusted_classes
from mudg.scene.read import read_image, read_points, read_scene

INDEX = "log_clips.json"
SKY = palette.ID["sky"]
FINE = 2
"""Colours are gathered at so many times the clip's size."""


@dataclass(frozen=True)
class LogClipRules:
    """How windows are cut from a log. Sizes are those of the clips."""

    width: int
    height: int
    window: int = 8
    stride: int = 4
    """Frames from one window's start to the next one's."""
    cameras: tuple[str, ...] = ()
    """Cameras to take clips from (empty = all of the scene)."""
    held_out_every: int = 5
    """Every n-th window is for scoring (0 = none)."""
    farthest: int = 4
    """Nearest usable image of a view: up to so many moments away (held-out windows: always 2, or this if less)."""
    least_points: float = 0.3
    """Smallest share of the cloud's points that a training window keeps."""
    seed: int = 0
    published: bool = False
    """The published system's condition: points alone, 0 where nothing was seen, projected at the camera's size; the
    reference is the window's first image."""

    def windows(self, scene: Scene) -> list[LogWindow]:
        """All windows of a scene, camera by camera in time order. Frames held out for scoring the scene, and images
        that are rendered in part (of an edited drive), are passed over. InputError: unknown camera, or no camera has
        enough frames."""
        usable = {frame.id for frame in photographs(scene)}
        found: list[LogWindow] = []
        for camera in self.cameras or tuple(scene.cameras):
            frames = sorted((f for f in scene.frames_of(camera) if f.id in usable), key=lambda f: f.view.time_s)
            for start in range(0, len(frames) - self.window + 1, self.stride):
                number = start // self.stride
                kept = self.held_out_every > 0 and number % self.held_out_every == self.held_out_every // 2
                found.append(LogWindow(tuple(f.id for f in frames[start : start + self.window]), kept))
        if not found:
            what = "a log is too short for a training clip"
            remedy = "give a shorter --data.window, or ingest with --test-every 0"
            raise InputError(what, where=scene.root, expected=f"{self.window} frames of a camera", remedy=remedy)
        time_of = {frame.id: frame.view.time_s for frame in scene.frames}
        scored = {time_of[name] for window in found if window.held_out for name in window.frames}
        return [w for w in found if w.held_out or not scored & {time_of[name] for name in w.frames}]


class LogWindow(NamedTuple):
    """One clip to be: the frames of one camera (their ids), and whether it is for scoring."""

    frames: tuple[str, ...]
    held_out: bool


@dataclass(frozen=True)
class LogSource:
    """A recorded log: where its scene and its fused cloud lie."""

    scene: Path
    fused: Path


def log_source(text: str) -> LogSource:
    """The log that SCENE=FUSED names, or the output folder of `mudg run` (labels of annotate are taken if there are
    some). InputError: no scene or no cloud there."""
    scene, separator, fused = text.partition("=")
    if separator:
        found = LogSource(Path(scene), Path(fused))
    else:
        run = Path(text)
        labelled = run / "annotate"
        found = LogSource(labelled if (labelled / "scene.json").is_file() else run / "scene", run / "fuse")
    if not (found.fused / "fuse.json").is_file() or not found.scene.exists():
        what, remedy = "no scene with a fused cloud here", "make the cloud with `mudg fuse`"
        raise InputError(what, where=text, expected="SCENE=FUSED, or an output folder of mudg run", remedy=remedy)
    return found


class OpenLog:
    """A log from which clips are made: scene, cloud, and the images around the window that is being made."""

    def __init__(self, source: LogSource, rules: LogClipRules) -> None:
        self.scene, self.cloud, self.rules = read_scene(source.scene), read_fused(source.fused), rules
        self._frames = sorted(photographs(self.scene), key=lambda f: f.view.time_s)
        self.place = {frame.id: number for number, frame in enumerate(self._frames)}
        times = np.array([f.view.time_s for f in self._frames])
        apart = np.diff(times) > SAME_TIME_S
        self.moment: list[int] = np.concatenate([[0], np.cumsum(apart)]).tolist()
        self._read: dict[int, Photo] = {}

    def frame(self, frame_id: str) -> Frame:
        """The frame with this id."""
        return self._frames[self.place[frame_id]]

    def images(self, first: int, last: int) -> dict[int, Photo]:
        """The recorded images of the moments `first` to `last`, by place in time; others are forgotten."""
        wanted = [n for n, moment in enumerate(self.moment) if first <= moment <= last]
        self._read = {n: self._read[n] if n in self._read else self._recorded(n) for n in wanted}
        return self._read

    def _recorded(self, number: int) -> Photo:
        frame = self._frames[number]
        classes = read_trusted_classes(self.scene, frame)
        return Photo(frame.view, read_image(self.scene, frame), classes)


def make_clip(log: OpenLog, window: LogWindow, number: int) -> Clip:
    """The clip of one window; what is left out of its condition is drawn from (seed of the rules, `number`)."""
    rules = log.rules
    rng = seeds.numpy_rng(rules.seed, number, "log clip")
    gap = min(2, rules.farthest) if window.held_out else int(rng.integers(1, rules.farthest + 1))
    share = 1.0 if window.held_out else rng.uniform(rules.least_points, 1.0)
    cloud = log.cloud if share == 1.0 else thinned_cloud(log.cloud, share, rng)
    places = [log.place[name] for name in window.frames]
    condition, images = _condition(log, cloud, places, gap)
    truths = [
        _truth(log, log.frame(name), images[place], view)
        for name, place, view in zip(window.frames, places, condition.views)
    ]
    rgb, depth, confidence, ids = (torch.stack(column) for column in zip(*truths))
    known = confidence > 0
    given = condition.depth if condition.measured is None else filled_depth(condition.measured)
    depth = torch.where(known, depth, given)  # a plausible filling: the noisy input shows it
    sure = bool((confidence[known] == 1).all())
    return Clip(condition, rgb, depth, known, ids, depth_confidence=None if sure else confidence)


def _condition(log: OpenLog, cloud: FusedCloud, places: Sequence[int], gap: int) -> tuple[Condition, dict[int, Photo]]:
    """The condition of some frames from images at least `gap` moments away (the published one: from the first frame's
    own), and all images read, by place in time."""
    rules, (first, last) = log.rules, (log.moment[places[0]], log.moment[places[-1]])
    size = rules.width, rules.height
    conditions = ConditionRules(*size, rules.width * FINE, rules.height * FINE)
    margin = 0 if rules.published else gap + conditions.images_per_view  # at a log's end all are of one side
    images = log.images(first - margin, last + margin)
    recorded, among = list(images.values()), None
    if rules.published:
        camera, recorded = images[places[0]].view.camera, [images[places[0]]]
        conditions = ConditionRules(*size, camera.width, camera.height, published=True)
    else:
        moments = [log.moment[n] for n in images]
        among = [[n for n, moment in enumerate(moments) if abs(moment - log.moment[place]) >= gap] for place in places]
    views = [images[place].view for place in places]
    drive = DriveInputs(cloud, log.scene.tracks, recorded)
    return build_conditions(drive, views, conditions, among=among)[0], images


def thinned_cloud(cloud: FusedCloud, share: float, rng: np.random.Generator) -> FusedCloud:
    """A random `share` of the points of every cloud."""

    def part(points: PointCloud) -> PointCloud:
        keep = rng.random(len(points)) < share
        semantics = None if points.semantics is None else points.semantics[keep]
        return PointCloud(points.xyz[keep], points.rgb[keep], points.frame, semantics)

    return FusedCloud(part(cloud.static), {name: part(points) for name, points in cloud.objects.items()}, cloud.colors)


def _truth(log: OpenLog, frame: Frame, recorded: Photo, view: View) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """rgb f32[3,H,W], depth f32[1,H,W] metres, its confidence f32[1,H,W] (1 = measured, 0 = unknown) and classes
    i64[H,W], all at the size of `view`. Where classes or labels say sky, depth is far away."""
    scene, (width, height) = log.scene, (view.camera.width, view.camera.height)
    rgb = image_tensor(resize_area(recorded.rgb, width, height))
    ids = np.full((height, width), palette.UNLABELLED, np.uint8)
    if recorded.semantics is not None:
        ids = resize_nearest(recorded.semantics, height, width)
    depth, known = measured_depth(scene, view)
    confidence, sky = known.astype(np.float32), (ids == SKY) & ~known
    if "depth" in frame.labels:
        label = lambda name: resize_nearest(read_label(scene, frame, name), height, width)
        labelled = label("depth")
        sure = label("depth_confidence") if "depth_confidence" in frame.labels else np.float32(1)
        more = ~known & ~sky & np.isfinite(labelled) & ~(label("ego") if "ego" in frame.labels else np.False_)
        depth, confidence = np.where(more, labelled, depth), np.where(more, sure, confidence)
        if "sky" in frame.labels:  # made labels have a depth there, too
            depth = np.where(more & label("sky"), np.float32(FAR_M), depth)
    depth, confidence = np.where(sky, np.float32(FAR_M), depth), np.where(sky, np.float32(1), confidence)
    planes = (torch.from_numpy(x.astype(np.float32))[None] for x in (depth, confidence))
    return rgb, *planes, torch.from_numpy(ids.astype(np.int64))


def measured_depth(scene: Scene, view: View) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Depth f32[H,W] of the sweep taken with an image and where it measured; points seen through gaps are left out."""
    sweeps: list[Sweep] = [s for s in scene.sweeps if abs(s.time_s - view.time_s) <= SAME_TIME_S]
    if not sweeps:
        empty = np.zeros((view.camera.height, view.camera.width), np.float32)
        return empty, empty > 0
    nearest: dict[str, Sweep] = {}
    for sweep in sweeps:  # one of each sensor
        other = nearest.get(sweep.sensor)
        if other is None or abs(sweep.time_s - view.time_s) < abs(other.time_s - view.time_s):
            nearest[sweep.sensor] = sweep
    places = [geometry.transform_points(s.world_from_lidar, read_points(scene, s).xyz) for s in nearest.values()]
    layer = PointLayer(np.concatenate(places).astype(np.float32), np.eye(4))
    depth, index = draw_points([layer], view, DrawLimits(1.0, 100.0))
    return depth, seen_pixels(depth, index >= 0, HIDING_RULES["condition"])


# files --------------------------------------------------------------------------------------------


def plan_shards(
    sources: Sequence[LogSource], rules: LogClipRules, first_held_out: int
) -> list[tuple[int, LogSource, LogWindow]]:
    """What shards there will be, one clip each: (number, log, window); numbers from 0 to train on, from
    `first_held_out` to score. InputError: a log is too short, or holding out leaves nothing to train on."""
    rows: list[tuple[int, LogSource, LogWindow]] = []
    counts = {False: 0, True: 0}
    for source in sources:
        for window in rules.windows(read_scene(source.scene)):
            rows.append((counts[window.held_out] + (first_held_out if window.held_out else 0), source, window))
            counts[window.held_out] += 1
    if not counts[False] or (rules.held_out_every and not counts[True]):
        raise InputError(
            "the logs are too short to hold out windows",
            where=", ".join(str(s.scene) for s in sources),
            got=f"{counts[False]} windows to train on, {counts[True]} to score",
            remedy="smaller --data.stride or --data.window, or --data.held-out-every 0 (scores are then of clips"
            " trained on)",
        )
    return rows


def write_log(source: LogSource, rules: LogClipRules, windows: Sequence[tuple[int, LogWindow]], folder: Path) -> int:
    """Write the shards of one log that are not there yet; returns how many were made."""
    missing = [(n, w) for n, w in windows if not shard_path(folder, n).is_file()]
    if missing:
        log = OpenLog(source, rules)
        for number, window in missing:
            write_shard(folder, number, [make_clip(log, window, number)], gaps=True)
    return len(missing)


def claim_folder(folder: Path, rules: LogClipRules, sources: Sequence[LogSource]) -> None:
    """Write down what the shards of a folder are made of; UsageError if they are made of something else."""
    inputs = [[store.digest(s.scene), store.digest(s.fused)] for s in sources]
    stated = {name: value for name, value in asdict(rules).items() if name != "published" or value}
    wanted = {"rules": store.parse_json(store.json_text(stated), INDEX), "logs": inputs}
    path = folder / INDEX
    if path.is_file():
        found = store.read_json(path)
        if found != wanted:
            what, remedy = "the folder holds training clips of other logs or settings", "give another --data.clips"
            raise UsageError(what, where=str(folder), got="; ".join(differences(found, wanted)[:4]), remedy=remedy)
        return
    if folder.is_dir() and any(folder.glob("*.safetensors")):
        raise UsageError("the folder holds other training clips", where=str(folder), remedy="give another --data.clips")
    store.write_json(path, wanted)
