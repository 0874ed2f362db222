"""One verb over many scenes: ``mudg ingest|annotate|fuse --list FILE --out ROOT [--shard i/n] [--jobs N]``.

Every scene is a process of its own and writes the folder ROOT/<name>. A finished one is verified and reused, so the same
command can be repeated until nothing fails; one that fails is reported with its reason, and the others go on.

The workers are those of ``mudg batch``, with their claims in ROOT/_batch. Apart from it: results lie right below ROOT, records of an
earlier run are not trusted but made again, and a failure is not tried again by itself.
"""

from __future__ import annotations

import io
import os
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final

from mudg import native
from mudg.base import config as configuration
from mudg.base import log, store
from mudg.base.errors import InputError, UsageError, plain
from mudg.base.location import Location
from mudg.base.run_folder import refuse_overlaps
from mudg.stages.batches.folders import BatchFolder
from mudg.stages.batches.lists import Entry, shard
from mudg.stages.batches.local import run_workers
from mudg.stages.batches.plan import BatchPlan, listed_plan
from mudg.stages.batches.work import WorkRequest, WorkRules

FAILED_BASE: Final = 10
"""Exit code of n failed scenes: this plus n, at most ``FAILED_MOST``; apart from all codes with a meaning of their own."""
FAILED_MOST: Final = 99


@dataclass(frozen=True)
class ListedRun:
    """A verb over a list.

    Args:
        verb: its name. settings: of the verb. entries: the whole list. out: ROOT; ``ROOT/status.json`` (with a shard:
            ``status-i-of-n.json``) tells the outcome. jobs: processes; 0 = as many as there are processors. They share the
            processors. overwrite: replace results of other settings. shard_text: ``i/n`` or empty. listed: the list, where it is a
            file.
    """

    verb: str
    settings: Any
    entries: list[Entry]
    out: Path
    jobs: int = 0
    overwrite: bool = False
    shard_text: str = ""
    listed: Path | None = None


@dataclass(frozen=True, slots=True)
class Outcome:
    """What became of a scene: ``done``, ``reused`` or ``failed``, with one line of what it holds or why it failed."""

    name: str
    source: str
    state: str
    seconds: float
    words: str
    error: str = ""


def run_listed(asked: ListedRun, plan: BatchPlan | None = None) -> dict[str, Any]:
    """Run a verb over a list.

    Args:
        plan: what to do instead of the verb, for tests.

    Returns:
        ``scenes`` (one record each), counts, ``text``: the table for people, and ``exit_code``: 0, or 10 plus the number of
        failed scenes, at most 99.

    Raises:
        UsageError: ``jobs`` is negative; an output touches a source, or the status another file. KeyboardInterrupt: the
            running scenes were stopped.
    """
    entries = shard(asked.entries, asked.shard_text)
    suffix = "-" + asked.shard_text.replace("/", "-of-") if asked.shard_text else ""
    status = asked.out / f"status{suffix}.json"
    _refuse_overlaps(entries, asked.out, status, asked.listed)
    if asked.jobs < 0:
        raise UsageError("number of jobs cannot be negative", where="--jobs", got=str(asked.jobs))
    jobs = min(asked.jobs or native.default_threads(), max(len(entries), 1))
    threads = max(1, native.default_threads() // jobs)
    log.info(f"{asked.verb}: {len(entries)} scenes, {jobs} at a time with {threads} threads each")
    folder = BatchFolder(Location.of(asked.out.absolute()))
    plan = plan or listed_plan(asked.verb, configuration.to_dict(asked.settings), asked.overwrite)
    before = {entry.name: _finished(asked.out / entry.name) for entry in entries}
    _forget(folder, plan, entries)
    rules = WorkRules(steal=False, threads=threads, patience_s=0.0, most_tries=1)
    told: dict[str, Mapping[str, Any]] = {}
    absolute = [_absolute(entry) for entry in entries]
    with log.task(asked.verb, len(entries)) as bar:

        def note(one: Mapping[str, Any]) -> None:
            told[one["scene"]] = one
            bar.advance()

        ended = run_workers(WorkRequest(folder, plan, absolute, rules), jobs, note)
    if ended.stopped:
        raise KeyboardInterrupt
    outcomes = [_outcome(entry, told.get(entry.name), asked.out / entry.name, before[entry.name]) for entry in entries]
    counts = {state: sum(one.state == state for one in outcomes) for state in ("done", "reused", "failed")}
    store.write_json(status, {"schema": 1, "verb": asked.verb, "counts": counts, "scenes": [asdict(one) for one in outcomes]})
    code = min(FAILED_BASE + counts["failed"], FAILED_MOST) if counts["failed"] else 0
    return {
        "scenes": [asdict(outcome) for outcome in outcomes], **counts, "status": status, "text": table(asked.verb, outcomes),
        "exit_code": code,
    }  # fmt: skip


def _absolute(entry: Entry) -> Entry:
    return entry if entry.source == "city" or "://" in entry.source else Entry(entry.name, os.path.abspath(entry.source), entry.settings)


def _forget(folder: BatchFolder, plan: BatchPlan, entries: Sequence[Entry]) -> None:
    """Remove the records of earlier runs: everything is verified once more."""
    for entry in entries:
        for unit in plan.units(_absolute(entry)):
            folder.done(unit.key).remove()
            folder.failed(unit.key).remove()


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


def _outcome(entry: Entry, told: Mapping[str, Any] | None, folder: Path, before: str) -> Outcome:
    if told is None:
        return Outcome(entry.name, entry.source, "failed", 0.0, "another worker is at it, or it was not begun", "busy")
    seconds = round(float(told["seconds"]), 2)
    if told["state"] == "done":
        state = "reused" if before and before == _finished(folder) else "done"
        return Outcome(entry.name, entry.source, state, seconds, _contents(folder))
    return Outcome(entry.name, entry.source, "failed", seconds, str(told["words"]), f"code {told['code']}")


def _state(folder: Path) -> Mapping[str, Any]:
    try:
        state = store.read_json(folder / store.RUN_STATE)
    except InputError:
        return {}
    return state if isinstance(state, dict) else {}


def _finished(folder: Path) -> str:
    """What tells one finished result from another; empty if there is none."""
    state = _state(folder)
    if state.get("state") != "complete":
        return ""
    return f"{state.get('key')} {(folder / store.RUN_STATE).stat().st_mtime_ns}"


def _contents(folder: Path) -> str:
    summary = _state(folder).get("summary")
    if not isinstance(summary, Mapping):
        return ""
    return ", ".join(f"{value} {name}" for name, value in summary.items() if isinstance(value, int | str))


def table(verb: str, outcomes: Sequence[Outcome]) -> str:
    """The outcomes as a table, failures last."""
    from rich.console import Console
    from rich.table import Table

    grid = Table(title=f"mudg {verb}", title_justify="left")
    for column in ("scene", "state", "seconds", "what it holds, or why it failed"):
        grid.add_column(column, overflow="fold", justify="right" if column == "seconds" else "left")
    for outcome in sorted(outcomes, key=lambda o: o.state == "failed"):
        grid.add_row(outcome.name, outcome.state, f"{outcome.seconds:.1f}", plain(outcome.words))
    out = io.StringIO()
    Console(file=out, width=int(os.environ.get("COLUMNS") or 120), markup=False, highlight=False).print(grid)
    failed = sum(outcome.state == "failed" for outcome in outcomes)
    out.write(
        f"{len(outcomes) - failed} of {len(outcomes)} scenes are there" + (f", {failed} failed" if failed else "")
    )
    return out.getvalue()
