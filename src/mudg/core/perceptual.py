"""Distances of two images in the features of a network or a filter bank: losses of a fit, and rows of the scores."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import torch
import torch.nn.functional as F
from torch import Tensor

from mudg.base.errors import InputError

LPIPS_EPSILON: Final = 1e-10


def unit_features(stages: Sequence[Tensor]) -> list[Tensor]:
    """Feature vectors of every place brought to length 1 as LPIPS does it: ``x / (|x| + 1e-10)``; per stage ``[C_l, h_l, w_l]``.

    A place without any feature has no direction: it stays 0 and passes no gradient, where the root would pass NaN.
    """
    return [_unit(features) for features in stages]


def _unit(features: Tensor) -> Tensor:
    squared = features.square().sum(0, keepdim=True)
    there = squared > 0
    length = torch.where(there, squared, 1.0).sqrt() + LPIPS_EPSILON
    return torch.where(there, features / length, 0.0)


def distance_places(features: Tensor, target: Tensor, channel_weights: Tensor | None = None) -> Tensor:
    """Squared difference at every place of one stage ``[h, w]``: of features ``[C, h, w]``, brought to length 1, and unit features."""
    squared = (_unit(features) - target) ** 2
    if channel_weights is not None:
        squared = squared * channel_weights.view(-1, 1, 1)
    return squared.sum(0)


def lpips_distance(
    prediction: Sequence[Tensor],
    target_units: Sequence[Tensor],
    weight: Tensor | None = None,
    channel_weights: Sequence[Tensor] | None = None,
    *,
    over_weight: bool = False,
) -> Tensor:
    """LPIPS (Zhang et al. 2018, eq. 1) in the features of any network; differentiable in the prediction.

    Per stage: every place's feature vector is brought to length 1, the squared difference is summed over channels and averaged
    over places; the stages are averaged (without ``channel_weights``) or summed (with them, as LPIPS does).

    Args:
        prediction: features of one image, per stage ``[C_l, h_l, w_l]``.
        target_units: ``unit_features`` of the other image, same shapes.
        weight: ``[1, H, W]`` in [0, 1] at full size, averaged down to each stage (default 1).
        channel_weights: per stage ``[C_l]`` for the squared differences (default 1).
        over_weight: what a weighted sum is divided by. False: the number of places, so that an image of which little is certain also
            weighs little (loss). True: the sum of the weights, so that only chosen pixels count (score).

    Returns:
        Scalar: 0 for equal images, NaN when nothing counts.

    Raises:
        InputError: the two have other shapes.
    """
    total = prediction[0].new_zeros(())
    for stage, (features, target) in enumerate(zip(prediction, target_units, strict=True)):
        if features.shape != target.shape:
            raise InputError("features of two images differ in shape", where=f"stage {stage}",
                expected=str(tuple(target.shape)), got=str(tuple(features.shape)))  # fmt: skip
        places = distance_places(features, target, None if channel_weights is None else channel_weights[stage])
        if weight is None:
            total = total + places.mean()
            continue
        share = F.adaptive_avg_pool2d(weight.to(places.dtype), (places.shape[-2], places.shape[-1]))[0]
        weighted = places * share
        total = total + (weighted.sum() / share.sum() if over_weight else weighted.mean())
    return total if channel_weights is not None else total / len(prediction)
