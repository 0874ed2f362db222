"""Backend "torch": Gaussian splatting in plain differentiable torch. This file is the specification of all backends:
any floating type, any device, gradients by autograd; slow, and what an installation without a compiler falls back to.

Elliptical weighted averaging of anisotropic Gaussians as in 3D Gaussian Splatting (Kerbl et al. 2023), with gsplat's
conventions. Symbols follow Zwicker et al. 2001: a Gaussian with mean mu, rotation R(q) and scales S has covariance
R S S^T R^T; the camera maps it to the image with the Jacobian J of the projection.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final

import torch
from torch import Tensor

from mudg.base.errors import NumericsError
from mudg.base.types import Camera, Gaussians, RasterTrace, Render
from mudg.core.harmonics import basis_rows, rotation_of_unit

if TYPE_CHECKING:
    from mudg.core.raster.rasterize import RasterConfig

ALPHA_MIN: Final = 1.0 / 255.0
STOP_TRANSMITTANCE: Final = 1e-4
TILE: Final = 16
FAR_M: Final = 1e10
"""Nothing farther away is drawn, by any backend."""


@dataclass(frozen=True, slots=True)
class Splats:
    """Gaussians in the image. means2d [M, 2] pixels; conics [M, 3] inverse covariance (xx, xy, yy), 1/pixels^2;
    opacity [M]; depth [M] camera z, metres; extents [M, 2] pixels: half size of the rectangle where alpha >= 1/255."""

    means2d: Tensor
    conics: Tensor
    opacity: Tensor
    depth: Tensor
    extents: Tensor

    @classmethod
    def of(
        cls, parts: tuple[Tensor, Tensor, Tensor, Tensor], world_from_cam: Tensor, camera: Camera, config: RasterConfig
    ) -> Splats:
        """Means, quaternions, scales and opacity, projected; nonsense for what cannot be drawn."""
        means, quats, scales, opacity = parts
        cam_from_world = world_from_cam[:3, :3].T
        mean_cam = (means - world_from_cam[:3, 3]) @ cam_from_world.T
        depth = mean_cam[:, 2]
        z = torch.where(depth > config.near_m, depth, torch.ones_like(depth))
        slope = mean_cam[:, :2] / z[:, None]
        focal = slope.new_tensor([camera.fx, camera.fy])
        center, size = slope.new_tensor([camera.cx, camera.cy]), slope.new_tensor([camera.width, camera.height])
        # The linearisation point is held within 1.3 times the field of view, where the approximation still makes sense.
        slack = 0.15 * size / focal
        held = torch.minimum(torch.maximum(slope, -center / focal - slack), (size - center) / focal + slack)
        zero = torch.zeros_like(z)
        jacobian = torch.stack(
            [focal[0] / z, zero, -focal[0] * held[:, 0] / z, zero, focal[1] / z, -focal[1] * held[:, 1] / z], 1
        ).view(-1, 2, 3)
        unit = quats / quats.square().sum(1, keepdim=True).clamp_min(1e-24).sqrt()  # zero gives the identity
        half = jacobian @ cam_from_world @ (rotation_of_unit(unit) * scales[:, None, :])  # unit sphere -> ellipse
        sharp = half @ half.transpose(1, 2)
        xx, xy, yy = sharp[:, 0, 0] + config.blur_px2, sharp[:, 0, 1], sharp[:, 1, 1] + config.blur_px2
        # det = xx yy - xy^2, by way of the cross product of the two rows: no cancellation for needles.
        sharp_det = torch.linalg.cross(half[:, 0], half[:, 1]).square().sum(1)
        det = sharp_det + config.blur_px2 * (xx + yy - config.blur_px2)
        if config.antialias:
            opacity = opacity * (sharp_det / det).clamp_min(1e-6).sqrt()
        conics = torch.stack([yy / det, -xy / det, xx / det], 1)
        with torch.no_grad():
            level = (2 * torch.log(opacity.clamp_min(1e-30) / ALPHA_MIN)).clamp_min(0)
            extents = torch.stack([(level * xx).sqrt(), (level * yy).sqrt()], 1) + 1e-3
        return cls(focal * slope + center, conics, opacity, depth, extents)


def render(g: Gaussians, camera: Camera, world_from_cam: Tensor, config: RasterConfig, absgrad: bool) -> Render:
    """Draw with torch operations. See ``core.raster.rasterize``."""
    _refuse_not_finite(g)
    keeps_graph = torch.is_grad_enabled() and any(t.requires_grad for t in (g.means, g.quats, g.scales, world_from_cam))
    # The means are handed out as a leaf, so that their gradient is kept; a zero that carries it joins the graph.
    means2d = g.means.new_zeros(len(g), 2, requires_grad=keeps_graph)
    absolute = torch.zeros_like(means2d) if absgrad and keeps_graph else None
    pose, sh = world_from_cam.to(g.means), harmonics(g)
    splats = project(g, pose, camera, config)
    colors = sh_colors(sh, g.means - pose[:3, 3])
    with torch.no_grad():
        low, high = splats.means2d - splats.extents, splats.means2d + splats.extents
        limit = torch.tensor((camera.width, camera.height), device=low.device)
        touched = (splats.depth < FAR_M) & (splats.opacity >= ALPHA_MIN) & (splats.extents > 0).all(1)
        touched &= (high >= 0.5).all(1) & (low <= limit - 0.5).all(1)
        order = torch.nonzero(touched)[:, 0]
        order = order[torch.argsort(splats.depth[order], stable=True)]
        radii = torch.where(touched[:, None], splats.extents.clamp(0, 1e9).ceil().clamp_min(1), 0).int()
    channels = torch.cat([colors, splats.depth[:, None], *([] if g.extra is None else [g.extra])], 1)[order]
    if not (torch.isfinite(channels).all() and torch.isfinite(sh[order]).all()):
        raise NumericsError(
            "the colour or a feature of a Gaussian is not finite", where="gaussians.sh, gaussians.extra"
        )
    blended, alpha = _blend_tiles(splats, means2d, order, channels, absolute, camera, config.alpha_max)
    means2d.detach().copy_(torch.where(radii > 0, splats.means2d.detach(), 0))
    depth, extra = blended[3:4] / alpha.clamp_min(1e-10), None if g.extra is None else blended[4:]
    return Render(blended[:3], depth, alpha, extra, RasterTrace(means2d, radii, radii[:, 0] > 0, absolute))


def harmonics(gaussians: Gaussians) -> Tensor:
    """All spherical harmonics in one tensor, [N, K, 3]; a copy if they are kept in two."""
    return gaussians.sh if gaussians.sh_rest is None else torch.cat([gaussians.sh, gaussians.sh_rest], 1)


def project(g: Gaussians, world_from_cam: Tensor, camera: Camera, config: RasterConfig) -> Splats:
    """Means and covariances into the image. What cannot be drawn (in front of ``near_m``, a covariance that overflows)
    gets extent 0 and harmless stand-in values, so that it can spoil neither images nor gradients."""
    with torch.no_grad():
        first = Splats.of((g.means, g.quats, g.scales, g.opacity), world_from_cam, camera, config)
        proper = torch.isfinite(torch.cat([first.means2d, first.conics, first.extents], 1)).all(1)
        proper &= (first.conics[:, 0] > 0) & (first.conics[:, 2] > 0) & (first.depth > config.near_m)
    harmless = world_from_cam.detach()[:3, 3] + world_from_cam.detach()[:3, 2] * (config.near_m + 1)
    values = ((g.means, harmless), (g.quats, harmless.new_tensor([1.0, 0, 0, 0])), (g.scales, harmless.new_ones(3)))
    safe = [torch.where(proper[:, None], value, stand_in) for value, stand_in in values]
    splats = Splats.of((safe[0], safe[1], safe[2], g.opacity), world_from_cam, camera, config)
    return replace(splats, extents=torch.where(proper[:, None], splats.extents, 0))


def sh_basis(directions: Tensor, degree: int) -> Tensor:
    """Real spherical harmonics of unit directions [N, 3]: [N, (degree + 1)^2]."""
    return torch.stack(basis_rows(*directions.unbind(1), degree=degree), 1)


def sh_colors(sh: Tensor, directions: Tensor) -> Tensor:
    """Colours [N, 3] >= 0 of harmonics [N, K, 3] seen along directions [N, 3] (camera centre to mean, any length)."""
    unit = directions / (directions.square().sum(1, keepdim=True) + 1e-24).sqrt()
    basis = sh_basis(unit, math.isqrt(sh.shape[1]) - 1)
    return ((basis[:, :, None] * sh).sum(1) + 0.5).clamp_min(0)


def _blend_tiles(
    splats: Splats,
    probe: Tensor,
    order: Tensor,
    channels: Tensor,
    absolute: Tensor | None,
    camera: Camera,
    alpha_max: float,
) -> tuple[Tensor, Tensor]:
    """Blend front to back. Returns accumulated channels [C, H, W] and alpha [1, H, W]."""
    width, height = camera.width, camera.height
    means, conics, opacity = (splats.means2d + probe)[order], splats.conics[order], splats.opacity[order]
    low, high = (splats.means2d - splats.extents)[order].detach(), (splats.means2d + splats.extents)[order].detach()
    rows: list[Tensor] = []
    for top in range(0, height, TILE):
        bottom = min(top + TILE, height)
        in_row = torch.nonzero((high[:, 1] >= top + 0.5) & (low[:, 1] <= bottom - 0.5))[:, 0]
        tiles: list[Tensor] = []
        for left in range(0, width, TILE):
            right = min(left + TILE, width)
            near = in_row[(high[in_row, 0] >= left + 0.5) & (low[in_row, 0] <= right - 0.5)]
            ys = torch.arange(top, bottom, device=means.device, dtype=means.dtype) + 0.5
            xs = torch.arange(left, right, device=means.device, dtype=means.dtype) + 0.5
            pixels = torch.cartesian_prod(ys, xs).flip(1)
            local_means = means[near]
            if absolute is not None and local_means.requires_grad:
                local_means = _SumAbsolute.apply(local_means, absolute, order[near], len(pixels))
            else:
                local_means = local_means[None]
            out = _blend(pixels, local_means, conics[near], opacity[near], channels[near], alpha_max)
            tiles.append(out.view(bottom - top, right - left, -1))
        rows.append(torch.cat(tiles, 1))
    image = torch.cat(rows, 0).permute(2, 0, 1)
    return image[:-1], image[-1:]


def _blend(
    pixels: Tensor, means: Tensor, conics: Tensor, opacity: Tensor, channels: Tensor, alpha_max: float
) -> Tensor:
    """Blend M splats, front to back, at P pixels [P, 2]; means [1 or P, M, 2]. Returns [P, C + 1], alpha last."""
    delta = means - pixels[:, None]
    dx, dy = delta[..., 0], delta[..., 1]
    sigma = 0.5 * (conics[:, 0] * dx * dx + conics[:, 2] * dy * dy) + conics[:, 1] * dx * dy
    alpha = (opacity * torch.exp(-sigma)).clamp_max(alpha_max)
    alpha = torch.where((alpha >= ALPHA_MIN) & (sigma >= 0), alpha, torch.zeros_like(alpha))
    # Transmittance only falls, so the entries that would push it to the stop are the last ones of each pixel.
    alive = torch.cumprod(1 - alpha.detach(), 1) > STOP_TRANSMITTANCE
    alpha = torch.where(alive, alpha, torch.zeros_like(alpha))
    transmittance = torch.cumprod(1 - alpha, 1)
    before = torch.cat([torch.ones_like(alpha[:, :1]), transmittance[:, :-1]], 1) if alpha.shape[1] else alpha
    weight = alpha * before
    left = transmittance[:, -1:] if alpha.shape[1] else torch.ones_like(pixels[:, :1])
    return torch.cat([weight @ channels, 1 - left], 1)


class _SumAbsolute(torch.autograd.Function):
    """Copies means [M, 2] to every pixel [P, M, 2]; backward also adds the absolute gradients of each copy to a
    table."""

    @staticmethod
    def forward(
        ctx: torch.autograd.function.FunctionCtx, means: Tensor, table: Tensor, rows: Tensor, count: int
    ) -> Tensor:
        ctx.table, ctx.rows = table, rows  # type: ignore[attr-defined]
        return means[None].expand(count, -1, -1).clone()

    @staticmethod
    def backward(ctx: torch.autograd.function.FunctionCtx, *grads: Tensor) -> tuple[Tensor | None, ...]:
        grad = grads[0]
        ctx.table.index_add_(0, ctx.rows, grad.abs().sum(0))  # type: ignore[attr-defined]
        return grad.sum(0), None, None, None


def _refuse_not_finite(g: Gaussians) -> None:
    for name in ("means", "quats", "scales", "opacity"):
        values = getattr(g, name)
        bad = ~torch.isfinite(values if values.ndim > 1 else values[:, None]).all(1)
        if bad.any():
            row = int(torch.nonzero(bad)[0, 0])
            raise NumericsError(
                "a Gaussian is not finite", where=f"Gaussian {row}: {name}", got=f"{int(bad.sum())} such Gaussians"
            )
