"""Backend "gsplat": an adapter to the CUDA rasteriser of the same mathematics (gsplat >= 1.5.3). Importable without it.

What differs stands in docs/gsplat.md. Harmonics and depths are evaluated here, so that colours, features and depth go
through one pass whose gradients are complete in every mode."""

from __future__ import annotations

import importlib
import importlib.metadata
import importlib.util
import math
import os
import shutil
import weakref
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any, Final

import torch
from torch import Tensor

from mudg.base import log
from mudg.base.errors import InputError, NumericsError, ResourceError
from mudg.base.types import Camera, Gaussians, RasterTrace, Render
from mudg.core.raster import torch_twin

if TYPE_CHECKING:
    from mudg.core.raster.rasterize import RasterConfig

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
    files = (file for folder in folders for file in sorted(Path(folder).glob("csrc*.*")))
    return next((file for file in files if file.suffix in (".so", ".pyd")), None)


def nvcc() -> str | None:
    """The CUDA compiler that gsplat would use, looked for where torch looks: CUDA_HOME, CUDA_PATH, PATH,
    /usr/local/cuda."""
    home = os.environ.get("CUDA_HOME") or os.environ.get("CUDA_PATH")
    places = (f"{home}/bin/nvcc" if home else "", shutil.which("nvcc") or "", "/usr/local/cuda/bin/nvcc")
    return next((place for place in places if Path(place).is_file()), None)


def _compiler_problem() -> str:
    """What is missing to compile the kernels: gsplat itself would only fail at the first picture."""
    missing = ""
    if nvcc() is None:
        missing = "there is no CUDA toolkit to compile them (nvcc was not found; set CUDA_HOME)"
    elif shutil.which("ninja") is None and importlib.util.find_spec("ninja") is None:
        missing = "ninja, which compiles them, is missing (pip install ninja)"
    elif not any(shutil.which(name) for name in (os.environ.get("CXX", "c++"), "g++", "clang++", "cl")):
        missing = "there is no C++ compiler to compile them"
    return missing and f"its kernels are not compiled and {missing}"


def status() -> str:
    """One line for people: usable here, and where its kernels come from; or why not."""
    if reason := problem():
        return f"cannot be used here: {reason}"
    if compiled_kernels():
        return "its kernels came with it"
    return f"{nvcc()} compiles its kernels at the first picture (minutes, once)"


def load() -> ModuleType:
    """The package. ResourceError: it cannot be used here."""
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


def render(g: Gaussians, camera: Camera, world_from_cam: Tensor, config: RasterConfig, absgrad: bool) -> Render:
    """Draw on the GPU. See ``core.raster.rasterize``."""
    if g.means.dtype != torch.float32:
        raise InputError("gsplat works on float32 tensors", where="gaussians.means", got=str(g.means.dtype))
    if not len(g):  # gsplat divides by their number
        return torch_twin.render(g, camera, world_from_cam, config, absgrad)
    gsplat = load()
    if config.alpha_max != ALPHA_MAX:
        log.info_once(f"rasterizer: gsplat caps alpha at {ALPHA_MAX}, not at {config.alpha_max}")
    g, colorless = _finite(g)
    # Poses are inverted in float64, places taken relative to the camera: float32 serves far from the world's origin
    pose = world_from_cam.to(g.means.device, torch.float64)
    origin = pose.detach()[:3, 3].to(g.means)
    rotation, center = pose[:3, :3].T, pose[:3, 3] - origin.double()
    rows = torch.cat([rotation, -(rotation @ center)[:, None]], 1)
    viewmat = torch.cat([rows, pose.new_tensor([[0, 0, 0, 1.0]])]).to(g.means)
    image, alpha, meta = gsplat.rasterization(
        **_splats(gsplat, g, config.near_m / max(camera.fx, camera.fy), origin, center, pose[:3, 2]),
        viewmats=viewmat[None],
        Ks=torch.from_numpy(camera.matrix)[None].to(g.means),
        width=camera.width,
        height=camera.height,
        near_plane=config.near_m,
        far_plane=torch_twin.FAR_M,
        eps2d=config.blur_px2,
        sh_degree=None,
        render_mode="RGB",
        packed=False,
        rasterize_mode="antialiased" if config.antialias else "classic",
        absgrad=absgrad,
    )
    trace = _trace(meta, absgrad)
    if colorless is not None and (trace.visible & colorless).any():
        raise NumericsError(
            "the colour or a feature of a Gaussian is not finite", where="gaussians.sh, gaussians.extra"
        )
    planes, alpha = image[0].permute(2, 0, 1), alpha[0].permute(2, 0, 1)
    depth = planes[-1:] / alpha.clamp_min(1e-10)
    return Render(planes[:3], depth, alpha, None if g.extra is None else planes[3:-1], trace)


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


def _splats(
    gsplat: Any, g: Gaussians, near_per_px: float, origin: Tensor, center: Tensor, forward: Tensor
) -> dict[str, Tensor]:
    """What gsplat receives of the Gaussians, relative to ``origin`` [3]; colors [1, N, 3 + features + 1]: colour,
    features, depth. ``center`` f64[3] and ``forward`` f64[3]: the camera's place and axis."""
    means = (g.means - origin).clamp(-_FARTHEST_M, _FARTHEST_M)
    scales = g.scales.clamp(_SMALLEST_M, _LARGEST_PX * near_per_px)
    usable = g.quats.square().sum(1, keepdim=True) > 1e-24
    quats = torch.where(usable, g.quats, g.quats.new_tensor([1.0, 0, 0, 0]))
    sh, axis, offset = torch_twin.harmonics(g), forward.to(means), means - center.to(means)
    at_center = (offset == 0).all(1, keepdim=True)  # has no direction: gsplat would make NaN of it
    direction = torch.where(at_center, axis.detach(), offset)
    rgb = (gsplat.spherical_harmonics(math.isqrt(sh.shape[1]) - 1, direction, sh) + 0.5).clamp_min(0)
    channels = torch.cat([rgb, *([] if g.extra is None else [g.extra]), offset @ axis[:, None]], 1)
    return {"means": means, "quats": quats, "scales": scales, "opacities": g.opacity, "colors": channels[None]}


def _trace(meta: dict[str, Any], absgrad: bool) -> RasterTrace:
    """Trace whose means2d is a leaf: a hook copies the gradient of gsplat's own tensor to it. Rows that are not drawn
    are 0: gsplat leaves them uninitialised."""
    means2d, size = meta["means2d"], meta["radii"][0]
    visible = (size > 0).all(-1)
    leaf = torch.where(visible[:, None], means2d.detach()[0], 0).requires_grad_(means2d.requires_grad)
    absolute = torch.zeros_like(leaf) if absgrad and means2d.requires_grad else None
    trace = RasterTrace(leaf, torch.where(visible[:, None], size, 0).int(), visible, absolute)
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
        mine.grad = gradient[0] if mine.grad is None else mine.grad + gradient[0]
        if absolute is not None:
            # set by gsplat in its backward
            absolute.add_(mine.drawn_by_gsplat.absgrad[0])  # type: ignore[attr-defined]

    means2d.register_hook(keep)
    return trace
