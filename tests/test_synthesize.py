"""synthesize: every frame is made, windows join, interruptions leave no trace, sizes fit."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from fit_settings import fit_config
from refusals import refused
from tiny_networks import small_mdm
from toy_scene import ToyStreet

from mudg import app
from mudg.base import memory, palette
from mudg.base.errors import InputError, UsageError
from mudg.core import trajectory
from mudg.diffusion import condition, model_files, views
from mudg.diffusion.model import MDM
from mudg.diffusion.settings import SynthesizeConfig
from mudg.diffusion.views import ViewMaker, add_detail, windows
from mudg.gaussians import fit
from mudg.gaussians.rendering import FAR_M, render_condition, render_planes
from mudg.scene.observations import list_observation_sets, read_observations
from mudg.scene.read import read_scene
from mudg.scene.settings import FuseConfig
from mudg.steps.fit import Fit
from mudg.steps.ingest import Fuse
from mudg.steps.synthesize import Synthesize

FRAMES = 7


@pytest.fixture(scope="module")
def world(tmp_path_factory):
    """A made-up street as a scene, its fused cloud, and a tiny model with a window of four frames."""
    root = tmp_path_factory.mktemp("street")
    ToyStreet(times=[0.1 * n for n in range(FRAMES)]).write(root / "scene", width=96, height=64)
    Fuse(scene=root / "scene", out=root / "fused", settings=FuseConfig()).run()
    torch.manual_seed(0)
    model = MDM(small_mdm(refine_widths=(64, 128), refine_blocks=(2, 3)))
    model_files.save(model, root / "model", "", {})
    small = {"width_px": 48, "full_size": False, "precision": "float32", "processes": 1}
    config = SynthesizeConfig(cameras=("front",), shifts_m=(1.0,), model=str(root / "model"), steps=2, **small)
    return root, config


def made(world, out, fitted=None, **changes):
    (root, config), inputs = world, {"fitted": fitted} if fitted else {}
    settings = replace(config, **changes)
    return Synthesize(scene=root / "scene", fused=root / "fused", out=out, settings=settings, **inputs).run()


def frames_of(path):
    found = read_observations(path)
    return [found[i] for i in range(len(found))]


def same_frames(one, other, name="front_shift+1.0"):
    for index, (a, b) in enumerate(zip(frames_of(one / name), frames_of(other / name), strict=True)):
        assert torch.equal(a.rgb, b.rgb), index
        assert torch.equal(a.depth.nan_to_num(), b.depth.nan_to_num()), index
        assert torch.equal(a.semantics, b.semantics), index


@pytest.fixture(scope="module")
def usual(world, tmp_path_factory):
    """What the settings of ``world`` give."""
    return made(world, tmp_path_factory.mktemp("usual") / "out")


@pytest.fixture(scope="module")
def large(world, tmp_path_factory):
    """The same at the camera's size."""
    return made(world, tmp_path_factory.mktemp("large") / "out", full_size=True)


def test_every_frame_is_made(usual):
    out = usual
    sets = list_observation_sets(out)
    assert list(sets) == ["front_shift+1.0"]
    found = read_observations(sets["front_shift+1.0"])
    assert len(found) == FRAMES
    assert [round(v.time_s, 3) for v in found.views] == [round(0.1 * n, 3) for n in range(FRAMES)]
    assert float(found.views[3].center_world[1]) == pytest.approx(1.0)
    first = found[0]
    assert first.rgb.shape == (3, 32, 48)
    assert first.kind == "virtual"
    assert first.source == "mudg_r"
    assert float(first.confidence.max()) <= 1
    finite = torch.isfinite(first.depth)
    assert bool(finite.any())
    assert float(first.depth[finite].min()) > 0
    assert (out / "front_shift+1.0" / "overview.png").is_file()
    assert not (out / "front_shift+1.0" / "state").exists()


def test_interruption_leaves_no_trace(world, usual, tmp_path, monkeypatch):
    make = ViewMaker.make

    def stop_in_second_window(self, views, number, known):
        if number == 1:
            raise KeyboardInterrupt
        return make(self, views, number, known)

    monkeypatch.setattr(ViewMaker, "make", stop_in_second_window)
    with pytest.raises(KeyboardInterrupt):
        made(world, tmp_path / "parts")
    monkeypatch.setattr(ViewMaker, "make", make)
    refused(".", read_observations, tmp_path / "parts" / "front_shift+1.0")
    same_frames(usual, made(world, tmp_path / "parts"))


@pytest.mark.slow
def test_processes_give_the_same_as_one(world, tmp_path):
    one = made(world, tmp_path / "one", shifts_m=(1.0, -1.0))
    two = made(world, tmp_path / "two", shifts_m=(1.0, -1.0), processes=2)
    for name in ("front_shift+1.0", "front_shift-1.0"):
        same_frames(one, two, name)


def test_trajectories_share_what_was_read_and_prepared_and_nothing_changes(world, usual, tmp_path, monkeypatch):
    prepared, prepare = [], condition._prepare_source
    noted = lambda *given: prepared.append(given[1].view.time_s) or prepare(*given)
    monkeypatch.setattr(condition, "_prepare_source", noted)
    both = made(world, tmp_path / "both", shifts_m=(2.0, 1.0))
    assert len(prepared) == len(set(prepared)) > 1
    assert views.recorded_drive.cache_info().currsize == 0
    same_frames(both, usual)


def test_conditions_in_files_change_nothing(world, large, tmp_path, monkeypatch):
    mapped, map_array = [], memory.mapped_array
    monkeypatch.setattr(condition, "LARGE_PIXELS", 0)
    noted = lambda folder, *asked: mapped.append(folder) or map_array(folder, *asked)
    monkeypatch.setattr(memory, "mapped_array", noted)
    filed = made(world, tmp_path / "filed", full_size=True)
    first = read_observations(large / "front_shift+1.0")[2]
    assert first.rgb.shape[1:] == first.semantics.shape == (64, 96) and first.view.camera.width == 96
    assert set(mapped) == {filed}
    one, other = (sorted(p.relative_to(out) for p in out.rglob("*")) for out in (filed, large))
    assert one == other
    same_frames(large, filed)


@pytest.mark.parametrize("frames", [1, 3, 8, 9, 13, 24, 199])
@pytest.mark.parametrize("overlap", [0, 2, 7])
def test_windows_cover_every_frame(frames, overlap):
    spans = windows(frames, 8, overlap)
    assert spans[0].start == 0
    assert spans[-1].stop == frames
    assert sorted({i for span in spans for i in span}) == list(range(frames))
    for before, after in zip(spans, spans[1:]):
        assert before.stop - after.start >= overlap
        assert after.stop > before.stop
        assert len(after) == 8


def test_detail_is_given_back_where_the_sample_agrees():
    generator = torch.Generator().manual_seed(0)
    fine = torch.rand(2, 3, 32, 48, generator=generator)
    coarse = torch.nn.functional.interpolate(fine, size=(16, 24), mode="area")

    def stand_in(color):
        shape = (2, 1, *color.shape[-2:])
        return type("C", (), {"color": color, "valid": torch.ones(shape) > 0, "warped": torch.ones(shape) > 0})()

    full = add_detail(coarse, stand_in(coarse), stand_in(fine))
    assert torch.allclose(full, fine, atol=1e-4)
    changed = (coarse + 0.5).clamp(0, 1)
    other = add_detail(changed, stand_in(coarse), stand_in(fine))
    enlarged = torch.nn.functional.interpolate(changed, size=(32, 48), mode="bicubic", align_corners=False).clamp(0, 1)
    moved = (changed - coarse).abs().amax(1, keepdim=True) > 0.12
    untouched = -torch.nn.functional.max_pool2d(-moved.float(), 5, stride=1, padding=2) > 0
    untouched = torch.nn.functional.interpolate(untouched.float(), size=(32, 48)) > 0
    assert bool(untouched.any())
    assert torch.allclose((other * untouched), enlarged * untouched, atol=1e-5)


def test_bad_requests(world, tmp_path):
    refused("overlap", windows, 20, 8, 8, raises=UsageError)
    refused("no diffusion model", made, world, tmp_path / "a", model=str(tmp_path / "nowhere"))
    refused(".", made, world, tmp_path / "b", cameras=("roof",), raises=(InputError, UsageError))
    refused("nothing to synthesize", made, world, tmp_path / "c", shifts_m=(), raises=UsageError)
    refused("same trajectory", made, world, tmp_path / "d", shifts_m=(1.0, 1.01), raises=UsageError)


def test_further_paths_are_made_and_parts_of_the_condition_switched_off(world, usual, tmp_path):
    """What the parts are: `test_clips`."""
    out = made(world, tmp_path / "lane", shifts_m=(1.0,), paths=("lane+0.2",), condition="points")
    lane = read_observations(out / "front_lane+0.2")
    start = trajectory.recorded(read_scene(world[0] / "scene"), "front").views
    assert len(lane) == FRAMES
    moved = [round(float(np.linalg.norm(a.center_world - b.center_world)), 3) for a, b in zip(lane.views, start)]
    assert moved[:3] == [0.0, 0.2, 0.4]
    points, whole = (frames_of(folder / "front_shift+1.0")[2].rgb for folder in (out, usual))
    assert not torch.equal(points, whole)


def test_a_setting_that_the_model_does_not_take_ends_the_command(tmp_path, capsys):
    """Before any work: neither scene nor cloud is read, and nothing is written."""
    for folder, name in (("scene", "scene.json"), ("fused", "fuse.json")):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / name).write_text("{}")
    words = ["synthesize", str(tmp_path / "scene"), "--fused", str(tmp_path / "fused"), "--out", str(tmp_path / "out")]
    for flags, word in ((("--guidance", "3"), "guidance"), (("--memory-budget-gb", "3"), "memory-budget")):
        assert app.main([*words, *flags]) == 2
        assert word in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
    assert app.main([*words, "--eta", "0.5"]) == 3  # on to the next fault: no such scene


@pytest.fixture(scope="module")
def fitted(world, tmp_path_factory):
    """A short fit of the street, and a model that takes renders and has a finisher."""
    root, _ = world
    folder = tmp_path_factory.mktemp("fitted")
    settings = fit_config(method="street_gaussians", iterations=4, start__gaussians=900)
    scene = Fit(scene=root / "scene", fused=root / "fused", out=folder / "fit", settings=settings).run()
    config = replace(model_files.load(root / "model").config, renders=True, finish_widths=(8, 16), finish_blocks=(1, 1))
    model_files.save(MDM(config), folder / "model", "", {})
    return scene, folder / "model"


def test_renders_of_a_fitted_scene_as_planes(world, fitted):
    root, _ = world
    view = trajectory.shifted(read_scene(root / "scene"), "front", 1.0).views[2].resized(96, 64)
    model = fit.load_model(fitted[0])
    shown, made = render_planes(model, view), render_condition(model, view)
    solid = torch.isfinite(made.depth)
    assert shown.color.shape == (3, 64, 96) and shown.semantics.dtype == torch.uint8
    assert torch.equal(shown.depth[0][solid], made.depth[solid].clamp(max=FAR_M))
    assert bool((shown.depth[0][~solid] == FAR_M).all())
    assert torch.equal(shown.alpha[0][solid], made.alpha[solid]) and not bool(shown.alpha[0][~solid].any())
    assert bool((shown.certainty <= shown.alpha).all()) and float(shown.certainty.min()) >= 0
    assert bool(solid.any())
    assert float(shown.certainty.max()) > 0
    model.table.labels.pop("certainty")  # as a version that measured none would have fitted it
    unmeasured = render_planes(model, view)
    assert torch.equal(unmeasured.certainty, 0.5 * unmeasured.alpha)


def test_a_fitted_scene_is_part_of_the_condition(world, fitted, tmp_path, monkeypatch):
    """Its renders reach the model, and full-size views come from the finisher."""
    scene, model = fitted
    given, finished = [], []
    sample, finish = MDM.sample, MDM.finish
    sampled = lambda self, condition, *rest: (given.append(condition), sample(self, condition, *rest))[1]
    refined = lambda self, clip, fine, **more: (finished.append(fine), finish(self, clip, fine, **more))[1]
    monkeypatch.setattr(MDM, "sample", sampled)
    monkeypatch.setattr(MDM, "finish", refined)
    changes = {"model": str(model), "full_size": True, "steps": 1}
    seen = frames_of(made(world, tmp_path / "out", scene, **changes) / "front_shift+1.0")
    assert len(seen) == FRAMES and seen[0].rgb.shape == (3, 64, 96)
    assert all(c.renders is not None and c.renders.color.shape[-2:] == (32, 48) for c in given)
    assert all(c.renders is not None and c.renders.color.shape[-2:] == (64, 96) for c in finished)
    assert len(finished) == len(given) > 1
    sky = seen[0].semantics == palette.ID["sky"]
    assert bool((torch.isnan(seen[0].depth[0]) | ~sky | finished[0].valid[0, 0]).all())
    plain = made(world, tmp_path / "plain", **changes)  # works without a fit, too
    assert not torch.equal(seen[2].rgb, frames_of(plain / "front_shift+1.0")[2].rgb)


@pytest.mark.parametrize(("condition", "words"), [("full", "not trained with renders"), ("points", "switched off")])
def test_what_takes_no_fitted_scene(world, fitted, tmp_path, condition, words):
    """A model without renders, and a condition with parts switched off."""
    changes = {} if condition == "full" else {"model": str(fitted[1]), "condition": condition}
    refused(words, made, world, tmp_path / "out", fitted[0], raises=UsageError, **changes)
    assert not (tmp_path / "out").exists()
