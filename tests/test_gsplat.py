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
from torch import Tensor

from mudg import native
from mudg.base import geometry
from mudg.base.errors import InputError, NumericsError, ResourceError
from mudg.base.types import Camera, Gaussians, Render, View
from mudg.core.raster import gsplat_cuda
from mudg.core.raster import gsplat_cuda as gsplat_package
from mudg.core.raster import rasterize as raster
from mudg.core.raster.rasterize import RasterConfig, rasterize
from mudg.steps import doctor as diagnosis

GROUPS = ("means", "quats", "scales", "opacity", "sh", "extra")
IMAGES = ("rgb", "depth", "alpha", "extra")
Parameters = dict[str, Tensor]


@pytest.fixture
def gsplat(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """The real package; `rasterize` believes that it can be used and takes CPU tensors."""
    package = gsplat_on_cpu.install(monkeypatch)
    monkeypatch.setattr(gsplat_cuda, "load", lambda: package)
    monkeypatch.setattr(raster, "_choose_backend", lambda gaussians, config: config.backend)
    return package


def _views(width: int = 50, height: int = 37) -> tuple[View, View]:
    """Neither centred nor aligned with the world, with different intrinsics."""
    turn = geometry.matrix_from_quaternion([0.97, 0.05, -0.1, 0.08])
    pose = geometry.from_rotation_translation(turn, [0.3, -0.2, 0.1])
    nearer = pose.copy()
    nearer[:3, 3] += [0.1, 0.05, 0.4]
    front = Camera("front", width, height, 0.9 * width, 0.93 * width, 0.53 * width, 0.47 * height)
    return View(front, pose, 0.0), View(replace(front, name="left", fx=30.0, fy=31.0, cx=20.0), nearer, 0.1)


def _parameters(count: int = 90, seed: int = 0, degree: int = 3, channels: int = 5) -> Parameters:
    """Large, small, flat, faint and nearly opaque Gaussians, some behind the camera, some beside the image."""
    rng = np.random.default_rng(seed)
    z = np.exp(rng.uniform(np.log(1.5), np.log(40), count)) * np.where(rng.random(count) < 0.08, -1, 1)
    scales = np.abs(z)[:, None] * np.exp(rng.uniform(np.log(0.004), np.log(0.12), (count, 3)))
    scales[::7, 0] *= 0.02
    values = {
        "means": np.stack([z * rng.uniform(-0.9, 0.9, count), z * rng.uniform(-0.6, 0.6, count), z], 1),
        "quats": rng.standard_normal((count, 4)),
        "scales": scales,
        "opacity": np.where(rng.random(count) < 0.4, rng.uniform(0.6, 0.9999, count), rng.uniform(0.001, 0.5, count)),
        "sh": 0.3 * rng.standard_normal((count, (degree + 1) ** 2, 3)),
        "extra": rng.standard_normal((count, channels)),
    }
    return {name: torch.tensor(value, dtype=torch.float32) for name, value in values.items()}


def _gaussians(p: Parameters) -> Gaussians:
    node = torch.zeros(len(p["means"]), dtype=torch.int32)
    return Gaussians(*(p[name] for name in GROUPS[:-1]), p.get("extra"), node)


def _leaves(p: Parameters, dtype: torch.dtype = torch.float32) -> Parameters:
    return {name: value.detach().to(dtype).clone().requires_grad_() for name, value in p.items()}


def _compare(
    p: Parameters, views: Any, config: RasterConfig, other: str, groups: tuple[str, ...] = GROUPS
) -> dict[str, float]:
    """Draw by gsplat and by another backend with gsplat's cap of alpha; differences of everything that comes back.

    Images: largest difference over the largest value. Gradients: relative L2 norm. Pixels where an alpha falls to
    different sides of a cut are left out; they are counted as "band".
    """
    single = torch.float64 if other == "torch" else torch.float32
    ours, theirs = _leaves(p), _leaves(p, single)
    poses = np.stack([v.world_from_cam for v in views]) if isinstance(views, tuple) else views.world_from_cam
    pose_a = torch.tensor(poses, dtype=torch.float32).requires_grad_()
    pose_b = pose_a.detach().to(single).requires_grad_()
    behind = torch.tensor([0.2, 0.5, 0.7])
    shared = {"absgrad": True}
    common = replace(config, backend=other, alpha_max=gsplat_cuda.ALPHA_MAX)
    got = rasterize(
        _gaussians(ours), views, replace(config, backend="gsplat"), background=behind, world_from_cam=pose_a, **shared
    )
    want = rasterize(_gaussians(theirs), views, common, background=behind.to(single), world_from_cam=pose_b, **shared)
    errors = [
        ((getattr(got, n) - getattr(want, n)).abs() / getattr(want, n).abs().max()).detach().amax(-3) for n in IMAGES
    ]
    band = torch.stack(errors).amax(0) > 1e-5
    found = {n: float(error[~band].max()) for n, error in zip(IMAGES, errors)} | {"band": float(band.double().mean())}
    generator = torch.Generator().manual_seed(0)
    weights = {n: torch.randn(getattr(got, n).shape, generator=generator) * ~band.unsqueeze(-3) for n in IMAGES}
    for out in (got, want):
        torch.stack([(getattr(out, n) * w).sum() for n, w in weights.items()]).sum().backward()
    pairs = {f"d {n}": (ours[n].grad, theirs[n].grad) for n in groups} | {"d pose": (pose_a.grad, pose_b.grad)}
    both = (got.trace.visible & want.trace.visible)[..., None]
    pairs["means2d"] = (got.trace.means2d.detach() * both, want.trace.means2d.detach() * both)
    pairs["d means2d"] = (got.trace.means2d.grad, want.trace.means2d.grad)
    pairs["abs"] = (got.trace.abs_grad2d, want.trace.abs_grad2d)
    for name, (mine, reference) in pairs.items():
        assert reference.norm() > 0, name
        found[name] = float((mine.double() - reference).norm() / reference.norm())
    assert not (want.trace.visible & ~got.trace.visible).any()
    assert (got.trace.means2d[~got.trace.visible] == 0).all()
    found["radii"] = float((got.trace.radii - want.trace.radii)[both[..., 0]].abs().max())
    found["only gsplat"] = float((got.trace.visible & ~want.trace.visible).double().mean())
    return found


def _hold(found: dict[str, float]) -> None:
    assert found["band"] < 0.005, found
    assert all(found[name] <= 1e-5 for name in IMAGES), found
    assert all(value <= 1e-4 for name, value in found.items() if name.startswith(("d ", "abs", "means2d"))), found
    assert found["radii"] <= 1, found  # rounded up, theirs without our thousandth of a pixel
    assert found["only gsplat"] <= 0.05, found  # a rectangle that ends between the border and the first pixel centre


OTHERS = ["torch", pytest.param("cpu", marks=pytest.mark.skipif(native.library() is None, reason=native.status()))]


@pytest.mark.parametrize("other", OTHERS)
@pytest.mark.parametrize("antialias", [False, True])
def test_it_draws_what_the_other_backends_draw(gsplat: ModuleType, antialias: bool, other: str) -> None:
    _hold(_compare(_parameters(), _views()[0], RasterConfig(antialias=antialias), other))


def test_several_views_are_drawn_in_one_call(gsplat: ModuleType, monkeypatch: pytest.MonkeyPatch) -> None:
    calls, draw = [], gsplat.rasterization
    monkeypatch.setattr(gsplat, "rasterization", lambda **a: (calls.append(a), draw(**a))[1])
    config = RasterConfig(near_m=2.0, far_m=20.0, blur_px2=0.1)
    _hold(_compare(_parameters(60), _views(), config, "torch"))
    assert len(calls) == 1


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_harmonics_of_every_degree_agree(gsplat: ModuleType, degree: int) -> None:
    _hold(_compare(_parameters(60, degree=degree), _views()[0], RasterConfig(), "torch"))
    _hold(_compare(_parameters(60), _views()[0], RasterConfig(sh_degree=degree), "torch"))


def test_the_most_feature_channels_and_none_and_harmonics_in_two_tensors(gsplat: ModuleType) -> None:
    """32 channels with colour and depth: gsplat would draw more in two passes, and absolute gradients only of the
    last."""
    _hold(_compare(_parameters(40, channels=raster.MAX_EXTRA_CHANNELS), _views()[0], RasterConfig(), "torch"))
    p = _parameters(20)
    del p["extra"]
    assert rasterize(_gaussians(p), _views()[0], RasterConfig(backend="gsplat")).extra is None
    p, config = _parameters(40), RasterConfig(backend="gsplat")
    whole = _gaussians(p)
    parted = replace(whole, sh=p["sh"][:, :1].clone(), sh_rest=p["sh"][:, 1:].clone())
    assert torch.equal(rasterize(whole, _views()[0], config).rgb, rasterize(parted, _views()[0], config).rgb)


def test_what_the_cap_of_alpha_changes(gsplat: ModuleType) -> None:
    """gsplat caps alpha at 0.999, the other backends at `alpha_max`, 0.99: an opaque Gaussian lets a hundredth
    through."""
    p = _parameters(1, degree=0, channels=1) | {"means": torch.tensor([[0.0, 0, 5]])}
    p |= {"scales": torch.full((1, 3), 2.0), "opacity": torch.ones(1)}
    view = View(Camera("front", 15, 15, 15.0, 15.0, 7.5, 7.5), np.eye(4), 0.0)
    drawn = [float(rasterize(_gaussians(p), view, RasterConfig(backend=b)).alpha.max()) for b in ("gsplat", "torch")]
    assert drawn == pytest.approx([0.999, 0.99], abs=1e-6)


def test_it_is_as_exact_far_from_the_origin(gsplat: ModuleType) -> None:
    """At 4 km a float32 resolves 0.5 mm: positions relative to the camera keep their bits."""
    p, (view, _) = _parameters(60), _views()
    p["means"] = (p["means"] * 64).round() / 64  # exactly representable there, too
    shift = np.array([4096.0, -2048.0, 512.0])
    pose = view.world_from_cam.copy()
    pose[:3, 3] += shift
    moved = p | {"means": p["means"] + torch.tensor(shift, dtype=torch.float32)}
    config = RasterConfig(backend="gsplat")
    here = rasterize(_gaussians(p), view, config)
    there = rasterize(_gaussians(moved), View(view.camera, pose, 0.0), config)
    assert (here.rgb - there.rgb).abs().max() < 2e-5
    assert (here.depth - there.depth).abs().max() < 1e-3


def test_gradients_of_two_backward_passes_add_up_and_none_is_recorded_where_none_is_wanted(gsplat: ModuleType) -> None:
    p = _leaves(_parameters(40))
    out = rasterize(_gaussians(p), _views()[0], RasterConfig(backend="gsplat"), absgrad=True)
    loss = out.rgb.square().sum() + out.depth.sum()
    loss.backward(retain_graph=True)
    once = [t.clone() for t in (p["means"].grad, out.trace.means2d.grad, out.trace.abs_grad2d)]
    loss.backward()
    for first, both in zip(once, (p["means"].grad, out.trace.means2d.grad, out.trace.abs_grad2d)):
        torch.testing.assert_close(both, 2 * first)
    config = RasterConfig(backend="gsplat")
    out = rasterize(_gaussians(_parameters(20)), _views()[0], config, absgrad=True)
    assert not out.rgb.requires_grad
    assert out.trace.abs_grad2d is None
    with torch.no_grad():
        assert not rasterize(_gaussians(_leaves(_parameters(20))), _views()[0], config).trace.means2d.requires_grad


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

    p, alive = _leaves(_parameters(20)), Alive()
    graph = weakref.ref(alive)
    gc.collect()
    gc.disable()
    try:
        config = RasterConfig(backend="gsplat")
        watched = _gaussians(p | {"means": _Canary.apply(p["means"], alive)})
        out = rasterize(watched, _views()[0], config, absgrad=True)
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
    p = _parameters(30)
    p[name][3:6] = value
    p = _leaves(p)
    out = rasterize(_gaussians(p), _views()[0], RasterConfig(backend="gsplat"), absgrad=True)
    (out.rgb.square().sum() + out.alpha.sum()).backward()
    assert all(torch.isfinite(getattr(out, n)).all() for n in IMAGES)
    assert torch.isfinite(out.trace.means2d).all()
    for leaf in p.values():
        assert leaf.grad is None or torch.isfinite(leaf.grad).all()


def test_values_that_are_not_finite(gsplat: ModuleType) -> None:
    config, (view, _) = RasterConfig(backend="gsplat"), _views()
    with pytest.raises(InputError, match="float32"):
        rasterize(_gaussians({n: v.double() for n, v in _parameters(3).items()}), view, config)
    for name in ("means", "quats", "scales", "opacity"):
        p = _parameters(10)
        p[name][2] = torch.nan
        with pytest.raises(NumericsError, match=name):
            rasterize(_gaussians(p), view, config)
    p = _parameters(60)
    visible = rasterize(_gaussians(p), view, config).trace.visible
    seen, unseen = int(torch.nonzero(visible)[0, 0]), int(torch.nonzero(~visible)[0, 0])
    for name in ("sh", "extra"):
        bad = {n: v.clone() for n, v in p.items()}
        bad[name][seen] = torch.inf
        with pytest.raises(NumericsError, match="colour or a feature"):
            rasterize(_gaussians(bad), view, config)
        harmless = {n: v.clone() for n, v in p.items()}
        harmless[name][unseen] = torch.nan
        leaves = _leaves(harmless)
        rasterize(_gaussians(leaves), view, config).rgb.sum().backward()
        assert torch.isfinite(leaves["means"].grad).all()


def test_nothing_to_draw(gsplat: ModuleType) -> None:
    config, (view, _) = RasterConfig(backend="gsplat"), _views()
    centre = _leaves(_parameters(10) | {"means": torch.zeros(10, 3)})  # at the very centre of the camera
    rasterize(_gaussians(centre), View(view.camera, np.eye(4), 0.0), config).rgb.sum().backward()
    assert centre["means"].grad is None or torch.isfinite(centre["means"].grad).all()
    none = {n: v[:0] for n, v in _parameters(3).items()}
    behind = _parameters(3) | {"means": torch.tensor([[0.0, 0, -5]]).repeat(3, 1)}
    for p in (none, behind):
        out = rasterize(_gaussians(p), view, config, background=torch.tensor([0.1, 0.2, 0.3]))
        assert out.alpha.abs().max() == 0
        assert out.rgb[:, 0, 0].tolist() == pytest.approx([0.1, 0.2, 0.3])
        assert not out.trace.visible.any()


# ---- whether it can be used ----------------------------------------------------------------------


def _pretend_installed(monkeypatch: pytest.MonkeyPatch, folder: Any, version: str = "1.5.3", cuda: bool = True) -> None:
    class Spec:
        submodule_search_locations = (str(folder),)

    find = gsplat_package.importlib.util.find_spec
    monkeypatch.setattr(gsplat_package, "_usable", False)
    monkeypatch.setattr("importlib.util.find_spec", lambda name, *a: Spec() if name == "gsplat" else find(name, *a))
    monkeypatch.setattr("importlib.metadata.version", lambda name: version)
    monkeypatch.setattr("torch.cuda.is_available", lambda: cuda)


def test_the_reason_why_it_cannot_be_used(monkeypatch: pytest.MonkeyPatch, tmp_path: Any) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda *_: None)
    assert "not installed" in gsplat_package.problem()
    with pytest.raises(ResourceError, match=r"mudg\[gsplat\]"):
        gsplat_package.load()
    monkeypatch.undo()
    _pretend_installed(monkeypatch, tmp_path, version="1.4.0")
    assert "older than 1.5.3" in gsplat_package.problem()
    _pretend_installed(monkeypatch, tmp_path, cuda=False)
    assert "no CUDA device" in gsplat_package.problem()
    _pretend_installed(monkeypatch, tmp_path)
    monkeypatch.setattr(gsplat_package, "nvcc", lambda: None)
    assert "nvcc" in gsplat_package.problem()
    assert gsplat_package.status().startswith("cannot be used here")
    (tmp_path / "csrc.so").touch()
    assert gsplat_package.problem() == ""
    assert "came with it" in gsplat_package.status()
    monkeypatch.setattr(diagnosis, "installed", lambda name: "1.5.3" if name == "gsplat" else "0")
    _pretend_installed(monkeypatch, tmp_path, cuda=False)
    assert diagnosis._optional()["gsplat"] == "1.5.3; cannot be used here: no CUDA device is available"
    (tmp_path / "csrc.so").touch()
    _pretend_installed(monkeypatch, tmp_path)
    assert diagnosis._optional()["gsplat"] == "1.5.3; its kernels came with it"
    monkeypatch.setattr(diagnosis, "installed", lambda name: None)
    assert "pip install 'mudg[gsplat]'" in diagnosis._optional()["gsplat"]


def test_a_missing_compiler_is_named(monkeypatch: pytest.MonkeyPatch, tmp_path: Any) -> None:
    (tmp_path / "bin").mkdir()
    (tmp_path / "bin" / "nvcc").touch()
    monkeypatch.setenv("CUDA_HOME", str(tmp_path))
    assert gsplat_package.nvcc() == str(tmp_path / "bin" / "nvcc")
    _pretend_installed(monkeypatch, tmp_path)
    monkeypatch.setattr("shutil.which", lambda name: "/bin/ninja" if name == "ninja" else None)
    assert "C++ compiler" in gsplat_package.problem()
    monkeypatch.setattr("shutil.which", lambda name: f"/bin/{name}")
    assert "first picture" in gsplat_package.status()


@pytest.mark.gpu
@pytest.mark.parametrize("antialias", [False, True])
def test_on_the_device_it_draws_what_the_native_kernel_draws(antialias: bool) -> None:
    reason = gsplat_package.problem()
    if reason:
        pytest.skip(reason)
    p, view = _parameters(2000), _views(160, 120)[0]
    on_device = {name: value.cuda() for name, value in p.items()}
    g = replace(_gaussians(on_device), node=torch.zeros(len(p["means"]), dtype=torch.int32, device="cuda"))
    got: Render = rasterize(g, view, RasterConfig(backend="gsplat", antialias=antialias))
    want = rasterize(
        _gaussians(p), view, RasterConfig(backend="cpu", antialias=antialias, alpha_max=gsplat_cuda.ALPHA_MAX)
    )
    error = (got.rgb.cpu() - want.rgb).abs()
    assert (error > 1e-4).double().mean() < 0.005  # fast mathematics on the device
