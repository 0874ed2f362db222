"""Seconds and peak memory of the published-type network with made-up weights: one pass, one decoding, one training step.

    python bench/published_speed.py --device cuda --size 1024x576 --batches 1 2 3 6 --training-batch 1
    python bench/published_speed.py --device cpu --size 64x64 --batches 1 --dtype float32

A clip takes 50 steps x 3 modalities x 2 (guidance) passes of batch 1, or 50 passes of batch 6. Peak memory is measured on CUDA only.
"""

import argparse
import functools
import statistics
import sys
import time
from collections.abc import Callable

import torch

from mudg.base import seeds
from mudg.models.published.model import PublishedConfig, PublishedLatents, PublishedMDM
from mudg.stages.learning import memory_plan


def built(config: PublishedConfig, device: str, dtype: torch.dtype) -> PublishedMDM:
    """The full-size model on a device, every weight drawn."""
    model = memory_plan.meta_model(config, dtype).to_empty(device=device)
    generator = torch.Generator(device).manual_seed(seeds.key(0, 0, "weights"))
    with torch.no_grad():
        for value in model.parameters():
            value.normal_(0.0, 0.02, generator=generator)
        model.text.zero_()
    return model


def measured(what: str, function: Callable[[], object], device: str, repeats: int) -> None:
    """Print median seconds and peak memory of a function, after one call to warm up."""
    function()
    if device == "cuda":
        torch.cuda.synchronize()
        torch.cuda.reset_peak_memory_stats()
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        function()
        if device == "cuda":
            torch.cuda.synchronize()
        times.append(time.perf_counter() - start)
    peak = f"{torch.cuda.max_memory_allocated() / 1e9:7.2f} GB" if device == "cuda" else "   not measured"
    sys.stdout.write(f"{what:<44}{statistics.median(times):9.3f} s {peak}\n")
    sys.stdout.flush()


def main() -> None:
    """Read the flags, measure, print."""
    flags = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    flags.add_argument("--device", default="cuda")
    flags.add_argument("--size", default="1024x576")
    flags.add_argument("--batches", type=int, nargs="+", default=[1, 2, 3, 6])
    flags.add_argument("--frames-at-once", type=int, nargs="+", default=[1, 4])
    flags.add_argument("--dtype", default="bfloat16", choices=("bfloat16", "float16", "float32"))
    flags.add_argument("--training-batch", type=int, default=0)
    flags.add_argument("--repeats", type=int, default=3)
    options = flags.parse_args()
    width, height = map(int, options.size.split("x"))
    config = PublishedConfig(width=width, height=height)
    model = built(config, options.device, getattr(torch, options.dtype))
    frames, channels, tokens = config.window, config.codec.latent_channels, config.image_tokens
    h, w = height // model.codec.factor, width // model.codec.factor
    generator = torch.Generator(options.device).manual_seed(seeds.key(0, 0, "inputs"))
    draw = lambda *shape: torch.randn(*shape, generator=generator, device=options.device)  # noqa: E731
    for batch in options.batches:
        x, planes = draw(batch, frames, channels, h, w), draw(batch, frames, 2 * channels, h, w)
        t = torch.full((batch,), 500, device=options.device)
        text, image = model.text[:1].expand(batch, -1, -1), draw(batch, frames, tokens.tokens, tokens.context_width)
        with torch.no_grad():
            one_pass = functools.partial(model.predict, x, planes, t, ["rgb"] * batch, text, image)
            measured(f"denoising pass, batch {batch}", one_pass, options.device, options.repeats)
    z = draw(frames, channels, h, w)
    for at_once in options.frames_at_once:
        with torch.no_grad():
            decoding = functools.partial(model.codec.decode_image, z, at_once)
            measured(f"decoding 16 frames, {at_once} at once", decoding, options.device, 1)
    if options.training_batch:
        batch = options.training_batch
        frozen = model.temporal_parameters("transformers") if height > 320 else set()
        model.requires_grad_(False)
        moving = [p.requires_grad_(True) for name, p in model.trained_part().named_parameters() if name not in frozen]
        model.net.train()
        model.net.checkpointing = True
        truth = {m: draw(batch, frames, channels, h, w) for m in ("rgb", "depth", "semantics")}
        features = draw(batch, 257, config.image.width).to(model.dtype)
        encoded = PublishedLatents(draw(batch, frames, 2 * channels, h, w), features, features[:1], draw(batch, frames, 1, h, w))

        def step() -> None:
            model.velocity_loss(truth, encoded, seeds.torch_generator(0, 0, "step")).total.backward()
            for value in moving:
                value.grad = None

        measured(f"loss and gradients, batch {batch}", step, options.device, options.repeats)


if __name__ == "__main__":
    main()
