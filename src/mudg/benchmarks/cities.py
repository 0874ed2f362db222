"""Measurements on generated cities, each one folder: ``mudg bench mdm``, ``poses`` and ``edit``.

mdm: the diffusion model on held-out cities beside the recorded path, against exact truth, and the seam between windows
of a longer video. poses: how much of the error of disturbed boxes a fit takes out, ``1 - rms(after) / rms(before)``
(docs/research/scene.md). edit: edits of fitted scenes against the city drawn again with the object elsewhere or gone,
vehicles of other cities, and what a diffusion model adds (docs/edit.md)."""

from __future__ import annotations

import itertools
import math
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch
from numpy.typing import NDArray
from scipy import ndimage

from mudg.base import geometry, log, seeds
from mudg.base.config import result_settings
from mudg.base.devices import NETWORK_KINDS, choose_device
from mudg.base.errors import InputError
from mudg.base.html import cells, markdown_table
from mudg.base.run_folder import RunDir
from mudg.base.types import FusedCloud, Observation, Scene, Track, View
from mudg.benchmarks.chain import finished
from mudg.benchmarks.columns import shipped_features
from mudg.benchmarks.settings import BenchConfig
from mudg.city.config import CityConfig
from mudg.city.logs import write_city, write_world
from mudg.city.world import CityWorld
from mudg.core import metrics
from mudg.core.edit import Motion
from mudg.core.fusion import fuse_sweeps
from mudg.core.losses import lpips_distance, unit_features
from mudg.core.raster.rasterize import drawing_device, rasterize
from mudg.diffusion import city_clips as from_city
from mudg.diffusion import model_files as mdm_files
from mudg.diffusion import score as learn_score
from mudg.diffusion.city_clips import CityClipRules, fit_city
from mudg.diffusion.condition import ConditionRules, WarpSource, build_conditions
from mudg.diffusion.memory_plan import choose_bf16
from mudg.diffusion.model import MDM
from mudg.diffusion.requests import SampleRequest, generated
from mudg.diffusion.settings import HarmonizeConfig, SynthesizeConfig
from mudg.diffusion.views import windows
from mudg.editing.apply import Drawer, EditedDrive, carry_out, complete_asset, drawer, write_asset
from mudg.editing.harmonised import repairing
from mudg.editing.model import linear_of
from mudg.editing.recorded import EditedImages, write_edited_scene
from mudg.editing.script import parse_edits
from mudg.editing.settings import EditConfig
from mudg.gaussians import fit
from mudg.gaussians.model import SceneModel, compose
from mudg.gaussians.nodes import RigidNode
from mudg.gaussians.rendering import raster_of, render_view
from mudg.gaussians.settings import DensifyConfig, FitConfig, PoseConfig, RecordedLossConfig, StartConfig
from mudg.gaussians.storage import StartFit, save_model, whole_run
from mudg.scene.fuse import rules_of, scene_sweeps
from mudg.scene.labels import read_label
from mudg.scene.read import read_image, read_scene
from mudg.scene.settings import FuseConfig

SEAM_FRAMES, SEAM_SHIFT_M = 26, 3.0


def measure_mdm(config: BenchConfig, out: Path) -> tuple[dict[str, Any], str]:
    """Scores of the model at every number of steps, with and without classes, and its seam; numbers and tables."""
    device = choose_device(config.device, "diffusion model", NETWORK_KINDS)
    bf16 = choose_bf16(config.precision, device)
    request = SampleRequest(1, config.seed, eta=config.eta, bf16=bf16)
    MDM.check_request(request)
    model = mdm_files.load(config.model).to(device)
    cities = from_city.LISTS[config.cities][: config.count]
    rules = CityClipRules(window=model.config.window, fitted=model.config.renders)
    from_city.write_missing(rules, cities, out / "clips", fit_city if rules.fitted else None)
    result: dict[str, Any] = {"cities": list(cities), "model": mdm_files.digest(config.model), "bf16": bf16, "rows": []}
    lines = [f"# Diffusion model on {len(cities)} held-out cities ({config.cities} list), exact truth", ""]
    with log.task("scoring", 2 * len(config.steps)) as bar:
        for given, steps in itertools.product((True, False), config.steps):
            picture = out / f"steps_{steps}_{'classes' if given else 'plain'}.png"
            prepare, started = None if given else learn_score.without_classes, time.perf_counter()
            sampled = replace(request, steps=steps)
            scores = learn_score.score(model, cities, out / "clips", sampled, prepare=prepare, picture=picture)
            seconds = (time.perf_counter() - started) / scores["clips"]
            row = {"steps": steps, "given_classes": given, "seconds_per_clip": round(seconds, 2), "scores": scores}
            result["rows"].append(row)
            title = f"{steps} step{'s' if steps > 1 else ''}, classes {'given' if given else 'withheld'}"
            lines += [f"## {title}, {seconds:.1f} s per clip with its scoring", "", "```"]
            lines += [learn_score.table(scores), "```", ""]
            bar.update(title)
            bar.advance()
    change = result["seam"] = seam(model, config, request)
    lines += [
        f"Seam: static surfaces change {change['across']:.3f} times as much as in the truth across the seams of"
        f" windows, {change['inside']:.3f} times inside them (city {change['city']}, {SEAM_FRAMES} frames, 3 m,"
        f" {change['steps']} steps).",
        "",
    ]
    return result, "\n".join(lines)


def seam(model: MDM, config: BenchConfig, request: SampleRequest) -> dict[str, Any]:
    """Change of static surfaces across the seams of overlapping windows, against that inside windows.

    A video of `SEAM_FRAMES` frames 3 m beside the path of one city is made in windows and steps as synthesize takes
    them by default. Returned per place: the mean of (change made / change of the
    truth) over pairs of frames; and the pairs themselves.
    """
    city, usual = from_city.LISTS[config.cities][0], SynthesizeConfig()
    rules = CityClipRules(window=model.config.window)
    record = from_city.make_log(rules, city, frames=SEAM_FRAMES)
    views = [from_city.shifted_view(record.world, v, SEAM_SHIFT_M) for v in record.world.frame_views("front")]
    small = [view.resized(rules.width, rules.height) for view in views]
    truths = [record.world.render(view) for view in small]
    sizes = ConditionRules(rules.width, rules.height, rules.width * rules.fine, rules.height * rules.fine)
    sources: dict[int, WarpSource] = {}
    frames: list[torch.Tensor] = []
    tail: dict[Any, torch.Tensor] = {}
    spans = windows(len(views), model.config.window, usual.overlap)
    for number, span in enumerate(spans):
        seen, shared = [views[i] for i in span], len(frames) - span.start
        condition = build_conditions(record.cloud, record.world.tracks(), seen, record.recorded, sizes, sources)[0]
        known = {m: z[-shared:] for m, z in tail.items()} if tail else None
        made = generated(model, condition, replace(request, steps=usual.steps, index=number, known=known))
        frames, tail = [*frames, *made.rgb[shared:]], dict(made.latents)
    rgb = torch.stack([torch.from_numpy(t.rgb.copy()).permute(2, 0, 1) for t in truths])
    depth = torch.stack([torch.from_numpy(t.depth.copy())[None] for t in truths]).clamp(max=1000.0)
    ids = torch.stack([torch.from_numpy(t.semantics.astype("int64")) for t in truths])
    true_frames = [metrics.TrueFrame.of(*one) for one in zip(small, depth, ids, strict=True)]
    pairs = metrics.changes(torch.stack(frames), rgb, true_frames)
    ratios = [m / t if t > 0 else math.nan for m, t in pairs]
    seams = {span.start + usual.overlap - 1 for span in spans[1:-1]} | {spans[-2].stop - 1}
    mean = lambda kept: sum(kept) / len(kept) if kept else math.nan
    across = mean([r for i, r in enumerate(ratios) if i in seams])
    within = mean([r for i, r in enumerate(ratios) if i not in seams])
    change = {"city": city, "across": round(across, 4), "inside": round(within, 4), "steps": usual.steps}
    return {**change, "seams": sorted(seams), "pairs": [round(r, 4) for r in ratios]}


LISTS: dict[str, tuple[int, ...]] = {
    "development": (2_000_000, 2_000_001, 2_000_002, 2_000_003),
    "reported": tuple(range(2_000_100, 2_000_106)),
}
"""Seeds of cities: for development, and to report on."""
SAME = 1.5 / 255
"""Colours of 8 bits that differ by more than this differ by more than one step."""
NOISE_M, NOISE_RAD = 0.1, np.radians(1.0)
SEEN_PX, FEWEST_KEYS = 60, 4
FRAMES, WIDTH, HEIGHT = 16, 240, 160
DRIFT_S = 0.4
CASES = (("noise", "learnt"), ("noise", "smoothed"), ("noise", "fixed"), ("drift", "learnt"), ("offset", "learnt"))
"""Kind of boxes, and what is done about their poses."""


def measure_poses(config: BenchConfig, out: Path) -> tuple[dict[str, Any], str]:
    """Fit every city with boxes as they are, with noise and with offsets, poses fixed and learnt; numbers and a table.
    Rows that an interrupted run wrote are taken as they are."""
    cities, rows = LISTS[config.cities][: config.count], []
    with log.task("fitting", len(cities) * len(CASES)) as bar:
        for city in cities:
            for row in _pose_rows(config, city, out):
                rows.append(row)
                bar.advance()
    result = {"cities": list(cities), "iterations": config.pose_iterations, "rows": rows, "summary": summary(rows)}
    return result, table(result)


def _pose_rows(config: BenchConfig, city: int, out: Path) -> Iterator[dict[str, Any]]:
    """The rows of a city, with the errors of their fits."""
    scene = city_scene(city, out / "cities" / str(city))

    @cache  # disturbed boxes and their clouds, the same for all ways to fit them
    def case(kind: str) -> tuple[Scene, FusedCloud]:
        boxes = replace(scene, tracks=disturbed(scene.tracks, kind, config.seed + city))
        return boxes, cloud_of(boxes)

    def measured(kind: str, poses: str) -> dict[str, Any]:
        (boxes, cloud), folder = case(kind), out / "fits" / f"{city}_{kind}_{poses}"
        model = fitted(boxes, cloud, fit_settings(config, poses), folder).model
        return {"city": city, "boxes": kind, "poses": poses, **row_of(scene, boxes, model)}

    for kind, poses in CASES:
        yield finished(out / "rows" / f"{city}_{kind}_{poses}.json", partial(measured, kind, poses))


def cloud_of(scene: Scene) -> FusedCloud:
    """The clouds of a scene, as fuse makes them by default."""
    return fuse_sweeps(scene_sweeps(scene, FuseConfig()), scene.tracks, rules_of(FuseConfig()))[0]


def fit_settings(config: BenchConfig, poses: str) -> FitConfig:
    """A small, quick fit with poses "fixed", "learnt", or only "smoothed"."""
    return FitConfig(
        method="street_gaussians",
        iterations=config.pose_iterations,
        seed=config.seed,
        device=config.device,
        preview_every=10**6,
        checkpoint_every=10**6,
        start=StartConfig(gaussians=8000),
        densify=DensifyConfig(kind="none"),
        loss=RecordedLossConfig(semantic_every=1000),
        poses=PoseConfig(learn=poses != "fixed", rounds=0 if poses == "smoothed" else PoseConfig().rounds),
    )


def city_scene(seed: int, folder: Path, **changes: Any) -> Scene:
    """A small generated log, made when missing."""
    if not (folder / "scene.json").is_file():
        sizes = {"n_frames": FRAMES, "width": WIDTH, "height": HEIGHT, "cameras": ("front",)}
        config = CityConfig(seed=seed, **sizes, lidar_azimuth_step_deg=0.8)
        write_city(replace(config, **changes), folder)
    return read_scene(folder)


def disturbed(tracks: tuple[Track, ...], kind: str, seed: int) -> tuple[Track, ...]:
    """The tracks with every key displaced in its own frame: "noise", "drift" or "offset" (see the module's text)."""
    made = []
    for index, track in enumerate(tracks):
        draws = seeds.numpy_rng(seed, index, f"track {kind}").normal(size=(len(track.times_s), 4))
        if kind == "offset":
            draws = np.broadcast_to(draws[:1], draws.shape)
        if kind == "drift":
            kernel = np.exp(-0.5 * ((track.times_s[:, None] - track.times_s) / DRIFT_S) ** 2)
            draws = kernel / np.linalg.norm(kernel, axis=1, keepdims=True) @ draws
        moves = np.stack([geometry.yaw_matrix(NOISE_RAD * row[3], NOISE_M * row[:3]) for row in draws])
        made.append(Track(track.id, track.label, track.size_m, track.times_s, track.world_from_object @ moves))
    return tuple(made)


def fitted(scene: Scene, cloud: FusedCloud, config: FitConfig, folder: Path) -> fit.FitState:
    """Fit in memory; ``folder`` takes the log and the pictures."""
    device = drawing_device(config.device, "fit", config.raster)
    start = fit.start_state(config, scene, cloud, *fit.recorded_views(config, scene))
    return optimised(start.to(device), config, folder)


def optimised(state: fit.FitState, config: FitConfig, folder: Path) -> fit.FitState:
    """The state after all steps; as ``fitted``."""
    run = RunDir.open(folder, fit.OUTPUT, result_settings(config), {})
    if not run.fresh:  # the fit starts again, and so does its log
        run.discard()
        run = RunDir.open(folder, fit.OUTPUT, result_settings(config), {})
    fit.optimise(state, config, run)
    return state


def seen_keys(scene: Scene) -> dict[str, NDArray[np.intp]]:
    """Per track of a generated log: numbers of the keys at frames where it shows enough pixels."""
    times: dict[int, list[float]] = {}
    for frame in scene.frames:
        pixels = np.bincount(read_label(scene, frame, "instance").ravel())
        for instance in np.flatnonzero(pixels >= SEEN_PX):
            times.setdefault(int(instance), []).append(frame.view.time_s)
    found = {}
    for track in scene.tracks:
        seen = times.get(int(track.id.rsplit("-", 1)[1]), [])
        found[track.id] = np.unique([int(np.abs(track.times_s - time_s).argmin()) for time_s in seen]).astype(np.intp)
    return found


def pose_errors(truth: NDArray[np.float64], keys: NDArray[np.float64], free: bool = True) -> tuple[float, float]:
    """Root mean square errors of poses f64[K, 4, 4] against the truth, metres and radians; ``free``: after the best
    constant motion in the box frame is taken out."""
    local = np.einsum("kji,kj->ki", keys[:, :3, :3], truth[:, :3, 3] - keys[:, :3, 3])
    turn = np.array([geometry.yaw_of(geometry.invert(b) @ a) for a, b in zip(truth, keys)])
    if free:
        local, turn = local - local.mean(0), turn - turn.mean()
    return float(np.sqrt((local**2).sum(1).mean())), float(np.sqrt((turn**2).mean()))


def row_of(truth: Scene, given: Scene, model: SceneModel) -> dict[str, Any]:
    """Errors of every object that was seen at four keys or more, and PSNR over all pixels of dynamic objects in the
    held-out frames together (NaN where there are none)."""
    objects, keys_seen = [], seen_keys(truth)
    for node in model.nodes:
        if not isinstance(node, RigidNode) or len(keys_seen[node.name]) < FEWEST_KEYS:
            continue
        seen = keys_seen[node.name]
        tracks = [scene.track(node.name).world_from_object for scene in (truth, given)]
        exact, before, after = (keys[seen] for keys in (*tracks, node.corrected_keys()))
        row = {"object": node.name, "keys": len(seen)}
        for name, keys in (("before", before), ("after", after)):
            for place, free in ((name, True), (f"{name}_absolute", False)):
                row[f"{place}_m"], row[f"{place}_rad"] = pose_errors(exact, keys, free)
        objects.append(row)
    errors = [torch.zeros(0)]
    for frame in truth.frames_in("test"):
        moving = torch.from_numpy(read_label(truth, frame, "dynamic").astype(bool))
        photo = torch.from_numpy(read_image(truth, frame)).permute(2, 0, 1).float() / 255
        errors.append((render_view(model, frame.view, raster_of(model)).rgb - photo)[:, moving].flatten())
    return {"objects": objects, "psnr_moving": metrics.psnr_of_errors(torch.cat(errors))}


def summary(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Per kind of box and way of fitting: errors pooled over keys, shares recovered, mean PSNR on dynamic objects."""
    made = []
    for kind, poses in dict.fromkeys((row["boxes"], row["poses"]) for row in rows):
        mine = [row for row in rows if (row["boxes"], row["poses"]) == (kind, poses)]
        objects = [found for row in mine for found in row["objects"]]
        keys = np.array([found["keys"] for found in objects], float)
        pooled, units = {}, ("m", "rad")
        for when, how, unit in itertools.product(("before", "after"), ("", "_absolute"), units):
            squares = np.array([found[f"{when}{how}_{unit}"] for found in objects]) ** 2
            pooled[f"{when}{how}_{unit}"] = float(np.sqrt((squares * keys).sum() / keys.sum()))
        shares = {f"recovered_{u}": 1 - pooled[f"after_{u}"] / max(pooled[f"before_{u}"], 1e-9) for u in units}
        psnr = float(np.nanmean([row["psnr_moving"] for row in mine]))
        counts = {"boxes": kind, "poses": poses, "objects": len(objects), "keys": int(keys.sum())}
        made.append({**counts, **pooled, **shares, "psnr_moving": psnr})
    return made


def table(result: dict[str, Any]) -> str:
    """The summary as text."""
    heads = ["boxes", "poses", "objects", "position [m]", "after", "recovered", "yaw [deg]", "after", "recovered"]
    cells = []
    for row in result["summary"]:
        recoverable = row["boxes"] in ("noise", "drift") and row["poses"] != "fixed"
        shares = [f"{row[f'recovered_{unit}']:.0%}" if recoverable else "-" for unit in ("m", "rad")]
        degrees = [f"{np.degrees(row[f'{when}_rad']):.2f}" for when in ("before", "after")]
        metres = [f"{row['before_m']:.3f}", f"{row['after_m']:.3f}", shares[0]]
        last = [shares[1], f"{row['after_absolute_m']:.3f}", f"{row['psnr_moving']:.2f}"]
        cells.append([row["boxes"], row["poses"], str(row["objects"]), *metres, *degrees, *last])
    size = f"{FRAMES} frames, {WIDTH}x{HEIGHT}, {result['iterations']} steps"
    lines = [
        f"# Boxes of {len(result['cities'])} generated logs ({size})",
        "",
        f"noise: {NOISE_M} m along each axis and 1 degree, anew per key; drift: the same, correlated over {DRIFT_S} s;"
        " offset: once per",
        "object. A constant motion per object is taken out of all errors but the absolute one.",
        "",
        *markdown_table([*heads, "absolute [m]", "PSNR moving [dB]"], cells),
    ]
    return "\n".join(lines) + "\n"


MOVE: Final = "- move: {id: ID, along_m: 3, ground: false}"
EDITS: Final = {
    "remove": "- remove: {ids: [ID]}",
    "move 3 m ahead": MOVE,
    "move 1 m left": "- move: {id: ID, left_m: 1, ground: false}",
    "turn 10 degrees": "- move: {id: ID, yaw_deg: 10, ground: false}",
    "half the speed": "- speed: {id: ID, factor: 0.5}",
    "brake": "- stop: {id: ID, at_s: 0.3, brake_m_s2: 6}",
    "lane change": "- lane_change: {id: ID, left_m: 1.5, start_s: 0.0, duration_s: 1.5, ground: false}",
}
"""Name of a row -> script."""
REPAIRED_EDITS: Final = {
    "remove": "- remove: {ids: [ID]}",
    "move 3 m ahead": MOVE,
    "insert": "- remove: {ids: [ID]}\n- insert: {id: new, asset: {file: ASSET}, path: PATH, ground: false}",
}
"""The edits that a diffusion model repairs."""
REPAIRS: Final = ("fit", "+ diffusion", "+ refit", "never there")
LIGHTS: Final = {"light matched": "true", "as recorded": "false"}
"""How vehicles of other cities are put in -> `match_light`."""
CHANGED: Final = 4 / 255
NEARBY_PX: Final = 3
EVERY_FRAMES: Final = 3
FEWEST_PX: Final = 30
"""A frame counts for a vehicle of another city if it shows so many pixels of it."""
Seen = tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.bool_]]
"""Render and truth f32[H, W, 3], and the vehicle's pixels bool[H, W]."""


@dataclass(frozen=True, slots=True, eq=False)
class EditCase:
    """One fitted city and the vehicle that is edited in it."""

    city: int
    world: CityWorld
    scene: Scene
    model: SceneModel
    name: str

    @property
    def instance(self) -> int:
        """Number of the vehicle in the city's labels."""
        return self.world.instance_of(self.name)


def measure_edits(config: BenchConfig, out: Path) -> tuple[dict[str, Any], str]:
    """The edits of fitted scenes, vehicles of other cities, and, if asked for, what a diffusion model adds; numbers and
    tables. Cities that an interrupted run finished are kept."""
    names, cases = LISTS[config.cities][: config.count], {}

    def case(city: int) -> EditCase:
        if city not in cases:
            cases[city] = case_of(config, city, out)
        return cases[city]

    def rows(task: str, parts: Mapping[str, Callable[[int], list[dict[str, Any]]]]) -> list[dict[str, Any]]:
        found = []
        with log.task(task, len(names)) as bar:
            for city in names:
                for name, measured in parts.items():
                    found += finished(out / "rows" / f"{city}_{name}.json", partial(measured, city))
                bar.advance()
        return found

    edits = lambda city: [_edited_row(case(city), name, text) for name, text in EDITS.items()]
    edited = rows("editing", {"edits": edits})
    first = dict.fromkeys(("edit", "cities", "outside"))  # the order of these in bench.json
    means = [{**first, **row} for row in EDITED.summary(edited)]
    result = {"cities": list(names), "iterations": config.pose_iterations, "rows": edited, "summary": means}
    title = EDITED.title.format(cities=len(names), iterations=config.pose_iterations)
    text = replace(EDITED, title=title).table(means)
    if len(names) > 1:
        giver = dict(zip(names, [*names[1:], *names[:1]], strict=True))
        insert = lambda city: _replaced_rows(case(city), case(giver[city]), out)
        replaced = rows("inserting vehicles of other cities", {"insert": insert})
        result["insert"] = {"rows": replaced, "summary": REPLACED.summary(replaced)}
        text += REPLACED.table(result["insert"]["summary"])
    if config.harmonize:
        repairs = lambda edit: lambda city: _repaired_rows(config, case(city), edit, out)
        parts = {f"{edit.replace(' ', '_')}_diffusion": repairs(edit) for edit in REPAIRED_EDITS}
        repaired = rows("editing with diffusion", parts)
        result["diffusion"] = {"rows": repaired, "summary": REPAIRED.summary(repaired)}
        text += REPAIRED.table(result["diffusion"]["summary"])
    return result, text


def case_of(config: BenchConfig, city: int, out: Path) -> EditCase:
    """A city, the scene fitted to it, and the vehicle that is edited: of those with a node of their own the one that
    shows the most pixels. InputError: there is none."""
    scene = city_scene(city, out / "cities" / str(city))
    settings = fit_settings(config, "fixed")
    state = fitted(scene, cloud_of(scene), settings, out / "fits" / f"{city}_edit")
    fit.add_certainty(state, settings)
    shown = (np.bincount(read_label(scene, frame, "instance").ravel(), minlength=4096) for frame in scene.frames)
    pixels = np.sum(list(shown), 0)
    names = [name for name in state.model.node_names() if name.startswith(("car", "truck", "bus"))]
    if not names:
        raise InputError("no vehicle moves in this city", where=scene.id)
    name = max(names, key=lambda name: pixels[int(name.rsplit("-", 1)[1])])
    return EditCase(city, CityWorld.from_source(scene.source), scene, state.model, name)


# ---- an edited city against its truth ----


def _edited_row(case: EditCase, name: str, text: str) -> dict[str, Any]:
    """Scores of one edit."""
    drive = carry_out(parse_edits(text.replace("ID", case.name), name), case.model, case.scene)
    truth, edited = _true_city(case, drive, case.name), drive.model(case.model)
    found = _compared(case, truth, drawer(edited), drawer(case.model), models=(edited, case.model))
    gone = {} if case.name in drive.plan.after.actors else {"overlap": None}
    return {"city": case.city, "object": case.name, "edit": name, **found, **gone}


def _true_city(case: EditCase, drive: EditedDrive, name: str) -> CityWorld:
    """The city in which the vehicle goes on the path of ``name`` after the edit, or is not there."""
    actor = drive.plan.after.actors.get(name)
    keys = None if actor is None else city_keys(actor.motion.at(case.world.key_times_s), actor.size_m[2])
    return case.world.rearranged({case.name: keys})


def city_keys(motion: Motion, height_m: float) -> NDArray[np.float64]:
    """A path as the city holds it: x, y, z on the ground, yaw f64[K, 4]."""
    yaws = np.unwrap([geometry.yaw_of(pose) for pose in motion.poses])
    return np.column_stack([motion.poses[:, :2, 3], motion.poses[:, 2, 3] - height_m / 2, yaws])


def _compared(
    case: EditCase, truth: CityWorld, edited: Drawer, unedited: Drawer, models: Sequence[SceneModel] = ()
) -> dict[str, Any]:
    """Scores of one way to make the edited frames, beside the fit without the edit; with both ``models`` also the
    overlap of the vehicle, without them the perceptual distance."""
    errors: dict[str, list[NDArray[np.float32]]] = {}
    # with and without the edit: pixels in both, pixels in either
    outside, distances, counts = [], [], np.zeros((2, 2), np.int64)
    for frame in case.scene.frames[::EVERY_FRAMES]:
        now, then = truth.render(frame.view), case.world.render(frame.view)
        made, usual = (draw(frame.view).rgb.permute(1, 2, 0).numpy() for draw in (edited, unedited))
        mask = np.abs(now.rgb - then.rgb).max(-1) > CHANGED
        new, old, mine = made - now.rgb, usual - then.rgb, now.instance == case.instance
        parts = {
            "inside": new[mask],
            "inside_before": old[mask],
            "vehicle": new[mine],
            "vehicle_before": old[then.instance == case.instance],
            "uncovered": new[mask & ~mine],
        }
        for place, part in parts.items():
            errors.setdefault(place, []).append(part)
        far = np.logical_not(ndimage.binary_dilation(mask, iterations=NEARBY_PX))
        outside.append((np.abs(made - usual).max(-1) > SAME)[far])
        for row, (seen, model) in enumerate(zip((now, then), models)):
            true, drawn = seen.instance == case.instance, drawn_pixels(model, case.name, frame.view)
            counts[row] += (true & drawn).sum(), (true | drawn).sum()
        if not models and mask.any():
            distances.append(distance_in(made, now.rgb, mask))
    psnr = {place: psnr_in(found) for place, found in errors.items()}
    away = float(np.concatenate(outside).mean())
    if not models:
        parts = {place: psnr[place] for place in ("inside", "vehicle", "uncovered")}
        return {**parts, "outside": away, "perceptual": _mean(distances)}
    overlaps = [float(a / b) if b else None for a, b in counts]
    pixels = int(sum(map(len, errors["inside"])))
    return {"pixels": pixels, **psnr, "outside": away, "overlap": overlaps[0], "overlap_before": overlaps[1]}


def drawn_pixels(model: SceneModel, name: str, view: View) -> NDArray[np.bool_]:
    """Pixels bool[H, W] of which an object's Gaussians make more than half."""
    if name not in model.node_names():
        return np.zeros((view.camera.height, view.camera.width), bool)
    gaussians = compose(model, view.time_s, semantics=False)
    mine = (gaussians.node == model.nodes.index(model.dynamic_object(name))).float()[:, None]
    with torch.no_grad():
        render = rasterize(replace(gaussians, extra=mine), view, raster_of(model))
    return np.zeros(0, bool) if render.extra is None else (render.extra[0] > 0.5).cpu().numpy()


def psnr_in(errors: Sequence[NDArray[np.float32]]) -> float | None:
    """PSNR of some pixels' errors, each f32[n, 3]; None where there is no pixel."""
    every = torch.from_numpy(np.concatenate(errors)) if errors else torch.zeros(0)
    return metrics.psnr_of_errors(every) if len(every) else None


def distance_in(generated: NDArray[np.float32], true: NDArray[np.float32], mask: NDArray[np.bool_]) -> float:
    """Perceptual distance of two images f32[H, W, 3], weighted by the pixels of a mask."""
    features = shipped_features()
    pair = [torch.from_numpy(np.ascontiguousarray(image.transpose(2, 0, 1))) for image in (generated, true)]
    with torch.no_grad():
        weight = torch.from_numpy(mask).float()[None]
        return float(lpips_distance(features(pair[0]), unit_features(features(pair[1])), weight, over_weight=True))


def _mean(values: Iterable[float | None]) -> float | None:
    """The mean of those that are numbers."""
    known = [value for value in values if value is not None]
    return float(np.mean(known)) if known else None


# ---- summaries ----


@dataclass(frozen=True)
class Part:
    """A part of the benchmark: what its rows are grouped by, with values in order, the title and headings of its table,
    and its numbers as text. A city counts where the first of ``numbers`` exists."""

    title: str
    heads: tuple[str, ...]
    groups: Mapping[str, Sequence[str]]
    numbers: Mapping[str, str]

    def summary(self, rows: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
        """Means over the cities that count; of light the root mean square factor."""
        made, first = [], next(iter(self.numbers))
        for values in itertools.product(*self.groups.values()):
            names = dict(zip(self.groups, values, strict=True))
            mine = [row for row in rows if names.items() <= row.items() and row[first] is not None]
            if mine:
                found = {key: [row[key] for row in mine] for key in self.numbers if key != "ratio"}
                means = {key: _mean(numbers) for key, numbers in found.items()}
                if "light" in means:
                    means["light"] = float(np.exp(np.sqrt(np.mean(np.log(found["light"]) ** 2))))
                made.append({**names, "cities": len(mine), **means})
        return made

    def table(self, summary: Sequence[Mapping[str, Any]]) -> str:
        """The summary as text."""
        rows = []
        for row in summary:
            ratio = {"ratio": row["perceptual"] / row["perceptual_recorded"]} if "ratio" in self.numbers else {}
            rows.append([*(row[name] for name in self.groups), *cells({**row, **ratio}, self.numbers)])
        return "\n".join([self.title, "", *markdown_table(self.heads, rows)]) + "\n"


_PIXELS: Final = ("inside", "inside_before", "vehicle", "vehicle_before", "uncovered")
EDITED: Final = Part(
    "# Edits of {cities} fitted cities ({iterations} steps) against the cities drawn again",
    (
        *("edit", "changed pixels [dB]", "unedited", "vehicle [dB]", "unedited"),
        *("uncovered [dB]", "outside changed", "overlap", "unedited"),
    ),
    {"edit": tuple(EDITS)},
    {**dict.fromkeys(_PIXELS, "{:.2f}"), "outside": "{:.2%}", "overlap": "{:.2f}", "overlap_before": "{:.2f}"},
)
REPLACED: Final = Part(
    "\n## Vehicles of other cities",
    ("inserted", "vehicle [dB]", "recorded there", "perceptual", "recorded there", "ratio", "light off by"),
    {"way": tuple(LIGHTS)},
    {
        "psnr": "{:.2f}",
        "psnr_recorded": "{:.2f}",
        "perceptual": "{:.4f}",
        "perceptual_recorded": "{:.4f}",
        "ratio": "{:.1f}x",
        "light": "{:.2f}x",
    },
)
REPAIRED: Final = Part(
    "\n## With a diffusion model",
    ("edit", "frames", "changed pixels [dB]", "vehicle [dB]", "uncovered [dB]", "perceptual", "outside changed"),
    {"edit": tuple(REPAIRED_EDITS), "way": REPAIRS},
    {**dict.fromkeys(("inside", "vehicle", "uncovered"), "{:.2f}"), "perceptual": "{:.4f}", "outside": "{:.2%}"},
)


# ---- vehicles of other cities ----


def _replaced_rows(case: EditCase, giver: EditCase, out: Path) -> list[dict[str, Any]]:
    """Scores of the vehicle of one city in another, with and without matched light."""
    asset = out / "edited" / f"{giver.city}_vehicle.safetensors"
    if not asset.is_file():
        write_asset(asset, complete_asset(giver.model, giver.name, [frame.view for frame in giver.scene.frames]))
    truth = case.world.recast(case.name, giver.world.objects[giver.instance - 1])
    usual, rows = _seen(case, case.world, case.model), []
    lights = f"{giver.world.light_name} to {case.world.light_name}"
    for way, match in LIGHTS.items():
        text = f"- replace: {{id: {case.name}, by: {{file: {asset}}}, match_light: {match}}}"
        drive = carry_out(parse_edits(text, way), case.model, case.scene)
        row = {"city": case.city, "object": case.name, "from": giver.city, "lights": lights, "way": way}
        rows.append({**row, **vehicle_scores(_seen(case, truth, drive.model(case.model)), usual)})
    return rows


def _seen(case: EditCase, world: CityWorld, model: SceneModel) -> list[Seen]:
    """Render, truth and the vehicle's pixels in the frames that show it."""
    draw, seen = drawer(model), []
    for frame in case.scene.frames[::EVERY_FRAMES]:
        truth = world.render(frame.view)
        if (truth.instance == case.instance).sum() >= FEWEST_PX:
            seen.append((draw(frame.view).rgb.permute(1, 2, 0).numpy(), truth.rgb, truth.instance == case.instance))
    return seen


def vehicle_scores(made: Sequence[Seen], recorded: Sequence[Seen]) -> dict[str, float | None]:
    """PSNR, perceptual distance and light in the pixels of a vehicle, and of the recorded one."""
    found: dict[str, float | None] = {}
    for end, seen in (("", made), ("_recorded", recorded)):
        found["psnr" + end] = psnr_in([(image - true)[mask] for image, true, mask in seen])
        found["perceptual" + end] = _mean(distance_in(image, true, mask) for image, true, mask in seen)
    if not made:
        return {**found, "light": None}
    light = [np.concatenate([linear_of(one[which][one[2]]) for one in made]).mean() for which in (0, 1)]
    return {**found, "light": float(light[1] / light[0])}


# ---- with a diffusion model ----


def _repaired_rows(config: BenchConfig, case: EditCase, name: str, out: Path) -> list[dict[str, Any]]:
    """Rows of one edit, one per way to make its frames."""
    script = parse_edits(_script(case, REPAIRED_EDITS[name], out), "bench")
    drive = carry_out(script, case.model, case.scene, cloud_of(case.scene))
    edited, truth = drive.model(case.model), _true_city(case, drive, "new" if name == "insert" else case.name)
    harmonize = HarmonizeConfig(on=True, model=config.model, seed=config.seed)
    settings = EditConfig(harmonize=harmonize, device=config.device)
    images = repairing(EditedImages(case.model, edited, settings, drive.plan.moves_ego), drive, case.scene)
    frames: dict[float, Observation] = {}
    for frame in case.scene.frames:
        frames[frame.view.time_s] = next((images.repaired or {})[frame.view.camera.name])
    images = replace(images, repaired={name: iter(frames.values()) for name in case.scene.cameras})
    refitted = _refitted(config, case, drive, images, out / "edited" / f"{case.city}_{name.replace(' ', '_')}")
    ways = [drawer(edited), lambda view: frames[view.time_s], drawer(refitted)]
    if name == "remove":  # a fit, with the same settings, of the city in which the object was never there
        folder, own = out / "cities" / f"{case.city}_without", fit_settings(config, "fixed")
        if not (folder / "scene.json").is_file():
            write_world(truth, folder)
        scene = read_scene(folder)
        never = fitted(scene, cloud_of(scene), own, out / "fits" / f"{case.city}_without")
        ways.append(drawer(never.model))
    row, usual = {"city": case.city, "object": case.name, "edit": name}, drawer(case.model)
    return [{**row, "way": way, **_compared(case, truth, draw, usual)} for way, draw in zip(REPAIRS, ways)]


def _script(case: EditCase, text: str, out: Path) -> str:
    """The script of an edit; an asset that it names is written first."""
    if "ASSET" in text:
        asset = out / "edited" / f"{case.city}.safetensors"
        write_asset(asset, complete_asset(case.model, case.name, [frame.view for frame in case.scene.frames]))
        moved = carry_out(parse_edits(MOVE.replace("ID", case.name), "move"), case.model, case.scene)
        motion = moved.plan.after.actors[case.name].motion
        yaws = np.degrees(np.unwrap(np.arctan2(motion.poses[:, 1, 0], motion.poses[:, 0, 0])))
        rows = np.column_stack([motion.times_s, motion.poses[:, :2, 3], yaws])
        path = [[round(float(x), 4) for x in row] for row in rows]
        text = text.replace("PATH", str(path)).replace("ASSET", str(asset))
    return text.replace("[ID]", f"[{case.name}]").replace("id: ID", f"id: {case.name}")


def _refitted(config: BenchConfig, case: EditCase, drive: EditedDrive, images: EditedImages, out: Path) -> SceneModel:
    """The edited fit after as many steps again on the repaired images; as `mudg fit --start-from` on an edited run does
    it."""
    if not (out / "scene" / "scene.json").is_file():
        write_edited_scene(case.scene, drive, images, out / "scene")
    save_model(images.after, out / "start")
    scene, start = read_scene(out / "scene"), StartFit(out / "start", "")
    settings = fit_settings(config, "fixed")
    views, classes = fit.recorded_views(settings, scene, None, start)
    state = fit.continued_state(whole_run(settings), start, views, classes)
    return optimised(state, whole_run(settings), out / "fit").model
