"""A generated city as a scene directory; and whole logs for scoring scenes off the recorded path, in two lists. No
model was ever trained on them, and they are not picked by eye: seeds are walked upwards, and what has moving vehicles
(`facts`) is kept, half of it curved."""

from __future__ import annotations

import dataclasses
from collections.abc import Container
from pathlib import Path
from typing import Final

import numpy as np

from mudg.base import log
from mudg.base.errors import UsageError
from mudg.base.types import Scene
from mudg.city.config import CityConfig
from mudg.city.layout import plan_streets
from mudg.city.traffic import ego_keys
from mudg.city.world import CityWorld
from mudg.core.fusion import FusionRules, judge_track
from mudg.scene.write import SceneWriter

SENSOR = "lidar"


def write_city(config: CityConfig, out_dir: Path | str, *, test_every: int = 4) -> Scene:
    """Generate the log of ``config`` and write it, as lossless PNG, with its exact labels (depth, semantics, sky,
    dynamic, instance); returns the scene, read back. An interrupted call leaves nothing, and the same call makes the
    same bytes again. ``test_every``: hold out every n-th frame of all cameras (never the first); 0 = none.
    ResourceError: no native library, or the folder cannot be written. InputError: there is a scene here already.
    UsageError: ``test_every`` is negative."""
    if test_every < 0:
        raise UsageError("test_every cannot be negative", got=str(test_every))
    world = CityWorld(config)
    log.info(f"city {config.seed}: {world.describe()}")
    return write_world(world, out_dir, test_every)


def write_world(world: CityWorld, out_dir: Path | str, test_every: int = 4) -> Scene:
    """As ``write_city``, of a world that is there, such as one with objects elsewhere (``CityWorld.rearranged``)."""
    config = world.config
    moving = np.array([0, *(int(posed.moving) for posed in world.objects)], bool)
    split: dict[str, str] = {}
    with SceneWriter(out_dir, f"city-{config.seed}", world.source()) as writer:
        for camera in world.cameras().values():
            writer.add_camera(camera)
        writer.set_ego(world.ego_path())
        for track in world.tracks():
            writer.add_track(track)
        views = {name: world.frame_views(name) for name in config.cameras}
        with log.task("recording the city", config.n_frames * (len(views) + 1)) as progress:
            for index in range(config.n_frames):
                part = "test" if test_every > 0 and index > 0 and index % test_every == 0 else "train"
                for name in config.cameras:
                    frame_id, view = f"{name}/{index:06d}", views[name][index]
                    truth = world.render(view, sensor_noise=config.sensor_noise)
                    labels = {"depth": truth.depth, "semantics": truth.semantics, "sky": truth.sky}
                    labels |= {"dynamic": moving[truth.instance], "instance": truth.instance}
                    writer.add_frame(frame_id, view, truth.rgb_u8, labels)
                    split[frame_id] = part
                    progress.advance()
                sweep = world.lidar_sweep(index)
                writer.add_sweep(f"{SENSOR}/{index:06d}", SENSOR, sweep.time_s, sweep.world_from_lidar, sweep.points)
                progress.advance()
        writer.set_split(split)
        return writer.finish()


# logs ---------------------------------------------------------------------------------------------


STANDARD: Final = CityConfig(n_frames=24, width=384, height=256)
"""What a log is recorded with, whatever its seed."""
MOVING, SMALLEST_SHARE, FRAMES_SHARE, CURVED_DEG = 2, 1e-3, 0.25, 5.0
"""A log enters a list with so many moving vehicles in view of the front camera: they cover this share of the image, in
this share of the frames. Half of the list turns by at least this angle."""
VEHICLES: Final = frozenset({"car", "truck", "bus", "cyclist"})

DEVELOPMENT: tuple[int, ...] = (2100000, 2100001, 2100004, 2100007)
"""Logs to look at while choosing: the first of them on that qualify."""
REPORTED: tuple[int, ...] = (2100100, 2100101, 2100102, 2100103, 2100151, 2100154, 2100157, 2100242)
"""Logs whose scores are reported and on which nothing is chosen; found in the same way."""
LISTS: dict[str, tuple[int, ...]] = {"development": DEVELOPMENT, "reported": REPORTED}


def log_config(seed: int, rules: CityConfig = STANDARD) -> CityConfig:
    """The generator's configuration of a log. ``rules``: what it is recorded with."""
    return dataclasses.replace(rules, seed=seed)


def moving_instances(world: CityWorld, labels: Container[str] | None = None) -> tuple[int, ...]:
    """Instance ids of the objects that move during the log, by the test that also separates their clouds; `labels`:
    which count."""
    rules = FusionRules()
    moving = (t for t in world.tracks() if (labels is None or t.label in labels) and judge_track(t, rules).moving)
    return tuple(world.instance_of(track.id) for track in moving)


def facts(world: CityWorld) -> dict[str, float | str]:
    """What a log holds, from small images of every fourth frame: its turn in degrees (range of headings) and length in
    metres, moving vehicles in view of the front camera, the share of the image that they cover together on average, and
    the generator's line about the city."""
    views = [view.resized(96, 64) for view in world.frame_views("front")[::4]]
    seen = np.stack([world.render(view, supersample=1).instance for view in views])
    moving = moving_instances(world, VEHICLES)
    shares = np.array([[float((image == i).mean()) for image in seen] for i in moving]).reshape(-1, len(views))
    count = int(((shares >= SMALLEST_SHARE).mean(1) >= FRAMES_SHARE).sum())
    path = {"turn_deg": round(turn_deg(world.config), 2), "length_m": round(world.plan.drive_length, 1)}
    movers = {"movers": count, "mover_share": round(float(shares.sum(0).mean()), 4)}
    return {**path, **movers, "words": world.describe()}


def turn_deg(config: CityConfig) -> float:
    """Range of the vehicle's headings over a log, degrees."""
    times, poses = ego_keys(config, plan_streets(config))
    driven = (times >= 0) & (times <= (config.n_frames - 1) / config.rate_hz)
    heading = np.unwrap(np.arctan2(poses[driven, 1, 0], poses[driven, 0, 0]))
    return float(np.rad2deg(heading.max() - heading.min()))
