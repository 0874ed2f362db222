"""Every loss of fits and of the diffusion model: pure functions, float32 and float64, differentiable in the prediction.
Masks are boolean and never change the shape of the work. ``core.native_ops`` holds native twins of some."""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from typing import Any, Final

import torch
import torch.nn.functional as F
from torch import Tensor
from torch.autograd.function import once_differentiable

from mudg.base.palette import UNLABELLED
from mudg.base.types import check_shape

# perceptual: distances in the features of a network or a filter bank ----------------------------------


LPIPS_EPSILON: Final = 1e-10


def unit_features(stages: Sequence[Tensor]) -> list[Tensor]:
    """Feature vectors of every place brought to length 1 as LPIPS does it: ``x / (|x| + 1e-10)``; per stage ``[C_l,
    h_l, w_l]``.

    A place without any feature has no direction: it stays 0 and passes no gradient, where the root would pass NaN.
    """
    units = []
    for features in stages:
        squared = features.square().sum(0, keepdim=True)
        there = squared > 0
        length = torch.where(there, squared, 1.0).sqrt() + LPIPS_EPSILON
        units.append(torch.where(there, features / length, 0.0))
    return units


def lpips_distance(
    prediction: Sequence[Tensor],
    target_units: Sequence[Tensor],
    weight: Tensor | None = None,
    channel_weights: Sequence[Tensor] | None = None,
    *,
    over_weight: bool = False,
) -> Tensor:
    """LPIPS (Zhang et al. 2018, eq. 1) in the features of any network; differentiable in the prediction.

    Per stage: every place's feature vector is brought to length 1, the squared difference is summed over channels and
    averaged over places; the stages are averaged (without ``channel_weights``) or summed (with them, as LPIPS does): 0
    for equal images, NaN when nothing counts. InputError: the two have other shapes.

    Args:
        prediction: features of one image, per stage ``[C_l, h_l, w_l]``.
        target_units: ``unit_features`` of the other image, same shapes.
        weight: ``[1, H, W]`` in [0, 1] at full size, averaged down to each stage (default 1).
        channel_weights: per stage ``[C_l]`` for the squared differences (default 1).
        over_weight: what a weighted sum is divided by. False: the number of places, so that an image of which little is
            certain also weighs little (loss). True: the sum of the weights, so that only chosen pixels count (score).
    """
    total = prediction[0].new_zeros(())
    for stage, (features, target) in enumerate(zip(prediction, target_units, strict=True)):
        check_shape(features, f"features of an image, stage {stage}", tuple(target.shape))
        squared = (unit_features([features])[0] - target) ** 2
        if channel_weights is not None:
            squared = squared * channel_weights[stage].view(-1, 1, 1)
        places = squared.sum(0)
        if weight is None:
            total = total + places.mean()
            continue
        share = F.adaptive_avg_pool2d(weight.to(places.dtype), (places.shape[-2], places.shape[-1]))[0]
        weighted = places * share
        total = total + (weighted.sum() / share.sum() if over_weight else weighted.mean())
    return total if channel_weights is not None else total / len(prediction)


# losses -------------------------------------------------------------------------------------------


SSIM_WINDOW: Final = 11
SSIM_SIGMA_PX: Final = 1.5
SSIM_C1: Final = 0.01**2
SSIM_C2: Final = 0.03**2
MAX_LOG_RATIO: Final = 2.0
"""Depth painted farther than e^2 times the truth costs no more than that."""


def weighted_mean(values: Tensor, weight: Tensor) -> Tensor:
    """Sum of ``values * weight`` over sum of ``weight`` (broadcast); zero, still differentiable, where nothing
    weighs."""
    weight = weight.to(values.dtype).expand_as(values)
    return (values * weight).sum() / weight.sum().clamp_min(1e-12)


def confident_mean(values: Tensor, weight: Tensor) -> Tensor:
    """Mean over **all** pixels of ``values * weight`` (broadcast): an observation that is sure of little also weighs
    little.

    ``weighted_mean`` would blow the few sure pixels up to the weight of a whole image.
    """
    return (values * weight.to(values.dtype)).mean()


# ---- colour --------------------------------------------------------------------------------------


@functools.lru_cache(maxsize=8)  # nothing is sent to a device in every step
def _window(dtype: torch.dtype, device: torch.device) -> Tensor:
    offset = torch.arange(SSIM_WINDOW, dtype=torch.float64) - SSIM_WINDOW // 2
    weights = torch.exp(-(offset**2) / (2 * SSIM_SIGMA_PX**2))
    return (weights / weights.sum()).to(device, dtype)


def ssim_map(prediction: Tensor, target: Tensor) -> Tensor:
    """Structural similarity at every pixel and channel (Wang et al. 2004), ``[C, H, W]`` in, ``[C, H, W]`` out, <= 1.

    11x11 Gaussian window with sigma 1.5 px, zero padding, C1 = 0.01^2, C2 = 0.03^2, for values in [0, 1].
    """
    check_shape(target, "ssim_map", tuple(prediction.shape))
    channels, half = prediction.shape[0], SSIM_WINDOW // 2
    window = _window(prediction.dtype, prediction.device).repeat(5 * channels, 1, 1, 1)
    stack = torch.cat([prediction, target, prediction**2, target**2, prediction * target])[None]
    across = F.conv2d(stack, window, padding=(0, half), groups=5 * channels)
    blurred = F.conv2d(across, window.transpose(2, 3), padding=(half, 0), groups=5 * channels)
    mean_p, mean_t, square_p, square_t, product = blurred[0].split(channels)
    variance_p, variance_t = square_p - mean_p**2, square_t - mean_t**2
    covariance = product - mean_p * mean_t
    luminance = (2 * mean_p * mean_t + SSIM_C1) / (mean_p**2 + mean_t**2 + SSIM_C1)
    return luminance * (2 * covariance + SSIM_C2) / (variance_p + variance_t + SSIM_C2)


def outside_mask_copied(prediction: Tensor, target: Tensor, mask: Tensor | None) -> Tensor:
    """The prediction with the target copied in where ``mask`` (bool ``[1, H, W]``) is False.

    Image losses then see no difference there and pass no gradient, while their windows stay full.
    """
    return prediction if mask is None else torch.where(mask, prediction, target)


# ---- depth ---------------------------------------------------------------------------------------


def trimmed_mean(values: Tensor, keep: float) -> Tensor:
    """Mean of the smallest ``keep`` share of a flat tensor; zero for an empty one.

    Outliers are the point of trimming: a LiDAR return seen through a window, or past an edge, must not pull the
    surface.
    """
    if values.numel() == 0:
        return values.sum()
    count = max(1, math.floor(keep * values.numel()))
    if count == values.numel():
        return values.mean()
    return torch.topk(values, count, largest=False, sorted=False).values.mean()


def sparse_depth(depth_m: Tensor, pixel: Tensor, target_m: Tensor, keep: float = 0.95) -> Tensor:
    """Trimmed mean of |depth - target| / target over sparse LiDAR pixels (relative, so that near and far weigh alike),
    of expected depth ``[1, H, W]`` and measurements ``[M]`` at flat pixel indices ``row * W + column`` i64[M], metres.
    ``keep``: share of the smallest errors that count (Street Gaussians: 0.95)."""
    at = depth_m.reshape(-1)[pixel]
    return trimmed_mean((at - target_m).abs() / target_m, keep)


def dense_depth_map(depth_m: Tensor, target_m: Tensor, delta: float = 0.1) -> Tensor:
    """Robust loss of log depth at every pixel: Huber on ``log depth - log target``, linear beyond ``delta``.

    A generated depth map errs in proportion to distance and has gross outliers at edges; both inputs in metres,
    ``[1, H, W]``, positive (clamped to 0.1 m). Huber is divided by ``delta``, so that far from zero it is |log ratio|.
    """
    check_shape(target_m, "dense_depth_map", tuple(depth_m.shape))
    difference = torch.log(depth_m.clamp_min(0.1)) - torch.log(target_m.clamp_min(0.1))
    return F.huber_loss(difference, torch.zeros_like(difference), reduction="none", delta=delta) / delta


def sparse_squared_depth(depth_m: Tensor, pixel: Tensor, target_m: Tensor, span_m: float) -> Tensor:
    """Mean squared difference of depths over ``span_m``, over sparse LiDAR pixels that are at most that far
    (S3Gaussian)."""
    near = (target_m > 0.01) & (target_m < span_m)
    return weighted_mean(((depth_m.reshape(-1)[pixel] - target_m) / span_m).square(), near)


def inverse_depth(depth_m: Tensor, alpha: Tensor, sky_m: float) -> Tensor:
    """Inverse depth of a pixel that is partly sky, in 1/m: ``alpha / depth + (1 - alpha) / sky_m`` (Periodic Vibration
    Gaussians); ``depth_m``: expected depth of what covers the pixel, of any shape, ``alpha`` in [0, 1]."""
    return alpha / depth_m.clamp_min(1e-2) + (1 - alpha) / sky_m


def sparse_inverse_depth(inverse: Tensor, pixel: Tensor, target_m: Tensor) -> Tensor:
    """Mean of |1 / target - inverse| over sparse LiDAR pixels, 1/m; ``pixel`` and ``target_m`` as in
    ``sparse_depth``."""
    return (1 / target_m - inverse.reshape(-1)[pixel]).abs().mean()


def edge_aware(values: Tensor, rgb: Tensor) -> Tensor:
    """Mean absolute difference of neighbouring ``values`` ``[1, H, W]``, less where the image ``[3, H, W]`` has an
    edge."""
    total = values.new_zeros(())
    for dim in (1, 2):
        edge = torch.diff(rgb, dim=dim).abs().mean(0, keepdim=True)
        total = total + (torch.diff(values, dim=dim).abs() * torch.exp(-edge)).mean()
    return total


# ---- sky, semantics, objects ---------------------------------------------------------------------


def sky_map(alpha: Tensor, sky: Tensor, floor: float = 1e-3) -> Tensor:
    """Binary cross-entropy of opacity against the sky mask at every pixel (Street Gaussians, lambda 0.05).

    ``-log(1 - alpha)`` where ``sky`` (bool), ``-log(alpha)`` elsewhere; ``alpha`` ``[1, H, W]`` in [0, 1] is kept
    ``floor`` away from 0 and 1, so the loss and its gradient stay bounded.
    """
    check_shape(sky, "sky_map", tuple(alpha.shape))
    opaque = alpha.clamp(floor, 1 - floor)
    return -torch.log(torch.where(sky, 1 - opaque, opaque))


def empty_sky(alpha: Tensor, sky: Tensor, floor: float = 1e-3) -> Tensor:
    """Mean over all pixels of ``-log(1 - alpha)`` where ``sky`` (bool), 0 elsewhere; ``[1, H, W]`` each."""
    check_shape(sky, "empty_sky", tuple(alpha.shape))
    return torch.where(sky, -torch.log(1 - alpha.clamp(max=1 - floor)), 0.0).mean()


def opacity_entropy(alpha: Tensor, floor: float = 1e-3) -> Tensor:
    """Mean of ``-alpha log alpha``: a pixel is covered, or it is not."""
    return -(alpha * torch.log(alpha.clamp_min(floor))).mean()


def object_map(object_alpha: Tensor, inside_boxes: Tensor, floor: float = 1e-3) -> Tensor:
    """Regulariser of an objects-only render (Street Gaussians, lambda 0.1, after densification).

    Entropy of the opacity inside the projected boxes (be there or not, but decide), ``-log(1 - alpha)`` outside
    (objects leave no haze outside their boxes). ``[1, H, W]`` each; ``inside_boxes`` bool.
    """
    check_shape(inside_boxes, "object_map", tuple(object_alpha.shape))
    alpha = object_alpha.clamp(floor, 1 - floor)
    entropy = -(alpha * torch.log(alpha) + (1 - alpha) * torch.log(1 - alpha))
    return torch.where(inside_boxes, entropy, -torch.log(1 - alpha))


# ---- regularisers --------------------------------------------------------------------------------


def identity_distance(difference: Tensor) -> Tensor:
    """Mean absolute entry (scalar) of what a colour map differs from the identity by, ``[3, 4]`` (Street Gaussians)."""
    return difference.abs().mean()


# ---- features ------------------------------------------------------------------------------------


def feature_distance(prediction: list[Tensor], target: list[Tensor], weight: Tensor) -> Tensor:
    """Mean absolute difference of feature maps ``[C_s, H_s, W_s]``, averaged over the scales, every place weighted by
    its confidence ``[1, H, W]`` in [0, 1], averaged down to each scale. Differentiable (once) in the prediction."""
    total = prediction[0].new_zeros(())
    for mine, theirs in zip(prediction, target):
        check_shape(theirs, "feature_distance", tuple(mine.shape))
        scale_weight = F.adaptive_avg_pool2d(weight.to(mine.dtype), (mine.shape[-2], mine.shape[-1]))
        total = total + _ConfidentDifference.apply(mine, theirs.detach(), scale_weight.detach())
    return total / len(prediction)


class _ConfidentDifference(torch.autograd.Function):
    """``confident_mean((mine - theirs).abs(), weight)``, its gradient worked out along with it: half of the passes over
    large maps."""

    @staticmethod
    def forward(ctx: Any, mine: Tensor, theirs: Tensor, weight: Tensor) -> Tensor:
        difference = mine - theirs
        gradient = difference.sgn().mul_(weight / mine.numel())
        ctx.save_for_backward(gradient)
        return difference.mul_(gradient).sum()

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, upstream: Tensor) -> tuple[Tensor | None, ...]:
        (gradient,) = ctx.saved_tensors
        return gradient * upstream, None, None


# ---- diffusion model -----------------------------------------------------------------------------
# Every term is a plain mean over clips, so that the loss of a batch is the mean over its parts however it is divided.


def latent_error(stated: Tensor, truth: Tensor, weight: Tensor) -> Tensor:
    """Mean of ``weight`` times the squared error of latents ``[B, T, C, h, w]``."""
    return (weight * (stated - truth).square()).mean()


def latent_depth_error(stated: Tensor, truth: Tensor, weight: Tensor, known: Tensor) -> Tensor:
    """As ``latent_error`` with 5 x Huber (delta 0.2), where depth is ``known``: share of the cell f32[B, T, 1, h,
    w]."""
    return (weight * (F.huber_loss(stated, truth, reduction="none", delta=0.2) * 5.0) * known).mean()


def share_cross_entropy(log_shares: Tensor, shares: Tensor, class_weights: Tensor | None) -> Tensor:
    """Mean cross-entropy of class shares ``[B, T, C, h, w]`` under stated logarithms; weights of the classes ``[C]`` or
    None."""
    weighted = shares if class_weights is None else shares * class_weights.view(-1, 1, 1)
    return -(weighted * log_shares).sum(2).mean()


def image_error(error: Tensor, square: float, gradient: float) -> Tensor:
    """L1 of an error image ``[N, 3, H, W]`` + ``square`` x its mean square + ``gradient`` x the L1 of its
    differences."""
    across, down = error[..., 1:] - error[..., :-1], error[..., 1:, :] - error[..., :-1, :]
    return error.abs().mean() + square * error.square().mean() + gradient * (across.abs().mean() + down.abs().mean())


def depth_code_error(generated: Tensor, truth: Tensor, weight: Tensor, log_per_code: float) -> Tensor:
    """5 x smooth L1 (beta 0.005) of made / true depth - 1, weighted; a plain mean over pixels.

    A surface painted too far away costs more than one too near, as in the measure it is scored by. Codes
    ``[N, 1, H, W]`` are taken for logarithms of depth in steps of ``log_per_code``; the weight is 0 where the truth is
    not known.
    """
    ratio = torch.expm1(((generated - truth) * log_per_code).clamp(max=MAX_LOG_RATIO))
    off = F.smooth_l1_loss(ratio, torch.zeros_like(ratio), beta=0.005, reduction="none")
    return 5.0 * (off * weight).mean()


def class_error(scores: Tensor, ids: Tensor, class_weights: Tensor | None) -> Tensor:
    """Cross-entropy of scores ``[N, C, H, W]`` summed over labelled pixels of i64[N, H, W], divided by the number of
    all."""
    weight = None if class_weights is None else class_weights.to(scores.dtype)
    return F.cross_entropy(scores, ids, weight, ignore_index=UNLABELLED, reduction="none").mean()


def stated_error(log_error: Tensor, error: Tensor) -> Tensor:
    """Negative log-likelihood (Laplace) of the absolute error of colour ``[N, 3, H, W]`` under the scale
    ``exp(log_error)``.

    Moves the statement ``[N, 1, H, W]`` only, not the colour.
    """
    size = error.detach().abs().mean(1, keepdim=True)
    scale = log_error.clamp(-6.0, 1.0)
    return (size * torch.exp(-scale) + scale).mean()
