"""adapt: the diffusion model, trained for a few steps on the log that it is going to work on.

Read from `PlannedAdaptation`: short fits to what the lessons of the log show (`adapting/lessons.py`), clips of them
(`adapting/clips.py`), some steps of the `learn` verb, and the comparison on blocks of frames that were kept for it. Frames that the scene
holds out are never read.

    OUT/model/            the model to use: adapted, or the one started from if that is as good (same layout as `learn`'s)
    OUT/adapt.json        scores of both on the clips kept for scoring, and which was taken
    OUT/before.png, after.png   those clips: condition, generated and true colour, depth and classes, confidence
    OUT/work              fits, clips and training while it runs; removed at the end
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from mudg import native
from mudg.base import log, store
from mudg.base.errors import InputError, UsageError
from mudg.base.processes import run_in_processes
from mudg.data.clips.from_city import HELD_OUT
from mudg.data.scene import read_scene
from mudg.models.diffusion import SampleRequest
from mudg.models.mdm import files as mdm_files
from mudg.models.mdm.model import MDM
from mudg.stages.adapting.clips import CLIPS, Plan, make_lesson, plan_clips, why_too_short
from mudg.stages.adapting.lessons import FitScene, LearntLog, Lesson, cameras_of, lessons_of
from mudg.stages.config import AdaptConfig, LearnConfig
from mudg.stages.config.learn import LearnCompute, LearnData, LearnOptimizer, LearnScore
from mudg.stages.fitting.storage import model_of_scene
from mudg.stages.learning import score as learn_score
from mudg.stages.learning.models import model_of_window
from mudg.stages.learning.precision import choose_bf16

MOST_SCALE = 4
"""Patches are at most this many times finer than the clips."""
SCORED_STEPS = 2
"""Denoising steps of the samples that are compared."""
SHARING = 4
"""Most lessons made at the same time where they share a device: each process holds a context and a small model there."""
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
        model = mdm_files.load(config.model)
        if not mdm_files.uses_renders(config.model):
            raise UsageError("this model was not trained with renders of a fitted scene", where="--model", got=config.model,
                             remedy="choose another model; `embedded` is one that was")  # fmt: skip
        learnt, lessons = _open_log(config, model, scene, fused, fitted)
        clips = plan_clips(lessons, config)
        reason = why_too_short(clips, config)
        if reason:
            raise InputError("the model cannot be adapted to this log", where=str(scene), got=reason,
                             remedy="smaller --block, or use the model as it is")  # fmt: skip
        return cls(config, model, learnt, lessons, clips)

    def make_clips(self, fit_scene: FitScene, work: Path) -> None:
        """Fits and clips of all lessons, several made at a time. fit_scene: fuses and fits one, also in another process."""
        jobs = [
            (self.config, self.learnt, lesson, [row for row in self.clips if row[1].name == lesson.name], work, fit_scene)
            for lesson in self.lessons
        ]
        made, cores = 0, native.default_threads()
        processes = self.config.processes or (cores if self.config.device == "cpu" else min(cores, SHARING))
        with log.task("lessons", len(jobs)) as bar:
            for _, clips in run_in_processes(make_lesson, jobs, min(processes, len(jobs))):
                made += clips
                bar.advance()
        log.info(f"adapt: {len(self.clips)} clips, {made} of them made now")

    def training(self, work: Path) -> LearnConfig:
        """The settings of the training, in terms of `learn`."""
        return _training(self.config, self.learnt, self.clips, work / CLIPS)

    def write_model(self, adapted: Path, work: Path, out: Path) -> dict[str, Any]:
        """Write the better one of the model as it was and as it was adapted; returns a summary."""
        record = _choose(self.config, model_of_window(self.model, self.config.block), self.clips, work, out)
        chosen = mdm_files.load(adapted) if record["adapted"] else self.model
        facts = {**mdm_files.facts(self.config.model), "adapted": record}
        mdm_files.save(model_of_window(chosen, self.model.config.window), out / "model", _card(self.config, record), facts)
        store.write_json(out / "adapt.json", record)
        return {"adapted": record["adapted"], "psnr": [record["before"]["psnr"], record["after"]["psnr"]]}


def _open_log(config: AdaptConfig, model: MDM, scene: Path, fused: Path, fitted: Path) -> tuple[LearntLog, list[Lesson]]:
    loaded = read_scene(scene)
    model_of_scene(fitted, loaded)  # refuses the fit of another scene
    names = cameras_of(loaded, config)
    unknown = [name for name in names if name not in loaded.cameras]
    if unknown or not names:
        raise InputError("the scene has no such camera", where=f"--cameras, {loaded.root}", expected=", ".join(loaded.cameras),
                         got=", ".join(unknown))  # fmt: skip
    camera = loaded.cameras[names[0]]
    width, height = model.image_size(camera.width, camera.height)
    scale = max(1, min(MOST_SCALE, camera.width // width))
    return LearntLog(scene, fused, fitted, width, height, scale), lessons_of(loaded, config)


def _training(config: AdaptConfig, learnt: LearntLog, plan: Plan, clips: Path) -> LearnConfig:
    """The settings of the training, in terms of `learn`."""
    train = sum(number < HELD_OUT for number, _, _ in plan)
    return LearnConfig(
        seed=config.seed, start=config.model, steps=config.steps, precision=config.precision,
        threads=config.threads or native.default_threads(),
        frozen="denoiser" if config.trained == "refiner" else "nothing",
        data=LearnData(
            width=learnt.width_px, height=learnt.height_px, window=config.block, clips=str(clips), cities=train,
            first_cities=train, clips_per_city=1, held_out=len(plan) - train, renders=False,  # the network is taken as it is
        ),
        optimizer=LearnOptimizer(
            batch_frames=config.batch_frames, lr=config.lr, full_window_share=1.0, warmup_steps=min(10, config.steps // 4),
            average_decay=0.95,
        ),
        score=LearnScore(every=1_000_000, watched=len(plan) - train, steps=SCORED_STEPS),
        compute=LearnCompute(device=config.device, workers=0, checkpoint_every=20, log_every=10),
    )  # fmt: skip


def _choose(config: AdaptConfig, base: MDM, plan: Plan, work: Path, out: Path) -> dict[str, Any]:
    """Compare the model started from with the one that `learn` left, on the clips kept for it; the record of the comparison."""
    kept = [number for number, _, _ in plan if number >= HELD_OUT]
    device = torch.device(config.device)
    request = SampleRequest(SCORED_STEPS, config.seed, bf16=choose_bf16(config.precision, device))
    found = {
        "before": learn_score.score(base.to(device), kept, work / CLIPS, request, picture=out / "before.png"),
        "after": store.read_json(work / "learn" / "metrics.json"),
    }
    picture = work / "learn" / "samples" / f"{config.steps:07d}.png"
    store.atomic_write(out / "after.png", store.read_bytes(picture))
    scores = {name: {"psnr": _mean_psnr(row), **{k: v for k, v in row.items() if k != "clips"}} for name, row in found.items()}
    gain = scores["after"]["psnr"] - scores["before"]["psnr"]
    verdict = "" if gain >= LEAST_GAIN_DB else "; the model is kept as it was"
    log.info(f"adapt: {_in_db(scores)}, on {len(kept)} clips not learned from{verdict}")
    return {"schema": 1, "adapted": gain >= LEAST_GAIN_DB, "clips": {"learned": len(plan) - len(kept), "scored": len(kept)}, **scores}


def _mean_psnr(found: Mapping[str, Any]) -> float:
    rows = [row["psnr"] for row in found["by_shift"].values()]
    return round(sum(rows) / len(rows), 4)


def _card(config: AdaptConfig, record: Mapping[str, Any]) -> str:
    """Text that lies with the model."""
    what = "adapted to one recorded log" if record["adapted"] else "as it was: adapting it to the log did not help"
    return (
        f"# Small multi-modal diffusion model, {what}\n\nStarted from `{config.model}`. PSNR on {record['clips']['scored']} clips of "
        f"the log that were not learned from: {_in_db(record)}. For this log only.\n"
        "Whoever passes it on passes on what the log's photographs taught it: mind their licence.\n"
    )


def _in_db(scores: Mapping[str, Any]) -> str:
    return f"{scores['before']['psnr']:.2f} dB before, {scores['after']['psnr']:.2f} dB after"
