"""Training clips of a log's lessons (see `lessons.py`).

The truth of a clip are photographs, and depth where a sweep measured it. Elsewhere depth and all classes are what the model that is
adapted makes itself of the same condition: the log shows colours, but nobody knows what stands above its LiDAR, and guessed labels
must not be learned as truth.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import torch

from mudg import native
from mudg.base import seeds
from mudg.base.devices import NETWORK_KINDS, choose_device
from mudg.base.processes import one_torch_thread
from mudg.base.types import Clip, Condition, Photo, Scene, View
from mudg.core.pictures import resize_area
from mudg.data.clips.condition import ConditionRules, WarpSource, build_conditions, image_tensor
from mudg.data.clips.from_city import HELD_OUT, PATCH_PX, cut_patch
from mudg.data.clips.from_log import measured_depth
from mudg.data.clips.shards import pack_clips, shard_path, write_shard
from mudg.data.cloudfile import read_fused
from mudg.data.scene import read_image, read_scene, read_trusted_classes
from mudg.models.diffusion import GeneratedClip, SampleRequest, generated, generated_and_finished
from mudg.models.mdm import files as mdm_files
from mudg.models.mdm.model import MDM
from mudg.stages.adapting.lessons import FitScene, LearntLog, Lesson, fit_lesson, lessons_of
from mudg.stages.config import AdaptConfig
from mudg.stages.fitting.planes import render_planes
from mudg.stages.fitting.storage import load_model
from mudg.stages.learning.models import model_of_window

CLIPS = "clips"
Plan = list[tuple[int, Lesson, tuple[str, ...]]]
"""Number of the shard, lesson, and ids of the frames of every clip."""


def plan_clips(lessons: list[Lesson], config: AdaptConfig) -> Plan:
    """All clips: those to learn from have numbers from 0, those for scoring from `HELD_OUT`; a block serves for one only."""
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


def make_lesson(config: AdaptConfig, log: LearntLog, lesson: Lesson, rows: Plan, work: Path, fit_scene: FitScene) -> int:
    """Fit a lesson and write its shards of a plan into `work`/clips, those that are not there yet; returns how many were made. One
    lesson needs nothing of another, so this may run in a process of its own."""
    missing = [row for row in rows if not shard_path(work / CLIPS, row[0]).is_file()]
    if not missing:
        return 0
    with native.one_thread(), one_torch_thread():
        folder = fit_lesson(config, log, lesson, work / lesson.name, fit_scene)
        device = choose_device(config.device, "diffusion model", NETWORK_KINDS)
        model = model_of_window(mdm_files.load(config.model), config.block).to(device)
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
        self._photos = [
            Photo(f.view, read_image(shown, f), read_trusted_classes(shown, f)) for f in shown.frames
        ]
        self._fitted = load_model(folder / "fit")
        self._sources: dict[int, WarpSource] = {}
        size = (log.width_px, log.height_px)
        self._rules = ConditionRules(*size, *(log.scale * side for side in size))

    def make(self, frames: tuple[str, ...], number: int) -> Clip:
        """The clip of some frames."""
        chosen = [next(f for f in self._scene.frames if f.id == name) for name in frames]
        views = [f.view for f in chosen]
        condition, fine = build_conditions(
            self._cloud, self._scene.tracks, views, self._photos, self._rules, self._sources,
            lambda view: render_planes(self._fitted, view),
        )  # fmt: skip
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

    def _clip(self, condition: Condition, images: list, made: GeneratedClip) -> Clip:
        rgb = torch.stack([image_tensor(resize_area(i, v.camera.width, v.camera.height)) for i, v in zip(images, condition.views)])
        depth, known = (torch.stack(parts) for parts in zip(*(self._measured(view) for view in condition.views)))
        return Clip(condition, rgb, torch.where(known, depth, made.depth), torch.ones_like(known), made.semantics)

    def _measured(self, view: View) -> tuple[torch.Tensor, torch.Tensor]:
        depth, known = measured_depth(self._scene, view)
        return torch.from_numpy(depth)[None], torch.from_numpy(known)[None]
