"""The effect vector: what it says, that without it a model is what it was, what alone is trained, and exact pairs to train on."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from test_mdm import TINY, learn_part, randomised, some_condition
from toy_clips import WINDOW, made_up_clip

from mudg.base import store
from mudg.base.effects import EFFECTS, effect_vector
from mudg.base.errors import UsageError
from mudg.base.types import Condition
from mudg.base.weather_settings import Conditions
from mudg.core import weather
from mudg.core.weather.tone import SRGB
from mudg.data.city import CityConfig, CityWorld
from mudg.data.clips import shards, weathered
from mudg.data.clips.weathered import InWeather
from mudg.models.diffusion import SampleRequest
from mudg.models.mdm import files
from mudg.models.mdm.model import MDM, BatchPart, LossSettings
from mudg.stages.config import LearnConfig
from mudg.stages.config.learn import LearnData
from mudg.stages.learning import models as learn_models

TUNED = replace(TINY, effects=4)
FOG = torch.tensor([0.0, 0.5, 0, 0, 0, 0, 0, 0])


def vector_of(**settings: object) -> dict[str, float]:
    found = effect_vector(Conditions.model_validate(settings))
    return {} if found is None else {name: value for name, value in zip(EFFECTS, found, strict=True) if value}


def with_weights_of(model: MDM, plain: MDM) -> MDM:
    model.load_state_dict({**model.state_dict(), **plain.state_dict()})
    return model.eval()


def test_the_vector_says_what_weather_and_light_ask_for():
    assert effect_vector(None) is None
    assert (
        effect_vector(Conditions.model_validate({"light": {"exposure_ev": 1.0}, "season": {"leaves": "autumn"}}))
        is None
    )
    assert vector_of(weather={"fog": {"visibility_m": 100.0}}) == {"fog": 0.5}
    assert vector_of(weather={"rain": {"mm_h": 10.0}, "wet": 0.8, "puddles": 0.3}) == {
        "rain": 0.5,
        "wet": 0.8,
        "puddle": 0.3,
    }
    assert vector_of(weather={"puddles": 0.3}) == {}, "dry ground has no puddles"
    assert vector_of(weather={"snow": {"cover": 0.6, "mm_h": 2.0}}) == {"snow": 0.5, "cover": 0.6}
    assert vector_of(light={"time": "overcast"}) == {"cloud": 1.0}
    assert vector_of(light={"time": "dusk"}) == {"night": 0.5}
    assert vector_of(light={"time": "night"}) == {"night": 1.0}


# the model ------------------------------------------------------------------------------------------------------------


def test_without_a_vector_every_bit_is_that_of_the_model_without_effects():
    plain, condition = randomised(TINY), some_condition()
    tuned = with_weights_of(randomised(TUNED, seed=3), plain)
    request = SampleRequest(3, seed=7)
    wanted = plain.sample(condition, request)
    for effect in (None, torch.zeros(8)):
        made = tuned.sample(replace(condition, effect=effect), request)
        for name in ("rgb", "depth", "semantics", "confidence"):
            assert torch.equal(getattr(made, name), getattr(wanted, name)), (effect, name)
    assert torch.equal(plain.sample(replace(condition, effect=FOG), request).rgb, wanted.rgb), (
        "this model takes no vector"
    )
    foggy = tuned.sample(replace(condition, effect=FOG), request)
    assert not torch.allclose(foggy.rgb, wanted.rgb, atol=1e-3)
    assert not torch.allclose(foggy.latents["rgb"], wanted.latents["rgb"], rtol=0, atol=5e-5), (
        "the denoiser reads it, too"
    )


def test_clips_of_a_batch_without_a_vector_are_those_of_the_model_without_effects():
    plain = randomised(TINY)
    tuned = with_weights_of(randomised(TUNED, seed=3), plain)
    clear, foggy = some_condition(seed=1), replace(some_condition(seed=2), effect=FOG)
    found, wanted = (model.encode_condition([clear, foggy]) for model in (tuned, plain))
    generator = torch.Generator().manual_seed(0)
    x = {name: torch.randn(latent.shape, generator=generator) for name, latent in found.copy.items()}
    x["semantics"] = x["semantics"][:, :, : tuned.codec.channels["semantics"]]
    t = torch.tensor([500, 500])
    made, usual = tuned.predict(x, found, t)[0]["rgb"], plain.predict(x, wanted, t)[0]["rgb"]
    assert torch.allclose(made[0], usual[0], atol=1e-6)
    assert not torch.allclose(made[1], usual[1], rtol=0, atol=5e-5)


def test_new_effects_change_nothing():
    plain = randomised(TINY)
    tuned = with_weights_of(MDM(TUNED), plain)
    condition, request = replace(some_condition(), effect=FOG), SampleRequest(2)
    assert torch.allclose(tuned.sample(condition, request).rgb, plain.sample(condition, request).rgb, atol=1e-6)


def test_weights_of_effects_lie_in_a_file_of_their_own(tmp_path: Path):
    plain = randomised(TINY)
    tuned = with_weights_of(randomised(TUNED, seed=3), plain)
    files.save(plain, tmp_path / "plain", "card", {})
    files.save(tuned, tmp_path / "tuned", "card", {})
    names = sorted(path.name for path in (tmp_path / "tuned").glob("*.safetensors"))
    assert names == ["effects_00.safetensors", "weights_00.safetensors"]
    kept = [(tmp_path / name / "weights_00.safetensors").read_bytes() for name in ("plain", "tuned")]
    assert kept[0] == kept[1]
    assert [files.takes_effects(tmp_path / name) for name in ("plain", "tuned")] == [False, True]
    description = store.read_json(tmp_path / "plain" / "model.json")
    del description["config"]["effects"]  # as earlier versions wrote it
    store.write_json(tmp_path / "plain" / "model.json", description)
    assert files.load(tmp_path / "plain").effects is None
    again, condition = files.load(tmp_path / "tuned"), replace(some_condition(), effect=FOG)
    assert torch.allclose(
        again.sample(condition, SampleRequest(1)).rgb, tuned.sample(condition, SampleRequest(1)).rgb, atol=0.02
    )


# training -------------------------------------------------------------------------------------------------------------


def test_only_effects_learn_and_they_do():
    model = with_weights_of(MDM(TUNED), randomised(TINY))
    assert model.effects is not None
    learn_models.draw_weights(model.effects, 0, "effects weights")
    before = {name: value.clone() for name, value in model.state_dict().items()}
    model.requires_grad_(False)
    model.trained_part().requires_grad_(True)
    learn_models.freeze(model, "all_but_effects")
    optimizer = torch.optim.AdamW([p for p in model.parameters() if p.requires_grad], lr=1e-2)
    clip = made_up_clip(0)
    darker = replace(
        clip, rgb=clip.rgb * 0.3, condition=replace(clip.condition, effect=torch.tensor([0.0] * 7 + [1.0]))
    )
    totals = []
    for step in range(12):
        loss = model.loss([darker], BatchPart(0, step, 0, 1), LossSettings(None, 1.0, 0.0))
        optimizer.zero_grad()
        loss.total.backward()
        optimizer.step()
        totals.append(loss.terms["pixel_rgb"])
    assert totals[-1] < 0.8 * totals[0]
    changed = {name for name, value in model.state_dict().items() if not torch.equal(value, before[name])}
    assert changed
    assert all(name.startswith("effects.") for name in changed)


def test_effects_and_clips_in_other_weather_go_together():
    with pytest.raises(UsageError, match="nothing is left"):
        learn_models.freeze(randomised(TINY), "all_but_effects")
    check, weathers = learn_models.check_effects, LearnConfig(data=LearnData(weathers=2))
    check(randomised(TUNED), {"effects"}, weathers)
    check(randomised(TUNED), set(), LearnConfig())
    check(randomised(TINY), {"effects"}, LearnConfig())
    for model, fresh, config, said in (
        (TINY, set[str](), weathers, "takes an effect vector"),
        (TUNED, {"effects"}, LearnConfig(), "learned from clips in other weather"),
        (TUNED, set[str](), LearnConfig(frozen="all_but_effects"), "learned from clips in other weather"),
        (TUNED, set[str](), replace(weathers, data=LearnData(weathers=2, renders=False)), "with renders"),
    ):
        with pytest.raises(UsageError, match=said):
            check(randomised(model), fresh, config)
    model = randomised(TUNED)
    learn_models.hold_effects(model, 0)
    assert model.effects is not None
    assert not any(value.requires_grad for value in model.effects.parameters())


def test_a_share_of_the_clips_goes_without_its_vector_wherever_the_batch_is_divided():
    model = randomised(TUNED)
    clips = [replace(made_up_clip(n).condition, effect=FOG) for n in range(6)]
    settings = LossSettings(None, 1.0, 0.0, effect_dropout=0.5)

    def kept(first: int, last: int) -> list[bool]:
        encoded = model.encode_condition(clips[first:last])
        found = model._some_without_effect(encoded, BatchPart(4, 1, first, 6), settings).effect
        assert found is not None
        return found.any(1).tolist()

    assert kept(0, 6) == kept(0, 2) + kept(2, 6)
    assert set(kept(0, 6)) == {True, False}


def test_clips_keep_vector_and_colors(tmp_path: Path):
    clear, foggy = made_up_clip(0), made_up_clip(1)
    foggy = replace(foggy, condition=replace(foggy.condition, effect=FOG))
    shards.write_shard(tmp_path, 3, shards.pack_clips([clear, foggy]))
    read = [shards.read_clip(tmp_path, 3, number, range(WINDOW)) for number in (0, 1)]
    assert read[0].condition.effect is None
    assert torch.equal(read[1].condition.effect, FOG)  # type: ignore[arg-type]
    for number in range(4):  # some mirrored, some not
        varied = shards.vary(read[1], np.random.default_rng(number))
        assert torch.equal(varied.rgb, read[1].rgb) or torch.equal(varied.rgb, read[1].rgb.flip(-1))


# pairs ----------------------------------------------------------------------------------------------------------------

CITY = CityConfig(seed=4, n_frames=3, width=48, height=32, cameras=("front",), light="day", supersample=1)


@pytest.fixture(scope="module")
def clear() -> tuple[CityWorld, Condition, weather.DriveFacts]:
    """A city on a clear day, the exact condition of two of its views, and its light."""
    world = CityWorld(CITY)
    views = tuple(world.frame_views("front")[1:])
    truths = [world.render(view) for view in views]
    shown = [
        weather.ShownView(v, t.rgb, t.depth, t.semantics.astype(np.uint8)) for v, t in zip(views, truths, strict=True)
    ]
    color = torch.stack([torch.from_numpy(t.rgb.copy()).permute(2, 0, 1) for t in truths])
    depth = torch.stack(
        [torch.from_numpy(np.nan_to_num(t.depth, posinf=1000.0).astype(np.float32))[None] for t in truths]
    )
    ids = torch.stack([torch.from_numpy(t.semantics.astype(np.uint8))[None] for t in truths])
    seen = depth < 500
    condition = Condition(views, color, depth, seen, color[0], seen, color.clone(), ids, ids)
    return world, condition, weather.drive_facts(shown, SRGB)


def test_a_condition_in_fog_says_so_and_fades_with_distance(clear: tuple[CityWorld, Condition, weather.DriveFacts]):
    world, condition, drive = clear
    still = lambda time_s: (0.0, 0.0, 0.0)  # noqa: E731
    fog = Conditions.model_validate({"weather": {"fog": {"visibility_m": 30.0}}})
    made = weathered.weathered(condition, InWeather(fog, drive, 0, still))
    assert made.effect is not None
    assert float(made.effect[1]) == pytest.approx(100 / 130)
    for kept in ("depth", "valid", "semantics", "warped"):
        assert torch.equal(getattr(made, kept), getattr(condition, kept)), kept
    air = torch.from_numpy(SRGB.encode(np.asarray(drive.surroundings.airlight, np.float32)).astype(np.float32))
    apart = (made.color - air.view(3, 1, 1)).abs().mean(1, keepdim=True)
    far, near = (condition.depth > 40) & condition.valid, condition.depth < 8
    assert float(apart[far].mean()) < 0.05 < float(apart[near].mean())
    plain = weathered.weathered(condition, InWeather(Conditions(), drive, 0, still))
    assert plain.effect is None
    assert float((plain.color - condition.color).abs().max()) < 2 / 255


def test_pairs_have_the_citys_own_truth(clear: tuple[CityWorld, Condition, weather.DriveFacts]):
    world, condition, drive = clear
    first = lambda x: x[:1]  # noqa: E731
    planes = {
        name: first(getattr(condition, name)) for name in ("color", "depth", "valid", "warped", "backdrop", "semantics")
    }
    one = replace(condition, views=condition.views[:1], **planes, backdrop_semantics=first(condition.semantics))
    pairs = weathered.pairs_of([one] * len(weathered.KINDS), world, drive, key=0)
    for kind, (given, truths, pair) in zip(weathered.KINDS, pairs, strict=True):
        exact = CityWorld(replace(CITY, **pair.changes)).render(condition.views[0])
        alone = not (pair.settings.weather.rain or (pair.settings.weather.snow and pair.settings.weather.snow.mm_h))
        alone = alone and not (pair.settings.light.time == "night" and pair.settings.light.headlights)
        assert given.effect is not None, kind
        assert np.array_equal(truths[0].rgb, exact.rgb) == alone, kind
        assert np.array_equal(truths[0].semantics, exact.semantics)
        assert np.array_equal(truths[0].depth, world.render(condition.views[0]).depth), "the same place"
    again = weathered.pairs_of([one], world, drive, key=0)[0]
    assert torch.equal(again[0].color, pairs[0][0].color)


def test_headlights_only_brighten_what_is_near(clear: tuple[CityWorld, Condition, weather.DriveFacts]):
    world, condition, drive = clear
    night = CityWorld(replace(CITY, light="night"))
    view = condition.views[0]
    dark = night.render(view)
    how = InWeather(Conditions.model_validate({"light": {"time": "night"}}), drive, 0, lambda time_s: (0.0, 0.0, 0.0))
    lit = weathered._completed(night, dark, view, how)
    more = (lit.rgb - dark.rgb).mean(-1)
    assert more.min() > -0.02
    assert more[(dark.depth < 15) & (dark.semantics == 0)].mean() > 0.02
    assert abs(more[dark.sky]).max() < 0.02


def test_effects_are_parameters_of_their_own():
    names = {name for name, _ in randomised(TUNED).named_parameters()} - {
        name for name, _ in randomised(TINY).named_parameters()
    }
    assert names
    assert all(name.startswith("effects.") for name in names)
    assert len(learn_part(randomised(TUNED))) - len(learn_part(randomised(TINY))) == len(names)
