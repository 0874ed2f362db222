"""KITTI-360 importer: a round trip through the published layout, then every part and every refusal."""

from __future__ import annotations

import re
import shutil
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import bad_logs
import numpy as np
import pytest
import roundtrip
import write_kitti360 as made
from PIL import Image
from refusals import refused

from mudg.base.errors import UsageError
from mudg.base.geometry import invert, transform_points, yaw_matrix
from mudg.base.types import Scene
from mudg.formats.importers import RECOGNISERS
from mudg.formats.importers.kitti360 import read_boxes
from mudg.scene.labels import read_label
from mudg.scene.read import read_image, read_points

truth = bad_logs.truth
pristine, source = bad_logs.fixtures(made.write_kitti360, "KITTI-360")
ingest = bad_logs.importer("kitti360", untwist="no")

pytestmark = roundtrip.needs_native
SAME = {"front": "front", "front_left": "front_stereo"}


POSES = f"data_poses/{made.DRIVE}/poses.txt"
SCANS = f"data_3d_raw/{made.DRIVE}/velodyne_points"
STAMPS, SCAN = f"{SCANS}/timestamps.txt", f"{SCANS}/data/{made.FIRST + 1:010d}.bin"
IMAGE = f"data_2d_raw/{made.DRIVE}/image_01/data_rect/{made.FIRST + 2:010d}.png"


# --- what is read ---------------------------------------------------------------------------------


def test_round_trip(truth: Scene, pristine: Path, tmp_path: Path) -> None:
    scene = ingest(pristine, tmp_path / "out", workers=2)
    roundtrip.assert_same_log(scene, truth, cameras=SAME)
    assert "CC BY-NC-SA" in scene.source.licence
    assert "front/000004" in {name for name, part in scene.split.items() if part == "test"}
    assert np.abs(scene.ego.world_from_ego[0, :3, 3]).max() < 1e-9  # the world begins at the vehicle
    assert [name for name, looks_like in RECOGNISERS.items() if looks_like(pristine)] == ["kitti360"]
    drive = pristine / "data_2d_raw" / made.DRIVE
    assert next(name for name, looks_like in RECOGNISERS.items() if looks_like(drive)) == "kitti360"
    part = ingest(drive, tmp_path / "part", frames=(2, 4), cameras=("image_01",), sequence="0003")
    assert [frame.id for frame in part.frames] == ["front_stereo/000000", "front_stereo/000001"]
    assert (read_image(part, part.frames[0]) == read_image(truth, truth.frames_of("front_left")[1])).all()


def test_poses_between_are_interpolated_and_outside_are_left_out(truth: Scene, source: Path, tmp_path: Path) -> None:
    path = source / POSES
    rows = path.read_text().splitlines()
    path.write_text("\n".join(rows[k] for k in (0, 2, 4)) + "\n")
    scene = ingest(source, tmp_path / "out")
    assert len(scene.sweeps) == 5
    for n in (1, 3):
        before, own, after = (scene.sweeps[k].world_from_lidar[:3, 3] for k in (n - 1, n, n + 1))
        assert np.abs(own - (before + after) / 2).max() < 1e-5  # the LiDAR turns about the vehicle
    moved = scene.sweeps[2].world_from_lidar[:3, 3] - scene.sweeps[0].world_from_lidar[:3, 3]
    true = truth.sweeps[2].world_from_lidar[:3, 3] - truth.sweeps[0].world_from_lidar[:3, 3]
    assert np.linalg.norm(moved) == pytest.approx(np.linalg.norm(true), abs=1e-6)
    path.write_text("\n".join(rows[1:4]) + "\n")
    inner = ingest(source, tmp_path / "inner")
    assert len(inner.sweeps) == 3
    assert any("without a pose or time stamp were left out: 1, 5" in note for note in inner.source.notes)


def test_a_gap_in_which_the_vehicle_moved_is_not_filled(source: Path, tmp_path: Path) -> None:
    path = source / POSES
    rows = [np.array(line.split(), float) for line in path.read_text().splitlines()]
    for row in rows[3:]:
        row[[4, 8]] += 40.0
    path.write_text("\n".join(made.numbers(row).replace(".0 ", " ", 1) for row in (rows[0], rows[1], rows[3], rows[4])))
    scene = ingest(source, tmp_path / "out", boxes=None)
    assert len(scene.sweeps) == 4
    assert any("without a pose or time stamp were left out: 3" in note for note in scene.source.notes)


def test_time_stamps_of_recorded_scans_only_and_empty_lines(source: Path, pristine: Path, tmp_path: Path) -> None:
    """A drive whose first scans are missing has a line per scan; an empty line is a frame without a time."""
    whole = ingest(pristine, tmp_path / "whole", frames=(3, 6))
    folder = source / SCANS
    for number in (1, 2):
        (folder / "data" / f"{number:010d}.bin").unlink()
    lines = (folder / "timestamps.txt").read_text().splitlines()
    (folder / "timestamps.txt").write_text("\n".join(lines[3:6]) + "\n")
    part = ingest(source, tmp_path / "part", frames=(3, 6))
    for a, b in zip(whole.sweeps, part.sweeps, strict=True):
        assert a.time_s == b.time_s
        assert np.abs(a.world_from_lidar - b.world_from_lidar).max() < 1e-9
    (folder / "timestamps.txt").write_text("\n".join([*lines[:4], "", *lines[5:]]) + "\n")
    holed = ingest(source, tmp_path / "holed", frames=(3, 6))
    assert [sweep.time_s for sweep in holed.sweeps] == pytest.approx([0.0, 0.2])


def test_scans_are_untwisted_clockwise(truth: Scene, source: Path, tmp_path: Path) -> None:
    """Posts measured by a sensor that turns from left to right stand where they are."""
    first = truth.ego.pose_at(0.0)
    mount = invert(first) @ truth.sweeps[0].world_from_lidar
    rng = np.random.default_rng(4)
    turn, reach = rng.uniform(-np.pi, np.pi, 300), rng.uniform(8, 25, 300)
    posts = np.c_[reach * np.cos(turn), reach * np.sin(turn), rng.uniform(-1, 3, 300)]
    posts = transform_points(truth.sweeps[2].world_from_lidar, posts)

    def velo(time_s: float) -> np.ndarray:
        pose = truth.ego.pose_at(float(np.clip(time_s, -0.05, 0.45)))
        return pose @ mount

    time_s = truth.sweeps[2].time_s
    points = transform_points(invert(velo(time_s)), posts)
    for _ in range(8):
        late = -np.arctan2(points[:, 1], points[:, 0]) / (2 * np.pi) * 0.1
        timed = zip(late, posts, strict=True)
        points = np.stack([transform_points(invert(velo(time_s + dt)), p[None])[0] for dt, p in timed])
    path = source / SCANS / "data" / f"{made.FIRST + 2:010d}.bin"
    np.c_[points, np.full(300, 0.5)].astype("<f4").tofile(path)
    errors = {}
    for choice in ("auto", "no"):
        scene = ingest(source, tmp_path / choice, untwist=choice)
        sweep = scene.sweeps[2]
        world_from_truth = sweep.world_from_lidar @ invert(truth.sweeps[2].world_from_lidar)
        got = read_points(scene, sweep)
        found = transform_points(sweep.world_from_lidar, got.xyz.astype(np.float64))
        errors[choice] = np.linalg.norm(found - transform_points(world_from_truth, posts), axis=1)
        if choice == "auto":
            ahead = np.abs(late) < 0.045
            assert np.abs(got.dt_s - late)[ahead].max() < 1e-3
    assert errors["auto"].max() < 0.02
    assert errors["no"].max() > 0.2


def test_semantics_are_taken_where_there_are_some(source: Path, tmp_path: Path) -> None:
    folder = source / "data_2d_semantics" / "train" / made.DRIVE / "image_00"
    ids = np.zeros((64, 96), np.uint8)
    ids[:10], ids[10:20], ids[20:30], ids[30:40], ids[40:] = 23, 26, 34, 9, 7
    sure = np.linspace(0, 65535, 96 * 64).reshape(64, 96).astype(np.uint16)
    for kind in ("semantic", "confidence"):
        (folder / kind).mkdir(parents=True)
    Image.fromarray(ids).save(folder / "semantic" / f"{made.FIRST:010d}.png")
    Image.fromarray(sure).save(folder / "confidence" / f"{made.FIRST:010d}.png")
    scene = ingest(source, tmp_path / "out")
    frame = scene.frames_of("front")[0]
    assert np.unique(read_label(scene, frame, "semantics")[[0, 10, 20, 30, 40]]).tolist() == [0, 2, 10, 13, 255]
    assert np.abs(read_label(scene, frame, "semantics_confidence") - sure / 65535).max() < 1e-6
    assert not scene.frames_of("front")[1].labels
    assert not scene.frames_of("front_stereo")[0].labels
    Image.fromarray(ids + 30).save(folder / "semantic" / f"{made.FIRST:010d}.png")
    refused("ids that do not exist", ingest, source, tmp_path / "bad")


# --- boxes ----------------------------------------------------------------------------------------


def boxes_of(tmp_path: Path, *objects: str) -> tuple[list, dict[str, int]]:
    path = tmp_path / "boxes.xml"
    path.write_text('<?xml version="1.0"?>\n<opencv_storage>' + "".join(objects) + "</opencv_storage>")
    left_out: Counter[str] = Counter()
    return list(read_boxes(path, left_out)), left_out


@pytest.mark.parametrize(
    "axes", [np.eye(3), np.eye(3)[:, [1, 0, 2]], np.eye(3)[:, [2, 0, 1]], np.diag([1.0, -1, 1]), np.diag([1.0, 1, -1])]
)
def test_the_same_box_by_any_axes(tmp_path: Path, axes: np.ndarray) -> None:
    """Sizes along other axes, mirrored and left-handed transforms are the same box: long, narrow, upright."""
    pose, size = yaw_matrix(0.4, (3.0, 4.0, 1.0)), np.array([4.5, 1.8, 1.5])
    turned = pose.copy()
    turned[:3, :3] = pose[:3, :3] @ axes
    ((box, _),), _ = boxes_of(tmp_path, made.box_xml(1, turned, np.abs(axes.T @ size)))
    assert box.size_m == pytest.approx((4.5, 1.8, 1.5))
    expected = made.SOURCE_FROM_WORLD @ pose
    assert np.abs(box.pose[:3, 3] - expected[:3, 3]).max() < 1e-6
    assert abs(box.pose[:3, 0] @ expected[:3, 0]) == pytest.approx(1)
    assert np.linalg.det(box.pose[:3, :3]) == pytest.approx(1)
    assert box.pose[2, 2] == pytest.approx(1)


def test_classes_labels_and_shear(tmp_path: Path) -> None:
    pose, size = yaw_matrix(0.1, (3.0, 4.0, 1.0)), np.array([4.5, 1.8, 1.5])
    sheared = pose.copy()
    sheared[0, 1] += 0.5
    named = re.sub(r"<semanticId>.*?</instanceId>", "", made.box_xml(7, pose, size))
    named = named.replace(">car<", ">unknownVehicle<")
    classes = [made.box_xml(n, pose, size, semantic=number) for n, number in enumerate((19, 11, 77), 1)]
    found, left_out = boxes_of(tmp_path, *classes, made.box_xml(4, sheared, size), named)
    assert [box.label for box, _ in found] == ["person", "unknown vehicle"]
    assert left_out == {"of classes that do not move": 2, "that are not cuboids": 1}


def test_standing_boxes_hold_in_their_window_and_one_drawn_twice_in_a_frame_is_taken_once(
    pristine: Path, tmp_path: Path
) -> None:
    pose, size = yaw_matrix(0.1, (3.0, 4.0, 1.0)), np.array([4.5, 1.8, 1.5])
    text = made.box_xml(1, pose, size, window=(2, 4)) + made.box_xml(2, pose, size, instance=2, window=(70, 90))
    path = tmp_path / "some.xml"
    path.write_text(f"<opencv_storage>{text}</opencv_storage>")
    scene = ingest(pristine, tmp_path / "out", boxes=path)
    (track,) = scene.tracks
    assert track.times_s == pytest.approx([0.1, 0.3])
    assert (track.world_from_object[0] == track.world_from_object[1]).all()
    assert any("1 boxes lie outside" in note for note in scene.source.notes)
    text = "".join(made.box_xml(n, pose, size, timestamp=frame) for n, frame in enumerate((1, 2, 2, 3)))
    path.write_text(f"<opencv_storage>{text}</opencv_storage>")
    scene = ingest(pristine, tmp_path / "moving", boxes=path)
    assert scene.tracks[0].times_s == pytest.approx([0.0, 0.1, 0.2])
    assert any("1 boxes that an object has twice" in note for note in scene.source.notes)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda s: s.replace("<opencv_storage>", '<!DOCTYPE x [<!ENTITY a "b">]><opencv_storage>'), "entities"),
        (lambda s: s.replace('version="1.0"', 'version="1.0" encoding="cp037"'), "encoding"),
        (lambda s: s[: len(s) // 2], "cut off"),
        (lambda s: s.replace("<rows>4</rows>", "<rows>999999999</rows>"), "wrong number of values"),
        (lambda s: s.replace("<timestamp>-1</timestamp>", "<timestamp>soon</timestamp>"), "'timestamp'"),
        (lambda s: re.sub(r"(<transform.*?<data>\s*)\S+", r"\1nan", s, flags=re.S), "not finite"),
        (lambda s: re.sub(r"(<transform.*?<data>\s*)\S+", r"\1car", s, flags=re.S), "not a number"),
    ],
)
def test_spoilt_box_files(source: Path, tmp_path: Path, change: Callable[[str], str], words: str) -> None:
    path = source / "data_3d_bboxes" / "train" / f"{made.DRIVE}.xml"
    path.write_text(change(path.read_text()))
    refused(words, ingest, source, tmp_path / "out")
    assert not (tmp_path / "out").exists()


# --- refusals -------------------------------------------------------------------------------------


def spoil_text(name: str, pattern: str, instead: str) -> Callable[[Path], None]:
    def spoil(source: Path) -> None:
        path = source / name
        text = path.read_text()
        changed = re.sub(pattern, instead, text, count=1, flags=re.S)
        assert changed != text
        path.write_text(changed)

    return spoil


def cut(name: str, size: int) -> Callable[[Path], None]:
    return lambda source: (source / name).write_bytes((source / name).read_bytes()[:size])


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (lambda s: (s / IMAGE).unlink(), "image_01 lacks 3"),
        (lambda s: (s / SCAN).unlink(), "velodyne lacks 2"),
        (cut(SCAN, 1001), "scan is cut off"),
        (lambda s: shutil.rmtree(s / "data_poses"), "no vehicle poses"),
        (cut(POSES, 700), "wrong number of values|not a rigid|no pose|without"),
        (spoil_text(POSES, r"\n2 ", "\n9 "), "growing frame numbers"),
        (lambda s: (s / STAMPS).write_text(made.stamp(0.0) + "\n"), "do not cover"),
        (spoil_text(STAMPS, r":17\.550", ":17.350"), "do not increase"),
        (spoil_text("calibration/calib_cam_to_pose.txt", r"image_00: \S+", "image_00:"), "wrong number of values"),
        (spoil_text("calibration/calib_cam_to_velo.txt", r"^\S+ ", ""), "wrong number of values"),
        (spoil_text("calibration/perspective.txt", r"S_rect_00: 96", "S_rect_00: 1408"), "not have the size"),
        (spoil_text("calibration/perspective.txt", r"P_rect_00", "P_rest_00"), "lacks P_rect_00"),
        (lambda s: shutil.rmtree(s / "calibration"), "file not found"),
    ],
)
def test_spoilt_logs_are_refused_in_words(
    source: Path, tmp_path: Path, spoil: Callable[[Path], object], words: str
) -> None:
    spoil(source)
    roundtrip.assert_refused(ingest, source, tmp_path / "out", words)


def test_times_out_of_order_are_refused_outside_of_the_imported_frames_too(source: Path, tmp_path: Path) -> None:
    spoil_text(STAMPS, r":17\.550", ":17.350")(source)
    refused("do not increase", ingest, source, tmp_path / "out", frames=(1, 2))


def test_missing_frames_can_be_skipped_and_choices_are_checked(source: Path, tmp_path: Path) -> None:
    (source / IMAGE).unlink()
    (source / SCAN).write_bytes(b"")
    scene = ingest(source, tmp_path / "out", skip_missing=True, untwist="auto")
    assert [len(read_points(scene, sweep).xyz) > 0 for sweep in scene.sweeps] == [True, False, True, True]
    caught = refused("no such camera", ingest, source, tmp_path / "no", cameras=("side_left",), raises=UsageError)
    assert "front (image_00)" in caught.expected
    refused("no such drive", ingest, source, tmp_path / "no", sequence="0007", raises=UsageError)
    (source / "data_2d_raw" / "2013_05_28_drive_0004_sync").mkdir()
    refused("several drives", ingest, source, tmp_path / "no", raises=UsageError)
    assert len(ingest(source, tmp_path / "yes", sequence="0003", frames=(1, 3)).sweeps) == 2
    refused("no frames to import", ingest, source, tmp_path / "no", sequence="0003", frames=(50, 60))
