"""Rendering a fitted scene: trajectories by configuration, folders, videos, resuming, edits."""

from __future__ import annotations

import itertools
from pathlib import Path

import av
import numpy as np
import pytest
import torch
from fit_settings import fit_config
from refusals import refused
from toy_world import CAR_SIZE, car_pose, fused_cloud, write_scene

from mudg.base import geometry, store
from mudg.base.errors import UsageError
from mudg.base.palette import ID
from mudg.core.raster.rasterize import RasterConfig
from mudg.editing import render
from mudg.editing.settings import RenderConfig
from mudg.gaussians import fit
from mudg.scene.clouds import write_fused
from mudg.scene.observations import list_observation_sets, read_observations
from mudg.scene.read import read_scene
from mudg.steps.fit import Fit
from mudg.steps.render import RenderViews

FRAMES = 4
SHIFTS = (0.0, 2.0, -3.0)


@pytest.fixture(scope="module")
def world(tmp_path_factory) -> dict[str, Path]:
    root = tmp_path_factory.mktemp("world")
    write_scene(root / "scene", frames=FRAMES, cameras=("front", "left"), width=60, height=40)
    write_fused(root / "fuse", fused_cloud(FRAMES), {})
    config = fit_config(method="street_gaussians", iterations=60, start__gaussians=900, densify__max_gaussians=1500)
    Fit(scene=root / "scene", fused=root / "fuse", out=root / "fit", settings=config).run()
    return {"scene": root / "scene", "model": root / "fit"}


@pytest.fixture(scope="module")
def rendered(world, tmp_path_factory) -> Path:
    settings = RenderConfig(shifts_m=SHIFTS)
    return RenderViews(**world, out=tmp_path_factory.mktemp("r") / "out", settings=settings).run()


def test_one_folder_and_video_per_trajectory(rendered):
    names = {"front_recorded", "front_shift+2.0", "front_shift-3.0"}
    assert set(list_observation_sets(rendered)) == names
    for name in names:
        assert len(read_observations(rendered / name)) == FRAMES
        with av.open(str(rendered / f"{name}.mp4")) as video:
            assert [(frame.height, frame.width) for frame in video.decode(video=0)] == [(40, 3 * 60 + 4)] * FRAMES
    store.verify_manifest(rendered)


def test_observations_hold_all_modalities_and_lie_where_the_trajectory_says(rendered):
    seen = read_observations(rendered / "front_shift+2.0")[1]
    assert seen.kind == "virtual"
    assert seen.source == "street_gaussians"
    sky = seen.semantics == ID["sky"]
    assert 0.05 < sky.float().mean() < 0.6
    assert torch.equal(sky, torch.isnan(seen.depth[0]))
    covered = torch.isfinite(seen.depth)
    assert ((seen.depth > 0.1) & (seen.depth < 200))[covered].all()
    assert ((seen.confidence >= 0) & (seen.confidence <= 1)).all()
    assert seen.confidence[covered].mean() > 0.8
    names = ("front_recorded", "front_shift+2.0")
    recorded, left = (read_observations(rendered / name).views for name in names)
    for a, b in zip(recorded, left):
        assert np.linalg.norm(b.center_world - a.center_world) == pytest.approx(2.0, abs=1e-9)
        assert b.time_s == a.time_s


def test_continues_after_an_interruption_and_reuses_what_is_finished(world, tmp_path, monkeypatch):
    config = RenderConfig(shifts_m=(0.0, 2.0), video=False)
    whole = RenderViews(**world, out=tmp_path / "whole", settings=config).run()
    real, calls, numbers = render.render_view, [], itertools.count(1)

    def stop_at_third(*arguments):  # threads call
        number = next(numbers)
        calls.append(number)
        if number == 3:
            raise KeyboardInterrupt
        return real(*arguments)

    monkeypatch.setattr(render, "render_view", stop_at_third)
    with pytest.raises(KeyboardInterrupt):
        RenderViews(**world, out=tmp_path / "parts", settings=config).run()
    kept = len(list((tmp_path / "parts").rglob("*.npz")))
    assert kept == 2
    calls.clear()
    parts = RenderViews(**world, out=tmp_path / "parts", settings=config).run()
    assert len(calls) == 2 * FRAMES - kept
    for name in ("front_recorded", "front_shift+2.0"):
        first, second = read_observations(whole / name), read_observations(parts / name)
        for index in range(FRAMES):
            for field in ("rgb", "depth", "semantics", "confidence"):
                one, other = (torch.nan_to_num(getattr(seen[index], field)) for seen in (first, second))
                assert torch.equal(one, other), (name, index, field)
    calls.clear()
    assert RenderViews(**world, out=tmp_path / "parts", settings=config).run() == parts
    assert not calls


def test_removing_the_car_shows_what_is_behind_it(world, tmp_path):
    config = RenderConfig(shifts_m=(0.0,), video=False)
    (tmp_path / "edits.yaml").write_text("- remove: {ids: [car], close_street: false}\n")
    folder = RenderViews(**world, edits=tmp_path / "edits.yaml", out=tmp_path / "out", settings=config).run()
    seen = read_observations(folder / "front_recorded")[1]
    with_car = fit.render_view(fit.load_model(world["model"]), seen.view, RasterConfig())
    uv, _ = geometry.project(seen.view, (car_pose(seen.view.time_s)[:3, 3] - [0, 0, CAR_SIZE[2] / 4])[None])
    row, column = int(uv[0, 1]), int(uv[0, 0])
    assert with_car.semantics[row, column] == ID["car"]
    assert seen.semantics[row, column] != ID["car"]


def test_any_camera_any_width(world):
    scene = read_scene(world["scene"])
    paths = render.trajectories(scene, RenderConfig(cameras=("left",), shifts_m=(0.0, -1.5), width_px=30))
    assert [path.name for path in paths] == ["left_recorded", "left_shift-1.5"]
    assert paths[0].views[0].camera.width == 30
    assert paths[0].views[0].camera.height == 20
    refused("no camera named 'rear'", render.trajectories, scene, RenderConfig(cameras=("rear",)), raises=UsageError)
    refused("no shifts", render.trajectories, scene, RenderConfig(shifts_m=()), raises=UsageError)
