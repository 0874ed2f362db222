"""The rasteriser: known answers, the float64 specification, published formulas, invariants, poison, memory."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from raster_scenes import (
    GROUPS,
    IMAGES,
    Parameters,
    axis_view,
    cloud,
    gaussians_of,
    leaves_of,
    outside_band,
    view_of,
    weighted,
)
from refusals import refused
from torch import Tensor

from mudg import native
from mudg.base.errors import NumericsError, ResourceError, UsageError
from mudg.base.types import View
from mudg.core.raster import cpu as raster_cpu
from mudg.core.raster import gsplat_cuda, torch_twin
from mudg.core.raster.rasterize import BACKENDS, RasterConfig, rasterize

needs_native = pytest.mark.skipif(native.library() is None, reason=native.status())
CPU, TORCH = RasterConfig(backend="cpu"), RasterConfig(backend="torch")


def _one(mean: tuple[float, float, float], scale: float, opacity: float, rgb: tuple[float, float, float]) -> Parameters:
    sh = (torch.tensor(rgb) - 0.5) / 0.2820947917738781
    return {
        "means": torch.tensor([mean]),
        "quats": torch.tensor([[1.0, 0, 0, 0]]),
        "scales": torch.full((1, 3), scale),
        "opacity": torch.tensor([opacity]),
        "sh": sh[None, None],
        "extra": torch.tensor([[2.0]]),
    }


@pytest.fixture(params=["torch", pytest.param("cpu", marks=needs_native)])
def config(request: pytest.FixtureRequest) -> RasterConfig:
    return RasterConfig(backend=request.param)


# ---- known answers -------------------------------------------------------------------------------


def test_one_gaussian_on_the_axis_has_the_alpha_of_the_formula(config: RasterConfig) -> None:
    view, scale, z, opacity = axis_view(21, 15), 0.4, 5.0, 0.8
    out = rasterize(gaussians_of(_one((0, 0, z), scale, opacity, (0.9, 0.5, 0.1))), view, config)
    variance = (20.0 * scale / z) ** 2 + 0.3  # pixels^2
    ys, xs = np.mgrid[0:15, 0:21]
    alpha = opacity * np.exp(-0.5 * ((xs - 10.0) ** 2 + (ys - 7.0) ** 2) / variance)
    alpha[alpha < 1 / 255] = 0
    np.testing.assert_allclose(out.alpha[0].numpy(), alpha, atol=2e-6)
    for channel, value in enumerate((0.9, 0.5, 0.1)):
        np.testing.assert_allclose(out.rgb[channel].numpy(), alpha * value, atol=2e-6)
    np.testing.assert_allclose(out.extra[0].numpy(), alpha * 2, atol=4e-6)
    np.testing.assert_allclose(out.depth[0].numpy(), np.where(alpha > 0, z, 0), rtol=2e-5)
    assert out.trace.visible.tolist() == [True]
    np.testing.assert_allclose(out.trace.means2d.numpy(), [[10.5, 7.5]], atol=1e-5)
    reach = np.sqrt(2 * np.log(opacity * 255) * variance)
    np.testing.assert_allclose(out.trace.radii.numpy(), np.ceil([[reach, reach]]), atol=1)


def test_the_nearer_of_two_covers_the_farther_whatever_their_order(config: RasterConfig) -> None:
    near, far = _one((0, 0, 4.0), 3.0, 0.6, (1, 0, 0)), _one((0, 0, 8.0), 6.0, 0.5, (0, 1, 0))
    for first, second in ((near, far), (far, near)):
        both = {name: torch.cat([first[name], second[name]]) for name in first}
        out = rasterize(gaussians_of(both), axis_view(5, 5), config)
        centre = [float(out.rgb[0, 2, 2]), float(out.rgb[1, 2, 2]), float(out.alpha[0, 2, 2])]
        np.testing.assert_allclose(centre, [0.6, 0.4 * 0.5, 1 - 0.4 * 0.5], atol=1e-5)
        assert float(out.depth[0, 2, 2]) == pytest.approx((0.6 * 4 + 0.2 * 8) / 0.8, rel=1e-5)


def test_alpha_is_capped(config: RasterConfig) -> None:
    huge = gaussians_of(_one((0, 0, 5.0), 1e4, 1.0, (0, 1, 0)))
    out = rasterize(huge, axis_view(33, 18), replace(config, alpha_max=0.9))
    torch.testing.assert_close(out.alpha, torch.full((1, 18, 33), 0.9), atol=1e-5, rtol=0)
    torch.testing.assert_close(out.rgb[1:2], out.alpha, atol=1e-5, rtol=0)


def test_antialiasing_dims_a_gaussian_smaller_than_a_pixel_by_the_ratio_of_areas(config: RasterConfig) -> None:
    dot = gaussians_of(_one((0, 0, 5.0), 0.05, 0.9, (1, 1, 1)))  # sigma 0.2 px
    plain = float(rasterize(dot, axis_view(15, 15), config).alpha[0, 7, 7])
    careful = float(rasterize(dot, axis_view(15, 15), replace(config, antialias=True)).alpha[0, 7, 7])
    sharp = (20 * 0.05 / 5) ** 2
    assert plain == pytest.approx(0.9, rel=1e-5)
    assert careful == pytest.approx(0.9 * sharp / (sharp + 0.3), rel=1e-5)


def test_colours_follow_the_viewing_direction_and_are_clamped_at_zero(config: RasterConfig) -> None:
    p = _one((0, 0, 5.0), 1.0, 0.5, (0.5, 0.5, 0.5))
    p["sh"] = torch.cat([p["sh"], torch.zeros(1, 3, 3)], 1)
    p["sh"][0, 2] = torch.tensor([1.0, -2.0, 0.0])  # the band along z, seen along +z
    centre = rasterize(gaussians_of(p), axis_view(9, 9), config).rgb[:, 4, 4]
    expected = torch.tensor([0.5 + 0.48860251190292, 0.0, 0.5]) * 0.5
    torch.testing.assert_close(centre, expected, atol=1e-5, rtol=0)


# ---- against the float64 specification -----------------------------------------------------------


@pytest.mark.parametrize("antialias", [False, True])
@pytest.mark.parametrize("seed", [0, 1])
def test_native_agrees_with_the_float64_reference(isa: str, antialias: bool, seed: int) -> None:
    view, p = view_of(53, 38), cloud(400, seed)
    single, double = leaves_of(p), leaves_of(p, torch.float64)
    pose32 = torch.tensor(view.world_from_cam, dtype=torch.float32, requires_grad=True)
    pose64 = pose32.detach().double().requires_grad_()
    got, want = (
        rasterize(gaussians_of(q), view, replace(c, antialias=antialias), world_from_cam=pose, absgrad=True)
        for q, c, pose in ((single, CPU, pose32), (double, TORCH, pose64))
    )
    weights, _ = outside_band(got, want, seed)
    weighted(got, weights).backward()
    weighted(want, weights).backward()
    pairs = {name: (single[name].grad, double[name].grad) for name in GROUPS}
    pairs |= {"pose": (pose32.grad, pose64.grad), "abs": (got.trace.abs_grad2d, want.trace.abs_grad2d)}
    pairs["means2d"] = (got.trace.means2d.grad, want.trace.means2d.grad)
    for name, (mine, reference) in pairs.items():
        assert reference.norm() > 0, name
        assert (mine.double() - reference).norm() / reference.norm() < 1e-4, name
    assert torch.equal(got.trace.visible, want.trace.visible)


# ---- invariants ----------------------------------------------------------------------------------


def _everything(p: Parameters, view: View, config: RasterConfig) -> list[Tensor]:
    leaves = leaves_of(p)
    out = rasterize(gaussians_of(leaves), view, config, absgrad=True)
    generator = torch.Generator().manual_seed(5)
    weighted(out, {n: torch.randn(getattr(out, n).shape, generator=generator) for n in IMAGES}).backward()
    images = [getattr(out, name) for name in IMAGES]
    everything = (*images, out.trace.means2d.grad, out.trace.abs_grad2d, *(leaves[n].grad for n in GROUPS))
    return [t.detach() for t in everything if t is not None]


def test_results_do_not_depend_on_the_number_of_threads(set_threads: Callable[[int], None]) -> None:
    p, view = cloud(3000), view_of(90, 70)
    results = []
    for threads in (1, 2, 5):
        set_threads(threads)
        results.append(_everything(p, view, CPU))
    assert len(results[0]) == 12
    assert all(torch.equal(mine, theirs) for other in results[1:] for mine, theirs in zip(results[0], other))


def test_the_parallel_depth_sort_is_stable(set_threads: Callable[[int], None]) -> None:
    """Enough Gaussians for several parts of the sort, many at equal depth: one picture for any number of threads."""
    p, view = cloud(60_000, channels=1), axis_view(96, 80)
    p["scales"] *= 0.1
    p["means"][:, 2] = p["means"][:, 2].round()
    drawn = []
    for threads in (1, 2, 3, 9):
        set_threads(threads)
        drawn.append(rasterize(gaussians_of(p), view, CPU))
    assert len(torch.unique(p["means"][drawn[0].trace.visible, 2])) < 50 < int(drawn[0].trace.visible.sum())
    for other in drawn[1:]:
        assert torch.equal(drawn[0].rgb, other.rgb) and torch.equal(drawn[0].depth, other.depth)


@pytest.mark.parametrize("degree", [1, 2, 3])
def test_harmonics_in_two_tensors_give_the_same_picture_and_gradients(config: RasterConfig, degree: int) -> None:
    p, view = cloud(300, degree=degree), view_of()
    joined, parted = leaves_of(p), leaves_of(p)
    first, rest = (t.detach().clone().requires_grad_() for t in (p["sh"][:, :1], p["sh"][:, 1:]))
    one = rasterize(gaussians_of(joined), view, config)
    two = rasterize(replace(gaussians_of(parted), sh=first, sh_rest=rest), view, config)
    for drawn in (one, two):
        (drawn.rgb.square().sum() + drawn.depth.sum()).backward()
    assert torch.equal(one.rgb, two.rgb)
    assert torch.equal(joined["sh"].grad, torch.cat([first.grad, rest.grad], 1))
    assert torch.equal(joined["means"].grad, parted["means"].grad)


def test_the_order_of_the_gaussians_does_not_matter(config: RasterConfig) -> None:
    p, view = cloud(300), view_of()
    order = torch.randperm(300, generator=torch.Generator().manual_seed(1))
    plain = rasterize(gaussians_of(p), view, config)
    mixed = rasterize(gaussians_of({n: v[order] for n, v in p.items()}), view, config)
    for name in ("rgb", "depth", "alpha"):
        torch.testing.assert_close(getattr(plain, name), getattr(mixed, name), atol=1e-6, rtol=1e-6)
    assert torch.equal(plain.trace.visible[order], mixed.trace.visible)


@needs_native
@pytest.mark.parametrize("channels", [0, 1, 4, 5, 8, 9, 13, 17, 20, 21, 24, 25, 28])
def test_any_number_of_channels_gives_the_same_numbers(channels: int) -> None:
    p, view = cloud(300, channels=28), view_of()
    full = leaves_of(p)
    part = leaves_of({**p, "extra": p["extra"][:, :channels]})
    a, b = rasterize(gaussians_of(full), view, CPU), rasterize(gaussians_of(part), view, CPU)
    assert torch.equal(a.rgb, b.rgb) and torch.equal(a.extra[:channels], b.extra)
    (a.extra[:channels].square().sum() + a.rgb.sum()).backward()
    (b.extra.square().sum() + b.rgb.sum()).backward()
    torch.testing.assert_close(full["means"].grad, part["means"].grad, rtol=1e-4, atol=1e-4)
    torch.testing.assert_close(full["extra"].grad[:, :channels], part["extra"].grad, rtol=1e-5, atol=1e-5)


@needs_native
def test_far_from_the_origin_nothing_is_lost() -> None:
    p, view = cloud(500), view_of()
    p["means"] = (p["means"] * 64).round() / 64  # exactly representable at 4096 m, too
    shift = np.array([4096.0, -2048.0, 512.0])
    pose = view.world_from_cam.copy()
    pose[:3, 3] += shift
    moved = {**p, "means": p["means"] + torch.tensor(shift, dtype=torch.float32)}
    here = rasterize(gaussians_of(p), view, CPU)
    there = rasterize(gaussians_of(moved), View(view.camera, pose, 0.0), CPU)
    torch.testing.assert_close(here.rgb, there.rgb, atol=1e-5, rtol=0)


@needs_native
def test_several_graphs_may_be_alive_and_end_in_any_order() -> None:
    view = view_of()
    scenes = [leaves_of(cloud(200, seed)) for seed in range(3)]
    alone = []
    for scene in scenes:
        rasterize(gaussians_of(scene), view, CPU).rgb.square().sum().backward()
        alone.append(scene["means"].grad.clone())
        scene["means"].grad = None
    losses = [rasterize(gaussians_of(scene), view, CPU).rgb.square().sum() for scene in scenes]
    for index in (1, 2, 0):
        losses[index].backward()
    assert all(torch.equal(scene["means"].grad, expected) for scene, expected in zip(scenes, alone))


@needs_native
def test_threads_of_python_may_draw_at_the_same_time() -> None:
    view, p = view_of(), cloud(500)
    expected = _everything(p, view, CPU)
    results: list[list[Tensor]] = [[] for _ in range(4)]

    def work(slot: int) -> None:
        for _ in range(5):
            results[slot] = _everything(p, view, CPU)

    workers = [threading.Thread(target=work, args=(slot,)) for slot in range(4)]
    for worker in workers:
        worker.start()
    for worker in workers:
        worker.join()
    assert all(torch.equal(a, b) for result in results for a, b in zip(result, expected, strict=True))


def test_backward_twice_adds_up_and_editing_an_input_is_refused(config: RasterConfig) -> None:
    p = leaves_of(cloud(50))
    loss = rasterize(gaussians_of(p), view_of(), config).rgb.sum()
    loss.backward(retain_graph=True)
    once = p["means"].grad.clone()
    loss.backward(retain_graph=True)
    torch.testing.assert_close(p["means"].grad, 2 * once)
    if config.backend == "torch":
        return  # torch keeps copies, so an edit does no harm there
    with torch.no_grad():
        p["quats"].add_(1.0)
    refused("inplace", loss.backward, raises=RuntimeError)


def test_no_gradient_is_recorded_where_none_is_wanted(config: RasterConfig) -> None:
    out = rasterize(gaussians_of(cloud(50)), view_of(), config, absgrad=True)
    assert not out.rgb.requires_grad and not out.trace.means2d.requires_grad
    with torch.no_grad():
        assert not rasterize(gaussians_of(leaves_of(cloud(50))), view_of(), config).rgb.requires_grad


def test_a_rolling_shutter_is_named_and_old_lens_coefficients_change_nothing(
    capsys: pytest.CaptureFixture[str],
) -> None:
    plain, p = view_of(), cloud(20)
    camera = replace(plain.camera, name="rolling test", distortion=(0.1, -0.2), readout_s=0.03)
    out = rasterize(gaussians_of(p), View(camera, plain.world_from_cam, 0.0), TORCH)
    said = capsys.readouterr()
    assert "rolling shutter of camera 'rolling test'" in said.err + said.out
    assert torch.equal(out.rgb, rasterize(gaussians_of(p), plain, TORCH).rgb)


# ---- odd sizes and poison ------------------------------------------------------------------------


@pytest.mark.parametrize(("width", "height"), [(1, 1), (1, 40), (33, 1), (16, 16), (17, 15)])
@pytest.mark.parametrize("count", [0, 1, 17])
def test_odd_sizes(config: RasterConfig, width: int, height: int, count: int) -> None:
    p = leaves_of({n: v[:count] for n, v in cloud(20, seed=2).items()})
    out = rasterize(gaussians_of(p), view_of(width, height), config)
    assert out.rgb.shape == (3, height, width)
    assert out.depth.shape == out.alpha.shape == (1, height, width)
    (out.rgb.sum() + out.depth.sum()).backward()
    for value in p.values():
        assert value.grad is None or torch.isfinite(value.grad).all()
    del p["extra"]
    assert rasterize(gaussians_of(p), view_of(width, height), config).extra is None


def test_everything_behind_the_camera_leaves_black(config: RasterConfig) -> None:
    p = leaves_of(cloud(40))
    with torch.no_grad():
        p["means"][:, 2] = -p["means"][:, 2].abs() - 2
    out = rasterize(gaussians_of(p), view_of(), config)
    assert not out.trace.visible.any() and all(getattr(out, name).abs().max() == 0 for name in IMAGES)
    out.rgb.sum().backward()
    assert p["means"].grad is None or p["means"].grad.abs().max() == 0


@pytest.mark.parametrize("name", ["means", "quats", "scales", "opacity", "sh", "extra"])
@pytest.mark.parametrize("bad", [float("nan"), float("inf"), float("-inf")])
def test_parameters_that_are_not_finite_are_refused_by_name(config: RasterConfig, name: str, bad: float) -> None:
    p = cloud(40)
    seen = int(torch.nonzero(rasterize(gaussians_of(p), view_of(), config).trace.visible)[3, 0])
    p[name][seen].view(-1)[0] = bad
    with pytest.raises(NumericsError) as caught:
        rasterize(gaussians_of(p), view_of(), config)
    if name in ("means", "quats", "scales", "opacity"):
        assert f"Gaussian {seen}" in str(caught.value) and name in str(caught.value)


@pytest.mark.parametrize(
    ("name", "bad"),
    [
        *(("means", bad) for bad in (1e38, -1e38, 1e-40)),
        *(("quats", bad) for bad in (0.0, 1e-30, 1e38)),
        *(("scales", bad) for bad in (0.0, 1e-40, 1e38, 1e15, -0.5)),
        *(("opacity", bad) for bad in (0.0, 1.0, 1 / 255, 1e-40, -1.0, 7.0)),
    ],
)
@pytest.mark.parametrize("antialias", [False, True])
def test_finite_poison_is_drawn_or_culled_and_never_spreads(
    config: RasterConfig, name: str, bad: float, antialias: bool
) -> None:
    p = leaves_of(cloud(60))
    with torch.no_grad():
        p[name][::3] = bad
    out = rasterize(gaussians_of(p), view_of(), replace(config, antialias=antialias), absgrad=True)
    assert all(torch.isfinite(getattr(out, image)).all() for image in IMAGES)
    (out.rgb.sum() + out.depth.sum() + out.extra.sum()).backward()
    assert all(torch.isfinite(value.grad).all() for value in p.values())
    assert ((out.alpha >= 0) & (out.alpha < 1)).all()


@pytest.mark.parametrize("shift", [0.0, 1e-6, -1e-6])
def test_the_near_plane_is_exclusive(config: RasterConfig, shift: float) -> None:
    p = _one((0, 0, 2.0), 0.1, 0.5, (1, 1, 1))
    p["means"][0, 2] = 2.0 + shift
    out = rasterize(gaussians_of(p), axis_view(9, 9), replace(config, near_m=2.0))
    assert bool(out.trace.visible[0]) == (float(p["means"][0, 2]) > 2.0)


@needs_native
def test_a_long_needle_across_the_image_matches_the_reference() -> None:
    p = _one((0, 0, 5.0), 0.01, 0.9, (1, 1, 1))
    p["scales"] = torch.tensor([[30.0, 1e-4, 1e-4]])
    p["quats"] = torch.tensor([[0.92, 0.1, 0.05, 0.37]])
    a, b = leaves_of(p), leaves_of(p, torch.float64)
    view = axis_view(200, 150, 90.0)
    got, want = rasterize(gaussians_of(a), view, CPU), rasterize(gaussians_of(b), view, TORCH)
    clear = want.alpha > 1.1 / 255  # the rim of a needle is where the alpha cut falls this way or that
    assert clear.sum() > 300
    torch.testing.assert_close(got.alpha.double()[clear], want.alpha[clear], atol=2e-5, rtol=0)


# ---- the front door ------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "wrong", [{"near_m": 0.0}, {"alpha_max": 1.0}, {"blur_px2": -1.0}, {"blur_px2": math.inf}, {"backend": "cuda"}]
)
def test_settings_out_of_range_are_refused(wrong: dict[str, Any]) -> None:
    refused(next(iter(wrong)), RasterConfig, **wrong, raises=UsageError)


@pytest.mark.parametrize(
    ("changes", "options", "words"),
    [
        ({}, {"world_from_cam": torch.eye(3)}, "world_from_cam"),
        ({"sh": torch.zeros(5, 5, 3)}, {}, "coefficients"),
        ({"extra": torch.zeros(5, 29)}, {}, "feature channels"),
        ({"quats": torch.ones(5, 4).double()}, {}, "share"),
        ({name: value.double() for name, value in cloud(5).items()}, {"config": CPU}, "float32"),
    ],
)
def test_bad_requests_are_refused_in_words(changes: Parameters, options: Any, words: str) -> None:
    if options.get("config") == CPU and native.library() is None:
        pytest.skip(native.status())
    refused(words, rasterize, gaussians_of({**cloud(5), **changes}), view_of(), **{"config": TORCH, **options})


def test_without_the_library_auto_takes_torch_and_cpu_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(native, "_loaded", None)
    monkeypatch.setattr(native, "_problem", "not built: test")
    used: list[str] = []
    monkeypatch.setitem(BACKENDS, "torch", lambda *given: used.append("torch") or torch_twin.render(*given))
    rasterize(gaussians_of(cloud(5)), view_of())
    assert rasterize(gaussians_of(cloud(5, dtype=torch.float64)), view_of()).rgb.dtype == torch.float64
    assert used == ["torch", "torch"]
    refused("not available", rasterize, gaussians_of(cloud(5)), view_of(), CPU, raises=ResourceError)


def test_gsplat_is_refused_where_it_is_missing() -> None:
    if not gsplat_cuda.problem():
        pytest.skip("gsplat is installed here")
    config = RasterConfig(backend="gsplat")
    refused("gsplat", rasterize, gaussians_of(cloud(5)), view_of(), config, raises=ResourceError)


# ---- proofs: finite differences without cut-offs, the published formulas, memory ------------------


@pytest.mark.parametrize(("antialias", "degree"), [(False, 2), (True, 1)])
def test_gradients_match_finite_differences_without_cut_offs(
    monkeypatch: pytest.MonkeyPatch, antialias: bool, degree: int
) -> None:
    """With the alpha cut at 1e-12 and no stop the picture is smooth in everything."""
    monkeypatch.setattr(torch_twin, "ALPHA_MIN", 1e-12)
    monkeypatch.setattr(torch_twin, "STOP_TRANSMITTANCE", 0.0)
    view, values = view_of(4, 3), cloud(3, degree=degree, channels=1)
    values["means"] = torch.tensor([[-0.5, 0.2, 3.0], [0.6, -0.3, 5.0], [0.0, 0.4, 8.0]])
    values["scales"] = values["means"][:, 2:] * torch.tensor([[0.3, 0.2, 0.25], [0.2, 0.3, 0.2], [0.25, 0.2, 0.3]])
    values["opacity"] = torch.tensor([0.5, 0.8, 0.4])
    values["sh"][:, 0] += 0.8
    values = leaves_of(values, torch.float64)
    inputs = [values[name] for name in GROUPS]
    pose = torch.tensor(view.world_from_cam, requires_grad=True)

    def draw(*given: Tensor) -> tuple[Tensor, ...]:
        config = RasterConfig(backend="torch", antialias=antialias)
        out = rasterize(gaussians_of(dict(zip(GROUPS, given))), view, config, world_from_cam=given[-1])
        return out.rgb, out.depth, out.alpha, out.extra

    drawn = draw(*inputs, pose)
    assert drawn[2].min() > 1e-3  # every pixel sees something, so depth is smooth, too
    assert drawn[2].max() > 0.5
    assert torch.autograd.gradcheck(draw, (*inputs, pose), eps=1e-6, atol=2e-5, rtol=1e-4, fast_mode=False)


@needs_native
def test_working_memory_stays_below_two_and_a_half_times_the_data() -> None:
    count, width, height = 60_000, 480, 320
    parts = cloud(count, channels=8)
    parts["scales"] *= 0.05
    parts = leaves_of(parts)
    raster_cpu.release_memory()
    rasterize(gaussians_of(parts), axis_view(width, height, 280.0), CPU).rgb.sum().backward()
    used = raster_cpu.last_statistics()
    assert used["visible"] > 0.6 * count
    data = 4 * (sum(value.numel() for value in parts.values()) + 13 * width * height)
    assert used["context_bytes"] <= 2.5 * data


@needs_native
def test_gradient_memory_is_used_again_but_never_while_somebody_holds_it() -> None:
    raster_cpu.release_memory()
    parts = cloud(60_000, channels=1)
    parts["scales"] *= 0.02
    parts = leaves_of(parts)

    def gradient(weight: float) -> Tensor:
        out = rasterize(gaussians_of(parts), view_of(11, 8), CPU)
        (found,) = torch.autograd.grad(weight * out.rgb.sum(), [parts["sh"]])
        return found

    first = gradient(1.0)
    kept, place = first.clone(), first.data_ptr()
    view_of_it = first[1:]
    second = gradient(3.0)
    assert second.data_ptr() != place and torch.equal(first, kept)
    torch.testing.assert_close(second, 3 * first)
    del first, second
    assert gradient(2.0).data_ptr() != place  # a view still looks at it
    assert torch.equal(view_of_it, kept[1:])
    del view_of_it
    assert place in {gradient(2.0).data_ptr() for _ in range(2)} | {
        block.data_ptr() for block in raster_cpu._free_blocks
    }
    raster_cpu.release_memory()
    assert not raster_cpu._free_blocks
