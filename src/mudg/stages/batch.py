"""``mudg batch run|status|cost|retry|review|accept|reject``: steps over long lists of driving logs, on any number of workers.

The machinery is in ``stages/batches/``; what it promises, and how to use it, in docs/batch.md.
"""

from __future__ import annotations

import os
import re
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

from mudg import native
from mudg.base import config as configuration
from mudg.base import log
from mudg.base.errors import InputError, UsageError
from mudg.base.location import Location
from mudg.base.plain_yaml import parse_yaml
from mudg.base.run_folder import refuse_overlaps
from mudg.stages.batches import costs, engines, quality, retries, review, status
from mudg.stages.batches.folders import BatchFolder
from mudg.stages.batches.listed import FAILED_BASE, FAILED_MOST
from mudg.stages.batches.lists import CITY, Entry, read_list, shard_of
from mudg.stages.batches.local import WorkersEnd, run_workers
from mudg.stages.batches.plan import COMMAND, OF_A_LINE, REVISION, BatchPlan, plan_of
from mudg.stages.batches.work import ASKED_TO_STOP, WorkRequest, WorkRules
from mudg.stages.config import RunConfig
from mudg.stages.config.batch import BatchConfig
from mudg.stages.config.presets import PresetName, run_preset

_LIMIT: Final = re.compile(r"\d+(\.\d+)?%?")
_PATHS: Final = ("poses", "boxes")
"""Settings of a line that are paths."""


@dataclass(frozen=True)
class BatchRequest:
    """What ``mudg batch run`` is asked for.

    Args:
        listed: path or address of the list. out: path or address of the results. batch: how work is shared out. run: settings of the
            steps. words: the command line behind ``mudg``, for engines that start it elsewhere. wait: for the end of an array job.
        scratch: folder for unfinished results.
    """

    listed: str
    out: str
    batch: BatchConfig
    run: RunConfig
    words: tuple[str, ...] = ()
    wait: bool = False
    scratch: Path | None = None


def run(asked: BatchRequest, dry: bool = False) -> dict[str, Any]:
    """Run the steps of a batch, or submit the tasks that do.

    Args:
        dry: only say what there is to do.

    Returns:
        Counts, ``text``, and ``exit_code``: 0, or 10 plus the number of failed steps of this call (at most 99), or 143 if it was asked to
        stop.

    Raises:
        UsageError: settings that contradict each other, or an output that belongs to another batch. InputError: a bad list.
    """
    entries = [_absolute(entry) for entry in read_list(asked.listed, (*OF_A_LINE, REVISION))]
    plan = plan_for(asked.batch, asked.run)
    folder, rules = BatchFolder(Location.of(asked.out)), rules_of(asked.batch, asked.scratch)
    if folder.out.local is not None:
        folder = BatchFolder(Location.of(folder.out.local.absolute()))
    _refuse_overlap(entries, folder, asked.listed)
    if dry:
        return _dry(folder, plan, entries)
    folder.begin(plan, entries)
    if asked.batch.engine in ("slurm", "ray"):
        work = WorkRequest(folder, plan, entries, rules)
        return engines.submitted(engines.Submission(asked.batch, folder, asked.words, asked.wait, work))
    shard = engines.shard_of_environment(asked.batch.shards) if asked.batch.engine == "env" else (0, 1)
    jobs = asked.batch.jobs or (native.default_threads() if asked.batch.engine == "local" else 1)
    jobs = min(jobs, max(1, sum(shard_of(entry.name, shard[1]) == shard[0] for entry in entries)))
    rules = replace(rules, threads=max(1, native.default_threads() // jobs))
    log.info(f"batch: {len(entries)} scenes, shard {shard[0]} of {shard[1]}, {jobs} at a time with {rules.threads} threads each")
    with log.task("batch", len(entries) * len(plan.stages)) as bar:
        ended = run_workers(WorkRequest(folder, plan, entries, rules, shard), jobs, lambda _: bar.advance())
    return _told(folder, ended)


def _told(folder: BatchFolder, ended: WorkersEnd) -> dict[str, Any]:
    bad = sum(count for state, count in ended.counts.items() if state != "done")
    code = ASKED_TO_STOP if ended.stopped else min(FAILED_BASE + bad, FAILED_MOST) if bad else 0
    text = ", ".join(f"{count} {state}" for state, count in sorted(ended.counts.items())) or "nothing was left to do here"
    if ended.gave_up:
        text += "; stopped: more steps have failed than --max-failures allows"
        code = code or FAILED_BASE
    if ended.stopped:
        text += "; stopped as asked, the same command goes on"
    return {"counts": dict(ended.counts), "out": str(folder.out), "text": f"{text}\nmudg batch status {folder.out}", "exit_code": code}


def plan_for(batch: BatchConfig, settings: RunConfig) -> BatchPlan:
    """The plan that settings ask for; paths in the settings that exist from here are made absolute, since steps run elsewhere."""
    values = _with_absolute_paths(configuration.to_dict(settings))
    own = bool(batch.command) and batch.stages == BatchConfig().stages
    command = tuple(_absolute_program(word) for word in batch.command)
    return plan_of(() if own else tuple(name for name in batch.stages if name != COMMAND or command), values, command)


def _with_absolute_paths(values: Mapping[str, Any]) -> dict[str, Any]:
    made: dict[str, Any] = {}
    for name, value in values.items():
        if isinstance(value, Mapping):
            made[name] = _with_absolute_paths(value)
        else:
            made[name] = os.path.abspath(value) if isinstance(value, str) and "/" in value and os.path.exists(value) else value
    return made


def _absolute_program(word: str) -> str:
    return os.path.abspath(word) if "/" in word and "{" not in word and os.path.isfile(word) else word


def rules_of(batch: BatchConfig, scratch: Path | None) -> WorkRules:
    """Rules of the workers; UsageError where a setting cannot be read.

    Args:
        scratch: folder for unfinished results (None: in the output if that is a folder, else the system's).
    """
    if batch.max_failures and not _LIMIT.fullmatch(batch.max_failures):
        raise UsageError("not a number of failures", where="--max-failures", got=batch.max_failures, expected="as 20 or 5%")
    return WorkRules(
        lease_s=batch.lease_s, grace_s=batch.grace_s, patience_s=batch.patience_s, steal=batch.steal,
        bounds=quality.parse_bounds(batch.bounds), second_share=batch.verify_share, most_failures=batch.max_failures,
        scratch=None if scratch is None else Path(scratch).absolute(), scratch_gb=batch.scratch_gb,
    )  # fmt: skip


def _absolute(entry: Entry) -> Entry:
    settings = {
        name: os.path.abspath(value) if name in _PATHS and os.path.exists(value) else value for name, value in entry.settings.items()
    }
    if entry.source == CITY or "://" in entry.source:
        return Entry(entry.name, entry.source, settings)
    return Entry(entry.name, os.path.abspath(entry.source), settings)


def _refuse_overlap(entries: Sequence[Entry], folder: BatchFolder, listed: str) -> None:
    out, place = folder.out.local, Location.of(listed).local
    if out is None:
        return
    read: dict[str, Path | str | None] = {
        f"source of {entry.name}": entry.source for entry in entries if entry.source != CITY and "://" not in entry.source
    }
    read["list"] = place if place is not None and place.is_file() else None
    refuse_overlaps([out], read)


def _dry(folder: BatchFolder, plan: BatchPlan, entries: Sequence[Entry]) -> dict[str, Any]:
    done, failed = folder.keys("done"), folder.keys("failed")
    keys = [unit.key for entry in entries for unit in plan.units(entry)]
    counts = {
        "scenes": len(entries), "steps": len(keys), "done": sum(key in done for key in keys), "failed": sum(key in failed for key in keys),
    }  # fmt: skip
    left = counts["steps"] - counts["done"] - counts["failed"]
    words = " -> ".join(stage.name for stage in plan.stages)
    text = f"{counts['scenes']} scenes: {words}\n{counts['done']} steps done, {counts['failed']} failed, {left} to do"
    return {**counts, "left": left, "text": text}


def show_status(out: str, html: bool = False) -> dict[str, Any]:
    """How far a batch is. html: also write ``status.html`` in its folder."""
    found_in = BatchFolder(Location.of(out))
    found = status.read_status(found_in)
    result: dict[str, Any] = {**found.record(), "text": status.text_of(found)}
    if html:
        page = Location.of(out) / "status.html"
        page.save(status.page_of(found).encode())
        if found.for_review:
            review.write_page(found_in, review.waiting(found_in))
        result["page"] = str(page)
        result["text"] += f"\npage: {page}"
    return result


def show_review(out: str) -> dict[str, Any]:
    """Results outside the bounds, which wait for somebody to look at them; their pictures are on a page. InputError: no batch is here."""
    folder = BatchFolder(Location.of(out))
    folder.plan()
    found = review.waiting(folder)
    page = review.write_page(folder, found)
    waiting = [{"scene": one.scene, "step": one.stage, "problems": list(one.problems), "place": one.place} for one in found]
    return {"waiting": waiting, "page": str(page), "text": f"{review.text_of(found, out)}\npage: {page}"}


def judge(out: str, scenes: Sequence[str], accepted: bool) -> dict[str, Any]:
    """Accept or reject results that wait for review; see ``review.judge``."""
    folder = BatchFolder(Location.of(out))
    folder.plan()
    chosen = review.judge(folder, scenes, accepted)
    words = "accepted: the next mudg batch run goes on with them" if accepted else "rejected"
    return {"scenes": [one.scene for one in chosen], "text": f"{len(chosen)} results {words}"}


def show_cost(out: str, price: float, storage_price: float) -> dict[str, Any]:
    """What a batch took, by step, and what the rest is going to take."""
    found = costs.costs_of(status.read_status(BatchFolder(Location.of(out))), price, storage_price)
    return {**found, "text": costs.text_of(found)}


def watch_status(out: str, html: bool, every_s: float) -> dict[str, Any]:
    """``show_status``, again and again until nothing is left; 0 s: once."""
    while True:
        found = show_status(out, html)
        if every_s <= 0 or not found["left"]:
            return found
        log.info(*found["text"].splitlines())
        time.sleep(every_s)


def settings_of(preset: PresetName, config: Path | None, given: Sequence[str]) -> RunConfig:
    """Settings of the steps: a preset, then a file of ``mudg run``, then ``STEP.NAME=VALUE``.

    Raises:
        UsageError: an unknown setting or a value out of range.
    """
    values: dict[str, Any] = {}
    for text in given:
        name, separator, value = text.partition("=")
        if not separator or not name:
            raise UsageError("not a setting", where="--set", got=text, expected="STEP.NAME=VALUE, as fit.iterations=500")
        values[name] = parse_yaml(value.encode(), f"--set {name}") if value else ""
    return configuration.load(RunConfig, run_preset(preset), config, configuration.nested(values))


def retry(out: str, reason: str = "") -> dict[str, Any]:
    """Forget failures, so that the next ``mudg batch run`` tries them again. reason: codes or names, with commas (empty: all).

    Raises:
        InputError: no batch is here. UsageError: an unknown reason.
    """
    folder, wanted = BatchFolder(Location.of(out)), retries.parse_reasons(reason)
    folder.plan()
    forgotten: list[str] = []
    by_key = status.read_status(folder).failures
    for key, failure in by_key.items():
        if not wanted or failure.code in wanted:
            folder.failed(key).remove()
            review.forget(folder, failure.scene, failure.stage)
            forgotten.append(key)
    if not forgotten and wanted:
        raise InputError("nothing failed for this reason", where=str(folder.out), got=reason,
            expected=", ".join(sorted({str(one.code) for one in by_key.values()})) or "no failures at all")  # fmt: skip
    return {"forgotten": len(forgotten), "text": f"{len(forgotten)} failed steps will be tried again by the next mudg batch run"}
