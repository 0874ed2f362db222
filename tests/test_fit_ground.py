"""The ground under virtual views (`virtual.hold_ground`): they leave its shape alone, recorded views do not."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from fit_settings import fit_config
from toy_world import camera, fused_cloud, truth, view_at, write_scene

from mudg.base.palette import ID
from mudg.data.cloudfile import write_fused
from mudg.models.scene.densify import DensifyStats
from mudg.models.scene.model import SceneModel, compose
from mudg.stages import fit
from mudg.stages.fitting import ground, views
from mudg.stages.fitting import start as fit_start
from mudg.stages.fitting.finite import FiniteCheck
from mudg.stages.fitting.perception import perception_of
from mudg.stages.fitting.rendering import raster_of

FRAMES, SHAPE = 4, ("means", "log_scales", "quats")


@pytest.fixture(scope="module")
def world(tmp_path_factory) -> dict:
    """The start of a fit, a recorded view of it, and a virtual one beside the path."""
    root = tmp_path_factory.mktemp("ground")
    scene = write_scene(root / "scene", frames=FRAMES, width=60, height=40)
    write_fused(root / "fuse", fused_cloud(FRAMES), {})
    config = fit_config(method="mudg_s", iterations=24, start__gaussians=900)
    frames = views.training_frames(scene, ())
    classes = views.classes_of(scene, frames, {})
    stored = [one for _, one in views.load_recorded(scene, frames, classes, 0, with_lidar=True)]
    model = fit_start.start_model(scene, fused_cloud(FRAMES), stored, classes, config)
    seen = truth(view_at(0.3, camera(width=60, height=40), left_m=2.0))
    beside = views.StoredView(
        "left", seen.view, "virtual", (seen.rgb * 255).round().to(torch.uint8).permute(1, 2, 0).numpy(),
        views.to_channels(seen.semantics.numpy(), classes), seen.semantics.numpy() == ID["sky"], seen.mask[0].numpy(),
        depth=seen.depth[0].numpy(),
    )  # fmt: skip
    return {"model": model, "config": config, "recorded": stored[1], "virtual": beside}


def gradients(world: dict, kind: str, hold: bool) -> dict[str, torch.Tensor]:
    """Gradients of every column of the Gaussians after one view of a kind."""
    config, model = world["config"], world["model"]
    config = replace(config, virtual=replace(config.virtual, hold_ground=hold))
    model.table.clear_gradients()
    state = fit.FitState(model, views.ViewSet([world["recorded"]], [world["virtual"]]), DensifyStats.zeros(len(model.table)), None, 0)
    check = FiniteCheck(3, at_once=True)
    how = fit.LearnStep(config, raster_of(model, config.raster), perception_of(config.virtual, state.device), check, 3, kind == "recorded")
    fit._learn_from(state, world[kind].as_tensors(state.device), how)
    found = {name: torch.zeros_like(c) if c.grad is None else c.grad.clone() for name, c in model.table.columns.items()}
    model.table.clear_gradients()
    return found


def test_virtual_views_do_not_move_the_ground_but_colour_it(world):
    rows = ground.ground_rows(world["model"])
    assert 50 < int(rows.sum()) < len(rows) - 50
    free, held = gradients(world, "virtual", hold=False), gradients(world, "virtual", hold=True)
    for name in SHAPE:
        assert free[name][rows].abs().max() > 0
        assert held[name][rows].abs().max() == 0
    for name in free:
        others = ~rows if name in SHAPE else torch.ones_like(rows)
        assert torch.equal(held[name][others], free[name][others])
    assert held["sh_dc"][rows].abs().max() > 0 and held["logits"][rows].abs().max() > 0


def test_recorded_views_still_move_the_ground(world):
    rows = ground.ground_rows(world["model"])
    free, held = gradients(world, "recorded", hold=False), gradients(world, "recorded", hold=True)
    assert all(torch.equal(free[name], held[name]) for name in free)
    assert all(held[name][rows].abs().max() > 0 for name in SHAPE)


def test_what_is_held_looks_the_same(world):
    plain = compose(world["model"], 0.3)
    held = ground.ground_held(world["model"], plain)
    assert all(torch.equal(getattr(held, name), getattr(plain, name)) for name in ("means", "quats", "scales"))


def test_without_classes_nothing_is_held(world, capsys):
    model: SceneModel = replace(world["model"], classes=())
    assert not ground.ground_rows(model).any()
    ground.warn_without_ground(model)
    assert "holds nothing" in capsys.readouterr().err
    ground.warn_without_ground(world["model"])
    assert not capsys.readouterr().err


def test_only_the_background_is_ground(world):
    model = world["model"]
    objects = model.table.labels["node"] > 0
    assert objects.any() and not ground.ground_rows(model)[objects].any()
