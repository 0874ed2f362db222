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

from mudg import app
from mudg.base.location import Location
from mudg.stages.batches import status
from mudg.stages.batches.folders import BatchFolder

pytestmark = [pytest.mark.cluster, pytest.mark.slow]
SCENES = 200
ELSEWHERE = ("unshare", "--pid", "--fork", "--mount-proc", "--kill-child")
"""Starts a program in a process space of its own, as on another machine."""
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
    assert app.main(made.words(made.folder / "out", "--jobs", "1")) == 12
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


@pytest.mark.parametrize(("scenes", "step_s", "lease_s"), [(60, 0.3, 5.0), (2, 4.0, 12.0)])
def test_a_node_of_ray_that_goes_down(
    scenes: int, step_s: float, lease_s: float, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With many scenes left, the other node has other work until the lease has run out; with none left, it waits for that."""
    pytest.importorskip("ray")
    for name, value in {"RAY_USAGE_STATS_ENABLED": "0", "RAY_AUTH_MODE": "disabled", "STEP_S": str(step_s)}.items():
        monkeypatch.setenv(name, value)
    from ray.cluster_utils import Cluster

    if subprocess.run([*ELSEWHERE, "true"], check=False, capture_output=True).returncode:
        pytest.skip("no process spaces of its own for this user (unshare --pid)")
    made = ListOfScenes(tmp_path, scenes)
    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 1})
    ray = str(Path(sys.executable).parent / "ray")
    node = [*ELSEWHERE, ray, "start", "--address", cluster.address, "--num-cpus", "1", "--block", "--disable-usage-stats"]
    with (tmp_path / "node.txt").open("wb") as log:
        doomed = subprocess.Popen(node, stdout=log, stderr=log)
    try:
        wait_until(lambda: "Ray runtime started" in (tmp_path / "node.txt").read_text(), 120)
        words = ("--engine", "ray", "--shards", "2", "--ray-address", cluster.address, "--lease-s", str(lease_s))
        running = made.start(tmp_path / "out", *words)
        wait_until(lambda: len({one["worker"] for one in begun(tmp_path / "out")}) == 2 and made.runs() >= min(6, scenes), 180)
        doomed.kill()
        doomed.wait()
        killed = time.time()
        assert running.wait(400) in (0, 11)
    finally:
        doomed.kill()
        cluster.shutdown()
    assert len(ends(tmp_path / "out")) == scenes
    events = begun(tmp_path / "out")
    again = [one for one in events if one["attempt"] > 1]
    for second in again:
        first = next(one for one in events if one["key"] == second["key"] and one["attempt"] == 1)
        before = max((one["at"] for one in events if one["worker"] == second["worker"] and one["at"] < second["at"]), default=killed)
        waited = max(0.0, second["at"] - max(killed, before + step_s))
        lost = killed - first["at"] + waited
        print(f"a node of Ray killed: {lost:.1f} s of work lost ({waited:.1f} s of it waiting), "
              f"its scene begun again {second['at'] - killed:.1f} s after the kill; lease {lease_s:.0f} s")  # fmt: skip
        assert lost < step_s + 1.0 + lease_s
    print(f"runs beyond the first of a scene: {made.runs() - scenes}")
    assert len(again) == made.runs() - scenes <= 2


def begun(out: Path) -> list[dict]:
    """Events of steps that were begun."""
    return [dict(one) for one in BatchFolder(Location.of(out)).events() if one["event"] == "began"]


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


# real steps -------------------------------------------------------------------------------------------------------------

CITIES = int(os.environ.get("MUDG_TEST_CITIES", "200"))
TINY = (
    "ingest.city.n_frames=6", "ingest.city.width=96", "ingest.city.height=64", "ingest.city.cameras=[front]", "ingest.city.lidar_beams=16",
    "ingest.contact_sheet=false", "fit.iterations=20", "fit.start.gaussians=2000",
)  # fmt: skip


class Cities:
    """A list of generated cities, each ingested, fused and fitted in the smallest size."""

    def __init__(self, folder: Path) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        self.listed = folder / "list.txt"
        self.listed.write_text("".join(f"city name=c{number:03d} seed={number}\n" for number in range(CITIES)))

    def start(self, out: Path, *more: str, **environment: str) -> subprocess.Popen[bytes]:
        words = ["batch", "run", "--list", str(self.listed), "--out", str(out), "--quiet", "--stages", "ingest", "fuse", "fit"]
        return subprocess.Popen([sys.executable, "-m", "mudg", *words, *more, "--set", *TINY], env={**os.environ, **environment})


def digests(out: Path) -> dict[str, str]:
    """Scene and step -> hash of the result's manifest."""
    assert not list((out / "_batch").glob("failed/*")), "a step has failed"
    records = [json.loads(path.read_text()) for path in (out / "_batch/done").glob("*.json")]
    return {f"{one['scene']} {one['stage']}": one["digest"] for one in records}


@pytest.fixture(scope="module")
def cities(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """What two local workers make of the cities."""
    folder = tmp_path_factory.mktemp("cities")
    began = time.monotonic()
    assert Cities(folder).start(folder / "out", "--jobs", "2").wait(40 * CITIES + 60) == 0
    print(f"{CITIES} cities through local: {time.monotonic() - began:.0f} s")
    found = digests(folder / "out")
    assert len(found) == 3 * CITIES == len(set(found.values())), "every city is another one"
    return found


def test_cities_through_numbered_tasks_of_which_one_is_killed(tmp_path: Path, cities: dict[str, str]) -> None:
    made, out, began = Cities(tmp_path), tmp_path / "out", time.monotonic()
    words = ("--engine", "env", "--shards", "2", "--lease-s", "5")
    first, second = (made.start(out, *words, JOB_COMPLETION_INDEX=str(index)) for index in range(2))
    wait_until(lambda: len(list((out / "_batch/done").glob("*"))) >= 2, 300)
    first.kill()
    first.wait()
    assert second.wait(40 * CITIES + 60) == 0
    print(f"{CITIES} cities through env, one of two tasks killed: {time.monotonic() - began:.0f} s")
    assert digests(out) == cities


def test_cities_through_slurm(tmp_path: Path, cities: dict[str, str], monkeypatch: pytest.MonkeyPatch) -> None:
    reason = slurm_here.missing()
    if reason:
        pytest.skip(reason)
    with slurm_here.slurm_here(tmp_path / "slurm") as environment:
        monkeypatch.setenv("SLURM_CONF", environment["SLURM_CONF"])
        began = time.monotonic()
        running = Cities(tmp_path).start(tmp_path / "out", "--engine", "slurm", "--shards", "2", "--wait")
        assert running.wait(40 * CITIES + 120) == 0
        print(f"{CITIES} cities through Slurm: {time.monotonic() - began:.0f} s")
        messages = "".join(path.read_text() for path in (tmp_path / "out/_batch/slurm").iterdir())
        assert digests(tmp_path / "out") == cities, messages[-2000:]


def test_cities_through_ray(tmp_path: Path, cities: dict[str, str]) -> None:
    pytest.importorskip("ray")
    began = time.monotonic()
    variables = {"RAY_USAGE_STATS_ENABLED": "0", "RAY_AUTH_MODE": "disabled"}
    running = Cities(tmp_path).start(tmp_path / "out", "--engine", "ray", "--shards", "2", **variables)
    assert running.wait(40 * CITIES + 120) == 0
    print(f"{CITIES} cities through Ray: {time.monotonic() - began:.0f} s")
    assert digests(tmp_path / "out") == cities


def wait_until(condition, seconds: float) -> None:
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "it did not happen"
        time.sleep(0.2)


def test_status_of_a_hundred_thousand_scenes(tmp_path: Path) -> None:
    import batch_overhead

    count = int(os.environ.get("MUDG_TEST_SCENES", "100000"))
    folder = Path("/dev/shm/mudg_batch_overhead") if os.path.isdir("/dev/shm") else tmp_path
    shutil.rmtree(folder, ignore_errors=True)
    try:
        code = "import sys, json, batch_overhead as b, pathlib; print(json.dumps(b.measured(pathlib.Path(sys.argv[1]), int(sys.argv[2]))))"
        words, here = [sys.executable, "-c", code, str(folder), str(count)], Path(batch_overhead.__file__).parent
        done = subprocess.run(words, capture_output=True, text=True, check=True, cwd=here)
        figures = json.loads(done.stdout)
        found = status.read_status(BatchFolder(Location.of(folder)))
    finally:
        shutil.rmtree(folder, ignore_errors=True)
    print(figures)
    assert (found.stages["command"].done, found.stages["command"].failed) == (count - count // 100, count // 100)
    assert figures["status_s"] <= 30 and figures["status_mib"] < 1024
    assert figures["ms_per_scene"] <= 50 and figures["disk_kb_per_scene"] <= 2000
