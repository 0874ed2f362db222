"""Metrics against hand-computed values; pooling over a trajectory; the words for what is missing."""

from __future__ import annotations

import math

import pytest
import torch

from mudg.base.errors import InputError
from mudg.base.geometry import yaw_matrix
from mudg.base.palette import CLASSES, ID
from mudg.base.types import Camera, View
from mudg.core import metrics
from mudg.core.losses import ssim_map
from mudg.core.metrics import METRICS, Pair


def pair(**given) -> Pair:
    names = ("rgb", "depth", "semantics", "truth_rgb", "truth_depth", "truth_depth_valid", "truth_semantics")
    return Pair(**{**dict.fromkeys(names), **given})


def add(metric, **given) -> None:
    metric.add(metric.source(pair(**given)))


def test_psnr_known_value_mask_and_limits():
    truth = torch.zeros(3, 2, 2)
    prediction = torch.zeros(3, 2, 2)
    prediction[:, 0, 0] = 0.1
    assert metrics.psnr(prediction, truth) == pytest.approx(-10 * math.log10(0.01 / 4), abs=1e-5)
    mask = torch.zeros(1, 2, 2, dtype=torch.bool)
    mask[0, 0, 0] = True
    assert metrics.psnr(prediction, truth, mask) == pytest.approx(20.0, abs=1e-5)
    assert metrics.psnr(truth, truth) == math.inf
    assert math.isnan(metrics.psnr(truth, truth, torch.zeros(1, 2, 2, dtype=torch.bool)))
    assert metrics.psnr(truth - 5, truth) == math.inf  # clamped to [0, 1] first


def test_depth_errors_known_values():
    truth = torch.tensor([[[10.0, 20.0, 5.0, 0.0]]])
    prediction = torch.tensor([[[11.0, 30.0, 5.0, 7.0]]])
    errors = metrics.depth_errors(prediction, truth, torch.ones(1, 1, 4, dtype=torch.bool))
    assert errors.pixels == 3  # a truth of 0 m is no truth
    assert errors.abs_rel == pytest.approx((0.1 + 0.5 + 0) / 3, abs=1e-6)
    assert errors.rmse_m == pytest.approx(math.sqrt((1 + 100 + 0) / 3), abs=1e-5)
    assert errors.delta1 == pytest.approx(2 / 3)
    with pytest.raises(InputError, match="not finite"):
        metrics.depth_errors(prediction * math.nan, truth, torch.ones(1, 1, 4, dtype=torch.bool))


def test_confusion_and_iou_by_hand():
    road, car = ID["road"], ID["car"]
    truth = torch.tensor([[road, road, road, car, 255]])
    prediction = torch.tensor([[road, road, car, car, car]])
    counts = metrics.confusion(prediction, truth)
    assert int(counts.sum()) == 4 and int(counts[road, car]) == 1
    assert metrics.iou_of(counts) == {"road": pytest.approx(2 / 3), "car": pytest.approx(1 / 2)}
    truth = torch.zeros(1, 4, dtype=torch.long)
    prediction = torch.tensor([[0, 0, 255, 0]])
    assert metrics.iou_of(metrics.confusion(prediction, truth)) == {CLASSES[0]: pytest.approx(3 / 4)}


def test_miou_and_rmse_are_pooled_over_the_trajectory_not_averaged_over_views():
    metric = metrics.Segmentation("miou")
    for made in (torch.zeros(1, 9, dtype=torch.long), torch.ones(1, 1, dtype=torch.long)):
        add(metric, semantics=made, truth_semantics=torch.zeros_like(made))
    assert metric.value() == pytest.approx(0.9)
    metric, ten = metrics.depth_error("rmse_m"), torch.full((1, 1, 3), 10.0)
    add(metric, depth=ten + 2, truth_depth=ten, truth_depth_valid=ten > 0)
    add(metric, depth=ten[..., :1], truth_depth=ten[..., :1])
    assert metric.value() == pytest.approx(math.sqrt(3 * 4 / 4))


def test_absent_modalities_are_said_in_words():
    accumulators = metrics.build_all()
    rgb = torch.rand(3, 16, 16, generator=torch.Generator().manual_seed(0))
    truth = {"truth_rgb": rgb, "truth_depth": torch.ones(1, 16, 16), "truth_semantics": torch.zeros(16, 16)}
    for metric in accumulators.values():
        add(metric, rgb=rgb, **truth)
    table = metrics.results(accumulators)
    assert table["psnr"] == 100.0 and table["ssim"] == pytest.approx(1.0, abs=1e-6)
    assert {table[name] for name in ("abs_rel", "rmse_m", "delta1", "miou", "accuracy")} == {"not produced"}
    assert {table[name] for name in ("lpips", "fid", "fvd")} == {"not computed"}
    assert set(table) == set(METRICS) and metrics.results(metrics.build_all())["miou"] == "not produced"


def test_a_full_mask_and_none_give_the_same_similarity():
    """Without a mask the native pass answers, with one the map in torch: both are the same number."""
    generator = torch.Generator().manual_seed(0)
    truth = torch.rand(3, 24, 40, generator=generator)
    made = (truth + 0.1 * torch.randn(truth.shape, generator=generator)).clamp(0, 1)
    expected = float(ssim_map(made, truth).double().mean())
    full = torch.ones(1, 24, 40, dtype=torch.bool)
    assert metrics.ssim(made, truth) == pytest.approx(expected, abs=1e-6)
    assert metrics.ssim(made, truth, full) == metrics.ssim(made, truth)
    assert metrics.psnr(made, truth, full) == metrics.psnr(made, truth)
    half = full.clone()
    half[..., 20:] = False
    assert metrics.ssim(made, truth, half) == pytest.approx(
        float(ssim_map(made, truth)[..., :20].double().mean()), abs=1e-6
    )


def test_large_images_are_measured_in_pieces_with_the_same_result(monkeypatch):
    rng = torch.Generator().manual_seed(3)
    made, true = (torch.rand(3, 37, 53, generator=rng) for _ in range(2))
    depth, true_depth = (torch.rand(1, 37, 53, generator=rng) * 80 for _ in range(2))
    ids, true_ids = (torch.randint(0, 22, (37, 53), generator=rng) for _ in range(2))
    mask = torch.rand(1, 37, 53, generator=rng) > 0.2
    view = lambda ahead_m: View(Camera("front", 53, 37, 20.0, 20.0, 26.5, 18.5), yaw_matrix(0.0, (0, 0, ahead_m)), 0.0)
    frames = [metrics.TrueFrame(view(0.4 * n), true_depth + 5 * n, true_ids) for n in (0, 1)]
    motion_of = {1: torch.from_numpy(view(0.4).world_from_cam.copy())}
    moved = metrics.PixelMotion(torch.rand(1, 37, 53, 2, generator=rng) * 2 - 1, mask[0])

    def numbers() -> list[float]:
        depths = metrics.depth_errors(depth, true_depth, mask)
        found = [depths.abs_rel, depths.rmse_m, depths.delta1, depths.pixels, metrics.change(made, true, moved)]
        found += [metrics.psnr(made, true), metrics.psnr(made, true, mask)]
        motion = metrics.pixel_motion(*frames, motion_of, true_ids)
        found += [*motion.there.flatten().tolist(), *motion.same.flatten().tolist()]
        return found + metrics.confusion(ids, true_ids, mask).flatten().tolist()

    whole = numbers()
    monkeypatch.setattr(metrics, "PIECE_VALUES", 100)
    monkeypatch.setattr(metrics, "WHOLE_PIXELS", 500)
    monkeypatch.setattr(metrics, "BAND_PIXELS", 160)
    assert [len(piece) for piece in metrics.pieces_of(made)] == [53] * 3 * 37
    assert [len(piece) for piece in metrics.pieces_of(made[0].flatten())] == [100] * 19 + [61]
    assert numbers() == pytest.approx(whole, rel=1e-12)
