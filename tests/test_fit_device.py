"""Fit, render and score on a device that is not the CPU: the same numbers, what is copied there and back, and going on
elsewhere.

The pretend device runs the plain-torch twins, so that the CPU that it is compared with runs them too.
"""

from __future__ import annotations

import contextlib
import json
import os
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from fit_settings import fit_config, fit_to, interrupted, log_lines, small_fit
from pretend_device import Transfer, pretend_device, transfers
from refusals import refused
from test_scene_options import EVERYTHING, written_world
from toy_world import camera, view_at

from mudg.base import store
from mudg.base.config import result_settings
from mudg.base.errors import NumericsError, ResourceError, UsageError
from mudg.benchmarks import chain, rows
from mudg.benchmarks.settings import BenchConfig
from mudg.core import native_ops
from mudg.core.raster import rasterize as place
from mudg.core.raster.rasterize import RasterConfig
from mudg.core.table import Table
from mudg.gaussians import fit
from mudg.gaussians.corrections import Appearance
from mudg.gaussians.densify import DensifySettings, DensifyStats, densify
from mudg.gaussians.model import SceneModel
from mudg.gaussians.nodes import StaticNode
from mudg.gaussians.rendering import NEAR_M, render_planes
from mudg.gaussians.schedule import FiniteCheck
from mudg.gaussians.settings import FitConfig
from mudg.steps.settings import RunConfig, with_device

SIZE, FRAMES = (36, 24), 4
PRETEND = torch.device("pretend", 0)
CPU = torch.device("cpu")
NUMBERS = 64
"""Copies of at most so many values are small: poses, sizes, numbers for the log."""


@pytest.fixture(scope="module")
def world(tmp_path_factory) -> dict[str, Path]:
    return written_world(tmp_path_factory.mktemp("world"), SIZE, FRAMES)


@pytest.fixture(autouse=True)
def early_densification(monkeypatch):
    """Rounds within a few steps."""

    def schedule(config: FitConfig, *_given: float) -> DensifySettings | None:
        return DensifySettings(2, 4, 2, static_gradient=1e-4, max_rows=config.densify.max_gaussians, reset_every=3)

    monkeypatch.setattr(fit, "densify_schedule", schedule)


def settings(method: str, device: str, **changes) -> FitConfig:
    few = {"iterations": 6, "start__gaussians": 120, "densify__max_gaussians": 400, "raster": "torch"}
    virtual = {"loss__semantic_every": 2, "virtual__probability": 0.5, "virtual__gaussians": 50}
    return small_fit(method, device=device, **{**few, **virtual, **changes})


@contextlib.contextmanager
def twins():
    """Within: the CPU computes what the other device does, without the native library."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(native_ops, "_library_for", lambda tensors: None)
        yield


def assert_same_fit(mine: Path, theirs: Path) -> None:
    one, other = ({path.name: store.read_tensors(path) for path in f.glob("*.safetensors")} for f in (mine, theirs))
    torch.testing.assert_close(one, other, atol=1e-5, rtol=1e-5)


def fitted(world: dict[str, Path], out: Path, config: FitConfig, **more: Path) -> Path:
    return fit_to(world, out, config, observations=(world["virtual"],), **more).run()


CASES = {
    "gradient": ("street_gaussians", {"sh_degree": 1, "poses__learn": True, "poses__start": 0.3, "poses__rounds": 2}),
    "everything": ("mudg_s", {**EVERYTHING, "densify__kind": "gradient"}),
}


@pytest.mark.slow
@pytest.mark.parametrize("case", CASES)
def test_a_fit_has_the_numbers_of_the_cpu(world, tmp_path, case):
    method, changes = CASES[case]
    with twins():
        here = fitted(world, tmp_path / "here", settings(method, "cpu", **changes))
    with pretend_device():
        there = fitted(world, tmp_path / "there", settings(method, "pretend", **changes))
    assert_same_fit(there, here)
    lines = [log_lines(folder) for folder in (here, there)]
    did = set().union(*lines[0])
    assert did >= {"cloned", "split", "pruned"}
    assert ("boxes_moved_m" in did) == bool(changes.get("poses__learn"))
    for mine, theirs in zip(*lines, strict=True):
        assert mine.keys() == theirs.keys()
        assert mine.get("view") == theirs.get("view")
        numbers = [name for name in mine if name not in ("view", "seconds")]
        assert [mine[name] for name in numbers] == pytest.approx([theirs[name] for name in numbers], rel=1e-4)


@pytest.mark.slow
def test_a_fit_goes_on_on_the_other_device(world, tmp_path):
    """Begun there, interrupted, finished here; then another fit goes on there with what was made here."""
    with twins():
        whole = fitted(world, tmp_path / "whole", settings("street_gaussians", "cpu"))
    with pretend_device(), interrupted(3):
        fitted(world, tmp_path / "parts", settings("street_gaussians", "pretend"))
    with twins():
        parts = fitted(world, tmp_path / "parts", settings("street_gaussians", "cpu"))
        assert_same_fit(parts, whole)
        here = fitted(world, tmp_path / "here", settings("mudg_s", "cpu", iterations=2), start_from=whole)
    with pretend_device():
        there = fitted(world, tmp_path / "there", settings("mudg_s", "pretend", iterations=2), start_from=whole)
    assert_same_fit(there, here)


# ---- what is copied ------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def plain_fit(world, tmp_path_factory) -> Path:
    """A short fit on the CPU, with the native library."""
    config = fit_config(method="street_gaussians", iterations=30, start__gaussians=120, device="cpu")
    return fit_to(world, tmp_path_factory.mktemp("fit") / "out", config).run()


def copies_of_steps(seen: list[Transfer], monkeypatch) -> dict[int, list[Transfer]]:
    """The copies of every step, apart from those of the rasterizer's twin, which asks for numbers all the time."""
    steps: dict[int, list[Transfer]] = {}
    choose, due = fit.ViewSet.choose, fit.densify_if_due

    def ended(*given):
        report = due(*given)
        steps[given[3]] = [copy for copy in seen if not copy.where.startswith("core/raster/")]
        return report

    monkeypatch.setattr(fit.ViewSet, "choose", lambda *given: (seen.clear(), choose(*given))[1])
    monkeypatch.setattr(fit, "densify_if_due", ended)
    return steps


@pytest.mark.parametrize("method", [pytest.param("street_gaussians", marks=pytest.mark.slow), "mudg_s"])
def test_a_step_copies_a_view_there_and_one_row_of_numbers_back(world, tmp_path, monkeypatch, method):
    pixels = {SIZE[0] * SIZE[1], 30 * 20}
    few = {"iterations": 5, "start__gaussians": 60, "virtual__gaussians": 0}
    config = settings(method, "pretend", densify__kind="none", **few, poses__learn=True, poses__rounds=0)
    monkeypatch.setattr(fit, "densify_schedule", lambda *_given: None)
    monkeypatch.setattr(fit, "add_certainty", lambda state, config: None)
    with pretend_device(), transfers() as seen:
        steps = copies_of_steps(seen, monkeypatch)
        fitted(world, tmp_path / "fit", config)
    assert set(steps) == {1, 2, 3, 4, 5}
    for step, copied in steps.items():
        there = [copy for copy in copied if copy.way == "there"]
        large = [copy for copy in there if copy.values > NUMBERS]
        assert {copy.where.partition(":")[0] for copy in large} == {"gaussians/views.py"}, step
        images = {n * count for n in pixels for count in (1, 3)}
        assert all(copy.values in images or copy.values < 1000 for copy in large)
        back = [copy for copy in copied if copy.way == "back"]
        assert not [copy for copy in copied if copy.way == "wait"], step
        if step > 1:  # at first the tracks' offsets come back and the rows of every node are counted
            assert [copy.where for copy in back] == ["gaussians/schedule.py:refuse"], step
            assert back[0].values < 100
    late = [copy for copy in steps[5] if copy.way == "there" and copy.values <= NUMBERS]
    assert all(copy.where == "gaussians/nodes.py:_placement" for copy in late), late


def test_densification_brings_no_rows_back(plain_fit):
    """Rows are chosen, copied, moved and dropped there; counts come back, and the only large thing that goes there is
    noise."""
    draw = torch.Generator().manual_seed(0)
    gradient = DensifySettings(1, 9, 1, max_rows=5000, least_opacity=0.1)
    model = fit.load_model(plain_fit)
    rows = len(model.table)
    seen_rows = DensifyStats(torch.rand(rows, generator=draw) * 4e-3, torch.ones(rows))
    with pretend_device() as there:
        far, stats = model.to(there), seen_rows.to(there)
        with transfers() as seen:
            found = densify(far, stats, 4, gradient, 0)
        assert found == densify(model, seen_rows, 4, gradient, 0)
        noted = {(copy.way, copy.where) for copy in seen if copy.values > NUMBERS}
        assert noted == {("there", "gaussians/densify.py:_halves")}
        means = far.table["means"].detach().cpu()
        torch.testing.assert_close(means, model.table["means"].detach(), atol=1e-6, rtol=1e-6)
        assert sum(found.values()) > found["rows"], found


def test_what_is_not_finite_is_found_in_one_look(world):
    """On another device nothing is looked at before the whole step is there, and the first fault is named as on the
    CPU."""
    with pretend_device() as there:
        table = Table({"means": torch.zeros(3, 3), "logits": torch.zeros(3)}).to(there)
        model = SceneModel(table, (StaticNode(),), None, (), 0)
        check = FiniteCheck(7)
        with transfers() as seen:
            table["means"].grad = torch.zeros(3, 3, device=there)
            table["logits"].grad = torch.full((3,), torch.inf, device=there)
            check.terms("front/1", {"color": torch.ones((), device=there), "sky": torch.ones((), device=there)})
            check.gradients("front/1", model, Appearance({}))
            assert not [copy for copy in seen if copy.way == "back"]
            refused(r"gaussians.logits, view front/1, step 7[\s\S]*3 values", check.refuse, raises=NumericsError)
        assert table["logits"].grad is None
        check.terms("front/2", {"color": torch.ones((), device=there), "sky": torch.full((), torch.nan, device=there)})
        refused(r"'sky' is not finite[\s\S]*front/2, step 7", check.refuse, raises=NumericsError)


# ---- parts ---------------------------------------------------------------------------------------


def test_a_fitted_scene_moves_and_renders_the_same(plain_fit):
    model = fit.load_model(plain_fit)
    assert model.to(CPU) is model
    view = view_at(0.45, camera(width=SIZE[0], height=SIZE[1]), left_m=1.0)
    raster = RasterConfig(backend="torch", near_m=NEAR_M)
    with twins():
        here = fit.render_view(model, view, raster)
    with pretend_device() as there:
        moved = model.to(there)
        with transfers() as seen:
            made = fit.render_view(moved, view, raster)
        planes = render_planes(moved, view)
        again = moved.to(CPU)
        assert fit.render_view(moved.without_nodes(["walker"]), view, raster).rgb.device == CPU
    large = [copy for copy in seen if copy.values > NUMBERS]
    assert {(copy.way, copy.where.partition(":")[0]) for copy in large} == {("back", "gaussians/rendering.py")}
    for name in ("rgb", "depth", "semantics", "confidence", "mask"):
        torch.testing.assert_close(getattr(made, name), getattr(here, name), atol=1e-6, rtol=1e-6, equal_nan=True)
    assert planes.color.device == planes.semantics.device == CPU
    for mine, theirs in zip(again.table.state().items(), model.table.state().items()):
        assert torch.equal(mine[1], theirs[1])


# ---- which device --------------------------------------------------------------------------------


def test_auto_draws_with_cuda_only_if_gsplat_can(monkeypatch):
    said: list[str] = []
    monkeypatch.setattr(place.log, "info_once", said.append)
    cuda = lambda wanted, purpose: torch.device({"auto": "cuda:0"}.get(wanted, wanted))
    monkeypatch.setattr(place, "choose_device", cuda)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(place, "available", lambda backend: "the package gsplat is not installed")
    given = [("auto",), ("cuda:0",), ("auto", "torch"), ("auto", "cpu"), ("auto", "gsplat")]
    drawn = lambda: [place.drawing_device(wanted, "fit", *raster).type for wanted, *raster in given]
    assert drawn()[:4] == ["cpu", "cuda", "cuda", "cpu"]
    assert "gsplat" in said[0]
    monkeypatch.setattr(place, "available", lambda backend: "")
    assert drawn() == ["cuda", "cuda", "cuda", "cpu", "cuda"]


def test_a_backend_that_does_not_draw_on_the_device_is_refused(world, tmp_path):
    for error, device, raster in ((ResourceError, "cuda", "torch"), (UsageError, "cpu", "gsplat")):
        with pytest.raises(error, match="--device" if device == "cuda" else "--raster"):
            fitted(world, tmp_path / "fit", settings("street_gaussians", device, raster=raster))
    assert not (tmp_path / "fit").exists()  # refused before anything is written


def test_steps_and_benchmarks_follow_the_device_of_a_run_unless_they_have_their_own(monkeypatch):
    made, usual = with_device(RunConfig(device="cuda:1", fit=FitConfig(device="cpu"))), RunConfig()
    assert (made.fit.device, made.render.device, made.score.device) == ("cpu", "cuda:1", "cuda:1")
    assert (made.fuse, with_device(usual)) == (usual.fuse, usual)
    assert result_settings(made) == result_settings(usual) and "device" not in json.dumps(result_settings(made))
    config = BenchConfig(device="cuda:1", methods=("street_gaussians", "mudg_s"))
    fits = [*(row.fit for row in rows.method_rows(config)), rows.usual_fit(config)]
    assert [one.device for one in fits] == ["cuda:1"] * 3
    monkeypatch.setattr(chain, "drawing_device", lambda wanted, purpose: PRETEND if wanted == "cuda:1" else CPU)
    many = (config, replace(config, processes=3), replace(config, device="cpu"))
    assert [chain.at_once(one) for one in many] == [1, 3, os.cpu_count()]
