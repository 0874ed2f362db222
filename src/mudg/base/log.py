"""Messages and progress on stderr. Results go to stdout and are the command line's business."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Iterable, Iterator
from typing import TypeVar

from mudg.base.errors import plain, plain_lines

Item = TypeVar("Item")

_quiet = False
_said: set[str] = set()


def set_quiet(quiet: bool) -> None:
    """Silence ``info`` and progress bars (warnings stay)."""
    global _quiet
    _quiet = quiet


def is_quiet() -> bool:
    """Return whether ``info`` and progress bars are silenced."""
    return _quiet


def _console():
    from rich.console import Console

    return Console(stderr=True, highlight=False, soft_wrap=True)


def _say(lines: Iterable[str], style: str | None = None) -> None:
    """Control characters and line breaks within a line are escaped. A message that cannot be written (stderr closed, or
    on a full disk) ends nothing."""
    with contextlib.suppress(OSError, ValueError):  # ValueError: the stream is closed
        _console().print(plain_lines(lines), markup=False, style=style)


def info(*lines: str) -> None:
    """Say something worth knowing, once, on stderr."""
    if not _quiet:
        _say(lines)


def info_once(message: str) -> None:
    """Say it the first time only (a chosen backend, precision or device)."""
    if message not in _said:
        _said.add(message)
        info(message)


def warn(message: str, *lines: str) -> None:
    """Say that something is wrong but the work goes on."""
    _say((f"warning: {message}", *lines), "yellow")


class ProgressTask:
    """One running progress bar. On a terminal it is drawn; elsewhere a line is written now and then."""

    def __init__(self, description: str, total: int, start: int) -> None:
        self._description = plain(description)
        self._total = total
        self._done = start
        self._text = ""
        self._progress = None
        self._id = None
        self._last_line_s = time.monotonic()
        if _quiet:
            return
        console = _console()
        if console.is_terminal:
            from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

            before, after = (TextColumn(f"{{task.{of}}}", markup=False) for of in ("description", "fields[text]"))
            columns = (before, BarColumn(), MofNCompleteColumn(), TimeRemainingColumn(), after)
            self._progress = Progress(*columns, console=console, transient=False)
            self._progress.start()
            self._id = self._progress.add_task(self._description, total=total, completed=start, text="")

    def advance(self, count: int = 1) -> None:
        """Count ``count`` more items as done."""
        self._done += count
        if self._progress is not None and self._id is not None:
            with contextlib.suppress(OSError, ValueError):
                self._progress.update(self._id, completed=self._done, text=self._text)
        elif not _quiet and (time.monotonic() - self._last_line_s > 10.0):
            self._last_line_s = time.monotonic()
            info(f"{self._description}: {self._done}/{self._total} {self._text}")

    def update(self, text: str) -> None:
        """Show ``text`` (a loss, a rate) beside the bar from the next ``advance`` on."""
        self._text = plain(text)

    def close(self) -> None:
        """Stop drawing."""
        if self._progress is not None:
            with contextlib.suppress(OSError, ValueError):
                self._progress.stop()
            self._progress = None


@contextlib.contextmanager
def task(description: str, total: int, start: int = 0) -> Iterator[ProgressTask]:
    """Show progress over ``total`` items, ``start`` of which are already done."""
    bar = ProgressTask(description, total, start)
    try:
        yield bar
    finally:
        bar.close()


def progress(items: Iterable[Item], total: int, description: str) -> Iterator[Item]:
    """Yield ``items`` while showing progress."""
    with task(description, total) as bar:
        for item in items:
            yield item
            bar.advance()
