"""Training the published-type network with `learn`: two stages, any layout, clips of points alone."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from test_learn_parallel import SAME, assert_same_training, both_run
from toy_clips import write_clips
from toy_published import published_settings, write_tiny
from toy_scene import ToyStreet

from mudg.base import palette
from mudg.base.errors import InputError, UsageError
from mudg.base.types import Condition
from mudg.diffusion import city_clips, convert, learn, log_clips, model_files, models
from mudg.diffusion import clips as clip_shards
from mudg.diffusion.condition import ConditionRules, DriveInputs, build_conditions
from mudg.diffusion.log_clips import LogClipRules, LogSource
from mudg.diffusion.model import BatchPart
from mudg.diffusion.published import PAPER_DROPOUT, ContextDropout
from mudg.diffusion.settings import SynthesizeConfig
from mudg.diffusion.views import recorded_images
from mudg.scene.settings import FuseConfig
from mudg.steps.ingest import Fuse
from mudg.steps.synthesize import Learn


@pytest.fixture(scope="module")
def clips(tmp_path_factory):
    return write_clips(tmp_path_factory.mktemp("clips"), 32, 32, points=True)


@pytest.fixture(scope="module")
def converted(tmp_path_factory):
    return write_tiny(tmp_path_factory.mktemp("converted"))


@pytest.fixture(scope="module")
def street(tmp_path_factory):
    root = tmp_path_factory.mktemp("street")
    ToyStreet(times=[0.1 * n for n in range(5)]).write(root / "scene", labels=False, width=72, height=48)
    Fuse(scene=root / "scene", out=root / "fuse", settings=FuseConfig()).run()
    return root


@pytest.fixture(scope="module")
def begun(converted, clips):
    """Settings of a training and the model that it begins with."""
    settings = published_settings(converted, clips)
    return settings, models.starting_model(settings)[0].eval()


def corner(clip):
    """The upper left 16x16 pixels: enough for a loss."""
    cut = lambda value, *names: {name: getattr(value, name)[..., :16, :16] for name in names}
    given = clip.condition
    condition = Condition(given.views, **cut(given, "color", "depth", "valid", "reference"))
    return replace(clip, condition=condition, **cut(clip, "rgb", "depth", "depth_valid", "semantics"))


def corners(settings, clips, *draw):
    return [corner(clip) for clip in learn.clips_of_cities(settings, clips, points_alone=True).draw(*draw)]


@pytest.mark.slow
def test_two_stages_from_a_converted_model(converted, clips, tmp_path):
    """Stage 1 moves all of the network; stage 2, larger, all but the temporal transformers."""
    one = Learn(out=tmp_path / "one", settings=published_settings(converted, clips, steps=1, batch_frames=4)).run()
    large = write_clips(tmp_path / "large", 36, 32, points=True)
    config = published_settings(
        one, large, width=36, height=32, frozen="temporal_transformers", steps=1, batch_frames=4
    )
    begun, fresh = models.starting_model(config)
    first, start = (model_files.load_published(folder).state_dict() for folder in (converted, one))
    assert not fresh
    assert all(torch.equal(value, start[name]) for name, value in begun.state_dict().items())  # the modality label too
    two = Learn(out=tmp_path / "two", settings=config).run()
    last = model_files.load_published(two)
    end = last.state_dict()
    trained = {name for name in first if name.startswith(("net.", "image_tokens."))}
    temporal = begun.temporal_parameters("transformers")
    assert {name for name in first if not torch.equal(first[name], start[name])} == trained
    assert {name for name in first if not torch.equal(start[name], end[name])} == trained - temporal
    assert temporal and not any(name.startswith("net.first.") or ".res" in name for name in temporal)
    for state in (start, end):  # learnt, and never that of the noise step
        assert not torch.equal(state["net.label.0.weight"], first["net.label.0.weight"])
        assert not torch.equal(state["net.label.0.weight"], state["net.time.0.weight"])
    assert (last.config.width, last.config.height) == (36, 32)
    assert torch.equal(last.schedule.scale, model_files.load_published(converted).schedule.scale)
    assert (two / "MODEL_CARD.md").read_text().rstrip().endswith(convert.LICENCE)
    assert json.loads((two.parent / "metrics.json").read_text())["clips"] == 1


def test_the_card_of_a_trained_model_says_how_it_was_trained(begun, clips, monkeypatch):
    settings, model = begun
    monkeypatch.setattr(models, "table", lambda scores: "a table")
    source = learn.clips_of_cities(settings, clips, points_alone=True)
    card = models.model_card(model, source, {"clips": 1, "steps": 2})
    said = f"reference left out in {settings.data.reference_dropout:.0%} of the clips."
    assert said in card and f"Continued from {settings.start}" in card and "a table" in card


def test_the_loss_of_a_batch_is_the_mean_of_its_parts(begun, clips):
    """With dropout inside the network on; terms too, and they have the same names in every part."""
    settings, model = begun
    model.trained_part().train()

    @torch.no_grad()
    def losses(step, part):
        drawn = corners(settings, clips, step, 2, 4, "batch", part)
        return model(drawn, BatchPart(settings.seed, step, part.start, 2))

    for step in range(2):
        whole, parts = losses(step, slice(0, 2)), [losses(step, slice(n, n + 1)) for n in (0, 1)]
        assert all(list(part.terms) == list(whole.terms) for part in parts)
        for name, value in {**whole.terms, "total": float(whole.total)}.items():
            mean = sum(float({**p.terms, "total": p.total}[name]) for p in parts) / 2
            assert mean == pytest.approx(value, rel=SAME)
    again = losses(1, slice(0, 2)).total
    assert torch.equal(again, whole.total)
    model.eval()
    assert abs(float(losses(1, slice(0, 2)).total) / float(again) - 1) > 1e-3  # dropout did something


def test_unknown_truth_has_no_part_in_the_loss(begun, clips):
    settings, model = begun
    drawn = corners(settings, clips, 0, 4, 4, "batch")
    nothing = [
        replace(clip, depth_valid=torch.zeros_like(clip.depth_valid), semantics=torch.full_like(clip.semantics, 255))
        for clip in drawn
    ]
    with torch.no_grad():
        terms, without = (model(some, BatchPart(0, 0, 0, 4)).terms for some in (drawn, nothing))
    assert {"depth", "semantics"} & set(terms)
    assert all(terms[m] > 0 and without[m] == 0 for m in ("depth", "semantics") if m in terms)


@pytest.mark.slow
def test_two_processes_give_the_losses_of_one(converted, clips, tmp_path):
    """With frozen layers, and blocks that are computed again."""
    common = {"frozen": "temporal_transformers", "steps": 3}
    Learn(out=tmp_path / "one", settings=published_settings(converted, clips, **common)).run()
    both_run("learn_published_together.py", tmp_path / "store", converted, clips, tmp_path / "both")
    assert_same_training(tmp_path / "one", tmp_path / "both", (1, 2, 3), model_files.load_published)


def test_shares_of_missing_references_are_those_of_paper_and_release():
    assert ContextDropout.for_reference(0.2) == PAPER_DROPOUT
    assert ContextDropout.for_reference(0.1) == ContextDropout(0.05, 0.05, 0.05)  # as the released training code
    assert ContextDropout.for_reference(0.0) == ContextDropout(0.05, 0.0, 0.0)


def test_frame_0_shows_the_reference_also_where_the_tokens_go_without(begun, clips):
    settings, model = begun
    (clip,) = corners(settings, clips, 0, 1, 4, "batch")
    other = replace(clip, condition=replace(clip.condition, reference=1 - clip.condition.reference))
    part = BatchPart(0, 0, 0, 1, reference_dropout=1.0)
    with torch.no_grad():
        loss, again, changed = (float(model([one], part).total) for one in (clip, clip, other))
    assert loss == again != changed


def test_what_does_not_fit_is_refused_in_words(converted, clips, tmp_path):
    length = r"exactly the length(.|\n)*--data.window 4 --optimizer.full-window-share 1"
    for wrong, said in (
        ({"window": 8}, length),
        ({"full_window_share": 0.5}, length),
        ({"width": 50}, "multiples of 4"),
        ({"widths": (16, 32, 64)}, "cannot be changed"),
        ({"frozen": "denoiser"}, "without a refiner"),
    ):
        with pytest.raises(UsageError, match=said):
            Learn(out=tmp_path / said[:8], settings=published_settings(converted, clips, **wrong)).run()
    warped = write_clips(tmp_path / "warped", 32, 32)
    with pytest.raises(InputError, match="warped images"):
        Learn(out=tmp_path / "other", settings=published_settings(converted, warped)).run()


# clips --------------------------------------------------------------------------------------------


def test_clips_of_logs_show_points_alone(street, tmp_path):
    """The condition is the one that `synthesize` builds for the published model, and survives the disk."""
    rules = LogClipRules(width=48, height=32, window=4, stride=4, held_out_every=0, published=True)
    log = log_clips.OpenLog(LogSource(street / "scene", street / "fuse"), rules)
    window = rules.windows(log.scene)[0]
    held = window._replace(held_out=True)  # all points are kept
    clip = log_clips.make_clip(log, held, 0)
    recorded = recorded_images(log.scene, SynthesizeConfig(given_classes=False))
    views = [log.frame(name).view for name in window.frames]
    conditions = ConditionRules(48, 32, 72, 48, published=True)
    wanted = build_conditions(DriveInputs(log.cloud, log.scene.tracks, recorded), views, conditions)[0]
    for name in ("color", "depth", "valid", "reference"):
        assert torch.equal(getattr(clip.condition, name), getattr(wanted, name)), name
    assert float((clip.condition.reference - clip.rgb[0]).abs().mean()) < 0.03  # frame 0's own image
    clip_shards.write_shard(tmp_path, 0, [clip], gaps=True)
    read = clip_shards.ShardFolder(tmp_path).clip(0, 0, range(4))
    given, filled = read.condition, read.depth[~read.depth_valid]
    assert torch.allclose(given.depth, wanted.depth, rtol=1e-3, atol=1e-3)
    assert bool((given.depth == 0).any()) and not bool(given.warped.any())
    assert torch.allclose(given.color, wanted.color, atol=1 / 500)
    points = wanted.measured
    # depth that was measured, none mixed with gaps
    assert torch.isin(filled, points.depth[points.valid].half().float()).all()
    assert torch.equal(given.measured.valid, points.valid)
    assert torch.allclose(given.measured.depth[points.valid], points.depth[points.valid], rtol=1e-3)
    cut = given.cropped(slice(3, 9), slice(1, 8)).measured
    assert torch.equal(cut.depth, given.measured.depth[..., 3:9, 1:8])
    varied = (clip_shards.vary(read, np.random.default_rng(n)) for n in range(20))
    seen = next(one for one in varied if not torch.equal(one.depth, read.depth))
    assert torch.equal(seen.condition.measured.depth, given.measured.depth.flip(-1))
    thinner = log_clips.make_clip(log, window, 0)
    assert not torch.equal(thinner.condition.depth, clip.condition.depth)  # to train on: a share of the points


def test_a_folder_of_clips_is_known_by_its_condition(street, tmp_path):
    sources = [LogSource(street / "scene", street / "fuse")]
    rules = LogClipRules(width=48, height=32, window=4)
    log_clips.claim_folder(tmp_path, rules, sources)
    assert "published" not in json.loads((tmp_path / log_clips.INDEX).read_text())["rules"]
    with pytest.raises(UsageError, match="other logs or settings"):
        log_clips.claim_folder(tmp_path, replace(rules, published=True), sources)


def test_clips_of_cities_show_points_alone_and_are_as_long_as_asked():
    rules = city_clips.CityClipRules(width=48, height=32, window=16, clips=1, published=True)
    assert rules.frames == 18 and city_clips.CityClipRules().frames == city_clips.FRAMES
    log = city_clips.make_log(replace(rules, width=24, height=16), 0, rules.frames)
    (clip,) = city_clips.make_clips(replace(rules, width=24, height=16), 0, log)
    condition = clip.condition
    assert len(clip.rgb) == 16 and condition.warped is None
    sky = (clip.semantics == palette.ID["sky"])[:, None]
    assert bool(sky.any()) and bool(clip.depth_valid[sky].all()) and bool((clip.depth[sky] == clip_shards.FAR_M).all())
    empty = ~condition.valid
    assert bool(empty.any()) and float((condition.depth * empty).abs().max()) == 0
    assert float((condition.color * empty).abs().max()) == 0
    found = np.stack([r.rgb for r in log.recorded if r.view.time_s == condition.views[0].time_s][:1])
    small = torch.nn.functional.interpolate(
        torch.from_numpy(found).permute(0, 3, 1, 2).float() / 255, size=(16, 24), mode="bilinear", align_corners=False
    )
    assert torch.allclose(condition.reference, small[0], atol=1e-6)
