"""Steps that were killed for want of memory: once more, alone on the machine and with less, then failed."""

from __future__ import annotations

import json
import sys
import threading
import time
from pathlib import Path

import pytest

from mudg import native
from mudg.base.location import Location
from mudg.stages.batches import retries, turns, work
from mudg.stages.batches.folders import BatchFolder
from mudg.stages.batches.lists import Entry
from mudg.stages.batches.plan import plan_of

pytestmark = pytest.mark.skipif(turns.fcntl is None, reason="no file locks on this system")
STEP = """
import os, signal, sys
name, out, least = sys.argv[1:4]
threads = int(os.environ["MUDG_THREADS"])
print("threads", threads, flush=True)
if threads > int(least):
    os.kill(os.getpid(), signal.SIGKILL)
os.makedirs(out)
open(os.path.join(out, "threads"), "w").write(str(threads))
"""


def never() -> bool:
    return False


def killed_above(threads: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> dict[str, int]:
    """What becomes of a scene whose step is killed with more threads than these."""
    monkeypatch.setattr(retries, "backoff", lambda *_: 0.0)
    monkeypatch.setattr(turns, "default_folder", lambda: tmp_path / "turns")
    (tmp_path / "step.py").write_text(STEP)
    folder, entries = BatchFolder(Location.of(tmp_path / "out")), [Entry("one", "/logs/one")]
    plan = plan_of((), {}, (sys.executable, str(tmp_path / "step.py"), "{name}", "{out}", str(threads)))
    folder.begin(plan, entries)
    return work.Worker(work.WorkRequest(folder, plan, entries, work.WorkRules(patience_s=5.0, threads=4))).run()


def test_a_killed_step_is_tried_again_with_less(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    assert killed_above(1, tmp_path, monkeypatch) == {"done": 1}
    (record,) = (json.loads(path.read_text()) for path in (tmp_path / "out/_batch/done").iterdir())
    assert record["attempt"] == 2 and (tmp_path / "out" / record["place"] / "threads").read_text() == "1"
    assert (
        "one command: killed before, most likely for want of memory: now alone on this machine"
        in capfd.readouterr().err
    )


def test_a_step_that_is_killed_again_has_failed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert killed_above(0, tmp_path, monkeypatch) == {"failed": 1}
    (record,) = (json.loads(path.read_text()) for path in (tmp_path / "out/_batch/failed").iterdir())
    assert (record["code"], record["attempt"]) == (137, 2) and "also alone on its machine with one thread" in record[
        "words"
    ]


def test_one_that_is_alone_waits_for_all_and_lets_nobody_in(tmp_path: Path) -> None:
    order: list[str] = []
    first_may_go, first_in = threading.Event(), threading.Event()

    def step(name: str, alone: bool) -> None:
        with turns.turn(alone, never, tmp_path) as mine:
            assert mine
            order.append(f"+{name}")
            if name == "first":
                first_in.set()
                first_may_go.wait(20)
            if name == "alone":
                time.sleep(0.3)
            order.append(f"-{name}")

    threads = [threading.Thread(target=step, args=("first", False))]
    threads[0].start()
    assert first_in.wait(20)
    with turns.turn(False, never, tmp_path) as beside:
        assert beside, "two run beside each other"
    for name, alone in (("alone", True), ("late", False)):
        threads.append(threading.Thread(target=step, args=(name, alone)))
        threads[-1].start()
        time.sleep(0.2)
    assert order == ["+first"]
    first_may_go.set()
    for one in threads:
        one.join(20)
    assert order == ["+first", "-first", "+alone", "-alone", "+late", "-late"]


def test_waiting_can_be_cancelled_and_steps_share_the_turn_of_what_started_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with turns.turn(True, never, tmp_path):
        end = time.monotonic() + 0.2
        with turns.turn(False, lambda: time.monotonic() > end, tmp_path) as mine:
            assert not mine
        monkeypatch.setenv(turns.HELD, "1")
        with turns.turn(False, never, tmp_path) as mine:
            assert mine


def test_processes_of_steps_are_as_many_as_their_threads(monkeypatch: pytest.MonkeyPatch) -> None:
    """What a step may take of a machine is one number for all of its threads and processes."""
    from mudg.stages import annotate
    from mudg.stages.config import AnnotateConfig

    monkeypatch.setenv("MUDG_THREADS", "3")
    assert native.default_threads() == annotate._usual_processes(AnnotateConfig(device="cpu")) == 3
