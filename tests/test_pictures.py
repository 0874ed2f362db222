"""Sizes and colours of pictures."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from PIL import Image

from mudg.base import palette
from mudg.base.errors import InputError
from mudg.core import pictures


def image(seed: int, height: int, width: int) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, (height, width, 3), dtype=np.uint8)


def test_area_and_bicubic_are_pillows_filters() -> None:
    rgb = image(0, 31, 47)
    for resize, rule in (
        (pictures.resize_area, Image.Resampling.BOX),
        (pictures.resize_bicubic, Image.Resampling.BICUBIC),
    ):
        assert np.array_equal(resize(rgb, 20, 17), np.asarray(Image.fromarray(rgb).resize((20, 17), rule)))
        assert np.array_equal(resize(rgb, 47, 31), rgb)
    assert pictures.resize_bicubic(rgb, 47, 31) is not rgb


@pytest.mark.parametrize("size", [(4, 4), (2, 2), (3, 5), (1, 7)])
def test_nearest_takes_the_pixel_under_the_centre_from_arrays_and_tensors(size: tuple[int, int]) -> None:
    ids = np.arange(20).reshape(4, 5)
    height, width = size
    expected = [
        [ids[int((y + 0.5) * 4 / height), int((x + 0.5) * 5 / width)] for x in range(width)] for y in range(height)
    ]
    found = pictures.resize_nearest(ids, height, width)
    assert found.tolist() == expected and found.flags.c_contiguous
    assert pictures.resize_nearest(torch.from_numpy(ids)[None], height, width).tolist() == [expected]


def test_exact_shrinking_is_the_mean_over_areas() -> None:
    rgb = image(1, 6, 8)
    halves = rgb.reshape(3, 2, 4, 2, 3).astype(float).mean((1, 3))
    assert np.abs(pictures.shrink_exact(rgb, 3, 4) - halves).max() <= 0.5
    # Rows of 3 out of 4: each new row is one old row and a third of its neighbour.
    wide = np.repeat(np.array([0, 30, 60, 90], np.uint8), 2 * 3).reshape(4, 2, 3)
    assert pictures.shrink_exact(wide, 3, 2)[:, 0, 0].tolist() == [8, 45, 82]
    with pytest.raises(InputError, match="never enlarged"):
        pictures.shrink_exact(rgb, 7, 8)


def test_depth_runs_from_warm_to_cold_and_missing_is_black() -> None:
    depth = np.array([[1.0, 2.0, 15.0, 100.0, 500.0, np.nan, 0.0, -3.0]])
    colors = pictures.depth_colors(depth)[0].astype(int)
    assert (colors[0] == colors[1]).all() and (colors[3] == colors[4]).all()
    assert colors[0, 0] > colors[0, 2] and colors[3, 2] > colors[3, 0]
    assert len(np.unique(colors[1:4], axis=0)) == 3
    assert (colors[5:] == 0).all() and (colors[:5].max(1) > 100).all()


def test_classes_confidences_and_errors_as_pictures() -> None:
    ids = np.array([[palette.ID["road"], palette.UNLABELLED]], np.uint8)
    assert pictures.class_colors(ids)[0].tolist() == [[128, 64, 128], [0, 0, 0]]
    assert pictures.gray(np.array([[0.0, 0.5, 2.0]]))[0].tolist() == [[0] * 3, [127] * 3, [255] * 3]
    rgb = torch.zeros(3, 1, 2)
    rgb[:, 0, 1] = 0.6
    error = pictures.error_image(rgb, torch.zeros(3, 1, 2))
    assert error[0].tolist() == [[0, 0, 0], [255, 255, 255]]
    assert pictures.to_bytes(rgb)[0].tolist() == [[0] * 3, [153] * 3]
