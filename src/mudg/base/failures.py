"""Errors of the system and of libraries, put in words: memory, disks, files, processes that ended."""

from __future__ import annotations

import contextlib
import errno
import os
import re
from typing import Final

from mudg.base import memory
from mudg.base.errors import MudgError, ResourceError

_LESS: Final = "take smaller images, fewer frames or fewer processes"
SMALLER: Final = f"{_LESS}, close other programs, or use a machine with more memory"
_NO_MEMORY: Final = (
    "DefaultCPUAllocator,not enough memory,Cannot allocate memory,out of memory,failed to map segment,"
    "can't allocate memory,can't start new thread,bad_alloc,error return without exception set"
).split(",")
"""What libraries say when memory is short; the last is an import that ran out of it."""
_FREE: Final = "free disk space, then repeat the command to resume"
_DISK: Final = {
    errno.ENOSPC: ("the disk is full", _FREE),
    errno.EDQUOT: ("the disk quota is used up", _FREE),
    errno.EFBIG: ("a file is larger than it may become", "raise the limit (ulimit -f), or choose another --out"),
    errno.EIO: ("the disk could not be read or written", "check the disk, then repeat the command to resume"),
    errno.EROFS: ("the file system is read-only", "choose another --out"),
    **dict.fromkeys((errno.EACCES, errno.EPERM), ("access to a file was refused", "check who may read and write it")),
    errno.EMFILE: ("too many files are open", "raise the limit (ulimit -n)"),
    errno.ENFILE: ("too many files are open on this machine", "close other programs"),
    errno.ENAMETOOLONG: ("a path is too long", "choose a shorter path"),
    errno.ELOOP: ("symbolic links lead in a circle", "check the links"),
    errno.ENOTDIR: ("a part of a path is no folder", "check the path"),
    errno.EISDIR: ("a folder is where a file should be", "check the path"),
    errno.ENOENT: ("a file or folder is missing", "was it removed meanwhile? check the path"),
    errno.ESTALE: ("a network drive lost a file", "repeat the command to resume"),
}


def in_words(error: BaseException, smaller: str = "") -> MudgError | None:
    """An error that this program did not raise, for users; None for a mistake in the program. smaller: settings for
    less memory."""
    from concurrent.futures.process import BrokenProcessPool  # late: --help needs no processes

    if isinstance(error, MudgError):
        return error
    if is_memory(error):
        free, text = memory.free_bytes(), str(error)
        # numpy: "... for an array with shape (3, 4) and data type float32"
        if wanted := re.search(r"allocate ([\d.]+ [KMGTPE]i?B)\b(.{0,120})", text, re.DOTALL):
            asked = wanted[1] + wanted[2]
        else:
            asked = memory.in_words(int(wanted[1])) if (wanted := re.search(r"allocate (\d+) bytes", text)) else ""
        got, remedy = f"{memory.in_words(free)} free" if free else "", f"{smaller}; {SMALLER}" if smaller else SMALLER
        return ResourceError("there is not enough memory", expected=asked, got=got, remedy=remedy)
    if isinstance(error, BrokenProcessPool):
        return ended_process(str(error))
    if isinstance(error, OSError):
        what, remedy = _DISK.get(error.errno or 0, ("the system refused", "check the path and the disk"))
        names = [str(name) for name in (error.filename, error.filename2) if name is not None]
        return ResourceError(what, where=" -> ".join(names), got=str(error)[:300], remedy=remedy)
    return None


def ended_process(got: str = "") -> ResourceError:
    """A worker process that was killed."""
    remedy = "take fewer processes, or a machine with more memory; repeat the command to resume"
    return ResourceError("a process ended without a word, most likely for want of memory", got=got, remedy=remedy)


def is_memory(error: BaseException) -> bool:
    """Whether an error says that memory ran out."""
    if isinstance(error, MemoryError) or (isinstance(error, OSError) and error.errno == errno.ENOMEM):
        return True
    kind = isinstance(error, RuntimeError | ImportError | SystemError)
    return kind and any(sign in str(error) for sign in _NO_MEMORY)


def silence(stream: int) -> None:
    """Let a stream that cannot be written (1: stdout, 2: stderr) lead nowhere: the process ends without an error."""
    with contextlib.suppress(OSError):
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, stream)
        os.close(nowhere)
