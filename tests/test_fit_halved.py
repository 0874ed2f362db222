"""Virtual views at half their size: what they show, and which steps see them so."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from mudg.base import geometry
from mudg.base.types import Camera, View
from mudg.gaussians.views import LEAST_PX, HalvedViews, LidarPixels, StoredView, halved

WIDTH, HEIGHT = 241, 196
RNG = np.random.default_rng(0)


def stored(width: int = WIDTH, height: int = HEIGHT, kind: str = "virtual") -> StoredView:
    view = View(Camera("front", width, height, 200.0, 210.0, 0.51 * width, 0.48 * height), np.eye(4), 0.0)
    rgb, confidence = (RNG.integers(0, 255, (height, width, *more), np.uint8) for more in ((3,), ()))
    channels, depth = RNG.integers(0, 9, (height, width), np.uint8), RNG.random((height, width), np.float32)
    sky, mask = (RNG.random((height, width)) < share for share in (0.5, 0.9))
    return StoredView("front_shift+2.0/000001", view, kind, rgb, channels, sky, mask, None, depth, confidence)


def test_colours_are_means_and_labels_those_of_a_pixel() -> None:
    whole = stored(240)
    half = halved(whole)
    blocks = whole.rgb.reshape(98, 2, 120, 2, 3).astype(float)
    assert np.abs(half.rgb - blocks.mean((1, 3))).max() <= 1  # rows and columns are rounded one after the other
    sure = whole.confidence.reshape(98, 2, 120, 2).astype(float)
    assert np.abs(half.confidence - sure.mean((1, 3))).max() <= 1
    assert np.array_equal(half.mask, whole.mask.reshape(98, 2, 120, 2).all((1, 3)))
    for name in ("channels", "sky", "depth"):
        assert np.array_equal(getattr(half, name), getattr(whole, name)[1::2, 1::2])


@pytest.mark.parametrize("width", [240, 241])
def test_a_measured_point_lies_in_the_pixel_that_shows_it(width: int) -> None:
    whole = stored(width)
    points = np.stack([RNG.uniform(-1, 1, 500), RNG.uniform(-0.8, 0.8, 500), RNG.uniform(2, 9, 500)], 1)

    def flat(view: View) -> np.ndarray:
        uv, _ = geometry.project(view, points)
        assert (uv > 0).all() and (uv < [view.camera.width, view.camera.height]).all()
        return uv.astype(int) @ [1, view.camera.width]

    half = halved(replace(whole, lidar=LidarPixels(torch.from_numpy(flat(whole.view)), torch.from_numpy(points[:, 2]))))
    there, camera = flat(half.view), half.view.camera
    row, column = half.lidar.pixel.numpy() // camera.width, half.lidar.pixel.numpy() % camera.width
    assert (camera.width, camera.height) == (120, 98)
    apart = np.abs(np.stack([row - there // camera.width, column - there % camera.width]))
    assert apart.max() <= (width != 240), "exact for even sides; in an odd one a pixel may lie across two"
    assert torch.equal(half.lidar.depth_m, torch.from_numpy(points[:, 2]))


@pytest.mark.parametrize("keep", [True, False])
def test_only_virtual_views_of_the_first_steps_are_halved(keep: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("mudg.gaussians.views.IN_MEMORY_BYTES", (1 << 30) * keep)
    sizes, virtual, recorded = HalvedViews(8), stored(), stored(kind="recorded")
    assert sizes.sized(virtual, 8).rgb.shape == (HEIGHT // 2, WIDTH // 2, 3)
    assert (sizes.sized(virtual, 8) is sizes.sized(virtual, 3)) == keep
    assert sizes.sized(virtual, 9) is virtual
    assert sizes.sized(recorded, 1) is recorded


def test_large_views_are_halved_at_every_step_and_tiny_ones_never(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("mudg.gaussians.views.WHOLE_PIXELS", WIDTH * HEIGHT - 1)
    view = stored()
    for until, side in ((10.0, WIDTH // 2), (0.0, WIDTH)):
        sizes = HalvedViews(until)
        assert [sizes.sized(view, step).rgb.shape[1] for step in (1, 11)] == [side, side]
    assert HalvedViews(10.0).sized(stored(WIDTH - 1), 11).rgb.shape[1] == WIDTH - 1
    small = stored(300, 2 * LEAST_PX - 1)
    assert halved(small) is small
