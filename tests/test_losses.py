"""Losses against known values, float64 finite differences, and what they must ignore."""

from __future__ import annotations

import math

import pytest
import torch
from scipy.ndimage import gaussian_filter
from torch import Tensor
from torch.nn import functional

from mudg.base.errors import InputError
from mudg.core import losses, native_ops
from mudg.networks import featnets
from mudg.networks.featnets import FilterBank


def image(seed: int, shape: tuple[int, ...] = (3, 14, 17), dtype: torch.dtype = torch.float64) -> Tensor:
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed), dtype=dtype)


def check_gradient(function, *inputs: Tensor) -> None:
    given = [x.clone().requires_grad_() for x in inputs]
    assert torch.autograd.gradcheck(function, given, eps=1e-6, atol=1e-6, rtol=1e-4)


DEPTHS, SKY = (torch.tensor([0, 5, 7, 11]), torch.tensor([2.0, 3, 9, 1]).double(), 0.75), image(8, (1, 3, 4)) > 0.5
INSIDE, CLASSES = torch.tensor([[[True, True, False]]]), torch.tensor([[0, 2, 255], [1, 1, 0]])
GRADIENTS = {
    "photometric": (lambda x: native_ops.photometric(x, image(2, (3, 7, 8))), image(1, (3, 7, 8))),
    "sparse depth": (lambda d: losses.sparse_depth(d, *DEPTHS), 1 + 5 * image(3, (1, 3, 4))),
    "dense depth": (lambda d: losses.dense_depth_map(d, 30 * image(5, (1, 3, 4))).sum(), 1 + 30 * image(4, (1, 3, 4))),
    "sky": (lambda a: losses.sky_map(a, SKY).sum(), 0.1 + 0.8 * image(7, (1, 3, 4))),
    "semantics": (lambda x: native_ops.class_loss(x, CLASSES, image(6, (2, 3)), 2.0), image(9, (3, 2, 3))),
    "objects": (lambda a: losses.object_map(a, INSIDE).sum(), 0.1 + 0.8 * image(7, (1, 1, 3))),
}


@pytest.mark.parametrize("name", GRADIENTS)
def test_gradients_agree_with_finite_differences(name):
    check_gradient(*GRADIENTS[name])


def test_ssim_agrees_with_an_independent_gaussian_filter_and_photometric_sums_it():
    """scipy's truncated Gaussian of radius 5 is the same 11-tap window; zero padding = mode constant."""
    x, y = image(1, (1, 20, 24)), image(2, (1, 20, 24))

    def blur(t: Tensor) -> Tensor:
        return torch.from_numpy(gaussian_filter(t.numpy(), (0, 1.5, 1.5), mode="constant", radius=(0, 5, 5)))

    mx, my = blur(x), blur(y)
    vx, vy, cov = blur(x * x) - mx**2, blur(y * y) - my**2, blur(x * y) - mx * my
    expected = (2 * mx * my + 1e-4) * (2 * cov + 9e-4) / ((mx**2 + my**2 + 1e-4) * (vx + vy + 9e-4))
    assert torch.allclose(losses.ssim_map(x, y), expected, atol=1e-12)
    assert torch.allclose(losses.ssim_map(x, x), torch.ones_like(x), atol=1e-12)
    x, y = image(1), image(2)
    expected = 0.7 * (x - y).abs().mean() + 0.3 * (1 - losses.ssim_map(x, y).mean())
    assert float(native_ops.photometric(x, y, 0.3)) == pytest.approx(float(expected), abs=1e-14)


def test_masked_pixels_change_nothing_and_get_no_gradient():
    x, y = image(1).requires_grad_(), image(2)
    mask = torch.ones(1, 14, 17, dtype=torch.bool)
    mask[:, 4:9, 5:] = False
    native_ops.photometric(losses.outside_mask_copied(x, y, mask), y).backward()
    assert (x.grad[:, 4:9, 5:] == 0).all() and (x.grad[:, :4] != 0).all()


def test_means_weighted_confident_and_trimmed():
    values = torch.tensor([1.0, 2.0, 6.0], requires_grad=True)
    assert losses.weighted_mean(values, torch.tensor([1.0, 0.0, 3.0])).item() == pytest.approx(19 / 4)
    nothing = losses.weighted_mean(values, torch.zeros(3))
    nothing.backward()
    assert nothing.item() == 0.0 and (values.grad == 0).all()
    values = torch.tensor([[1.0, 2.0], [4.0, 8.0]])
    assert losses.confident_mean(values, torch.tensor([[1.0, 0.0], [0.5, 0.0]])).item() == pytest.approx(3.0 / 4)
    assert losses.confident_mean(values, torch.ones(2, 2)).item() == values.mean().item()
    values = torch.tensor([5.0, 1.0, 2.0, 100.0, 3.0])
    assert float(losses.trimmed_mean(values, 0.8)) == pytest.approx((1 + 2 + 3 + 5) / 4)
    assert float(losses.trimmed_mean(values, 1.0)) == pytest.approx(111 / 5)
    assert float(losses.trimmed_mean(values[:0], 0.95)) == 0.0


def test_depth_losses_at_known_values():
    depth = torch.arange(1.0, 13.0, dtype=torch.float64).view(1, 3, 4)
    places = torch.tensor([1 * 4 + 2, 2 * 4 + 3])
    loss = losses.sparse_depth(depth, places, torch.tensor([7.0, 10.0]).double(), keep=1.0)
    assert float(loss) == pytest.approx((0 / 7 + 2 / 10) / 2)
    two = torch.full((1, 1, 1), 20.0, dtype=torch.float64)
    forty = 2 * two
    expected = math.log(2) - 0.05  # Huber: delta * (|x| - delta / 2), divided by delta = 0.1
    assert float(losses.dense_depth_map(two, forty)) == pytest.approx(expected)
    assert float(losses.dense_depth_map(forty, two)) == pytest.approx(expected)
    assert float(losses.dense_depth_map(two, two)) == 0.0


def test_sky_semantics_and_objects_at_known_values():
    alpha = torch.tensor([[[0.25, 0.25, 1.0, 0.0]]], dtype=torch.float64)
    sky = torch.tensor([[[True, False, True, False]]])
    values = losses.sky_map(alpha, sky)[0, 0]
    assert values[0] == pytest.approx(-math.log(0.75)) and values[1] == pytest.approx(-math.log(0.25))
    assert values[2:].tolist() == pytest.approx([-math.log(1e-3)] * 2)
    logits = torch.zeros(4, 1, 2, dtype=torch.float64)
    logits[2, 0, 0] = math.log(3)
    weight = torch.tensor([[2.0, 9.0]]).double()
    value = native_ops.class_loss(logits, torch.tensor([[2, 255]]), weight, 4.0)
    assert float(value) == pytest.approx(-2 * math.log(3 / 6) / 4)
    values = losses.object_map(torch.tensor([[[0.5, 0.999, 0.5]]], dtype=torch.float64), INSIDE)[0, 0]
    assert values[[0, 2]].tolist() == pytest.approx([math.log(2)] * 2) and values[1] < 0.01
    with pytest.raises(InputError, match="wrong shape"):
        losses.ssim_map(torch.zeros(3, 2, 2), torch.zeros(1, 2, 2))


def distance(a: Tensor, b: Tensor) -> float:
    bank = FilterBank()
    return float(losses.feature_distance(bank(a), bank(b), torch.ones(1, *a.shape[1:], dtype=a.dtype)))


def stripes(phase: float, width_px: float = 6.0) -> Tensor:
    x = torch.arange(64, dtype=torch.float64)
    row = 0.5 + 0.3 * torch.sin(2 * math.pi * (x / width_px + phase))
    return row.expand(3, 48, 64).contiguous()


def test_filter_bank_zero_for_equal_images_and_gradient():
    x = image(3, (3, 8, 9))
    assert distance(image(3, (3, 16, 20)), image(3, (3, 16, 20))) == 0.0
    bank, weight = FilterBank(scales=2), image(1, (1, 8, 9))
    target = bank(image(4, (3, 8, 9)))
    check_gradient(lambda p: losses.feature_distance(bank(p), target, weight), x)


def test_feature_distance_and_slopes_are_those_of_plain_formulas():
    smooth, slope = torch.tensor([1.0, 2, 1]).double() / 4, torch.tensor([-1.0, 0, 1]).double() / 2
    kernels = torch.stack([torch.outer(smooth, slope), torch.outer(slope, smooth)])[:, None]
    plane, upstream = image(5, (1, 14, 19))[None].requires_grad_(), image(6, (2, 12, 17))[None]
    wanted, found = functional.conv2d(plane, kernels), featnets._Slope.apply(plane)
    assert torch.allclose(found, wanted, atol=1e-14)
    (of_wanted,), (of_found,) = (torch.autograd.grad(out, plane, upstream) for out in (wanted, found))
    assert torch.allclose(of_found, of_wanted, atol=1e-14)
    mine, theirs = image(7, (4, 9, 11)).requires_grad_(), image(8, (4, 9, 11))
    theirs[:, 2, 3] = mine.detach()[:, 2, 3]  # no slope there
    weight = image(9, (1, 9, 11))
    wanted = losses.confident_mean((mine - theirs).abs(), weight)
    found = losses.feature_distance([mine], [theirs], weight)
    assert torch.allclose(found, wanted, atol=1e-14)
    (of_wanted,), (of_found,) = (torch.autograd.grad(2 * out, mine) for out in (wanted, found))
    assert torch.allclose(of_found, of_wanted, atol=1e-14)


def test_filter_bank_prefers_a_shifted_texture_to_a_blurred_one():
    """L1 prefers the blur (that is why it blurs); the filter bank must not."""
    truth, shifted, blurred = stripes(0.0), stripes(0.5), torch.full((3, 48, 64), 0.5, dtype=torch.float64)
    assert (shifted - truth).abs().mean() > 1.5 * (blurred - truth).abs().mean()
    assert distance(shifted, truth) < distance(blurred, truth)


def test_pixel_terms_at_known_values():
    """Everything right: no error, and the stated scale costs its own logarithm. Colour off by 0.1: L1 and square."""
    ids = torch.randint(0, 19, (1, 4, 4), generator=torch.Generator().manual_seed(0))
    scores = 50.0 * torch.nn.functional.one_hot(ids, 19).movedim(-1, 1).float()
    rgb, code = torch.zeros(1, 3, 4, 4), torch.zeros(1, 1, 4, 4)
    weight = 1.0 + 2.0 * (ids == 10).unsqueeze(1)
    assert float(losses.image_error(rgb, square=2.0, gradient=0.5)) == 0
    assert float(losses.depth_code_error(code, code, weight, 1.0)) == 0
    assert float(losses.class_error(scores, ids, None)) == pytest.approx(0, abs=1e-6)
    assert float(losses.stated_error(torch.full_like(code, -3.0), rgb)) == pytest.approx(-3.0)
    assert float(losses.image_error(rgb + 0.1, square=2.0, gradient=0.5)) == pytest.approx(0.1 + 2 * 0.01, rel=1e-5)
    apart = losses.depth_code_error(code + 0.1, code, weight, log_per_code=2.0)
    assert float(apart) == pytest.approx(5 * float(weight.mean()) * (math.expm1(0.2) - 0.0025), rel=1e-4)
    assert float(losses.class_error(scores, torch.full_like(ids, 255), None)) == 0
    error = torch.full((1, 3, 4, 4), 0.3, requires_grad=True)
    log_error = torch.full((1, 1, 4, 4), -1.0, requires_grad=True)
    losses.stated_error(log_error, error).backward()
    assert error.grad is None or float(error.grad.abs().sum()) == 0
    assert float(log_error.grad.sum()) != 0


def test_latent_terms_at_known_values():
    truth, weight = torch.zeros(2, 1, 4, 2, 2), torch.tensor([1.0, 5.0]).view(2, 1, 1, 1, 1)
    assert float(losses.latent_error(truth + 0.1, truth, weight)) == pytest.approx(0.03, rel=1e-5)
    half = torch.tensor([1.0, 0.0]).view(2, 1, 1, 1, 1)  # the second clip's depth is not known
    found = losses.latent_depth_error(truth + 0.1, truth, weight, half)
    assert float(found) == pytest.approx(0.5 * 5 * 0.005, rel=1e-5)
    shares = torch.zeros(1, 1, 3, 1, 2)
    shares[:, :, 0, :, 0] = 1.0  # one cell of class 0, one without a class
    stated = torch.full_like(shares, math.log(1 / 3))
    assert float(losses.share_cross_entropy(stated, shares, None)) == pytest.approx(math.log(3) / 2, rel=1e-6)
    weighted = losses.share_cross_entropy(stated, shares, torch.tensor([2.0, 1.0, 1.0]))
    assert float(weighted) == pytest.approx(math.log(3), rel=1e-6)
