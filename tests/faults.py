"""Fault injection: every point at which something is put on the disk can fail, or be the last thing that a process
does."""

from __future__ import annotations

import errno
import os
import shutil
import signal
import sys
import tempfile
import traceback
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from mudg.base import store
from mudg.base.errors import MudgError

Act = Callable[[int, str], None]
"""What happens at a point: it gets the point's number, from 1 on, and its name."""


@contextmanager
def points(act: Act, root: Path) -> Iterator[list[str]]:
    """Call ``act`` before every operation below ``root`` that changes the disk: names such as ``replace out.txt``, in
    order.

    Operations are those of the system (a folder or temporary file made, bytes written or flushed, a file renamed or
    removed), so that a point lies before and after each single step of what the store promises to be one.
    """
    done: list[str] = []

    def point(kind: str, path: Any) -> None:
        place = os.path.abspath(str(path))
        if place.startswith(f"{root}{os.sep}"):
            done.append(f"{kind} {os.path.basename(place)}")
            act(len(done), done[-1])

    def before(kind: str, original: Callable[..., Any]) -> Callable[..., Any]:
        def call(path: Any, *rest: Any, **named: Any) -> Any:
            point(kind, path)
            return original(path, *rest, **named)

        return call

    mkstemp, append = tempfile.mkstemp, store.append_line

    def temporary(*rest: Any, **named: Any) -> Any:
        point("mkstemp", Path(named["dir"]) / named.get("prefix", ""))
        return mkstemp(*rest, **named)

    with pytest.MonkeyPatch.context() as patched:
        for kind in ("mkdir", "rename", "replace", "write_bytes", "unlink", "rmdir", "chmod"):
            patched.setattr(Path, kind, before(kind, getattr(Path, kind)))
        patched.setattr(store.tempfile, "mkstemp", temporary)
        patched.setattr(store, "append_line", before("append", append))
        yield done


def failing(number: int, code: int = errno.ENOSPC) -> Act:
    """The operation of this number, and every later one that needs space, fails as a full disk does (or a broken
    one)."""
    space = {"mkstemp", "mkdir", "write_bytes", "append", "replace", "rename"}

    def act(count: int, name: str) -> None:
        if count >= number and name.split(" ")[0] in space:
            raise OSError(code, os.strerror(code), name)

    return act


def killed(number: int, how: int = signal.SIGKILL) -> Act:
    """The process is killed before the operation of this number (or gets another signal)."""

    def act(count: int, _name: str) -> None:
        if count == number:
            os.kill(os.getpid(), how)

    return act


def terminated(number: int) -> Act:
    """The process is asked to stop (SIGTERM) before the operation of this number."""
    return killed(number, signal.SIGTERM)


def in_child(work: Callable[[], Any], act: Act, root: Path) -> int:
    """Do the work in a copy of this process; returns its exit status, negative for the signal that ended it.

    Forked, not spawned: a fresh interpreter would take seconds to load torch, for each of hundreds of points.
    """
    sys.stdout.flush()
    sys.stderr.flush()
    child = os.fork()
    if child == 0:
        code = 1
        try:
            with points(act, root):
                work()
            code = 0
        finally:
            if code == 1:
                traceback.print_exc()  # pytest does not see what ended the child
            os._exit(code)
    _, status = os.waitpid(child, 0)
    return os.waitstatus_to_exitcode(status)


def counted(work: Callable[[Path], Any], place: Path) -> list[str]:
    """Do the work in a new folder; returns its operations on the disk."""
    place.mkdir(exist_ok=True)
    with points(lambda *_: None, place) as found:
        work(place)
    return found


def sweep(
    work: Callable[[Path], Any],
    root: Path,
    stop: Callable[[int], Act],
    chosen: Callable[[list[str]], Iterable[int]],
    begun: Callable[[Path], object] = Path.mkdir,
) -> Iterator[tuple[Path, Any, str]]:
    """Stop the work in a folder, each time a new one that ``begun`` makes, at the chosen numbers of its operations on
    the disk. Yields the folder, for the work to be repeated there, its exit status (of a full disk, its error or what
    it returned), and the operation. Nothing temporary may be in the folder then, and it goes."""
    begun(root / "counted")
    operations = counted(work, root / "counted")
    for number in chosen(operations):
        place, act = root / f"stop{number}", stop(number)
        begun(place)
        if stop in (killed, terminated):
            end: Any = in_child(partial(work, place), act, place)
            assert end == -9 if stop is killed else end in (0, 1), number  # asked at the very end, it finishes
        else:
            try:
                with points(act, place):
                    end = work(place)
            except (MudgError, OSError) as error:
                end = error
        yield place, end, operations[number - 1]
        assert not [path for path in place.rglob("*") if ".part" in path.name], operations[number - 1]
        shutil.rmtree(place)


def every(step: int) -> Callable[[list[str]], Iterable[int]]:
    """Each so many-th operation."""
    return lambda operations: range(1, len(operations) + 1, step)


def contents(folder: Path) -> dict[str, bytes]:
    """Every file below a folder, without the record and the log of the run, which tell how long it took and how it
    went."""
    return {
        path.relative_to(folder).as_posix(): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file() and path.name not in ("run.json", "log.jsonl")
    }
