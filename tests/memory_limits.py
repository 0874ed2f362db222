"""A limit on the memory that a block of a test may take, set in the process itself."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest


@contextmanager
def at_most(mib: int) -> Iterator[None]:
    """Let the block map no more than this on top of what the process has; what asks for more gets a MemoryError."""
    resource = pytest.importorskip("resource")
    found = re.search(r"^VmSize:\s+(\d+) kB", Path("/proc/self/status").read_text(), re.MULTILINE)
    if found is None:
        pytest.skip("the system does not say how much memory a process has")
    before = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (1024 * int(found[1]) + (mib << 20), before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, before)
