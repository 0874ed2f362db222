"""What work takes: seconds, processor seconds, memory with child processes, bytes; over interrupted runs, too."""

import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from mudg.base import store, usage
from mudg.base.run_folder import RunDir, VerbOutput
from mudg.base.usage import Meter, Usage

OUTPUT = VerbOutput("work", 1, ("*.txt",))
needs_proc = pytest.mark.skipif(usage.resident_bytes() is None, reason="the system does not tell the memory of processes (/proc)")


def wait_until(reached: float) -> None:
    while time.process_time() < reached:
        pass


def test_processor_time_counts_work_and_not_waiting() -> None:
    meter = Meter()
    time.sleep(0.3)
    wait_until(time.process_time() + 0.2)
    found = meter.stop()
    assert found.seconds >= 0.5
    assert 0.15 < found.processor_s < found.seconds - 0.2
    assert meter.usage() == found  # stopped


def test_processor_time_of_children_that_have_ended_counts() -> None:
    meter = Meter()
    subprocess.run([sys.executable, "-c", "import time\nwhile time.process_time() < 0.4: pass"], check=True)
    assert meter.stop().processor_s > 0.35


@needs_proc
def test_the_peak_holds_memory_that_was_given_back() -> None:
    meter = Meter()
    before = usage.resident_bytes()
    held = np.ones(80 << 17)  # 80 MiB
    time.sleep(3 * usage.PERIOD_S)
    del held
    peak = meter.stop().peak_bytes
    assert peak > before + (70 << 20)


@needs_proc
def test_memory_of_child_processes_counts() -> None:
    meter = Meter()
    before = usage.resident_bytes()
    code = "held = bytearray(90 << 20); held[::4096] = b'1' * len(held[::4096]); import time; time.sleep(1)"
    subprocess.run([sys.executable, "-c", code], check=True)
    assert meter.stop().peak_bytes > before + (80 << 20)


def test_the_thread_ends_with_the_last_meter() -> None:
    meter = Meter()
    assert usage._SAMPLER._thread is not None
    meter.stop()
    usage._SAMPLER._meters.clear()  # of run folders that other tests left open
    time.sleep(3 * usage.PERIOD_S)
    assert usage._SAMPLER._thread is None


def test_sizes_are_those_of_a_folder_or_of_one_file(tmp_path: Path) -> None:
    for name, size in (("a/b.txt", 300), ("a/c/d.txt", 40)):
        store.write_text(tmp_path / name, "x" * size)
    assert usage.folder_bytes(tmp_path) == 340
    assert usage.folder_bytes(tmp_path / "a" / "b.txt") == 300
    assert usage.folder_bytes(tmp_path / "missing") == 0


def test_later_parts_add_up_and_the_peak_is_the_highest() -> None:
    assert Usage(1.0, 2.0, 30).then(Usage(4.0, 5.0, 20)) == Usage(5.0, 7.0, 30)
    assert Usage(1.0, 2.0, None).then(Usage(1.0, 1.0, 7)).peak_bytes == 7
    assert Usage.of_record(Usage(1.5, 2.5, 9).record()) == Usage(1.5, 2.5, 9)
    assert Usage.of_record({"seconds": 3}) == Usage(3.0, 0.0, None)  # as earlier versions wrote it


def test_a_run_folder_notes_what_it_took_over_all_its_runs(tmp_path: Path) -> None:
    open_it = lambda: RunDir.open(tmp_path / "out", OUTPUT, {"a": 1}, {})  # noqa: E731
    first = open_it()
    wait_until(time.process_time() + 0.1)
    first.pause()
    paused = store.read_json(tmp_path / "out" / "run.json")
    second = open_it()
    store.write_text(tmp_path / "out" / "words.txt", "x" * 5000)
    wait_until(time.process_time() + 0.1)
    second.finish()
    done = store.read_json(tmp_path / "out" / "run.json")
    assert paused["processor_s"] >= 0.09
    assert done["processor_s"] >= paused["processor_s"] + 0.09
    assert done["seconds"] > paused["seconds"]
    assert done["written_bytes"] >= 5000
    files = sum(p.stat().st_size for p in (tmp_path / "out").iterdir() if p.name not in ("run.json", "lock"))
    assert done["written_bytes"] == files
    assert open_it().complete  # none of it decides on reuse
