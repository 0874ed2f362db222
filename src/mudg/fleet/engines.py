"""Engines: who runs the scenes of a batch. Threads of this process, tasks of a Ray cluster, or an array job of Slurm,
through submitit.

Scheduling, retries of lost workers and requeueing belong to the engine. All of them call ``Job.run``, which does only
what is missing.
"""

from __future__ import annotations

import concurrent.futures
import os
import signal
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

from mudg.base import log, store
from mudg.base.errors import ResourceError, UsageError
from mudg.fleet.plan import Entry
from mudg.fleet.records import Ended
from mudg.fleet.settings import BatchConfig
from mudg.fleet.work import LOST, Job, Stop

Tell = Callable[[Ended], None]
_LOST_NODES: Final = 20
"""How often Ray runs a scene again whose node or process is gone."""
_AT_ONCE: Final = 2000
"""Scenes that wait in Ray's queue at a time."""
_GB: Final = 1_000_000_000

# this machine -------------------------------------------------------------------------------------


@dataclass
class LocalRun:
    """Scenes on this machine, ``jobs`` at a time."""

    job: Job
    entries: Sequence[Entry]
    jobs: int
    stop: Stop
    _scenes: list[concurrent.futures.Future[list[Ended]]] = field(default_factory=list)

    def run(self, tell: Tell) -> None:
        """Do them all. Ctrl-C and SIGTERM stop steps with a checkpoint, a second one at once: KeyboardInterrupt."""
        steps_of = lambda entry: [] if self.stop.asked else self.job.run(entry, self.stop)
        with concurrent.futures.ThreadPoolExecutor(self.jobs) as pool:
            try:
                self._scenes = [pool.submit(steps_of, entry) for entry in self.entries]
                for scene in concurrent.futures.as_completed(self._scenes):
                    for report in scene.result():
                        tell(report)
            except BaseException:
                self.stop.ask()
                try:
                    self.wait()
                except KeyboardInterrupt:
                    self.stop.ask()
                raise

    def wait(self) -> None:
        """Wait until no step runs."""
        concurrent.futures.wait(self._scenes)


# Ray ----------------------------------------------------------------------------------------------


def run_on_ray(job: Job, entries: Sequence[Entry], batch: BatchConfig, tell: Tell) -> None:
    """One task of a Ray cluster per scene: the one at ``ray_address``, the one Ray finds, or one on this machine.
    ResourceError: Ray is not installed, or no cluster answers. KeyboardInterrupt: stopped; running steps have written
    checkpoints."""
    try:
        import ray
    except ImportError as error:
        what, remedy = "the package ray is not installed", "pip install 'mudg[ray]'"
        raise ResourceError(what, where="--engine ray", remedy=remedy) from error
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    if not ray.is_initialized():
        try:
            ray.init(address=batch.ray_address or None, log_to_driver=False, logging_level="warning")
        except (ConnectionError, ValueError, RuntimeError) as error:
            got = str(error).split("\n")[0][:300]
            raise ResourceError("no Ray cluster answers", where="--ray-address", got=got) from error
    memory = {"memory": int(batch.memory_gb * _GB)} if batch.memory_gb else {}
    options: dict[str, Any] = {"num_cpus": batch.cpus, "num_gpus": batch.gpus, "max_retries": _LOST_NODES, **memory}
    task, common = ray.remote(scheduling_strategy="SPREAD", **options)(_ray_task), ray.put(job)
    left, running = deque(entries), dict[Any, Entry]()
    try:
        while left or running:
            while left and len(running) < _AT_ONCE:
                entry = left.popleft()
                running[task.remote(common, entry)] = entry
            for one in ray.wait(list(running), timeout=1.0)[0]:
                entry = running.pop(one)
                try:
                    for report in ray.get(one):
                        tell(report)
                except ray.exceptions.RayError as error:
                    words = str(error).splitlines()[0][:300]
                    tell(Ended(scene=entry.name, stage=job.plan.stages[0].name, key="none", state=LOST, words=words))
    except KeyboardInterrupt:
        for one in running:
            ray.cancel(one, force=False)
        ray.wait(list(running), num_returns=len(running), timeout=job.grace_s + 10) if running else None
        raise


def _ray_task(job: Job, entry: Entry) -> list[Ended]:
    log.set_quiet(True)
    return job.run(entry, Stop(job.grace_s))


# Slurm --------------------------------------------------------------------------------------------

_OWN_OPTIONS: Final = set("array job-name signal requeue no-requeue open-mode output error cpus-per-task".split())


class SlurmTask:
    """The scenes of one task of an array job. Told that its time ends, it writes checkpoints, and submitit puts it back
    into the queue."""

    def __init__(self, job: Job, entries: Sequence[Entry]) -> None:
        self._job, self._entries = job, entries
        self._run: LocalRun | None = None

    def __call__(self) -> dict[str, int]:
        """Do the scenes; returns how many steps ended how."""
        counts: dict[str, int] = {}
        self._run = LocalRun(self._job, self._entries, 1, Stop(self._job.grace_s))
        signal.signal(signal.SIGTERM, lambda *_: self._run.stop.ask() if self._run is not None else None)
        self._run.run(lambda report: counts.update({report.state: counts.get(report.state, 0) + 1}))
        self._run = None
        return counts

    def checkpoint(self) -> Any:
        """Called by submitit when the job is about to end: stop, and say what is to be run again."""
        from submitit.helpers import DelayedSubmission

        if self._run is not None:
            self._run.stop.ask()
            self._run.wait()
        return DelayedSubmission(SlurmTask(self._job, self._entries))


def submit_to_slurm(job: Job, entries: Sequence[Entry], batch: BatchConfig) -> tuple[str, Path]:
    """Submit an array job of ``batch.jobs`` tasks; returns its number and the folder of its messages. ResourceError:
    submitit is not installed, there is no Slurm, or it refuses. UsageError: options that cannot be."""
    try:
        import submitit
        from submitit.core.utils import FailedJobError
    except ImportError as error:
        what, remedy = "the package submitit is not installed", "pip install 'mudg[slurm]'"
        raise ResourceError(what, where="--engine slurm", remedy=remedy) from error
    given: dict[str, str | bool] = {}
    for text in batch.slurm_options:
        name, equals, value = text.partition("=")
        if not name or name.startswith("-") or any(letter in text for letter in "\n\r") or name in _OWN_OPTIONS:
            what, got = "not an option for the array job", text[:80]
            expected = "NAME or NAME=VALUE without dashes, other than " + ", ".join(sorted(_OWN_OPTIONS))
            raise UsageError(what, where="--slurm-options", got=got, expected=expected)
        given[name] = value if equals else True
    if "time" not in given:
        what, expected = "Slurm needs to know how long a task may run", "time=4:00:00 among them"
        raise UsageError(what, where="--slurm-options", expected=expected)
    folder = job.folder.own / "slurm"
    store.make_folder(folder)
    folder.chmod(0o700)  # tasks are pickles that nobody else may write
    count = max(1, min(batch.jobs or 1, len(entries)))
    try:
        executor = submitit.AutoExecutor(folder=folder / "%j", cluster="slurm", slurm_max_num_timeout=1000)
        executor.update_parameters(
            name="mudg-batch",
            cpus_per_task=max(1, round(batch.cpus)),
            slurm_signal_delay_s=int(batch.grace_s) + 20,
            slurm_array_parallelism=count,
            slurm_additional_parameters={**given, "requeue": True},
            **({"mem_gb": batch.memory_gb} if batch.memory_gb else {}),
            **({"gpus_per_node": round(batch.gpus)} if batch.gpus else {}),
        )
        with executor.batch():
            tasks = [executor.submit(SlurmTask(job, entries[index::count])) for index in range(count)]
    except (RuntimeError, FailedJobError, OSError) as error:
        what, remedy = "Slurm refused, or is not on this machine", "run this on a login node, or take another --engine"
        raise ResourceError(what, where="sbatch", got=str(error).strip()[:500], remedy=remedy) from error
    return str(tasks[0].job_id).partition("_")[0], folder
