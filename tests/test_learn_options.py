"""Settings of training: stages, frozen layers, dropout of the reference, latents on disk, no average."""

import importlib.util
import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from toy_clips import WINDOW, tiny, write_clips

from mudg.base import checkpoint
from mudg.base.errors import InputError, ResourceError, UsageError
from mudg.models.mdm import files
from mudg.models.mdm.model import MDM, MDMConfig
from mudg.stages import learn
from mudg.stages.learning import clips as learn_clips
from mudg.stages.learning import latents as learn_latents


@pytest.fixture(scope="module")
def clips(tmp_path_factory):
    return write_clips(tmp_path_factory.mktemp("clips"))


@pytest.fixture(scope="module")
def large_clips(tmp_path_factory):
    return write_clips(tmp_path_factory.mktemp("large"), 96, 64)


@pytest.fixture(scope="module")
def stage_one(clips, tmp_path_factory):
    """A model of a few steps at the small size."""
    return learn.run(tiny(clips, steps=2), tmp_path_factory.mktemp("stage one") / "run")


@pytest.fixture(scope="module")
def unrefined(tmp_path_factory):
    """A model without refiner, of another network than the settings describe by default."""
    model = MDM(
        MDMConfig(
            widths=(16, 32), blocks=(1, 1), spatial_attention=(False, True), temporal_attention=(False, True), patch=2,
            refine_widths=(), refine_blocks=(), window=WINDOW, area_px=192 * 128,
        )
    )  # fmt: skip
    learn.draw_weights(model.net, 3, "weights")
    learn.draw_weights(model.codec, 3, "codec")
    folder = tmp_path_factory.mktemp("unrefined") / "model"
    files.save(model, folder, "card", {})
    return folder


def test_the_second_stage_takes_over_everything_at_another_size(large_clips, stage_one, tmp_path):
    config = tiny(
        large_clips, start=str(stage_one), steps=1, width=96, height=64, frozen="temporal_transformers", average_decay=0
    )
    begun, fresh = learn.starting_model(config)
    before, start = files.load(stage_one).state_dict(), begun.state_dict()
    assert not fresh
    assert all(torch.equal(before[name], start[name]) for name in before)
    after = files.load(learn.run(config, tmp_path / "two")).state_dict()
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
            config = replace(learn.LearnConfig(), start=str(folder), clips=str(clips), window=WINDOW)
        else:
            config = tiny(clips, start=str(folder), **changes)
        label = files.load(folder).net.label.state_dict()
        begun, _ = learn.starting_model(config)
        assert all(torch.equal(value, begun.net.label.state_dict()[name]) for name, value in label.items())
        assert not torch.equal(label["0.weight"], begun.net.time.state_dict()["0.weight"])


def test_frozen_layers_need_some_to_freeze(clips):
    model = MDM(learn.model_config(tiny(clips, temporal_attention=(False, False))))
    with pytest.raises(UsageError, match="nothing to freeze"):
        learn.freeze(model, "temporal_transformers")
    other = MDM(learn.model_config(tiny(clips)))
    count = learn.freeze(other, "temporal_layers")
    frozen = {n for n, p in other.net.named_parameters() if not p.requires_grad}
    assert frozen == {n for n, _ in other.net.named_parameters() if ".temporal." in n}
    assert count == sum(p.numel() for n, p in other.net.named_parameters() if n in frozen)


def test_an_embedded_kind_of_network_need_not_be_described_again(unrefined, clips, tmp_path):
    config = replace(
        tiny(clips, start=str(unrefined), steps=2, log_every=1, augment=False),
        **{n: getattr(learn.LearnConfig(), n) for n in ("widths", "blocks", "spatial_attention", "temporal_attention")},
        refine_widths=learn.LearnConfig().refine_widths, refine_blocks=learn.LearnConfig().refine_blocks,
    )  # fmt: skip
    model = files.load(learn.run(config, tmp_path / "run"))
    assert model.config == replace(files.load(unrefined).config, area_px=48 * 32)


def test_kept_latents_change_nothing_and_are_made_once(unrefined, clips, tmp_path, monkeypatch):
    def losses(name, **changes):
        config = replace(
            learn.LearnConfig(), start=str(unrefined), clips=str(clips), workers=0, cities=3, first_cities=3, held_out=1, steps=3,
            width=48, height=32, window=WINDOW, batch_frames=8, full_window_share=1.0, augment=False, reference_dropout=0.0,
            score_steps=1, sample_steps=1, log_every=1, precision="float32", **changes,
        )  # fmt: skip
        learn.run(config, tmp_path / name)
        rows = [json.loads(line) for line in (tmp_path / name / "log.jsonl").read_text().splitlines()]
        return [row["total"] for row in rows if "total" in row]

    encoded = []
    monkeypatch.setattr(
        learn_latents, "_of_clip",
        lambda encode, name, folder, clip, own=learn_latents._of_clip: own(
            lambda x: encoded.append(name) or encode(x), name, folder, clip
        ),
    )  # fmt: skip
    plain, kept = losses("plain"), losses("kept", cache_latents=True)
    assert kept == pytest.approx(plain, rel=1e-6)
    kept_files = list((tmp_path / "kept" / "latents").rglob("*.safetensors"))
    assert 0 < len(encoded) == len(kept_files) <= 6 * 6  # six encoded maps of at most six clips
    model = files.load(unrefined)
    assert {path.parent.parent.name for path in kept_files} == {learn_latents.codec_digest(model.codec)[:16]}
    with pytest.raises(UsageError, match="latents cannot be kept"):
        learn.run(tiny(clips, cache_latents=True), tmp_path / "varied")


def test_a_latent_belongs_to_its_codec_and_its_pixels(tmp_path):
    codec, other = (MDM(MDMConfig(widths=(16,), blocks=(1,), spatial_attention=(False,), temporal_attention=(False,), patch=2,
                            refine_widths=(), refine_blocks=(), window=8, area_px=24576)).codec
                    for _ in range(2))  # fmt: skip
    with torch.no_grad():
        other.rgb_scale.mul_(2)
    generator = torch.Generator().manual_seed(0)
    clips = torch.rand(2, 3, 3, 8, 8, generator=generator)
    for module in (codec, other, codec):
        with learn_latents.cached_latents(module, tmp_path):
            assert torch.equal(module.encode_rgb(clips), type(module).encode_rgb(module, clips))
            assert torch.equal(module.encode_rgb(clips.flip(-1)), type(module).encode_rgb(module, clips.flip(-1)))
        assert "encode_rgb" not in vars(module)
    assert len(list(tmp_path.rglob("*.safetensors"))) == 8


def test_references_are_dropped_as_often_as_asked(clips):
    def dropped(share):
        drawn = learn_clips.draw_clips(tiny(clips, reference_dropout=share), clips, 1, 40, 2, "batch")
        return np.mean([torch.equal(clip.condition.reference, clip.condition.color[0]) for clip in drawn])

    assert dropped(0.0) == 0.0
    assert dropped(1.0) == 1.0
    assert 0.05 < dropped(0.2) < 0.4


def test_constant_rate_and_averages(clips):
    config = tiny(clips, steps=100, warmup_steps=0, last_lr_share=1.0, lr=1e-5)
    assert {learn.learning_rate(config, step) for step in range(100)} == {1e-5}


def test_clips_of_another_size_are_refused(clips, stage_one, tmp_path):
    with pytest.raises(InputError, match="another size"):
        learn.run(tiny(clips, start=str(stage_one), width=96, height=64), tmp_path / "run")


def test_tensorboard_is_asked_for_in_words(clips, tmp_path, monkeypatch):
    find = importlib.util.find_spec
    monkeypatch.setattr(
        importlib.util, "find_spec", lambda name, *rest: None if name == "tensorboard" else find(name, *rest)
    )
    with pytest.raises(ResourceError, match=r"pip install 'mudg\[track\]'"):
        learn.run(tiny(clips, tensorboard=True), tmp_path / "run")


def test_moments_of_another_model_are_refused(clips, stage_one, tmp_path):
    """A checkpoint whose tensors do not fit is named, not half loaded."""
    saved = checkpoint.latest(stage_one.parent / "steps")
    assert saved is not None
    model = MDM(learn.model_config(tiny(clips, widths=(16, 64))))
    trained = model.trained_part()
    state = learn.TrainingState(trained, torch.optim.AdamW(trained.parameters()), None)
    with pytest.raises(checkpoint.IntegrityError, match="does not fit"):
        state.load(saved.path)
