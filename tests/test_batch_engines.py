"""The same list through every engine: the same results. And what survives killed workers, nodes that go down, requeued jobs.

Run with ``pytest -m cluster tests/test_batch_engines.py``; ``tools/cluster_tests.sh`` installs Slurm and Ray before.
"""

from __future__ import annotations

import contextlib
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import slurm_here

from mudg import cli
from mudg.base.location import Location
from mudg.stages.batches import status
from mudg.stages.batches.folders import BatchFolder

pytestmark = [pytest.mark.cluster, pytest.mark.slow]
SCENES = 200
STEP = """#!/bin/sh
# step.sh NAME OUT TALLY: writes a small result, and a line per run
echo "$1" >> "$3/$1"
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
        return ["batch", "run", "--list", str(self.folder / "list.txt"), "--out", str(out), "--quiet", *more,
                "--command", "sh", str(self.folder / "step.sh"), "{name}", "{out}", str(self.tally)]  # fmt: skip

    def start(self, out: Path, *more: str, **environment: str) -> subprocess.Popen[bytes]:
        return subprocess.Popen([sys.executable, "-m", "mudg", *self.words(out, *more)], env={**os.environ, **environment})

    def runs(self) -> int:
        """How often any scene was begun."""
        return sum(len(path.read_text().splitlines()) for path in self.tally.iterdir())


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
    assert cli.main(made.words(made.folder / "out", "--jobs", "1")) == 12
    found = ends(made.folder / "out")
    assert len(found) == SCENES and sorted(found.values()).count("3") == 2
    return found


def test_several_local_workers(tmp_path: Path, undisturbed: dict[str, str]) -> None:
    made = ListOfScenes(tmp_path)
    assert made.start(tmp_path / "out", "--jobs", "3").wait(300) == 12
    assert ends(tmp_path / "out") == undisturbed and made.runs() == SCENES


def test_numbered_tasks(tmp_path: Path, undisturbed: dict[str, str]) -> None:
    made = ListOfScenes(tmp_path)
    tasks = [made.start(tmp_path / "out", "--engine", "env", "--shards", "3", JOB_COMPLETION_INDEX=str(index)) for index in range(2)]
    assert {one.wait(300) for one in tasks} <= {0, 10, 11, 12}  # the third never came: the others take its scenes
    assert ends(tmp_path / "out") == undisturbed and made.runs() == SCENES


def test_slurm(tmp_path: Path, undisturbed: dict[str, str], monkeypatch: pytest.MonkeyPatch) -> None:
    reason = slurm_here.missing()
    if reason:
        pytest.skip(reason)
    with contextlib.ExitStack() as stack:
        try:
            environment = stack.enter_context(slurm_here.slurm_here(tmp_path / "slurm"))
        except RuntimeError as error:
            pytest.skip(str(error))
        made = ListOfScenes(tmp_path / "a")
        monkeypatch.setenv("SLURM_CONF", environment["SLURM_CONF"])
        monkeypatch.chdir(tmp_path)
        words = ["--engine", "slurm", "--shards", "4", "--wait"]
        began = time.monotonic()
        assert made.start(tmp_path / "out", *words).wait(500) == 0
        print(f"{SCENES} scenes through Slurm: {time.monotonic() - began:.1f} s")
        messages = "".join(path.read_text() for path in (tmp_path / "out/_batch/slurm").iterdir())
        assert ends(tmp_path / "out") == undisturbed, messages[-2000:]
        assert made.runs() == SCENES
        _requeued(tmp_path / "requeued", environment)


def _requeued(folder: Path, environment: dict[str, str]) -> None:
    """A task that is asked to stop goes back into the queue, and ends with the same results."""
    made = ListOfScenes(folder, 30)
    environment = {**environment, "STEP_S": "1"}
    submitted = subprocess.run(
        [sys.executable, "-m", "mudg", *made.words(folder / "out", "--json", "--engine", "slurm", "--shards", "1", "--grace-s", "10")],
        env=environment, cwd=folder, capture_output=True, text=True, check=True,
    )  # fmt: skip
    number = json.loads(submitted.stdout)["job"]
    wait_until(lambda: made.runs() >= 3, 120)
    subprocess.run(["scancel", "--batch", "--signal=USR1", f"{number}_0"], env=environment, check=True)
    wait_until(lambda: len(ends(folder / "out")) == 30, 300)
    assert made.runs() <= 31 + 1
    messages = "".join(path.read_text() for path in (folder / "out/_batch/slurm").iterdir())
    shown = subprocess.run(["scontrol", "show", "job", number], env=environment, capture_output=True, text=True).stdout
    assert "Restarts=1" in shown, f"{shown} {messages[-1000:]}"


def test_ray(tmp_path: Path, undisturbed: dict[str, str], monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("ray")
    made = ListOfScenes(tmp_path)
    out = tmp_path / "out"
    variables = {"RAY_USAGE_STATS_ENABLED": "0", "RAY_AUTH_MODE": "disabled"}
    began = time.monotonic()
    assert made.start(out, "--engine", "ray", "--shards", "2", **variables).wait(500) in (10, 11, 12)
    print(f"{SCENES} scenes through Ray: {time.monotonic() - began:.1f} s")
    assert ends(out) == undisturbed and made.runs() == SCENES


def test_a_node_of_ray_that_goes_down(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("ray")
    for name, value in {"RAY_USAGE_STATS_ENABLED": "0", "RAY_AUTH_MODE": "disabled", "STEP_S": "0.3"}.items():
        monkeypatch.setenv(name, value)
    from ray.cluster_utils import Cluster

    made = ListOfScenes(tmp_path, 60)
    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 1})
    try:
        doomed = cluster.add_node(num_cpus=1)
        words = ("--engine", "ray", "--shards", "2", "--ray-address", cluster.address, "--lease-s", "5")
        running = made.start(tmp_path / "out", *words)
        wait_until(lambda: made.runs() >= 6, 180)
        cluster.remove_node(doomed, allow_graceful=False)
        assert running.wait(400) in (0, 11)
    finally:
        cluster.shutdown()
    assert len(ends(tmp_path / "out")) == 60
    print(f"runs beyond the first of a scene: {made.runs() - 60}")
    assert made.runs() - 60 <= 2


def test_chaos(tmp_path: Path, undisturbed: dict[str, str]) -> None:
    """Workers are killed at random, with their steps; one machine "goes down" with claims that must run out."""
    made = ListOfScenes(tmp_path)
    out, rng = tmp_path / "out", random.Random(3)
    words = ("--engine", "env", "--shards", "3", "--lease-s", "2", "--patience-s", "30")
    running = [made.start(out, *words, JOB_COMPLETION_INDEX=str(index)) for index in range(3)]
    wait_until(lambda: made.tally.is_dir() and made.runs() >= 3, 120)
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
    assert killed >= 2
    assert made.start(out, "--jobs", "1").wait(300) in (0, 10, 11, 12)
    assert ends(out) == undisturbed
    print(f"{killed} workers killed, runs beyond the first of a scene: {made.runs() - SCENES}")
    assert made.runs() - SCENES <= max(killed, 0.02 * SCENES)
    assert not list((out / "_batch/claims").iterdir())


def test_storage_that_fails_and_scratch_that_is_full(tmp_path: Path, undisturbed: dict[str, str]) -> None:
    """Results cannot be published for a while; then the scratch disk is full for a while."""
    made = ListOfScenes(tmp_path, 20)
    out = tmp_path / "out"
    blocked = out / "s003"
    blocked.parent.mkdir()
    (out / "_batch").mkdir()
    blocked.write_text("a file where a folder should be")
    running = made.start(out, "--jobs", "1", "--patience-s", "0", "--scratch", str(tmp_path / "scratch"))
    time.sleep(2.0)
    running.wait(300)
    assert len(ends(out)) == 19 - sum(name.endswith("13") for name in ()) and "s003" not in ends(out)
    blocked.unlink()
    claims = list((out / "_batch/claims").iterdir())
    assert claims, "the scene waits for another try"
    record = json.loads(claims[0].read_text())
    claims[0].write_text(json.dumps({**record, "until": 0.0, "host": "another machine"}))
    made.start(out, "--jobs", "1", "--patience-s", "0").wait(300)
    assert {name: end for name, end in undisturbed.items() if name < "s020"} == ends(out)


def wait_until(condition, seconds: float) -> None:
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "it did not happen"
        time.sleep(0.2)


def test_status_of_a_hundred_thousand_scenes(tmp_path: Path) -> None:
    import batch_overhead

    folder = Path("/dev/shm/mudg_batch_overhead") if os.path.isdir("/dev/shm") else tmp_path
    shutil.rmtree(folder, ignore_errors=True)
    try:
        code = "import sys, json, batch_overhead, pathlib; print(json.dumps(batch_overhead.measured(pathlib.Path(sys.argv[1]), 100_000)))"
        done = subprocess.run(
            [sys.executable, "-c", code, str(folder)], capture_output=True, text=True, check=True, cwd=Path(batch_overhead.__file__).parent
        )
        figures = json.loads(done.stdout)
        found = status.read_status(BatchFolder(Location.of(folder)))
    finally:
        shutil.rmtree(folder, ignore_errors=True)
    print(figures)
    assert found.stages["command"].done == 99_000 and found.stages["command"].failed == 1000
    assert figures["status_s"] <= 30 and figures["status_mib"] < 1024
    assert figures["ms_per_scene"] <= 50 and figures["disk_kb_per_scene"] <= 2000
