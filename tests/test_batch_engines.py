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
from test_batches import Scenes, wait_for

from mudg import app
from mudg.fleet import records as status
from mudg.fleet.plan import Entry, plan_of
from mudg.fleet.records import BatchFolder, Ended

pytestmark = [pytest.mark.cluster, pytest.mark.slow]
SCENES = 200
RAY = {"RAY_USAGE_STATS_ENABLED": "0", "RAY_AUTH_MODE": "disabled"}
STEP = """
# step.sh NAME OUT TALLY: writes a small result, and a line per run
echo "on node $RAY_RAYLET_PID" >> "$3/$1.runs"
sleep ${STEP_S:-0.02}
mkdir -p "$2" && echo "result of $1" > "$2/result.txt"
case $1 in *13) echo "error: it is cut off" >&2; exit 3;; esac
"""


def begun(made: Scenes) -> int:
    """How often any scene was begun."""
    return sum(made.runs().values())


def ends(made: Scenes) -> dict[str, str]:
    """Scene -> digest of its result, or its exit code."""
    for record in made.batch.records("done"):
        assert (made.batch.out / record.place / "result.txt").read_text() == f"result of {record.scene}\n"
    return made.digests() | {record.scene: str(record.code) for record in made.batch.records("failed")}


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """What one worker on this machine makes of the list."""
    made = Scenes(tmp_path_factory.mktemp("undisturbed"), SCENES, STEP)
    assert app.main(made.words("--jobs", "1")) == 12
    found = ends(made)
    assert len(found) == SCENES and sorted(found.values()).count("3") == 2
    return found


def test_numbered_tasks(tmp_path: Path, undisturbed: dict[str, str]) -> None:
    made = Scenes(tmp_path, SCENES, STEP)
    tasks = [made.start("--shard", "env/3", JOB_COMPLETION_INDEX=str(index)) for index in range(3)]
    assert sorted(one.wait(300) for one in tasks) in ([0, 0, 12], [0, 11, 11])
    assert ends(made) == undisturbed and begun(made) == SCENES


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
    made, out, began = Scenes(tmp_path, SCENES, STEP), tmp_path / "out", time.monotonic()
    running = made.start(*SLURM, "--jobs", "4", "--wait", **slurm)
    wait_for(lambda: len(made.runs()) > 10, 120)
    command = [sys.executable, "-m", "mudg", *made.words()]
    refused = subprocess.run(command, env=slurm, capture_output=True, text=True)
    assert refused.returncode == 2 and "another driver works on this batch" in refused.stderr
    assert running.wait(500) == 12, messages(out)
    print(f"{SCENES} scenes through Slurm: {time.monotonic() - began:.1f} s")
    assert ends(made) == undisturbed and begun(made) == SCENES, messages(out)
    again = made.start(**slurm).wait(120)  # the job is over: its claim on the folder, too
    assert again == 0 and begun(made) == SCENES


@pytest.mark.parametrize("how", ["announced", "requeued"])
def test_a_preempted_slurm_job_goes_on(how: str, tmp_path: Path, slurm: dict[str, str]) -> None:
    """Told before (USR2), or taken off its node without a word (scontrol requeue): back in the queue, and the same
    results."""
    made, out = Scenes(tmp_path, 30, STEP), tmp_path / "out"
    words = made.words(*SLURM, "--json")
    environment = {**slurm, "STEP_S": "1"}
    command = [sys.executable, "-m", "mudg", *words]
    submitted = subprocess.run(command, env=environment, cwd=tmp_path, capture_output=True, text=True)
    assert submitted.returncode == 0, submitted.stderr
    number = json.loads(submitted.stdout)["job"]
    wait_for(lambda: begun(made) >= 3, 120)
    command = ["scancel", "--signal=USR2", number] if how == "announced" else ["scontrol", "requeue", number]
    subprocess.run(command, env=slurm, check=True)
    wait_for(lambda: len(ends(made)) == 30, 400)
    shown = subprocess.run(["scontrol", "show", "job", number], env=slurm, capture_output=True, text=True).stdout
    assert "Restarts=1" in shown, f"{shown} {messages(out)}"
    print(f"{how}: runs beyond the first of a scene: {begun(made) - 30}")
    assert begun(made) <= 31


def test_ray(tmp_path: Path, undisturbed: dict[str, str]) -> None:
    pytest.importorskip("ray")
    made, began = Scenes(tmp_path, SCENES, STEP), time.monotonic()
    assert made.start("--engine", "ray", "--memory-gb", "0.1", **RAY).wait(500) == 12
    print(f"{SCENES} scenes through Ray: {time.monotonic() - began:.1f} s")
    assert ends(made) == undisturbed and begun(made) == SCENES


def test_a_node_of_ray_that_goes_down(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    cluster_utils = pytest.importorskip("ray.cluster_utils")
    for name, value in RAY.items():
        monkeypatch.setenv(name, value)
    cluster = cluster_utils.Cluster(initialize_head=True, head_node_args={"num_cpus": 1, "include_dashboard": False})
    made = Scenes(tmp_path, 40, STEP)
    try:
        doomed = cluster.add_node(num_cpus=1)
        cluster.wait_for_nodes()
        running = made.start("--engine", "ray", "--ray-address", cluster.address, STEP_S="0.5", **RAY)
        nodes = lambda: {line for path in made.tally.iterdir() for line in path.read_text().splitlines()}
        wait_for(lambda: len(nodes()) == 2, 180)
        cluster.remove_node(doomed, allow_graceful=False)
        assert running.wait(400) == 11
    finally:
        cluster.shutdown()
    assert len(ends(made)) == 40
    print(f"a node of Ray killed: runs beyond the first of a scene: {begun(made) - 40}")
    assert begun(made) - 40 <= 2


def test_chaos(tmp_path: Path, undisturbed: dict[str, str]) -> None:
    """Drivers are killed at random, with their steps, and so are steps alone."""
    made = Scenes(tmp_path, SCENES, STEP)
    out, rng = tmp_path / "out", random.Random(3)
    words = ("--shard", "env/3")
    running = [made.start(*words, JOB_COMPLETION_INDEX=str(index)) for index in range(3)]
    wait_for(lambda: begun(made) >= 3, 120)
    killed = 0
    while len(ends(made)) < SCENES and killed < 4:
        time.sleep(rng.uniform(0.5, 2.0))
        index = rng.randrange(3)
        if running[index].poll() is None:
            running[index].send_signal(signal.SIGKILL)
            running[index].wait()
            killed += 1
        running[index] = made.start(*words, JOB_COMPLETION_INDEX=str(index))
    for one in running:
        one.wait(300)
    assert killed >= 2 and made.start("--jobs", "1").wait(300) in (0, 10, 11, 12) and ends(made) == undisturbed
    print(f"{killed} drivers killed, runs beyond the first of a scene: {begun(made) - SCENES}")
    assert begun(made) - SCENES <= killed
    assert not list((out / "_batch/work").iterdir()) and not list((out / "_batch").glob("owner*"))


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
