"""``mudg bench edit RUN ...``: edits of recorded drives, of which no truth exists, by measures that need none.

On every finished ``mudg run``, seen by its front camera, the moving vehicle ahead that shows the most pixels is taken
away and moved, a vehicle of the next run is put in, and fog and dusk come. Every render is compared with that of the
unedited fit; docs/edit.md explains the measures.

    OUT/bench.json  bench.md  page.html  rows/  pictures/  assets/ the vehicles that were put in"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch
from numpy.typing import NDArray
from scipy import ndimage
from torch import Tensor

from mudg.base import geometry, log, store
from mudg.base.config import result_settings
from mudg.base.errors import InputError, UsageError
from mudg.base.html import TextTable, cells, markdown_table
from mudg.base.run_folder import RunDir, VerbOutput, refuse_overlap
from mudg.base.types import Frame, FusedCloud, Observation, Scene, Track, View
from mudg.benchmarks.chain import finished, render_page, wall
from mudg.benchmarks.cities import SAME, drawn_pixels
from mudg.benchmarks.settings import BenchConfig
from mudg.core import lidar, metrics, pictures, street_scores
from mudg.core import metrics as flicker
from mudg.core.edit import Motion
from mudg.core.fusion import STATIC
from mudg.core.lidar import DEPTH_LIMIT_M, OwnedPoints
from mudg.core.raster.rasterize import drawing_device
from mudg.core.weather.light import LUMA
from mudg.editing import apply
from mudg.editing.plan import EditPlan, EditSources, EditWorld, collisions, plan_edits
from mudg.editing.recorded import boxes_mask, ground_mask, outlines, touched_boxes
from mudg.editing.runs import RunParts, find_run
from mudg.editing.script import EditScript, conditions_of, parse_edits
from mudg.formats.exporters.video import jpeg_bytes
from mudg.gaussians.model import SceneModel
from mudg.gaussians.storage import model_of_scene
from mudg.scene.clouds import read_fused
from mudg.scene.read import read_image, read_scene
from mudg.scoring.truth import LogPoints

AROUND_SWEEPS: Final = 12
"""Sweeps of each LiDAR whose static points tell what stands behind a vehicle."""
COLOR_FRAMES: Final = 4
"""So many recorded frames, evenly spread, tell the colours of those points."""
UNKNOWN_M: Final = 1000.0
"""Depth of pixels without any, for the motion between frames."""
Shown = Callable[[int, Observation, Observation], None]
Mask = NDArray[np.bool_]


@dataclass(frozen=True, slots=True, eq=False)
class RunCase:
    """A recorded drive to edit. ``frames``: the recorded frames of its front camera, in order. ``lead``: id of the
    vehicle that is edited."""

    name: str
    scene: Scene
    cloud: FusedCloud
    model: SceneModel
    frames: tuple[Frame, ...]
    lead: str
    points: LogPoints


@dataclass(slots=True, eq=False)
class Video:
    """One of the two videos, frame by frame: the fit, what draws it, and sums over what was seen of it. ``actor``: id
    of the vehicle whose path is followed, or empty. ``motion``: its path. ``size_m``: of its box."""

    model: SceneModel
    draw: apply.Drawer
    actor: str = ""
    motion: Motion | None = None
    size_m: tuple[float, float, float] = (1.0, 1.0, 1.0)
    before: tuple[Observation, flicker.TrueFrame, NDArray[np.bool_]] | None = None
    change: float = 0.0
    carried: int = 0
    common: int = 0
    either: int = 0

    def add(self, view: View) -> tuple[Observation, NDArray[np.bool_]]:
        """The next frame, and the pixels bool[H, W] that show the vehicle."""
        seen, pose = self.draw(view), None if self.motion is None else self.motion.pose_at(view.time_s)
        mine = np.zeros(seen.rgb.shape[1:], bool) if pose is None else drawn_pixels(self.model, self.actor, view)
        if pose is not None:
            shown = outlines(view, [(pose, np.asarray(self.size_m, np.float64))])
            self.common, self.either = self.common + int((mine & shown).sum()), self.either + int((mine | shown).sum())
        now = (seen, _carrier(seen), mine)
        if self.before is not None:
            where = self._motion(self.before, now)
            self.change += flicker.change(self.before[0].rgb, seen.rgb, where)
            self.carried += int(where.same.sum())
        self.before = now
        return seen, mine

    def _motion(self, before: Any, now: Any) -> flicker.PixelMotion:
        """Where surfaces are in the next frame; vehicles other than the followed one do not count."""
        moved = {}
        if self.motion is not None:
            first, last = (self.motion.pose_at(frame[0].view.time_s) for frame in (before, now))
            if first is not None and last is not None:
                moved[1] = torch.from_numpy(last @ geometry.invert(first))
        return flicker.pixel_motion(before[1], now[1], moved, torch.from_numpy(before[2].astype(np.int64)))

    @property
    def warp(self) -> float | None:
        """Mean absolute change of a surface between neighbouring frames."""
        return self.change / self.carried if self.carried else None

    @property
    def overlap(self) -> float | None:
        """Intersection over union of the vehicle's pixels and the outline of its box, pooled."""
        return self.common / self.either if self.either else None


def _carrier(seen: Observation) -> flicker.TrueFrame:
    depth = torch.full((1, *seen.rgb.shape[1:]), UNKNOWN_M) if seen.depth is None else seen.depth
    ids = torch.zeros(seen.rgb.shape[1:], dtype=torch.int64) if seen.semantics is None else seen.semantics.long()
    return flicker.TrueFrame.of(seen.view, torch.where(torch.isfinite(depth) & (depth > 0), depth, UNKNOWN_M), ids)


@dataclass(slots=True)
class Sums:
    """What is pooled over frames: pixels away from the edit and those of them that changed; correlations; errors of
    colours of uncovered points; depth errors by name."""

    away: int = 0
    changed: int = 0
    structure: list[float] = field(default_factory=list)
    colors: list[NDArray[np.float32]] = field(default_factory=list)
    depth: dict[str, metrics.Pooled] = field(default_factory=dict)

    def add_depth(self, name: str, seen: Observation, truth: NDArray[np.float32], where: NDArray[np.bool_]) -> None:
        """Relative error of rendered depth at LiDAR points; where there is no depth, it counts as the farthest that is
        compared."""
        if seen.depth is None:
            return
        made = torch.nan_to_num(seen.depth, DEPTH_LIMIT_M, DEPTH_LIMIT_M, DEPTH_LIMIT_M)
        errors = metrics.depth_errors(made, torch.from_numpy(truth)[None], torch.from_numpy(where)[None])
        self.depth.setdefault(name, metrics.depth_error("abs_rel")).add(errors)

    @property
    def uncovered_psnr(self) -> float | None:
        """PSNR of the colours of uncovered points."""
        errors = np.concatenate([np.zeros(0, np.float32), *self.colors])
        return metrics.psnr_of_errors(torch.from_numpy(errors)) if len(errors) else None

    def depth_of(self, name: str) -> float | None:
        """The pooled error."""
        return self.depth[name].value() if name in self.depth else None


def changed_pixels(edited: Tensor, unedited: Tensor) -> NDArray[np.bool_]:
    """Where colours f32[3, H, W] in [0, 1] differ by more than a step of 8 bits in a channel, bool[H, W]."""
    return ((edited - unedited).abs().amax(0) > SAME).numpy()


def gradient_correlation(edited: Tensor, unedited: Tensor) -> float | None:
    """Correlation of Sobel derivatives of the brightness of two images f32[3, H, W]: [-1, 1], 1 = every edge in its
    place with the same relative strength, also under another exposure or contrast. None: an image has no edges."""
    brightness = [np.tensordot(LUMA, image.numpy(), 1) for image in (edited, unedited)]
    a, b = (np.stack([ndimage.sobel(one, axis, mode="nearest") for axis in (1, 0)]) for one in brightness)
    scale = math.sqrt(float((a**2).sum()) * float((b**2).sum()))
    return float((a * b).sum()) / scale if scale > 0 else None


def measured(case: RunCase, script: EditScript, shown: Shown | None = None) -> dict[str, Any]:
    """The numbers of one edit. ``shown``: gets the number of each frame, and its renders without and with the edit.
    InputError: the script cannot be carried out on this drive."""
    drive = apply.carry_out(script, case.model, case.scene, case.cloud)
    usual, edited, weather = _videos(case, drive)
    sums = Sums()
    for number, frame in enumerate(case.frames):
        (old, stood), (new, stands) = usual.add(frame.view), edited.add(frame.view)
        touched, freed = _regions(drive.plan, frame.view, stood, stands)
        if weather:
            structure = gradient_correlation(new.rgb, old.rgb)
            sums.structure += [] if structure is None else [structure]
        else:
            sums.away += int((~touched).sum())
            sums.changed += int((changed_pixels(new.rgb, old.rgb) & ~touched).sum())
        _add_points(case, drive.plan, frame, old, new, touched, freed, sums)
        if shown is not None:
            shown(number, old, new)
    kinds = [note["kind"] for note in drive.notes]
    outside = sums.changed / sums.away if sums.away else None
    structure = float(np.mean(sums.structure)) if sums.structure else None
    images = {"warp": edited.warp, "warp_before": usual.warp, "outside": outside, "structure": structure}
    depths = {name: sums.depth_of(key) for name, key in (("lidar", "after"), ("lidar_before", "before"))}
    uncovered = {"uncovered": sums.depth_of("uncovered"), "uncovered_psnr": sums.uncovered_psnr}
    overlaps = {"overlap": edited.overlap, "overlap_before": usual.overlap}
    counts = {"collisions": kinds.count("collision"), "warnings": len(kinds)}
    notes = [note["text"] for note in drive.notes]
    return {**images, **depths, **uncovered, **overlaps, **counts, "notes": notes}


def _videos(case: RunCase, drive: apply.EditedDrive) -> tuple[Video, Video, bool]:
    """The unedited and the edited video, and whether weather or light changes."""
    conditions = conditions_of(drive.script.canonical())
    made = drive.model(case.model)
    plain, draw = apply.drawer(case.model), apply.drawer(made)
    if conditions is not None:
        draw = apply.in_weather(draw, apply.weather_of(draw, conditions, case.scene))
    new = next(iter(drive.plan.inserted), case.lead)
    usual, edited = Video(case.model, plain), Video(made, draw)
    for video, world, name in ((usual, drive.plan.before, case.lead), (edited, drive.plan.after, new)):
        if actor := world.actors.get(name):
            video.actor, video.motion, video.size_m = name, actor.motion, actor.size_m
    return usual, edited, conditions is not None


def _regions(plan: EditPlan, view: View, stood: Mask, stands: Mask) -> tuple[Mask, Mask]:
    """Bool[H, W] each: pixels near the edit (the boxes' old and new places and the ground about them, where shadows
    lie), and those that showed the vehicle and do not any more."""
    before, after = (touched_boxes(plan, view.time_s, when) for when in ("before", "after"))
    touched = boxes_mask(view, before) | boxes_mask(view, after) | ground_mask(view, [*before, *after])
    return touched, stood & ~stands & ~boxes_mask(view, after) if before else np.zeros_like(stood)


def _add_points(
    case: RunCase,
    plan: EditPlan,
    frame: Frame,
    old: Observation,
    new: Observation,
    touched: Mask,
    freed: Mask,
    sums: Sums,
) -> None:
    """Add the errors of depth and of uncovered colours at LiDAR points."""
    truth = case.points.truth_at(frame.view, None)
    if truth is not None:
        where = (truth.depth > 0) & ~touched
        sums.add_depth("before", old, truth.depth, where)
        sums.add_depth("after", new, truth.depth, where)
    around = case.points.around(frame.view.time_s, AROUND_SWEEPS) if freed.any() else None
    if around is not None:
        rows = np.flatnonzero(around.owner == STATIC)
        still = around.taken(rows)
        depth, index = lidar.visible(frame.view, still.xyz, still.gap_deg)
        sums.add_depth("uncovered", new, depth, (depth > 0) & freed)
        color, known = _recorded_colors(case, plan, around)
        asked = freed & (index >= 0)
        number = rows[index[asked]]
        made = new.rgb.permute(1, 2, 0).numpy()[asked]
        sums.colors.append((made - color[number].astype(np.float32) / 255)[known[number]].ravel())


def _recorded_colors(case: RunCase, plan: EditPlan, points: OwnedPoints) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
    """Colours u8[N, 3] that recorded frames show at points, and which of them some frame shows, bool[N]: of
    ``COLOR_FRAMES`` frames, the middle one first. What lies in the boxes of the edit's objects or on the ground about
    them, where their shadow lies, is not known."""
    middle = (len(case.frames) - 1) / 2
    spread = np.unique(np.linspace(0, len(case.frames) - 1, COLOR_FRAMES).round().astype(int))
    color, known = np.zeros((len(points.xyz), 3), np.uint8), np.zeros(len(points.xyz), bool)
    for number in sorted(spread.tolist(), key=lambda n: abs(n - middle)):
        frame = case.frames[number]
        boxes = touched_boxes(plan, frame.view.time_s, "before")
        spoilt = boxes_mask(frame.view, boxes) | ground_mask(frame.view, boxes)
        image = np.dstack([read_image(case.scene, frame), spoilt.astype(np.uint8)])
        placed = case.points.placed(points, frame.view.time_s)
        found, there = lidar.carried(frame.view, image, placed, points.gap_deg)
        fresh = there[:-1] & ~known & (found[:-1, 3] == 0)
        color[fresh], known = found[:-1][fresh, :3], known | fresh
    return color, known


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
"""Places, metres ahead of and to the left of the vehicle, that are tried for an inserted one: the first without a
collision is taken."""
AHEAD_M: Final = 2.0
CANDIDATES: Final = 6
LOOKS: Final = 6
"""Frames in which the pixels of vehicles are counted, and how many vehicles, those with the largest boxes."""
PICTURES: Final = (1 / 3, 2 / 3)
"""Where in the video the frames of the page lie."""
HEADS: Final = (
    *("run", "edit", "warp error (lower)", "unedited", "outside changed (lower)", "structure (higher)"),
    *("LiDAR AbsRel (lower)", "unedited", "uncovered AbsRel (lower)", "uncovered PSNR dB (higher)"),
    *("overlap (higher)", "unedited", "collisions", "warnings"),
)
FORMS: Final = {
    **dict.fromkeys(("warp", "warp_before"), "{:.4f}"),
    "outside": "{:.2%}",
    "structure": "{:.3f}",
    **dict.fromkeys(("lidar", "lidar_before"), "{:.4f}"),
    "uncovered": "{:.3f}",
    **dict.fromkeys(("uncovered_psnr", "overlap", "overlap_before"), "{:.2f}"),
    **dict.fromkeys(("collisions", "warnings"), "{}"),
}
KINDS: Final = ("unedited", "edited", "difference")
"""Pictures of a frame."""
OUTPUT: Final = VerbOutput(
    "bench edit of runs", 1, ("bench.json", "bench.md", "page.html", "rows/*.json", "pictures/*.jpg", "assets/*")
)


def run(config: BenchConfig, sources: Sequence[Path], out: Path, *, overwrite: bool = False) -> Path:
    """Edit recorded drives; returns ``out`` with ``bench.json``, ``bench.md`` and ``page.html``. What an interrupted
    one finished is kept. ``sources``: folders of finished ``mudg run``. UsageError: ``--harmonize``, which compares
    with a truth. InputError: a folder is no finished run, its scene has no labels, no LiDAR or no moving vehicle."""
    if config.harmonize:
        what = "what a diffusion model adds is compared with generated cities alone"
        raise UsageError(what, where="--harmonize", remedy="leave it out, or name no runs")
    folders = names_of(sources)
    runs = {name: find_run(path) for name, path in folders.items()}
    for name, parts in runs.items():
        if not parts.whole:
            what, expected = "of a fit alone the recorded drive is not known", "a folder made by `mudg run`"
            raise InputError(what, where=str(folders[name]), expected=expected)
    refuse_overlap(out, {f"run {name}": path for name, path in folders.items()})
    device, inputs = drawing_device(config.device, "benchmark"), {}
    for name, parts in runs.items():
        paths = {"fit": parts.model, "scene": parts.scene, "fused": parts.fused}
        inputs |= {f"{name} {part}": store.digest(path) for part, path in paths.items() if path is not None}
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
        names = (plain if n == 1 else f"{plain}-{n}" for n in range(1, len(found) + 2))
        found[next(name for name in names if name not in found)] = path
    return found


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
        apply.write_asset(out / "assets" / f"{name}.safetensors", apply.asset_from(runs[name], lead))
        return {"lead": lead}

    lead_files = {name: finished(out / "rows" / f"{name}_lead.json", partial(lead_found, name)) for name in names}
    leads = {name: str(file["lead"]) for name, file in lead_files.items()}
    with log.task("editing runs", len(names) * len(EDITS)) as bar:
        for number, name in enumerate(names):
            giver = names[(number + 1) % len(names)]
            for edit in EDITS:
                bar.update(f"{name}: {edit}")

                def row(name: str = name, edit: str = edit, giver: str = giver) -> dict[str, Any]:
                    drive = case(name, leads[name])
                    script = script_of(drive, edit, out / "assets" / f"{giver}.safetensors")
                    values = measured(drive, script, _pictures(len(drive.frames), out, _stem(name, edit)))
                    head = {"run": name, "edit": edit, "object": drive.lead}
                    return {**head, "given_by": giver if edit == "insert" else None, **values, "script": script.text()}

                rows.append(finished(out / "rows" / f"{_stem(name, edit)}.json", row))
                bar.advance()
    return {"schema": 1, "runs": names, "leads": leads, "rows": rows}


def _stem(name: str, edit: str) -> str:
    return f"{name}_{edit.replace(' ', '_')}"


def case_of(name: str, parts: RunParts, device: torch.device, lead: str = "") -> RunCase:
    """A run, read; ``lead``: the vehicle that is edited, if it is known. InputError: no classes, no LiDAR, or no
    vehicle that moves."""
    if parts.scene is None or parts.fused is None:  # a whole run has both
        raise InputError("a run without its scene", where=name)
    scene, fused = read_scene(parts.scene), read_fused(parts.fused)
    if not scene.sweeps:
        what = "this scene has no LiDAR, which tells the depth that edits are held against"
        raise InputError(what, where=str(parts.scene))
    model = model_of_scene(parts.model, scene).to(device)
    if not model.classes:
        what = "this scene was fitted without labels, which edits of weather and the warp error need"
        remedy = "label the scene with `mudg annotate` and fit it again"
        raise InputError(what, where=str(parts.model), remedy=remedy)
    camera = "front" if "front" in scene.cameras else next(iter(scene.cameras))
    frames = tuple(sorted((f for f in scene.frames if f.view.camera.name == camera), key=lambda f: f.view.time_s))
    points = LogPoints(scene)
    return RunCase(name, scene, fused, model, frames, lead or lead_of(scene, model, frames, points), points)


def lead_of(scene: Scene, model: SceneModel, frames: Sequence[Frame], points: LogPoints) -> str:
    """The moving vehicle with Gaussians of its own that shows the most pixels, of those that are ahead where there are
    any. InputError: there is none."""
    nodes = model.node_names()
    tracks = [t for t in points.dynamic if t.id in nodes and t.label in street_scores.VEHICLE_LABELS]
    chosen = [frames[int(i)].view for i in np.unique(np.linspace(0, len(frames) - 1, min(LOOKS, len(frames))).round())]
    areas = {track.id: 0.0 for track in tracks}
    for track in tracks:
        for view in chosen:
            pose = track.pose_at(view.time_s)
            box = None if pose is None else street_scores.clipped_box(view, pose, track.size_m)
            if box is not None:
                edge = np.array([view.camera.width, view.camera.height], np.float64)
                areas[track.id] += float((np.clip(box[2:], 0, edge) - np.clip(box[:2], 0, edge)).prod())
    ahead = {track.id for track in tracks if any(_is_ahead(track, view) for view in chosen)}
    visible = (name for name, area in areas.items() if area > 0)
    seen = sorted(visible, key=lambda name: (name not in ahead, -areas[name]))
    nearest = [name for name in seen if name in ahead or not ahead & {*seen}][:CANDIDATES]
    shown = {name: sum(int(drawn_pixels(model, name, view).sum()) for view in chosen) for name in nearest}
    if not any(shown.values()):
        what, where = "no vehicle moves in the view of this drive's front camera", scene.id
        expected = "a moving track of a vehicle with Gaussians of its own"
        got = f"{len(points.dynamic)} moving tracks of {len(scene.tracks)}"
        raise InputError(what, where=where, expected=expected, got=got, remedy="edit another drive")
    return max(shown, key=lambda name: shown[name])


def _is_ahead(track: Track, view: View) -> bool:
    """Whether a track's box stands in front of the camera, less than ``AHEAD_M`` beside its axis."""
    pose = track.pose_at(view.time_s)
    x, _, z = (0.0, 0.0, -1.0) if pose is None else (view.cam_from_world @ pose)[:3, 3]
    return bool(z > 0 and abs(x) < AHEAD_M)


def script_of(case: RunCase, edit: str, asset: Path) -> EditScript:
    """The script of one edit; an inserted vehicle stands at the first free place of ``INSERT_AT_M``, or at the first of
    all."""
    text = EDITS[edit].replace("ID", case.lead).replace("ASSET", store.json_text(str(asset.resolve()), indent=None))
    made = [parse_edits(text.replace("AHEAD", str(a)).replace("LEFT", str(b)), edit, Path()) for a, b in INSERT_AT_M]
    if edit != "insert":
        return made[0]
    world, given = EditWorld.of_scene(case.scene, apply.ground_of(case.cloud, case.model)), apply.read_asset(asset)
    sources = EditSources(lambda _: given, lambda path: apply.background_of(find_run(Path(path)), path))
    return next((script for script in made if not collisions(plan_edits(script, world, sources))), made[0])


def _pictures(frames: int, out: Path, name: str) -> Shown:
    """What writes the pictures of some frames."""
    chosen = {min(frames - 1, int(share * frames)): n for n, share in enumerate(PICTURES)}

    def shown(number: int, old: Observation, new: Observation) -> None:
        if number in chosen:
            images = (pictures.to_bytes(old.rgb), pictures.to_bytes(new.rgb), pictures.error_image(new.rgb, old.rgb))
            for kind, image in zip(KINDS, images, strict=True):
                path = out / "pictures" / f"{name}_{chosen[number]}_{kind}.jpg"
                store.atomic_write(path, jpeg_bytes(image, quality=85))

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
    """The whole page, from what ``bench.json`` holds and the pictures in ``out``, which it holds: it is for their
    owner."""
    walls = []
    for row in doc["rows"]:
        stem = out / "pictures" / _stem(row["run"], row["edit"])
        for number in range(len(list(stem.parent.glob(f"{stem.name}_[0-9]_edited.jpg")))):
            images = {kind: stem.with_name(f"{stem.name}_{number}_{kind}.jpg") for kind in KINDS}
            walls.append(wall(f"{row['run']}: {row['edit']}", images, row["notes"] if number == 0 else ()))
    lead = "Recorded drives, edited, against their unedited fits."
    private = "The pictures show your recordings: share this page with care."
    difference = "Difference: mean of the channels, black = equal, through red to white = 0.35 or more."
    sections = [
        {"title": "Numbers", "tables": [TextTable.of_texts(HEADS, map(_cells, doc["rows"]))]},
        {"title": "Pictures", "walls": walls, "notes": [difference]},
    ]
    return render_page("Edited drives", "mudg bench edit", f"{lead} {private}", sections)
