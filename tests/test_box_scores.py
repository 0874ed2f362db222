"""NTA-IoU and agent IoU against values worked out by hand."""

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


def test_iou_by_hand() -> None:
    assert street_scores.iou(box(0, 0, 10, 10), box(5, 0, 15, 10)) == pytest.approx(1 / 3)
    assert street_scores.iou(box(0, 0, 10, 10), box(20, 0, 30, 10)) == 0
    assert street_scores.iou(box(3, 3, 3, 3), box(3, 3, 3, 3)) == 0  # both empty


def test_a_box_ahead_projects_to_its_front_face() -> None:
    # Near face 10 m ahead, 2 m wide: 240 * 2 / 10 = 48 pixels.
    ((found, truth),) = street_scores.nta_truths(VIEW, [track("car", 0, 0, 11)])
    assert found.label == "car"
    assert truth.tolist() == [216, 136, 264, 184]
    ((_, published),) = street_scores.nta_truths(VIEW, [track("car", 0, 0, 11)], as_published=True)
    assert published.tolist() == truth.tolist()  # nothing is behind the camera


def test_other_sizes_are_scaled_to_480_x_320_and_truncated() -> None:
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


def test_a_box_beside_the_camera_becomes_garbage_only_as_published() -> None:
    beside = track("car", -3.0, 0.0, 0.4, (1.0, 1.0, 4.0))  # from 1.6 m behind the camera to 2.4 m ahead
    cut = street_scores.clipped_box(VIEW, beside.world_from_object[0], beside.size_m)
    garbage = street_scores.published_box(VIEW, beside.world_from_object[0], beside.size_m)
    # Corners behind the camera change sides: the published box reaches far to the right of a car on the left.
    assert garbage[2] > 480 * 1.2
    assert cut is None or cut[2] <= 240 - 240 * 2.5 / 2.4 + 1e-6
    # Tuned to fall inside the image: kept as published, dropped when cut.
    small = track("car", -0.4, 0.0, 0.0, (0.2, 0.2, 2.0))
    assert street_scores.nta_truths(VIEW, [small]) == []
    assert len(street_scores.nta_truths(VIEW, [small], as_published=True)) == 1


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
