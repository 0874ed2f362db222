"""Gaps, flips and jumps between pose keys: of the vehicle and of tracks, against an arc that is known exactly."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import bad_logs
import kitti_folders
import numpy as np
import pytest
import roundtrip
import write_custom
from refusals import refused
from toy_scene import ToyStreet

from mudg.base.geometry import yaw_matrix
from mudg.base.types import EgoPath, Scene, Track
from mudg.formats.importers import IMPORTERS, custom
from mudg.formats.importers.common import ImportOptions
from mudg.scene import motion
from mudg.scene.check import check_records

truth = bad_logs.truth

RADIUS_M, SPEED_M_S = 12.0, 8.0
LOST_S = (0.62, 1.88)


def on_arc(time_s: float) -> np.ndarray:
    """The vehicle in a tight curve, exactly."""
    angle = SPEED_M_S * time_s / RADIUS_M
    return yaw_matrix(angle, (RADIUS_M * np.sin(angle), RADIUS_M * (1 - np.cos(angle)), 0.0))


def arc(first_s: float, last_s: float, step_s: float, lost_s: tuple[float, float] = (1.0, 0.0)) -> EgoPath:
    times = np.arange(first_s, last_s + 1e-9, step_s)
    times = times[(times < lost_s[0]) | (times > lost_s[1])]
    return EgoPath(times, np.stack([on_arc(float(time_s)) for time_s in times]))


def warnings(scene: Scene, place: str) -> str:
    return "\n".join(f.message for f in check_records(scene) if f.level == "warning" and f.where.startswith(place))


def curve_log(truth: Scene, root: Path, path: EgoPath) -> Path:
    """The city's images and sweeps, one every half second, of a vehicle in the curve."""

    def edit(log: dict[str, Any]) -> None:
        start = write_custom.ns(0.0)
        keys = ((write_custom.ns(t), write_custom.far(p).tolist()) for t, p in zip(path.times_s, path.world_from_ego))
        log["ego"] = [{"time": time, "world_from_ego": pose} for time, pose in keys]
        log["tracks"] = []
        for record in (*log["images"], *log["sweeps"]):
            record["time"] = start + 5 * (record["time"] - start)

    return write_custom.write_log(truth, root, edit=edit)


@roundtrip.needs_native
def test_frames_in_a_gap_of_a_curve_are_refused_or_left_out(truth: Scene, tmp_path: Path) -> None:
    log = curve_log(truth, tmp_path / "log", arc(-0.5, 2.5, 0.05, LOST_S))
    caught = refused("vehicle poses have a gap", IMPORTERS["custom"], log, tmp_path / "refused", ImportOptions())
    assert "no pose for 1.30 s" in caught.got and "--skip-missing" in caught.remedy
    assert any("vehicle poses have a gap" in f.message for f in custom.check_log(log))

    left = IMPORTERS["custom"](log, tmp_path / "left", ImportOptions(skip_missing=True))
    every = curve_log(truth, tmp_path / "all", arc(-0.5, 2.5, 0.05))
    whole = IMPORTERS["custom"](every, tmp_path / "whole", ImportOptions())
    times = {round(f.view.time_s, 6) for f in whole.frames}
    # seconds count from the first pose, 0.5 s before
    inside = {t for t in times if LOST_S[0] + 0.3 < t - 0.5 < LOST_S[1] - 0.3}
    assert inside and {round(f.view.time_s, 6) for f in left.frames} == times - inside
    assert "no pose for 1.30 s" in warnings(left, "ego path")


def test_lost_packets_of_kitti_leave_their_frames_out(tmp_path: Path) -> None:
    folder = kitti_folders.write_raw_drive(tmp_path / "day", kitti_folders.Drive(tuple(range(16))), twisted=False)
    for number in range(3, 14):
        (folder / "oxts" / "data" / f"{number:010d}.txt").write_text("\n")
    refused("packets are missing", IMPORTERS["kitti"], folder, tmp_path / "refused", ImportOptions())
    left = IMPORTERS["kitti"](folder, tmp_path / "left", ImportOptions(skip_missing=True))
    whole = [round(0.1 * n, 6) for n in range(16)]
    kept = [round(s.time_s, 6) for s in left.sweeps]
    assert set(kept) < set(whole) and {0.0, 0.2, 1.4, 1.5} <= set(kept) and not {0.6, 0.8, 1.0} & set(kept)
    first = np.linalg.inv(kitti_folders.world_from_imu(0.0))
    for sweep in left.sweeps:
        exact = first @ kitti_folders.world_from_velo(sweep.time_s)
        assert np.linalg.norm(sweep.world_from_lidar[:3, 3] - exact[:3, 3]) < motion.OFF_M


def poses_of(headings: list[float], step_m: float) -> np.ndarray:
    return np.stack([yaw_matrix(np.deg2rad(h), (step_m * n, 0, 0)) for n, h in enumerate(headings)])


FLIPS: dict[str, tuple[list[float], float, float, list[float]]] = {
    # headings, metres and seconds a step, headings afterwards
    "one of many, standing": ([0, 1, 181, 2, 1], 0.0, 0.1, [0, 1, 1, 2, 1]),
    "half of them, driving": ([0, 0, 180, 180], 1.0, 0.1, [0, 0, 0, 0]),
    "half of them, standing: not known": ([0, 0, 180, 180], 0.0, 0.1, [0, 0, 180, 180]),
    "half of them, driving the other way": ([0, 0, 180, 180], -1.0, 0.1, [180, 180, 180, 180]),
    "a flipped first key": ([180, 0, 0, 0], 1.0, 0.1, [0, 0, 0, 0]),
    "every other key": ([0, 180, 0, 180, 0, 180], 1.0, 0.1, [0] * 6),
    "a car that reverses, one key flipped": ([180, 180, 0, 180, 180], 1.0, 0.1, [180] * 5),
    "a real turn of many keys": ([0, 45, 90, 135, 180], 1.0, 0.5, [0, 45, 90, 135, 180]),
    "a real turn between far keys": ([0, 180], 5.0, 3.0, [0, 180]),
    "a turn into another street": ([0, 30, 90, 90], 1.0, 0.3, [0, 30, 90, 90]),
}


@pytest.mark.parametrize("case", FLIPS)
def test_headings_that_flip_are_turned_back_where_it_is_clear(case: str) -> None:
    headings, step_m, step_s, wanted = FLIPS[case]
    times = step_s * np.arange(len(headings))
    mended, turned = motion.unflipped(times, poses_of(headings, step_m), motion.MOST_TURN_RAD_S)
    assert np.allclose(mended, poses_of(wanted, step_m), atol=1e-9)
    assert len(turned) == sum(a != b for a, b in zip(headings, wanted, strict=True))


@roundtrip.needs_native
def test_flips_of_tracks_and_of_the_vehicle_are_undone_on_import(truth: Scene, tmp_path: Path) -> None:
    """The generated city is the truth: with flipped headings in the log the scene is the same as without."""

    def flip(log: dict[str, Any]) -> None:
        for record in (log["tracks"][0]["boxes"][2]["world_from_object"], log["ego"][5]["world_from_ego"]):
            for row in record[:3]:
                row[0], row[1] = -row[0], -row[1]

    log = write_custom.write_log(truth, tmp_path / "log", edit=flip)
    scene = IMPORTERS["custom"](log, tmp_path / "scene", ImportOptions())
    roundtrip.assert_same_log(scene, truth, time_s=2e-9)
    for track in scene.tracks:
        middle = (track.times_s[1] + track.times_s[2]) / 2  # between two keys, where a flip would stand across the lane
        sides = [pose[:3, 0] for pose in (track.pose_at(float(middle)), track.world_from_object[1]) if pose is not None]
        assert sides[0] @ sides[1] > 0.9
    notes = "\n".join(scene.source.notes)
    assert f"turned back: {truth.tracks[0].id} at " in notes and "the vehicle's heading flips by 180 degrees" in notes
    words = "\n".join(f"{f.where} {f.message}" for f in custom.check_log(log) if f.level == "warning")
    assert "ego path its heading flips by 180 degrees" in words
    assert f"track {truth.tracks[0].id}" in words and "ingest turns it back" in words


def test_doctor_names_what_no_vehicle_does(tmp_path: Path) -> None:
    scene = ToyStreet(times=(0.0, 0.1)).write(tmp_path / "scene")
    plain = arc(0.0, 2.0, 0.1)
    assert not warnings(replace(scene, ego=plain), "ego path")

    def changed(change: Any) -> str:
        poses = plain.world_from_ego.copy()
        change(poses)
        return warnings(replace(scene, ego=EgoPath(plain.times_s, poses)), "ego path")

    assert "it jumps by 1.5 m after 0.900 s (key 9" in changed(lambda p: p[10:, :3, 3].__iadd__([0, 0, 1.5]))
    turn = yaw_matrix(np.pi / 2 - SPEED_M_S * 0.1 / RADIUS_M)[:3, :3]  # with what the curve has anyway
    turned, flipped = (lambda p: p[10:, :3, :3].__imatmul__(turn)), (lambda p: p[10, :3, :2].__imul__(-1))
    assert "it turns by 90 degrees within 0.10 s after 0.900 s (key 9" in changed(turned)
    assert "heading flips by 180 degrees 2 times, first after 0.900 s (key 9)" in changed(flipped)
    times = plain.times_s
    boxes = np.stack([yaw_matrix(0.0, (8 * t + (6 if t > 0.95 else 0), 3, 0)) for t in times])
    track = Track("swapped", "car", np.array([4.5, 1.9, 1.5]), times, boxes)
    assert "it jumps by 6.0 m after 0.900 s (key 9" in warnings(replace(scene, tracks=(track,)), "track swapped")


@roundtrip.needs_native
def test_earth_centred_coordinates_keep_their_digits(truth: Scene, tmp_path: Path) -> None:
    """6378 km from the origin a float32 number is rounded to half a metre; the offset is taken off before."""
    far = np.array([6_378_137.25, -4_200_000.5, 310.0])

    def move(log: dict[str, Any]) -> None:
        boxes = (b["world_from_object"] for t in log["tracks"] for b in t["boxes"])
        for record in (*(e["world_from_ego"] for e in log["ego"]), *boxes):
            for row, value in zip(record, far, strict=False):
                row[3] += value

    log = write_custom.write_log(truth, tmp_path / "log", edit=move)
    scene = IMPORTERS["custom"](log, tmp_path / "scene", ImportOptions())
    roundtrip.assert_same_log(scene, truth, time_s=2e-9)
    first = json.loads((log / "log.json").read_text())["ego"][0]["world_from_ego"]
    assert f"({first[0][3]:.3f}, {first[1][3]:.3f}, {first[2][3]:.3f})" in "\n".join(scene.source.notes)
    assert not warnings(scene, "world")
    moved = np.stack([write_custom.far(pose) for pose in scene.ego.world_from_ego])
    away = replace(scene, ego=EgoPath(scene.ego.times_s, moved))
    assert "float32 rounds points there to 500 mm" in warnings(away, "world")
