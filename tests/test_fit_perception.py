"""In whose eyes a fit compares: agreement with the scorer's distance, gradients, confidence, refusals."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from refusals import refused
from test_score_metrics import lpips_state

from mudg.base import store
from mudg.base.errors import InputError, UsageError
from mudg.core.losses import lpips_distance, unit_features
from mudg.core.metrics import Pair
from mudg.gaussians.fit import Perception, perception_of
from mudg.gaussians.settings import VirtualConfig
from mudg.networks.featnets import LpipsFeatures, PerceptualDistance


def random(seed: int, *shape: int) -> torch.Tensor:
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def test_gradient_of_the_loss():
    theirs, weight, channels = random(1, 3, 4, 5), random(2, 1, 8, 10), [random(3, 3)]
    units = unit_features([theirs])
    x = (random(4, 3, 4, 5) + 0.1).requires_grad_()
    assert torch.autograd.gradcheck(lambda p: lpips_distance([p], units, weight, channels), (x,))


def perceiving(name: str, folder: Path) -> Perception:
    path = folder / "lpips.safetensors"
    store.write_safetensors(path, {key: value.numpy() for key, value in lpips_state().items()})
    return perception_of(VirtualConfig(perception=name, lpips_weights=str(path)))


def test_the_loss_is_the_scorers_distance_where_all_is_certain(tmp_path):
    network = LpipsFeatures(lpips_state())
    render, truth = random(5, 3, 48, 64).float(), random(6, 3, 48, 64).float()
    loss = perceiving("lpips", tmp_path)(render, truth, torch.ones(1, 48, 64))
    pair = Pair(render, None, None, truth, None, None, None)
    assert loss.item() == pytest.approx(PerceptualDistance(network, network.channel_weights)(pair), rel=1e-6)


@pytest.mark.parametrize("name", ["filters", "lpips"])
def test_every_eye_sees_equality_differences_and_confidence(name, tmp_path):
    perception, truth, everywhere = perceiving(name, tmp_path), random(1, 3, 48, 64).float(), torch.ones(1, 48, 64)
    assert perception(truth, truth, everywhere).item() == pytest.approx(0, abs=1e-6)
    render = (truth * 0.6 + 0.1).requires_grad_()
    distance = perception(render, truth, everywhere)
    distance.backward()
    assert distance.item() > 1e-4
    assert render.grad is not None and bool(torch.isfinite(render.grad).all()) and float(render.grad.abs().max()) > 0
    assert perception(render, truth, everywhere * 0).item() == 0
    assert perception(render, truth, everywhere * 0.5).item() == pytest.approx(distance.item() / 2, rel=1e-4)


def test_lpips_without_or_with_other_weights_is_refused(tmp_path):
    refused("weight file", perception_of, VirtualConfig(perception="lpips"), raises=UsageError)
    store.write_safetensors(tmp_path / "other.safetensors", {"x": torch.zeros(3).numpy()})
    with pytest.raises(InputError, match="not the network it should be"):
        perception_of(VirtualConfig(perception="lpips", lpips_weights=str(tmp_path / "other.safetensors")))
