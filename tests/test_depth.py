"""Completion of sparse depth, and alignment of generated depth to measured depth: exact where the answer is known,
honest about where it is not."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from refusals import refused
from scipy import ndimage

from mudg.base.types import Camera, View
from mudg.core import depth as depth_module
from mudg.core.depth import align_depth, beyond_reach, complete_depth, fit_depth, ray_elevation

HEIGHT, WIDTH, FOCAL = 60, 90, 80.0
CAMERA = Camera("c", WIDTH, HEIGHT, FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2)
LEVEL = np.array([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 1.5], [0, 0, 0, 1]])


def street() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Colours, depth and sky: a road, a wall that recedes on the left, a car across, sky above the horizon
    elsewhere."""
    row, column = np.indices((HEIGHT, WIDTH)) + 0.5
    x, y = (column - WIDTH / 2) / FOCAL, (row - HEIGHT / 2) / FOCAL
    road = np.where(y > 0.01, 1.5 / np.maximum(y, 0.01), np.inf)
    wall = np.where(x < -0.05, -4.0 / np.minimum(x, -0.05), np.inf)
    car = np.where((np.abs(x) < 0.15) & (y > -0.05) & (y < 0.14), 10.0, np.inf)
    layers = np.stack([road, wall, car])
    depth, which = layers.min(0), layers.argmin(0)
    sky = depth > 60
    colors = np.array([[90, 90, 95], [180, 120, 80], [40, 50, 160]], np.uint8)[which]
    colors[sky] = 235
    return colors, np.where(sky, np.nan, depth).astype(np.float32), sky


def sampled(depth: np.ndarray, rows: int = 6, first: int = 15) -> np.ndarray:
    """Rows of measurements, as a scanner leaves them; none above row ``first``."""
    out = np.full_like(depth, np.nan)
    out[first::rows, ::2] = depth[first::rows, ::2]
    return out


def relative_error(found: np.ndarray, truth: np.ndarray) -> np.ndarray:
    return np.abs(found / truth - 1)


def test_it_beats_the_nearest_measurement_and_its_error_falls_with_confidence() -> None:
    rgb, depth, sky = street()
    measured = sampled(depth)
    dense = complete_depth(rgb, measured, sky)
    index = ndimage.distance_transform_edt(np.isnan(measured), return_distances=False, return_indices=True)
    near = measured[index[0], index[1]]
    ours, theirs = relative_error(dense.depth, depth)[~sky].mean(), relative_error(near, depth)[~sky].mean()
    assert ours < 0.05 and ours < 0.5 * theirs
    error, sure = relative_error(dense.depth, depth)[~sky], dense.confidence[~sky]
    assert ((sure >= 0) & (sure <= 1)).all()
    limits = np.quantile(sure, [0, 0.25, 0.5, 0.75, 1])
    means = [error[(sure >= low) & (sure <= high)].mean() for low, high in zip(limits[:-1], limits[1:])]
    assert means[0] > 3 * means[1] and means[1] >= means[3]


def test_an_upright_wall_goes_on_above_the_beams() -> None:
    rgb, depth, sky = street()
    dense = complete_depth(rgb, sampled(depth, first=30), sky)
    above = np.zeros_like(sky)
    above[:28, :30] = True
    assert np.median(relative_error(dense.depth, depth)[above & ~sky]) < 0.05


def test_a_slanted_plane_is_found_to_a_thousandth() -> None:
    row, column = np.indices((HEIGHT, WIDTH))
    depth = (1 / (0.05 + 0.0004 * column + 0.0006 * row)).astype(np.float32)
    dense = complete_depth(np.full((HEIGHT, WIDTH, 3), 120, np.uint8), sampled(depth, first=0))
    inner = np.s_[4:-8, 4:-4]
    assert relative_error(dense.depth, depth)[inner].max() < 0.01
    assert relative_error(dense.depth, depth)[inner].mean() < 1e-3


def test_a_wrong_measurement_does_not_last_and_sky_pulls_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    rgb, depth, sky = street()
    measured = sampled(depth)
    measured[51, 44] = 30.0  # on the road, where 6 m is right
    dense = complete_depth(rgb, measured, sky)
    assert abs(dense.depth[51, 45] / depth[51, 45] - 1) < 0.1
    monkeypatch.setattr(depth_module, "SKY_M", 77.0)
    other = complete_depth(rgb, measured, sky)
    assert (other.depth[sky] == 77).all() and np.array_equal(dense.depth[~sky], other.depth[~sky])


def test_nothing_measured_is_nothing_known_and_bad_input_is_named() -> None:
    rgb, depth, sky = street()
    dense = complete_depth(rgb, np.full_like(depth, np.nan), sky)
    assert np.isnan(dense.depth[~sky]).all() and (dense.confidence[~sky] == 0).all()
    refused("wrong shape", complete_depth, rgb[:-1], depth, sky)
    refused("positive", complete_depth, rgb, np.where(np.isfinite(depth), -depth, np.nan).astype(np.float32), sky)


@pytest.mark.parametrize("count", [1, 2, 5])
def test_a_few_measurements_are_enough_for_finite_depth(count: int) -> None:
    rgb, depth, _ = street()
    measured = np.full_like(depth, np.nan)
    measured[50, 10 : 10 + count] = 6.0
    dense = complete_depth(rgb, measured)
    assert np.isfinite(dense.depth).all() and (dense.depth > 0).all()


def test_what_does_not_answer_is_far() -> None:
    view = View(CAMERA, LEVEL, 0.0)
    rgb = np.full((HEIGHT, WIDTH, 3), 100, np.uint8)
    rgb[:, 30:60] = 180
    measured = np.full((HEIGHT, WIDTH), np.nan, np.float32)
    measured[::3, :28], measured[::3, 62:] = 12.0, 12.0
    beyond = beyond_reach(view, measured, 0.35, gap_deg=3.0)
    assert beyond[20, 45]
    assert not beyond[55, 45]  # below the horizon
    assert not beyond[:, :30].any()
    dense = complete_depth(rgb, measured, None, beyond)
    assert dense.depth[20, 45] > 70 and dense.confidence[20, 45] < 0.5
    assert abs(dense.depth[20, 10] / 12 - 1) < 0.01
    elevation = ray_elevation(View(CAMERA, LEVEL, 0.0))
    assert elevation[HEIGHT // 2 - 1, WIDTH // 2] == pytest.approx(0.5 / FOCAL, rel=1e-3)
    assert (np.diff(elevation, axis=0) < 0).all()


# -- alignment --------------------------------------------------------------------------------------


def measured_half(seed: int = 0) -> tuple[torch.Tensor, torch.Tensor, torch.Generator]:
    """True depth, and which pixels were measured."""
    generator = torch.Generator().manual_seed(seed)
    truth = 3 + 60 * torch.rand(1, 20, 30, generator=generator)
    return truth, torch.rand(1, 20, 30, generator=generator) < 0.5, generator


def test_scale_and_shift_are_recovered() -> None:
    truth, valid, _ = measured_half()
    fit = fit_depth((truth - 2.0) / 1.25, truth, valid)
    assert fit.scale == pytest.approx(1.25, rel=1e-4) and fit.shift_m == pytest.approx(2.0, abs=1e-3)
    assert fit.used and fit.residual < 1e-4 < fit.residual_before
    refused(".", fit_depth, truth, truth[:, 1:], valid)


def test_wrongly_painted_surfaces_do_not_pull() -> None:
    """A fifth of the pixels lies on a surface at a wrong distance, and all carry 1 % noise."""
    truth, valid, generator = measured_half(1)
    painted = (truth - 1.0) / 0.9 * (1 + 0.01 * torch.randn(truth.shape, generator=generator))
    painted[:, :4] = 70.0
    aligned, (fit,) = align_depth(painted[None], truth[None], valid[None])
    assert fit.scale == pytest.approx(0.9, rel=0.02) and fit.shift_m == pytest.approx(1.0, abs=0.2)
    error = (aligned[0, :, 4:] / truth[:, 4:] - 1).abs()
    assert float(error.mean()) < 0.015


def test_too_little_or_nothing_to_align_to_leaves_the_frame_alone() -> None:
    truth, valid, _ = measured_half(2)
    few = torch.zeros_like(valid)
    few[:, 0, :10] = True
    for mask in (few, torch.zeros_like(valid)):
        aligned, (fit,) = align_depth(2 * truth[None], truth[None], mask[None])
        assert not fit.used and torch.equal(aligned[0], 2 * truth)
    assert math.isnan(fit.residual)


def test_a_hopeless_fit_is_not_applied() -> None:
    """Depth that has nothing to do with the measurement: whatever is fitted must not make it worse."""
    truth, valid, generator = measured_half(3)
    painted = 3 + 60 * torch.rand(truth.shape, generator=generator)
    fit = fit_depth(painted, truth, valid)
    assert fit.residual <= fit.residual_before
