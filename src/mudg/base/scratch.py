"""Scratch files: what a computation puts aside because it does not fit into memory."""

from __future__ import annotations

import contextlib
import mmap
import os
import tempfile
import weakref
from pathlib import Path

import numpy as np
from numpy.typing import DTypeLike, NDArray

from mudg.base.store import disk_errors

_MAPPED: weakref.WeakValueDictionary[int, np.memmap] = weakref.WeakValueDictionary()


def mapped_array(folder: Path, shape: tuple[int, ...], dtype: DTypeLike) -> NDArray[np.generic]:
    """An array of zeros in a file without a name: the system keeps of it in memory what it can spare, and removes it
    with the array. ResourceError: the disk has no room for all of it. Writing to the array later needs none."""
    size = max(1, int(np.prod(shape)) * np.dtype(dtype).itemsize)
    with disk_errors("cannot make a scratch file", folder), tempfile.TemporaryFile(dir=folder, buffering=0) as file:
        if hasattr(os, "posix_fallocate"):
            os.posix_fallocate(file.fileno(), 0, size)
        else:
            file.truncate(size)
        made = np.memmap(file, dtype, "r+", shape=shape)
    _MAPPED[id(made)] = made
    return made


def rest_mapped() -> None:
    """Take mapped arrays out of the memory of this process; what is read or written again comes back."""
    for one in list(_MAPPED.values()):
        pages = getattr(one, "_mmap", None)
        if pages is not None and hasattr(mmap, "MADV_DONTNEED"):
            with contextlib.suppress(OSError, ValueError):
                pages.madvise(mmap.MADV_DONTNEED)
