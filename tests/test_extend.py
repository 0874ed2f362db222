"""The skeletons of docs/examples/extend work: other packages add an importer and a method, a module adds the rest."""

from __future__ import annotations

import importlib
import math
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import roundtrip
import toy_views
import write_custom
from test_edit import toy
from test_sim import LOOK, placed, wall

import mudg
from mudg import app
from mudg.base import geometry, store
from mudg.base.errors import UsageError
from mudg.base.types import Scene
from mudg.base.versions import GROUP, load_plugin, plugins
from mudg.core.metrics import METRICS
from mudg.formats.splats.formats import FORMATS
from mudg.gaussians.recipes import RECIPES
from mudg.gaussians.storage import load_model, save_model
from mudg.scene.read import read_scene
from mudg.sim import Instant, Session


@pytest.fixture
def installed(tmp_path: Path, repository: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder of installed packages with one that offers the skeletons, as pip would leave it."""
    assert plugins() == {}  # nothing is offered where no package offers it
    folder = tmp_path / "site"
    shutil.copytree(repository / "docs" / "examples" / "extend", folder)
    info = folder / "my_package-1.2.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: my-package\nVersion: 1.2\n")
    (info / "entry_points.txt").write_text(
        f"[{GROUP}]\nimporter.my_log = my_importer:import_log\nimporter.broken = my_importer:absent\n"
        "importer.gone = no_such_module:import_log\n"
    )
    monkeypatch.syspath_prepend(str(folder))
    return folder


@pytest.fixture(scope="module")
def truth(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    return roundtrip.small_log(tmp_path_factory.mktemp("truth") / "city")


def test_an_importer_of_another_package_reads_a_recording(installed: Path, truth: Scene, tmp_path: Path) -> None:
    recording = write_custom.write_recording(truth, tmp_path / "recording")
    mudg.ingest(str(recording), out=tmp_path / "scene", format="my_log")
    roundtrip.assert_same_log(read_scene(tmp_path / "scene"), truth, time_s=1e-6, dt_s=1e-6)
    assert app.main(["ingest", "my_log", str(recording), str(tmp_path / "scene")]) == 0  # the same: reused
    with pytest.raises(UsageError, match=r"no such format(.|\n)*my_log"):
        mudg.ingest(str(recording), out=tmp_path / "other", format="their_log")


def test_doctor_lists_what_other_packages_offer_and_loads_none_of_it(
    installed: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (installed / "my_importer.py").write_text("raise SystemExit('loaded')")
    assert app.main(["doctor"]) == 0
    said = capsys.readouterr().out
    assert "importer my_log    my_importer:import_log of my-package 1.2" in said


@pytest.mark.parametrize(("name", "got"), [("broken", "AttributeError"), ("gone", "ModuleNotFoundError")])
def test_code_that_cannot_be_loaded_is_named_with_its_package(installed: Path, name: str, got: str) -> None:
    with pytest.raises(UsageError, match=rf"importer {name}(.|\n)*of my-package 1.2(.|\n)*{got}"):
        load_plugin(name)


def test_a_metric_becomes_a_column_of_the_scores(
    installed: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Views that are 20 grey values darker, and brighter, than the truth: what a squared error cannot tell apart."""
    monkeypatch.setitem(METRICS, "brightness_bias", importlib.import_module("my_metric").ROW)
    scene = toy_views.write_scene(tmp_path / "scene")
    views, offsets = {}, {"darker": -20, "brighter": 20}
    for name, by in offsets.items():
        change = lambda _, seen, by=by: replace(seen, rgb=seen.rgb + by / 255)
        views[name] = toy_views.write_views(scene, tmp_path / name, name, (0.0,), change)
    out = mudg.score(scene, views=views, out=tmp_path / "score", perceptual_views=0)
    values = {row["method"]: row["values"] for row in store.read_json(out / "metrics.json")["results"]}
    for name, by in offsets.items():
        assert values[name]["brightness_bias"] == pytest.approx(by / 255, abs=1e-6)
    assert values["darker"]["psnr"] == pytest.approx(values["brighter"]["psnr"])
    assert "brightness_bias" in (out / "metrics.md").read_text()


def test_an_exporter_writes_files_and_says_what_they_lose(
    installed: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(FORMATS, "xyz", importlib.import_module("my_exporter").FORMAT)
    save_model(toy(), tmp_path / "fit")
    mudg.export("xyz", tmp_path / "fit", out=tmp_path / "scene.xyz", time_s=1.0)
    rows = np.loadtxt(tmp_path / "scene.xyz")
    assert rows.shape[1] == 7 and (rows[:, 3:] >= 0).all() and (rows[:, 3:] <= 1).all()
    assert len(rows) == 690 and "motion" in str(store.read_json(tmp_path / "scene.xyz.json")["not_in_the_file"])


def test_a_sensor_hears_the_nearest_surface_and_whose_it_is(installed: Path) -> None:
    """A wall 10 m ahead, heard obliquely; and a car in front of the vehicle, which is gone where it is not listed."""
    module = importlib.import_module("my_sensor")
    (echo,) = Session(wall()).render([module.UltrasonicRequest(Instant(0.5, placed(7.0)))])
    assert echo.range_m == pytest.approx(3.0, abs=0.02) and echo.object == ""
    turned = placed(7.0, yaw=math.radians(45))  # the edge of the cone meets the wall at 15 degrees
    (echo,) = Session(wall()).render([module.UltrasonicRequest(Instant(0.5, turned))])
    assert echo.range_m == pytest.approx(3.0 / math.cos(math.radians(15)), rel=0.02)
    session = Session(toy())
    ahead = session.objects(0.5)["car-1"] @ geometry.yaw_matrix(0.0, (-4.0, 0.0, 0.0)) @ LOOK
    listed, absent = session.render(
        [module.UltrasonicRequest(Instant(0.5, ahead, objects), 15.0) for objects in (session.objects(0.5), {})]
    )
    assert listed.object == "car-1" and 1.0 < listed.range_m < 4.0
    assert absent.object == ""


def test_a_method_adds_its_loss_to_the_common_fit(
    installed: Path, truth: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    fused = mudg.fuse(truth.root, out=tmp_path / "fused")

    def smallest_axes_m(name: str) -> float:
        settings = {"iterations": 40, "width_px": 48, "start": {"gaussians": 600}, "densify": {"kind": "none"}}
        folder = mudg.fit(truth.root, fused, out=tmp_path / name, method="street_gaussians", **settings)
        return float(load_model(folder).table["log_scales"].detach().exp().min(1).values.mean())

    plain = smallest_axes_m("plain")
    monkeypatch.setitem(RECIPES, "street_gaussians", "my_method:FlatRecipe")
    assert smallest_axes_m("flat") < 0.9 * plain
