"""Backend "cpu": the native rasteriser as a torch autograd function. float32 on the CPU.

A context of the library keeps the forward pass's working memory until the backward pass is over (or the graph is
dropped), and is then used again. Images do not depend on the number of threads."""

from __future__ import annotations

import ctypes
import weakref
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, ClassVar, Final

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from mudg import native
from mudg.base import memory
from mudg.base.errors import InputError, NumericsError, ResourceError
from mudg.base.types import Camera, Gaussians, RasterTrace, Render

if TYPE_CHECKING:
    from mudg.core.raster.rasterize import RasterConfig

_F, _I, _P = ctypes.c_float, ctypes.c_int32, ctypes.c_void_p
_RECYCLE_FROM_BYTES: Final = 8 << 20
PHASES: Final = ("project", "sort", "bin", "blend", "blend_backward", "project_backward")


# Mirrors of the structs in native/raster_types.h.
class _Scene(ctypes.Structure):
    _fields_ = [
        *((name, _I) for name in ("count", "width", "height", "extra_channels", "sh_coefficients")),
        *((name, _I) for name in ("antialias", "want_abs_gradient")),
        *((name, _F) for name in ("near_m", "blur_px2", "alpha_max", "fx", "fy", "cx", "cy")),
        ("rotation", _F * 9),
        ("center_high", _F * 3),
        ("center_low", _F * 3),
        *((name, _P) for name in ("means", "quats", "scales", "opacities", "sh", "extra", "sh_rest")),
    ]


class _Image(ctypes.Structure):
    _fields_ = [(name, _P) for name in ("rgb", "depth", "alpha", "extra", "means2d", "radii")]


class _ImageGradient(ctypes.Structure):
    _fields_ = [(name, _P) for name in ("rgb", "depth", "alpha", "extra")]


class _Gradient(ctypes.Structure):
    _fields_ = [
        *((name, _P) for name in ("means", "quats", "scales", "opacities", "sh", "extra")),
        *((name, _P) for name in ("means2d", "abs_means2d", "sh_rest")),
        ("rotation", _F * 9),
        ("center", _F * 3),
    ]


class _Context:
    """A native context; it goes back to the free list when the last reference is dropped."""

    free: ClassVar[list[int]] = []

    def __init__(self, library: ctypes.CDLL) -> None:
        self.library = library
        try:
            self.handle = _Context.free.pop()
        except IndexError:
            self.handle = library.mudg_raster_new()
        if not self.handle:
            raise ResourceError("not enough memory for the rasteriser")
        weakref.finalize(self, _Context.free.append, self.handle)


def _statistics(library: ctypes.CDLL, handle: int) -> dict[str, float]:
    counts, phases = (ctypes.c_int64 * 6)(), (ctypes.c_double * 6)()
    library.mudg_raster_statistics(handle, counts, phases)
    names = ("visible", "entries", "not_finite", "first_not_finite", "context_bytes", "pairs", *PHASES)
    return {name: float(value) for name, value in zip(names, (*counts, *phases), strict=True)}


_free_blocks: Final[list[Tensor]] = []
"""Memory of earlier gradients that no tensor looks at any more."""


def _recycled_like(tensor: Tensor) -> Tensor:
    """``torch.empty_like``, from memory of an earlier gradient where there is some.

    The allocator gives blocks of this size back to the system, and every page of a fresh one costs a fault: at 200,000
    Gaussians that was a tenth of a training step.
    """
    count = tensor.numel()
    if count * tensor.element_size() < _RECYCLE_FROM_BYTES:
        return torch.empty_like(tensor)
    fitting = [i for i, block in enumerate(_free_blocks) if count <= block.numel() <= 1.5 * count]
    if fitting:
        block = _free_blocks.pop(fitting[0])
    else:
        _free_blocks.clear()  # blocks of a size that is no longer asked for
        block = torch.empty(count + count // 8)
    memory = (_F * count).from_address(block.data_ptr())
    weakref.finalize(memory, _free_blocks.append, block)  # the tensor keeps `memory` alive, and that the block
    return torch.frombuffer(memory, dtype=torch.float32).view(tensor.shape)


def release_memory() -> None:
    """Free the working memory that is not in use, contexts of the library and memory kept for gradients, and hand all
    that is free to the system: for work that follows and renders nothing for a while, here or in other processes."""
    global _last_handle
    _last_handle = 0
    _free_blocks.clear()
    library = native.library()
    while library is not None and _Context.free:
        library.mudg_raster_free(_Context.free.pop())
    memory.give_back()


PARTS: Final = ("means", "quats", "scales", "opacity", "sh", "extra", "sh_rest")
"""Fields of Gaussians in the order of the library's structures."""


def render(g: Gaussians, camera: Camera, world_from_cam: Tensor, config: RasterConfig, absgrad: bool) -> Render:
    """Draw with the native kernel. See ``core.raster.rasterize``."""
    library = native.require("the CPU rasteriser")
    library.mudg_raster_new.restype = _P
    library.mudg_raster_free.argtypes = [_P]
    for name in ("forward", "backward", "statistics"):
        getattr(library, f"mudg_raster_{name}").argtypes = [_P, _P, _P]
    if g.means.dtype != torch.float32 or g.means.device.type != "cpu":
        what, got = "the native rasteriser works on float32 CPU tensors", f"{g.means.dtype} on {g.means.device}"
        raise InputError(what, where="gaussians.means", expected="torch.float32 on cpu", got=got)
    parts = [None if (part := getattr(g, name)) is None else part.contiguous() for name in PARTS]
    keeps_graph = torch.is_grad_enabled() and any(t is not None and t.requires_grad for t in (*parts, world_from_cam))
    means2d = torch.zeros(len(g), 2, requires_grad=keeps_graph)
    absolute = torch.zeros_like(means2d) if absgrad and keeps_graph else None
    radii = torch.empty(len(g), 2, dtype=torch.int32)
    scene = _scene(parts, world_from_cam, camera, config, absolute is not None)
    call = (library, scene, radii, absolute, keeps_graph)
    rgb, depth, alpha, extra = _Rasterize.apply(call, world_from_cam, means2d, *parts)
    trace = RasterTrace(means2d, radii, radii[:, 0] > 0, absolute)
    return Render(rgb, depth, alpha, None if g.extra is None else extra, trace)


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
        ctx: Any, call: tuple[Any, ...], world_from_cam: Tensor, means2d: Tensor, *parts: Tensor | None
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """``parts``: the tensors of ``PARTS``. ``call``: library, scene, radii, absolute gradients or None, and whether
        a graph is kept."""
        global _last_handle
        library, scene, radii, absolute, keeps_graph = call
        shape = (scene.height, scene.width)
        rgb, depth, alpha, extra = (torch.empty(count, *shape) for count in (3, 1, 1, scene.extra_channels))
        image = _Image(*map(_at, (rgb, depth, alpha, extra, means2d, radii)))
        context = _Context(library)
        _last_handle = context.handle
        _check(library.mudg_raster_forward(context.handle, ctypes.byref(scene), ctypes.byref(image)), context, parts)
        ctx.set_materialize_grads(False)
        if keeps_graph:
            ctx.context, ctx.absolute, ctx.pose_type = context, absolute, world_from_cam.dtype
            ctx.save_for_backward(*parts)
        return rgb, depth, alpha, extra

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *upstream: Tensor | None) -> tuple[Tensor | None, ...]:
        parts, needs = ctx.saved_tensors, ctx.needs_input_grad[3:]  # reading them checks for edits in place
        given = [None if g is None else g.contiguous() for g in upstream]
        colors = needs[4] or needs[6]  # harmonics in two tensors are written together
        asked = (True, True, True, True, colors, needs[5], colors)
        out = [_recycled_like(t) if t is not None and needed else None for t, needed in zip(parts, asked, strict=True)]
        of_means2d = torch.empty(len(parts[0]), 2)
        absolute = None if ctx.absolute is None else torch.empty_like(of_means2d)
        gradient = _Gradient(*map(_at, (*out[:6], of_means2d, absolute, out[6])))
        image, context = _ImageGradient(*map(_at, given)), ctx.context
        backward = context.library.mudg_raster_backward
        _check(backward(context.handle, ctypes.byref(image), ctypes.byref(gradient)), context, parts)
        if absolute is not None and ctx.absolute is not None:
            ctx.absolute.add_(absolute)
        of_pose = None
        if ctx.needs_input_grad[1]:  # the library knows the transposed rotation, and the centre
            of_pose = torch.zeros(4, 4, dtype=ctx.pose_type)
            of_pose[:3, :3] = torch.tensor(list(gradient.rotation), dtype=ctx.pose_type).view(3, 3).T
            of_pose[:3, 3] = torch.tensor(list(gradient.center), dtype=ctx.pose_type)
        wanted = [g if needed else None for g, needed in zip(out, needs)]
        return (None, of_pose, of_means2d, *wanted)


def _scene(
    parts: list[Tensor | None], world_from_cam: Tensor, camera: Camera, config: RasterConfig, absolute: bool
) -> _Scene:
    means, _, _, _, sh, extra, sh_rest = parts
    if means is None or sh is None:
        raise InputError("means and sh are needed")
    pose = world_from_cam.detach().to("cpu", torch.float64)
    if not torch.isfinite(pose).all():
        raise NumericsError("the camera pose is not finite", where="world_from_cam")
    center = pose[:3, 3]
    high = center.float()
    low = (center - high.double()).float()
    coefficients = sh.shape[1] + (0 if sh_rest is None else sh_rest.shape[1])
    counts = (len(means), camera.width, camera.height, 0 if extra is None else extra.shape[1], coefficients)
    settings = (int(config.antialias), int(absolute), config.near_m, config.blur_px2, config.alpha_max)
    rotation = (_F * 9)(*pose[:3, :3].T.flatten().tolist())
    place = (rotation, (_F * 3)(*high.tolist()), (_F * 3)(*low.tolist()))
    return _Scene(*counts, *settings, *camera.intrinsics, *place, *map(_at, parts))


def _check(status: int, context: _Context, parts: Sequence[Tensor | None]) -> None:
    if status == 0:
        return
    if status == 3:
        found = _statistics(context.library, context.handle)
        row = int(found["first_not_finite"])
        bad = [n for n, t in zip(PARTS, parts, strict=True) if t is not None and not torch.isfinite(t[row]).all()]
        what, where = "a Gaussian is not finite", f"Gaussian {row}: {', '.join(bad) or 'its colour overflows'}"
        remedy = "a loss or an optimiser step went wrong earlier; lower the learning rate or check the data"
        raise NumericsError(what, where=where, got=f"{int(found['not_finite'])} such Gaussians", remedy=remedy)
    what = {1: "the rasteriser ran out of memory", 2: "too many Gaussian-tile pairs for one image"}[status]
    raise ResourceError(what, remedy="use fewer or smaller Gaussians, or a smaller image")


def _at(tensor: Tensor | None) -> int | None:
    return None if tensor is None else tensor.data_ptr()
