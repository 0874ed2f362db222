"""Backend "gsplat": an adapter to the CUDA rasteriser of the same mathematics (gsplat >= 1.5.3). Importable without it.

What differs: gsplat caps alpha at 0.999 whatever ``alpha_max`` says, calls a Gaussian visible whose rectangle reaches
the image's border before its first pixel centre, and rounds radii up without our thousandth of a pixel. Everything else
agrees to rounding. Colours are evaluated here with gsplat's spherical harmonics, and depths here, so that colours,
features and depth go through one pass whose gradients are complete in every mode.
"""

from __future__ import annotations

import importlib
import importlib.metadata
import importlib.util
import os
import shutil
import weakref
from dataclasses import dataclass, replace
from pathlib import Path
from types import ModuleType
from typing import Any, Final

import torch
from torch import Tensor

from mudg.base import log
from mudg.base.errors import InputError, NumericsError, ResourceError
from mudg.base.types import Gaussians, RasterTrace, Render
from mudg.core.raster import torch_twin
from mudg.core.raster.request import Request, harmonics

# whether the package gsplat can be used here, and why not. Imports it only in ``load`` ------------


MINIMUM_VERSION: Final = (1, 5, 3)
_usable = False


def problem() -> str:
    """Why gsplat cannot be used here, or "" if it can."""
    global _usable
    if _usable:
        return ""
    if importlib.util.find_spec("gsplat") is None:
        return "the package gsplat is not installed"
    version = importlib.metadata.version("gsplat")
    numbers = tuple(int(part) for part in version.split("+")[0].split(".")[:3] if part.isdigit())
    if numbers < MINIMUM_VERSION:
        return f"gsplat {version} is older than {'.'.join(map(str, MINIMUM_VERSION))}"
    if not torch.cuda.is_available():
        return "no CUDA device is available"
    reason = "" if compiled_kernels() else _compiler_problem()
    _usable = not reason
    return reason


def compiled_kernels() -> Path | None:
    """The library of kernels that came with gsplat; None if gsplat compiles them when it first draws."""
    spec = importlib.util.find_spec("gsplat")
    folders = [] if spec is None else spec.submodule_search_locations or []
    return next(
        (file for folder in folders for file in sorted(Path(folder).glob("csrc*.*")) if file.suffix in (".so", ".pyd")),
        None,
    )


def nvcc() -> str | None:
    """The CUDA compiler that gsplat would use, looked for where torch looks: CUDA_HOME, CUDA_PATH, PATH,
    /usr/local/cuda."""
    home = os.environ.get("CUDA_HOME") or os.environ.get("CUDA_PATH")
    named = [Path(home) / "bin" / "nvcc"] if home else []
    found = shutil.which("nvcc")
    places = [*named, *([Path(found)] if found else []), Path("/usr/local/cuda/bin/nvcc")]
    return next((str(place) for place in places if place.is_file()), None)


def _compiler_problem() -> str:
    """What is missing to compile the kernels: gsplat itself would only fail at the first picture."""
    if nvcc() is None:
        return (
            "its kernels are not compiled and there is no CUDA toolkit to compile them (nvcc was not found; set"
            " CUDA_HOME)"
        )
    if shutil.which("ninja") is None and importlib.util.find_spec("ninja") is None:
        return "its kernels are not compiled and ninja, which compiles them, is missing (pip install ninja)"
    if not any(shutil.which(name) for name in (os.environ.get("CXX", "c++"), "g++", "clang++", "cl")):
        return "its kernels are not compiled and there is no C++ compiler to compile them"
    return ""


def status() -> str:
    """One line for people: usable here, and where its kernels come from; or why not."""
    reason = problem()
    if reason:
        return f"cannot be used here: {reason}"
    return (
        "its kernels came with it"
        if compiled_kernels()
        else f"{nvcc()} compiles its kernels at the first picture (minutes, once)"
    )


def load() -> ModuleType:
    """The package.

    Raises:
        ResourceError: it cannot be used here.
    """
    reason = problem()
    if reason:
        what = "raster backend 'gsplat' is not available"
        raise ResourceError(what, got=reason, remedy="see docs/gsplat.md; pip install 'mudg[gsplat]'")
    return importlib.import_module("gsplat")


# gsplat cuda --------------------------------------------------------------------------------------


ALPHA_MAX: Final = 0.999
_FARTHEST_M: Final = 1e30
_SMALLEST_M: Final = 1e-9
_LARGEST_PX: Final = 1e9
"""Means and scales are held within these bounds: what lies beyond would overflow in gsplat's float32 and spread NaN."""


@dataclass(frozen=True, slots=True)
class _Cameras:
    """The views relative to ``origin`` [3]: viewmats [V, 4, 4] (cam from world), centers [V, 3], optical axes
    ``forward`` [V, 3], intrinsics [V, 3, 3]."""

    origin: Tensor
    viewmats: Tensor
    centers: Tensor
    forward: Tensor
    intrinsics: Tensor


def render(request: Request) -> Render:
    """Draw all views. See ``core.raster.rasterize``."""
    if request.gaussians.means.dtype != torch.float32:
        got = str(request.gaussians.means.dtype)
        raise InputError("gsplat works on float32 tensors", where="gaussians.means", got=got)
    if not len(request.gaussians):  # gsplat divides by their number
        return torch_twin.render(replace(request, poses=(None,) * len(request.views)))
    gsplat, g, cameras = load(), request.gaussians, _cameras(request)
    if request.config.alpha_max != ALPHA_MAX:
        log.info_once(f"rasterizer: gsplat caps alpha at {ALPHA_MAX}, not at {request.config.alpha_max}")
    g, colorless = _finite(g)
    image, alpha, meta = gsplat.rasterization(
        **_splats(gsplat, request, g, cameras),
        viewmats=cameras.viewmats,
        Ks=cameras.intrinsics,
        width=request.views[0].camera.width,
        height=request.views[0].camera.height,
        near_plane=request.config.near_m,
        far_plane=request.config.far_m,
        eps2d=request.config.blur_px2,
        sh_degree=None,
        render_mode="RGB",
        packed=False,
        rasterize_mode="antialiased" if request.config.antialias else "classic",
        absgrad=request.absgrad,
    )
    trace = _trace(meta, request)
    if colorless is not None and (trace.visible & colorless).any():
        raise NumericsError(
            "the colour or a feature of a Gaussian is not finite", where="gaussians.sh, gaussians.extra"
        )
    planes, alpha = image.permute(0, 3, 1, 2), alpha.permute(0, 3, 1, 2)
    features = 0 if g.extra is None else g.extra.shape[1]
    color, extra, depth_sum = planes[:, :3], planes[:, 3 : 3 + features], planes[:, 3 + features : 4 + features]
    if any(background is not None for background in request.backgrounds):
        behind = torch.stack([color.new_zeros(3) if b is None else b.to(color) for b in request.backgrounds])
        color = color + (1 - alpha) * behind[:, :, None, None]
    depth = depth_sum / alpha.clamp_min(1e-10)
    if request.batched:
        return Render(rgb=color, depth=depth, alpha=alpha, extra=None if g.extra is None else extra, trace=trace)
    return Render(
        rgb=color[0], depth=depth[0], alpha=alpha[0], extra=None if g.extra is None else extra[0], trace=trace
    )


def _finite(g: Gaussians) -> tuple[Gaussians, Tensor | None]:
    """Refuse geometry that is not finite. Harmonics and features that are not are replaced by 0, since only those of
    drawn Gaussians count; the second value [N] says where. One transfer to the CPU."""
    colors = {"sh": g.sh, "sh_rest": g.sh_rest, "extra": g.extra}
    given = {name: tensor for name, tensor in colors.items() if tensor is not None}
    geometry = {name: getattr(g, name) for name in ("means", "quats", "scales", "opacity")}
    flags = torch.stack([torch.isfinite(tensor).all() for tensor in (*geometry.values(), *given.values())]).tolist()
    for name, fine in zip(geometry, flags, strict=False):
        if not fine:
            raise NumericsError("a Gaussian is not finite", where=f"gaussians.{name}")
    if all(flags):
        return g, None
    bad = torch.stack([~torch.isfinite(tensor).flatten(1).all(1) for tensor in given.values()]).any(0)
    clean = {n: torch.where(bad.view(-1, *[1] * (t.ndim - 1)), 0, t) for n, t in given.items()}
    return replace(g, **clean), bad


def _cameras(request: Request) -> _Cameras:
    """Poses are inverted in float64 and taken relative to the first camera, so that float32 serves far from the world's
    origin."""
    like = request.gaussians.means
    poses = torch.stack([request.pose(i).to(like.device, torch.float64) for i in range(len(request.views))])
    origin = poses.detach().reshape(-1, 4, 4)[0, :3, 3].to(like.dtype)
    rotation, centers = poses[..., :3, :3].transpose(-1, -2), poses[..., :3, 3] - origin.double()
    last_row = poses.new_tensor([0, 0, 0, 1.0]).expand(*poses.shape[:-2], 1, 4)
    viewmats = torch.cat([torch.cat([rotation, -rotation @ centers[..., None]], -1), last_row], -2).to(like.dtype)
    intrinsics = torch.stack([torch.from_numpy(view.camera.matrix) for view in request.views]).to(like)
    return _Cameras(origin, viewmats, centers.to(like.dtype), poses[..., :3, 2].to(like.dtype), intrinsics)


def _splats(gsplat: Any, request: Request, g: Gaussians, cameras: _Cameras) -> dict[str, Tensor]:
    """What gsplat receives of the Gaussians; colors [V, N, 3 + features + 1]: colour, features, depth."""
    focal = max(max(view.camera.fx, view.camera.fy) for view in request.views)
    means = (g.means - cameras.origin).clamp(-_FARTHEST_M, _FARTHEST_M)
    scales = g.scales.clamp(_SMALLEST_M, _LARGEST_PX * request.config.near_m / focal)
    usable = g.quats.square().sum(1, keepdim=True) > 1e-24
    quats = torch.where(usable, g.quats, g.quats.new_tensor([1.0, 0, 0, 0]))
    sh = harmonics(g)
    channels = []
    for center, forward in zip(cameras.centers, cameras.forward, strict=True):
        offset = means - center
        at_center = (offset == 0).all(1, keepdim=True)  # has no direction: gsplat would make NaN of it
        direction = torch.where(at_center, forward.detach(), offset)
        rgb = (gsplat.spherical_harmonics(request.sh_degree, direction, sh) + 0.5).clamp_min(0)
        depth = offset @ forward[:, None]
        channels.append(torch.cat([rgb, depth] if g.extra is None else [rgb, g.extra, depth], 1))
    together = channels[0][None] if len(channels) == 1 else torch.stack(channels)
    return {"means": means, "quats": quats, "scales": scales, "opacities": g.opacity, "colors": together}


def _trace(meta: dict[str, Any], request: Request) -> RasterTrace:
    """Trace whose means2d is a leaf: a hook copies the gradient of gsplat's own tensor to it. Rows that are not drawn
    are 0: gsplat leaves them uninitialised."""
    means2d, radii = meta["means2d"], meta["radii"]
    shaped = lambda tensor: tensor if request.batched else tensor[0]
    size = shaped(radii)
    visible = (size > 0).all(-1)
    leaf = torch.where(visible[..., None], shaped(means2d.detach()), 0).requires_grad_(means2d.requires_grad)
    absolute = torch.zeros_like(leaf) if request.absgrad and means2d.requires_grad else None
    trace = RasterTrace(leaf, torch.where(visible[..., None], size, 0).int(), visible, absolute)
    if not means2d.requires_grad:
        return trace
    # The trace owns gsplat's tensor and the hook knows the trace's only weakly: in a circle, both would outlive their
    # use.
    leaf.drawn_by_gsplat = means2d  # type: ignore[attr-defined]
    reference = weakref.ref(leaf)

    def keep(gradient: Tensor) -> None:
        mine = reference()
        if mine is None:
            return
        mine.grad = shaped(gradient) if mine.grad is None else mine.grad + shaped(gradient)
        if absolute is not None:
            # set by gsplat in its backward
            absolute.add_(shaped(mine.drawn_by_gsplat.absgrad))  # type: ignore[attr-defined]

    means2d.register_hook(keep)
    return trace
