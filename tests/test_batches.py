"""Batches: claims, retries, takeover, stop and resume, bounds, second runs, status and costs."""

from __future__ import annotations

import json
import multiprocessing
import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

from mudg import app
from mudg.base.errors import InputError, ResourceError, UsageError
from mudg.base.location import Location
from mudg.stages import batch
from mudg.stages.batches import claims, costs, engines, quality, retries, slurm, status, work
from mudg.stages.batches.children import Ending, last_words
from mudg.stages.batches.folders import BatchFolder
from mudg.stages.batches.lists import Entry, read_list, shard_of
from mudg.stages.batches.plan import BatchPlan, BatchStage, command_of, plan_of
from mudg.stages.batches.scratch import WorkFolder
from mudg.stages.config import BatchConfig, RunConfig

COMMAND = ("program", "{source}", "{out}")
OWNER = claims.Owner("here")


def entries(count: int) -> list[Entry]:
    return [Entry(f"scene{number:03d}", f"/logs/{number}") for number in range(count)]


def request(out: Path, count: int = 3, **rules: object) -> work.WorkRequest:
    folder, plan, listed = BatchFolder(Location.of(out)), plan_of((), {}, COMMAND), entries(count)
    folder.begin(plan, listed)
    return work.WorkRequest(folder, plan, listed, work.WorkRules(**{"patience_s": 0.0, **rules}))  # type: ignore[arg-type]


def writes(unit: object, folder: WorkFolder) -> Ending:
    folder.result.mkdir(parents=True, exist_ok=True)
    (folder.result / "x.json").write_text(json.dumps({"value": unit.entry.source, "n": 7}))  # type: ignore[attr-defined]
    return Ending(0, seconds=0.5, processor_s=0.25)


def done_records(out: Path) -> dict[str, dict]:
    return {path.stem: json.loads(path.read_text()) for path in sorted((out / "_batch/done").glob("*.json"))}


def fail_with(code: int, times: int, counter: dict[str, int]):
    def perform(unit, folder):
        counter[unit.entry.name] = counter.get(unit.entry.name, 0) + 1
        return Ending(code, "it broke", "error: it broke\n") if counter[unit.entry.name] <= times else writes(unit, folder)

    return perform


# ---- keys and lists -----------------------------------------------------------------------------------------------------


def test_a_key_depends_on_log_settings_and_what_is_read() -> None:
    settings = {"ingest": {"frames": "", "device": "auto"}, "fuse": {"voxel_m": 0.0}}
    plan = plan_of(("ingest", "fuse"), settings)
    first, second = plan.units(Entry("a", "/logs/a"))
    assert second.needs == {"ingest": first.key}
    assert [unit.key for unit in plan.units(Entry("a", "/logs/a"))] == [first.key, second.key]
    other = plan_of(("ingest", "fuse"), {**settings, "ingest": {"frames": "0:5"}})
    assert {unit.key for unit in other.units(Entry("a", "/logs/a"))}.isdisjoint({first.key, second.key})
    device = plan_of(("ingest", "fuse"), {**settings, "ingest": {"frames": "", "device": "cuda"}})
    assert next(iter(device.units(Entry("a", "/logs/a")))).key == first.key
    for changed in (Entry("a", "/logs/b"), Entry("a", "/logs/a", {"revision": "2"}), Entry("a", "/logs/a", {"frames": "0:3"})):
        assert next(iter(plan.units(changed))).key != first.key


def test_steps_need_what_they_read() -> None:
    values = {name: {} for name in ("ingest", "annotate", "fuse", "fit", "render", "synthesize", "score")}
    plan = plan_of(("ingest", "annotate", "fuse", "fit", "render", "score"), values)
    assert {stage.name: stage.needs for stage in plan.stages} == {
        "ingest": (), "annotate": ("ingest",), "fuse": ("annotate",), "fit": ("annotate", "fuse"), "render": ("annotate", "fit"),
        "score": ("annotate", "fuse", "render"),
    }  # fmt: skip
    assert plan_of(("fuse",), values).stages[0].words == ("fuse", "{source}")
    for names in (("fit",), ("ingest", "ingest"), ("nothing",), ()):
        with pytest.raises(UsageError):
            plan_of(names, values)
    with pytest.raises(UsageError, match="where to write"):
        plan_of((), {}, ("program",))


def test_settings_of_a_line_are_those_of_ingest_also_in_the_chain() -> None:
    values = {"ingest": {}, "fuse": {}}
    entry = Entry("a", "city", {"frames": "0:5", "cameras": "front,left", "seed": "7", "revision": "2"})
    ingest, fuse = plan_of(("ingest", "fuse"), values).units(entry)
    (chain,) = plan_of(("run",), values).units(entry)
    flags = {unit.stage.name: command_of(unit, {"source": "city", "ingest": "i"}, "o", "") for unit in (ingest, fuse, chain)}
    assert flags["ingest"][-5:] == ["--frames=0:5", "--cameras", "front", "left", "--city.seed=7"]
    assert flags["run"][-5:] == ["--ingest.frames=0:5", "--ingest.cameras", "front", "left", "--ingest.city.seed=7"]
    assert flags["fuse"][-1] == "--quiet"
    for words in flags.values():
        app.parse(words[3:])


def test_a_scene_stays_in_its_shard_when_the_list_grows(tmp_path: Path) -> None:
    names = [entry.name for entry in entries(200)]
    counts = [sum(shard_of(name, 4) == i for name in names) for i in range(4)]
    assert sum(counts) == 200 and min(counts) > 20
    assert all(shard_of(name, 12) % 4 == shard_of(name, 4) for name in names)  # lanes are shards of a finer division


def test_sources_may_be_addresses(tmp_path: Path) -> None:
    (tmp_path / "list.txt").write_text("s3://bucket/logs/a revision=3\nlocal/b\n")
    found = read_list(tmp_path / "list.txt", ("revision",))
    assert [(e.name, e.source) for e in found] == [("a", "s3://bucket/logs/a"), ("b", str(tmp_path / "local/b"))]


# ---- claims -------------------------------------------------------------------------------------------------------------


def _race(folder: str, key: str, start: float, results: object) -> None:
    time.sleep(max(0.0, start - time.time()))
    found = claims.take(Location.of(folder), key, claims.Owner(f"w{os.getpid()}", "a machine of its own", 1), 60.0)
    results.put(found.attempt if isinstance(found, claims.Claim) else 0)  # type: ignore[attr-defined]


def test_of_eight_processes_one_gets_a_claim_and_one_an_expired_one(tmp_path: Path) -> None:
    context = multiprocessing.get_context("fork" if sys.platform == "linux" else "spawn")
    for key, first in (("fresh", 1), ("expired", 2)):
        if key == "expired":
            claims.take(Location.of(tmp_path), key, claims.Owner("gone", "another machine"), -1.0)
        results = context.Queue()
        start = time.time() + 0.3
        racers = [context.Process(target=_race, args=(str(tmp_path), key, start, results)) for _ in range(8)]
        for one in racers:
            one.start()
        won = [attempt for attempt in (results.get(timeout=30) for _ in racers) if attempt]
        for one in racers:
            one.join()
        assert won == [first]


def test_a_lease_is_kept_by_renewing_and_lost_to_the_next_attempt(tmp_path: Path) -> None:
    place = Location.of(tmp_path)
    mine = claims.take(place, "k", claims.Owner("me", "host one"), 0.2)
    assert isinstance(mine, claims.Claim) and mine.attempt == 1
    other = claims.Owner("you", "host two")
    assert isinstance(claims.take(place, "k", other, 60.0), claims.Busy)
    lost = threading.Event()
    with claims.Heartbeat(mine, lost.set):
        time.sleep(0.4)
        assert isinstance(claims.take(place, "k", other, 60.0), claims.Busy)
    time.sleep(0.25)
    theirs = claims.take(place, "k", other, 60.0)
    assert isinstance(theirs, claims.Claim) and theirs.attempt == 2 and theirs.counts == {retries.LOST: 1}
    with claims.Heartbeat(mine, lost.set):
        assert lost.wait(2.0)
    assert not mine.renew() and mine.lost.is_set()


def test_a_worker_that_died_on_this_machine_is_replaced_at_once(tmp_path: Path) -> None:
    dead = subprocess.Popen([sys.executable, "-c", ""])
    dead.wait()
    claims.take(Location.of(tmp_path), "k", claims.Owner("dead", process=dead.pid), 600.0)
    found = claims.take(Location.of(tmp_path), "k", OWNER, 600.0)
    assert isinstance(found, claims.Claim) and found.attempt == 2


# ---- workers ------------------------------------------------------------------------------------------------------------


def test_a_second_run_does_nothing_and_any_order_gives_the_same(tmp_path: Path) -> None:
    asked = request(tmp_path / "a", 6)
    assert work.Worker(asked, perform=writes).run() == {"done": 6}
    again = work.Worker(asked, perform=lambda *_: pytest.fail("nothing was to be done")).run()  # type: ignore[arg-type, return-value]
    assert again == {}
    backwards = request(tmp_path / "b", 6)
    object.__setattr__(backwards, "entries", list(reversed(backwards.entries)))
    work.Worker(backwards, perform=writes).run()
    first, second = done_records(tmp_path / "a"), done_records(tmp_path / "b")
    assert {key: one["digest"] for key, one in first.items()} == {key: one["digest"] for key, one in second.items()}
    assert not list((tmp_path / "a/_batch/claims").iterdir()) and not list((tmp_path / "a/_batch/work").iterdir())
    one = next(iter(first.values()))
    assert (tmp_path / "a" / one["place"] / "x.json").is_file()


def test_an_output_of_another_batch_or_of_something_else_is_refused(tmp_path: Path) -> None:
    asked = request(tmp_path / "a")
    with pytest.raises(UsageError, match="other steps"):
        asked.folder.begin(plan_of((), {}, (*COMMAND, "--more")), asked.entries)
    asked.folder.begin(asked.plan, entries(5))  # a longer list is the same batch
    assert len(asked.folder.entries()) == 5
    (tmp_path / "b").mkdir()
    (tmp_path / "b/photo.jpg").write_text("")
    with pytest.raises(UsageError, match="something else"):
        BatchFolder(Location.of(tmp_path / "b")).begin(asked.plan, entries(1))


@pytest.mark.parametrize(("code", "tries"), [(1, 1), (2, 1), (3, 1), (4, 2), (6, 1), (134, 3)])
def test_exit_codes_decide_how_often_a_step_is_tried(tmp_path: Path, code: int, tries: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(retries, "backoff", lambda *_: 0.0)
    counter: dict[str, int] = {}
    asked = request(tmp_path, 1, patience_s=5.0)
    counts = work.Worker(asked, perform=fail_with(code, 99, counter)).run()
    assert counts == {"failed": 1} and counter == {"scene000": tries}
    record = json.loads(next((tmp_path / "_batch/failed").iterdir()).read_text())
    assert (record["code"], record["words"], record["attempt"]) == (code, "it broke", tries)
    assert next((tmp_path / "_batch/logs").iterdir()).read_text() == "error: it broke\n"


def test_want_of_memory_waits_longer_on_the_machine_where_it_was_met(tmp_path: Path) -> None:
    assert [retries.backoff(5, times, False) for times in (1, 2, 3)] == [60, 120, 240]
    counter: dict[str, int] = {}
    work.Worker(request(tmp_path, 1), perform=fail_with(5, 1, counter)).run()
    place = Location.of(tmp_path / "_batch/claims")
    key = next(iter((tmp_path / "_batch/claims").iterdir())).name.split(".")[0]
    here, there = claims.take(place, key, OWNER, 60.0), claims.take(place, key, claims.Owner("x", "another machine"), 60.0)
    assert isinstance(here, claims.Busy) and isinstance(there, claims.Busy)
    assert here.until_s == pytest.approx(180, abs=5) and there.until_s == pytest.approx(60, abs=5)


def test_what_a_killed_worker_left_is_gone_on_with(tmp_path: Path) -> None:
    asked = request(tmp_path, 1)
    unit = next(iter(asked.plan.units(asked.entries[0])))
    claims.take(asked.folder.claims, unit.key, claims.Owner("gone", "another machine"), -1.0)
    left = tmp_path / "_batch/work" / f"{unit.key}.1/result"
    left.mkdir(parents=True)
    (left / "checkpoint").write_text("half")
    (left / "lock").write_text("{}")
    seen = []

    def resumes(unit, folder):
        seen.append(((folder.result / "checkpoint").read_text(), (folder.result / "lock").exists(), left.exists()))
        return writes(unit, folder)

    assert work.Worker(asked, perform=resumes).run() == {"done": 1}
    assert seen == [("half", False, False)]


def test_a_result_without_a_record_is_taken_as_it_is(tmp_path: Path) -> None:
    """A worker that was cut off between publishing and recording."""
    asked = request(tmp_path, 1)
    work.Worker(asked, perform=writes).run()
    (record,) = (tmp_path / "_batch/done").iterdir()
    before = json.loads(record.read_text())["digest"]
    record.unlink()
    assert work.Worker(asked, perform=lambda *_: Ending(1, "not again")).run() == {"done": 1}
    assert json.loads(record.read_text())["digest"] == before


def test_a_worker_that_lost_its_claim_records_nothing(tmp_path: Path) -> None:
    asked = request(tmp_path, 1)

    def overtaken(unit, folder):
        (tmp_path / "_batch/claims" / f"{unit.key}.2.json").write_text(json.dumps({"state": "working", "until": time.time() + 60}))
        return writes(unit, folder)

    assert work.Worker(asked, perform=overtaken).run() == {}
    assert not done_records(tmp_path) and not (tmp_path / "_batch/failed").exists()


def test_bounds_reject_a_result_with_its_number(tmp_path: Path) -> None:
    asked = request(tmp_path, 1, bounds=quality.parse_bounds(["x.json:n>=8", "x.json:missing>=1"]))
    assert work.Worker(asked, perform=writes).run() == {"rejected": 1}
    found = status.read_status(asked.folder)
    (failure,) = found.failures.values()
    assert (failure.code, failure.words, failure.state) == (retries.REJECTED, "x.json:n>=8: it is 7", "rejected")
    assert batch.retry(str(tmp_path), "quality")["forgotten"] == 1
    with pytest.raises(InputError, match="nothing failed"):
        batch.retry(str(tmp_path), "5")


def test_bounds_read_scores(tmp_path: Path) -> None:
    rows = [{"method": "mudg_s", "distance_m": 3.0, "values": {"psnr": 17.5, "fid": "not computed"}}]
    (tmp_path / "score").mkdir()
    (tmp_path / "score/metrics.json").write_text(json.dumps({"by_distance": rows}))
    low, high, other = quality.parse_bounds(["mudg_s.psnr@3>=18", "mudg_s.psnr@3<=18", "mudg_s.fid@3<=1"])
    assert low.problem(tmp_path) == "mudg_s.psnr@3>=18: it is 17.5"
    assert high.problem(tmp_path) == "" and other.problem(tmp_path) == ""
    for bad in ("psnr>=1", "a.b>1", "a.b>=x", "../x.json:n>=1", "a.b>=inf"):
        with pytest.raises(UsageError):
            quality.parse_bounds([bad])


def test_a_second_run_that_differs_is_a_failure(tmp_path: Path) -> None:
    same = request(tmp_path / "same", 1, second_share=1.0)
    assert work.Worker(same, perform=writes).run() == {"done": 1}
    assert status.read_status(same.folder).events == {"second": 1, "different": 0}
    calls = []

    def differs(unit, folder):
        calls.append(1)
        ending = writes(unit, folder)
        (folder.result / "x.json").write_text(str(len(calls)))
        return ending

    assert work.Worker(request(tmp_path / "other", 1, second_share=1.0), perform=differs).run() == {"failed": 1}
    assert sum(quality.is_sampled(f"{n:032x}", 0.1) for n in range(2000)) == pytest.approx(200, abs=50)


def test_too_many_failures_stop_a_batch(tmp_path: Path) -> None:
    worker = work.Worker(request(tmp_path, 20, most_failures="10%"), perform=lambda *_: Ending(3, "bad"))
    assert worker.run() == {"failed": 3} and worker.gave_up
    assert work.limit_of("5%", 1000) == 50 and work.limit_of("7", 1000) == 7


# ---- status and costs -----------------------------------------------------------------------------------------------------


def test_status_counts_groups_and_forecasts(tmp_path: Path) -> None:
    asked = request(tmp_path, 6)

    def some(unit, folder):
        return Ending(3, f"it is cut off; {unit.entry.source}") if unit.entry.name < "scene002" else writes(unit, folder)

    work.Worker(asked, perform=some).run()
    found = status.read_status(asked.folder)
    figures = found.stages["command"]
    assert (figures.done, figures.failed, found.finished_scenes, found.left()) == (4, 2, 4, 0)
    assert [(words, count) for words, count, _ in found.reasons()] == [("3 bad input: it is cut off", 2)]
    assert figures.seconds == pytest.approx(2.0)
    for file in (tmp_path / "_batch/events").iterdir():  # events may be lost with a worker; the records tell the same
        file.unlink()
    again = status.read_status(asked.folder)
    assert again.stages["command"].done == 4 and again.stages["command"].seconds == pytest.approx(2.0)
    assert again.reasons() == found.reasons()
    asked.folder.begin(asked.plan, entries(10))
    longer = status.read_status(asked.folder)
    assert longer.left() == 4
    cost = costs.costs_of(longer, 3600.0, 0.0)
    assert cost["stages"]["command"]["core_hours"] == pytest.approx(1.0 / 3600, abs=1e-4)
    assert cost["total"]["money_left"] == pytest.approx(1.0, rel=0.01)
    assert "scenes" in costs.text_of(cost) and "cut off" in status.text_of(found)
    page = status.page_of(found)
    assert "it is cut off" in page and "<script" not in page


def test_status_escapes_what_others_wrote(tmp_path: Path) -> None:
    asked = request(tmp_path, 1)
    work.Worker(asked, perform=lambda *_: Ending(3, "<img src=x onerror=alert(1)>")).run()
    assert "<img" not in status.page_of(status.read_status(asked.folder))
    with (tmp_path / "_batch/events/other.jsonl").open("w") as handle:
        handle.write('{"event": "done", "key": "forged"}\n[1]\n{"cut')
    assert status.read_status(asked.folder).stages["command"].done == 0


def test_facts_are_summed_over_the_logs(tmp_path: Path) -> None:
    poses = [[1, 0, 0, x, 0, 1, 0, y, 0, 0, 1, 0] for x, y in ((0, 0), (3, 4), (3, 10))]
    ego = {"times_s": [0.0, 1.0, 1.5], "world_from_ego": poses}
    scene = {"frames": [1, 2], "cameras": {"front": {}}, "ego": ego, "source": {"dataset": "kitti"}}
    (tmp_path / "scene.json").write_text(json.dumps(scene))
    (tmp_path / "tracks.json").write_text(json.dumps({"tracks": [{"label": "car"}, {"label": "car"}]}))
    facts = {"dataset": "kitti", "cameras": 1, "images": 2, "seconds": 1.5, "metres": 11.0, "objects": {"car": 2}}
    assert quality.facts_of(tmp_path) == facts
    folder, plan = BatchFolder(Location.of(tmp_path / "out")), BatchPlan((BatchStage("ingest", COMMAND),))
    folder.begin(plan, entries(3))

    def copies(unit, folder):
        shutil.copytree(tmp_path, folder.result, ignore=shutil.ignore_patterns("out"))
        return Ending(0)

    work.Worker(work.WorkRequest(folder, plan, entries(3)), perform=copies).run()
    found = status.read_status(folder)
    corpus = found.record()["corpus"]
    assert (corpus["scenes"], corpus["images"], corpus["kilometres"], corpus["objects"]) == (3, 6, 0.033, {"car": 6})
    assert "Kilometres driven" in status.page_of(found)


# ---- engines ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("environment", "shards", "wanted"),
    [
        ({"SLURM_ARRAY_TASK_ID": "3", "SLURM_ARRAY_TASK_COUNT": "8"}, 1, (3, 8)),
        ({"SLURM_ARRAY_TASK_ID": "3", "SLURM_ARRAY_TASK_COUNT": "8", "SLURM_ARRAY_TASK_MIN": "1"}, 1, (2, 8)),
        ({"JOB_COMPLETION_INDEX": "0"}, 5, (0, 5)),
        ({"SKYPILOT_NODE_RANK": "1", "SKYPILOT_NUM_NODES": "4"}, 1, (1, 4)),
        ({"AWS_BATCH_JOB_ARRAY_INDEX": "7"}, 9, (7, 9)),
    ],
)
def test_schedulers_number_the_shards(environment: dict[str, str], shards: int, wanted: tuple[int, int]) -> None:
    assert engines.shard_of_environment(shards, environment) == wanted


@pytest.mark.parametrize("environment", [{}, {"JOB_COMPLETION_INDEX": "5"}, {"JOB_COMPLETION_INDEX": "x"}])
def test_numbers_that_are_no_shard_are_refused(environment: dict[str, str]) -> None:
    with pytest.raises(UsageError):
        engines.shard_of_environment(5, environment)


SCRIPT = """#!/bin/bash
#SBATCH --job-name=mudg-batch
#SBATCH --array=0-7%2
#SBATCH --requeue
#SBATCH --open-mode=append
#SBATCH --signal=B:USR1@120
#SBATCH --output=/runs/_batch/slurm/%A_%a.txt
#SBATCH --partition=gpu
#SBATCH --gres=gpu:1

cd '/my folder' || exit 2
pass_on() { kill -TERM "$child" 2>/dev/null; }
trap pass_on USR1 TERM
mudg batch run --list 'a b.txt' &
child=$!
wait "$child"
while kill -0 "$child" 2>/dev/null; do wait "$child"; done
wait "$child"  # one that a signal cut short does not say how the task ended
code=$?
if [ "$code" -eq 143 ]; then
  scontrol requeue "${SLURM_ARRAY_JOB_ID}_${SLURM_ARRAY_TASK_ID}" && sleep 60
fi
exit "$code"
"""


def test_the_slurm_script() -> None:
    words = ("mudg", "batch", "run", "--list", "a b.txt")
    job = slurm.SlurmJob(words, 8, "/my folder", "/runs/_batch/slurm/%A_%a.txt", 100.0, 2, ("partition=gpu", "gres=gpu:1"))
    assert slurm.script_of(job) == SCRIPT
    for bad in ("array=0-3", "time=1\n#SBATCH --wrap=x", "--partition=gpu"):
        with pytest.raises(UsageError):
            slurm.script_of(slurm.SlurmJob(words, 8, "/", "/o", 1.0, 0, (bad,)))
    words = ["batch", "run", "--engine", "slurm", "--shards=8", "--wait", "--list", "l"]
    assert slurm.task_words(words, 8)[3:] == ("batch", "run", "--list", "l", "--engine", "env", "--shards", "8", "--quiet")


@pytest.mark.skipif(shutil.which("bash") is None, reason="no bash")
def test_the_slurm_script_forwards_the_signal_and_asks_to_be_queued_again(tmp_path: Path) -> None:
    (tmp_path / "bin").mkdir()
    (tmp_path / "bin/scontrol").write_text(f"#!/bin/sh\necho \"$@\" >> {tmp_path}/requeued\nexit 1\n")
    (tmp_path / "bin/scontrol").chmod(0o755)
    child = f"import signal,sys,time; signal.signal(15, lambda *_: sys.exit(143)); open({str(tmp_path / 'up')!r},'w'); time.sleep(30)"
    job = slurm.SlurmJob((sys.executable, "-c", child), 1, str(tmp_path), "/o", 1.0)
    environment = {**os.environ, "PATH": f"{tmp_path}/bin:{os.environ['PATH']}", "SLURM_ARRAY_JOB_ID": "9", "SLURM_ARRAY_TASK_ID": "4"}
    process = subprocess.Popen(["bash", "-c", slurm.script_of(job)], env=environment)
    wait_for(tmp_path / "up")
    process.send_signal(signal.SIGUSR1)
    assert process.wait(20) == 143
    assert (tmp_path / "requeued").read_text() == "requeue 9_4\n"


def wait_for(path: Path, seconds: float = 20.0) -> None:
    end = time.monotonic() + seconds
    while not path.exists():
        assert time.monotonic() < end, f"{path} did not come"
        time.sleep(0.02)


# ---- processes ----------------------------------------------------------------------------------------------------------

CHECKPOINTS = """
import os, signal, sys, time
out, up = sys.argv[1:3]
os.makedirs(out, exist_ok=True)
half = os.path.join(out, "half")
def stop(*_):
    open(half, "w").write("half")
    sys.exit(143)
signal.signal(signal.SIGTERM, stop)
if not os.path.exists(half):
    open(up, "w").write(str(os.getpid()))
    time.sleep(60)
os.remove(half)
open(os.path.join(out, "whole"), "w").write("whole")
"""


def test_sigterm_leads_to_a_checkpoint_and_the_same_command_goes_on(tmp_path: Path) -> None:
    (tmp_path / "step.py").write_text(CHECKPOINTS)
    (tmp_path / "list.txt").write_text("city name=one\n")
    words = [sys.executable, "-m", "mudg", "batch", "run", "--list", str(tmp_path / "list.txt"), "--out", str(tmp_path / "out"),
             "--jobs", "1", "--quiet", "--command", sys.executable, str(tmp_path / "step.py"), "{out}", str(tmp_path / "up")]  # fmt: skip
    process = subprocess.Popen(words)
    wait_for(tmp_path / "up", 60)
    process.send_signal(signal.SIGTERM)
    assert process.wait(30) == 143
    (claim,) = (tmp_path / "out/_batch/claims").iterdir()
    assert json.loads(claim.read_text())["counts"] == {"143": 1}
    assert next((tmp_path / "out/_batch/work").iterdir()).name.endswith(".left")
    (tmp_path / "up").unlink()
    assert app.main(words[3:]) == 0
    assert not (tmp_path / "up").exists()
    (record,) = done_records(tmp_path / "out").values()
    assert record["attempt"] == 2 and (tmp_path / "out" / record["place"] / "whole").is_file()


@pytest.mark.skipif(shutil.which("setpriv") is None, reason="no setpriv")
def test_a_killed_worker_leaves_no_orphan(tmp_path: Path) -> None:
    (tmp_path / "step.py").write_text(CHECKPOINTS)
    (tmp_path / "list.txt").write_text("city name=one\n")
    words = ["batch", "run", "--list", str(tmp_path / "list.txt"), "--out", str(tmp_path / "out"), "--jobs", "1", "--quiet",
             "--command", sys.executable, str(tmp_path / "step.py"), "{out}", str(tmp_path / "up")]  # fmt: skip
    process = subprocess.Popen([sys.executable, "-m", "mudg", *words])
    wait_for(tmp_path / "up", 60)
    time.sleep(0.1)
    child = int((tmp_path / "up").read_text())
    process.kill()
    process.wait()
    end = time.monotonic() + 10
    while Path(f"/proc/{child}").exists() and "State:\tZ" not in Path(f"/proc/{child}/status").read_text():
        assert time.monotonic() < end, "the step outlived its worker"
        time.sleep(0.05)


def test_last_words() -> None:
    said = "warning\nerror: it is broken\n  where: a.bin\n  expected: 4 bytes\n  got: 3\n  what to do: mend it\n"
    assert last_words(said, 3) == "it is broken; a.bin; expected 4 bytes; got 3"
    assert "signal 9" in last_words("", 137) and "memory" in last_words("", 137)
    assert last_words("Traceback\nZeroDivisionError: x\n", 1) == "its process ended with code 1: ZeroDivisionError: x"


def test_the_command_line_says_what_is_missing(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert app.main(["batch", "status", str(tmp_path)]) == 3
    assert app.main(["batch", "run", "--out", str(tmp_path / "o")]) == 2
    (tmp_path / "list.txt").write_text("city\n")
    words = ["batch", "run", "--list", str(tmp_path / "list.txt"), "--out", str(tmp_path / "o")]
    assert app.main([*words, "--max-failures", "many"]) == 2
    assert app.main([*words, "--set", "fit.iterationz=3"]) == 2
    assert "did you mean fit.iterations" in capsys.readouterr().err
    assert app.main([*words, "--stages", "ingest", "fuse", "--dry-run"]) == 0
    assert "1 scenes: ingest -> fuse" in capsys.readouterr().out
    assert not (tmp_path / "o").exists()


def test_paths_in_settings_are_made_absolute(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "models/net").mkdir(parents=True)
    settings = batch.settings_of("default", None, ["annotate.weights=models/net", "fit.iterations=5"])
    assert settings.fit.iterations == 5
    plan = batch.plan_for(BatchConfig(stages=("ingest", "annotate")), settings)
    assert plan.stages[1].settings["weights"] == str(tmp_path / "models/net")
    assert batch.plan_for(BatchConfig(), RunConfig()).stages[0].name == "run"


# ---- templates for schedulers -------------------------------------------------------------------------------------------

EXAMPLES = Path(__file__).resolve().parents[1] / "docs/examples"
ANY = object()
KUBERNETES = {
    "apiVersion": "batch/v1", "kind": "Job", "metadata": {"name": str},
    "spec": {
        "completionMode": "Indexed", "completions": int, "parallelism": int, "backoffLimitPerIndex": int, "maxFailedIndexes": int,
        "podFailurePolicy": {"rules": [{"action": str, "onExitCodes?": {"containerName": str, "operator": str, "values": [int]},
                                        "onPodConditions?": [{"type": str}]}]},
        "template": {"spec": {
            "restartPolicy": "Never", "terminationGracePeriodSeconds": int, "serviceAccountName": str,
            "containers": [{"name": str, "image": str, "command": [str], "args": [str], "resources": {"requests": ANY, "limits": ANY},
                            "volumeMounts": [{"name": str, "mountPath": str}]}],
            "volumes": [{"name": str, "emptyDir": {}}],
        }},
    },
}  # fmt: skip
SKYPILOT = {
    "name": str, "num_nodes": int, "envs": {"LIST": str, "OUT": str}, "setup": str, "run": str,
    "resources": {"cpus": str, "memory": str, "disk_size": int, "use_spot": bool,
                  "job_recovery": {"strategy": str, "max_restarts_on_errors": int}},
}  # fmt: skip


def differs(found: object, schema: object, at: str = "") -> list[str]:
    """What in a value does not follow a schema: mappings with these keys (? = may be absent), lists of these, types, or values."""
    if schema is ANY:
        return []
    if isinstance(schema, type):
        return [] if type(found) is schema else [f"{at}: {found!r}"]
    if isinstance(schema, list):
        return [p for i, one in enumerate(found) for p in differs(one, schema[0], f"{at}[{i}]")] if isinstance(found, list) else [at]
    if isinstance(schema, dict):
        if not isinstance(found, dict):
            return [at]
        known = {name.rstrip("?"): (name.endswith("?"), inner) for name, inner in schema.items()}
        wrong = [f"{at}.{name}" for name in found if name not in known]
        wrong += [f"{at}.{name} is missing" for name, (optional, _) in known.items() if not optional and name not in found]
        return wrong + [p for name, inner in found.items() if name in known for p in differs(inner, known[name][1], f"{at}.{name}")]
    return [] if found == schema else [f"{at}: {found!r}"]


def test_templates_follow_their_schemas_and_start_a_batch() -> None:
    import yaml

    job = yaml.safe_load((EXAMPLES / "batch_kubernetes.yaml").read_text())
    assert differs(job, KUBERNETES) == []
    spec = job["spec"]
    pod, (container,) = spec["template"]["spec"], spec["template"]["spec"]["containers"]
    words = [*container["command"], *container["args"]]
    parsed = app.parse(words[1:])
    assert parsed.settings.engine == "env" and parsed.settings.shards == spec["completions"]
    assert pod["terminationGracePeriodSeconds"] > parsed.settings.grace_s
    rules = [rule["onExitCodes"] for rule in spec["podFailurePolicy"]["rules"] if "onExitCodes" in rule]
    assert {rule["containerName"] for rule in rules} == {container["name"]}
    assert {mount["name"] for mount in container["volumeMounts"]} == {volume["name"] for volume in pod["volumes"]}
    task = yaml.safe_load((EXAMPLES / "batch_skypilot.yaml").read_text())
    assert differs(task, SKYPILOT) == []
    line = next(line for line in task["run"].splitlines() if line.startswith("mudg"))
    assert app.parse(line.split()[1:]).settings.engine == "env"
    assert differs({"a": 1, "c": "x"}, {"a": str, "b": int}) == [".c", ".b is missing", ".a: 1"]


# ---- object stores ------------------------------------------------------------------------------------------------------


@pytest.fixture
def bucket() -> Location:
    fsspec = pytest.importorskip("fsspec")
    fsspec.filesystem("memory").store.clear()
    return Location.of("memory://bucket/runs")


def remote_request(out: Location, scratch: Path, count: int = 2) -> work.WorkRequest:
    folder, plan, listed = BatchFolder(out), plan_of((), {}, COMMAND), entries(count)
    folder.begin(plan, listed)
    return work.WorkRequest(folder, plan, listed, work.WorkRules(patience_s=0.0, scratch=scratch))


@pytest.mark.filterwarnings("ignore::ResourceWarning")
def test_results_in_an_object_store(bucket: Location, tmp_path: Path) -> None:
    asked = remote_request(bucket, tmp_path)
    assert work.Worker(asked, perform=writes).run() == {"done": 2}
    for unit in (unit for entry in asked.entries for unit in asked.plan.units(entry)):
        record = json.loads(asked.folder.done(unit.key).load())
        assert json.loads((bucket / record["place"] / "x.json").load())["n"] == 7
    assert status.read_status(asked.folder).stages["command"].done == 2
    assert work.Worker(asked, perform=lambda *_: pytest.fail("again")).run() == {}  # type: ignore[arg-type, return-value]
    assert not list((tmp_path / "mudg_batch").iterdir()) and asked.folder.claims.names() == []


def test_a_checkpoint_goes_to_the_next_machine(bucket: Location, tmp_path: Path) -> None:
    asked = remote_request(bucket, tmp_path / "one", 1)

    def stopped(unit, folder):
        folder.result.mkdir(parents=True)
        (folder.result / "half").write_text("half")
        worker.stop()
        return Ending(143)

    worker = work.Worker(asked, perform=stopped)
    assert worker.run() == {} and worker.stopped
    seen = []

    def resumes(unit, folder):
        seen.append((folder.result / "half").read_text())
        return writes(unit, folder)

    elsewhere = remote_request(bucket, tmp_path / "two", 1)
    assert work.Worker(elsewhere, perform=resumes).run() == {"done": 1}
    assert seen == ["half"] and (asked.folder.own / "partial").names() == []


def test_an_upload_that_fails_for_a_moment_costs_no_second_run(
    bucket: Location, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(work, "_PUBLISH_WAITS_S", (0.0, 0.0))
    tries, runs, publish = [], [], WorkFolder.publish

    def fails_twice(self: WorkFolder, read_later: bool = False) -> None:
        tries.append(1)
        if len(tries) <= 2:
            raise ResourceError("no connection")
        publish(self, read_later)

    def counted(unit, folder):
        runs.append(1)
        return writes(unit, folder)

    monkeypatch.setattr(WorkFolder, "publish", fails_twice)
    assert work.Worker(remote_request(bucket, tmp_path, 1), perform=counted).run() == {"done": 1}
    assert (len(tries), len(runs)) == (3, 1)


def test_a_full_scratch_disk_is_tried_again_and_emptied(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(retries, "backoff", lambda *_: 0.0)
    asked = request(tmp_path / "out", 1, scratch=tmp_path / "scratch", patience_s=5.0)
    runs = []

    def full(unit, folder):
        runs.append(list((tmp_path / "scratch/mudg_batch").iterdir()))
        if len(runs) < 3:
            folder.result.mkdir(parents=True)
            raise OSError(28, "No space left on device")
        return writes(unit, folder)

    assert work.Worker(asked, perform=full).run() == {"done": 1}
    assert [len(there) for there in runs] == [1, 1, 1]
    assert not list((tmp_path / "scratch/mudg_batch").iterdir())
