"""The rasteriser's numbers: finite differences without cut-offs, the published formulas, memory."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from torch import Tensor

from mudg import native
from mudg.base import geometry
from mudg.base.types import Camera, Gaussians, View
from mudg.core.raster import cpu as raster_cpu
from mudg.core.raster import torch_twin
from mudg.core.raster.rasterize import RasterConfig, rasterize

needs_native = pytest.mark.skipif(native.library() is None, reason=native.status())
GROUPS = ("means", "quats", "scales", "opacity", "sh", "extra")


def _view(width: int = 11, height: int = 8) -> View:
    turn = geometry.matrix_from_quaternion([0.97, 0.05, -0.1, 0.08])
    pose = geometry.from_rotation_translation(turn, [0.3, -0.2, 0.1])
    return View(Camera("front", width, height, 0.9 * width, 0.93 * width, 0.53 * width, 0.47 * height), pose, 0.0)


def _values(count: int, degree: int, channels: int, seed: int = 0, spread: float = 0.4) -> dict[str, Tensor]:
    rng = np.random.default_rng(seed)
    z = rng.uniform(2, 12, count)
    values = {
        "means": np.stack([z * rng.uniform(-spread, spread, count), z * rng.uniform(-spread, spread, count), z], 1),
        "quats": rng.standard_normal((count, 4)),
        "scales": z[:, None] * np.exp(rng.uniform(math.log(0.03), math.log(0.2), (count, 3))),
        "opacity": rng.uniform(0.1, 0.9, count),
        "sh": 0.3 * rng.standard_normal((count, (degree + 1) ** 2, 3)) + 0.8 * np.eye((degree + 1) ** 2, 1),
        "extra": rng.standard_normal((count, channels)),
    }
    return {name: torch.tensor(value) for name, value in values.items()}


def _gaussians(parts: dict[str, Tensor], dtype: torch.dtype = torch.float64) -> Gaussians:
    cast = {name: value if value.requires_grad else value.to(dtype) for name, value in parts.items()}
    return Gaussians(**cast, node=torch.zeros(len(cast["means"]), dtype=torch.int32))


@pytest.mark.parametrize("antialias", [False, True])
def test_gradients_match_finite_differences_without_cut_offs(monkeypatch: pytest.MonkeyPatch, antialias: bool) -> None:
    """With the alpha cut at 1e-12 and no stop the picture is smooth in everything."""
    monkeypatch.setattr(torch_twin, "ALPHA_MIN", 1e-12)
    monkeypatch.setattr(torch_twin, "STOP_TRANSMITTANCE", 0.0)
    view, values = _view(5, 4), _values(3, 2, 2)
    values["scales"] *= 3
    inputs = [values[name].requires_grad_() for name in GROUPS]
    pose = torch.tensor(view.world_from_cam, requires_grad=True)
    background = torch.tensor([0.3, 0.1, 0.9], dtype=torch.float64, requires_grad=True)

    def draw(*given: Tensor) -> tuple[Tensor, ...]:
        parts, (at, behind) = dict(zip(GROUPS, given)), given[-2:]
        config = RasterConfig(backend="torch", antialias=antialias)
        out = rasterize(_gaussians(parts), view, config, background=behind, world_from_cam=at)
        assert out.extra is not None
        return out.rgb, out.depth, out.alpha, out.extra

    drawn = draw(*inputs, pose, background)
    assert drawn[2].min() > 1e-3  # every pixel sees something, so depth is smooth, too
    assert drawn[2].max() > 0.5
    assert torch.autograd.gradcheck(draw, (*inputs, pose, background), eps=1e-6, atol=2e-5, rtol=1e-4, fast_mode=False)


def _dense(parts: dict[str, Tensor], view: View, blur: float = 0.3) -> dict[str, NDArray[np.float64]]:
    """Every Gaussian at every pixel, front to back (Zwicker et al. 2001, Kerbl et al. 2023); harmonics of degree 1."""
    camera, p = view.camera, {name: value.numpy().astype(np.float64) for name, value in parts.items()}
    rotation, center = view.world_from_cam[:3, :3].T, view.world_from_cam[:3, 3]
    ys, xs = np.mgrid[0 : camera.height, 0 : camera.width] + 0.5
    channels = 4 + p["extra"].shape[1]
    total, left = np.zeros((channels, camera.height, camera.width)), np.ones((camera.height, camera.width))
    done = np.zeros_like(left, dtype=bool)
    cam = (p["means"] - center) @ rotation.T
    for i in np.argsort(cam[:, 2], kind="stable"):
        x, y, z = cam[i]
        if z <= 0.01:
            continue
        axes = geometry.matrix_from_quaternion(p["quats"][i] / np.linalg.norm(p["quats"][i]))
        covariance = axes @ np.diag(p["scales"][i] ** 2) @ axes.T
        # 1.3 times the field of view
        slack_x, slack_y = 0.15 * camera.width / camera.fx, 0.15 * camera.height / camera.fy
        tx = z * np.clip(x / z, -camera.cx / camera.fx - slack_x, (camera.width - camera.cx) / camera.fx + slack_x)
        ty = z * np.clip(y / z, -camera.cy / camera.fy - slack_y, (camera.height - camera.cy) / camera.fy + slack_y)
        jacobian = np.array([[camera.fx / z, 0, -camera.fx * tx / z**2], [0, camera.fy / z, -camera.fy * ty / z**2]])
        image = jacobian @ rotation @ covariance @ rotation.T @ jacobian.T + blur * np.eye(2)
        offset = np.stack([xs - (camera.fx * x / z + camera.cx), ys - (camera.fy * y / z + camera.cy)], -1)
        power = -0.5 * np.einsum("hwi,ij,hwj->hw", offset, np.linalg.inv(image), offset)
        alpha = np.minimum(p["opacity"][i] * np.exp(power), 0.99)
        alpha[alpha < 1 / 255] = 0
        done |= left * (1 - alpha) <= 1e-4
        alpha[done] = 0
        direction = (p["means"][i] - center) / np.linalg.norm(p["means"][i] - center)
        sh, c1 = p["sh"][i], 0.4886025119029199
        color = 0.5 + 0.28209479177387814 * sh[0]
        color += c1 * (-direction[1] * sh[1] + direction[2] * sh[2] - direction[0] * sh[3])
        values = np.concatenate([np.maximum(color, 0), [z], p["extra"][i]])
        total += values[:, None, None] * (alpha * left)
        left = left * (1 - alpha)
    alpha = 1 - left
    return {"rgb": total[:3], "alpha": alpha[None], "depth": total[3:4] / np.maximum(alpha, 1e-10), "extra": total[4:]}


@pytest.mark.parametrize("backend", ["torch", pytest.param("cpu", marks=needs_native)])
@pytest.mark.parametrize("seed", [0, 1])
def test_pictures_follow_the_published_formulas(backend: Any, seed: int) -> None:
    view, parts = _view(31, 22), _values(120, 1, 2, seed, spread=0.8)
    exact = backend == "torch"
    parts = {name: value.float() for name, value in parts.items()}  # both see the same numbers
    out = rasterize(_gaussians(parts, torch.float64 if exact else torch.float32), view, RasterConfig(backend=backend))
    want = _dense(parts, view)
    far = np.zeros((22, 31), bool)
    for name, truth in want.items():
        error = np.abs(getattr(out, name).numpy() - truth).max(0) / np.abs(truth).max()
        far |= error > (1e-10 if exact else 1e-5)
    assert far.mean() <= (0.0 if exact else 0.005)  # float32: pixels on the edge of the alpha cut
    assert want["alpha"].max() > 0.9


@needs_native
def test_working_memory_stays_below_two_and_a_half_times_the_data() -> None:
    count, width, height = 60_000, 480, 320
    parts = {name: value.float().requires_grad_() for name, value in _values(count, 3, 8, spread=0.6).items()}
    with torch.no_grad():
        parts["scales"] *= 0.05
    raster_cpu.release_memory()
    camera = Camera("front", width, height, 400.0, 400.0, width / 2, height / 2)
    out = rasterize(_gaussians(parts), View(camera, np.eye(4), 0.0), RasterConfig(backend="cpu"))
    out.rgb.sum().backward()
    used = raster_cpu.last_statistics()
    assert used["visible"] > 0.6 * count
    data = 4 * (sum(value.numel() for value in parts.values()) + 13 * width * height)
    assert used["context_bytes"] <= 2.5 * data


@needs_native
def test_gradient_memory_is_used_again_but_never_while_somebody_holds_it() -> None:
    raster_cpu.release_memory()
    parts = {name: value.float().requires_grad_() for name, value in _values(60_000, 3, 1, spread=0.6).items()}
    with torch.no_grad():
        parts["scales"] *= 0.02

    def gradient(weight: float) -> Tensor:
        out = rasterize(_gaussians(parts), _view(), RasterConfig(backend="cpu"))
        (found,) = torch.autograd.grad(weight * out.rgb.sum(), [parts["sh"]])
        return found

    first = gradient(1.0)
    kept, place = first.clone(), first.data_ptr()
    view_of_it = first[1:]
    second = gradient(3.0)
    assert second.data_ptr() != place
    assert torch.equal(first, kept)
    torch.testing.assert_close(second, 3 * first)
    del first, second
    assert gradient(2.0).data_ptr() != place  # a view still looks at it
    assert torch.equal(view_of_it, kept[1:])
    del view_of_it
    assert place in {gradient(2.0).data_ptr() for _ in range(2)} | {block.data_ptr() for block in raster_cpu._Loan.free}
    raster_cpu.release_memory()
    assert not raster_cpu._Loan.free
