"""Renders of a fit, repaired beside the path: what the network sees, in which order they are made, and what the fit
makes of them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from toy_world import camera, fused_cloud, view_at

from mudg.base.errors import UsageError
from mudg.base.types import FusedCloud, Photo, RenderPlanes
from mudg.benchmarks.chain import Chain, repair_settings
from mudg.benchmarks.rows import Row
from mudg.benchmarks.settings import BenchConfig
from mudg.diffusion import condition as conditions
from mudg.diffusion import views
from mudg.diffusion.condition import ConditionRules, DriveInputs
from mudg.diffusion.settings import SynthesizeConfig
from mudg.diffusion.views import conditions_of
from mudg.gaussians.recipes import recipe_of
from mudg.gaussians.settings import METHODS, FitConfig
from mudg.steps.fit import Fit
from mudg.steps.synthesize import Synthesize


def shown(view):
    """A render with colours, depths and classes of its own, that covers the right half."""
    size = view.camera.height, view.camera.width
    plane = torch.linspace(0, 1, size[0] * size[1]).view(1, *size)
    classes = torch.full((1, *size), 2, dtype=torch.uint8)
    covers = (torch.arange(size[1]) >= size[1] // 2).float().expand(1, *size)
    return RenderPlanes(plane.expand(3, -1, -1), 5 + 20 * plane, covers, 0.7 * covers, classes)


@pytest.mark.parametrize("fine", [0, 2])
def test_a_repair_sees_the_render_and_one_photograph_and_nothing_measured(fine):
    cam = camera(width=48, height=32)
    rules = ConditionRules(48, 32, 48 * fine, 32 * fine)
    image = np.random.default_rng(1).integers(0, 255, (32, 48, 3)).astype(np.uint8)
    view = view_at(0.2, cam)
    given = DriveInputs(fused_cloud(3), (), [Photo(view, image)], shown)
    for grid, condition in enumerate(conditions_of(given, "repair", [view], rules, {})):
        own = shown(view.resized(48 * fine, 32 * fine)) if fine and grid else shown(view)
        width = condition.color.shape[-1]
        assert not bool(condition.valid.any())
        assert not bool(condition.warped[..., : width // 2].any()) and bool(condition.warped[..., width // 2 :].all())
        if grid or not fine:  # the coarse grid averages the fine one
            assert torch.equal(condition.color[0], own.color) and torch.equal(condition.depth[0], own.depth)
        assert torch.equal(condition.color, condition.renders.color)
        assert torch.equal(condition.depth, condition.renders.depth)
        assert bool((condition.semantics == 2).all())
    coarse = ConditionRules(48, 32)
    small = conditions_of(given, "repair", [view], coarse, {})[0]
    assert torch.allclose(small.backdrop[0], conditions.image_tensor(image), atol=1e-5)
    elsewhere = FusedCloud(replace(given.cloud.static, xyz=given.cloud.static.xyz + 500), {})
    without_points = replace(given, cloud=elsewhere)
    assert torch.equal(conditions_of(without_points, "repair", [view], coarse, {})[0].color, small.color)
    with pytest.raises(UsageError, match="renders"):
        conditions_of(replace(given, render_at=None), "repair", [view], coarse, {})


def test_repairs_need_a_fit_and_only_they_go_with_one():
    with pytest.raises(UsageError, match="renders of a fitted scene"):
        views.check_config(SynthesizeConfig(condition="repair"), False)
    assert views.check_config(SynthesizeConfig(condition="repair", device="cpu"), True).condition == "repair"
    with pytest.raises(UsageError, match="cannot be switched off"):
        views.check_config(SynthesizeConfig(condition="points"), True)


def test_repaired_views_move_towards_their_places():
    generator = SynthesizeConfig(shifts_m=(3.0, -3.0, 0.0), paths=("lane+0.1",), steps=4)
    first, last = repair_settings(generator, 1 / 3), repair_settings(generator, 1.0)
    assert (first.shifts_m, first.paths, first.steps) == ((1.0, -1.0), (), 1)
    assert (last.shifts_m, last.paths, last.condition) == ((3.0, -3.0), ("lane+0.1",), "repair")
    assert repair_settings(replace(generator, shifts_m=(0.0,)), 1 / 3).paths == ("lane+0.1",)


def test_every_step_repairs_renders_of_the_fit_before_and_every_fit_goes_on_with_the_first(tmp_path, monkeypatch):
    done: list[tuple] = []

    def repaired(step):
        done.append(("repair", step.settings.shifts_m, "/".join(step.fitted.parts[-2:])))
        for shift in step.settings.shifts_m:
            (step.out / f"front_shift{shift:+.1f}").mkdir(parents=True)
            (step.out / f"front_shift{shift:+.1f}" / "observations.json").write_text("{}")
        return step.out

    def fitted(step):
        begun = None if step.start_from is None else "/".join(step.start_from.parts[-2:])
        observed = ["/".join(path.parts[-2:]) for path in step.observations]
        done.append((step.settings.method, step.settings.iterations, observed, begun))
        return step.out

    monkeypatch.setattr(Synthesize, "run", repaired)
    monkeypatch.setattr(Fit, "run", fitted)
    steps = Chain(tmp_path, tmp_path / "scene", BenchConfig(iterations=100), False, SynthesizeConfig(shifts_m=(3.0,)))
    row = Row("difix", "", "difix", FitConfig(method="difix", iterations=100))
    assert steps.fitted(row) == tmp_path / "fit" / "difix"
    first = "fit/street_gaussians"
    assert [entry for entry in done if entry[0] != "street_gaussians"] == [
        ("repair", (1.0,), first),
        ("difix", 50, ["1/front_shift+1.0"], first),
        ("repair", (2.0,), "start/difix-1"),
        ("difix", 50, ["1/front_shift+1.0", "2/front_shift+2.0"], first),
        ("repair", (3.0,), "start/difix-2"),
        ("difix", 50, ["1/front_shift+1.0", "2/front_shift+2.0", "3/front_shift+3.0"], first),
    ]
    replace(steps, out=tmp_path / "many", generator=SynthesizeConfig(shifts_m=(2.0, 3.0, 4.0))).fitted(row)
    # steps two and three pass places of the step before: the newer views count, once
    views = "1/+0.7 1/+1.0 2/+1.3 3/+2.0 2/+2.7 3/+3.0 3/+4.0"
    assert done[-1][2] == views.replace("/", "/front_shift").split()


def test_only_the_colour_of_a_repair_counts():
    used = recipe_of("difix").used(FitConfig(method="difix")).virtual
    assert (used.probability, used.continued_probability, used.color_weight, used.ssim_weight) == (0.3, 0.3, 0.3, 0.2)
    unused = ("depth_weight", "lidar_weight", "semantic_weight", "perceptual_weight", "gaussians")
    assert {getattr(used, name) for name in unused} == {0}
    assert "virtual" not in METHODS["difix"].supervision and "no last repair" in METHODS["difix"].title
    assert recipe_of("mudg_s").used(FitConfig()) == FitConfig()
