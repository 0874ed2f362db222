"""Processes, threads, interrupts, and errors that cross a process boundary. Everything of that kind in the package is
here.

Children are spawned, never forked. What parent and child tell each other beside arguments and results is JSON text.
"""

from __future__ import annotations

import concurrent.futures
import contextlib
import functools
import itertools
import multiprocessing
import os
import signal
import sys
import threading
import time
import types
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
from concurrent.futures.process import BrokenProcessPool
from multiprocessing.connection import wait
from multiprocessing.context import SpawnContext
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any, TypeVar

from mudg.base import log
from mudg.base.errors import InputError, IntegrityError, MudgError, NumericsError, ResourceError, UsageError
from mudg.base.failures import ended_process, is_memory
from mudg.base.memory import GIB

Result = TypeVar("Result")
Future = concurrent.futures.Future

_ERRORS = {cls.__name__: cls for cls in (UsageError, InputError, IntegrityError, ResourceError, NumericsError)}
_POLL_S = 0.5
_NOTICED_AFTER = 20
"""Polls without a result in which a worker is dead, until the pool is given up."""
_PATIENCE_S = 60.0
"""Time that workers have to end when a command is stopped: a fit ends its step and writes a checkpoint."""
_SAME_SIGNAL_S = 10.0
"""A worker takes signals that come together for one: Ctrl-C reaches it from the terminal and again from its parent."""

# ---- threads and environment ---------------------------------------------------------------------


@contextlib.contextmanager
def one_torch_thread() -> Iterator[None]:
    """One torch thread in this block: sums depend on their number, results must not depend on how many are free."""
    import torch

    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


@contextlib.contextmanager
def child_environment() -> Iterator[None]:
    """Environment of processes started in this block: one thread each, and waiting without spinning."""
    counts = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MUDG_THREADS")
    wanted = {"OMP_WAIT_POLICY": "PASSIVE", **dict.fromkeys(counts, "1")}
    before = {name: os.environ[name] for name in wanted if name in os.environ}
    os.environ.update(wanted)
    try:
        yield
    finally:
        for name in wanted:
            os.environ.pop(name, None)
        os.environ.update(before)


# ---- other processes -----------------------------------------------------------------------------


def process_alive(pid: int) -> bool:
    """Whether a process with this id runs on this machine."""
    import psutil  # late: --help does without

    return psutil.pid_exists(pid)


# ---- interrupts ----------------------------------------------------------------------------------

_NOTICES = (signal.SIGUSR1,) if hasattr(signal, "SIGUSR1") else ()
"""Signals that announce the end of a job."""


class Interruption:
    """Ctrl-C, SIGTERM and SIGUSR1 (with which batch systems announce the end of a job) wait for the end of the step, so
    that a checkpoint can be written; a second one does not wait. Outside the main thread signals are left as they are.

    repeated_within_s: a signal that comes again within this time is taken for the same one. Launchers such as torchrun
    pass on a signal that the terminal has sent already; so does the parent of a worker process (10 s).
    """

    def __init__(self, repeated_within_s: float = 0.0) -> None:
        in_worker = multiprocessing.parent_process() is not None
        self._repeated_within_s = max(repeated_within_s, _SAME_SIGNAL_S if in_worker else 0.0)
        self._number = 0
        self._since_s = 0.0
        self._before: dict[int, Any] = {}

    def __enter__(self) -> Interruption:
        if threading.current_thread() is threading.main_thread():
            self._before = {n: signal.signal(n, self._note) for n in (signal.SIGINT, signal.SIGTERM, *_NOTICES)}
        return self

    def __exit__(self, *_: object) -> None:
        for number, before in self._before.items():
            signal.signal(number, before)
        self._before = {}

    def _note(self, number: int, frame: types.FrameType | None) -> None:
        now = time.monotonic()
        if self._number and now - self._since_s > self._repeated_within_s:
            self.stop_now(number, frame)
        if not self._number:
            self._number, self._since_s = number, now
            log.info("stopping after this step; once more to stop at once")

    @property
    def requested(self) -> bool:
        """Whether this process was asked to stop."""
        return self._number != 0

    def stop_now(self, number: int = 0, frame: types.FrameType | None = None) -> None:
        """Do what the signal would have done at once: raise KeyboardInterrupt, or what the program has set."""
        number = number or self._number
        number = signal.SIGTERM if number in _NOTICES else number
        before = self._before.get(number)
        if callable(before):
            before(number, frame)
        raise KeyboardInterrupt


# ---- errors as JSON values -----------------------------------------------------------------------


def error_record(error: MudgError) -> dict[str, Any]:
    """An error as JSON values; ``error_from_record`` makes it again."""
    return {"error": type(error).__name__, "what": error.what, "fields": error.fields}


def error_from_record(record: Mapping[str, Any]) -> MudgError:
    """The error that ``error_record`` wrote; the class comes from a literal table."""
    return _ERRORS.get(record["error"], MudgError)(record["what"], **record["fields"])


# ---- one function over many arguments ------------------------------------------------------------


def run_in_processes(
    function: Callable[..., Result], arguments: Sequence[tuple[Any, ...]], processes: int
) -> Iterator[tuple[int, Result]]:
    """Call a module's ``function`` with each of ``arguments`` in processes of one thread each (``processes`` = 1: in
    this one); yields index and result as they come. Where this process is stopped (Ctrl-C, SIGTERM), or the caller
    wants no more results, calls that run are stopped, too.

    Raises what the function raises, and ResourceError where a process ended from outside; calls that have not begun are
    dropped.
    """
    if processes == 1:
        with one_torch_thread():
            for index, items in enumerate(arguments):
                yield index, function(*items)
        return
    with child_environment(), _working(processes) as pool:
        try:
            yield from _in_turn(pool, function, arguments, processes)
        except BrokenProcessPool:
            raise
        except Exception:
            pool.shutdown(cancel_futures=True)  # the other calls end
            raise
        pool.shutdown()


@contextlib.contextmanager
def _working(processes: int) -> Iterator[Pool]:
    """A pool for this block. Where it is stopped, so are the calls; a worker that died ends all others."""
    pool = Pool(processes)
    try:
        yield pool
    except (KeyboardInterrupt, GeneratorExit):
        _stop(pool)
        raise
    except BrokenProcessPool as error:
        _each(BaseProcess.kill, pool.members)
        raise ended_process(str(error)) from error
    finally:
        pool.shutdown(wait=False, cancel_futures=True)


@contextlib.contextmanager
def calls_beside(
    function: Callable[..., object], arguments: Sequence[tuple[Any, ...]], processes: int
) -> Iterator[None]:
    """``run_in_processes`` while the block runs, without results. Once a call fails, none begins any more. At the end
    of the block calls that have not begun are dropped, and those that run are waited for; where it ends with an error
    or is stopped (Ctrl-C, SIGTERM), they are stopped. Errors of calls are raised at the end of the block."""
    with _working(processes) as pool:
        with child_environment():
            futures = [pool.submit(_stoppable, function, items) for items in arguments]

        def drop_rest(done: Future[Any]) -> None:
            if not done.cancelled() and done.exception() is not None:
                for future in futures:
                    future.cancel()

        for future in futures:
            future.add_done_callback(drop_rest)
        try:
            yield
        except BaseException:
            _stop(pool)
            raise
        for future in futures:
            future.cancel()
        for _ in _as_completed(pool, {future: index for index, future in enumerate(futures) if not future.cancelled()}):
            pass


def _in_turn(
    pool: Pool, function: Callable[..., Result], arguments: Sequence[tuple[Any, ...]], processes: int
) -> Iterator[tuple[int, Result]]:
    """Results as they come. No more calls are handed out than there are processes: the pool cannot take back one that
    waits in its queue, and after an error it would still be begun."""
    futures: dict[Future[Result], int] = {}
    rest = iter(enumerate(arguments))

    def hand_out(count: int) -> list[Future[Result]]:
        given = [(pool.submit(_stoppable, function, items), index) for index, items in itertools.islice(rest, count)]
        futures.update(given)
        return [future for future, _ in given]

    hand_out(processes)
    return _as_completed(pool, futures, lambda: hand_out(1))


def _as_completed(
    pool: Pool, futures: Mapping[Future[Result], int], next_of: Callable[[], Sequence[Future[Result]]] = tuple
) -> Iterator[tuple[int, Result]]:
    """Results as they come; ``next_of`` hands out what takes the place of a call that has ended well. The pool itself
    does not notice every death: its own threads can be short of memory, too."""
    waiting, dead_for = set(futures), 0
    while waiting:
        done, waiting = concurrent.futures.wait(waiting, _POLL_S, concurrent.futures.FIRST_COMPLETED)
        # errors first: after one, nothing is handed out
        for future in sorted(done, key=lambda one: one.exception() is None):
            if isinstance(future.exception(), KeyboardInterrupt):
                raise BrokenProcessPool("a worker was stopped")
            result = future.result()
            waiting.update(next_of())
            yield futures[future], result
        dead_for = dead_for + 1 if not done and any(not one.is_alive() for one in pool.members) else 0
        if dead_for > _NOTICED_AFTER:
            raise BrokenProcessPool("a worker is gone")


def _each(act: Callable[[BaseProcess], None], members: Iterable[BaseProcess]) -> None:
    for process in members:
        with contextlib.suppress(OSError, ValueError):  # it has ended
            act(process)


def _stop(pool: Pool) -> None:
    """End the calls of a pool: a fit writes its checkpoint. Who does not end in time, or at an interrupt, is killed."""
    waiting, begun_s = {process.sentinel: process for process in pool.members}, time.monotonic()
    pool.shutdown(wait=False, cancel_futures=True)
    try:
        while waiting and time.monotonic() < begun_s + _PATIENCE_S:
            if time.monotonic() < begun_s + _SAME_SIGNAL_S / 2:  # again: one that another thread takes wakes nobody
                _each(BaseProcess.terminate, waiting.values())
            for ended in wait(list(waiting), _POLL_S):
                del waiting[ended]  # type: ignore[arg-type]
    finally:
        _each(BaseProcess.kill, waiting.values())


_stop_asked = threading.Event()
"""Set in a worker that was asked to stop: it begins no further call."""


def _stoppable(function: Callable[..., Result], items: tuple[Any, ...]) -> Result:
    """A call in a worker; SIGTERM and Ctrl-C raise KeyboardInterrupt in it, unless it takes them (``Interruption``)."""

    def stop(*_: object) -> None:
        if not _stop_asked.is_set():  # once: what tidies up is not stopped again
            _stop_asked.set()
            raise KeyboardInterrupt

    heard = [n for n in (signal.SIGINT, signal.SIGTERM) if signal.getsignal(n) != signal.SIG_IGN]
    try:
        for number in heard:
            signal.signal(number, stop)
        if _stop_asked.is_set():
            raise KeyboardInterrupt
        return function(*items)
    finally:
        for number in heard:
            signal.signal(number, lambda *_: _stop_asked.set())


class _Spawning(SpawnContext):
    """Starts the processes of one pool, and knows them."""

    def __init__(self) -> None:
        self.made: list[BaseProcess] = []

    def Process(self, *args: Any, **options: Any) -> BaseProcess:  # type: ignore[override]
        self.made.append(SpawnContext.Process(*args, **options))
        return self.made[-1]


class Pool(concurrent.futures.ProcessPoolExecutor):
    """A pool of quiet processes, to be used within ``child_environment``: of one thread each."""

    def __init__(self, processes: int) -> None:
        self._spawning = _Spawning()
        super().__init__(processes, mp_context=self._spawning, initializer=_prepare_child)

    @property
    def members(self) -> list[BaseProcess]:
        """All processes that were started, also those that have ended."""
        return [process for process in self._spawning.made if process.pid is not None]


def _prepare_child() -> None:
    log.set_quiet(True)
    parent = multiprocessing.parent_process()
    if parent is not None:  # a worker would wait for work for ever
        _end_after(functools.partial(wait, [parent.sentinel]), "parent")


def _end_after(event: Callable[[], object], name: str) -> None:
    def end() -> None:
        with contextlib.suppress(OSError):
            event()
            os._exit(1)

    threading.Thread(target=end, name=name, daemon=True).start()


LIFE_LINE = "MUDG_LIFE_LINE"
"""Environment variable: number of a file that ends when the process that started this one is gone."""


@contextlib.contextmanager
def life_line() -> Iterator[int]:
    """A file number for a command (in ``LIFE_LINE``, and kept open there): it ends when this process does."""
    theirs, ours = os.pipe()
    try:
        yield theirs
    finally:
        os.close(theirs)
        os.close(ours)


def hold_life_line() -> None:
    """End this process when the one that started it, and gave it a life line, is gone."""
    number = os.environ.pop(LIFE_LINE, "")
    if number.isdecimal():
        _end_after(lambda: os.fdopen(int(number), "rb").read(), "life line")


def computed_ahead(compute: Callable[[int], Result], count: int, threads: int) -> Generator[Result, None, None]:
    """``compute(0)``, ``compute(1)``, ... in order, a few ahead in other threads, each with one torch thread."""
    with one_torch_thread(), concurrent.futures.ThreadPoolExecutor(threads) as pool:
        waiting: deque[Future[Result]] = deque()
        try:
            for number in range(count):
                waiting.append(pool.submit(compute, number))
                if len(waiting) > 2 * threads:
                    yield waiting.popleft().result()
            while waiting:
                yield waiting.popleft().result()
        finally:  # whoever stops asking, or fails, does not wait for what has not begun
            pool.shutdown(wait=False, cancel_futures=True)


# ---- one call under a limit of memory ------------------------------------------------------------


def run_limited(work: Callable[[], None], limit_bytes: int, where: Path) -> int:
    """Do the work, a call on the file ``where``, in a fresh process that may take ``limit_bytes`` of address space
    beyond the program's own (on Linux). Returns its peak of resident memory in bytes (0: no such limit). ResourceError:
    the limit was reached, or the process was ended from outside. And what the work itself raises."""
    if sys.platform != "linux":
        log.warn("this system has no limit of address space; a hostile file may take all memory")
    with child_environment(), Pool(1) as pool:
        try:
            return pool.submit(_limited, work, limit_bytes, where).result()
        except BrokenProcessPool as error:
            what = "the converting process was ended from outside, most likely for want of memory"
            expected = f"about {limit_bytes / GIB:.0f} GiB of address space, of which the file takes most"
            remedy = "close other programs, raise the limit (ulimit -v), or take a machine with more memory"
            raise ResourceError(what, where=str(where), expected=expected, remedy=remedy) from error


def _limited(work: Callable[[], None], limit_bytes: int, where: Path) -> int:
    if sys.platform != "linux":
        work()
        return 0
    import resource

    import psutil

    most = psutil.Process().memory_info().vms + limit_bytes
    hard = resource.getrlimit(resource.RLIMIT_AS)[1]  # of the shell (ulimit -v), which cannot be raised
    most = most if hard == resource.RLIM_INFINITY else min(most, hard)
    resource.setrlimit(resource.RLIMIT_AS, (most, most))
    try:
        work()
    except (MemoryError, RuntimeError) as error:
        if not is_memory(error):
            raise
        what, expected = "conversion needs more memory than it may take", f"<= {limit_bytes / 1e9:.1f} GB"
        got, remedy = (str(error).splitlines() or [""])[0][:200], "raise --memory-gb, unless the file should be small"
        raise ResourceError(what, where=str(where), expected=expected, got=got, remedy=remedy) from error
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
