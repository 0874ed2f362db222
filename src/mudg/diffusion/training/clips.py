"""The clips that `learn` trains on: made if they are missing, and drawn for a step as a pure function of (seed,
step)."""

from __future__ import annotations

import concurrent.futures
import contextlib
import math
import os
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import torch
from torch import Tensor

from mudg.base import log, seeds, store
from mudg.base.config import result_settings
from mudg.base.errors import InputError, ResourceError, UsageError
from mudg.base.location import Location
from mudg.base.processes import calls_beside, run_in_processes
from mudg.base.run_folder import RunDir
from mudg.base.types import Clip, RenderPlanes, View
from mudg.diffusion.clips import from_city, from_log
from mudg.diffusion.clips import shards as clip_shards
from mudg.diffusion.clips.condition import RenderAt
from mudg.diffusion.clips.from_city import CityClipRules, CityLog
from mudg.diffusion.clips.from_log import LogClipRules, LogSource, LogWindow
from mudg.diffusion.clips.shards import ShardSource
from mudg.diffusion.clips.sources import ShardCache, StreamedShards
from mudg.diffusion.requests import sized_to_area
from mudg.diffusion.settings.learn import LearnConfig
from mudg.diffusion.training.scene_list import ListedShards, is_list, read_list
from mudg.gaussians import fit
from mudg.gaussians.rendering import render_planes
from mudg.gaussians.schedule import short_fit
from mudg.networks.codec import CLASSES
from mudg.scene.clouds import write_fused
from mudg.scene.read import read_scene
from mudg.scene.write import PlacedSweep, write_photos

# city fits ----------------------------------------------------------------------------------------
#
# Short fits to generated cities, whose renders become part of the conditions that the diffusion model is trained on.


def write_fitted_city(rules: CityClipRules, city: int, folder: Path) -> int:
    """Make one city's clips with renders of a fit and write its shard; returns the number of clips. For a process of
    its own."""
    return from_city.write_city(rules, city, folder, fit_city)


def fit_city(rules: CityClipRules, city: int, log: CityLog) -> RenderAt:
    """Fit a scene to the images that the clips of a city may know; returns what it shows at a view."""
    steps = steps_of(rules, city)
    width = from_city.size_of(rules, city)[0]
    images = from_city.given_images(rules, city, log)
    config = short_fit(steps, width, images[0].view.camera.width, seed=city)
    with tempfile.TemporaryDirectory() as text:
        folder = Path(text)
        write_photos(
            folder / "scene", log.world.source(), log.world.ego_path(), log.tracks(), images, placed_sweeps(log)
        )
        write_fused(folder / "fused", log.cloud, {})
        work = RunDir.open(folder / "fit", fit.OUTPUT, result_settings(config), {})
        fit.write_fit(config, fit.FitInputs(folder / "scene", folder / "fused"), work)
        model = fit.load_model(work.path)

    def render_at(view: View) -> RenderPlanes:
        return render_planes(model, view)

    return render_at


def steps_of(rules: CityClipRules, city: int) -> int:
    """Steps of a city's fit, drawn from `rules.fit_steps`, because renders of logs are of different quality, too."""
    fewest, most = rules.fit_steps
    if city >= from_city.HELD_OUT or fewest == most:
        return (fewest + most) // 2
    return int(seeds.numpy_rng(rules.seed, city, "fit").integers(fewest, most))


def placed_sweeps(log: CityLog) -> Iterator[PlacedSweep]:
    """The sweeps of a generated log; a second one at the same time comes from a second sensor."""
    last_s = -math.inf
    for sweep in log.sweeps:
        yield "lidar_second" if sweep.time_s == last_s else "lidar", sweep.time_s, sweep.world_from_lidar, sweep.points
        last_s = sweep.time_s


# clips --------------------------------------------------------------------------------------------


CACHE = "cache"
"""Where in the output folder clips are kept that are fetched or made when they are needed, while training runs."""


def held_out_cities(config: LearnConfig) -> list[int]:
    """Numbers of the shards used for scoring only."""
    return [from_city.HELD_OUT + n for n in range(config.data.held_out)]


def cities_in_use(config: LearnConfig, step: int) -> range:
    """Cities that training may draw from at `step`: `first_cities`, then linearly up to `cities` at `all_cities_at`,
    after those skipped.

    A function of the step alone, so that clips can still be in the making while training runs and the draw stays the
    same in every run.
    """
    data = config.data
    share = min(1.0, step / max(1.0, data.all_cities_at * config.steps))
    count = min(data.cities, data.first_cities + int((data.cities - data.first_cities) * share))
    return range(data.skip_cities, data.skip_cities + count)


# cities -------------------------------------------------------------------------------------------


def clip_rules(config: LearnConfig, points_alone: bool = False) -> from_city.CityClipRules:
    """Rules for the generator; `points_alone`: the published system's condition."""
    data = config.data
    return from_city.CityClipRules(
        data.width,
        data.height,
        data.window,
        config.seed,
        data.clips_per_city,
        published=points_alone,
        realism=data.realism,
        textures=data.textures,
        fitted=data.renders and not points_alone,
        near_points=data.condition == "freevs",
        log_frames=data.log_frames,
        side_cameras=data.side_cameras,
        fit_steps=data.fit_steps,
    )


def without_renders(config: LearnConfig) -> LearnConfig:
    """The configuration for a model that uses no renders: no city has to be fitted."""
    return replace(config, data=replace(config.data, renders=False))


def making_clips(
    config: LearnConfig, folder: Path, points_alone: bool = False
) -> contextlib.AbstractContextManager[None]:
    """A block while which processes make the missing clips of cities, held-out ones first (see ``calls_beside``)."""
    rules = clip_rules(config, points_alone)
    wanted = [*held_out_cities(config), *(config.data.skip_cities + n for n in range(config.data.cities))]
    missing = [n for n in wanted if not clip_shards.shard_path(folder, n).is_file()]
    for number in set(wanted).difference(missing):
        # a damaged one is found before the training begins
        clip_shards.clips_at(clip_shards.shard_path(folder, number))
    if not missing or config.compute.workers == 0:
        return contextlib.nullcontext()
    store.make_folder(folder)
    if not os.access(folder, os.W_OK):
        raise ResourceError(
            "training clips cannot be written here", where=str(folder), remedy="choose another --data.clips"
        )
    log.info(f"learn: {len(missing)} cities to generate into {folder}, {config.compute.workers} processes")
    make = write_fitted_city if rules.fitted else from_city.write_city
    return calls_beside(make, [(rules, n, folder) for n in missing], config.compute.workers)


def await_shard(folder: Path | ShardSource, city: int, patience_s: float = 900.0) -> None:
    """Wait until a shard is there (it is being made by another process). One of another source is brought when it is
    read."""
    if not isinstance(folder, Path):
        return
    path = clip_shards.shard_path(folder, city)
    started = time.monotonic()
    while not path.is_file():
        if time.monotonic() - started > patience_s:
            raise ResourceError(
                "no training clips arrived",
                where=str(path),
                expected=f"within {patience_s:.0f} s",
                remedy="see the errors of the generating processes above",
            )
        time.sleep(0.5)


# logs ---------------------------------------------------------------------------------------------


def log_rules(config: LearnConfig, sources: list[LogSource], multiple: int, points_alone: bool = False) -> LogClipRules:
    """How clips are cut from logs: of the configuration's area, in the aspect of the first log's first camera.

    `points_alone`: with the published system's condition, and of the configuration's very size, whatever the aspect.
    """
    scene = read_scene(sources[0].scene)
    names = config.data.cameras or tuple(scene.cameras)
    if names[0] not in scene.cameras:
        raise InputError(
            "the scene has no such camera",
            where=f"--data.cameras, {scene.root}",
            expected=", ".join(scene.cameras),
            got=names[0],
        )
    camera = scene.cameras[names[0]]
    width, height = sized_to_area(config.data.width * config.data.height, camera.width / camera.height, multiple)
    if points_alone:
        width, height = config.data.width, config.data.height
    return _log_rules(config, (width, height), config.data.held_out_every, points_alone)


def _log_rules(config: LearnConfig, size: tuple[int, int], held_out_every: int, points_alone: bool) -> LogClipRules:
    data = config.data
    least_points = (
        (1.0 if points_alone else LogClipRules.least_points) if data.least_points is None else data.least_points
    )
    return LogClipRules(
        *size,
        window=data.window,
        stride=data.stride,
        cameras=data.cameras,
        held_out_every=held_out_every,
        seed=config.seed,
        published=points_alone,
        depth=data.depth,
        least_points=least_points,
    )


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
        config.data,
        cities=train,
        first_cities=train,
        clips_per_city=1,
        width=rules.width,
        height=rules.height,
        held_out=max(1, scored),
        skip_cities=0,
    )
    return replace(config, data=data, score=replace(config.score, watched=min(config.score.watched, max(1, scored))))


def scored_shards(config: LearnConfig, folder: Path | ShardSource) -> list[int]:
    """Numbers of the shards to score: the held-out ones, or the first one trained on where nothing was held out."""
    if isinstance(folder, ListedShards):
        return folder.scored()
    return [0] if config.data.scenes and not config.data.held_out_every else held_out_cities(config)


def describe_logs(config: LearnConfig, rules: LogClipRules) -> str:
    """A sentence on the training data for the model card."""
    given = "the projected points and the first image" if rules.published else "images taken at other times"
    elsewhere = ", and from labels elsewhere" if rules.depth == "annotated" else ""
    return (
        f"{config.data.cities} clips of {config.data.window} frames of {len(config.data.scenes)} recorded"
        f" {'log' if len(config.data.scenes) == 1 else 'logs'} at {rules.width}x{rules.height} pixels, seen from where"
        f" they were\nrecorded, with {given} as condition. Depth was learned where a sweep measured it{elsewhere}. The"
        " model this\none continues from has training data of its own. `held-out` below means every"
        f" {config.data.held_out_every}. window of these logs."
    )


# clips that are fetched or made when they are needed ----------------------------------------------


def clips_at_address(config: LearnConfig) -> bool:
    """Whether the setting `clips` is an address in an object store."""
    return bool(config.data.clips) and Location.of(config.data.clips).local is None


def is_streamed(config: LearnConfig) -> bool:
    """Whether clips are not all in one folder of this machine before training starts.

    Raises:
        UsageError: settings that do not go together.
    """
    listed, remote = is_list(config.data.scenes), clips_at_address(config)
    if remote and config.data.scenes:
        raise UsageError(
            "logs and clips at an address are given",
            where="--data.scenes, --data.clips",
            got=config.data.clips,
            remedy="leave one out; a list of scenes may name folders of clips at addresses",
        )
    if listed and config.data.clips:
        raise UsageError(
            "a list of scenes says where the clips are",
            where="--data.clips",
            got=config.data.clips,
            remedy="leave it out; --compute.cache chooses where clips that were made or fetched are kept",
        )
    return listed or remote


def open_streamed(
    config: LearnConfig, out: Path, multiple: int, points_alone: bool
) -> tuple[LearnConfig, StreamedShards | ListedShards]:
    """The clips at the address of `clips` or of the listed scenes, and the configuration with the size that they
    have."""
    cache = ShardCache(
        Path(config.compute.cache) if config.compute.cache else out / CACHE, int(config.compute.cache_gb * 1e9)
    )
    if not config.data.scenes:
        return config, StreamedShards(Location.of(config.data.clips), cache, config.data.clips_per_city)
    data = config.data
    if not points_alone:
        data = replace(
            data, width=round(data.width / multiple) * multiple, height=round(data.height / multiple) * multiple
        )
    rules = _log_rules(config, (data.width, data.height), 0, points_alone)
    scenes = read_list(data.scenes[0], data.held_out)
    log.info(*f"learn: {data.scenes[0]}: {scenes.summary()}".splitlines())
    return replace(config, data=data), ListedShards(scenes, cache, rules, data.bad_scenes)


def weighed_shards(config: LearnConfig, folder: Path | ShardSource) -> Sequence[int]:
    """Shards over which classes are counted: the first cities, or some that are drawn from a list, where classes are
    balanced."""
    if not isinstance(folder, ListedShards):
        return cities_in_use(config, 0)[:20]
    count = 20 if config.loss.class_balance else 0
    return [folder.draw(seeds.numpy_rng(config.seed, n, "class weights"), _with_clips(folder)) for n in range(count)]


def _with_clips(folder: ListedShards) -> Callable[[int], int]:
    def take(number: int) -> int:
        folder.clips_in(number)
        return number

    return take


def describe_list(config: LearnConfig, shards: ListedShards) -> str:
    """A sentence on the training data for the model card."""
    shares = ", ".join(f"{name} {100 * share:.3g} %" for name, share in list(shards.scenes.shares.items())[:20])
    return (
        f"clips of {config.data.window} frames of {len(shards.scenes.scenes)} listed scenes at "
        f"{config.data.width}x{config.data.height} pixels\n"
        f"({shares}). {len(shards.scenes.scored)} scenes were held out for scoring."
    )


# a step's clips -----------------------------------------------------------------------------------


def of_one_size(config: LearnConfig) -> LearnConfig:
    """The configuration for clips that were made of one size, as the published system needs them, however varied the
    cities are."""
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
    config: LearnConfig,
    folder: Path | ShardSource,
    step: int,
    count: int,
    frames: int,
    purpose: str,
    part: slice | None = None,
) -> list[Clip]:
    """The clips of a step: random shards, clips and runs of consecutive frames, varied (see `clip_shards.vary`).

    What is drawn for a clip depends on (seed, step, purpose) and the clip's place in the batch of `count`, and not on
    which `part` of that batch is drawn here, nor on where the shards come from. All clips of a step have one size: that
    of its first clip.
    """
    places = range(count)[part or slice(None)]
    if isinstance(folder, ListedShards):
        return [
            _varied(config, _listed_clip(config, folder, (step, place, purpose), frames), step, place, purpose)
            for place in places
        ]
    picks, sizes = _picks(config, folder, step, count, frames, purpose), sizes_of_cities(config)
    clips = []
    for place in places:
        clip = clip_shards.read_clip(folder, *picks[place])
        _refuse_size(clip, sizes[picks[place][0] % len(sizes)], folder, picks[place][0])
        clips.append(_varied(config, clip, step, place, purpose))
    return clips


def _picks(
    config: LearnConfig, folder: Path | ShardSource, step: int, count: int, frames: int, purpose: str
) -> list[tuple[int, int, range]]:
    """Shard, clip and frames for every place of a batch."""
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
    return picks


def _listed_clip(config: LearnConfig, folder: ListedShards, place: tuple[int, int, str], frames: int) -> Clip:
    """The clip of a listed scene for (step, place in the batch, purpose). A scene of another size is a bad one."""
    step, number, purpose = place
    chosen, start = seeds.numpy_rng(config.seed, step, f"{purpose}, frames {number}").random(2).tolist()

    def take(shard: int) -> Clip:
        clip = int(chosen * clip_shards.clips_in(folder, shard))
        first = int(start * (config.data.window - frames + 1))
        found = clip_shards.read_clip(folder, shard, clip, range(first, first + frames))
        _refuse_size(found, (config.data.width, config.data.height), folder, shard)
        return found

    return folder.draw(seeds.numpy_rng(config.seed, step, f"{purpose}, scene {number}"), take)


def _refuse_size(clip: Clip, size: tuple[int, int], folder: Path | ShardSource, shard: int) -> None:
    width, height = size
    if clip.rgb.shape[-2:] != (height, width):
        raise InputError(
            "the training clips have another size",
            where=str(clip_shards.shard_path(folder, shard)) if isinstance(folder, Path) else f"shard {shard}",
            expected=f"{width}x{height}",
            got=f"{clip.rgb.shape[-1]}x{clip.rgb.shape[-2]}",
            remedy="choose another --data.clips",
        )


def _varied(config: LearnConfig, clip: Clip, step: int, place: int, purpose: str) -> Clip:
    if not config.data.augment:
        return clip
    return clip_shards.vary(clip, seeds.numpy_rng(config.seed, step, f"{purpose}, clip {place}"))


def bring_shards(
    config: LearnConfig, folder: Path | ShardSource, step: int, count: int, frames: int, parts: Sequence[slice]
) -> None:
    """Fetch or make the shards that a process needs for its `parts` of a step, so that drawing them need not wait."""
    if isinstance(folder, Path):
        return
    places = [place for part in parts for place in range(count)[part]]
    if isinstance(folder, ListedShards):
        for place in places:
            folder.draw(seeds.numpy_rng(config.seed, step, f"batch, scene {place}"), folder.clips_in)
        return
    picks = _picks(config, folder, step, count, frames, "batch")
    for place in places:
        folder.reading(picks[place][0], lambda path: None)


class ReadingAhead:
    """Threads that bring the shards of the next steps while a step is computed. What fails there fails again when it is
    drawn.

    Args:
        bring: brings the shards of a step.
        depth: so many steps ahead. 0: nothing is brought.
        steps: of the training.
    """

    def __init__(self, bring: Callable[[int], None], depth: int, steps: int) -> None:
        self._bring, self._depth, self._steps, self._next = bring, depth, steps, 0
        self._pool = concurrent.futures.ThreadPoolExecutor(min(4, depth)) if depth else None

    def __enter__(self) -> ReadingAhead:
        return self

    def __exit__(self, *_: object) -> None:
        if self._pool is not None:
            self._pool.shutdown(wait=True, cancel_futures=True)

    def beyond(self, step: int) -> None:
        """Begin with what is missing for the steps after `step`."""
        self._next = max(self._next, step + 1)
        while self._pool is not None and self._next <= min(step + self._depth, self._steps - 1):
            self._pool.submit(self._bring, self._next)
            self._next += 1


def have_patches(config: LearnConfig, folder: Path | ShardSource, city: int = 0) -> bool:
    """Whether the clips have patches at a higher resolution; seen in the first one of a city."""
    if isinstance(folder, ListedShards):
        return _listed_clip(config, folder, (0, 0, "patches"), 1).fine is not None
    await_shard(folder, city)
    return clip_shards.read_clip(folder, city, 0, range(1)).fine is not None


def class_weights(folder: Path | ShardSource, cities: Iterable[int], balance: float) -> Tensor:
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
