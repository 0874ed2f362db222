"""NTA-IoU and agent IoU, NTL-IoU, lane IoU and lane gradients against values worked out by hand."""

from __future__ import annotations

import numpy as np
import pytest

from mudg.base import geometry
from mudg.base.palette import ID
from mudg.base.types import Camera, Track, View
from mudg.core import street_scores

CAMERA = Camera("front", 480, 320, 240.0, 240.0, 240.0, 160.0)
VIEW = View(CAMERA, np.eye(4), 0.0)


def track(label: str, x: float, y: float, z: float, size: tuple[float, float, float] = (2.0, 2.0, 2.0)) -> Track:
    """A box whose axes are the camera's: size is right, down, ahead."""
    pose = geometry.from_rotation_translation(np.eye(3), (x, y, z))
    return Track(f"{label}-{x}-{z}", label, np.array(size), np.array([0.0]), pose[None])


def box(*values: float) -> np.ndarray:
    return np.array(values, np.float64)


def test_ious_by_hand() -> None:
    assert street_scores.iou(box(0, 0, 10, 10), box(5, 0, 15, 10)) == pytest.approx(1 / 3)
    assert street_scores.iou(box(0, 0, 10, 10), box(20, 0, 30, 10)) == 0
    assert street_scores.iou(box(3, 3, 3, 3), box(3, 3, 3, 3)) == 0  # both empty
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
    true = np.zeros((20, 60), bool)
    true[:, 20:22] = True
    moved = np.roll(true, 2, 1)
    assert street_scores.tolerant_iou(moved, true) == (40, 40)  # all within 2 px
    moved = np.roll(true, 3, 1)
    hits, union = street_scores.tolerant_iou(moved, true)
    assert (hits, union) == (20, 60)  # one column of each is 2 px from the other
    assert street_scores.tolerant_iou(np.roll(true, 9, 1), true) == (0, 80)
    assert street_scores.tolerant_iou(np.zeros_like(true), true) == (0, 40)


def test_a_box_ahead_projects_to_its_front_face_scaled_and_truncated() -> None:
    ((found, truth),) = street_scores.nta_truths(VIEW, [track("car", 0, 0, 11)])
    assert found.label == "car"
    assert truth.tolist() == [216, 136, 264, 184]
    camera = Camera("front", 960, 800, 480.0, 480.0, 481.0, 400.0)
    ((_, truth),) = street_scores.nta_truths(View(camera, np.eye(4), 0.0), [track("car", 0, 0, 11)])
    # Left: (481 - 48) / 2 = 216.5 -> 216; top: (400 - 48) * 0.4 = 140.8 -> 140.
    assert truth.tolist() == [216, 140, 264, 179]


@pytest.mark.parametrize(
    "other",
    [track("pedestrian", 0, 0, 11), track("car", 0, 0, -11), track("car", 10.0, 0, 11), track("car", 0, 0, 0.5)],
)
def test_people_and_what_is_behind_or_not_whole_in_the_image_do_not_count(other: Track) -> None:
    assert street_scores.nta_truths(VIEW, [other]) == []


def test_the_nearest_centre_decides_not_the_best_overlap() -> None:
    true = box(100, 100, 140, 140)
    off = box(104, 100, 144, 140)  # centre 4 px away, IoU 36/44
    shrunk = box(118, 118, 122, 122)  # the same centre, IoU 16/1600
    assert street_scores.nta_iou([true], [off, shrunk]) == [pytest.approx(0.01)]
    assert street_scores.nta_iou([true], [off]) == [pytest.approx(36 / 44)]
    assert street_scores.nta_iou([true], [true + 8.0]) == [0.0]  # centre 11.3 px away: overlap does not help
    # 10 px still count
    assert street_scores.nta_iou([true], [true + np.array([10.0, 0, 10, 0])]) == [pytest.approx(30 / 50)]
    assert street_scores.nta_iou([true, true], [off]) == [pytest.approx(36 / 44)] * 2  # one detection serves two truths
    assert street_scores.nta_iou([true], []) == [0.0]


# ---- what is really visible ----------------------------------------------------------------------


def instances(left: int, right: int) -> np.ndarray:
    """Instance map with the visible part of vehicle 7."""
    found = np.zeros((320, 480), np.int32)
    found[136:184, left:right] = 7
    return found


def test_agents_are_compared_with_their_visible_part() -> None:
    car = track("car", 0, 0, 11)
    (whole,) = street_scores.visible_agents(VIEW, [(7, car)], instances(216, 264))
    assert whole.visible.tolist() == [216, 136, 264, 184] == whole.outline.tolist()
    (half,) = street_scores.visible_agents(VIEW, [(7, car)], instances(240, 264))
    assert half.visible.tolist() == [240, 136, 264, 184]
    assert half.outline.tolist() == [216, 136, 264, 184]
    assert street_scores.visible_agents(VIEW, [(7, car)], instances(252, 264)) == ()  # a quarter: less than 30 %
    assert street_scores.visible_agents(VIEW, [(8, car)], instances(216, 264)) == ()
    far = track("car", 0, 0, 60)
    few = np.where(np.arange(320)[:, None] < 9, 7, 0) * (np.arange(480) < 9)
    assert street_scores.visible_agents(VIEW, [(7, far)], few) == ()  # 81 pixels


def classes(left: int, right: int, name: str = "car") -> np.ndarray:
    ids = np.zeros((320, 480), np.int64)
    ids[136:184, left:right] = ID[name]
    return ids


def test_agent_iou_by_hand() -> None:
    agents = street_scores.visible_agents(VIEW, [(7, track("car", 0, 0, 11))], instances(216, 264))
    assert street_scores.agent_ious(agents, classes(216, 264)) == [1.0]
    assert street_scores.agent_ious(agents, classes(216, 264, "truck")) == [1.0]  # any vehicle
    assert street_scores.agent_ious(agents, classes(216, 264, "person")) == [0.0]
    assert street_scores.agent_ious(agents, classes(216, 252)) == [pytest.approx(0.75)]
    # Outline 1.2 times as large ends at 268.8: of a region moved by 8 px, 45 columns are left.
    assert street_scores.agent_ious(agents, classes(224, 272)) == [pytest.approx(40 / 53)]
    assert street_scores.agent_ious(agents, classes(216, 236)) == [0.0]  # its centre is 14 px off
    speck = classes(216, 264)
    speck[132, 212] = ID["car"]
    assert street_scores.agent_ious(agents, speck) == [1.0]  # the largest region counts
    assert street_scores.agent_ious((), speck) == []


# -- lanes ------------------------------------------------------------------------------------------

# x right, y down, z forward in the world's x forward, y left, z up; 1.5 m above the ground.
POSE = np.array([[0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 1.5], [0, 0, 0, 1]], np.float64)
ROAD_VIEW = View(Camera("front", 384, 256, 300.0, 300.0, 192.0, 128.0), POSE, 0.0)


def line(left_m: float, near_m: float = 2.0, far_m: float = 60.0) -> np.ndarray:
    x = np.arange(near_m, far_m, 0.25)
    return np.stack([x, np.full(len(x), left_m), np.zeros(len(x))], 1)


def test_a_lane_line_is_where_the_pinhole_puts_it_and_20_pixels_thick() -> None:
    mask = street_scores.lane_truth(ROAD_VIEW, [line(0.0)])
    assert mask.shape == (360, 640)
    rows, columns = np.nonzero(mask)
    # Straight ahead: column 320; 20 of 1920 pixels are 6.7 of 640; the horizon lies in row 180.
    assert abs(columns.mean() - 319.5) < 0.6
    widths = mask[250:340].sum(1)
    assert 6 <= widths.min() and widths.max() <= 8
    assert rows.min() >= 180
    side = street_scores.lane_truth(ROAD_VIEW, [line(-1.5)])
    # 1.5 m to the right and 1.5 m down: as far right as down, in pixels of the camera.
    for row in (240, 300):
        down = (row + 0.5) / 360 * 256 - 128
        expected = (192 + down) / 384 * 640
        assert abs(np.flatnonzero(side[row]).mean() + 0.5 - expected) < 1.0


def test_lines_beside_behind_and_far_away_are_left_out() -> None:
    assert not street_scores.lane_truth(ROAD_VIEW, [line(10.5)]).any()
    assert not street_scores.lane_truth(ROAD_VIEW, [line(0.0, -20.0, -1.0)]).any()
    assert not street_scores.lane_truth(ROAD_VIEW, [line(0.0, 76.0, 90.0)]).any()
    assert not street_scores.lane_truth(ROAD_VIEW, []).any()
    across = np.stack([np.full(101, 10.0), np.linspace(-25, 25, 101), np.zeros(101)], 1)
    mask = street_scores.lane_truth(ROAD_VIEW, [across])  # cut at 10 m to each side: 300 px of 384
    assert not mask[:, :10].any() or np.flatnonzero(mask.any(0)).min() == 0
    through = np.stack([np.linspace(-5, 30, 141), np.full(141, -0.5), np.zeros(141)], 1)
    # runs out of the lower edge, not to the horizon's other side
    assert street_scores.lane_truth(ROAD_VIEW, [through])[-1].any()
    assert not street_scores.lane_truth(ROAD_VIEW, [through])[:175].any()


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
    road = np.zeros_like(mask)
    road[:, 80:125] = True
    rgb[:, ~road] = 0.0  # dark cars on both sides
    found = street_scores.bright_stripes(rgb, road)
    assert np.array_equal(found, street_scores.bright_stripes(np.where(road, rgb, 1.0), road))
    hits, union = street_scores.tolerant_iou(found, mask)
    assert hits / union == 1.0


def test_lane_gradients_fall_when_a_line_moves_or_fades() -> None:
    rgb, mask = road_with_line()
    band = street_scores.lane_band(mask)
    assert band.sum() > mask.sum()

    def correlation(other: np.ndarray) -> float:
        theirs, own = (street_scores.edges_of(street_scores.gray_of(one)) for one in (other, rgb))
        return street_scores.edge_correlation(theirs, own, band)

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
    beside = View(ROAD_VIEW.camera, moved, 0.0)
    places = street_scores.plane_points(beside, np.zeros(3), 25.0)
    colors, shown = street_scores.seen_from(ROAD_VIEW, photograph(ROAD_VIEW), places)
    assert 0.1 < shown.mean() < 0.5 and not shown[:128].any()
    assert np.abs(colors - photograph(beside))[:, shown].max() < 0.01  # measured 0.004: bilinear reading
    # At its own place the image is itself.
    own, there = street_scores.seen_from(
        ROAD_VIEW, photograph(ROAD_VIEW), street_scores.plane_points(ROAD_VIEW, np.zeros(3), 25.0)
    )
    assert np.abs(own - photograph(ROAD_VIEW))[:, there].max() < 1e-9
    plane = np.array([0.05, 0.0, -1.0])
    places = street_scores.plane_points(ROAD_VIEW, plane, 60.0)
    known = places[np.isfinite(places).all(-1)]
    assert len(known) > 1000
    assert np.abs(known[:, 2] - (0.05 * known[:, 0] - 1.0)).max() < 1e-9
    uv, z = geometry.project(ROAD_VIEW, places[200, 300][None])
    assert uv[0].tolist() == pytest.approx([300.5, 200.5]) and z[0] > 0
