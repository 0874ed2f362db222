"""Engines: where the workers of a batch run. Every engine starts the same workers; no engine holds state of a batch.

``local`` and ``env`` work in this process; ``slurm`` submits an array job whose tasks are ``env``; ``ray`` runs tasks on a cluster.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final, Protocol

from mudg.base.errors import UsageError
from mudg.stages.batches import on_ray, slurm
from mudg.stages.batches.folders import BatchFolder
from mudg.stages.batches.work import WorkRequest
from mudg.stages.config.batch import BatchConfig


@dataclass(frozen=True)
class Submission:
    """What an engine submits. words: the command line behind ``mudg``; wait: for its end; work: of all shards together."""

    batch: BatchConfig
    folder: BatchFolder
    words: tuple[str, ...]
    wait: bool
    work: WorkRequest


SHARD_VARIABLES: Final[tuple[tuple[str, str, str], ...]] = (
    ("SLURM_ARRAY_TASK_ID", "SLURM_ARRAY_TASK_COUNT", "SLURM_ARRAY_TASK_MIN"),
    ("JOB_COMPLETION_INDEX", "", ""),
    ("SKYPILOT_JOB_RANK", "SKYPILOT_NUM_JOBS", ""),
    ("SKYPILOT_NODE_RANK", "SKYPILOT_NUM_NODES", ""),
    ("AWS_BATCH_JOB_ARRAY_INDEX", "AWS_BATCH_JOB_ARRAY_SIZE", ""),
)
"""Variables that number the tasks of a scheduler: the index, the count and the lowest index (empty: 0)."""


def shard_of_environment(shards: int, environment: Mapping[str, str] | None = None) -> tuple[int, int]:
    """(i, n): which shard a task is, from the first of ``SHARD_VARIABLES`` that is set.

    Args:
        shards: n, where the scheduler does not tell it (1: then it must).

    Raises:
        UsageError: no such variable is set, or what it says is no shard.
    """
    found = os.environ if environment is None else environment
    for index_name, count_name, first_name in SHARD_VARIABLES:
        if not found.get(index_name):
            continue
        text = found[index_name]
        count = found.get(count_name, "") if count_name and shards == 1 else ""
        first = found.get(first_name, "") if first_name else ""
        if not text.isdecimal() or (count and not count.isdecimal()):
            raise UsageError("the scheduler's numbers cannot be read", where=index_name, got=text)
        index, total = int(text) - (int(first) if first.isdecimal() else 0), int(count) if count else shards
        if not 0 <= index < total:
            raise UsageError("the task's number is not one of the shards", where=index_name, got=text, expected=f"0 to {total - 1}",
                remedy="give --shards as many as the scheduler has tasks")  # fmt: skip
        return index, total
    raise UsageError("no scheduler has numbered this task", where="--engine env",
        expected=f"one of {', '.join(names[0] for names in SHARD_VARIABLES)} in the environment")  # fmt: skip


class Engine(Protocol):
    """What the engines have in common."""

    def submit(self) -> str:
        """Hand the tasks over; returns what the engine calls them."""
        ...

    def poll(self) -> int:
        """Tasks that wait or run."""
        ...

    def cancel(self) -> None:
        """Stop them, with checkpoints."""
        ...


def submitted(asked: Submission) -> dict[str, Any]:
    """Submit the tasks of a batch to Slurm, or run them on a Ray cluster."""
    batch, here = asked.batch, os.getcwd()
    words = slurm.task_words(asked.words, batch.shards)
    if batch.engine == "slurm":
        local = asked.folder.own.local
        output = str(local / "slurm" / "%A_%a.txt") if local is not None else f"{here}/mudg-batch-%A_%a.txt"
        job = slurm.SlurmJob(words, batch.shards, here, output, batch.grace_s, batch.slurm_at_once, batch.slurm_options)
        array = slurm.SlurmArray(job)
        number = array.submit()
        if asked.wait:
            array.wait()
        text = f"job {number} with {batch.shards} tasks; its messages: {output}\nmudg batch status {asked.folder.out}"
        return {"job": number, "shards": batch.shards, "out": str(asked.folder.out), "text": text}
    tasks = on_ray.RayTasks(on_ray.RayJob(words, batch.shards, here, batch.ray_address, max(1, batch.jobs), batch.ray_gpus))
    tasks.submit()
    code = on_ray.worst_of(tasks.wait())
    text = f"{batch.shards} tasks have ended\nmudg batch status {asked.folder.out}"
    return {"shards": batch.shards, "out": str(asked.folder.out), "text": text, "exit_code": code}
