"""The process of one step: started, watched, asked to stop, and its last words."""

from __future__ import annotations

import contextlib
import os
import re
import shutil
import signal
import subprocess
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO, Final

from mudg.base import processes, store
from mudg.base.errors import ResourceError, UsageError
from mudg.base.run_folder import fcntl

KILLED: Final = 137
"""Code of a step that was killed, as the system does where memory runs out."""
ASKED_TO_STOP: Final = 143
_LAST_BYTES: Final = 16_384
"""Bytes of what a step said that are kept."""
_HELD: Final = "MUDG_BATCH_TURN"
"""Set in the environment of a step: batches that it starts itself share its turn."""
_FIELD: Final = re.compile(r"^  (where|expected|got|what to do): (.*)$")


@dataclass
class Stop:
    """Whether work is to stop. grace_s: seconds that steps have for a checkpoint. deadline: when those that still run
    are killed, by the monotonic clock."""

    grace_s: float = 100.0
    deadline: float | None = None

    def ask(self) -> None:
        """Ask all steps to write a checkpoint; asked again, kill them. Called by signal handlers, too."""
        self.deadline = time.monotonic() + (0.0 if self.asked else self.grace_s)

    @property
    def asked(self) -> bool:
        """Whether work is to stop."""
        return self.deadline is not None

    def sleep(self, seconds: float) -> None:
        """Wait, but not once work is to stop."""
        end = time.monotonic() + seconds
        while not self.asked and (left := end - time.monotonic()) > 0:
            time.sleep(min(0.2, left))


@dataclass(frozen=True)
class Ending:
    """How a step ended. code: of its process; words: why it failed, in one line; text: the end of what it said."""

    code: int
    words: str = ""
    text: str = ""
    seconds: float = 0.0
    processor_s: float = 0.0


def run_step(words: Sequence[str], folder: Path, threads: int, stop: Stop, *, alone: bool = False) -> Ending:
    """Run a command in a process group of its own and wait for its end. It ends with this process, however that ends.
    alone: wait until no other step runs on this machine. UsageError: there is no such program. ResourceError: no
    process can be started."""
    own = {"OMP_NUM_THREADS": str(threads), "OMP_WAIT_POLICY": "PASSIVE", "MUDG_THREADS": str(threads), _HELD: "1"}
    with _turn(alone, stop), tempfile.TemporaryFile() as said, processes.life_line() as line:
        began_s = time.monotonic()
        try:
            environment = {**os.environ, **own, processes.LIFE_LINE: str(line)}
            streams: dict[str, Any] = {"stdin": subprocess.DEVNULL, "stdout": said, "stderr": said, "pass_fds": (line,)}
            process = subprocess.Popen(_guarded(words), cwd=folder, env=environment, start_new_session=True, **streams)
        except FileNotFoundError as error:
            raise UsageError("there is no such program", where="--command", got=words[0]) from error
        except OSError as error:
            raise ResourceError("a process cannot be started", got=str(error), remedy="take fewer --jobs") from error
        code, processor_s = _wait(process, stop)
        code = 128 - code if code < 0 else code
        said.seek(max(0, said.seek(0, os.SEEK_END) - _LAST_BYTES))
        text = said.read().decode("utf-8", "replace")
    return Ending(code, last_words(text, code) if code else "", text, time.monotonic() - began_s, processor_s)


def _wait(process: subprocess.Popen[Any], stop: Stop) -> tuple[int, float]:
    """Exit code and processor seconds. A Ctrl-C that reaches this thread asks for a stop, too."""
    told, pause_s = False, 0.005
    while True:
        try:
            if hasattr(os, "wait4"):
                found, status, usage = os.wait4(process.pid, os.WNOHANG)
                if found:
                    process.returncode = os.waitstatus_to_exitcode(status)
                    return process.returncode, usage.ru_utime + usage.ru_stime
            elif process.poll() is not None:
                return process.returncode, 0.0
            if stop.asked and not told:
                process.terminate()
                told = True
            if stop.deadline is not None and time.monotonic() > stop.deadline:
                os.killpg(process.pid, signal.SIGKILL)
            time.sleep(pause_s)
            pause_s = min(2 * pause_s, 0.1)
        except KeyboardInterrupt:
            stop.ask()


def _guarded(words: Sequence[str]) -> list[str]:
    """The command such that the system ends it with this process (mudg itself watches its life line), and such that the
    signal with which Slurm announces the end of a job reaches this process alone."""
    guard = None if "mudg" in words[:3] else shutil.which("setpriv")
    guarded = [guard, "--pdeathsig", "KILL", "--", *words] if guard else list(words)
    return ["sh", "-c", 'trap "" USR1 USR2; exec "$@"', "sh", *guarded] if "SLURM_JOB_ID" in os.environ else guarded


@contextlib.contextmanager
def _turn(alone: bool, stop: Stop) -> Iterator[None]:
    """Hold the turn of a step: beside others of this user on this machine, or alone, holding the door meanwhile."""
    if fcntl is None or os.environ.get(_HELD):
        yield
        return
    folder = Path(tempfile.gettempdir()) / f"mudg_batch_turns_{os.getuid()}"
    for name in ("door", "room"):
        store.create_once(folder / name, b"")
    with store.open_file(folder / "door") as door, store.open_file(folder / "room") as room:
        lock(door, alone, stop)
        lock(room, alone, stop)
        if not alone:
            fcntl.flock(door, fcntl.LOCK_UN)
        yield


def lock(file: BinaryIO, alone: bool, stop: Stop | None) -> bool:
    """Lock an open file until it is closed, alone or together with others. False where that could not be: work is to
    stop meanwhile, or stop is None and it is locked already."""
    pause_s = 0.02
    while fcntl is not None:
        try:
            fcntl.flock(file, (fcntl.LOCK_EX if alone else fcntl.LOCK_SH) | fcntl.LOCK_NB)
            return True
        except BlockingIOError:
            if stop is None or stop.asked:
                return False
            time.sleep(pause_s)
            pause_s = min(1.0, 2 * pause_s)
    return True


def last_words(text: str, code: int) -> str:
    """Why a process failed, in a line: its error message, the last line of a traceback, or how it ended."""
    lines = text.splitlines()
    begins = [number for number, line in enumerate(lines) if line.startswith("error: ")]
    if begins:
        parts = [lines[begins[-1]].removeprefix("error: ")]
        for line in lines[begins[-1] + 1 :]:
            match = _FIELD.match(line)
            if match is None:
                break
            name, value = match.groups()
            if name != "what to do":
                parts.append(value if name == "where" else f"{name} {value}")
        return "; ".join(parts)
    if code > 128:
        words = f"its process was killed by signal {code - 128}"
        return words + " (out of memory? try fewer --jobs)" if code == KILLED else words
    last = next((line.strip() for line in reversed(lines) if line.strip()), "")
    return f"its process ended with code {code}" + (f": {last[:300]}" if last else "")
