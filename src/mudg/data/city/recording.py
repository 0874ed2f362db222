"""Records a generated city as a scene directory."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mudg.base import log
from mudg.base.errors import UsageError
from mudg.base.types import Scene, View
from mudg.data.city.config import CityConfig
from mudg.data.city.world import CityWorld
from mudg.data.scene import SceneWriter

SENSOR = "lidar"


def write_city(config: CityConfig, out_dir: Path | str, *, test_every: int = 4) -> Scene:
    """Generate the log of ``config`` and write it, as lossless PNG, with its exact labels (depth, semantics, sky, dynamic, instance).

    All cores work: the rays of a frame on the native threads, encoding and writing on the writer's. The scene is moved
    into place when it is complete; an interrupted call leaves nothing, and the same call makes the same bytes again.

    Args:
        config: the city and its log.
        out_dir: destination; must not hold a scene yet.
        test_every: hold out every n-th frame of all cameras (n, 2n, ...; never the first); 0 = none.

    Returns:
        The scene, read back.

    Raises:
        ResourceError: no native library, or the folder cannot be written. InputError: there is a scene here already.
        UsageError: ``test_every`` is negative.
    """
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
                held_out = test_every > 0 and index > 0 and index % test_every == 0
                for name in config.cameras:
                    frame_id = f"{name}/{index:06d}"
                    _write_frame(writer, world, frame_id, views[name][index], moving)
                    split[frame_id] = "test" if held_out else "train"
                    progress.advance()
                sweep = world.lidar_sweep(index)
                writer.add_sweep(f"{SENSOR}/{index:06d}", SENSOR, sweep.time_s, sweep.world_from_lidar, sweep.points)
                progress.advance()
        writer.set_split(split)
        return writer.finish()


def _write_frame(writer: SceneWriter, world: CityWorld, frame_id: str, view: View, moving: NDArray[np.bool_]) -> None:
    truth = world.render(view, sensor_noise=world.config.sensor_noise)
    labels = {
        "depth": truth.depth, "semantics": truth.semantics, "sky": truth.sky, "dynamic": moving[truth.instance],
        "instance": truth.instance,
    }  # fmt: skip
    writer.add_frame(frame_id, view, truth.rgb_u8, labels)
