"""Corrections of exposure and camera poses: identity at the start, gradients, what is held fixed, recovery in a small
fit."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from fit_settings import fit_config
from refusals import refused
from toy_world import camera, fused_cloud, truth, view_at, write_scene

from mudg.base import geometry
from mudg.base.config import to_dict
from mudg.base.errors import NumericsError
from mudg.base.run_folder import RunDir
from mudg.core.table import Table
from mudg.gaussians import fit
from mudg.gaussians.corrections import Appearance, rigid_motion
from mudg.gaussians.model import SceneModel, compose
from mudg.gaussians.nodes import StaticNode
from mudg.gaussians.rendering import boxes_in_view, objects_only
from mudg.gaussians.schedule import FiniteCheck
from mudg.gaussians.settings import AppearanceConfig, FitConfig
from mudg.scene.read import read_scene

SIZE = (60, 40)
RECORDED = ("front/000000", "front/000001", "left/000000")
VIRTUAL = "front_shift+2.0/000000"


def everything(exposure="image") -> Appearance:
    return Appearance.of_views(RECORDED, AppearanceConfig(exposure=exposure, cameras=True))


def test_the_start_is_the_identity_and_what_is_off_is_absent():
    made, view = everything(), view_at(0.3, camera())
    rgb = torch.rand(3, 4, 5, generator=torch.Generator().manual_seed(0))
    assert torch.equal(made.colored(rgb, RECORDED[0], "recorded"), rgb)
    assert made.penalty(RECORDED[0], "recorded").item() == 0
    assert made.colored(rgb, VIRTUAL, "virtual") is rgb and made.penalty(VIRTUAL, "virtual") is None
    assert torch.allclose(made.world_from_cam(view, RECORDED[2]), torch.from_numpy(view.world_from_cam.copy()).float())
    off = Appearance.of_views(RECORDED, AppearanceConfig())
    assert not off and off.colored(rgb, RECORDED[0], "recorded") is rgb
    assert off.penalty(RECORDED[0], "recorded") is off.world_from_cam(view, RECORDED[0]) is None
    assert everything("camera").names == {"exposure": ("front", "left"), "cameras": RECORDED}


def test_what_does_not_fit_or_is_not_finite_is_named():
    made = everything()
    refused("no colour map", made.colored, torch.zeros(3, 2, 2), "rear/000000", "recorded")
    refused("do not fit", Appearance, {"exposure": ("a", "b")}, made.tables)
    made.tables["exposure"]["affine"].grad = torch.full((3, 3, 4), float("nan"))
    scene = SceneModel(Table({"means": torch.zeros(1, 3)}), (StaticNode(),), None, (), 0)
    check = FiniteCheck(3)
    check.gradients("v/1", scene, made)
    refused("exposure.affine, view v/1, step 3", check.refuse, raises=NumericsError)
    assert made.tables["exposure"]["affine"].grad is None


def test_maps_average_to_the_identity():
    made = everything("camera")
    drawn = torch.randn(2, 3, 4, generator=torch.Generator().manual_seed(1))
    with torch.no_grad():
        made.tables["exposure"]["affine"].copy_(drawn)
    rgb = torch.rand(3, 4, 5, generator=torch.Generator().manual_seed(0))
    mean = (made.colored(rgb, "front/7", "recorded") + made.colored(rgb, "left/7", "recorded")) / 2
    assert torch.allclose(mean, rgb, atol=1e-6)
    affine = drawn[1] - drawn.mean(0)
    expected = rgb + torch.einsum("ij,jhw->ihw", affine[:, :3], rgb) + affine[:, 3, None, None]
    assert torch.allclose(made.colored(rgb, "left/7", "recorded"), expected, atol=1e-6)


def test_rigid_motion_agrees_with_the_rotation_about_an_axis():
    moved = rigid_motion(torch.tensor([1.0, 2.0, 3.0]), torch.tensor([0.0, 0.0, 0.7])).numpy()
    assert np.abs(moved - geometry.yaw_matrix(0.7, (1, 2, 3))).max() < 1e-6
    turn = torch.tensor([0.3, -0.4, 0.5], dtype=torch.float64)
    any_turn = rigid_motion(torch.zeros(3, dtype=torch.float64), turn).numpy()
    assert geometry.rigid_problem(any_turn) is None
    assert math.acos((np.trace(any_turn[:3, :3]) - 1) / 2) == pytest.approx(math.sqrt(0.5), abs=1e-9)


@pytest.mark.parametrize("scale", [0.0, 0.3])
def test_gradients_by_finite_differences(scale):
    """Colour maps (through their mean as well) and camera motions, also where the turn is zero."""
    g = torch.Generator().manual_seed(3)
    made = everything()
    rgb = torch.rand(3, 2, 2, generator=g, dtype=torch.float64)
    view = view_at(0.3, camera())

    def applied(affine, shift, turn):
        made.tables["exposure"].columns["affine"] = affine
        made.tables["cameras"].columns |= {"shift": shift, "turn": turn}
        pose = made.world_from_cam(view, RECORDED[1])
        return torch.cat([made.colored(rgb, RECORDED[1], "recorded").flatten(), pose.flatten()])

    draw = lambda *shape: (scale * torch.randn(*shape, generator=g, dtype=torch.float64)).requires_grad_()
    inputs = [draw(3, 3, 4), draw(3, 3), draw(3, 3)]
    assert torch.autograd.gradcheck(applied, inputs)


def test_only_the_image_of_a_step_moves():
    made = everything()
    view = view_at(0.3, camera())
    made.world_from_cam(view, RECORDED[1])[:3, 3].sum().backward()
    made.adam_step(1, {"shift": 0.1, "turn": 0.1, "affine": 0.1})
    assert made.tables["cameras"]["shift"].detach().any(1).tolist() == [False, True, False]
    for group, name in (("cameras", "turn"), ("exposure", "affine")):
        assert not made.tables[group][name].detach().any()


# ---- fits ----------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def world(tmp_path_factory):
    root = tmp_path_factory.mktemp("world")
    write_scene(root / "scene", frames=6, width=SIZE[0], height=SIZE[1], cameras=("front", "left"))
    return read_scene(root / "scene"), fused_cloud(6)


def begin(world, change=None, **options) -> tuple[fit.FitState, FitConfig]:
    scene, cloud = world
    few = {"iterations": 120, "start__gaussians": 700, "densify__kind": "none"}
    config = fit_config(method="street_gaussians", **{**few, **options})
    views, classes = fit.recorded_views(config, scene)
    if change is not None:
        views = replace(views, recorded=tuple(map(change, views.recorded)))
    return fit.start_state(config, scene, cloud, views, classes), config


def darker_left(stored):
    """What a left camera of 0.7 times the exposure, and a little more blue, records."""
    rgb = (stored.rgb.astype(np.float32) * [0.7, 0.7, 0.75] + 6).clip(0, 255).astype(np.uint8)
    return replace(stored, rgb=rgb) if stored.name.startswith("left") else stored


@pytest.mark.slow
def test_different_exposures_are_recovered(world, tmp_path):
    """The ratio of both cameras' maps comes near the injected one, and the fit explains the pictures better."""
    state, config = begin(world, darker_left, appearance__exposure="camera", iterations=240)
    fit.optimise(state, config, RunDir.open(tmp_path / "learnt", fit.OUTPUT, to_dict(config), {}))
    grey = torch.full((3, 1, 1), 0.5)
    shown = lambda name: state.appearance.colored(grey, f"{name}/0", "recorded").detach().flatten()
    front, left = shown("front"), shown("left")
    injected = torch.tensor([0.7, 0.7, 0.75]) * 0.5 + 6 / 255
    assert ((left - front) / (injected - 0.5) > 0.4).all()


def test_boxes_of_objects_in_a_view(world):
    state, _ = begin(world)
    view = view_at(0.3, camera(width=SIZE[0], height=SIZE[1]))
    inside = boxes_in_view(state.model, view)
    moving = truth(view).semantics == 13
    uv, _ = geometry.project(view, state.model.nodes[1].pose_matrix(0.3)[None, :3, 3])
    assert inside[0, int(uv[0, 1]), int(uv[0, 0])] and inside.float().mean() < 0.3
    assert (inside[0] & moving).sum() > 20
    away = replace(view, world_from_cam=view.world_from_cam @ np.diag([-1.0, 1.0, -1.0, 1.0]))
    assert not boxes_in_view(state.model, away).any()
    only = objects_only(compose(state.model, 0.3))
    assert len(only.means) == int((state.model.table.labels["node"] > 0).sum())
