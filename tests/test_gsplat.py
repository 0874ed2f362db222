"""The adapter to gsplat, drawing through the real package whose compiled kernels are replaced (`gsplat_on_cpu.py`)."""

from __future__ import annotations

import gc
import weakref
from dataclasses import replace
from types import ModuleType
from typing import Any

import gsplat_on_cpu
import numpy as np
import pytest
import torch
from raster_scenes import IMAGES, Parameters, axis_view, cloud, gaussians_of, leaves_of, outside_band, view_of, weighted
from refusals import refused
from torch import Tensor

from mudg import native
from mudg.base.errors import NumericsError, ResourceError
from mudg.base.types import View
from mudg.core.raster import gsplat_cuda
from mudg.core.raster import rasterize as raster
from mudg.core.raster.rasterize import RasterConfig, rasterize

GSPLAT = RasterConfig(backend="gsplat")


@pytest.fixture
def gsplat(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """The real package; `rasterize` believes that it can be used and takes CPU tensors."""
    package = gsplat_on_cpu.install(monkeypatch)
    monkeypatch.setattr(gsplat_cuda, "load", lambda: package)
    monkeypatch.setattr(raster, "_choose_backend", lambda gaussians, config: config.backend)
    return package


def _hold(p: Parameters, view: View, config: RasterConfig, other: str = "torch") -> None:
    """Draw by gsplat and by another backend with gsplat's cap of alpha: everything that comes back agrees, images by
    the largest difference over the largest value, gradients by the relative L2 norm."""
    single = torch.float64 if other == "torch" else torch.float32
    ours, theirs = leaves_of(p), leaves_of(p, single)
    pose_a = torch.tensor(view.world_from_cam, dtype=torch.float32).requires_grad_()
    pose_b = pose_a.detach().to(single).requires_grad_()
    common = replace(config, backend=other, alpha_max=gsplat_cuda.ALPHA_MAX)
    got = rasterize(gaussians_of(ours), view, replace(config, backend="gsplat"), world_from_cam=pose_a, absgrad=True)
    want = rasterize(gaussians_of(theirs), view, common, world_from_cam=pose_b, absgrad=True)
    weights, errors = outside_band(got, want)
    assert all(error <= 1e-5 for error in errors.values()), errors
    for out in (got, want):
        weighted(out, weights).backward()
    pairs = {n: (ours[n].grad, theirs[n].grad) for n in ours} | {"pose": (pose_a.grad, pose_b.grad)}
    both = got.trace.visible & want.trace.visible
    pairs["means2d"] = (got.trace.means2d.detach() * both[:, None], want.trace.means2d.detach() * both[:, None])
    pairs["d means2d"] = (got.trace.means2d.grad, want.trace.means2d.grad)
    pairs["abs"] = (got.trace.abs_grad2d, want.trace.abs_grad2d)
    for name, (mine, reference) in pairs.items():
        assert reference.norm() > 0, name
        assert (mine.double() - reference).norm() / reference.norm() <= 1e-4, name
    assert not (want.trace.visible & ~got.trace.visible).any()
    assert (got.trace.means2d[~got.trace.visible] == 0).all()
    # rounded up, theirs without our thousandth of a pixel
    assert (got.trace.radii - want.trace.radii)[both].abs().max() <= 1
    # a rectangle that ends between the border and the first pixel centre
    assert (got.trace.visible & ~want.trace.visible).double().mean() <= 0.05


OTHERS = ["torch", pytest.param("cpu", marks=pytest.mark.skipif(native.library() is None, reason=native.status()))]


@pytest.mark.parametrize("other", OTHERS)
@pytest.mark.parametrize("antialias", [False, True])
def test_it_draws_what_the_other_backends_draw(gsplat: ModuleType, antialias: bool, other: str) -> None:
    _hold(cloud(90), view_of(), RasterConfig(antialias=antialias), other)


@pytest.mark.parametrize("degree", [0, 1, 2])
def test_harmonics_of_every_degree_agree(gsplat: ModuleType, degree: int) -> None:
    _hold(cloud(60, degree=degree), view_of(), RasterConfig(near_m=2.0, blur_px2=0.1))


def test_the_most_feature_channels_and_none_and_harmonics_in_two_tensors(gsplat: ModuleType) -> None:
    """32 channels with colour and depth: gsplat would draw more in two passes, and absolute gradients only of the
    last."""
    _hold(cloud(40, channels=raster.MAX_EXTRA_CHANNELS), view_of(), RasterConfig())
    p = cloud(40)
    whole = gaussians_of(p)
    parted = replace(whole, sh=p["sh"][:, :1].clone(), sh_rest=p["sh"][:, 1:].clone())
    one, two = (rasterize(g, view_of(), GSPLAT).rgb for g in (whole, parted))
    assert torch.equal(one, two)
    assert rasterize(replace(whole, extra=None), view_of(), GSPLAT).extra is None


def test_what_the_cap_of_alpha_changes(gsplat: ModuleType) -> None:
    """gsplat caps alpha at 0.999, the other backends at `alpha_max`, 0.99: an opaque Gaussian lets a hundredth
    through."""
    p = cloud(1, degree=0, channels=1) | {"means": torch.tensor([[0.0, 0, 5]])}
    p |= {"scales": torch.full((1, 3), 2.0), "opacity": torch.ones(1)}
    drawn = [
        float(rasterize(gaussians_of(p), axis_view(15, 15, 15.0), RasterConfig(backend=b)).alpha.max())
        for b in ("gsplat", "torch")
    ]
    assert drawn == pytest.approx([0.999, 0.99], abs=1e-6)


def test_it_is_as_exact_far_from_the_origin(gsplat: ModuleType) -> None:
    """At 4 km a float32 resolves 0.5 mm: positions relative to the camera keep their bits."""
    p, view = cloud(60), view_of()
    p["means"] = (p["means"] * 64).round() / 64  # exactly representable there, too
    shift = np.array([4096.0, -2048.0, 512.0])
    pose = view.world_from_cam.copy()
    pose[:3, 3] += shift
    moved = p | {"means": p["means"] + torch.tensor(shift, dtype=torch.float32)}
    here = rasterize(gaussians_of(p), view, GSPLAT)
    there = rasterize(gaussians_of(moved), View(view.camera, pose, 0.0), GSPLAT)
    assert (here.rgb - there.rgb).abs().max() < 2e-5 and (here.depth - there.depth).abs().max() < 1e-3


def test_gradients_of_two_backward_passes_add_up_and_none_is_recorded_where_none_is_wanted(gsplat: ModuleType) -> None:
    p = leaves_of(cloud(40))
    out = rasterize(gaussians_of(p), view_of(), GSPLAT, absgrad=True)
    loss = out.rgb.square().sum() + out.depth.sum()
    loss.backward(retain_graph=True)
    once = [t.clone() for t in (p["means"].grad, out.trace.means2d.grad, out.trace.abs_grad2d)]
    loss.backward()
    for first, both in zip(once, (p["means"].grad, out.trace.means2d.grad, out.trace.abs_grad2d)):
        torch.testing.assert_close(both, 2 * first)
    out = rasterize(gaussians_of(cloud(20)), view_of(), GSPLAT, absgrad=True)
    assert not out.rgb.requires_grad and out.trace.abs_grad2d is None
    with torch.no_grad():
        assert not rasterize(gaussians_of(leaves_of(cloud(20))), view_of(), GSPLAT).trace.means2d.requires_grad


class _Canary(torch.autograd.Function):
    """Hands a tensor on; what it remembers lives as long as the graph."""

    @staticmethod
    def forward(ctx: Any, tensor: Tensor, alive: Any) -> Tensor:
        ctx.alive = alive
        return tensor.clone()

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> Any:
        return gradients[0], None


def test_a_dropped_picture_frees_its_graph_at_once(gsplat: ModuleType) -> None:
    """Not when Python next looks for circles: on a GPU every picture would cost memory until then."""

    class Alive:
        pass

    p, alive = leaves_of(cloud(20)), Alive()
    graph = weakref.ref(alive)
    gc.collect()
    gc.disable()
    try:
        watched = gaussians_of(p | {"means": _Canary.apply(p["means"], alive)})
        out = rasterize(watched, view_of(), GSPLAT, absgrad=True)
        del alive, watched
        assert graph() is not None
        del out
        assert graph() is None
    finally:
        gc.enable()


# ---- what would make gsplat fail -----------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "value"),
    [
        *(("quats", value) for value in (0.0, 1e-30, 1e30)),
        *(("scales", value) for value in (0.0, 1e30)),
        *(("means", value) for value in (1e38, -1e38)),
        *(("opacity", value) for value in (0.0, 1.0)),
    ],
)
def test_absurd_values_never_spread(gsplat: ModuleType, name: str, value: float) -> None:
    p = cloud(30)
    p[name][3:6] = value
    p = leaves_of(p)
    out = rasterize(gaussians_of(p), view_of(), GSPLAT, absgrad=True)
    (out.rgb.square().sum() + out.alpha.sum()).backward()
    assert all(torch.isfinite(getattr(out, n)).all() for n in IMAGES)
    assert torch.isfinite(out.trace.means2d).all()
    for leaf in p.values():
        assert leaf.grad is None or torch.isfinite(leaf.grad).all()


def test_values_that_are_not_finite(gsplat: ModuleType) -> None:
    view = view_of()
    refused("float32", rasterize, gaussians_of({n: v.double() for n, v in cloud(3).items()}), view, GSPLAT)
    for name in ("means", "quats", "scales", "opacity"):
        p = cloud(10)
        p[name][2] = torch.nan
        refused(name, rasterize, gaussians_of(p), view, GSPLAT, raises=NumericsError)
    p = cloud(60)
    visible = rasterize(gaussians_of(p), view, GSPLAT).trace.visible
    seen, unseen = int(torch.nonzero(visible)[0, 0]), int(torch.nonzero(~visible)[0, 0])
    for name in ("sh", "extra"):
        bad, harmless = ({n: v.clone() for n, v in p.items()} for _ in range(2))
        bad[name][seen], harmless[name][unseen] = torch.inf, torch.nan
        refused("colour or a feature", rasterize, gaussians_of(bad), view, GSPLAT, raises=NumericsError)
        leaves = leaves_of(harmless)
        rasterize(gaussians_of(leaves), view, GSPLAT).rgb.sum().backward()
        assert torch.isfinite(leaves["means"].grad).all()


def test_nothing_to_draw(gsplat: ModuleType) -> None:
    view = view_of()
    centre = leaves_of(cloud(10) | {"means": torch.zeros(10, 3)})  # at the very centre of the camera
    rasterize(gaussians_of(centre), View(view.camera, np.eye(4), 0.0), GSPLAT).rgb.sum().backward()
    assert centre["means"].grad is None or torch.isfinite(centre["means"].grad).all()
    none = {n: v[:0] for n, v in cloud(3).items()}
    behind = cloud(3) | {"means": torch.tensor([[0.0, 0, -5]]).repeat(3, 1)}
    for p in (none, behind):
        out = rasterize(gaussians_of(p), view, GSPLAT)
        assert out.alpha.abs().max() == out.rgb.abs().max() == 0 and not out.trace.visible.any()


# ---- whether it can be used ----------------------------------------------------------------------


def _pretend_installed(monkeypatch: pytest.MonkeyPatch, folder: Any, version: str = "1.5.3", cuda: bool = True) -> None:
    class Spec:
        submodule_search_locations = (str(folder),)

    find = gsplat_cuda.importlib.util.find_spec
    monkeypatch.setattr(gsplat_cuda, "_usable", False)
    monkeypatch.setattr("importlib.util.find_spec", lambda name, *a: Spec() if name == "gsplat" else find(name, *a))
    monkeypatch.setattr("importlib.metadata.version", lambda name: version)
    monkeypatch.setattr("torch.cuda.is_available", lambda: cuda)


def test_the_reason_why_it_cannot_be_used(monkeypatch: pytest.MonkeyPatch, tmp_path: Any) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda *_: None)
    assert "not installed" in gsplat_cuda.problem()
    refused(r"mudg\[gsplat\]", gsplat_cuda.load, raises=ResourceError)
    monkeypatch.undo()
    _pretend_installed(monkeypatch, tmp_path, version="1.4.0")
    assert "older than 1.5.3" in gsplat_cuda.problem()
    _pretend_installed(monkeypatch, tmp_path, cuda=False)
    assert "no CUDA device" in gsplat_cuda.problem()
    _pretend_installed(monkeypatch, tmp_path)
    monkeypatch.setattr(gsplat_cuda, "nvcc", lambda: None)
    assert "nvcc" in gsplat_cuda.problem() and gsplat_cuda.status().startswith("cannot be used here")
    (tmp_path / "csrc.so").touch()
    assert gsplat_cuda.problem() == "" and "came with it" in gsplat_cuda.status()


def test_a_missing_compiler_is_named(monkeypatch: pytest.MonkeyPatch, tmp_path: Any) -> None:
    (tmp_path / "bin").mkdir()
    (tmp_path / "bin" / "nvcc").touch()
    monkeypatch.setenv("CUDA_HOME", str(tmp_path))
    assert gsplat_cuda.nvcc() == str(tmp_path / "bin" / "nvcc")
    _pretend_installed(monkeypatch, tmp_path)
    monkeypatch.setattr("shutil.which", lambda name: "/bin/ninja" if name == "ninja" else None)
    assert "C++ compiler" in gsplat_cuda.problem()
    monkeypatch.setattr("shutil.which", lambda name: f"/bin/{name}")
    assert "first picture" in gsplat_cuda.status()


@pytest.mark.gpu
@pytest.mark.parametrize("antialias", [False, True])
def test_on_the_device_it_draws_what_the_native_kernel_draws(antialias: bool) -> None:
    reason = gsplat_cuda.problem()
    if reason:
        pytest.skip(reason)
    p, view = cloud(2000), view_of(160, 120)
    on_device = {name: value.cuda() for name, value in p.items()}
    got = rasterize(gaussians_of(on_device), view, RasterConfig(backend="gsplat", antialias=antialias))
    want = rasterize(
        gaussians_of(p), view, RasterConfig(backend="cpu", antialias=antialias, alpha_max=gsplat_cuda.ALPHA_MAX)
    )
    error = (got.rgb.cpu() - want.rgb).abs()
    assert (error > 1e-4).double().mean() < 0.005  # fast mathematics on the device
