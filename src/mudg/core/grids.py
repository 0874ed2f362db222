"""Learnt features of places in 3 or 4 dimensions: hash grids, and planes of place and time. The native op runs on
float32 tensors on the CPU, its twin in torch everywhere; gradients do not depend on the number of threads."""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any, Final

import torch
import torch.nn.functional as F
from torch import Tensor
from torch.autograd.function import once_differentiable

from mudg import native
from mudg.base import log
from mudg.base.errors import InputError, UsageError
from mudg.base.types import check_shape
from mudg.core.native_ops import address

# hex planes ---------------------------------------------------------------------------------------
# HexPlane (Cao and Johnson 2023), K-Planes (Fridovich-Keil et al. 2023): planes along xy, xz, yz and xt, yt, zt, of
# several sizes. The features of a place and time at one size are the product of the six bilinear values there; those of
# the sizes are joined. All numbers are one tensor: size by size, plane by plane, ``[second axis, first axis,
# features]``.


PLANES: Final = ((0, 1), (0, 2), (1, 2), (0, 3), (1, 3), (2, 3))
"""The two axes of each plane: x, y, z, t."""
TIME: Final = 3
NATIVE_FEATURES: Final = (1, 2, 4, 8, 16, 32)
NATIVE_LEVELS: Final = 16


@dataclass(frozen=True)
class PlaneSizes:
    """Sizes of the planes: ``features`` numbers per place, ``levels`` of 1, 2, 4, ... times ``space`` cells along x, y
    and z, ``time`` cells along t at every level; ``width`` of the networks."""

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
        """Axes and shape (second axis, first axis, features) of every plane, in the order in which their numbers
        lie."""
        return tuple((axes, (cells[axes[1]], cells[axes[0]], self.features)) for cells in self.cells for axes in PLANES)

    @cached_property
    def numbers(self) -> int:
        """Numbers of all planes."""
        return sum(rows * columns * features for _, (rows, columns, features) in self.shapes)

    def planes(self, numbers: Tensor) -> Iterator[tuple[tuple[int, int], Tensor]]:
        """Axes and view ``[second axis, first axis, features]`` of every plane of a tensor ``[numbers]``; one gradient
        for all."""
        parts = numbers.split([rows * columns * features for _, (rows, columns, features) in self.shapes])
        for (axes, shape), part in zip(self.shapes, parts):
            yield axes, part.view(shape)


def look_up(places: Tensor, numbers: Tensor, sizes: PlaneSizes) -> Tensor:
    """Features ``[N, features * levels]`` of places ``[N, 4]``, -1 to 1 along x, y, z, t, in planes of ``numbers
    [sizes.numbers]``. Places outside get the features of the nearest place on the border. Differentiable once, in
    planes and places. InputError: shapes do not fit."""
    check_shape(places, "planes of place and time: places", (None, 4))
    check_shape(numbers, "planes of place and time: numbers", (sizes.numbers,))
    library = native.library()
    known = sizes.features in NATIVE_FEATURES and sizes.levels <= NATIVE_LEVELS and sizes.space > 1 and sizes.time > 1
    fits = known and all(t.dtype == torch.float32 and t.device.type == "cpu" for t in (places, numbers))
    if library is None or not fits or not len(places):
        why = native.status() if library is None else f"{places.dtype} on {places.device}, {sizes.features} features"
        log.info_once(f"planes of place and time: plain torch ({why})")
        return torch_look_up(places, numbers, sizes)
    width = sizes.features * sizes.levels
    return _Native.apply(places, numbers, width, partial(_call_hex_planes, library, sizes))


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


def _call_hex_planes(library: ctypes.CDLL, sizes: PlaneSizes, *tensors: Tensor | None) -> None:
    places, numbers = tensors[:2]
    flat = [count for cells in sizes.cells for count in cells]
    library.mudg_hex_planes.restype = ctypes.c_int
    status = library.mudg_hex_planes(
        address(places),
        ctypes.c_int64(0 if places is None else len(places)),
        address(numbers),
        sizes.features,
        sizes.levels,
        (ctypes.c_int32 * len(flat))(*flat),
        *map(address, tensors[2:]),
    )
    if status == 2:
        raise MemoryError("the look-up in planes of place and time needs more memory than there is")
    if status != 0:
        raise InputError("the native library does not know such planes", got=str(sizes))


class _Native(torch.autograd.Function):
    """A look-up of points in learnt values. ``call(points, values, out, upstream, of_values, of_points)`` fills the
    features ``[N, width]``, or the gradients that are asked for."""

    @staticmethod
    def forward(ctx: Any, points: Tensor, values: Tensor, width: int, call: Callable[..., None]) -> Tensor:
        given = points.detach().contiguous(), values.detach().contiguous()
        out = torch.empty(len(points), width)
        call(*given, out, None, None, None)
        ctx.save_for_backward(*given)
        ctx.call = call
        return out

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, upstream: Tensor) -> tuple[Tensor | None, ...]:
        asked = zip(ctx.saved_tensors, ctx.needs_input_grad)
        of_points, of_values = (torch.zeros_like(one) if needed else None for one, needed in asked)
        ctx.call(*ctx.saved_tensors, None, upstream.contiguous(), of_values, of_points)
        return of_points, of_values, None, None


# hash grid ----------------------------------------------------------------------------------------
# Müller et al. 2022, "Instant neural graphics primitives": the features of a point are, level by level, those of the
# corners of its cell, blended linearly along every axis. A level that has room for all its corners stores them in
# order; a finer one shares its entries by a hash of the corner's integer coordinates.


_PRIMES = (1, 2654435761, 805459861, 3674653429)
_MASK32 = (1 << 32) - 1


@dataclass(frozen=True)
class HashGrid:
    """The shape of a grid of 3 or 4 dimensions, 1 to 32 levels, and 1, 2, 4 or 8 features per level. ``coarsest``,
    ``finest``: cells along an axis of the first and the last level; those between grow geometrically. A level has at
    most 2 to the power ``log2_entries`` entries. UsageError: other values."""

    dimensions: int
    levels: int
    features: int
    coarsest: int
    finest: int
    log2_entries: int

    def __post_init__(self) -> None:
        fits = (
            self.dimensions in (3, 4)
            and 1 <= self.levels <= 32
            and self.features in (1, 2, 4, 8)
            and 1 <= self.coarsest <= self.finest <= 65536
            and 4 <= self.log2_entries <= 30
        )
        if not fits:
            expected = "3 or 4 dimensions, 1..32 levels, 1, 2, 4 or 8 features, coarsest <= finest <= 65536, 2^4..2^30"
            raise UsageError("hash grid: sizes out of range", got=str(self), expected=f"{expected} entries")

    @cached_property
    def resolutions(self) -> tuple[int, ...]:
        """Cells along an axis, per level."""
        steps = max(1, self.levels - 1)
        growth = (self.finest / self.coarsest) ** (1 / steps)
        return tuple(int(self.coarsest * growth**level + 1e-6) for level in range(self.levels))

    @cached_property
    def hashed(self) -> tuple[bool, ...]:
        """Whether a level has fewer entries than corners."""
        return tuple((cells + 1) ** self.dimensions > 1 << self.log2_entries for cells in self.resolutions)

    @cached_property
    def entries(self) -> tuple[int, ...]:
        """Entries per level."""
        return tuple(
            1 << self.log2_entries if hashed else (cells + 1) ** self.dimensions
            for cells, hashed in zip(self.resolutions, self.hashed)
        )

    @property
    def table_shape(self) -> tuple[int, int]:
        """Shape of the table: entries of all levels, features."""
        return sum(self.entries), self.features

    @property
    def width(self) -> int:
        """Features of a point."""
        return self.levels * self.features


def encode(points: Tensor, table: Tensor, grid: HashGrid) -> Tensor:
    """Features ``[N, levels * features]`` of points ``[N, D]`` in the unit cube, from a table of ``grid.table_shape``.
    Points outside get the features of the nearest place on the border. Differentiable once, in table and points.
    InputError: shapes do not fit the grid."""
    check_shape(points, "hash grid: points", (None, grid.dimensions))
    check_shape(table, "hash grid: table", grid.table_shape)
    library = native.library()
    fits = all(t.dtype == torch.float32 and t.device.type == "cpu" for t in (points, table))
    if library is None or not fits or not len(points):
        why = native.status() if library is None else f"{points.dtype} on {points.device}"
        log.info_once(f"hash grids: plain torch ({why})")
        return torch_encode(points, table, grid)
    return _Native.apply(points, table, grid.width, partial(_call_hash_grid, library, grid))


def torch_encode(points: Tensor, table: Tensor, grid: HashGrid) -> Tensor:
    """``encode`` in plain torch."""
    inside, offset, made = points.clamp(0, 1), 0, []
    for cells, hashed, entries in zip(grid.resolutions, grid.hashed, grid.entries):
        at = inside * cells
        first = at.detach().long().clamp(max=cells - 1)
        part = at - first
        total: Tensor | float = 0.0
        for corner in range(1 << grid.dimensions):
            number, weight, stride = torch.zeros_like(first[:, 0]), torch.ones_like(part[:, 0]), 1
            for axis in range(grid.dimensions):
                upper = corner >> axis & 1
                step = first[:, axis] + upper
                weight = weight * (part[:, axis] if upper else 1 - part[:, axis])
                number = number ^ (step * _PRIMES[axis] & _MASK32) if hashed else number + step * stride
                stride *= cells + 1
            index = offset + (number & entries - 1 if hashed else number)
            total = total + weight[:, None] * table[index]
        made.append(total)
        offset += entries
    return torch.cat(made, 1)


def _call_hash_grid(library: ctypes.CDLL, grid: HashGrid, *tensors: Tensor | None) -> None:
    points, values = tensors[:2]
    levels = grid.levels
    library.mudg_hash_grid.restype = ctypes.c_int
    status = library.mudg_hash_grid(
        address(points),
        ctypes.c_int64(0 if points is None else len(points)),
        address(values),
        (ctypes.c_int * 3)(grid.dimensions, levels, grid.features),
        (ctypes.c_int32 * levels)(*grid.resolutions),
        (ctypes.c_int64 * levels)(*grid.entries),
        (ctypes.c_uint8 * levels)(*grid.hashed),
        *map(address, tensors[2:]),
    )
    if status != 0:
        raise InputError("the native library does not know such a hash grid", got=str(grid))
