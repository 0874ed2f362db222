"""adapt: the diffusion model, trained for a few steps on the log that it is going to work on.

Read from `run`: short fits to what the lessons of the log show (`adapting/lessons.py`), clips of them (`adapting/clips.py`), some steps of
the `learn` verb, and the comparison on blocks of frames that were kept for it. Frames that the scene holds out are never read.

    OUT/model/            the model to use: adapted, or the one started from if that is as good (same layout as `learn`'s)
    OUT/adapt.json        scores of both on the clips kept for scoring, and which was taken
    OUT/before.png, after.png   those clips: condition, generated and true colour, depth and classes, confidence
    OUT/work              fits, clips and training while it runs; removed at the end
"""

from __future__ import annotations

import shutil
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from mudg import native
from mudg.base import log, store
from mudg.base.config import result_settings
from mudg.base.devices import NETWORK_KINDS, choose_device
from mudg.base.errors import InputError, UsageError
from mudg.base.processes import run_in_processes
from mudg.base.run_folder import RunDir, VerbOutput, refuse_overlap
from mudg.data.clips.from_city import HELD_OUT
from mudg.data.scene import read_scene
from mudg.models.diffusion import SampleRequest
from mudg.models.mdm import files as mdm_files
from mudg.models.mdm.model import MDM
from mudg.stages import learn
from mudg.stages.adapting.clips import CLIPS, Plan, make_lesson, plan_clips, why_too_short
from mudg.stages.adapting.lessons import LearntLog, Lesson, cameras_of, lessons_of
from mudg.stages.config import AdaptConfig, LearnConfig
from mudg.stages.config.learn import LearnCompute, LearnData, LearnOptimizer, LearnScore
from mudg.stages.fitting.storage import model_of_scene
from mudg.stages.learning import score as learn_score
from mudg.stages.learning.models import model_of_window
from mudg.stages.learning.precision import choose_bf16

_OUTPUT = VerbOutput("adapt", 2, ("model/*", "model.part/", "adapt.json", "before.png", "after.png", "work/"))
MOST_SCALE = 4
"""Patches are at most this many times finer than the clips."""
SCORED_STEPS = 2
"""Denoising steps of the samples that are compared."""
SHARING = 4
"""Most lessons made at the same time where they share a device: each process holds a context and a small model there."""
LEAST_GAIN_DB = 0.05
"""An adapted model that gains less than this on the clips kept for scoring is not taken."""


def run(config: AdaptConfig, scene: Path, fused: Path, fitted: Path, out: Path, *, overwrite: bool = False) -> Path:
    """Adapt a diffusion model to a log; returns the folder of the model to use (`OUT/model`).

    Args:
        config: see `AdaptConfig`.
        scene: scene directory or stored zip. fused: output of fuse for it. fitted: output of fit for it, without virtual views.

    Raises:
        InputError: the log is too short, inputs malformed. UsageError: a model that does not use renders.
    """
    refuse_overlap(out, {"scene": scene, "fused": fused, "fitted": fitted, "model": mdm_files.folder_of(config.model)})
    config = replace(config, device=str(choose_device(config.device, "diffusion model", NETWORK_KINDS)))
    model = mdm_files.load(config.model)
    if not mdm_files.uses_renders(config.model):
        raise UsageError("this model was not trained with renders of a fitted scene", where="--model", got=config.model,
                         remedy="choose another model; `embedded` is one that was")  # fmt: skip
    inputs = {"scene": store.digest(scene), "fused": store.digest(fused), "fitted": store.digest(fitted),
              "model": mdm_files.digest(config.model)}  # fmt: skip
    learnt, lessons = _open_log(config, model, Path(scene), Path(fused), Path(fitted))
    plan = plan_clips(lessons, config)
    reason = why_too_short(plan, config)
    if reason:
        raise InputError("the model cannot be adapted to this log", where=str(scene), got=reason,
                         remedy="smaller --block, or use the model as it is")  # fmt: skip
    settings = {name: value for name, value in result_settings(config).items() if name != "processes"}
    directory = RunDir.open(out, _OUTPUT, settings, inputs, overwrite)
    if directory.complete:
        return directory.reused() / "model"
    work = directory.path / "work"
    made = _make_lessons(config, learnt, lessons, plan, work)
    base = model_of_window(model, config.block)
    log.info(f"adapt: {len(plan)} clips, {made} of them made now")
    adapted = learn.run(_training(config, learnt, plan, work / CLIPS), work / "learn")
    record = _choose(config, base, plan, work, directory.path)
    chosen = mdm_files.load(adapted) if record["adapted"] else model
    facts = {**mdm_files.facts(config.model), "adapted": record}
    mdm_files.save(model_of_window(chosen, model.config.window), directory.path / "model", _card(config, record), facts)
    store.write_json(directory.path / "adapt.json", record)
    shutil.rmtree(work, ignore_errors=True)
    directory.finish({"adapted": record["adapted"], "psnr": [record["before"]["psnr"], record["after"]["psnr"]]})
    return directory.path / "model"


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


def _make_lessons(config: AdaptConfig, learnt: LearntLog, lessons: list[Lesson], plan: Plan, work: Path) -> int:
    """Fits and clips of all lessons, several made at a time; returns the number of clips made."""
    jobs = [(config, learnt, lesson, [row for row in plan if row[1].name == lesson.name], work) for lesson in lessons]
    made = 0
    cores = native.default_threads()
    processes = config.processes or (cores if config.device == "cpu" else min(cores, SHARING))
    with log.task("lessons", len(jobs)) as bar:
        for _, clips in run_in_processes(make_lesson, jobs, min(processes, len(jobs))):
            made += clips
            bar.advance()
    return made


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
