"""DINOv2 and CLIP: networks against second implementations, and what the scorer makes of them."""

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
from mudg.networks import clip_image, dinov2
from mudg.scoring.sets import subject_consistency
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


def test_dinov2_against_a_twin_in_float64() -> None:
    # 56 pixels: its own 4 x 4 places
    state = {name: value.double() for name, value in toy_vit.dino_state(side=4).items()}
    image = images(1, 56)[0].double()
    x = patches(image, state["patch_embed.proj.weight"], 14) + state["patch_embed.proj.bias"]
    x = torch.cat([state["cls_token"][0], x]) + state["pos_embed"][0]
    for number in range(2):
        block = f"blocks.{number}"
        joined = (state[f"{block}.attn.qkv.weight"], state[f"{block}.attn.qkv.bias"])
        y = attended(normed(x, state, f"{block}.norm1", 1e-6), *joined, 2)
        y = y @ state[f"{block}.attn.proj.weight"].T + state[f"{block}.attn.proj.bias"]
        x = x + y * state[f"{block}.ls1.gamma"]
        y = normed(x, state, f"{block}.norm2", 1e-6)
        y = y @ state[f"{block}.mlp.fc1.weight"].T + state[f"{block}.mlp.fc1.bias"]
        y = y * 0.5 * (1 + torch.erf(y / 2**0.5))
        x = x + (y @ state[f"{block}.mlp.fc2.weight"].T + state[f"{block}.mlp.fc2.bias"]) * state[f"{block}.ls2.gamma"]
    expected = normed(x, state, "norm", 1e-6)[0]
    made = dinov2.DinoFeatures(toy_vit.dino_state(side=4))(image.float()[None])[0]
    assert made.shape == (128,)
    assert (made - expected).abs().max() < 1e-5 * expected.abs().max()  # measured 6e-7


def test_positions_are_resized_by_the_published_factor_and_sizes_name_the_network() -> None:
    """Bicubic interpolation nearly keeps straight lines: a ramp shows where it is read."""
    state = toy_vit.dino_state()
    ramp = torch.arange(37.0).view(37, 1).expand(37, 37).reshape(1, -1, 1)
    state["pos_embed"] = torch.cat([torch.full((1, 1, 128), 5.0), ramp.expand(1, -1, 128)], 1)
    network = dinov2.DinoFeatures(state)
    found = network.positions(16, 16)
    assert found.shape == (1, 257, 128) and bool((found[:, 0] == 5).all())
    read = found[0, 1:, 0].reshape(16, 16)[:, 3]
    expected = (torch.arange(16) + 0.5) * 37 / 16.1 - 0.5
    assert (read - expected)[2:-2].abs().max() < 0.06  # measured 0.048, by the cubic kernel itself
    # by the size they would lie elsewhere
    assert (expected - ((torch.arange(16) + 0.5) * 37 / 16 - 0.5)).abs().max() > 0.2
    assert torch.equal(network.positions(37, 37), state["pos_embed"])
    assert dinov2.NAMES[384, 12] == "ViT-S/14"
    count = sum(torch.Size(shape).numel() for shape in dinov2.tensor_shapes(384, 12).values())
    assert count == 22_056_576 - 384  # the published ViT-S/14 without its mask token
    large = sum(torch.Size(shape).numel() for shape in dinov2.tensor_shapes(1024, 24).values())
    assert large == 304_368_640 - 1024


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
    state = toy_vit.dino_state()
    for change, said in (
        ({"register_tokens": torch.zeros(1, 4, 128)}, "register_tokens"),
        ({"blocks.1.norm1.weight": torch.zeros(3)}, r"blocks.1.norm1.weight"),
        ({"norm.bias": torch.full((128,), torch.nan)}, "not finite"),
    ):
        with pytest.raises(InputError, match=said):
            dinov2.DinoFeatures({**state, **change})
    with pytest.raises(InputError, match="not the weights of a DINOv2"):
        dinov2.DinoFeatures(toy_vit.clip_state())
    with pytest.raises(InputError, match="not the weights of a CLIP"):
        clip_image.ClipImageFeatures(state)
    lacking = toy_vit.transformers_names(toy_vit.clip_state())
    del lacking["vision_model.encoder.layers.0.self_attn.k_proj.bias"]
    with pytest.raises(InputError, match="resblocks.0.attn.in_proj_bias"):
        clip_image.ClipImageFeatures(lacking)


def test_prepared_images_have_the_statistics_of_the_networks() -> None:
    white = np.full((50, 80, 3), 255, np.uint8)
    expected = [(1 - m) / d for m, d in zip(dinov2.MEAN, dinov2.DEVIATION)]
    assert dinov2.prepared(white)[:, 100, 100].tolist() == pytest.approx(expected)
    assert clip_image.prepared(white)[0, 100, 100].item() == pytest.approx((1 - 0.48145466) / 0.26862954)
    assert clip_image.prepared(white).shape == (3, 336, 336)
    picture = toy_views.colors(0)
    planes = torch.from_numpy(picture).permute(2, 0, 1)[None].float() / 255
    expected = functional.interpolate(planes, (336, 336), mode="bicubic")
    mean, deviation = (torch.tensor(of).view(3, 1, 1) for of in (clip_image.MEAN, clip_image.DEVIATION))
    found = clip_image.prepared(picture) * deviation + mean
    assert (found - expected[0]).abs().max() < 1e-6


# ---- distances -----------------------------------------------------------------------------------


def test_consistency_by_hand() -> None:
    rows = np.array([[1.0, 0.0], [0.0, 1.0], [-1.0, 0.0]])
    # Neighbours at right angles: 0. With the first: 0 and max(0, -1).
    assert subject_consistency(rows) == 0
    tilted = np.array([[1.0, 0.0], [1.0, 1.0]])
    assert subject_consistency(tilted) == pytest.approx(0.5**0.5) and subject_consistency(rows[:1]) is None


# ---- in the scorer -------------------------------------------------------------------------------


def darker(_index: int, seen: Observation) -> Observation:
    return dataclasses.replace(seen, rgb=seen.rgb * 0.5)


def test_the_scorer_computes_what_weights_allow(tmp_path: Path) -> None:
    scene = toy_views.write_scene(tmp_path / "scene")
    methods = {"a": toy_views.write_views(scene, tmp_path / "a", "a", (2.0,))}
    methods["b"] = toy_views.write_views(scene, tmp_path / "b", "b", (2.0,), darker)
    store.write_safetensors(tmp_path / "dino.safetensors", toy_vit.dino_state())
    store.write_safetensors(tmp_path / "clip.safetensors", toy_vit.clip_state())
    weights = {f"{name}_weights": str(tmp_path / f"{name}.safetensors") for name in ("dino", "clip")}
    config = ScoreConfig(**weights, perceptual_views=0, error_pictures=False)
    out = Score(scene=scene, views=methods, out=tmp_path / "score", settings=config).run()
    document = store.read_json(out / "metrics.json")
    values = {r["method"]: r["values"] for r in document["results"]}
    assert values["a"]["fd_dinov2"] == pytest.approx(0, abs=1e-4)  # the toy's views are its recorded images
    assert values["a"]["cmmd"] == pytest.approx(0, abs=1e-9) and values["a"]["clip_v"] == pytest.approx(1.0, abs=1e-6)
    assert values["b"]["fd_dinov2"] > 0.1 and values["b"]["cmmd"] > 0 and values["b"]["clip_v"] < 0.9999
    assert 0 < values["a"]["subject_consistency"] <= 1 and 0 < values["a"]["clip_f"] <= 1

    seen = torch.stack([clip_image.prepared(toy_views.colors(n), 42) for n in range(4)])
    units = functional.normalize(clip_image.ClipImageFeatures(toy_vit.clip_state())(seen), dim=1)
    assert values["a"]["clip_f"] == pytest.approx(float((units[1:] * units[:-1]).sum(1).mean()), abs=1e-5)
    for entry, metric in (("dinov2", "fd_dinov2"), ("clip", "cmmd")):
        (floor,) = document[entry]["floors"]
        assert metric in floor and floor["trajectory"] == "front_shift+2.0"
    assert document["dinov2"]["weights_sha256"] == store.sha256_file(tmp_path / "dino.safetensors")
    row = next(r for r in document["results"] if r["method"] == "a")
    assert row["clip"] == {"n": 4, "n_reference": 4}
    text = (out / "metrics.md").read_text()
    assert "Floor: the truth itself: FD-DINOv2" in text and "a network of 2 blocks of 128" in text
    # two networks, two methods; the recorded set is a's
    assert len(list((out / "features").glob("*.safetensors"))) == 4
