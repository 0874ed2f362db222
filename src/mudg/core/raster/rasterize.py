"""The one front door to Gaussian splatting: ``rasterize(gaussians, view, config) -> Render``, differentiable.

Every backend follows the mathematics of ``torch_twin``; docs/rasterizer.md has the conventions.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final, Literal

import torch
from torch import Tensor

from mudg import native
from mudg.base import log
from mudg.base.devices import choose_device
from mudg.base.errors import InputError, ResourceError, UsageError
from mudg.base.types import Camera, Gaussians, Render, View, check_shape
from mudg.core.raster import cpu as raster_cpu
from mudg.core.raster import gsplat_cuda, torch_twin

Backend = Literal["auto", "cpu", "torch", "gsplat"]
MAX_EXTRA_CHANNELS: Final = 28
MAX_SH_DEGREE: Final = 3


@dataclass(frozen=True, kw_only=True)
class RasterConfig:
    """How to draw.

    Args:
        backend: which implementation; "auto" takes gsplat for CUDA tensors, else the native kernel, else torch.
        near_m: only Gaussians whose mean has a larger camera z are drawn, metres.
        blur_px2: added to the diagonal of the projected covariance, pixels squared.
        alpha_max: cap on the alpha of one Gaussian at one pixel, in (0, 1).
        antialias: scale opacity by sqrt(det(covariance) / det(covariance + blur)), so that blurring adds no light.
    """

    backend: Backend = "auto"
    near_m: float = 0.01
    blur_px2: float = 0.3
    alpha_max: float = 0.99
    antialias: bool = False

    def __post_init__(self) -> None:
        if self.backend not in ("auto", *BACKENDS):
            raise UsageError("unknown raster backend", expected=f"auto, {', '.join(BACKENDS)}", got=repr(self.backend))
        if not (0 < self.near_m < math.inf and 0 <= self.blur_px2 < math.inf and 0 < self.alpha_max < 1):
            what, got = "a setting of the rasterizer is out of range", str(self)
            raise UsageError(what, expected="near_m > 0, blur_px2 >= 0, alpha_max in (0, 1), all finite", got=got)


# Each backend draws Gaussians with a camera at a pose world_from_cam [4, 4]; the last argument asks for absolute
# gradients. The only place where backends are listed.
BACKENDS: Final[dict[str, Callable[[Gaussians, Camera, Tensor, RasterConfig, bool], Render]]] = {
    "cpu": raster_cpu.render,
    "torch": torch_twin.render,
    "gsplat": gsplat_cuda.render,
}


def rasterize(
    gaussians: Gaussians,
    view: View,
    config: RasterConfig | None = None,
    *,
    world_from_cam: Tensor | None = None,
    absgrad: bool = False,
) -> Render:
    """Draw Gaussians into a view, over black; everything returned is differentiable.

    Cameras are pinhole cameras with a global shutter: ``Camera.distortion`` describes the lens before rectification,
    and ``core/trajectory.py`` moves Gaussians to where a rolling shutter sees them.

    Args:
        gaussians: activated parameters; gradients flow to means, quats, scales, opacity, sh (sh_rest), extra.
        view: the camera, and the pose unless ``world_from_cam`` is given.
        config: see ``RasterConfig``.
        world_from_cam: [4, 4], a rigid, differentiable pose used instead of the view's.
        absgrad: also fill ``trace.abs_grad2d`` in backward (sum over pixels of |d loss / d mean2d|, pixels).

    Returns:
        Render with rgb [3, H, W], depth [1, H, W] (expected z; times alpha = the accumulated z; 0 where alpha is 0),
        alpha [1, H, W], extra [C, H, W] accumulated, and the trace. ``trace.means2d`` is a leaf whose ``.grad``
        backward fills (pixels); rows of Gaussians that were not drawn are 0.

    Raises:
        InputError: shapes, devices or types that do not fit.
        ResourceError: the backend asked for is not available here, or memory ran out.
        NumericsError: a parameter is NaN or infinite (in any Gaussian), or the colour or a feature of a drawn one.
            Finite but absurd values (zero quaternion, scale of 1e38) are drawn or culled, never spread NaN.
    """
    config, camera = config or RasterConfig(), view.camera
    _check(gaussians)
    if world_from_cam is None:
        world_from_cam = torch.from_numpy(view.world_from_cam.copy())
    check_shape(world_from_cam, "world_from_cam", (4, 4))
    if camera.readout_s > 0 and camera.shutter == "global":
        log.info_once(
            f"rasterizer: the rolling shutter of camera {camera.name!r} ({camera.readout_s} s) is not followed, "
            "as its direction is unknown; drawn as a global shutter at the view's time"
        )
    return BACKENDS[_choose_backend(gaussians, config)](gaussians, camera, world_from_cam, config, absgrad)


def available(backend: str) -> str:
    """Why a backend cannot be used here, or "" if it can."""
    if backend == "cpu":
        return "" if native.library() is not None else native.status()
    if backend == "gsplat":
        return gsplat_cuda.problem()
    return "" if backend == "torch" else f"unknown backend {backend!r}"


def _choose_backend(gaussians: Gaussians, config: RasterConfig) -> str:
    device, dtype = gaussians.means.device, gaussians.means.dtype
    if config.backend != "auto":
        problem = available(config.backend)
        if problem:
            what = f"raster backend {config.backend!r} is not available"
            raise ResourceError(what, got=problem, remedy="install what is missing or use backend='auto'")
        if device.type in ("cpu", "cuda") and device.type not in DRAWN_ON[config.backend]:
            what = f"raster backend {config.backend!r} works on {DRAWN_ON[config.backend][0]} tensors"
            raise ResourceError(what, got=str(device))
        return config.backend
    if device.type == "cuda":
        problem = available("gsplat")
        if problem:
            remedy = "pip install 'mudg[gsplat]', or keep the Gaussians on the CPU"
            raise ResourceError("drawing on a GPU needs gsplat", got=problem, remedy=remedy)
        log.info_once("rasterizer: gsplat (CUDA)")
        return "gsplat"
    problem = available("cpu")
    if device.type == "cpu" and dtype == torch.float32 and not problem:
        log.info_once(f"rasterizer: native CPU kernel ({native.isa()}, {native.threads()} threads)")
        return "cpu"
    reason = problem or f"tensors are {dtype} on {device}"
    log.info_once(f"rasterizer: torch reference, 10 to 100 times slower than the native kernel ({reason})")
    return "torch"


def _check(gaussians: Gaussians) -> None:
    """Check what the dataclass does not."""
    parts = {name: getattr(gaussians, name) for name in raster_cpu.PARTS if getattr(gaussians, name) is not None}
    coefficients = sum(parts[name].shape[1] for name in ("sh", "sh_rest") if name in parts)
    if coefficients not in [(degree + 1) ** 2 for degree in range(MAX_SH_DEGREE + 1)]:
        what, got = "spherical harmonics do not have as many coefficients as a degree", f"[N, {coefficients}, 3]"
        raise InputError(what, where="gaussians.sh", expected="[N, 1, 4, 9 or 16, 3]", got=got)
    if "extra" in parts and parts["extra"].shape[1] > MAX_EXTRA_CHANNELS:
        what, expected, got = "too many feature channels", f"at most {MAX_EXTRA_CHANNELS}", parts["extra"].shape[1]
        raise InputError(what, where="gaussians.extra", expected=expected, got=str(got))
    device, dtype = gaussians.means.device, gaussians.means.dtype
    for name, tensor in parts.items():
        if tensor.device != device or tensor.dtype != dtype:
            what, got = "all parameters must share device and type", f"{tensor.dtype} on {tensor.device}"
            raise InputError(what, where=f"gaussians.{name}", expected=f"{dtype} on {device}", got=got)


# Which device Gaussians are drawn on, and so where everything that is learnt about them lives.
DRAWN_ON: Final[dict[str, tuple[str, ...]]] = {
    "auto": ("cpu", "cuda"),
    "cpu": ("cpu",),
    "torch": ("cpu", "cuda"),
    "gsplat": ("cuda",),
}
"""Kinds of devices that each backend draws on."""


def drawing_device(wanted: str, purpose: str, backend: Backend = "auto") -> torch.device:
    """The device (``wanted``: a ``DeviceName``) for a purpose that draws Gaussians. Says which, once per purpose.

    ``auto`` takes a CUDA device only if the backend can draw there: with backend ``auto``, if gsplat can be used.
    UsageError: the backend does not draw on the device, or see ``choose_device``.
    """
    kinds = DRAWN_ON[backend]
    if wanted == "auto":
        problem = available("gsplat") if backend == "auto" and torch.cuda.is_available() else ""
        if problem:
            log.info_once(f"{purpose}: CUDA is not used, drawing there needs gsplat ({problem})")
        wanted = kinds[0] if len(kinds) == 1 else "cpu" if problem else "auto"
    chosen = choose_device(wanted, purpose)
    if chosen.type in ("cpu", "cuda") and chosen.type not in kinds:
        what, where, got = f"raster backend {backend!r} does not draw on this device", "--raster", f"--device {wanted}"
        raise UsageError(what, where=where, expected=f"--device {kinds[0]}", got=got, remedy="leave --raster at auto")
    return chosen
