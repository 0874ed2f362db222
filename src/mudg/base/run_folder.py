"""The output folder of a verb: made, continued, reused, or replaced, and never at the cost of anything else.

A folder is finished when its manifest verifies and its key (verb, version, configuration, hashes of the inputs) is the
one asked for. A finished folder of another key is replaced only on demand, and only when the new result is finished:
until then that is made in a folder beside it.
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
import json
import os
import re
import shutil
import socket
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any

from mudg.base import log, store
from mudg.base.config import differences
from mudg.base.errors import InputError, IntegrityError, ResourceError, UsageError
from mudg.base.memory import Meter, Usage, folder_bytes
from mudg.base.processes import process_alive
from mudg.base.records import ForeignRecord, Number, parse_record
from mudg.base.store import all_names

# replacement --------------------------------------------------------------------------------------

OwnNames = Callable[[Path], Sequence[str]]
"""Folder -> relative names of the files in it that belong to the result, in the order in which they may be removed:
those last that the function itself reads. All other files belong to somebody else."""


class Replacement:
    """The folder that a path names or links to, and whose content is replaced as a whole by one that is made beside it:
    ``.NAME.new.part`` (``staging``). The old content is ``.NAME.old.part`` (``retired``) from the moment the new one
    has its name until the files of the old result are removed; those of somebody else move to the new folder."""

    def __init__(self, path: Path) -> None:
        self.folder = Path(os.path.realpath(path))
        self.staging, self.retired = store.staging_path(self.folder), store.retired_path(self.folder)

    def begin(self) -> Path:
        """Make the staging folder, or take up the one that is there. ResourceError: a mount point, or it cannot be
        made."""
        if os.path.ismount(self.folder):
            remedy = "choose an --out inside it"
            raise ResourceError("a mount point cannot be replaced", where=str(self.folder), remedy=remedy)
        with store.disk_errors("the new result cannot be made beside the old one", self.folder.parent):
            self.staging.mkdir(exist_ok=True)
        return self.staging

    def swap(self, own_names: OwnNames) -> None:
        """Put the finished staging folder in the place of the folder, and remove the old result. ResourceError: a
        folder cannot be renamed; old and new content are both still there."""
        try:
            if self.folder.exists():
                self.folder.rename(self.retired)
            self.staging.rename(self.folder)
        except OSError as error:
            if self.retired.exists() and not self.folder.exists():
                self.retired.rename(self.folder)
            what = "the new result cannot take the place of the old one"
            remedy = f"it is finished and lies in {self.staging}; repeat the command, or move it"
            raise ResourceError(what, where=str(self.folder), got=str(error), remedy=remedy) from error
        store.fsync_directory(self.folder.parent)
        self._remove_retired(own_names)

    def recover(self, is_finished: Callable[[Path], bool], own_names: OwnNames) -> None:
        """Complete, or undo, a ``swap`` that was cut off by a crash. is_finished: whether a folder holds a finished,
        unaltered result. UsageError: old and new content lie side by side in a way that no crash leaves."""
        if not self.retired.is_dir():
            return
        if self.folder.is_dir() and not any(self.folder.iterdir()):
            self.folder.rmdir()
        if not self.folder.exists():
            if not is_finished(self.staging):
                self.retired.rename(self.folder)
                log.warn(f"{self.folder}: the old result is back; replacing it was cut off")
                return
            self.staging.rename(self.folder)
            store.fsync_directory(self.folder.parent)
        elif self.staging.exists() or not is_finished(self.folder):
            what = "a cut-off replacement and another folder are in each other's way"
            remedy = "move one of them elsewhere"
            raise UsageError(what, where=str(self.folder), got=f"the replaced result in {self.retired}", remedy=remedy)
        log.warn(f"{self.folder}: finished replacing the old result, which had been cut off")
        self._remove_retired(own_names)

    def _remove_retired(self, own_names: OwnNames) -> None:
        if not self.retired.is_dir():
            return
        own = own_names(self.retired)
        remedy = f"the new one is in place; move what you need from here to {self.folder}"
        with store.disk_errors("the old result cannot be removed", self.retired, remedy):
            kept = [self._hand_over(name) for name in sorted(set(all_names(self.retired)) - set(own))]
            remove_files(self.retired, own)
            self.retired.rmdir()
        if kept:
            more = f" and {len(kept) - 8} more" if len(kept) > 8 else ""
            log.warn(f"{self.folder}: kept files that are not of the old result: {', '.join(kept[:8])}{more}")

    def _hand_over(self, name: str) -> str:
        """Move somebody else's file from the old folder to the new one; returns its name there."""
        target, number = name, 0
        while os.path.lexists(self.folder / target):
            number += 1
            target = f"{name}.kept{number}"
        (self.folder / target).parent.mkdir(parents=True, exist_ok=True)
        (self.retired / name).rename(self.folder / target)
        return target


def remove_files(folder: Path, names: Sequence[str]) -> None:
    """Remove files of a folder in this order, and then the sub-folders that are empty."""
    for name in names:
        (folder / name).unlink(missing_ok=True)
    for place, _, _ in os.walk(folder, topdown=False):
        if Path(place) != folder:
            with contextlib.suppress(OSError):  # not empty: somebody else's
                Path(place).rmdir()


# run folder ---------------------------------------------------------------------------------------

fcntl: Any
try:
    import fcntl
except ImportError:  # Windows
    fcntl = None

_STATE, _SETTINGS, _LOCK, _LOG = store.RUN_STATE, "run.yaml", "lock", store.RUN_LOG
_BOARD = "tensorboard/events.out.tfevents.*"
"""What ``RunDir.watch`` writes."""
_BEGUN = frozenset({_STATE, _SETTINGS, _LOCK})
"""What a run folder holds before anything is made."""
_BOOKKEEPING = _BEGUN | {_LOG, store.MANIFEST}
_TEMPORARY = re.compile(r"\..+\.([a-z0-9_]{8}\.part(\..*)?|\d+-\d+\.part)")
"""Names under which files and scenes are written before they get their own; a killed run leaves some."""
_LONGEST_NAME, _LONGEST_PATH = 230, 3800
"""Bytes: what file systems take (255 and 4096), less what temporary names and files inside the folder add."""


def refuse_overlap(out: Path | str, inputs: Mapping[str, Path | str | None]) -> None:
    """UsageError for an output that is, holds or lies in an input, or that cannot be. To be called before anything is
    written. Links, ``..`` and, where the file system does not tell them apart, upper and lower case make no difference.
    inputs: name for messages -> file or folder that is read (None or empty: not given)."""
    _refuse_impossible(out)
    line_out = _line_of(Path(out))
    for name, given in inputs.items():
        if given is None or not str(given):
            continue
        line = _line_of(Path(given))
        if line_out[0] in line:
            relation = "is also" if line_out[0] == line[0] else "holds"
        elif line[0] in line_out:
            relation = "lies in"
        else:
            continue
        what, where, got = f"the output {relation} an input", f"output: {out}", f"{name}: {given}"
        raise UsageError(what, where=where, got=got, remedy="choose an output apart from everything that is read")


def _refuse_impossible(out: Path | str) -> None:
    """UsageError for a path under which no folder can be made, whatever is on the disk."""
    text = str(out)
    if "\0" in text:
        raise UsageError("the output's name holds a zero byte", where=repr(text)[:200])
    real = os.path.realpath(text)
    longest = max(len(os.fsencode(part)) for part in (*Path(text).parts, Path(real).name, "."))
    if longest > _LONGEST_NAME or len(os.fsencode(real)) > _LONGEST_PATH:
        what, got = "the output's name is too long", f"{longest} and {len(os.fsencode(real))} bytes"
        expected = f"names of at most {_LONGEST_NAME} bytes, paths of at most {_LONGEST_PATH}"
        raise UsageError(what, where=f"{text[:120]}...", got=got, expected=expected, remedy="choose a shorter --out")
    above = next((one for one in Path(real).parents if os.path.lexists(one)), None)
    if above is not None and not above.is_dir():
        remedy = "choose another --out"
        raise UsageError("the output lies below something that is no folder", where=text, got=str(above), remedy=remedy)


def _line_of(path: Path) -> list[object]:
    """What identifies a path, then each folder above it: the file system's own number, else the name."""
    real, found = Path(os.path.realpath(path)), list[object]()
    for one in (real, *real.parents):
        facts = None
        with contextlib.suppress(OSError):
            facts = one.stat()
        found.append((facts.st_dev, facts.st_ino) if facts and facts.st_ino else os.path.normcase(one))
    return found


class _State(ForeignRecord):
    """What is read of ``run.json``."""

    verb: str
    key: str
    state: str
    inputs: dict[str, str] = {}
    files: list[str] = []
    seconds: Number = 0.0
    processor_s: Number = 0.0
    peak_bytes: int | None = None


@dataclass(frozen=True)
class VerbOutput:
    """What a verb writes. version: counts up when its rules change; older results are then made again. files: names of
    its files, relative to the folder, as patterns: ``*`` stands for any part of one name, and a ``/`` at the end for
    everything below. A file that matches none belongs to somebody else: it is not listed and never removed."""

    verb: str
    version: int
    files: tuple[str, ...]


def _matches(name: str, patterns: Sequence[str]) -> bool:
    parts = name.split("/")
    for pattern in patterns:
        wanted = pattern.rstrip("/").split("/")
        length = len(parts) > len(wanted) if pattern.endswith("/") else len(parts) == len(wanted)
        if length and all(map(fnmatchcase, parts, wanted)):
            return True
    return False


def is_temporary(name: str) -> bool:
    """Whether a relative name is one that this program gives while it writes."""
    return any(_TEMPORARY.fullmatch(part) for part in name.split("/"))


def run_state(folder: Path) -> dict[str, Any]:
    """What ``run.json`` says; empty if nothing is in the folder. UsageError: it holds something else than a run."""
    what, empty = "the output folder holds files of something else", "choose an empty --out"
    refused = UsageError(what, where=str(folder), remedy=empty)
    if not folder.is_dir():
        if not os.path.lexists(folder):
            return {}
        got, remedy = "a device, pipe or socket", "choose the name of a folder that does not exist yet"
        if not folder.exists():
            got = f"a link that leads nowhere: {os.readlink(folder)}"
        elif folder.is_file():
            got = "a file"
        raise UsageError("the output is no folder", where=str(folder), got=got, remedy=remedy)
    if not (folder / _STATE).is_file():
        for entry in folder.iterdir():  # but for the lock of a run that was killed before it wrote anything else
            if not is_temporary(entry.name) and not (entry.name == _LOCK and _owner(entry) is not None):
                raise refused
        return {}
    try:
        state = store.read_json(folder / _STATE)
        parse_record(_State, state, str(folder / _STATE))
    except InputError as error:
        raise refused from error
    if state.get("schema") != store.RUN_SCHEMA:
        raise refused
    return dict(state)


def known_input(folder: Path, name: str) -> Path | None:
    """Where an input of a result lies, as seen from the result or from the root; None if unknown, gone or changed."""
    with contextlib.suppress(InputError, KeyError, TypeError, IndexError):
        state = store.read_json(folder / _STATE)
        places, digest = state["paths"][name], state["inputs"][name]
        places = (place for place in (folder / places[0], Path(places[1])) if place.exists())
        return next((place for place in places if store.digest(place) == digest), None)
    return None


def _owner(lock: Path) -> tuple[int, str] | None:
    """Process and machine that hold a lock; None where there is none, or something else."""
    with contextlib.suppress(InputError, KeyError, TypeError, ValueError):
        owner = store.read_json(lock) if lock.is_file() else {}
        return int(owner["pid"]), str(owner["host"])
    return None


def own_names(output: VerbOutput, folder: Path) -> list[str]:
    """Names of the files in a run folder that the run made, the bookkeeping last: those that its manifest lists, of an
    unfinished one those that its verb may write. output: speaks for an unfinished run of its verb."""
    try:
        state = run_state(folder)
    except UsageError:
        return []
    listed: Collection[str] = store.json_object(folder / store.MANIFEST).get("files") or ()
    patterns = state.get("files", output.files if state.get("verb") == output.verb else ())
    finished = state.get("state") == "complete" and listed

    def is_own(name: str) -> bool:
        if name in _BOOKKEEPING or name in listed or is_temporary(name) or fnmatchcase(name, _BOARD):
            return True
        return (not finished or ".part" in name) and _matches(name, patterns)  # no manifest lists temporary folders

    own = [name for name in all_names(folder) if is_own(name)]
    return sorted(own, key=lambda name: (name in _BOOKKEEPING, name == _STATE))


def _is_finished(folder: Path) -> bool:
    with contextlib.suppress(UsageError, InputError, IntegrityError):
        if run_state(folder).get("state") == "complete":
            store.verify_result(folder)
            return True
    return False


# a verb's output folder ---------------------------------------------------------------------------


class RunDir:
    """The output folder of one verb: resolved configuration, state, log, manifest, lock.

    ``run.yaml`` is enough to repeat the run; ``run.json`` names verb, key, inputs and state. A verb writes below
    ``path``. That is ``out``, or a folder beside it while ``out`` still holds the result that is to be replaced; from
    ``finish`` on it is ``out``.
    """

    def __init__(
        self, out: Path, path: Path, output: VerbOutput, key: str, inputs: Mapping[str, str], *, complete: bool = False
    ) -> None:
        self.out, self.path, self.verb, self.key, self.inputs = out, path, output.verb, key, dict(inputs)
        self.complete = self._ended = complete
        self.fresh = not path.is_dir() or not any(path.iterdir())
        """Whether nothing was in the folder when it was opened."""
        self._output, self._made_folder, self._meter = output, path != out or not path.is_dir(), Meter()
        self._earlier = Usage()
        """What earlier, interrupted runs of this same key have taken."""
        self._paths: dict[str, list[str]] = {}
        self._board: Any = None

    @classmethod
    def open(
        cls,
        path: Path,
        output: VerbOutput,
        config: Mapping[str, Any],
        inputs: Mapping[str, str],
        overwrite: bool = False,
        paths: Mapping[str, Path | None] | None = None,
    ) -> RunDir:
        """Open ``path`` for this verb, configuration and inputs. Call ``refuse_overlap`` first.

        ``complete`` is True when an earlier run with the same key finished and its manifest verifies: the verb then
        returns at once. An unfinished run with the same key is continued, also one that is to replace another result.
        inputs: name -> digest of what is read. paths: name -> where it lies, for who asks the result later
        (`known_input`). overwrite: replace a result of another key, or one that was altered, as soon as the new one is
        finished. UsageError: the folder holds the output of another verb or configuration, or files of somebody else.
        IntegrityError: the finished result was altered. ResourceError: it cannot be written, or another live process
        is working in it."""
        out, values = Path(path), [output.verb, output.version, dict(config), dict(inputs)]
        key = hashlib.sha256(store.json_text(values, indent=None).encode()).hexdigest()
        own, replacement = functools.partial(own_names, output), Replacement(out)
        replacement.recover(_is_finished, own)
        state, staged = run_state(out), run_state(replacement.staging)
        same = state.get("key") == key
        if same and state["state"] == "complete" and _verified(out, overwrite):
            if staged:
                log.info(f"{output.verb}: {replacement.staging} holds an unfinished replacement of {out}")
            _drop_lock_of_the_dead(out / _LOCK)
            return cls(out, out, output, key, inputs, complete=True)
        in_the_way = (not same or state["state"] == "complete") and out.is_dir()
        # a run that failed before it made anything (a mistyped flag) left its bookkeeping alone
        in_the_way = in_the_way and any(e.name not in _BEGUN and not is_temporary(e.name) for e in out.iterdir())
        if in_the_way and not overwrite:
            _refuse_other(out, output.verb, config, inputs, state)
        work = out
        if in_the_way or (staged.get("key") == key and not same):
            work = replacement.staging
            for folder in (out, work):
                refuse_while_others_work(folder / _LOCK)
            if staged and staged["key"] != key:
                log.info(f"{output.verb}: the unfinished replacement of {out} with other settings is given up")
                remove_files(work, own(work))
            replacement.begin()
        run = cls(out, work, output, key, inputs)
        known = {name: path for name, path in (paths or {}).items() if path}
        run._paths = {name: [os.path.relpath(path, out), str(path.absolute())] for name, path in known.items()}
        seen = state if work == out else run_state(work)
        if work != out and staged.get("key") == key and _is_finished(work):
            _drop_lock_of_the_dead(work / _LOCK)
            run._take_place()
            run.complete = True
            return run
        run._begin(config, seen)
        if work != out:
            log.info(f"{output.verb}: {out} stays as it is until the new result is finished; that is made in {work}")
        return run

    def _begin(self, config: Mapping[str, Any], seen: Mapping[str, Any]) -> None:
        """Lock the folder and write down what is made in it. seen: its record when it was opened."""
        import yaml

        take_lock(self.path / _LOCK)
        if run_state(self.path) != seen:
            (self.path / _LOCK).unlink(missing_ok=True)
            what = "another process has worked in this folder meanwhile"
            raise ResourceError(what, where=str(self.path), remedy="repeat the command")
        self._earlier = Usage.of_record(seen) if seen.get("key") == self.key else Usage()
        self._write_state("running", {})
        values = {"verb": self.verb, **json.loads(store.json_text(dict(config)))}
        store.write_text(self.path / _SETTINGS, yaml.safe_dump(values, sort_keys=False))

    def _write_state(self, state: str, summary: Mapping[str, Any]) -> None:
        from mudg.base.versions import environment

        if state != "running":
            self._meter.stop()
        spent = self._earlier.then(self._meter.usage()).record()
        own = sum(folder_bytes(self.path / name) for name in (_STATE, _LOCK))  # the first holds the size
        values = {"schema": store.RUN_SCHEMA, "verb": self.verb, "key": self.key, "inputs": self.inputs, "state": state}
        values |= {**spent, "written_bytes": folder_bytes(self.path) - own, "files": list(self._output.files)}
        values |= {"environment": environment(), "summary": dict(summary)}
        values |= {"paths": self._paths} if self._paths else {}
        store.write_json(self.path / _STATE, store.sealed(values, self.path) if state == "complete" else values)

    def log(self, **fields: Any) -> None:
        """Append one JSON line to log.jsonl; its numbers go to TensorBoard, too, if it is watched."""
        store.append_line(self.path / _LOG, store.json_text(fields, indent=None))
        if self._board is not None:
            for name, value in fields.items():
                if name != "step" and isinstance(value, int | float):
                    self._board.add_scalar(f"{self._output.verb}/{name}", value, fields.get("step"))
            self._board.flush()

    def watch(self) -> None:
        """Write what is logged from now on to ``tensorboard/``, too. No result depends on it, and no manifest lists
        it."""
        from torch.utils.tensorboard import SummaryWriter

        self._board = SummaryWriter(str((self.path / _BOARD).parent))

    def pause(self, summary: Mapping[str, Any] | None = None) -> None:
        """Record an interruption, once: the time spent is kept, the lock released; the same command continues."""
        if self._ended:
            return
        self._ended = True
        self._write_state("interrupted", summary or {})
        (self.path / _LOCK).unlink(missing_ok=True)

    def discard(self) -> None:
        """Remove what this unfinished run made, and the folder if the run made it and nothing else is in it."""
        self._ended = True
        with contextlib.suppress(OSError):  # an error brought us here, and that one is to be told
            remove_files(self.path, own_names(self._output, self.path))
            if self._made_folder:
                self.path.rmdir()

    def finish(self, summary: Mapping[str, Any] | None = None) -> None:
        """Mark the folder complete: write the manifest, release the lock, and take the place of what is to be
        replaced."""
        remove_files(self.path, list(filter(is_temporary, all_names(self.path))))  # of runs that were killed
        if self._board is not None:
            self._board.close()
        names = [n for n in store.list_files(self.path) if n not in (_LOG, _STATE) and not fnmatchcase(n, _BOARD)]
        own = [name for name in names if name == _SETTINGS or _matches(name, self._output.files)]
        if others := sorted(set(names) - set(own)):
            log.warn(f"{self.path} holds files that {self.verb} did not make: {', '.join(others[:8])}")
        store.write_manifest(self.path, own)
        self._ended = True
        self._write_state("complete", summary or {})
        (self.path / _LOCK).unlink(missing_ok=True)
        if self.path != self.out:
            self._take_place()
        self.complete = True

    def _take_place(self) -> None:
        Replacement(self.out).swap(functools.partial(own_names, self._output))
        self.path = self.out

    def reused(self) -> Path:
        """Say that an earlier result is used again, and return its path."""
        log.info(f"{self.verb}: reused {self.path} (verified)")
        return self.path


def _verified(path: Path, overwrite: bool) -> bool:
    try:
        store.verify_result(path)
    except IntegrityError as error:
        if overwrite:
            return False
        fields = {**error.fields, "remedy": "add --overwrite to make it again, or choose another --out"}
        raise IntegrityError(error.what, **fields) from error
    return True


def _refuse_other(
    path: Path, verb: str, config: Mapping[str, Any], inputs: Mapping[str, str], state: Mapping[str, Any]
) -> None:
    from mudg.base.plain_yaml import parse_yaml

    found = [] if state["verb"] == verb else [f"verb {state['verb']!r} instead of {verb!r}"]
    old_inputs = state.get("inputs", {})
    found += [f"input {name!r} changed" for name in inputs if old_inputs.get(name) != inputs[name]]
    with contextlib.suppress(InputError):
        old = parse_yaml(store.read_bytes(path / _SETTINGS), str(path / _SETTINGS)) or {}
        found += differences(old, {"verb": verb, **json.loads(store.json_text(dict(config)))})
    what = "the output folder holds the result of another configuration"
    got = "; ".join(found[:8]) or "another program version"
    raise UsageError(what, where=str(path), got=got, remedy="choose another --out, or add --overwrite to replace it")


def _drop_lock_of_the_dead(lock: Path) -> None:
    """Remove the lock of a run that was killed after it had finished its work."""
    owner = _owner(lock)
    if owner is not None and owner[1] == socket.gethostname() and not process_alive(owner[0]):
        with contextlib.suppress(OSError):
            lock.unlink(missing_ok=True)


@contextlib.contextmanager
def locked(lock: Path, what: Path | None = None) -> Iterator[None]:
    """``take_lock`` for this block."""
    take_lock(lock, what)
    try:
        yield
    finally:
        with contextlib.suppress(OSError):  # that of a dead process is in nobody's way
            lock.unlink(missing_ok=True)


def take_lock(lock: Path, what: Path | None = None) -> None:
    """Write this process into a lock: that of a file ``what``, else of the folder in which the lock lies. Of several
    that try at the same moment one succeeds. ResourceError: another live process of this machine holds it."""
    store.make_folder(lock.parent)
    folder = os.open(lock.parent, os.O_RDONLY) if fcntl is not None else -1
    try:
        if fcntl is not None:
            with contextlib.suppress(OSError):  # a file system without locks
                fcntl.flock(folder, fcntl.LOCK_EX)
        refuse_while_others_work(lock, what)
        store.write_json(lock, {"pid": os.getpid(), "host": socket.gethostname()})
    finally:
        if fcntl is not None:
            os.close(folder)


def refuse_while_others_work(lock: Path, what: Path | None = None) -> None:
    """ResourceError if the process that wrote this lock still runs on this machine."""
    pid, host = _owner(lock) or (os.getpid(), "")
    if pid != os.getpid() and host == socket.gethostname() and process_alive(pid):
        busy = "writing this file" if what else "working in this folder"
        got = f"pid {pid} on {host}"
        remedy = f"wait for it, or choose another --out; if it is no longer running, delete {lock}"
        raise ResourceError(f"another process is {busy}", where=str(what or lock.parent), got=got, remedy=remedy)


# result file --------------------------------------------------------------------------------------
# Beside the file OUT (or a second form of it, such as the folder of a large page) lies OUT.json, its description: verb,
# key of settings and inputs, SHA-256, and what else the verb says. The description gets its name first and the file its
# last, so that the same command completes what a stop leaves in between.


def description_path(out: Path) -> Path:
    """The file beside an output that says what it is."""
    return out.with_name(f"{out.name}.json")


class ResultFile:
    """The output file of one verb, for this process alone. Make it at ``staged(form)``, then call ``finish``.
    ``complete``: the same command has finished before and the file is as it was written."""

    def __init__(self, out: Path, verb: str, key: str, forms: Sequence[Path]) -> None:
        self.out, self.verb, self.key, self.complete = out, verb, key, False
        self._forms, self._lock = tuple(forms) or (out,), out.with_name(f".{out.name}.lock")
        self.path = self.staged()
        """Where the file is made."""

    @classmethod
    @contextlib.contextmanager
    def open(
        cls,
        out: Path,
        verb: str,
        settings: Mapping[str, Any],
        inputs: Mapping[str, str],
        *,
        forms: Sequence[Path] = (),
        overwrite: bool = False,
    ) -> Iterator[ResultFile]:
        """Hold the output of a verb. Call ``refuse_overlap`` first. inputs: name -> digest of what is read. forms:
        where the result may lie (none: at ``out``). overwrite: replace what is there. UsageError: another result, or
        somebody else's file, is there. IntegrityError: the finished result was altered. ResourceError: it cannot be
        written, or another live process is writing it."""
        key = hashlib.sha256(store.json_text([verb, dict(settings), dict(inputs)], indent=None).encode()).hexdigest()
        result = cls(Path(out), verb, key, forms)
        with locked(result._lock, out):
            try:
                result._examine(overwrite)
                yield result
            finally:
                result._tidy()

    def staged(self, form: Path | None = None) -> Path:
        """Where the content of a form is made."""
        form = form or self.out
        return form.with_name(f".{form.name}.new.part{form.suffix}")

    def finish(self, about: Mapping[str, Any], form: Path | None = None) -> Path:
        """Give what was made its description, and its name; returns where it lies."""
        form = form or self.out
        values = {"schema": 1, "verb": self.verb, "key": self.key, "file": form.name}
        values |= {"sha256": store.digest(self.staged(form)), **about}
        with store.disk_errors("the result cannot get its name", form):
            store.write_json(description_path(self.out), values)
            for one in self._forms:
                if one.is_dir():
                    shutil.rmtree(one)
                elif one != form:
                    one.unlink(missing_ok=True)
            self.staged(form).replace(form)
            store.fsync_directory(form.parent)
        return form

    def reused(self) -> Path:
        """Say that an earlier result is used again, and return where it lies."""
        form = next(filter(os.path.lexists, self._forms))
        log.info(f"{self.verb}: reused {form} (verified)")
        return form

    def description(self) -> dict[str, Any]:
        """What ``OUT.json`` says; empty where it is missing or somebody else's."""
        found = store.json_object(description_path(self.out))
        return found if all(isinstance(found.get(name), str) for name in ("verb", "key", "file", "sha256")) else {}

    def _examine(self, overwrite: bool) -> None:
        about, file = self.description(), description_path(self.out)
        if os.path.lexists(self.out) and not self.out.is_file():
            got, remedy = "not a regular file", "choose another --out"
            raise ResourceError("cannot write here", where=str(self.out), got=got, remedy=remedy)
        there = [one for one in self._forms if os.path.lexists(one)]
        if about.get("key") == self.key and [one.name for one in there] == [about["file"]]:
            self.complete = store.digest(there[0]) == about["sha256"]
            if not (self.complete or overwrite):
                what = "a file was altered after it was written"
                remedy = "add --overwrite to make it again, or choose another --out"
                raise IntegrityError(what, where=str(there[0]), expected=f"sha256 {about['sha256']}", remedy=remedy)
        elif not overwrite and (there or (os.path.lexists(file) and not about)):
            got = "a result of other settings or inputs" if about else "a file of something else"
            remedy = "choose another --out, or add --overwrite"
            raise UsageError("the file exists", where=str([*there, file][0]), got=got, remedy=remedy)

    def _tidy(self) -> None:
        """Remove what this and earlier, killed commands left: no other is at work here."""
        targets = (*self._forms, description_path(self.out), self._lock)
        names = [re.escape(f".{one.stem}.") + r"[a-z0-9_]{8}\.part" + re.escape(one.suffix) for one in targets]
        names += [rf"\.?{re.escape(self.staged(one).name.removesuffix(one.suffix))}.*" for one in self._forms]
        left = re.compile("|".join(names))
        with contextlib.suppress(OSError):  # an error may have brought us here, and that one is to be told
            for one in [one for one in self.out.parent.iterdir() if left.fullmatch(one.name)]:
                shutil.rmtree(one) if one.is_dir() and not one.is_symlink() else one.unlink()
