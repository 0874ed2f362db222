"""KITTI importer: every layout against an exact drive, and the real pieces against known answers."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import bad_logs
import kitti_folders as made
import numpy as np
import pytest
from refusals import refused

from mudg.base import geometry, store
from mudg.base.errors import UsageError
from mudg.base.geometry import invert
from mudg.base.types import View
from mudg.formats.importers import kitti as kitti_boxes
from mudg.formats.importers.kitti import read_calibration_day, read_calibration_text, read_timestamps
from mudg.scene.read import read_image, read_points

ingest = bad_logs.importer("kitti")


def worst(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.abs(np.asarray(a) - np.asarray(b)).max())


# --- calibration ----------------------------------------------------------------------------------


def test_camera_projects_as_the_projection_matrix_does_and_day_calibration_equals_it(tmp_path: Path) -> None:
    made.write_calibration_text(tmp_path / "calib.txt")
    calibration = read_calibration_text(tmp_path / "calib.txt")
    camera = calibration.camera(2, "front", made.WIDTH, made.HEIGHT)
    view = View(camera, calibration.velo_from_cam(2), 0.0)
    points = np.array([[10.0, 1, 0.5], [25, -4, -1], [6, 0, 0]])
    uv, z = geometry.project(view, points)
    rect0 = points @ made.RECT0_FROM_VELO[:3, :3].T + made.RECT0_FROM_VELO[:3, 3]
    homogeneous = np.c_[rect0, np.ones(3)] @ made.projection(2).T
    assert worst(uv - 0.5, homogeneous[:, :2] / homogeneous[:, 2:]) < 1e-9
    assert worst(z, homogeneous[:, 2]) < 1e-9
    made.write_calibration_text(tmp_path / "calib.txt")
    made.write_calibration_day(tmp_path / "day")
    one, other = read_calibration_text(tmp_path / "calib.txt"), read_calibration_day(tmp_path / "day")
    assert worst(one.rect0_from_velo, other.rect0_from_velo) < 1e-12
    assert worst(one.velo_from_imu, other.velo_from_imu) < 1e-12
    assert worst(one.velo_from_cam(3), other.velo_from_cam(3)) < 1e-12


def test_rounded_rotation_becomes_exact_and_a_scaled_one_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "calib.txt"
    made.write_calibration_text(path)
    rounded = [f"{v:.4f}" for v in geometry.yaw_matrix(0.3)[:3, :3].ravel()]
    text = path.read_text()
    path.write_text(text.replace(made.numbers(np.eye(3)), " ".join(rounded)))
    rotation = read_calibration_text(path).rect0_from_velo[:3, :3]
    assert worst(rotation @ rotation.T, np.eye(3)) < 1e-14
    path.write_text(text.replace(made.numbers(np.eye(3)), made.numbers(1.01 * np.eye(3))))
    refused("pose is scaled", read_calibration_text, path)


# --- raw drives -----------------------------------------------------------------------------------


def test_raw_drive_poses_images_times_and_calibration(tmp_path: Path) -> None:
    folder = made.write_raw_drive(tmp_path / "2011_09_26")
    scene = ingest(folder, tmp_path / "out")
    assert [frame.id for frame in scene.frames] == [f"front/{n:06d}" for n in range(6)]
    assert worst(scene.ego.world_from_ego, np.stack([made.world_from_imu(0.1 * n) for n in range(6)])) < 2e-5
    assert worst([f.view.time_s for f in scene.frames], np.arange(6) * 0.1) < 1e-6
    for n, (frame, sweep) in enumerate(zip(scene.frames, scene.sweeps, strict=True)):
        velo = made.world_from_velo(0.1 * n)
        cam_from_rect0 = geometry.from_rotation_translation(np.eye(3), [0.06, 0, 0.003])
        assert worst(sweep.world_from_lidar, velo) < 2e-5
        assert worst(frame.view.world_from_cam, velo @ invert(cam_from_rect0 @ made.RECT0_FROM_VELO)) < 2e-5
        assert (read_image(scene, frame) == made.image(n)).all()
    assert scene.split["front/000004"] == "test"
    assert sorted(scene.split.values()).count("test") == 1
    assert "CC BY-NC-SA" in scene.source.licence
    scene = ingest(folder, tmp_path / "part", frames=(2, 5))
    assert len(scene.frames) == 3
    moved = invert(made.world_from_imu(0.2)) @ made.world_from_imu(0.4)
    assert worst((invert(scene.ego.world_from_ego[0]) @ scene.ego.world_from_ego[2]), moved) < 2e-5
    assert any("source frames 2 to 4" in note for note in scene.source.notes)


def test_raw_scans_are_untwisted_to_where_the_posts_are(tmp_path: Path) -> None:
    drive = made.Drive()
    folder = made.write_raw_drive(tmp_path / "day")
    scene = ingest(folder, tmp_path / "out")
    plain = ingest(folder, tmp_path / "plain", untwist="no")
    for sweep, twisted in zip(scene.sweeps[1:-1], plain.sweeps[1:-1], strict=True):
        points = read_points(scene, sweep)
        world = geometry.transform_points(sweep.world_from_lidar, points.xyz.astype(np.float64))
        error = np.linalg.norm(world - drive.posts, axis=1)
        assert error.max() < 0.01
        raw = geometry.transform_points(twisted.world_from_lidar, read_points(plain, twisted).xyz.astype(np.float64))
        assert np.linalg.norm(raw - drive.posts, axis=1).max() > 0.3  # what is undone is not small
        turn = np.arctan2(points.xyz[:, 1], points.xyz[:, 0]) / (2 * np.pi) * 0.1
        behind = np.abs(turn) > 0.045  # the correction may carry a point across the seam
        assert worst(points.dt_s[~behind], turn[~behind]) < 1e-3
        assert not read_points(plain, twisted).dt_s.any()


@pytest.mark.parametrize("twisted", [True, False])
def test_tracklets_become_the_cars_exact_path(tmp_path: Path, twisted: bool) -> None:
    folder = made.write_raw_drive(tmp_path / "day", twisted=twisted)
    scene = ingest(folder, tmp_path / "out", untwist="yes" if twisted else "no")
    (track,) = scene.tracks
    assert track.label == "car"
    assert track.size_m.tolist() == list(made.CAR_SIZE_M)
    truth = np.stack([made.world_from_car(t) for t in track.times_s])
    assert worst(track.world_from_object[:, :3, 3], truth[:, :3, 3]) < 5e-3
    assert worst(track.world_from_object[:, :3, :3], truth[:, :3, :3]) < 5e-3


def test_camera_times_outside_the_pose_packets_go_on_as_the_motion_did(tmp_path: Path) -> None:
    folder = made.write_raw_drive(tmp_path / "day")
    late = "\n".join(made.clock_line(0.1 * n + 0.03) for n in range(6)) + "\n"
    (folder / "image_02" / "timestamps.txt").write_text(late)
    scene = ingest(folder, tmp_path / "out")
    last = scene.frames[-1].view
    cam_from_rect0 = geometry.from_rotation_translation(np.eye(3), [0.06, 0, 0.003])
    expected = made.world_from_velo(0.53) @ invert(cam_from_rect0 @ made.RECT0_FROM_VELO)
    assert last.time_s == pytest.approx(0.53, abs=1e-6)
    assert worst(last.world_from_cam, expected) < 3e-3
    path = tmp_path / "timestamps.txt"
    path.write_text("2011-09-26 13:02:59.964389445\n2011-09-26 13:03:00.067891234\n")
    first, second = read_timestamps(path, [0, 1], 1).values()
    assert second - first == pytest.approx(0.103501789, abs=1e-6)


# --- other layouts --------------------------------------------------------------------------------


def test_odometry_sequence(tmp_path: Path) -> None:
    scene = ingest(made.write_odometry(tmp_path), tmp_path / "out")
    truth = np.stack([invert(made.world_from_velo(0)) @ made.world_from_velo(0.1 * n) for n in range(6)])
    assert worst(scene.ego.world_from_ego, truth) < 1e-9
    assert worst([s.time_s for s in scene.sweeps], np.arange(6) * 0.1) < 1e-6
    assert scene.tracks == ()
    assert not read_points(scene, scene.sweeps[3]).dt_s.any()


def test_derived_poses_and_tracking_labels_are_found_without_a_flag(tmp_path: Path) -> None:
    scene = ingest(made.write_derived(tmp_path / "drive"), tmp_path / "out")
    first = invert(made.world_from_velo(0))
    assert worst(scene.ego.world_from_ego[5], first @ made.world_from_velo(0.5)) < 1e-9
    (track,) = scene.tracks
    assert track.id == "7"
    truth = np.stack([first @ made.world_from_car(t) for t in track.times_s])
    assert worst(track.world_from_object, truth) < 1e-6
    assert any("10 Hz" in note for note in scene.source.notes)


def test_tracking_layout_needs_its_sequence_named(tmp_path: Path) -> None:
    root = made.write_tracking(tmp_path / "training")
    assert "0003" in refused("several sequences", ingest, root, tmp_path / "out", raises=UsageError).expected
    scene = ingest(root, tmp_path / "out", sequence="0003")
    assert worst(scene.ego.world_from_ego[4], made.world_from_imu(0.4)) < 2e-5
    truth = np.stack([made.world_from_car(t) for t in scene.tracks[0].times_s])
    assert worst(scene.tracks[0].world_from_object, truth) < 1e-4


def test_object_frame(tmp_path: Path) -> None:
    root = made.write_object(tmp_path / "training")
    scene = ingest(root, tmp_path / "out")
    assert len(scene.frames) == len(scene.sweeps) == 1
    assert worst(scene.ego.world_from_ego[0], np.eye(4)) == 0
    (track,) = scene.tracks  # the DontCare row is no box
    assert worst(track.world_from_object[0], invert(made.world_from_velo(0.8)) @ made.world_from_car(0.8)) < 1e-6
    made.write_object(tmp_path / "many", frames=(3, 8))
    refused("unrelated frames", ingest, tmp_path / "many", tmp_path / "out2", raises=UsageError)
    assert len(ingest(tmp_path / "many", tmp_path / "out2", sequence="000008").frames) == 1


def test_explicit_files_win_over_those_found(tmp_path: Path) -> None:
    root = made.write_derived(tmp_path / "drive")
    still = tmp_path / "still.txt"
    still.write_text("\n".join(f"{n} {made.numbers(np.eye(4)[:3])}" for n in range(6)) + "\n")
    none = tmp_path / "none.txt"
    none.write_text("")
    scene = ingest(root, tmp_path / "out", poses=still, boxes=none)
    assert worst(scene.ego.world_from_ego, np.stack([np.eye(4)] * 6)) == 0
    assert scene.tracks == ()


def test_track_with_a_gap_is_split_where_it_is_long(tmp_path: Path) -> None:
    drive = made.Drive(tuple(range(14)))
    root = made.write_derived(tmp_path / "drive", drive)
    rows = [made.label_line(0.1 * n, f"{n} 7 ") for n in drive.frames if n not in (2, 3, 6, 7, 8, 9, 10, 11)]
    (root / "derived" / "label_02.txt").write_text("\n".join(rows) + "\n")
    scene = ingest(root, tmp_path / "out")
    spans = {t.id: (round(float(t.times_s[0]), 3), round(float(t.times_s[-1]), 3)) for t in scene.tracks}
    assert spans == {"7": (0.0, 0.5), "7.1": (1.2, 1.3)}
    short_gap = scene.track("7").pose_at(0.25)
    assert worst(short_gap, invert(made.world_from_velo(0)) @ made.world_from_car(0.25)) < 1e-6
    assert any("0.55 s and were split" in note for note in scene.source.notes)


# --- real pieces ----------------------------------------------------------------------------------


def test_real_sequence_imports_with_one_command(shared_data: Callable[[str], Path], tmp_path: Path) -> None:
    source = shared_data("kitti_2011_09_26")
    scene = ingest(source, tmp_path / "out")
    assert (len(scene.frames), len(scene.sweeps), len(scene.tracks)) == (16, 16, 8)
    poses = np.loadtxt(source / "derived" / "poses_velo.txt")
    assert worst(scene.ego.world_from_ego[:, :3].reshape(16, 12), poses[:, 1:]) < 1e-6
    # the two pose files of the folder agree with each other once frames of reference are put right
    other = ingest(source, tmp_path / "cam0", poses=source / "derived" / "poses_cam0.txt")
    assert worst(other.ego.world_from_ego, scene.ego.world_from_ego) < 1e-6
    # boxes against the same boxes given in the world
    objects = store.read_json(source / "derived" / "tracks.json")["objects"]
    for track in scene.tracks:
        given = np.array([objects[track.id]["world_from_box"][str(n)] for n in range(16)]).reshape(16, 3, 4)
        # labels turn about the camera's y axis, which leans by about 0.01 rad against the LiDAR's z axis
        assert worst(track.world_from_object[:, :3, 3], given[:, :, 3]) < 0.025
        assert worst(track.world_from_object[:, :3, :3], given[:, :, :3]) < 0.02


def test_real_tracking_boxes_project_to_their_rectangles(shared_data: Callable[[str], Path]) -> None:
    source = shared_data("kitti_tracking_0001")
    calibration = read_calibration_text(source / "calib.txt")
    camera = calibration.camera(2, "front", 1242, 375)
    view = View(camera, calibration.velo_from_cam(2), 0.0)
    signs = np.array([[i, j, k] for i in (-1, 1) for j in (-1, 1) for k in (-1, 1)]) / 2
    differences = []
    boxes = kitti_boxes.read_label_text(source / "label_02.txt", calibration.rect0_from_velo)
    rows = [line.split() for line in (source / "label_02.txt").read_text().splitlines() if "DontCare" not in line]
    for box, row in zip(boxes, rows, strict=True):
        left, top, right, bottom = (float(value) for value in row[6:10])
        uncut = left > 1 and top > 1 and right < 1240 and bottom < 373
        if box.frame not in (10, 20) or not uncut:
            continue
        corners = geometry.transform_points(box.pose, signs * box.size_m)
        uv = geometry.project(view, corners)[0] - 0.5  # KITTI counts from the pixel's centre
        differences.append(np.abs(np.r_[uv.min(0), uv.max(0)] - [left, top, right, bottom]).max())
    assert len(differences) >= 10
    assert np.median(differences) < 0.35


# --- empty lines ----------------------------------------------------------------------------------


def empty_lines(path: Path, *numbers: int) -> None:
    lines = path.read_text().splitlines()
    path.write_text("\n".join("" if n in numbers else line for n, line in enumerate(lines)) + "\n")


@pytest.mark.parametrize("frames", [None, (0, 12)])
@pytest.mark.parametrize("stream", ["velodyne_points", "oxts", "image_02"])
def test_an_empty_line_is_a_missing_time_and_moves_nothing(
    stream: str, frames: tuple[int, int] | None, tmp_path: Path
) -> None:
    """Drive 0009 of 2011_09_26 lacks four scans, and the file of their times has empty lines for them."""
    folder = made.write_raw_drive(tmp_path / "day", made.Drive(tuple(range(14))), twisted=False)
    suffix = {"velodyne_points": "bin", "oxts": "txt", "image_02": "png"}[stream]
    for number in (4, 5):
        (folder / stream / "data" / f"{number:010d}.{suffix}").unlink()
    empty_lines(folder / stream / "timestamps.txt", 4, 5)
    scene = ingest(folder, tmp_path / "out", skip_missing=True, frames=frames, untwist="no")
    numbers = [n for n in range(*(frames or (0, 14))) if stream == "oxts" or n not in (4, 5)]
    first = invert(made.world_from_imu(0.0))
    assert [sweep.time_s for sweep in scene.sweeps] == pytest.approx([0.1 * n for n in numbers])
    assert [frame.view.time_s for frame in scene.frames] == pytest.approx([0.1 * n for n in numbers])
    for number, sweep in zip(numbers, scene.sweeps, strict=True):
        exact = first @ made.world_from_velo(0.1 * number)
        assert worst(sweep.world_from_lidar[:3, 3], exact[:3, 3]) < (0.03 if stream == "oxts" else 1e-5)
    pictures = [int(read_image(scene, frame)[0, 0, 2]) for frame in scene.frames]
    assert pictures == [20 * n % 256 for n in numbers]


def test_a_time_that_is_missing_for_a_recorded_file_is_named(tmp_path: Path) -> None:
    folder = made.write_raw_drive(tmp_path / "day")
    empty_lines(folder / "image_02" / "timestamps.txt", 2)
    refused("timestamps of front lacks 2", ingest, folder, tmp_path / "refused")
    scene = ingest(folder, tmp_path / "out", skip_missing=True)
    assert [sweep.time_s for sweep in scene.sweeps] == pytest.approx([0.0, 0.1, 0.3, 0.4, 0.5])


@pytest.mark.parametrize("kind", ["poses", "packets"])
def test_an_empty_line_of_poses_or_packets_is_a_missing_one(kind: str, tmp_path: Path) -> None:
    """Line k is frame k: what lies behind the empty line stays where it was."""
    drive = made.Drive(tuple(range(8)))
    if kind == "poses":
        folder, sequence, first = made.write_odometry(tmp_path, drive), "", invert(made.world_from_velo(0.0))
        empty_lines(tmp_path / "poses" / "07.txt", 3)
        refused("pose file lacks frames", ingest, folder, tmp_path / "refused")
    else:
        folder, sequence, first = made.write_tracking(tmp_path, drive=drive), "0003", invert(made.world_from_imu(0.0))
        empty_lines(folder / "oxts" / "0003.txt", 3)
    scene = ingest(folder, tmp_path / "out", sequence=sequence, skip_missing=True)
    for sweep in scene.sweeps:
        exact = first @ made.world_from_velo(sweep.time_s)
        # frame 3 lies between its neighbours: 1.6 m of the arc
        assert worst(sweep.world_from_lidar[:3, 3], exact[:3, 3]) < 0.03
    assert [sweep.time_s for sweep in scene.sweeps] == pytest.approx(np.arange(8) * 0.1)
