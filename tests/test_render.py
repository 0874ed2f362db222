"""Rendering a fitted scene: trajectories by configuration, folders, videos, resuming, edits."""

from __future__ import annotations

import itertools
from pathlib import Path

import av
import numpy as np
import pytest
import torch
from refusals import refused
from toy_world import write_scene

from mudg.base import store
from mudg.base.errors import UsageError
from mudg.base.palette import ID
from mudg.editing import render
from mudg.editing.settings import RenderConfig
from mudg.scene.observations import list_observation_sets, read_observations
from mudg.steps.render import RenderViews

FRAMES = 4


@pytest.fixture(scope="module")
def world(street_run: Path) -> dict[str, Path]:
    return {"scene": street_run / "scene", "model": street_run / "fit" / "street_gaussians"}


@pytest.fixture(scope="module")
def rendered(world: dict[str, Path], tmp_path_factory) -> Path:
    settings = RenderConfig(shifts_m=(0.0, 2.0, -3.0))
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
    assert (seen.kind, seen.source) == ("virtual", "street_gaussians")
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
        assert np.linalg.norm(b.center_world - a.center_world) == pytest.approx(2.0, abs=1e-9) and b.time_s == a.time_s


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


def test_any_camera_any_width(tmp_path):
    scene = write_scene(tmp_path / "scene", frames=2, cameras=("front", "left"), width=60, height=40)
    paths = render.trajectories(scene, RenderConfig(cameras=("left",), shifts_m=(0.0, -1.5), width_px=30))
    assert [path.name for path in paths] == ["left_recorded", "left_shift-1.5"]
    assert (paths[0].views[0].camera.width, paths[0].views[0].camera.height) == (30, 20)
    refused("no camera named 'rear'", render.trajectories, scene, RenderConfig(cameras=("rear",)), raises=UsageError)
    refused("no shifts", render.trajectories, scene, RenderConfig(shifts_m=()), raises=UsageError)
