"""Densification by relocation: what a stack looks like, who moves where, and that every column moves with its row."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from mudg.base import geometry
from mudg.base.types import Camera, Gaussians, View
from mudg.core.raster.rasterize import RasterConfig, rasterize
from mudg.core.table import Table
from mudg.gaussians import densify as mcmc
from mudg.gaussians.densify import (
    McmcSettings,
    drift,
    order_of_place,
    random_step,
    relocate_and_grow,
    stack_of,
    systematic_counts,
)
from mudg.gaussians.model import SceneModel
from mudg.gaussians.nodes import RigidNode, StaticNode

SETTINGS = McmcSettings(start=10, stop=100, every=10, max_rows=1000, growth=0.0)
NOWHERE = -9.0  # a logit of opacity 0.0001


def scene(
    static: int = 8, moving: int = 5, dead: tuple[int, ...] = (), opacity: float = 0.5, seed: int = 0
) -> SceneModel:
    """Rows with a tag (``sh_dc``) and a moment that follows it; ``dead`` ones are transparent."""
    count = static + moving
    generator = torch.Generator().manual_seed(seed)
    tag = torch.arange(count, dtype=torch.float32)
    logits = torch.full((count,), math.log(opacity / (1 - opacity))) + 0.3 * torch.randn(count, generator=generator)
    logits[list(dead)] = NOWHERE
    columns = {
        "means": 0.3 * torch.randn(count, 3, generator=generator),
        "quats": torch.randn(count, 4, generator=generator),
        "log_scales": -2 + 0.3 * torch.randn(count, 3, generator=generator),
        "logits": logits,
        "sh_dc": tag[:, None, None].repeat(1, 1, 3),
        "semantics": tag[:, None].repeat(1, 2),
    }
    owner = torch.tensor([0] * static + [1] * moving, dtype=torch.int32)
    poses = [geometry.yaw_matrix(0.0), geometry.yaw_matrix(0.0, (1, 0, 0))]
    node = RigidNode("car", "car", (4.0, 2.0, 1.5), [0.0, 1.0], poses)
    model = SceneModel(Table(columns, {"node": owner}), (StaticNode(), node), None, (0, 1), 0)
    for moments in (model.table.moment1, model.table.moment2):
        for value in moments.values():
            value += (tag + 1).view(-1, *[1] * (value.ndim - 1))
    return model


def tags(model: SceneModel) -> list[int]:
    return [int(value) for value in model.table["sh_dc"][:, 0, 0].tolist()]


# ---- the stack -----------------------------------------------------------------------------------


@pytest.mark.parametrize("opacity", [0.01, 0.3, 0.9, 0.999])
@pytest.mark.parametrize("members", [1, 2, 5, 51])
def test_a_stack_covers_what_the_one_covered(opacity: float, members: int) -> None:
    """At the centre exactly; along a line through it in the integral (by quadrature)."""
    each, factor = stack_of(torch.tensor([opacity], dtype=torch.float64), torch.tensor([members]))
    assert 1 - (1 - each.item()) ** members == pytest.approx(opacity, rel=1e-9)
    x = np.linspace(-12, 12, 200_001)
    one = opacity * np.exp(-(x**2) / 2)
    stack = 1 - (1 - each.item() * np.exp(-((x / factor.item()) ** 2) / 2)) ** members
    assert np.trapezoid(stack, x) == pytest.approx(np.trapezoid(one, x), rel=1e-8)
    assert (factor.item() == 1.0) == (members == 1)


def test_one_gaussian_stays_as_it_is_and_none_is_fine() -> None:
    each, factor = stack_of(torch.tensor([0.2, 0.7], dtype=torch.float64), torch.tensor([1, 1]))
    assert each.tolist() == pytest.approx([0.2, 0.7], rel=1e-12)
    assert factor.tolist() == [1.0, 1.0]
    assert len(stack_of(torch.zeros(0).double(), torch.zeros(0, dtype=torch.int64))[0]) == 0


@pytest.mark.parametrize("members", [2, 7])
def test_a_rendered_stack_keeps_alpha_and_colour(members: int) -> None:
    """Drawn by the renderer: the pixel at the centre, and the sum along the row through it."""
    opacity, view = 0.8, View(Camera("c", 161, 9, 400.0, 400.0, 80.5, 4.5), np.eye(4), 0.0)

    def drawn(count: int, alpha: float, scale_m: float) -> torch.Tensor:
        one = torch.ones(count, 1)
        gaussians = Gaussians(
            means=one * torch.tensor([[0.0, 0.0, 4.0]]),
            quats=one * torch.tensor([[1.0, 0, 0, 0]]),
            scales=torch.full((count, 3), scale_m),
            opacity=torch.full((count,), alpha),
            sh=one[:, None] * torch.tensor([0.3, -0.2, 1.0]),
            extra=None,
            node=torch.zeros(count, dtype=torch.int32),
        )
        render = rasterize(gaussians, view, RasterConfig(backend="torch", blur_px2=0.0))
        return torch.cat([render.alpha, render.rgb])

    each, factor = stack_of(torch.tensor([opacity], dtype=torch.float64), torch.tensor([members]))
    one, stack = drawn(1, opacity, 0.2), drawn(members, each.item(), 0.2 * factor.item())
    assert torch.allclose(stack[:, 4, 80], one[:, 4, 80], atol=1e-5)
    assert torch.allclose(stack[:, 4].sum(1), one[:, 4].sum(1), rtol=0.01)  # contributions below 1/255 are not drawn
    wrong = drawn(members, each.item(), 0.2)  # without the correction of the scale
    assert (wrong[0, 4].sum() - one[0, 4].sum()).abs() > 3 * (stack[0, 4].sum() - one[0, 4].sum()).abs()


# ---- the draw ------------------------------------------------------------------------------------


def test_systematic_draws_have_the_wanted_number_and_stay_within_one_of_their_expectation() -> None:
    rng = np.random.default_rng(0)
    for _ in range(30):
        weights = torch.from_numpy(rng.random(50) * (rng.random(50) > 0.3))
        total = int(rng.integers(1, 200))
        counts = systematic_counts(weights, total, float(rng.random()))
        assert int(counts.sum()) == total
        assert ((counts - total * weights / weights.sum()).abs() < 1).all()
        assert (counts[weights == 0] == 0).all()
    offsets = np.linspace(0, 1, 1000, endpoint=False)
    mean = (
        torch.stack([systematic_counts(torch.tensor([0.2, 0.5, 0.3]).double(), 4, u) for u in offsets]).double().mean(0)
    )
    assert mean.tolist() == pytest.approx([0.8, 2.0, 1.2], abs=0.01)
    assert systematic_counts(torch.zeros(3).double(), 0, 0.5).tolist() == [0, 0, 0]


def test_the_order_of_place_is_that_of_the_places() -> None:
    means = torch.tensor([[1.0, 0, 0], [0, 5, 0], [0, 2, 7], [0, 2, 3]])
    assert order_of_place(means).tolist() == [3, 2, 1, 0]


# ---- relocation ----------------------------------------------------------------------------------


def test_nothing_dead_and_no_growth_changes_nothing() -> None:
    model = scene()
    before = {name: value.clone() for name, value in model.table.state().items()}
    assert relocate_and_grow(model, 10, SETTINGS, 0) == {"relocated": 0, "added": 0, "dropped": 0, "rows": 13}
    assert all(torch.equal(value, before[name]) for name, value in model.table.state().items())


def test_the_dead_of_a_node_become_copies_in_the_same_node_with_everything_that_belongs_to_them() -> None:
    model = scene(dead=(1, 6, 10))
    old = {name: value.clone() for name, value in model.table.state().items()}
    report = relocate_and_grow(model, 10, SETTINGS, 0)
    assert report == {"relocated": 3, "added": 0, "dropped": 0, "rows": 13}
    assert model.counts() == [8, 5]
    assert model.table.labels["node"].tolist() == [0] * 8 + [1] * 5
    now = model.table.state()
    seen = tags(model)
    assert not {1, 6, 10} & set(seen)
    assert all(tag < 8 for tag in seen[:8]) and all(tag >= 8 for tag in seen[8:])
    for row, tag in enumerate(seen):
        members = seen.count(tag)
        each, factor = stack_of(torch.sigmoid(old["column.logits"][tag].double())[None], torch.tensor([members]))
        for name in ("means", "quats", "semantics", "sh_dc"):
            assert torch.equal(now[f"column.{name}"][row], old[f"column.{name}"][tag])
        assert torch.sigmoid(now["column.logits"][row]).item() == pytest.approx(each.item(), rel=1e-5)
        change = (now["column.log_scales"][row] - old["column.log_scales"][tag]).tolist()
        assert change == pytest.approx([math.log(factor.item())] * 3, abs=1e-6)
        for moment in ("moment1", "moment2"):  # forgotten where one became several
            for name in model.table.columns:
                expected = tag + 1 if members == 1 else 0
                assert (now[f"{moment}.{name}"][row] == expected).all()


def test_the_order_of_the_rows_does_not_matter() -> None:
    """The same Gaussians in another order give the same Gaussians."""
    settings = McmcSettings(start=1, stop=9, every=1, max_rows=70, growth=0.2)
    model, other = (scene(40, 20, dead=(3, 11, 12, 45, 50), seed=4) for _ in range(2))
    shuffled = torch.cat([torch.randperm(40), 40 + torch.randperm(20)])
    other.table.take(shuffled)
    for one in (model, other):
        relocate_and_grow(one, 10, settings, 7)
    assert len(model.table) == len(other.table) > 60
    rows = [
        torch.cat([v.reshape(len(one.table), -1).double() for v in one.table.state().values()], 1)
        for one in (model, other)
    ]
    for one in rows:
        assert torch.isfinite(one).all()
    assert sorted(map(tuple, rows[0].tolist())) == sorted(map(tuple, rows[1].tolist()))


def test_draws_follow_seed_and_step() -> None:
    def after(step: int, seed: int) -> list[int]:
        model = scene(60, 30, dead=tuple(range(0, 60, 5)))
        relocate_and_grow(model, step, SETTINGS, seed)
        return tags(model)

    assert after(10, 0) == after(10, 0)
    assert after(20, 0) != after(10, 0)
    assert after(10, 1) != after(10, 0)


def test_growth_goes_up_to_the_cap_and_never_beyond() -> None:
    model = scene(60, 40)
    settings = McmcSettings(start=1, stop=9, every=1, max_rows=123, growth=0.1)
    sizes = []
    for step in range(1, 8):
        sizes.append(relocate_and_grow(model, step, settings, 0)["rows"])
        with torch.no_grad():
            model.table["logits"][step] = NOWHERE  # one dies per round
    assert sizes == [110, 121, 123, 123, 123, 123, 123]
    over = scene(60, 40)  # more rows than the cap: nothing is thrown away, nothing is added
    assert relocate_and_grow(over, 1, McmcSettings(1, 9, 1, max_rows=50), 0)["rows"] == 100


def test_a_node_whose_rows_are_all_dead_keeps_them() -> None:
    model = scene(dead=(8, 9, 10, 11, 12))
    report = relocate_and_grow(model, 10, SETTINGS, 0)
    assert report["rows"] == 13
    assert tags(model) == list(range(13))


def test_a_stack_never_gets_so_many_members_that_they_are_dead() -> None:
    """One faint live row among many dead: what finds no place is dropped."""
    model = scene(static=40, moving=0, dead=tuple(range(1, 40)))
    with torch.no_grad():
        model.table["logits"][0] = math.log(0.04 / 0.96)
    report = relocate_and_grow(model, 10, SETTINGS, 0)
    alive = torch.sigmoid(model.table["logits"])
    assert (alive >= SETTINGS.least_opacity).all()
    assert report["rows"] == int(math.log(1 - 0.04) / math.log(1 - SETTINGS.least_opacity)) == len(model.table)
    assert report["dropped"] == 40 - report["rows"]
    opaque = scene(static=90, moving=0, dead=tuple(range(1, 90)), opacity=0.97)
    assert relocate_and_grow(opaque, 10, SETTINGS, 0)["rows"] == mcmc.LARGEST_STACK


def test_an_opaque_gaussian_can_be_stacked_too() -> None:
    model = scene(static=3, moving=0, dead=(2,))
    with torch.no_grad():
        model.table["logits"][:2] = 40.0
    relocate_and_grow(model, 10, SETTINGS, 0)
    assert all(torch.isfinite(value).all() for value in model.table.columns.values())
    opacity = torch.sigmoid(model.table["logits"].detach().double())
    assert sorted(set(tags(model))) == [0, 1]
    for tag in (0, 1):  # a stack hides what is behind it as its one member did
        member = torch.tensor([mine == tag for mine in tags(model)])
        assert 1 - float((1 - opacity[member]).prod()) > 0.99


def test_what_left_its_box_or_grew_too_large_is_dead() -> None:
    model = scene()
    with torch.no_grad():
        model.table["means"][9] = torch.tensor([9.0, 0, 0])  # outside the car
        model.table["means"][2] = torch.tensor([90.0, 0, 0])  # static: may be anywhere
        model.table["log_scales"][3] = math.log(50.0)
    assert relocate_and_grow(model, 10, SETTINGS, 0)["relocated"] == 2
    assert 2 in tags(model)
    assert not {3, 9} & set(tags(model))


# ---- the random step -----------------------------------------------------------------------------


def test_the_random_step_has_the_shape_of_the_covariance_and_fades_with_opacity() -> None:
    """A Gaussian turned by 90 degrees about z; the published step within its bound."""
    count = 20_000
    quats = torch.tensor([[math.sqrt(0.5), 0.0, 0.0, math.sqrt(0.5)]]).repeat(count, 1)
    scales = torch.tensor([[0.02, 0.01, 5.0]]).repeat(count, 1)
    noise = torch.randn(count, 3, generator=torch.Generator().manual_seed(0))
    for opacity, gate in ((0.005, 0.5), (0.03, 1 / (1 + math.exp(2.5)))):
        moved = random_step(scales, quats, torch.full((count,), opacity), noise, 1e-3, SETTINGS)
        spread = moved.std(0).tolist()
        published = [1e-3 * SETTINGS.step_per_m2 * s**2 * gate for s in (0.01, 0.02)]  # x and y change places
        assert spread[:2] == pytest.approx(published, rel=0.03)
        assert spread[2] == pytest.approx(5.0 * gate, rel=0.03)  # bounded by the size
    opaque = random_step(scales, quats, torch.full((count,), 0.5), noise, 1e-3, SETTINGS)
    assert opaque.abs().max() < 1e-15


def test_only_the_nearly_transparent_drift_and_only_their_centres() -> None:
    model = scene(dead=(2, 9))
    before = {name: value.clone() for name, value in model.table.state().items()}
    drift(model, 3, 1e-3, SETTINGS, 0)
    after = model.table.state()
    moved = (after["column.means"] != before["column.means"]).any(1).nonzero()[:, 0].tolist()
    assert moved == [2, 9]
    assert all(torch.equal(after[name], before[name]) for name in after if name != "column.means")
    again, later = scene(dead=(2, 9)), scene(dead=(2, 9))
    drift(again, 3, 1e-3, SETTINGS, 0)
    drift(later, 4, 1e-3, SETTINGS, 0)
    assert torch.equal(again.table["means"], model.table["means"])
    assert not torch.equal(later.table["means"], model.table["means"])


def test_when_it_is_due() -> None:
    assert [step for step in range(1, 130) if SETTINGS.due(step)] == list(range(10, 101, 10))
