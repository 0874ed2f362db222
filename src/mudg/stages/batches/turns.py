"""Whether a step runs beside others of this machine or alone: one that was killed for want of memory is tried again alone.

Two locked files: ``room`` is held together by steps that run beside others, and by one that runs alone for itself; ``door`` is held for a
moment on the way in, and by one that waits to be alone, so that nobody else comes in. Locks end with the process that holds them. On
systems without such locks steps never wait.
"""

from __future__ import annotations

import contextlib
import os
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, BinaryIO, Final

from mudg.base import store

fcntl: Any
try:
    import fcntl
except ImportError:  # Windows
    fcntl = None

HELD: Final = "MUDG_BATCH_TURN"
"""Set in the environment of a step: batches that it starts itself share its turn."""
_POLL_S: Final = (0.02, 1.0)
"""First and longest pause between two looks at a lock."""


def default_folder() -> Path:
    """Folder of the locks: one for all batches of this user on this machine."""
    user = os.getuid() if hasattr(os, "getuid") else 0
    return Path(tempfile.gettempdir()) / f"mudg_batch_turns_{user}"


@contextlib.contextmanager
def turn(alone: bool, cancelled: Callable[[], bool], folder: Path | None = None) -> Iterator[bool]:
    """Wait for the turn of a step, and hold it for the block; yields False if it was cancelled meanwhile.

    Args:
        alone: no other step may run on this machine. cancelled: whether to wait no longer.
    """
    if fcntl is None or os.environ.get(HELD):
        yield True
        return
    folder = folder or default_folder()
    for name in ("door", "room"):
        store.create_once(folder / name, b"")
    with store.open_file(folder / "door") as door, store.open_file(folder / "room") as room:
        inside = lock(door, True, cancelled) and lock(room, alone, cancelled)
        fcntl.flock(door, fcntl.LOCK_UN)
        yield inside


def lock(file: BinaryIO, alone: bool, cancelled: Callable[[], bool]) -> bool:
    """Lock an open file, in place of a lock held before, until it is closed; False, without any lock, if it was cancelled meanwhile.

    Args:
        alone: nobody else may hold a lock on it. cancelled: whether to wait no longer; one that is always true: do not wait.
    """
    pause_s, longest_s = _POLL_S
    while fcntl is not None:
        try:
            fcntl.flock(file, (fcntl.LOCK_EX if alone else fcntl.LOCK_SH) | fcntl.LOCK_NB)
        except BlockingIOError:
            if cancelled():
                fcntl.flock(file, fcntl.LOCK_UN)
                return False
            time.sleep(pause_s)
            pause_s = min(longest_s, 2 * pause_s)
        else:
            return True
    return True
