"""Pieces of work that need nothing of each other, each in a process of its own, at the same time.

The parent shows the progress of all. Ctrl-C (or a parent that dies) stops every child as Ctrl-C stops a verb: at the end of a
step, after a checkpoint; a second Ctrl-C ends them at once. If one fails, the others are stopped in the same way and its own
error is raised here. What parent and child tell each other is JSON text.
"""

from __future__ import annotations

import _thread
import contextlib
import json
import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from multiprocessing.connection import Connection, wait
from typing import Any

from mudg.base import log
from mudg.base.errors import InputError, IntegrityError, MudgError, NumericsError, ResourceError, UsageError

_ERRORS: dict[str, type[MudgError]] = {
    cls.__name__: cls for cls in (UsageError, InputError, IntegrityError, ResourceError, NumericsError)
}
_PATIENCE_S = 0.5


@dataclass(frozen=True)
class Task:
    """One piece of work: a name for people, and a function of a module with what it is called with."""

    name: str
    function: Callable[..., Any]
    arguments: tuple[Any, ...] = ()
    named: Mapping[str, Any] = field(default_factory=dict)


@dataclass
class _Child:
    task: Task
    process: Any
    pipe: Connection
    progress: str = "starting"
    outcome: dict[str, Any] | None = None


def run_side_by_side(tasks: Sequence[Task], threads_each: int) -> None:
    """Do all tasks at the same time, each in a process with ``threads_each`` native threads and one of torch's.

    Raises:
        MudgError: the error of the first task that failed, after the others have stopped; ResourceError if its process
            ended without a word. RuntimeError: a task failed by an error that is a bug (its trace is on stderr).
        KeyboardInterrupt: interrupted; all tasks have stopped.
    """
    children: list[_Child] = []
    try:
        for task in tasks:
            children.append(_start(task, threads_each))
        with log.task(" and ".join(task.name for task in tasks), len(tasks)) as bar:
            failed = _watch(children, bar)
        if failed is not None:
            _stop(children)
    except BaseException:
        _stop(children)
        raise
    if failed is not None:
        _raise(failed)


def _start(task: Task, threads: int) -> _Child:
    context = multiprocessing.get_context("spawn")
    mine, theirs = context.Pipe()
    process = context.Process(target=_work, args=(theirs, task, log.is_quiet()), name=task.name, daemon=True)
    with _environment(threads), _deaf_to_ctrl_c():
        process.start()
    theirs.close()
    return _Child(task, process, mine)


def _watch(children: Sequence[_Child], bar: log.Task) -> _Child | None:
    """Show what the children say until all have ended or one has failed, which is returned."""
    running = list(children)
    while running:
        for pipe in wait([child.pipe for child in running], _PATIENCE_S):
            child = next(c for c in running if c.pipe is pipe)
            if _heard(child):
                bar.update(" | ".join(c.progress for c in running))
                bar.advance(0)
                continue
            running.remove(child)
            child.process.join()
            if child.outcome is None or "done" not in child.outcome:
                return child
            bar.advance()
    return None


def _heard(child: _Child) -> bool:
    """Take one message; False when the child has ended."""
    try:
        message = json.loads(child.pipe.recv_bytes())
    except (EOFError, OSError):
        return False
    if "info" in message:
        log.info(f"{child.task.name}: {message['info']}")
    elif "warn" in message:
        log.warn(f"{child.task.name}: {message['warn']}")
    elif "progress" in message:
        child.progress = message["progress"]
    else:
        child.outcome = message
    return True


def _stop(children: Sequence[_Child]) -> None:
    """Ask every running child to stop after its step, and wait for it; a further Ctrl-C ends them at once."""
    for child in children:
        with contextlib.suppress(OSError):
            child.pipe.send_bytes(b"stop")
    try:
        for child in children:
            while _heard(child):
                pass
            child.process.join()
    except KeyboardInterrupt:
        for child in children:
            child.process.terminate()
        raise


def _raise(child: _Child) -> None:
    outcome = child.outcome or {}
    if "stopped" in outcome:
        raise KeyboardInterrupt
    if "error" in outcome:
        raise _ERRORS[outcome["error"]](outcome["what"], **outcome["fields"])
    code = child.process.exitcode
    if code == 1:
        raise RuntimeError(f"{child.task.name} failed; what went wrong is written above")
    raise ResourceError(
        f"the process of {child.task.name} ended without a word", got=f"exit code {code}" + (", killed" if code == -9 else ""),
        remedy="repeat the command to continue; MUDG_THREADS=1 does one thing at a time and takes less memory",
    )  # fmt: skip


# ---- in the child --------------------------------------------------------------------------------------------------


def _work(pipe: Connection, task: Task, quiet: bool) -> None:
    if hasattr(os, "setpgid"):
        os.setpgid(0, 0)  # Ctrl-C in the terminal is for the parent, which hands it on once
    signal.signal(signal.SIGINT, signal.default_int_handler)
    guard = threading.Lock()

    def tell(message: dict[str, Any]) -> None:
        with guard, contextlib.suppress(OSError):  # a parent that is gone hears nothing; the listener stops the work
            pipe.send_bytes(json.dumps(message).encode())

    threading.Thread(target=_listen, args=(pipe,), daemon=True).start()
    log.set_quiet(quiet)
    log.set_sink(tell)
    try:
        task.function(*task.arguments, **task.named)
        tell({"done": True})
    except MudgError as error:
        name = next((n for n, cls in _ERRORS.items() if type(error) is cls), "")
        if not name:
            raise
        fields = {"where": error.where, "expected": error.expected, "got": error.got, "remedy": error.remedy}
        tell({"error": name, "what": error.what, "fields": fields})
    except KeyboardInterrupt:
        tell({"stopped": True})


def _listen(pipe: Connection) -> None:
    """Interrupt the main thread once, when the parent says so or is gone."""
    parent = multiprocessing.parent_process()
    wait([pipe] if parent is None else [pipe, parent.sentinel])
    main = threading.main_thread().ident
    if hasattr(signal, "pthread_kill") and main is not None:
        signal.pthread_kill(main, signal.SIGINT)  # wakes it even where it waits for something
    else:
        _thread.interrupt_main()


@contextlib.contextmanager
def _environment(threads: int) -> Iterator[None]:
    """Environment for children: their threads, and waiting without spinning; must be there before they import torch."""
    wanted = {"OMP_NUM_THREADS": "1", "OMP_WAIT_POLICY": "PASSIVE", "MUDG_THREADS": str(threads)}
    before = {name: os.environ.get(name) for name in wanted}
    os.environ.update(wanted)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value


@contextlib.contextmanager
def _deaf_to_ctrl_c() -> Iterator[None]:
    """A child inherits that Ctrl-C is ignored, until it has a process group of its own."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
