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
from worker_calls import PATIENCE_S, note, sleep_long, wait_for

from mudg.base.errors import NumericsError
from mudg.base.processes import calls_beside, error_from_record, error_record, process_alive, run_in_processes


def folders(root: Path, *names: str) -> list[Path]:
    made = [root / name for name in names]
    for folder in made:
        folder.mkdir()
    return made


def begun(places: list[Path]) -> set[str]:
    return {place.name for place in places if (place / "started").exists()}


def worker_in(folder: Path) -> int:
    return int((folder / "started").read_text())


def ends(worker: int) -> bool:
    """Whether a process ends before long."""
    end = time.monotonic() + 20
    while process_alive(worker) and time.monotonic() < end:
        time.sleep(0.05)
    return not process_alive(worker)


def test_an_error_crosses_a_process_boundary_as_it_is() -> None:
    sent = NumericsError("a loss is not finite", where="view 3, step 9", got="nan", remedy="look")
    error = error_from_record(json.loads(json.dumps(error_record(sent))))
    assert isinstance(error, NumericsError) and (error.what, error.fields) == (sent.what, sent.fields)


def test_after_an_error_no_call_begins_any_more(tmp_path: Path) -> None:
    places = folders(tmp_path, "fails", *"abcde")
    calls = [(place, 0.3 * (place.name == "a")) for place in places]
    with pytest.raises(NumericsError, match="not finite"):
        list(run_in_processes(note, calls, 2))
    assert begun(places) <= {"fails", "a"}
    assert sorted(run_in_processes(note, calls[1:], 3)) == [(n, None) for n in range(5)]
    assert all((place / "done").exists() for place in places[1:])


def started(script: str, folder: Path, **options: object) -> subprocess.Popen[str]:
    """A Python that runs a script, which finds the modules of the tests, and a folder as its argument."""
    (folder / "parent.py").write_text(f"import sys; sys.path[:0] = sys.argv[2:]\n{script}")
    places = [str(Path(__file__).parent), *(path for path in sys.path if path)]
    return subprocess.Popen([sys.executable, str(folder / "parent.py"), str(folder), *places], text=True, **options)


def test_workers_of_a_parent_that_is_killed_end(tmp_path: Path) -> None:
    (folder,) = folders(tmp_path, "a")
    script = (
        "from pathlib import Path\nfrom worker_calls import sleep_long\n"
        "from mudg.base.processes import run_in_processes\n"
        "if __name__ == '__main__': list(run_in_processes(sleep_long, [(Path(sys.argv[1]) / 'a',)] * 2, 2))"
    )
    parent = started(script, tmp_path)
    wait_for(folder / "started")
    time.sleep(0.2)
    worker = worker_in(folder)
    parent.kill()
    parent.wait()
    if not ends(worker):
        os.kill(worker, 9)
        raise AssertionError("the worker outlived its parent")


IN_TURN = "for _ in run_in_processes(call, calls, 2):\n        pass"
BESIDE = "with calls_beside(call, calls, 2):\n        time.sleep(600)"
COMMAND = """
import signal, time
from pathlib import Path
from worker_calls import call
from mudg.base.processes import calls_beside, run_in_processes
def work(_args):
    calls = [(folder,) for folder in sorted(Path(sys.argv[1]).glob('[0-9]*'))]
    CALLING
    return {}
if __name__ == '__main__':
    from mudg import app
    from mudg.steps.doctor import Doctor
    signal.signal(signal.SIGINT, signal.default_int_handler)  # ignored in what a script starts in the background
    Doctor.run = work
    sys.exit(app.main(['doctor']))
"""


@pytest.mark.skipif(os.name == "nt", reason="signals of POSIX systems")
@pytest.mark.parametrize(
    ("number", "group", "code", "calling", "first"),
    [
        (signal.SIGTERM, False, 143, IN_TURN, "0steps"),
        pytest.param(signal.SIGINT, False, 130, IN_TURN, "0steps", marks=pytest.mark.slow),
        (signal.SIGINT, True, 130, IN_TURN, "0steps"),
        (signal.SIGTERM, False, 143, BESIDE, "0steps"),
        (signal.SIGTERM, False, 143, IN_TURN, "0fails"),  # while it waits for the calls that still run
    ],
)
def test_a_command_that_is_stopped_stops_its_workers(
    tmp_path: Path, number: int, group: bool, code: int, calling: str, first: str
) -> None:
    """A command with two calls that run and three that wait gets a signal."""
    given = folders(tmp_path, first, "1sleeps", "2never", "3never", "4never")
    script = COMMAND.replace("CALLING", calling)
    with started(script, tmp_path, start_new_session=True, stderr=subprocess.PIPE) as parent:
        try:
            wait_for(given[0] / "started")
            wait_for(given[1] / "started")
            time.sleep(0.2 if first == "0steps" else 0.7)
            os.killpg(parent.pid, number) if group else os.kill(parent.pid, number)
            said = parent.communicate(timeout=PATIENCE_S)[1]
        finally:
            if parent.poll() is None:
                os.killpg(parent.pid, signal.SIGKILL)
    assert parent.returncode == code, said
    assert "Repeat the same command to resume" in said and "Traceback" not in said
    assert (given[0] / "checkpoint").exists() == (first == "0steps") and (given[1] / "tidy").exists()
    assert begun(given) == {first, "1sleeps"}, "a call began after the command was stopped"
    assert not any(process_alive(worker_in(folder)) for folder in given[:2])


def beside(given: list[Path], block_s: float) -> None:
    """Calls beside a block that waits until the first has begun, and a while longer."""
    with calls_beside(note, [(folder, 0.2) for folder in given], 1):
        wait_for(given[0] / "started")
        time.sleep(block_s)


def test_calls_beside_a_block_that_ends_are_finished_or_never_begun(tmp_path: Path) -> None:
    given = folders(tmp_path, "first", "second")
    beside(given, 0.0)
    assert (given[0] / "done").exists()
    assert begun(given) == {folder.name for folder in given if (folder / "done").exists()}


def test_a_call_beside_that_fails_is_told_and_the_rest_are_dropped(tmp_path: Path) -> None:
    given = folders(tmp_path, "fails", *"abcdef")
    refused("not finite", beside, given, 0.5, raises=NumericsError)
    assert not (given[-1] / "started").exists()


def test_an_error_in_the_block_stops_the_calls_beside_it(tmp_path: Path) -> None:
    (folder,) = folders(tmp_path, "a")

    def fail() -> None:
        with calls_beside(sleep_long, [(folder,)], 1):
            wait_for(folder / "started")
            raise ValueError("in the block")

    refused("in the block", fail, raises=ValueError)
    assert ends(worker_in(folder))
