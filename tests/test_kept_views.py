"""Views in a scratch file are those in memory, to the bit; threads that read ahead leave nothing behind."""

from __future__ import annotations

import errno
import itertools
import os
import shutil
import sys
import threading
import tracemalloc
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
import torch
from fit_settings import fit_to, interrupted, small_fit, written_street
from pretend_device import pretend_device
from scipy.spatial import cKDTree
from toy_world import camera, view_at

from mudg.base import scratch
from mudg.base.errors import ResourceError
from mudg.gaussians import fit, trust
from mudg.gaussians import views as fit_views
from mudg.gaussians import views as kept
from mudg.gaussians.nodes import SkyNode
from mudg.gaussians.start import StartPoints
from mudg.gaussians.views import LidarPixels, StoredView, TrainView, ViewSet
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


def filed(folder: Path, views: list[StoredView]) -> kept.ViewFile:
    def loaded():
        for index in reversed(range(len(views))):  # any order
            yield index, views[index]

    found = kept.keep(loaded(), len(views), folder)
    assert isinstance(found, kept.ViewFile)
    return found


def open_in(folder: Path) -> list[str]:
    """Files below a folder that this process holds open, deleted ones included."""
    descriptors = Path("/proc/self/fd")
    if not descriptors.is_dir():
        pytest.skip("the system does not list open files")
    targets = []
    for entry in descriptors.iterdir():
        try:
            targets.append(os.readlink(entry))
        except OSError:
            continue
    return [target for target in targets if target.startswith(str(folder))]


def test_every_combination_of_fields_and_number_types_comes_back_to_the_bit(tmp_path):
    """A label image may hold other numbers than usual; nothing may be cut off."""
    combinations = [c for n in range(len(OPTIONAL) + 1) for c in itertools.combinations(OPTIONAL, n)]
    views = [a_view(seed, given) for seed, given in enumerate(combinations)]
    read = filed(tmp_path, views)
    assert len(read) == len(views) == 64
    for found, wanted in zip(read, views, strict=True):
        assert_same(found, wanted)
        assert_same(found.as_tensors(), wanted.as_tensors())
    assert list(fit_views.heads_of(read)) == list(fit_views.heads_of(views))
    assert list(tmp_path.iterdir()) == []
    read.close()
    usual = a_view(5)
    views = [replace(usual, depth=usual.depth.astype(np.float64)), replace(usual, depth=usual.depth.astype(np.float16))]
    for found, wanted in zip(filed(tmp_path, views), views, strict=True):
        assert_same(found, wanted)


@pytest.mark.parametrize("first", [1, 14])
def test_views_prepared_ahead_are_those_of_their_steps(tmp_path, first):
    """From the beginning, and from the step at which a resumed fit goes on."""
    recorded, virtual = [a_view(seed) for seed in range(5)], [a_view(seed, kind="virtual") for seed in range(20, 23)]
    direct = ViewSet(tuple(recorded), tuple(virtual))
    read = ViewSet(filed(tmp_path, recorded), filed(tmp_path, virtual))
    assert read.filed and not direct.filed
    steps = range(first, 31)

    def chosen(views: ViewSet):
        return lambda step: views.choose(3, step, 0.5 if step > 10 else 0.0, beside=True)

    with kept.chosen_ahead(read, chosen(read), steps) as ahead:
        found = list(ahead)
    with kept.chosen_ahead(direct, chosen(direct), steps) as usual:
        wanted = list(usual)
    assert {len(views) for views in wanted} == {1, 2}
    for step, ours, theirs in zip(steps, found, wanted, strict=True):
        for one, other, stored in zip(ours, theirs, chosen(direct)(step), strict=True):
            assert_same(one, other)
            assert_same(one, stored.as_tensors())


def test_views_grow_on_their_device(tmp_path):
    views = ViewSet(filed(tmp_path, [a_view(seed) for seed in range(4)]), ())
    with (
        pretend_device() as there,
        kept.chosen_ahead(views, lambda step: views.choose(0, step, 0.0), range(1, 5), there) as ahead,
    ):
        for step, (view,) in enumerate(ahead, start=1):
            wanted = views.choose(0, step, 0.0)[0].as_tensors()
            given = [getattr(view, f.name) for f in fields(view) if isinstance(getattr(view, f.name), torch.Tensor)]
            every = (*given, view.lidar.pixel, view.lidar.depth_m)
            assert len(given) == 6 and all(tensor.device == there for tensor in every)
            assert torch.equal(view.lidar.pixel.cpu(), wanted.lidar.pixel)
            for name in ("rgb", "mask", "channels"):
                assert torch.equal(getattr(view, name).cpu(), getattr(wanted, name))


def test_an_error_of_a_thread_is_raised_at_its_step_in_words(tmp_path):
    views = ViewSet(filed(tmp_path, [a_view(seed) for seed in range(6)]), ())
    # the file was written from the last view to the first
    views.recorded._file._file.truncate(2 * views.recorded._slots[0].size)
    seen, before = [], threads_at_work()

    def go_through() -> None:
        with kept.chosen_ahead(views, lambda step: (views.recorded[6 - step],), range(1, 7)) as ahead:
            seen.extend(view.name for (view,) in ahead)

    with pytest.raises(ResourceError, match=r"scratch file ended early[\s\S]*repeat the command"):
        go_through()
    assert threads_at_work() == before


def test_ctrl_c_ends_the_threads(tmp_path):
    views = ViewSet(filed(tmp_path, [a_view(seed) for seed in range(6)]), ())
    before, read = threads_at_work(), []

    def choose(step: int) -> tuple[StoredView, ...]:
        read.append(step)
        return (views.recorded[step % 6],)

    def go_through() -> None:
        with kept.chosen_ahead(views, choose, range(1, 100_001)) as ahead:
            next(ahead)
            assert threads_at_work() > before
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        go_through()
    assert threads_at_work() == before
    assert len(read) < 20  # what had not begun was dropped


def test_a_full_disk_is_said_before_anything_is_read(tmp_path, monkeypatch):
    room = shutil._ntuple_diskusage(100 << 30, 97 << 30, 3 << 30)
    monkeypatch.setattr(kept.shutil, "disk_usage", lambda folder: room)
    assert kept.scratch_folder(9, kept.IN_MEMORY_BYTES, tmp_path) is None
    assert kept.scratch_folder(9, 2 << 30, tmp_path) == tmp_path
    said = r"too little room[\s\S]*4.0 GiB free for 9 views[\s\S]*3.0 GiB[\s\S]*--width-px"
    with pytest.raises(ResourceError, match=said):
        kept.scratch_folder(9, 4 << 30, tmp_path)


@pytest.mark.skipif(not Path("/dev/full").is_char_device(), reason="needs a device that is always full")
def test_a_disk_that_fills_up_is_an_error_in_words(tmp_path, monkeypatch):
    monkeypatch.setattr(scratch.tempfile, "TemporaryFile", lambda **_: open("/dev/full", "wb", buffering=0))
    with pytest.raises(ResourceError, match=r"writing failed[\s\S]*No space left[\s\S]*free disk space"):
        scratch.ScratchFile(tmp_path).append(np.zeros(100, np.uint8))


def test_a_mapped_array_that_the_disk_has_no_room_for_is_an_error_in_words(tmp_path, monkeypatch):
    def full(*_: int) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(scratch.os, "posix_fallocate", full, raising=False)
    with pytest.raises(ResourceError, match=r"cannot make a scratch file[\s\S]*No space left"):
        scratch.mapped_array(tmp_path, (100,), np.uint8)


# ---- whole fits ----------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def world(tmp_path_factory) -> dict[str, Path]:
    return written_street(tmp_path_factory.mktemp("world"), SIZE, FRAMES)


def settings():
    few = {"start__gaussians": 600, "densify__max_gaussians": 1000, "preview_every": 12}
    return small_fit("mudg_s", **few, poses__learn=True)


def result_of(folder: Path) -> dict[str, bytes]:
    names = ("gaussians.safetensors", "nodes.safetensors", "model.json", "preview/000012.png", "preview/000024.png")
    return {name: (folder / name).read_bytes() for name in names}


def test_a_fit_from_a_file_of_views_is_the_same_fit_also_when_resumed(world, tmp_path, monkeypatch):
    step = fit_to(world, tmp_path / "whole", settings(), observations=(world["virtual"],))
    usual = replace(step, out=tmp_path / "usual").run()
    monkeypatch.setattr(kept, "IN_MEMORY_BYTES", 0)
    before, folder, asked = threads_at_work(), tmp_path / "filed", []
    with interrupted(9, lambda: asked.append(len(open_in(folder)))):
        replace(step, out=folder).run()
    assert asked == [2]  # recorded and virtual views
    assert threads_at_work() == before and open_in(folder) == []
    replace(step, out=folder).run()
    assert result_of(folder) == result_of(usual)
    names = {path.relative_to(folder).as_posix() for path in folder.rglob("*")}
    assert names == {path.relative_to(tmp_path / "usual").as_posix() for path in (tmp_path / "usual").rglob("*")}
    assert threads_at_work() == before and open_in(folder) == []


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
    assert open_in(tmp_path) == [] and list((tmp_path / "scratch").iterdir()) == []


def test_ctrl_c_while_frames_are_read_ends_the_threads(world, tmp_path, monkeypatch):
    def ctrl_c(self, index, stored):
        assert threads_at_work() > before
        raise KeyboardInterrupt

    scene, before = read_scene(world["scene"]), threads_at_work()
    monkeypatch.setattr(kept.ViewFile, "put", ctrl_c)
    with pytest.raises(KeyboardInterrupt):
        fit.recorded_views(settings(), scene, scratch=tmp_path)
    assert threads_at_work() == before and open_in(tmp_path) == []


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
        assert len(cache._read) == 1


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


@pytest.mark.skipif(sys.platform != "linux", reason="reads the peak of resident memory as Linux gives it")
def test_views_of_a_pass_are_not_held(tmp_path):
    """Reading all views one after the other takes the memory of one, not of all."""
    shape = (200, 300)
    rgb = np.zeros((*shape, 3), np.uint8)
    large = StoredView("v", view_at(0.0, camera(300, 200)), "recorded", rgb, rgb[..., 0].copy())
    read = kept.keep(((index, large) for index in range(40)), 40, tmp_path)
    tracemalloc.start()
    total = sum(int(view.rgb.sum()) for view in read)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert total == 0 and peak < 4 * 4 * shape[0] * shape[1]
