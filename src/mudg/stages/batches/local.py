"""Workers on this machine: started, watched, and started again when one is killed."""

from __future__ import annotations

import contextlib
import json
import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from multiprocessing.connection import Connection, wait
from typing import Any, Final

from mudg.base import log, processes
from mudg.stages.batches.work import ASKED_TO_STOP, Worker, WorkRequest

_GAVE_UP: Final = 9
_MOST_RESTARTS: Final = 20
"""Per worker: one that is killed again and again is not the fault of one scene."""

Report = Callable[[Mapping[str, Any]], None]


@dataclass(frozen=True)
class WorkersEnd:
    """How workers ended. counts: state -> steps; stopped: asked to; gave_up: for the number of failures."""

    counts: Mapping[str, int]
    stopped: bool = False
    gave_up: bool = False


def run_workers(request: WorkRequest, jobs: int, report: Report | None = None) -> WorkersEnd:
    """Do the request with ``jobs`` workers at a time; SIGTERM, SIGUSR1 and Ctrl-C stop them all, each with a checkpoint.

    Args:
        report: called for every step that ended, in this process.
    """
    if jobs == 1:
        worker = Worker(request, report)
        counts = worker.run()
        return WorkersEnd(counts, worker.stopped, worker.gave_up)
    return _WorkerGroup(request, jobs, report or (lambda _: None)).run()


class _WorkerGroup:
    """Worker processes, one per lane of the shard."""

    def __init__(self, request: WorkRequest, jobs: int, report: Report) -> None:
        self._request, self._jobs, self._report = request, jobs, report
        self._context = multiprocessing.get_context("spawn")
        self._running: dict[Connection, tuple[int, Any]] = {}
        self._restarts = 0
        self._stopping = False
        self._gave_up = False
        self._counts: dict[str, int] = {}

    def run(self) -> WorkersEnd:
        with self._signals():
            try:
                for lane in range(self._jobs):
                    self._start(lane)
                while self._running:
                    for connection in wait(list(self._running), 1.0):
                        if isinstance(connection, Connection):
                            self._hear(connection)
            finally:
                for _, process in self._running.values():
                    process.terminate()
                for _, process in self._running.values():
                    process.join()
        return WorkersEnd(self._counts, self._stopping, self._gave_up)

    def _start(self, lane: int) -> None:
        ours, theirs = self._context.Pipe(duplex=False)
        request = replace(self._request, lane=(lane, self._jobs))
        process = self._context.Process(target=_worker_process, args=(theirs, request, log.is_quiet()), name=f"mudg worker {lane}")
        process.start()
        theirs.close()
        self._running[ours] = (lane, process)

    def _hear(self, connection: Connection) -> None:
        try:
            told = json.loads(connection.recv_bytes())
        except (EOFError, OSError):
            self._ended(connection)
            return
        self._counts[told["state"]] = self._counts.get(told["state"], 0) + 1
        self._report(told)

    def _ended(self, connection: Connection) -> None:
        lane, process = self._running.pop(connection)
        connection.close()
        process.join()
        if process.exitcode == _GAVE_UP:
            self._gave_up = True
        elif process.exitcode not in (0, ASKED_TO_STOP) and not self._stopping and self._restarts < _MOST_RESTARTS * self._jobs:
            self._restarts += 1
            log.warn(f"a worker ended with code {process.exitcode} and is started again")
            self._start(lane)

    @contextlib.contextmanager
    def _signals(self) -> Iterator[None]:
        numbers = [signal.SIGTERM, signal.SIGINT, *([signal.SIGUSR1] if hasattr(signal, "SIGUSR1") else [])]
        try:
            before = {number: signal.signal(number, self._stop) for number in numbers}
        except ValueError:  # not the main thread
            yield
            return
        try:
            yield
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)

    def _stop(self, number: int, _frame: object) -> None:
        if self._stopping and number == signal.SIGINT:
            raise KeyboardInterrupt
        if not self._stopping:
            log.info("stopping: every running step writes its checkpoint")
        self._stopping = True
        for _, process in self._running.values():
            with contextlib.suppress(OSError, ValueError):
                process.terminate()


def _worker_process(connection: Connection, request: WorkRequest, quiet: bool) -> None:
    log.set_quiet(quiet)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches the whole group; the parent decides
    processes.end_with_parent()
    lock = threading.Lock()

    def report(told: Mapping[str, Any]) -> None:
        with lock, contextlib.suppress(OSError):
            connection.send_bytes(json.dumps(dict(told)).encode())

    worker = Worker(request, report)
    worker.run()
    connection.close()
    os._exit(ASKED_TO_STOP if worker.stopped else _GAVE_UP if worker.gave_up else 0)
