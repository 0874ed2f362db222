"""Training of the small model's latent codec, before the network: by the leader alone, on whole images."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import torch
from torch import Tensor, nn
from torch.nn import functional

from mudg.base import log, palette, seeds
from mudg.base.errors import ResourceError
from mudg.base.run_folder import RunDir
from mudg.base.types import Clip
from mudg.core import losses
from mudg.data.clips.shards import ShardSource
from mudg.models.mdm.codec import Modality, PatchCodec
from mudg.stages.config import LearnConfig
from mudg.stages.learning.clips import draw_clips
from mudg.stages.learning.models import draw_weights
from mudg.stages.learning.parallel import Ranks, agreed_terms
from mudg.stages.learning.state import TrainingState, mean_of, newest_checkpoint, read_rows

CPU = torch.device("cpu")
LEARNING_RATE = 2e-3
FIT_IMAGES = 8


def train_codec(
    codec: PatchCodec, config: LearnConfig, run_dir: RunDir, folder: Path | ShardSource, bf16: bool, device: torch.device = CPU
) -> None:
    """Fit the linear parts on the first cities of `folder`, on the CPU, then train the decoder on noisy latents, on a device."""
    steps, out, alone = config.codec.steps, run_dir.path / "codec", Ranks(0, 1, device)
    codec.to(device)
    optimizer = torch.optim.AdamW(codec.parameters(), lr=LEARNING_RATE, betas=(0.9, 0.99), weight_decay=1e-3)
    state = TrainingState(nn.ModuleDict({"codec": codec}), optimizer, None)
    if not state.resume(out, alone):
        codec.load_state_dict(_fitted(codec, config, folder).state_dict())
    recent: list[dict[str, float]] = []
    with log.task("codec", steps, state.step) as bar:
        for step in range(state.step, steps):
            warm, left = min(1.0, (step + 1) / 50), 1 - step / steps
            optimizer.param_groups[0]["lr"] = LEARNING_RATE * warm * min(1.0, left / 0.6)
            clips = [clip.to(device) for clip in draw_clips(config, folder, step, config.codec.batch, 1, "codec batch")]
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


def _fitted(like: PatchCodec, config: LearnConfig, folder: Path | ShardSource) -> PatchCodec:
    """A codec on the CPU with weights drawn and its linear parts fitted."""
    codec = PatchCodec(like.config)
    draw_weights(codec, config.seed, "codec weights")
    batches = [draw_clips(config, folder, n, FIT_IMAGES, 1, "codec fit") for n in range(config.codec.fit_batches)]
    images = [clip for batch in batches for clip in batch]
    height, width = (min(clip.rgb.shape[axis] for clip in images) for axis in (-2, -1))  # steps may differ in size
    codec.fit_color(torch.cat([clip.rgb[..., :height, :width] for clip in images]))
    codec.fit_depth(torch.cat([clip.depth[..., :height, :width] for clip in images]))
    return codec


def load_trained_codec(codec: PatchCodec, out: Path, ranks: Ranks) -> None:
    """The codec that the leader trained, in every process."""
    saved = newest_checkpoint(out / "codec", ranks)
    if saved is None:
        raise ResourceError("the trained codec that rank 0 wrote is not visible here", where=str(out / "codec"),
                            remedy="choose an --out on a file system that all processes share")  # fmt: skip
    read_rows(saved.path, "net", nn.ModuleDict({"codec": codec}).state_dict())


def codec_loss(codec: PatchCodec, clips: Sequence[Clip], generator: torch.Generator) -> tuple[Tensor, dict[str, float]]:
    """Reconstruction loss of the decoder on latents with a little noise, drawn on the CPU; modalities are left out at random.

    L1 + half squared error and L1 of gradients for colour, L1 for the depth code, cross-entropy for classes.
    """
    rgb, depth, known, ids = (
        torch.cat([getattr(clip, name) for clip in clips]) for name in ("rgb", "depth", "depth_weight", "semantics")
    )
    with torch.no_grad():
        latents: dict[Modality, Tensor] = {
            "rgb": codec.encode_rgb(rgb), "depth": codec.encode_depth(depth), "semantics": codec.encode_semantics(ids)
        }  # fmt: skip
        amount = 0.15 * torch.rand(len(rgb), 1, 1, 1, generator=generator).to(rgb.device)
        keep = (torch.rand(3, len(rgb), 1, 1, 1, generator=generator) > 0.15).float().to(rgb.device)
        noisy: dict[Modality, Tensor] = {
            m: (z + amount * torch.randn(z.shape, generator=generator).to(z.device)) * k for (m, z), k in zip(latents.items(), keep)
        }
        target = codec.linear_depth_code(depth)
    made_rgb, made_depth, scores = codec.decode_raw(noisy)
    ids = torch.where(keep[2, :, 0] > 0, ids, palette.UNLABELLED)
    labelled = bool((ids < palette.UNLABELLED).any())
    parts = {
        "rgb": losses.image_error((made_rgb - (rgb * 2 - 1)) * keep[0], square=0.5, gradient=0.25),
        "depth": ((made_depth - target) * keep[1] * known).abs().mean(),
        "semantics": functional.cross_entropy(scores, ids, ignore_index=palette.UNLABELLED)
        if labelled
        else scores.sum() * 0,
    }
    loss = parts["rgb"] + parts["depth"] + 0.1 * parts["semantics"]
    return loss, {name: float(part.detach()) for name, part in parts.items()}
