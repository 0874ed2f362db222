"""A recorded city: the scene on disk is the world."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from mudg import native
from mudg.base.errors import InputError, UsageError
from mudg.base.types import Scene
from mudg.city.config import CityConfig
from mudg.city.logs import write_city
from mudg.city.world import CityWorld
from mudg.scene.labels import read_label
from mudg.scene.read import read_image, read_points

pytestmark = pytest.mark.skipif(native.library() is None, reason="the city needs the native library")

CONFIG = CityConfig(
    seed=9, n_frames=9, width=60, height=40, cameras=("front", "front_left"), lidar_azimuth_step_deg=2.0
)


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    return write_city(CONFIG, tmp_path_factory.mktemp("city") / "scene")


@pytest.fixture(scope="module")
def world(scene: Scene) -> CityWorld:
    return CityWorld.from_source(scene.source)


def test_images_and_labels_are_the_truth(scene: Scene, world: CityWorld) -> None:
    assert len(scene.frames) == 2 * CONFIG.n_frames
    moving = {i + 1 for i, posed in enumerate(world.objects) if posed.moving}
    for frame in (scene.frames_of("front")[3], scene.frames_of("front_left")[8]):
        truth = world.render(frame.view, sensor_noise=True)
        np.testing.assert_array_equal(read_image(scene, frame), truth.rgb_u8)
        depth = read_label(scene, frame, "depth")
        np.testing.assert_array_equal(np.isnan(depth), truth.sky)
        np.testing.assert_array_equal(depth[~truth.sky], truth.depth[~truth.sky])
        np.testing.assert_array_equal(read_label(scene, frame, "semantics"), truth.semantics)
        np.testing.assert_array_equal(read_label(scene, frame, "instance"), truth.instance)
        np.testing.assert_array_equal(read_label(scene, frame, "sky"), truth.sky)
        dynamic = read_label(scene, frame, "dynamic")
        np.testing.assert_array_equal(dynamic, np.isin(truth.instance, sorted(moving)))


def test_sweeps_tracks_and_ego_are_the_truth(scene: Scene, world: CityWorld) -> None:
    assert len(scene.sweeps) == CONFIG.n_frames
    points = read_points(scene, scene.sweeps[4])
    np.testing.assert_array_equal(points.xyz, world.lidar_sweep(4).points.xyz)
    assert [t.id for t in scene.tracks] == [t.id for t in world.tracks()]
    for stored, true in zip(scene.tracks, world.tracks()):
        np.testing.assert_allclose(stored.world_from_object, true.world_from_object, atol=1e-9)
    for frame in scene.frames:
        ego = scene.ego.pose_at(frame.view.time_s)
        true_ego = world.ego_path().pose_at(frame.view.time_s)
        np.testing.assert_allclose(ego, true_ego, atol=1e-9)


def test_held_out_frames(scene: Scene, tmp_path: Path) -> None:
    held_out = sorted(frame.id for frame in scene.frames_in("test"))
    assert held_out == ["front/000004", "front/000008", "front_left/000004", "front_left/000008"]
    with pytest.raises(UsageError, match="negative"):
        write_city(CONFIG, tmp_path / "x", test_every=-1)


def test_an_existing_scene_is_not_overwritten(scene: Scene) -> None:
    with pytest.raises(InputError, match="scene here already"):
        write_city(CONFIG, scene.root)


def test_the_same_call_writes_the_same_bytes(scene: Scene, tmp_path: Path) -> None:
    again = write_city(CONFIG, tmp_path / "again")
    manifest = (Path(scene.root) / "manifest.json").read_text()
    assert (Path(again.root) / "manifest.json").read_text() == manifest
