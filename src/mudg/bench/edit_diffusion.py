"""What a diffusion model adds to edits of fitted scenes, against the generated city drawn again with them (see `bench/edit.py`).

Three edits per city, three ways to make their frames: the fitted scene with the edits; its frames with the touched pixels repaired by the
diffusion model (``stages/editing/harmonised.py``); renders of a fit that goes on for as many steps again on an edited drive whose images
are such frames. Besides a fit of the same city in which the object was never there: what a scene of this size can show at all.

Numbers are those of `bench/edit.py`, and the perceptual distance in the pixels that the edit changes (features of the shipped codec).
`insert` takes the object away and puts its own asset in 3 m ahead, so that the truth is that of the move.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch
from numpy.typing import NDArray
from scipy import ndimage

from mudg.base import log, store
from mudg.base.types import Observation, View
from mudg.bench import edit as bench_edit
from mudg.bench import edit_insert
from mudg.bench import poses as bench_poses
from mudg.bench.edit import CHANGED, NEARBY_PX, EditCase, city_keys, distance_in, psnr_in
from mudg.core.edit_scores import SAME
from mudg.core.fusion import fuse_sweeps
from mudg.data.city import CityWorld
from mudg.data.city.recording import write_world
from mudg.data.edits import EditScript, parse_edits
from mudg.data.scene import read_scene
from mudg.models.featnets import CodecFeatures
from mudg.models.mdm import files as mdm_files
from mudg.models.scene.model import SceneModel
from mudg.stages import fit
from mudg.stages.config import BenchConfig, EditConfig, FuseConfig, HarmonizeConfig
from mudg.stages.editing.assets import complete_asset, write_asset
from mudg.stages.editing.carried import EditedDrive, carry_out
from mudg.stages.editing.harmonised import repairing
from mudg.stages.editing.written import DriveChange, EditedImages, write_edited_scene
from mudg.stages.fitting.continued import StartFit, whole_run
from mudg.stages.fitting.rendering import raster_of, render_view
from mudg.stages.fitting.storage import save_model
from mudg.stages.fuse import rules_of, scene_sweeps

MOVE: Final = "- move: {id: ID, along_m: 3, ground: false}"
EDITS: Final = {
    "remove": "- remove: {ids: [ID]}",
    "move 3 m ahead": MOVE,
    "insert": "- remove: {ids: [ID]}\n- insert: {id: new, asset: {file: ASSET}, path: PATH, ground: false}",
}
"""Name of a row -> script."""
WAYS: Final = ("fit", "+ diffusion", "+ refit")
UNSEEN: Final = "never there"
_PLACES: Final = ("inside", "vehicle", "uncovered")
Draw = Callable[[View], torch.Tensor]


def _rows_of_city(config: BenchConfig, city: int, out: Path) -> list[dict[str, Any]]:
    """Rows of one city: every edit, every way; those that an interrupted run finished are kept."""
    places = {name: out / "rows" / f"{city}_{name.replace(' ', '_')}_diffusion.json" for name in EDITS}
    if not all(place.is_file() for place in places.values()):
        case = bench_edit.case_of(config, city, out)
        for name, place in places.items():
            if not place.is_file():
                store.write_json(place, _rows_of(config, case, name, out))
    return [row for place in places.values() for row in store.read_json(place)]


def _rows_of(config: BenchConfig, case: EditCase, name: str, out: Path) -> list[dict[str, Any]]:
    """Rows of one edit."""
    script = _script(case, EDITS[name], out)
    cloud = fuse_sweeps(scene_sweeps(case.scene, FuseConfig()), case.scene.tracks, rules_of(FuseConfig()))[0]
    drive = carry_out(script, case.model, case.scene, cloud)
    edited = drive.model(case.model)
    actor = drive.plan.after.actors.get("new" if name == "insert" else case.name)
    keys = None if actor is None else city_keys(actor.motion.at(case.world.key_times_s), actor.size_m[2])
    truth = case.world.rearranged({case.name: keys})
    settings = EditConfig(harmonize=HarmonizeConfig(on=True, model=config.model, seed=config.seed), device=config.device)
    images = repairing(EditedImages(case.model, edited, settings, drive.plan.moves_ego), drive, case.scene)
    kept: dict[float, Observation] = {}
    for frame in case.scene.frames:
        kept[frame.view.time_s] = next((images.repaired or {})[frame.view.camera.name])
    images = replace(images, repaired={name: iter(kept.values()) for name in case.scene.cameras})
    place = out / "edited" / f"{case.city}_{name.replace(' ', '_')}"
    refitted = _refitted(config, case, (drive, images), place)
    drawn = lambda model: lambda view: render_view(model, view, raster_of(model)).rgb  # noqa: E731
    ways: dict[str, Draw] = {"fit": drawn(edited), "+ diffusion": lambda view: kept[view.time_s].rgb, "+ refit": drawn(refitted)}
    if name == "remove":
        ways[UNSEEN] = drawn(_without(config, case, truth, out))
    usual = drawn(case.model)
    return [{"city": case.city, "object": case.name, "edit": name, "way": way, **scores(case, truth, (draw, usual))}
            for way, draw in ways.items()]  # fmt: skip


def _script(case: EditCase, text: str, out: Path) -> EditScript:
    """The script of an edit; an asset that it names is written first."""
    asset = out / "edited" / f"{case.city}.safetensors"
    if "ASSET" in text:
        write_asset(asset, complete_asset(case.model, case.name, [frame.view for frame in case.scene.frames]))
        moved = carry_out(parse_edits(MOVE.replace("ID", case.name), "move"), case.model, case.scene)
        motion = moved.plan.after.actors[case.name].motion
        yaws = np.degrees(np.unwrap(np.arctan2(motion.poses[:, 1, 0], motion.poses[:, 0, 0])))
        path = [[round(float(x), 4) for x in row] for row in np.column_stack([motion.times_s, motion.poses[:, :2, 3], yaws])]
        text = text.replace("PATH", str(path)).replace("ASSET", str(asset))
    return parse_edits(text.replace("[ID]", f"[{case.name}]").replace("id: ID", f"id: {case.name}"), "bench")


def _refitted(config: BenchConfig, case: EditCase, edited: tuple[EditedDrive, EditedImages], out: Path) -> SceneModel:
    """The edited fit after as many steps again on the repaired images; as `mudg fit --start-from` on an edited run does it."""
    drive, images = edited
    if not (out / "scene" / "scene.json").is_file() and drive.scene is not None and drive.cloud is not None:  # both were given
        write_edited_scene(case.scene, DriveChange(drive.plan, drive.scene, drive.cloud), images, out / "scene")
    save_model(images.after, out / "start")
    scene, start = read_scene(out / "scene"), StartFit(out / "start", "")
    settings = replace(bench_poses.fit_settings(config, "fixed"), iterations=config.pose_iterations)
    views, classes = fit.recorded_views(settings, scene, None, start)
    state = fit.continued_state(whole_run(settings), start, views, classes)
    return bench_poses.optimised(state, whole_run(settings), out / "fit").model


def _without(config: BenchConfig, case: EditCase, world: CityWorld, out: Path) -> SceneModel:
    """A fit, with the same settings, of the city in which the object was never there."""
    folder = out / "cities" / f"{case.city}_without"
    if not (folder / "scene.json").is_file():
        write_world(world, folder)
    scene = read_scene(folder)
    cloud = fuse_sweeps(scene_sweeps(scene, FuseConfig()), scene.tracks, rules_of(FuseConfig()))[0]
    return bench_poses.fitted(scene, cloud, bench_poses.fit_settings(config, "fixed"), out / "fits" / f"{case.city}_without").model


def scores(case: EditCase, truth: CityWorld, draws: tuple[Draw, Draw]) -> dict[str, Any]:
    """Scores of one way to make the edited frames; ``draws``: it, and the fit without the edit."""
    codec = CodecFeatures(mdm_files.load("embedded").codec)
    errors: dict[str, list[NDArray[np.float32]]] = {place: [] for place in _PLACES}
    outside, distances = [], []
    instance = case.world.instance_of(case.name)
    for frame in case.scene.frames[:: bench_edit.EVERY_FRAMES]:
        now, then = truth.render(frame.view), case.world.render(frame.view)
        made, usual = (draw(frame.view).permute(1, 2, 0).numpy() for draw in draws)
        mask, mine = np.abs(now.rgb - then.rgb).max(-1) > CHANGED, now.instance == instance
        for place, where in zip(_PLACES, (mask, mine, mask & ~mine), strict=True):
            errors[place].append((made - now.rgb)[where])
        far = np.logical_not(ndimage.binary_dilation(mask, iterations=NEARBY_PX))
        outside.append((np.abs(made - usual).max(-1) > SAME)[far])
        if mask.any():
            distances.append(distance_in(codec, made, now.rgb, mask))
    return {
        **{place: psnr_in(found) for place, found in errors.items()},
        "outside": float(np.concatenate(outside).mean()), "perceptual": float(np.mean(distances)) if distances else None,
    }  # fmt: skip


def summary(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Means per edit and way over the cities in which the edit changes something."""
    made = []
    for edit in EDITS:
        for way in (*WAYS, UNSEEN):
            mine = [row for row in rows if (row["edit"], row["way"]) == (edit, way) and row["inside"] is not None]
            known = {key: [row[key] for row in mine if row[key] is not None] for key in (*_PLACES, "perceptual", "outside")}
            if mine:
                means = {key: float(np.mean(values)) if values else None for key, values in known.items()}
                made.append({"edit": edit, "way": way, "cities": len(mine), **means})
    return made


def table(rows: list[dict[str, Any]]) -> str:
    """The summary as text."""
    lines = [
        "", "## With a diffusion model", "",
        "| edit | frames | changed pixels [dB] | vehicle [dB] | uncovered [dB] | perceptual | outside changed |",
        "|---|---|---|---|---|---|---|",
    ]  # fmt: skip
    for row in summary(rows):
        shown = ["-" if row[key] is None else f"{row[key]:.2f}" for key in _PLACES]
        distance = "-" if row["perceptual"] is None else f"{row['perceptual']:.4f}"
        lines.append(f"| {row['edit']} | {row['way']} | {' | '.join(shown)} | {distance} | {row['outside']:.2%} |")
    return "\n".join(lines) + "\n"


def measure(config: BenchConfig, out: Path) -> tuple[dict[str, Any], str]:
    """`mudg bench edit`: the edits of fitted scenes, vehicles of other cities, and, if asked for, what a diffusion model adds."""
    result, text = bench_edit.measure(config, out)
    if len(result["cities"]) > 1:
        rows = edit_insert.measure(config, result["cities"], out)
        result, text = {**result, "insert": {"rows": rows, "summary": edit_insert.summary(rows)}}, text + edit_insert.table(rows)
    if not config.harmonize:
        return result, text
    rows = []
    with log.task("editing with diffusion", len(result["cities"])) as bar:
        for city in result["cities"]:
            rows += _rows_of_city(config, city, out)
            bar.advance()
    return {**result, "diffusion": {"rows": rows, "summary": summary(rows)}}, text + table(rows)
