"""gsplat without CUDA: the real package with stand-ins for its compiled kernels.

Everything that gsplat does in Python runs as it is: argument checks, autograd functions, what it returns. Only the
compiled functions are replaced, by gsplat's own references in torch (`gsplat.cuda._torch_impl`) and, where those need
further packages, by the formulas of the kernels' source (alpha cut 1/255, cap 0.999, stop at a transmittance of 1e-4,
radii that know the opacity), for one view and without tiles. Backward kernels are autograd of the forward ones. As on a
GPU, what a kernel does not write is whatever was in memory: here NaN.
"""

from __future__ import annotations

import sys
from types import ModuleType, SimpleNamespace
from typing import Any

import pytest
import torch
from torch import Tensor

ALPHA_MIN, ALPHA_MAX, STOP = 1 / 255, 0.999, 1e-4


def install(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """The package gsplat, drawing with the stand-ins until the test ends."""
    reason = "gsplat is not installed (pip install gsplat; it needs no CUDA for this test)"
    gsplat = pytest.importorskip("gsplat", reason=reason)
    backend = ModuleType("gsplat.cuda._backend")
    backend._C = Kernels()
    monkeypatch.setitem(sys.modules, "gsplat.cuda._backend", backend)
    monkeypatch.setattr("gsplat.rendering.torch", _TorchOnCpu())
    monkeypatch.setattr("torch.cuda.synchronize", lambda *_: None)
    return gsplat


class _TorchOnCpu:
    """torch, but for one call of gsplat that names the device "cuda"."""

    def __getattr__(self, name: str) -> Any:
        return getattr(torch, name)

    def zeros_like(self, tensor: Tensor, device: str | None = None, **other: Any) -> Tensor:
        assert device == "cuda"
        return torch.zeros_like(tensor, **other)


def _gradients(outputs: list[Tensor], cotangents: list[Tensor], inputs: list[Tensor]) -> list[Tensor]:
    found = torch.autograd.grad(outputs, inputs, cotangents, allow_unused=True)
    return [torch.zeros_like(one) if g is None else g for one, g in zip(inputs, found, strict=True)]


def _leaves(*tensors: Tensor) -> list[Tensor]:
    return [tensor.detach().clone().requires_grad_() for tensor in tensors]


def _blend(alpha: Tensor, sigma: Tensor, channels: Tensor) -> tuple[Tensor, Tensor]:
    """alpha, sigma [P, M] and channels [M, C] to [P, C] and accumulated alpha [P, 1], as the kernels do it."""
    alpha = alpha.clamp_max(ALPHA_MAX)
    alpha = torch.where((alpha >= ALPHA_MIN) & (sigma >= 0), alpha, 0)
    alpha = torch.where(torch.cumprod(1 - alpha.detach(), 1) > STOP, alpha, 0)
    left = torch.cumprod(torch.cat([alpha.new_ones(len(alpha), 1), 1 - alpha], 1), 1)
    return (alpha * left[:, :-1]) @ channels, 1 - left[:, -1:]


class Kernels:
    """The functions of gsplat's compiled module that this project reaches."""

    CameraModelType = ShutterType = None  # gsplat looks their members up in the module
    PINHOLE = "pinhole"

    def __init__(self) -> None:
        sides = ("TOP_TO_BOTTOM", "LEFT_TO_RIGHT", "BOTTOM_TO_TOP", "RIGHT_TO_LEFT")
        for name in ("GLOBAL", *(f"ROLLING_{side}" for side in sides)):
            setattr(self, name, name)
        self.UnscentedTransformParameters = self.FThetaCameraDistortionParameters = SimpleNamespace

    # ---- harmonics ----

    def spherical_harmonics_fwd(self, degree: int, dirs: Tensor, coeffs: Tensor, masks: Tensor | None) -> Tensor:
        from gsplat.cuda._torch_impl import _spherical_harmonics

        return _spherical_harmonics(degree, dirs, coeffs)

    def spherical_harmonics_bwd(
        self, bases: int, degree: int, dirs: Tensor, coeffs: Tensor, masks: Any, v_colors: Tensor, wants_dirs: bool
    ) -> tuple[Tensor, Tensor]:
        assert dirs.norm(dim=-1).min() > 0  # the kernel divides by it
        with torch.enable_grad():
            dirs, coeffs = _leaves(dirs, coeffs)
            colors = self.spherical_harmonics_fwd(degree, dirs, coeffs, masks)
            v_coeffs, v_dirs = _gradients([colors], [v_colors], [coeffs, dirs])
        return v_coeffs, v_dirs

    # ---- projection of ellipsoids ----

    def _project(
        self, means: Tensor, quats: Tensor, scales: Tensor, viewmats: Tensor, Ks: Tensor, rest: tuple[Any, ...]
    ) -> Any:
        from gsplat.cuda._torch_impl import _fully_fused_projection, _quat_scale_to_covar_preci

        covars, _ = _quat_scale_to_covar_preci(quats, scales, True, False)
        return _fully_fused_projection(means, covars, viewmats, Ks, *rest)

    def projection_ewa_3dgs_fused_fwd(self, means: Tensor, covars: None, *rest: Any) -> Any:
        quats, scales, opacities, viewmats, Ks, width, height, eps2d, near, far, clip, compensate, model = rest
        for tensor in (means, quats, scales, opacities, viewmats, Ks):
            assert tensor.dtype == torch.float32
            assert tensor.is_contiguous()
            assert torch.isfinite(tensor).all()
        settings = (width, height, eps2d, near, far, True, model)
        _, means2d, depths, conics, factor = self._project(means, quats, scales, viewmats, Ks, settings)
        seen = opacities * factor if compensate else opacities.expand_as(depths)
        det = conics[..., 0] * conics[..., 2] - conics[..., 1] ** 2
        extend = (2 * (seen / ALPHA_MIN).clamp_min(1e-9).log()).clamp_min(0).sqrt().clamp_max(3.33)
        size = torch.ceil(extend[..., None] * (conics[..., [2, 0]] / det[..., None]).sqrt())
        limit = torch.tensor([width, height])
        drawn = (depths >= near) & (depths <= far) & (seen >= ALPHA_MIN) & (size > clip).any(-1)
        drawn &= ((means2d + size > 0) & (means2d - size < limit)).all(-1)
        radii = torch.where(drawn[..., None], size, 0).int()
        like = lambda tensor: drawn.view(*drawn.shape, *[1] * (tensor.ndim - 2))
        poisoned = [torch.where(like(tensor), tensor, torch.nan) for tensor in (means2d, depths, conics)]
        return radii, *poisoned, torch.where(drawn, factor, 0) if compensate else None

    def _projection_gradients(
        self, where: tuple[Tensor, ...], inputs: tuple[Any, ...], cotangents: list[Any]
    ) -> list[Tensor]:
        means, quats, scales, viewmats, Ks, width, height, eps2d, model = inputs
        used, row = torch.unique(where[1], return_inverse=True)  # a kernel touches no other rows
        with torch.enable_grad():
            leaves = _leaves(means, quats, scales, viewmats)
            parts = [leaf[used] for leaf in leaves[:3]]
            settings = (width, height, eps2d, 0.0, 1e10, cotangents[3] is not None, model)
            _, *outputs = self._project(*parts, leaves[3], Ks, settings)
            pairs = [(out[where[0], row], v) for out, v in zip(outputs, cotangents, strict=True) if v is not None]
            return _gradients([out for out, _ in pairs], [v for _, v in pairs], leaves)

    def projection_ewa_3dgs_fused_bwd(
        self, means: Tensor, covars: None, quats: Tensor, scales: Tensor, viewmats: Tensor, Ks: Tensor, *rest: Any
    ) -> Any:
        width, height, eps2d, model, radii, _, _, v_means2d, v_depths, v_conics, v_factor, _ = rest
        drawn = torch.nonzero((radii > 0).all(-1), as_tuple=True)
        cotangents = [None if v is None else v[drawn] for v in (v_means2d, v_depths, v_conics, v_factor)]
        inputs = (means, quats, scales, viewmats, Ks, width, height, eps2d, model)
        v = self._projection_gradients(drawn, inputs, cotangents)
        return v[0], None, v[1], v[2], v[3]

    def intersect_tile(self, means2d: Tensor, radii: Tensor, depths: Tensor, *rest: Any) -> Any:
        assert rest[0] is None  # nothing is packed
        drawn = torch.nonzero((radii[0] > 0).all(-1))[:, 0]
        order = drawn[torch.argsort(depths[0, drawn], stable=True)]  # instead of tiles: all of them, front to back
        return torch.zeros_like(radii[..., 0]), order.long(), order.int()

    def intersect_offset(self, codes: Tensor, count: int, across: int, down: int) -> Tensor:
        return torch.zeros(1, down, across, dtype=torch.int32)

    # ---- pixels ----

    def _pixels(
        self, means: Tensor, conics: Tensor, colors: Tensor, opacity: Tensor, width: int, height: int
    ) -> tuple[Tensor, Tensor]:
        """Of splats front to back, means [1 or P, M, 2]: image [1, H, W, C] and alpha [1, H, W, 1]."""
        y, x = (
            side.reshape(-1, 1) + 0.5
            for side in torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
        )
        dx, dy = means[..., 0] - x, means[..., 1] - y
        sigma = 0.5 * (conics[:, 0] * dx * dx + conics[:, 2] * dy * dy) + conics[:, 1] * dx * dy
        image, alpha = _blend(opacity * torch.exp(-sigma), sigma, colors)
        return image.view(1, height, width, -1), alpha.view(1, height, width, 1)

    def rasterize_to_pixels_3dgs_fwd(
        self, means2d: Tensor, conics: Tensor, colors: Tensor, opacities: Tensor, *rest: Any
    ) -> Any:
        background, mask, width, height, _, _, ids = rest
        assert background is None and mask is None
        means, conics, colors, opacity = (tensor[0][ids.long()] for tensor in (means2d, conics, colors, opacities))
        return *self._pixels(means[None], conics, colors, opacity, width, height), torch.zeros(0)

    def rasterize_to_pixels_3dgs_bwd(
        self, means2d: Tensor, conics: Tensor, colors: Tensor, opacities: Tensor, *rest: Any
    ) -> Any:
        _, _, width, height, _, _, ids, _, _, v_image, v_alpha, absolute = rest
        order = ids.long()
        with torch.enable_grad():
            given = [tensor[0][order] for tensor in (conics, colors, opacities)]
            # a copy of the means per pixel, so that absolute gradients can be summed over pixels
            leaves = _leaves(*given, means2d[0][order].expand(width * height, -1, -1))
            outputs = list(self._pixels(leaves[3], *leaves[:3], width, height))
            v = _gradients(outputs, [v_image, v_alpha], leaves)
        spread = lambda like, values: torch.zeros_like(like).index_put((torch.tensor(0), order), values)
        v_means, v_abs = spread(means2d.nan_to_num(), v[3].sum(0)), spread(means2d.nan_to_num(), v[3].abs().sum(0))
        flat = [spread(like.nan_to_num(), one) for like, one in zip((conics, colors, opacities), v[:3], strict=True)]
        return v_abs if absolute else None, v_means, *flat
