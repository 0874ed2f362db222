"""The radiance field: space and rays, what is learnt, the fit and its renders."""

from __future__ import annotations

import math
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from fit_settings import SMALL_RADIANCE, fit_config
from pretend_device import pretend_device
from refusals import refused
from toy_world import camera, fused_cloud, view_at, write_scene

from mudg.base import geometry, seeds, store
from mudg.base.errors import NumericsError, UsageError
from mudg.baselines import emernerf
from mudg.baselines.emernerf import (
    SIZES,
    Budget,
    Extent,
    RadianceField,
    RayDraws,
    aggregated,
    extent_of,
    lidar_rays,
    load_field,
    view_rays,
)
from mudg.diffusion.settings import SynthesizeConfig
from mudg.editing.settings import RenderConfig
from mudg.gaussians.settings import FitConfig
from mudg.scene.clouds import write_fused
from mudg.scene.observations import read_observations
from mudg.scene.read import read_scene
from mudg.steps.fit import Fit
from mudg.steps.fitted import FittedScene
from mudg.steps.render import RenderViews
from mudg.steps.synthesize import Synthesize

TINY = {"method": "emernerf", "iterations": 8, "preview_every": 100, "checkpoint_every": 4, **SMALL_RADIANCE}


def drawn(*shape: int, name: str = "values", dtype: torch.dtype = torch.float64) -> torch.Tensor:
    return torch.rand(shape, generator=seeds.torch_generator(1, 0, name), dtype=dtype)


def tiny_field() -> RadianceField:
    extent = Extent((1.0, 2.0, 3.0), (10.0, 20.0, 5.0), 0.0, 2.0, 0.2)
    return RadianceField(SIZES["tiny"], extent, ("front",), {"method": "emernerf"})


# ---- space and rays ------------------------------------------------------------------------------


def test_space_and_rays_by_hand():
    center, half = torch.tensor([1.0, 2.0, 3.0]), torch.tensor([10.0, 20.0, 5.0])
    places = torch.tensor([[1.0, 2, 3], [11, 2, 3], [1, -18, 3], [21, 2, 3], [1, 2, 1e9], [21, 22, 3]])
    wanted = [[8, 8, 8], [12, 8, 8], [8, 4, 8], [14, 8, 8], [8, 8, 16], [14, 11, 8]]
    assert torch.allclose(emernerf.contract(places, center, half), torch.tensor(wanted) / 16)
    along = torch.tensor([0.0, 0.25, 0.5, 0.75, 1.0])
    found = emernerf.distances(along, 0.1, 200.0, 1000.0)
    assert torch.allclose(found, torch.tensor([0.1, 100.05, 200.0, 1 / (0.5 / 200 + 0.5 / 1000), 1000.0]))
    edges = torch.tensor([[0.0, 1.0, 3.0, 4.0, 10.0]])
    density = torch.tensor([[0.5, 0.0, 2.0, 1e6]])
    first, third = 1 - math.exp(-0.5), math.exp(-0.5) * (1 - math.exp(-2.0))
    wanted = torch.tensor([[first, 0.0, third, math.exp(-2.5)]])
    assert torch.allclose(emernerf.rendering_weights(density, edges), wanted, atol=1e-6)


def test_samples_gather_where_the_weights_are():
    edges = torch.linspace(0, 1, 11)[None]
    weights = torch.zeros(1, 10)
    weights[0, 6] = 1.0
    found = emernerf.resampled_edges(edges, weights, 20, torch.full((1, 1), 0.5))
    assert found.shape == (1, 21) and (found.diff() >= 0).all()
    assert ((found >= 0.6) & (found <= 0.7)).float().mean() > 0.9
    for jitter in (0.0, 0.5, 0.99):
        across = emernerf.even_edges(1, 8, torch.full((1, 1), jitter))
        assert across[0, 0] == 0 and across[0, -1] == 1 and (across.diff() >= 0).all()
    even = emernerf.resampled_edges(edges, torch.ones(1, 10), 9, torch.full((1, 1), 0.5))
    assert torch.allclose(even[0], (torch.arange(10) + 0.5) / 10, atol=1e-6)


def test_a_blurred_histogram_keeps_its_mass_and_equals_a_fine_convolution():
    edges = torch.tensor([[0.2, 0.3, 0.45, 0.7]], dtype=torch.float64)
    weights = torch.tensor([[0.2, 0.5, 0.3]], dtype=torch.float64)
    wanted = torch.linspace(0, 1, 11, dtype=torch.float64)[None]
    radius, fine = 0.05, 20_000
    x = (torch.arange(fine, dtype=torch.float64) + 0.5) / fine
    height = torch.zeros(fine, dtype=torch.float64)
    for low, high, weight in zip(edges[0, :-1], edges[0, 1:], weights[0]):
        height[(x >= low) & (x < high)] = weight / (high - low)
    box = int(2 * radius * fine)
    blurred = torch.nn.functional.avg_pool1d(height[None, None], box + 1, 1, box // 2)[0, 0]
    expected = blurred.view(10, -1).sum(1) / fine
    found = emernerf.blurred_mass(edges, weights, wanted, radius)[0]
    assert torch.allclose(found, expected, atol=2e-4)
    assert float(found.sum()) == pytest.approx(1.0, abs=1e-9)


def test_proposals_that_agree_cost_nothing_and_others_do():
    edges = drawn(3, 9).sort(1).values
    weights = drawn(3, 8, name="weights")
    weights = weights / weights.sum(1, keepdim=True)
    assert float(emernerf.interlevel_loss(edges, weights, edges, weights, 0.0)) < 1e-6
    even, flat = torch.linspace(0, 1, 9).double().expand(2, -1), torch.full((2, 8), 0.125).double()
    assert float(emernerf.interlevel_loss(even, flat, even, flat, 0.03)) == pytest.approx(0.0, abs=1e-12)
    assert float(emernerf.interlevel_loss(edges, weights, edges, weights.flip(1), 0.0)) > 1e-2


# ---- the field -----------------------------------------------------------------------------------


def test_flow_aggregation_equals_a_loop_and_moves_its_flow():
    xyz, time, share = drawn(6, 3), drawn(6, 1, name="t"), drawn(6, 1, name="n")
    flow = drawn(6, 6, name="f").requires_grad_()

    def feature(places: torch.Tensor, times: torch.Tensor) -> torch.Tensor:
        return torch.cat([places.square().sum(1, keepdim=True), times * places[:, :1]], 1)

    found, step = aggregated(feature, xyz, time, flow, share, 0.1), 0.1
    for i in range(6):
        n = share[i]
        terms = [
            feature(xyz[i : i + 1], time[i : i + 1]),
            0.5 * feature((xyz[i] + n * flow[i, :3])[None], (time[i] + n * step)[None]),
            0.5 * feature((xyz[i] + n * flow[i, 3:])[None], (time[i] - n * step)[None]),
        ]
        assert torch.allclose(found[i], sum(terms)[0] / 2)
    found.sum().backward()
    assert (flow.grad.abs() > 0).all()


def test_color_loss_reaches_every_field_and_proposals_learn_only_when_asked():
    field = tiny_field()
    rays, _ = view_rays(view_at(0.3, camera("front", 6, 4)), field.extent, 0)
    budget = Budget((16, 12), 8, 0.1, 1000.0)
    draws = RayDraws.of(len(rays), budget, seeds.torch_generator(0, 1, "draws"), torch.device("cpu"))
    marched = emernerf.march(field, rays, budget, draws)
    emernerf.colors(field, rays, marched)[0].square().mean().backward()
    gradients = {name: value.grad for name, value in field.named_parameters() if value.grad is not None}
    reached = {name for name, gradient in gradients.items() if gradient.abs().sum() > 0}
    for part in ("static.table", "dynamic.table", "flow.net.weights.0", "color.out", "shadow", "sky", "appearance"):
        assert any(name.startswith(part) for name in reached), part
    assert not any(name.startswith("proposals") for name in reached)
    emernerf.proposal_loss(emernerf.march(field, rays, budget, draws, True)).backward()
    assert all(proposal.table.grad.abs().sum() > 0 for proposal in field.proposals)


def test_line_of_sight_wants_emptiness_before_the_surface_and_the_mass_of_a_bell_at_it():
    edges, measured = torch.tensor([[1.0, 8.0, 9.5, 10.5, 20.0, 30.0]]), torch.tensor([10.0])
    one = math.erf(1 / math.sqrt(2))  # the mass within a standard deviation, which is 0.5 m
    weights = torch.tensor([[0.2, (1 - one) / 2, one, (1 - one) / 2, 0.7]])
    assert float(emernerf.line_of_sight(weights, edges, measured, 1.5)) == pytest.approx(0.04, abs=5e-5)
    assert float(emernerf.line_of_sight(weights - 0.05, edges, measured, 1.5)) == pytest.approx(0.03, abs=5e-5)


def test_the_median_lies_where_half_of_the_weight_is_passed():
    edges = torch.tensor([[1.0, 2.0, 3.0, 5.0]]).expand(3, -1)
    weights = torch.tensor([[0.1, 0.8, 0.1], [0.2, 0.2, 0.4], [0.0, 0.0, 0.5]])
    marched = emernerf.Marched(edges, edges, edges[:, 1:], weights, edges, edges, (), *[edges] * 5)
    assert marched.median_m.tolist() == pytest.approx([2.5, 3.0, 4.0])
    assert marched.range_m.tolist() == pytest.approx([(0.2 + 2.4 + 0.5), (0.4 + 0.6 + 2.0) / 0.8, 5.0])


def test_schedules_and_published_sizes():
    assert [emernerf.rate_share(step, 1000) for step in (1, 200, 1000)] == pytest.approx([0.01, 1.0, 0.33**4])
    assert [emernerf.sight_width(step, 1000) for step in (80, 81, 290, 900)] == [0.0, 6.0, 3.0, 0.6]
    assert [emernerf.dynamic_share(step, 1000) for step in (1, 100, 300, 500, 900)] == pytest.approx([0, 0, 0.5, 1, 1])
    size = fit_config(method="emernerf", radiance__size="published").radiance.size
    assert SIZES[size].static == (10, 4, 16, 8192, 20)
    assert (emernerf.BUDGETS[size].proposals, emernerf.BATCHES[size]) == ((128, 64), (8192, 8192))
    assert emernerf.DIRECTION_WIDTH == 33


# ---- the fit -------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def world(tmp_path_factory) -> Path:
    root = tmp_path_factory.mktemp("world")
    write_scene(root / "scene", frames=4, width=24, height=16)
    write_scene(root / "bare", frames=4, width=24, height=16, tracks=False)
    write_fused(root / "fuse", fused_cloud(4), {})
    Fit(scene=root / "scene", out=root / "fit", settings=fit_config(**TINY)).run()
    return root


def test_resumed_equals_uninterrupted(world, tmp_path, monkeypatch):
    real, calls = emernerf.take_step, []

    def stopped(state, config, step):
        calls.append(step)
        if len(calls) == 6:
            raise KeyboardInterrupt
        return real(state, config, step)

    monkeypatch.setattr(emernerf, "take_step", stopped)
    fitting = Fit(scene=world / "scene", out=tmp_path / "fit", settings=fit_config(**TINY))
    with pytest.raises(KeyboardInterrupt):
        fitting.run()
    folder = fitting.run()
    assert calls == [1, 2, 3, 4, 5, 6, 5, 6, 7, 8]
    assert (folder / "field.safetensors").read_bytes() == (world / "fit" / "field.safetensors").read_bytes()
    assert not (folder / "steps").exists()


def started(world: Path, device: str | torch.device = "cpu") -> tuple[emernerf.RadianceState, FitConfig]:
    config, folder = fit_config(**TINY), SimpleNamespace(path=world / "none")
    return emernerf.prepare(config, read_scene(world / "scene"), folder, torch.device(device)), config


@pytest.mark.slow
def test_a_step_on_another_device_is_the_same(world, monkeypatch):
    monkeypatch.setitem(emernerf.BATCHES, "tiny", (8, 8))

    def two_steps(device: str | torch.device) -> dict[tuple[int, str], float]:
        state, config = started(world, device)
        steps = ((step, emernerf.take_step(state, config, step)) for step in (1, 2))
        return {(step, name): float(value.detach().cpu()) for step, terms in steps for name, value in terms.items()}

    with pretend_device() as there:
        elsewhere = two_steps(there)
    assert elsewhere == pytest.approx(two_steps("cpu"), rel=1e-3, abs=1e-6)


def test_what_is_not_finite_never_reaches_the_parameters(world):
    state, config = started(world)
    state.pixels._rgb = torch.full_like(state.pixels._rgb, 7).float() * torch.nan
    before = {name: value.clone() for name, value in state.field.state_dict().items()}
    refused("color", emernerf.take_step, state, config, 1, raises=NumericsError)
    assert all(torch.equal(value, before[name]) for name, value in state.field.state_dict().items())


def test_renders_as_observations_without_classes(world, tmp_path):
    render = partial(RenderViews, scene=world / "scene", model=world / "fit")
    out = render(out=tmp_path / "render", settings=RenderConfig(shifts_m=(0.0, 2.0), video=True)).run()
    seen = read_observations(out / "front_shift+2.0")[1]
    assert seen.source == "emernerf" and seen.semantics is None
    assert seen.rgb.shape == (3, 16, 24) and torch.isfinite(seen.rgb).all()
    known = seen.depth[torch.isfinite(seen.depth)]
    assert len(known) and (known > 0).all()
    (tmp_path / "edits.yaml").write_text("- remove: {ids: [car]}\n")
    other = render(out=tmp_path / "other", edits=tmp_path / "edits.yaml", settings=RenderConfig())
    refused("no objects", other.run, raises=UsageError)


def test_saved_field_is_the_fitted_one(world):
    field, budget = load_field(world / "fit")
    assert budget == emernerf.BUDGETS["tiny"]
    assert field.facts == {"method": "emernerf", "scene": "toy"}
    values = store.read_json(world / "fit" / "model.json")
    tensors = store.read_tensors(world / "fit" / "field.safetensors")
    tensors.pop("appearance")
    refused("appearance", RadianceField.from_state, values, tensors)


def test_what_needs_gaussians_refuses_a_radiance_field(world, tmp_path):
    refused("radiance field", FittedScene.read, world / "fit", "cpu")
    inputs = {"scene": world / "scene", "fused": world / "fuse", "fitted": world / "fit"}
    refused("radiance field", Synthesize(**inputs, out=tmp_path / "virtual", settings=SynthesizeConfig()).run)
    store.write_json(tmp_path / "model.json", {"schema": 1})
    refused("no radiance field", load_field, tmp_path)
    again = partial(Fit, scene=world / "scene")
    more = again(start_from=world / "fit", out=tmp_path / "more", settings=fit_config(**TINY))
    refused("cannot go on", more.run, raises=UsageError)
    gs3d = again(out=tmp_path / "gs3d", settings=fit_config(method="gs3d"))
    refused("needs fused clouds", gs3d.run, raises=UsageError)


# ---- rays ----------------------------------------------------------------------------------------


def test_pixels_and_lidar_are_rays_of_the_world(world):
    scene = read_scene(world / "scene")
    lidar = lidar_rays(scene)
    extent = extent_of(scene, lidar)
    ends = lidar[0].origins + lidar[1][:, None] * lidar[0].directions
    assert float((ends[:, 2]).min()) > -0.1  # nothing below the ground
    inside = emernerf.contract(ends, torch.tensor(extent.center), torch.tensor(extent.half))
    assert 0.85 < float(((inside > 0.249) & (inside < 0.751)).all(1).float().mean()) < 0.99
    assert extent.step == pytest.approx(0.3 / 0.9) and extent.normalised(-5.0) == 0.0
    view = scene.frames[1].view
    rays, z_per_m = view_rays(view, extent, 0)
    assert torch.allclose(rays.directions.norm(dim=1), torch.ones(len(rays)), atol=1e-6)
    place = rays.origins[5 * 24 + 7] + 10 / z_per_m[5 * 24 + 7] * rays.directions[5 * 24 + 7]
    uv, z = geometry.project(view, place.numpy()[None])
    assert np.allclose(uv[0], (7.5, 5.5), atol=1e-3) and z[0] == pytest.approx(10.0, abs=1e-4)


def test_a_batch_of_pixels_shows_what_the_rays_meet(world):
    state, _ = started(world)
    rays, (rgb, _, sky), cells = state.pixels.batch(40, 0.25, seeds.torch_generator(0, 1, "batch"))
    assert rgb.shape == (40, 3) and sky.dtype == torch.bool
    assert not (sky & (rays.directions[:, 2] < -0.05)).any()  # no sky below the horizon
    state.pixels.note(cells, torch.ones(40))
    assert (state.pixels.errors[cells] == 1.0).all()
    state.pixels.errors.zero_()
    state.pixels.errors[3] = 1.0
    assert (state.pixels.batch(40, 1.0, seeds.torch_generator(0, 2, "batch"))[2] == 3).all()
