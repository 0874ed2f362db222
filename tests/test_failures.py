"""Memory, disks, files and processes that fail: every command ends in words and with an exit code, and nothing waits
for ever."""

from __future__ import annotations

import errno
import os
import signal
import subprocess
import sys
import time
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path

import numpy as np
import pytest
import torch
from test_hostile_files import ends_within

from mudg import app
from mudg.base import failures, memory
from mudg.base.errors import InputError, ResourceError
from mudg.base.processes import run_in_processes
from mudg.steps.synthesize import Learn

FULL = Path("/dev/full")
needs_full_device = pytest.mark.skipif(not FULL.exists(), reason="needs /dev/full")


def allocation_error() -> BaseException:
    """What torch says when memory is short."""
    with pytest.raises(RuntimeError) as failed:
        torch.empty(1 << 60, dtype=torch.uint8)
    return failed.value


def array_error() -> BaseException:
    with pytest.raises(MemoryError) as failed:
        np.empty((1 << 30, 1 << 30), np.float32)
    return failed.value


# ---- in words ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("error", "what", "asked"),
    [
        (array_error, "not enough memory", "4.00 EiB for an array with shape (1073741824, 1073741824)"),
        (allocation_error, "not enough memory", "TiB"),
        (lambda: MemoryError(), "not enough memory", ""),
        (lambda: ImportError("libtorch_cpu.so: failed to map segment from shared object"), "not enough memory", ""),
        (lambda: OSError(errno.ENOMEM, "Cannot allocate memory"), "not enough memory", ""),
        (lambda: OSError(errno.ENOSPC, "No space left on device", "runs/x"), "disk is full", ""),
        (lambda: OSError(errno.EIO, "Input/output error", "runs/x"), "could not be read or written", ""),
        (lambda: OSError(errno.EMFILE, "Too many open files", "runs/x"), "too many files", ""),
        (lambda: OSError(errno.EXDEV, "Invalid cross-device link", "a", None, "b"), "system refused", ""),
        (lambda: BrokenProcessPool("gone"), "ended without a word", ""),
    ],
)
def test_errors_of_the_system_are_put_in_words(
    error: object, what: str, asked: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    made = error()
    told = failures.in_words(made, "smaller views (--width-px)")
    assert isinstance(told, ResourceError) and what in told.what and told.remedy and asked in told.expected
    if what == "not enough memory":
        assert "--width-px" in told.remedy and "free" in told.got
    if getattr(made, "filename", None):
        assert str(made.filename) in told.where

    def fail(_args: object) -> dict[str, object]:
        raise made

    monkeypatch.setattr(Learn, "run", fail)
    assert app.main(["learn", "--out", "x"]) == 5
    said = capsys.readouterr().err
    assert what in said and "what to do" in said and "Traceback" not in said


def test_mistakes_of_the_program_stay_what_they_are() -> None:
    for error in (KeyError("a"), RuntimeError("shape mismatch"), ImportError("no module"), ZeroDivisionError()):
        assert failures.in_words(error) is None
    own = InputError("x")
    assert failures.in_words(own) is own


def test_an_allocation_that_cannot_succeed_is_not_tried(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(memory, "free_bytes", lambda: 3 << 30)
    memory.require(2 << 30, "one view", "--width-px")
    with pytest.raises(ResourceError, match=r"8\.0 GiB") as refused:
        memory.require(8 << 30, "one view of 9 x 9", "--width-px")
    assert refused.value.got == "3.0 GiB free" and refused.value.remedy == "--width-px"
    monkeypatch.setattr(memory, "free_bytes", lambda: 0)  # a system that does not say
    memory.require(8 << 40, "one view", "")


# ---- streams -------------------------------------------------------------------------------------


def run_mudg(redirections: str, *words: str, limit: str = "") -> subprocess.CompletedProcess[str]:
    """One command of a shell; what it writes elsewhere than into the redirections comes back."""
    command = f"{limit}exec {sys.executable} -m mudg {' '.join(words)} {redirections}"
    return subprocess.run(["sh", "-c", command], capture_output=True, text=True, timeout=60, check=False)


@needs_full_device
@pytest.mark.parametrize(
    ("redirections", "words", "code"),
    [
        (">/dev/full", ("--help",), 5),
        (">/dev/full", ("fit", "--help"), 5),
        ("2>/dev/full", ("fit", "nothing"), 2),
        ("2>&-", ("nonsense",), 2),
        (">&-", ("--version",), 5),
        ("2>/dev/full", ("--version",), 0),
    ],
    ids=str,
)
def test_streams_that_cannot_be_written_end_nothing_badly(redirections: str, words: tuple[str, ...], code: int) -> None:
    done = run_mudg(redirections, *words)
    assert done.returncode == code, done.stderr
    assert "Traceback" not in done.stderr and "Exception ignored" not in done.stderr


@pytest.mark.skipif(sys.platform != "linux", reason="needs ulimit -v")
def test_too_little_address_space_is_said_before_anything_is_loaded() -> None:
    done = run_mudg("", "fit", "scene", "--fused", "x", "--out", "y", limit="ulimit -v 700000; ")
    assert done.returncode == 5, done.stderr
    assert "at least 1.0 GiB of address space" in done.stderr and "ulimit -v" in done.stderr


# ---- processes -----------------------------------------------------------------------------------


def die(how: str) -> str:
    """End this process in a way that no program can catch."""
    if how == "signal":
        os.kill(os.getpid(), signal.SIGKILL)
    if how == "exit":
        os._exit(0)
    time.sleep(0.0 if how == "" else 600)
    return how


class Deadly:
    """An argument that ends the process which reads it."""

    def __init__(self, size: int) -> None:
        self.content = bytes(size)

    def __reduce__(self) -> object:
        return (die, ("signal",), None, None, iter([("content", self.content)]))


@pytest.mark.slow
@pytest.mark.parametrize("how", ["signal", "exit"])
def test_a_worker_that_dies_ends_the_work_of_all(how: str) -> None:
    with ends_within(60), pytest.raises(ResourceError, match="ended without a word"):
        list(run_in_processes(die, [(how,), ("long",)], 2))


@pytest.mark.slow
def test_a_worker_that_dies_while_it_is_sent_work_ends_the_work_of_all() -> None:
    with ends_within(60), pytest.raises(ResourceError, match="ended without a word"):
        list(run_in_processes(die, [(Deadly(50_000_000),)] * 4, 2))


SHORT_OF_MEMORY = """
import resource, sys
sys.path[:0] = sys.argv[1:]
import test_failures
from mudg.base import failures
from mudg.base.processes import run_in_processes
if __name__ == "__main__":
    resource.setrlimit(resource.RLIMIT_AS, (500 << 20, 8 << 30))
    try:
        list(run_in_processes(test_failures.die, [("",)] * 2, 2))
    except Exception as error:
        sys.exit(55 if failures.in_words(error) else 1)
"""


@pytest.mark.slow
def test_workers_without_memory_to_start_end_the_work(tmp_path: Path) -> None:
    (tmp_path / "parent.py").write_text(SHORT_OF_MEMORY)
    places = [str(Path(__file__).parent), *(path for path in sys.path if path)]
    command = [sys.executable, str(tmp_path / "parent.py"), *places]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 55, done.stderr[-2000:]
