"""Outputs that are one file: described, one writer at a time, verified on reuse."""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from faults import Act, every, failing, killed, sweep
from test_gallery import run_of
from toy_fitted import write_toy_run

from mudg import app
from mudg.base import store
from mudg.base.errors import ResourceError, UsageError
from mudg.base.run_folder import take_lock
from mudg.core.table import Table
from mudg.gaussians.storage import save_model
from mudg.viewer import view
from mudg.viewer.settings import PageConfig


@pytest.fixture(scope="module")
def toy(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("toy").resolve()
    write_toy_run(root, degree=0)
    run_of(root / "run")
    run_of(root / "other_run")
    assert app.main(["export", "ply", str(root / "fit"), "--out", str(root / "van.ply"), "--quiet"]) == 0
    return root


COMMANDS: dict[str, tuple[str, str, str]] = {
    "ply": ("a.ply", "export ply TOY/fit --quiet --out OUT", "--time-s 0.2"),
    "mcap": ("a.mcap", "export mcap TOY/scene --quiet --out OUT", "--overwrite"),
    "asset": ("a.safetensors", "asset export TOY/fit car-1 --quiet --out OUT", "--scene TOY/scene"),
    "import": ("a.safetensors", "asset import TOY/van.ply --quiet --out OUT", "--length-m 4"),
    "page": ("a.html", "page TOY/fit --scene TOY/scene --quiet --out OUT --images 0", "--budget 9"),
    "report": ("a.html", "report --quiet --out OUT TOY/run", "TOY/other_run"),
}
"""Name of the output, a command, and words that make another result of it."""


def command(name: str, toy: Path, more: str = "") -> Callable[[Path], int]:
    """Runs a command that writes to a folder; returns its exit code."""
    out, words, _ = COMMANDS[name]
    line = f"{words} {more}".replace("TOY", str(toy))
    return lambda folder: app.main(line.replace("OUT", str(folder / out)).split())


def pair(out: Path) -> dict[str, bytes]:
    """The file and its description, which must belong together where the file is there."""
    about = out.with_name(f"{out.name}.json")
    if not out.exists():
        return {}
    content = out.read_bytes()
    sha256 = json.loads(about.read_text())["sha256"]
    assert sha256 == hashlib.sha256(content).hexdigest(), "the description is of another file"
    return {out.name: content, about.name: about.read_bytes()}


def folder_of(out: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in out.iterdir()}


@pytest.mark.parametrize("nth", [15, pytest.param(5, marks=pytest.mark.slow)])
@pytest.mark.parametrize(
    ("stop", "name"), [*((killed, name) for name in COMMANDS), *((failing, name) for name in ("ply", "asset", "page"))]
)
def test_a_command_stopped_at_any_moment_and_repeated_ends_in_the_same_pair(
    name: str, nth: int, stop: Callable[[int], Act], toy: Path, tmp_path: Path
) -> None:
    """Killed, or on a full disk."""
    out = COMMANDS[name][0]
    (tmp_path / "whole").mkdir()
    assert command(name, toy)(tmp_path / "whole") == 0
    whole = pair(tmp_path / "whole" / out)
    assert folder_of(tmp_path / "whole") == whole, "nothing else lies there"

    def chosen(operations: list[str]) -> set[int]:
        last = [number for number, what in enumerate(operations, 1) if out in what or "part" in what][-8:]
        return {*range(2, len(operations) + 1, nth), *last[1 :: -(-nth // 5) + 1]}

    for place, end, at in sweep(command(name, toy), tmp_path, stop, lambda found: sorted(chosen(found))):
        assert end in (-9, 0, 5)
        pair(place / out)
        assert command(name, toy)(place) == 0 and folder_of(place) == whole, at


@pytest.mark.parametrize("nth", [7, pytest.param(1, marks=pytest.mark.slow)])
@pytest.mark.parametrize("name", ["ply", "page"])
def test_replacing_killed_at_any_moment_loses_neither(name: str, nth: int, toy: Path, tmp_path: Path) -> None:
    out, _, other = COMMANDS[name]
    for place in (old := tmp_path / "old", new := tmp_path / "new"):
        place.mkdir()
    assert command(name, toy)(old) == 0 and command(name, toy, other)(new) == 0
    before, after = pair(old / out), pair(new / out)
    assert before[out] != after[out]
    replace = command(name, toy, f"{other} --overwrite")
    begun = partial(shutil.copytree, old)
    for place, _, at in sweep(replace, tmp_path, killed, every(nth), begun):
        assert (place / out).read_bytes() in (before[out], after[out]), at
        again = shutil.copytree(place, tmp_path / "again")  # either command finds a whole result, or makes its own
        assert replace(place) == 0 and folder_of(place) == after
        assert command(name, toy)(again) in (0, 2)
        assert (again / out).read_bytes() in (before[out], after[out])
        shutil.rmtree(again)


@pytest.mark.parametrize("name", COMMANDS)
def test_files_of_others_and_altered_ones_are_replaced_on_demand_only(
    name: str, toy: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / COMMANDS[name][0]
    about = out.with_name(f"{out.name}.json")
    assert command(name, toy)(tmp_path) == 0
    whole, stamp = folder_of(tmp_path), out.stat().st_mtime_ns
    if name in ("ply", "asset"):
        assert store.read_json(about)["inputs"] == {"fit": store.digest(toy / "fit")}
    assert command(name, toy)(tmp_path) == 0 and out.stat().st_mtime_ns == stamp
    if (other := COMMANDS[name][2]) != "--overwrite":
        assert command(name, toy, other)(tmp_path) == 2 and "the file exists" in capsys.readouterr().err
        assert folder_of(tmp_path) == whole
    about.unlink()  # nothing says what the file is
    assert command(name, toy)(tmp_path) == 2 and "exists" in capsys.readouterr().err
    about.write_bytes(whole[about.name])
    out.write_bytes(whole[out.name][:-1] + b"?")
    assert command(name, toy)(tmp_path) == 4 and "altered" in capsys.readouterr().err
    about.unlink()
    assert command(name, toy)(tmp_path) == 2 and "exists" in capsys.readouterr().err
    assert out.read_bytes().endswith(b"?") and [path.name for path in tmp_path.iterdir()] == [out.name]
    out.unlink()
    about.write_text('{"mine": 1}')
    assert command(name, toy)(tmp_path) == 2 and about.read_text() == '{"mine": 1}'
    assert command(name, toy, "--overwrite")(tmp_path) == 0 and folder_of(tmp_path) == whole
    out.unlink()
    about.unlink()
    (out / "mine").mkdir(parents=True)
    assert command(name, toy, "--overwrite")(tmp_path) == 5 and (out / "mine").is_dir()


def test_a_large_page_stopped_and_repeated(toy: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(view, "ONE_FILE_BYTES", 1000)
    monkeypatch.setattr(view, "CHUNK", 64)

    def page(folder: Path) -> dict[str, Any]:
        return view.run_page(PageConfig(images=0), toy / "fit", folder / "a.html", scene=toy / "scene")

    def whole_of(page: Path) -> dict[str, bytes]:
        return {path.name: path.read_bytes() for path in page.parent.iterdir()}

    (tmp_path / "x").mkdir()
    made = page(tmp_path / "x")
    assert made["page"] == tmp_path / "x" / "a_page" / "index.html" and page(tmp_path / "x") == made
    quarter = lambda operations: range(1, len(operations) + 1, max(1, len(operations) // 4))
    for place, _, at in sweep(page, tmp_path, killed, quarter):
        assert whole_of(page(place)["page"]) == whole_of(made["page"]), at
        assert {path.name for path in place.iterdir()} == {"a_page", "a.html.json"}
    with monkeypatch.context() as newer:
        newer.setattr(view.pages, "import_map", lambda: "{}")
        with pytest.raises(UsageError, match="other settings"):  # a page of another viewer is no longer this one
            page(tmp_path / "x")
    (made["page"].parent / "index.html").write_text("altered")
    with pytest.raises(Exception, match="altered"):
        page(tmp_path / "x")


# ---- any number of threads -----------------------------------------------------------------------


@pytest.fixture(scope="module")
def crowd(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A fit of 95,003 Gaussians: torch rounds otherwise where a thread's part does not fill a vector."""
    root = tmp_path_factory.mktemp("crowd").resolve()
    scene, _, _, small = write_toy_run(root, degree=0)
    rng = np.random.default_rng(0)
    rows = torch.from_numpy(rng.integers(0, 720, 95_003))
    noise = lambda values: 0.01 * torch.from_numpy(rng.standard_normal(values.shape, np.float32))
    columns = {name: values[rows] + noise(values[rows]) for name, values in small.table.columns.items()}
    some = torch.randn(4096, generator=torch.Generator().manual_seed(0)) * 2
    whole, alone = torch.sigmoid(some), torch.stack([torch.sigmoid(one) for one in some])  # in vectors, and one by one
    odd = some[whole != alone] if (whole != alone).any() else some
    columns["logits"] = odd.repeat(-(-95_003 // len(odd)))[:95_003].clone()
    table = Table(columns, {name: values[rows] for name, values in small.table.labels.items()})
    save_model(replace(small, table=table, nodes=small.nodes[:1]), root / "fit")
    return scene.parent


@pytest.mark.parametrize("name", ["ply", "page"])
def test_any_number_of_threads_writes_the_same_bytes(name: str, crowd: Path, tmp_path: Path) -> None:
    before, made = torch.get_num_threads(), set()
    try:
        for threads in (1, 3):
            torch.set_num_threads(threads)
            (tmp_path / str(threads)).mkdir()
            assert command(name, crowd)(tmp_path / str(threads)) == 0
            made.add((tmp_path / str(threads) / COMMANDS[name][0]).read_bytes())
            assert torch.get_num_threads() == threads
    finally:
        torch.set_num_threads(before)
    assert len(made) == 1


# ---- several at a time ---------------------------------------------------------------------------


def forked(work: Callable[[], int], go: Path) -> int:
    """A process that does the work as soon as a file is there; its exit code is what the work returns."""
    child = os.fork()
    if child:
        return child
    code = 99
    try:
        while not go.exists():
            time.sleep(0.001)
        code = work()
    finally:
        os._exit(code)


def test_two_exports_to_one_file_at_a_time(toy: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Only one of the two writes."""
    out, go, slow, end = tmp_path / "a.ply", *(tmp_path / name for name in ("go", "slow", "end"))
    write = store.atomic_write

    def slowly(path: Path, content: bytes) -> None:
        write(path, content)
        if path.suffix == ".ply":
            slow.touch()
            while not end.exists():
                time.sleep(0.005)

    with monkeypatch.context() as patched:
        patched.setattr(store, "atomic_write", slowly)
        first = forked(partial(command("ply", toy), tmp_path), go)
    go.touch()
    while not slow.exists():
        time.sleep(0.005)
    assert command("ply", toy, "--time-s 0.2")(tmp_path) == 5
    assert command("ply", toy, "--time-s 0.2 --overwrite")(tmp_path) == 5
    end.touch()
    assert os.waitstatus_to_exitcode(os.waitpid(first, 0)[1]) == 0
    assert json.loads((tmp_path / "a.ply.json").read_text())["time_s"] != 0.2
    pair(out)
    assert {path.name for path in tmp_path.iterdir()} == {"a.ply", "a.ply.json", "go", "slow", "end"}


def test_of_many_that_start_together_one_takes_the_lock(tmp_path: Path) -> None:
    lock = tmp_path / "lock"
    store.write_json(lock, {"pid": 2**22 - 3, "host": os.uname().nodename})  # of a dead process

    def take() -> int:
        try:
            take_lock(lock)
        except ResourceError:
            return 7
        (tmp_path / f"mine{os.getpid()}").touch()
        while not (tmp_path / "end").exists():  # it works in there until all have tried
            time.sleep(0.005)
        return 0

    for round_ in range(3):
        go = tmp_path / f"go{round_}"
        started = [forked(take, go) for _ in range(8)]
        go.touch()
        time.sleep(0.5)
        (tmp_path / "end").touch()
        codes = [os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) for child in started]
        assert sorted(codes) == [0, *[7] * 7]
        (tmp_path / "end").unlink()
