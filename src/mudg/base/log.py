"""Messages and progress on stderr. Results go to stdout and are the command line's business."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Iterable, Iterator
from typing import TYPE_CHECKING, TypeVar

from mudg.base.errors import plain, plain_lines

if TYPE_CHECKING:
    from rich.console import Console
    from rich.progress import Progress, TaskID

Item = TypeVar("Item")

_quiet = False
_said: set[str] = set()
_bars: list[Progress] = []
"""What draws all bars of a terminal, while there are some. Messages go through its console, and break none."""


def set_quiet(quiet: bool) -> None:
    """Silence ``info`` and progress bars (warnings stay)."""
    global _quiet
    _quiet = quiet


def is_quiet() -> bool:
    """Return whether ``info`` and progress bars are silenced."""
    return _quiet


def _console() -> Console:
    """That of the bars, or a new one: stderr may be another stream by now."""
    from rich.console import Console

    return _bars[0].console if _bars else Console(stderr=True, highlight=False, soft_wrap=True)


def _say(lines: Iterable[str], style: str | None = None) -> None:
    """Print lines without control characters. One that cannot be written (stderr closed, or on a full disk) ends
    nothing."""
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
        self._id: TaskID | None = None
        self._last_line_s = time.monotonic()
        if _quiet or not _console().is_terminal:
            return
        if not _bars:
            from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

            before, after = (TextColumn(f"{{task.{of}}}", markup=False) for of in ("description", "fields[text]"))
            columns = (before, BarColumn(), MofNCompleteColumn(), TimeRemainingColumn(), after)
            _bars.append(Progress(*columns, console=_console()))
            _bars[0].start()
        self._id = _bars[0].add_task(self._description, total=total, completed=start, text="")

    def advance(self, count: int = 1) -> None:
        """Count ``count`` more items as done."""
        self._done += count
        if self._id is not None:
            with contextlib.suppress(OSError, ValueError):
                _bars[0].update(self._id, completed=self._done, text=self._text)
        elif not _quiet and (time.monotonic() - self._last_line_s > 10.0):
            self._last_line_s = time.monotonic()
            info(f"{self._description}: {self._done}/{self._total} {self._text}")

    def update(self, text: str) -> None:
        """Show ``text`` (a loss, a rate) beside the bar from the next ``advance`` on."""
        self._text = plain(text)

    def close(self) -> None:
        """Stop drawing. A bar within another goes away; the outer one stays on the screen."""
        if self._id is None:
            return
        with contextlib.suppress(OSError, ValueError):
            if len(_bars[0].tasks) > 1:
                _bars[0].remove_task(self._id)
            else:
                _bars.pop().stop()
        self._id = None


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
