"""Other processes: an error that comes from one is its own, and workers end with their parent."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from refusals import refused

from mudg.base.errors import NumericsError
from mudg.base.processes import (
    Interruption,
    calls_beside,
    error_from_record,
    error_record,
    process_alive,
    run_in_processes,
)

PATIENCE_S = 60.0


def wait_for(path: Path) -> None:
    """Until the file is there."""
    end = time.monotonic() + PATIENCE_S
    while not path.exists():
        if time.monotonic() > end:
            raise TimeoutError(str(path))
        time.sleep(0.01)


def folders(root: Path, *names: str) -> list[Path]:
    made = [root / name for name in names]
    for folder in made:
        folder.mkdir()
    return made


def test_an_error_crosses_a_process_boundary_as_it_is() -> None:
    sent = NumericsError("a loss is not finite", where="view 3, step 9", got="nan", remedy="look")
    error = error_from_record(json.loads(json.dumps(error_record(sent))))
    assert isinstance(error, NumericsError) and (error.what, error.fields) == (sent.what, sent.fields)


def mark(folder: Path) -> None:
    """Say which process works in a folder, at once and whole."""
    (folder / "starting").write_text(str(os.getpid()))
    (folder / "starting").rename(folder / "started")


def sleep_long(folder: Path) -> None:
    """Says which process it is, and works for longer than any test waits."""
    mark(folder)
    time.sleep(600)


def begin_and_fail(folder: Path, fails: bool) -> None:
    """Says that it has begun; one call fails at once, the others take a moment."""
    (folder / "begun").write_text("")
    if fails:
        raise NumericsError("a loss is not finite")
    time.sleep(0.5)


def test_after_an_error_no_call_begins_any_more(tmp_path: Path) -> None:
    places = folders(tmp_path, *"abcdef")
    with pytest.raises(NumericsError, match="not finite"):
        list(run_in_processes(begin_and_fail, [(place, place.name == "a") for place in places], 2))
    assert {place.name for place in places if (place / "begun").exists()} <= {"a", "b"}
    found = run_in_processes(begin_and_fail, [(place, False) for place in places], 3)
    assert sorted(found) == [(n, None) for n in range(6)] and all((place / "begun").exists() for place in places)


def test_workers_of_a_parent_that_is_killed_end(tmp_path: Path) -> None:
    (folder,) = folders(tmp_path, "a")
    script = (
        "import sys; sys.path[:0] = sys.argv[2:]\nfrom pathlib import Path\nimport test_processes as t\n"
        "from mudg.base.processes import run_in_processes\n"
        "if __name__ == '__main__': list(run_in_processes(t.sleep_long, [(Path(sys.argv[1]),)] * 2, 2))"
    )
    (tmp_path / "parent.py").write_text(script)
    places = [str(Path(__file__).parent), *(path for path in sys.path if path)]
    parent = subprocess.Popen([sys.executable, str(tmp_path / "parent.py"), str(folder), *places])
    wait_for(folder / "started")
    time.sleep(0.2)
    worker = int((folder / "started").read_text())
    parent.kill()
    parent.wait()
    for _ in range(200):
        if not process_alive(worker):
            return
        time.sleep(0.1)
    os.kill(worker, 9)
    raise AssertionError("the worker outlived its parent")


def work_in_steps(folder: Path) -> None:
    """Works like a fit: a signal is taken at the end of a step, and a checkpoint is written."""
    with Interruption() as interruption:
        mark(folder)
        while not interruption.requested:
            time.sleep(0.05)
        time.sleep(0.5)
        (folder / "checkpoint").touch()
        interruption.stop_now()


def work_with_cleanup(folder: Path) -> None:
    """Works like any other step, and tidies up when it is stopped."""
    try:
        sleep_long(folder)
    finally:
        (folder / "tidy").touch()


def fail_soon(folder: Path) -> None:
    """Fails when the other call has begun."""
    mark(folder)
    wait_for(folder.parent / "1cleanup" / "started")
    raise NumericsError("a loss is not finite")


def call(name: str, folder: Path) -> None:
    """One of the calls above, or one that must not begin."""
    {"steps": work_in_steps, "cleanup": work_with_cleanup, "never": sleep_long, "fails": fail_soon}[name](folder)


IN_TURN = "for _ in run_in_processes(t.call, calls, 2):\n        pass"
BESIDE = "with calls_beside(t.call, calls, 2):\n        time.sleep(600)"


def stopped_command(
    tmp_path: Path, number: int, *, group: bool, calling: str = IN_TURN, first: str = "steps", after_s: float = 0.2
) -> tuple[int, str, list[int]]:
    """A command with two calls that run and three that wait gets a signal: exit code, what it said, workers."""
    names = [first, "cleanup", "never", "never", "never"]
    given = folders(tmp_path, *(f"{index}{name}" for index, name in enumerate(names)))
    script = (
        "import signal, sys, time; sys.path[:0] = sys.argv[2:]\nfrom pathlib import Path\n"
        "import test_processes as t\nfrom mudg import app\nfrom mudg.steps.doctor import Doctor\n"
        "from mudg.base.processes import calls_beside, run_in_processes\n"
        "def work(_args):\n"
        "    folders = sorted(Path(sys.argv[1]).glob('[0-9]*'))\n"
        "    calls = [(f.name[1:], f) for f in folders]\n"
        f"    {calling}\n"
        "    return {}\n"
        "if __name__ == '__main__':\n"
        # ignored in what a script starts in the background
        "    signal.signal(signal.SIGINT, signal.default_int_handler)\n"
        "    Doctor.run = work\n"
        "    sys.exit(app.main(['doctor']))\n"
    )
    (tmp_path / "parent.py").write_text(script)
    places = [str(Path(__file__).parent), *(path for path in sys.path if path)]
    command = [sys.executable, str(tmp_path / "parent.py"), str(tmp_path), *places]
    with subprocess.Popen(command, start_new_session=True, stderr=subprocess.PIPE, text=True) as parent:
        try:
            wait_for(given[0] / "started")
            wait_for(given[1] / "started")
            time.sleep(after_s)
            os.killpg(parent.pid, number) if group else os.kill(parent.pid, number)
            said = parent.communicate(timeout=PATIENCE_S)[1]
        finally:
            if parent.poll() is None:
                os.killpg(parent.pid, signal.SIGKILL)
    return parent.returncode, said, [int((folder / "started").read_text()) for folder in given[:2]]


@pytest.mark.skipif(os.name == "nt", reason="signals of POSIX systems")
@pytest.mark.parametrize(
    ("number", "group", "code", "calling"),
    [
        (signal.SIGTERM, False, 143, IN_TURN),
        pytest.param(signal.SIGINT, False, 130, IN_TURN, marks=pytest.mark.slow),
        (signal.SIGINT, True, 130, IN_TURN),
        (signal.SIGTERM, False, 143, BESIDE),
    ],
)
def test_a_command_that_is_stopped_stops_its_workers(
    tmp_path: Path, number: int, group: bool, code: int, calling: str
) -> None:
    got, said, workers = stopped_command(tmp_path, number, group=group, calling=calling)
    assert got == code, said
    assert "Repeat the same command to resume" in said and "Traceback" not in said
    assert (tmp_path / "0steps" / "checkpoint").exists() and (tmp_path / "1cleanup" / "tidy").exists()
    assert not list(tmp_path.glob("*never/started")), "a call began after the command was stopped"
    assert not any(process_alive(worker) for worker in workers)


@pytest.mark.skipif(os.name == "nt", reason="signals of POSIX systems")
def test_a_command_that_is_stopped_after_an_error_stops_its_workers(tmp_path: Path) -> None:
    """While it waits for the calls that still run."""
    got, said, workers = stopped_command(tmp_path, signal.SIGTERM, group=False, first="fails", after_s=2.0)
    assert got == 143, said
    assert (tmp_path / "1cleanup" / "tidy").exists() and not any(process_alive(worker) for worker in workers)


def note(folder: Path, seconds: float, fails: bool) -> None:
    """A call that takes some time, and writes or fails."""
    (folder / "started").touch()
    time.sleep(seconds)
    if fails:
        raise NumericsError("it failed", where=folder.name)
    (folder / "done").touch()


def test_calls_beside_a_block_that_ends_are_finished_or_never_begun(tmp_path: Path) -> None:
    first, second = folders(tmp_path, "first", "second")
    with calls_beside(note, [(first, 0.5, False), (second, 0.0, False)], 1):
        wait_for(first / "started")
    assert (first / "done").exists()
    begun = [folder for folder in (first, second) if (folder / "started").exists()]
    assert all((folder / "done").exists() for folder in begun)


def fail_beside(given: list[Path]) -> None:
    with calls_beside(note, [(folder, 0.2, folder.name == "fails") for folder in given], 1):
        wait_for(given[0] / "started")
        time.sleep(1.0)


def test_a_call_beside_that_fails_is_told_and_the_rest_are_dropped(tmp_path: Path) -> None:
    given = folders(tmp_path, "fails", *"abcdef")
    refused("it failed", fail_beside, given, raises=NumericsError)
    assert not (given[-1] / "started").exists()


def fail_in_block(folder: Path) -> None:
    with calls_beside(sleep_long, [(folder,)], 1):
        wait_for(folder / "started")
        raise ValueError("in the block")


def test_an_error_in_the_block_stops_the_calls_beside_it(tmp_path: Path) -> None:
    (folder,) = folders(tmp_path, "a")
    refused("in the block", fail_in_block, folder, raises=ValueError)
    end = time.monotonic() + PATIENCE_S
    while process_alive(int((folder / "started").read_text())):
        assert time.monotonic() < end
        time.sleep(0.05)
