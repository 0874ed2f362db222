"""How much memory this process may still take, and what is said when that is too little."""

from __future__ import annotations

import ctypes
import re
import sys
from pathlib import Path
from typing import Final

from mudg.base.errors import ResourceError

GIB: Final = 1 << 30
LEAST_ADDRESS_SPACE: Final = GIB
"""With less, torch and the libraries behind it cannot be loaded, and end the process in ways that no program can catch."""


def free_bytes() -> int:
    """Memory that this process may still take: what the machine has, at most what a control group or ``ulimit -v`` allows;
    0 where the system does not say."""
    return min((one for one in (machine_bytes(), _group_bytes(), _address_bytes()) if one is not None), default=0)


def machine_bytes() -> int | None:
    """Memory that programs on this machine can still ask for; None where the system does not say."""
    found = re.search(r"^MemAvailable:\s+(\d+) kB", system_text("/proc/meminfo"), re.MULTILINE)
    return 1024 * int(found[1]) if found else None


def require_address_space(command: str) -> None:
    """ResourceError if ``ulimit -v`` leaves less than the libraries of ``command`` need just to be loaded."""
    left = _address_bytes()
    if left is not None and left < LEAST_ADDRESS_SPACE:
        raise ResourceError(
            f"{command} needs more memory than it may take", expected=f"at least {in_words(LEAST_ADDRESS_SPACE)} of address space",
            got=f"{in_words(left)} left of the limit (ulimit -v)", remedy="raise the limit with ulimit -v",
        )  # fmt: skip


def require(count: int, asked: str, remedy: str) -> None:
    """ResourceError before an allocation that cannot succeed.

    Args:
        count: bytes. asked: what for, with its sizes. remedy: the settings that make it smaller.
    """
    free = free_bytes()
    if free and count > free:
        raise ResourceError(f"{asked} needs more memory than there is", expected=f"about {in_words(count)}", got=f"{in_words(free)} free",
            remedy=remedy)  # fmt: skip


def give_back() -> None:
    """Hand the system what was freed: glibc keeps freed memory for later, up to hundreds of megabytes after a fit. Elsewhere: nothing."""
    if sys.platform == "linux":
        trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
        if trim is not None:
            trim(0)


def in_words(count: float) -> str:
    """``1.5 GiB``."""
    for unit, size in (("TiB", 1 << 40), ("GiB", GIB), ("MiB", 1 << 20)):
        if count >= size:
            return f"{count / size:.1f} {unit}"
    return f"{count / 1024:.1f} KiB"


def _group_bytes() -> int | None:
    for limit, used in (("memory.max", "memory.current"), ("memory/memory.limit_in_bytes", "memory/memory.usage_in_bytes")):
        texts = [system_text(f"/sys/fs/cgroup/{name}").strip() for name in (limit, used)]
        if all(text.isdigit() for text in texts) and int(texts[0]) < 1 << 60:
            return max(0, int(texts[0]) - int(texts[1]))
    return None


def _address_bytes() -> int | None:
    if sys.platform != "linux":
        return None
    import resource

    limit = resource.getrlimit(resource.RLIMIT_AS)[0]
    pages = system_text("/proc/self/statm").split()
    if limit == resource.RLIM_INFINITY or not pages:
        return None
    return max(0, limit - int(pages[0]) * resource.getpagesize())


def system_text(path: str) -> str:
    """What the system says in a file of ``/proc`` or ``/sys``; empty where it does not."""
    try:
        return Path(path).read_text(encoding="ascii")
    except (OSError, UnicodeDecodeError):
        return ""
