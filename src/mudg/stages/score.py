"""``mudg score``: what the methods rendered, against the truth.

For a generated city the truth is exact at any view. For a recorded log it is the held-out recorded frames, and nothing
at shifted views. OUT holds metrics.json, metrics.md, truth/<trajectory>/ and nearest_fill/<trajectory>/ (observations),
errors/*.png and, where FID is computed, features/.
"""

from __future__ import annotations

import contextlib
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt
from torch import Tensor

from mudg import native
from mudg.base import config as configuration
from mudg.base import log, palette, store
from mudg.base.devices import choose_device
from mudg.base.errors import InputError, UsageError
from mudg.base.processes import computed_ahead
from mudg.base.run_folder import RunDir, VerbOutput, below, refuse_overlap
from mudg.base.types import Frame, FusedCloud, Observation, Scene, View
from mudg.core import metrics, project
from mudg.core.pictures import error_image, resize_nearest, resize_rgb, to_bytes
from mudg.data.cloudfile import read_fused
from mudg.data.observations import (
    OBSERVATION_FILES,
    ObservationSet,
    ObservationWriter,
    list_observation_sets,
    read_observations,
)
from mudg.data.scene import read_scene
from mudg.models.featnets import CodecFeatures, PerceptualDistance
from mudg.models.mdm import files as mdm_files
from mudg.report import score_tables
from mudg.stages.config import ScoreConfig
from mudg.stages.fitting.perception import lpips_network
from mudg.stages.score_truth import SAME_PLACE_M, SAME_TIME_S, Truth, ViewTruth, apart_m, stored_truth, truth_of
from mudg.stages.scoring.distributions import FEATURES_FOLDER, Distributions, ImageSet, TrajectorySets, distributions_of
from mudg.stages.scoring.videos import VideoDistances, videos_of

BASELINE: Final = "nearest_fill"
BASELINE_DRAWING: Final = project.ProjectConfig(static_splat_px=2.5, object_splat_px=4.0, occluder_m=0.3)
DEPTH_LIMIT_M: Final = 80.0
_OUTPUT: Final = VerbOutput(
    "score", 4,
    ("metrics.json", "metrics.md", "errors/*.png", f"{FEATURES_FOLDER}/*.safetensors",
     *below("truth/*", OBSERVATION_FILES), *below(f"{BASELINE}/*", OBSERVATION_FILES)),
)  # fmt: skip
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
    """

    truth: Truth
    baseline: Baseline | None
    held_out: frozenset[str]
    error_pictures: bool
    distances: Mapping[str, PairDistance]
    distance_views: int


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
    weights = {"lpips_weights": config.lpips_weights, "fid_weights": config.fid_weights, "fvd_weights": config.fvd_weights}
    named = {name.replace("_", "-"): path for name, path in weights.items()}
    refuse_overlap(out, {"scene": scene, **methods, "fused": fused, "truth": truth, **named})
    others = {
        "fused": fused if config.baseline else None,
        **{name: Path(path) if path else None for name, path in weights.items()},
        "truth": truth,
    }
    given = {"scene": scene, **methods, **{name: path for name, path in others.items() if path is not None}}
    inputs = {name: store.digest(path) for name, path in given.items()}
    choose_device(config.device, "networks of the scores")  # refused before anything is written
    work = RunDir.open(out, _OUTPUT, configuration.result_settings(config), inputs, overwrite)
    if work.complete:
        return work.reused()
    recorded = read_scene(scene)
    trajectories = _trajectories(config, recorded, methods)
    reference = Reference(
        truth=truth_of(recorded) if truth is None else stored_truth(truth),
        baseline=baseline_of(recorded, read_fused(fused)) if fused is not None and config.baseline else None,
        held_out=frozenset(f.id for f in recorded.frames_in("test") or recorded.frames),
        error_pictures=config.error_pictures, distances=_distances(config), distance_views=config.perceptual_views,
    )  # fmt: skip
    # Before the work: the weights may be unusable.
    sets, videos = distributions_of(config, recorded, work.path), videos_of(config, recorded, work.path)
    results: list[dict[str, Any]] = []
    with log.task("score", sum(len(trajectory.views) for trajectory in trajectories)) as bar:
        for trajectory in trajectories:
            bar.update(trajectory.name)
            results += _score(trajectory, reference, work.path, bar.advance)
    if sets is not None or videos is not None:
        _compare_sets(results, trajectories, reference, work.path, sets, videos)
    names = [*([BASELINE] if reference.baseline is not None else []), *methods]
    rows = {
        name: {"title": row.title, "unit": row.unit, "better": row.better, "needs": list(row.needs)}
        for name, row in metrics.METRICS.items()
    }
    records = [trajectory.record() for trajectory in trajectories]
    document = score_tables.document(recorded, reference.truth.exact, records, names, results, rows,
        {"depth_limit_m": DEPTH_LIMIT_M, "distributions": None if sets is None else sets.record(),
         "videos": None if videos is None else videos.record()})  # fmt: skip
    store.write_json(work.path / "metrics.json", document)
    store.write_text(work.path / "metrics.md", score_tables.markdown(document))
    work.finish({"trajectories": len(trajectories), "methods": names})
    return work.path


def _compare_sets(
    results: Sequence[dict[str, Any]], trajectories: Sequence[ScoredTrajectory], reference: Reference, out: Path,
    sets: Distributions | None, videos: VideoDistances | None,
) -> None:  # fmt: skip
    """Add to the results what compares whole sets of views: distances of images, and of clips, where their weights are given."""
    with log.task("features", len(results)) as bar:
        for trajectory in trajectories:
            bar.update(trajectory.name)
            rows_here = [row for row in results if row["trajectory"] == trajectory.name]
            if sets is not None:
                counted = trajectory.counted(reference.held_out)
                _add_distributions(rows_here, sets, _sets_of(trajectory, reference, out, counted))
            if videos is not None:
                every = range(len(trajectory.views))
                _add_videos(rows_here, videos, _sets_of(trajectory, reference, out, every))
            for _ in rows_here:
                bar.advance()


def _distances(config: ScoreConfig) -> dict[str, PairDistance]:
    """The rows that need weights and have them."""
    found: dict[str, PairDistance] = {}
    if not (config.perceptual_views or config.lpips_weights):
        return found
    device = choose_device(config.device, "networks of the scores")
    if config.perceptual_views:
        found["perceptual"] = PerceptualDistance(CodecFeatures(mdm_files.load("embedded").codec), device=device)
    if config.lpips_weights:
        network = lpips_network(config.lpips_weights)
        found["lpips"] = PerceptualDistance(network, network.channel_weights, device)
    return found


def summary_table(out: Path) -> str:
    """The main numbers of a finished score folder as plain text for a terminal."""
    return score_tables.plain(store.read_json(Path(out) / "metrics.json"))


# ---- what is compared with what ----


def _trajectories(config: ScoreConfig, scene: Scene, methods: Mapping[str, Path]) -> list[ScoredTrajectory]:
    sets = {
        method: {name: read_observations(path) for name, path in list_observation_sets(folder).items()}
        for method, folder in methods.items()
    }
    names = sorted({name for found in sets.values() for name in found}, key=_order)
    if not names:
        raise InputError("none of the folders holds rendered views", where=", ".join(str(p) for p in methods.values()),
            expected="output of mudg render or mudg synthesize")  # fmt: skip
    return [_matched(config, scene, name, {m: found[name] for m, found in sets.items() if name in found}) for name in names]


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
    return ScoredTrajectory(name, camera_name, shift_m, tuple(views), frames, sets, {m: tuple(i) for m, i in indices.items()})


def _frame_of(scene: Scene, camera: str, view: View) -> Frame | None:
    return next((f for f in scene.frames_of(camera) if abs(f.view.time_s - view.time_s) <= SAME_TIME_S), None)


# ---- the baseline ----


def baseline_of(scene: Scene, cloud: FusedCloud) -> Baseline:
    """The fused points drawn at a view, every hole taking the nearest point in the image: no learning at all."""

    def draw(view: View) -> Observation:
        placed = ((track.id, track.pose_at(view.time_s)) for track in scene.tracks)
        return nearest_fill(cloud, {name: pose for name, pose in placed if pose is not None}, view)

    return draw


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


@dataclass(frozen=True)
class MeasuredView:
    """Truth and methods' views at one place, and by method what the wanted metrics measure there."""

    truth: ViewTruth | None
    seen: Mapping[str, Observation]
    measured: Mapping[str, Mapping[str, Any]]


def _score(
    trajectory: ScoredTrajectory, reference: Reference, out: Path, advance: Callable[[], None]
) -> list[dict[str, Any]]:
    """Score all methods on one trajectory; writes its truth, its baseline and its error picture."""
    names = [*([BASELINE] if reference.baseline is not None else []), *trajectory.sets]
    motion = metrics.StaticMotion()
    sums = {name: metrics.build_all(reference.distances, motion) for name in names}
    counted = trajectory.counted(reference.held_out)
    wanted = _wanted(trajectory, reference, counted)
    truth_has: set[str] = set()
    scored = 0

    def measure(number: int) -> MeasuredView:
        return _measured(trajectory, reference, number, {m: {k: sums[m][k] for k in wanted[number]} for m in names})

    threads = native.threads()
    with native.one_thread(), contextlib.ExitStack() as stack:
        truths = fills = None
        exact = reference.truth.exact
        if not reference.truth.stored and (exact or all(frame is not None for frame in trajectory.frames)):
            truths = stack.enter_context(
                ObservationWriter(out / "truth" / trajectory.name, trajectory.name, "truth", "recorded")
            )
        if reference.baseline is not None:
            fills = stack.enter_context(ObservationWriter(out / BASELINE / trajectory.name, trajectory.name, BASELINE))
        for number, made in enumerate(computed_ahead(measure, len(trajectory.views), threads)):
            if fills is not None:
                fills.add(made.seen[BASELINE])
            if made.truth is not None:
                if truths is not None:
                    truths.add(made.truth.seen)
                if number in counted:
                    scored += 1
                    truth_has |= _contents(made.truth, exact)
                for name, values in made.measured.items():
                    for metric, value in values.items():
                        sums[name][metric].add(value)
                if reference.error_pictures and number == len(trajectory.views) // 2:
                    _write_error_picture(out / "errors" / f"{trajectory.name}.png", made.seen, made.truth.seen)
            advance()
    return [
        {"method": name, "trajectory": trajectory.name, "views": scored, "values": _values(of, truth_has), "iou": _iou(of)}
        for name, of in sums.items()
    ]


def _sets_of(trajectory: ScoredTrajectory, reference: Reference, out: Path, counted: Sequence[int]) -> TrajectorySets:
    """The images at the counted views of a trajectory whose views have been scored and written."""

    def chosen(found: ObservationSet, indices: Sequence[int]) -> ImageSet:
        return ImageSet(len(counted), lambda number: found.rgb_u8(indices[counted[number]]))

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
        drawn = out / "truth" / trajectory.name
        truth = ImageSet(len(counted), true_image) if reference.truth.stored else chosen(read_observations(drawn), every)
    camera = trajectory.views[0].camera
    return TrajectorySets(trajectory.name, trajectory.camera, camera.width, camera.height, methods, truth)


def _add_videos(rows: Sequence[dict[str, Any]], videos: VideoDistances, here: TrajectorySets) -> None:
    """FVD into the results of one trajectory."""
    found = videos.of(here)
    for row in rows:
        value = found[row["method"]]
        row["values"]["fvd"] = value if isinstance(value, str) else value["fvd"]
        if not isinstance(value, str):
            row["video"] = {"n": value["n"], "n_reference": value["n_reference"]}


def _add_distributions(rows: Sequence[dict[str, Any]], sets: Distributions, here: TrajectorySets) -> None:
    """FID and KID into the results of one trajectory."""
    found = sets.of(here)
    for row in rows:
        value = found[row["method"]]
        if isinstance(value, str):
            row["values"] |= {"fid": value, "kid": value}
        else:
            row["values"] |= {"fid": round(value.fid, 6), "kid": round(value.kid, 6)}
            row["distribution"] = value.record()


def _wanted(trajectory: ScoredTrajectory, reference: Reference, counted: Sequence[int]) -> list[set[str]]:
    """The metrics that each view of a trajectory enters."""
    sampled = set(evenly(counted, reference.distance_views or len(counted)))
    every_frame = {"flicker"} if reference.truth.exact else set()  # wants all frames, in order
    needs_weights = reference.distances.keys()
    usual = {name for name, row in metrics.METRICS.items() if row.build is not None} - needs_weights - {"flicker"}
    return [
        every_frame | (usual if n in counted else set()) | (needs_weights if n in sampled else set())
        for n in range(len(trajectory.views))
    ]


def _measured(
    trajectory: ScoredTrajectory, reference: Reference, number: int, wanted: Mapping[str, Mapping[str, metrics.Metric]]
) -> MeasuredView:
    """Measure one view; threads may call, for it adds nothing to the sums."""
    view = trajectory.views[number]
    truth = reference.truth.at_view(view, trajectory.frames[number], trajectory.name)
    seen = {m: found[trajectory.indices[m][number]] for m, found in trajectory.sets.items()}
    if reference.baseline is not None:
        seen = {BASELINE: reference.baseline(view), **seen}
    if truth is None:
        return MeasuredView(None, seen, {})
    return MeasuredView(truth, seen, {m: metrics.measure(pair_of(o, truth), wanted[m]) for m, o in seen.items()})


def evenly(items: Sequence[int], count: int) -> list[int]:
    """At most ``count`` of the items, evenly spread, from the middle of each share."""
    kept = min(count, len(items))
    return [items[int((k + 0.5) * len(items) / kept)] for k in range(kept)]


def _contents(truth: ViewTruth, exact: bool) -> set[str]:
    """What the truth of a view holds, as ``MetricRow.needs`` names it."""
    has = {m for m in ("rgb", "depth", "semantics") if getattr(truth.seen, m) is not None}
    if exact:
        has.add("every frame")
    if truth.moving is not None and float(truth.moving.float().mean()) >= metrics.SMALLEST_SHARE:
        has.add("dynamic objects")
    return has


def _values(sums: Mapping[str, metrics.Metric], truth_has: set[str]) -> dict[str, float | str]:
    """A number per metric, or why there is none: no truth, not produced by the method, not computed by this build."""
    values = metrics.results(sums)
    if "perceptual" not in sums:
        values["perceptual"] = score_tables.NOT_REQUESTED  # its weights are part of every build
    for name, row in metrics.METRICS.items():
        if name in sums and row.needs[0] not in truth_has:
            values[name] = score_tables.NO_TRUTH
    return {n: round(v, 6) if isinstance(v, float) else v for n, v in values.items()}


def _iou(sums: Mapping[str, metrics.Metric]) -> dict[str, float]:
    segmentation = sums["miou"]
    if not isinstance(segmentation, metrics.Segmentation) or not int(segmentation.counts.sum()):
        return {}
    return {name: round(value, 4) for name, value in metrics.iou_of(segmentation.counts).items()}


def pair_of(seen: Observation, truth: ViewTruth) -> metrics.Pair:
    """Bring a method's view to the truth's size; where it gives no depth, it counts as the depth limit (80 m)."""
    true = truth.seen
    height, width = true.view.camera.height, true.view.camera.width
    depth: Tensor | None = None
    if seen.depth is not None:
        depth = resize_nearest(seen.depth, height, width)
        given = torch.isfinite(depth) & (depth > 0)
        depth = torch.where(given, depth, DEPTH_LIMIT_M).clamp(max=DEPTH_LIMIT_M)
    valid = None
    if true.depth is not None:
        valid = torch.isfinite(true.depth) & (true.depth > 0) & (true.depth <= DEPTH_LIMIT_M)
    return metrics.Pair(
        rgb=resize_rgb(seen.rgb, height, width), depth=depth,
        semantics=None if seen.semantics is None else resize_nearest(seen.semantics, height, width),
        truth_rgb=true.rgb, truth_depth=true.depth, truth_depth_valid=valid, truth_semantics=true.semantics,
        mask=true.mask, moving=truth.moving, view=true.view,
    )  # fmt: skip


def _write_error_picture(path: Path, seen: Mapping[str, Observation], true: Observation) -> None:
    """Truth and the methods beside each other, their colour errors below."""
    height, width = true.view.camera.height, true.view.camera.width
    images = [true.rgb, *(resize_rgb(observation.rgb, height, width) for observation in seen.values())]
    errors = [np.zeros((height, width, 3), np.uint8), *(error_image(rgb, true.rgb) for rgb in images[1:])]
    picture = np.vstack([np.hstack([to_bytes(rgb) for rgb in images]), np.hstack(errors)])
    store.write_image(path, picture, optimize=False, compress_level=1)
