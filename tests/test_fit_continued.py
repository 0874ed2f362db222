"""A fit that goes on with a finished one: what it starts from, that it resumes bit for bit, what is refused."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
import torch
from fit_settings import fit_to, fitted_bytes, interrupted, mean_psnr, small_fit, written_street
from refusals import refused
from toy_world import fused_cloud, write_scene

from mudg.base import store
from mudg.base.errors import InputError, UsageError
from mudg.base.palette import ID
from mudg.gaussians import fit
from mudg.gaussians import storage as continued
from mudg.gaussians.corrections import Appearance
from mudg.gaussians.settings import FitConfig
from mudg.scene.clouds import write_fused

SIZE = (60, 40)
FRAMES = 6


def settings(method: str = "mudg_s", **changes) -> FitConfig:
    return small_fit(method, **{"iterations": 16, **changes})


@pytest.fixture(scope="module")
def world(tmp_path_factory) -> dict[str, Path]:
    """A scene, its fused cloud, perfect virtual views 2 m to the left, and a finished fit on recorded views."""
    root = tmp_path_factory.mktemp("world")
    world = written_street(root, SIZE, FRAMES)
    return world | {"plain": fit_to(world, root / "plain", settings("street_gaussians", iterations=80)).run()}


def go_on(world: dict[str, Path], out: Path, config: FitConfig | None = None, **changes) -> Path:
    named = {"observations": (world["virtual"],), "start_from": world["plain"], **changes}
    return fit_to(world, out, config or settings(), **named).run()


def test_it_starts_from_the_finished_scene_and_learns_from_virtual_views_at_once(world, tmp_path, monkeypatch):
    seen, learn = [], fit._learn_from

    def spy(state, view, **how):
        seen.append(view.kind)
        return learn(state, view, **how)

    monkeypatch.setattr(fit, "_learn_from", spy)
    one = go_on(world, tmp_path / "one", settings(iterations=1, virtual__continued_probability=1.0, virtual__stop=1.0))
    assert seen == ["recorded", "virtual"]
    old, new = fit.load_model(world["plain"]), fit.load_model(one)
    assert len(new.table) > len(old.table)  # Gaussians at surfaces that only virtual views show
    moved = torch.cdist(old.table["means"], new.table["means"]).amin(1)
    assert float(moved.detach().median()) < 0.02
    assert new.facts["method"] == "mudg_s" and new.facts["scene"] == old.facts["scene"]
    state = store.read_json(one / "run.json")
    assert (state["inputs"]["start"], state["summary"]["steps"]) == (store.digest(world["plain"]), 1)


def test_few_more_steps_help_beside_the_path_and_are_the_second_half_of_a_run(world, tmp_path, monkeypatch):
    assert (
        mean_psnr(go_on(world, tmp_path / "fit", settings(iterations=40)), SIZE, 2.0)
        > mean_psnr(world["plain"], SIZE, 2.0) + 0.3
    )
    config = continued.whole_run(settings(iterations=500))
    assert (config.iterations, continued.begun_at(config.iterations)) == (1000, 500)
    assert config.virtual.probability == FitConfig().virtual.continued_probability
    schedule = fit.densify_schedule(config)
    assert schedule.due(600) and not schedule.due(601 + schedule.every)


def test_a_resumed_run_equals_an_uninterrupted_one(world, tmp_path):
    whole, parts = go_on(world, tmp_path / "whole"), tmp_path / "parts"
    for stop in (17, 18, 20, 25):  # of the steps 17 to 32; densification after 20
        with interrupted(stop):
            go_on(world, parts)
        assert (parts / "steps" / f"step_{stop:08d}").is_dir()
    assert fitted_bytes(go_on(world, parts)) == fitted_bytes(whole)


def test_another_start_is_another_fit_and_one_without_virtual_views_goes_on_too(world, tmp_path):
    go_on(world, tmp_path / "fit", settings(iterations=2))
    with pytest.raises(UsageError, match="another configuration"):
        go_on(world, tmp_path / "fit", settings(iterations=2), start_from=None)
    made = go_on(world, tmp_path / "plain", settings("street_gaussians", iterations=4), observations=())
    assert fit.load_model(made).facts["method"] == "street_gaussians"


# ---- what is carried over ------------------------------------------------------------------------


def test_classes_that_only_virtual_views_show_are_added(world):
    model = fit.load_model(world["plain"])
    wanted = tuple(sorted({*model.classes, ID["bicycle"]}))
    wider = continued.with_classes(model, wanted)
    assert wider.classes == wanted and wider.table["semantics"].shape[1] == len(wanted)
    for channel, train_id in enumerate(wanted):
        column = wider.table["semantics"][:, channel].detach()
        if train_id in model.classes:
            assert torch.equal(column, model.table["semantics"][:, model.classes.index(train_id)].detach())
        else:
            assert (column == continued.NEW_CLASS_LOGIT).all()
    assert continued.with_classes(model, model.classes) is model


def test_learnt_corrections_of_cameras_are_kept(world, tmp_path):
    changes = {"appearance__cameras": True, "appearance__exposure": "camera"}
    plain = fit_to(world, tmp_path / "plain", settings("street_gaussians", iterations=12, **changes)).run()
    learnt = store.read_tensors(plain / "appearance.safetensors")
    start, names = continued.StartFit(plain, ""), store.read_json(plain / "appearance.json")["names"]
    kept = continued.continued_appearance(start, Appearance(names))
    assert torch.equal(kept.tables["cameras"]["shift"], learnt["cameras/column.shift"])
    assert learnt["cameras/column.shift"].abs().max() > 0
    other = continued.continued_appearance(start, Appearance({"cameras": ("front/999999",)}))
    assert other.tables["cameras"]["shift"].abs().max() == 0
    go_on(world, tmp_path / "more", settings(iterations=2, **changes), start_from=plain)


# ---- what is refused -----------------------------------------------------------------------------


def test_another_scene_cloud_or_method_is_refused(world, tmp_path):
    other = write_scene(tmp_path / "scene", frames=FRAMES - 1, width=SIZE[0], height=SIZE[1]).root
    refused(r"belongs to another scene[\s\S]*inputs.scene", go_on, {**world, "scene": Path(other)}, tmp_path / "a")
    write_fused(tmp_path / "fuse", fused_cloud(FRAMES - 1), {})
    with pytest.raises(InputError, match=r"another fused cloud[\s\S]*fit street_gaussians to this fused cloud"):
        go_on({**world, "fuse": tmp_path / "fuse"}, tmp_path / "b")
    guided = go_on(world, tmp_path / "guided", settings(iterations=1))
    refused(r"on recorded views[\s\S]*street_gaussians[\s\S]*mudg_s", go_on, world, tmp_path / "c", start_from=guided)
    assert not any((tmp_path / name).exists() for name in "abc")


def test_what_is_no_finished_fit_is_refused(world, tmp_path):
    for folder in (world["fuse"], world["scene"], tmp_path / "nothing"):
        refused("no fitted scene", go_on, world, tmp_path / "fit", start_from=folder)
    unfinished = shutil.copytree(world["plain"], tmp_path / "unfinished")
    state = store.read_json(unfinished / "run.json")
    store.write_json(unfinished / "run.json", {**state, "state": "interrupted"})
    refused("interrupted", go_on, world, tmp_path / "fit", start_from=unfinished)
    with pytest.raises(UsageError, match=r"spherical harmonics[\s\S]*--sh-degree 0"):
        go_on(world, tmp_path / "fit", settings(sh_degree=1))
    refused("the output is also an input", go_on, world, world["plain"], raises=UsageError)
