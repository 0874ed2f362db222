"""Trains the small diffusion model further by the recipe in its folder, and scores both on the same held-out cities.

    python bench/gpu/train_mdm.py --device cuda --steps 20000 --work runs/mdm --out mdm.json
    python bench/gpu/train_mdm.py --small --device cpu

The recipe is the last of `src/mudg/assets/mdm_small/model.json` (`facts.recipe`). The new weights are worth shipping
only if they are better at 2, 3 and 4 m in every modality: `held_out` of both, in the result. The model is in
WORK/learned.
"""

from __future__ import annotations

import json
import time
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from shared import device_of, finish, flags, work_folder

from mudg.base import config as configuration
from mudg.diffusion import model_files
from mudg.diffusion.settings import LearnCodec, LearnConfig
from mudg.steps.synthesize import Learn

NO_LONGER = ("textures",)
"""Of the recipe: photographs that are not part of the repository, unless --textures names them."""


def recipe(steps: int, textures: str, device: str, workers: int) -> LearnConfig:
    """The recipe of the shipped model, for so many steps on a device, by processes that make its clips.

    The recipe itself has none: its clips were made before.
    """
    given = dict(model_files.facts("embedded")["recipe"])
    given["data"] = {name: value for name, value in given["data"].items() if name not in NO_LONGER}
    config = configuration.load(LearnConfig, None, None, {**given, "steps": steps})
    return replace(
        config,
        data=replace(config.data, textures=textures),
        compute=replace(config.compute, device=device, workers=workers),
    )


def small(config: LearnConfig) -> LearnConfig:
    """The same from nothing at a tiny size."""
    return replace(
        config,
        start="",
        precision="float32",
        codec=LearnCodec(steps=2, batch=2, fit_batches=1),
        data=replace(
            config.data,
            width=48,
            height=32,
            window=2,
            cities=1,
            first_cities=1,
            clips_per_city=1,
            held_out=1,
            renders=False,
            realism="plain",
        ),
        network=replace(
            config.network,
            widths=(32, 32),
            blocks=(1, 1),
            spatial_attention=(False, False),
            temporal_attention=(False, True),
            refine_widths=(8, 8),
            refine_blocks=(1, 1),
            renders=False,
            finish_widths=(),
            finish_blocks=(),
        ),
        optimizer=replace(config.optimizer, batch_frames=2, warmup_steps=1),
        score=replace(config.score, every=1000, steps=1),
    )


def main(words: Sequence[str] | None = None) -> dict[str, Any]:
    """Read the flags, train, print scores."""
    parser = flags(__doc__)
    parser.add_argument("--steps", type=int, default=20_000)
    parser.add_argument("--textures", default="", help="folder of CC0 photographs (see the model card)")
    parser.add_argument("--workers", type=int, default=1, help="processes that make clips")
    options = parser.parse_args(words)
    device = device_of(options)
    config = recipe(options.steps, options.textures, str(device), options.workers)
    if options.small:
        config = small(replace(config, steps=2))
    began = time.perf_counter()
    model = Learn(out=work_folder(options) / "learned", settings=config).run()
    seconds = time.perf_counter() - began
    after, before = model_files.facts(model)["held_out"], model_files.facts("embedded")["held_out"]
    rows = [{"what": "training", "steps": config.steps, "seconds": seconds, "seconds per step": seconds / config.steps}]
    rows += [
        {"what": name, "held_out": json.dumps(scores)} for name, scores in (("shipped", before), ("trained", after))
    ]
    return finish(
        options, device, rows, {"shipped": model_files.digest("embedded"), "trained": model_files.digest(model)}
    )


if __name__ == "__main__":
    main()
