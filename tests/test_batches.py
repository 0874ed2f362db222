"""Batches: keys, steps that are killed, stopped and tried again, who drives, retry, status, and the command line."""

from __future__ import annotations

import json
import os
import shutil
import signal
import socket
import subprocess
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable, Mapping
from pathlib import Path

import pytest

from mudg import app
from mudg.base.errors import InputError, ResourceError, UsageError
from mudg.fleet import engines, work
from mudg.fleet import records as status
from mudg.fleet.engines import LocalRun
from mudg.fleet.plan import Entry, parse_shard, plan_of, read_list, shard_of
from mudg.fleet.records import BatchFolder, Ended, this_host
from mudg.fleet.settings import BatchConfig
from mudg.fleet.work import Job, Stop, last_words, run_step
from mudg.steps import batching
from mudg.steps.run import stage_lines
from mudg.steps.settings import RunConfig

STEP = """
# step.sh NAME OUT TALLY: a line per run; then what is in TALLY/NAME.do, or a small result
echo run >> "$3/$1.runs"
[ -f "$3/$1.do" ] && . "$3/$1.do"
mkdir -p "$2" && echo "result of $1" > "$2/x.txt"
"""

LINES = stage_lines()


class Scenes:
    """A list of scenes, a step, and what is to happen to single ones."""

    def __init__(self, folder: Path, count: int = 3, step: str = STEP) -> None:
        self.folder, self.tally = folder, folder / "tally"
        self.tally.mkdir(parents=True, exist_ok=True)
        (folder / "step.sh").write_text(step)
        self.entries = [Entry(f"s{number}", f"/logs/{number}") for number in range(count)]
        self.command = ("sh", str(folder / "step.sh"), "{name}", "{out}", str(self.tally))
        self.plan = plan_of((), {}, {}, self.command)
        self.batch = BatchFolder(folder / "out")
        (folder / "list.txt").write_text("".join(f"city name={entry.name}\n" for entry in self.entries))

    def does(self, name: str, script: str) -> None:
        (self.tally / f"{name}.do").write_text(script)

    def run(self, jobs: int = 1, threads: int = 1) -> dict[str, int]:
        """Run what is missing; how many steps ended how."""
        self.batch.begin(self.plan, self.entries)
        reports: list[Ended] = []
        job = Job(self.batch, self.plan, threads, grace_s=5.0)
        done, failed = self.batch.keys("done"), self.batch.keys("failed")
        entries = [entry for entry in self.entries if work.is_open(self.plan, entry, done, failed)]
        LocalRun(job, entries, jobs, Stop(5.0)).run(reports.append)
        return dict(Counter(report.state for report in reports))

    def runs(self) -> dict[str, int]:
        return {path.stem: len(path.read_text().splitlines()) for path in sorted(self.tally.glob("*.runs"))}

    def digests(self) -> dict[str, str]:
        return {one.scene: one.digest for one in self.batch.records("done")}

    def words(self, *more: str) -> list[str]:
        first = f"batch run --list {self.folder}/list.txt --out {self.batch.out} --quiet".split()
        return [*first, *more, "--command", *self.command]

    def start(self, *more: str, **environment: str) -> subprocess.Popen[bytes]:
        command = [sys.executable, "-m", "mudg", *self.words(*more)]
        return subprocess.Popen(command, env={**os.environ, **environment})


@pytest.fixture(autouse=True)
def _no_pauses(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(work, "WAITS_S", {code: (0.0,) * len(waits) for code, waits in work.WAITS_S.items()})
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))  # turns of this test alone


def wait_for(condition: Callable[[], object], seconds: float = 60.0) -> None:
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "it did not happen"
        time.sleep(0.02)


# ---- keys and lists ------------------------------------------------------------------------------


def test_a_key_depends_on_log_settings_and_what_is_read() -> None:
    settings = {"ingest": {"frames": "", "device": "auto"}, "fuse": {"voxel_m": 0.0}}
    plan = plan_of(("ingest", "fuse"), LINES, settings)
    first, second = plan.units(Entry("a", "/logs/a"))
    assert second.needs == {"ingest": first.place}
    assert [unit.key for unit in plan.units(Entry("a", "/logs/a"))] == [first.key, second.key]
    other = plan_of(("ingest", "fuse"), LINES, {**settings, "ingest": {"frames": "0:5"}})
    assert {unit.key for unit in other.units(Entry("a", "/logs/a"))}.isdisjoint({first.key, second.key})
    device = plan_of(("ingest", "fuse"), LINES, {**settings, "ingest": {"frames": "", "device": "cuda"}})
    assert next(iter(device.units(Entry("a", "/logs/a")))).key == first.key
    for changed in (("/logs/b", {}), ("/logs/a", {"frames": "0:3"})):
        assert next(iter(plan.units(Entry("a", *changed)))).key != first.key


def test_steps_need_what_they_read() -> None:
    values = {name: {} for name in ("ingest", "annotate", "fuse", "fit", "render", "synthesize", "score")}
    plan = plan_of(("ingest", "annotate", "fuse", "fit", "render", "score"), LINES, values)
    assert {stage.name: stage.needs for stage in plan.stages} == {
        "ingest": (),
        "annotate": ("ingest",),
        "fuse": ("annotate",),
        "fit": ("annotate", "fuse"),
        "render": ("annotate", "fit"),
        "score": ("annotate", "fuse", "render"),
    }
    assert plan_of(("fuse",), LINES, values).stages[0].words == ("fuse", "{source}")
    for names in (("fit",), ("ingest", "ingest"), ("nothing",), ()):
        with pytest.raises(UsageError):
            plan_of(names, LINES, values)
    with pytest.raises(UsageError, match="where to write"):
        plan_of((), {}, {}, ("program",))


def test_settings_of_a_line_are_those_of_ingest_also_in_the_chain() -> None:
    values = {"ingest": {}, "fuse": {}}
    entry = Entry("a", "city", {"frames": "0:5", "cameras": "front,left", "seed": "7"})
    ingest, fuse = plan_of(("ingest", "fuse"), LINES, values).units(entry)
    (chain,) = plan_of(("run",), LINES, values).units(entry)
    places = {"source": "city", "ingest": "i"}
    flags = {unit.stage.name: unit.command(places, "o", "") for unit in (ingest, fuse, chain)}
    assert flags["ingest"][-5:] == ["--frames=0:5", "--cameras", "front", "left", "--city.seed=7"]
    assert flags["run"][-5:] == ["--ingest.frames=0:5", "--ingest.cameras", "front", "left", "--ingest.city.seed=7"]
    assert flags["fuse"][-1] == "--quiet"
    for words in flags.values():
        app.parse(words[3:])


def test_a_list_names_sources_folders_and_settings(tmp_path: Path) -> None:
    drives = "a/drive_1\n'b/drive 2' name=two sequence=07\n/abs/drive_3.zip   # comment\ncity name=c\n"
    (tmp_path / "list.txt").write_text(f"# drives\n\n{drives}")
    entries = read_list(tmp_path / "list.txt", ("sequence",))
    assert [(e.name, e.source, dict(e.settings)) for e in entries] == [
        ("drive_1", str(tmp_path / "a/drive_1"), {}),
        ("two", str(tmp_path / "b/drive 2"), {"sequence": "07"}),
        ("drive_3.zip", "/abs/drive_3.zip", {}),
        ("c", "city", {}),
    ]
    for name in ("b", "a.tfrecord", "_batch", ".hidden", "status.yaml"):  # what a batch wrote there is no log
        (tmp_path / "logs" / name).mkdir(parents=True)
    named = [Path(entry.source).name for entry in read_list(tmp_path / "logs")]
    assert named == ["a.tfrecord", "b", "status.yaml"]


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("s3://bucket/a\n", "works on folders"),
        ("# nothing\n", "list is empty"),
        ("a/x\nb/x\n", "the same folder"),
        ("a b\n", "unknown setting"),
        ("a speed=3\n", "unknown setting"),
        ("'a\n", "cannot parse the line"),
        ("a name=../up\n", "folder name"),
    ],
)
def test_bad_lists_are_refused_with_their_line(tmp_path: Path, text: str, words: str) -> None:
    (tmp_path / "list.txt").write_text(text)
    with pytest.raises((InputError, UsageError), match=words):
        read_list(tmp_path / "list.txt")


@pytest.mark.parametrize(
    ("text", "environment", "wanted"),
    [
        ("", {}, (0, 1)),
        ("2/5", {"JOB_COMPLETION_INDEX": "0"}, (2, 5)),
        ("env", {"SLURM_ARRAY_TASK_ID": "3", "SLURM_ARRAY_TASK_COUNT": "8"}, (3, 8)),
        ("env", {"SLURM_ARRAY_TASK_ID": "3", "SLURM_ARRAY_TASK_COUNT": "8", "SLURM_ARRAY_TASK_MIN": "1"}, (2, 8)),
        ("env/5", {"JOB_COMPLETION_INDEX": "0"}, (0, 5)),
        ("env", {"SKYPILOT_NODE_RANK": "1", "SKYPILOT_NUM_NODES": "4"}, (1, 4)),
        ("env", {"AWS_BATCH_JOB_ARRAY_INDEX": "7", "AWS_BATCH_JOB_ARRAY_SIZE": "9"}, (7, 9)),
    ],
)
def test_schedulers_number_the_shards(text: str, environment: Mapping[str, str], wanted: tuple[int, int]) -> None:
    assert parse_shard(text, environment) == wanted


@pytest.mark.parametrize("text", ["5/5", "1", "a/b", "-1/3", "1/0", "env", "env/5", "env/7"])
def test_what_is_no_shard_is_refused(text: str) -> None:
    for environment in ({}, {"JOB_COMPLETION_INDEX": "7"}, {"JOB_COMPLETION_INDEX": "x"}):
        with pytest.raises(UsageError, match="shard|numbered"):
            parse_shard(text, environment)
    parts = Counter(shard_of(str(number), 3) for number in range(60))
    assert set(parts) == {0, 1, 2} and min(parts.values()) >= 10


# ---- scenes --------------------------------------------------------------------------------------


def test_a_second_run_does_nothing_and_any_order_gives_the_same(tmp_path: Path) -> None:
    one, other = Scenes(tmp_path / "a", 6), Scenes(tmp_path / "b", 6)
    assert one.run(jobs=3) == {"done": 6} and one.run() == {}
    other.entries.reverse()
    assert other.run() == {"done": 6} and one.digests() == other.digests() and set(one.runs().values()) == {1}
    assert not list((tmp_path / "a/out/_batch/work").iterdir())
    (record,) = (one for one in one.batch.records("done") if one.scene == "s3")
    assert (tmp_path / "a/out" / record.place / "x.txt").read_text() == "result of s3\n"


def test_an_output_of_another_batch_or_of_something_else_is_refused(tmp_path: Path) -> None:
    made = Scenes(tmp_path)
    made.run()
    with pytest.raises(UsageError, match="other steps"):
        made.batch.begin(plan_of((), {}, {}, (*made.command, "--more")), made.entries)
    made.batch.begin(made.plan, [*made.entries, Entry("more", "/logs/more")])  # a longer list is the same batch
    assert made.batch.scenes() == ["more", "s0", "s1", "s2"]
    (tmp_path / "b").mkdir()
    (tmp_path / "b/photo.jpg").write_text("")
    with pytest.raises(UsageError, match="something else"):
        BatchFolder(tmp_path / "b").begin(made.plan, made.entries)


@pytest.mark.parametrize(("code", "tries"), [(1, 1), (2, 1), (3, 1), (4, 2), (5, 3), (6, 1), (134, 2), (143, 3)])
def test_exit_codes_decide_how_often_a_step_is_tried(
    tmp_path: Path, code: int, tries: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Stop, "sleep", lambda *_: None)
    made = Scenes(tmp_path, 2)
    made.does("s0", f"echo 'error: it broke' >&2; mkdir -p $2; echo x >> $2/left; exit {code}")
    assert made.run() == {"failed": 1, "done": 1} and made.runs() == {"s0": tries, "s1": 1}
    (record,) = made.batch.records("failed")
    assert (record.code, record.words, record.scene) == (code, "it broke", "s0")
    assert made.batch.log(record.key).read_bytes() == b"error: it broke\n"
    made.does("s0", "")
    assert made.run() == {}, "what has failed stays so"
    assert batching.retry(str(made.batch.out), str(code))["forgotten"] == 1 and made.run() == {"done": 1}
    (path,) = (tmp_path / "out/s0/command").iterdir()
    assert [file.name for file in path.iterdir()] == ["x.txt"], "nothing is left of the failure"


def test_what_a_killed_driver_left_is_gone_on_with(tmp_path: Path) -> None:
    made = Scenes(tmp_path, 1)
    (unit,) = made.plan.units(made.entries[0])
    left = tmp_path / "out/_batch/work" / f"{unit.key}.77-1/result"
    left.mkdir(parents=True)
    (left / "checkpoint").write_text("half")
    (left / "lock").write_text("{}")
    made.does("s0", "[ -f $2/lock ] && exit 3; mv $2/checkpoint $2/seen")
    assert made.run() == {"done": 1}
    (result,) = (tmp_path / "out/s0/command").iterdir()
    assert (result / "seen").read_text() == "half" and not list((tmp_path / "out/_batch/work").iterdir())


def test_a_result_without_a_record_is_taken_as_it_is(tmp_path: Path) -> None:
    """A driver that was cut off between publishing and recording."""
    made = Scenes(tmp_path, 1)
    made.run()
    before, (record,) = made.digests(), (tmp_path / "out/_batch/done").iterdir()
    record.unlink()
    assert made.run() == {"done": 1} and made.digests() == before and made.runs() == {"s0": 1}


def test_a_slow_attempt_that_another_took_over_publishes_nothing(tmp_path: Path) -> None:
    """As on a node that only seemed to be lost: the other attempt took its folder, and its result stays."""
    made, other = Scenes(tmp_path, 1), Scenes(tmp_path, 1)
    made.does("s0", f"touch {tmp_path}/up; while [ ! -f {tmp_path}/go ]; do sleep 0.05; done")
    slow = threading.Thread(target=made.run)
    slow.start()
    wait_for((tmp_path / "up").exists)
    made.does("s0", "")
    assert other.run() == {"done": 1}
    before = other.digests()
    (tmp_path / "go").touch()
    slow.join(30)
    assert other.digests() == before and len(list((tmp_path / "out/s0/command").iterdir())) == 1


def test_a_killed_step_is_tried_again_alone_and_with_less(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Stop, "sleep", lambda *_: None)
    made, order = Scenes(tmp_path, 2), tmp_path / "order"
    both = f"while [ ! -f {tmp_path}/tally/s0.runs ] || [ ! -f {tmp_path}/tally/s1.runs ]; do sleep 0.02; done"
    first = f"[ $MUDG_THREADS -gt 1 ] && {{ {both}; kill -9 $$; }}"
    made.does("s0", f"{first}; echo a >> {order}; sleep 0.3; echo a >> {order}")
    made.does("s1", f"{both}; sleep 0.5; echo b >> {order}")
    assert made.run(jobs=2, threads=4) == {"done": 2} and made.runs() == {"s0": 2, "s1": 1}
    assert "".join(order.read_text().split()) == "baa", "the second try waited for the other step"
    made.entries.append(Entry("s2", "/logs/2"))
    made.does("s2", "kill -9 $$")
    assert made.run(threads=4) == {"failed": 1} and "also alone" in next(made.batch.records("failed")).words
    made.entries.append(Entry("s3", "/logs/3"))
    made.does("s3", "exit 0")
    made.run()
    assert "it ended well but wrote nothing" in {record.words for record in made.batch.records("failed")}
    with pytest.raises(UsageError, match="no such program"):
        run_step(["/no/such/program", "mudg"], tmp_path, 1, Stop())


# ---- drivers -------------------------------------------------------------------------------------


def test_two_drivers_on_one_output_are_refused(tmp_path: Path) -> None:
    folder = BatchFolder(tmp_path)
    child = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(60)"])
    try:
        with folder.owned() as mine:
            mine.write_text(json.dumps(json.loads(mine.read_text()) | {"process": child.pid}))
        for shard in ((0, 1), (1, 3)):
            with pytest.raises(UsageError, match="another driver works"), folder.owned(shard):
                pass
    finally:
        child.kill()
        child.wait()
    with folder.owned():  # dead, on this machine
        pass
    assert not list((tmp_path / "_batch").iterdir())


def test_shards_have_drivers_of_their_own(tmp_path: Path) -> None:
    folder, elsewhere = BatchFolder(tmp_path), {"host": "elsewhere", "process": 1, "since": 1.0}
    (tmp_path / "_batch").mkdir()
    (tmp_path / "_batch/owner-1-of-3.json").write_text(json.dumps({**elsewhere, "shard": [1, 3]}))
    with folder.owned((0, 3)):
        assert len(folder.owners()) == 2
    for refused in ((1, 3), (0, 1), (0, 2)):
        with pytest.raises(UsageError, match="another machine may still") as caught, folder.owned(refused):
            pass
        assert "--take-over" in caught.value.remedy
    with folder.owned((1, 3), numbered=True):  # the scheduler runs every number once
        assert next(iter(folder.owners().values())).host == this_host()
    (tmp_path / "_batch/owner.json").write_text(json.dumps(elsewhere))
    with folder.owned(take_over=True):
        assert [one.host.split()[0] for one in folder.owners().values()] == [socket.gethostname()]


# ---- status --------------------------------------------------------------------------------------


def test_status_counts_groups_and_forecasts(tmp_path: Path) -> None:
    made = Scenes(tmp_path, 6)
    for name in ("s0", "s1"):
        made.does(name, f"echo 'error: it is cut off' >&2; echo '  where: {name}' >&2; exit 3")
    made.run()
    for record in (tmp_path / "out/_batch/done").iterdir():
        record.write_text(json.dumps(json.loads(record.read_text()) | {"processor_s": 900.0, "lost_s": 900.0}))
    state = json.loads(json.dumps(status.read_status(made.batch)))
    command = state["stages"]["command"]
    assert (command["done"], command["failed"], state["finished"], state["left"]) == (4, 2, 4, 0)
    assert state["reasons"] == [{"reason": "3 bad input: it is cut off", "steps": 2, "example": "s0 command"}]
    for failed in made.batch.keys("failed"):
        made.batch.record("failed", failed).unlink()
    made.batch.begin(made.plan, [*made.entries, Entry("more", "/logs/more")])
    state = status.read_status(made.batch)
    command = state["stages"]["command"]
    assert (state["left"], command["core_hours"], command["core_hours_left"]) == (3, 2.0, 1.5)
    assert "1.500" in status.text_of(state)


# ---- processes -----------------------------------------------------------------------------------

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


def start(made: Scenes) -> subprocess.Popen[bytes]:
    made.command = (sys.executable, str(made.folder / "step.py"), "{out}", str(made.folder / "up"))
    (made.folder / "step.py").write_text(CHECKPOINTS)
    process = made.start("--jobs", "1")
    wait_for((made.folder / "up").exists)
    return process


def test_sigterm_leads_to_a_checkpoint_and_the_same_command_goes_on(tmp_path: Path) -> None:
    made = Scenes(tmp_path, 1)
    process = start(made)
    process.send_signal(signal.SIGTERM)
    assert process.wait(30) == 143
    assert not list((tmp_path / "out/_batch").glob("owner*")) and not (tmp_path / "out/_batch/failed").exists()
    (tmp_path / "up").unlink()
    assert app.main(made.words("--jobs", "1")) == 0
    assert not (tmp_path / "up").exists(), "it began from nothing"
    (record,) = made.batch.records("done")
    assert (tmp_path / "out" / record.place / "whole").is_file()


@pytest.mark.skipif(shutil.which("setpriv") is None, reason="no setpriv")
def test_a_killed_driver_leaves_no_orphan_and_is_taken_over(tmp_path: Path) -> None:
    made = Scenes(tmp_path, 1)
    process = start(made)
    wait_for(lambda: (tmp_path / "up").read_text())
    child = int((tmp_path / "up").read_text())
    process.kill()
    process.wait()
    state = Path(f"/proc/{child}/status")
    wait_for(lambda: not state.exists() or "State:\tZ" in state.read_text(), 10)
    (work_dir,) = (tmp_path / "out/_batch/work").iterdir()
    (work_dir / "result/half").write_text("half")
    assert app.main(made.words("--jobs", "1")) == 0


def test_a_slurm_task_stops_for_its_checkpoint(tmp_path: Path) -> None:
    """What submitit calls when the job is about to end."""
    pytest.importorskip("submitit")
    made = Scenes(tmp_path, 2)
    trap = f"trap 'touch {tmp_path}/stopped; exit 143' TERM"
    made.does("s0", f"{trap}; touch {tmp_path}/up; while :; do sleep 0.05; done")
    made.batch.begin(made.plan, made.entries)
    task = engines.SlurmTask(Job(made.batch, made.plan, grace_s=20.0), made.entries)
    answers = []
    thread = threading.Thread(target=lambda: answers.append(task.checkpoint()))

    def announce() -> None:
        wait_for((tmp_path / "up").exists)
        thread.start()

    threading.Thread(target=announce).start()
    handler = signal.getsignal(signal.SIGTERM)
    try:
        assert task() == {"stopped": 1} and (tmp_path / "stopped").exists()
        thread.join()
        made.does("s0", "")
        assert answers[0].function() == {"done": 2}
    finally:
        signal.signal(signal.SIGTERM, handler)


@pytest.mark.parametrize("option", ["array=0-3", "time=1\n#SBATCH --wrap=x", "--partition=gpu", ""])
def test_options_that_are_none_for_slurm_and_a_machine_without_it_are_told(
    option: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("submitit")
    monkeypatch.setenv("PATH", str(tmp_path))
    made = Scenes(tmp_path, 1)
    for options, error, said in (
        ((option, "time=3"), UsageError, "slurm-options"),
        (("partition=gpu",), UsageError, "slurm-options"),
        (("time=3",), ResourceError, "another --engine"),
    ):
        with pytest.raises(error, match=said):
            engines.submit_to_slurm(Job(made.batch, made.plan), made.entries, BatchConfig(slurm_options=options))


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
    assert app.main([*words, "--shard", "3"]) == 2 and app.main([*words, "--shard", "0/3", "--engine", "ray"]) == 2
    assert app.main([*words, "--set", "fit.iterationz=3"]) == 2
    assert app.main([*words[:-1], "s3://bucket/runs"]) == 2
    assert "did you mean fit.iterations" in capsys.readouterr().err
    assert app.main([*words, "--stages", "ingest", "fuse", "--dry-run"]) == 0
    assert "1 scenes: ingest -> fuse" in capsys.readouterr().out and not (tmp_path / "o").exists()


def test_failures_from_the_command_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    made = Scenes(tmp_path, 4)
    made.does("s1", "echo 'error: no camera' >&2; exit 3")
    assert app.main(made.words("--jobs", "2")) == 11
    assert app.main(made.words("--jobs", "2")) == 0, "nothing was left to do"
    capsys.readouterr()
    assert app.main(["batch", "status", str(tmp_path / "out"), "--json"]) == 0
    record = json.loads(capsys.readouterr().out)
    assert record["reasons"] == [{"reason": "3 bad input: no camera", "steps": 1, "example": "s1 command"}]
    assert app.main(["batch", "retry", str(tmp_path / "out"), "--reason", "5"]) == 3
    assert app.main(["batch", "retry", str(tmp_path / "out"), "--reason", "memory"]) == 2
    made.does("s1", "")
    assert app.main(["batch", "retry", str(tmp_path / "out"), "--reason", "5,3"]) == 0
    assert app.main(made.words()) == 0 and made.runs() == {"s0": 1, "s1": 2, "s2": 1, "s3": 1}
    with pytest.raises(InputError, match="no batch"):
        batching.retry(str(tmp_path / "elsewhere"))


def test_paths_in_settings_are_made_absolute(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "models/net").mkdir(parents=True)
    settings = batching.settings_of("default", None, ["annotate.weights=models/net", "fit.iterations=5"])
    assert settings.fit.iterations == 5
    plan = batching.plan_for(BatchConfig(stages=("ingest", "annotate")), settings, LINES)
    assert plan.stages[1].settings["weights"] == str(tmp_path / "models/net")
    assert batching.plan_for(BatchConfig(), RunConfig(), LINES).stages[0].name == "run"


# ---- templates for schedulers --------------------------------------------------------------------

EXAMPLES = Path(__file__).resolve().parents[1] / "docs/examples"


def test_templates_start_a_batch() -> None:
    import yaml

    spec = yaml.safe_load((EXAMPLES / "batch_kubernetes.yaml").read_text())["spec"]
    pod, (container,) = spec["template"]["spec"], spec["template"]["spec"]["containers"]
    parsed, _ = app.parse([*container["command"], *container["args"]][1:])
    assert spec["completionMode"] == "Indexed" and parsed.shard == f"env/{spec['completions']}"
    assert pod["terminationGracePeriodSeconds"] > parsed.settings.grace_s
    rules = [rule["onExitCodes"] for rule in spec["podFailurePolicy"]["rules"] if "onExitCodes" in rule]
    assert {rule["containerName"] for rule in rules} == {container["name"]}
    assert {mount["name"] for mount in container["volumeMounts"]} == {volume["name"] for volume in pod["volumes"]}
