"""A run's folder stands for each of its parts; wrong paths are refused at once; help of every command."""

from __future__ import annotations

import contextlib
import functools
import io
import json
import subprocess
import sys
from pathlib import Path

import pytest
from refusals import refused
from test_edit_run import run  # noqa: F401
from test_engine import ANSWERS
from toy_fitted import write_toy_run

import mudg
from mudg import FittedScene, app, steps
from mudg.base import store
from mudg.benchmarks import run as bench
from mudg.formats.importers import FORMATS
from mudg.scoring import score
from mudg.steps.engine import Result, paths_of


@pytest.fixture
def called(monkeypatch: pytest.MonkeyPatch) -> list[Result]:
    """The steps as they would be carried out, in place of doing it."""
    calls: list[Result] = []
    monkeypatch.setattr(Result, "act", lambda step: calls.append(step) or Path("made"))
    monkeypatch.setattr(score, "summary_table", lambda _out: "")
    return calls


@pytest.mark.parametrize(
    ("line", "paths"),
    [
        ("annotate RUN --out OUT", ["scene"]),
        ("fuse RUN --out OUT", ["scene"]),
        ("fit RUN --out OUT", ["scene", "fuse"]),
        ("fit RUN --start-from RUN --out OUT", ["scene", "fuse", "fit/street_gaussians"]),
        ("fit RUN --observations RUN --out OUT", ["scene", "fuse", "synthesize"]),
        ("synthesize RUN --out OUT", ["scene", "fuse"]),
        ("synthesize RUN --fitted RUN --out OUT", ["scene", "fuse", "fit/street_gaussians"]),
        ("render RUN --out OUT", ["scene", "fit/mudg_s"]),
        ("render RUN/scene --model RUN --fused RUN --out OUT", ["scene", "fit/mudg_s", "fuse"]),
        ("score RUN --views mudg_s=RUN mudg_r=RUN --out OUT", ["scene", "render/mudg_s", "synthesize"]),
    ],
)
def test_a_run_stands_for_its_parts(line: str, paths: list[str], called: list[Result], tmp_path: Path) -> None:
    folder = tmp_path / "run"
    for name in ("scene/scene.json", "fuse/fuse.json", "fit/street_gaussians/model.json", "fit/mudg_s/model.json"):
        store.write_json(folder / name, {})
    for name in ("synthesize", "render/mudg_s"):
        store.make_folder(folder / name)
    assert app.main(line.replace("RUN", str(folder)).replace("OUT", str(tmp_path / "out")).split()) == 0
    assert [path.relative_to(folder).as_posix() for path in paths_of(called[0]).values() if path is not None] == paths


def test_a_run_in_python_doctor_and_render(run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert len(FittedScene.read(run, "cpu")) == len(FittedScene.read(run / "fit" / "street_gaussians", "cpu"))
    assert app.main(["doctor", str(run)]) == 0 and "can be used" in capsys.readouterr().out
    line = ["render", str(run), "--shifts-m", "0", "--no-video", "--quiet", "--out"]
    assert app.main([*line, str(tmp_path / "a")]) == 0
    parts = [str(run / "scene"), "--model", str(run / "fit" / "street_gaussians")]
    assert app.main(["render", *parts, *line[2:], str(tmp_path / "b")]) == 0
    mudg.render(run, run, out=tmp_path / "c", shifts_m=(0.0,), video=False)
    one, two, three = (store.read_json(tmp_path / name / store.MANIFEST)["files"] for name in "abc")
    pictures = [name for name in one if name.endswith((".png", ".safetensors"))]
    assert pictures and all(one[name] == two[name] == three[name] for name in pictures)


WRONG_PATHS = [
    ("fuse TOY/scen --out OUT", 3, "TOY/scene?"),
    ("fit TOY/scene --fused TOY/fuze --out OUT", 3, "made by `mudg fuse`"),
    ("render TOY/scene --model TOY/fitt --out OUT", 3, "TOY/fit?"),
    ("synthesize TOY/scene --fused TOY/fit --out OUT", 3, "made by `mudg fuse`"),
    ("synthesize TOY/none --fused TOY/fit --out OUT", 3, "no such file or folder"),
    ("synthesize TOY/scene --out OUT", 2, "no --fused was given"),
    ("render TOY/scene --model TOY/scene --out OUT", 3, "made by `mudg fit`"),
    ("render TOY/fit --model TOY/fit --out OUT", 3, "not a scene"),
    ("render TOY/scene --out OUT", 2, "no --model was given"),
    ("fit TOY/scene --fused TOY/none --out OUT", 3, "made by `mudg fuse`"),
    ("page TOY/fit --scene TOY/none --out OUT.html", 3, "no such file or folder"),
    ("export ply TOY/fit --scene TOY/none --out OUT.ply", 3, "no such file or folder"),
]


def test_wrong_paths_are_refused_before_anything_heavy_is_loaded(tmp_path: Path) -> None:
    write_toy_run(tmp_path)
    lines = [line.replace("TOY", str(tmp_path)).replace("OUT", str(tmp_path / "out")) for line, _, _ in WRONG_PATHS]
    command = [sys.executable, "-c", ANSWERS, json.dumps(lines)]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    answers = [json.loads(answer) for answer in done.stdout.splitlines()]
    for (line, code, said), (left, message, torch_loaded) in zip(WRONG_PATHS, answers, strict=True):
        assert left == code and said.replace("TOY", str(tmp_path)) in message, (line, message)
        assert not torch_loaded, f"{line}: torch was loaded"
    assert not list(tmp_path.glob("out*"))


def test_in_python_wrong_paths_are_refused_too(tmp_path: Path) -> None:
    scene, fitted, _, _ = write_toy_run(tmp_path)
    refused("file not found", mudg.synthesize, scene, fitted, out=tmp_path / "out")
    refused("no fitted scene", FittedScene.read, scene)


@functools.cache
def help_of(page: str, asked: str) -> str:
    """What a command prints that is asked for help."""
    with contextlib.redirect_stdout(io.StringIO()) as said:
        assert app.main([*page.split(), asked]) == 0
    return said.getvalue()


def test_short_help_is_help_and_every_part_of_a_verb_has_a_page() -> None:
    assert help_of("ingest kitti", "-h") == help_of("ingest kitti", "--help")
    assert set(steps.step_class("ingest").parts) == {"city", *FORMATS}
    assert set(steps.step_class("bench").parts) == set(bench.BENCHES)


@pytest.mark.parametrize("verb", steps.VERBS)
def test_help_all_works_for_every_verb(verb: str) -> None:
    said = help_of(verb, "--help-all")
    assert f"usage: mudg {verb}" in said and "--quiet" in said
