"""Kills and full disks at every point of every verb: the repeated command ends in the result of an undisturbed run, to
the bit."""

from __future__ import annotations

import contextlib
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
from faults import Act, contents, counted, every, failing, in_child, killed, sweep, terminated
from test_nothing_is_lost import STEPS, call, world  # noqa: F401
from toy_clips import tiny, write_clips

from mudg import app
from mudg.base import store
from mudg.base.errors import UsageError
from mudg.base.run_folder import Replacement, RunDir, VerbOutput
from mudg.steps.synthesize import Learn

OUTPUT = VerbOutput("small", 1, ("*.txt", "rows/*.txt"))
SWEPT = [name for name in STEPS if name not in ("learn", "film")]
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


EVERY = pytest.mark.parametrize("step", [5, pytest.param(1, marks=pytest.mark.slow)])
"""Sweep over every fifth point, in the slow set over all."""


def broken(number: int) -> Act:
    """The disk fails from the operation of this number on."""
    return failing(number, errno.EIO)


# ---- the store and the run folder ----------------------------------------------------------------


@EVERY
@pytest.mark.parametrize("stop", [killed, failing, pytest.param(broken, marks=pytest.mark.slow)])
def test_a_small_run_stopped_at_every_point_is_repeated_to_the_same_bytes(
    tmp_path: Path, stop: Callable[[int], Act], step: int
) -> None:
    """Killed; or the disk is full, or broken, which is said."""
    whole, ends = contents(small_run(tmp_path / "whole")), list[Any]()
    for place, end, name in sweep(lambda place: small_run(place / "out"), tmp_path, stop, every(step)):
        small_run(place / "out")
        assert contents(place / "out") == whole, name
        ends.append(end)
    assert len(ends) > 20 / step
    if stop is not killed:
        said = [str(end) for end in ends if isinstance(end, Exception)]
        words = os.strerror(errno.ENOSPC if stop is failing else errno.EIO)
        assert len(said) > 15 / step and all(words in one for one in said)


@EVERY
def test_a_replacement_killed_at_every_point_is_never_lost(tmp_path: Path, step: int) -> None:
    """Old or new, whole, is there at any moment; somebody else's file always is; the repeated command ends in the new
    one, and that for the old one finds it, or is refused."""
    new = contents(small_run(tmp_path / "whole", 2)) | {"mine.md": b"mine"}

    def old(place: Path) -> None:
        small_run(place / "out", 1)
        (place / "out" / "mine.md").write_text("mine")

    def chosen(operations: list[str]) -> list[int]:
        exchange = (n for n, name in enumerate(operations, 1) if name.startswith(("rename", "rmdir")))
        return sorted({*range(1, len(operations) + 1, step), *exchange})

    replace = lambda place: small_run(place / "out", 2, overwrite=True)
    for place, _, name in sweep(replace, tmp_path, killed, chosen, old):
        places = (place / "out", Replacement(place / "out").retired)
        standing = [folder for folder in places if (folder / "manifest.json").is_file()]
        assert standing, f"nothing whole after a kill at {name}"
        store.verify_manifest(standing[0])
        again = shutil.copytree(place, tmp_path / "again")
        with contextlib.suppress(UsageError):
            assert contents(small_run(again / "out", 1))["out.txt"] == b"1", name
        assert [path.read_text() for path in again.rglob("mine.md*")] == ["mine"], name
        shutil.rmtree(again)
        replace(place)
        assert contents(place / "out") == new, name


# ---- every verb ----------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("stop", [killed, terminated, failing])
@pytest.mark.parametrize("name", SWEPT)
def test_a_verb_stopped_at_any_point_is_repeated_to_the_same_bytes(
    name: str, stop: Callable[[int], Act], world: dict[str, Path], tmp_path: Path
) -> None:
    """Equal to the bit, but for what shows how a run went."""

    def work(place: Path) -> None:
        with app._sigterm_interrupts():
            call(name, world, place / "out")

    def some(operations: list[str]) -> list[int]:
        count = min(len(operations), POINTS if stop is not failing else 8)
        return sorted(random.Random(name).sample(range(1, len(operations) + 1), count))

    def made(place: Path) -> dict[str, bytes]:
        return {n: c for n, c in contents(place / "out").items() if Path(n).name not in ("state.json", "manifest.json")}

    work(tmp_path)
    for place, end, at in sweep(work, tmp_path, stop, some):
        assert not isinstance(end, Exception) or "No space left" in str(end), at
        work(place)
        found, wanted = made(place), made(tmp_path)
        assert found.keys() == wanted.keys(), at
        assert [n for n in found if found[n] != wanted[n]] == [], at


# ---- training ------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("stop", [killed, terminated])
def test_a_training_stopped_at_every_point_is_repeated_to_the_same_bytes(
    stop: Callable[[int], Act], tmp_path: Path
) -> None:
    """Killed, and asked to stop: the repeated command ends in the weights and scores of an undisturbed training, to the
    bit."""
    clips = write_clips(tmp_path.resolve() / "clips")

    def training(place: Path) -> None:
        """``mudg learn`` in a moment: codec, steps, checkpoints, scores, model; stops on SIGTERM as the command
        does."""
        with app._sigterm_interrupts():
            Learn(out=place / "out", settings=tiny(clips)).run()

    def learned(out: Path) -> dict[str, bytes]:
        """What it leaves, without its history: earlier checkpoints, of which being asked to stop makes one more, and
        how it went."""
        last, made = max((out / "steps").glob("step_*")).name, contents(out)
        made.pop("manifest.json")
        return {n: c for n, c in made.items() if not n.startswith("steps/") or n.startswith(f"steps/{last}/")}

    training(tmp_path)
    whole = learned(tmp_path / "out")
    for place, _, at in sweep(training, tmp_path.resolve(), stop, every(1)):
        training(place)
        found = learned(place / "out")
        assert found.keys() == whole.keys(), at
        assert [name for name in found if found[name] != whole[name]] == [], at
        store.verify_manifest(place / "out")
        assert not list(place.rglob(".tmp*")), at


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
    total = len(counted(lambda place: small_run(place / "out"), tmp_path / "x"))
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
