"""Two pieces of work at the same time: both done, both heard, both stopped; the error of one is its own."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from mudg.base import log
from mudg.base.errors import NumericsError, ResourceError
from mudg.base.processes import Task, process_alive, run_side_by_side

PATIENCE_S = 60.0


def wait_for(path: Path) -> None:
    """Until the file is there."""
    end = time.monotonic() + PATIENCE_S
    while not path.exists():
        if time.monotonic() > end:
            raise TimeoutError(str(path))
        time.sleep(0.01)


def meet(mine: Path, other: Path) -> None:
    """Done only if the other works at the same time."""
    log.info(f"here with {os.environ['MUDG_THREADS']}")
    with log.task("meeting", 2) as bar:
        bar.update("waiting")
        mine.touch()
        time.sleep(0.35)
        bar.advance()
        wait_for(other)
        bar.advance()


def until_stopped(folder: Path) -> None:
    """Works until it is interrupted, and notes how often."""
    (folder / "started").write_text(str(os.getpid()))
    try:
        time.sleep(PATIENCE_S)
    except KeyboardInterrupt:
        time.sleep(0.2)  # a second interruption would come now
        (folder / "stopped").touch()
        raise


def fail(after: Path) -> None:
    """A numerical error, once the other one works."""
    wait_for(after)
    raise NumericsError("a loss is not finite", where="view 3, step 9", got="nan", remedy="look")


def die(code: int) -> None:
    """End without a word."""
    os.kill(os.getpid(), signal.SIGKILL) if code < 0 else os._exit(code)


@pytest.fixture
def heard() -> Iterator[list[dict[str, Any]]]:
    """What would have been written on the terminal."""
    messages: list[dict[str, Any]] = []
    log.set_sink(messages.append)
    yield messages
    log.set_sink(None)


def folders(root: Path, *names: str) -> list[Path]:
    made = [root / name for name in names]
    for folder in made:
        folder.mkdir()
    return made


def test_both_work_at_the_same_time_and_are_heard(tmp_path: Path, heard: list[dict[str, Any]]) -> None:
    a, b = tmp_path / "a", tmp_path / "b"
    run_side_by_side([Task("first", meet, (a, b)), Task("second", meet, (b,), {"other": a})], threads_each=3)
    said = [message["info"] for message in heard if "info" in message]
    assert sorted(said) == ["first: here with 3", "second: here with 3"]
    shown = " ".join(message["progress"] for message in heard if "progress" in message)
    assert "meeting: 1/2 waiting" in shown
    assert "MUDG_THREADS" not in os.environ or os.environ["MUDG_THREADS"] != "3"


def test_the_error_of_one_is_raised_as_its_own_and_the_other_stops_cleanly(
    tmp_path: Path, heard: list[dict[str, Any]]
) -> None:
    (folder,) = folders(tmp_path, "waits")
    with pytest.raises(NumericsError) as raised:
        run_side_by_side([Task("bad", fail, (folder / "started",)), Task("good", until_stopped, (folder,))], 1)
    error = raised.value
    assert (error.what, error.where, error.got, error.remedy) == (
        "a loss is not finite",
        "view 3, step 9",
        "nan",
        "look",
    )
    assert error.exit_code == 6
    assert (folder / "stopped").exists()


@pytest.mark.skipif(os.name == "nt", reason="ends by a signal")
def test_a_process_that_ends_without_a_word_is_named(heard: list[dict[str, Any]]) -> None:
    with pytest.raises(ResourceError, match=r"greedy ended without a word[\s\S]*exit code -9, killed"):
        run_side_by_side([Task("greedy", die, (-9,))], 1)
    with pytest.raises(RuntimeError, match="buggy failed"):
        run_side_by_side([Task("buggy", die, (1,))], 1)


@pytest.mark.skipif(os.name == "nt", reason="sends a signal")
def test_ctrl_c_stops_both_once_and_cleanly(tmp_path: Path, heard: list[dict[str, Any]]) -> None:
    both = folders(tmp_path, "a", "b")

    def interrupt() -> None:
        for folder in both:
            wait_for(folder / "started")
        os.kill(os.getpid(), signal.SIGINT)

    before = signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background jobs start deaf to it
    threading.Thread(target=interrupt, daemon=True).start()
    try:
        with pytest.raises(KeyboardInterrupt):
            run_side_by_side([Task(folder.name, until_stopped, (folder,)) for folder in both], 1)
    finally:
        signal.signal(signal.SIGINT, before)
    assert all((folder / "stopped").exists() for folder in both)


@pytest.mark.skipif(os.name == "nt", reason="ends by a signal")
def test_children_of_a_parent_that_is_killed_stop_too(tmp_path: Path) -> None:
    (folder,) = folders(tmp_path, "a")
    script = (
        "import sys; sys.path[:0] = sys.argv[2:]\nfrom pathlib import Path\nimport test_processes as t\n"
        "if __name__ == '__main__': t.run_side_by_side([t.Task('a', t.until_stopped, (Path(sys.argv[1]),))], 1)"
    )
    (tmp_path / "parent.py").write_text(script)
    places = [str(Path(__file__).parent), *(path for path in sys.path if path)]
    parent = subprocess.Popen([sys.executable, str(tmp_path / "parent.py"), str(folder), *places])
    wait_for(folder / "started")
    parent.kill()
    parent.wait()
    wait_for(folder / "stopped")


def sleep_long(folder: Path) -> None:
    """Says which process it is, and works for longer than any test waits."""
    (folder / "started").write_text(str(os.getpid()))
    time.sleep(600)


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
