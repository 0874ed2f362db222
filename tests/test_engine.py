"""The engine: what holds for every verb that makes a folder or a file, whatever it makes."""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import pytest
from toy_fitted import write_toy_run

from mudg import app, steps
from mudg.base import store
from mudg.base.errors import InputError, IntegrityError, UsageError
from mudg.base.run_folder import RunDir
from mudg.steps.command import parse, words_of
from mudg.steps.engine import Make, Output, Result, paths_of
from mudg.steps.run import stage_lines
from mudg.steps.step import Flag

LINES = {
    "annotate": "annotate TOY/scene",
    "fuse": "fuse TOY/scene",
    "fit": "fit TOY/scene --fused TOY/fuse --observations TOY/views",
    "synthesize": "synthesize TOY/scene --fused TOY/fuse --fitted TOY/fit --edits TOY/edits.yaml",
    "render": "render TOY/scene --model TOY/fit --edits TOY/edits.yaml",
    "score": "score TOY/scene --views a=TOY/views b=TOY/more --fused TOY/fuse",
    "edit": "edit TOY/fit TOY/edits.yaml --scene TOY/scene",
    "export": "export colmap TOY/fit --scene TOY/scene --edits TOY/edits.yaml",
    "asset export": "asset export TOY/fit car-001 --scene TOY/scene",
    "asset import": "asset import TOY/edits.yaml --kind scene",
    "dataset": "dataset coco TOY/fit --scene TOY/scene",
    "ingest": "ingest TOY/scene",
}
"""A command line of every verb whose result has inputs."""
ANSWERS = """
import contextlib, io, json, sys
from mudg import app
for line in json.loads(sys.argv[1]):
    with contextlib.redirect_stderr(io.StringIO()) as said:
        code = app.main(line.split())
    print(json.dumps([code, said.getvalue(), "torch" in sys.modules]))
"""


@pytest.fixture(scope="module")
def toy(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A scene, clouds, a fit, views and a script."""
    root = tmp_path_factory.mktemp("toy")
    write_toy_run(root)
    store.write_json(root / "fuse" / "fuse.json", {})
    for name in ("views", "more"):
        store.write_json(root / name / "observations.json", {})
    (root / "edits.yaml").write_text("- remove: {ids: [car]}\n")
    return root


def inputs_in(line: str) -> list[str]:
    """Paths that a command line names."""
    return [word.partition("=")[2] or word for word in line.split() if "TOY" in word]


def test_every_result_with_inputs_is_tried_below() -> None:
    classes = {verb: cls for verb in steps.VERBS if issubclass(cls := steps.step_class(verb), Result)}
    assert {verb for verb, cls in classes.items() if cls.prepare is not Result.prepare} == LINES.keys()


def test_a_wrong_path_is_refused_before_torch_loads_whatever_the_verb(toy: Path, tmp_path: Path) -> None:
    wrong = [line.replace(path, f"{path}x") for line in LINES.values() for path in inputs_in(line)]
    told = [f"{line.replace('TOY', str(toy))} --out {tmp_path / 'out.safetensors'}" for line in wrong]
    done = subprocess.run([sys.executable, "-c", ANSWERS, json.dumps(told)], capture_output=True, text=True, check=True)
    for line, answer in zip(wrong, done.stdout.splitlines(), strict=True):
        code, said, torch_loaded = json.loads(answer)
        assert code == InputError.exit_code and str(toy) in said, (line, said)
        assert not torch_loaded, f"{line}: torch was loaded"
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    "line", [*LINES.values(), "ingest TOY/scene --poses TOY/edits.yaml", "annotate TOY/scene --weights TOY/more"]
)
def test_an_output_that_touches_an_input_is_refused(line: str, toy: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = {path: path.stat().st_mtime_ns for path in toy.rglob("*")}
    for path in inputs_in(line):
        for out in (path, f"{path}/inside", "TOY") if not path.endswith(".yaml") else (path,):
            for overwrite in ("", "--overwrite"):
                words = f"{line} {overwrite} --out {out}".replace("TOY", str(toy)).split()
                assert app.main(words) == UsageError.exit_code, words
                assert "an input" in capsys.readouterr().err or line.startswith("asset export"), words
    assert {path: path.stat().st_mtime_ns for path in toy.rglob("*")} == before


@pytest.mark.parametrize(
    "line", [*LINES.values(), "ingest city --city.seed 7 --no-contact-sheet", "run city --fast --seed 4"]
)
def test_the_words_of_a_step_are_read_as_the_same_step(line: str) -> None:
    words = line.split()
    verb, rest = app.find_verb([*words, "--out", "OUT"])
    step = parse(steps.step_class(verb), rest)[0]
    again = words_of(step)
    assert parse(steps.step_class(verb), [*again[len(verb.split(" ")) :], "--out", "OUT"])[0] == step


def test_steps_of_batches_say_only_what_their_settings_do_not() -> None:
    assert stage_lines()["fit"] == ("fit", "{scene}", "--fused", "{fuse}", "--method", "street_gaussians")
    assert stage_lines()["score"] == ("score", "{scene}", "--fused", "{fuse}", "--views", "fit={render}")


# ---- a step that writes one line of each input ---------------------------------------------------


class Lines(Output):
    """Write the texts of files, a file a time."""

    version, files = 1, ("*.txt", "begun/")
    first: Annotated[Path, Flag("FILE", "first")]
    more: tuple[Path, ...] = ()
    views: Any = None
    end: str = ""
    stop: Any = None
    """Called before every file."""

    def checked(self) -> Lines:
        """Refuses one end."""
        if self.end == "wrong":
            raise UsageError("no such end")
        return self

    def key_settings(self) -> dict[str, Any]:
        """The end alone."""
        return {"end": self.end}

    def prepare(self, inputs: dict[str, str]) -> Make:
        """Refuses an empty file."""
        texts = [path.read_text() for path in (self.first, *self.more)]
        if "" in texts:
            raise InputError("an empty file")
        return partial(self.written, texts)

    def written(self, texts: list[str], work: RunDir) -> dict[str, Any]:
        """Go on after the last file that is there."""
        for number, text in enumerate(texts):
            if not (work.path / f"{number}.txt").is_file():
                (self.stop or str)(number)
                store.write_text(work.path / f"{number}.txt", text + self.end)
        return {"files": len(texts)}


def interrupted(number: int) -> None:
    if number == 1:
        raise KeyboardInterrupt


@pytest.fixture
def lines(tmp_path: Path) -> Lines:
    """Two files as inputs."""
    for name in ("a", "b"):
        (tmp_path / name).write_text(name)
    return Lines(first=tmp_path / "a", more=(tmp_path / "b",), out=tmp_path / "out")


def test_a_finished_result_is_reused_and_names_what_it_was_made_of(lines: Lines, tmp_path: Path) -> None:
    assert lines.run() == tmp_path / "out"
    record = store.read_json(tmp_path / "out" / "run.json")
    assert (record["verb"], record["state"]) == ("lines", "complete")
    assert (record["summary"], record["files"]) == ({"files": 2}, ["*.txt", "begun/"])
    assert record["inputs"] == {"first": store.digest(tmp_path / "a"), "more": store.digest(tmp_path / "b")}
    replace(lines, stop=pytest.fail).run()
    with pytest.raises(UsageError, match="end: '' there, '!' asked"):
        replace(lines, end="!").run()
    (tmp_path / "b").write_text("other")
    with pytest.raises(UsageError, match="input 'more' changed"):
        lines.run()
    (tmp_path / "b").write_text("b")
    (tmp_path / "out" / "1.txt").write_text("altered")
    with pytest.raises(IntegrityError):
        lines.run()


def test_an_interrupted_step_says_so_lets_go_and_goes_on(lines: Lines, tmp_path: Path) -> None:
    with pytest.raises(KeyboardInterrupt):
        replace(lines, stop=interrupted).run()
    assert store.read_json(tmp_path / "out" / "run.json")["state"] == "interrupted"
    assert not (tmp_path / "out" / "lock").exists()
    numbers: list[int] = []
    replace(lines, stop=numbers.append).run()
    assert numbers == [1]


def test_what_cannot_be_done_is_refused_before_anything_is_written(lines: Lines, tmp_path: Path) -> None:
    (tmp_path / "empty").write_text("")
    for change, error in (
        ({"end": "wrong"}, UsageError),
        ({"first": tmp_path / "none"}, InputError),
        ({"more": (tmp_path / "none",)}, InputError),
        ({"first": tmp_path / "empty"}, InputError),
        ({"out": tmp_path / "a"}, UsageError),
        ({"out": tmp_path}, UsageError),
    ):
        with pytest.raises(error):
            replace(lines, **change).run()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a", "b", "empty"]
    several = replace(lines, more=(tmp_path / "b", tmp_path / "a"))
    assert paths_of(several) == {"first": tmp_path / "a", "more": tmp_path / "b", "more 1": tmp_path / "a"}
