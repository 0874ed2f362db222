"""Training: resume is invisible, schedules and settings are what they say, bad numbers never reach the weights."""

import json
from dataclasses import replace
from pathlib import Path

import pytest
import torch
import yaml
from tiny_networks import hide, small_mdm
from toy_clips import WINDOW, interrupted_at, tiny, with_settings, write_clips

from mudg.base import checkpoint
from mudg.base.config import load
from mudg.base.errors import InputError, NumericsError, ResourceError, UsageError
from mudg.diffusion import city_clips, learn, model_files, models
from mudg.diffusion.clips import ShardFolder, class_weights
from mudg.diffusion.model import MDM
from mudg.diffusion.parallel import TrainingState
from mudg.diffusion.requests import GeneratedClip
from mudg.diffusion.settings import LearnConfig, LearnData, LearnNetwork
from mudg.steps.synthesize import Learn


@pytest.fixture(scope="module")
def clips(tmp_path_factory):
    return write_clips(tmp_path_factory.mktemp("clips"))


@pytest.fixture(scope="module")
def whole(clips, tmp_path_factory):
    """The model of an undisturbed run."""
    return Learn(out=tmp_path_factory.mktemp("whole") / "run", settings=tiny(clips, checkpoint_every=100)).run()


def weights(folder):
    return model_files.load(folder).state_dict()


def test_an_interrupted_run_saves_its_step_and_continues_bit_for_bit(clips, whole, tmp_path):
    config = tiny(clips, checkpoint_every=100)
    with interrupted_at(1), pytest.raises(KeyboardInterrupt):
        Learn(out=tmp_path / "parts", settings=config).run()
    saved = checkpoint.latest(tmp_path / "parts" / "steps")
    assert saved is not None and saved.step == 2  # the step that was under way was finished
    assert json.loads((tmp_path / "parts" / "run.json").read_text())["state"] == "interrupted"
    assert not (tmp_path / "parts" / "model").exists()
    # how often is written down may change
    parts = Learn(out=tmp_path / "parts", settings=with_settings(config, log_every=1)).run()
    first, second = weights(whole), weights(parts)
    assert all(torch.equal(first[name], second[name]) for name in first)
    scores = [json.loads((p.parent / "metrics.json").read_text()) for p in (whole, parts)]
    assert scores[0] == scores[1]
    assert json.loads((parts / "model.json").read_text())["facts"]["held_out"]["clips"] == 2
    assert "held-out" in (parts / "MODEL_CARD.md").read_text().lower()
    assert (parts.parent / "samples" / "0000004.png").stat().st_size > 1000
    assert Learn(out=tmp_path / "parts", settings=with_settings(config, log_every=1)).run() == parts  # used again


def test_training_continues_from_a_model(clips, whole, tmp_path):
    second = Learn(out=tmp_path / "second", settings=tiny(clips, start=str(whole), seed=1)).run()
    before, after = weights(whole), weights(second)
    assert all(torch.equal(before[n], after[n]) for n in before if n.startswith("codec."))
    assert any(not torch.equal(before[n], after[n]) for n in before if n.startswith("net."))
    assert json.loads((second / "model.json").read_text())["facts"]["continued_from"]["recipe"]["steps"] == 4
    for name, changes, error, said in (
        ("third", {"widths": (32, 32)}, UsageError, "another kind"),
        ("second", {"seed": 2}, UsageError, "another configuration"),  # an unfinished run, too, is of its settings
        ("fourth", {"width": 96, "height": 64}, InputError, "another size"),
    ):
        with pytest.raises(error, match=said):
            Learn(out=tmp_path / name, settings=tiny(clips, start=str(whole), **changes)).run()
    with pytest.raises(ResourceError, match="no training clips arrived"):
        ShardFolder(tmp_path, patience_s=0.0).path(1)


def test_class_weights_lift_rare_classes(clips):
    assert torch.equal(class_weights(ShardFolder(clips), range(2), 0.0), torch.ones(19))
    weight = class_weights(ShardFolder(clips), range(2), 0.5)
    assert float(weight[13]) > float(weight[0])


def test_numbers_that_are_not_finite_are_named_and_kept_out(clips, tmp_path):
    with pytest.raises(NumericsError, match=r"network(.|\n)*step \d"):
        Learn(out=tmp_path / "run", settings=tiny(clips, lr=1e30, steps=20, checkpoint_every=1)).run()
    saved = checkpoint.latest(tmp_path / "run" / "steps")
    if saved is not None:
        assert saved.step < 20


@pytest.mark.slow
def test_learning_on_the_same_few_clips_lowers_the_loss(clips, tmp_path):
    out = tmp_path / "run"
    Learn(out=out, settings=tiny(clips, steps=30, lr=3e-3, checkpoint_every=100, batch_frames=8, log_every=10)).run()
    totals = [json.loads(line) for line in (out / "log.jsonl").read_text().splitlines()]
    totals = [entry["total"] for entry in totals if "total" in entry]
    assert totals[-1] < 0.95 * totals[0]  # measured: 0.90


def test_cities_that_are_skipped_are_never_drawn(clips):
    config = with_settings(tiny(clips, cities=2, first_cities=2), skip_cities=1, augment=False)
    source = learn.clips_of_cities(config, clips)
    allowed = [ShardFolder(clips).clip(city, k, range(4)).rgb for city in (1, 2) for k in range(2)]
    drawn = [clip.rgb for step in range(8) for clip in source.draw(step, 2, 4, "batch")]
    assert all(any(torch.equal(one, rgb) for rgb in allowed) for one in drawn)
    assert all(any(torch.equal(one, rgb) for one in drawn) for rgb in allowed)


def test_schedules(clips):
    config = tiny(clips, steps=1000, warmup_steps=100, decay_share=0.5, lr=1e-3, cities=3, first_cities=1)
    assert learn.learning_rate(config, 0) == pytest.approx(1e-5)
    assert learn.learning_rate(config, 300) == pytest.approx(1e-3)
    assert learn.learning_rate(config, 750) == pytest.approx(5e-4)
    assert learn.learning_rate(config, 999) == pytest.approx(2e-5)
    source, later = (learn.clips_of_cities(with_settings(config, skip_cities=n), clips) for n in (0, 2))
    assert [source.in_use(0), source.in_use(600), later.in_use(600)] == [range(1), range(3), range(2, 5)]
    assert [learn.frames_at(config, s) for s in (0, 499, 500)] == [2, 2, 4]
    constant = tiny(clips, steps=100, warmup_steps=0, last_lr_share=1.0, lr=1e-5)
    assert {learn.learning_rate(constant, step) for step in range(100)} == {1e-5}
    config = with_settings(tiny(clips), first_cities=40)  # fewer than training begins with are not waited for
    assert config.data.cities < config.data.first_cities
    assert learn.clips_of_cities(config, clips).weighed() == range(config.data.cities)


def test_perfect_samples_score_perfectly_and_confidence_ranks(clips):
    clip = ShardFolder(clips).clip(city_clips.HELD_OUT, 0, range(WINDOW))
    depth = clip.depth.clamp(max=100.0)
    sample = GeneratedClip(clip.rgb, depth, clip.semantics, torch.ones_like(depth), {})
    row, counts = models.score_clip(clip, sample)
    assert row["psnr"] == float("inf")
    assert row["abs_rel"] == pytest.approx(0.0, abs=1e-6)
    assert row["sharpness"] == pytest.approx(1.0)
    assert row["sky_near"] == 0.0
    assert row["edges_agree"] == 1.0
    assert int(counts[:, :-1].diagonal().sum()) == int(counts.sum())
    error = torch.linspace(0, 1, 1000)
    assert models.auc(1 - error, error) > 0.99
    assert models.auc(error, error) < 0.01
    assert models.auc(torch.ones(1000), error) == pytest.approx(0.5)


# -- settings ---------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def large_clips(tmp_path_factory):
    return write_clips(tmp_path_factory.mktemp("large"), 96, 64)


@pytest.fixture(scope="module")
def unrefined(tmp_path_factory):
    """A model without refiner, of another network than the settings describe by default."""
    model = MDM(small_mdm(refine_widths=(), refine_blocks=(), window=WINDOW, area_px=192 * 128))
    models.draw_weights(model.net, 3, "weights")
    models.draw_weights(model.codec, 3, "codec")
    folder = tmp_path_factory.mktemp("unrefined") / "model"
    model_files.save(model, folder, "card", {})
    return folder


def test_the_second_stage_takes_over_everything_at_another_size(large_clips, whole, tmp_path):
    config = tiny(
        large_clips, start=str(whole), steps=1, width=96, height=64, frozen="temporal_transformers", average_decay=0
    )
    begun, fresh = models.starting_model(config)
    before, start = model_files.load(whole).state_dict(), begun.state_dict()
    assert not fresh
    assert all(torch.equal(before[name], start[name]) for name in before)
    after = model_files.load(Learn(out=tmp_path / "two", settings=config).run()).state_dict()
    kept = {name for name in before if name.startswith("codec.") or ".temporal." in name}
    assert kept > {n for n in before if n.startswith("codec.")}
    assert all(torch.equal(before[name], after[name]) for name in kept)
    for name in ("net.enter.weight", "net.label.0.weight", "net.leave.weight", "refiner.leave.weight"):
        assert not torch.equal(before[name], after[name]), name
    assert not list((tmp_path / "two" / "steps").glob("*/average.*"))  # no average was asked for


def test_frozen_layers_need_some_to_freeze(clips):
    model = MDM(models.model_config(tiny(clips, temporal_attention=(False, False))))
    with pytest.raises(UsageError, match="nothing to freeze"):
        models.freeze(model, "temporal_transformers")
    other = MDM(models.model_config(tiny(clips)))
    count = models.freeze(other, "temporal_layers")
    frozen = {n for n, p in other.net.named_parameters() if not p.requires_grad}
    assert frozen == {n for n, _ in other.net.named_parameters() if ".temporal." in n}
    assert count == sum(p.numel() for n, p in other.net.named_parameters() if n in frozen)


def test_an_embedded_kind_of_network_need_not_be_described_again(unrefined, clips, tmp_path):
    config = replace(tiny(clips, start=str(unrefined), steps=2, log_every=1, augment=False), network=LearnNetwork())
    model = model_files.load(Learn(out=tmp_path / "run", settings=config).run())
    assert model.config == replace(model_files.load(unrefined).config, area_px=48 * 32)


def test_tensorboard_is_asked_for_in_words(clips, tmp_path, monkeypatch):
    hide(monkeypatch, "tensorboard")
    with pytest.raises(ResourceError, match=r"pip install 'mudg\[track\]'"):
        Learn(out=tmp_path / "run", tensorboard=True, settings=tiny(clips)).run()
    assert not (tmp_path / "run").exists()


def test_moments_of_another_model_are_refused(clips, whole, tmp_path):
    """A checkpoint whose tensors do not fit is named, not half loaded."""
    saved = checkpoint.latest(whole.parent / "steps")
    model = MDM(models.model_config(tiny(clips, widths=(16, 64))))
    trained = model.trained_part()
    state = TrainingState(trained, torch.optim.AdamW(trained.parameters()), None)
    with pytest.raises(checkpoint.IntegrityError, match="does not fit"):
        state.load(saved)


def recipes(facts):
    """Every recipe that a shipped model tells of, its predecessors' too."""
    for name, value in facts.items():
        if name == "recipe":
            yield value
        elif isinstance(value, dict):
            yield from recipes(value)


@pytest.mark.parametrize("name", sorted(model_files.EMBEDDED))
def test_the_recipes_of_the_shipped_models_and_the_manual_are_settings_files(name, tmp_path):
    told = list(recipes(model_files.facts(name)))
    assert told
    for recipe in told:
        (tmp_path / "recipe.yaml").write_text(yaml.safe_dump(recipe))
        config = load(LearnConfig, None, tmp_path / "recipe.yaml")
        assert config.steps == recipe["steps"] and config.data.cities == recipe["data"]["cities"]
    network = models.model_config(config)
    assert network.widths == model_files.load(name).config.widths
    text = (Path(__file__).parents[1] / "docs" / "training" / "published.md").read_text()
    (tmp_path / "stage1.yaml").write_text(text.partition("`stage1.yaml`:")[2].split("```yaml\n")[1].split("```")[0])
    manual = load(LearnConfig, None, tmp_path / "stage1.yaml")
    assert manual.optimizer.betas == (0.9, 0.999) and manual.compute.recompute and not manual.data.augment


def test_a_step_has_clips_of_one_size(tmp_path) -> None:
    config = LearnConfig(data=LearnData(realism="varied"))
    source = learn.clips_of_cities(config, tmp_path)
    sizes = source.sizes
    assert len(set(sizes)) == 5
    for cities in (range(3), range(7), range(40), range(5, 12), range(8, 21)):
        for first in cities:
            for city in cities:
                chosen = source.of_same_size(city, first, cities)
                assert chosen in cities
                assert sizes[chosen % 5] == sizes[first % 5]
    assert learn.clips_of_cities(LearnConfig(), tmp_path).sizes == [(192, 128)]
    assert len(learn.clips_of_cities(config, tmp_path, points_alone=True).sizes) == 1
