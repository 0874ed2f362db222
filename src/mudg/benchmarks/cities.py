"""Measurements on generated cities, each one folder: ``mudg bench mdm`` and ``edit``.

mdm: the diffusion model on held-out cities beside the recorded path, against exact truth. edit: edits of fitted scenes
against the city drawn again with the object elsewhere or gone, and vehicles of other cities (docs/research/edit.md)."""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch
from numpy.typing import NDArray
from scipy import ndimage

from mudg.base import geometry, log
from mudg.base.config import result_settings
from mudg.base.devices import NETWORK_KINDS, choose_device
from mudg.base.errors import InputError
from mudg.base.html import cells, markdown_table
from mudg.base.run_folder import RunDir
from mudg.base.types import Scene, View
from mudg.benchmarks.chain import finished
from mudg.benchmarks.columns import shipped_features
from mudg.benchmarks.settings import BenchConfig
from mudg.city.config import CityConfig
from mudg.city.logs import write_city
from mudg.city.world import CityWorld
from mudg.core import metrics
from mudg.core.edit import Motion
from mudg.core.fusion import fuse_sweeps
from mudg.core.losses import lpips_distance, unit_features
from mudg.core.raster.rasterize import drawing_device, rasterize
from mudg.diffusion import city_clips as from_city
from mudg.diffusion import model_files as mdm_files
from mudg.diffusion import models as learn_score
from mudg.diffusion.city_clips import CityClipRules
from mudg.diffusion.clips import ShardFolder
from mudg.diffusion.model import MDM
from mudg.diffusion.requests import SampleRequest, half_format
from mudg.editing.apply import carry_out, complete_asset, drawer, write_asset
from mudg.editing.model import linear_of
from mudg.editing.script import parse_edits
from mudg.gaussians import fit
from mudg.gaussians.model import SceneModel, compose
from mudg.gaussians.rendering import raster_of
from mudg.gaussians.settings import DensifyConfig, FitConfig, PoseConfig, RecordedLossConfig, StartConfig
from mudg.scene.fuse import rules_of, scene_sweeps
from mudg.scene.labels import read_label
from mudg.scene.read import read_scene
from mudg.scene.settings import FuseConfig


def measure_mdm(config: BenchConfig, out: Path) -> tuple[dict[str, Any], str]:
    """Scores of the model at every number of steps, with and without classes; numbers and tables."""
    device = choose_device(config.device, "diffusion model", NETWORK_KINDS)
    bf16 = half_format(config.precision, device) is not None
    request = SampleRequest(1, config.seed, eta=config.eta, bf16=bf16)
    MDM.check_request(request)
    model = mdm_files.load(config.model).to(device)
    cities = from_city.LISTS[config.cities][: config.count]
    rules = CityClipRules(window=model.config.window, fitted=model.config.renders)
    from_city.write_missing(rules, cities, out / "clips")
    result: dict[str, Any] = {"cities": list(cities), "model": mdm_files.digest(config.model), "bf16": bf16, "rows": []}
    lines = [f"# Diffusion model on {len(cities)} held-out cities ({config.cities} list), exact truth", ""]
    with log.task("scoring", 2 * len(config.steps)) as bar:
        for given, steps in itertools.product((True, False), config.steps):
            picture = out / f"steps_{steps}_{'classes' if given else 'plain'}.png"
            prepare, started = None if given else learn_score.without_classes, time.perf_counter()
            sampled = replace(request, steps=steps)
            scores = learn_score.score(
                model, cities, ShardFolder(out / "clips"), sampled, prepare=prepare, picture=picture
            )
            seconds = (time.perf_counter() - started) / scores["clips"]
            row = {"steps": steps, "given_classes": given, "seconds_per_clip": round(seconds, 2), "scores": scores}
            result["rows"].append(row)
            title = f"{steps} step{'s' if steps > 1 else ''}, classes {'given' if given else 'withheld'}"
            lines += [f"## {title}, {seconds:.1f} s per clip with its scoring", "", "```"]
            lines += [learn_score.table(scores), "```", ""]
            bar.update(title)
            bar.advance()
    return result, "\n".join(lines)


LISTS: dict[str, tuple[int, ...]] = {
    "development": (2_000_000, 2_000_001, 2_000_002, 2_000_003),
    "reported": tuple(range(2_000_100, 2_000_106)),
}
"""Seeds of cities: for development, and to report on."""
FRAMES, WIDTH, HEIGHT = 16, 240, 160


def fit_settings(config: BenchConfig) -> FitConfig:
    """A small, quick fit."""
    return FitConfig(
        method="street_gaussians",
        iterations=config.edit_iterations,
        seed=config.seed,
        device=config.device,
        preview_every=10**6,
        checkpoint_every=10**6,
        start=StartConfig(gaussians=8000),
        densify=DensifyConfig(kind="none"),
        loss=RecordedLossConfig(semantic_every=1000),
        poses=PoseConfig(learn=False),
    )


def city_scene(seed: int, folder: Path) -> Scene:
    """A small generated log, made when missing."""
    if not (folder / "scene.json").is_file():
        sizes = {"n_frames": FRAMES, "width": WIDTH, "height": HEIGHT, "cameras": ("front",)}
        write_city(CityConfig(seed=seed, **sizes, lidar_azimuth_step_deg=0.8), folder)
    return read_scene(folder)


def fitted(scene: Scene, config: FitConfig, folder: Path) -> fit.FitState:
    """Fit in memory; ``folder`` takes the log and the pictures."""
    cloud = fuse_sweeps(scene_sweeps(scene, FuseConfig()), scene.tracks, rules_of(FuseConfig()))[0]
    device = drawing_device(config.device, "fit", config.raster)
    state = fit.start_state(config, scene, cloud, *fit.recorded_views(config, scene)).to(device)
    run = RunDir.open(folder, fit.OUTPUT, result_settings(config), {})
    if not run.fresh:  # the fit starts again, and so does its log
        run.discard()
        run = RunDir.open(folder, fit.OUTPUT, result_settings(config), {})
    fit.optimise(state, config, run)
    return state


EDITS: Final = {
    "remove": "- remove: {ids: [ID]}",
    "move 3 m ahead": "- move: {id: ID, along_m: 3, ground: false}",
    "move 1 m left": "- move: {id: ID, left_m: 1, ground: false}",
    "turn 10 degrees": "- move: {id: ID, yaw_deg: 10, ground: false}",
    "half the speed": "- speed: {id: ID, factor: 0.5}",
    "brake": "- stop: {id: ID, at_s: 0.3, brake_m_s2: 6}",
    "lane change": "- lane_change: {id: ID, left_m: 1.5, start_s: 0.0, duration_s: 1.5, ground: false}",
}
"""Name of a row -> script."""
LIGHTS: Final = {"light matched": "true", "as recorded": "false"}
"""How vehicles of other cities are put in -> `match_light`."""
CHANGED: Final = 4 / 255
SAME: Final = 1.5 / 255
"""Colours of 8 bits that differ by more than this differ by more than one step."""
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
    """The edits of fitted scenes and vehicles of other cities; numbers and tables. Cities that an interrupted run
    finished are kept."""
    names, cases = LISTS[config.cities][: config.count], {}

    def case(city: int) -> EditCase:
        if city not in cases:
            cases[city] = case_of(config, city, out)
        return cases[city]

    def rows(task: str, part: str, measured: Callable[[int], list[dict[str, Any]]]) -> list[dict[str, Any]]:
        found = []
        with log.task(task, len(names)) as bar:
            for city in names:
                found += finished(out / "rows" / f"{city}_{part}.json", partial(measured, city))
                bar.advance()
        return found

    edited = rows("editing", "edits", lambda city: [_edited_row(case(city), *edit) for edit in EDITS.items()])
    first = dict.fromkeys(("edit", "cities", "outside"))  # the order of these in bench.json
    means = [{**first, **row} for row in EDITED.summary(edited)]
    result = {"cities": list(names), "iterations": config.edit_iterations, "rows": edited, "summary": means}
    title = EDITED.title.format(cities=len(names), iterations=config.edit_iterations)
    text = replace(EDITED, title=title).table(means)
    if len(names) > 1:
        giver = dict(zip(names, [*names[1:], *names[:1]], strict=True))
        insert = lambda city: _replaced_rows(case(city), case(giver[city]), out)
        replaced = rows("inserting vehicles of other cities", "insert", insert)
        result["insert"] = {"rows": replaced, "summary": REPLACED.summary(replaced)}
        text += REPLACED.table(result["insert"]["summary"])
    return result, text


def case_of(config: BenchConfig, city: int, out: Path) -> EditCase:
    """A city, the scene fitted to it, and the vehicle that is edited: of those with a node of their own the one that
    shows the most pixels. InputError: there is none."""
    scene = city_scene(city, out / "cities" / str(city))
    settings = fit_settings(config)
    state = fitted(scene, settings, out / "fits" / f"{city}_edit")
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
    """Scores of one edit against the city in which the vehicle goes on the edited path, or is not there."""
    drive = carry_out(parse_edits(text.replace("ID", case.name), name), case.model, case.scene)
    actor = drive.plan.after.actors.get(case.name)
    keys = None if actor is None else city_keys(actor.motion.at(case.world.key_times_s), actor.size_m[2])
    found = _compared(case, case.world.rearranged({case.name: keys}), drive.model(case.model))
    return {
        "city": case.city,
        "object": case.name,
        "edit": name,
        **found,
        **({} if actor is not None else {"overlap": None}),
    }


def city_keys(motion: Motion, height_m: float) -> NDArray[np.float64]:
    """A path as the city holds it: x, y, z on the ground, yaw f64[K, 4]."""
    yaws = np.unwrap([geometry.yaw_of(pose) for pose in motion.poses])
    return np.column_stack([motion.poses[:, :2, 3], motion.poses[:, 2, 3] - height_m / 2, yaws])


def _compared(case: EditCase, truth: CityWorld, model: SceneModel) -> dict[str, Any]:
    """Scores of the edited model, beside those of the fit without the edit."""
    errors: dict[str, list[NDArray[np.float32]]] = {}
    # with and without the edit: pixels in both, pixels in either
    outside, counts, draws = [], np.zeros((2, 2), np.int64), (drawer(model), drawer(case.model))
    for frame in case.scene.frames[::EVERY_FRAMES]:
        now, then = truth.render(frame.view), case.world.render(frame.view)
        made, usual = (draw(frame.view).rgb.permute(1, 2, 0).numpy() for draw in draws)
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
        for row, (seen, own) in enumerate(((now, model), (then, case.model))):
            true, drawn = seen.instance == case.instance, drawn_pixels(own, case.name, frame.view)
            counts[row] += (true & drawn).sum(), (true | drawn).sum()
    overlaps = dict(zip(("overlap", "overlap_before"), (float(a / b) if b else None for a, b in counts), strict=True))
    psnr = {place: psnr_in(found) for place, found in errors.items()}
    away = float(np.concatenate(outside).mean())
    return {"pixels": int(sum(map(len, errors["inside"]))), **psnr, "outside": away, **overlaps}


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
    """A part of the benchmark: what tells its rows apart, with values in order, the title and headings of its table,
    and its numbers as text. A city counts where the first of ``numbers`` exists."""

    title: str
    heads: tuple[str, ...]
    group: str
    values: Iterable[str]
    numbers: Mapping[str, str]

    def summary(self, rows: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
        """Means over the cities that count; of light the root mean square factor."""
        made, first = [], next(iter(self.numbers))
        for value in self.values:
            mine = [row for row in rows if row[self.group] == value and row[first] is not None]
            if mine:
                means = {key: _mean(row[key] for row in mine) for key in self.numbers if key != "ratio"}
                if "light" in means:
                    means["light"] = float(np.exp(np.sqrt(np.mean(np.log([row["light"] for row in mine]) ** 2))))
                made.append({self.group: value, "cities": len(mine), **means})
        return made

    def table(self, summary: Sequence[Mapping[str, Any]]) -> str:
        """The summary as text."""
        rows = []
        for row in summary:
            ratio = {"ratio": row["perceptual"] / row["perceptual_recorded"]} if "ratio" in self.numbers else {}
            rows.append([row[self.group], *cells({**row, **ratio}, self.numbers)])
        return "\n".join([self.title, "", *markdown_table(self.heads, rows)]) + "\n"


EDITED: Final = Part(
    "# Edits of {cities} fitted cities ({iterations} steps) against the cities drawn again",
    (
        *("edit", "changed pixels [dB]", "unedited", "vehicle [dB]", "unedited"),
        *("uncovered [dB]", "outside changed", "overlap", "unedited"),
    ),
    "edit",
    EDITS,
    {
        **dict.fromkeys(("inside", "inside_before", "vehicle", "vehicle_before", "uncovered"), "{:.2f}"),
        "outside": "{:.2%}",
        **dict.fromkeys(("overlap", "overlap_before"), "{:.2f}"),
    },
)
REPLACED: Final = Part(
    "\n## Vehicles of other cities",
    ("inserted", "vehicle [dB]", "recorded there", "perceptual", "recorded there", "ratio", "light off by"),
    "way",
    LIGHTS,
    {
        **dict.fromkeys(("psnr", "psnr_recorded"), "{:.2f}"),
        **dict.fromkeys(("perceptual", "perceptual_recorded"), "{:.4f}"),
        "ratio": "{:.1f}x",
        "light": "{:.2f}x",
    },
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
