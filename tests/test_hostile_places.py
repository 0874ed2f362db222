"""Commands where the place is hostile: a current folder that is gone, limits of the shell, scenes that claim to be
others."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from mudg import app
from mudg.base.errors import InputError
from mudg.city.config import CityConfig
from mudg.formats.settings import IngestConfig
from mudg.scene.read import read_scene
from mudg.scoring.truth import truth_of
from mudg.steps.ingest import Ingest

GONE = ["doctor", "fuse scene --out out", "view run", "convert a --to b", "run city --out out", "batch status out"]


@pytest.mark.parametrize("words", GONE)
def test_a_current_folder_that_is_gone_is_said(
    words: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "gone").mkdir()
    monkeypatch.chdir(tmp_path / "gone")
    (tmp_path / "gone").rmdir()
    assert app.main(words.split()) == 5
    assert "the current folder is gone" in capsys.readouterr().err
    assert app.main(["--help"]) == 0


LIMITED = """
import gc, resource
from pathlib import Path
from mudg.base import processes
if __name__ == "__main__":
    resource.setrlimit(resource.RLIMIT_AS, (8 << 30, 8 << 30))
    print(processes.run_limited(gc.collect, 64 << 30, Path("file")))
"""


@pytest.mark.skipif(sys.platform != "linux", reason="needs a limit of address space")
def test_a_limit_of_the_shell_below_our_own_is_kept(tmp_path: Path) -> None:
    script = tmp_path / "limited.py"
    script.write_text(LIMITED)
    ended = subprocess.run([sys.executable, str(script)], capture_output=True, text=True, check=False)
    assert ended.returncode == 0, ended.stderr
    assert int(ended.stdout) > 0


@pytest.fixture(scope="module")
def city(tmp_path_factory: pytest.TempPathFactory) -> Any:
    tiny = CityConfig(n_frames=2, width=32, height=24, cameras=("front",), lidar_beams=4)
    settings, out = IngestConfig(city=tiny, contact_sheet=False), tmp_path_factory.mktemp("city") / "scene"
    scene = read_scene(Ingest(log="city", out=out, settings=settings).run())
    assert truth_of(scene).exact
    return scene


@pytest.mark.parametrize(
    "change",
    [
        {"city": 3},
        {"city": None},
        {"city": []},
        {"city": {}},
        {"city": {"n_frames": -1}},
        {"city": {"unknown": 1}},
        {"generator_version": None},
        {"n_frames": 20},
        {"seed": 1},
        {"seed": 10**18},
        {"light": "no"},
        {"textures": "/nowhere"},
        {},
    ],
    ids=str,
)
def test_a_scene_that_claims_to_be_another_city_has_no_truth(change: dict[str, Any], city: Any) -> None:
    recipe = city.source.recipe
    own = {"city", "generator_version"} & set(change)
    changed = {**recipe, **change} if own else {**recipe, "city": {**recipe["city"], **change}} if change else {}
    with pytest.raises(InputError):
        truth_of(replace(city, source=replace(city.source, recipe=changed)))
