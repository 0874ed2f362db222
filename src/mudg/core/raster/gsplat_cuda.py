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
from typing import Final

import torch
from torch import Tensor

from mudg.base import log
from mudg.base.errors import NumericsError, ResourceError
from mudg.base.types import RasterTrace, Render
from mudg.core.raster.request import Request, harmonics

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
    """Draw all views with one call of gsplat. ``module`` stands in for the gsplat package in tests. See
    ``core.raster.rasterize``."""
    gsplat = module or _load()
    g, config, camera = request.gaussians, request.config, request.views[0].camera
    if config.alpha_max != ALPHA_MAX:
        log.info_once(f"rasterizer: gsplat caps alpha at {ALPHA_MAX}, not at {config.alpha_max}")
    for name in ("means", "quats", "scales", "opacity"):
        if not torch.isfinite(getattr(g, name)).all():
            raise NumericsError("a Gaussian is not finite", where=f"gaussians.{name}")
    poses = torch.stack([request.pose(index).to(g.means) for index in range(len(request.views))])
    rotation, center = poses[:, :3, :3].transpose(1, 2), poses[:, :3, 3]
    last_row = poses.new_tensor([0, 0, 0, 1.0]).expand(len(poses), 1, 4)
    cam_from_world = torch.cat([torch.cat([rotation, -rotation @ center[:, :, None]], 2), last_row], 1)
    directions = torch.nn.functional.normalize(g.means - center[:, None], dim=2)
    sh = harmonics(g)
    sh_per_view = sh.expand(len(poses), *sh.shape)
    rgb = (gsplat.spherical_harmonics(request.sh_degree, directions, sh_per_view) + 0.5).clamp_min(0)
    colors = rgb if g.extra is None else torch.cat([rgb, g.extra.expand(len(poses), *g.extra.shape)], 2)
    intrinsics = torch.stack([torch.from_numpy(view.camera.matrix) for view in request.views]).to(g.means)
    image, alpha, meta = gsplat.rasterization(
        means=g.means, quats=g.quats, scales=g.scales, opacities=g.opacity, colors=colors,
        viewmats=cam_from_world, Ks=intrinsics, width=camera.width, height=camera.height,
        near_plane=config.near_m, far_plane=config.far_m, eps2d=config.blur_px2, sh_degree=None, packed=False,
        render_mode="RGB+D", rasterize_mode="antialiased" if config.antialias else "classic", absgrad=request.absgrad,
    )  # fmt: skip
    planes, alpha = image.permute(0, 3, 1, 2), alpha.permute(0, 3, 1, 2)
    color, extra, depth_sum = planes[:, :3], planes[:, 3:-1], planes[:, -1:]
    if any(background is not None for background in request.backgrounds):
        behind = torch.stack([color.new_zeros(3) if b is None else b.to(color) for b in request.backgrounds])
        color = color + (1 - alpha) * behind[:, :, None, None]
    depth = depth_sum / alpha.clamp_min(1e-10)
    trace = _trace(meta, request)
    if request.batched:
        return Render(rgb=color, depth=depth, alpha=alpha, extra=None if g.extra is None else extra, trace=trace)
    return Render(rgb=color[0], depth=depth[0], alpha=alpha[0], extra=None if g.extra is None else extra[0], trace=trace)


def _trace(meta: dict[str, Tensor], request: Request) -> RasterTrace:
    """Trace whose means2d is a leaf: a hook copies the gradient of gsplat's own tensor [V, N, 2] to it."""
    means2d, radii = meta["means2d"], meta["radii"]
    if radii.ndim == 2:
        radii = radii[:, :, None].expand(-1, -1, 2)

    def shaped(tensor: Tensor) -> Tensor:
        return tensor if request.batched else tensor[0]

    leaf = shaped(means2d.detach()).clone().requires_grad_(means2d.requires_grad)
    absolute = torch.zeros_like(leaf) if request.absgrad else None
    trace = RasterTrace(leaf, shaped(radii.int()), shaped((radii > 0).all(2)), absolute)

    def keep(gradient: Tensor) -> None:
        leaf.grad = shaped(gradient) if leaf.grad is None else leaf.grad + shaped(gradient)
        if trace.abs_grad2d is not None:
            trace.abs_grad2d += shaped(means2d.absgrad)  # type: ignore[attr-defined]  # set by gsplat in its backward

    if means2d.requires_grad:
        means2d.register_hook(keep)
    return trace


def _load() -> ModuleType:
    reason = problem()
    if reason:
        raise ResourceError("raster backend 'gsplat' is not available", got=reason, remedy="pip install 'mudg[gsplat]'")
    return importlib.import_module("gsplat")
