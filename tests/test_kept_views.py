"""Views in files are those in memory, to the bit; threads that read frames leave nothing behind."""

from __future__ import annotations

import errno
import itertools
import os
import shutil
import threading
from collections.abc import Sequence
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
import torch
from fit_settings import fit_to, interrupted, small_fit, written_street
from scipy.spatial import cKDTree
from toy_world import camera, view_at

from mudg.base import memory
from mudg.base.errors import ResourceError
from mudg.gaussians import fit, trust
from mudg.gaussians import views as fit_views
from mudg.gaussians import views as kept
from mudg.gaussians.nodes import SkyNode
from mudg.gaussians.start import StartPoints
from mudg.gaussians.views import LidarPixels, StoredView, TrainView
from mudg.scene.read import read_scene

SIZE, FRAMES = (60, 40), 6
ODD = (7, 5)
OPTIONAL = ("channels", "sky", "mask", "lidar", "depth", "confidence")


def threads_at_work() -> int:
    """Threads of this process but for the memory meter's, which ends a moment after the last meter."""
    return sum(thread.name != "memory meter" for thread in threading.enumerate())


def a_view(seed: int, given: tuple[str, ...] = OPTIONAL, kind: str = "recorded") -> StoredView:
    rng = np.random.default_rng(seed)
    shape = ODD[::-1]
    depth = rng.uniform(0, 90, shape).astype(np.float32)
    depth[0, :3] = np.nan, np.inf, -0.0
    pixel = torch.from_numpy(rng.permutation(35)[: seed % 9])
    every = {
        "channels": rng.integers(0, 256, shape, np.uint8),
        "sky": rng.random(shape) < 0.5,
        "mask": rng.random(shape) < 0.5,
        "lidar": LidarPixels(pixel, torch.rand(len(pixel), generator=torch.Generator().manual_seed(seed)) * 100),
        "depth": depth,
        "confidence": rng.integers(0, 256, shape, np.uint8),
    }
    rgb = rng.integers(0, 256, (*shape, 3), np.uint8)
    return StoredView(f"v/{seed}", view_at(seed / 10, camera(*ODD)), kind, rgb, **{name: every[name] for name in given})


def assert_same(found: StoredView | TrainView, wanted: StoredView | TrainView) -> None:
    """Same values, types, shapes, and the same ones missing; NaN equals NaN, and -0 is not 0."""
    for field in fields(wanted):
        one, other = getattr(found, field.name), getattr(wanted, field.name)
        if isinstance(other, LidarPixels):
            pairs = [(one.pixel, other.pixel), (one.depth_m, other.depth_m)]
        elif isinstance(other, np.ndarray | torch.Tensor):
            pairs = [(one, other)]
        else:
            assert one is other or one == other
            continue
        for a, b in pairs:
            a, b = np.asarray(a), np.asarray(b)
            assert (a.dtype, a.shape, a.tobytes()) == (b.dtype, b.shape, b.tobytes()), field.name


def filed(folder: Path, views: list[StoredView]) -> Sequence[StoredView]:
    def loaded():
        for index in reversed(range(len(views))):  # any order
            yield index, views[index]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(kept, "IN_MEMORY_BYTES", 0)
        return kept.keep(loaded(), len(views), folder)


def test_every_combination_of_fields_and_number_types_comes_back_to_the_bit(tmp_path, monkeypatch):
    """A label image may hold other numbers than usual; nothing may be cut off."""
    combinations = [c for n in range(len(OPTIONAL) + 1) for c in itertools.combinations(OPTIONAL, n)]
    views = [a_view(seed, given) for seed, given in enumerate(combinations)]
    monkeypatch.setattr(kept, "FILE_BYTES", 1000)
    read = filed(tmp_path, views)
    assert len(read) == len(views) == 64
    for found, wanted in zip(read, views, strict=True):
        assert_same(found, wanted)
        assert_same(*(TrainView.of(one, torch.device("cpu")) for one in (found, wanted)))
        assert isinstance(found.rgb.base.base if found.rgb.base.base is not None else found.rgb.base, np.memmap)
    assert list(tmp_path.iterdir()) == []
    usual = a_view(5)
    views = [replace(usual, depth=usual.depth.astype(np.float64)), replace(usual, depth=usual.depth.astype(np.float16))]
    for found, wanted in zip(filed(tmp_path, views), views, strict=True):
        assert_same(found, wanted)


def test_a_mapped_array_that_the_disk_has_no_room_for_is_an_error_in_words(tmp_path, monkeypatch):
    def full(*_: int) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(memory.os, "posix_fallocate", full, raising=False)
    with pytest.raises(ResourceError, match=r"cannot make a scratch file[\s\S]*No space left"):
        memory.mapped_array(tmp_path, (100,), np.uint8)


# ---- whole fits ----------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def world(tmp_path_factory) -> dict[str, Path]:
    return written_street(tmp_path_factory.mktemp("world"), SIZE, FRAMES)


def settings():
    few = {"start__gaussians": 600, "densify__max_gaussians": 1000, "preview_every": 8}
    return small_fit("mudg_s", iterations=16, **few, poses__learn=True)


def result_of(folder: Path) -> dict[str, bytes]:
    names = ("gaussians.safetensors", "nodes.safetensors", "model.json", "preview/000008.png", "preview/000016.png")
    return {name: (folder / name).read_bytes() for name in names}


def test_a_fit_from_a_file_of_views_is_the_same_fit_also_when_resumed(world, tmp_path, monkeypatch):
    step = fit_to(world, tmp_path / "whole", settings(), observations=(world["virtual"],))
    usual = replace(step, out=tmp_path / "usual").run()
    monkeypatch.setattr(kept, "IN_MEMORY_BYTES", 0)
    folder = tmp_path / "filed"
    with interrupted(9):
        replace(step, out=folder).run()
    replace(step, out=folder).run()
    assert result_of(folder) == result_of(usual)
    names = {path.relative_to(folder).as_posix() for path in folder.rglob("*")}
    assert names == {path.relative_to(tmp_path / "usual").as_posix() for path in (tmp_path / "usual").rglob("*")}


def test_a_wrong_frame_is_named_by_the_thread_that_reads_it(world, tmp_path):
    """Nothing half-read is left behind."""
    scene = tmp_path / "scene"
    shutil.copytree(world["scene"], scene)
    (scene / "manifest.json").unlink(missing_ok=True)
    image = scene / fit_views.training_frames(read_scene(scene), ())[2].image.path
    image.write_bytes(image.read_bytes()[:200])
    before, config = threads_at_work(), replace(settings(), method="street_gaussians")
    with pytest.raises(fit_views.InputError, match=image.name):
        fit_to({**world, "scene": scene}, tmp_path / "fit", config).run()
    assert threads_at_work() == before

    def loaded():
        yield 0, a_view(0)
        raise ResourceError("the disk broke")

    (tmp_path / "scratch").mkdir()
    with pytest.raises(ResourceError, match="the disk broke"):
        kept.keep(loaded(), 2, tmp_path / "scratch")
    assert list((tmp_path / "scratch").iterdir()) == []


def test_ctrl_c_while_frames_are_read_ends_the_threads(world, tmp_path, monkeypatch):
    def ctrl_c(*_):
        assert threads_at_work() > before
        raise KeyboardInterrupt

    scene, before = read_scene(world["scene"]), threads_at_work()
    monkeypatch.setattr(kept, "mapped_array", ctrl_c)
    monkeypatch.setattr(kept, "IN_MEMORY_BYTES", 0)
    with pytest.raises(KeyboardInterrupt):
        fit.recorded_views(settings(), scene, folder=tmp_path)
    assert threads_at_work() == before


def test_sweeps_are_let_go_and_depths_stay_the_same(world, monkeypatch):
    scene = read_scene(world["scene"])
    frames = fit_views.training_frames(scene, ())

    def loaded() -> dict[int, StoredView]:
        return dict(fit_views.load_recorded(scene, frames, (0, 10), 0, with_lidar=True))

    usual = loaded()
    monkeypatch.setattr(fit_views, "SWEEPS_PER_SENSOR", 1)
    for index, stored in loaded().items():
        assert stored.name == frames[index].id
        assert_same(stored, usual[index])
    cache = fit_views._SweepCache(scene)
    for frame in frames:
        cache.pixels_of(frame.view)
        assert cache._world.cache_info().currsize == 1


# ---- what goes over all views --------------------------------------------------------------------


def test_a_sky_is_the_same_however_its_pixels_are_divided():
    rng = np.random.default_rng(0)
    directions, colors = rng.normal(size=(4000, 3)), rng.random((4000, 3)).astype(np.float32)
    whole, parts, none = (SkyNode.uniform(8) for _ in range(3))
    whole.fill([(directions, colors)])
    cuts = [0, 0, 17, 1000, 2500, 4000]
    parts.fill((directions[a:b], colors[a:b]) for a, b in itertools.pairwise(cuts))
    assert torch.equal(whole.table["panorama"], parts.table["panorama"])
    none.fill([(directions[:0], colors[:0])])
    assert torch.equal(none.table["panorama"], SkyNode.uniform(8).table["panorama"])


def test_few_points_of_unseen_surfaces_still_cover_them():
    """10,000 points on a square of 10 m: 100 of them are spread over all of it and are as large as their distance."""
    axis = np.arange(0, 10, 0.1)
    grid = np.stack(np.meshgrid(axis, axis, [0.0]), -1).reshape(-1, 3).astype(np.float32)
    black, sizes = np.zeros((len(grid), 3), np.uint8), np.full(len(grid), 0.05, np.float32)
    points = StartPoints(grid, black, black[:, 0], sizes)
    few = trust._spread(points, 100, np.random.default_rng(0))
    all_of_them = trust._spread(points, len(grid), np.random.default_rng(0))
    assert 40 <= len(few) <= 100
    distance, nearest = cKDTree(few.xyz).query(grid)
    assert distance.max() < 2.5 and np.median(distance / few.scale_m[nearest]) < 1.5
    assert np.array_equal(all_of_them.xyz, grid) and np.allclose(all_of_them.scale_m, 0.05)
