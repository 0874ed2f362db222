"""Logs with sensors on their own clocks: choosing frames, the split, missing files, boxes brought to the sweeps'
times."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from bad_logs import refused
from PIL import Image

from mudg.base.errors import UsageError
from mudg.base.geometry import yaw_matrix
from mudg.base.types import Camera, EgoPath, Source, SweepPoints, Track
from mudg.formats.importers import common
from mudg.formats.importers.common import ImportOptions, nearest_index
from mudg.formats.importers.drive_log import (
    BoxTimes,
    BoxTracks,
    DriveLog,
    ImageRecord,
    SweepRecord,
    clip_track,
    reach_images,
    write_log,
)
from mudg.scene.check import check_records

UP = np.array([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 1.5], [0, 0, 0, 1]])


def points(count: int = 3) -> SweepPoints:
    xyz = np.arange(3 * count, dtype=np.float32).reshape(-1, 3) + 5
    return SweepPoints(xyz, np.zeros(count, np.float32), np.zeros(count, np.float32))


def made(folder: Path, *, offset_s: float = 0.03) -> DriveLog:
    """Camera a at 10 Hz, b at 10 Hz a little later, c with one image only; sweeps at 20 Hz; the vehicle drives 10
    m/s."""
    folder.mkdir()
    Image.new("RGB", (32, 16), (9, 99, 199)).save(folder / "image.png")

    def place(time_s: float) -> np.ndarray:
        return yaw_matrix(0.5, (1000 + 10 * time_s * np.cos(0.5), 50.0 + 10 * time_s * np.sin(0.5), 7.0))

    cameras = {name: Camera(name, 32, 16, 30.0, 30.0, 16.0, 8.0) for name in "abc"}
    times = {"a": [0.1 * n for n in range(6)], "b": [0.1 * n + offset_s for n in range(6)], "c": [0.31]}
    images = []
    for name, stamps in times.items():
        for number, time_s in enumerate(stamps):
            path = folder / f"{name}{number}.png"
            path.write_bytes((folder / "image.png").read_bytes())
            images.append(ImageRecord(name, time_s, place(time_s) @ UP, path))
    path, read = folder / "image.png", partial(points, 3)
    sweeps = [SweepRecord("lidar", 0.05 * n, place(0.05 * n), path, read) for n in range(11)]
    ego = EgoPath(np.arange(-20, 80) * 0.01, np.stack([place(0.01 * n) for n in range(-20, 80)]))
    source = Source("made", "none")
    return DriveLog("log", cameras, images[::-1], sweeps[::-1], [], ego, source, str(folder))


def test_nearest_index_gives_ties_to_the_earlier() -> None:
    times_s = np.array([-5, 0.4, 0.5, 0.6, 2.5, 2.6, 99])
    assert nearest_index(np.array([0.0, 1.0, 4.0]), times_s).tolist() == [0, 0, 0, 1, 1, 2, 2]
    assert nearest_index(np.array([3.0]), np.array([-1.0, 9.0])).tolist() == [0, 0]


def test_frames_are_counted_by_the_reference_and_held_out_together(tmp_path: Path) -> None:
    drive = made(tmp_path / "log")
    scene = write_log(drive, tmp_path / "out", ImportOptions(frames=(2, 4), test_every=0))
    assert [f.id for f in scene.frames_of("a")] == ["a/000000", "a/000001"]
    assert np.allclose([f.view.time_s for f in scene.frames_of("a")], [0.0, 0.1])  # zero is the earliest record
    assert np.allclose([f.view.time_s for f in scene.frames_of("b")], [0.03, 0.13])
    assert np.allclose([f.view.time_s for f in scene.frames_of("c")], [0.11])
    assert np.allclose([s.time_s for s in scene.sweeps], [0.0, 0.05, 0.1, 0.15])  # halfway goes to the earlier frame
    assert np.allclose(scene.ego.world_from_ego[0][:3, 3], 0)
    assert np.allclose(scene.ego.world_from_ego[0][:3, :3], np.eye(3))
    assert any("frames 2 to 3 of camera a" in note for note in scene.source.notes)
    scene = write_log(drive, tmp_path / "split", ImportOptions(test_every=3))
    assert sorted(i for i, s in scene.split.items() if s == "test") == ["a/000003", "b/000003", "c/000000"]


def test_missing_files_are_counted_per_sensor_or_left_out(tmp_path: Path) -> None:
    drive = made(tmp_path / "log")
    (tmp_path / "log" / "b2.png").unlink()
    assert refused("missing", write_log, drive, tmp_path / "out", ImportOptions()).got == "b lacks 1 (first: b2.png)"
    assert not (tmp_path / "out").exists()
    scene = write_log(drive, tmp_path / "out", ImportOptions(skip_missing=True))
    assert len(scene.frames_of("b")) == 5


def test_ranges_beyond_the_log_and_impossible_motion_are_refused(tmp_path: Path) -> None:
    drive = made(tmp_path / "log")
    caught = refused("no frame", write_log, drive, tmp_path / "out", ImportOptions(frames=(6, 9)), raises=UsageError)
    assert "0 to 5" in caught.expected
    without_c = replace(drive, images=[image for image in drive.images if image.sensor != "c"])
    assert refused("no images", write_log, without_c, tmp_path / "out", ImportOptions()).got == "c"
    twice = replace(drive, images=[*drive.images, drive.images[0]])
    refused("same time", write_log, twice, tmp_path / "out", ImportOptions())
    fast = replace(drive, ego=EgoPath(drive.ego.times_s / 1000, drive.ego.world_from_ego))
    refused("impossibly fast", write_log, fast, tmp_path / "out", ImportOptions())
    lying = replace(drive, ego=EgoPath(drive.ego.times_s, drive.ego.world_from_ego @ UP))
    refused("upright", write_log, lying, tmp_path / "out", ImportOptions())
    sliding = EgoPath(drive.ego.times_s, drive.ego.world_from_ego @ yaw_matrix(0.8))
    common.check_motion(drive.ego, "log")
    assert "46 degrees" in refused("where it looks", common.check_motion, sliding, "log").got
    common.check_motion(EgoPath(drive.ego.times_s, drive.ego.world_from_ego @ yaw_matrix(np.pi)), "log")


@pytest.mark.parametrize(
    ("stamp", "per_second"),
    [(1_532_402_927_647, 10**6), (1_532_402_927_647_951_000, 10**6), (315_966_265_259_836, 10**9)],
)
def test_stamps_in_another_unit_are_refused(stamp: int, per_second: int) -> None:
    refused("another unit", common.check_epoch, np.array([stamp]), per_second, "table")
    common.check_epoch(np.array([1_532_402_927 * per_second, 1_532_402_947 * per_second]), per_second, "table")


# --- tracks ---------------------------------------------------------------------------------------


def tracks_of(*keys: tuple[float, float], max_gap_s: float = 1.0) -> tuple[list[Track], list[str]]:
    """Tracks of car 7 from (time, x)."""
    boxes = BoxTracks("table", {}, max_gap_s)
    for time_s, x in keys:
        boxes.add("7", "car", time_s, (4.0, 2.0, 1.5), yaw_matrix(0.0, (x, 0.0, 0.0)))
    return boxes.tracks()


def test_tracks_are_sorted_split_at_gaps_and_clipped_one_key_beyond_each_end() -> None:
    tracks, notes = tracks_of(*((t, t) for t in (2.0, 0.0, 0.5, 1.0, 5.0)), max_gap_s=1.1)
    assert [(t.id, t.times_s.tolist()) for t in tracks] == [("7", [0.0, 0.5, 1.0, 2.0]), ("7.1", [5.0])]
    assert notes == ["1 tracks are not seen for more than 1.1 s and were split there"]
    refused("two boxes", tracks_of, (1.0, 0.0), (1.0, 1.0))
    track = tracks_of(*((0.5 * n, n) for n in range(9)))[0][0]
    kept = clip_track(track, 1.2, 2.0)
    assert kept.times_s.tolist() == [1.0, 1.5, 2.0]
    assert clip_track(track, 1.2, 2.1).times_s.tolist() == [1.0, 1.5, 2.0, 2.5]
    assert clip_track(track, 4.1, 5.0) is None
    assert clip_track(track, -3.0, -0.1) is None


def test_what_stands_needs_no_keys_in_between_and_what_left_its_place_does(tmp_path: Path) -> None:
    """Boxes that stand in the whole log have two keys, from the first image to the last; that is no gap."""

    scene = write_log(made(tmp_path / "log"), tmp_path / "out", ImportOptions())

    def scene_of(*standing: bool, x_m: float) -> tuple[list[Track], list[str]]:
        boxes = BoxTracks("table", {}, 9.0)
        times = np.arange(len(standing)) * 3.0
        for index, stands in enumerate(standing):
            x = x_m * index / (len(standing) - 1)
            boxes.add("7", "car", times[index], (4.0, 2.0, 1.5), yaw_matrix(0.0, (x, 0.0, 0.0)), standing=stands)
        tracks, _ = boxes.tracks(images_s={time_s: (time_s - 0.09, time_s - 0.02) for time_s in times.tolist()})
        gaps = [f.message for f in check_records(replace(scene, tracks=tuple(tracks))) if "not seen" in f.message]
        return tracks, gaps

    (stays,), gaps = scene_of(True, True, True, x_m=0.0)
    assert stays.times_s == pytest.approx([-0.09, 6.0])
    assert gaps == []
    # not known to stand, but nowhere else when it is seen again
    (seldom,), gaps = scene_of(False, False, False, x_m=0.0)
    assert len(seldom.times_s) == 4
    assert gaps == []
    (moved,), gaps = scene_of(False, False, False, x_m=2.0)
    assert "not seen for 3.0 s" in gaps[0]
    (changed,), _ = scene_of(True, False, True, x_m=2.0)  # one box that moves makes an object that moves
    assert len(changed.times_s) == 4


def test_swapped_sides_are_refused_when_most_vehicles_have_them() -> None:
    def boxes(*widths: float) -> BoxTracks:
        found = BoxTracks("table", {})
        for number, width in enumerate(widths):
            found.add(str(number), "car", 0.0, (6.0 - width, width, 1.5), yaw_matrix(0.0, (9.0 * number, 0.0, 0.0)))
        return found

    assert len(boxes(2.0, 2.0, 4.0).tracks()[0]) == 3
    assert "2 of 3" in refused("swapped", boxes(4.0, 2.0, 4.0).tracks).got


def test_a_track_takes_its_commonest_label_and_unknown_ones_keep_their_last_word() -> None:
    boxes = BoxTracks("table", {})
    for time_s, label in ((0.0, "van"), (0.1, "car"), (0.2, "car")):
        boxes.add("7", label, time_s, (4.0, 2.0, 1.5), np.eye(4))
    assert boxes.tracks()[0][0].label == "car"
    for bad in ((0.0, 2.0, 1.5), (4.0, float("nan"), 1.5), (4.0, 2.0, 1e6), (None, 2.0, 1.5)):
        caught = refused("box size", boxes.add, "8", "car", 0.0, bad, np.eye(4), where="table: row 3")
        assert caught.where == "table: row 3"
    boxes = BoxTracks("table", {"vehicle.car": "car"})
    assert boxes.label_of("vehicle.hover Craft") == "hover_craft"
    assert boxes.label_of("vehicle.car") == "car"
    assert boxes.tracks()[1] == ["classes that are not known here keep their names: 'vehicle.hover Craft' (1 boxes)"]


def drawn(speed: float, delays: list[float], x0: float = 20.0) -> tuple[Track, list[SweepPoints]]:
    """A car along x, boxes drawn around returns taken ``delays`` after each sweep's time; sweeps every 0.1 s at the
    origin."""
    poses, sweeps = [], []
    for number, late in enumerate(delays):
        x = x0 + speed * (0.1 * number + late)
        poses.append(yaw_matrix(0.0, (x, 3.0, 0.0)))
        xyz = np.array([[x - 1.9, 3.5, 0.2], [x - 1.9, 2.5, 0.4], [60.0, 3.0, 0.0]], np.float32)
        dt_s = np.array([late - 0.004, late + 0.004, -9.0], np.float32)
        sweeps.append(SweepPoints(xyz, np.zeros(3, np.float32), dt_s))
    times = 0.1 * np.arange(len(delays))
    return Track("1", "car", np.array([4.0, 2.0, 1.5]), times, np.stack(poses)), sweeps


@pytest.mark.parametrize(
    "delays", [[0.08] * 6, [0.02, 0.03, 0.04, 0.05, 0.06, 0.07], [0.09, 0.1, 0.1, 0.0, 0.01, 0.02]]
)
def test_boxes_come_to_the_sweeps_times(delays: list[float]) -> None:
    track, sweeps = drawn(10.0, delays)
    times = BoxTimes([track])
    for number, sweep in reversed(list(enumerate(sweeps))):
        times.observe(0.1 * number, np.eye(4), sweep)
    (moved,) = times.at_sweep_times()
    assert np.abs(moved.world_from_object[:, 0, 3] - (20 + 10.0 * track.times_s)).max() < 1e-4
    assert np.abs(track.world_from_object[:, 0, 3] - (20 + 10.0 * track.times_s)).max() > 0.5


def test_boxes_without_returns_take_the_delay_of_their_neighbours_and_standing_ones_stay() -> None:
    track, sweeps = drawn(10.0, [0.08] * 6)
    standing, _ = drawn(0.5, [0.08] * 6)
    times = BoxTimes([track, standing])
    times.observe(0.2, np.eye(4), sweeps[2])
    moved, kept = times.at_sweep_times()
    assert np.abs(moved.world_from_object[:, 0, 3] - (20 + 10.0 * track.times_s)).max() < 1e-4
    assert kept is standing


def test_tracks_reach_the_images_at_their_ends() -> None:
    track, _ = drawn(10.0, [0.0] * 6)
    longer = reach_images(track)
    assert np.allclose(longer.times_s, [-0.05, *track.times_s, 0.55])
    assert np.allclose(longer.world_from_object[:, 0, 3], 20 + 10 * longer.times_s)
    assert (longer.world_from_object[1:-1] == track.world_from_object).all()
    once = reach_images(Track("1", "car", track.size_m, np.array([2.0]), track.world_from_object[:1]))
    assert once.times_s.tolist() == [1.95, 2.0, 2.05]
    assert (once.world_from_object == track.world_from_object[0]).all()
