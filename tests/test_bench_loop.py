"""``mudg bench loop``: drives scored against the exact city, the exact city itself among them."""

from __future__ import annotations

import json
import math
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from roundtrip import needs_native

from mudg.base import geometry
from mudg.base.errors import UsageError
from mudg.benchmarks import loop
from mudg.benchmarks.settings import BenchConfig
from mudg.city.config import CityConfig
from mudg.city.logs import LISTS, log_config
from mudg.city.world import CityWorld
from mudg.sim.lidar import BeamTable

pytestmark = needs_native

RULES = CityConfig(n_frames=8, width=96, height=64, cameras=("front",))


@pytest.fixture(scope="module")
def course() -> loop.Course:
    return loop.Course.of(CityWorld(log_config(LISTS["development"][0], RULES)))


def test_exact_eyes_make_the_exact_drive_and_perfect_scores(course: loop.Course) -> None:
    alone = loop.measure_drive(course, "left")
    seen = loop.measure_drive(course, "left", course.exact)
    assert seen["path"] == alone["path"]
    assert (seen["psnr"], seen["abs_rel"], seen["miou"]) == (100.0, 0.0, 1.0)
    parted = loop.parting(seen["path"], alone["path"])
    assert parted["parting_m"] == parted["parted_m"] == parted["speed_off_mps"] == 0.0
    assert 0.3 < alone["path"][-1]["shift_m"] < 3.0


def test_drives_to_both_sides_leave_the_path_the_right_way(course: loop.Course) -> None:
    ends = {pilot: loop.measure_drive(course, pilot)["path"][-1]["shift_m"] for pilot in ("left", "right")}
    assert ends["left"] > 0.2 and ends["right"] < -0.2


def test_pilots_that_pull_over_steer_by_the_edge_that_they_see(course: loop.Course) -> None:
    def narrow(drive: object) -> dict[str, np.ndarray]:
        """Road in one column of each picture only, straight ahead."""
        exact = course.exact(drive)
        classes = exact["classes"].copy()
        classes[:, : classes.shape[1] // 2 - 1] = classes[:, classes.shape[1] // 2 + 1 :] = 2
        return {**exact, "classes": classes}

    for pilot, side in (("left edge", 1), ("right edge", -1)):
        wide, held = loop.measure_drive(course, pilot), loop.measure_drive(course, pilot, narrow)
        assert side * wide["path"][-1]["shift_m"] > 0.1
        assert abs(held["path"][-1]["shift_m"]) < 0.05
        assert loop.parting(held["path"], wide["path"])["parting_m"] > 0.02


def test_worse_pictures_score_worse_by_what_was_done_to_them(course: loop.Course) -> None:
    def worse(drive: object) -> dict[str, np.ndarray]:
        exact = course.exact(drive)
        rgb = np.clip(exact["rgb"].astype(int), 20, 235) + 20
        return {"rgb": rgb.astype(np.uint8), "depth": exact["depth"] * np.float32(1.25), "classes": exact["classes"]}

    seen = loop.measure_drive(course, "left", worse)
    assert seen["abs_rel"] == pytest.approx(0.25, abs=1e-5)
    assert seen["psnr"] == pytest.approx(20 * math.log10(255 / 20), abs=1.0)
    assert seen["miou"] == 1.0


def test_a_vehicle_on_the_sidewalk_and_in_another_is_judged(course: loop.Course) -> None:
    drive = course.begin()
    assert not course.judge(drive)["off_road"] and not course.judge(drive)["hit"]
    box = next(iter(drive.boxes().values()))
    x, y = box.world_from_box[:2, 3]
    drive.motion = type(drive.motion)(float(x), float(y), drive.motion.heading_rad, 0.0)
    assert course.judge(drive)["hit"]
    aside = course.begin()
    x, y = (aside.pose @ [0, 30, 0, 1])[:2]
    aside.motion = type(aside.motion)(float(x), float(y), aside.motion.heading_rad, 0.0)
    assert course.judge(aside)["off_road"]


def test_a_sweep_is_judged_by_what_the_city_returns_there(course: loop.Course) -> None:
    beams = BeamTable.spinning(np.linspace(-20, 5, 8), 2.0)
    mount = geometry.from_rotation_translation(np.eye(3), (0, 0, 1.8))

    class Echo:
        """Answers with the city's own ranges, farther by an offset, without every third return."""

        def __init__(self, off_m: float, third: bool) -> None:
            self.off_m, self.third = off_m, third

        def render(self, requests: list) -> list:
            pose = requests[0].start.world_from_sensor
            away = np.tile(pose[:3, 3], (len(beams.share), 1)), beams.directions @ pose[:3, :3].T
            found, _ = course.world.ranges(*away, np.full(len(beams.share), requests[0].start.time_s))
            rows = np.flatnonzero(np.isfinite(found))
            rows = rows[np.arange(len(rows)) % 3 > 0] if self.third else rows
            return [SimpleNamespace(beam=rows, range_m=found[rows] + self.off_m)]

    lidar = (SimpleNamespace(sensor="lidar"), beams, mount)
    assert loop.sweep_errors(course, Echo(0.0, False), lidar, course.begin()) == {"range_m": 0.0, "beams_f1": 1.0}
    worse = loop.sweep_errors(course, Echo(0.25, True), lidar, course.begin())
    assert worse["range_m"] == pytest.approx(0.25)
    assert worse["beams_f1"] == pytest.approx(0.8, abs=0.01)


@pytest.mark.slow
def test_the_benchmark_fits_drives_and_is_reused(tmp_path: Path) -> None:
    config = BenchConfig(logs=1, methods=("street_gaussians",), iterations=8, processes=1)
    out = loop.run(config, tmp_path / "loop", rules=RULES)
    doc = json.loads((out / "bench.json").read_text())
    (entry,) = doc["logs"]
    assert set(entry["values"]) == {"exact city", "street_gaussians"} == set(doc["rows"])
    drive = entry["values"]["street_gaussians"]["left"]
    assert 5 < drive["psnr"] < 40 and 0 < drive["abs_rel"] and math.isfinite(drive["parting_m"])
    mean = np.mean([of["psnr"] for of in entry["values"]["street_gaussians"].values()])
    assert doc["pooled"]["street_gaussians"]["psnr"]["mean"] == pytest.approx(mean)
    assert "street_gaussians" in (out / "bench.md").read_text()
    times = {path: path.stat().st_mtime_ns for path in out.rglob("drives/*")}
    assert len(times) == 12
    loop.run(config, tmp_path / "loop", rules=RULES)
    assert times == {path: path.stat().st_mtime_ns for path in out.rglob("drives/*")}
    with pytest.raises(UsageError, match="is no scene"):
        loop.run(BenchConfig(logs=1, methods=("mudg_r",)), tmp_path / "other", rules=RULES)
