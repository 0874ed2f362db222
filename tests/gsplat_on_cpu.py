"""gsplat without CUDA: the real package with stand-ins for its compiled kernels.

Everything that gsplat does in Python runs as it is: argument checks, autograd functions, tiles, what it returns. Only
the compiled functions are replaced, by gsplat's own references in torch (`gsplat.cuda._torch_impl`) and, where those
need further packages, by the formulas of the kernels' source (alpha cut 1/255, cap 0.999, stop at a transmittance of
1e-4, radii that know the opacity). Backward kernels are autograd of the forward ones. As on a GPU, what a kernel does
not write is whatever was in memory: here NaN.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
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


def _tiles(width: int, height: int, tile: int, offsets: Tensor, ids: Tensor) -> Iterator[tuple[int, Tensor, Tensor]]:
    """For every tile of every image: image, flat pixel indices, entries front to back."""
    down, across = offsets.shape[-2:]
    ends = [*offsets.flatten().tolist(), len(ids)]
    for index in range(len(ends) - 1):
        image, place = divmod(index, down * across)
        ys = torch.arange(place // across * tile, min((place // across + 1) * tile, height))
        xs = torch.arange(place % across * tile, min((place % across + 1) * tile, width))
        yield image, (ys[:, None] * width + xs).flatten(), ids[ends[index] : ends[index + 1]].long()


def _blend(alpha: Tensor, sigma: Tensor, channels: Tensor) -> tuple[Tensor, Tensor]:
    """alpha, sigma [P, M] and channels [M, C] to [P, C] and accumulated alpha [P, 1], as the kernels do it."""
    alpha = alpha.clamp_max(ALPHA_MAX)
    alpha = torch.where((alpha >= ALPHA_MIN) & (sigma >= 0), alpha, 0)
    alpha = torch.where(torch.cumprod(1 - alpha.detach(), 1) > STOP, alpha, 0)
    left = torch.cumprod(torch.cat([alpha.new_ones(len(alpha), 1), 1 - alpha], 1), 1)
    return (alpha * left[:, :-1]) @ channels, 1 - left[:, -1:]


def _centers(pixels: Tensor, width: int) -> tuple[Tensor, Tensor]:
    return pixels % width + 0.5, pixels // width + 0.5


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
        from gsplat.cuda._torch_impl import _isect_tiles

        images, _, _, tile, across, down, sort, _ = rest
        assert images is None  # nothing is packed
        return _isect_tiles(means2d.nan_to_num(), radii, depths.nan_to_num(), tile, across, down, sort)

    def intersect_offset(self, codes: Tensor, count: int, across: int, down: int) -> Tensor:
        from gsplat.cuda._torch_impl import _isect_offset_encode

        return _isect_offset_encode(codes, count, across, down)

    # ---- pixels: linear projection ----

    def _pixels(
        self, colors: Tensor, size: tuple[int, int, int], offsets: Tensor, ids: Tensor, response: Any, *masked: Any
    ) -> tuple[Tensor, Tensor]:
        assert masked == (None, None)  # backgrounds and masks
        width, height, tile = size
        images = offsets.numel() // offsets.shape[-1] // offsets.shape[-2]
        blended, image_of, pixels_of = [], [], []
        for image, pixels, entries in _tiles(width, height, tile, offsets, ids):
            alpha, sigma = response(image, pixels, entries)
            blended.append(_blend(alpha, sigma, colors[entries]))
            image_of.append(torch.full_like(pixels, image))
            pixels_of.append(pixels)
        place = (torch.cat(image_of), torch.cat(pixels_of))
        made = []
        for part in range(2):
            values = torch.cat([one[part] for one in blended])
            canvas = values.new_zeros(images, width * height, values.shape[1]).index_put(place, values)
            made.append(canvas.view(*offsets.shape[:-2], height, width, -1))
        return made[0], made[1]

    def _flat_response(self, means: Tensor, conics: Tensor, opacity: Tensor, width: int, spread: list[Any]) -> Any:
        def response(image: int, pixels: Tensor, entries: Tensor) -> tuple[Tensor, Tensor]:
            x, y = _centers(pixels, width)
            here = means[entries][None]
            if spread:  # a copy of the means per pixel, so that absolute gradients can be summed over pixels
                here = means[entries].detach().expand(len(pixels), -1, -1).clone().requires_grad_()
                spread.append((here, entries))
            dx, dy = here[..., 0] - x[:, None], here[..., 1] - y[:, None]
            c = conics[entries]
            sigma = 0.5 * (c[:, 0] * dx * dx + c[:, 2] * dy * dy) + c[:, 1] * dx * dy
            return opacity[entries] * torch.exp(-sigma), sigma

        return response

    def rasterize_to_pixels_3dgs_fwd(
        self, means2d: Tensor, conics: Tensor, colors: Tensor, opacities: Tensor, *rest: Any
    ) -> Any:
        background, mask, width, height, tile, offsets, ids = rest
        means, conics, colors = (tensor.reshape(-1, tensor.shape[-1]) for tensor in (means2d, conics, colors))
        opacity = opacities.reshape(-1)
        response = self._flat_response(means, conics, opacity, width, [])
        image, alpha = self._pixels(colors, (width, height, tile), offsets, ids, response, background, mask)
        return image, alpha, torch.zeros(0)

    def rasterize_to_pixels_3dgs_bwd(
        self, means2d: Tensor, conics: Tensor, colors: Tensor, opacities: Tensor, *rest: Any
    ) -> Any:
        background, mask, width, height, tile, offsets, ids, _, _, v_image, v_alpha, absolute = rest
        with torch.enable_grad():
            flat = [tensor.reshape(-1, tensor.shape[-1]) for tensor in (conics, colors)]
            leaves = _leaves(*flat, opacities.reshape(-1))
            spread: list[Any] = [None]
            response = self._flat_response(means2d.reshape(-1, 2), leaves[0], leaves[2], width, spread)
            image, alpha = self._pixels(leaves[1], (width, height, tile), offsets, ids, response, background, mask)
            copies = spread[1:]
            v = _gradients([image, alpha], [v_image, v_alpha], [*leaves, *(here for here, _ in copies)])
        v_means = torch.zeros(means2d.reshape(-1, 2).shape)
        v_abs = torch.zeros_like(v_means)
        for gradient, (_, entries) in zip(v[3:], copies, strict=True):
            v_means.index_add_(0, entries, gradient.sum(0))
            v_abs.index_add_(0, entries, gradient.abs().sum(0))
        v_flat = [one.view_as(like) for one, like in zip(v[:3], (conics, colors, opacities), strict=True)]
        return v_abs.view_as(means2d) if absolute else None, v_means.view_as(means2d), *v_flat
