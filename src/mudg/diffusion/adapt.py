"""adapt: the diffusion model, trained for a few steps on the log that it is going to work on.

Read from `PlannedAdaptation`: short fits to what the lessons of the log show, clips of them, some steps of the
`learn` verb, and the comparison on blocks of frames that were kept for it. Frames that the scene holds out are never
read.

    OUT/model/            the model to use: adapted, or the one started from if that is as good (same layout as
                          `learn`'s)
    OUT/adapt.json        scores of both on the clips kept for scoring, and which was taken
    OUT/before.png, after.png   those clips: condition, generated and true colour, depth and classes, confidence
    OUT/work              fits, clips and training while it runs; removed at the end
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from mudg import native
from mudg.base import log, palette, seeds, store
from mudg.base.devices import NETWORK_KINDS, choose_device
from mudg.base.errors import InputError, UsageError
from mudg.base.processes import one_torch_thread, run_in_processes
from mudg.base.types import Clip, Condition, Frame, Photo, Scene, View
from mudg.core import trajectory
from mudg.core.pictures import resize_area, resize_nearest
from mudg.diffusion import model_files, score
from mudg.diffusion.city_clips import HELD_OUT, PATCH_PX, cut_patch
from mudg.diffusion.clips import pack_clips, shard_path, write_shard
from mudg.diffusion.condition import ConditionRules, WarpSource, build_conditions, image_tensor, warp
from mudg.diffusion.log_clips import measured_depth
from mudg.diffusion.memory_plan import choose_bf16
from mudg.diffusion.model import MDM
from mudg.diffusion.models import model_of_window
from mudg.diffusion.requests import GeneratedClip, SampleRequest, generated, generated_and_finished
from mudg.diffusion.settings import AdaptConfig, LearnCompute, LearnConfig, LearnData, LearnOptimizer, LearnScore
from mudg.gaussians.model import SceneModel
from mudg.gaussians.rendering import render_planes
from mudg.gaussians.schedule import short_fit
from mudg.gaussians.settings import FitConfig
from mudg.gaussians.storage import load_model, model_of_scene
from mudg.scene.clouds import read_fused
from mudg.scene.labels import photographs, read_trusted_classes
from mudg.scene.read import read_image, read_points, read_scene
from mudg.scene.write import write_photos

# lessons ------------------------------------------------------------------------------------------
#
# What a log can teach about views that were not driven: its photographs as truth, seen without them. A lesson is a
# drive that shows some photographs and not others:
#
# * **gap**: blocks of consecutive frames are left out, every other block in the first lesson, the rest in the second.
#   The truth are the photographs left out.
# * **shifted**: every photograph is carried to a pose some metres to the side, with the depth of the scene fitted to
#   the log; what it does not show there is rendered. These pictures are taken for a recorded drive, and the real
#   photographs, now beside its path, are the truth. The way there goes by the depth of the first fit, the way back by
#   that of another, which is fitted to the carried pictures alone, so holes, splinters and wrong parallax are those of
#   a lateral shift.
#
# A short fit to what a lesson shows gives the renders of its conditions, as `synthesize` would have them.


@dataclass(frozen=True)
class Lesson:
    """A drive to learn from.

    Args:
        name: of its folder.
        shift_m: how far the shown pictures were carried to the left; 0 = they are photographs.
        shown: ids of the frames that are shown. truth: blocks of ids of the frames to be generated, one camera and at
            most `AdaptConfig.block` frames each, with the number of the block along the log.
    """

    name: str
    shift_m: float
    shown: tuple[str, ...]
    truth: tuple[tuple[int, tuple[str, ...]], ...]


@dataclass(frozen=True)
class LearntLog:
    """The log that is learned: folders of its scene, its fused cloud and the fit to it; width and height of the clips,
    and how many times finer their patches are."""

    scene: Path
    fused: Path
    fitted: Path
    width_px: int
    height_px: int
    scale: int


def cameras_of(scene: Scene, config: AdaptConfig) -> tuple[str, ...]:
    """The cameras that are learned."""
    return config.cameras or tuple(scene.cameras)[:1]


def blocks_of(scene: Scene, config: AdaptConfig) -> list[list[Frame]]:
    """The photographs that may be used, in blocks of `config.block` consecutive moments; all cameras of a moment lie in
    one block."""
    names = set(cameras_of(scene, config))
    frames = sorted((f for f in photographs(scene) if f.view.camera.name in names), key=lambda f: f.view.time_s)
    moment, last_s, blocks = -1, -np.inf, []
    for frame in frames:
        if frame.view.time_s - last_s > ConditionRules(1, 1).same_time_s:
            moment, last_s = moment + 1, frame.view.time_s
        if moment // config.block == len(blocks):
            blocks.append([])
        blocks[-1].append(frame)
    return blocks


def lessons_of(scene: Scene, config: AdaptConfig) -> list[Lesson]:
    """All lessons of a log."""
    blocks = blocks_of(scene, config)
    everything = tuple(f.id for block in blocks for f in block)
    clips = []
    for n, block in enumerate(blocks):
        for name in dict.fromkeys(f.view.camera.name for f in block):
            clips.append((n, tuple(f.id for f in block if f.view.camera.name == name)))
    lessons = [Lesson(f"shift{shift:+g}", shift, everything, tuple(clips)) for shift in config.shifts_m]
    if config.gaps and len(blocks) >= 3:
        for odd in (0, 1):
            shown = tuple(f.id for n, block in enumerate(blocks) for f in block if n % 2 != odd)
            lessons.append(Lesson(f"gap{odd}", 0.0, shown, tuple((n, ids) for n, ids in clips if n % 2 == odd)))
    return lessons


# what a lesson shows ------------------------------------------------------------------------------


def shown_photos(scene: Scene, lesson: Lesson, config: AdaptConfig, model: SceneModel, width_px: int) -> list[Photo]:
    """The pictures of a lesson: photographs, or photographs carried to the side by a fitted scene (at most `width_px`
    wide)."""
    photos = []
    for frame in (f for f in scene.frames if f.id in set(lesson.shown)):
        photo = Photo(frame.view, read_image(scene, frame), read_trusted_classes(scene, frame))
        if lesson.shift_m:
            photo = carried(photo, moved_view(scene, frame.view, lesson.shift_m), model, width_px)
        photos.append(photo)
    return photos


def moved_view(scene: Scene, view: View, shift_m: float) -> View:
    """The view of a vehicle that is `shift_m` to the left."""
    return min(trajectory.shifted(scene, view.camera.name, shift_m).views, key=lambda v: abs(v.time_s - view.time_s))


def carried(photo: Photo, target: View, model: SceneModel, width_px: int) -> Photo:
    """A photograph as it would look from another pose: carried by the depth of a fitted scene, which is rendered where
    the photograph shows nothing."""
    camera = photo.view.camera
    width = min(width_px, camera.width)
    size = width, max(8, round(camera.height * width / camera.width))
    own, view = photo.view.resized(*size), target.resized(*size)
    here, there = render_planes(model, own), render_planes(model, view)
    unknown = np.full(size[::-1], palette.UNLABELLED, np.uint8)
    ids = torch.from_numpy(unknown if photo.semantics is None else resize_nearest(photo.semantics, *size[::-1]))
    still = torch.zeros(size[::-1], dtype=torch.bool)
    source = WarpSource(own, image_tensor(resize_area(photo.rgb, *size)), here.depth[0], still, ids)
    rgb, classes, found = warp(view, there.depth[0], source, here.depth[0], ConditionRules(1, 1).hidden_share)
    rgb = torch.where(found, rgb, there.color).clamp(0, 1)
    classes = torch.where(found, classes, there.semantics[0])
    pixels = (rgb * 255).round().to(torch.uint8).permute(1, 2, 0).contiguous().numpy()
    return Photo(view, pixels, None if photo.semantics is None else classes.numpy())


# the fit of a lesson ------------------------------------------------------------------------------


FitScene = Callable[[FitConfig, Path, Path | None, Path], None]
"""Fits a scene with these settings and fused clouds into a folder (`folder`/fit); without clouds it makes its own
(`folder`/fuse)."""


def fit_lesson(config: AdaptConfig, log: LearntLog, lesson: Lesson, folder: Path, fit_scene: FitScene) -> Path:
    """Write what a lesson shows as a scene (`folder`/scene), fuse it where photographs are missing (`folder`/fuse), and
    fit it (`folder`/fit); returns `folder`. What is there already is used again."""
    scene = read_scene(log.scene)
    if not (folder / "scene" / "scene.json").is_file():
        photos = shown_photos(scene, lesson, config, load_model(log.fitted), log.width_px * log.scale)
        sweeps = ((s.sensor, s.time_s, s.world_from_lidar, read_points(scene, s)) for s in scene.sweeps)
        write_photos(folder / "scene", scene.source, scene.ego, scene.tracks, photos, sweeps)
    camera = next(iter(scene.cameras.values()))
    device = "auto" if config.device.startswith("cuda") else "cpu"  # a GPU that lacks gsplat cannot draw
    settings = short_fit(config.fit_iterations, log.width_px, camera.width, config.seed, device)
    fit_scene(settings, folder / "scene", log.fused if lesson.shift_m else None, folder)
    return folder


# clips --------------------------------------------------------------------------------------------
#
# The truth of a clip are photographs, and depth where a sweep measured it. Elsewhere depth and all classes are what the
# model that is adapted makes itself of the same condition: the log shows colours, but nobody knows what stands above
# its LiDAR, and guessed labels must not be learned as truth.


CLIPS = "clips"
Plan = list[tuple[int, Lesson, tuple[str, ...]]]
"""Number of the shard, lesson, and ids of the frames of every clip."""


def plan_clips(lessons: list[Lesson], config: AdaptConfig) -> Plan:
    """All clips: those to learn from have numbers from 0, those for scoring from `HELD_OUT`; a block serves for one
    only."""
    plan: Plan = []
    counts = {False: 0, True: 0}
    for lesson in lessons:
        for block, frames in lesson.truth:
            scored = block % config.held_out_every == config.held_out_every // 2
            if len(frames) < config.block:
                continue
            plan.append((counts[scored] + (HELD_OUT if scored else 0), lesson, frames))
            counts[scored] += 1
    return plan


def why_not(scene: Scene, config: AdaptConfig) -> str:
    """Why a log cannot be adapted to; empty if it can."""
    return why_too_short(plan_clips(lessons_of(scene, config), config), config)


def why_too_short(plan: Plan, config: AdaptConfig) -> str:
    """Why a plan leaves nothing to learn or nothing to score; empty if it does not."""
    scored = sum(number >= HELD_OUT for number, _, _ in plan)
    if scored and scored < len(plan):
        return ""
    return f"it is too short: {len(plan)} clips of {config.block} frames, {scored} of them to score"


def make_lesson(
    config: AdaptConfig, log: LearntLog, lesson: Lesson, rows: Plan, work: Path, fit_scene: FitScene
) -> int:
    """Fit a lesson and write its shards of a plan into `work`/clips, those that are not there yet; returns how many
    were made. One lesson needs nothing of another, so this may run in a process of its own."""
    missing = [row for row in rows if not shard_path(work / CLIPS, row[0]).is_file()]
    if not missing:
        return 0
    with native.one_thread(), one_torch_thread():
        folder = fit_lesson(config, log, lesson, work / lesson.name, fit_scene)
        device = choose_device(config.device, "diffusion model", NETWORK_KINDS)
        model = model_of_window(model_files.load(config.model), config.block).to(device)
        maker = ClipMaker(config, log, lesson, model, folder)
        for number, _, frames in missing:
            write_shard(work / CLIPS, number, pack_clips([maker.make(frames, number)]))
    return len(missing)


class ClipMaker:
    """Makes the clips of one lesson."""

    def __init__(self, config: AdaptConfig, log: LearntLog, lesson: Lesson, model: MDM, folder: Path) -> None:
        self._config, self._log, self._lesson, self._model = config, log, lesson, model
        self._scene, shown = read_scene(log.scene), read_scene(folder / "scene")
        self._cloud = read_fused(log.fused if lesson.shift_m else folder / "fuse")
        self._photos = [Photo(f.view, read_image(shown, f), read_trusted_classes(shown, f)) for f in shown.frames]
        self._fitted = load_model(folder / "fit")
        self._sources: dict[int, WarpSource] = {}
        size = (log.width_px, log.height_px)
        self._rules = ConditionRules(*size, *(log.scale * side for side in size))

    def make(self, frames: tuple[str, ...], number: int) -> Clip:
        """The clip of some frames."""
        chosen = [next(f for f in self._scene.frames if f.id == name) for name in frames]
        views = [f.view for f in chosen]
        condition, fine = build_conditions(
            self._cloud,
            self._scene.tracks,
            views,
            self._photos,
            self._rules,
            self._sources,
            lambda view: render_planes(self._fitted, view),
        )
        images = [read_image(self._scene, f) for f in chosen]
        request, finished = SampleRequest(1, self._config.seed, number), None
        if self._model.finisher is None:
            sample = generated(self._model, condition, request)
        else:
            sample, finished = generated_and_finished(self._model, condition, fine, request)
        clip = self._clip(condition, images, sample)
        if finished is not None:
            rng = seeds.numpy_rng(self._config.seed, number, "patch")
            clip = replace(clip, fine=cut_patch(self._clip(fine, images, finished), self._log.scale, PATCH_PX, rng))
        return replace(clip, shift_m=self._lesson.shift_m)

    def _clip(self, condition: Condition, images: list, clip: GeneratedClip) -> Clip:
        rgb = torch.stack(
            [image_tensor(resize_area(i, v.camera.width, v.camera.height)) for i, v in zip(images, condition.views)]
        )
        depth, known = zip(*(measured_depth(self._scene, view) for view in condition.views))
        depth, known = torch.from_numpy(np.stack(depth))[:, None], torch.from_numpy(np.stack(known))[:, None]
        return Clip(condition, rgb, torch.where(known, depth, clip.depth), torch.ones_like(known), clip.semantics)


# adapt --------------------------------------------------------------------------------------------


MOST_SCALE = 4
"""Patches are at most this many times finer than the clips."""
SCORED_STEPS = 2
"""Denoising steps of the samples that are compared."""
SHARING = 4
"""Most lessons made at the same time where they share a device: each process holds a context and a small model
there."""
LEAST_GAIN_DB = 0.05
"""An adapted model that gains less than this on the clips kept for scoring is not taken."""


@dataclass(frozen=True, eq=False)
class PlannedAdaptation:
    """The lessons of a log, and the clips that they are made into.

    Args:
        model: that is adapted.
    """

    config: AdaptConfig
    model: MDM
    learnt: LearntLog
    lessons: list[Lesson]
    clips: Plan

    @classmethod
    def of(cls, config: AdaptConfig, scene: Path, fused: Path, fitted: Path) -> PlannedAdaptation:
        """Plan the adaptation to a log.

        Raises:
            InputError: the log is too short, inputs malformed. UsageError: a model that does not use renders.
        """
        if not model_files.uses_renders(config.model):
            raise UsageError(
                "this model was not trained with renders of a fitted scene",
                where="--model",
                got=config.model,
                remedy="choose another model; `embedded` is one that was",
            )
        model, loaded = model_files.load(config.model), read_scene(scene)
        model_of_scene(fitted, loaded)  # refuses the fit of another scene
        names = cameras_of(loaded, config)
        unknown = [name for name in names if name not in loaded.cameras]
        if unknown or not names:
            raise InputError(
                "the scene has no such camera",
                where=f"--cameras, {loaded.root}",
                expected=", ".join(loaded.cameras),
                got=", ".join(unknown),
            )
        camera = loaded.cameras[names[0]]
        width, height = model.image_size(camera.width, camera.height)
        scale = max(1, min(MOST_SCALE, camera.width // width))
        learnt, lessons = LearntLog(scene, fused, fitted, width, height, scale), lessons_of(loaded, config)
        clips = plan_clips(lessons, config)
        reason = why_too_short(clips, config)
        if reason:
            raise InputError(
                "the model cannot be adapted to this log",
                where=str(scene),
                got=reason,
                remedy="smaller --block, or use the model as it is",
            )
        return cls(config, model, learnt, lessons, clips)

    def make_clips(self, fit_scene: FitScene, work: Path) -> None:
        """Fits and clips of all lessons, several made at a time. fit_scene: fuses and fits one, also in another
        process."""
        rows = {lesson.name: [row for row in self.clips if row[1].name == lesson.name] for lesson in self.lessons}
        jobs = [(self.config, self.learnt, one, rows[one.name], work, fit_scene) for one in self.lessons]
        made, cores = 0, native.default_threads()
        processes = self.config.processes or (cores if self.config.device == "cpu" else min(cores, SHARING))
        with log.task("lessons", len(jobs)) as bar:
            for _, clips in run_in_processes(make_lesson, jobs, min(processes, len(jobs))):
                made += clips
                bar.advance()
        log.info(f"adapt: {len(self.clips)} clips, {made} of them made now")

    def training(self, work: Path) -> LearnConfig:
        """The settings of the training, in terms of `learn`; the network is taken as it is."""
        train = sum(number < HELD_OUT for number, _, _ in self.clips)
        return LearnConfig(
            seed=self.config.seed,
            start=self.config.model,
            steps=self.config.steps,
            precision=self.config.precision,
            threads=self.config.threads or native.default_threads(),
            frozen="denoiser" if self.config.trained == "refiner" else "nothing",
            data=LearnData(
                width=self.learnt.width_px,
                height=self.learnt.height_px,
                window=self.config.block,
                clips=str(work / CLIPS),
                cities=train,
                first_cities=train,
                clips_per_city=1,
                held_out=len(self.clips) - train,
                renders=False,
            ),
            optimizer=LearnOptimizer(
                batch_frames=self.config.batch_frames,
                lr=self.config.lr,
                full_window_share=1.0,
                warmup_steps=min(10, self.config.steps // 4),
                average_decay=0.95,
            ),
            score=LearnScore(every=1_000_000, watched=len(self.clips) - train, steps=SCORED_STEPS),
            compute=LearnCompute(device=self.config.device, workers=0, checkpoint_every=20, log_every=10),
        )

    def write_model(self, adapted: Path, work: Path, out: Path) -> dict[str, Any]:
        """Write the better one of the model as it was and as it was adapted; returns a summary."""
        record = _choose(self.config, model_of_window(self.model, self.config.block), self.clips, work, out)
        chosen = model_files.load(adapted) if record["adapted"] else self.model
        facts = {**model_files.facts(self.config.model), "adapted": record}
        model_files.save(
            model_of_window(chosen, self.model.config.window), out / "model", _card(self.config, record), facts
        )
        store.write_json(out / "adapt.json", record)
        return {"adapted": record["adapted"], "psnr": [record["before"]["psnr"], record["after"]["psnr"]]}


def _choose(config: AdaptConfig, base: MDM, plan: Plan, work: Path, out: Path) -> dict[str, Any]:
    """Compare the model started from with the one that `learn` left, on the clips kept for it; the record of the
    comparison."""
    kept = [number for number, _, _ in plan if number >= HELD_OUT]
    device = torch.device(config.device)
    request = SampleRequest(SCORED_STEPS, config.seed, bf16=choose_bf16(config.precision, device))
    found = {
        "before": score.score(base.to(device), kept, work / CLIPS, request, picture=out / "before.png"),
        "after": store.read_json(work / "learn" / "metrics.json"),
    }
    picture = work / "learn" / "samples" / f"{config.steps:07d}.png"
    store.atomic_write(out / "after.png", store.read_bytes(picture))
    scores = {}
    for name, row in found.items():
        psnr = [shift["psnr"] for shift in row["by_shift"].values()]
        scores[name] = {"psnr": round(sum(psnr) / len(psnr), 4), **{k: v for k, v in row.items() if k != "clips"}}
    gain = scores["after"]["psnr"] - scores["before"]["psnr"]
    verdict = "" if gain >= LEAST_GAIN_DB else "; the model is kept as it was"
    log.info(f"adapt: {_in_db(scores)}, on {len(kept)} clips not learned from{verdict}")
    return {
        "schema": 1,
        "adapted": gain >= LEAST_GAIN_DB,
        "clips": {"learned": len(plan) - len(kept), "scored": len(kept)},
        **scores,
    }


def _card(config: AdaptConfig, record: Mapping[str, Any]) -> str:
    """Text that lies with the model."""
    what = "adapted to one recorded log" if record["adapted"] else "as it was: adapting it to the log did not help"
    return (
        f"# Small multi-modal diffusion model, {what}\n\nStarted from `{config.model}`. PSNR on"
        f" {record['clips']['scored']} clips of the log that were not learned from: {_in_db(record)}. For this log"
        " only.\nWhoever passes it on passes on what the log's photographs taught it: mind their licence.\n"
    )


def _in_db(scores: Mapping[str, Any]) -> str:
    return f"{scores['before']['psnr']:.2f} dB before, {scores['after']['psnr']:.2f} dB after"
