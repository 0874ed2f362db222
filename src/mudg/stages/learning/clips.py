"""The clips that `learn` trains on: made if they are missing, and drawn for a step as a pure function of (seed, step)."""

from __future__ import annotations

import concurrent.futures
import time
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from mudg.base import log, seeds
from mudg.base.errors import InputError, ResourceError
from mudg.base.processes import child_environment, process_pool, run_in_processes
from mudg.base.types import Clip
from mudg.data.clips import from_city, from_log
from mudg.data.clips import shards as clip_shards
from mudg.data.clips.from_log import LogClipRules, LogSource, LogWindow
from mudg.data.scene import read_scene
from mudg.models.diffusion import sized_to_area
from mudg.models.mdm.codec import CLASSES
from mudg.stages.config import LearnConfig
from mudg.stages.learning import city_fits


def held_out_cities(config: LearnConfig) -> list[int]:
    """Numbers of the shards used for scoring only."""
    return [from_city.HELD_OUT + n for n in range(config.data.held_out)]


def cities_in_use(config: LearnConfig, step: int) -> range:
    """Cities that training may draw from at `step`: `first_cities`, then linearly up to `cities` at `all_cities_at`, after those skipped.

    A function of the step alone, so that clips can still be in the making while training runs and the draw stays the
    same in every run.
    """
    data = config.data
    share = min(1.0, step / max(1.0, data.all_cities_at * config.steps))
    count = min(data.cities, data.first_cities + int((data.cities - data.first_cities) * share))
    return range(data.skip_cities, data.skip_cities + count)


# cities ---------------------------------------------------------------------------------------------------------------


def clip_rules(config: LearnConfig, points_alone: bool = False) -> from_city.CityClipRules:
    """Rules for the generator; `points_alone`: the published system's condition."""
    data = config.data
    return from_city.CityClipRules(
        data.width, data.height, data.window, config.seed, data.clips_per_city, published=points_alone,
        realism=data.realism, textures=data.textures,
        fitted=data.renders and not points_alone, near_points=data.condition == "freevs",
        weathers=data.weathers if data.renders and not points_alone else 0,
        log_frames=data.log_frames, side_cameras=data.side_cameras, fit_steps=data.fit_steps,
    )


def without_renders(config: LearnConfig) -> LearnConfig:
    """The configuration for a model that uses no renders: no city has to be fitted."""
    return replace(config, data=replace(config.data, renders=False))


class MakingClips:
    """Processes that make the missing clips of cities, held-out ones first, while the block runs."""

    def __init__(self, config: LearnConfig, folder: Path, points_alone: bool = False) -> None:
        self._rules, self._folder = clip_rules(config, points_alone), folder
        wanted = [*held_out_cities(config), *(config.data.skip_cities + n for n in range(config.data.cities))]
        self._missing = [n for n in wanted if not clip_shards.shard_path(folder, n).is_file()]
        self._workers = config.compute.workers
        self._pool: concurrent.futures.ProcessPoolExecutor | None = None
        self._futures: list[concurrent.futures.Future[int]] = []

    def __enter__(self) -> None:
        if not self._missing or self._workers == 0:
            return
        log.info(f"learn: {len(self._missing)} cities to generate into {self._folder}, {self._workers} processes")
        self._pool = process_pool(self._workers)
        with child_environment(1):
            make = city_fits.write_fitted_city if self._rules.fitted else from_city.write_city
            self._futures = [self._pool.submit(make, self._rules, n, self._folder) for n in self._missing]
        for future in self._futures:
            future.add_done_callback(_stop_all_on_error(self._futures))

    def __exit__(self, *_: object) -> None:
        if self._pool is not None:
            self._pool.shutdown(wait=True, cancel_futures=True)
        for future in self._futures:
            if not future.cancelled() and future.exception() is not None:
                raise future.exception()  # type: ignore[misc]


def _stop_all_on_error(futures: list[concurrent.futures.Future[int]]) -> Any:
    def stop(done: concurrent.futures.Future[int]) -> None:
        if not done.cancelled() and done.exception() is not None:
            for other in futures:
                other.cancel()

    return stop


def await_shard(folder: Path, city: int, patience_s: float = 900.0) -> None:
    """Wait until a shard is there (it is being made by another process)."""
    path = clip_shards.shard_path(folder, city)
    started = time.monotonic()
    while not path.is_file():
        if time.monotonic() - started > patience_s:
            raise ResourceError("no training clips arrived", where=str(path), expected=f"within {patience_s:.0f} s",
                                remedy="see the errors of the generating processes above")  # fmt: skip
        time.sleep(0.5)


# logs -----------------------------------------------------------------------------------------------------------------


def log_rules(config: LearnConfig, sources: list[LogSource], multiple: int, points_alone: bool = False) -> LogClipRules:
    """How clips are cut from logs: of the configuration's area, in the aspect of the first log's first camera.

    `points_alone`: with the published system's condition, and of the configuration's very size, whatever the aspect.
    """
    scene = read_scene(sources[0].scene)
    names = config.data.cameras or tuple(scene.cameras)
    if names[0] not in scene.cameras:
        raise InputError("the scene has no such camera", where=f"--data.cameras, {scene.root}",
            expected=", ".join(scene.cameras), got=names[0])  # fmt: skip
    camera = scene.cameras[names[0]]
    width, height = sized_to_area(config.data.width * config.data.height, camera.width / camera.height, multiple)
    if points_alone:
        width, height = config.data.width, config.data.height
    return LogClipRules(
        width=width, height=height, window=config.data.window, stride=config.data.stride, frame_step=config.data.frame_step,
        cameras=config.data.cameras, held_out_every=config.data.held_out_every, label_confidence=config.data.label_confidence,
        seed=config.seed, published=points_alone,
    )  # fmt: skip


def make_log_clips(config: LearnConfig, rules: LogClipRules, folder: Path) -> tuple[int, int]:
    """Make the missing clips of all logs; returns how many there are to train on and to score."""
    sources = [from_log.log_source(text) for text in config.data.scenes]
    rows = from_log.plan_shards(sources, rules, from_city.HELD_OUT)
    from_log.claim_folder(folder, rules, sources)
    jobs: list[tuple[LogSource, LogClipRules, list[tuple[int, LogWindow]], Path]] = []
    for source in dict.fromkeys(sources):
        windows = [(number, window) for number, owner, window in rows if owner == source]
        jobs.append((source, rules, windows, folder))
    with log.task("clips of logs", len(jobs)) as bar:
        if config.compute.workers < 2 or len(jobs) == 1:
            for job in jobs:
                from_log.write_log(*job)
                bar.advance()
        else:
            for _ in run_in_processes(from_log.write_log, jobs, config.compute.workers):
                bar.advance()
    scored = sum(window.held_out for _, _, window in rows)
    return len(rows) - scored, scored


def for_logs(config: LearnConfig, rules: LogClipRules, train: int, scored: int) -> LearnConfig:
    """The configuration in terms of shards: clips of logs lie as those of cities do, one clip per shard."""
    if not scored:
        log.warn("learn: no clip is held out; the scored clip was also trained on")
    data = replace(
        config.data, cities=train, first_cities=train, clips_per_city=1, width=rules.width, height=rules.height,
        held_out=max(1, scored), skip_cities=0,
    )  # fmt: skip
    return replace(config, data=data, score=replace(config.score, watched=min(config.score.watched, max(1, scored))))


def scored_shards(config: LearnConfig) -> list[int]:
    """Numbers of the shards to score: the held-out ones, or the first one trained on where nothing was held out."""
    return [0] if config.data.scenes and not config.data.held_out_every else held_out_cities(config)


def describe_logs(config: LearnConfig, rules: LogClipRules) -> str:
    """A sentence on the training data for the model card."""
    given = "the projected points and the first image" if rules.published else "images taken at other times"
    return (
        f"{config.data.cities} clips of {config.data.window} frames of {len(config.data.scenes)} recorded "
        f"{'log' if len(config.data.scenes) == 1 else 'logs'} at {rules.width}x{rules.height} pixels, seen from where they were\n"
        f"recorded, with {given} as condition. Depth was learned where a sweep measured it. The model this\n"
        f"one continues from has training data of its own. `held-out` below means every {config.data.held_out_every}. window of these logs."
    )


# a step's clips -------------------------------------------------------------------------------------------------------


def of_one_size(config: LearnConfig) -> LearnConfig:
    """The configuration for clips that were made of one size, as the published system needs them, however varied the cities are."""
    return replace(config, data=replace(config.data, realism="plain"))


def sizes_of_cities(config: LearnConfig) -> list[tuple[int, int]]:
    """Sizes of the clips to train on: shard number n has the n-th, counted round."""
    if config.data.realism == "plain" or config.data.scenes:
        return [(config.data.width, config.data.height)]
    rules = clip_rules(config)
    return [from_city.size_of(rules, city) for city in range(from_city.SIZES)]


def _of_same_size(city: int, first: int, sizes: list[tuple[int, int]], cities: range) -> int:
    """The city of the first one's size next to `city`, out of `cities`."""
    near = city - city % len(sizes) + first % len(sizes)
    return next((n for n in (near, near - len(sizes), near + len(sizes)) if n in cities), first)


def draw_clips(
    config: LearnConfig, folder: Path, step: int, count: int, frames: int, purpose: str, part: slice | None = None
) -> list[Clip]:
    """The clips of a step: random shards, clips and runs of consecutive frames, varied (see `clip_shards.vary`).

    What is drawn for a clip depends on (seed, step, purpose) and the clip's place in the batch of `count`, and not on which
    `part` of that batch is drawn here. All clips of a step have one size: that of its first clip.
    """
    rng = seeds.numpy_rng(config.seed, step, purpose)
    picks: list[tuple[int, int, range]] = []
    sizes, cities = sizes_of_cities(config), cities_in_use(config, step)
    for _ in range(count):
        city = cities[int(rng.integers(len(cities)))]
        city = city if not picks else _of_same_size(city, picks[0][0], sizes, cities)
        await_shard(folder, city)
        number = int(rng.integers(clip_shards.clips_in(folder, city)))
        start = int(rng.integers(config.data.window - frames + 1))
        picks.append((city, number, range(start, start + frames)))
    clips = []
    for place in range(count)[part or slice(None)]:
        clip = clip_shards.read_clip(folder, *picks[place])
        width, height = sizes[picks[place][0] % len(sizes)]
        if clip.rgb.shape[-2:] != (height, width):
            raise InputError(
                "the training clips have another size", where=str(clip_shards.shard_path(folder, picks[place][0])),
                expected=f"{width}x{height}", got=f"{clip.rgb.shape[-1]}x{clip.rgb.shape[-2]}",
                remedy="choose another --data.clips",
            )  # fmt: skip
        if config.data.augment:
            clip = clip_shards.vary(clip, seeds.numpy_rng(config.seed, step, f"{purpose}, clip {place}"))
        clips.append(clip)
    return clips


def have_patches(folder: Path, city: int = 0) -> bool:
    """Whether the clips have patches at a higher resolution; seen in the first one of a city."""
    await_shard(folder, city)
    return clip_shards.read_clip(folder, city, 0, range(1)).fine is not None


def class_weights(folder: Path, cities: Iterable[int], balance: float) -> Tensor:
    """Weights f32[19] of the classes in the semantic loss: share^-balance, counted over some cities.

    Scaled so that the mean over labelled pixels is 1; a class that never occurs weighs as much as the rarest that does.
    """
    counts = torch.zeros(256, dtype=torch.float64)
    for city in cities:
        await_shard(folder, city)
        ids = clip_shards.read_clip(folder, city, 0, range(1)).semantics
        counts += torch.bincount(ids.flatten(), minlength=256)
    if not bool(counts[:CLASSES].any()):  # logs without labels
        return torch.ones(CLASSES)
    share = counts[:CLASSES] / counts[:CLASSES].sum().clamp(min=1)
    floor = max(float(share[share > 0].min()) if bool((share > 0).any()) else 1.0, 1e-3)
    weight = share.clamp(min=floor) ** -balance
    return (weight / (weight * share).sum().clamp(min=1e-9)).float()
