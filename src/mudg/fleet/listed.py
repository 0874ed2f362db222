"""One verb over many scenes: ``mudg ingest|annotate|fuse --list FILE --out ROOT [--shard i/n] [--jobs N]``.

Every scene is a process of its own and writes the folder ROOT/<name>. A finished one is verified and reused by the verb
itself, so the same command can be repeated until nothing fails; one that fails is reported with its reason, and the
others go on.
"""

from __future__ import annotations

import io
import os
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

from mudg import native
from mudg.base import config as configuration
from mudg.base import log, store
from mudg.base.errors import UsageError, plain
from mudg.base.location import Location
from mudg.base.run_folder import refuse_overlap
from mudg.fleet.child import Stop
from mudg.fleet.engines import LocalRun
from mudg.fleet.plan import BatchPlan, Entry, files_read, listed_plan, parse_shard, shard
from mudg.fleet.records import BatchFolder, Ended
from mudg.fleet.work import DONE, Job

FAILED_BASE: Final = 10
FAILED_MOST: Final = 99


def exit_code(failed: int) -> int:
    """Exit code of so many failures: 10 more, at most 99; apart from all codes with a meaning of their own."""
    return min(FAILED_BASE + failed, FAILED_MOST) if failed else 0


def run_listed(
    words: Sequence[str],
    settings: Any,
    entries: list[Entry],
    out: Path,
    *,
    jobs: int = 0,
    shard_text: str = "",
    listed: Path | None = None,
    plan: BatchPlan | None = None,
) -> dict[str, Any]:
    """Run a step over a list.

    Args:
        words: its command line for a ``{source}``. settings: of the step. entries: the whole list. out: ROOT;
            ``ROOT/status.json`` (with a shard: ``status-i-of-n.json``) tells the outcome. jobs: processes; 0 = as many
            as there are processors. They share the processors. shard_text: ``i/n`` or empty. listed: the list, where it
            is a file. plan: what to do instead, for tests.

    Returns:
        ``scenes`` (one record each), counts, ``text``: the table for people, and ``exit_code``: 0, or 10 plus the
        number of failed scenes, at most 99.

    Raises:
        UsageError: ``jobs`` is negative; an output touches a source, or the status another file. KeyboardInterrupt: the
            running scenes were stopped.
    """
    part = parse_shard(shard_text)
    entries = shard(entries, part)
    status = out / (f"status-{part[0]}-of-{part[1]}.json" if shard_text else "status.json")
    refuse_overlap([status, *(out / entry.name for entry in entries)], files_read(entries, listed))
    if status.exists() and not {"schema", "verb", "counts", "scenes"} <= store.json_object(status).keys():
        what = "the status file would replace a file that does not belong to this list"
        raise UsageError(what, where=str(status), remedy="choose another --out")
    if jobs < 0:
        raise UsageError("number of jobs cannot be negative", where="--jobs", got=str(jobs))
    jobs = min(jobs or native.default_threads(), max(len(entries), 1))
    threads = max(1, native.default_threads() // jobs)
    log.info(f"{words[0]}: {len(entries)} scenes, {jobs} at a time with {threads} threads each")
    folder = BatchFolder(Location.of(out.absolute()))
    plan = plan or listed_plan(words, configuration.to_dict(settings))
    before = {entry.name: _finished(out / entry.name) for entry in entries}
    told: dict[str, Ended] = {}
    with log.task(words[0], len(entries)) as bar, tempfile.TemporaryDirectory() as scratch:

        def note(report: Ended) -> None:
            told[report.scene] = report
            bar.advance()

        LocalRun(Job(folder, plan, threads, scratch=Path(scratch)), entries, jobs, Stop()).run(note)
    outcomes = [_outcome(entry, told[entry.name], out / entry.name, before[entry.name]) for entry in entries]
    counts = {state: sum(one["state"] == state for one in outcomes) for state in ("done", "reused", "failed")}
    store.write_json(status, {"schema": 1, "verb": words[0], "counts": counts, "scenes": outcomes})
    shown = {"status": status, "text": table(words[0], outcomes), "exit_code": exit_code(counts["failed"])}
    return {"scenes": outcomes, **counts, **shown}


def _outcome(entry: Entry, report: Ended, folder: Path, before: str) -> dict[str, Any]:
    """What became of a scene: ``done``, ``reused`` or ``failed``, with one line of what it holds or why it failed."""
    state, words, error = "failed", report.words, f"code {report.code}"
    if report.state == DONE:
        state = "reused" if before and before == _finished(folder) else "done"
        summary, error = store.json_object(folder / store.RUN_STATE).get("summary"), ""
        facts = summary.items() if isinstance(summary, Mapping) else ()
        words = ", ".join(f"{value} {name}" for name, value in facts if isinstance(value, int | str))
    outcome = {"name": entry.name, "source": entry.source, "state": state, "seconds": round(report.seconds, 2)}
    return {**outcome, "words": words, "error": error}


def _finished(folder: Path) -> str:
    """What tells one finished result from another; empty if there is none."""
    state = store.json_object(folder / store.RUN_STATE)
    if state.get("state") != "complete":
        return ""
    return f"{state.get('key')} {(folder / store.RUN_STATE).stat().st_mtime_ns}"


def table(verb: str, outcomes: Sequence[Mapping[str, Any]]) -> str:
    """The outcomes as a table, failures last."""
    from rich.console import Console
    from rich.table import Table

    grid = Table(title=f"mudg {verb}", title_justify="left")
    for column in ("scene", "state", "seconds", "what it holds, or why it failed"):
        grid.add_column(column, overflow="fold", justify="right" if column == "seconds" else "left")
    for outcome in sorted(outcomes, key=lambda one: one["state"] == "failed"):
        grid.add_row(outcome["name"], outcome["state"], f"{outcome['seconds']:.1f}", plain(outcome["words"]))
    out = io.StringIO()
    Console(file=out, width=int(os.environ.get("COLUMNS") or 120), markup=False, highlight=False).print(grid)
    failed = sum(outcome["state"] == "failed" for outcome in outcomes)
    there = f"{len(outcomes) - failed} of {len(outcomes)} scenes are there"
    return out.getvalue() + there + (f", {failed} failed" if failed else "")
