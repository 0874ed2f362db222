"""Densification: who grows, who goes, and that every column moves with its row."""

from __future__ import annotations

import math

import pytest
import torch
from refusals import refused

from mudg.base import config as configuration
from mudg.base import geometry
from mudg.base.errors import UsageError
from mudg.base.types import RasterTrace
from mudg.core.table import Table
from mudg.gaussians.densify import SPLIT_SHRINK, DensifySettings, DensifyStats, densify, reset_opacity, shorten_needles
from mudg.gaussians.model import SceneModel
from mudg.gaussians.nodes import RigidNode, StaticNode
from mudg.gaussians.settings import FitConfig

THRESHOLDS = {"static_gradient": 1.0, "object_gradient": 1.0, "split_above_m": 0.5, "growth": 10.0}
SETTINGS = DensifySettings(start=10, stop=100, every=10, max_rows=1000, **THRESHOLDS)


def scene(static: int = 6, moving: int = 4, scale_m: float = 0.1, opacity: float = 0.5) -> SceneModel:
    count = static + moving
    number = torch.arange(count, dtype=torch.float32)
    columns = {
        "means": torch.stack([number * 0.01, torch.zeros(count), torch.zeros(count)], 1),
        "quats": torch.eye(4)[:1].repeat(count, 1),
        "log_scales": torch.full((count, 3), math.log(scale_m)),
        "logits": torch.full((count,), math.log(opacity / (1 - opacity))),
        "sh_dc": number[:, None, None].repeat(1, 1, 3),
        "semantics": number[:, None].repeat(1, 2),
    }
    owner = torch.tensor([0] * static + [1] * moving, dtype=torch.int32)
    times, poses = [0.0, 1.0], [geometry.yaw_matrix(0.0), geometry.yaw_matrix(0.0, (1, 0, 0))]
    node = RigidNode("car", "car", (4.0, 2.0, 1.5), times, poses)
    model = SceneModel(Table(columns, {"node": owner}), (StaticNode(), node), None, (0, 1), 0)
    model.table.moment1["sh_dc"] += number[:, None, None] + 0.5
    return model


def stats_for(model: SceneModel, loud: list[int]) -> DensifyStats:
    stats = DensifyStats.zeros(len(model.table))
    stats.seen += 2
    stats.gradient[loud] = 6.0
    return stats


def test_useless_rows_go_and_nothing_happens_below_the_threshold():
    model = scene()
    before = {name: value.clone() for name, value in model.table.state().items()}
    report = densify(model, stats_for(model, []), 10, SETTINGS, 0)
    assert report == {"cloned": 0, "split": 0, "pruned": 0, "rows": 10}
    assert all(torch.equal(value, before[name]) for name, value in model.table.state().items())
    with torch.no_grad():
        model.table["logits"][1] = -8.0  # transparent
        model.table["log_scales"][2] = math.log(50.0)  # huge
        model.table["means"][7] = torch.tensor([9.0, 0, 0])  # outside its box
        model.table["means"][3] = torch.tensor([90.0, 0, 0])  # static: may be anywhere
    report = densify(model, stats_for(model, []), 10, SETTINGS, 0)
    assert report["pruned"] == 3
    assert model.table["sh_dc"][:, 0, 0].tolist() == [0, 3, 4, 5, 6, 8, 9]


def test_small_rows_are_cloned_with_fresh_moments():
    model = scene()
    report = densify(model, stats_for(model, [2, 7]), 10, SETTINGS, 0)
    assert report == {"cloned": 2, "split": 0, "pruned": 0, "rows": 12}
    assert model.counts() == [7, 5]
    assert model.table.labels["node"].tolist() == [0] * 7 + [1] * 5
    tags = model.table["sh_dc"][:, 0, 0].tolist()
    assert tags == [0, 1, 2, 3, 4, 5, 2, 6, 7, 8, 9, 7]
    assert model.table.moment1["sh_dc"][:, 0, 0].tolist() == [0.5, 1.5, 2.5, 3.5, 4.5, 5.5, 0, 6.5, 7.5, 8.5, 9.5, 0]
    assert torch.equal(model.table["means"][6], model.table["means"][2])


def test_large_rows_are_split_into_two_smaller_ones():
    model = scene(scale_m=1.0)
    report = densify(model, stats_for(model, [3]), 10, SETTINGS, 0)
    assert report == {"cloned": 0, "split": 1, "pruned": 0, "rows": 11}
    halves = (model.table["sh_dc"][:, 0, 0] == 3).nonzero()[:, 0]
    assert len(halves) == 2
    assert torch.allclose(model.table["log_scales"][halves].exp(), torch.tensor(1.0 / SPLIT_SHRINK))
    assert not torch.equal(model.table["means"][halves[0]], model.table["means"][halves[1]])
    assert (model.table["means"][halves] - torch.tensor([0.03, 0, 0])).abs().max() < 5.0
    for step in (10, 20):  # the same seed and step draw the same
        other = scene(scale_m=1.0)
        densify(other, stats_for(other, [3]), step, SETTINGS, 0)
        assert torch.equal(other.table["means"], model.table["means"]) == (step == 10)


def test_splits_are_drawn_along_the_gaussians_own_axes():
    """A needle along its local x, turned by 90 degrees about z, must split along world y."""
    model = scene(static=400, moving=4)
    with torch.no_grad():
        model.table["means"].zero_()
        model.table["log_scales"][:400] = torch.log(torch.tensor([2.0, 1e-3, 1e-3]))
        model.table["quats"][:400] = torch.tensor([math.sqrt(0.5), 0.0, 0.0, math.sqrt(0.5)])
    densify(model, stats_for(model, list(range(400))), 10, SETTINGS, 0)
    spread = model.table["means"][:800].detach().std(0)
    assert spread[1] == pytest.approx(2.0, rel=0.1) and max(spread[0], spread[2]) < 0.01


def test_the_budget_takes_the_loudest_first_and_thresholds_differ_by_node():
    model = scene(static=10, moving=0)
    stats = stats_for(model, [])
    stats.gradient += torch.arange(10.0) + 3
    settings = DensifySettings(start=1, stop=9, every=1, max_rows=12, **THRESHOLDS)
    densify(model, stats, 1, settings, 0)
    assert len(model.table) == 12 and sorted(model.table["sh_dc"][:, 0, 0].tolist())[-4:] == [8, 8, 9, 9]
    assert densify(model, stats_for(model, [0, 1]), 2, settings, 0)["rows"] == 12
    model = scene()
    settings = DensifySettings(start=1, stop=9, every=1, max_rows=99, **{**THRESHOLDS, "static_gradient": 5.0})
    densify(model, stats_for(model, [2, 7]), 1, settings, 0)
    assert model.counts() == [6, 5]


def test_statistics_count_visible_rows_and_objects_with_their_plain_gradient():
    """Opposite contributions of single pixels cancel there; the background keeps the absolute gradient."""
    stats = DensifyStats.zeros(2)
    visible, gradient = torch.tensor([True, False]), torch.tensor([[0.3, 0.4], [1.0, 1.0]])
    trace = RasterTrace(torch.zeros(2, 2), torch.zeros(2, 2, dtype=torch.int32), visible, gradient)
    stats.observe(trace, 200, 100)
    stats.observe(trace, 200, 100)
    assert stats.seen.tolist() == [2, 0]
    assert stats.gradient[0].item() == pytest.approx(2 * math.hypot(30.0, 20.0))
    assert stats.gradient[1].item() == 0
    with pytest.raises(ValueError, match="without absolute gradients"):
        stats.observe(RasterTrace(trace.means2d, trace.radii, trace.visible), 200, 100)
    stats = DensifyStats.zeros(3)
    means2d = torch.zeros(3, 2, requires_grad=True)
    means2d.grad = torch.tensor([[0.1, 0.0], [0.1, 0.0], [0.0, 0.2]])
    absolute = torch.tensor([[0.3, 0.0], [0.3, 0.0], [0.0, 0.4]])
    trace = RasterTrace(means2d, torch.zeros(3, 2, dtype=torch.int32), torch.ones(3, dtype=torch.bool), absolute)
    stats.observe(trace, 200, 100, plain_from=1)
    assert stats.gradient.tolist() == pytest.approx([30.0, 10.0, 10.0])
    stats.observe(trace, 200, 100)
    assert stats.gradient.tolist() == pytest.approx([60.0, 40.0, 30.0])


def test_opacity_reset_only_lowers_and_needles_are_shortened():
    model = scene()
    with torch.no_grad():
        model.table["logits"][0] = -6.0
    model.table.moment1["logits"] += 1
    reset_opacity(model)
    opacity = torch.sigmoid(model.table["logits"])
    assert opacity.max().item() == pytest.approx(0.01, rel=1e-4) and opacity[0] < 0.005
    assert (model.table.moment1["logits"] == 0).all()
    model = scene(static=2, moving=0)
    with torch.no_grad():
        model.table["log_scales"][0] = torch.log(torch.tensor([0.1, 5.0, 0.2]))  # a needle
        model.table["log_scales"][1] = torch.log(torch.tensor([3.0, 0.01, 4.0]))  # a disc
    shorten_needles(model.table, 4.0)
    assert model.table["log_scales"].exp()[0].tolist() == pytest.approx([0.1, 0.8, 0.2], rel=1e-5)
    assert model.table["log_scales"].exp()[1].tolist() == pytest.approx([3.0, 0.01, 4.0], rel=1e-5)


def test_when_it_is_due_and_a_wrong_kind_is_refused(tmp_path):
    due = [step for step in range(1, 130) if SETTINGS.due(step)]
    assert due == list(range(10, 101, 10))
    assert not any(SETTINGS.reset_due(step) for step in range(1, 130))
    (tmp_path / "fit.yaml").write_text("densify: {kind: mcm}\n")
    refused("'gradient' or 'none'", configuration.load, FitConfig, None, tmp_path / "fit.yaml", raises=UsageError)
