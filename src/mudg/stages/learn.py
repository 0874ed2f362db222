"""learn: train the small multi-modal diffusion model on generated cities.

Read from `run`: make the clips, fit and train the latent codec, train the denoising network, score, export. Both training
loops are in full view in `_train_codec` and `_train_network`. Every draw is a function of (seed, step), so a run that was
interrupted and continued equals one that was not, bit for bit at a fixed number of threads.

OUT/clips/    one shard per city (or the folder `clips` of the configuration)
OUT/codec/    checkpoints of the codec         OUT/steps/   checkpoints of the network, its moving average, the optimiser
OUT/samples/  picture grids during training    OUT/loss.png, OUT/log.jsonl
OUT/model/    the exported model: fp16 weights, model.json, MODEL_CARD.md
"""

from __future__ import annotations

import concurrent.futures
import math
import multiprocessing
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from mudg.base import checkpoint, log, seeds, store
from mudg.base.config import to_dict
from mudg.base.errors import NumericsError, ResourceError
from mudg.data import city_clips, clip_shards
from mudg.data.clip_shards import Batch
from mudg.models import mdm
from mudg.models.mdm import MDM, MDMConfig
from mudg.models.vae import PatchCodec
from mudg.stages import learn_score
from mudg.stages.config import LearnConfig
from mudg.stages.precision import choose_bf16

HELD_OUT = 1_000_000
"""City numbers from here on are never trained on."""


def run(config: LearnConfig, out: Path, *, overwrite: bool = False) -> Path:
    """Train a model, from nothing or from an earlier one; returns the folder of the exported model (`OUT/model`).

    Raises:
        NumericsError: a loss or gradient is not finite (names the term and the step; parameters are untouched).
        ResourceError, UsageError: see `RunDir.open`.
    """
    before = mdm.load(config.start) if config.start else None
    model = MDM(model_config(config)) if before is None else mdm.grown(before, model_config(config))
    inputs = {"start": mdm.digest(config.start)} if config.start else {}
    directory = store.RunDir.open(out, verb="learn", config=to_dict(config), inputs=inputs, overwrite=overwrite)
    if directory.complete:
        return directory.reused() / "model"
    bf16 = choose_bf16(config.precision)
    torch.set_num_threads(config.threads)
    clips = Path(config.clips) if config.clips else out / "clips"
    with _making_clips(config, clips):
        if before is None:
            _train_codec(model, config, directory, clips, bf16)
            draw_weights(model.net, config.seed, "weights")
        if model.refiner is not None and (before is None or before.refiner is None):
            draw_weights(model.refiner, config.seed, "refiner weights")
            model.refiner.reset()
        model.codec.requires_grad_(False)
        _train_network(model, config, directory, clips, bf16)
    scores = learn_score.score(model, held_out(config), clips, steps=config.score_steps, seed=config.seed, bf16=bf16)
    store.write_json(out / "metrics.json", scores)
    facts = {"recipe": to_dict(config), "held_out": scores}
    if config.start:
        facts["continued_from"] = mdm.facts(config.start)
    mdm.save(model, out / "model", learn_score.model_card(model, config, scores), facts)
    directory.finish({"held_out": scores["average"]})
    log.info(learn_score.table(scores))
    return out / "model"


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


# clips ----------------------------------------------------------------------------------------------------------------


def held_out(config: LearnConfig) -> list[int]:
    """City numbers used for scoring only."""
    return [HELD_OUT + n for n in range(config.held_out)]


def cities_at(config: LearnConfig, step: int) -> int:
    """How many cities training may draw from at `step`: `first_cities`, then linearly up to `cities` at half time.

    A function of the step alone, so that clips can still be in the making while training runs and the draw stays the
    same in every run.
    """
    share = min(1.0, step / max(1.0, config.all_cities_at * config.steps))
    return min(config.cities, config.first_cities + int((config.cities - config.first_cities) * share))


def clip_rules(config: LearnConfig) -> city_clips.CityClipRules:
    """What the generator is asked for."""
    return city_clips.CityClipRules(
        width=config.width, height=config.height, window=config.window, seed=config.seed, clips=config.clips_per_city
    )


class _making_clips:
    """Processes that make the missing clips, held-out cities first, while the block runs."""

    def __init__(self, config: LearnConfig, folder: Path) -> None:
        self._rules, self._folder = clip_rules(config), folder
        wanted = [*held_out(config), *range(config.cities)]
        self._missing = [n for n in wanted if not clip_shards.shard_path(folder, n).is_file()]
        self._workers = config.workers
        self._pool: concurrent.futures.ProcessPoolExecutor | None = None
        self._futures: list[concurrent.futures.Future[int]] = []

    def __enter__(self) -> None:
        if not self._missing or self._workers == 0:
            return
        log.info(f"learn: {len(self._missing)} cities to generate into {self._folder}, {self._workers} processes")
        context = multiprocessing.get_context("spawn")
        self._pool = concurrent.futures.ProcessPoolExecutor(self._workers, mp_context=context)
        self._futures = [self._pool.submit(city_clips.write_city, self._rules, n, self._folder) for n in self._missing]
        for future in self._futures:
            future.add_done_callback(_stop_all_on_error(self._futures))

    def __exit__(self, *_: object) -> None:
        if self._pool is not None:
            self._pool.shutdown(wait=True, cancel_futures=True)
        for future in self._futures:
            if not future.cancelled() and future.exception() is not None:
                raise future.exception()  # type: ignore[misc]


def _stop_all_on_error(futures: list[concurrent.futures.Future[int]]):
    def stop(done: concurrent.futures.Future[int]) -> None:
        if not done.cancelled() and done.exception() is not None:
            for other in futures:
                other.cancel()

    return stop


def _await_shard(folder: Path, city: int, patience_s: float = 900.0) -> None:
    """Wait until a shard is there (it is being made by another process)."""
    path = clip_shards.shard_path(folder, city)
    started = time.monotonic()
    while not path.is_file():
        if time.monotonic() - started > patience_s:
            raise ResourceError("training clips are not arriving", where=str(path), expected=f"within {patience_s:.0f} s",
                                remedy="look for an error of the generating processes above")  # fmt: skip
        time.sleep(0.5)


def draw_batch(config: LearnConfig, folder: Path, step: int, count: int, frames: int, purpose: str) -> Batch:
    """The batch of a step: random cities, clips and runs of consecutive frames, varied (see `clip_shards.vary`)."""
    rng = seeds.numpy_rng(config.seed, step, purpose)
    picks = []
    for _ in range(count):
        city = int(rng.integers(cities_at(config, step)))
        _await_shard(folder, city)
        clip = int(rng.integers(clip_shards.clips_in(folder, city)))
        start = int(rng.integers(config.window - frames + 1))
        picks.append((city, clip, range(start, start + frames)))
    return clip_shards.vary(clip_shards.read_batch(folder, picks), rng)


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
        first = [draw_batch(config, folder, n, 8, 1, "codec fit") for n in range(config.codec_fit_batches)]
        codec.fit_colour(torch.cat([b.rgb.flatten(0, 1) for b in first]))
        codec.fit_depth(torch.cat([b.depth.flatten(0, 1) for b in first]))
    recent: list[dict[str, float]] = []
    with log.task("codec", config.codec_steps, start) as bar:
        for step in range(start, config.codec_steps):
            warm, left = min(1.0, (step + 1) / 50), 1 - step / config.codec_steps
            optimizer.param_groups[0]["lr"] = config.codec_lr * warm * min(1.0, left / 0.6)
            batch = draw_batch(config, folder, step, config.codec_batch, 1, "codec batch")
            with torch.autocast("cpu", torch.bfloat16, enabled=bf16):
                loss, terms = codec_loss(codec, batch, seeds.torch_generator(config.seed, step, "codec noise"))
            _check_finite(terms, step, "codec")
            optimizer.zero_grad(set_to_none=True)
            loss.backward()
            torch.nn.utils.clip_grad_norm_(codec.parameters(), 1.0)
            optimizer.step()
            recent.append(terms)
            bar.update(" ".join(f"{k} {v:.4f}" for k, v in _mean(recent[-20:]).items()))
            bar.advance()
            done = step + 1
            if done % 50 == 0 or done == config.codec_steps:
                run_dir.log(codec_step=done, **_mean(recent))
                recent = []
            if done % 200 == 0 or done == config.codec_steps:
                checkpoint.save(out, done, {"codec": codec.state_dict(), "optimizer": _moments(optimizer)}, {})


def codec_loss(codec: PatchCodec, batch: Batch, generator: torch.Generator) -> tuple[Tensor, dict[str, float]]:
    """Reconstruction loss of the decoder on latents with a little noise; modalities are left out at random.

    L1 + half squared error and L1 of gradients for colour, L1 for the depth code, cross-entropy for classes.
    """
    rgb, depth, ids = batch.rgb.flatten(0, 1), batch.depth.flatten(0, 1), batch.semantics.flatten(0, 1)
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
    error = (out_rgb - (rgb * 2 - 1)) * keep[0]
    gradient = (error[..., 1:] - error[..., :-1]).abs().mean() + (error[..., 1:, :] - error[..., :-1, :]).abs().mean()
    part_rgb = error.abs().mean() + 0.5 * error.square().mean() + 0.25 * gradient
    part_depth = ((out_depth - target) * keep[1]).abs().mean()
    ids = torch.where(keep[2, :, 0] > 0, ids, torch.full_like(ids, 255))
    part_semantics = (
        functional.cross_entropy(scores, ids, ignore_index=255) if bool((ids < 255).any()) else scores.sum() * 0
    )
    loss = part_rgb + part_depth + 0.1 * part_semantics
    terms = {"rgb": part_rgb, "depth": part_depth, "semantics": part_semantics}
    return loss, {k: float(v.detach()) for k, v in terms.items()}


# network --------------------------------------------------------------------------------------------------------------


def learning_rate(config: LearnConfig, step: int) -> float:
    """Linear warm-up, constant, then a linear fall to 2 % over the last `decay_share` of the steps."""
    warm = min(1.0, (step + 1) / max(1, config.warmup_steps))
    left = (config.steps - step) / max(1.0, config.decay_share * config.steps)
    return config.lr * warm * max(0.02, min(1.0, left))


def frames_at(config: LearnConfig, step: int) -> int:
    """Frames per clip: half the window first, the whole window for the last `full_window_share` of the steps."""
    late = step >= (1 - config.full_window_share) * config.steps
    return config.window if late else max(1, config.window // 2)


def _train_network(model: MDM, config: LearnConfig, run_dir: store.RunDir, folder: Path, bf16: bool) -> None:
    """Train denoiser and refiner; on return the model holds the moving average of the weights."""
    net, out = trained_part(model), run_dir.path / "steps"
    average = {k: v.detach().clone() for k, v in net.state_dict().items()}
    optimizer = torch.optim.AdamW(net.parameters(), lr=config.lr, betas=(0.9, 0.99), weight_decay=0.01, fused=True)
    saved = checkpoint.latest(out)
    start = 0
    if saved is not None:
        net.load_state_dict(saved.tensors("net"))
        average = saved.tensors("average")
        _load_moments(optimizer, saved.tensors("optimizer"))
        start = saved.step
        log.info(f"learn: continues at step {start}")
    net.train()
    weights = class_weights(folder, min(config.first_cities, 20), config.balance)
    recent: list[dict[str, float]] = []
    clock = time.monotonic()
    with log.task("network", config.steps, start) as bar:
        for step in range(start, config.steps):
            optimizer.param_groups[0]["lr"] = learning_rate(config, step)
            frames = frames_at(config, step)
            count = max(1, config.batch_frames // frames)
            batch = draw_batch(config, folder, step, count, frames, "batch")
            with torch.no_grad():
                truth = model.encode_truth(batch.rgb, batch.depth, batch.semantics)
                shares = mdm.truth_shares(batch.semantics)
                encoded = model.encode_planes(batch.color, batch.sparse_depth, batch.valid, batch.warped, batch.backdrop,
                                              batch.reference, batch.ids, batch.backdrop_ids)  # fmt: skip
                pixels = model.pixel_truth(batch.rgb, batch.depth, batch.semantics)
            with torch.autocast("cpu", torch.bfloat16, enabled=bf16):
                losses = model.loss(truth, encoded, seeds.torch_generator(config.seed, step, "noise"), shares=shares,
                                    class_weights=weights, pixels=pixels, window=refined_window(config, model, step))  # fmt: skip
            _check_finite(losses.terms, step, "network")
            optimizer.zero_grad(set_to_none=True)
            losses.total.backward()
            norm = float(torch.nn.utils.clip_grad_norm_(net.parameters(), 1.0))
            _check_finite({"gradient norm": norm}, step, "network")
            optimizer.step()
            keep = min(config.average_decay, (step + 1) / (step + 10))
            _blend(average, net.state_dict(), keep)
            recent.append({**losses.terms, "total": float(losses.total.detach()), "gradient_norm": norm})
            rate = (step + 1 - start) / (time.monotonic() - clock)
            bar.update(f"loss {_mean(recent[-25:])['total']:.4f}  {rate:.2f} steps/s")
            bar.advance()
            done = step + 1
            if done % 50 == 0 or done == config.steps:
                run_dir.log(step=done, frames=frames, rate=round(rate, 3), **_mean(recent))
                recent = []
                learn_score.plot_losses(run_dir.path / "log.jsonl", run_dir.path / "loss.png")
            if done % config.checkpoint_every == 0 or done == config.steps:
                groups = {"net": net.state_dict(), "average": average, "optimizer": _moments(optimizer)}
                checkpoint.save(out, done, groups, {"seed": config.seed})
            if done % config.sample_every == 0 or done == config.steps:
                _look(model, average, config, run_dir, folder, done, bf16)
    net.load_state_dict(average)
    net.eval()


def trained_part(model: MDM) -> torch.nn.ModuleDict:
    """What the second part of training changes: the denoiser and, if there is one, the refiner."""
    return torch.nn.ModuleDict({"net": model.net} | ({} if model.refiner is None else {"refiner": model.refiner}))


def refined_window(config: LearnConfig, model: MDM, step: int) -> tuple[slice, slice]:
    """Rectangle of latent cells on which the refiner is trained at `step`: a share of each side, anywhere."""
    rng = seeds.numpy_rng(config.seed, step, "refined window")
    spans = []
    for side in (config.height, config.width):
        cells = side // model.codec.factor
        size = min(cells, max(8, round(cells * config.refined_share / 8) * 8))
        start = 2 * int(rng.integers((cells - size) // 2 + 1))
        spans.append(slice(start, start + size))
    return spans[0], spans[1]


def class_weights(folder: Path, cities: int, balance: float) -> Tensor:
    """Weights f32[19] of the classes in the semantic loss: share^-balance, counted over the first cities.

    Scaled so that the mean over labelled pixels is 1; a class that never occurs weighs as much as the rarest that does.
    """
    counts = torch.zeros(256, dtype=torch.float64)
    for city in range(cities):
        _await_shard(folder, city)
        ids = clip_shards.read_batch(folder, [(city, 0, range(1))]).semantics
        counts += torch.bincount(ids.flatten(), minlength=256)
    share = counts[: mdm.CLASSES] / counts[: mdm.CLASSES].sum().clamp(min=1)
    floor = max(float(share[share > 0].min()) if bool((share > 0).any()) else 1.0, 1e-3)
    weight = share.clamp(min=floor) ** -balance
    return (weight / (weight * share).sum().clamp(min=1e-9)).float()


def _look(
    model: MDM,
    average: dict[str, Tensor],
    config: LearnConfig,
    run_dir: store.RunDir,
    folder: Path,
    step: int,
    bf16: bool,
) -> None:
    """Score the moving average on a few held-out clips and draw a grid of what it makes."""
    shown = MDM(model.config)
    shown.codec.load_state_dict(model.codec.state_dict())
    trained_part(shown).load_state_dict(average)
    shown.eval()
    scores = learn_score.score(
        shown, held_out(config)[: config.watched], folder, steps=config.sample_steps, seed=config.seed, bf16=bf16,
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


def _check_finite(terms: dict[str, float], step: int, what: str) -> None:
    for name, value in terms.items():
        if not math.isfinite(value):
            raise NumericsError(
                f"the {name} term of the {what} is not finite",
                where=f"learn, step {step}",
                got=str(value),
                remedy="continue from the last checkpoint with a lower learning rate",
            )


def _blend(average: dict[str, Tensor], current: dict[str, Tensor], keep: float) -> None:
    with torch.no_grad():
        torch._foreach_lerp_(list(average.values()), [current[k] for k in average], 1.0 - keep)


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


def _mean(terms: list[dict[str, float]]) -> dict[str, float]:
    return {k: round(float(np.mean([t[k] for t in terms])), 6) for k in terms[0]} if terms else {}


def batches(config: LearnConfig, folder: Path, steps: range) -> Iterator[Batch]:
    """The batches of some steps, for looking at the data."""
    for step in steps:
        yield draw_batch(config, folder, step, max(1, config.batch_frames // config.window), config.window, "batch")
