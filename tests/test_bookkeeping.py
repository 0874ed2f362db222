"""What decides about reuse and inputs is checked like the content: record, log and manifest of a finished folder."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from test_run_folder import run

from mudg.base import store
from mudg.base.errors import InputError, IntegrityError, MudgError, UsageError
from mudg.base.run_folder import refuse_overlap


@pytest.fixture
def finished(tmp_path: Path) -> Path:
    made = run(tmp_path / "r")
    store.write_text(made.path / "out.txt", "result")
    made.log(step=1, loss=0.5)
    made.finish({"psnr": 30.0})
    return made.path


def flipped(content: bytes, place: int) -> bytes:
    return content[:place] + bytes([content[place] ^ (1 << place % 7)]) + content[place + 1 :]


@pytest.mark.parametrize("nth", [40, pytest.param(3, marks=pytest.mark.slow)])
@pytest.mark.parametrize("name", ["run.json", "log.jsonl", "manifest.json"])
def test_no_altered_bookkeeping_is_taken(name: str, nth: int, finished: Path) -> None:
    file = finished / name
    whole = file.read_bytes()
    before = store.digest(finished)
    damaged = [whole[:size] for size in (0, 1, len(whole) // 2, len(whole) - 2)]
    damaged += [flipped(whole, place) for place in range(0, len(whole), nth)]
    for content in damaged:
        file.write_bytes(content)
        with pytest.raises(MudgError) as refused:
            store.digest(finished)
        assert str(finished) in refused.value.where
        with pytest.raises(MudgError) if name != "run.json" else _either():
            assert not run(finished).complete
        file.write_bytes(whole)
    assert store.digest(finished) == before and run(finished).complete


class _either:
    """A record that says "unfinished" is not refused as an output: the run is then made again."""

    def __enter__(self) -> None: ...

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> bool:
        return kind is not None and issubclass(kind, MudgError)


def note(folder: Path, **values: str) -> None:
    store.write_json(folder / "run.json", {**store.read_json(folder / "run.json"), **values})


@pytest.mark.parametrize(
    ("change", "error", "words"),
    [
        (lambda folder: (folder / "manifest.json").unlink(), IntegrityError, "missing"),
        (lambda folder: (folder / "log.jsonl").unlink(), IntegrityError, "missing"),
        (lambda folder: (folder / "out.txt").write_text("other"), IntegrityError, "altered"),
        (lambda folder: store.write_manifest(folder, ["out.txt"]), IntegrityError, "altered"),
        (lambda folder: note(folder, key="x"), IntegrityError, "altered"),
        (lambda folder: store.write_json(folder / "run.json", []), IntegrityError, "damaged"),
        (lambda folder: note(folder, state="running"), InputError, "unfinished"),
    ],
)
def test_a_folder_whose_bookkeeping_does_not_fit_is_no_input(
    finished: Path, change: Callable[[Path], object], error: type[MudgError], words: str
) -> None:
    change(finished)
    with pytest.raises(error, match=words):
        store.digest(finished)


def test_a_copied_folder_is_an_input_with_and_without_its_record(finished: Path, tmp_path: Path) -> None:
    copy = shutil.copytree(finished, tmp_path / "copy")
    assert store.digest(copy) == store.digest(finished)
    (copy / "run.json").unlink()
    assert store.digest(copy) == store.digest(finished)


@pytest.mark.parametrize("lost", [("check",), ("check", "sealed")])
def test_a_record_without_its_seal_is_damaged_whatever_schema_it_names(finished: Path, lost: tuple[str, ...]) -> None:
    state = store.read_json(finished / "run.json")
    older = {name: value for name, value in state.items() if name not in lost} | {"schema": 1}
    store.write_json(finished / "run.json", older)
    with pytest.raises(IntegrityError, match="record of a run is damaged"):
        store.digest(finished)


# ---- outputs that cannot be ----------------------------------------------------------------------


def refuse_and_open(out: Path, overwrite: bool) -> None:
    refuse_overlap(out, {"scene": out.parent / "scene"})
    run(out, overwrite=overwrite)


@pytest.mark.parametrize("overwrite", [False, True])
def test_an_output_that_cannot_be_is_refused_in_words(tmp_path: Path, overwrite: bool) -> None:
    (tmp_path / "file").write_text("mine")
    (tmp_path / "nowhere").symlink_to("gone")
    (tmp_path / "loop").symlink_to("loop")
    (tmp_path / "to_file").symlink_to("file")
    before = sorted(os.listdir(tmp_path))
    cases = {
        **{tmp_path / name: "no folder" for name in ("file", "to_file", "nowhere", "loop")},
        Path("/dev/null"): "no folder",
        tmp_path / "file" / "below": "below something",
        tmp_path / "file" / "deep" / "er": "below something",
        tmp_path / ("a" * 300): "too long",
        tmp_path / ("ä" * 120): "too long",
        tmp_path / "/".join(["abcdefgh"] * 500): "too long",
        tmp_path / "zero\0byte": "zero byte",
    }
    for out, words in cases.items():
        with pytest.raises(UsageError, match=words):
            refuse_and_open(out, overwrite)
    assert sorted(os.listdir(tmp_path)) == before and (tmp_path / "file").read_text() == "mine"


def test_names_as_long_as_can_be_work(tmp_path: Path) -> None:
    for value in (1, 2):
        made = run(tmp_path / ("a" * 230), value, overwrite=True)
        store.write_text(made.path / "out.txt", str(value))
        made.finish()
    assert run(made.path, 2).complete and (made.path / "out.txt").read_text() == "2"
    assert [path.name for path in tmp_path.iterdir()] == ["a" * 230]  # nothing is left beside it


def test_no_file_takes_the_place_of_a_device_or_folder(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "folder").mkdir()
    for name in ("pipe", "folder"):
        with pytest.raises(MudgError, match="not a regular file"):
            store.write_text(tmp_path / name, "x")
    assert sorted(os.listdir(tmp_path)) == ["folder", "pipe"]
    store.write_image(tmp_path / "x.png", np.zeros((2, 2, 3), np.uint8))
