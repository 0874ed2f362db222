"""``mudg bench edit``: edits of fitted scenes against exact truth, the generated city drawn again with the object
elsewhere or gone.

Of every city the vehicle that shows the most pixels is edited in a scene that was fitted to the city as it was. Truth
is the same city with that vehicle on the edited path (``CityWorld.rearranged``), shadows included. Over frames of the
recorded path:

    inside     PSNR in the pixels that the edit changes in the truth (by more than 4/255), against the edited truth; and
               of the unedited render in the same pixels, against the unedited truth: what the fit can do there at all
    vehicle    PSNR in all pixels of the vehicle, with the edit and without
    uncovered  PSNR in those of the changed pixels that show no vehicle any more: what stood behind it, and its shadow
    outside    share of the other pixels that the edit changes in the render by more than 1/255
    overlap    intersection over union of the vehicle's pixels in the truth and in the render, where its Gaussians make
               more than half; and the same without the edit
    perceptual  perceptual distance in the changed pixels (features of the shipped codec)

With several cities the vehicle of each is also replaced by that of the next one, which knows nothing of this city but
what `matched_light` tells. Truth is the city with a vehicle of that shape, size and paint on the path of its own, in
its own light (``CityWorld.recast``). Beside it stands what the fit makes of its own vehicle, which was recorded there.
light: true mean light of the vehicle over that of the render, in linear light: 1 = as bright as it should be.

With a diffusion model (``--harmonize``) three edits are made in three ways: the fitted scene with the edits; its frames
with the touched pixels repaired by the model (``editing/harmonised.py``); renders of a fit that goes on for as many
steps again on an edited drive whose images are such frames. Besides a fit of the same city in which the object was
never there: what a scene of this size can show at all. `insert` takes the object away and puts its own asset in 3 m
ahead, so that the truth is that of the move.
"""

from __future__ import annotations

import itertools
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
from mudg.base.errors import InputError
from mudg.base.html import cells, markdown_table
from mudg.base.types import Observation, Scene, View
from mudg.benchmarks import poses as bench_poses
from mudg.benchmarks.columns import shipped_features
from mudg.benchmarks.loop import finished
from mudg.benchmarks.settings import BenchConfig
from mudg.city.logs import write_world
from mudg.city.world import CityWorld
from mudg.core import metrics
from mudg.core.edit import Motion
from mudg.core.losses import lpips_distance, unit_features
from mudg.core.raster.rasterize import rasterize
from mudg.core.view_metrics import SAME
from mudg.diffusion.settings import HarmonizeConfig
from mudg.editing.assets import complete_asset, write_asset
from mudg.editing.carried import EditedDrive, carry_out
from mudg.editing.harmonised import repairing
from mudg.editing.model import linear_of
from mudg.editing.recorded import DriveChange, EditedImages, write_edited_scene
from mudg.editing.script import parse_edits
from mudg.editing.settings import EditConfig
from mudg.gaussians import fit
from mudg.gaussians.model import SceneModel, compose
from mudg.gaussians.rendering import raster_of, render_view
from mudg.gaussians.storage import StartFit, save_model, whole_run
from mudg.scene.labels import read_label
from mudg.scene.read import read_scene

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
Draw = Callable[[View], torch.Tensor]
"""The image f32[3, H, W] of a view."""
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


def measure(config: BenchConfig, out: Path) -> tuple[dict[str, Any], str]:
    """The edits of fitted scenes, vehicles of other cities, and, if asked for, what a diffusion model adds; numbers and
    tables. Cities that an interrupted run finished are kept."""
    names, cases = bench_poses.LISTS[config.cities][: config.count], {}

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

    edited = rows(
        "editing", {"edits": lambda city: [_edited_row(case(city), name, text) for name, text in EDITS.items()]}
    )
    first = dict.fromkeys(("edit", "cities", "outside"))  # the order of these in bench.json
    means = [{**first, **row} for row in EDITED.summary(edited)]
    result = {"cities": list(names), "iterations": config.pose_iterations, "rows": edited, "summary": means}
    title = EDITED.title.format(cities=len(names), iterations=config.pose_iterations)
    text = replace(EDITED, title=title).table(means)
    if len(names) > 1:
        giver = dict(zip(names, [*names[1:], *names[:1]], strict=True))
        replaced = rows(
            "inserting vehicles of other cities",
            {"insert": lambda city: _replaced_rows(case(city), case(giver[city]), out)},
        )
        result["insert"] = {"rows": replaced, "summary": REPLACED.summary(replaced)}
        text += REPLACED.table(result["insert"]["summary"])
    if config.harmonize:
        parts = {f"{edit.replace(' ', '_')}_diffusion": edit for edit in REPAIRED_EDITS}
        repaired = rows(
            "editing with diffusion",
            {
                name: lambda city, edit=edit: _repaired_rows(config, case(city), edit, out)
                for name, edit in parts.items()
            },
        )
        result["diffusion"] = {"rows": repaired, "summary": REPAIRED.summary(repaired)}
        text += REPAIRED.table(result["diffusion"]["summary"])
    return result, text


def case_of(config: BenchConfig, city: int, out: Path) -> EditCase:
    """A city, the scene fitted to it, and the vehicle that is edited."""
    scene = bench_poses.city_scene(city, out / "cities" / str(city))
    settings = bench_poses.fit_settings(config, "fixed")
    state = bench_poses.fitted(scene, bench_poses.cloud_of(scene), settings, out / "fits" / f"{city}_edit")
    fit.add_certainty(state, settings)
    return EditCase(city, CityWorld.from_source(scene.source), scene, state.model, most_visible(scene, state.model))


def most_visible(scene: Scene, model: SceneModel) -> str:
    """The vehicle with a node of its own that shows the most pixels.

    Raises:
        InputError: the city has none.
    """
    pixels = np.sum(
        [np.bincount(read_label(scene, frame, "instance").ravel(), minlength=4096) for frame in scene.frames], 0
    )
    names = [name for name in model.node_names() if name.startswith(("car", "truck", "bus"))]
    if not names:
        raise InputError("no vehicle moves in this city", where=scene.id)
    return max(names, key=lambda name: pixels[int(name.rsplit("-", 1)[1])])


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
    case: EditCase, truth: CityWorld, edited: Draw, unedited: Draw, models: tuple[SceneModel, SceneModel] | None = None
) -> dict[str, Any]:
    """Scores of one way to make the edited frames, beside the fit without the edit; with both ``models`` also the
    overlap of the vehicle, without them the perceptual distance."""
    errors: dict[str, list[NDArray[np.float32]]] = {}
    # with and without the edit: pixels in both, pixels in either
    outside, distances, counts = [], [], np.zeros((2, 2), np.int64)
    for frame in case.scene.frames[::EVERY_FRAMES]:
        now, then = truth.render(frame.view), case.world.render(frame.view)
        made, usual = (draw(frame.view).permute(1, 2, 0).numpy() for draw in (edited, unedited))
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
        for row, (seen, model) in enumerate(zip((now, then), models or ())):
            true, drawn = seen.instance == case.instance, drawn_pixels(model, case.name, frame.view)
            counts[row] += (true & drawn).sum(), (true | drawn).sum()
        if models is None and mask.any():
            distances.append(distance_in(made, now.rgb, mask))
    psnr = {place: psnr_in(found) for place, found in errors.items()}
    away = float(np.concatenate(outside).mean())
    if models is None:
        return {
            **{place: psnr[place] for place in ("inside", "vehicle", "uncovered")},
            "outside": away,
            "perceptual": _mean(distances),
        }
    overlaps = [float(a / b) if b else None for a, b in counts]
    pixels = int(sum(map(len, errors["inside"])))
    return {"pixels": pixels, **psnr, "outside": away, "overlap": overlaps[0], "overlap_before": overlaps[1]}


def drawer(model: SceneModel) -> Draw:
    """What draws the images of a scene."""
    return lambda view: render_view(model, view, raster_of(model)).rgb


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


def distance_in(made: NDArray[np.float32], true: NDArray[np.float32], mask: NDArray[np.bool_]) -> float:
    """Perceptual distance of two images f32[H, W, 3], weighted by the pixels of a mask."""
    features = shipped_features()
    pair = [torch.from_numpy(np.ascontiguousarray(image.transpose(2, 0, 1))) for image in (made, true)]
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
        "edit",
        "changed pixels [dB]",
        "unedited",
        "vehicle [dB]",
        "unedited",
        "uncovered [dB]",
        "outside changed",
        "overlap",
        "unedited",
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
            seen.append((draw(frame.view).permute(1, 2, 0).numpy(), truth.rgb, truth.instance == case.instance))
    return seen


def vehicle_scores(made: Sequence[Seen], recorded: Sequence[Seen]) -> dict[str, float | None]:
    """PSNR, perceptual distance and light in the pixels of a vehicle, and of the recorded one."""
    found: dict[str, float | None] = {}
    for end, seen in (("", made), ("_recorded", recorded)):
        found["psnr" + end] = psnr_in([(image - true)[mask] for image, true, mask in seen])
        found["perceptual" + end] = _mean(distance_in(image, true, mask) for image, true, mask in seen)
    light = (
        [np.concatenate([linear_of(one[which][one[2]]) for one in made]).mean() for which in (0, 1)] if made else None
    )
    return {**found, "light": None if light is None else float(light[1] / light[0])}


# ---- with a diffusion model ----


def _repaired_rows(config: BenchConfig, case: EditCase, name: str, out: Path) -> list[dict[str, Any]]:
    """Rows of one edit, one per way to make its frames."""
    script = parse_edits(_script(case, REPAIRED_EDITS[name], out), "bench")
    drive = carry_out(script, case.model, case.scene, bench_poses.cloud_of(case.scene))
    edited, truth = drive.model(case.model), _true_city(case, drive, "new" if name == "insert" else case.name)
    settings = EditConfig(
        harmonize=HarmonizeConfig(on=True, model=config.model, seed=config.seed), device=config.device
    )
    images = repairing(EditedImages(case.model, edited, settings, drive.plan.moves_ego), drive, case.scene)
    frames: dict[float, Observation] = {}
    for frame in case.scene.frames:
        frames[frame.view.time_s] = next((images.repaired or {})[frame.view.camera.name])
    images = replace(images, repaired={name: iter(frames.values()) for name in case.scene.cameras})
    refitted = _refitted(config, case, drive, images, out / "edited" / f"{case.city}_{name.replace(' ', '_')}")
    ways: list[Draw] = [drawer(edited), lambda view: frames[view.time_s].rgb, drawer(refitted)]
    if name == "remove":
        ways.append(drawer(_never_there(config, case, truth, out)))
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
        path = [
            [round(float(x), 4) for x in row] for row in np.column_stack([motion.times_s, motion.poses[:, :2, 3], yaws])
        ]
        text = text.replace("PATH", str(path)).replace("ASSET", str(asset))
    return text.replace("[ID]", f"[{case.name}]").replace("id: ID", f"id: {case.name}")


def _refitted(config: BenchConfig, case: EditCase, drive: EditedDrive, images: EditedImages, out: Path) -> SceneModel:
    """The edited fit after as many steps again on the repaired images; as `mudg fit --start-from` on an edited run does
    it."""
    # both were given
    if not (out / "scene" / "scene.json").is_file() and drive.scene is not None and drive.cloud is not None:
        write_edited_scene(case.scene, DriveChange(drive.plan, drive.scene, drive.cloud), images, out / "scene")
    save_model(images.after, out / "start")
    scene, start, settings = (
        read_scene(out / "scene"),
        StartFit(out / "start", ""),
        bench_poses.fit_settings(config, "fixed"),
    )
    views, classes = fit.recorded_views(settings, scene, None, start)
    state = fit.continued_state(whole_run(settings), start, views, classes)
    return bench_poses.optimised(state, whole_run(settings), out / "fit").model


def _never_there(config: BenchConfig, case: EditCase, world: CityWorld, out: Path) -> SceneModel:
    """A fit, with the same settings, of the city in which the object was never there."""
    folder = out / "cities" / f"{case.city}_without"
    if not (folder / "scene.json").is_file():
        write_world(world, folder)
    scene, settings = read_scene(folder), bench_poses.fit_settings(config, "fixed")
    return bench_poses.fitted(scene, bench_poses.cloud_of(scene), settings, out / "fits" / f"{case.city}_without").model
