"""Certainty of a fitted scene: exact sums of blending weights, what they are turned into, and renders with it."""

from __future__ import annotations

import dataclasses
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from fit_settings import fit_config
from toy_world import camera, fused_cloud, truth, view_at, write_scene

from mudg.base.types import Gaussians, Track
from mudg.core.raster.rasterize import RasterConfig, rasterize
from mudg.core.table import Table
from mudg.gaussians import fit, trust
from mudg.gaussians.corrections import UNCORRECTED
from mudg.gaussians.model import SceneModel, compose
from mudg.gaussians.nodes import RigidNode, SkyNode, StaticNode
from mudg.gaussians.rendering import render_condition
from mudg.gaussians.trust import COLOR_ERROR, DEPTH_ERROR, certainty_of, difference_images, weight_sums
from mudg.gaussians.views import LidarPixels, StoredView, TrainView
from mudg.scene.clouds import write_fused
from mudg.steps.fit import Fit

RASTER = RasterConfig(near_m=0.2)
ROWS = 12
SIZE = (48, 32)


def tiny_model(order: torch.Tensor | None = None, moved: bool = True) -> SceneModel:
    """A few Gaussians ahead of the camera at time 0, the last four on an object, in the given order."""
    generator = torch.Generator().manual_seed(3)

    def draw(*shape: int) -> torch.Tensor:
        return torch.rand(*shape, generator=generator)

    means = draw(ROWS, 3) * torch.tensor([10.0, 6.0, 2.0]) + torch.tensor([7.0, -3.0, 0.5])
    owner = torch.zeros(ROWS, dtype=torch.int32)
    if moved:
        owner[-4:] = 1
        means[-4:] = (draw(4, 3) - 0.5) * 2
    columns = {
        "means": means,
        "quats": draw(ROWS, 4) - 0.5,
        "log_scales": torch.log(0.1 + 0.5 * draw(ROWS, 3)),
        "logits": 2 * draw(ROWS),
        "sh_dc": draw(ROWS, 1, 3) - 0.5,
        "semantics": draw(ROWS, 2),
    }
    if order is not None:
        columns, owner = {name: value[order] for name, value in columns.items()}, owner[order]
    pose = np.eye(4)
    pose[:3, 3] = (9.0, 1.0, 1.0)
    track = Track("car", "car", np.array([4.0, 2.0, 1.5]), np.array([0.0, 1.0]), np.stack([pose, pose]))
    nodes = (StaticNode(), RigidNode.from_track(track)) if moved else (StaticNode(),)
    return SceneModel(Table(columns, {"node": owner}), nodes, SkyNode.uniform(8), (0, 10), 0)


def photograph(time_s: float = 0.0, left_m: float = 0.0) -> StoredView:
    """The toy street seen by its camera, with a part that may not be used and a few LiDAR pixels."""
    seen = truth(view_at(time_s, camera(width=SIZE[0], height=SIZE[1]), left_m=left_m))
    rgb = (seen.rgb.permute(1, 2, 0) * 255).round().to(torch.uint8).numpy()
    mask = np.ones(SIZE[::-1], bool)
    mask[-4:] = False
    pixel = torch.arange(700, 1400, 7)
    lidar = LidarPixels(pixel, torch.full((len(pixel),), 9.0))
    return StoredView("front/000000", seen.view, "recorded", rgb, mask=mask, lidar=lidar)


def in_double(gaussians: Gaussians) -> Gaussians:
    values = {field.name: getattr(gaussians, field.name) for field in dataclasses.fields(gaussians)}
    numbers = {n: v for n, v in values.items() if torch.is_tensor(v) and v.is_floating_point()}
    return replace(gaussians, **{name: value.detach().double() for name, value in numbers.items()})


def test_sums_are_those_of_every_gaussians_weight_in_double_precision():
    """With one feature per Gaussian that is 1 for itself and 0 else, a rendered feature is a Gaussian's weight at every
    pixel."""
    model, view = tiny_model(), TrainView.of(photograph(), torch.device("cpu"))
    gaussians = compose(model, view.view.time_s, semantics=False)
    alone = replace(in_double(gaussians), extra=torch.eye(ROWS, dtype=torch.float64))
    weights = rasterize(alone, view.view, RasterConfig(backend="torch", near_m=0.2)).extra
    with torch.no_grad():
        images = difference_images(model, rasterize(gaussians, view.view, RASTER), view, UNCORRECTED)
    expected = torch.einsum("nhw,khw->kn", weights, images.double())
    found = weight_sums(model, view, RASTER)
    assert (expected[0] > 1).sum() > ROWS // 2 and expected[2:].amax(1).min() > 0.1
    torch.testing.assert_close(found.double(), expected, rtol=1e-4, atol=1e-5)


def test_images_of_differences():
    model, view = tiny_model(), TrainView.of(photograph(), torch.device("cpu"))
    with torch.no_grad():
        render = rasterize(compose(model, 0.0, semantics=False), view.view, RASTER)
    used, color, lidar, depth = difference_images(model, render, view, UNCORRECTED)
    assert used[-4:].sum() == 0 and used[:-4].min() == 1
    assert color[-4:].abs().sum() == 0 and color.max() > 0.05 and int(lidar.sum()) == 100
    pixel = int(view.lidar.pixel[50])
    off = abs(float(render.depth.flatten()[pixel]) - 9.0) / 9.0
    assert depth.flatten()[pixel] == pytest.approx(min(1.0, off), rel=1e-5)


def test_certainty_of_known_sums():
    def certainty(views: float, color: float, lidar: float, depth: float) -> float:
        values = (views, 10.0, 10.0 * color, lidar, lidar * depth)
        return float(trust.certainty(*(torch.tensor([value]) for value in values)))

    assert certainty(0, 0, 0, 0) == 0
    assert certainty(1, 0, 0, 0) == pytest.approx(0.5 * 0.5)  # LiDAR never met it
    assert certainty(3, 0, 1e6, 0) == pytest.approx(0.75, rel=1e-5)
    assert certainty(3, COLOR_ERROR, 1e6, 0) == pytest.approx(0.375, rel=1e-5)
    assert certainty(3, 0, 1e6, DEPTH_ERROR) == pytest.approx(0.375, rel=1e-5)


def test_certainty_follows_its_gaussian_and_grows_with_views():
    views = [photograph(0.0, left_m=left) for left in (0.0, 0.5, -0.5)]
    order = torch.cat([torch.randperm(8, generator=torch.Generator().manual_seed(1)), torch.tensor([9, 11, 8, 10])])
    plain, shuffled = certainty_of(tiny_model(), views, RASTER), certainty_of(tiny_model(order), views, RASTER)
    assert plain.dtype == torch.float16
    torch.testing.assert_close(shuffled.float(), plain.float()[order], rtol=2e-3, atol=1e-5)
    once, often = certainty_of(tiny_model(), views[:1], RASTER), certainty_of(tiny_model(), [views[0]] * 3, RASTER)
    seen = once > 0.01
    assert seen.any() and (often[seen] > once[seen]).all()


def test_what_no_view_shows_has_none_and_few_views_stand_for_many():
    model = tiny_model(moved=False)
    with torch.no_grad():
        model.table["means"][0] = torch.tensor([-20.0, 0.0, 1.0])
    views = [photograph()] * 6
    every, some = certainty_of(model, views, RASTER), certainty_of(model, views, RASTER, most=2)
    assert every[0] == 0 and every.max() > 0.03
    torch.testing.assert_close(some, every)


# ---- renders and files ---------------------------------------------------------------------------


@pytest.fixture(scope="module")
def fitted(tmp_path_factory) -> Path:
    root = tmp_path_factory.mktemp("fitted")
    write_scene(root / "scene", frames=6, width=60, height=40)
    write_fused(root / "fuse", fused_cloud(6), {})
    config = fit_config(method="street_gaussians", iterations=30, start__gaussians=900, densify__max_gaussians=1500)
    return Fit(scene=root / "scene", fused=root / "fuse", out=root / "fit", settings=config).run()


def test_a_fit_stores_it_and_a_render_shows_it(fitted):
    model, view = fit.load_model(fitted), view_at(0.3, camera(width=60, height=40), left_m=2.0)
    assert model.certainty.dtype == torch.float16 and len(model.certainty) == len(model.table)
    assert 0 < model.certainty.float().mean() < 1
    seen, plain = render_condition(model, view, RASTER), fit.render_view(model, view, RASTER)
    torch.testing.assert_close(seen.rgb, plain.rgb)
    torch.testing.assert_close(seen.depth, plain.depth[0], equal_nan=True)
    assert torch.equal(seen.semantics.long(), plain.semantics) and seen.semantics.dtype == torch.uint8
    assert seen.certainty.shape == seen.alpha.shape == (40, 60)
    assert (seen.certainty >= 0).all() and (seen.certainty <= seen.alpha).all()
    assert seen.certainty.max() > 0.02
    away = view_at(0.3, camera(width=60, height=40), yaw_rad=np.pi)  # where no camera ever looked
    assert render_condition(model, away, RASTER).certainty.mean() < 0.3 * seen.certainty.mean()
    bare = render_condition(replace(model, classes=()), view, RASTER)
    torch.testing.assert_close(bare.certainty, seen.certainty)
    assert (bare.semantics == 255).all()
