"""The folder of a run stands for each of its parts; wrong paths are refused at once; help of every command and of its parts."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path
from typing import Any, get_args, get_type_hints

import pytest
from test_edit_run import run  # noqa: F401
from toy_fitted import write_toy_run

from mudg import FittedScene, cli, flags, verbs
from mudg.base import store
from mudg.base.errors import InputError
from mudg.bench import run as bench
from mudg.data.importers import FORMATS
from mudg.stages import adapt, annotate, fit, fuse, render, score, synthesize


@pytest.fixture
def called(monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """What the steps are called with, in place of doing it."""
    calls: list[Any] = []

    def note(*args: Any, **named: Any) -> Path:
        calls.append((args[1:], named))
        return Path("made")

    for stage in (adapt, annotate, fit, fuse, render, synthesize, score):
        monkeypatch.setattr(stage, "run", note)
    monkeypatch.setattr(score, "summary_table", lambda _out: "")
    return calls


def paths_of(call: Any, folder: Path) -> list[str]:
    """Paths below a folder that a step was called with."""
    args, named = call
    views = [path for one in args if isinstance(one, dict) for path in one.values()]
    several = [path for one in named.values() if isinstance(one, tuple) for path in one]
    flat = [one for one in (*args, *named.values(), *views, *several) if isinstance(one, Path)]
    return [one.relative_to(folder).as_posix() for one in flat if one.is_relative_to(folder)]


@pytest.mark.parametrize(
    ("line", "paths"),
    [
        ("annotate RUN --out OUT", ["scene"]),
        ("fuse RUN --out OUT", ["scene"]),
        ("fit RUN --out OUT", ["scene", "fuse"]),
        ("fit RUN RUN --start-from RUN --out OUT", ["scene", "fuse", "fit/street_gaussians"]),
        ("fit RUN --observations RUN --out OUT", ["scene", "fuse", "synthesize"]),
        ("synthesize RUN --out OUT", ["scene", "fuse"]),
        ("synthesize RUN --fitted RUN --out OUT", ["scene", "fuse", "fit/street_gaussians"]),
        ("adapt RUN --out OUT", ["scene", "fuse", "fit/street_gaussians"]),
        ("render RUN --out OUT", ["scene", "fit/mudg_s"]),
        ("render RUN/scene --model RUN --fused RUN --out OUT", ["scene", "fit/mudg_s", "fuse"]),
        ("score RUN --views mudg_s=RUN mudg_r=RUN --out OUT", ["scene", "render/mudg_s", "synthesize"]),
    ],
)
def test_a_run_stands_for_its_parts(line: str, paths: list[str], called: list[Any], tmp_path: Path) -> None:
    folder = tmp_path / "run"
    for name in ("scene/scene.json", "fuse/fuse.json", "fit/street_gaussians/model.json", "fit/mudg_s/model.json"):
        store.write_json(folder / name, {})
    for name in ("synthesize", "render/mudg_s"):
        store.make_folder(folder / name)
    assert cli.main(line.replace("RUN", str(folder)).replace("OUT", str(tmp_path / "out")).split()) == 0
    assert paths_of(called[0], folder) == paths


def test_a_run_in_python_doctor_and_render(run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:  # noqa: F811
    assert len(FittedScene.read(run, "cpu")) == len(FittedScene.read(run / "fit" / "street_gaussians", "cpu"))
    assert cli.main(["doctor", str(run)]) == 0 and "can be used" in capsys.readouterr().out
    line = ["render", str(run), "--shifts-m", "0", "--no-video", "--quiet", "--out"]
    assert cli.main([*line, str(tmp_path / "a")]) == 0
    parts = [str(run / "scene"), "--model", str(run / "fit" / "street_gaussians")]
    assert cli.main(["render", *parts, *line[2:], str(tmp_path / "b")]) == 0
    verbs.render(run, run, tmp_path / "c", shifts_m=(0.0,), video=False)
    one, two, three = (store.read_json(tmp_path / name / store.MANIFEST)["files"] for name in "abc")
    pictures = [name for name in one if name.endswith((".png", ".safetensors"))]
    assert pictures and all(one[name] == two[name] == three[name] for name in pictures)


@pytest.mark.parametrize(
    ("line", "code", "said"),
    [
        ("synthesize TOY/scene --fused TOY/fit --out OUT", 3, "made by `mudg fuse`"),
        ("synthesize TOY/none --fused TOY/fit --out OUT", 3, "no such file or folder"),
        ("synthesize TOY/scene --out OUT", 2, "no --fused was given"),
        ("render TOY/scene --model TOY/scene --out OUT", 3, "made by `mudg fit`"),
        ("render TOY/fit --model TOY/fit --out OUT", 3, "not a scene"),
        ("render TOY/scene --out OUT", 2, "no --model was given"),
        ("adapt TOY/scene --fused TOY --out OUT", 3, "made by `mudg fuse`"),
        ("fit TOY/scene --fused TOY/none --out OUT", 3, "made by `mudg fuse`"),
        ("page TOY/fit --scene TOY/none --out OUT.html", 3, "no such file or folder"),
        ("export ply TOY/fit --scene TOY/none --out OUT.ply", 3, "no such file or folder"),
    ],
)
def test_wrong_paths_are_refused_before_anything_heavy_is_loaded(line: str, code: int, said: str, tmp_path: Path) -> None:
    write_toy_run(tmp_path)
    words = line.replace("TOY", str(tmp_path)).replace("OUT", str(tmp_path / "out")).split()
    script = f"import sys; from mudg import cli; code = cli.main({words!r}); print('torch' in sys.modules); raise SystemExit(code)"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False)
    assert done.returncode == code and said in done.stderr, done.stderr
    assert done.stdout.strip() == "False", "torch was loaded"
    assert not (tmp_path / "out").exists()


def test_in_python_wrong_paths_are_refused_too(tmp_path: Path) -> None:
    scene, fitted, _, _ = write_toy_run(tmp_path)
    with pytest.raises(InputError, match="file not found"):
        verbs.synthesize(scene, fitted, tmp_path / "out")
    with pytest.raises(InputError, match="no fitted scene"):
        FittedScene.read(scene)


@pytest.mark.parametrize("verb", cli.VERBS)
def test_help_all_works_for_every_verb(verb: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as left:
        cli.main([verb, "--help-all"])
    assert left.value.code == 0
    said = capsys.readouterr().out
    assert f"usage: mudg {verb}" in said and "--quiet" in said


@pytest.mark.parametrize(
    ("page", "shown", "others"),
    [
        ("batch status", ("--html", "--watch-s", "--price"), ("--stages", "--preset", "--reason", "--shard")),
        ("batch retry", ("--reason",), ("--stages", "--html", "--price")),
        ("batch run", ("--list", "--stages", "--engine", "--set"), ("--watch-s", "--reason", "--price")),
        ("bench paper", ("--table", "--iterations"), ("--protocols", "--sampler", "--variant")),
        ("bench mdm", ("--steps", "--cities"), ("--table", "--protocols", "--score.width-px")),
        ("bench real", ("--protocols", "--variant", "--ablation"), ("--table", "--videos", "--sampler")),
        ("ingest kitti", ("--frames", "--resolution", "--boxes"), ("--city.width", "--format")),
        ("ingest city", ("--city.width", "--test-every"), ("--frames", "--boxes", "--format")),
        ("asset export", ("--scene", "--out"), ("--label", "--kind", "--axes")),
        ("asset import", ("--label", "--kind"), ("--scene",)),
    ],
)
@pytest.mark.parametrize("asked", ["--help", "--help-all", "-h"])
def test_parts_of_verbs_have_pages_of_their_own(
    page: str, shown: tuple[str, ...], others: tuple[str, ...], asked: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as left:
        cli.main([*page.split(), asked])
    assert left.value.code == 0
    said = capsys.readouterr().out
    assert f"usage: mudg {page}" in said and "--quiet" in said
    flags_shown = set(re.findall(r"(?<![\w-])--[a-z][a-z0-9.-]*", re.sub(r"examples:.*?(?=\n\n|\u256d)", "", said, flags=re.DOTALL)))
    listed = {line.split()[1].split(",")[0] for line in said.splitlines() if line.startswith("\u2502 --")}
    assert set(shown) <= flags_shown and not set(others) & listed
    parent = page.split()[0]
    with pytest.raises(SystemExit):
        cli.main([parent, asked])
    assert len(said) < len(capsys.readouterr().out)


def test_every_part_that_a_verb_takes_has_a_page() -> None:
    actions = {verb: get_args(get_args(get_type_hints(flags.FLAGS[verb], include_extras=True)["action"])[0]) for verb in ("batch", "asset")}
    assert {verb: set(flags.PARTS[verb]) for verb in actions} == {verb: set(names) for verb, names in actions.items()}
    assert set(flags.PARTS["ingest"]) == {"city", *FORMATS}
    assert set(flags.PARTS["bench"]) == {*bench.BENCHES, bench.SHIFT, bench.REAL, bench.PAPER}
