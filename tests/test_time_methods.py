"""Methods whose Gaussians depend on time: their equations, and their fits end to end on a tiny exact street."""

from __future__ import annotations

import math
import os
import signal
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from fit_settings import fit_config
from toy_world import camera, fused_cloud, truth, view_at, write_scene

from mudg.base.errors import UsageError
from mudg.core import losses, metrics
from mudg.core.raster.rasterize import RasterConfig
from mudg.core.table import Table
from mudg.data.cloudfile import write_fused
from mudg.models.scene import densify
from mudg.models.scene.model import SceneModel, compose
from mudg.models.scene.nodes import NodeRows
from mudg.models.scene.vibration import VibrationNode, average_velocity, born_later, moving_rows, starting_columns
from mudg.stages import fit
from mudg.stages.fitting import pvg
from mudg.stages.fitting.recipes import RECIPES

SIZE, FRAMES = (60, 40), 6
OWN = {"pvg": {"tau", "log_beta", "velocity"}}
BOX_FREE = [name for name, recipe in RECIPES.items() if not recipe.boxes]


@pytest.fixture(scope="module")
def world(tmp_path_factory) -> dict[str, Path]:
    """A scene with a moving car, the same without its track, and what fusing gives."""
    root = tmp_path_factory.mktemp("world")
    write_scene(root / "scene", frames=FRAMES, width=SIZE[0], height=SIZE[1])
    write_scene(root / "untracked", frames=FRAMES, width=SIZE[0], height=SIZE[1], tracks=False)
    write_fused(root / "fuse", fused_cloud(FRAMES), {})
    return {name: root / name for name in ("scene", "untracked", "fuse")}


def settings(method: str, **changes):
    small = {"iterations": 24, "start__gaussians": 900, "densify__max_gaussians": 1500, "checkpoint_every": 1000, "preview_every": 1000}
    return fit_config(method=method, **{**small, **changes})


def fitted_bytes(folder: Path) -> dict[str, bytes]:
    return {name: (folder / name).read_bytes() for name in ("gaussians.safetensors", "nodes.safetensors", "model.json")}


# ---- vibration -------------------------------------------------------------------------------------------------------


def vibrating(count: int = 5) -> NodeRows:
    g = torch.Generator().manual_seed(3)

    def drawn(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, generator=g, dtype=torch.float64)

    own = {"tau": 0.03 * drawn(count), "log_beta": -2.5 + 0.5 * drawn(count), "velocity": 20 * drawn(count, 3)}
    return NodeRows(drawn(count, 3), drawn(count, 4), torch.sigmoid(drawn(count)), drawn(count, 1, 3), own)


def test_vibration_by_hand():
    """A quarter of a cycle after its peak a Gaussian is v l / (2 pi) away, and as faint as the normal density says."""
    node = VibrationNode("background", middle_s=10.0, frame_s=0.1)
    assert node.time_of(10.1) == pytest.approx(0.02)
    own = {"tau": torch.tensor([0.0, 0.05]), "log_beta": torch.tensor([0.05, 0.01]).log(), "velocity": torch.tensor([[2.0, 0, 0]] * 2)}
    rows = NodeRows(torch.zeros(2, 3), torch.ones(2, 4), torch.tensor([0.8, 0.8]), torch.zeros(2, 1, 3), own)
    seen = node.at_time(rows, 10.25)  # t = 0.05, a quarter of the cycle 0.2
    assert seen.means[0].tolist() == pytest.approx([2.0 * 0.2 / (2 * math.pi), 0, 0])
    assert seen.means[1].tolist() == pytest.approx([0, 0, 0])
    assert seen.opacity.tolist() == pytest.approx([0.8 * math.exp(-0.5), 0.8])
    later = node.at_time(rows, 10.4)  # t = 0.08: three life spans after the peak of the second
    assert later.opacity[1] == 0.0
    assert average_velocity(own["velocity"], torch.tensor([0.4, 0.0]))[:, 0].tolist() == pytest.approx([2 * math.exp(-1), 2.0])


def test_vibration_agrees_with_a_plain_loop_and_its_slopes_with_differences():
    rows, node = vibrating(), VibrationNode("background", 1.0, 0.1).smoothed(0.013)
    seen = node.at_time(rows, 1.2)
    for i in range(len(rows.means)):
        beta, since = math.exp(rows.own["log_beta"][i]), 0.04 - 0.013 - float(rows.own["tau"][i])
        factor = math.exp(-(since**2) / (2 * beta**2))
        assert float(seen.opacity[i]) == pytest.approx(float(rows.opacity[i]) * (factor if factor > 0.05 else 0.0), rel=1e-12)
        for axis in range(3):
            v = float(rows.own["velocity"][i, axis])
            moved = v * math.sin(2 * math.pi * since / 0.2) * 0.2 / (2 * math.pi) + v * math.exp(-beta / 0.4) * 0.013
            assert float(seen.means[i, axis]) == pytest.approx(float(rows.means[i, axis]) + moved, rel=1e-12)
    held = [rows.means, rows.opacity, *(rows.own[name] for name in ("tau", "log_beta", "velocity"))]

    def at(means, opacity, tau, log_beta, velocity):
        now = node.at_time(replace(rows, means=means, opacity=opacity, own={"tau": tau, "log_beta": log_beta, "velocity": velocity}), 1.2)
        return now.means, now.opacity

    assert torch.autograd.gradcheck(at, [value.clone().requires_grad_() for value in held])


def test_children_lie_on_their_parents_path():
    columns = {"means": torch.zeros(2, 3), "tau": torch.tensor([0.1, 0.1]), "log_beta": torch.tensor([0.04, 0.005]).log(),
               "velocity": torch.tensor([[3.0, 0, 0]] * 2)}  # fmt: skip
    born = born_later(columns, torch.tensor([1.0, -2.0]), late=True)
    assert born["tau"].tolist() == pytest.approx([0.14, 0.09])
    assert born["means"][:, 0].tolist() == pytest.approx([3 * math.exp(-0.1) * 0.04, -3 * math.exp(-0.0125) * 0.01])
    assert born["log_beta"].exp().tolist() == pytest.approx([0.04 / 1.6, 0.005])
    assert born_later(columns, torch.zeros(2), late=False)["log_beta"].tolist() == columns["log_beta"].tolist()
    assert moving_rows(columns).tolist() == [True, True]
    assert moving_rows(columns, 0.01).tolist() == [False, True]


@pytest.mark.parametrize(("step", "late", "rows"), [(10, 20, 5), (20, 20, 6)])
def test_what_changes_in_time_is_split_in_time(step, late, rows):
    """Of three Gaussians with small image gradients, one has a gradient of tau and a long life: it becomes two, late in the run three."""
    from mudg.models.scene.initial import columns_from_points

    columns = columns_from_points(np.zeros((4, 3), np.float32), np.zeros((4, 3), np.uint8), None, (), 0, np.full(4, 0.1, np.float32))
    columns |= starting_columns(4, torch.zeros(4), 0.2) | {"log_beta": torch.tensor([0.1, 0.1, 0.1, 0.005]).log()}
    model = SceneModel(Table(columns, {"node": torch.zeros(4, dtype=torch.int32)}), (VibrationNode("b", 0.0, 0.1),), None, (), 0)
    stats = densify.DensifyStats(torch.zeros(4), torch.ones(4), torch.tensor([0.0, 1.0, 0.0, 0.0]))
    report = densify.densify(model, stats, step, densify.DensifySettings(1, 99, 10, growth=9.0, late=late), 0)
    assert (report["split"], report["cloned"], report["rows"]) == (1, 0, rows)
    assert len(set(model.table["tau"].tolist())) == rows - 2
    copied = densify.densify(model, densify.DensifyStats(*(torch.ones(rows) for _ in range(3))), step,
                             densify.DensifySettings(1, 99, 10, static_gradient=9.0, growth=9.0), 0)  # fmt: skip
    assert copied["cloned"] == 1


def test_the_losses_of_pvg_by_hand():
    alpha, depth = torch.tensor([[[0.5, 1.0]]]), torch.tensor([[[10.0, 20.0]]])
    inverse = losses.inverse_depth(depth, alpha, 1000.0)
    assert inverse.flatten().tolist() == pytest.approx([0.05 + 0.0005, 0.05])
    assert losses.sparse_inverse_depth(inverse, torch.tensor([1]), torch.tensor([10.0])).item() == pytest.approx(0.05)
    rgb = torch.tensor([[[0.0, 1.0]]] * 3)
    assert losses.edge_aware(torch.tensor([[[1.0, 3.0], [1.0, 3.0]]]), rgb.expand(3, 2, 2)).item() == pytest.approx(2 * math.exp(-1))
    assert losses.opacity_entropy(alpha).item() == pytest.approx(-0.25 * math.log(0.5))
    assert losses.empty_sky(alpha, torch.tensor([[[True, False]]])).item() == pytest.approx(-0.5 * math.log(0.5))


def test_half_of_the_steps_draw_the_state_of_another_time():
    table = Table({"means": torch.zeros(1, 3)}, {"node": torch.zeros(1, dtype=torch.int32)})
    model = SceneModel(table, (VibrationNode("b", 0, 0.1),), None, (), 0)
    drawn = [pvg.VibrationRecipe().drawn_model(model, None, step, settings("pvg")).nodes[0].early for step in range(400)]
    moved = [early for early in drawn if early]
    assert 160 < len(moved) < 240
    assert max(map(abs, moved)) <= 0.03
    assert max(moved) > 0.02 and min(moved) < -0.02
    assert model.nodes[0].early == 0.0


# ---- fits ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("method", RECIPES)
def test_a_fit_learns_reaches_every_column_and_is_read_back(world, tmp_path, monkeypatch, method):
    reached: set[str] = set()
    adam_step = fit.adam_step

    def spy(model, *rest):
        for table in (model.table, *model.node_tables().values()):
            reached.update(name for name, value in table.gradients().items() if bool((value != 0).any()))
        adam_step(model, *rest)

    monkeypatch.setattr(fit, "adam_step", spy)
    folder = fit.run(settings(method, iterations=60), world["scene"], world["fuse"], tmp_path / "fit")
    assert OWN[method] <= reached
    model = fit.load_model(folder)
    view = view_at(0.6, camera(width=SIZE[0], height=SIZE[1]))
    seen = fit.render_view(model, view, RasterConfig())
    assert metrics.psnr(seen.rgb, truth(view).rgb) > 17.0
    values, groups = model.state()
    again = SceneModel.from_state(values, groups)
    assert torch.equal(fit.render_view(again, view, RasterConfig()).rgb, seen.rgb)
    assert not torch.equal(compose(again, 0.0).means, compose(again, 0.45).means)


@pytest.mark.parametrize("method", RECIPES)
def test_interrupted_and_resumed_equals_uninterrupted(world, tmp_path, monkeypatch, method):
    config, stops = settings(method, iterations=26), [4, 13]
    whole = fit.run(config, world["scene"], world["fuse"], tmp_path / "whole")
    adam_step = fit.adam_step

    def stopped(model, step, *rest):
        adam_step(model, step, *rest)
        if step == stops[0]:
            os.kill(os.getpid(), signal.SIGINT)

    monkeypatch.setattr(fit, "adam_step", stopped)
    while stops:
        with pytest.raises(KeyboardInterrupt):
            fit.run(config, world["scene"], world["fuse"], tmp_path / "parts")
        stops.pop(0)
    monkeypatch.setattr(fit, "adam_step", adam_step)
    assert fitted_bytes(fit.run(config, world["scene"], world["fuse"], tmp_path / "parts")) == fitted_bytes(whole)


@pytest.mark.parametrize("method", BOX_FREE)
def test_methods_without_boxes_do_not_read_them(world, tmp_path, method):
    """Neither the tracks of the scene nor the clouds of its objects change a byte."""
    fused = fused_cloud(FRAMES)
    write_fused(tmp_path / "fuse", replace(fused, objects={}), {})
    tracked = fit.run(settings(method), world["scene"], world["fuse"], tmp_path / "tracked")
    untracked = fit.run(settings(method), world["untracked"], tmp_path / "fuse", tmp_path / "untracked")
    assert fitted_bytes(tracked) == fitted_bytes(untracked)


@pytest.mark.parametrize("method", BOX_FREE)
@pytest.mark.parametrize("changes", [{"poses__learn": True}, {"objects__deformable": False}, {"loss__object_weight": 0.1}])
def test_settings_about_boxes_are_refused_by_methods_without_them(world, tmp_path, method, changes):
    with pytest.raises(UsageError, match="knows nothing of it"):
        fit.run(settings(method, **changes), world["scene"], world["fuse"], tmp_path / "fit")
    assert not (tmp_path / "fit").exists()


@pytest.mark.parametrize("method", RECIPES)
def test_what_a_method_cannot_follow_is_refused(world, tmp_path, method):
    for weight in RECIPES[method].own_weights:
        with pytest.raises(UsageError, match="published weights of its own"):
            fit.run(settings(method, **{f"loss__{weight}": 0.33}), world["scene"], world["fuse"], tmp_path / "fit")
    with pytest.raises(UsageError, match="densifies by gradients"):
        fit.run(settings(method, densify__kind="mcmc"), world["scene"], world["fuse"], tmp_path / "fit")
    with pytest.raises(UsageError, match="cannot go on"):
        fit.run(settings(method), world["scene"], world["fuse"], tmp_path / "fit", start=tmp_path / "other")
