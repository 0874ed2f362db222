"""What work takes: seconds, processor seconds, memory with child processes, bytes; over interrupted runs, too."""

import gc
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest

from mudg.base import memory as usage
from mudg.base import store
from mudg.base.memory import Meter, Usage
from mudg.base.run_folder import RunDir, VerbOutput

OUTPUT = VerbOutput("work", 1, ("*.txt",))
needs_proc = pytest.mark.skipif(
    usage.held_bytes() is None, reason="the system does not tell the memory of processes (/proc)"
)


def wait_until(reached: float) -> None:
    while time.process_time() < reached:
        pass


def test_processor_time_counts_work_also_of_children_and_not_waiting() -> None:
    meter = Meter()
    time.sleep(0.3)
    wait_until(time.process_time() + 0.2)
    found = meter.stop()
    assert found.seconds >= 0.5 and 0.15 < found.processor_s < found.seconds - 0.2
    assert meter.usage() == found  # stopped
    meter = Meter()
    subprocess.run([sys.executable, "-c", "import time\nwhile time.process_time() < 0.4: pass"], check=True)
    assert meter.stop().processor_s > 0.35


GIVEN_BACK = """
import time
import numpy as np
from mudg.base import memory as usage
meter, before = usage.Meter(), usage.held_bytes()
held = np.ones(80 << 17)  # 80 MiB
time.sleep(3 * usage.PERIOD_S)
del held
print(meter.stop().peak_bytes - before)
"""


@needs_proc
def test_the_peak_holds_memory_that_was_given_back() -> None:
    """In a program of its own: what else ends meanwhile would make room."""
    found = subprocess.run([sys.executable, "-c", GIVEN_BACK], check=True, capture_output=True, text=True)
    assert int(found.stdout) > 70 << 20


@needs_proc
def test_memory_of_child_processes_counts() -> None:
    meter = Meter()
    before = usage.held_bytes()
    code = "held = bytearray(90 << 20); held[::4096] = b'1' * len(held[::4096]); import time; time.sleep(1)"
    subprocess.run([sys.executable, "-c", code], check=True)
    assert meter.stop().peak_bytes > before + (80 << 20)


SHARING = """
import sys, time
import numpy as np
shared = np.memmap(sys.argv[1], np.uint8, "r")
assert shared[::4096].sum() == 0
print("ready", flush=True)
sys.stdin.read()
"""


@needs_proc
def test_what_child_processes_share_counts_once(tmp_path: Path) -> None:
    size, large = 200 << 20, tmp_path / "large"
    large.write_bytes(bytes(size))
    alone = usage.held_bytes()
    mine = np.memmap(large, np.uint8, "r")
    assert mine[::4096].sum() == 0
    meter = Meter()
    children = [
        subprocess.Popen([sys.executable, "-c", SHARING, large], stdin=-1, stdout=-1, text=True) for _ in range(2)
    ]
    try:
        assert [child.stdout.readline() for child in children] == ["ready\n"] * 2
        held = usage.held_bytes()
        time.sleep(3 * usage.PERIOD_S)
        peak = meter.stop().peak_bytes
    finally:
        for child in children:
            child.communicate()
    for found in (held, peak):
        assert alone + 0.9 * size < found < alone + 1.9 * size


def watching() -> int:
    return sum(thread.name == "memory meter" for thread in threading.enumerate())


def test_the_thread_of_a_meter_ends_with_it() -> None:
    gc.collect()  # run folders that other tests left open
    time.sleep(3 * usage.PERIOD_S)
    before = watching()
    meter, forgotten = Meter(), Meter()
    assert watching() == before + 2
    meter.stop()
    del forgotten
    time.sleep(3 * usage.PERIOD_S)
    assert watching() == before


def test_later_parts_add_up_the_peak_is_the_highest_and_sizes_are_those_of_files(tmp_path: Path) -> None:
    assert Usage(1.0, 2.0, 30).then(Usage(4.0, 5.0, 20)) == Usage(5.0, 7.0, 30)
    assert Usage(1.0, 2.0, None).then(Usage(1.0, 1.0, 7)).peak_bytes == 7
    assert Usage.of_record(Usage(1.5, 2.5, 9).record()) == Usage(1.5, 2.5, 9)
    assert Usage.of_record({"seconds": 3}) == Usage(3.0, 0.0, None)
    for name, size in (("a/b.txt", 300), ("a/c/d.txt", 40)):
        store.write_text(tmp_path / name, "x" * size)
    assert usage.folder_bytes(tmp_path) == 340 and usage.folder_bytes(tmp_path / "a" / "b.txt") == 300
    assert usage.folder_bytes(tmp_path / "missing") == 0


def test_a_run_folder_notes_what_it_took_over_all_its_runs(tmp_path: Path) -> None:
    open_it = lambda: RunDir.open(tmp_path / "out", OUTPUT, {"a": 1}, {})
    first = open_it()
    wait_until(time.process_time() + 0.1)
    first.pause()
    paused = store.read_json(tmp_path / "out" / "run.json")
    second = open_it()
    store.write_text(tmp_path / "out" / "words.txt", "x" * 5000)
    wait_until(time.process_time() + 0.1)
    second.finish()
    done = store.read_json(tmp_path / "out" / "run.json")
    assert paused["processor_s"] >= 0.09 and done["processor_s"] >= paused["processor_s"] + 0.09
    assert done["seconds"] > paused["seconds"] and done["written_bytes"] >= 5000
    files = sum(p.stat().st_size for p in (tmp_path / "out").iterdir() if p.name not in ("run.json", "lock"))
    assert done["written_bytes"] == files
    assert open_it().complete  # none of it decides on reuse
