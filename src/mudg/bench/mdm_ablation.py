"""What of its condition the diffusion model lives on: the published ablation of conditions, on generated cities.

Four small models are trained alike, on the same clips, draws and steps, with what the published system is given (projected
points with nothing filled in, zeros where nothing was seen; one reference image), and differ in the condition only:

reference only       the dense reference image as frame 0 of an otherwise empty colour condition; no points
sparse only          points, no reference image
concatenated         points; the reference as four further input channels of every frame
frame 0              points; the reference takes the place of frame 0 of the colour condition (the published choice)

and, for comparison, ours: points filled in, recorded images warped in, masks and given classes.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch

from mudg.base import log
from mudg.base.errors import NumericsError
from mudg.base.types import Clip, Condition
from mudg.data.clips import from_city
from mudg.data.clips.from_city import CityClipRules
from mudg.models.mdm import model as mdm
from mudg.models.mdm.model import MDM, BatchPart, LossSettings, MDMConfig
from mudg.stages import learn
from mudg.stages.config import BenchConfig, LearnConfig
from mudg.stages.config.learn import LearnCompute, LearnData, LearnOptimizer
from mudg.stages.learning import score as learn_score
from mudg.stages.learning.models import draw_weights
from mudg.stages.learning.precision import choose_bf16

WIDTH, HEIGHT = 96, 64
_SMALL: dict[str, Any] = {"widths": (48, 96, 160), "blocks": (1, 1, 2), "patch": 2}
_PUBLISHED: dict[str, Any] = {
    **_SMALL, "copy_condition": False, "backdrop": False, "mask_planes": "none", "given_classes": False,
    "refine_widths": (), "refine_blocks": (),
}  # fmt: skip


@dataclass(frozen=True)
class Variant:
    """A row of the table: the model's configuration and what its batches are made into."""

    config: MDMConfig
    prepare: Callable[[Clip], Clip]


def points_only(clip: Clip) -> Clip:
    """The published condition: colour and depth of the points, 0 where none was seen; no class, no warped image."""
    if clip.point_color is None:
        raise ValueError("the clips were made without point colours")
    given = clip.condition
    seen = given.valid.float()
    points = Condition(given.views, clip.point_color * seen, given.depth * seen, given.valid, given.reference)
    return replace(clip, condition=points)


def nothing_seen(clip: Clip) -> Clip:
    """As `points_only`, without the points."""
    empty = points_only(clip).condition
    nothing = {name: torch.zeros_like(getattr(empty, name)) for name in ("color", "depth", "valid")}
    return replace(clip, condition=replace(empty, **nothing))


VARIANTS: dict[str, Variant] = {
    "reference only": Variant(MDMConfig(**_PUBLISHED, reference="first_frame"), nothing_seen),
    "sparse only": Variant(MDMConfig(**_PUBLISHED, reference="none"), points_only),
    "concatenated": Variant(MDMConfig(**_PUBLISHED, reference="concatenated"), points_only),
    "frame 0": Variant(MDMConfig(**_PUBLISHED, reference="first_frame"), points_only),
    "ours": Variant(MDMConfig(**_SMALL, refine_widths=(32, 64)), lambda batch: batch),
}


def measure(config: BenchConfig, out: Path) -> tuple[dict[str, Any], str]:
    """Train and score all variants; returns the numbers and a table."""
    folder, cities = out / "clips", from_city.LISTS[config.cities][: config.count]
    training = _learn_config(config, folder)
    rules = CityClipRules(WIDTH, HEIGHT, clips=4, seed=config.seed, point_colors=True)
    from_city.write_missing(rules, [*cities, *range(config.ablation_cities)], folder)
    bf16 = choose_bf16(config.precision)
    rows: dict[str, Any] = {}
    for name, variant in VARIANTS.items():
        model = _trained(name, variant, training, bf16)
        rows[name] = learn_score.score(
            model, cities, folder, {"steps": 4, "seed": config.seed, "bf16": bf16}, prepare=variant.prepare,
            picture=out / f"{name.replace(' ', '_')}.png",
        )["average"]  # fmt: skip
        log.info(f"{name}: PSNR {rows[name]['psnr']:.2f} dB, AbsRel {rows[name]['abs_rel']:.3f}, mIoU {rows[name]['miou']:.3f}")
    return {"cities": list(cities), "training_steps": config.ablation_steps, "rows": rows}, _table(rows, config)


def _learn_config(config: BenchConfig, folder: Path) -> LearnConfig:
    return LearnConfig(
        seed=config.seed, steps=config.ablation_steps,
        data=LearnData(
            cities=config.ablation_cities, first_cities=config.ablation_cities, clips=str(folder), width=WIDTH, height=HEIGHT,
            reference_dropout=0.0,
        ),
        optimizer=LearnOptimizer(full_window_share=0.2), compute=LearnCompute(workers=0),
    )  # fmt: skip


def _trained(name: str, variant: Variant, config: LearnConfig, bf16: bool) -> MDM:
    """A model of the variant after the training steps; codec of the shipped model, weights drawn from the seed."""
    model = MDM(variant.config)
    model.codec.load_state_dict(mdm.load("embedded").codec.state_dict())
    model.codec.requires_grad_(False)
    draw_weights(model.net, config.seed, "ablation weights")
    if model.refiner is not None:
        draw_weights(model.refiner, config.seed, "ablation refiner weights")
        model.refiner.reset()
    trained = [p for n, p in model.named_parameters() if not n.startswith("codec.")]
    optimizer = torch.optim.AdamW(trained, lr=config.optimizer.lr, betas=(0.9, 0.99), weight_decay=0.01)
    with log.task(name, config.steps) as bar:
        for step in range(config.steps):
            optimizer.param_groups[0]["lr"] = learn.learning_rate(config, step)
            frames = learn.frames_at(config, step)
            count = max(1, config.optimizer.batch_frames // frames)
            clips = learn.draw_clips(config, Path(config.data.clips), step, count, frames, "ablation batch")
            with torch.autocast("cpu", torch.bfloat16, enabled=bf16):
                losses = model(
                    [variant.prepare(clip) for clip in clips], BatchPart(config.seed, step, 0, count), LossSettings(refined_share=1.0)
                )
            optimizer.zero_grad(set_to_none=True)
            losses.total.backward()
            norm = float(torch.nn.utils.clip_grad_norm_(trained, 1.0))
            if not math.isfinite(norm):
                raise NumericsError("the gradient is not finite", where=f"{name}, step {step}", got=str(norm))
            optimizer.step()
            bar.update(f"loss {float(losses.total.detach()):.3f}")
            bar.advance()
    return model.eval()


def _table(rows: dict[str, Any], config: BenchConfig) -> str:
    lines = [
        f"# Conditions compared: {config.ablation_steps} training steps each, {WIDTH}x{HEIGHT}, {config.count} held-out cities", "",
        "| condition | PSNR dB | SSIM | AbsRel | delta1 | mIoU | flicker |", "|---|---|---|---|---|---|---|",
    ]  # fmt: skip
    for name, row in rows.items():
        values = (("psnr", ".2f"), ("ssim", ".3f"), ("abs_rel", ".3f"), ("delta1", ".3f"), ("miou", ".3f"), ("flicker", ".2f"))
        lines.append(f"| {name} | " + " | ".join(format(row.get(key, math.nan), how) for key, how in values) + " |")
    return "\n".join(lines) + "\n"
