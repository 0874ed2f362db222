"""learn: train a multi-modal diffusion model on generated cities or recorded logs, on one process or many.

Read from `run`: make the clips, fit and train the latent codec, train the denoising network, score, export. Both training
loops are in full view in `_train_codec` and `_train_network`. Every draw is a function of (seed, step) and of a clip's place
in the step's batch, so a run that was interrupted and continued equals one that was not: bit for bit at a fixed number of
threads and processes, up to rounding if the number of processes or the layout changed meanwhile.

OUT/clips/    one shard per city or clip of a log (or the folder `clips` of the configuration)
OUT/codec/    checkpoints of the codec         OUT/steps/   checkpoints of the network, its moving average, the optimiser
OUT/samples/  picture grids during training    OUT/loss.png, OUT/log.jsonl, OUT/metrics.json
OUT/model/    the exported model: fp16 weights, model.json, MODEL_CARD.md
OUT/latents/  with `cache_latents`             OUT/tensorboard/  with `tensorboard`

Clips are in `learn_clips`, processes and layouts in `learn_parallel`, checkpoints in `learn_state`, what is asked of a
model in `learn_models`, the published-type model in `learn_published`.
"""

from __future__ import annotations

import contextlib
import importlib.util
import math
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torch.nn import functional

from mudg.base import checkpoint, log, seeds, store
from mudg.base.config import to_dict
from mudg.base.errors import ResourceError, UsageError
from mudg.base.types import Clip
from mudg.core import losses
from mudg.data.clips import from_log
from mudg.data.clips.from_log import LogClipRules
from mudg.models.diffusion import SampleRequest
from mudg.models.mdm import files as mdm_files
from mudg.models.mdm.codec import PatchCodec
from mudg.models.mdm.model import MDM, BatchPart, LossSettings, MDMConfig, same_denoiser, with_refiner
from mudg.models.published.files import is_published
from mudg.stages.config import LearnConfig
from mudg.stages.learning import (
    clips as learn_clips,
)
from mudg.stages.learning import (
    parallel as learn_parallel,
)
from mudg.stages.learning import (
    published as learn_published,
)
from mudg.stages.learning import (
    score as learn_score,
)
from mudg.stages.learning.clips import class_weights, draw_clips
from mudg.stages.learning.latents import cached_latents
from mudg.stages.learning.models import Model, kind_of
from mudg.stages.learning.parallel import Interruption, Ranks, Spread, agreed, joined
from mudg.stages.learning.precision import choose_bf16
from mudg.stages.learning.state import TrainingState, mean_of, newest

HOW = (
    "parallel",
    "accumulate",
    "recompute",
    "cache_latents",
    "tensorboard",
    "workers",
    "device",
    "checkpoint_every",
    "log_every",
)
"""Settings that say how a run is computed and not what comes out; a run may be continued with other ones."""


def run(config: LearnConfig, out: Path, *, overwrite: bool = False) -> Path:
    """Train a model, from nothing or from an earlier one; returns the folder of the exported model (`OUT/model`).

    Under `torchrun` every process calls this with the same arguments; `out` lies on a file system that all see.

    Raises:
        NumericsError: a loss or gradient is not finite (names the term, the step and the process; parameters are untouched).
        InputError: logs or clips that cannot be used. ResourceError, UsageError: see `RunDir.open`.
    """
    if config.cache_latents and config.augment:
        raise UsageError("varied clips are never the same twice, so their latents cannot be kept", where="--cache-latents",
                         remedy="add --no-augment")  # fmt: skip
    if config.tensorboard and importlib.util.find_spec("tensorboard") is None:
        raise ResourceError("TensorBoard is not installed", where="--tensorboard",
                            remedy="pip install 'mudg[track]', or leave the flag out: log.jsonl holds the same")  # fmt: skip
    torch.set_num_threads(config.threads)
    with joined(config.device) as ranks:
        model, fresh = starting_model(config)
        directory = _open(config, out, overwrite, ranks)
        if directory is None:
            return out / "model"
        try:
            _run(model, fresh, config, directory, ranks)
        except KeyboardInterrupt:
            if ranks.leads:
                directory.pause()
            raise
    return out / "model"


def _open(config: LearnConfig, out: Path, overwrite: bool, ranks: Ranks) -> store.RunDir | None:
    """The run's folder, locked by the leader; None if a finished result is there and was verified."""
    opened: list[store.RunDir] = []
    asked = {name: value for name, value in to_dict(config).items() if name not in HOW}

    def open_it() -> bool:
        inputs = {"start": mdm_files.digest(config.start)} if config.start else {}
        for number, text in enumerate(config.scenes):
            source = from_log.log_source(text)
            inputs |= {f"scene {number}": store.digest(source.scene), f"fused {number}": store.digest(source.fused)}
        opened.append(store.RunDir.open(out, verb="learn", config=asked, inputs=inputs, overwrite=overwrite))
        if opened[0].complete:
            opened[0].reused()
        return opened[0].complete

    if ranks.leader_does(open_it):
        return None
    return opened[0] if ranks.leads else store.RunDir(out, "learn", "", {}, complete=False)


def _run(model: Model, fresh: set[str], config: LearnConfig, directory: store.RunDir, ranks: Ranks) -> None:
    out = directory.path
    bf16 = choose_bf16(config.precision)
    clips = Path(config.clips) if config.clips else out / "clips"
    rules: LogClipRules | None = None
    asked, kind = config, kind_of(model)
    if config.scenes:
        sources = [from_log.log_source(text) for text in config.scenes]
        rules = learn_clips.log_rules(config, sources, model.config.pixel_multiple, kind.points_alone)
        counts = ranks.leader_does(lambda: learn_clips.make_log_clips(asked, rules, clips))
        config = learn_clips.for_logs(config, rules, *counts)
    making = ranks.leads and not config.scenes
    with learn_clips.MakingClips(config, clips, kind.points_alone) if making else contextlib.nullcontext():
        if "codec" in fresh and isinstance(model, MDM):
            ranks.leader_does(lambda: _train_codec(model, config, directory, clips, bf16))
            _take_codec(model, out, ranks)
            draw_weights(model.net, config.seed, "weights")
        if "refiner" in fresh and isinstance(model, MDM) and model.refiner is not None:
            draw_weights(model.refiner, config.seed, "refiner weights")
            model.refiner.reset()
        model.requires_grad_(False)
        model.trained_part().requires_grad_(True)
        with cached_latents(model.codec, out / "latents") if config.cache_latents else contextlib.nullcontext():
            weights = _train_network(model, config, directory, clips, bf16, ranks)
    ranks.leader_does(lambda: _finish(model, weights, config, asked, directory, clips, bf16, rules))


def _finish(
    model: Model, weights: dict[str, Tensor], config: LearnConfig, asked: LearnConfig, directory: store.RunDir, clips: Path,
    bf16: bool, rules: LogClipRules | None,
) -> None:  # fmt: skip
    """Score and export what was trained."""
    kind = kind_of(model)
    made = kind.rebuilt(model, weights)
    if isinstance(made, MDM) and made.refiner is not None and config.balance:
        made.refiner.take_back(class_weights(clips, min(config.first_cities, 20), config.balance))
    shards = learn_clips.scored_shards(config)
    scores = learn_score.score(made, shards, clips, SampleRequest(config.score_steps, config.seed, bf16=bf16))
    store.write_json(directory.path / "metrics.json", scores)
    facts: dict[str, Any] = {"recipe": to_dict(asked), "held_out": scores}
    if config.start:
        facts["continued_from"] = mdm_files.facts(config.start)
    words = learn_clips.data_words(config, rules)
    kind.save(made, directory.path / "model", kind.card(made, config, scores, words), facts)
    directory.finish({"held_out": scores["average"]})
    log.info(learn_score.table(scores))


def starting_model(config: LearnConfig) -> tuple[Model, set[str]]:
    """The model to train, and which of its parts ("codec", "refiner") have no weights yet.

    With `start` the network is that of the earlier model, with a new refiner where the settings ask for
    one. If the settings do not describe that network but are the defaults, it is taken as it is. Clips may be of another
    size and length than before.

    Raises:
        UsageError: the settings ask for another network than the earlier model has, or for clips that it cannot take.
    """
    wanted = model_config(config)
    if not config.start:
        return MDM(wanted), {"codec", "refiner"}
    if is_published(config.start):
        if not _says_nothing(config):
            raise UsageError("the network of a published-type model cannot be described", where="--start",
                             remedy="leave out widths, blocks, attention, patch and refiner")  # fmt: skip
        return learn_published.starting(config), set()
    before = mdm_files.load(config.start)
    if before.config.window != config.window:
        log.info(f"learn: clips of {config.window} frames; the model to continue from had {before.config.window}")
    now = {"window": config.window, "area_px": wanted.area_px}
    resized = MDM(replace(before.config, **now))
    resized.load_state_dict(before.state_dict())
    if wanted != resized.config and not same_denoiser(resized.config, wanted) and _says_nothing(config):
        log.info("learn: the network is that of the model to continue from")
        wanted = resized.config
    if wanted == resized.config:
        return resized, set()
    grows_refiner = bool(wanted.refine_widths) and before.refiner is None
    return with_refiner(resized, wanted), {"refiner"} if grows_refiner else set()


def _says_nothing(config: LearnConfig) -> bool:
    """Whether the settings leave the network as it is by default."""
    default = LearnConfig(window=config.window, width=config.width, height=config.height)
    return model_config(config) == model_config(default)


def model_config(config: LearnConfig) -> MDMConfig:
    """The network that a learn configuration asks for."""
    return MDMConfig(
        widths=config.widths,
        blocks=config.blocks,
        spatial_attention=config.spatial_attention,
        temporal_attention=config.temporal_attention,
        patch=config.patch,
        window=config.window,
        area_px=config.width * config.height,
        refine_widths=config.refine_widths,
        refine_blocks=config.refine_blocks if config.refine_widths else (),
    )


# codec ----------------------------------------------------------------------------------------------------------------


def _train_codec(model: MDM, config: LearnConfig, run_dir: store.RunDir, folder: Path, bf16: bool) -> None:
    """Fit the linear parts on the first cities, then train the decoder on noisy latents."""
    codec, out = model.codec, run_dir.path / "codec"
    optimizer = torch.optim.AdamW(codec.parameters(), lr=config.codec_lr, betas=(0.9, 0.99), weight_decay=1e-3)
    saved = checkpoint.latest(out)
    start = 0
    if saved is not None:
        codec.load_state_dict(saved.tensors("codec"))
        _load_moments(optimizer, saved.tensors("optimizer"))
        start = saved.step
    else:
        draw_weights(codec, config.seed, "codec weights")
        first = [c for n in range(config.codec_fit_batches) for c in draw_clips(config, folder, n, 8, 1, "codec fit")]
        codec.fit_colour(torch.cat([clip.rgb for clip in first]))
        codec.fit_depth(torch.cat([clip.depth for clip in first]))
    recent: list[dict[str, float]] = []
    with log.task("codec", config.codec_steps, start) as bar:
        for step in range(start, config.codec_steps):
            warm, left = min(1.0, (step + 1) / 50), 1 - step / config.codec_steps
            optimizer.param_groups[0]["lr"] = config.codec_lr * warm * min(1.0, left / 0.6)
            clips = draw_clips(config, folder, step, config.codec_batch, 1, "codec batch")
            with torch.autocast("cpu", torch.bfloat16, enabled=bf16):
                loss, terms = codec_loss(codec, clips, seeds.torch_generator(config.seed, step, "codec noise"))
            terms, _ = agreed(_ALONE, terms, 1, step, "codec")
            optimizer.zero_grad(set_to_none=True)
            loss.backward()
            torch.nn.utils.clip_grad_norm_(codec.parameters(), 1.0)
            optimizer.step()
            recent.append(terms)
            bar.update(" ".join(f"{k} {v:.4f}" for k, v in mean_of(recent[-20:]).items()))
            bar.advance()
            done = step + 1
            if done % 50 == 0 or done == config.codec_steps:
                run_dir.log(codec_step=done, **mean_of(recent))
                recent = []
            if done % 200 == 0 or done == config.codec_steps:
                checkpoint.save(out, done, {"codec": codec.state_dict(), "optimizer": _moments(optimizer)}, {})


def _take_codec(model: MDM, out: Path, ranks: Ranks) -> None:
    """The codec that the leader trained, in every process."""
    saved = newest(out / "codec", ranks)
    if saved is None:
        raise ResourceError("the trained codec is not where the leader wrote it", where=str(out / "codec"),
                            remedy="give an --out on a file system that all processes see")  # fmt: skip
    model.codec.load_state_dict(saved.tensors("codec"))


_ALONE = Ranks(0, 1, torch.device("cpu"))


def codec_loss(codec: PatchCodec, clips: Sequence[Clip], generator: torch.Generator) -> tuple[Tensor, dict[str, float]]:
    """Reconstruction loss of the decoder on latents with a little noise; modalities are left out at random.

    L1 + half squared error and L1 of gradients for colour, L1 for the depth code, cross-entropy for classes.
    """
    rgb, depth, known, ids = (
        torch.cat([getattr(clip, name) for clip in clips]) for name in ("rgb", "depth", "depth_valid", "semantics")
    )
    with torch.no_grad():
        latents = {
            "rgb": codec.encode_rgb(rgb),
            "depth": codec.encode_depth(depth),
            "semantics": codec.encode_semantics(ids),
        }
        amount = 0.15 * torch.rand(len(rgb), 1, 1, 1, generator=generator)
        keep = (torch.rand(3, len(rgb), 1, 1, 1, generator=generator) > 0.15).float()
        noisy = {
            m: (z + amount * torch.randn(z.shape, generator=generator)) * k for (m, z), k in zip(latents.items(), keep)
        }
        target = codec.linear_depth_code(depth)
    out_rgb, out_depth, scores = codec.decode_raw(noisy)  # type: ignore[arg-type]
    part_rgb = losses.image_error((out_rgb - (rgb * 2 - 1)) * keep[0], square=0.5, gradient=0.25)
    part_depth = ((out_depth - target) * keep[1] * known).abs().mean()
    ids = torch.where(keep[2, :, 0] > 0, ids, torch.full_like(ids, 255))
    part_semantics = (
        functional.cross_entropy(scores, ids, ignore_index=255) if bool((ids < 255).any()) else scores.sum() * 0
    )
    loss = part_rgb + part_depth + 0.1 * part_semantics
    terms = {"rgb": part_rgb, "depth": part_depth, "semantics": part_semantics}
    return loss, {k: float(v.detach()) for k, v in terms.items()}


# network --------------------------------------------------------------------------------------------------------------


def learning_rate(config: LearnConfig, step: int) -> float:
    """Linear warm-up, constant, then a linear fall to `last_lr_share` over the last `decay_share` of the steps."""
    warm = min(1.0, (step + 1) / max(1, config.warmup_steps))
    left = (config.steps - step) / max(1.0, config.decay_share * config.steps)
    return config.lr * warm * max(config.last_lr_share, min(1.0, left))


def frames_at(config: LearnConfig, step: int) -> int:
    """Frames per clip: half the window first, the whole window for the last `full_window_share` of the steps."""
    late = step >= (1 - config.full_window_share) * config.steps
    return config.window if late else max(1, config.window // 2)


def freeze(model: Model, what: str) -> int:
    """Let a part of the network keep its weights (see `LearnConfig.frozen`); returns the number of parameters it has.

    Raises:
        UsageError: nothing would be frozen: the network has no such layers.
    """
    if what == "nothing":
        return 0
    if what == "denoiser":
        names = {name for name, _ in model.trained_part().named_parameters() if name.startswith("net.")}
        if not isinstance(model, MDM) or model.refiner is None:
            raise UsageError("without a refiner nothing would be left to train", where="--frozen", got=what)
    else:
        names = model.temporal_parameters("all" if what == "temporal_layers" else "transformers")
    count = 0
    for name, parameter in model.trained_part().named_parameters():
        if name in names:
            parameter.requires_grad_(False)
            count += parameter.numel()
    if not count:
        raise UsageError(
            "there is nothing to freeze", where="--frozen", got=what, expected="a network with such layers"
        )
    log.info(f"learn: {what.replace('_', ' ')} keep their weights ({count:,} parameters)")
    return count


def _begin(model: Model, config: LearnConfig, out: Path, ranks: Ranks) -> tuple[TrainingState, Spread]:
    """Freeze, spread over the processes, make the optimiser, and take up the newest checkpoint."""
    freeze(model, config.frozen)
    model.to(ranks.device)
    trained = model.trained_part()
    trained.train()
    if config.recompute:
        for part in trained.values():
            learn_parallel.recompute(part)
    spread = Spread(model, trained, ranks, config.parallel)
    optimizer = torch.optim.AdamW(
        [p for p in trained.parameters() if p.requires_grad], lr=config.lr, betas=(config.beta1, config.beta2),
        weight_decay=config.weight_decay, fused=True,
    )  # fmt: skip
    average = None
    if config.average_decay:
        average = {k: learn_parallel.local(v).detach().clone() for k, v in trained.state_dict().items()}
    state = TrainingState(trained, optimizer, average)
    saved = newest(out, ranks)
    if saved is not None:
        ranks.all_do(lambda: state.load(saved.path))
        state.step = saved.step
        log.info(f"learn: continues at step {saved.step}")
    if ranks.size > 1:
        log.info(f"learn: {ranks.size} processes, {config.parallel}")
    return state, spread


def _train_network(
    model: Model, config: LearnConfig, run_dir: store.RunDir, folder: Path, bf16: bool, ranks: Ranks
) -> dict[str, Tensor]:
    """Train what the model names; returns the weights to use (the moving average), whole, in the leader."""
    out = run_dir.path / "steps"
    state, spread = _begin(model, config, out, ranks)
    weights = class_weights(folder, min(config.first_cities, 20), config.balance).to(ranks.device)
    settings = LossSettings(weights, config.refined_share, config.reference_dropout)
    board = _Board(run_dir.path / "tensorboard") if config.tensorboard and ranks.leads else None
    facts = {"seed": config.seed, "layout": config.parallel}
    kind = kind_of(model)
    drawn = replace(config, reference_dropout=0.0) if kind.drops_reference else config
    recent: list[dict[str, float]] = []
    begun, clock, saved_at = state.step, time.monotonic(), state.step
    with log.task("network", config.steps, begun) as bar, Interruption() as interruption:
        for step in range(begun, config.steps):
            for group in state.optimizer.param_groups:
                group["lr"] = learning_rate(config, step)
            frames = frames_at(config, step)
            count = max(1, config.batch_frames // frames)
            parts = ranks.share(count, config.accumulate)
            terms: dict[str, float] = {}
            state.optimizer.zero_grad(set_to_none=True)
            for part in parts:
                clips = draw_clips(drawn, folder, step, count, frames, "batch", part)
                clips = [clip.to(ranks.device) for clip in clips]
                with spread.portion(last=part is parts[-1]):
                    with torch.autocast(ranks.device.type, torch.bfloat16, enabled=bf16):
                        loss = spread.network(clips, BatchPart(config.seed, step, part.start, count), settings)
                    (loss.total / len(parts)).backward()
                for name, value in {**loss.terms, "total": float(loss.total.detach())}.items():
                    terms[name] = terms.get(name, 0.0) + value
            terms, stop = agreed(ranks, terms, len(parts), step, "network", stop=interruption.asked)
            norm = learn_parallel.clip_gradients(state.trained, config.clip_norm)
            agreed(ranks, {"gradient norm": norm}, 1, step, "network")
            state.optimizer.step()
            state.step = done = step + 1
            state.blend(config.average_decay)
            recent.append({**terms, "gradient_norm": norm})
            rate = (done - begun) / (time.monotonic() - clock)
            bar.update(f"loss {mean_of(recent[-25:])['total']:.4f}  {rate:.2f} steps/s")
            bar.advance()
            last = done == config.steps
            if done % config.log_every == 0 or last:
                if ranks.leads:
                    _write_down(run_dir, board, done, {"frames": frames, "rate": round(rate, 3), **mean_of(recent)})
                recent = []
            if done % config.checkpoint_every == 0 or last or stop:
                state.save(out, ranks, facts)
                saved_at = done
            if done % config.sample_every == 0 or last:
                shown = state.shown(ranks)
                ranks.leader_does(lambda: _look(kind.rebuilt(model, shown), config, run_dir, folder, done, bf16))  # noqa: B023
            if stop and not last:
                log.info(f"learn: stopped after step {saved_at}, which is saved")
                interruption.end()
    if board is not None:
        board.close()
    return state.shown(ranks)


def _write_down(run_dir: store.RunDir, board: _Board | None, step: int, values: dict[str, float]) -> None:
    run_dir.log(step=step, **values)
    learn_score.plot_losses(run_dir.path / "log.jsonl", run_dir.path / "loss.png")
    if board is not None:
        board.add(step, values)


class _Board:
    """Losses for TensorBoard."""

    def __init__(self, folder: Path) -> None:
        from torch.utils.tensorboard import SummaryWriter

        self._writer = SummaryWriter(str(folder))

    def add(self, step: int, values: dict[str, float]) -> None:
        for name, value in values.items():
            self._writer.add_scalar(f"learn/{name}", value, step)

    def close(self) -> None:
        self._writer.close()


def _look(shown: Model, config: LearnConfig, run_dir: store.RunDir, folder: Path, step: int, bf16: bool) -> None:
    """Score a model on a few held-out clips and draw a grid of what it makes."""
    scores = learn_score.score(
        shown, learn_clips.scored_shards(config)[: config.watched], folder, SampleRequest(config.sample_steps, config.seed, bf16=bf16),
        picture=run_dir.path / "samples" / f"{step:07d}.png",
    )  # fmt: skip
    run_dir.log(step=step, held_out=scores["average"])
    log.info(f"step {step}\n{learn_score.table(scores)}")


def draw_weights(net: torch.nn.Module, seed: int, purpose: str) -> None:
    """Draw all weights that are not zero at the start from the run's seed (the constructor's own draw is not used)."""
    generator = seeds.torch_generator(seed, 0, purpose)
    with torch.no_grad():
        for name, value in net.named_parameters():
            if value.ndim >= 2 and bool(value.any()):
                fan_in = math.prod(value.shape[1:])
                gain = 2.0 if "conv1" in name else 1.0
                value.copy_(torch.randn(value.shape, generator=generator) * math.sqrt(gain / fan_in))
            elif value.ndim == 1 and name.endswith("bias"):
                value.zero_()


def _moments(optimizer: torch.optim.Optimizer) -> dict[str, Tensor]:
    """State of AdamW as flat named tensors."""
    found: dict[str, Tensor] = {}
    for index, parameter in enumerate(optimizer.param_groups[0]["params"]):
        for name, value in optimizer.state.get(parameter, {}).items():
            found[f"{index}.{name}"] = torch.as_tensor(value)
    return found


def _load_moments(optimizer: torch.optim.Optimizer, moments: dict[str, Tensor]) -> None:
    for index, parameter in enumerate(optimizer.param_groups[0]["params"]):
        own = {n.split(".", 1)[1]: v for n, v in moments.items() if n.split(".", 1)[0] == str(index)}
        for name, value in own.items():
            if name != "step":
                own[name] = value.to(memory_format=_format_of(parameter))
        optimizer.state[parameter] = own


def _format_of(tensor: Tensor) -> torch.memory_format:
    channels_last = tensor.ndim == 4 and tensor.is_contiguous(memory_format=torch.channels_last)
    return torch.channels_last if channels_last else torch.contiguous_format
