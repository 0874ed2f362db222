"""NTL-IoU, lane IoU and lane gradients against values worked out by hand."""

from __future__ import annotations

import numpy as np
import pytest

from mudg.base import geometry
from mudg.base.types import Camera, View
from mudg.core import street_scores

# x right, y down, z forward in the world's x forward, y left, z up; 1.5 m above the ground.
POSE = np.array([[0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 1.5], [0, 0, 0, 1]], np.float64)
VIEW = View(Camera("front", 384, 256, 300.0, 300.0, 192.0, 128.0), POSE, 0.0)


def line(left_m: float, near_m: float = 2.0, far_m: float = 60.0) -> np.ndarray:
    x = np.arange(near_m, far_m, 0.25)
    return np.stack([x, np.full(len(x), left_m), np.zeros(len(x))], 1)


def test_a_lane_line_is_where_the_pinhole_puts_it_and_20_pixels_thick() -> None:
    mask = street_scores.lane_truth(VIEW, [line(0.0)])
    assert mask.shape == (360, 640)
    rows, columns = np.nonzero(mask)
    # Straight ahead: column 320; 20 of 1920 pixels are 6.7 of 640; the horizon lies in row 180.
    assert abs(columns.mean() - 319.5) < 0.6
    widths = mask[250:340].sum(1)
    assert 6 <= widths.min() and widths.max() <= 8
    assert rows.min() >= 180
    side = street_scores.lane_truth(VIEW, [line(-1.5)])
    # 1.5 m to the right and 1.5 m down: as far right as down, in pixels of the camera.
    for row in (240, 300):
        down = (row + 0.5) / 360 * 256 - 128
        expected = (192 + down) / 384 * 640
        assert abs(np.flatnonzero(side[row]).mean() + 0.5 - expected) < 1.0


def test_lines_beside_behind_and_far_away_are_left_out() -> None:
    assert not street_scores.lane_truth(VIEW, [line(10.5)]).any()
    assert not street_scores.lane_truth(VIEW, [line(0.0, -20.0, -1.0)]).any()
    assert not street_scores.lane_truth(VIEW, [line(0.0, 76.0, 90.0)]).any()
    assert not street_scores.lane_truth(VIEW, []).any()
    across = np.stack([np.full(101, 10.0), np.linspace(-25, 25, 101), np.zeros(101)], 1)
    mask = street_scores.lane_truth(VIEW, [across])  # cut at 10 m to each side: 300 px of 384
    assert not mask[:, :10].any() or np.flatnonzero(mask.any(0)).min() == 0
    through = np.stack([np.linspace(-5, 30, 141), np.full(141, -0.5), np.zeros(141)], 1)
    # runs out of the lower edge, not to the horizon's other side
    assert street_scores.lane_truth(VIEW, [through])[-1].any()
    assert not street_scores.lane_truth(VIEW, [through])[:175].any()


def test_ntl_iou_by_hand() -> None:
    true = np.zeros((360, 640), bool)
    true[:, :64] = True  # a tenth
    found = np.zeros_like(true)
    found[:, 32:96] = True
    # Lanes: 32 of 96 columns; background: 544 of 608.
    assert street_scores.ntl_iou(found, true) == pytest.approx(50 * (32 / 96 + 544 / 608))
    assert street_scores.ntl_iou(true, true) == 100
    nothing = np.zeros_like(true)
    assert street_scores.ntl_iou(nothing, nothing) == 50  # no lane at all: NaN counts as 0
    assert street_scores.ntl_iou(nothing, true) == pytest.approx(45)


def test_masks_of_detectors_take_the_nearest_pixel() -> None:
    small = np.zeros((2, 4), np.uint8)
    small[1, 3] = 200
    large = street_scores.at_lane_size(small)
    assert large[180:, 480:].all() and large.sum() == 180 * 160


def road_with_line(contrast: float = 0.3, column: int = 100, width: int = 4) -> tuple[np.ndarray, np.ndarray]:
    rgb = np.full((3, 60, 240), 0.3)
    rgb[:, :, column : column + width] += contrast
    mask = np.zeros((60, 240), bool)
    mask[:, column : column + width] = True
    return rgb, mask


def test_the_rule_finds_bright_stripes_on_the_road_only() -> None:
    rgb, mask = road_with_line()
    everywhere = np.ones_like(mask)
    hits, union = street_scores.tolerant_iou(street_scores.bright_stripes(rgb, everywhere), mask)
    assert hits / union == 1.0
    assert not street_scores.bright_stripes(rgb, ~mask & False).any()
    assert not street_scores.bright_stripes(road_with_line(0.05)[0], everywhere).any()  # too faint
    assert not street_scores.bright_stripes(road_with_line(-0.2)[0], everywhere)[:, 98:106].any()  # dark
    # a bright field is no line
    assert not street_scores.bright_stripes(road_with_line(0.3, 100, 60)[0], everywhere).any()
    rgb[:, 30, 200:202] += 0.2  # a speck
    assert not street_scores.bright_stripes(rgb, everywhere)[:, 190:].any()


def test_what_lies_beside_the_road_makes_no_markings() -> None:
    rgb, mask = road_with_line()
    road = np.zeros_like(mask)
    road[:, 80:125] = True
    rgb[:, ~road] = 0.0  # dark cars on both sides
    found = street_scores.bright_stripes(rgb, road)
    assert np.array_equal(found, street_scores.bright_stripes(np.where(road, rgb, 1.0), road))
    hits, union = street_scores.tolerant_iou(found, mask)
    assert hits / union == 1.0


def test_tolerant_iou_by_hand() -> None:
    true = np.zeros((20, 60), bool)
    true[:, 20:22] = True
    moved = np.roll(true, 2, 1)
    assert street_scores.tolerant_iou(moved, true) == (40, 40)  # all within 2 px
    moved = np.roll(true, 3, 1)
    hits, union = street_scores.tolerant_iou(moved, true)
    assert (hits, union) == (20, 60)  # one column of each is 2 px from the other
    assert street_scores.tolerant_iou(np.roll(true, 9, 1), true) == (0, 80)
    assert street_scores.tolerant_iou(np.zeros_like(true), true) == (0, 40)


def test_lane_gradients_fall_when_a_line_moves_or_fades() -> None:
    rgb, mask = road_with_line()
    band = street_scores.lane_band(mask)
    assert band.sum() > mask.sum()

    def correlation(other: np.ndarray) -> float:
        gray = street_scores.gray_of
        return street_scores.edge_correlation(
            street_scores.edges_of(gray(other)), street_scores.edges_of(gray(rgb)), band
        )

    assert correlation(rgb) == pytest.approx(1.0)
    assert correlation(0.5 * rgb + 0.2) == pytest.approx(1.0)  # brightness and contrast do not matter
    assert correlation(np.roll(rgb, 2, 2)) < 0.5
    assert np.isnan(correlation(np.full_like(rgb, 0.3)))  # nothing left
    assert np.isnan(street_scores.edge_correlation(np.ones((4, 4)), np.ones((4, 4)), np.zeros((4, 4), bool)))


def test_the_ground_seen_from_beside_is_the_same_ground() -> None:
    """A floor with a pattern, photographed from two places 2 m apart."""

    def photograph(view: View) -> np.ndarray:
        places = street_scores.plane_points(view, np.zeros(3), 1e3)
        tone = 0.5 + 0.2 * np.sin(places[..., 0]) * np.cos(0.7 * places[..., 1])
        return np.nan_to_num(np.stack([tone] * 3))

    moved = POSE.copy()
    moved[1, 3] += 2.0
    beside = View(VIEW.camera, moved, 0.0)
    places = street_scores.plane_points(beside, np.zeros(3), 25.0)
    colors, shown = street_scores.seen_from(VIEW, photograph(VIEW), places)
    assert 0.1 < shown.mean() < 0.5 and not shown[:128].any()
    assert np.abs(colors - photograph(beside))[:, shown].max() < 0.01  # measured 0.004: bilinear reading
    # At its own place the image is itself.
    own, there = street_scores.seen_from(VIEW, photograph(VIEW), street_scores.plane_points(VIEW, np.zeros(3), 25.0))
    assert np.abs(own - photograph(VIEW))[:, there].max() < 1e-9


def test_a_tilted_plane() -> None:
    plane = np.array([0.05, 0.0, -1.0])
    places = street_scores.plane_points(VIEW, plane, 60.0)
    known = places[np.isfinite(places).all(-1)]
    assert len(known) > 1000
    assert np.abs(known[:, 2] - (0.05 * known[:, 0] - 1.0)).max() < 1e-9
    uv, z = geometry.project(VIEW, places[200, 300][None])
    assert uv[0].tolist() == pytest.approx([300.5, 200.5]) and z[0] > 0
