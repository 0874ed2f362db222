"""Short fits of training cities: the scene that is fitted, and the whole way from a city to a model that takes
renders."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from toy_clips import tiny, with_settings

from mudg import native
from mudg.core import metrics
from mudg.diffusion import city_clips, clips, learn, model_files, models
from mudg.diffusion.city_clips import CityClipRules
from mudg.diffusion.model import MDM
from mudg.diffusion.parallel import Ranks
from mudg.scene.labels import read_label
from mudg.scene.read import read_image, read_points, read_scene
from mudg.scene.write import write_photos
from mudg.steps.synthesize import Learn

pytestmark = pytest.mark.skipif(native.library() is None, reason="the native library is not built")
RULES = CityClipRules(width=48, height=32, window=2, clips=2, fitted=True)


@pytest.mark.parametrize("realism", [pytest.param("plain", marks=pytest.mark.slow), "varied"])
def test_the_scene_of_a_log_holds_what_its_clips_may_know(tmp_path, realism):
    rules = replace(RULES, realism=realism)
    log = city_clips.make_log(rules, 3, 5)
    images = city_clips.given_images(rules, 3, log)
    sweeps = city_clips.placed_sweeps(log)
    write_photos(tmp_path / "scene", log.world.source(), log.world.ego_path(), log.tracks(), images, sweeps)
    scene = read_scene(tmp_path / "scene")
    left = {(photo.view.camera.name, round(photo.view.time_s, 6)): photo for photo in images}
    for frame in scene.frames:
        photo = left.pop((frame.view.camera.name, round(frame.view.time_s, 6)))
        assert np.array_equal(read_image(scene, frame), photo.rgb)
        assert np.allclose(frame.view.world_from_cam, photo.view.world_from_cam)
        assert frame.view.camera == photo.view.camera
        if photo.semantics is not None:
            assert np.array_equal(read_label(scene, frame, "semantics"), photo.semantics)
    assert not left and len(scene.frames) == len(images)
    assert {track.id for track in scene.tracks} == {track.id for track in log.tracks()}
    written = sorted((s.time_s, len(read_points(scene, s).xyz)) for s in scene.sweeps)
    assert written == sorted((s.time_s, len(s.points.xyz)) for s in log.sweeps)


@pytest.mark.parametrize(("renders", "wanted"), [(True, True), (False, True), (True, False)])
def test_a_model_that_uses_no_renders_needs_no_fits(tmp_path, monkeypatch, renders, wanted):
    config, made = tiny(tmp_path), []
    config = replace(config, data=replace(config.data, renders=wanted))
    model = MDM(replace(models.model_config(config), renders=renders, finish_widths=(), finish_blocks=()))
    monkeypatch.setattr(learn, "making_clips", lambda source, folder, rules: made.append(rules))
    learn.open_clips(config, model, tmp_path, Ranks(0, 1, torch.device("cpu")))
    assert made[0].fitted == (renders and wanted)


def test_only_cities_with_renders_add_renders_and_a_finisher(tmp_path):
    from_cities, _ = models.starting_model(tiny(tmp_path))
    assert from_cities.config.renders and from_cities.finisher is not None
    model, _ = models.starting_model(tiny(tmp_path, scenes=("log",)))
    assert not model.config.renders and model.finisher is None
    model_files.save(model, tmp_path / "plain", "", {})
    model_files.save(from_cities, tmp_path / "rendered", "", {})
    on_a_log = tiny(tmp_path, scenes=("log",), start=str(tmp_path / "plain"))
    assert models.starting_model(on_a_log)[1] == set()
    kept, fresh = models.starting_model(with_settings(on_a_log, start=str(tmp_path / "rendered")))
    assert kept.config == from_cities.config and not fresh
    grown, fresh = models.starting_model(tiny(tmp_path, start=str(tmp_path / "plain")))
    assert grown.config == from_cities.config and fresh == {"finisher"}


def test_steps_of_fits_are_drawn_from_their_range(tmp_path):
    rules = replace(RULES, fit_steps=(400, 1000))
    steps = [city_clips.steps_of(rules, city) for city in range(60)]
    assert 400 <= min(steps) < 450 and 950 < max(steps) < 1000
    assert city_clips.steps_of(rules, city_clips.HELD_OUT) == 700
    assert city_clips.steps_of(replace(rules, fit_steps=(50, 50)), 3) == 50
    assert [city_clips.steps_of(RULES, city) for city in range(3)] == [117, 116, 113]  # as before there was a setting
    config = with_settings(tiny(tmp_path), fit_steps=(400, 1000), log_frames=24, side_cameras=0.7)
    made = learn.city_rules(config)
    assert (made.fit_steps, made.log_frames, made.side_cameras) == ((400, 1000), 24, 0.7)


@pytest.mark.slow
def test_a_city_is_fitted_and_learnt_from(tmp_path):
    """From the generator over a short fit to a trained model with finisher; the renders resemble what they show."""
    rules = replace(RULES, fit_steps=(60, 100))
    for city in (0, city_clips.HELD_OUT):
        written = city_clips.write_city(rules, city, tmp_path / "clips")
        assert written == (2 if city == 0 else len(city_clips.shifts_of(RULES, city)))
    shifted = clips.ShardFolder(tmp_path / "clips").clip(0, 0, [0, 1])
    shown = shifted.condition.renders
    assert float(metrics.psnr(shown.color, shifted.rgb)) > 12
    assert float(shown.alpha.mean()) > 0.2 and float(shown.certainty.max()) > 0.1
    assert bool((shown.certainty <= shown.alpha + 1 / 255).all())
    solid = (shown.alpha > 0.9) & (shifted.depth < 60)
    assert float(((shown.depth - shifted.depth).abs() / shifted.depth)[solid].median()) < 0.3
    config = tiny(tmp_path / "clips", cities=1, first_cities=1, window=2, steps=2, batch_frames=2, seed=0)
    made = Learn(out=tmp_path / "run", settings=config).run()
    model = model_files.load(made)
    assert model.finisher is not None and model.config.renders
    assert "fine_rgb" in (tmp_path / "run" / "log.jsonl").read_text()
    assert json.loads((made / "model.json").read_text())["facts"]["held_out"]["clips"] > 0
