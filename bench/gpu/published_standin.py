"""What fewer passes of the published network cost, on a stand-in trained on generated cities.

    python bench/gpu/published_standin.py --device cuda --work runs/standin --out standin.json --picture standin.png
    python bench/gpu/published_standin.py --small --device cpu

The stand-in has every part of the published model (autoencoder, image tower, resampler, video UNet with temporal and
cross-attention, labels, velocity with a dynamic rescale, guidance), narrower, with 16 latent channels in place of 4,
and for 8 frames of 96x64. The image tower is drawn, not trained. The condition is the published one: points alone, and
a recorded reference. Trained weights are kept in --work; an interrupted training resumes. Then the same clips, of
cities it never saw, are generated with fewer passes.
"""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from shared import device_of, finish, flags, work_folder
from torch import Tensor
from torch.nn import functional

from mudg.base import log, seeds, store
from mudg.base.types import Clip
from mudg.core import metrics
from mudg.core.metrics import Pair
from mudg.core.noise import ScheduleConfig
from mudg.core.pictures import class_colors, depth_colors, to_bytes
from mudg.diffusion import city_clips, model_files, models
from mudg.diffusion import clips as clip_shards
from mudg.diffusion.model_files import generated
from mudg.diffusion.published import GUIDANCE, PublishedConfig, PublishedLatents, PublishedMDM, WorkSplit
from mudg.diffusion.published_network import AutoencoderConfig, ResamplerConfig, VideoUNetConfig
from mudg.diffusion.requests import GeneratedClip, SampleRequest
from mudg.networks.clip import TowerConfig
from mudg.networks.codec import MODALITIES
from mudg.networks.featnets import CodecFeatures, PerceptualDistance

RULES = city_clips.CityClipRules(width=96, height=64, window=8, clips=4, published=True)
CONFIG = PublishedConfig(
    net=VideoUNetConfig(
        channels_in=48,
        channels_out=16,
        width=64,
        multipliers=(1, 2, 4),
        blocks=1,
        attention=(True, True, False),
        head_width=32,
        first_heads=2,
        context_width=64,
    ),
    codec=AutoencoderConfig(width=32, multipliers=(1, 2, 2, 4), blocks=1, latent_channels=16, posterior="mean"),
    image_tokens=ResamplerConfig(
        width=64, layers=2, head_width=32, heads=2, tokens=4, frames=8, image_width=64, context_width=64
    ),
    image=TowerConfig(64, 2, 2),
    image_side=56,
    text=TowerConfig(64, 3, 2),
    schedule=ScheduleConfig(base_scale=0.7),
    width=96,
    height=64,
)
SMALL_RULES = replace(RULES, width=32, height=32, window=4, clips=1)
SMALL_CONFIG = replace(
    CONFIG,
    net=replace(CONFIG.net, width=32, multipliers=(1, 2), attention=(True, False)),
    codec=replace(CONFIG.codec, multipliers=(1, 2)),
    image_tokens=replace(CONFIG.image_tokens, frames=4, layers=1),
    width=32,
    height=32,
)
LATENT_DEVIATION = 1.0
"""Standard deviation that the scaled latents are brought to."""
NETWORK_FILE = "network.safetensors"


class Sampling(NamedTuple):
    """How clips are generated: steps, guidance (None: the published 7.5), noise added between steps (None: all
    of it, as the release does)."""

    steps: int
    guidance: float | None = None
    eta: float | None = None


GRID = (
    Sampling(50),
    Sampling(20),
    Sampling(8),
    Sampling(5),
    Sampling(5, eta=0.0),
    Sampling(50, 1.0),
    Sampling(10, 1.0),
    Sampling(10, 1.0, 0.0),
    Sampling(1, 1.0, 0.0),
)
"""Rows of the table; the first is the published way, the last the regression of a clip on its condition."""


# clips --------------------------------------------------------------------------------------------


def images_of(clip: Clip, model: PublishedMDM) -> Tensor:
    """Colour, depth and class images of a clip's frames, f32[3*T,3,H,W] in [-1,1]."""
    depth = torch.where(clip.depth_valid, clip.depth, clip_shards.FAR_M)
    return torch.cat([clip.rgb * 2 - 1, model.codec.depth_image(depth), model.codec.semantic_image(clip.semantics)])


def every_clip(folder: Path, cities: Sequence[int], window: int) -> list[Clip]:
    """All clips of the cities."""
    shards = clip_shards.ShardFolder(folder)
    return [shards.clip(city, number, range(window)) for city in cities for number in range(shards.clips_in(city))]


# autoencoder --------------------------------------------------------------------------------------


def train_codec(model: PublishedMDM, clips: Sequence[Clip], steps: int) -> None:
    """Train the autoencoder on frames of the three modalities, then scale its latents to `LATENT_DEVIATION`."""
    codec = model.codec.train()
    optimizer = torch.optim.AdamW(codec.parameters(), lr=1e-3, betas=(0.9, 0.99), weight_decay=1e-4)
    rng, began = seeds.numpy_rng(0, 0, "codec clips"), time.perf_counter()
    for step in range(steps):
        for group in optimizer.param_groups:
            group["lr"] = 1e-3 * min(1.0, (step + 1) / 50) * 0.5 * (1 + math.cos(math.pi * step / steps))
        pool = torch.cat([images_of(clips[n], model) for n in rng.integers(0, len(clips), 4)])
        image = pool[torch.from_numpy(rng.permutation(len(pool))[:24])].to(model.device)
        with torch.autocast(model.device.type, torch.bfloat16):
            mean, log_variance = codec.to_moments(codec.encoder(image)).chunk(2, 1)
            noise = torch.randn(mean.shape, generator=seeds.torch_generator(0, step, "codec")).to(mean)
            made = codec.decoder(codec.from_latent(mean + (0.5 * log_variance).exp() * noise))
        made, mean, log_variance = made.float(), mean.float(), log_variance.float()
        penalty = 0.5 * (mean.square() + log_variance.exp() - 1 - log_variance).mean()
        loss = functional.l1_loss(made, image) + 0.5 * functional.mse_loss(made, image) + 1e-5 * penalty
        optimizer.zero_grad(set_to_none=True)
        loss.backward()
        torch.nn.utils.clip_grad_norm_(codec.parameters(), 1.0)
        optimizer.step()
        if step % 100 == 0 or step + 1 == steps:
            log.info(
                f"autoencoder {step + 1}/{steps} loss {float(loss.detach()):.4f} ({time.perf_counter() - began:.0f} s)"
            )
    codec.eval()
    with torch.no_grad():
        z = torch.cat([codec.encode(images_of(clip, model).to(model.device), frames_at_once=8) for clip in clips[:32]])
        factor = LATENT_DEVIATION / float(z.std())
        channels = model.config.codec.latent_channels
        codec.to_moments.weight[:channels] *= factor
        codec.to_moments.bias[:channels] *= factor
        codec.from_latent.weight /= factor


def codec_psnr(model: PublishedMDM, clips: Sequence[Clip]) -> float:
    """PSNR of colour frames that went through the autoencoder."""
    with torch.no_grad():
        made = [
            model.codec.decode_rgb(model.codec.encode(c.rgb.to(model.device) * 2 - 1, frames_at_once=8), 8).cpu()
            for c in clips
        ]
    errors = [(a - c.rgb).square().mean() for a, c in zip(made, clips, strict=True)]
    return -10 * math.log10(float(torch.stack(errors).mean()))


# network ------------------------------------------------------------------------------------------


def encode_all(model: PublishedMDM, clips: Sequence[Clip]) -> tuple[dict[str, Tensor], PublishedLatents]:
    """Latents of the truth of all clips and of their conditions, encoded once (the posterior's mean)."""
    parts, truths = [], []
    with torch.no_grad():
        for clip in clips:
            depth = torch.where(clip.depth_valid, clip.depth, clip_shards.FAR_M)
            parts.append(model.encode_condition(clip.condition.to(model.device)))
            truths.append(model.encode_truth(clip.rgb[None], depth[None], clip.semantics[None]))
    joined = [torch.cat([getattr(p, name) for p in parts]) for name in ("planes", "features", "seen")]
    truth = {m: torch.cat([one[m] for one in truths]) for m in MODALITIES}
    return truth, PublishedLatents(joined[0], joined[1], parts[0].grey, joined[2])


def train_network(model: PublishedMDM, clips: Sequence[Clip], steps: int, batch: int, folder: Path) -> None:
    """Train network and resampler with `velocity_loss`, keeping a running average of the weights; resumes from
    `folder`."""
    truth, encoded = encode_all(model, clips)
    part = model.trained_part()
    model.requires_grad_(False)
    part.requires_grad_(True).train()
    average = {name: value.detach().clone() for name, value in part.state_dict().items()}
    optimizer = torch.optim.AdamW(part.parameters(), lr=6e-4, betas=(0.9, 0.99), weight_decay=1e-2)
    begin, kept = 0, folder / NETWORK_FILE
    if kept.is_file():
        begin, average = restored(kept, part, optimizer)
    began, losses = time.perf_counter(), list[float]()
    for step in range(begin, steps):
        for group in optimizer.param_groups:
            group["lr"] = 6e-4 * min(1.0, (step + 1) / 200) * (0.1 + 0.9 * 0.5 * (1 + math.cos(math.pi * step / steps)))
        chosen = torch.from_numpy(seeds.numpy_rng(0, step, "batch").integers(0, len(clips), batch)).to(model.device)
        given = PublishedLatents(encoded.planes[chosen], encoded.features[chosen], encoded.grey, encoded.seen[chosen])
        with torch.autocast(model.device.type, torch.bfloat16):
            loss = model.velocity_loss(
                {m: z[chosen] for m, z in truth.items()}, given, seeds.torch_generator(0, step, "noise")
            ).total
        optimizer.zero_grad(set_to_none=True)
        loss.backward()
        torch.nn.utils.clip_grad_norm_(part.parameters(), 1.0)
        optimizer.step()
        losses.append(float(loss.detach()))
        decay = min(0.998, (step + 1) / (step + 10))
        with torch.no_grad():
            for name, value in part.state_dict().items():
                average[name].lerp_(value, 1 - decay)
        last = step + 1 == steps
        if (step + 1) % 100 == 0 or last:
            log.info(
                f"network {step + 1}/{steps} loss {np.mean(losses[-100:]):.4f} ({time.perf_counter() - began:.0f} s)"
            )
        if (step + 1) % 200 == 0 or last:
            store.write_safetensors(kept, resumable(part, average, optimizer, step + 1))
    part.load_state_dict(average)
    model.requires_grad_(False).eval()


def resumable(
    part: torch.nn.Module, average: dict[str, Tensor], optimizer: torch.optim.Optimizer, step: int
) -> dict[str, Tensor]:
    """Everything that training needs to go on, by name."""
    moments = {f"adam {n} {k}": v for n, state in optimizer.state_dict()["state"].items() for k, v in state.items()}
    weights = {f"weights {n}": v for n, v in part.state_dict().items()}
    return {"step": torch.tensor(step), **weights, **{f"average {n}": v for n, v in average.items()}, **moments}


def restored(path: Path, part: torch.nn.Module, optimizer: torch.optim.Optimizer) -> tuple[int, dict[str, Tensor]]:
    """Put back what `resumable` kept; gives the step and the average weights."""
    device = next(part.parameters()).device
    found = {name: value.to(device) for name, value in store.read_tensors(path).items()}
    part.load_state_dict({n.split(" ", 1)[1]: v for n, v in found.items() if n.startswith("weights ")})
    state: dict[int, dict[str, Tensor]] = {}
    for name, value in found.items():
        if name.startswith("adam "):
            _, number, key = name.split(" ")
            state.setdefault(int(number), {})[key] = value
    optimizer.load_state_dict({**optimizer.state_dict(), "state": state})
    return int(found["step"]), {n.split(" ", 1)[1]: v for n, v in found.items() if n.startswith("average ")}


def trained(
    options: argparse.Namespace, config: PublishedConfig, clips: Sequence[Clip], device: torch.device
) -> PublishedMDM:
    """The stand-in; weights that lie in the folder are used again."""
    work, model = work_folder(options), drawn(config).to(device)
    if not (work / "codec").is_dir():
        train_codec(model, clips, options.codec_steps)
        tensors = {name: value.cpu() for name, value in model.state_dict().items()}
        model_files.save_published(work / "codec", config, tensors, {}, "An autoencoder of a stand-in.\n")
    model = model_files.load_published(work / "codec", device, torch.float32)
    for value in (*model.parameters(), *model.buffers()):
        value.data = value.data.clone()  # out of the mapped files: training writes in place
    model.requires_grad_(False)
    train_network(model, clips, options.steps, options.batch, work)
    model.split = WorkSplit(frames_at_once=config.window)
    return model


def drawn(config: PublishedConfig) -> PublishedMDM:
    """A stand-in before training."""
    with torch.random.fork_rng():
        torch.manual_seed(seeds.key(0, 0, "weights") % 2**31)
        model = PublishedMDM(config)
        with torch.no_grad():
            model.text[0].normal_(0.0, 1.0)
            model.image.places.normal_(0.0, 0.02)
    return model


# steps --------------------------------------------------------------------------------------------


def passes_of(steps: int, guidance: float | None) -> int:
    """Videos that go through the network for a clip of three modalities."""
    return steps * len(MODALITIES) * (1 if guidance == 1.0 else 2)


def generated_with(model: PublishedMDM, clips: Sequence[Clip], how: Sampling) -> list[GeneratedClip]:
    """The clips as they come out."""
    return [
        generated(model, clip.condition, SampleRequest(how.steps, index=n, eta=how.eta, guidance=how.guidance))
        for n, clip in enumerate(clips)
    ]


def scores_of(clips: Sequence[Clip], made: Sequence[GeneratedClip], distance: PerceptualDistance) -> dict[str, float]:
    """Mean scores of generated clips; classes are pooled."""
    rows, matrices = zip(
        *(models.score_clip(clip, sample) for clip, sample in zip(clips, made, strict=True)), strict=True
    )
    frames = (
        (a, b) for clip, sample in zip(clips, made, strict=True) for a, b in zip(sample.rgb, clip.rgb, strict=True)
    )
    apart = [distance(Pair(a, None, None, b, None, None, None)) for a, b in frames]
    means = {
        name: float(np.nanmean([row[name] for row in rows]))
        for name in ("psnr", "ssim", "sharpness", "abs_rel", "flicker")
    }
    ious = list(metrics.iou_of(torch.stack(matrices).sum(0)).values())
    return {"perceptual": float(np.mean(apart)), **means, "miou": sum(ious) / len(ious)}


def strip(made: Sequence[GeneratedClip], frame: int = 3) -> NDArray[np.uint8]:
    """Colour of three clips, depth and classes of the first."""
    return _cells([c.rgb[frame] for c in made[:3]], made[0].depth[frame, 0], made[0].semantics[frame])


def given_and_true(clips: Sequence[Clip], frame: int = 3) -> NDArray[np.uint8]:
    """Two rows: what the same clips are given, and the truth."""
    one = clips[0]
    given = _cells([c.condition.color[frame] for c in clips[:3]], one.condition.depth[frame, 0], one.semantics[frame])
    return np.concatenate(
        [given, _cells([c.rgb[frame] for c in clips[:3]], one.depth[frame, 0], one.semantics[frame])], 0
    )


def _cells(colors: Sequence[Tensor], depth: Tensor, ids: Tensor) -> NDArray[np.uint8]:
    return np.concatenate([*map(to_bytes, colors), depth_colors(depth.numpy()), class_colors(ids.numpy())], 1)


def main(words: Sequence[str] | None = None) -> dict[str, Any]:
    """Read the flags, train, measure, print."""
    parser = flags(__doc__)
    parser.add_argument("--steps", type=int, help="of the network (20000; 4 with --small)")
    parser.add_argument("--codec-steps", type=int, help="of the autoencoder (5000; 2 with --small)")
    parser.add_argument("--batch", type=int, default=8)
    parser.add_argument("--cities", type=int, help="how many cities (400; 1 with --small)")
    parser.add_argument("--clips", type=int, default=24, help="how many clips are generated")
    parser.add_argument("--rows", type=int, default=len(GRID), help="how many rows of the table")
    parser.add_argument(
        "--picture", type=Path, help="PNG: what is given, the truth, and a line for every row of the table"
    )
    options = parser.parse_args(words)
    device, work = device_of(options), work_folder(options)
    options.work = work
    for name, full, small in (("steps", 20_000, 4), ("codec_steps", 5000, 2), ("cities", 400, 1)):
        setattr(options, name, getattr(options, name) or (small if options.small else full))
    rules, config = (SMALL_RULES, SMALL_CONFIG) if options.small else (RULES, CONFIG)
    seen, unseen = range(options.cities), city_clips.REPORTED[: 1 if options.small else None]
    (work / "clips").mkdir(parents=True, exist_ok=True)
    missing = [city for city in (*seen, *unseen) if not clip_shards.shard_path(work / "clips", city).is_file()]
    for city in log.progress(missing, len(missing), "generating cities"):
        city_clips.write_city(rules, city, work / "clips")
    model = trained(options, config, every_clip(work / "clips", seen, rules.window), device)
    clips = every_clip(work / "clips", unseen, rules.window)[: options.clips]
    distance = PerceptualDistance(CodecFeatures(model_files.load("embedded").codec))
    rows, strips = list[dict[str, Any]](), list[NDArray[np.uint8]]()
    for how in GRID[: options.rows]:
        made = generated_with(model, clips, how)
        told = {"steps": how.steps, "guidance": how.guidance or GUIDANCE, "eta": how.eta}
        rows.append({**told, "passes": passes_of(how.steps, how.guidance), **scores_of(clips, made, distance)})
        strips.append(strip(made))
    if options.picture:
        store.write_image(options.picture, np.concatenate([given_and_true(clips), *strips], 0))
    weights = {"network": store.sha256_file(work / NETWORK_FILE)}
    return finish(options, device, [{"autoencoder PSNR": codec_psnr(model, clips)}, *rows], weights)


if __name__ == "__main__":
    main()
