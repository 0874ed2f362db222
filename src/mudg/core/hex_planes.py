"""Six planes of several sizes (HexPlane, Cao and Johnson 2023; K-Planes, Fridovich-Keil et al. 2023): learnt features of places and times.

The planes lie along xy, xz, yz and xt, yt, zt. The features of a place and time at one size are the product of the six bilinear values
there; those of the sizes are joined. All numbers are one tensor: size by size, plane by plane, ``[second axis, first axis, features]``.

The native op runs on float32 tensors on the CPU; ``torch_look_up`` is the specification and runs everywhere. Gradients reach the planes
and, where they are asked for, the places. They do not depend on the number of threads.
"""

from __future__ import annotations

import ctypes
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Final

import torch
import torch.nn.functional as F
from torch import Tensor
from torch.autograd.function import once_differentiable

from mudg import native
from mudg.base import log
from mudg.base.errors import InputError

PLANES: Final = ((0, 1), (0, 2), (1, 2), (0, 3), (1, 3), (2, 3))
"""The two axes of each plane: x, y, z, t."""
TIME: Final = 3
NATIVE_FEATURES: Final = (1, 2, 4, 8, 16, 32)
NATIVE_LEVELS: Final = 16


@dataclass(frozen=True)
class PlaneSizes:
    """Sizes of the planes: ``features`` numbers per place, ``levels`` of 1, 2, 4, ... times ``space`` cells along x, y and z, ``time``
    cells along t at every level; ``width`` of the networks."""

    features: int
    levels: int
    space: int
    time: int
    width: int

    @cached_property
    def cells(self) -> tuple[tuple[int, int, int, int], ...]:
        """Numbers along x, y, z and t, per level."""
        return tuple((*(self.space * 2**level,) * 3, self.time) for level in range(self.levels))

    @cached_property
    def shapes(self) -> tuple[tuple[tuple[int, int], tuple[int, int, int]], ...]:
        """Axes and shape (second axis, first axis, features) of every plane, in the order in which their numbers lie."""
        return tuple(
            (axes, (cells[axes[1]], cells[axes[0]], self.features)) for cells in self.cells for axes in PLANES
        )

    @cached_property
    def numbers(self) -> int:
        """Numbers of all planes."""
        return sum(rows * columns * features for _, (rows, columns, features) in self.shapes)

    def planes(self, numbers: Tensor) -> Iterator[tuple[tuple[int, int], Tensor]]:
        """Axes and view ``[second axis, first axis, features]`` of every plane of a tensor ``[numbers]``; one gradient for all."""
        parts = numbers.split([rows * columns * features for _, (rows, columns, features) in self.shapes])
        for (axes, shape), part in zip(self.shapes, parts):
            yield axes, part.view(shape)


def look_up(places: Tensor, numbers: Tensor, sizes: PlaneSizes) -> Tensor:
    """Features ``[N, features * levels]`` of places ``[N, 4]``, -1 to 1 along x, y, z, t.

    Places outside get the features of the nearest place on the border. Differentiable once, in planes and places.

    Args:
        places: ``[N, 4]``.
        numbers: ``[sizes.numbers]``.

    Raises:
        InputError: shapes do not fit.
    """
    if places.ndim != 2 or places.shape[1] != 4 or tuple(numbers.shape) != (sizes.numbers,):
        raise InputError("planes of place and time: shapes do not fit", expected=f"places [N, 4], planes ({sizes.numbers},)",
                         got=f"{tuple(places.shape)}, {tuple(numbers.shape)}")  # fmt: skip
    library = native.library()
    known = sizes.features in NATIVE_FEATURES and sizes.levels <= NATIVE_LEVELS and sizes.space > 1 and sizes.time > 1
    fits = known and all(t.dtype == torch.float32 and t.device.type == "cpu" for t in (places, numbers))
    if library is None or not fits or not len(places):
        why = native.status() if library is None else f"{places.dtype} on {places.device}, {sizes.features} features"
        log.info_once(f"planes of place and time: plain torch ({why})")
        return torch_look_up(places, numbers, sizes)
    return _LookUp.apply(places, numbers, sizes, library)


def torch_look_up(places: Tensor, numbers: Tensor, sizes: PlaneSizes) -> Tensor:
    """``look_up`` in plain torch."""
    levels: list[Tensor] = []
    for index, (axes, plane) in enumerate(sizes.planes(numbers)):
        at = places[None, None, :, list(axes)]
        image = plane.permute(2, 0, 1)[None]
        value = F.grid_sample(image, at, mode="bilinear", padding_mode="border", align_corners=True)[0, :, 0].T
        if index % len(PLANES):
            levels[-1] = levels[-1] * value
        else:
            levels.append(value)
    return torch.cat(levels, 1)


class _LookUp(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, places: Tensor, numbers: Tensor, sizes: PlaneSizes, library: ctypes.CDLL) -> Tensor:
        given = places.detach().contiguous(), numbers.detach().contiguous()
        out = torch.empty(len(places), sizes.features * sizes.levels)
        _call(library, sizes, given, (out, None, None, None))
        ctx.save_for_backward(*given)
        ctx.sizes, ctx.library = sizes, library
        return out

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, upstream: Tensor) -> tuple[Tensor | None, ...]:
        places, numbers = ctx.saved_tensors
        of_places = torch.zeros_like(places) if ctx.needs_input_grad[0] else None
        of_numbers = torch.zeros_like(numbers) if ctx.needs_input_grad[1] else None
        _call(ctx.library, ctx.sizes, (places, numbers), (None, upstream.contiguous(), of_numbers, of_places))
        return of_places, of_numbers, None, None


def _call(
    library: ctypes.CDLL, sizes: PlaneSizes, given: tuple[Tensor, Tensor], rest: tuple[Tensor | None, ...]
) -> None:
    places, numbers = given
    flat = [count for cells in sizes.cells for count in cells]
    library.mudg_hex_planes.restype = ctypes.c_int
    status = library.mudg_hex_planes(
        _address(places), ctypes.c_int64(len(places)), _address(numbers), sizes.features, sizes.levels,
        (ctypes.c_int32 * len(flat))(*flat), *map(_address, rest),
    )  # fmt: skip
    if status == 2:
        raise MemoryError("the look-up in planes of place and time needs more memory than there is")
    if status != 0:
        raise InputError("the native library does not know such planes", got=str(sizes))


def _address(tensor: Tensor | None) -> ctypes.c_void_p:
    return ctypes.c_void_p(None if tensor is None else tensor.data_ptr())
