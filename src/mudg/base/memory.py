"""How much memory this process may still take, and what is said when that is too little."""

from __future__ import annotations

import contextlib
import mmap
import os
import sys
import tempfile
import threading
import time
import weakref
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from mudg.base.errors import ResourceError

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import DTypeLike, NDArray

GIB: Final = 1 << 30
LEAST_ADDRESS_SPACE: Final = GIB
"""With less, torch and the libraries behind it cannot be loaded, and end the process in ways no program can catch."""


def free_bytes() -> int:
    """Memory that this process may still take: what the machine has, at most what a control group or ``ulimit -v``
    allows; 0 where there is not even memory to ask."""
    try:
        import psutil  # late, as below: --help does without

        left = (psutil.virtual_memory().available, _group_bytes(), _address_bytes())
    except (ImportError, MemoryError, OSError):
        return 0
    return min(one for one in left if one is not None)


def require_address_space(command: str) -> None:
    """ResourceError if ``ulimit -v`` leaves less than the libraries of ``command`` need just to be loaded."""
    left = _address_bytes()
    if left is not None and left < LEAST_ADDRESS_SPACE:
        expected = f"at least {in_words(LEAST_ADDRESS_SPACE)} of address space"
        got, remedy = f"{in_words(left)} left of the limit (ulimit -v)", "raise the limit with ulimit -v"
        raise ResourceError(f"{command} needs more memory than it may take", expected=expected, got=got, remedy=remedy)


def require(count: int, asked: str, remedy: str) -> None:
    """ResourceError before an allocation of ``count`` bytes that cannot succeed. asked: what for, with its sizes.
    remedy: the settings that make it smaller."""
    free = free_bytes()
    if free and count > free:
        what = f"{asked} needs more memory than there is"
        raise ResourceError(what, expected=f"about {in_words(count)}", got=f"{in_words(free)} free", remedy=remedy)


def give_back() -> None:
    """Give back what was freed: C libraries keep freed memory for later, up to hundreds of megabytes after a fit."""
    import psutil

    getattr(psutil, "heap_trim", bool)()  # not with every C library


def in_words(count: float) -> str:
    """``1.5 GiB``."""
    for unit, size in (("TiB", 1 << 40), ("GiB", GIB), ("MiB", 1 << 20)):
        if count >= size:
            return f"{count / size:.1f} {unit}"
    return f"{count / 1024:.1f} KiB"


def _group_bytes() -> int | None:
    for names in ("memory.max memory.current", "memory/memory.limit_in_bytes memory/memory.usage_in_bytes"):
        texts = [system_text(f"/sys/fs/cgroup/{name}").strip() for name in names.split()]
        if all(text.isdigit() for text in texts) and int(texts[0]) < 1 << 60:
            return max(0, int(texts[0]) - int(texts[1]))
    return None


def _address_bytes() -> int | None:
    if sys.platform != "linux":
        return None
    import resource

    if (limit := resource.getrlimit(resource.RLIMIT_AS)[0]) == resource.RLIM_INFINITY:
        return None
    import psutil

    return max(0, limit - psutil.Process().memory_info().vms)


def system_text(path: str) -> str:
    """What the system says in a file of ``/proc`` or ``/sys``; empty where it does not."""
    try:
        return Path(path).read_text(encoding="ascii")
    except (OSError, UnicodeDecodeError):
        return ""


# usage --------------------------------------------------------------------------------------------

PERIOD_S: Final = 0.25
"""How often a meter looks at memory, besides at its start and end: a peak that lasts less may be missed."""


@dataclass(frozen=True, slots=True)
class Usage:
    """What was taken so far; processor_s: of all threads and ended child processes. peak_bytes: None without
    ``/proc``."""

    seconds: float = 0.0
    processor_s: float = 0.0
    peak_bytes: int | None = None

    def then(self, later: Usage) -> Usage:
        """Of this work and the one that continued it."""
        peaks = [one for one in (self.peak_bytes, later.peak_bytes) if one is not None]
        return Usage(self.seconds + later.seconds, self.processor_s + later.processor_s, max(peaks, default=None))

    def record(self) -> dict[str, Any]:
        """As JSON values."""
        spent = {"seconds": round(self.seconds, 3), "processor_s": round(self.processor_s, 3)}
        return {**spent, "peak_bytes": self.peak_bytes}

    @classmethod
    def of_record(cls, values: Mapping[str, Any]) -> Usage:
        """Of what `record` wrote; what is not noted is 0 or unknown."""
        seconds, processor_s = (float(values.get(name, 0.0)) for name in ("seconds", "processor_s"))
        peak = values.get("peak_bytes")
        return cls(seconds, processor_s, None if peak is None else int(peak))


class Meter:
    """Measures from its making on: time, and the most memory that this process and its descendants held together."""

    def __init__(self) -> None:
        self._began_s, self._processor_s = time.monotonic(), sum(os.times()[:4])  # with children that have ended
        self._peak = held_bytes() or 0
        self._last: Usage | None = None
        self._stopped = threading.Event()
        given = weakref.ref(self), self._stopped
        with contextlib.suppress(RuntimeError):  # no thread to be had: the samples of start and end remain
            threading.Thread(target=_watch, args=given, name="memory meter", daemon=True).start()

    def look(self) -> None:
        """Take a sample of memory."""
        self._peak = max(self._peak, held_bytes() or 0)

    def usage(self) -> Usage:
        """Up to now; after `stop`, up to then."""
        if self._last is not None:
            return self._last
        self.look()
        return Usage(time.monotonic() - self._began_s, sum(os.times()[:4]) - self._processor_s, self._peak or None)

    def stop(self) -> Usage:
        """Measure no further."""
        self._last = self.usage()
        self._stopped.set()
        return self._last


def _watch(meter: weakref.ref[Meter], stopped: threading.Event) -> None:
    """Let a meter look at memory until it is stopped, or nobody holds it."""
    while not stopped.wait(PERIOD_S) and (alive := meter()) is not None:
        alive.look()
        del alive


def held_bytes() -> int | None:
    """Memory that this process and its descendants hold now: what belongs to each alone, and of mapped files and shared
    memory the most that one of them has resident. None where the system has no ``/proc``."""
    own, mapped, waiting = 0, 0, [os.getpid()]
    while waiting:  # psutil finds children only by a look at all processes
        process = waiting.pop()
        pages = system_text(f"/proc/{process}/statm").split()
        if len(pages) > 2:
            own += int(pages[1]) - int(pages[2])
            mapped = max(mapped, int(pages[2]))
        with contextlib.suppress(OSError):  # it ended meanwhile
            for thread in os.listdir(f"/proc/{process}/task"):
                waiting += map(int, system_text(f"/proc/{process}/task/{thread}/children").split())
    return (own + mapped) * os.sysconf("SC_PAGE_SIZE") if own else None


def folder_bytes(folder: Path) -> int:
    """Size of all files in a folder, or of one file."""
    with contextlib.suppress(OSError):
        if folder.is_file():
            return folder.stat().st_size
    total = 0
    for top, _, names in os.walk(folder):
        for name in names:
            with contextlib.suppress(OSError):
                total += os.lstat(os.path.join(top, name)).st_size
    return total


# scratch files: what a computation puts aside because it does not fit into memory ---------------------

_MAPPED: weakref.WeakValueDictionary[int, np.memmap] = weakref.WeakValueDictionary()


def mapped_array(folder: Path, shape: tuple[int, ...], dtype: DTypeLike) -> NDArray[np.generic]:
    """An array of zeros in a file without a name: the system keeps of it in memory what it can spare, and removes it
    with the array. ResourceError: the disk has no room for all of it. Writing to the array later needs none."""
    import numpy as np  # late: --help does without

    from mudg.base.store import disk_errors

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
