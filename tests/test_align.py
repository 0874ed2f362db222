"""Alignment of generated depth to measured depth."""

import math

import pytest
import torch

from mudg.base.errors import InputError
from mudg.core.depth import align_depth, fit_depth


def some(seed=0):
    """True depth, and which pixels were measured."""
    generator = torch.Generator().manual_seed(seed)
    truth = 3 + 60 * torch.rand(1, 20, 30, generator=generator)
    return truth, torch.rand(1, 20, 30, generator=generator) < 0.5, generator


def test_scale_and_shift_are_recovered():
    truth, valid, _ = some()
    fit = fit_depth((truth - 2.0) / 1.25, truth, valid)
    assert fit.scale == pytest.approx(1.25, rel=1e-4)
    assert fit.shift_m == pytest.approx(2.0, abs=1e-3)
    assert fit.used
    assert fit.residual < 1e-4 < fit.residual_before


def test_wrongly_painted_surfaces_do_not_pull():
    """A fifth of the pixels lies on a surface at a wrong distance, and all carry 1 % noise."""
    truth, valid, generator = some(1)
    painted = (truth - 1.0) / 0.9 * (1 + 0.01 * torch.randn(truth.shape, generator=generator))
    painted[:, :4] = 70.0
    aligned, (fit,) = align_depth(painted[None], truth[None], valid[None])
    assert fit.scale == pytest.approx(0.9, rel=0.02)
    assert fit.shift_m == pytest.approx(1.0, abs=0.2)
    error = (aligned[0, :, 4:] / truth[:, 4:] - 1).abs()
    assert float(error.mean()) < 0.015


def test_too_little_or_nothing_to_align_to_leaves_the_frame_alone():
    truth, valid, _ = some(2)
    few = torch.zeros_like(valid)
    few[:, 0, :10] = True
    for mask in (few, torch.zeros_like(valid)):
        aligned, (fit,) = align_depth(2 * truth[None], truth[None], mask[None])
        assert not fit.used
        assert torch.equal(aligned[0], 2 * truth)
    assert math.isnan(fit.residual)


def test_a_hopeless_fit_is_not_applied():
    """Depth that has nothing to do with the measurement: whatever is fitted must not make it worse."""
    truth, valid, generator = some(3)
    painted = 3 + 60 * torch.rand(truth.shape, generator=generator)
    fit = fit_depth(painted, truth, valid)
    assert fit.residual <= fit.residual_before


def test_shapes_must_agree():
    truth, valid, _ = some()
    with pytest.raises(InputError):
        fit_depth(truth, truth[:, 1:], valid)
