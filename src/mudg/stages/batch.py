"""One verb over many scenes: ``mudg ingest|annotate|fuse --list FILE --out ROOT [--shard i/n] [--jobs N]``.

Every scene is a process of its own and writes the folder ROOT/<name>. A finished one is verified and reused, so the same
command can be repeated until nothing fails; one that fails is reported with its reason, and the others go on.
"""

from __future__ import annotations

import io
import json
import multiprocessing
import os
import re
import shlex
import signal
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import Any, Final

from mudg import native
from mudg.base import failures, log, processes, store
from mudg.base.errors import InputError, UsageError
from mudg.base.run_folder import refuse_overlaps
from mudg.data.scene.schema import NAME_PATTERN

FAILED_BASE: Final = 10
"""Exit code of n failed scenes: this plus n, at most ``FAILED_MOST``; apart from all codes with a meaning of their own."""
FAILED_MOST: Final = 99
_STATUS_FILE: Final = re.compile(r"status(-\d+-of-\d+)?\.json")

Work = Callable[["Entry", Path, bool], Path]
"""(entry, output folder, overwrite) -> the folder; a function of a module, since it is called in another process."""


@dataclass(frozen=True, slots=True)
class Entry:
    """One line of a list: the source, the name of its output folder, and settings of its own (``sequence``, ``frames``, ...)."""

    name: str
    source: str
    settings: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Outcome:
    """What became of a scene: ``done``, ``reused`` or ``failed``, with one line of what it holds or why it failed."""

    name: str
    source: str
    state: str
    seconds: float
    words: str
    error: str = ""


# --- the list -----------------------------------------------------------------------------------------------------------


def read_list(path: Path, settings: Sequence[str] = ()) -> list[Entry]:
    """Entries of a list file, or one for each entry of a folder (but for what an earlier run over a list wrote there).

    A line is ``SOURCE [name=NAME] [setting=value ...]``, quoted as in a shell; ``#`` starts a comment. Relative sources count
    from the list's folder. Without a name, the last part of the source is taken.

    Args:
        settings: settings a line may give.

    Raises:
        InputError: missing, empty, malformed, or two lines that would write one folder.
    """
    if path.is_dir():
        lines = [
            (str(entry), shlex.quote(entry.name))
            for entry in sorted(path.iterdir())
            if not entry.name.startswith(".") and not _STATUS_FILE.fullmatch(entry.name)
        ]
        folder = path
    else:
        text = store.read_bytes(path).decode("utf-8", "replace")
        lines = [(f"{path}: line {index + 1}", line) for index, line in enumerate(text.splitlines())]
        folder = path.parent
    entries = [entry for where, line in lines if (entry := _entry(line, where, folder, settings)) is not None]
    if not entries:
        raise InputError("the list is empty", where=str(path), expected="one source per line")
    sources: dict[str, str] = {}
    for entry in entries:
        if entry.name in sources:
            raise InputError(
                "two entries would write the same folder", where=str(path), got=f"{sources[entry.name]} and {entry.source}",
                remedy=f"give one of them another name: SOURCE name={entry.name}-2",
            )  # fmt: skip
        sources[entry.name] = entry.source
    return entries


def _entry(line: str, where: str, folder: Path, settings: Sequence[str]) -> Entry | None:
    try:
        words = shlex.split(line, comments=True)
    except ValueError as error:
        raise InputError("cannot parse the line", where=where, got=line[:80]) from error
    if not words:
        return None
    given: dict[str, str] = {}
    for word in words[1:]:
        key, separator, value = word.partition("=")
        if not separator or key not in ("name", *settings):
            raise InputError(
                "unknown setting in the line", where=where, got=word[:80],
                expected=", ".join(f"{key}=..." for key in ("name", *settings)),
                remedy="put quotes around a path with spaces")  # fmt: skip
        given[key] = value
    source = words[0] if words[0] == "city" else str(folder / Path(words[0]).expanduser())
    name = given.pop("name", "") or Path(source).name.removesuffix(".zip")
    if not NAME_PATTERN.fullmatch(name):
        raise InputError("name cannot be a folder name", where=where, got=name[:80], remedy="add name=NAME to the line")
    return Entry(name, source, given)


def shard(entries: list[Entry], text: str) -> list[Entry]:
    """Every n-th entry from the i-th on, for ``"i/n"`` with i from 0 to n - 1; an empty text takes all.

    Raises:
        UsageError: not of this form.
    """
    if not text:
        return entries
    first, separator, count = text.partition("/")
    if not separator or not first.isdigit() or not count.isdigit() or not int(first) < int(count):
        raise UsageError(
            "invalid shard", where="--shard", expected="i/n with i from 0 to n-1, e.g. 0/4", got=text
        )
    return entries[int(first) :: int(count)]


# --- running ------------------------------------------------------------------------------------------------------------


def run_batch(
    verb: str,
    entries: list[Entry],
    out: Path,
    work: Work,
    *,
    jobs: int = 0,
    overwrite: bool = False,
    shard_text: str = "",
    listed: Path | None = None,
) -> dict[str, Any]:
    """Do ``work`` for every entry, ``jobs`` processes at a time.

    Args:
        verb: for messages.
        out: ROOT; ``ROOT/status.json`` (with a shard: ``status-i-of-n.json``) tells the outcome.
        jobs: processes; 0 = as many as there are processors. They share the processors.
        overwrite: replace results of other settings.
        listed: the list, where it is a file.

    Returns:
        ``scenes`` (one record each), counts, ``text``: the table for people, and ``exit_code``: 0, or 10 plus the number of
        failed scenes, at most 99.

    Raises:
        UsageError: ``jobs`` is negative; an output touches a source, or the status another file. KeyboardInterrupt: the
            running scenes are stopped.
    """
    suffix = "-" + shard_text.replace("/", "-of-") if shard_text else ""
    status = out / f"status{suffix}.json"
    _refuse_overlaps(entries, out, status, listed)
    if jobs < 0:
        raise UsageError("number of jobs cannot be negative", where="--jobs", got=str(jobs))
    jobs = min(jobs or native.default_threads(), max(len(entries), 1))
    threads = max(1, native.default_threads() // jobs)
    log.info(f"{verb}: {len(entries)} scenes, {jobs} at a time with {threads} threads each")
    outcomes: dict[str, Outcome] = {}
    with processes.child_environment(threads, torch_threads=threads), log.task(verb, len(entries)) as bar:
        for outcome in _run_all(entries, out, work, jobs, overwrite):
            outcomes[outcome.name] = outcome
            bar.advance()
            if outcome.state == "failed":
                log.warn(f"{verb}: {outcome.name} failed: {outcome.words}")
    ordered = [outcomes[entry.name] for entry in entries]
    counts = {state: sum(o.state == state for o in ordered) for state in ("done", "reused", "failed")}
    store.write_json(status, {"schema": 1, "verb": verb, "counts": counts, "scenes": [asdict(o) for o in ordered]})
    code = min(FAILED_BASE + counts["failed"], FAILED_MOST) if counts["failed"] else 0
    return {
        "scenes": [asdict(outcome) for outcome in ordered], **counts, "status": status, "text": table(verb, ordered),
        "exit_code": code,
    }  # fmt: skip


def _refuse_overlaps(entries: Sequence[Entry], out: Path, status: Path, listed: Path | None) -> None:
    """UsageError where a scene's output touches any source or the list, or the status would replace another file."""
    read: dict[str, Path | str | None] = {
        f"source of {entry.name}": entry.source for entry in entries if entry.source != "city"
    }
    read["list"] = listed if listed is not None and listed.is_file() else None
    refuse_overlaps([status, *(out / entry.name for entry in entries)], read)
    if status.exists():
        try:
            known = {"schema", "verb", "counts", "scenes"} <= set(store.read_json(status))
        except (InputError, TypeError):
            known = False
        if not known:
            raise UsageError(
                "the status file would replace a file that does not belong to this list", where=str(status), remedy="choose another --out"
            )


def _run_all(entries: list[Entry], out: Path, work: Work, jobs: int, overwrite: bool) -> Iterator[Outcome]:
    context = multiprocessing.get_context("spawn")
    waiting = list(reversed(entries))
    running: dict[Connection, tuple[Entry, Any, float]] = {}
    try:
        while waiting or running:
            while waiting and len(running) < jobs:
                entry = waiting.pop()
                ours, theirs = context.Pipe(duplex=False)
                process = context.Process(
                    target=_child, args=(theirs, work, entry, out / entry.name, overwrite), name=f"mudg {entry.name}"
                )
                process.start()
                theirs.close()
                running[ours] = (entry, process, time.monotonic())
            ready = set(wait(list(running)))
            for connection in [one for one in running if one in ready]:
                entry, process, started = running.pop(connection)
                yield _outcome(entry, connection, process, time.monotonic() - started)
    finally:
        for _, process, _ in running.values():
            process.terminate()
        for _, process, _ in running.values():
            process.join()


def _outcome(entry: Entry, connection: Connection, process: Any, seconds: float) -> Outcome:
    """What the process said, or how it ended without a word."""
    try:
        state, words, error = json.loads(connection.recv_bytes())
    except EOFError:
        state, words, error = "failed", "", "crash"
    connection.close()
    process.join()
    if error == "crash":
        code = process.exitcode or 0
        words = f"its process ended with code {code}; see the messages above"
        if code < 0:
            words = f"its process was killed by signal {-code}"
        if -code == signal.SIGKILL:
            words += " (out of memory? try fewer --jobs)"
    return Outcome(entry.name, entry.source, state, round(seconds, 2), words, error)


def _child(connection: Connection, work: Work, entry: Entry, folder: Path, overwrite: bool) -> None:
    """In the process of one scene."""
    signal.signal(
        signal.SIGTERM, lambda *_: sys.exit(128 + signal.SIGTERM)
    )  # unwinds, so that partial folders are removed
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches the whole group; the parent decides, and terminates
    log.set_quiet(True)
    before = _finished(folder)
    try:
        try:
            work(entry, folder, overwrite)
        except UsageError:
            if overwrite or before or not _unfinished(folder):
                raise
            work(entry, folder, True)  # what an earlier failure left of another state of the source
        reused = before != "" and before == _finished(folder)
        connection.send_bytes(json.dumps(["reused" if reused else "done", _contents(folder), ""]).encode())
    except Exception as failed:
        error = failures.in_words(failed)
        if error is None:
            raise
        parts = (
            error.what,
            error.where,
            error.expected and f"expected {error.expected}",
            error.got and f"got {error.got}",
        )
        words = "; ".join(part for part in parts if part)
        connection.send_bytes(json.dumps(["failed", words, type(error).__name__]).encode())
    finally:
        connection.close()


def _state(folder: Path) -> Mapping[str, Any]:
    try:
        state = store.read_json(folder / "run.json")
    except InputError:
        return {}
    return state if isinstance(state, dict) else {}


def _finished(folder: Path) -> str:
    """What tells one finished result from another; empty if there is none."""
    state = _state(folder)
    if state.get("state") != "complete":
        return ""
    return f"{state.get('key')} {(folder / 'run.json').stat().st_mtime_ns}"


def _unfinished(folder: Path) -> bool:
    return _state(folder).get("state") in ("running", "interrupted")


def _contents(folder: Path) -> str:
    summary = _state(folder).get("summary", {})
    return ", ".join(f"{value} {name}" for name, value in summary.items() if isinstance(value, int | str))


def table(verb: str, outcomes: Sequence[Outcome]) -> str:
    """The outcomes as a table, failures last."""
    from rich.console import Console
    from rich.table import Table

    grid = Table(title=f"mudg {verb}", title_justify="left")
    for column in ("scene", "state", "seconds", "what it holds, or why it failed"):
        grid.add_column(column, overflow="fold", justify="right" if column == "seconds" else "left")
    for outcome in sorted(outcomes, key=lambda o: o.state == "failed"):
        grid.add_row(outcome.name, outcome.state, f"{outcome.seconds:.1f}", outcome.words)
    out = io.StringIO()
    Console(file=out, width=int(os.environ.get("COLUMNS") or 120), markup=False, highlight=False).print(grid)
    failed = sum(outcome.state == "failed" for outcome in outcomes)
    out.write(
        f"{len(outcomes) - failed} of {len(outcomes)} scenes are there" + (f", {failed} failed" if failed else "")
    )
    return out.getvalue()
