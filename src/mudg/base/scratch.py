"""Scratch files: what a computation puts aside because it does not fit into memory."""

from __future__ import annotations

import contextlib
import mmap
import os
import tempfile
import threading
import weakref
from pathlib import Path

import numpy as np
from numpy.typing import DTypeLike, NDArray

from mudg.base.errors import ResourceError
from mudg.base.store import disk_errors


class ScratchFile:
    """A file without a name, for what does not fit into memory; any thread may append and read. The system removes it
    with the process, however that ends."""

    def __init__(self, folder: Path) -> None:
        self.where = str(folder)
        with disk_errors("cannot make a scratch file", folder):
            self._file = tempfile.TemporaryFile(dir=folder, buffering=0)
        self._lock = threading.Lock()
        weakref.finalize(self, self._file.close)

    def append(self, content: NDArray[np.uint8]) -> int:
        """Write a block, u8[N], at the end; returns where it begins. ResourceError if the disk is full."""
        left = content.data
        with self._lock, disk_errors("writing failed", Path(self.where), "free disk space or choose another --out"):
            began = self._file.seek(0, os.SEEK_END)
            while len(left):
                left = left[self._file.write(left) :]
        return began

    def read(self, begins: int, size: int) -> NDArray[np.uint8]:
        """The bytes of a block. ResourceError if the disk does not give them back."""
        found = np.empty(size, np.uint8)
        left, remedy = found.data, "check the disk, then repeat the command to resume"
        with self._lock, disk_errors("a scratch file cannot be read", Path(self.where), remedy):
            self._file.seek(begins)
            while len(left):
                count = self._file.readinto(left)
                if not count:
                    raise ResourceError("a scratch file ended early", where=self.where, remedy=remedy)
                left = left[count:]
        return found

    def close(self) -> None:
        """Give the space back."""
        self._file.close()


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
