"""The one front door to Gaussian splatting: ``rasterize(gaussians, view or views, config) -> Render``, differentiable.

The mathematics, which every backend follows (it is written down, readable, in ``torch_twin``): elliptical weighted
averaging of anisotropic Gaussians as in 3D Gaussian Splatting (Kerbl et al. 2023) with the conventions of gsplat: the
projected covariance grows by ``blur_px2``; contributions below 1/255 are dropped; alpha is capped; a pixel stops when
its transmittance would fall to 1e-4; colours are spherical harmonics plus 0.5, clamped at 0; pixel centres lie at +0.5.

Pinhole cameras. ``Camera.distortion`` describes the lens before rectification; images in a scene are rectified, so a
picture drawn here belongs to the rectified camera and the coefficients play no part. A camera with ``readout_s`` > 0 is
drawn as a global shutter at the view's time: ``core/shutter.py`` moves the Gaussians to where a rolling one sees them.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Final, Literal

import torch
from torch import Tensor

from mudg import native
from mudg.base import log
from mudg.base.devices import choose_device
from mudg.base.errors import InputError, ResourceError, UsageError
from mudg.base.types import Gaussians, Render, View, check_shape
from mudg.core.raster import cpu as raster_cpu
from mudg.core.raster import gsplat_cuda, torch_twin
from mudg.core.raster.request import Request

Backend = Literal["auto", "cpu", "torch", "gsplat"]
MAX_EXTRA_CHANNELS: Final = 28
MAX_SH_DEGREE: Final = 3


@dataclass(frozen=True, kw_only=True)
class RasterConfig:
    """How to draw.

    Args:
        backend: which implementation; "auto" takes gsplat for CUDA tensors, else the native kernel, else torch.
        near_m, far_m: only Gaussians whose mean has camera z strictly between these are drawn, metres.
        blur_px2: added to the diagonal of the projected covariance, pixels squared.
        alpha_max: cap on the alpha of one Gaussian at one pixel, in (0, 1).
        antialias: scale opacity by sqrt(det(covariance) / det(covariance + blur)), so that blurring adds no light.
        sh_degree: degree of spherical harmonics in use, 0 to 3; None = what the coefficients allow.
    """

    backend: Backend = "auto"
    near_m: float = 0.01
    far_m: float = 1e10
    blur_px2: float = 0.3
    alpha_max: float = 0.99
    antialias: bool = False
    sh_degree: int | None = None

    def __post_init__(self) -> None:
        if self.backend not in ("auto", *BACKENDS):
            raise UsageError("unknown raster backend", expected=f"auto, {', '.join(BACKENDS)}", got=repr(self.backend))
        if not 0 < self.near_m < self.far_m:
            raise UsageError("depth limits must satisfy 0 < near_m < far_m", got=f"{self.near_m}, {self.far_m}")
        if not (0 <= self.blur_px2 < math.inf and 0 < self.alpha_max < 1):
            raise UsageError(
                "blur_px2 must be finite and >= 0, alpha_max in (0, 1)", got=f"{self.blur_px2}, {self.alpha_max}"
            )
        if self.sh_degree is not None and not 0 <= self.sh_degree <= MAX_SH_DEGREE:
            raise UsageError("sh_degree is out of range", expected=f"0 to {MAX_SH_DEGREE}", got=str(self.sh_degree))


# Each backend: Request -> Render. The only place where backends are listed.
BACKENDS: Final[dict[str, Callable[[Request], Render]]] = {
    "cpu": raster_cpu.render,
    "torch": torch_twin.render,
    "gsplat": gsplat_cuda.render,
}


def rasterize(
    gaussians: Gaussians,
    view: View | Sequence[View],
    config: RasterConfig | None = None,
    *,
    background: Tensor | None = None,
    world_from_cam: Tensor | None = None,
    absgrad: bool = False,
) -> Render:
    """Draw Gaussians into a view, or into several at once; everything returned is differentiable.

    Args:
        gaussians: activated parameters; gradients flow to means, quats, scales, opacity, sh (sh_rest), extra.
        view: the camera, and the pose unless ``world_from_cam`` is given. A sequence of V views (one image size, any
            cameras and poses) gives every result a leading dimension V; gradients are summed over the views.
        config: see ``RasterConfig``.
        background: colour behind everything, in [0, 1]: [3] or [3, H, W], or one per view: [V, 3] or [V, 3, H, W];
            None = black. Differentiable.
        world_from_cam: [4, 4] (with several views [V, 4, 4]) rigid, differentiable poses used instead of the views'.
        absgrad: also fill ``trace.abs_grad2d`` in backward (sum over pixels of |d loss / d mean2d|, pixels).

    Returns:
        Render with rgb [3, H, W], depth [1, H, W] (expected z; times alpha = the accumulated z; 0 where alpha is 0),
        alpha [1, H, W], extra [C, H, W] accumulated, and the trace. ``trace.means2d`` is a leaf whose ``.grad``
        backward fills (pixels); rows of Gaussians that were not drawn are 0.

    Raises:
        InputError: shapes, devices or types that do not fit; views of different sizes, or none.
        ResourceError: the backend asked for is not available here, or memory ran out.
        NumericsError: a parameter is NaN or infinite (in any Gaussian), or the colour or a feature of a drawn one.
            Finite but absurd values (zero quaternion, scale of 1e38) are drawn or culled, never spread NaN.
    """
    config = config or RasterConfig()
    batched = not isinstance(view, View)
    views = (view,) if isinstance(view, View) else tuple(view)
    degree = _check(gaussians, config)
    _check_views(views)
    poses = _poses(world_from_cam, len(views), batched)
    name = _choose_backend(gaussians, config)
    flat, pixelwise = _backgrounds(background, views, batched)
    drawn = BACKENDS[name](Request(gaussians, views, batched, config, degree, flat, poses, absgrad))
    if pixelwise is None:
        return drawn
    return replace(drawn, rgb=drawn.rgb + (1 - drawn.alpha) * pixelwise)


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
        wanted = {"cpu": "cpu", "gsplat": "cuda"}.get(config.backend)
        if wanted is not None and device.type != wanted:
            raise ResourceError(f"raster backend {config.backend!r} works on {wanted} tensors", got=str(device))
        return config.backend
    if device.type == "cuda":
        problem = available("gsplat")
        if problem:
            what, got = "drawing on a GPU needs gsplat", problem
            raise ResourceError(what, got=got, remedy="pip install 'mudg[gsplat]', or keep the Gaussians on the CPU")
        log.info_once("rasterizer: gsplat (CUDA)")
        return "gsplat"
    if device.type == "cpu" and dtype == torch.float32 and not available("cpu"):
        log.info_once(f"rasterizer: native CPU kernel ({native.isa()}, {native.threads()} threads)")
        return "cpu"
    reason = f"tensors are {dtype} on {device}" if not available("cpu") else available("cpu")
    log.info_once(f"rasterizer: torch reference, 10 to 100 times slower than the native kernel ({reason})")
    return "torch"


def _check(gaussians: Gaussians, config: RasterConfig) -> int:
    """Check what the dataclass does not; return the harmonics' degree."""
    coefficients = gaussians.sh.shape[1] + (0 if gaussians.sh_rest is None else gaussians.sh_rest.shape[1])
    allowed = math.isqrt(coefficients) - 1
    degree = allowed if config.sh_degree is None else config.sh_degree
    if not 0 <= degree <= min(allowed, MAX_SH_DEGREE):
        what = "spherical harmonics do not have enough coefficients for their degree"
        expected = f"[N, {(max(degree, 0) + 1) ** 2}, 3]"
        raise InputError(what, where="gaussians.sh", expected=expected, got=f"[{len(gaussians)}, {coefficients}, 3]")
    parts = {
        "means": gaussians.means,
        "quats": gaussians.quats,
        "scales": gaussians.scales,
        "opacity": gaussians.opacity,
        "sh": gaussians.sh,
    }
    if gaussians.sh_rest is not None:
        parts["sh_rest"] = gaussians.sh_rest
    if gaussians.extra is not None:
        parts["extra"] = gaussians.extra
        if gaussians.extra.shape[1] > MAX_EXTRA_CHANNELS:
            what, expected = "too many feature channels", f"at most {MAX_EXTRA_CHANNELS}"
            raise InputError(what, where="gaussians.extra", expected=expected, got=str(gaussians.extra.shape[1]))
    for name, tensor in parts.items():
        if tensor.device != gaussians.means.device or tensor.dtype != gaussians.means.dtype:
            what, where = "all parameters must share device and type", f"gaussians.{name}"
            expected = f"{gaussians.means.dtype} on {gaussians.means.device}"
            raise InputError(what, where=where, expected=expected, got=f"{tensor.dtype} on {tensor.device}")
    return degree


def _check_views(views: tuple[View, ...]) -> None:
    if not views:
        raise InputError("there is no view to draw", expected="a View or a sequence of Views")
    size = (views[0].camera.width, views[0].camera.height)
    for index, view in enumerate(views):
        camera = view.camera
        if (camera.width, camera.height) != size:
            what, where = "views drawn together must share one image size", f"view {index}, camera {camera.name!r}"
            raise InputError(what, where=where, expected=f"{size[0]}x{size[1]}", got=f"{camera.width}x{camera.height}")
        if camera.readout_s > 0 and camera.shutter == "global":
            log.info_once(
                f"rasterizer: the rolling shutter of camera {camera.name!r} ({camera.readout_s} s) is not followed, "
                "as its direction is unknown; drawn as a global shutter at the view's time"
            )


def _poses(world_from_cam: Tensor | None, views: int, batched: bool) -> tuple[Tensor | None, ...]:
    if world_from_cam is None:
        return (None,) * views
    wanted = (views, 4, 4) if batched else (4, 4)
    check_shape(world_from_cam, "world_from_cam", wanted)
    return world_from_cam.unbind(0) if batched else (world_from_cam,)


def _backgrounds(
    background: Tensor | None, views: tuple[View, ...], batched: bool
) -> tuple[tuple[Tensor | None, ...], Tensor | None]:
    """One colour per view for the backend; or black, and what is added to the picture afterwards."""
    black = (None,) * len(views)
    if background is None:
        return black, None
    height, width = views[0].camera.height, views[0].camera.width
    shape, per_view = tuple(background.shape), (len(views),) if batched else ()
    if shape == (3,):
        return (background,) * len(views), None
    if batched and shape == (*per_view, 3):
        return background.unbind(0), None
    if shape in ((3, height, width), (*per_view, 3, height, width)):
        return black, background
    also = f", [{len(views)}, 3] or [{len(views)}, 3, {height}, {width}]" if batched else ""
    raise InputError(
        "the background has the wrong shape", expected=f"[3], [3, {height}, {width}]{also}", got=str(list(shape))
    )


# place --------------------------------------------------------------------------------------------
# Which device Gaussians are drawn on, and so where everything that is learnt about them lives.


DRAWN_ON: Final[dict[str, tuple[str, ...]]] = {
    "auto": ("cpu", "cuda"),
    "cpu": ("cpu",),
    "torch": ("cpu", "cuda"),
    "gsplat": ("cuda",),
}
"""Kinds of devices that each backend draws on."""


def drawing_device(wanted: str, purpose: str, backend: Backend = "auto") -> torch.device:
    """The device for a purpose that draws Gaussians. Says which, once per purpose.

    ``auto`` takes a CUDA device only if the backend can draw there: with backend ``auto``, if gsplat can be used.

    Args:
        wanted: a ``DeviceName``.

    Raises:
        UsageError: the backend does not draw on the device. See ``choose_device``.
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
