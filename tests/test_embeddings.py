"""CLIP: the tower against a second implementation, and what the scorer makes of it."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import torch
import toy_views
import toy_vit
from torch.nn import functional

from mudg.base import store
from mudg.base.errors import InputError
from mudg.base.types import Observation
from mudg.editing.settings import ScoreConfig
from mudg.networks import clip as clip_image
from mudg.steps.render import Score


def images(count: int, side: int, seed: int = 0) -> torch.Tensor:
    return torch.randn(count, 3, side, side, generator=torch.Generator().manual_seed(seed))


def attended(x: torch.Tensor, weight: torch.Tensor, bias: torch.Tensor, heads: int) -> torch.Tensor:
    """Attention head by head and token by token, float64."""
    width = x.shape[1]
    query, key, value = (x @ w.T + b for w, b in zip(weight.split(width), bias.split(width)))
    out = torch.zeros_like(x)
    for head in range(heads):
        own = slice(head * width // heads, (head + 1) * width // heads)
        for token in range(len(x)):
            shares = torch.softmax(key[:, own] @ query[token, own] / (width / heads) ** 0.5, 0)
            out[token, own] = shares @ value[:, own]
    return out


def normed(x: torch.Tensor, state: dict[str, torch.Tensor], name: str, epsilon: float) -> torch.Tensor:
    middle, spread = x.mean(-1, keepdim=True), x.var(-1, keepdim=True, unbiased=False)
    return (x - middle) / (spread + epsilon).sqrt() * state[f"{name}.weight"] + state[f"{name}.bias"]


def patches(image: torch.Tensor, kernel: torch.Tensor, size: int) -> torch.Tensor:
    rows = []
    for top in range(0, image.shape[1], size):
        for left in range(0, image.shape[2], size):
            rows.append((image[:, top : top + size, left : left + size] * kernel).sum((1, 2, 3)))
    return torch.stack(rows)


def test_clip_against_a_twin_in_float64_under_both_names() -> None:
    state = {name.removeprefix("visual."): value.double() for name, value in toy_vit.clip_state().items()}
    image = images(1, 42)[0].double()
    x = torch.cat([state["class_embedding"][None], patches(image, state["conv1.weight"], 14)])
    x = x + state["positional_embedding"]
    x = normed(x, state, "ln_pre", 1e-5)
    for number in range(2):
        block = f"transformer.resblocks.{number}"
        joined = (state[f"{block}.attn.in_proj_weight"], state[f"{block}.attn.in_proj_bias"])
        y = attended(normed(x, state, f"{block}.ln_1", 1e-5), *joined, 2)
        x = x + y @ state[f"{block}.attn.out_proj.weight"].T + state[f"{block}.attn.out_proj.bias"]
        y = normed(x, state, f"{block}.ln_2", 1e-5)
        y = y @ state[f"{block}.mlp.c_fc.weight"].T + state[f"{block}.mlp.c_fc.bias"]
        y = y / (1 + torch.exp(-1.702 * y))
        x = x + y @ state[f"{block}.mlp.c_proj.weight"].T + state[f"{block}.mlp.c_proj.bias"]
    expected = normed(x[0], state, "ln_post", 1e-5) @ state["proj"]
    for names in (toy_vit.clip_state(), toy_vit.transformers_names(toy_vit.clip_state())):
        network = clip_image.ClipImageFeatures(names)
        assert (network.side, network.out) == (42, 32)
        made = network(image.float()[None])[0]
        assert (made - expected).abs().max() < 1e-5 * expected.abs().max()


def test_other_weights_are_refused_and_named() -> None:
    state = toy_vit.clip_state()
    lacking = toy_vit.transformers_names(state)
    del lacking["vision_model.encoder.layers.0.self_attn.k_proj.bias"]
    for given, said in (
        ({"conv1.weight": torch.zeros(3)}, "not the weights of a CLIP"),
        ({**state, "visual.ln_post.bias": torch.full((128,), torch.nan)}, "not finite"),
        (lacking, "resblocks.0.attn.in_proj_bias"),
    ):
        with pytest.raises(InputError, match=said):
            clip_image.ClipImageFeatures(given)


def test_prepared_images_have_the_statistics_of_the_network() -> None:
    white = np.full((50, 80, 3), 255, np.uint8)
    assert clip_image.prepared(white)[0, 100, 100].item() == pytest.approx((1 - 0.48145466) / 0.26862954)
    assert clip_image.prepared(white).shape == (3, 336, 336)
    picture = toy_views.colors(0)
    planes = torch.from_numpy(picture).permute(2, 0, 1)[None].float() / 255
    expected = functional.interpolate(planes, (336, 336), mode="bicubic")
    mean, deviation = (torch.tensor(of).view(3, 1, 1) for of in (clip_image.MEAN, clip_image.DEVIATION))
    found = clip_image.prepared(picture) * deviation + mean
    assert (found - expected[0]).abs().max() < 1e-6


# ---- in the scorer -------------------------------------------------------------------------------


def darker(_index: int, seen: Observation) -> Observation:
    return dataclasses.replace(seen, rgb=seen.rgb * 0.5)


def test_the_scorer_computes_what_weights_allow(tmp_path: Path) -> None:
    scene = toy_views.write_scene(tmp_path / "scene")
    methods = {"a": toy_views.write_views(scene, tmp_path / "a", "a", (2.0,))}
    methods["b"] = toy_views.write_views(scene, tmp_path / "b", "b", (2.0,), darker)
    store.write_safetensors(tmp_path / "clip.safetensors", toy_vit.clip_state())
    weights = str(tmp_path / "clip.safetensors")
    config = ScoreConfig(clip_weights=weights, perceptual_views=0, error_pictures=False)
    out = Score(scene=scene, views=methods, out=tmp_path / "score", settings=config).run()
    document = store.read_json(out / "metrics.json")
    values = {r["method"]: r["values"] for r in document["results"]}
    # the toy's views are its recorded images
    assert values["a"]["clip_v"] == pytest.approx(1.0, abs=1e-6) and values["b"]["clip_v"] < 0.9999

    seen = torch.stack([clip_image.prepared(toy_views.colors(n), 42) for n in range(4)])
    units = functional.normalize(clip_image.ClipImageFeatures(toy_vit.clip_state())(seen), dim=1)
    assert values["a"]["clip_f"] == pytest.approx(float((units[1:] * units[:-1]).sum(1).mean()), abs=1e-5)
    assert document["clip"]["weights_sha256"] == store.sha256_file(tmp_path / "clip.safetensors")
    assert "CLIP-V (recorded frame of the same time) are made with CLIP" in (out / "metrics.md").read_text()
    # one network, two methods; the recorded set is a's
    assert len(list((out / "features").glob("*.safetensors"))) == 2
