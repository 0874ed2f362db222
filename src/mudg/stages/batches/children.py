"""The process of one step of one scene: started, watched, asked to stop, and its last words."""

from __future__ import annotations

import contextlib
import os
import re
import shutil
import signal
import subprocess
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from multiprocessing.connection import wait
from pathlib import Path
from typing import Any, Final

from mudg.base import processes
from mudg.base.errors import ResourceError, UsageError
from mudg.stages.batches.retries import code_of

_KEPT: Final = 16_384
"""Bytes of what a step said that are kept."""
_FIELD: Final = re.compile(r"^  (where|expected|got|what to do): (.*)$")


@dataclass(frozen=True)
class Ending:
    """How a step ended. code: exit code of its process; words: why it failed, in one line; said: the end of what it said."""

    code: int
    words: str = ""
    said: str = ""
    seconds: float = 0.0
    processor_s: float = 0.0


class ChildProcess:
    """Runs one command at a time in a process group of its own. It ends with this process, however that ends."""

    def __init__(self, grace_s: float) -> None:
        self._grace_s = grace_s
        self._process: subprocess.Popen[bytes] | None = None
        self._stop_by: float | None = None

    def run(
        self, words: Sequence[str], folder: Path | None, environment: Mapping[str, str], cancelled: Callable[[], bool] = lambda: False
    ) -> Ending:
        """Run a command in a folder and wait for its end. cancelled: whether it was asked to stop before the process was there."""
        began, before = time.monotonic(), os.times()
        self._stop_by = None
        with tempfile.TemporaryFile() as said, processes.life_line() as line:
            command = _guarded(words)
            try:
                self._process = subprocess.Popen(
                    command, cwd=folder, stdin=subprocess.DEVNULL, stdout=said, stderr=said, start_new_session=True,
                    env={**os.environ, **environment, processes.LIFE_LINE: str(line)}, pass_fds=(line,),
                )  # fmt: skip
            except FileNotFoundError as error:
                raise UsageError("there is no such program", where="--command", got=words[0]) from error
            except OSError as error:
                raise ResourceError("a process cannot be started", got=str(error), remedy="take fewer --jobs") from error
            if cancelled():
                self.stop()
            try:
                code = self._wait(self._process)
            except BaseException:
                self._end_group(signal.SIGKILL)
                raise
            finally:
                self._process.wait()
                self._process = None
            size = said.seek(0, os.SEEK_END)
            said.seek(max(0, size - _KEPT))
            text = said.read().decode("utf-8", "replace")
        after = os.times()
        spent = after.children_user + after.children_system - before.children_user - before.children_system
        code = code_of(code)
        return Ending(code, last_words(text, code) if code else "", text, time.monotonic() - began, spent)

    def stop(self) -> None:
        """Ask the process to stop: it has the time of grace for a checkpoint. Called by signal handlers and threads."""
        if self._stop_by is None:
            self._stop_by = time.monotonic() + self._grace_s
            self._end_group(signal.SIGTERM, group=False)

    def _wait(self, process: subprocess.Popen[bytes]) -> int:
        watched = _watch(process.pid)
        try:
            while process.poll() is None:
                if self._stop_by is not None and time.monotonic() > self._stop_by:
                    self._end_group(signal.SIGKILL)
                if watched is None:
                    with contextlib.suppress(subprocess.TimeoutExpired):
                        process.wait(1.0)
                else:
                    wait([watched], 1.0)
        finally:
            if watched is not None:
                os.close(watched)
        return int(process.returncode)

    def _end_group(self, number: int, group: bool = True) -> None:
        process = self._process
        if process is not None and process.returncode is None:
            with contextlib.suppress(OSError):
                os.killpg(process.pid, number) if group else process.send_signal(number)


def _watch(pid: int) -> int | None:
    """Something that becomes readable when a process ends, where the system has that."""
    opened: Any = getattr(os, "pidfd_open", None)
    try:
        return None if opened is None else int(opened(pid))
    except OSError:
        return None


def _guarded(words: Sequence[str]) -> list[str]:
    """The command such that the system ends it with this process. mudg itself watches its life line."""
    guard = None if "mudg" in words[:3] else shutil.which("setpriv")
    return [guard, "--pdeathsig", "KILL", "--", *words] if guard else list(words)


def last_words(said: str, code: int) -> str:
    """Why a process failed, in a line: its error message, the last line of a traceback, or how it ended."""
    lines = said.splitlines()
    begins = [number for number, line in enumerate(lines) if line.startswith("error: ")]
    if begins:
        parts = [lines[begins[-1]].removeprefix("error: ")]
        for line in lines[begins[-1] + 1 :]:
            found = _FIELD.match(line)
            if found is None:
                break
            name, value = found.groups()
            if name != "what to do":
                parts.append(value if name == "where" else f"{name} {value}")
        return "; ".join(parts)
    if code > 128:
        words = f"its process was killed by signal {code - 128}"
        return words + " (out of memory? try fewer --jobs)" if code == 128 + signal.SIGKILL else words
    last = next((line.strip() for line in reversed(lines) if line.strip()), "")
    return f"its process ended with code {code}" + (f": {last[:300]}" if last else "")
