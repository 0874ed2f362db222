"""Backend "gsplat": an adapter to the CUDA rasteriser of the same mathematics (gsplat >= 1.5.3). Importable without it.

Differences that gsplat does not let us set: it caps alpha at 0.999 whatever ``alpha_max`` says, and it drops Gaussians by a radius of
3.33 standard deviations, which equals the alpha cut to within rounding. Colours are evaluated here with gsplat's
spherical harmonics, so that colours and features go through one pass.
"""

from __future__ import annotations

import importlib
import importlib.metadata
import importlib.util
from types import ModuleType
from typing import TYPE_CHECKING, Final

import torch
from torch import Tensor

from mudg.base import log
from mudg.base.errors import NumericsError, ResourceError
from mudg.base.types import RasterTrace, Render

if TYPE_CHECKING:
    from mudg.core.raster import Request

MINIMUM_VERSION: Final = (1, 5, 3)
ALPHA_MAX: Final = 0.999


def problem() -> str:
    """Why gsplat cannot be used here, or "" if it can."""
    if importlib.util.find_spec("gsplat") is None:
        return "the package gsplat is not installed"
    version = importlib.metadata.version("gsplat")
    numbers = tuple(int(part) for part in version.split("+")[0].split(".")[:3] if part.isdigit())
    if numbers < MINIMUM_VERSION:
        return f"gsplat {version} is older than {'.'.join(map(str, MINIMUM_VERSION))}"
    return "" if torch.cuda.is_available() else "no CUDA device is available"


def render(request: Request, module: ModuleType | None = None) -> Render:
    """Draw with gsplat. ``module`` stands in for the gsplat package in tests. See ``core.raster.rasterize``."""
    gsplat = module or _load()
    g, camera, config = request.gaussians, request.view.camera, request.config
    if config.alpha_max != ALPHA_MAX:
        log.info_once(f"rasterizer: gsplat caps alpha at {ALPHA_MAX}, not at {config.alpha_max}")
    pose = request.world_from_cam
    if pose is None:
        pose = torch.from_numpy(request.view.world_from_cam.copy())
    pose = pose.to(g.means)
    for name in ("means", "quats", "scales", "opacity"):
        if not torch.isfinite(getattr(g, name)).all():
            raise NumericsError("a Gaussian is not finite", where=f"gaussians.{name}")
    rotation = pose[:3, :3].T
    cam_from_world = torch.cat([torch.cat([rotation, -rotation @ pose[:3, 3:]], 1), pose.new_tensor([[0, 0, 0, 1.0]])])
    directions = torch.nn.functional.normalize(g.means - pose[:3, 3], dim=1)
    rgb = (gsplat.spherical_harmonics(request.sh_degree, directions, g.sh) + 0.5).clamp_min(0)
    colors = rgb if g.extra is None else torch.cat([rgb, g.extra], 1)
    intrinsics = torch.from_numpy(camera.matrix).to(g.means)
    image, alpha, meta = gsplat.rasterization(
        means=g.means, quats=g.quats, scales=g.scales, opacities=g.opacity, colors=colors,
        viewmats=cam_from_world[None], Ks=intrinsics[None], width=camera.width, height=camera.height,
        near_plane=config.near_m, far_plane=config.far_m, eps2d=config.blur_px2, sh_degree=None, packed=False,
        render_mode="RGB+D", rasterize_mode="antialiased" if config.antialias else "classic", absgrad=request.absgrad,
    )  # fmt: skip
    planes, alpha = image[0].permute(2, 0, 1), alpha[0].permute(2, 0, 1)
    color, extra, depth_sum = planes[:3], planes[3:-1], planes[-1:]
    if request.background is not None:
        color = color + (1 - alpha) * request.background.to(color)[:, None, None]
    return Render(
        rgb=color, depth=depth_sum / alpha.clamp_min(1e-10), alpha=alpha,
        extra=None if g.extra is None else extra, trace=_trace(meta, request.absgrad),
    )  # fmt: skip


def _trace(meta: dict[str, Tensor], absgrad: bool) -> RasterTrace:
    """Trace whose means2d is a leaf: a hook copies the gradient of gsplat's own tensor [1, N, 2] to it."""
    means2d, radii = meta["means2d"], meta["radii"][0]
    if radii.ndim == 1:
        radii = radii[:, None].expand(-1, 2)
    leaf = means2d.detach()[0].clone().requires_grad_(means2d.requires_grad)
    trace = RasterTrace(leaf, radii.int(), (radii > 0).all(1), torch.zeros_like(leaf) if absgrad else None)

    def keep(gradient: Tensor) -> None:
        leaf.grad = gradient[0] if leaf.grad is None else leaf.grad + gradient[0]
        if trace.abs_grad2d is not None:
            trace.abs_grad2d += means2d.absgrad[0]  # type: ignore[attr-defined]  # set by gsplat in its backward

    if means2d.requires_grad:
        means2d.register_hook(keep)
    return trace


def _load() -> ModuleType:
    reason = problem()
    if reason:
        raise ResourceError("raster backend 'gsplat' is not available", got=reason, remedy="pip install 'mudg[gsplat]'")
    return importlib.import_module("gsplat")
