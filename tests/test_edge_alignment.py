"""LiDAR against image edges: the given calibration is told from one turned by a degree, on cities and on a real
drive."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from toy_scene import ToyStreet

from mudg import native
from mudg.base.types import Frame, Scene, View
from mudg.city.config import CityConfig
from mudg.city.logs import write_city
from mudg.core import calibration as edges
from mudg.formats.importers import IMPORTERS
from mudg.formats.importers.common import ImportOptions
from mudg.scene import check
from mudg.scene.check import camera_alignment, describe
from mudg.steps import doctor as diagnosis

TURNS = ((1.0, 0.0), (-1.0, 0.0), (0.0, 1.0), (0.0, -1.0))


def turned(scene: Scene, about_y_deg: float, about_x_deg: float) -> Scene:
    """The scene with the rotation of every camera wrong by that much."""

    def turn(frame: Frame) -> Frame:
        pose = frame.view.world_from_cam.copy()
        pose[:3, :3] = pose[:3, :3] @ edges._turn(about_y_deg, about_x_deg)
        return replace(frame, view=View(frame.view.camera, pose, frame.view.time_s))

    return replace(scene, frames=tuple(turn(frame) for frame in scene.frames))


def assert_told_apart(scene: Scene, camera: str) -> None:
    right = camera_alignment(scene)[camera]
    assert right.verdict == "right", right
    for turn in TURNS:
        wrong = camera_alignment(turned(scene, *turn))[camera]
        assert wrong.verdict == "doubtful", (turn, wrong)
        assert wrong.score < right.score - 0.2
        assert np.abs(np.array(wrong.best_turn_deg) - turn).max() <= 0.5


@pytest.mark.skipif(native.library() is None, reason="the city needs the native library")
@pytest.mark.parametrize("seed", [3, pytest.param(5, marks=pytest.mark.slow)])
def test_a_city_turned_by_a_degree_is_doubtful(tmp_path: Path, seed: int) -> None:
    config = CityConfig(seed=seed, n_frames=3, rate_hz=5, width=320, height=214, cameras=("front",), supersample=1)
    assert_told_apart(write_city(config, tmp_path / "city"), "front")


def test_a_real_drive_turned_by_a_degree_is_doubtful(tmp_path: Path, shared_data: Callable[[str], Path]) -> None:
    drive = shared_data("kitti_2011_09_26")
    scene = IMPORTERS["kitti"](drive, tmp_path / "scene", ImportOptions(frames=(0, 12), resolution=621))
    assert_told_apart(replace(scene, frames=scene.frames[::4]), "front")


def test_depth_jumps_are_on_the_near_side() -> None:
    azimuth = np.deg2rad(np.arange(-20, 20, 0.5))
    distance = np.where(np.abs(azimuth) < np.deg2rad(5.1), 8.0, 20.0)
    x, y = distance * np.cos(azimuth), distance * np.sin(azimuth)
    xyz = np.concatenate([np.stack([x, y, z * distance], 1) for z in (-0.02, 0.0, 0.02)])
    found = edges.depth_jumps(xyz)
    assert (np.linalg.norm(xyz[found, :2], axis=1) < 9).all()
    at = np.rad2deg(np.abs(np.arctan2(xyz[found, 1], xyz[found, 0])))
    assert len(found) >= 6
    assert at.min() >= 4.0  # the two ends of the near panel, in each row
    assert len(edges.depth_jumps(xyz[:3])) == 0 and len(edges.depth_jumps(np.zeros((50, 3)))) == 0


def test_a_verdict_needs_a_peak_that_is_no_accident() -> None:
    """40 contours of 10 jumps: the sums of one turn are raised, by all contours or by a few."""
    side = len(edges.TURNS_DEG)
    flat = np.full((side, side, 40), 4.0)

    def verdict(row: int, column: int, raised: np.ndarray) -> str:
        sums = flat.copy()
        sums[row, column] += raised
        return edges._judge(sums.reshape(side * side, 40), 400).verdict

    middle = side // 2
    everywhere = np.full(40, 1.0)
    assert verdict(middle, middle, everywhere) == "right"
    assert verdict(middle + 2, middle, everywhere) == "doubtful"
    assert verdict(middle + 2, middle, np.r_[40.0, np.zeros(39)]) == "unknown"  # one contour alone
    assert verdict(side - 1, middle, everywhere) == "unknown"  # at the end of the range: a slope, no peak
    assert verdict(middle + 2, middle, 0.01 * everywhere) == "unknown"
    slope = edges.EdgeAlignment(0.1, (0.0, 2.0), 0.2, 900, "unknown", 6.0)
    assert "end of the range" in describe("front", slope)
    assert "about as well" in describe("front", replace(slope, best_turn_deg=(0.0, 1.0)))
    told = edges._judge(np.full((side * side, 40), 4.0), 400)
    assert "do not tell" in describe("front", told) and "no turn" in describe("front", told)


def test_too_little_to_tell_is_said(tmp_path: Path) -> None:
    scene = ToyStreet().write(tmp_path / "scene", labels=False, width=60, height=30)
    found = camera_alignment(scene)["front"]
    assert found.verdict == "unknown" and "too few" in describe("front", found)
    assert camera_alignment(replace(scene, sweeps=())) == {}


def test_doctor_tells_of_each_camera(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    ToyStreet().write(tmp_path / "scene", labels=False, width=60, height=30)
    doubtful = edges.EdgeAlignment(0.2, (1.0, -0.5), 0.2, 900, "doubtful")
    right = replace(doubtful, verdict="right")
    for found, level, said in ((doubtful, "warning", "+1.0 degrees"), (right, None, "agree")):
        monkeypatch.setattr(check, "camera_alignment", lambda _scene, found=found: {"front": found})
        report: dict[str, Any] = diagnosis.report_scene(tmp_path / "scene")
        assert said in report["text"] and report["alignment"]["front"]["depth_edges"] == 900
        assert any(f["level"] == level and "degrees" in f["words"] for f in report["findings"]) == (level is not None)
        assert report["exit_code"] == 0
