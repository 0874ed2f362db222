"""FID's network: its layers against a twin in numpy, its traps, its input rules against other implementations."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
import toy_inception
from PIL import Image
from refusals import refused

from mudg.base import seeds
from mudg.base.errors import InputError
from mudg.networks import inception


@pytest.fixture(scope="module")
def state() -> dict[str, torch.Tensor]:
    return toy_inception.state()


@pytest.fixture(scope="module")
def network(state: dict[str, torch.Tensor]) -> inception.InceptionFeatures:
    return inception.InceptionFeatures(state)


def picture(height: int = 64, width: int = 96, seed: int = 0) -> np.ndarray:
    rough = seeds.numpy_rng(seed, 0, "picture").integers(0, 256, (height // 8, width // 8, 3), dtype=np.uint8)
    return np.array(Image.fromarray(rough).resize((width, height), Image.Resampling.BILINEAR))


def test_the_published_file_has_these_tensors() -> None:
    shapes = inception.tensor_shapes()
    assert len(shapes) == 472 and sum(math.prod(shape) for shape in shapes.values()) == 23_885_392
    assert sum(name.endswith("conv.weight") for name in shapes) == 94
    assert shapes["Conv2d_4a_3x3.conv.weight"] == (192, 80, 3, 3)
    assert shapes["Mixed_5b.branch5x5_2.conv.weight"] == (64, 48, 5, 5)
    assert shapes["Mixed_6c.branch7x7dbl_2.conv.weight"] == (160, 160, 7, 1)
    assert shapes["Mixed_6c.branch7x7_2.conv.weight"] == (160, 160, 1, 7)
    assert shapes["Mixed_7a.branch7x7x3_4.conv.weight"] == (192, 192, 3, 3)
    assert shapes["Mixed_7c.branch3x3dbl_3b.conv.weight"] == (384, 384, 3, 1)
    assert shapes["Mixed_7c.branch_pool.bn.running_var"] == (192,) and shapes["fc.weight"] == (1008, 2048)


def test_features_do_not_depend_on_the_batch(network: inception.InceptionFeatures, monkeypatch) -> None:
    images = torch.stack([inception.prepared(picture(seed=n), "tf1") for n in range(2)])
    sizes, block = [], network.block

    def noted(name: str, x: torch.Tensor) -> torch.Tensor:
        made = block(name, x)
        sizes.append(made.shape[1:])
        return made

    monkeypatch.setattr(network, "block", noted)
    found = network(images)
    assert found.shape == (2, 2048) and float((found[0] - found[1]).abs().max()) > 1e-3
    channels, sides = [256, 288, 288, *[768] * 5, 1280, 2048, 2048], [35] * 3 + [17] * 5 + [8] * 3
    assert sizes == [(width, side, side) for width, side in zip(channels, sides, strict=True)]
    assert torch.allclose(network(images[1:]), found[1:], atol=1e-5)
    with pytest.raises(InputError, match="images of one size"):
        network(torch.zeros(1, 3, 224, 224))


def convolved(x: np.ndarray, state: dict[str, torch.Tensor], name: str) -> np.ndarray:
    """[C, h, w] through a unit that keeps the size, with loops over the kernel's places, float64."""
    kernel = state[f"{name}.conv.weight"].double().numpy()
    tall, wide = kernel.shape[2:]
    padded = np.pad(x, ((0, 0), (tall // 2,) * 2, (wide // 2,) * 2))
    height, width = x.shape[1:]
    total = np.zeros((len(kernel), height, width))
    for i in range(tall):
        for j in range(wide):
            total += np.einsum("oc,chw->ohw", kernel[:, :, i, j], padded[:, i : i + height, j : j + width])
    leaves = ("weight", "bias", "running_mean", "running_var")
    norm = {leaf: state[f"{name}.bn.{leaf}"].double().numpy()[:, None, None] for leaf in leaves}
    scaled = (total - norm["running_mean"]) / np.sqrt(norm["running_var"] + 0.001) * norm["weight"] + norm["bias"]
    return np.maximum(scaled, 0)


def neighbours(x: np.ndarray, reduce) -> np.ndarray:
    """``reduce`` over the pixels of each 3x3 window that lie inside."""
    _, height, width = x.shape
    rows = [[x[:, max(0, i - 1) : i + 2, max(0, j - 1) : j + 2] for j in range(width)] for i in range(height)]
    return np.stack([np.stack([reduce(window, axis=(1, 2)) for window in row], -1) for row in rows], -2)


@pytest.mark.parametrize(("name", "pool"), [("Mixed_7b", np.mean), ("Mixed_7c", np.max)])
def test_the_last_blocks_against_a_twin_in_numpy(network, state, name: str, pool) -> None:
    width = 1280 if name == "Mixed_7b" else 2048
    x = torch.rand(1, width, 3, 4, generator=torch.Generator().manual_seed(1))
    of = lambda y, unit: convolved(y, state, f"{name}.{unit}")
    one = x[0].double().numpy()
    middle = of(one, "branch3x3_1")
    double = of(of(one, "branch3x3dbl_1"), "branch3x3dbl_2")
    ends = [of(middle, f"branch3x3_2{k}") for k in "ab"] + [of(double, f"branch3x3dbl_3{k}") for k in "ab"]
    expected = np.concatenate([of(one, "branch1x1"), *ends, of(neighbours(one, pool), "branch_pool")])
    assert np.abs(network.block(name, x)[0].numpy() - expected).max() < 1e-4 * np.abs(expected).max()


@pytest.mark.parametrize(("name", "pool"), [("Mixed_5c", np.mean), ("Mixed_6d", np.mean)])
def test_the_order_of_branches_and_the_pools_of_earlier_blocks(network, state, name: str, pool) -> None:
    width = 256 if name == "Mixed_5c" else 768
    one = np.random.default_rng(2).random((width, 5, 4))

    def chain(y: np.ndarray, *units: str) -> np.ndarray:
        for unit in units:
            y = convolved(y, state, f"{name}.{unit}")
        return y

    if name == "Mixed_5c":
        lengths = {"branch5x5": 2, "branch3x3dbl": 3}
    else:
        lengths = {"branch7x7": 3, "branch7x7dbl": 5}
    branches = [[f"{branch}_{n + 1}" for n in range(count)] for branch, count in lengths.items()]
    chains = [chain(one, *branch) for branch in (["branch1x1"], *branches)]
    expected = np.concatenate([*chains, chain(neighbours(one, pool), "branch_pool")])
    found = network.block(name, torch.from_numpy(one).float()[None])[0].numpy()
    assert np.abs(found - expected).max() < 1e-4 * np.abs(expected).max()


def test_reducing_blocks_pass_maxima_on_as_their_last_channels(network) -> None:
    for name, width in (("Mixed_6a", 288), ("Mixed_7a", 768)):
        x = torch.rand(1, width, 9, 9, generator=torch.Generator().manual_seed(3))
        largest = network.block(name, x)[0, -width:]
        for i, j in np.ndindex(4, 4):
            window = x[0, :, 2 * i : 2 * i + 3, 2 * j : 2 * j + 3]
            assert torch.equal(largest[:, i, j], window.amax((1, 2)))


def test_counts_of_batches_are_left_alone_and_other_weights_refused(network, state) -> None:
    counted = inception.InceptionFeatures({**state, "Mixed_5b.branch1x1.bn.num_batches_tracked": torch.tensor(7)})
    x = torch.rand(1, 192, 5, 5, generator=torch.Generator().manual_seed(4))
    assert torch.equal(counted.block("Mixed_5b", x), network.block("Mixed_5b", x))
    with pytest.raises(InputError, match="num_batches_seen"):  # of another name it is a tensor of another network
        inception.InceptionFeatures({**state, "Mixed_5b.branch1x1.bn.num_batches_seen": torch.tensor(7)})
    missing = {name: value for name, value in state.items() if name != "Mixed_6e.branch7x7_3.bn.running_mean"}
    refused(r"1 missing: Mixed_6e.branch7x7_3.bn.running_mean", inception.InceptionFeatures, missing, "mine")
    refused("another network", inception.InceptionFeatures, {**state, "fc.weight": torch.zeros(1000, 2048)})
    refused("AuxLogits", inception.InceptionFeatures, {**state, "AuxLogits.fc.weight": torch.zeros(1000, 768)})
    for value, said in ((math.nan, "not finite"), (-1.0, "a variance lies below 0")):
        with pytest.raises(InputError, match=said):
            inception.InceptionFeatures({**state, "Conv2d_1a_3x3.bn.running_var": torch.full((32,), value)})


@pytest.mark.parametrize("rule", inception.RULES)
def test_plain_images_keep_their_value_under_every_rule(rule: inception.ResizeRule) -> None:
    for value in (0, 128, 255):
        found = inception.prepared(np.full((40, 70, 3), value, np.uint8), rule)
        assert found.shape == (3, 299, 299) and found.dtype == torch.float32
        expected = 2 * value / 255 - 1 if rule == "pytorch-fid" else (value - 128) / 128
        assert torch.allclose(found, torch.full_like(found, expected), atol=1e-4)


def test_rules_differ_and_pytorch_fid_samples_at_pixel_centres() -> None:
    made = {rule: inception.prepared(picture(400, 640), rule) for rule in inception.RULES}
    for rule, other in (("tf1", "pytorch-fid"), ("clean", "tm"), ("tm", "pytorch-fid"), ("clean", "tf1")):
        assert float((made[rule] - made[other]).abs().max()) > 0.01
    assert 0 < float((made["neurad"] - made["clean"]).abs().max()) < 2 / 128  # rounding after each pass
    image = np.zeros((2, 2, 3), np.uint8)
    image[:, 1] = 255
    row = (inception.prepared(image, "pytorch-fid")[0, 0] + 1) / 2
    centres = (torch.arange(299) + 0.5) * 2 / 299 - 0.5
    assert torch.allclose(row, centres.clamp(0, 1), atol=1e-5)


@pytest.mark.parametrize(("height", "width"), [(37, 50), (299, 299), (400, 640)])
def test_tf1_against_loops(height: int, width: int) -> None:
    image = seeds.numpy_rng(0, height, "tf1").integers(0, 256, (height, width, 3), dtype=np.uint8)
    found = inception.prepared(image, "tf1").numpy() * 128 + 128
    for row, column in ((0, 0), (298, 298), (7, 250), (150, 149), (298, 3)):
        y, x = row * height / 299, column * width / 299
        i, j = int(y + 1e-9), int(x + 1e-9)
        below, right = min(i + 1, height - 1), min(j + 1, width - 1)
        p, q = y - i, x - j
        pixels = image.astype(float)
        top = pixels[i, j] * (1 - q) + pixels[i, right] * q
        bottom = pixels[below, j] * (1 - q) + pixels[below, right] * q
        assert found[:, row, column] == pytest.approx(top * (1 - p) + bottom * p, abs=0.02)


@pytest.mark.parametrize("rule", ["clean", "tm"])
@pytest.mark.parametrize(("height", "width"), [(120, 200), (480, 720)])
def test_antialiasing_rules_are_pillows_on_floats(rule: inception.ResizeRule, height: int, width: int) -> None:
    image = picture(height, width)
    method = Image.Resampling.BICUBIC if rule == "clean" else Image.Resampling.BILINEAR
    images = [Image.fromarray(image[..., c].astype(np.float32)) for c in range(3)]
    planes = [np.asarray(one.resize((299, 299), method)) for one in images]
    found = inception.prepared(image, rule).numpy() * 128 + 128
    assert np.abs(found - np.clip(np.stack(planes), 0, 255)).max() < 0.01
