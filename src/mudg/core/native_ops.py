"""Training steps that touch much memory, done in one native pass; in plain torch, which is named once, where the native
library is missing or the tensors are not float32 on the CPU. Differentiable once; values do not depend on the number of
threads."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable
from torch.nn import functional

from mudg import native
from mudg.base import log
from mudg.base.errors import InputError, ResourceError, UsageError
from mudg.base.palette import UNLABELLED
from mudg.base.types import check_shape
from mudg.core import losses

BETA1, BETA2, EPSILON = 0.9, 0.999, 1e-15


def photometric(prediction: Tensor, target: Tensor, ssim_weight: float = 0.2, weight: Tensor | None = None) -> Tensor:
    """Scalar ``(1 - w) mean|p - t| + w (1 - mean SSIM)`` of images ``[C, H, W]`` in [0, 1]; with a weight ``[H, W]``
    for every pixel the mean over all of them of weight times ``(1 - w) |p - t| + w (1 - SSIM)``.

    Differentiable in the prediction; target and weight are data. SSIM as in ``losses.ssim_map``. InputError: shapes
    differ or are not [C, H, W]. UsageError: the weight of SSIM is outside [0, 1].
    """
    check_shape(prediction, "photometric: prediction", (None, None, None))
    check_shape(target, "photometric: target", tuple(prediction.shape))
    if not 0 <= ssim_weight <= 1:
        raise UsageError("the weight of SSIM must lie in [0, 1]", got=str(ssim_weight))
    if weight is not None:
        check_shape(weight, "photometric: weight", tuple(prediction.shape[1:]))
        weight = weight.detach().to(prediction.dtype).contiguous()
    library = _library_for((prediction, target))
    if library is None or prediction.numel() == 0:
        both = (1 - ssim_weight) * (prediction - target).abs()
        both = both + ssim_weight * (1 - losses.ssim_map(prediction, target))
        return both.mean() if weight is None else losses.confident_mean(both, weight)
    image, wanted = prediction.detach().contiguous(), target.detach().contiguous()
    gradient, status = torch.empty_like(image), ctypes.c_int(0)
    library.mudg_photometric.restype = ctypes.c_double
    value = library.mudg_photometric(
        *map(address, (image, wanted, weight)),
        *map(ctypes.c_int, image.shape),
        ctypes.c_float(ssim_weight),
        address(gradient),
        ctypes.byref(status),
    )
    if status.value != 0:
        raise ResourceError("not enough memory for the photometric loss", where=f"image {tuple(image.shape)}")
    return _WithGradient.apply(prediction, value, gradient)


def class_loss(
    logits: Tensor, target: Tensor, weight: Tensor, total: float | Tensor, lift: tuple[int, Tensor] | None = None
) -> Tensor:
    """Scalar: cross entropy of the logits ``[C, H, W]`` of every pixel, times its weight ``[H, W]``, summed and divided
    by ``total``, a positive number or scalar tensor. InputError: sizes differ, or there is no channel.

    Differentiable in the logits; everything else is data. Of ``target`` i64[H, W], what is not in 0..C-1 is unlabelled
    and counts nothing. ``lift``: a channel, and ``[H, W]`` to add to its logits.
    """
    check_shape(logits, "class loss: logits", (None, None, None))
    planes = {"target": target, "weight": weight, "lift": weight if lift is None else lift[1]}
    for name, plane in planes.items():
        check_shape(plane, f"class loss: {name}", tuple(logits.shape[1:]))
    if not 0 <= (0 if lift is None else lift[0]) < len(logits):
        raise InputError("class loss: there is no such channel to lift", got=f"{lift} of {len(logits)} channels"[:80])
    library = _library_for((logits, weight))
    if library is None or logits.numel() == 0 or target.dtype != torch.int64:
        if lift is not None:
            # filled there: a list would be copied, and waited for
            raised = torch.full((1,), lift[0], device=logits.device)
            logits = logits.index_add(0, raised, lift[1].detach()[None].to(logits.dtype))
        labelled = torch.where((target >= 0) & (target < len(logits)), target, UNLABELLED)[None]
        errors = functional.cross_entropy(logits[None], labelled, ignore_index=UNLABELLED, reduction="none")[0]
        return (errors * weight).sum() / (total.to(weight.dtype) if isinstance(total, Tensor) else total)
    channel, added = (-1, None) if lift is None else (lift[0], lift[1].detach().to(torch.float32).contiguous())
    values, ids, weight = logits.detach().contiguous(), target.contiguous(), weight.detach().contiguous()
    gradient, status = torch.empty_like(values), ctypes.c_int(0)
    library.mudg_class_loss.restype = ctypes.c_double
    value = library.mudg_class_loss(
        *map(address, (values, ids, weight, added)),
        ctypes.c_int(channel),
        ctypes.c_int(len(values)),
        ctypes.c_int64(ids.numel()),
        ctypes.c_float(1.0 / float(total)),
        address(gradient),
        ctypes.byref(status),
    )
    if status.value != 0:
        raise ResourceError("not enough memory for the class loss", where=f"logits {tuple(values.shape)}")
    return _WithGradient.apply(logits, value, gradient)


def over(rgb: Tensor, alpha: Tensor, coarse: Tensor) -> Tensor:
    """``rgb + (1 - alpha) * coarse``, with the coarse picture ``[C, h, w]`` enlarged to the size of ``rgb [C, H, W]``
    (bilinear between pixel centres); ``alpha`` is ``[1, H, W]``. Differentiable in all three. InputError: shapes do not
    fit."""
    check_shape(rgb, "over: rgb", (None, None, None))
    check_shape(coarse, "over: coarse", (len(rgb), None, None))
    check_shape(alpha, "over: alpha", (1, *rgb.shape[1:]))
    library = _library_for((rgb, alpha, coarse))
    if library is None or rgb.numel() == 0 or coarse.numel() == 0:
        size = (rgb.shape[1], rgb.shape[2])
        enlarged = functional.interpolate(coarse[None], size=size, mode="bilinear", align_corners=False)[0]
        return rgb + (1 - alpha) * enlarged
    return _Over.apply(rgb, alpha, coarse, library)


def box_mean(values: Tensor, size: int) -> Tensor:
    """Means over ``size`` x ``size`` pixels (odd), of the same shape ``[..., H, W]``; at the borders, over what is
    there. UsageError: an even size."""
    if size < 1 or size % 2 == 0:
        raise UsageError("the side of a box of pixels must be odd", got=str(size))
    library = _library_for((values,))
    if library is None or values.numel() == 0:
        planes = values.reshape(1, -1, *values.shape[-2:])
        found = functional.avg_pool2d(planes, size, stride=1, padding=size // 2, count_include_pad=False)
        return found.reshape(values.shape)
    return _BoxMean.apply(values, size // 2, library)


@dataclass(frozen=True, slots=True, eq=False)
class AdamColumn:
    """One column of a step of Adam: four tensors of one shape [N, ...] (all but ``gradient`` are updated) and the
    learning rate."""

    parameter: Tensor
    gradient: Tensor
    moment1: Tensor
    moment2: Tensor
    rate: float

    def step_in_torch(self, step: int, rows: Tensor | None) -> None:
        """``adam_columns`` of this one in plain torch."""
        whole = (self.parameter, self.moment1, self.moment2)
        parameter, moment1, moment2 = whole if rows is None else (values.clone() for values in whole)
        moment1.mul_(BETA1).add_(self.gradient, alpha=1 - BETA1)
        moment2.mul_(BETA2).addcmul_(self.gradient, self.gradient, value=1 - BETA2)
        denominator = (moment2 / (1 - BETA2**step)).sqrt_().add_(EPSILON)
        parameter.addcdiv_(moment1, denominator, value=-self.rate / (1 - BETA1**step))
        if rows is not None:
            # chosen by a mask: counting rows would wait for the device
            chosen = rows.view(-1, *[1] * (self.gradient.ndim - 1))
            for values, updated in zip(whole, (parameter, moment1, moment2)):
                values.copy_(torch.where(chosen, updated, values))


def adam_columns(columns: Sequence[AdamColumn], step: int, chosen: Tensor | None = None) -> None:
    """One step of Adam (Kingma & Ba 2015) in place on columns with the same N rows: betas 0.9 and 0.999, epsilon 1e-15,
    bias-corrected for ``step`` (from 1). ``chosen`` bool[N]: only these rows move, parameters and moments. InputError:
    shapes differ, or ``chosen`` is not bool[N]. UsageError: ``step`` below 1."""
    if step < 1:
        raise UsageError("Adam steps count from 1", got=str(step))
    if not columns:
        return
    rows = len(columns[0].parameter)
    for one in columns:
        shape = tuple(one.parameter.shape)
        check_shape(one.parameter, "adam: parameter", (rows, *shape[1:]))
        for name in ("gradient", "moment1", "moment2"):
            check_shape(getattr(one, name), f"adam: {name}", shape)
    if chosen is not None and (chosen.shape != (rows,) or chosen.dtype != torch.bool):
        got = f"{chosen.dtype} {tuple(chosen.shape)}"
        raise InputError("adam: the chosen rows do not fit", expected=f"bool [{rows}]", got=got)
    in_place = tuple(t for one in columns for t in (one.parameter, one.moment1, one.moment2))
    library = _library_for((*in_place, *(one.gradient for one in columns)))
    if library is None or not all(t.is_contiguous() for t in in_place):
        with torch.no_grad():
            for one in columns:
                one.step_in_torch(step, chosen)
        return
    gradients = [one.gradient.detach().contiguous() for one in columns]
    table = (_Column * len(columns))()
    for entry, one, gradient in zip(table, columns, gradients, strict=True):
        entry.parameter, entry.gradient = one.parameter.data_ptr(), gradient.data_ptr()
        entry.moment1, entry.moment2 = one.moment1.data_ptr(), one.moment2.data_ptr()
        entry.width, entry.rate = one.parameter.numel() // rows if rows else 0, one.rate
    mask = None if chosen is None else chosen.contiguous()
    count, numbers = ctypes.c_int(len(columns)), map(ctypes.c_double, (BETA1, BETA2, EPSILON))
    library.mudg_adam(table, count, ctypes.c_int64(rows), address(mask), *numbers, ctypes.c_int64(step))
    # The library wrote behind autograd's back: tell it, so that a graph that still needs the old values is refused.
    torch.autograd.graph.increment_version(in_place)


class _Column(ctypes.Structure):
    """Mirror of AdamColumn in native/kernels.h."""

    _fields_ = [
        *((name, ctypes.c_void_p) for name in ("parameter", "gradient", "moment1", "moment2")),
        ("width", ctypes.c_int64),
        ("rate", ctypes.c_double),
        ("step_size", ctypes.c_float),
    ]


class _WithGradient(torch.autograd.Function):
    """A scalar whose gradient was worked out along with its value."""

    @staticmethod
    def forward(ctx: Any, variable: Tensor, value: float, gradient: Tensor) -> Tensor:
        ctx.save_for_backward(gradient)
        return variable.new_tensor(value)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, upstream: Tensor) -> tuple[Tensor | None, ...]:
        (gradient,) = ctx.saved_tensors
        # The usual case, a loss term whose weight is in the value already, needs no copy.
        return gradient if upstream.item() == 1.0 else gradient * upstream, None, None


class _Over(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, rgb: Tensor, alpha: Tensor, coarse: Tensor, library: ctypes.CDLL) -> Tensor:
        picture, cover, small = (t.detach().contiguous() for t in (rgb, alpha, coarse))
        out = torch.empty_like(picture)
        ctx.library, ctx.sizes = library, (ctypes.c_int * 5)(*picture.shape, *small.shape[1:])
        _call_over(ctx, (picture, cover, small), (out, None, None, None))
        ctx.save_for_backward(cover, small)
        return out

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, upstream: Tensor) -> tuple[Tensor | None, ...]:
        cover, small = ctx.saved_tensors
        of_alpha, of_coarse, gradient = torch.empty_like(cover), torch.empty_like(small), upstream.contiguous()
        _call_over(ctx, (None, cover, small), (None, gradient, of_alpha, of_coarse))
        return upstream, of_alpha, of_coarse, None


def _call_over(ctx: Any, given: tuple[Tensor | None, ...], rest: tuple[Tensor | None, ...]) -> None:
    if ctx.library.mudg_over(*map(address, given), ctx.sizes, *map(address, rest)) != 0:
        raise ResourceError("not enough memory to put a picture over the sky")


class _BoxMean(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, values: Tensor, radius: int, library: ctypes.CDLL) -> Tensor:
        ctx.radius, ctx.library = radius, library
        return _boxes(values.detach(), radius, False, library)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, upstream: Tensor) -> tuple[Tensor | None, ...]:
        return _boxes(upstream, ctx.radius, True, ctx.library), None, None


def _boxes(values: Tensor, radius: int, transposed: bool, library: ctypes.CDLL) -> Tensor:
    values = values.contiguous()
    out, (height, width) = torch.empty_like(values), values.shape[-2:]
    sizes = map(ctypes.c_int, (values.numel() // (height * width), height, width, radius, transposed))
    if library.mudg_box_mean(address(values), *sizes, address(out)) != 0:
        raise ResourceError("not enough memory for means over boxes of pixels")
    return out


def address(tensor: Tensor | None) -> ctypes.c_void_p:
    """Address of a contiguous tensor's first element, for the native library."""
    return ctypes.c_void_p(None if tensor is None else tensor.data_ptr())


def _library_for(tensors: tuple[Tensor, ...]) -> ctypes.CDLL | None:
    """The library where it can work on these tensors; says once why not."""
    library = native.library()
    if library is None:
        log.info_once(f"losses and Adam: plain torch, slower ({native.status()})")
        return None
    fits = all(t.dtype == torch.float32 and t.device.type == "cpu" for t in tensors)
    if not fits:
        log.info_once(f"losses and Adam: plain torch for {tensors[0].dtype} on {tensors[0].device}")
    return library if fits else None
