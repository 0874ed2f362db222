"""One scene: its steps one after another. Each is made in a folder of its own, published when it has ended well, and
put on record.

    WORK/<key>.<token>/     inputs/<step>   source   weights   settings.yaml   result

A result counts from its record on. Everything before may happen twice, or be cut off at any point: what another attempt
left is gone on with. Commands run in this folder and name what is in it by relative names, so that a result does not
depend on where it was made. Results are named by what they are made of, so whoever runs a scene again, here or on
another machine, does only what is missing.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import re
import shutil
import socket
import tempfile
import time
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Final

import yaml

from mudg.base import failures, log, store
from mudg.base.errors import InputError, IntegrityError, MudgError, ResourceError, UsageError
from mudg.base.location import PACKAGES, Location
from mudg.base.memory import folder_bytes
from mudg.fleet.child import ASKED_TO_STOP, KILLED, Ending, Stop, lock, run_step
from mudg.fleet.plan import REVISION, BatchPlan, Entry, Unit, command_of
from mudg.fleet.records import BatchFolder, Ended

DONE, FAILED, STOPPED, LOST = "done", "failed", "stopped", "lost"
REASONS: Final[Mapping[int, str]] = {
    **dict(enumerate("a mistake in the program,usage,bad input,damaged result,memory or disk,numbers".split(","), 1)),
    130: "interrupted",
    KILLED: "killed, most likely for want of memory",
    ASKED_TO_STOP: "asked to stop",
}
WAITS_S: Final = {4: (0.0,), 5: (10.0, 60.0), 130: (2.0, 2.0), KILLED: (5.0,), ASKED_TO_STOP: (2.0, 2.0)}
"""Exit code -> pauses before further tries; another signal: one more try. Other codes would come again."""
_RESULT: Final = "result"
_SETTINGS: Final = "settings.yaml"
_ADDRESS: Final = re.compile(rf"({'|'.join(PACKAGES)}):/+")
"""The beginning of an address, also as a path writes it."""


# inputs -------------------------------------------------------------------------------------------
#
# Inputs that lie in a store, on this machine: shared by all steps that read them, removed when nobody needs them any
# more. They are compared with their address, file by file, once by every driver and after a step said that one is bad.
#
#     SCRATCH/mudg_inputs/<digest>/content/<name>     what was fetched
#                                  complete           for which driver; written when it is whole
#                         <digest>.lock               held together by steps that use it, or alone to fetch or remove it

FOLDER: Final = "mudg_inputs"


@dataclass(frozen=True)
class InputStore:
    """Inputs below a scratch folder. token: of the driver."""

    scratch: Path
    token: str

    def _place(self, source: Location, version: str) -> Path:
        return self.scratch / FOLDER / hashlib.sha256(f"{source} {version}".encode()).hexdigest()[:20]

    @contextlib.contextmanager
    def held(self, source: Location, version: str, stop: Stop, *, keep: bool = False) -> Iterator[Path]:
        """The file or folder at an address, on this machine, for as long as the block runs. version: of what lies
        there, where the address alone does not tell. keep: leave it there for others. InputError: nothing is there.
        ResourceError: no connection, the disk is full, or work is to stop."""
        place = self._place(source, version)
        content, mark, file = place / "content" / source.name, place / "complete", place.with_suffix(".lock")
        store.create_once(file, b"")
        with store.open_file(file) as handle:
            while True:
                if not lock(handle, False, stop):
                    raise ResourceError("stopped while another process fetches an input", where=str(source))
                whole = mark.is_file()
                if whole and store.read_text(mark) == self.token:
                    break
                if not lock(handle, True, None if whole else stop):
                    if whole:  # another driver uses it, and has compared it
                        lock(handle, False, stop)
                        break
                    continue
                if mark.is_file() and store.read_text(mark) == self.token:
                    continue  # fetched by another while this one waited: the lock is let go of before it is had alone
                store.remove(mark)
                source.fetch(content, mirror=True)
                store.write_in_tree(mark, self.token.encode())
            try:
                yield content
            finally:
                if not keep and lock(handle, True, None):
                    shutil.rmtree(place, ignore_errors=True)

    def doubt(self, source: Location, version: str) -> None:
        """Compare an input with its address before it is used again: a step said that it is bad."""
        store.remove(self._place(source, version) / "complete")

    def clear(self) -> None:
        """Remove all that is not in use."""
        for file in (self.scratch / FOLDER).glob("*.lock"):
            with contextlib.suppress(OSError, InputError), store.open_file(file) as handle:
                if lock(handle, True, None):
                    shutil.rmtree(file.with_suffix(""), ignore_errors=True)


# scenes -------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Job:
    """What every task of a batch needs to know. threads: of each step. grace_s: seconds that a step has to stop.
    scratch: folder for unfinished results (None: in the output if that is a folder, else the system's) and for inputs
    from a store. token: of the driver."""

    folder: BatchFolder
    plan: BatchPlan
    threads: int = 1
    grace_s: float = 100.0
    scratch: Path | None = None
    token: str = field(default_factory=lambda: f"{os.getpid()}-{time.time_ns():x}")

    @property
    def work_root(self) -> Path:
        """Folder of unfinished results on this machine."""
        local = self.folder.own.local
        root = local / "work" if local is not None and self.scratch is None else self.scratch_root / "mudg_batch"
        return root.absolute()

    @property
    def scratch_root(self) -> Path:
        """The scratch folder."""
        named = self.scratch or os.environ.get("SLURM_TMPDIR") or os.environ.get("TMPDIR") or tempfile.gettempdir()
        return Path(named).absolute()

    @property
    def inputs(self) -> InputStore:
        """Inputs from a store."""
        return InputStore(self.scratch_root, self.token)


def run_scene(job: Job, entry: Entry, stop: Stop) -> list[Ended]:
    """Do the steps of a scene that are not on record yet, until one fails or work is to stop; returns their ends."""
    ended: list[Ended] = []
    with contextlib.ExitStack() as held:
        for unit in job.plan.units(entry):
            if job.folder.record("done", unit.key).exists():
                continue
            if job.folder.record("failed", unit.key).exists():
                break
            ended.append(_Step(job, unit, stop, held).run())
            if ended[-1].state != DONE:
                log.warn(f"{unit.title} {ended[-1].state}: {ended[-1].words or 'the same command goes on'}")
                break
    return ended


def is_open(plan: BatchPlan, entry: Entry, done: set[str], failed: set[str]) -> bool:
    """Whether a scene has steps that can be done, by the keys on record."""
    return next((unit.key not in failed for unit in plan.units(entry) if unit.key not in done), False)


class _Step:
    """A step of a scene, with the attempts at it. held: inputs that stay on this machine until the scene is left."""

    def __init__(self, job: Job, unit: Unit, stop: Stop, held: contextlib.ExitStack) -> None:
        self._job, self._unit, self._stop, self._held = job, unit, stop, held
        self._path = job.work_root / f"{unit.key}.{os.getpid()}-{time.time_ns():x}"
        self._result = self._path / _RESULT
        self._lost_s = 0.0
        self._unpublished: Ending | None = None
        """How the command ended whose result could not be published yet."""
        self._in_output = job.folder.out.local is not None and job.scratch is None

    @property
    def _published(self) -> Location:
        return self._job.folder.out / self._unit.place

    def run(self) -> Ended:
        """Try until it has ended well, has failed for good, or is to stop."""
        tries: Counter[int] = Counter()
        while not self._stop.asked:
            ending, record = self._attempt(alone=tries[KILLED] > 0)
            if record is not None:
                return record
            if self._stop.asked and ending.code in (1, ResourceError.exit_code, 130, KILLED, ASKED_TO_STOP):
                break
            self._lost_s += ending.processor_s
            waits = WAITS_S.get(ending.code, (5.0,) if ending.code > 128 else ())
            if tries[ending.code] >= len(waits):
                return self._fail(ending)
            if ending.code == IntegrityError.exit_code:
                self._remove()  # what was made is thrown away first
                if "://" in (source := self._unit.entry.source):
                    self._held.close()
                    self._job.inputs.doubt(Location.of(source), self._unit.entry.settings.get(REVISION, ""))
            log.warn(f"{self._unit.title} is tried again: {ending.words}")
            self._stop.sleep(waits[tries[ending.code]])
            tries[ending.code] += 1
        self._leave()
        return self._ended(STOPPED, Ending(ASKED_TO_STOP))

    def _attempt(self, alone: bool) -> tuple[Ending, Ended | None]:
        ending, adopted = self._unpublished or Ending(0), None
        try:
            adopted = self._adopted()
            if adopted is not None:
                self._take_over()  # what else the driver left that was cut off goes with this attempt
            elif not self._unpublished:
                self._prepare()
                if alone:
                    how = "alone on this machine, with one thread"
                    log.warn(f"{self._unit.title} was killed, most likely for want of memory: now {how}")
                ending = self._run_command(alone)
                if ending.code:
                    return ending, None
                self._unpublished = ending
            record = self._record(adopted or self._result, ending)
            if adopted is None:
                self._publish()
            self._remove()
            self._job.folder.end("done", record)
            return ending, record
        except (MudgError, OSError, MemoryError) as error:
            told = failures.in_words(error)
            if told is None:
                raise
            words = "; ".join(part for part in (told.what, told.where, told.got) if part)
            return Ending(told.exit_code, words), None

    def _run_command(self, alone: bool) -> Ending:
        threads = 1 if alone else self._job.threads
        words, folder = self._command(), self._path
        ending = run_step(words, folder, threads, self._stop, alone=alone)
        # of another state of the source
        state = "" if self._unit.stage.is_own else store.json_object(self._result / store.RUN_STATE).get("state")
        begun = state in ("running", "interrupted")
        if ending.code == UsageError.exit_code and begun and "--overwrite" not in words:
            ending = run_step([*words, "--overwrite"], folder, threads, self._stop, alone=alone)
        if alone and ending.code == KILLED:
            words = "its process was killed by signal 9, also alone on its machine with one thread: out of memory?"
            return replace(ending, words=words)
        if ending.code == 0 and not self._result.exists():
            return replace(ending, code=1, words="it ended well but wrote nothing")
        return ending

    def _command(self) -> list[str]:
        source, settings = self._unit.entry.source, _SETTINGS if self._unit.stage.settings else ""
        if "://" in source:
            source = f"source/{Location.of(source).name}"
        places = {"source": source, **{name: f"inputs/{name}" for name in self._unit.needs}}
        return command_of(self._unit, places, _RESULT, settings)

    # where it is made -----------------------------------------------------------------------------

    def _adopted(self) -> Path | None:
        """The published result, where its driver was cut off before it put it on record."""
        place = self._published.local
        if self._in_output and place is not None:
            if not (place / store.MANIFEST).is_file():
                return place if place.exists() else None
            try:
                store.verify_result(place)
            except (IntegrityError, InputError):
                log.warn(f"{place} is damaged and is made again")
                shutil.rmtree(place)
                return None
            return place
        try:
            upload = self._published.uploaded()
            if upload is None or not upload.complete:
                return None
            self._published.fetch(self._result)
        except MudgError as error:
            log.warn(f"{self._published} cannot be used: {error.what}")
            if self._unpublished is None:
                self._remove()
            return None
        return self._result

    def _prepare(self) -> None:
        """Make the folder, with what earlier attempts left, and stage in what the command reads."""
        self._take_over()
        store.make_folder(self._path)
        for name, key in self._unit.needs.items():
            place = self._job.folder.out / f"{self._unit.entry.name}/{name}/{key[:12]}"
            local = place.local
            if local is None:
                local = self._job.work_root / f"{key}.input"
                if not local.exists():
                    place.fetch(local)
                self._held.callback(shutil.rmtree, local, True)
            self._link(local, f"inputs/{name}")
        source = self._unit.entry.source
        if "{source}" in " ".join(self._unit.stage.words) and "://" in source:
            place = Location.of(source)
            self._link(self._hold(place, self._unit.entry.settings.get(REVISION, "")), f"source/{place.name}")
        if self._unit.stage.settings:
            text = yaml.safe_dump(self._with_fetched(self._unit.stage.settings), sort_keys=False)
            store.write_in_tree(self._path / _SETTINGS, text.encode())

    def _take_over(self) -> None:
        """Rename what an earlier attempt left, so that one that only seemed to be dead cannot publish it."""
        left = sorted(self._job.work_root.glob(f"{self._unit.key}.*-*"), key=lambda path: path.name != self._path.name)
        for one in left:
            with contextlib.suppress(OSError):  # others do so at the same moment
                if one != self._path and self._path.exists():
                    shutil.rmtree(one, ignore_errors=True)
                elif one != self._path:
                    one.rename(self._path)
                    for lock in self._path.rglob("lock"):  # of a run on a machine that may be gone
                        lock.unlink(missing_ok=True)
        partial = self._job.folder.partial(self._unit.key)
        if not self._in_output and not self._path.exists() and partial.exists():
            try:
                partial.fetch(self._result)
            except MudgError as error:
                log.warn(f"{self._unit.title}: what an earlier attempt made cannot be used: {error.what}")
                shutil.rmtree(self._path, ignore_errors=True)

    def _hold(self, source: Location, version: str, keep: bool = False) -> Path:
        return self._held.enter_context(self._job.inputs.held(source, version, self._stop, keep=keep))

    def _link(self, local: Path, name: str) -> None:
        link = self._path / name
        store.make_folder(link.parent)
        if link.is_symlink():  # of an earlier attempt
            link.unlink()
        link.symlink_to(os.path.abspath(local))

    def _with_fetched(self, settings: Mapping[str, Any]) -> dict[str, Any]:
        """Settings with names below the work folder for addresses; weights are fetched once for a machine."""
        values: dict[str, Any] = {}
        for name, value in settings.items():
            if isinstance(value, Mapping):
                values[name] = self._with_fetched(value)
            elif isinstance(value, str) and (match := _ADDRESS.match(value)):
                source = Location.of(f"{match[1]}://{value[match.end() :]}")
                values[name] = f"weights/{hashlib.sha256(str(source).encode()).hexdigest()[:8]}/{source.name}"
                self._link(self._hold(source, "", keep=True), values[name])
            else:
                values[name] = value
        return values

    def _publish(self) -> None:
        """Bring the result to its place in the output. Another attempt's result of the same key is as good."""
        place = self._published
        if not self._in_output or place.local is None:
            place.push(self._result)
            # it stays for the next step
            if any(self._unit.stage.name in stage.needs for stage in self._job.plan.stages):
                kept = self._job.work_root / f"{self._unit.key}.input"
                self._held.callback(shutil.rmtree, kept, True)
                with contextlib.suppress(OSError):
                    self._result.rename(kept)
            return
        store.make_folder(place.local.parent)
        try:
            self._result.rename(place.local)
        except OSError as error:
            if not place.local.exists():
                what = "the result cannot be moved to its place"
                raise ResourceError(what, where=str(place), got=str(error)) from error
        store.fsync_directory(place.local.parent)

    def _leave(self) -> None:
        """Keep an unfinished result for the next attempt, on whatever machine it is."""
        if not self._result.is_dir():
            self._remove()
        elif not self._in_output:
            with contextlib.suppress(MudgError):
                self._job.folder.partial(self._unit.key).push(self._result)
                shutil.rmtree(self._path, ignore_errors=True)

    def _remove(self) -> None:
        shutil.rmtree(self._path, ignore_errors=True)
        partial = self._job.folder.partial(self._unit.key)
        with contextlib.suppress(MudgError):
            if not self._in_output and partial.exists():
                partial.remove()

    # ends -----------------------------------------------------------------------------------------

    def _ended(self, state: str, ending: Ending, **more: Any) -> Ended:
        unit, times = self._unit, {"ended": time.time(), "lost_s": self._lost_s}
        times |= {"seconds": ending.seconds, "processor_s": ending.processor_s}
        what: dict[str, Any] = {"scene": unit.entry.name, "stage": unit.stage.name, "source": unit.entry.source}
        what |= {"key": unit.key, "place": unit.place, "host": socket.gethostname()} | more
        what |= {name: round(value, 3) for name, value in times.items()}
        return Ended(state=state, code=ending.code, words=ending.words[:2000], **what)

    def _record(self, result: Path, ending: Ending) -> Ended:
        facts: dict[str, Any] = {"digest": digest_of(result), "written_bytes": folder_bytes(result)}
        return self._ended(DONE, ending, **facts, peak_bytes=peak_of(result))

    def _fail(self, ending: Ending) -> Ended:
        record = self._ended(FAILED, replace(ending, processor_s=0.0))
        self._remove()
        if ending.text:
            self._job.folder.log(self._unit.key).save(ending.text.encode())
        self._job.folder.end("failed", record)
        return record


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
