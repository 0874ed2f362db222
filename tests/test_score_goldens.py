"""The networks of the scores still give the recorded features."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import score_goldens

from mudg.base import store


@pytest.mark.parametrize("part", [score_goldens.inception_values, score_goldens.i3d_values, score_goldens.vit_values])
def test_features_are_the_recorded_ones(part: Callable[[], dict[str, np.ndarray]]) -> None:
    recorded = store.read_safetensors(score_goldens.PATH)
    for name, value in part().items():
        assert value.shape == recorded[name].shape
        apart = np.abs(value.astype(np.float64) - recorded[name]).max() / np.abs(recorded[name]).max()
        assert apart < 1e-4, name  # other processors add up in another order; measured 0 on the same one
        assert np.ptp(recorded[name]) > 0
