"""``mudg batch run|status|retry``: steps over long lists of driving logs, on this machine, Ray or Slurm.

The machinery is in ``fleet/``; what it promises, and how to use it, in docs/batch.md.
"""

from __future__ import annotations

import os
import time
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from mudg import native
from mudg.base import config as configuration
from mudg.base import log, store
from mudg.base.errors import InputError, ResourceError, UsageError
from mudg.base.plain_yaml import parse_yaml
from mudg.base.run_folder import refuse_overlap
from mudg.fleet import engines
from mudg.fleet.plan import (
    CITY,
    COMMAND,
    OF_A_LINE,
    BatchPlan,
    Entry,
    parse_shard,
    plan_of,
    read_list,
    refuse_address,
    shard_of,
)
from mudg.fleet.records import BatchFolder, Ended, slurm_tasks_left
from mudg.fleet.settings import BatchConfig
from mudg.fleet.work import DONE, STOPPED, Job, Stop, is_open
from mudg.steps.settings import PresetName, RunConfig, run_preset

_POLL_S = 10.0
FAILED_BASE, FAILED_MOST = 10, 99


def exit_code(failed: int) -> int:
    """Exit code of so many failures: 10 more, at most 99; apart from all codes with a meaning of their own."""
    return min(FAILED_BASE + failed, FAILED_MOST) if failed else 0


def run(
    listed: str,
    out: str,
    batch: BatchConfig,
    settings: RunConfig,
    lines: Mapping[str, Sequence[str]],
    *,
    shard_text: str = "",
    wait: bool = False,
    take_over: bool = False,
    dry: bool = False,
) -> dict[str, Any]:
    """Run the steps of a batch, or submit the tasks that do. settings, lines: of the steps, and their words
    (``plan_of``). shard_text: ``i/n``, ``env`` or ``env/n``, or empty. wait: for the end of an array job. dry: only say
    what there is to do.

    Returns counts, ``text``, and ``exit_code``: 0, or 10 plus the number of failed steps of this call (at most 99).
    UsageError: settings that contradict each other, or an output of another batch or driver. InputError: a bad list.
    KeyboardInterrupt: asked to stop; running steps have written checkpoints.
    """
    refuse_address(listed, "--list")
    refuse_address(out, "--out")
    scenes, part = read_list(Path(listed), OF_A_LINE), parse_shard(shard_text)
    if shard_text and batch.engine != "local":
        raise UsageError("the engine itself shares out the list", where="--shard", got=f"--engine {batch.engine}")
    plan, folder = plan_for(batch, settings, lines), BatchFolder(Path(out).absolute())
    sources = {f"source of {entry.name}": entry.source for entry in scenes if entry.source != CITY}
    refuse_overlap(folder.out, sources | {"list": listed if Path(listed).is_file() else None})
    if not dry:
        folder.begin(plan, scenes)
    done, failed = folder.keys("done"), folder.keys("failed")
    ours = [entry for entry in scenes if shard_of(entry.name, part[1]) == part[0]]
    entries = [entry for entry in ours if is_open(plan, entry, done, failed)]
    if dry:
        keys = [unit.key for entry in ours for unit in plan.units(entry)]
        counts = {"scenes": len(ours), "steps": len(keys)}
        counts |= {DONE: len(done.intersection(keys)), "failed": len(failed.intersection(keys))}
        left = counts["steps"] - counts[DONE] - counts["failed"]
        text = f"{len(ours)} scenes: {' -> '.join(stage.name for stage in plan.stages)}"
        text += f"\n{counts[DONE]} steps done, {counts['failed']} failed, {left} to do"
        return {**counts, "left": left, "text": text}
    job = Job(folder, plan, max(1, round(batch.cpus)), batch.grace_s)
    with folder.owned(part, numbered=shard_text.startswith("env"), take_over=take_over) as owner:
        if batch.engine == "slurm" and entries:
            number, messages = engines.submit_to_slurm(job, entries, batch)
            me = next(one for one in folder.owners().values() if one.process == os.getpid())
            store.atomic_write(owner, me.model_copy(update={"job": number}).model_dump_json().encode())
            text = f"job {number}; its messages: {messages}\nmudg batch status {folder.out}"
            result = {"job": number, "out": str(folder.out), "text": text}
            return {**result, "exit_code": _awaited(job, entries, number)} if wait else result
        counts = _run(job, entries, batch)
    text = ", ".join(f"{count} {state}" for state, count in sorted(counts.items())) or "nothing was left to do here"
    text, code = f"{text}\nmudg batch status {folder.out}", exit_code(counts.total() - counts[DONE])
    return {"counts": dict(counts), "out": str(folder.out), "text": text, "exit_code": code}


def _run(job: Job, entries: Sequence[Entry], batch: BatchConfig) -> Counter[str]:
    counts: Counter[str] = Counter()
    with log.task("batch", len(entries) * len(job.plan.stages)) as bar:

        def tell(report: Ended) -> None:
            if report.state != STOPPED:
                counts[report.state] += 1
            if report.state not in (DONE, STOPPED) and batch.engine == "ray":
                log.warn(f"{report.scene} {report.stage} {report.state}: {report.words}")
            bar.advance()

        if batch.engine == "ray":
            engines.run_on_ray(job, entries, batch, tell)
            return counts
        cores = native.default_threads()
        jobs = max(1, min(batch.jobs or cores, len(entries)))
        threads = max(1, cores // jobs)
        log.info(f"batch: {len(entries)} scenes, {jobs} at a time with {threads} threads each")
        engines.LocalRun(replace(job, threads=threads), entries, jobs, Stop(job.grace_s)).run(tell)
    return counts


def _awaited(job: Job, entries: Sequence[Entry], number: str) -> int:
    """Wait for the end of an array job; returns the exit code of what it left undone."""
    try:
        while slurm_tasks_left(number):
            time.sleep(_POLL_S)
    except OSError as error:
        raise ResourceError("Slurm does not answer", where="squeue", got=str(error)) from error
    done = job.folder.keys("done")
    return exit_code(sum(any(unit.key not in done for unit in job.plan.units(entry)) for entry in entries))


def plan_for(batch: BatchConfig, settings: RunConfig, lines: Mapping[str, Sequence[str]]) -> BatchPlan:
    """The plan that settings ask for; paths in the settings that exist from here are made absolute, since steps run
    elsewhere."""
    values = _with_absolute_paths(configuration.to_dict(settings))
    own = bool(batch.command) and batch.stages == BatchConfig().stages
    is_file = lambda word: "/" in word and "{" not in word and os.path.isfile(word)
    command = tuple(os.path.abspath(word) if is_file(word) else word for word in batch.command)
    names = () if own else tuple(name for name in batch.stages if name != COMMAND or command)
    return plan_of(names, lines, values, command)


def _with_absolute_paths(values: Any) -> Any:
    if isinstance(values, Mapping):
        return {name: _with_absolute_paths(value) for name, value in values.items()}
    is_path = isinstance(values, str) and "/" in values and os.path.exists(values)
    return os.path.abspath(values) if is_path else values


def settings_of(preset: PresetName, config: Path | None, given: Sequence[str]) -> RunConfig:
    """Settings of the steps: a preset, then a file of ``mudg run``, then ``STEP.NAME=VALUE``. UsageError: an unknown
    setting or a value out of range."""
    values: dict[str, Any] = {}
    for text in given:
        name, separator, value = text.partition("=")
        if not separator or not name:
            expected = "STEP.NAME=VALUE, as fit.iterations=500"
            raise UsageError("not a setting", where="--set", got=text, expected=expected)
        values[name] = parse_yaml(value.encode(), f"--set {name}") if value else ""
    return configuration.load(RunConfig, run_preset(preset), config, configuration.nested(values))


def retry(out: str, reason: str = "") -> dict[str, Any]:
    """Forget failures, so that the next ``mudg batch run`` tries them again. reason: exit codes with commas (empty:
    all). InputError: no batch is here, or nothing failed for this reason. UsageError: not a list of exit codes."""
    folder, words = BatchFolder(Path(out)), reason.replace(",", " ").split()
    if not all(word.isdecimal() for word in words):
        raise UsageError("unknown reason", where="--reason", got=reason, expected="exit codes with commas, as 5,137")
    folder.stages()
    failures = list(folder.records("failed"))
    chosen = [one for one in failures if not words or one.code in map(int, words)]
    for one in chosen:
        store.remove(folder.record("failed", one.key))
    if words and not chosen:
        expected = ", ".join(sorted({str(one.code) for one in failures})) or "no failures at all"
        raise InputError("nothing failed for this reason", where=str(folder.out), got=reason, expected=expected)
    text = f"{len(chosen)} failed steps will be tried again by the next mudg batch run"
    return {"forgotten": len(chosen), "text": text}
