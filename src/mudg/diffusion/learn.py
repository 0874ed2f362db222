"""learn: train a multi-modal diffusion model on generated cities or recorded logs, on one process or many.

Read from `train`: open the clips, train the latent codec (`models.py`), train the denoising network, score, export. The
training loop is in full view in `_train_network`; from the disk to the loss it goes through `clips.py` and `model.py`
(`MDM.loss`). Every draw is a function of (seed, step) and of a clip's place in the step's batch, so a run that was
interrupted and continued equals one that was not: bit for bit at a fixed number of threads and processes, up to
rounding if the number of processes or the layout changed meanwhile.

OUT/clips/    one shard per city or clip of a log (or the folder `data.clips` of the configuration)
OUT/codec/    checkpoints of the codec         OUT/steps/   checkpoints of the network, its moving average, the
              optimiser
OUT/samples/  picture grids during training    OUT/loss.png, OUT/log.jsonl, OUT/metrics.json
OUT/model/    the exported model: fp16 weights, model.json, MODEL_CARD.md
OUT/cache/    clips that were fetched or made when they were drawn; removed at the end
OUT/tensorboard/  with `compute.tensorboard`
"""

from __future__ import annotations

import contextlib
import hashlib
import importlib.util
import shutil
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from mudg.base import log, store
from mudg.base.config import to_dict
from mudg.base.errors import ResourceError, UsageError
from mudg.base.location import Location
from mudg.base.processes import Interruption
from mudg.base.run_folder import RunDir, VerbOutput
from mudg.diffusion import learn_clips, log_clips, model_files, models, parallel, score
from mudg.diffusion.clips import ShardSource
from mudg.diffusion.learn_clips import class_weights, draw_clips
from mudg.diffusion.memory_plan import choose_bf16
from mudg.diffusion.model import MDM, BatchPart, LossSettings
from mudg.diffusion.models import Model, draw_weights, freeze, hold_finisher, rebuilt, starting_model
from mudg.diffusion.parallel import SAME_SIGNAL_S, Ranks, Spread, TrainingState, agreed_terms, mean_of
from mudg.diffusion.requests import SampleRequest
from mudg.diffusion.settings import LearnConfig
from mudg.diffusion.shard_sources import ListedShards, is_list, read_list


def check(config: LearnConfig) -> LearnConfig:
    """The configuration; without renders where the condition has none.

    Raises:
        UsageError: settings that do not go together, or a condition that cannot be made. ResourceError: a package is
            missing.
    """
    if config.compute.tensorboard and importlib.util.find_spec("tensorboard") is None:
        raise ResourceError(
            "TensorBoard is not installed",
            where="--compute.tensorboard",
            remedy="pip install 'mudg[track]', or leave the flag out: log.jsonl holds the same",
        )
    if config.data.condition != "full":
        if config.data.scenes:
            raise UsageError(
                "this condition is made of generated cities only",
                where="--data.condition",
                got="--data.scenes",
                remedy="leave one of them out",
            )
        config = learn_clips.without_renders(config)
    learn_clips.is_streamed(config)  # refuses what does not go together
    return config


WEIGHT_DECAY = 0.01
"""Of AdamW, as published."""


def train(config: LearnConfig, out: Path, output: VerbOutput, open_work: Callable[[], RunDir]) -> None:
    """Train a model, from nothing or from an earlier one, and export it to `OUT/model`.

    Under `torchrun` every process calls this with the same arguments; `out` lies on a file system that all see.

    Args:
        open_work: opens the folder, in the leader alone; a finished result is verified and used again.

    Raises:
        NumericsError: a loss or gradient is not finite (names the term, the step and the process; parameters are
            untouched).
        InputError: logs or clips that cannot be used. ResourceError, UsageError: see `RunDir.open`.
    """
    torch.set_num_threads(config.threads)
    with parallel.join_processes(config.compute.device) as ranks:
        model, fresh = starting_model(config)
        opened: list[RunDir] = []

        def open_run() -> str:
            opened.append(open_work())
            return "" if opened[0].complete else str(opened[0].path)

        path = ranks.leader_does(open_run)
        if not path:
            return
        work = opened[0] if ranks.leads else RunDir(out, Path(path), output, "", {})
        try:
            _train(model, fresh, config, work, ranks)
        except KeyboardInterrupt:
            if ranks.leads:
                work.pause()
            raise


def inputs_of(config: LearnConfig) -> dict[str, str]:
    """Digests of what a training starts from and learns from."""
    inputs = {"start": model_files.digest(config.start)} if config.start else {}
    if is_list(config.data.scenes):
        inputs["list of scenes"] = hashlib.sha256(Location.of(config.data.scenes[0]).load()).hexdigest()
    for number, source in enumerate(_sources(config)):
        inputs |= {f"scene {number}": store.digest(source.scene), f"fused {number}": store.digest(source.fused)}
    return inputs


def _sources(config: LearnConfig) -> list[log_clips.LogSource]:
    return [] if is_list(config.data.scenes) else [log_clips.log_source(text) for text in config.data.scenes]


def files_read(config: LearnConfig, out: Path, overwrite: bool) -> dict[str, Path | str | None]:
    """What is read, by names for messages. Clips may lie in `out` where they do by default, unless a result there is to
    be replaced."""
    read: dict[str, Path | str | None] = {"start": model_files.folder_of(config.start) if config.start else ""}
    for number, source in enumerate(_sources(config)):
        read |= {f"scene {number}": source.scene, f"fused {number}": source.fused}
    if is_list(config.data.scenes):
        listed = [text for scene in read_list(config.data.scenes[0]).scenes for text in scene.path.split("=")]
        read |= {f"scene {text}": text for text in listed if Location.of(text).local is not None}
        read["list"] = config.data.scenes[0] if Location.of(config.data.scenes[0]).local is not None else ""
    clips = "" if learn_clips.clips_at_address(config) else config.data.clips
    own_clips = not overwrite and Path(clips).resolve() == (out / "clips").resolve()
    return {**read, "clips": "" if own_clips else clips}


def _train(model: Model, fresh: set[str], config: LearnConfig, directory: RunDir, ranks: Ranks) -> None:
    """Clips, codec, network, scores. From logs, `config` is rewritten in terms of shards: `given` is what the user
    said."""
    out, given = directory.path, config
    bf16 = choose_bf16(config.precision, ranks.device)
    folder: Path | ShardSource = Path(config.data.clips) if config.data.clips else out / "clips"
    about_data = ""
    if isinstance(model, MDM) and not model.config.renders:
        config = learn_clips.without_renders(config)
    making: contextlib.AbstractContextManager[None] = contextlib.nullcontext()
    if learn_clips.is_streamed(config):
        config, folder = learn_clips.open_streamed(config, out, model.config.pixel_multiple, model.points_alone)
        about_data = learn_clips.describe_list(config, folder) if isinstance(folder, ListedShards) else ""
    elif isinstance(folder, Path) and config.data.scenes:
        sources = [log_clips.log_source(text) for text in config.data.scenes]
        rules = learn_clips.log_rules(config, sources, model.config.pixel_multiple, model.points_alone)
        counts = ranks.leader_does(partial(learn_clips.make_log_clips, given, rules, folder))
        config = learn_clips.for_logs(config, rules, *counts)
        about_data = learn_clips.describe_logs(config, rules)
    elif isinstance(folder, Path) and ranks.leads:
        making = learn_clips.making_clips(config, folder, model.points_alone)
    if model.points_alone:
        config = learn_clips.of_one_size(config)
    with making:
        if "codec" in fresh and isinstance(model, MDM):
            ranks.leader_does(lambda: models.train_codec(model.codec, config, directory, folder, bf16, ranks.device))
            models.load_trained_codec(model.codec, out, ranks)
            draw_weights(model.net, config.seed, "weights")
        for name in ("refiner", "finisher"):
            part = getattr(model, name, None)
            if name in fresh and part is not None:
                draw_weights(part, config.seed, f"{name} weights")
                part.reset()
        model.requires_grad_(False)
        model.trained_part().requires_grad_(True)
        hold_finisher(model, fresh, learn_clips.have_patches(config, folder, config.data.skip_cities))
        weights = _train_network(model, config, directory, folder, bf16, ranks)

    def finish() -> None:
        made = rebuilt(model, weights)
        if isinstance(made, MDM) and made.refiner is not None and config.loss.class_balance:
            made.refiner.take_back(_class_weights(config, folder))
        request = SampleRequest(config.score.steps, config.seed, bf16=bf16)
        scores = score.score(made, learn_clips.scored_shards(config, folder), folder, request)
        store.write_json(out / "metrics.json", scores)
        facts: dict[str, Any] = {"recipe": to_dict(given), "held_out": scores}
        if config.start:
            facts["continued_from"] = model_files.facts(config.start)
        models.save(made, out / "model", models.model_card(made, config, scores, about_data), facts)
        shutil.rmtree(out / learn_clips.CACHE, ignore_errors=True)
        directory.finish({"held_out": scores["average"]})
        log.info(*score.table(scores).splitlines())

    ranks.leader_does(finish)


def _class_weights(config: LearnConfig, folder: Path | ShardSource) -> Tensor:
    return class_weights(folder, learn_clips.weighed_shards(config, folder), config.loss.class_balance)


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


def _begin(model: Model, config: LearnConfig, out: Path, ranks: Ranks) -> tuple[TrainingState, Spread]:
    """Freeze, spread over the processes, make the optimiser, and take up the newest checkpoint."""
    freeze(model, config.frozen)
    model.to(ranks.device)
    trained = model.trained_part()
    trained.train()
    if config.compute.recompute:
        for part in trained.values():
            parallel.recompute(part)
    spread = Spread(model, trained, ranks, config.compute.parallel, config.compute.processes_per_replica)
    rules = config.optimizer
    optimizer = torch.optim.AdamW(
        [p for p in trained.parameters() if p.requires_grad],
        lr=rules.lr,
        betas=rules.betas,
        weight_decay=WEIGHT_DECAY,
        fused=True,
    )
    average = None
    if rules.average_decay:
        average = {name: value.detach().clone() for name, value in trained.state_dict().items()}
    state = TrainingState(trained, optimizer, average)
    if state.resume(out, ranks):
        log.info(f"learn: resuming at step {state.step}")
    if ranks.size > 1:
        log.info(f"learn: {ranks.size} processes, {config.compute.parallel}")
    return state, spread


def _batch(config: LearnConfig, ranks: Ranks, step: int) -> tuple[int, int, list[slice]]:
    """Frames of a clip at `step`, clips of the whole batch, and this process's portions of it."""
    frames = frames_at(config, step)
    count = max(1, config.optimizer.batch_frames // frames)
    return frames, count, ranks.share(count, config.compute.accumulate)


def _reading_ahead(config: LearnConfig, folder: Path | ShardSource, ranks: Ranks) -> learn_clips.ReadingAhead:
    def bring(step: int) -> None:
        frames, count, parts = _batch(config, ranks, step)
        learn_clips.bring_shards(config, folder, step, count, frames, parts)

    return learn_clips.ReadingAhead(bring, 0 if isinstance(folder, Path) else config.compute.read_ahead, config.steps)


def _train_network(
    model: Model, config: LearnConfig, run_dir: RunDir, folder: Path | ShardSource, bf16: bool, ranks: Ranks
) -> dict[str, Tensor]:
    """Train what the model names; returns the weights to use (the moving average), whole, in the leader."""
    out = run_dir.path / "steps"
    state, spread = _begin(model, config, out, ranks)
    settings = _loss_settings(config, _class_weights(config, folder).to(ranks.device))
    board = _tensorboard(run_dir.path / "tensorboard") if config.compute.tensorboard and ranks.leads else None
    facts = {"seed": config.seed, "layout": config.compute.parallel}
    recent: list[dict[str, float]] = []
    begun, clock, saved_at = state.step, time.monotonic(), state.step
    watch = partial(_score_watched, model, config, run_dir, folder, bf16)
    _watch_missed(state, config, run_dir, ranks, watch)
    with (
        log.task("network", config.steps, begun) as bar,
        Interruption(SAME_SIGNAL_S) as interruption,
        _reading_ahead(config, folder, ranks) as ahead,
    ):
        for step in range(begun, config.steps):
            ahead.beyond(step)
            for group in state.optimizer.param_groups:
                group["lr"] = learning_rate(config, step)
            frames, count, parts = _batch(config, ranks, step)
            terms: dict[str, float] = {}
            state.optimizer.zero_grad(set_to_none=True)
            for part in parts:
                drawn = draw_clips(config, folder, step, count, frames, "batch", part)
                clips = [clip.to(ranks.device) for clip in drawn]
                with spread.portion(last=part is parts[-1]):
                    with torch.autocast(ranks.device.type, torch.bfloat16, enabled=bf16):
                        loss = spread.network(clips, BatchPart(config.seed, step, part.start, count), settings)
                    (loss.total / len(parts)).backward()
                for name, value in {**loss.terms, "total": float(loss.total.detach())}.items():
                    terms[name] = terms.get(name, 0.0) + value
            terms, stop = agreed_terms(ranks, terms, len(parts), step, "network", stop=interruption.requested)
            norm = parallel.clip_gradients(state.trained, config.optimizer.clip_norm)
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
                    _record(run_dir, board, done, {"frames": frames, "rate": round(rate, 3), **mean_of(recent)})
                recent = []
            if done % config.compute.checkpoint_every == 0 or last or stop:
                took_s = state.save(out, ranks, facts, config.compute.checkpoints_kept)
                log.info(f"learn: checkpoint of step {done} in {took_s:.2f} s")
                saved_at = done
            if _is_watched(config, done):
                made = state.export_weights(ranks)
                ranks.leader_does(partial(watch, made, done))
            if stop and not last:
                log.info(f"learn: stopped after step {saved_at}, which is saved")
                interruption.stop_now()
    if board is not None:
        board.close()
    return state.export_weights(ranks)


def _loss_settings(config: LearnConfig, class_weights: Tensor) -> LossSettings:
    data = config.data
    return LossSettings(
        class_weights,
        config.loss.refined_share,
        data.reference_dropout,
        frame_dropout=data.reference_dropout_scope == "tokens_and_frame",
    )


def _watch_missed(
    state: TrainingState,
    config: LearnConfig,
    run_dir: RunDir,
    ranks: Ranks,
    watch: Callable[[dict[str, Tensor], int], None],
) -> None:
    """Score and draw after a training that was stopped between a checkpoint and its picture."""
    done = state.step
    if done and _is_watched(config, done) and not ranks.leader_does(lambda: _picture(run_dir, done).is_file()):
        made = state.export_weights(ranks)
        ranks.leader_does(partial(watch, made, done))


def _is_watched(config: LearnConfig, step: int) -> bool:
    """Whether a few held-out clips are scored and drawn after so many steps."""
    return step % config.score.every == 0 or step == config.steps


def _picture(run_dir: RunDir, step: int) -> Path:
    return run_dir.path / "samples" / f"{step:07d}.png"


def _record(run_dir: RunDir, board: Any, step: int, values: dict[str, float]) -> None:
    """A line of the log, the loss curve, and the same for TensorBoard if it is wanted."""
    run_dir.log(step=step, **values)
    score.plot_losses(run_dir.path / "log.jsonl", run_dir.path / "loss.png")
    if board is not None:
        for name, value in values.items():
            board.add_scalar(f"learn/{name}", value, step)


def _tensorboard(folder: Path) -> Any:
    from torch.utils.tensorboard import SummaryWriter

    return SummaryWriter(str(folder))


def _score_watched(
    model: Model,
    config: LearnConfig,
    run_dir: RunDir,
    folder: Path | ShardSource,
    bf16: bool,
    weights: dict[str, Tensor],
    step: int,
) -> None:
    """Score the model with these weights on a few held-out clips and draw a grid of what it makes."""
    made = rebuilt(model, weights)
    shards = learn_clips.scored_shards(config, folder)[: config.score.watched]
    request = SampleRequest(config.score.steps, config.seed, bf16=bf16)
    scores = score.score(made, shards, folder, request, picture=_picture(run_dir, step))
    run_dir.log(step=step, held_out=scores["average"])
    log.info(f"step {step}", *score.table(scores).splitlines())
