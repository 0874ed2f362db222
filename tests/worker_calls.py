"""What workers do in tests of processes; a module of its own, for each of them imports it."""

from __future__ import annotations

import os
import time
from pathlib import Path

from mudg.base.errors import NumericsError
from mudg.base.processes import Interruption

PATIENCE_S = 60.0


def wait_for(path: Path) -> None:
    """Until the file is there."""
    end = time.monotonic() + PATIENCE_S
    while not path.exists():
        if time.monotonic() > end:
            raise TimeoutError(str(path))
        time.sleep(0.01)


def mark(folder: Path) -> None:
    """Say which process works in a folder, at once and whole."""
    (folder / "starting").write_text(str(os.getpid()))
    (folder / "starting").rename(folder / "started")


def sleep_long(folder: Path) -> None:
    """Works for longer than any test waits, and tidies up when it is stopped."""
    try:
        mark(folder)
        time.sleep(600)
    finally:
        (folder / "tidy").touch()


def work_in_steps(folder: Path) -> None:
    """Works like a fit: a signal is taken at the end of a step, and a checkpoint is written."""
    with Interruption() as interruption:
        mark(folder)
        while not interruption.requested:
            time.sleep(0.05)
        time.sleep(0.3)
        (folder / "checkpoint").touch()
        interruption.stop_now()


def note(folder: Path, seconds: float, after: Path | None = None) -> None:
    """Takes some time, from the moment on that a file is there; then it writes, or fails if its folder is so called."""
    mark(folder)
    if after is not None:
        wait_for(after)
    time.sleep(seconds)
    if folder.name.endswith("fails"):
        raise NumericsError("a loss is not finite", where=folder.name)
    (folder / "done").touch()


def call(folder: Path) -> None:
    """One of the calls above, by the folder's name."""
    if folder.name.endswith("steps"):
        work_in_steps(folder)
    elif folder.name.endswith("fails"):
        note(folder, 0.0, folder.parent / "1sleeps" / "started")
    else:
        sleep_long(folder)
