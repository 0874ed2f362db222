"""``mudg score``: what the methods rendered, against the truth.

For a generated city the truth is exact at any view. For a recorded log it is the held-out recorded frames, and nothing
at shifted views. OUT holds metrics.json, metrics.md, truth/<trajectory>/ and nearest_fill/<trajectory>/ (observations),
errors/*.png and, where FID is computed, features/.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt
from torch import Tensor

from mudg import native
from mudg.base import log, store
from mudg.base.devices import choose_device
from mudg.base.processes import computed_ahead, one_torch_thread
from mudg.base.records import understood
from mudg.base.run_folder import RunDir
from mudg.base.types import FusedCloud, Observation, Scene, View
from mudg.base.weights import read_checkpoint
from mudg.core import metrics, project
from mudg.core.losses import LPIPS_EPSILON
from mudg.core.metrics import ViewFacts
from mudg.core.pictures import error_image, resize_nearest, resize_rgb, to_bytes
from mudg.diffusion import model_files as mdm_files
from mudg.editing.settings import ScoreConfig
from mudg.networks.featnets import WHOLE_PIXELS, CodecFeatures, LpipsFeatures, LpipsTrunk, PerceptualDistance
from mudg.scene.clouds import read_fused
from mudg.scene.observations import ObservationWriter
from mudg.scene.read import read_scene
from mudg.scoring import tables as score_tables
from mudg.scoring import truth as scored_truth
from mudg.scoring.sets import BASELINE, SetScores, anchors_of
from mudg.scoring.sweeps import sweep_scores
from mudg.scoring.truth import Baseline, PairDistance, Reference, ScoredTrajectory, ViewTruth

BASELINE_DRAWING: Final = project.ProjectConfig(static_splat_px=2.5, object_splat_px=4.0, occluder_m=0.3)
TRUTH: Final = "=truth"
"""Stands for the true images where they are held against what is known of them, as a method is."""
LPIPS_FILES: Final[Mapping[str, tuple[str, LpipsTrunk]]] = {
    "lpips_weights": ("lpips", "alex"),
    "lpips_vgg_weights": ("lpips_vgg", "vgg"),
}
"""Setting that names a file -> row of the table and the network in the file."""
DEPTH_LIMIT_M: Final = 80.0


def write_scores(
    config: ScoreConfig,
    scene: Path,
    methods: Mapping[str, Path],
    work: RunDir,
    *,
    fused: Path | None = None,
    truth: Path | None = None,
) -> dict[str, Any]:
    """Score every trajectory of every method; returns a summary. ``scene``: the scene that was rendered. ``methods``:
    name -> folder of observation folders (output of render or synthesize). ``fused``: clouds made by fuse, for the
    baseline; without them there is none. ``truth``: folder of ``DrawTruth`` for this scene, to be read instead of
    drawing the truth again. InputError: nothing to score, or methods disagree about a trajectory's views."""
    recorded, out = read_scene(scene), work.path
    trajectories = scored_truth.trajectories_of(config, recorded, methods)
    true = scored_truth.truth_of(recorded) if truth is None else scored_truth.stored_truth(truth)
    baseline = baseline_of(recorded, read_fused(fused)) if fused is not None and config.baseline else None
    reference = Reference(config, recorded, true, baseline, _distances(config))
    sets = SetScores(config, recorded, out)  # before the work: the weights may be unusable
    results: list[dict[str, Any]] = []
    with log.task("score", sum(len(trajectory.views) for trajectory in trajectories)) as bar:
        for trajectory in trajectories:
            bar.update(trajectory.name)
            results += _score(trajectory, reference, out, bar.advance)
    sets.add_to(results, trajectories, reference, out)
    names = [*([BASELINE] if reference.baseline is not None else []), *methods]
    rows = {
        name: {"title": row.title, "unit": row.unit, "better": row.better, "needs": list(row.needs)}
        for name, row in metrics.METRICS.items()
    }
    made = {"depth_limit_m": DEPTH_LIMIT_M, "anchors": anchors_of(results, trajectories)}
    digests = {row: store.sha256_file(Path(own)) for f, (row, _) in LPIPS_FILES.items() if (own := getattr(config, f))}
    facts = {"version": "0.1", "input": config.lpips_input, "epsilon": LPIPS_EPSILON, "weights_sha256": digests}
    made |= {"lpips": facts if digests else {}, **sets.records()}
    records, exact = [trajectory.record() for trajectory in trajectories], reference.truth.exact
    if sweeps := sweep_scores(recorded, methods):
        made["sweeps"] = sweeps
    document = score_tables.document(recorded, exact, records, names, results, rows, made)
    store.write_json(out / "metrics.json", document)
    store.write_text(out / "metrics.md", score_tables.markdown(document))
    return {"trajectories": len(trajectories), "methods": names}


def _distances(config: ScoreConfig) -> dict[str, PairDistance]:
    """The rows that need weights and have them."""
    found: dict[str, PairDistance] = {}
    files = {flag: weights for flag in LPIPS_FILES if (weights := getattr(config, flag))}
    device = choose_device(config.device, "networks of the scores") if files or config.perceptual_views else None
    if config.perceptual_views:
        found["perceptual"] = PerceptualDistance(CodecFeatures(mdm_files.load("embedded").codec), device=device)
    for flag, weights in files.items():
        row, trunk = LPIPS_FILES[flag]
        network = LpipsFeatures(read_checkpoint(Path(weights)), weights, trunk, config.lpips_input)
        found[row] = PerceptualDistance(network, network.channel_weights, device)
    return found


def summary_table(out: Path) -> str:
    """The main numbers of a finished score folder as plain text for a terminal."""
    with understood("scores", str(Path(out) / "metrics.json")):
        return score_tables.plain(store.read_json(Path(out) / "metrics.json"))


def baseline_of(scene: Scene, cloud: FusedCloud) -> Baseline:
    """The fused points drawn at a view, every hole taking the nearest point in the image: no learning at all."""

    def draw(view: View) -> Observation:
        return nearest_fill(cloud, {track.id: track.pose_at(view.time_s) for track in scene.tracks}, view)

    return draw


def nearest_fill(
    cloud: FusedCloud, world_from_object: Mapping[str, NDArray[np.float64] | None], view: View
) -> Observation:
    """Draw a cloud and fill what no point covers with the nearest covered pixel's colour, depth and class. A view that
    sees no point at all is black, without depth and class."""
    drawn = project.project_cloud(cloud, world_from_object, view, BASELINE_DRAWING)
    height, width = view.camera.height, view.camera.width
    if not drawn.valid.any():
        row, column = np.mgrid[0:height, 0:width]
    else:
        row, column = distance_transform_edt(~drawn.valid.numpy(), return_distances=False, return_indices=True)
    classed = all(points.semantics is not None for points in (cloud.static, *cloud.objects.values()))
    semantics = drawn.semantics[row, column].long() if classed else None
    rgb, depth = drawn.rgb[:, row, column], drawn.depth[row, column][None]
    depth = torch.where(depth > 0, depth, torch.nan).float()
    mask = torch.ones(1, height, width, dtype=torch.bool)
    return Observation(view, rgb, depth, semantics, drawn.valid[None].float(), mask, "virtual", BASELINE)


@dataclass(frozen=True)
class MeasuredView:
    """Truth, facts and methods' views at one place, and by method what the wanted metrics measure there."""

    truth: ViewTruth | None
    facts: ViewFacts
    seen: Mapping[str, Observation]
    measured: Mapping[str, Mapping[str, Any]]


def _score(
    trajectory: ScoredTrajectory, reference: Reference, out: Path, advance: Callable[[], None]
) -> list[dict[str, Any]]:
    """Score all methods on one trajectory; writes its truth, its baseline and its error picture."""
    names = [*([BASELINE] if reference.baseline is not None else []), *trajectory.sets]
    motion, exact_motion = metrics.ExactMotion(), metrics.ExactMotion(reference.facts.vehicles)
    build = lambda: metrics.build_all(reference.distances, motion, metrics.build_facts(exact_motion))
    sums = {name: build() for name in names} | {TRUTH: metrics.build_facts(exact_motion)}
    counted = reference.counted(trajectory)
    wanted = _wanted(trajectory, reference, counted)
    truth_has: set[str] = set()
    scored = 0

    def measure(number: int) -> MeasuredView:
        own = {method: {k: of[k] for k in wanted[number] if k in of} for method, of in sums.items()}
        return _measured(trajectory, reference, number, own)

    threads = native.threads()
    small = _is_small(trajectory)
    # of large views no two are in memory at the same time
    with native.one_thread() if small else one_torch_thread(), contextlib.ExitStack() as stack:
        truths = fills = None
        exact = reference.truth.exact
        writer = lambda folder, *kind: ObservationWriter(out / folder / trajectory.name, trajectory.name, *kind)
        if not reference.truth.stored and (exact or all(frame is not None for frame in trajectory.frames)):
            truths = stack.enter_context(writer("truth", "truth", "recorded"))
        if reference.baseline is not None:
            fills = stack.enter_context(writer(BASELINE, BASELINE))
        every = len(trajectory.views)
        views = computed_ahead(measure, every, threads) if small else map(measure, range(every))
        # not over `views`: the last one would stay in memory while the next is made
        for number in range(every):
            made = next(views)
            if fills is not None:
                fills.add(made.seen[BASELINE])
            if number in counted:
                truth_has |= scored_truth.known_of(made.facts)
            if made.truth is not None:
                if truths is not None:
                    truths.add(made.truth.seen)
                if number in counted:
                    scored += 1
                    truth_has |= _contents(made.truth, exact)
                if reference.error_pictures and number == every // 2:
                    write_errors(out / "errors" / f"{trajectory.name}.png", made.seen, made.truth.seen)
            for name, values in made.measured.items():
                for metric, value in values.items():
                    sums[name][metric].add(value)
            del made
            advance()
    anchors = {k: v for k, v in _values(sums.pop(TRUTH), truth_has).items() if not isinstance(v, str)}
    results = []
    for name, of in sums.items():
        classes = of["miou"]
        counted = isinstance(classes, metrics.Segmentation) and int(classes.counts.sum())
        iou = {n: round(value, 4) for n, value in metrics.iou_of(classes.counts).items()} if counted else {}
        numbers = {"values": _values(of, truth_has), "iou": iou}
        where = {"method": name, "trajectory": trajectory.name, "views": scored}
        results.append({**where, **numbers, "truth": dict(anchors)})
    return results


def _is_small(trajectory: ScoredTrajectory) -> bool:
    return all(view.camera.width * view.camera.height <= WHOLE_PIXELS for view in trajectory.views)


def _wanted(trajectory: ScoredTrajectory, reference: Reference, counted: Sequence[int]) -> list[set[str]]:
    """The metrics that each view of a trajectory enters."""
    sampled = set(evenly(counted, reference.distance_views or len(counted)))
    every_frame = {"temporal_flickering"} | ({"flicker", "warp_error"} if reference.truth.exact else set())
    needs_weights = reference.distances.keys()  # "flicker" and "temporal_flickering" want all views, in order
    usual = {name for name, row in metrics.METRICS.items() if row.build is not None}
    usual -= {*needs_weights, *metrics.EVERY_VIEW}
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
    asked = {name for of in wanted.values() for name in of}
    if asked <= {*metrics.EVERY_VIEW}:  # a view that does not count: only its neighbours need it
        facts = ViewFacts(instance=None if truth is None else truth.instance)
    else:
        facts = reference.facts.of(view, truth)
    compared = {**seen, **({} if truth is None else {TRUTH: truth.seen})}
    pairs = {name: pair_of(one, truth, view, facts) for name, one in compared.items()}
    if _is_small(trajectory):  # whose views are measured at the same time
        measured = {name: metrics.measure(pair, wanted[name]) for name, pair in pairs.items()}
        return MeasuredView(truth, facts, seen, measured)
    with ThreadPoolExecutor(native.threads()) as pool:
        found = pool.map(lambda name: metrics.measure(pairs[name], wanted[name]), pairs)
        return MeasuredView(truth, facts, seen, dict(zip(pairs, found, strict=True)))


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


def pair_of(
    seen: Observation, truth: ViewTruth | None, view: View | None = None, facts: ViewFacts | None = None
) -> metrics.Pair:
    """Bring a method's view to the truth's size; where it gives no depth, it counts as the depth limit (80 m).
    ``view``: of both; without it, the truth's. ``facts``: what is known of the view beside the truth."""
    true, facts = None if truth is None else truth.seen, facts or ViewFacts()
    view = view or (seen.view if true is None else true.view)
    height, width = view.camera.height, view.camera.width
    depth: Tensor | None = None
    if seen.depth is not None:
        depth = resize_nearest(seen.depth, height, width)
        given = torch.isfinite(depth) & (depth > 0)
        depth = torch.where(given, depth, DEPTH_LIMIT_M).clamp(max=DEPTH_LIMIT_M)
    rgb = resize_rgb(seen.rgb, height, width)
    semantics = None if seen.semantics is None else resize_nearest(seen.semantics, height, width)
    if true is None or truth is None:
        return metrics.Pair(rgb, depth, semantics, None, None, None, None, view=view, facts=facts)
    valid = None
    if true.depth is not None:
        valid = torch.isfinite(true.depth) & (true.depth > 0) & (true.depth <= DEPTH_LIMIT_M)
    made, truths = (rgb, depth, semantics), (true.rgb, true.depth, valid, true.semantics)
    return metrics.Pair(*made, *truths, mask=true.mask, moving=truth.moving, view=true.view, facts=facts)


def write_errors(path: Path, seen: Mapping[str, Observation], true: Observation) -> None:
    """A picture: truth and the methods beside each other, their colour errors below."""
    height, width = true.view.camera.height, true.view.camera.width
    images = [true.rgb, *(resize_rgb(observation.rgb, height, width) for observation in seen.values())]
    errors = [np.zeros((height, width, 3), np.uint8), *(error_image(rgb, true.rgb) for rgb in images[1:])]
    picture = np.vstack([np.hstack([to_bytes(rgb) for rgb in images]), np.hstack(errors)])
    store.write_image(path, picture, optimize=False, compress_level=1)
