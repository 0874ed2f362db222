"""``mudg bench edit RUN ...``: edits of recorded drives, of which no truth exists, by measures that need none.

On every finished ``mudg run``, seen by its front camera on the recorded path, the moving vehicle ahead that shows the most pixels is taken
away and moved, a vehicle of the next run is put in, and fog and dusk come. Every render is compared with that of the unedited fit:

    warp       mean absolute colour difference, [0, 1], of a surface between neighbouring frames, carried by the depth and the poses of
               the rendered scene (the edited vehicle by its path); lower is steadier. Beside it that of the unedited video
    outside    share of the pixels away from the edit that change by more than 1/255, [0, 1]; lower is better (not for weather and light)
    structure  correlation of luminance gradients with the unedited render, [-1, 1]; higher is better (weather and light alone)
    lidar      AbsRel, 0 and up, of rendered depth at the LiDAR points of the moment away from the edit, with the edit and without
    uncovered  AbsRel in the pixels that showed the vehicle and do not any more, at static points of the sweeps around; lower is better.
               PSNR, dB, of the render's colours there against those that recorded frames show at these points when neither the vehicle
               nor its shadow is there; higher is better
    overlap    intersection over union of the vehicle's pixels with the outline of its box, [0, 1], at the new place and at the old one
    collisions, warnings   numbers of what ``mudg edit`` reports

OUT/bench.json  OUT/bench.md  OUT/page.html  OUT/rows/  OUT/pictures/  OUT/assets/ the vehicles that were put in
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch

from mudg.base import log, store
from mudg.base.config import result_settings
from mudg.base.errors import InputError, UsageError
from mudg.base.run_folder import RunDir, VerbOutput, refuse_overlap
from mudg.base.types import Frame, Observation, Scene, Track, View
from mudg.benchmarks import page as pages
from mudg.benchmarks.edit import drawn_pixels
from mudg.benchmarks.edit_runs_measure import RunCase, Shown, measured
from mudg.benchmarks.loop import finished
from mudg.core import box_scores, pictures
from mudg.core.raster.place import drawing_device
from mudg.data.cloudfile import read_fused
from mudg.data.edits import EditScript, parse_edits
from mudg.data.exporters.video import jpeg_bytes
from mudg.data.scene import read_scene
from mudg.models.scene.model import SceneModel
from mudg.pages.tables import TextTable, cells, markdown_table
from mudg.stages.config import BenchConfig
from mudg.stages.editing.apply import ground_of
from mudg.stages.editing.assets import asset_from, read_asset, write_asset
from mudg.stages.editing.carried import background_of
from mudg.stages.editing.checks import collisions
from mudg.stages.editing.plan import EditSources, EditWorld, plan_edits
from mudg.stages.editing.runs import RunParts, find_run
from mudg.stages.fitting.storage import model_of_scene
from mudg.stages.scoring.log_points import LogPoints

EDITS: Final = {
    "remove": "- remove: {ids: ['ID'], close_street: false}",
    "remove, street closed": "- remove: {ids: ['ID'], close_street: true}",
    "move 3 m ahead": "- move: {id: 'ID', along_m: 3, close_street: false}",
    "move 1 m left": "- move: {id: 'ID', left_m: 1, close_street: false}",
    "move 2.5 m left": "- move: {id: 'ID', left_m: 2.5, close_street: false}",
    "move 2.5 m left, street closed": "- move: {id: 'ID', left_m: 2.5, close_street: true}",
    "insert": "- insert: {asset: {file: ASSET}, id: inserted, near: {id: ego, ahead_m: AHEAD, left_m: LEFT}}",
    "fog": "- weather: {fog: {visibility_m: 60}}",
    "dusk": "- light: {time: dusk}",
}
"""Name of a row -> script."""
INSERT_AT_M: Final = tuple((ahead, left) for left in (0.0, 3.5, -3.5) for ahead in (12.0, 9.0, 16.0, 20.0))
"""Places, metres ahead of and to the left of the vehicle, that are tried for an inserted one: the first without a collision is taken."""
AHEAD_M: Final = 2.0
CANDIDATES: Final = 6
LOOKS: Final = 6
"""Frames in which the pixels of vehicles are counted, and how many vehicles, those with the largest boxes."""
PICTURES: Final = (1 / 3, 2 / 3)
"""Where in the video the frames of the page lie."""
HEADS: Final = (
    "run", "edit", "warp error (lower)", "unedited", "outside changed (lower)", "structure (higher)", "LiDAR AbsRel (lower)", "unedited",
    "uncovered AbsRel (lower)", "uncovered PSNR dB (higher)", "overlap (higher)", "unedited", "collisions", "warnings",
)  # fmt: skip
FORMS: Final = {
    "warp": "{:.4f}", "warp_before": "{:.4f}", "outside": "{:.2%}", "structure": "{:.3f}", "lidar": "{:.4f}", "lidar_before": "{:.4f}",
    "uncovered": "{:.3f}", "uncovered_psnr": "{:.2f}",
    "overlap": "{:.2f}", "overlap_before": "{:.2f}", "collisions": "{}", "warnings": "{}",
}  # fmt: skip
KINDS: Final = ("unedited", "edited", "difference")
"""Pictures of a frame."""
OUTPUT: Final = VerbOutput("bench edit of runs", 1, ("bench.json", "bench.md", "page.html", "rows/*.json", "pictures/*.jpg", "assets/*"))


def run(config: BenchConfig, sources: Sequence[Path], out: Path, *, overwrite: bool = False) -> Path:
    """Edit recorded drives; returns ``out`` with ``bench.json``, ``bench.md`` and ``page.html``. What an interrupted one finished is kept.

    Args:
        sources: folders of finished ``mudg run``.

    Raises:
        UsageError: ``--harmonize``, which compares with a truth. InputError: a folder is no finished run, its scene has no labels, no
            LiDAR or no moving vehicle.
    """
    if config.harmonize:
        raise UsageError("what a diffusion model adds is compared with generated cities alone", where="--harmonize",
            remedy="leave it out, or name no runs")  # fmt: skip
    runs = {name: _whole(path) for name, path in names_of(sources).items()}
    refuse_overlap(out, {f"run {name}": path for name, path in names_of(sources).items()})
    device = drawing_device(config.device, "benchmark")
    inputs = {f"{name} {part}": store.digest(path) for name, parts in runs.items() for part, path in _inputs(parts).items()}
    folder = RunDir.open(out, OUTPUT, result_settings(config), inputs, overwrite)
    if folder.complete:
        return folder.reused()
    torch.set_num_threads(config.threads)
    try:
        document = _document(runs, device, folder.path)
    except KeyboardInterrupt:
        folder.pause()
        raise
    store.write_json(folder.path / "bench.json", document)
    store.write_text(folder.path / "bench.md", markdown(document))
    store.write_text(folder.path / "page.html", page(document, folder.path))
    folder.finish({"measurement": "edit", "runs": len(runs)})
    return folder.path


def names_of(sources: Sequence[Path]) -> dict[str, Path]:
    """Name -> folder: the last part of its path, with a number where that is taken."""
    found: dict[str, Path] = {}
    for path in map(Path, sources):
        plain = re.sub(r"[^A-Za-z0-9_.+-]+", "_", path.name or path.resolve().name) or "run"
        found[next(name for n in range(1, len(found) + 2) if (name := plain if n == 1 else f"{plain}-{n}") not in found)] = path
    return found


def _whole(path: Path) -> RunParts:
    parts = find_run(path)
    if not parts.whole:
        raise InputError("of a fit alone the recorded drive is not known", where=str(path), expected="a folder made by `mudg run`")
    return parts


def _inputs(parts: RunParts) -> dict[str, Path]:
    return {key: path for key, path in (("fit", parts.model), ("scene", parts.scene), ("fused", parts.fused)) if path is not None}


def _document(runs: Mapping[str, RunParts], device: torch.device, out: Path) -> dict[str, Any]:
    """All runs, one after the other; each is read once, if anything of it is left to measure."""
    names, rows, cases = list(runs), [], {}

    def case(name: str, lead: str = "") -> RunCase:
        if name not in cases:
            cases.clear()  # one at a time in memory
            cases[name] = case_of(name, runs[name], device, lead)
        return cases[name]

    def lead_found(name: str) -> dict[str, str]:
        lead = case(name).lead
        write_asset(out / "assets" / f"{name}.safetensors", asset_from(runs[name], lead))
        return {"lead": lead}

    leads = {name: str(finished(out / "rows" / f"{name}_lead.json", partial(lead_found, name))["lead"]) for name in names}
    with log.task("editing runs", len(names) * len(EDITS)) as bar:
        for number, name in enumerate(names):
            giver = names[(number + 1) % len(names)]
            for edit in EDITS:
                bar.update(f"{name}: {edit}")

                def row(name: str = name, edit: str = edit, giver: str = giver) -> dict[str, Any]:
                    drive = case(name, leads[name])
                    script = script_of(drive, edit, out / "assets" / f"{giver}.safetensors")
                    values = measured(drive, script, _pictures(len(drive.frames), out, _stem(name, edit)))
                    given_by = giver if edit == "insert" else None
                    return {"run": name, "edit": edit, "object": drive.lead, "given_by": given_by, **values, "script": script.text()}

                rows.append(finished(out / "rows" / f"{_stem(name, edit)}.json", row))
                bar.advance()
    return {"schema": 1, "runs": names, "leads": leads, "rows": rows}


def _stem(name: str, edit: str) -> str:
    return f"{name}_{edit.replace(' ', '_')}"


def case_of(name: str, parts: RunParts, device: torch.device, lead: str = "") -> RunCase:
    """A run, read; ``lead``: the vehicle that is edited, if it is known.

    Raises:
        InputError: no classes, no LiDAR, or no vehicle that moves.
    """
    if parts.scene is None or parts.fused is None:  # a whole run has both
        raise InputError("a run without its scene", where=name)
    scene, fused = read_scene(parts.scene), read_fused(parts.fused)
    if not scene.sweeps:
        raise InputError("this scene has no LiDAR, which tells the depth that edits are held against", where=str(parts.scene))
    model = model_of_scene(parts.model, scene).to(device)
    if not model.classes:
        raise InputError("this scene was fitted without labels, which edits of weather and the warp error need", where=str(parts.model),
            remedy="label the scene with `mudg annotate` and fit it again")  # fmt: skip
    camera = "front" if "front" in scene.cameras else next(iter(scene.cameras))
    frames = tuple(sorted((f for f in scene.frames if f.view.camera.name == camera), key=lambda f: f.view.time_s))
    points = LogPoints(scene)
    return RunCase(name, scene, fused, model, frames, lead or lead_of(scene, model, frames, points), points)


def lead_of(scene: Scene, model: SceneModel, frames: Sequence[Frame], points: LogPoints) -> str:
    """The moving vehicle with Gaussians of its own that shows the most pixels, of those that are ahead where there are any.

    Raises:
        InputError: there is none.
    """
    nodes = model.node_names()
    tracks = [t for t in points.dynamic if t.id in nodes and t.label in box_scores.VEHICLE_LABELS]
    chosen = [frames[int(i)].view for i in np.unique(np.linspace(0, len(frames) - 1, min(LOOKS, len(frames))).round())]
    areas = {track.id: 0.0 for track in tracks}
    for track in tracks:
        for view in chosen:
            pose = track.pose_at(view.time_s)
            box = None if pose is None else box_scores.clipped_box(view, pose, track.size_m)
            if box is not None:
                edge = np.array([view.camera.width, view.camera.height], np.float64)
                areas[track.id] += float((np.clip(box[2:], 0, edge) - np.clip(box[:2], 0, edge)).prod())
    ahead = {track.id for track in tracks if any(_is_ahead(track, view) for view in chosen)}
    seen = sorted((name for name, area in areas.items() if area > 0), key=lambda name: (name not in ahead, -areas[name]))
    nearest = [name for name in seen if name in ahead or not ahead & {*seen}][:CANDIDATES]
    shown = {name: sum(int(drawn_pixels(model, name, view).sum()) for view in chosen) for name in nearest}
    if not any(shown.values()):
        raise InputError("no vehicle moves in the view of this drive's front camera", where=scene.id,
            expected="a moving track of a vehicle with Gaussians of its own",
            got=f"{len(points.dynamic)} moving tracks of {len(scene.tracks)}", remedy="edit another drive")  # fmt: skip
    return max(shown, key=lambda name: shown[name])


def _is_ahead(track: Track, view: View) -> bool:
    """Whether a track's box stands in front of the camera, less than ``AHEAD_M`` beside its axis."""
    pose = track.pose_at(view.time_s)
    x, _, z = (0.0, 0.0, -1.0) if pose is None else (view.cam_from_world @ pose)[:3, 3]
    return bool(z > 0 and abs(x) < AHEAD_M)


def script_of(case: RunCase, edit: str, asset: Path) -> EditScript:
    """The script of one edit; an inserted vehicle stands at the first free place of ``INSERT_AT_M``, or at the first of all."""
    text = EDITS[edit].replace("ID", case.lead).replace("ASSET", store.json_text(str(asset.resolve()), indent=None))
    made = [parse_edits(text.replace("AHEAD", str(a)).replace("LEFT", str(b)), edit, Path()) for a, b in INSERT_AT_M]
    if edit != "insert":
        return made[0]
    world, given = EditWorld.of_scene(case.scene, ground_of(case.cloud, case.model)), read_asset(asset)
    sources = EditSources(lambda _: given, lambda path: background_of(find_run(Path(path)), path))
    return next((script for script in made if not collisions(plan_edits(script, world, sources))), made[0])


def _pictures(frames: int, out: Path, name: str) -> Shown:
    """What writes the pictures of some frames."""
    chosen = {min(frames - 1, int(share * frames)): n for n, share in enumerate(PICTURES)}

    def shown(number: int, old: Observation, new: Observation) -> None:
        if number in chosen:
            images = (pictures.to_bytes(old.rgb), pictures.to_bytes(new.rgb), pictures.error_image(new.rgb, old.rgb))
            for kind, image in zip(KINDS, images, strict=True):
                store.atomic_write(out / "pictures" / f"{name}_{chosen[number]}_{kind}.jpg", jpeg_bytes(image, quality=85))

    return shown


# ---- text ----


def _cells(row: Mapping[str, Any]) -> list[str]:
    """A row of the table as text; `-`: there is no such number."""
    return [row["run"], row["edit"], *cells(row, FORMS)]


def markdown(doc: Mapping[str, Any]) -> str:
    """The table as text."""
    title = f"# Edits of {len(doc['runs'])} recorded drives against their unedited fits"
    return "\n".join([title, "", *markdown_table(HEADS, map(_cells, doc["rows"]))]) + "\n"


def page(doc: Mapping[str, Any], out: Path) -> str:
    """The whole page, from what ``bench.json`` holds and the pictures in ``out``, which it holds: it is for their owner."""
    walls = []
    for row in doc["rows"]:
        stem = out / "pictures" / _stem(row["run"], row["edit"])
        for number in range(len(list(stem.parent.glob(f"{stem.name}_[0-9]_edited.jpg")))):
            images = {kind: stem.with_name(f"{stem.name}_{number}_{kind}.jpg") for kind in KINDS}
            walls.append(pages.wall(f"{row['run']}: {row['edit']}", images, row["notes"] if number == 0 else ()))
    return pages.render(
        "Edited drives", "mudg bench edit",
        "Recorded drives, edited, against their unedited fits. The pictures show your recordings: share this page with care.",
        [
            {"title": "Numbers", "tables": [TextTable.of_texts(HEADS, map(_cells, doc["rows"]))]},
            {"title": "Pictures", "walls": walls,
             "notes": ["Difference: mean of the channels, black = equal, through red to white = 0.35 or more."]},
        ],
    )  # fmt: skip
