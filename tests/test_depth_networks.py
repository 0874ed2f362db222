"""Depth by networks from folders: the alignment to LiDAR with known answers, and each kind against the package that it
comes from."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import tiny_networks
import torch
from PIL import Image
from refusals import refused
from tiny_networks import package

from mudg.base.errors import ResourceError
from mudg.core.depth import SKY_M
from mudg.labels.depth_networks import align_to_lidar, kind_of, lidar_cue, load_depth_network, residual_confidence
from mudg.labels.inputs import DepthInput, Prediction

real_packages = pytest.mark.filterwarnings("ignore")
"""What the packages warn about among themselves is theirs."""


def street(height: int = 48, width: int = 72, measured: float = 0.2, seed: int = 0) -> tuple[DepthInput, np.ndarray]:
    """A road, two walls and sky, a share of the pixels measured; and the true depth f32[H, W], the sky at 100 m."""
    rng = np.random.default_rng(seed)
    v, u = np.mgrid[0:height, 0:width].astype(np.float64)
    depth = np.minimum(1.5 * width / np.maximum(v - height / 2, 0.5), 6 + 0.9 * np.abs(u - width / 2)).clip(2, 80)
    sky = (v < height / 4) & (np.abs(u - width / 2) < width / 4)
    depth[sky] = SKY_M
    depth = depth.astype(np.float32)
    seen = (rng.uniform(size=depth.shape) < measured) & ~sky
    rgb = np.stack([255 * (depth % 7) / 7, 3 * u, 2 * v], 2).clip(0, 255).astype(np.uint8)
    return DepthInput(rgb, np.where(seen, depth, np.float32(np.nan)), depth.copy(), sky), depth


# --- alignment ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("space", "scale", "shift"), [("depth", 0.0123, -0.4), ("disparity", 21.0, 3.5), ("depth", 1.0, 0.0)]
)
@pytest.mark.parametrize("wrong", [0.0, 0.3])
def test_an_affine_map_of_the_truth_comes_back_as_the_truth(
    space: str, scale: float, shift: float, wrong: float
) -> None:
    given, truth = street()
    goal, rng = truth if space == "depth" else 1 / truth, np.random.default_rng(1)
    bad = given.known & (rng.uniform(size=truth.shape) < wrong)
    given.measured[bad] = rng.uniform(1, 90, int(bad.sum()))
    prediction = Prediction((scale * goal + shift).astype(np.float32), space)
    dense, fit = align_to_lidar(prediction, given)
    assert fit.used and dense is not None and np.abs(dense.depth / truth - 1).max() < 1e-3
    assert (dense.depth[given.sky] == SKY_M).all() and fit.residual < 1e-3


def test_wrong_returns_from_behind_do_not_pull_and_depth_that_does_not_fit_is_not_used() -> None:
    """Two fifths of the returns lie 40 % behind the surface, as what shows through gaps does: noise that has one
    sign."""
    given, truth = street()
    bad = given.known & (np.random.default_rng(2).uniform(size=truth.shape) < 0.4)
    asked = replace(given, measured=np.where(bad, 1.4 * given.measured, given.measured))
    dense, _ = align_to_lidar(Prediction(truth / 80 - 0.1, "depth"), asked)
    assert dense is not None and np.abs(dense.depth / truth - 1).max() < 1e-3
    noise = np.random.default_rng(3).uniform(1, 2, truth.shape).astype(np.float32)
    few = np.where(np.cumsum(given.known).reshape(truth.shape) <= 20, given.measured, np.nan)
    unfit = ((noise, given), (-truth, given), (np.full_like(truth, 3.0), given), (truth, replace(given, measured=few)))
    for values, asked in unfit:
        assert align_to_lidar(Prediction(values, "depth"), asked)[0] is None
    refused("size", align_to_lidar, Prediction(truth[1:], "depth"), given)


def test_confidence_is_low_where_the_depth_is_off() -> None:
    given, truth = street()
    off = truth.copy()
    off[:, :24] *= 1.3
    confidence = residual_confidence(off, given.measured, given.sky, SKY_M)
    right, wrong = np.median(confidence[30:, 40:]), np.median(confidence[30:, :16])
    assert right > 0.5 > 0.1 > wrong and confidence.dtype == np.float32
    assert ((confidence >= 0) & (confidence <= 1)).all()


def test_the_map_for_the_network_has_no_holes_and_no_sky() -> None:
    given, truth = street()
    cue = lidar_cue(given, 36)
    assert tuple(cue.shape) == (1, 1, 24, 36) and bool(torch.isfinite(cue).all())
    assert float(cue.max()) <= float(truth[~given.sky].max())
    flat = lidar_cue(replace(given, filled=np.full_like(truth, 5.0)))
    assert float(flat.max() - flat.min()) > 0
    refused("LiDAR", lidar_cue, replace(given, filled=np.full_like(truth, np.nan)))


# --- folders --------------------------------------------------------------------------------------


def test_what_is_missing_or_wrong_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for nothing in ("", tmp_path):
        refused("weights are missing", kind_of, nothing, raises=ResourceError)
    (tmp_path / "model.json").write_text('{"kind": "published"}')
    refused("another kind", kind_of, tmp_path)
    for text, words in (('{"model_type": "bert"}', "another kind"), ("[1]", "JSON object")):
        (tmp_path / "config.json").write_text(text)
        refused(words, kind_of, tmp_path)
    (tmp_path / "config.json").write_text('{"model_type": "depth_anything"}')
    tiny_networks.hide(monkeypatch, "transformers")
    refused(r"mudg\[models\]", load_depth_network, tmp_path, raises=ResourceError)


@real_packages
def test_a_folder_without_all_its_weights_is_refused(tmp_path: Path) -> None:
    from safetensors.torch import load_file, save_file

    tiny_networks.depth_anything(tmp_path)
    (tmp_path / "model.safetensors").rename(tmp_path / "aside")
    refused("cannot be read", load_depth_network, tmp_path)
    weights = load_file(tmp_path / "aside")
    weights.pop("head.conv3.weight")
    save_file(weights, tmp_path / "model.safetensors", metadata={"format": "pt"})
    refused(r"head\.conv3\.weight", load_depth_network, tmp_path)


@real_packages
@pytest.mark.parametrize(("with_lidar", "metric"), [(True, False), (False, False), (False, True)])
def test_networks_of_transformers_answer_as_in_their_package(with_lidar: bool, metric: bool, tmp_path: Path) -> None:
    """Against the package's own preparation of images and its own sizing of the answer."""
    transformers = package("transformers")
    network = tiny_networks.depth_anything(tmp_path, with_lidar=with_lidar, metric=metric)
    given, _ = street()
    found = load_depth_network(tmp_path)(given)
    name = "PromptDepthAnythingImageProcessor" if with_lidar else "DPTImageProcessor"
    processor_class = getattr(transformers, f"{name}Pil", None) or getattr(transformers, name)
    processor = processor_class.from_pretrained(str(tmp_path))
    inputs = processor(images=Image.fromarray(given.rgb), return_tensors="pt")
    assert tuple(inputs["pixel_values"].shape) == (1, 3, 42, 56)
    if with_lidar:
        inputs["prompt_depth"] = lidar_cue(given)
    with torch.inference_mode():
        output = network(**inputs).predicted_depth
    expected = torch.nn.functional.interpolate(output[:, None], size=(48, 72), mode="bilinear")[0, 0].numpy()
    assert found.space == ("depth" if with_lidar or metric else "disparity")
    assert np.ptp(expected) > 1e-3  # not a constant
    np.testing.assert_allclose(found.values, expected, rtol=1e-3, atol=1e-4 * np.abs(expected).max())
