"""Perceptual distance, flicker and dynamic objects: known degradations, known values, the scorer."""

from __future__ import annotations

import dataclasses
import io
from collections.abc import Callable

import numpy as np
import pytest
import score_goldens
import torch
import toy_views
from PIL import Image
from refusals import refused
from test_metrics import pair
from torch.nn import functional

from mudg.base import store
from mudg.base.types import Camera, View
from mudg.city.config import CityConfig
from mudg.city.world import CityWorld
from mudg.core import losses as perceptual
from mudg.core import metrics
from mudg.diffusion import model_files as files
from mudg.editing.settings import ScoreConfig
from mudg.networks.featnets import CodecFeatures, LpipsFeatures, PerceptualDistance, lpips_shapes
from mudg.scoring import tables as score_tables
from mudg.steps.render import Score


@pytest.fixture(scope="module")
def pictures():
    """Two views of different cities, f32[3, 128, 192]."""
    found = []
    for seed in (11, 12):
        world = CityWorld(CityConfig(seed=seed, n_frames=4, width=192, height=128, cameras=("front",)))
        rgb = world.render(world.frame_views("front")[2]).rgb.copy()
        found.append(torch.from_numpy(rgb).permute(2, 0, 1).contiguous())
    return found


@pytest.fixture(scope="module")
def distance():
    perceptual_of = PerceptualDistance(CodecFeatures(files.load("embedded").codec))
    return lambda made, truth, mask=None: perceptual_of(pair(rgb=made, truth_rgb=truth, mask=mask))


def blurred(rgb, sigma):
    reach = int(3 * sigma) + 1
    kernel = torch.exp(-(torch.arange(-reach, reach + 1.0) ** 2) / (2 * sigma**2))
    kernel = (kernel / kernel.sum()).expand(3, 1, 1, -1)
    padded = functional.pad(rgb[None], (reach,) * 4, mode="replicate")
    return functional.conv2d(functional.conv2d(padded, kernel, groups=3), kernel.transpose(2, 3), groups=3)[0]


def noisy(rgb, sigma):
    return (rgb + sigma * torch.randn(rgb.shape, generator=torch.Generator().manual_seed(0))).clamp(0, 1)


def jpeg(rgb, quality):
    target = io.BytesIO()
    Image.fromarray((rgb * 255).round().byte().permute(1, 2, 0).numpy()).save(target, "JPEG", quality=quality)
    return torch.from_numpy(np.array(Image.open(target))).permute(2, 0, 1) / 255


def scrambled(rgb, seed=0):
    """Blocks of 4x4 pixels change places within 32x32: colours stay, what is drawn does not."""
    blocks = rgb.reshape(3, 4, 8, 4, 6, 8, 4).permute(1, 4, 2, 5, 0, 3, 6).reshape(24, 64, 3, 4, 4)
    order = torch.stack([torch.randperm(64, generator=torch.Generator().manual_seed(seed + n)) for n in range(24)])
    moved = torch.stack([cell[o] for cell, o in zip(blocks, order)])
    return moved.reshape(4, 6, 8, 8, 3, 4, 4).permute(4, 0, 2, 5, 1, 3, 6).reshape(3, 128, 192)


def test_equal_pictures_are_0_apart_only_masked_in_pixels_count_and_odd_sizes_work(pictures, distance):
    assert distance(pictures[0], pictures[0]) == 0.0
    truth = pictures[0][:, :125, :187]
    spoilt = truth.clone()
    spoilt[:, :, 120:] = 0.5
    mask = torch.zeros(1, 125, 187, dtype=torch.bool)
    mask[..., :40] = True
    assert distance(spoilt, truth, mask) < 1e-6 < distance(spoilt, truth)


def test_degradations_are_ordered_as_people_see_them_where_psnr_is_not(pictures, distance):
    truth = pictures[0]
    darker, moved = truth * 0.9, torch.roll(truth, 1, 2)
    soft, wrong = blurred(truth, 2.0), scrambled(truth)
    changed = {"darker": darker, "moved": moved, "soft": soft, "wrong": wrong}
    apart = {name: distance(x, truth) for name, x in changed.items()}
    assert apart["darker"] < apart["moved"] < apart["soft"] < apart["wrong"]
    assert apart["wrong"] > 3 * apart["soft"]  # the wrong texture is farther than none
    assert distance(pictures[1], truth) > 3 * apart["soft"]
    # Of a picture a tenth darker and one with visible blocks, PSNR takes the blocks.
    assert metrics.psnr(jpeg(truth, 20), truth) > metrics.psnr(darker, truth)
    assert distance(jpeg(truth, 20), truth) > 2 * apart["darker"]


def lpips(prediction, truth, **more):
    return float(perceptual.lpips_distance(prediction, perceptual.unit_features(truth), **more))


def test_lpips_distance_by_hand():
    a, b = torch.tensor([[[3.0, 1.0]], [[4.0, 0.0]]]), torch.tensor([[[6.0, 0.0]], [[8.0, 2.0]]])
    # First place: the same direction; second: right angles, squared distance of unit vectors 2.
    assert lpips([a], [b]) == pytest.approx(1.0, abs=1e-6)
    assert lpips([a, a], [b, a]) == pytest.approx(0.5, abs=1e-6)
    assert lpips([a, a], [b, a], channel_weights=[torch.tensor([1.0, 0.0])] * 2) == pytest.approx(0.5, abs=1e-6)
    second = torch.tensor([[[False, True]]])
    assert lpips([a], [b], weight=~second, over_weight=True) == pytest.approx(0.0, abs=1e-6)
    assert lpips([a], [b], weight=second, over_weight=True) == pytest.approx(2.0, abs=1e-6)
    assert lpips([a], [b], weight=second) == pytest.approx(1.0, abs=1e-6)  # of two places
    assert np.isnan(lpips([a], [b], weight=second & ~second, over_weight=True))
    refused("shape", lpips, [a], [b[..., :1]])


def test_places_without_features_pass_a_finite_gradient():
    y = torch.rand(4, 3, 3, generator=torch.Generator().manual_seed(2))
    for value in (0.0, 1e-30):  # the square of the second is 0 in float32
        x = torch.full((4, 3, 3), value)
        x[:, 0] = 1.0
        x.requires_grad_()
        perceptual.lpips_distance([x], perceptual.unit_features([y])).backward()
        assert bool(torch.isfinite(x.grad).all()) and float(x.grad[:, 0].abs().max()) > 0
        assert float(x.grad[:, 1:].abs().max()) == 0


def lpips_state(trunk="alex"):
    generator = torch.Generator().manual_seed(0)
    state = {}
    for name, shape in lpips_shapes(trunk).items():
        draw = torch.randn(shape, generator=generator)
        fan_in = draw[0].numel() if name.startswith("net.") and name.endswith("weight") else 100
        state[name] = draw.abs() if name.startswith("lin") else draw / fan_in**0.5
    return state


def lpips_twin(made, truth, state, trunk, taps, scaled=True):
    """LPIPS in float64 from torch's layers and the paper's equation, and how many layers features are read from."""
    trunk = trunk.double()
    trunk.load_state_dict({name.split(".", 2)[2]: v.double() for name, v in state.items() if name.startswith("net.")})
    x = torch.stack([made, truth]).double()
    mean = torch.tensor([-0.030, -0.088, -0.188]).double().view(3, 1, 1)
    deviation = torch.tensor([0.458, 0.448, 0.450]).double().view(3, 1, 1)
    x, total, stage = ((x * 2 - 1 if scaled else x) - mean) / deviation, 0.0, 0
    with torch.no_grad():
        for number, layer in enumerate(trunk):
            x = layer(x)
            if number in taps:
                a, b = functional.normalize(x, dim=1)
                total += float(((a - b) ** 2 * state[f"lin{stage}.model.1.weight"][0].double()).sum(0).mean())
                stage += 1
    return total, stage


def test_incomplete_lpips_weights_are_refused_and_named(tmp_path):
    state = lpips_state()
    del state["lin3.model.1.weight"]
    refused("lin3.model.1.weight", LpipsFeatures, state, "file")
    refused("too small", LpipsFeatures(lpips_state()), torch.zeros(3, 20, 64))


# ---- flicker and dynamic objects -----------------------------------------------------------------


def still_pair(number, made_noise):
    """A wall 10 m ahead whose true picture flickers by 0.1 and the made one by ``made_noise``."""
    wall = torch.rand(3, 12, 16, generator=torch.Generator().manual_seed(0)) * 0.2 + 0.4
    sign = 1.0 if number % 2 else -1.0
    view = View(Camera("front", 16, 12, 20.0, 20.0, 8.0, 6.0), np.eye(4), 0.1 * number)
    depth, ids = torch.full((1, 12, 16), 10.0), torch.full((12, 16), 2)
    depth[:, :3], ids[:3] = 0.0, 10  # sky: no depth
    true = {"truth_rgb": wall + sign * 0.05, "truth_depth": depth, "truth_semantics": ids}
    return pair(rgb=wall + sign * made_noise / 2, view=view, **true)


def test_flicker_is_change_of_static_surfaces_over_that_of_the_truth():
    metric = metrics.flicker_over_truth()
    assert metric.value() is None
    for number in range(4):
        metric.add(metric.source(still_pair(number, 0.25)))
    assert metric.value() == pytest.approx(2.5, rel=1e-4)
    alone = metrics.flicker_over_truth()
    alone.add(alone.source(still_pair(0, 0.25)))
    assert alone.value() is None


def test_flicker_of_several_methods_shares_what_the_truth_does():
    motion = metrics.ExactMotion()
    shared = [metrics.flicker_over_truth(motion) for _ in range(3)]
    alone = [metrics.flicker_over_truth() for _ in range(3)]
    for number in range(4):
        true = still_pair(number, 0.0)
        for place, noise in enumerate((0.1, 0.25, 0.0)):
            made = dataclasses.replace(true, rgb=still_pair(number, noise).rgb)
            shared[place].add(made)
            alone[place].add(made)
    assert [one.value() for one in shared] == [one.value() for one in alone]
    assert shared[1].value() == pytest.approx(2.5, rel=1e-4) and motion.between(pair(), pair()) is None


def test_psnr_of_dynamic_objects_counts_their_pixels_only_and_leaves_specks_out():
    truth = torch.zeros(3, 40, 50)
    made = truth.clone()
    moving = torch.zeros(1, 40, 50, dtype=torch.bool)
    moving[:, 10:20, 10:20] = True
    made[:, 10:20, 10:20] = 0.1
    made[:, 30:] = 1.0  # elsewhere
    of = metrics.build_all()["psnr_movers"]
    of.add(of.source(pair(rgb=made, truth_rgb=truth, moving=moving)))
    assert of.value() == pytest.approx(20.0, abs=1e-4)
    speck = torch.zeros_like(moving)
    speck[0, 0, 0] = True
    empty = metrics.build_all()["psnr_movers"]
    empty.add(empty.source(pair(rgb=made, truth_rgb=truth, moving=speck)))
    empty.add(empty.source(pair(rgb=made, truth_rgb=truth)))
    assert empty.value() is None


# ---- in the scorer -------------------------------------------------------------------------------


def test_a_recorded_log_has_a_perceptual_distance_but_no_flicker_and_no_dynamic_objects(tmp_path):
    scene = toy_views.write_scene(tmp_path / "scene")

    def grey(_index, seen):
        return dataclasses.replace(seen, rgb=torch.full_like(seen.rgb, 0.5))

    plain = toy_views.write_views(scene, tmp_path / "a", "a", (0.0,))
    views = {"a": plain, "b": toy_views.write_views(scene, tmp_path / "b", "b", (0.0,), grey)}

    def scored(name, config):
        out = Score(scene=scene, views=views, out=tmp_path / name, settings=config).run()
        return {r["method"]: r["values"] for r in store.read_json(out / "metrics.json")["results"]}

    values = scored("score", ScoreConfig())
    assert values["a"]["perceptual"] == pytest.approx(0.0, abs=1e-6)
    assert values["b"]["perceptual"] > 0.05
    assert values["a"]["flicker"] == values["a"]["psnr_movers"] == score_tables.NO_TRUTH
    assert values["a"]["lpips"] == "not computed"
    store.write_safetensors(tmp_path / "lpips.safetensors", {name: v.numpy() for name, v in lpips_state().items()})
    config = ScoreConfig(perceptual_views=0, lpips_weights=str(tmp_path / "lpips.safetensors"))
    values = scored("other", config)
    assert values["a"]["perceptual"] == score_tables.NOT_REQUESTED
    assert values["a"]["lpips"] == pytest.approx(0.0, abs=1e-6) != values["b"]["lpips"]


# ---- the other networks of LPIPS -----------------------------------------------------------------


def torchvision_trunk(name):
    """Layers in torchvision's numbering, and after which of them features are read."""
    conv, relu, pool = torch.nn.Conv2d, torch.nn.ReLU, torch.nn.MaxPool2d
    if name == "alex":
        layers = [conv(3, 64, 11, 4, 2), relu(), pool(3, 2), conv(64, 192, 5, padding=2), relu(), pool(3, 2)]
        for into, out in ((192, 384), (384, 256), (256, 256)):
            layers += [conv(into, out, 3, padding=1), relu()]
        return torch.nn.Sequential(*layers), (1, 4, 7, 9, 11)
    layers, into = [], 3
    for out in (64, 64, "M", 128, 128, "M", 256, 256, 256, "M", 512, 512, 512, "M", 512, 512, 512):
        layers += [pool(2, 2)] if out == "M" else [conv(into, out, 3, padding=1), relu()]
        into = into if out == "M" else out
    return torch.nn.Sequential(*layers), (3, 8, 15, 22, 29)


@pytest.mark.parametrize("name", ["alex", pytest.param("vgg", marks=pytest.mark.slow)])
@pytest.mark.parametrize("given", ["correct", "unscaled"])
def test_lpips_equals_its_float64_twin(pictures, name, given):
    state, truth = lpips_state(name), pictures[0][:, :70, :75]
    made = blurred(truth, 1.0)
    total, stage = lpips_twin(made, truth, state, *torchvision_trunk(name), scaled=given == "correct")
    network = LpipsFeatures(state, "file", name, given)
    assert stage == len(network.channel_weights)
    apart = PerceptualDistance(network, network.channel_weights)(pair(rgb=made, truth_rgb=truth))
    assert apart == pytest.approx(total, rel=1e-4)


# ---- the networks of the scores still give the recorded features ---------------------------------


@pytest.mark.parametrize("part", [score_goldens.inception_values, score_goldens.i3d_values])
def test_features_are_the_recorded_ones(part: Callable[[], dict[str, np.ndarray]]) -> None:
    recorded = store.read_safetensors(score_goldens.PATH)
    for name, value in part().items():
        assert value.shape == recorded[name].shape
        apart = np.abs(value.astype(np.float64) - recorded[name]).max() / np.abs(recorded[name]).max()
        assert apart < 1e-4, name  # other processors add up in another order; measured 0 on the same one
        assert np.ptp(recorded[name]) > 0
