"""Ray: a batch as tasks of a cluster, one per shard. The extra ``[ray]`` brings the package."""

from __future__ import annotations

import os
import subprocess
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

from mudg.base import log
from mudg.base.errors import ResourceError
from mudg.stages.batches.work import ASKED_TO_STOP

_RETRIES: Final = 20


@dataclass(frozen=True)
class RayJob:
    """Tasks of a Ray cluster. words: command line of a task, for engine ``env``; cores, gpus: of each; folder: where it runs."""

    words: tuple[str, ...]
    shards: int
    folder: str
    address: str = ""
    cores: float = 1.0
    gpus: float = 0.0


def environment_of(index: int) -> dict[str, str]:
    """What tells a task its shard."""
    return {"JOB_COMPLETION_INDEX": str(index), "SLURM_ARRAY_TASK_ID": ""}


def run_shard(words: Sequence[str], folder: str, index: int) -> int:
    """One task: a process that works on a shard. It ends with the task's process. Returns its exit code."""
    from mudg.base import processes

    with processes.life_line() as line:
        variables: Mapping[str, str] = {**os.environ, **environment_of(index), processes.LIFE_LINE: str(line)}
        here = folder if os.path.isdir(folder) else None
        return subprocess.run(list(words), cwd=here, env=dict(variables), pass_fds=(line,), check=False).returncode


class RayTasks:
    """The tasks of a batch on a Ray cluster."""

    def __init__(self, job: RayJob) -> None:
        self._job = job
        self._waiting: list[Any] = []
        self._codes: list[int] = []
        try:
            import ray
        except ImportError as error:
            raise ResourceError("the package ray is not installed", where="--engine ray", remedy="pip install 'mudg[ray]'") from error
        self._ray: Any = ray

    def submit(self) -> str:
        """Connect to the cluster and hand over all tasks; returns the cluster's address."""
        if not self._ray.is_initialized():
            os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
            self._ray.init(address=self._job.address or None, log_to_driver=True, logging_level="warning")
        task = self._ray.remote(
            num_cpus=self._job.cores, num_gpus=self._job.gpus, max_retries=_RETRIES, scheduling_strategy="SPREAD", max_calls=1
        )(run_shard)
        self._waiting = [task.remote(self._job.words, self._job.folder, index) for index in range(self._job.shards)]
        return str(self._job.address or "local")

    def poll(self) -> int:
        """Tasks that wait or run."""
        if self._waiting:
            ready, self._waiting = self._ray.wait(self._waiting, num_returns=len(self._waiting), timeout=1.0)
            for one in ready:
                try:
                    self._codes.append(int(self._ray.get(one)))
                except self._ray.exceptions.RayError as error:
                    log.warn(f"a task of Ray failed: {str(error).splitlines()[0][:300]}")
                    self._codes.append(ResourceError.exit_code)
        return len(self._waiting)

    def cancel(self) -> None:
        """Stop all tasks."""
        for one in self._waiting:
            self._ray.cancel(one, force=False)

    def wait(self) -> list[int]:
        """Wait for all tasks; returns their exit codes. Interrupted, all tasks are cancelled."""
        try:
            while self.poll():
                pass
        except KeyboardInterrupt:
            self.cancel()
            raise
        return self._codes


def worst_of(codes: Sequence[int]) -> int:
    """The exit code of all tasks together."""
    return ASKED_TO_STOP if ASKED_TO_STOP in codes else max(codes, default=0)
