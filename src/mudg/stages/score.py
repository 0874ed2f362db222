"""``mudg score``: what the methods rendered, against the truth.

For a generated city the truth is exact at any view. For a recorded log it is the held-out recorded frames, and nothing
at shifted views. OUT holds metrics.json, metrics.md, truth/<trajectory>/ and nearest_fill/<trajectory>/ (observations)
and errors/*.png.
"""

from __future__ import annotations

import contextlib
import re
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image
from scipy.ndimage import distance_transform_edt
from torch import Tensor

from mudg import native
from mudg.base import config as configuration
from mudg.base import log, palette, store
from mudg.base.errors import InputError, UsageError
from mudg.base.types import Frame, FusedCloud, Observation, Scene, View
from mudg.core import metrics, project
from mudg.core.pictures import error_image, resize_nearest, resize_rgb, to_bytes
from mudg.data.cloudfile import read_fused
from mudg.data.observations import ObservationSet, ObservationWriter, list_observation_sets, read_observations
from mudg.data.scene import read_scene
from mudg.models.featnets import CodecFeatures, LpipsFeatures, PerceptualDistance
from mudg.models.mdm import files as mdm_files
from mudg.report import score_tables
from mudg.stages.config import ScoreConfig
from mudg.stages.score_truth import (
    SAME_PLACE_M,
    SAME_TIME_S,
    TrueView,
    Truth,
    stored_truth,
    truth_of,
)

Made = TypeVar("Made")
BASELINE: Final = "nearest_fill"
BASELINE_DRAWING: Final = project.ProjectConfig(static_splat_px=2.5, object_splat_px=4.0, occluder_m=0.3)
DEPTH_LIMIT_M: Final = 80.0
_VERSION: Final = 2
_NAME: Final = re.compile(r"(?P<camera>.+?)_(?:recorded|shift(?P<shift>[+-]\d+(?:\.\d+)?))(?P<more>.*)")


@dataclass(frozen=True)
class Course:
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


Baseline = Callable[[View], Observation]


@dataclass(frozen=True)
class Yardstick:
    """What every method is held against."""

    truth: Truth
    baseline: Baseline | None
    held_out: frozenset[str]
    error_pictures: bool
    distances: Mapping[str, Callable[[metrics.Pair], float | None]]
    """What computes the rows of the table that need weights."""
    distance_views: int
    """At so many views of a trajectory, evenly spread."""


def run(
    config: ScoreConfig, scene: Path, methods: Mapping[str, Path], out: Path, *, fused: Path | None = None,
    truth: Path | None = None, overwrite: bool = False,
) -> Path:  # fmt: skip
    """Score every trajectory of every method and write ``out``.

    Args:
        config: settings.
        scene: the scene that was rendered.
        methods: name -> folder of observation folders (output of render or synthesize).
        out: folder to write.
        fused: clouds made by fuse, for the baseline; without them there is none.
        truth: folder of ``score_truth.write_truth`` for this scene, to be read instead of drawing the truth again.
        overwrite: replace what other settings or inputs left in ``out``.

    Raises:
        UsageError: no method given. InputError: nothing to score, or methods disagree about a trajectory's views.
    """
    if not methods:
        raise UsageError("nothing to score", expected="at least one method with its folder of rendered views")
    inputs = {"scene": store.digest(scene)} | {name: store.digest(folder) for name, folder in methods.items()}
    if fused is not None and config.baseline:
        inputs["fused"] = store.digest(fused)
    if config.lpips_weights:
        inputs["lpips_weights"] = store.digest(Path(config.lpips_weights))
    if truth is not None:
        inputs["truth"] = store.digest(truth)
    work = store.RunDir.open(out, "score", configuration.to_dict(config), inputs, version=_VERSION, overwrite=overwrite)
    if work.complete:
        return work.reused()
    recorded = read_scene(scene)
    true = truth_of(recorded) if truth is None else stored_truth(truth)
    courses = _courses(config, recorded, methods)
    baseline = baseline_of(recorded, read_fused(fused)) if fused is not None and config.baseline else None
    held_out = frozenset(f.id for f in recorded.frames_in("test")) or frozenset(f.id for f in recorded.frames)
    yardstick = Yardstick(true, baseline, held_out, config.error_pictures, _distances(config), config.perceptual_views)
    results: list[dict[str, Any]] = []
    with log.task("score", sum(len(course.views) for course in courses)) as bar:
        for course in courses:
            bar.update(course.name)
            results += _score_course(course, yardstick, out, bar.advance)
    names = [*([BASELINE] if baseline is not None else []), *methods]
    rows = {
        name: {"title": row.title, "unit": row.unit, "better": row.better, "needs": list(row.needs)}
        for name, row in metrics.METRICS.items()
    }
    record = courses_record(courses)
    document = score_tables.document(recorded, true.exact, record, names, results, rows, DEPTH_LIMIT_M)
    store.write_json(out / "metrics.json", document)
    store.write_text(out / "metrics.md", score_tables.markdown(document))
    work.finish({"trajectories": len(courses), "methods": names})
    return out


def _distances(config: ScoreConfig) -> dict[str, Callable[[metrics.Pair], float | None]]:
    """The rows that need weights and have them."""
    found: dict[str, Callable[[metrics.Pair], float | None]] = {}
    if config.perceptual_views:
        found["perceptual"] = PerceptualDistance(CodecFeatures(mdm_files.load("embedded").codec))
    if config.lpips_weights:
        state = {name: torch.from_numpy(v.copy()) for name, v in store.read_safetensors(Path(config.lpips_weights)).items()}
        network = LpipsFeatures(state, config.lpips_weights)
        found["lpips"] = PerceptualDistance(network, network.channel_weights)
    return found


def summary_table(out: Path) -> str:
    """The main numbers of a finished score folder as plain text for a terminal."""
    return score_tables.plain(store.read_json(Path(out) / "metrics.json"))


# ---- what is compared with what ----


def _courses(config: ScoreConfig, scene: Scene, methods: Mapping[str, Path]) -> list[Course]:
    sets = {
        method: {name: read_observations(path) for name, path in list_observation_sets(folder).items()}
        for method, folder in methods.items()
    }
    names = sorted({name for of in sets.values() for name in of}, key=_order)
    if not names:
        raise InputError(
            "none of the folders holds rendered views", where=", ".join(str(p) for p in methods.values()),
            expected="output of mudg render or mudg synthesize",
        )  # fmt: skip
    return [_course(config, scene, name, {m: of[name] for m, of in sets.items() if name in of}) for name in names]


def _order(name: str) -> tuple[str, float, str]:
    found = _NAME.fullmatch(name)
    return (found["camera"], float(found["shift"] or 0), name) if found else (name, 1e9, name)


def _course(config: ScoreConfig, scene: Scene, name: str, sets: Mapping[str, ObservationSet]) -> Course:
    """Match the methods' views by time; keep those that all have, so that all are scored on the same ones."""
    times = {m: np.array([v.time_s for v in of.views]) for m, of in sets.items()}
    indices: dict[str, list[int]] = {m: [] for m in sets}
    views: list[View] = []
    for view in next(iter(sets.values())).views:
        nearest = {m: int(np.argmin(np.abs(t - view.time_s))) for m, t in times.items() if len(t)}
        if len(nearest) < len(sets) or any(abs(times[m][i] - view.time_s) > SAME_TIME_S for m, i in nearest.items()):
            continue
        for method, index in nearest.items():
            apart_m = float(np.linalg.norm(sets[method].views[index].center_world - view.center_world))
            if apart_m > SAME_PLACE_M:
                raise InputError("two methods rendered one trajectory from different places",
                                 where=f"{name}: {method}, view {index}", got=f"{apart_m:.3f} m apart")  # fmt: skip
            indices[method].append(index)
        views.append(_sized(config, scene, view))
    if not views:
        raise InputError("the methods have no view in common", where=name, got=", ".join(sets))
    found = _NAME.fullmatch(name)
    shift_m = float(found["shift"] or 0.0) if found is not None and not found["more"] else None
    camera = views[0].camera.name
    frames = tuple(_frame_at(scene, camera, view) if shift_m == 0.0 else None for view in views)
    return Course(name, camera, shift_m, tuple(views), frames, sets, {m: tuple(i) for m, i in indices.items()})


def courses_record(courses: list[Course]) -> list[dict[str, Any]]:
    """The trajectories as JSON values."""
    return [
        {
            "name": course.name, "camera": course.camera, "shift_m": course.shift_m, "views": len(course.views),
            "width": course.views[0].camera.width, "height": course.views[0].camera.height,
            "methods": list(course.sets), "indices": {m: list(i) for m, i in course.indices.items()},
        }
        for course in courses
    ]  # fmt: skip


def _sized(config: ScoreConfig, scene: Scene, view: View) -> View:
    camera = scene.cameras.get(view.camera.name, view.camera)
    width = config.width_px or camera.width
    return view.resized(width, max(1, round(camera.height * width / camera.width)))


def _frame_at(scene: Scene, camera: str, view: View) -> Frame | None:
    return next((f for f in scene.frames_of(camera) if abs(f.view.time_s - view.time_s) <= SAME_TIME_S), None)


# ---- the baseline ----


def baseline_of(scene: Scene, cloud: FusedCloud) -> Baseline:
    """The fused points drawn at a view, every hole taking the nearest point in the picture: no learning at all."""

    def at(view: View) -> Observation:
        placed = ((track.id, track.pose_at(view.time_s)) for track in scene.tracks)
        poses = {name: pose for name, pose in placed if pose is not None}
        return nearest_fill(cloud, poses, view)

    return at


def nearest_fill(cloud: FusedCloud, world_from_object: Mapping[str, NDArray[np.float64]], view: View) -> Observation:
    """Draw a cloud and fill what no point covers with the nearest covered pixel's colour, depth and class.

    A view that sees no point at all is black, without depth and class.
    """
    drawn = project.project_cloud(cloud, world_from_object, view, BASELINE_DRAWING)
    height, width = view.camera.height, view.camera.width
    index = drawn.index.numpy()
    if (index < 0).all():
        row, column = np.mgrid[0:height, 0:width]
    else:
        row, column = distance_transform_edt(index < 0, return_distances=False, return_indices=True)
    layers = [cloud.static, *(points for _, points in project.drawn_objects(cloud, world_from_object))]
    semantics = None
    if all(layer.semantics is not None for layer in layers):
        known = np.concatenate([layer.semantics for layer in layers if layer.semantics is not None])
        ids = np.append(known, palette.UNLABELLED)[index]  # index -1 = nothing = the appended entry
        semantics = torch.from_numpy(ids[row, column].astype(np.int64))
    depth = drawn.depth.numpy()[:, row, column]
    return Observation(
        view=view, rgb=torch.from_numpy(drawn.color.numpy()[:, row, column]),
        depth=torch.from_numpy(np.where(depth > 0, depth, np.nan).astype(np.float32)), semantics=semantics,
        confidence=drawn.valid.float(), mask=torch.ones(1, height, width, dtype=torch.bool),
        kind="virtual", source=BASELINE,
    )  # fmt: skip


# ---- one trajectory ----


def _score_course(course: Course, by: Yardstick, out: Path, advance: Callable[[], None]) -> list[dict[str, Any]]:
    """Score all methods on one trajectory; writes its truth, its baseline and its error pictures."""
    names = [*([BASELINE] if by.baseline is not None else []), *course.sets]
    motion = metrics.StaticMotion()
    sums = {name: metrics.build_all(by.distances, motion) for name in names}
    # Recorded training frames were seen by the fit and do not count; views off the path never were.
    counted = [n for n, frame in enumerate(course.frames) if frame is None or frame.id in by.held_out]
    wanted = _wanted(course, by, counted)
    truth_has: set[str] = set()
    scored = 0
    middle = len(course.views) // 2
    with contextlib.ExitStack() as stack:
        truths = fills = None
        if not by.truth.stored and (by.truth.exact or all(frame is not None for frame in course.frames)):
            writer = ObservationWriter(out / "truth" / course.name, course.name, "truth", "recorded")
            truths = stack.enter_context(writer)
        if by.baseline is not None:
            fills = stack.enter_context(ObservationWriter(out / BASELINE / course.name, course.name, BASELINE))
        made = _ahead(lambda number: _measured(course, by, number, wanted[number], sums), len(course.views))
        for number, (true, found, measured) in enumerate(made):
            if fills is not None:
                fills.add(found[BASELINE])
            if true is not None:
                if truths is not None:
                    truths.add(true.seen)
                if number in counted:
                    scored += 1
                    truth_has |= _contents(true, by.truth.exact)
                for name, of in measured.items():
                    for metric, value in of.items():
                        sums[name][metric].add(value)
                if by.error_pictures and number == middle:
                    _write_error_picture(out / "errors" / f"{course.name}.png", found, true.seen)
            advance()
    return [
        {"method": name, "trajectory": course.name, "views": scored, "values": _values(of, truth_has), "iou": _iou(of)}
        for name, of in sums.items()
    ]


def _wanted(course: Course, by: Yardstick, counted: Sequence[int]) -> list[set[str]]:
    """The metrics that each view of a trajectory enters."""
    looked_at = set(evenly(counted, by.distance_views or len(counted)))
    every_frame = {"flicker"} if by.truth.exact else set()  # wants all frames, in order
    usual = metrics.METRICS.keys() - by.distances.keys() - {"flicker"}
    return [
        every_frame | (usual if n in counted else set()) | (by.distances.keys() if n in looked_at else set())
        for n in range(len(course.views))
    ]


def _measured(
    course: Course, by: Yardstick, number: int, wanted: set[str], sums: Mapping[str, Mapping[str, metrics.Metric]]
) -> tuple[TrueView | None, dict[str, Observation], dict[str, dict[str, Any]]]:
    """Truth and methods' views of one number, and by method what the wanted metrics measure there; adds nothing to the sums."""
    true, found = _seen(course, by, number)
    if true is None:
        return true, found, {}
    measured = {}
    for name, seen in found.items():
        pair = pair_of(seen, true.seen, true.moving)
        measured[name] = metrics.measure(pair, {m: of for m, of in sums[name].items() if m in wanted})
    return true, found, measured


def evenly(items: Sequence[int], count: int) -> list[int]:
    """At most ``count`` of the items, evenly spread, from the middle of each share."""
    kept = min(count, len(items))
    return [items[int((k + 0.5) * len(items) / kept)] for k in range(kept)]


def _contents(true: TrueView, exact: bool) -> set[str]:
    """What a true view can be asked for, in the words of ``MetricRow.needs``."""
    has = {m for m in ("rgb", "depth", "semantics") if getattr(true.seen, m) is not None}
    if exact:
        has.add("every frame")
    if true.moving is not None and float(true.moving.float().mean()) >= metrics.SMALLEST_SHARE:
        has.add("movers")
    return has


def _seen(course: Course, by: Yardstick, number: int) -> tuple[TrueView | None, dict[str, Observation]]:
    """Truth and what each method has for one view."""
    true = by.truth.at(course.views[number], course.frames[number], course.name)
    found = {m: of[course.indices[m][number]] for m, of in course.sets.items()}
    return true, found if by.baseline is None else {BASELINE: by.baseline(course.views[number]), **found}


def _ahead(make: Callable[[int], Made], count: int) -> Iterator[Made]:
    """``make(0)``, ``make(1)``, ... in order, a few of them made beforehand by other threads."""
    threads = native.threads()
    with _one_thread_each(), ThreadPoolExecutor(threads) as pool:
        waiting: deque[Future[Made]] = deque()
        for number in range(count):
            waiting.append(pool.submit(make, number))
            if len(waiting) > 2 * threads:
                yield waiting.popleft().result()
        while waiting:
            yield waiting.popleft().result()


@contextlib.contextmanager
def _one_thread_each() -> Iterator[None]:
    """While several threads work on a view each, each of them counts as one: threads inside threads only wait for each other."""
    before = torch.get_num_threads(), native.threads()
    torch.set_num_threads(1)
    if native.library() is not None:
        native.set_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before[0])
        if native.library() is not None:
            native.set_threads(before[1])


def _values(of: Mapping[str, metrics.Metric], truth_has: set[str]) -> dict[str, float | str]:
    """A number per metric, or why there is none: no truth, not produced by the method, not computed by this build."""
    values = metrics.results(dict(of))
    if "perceptual" not in of:
        values["perceptual"] = score_tables.NOT_ASKED  # its weights are part of every build
    for name, row in metrics.METRICS.items():
        if name in of and row.needs[0] not in truth_has:
            values[name] = score_tables.NO_TRUTH
    return {n: round(v, 6) if isinstance(v, float) else v for n, v in values.items()}


def _iou(of: Mapping[str, metrics.Metric]) -> dict[str, float]:
    segmentation = of["miou"]
    if not isinstance(segmentation, metrics.Segmentation) or not int(segmentation.counts.sum()):
        return {}
    return {name: round(value, 4) for name, value in metrics.iou_of(segmentation.counts).items()}


def pair_of(seen: Observation, true: Observation, moving: Tensor | None = None) -> metrics.Pair:
    """Bring a method's view to the truth's size; where it gives no depth, it counts as the depth limit (80 m).

    ``moving`` bool[1, H, W]: where moving objects are in truth, if that is known.
    """
    height, width = true.view.camera.height, true.view.camera.width
    depth = None
    if seen.depth is not None:
        depth = resize_nearest(seen.depth, height, width)
        given = torch.isfinite(depth) & (depth > 0)
        depth = torch.where(given, depth, torch.full_like(depth, DEPTH_LIMIT_M)).clamp(max=DEPTH_LIMIT_M)
    valid = None
    if true.depth is not None:
        valid = torch.isfinite(true.depth) & (true.depth > 0) & (true.depth <= DEPTH_LIMIT_M)
    return metrics.Pair(
        rgb=resize_rgb(seen.rgb, height, width), depth=depth,
        semantics=None if seen.semantics is None else resize_nearest(seen.semantics[None], height, width)[0],
        truth_rgb=true.rgb, truth_depth=true.depth, truth_depth_valid=valid, truth_semantics=true.semantics,
        mask=true.mask, moving=moving, view=true.view,
    )  # fmt: skip



def _write_error_picture(path: Path, found: Mapping[str, Observation], true: Observation) -> None:
    """Truth and the methods beside each other, their colour errors below."""
    height, width = true.view.camera.height, true.view.camera.width
    picture = np.zeros((2 * height, (len(found) + 1) * width, 3), np.uint8)
    picture[:height, :width] = to_bytes(true.rgb)
    for column, seen in enumerate(found.values(), start=1):
        rgb = resize_rgb(seen.rgb, height, width)
        picture[:height, column * width : (column + 1) * width] = to_bytes(rgb)
        picture[height:, column * width : (column + 1) * width] = error_image(rgb, true.rgb)
    with store.atomic_path(path) as temporary:
        Image.fromarray(picture).save(temporary, optimize=False, compress_level=1)
