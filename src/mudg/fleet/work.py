"""One scene: its steps one after another, each a process. A step is made in a folder of its own, published when it has
ended well, and put on record.

    WORK/<key>.<token>/     inputs/<step>   settings.yaml   result

A result counts from its record on. Everything before may happen twice, or be cut off at any point: what another attempt
left is gone on with. Commands run in this folder and name what is in it by relative names, so that a result does not
depend on where it was made. Results are named by what they are made of, so whoever runs a scene again, here or on
another machine, does only what is missing.
"""

from __future__ import annotations

import contextlib
import os
import re
import shutil
import signal
import socket
import subprocess
import tempfile
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import yaml

from mudg.base import failures, log, processes, store
from mudg.base.errors import InputError, IntegrityError, MudgError, ResourceError, UsageError
from mudg.base.memory import folder_bytes
from mudg.base.run_folder import fcntl
from mudg.fleet.plan import COMMAND, BatchPlan, Entry, Unit
from mudg.fleet.records import ASKED_TO_STOP, KILLED, BatchFolder, Ended

# the process of a step: started, watched, asked to stop, and its last words ---------------------------

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
        for file in (door, room):
            while not stop.asked:
                try:
                    fcntl.flock(file, (fcntl.LOCK_EX if alone else fcntl.LOCK_SH) | fcntl.LOCK_NB)
                    break
                except BlockingIOError:
                    time.sleep(0.1)
        if not alone:
            fcntl.flock(door, fcntl.LOCK_UN)
        yield


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


# the steps of a scene -----------------------------------------------------------------------------

DONE, FAILED, STOPPED, LOST = "done", "failed", "stopped", "lost"
WAITS_S: Final = {4: (0.0,), 5: (10.0, 60.0), 130: (2.0, 2.0), KILLED: (5.0,), ASKED_TO_STOP: (2.0, 2.0)}
"""Exit code -> pauses before further tries; another signal: one more try. Other codes would come again."""
_RESULT: Final = "result"
_SETTINGS: Final = "settings.yaml"


@dataclass(frozen=True)
class Job:
    """What every task of a batch needs to know. threads: of each step. grace_s: seconds that a step has to stop."""

    folder: BatchFolder
    plan: BatchPlan
    threads: int = 1
    grace_s: float = 100.0

    def run(self, entry: Entry, stop: Stop) -> list[Ended]:
        """Do the steps of a scene that are not on record yet, until one fails or work is to stop; returns their
        ends."""
        ended: list[Ended] = []
        for unit in self.plan.units(entry):
            if self.folder.record("done", unit.key).exists():
                continue
            if self.folder.record("failed", unit.key).exists():
                break
            ended.append(_Step(self, unit, stop).run())
            if ended[-1].state != DONE:
                log.warn(f"{unit.title} {ended[-1].state}: {ended[-1].words or 'the same command goes on'}")
                break
        return ended


def is_open(plan: BatchPlan, entry: Entry, done: set[str], failed: set[str]) -> bool:
    """Whether a scene has steps that can be done, by the keys on record."""
    return next((unit.key not in failed for unit in plan.units(entry) if unit.key not in done), False)


class _Step:
    """A step of a scene, with the attempts at it."""

    def __init__(self, job: Job, unit: Unit, stop: Stop) -> None:
        self._job, self._unit, self._stop = job, unit, stop
        self._root = job.folder.own.absolute() / "work"
        self._path = self._root / f"{unit.key}.{os.getpid()}-{time.time_ns():x}"
        self._result, self._published = self._path / _RESULT, job.folder.out / unit.place
        self._lost_s = 0.0

    def run(self) -> Ended:
        """Try until it has ended well, has failed for good, or is to stop."""
        tries: Counter[int] = Counter()
        while not self._stop.asked:
            ending = self._attempt(alone=tries[KILLED] > 0)
            if isinstance(ending, Ended):
                return ending
            if self._stop.asked and ending.code in (1, ResourceError.exit_code, 130, KILLED, ASKED_TO_STOP):
                break
            self._lost_s += ending.processor_s
            waits = WAITS_S.get(ending.code, (5.0,) if ending.code > 128 else ())
            if tries[ending.code] >= len(waits):
                record = self._ended(FAILED, replace(ending, processor_s=0.0))
                self._remove()
                if ending.text:
                    store.atomic_write(self._job.folder.log(self._unit.key), ending.text.encode())
                self._job.folder.end("failed", record)
                return record
            if ending.code == IntegrityError.exit_code:
                self._remove()  # what was made is thrown away first
            log.warn(f"{self._unit.title} is tried again: {ending.words}")
            self._stop.sleep(waits[tries[ending.code]])
            tries[ending.code] += 1
        if not self._result.is_dir():
            self._remove()
        return self._ended(STOPPED, Ending(ASKED_TO_STOP))

    def _attempt(self, alone: bool) -> Ending | Ended:
        """Make and publish the result, and put it on record; or how that failed."""
        try:
            ending = Ending(0)
            self._take_over()
            if not self._was_published():
                self._prepare()
                if alone:
                    how = "alone on this machine, with one thread"
                    log.warn(f"{self._unit.title} was killed, most likely for want of memory: now {how}")
                ending = self._run_command(alone)
                if ending.code:
                    return ending
                self._publish()
            facts = {"digest": digest_of(self._published), "written_bytes": folder_bytes(self._published)}
            record = self._ended(DONE, ending, **facts, peak_bytes=peak_of(self._published))
            self._remove()
            self._job.folder.end("done", record)
            return record
        except (MudgError, OSError, MemoryError) as error:
            told = failures.in_words(error)
            if told is None:
                raise
            return Ending(told.exit_code, "; ".join(part for part in (told.what, told.where, told.got) if part))

    def _was_published(self) -> bool:
        """Whether the result is there: its driver was cut off before it put it on record."""
        place = self._published
        if not (place / store.MANIFEST).is_file():
            return place.exists()
        try:
            store.verify_result(place)
        except (IntegrityError, InputError):
            log.warn(f"{place} is damaged and is made again")
            shutil.rmtree(place)
            return False
        return True

    def _take_over(self) -> None:
        """Rename what an earlier attempt left, so that one that only seemed to be dead cannot publish it."""
        left = sorted(self._root.glob(f"{self._unit.key}.*-*"), key=lambda path: path.name != self._path.name)
        for one in left:
            with contextlib.suppress(OSError):  # others do so at the same moment
                if one != self._path and self._path.exists():
                    shutil.rmtree(one, ignore_errors=True)
                elif one != self._path:
                    one.rename(self._path)
                    for held in self._path.rglob("lock"):  # of a run on a machine that may be gone
                        held.unlink(missing_ok=True)

    def _prepare(self) -> None:
        """Make the folder, with links to what the command reads, and its settings."""
        store.make_folder(self._path / "inputs")
        for name, place in self._unit.needs.items():
            link = self._path / "inputs" / name
            link.unlink(missing_ok=True)  # of an earlier attempt
            link.symlink_to((self._job.folder.out / place).absolute())
        if self._unit.stage.settings:
            text = yaml.safe_dump(dict(self._unit.stage.settings), sort_keys=False)
            store.write_in_tree(self._path / _SETTINGS, text.encode())

    def _run_command(self, alone: bool) -> Ending:
        unit, threads = self._unit, 1 if alone else self._job.threads
        places = {"source": unit.entry.source, **{name: f"inputs/{name}" for name in unit.needs}}
        words = unit.command(places, _RESULT, _SETTINGS if unit.stage.settings else "")
        ending = run_step(words, self._path, threads, self._stop, alone=alone)
        # of another state of the source
        own = unit.stage.name == COMMAND
        begun = not own and store.json_object(self._result / store.RUN_STATE).get("state") in ("running", "interrupted")
        if ending.code == UsageError.exit_code and begun:
            ending = run_step([*words, "--overwrite"], self._path, threads, self._stop, alone=alone)
        if alone and ending.code == KILLED:
            said = "its process was killed by signal 9, also alone on its machine with one thread: out of memory?"
            return replace(ending, words=said)
        if ending.code == 0 and not self._result.exists():
            return replace(ending, code=1, words="it ended well but wrote nothing")
        return ending

    def _publish(self) -> None:
        """Bring the result to its place in the output. Another attempt's result of the same key is as good."""
        store.make_folder(self._published.parent)
        try:
            self._result.rename(self._published)
        except OSError as error:
            if not self._published.exists():
                what = "the result cannot be moved to its place"
                raise ResourceError(what, where=str(self._published), got=str(error)) from error
        store.fsync_directory(self._published.parent)

    def _remove(self) -> None:
        shutil.rmtree(self._path, ignore_errors=True)

    def _ended(self, state: str, ending: Ending, **more: Any) -> Ended:
        unit, times = self._unit, {"ended": time.time(), "lost_s": self._lost_s}
        times |= {"seconds": ending.seconds, "processor_s": ending.processor_s}
        what: dict[str, Any] = {"scene": unit.entry.name, "stage": unit.stage.name, "source": unit.entry.source}
        what |= {"key": unit.key, "place": unit.place, "host": socket.gethostname()} | more
        what |= {name: round(value, 3) for name, value in times.items()}
        return Ended(state=state, code=ending.code, words=ending.words[:2000], **what)


# facts about results ------------------------------------------------------------------------------


def digest_of(folder: Path) -> str:
    """What tells a result's bytes: the hash of its manifest; of a chain, of its steps' manifests; else of all files."""
    if (folder / store.MANIFEST).is_file():
        return store.sha256_file(folder / store.MANIFEST)
    manifests = sorted(path.relative_to(folder).as_posix() for path in folder.rglob(store.MANIFEST))
    names = manifests or (store.list_files(folder) if folder.is_dir() else [""])
    return store.digest_of_files(folder, names)


def peak_of(folder: Path) -> int | None:
    """Most memory that the record of a result tells, in bytes; None where it does not."""
    with contextlib.suppress(AttributeError, TypeError, ValueError):
        state = store.json_object(folder / store.RUN_STATE)
        steps = state["steps"].values() if "steps" in state else [state]
        return max((int(one["peak_bytes"]) for one in steps if one.get("peak_bytes")), default=None)
    return None
