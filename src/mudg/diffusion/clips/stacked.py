"""Planes of the views of a clip as one tensor each, in memory or, where they are large, in files without names."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mudg.base import scratch

if TYPE_CHECKING:
    from mudg.diffusion.clips.condition import WarpSource

LARGE_PIXELS = 2_500_000
"""Planes of more pixels lie in files where there is a folder for them."""


class KeptImages(dict[int, "WarpSource"]):
    """Recorded images that were prepared for warping, by their numbers.

    Args:
        folder: where large conditions are kept while they are used, in files without names; None: in memory.
    """

    def __init__(self, folder: Path | None = None) -> None:
        super().__init__()
        self.folder = folder


def stacked(rows: Iterable[Sequence[Tensor]], count: int, folder: Path | None) -> list[Tensor]:
    """``torch.stack`` of every column of ``count`` rows, of which only one is in memory besides.

    Args:
        rows: planes ``[..., H, W]`` of one view each. folder: where large ones are put into files; None: all stay in
            memory.
    """
    stacks: list[Tensor] = []
    for number, row in enumerate(rows):
        stacks = stacks or [_empty((count, *x.shape), x.dtype, folder) for x in row]
        for stack, x in zip(stacks, row, strict=True):
            stack[number] = x
        scratch.rest_mapped()
    return stacks


def _empty(shape: tuple[int, ...], dtype: torch.dtype, folder: Path | None) -> Tensor:
    if folder is None or shape[-2] * shape[-1] <= LARGE_PIXELS:
        return torch.empty(shape, dtype=dtype)
    return torch.from_numpy(scratch.mapped_array(folder, shape, torch.empty(0, dtype=dtype).numpy().dtype))
