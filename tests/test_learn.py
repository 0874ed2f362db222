"""Training: resume is invisible, schedules are what they say, bad numbers never reach the weights."""

import json

import pytest
import torch
from toy_clips import WINDOW, interrupted_at, tiny, with_settings, write_clips

from mudg.base import checkpoint
from mudg.base.errors import NumericsError, ResourceError, UsageError
from mudg.diffusion import city_clips, learn, model_files, score
from mudg.diffusion.clips import await_shard, class_weights, read_clip
from mudg.diffusion.requests import GeneratedClip
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


def test_outputs_and_reuse(clips, tmp_path):
    out = tmp_path / "run"
    model_folder = Learn(out=out, settings=tiny(clips, score_every=4)).run()
    assert (out / "samples" / "0000004.png").stat().st_size > 1000
    assert (out / "loss.png").is_file()
    content = json.loads((model_folder / "model.json").read_text())
    assert content["facts"]["recipe"]["steps"] == 4
    assert content["facts"]["held_out"]["clips"] == 2
    assert "held-out" in (model_folder / "MODEL_CARD.md").read_text().lower()
    assert Learn(out=out, settings=tiny(clips, score_every=4)).run() == model_folder


def test_training_continues_from_a_model(clips, whole, tmp_path):
    first = whole
    second = Learn(out=tmp_path / "second", settings=tiny(clips, start=str(first), seed=1)).run()
    before, after = weights(first), weights(second)
    assert all(torch.equal(before[n], after[n]) for n in before if n.startswith("codec."))
    assert any(not torch.equal(before[n], after[n]) for n in before if n.startswith("net."))
    assert json.loads((second / "model.json").read_text())["facts"]["continued_from"]["recipe"]["steps"] == 4
    with pytest.raises(UsageError, match="another kind"):
        Learn(out=tmp_path / "third", settings=tiny(clips, start=str(first), widths=(32, 32))).run()
    with pytest.raises(UsageError, match="another configuration"):  # an unfinished run, too, is of its settings
        Learn(out=tmp_path / "second", settings=tiny(clips, start=str(first), seed=2)).run()


def test_class_weights_lift_rare_classes(clips):
    assert torch.equal(class_weights(clips, range(2), 0.0), torch.ones(19))
    weight = class_weights(clips, range(2), 0.5)
    assert float(weight[13]) > float(weight[0])


def test_fewer_cities_than_training_begins_with_are_not_waited_for(clips):
    config = with_settings(tiny(clips), first_cities=40)
    assert config.data.cities < config.data.first_cities
    assert learn.clips_of_cities(config, clips).weighed() == range(config.data.cities)


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


def test_batches_depend_on_step_only(clips):
    source = learn.clips_of_cities(tiny(clips), clips)
    first, again, other = (source.draw(step, 2, 2, "batch") for step in (7, 7, 8))
    assert all(torch.equal(one.rgb, two.rgb) for one, two in zip(first, again, strict=True))
    assert not torch.equal(first[0].rgb, other[0].rgb)


def test_cities_that_are_skipped_are_never_drawn(clips):
    config = with_settings(tiny(clips, cities=2, first_cities=2), skip_cities=1, augment=False)
    source = learn.clips_of_cities(config, clips)
    allowed = [read_clip(clips, city, k, range(4)).rgb for city in (1, 2) for k in range(2)]
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


def test_clips_that_never_come_are_an_error(tmp_path):
    with pytest.raises(ResourceError, match="no training clips arrived"):
        await_shard(tmp_path, 1, patience_s=0.0)


def test_perfect_samples_score_perfectly(clips):
    clip = read_clip(clips, city_clips.HELD_OUT, 0, range(WINDOW))
    depth = clip.depth.clamp(max=100.0)
    sample = GeneratedClip(clip.rgb, depth, clip.semantics, torch.ones_like(depth), {})
    row, counts = score.score_clip(clip, sample)
    assert row["psnr"] == float("inf")
    assert row["abs_rel"] == pytest.approx(0.0, abs=1e-6)
    assert row["sharpness"] == pytest.approx(1.0)
    assert row["sky_near"] == 0.0
    assert row["edges_agree"] == 1.0
    assert int(counts[:, :-1].diagonal().sum()) == int(counts.sum())


def test_confidence_score_ranks():
    error = torch.linspace(0, 1, 1000)
    assert score._auc(1 - error, error) > 0.99
    assert score._auc(error, error) < 0.01
    assert score._auc(torch.ones(1000), error) == pytest.approx(0.5)
