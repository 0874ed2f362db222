"""Work on files from elsewhere, in a process of its own and, on Linux, under a limit of address space."""

from __future__ import annotations

import concurrent.futures
import multiprocessing
import sys
from collections.abc import Callable
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path

import torch

from mudg.base import log
from mudg.base.errors import ResourceError
from mudg.data import weights

GIB = 1 << 30


def run(work: Callable[[], None], limit: int, where: Path) -> int:
    """Do the work in a fresh process that may take ``limit`` bytes of address space beyond the program's own.

    Args:
        work: a call that can be sent to another process. where: what it reads, for messages.

    Returns:
        Peak of resident memory in bytes, 0 where the system has no such limit.

    Raises:
        ResourceError: the limit was reached, or the process was ended from outside. And what the work itself raises.
    """
    if sys.platform != "linux":
        log.warn("convert: this system has no limit of address space; a hostile file may take all memory")
    context = multiprocessing.get_context("spawn")
    with concurrent.futures.ProcessPoolExecutor(1, mp_context=context) as pool:
        try:
            return pool.submit(_limited, work, limit, where).result()
        except BrokenProcessPool as error:
            raise ResourceError(
                "the converting process was ended from outside, most likely for want of memory", where=str(where),
                expected=f"about {limit / GIB:.0f} GiB of address space, of which the file takes most",
                remedy="close other programs, or convert on a machine with more memory",
            ) from error  # fmt: skip


def _limited(work: Callable[[], None], limit: int, where: Path) -> int:
    log.set_quiet(True)
    torch.set_num_threads(1)
    if sys.platform != "linux":
        work()
        return 0
    import resource

    pages = int(Path("/proc/self/statm").read_text().split()[0])
    most = pages * resource.getpagesize() + limit
    resource.setrlimit(resource.RLIMIT_AS, (most, most))
    try:
        work()
    except (MemoryError, RuntimeError) as error:
        if isinstance(error, RuntimeError) and not weights.out_of_memory(error):
            raise
        raise ResourceError(
            "conversion needs more memory than it may take", where=str(where), expected=f"<= {limit / 1e9:.1f} GB",
            got=(str(error).splitlines() or [""])[0][:200], remedy="raise --memory-gb, unless the file should be small",
        ) from error  # fmt: skip
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
