"""The one loop of benchmarks: logs that are worked on side by side, parts that are reused, and folders that hold
nothing foreign."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Protocol

from mudg import native
from mudg.base import log, store
from mudg.base.errors import InputError, UsageError
from mudg.base.processes import run_in_processes
from mudg.base.run_folder import is_temporary
from mudg.benchmarks.settings import BenchConfig
from mudg.core.raster.place import drawing_device
from mudg.steps.engine import Result


class BenchJob(Protocol):
    """What is worked on at a time, in terms that another process understands."""

    @property
    def title(self) -> str:
        """For the progress bar."""

    def measure(self) -> dict[str, Any]:
        """Do the work; values for JSON."""


def compare(
    out: Path,
    jobs: Sequence[BenchJob],
    config: BenchConfig,
    document: Callable[[list[dict[str, Any]]], dict[str, Any]],
    texts: Mapping[str, Callable[[Mapping[str, Any]], str]],
) -> Path:
    """Do all jobs, several at a time with one thread each; write ``bench.json`` and its texts. Results do not depend on
    how many run at a time; finished steps of an interrupted benchmark are reused.

    Args:
        document: what ``bench.json`` holds, from what the jobs measured, in their order. texts: file -> its text, from
            the document.
    """
    measured: dict[int, dict[str, Any]] = {}
    with log.task("logs", len(jobs)) as bar, native.one_thread():
        for index, facts in run_in_processes(_measure, [(job,) for job in jobs], min(at_once(config), len(jobs))):
            measured[index] = facts
            bar.update(jobs[index].title)
            bar.advance()
    content = document([measured[index] for index in range(len(jobs))])
    store.write_json(out / "bench.json", content)
    for name, text in texts.items():
        store.write_text(out / name, text(content))
    return out


def _measure(job: BenchJob) -> dict[str, Any]:
    return job.measure()


def at_once(config: BenchConfig) -> int:
    """Logs that are processed at the same time: as many as asked for, else one per core, or one where they would share
    a GPU."""
    if config.processes:
        return config.processes
    return os.cpu_count() or 1 if drawing_device(config.device, "benchmark").type == "cpu" else 1


def run_step(step: Result) -> Path:
    """Run a step, or reuse its result; what other settings left in its folder is replaced only with ``overwrite``."""
    try:
        return replace(step, overwrite=False).run()
    except UsageError:
        if not step.overwrite:
            raise
        return step.run()


def finished(path: Path, measure: Callable[[], Any]) -> Any:
    """What a part of a benchmark wrote; it is measured if there is no such file yet, so an interrupted benchmark goes
    on."""
    if not path.is_file():
        store.write_json(path, measure())
    return store.read_json(path)


def refuse_foreign(
    out: Path, pages: Sequence[str], is_own: Callable[[Any], bool], may_be: Callable[[Path], bool] = Path.is_dir
) -> None:
    """UsageError if a folder holds anything that a benchmark does not write.

    Args:
        out: it need not exist. pages: names of its files at the top; the first is its result, in JSON.
        is_own: whether that result is this benchmark's. may_be: whether an entry may belong to it, if it is no page.
    """
    if not out.exists():
        return
    entries = [entry for entry in out.iterdir() if not is_temporary(entry.name)] if out.is_dir() else [out]
    names = [entry.name for entry in entries]
    foreign = [entry.name for entry in entries if entry.name not in pages and not may_be(entry)]
    if not foreign and any(name in pages for name in names):
        try:
            foreign = [] if is_own(store.read_json(out / pages[0])) else [pages[0]]
        except (InputError, KeyError, TypeError):
            foreign = [name for name in names if name in pages]
    if foreign:
        raise UsageError(
            "the output folder holds files that do not belong to this run",
            where=str(out),
            got=", ".join(sorted(foreign)[:8]),
            remedy="choose an empty --out",
        )


def seconds_of(out: Path) -> dict[str, float]:
    """Seconds of each finished step, by folder."""
    steps = sorted(path.relative_to(out) for path in out.glob("**/run.json"))
    return {
        path.parent.as_posix(): float(store.read_json(out / path).get("seconds", math.nan))
        for path in steps
        if len(path.parts) <= 3 and ".part" not in str(path)
    }
