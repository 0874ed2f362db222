"""Where the views of a fit lie: small sets in memory, large ones in a scratch file, read ahead of the steps that need them.

Decoded views of a long log at full size need more memory than the fit itself: 1,000 of 1600 x 1066 pixels 8 to 11 GiB, 1,000 virtual
ones with dense depth 18. Above ``IN_MEMORY_BYTES`` they go to a file without a name in the folder of the fit, plane by plane as they
are (masks in bits), so that a view costs one read and no decoding, and what a step gets is the same to the bit. The system keeps as
much of the file in memory as it can spare. Which views a step gets is a function of the step, so threads read those of the next steps
beforehand.
"""

from __future__ import annotations

import contextlib
import math
import shutil
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, overload

import numpy as np
import torch
from numpy.typing import NDArray

from mudg.base import log
from mudg.base.errors import ResourceError
from mudg.base.processes import GIB, computed_ahead
from mudg.base.scratch import ScratchFile
from mudg.base.types import Frame
from mudg.data.observations import ObservationSet
from mudg.stages.fitting.views import (
    CPU,
    FiledViews,
    LidarPixels,
    LoadedViews,
    StoredView,
    TrainView,
    ViewHead,
    ViewSet,
    resized_view,
)

IN_MEMORY_BYTES = GIB
"""Decoded views of up to this size stay in memory."""
AHEAD_THREADS = 2
"""Threads that read the views of later steps; each has two steps waiting."""
LIDAR_SHARE = 0.05
"""Assumed share of pixels with LiDAR, for the size of views that are not read yet."""
_PLANES = ("depth", "rgb", "channels", "confidence", "sky", "mask")
"""Depth first, so that it lies at a multiple of its element's size."""


# ---- how much there is -----------------------------------------------------------------------------------------------


def recorded_bytes(frames: Sequence[Frame], width_px: int) -> int:
    """Bytes that the frames need when they are decoded, about."""
    total = 0.0
    for frame in frames:
        camera = resized_view(frame.view, width_px).camera
        has = frame.labels
        planes = (
            3
            + ("semantics" in has)
            + ("sky" in has or "semantics" in has)
            + ("ego" in has)
            + ("semantics_confidence" in has)
        )
        total += camera.width * camera.height * (planes + 12 * LIDAR_SHARE)
    return int(total)


def virtual_bytes(sets: Mapping[str, ObservationSet]) -> int:
    """Bytes that these observations need when they are decoded, about."""
    total = 0.0
    for found in sets.values():
        for view, depth, semantics in zip(found.views, found.has_depth, found.has_semantics):
            total += view.camera.width * view.camera.height * (5 + 4 * depth + 2 * semantics + 12 * LIDAR_SHARE)
    return int(total)


def scratch_folder(count: int, needed: int, folder: Path) -> Path | None:
    """Where ``count`` views of ``needed`` bytes are to be kept: in a file in this folder, or None: in memory. Says which.

    Raises:
        ResourceError: the disk has less room than the file needs.
    """
    if needed <= IN_MEMORY_BYTES:
        return None
    free = shutil.disk_usage(folder).free
    if free < needed:
        raise ResourceError("the disk has too little room for the decoded views", where=str(folder),
            expected=f"{needed / GIB:.1f} GiB free for {count} views while the fit runs", got=f"{free / GIB:.1f} GiB",
            remedy="free disk space, choose --out on another disk, or lower --width-px")  # fmt: skip
    log.info(
        f"views: {count}, {needed / GIB:.1f} GiB decoded: kept in a scratch file in {folder}, gone when the fit ends"
    )
    return folder


# ---- a file of views -------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Slot:
    """Where a view lies: its head, the first byte, its planes (name, type, shape) in order, the number of LiDAR pixels (None: none)."""

    head: ViewHead
    begins: int
    size: int
    planes: tuple[tuple[str, np.dtype[Any], tuple[int, ...]], ...]
    lidar: int | None


class ViewFile(FiledViews):
    """Views in a scratch file. Filled once; then any thread may read."""

    def __init__(self, folder: Path, count: int) -> None:
        self._file = ScratchFile(folder)
        self._slots: list[_Slot | None] = [None] * count

    def put(self, index: int, stored: StoredView) -> None:
        """Write a view to its place."""
        planes = [(name, array) for name in _PLANES if (array := getattr(stored, name)) is not None]
        parts: list[NDArray[Any]] = []
        if stored.lidar is not None:
            parts += [stored.lidar.depth_m.numpy(), stored.lidar.pixel.numpy().astype(np.int32)]
        parts += [np.packbits(array) if array.dtype == bool else array for _, array in planes]
        content = np.concatenate([np.ascontiguousarray(part).reshape(-1).view(np.uint8) for part in parts])
        lidar = None if stored.lidar is None else len(stored.lidar.pixel)
        forms = tuple((name, array.dtype, array.shape) for name, array in planes)
        self._slots[index] = _Slot(stored.head, self._file.append(content), len(content), forms, lidar)

    def _slot(self, index: int) -> _Slot:
        found = self._slots[index]
        if found is None:
            raise IndexError(f"view {index} was never written")
        return found

    @property
    def heads(self) -> Sequence[ViewHead]:  # type: ignore[override]
        """All views without their pixels."""
        return [self._slot(index).head for index in range(len(self))]

    def __len__(self) -> int:
        return len(self._slots)

    @overload
    def __getitem__(self, index: int) -> StoredView: ...
    @overload
    def __getitem__(self, index: slice) -> Sequence[StoredView]: ...
    def __getitem__(self, index: int | slice) -> StoredView | Sequence[StoredView]:
        if isinstance(index, slice):
            raise TypeError("views in a file are read one at a time")
        slot = self._slot(index)
        content, at, lidar = self._file.read(slot.begins, slot.size), 0, None
        if slot.lidar is not None:
            ends = 4 * slot.lidar, 8 * slot.lidar
            pixel = torch.from_numpy(content[ends[0] : ends[1]].view(np.int32).astype(np.int64))
            at, lidar = ends[1], LidarPixels(pixel, torch.from_numpy(content[: ends[0]].view(np.float32)))
        planes: dict[str, NDArray[Any]] = {}
        for name, kind, shape in slot.planes:
            pixels = math.prod(shape)
            size = -(-pixels // 8) if kind.kind == "b" else pixels * kind.itemsize
            part, at = content[at : at + size], at + size
            planes[name] = (np.unpackbits(part, count=pixels) if kind.kind == "b" else part).view(kind).reshape(shape)
        return StoredView(slot.head.name, slot.head.view, slot.head.kind, lidar=lidar, **planes)

    def __iter__(self) -> Iterator[StoredView]:
        for index in range(len(self)):
            yield self[index]

    def close(self) -> None:
        """Give the space back; nothing can be read any more."""
        self._file.close()


def keep(loaded: LoadedViews, count: int, folder: Path | None) -> Sequence[StoredView]:
    """The views in their places: in a scratch file in ``folder``, or in memory."""
    with contextlib.closing(loaded) as pairs:
        if folder is None:
            places = dict(pairs)
            return tuple(places[index] for index in range(count))
        filed = ViewFile(folder, count)
        try:
            for index, stored in pairs:
                filed.put(index, stored)
        except BaseException:
            filed.close()
            raise
        return filed


# ---- views of later steps --------------------------------------------------------------------------------------------


@contextlib.contextmanager
def chosen_ahead(
    views: ViewSet, choose: Callable[[int], tuple[StoredView, ...]], steps: range, device: torch.device = CPU
) -> Iterator[Iterator[tuple[TrainView, ...]]]:
    """The views that ``choose`` gives for each of these steps, as tensors on a device.

    Where views lie in a file, threads read those of a few steps beforehand; they end with the block. What goes wrong in a thread is
    raised at its step. Tensors are made by the caller's thread: in another one, every large allocation costs its page faults anew.
    """
    chosen: Generator[tuple[StoredView, ...], None, None]
    if views.filed:
        chosen = computed_ahead(lambda turn: choose(steps[turn]), len(steps), AHEAD_THREADS)
    else:
        chosen = (choose(step) for step in steps)
    with contextlib.closing(chosen):
        yield (tuple(view.as_tensors(device) for view in found) for found in chosen)
