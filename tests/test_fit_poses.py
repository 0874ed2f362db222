"""Gauss-Newton rounds on boxes: every part against a known answer, and a disturbed track found again."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from fit_settings import fit_config
from toy_world import camera, car_pose, fused_cloud, truth, view_at, write_scene

from mudg.base import geometry
from mudg.base.config import to_dict
from mudg.base.run_folder import RunDir
from mudg.core.raster.rasterize import RasterConfig
from mudg.gaussians import corrections as fit_poses
from mudg.gaussians import fit
from mudg.gaussians.model import compose
from mudg.gaussians.rendering import outline_mask
from mudg.scene.read import read_scene

SIZE, FRAMES = (96, 64), 6
RASTER = RasterConfig(near_m=0.2)


@pytest.fixture(scope="module")
def fitted(tmp_path_factory) -> fit.FitState:
    """A toy street fitted with exact boxes."""
    root = tmp_path_factory.mktemp("world")
    scene = read_scene(write_scene(root / "scene", frames=FRAMES, width=SIZE[0], height=SIZE[1]).root)
    few = {"start__gaussians": 1500, "densify__kind": "none", "loss__semantic_every": 999}
    config = fit_config(method="street_gaussians", iterations=60, **few)
    state = fit.start_state(config, scene, fused_cloud(FRAMES), *fit.recorded_views(config, scene))
    fit.optimise(state, config, RunDir.open(root / "fit", fit.OUTPUT, to_dict(config), {}))
    return state


@pytest.fixture
def node(fitted):
    """Its car, with offsets of zero before and after."""
    car = fitted.model.nodes[1]
    car.learn_pose = True
    yield car
    car.learn_pose = False
    car.add_offsets(-car.offsets["shift"].detach().double().numpy(), -car.offsets["yaw"].detach().double().numpy())


def test_a_displaced_picture_is_that_of_moved_offsets(fitted, node):
    view = view_at(0.3, camera(width=SIZE[0], height=SIZE[1]))
    here = compose(fitted.model, 0.3, semantics=False)
    for axis, step in enumerate(fit_poses.STEPS):
        moved = fit_poses._displaced(here, {1: node.pose_matrix(0.3)}, axis, step)
        change = np.zeros((FRAMES, 4))
        change[1, axis] = step  # the key at 0.3 s
        node.add_offsets(change[:, :3], change[:, 3])
        expected = compose(fitted.model, 0.3, semantics=False)
        node.add_offsets(-change[:, :3], -change[:, 3])
        assert torch.allclose(moved.means, expected.means, atol=2e-5)
        same, other = (torch.nn.functional.normalize(g.quats, dim=1) for g in (moved, expected))
        assert ((same * other).sum(1).abs() > 1 - 1e-5).all()
    mask = outline_mask(view, node.pose_matrix(0.3), node.size_m)
    assert (mask & (truth(view).semantics.numpy() == 13)).sum() > 30


def test_without_evidence_a_clean_track_stays_and_wrong_offsets_go_back(node):
    nothing = fit_poses.PoseEvidence(FRAMES)
    assert np.abs(fit_poses._move(node, nothing)).max() < 0.02
    node.add_offsets(np.tile([0.1, 0.05, 0.0], (FRAMES, 1)), np.full(FRAMES, 0.02))
    fit_poses._move(node, nothing)
    assert np.abs(node.corrected_keys()[:, :3, 3] - node.world_from_object[:, :3, 3]).max() < 0.02


def test_evidence_between_two_keys_is_shared(node):
    evidence = fit_poses.PoseEvidence(FRAMES)
    evidence.add(node.keys_around(0.375), np.eye(4), np.ones(4))
    assert evidence.matrix[1:3, 0, 0] == pytest.approx([0.75**2, 0.25**2])
    assert evidence.vector[:, 0] == pytest.approx([0, 0.75, 0.25, 0, 0, 0])
    evidence.add(node.keys_around(99.0), np.eye(4), np.ones(4))
    assert evidence.views == 1


def errors_of(exact, keys):
    """Root mean square errors, metres and radians, after the best constant motion in the box frame is taken out."""
    local = np.einsum("kji,kj->ki", keys[:, :3, :3], exact[:, :3, 3] - keys[:, :3, 3])
    turn = np.array([geometry.yaw_of(geometry.invert(b) @ a) for a, b in zip(exact, keys, strict=True)])
    return np.sqrt(((local - local.mean(0)) ** 2).sum(1).mean()), np.sqrt(((turn - turn.mean()) ** 2).mean())


def test_a_drifted_track_is_found_again(fitted, node):
    """Boxes pushed off a known scene come back from the pictures alone."""
    keys = np.arange(FRAMES)
    drift = np.stack([0.15 * np.sin(keys), 0.12 * np.cos(keys), 0.05 * np.sin(keys), 0.04 * np.cos(keys)], 1)
    node.add_offsets(drift[:, :3], drift[:, 3])
    exact = np.stack([car_pose(0.3 * n) for n in keys])
    train = [n for n in keys if n != 3]  # frame 3 is held out
    before = errors_of(exact[train], node.corrected_keys()[train])
    for _ in range(3):
        fit_poses.refine_poses(fitted.model, fitted.views.recorded, RASTER)
    after = errors_of(exact[train], node.corrected_keys()[train])
    assert after[0] < 0.5 * before[0] and after[1] < 0.6 * before[1]
    assert geometry.all_rigid(node.corrected_keys())


def test_rounds_are_spread_over_the_run_and_poses_that_are_not_learnt_stay(fitted):
    assert fit_poses.refine_poses(fitted.model, fitted.views.recorded, RASTER) == 0.0
    for learn, rounds in ((True, [50, 90, 130, 170]), (False, [])):
        config = fit_config(iterations=200, poses__learn=learn, poses__rounds=4, poses__start=0.25)
        assert [step for step in range(1, 201) if fit.pose_round_due(config, step)] == rounds
