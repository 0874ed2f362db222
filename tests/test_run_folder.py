"""A verb's output folder: reused, continued, replaced by a finished result; others' files stay."""

from __future__ import annotations

import os
import socket
from pathlib import Path
from typing import Any

import pytest
from refusals import refused

from mudg.base import store
from mudg.base.errors import IntegrityError, ResourceError, UsageError
from mudg.base.run_folder import Replacement, RunDir, VerbOutput, refuse_overlap

OUTPUT = VerbOutput("fit", 1, ("out.txt", "rows/*.txt", "steps/"))
SETTINGS = {"nested": {"x": 0.5}}


def run(path: Path, value: int = 1, **named: Any) -> RunDir:
    return RunDir.open(path, OUTPUT, {"value": value, **SETTINGS}, {"scene": "abc"}, **named)


def finished(path: Path, value: int = 1, **named: Any) -> RunDir:
    made = run(path, value, **named)
    store.write_text(made.path / "out.txt", f"result {value}")
    store.write_text(made.path / "rows" / f"{value}.txt", "row")
    made.finish({"value": value})
    return made


def contents(folder: Path) -> dict[str, str]:
    found = {p.relative_to(folder).as_posix(): p for p in folder.rglob("*") if p.is_file()}
    return {name: path.read_text() for name, path in sorted(found.items()) if name != "run.json"}


# reused, continued, refused -----------------------------------------------------------------------


def test_run_folder_refuses_another_configuration_and_names_the_difference(tmp_path: Path) -> None:
    run(tmp_path / "r").finish()
    refused("value: 1 there, 2 asked", run, tmp_path / "r", value=2, raises=UsageError)
    refused("scene", RunDir.open, tmp_path / "r", OUTPUT, {"value": 1, **SETTINGS}, {"scene": "xyz"}, raises=UsageError)


def test_a_run_that_failed_before_it_made_anything_is_in_nobodys_way(tmp_path: Path) -> None:
    run(tmp_path / "r")
    corrected = run(tmp_path / "r", value=2)
    assert not corrected.complete
    store.write_text(corrected.path / "out.txt", "half")
    refused("value: 2 there, 1 asked", run, tmp_path / "r", raises=UsageError)


def test_lock_of_a_live_process_is_respected_and_of_a_dead_one_taken_over(tmp_path: Path) -> None:
    made = run(tmp_path / "r")
    store.write_json(made.path / "lock", {"pid": os.getppid(), "host": socket.gethostname()})
    refused(str(os.getppid()), run, tmp_path / "r", raises=ResourceError)
    store.write_text(made.path / "out.txt", "half")
    for value in (1, 2):
        refused("another process", run, tmp_path / "r", value, overwrite=True, raises=ResourceError)
    assert (made.path / "out.txt").is_file()
    store.write_json(made.path / "lock", {"pid": 2**22 + 1, "host": socket.gethostname()})
    assert not run(tmp_path / "r").complete


def test_a_folder_that_another_process_filled_meanwhile_is_not_taken_over(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Between a look into the folder and its lock another command can have finished there."""
    begin = RunDir._begin

    def later(made: RunDir, *given: Any) -> None:
        monkeypatch.setattr(RunDir, "_begin", begin)
        finished(tmp_path / "r")
        begin(made, *given)

    monkeypatch.setattr(RunDir, "_begin", later)
    with pytest.raises((ResourceError, UsageError)):
        finished(tmp_path / "r", 2)
    assert contents(tmp_path / "r")["out.txt"] == "result 1"
    store.verify_manifest(tmp_path / "r")


# somebody else's files ----------------------------------------------------------------------------


@pytest.mark.parametrize(
    "state",
    [None, "{", "[]", '{"schema": 1}']
    + ['{"schema": 3, "verb": "fit", "key": "k", "state": "complete"}']
    + ['{"schema": 1, "state": "complete", "asked": {"verb": "run"}}'],
)
@pytest.mark.parametrize("overwrite", [False, True])
def test_a_folder_of_somebody_elses_files_is_refused(tmp_path: Path, state: str | None, overwrite: bool) -> None:
    folder = tmp_path / "r"
    folder.mkdir()
    (folder / "thesis.tex").write_text("precious")
    if state is not None:
        (folder / "run.json").write_text(state)
    before = sorted(p.name for p in tmp_path.rglob("*"))
    refused("something else", run, folder, overwrite=overwrite, raises=UsageError)
    assert sorted(p.name for p in tmp_path.rglob("*")) == before
    refused("no folder", run, folder / "thesis.tex", overwrite=overwrite, raises=UsageError)


def test_a_run_killed_before_its_first_record_is_in_nobodys_way(tmp_path: Path) -> None:
    folder = tmp_path / "r"
    store.write_json(folder / "lock", {"pid": 2**22 + 1, "host": socket.gethostname()})
    (folder / ".run.abcdefgh.part.json").write_text("{")
    finished(folder)
    assert run(folder).complete
    (folder / "lock").write_text("a key, and not ours")
    (folder / "run.json").unlink()
    refused("something else", run, folder, raises=UsageError)


@pytest.mark.parametrize("done", [True, False])
def test_only_files_of_the_old_result_are_removed_and_others_named_and_kept(
    tmp_path: Path, done: bool, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "r"
    old = run(folder)
    for name in ("out.txt", "rows/1.txt", "rows/a b.txt", "steps/step_01/weights", "steps/x.part/y"):
        store.write_text(old.path / name, "old")
    (folder / "rows" / ".1.abcdefgh.part.txt").write_text("left by a killed writer")
    (folder / "rows" / "mine.md").write_text("mine")  # while the run goes on
    (folder / "photos" / "2024").mkdir(parents=True)
    (folder / "photos" / "2024" / "a.jpg").write_text("mine, too")
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "elsewhere" / "b.jpg").write_text("far away")
    (folder / "link").symlink_to(tmp_path / "elsewhere")
    if done:
        old.finish()
        assert "rows/mine.md" not in store.read_json(folder / "manifest.json")["files"]
        (folder / "rows" / "9.txt").write_text("added to a finished result")
        (folder / "out.txt.kept1").write_text("mine by chance")
    capsys.readouterr()
    new = finished(folder, 2, overwrite=True)
    said = capsys.readouterr().err.replace("\n", " ")
    kept = ["link", "photos/2024/a.jpg", "rows/mine.md", *(["out.txt.kept1", "rows/9.txt"] if done else [])]
    assert all(name in said for name in kept)
    made = {"manifest.json", "out.txt", "rows/2.txt", "run.yaml"}
    assert {name for name in contents(folder) if "link" not in name} == made | set(kept[1:])
    assert (folder / "link" / "b.jpg").read_text() == "far away" and new.path == new.out == folder
    store.verify_manifest(folder)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["elsewhere", "r"] and run(folder, 2).complete


def test_a_manifest_names_nothing_outside_its_folder(tmp_path: Path) -> None:
    folder = finished(tmp_path / "r").path
    (folder / "rows" / "2.txt").write_text("mine")  # gets another name
    (tmp_path / "precious").write_text("x")
    manifest = store.read_json(folder / "manifest.json")
    manifest["files"] |= dict.fromkeys(("../precious", str(tmp_path / "precious")), {"bytes": 1, "sha256": "0"})
    store.write_json(folder / "manifest.json", manifest)
    finished(folder, 2, overwrite=True)
    assert (tmp_path / "precious").read_text() == "x"
    assert (folder / "rows" / "2.txt").read_text() == "row" and (folder / "rows" / "2.txt.kept1").read_text() == "mine"


# replaced when the new result is finished ---------------------------------------------------------


def test_the_old_result_stands_until_the_new_one_is_finished(tmp_path: Path) -> None:
    folder = finished(tmp_path / "r").path
    before = contents(folder)
    digest = store.digest(tmp_path)
    new = run(folder, 2, overwrite=True)
    assert new.path == Replacement(folder).staging and store.digest(tmp_path) == digest
    store.write_text(new.path / "out.txt", "half")
    new.log(step=1)
    assert contents(folder) == before
    assert run(folder).complete  # the old result is reused as ever
    refused("another configuration", run, folder, 2, raises=UsageError)
    again = run(folder, 2, overwrite=True)
    assert (again.path / "out.txt").read_text() == "half"
    other = run(folder, 3, overwrite=True)
    assert not (other.path / "out.txt").exists() and contents(folder) == before
    finished(folder, 3, overwrite=True)
    assert contents(folder)["out.txt"] == "result 3" and [p.name for p in tmp_path.iterdir()] == ["r"]
    assert ".part" not in "".join(contents(folder).values())


@pytest.mark.parametrize("altered", ["out.txt", "run.json"])
def test_a_finished_result_is_reused_with_overwrite_too_and_an_altered_one_made_again(
    tmp_path: Path, altered: str
) -> None:
    folder = finished(tmp_path / "r").path
    assert run(folder, overwrite=True).complete
    text = (folder / altered).read_text()
    (folder / altered).write_text(text.replace('"value": 1', '"value": 2').replace("result 1", "altered"))
    refused("--overwrite", run, folder, raises=IntegrityError)
    assert finished(folder, overwrite=True).path == folder and (folder / "out.txt").read_text() == "result 1"


def test_a_replacement_goes_on_when_the_old_result_was_taken_away_and_a_link_stays_one(tmp_path: Path) -> None:
    folder = finished(tmp_path / "r").path
    store.write_text(run(folder, 2, overwrite=True).path / "out.txt", "half")
    folder.rename(tmp_path / "away")
    again = run(folder, 2)
    assert (again.path / "out.txt").read_text() == "half"
    finished(folder, 2)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["away", "r"]
    (tmp_path / "link").symlink_to("r")
    finished(tmp_path / "link", 3, overwrite=True)
    assert (tmp_path / "link").is_symlink() and (folder / "out.txt").read_text() == "result 3"


def test_a_folder_that_cannot_be_renamed_is_refused_before_the_work(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = finished(tmp_path / "r").path
    monkeypatch.setattr(os.path, "ismount", lambda path: Path(path) == folder)
    refused("mount point", run, folder, 2, overwrite=True, raises=ResourceError)
    monkeypatch.undo()
    monkeypatch.setattr(Path, "mkdir", _refuse)
    refused("beside the old one", run, folder, 2, overwrite=True, raises=ResourceError)
    assert contents(folder)["out.txt"] == "result 1"


def _refuse(*_: object, **__: object) -> None:
    raise PermissionError("read-only")


# crashes ------------------------------------------------------------------------------------------


class Crash(BaseException):
    """The process ends here."""


def crashed(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Replace result 1 by result 2, and crash between the two renames."""
    new = run(folder, 2, overwrite=True)
    store.write_text(new.path / "out.txt", "result 2")
    rename = Path.rename

    def once(self: Path, target: Path) -> Path:
        if self == new.path:
            raise Crash
        return rename(self, target)

    with monkeypatch.context() as patched:
        patched.setattr(Path, "rename", once)
        with pytest.raises(Crash):
            new.finish()


def test_what_a_crash_between_the_renames_left_is_told_and_undone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = finished(tmp_path / "r").path
    crashed(folder, monkeypatch)
    assert not folder.exists()
    refused("repeat the command that wrote it", store.digest, folder)
    (store.staging_path(folder) / "out.txt").write_text("damaged")
    assert run(folder).complete and contents(folder)["out.txt"] == "result 1"


def test_a_folder_made_by_hand_between_the_renames_is_not_mistaken(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = finished(tmp_path / "r").path
    crashed(folder, monkeypatch)
    folder.mkdir()
    (folder / "mine.md").write_text("mine")
    error = refused("in each other's way", run, folder, 2, overwrite=True, raises=UsageError)
    assert str(store.retired_path(folder)) in error.got
    (folder / "mine.md").unlink()
    assert run(folder, 2).complete


def test_a_failed_second_rename_is_undone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = finished(tmp_path / "r").path
    new = run(folder, 2, overwrite=True)
    store.write_text(new.path / "out.txt", "result 2")
    real = Path.rename

    def refuse(self: Path, target: Path) -> Path:
        if self == new.path:
            raise OSError("busy")
        return real(self, target)

    monkeypatch.setattr(Path, "rename", refuse)
    refused("it is finished and lies in", new.finish, raises=ResourceError)
    monkeypatch.undo()
    assert run(folder).complete and run(folder, 2, overwrite=True).complete
    assert contents(folder)["out.txt"] == "result 2"


# inputs and outputs apart -------------------------------------------------------------------------


@pytest.fixture
def places(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Folder data/scene with a file in it, links to both and one through another folder, and the current folder."""
    (tmp_path / "data" / "scene" / "images").mkdir(parents=True)
    (tmp_path / "data" / "scene" / "weights").write_text("w")
    (tmp_path / "other").mkdir()
    (tmp_path / "link").symlink_to("data/scene")
    (tmp_path / "other" / "up").symlink_to("../data")
    (tmp_path / "weights_link").symlink_to("data/scene/weights")
    monkeypatch.chdir(tmp_path)
    return tmp_path


OVERLAPS = {
    "is also": "data/scene=data/scene data/scene/=link link=data/scene data/../data/scene=data/scene "
    "other/up/scene=data/scene data/scene/weights=data/scene/weights",
    "holds": "data=data/scene .=link data/scene=data/scene/weights data/scene=weights_link",
    "lies in": "data/scene/new=data/scene link/a/b/c=data/scene other/../link/new=data/scene other/up/scene/new=link "
    "link/images=data",
}
"""Relation -> outputs and inputs between which it is."""
NEAR = ("other", "data/scene2", "data/sc")


@pytest.mark.parametrize(("relation", "pair"), [(name, one) for name, all_ in OVERLAPS.items() for one in all_.split()])
def test_overlaps_are_found_through_links_and_dots(places: Path, relation: str, pair: str) -> None:
    out, given = pair.split("=")
    for base in (Path(), places):
        inputs = {"nothing": None, "none": "", "scene": base / given}
        error = refused(relation, refuse_overlap, base / out, inputs, raises=UsageError)
        assert str(base / out) in str(error) and str(base / given) in str(error) and error.remedy


def test_neighbours_do_not_overlap(places: Path) -> None:
    refuse_overlap("data/scene/images", {"scene": "data/scene/weights"})
    for out, given in (("data/new/deep", "link"), ("nowhere", "nothing there"), *((n, "data/scene") for n in NEAR)):
        refuse_overlap(out, {"scene": given})


def test_upper_and_lower_case_are_one_where_the_file_system_says_so(
    places: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    real = Path.stat

    def careless(self: Path, **named: Any) -> os.stat_result:
        return real(Path(str(places) + str(self).removeprefix(str(places)).lower()), **named)

    monkeypatch.setattr(Path, "stat", careless)
    for out in ("Data/Scene", "DATA/SCENE/new", "Data"):
        refused(".", refuse_overlap, places / out, {"scene": places / "data" / "scene"}, raises=UsageError)
