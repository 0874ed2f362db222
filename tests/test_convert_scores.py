"""Weights of the networks of the scores, converted: names, origin, use in the scorer, and what is refused."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
import toy_inception
import toy_views
from test_i3d import made_up, renamed
from test_score_metrics import lpips_state

from mudg import app
from mudg.base import store
from mudg.base.errors import InputError, UsageError
from mudg.diffusion.settings import ConvertConfig
from mudg.editing.settings import ScoreConfig
from mudg.networks import i3d, inception
from mudg.scoring import sets as converted
from mudg.steps.export import Convert
from mudg.steps.render import Score

STATES = {
    "inception": lambda: {**toy_inception.state(), "Conv2d_1a_3x3.bn.num_batches_tracked": torch.tensor(3)},
    "i3d": lambda: {renamed(name): value for name, value in made_up().items()},
    "lpips": lpips_state,
}


def saved(tmp_path: Path, network: str) -> Path:
    torch.save({"state_dict": STATES[network]()}, tmp_path / "published.pth")
    return tmp_path / "published.pth"


LARGE = {"inception", "i3d"}


@pytest.mark.parametrize(
    "network", [pytest.param(one, marks=pytest.mark.slow) if one in LARGE else one for one in STATES]
)
def test_converted_weights_are_the_published_ones_under_known_names(tmp_path: Path, network: str) -> None:
    checkpoint = saved(tmp_path, network)
    converted.convert_weights(network, checkpoint, tmp_path / "out")
    found = store.read_tensors(tmp_path / "out" / "weights.safetensors")
    converted.NETWORKS[network][1](found, "converted")
    description = store.read_json(tmp_path / "out" / "model.json")
    assert description["source"]["sha256"] == store.sha256_file(checkpoint)
    assert description["source"]["published_as"] is None
    assert description["files"] == {"weights.safetensors": store.sha256_file(tmp_path / "out" / "weights.safetensors")}
    if network == "i3d":
        assert set(found) == set(i3d.tensor_shapes())
        assert torch.equal(found["logits.conv3d.bias"], made_up()["logits.conv3d.bias"])
    if network == "inception":
        assert set(found) == set(inception.tensor_shapes())


@pytest.mark.slow
def test_a_converted_file_keeps_its_origin(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    checkpoint = saved(tmp_path, "inception")
    converted.convert_weights("inception", checkpoint, tmp_path / "out")
    weights = tmp_path / "out" / "weights.safetensors"
    assert converted.source_sha256(weights) == store.sha256_file(checkpoint)
    assert converted.source_sha256(checkpoint) == store.sha256_file(checkpoint)
    monkeypatch.setattr(inception, "KNOWN_SHA256", store.sha256_file(checkpoint))
    scene = toy_views.write_scene(tmp_path / "scene")
    views = toy_views.write_views(scene, tmp_path / "a", "a", (2.0,))
    settings = ScoreConfig(fid_weights=str(weights), perceptual_views=0)
    out = Score(scene=scene, views={"a": views}, out=tmp_path / "score", settings=settings).run()
    assert store.read_json(out / "metrics.json")["distributions"]["published_weights"] is True
    store.write_safetensors(weights, {name: value + 1 for name, value in store.read_tensors(weights).items()})
    assert converted.source_sha256(weights) == store.sha256_file(weights)  # altered since: no longer the published ones


def test_other_networks_are_refused_and_nothing_is_written(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="not the network it should be"):
        converted.convert_weights("inception", saved(tmp_path, "lpips"), tmp_path / "out")
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
def test_the_verb_converts_replaces_and_refuses_foreign_settings(tmp_path: Path) -> None:
    checkpoint = saved(tmp_path, "lpips")
    to = tmp_path / "weights" / "lpips"
    words = ["convert", str(checkpoint), "--to", str(to), "--network", "lpips"]
    assert app.main(words) == 0 and (to / "weights.safetensors").is_file()
    assert app.main(words) != 0 and app.main([*words, "--overwrite"]) == 0
    plain, half = ConvertConfig(network="lpips"), ConvertConfig(network="lpips", dtype="float16")
    with pytest.raises(UsageError, match="diffusion models only"):
        Convert(checkpoint=checkpoint, to=tmp_path / "other", settings=half).run()
    with pytest.raises(InputError, match="no such checkpoint"):
        Convert(checkpoint=tmp_path / "missing.pth", to=tmp_path / "other", settings=plain).run()
