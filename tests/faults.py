"""Fault injection: every point at which something is put on the disk can fail, or be the last thing that a process
does."""

from __future__ import annotations

import errno
import os
import signal
import sys
import tempfile
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from mudg.base import store

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


def killed(number: int) -> Act:
    """The process is killed before the operation of this number."""

    def act(count: int, _name: str) -> None:
        if count == number:
            os.kill(os.getpid(), signal.SIGKILL)

    return act


def terminated(number: int) -> Act:
    """The process is asked to stop (SIGTERM) before the operation of this number."""

    def act(count: int, _name: str) -> None:
        if count == number:
            os.kill(os.getpid(), signal.SIGTERM)

    return act


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
        except OSError:
            code = 3
        finally:
            if code == 1:
                traceback.print_exc()  # pytest does not see what ended the child
            os._exit(code)
    _, status = os.waitpid(child, 0)
    return os.waitstatus_to_exitcode(status)


def contents(folder: Path) -> dict[str, bytes]:
    """Every file below a folder, without the record and the log of the run, which tell how long it took and how it
    went."""
    return {
        path.relative_to(folder).as_posix(): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file() and path.name not in ("run.json", "log.jsonl")
    }
