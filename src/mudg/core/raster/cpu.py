"""Backend "cpu": the native rasteriser as a torch autograd function. float32 on the CPU.

The forward pass keeps its working memory in a context of the library until the backward pass is over (or the graph is
dropped); contexts are then reused, so that a training loop allocates once. Images do not depend on the number of
threads.
"""

from __future__ import annotations

import ctypes
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, Final

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from mudg import native
from mudg.base import memory
from mudg.base.errors import InputError, NumericsError, ResourceError
from mudg.base.types import Camera, Render
from mudg.core.raster.request import Drawn, Request, joined, trace_leaves

if TYPE_CHECKING:
    from mudg.core.raster.rasterize import RasterConfig

_F, _I, _P = ctypes.c_float, ctypes.c_int32, ctypes.c_void_p
_RECYCLE_FROM_BYTES: Final = 8 << 20
PHASES: Final = ("project", "sort", "bin", "blend", "blend_backward", "project_backward")


# Mirrors of the structs in native/raster_types.h.
class _Scene(ctypes.Structure):
    _fields_ = [
        *(
            (name, _I)
            for name in (
                "count",
                "width",
                "height",
                "extra_channels",
                "sh_coefficients",
                "sh_degree",
                "antialias",
                "want_abs_gradient",
            )
        ),
        *((name, _F) for name in ("near_m", "far_m", "blur_px2", "alpha_max", "fx", "fy", "cx", "cy")),
        ("rotation", _F * 9),
        ("center_high", _F * 3),
        ("center_low", _F * 3),
        ("background", _F * 3),
        *((name, _P) for name in ("means", "quats", "scales", "opacities", "sh", "extra", "sh_rest")),
    ]


class _Image(ctypes.Structure):
    _fields_ = [(name, _P) for name in ("rgb", "depth", "alpha", "extra", "means2d", "radii")]


class _ImageGradient(ctypes.Structure):
    _fields_ = [(name, _P) for name in ("rgb", "depth", "alpha", "extra")]


class _Gradient(ctypes.Structure):
    _fields_ = [
        *(
            (name, _P)
            for name in ("means", "quats", "scales", "opacities", "sh", "extra", "means2d", "abs_means2d", "sh_rest")
        ),
        ("rotation", _F * 9),
        ("center", _F * 3),
        ("background", _F * 3),
    ]


class _Context:
    """A native context; it goes back to the free list when the last reference is dropped."""

    _free: ClassVar[list[int]] = []

    def __init__(self, library: ctypes.CDLL) -> None:
        self.library = library
        try:
            self.handle = _Context._free.pop()
        except IndexError:
            self.handle = library.mudg_raster_new()
        if not self.handle:
            raise ResourceError("not enough memory for the rasteriser")

    def __del__(self) -> None:
        free = getattr(type(self), "_free", None)  # gone when the interpreter is shutting down
        if free is not None and getattr(self, "handle", None):
            free.append(self.handle)


def _statistics(library: ctypes.CDLL, handle: int) -> dict[str, float]:
    counts, phases = (ctypes.c_int64 * 6)(), (ctypes.c_double * 6)()
    library.mudg_raster_statistics(handle, counts, phases)
    names = ("visible", "entries", "not_finite", "first_not_finite", "context_bytes", "pairs", *PHASES)
    return {name: float(value) for name, value in zip(names, (*counts, *phases), strict=True)}


class _Loan:
    """Keeps borrowed memory out of the free list until the last tensor over it is gone."""

    free: ClassVar[list[Tensor]] = []

    def __init__(self, block: Tensor) -> None:
        self.block = block

    def __del__(self) -> None:
        free = getattr(type(self), "free", None)  # gone when the interpreter is shutting down
        if free is not None:
            free.append(self.block)


def _recycled_like(tensor: Tensor) -> Tensor:
    """``torch.empty_like``, from memory of an earlier gradient where there is some.

    The allocator gives blocks of this size back to the system, and every page of a fresh one costs a fault: at 200,000
    Gaussians that was a tenth of a training step.
    """
    count = tensor.numel()
    if count * tensor.element_size() < _RECYCLE_FROM_BYTES:
        return torch.empty_like(tensor)
    fitting = [i for i, block in enumerate(_Loan.free) if count <= block.numel() <= 1.5 * count]
    if fitting:
        block = _Loan.free.pop(fitting[0])
    else:
        _Loan.free.clear()  # blocks of a size that is no longer asked for
        block = torch.empty(count + count // 8)
    memory = (_F * count).from_address(block.data_ptr())
    # The tensor keeps `memory` alive, and that the loan.
    memory.loan = _Loan(block)  # type: ignore[attr-defined]
    return torch.frombuffer(memory, dtype=torch.float32).view(tensor.shape)


def release_memory() -> None:
    """Free the working memory that is not in use, contexts of the library and memory kept for gradients, and hand all
    that is free to the system: for work that follows and renders nothing for a while, here or in other processes."""
    global _last_handle
    _last_handle = 0
    _Loan.free.clear()
    library = native.library()
    while library is not None and _Context._free:
        library.mudg_raster_free(_Context._free.pop())
    memory.give_back()


_PARTS: Final = ("means", "quats", "scales", "opacity", "sh", "extra", "sh_rest")
"""Fields of Gaussians in the order of the library's structures."""


@dataclass(slots=True)
class _Call:
    """What one call needs besides tensors, and what it hands back besides differentiable ones."""

    library: ctypes.CDLL
    camera: Camera
    config: RasterConfig
    sh_degree: int
    keeps_graph: bool
    radii: Tensor
    abs_grad2d: Tensor | None


def render(request: Request) -> Render:
    """Draw with the native kernel. See ``core.raster.rasterize``."""
    gaussians = request.gaussians
    _library()
    if gaussians.means.dtype != torch.float32 or gaussians.means.device.type != "cpu":
        what = "the native rasteriser works on float32 CPU tensors"
        got = f"{gaussians.means.dtype} on {gaussians.means.device}"
        raise InputError(what, where="gaussians.means", expected="torch.float32 on cpu", got=got)
    tensors = (*(getattr(gaussians, name) for name in _PARTS), *request.backgrounds, *request.poses)
    keeps_graph = torch.is_grad_enabled() and any(t is not None and t.requires_grad for t in tensors)
    means2d, leaves = trace_leaves(request, gaussians.means, keeps_graph)
    absolute = torch.zeros_like(means2d) if request.absgrad and keeps_graph else None
    parts_of_absolute = (None,) * len(leaves) if absolute is None else absolute.view(len(leaves), -1, 2).unbind(0)
    drawn = [
        _draw(request, index, leaf, part, keeps_graph)
        for index, (leaf, part) in enumerate(zip(leaves, parts_of_absolute, strict=True))
    ]
    return joined(request, drawn, means2d, absolute)


def _draw(request: Request, index: int, means2d: Tensor, abs_grad2d: Tensor | None, keeps_graph: bool) -> Drawn:
    g = request.gaussians
    call = _Call(
        library=_library(),
        camera=request.views[index].camera,
        config=request.config,
        sh_degree=request.sh_degree,
        keeps_graph=keeps_graph,
        radii=torch.empty(len(g), 2, dtype=torch.int32),
        abs_grad2d=abs_grad2d,
    )
    parts = (getattr(g, name) for name in _PARTS)
    rgb, depth, alpha, extra = _Rasterize.apply(call, request.pose(index), request.backgrounds[index], means2d, *parts)
    return Drawn(rgb, depth, alpha, None if g.extra is None else extra, call.radii)


def last_statistics() -> dict[str, float]:
    """Counts and seconds per phase of the most recent forward pass, and of the backward pass on the same context."""
    library = native.library()
    return {} if library is None or not _last_handle else _statistics(library, _last_handle)


# Only the number: holding the context itself would keep it from being reused. Contexts are freed by release_memory
# alone.
_last_handle = 0


class _Rasterize(torch.autograd.Function):
    """forward: parameters -> rgb, depth, alpha, extra. Gradients come from the library."""

    @staticmethod
    def forward(
        ctx: Any, call: _Call, world_from_cam: Tensor, background: Tensor | None, means2d: Tensor, *given: Tensor | None
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """``given``: the tensors of ``_PARTS``."""
        global _last_handle
        parts = [t.contiguous() if t is not None else None for t in given]
        height, width = call.camera.height, call.camera.width
        channels = 0 if parts[5] is None else parts[5].shape[1]
        rgb, depth, alpha = torch.empty(3, height, width), torch.empty(1, height, width), torch.empty(1, height, width)
        features = torch.empty(channels, height, width)
        scene = _scene(parts, background, world_from_cam, call)
        image = _Image(_at(rgb), _at(depth), _at(alpha), _at(features), _at(means2d), _at(call.radii))
        context = _Context(call.library)
        _last_handle = context.handle
        status = call.library.mudg_raster_forward(context.handle, ctypes.byref(scene), ctypes.byref(image))
        if status != 0:
            _raise(status, context, parts)
        ctx.set_materialize_grads(False)
        if call.keeps_graph:
            ctx.context, ctx.call = context, call
            ctx.pose_type = world_from_cam.dtype
            ctx.background_type = None if background is None else background.dtype
            ctx.save_for_backward(*parts)
        return rgb, depth, alpha, features

    @staticmethod
    @once_differentiable
    def backward(
        ctx: Any, of_rgb: Tensor | None, of_depth: Tensor | None, of_alpha: Tensor | None, of_extra: Tensor | None
    ) -> tuple[Tensor | None, ...]:
        # reading them checks for edits in place
        parts, call, needs = ctx.saved_tensors, ctx.call, ctx.needs_input_grad[4:]
        count = parts[0].shape[0]
        upstream = [None if g is None else g.contiguous() for g in (of_rgb, of_depth, of_alpha, of_extra)]
        out = [_recycled_like(t) for t in parts[:4]]
        colors = needs[4] or needs[6]  # harmonics in two tensors are written together
        asked = (colors, needs[5], colors)
        out += [
            _recycled_like(t) if t is not None and needed else None for t, needed in zip(parts[4:], asked, strict=True)
        ]
        of_means2d = torch.empty(count, 2)
        absolute = None if call.abs_grad2d is None else torch.empty(count, 2)
        gradient = _Gradient(*(_at(t) for t in (*out[:6], of_means2d, absolute, out[6])))
        image = _ImageGradient(*(_at(g) for g in upstream))
        status = call.library.mudg_raster_backward(ctx.context.handle, ctypes.byref(image), ctypes.byref(gradient))
        if status != 0:
            _raise(status, ctx.context, parts)
        if absolute is not None and call.abs_grad2d is not None:
            call.abs_grad2d.add_(absolute)
        of_background = (
            torch.tensor(list(gradient.background), dtype=ctx.background_type) if ctx.needs_input_grad[2] else None
        )
        of_pose = _pose_gradient(gradient, ctx.pose_type) if ctx.needs_input_grad[1] else None
        wanted = [g if needed else None for g, needed in zip(out, needs)]
        return (None, of_pose, of_background, of_means2d, *wanted)


def _pose_gradient(gradient: _Gradient, dtype: torch.dtype) -> Tensor:
    """d loss / d world_from_cam: its rotation is the transpose of the one the library knows, its last column the
    centre."""
    of_pose = torch.zeros(4, 4, dtype=dtype)
    of_pose[:3, :3] = torch.tensor(list(gradient.rotation), dtype=dtype).view(3, 3).T
    of_pose[:3, 3] = torch.tensor(list(gradient.center), dtype=dtype)
    return of_pose


def _scene(parts: list[Tensor | None], background: Tensor | None, world_from_cam: Tensor, call: _Call) -> _Scene:
    means, _, _, _, sh, extra, sh_rest = parts
    config, camera = call.config, call.camera
    if means is None or sh is None:
        raise InputError("means and sh are needed")
    pose = world_from_cam.detach().to("cpu", torch.float64)
    if not torch.isfinite(pose).all():
        raise NumericsError("the camera pose is not finite", where="world_from_cam")
    center = pose[:3, 3]
    high = center.float()
    low = (center - high.double()).float()
    color = [0.0] * 3 if background is None else background.detach().float().tolist()
    return _Scene(
        means.shape[0],
        camera.width,
        camera.height,
        0 if extra is None else extra.shape[1],
        sh.shape[1] + (0 if sh_rest is None else sh_rest.shape[1]),
        call.sh_degree,
        int(config.antialias),
        int(call.abs_grad2d is not None),
        config.near_m,
        config.far_m,
        config.blur_px2,
        config.alpha_max,
        camera.fx,
        camera.fy,
        camera.cx,
        camera.cy,
        (_F * 9)(*pose[:3, :3].T.flatten().tolist()),
        (_F * 3)(*high.tolist()),
        (_F * 3)(*low.tolist()),
        (_F * 3)(*color),
        *(_at(t) for t in parts),
    )


def _raise(status: int, context: _Context, parts: list[Tensor | None] | tuple[Tensor | None, ...]) -> None:
    if status == 3:
        found = _statistics(context.library, context.handle)
        row = int(found["first_not_finite"])
        bad = [n for n, t in zip(_PARTS, parts, strict=True) if t is not None and not torch.isfinite(t[row]).all()]
        what, where = "a Gaussian is not finite", f"Gaussian {row}: {', '.join(bad) or 'its colour overflows'}"
        remedy = "a loss or an optimiser step went wrong earlier; lower the learning rate or check the data"
        raise NumericsError(what, where=where, got=f"{int(found['not_finite'])} such Gaussians", remedy=remedy)
    what = {1: "the rasteriser ran out of memory", 2: "too many Gaussian-tile pairs for one image"}[status]
    raise ResourceError(what, remedy="use fewer or smaller Gaussians, or a smaller image")


def _at(tensor: Tensor | None) -> int | None:
    return None if tensor is None else tensor.data_ptr()


def _library() -> ctypes.CDLL:
    library = native.require("the CPU rasteriser")
    if library.mudg_raster_new.restype is not _P:
        library.mudg_raster_new.restype = _P
        library.mudg_raster_free.argtypes = [_P]
        library.mudg_raster_forward.argtypes = [_P, _P, _P]
        library.mudg_raster_backward.argtypes = [_P, _P, _P]
        library.mudg_raster_statistics.argtypes = [_P, _P, _P]
    return library
