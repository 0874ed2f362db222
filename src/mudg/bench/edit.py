"""Edits of a fitted scene against exact truth: the generated city, drawn again with the object elsewhere or gone.

Of every city the vehicle that shows the most pixels is edited in a scene that was fitted to the city as it was. Truth is the same city
with that vehicle on the edited path (``CityWorld.rearranged``), shadows included. Over frames of the recorded path:

    inside     PSNR in the pixels that the edit changes in the truth (by more than 4/255), against the edited truth; and of the unedited
               render in the same pixels, against the unedited truth: what the fit can do there at all
    vehicle    PSNR in all pixels of the vehicle, with the edit and without
    uncovered  PSNR in those of the changed pixels that show no vehicle any more: what stood behind it, and its shadow
    outside    share of the other pixels that the edit changes in the render by more than 1/255
    overlap    intersection over union of the vehicle's pixels in the truth and in the render, where its Gaussians make more than half;
               and the same without the edit
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch
from numpy.typing import NDArray
from scipy import ndimage

from mudg.base import geometry, log, store
from mudg.base.errors import InputError
from mudg.base.types import Scene, View
from mudg.bench import poses as bench_poses
from mudg.core import metrics
from mudg.core.edit import Motion
from mudg.core.edit_scores import SAME
from mudg.core.fusion import fuse_sweeps
from mudg.core.perceptual import lpips_distance, unit_features
from mudg.core.raster.rasterize import rasterize
from mudg.data.city import CityWorld
from mudg.data.edits import parse_edits
from mudg.data.scene import read_label
from mudg.models.featnets import CodecFeatures
from mudg.models.scene.model import SceneModel, compose
from mudg.stages import fit
from mudg.stages.config import BenchConfig, FuseConfig
from mudg.stages.editing.carried import carry_out
from mudg.stages.fitting.rendering import raster_of, render_view
from mudg.stages.fuse import rules_of, scene_sweeps

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
_PSNR: Final = ("inside", "inside_before", "vehicle", "vehicle_before", "uncovered")
CHANGED = 4 / 255
NEARBY_PX: Final = 3
EVERY_FRAMES: Final = 3


@dataclass(frozen=True, slots=True, eq=False)
class EditCase:
    """One fitted city and the vehicle that is edited in it."""

    city: int
    world: CityWorld
    scene: Scene
    model: SceneModel
    name: str


def measure(config: BenchConfig, out: Path) -> tuple[dict[str, Any], str]:
    """Every edit on every city; numbers and a table. Cities that an interrupted run finished are kept."""
    cities = bench_poses.LISTS[config.cities][: config.count]
    rows: list[dict[str, Any]] = []
    with log.task("editing", len(cities)) as bar:
        for city in cities:
            place = out / "rows" / f"{city}_edits.json"
            if not place.is_file():
                case = case_of(config, city, out)
                store.write_json(place, [row_of(case, name, text) for name, text in EDITS.items()])
            rows += store.read_json(place)
            bar.advance()
    result = {"cities": list(cities), "iterations": config.pose_iterations, "rows": rows, "summary": summary(rows)}
    return result, table(result)


def case_of(config: BenchConfig, city: int, out: Path) -> EditCase:
    """A city, the scene fitted to it, and the vehicle that is edited."""
    scene = bench_poses.city_scene(city, out / "cities" / str(city))
    cloud = fuse_sweeps(scene_sweeps(scene, FuseConfig()), scene.tracks, rules_of(FuseConfig()))[0]
    settings = bench_poses.fit_settings(config, "fixed")
    state = bench_poses.fitted(scene, cloud, settings, out / "fits" / f"{city}_edit")
    fit.add_certainty(state, settings)
    return EditCase(city, CityWorld.from_source(scene.source), scene, state.model, most_visible(scene, state.model))


def most_visible(scene: Scene, model: SceneModel) -> str:
    """The vehicle with a node of its own that shows the most pixels.

    Raises:
        InputError: the city has none.
    """
    pixels = np.sum([np.bincount(read_label(scene, frame, "instance").ravel(), minlength=4096) for frame in scene.frames], 0)
    names = [name for name in model.node_names() if name.startswith(("car", "truck", "bus"))]
    if not names:
        raise InputError("no vehicle moves in this city", where=scene.id)
    return max(names, key=lambda name: pixels[int(name.rsplit("-", 1)[1])])


def row_of(case: EditCase, name: str, text: str) -> dict[str, Any]:
    """Scores of one edit."""
    script = parse_edits(text.replace("ID", case.name), name)
    drive = carry_out(script, case.model, case.scene)
    actor = drive.plan.after.actors.get(case.name)
    times = case.world.key_times_s
    keys = None if actor is None else city_keys(actor.motion.at(times), actor.size_m[2])
    truth, edited = case.world.rearranged({case.name: keys}), drive.model(case.model)
    instance = case.world.instance_of(case.name)
    errors: dict[str, list[NDArray[np.float32]]] = {name: [] for name in _PSNR}
    outside = []
    counts = np.zeros((2, 2), np.int64)  # with and without the edit: pixels in both, pixels in either
    for frame in case.scene.frames[::EVERY_FRAMES]:
        now, then = truth.render(frame.view), case.world.render(frame.view)
        made, usual = (rendered(model, frame.view) for model in (edited, case.model))
        mask = np.abs(now.rgb - then.rgb).max(-1) > CHANGED
        new, old = made - now.rgb, usual - then.rgb
        mine = now.instance == instance
        parts = (new[mask], old[mask], new[mine], old[then.instance == instance], new[mask & ~mine])
        for place, part in zip(_PSNR, parts, strict=True):
            errors[place].append(part)
        far = np.logical_not(ndimage.binary_dilation(mask, iterations=NEARBY_PX))
        outside.append((np.abs(made - usual).max(-1) > SAME)[far])
        for row, seen, model in ((0, now, edited), (1, then, case.model)):
            there, drawn = seen.instance == instance, drawn_pixels(model, case.name, frame.view)
            counts[row] += (there & drawn).sum(), (there | drawn).sum()
    overlaps = [float(a / b) if b else None for a, b in counts]
    return {
        "city": case.city, "object": case.name, "edit": name, "pixels": int(sum(len(e) for e in errors["inside"])),
        **{place: psnr_in(found) for place, found in errors.items()}, "outside": float(np.concatenate(outside).mean()),
        "overlap": None if actor is None else overlaps[0], "overlap_before": overlaps[1],
    }  # fmt: skip


def city_keys(motion: Motion, height_m: float) -> NDArray[np.float64]:
    """A path as the city holds it: x, y, z on the ground, yaw f64[K, 4]."""
    yaws = np.unwrap([geometry.yaw_of(pose) for pose in motion.poses])
    return np.column_stack([motion.poses[:, :2, 3], motion.poses[:, 2, 3] - height_m / 2, yaws])


def rendered(model: SceneModel, view: View) -> NDArray[np.float32]:
    """The image f32[H, W, 3] of a scene."""
    return render_view(model, view, raster_of(model)).rgb.permute(1, 2, 0).numpy()


def drawn_pixels(model: SceneModel, name: str, view: View) -> NDArray[np.bool_]:
    """Pixels bool[H, W] of which an object's Gaussians make more than half."""
    if name not in model.node_names():
        return np.zeros((view.camera.height, view.camera.width), bool)
    gaussians = compose(model, view.time_s, semantics=False)
    mine = (gaussians.node == model.nodes.index(model.dynamic_object(name))).float()[:, None]
    with torch.no_grad():
        render = rasterize(replace(gaussians, extra=mine), view, raster_of(model))
    return np.zeros(0, bool) if render.extra is None else (render.extra[0] > 0.5).cpu().numpy()


def psnr_in(errors: list[NDArray[np.float32]]) -> float | None:
    """PSNR of some pixels' errors, each f32[n, 3]; None where there is no pixel."""
    every = torch.from_numpy(np.concatenate(errors)) if errors else torch.zeros(0)
    return metrics.psnr_of_errors(every) if len(every) else None


def distance_in(codec: CodecFeatures, made: NDArray[np.float32], true: NDArray[np.float32], mask: NDArray[np.bool_]) -> float:
    """Perceptual distance of two images f32[H, W, 3], weighted by the pixels of a mask."""
    pair = [torch.from_numpy(np.ascontiguousarray(image.transpose(2, 0, 1))) for image in (made, true)]
    with torch.no_grad():
        weight = torch.from_numpy(mask).float()[None]
        return float(lpips_distance(codec(pair[0]), unit_features(codec(pair[1])), weight, over_weight=True))


def summary(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Means per edit over the cities in which it changed something."""
    made = []
    for name in EDITS:
        mine = [row for row in rows if row["edit"] == name and row["inside"] is not None]
        if mine:
            mean: dict[str, float | None] = {"outside": float(np.mean([row["outside"] for row in mine]))}
            for key in (*_PSNR, "overlap", "overlap_before"):
                known = [row[key] for row in mine if row[key] is not None]
                mean[key] = float(np.mean(known)) if known else None
            made.append({"edit": name, "cities": len(mine), **mean})
    return made


def table(result: dict[str, Any]) -> str:
    """The summary as text."""
    lines = [
        f"# Edits of {len(result['cities'])} fitted cities ({result['iterations']} steps) against the cities drawn again", "",
        "| edit | changed pixels [dB] | unedited | vehicle [dB] | unedited | uncovered [dB] | outside changed | overlap | unedited |",
        "|---|---|---|---|---|---|---|---|---|",
    ]  # fmt: skip
    for row in result["summary"]:
        show = {key: "-" if row[key] is None else f"{row[key]:.2f}" for key in (*_PSNR, "overlap", "overlap_before")}
        values = [show[key] for key in _PSNR] + [f"{row['outside']:.2%}", show["overlap"], show["overlap_before"]]
        lines.append(f"| {row['edit']} | {' | '.join(values)} |")
    return "\n".join(lines) + "\n"
