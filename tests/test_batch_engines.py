"""The same list through every engine: the same results. And what survives killed workers, nodes that go down, requeued
jobs.

Run with ``pytest -m cluster tests/test_batch_engines.py``; ``tools/cluster_tests.sh`` installs Slurm and Ray before.
"""

from __future__ import annotations

import contextlib
import json
import os
import random
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
import slurm_here

from mudg import app
from mudg.fleet import records as status
from mudg.fleet.plan import Entry, plan_of
from mudg.fleet.records import BatchFolder, Ended

pytestmark = [pytest.mark.cluster, pytest.mark.slow]
SCENES = 200
RAY = {"RAY_USAGE_STATS_ENABLED": "0", "RAY_AUTH_MODE": "disabled"}
STEP = """#!/bin/sh
# step.sh NAME OUT TALLY: writes a small result, and a line per run
echo "on node $RAY_RAYLET_PID" >> "$3/$1"
sleep ${STEP_S:-0.02}
mkdir -p "$2" && echo "result of $1" > "$2/result.txt"
case $1 in *13) echo "error: it is cut off" >&2; exit 3;; esac
"""


class ListOfScenes:
    """A list, its step, and how often each scene was begun."""

    def __init__(self, folder: Path, scenes: int = SCENES) -> None:
        self.folder, self.scenes = folder, scenes
        self.tally = folder / "tally"
        self.tally.mkdir(parents=True)
        (folder / "step.sh").write_text(STEP)
        (folder / "list.txt").write_text("".join(f"city name=s{number:03d}\n" for number in range(scenes)))

    def words(self, out: Path, *more: str) -> list[str]:
        step = ["sh", str(self.folder / "step.sh"), "{name}", "{out}", str(self.tally)]
        first = f"batch run --list {self.folder}/list.txt --out {out} --quiet".split()
        return [*first, *more, "--command", *step]

    def start(self, out: Path, *more: str, **environment: str) -> subprocess.Popen[bytes]:
        command = [sys.executable, "-m", "mudg", *self.words(out, *more)]
        return subprocess.Popen(command, env={**os.environ, **environment})

    def tallies(self) -> list[Path]:
        """A file for each scene that was begun."""
        return list(self.tally.iterdir())

    def runs(self) -> int:
        """How often any scene was begun."""
        return sum(len(path.read_text().splitlines()) for path in self.tallies())


def ends(out: Path) -> dict[str, str]:
    """Scene -> digest of its result, or its exit code."""
    found = {}
    for kind in ("done", "failed"):
        for path in (out / "_batch" / kind).glob("*.json"):
            record = json.loads(path.read_text())
            found[record["scene"]] = record["digest"] if kind == "done" else str(record["code"])
            if kind == "done":
                assert (out / record["place"] / "result.txt").read_text() == f"result of {record['scene']}\n"
    return found


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """What one worker on this machine makes of the list."""
    made = ListOfScenes(tmp_path_factory.mktemp("undisturbed"))
    assert app.main(made.words(made.folder / "out", "--jobs", "1")) == 12
    found = ends(made.folder / "out")
    assert len(found) == SCENES and sorted(found.values()).count("3") == 2
    return found


def test_numbered_tasks(tmp_path: Path, undisturbed: dict[str, str]) -> None:
    made = ListOfScenes(tmp_path)
    tasks = [made.start(tmp_path / "out", "--shard", "env/3", JOB_COMPLETION_INDEX=str(index)) for index in range(3)]
    assert sorted(one.wait(300) for one in tasks) in ([0, 0, 12], [0, 11, 11])
    assert ends(tmp_path / "out") == undisturbed and made.runs() == SCENES


@pytest.fixture(scope="module")
def slurm(tmp_path_factory: pytest.TempPathFactory) -> Iterator[dict[str, str]]:
    """Environment in which a Slurm of this machine answers."""
    reason = slurm_here.missing()
    if reason:
        pytest.skip(reason)
    with contextlib.ExitStack() as stack:
        try:
            yield stack.enter_context(slurm_here.slurm_here(tmp_path_factory.mktemp("cluster") / "slurm"))
        except RuntimeError as error:
            pytest.skip(str(error))


def messages(out: Path) -> str:
    """The last of what the tasks of a job said."""
    return "".join(path.read_text(errors="replace")[-1500:] for path in (out / "_batch/slurm").rglob("*.err"))


SLURM = ("--engine", "slurm", "--slurm-options", "time=60", "--grace-s", "10")


def test_slurm(tmp_path: Path, undisturbed: dict[str, str], slurm: dict[str, str]) -> None:
    made, out, began = ListOfScenes(tmp_path), tmp_path / "out", time.monotonic()
    running = made.start(out, *SLURM, "--jobs", "4", "--wait", **slurm)
    wait_until(lambda: len(made.tallies()) > 10, 120)
    command = [sys.executable, "-m", "mudg", *made.words(out)]
    refused = subprocess.run(command, env=slurm, capture_output=True, text=True)
    assert refused.returncode == 2 and "another driver works on this batch" in refused.stderr
    assert running.wait(500) == 12, messages(out)
    print(f"{SCENES} scenes through Slurm: {time.monotonic() - began:.1f} s")
    assert ends(out) == undisturbed and made.runs() == SCENES, messages(out)
    again = made.start(out, **slurm).wait(120)  # the job is over: its claim on the folder, too
    assert again == 0 and made.runs() == SCENES


@pytest.mark.parametrize("how", ["announced", "requeued"])
def test_a_preempted_slurm_job_goes_on(how: str, tmp_path: Path, slurm: dict[str, str]) -> None:
    """Told before (USR2), or taken off its node without a word (scontrol requeue): back in the queue, and the same
    results."""
    made, out = ListOfScenes(tmp_path, 30), tmp_path / "out"
    words = made.words(out, *SLURM, "--json")
    environment = {**slurm, "STEP_S": "1"}
    command = [sys.executable, "-m", "mudg", *words]
    submitted = subprocess.run(command, env=environment, cwd=tmp_path, capture_output=True, text=True)
    assert submitted.returncode == 0, submitted.stderr
    number = json.loads(submitted.stdout)["job"]
    wait_until(lambda: made.runs() >= 3, 120)
    command = ["scancel", "--signal=USR2", number] if how == "announced" else ["scontrol", "requeue", number]
    subprocess.run(command, env=slurm, check=True)
    wait_until(lambda: len(ends(out)) == 30, 400)
    shown = subprocess.run(["scontrol", "show", "job", number], env=slurm, capture_output=True, text=True).stdout
    assert "Restarts=1" in shown, f"{shown} {messages(out)}"
    print(f"{how}: runs beyond the first of a scene: {made.runs() - 30}")
    assert made.runs() <= 31


def test_ray(tmp_path: Path, undisturbed: dict[str, str]) -> None:
    pytest.importorskip("ray")
    made, out, began = ListOfScenes(tmp_path), tmp_path / "out", time.monotonic()
    assert made.start(out, "--engine", "ray", "--memory-gb", "0.1", **RAY).wait(500) == 12
    print(f"{SCENES} scenes through Ray: {time.monotonic() - began:.1f} s")
    assert ends(out) == undisturbed and made.runs() == SCENES


def test_a_node_of_ray_that_goes_down(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    cluster_utils = pytest.importorskip("ray.cluster_utils")
    for name, value in RAY.items():
        monkeypatch.setenv(name, value)
    cluster = cluster_utils.Cluster(initialize_head=True, head_node_args={"num_cpus": 1, "include_dashboard": False})
    made, out = ListOfScenes(tmp_path, 40), tmp_path / "out"
    try:
        doomed = cluster.add_node(num_cpus=1)
        cluster.wait_for_nodes()
        running = made.start(out, "--engine", "ray", "--ray-address", cluster.address, STEP_S="0.5", **RAY)
        nodes = lambda: {line for path in made.tallies() for line in path.read_text().splitlines()}
        wait_until(lambda: len(nodes()) == 2, 180)
        cluster.remove_node(doomed, allow_graceful=False)
        assert running.wait(400) == 11
    finally:
        cluster.shutdown()
    assert len(ends(out)) == 40
    print(f"a node of Ray killed: runs beyond the first of a scene: {made.runs() - 40}")
    assert made.runs() - 40 <= 2


def test_chaos(tmp_path: Path, undisturbed: dict[str, str]) -> None:
    """Drivers are killed at random, with their steps, and so are steps alone."""
    made = ListOfScenes(tmp_path)
    out, rng = tmp_path / "out", random.Random(3)
    words = ("--shard", "env/3")
    running = [made.start(out, *words, JOB_COMPLETION_INDEX=str(index)) for index in range(3)]
    wait_until(lambda: made.runs() >= 3, 120)
    killed = 0
    while len(ends(out)) < SCENES and killed < 4:
        time.sleep(rng.uniform(0.5, 2.0))
        index = rng.randrange(3)
        if running[index].poll() is None:
            running[index].send_signal(signal.SIGKILL)
            running[index].wait()
            killed += 1
        running[index] = made.start(out, *words, JOB_COMPLETION_INDEX=str(index))
    for one in running:
        one.wait(300)
    assert killed >= 2 and made.start(out, "--jobs", "1").wait(300) in (0, 10, 11, 12) and ends(out) == undisturbed
    print(f"{killed} drivers killed, runs beyond the first of a scene: {made.runs() - SCENES}")
    assert made.runs() - SCENES <= killed
    assert not list((out / "_batch/work").iterdir()) and not list((out / "_batch").glob("owner*"))


def wait_until(condition, seconds: float) -> None:
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "it did not happen"
        time.sleep(0.2)


def test_status_of_a_hundred_thousand_scenes(tmp_path: Path) -> None:
    count = int(os.environ.get("MUDG_TEST_SCENES", "100000"))
    folder, plan = BatchFolder(tmp_path), plan_of((), {}, {}, ("program", "{out}"))
    entries = [Entry(f"scene{number:06d}", f"/logs/{number}") for number in range(count)]
    folder.begin(plan, entries)
    for kind in ("done", "failed"):
        (tmp_path / "_batch" / kind).mkdir()
    for number, unit in enumerate(unit for entry in entries for unit in plan.units(entry)):
        kind = "failed" if number % 100 == 77 else "done"
        facts = {"scene": unit.entry.name, "stage": "command", "key": unit.key, "code": 3 * (kind == "failed")}
        ended = Ended(**facts, ended=1e9 + number)
        (tmp_path / "_batch" / kind / f"{unit.key}.json").write_text(ended.model_dump_json())
    began = time.monotonic()
    state = status.read_status(folder)
    assert len(status.text_of(state)) < 1_000_000
    print(f"status of {count} scenes: {time.monotonic() - began:.1f} s")
    command = state["stages"]["command"]
    assert (command["done"], command["failed"]) == (count - count // 100, count // 100)
    assert time.monotonic() - began < 40
