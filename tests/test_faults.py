"""Kills and full disks at every point of every verb: the repeated command ends in the result of an undisturbed run, to
the bit."""

from __future__ import annotations

import errno
import os
import random
import shutil
import tempfile
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from faults import contents, failing, in_child, killed, points, terminated
from test_nothing_is_lost import VERBS, call, world  # noqa: F401
from toy_clips import tiny, write_clips

from mudg import app
from mudg.base import store
from mudg.base.errors import ResourceError
from mudg.base.run_folder import Replacement, RunDir, VerbOutput
from mudg.steps.synthesize import Learn

OUTPUT = VerbOutput("small", 1, ("*.txt", "rows/*.txt"))
SWEPT = [name for name in VERBS if name not in ("learn", "bench", "film")]
"""Verbs that do their work in this process; ``learn`` has its own sweep below, the others write through the same
store."""
POINTS = int(os.environ.get("MUDG_TEST_POINTS", "24"))
"""At how many operations of each verb it is stopped; a number above all of them means at every one."""


def small_run(out: Path, value: int = 1, *, overwrite: bool = False) -> Path:
    """A verb in small: files, a log, sub-folders; it continues where it stopped."""
    run = RunDir.open(out, OUTPUT, {"value": value}, {}, overwrite)
    if run.complete:
        return run.reused()
    for number in range(3):
        path = run.path / "rows" / f"{number}.txt"
        if not path.exists():
            store.write_text(path, f"{value} {number}")
        run.log(step=number)
    store.write_text(run.path / "out.txt", f"{value}")
    run.finish()
    return run.out


def counted(work: Callable[[], Any], root: Path) -> list[str]:
    root.mkdir(exist_ok=True)
    with points(lambda *_: None, root) as found:
        work()
    return found


def leftovers(folder: Path) -> list[str]:
    """What no finished run leaves beside its result."""
    return [path.name for path in folder.iterdir() if ".part" in path.name]


# ---- the store and the run folder ----------------------------------------------------------------


EVERY = pytest.mark.parametrize("step", [5, pytest.param(1, marks=pytest.mark.slow)])
"""Sweep over every fifth point, in the slow set over all."""


@EVERY
def test_a_small_run_killed_at_every_point_is_repeated_to_the_same_bytes(tmp_path: Path, step: int) -> None:
    whole = contents(small_run(tmp_path / "whole"))
    total = len(counted(lambda: small_run(tmp_path / "x" / "counted"), tmp_path / "x"))
    assert total > 20
    for number in range(1, total + 1, step):
        place = tmp_path / f"kill{number}"
        place.mkdir()
        assert in_child(lambda place=place: small_run(place / "out"), killed(number), place) == -9
        small_run(place / "out")
        assert contents(place / "out") == whole, f"after a kill at point {number}"
        assert not leftovers(place)
        shutil.rmtree(place)


@EVERY
def test_a_replacement_killed_at_every_point_is_never_lost(tmp_path: Path, step: int) -> None:
    """Old or new, whole, is there at any moment; somebody else's file always is; the repeated command ends in the new
    one."""
    new = contents(small_run(tmp_path / "whole", 2)) | {"mine.md": b"mine"}

    def replaced(place: Path) -> Path:
        small_run(place / "out", 1)
        (place / "out" / "mine.md").write_text("mine")
        return place

    probe = replaced(tmp_path / "probe")
    total = len(counted(lambda: small_run(probe / "out", 2, overwrite=True), probe))
    for number in range(1, total + 1, step):
        place = replaced(tmp_path / f"kill{number}")
        assert in_child(lambda place=place: small_run(place / "out", 2, overwrite=True), killed(number), place) == -9
        places = (place / "out", Replacement(place / "out").retired)
        standing = [folder for folder in places if (folder / "manifest.json").is_file()]
        assert standing, f"nothing whole after a kill at point {number}"
        store.verify_manifest(standing[0])
        small_run(place / "out", 2, overwrite=True)
        assert contents(place / "out") == new, f"after a kill at point {number}"
        assert not leftovers(place)


@EVERY
@pytest.mark.parametrize("code", [errno.ENOSPC, pytest.param(errno.EIO, marks=pytest.mark.slow)])
def test_a_full_or_broken_disk_at_every_write_leaves_what_resumes(tmp_path: Path, code: int, step: int) -> None:
    whole = contents(small_run(tmp_path / "whole"))
    total = len(counted(lambda: small_run(tmp_path / "x" / "counted"), tmp_path / "x"))
    said: list[str] = []
    for number in range(1, total + 1, step):
        place = tmp_path / f"full{number}"
        place.mkdir()
        try:
            with points(failing(number, code), place):
                small_run(place / "out")
        except (ResourceError, OSError) as error:
            said.append(str(error))
        small_run(place / "out")
        assert contents(place / "out") == whole, f"after a failure at point {number}"
        assert not leftovers(place)
    assert len(said) > 15 / step and all(os.strerror(code) in words for words in said)


# ---- every verb ----------------------------------------------------------------------------------


def same_result(out: Path, whole: Path) -> None:
    """Equal to the bit, but for what shows how a run went."""
    found, wanted = (
        {n: c for n, c in contents(folder).items() if Path(n).name != "state.json"} for folder in (out, whole)
    )
    assert found.keys() == wanted.keys()
    assert [n for n in found if found[n] != wanted[n] and n != "manifest.json"] == []


@pytest.mark.slow
@pytest.mark.parametrize("stopped", [killed, terminated])
@pytest.mark.parametrize("name", SWEPT)
def test_a_verb_stopped_at_any_point_is_repeated_to_the_same_bytes(
    name: str, stopped: Any, world: dict[str, Path], tmp_path: Path
) -> None:
    def work(out: Path) -> None:
        with app._sigterm_interrupts():
            call(name, world, out, 1, False)

    work(tmp_path / "whole")
    found = counted(lambda: work(tmp_path / "x" / "counted"), tmp_path / "x")
    chosen = sorted(random.Random(name).sample(range(1, len(found) + 1), min(len(found), POINTS)))
    for number in chosen:
        place = tmp_path / f"stop{number}"
        place.mkdir()
        status = in_child(lambda place=place: work(place / "out"), stopped(number), place)
        told = f"status {status} at {found[number - 1]}"
        assert status == -9 if stopped is killed else status in (0, 1), told  # asked at the very end, it finishes
        work(place / "out")
        same_result(place / "out", tmp_path / "whole")
        assert not leftovers(place), found[number - 1]
        shutil.rmtree(place)


@pytest.mark.slow
@pytest.mark.parametrize("name", SWEPT)
def test_a_verb_on_a_full_disk_resumes_when_there_is_space(name: str, world: dict[str, Path], tmp_path: Path) -> None:
    call(name, world, tmp_path / "whole", 1, False)
    found = counted(lambda: call(name, world, tmp_path / "x" / "counted", 1, False), tmp_path / "x")
    said: list[str] = []
    for number in sorted(random.Random(name).sample(range(1, len(found) + 1), min(len(found), 8))):
        place = tmp_path / f"full{number}"
        place.mkdir()
        try:
            with points(failing(number), place):
                call(name, world, place / "out", 1, False)
        except (ResourceError, OSError) as error:
            said.append(str(error))
        call(name, world, place / "out", 1, False)
        same_result(place / "out", tmp_path / "whole")
    assert all("No space left" in words for words in said)


# ---- training ------------------------------------------------------------------------------------


def small_training(clips: Path, out: Path) -> Path:
    """``mudg learn`` in a moment: codec, steps, checkpoints, scores, model; stops on SIGTERM as the command does."""
    with app._sigterm_interrupts():
        return Learn(out=out, settings=tiny(clips)).run()


@pytest.fixture(scope="module")
def training(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, bytes], int]:
    """Clips; the weights, scores and last checkpoint of an undisturbed training on them; the number of its operations
    on the disk."""
    root = tmp_path_factory.mktemp("training").resolve()
    write_clips(root / "clips")
    total = len(counted(lambda: small_training(root / "clips", root / "x" / "out"), root / "x"))
    assert total > 20
    return root / "clips", learned(root / "x" / "out"), total


def learned(out: Path) -> dict[str, bytes]:
    """What a training leaves, without its history: earlier checkpoints, of which being asked to stop makes one more,
    and how it went."""
    last = max((out / "steps").glob("step_*")).name
    return {
        name: content
        for name, content in contents(out).items()
        if name != "manifest.json" and (not name.startswith("steps/") or name.startswith(f"steps/{last}/"))
    }


@pytest.mark.slow
@pytest.mark.parametrize("stopped", [killed, terminated])
def test_a_training_stopped_at_every_point_is_repeated_to_the_same_bytes(
    stopped: Any, training: tuple[Path, dict[str, bytes], int], tmp_path: Path
) -> None:
    """Killed, and asked to stop: the repeated command ends in the weights and scores of an undisturbed training, to the
    bit."""
    clips, whole, total = training
    for number in range(1, total + 1):
        place = tmp_path / f"stop{number}"
        place.mkdir()
        status = in_child(lambda place=place: small_training(clips, place / "out"), stopped(number), place)
        told = f"status {status} at {number}"
        assert status == -9 if stopped is killed else status in (0, 1), told  # asked at the very end, it finishes
        small_training(clips, place / "out")
        found = learned(place / "out")
        assert found.keys() == whole.keys(), number
        assert [name for name in found if found[name] != whole[name]] == [], number
        store.verify_manifest(place / "out")
        assert not [p for p in place.rglob("*") if ".part" in p.name or p.name.startswith(".tmp")], number
        shutil.rmtree(place)


# ---- soak ----------------------------------------------------------------------------------------


def open_files() -> set[str]:
    """What this process holds open."""
    folder, found = Path("/proc/self/fd"), set()
    for one in list(folder.iterdir()) if folder.is_dir() else []:
        try:
            found.add(os.readlink(one))
        except OSError:
            continue
    return found


def children() -> list[str]:
    listed = Path(f"/proc/self/task/{threading.get_native_id()}/children")
    return listed.read_text().split() if listed.is_file() else []


@pytest.mark.slow
def test_two_hundred_runs_with_kills_leak_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    scratch = tmp_path / "tmp"
    scratch.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(scratch))
    rng = random.Random(18)
    total = len(counted(lambda: small_run(tmp_path / "x" / "counted"), tmp_path / "x"))
    whole = {value: contents(small_run(tmp_path / f"whole{value}", value)) for value in (1, 2)}
    files, threads, processes = open_files(), threading.active_count(), children()
    place = tmp_path / "soak"
    place.mkdir()
    value = 1
    for _ in range(200):
        value = rng.choice((1, 2))
        if rng.random() < 0.6:
            stop = killed(rng.randint(1, 2 * total))
            in_child(lambda value=value: small_run(place / "out", value, overwrite=True), stop, place)
        else:
            small_run(place / "out", value, overwrite=True)
            assert contents(place / "out") == whole[value]
            assert not (place / "out" / "lock").exists()
    small_run(place / "out", 3 - value, overwrite=True)
    small_run(place / "out", value, overwrite=True)
    assert contents(place / "out") == whole[value]
    assert sorted(os.listdir(place)) == ["out"]
    assert os.listdir(scratch) == []
    assert threading.active_count() == threads and children() == processes
    assert {f for f in open_files() if str(tmp_path) in f} <= files
