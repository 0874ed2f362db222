"""learn: train a multi-modal diffusion model on generated cities or recorded logs, on one process or many.

Read from `train`; the loop is in full view in `_train_network`. Every draw is a function of (seed, step) and of a
clip's place in the step's batch, so a continued run equals an uninterrupted one.
"""

from __future__ import annotations

import concurrent.futures
import contextlib
import hashlib
import os
import shutil
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, cast

import torch
from torch import Tensor

from mudg.base import log, store
from mudg.base.checkpoint import Checkpoint
from mudg.base.config import to_dict
from mudg.base.errors import InputError, ResourceError, UsageError
from mudg.base.location import Location
from mudg.base.processes import Interruption, calls_beside, run_in_processes
from mudg.base.run_folder import RunDir, VerbOutput
from mudg.base.types import Clip
from mudg.diffusion import city_clips, log_clips, model_files, models, parallel
from mudg.diffusion.city_clips import CityClipRules
from mudg.diffusion.clips import ShardFolder, TrainingClips, class_weights, counts_at, shard_path
from mudg.diffusion.log_clips import LogClipRules, LogSource
from mudg.diffusion.model import MDM, BatchPart
from mudg.diffusion.model_files import Model
from mudg.diffusion.models import starting_model
from mudg.diffusion.parallel import (
    SAME_SIGNAL_S,
    Ranks,
    TrainingState,
    agreed_terms,
    mean_of,
    newest_checkpoint,
    read_group,
)
from mudg.diffusion.requests import SampleRequest, half_format, sized_to_area
from mudg.diffusion.settings import LearnConfig
from mudg.diffusion.shard_sources import ListedClips, ListedShards, ShardCache, is_list, read_list
from mudg.scene.read import read_scene

WEIGHT_DECAY = 0.01
"""Of AdamW, as published."""


def train(config: LearnConfig, out: Path, output: VerbOutput, open_work: Callable[[], RunDir]) -> Path:
    """Train a model, from nothing or from an earlier one, and export it to `OUT/model`, which is returned. Under
    `torchrun` every process calls this with the same arguments; `out` lies on a file system that all see. open_work:
    opens the folder, in the leader alone; a finished result is verified and used again. NumericsError: a loss or
    gradient is not finite (names the term, the step and the process; parameters are untouched). InputError: logs or
    clips that cannot be used. ResourceError, UsageError: see `RunDir.open`."""
    torch.set_num_threads(config.threads)
    with parallel.join_processes(config.compute.device) as ranks:
        model, fresh = starting_model(config)
        opened: list[RunDir] = []

        def open_run() -> str:
            opened.append(open_work())
            return "" if opened[0].complete else str(opened[0].path)

        path = ranks.leader_does(open_run)
        if path:
            work = opened[0] if ranks.leads else RunDir(out, Path(path), output, "", {})
            try:
                _train(model, fresh, config, work, ranks)
            except KeyboardInterrupt:
                if ranks.leads:
                    work.pause()
                raise
    return out / "model"


def inputs_of(config: LearnConfig) -> dict[str, str]:
    """Digests of what a training starts from and learns from."""
    inputs = {"start": model_files.digest(config.start)} if config.start else {}
    if is_list(config.data.scenes):
        inputs["list of scenes"] = hashlib.sha256(Location.of(config.data.scenes[0]).load()).hexdigest()
    for number, source in enumerate(_logs(config)):
        inputs |= {f"scene {number}": store.digest(source.scene), f"fused {number}": store.digest(source.fused)}
    return inputs


def _logs(config: LearnConfig) -> list[LogSource]:
    return [] if is_list(config.data.scenes) else [log_clips.log_source(text) for text in config.data.scenes]


def files_read(config: LearnConfig, out: Path, overwrite: bool) -> dict[str, Path | str | None]:
    """What is read, by names for messages. Clips may lie in `out` where they do by default, unless a result there is to
    be replaced."""
    read: dict[str, Path | str | None] = {"start": model_files.folder_of(config.start) if config.start else ""}
    for number, source in enumerate(_logs(config)):
        read |= {f"scene {number}": source.scene, f"fused {number}": source.fused}
    if is_list(config.data.scenes):
        listed = [text for scene in read_list(config.data.scenes[0]).scenes for text in scene.path.split("=")]
        read |= {f"scene {text}": text for text in listed if Location.of(text).local is not None}
        read["list"] = config.data.scenes[0] if Location.of(config.data.scenes[0]).local is not None else ""
    own_clips = not overwrite and Path(config.data.clips).resolve() == (out / "clips").resolve()
    return {**read, "clips": "" if own_clips else config.data.clips}


def _train(model: Model, fresh: set[str], config: LearnConfig, directory: RunDir, ranks: Ranks) -> None:
    """Clips, codec, network, scores."""
    out = directory.path
    bf16 = half_format(config.precision, ranks.device) is not None
    source, making = open_clips(config, model, out, ranks)
    with making:
        if "codec" in fresh and isinstance(model, MDM):
            ranks.leader_does(lambda: models.train_codec(model.codec, source, directory, bf16, ranks.device))
            trained = cast("Checkpoint", newest_checkpoint(out / "codec", ranks))  # the leader's, in every process
            read_group(trained, "net", torch.nn.ModuleDict({"codec": model.codec}).state_dict())
            models.draw_weights(model.net, config.seed, "weights")
        for name in ("refiner", "finisher"):
            part = getattr(model, name, None)
            if name in fresh and part is not None:
                models.draw_weights(part, config.seed, f"{name} weights")
                part.reset()
        model.requires_grad_(False)
        model.trained_part().requires_grad_(True)
        models.hold_finisher(model, fresh, source.have_patches())
        weights = _train_network(model, source, directory, bf16, ranks)

    def finish() -> None:
        made = models.rebuilt(model, weights)
        if isinstance(made, MDM) and made.refiner is not None and config.loss.class_balance:
            made.refiner.take_back(class_weights(source.shards, source.weighed(), config.loss.class_balance))
        request = SampleRequest(config.score.steps, config.seed, bf16=bf16)
        scores = models.score(made, source.to_score(), source.shards, request)
        store.write_json(out / "metrics.json", scores)
        facts: dict[str, Any] = {"recipe": to_dict(config), "held_out": scores}
        if config.start:
            facts["continued_from"] = model_files.facts(config.start)
        models.save(made, out / "model", models.model_card(made, source, scores), facts)
        shutil.rmtree(out / CACHE, ignore_errors=True)
        directory.finish({"held_out": scores["average"]})
        log.info(*models.table(scores).splitlines())

    ranks.leader_does(finish)


# clips --------------------------------------------------------------------------------------------


CACHE = "cache"
"""Where in the output folder clips are kept that are fetched or made when they are needed, while training runs."""


def check_clips(config: LearnConfig) -> None:
    """UsageError for settings of clips that do not go together."""
    if config.data.clips and is_list(config.data.scenes):
        what = "a list of scenes says where the clips are"
        remedy = "leave it out; --compute.cache chooses where clips that were made or fetched are kept"
        raise UsageError(what, where="--data.clips", got=config.data.clips, remedy=remedy)


def open_clips(
    config: LearnConfig, model: Model, out: Path, ranks: Ranks
) -> tuple[TrainingClips, contextlib.AbstractContextManager[None]]:
    """The clips of a training, those of logs made; and a block in which processes make the missing ones of cities."""
    check_clips(config)
    data, points_alone = config.data, model.points_alone
    folder, nothing = Path(data.clips) if data.clips else out / "clips", contextlib.nullcontext()
    if is_list(data.scenes):
        return listed_clips(config, model.config.pixel_multiple, points_alone, out), nothing
    if data.scenes:
        rules = log_rules(config, model.config.pixel_multiple, points_alone)
        counts = ranks.leader_does(partial(make_log_clips, config, rules, folder))
        return clips_of_logs(config, rules, folder, *counts), nothing
    fitted = data.renders and isinstance(model, MDM) and model.config.renders
    source = clips_of_cities(config, folder, points_alone)
    return source, making_clips(source, folder, city_rules(config, points_alone, fitted)) if ranks.leads else nothing


def clips_of_cities(config: LearnConfig, folder: Path, points_alone: bool = False) -> TrainingClips:
    """Clips of generated cities; of the published system's condition all are of one size, however varied the cities."""
    data, size = config.data, (config.data.width, config.data.height)
    sizes = [size]
    if data.realism != "plain" and not points_alone:
        sizes = [city_clips.size_of(city_rules(config), city) for city in range(city_clips.SIZES)]
    held_out = [city_clips.HELD_OUT + n for n in range(data.held_out)]
    numbers = range(data.skip_cities, data.skip_cities + data.cities)
    return TrainingClips(config, ShardFolder(folder), size, sizes, numbers, data.first_cities, held_out)


def city_rules(config: LearnConfig, points_alone: bool = False, fitted: bool = False) -> CityClipRules:
    """Rules for the generator; `points_alone`: the published system's condition."""
    data = config.data
    return CityClipRules(
        data.width,
        data.height,
        data.window,
        config.seed,
        data.clips_per_city,
        published=points_alone,
        realism=data.realism,
        textures=data.textures,
        fitted=fitted,
        log_frames=data.log_frames,
        side_cameras=data.side_cameras,
        fit_steps=data.fit_steps,
    )


def making_clips(source: TrainingClips, folder: Path, rules: CityClipRules) -> contextlib.AbstractContextManager[None]:
    """A block while which processes make the missing clips of cities, held-out ones first (see ``calls_beside``)."""
    workers, missing = source.config.compute.workers, list[int]()
    for number in (*source.scored, *source.numbers):
        if source.shards.has(number):
            counts_at(shard_path(folder, number))  # a damaged one is found before the training begins
        else:
            missing.append(number)
    if not missing or workers == 0:
        return contextlib.nullcontext()
    store.make_folder(folder)
    if not os.access(folder, os.W_OK):
        raise ResourceError(
            "training clips cannot be written here", where=str(folder), remedy="choose another --data.clips"
        )
    log.info(f"learn: {len(missing)} cities to generate into {folder}, {workers} processes")
    return calls_beside(city_clips.write_city, [(rules, n, folder) for n in missing], workers)


def log_rules(config: LearnConfig, multiple: int, points_alone: bool = False) -> LogClipRules:
    """How clips are cut from logs: of the configuration's area, in the aspect of the first log's first camera.
    `points_alone`: with the published system's condition, and of the configuration's very size, whatever the aspect."""
    data, scene = config.data, read_scene(log_clips.log_source(config.data.scenes[0]).scene)
    names = data.cameras or tuple(scene.cameras)
    if names[0] not in scene.cameras:
        what = "the scene has no such camera"
        raise InputError(what, where=f"--data.cameras, {scene.root}", expected=", ".join(scene.cameras), got=names[0])
    camera, size = scene.cameras[names[0]], (data.width, data.height)
    if not points_alone:
        size = sized_to_area(data.width * data.height, camera.width / camera.height, multiple)
    return rules_of_size(config, size, points_alone)


def rules_of_size(config: LearnConfig, size: tuple[int, int], points_alone: bool) -> LogClipRules:
    """How clips of a size are cut from logs."""
    data = config.data
    return LogClipRules(
        *size,
        window=data.window,
        stride=data.stride,
        cameras=data.cameras,
        held_out_every=data.held_out_every,
        seed=config.seed,
        published=points_alone,
        least_points=1.0 if points_alone else LogClipRules.least_points,
    )


def make_log_clips(config: LearnConfig, rules: LogClipRules, folder: Path) -> tuple[int, int]:
    """Make the missing clips of all logs; returns how many there are to train on and to score."""
    sources, workers = _logs(config), config.compute.workers
    rows = log_clips.plan_shards(sources, rules, city_clips.HELD_OUT)
    log_clips.claim_folder(folder, rules, sources)
    jobs = [
        (source, rules, [(number, window) for number, owner, window in rows if owner == source], folder)
        for source in dict.fromkeys(sources)
    ]
    with log.task("clips of logs", len(jobs)) as bar:
        for _ in run_in_processes(log_clips.write_log, jobs, max(1, min(workers, len(jobs)))):
            bar.advance()
    scored = sum(window.held_out for _, _, window in rows)
    return len(rows) - scored, scored


def clips_of_logs(config: LearnConfig, rules: LogClipRules, folder: Path, train: int, scored: int) -> TrainingClips:
    """Clips of logs, one in each shard; where none is held out, the first one trained on is scored."""
    data, size = config.data, (rules.width, rules.height)
    if not scored:
        log.warn("learn: no clip is held out; the scored clip was also trained on")
    condition = "the projected points and the first image" if rules.published else "images taken at other times"
    about = (
        f"{train} clips of {data.window} frames of {len(data.scenes)} recorded"
        f" {'log' if len(data.scenes) == 1 else 'logs'} at {rules.width}x{rules.height} pixels, seen from where"
        f" they were\nrecorded, with {condition} as condition. Depth was learned where a sweep measured it,"
        " and from labels elsewhere. The model this\none continues from has training data of its own. `held-out` below"
        f" means every {data.held_out_every}. window of these logs."
    )
    to_score = [city_clips.HELD_OUT + n for n in range(scored)] if data.held_out_every else [0]
    return TrainingClips(config, ShardFolder(folder), size, [size], range(train), train, to_score, about)


def listed_clips(config: LearnConfig, multiple: int, points_alone: bool, out: Path) -> ListedClips:
    """Clips of listed scenes, of the configuration's size, which is rounded to what the model takes."""
    data, compute, size = config.data, config.compute, (config.data.width, config.data.height)
    if not points_alone:
        size = round(data.width / multiple) * multiple, round(data.height / multiple) * multiple
    scenes = read_list(data.scenes[0], data.held_out)
    log.info(*f"learn: {data.scenes[0]}: {scenes.summary()}".splitlines())
    shares = ", ".join(f"{name} {100 * share:.3g} %" for name, share in list(scenes.shares.items())[:20])
    about = (
        f"clips of {data.window} frames of {len(scenes.scenes)} listed scenes at {size[0]}x{size[1]} pixels\n"
        f"({shares}). {len(scenes.scored)} scenes were held out for scoring."
    )
    cache = ShardCache(Path(compute.cache) if compute.cache else out / CACHE, int(compute.cache_gb * 1e9))
    shards = ListedShards(scenes, cache, rules_of_size(config, size, points_alone), data.bad_scenes)
    return ListedClips(config, shards, size, [size], range(0), 0, (), about)


Drawn = list[list[Clip]]
"""The clips of a step, by portions."""


class DrawingAhead:
    """Threads that draw the clips of the next steps while a step is computed. draw: the clips of a step, by portions.
    ready: whether nothing has to be waited for to draw them. depth: so many steps ahead. 0: none. steps: of the
    training."""

    def __init__(self, draw: Callable[[int], Drawn], ready: Callable[[int], bool], depth: int, steps: int) -> None:
        self._draw, self._ready, self._depth, self._steps = draw, ready, depth, steps
        self._pool = concurrent.futures.ThreadPoolExecutor(max(1, depth))
        self._drawn: dict[int, concurrent.futures.Future[Drawn]] = {}

    def __enter__(self) -> DrawingAhead:
        return self

    def __exit__(self, *_: object) -> None:
        self._pool.shutdown(wait=True, cancel_futures=True)

    def take(self, step: int) -> Drawn:
        """The clips of a step. Begins with those of the steps after it."""
        for later in range(step + 1, min(step + 1 + self._depth, self._steps)):
            if later not in self._drawn and self._ready(later):
                self._drawn[later] = self._pool.submit(self._draw, later)
        future = self._drawn.pop(step, None)
        return self._draw(step) if future is None else future.result()


# network ------------------------------------------------------------------------------------------


def learning_rate(config: LearnConfig, step: int) -> float:
    """Linear warm-up, constant, then a linear fall to `last_lr_share` over the last `decay_share` of the steps."""
    rules = config.optimizer
    warm = min(1.0, (step + 1) / max(1, rules.warmup_steps))
    left = (config.steps - step) / max(1.0, rules.decay_share * config.steps)
    return rules.lr * warm * max(rules.last_lr_share, min(1.0, left))


def frames_at(config: LearnConfig, step: int) -> int:
    """Frames per clip: half the window first, the whole window for the last `full_window_share` of the steps."""
    late = step >= (1 - config.optimizer.full_window_share) * config.steps
    return config.data.window if late else max(1, config.data.window // 2)


def _begin(model: Model, config: LearnConfig, out: Path, ranks: Ranks) -> tuple[TrainingState, torch.nn.Module]:
    """Freeze, spread over the processes, make the optimiser, and take up the newest checkpoint. Returns what to call in
    place of the model, too."""
    models.freeze(model, config.frozen)
    model.to(ranks.device)
    trained = model.trained_part()
    trained.train()
    if config.compute.recompute:
        for part in trained.values():
            parallel.recompute(part)
    network = parallel.spread(model, ranks)
    rules, moving = config.optimizer, [p for p in trained.parameters() if p.requires_grad]
    optimizer = torch.optim.AdamW(moving, lr=rules.lr, betas=rules.betas, weight_decay=WEIGHT_DECAY, fused=True)
    average = None
    if rules.average_decay:
        average = {name: value.detach().clone() for name, value in trained.state_dict().items()}
    state = TrainingState(trained, optimizer, average)
    if state.resume(out, ranks):
        log.info(f"learn: resuming at step {state.step}")
    if ranks.size > 1:
        log.info(f"learn: {ranks.size} processes")
    return state, network


def _batch(config: LearnConfig, ranks: Ranks, step: int) -> tuple[int, int, list[slice]]:
    """Frames of a clip at `step`, clips of the whole batch, and this process's portions of it."""
    frames = frames_at(config, step)
    count = max(1, config.optimizer.batch_frames // frames)
    return frames, count, ranks.share(count, config.compute.accumulate)


def _train_network(model: Model, source: TrainingClips, run_dir: RunDir, bf16: bool, ranks: Ranks) -> dict[str, Tensor]:
    """Train what the model names; returns the weights to use (the moving average)."""
    config, out = source.config, run_dir.path / "steps"
    state, network = _begin(model, config, out, ranks)
    balance = class_weights(source.shards, source.weighed(), config.loss.class_balance).to(ranks.device)
    rules = balance, config.loss.refined_share, config.data.reference_dropout
    picture_of = lambda step: run_dir.path / "samples" / f"{step:07d}.png"

    def draw(step: int) -> Drawn:
        frames, count, parts = _batch(config, ranks, step)
        return [source.draw(step, count, frames, "batch", part) for part in parts]

    def watch() -> None:
        """Score the model as it is on a few held-out clips and draw a grid of what it makes."""
        shards, made = source.to_score()[: config.score.watched], models.rebuilt(model, state.weights())
        request = SampleRequest(config.score.steps, config.seed, bf16=bf16)
        scores = models.score(made, shards, source.shards, request, picture=picture_of(state.step))
        run_dir.log(step=state.step, held_out=scores["average"])
        log.info(f"step {state.step}", *models.table(scores).splitlines())

    def is_watched(step: int) -> bool:
        return step % config.score.every == 0 or step == config.steps

    # a training may have been stopped between a checkpoint and its picture
    if state.step and is_watched(state.step):
        ranks.leader_does(lambda: None if picture_of(state.step).is_file() else watch())
    facts = {"seed": config.seed}
    recent: list[dict[str, float]] = []
    begun, clock, saved_at = state.step, time.monotonic(), state.step
    with (
        log.task("network", config.steps, begun) as bar,
        Interruption(SAME_SIGNAL_S) as interruption,
        DrawingAhead(draw, source.ready, config.compute.read_ahead, config.steps) as ahead,
    ):
        for step in range(begun, config.steps):
            for group in state.optimizer.param_groups:
                group["lr"] = learning_rate(config, step)
            frames, count, parts = _batch(config, ranks, step)
            terms: dict[str, float] = {}
            state.optimizer.zero_grad(set_to_none=True)
            for part, drawn in zip(parts, ahead.take(step), strict=True):
                clips = [clip.to(ranks.device) for clip in drawn]
                with parallel.portion(network, last=part is parts[-1]):
                    with torch.autocast(ranks.device.type, torch.bfloat16, enabled=bf16):
                        loss = network(clips, BatchPart(config.seed, step, part.start, count, *rules))
                    (loss.total / len(parts)).backward()
                for name, value in {**loss.terms, "total": float(loss.total.detach())}.items():
                    terms[name] = terms.get(name, 0.0) + value
            terms, stop = agreed_terms(ranks, terms, len(parts), step, "network", stop=interruption.requested)
            limit = config.optimizer.clip_norm or float("inf")
            norm = float(torch.nn.utils.clip_grad_norm_(state.trained.parameters(), limit))
            agreed_terms(ranks, {"gradient norm": norm}, 1, step, "network")
            state.optimizer.step()
            state.step = done = step + 1
            state.blend(config.optimizer.average_decay)
            recent.append({**terms, "gradient_norm": norm})
            rate = (done - begun) / (time.monotonic() - clock)
            bar.update(f"loss {mean_of(recent[-25:])['total']:.4f}  {rate:.2f} steps/s")
            bar.advance()
            last = done == config.steps
            if done % config.compute.log_every == 0 or last:
                if ranks.leads:
                    values = {"frames": frames, "rate": round(rate, 3), **mean_of(recent)}
                    run_dir.log(step=done, **values)
                recent = []
            if done % config.compute.checkpoint_every == 0 or last or stop:
                took_s = state.save(out, ranks, facts)
                log.info(f"learn: checkpoint of step {done} in {took_s:.2f} s")
                saved_at = done
            if is_watched(done):
                ranks.leader_does(watch)
            if stop and not last:
                log.info(f"learn: stopped after step {saved_at}, which is saved")
                interruption.stop_now()
    return state.weights()
