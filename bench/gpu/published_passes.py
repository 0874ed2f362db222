"""Seconds and peak memory of the published-type network with made-up weights: a pass, a decoding, and what a clip
takes.

    python bench/gpu/published_passes.py --device cuda --out full_size.json
    python bench/gpu/published_passes.py --device cuda --compile
    python bench/gpu/published_passes.py --small --device cpu

A clip has 3 modalities: per step a pass of batch 6 with guidance, of batch 3 without; then 3 decodings. Clips are
computed from the passes.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import Any

import torch
from shared import SMALL_PUBLISHED, device_of, drawn_model, finish, flags, generator_of, measured

from mudg.diffusion.published import PublishedConfig

MODALITIES = 3
STEPS = (50, 20, 8, 4)


def main(words: Sequence[str] | None = None) -> dict[str, Any]:
    """Read the flags, measure, print."""
    parser = flags(__doc__)
    parser.add_argument("--size", default="1024x576")
    parser.add_argument("--batches", type=int, nargs="+", default=[1, 2, 3, 6])
    parser.add_argument("--frames-at-once", type=int, nargs="+", default=[1, 4])
    parser.add_argument("--dtype", choices=("bfloat16", "float16", "float32"))
    parser.add_argument("--compile", action="store_true", help="compile the denoising network first")
    options = parser.parse_args(words)
    device = device_of(options)
    options.dtype = options.dtype or ("bfloat16" if device.type == "cuda" else "float32")
    width, height = map(int, options.size.split("x"))
    config = SMALL_PUBLISHED if options.small else PublishedConfig(width=width, height=height)
    model = drawn_model(config, device, getattr(torch, options.dtype))
    if options.compile:
        model.net.compile()
    frames, channels, tokens = config.window, config.codec.latent_channels, config.image_tokens
    h, w = config.height // model.codec.factor, config.width // model.codec.factor
    generator = generator_of("inputs", device)
    draw = functools.partial(torch.randn, generator=generator, device=device)
    rows: list[dict[str, Any]] = []
    passes: dict[int, float] = {}
    with torch.no_grad():
        for batch in options.batches:
            x, planes = draw(batch, frames, channels, h, w), draw(batch, frames, 2 * channels, h, w)
            t = torch.full((batch,), 500, device=device)
            text, image = model.text[:1].expand(batch, -1, -1), draw(batch, frames, tokens.tokens, tokens.context_width)
            one_pass = functools.partial(model.predict, x, planes, t, ["rgb"] * batch, text, image)
            found = measured(one_pass, device, options.repeats)
            passes[batch] = found["seconds"] or 0.0
            rows.append({"what": "pass", "batch": batch, **found})
        z, decoding_s = draw(frames, channels, h, w), 0.0
        for at_once in options.frames_at_once:
            found = measured(functools.partial(model.codec.decode_image, z, at_once), device, 1)
            decoding_s = found["seconds"] or 0.0
            rows.append({"what": f"decoding {frames} frames", "at once": at_once, **found})
    for batch, kind in ((2 * MODALITIES, "clip with guidance"), (MODALITIES, "clip without guidance")):
        if batch in passes:
            rows += [
                {"what": kind, "steps": n, "computed seconds": n * passes[batch] + MODALITIES * decoding_s}
                for n in STEPS
            ]
    return finish(options, device, rows)


if __name__ == "__main__":
    main()
