"""The models that `learn` can train, what is particular to each, and with which weights a training starts.

Both have what the loop uses: `loss(clips, part)`, also as `forward`, `trained_part()`, and
`temporal_parameters(which)`, those that a later stage may freeze.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from mudg.base import html, log, palette, seeds, store
from mudg.base.errors import UsageError
from mudg.base.run_folder import RunDir
from mudg.base.types import Clip
from mudg.core import losses, metrics
from mudg.core.metrics import TrueFrame, flicker
from mudg.core.pictures import class_colors, depth_colors, gray, to_bytes
from mudg.diffusion import model_files
from mudg.diffusion.clips import FAR_M, Shards, TrainingClips, counts_at
from mudg.diffusion.condition import filled_depth
from mudg.diffusion.model import MDM
from mudg.diffusion.model_files import Model, generated
from mudg.diffusion.network import MDMConfig
from mudg.diffusion.parallel import Ranks, TrainingState, agreed_terms, mean_of
from mudg.diffusion.published import PublishedMDM, WorkSplit
from mudg.diffusion.requests import GeneratedClip, SampleRequest
from mudg.diffusion.settings import LearnConfig
from mudg.networks.codec import Modality, PatchCodec

PATCH = 2
"""Side of the squares of latent pixels that the network processes as one cell."""


def rebuilt(model: Model, weights: Mapping[str, Tensor]) -> Model:
    """A model where it was trained, ready for use, whose trained part has these weights. A published-type one shares
    memory with what it is made of: it is large, and scoring it on a CPU would take longer than training it on a GPU."""
    fixed = {name: value for name, value in model.state_dict().items() if name not in weights}
    if isinstance(model, MDM):
        made = MDM(model.config)
        made.load_state_dict({**fixed, **weights})
        return made.to(model.device).eval()
    with torch.device("meta"):
        made = PublishedMDM(model.config)
    made.load_state_dict({**fixed, **{n: value.to(model.device) for n, value in weights.items()}}, assign=True)
    made.requires_grad_(False)
    made.adopt_scale()
    made.split = model.split
    return made.eval()


def save(model: Model, folder: Path, card: str, facts: Mapping[str, Any]) -> None:
    """Write the folder that `synthesize --model` and a further `learn --start` read. Published-type weights are in
    float32; the terms of the model that was continued from are handed on."""
    if isinstance(model, MDM):
        model_files.save(model, folder, card, facts)
        return
    before = facts.get("continued_from", {})
    handed_on = {name: before[name] for name in ("licence", "caption", "base_scale") if name in before}
    licence = f"\n## Licence\n\n{handed_on['licence']}\n" if "licence" in handed_on else ""
    tensors = {name: value.cpu() for name, value in model.state_dict().items()}
    model_files.save_published(folder, model.config, tensors, {**facts, **handed_on}, card + licence)


def model_card(model: Model, source: TrainingClips, scores: Mapping[str, Any]) -> str:
    """Text that travels with the weights: what the model is, how it was made, what it can and cannot do."""
    config, (width, height) = source.config, source.size
    small = isinstance(model, MDM)
    own: dict[str, Any] = {"window": model.config.window}
    if small:
        own = {"refines": model.refiner is not None, "parameters": sum(p.numel() for p in model.parameters())}
    return html.render_text(
        "mdm_card.md.j2" if small else "published_card.md.j2",
        data=source.about,
        width=width,
        height=height,
        config=config,
        clips=config.data,
        rules=config.optimizer,
        scores=scores,
        table=table(scores),
        **own,
    )


# start --------------------------------------------------------------------------------------------


def starting_model(config: LearnConfig) -> tuple[Model, set[str]]:
    """The model to train, and which of its parts ("codec", "refiner", "finisher") have no weights yet. With `start` the
    network is that of the earlier model, extended by a refiner, a finisher and inputs for renders where the settings
    ask for them. If the settings do not describe that network but are the defaults, it is taken as it is. Clips may be
    of another size and length than before. Inputs for renders and a finisher are learned from generated cities with
    renders; from other clips no model gets any that it does not have. UsageError: the settings ask for another network
    than the earlier model has, or for clips that it cannot take."""
    wanted = model_config(config)
    usual = wanted == model_config(LearnConfig(data=config.data))  # the network is left as it is by default
    can_grow = config.data.renders and not config.data.scenes
    if not config.start:
        wanted = wanted if can_grow else replace(wanted, renders=False, finish_widths=(), finish_blocks=())
        return MDM(wanted), {"codec", "refiner", "finisher"}
    if model_files.is_published(config.start):
        if not usual:
            what = "the shape of a published-type network cannot be changed"
            raise UsageError(what, where="--start", remedy="leave out the settings of the group network")
        model = model_files.load_published(config.start, dtype=torch.float32)
        frames = model.config.window
        if config.data.window != frames or config.optimizer.full_window_share < 1:
            raise UsageError(
                "a published-type model needs clips of exactly the length of its image tokens",
                where="--data.window, --optimizer.full-window-share",
                expected=f"{frames} frames in all steps",
                got=f"{config.data.window} frames in {config.optimizer.full_window_share:.0%} of the steps",
                remedy=f"--data.window {frames} --optimizer.full-window-share 1",
            )
        model.check_clip(frames, config.data.height, config.data.width)
        with torch.no_grad():  # out of the mapped files: training writes in place
            for value in (*model.parameters(), *model.buffers()):
                value.data = value.data.clone()
        model.config = replace(model.config, width=config.data.width, height=config.data.height)
        model.split = WorkSplit(frames_at_once=1)
        return model, set()
    before = model_files.load(config.start)
    if before.config.window != config.data.window:
        log.info(
            f"learn: training on clips of {config.data.window} frames; --start was trained on clips of"
            f" {before.config.window}"
        )
    if not can_grow:
        own = {name: getattr(before.config, name) for name in ("renders", "finish_widths", "finish_blocks")}
        wanted = replace(wanted, **own)
    resized = replace(before.config, window=wanted.window, area_px=wanted.area_px)
    if wanted != resized and not same_denoiser(resized, wanted) and usual:
        log.info("learn: the network has the shape of --start")
        wanted = resized
    grown = {name for name, had in (("refiner", before.refiner), ("finisher", before.finisher)) if had is None}
    return extended(before, wanted), set() if wanted == resized else grown


def hold_finisher(model: Model, fresh: set[str], patches: bool) -> None:
    """Let the finisher keep its weights if the clips have no patches at a higher resolution to learn it from.
    UsageError: it has no weights yet."""
    if patches or not isinstance(model, MDM) or model.finisher is None:
        return
    if "finisher" in fresh:
        what = "the training clips have no patches at a higher resolution, from which the finisher is learned"
        raise UsageError(what, where="--data.clips", remedy="choose another folder, or give --data.no-renders")
    model.finisher.requires_grad_(False)
    log.info("learn: the clips have no patches at a higher resolution; the finisher keeps its weights")


def model_config(config: LearnConfig) -> MDMConfig:
    """The network that a learn configuration asks for."""
    shape = asdict(config.network)
    shape["refine_blocks"] = shape["refine_blocks"] if shape["refine_widths"] else ()
    if not (shape["finish_widths"] and shape["refine_widths"] and shape["renders"]):
        shape["finish_widths"] = shape["finish_blocks"] = ()
    return MDMConfig(**shape, patch=PATCH, window=config.data.window, area_px=config.data.width * config.data.height)


def freeze(model: Model, what: str) -> int:
    """Let a part of the network keep its weights (see `LearnConfig.frozen`); returns the number of parameters it has.
    UsageError: nothing would be frozen: the network has no such layers."""
    if what == "nothing":
        return 0
    if what == "denoiser":
        names = {name for name, _ in model.trained_part().named_parameters() if name.startswith("net.")}
        if not isinstance(model, MDM) or model.refiner is None:
            raise UsageError("without a refiner nothing is left to train", where="--frozen", got=what)
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
    log.info(f"learn: {what.replace('_', ' ')} are frozen ({count:,} parameters)")
    return count


def draw_weights(net: nn.Module, seed: int, purpose: str) -> None:
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


# training of the small model's latent codec, before the network: by the leader alone, on whole images -----------------


LEARNING_RATE = 2e-3
FIT_IMAGES = 8


def train_codec(codec: PatchCodec, source: TrainingClips, run_dir: RunDir, bf16: bool, device: torch.device) -> None:
    """Fit the linear parts on the first clips, on the CPU, then train the decoder on noisy latents, on a device."""
    config = source.config
    steps, out, alone = config.codec.steps, run_dir.path / "codec", Ranks(0, 1, device)
    codec.to(device)
    optimizer = torch.optim.AdamW(codec.parameters(), lr=LEARNING_RATE, betas=(0.9, 0.99), weight_decay=1e-3)
    state = TrainingState(nn.ModuleDict({"codec": codec}), optimizer, None)
    if not state.resume(out, alone):
        fitted = PatchCodec(codec.config)
        draw_weights(fitted, config.seed, "codec weights")
        batches = [source.draw(n, FIT_IMAGES, 1, "codec fit") for n in range(config.codec.fit_batches)]
        images = [clip for batch in batches for clip in batch]
        height, width = (min(clip.rgb.shape[axis] for clip in images) for axis in (-2, -1))  # steps may differ in size
        fitted.fit_color(torch.cat([clip.rgb[..., :height, :width] for clip in images]))
        fitted.fit_depth(torch.cat([clip.depth[..., :height, :width] for clip in images]))
        codec.load_state_dict(fitted.state_dict())
    recent: list[dict[str, float]] = []
    with log.task("codec", steps, state.step) as bar:
        for step in range(state.step, steps):
            warm, left = min(1.0, (step + 1) / 50), 1 - step / steps
            optimizer.param_groups[0]["lr"] = LEARNING_RATE * warm * min(1.0, left / 0.6)
            clips = [clip.to(device) for clip in source.draw(step, config.codec.batch, 1, "codec batch")]
            with torch.autocast(device.type, torch.bfloat16, enabled=bf16):
                loss, terms = codec_loss(codec, clips, seeds.torch_generator(config.seed, step, "codec noise"))
            terms, _ = agreed_terms(alone, terms, 1, step, "codec")
            optimizer.zero_grad(set_to_none=True)
            loss.backward()
            torch.nn.utils.clip_grad_norm_(codec.parameters(), 1.0)
            optimizer.step()
            recent.append(terms)
            bar.update(" ".join(f"{k} {v:.4f}" for k, v in mean_of(recent[-20:]).items()))
            bar.advance()
            state.step = done = step + 1
            if done % 50 == 0 or done == steps:
                run_dir.log(codec_step=done, **mean_of(recent))
                recent = []
            if done % 200 == 0 or done == steps:
                state.save(out, alone, {})


def codec_loss(codec: PatchCodec, clips: Sequence[Clip], generator: torch.Generator) -> tuple[Tensor, dict[str, float]]:
    """Reconstruction loss of the decoder on latents with a little noise, drawn on the CPU; modalities are left out at
    random. L1 + half squared error and L1 of gradients for colour, L1 for the depth code, cross-entropy for classes."""
    rgb, depth, known, ids = (
        torch.cat([getattr(clip, name) for clip in clips]) for name in ("rgb", "depth", "depth_weight", "semantics")
    )
    with torch.no_grad():
        latents: dict[Modality, Tensor] = {
            "rgb": codec.encode_rgb(rgb),
            "depth": codec.encode_depth(depth),
            "semantics": codec.encode_semantics(ids),
        }
        amount = 0.15 * torch.rand(len(rgb), 1, 1, 1, generator=generator).to(rgb.device)
        keep = (torch.rand(3, len(rgb), 1, 1, 1, generator=generator) > 0.15).float().to(rgb.device)
        noisy: dict[Modality, Tensor] = {
            m: (z + amount * torch.randn(z.shape, generator=generator).to(z.device)) * k
            for (m, z), k in zip(latents.items(), keep)
        }
        target = codec.linear_depth_code(depth)
    made_rgb, made_depth, scores = codec.decode_raw(noisy)
    ids = torch.where(keep[2, :, 0] > 0, ids, palette.UNLABELLED)
    labelled = bool((ids < palette.UNLABELLED).any())
    parts = {
        "rgb": losses.image_error((made_rgb - (rgb * 2 - 1)) * keep[0], square=0.5, gradient=0.25),
        "depth": ((made_depth - target) * keep[1] * known).abs().mean(),
        "semantics": (
            functional.cross_entropy(scores, ids, ignore_index=palette.UNLABELLED) if labelled else scores.sum() * 0
        ),
    }
    loss = parts["rgb"] + parts["depth"] + 0.1 * parts["semantics"]
    return loss, {name: float(part.detach()) for name, part in parts.items()}


# models that go on from an earlier, plainer one ---------------------------------------------------


_WIDENED = ("net.enter", "refiner.enter", "net.leave", "refiner.leave")
"""Layers that have further inputs or outputs, behind the others, in a model that uses renders."""


def same_denoiser(one: MDMConfig, other: MDMConfig) -> bool:
    """Whether two networks differ at most in what follows the denoiser, in the use of renders, and in the clips trained
    on."""
    after = {"refine_widths": (), "refine_blocks": (), "finish_widths": (), "finish_blocks": ()}
    without = lambda config: replace(config, **after, renders=False, area_px=0, window=0)
    return without(one) == without(other)


def extended(before: MDM, config: MDMConfig) -> MDM:
    """A model of `config` with the weights of `before`; a refiner is taken over if `before` has one of the same shape.
    For continuing the training of an earlier, plainer model. What new inputs weigh is 0, so they change nothing at
    first. UsageError: the two differ in more than the refiner, the use of renders and the clips trained on."""
    if not same_denoiser(before.config, config) or (before.config.renders and not config.renders):
        remedy, got = "give its widths, blocks, attention, patch and renders", str(before.config)
        raise UsageError("the model to continue from is of another kind", expected=str(config), got=got, remedy=remedy)
    model = MDM(config)
    state = model.state_dict()
    for name, old in before.state_dict().items():
        if name in state and state[name].shape == old.shape:
            state[name] = old
        elif name in state and name.removesuffix(".weight").removesuffix(".bias") in _WIDENED:
            larger = torch.zeros_like(state[name]) if name.startswith(_WIDENED[:2]) else state[name].clone()
            larger[tuple(slice(size) for size in old.shape)] = old  # in its first places
            state[name] = larger
    model.load_state_dict(state)
    return model


# scores -------------------------------------------------------------------------------------------


SKY = palette.ID["sky"]
SCORES = (
    ("psnr", "RGB PSNR dB"),
    ("psnr_seen", "- where seen"),
    ("psnr_unseen", "- unseen"),
    ("psnr_condition", "- of the condition"),
    ("ssim", "SSIM"),
    ("sharpness", "sharpness (1 = truth)"),
    ("abs_rel", "depth AbsRel"),
    ("delta1", "delta1"),
    ("abs_rel_nearest", "AbsRel nearest fill"),
    ("delta1_nearest", "delta1 nearest fill"),
    ("miou", "mIoU"),
    ("accuracy", "accuracy"),
    ("flicker", "flicker (1 = truth)"),
    ("sky_near", "sky nearer 80 m"),
    ("edges_agree", "depth edges on class edges"),
    ("confidence_gap", "confidence AUC"),
)


def score(
    model: Model, cities: Sequence[int], shards: Shards, request: SampleRequest, *, picture: Path | None = None
) -> dict[str, Any]:
    """Generate all clips of some cities and compare with the truth. Returns {"average": scores over the shifted clips,
    "by_shift": {shift: scores}, "clips": n, "steps": request.steps}. Keys as in `SCORES`; classes are pooled over all
    clips before the IoU. Draws a grid of up to 6 clips into `picture`. request: how clips are sampled; the index is put
    in for each."""
    rows: dict[str, list[dict[str, float]]] = {}
    counts: dict[str, Tensor] = {}
    pairs: list[tuple[Clip, GeneratedClip]] = []
    for city in cities:
        count, frames = shards.reading(city, counts_at)
        for number in range(count):
            clip = shards.clip(city, number, range(min(model.config.window, frames)))
            sample = generated(model, clip.condition, replace(request, index=city * 16 + number))
            name = "recorded" if clip.shift_m == 0 else f"{abs(clip.shift_m):.0f} m"
            row, matrix = score_clip(clip, sample)
            rows.setdefault(name, []).append(row)
            counts[name] = counts.get(name, torch.zeros_like(matrix)) + matrix
            if len(pairs) < 6 and (clip.shift_m != 0 or number == 0):
                pairs.append((clip, sample))
    if picture is not None and pairs:
        save_grid(picture, pairs)
    by_shift = {name: _average(rows[name], counts[name]) for name in sorted(rows)}
    shifted = [n for n in rows if n != "recorded"] or list(rows)
    pooled = _average([r for n in shifted for r in rows[n]], sum(counts[n] for n in shifted))
    return {"average": pooled, "by_shift": by_shift, "clips": sum(map(len, rows.values())), "steps": request.steps}


def score_clip(clip: Clip, sample: GeneratedClip) -> tuple[dict[str, float], Tensor]:
    """Scores of one clip and its class confusion i64[19,20]."""
    rgb, ids, given = clip.rgb, clip.semantics, clip.condition
    # far depth does not count, nor does guessed depth
    depth = torch.where(clip.depth_weight == 1, clip.depth, FAR_M)
    seen = given.valid if given.warped is None else given.valid | given.warped
    frames = [TrueFrame(*one) for one in zip(given.views, depth, ids, strict=True)]
    solid = (depth < 90.0) & (ids.unsqueeze(1) != SKY)
    flat = lambda x: x.transpose(0, 1).flatten(1, 2)
    error = metrics.depth_errors(flat(sample.depth), flat(depth), flat(solid))
    filled = given.depth if given.measured is None else filled_depth(given.measured)
    nearest = metrics.depth_errors(flat(filled), flat(depth), flat(solid))
    matrix = metrics.confusion(sample.semantics.flatten(0, 1), ids.flatten(0, 1))
    sky = (ids == SKY).unsqueeze(1)
    wrong = (sample.rgb - rgb).abs().mean(1, keepdim=True)
    row = {
        "psnr": metrics.psnr(flat(sample.rgb), flat(rgb)),
        "psnr_seen": metrics.psnr(flat(sample.rgb), flat(rgb), flat(seen)),
        "psnr_unseen": metrics.psnr(flat(sample.rgb), flat(rgb), flat(~seen)),
        "psnr_condition": metrics.psnr(flat(given.color), flat(rgb)),
        "ssim": float(np.mean([metrics.ssim(a, b) for a, b in zip(sample.rgb, rgb)])),
        "sharpness": _gradient(sample.rgb) / max(_gradient(rgb), 1e-6),
        "abs_rel": error.abs_rel,
        "delta1": error.delta1,
        "abs_rel_nearest": nearest.abs_rel,
        "delta1_nearest": nearest.delta1,
        "flicker": flicker(sample.rgb, rgb, frames),
        "sky_near": float((sample.depth[sky] < 80).float().mean()) if bool(sky.any()) else math.nan,
        "edges_agree": edges_agree(sample.depth, sample.semantics),
        "confidence_gap": auc(sample.confidence.flatten(), wrong.flatten()),
    }
    return row, matrix


def edges_agree(depth: Tensor, semantics: Tensor) -> float:
    """Share of depth edges (ratio of neighbours > 1.25) that lie within a pixel of a class edge. NaN without edges."""
    log_depth = depth.clamp(min=0.1).log()
    tall = ((log_depth[..., 1:, :] - log_depth[..., :-1, :]).abs() > 0.223)[..., :-1]
    wide = ((log_depth[..., 1:] - log_depth[..., :-1]).abs() > 0.223)[..., :-1, :]
    edge = tall | wide
    ids = semantics.unsqueeze(1)
    change = (ids[..., 1:, :-1] != ids[..., :-1, :-1]) | (ids[..., :-1, 1:] != ids[..., :-1, :-1])
    near = torch.nn.functional.max_pool2d(change.float(), 3, stride=1, padding=1) > 0
    return float((edge & near).sum() / edge.sum()) if bool(edge.any()) else math.nan


def auc(confidence: Tensor, error: Tensor) -> float:
    """Probability that of two pixels the one with more error has less confidence (0.5 = no use, 1 = perfect)."""
    a, b = torch.randint(len(error), (2, 20000), generator=torch.Generator().manual_seed(0))
    right = ((error[a] > error[b]) == (confidence[a] < confidence[b])).float()
    return float(torch.where(confidence[a] == confidence[b], 0.5, right).mean())


def _gradient(rgb: Tensor) -> float:
    return float((rgb[..., 1:] - rgb[..., :-1]).abs().mean() + (rgb[..., 1:, :] - rgb[..., :-1, :]).abs().mean())


def _average(rows: Sequence[Mapping[str, float]], counts: Tensor) -> dict[str, float]:
    result: dict[str, float] = {}
    for name in rows[0]:
        values = [r[name] for r in rows if math.isfinite(r[name])]
        if values:
            result[name] = round(float(np.mean(values)), 4)
    if not bool(counts.any()):  # logs without labels
        return result
    ious = metrics.iou_of(counts)
    frequent = {n: v for n, v in ious.items() if float(counts[palette.ID[n]].sum()) > 2e-4 * float(counts.sum())}
    result["miou"] = round(float(np.mean(list(frequent.values()))), 4)
    result["miou_all"] = round(float(np.mean(list(ious.values()))), 4)
    result["accuracy"] = round(float(counts[:, :-1].diagonal().sum() / counts.sum()), 4)
    return result | {f"iou {n}": round(v, 3) for n, v in ious.items()}


def table(scores: Mapping[str, Any]) -> str:
    """Scores as text, one column per shift."""
    columns = {**scores["by_shift"], "shifted": scores["average"]}
    lines = [f"{'':28s}" + "".join(f"{c:>11s}" for c in columns)]
    for key, title in SCORES:
        cells = (columns[c].get(key) for c in columns)
        lines.append(f"{title:28s}" + "".join(f"{'-' if v is None else format(v, '.3f'):>11s}" for v in cells))
    return "\n".join(lines)


# pictures -----------------------------------------------------------------------------------------


def save_grid(path: Path, pairs: Sequence[tuple[Clip, GeneratedClip]], frame: int = 4) -> None:
    """One row per clip: condition, made and true colour; condition, made and true depth; made and true classes;
    confidence."""
    rows = []
    for clip, sample in pairs:
        t = min(frame, len(sample.confidence) - 1)
        given = clip.condition
        measured = torch.where(given.measurement.valid[t], given.measurement.depth[t], 100.0)
        cells = [
            *(to_bytes(rgb) for rgb in (given.color[t], sample.rgb[t], clip.rgb[t])),
            *(depth_colors(depth[0].numpy()) for depth in (measured, sample.depth[t], clip.depth[t])),
            *(class_colors(ids.numpy()) for ids in (sample.semantics[t], clip.semantics[t])),
            gray(sample.confidence[t, 0].numpy()),
        ]
        rows.append(np.concatenate(cells, 1))
    store.write_image(path, np.concatenate(rows, 0))
