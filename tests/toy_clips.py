"""Made-up training clips and a configuration small enough to train in a moment."""

from __future__ import annotations

import contextlib
import json
import signal
from collections.abc import Callable, Iterator
from dataclasses import fields, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch

from mudg.base.types import Camera, Clip, Condition, FinePatch, RenderPlanes, View
from mudg.diffusion.city_clips import HELD_OUT
from mudg.diffusion.clips import write_shard
from mudg.diffusion.learn import DrawingAhead
from mudg.diffusion.network import ConditionPixels
from mudg.diffusion.settings import LearnCodec, LearnConfig

WIDTH, HEIGHT, WINDOW = 48, 32, 4


def some_ids(generator: torch.Generator, frames: int, height: int, width: int) -> torch.Tensor:
    """Classes 0 to 18, and one in five unknown."""
    ids = torch.randint(0, 19, (frames, 1, height, width), generator=generator, dtype=torch.uint8)
    return torch.where(torch.rand(ids.shape, generator=generator) < 0.2, torch.full_like(ids, 255), ids)


def some_condition(frames: int = 3, height: int = 16, width: int = 24, seed: int = 0) -> Condition:
    """A condition of random numbers."""
    generator = torch.Generator().manual_seed(seed)
    camera = Camera("front", width, height, 20.0, 20.0, width / 2, height / 2)
    views = tuple(View(camera, np.eye(4), 0.1 * t) for t in range(frames))
    draw = lambda *shape: torch.rand(*shape, height, width, generator=generator)
    color, depth, valid = draw(frames, 3), 3 + 60 * draw(frames, 1), draw(frames, 1) > 0.5
    reference, warped, backdrop = draw(3), draw(frames, 1) > 0.3, draw(frames, 3)
    ids = [some_ids(generator, frames, height, width) for _ in range(2)]
    return Condition(views, color, depth, valid, reference, warped, backdrop, *ids)


def some_clip() -> Clip:
    """A clip of random numbers; a part of its depth is not true."""
    generator = torch.Generator().manual_seed(1)
    rgb, depth = (torch.rand(3, channels, 16, 24, generator=generator) for channels in (3, 1))
    ids = torch.randint(0, 19, (3, 16, 24), generator=generator)
    return Clip(some_condition(), rgb, 80 * depth, depth > 0.06, ids)


def some_pixels(height: int, width: int, frames: int = 2, seed: int = 0) -> ConditionPixels:
    """A condition of random pixels, with renders."""
    generator = torch.Generator().manual_seed(seed)
    image = lambda c: torch.rand(frames, c, height, width, generator=generator) * 2 - 1
    mask = lambda: (image(1) > 0).float()
    ids = lambda: torch.randint(0, 19, (frames, 1, height, width), generator=generator, dtype=torch.uint8)
    own = image(3), image(3), image(1), mask(), mask(), ids(), ids()
    return ConditionPixels(*own, image(3), image(1), mask(), image(1).abs(), ids())


def made_up_clip(seed: int, width: int = WIDTH, height: int = HEIGHT) -> Clip:
    """A clip with structure: a horizon, a box, a noisy half-seen condition."""
    generator = torch.Generator().manual_seed(seed)
    rows = torch.arange(height).view(1, 1, height, 1).expand(WINDOW, 1, height, width)
    color = torch.rand(2, 3, 1, 1, generator=generator)
    rgb = torch.where(rows < 12, color[0], color[1])
    depth = torch.where(rows < 12, torch.tensor(1000.0), 200.0 / (rows - 8).clamp(min=1).float())
    ids = torch.where(rows < 12, 10, 0)[:, 0].clone()
    box = int(torch.randint(4, width - 14, (), generator=generator))
    rgb[:, :, 8:20, box : box + 10] = torch.rand(3, 1, 1, generator=generator)
    depth[:, :, 8:20, box : box + 10] = 9.0
    ids[:, 8:20, box : box + 10] = 13
    valid = torch.rand(depth.shape, generator=generator) > 0.4
    camera = Camera("front", width, height, 40.0, 40.0, width / 2, height / 2)
    views = tuple(View(camera, np.eye(4), 0.1 * t) for t in range(WINDOW))
    seen = torch.where(valid, rgb, torch.rand(rgb.shape, generator=generator))
    alpha = (depth < 500).float()
    renders = RenderPlanes((rgb + 0.05).clamp(max=1), depth, alpha, 0.5 * alpha, ids[:, None].to(torch.uint8))
    condition = Condition(
        views, seen, torch.where(valid, depth, 20.0).clamp(max=100), valid, rgb[0], valid, rgb, renders=renders
    )
    return Clip(condition, rgb, depth, depth < 500, ids)


def part_of(x: torch.Tensor, row: int, column: int, side: int = 12, scale: int = 2) -> torch.Tensor:
    """What a patch made by `with_patch` shows of an image of its clip."""
    cut = x[..., row : row + side, column : column + side]
    return cut.repeat_interleave(scale, -1).repeat_interleave(scale, -2)


def with_patch(clip: Clip, row: int = 6, column: int = 10, side: int = 12, scale: int = 2) -> Clip:
    """The clip with a patch that shows a square of it `scale` times finer (and no more sharply)."""

    finer = partial(part_of, row=row, column=column, side=side, scale=scale)
    c = clip.condition
    camera = Camera("front", side * scale, side * scale, 40.0 * scale, 40.0 * scale, side * scale / 2, side * scale / 2)
    assert c.renders is not None
    names = ("color", "depth", "valid", "reference", "warped", "backdrop", "semantics", "backdrop_semantics")
    given = {name: finer(tensor) for name in names if (tensor := getattr(c, name)) is not None}
    views = tuple(View(camera, v.world_from_cam, v.time_s) for v in c.views)
    condition = Condition(views=views, **given, renders=c.renders.map(finer))
    own = {name: finer(getattr(clip, name)) for name in ("rgb", "depth", "depth_valid", "semantics")}
    return replace(clip, fine=FinePatch(Clip(condition, **own), row, column, scale))


def write_clips(folder: Path, width: int = WIDTH, height: int = HEIGHT, *, points: bool = False) -> Path:
    """Three shards to train on and one to score, two clips each; `points`: of points alone, and one to score."""
    for number in [*range(3), HELD_OUT]:
        made = [with_patch(made_up_clip(number * 7 + k, width, height)) for k in range(2)]
        made = [points_alone(clip) for clip in made[: 1 if number == HELD_OUT else 2]] if points else made
        made = [replace(clip, shift_m=shift) for clip, shift in zip(made, (2.0, 0.0), strict=False)]
        write_shard(folder, number, made)
    return folder


def points_alone(clip: Clip) -> Clip:
    """The clip with the published system's condition: 0 where nothing was seen, nothing warped in."""
    c = clip.condition
    return replace(
        clip, condition=Condition(c.views, c.color * c.valid, c.depth * c.valid, c.valid, c.reference), fine=None
    )


def with_settings(config: LearnConfig, **changes: Any) -> LearnConfig:
    """The configuration with settings changed by their own names, whichever group they are in (group `score`:
    `score_NAME`)."""
    for name, value in changes.items():
        if name in {f.name for f in fields(config)}:
            config = replace(config, **{name: value})
            continue
        group, own = ("score", name[6:]) if name.startswith("score_") else (GROUPS[name], name)
        config = replace(config, **{group: replace(getattr(config, group), **{own: value})})
    return config


GROUPS = {
    field.name: group
    for group in ("data", "network", "optimizer", "loss", "compute")
    for field in fields(getattr(LearnConfig(), group))
}


def tiny(clips: Path | str, **changes: Any) -> LearnConfig:
    """A run of four steps of a network with a few thousand weights on the clips of `write_clips`."""
    config = with_settings(
        LearnConfig(codec=LearnCodec(steps=3, batch=2, fit_batches=1)),
        cities=3,
        first_cities=2,
        clips_per_city=2,
        held_out=1,
        score_watched=1,
        clips=str(clips),
        workers=0,
        precision="float32",
        width=WIDTH,
        height=HEIGHT,
        window=WINDOW,
        widths=(16, 32),
        blocks=(1, 1),
        spatial_attention=(False, True),
        temporal_attention=(False, True),
        refine_widths=(8, 16),
        refine_blocks=(1, 1),
        finish_widths=(8, 16),
        finish_blocks=(1, 1),
        steps=4,
        batch_frames=4,
        full_window_share=0.5,
        warmup_steps=1,
        checkpoint_every=2,
        score_every=100,
        score_steps=1,
    )
    return with_settings(config, **changes)


@contextlib.contextmanager
def before_each_batch(act: Callable[[int], None]) -> Iterator[None]:
    """Within, `act(step)` is called before the clips of a step are taken."""
    take = DrawingAhead.take

    def acted(self: DrawingAhead, step: int) -> list[list[Clip]]:
        act(step)
        return take(self, step)

    DrawingAhead.take = acted
    try:
        yield
    finally:
        DrawingAhead.take = take


def interrupted_at(step: int) -> contextlib.AbstractContextManager[None]:
    """Within, the user interrupts a training during this step."""
    return before_each_batch(lambda now: signal.raise_signal(signal.SIGINT) if now == step else None)


def losses_of(out: Path) -> dict[int, float]:
    """The loss of each step of a training; of one that was repeated after a restart, the last."""
    rows = [json.loads(line) for line in (out / "log.jsonl").read_text().splitlines()]
    return {row["step"]: row["total"] for row in rows if "total" in row}
