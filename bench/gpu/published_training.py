"""Seconds and peak memory of a training step of the published-type network: loss, gradients and AdamW, weights made up.

    python bench/gpu/published_training.py --device cuda --size 512x320 --batches 1 2 4 8                 # stage 1
    python bench/gpu/published_training.py --device cuda --size 1024x576 --batches 1 2 4 --stage 2        # temporal
                                                                                                          transformers
                                                                                                          frozen
    python bench/gpu/published_training.py --small --device cpu

Weights and moments are float32, the step computes in bfloat16 on a card. A batch that does not fit is a row that says
so.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from shared import SMALL_PUBLISHED, device_of, drawn_model, finish, flags, generator_of, measured

from mudg.base import seeds
from mudg.diffusion.parallel import recompute
from mudg.diffusion.published import PublishedConfig, PublishedLatents, PublishedMDM

MODALITIES = ("rgb", "depth", "semantics")


def trained_weights(model: PublishedMDM, stage: int) -> list[torch.nn.Parameter]:
    """Gradients on for what a stage of the published training moves, off for the rest; returns what moves."""
    frozen = model.temporal_parameters("transformers") if stage == 2 else set()
    model.requires_grad_(False)
    moving = [p.requires_grad_(True) for name, p in model.trained_part().named_parameters() if name not in frozen]
    model.net.train()
    recompute(model.net)
    return moving


def step_of_batch(
    model: PublishedMDM, moving: list[torch.nn.Parameter], optimizer: torch.optim.Optimizer, batch: int
) -> dict[str, float | None]:
    """Seconds and memory of one step at a batch size."""
    config, device = model.config, model.device
    frames, channels = config.window, config.codec.latent_channels
    h, w = config.height // model.codec.factor, config.width // model.codec.factor
    generator = generator_of("inputs", device)

    def draw(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, generator=generator, device=device)

    truth = {m: draw(batch, frames, channels, h, w) for m in MODALITIES}
    patches = model.image.places.shape[0]
    features = draw(batch, patches, config.image.width).to(model.dtype)
    encoded = PublishedLatents(
        draw(batch, frames, 2 * channels, h, w), features, features[:1], draw(batch, frames, 1, h, w)
    )

    def step() -> None:
        with torch.autocast(device.type, torch.bfloat16, enabled=device.type == "cuda"):
            loss = model.velocity_loss(truth, encoded, seeds.torch_generator(0, 0, "step")).total
        loss.backward()
        torch.nn.utils.clip_grad_norm_(moving, 0.5)
        optimizer.step()
        optimizer.zero_grad(set_to_none=True)

    return measured(step, device, 3)


def main(words: Sequence[str] | None = None) -> dict[str, Any]:
    """Read the flags, measure, print."""
    parser = flags(__doc__)
    parser.add_argument("--size", default="512x320")
    parser.add_argument("--batches", type=int, nargs="+", default=[1])
    parser.add_argument("--stage", type=int, choices=(1, 2), default=1)
    options = parser.parse_args(words)
    device = device_of(options)
    width, height = map(int, options.size.split("x"))
    config = SMALL_PUBLISHED if options.small else PublishedConfig(width=width, height=height)
    model = drawn_model(config, device, torch.float32)
    moving = trained_weights(model, options.stage)
    optimizer = torch.optim.AdamW(moving, lr=1e-5)
    rows: list[dict[str, Any]] = []
    for batch in options.batches:
        row: dict[str, Any] = {
            "what": f"training step, stage {options.stage}",
            "size": f"{config.width}x{config.height}",
            "batch": batch,
        }
        try:
            rows.append({**row, **step_of_batch(model, moving, optimizer, batch)})
        except torch.OutOfMemoryError:
            optimizer.zero_grad(set_to_none=True)
            rows.append({**row, "seconds": None, "peak_gb": None, "failed": "out of memory"})
    return finish(options, device, rows)


if __name__ == "__main__":
    main()
