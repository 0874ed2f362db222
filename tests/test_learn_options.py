"""Settings of training: stages, frozen layers, dropout of the reference, no average."""

import importlib.util
from dataclasses import replace
from pathlib import Path

import pytest
import torch
import yaml
from toy_clips import WINDOW, tiny, write_clips

from mudg.base import checkpoint
from mudg.base.config import load
from mudg.base.errors import InputError, ResourceError, UsageError
from mudg.diffusion import learn, model_files, models
from mudg.diffusion.model import MDM, MDMConfig
from mudg.diffusion.parallel import TrainingState
from mudg.diffusion.settings import LearnConfig, LearnData, LearnNetwork
from mudg.steps.synthesize import Learn


@pytest.fixture(scope="module")
def clips(tmp_path_factory):
    return write_clips(tmp_path_factory.mktemp("clips"))


@pytest.fixture(scope="module")
def large_clips(tmp_path_factory):
    return write_clips(tmp_path_factory.mktemp("large"), 96, 64)


@pytest.fixture(scope="module")
def stage_one(clips, tmp_path_factory):
    """A model of a few steps at the small size."""
    return Learn(out=tmp_path_factory.mktemp("stage one") / "run", settings=tiny(clips, steps=2)).run()


@pytest.fixture(scope="module")
def unrefined(tmp_path_factory):
    """A model without refiner, of another network than the settings describe by default."""
    model = MDM(
        MDMConfig(
            widths=(16, 32),
            blocks=(1, 1),
            spatial_attention=(False, True),
            temporal_attention=(False, True),
            patch=2,
            refine_widths=(),
            refine_blocks=(),
            window=WINDOW,
            area_px=192 * 128,
        )
    )
    models.draw_weights(model.net, 3, "weights")
    models.draw_weights(model.codec, 3, "codec")
    folder = tmp_path_factory.mktemp("unrefined") / "model"
    model_files.save(model, folder, "card", {})
    return folder


def test_the_second_stage_takes_over_everything_at_another_size(large_clips, stage_one, tmp_path):
    config = tiny(
        large_clips, start=str(stage_one), steps=1, width=96, height=64, frozen="temporal_transformers", average_decay=0
    )
    begun, fresh = models.starting_model(config)
    before, start = model_files.load(stage_one).state_dict(), begun.state_dict()
    assert not fresh
    assert all(torch.equal(before[name], start[name]) for name in before)
    after = model_files.load(Learn(out=tmp_path / "two", settings=config).run()).state_dict()
    kept = {name for name in before if name.startswith("codec.") or ".temporal." in name}
    assert kept > {n for n in before if n.startswith("codec.")}
    assert all(torch.equal(before[name], after[name]) for name in kept)
    for name in ("net.enter.weight", "net.label.0.weight", "net.leave.weight", "refiner.leave.weight"):
        assert not torch.equal(before[name], after[name]), name
    assert not list((tmp_path / "two" / "steps").glob("*/average.*"))  # no average was asked for


def test_the_modality_embedding_survives_a_change_of_stage(stage_one, unrefined, clips):
    """It once was overwritten by the time embedding in the published second stage."""
    for folder, changes in ((stage_one, {}), (stage_one, {"refine_widths": (16, 16)}), (unrefined, {})):
        if folder is unrefined:
            config = LearnConfig(start=str(folder), data=LearnData(clips=str(clips), window=WINDOW))
        else:
            config = tiny(clips, start=str(folder), **changes)
        label = model_files.load(folder).net.label.state_dict()
        begun, _ = models.starting_model(config)
        assert all(torch.equal(value, begun.net.label.state_dict()[name]) for name, value in label.items())
        assert not torch.equal(label["0.weight"], begun.net.time.state_dict()["0.weight"])


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


def test_constant_rate_and_averages(clips):
    config = tiny(clips, steps=100, warmup_steps=0, last_lr_share=1.0, lr=1e-5)
    assert {learn.learning_rate(config, step) for step in range(100)} == {1e-5}


def test_clips_of_another_size_are_refused(clips, stage_one, tmp_path):
    with pytest.raises(InputError, match="another size"):
        Learn(out=tmp_path / "run", settings=tiny(clips, start=str(stage_one), width=96, height=64)).run()


def test_tensorboard_is_asked_for_in_words(clips, tmp_path, monkeypatch):
    find = importlib.util.find_spec
    monkeypatch.setattr(
        importlib.util, "find_spec", lambda name, *rest: None if name == "tensorboard" else find(name, *rest)
    )
    with pytest.raises(ResourceError, match=r"pip install 'mudg\[track\]'"):
        Learn(out=tmp_path / "run", tensorboard=True, settings=tiny(clips)).run()
    assert not (tmp_path / "run").exists()


def test_moments_of_another_model_are_refused(clips, stage_one, tmp_path):
    """A checkpoint whose tensors do not fit is named, not half loaded."""
    saved = checkpoint.latest(stage_one.parent / "steps")
    model = MDM(models.model_config(tiny(clips, widths=(16, 64))))
    trained = model.trained_part()
    state = TrainingState(trained, torch.optim.AdamW(trained.parameters()), None)
    with pytest.raises(checkpoint.IntegrityError, match="does not fit"):
        state.load(saved.path)


def recipes(facts):
    """Every recipe that a shipped model tells of, its predecessors' too."""
    for name, value in facts.items():
        if name == "recipe":
            yield value
        elif isinstance(value, dict):
            yield from recipes(value)


@pytest.mark.parametrize("name", sorted(model_files.EMBEDDED))
def test_the_recipes_of_the_shipped_models_are_settings_files(name, tmp_path):
    found = list(recipes(model_files.facts(name)))
    assert found
    for recipe in found:
        (tmp_path / "recipe.yaml").write_text(yaml.safe_dump(recipe))
        config = load(LearnConfig, None, tmp_path / "recipe.yaml")
        assert config.steps == recipe["steps"] and config.data.cities == recipe["data"]["cities"]
    network = models.model_config(config)
    assert network.widths == model_files.load(name).config.widths


def test_the_recipe_in_the_manual_is_a_settings_file(tmp_path):
    text = (Path(__file__).parents[1] / "docs" / "training" / "published.md").read_text()
    (tmp_path / "stage1.yaml").write_text(text.partition("`stage1.yaml`:")[2].split("```yaml\n")[1].split("```")[0])
    config = load(LearnConfig, None, tmp_path / "stage1.yaml")
    assert config.optimizer.betas == (0.9, 0.999) and config.compute.parallel == "fsdp" and not config.data.augment


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
