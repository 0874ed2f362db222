"""Waymo importer: round trips of both formats, the real frame, its parts against slow twins, damaged logs."""

from __future__ import annotations

import copy
import struct
import sys
import zlib
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import bad_logs
import numpy as np
import pytest
import roundtrip
import write_waymo as made
from hypothesis import given
from hypothesis import strategies as st
from refusals import refused
from write_waymo import write

from mudg.base import geometry
from mudg.base.errors import InputError, ResourceError, UsageError
from mudg.base.geometry import invert, transform_points, yaw_matrix
from mudg.base.types import Scene, Track
from mudg.city import sensors as rig
from mudg.formats.importers import waymo
from mudg.formats.importers import waymo_logs as logs
from mudg.formats.importers.waymo_logs import (
    CameraShot,
    LaserCalibration,
    LaserScan,
    Message,
    ParquetTable,
    TfrecordLog,
)
from mudg.scene.labels import read_label
from mudg.scene.read import read_points, read_scene

pytestmark = roundtrip.needs_native


ingest = bad_logs.importer("waymo")
COLUMNS = 240
City = tuple[Scene, tuple[Track, ...]]


@pytest.fixture(scope="module")
def city(tmp_path_factory: pytest.TempPathFactory) -> City:
    """A tiny city whose boxes stand upright in the vehicle, as the data set's do, and its tracks at all times."""
    folder = tmp_path_factory.mktemp("city")
    truth, tracks = roundtrip.small_log(folder), []
    for track in truth.tracks:
        poses = track.world_from_object.copy()
        for index, time in enumerate(track.times_s):
            vehicle = truth.ego.pose_at(float(time))
            local = invert(vehicle) @ poses[index]
            poses[index, :3, :3] = (vehicle @ yaw_matrix(geometry.yaw_of(local)))[:3, :3]
        tracks.append(replace(track, world_from_object=poses))
    return replace(truth, tracks=tuple(tracks)), read_scene(folder).tracks


@pytest.fixture(scope="module")
def pristine(city: City) -> made.Log:
    return made.log_of(*city, beams=rig.lidar_elevations(roundtrip.SMALL), columns=COLUMNS)


@pytest.fixture
def drive(pristine: made.Log) -> made.Log:
    """The city as a Waymo log that the test may change."""
    return copy.deepcopy(pristine)


def test_round_trip(city: City, drive: made.Log, tmp_path: Path) -> None:
    truth, own = city
    scene = ingest(write(drive, "v1", tmp_path / "log"), tmp_path / "scene")
    roundtrip.assert_same_log(scene, truth, labels=made.LABELS, cloud_m=2e-4, dt_s=1e-6, box_pose=0.03, intensity=1e-4)
    assert scene.ego.world_from_ego[0] == pytest.approx(np.eye(4), abs=1e-12)
    assert scene.frames[0].view.camera.readout_s == pytest.approx(made.READOUT_S, abs=1e-6)
    assert scene.frames[0].view.camera.shutter == "left_to_right"
    assert {scene.split[f"front/00000{n}"] for n in (0, 1, 2, 3)} == {"train"}
    assert scene.split["front_left/000004"] == "test"
    assert scene.frames[0].view.time_s == pytest.approx(0.05, abs=1e-6)  # the clock begins with the LiDAR's turn
    at_first = truth.ego.pose_at(truth.sweeps[0].time_s)
    standing = {track.id for track in own if np.ptp(track.world_from_object, axis=0).max() < 1e-9}
    assert standing & {track.id for track in truth.tracks}
    uncarried_m = 0.0
    for track in truth.tracks:
        if track.id in standing:
            found = scene.track(track.id).world_from_object
            assert np.abs(found - invert(at_first) @ track.world_from_object).max() < 1e-6
        for frame, pose in zip(drive.frames, track.world_from_object, strict=True):
            (box,) = (box for box in frame["boxes"] if box["id"] == track.id)
            shown = transform_points(invert(made.GLOBAL_FROM_WORLD) @ frame["pose"], box["centre"][None])[0]
            uncarried_m = max(uncarried_m, float(np.linalg.norm(shown - pose[:3, 3])))
    assert uncarried_m > 0.2  # what boxes would be off without their times


def test_both_formats_and_any_number_of_workers_give_the_same_scene(drive: made.Log, tmp_path: Path) -> None:
    one = ingest(write(drive, "v1", tmp_path / "one"), tmp_path / "a", workers=3)
    two = ingest(write(drive, "v2", tmp_path / "two"), tmp_path / "b", workers=1)
    for name in ("tracks.json", "lidar/lidar_top/000002.safetensors", "images/front_left/000003.png"):
        assert (Path(one.root) / name).read_bytes() == (Path(two.root) / name).read_bytes()
    for a, b in zip(one.frames, two.frames, strict=True):
        assert a.view.time_s == b.view.time_s
        assert np.array_equal(a.view.world_from_cam, b.view.world_from_cam)


def test_chosen_frames_and_cameras_far_from_the_origin(city: City, tmp_path: Path) -> None:
    far, truth = yaw_matrix(2.0, (-25211.25, 42391.08, -160.6)), city[0]
    log = made.log_of(*city, beams=rig.lidar_elevations(roundtrip.SMALL), columns=COLUMNS, global_from_world=far)
    for form in ("v1", "v2"):
        source = write(log, form, tmp_path / form)
        scene = ingest(source, tmp_path / f"{form} scene", frames=(1, 4), cameras=("front_left",))
        assert [frame.id for frame in scene.frames] == [f"front_left/{n:06d}" for n in range(3)]
        shift = scene.frames[0].view.world_from_cam @ invert(truth.frames_of("front_left")[1].view.world_from_cam)
        for index, sweep in enumerate(scene.sweeps):
            original = truth.sweeps[index + 1]
            assert np.abs(sweep.world_from_lidar - shift @ original.world_from_lidar).max() < 1e-6
            assert len(read_points(scene, sweep).xyz) == len(read_points(truth, original).xyz)
        assert any("origin is (-25" in note for note in scene.source.notes)
        refused("no such camera", ingest, source, tmp_path / "c", cameras=("rear",), raises=UsageError)


def test_lenses_are_undone_and_other_lidars_read(drive: made.Log, tmp_path: Path) -> None:
    lens = [60.0, 60.0, 47.0, 33.0, 0.05, -0.3, 0.002, -0.001, 0.0]
    drive.cameras[0]["intrinsic"] = lens
    image = np.full((4, 30, 4), -1, np.float32)
    image[1, 7, :2] = 12.0, 0.5
    for frame in drive.frames:
        frame["lasers"].append({"number": 3, "returns": [image], "poses": None})
    side = {"number": 3, "inclinations": (), "min": -1.0, "max": 0.2}
    drive.lasers.append(side | {"extrinsic": yaw_matrix(1.5, (3.2, 1.0, 0.9))})
    scene = ingest(write(drive, "v1", tmp_path / "log"), tmp_path / "scene", frames=(0, 2))
    assert scene.cameras["front"].distortion == tuple(lens[4:]) and scene.cameras["front"].fx > 60.0
    assert any("front" in note and "rectified" in note for note in scene.source.notes)
    assert len(scene.sweeps) == 4
    points = read_points(scene, next(sweep for sweep in scene.sweeps if sweep.sensor == "lidar_side_left"))
    azimuth, pitch = np.pi * (1 - 15 / 30) - 1.5, 0.2 - 1.5 / 4 * 1.2
    local = 12 * np.array([np.cos(azimuth) * np.cos(pitch), np.sin(azimuth) * np.cos(pitch), np.sin(pitch)])
    assert np.abs(points.xyz - local).max() < 1e-5
    assert (points.dt_s == 0).all()
    assert points.intensity[0] == pytest.approx(np.tanh(0.5), abs=1e-6)


@pytest.mark.parametrize("form", ["v1", "v2"])
def test_panoptic_labels(form: str, drive: made.Log, tmp_path: Path) -> None:
    width, height = drive.cameras[0]["width"], drive.cameras[0]["height"]
    ids = np.zeros((height, width), int)
    ids[:10] = 25 * made.DIVISOR
    ids[10:20] = 10 * made.DIVISOR + 4
    ids[20:30, ::2] = 1 * made.DIVISOR
    ids[30:] = 22 * made.DIVISOR
    drive.frames[1]["images"][0]["panoptic"] = made.panoptic_png(ids)
    scene = ingest(write(drive, form, tmp_path / "log"), tmp_path / "scene", workers=2)
    labelled = [frame.id for frame in scene.frames if frame.labels]
    assert labelled == ["front/000001"]
    frame = scene.frames_of("front")[1]
    semantics = read_label(scene, frame, "semantics")
    assert [int(semantics[row, 0]) for row in (0, 10, 20, 40)] == [10, 12, 255, 0]
    assert (read_label(scene, frame, "sky") == (ids == 25000)).all()
    assert (read_label(scene, frame, "ego") == (ids == 1000)).all()
    assert (read_label(scene, frame, "instance") == np.where(ids == 10004, 10004, 0)).all()


def test_the_real_frame(shared_data: Callable[[str], Path], tmp_path: Path) -> None:
    path = shared_data("waymo_frame") / "pvps_data_one_frame.tfrecord"
    scene = ingest(path, tmp_path / "scene", resolution=480, cameras=("front", "side_right"))
    assert scene.id == "1024360143612057520_3580_000_3600_000"
    assert [frame.view.camera.name for frame in scene.frames] == ["front", "side_right"]  # as the LiDAR passes them
    assert (scene.cameras["front"].width, scene.cameras["front"].height) == (480, 320)
    counts = Counter(track.label for track in scene.tracks)
    assert counts == {"vehicle": 37, "pedestrian": 12, "sign": 25, "cyclist": 1}
    cars = [track for track in scene.tracks if track.label == "vehicle"]
    assert np.mean([track.size_m[0] > track.size_m[1] for track in cars]) > 0.9  # longer than wide
    assert scene.cameras["front"].readout_s == pytest.approx(0.044, abs=1e-3)
    for frame in scene.frames:
        assert all(track.pose_at(frame.view.time_s) is not None for track in scene.tracks)
        assert frame.view.world_from_cam[2, 1] < -0.99  # the image's down is the world's down
        assert frame.view.center_world[2] == pytest.approx(2.1, abs=0.2)
        semantics = read_label(scene, frame, "semantics")
        assert (semantics == 255).mean() < 0.2
        assert not np.isin(semantics[: len(semantics) // 8], [0, 1]).any()  # no road up there
    headings = {f.view.camera.name: np.rad2deg(np.arctan2(*f.view.world_from_cam[[1, 0], 2])) for f in scene.frames}
    assert abs(headings["front"]) < 3
    assert abs(headings["side_right"] + 90) < 3


def test_boxes_of_the_real_frame_project_onto_the_recorded_rectangles(shared_data: Callable[[str], Path]) -> None:
    path = shared_data("waymo_frame") / "pvps_data_one_frame.tfrecord"
    box = "x 1 double, y 2 double, width 4 double, length 5 double"  # rectangles: the centre, then the sides
    label = Message("Label", "box 1 message, id 4 text", box=Message("Box", box))
    message = Message(
        "Frame", "projected 9 messages", projected=Message("Camera", "name 1 int, labels 2 messages", labels=label)
    )
    (place,) = logs.record_places(path)
    with path.open("rb") as file:
        projected = logs.parse_message(logs.read_payload(file, *place), message, "real")["projected"]
    log = TfrecordLog(path)
    frame = log.frames[0]
    boxes = {box[0]: box[2:] for box in frame.boxes}
    names = {number: name for name, number in made.CAMERA_NUMBERS.items()}
    errors = []
    for camera in projected:
        name = names[camera["name"]]
        calibration = log.cameras[name]
        pose, _ = waymo.middle_of_exposure(frame.shots[name])
        cam_from_vehicle = invert(pose @ calibration.vehicle_from_cam()) @ frame.global_from_vehicle
        fx, fy, cx, cy, *lens = calibration.intrinsic
        for item in camera["labels"]:
            vehicle_from_box, size_m = next(box for key, box in boxes.items() if item["id"].startswith(key))
            corners = np.stack(np.meshgrid(*[[-0.5, 0.5]] * 3), -1).reshape(-1, 3) * size_m
            corners = transform_points(cam_from_vehicle @ vehicle_from_box, corners)
            if (corners[:, 2] < 0.5).any():
                continue
            x, y = corners[:, 0] / corners[:, 2], corners[:, 1] / corners[:, 2]
            r2 = x * x + y * y
            radial = 1 + r2 * (lens[0] + r2 * lens[1])
            u = fx * (x * radial + 2 * lens[2] * x * y + lens[3] * (r2 + 2 * x * x)) + cx
            v = fy * (y * radial + lens[2] * (r2 + 2 * y * y) + 2 * lens[3] * x * y) + cy
            ours = np.array([u.min(), v.min(), u.max(), v.max()])
            if (ours[:2] > 2).all() and (ours[2:] < [calibration.width - 2, calibration.height - 2]).all():
                b = item["box"]
                centre, half = np.array([b["x"], b["y"]]), np.array([b["length"], b["width"]]) / 2
                errors.append(ours - np.r_[centre - half, centre + half])
    assert len(errors) == 44
    assert np.median(np.abs(errors)) < 0.03
    assert np.abs(errors).max() < 0.2


def test_the_real_frame_without_images_is_refused_in_words(shared_data: Callable[[str], Path], tmp_path: Path) -> None:
    refused("no camera", ingest, shared_data("waymo_frame") / "labels_only_one_frame.tfrecord", tmp_path / "scene")


def test_the_real_table_of_poses(shared_data: Callable[[str], Path]) -> None:
    pytest.importorskip("pyarrow")
    table = ParquetTable(shared_data("waymo_frame") / "v2_vehicle_pose.parquet", "vehicle_pose")
    column = "world_from_vehicle.transform"
    found = [row for _, row in table.records(("key.segment_context_name", "key.frame_timestamp_micros"), (column,))]
    assert len(found) == 199
    assert all(geometry.rigid_problem(np.array(row[column]).reshape(4, 4), 1e-6) is None for row in found)
    steps = np.diff(np.array([row["key.frame_timestamp_micros"] for row in found], np.int64))
    assert ((steps > 90_000) & (steps < 110_000)).all()
    for row in (57, 3):  # forwards, and back
        assert np.allclose(table.value(row, column), found[row][column])


# --- parts against slow twins ---------------------------------------------------------------------


@pytest.mark.parametrize(
    "data, crc", [(b"123456789", 0xE3069283), (bytes(32), 0x8A9136AA), (b"\xff" * 32, 0x62A8AB43), (b"", 0)]
)
def test_crc32c_has_the_published_values(data: bytes, crc: int) -> None:
    assert logs.crc32c(data) == crc


@pytest.mark.parametrize("length", [1, 63, 64, 65, 2319, 2320, 2321, 2328, 3571, 45479, 45480, 45488, 80064, 123457])
def test_crc32c_folded_equals_byte_by_byte(length: int) -> None:
    data = np.random.default_rng(length).bytes(length)
    assert logs.crc32c(data) == made.crc32c_bitwise(data)


INNER = Message("Inner", "values 1 doubles, counts 3 ints")
OUTER = Message("Outer", "name 1 text, number 2 int, inner 4 messages", inner=INNER)


def test_messages_keep_wanted_fields_skip_others_and_take_both_forms_of_lists() -> None:
    packed = made.text(1, struct.pack("<2d", 1.5, -2)) + made.text(3, made.varint(7) + made.varint(-7))
    plain = made.doubles(1, [1.5, -2]) + made.number(3, 7) + made.number(3, -7)
    skipped = made.double(9, 1.0) + made.single(10, 1.0) + made.number(11, 300) + made.text(12, b"?")
    data = made.text(1, "Straße".encode()) + skipped + made.number(2, -5) + made.text(4, packed) + made.text(4, plain)
    found = logs.parse_message(data, OUTER, "x")
    assert (found["name"], found["number"], len(found["inner"])) == ("Straße", -5, 2)
    for inner in found["inner"]:
        assert inner["values"].tolist() == [1.5, -2]
        assert inner["counts"].tolist() == [7, -7]


@pytest.mark.parametrize(
    "data, word",
    [
        (b"\x0a\x05ab", "5 bytes where 2 are left"),
        (b"\x0a", "inside a number"),
        (b"\x0a\xff\xff\xff\xff\xff\xff\xff\x7f", "are left"),
        (b"\x80" * 11, "ten bytes"),
        (b"\x0b", "wire type 3"),
        (b"\x00\x00", "field number 0"),
        (b"\x10\x80", "inside a number"),
        (b"\x08\x01", "wire type 0, not 2"),
        (b"\x0a\x01\xff", "no text"),
        (b"\x22\x03\x0a\x01\x00", "no multiple of"),
    ],
)
def test_broken_messages_are_named(data: bytes, word: str) -> None:
    caught = refused("message cannot be decoded", logs.parse_message, data, OUTER, "file: record 3")
    assert word in caught.got
    assert "record 3" in caught.where


@given(st.binary(max_size=200))
def test_no_bytes_raise_anything_but_an_input_error(data: bytes) -> None:
    for message in (logs.FRAME, logs.CONTEXT, logs.MATRIX_FLOAT):
        try:
            logs.parse_message(data, message, "x")
        except InputError:
            continue


def test_points_without_a_pose_are_left_out_and_counted() -> None:
    image = np.ones((2, 8, 4), np.float32)
    poses = np.full((2, 8, 6), 0.1, np.float32)
    poses[1, 3:] = 0
    laser = LaserCalibration((), (-0.2, 0.1), np.eye(4))
    points = waymo.points_of_scan(LaserScan([image, image], poses), laser, np.eye(4), 0.05, "x")
    assert (points.no_returns, len(points.xyz)) == (10, 22)


def test_a_view_is_that_of_the_middle_of_the_exposure() -> None:
    pose = yaw_matrix(0.4, (5.0, 6.0, 1.0))
    velocity = np.array([10.0, -2.0, 0.5, 0, 0, 0.8])
    shot = CameraShot(pose, 100.0, velocity, 0.002, 99.985, 100.027)
    moved, time = waymo.middle_of_exposure(shot)
    late = time - 100.0
    assert late == pytest.approx(0.006, abs=1e-9)
    assert np.abs(moved - yaw_matrix(0.4 + 0.8 * late, pose[:3, 3] + velocity[:3] * late)).max() < 1e-12
    unknown = CameraShot(pose, 100.0, None, 0.002, 99.985, 100.027)
    assert waymo.middle_of_exposure(unknown) == (pose, 100.0)


def test_tracks_cover_the_images_of_their_frames_and_are_split_at_gaps(drive: made.Log, tmp_path: Path) -> None:
    left = drive.frames[2]["boxes"][0]["id"]
    drive.frames[2]["boxes"] = []
    for number, frame in enumerate(drive.frames):  # half a second apart
        late = 0.4 * number
        frame["timestamp_us"] += round(late * 1e6)
        for image in frame["images"]:
            image.update({name: image[name] + late for name in ("pose_time", "trigger", "done")})
    scene = ingest(write(drive, "v1", tmp_path / "log"), tmp_path / "scene")
    assert any("split" in note for note in scene.source.notes)
    pieces = [track for track in scene.tracks if track.id in (left, f"{left}.1")]
    taken = sorted(frame.view.time_s for frame in scene.frames)
    ends = [(track.times_s[0], track.times_s[-1]) for track in pieces]
    assert len(pieces) == 2 and ends[0][0] <= taken[0] and ends[0][1] >= taken[3] and ends[1][1] >= taken[-1]


# --- damaged, contradictory and incomplete logs ---------------------------------------------------


def milliseconds(log: made.Log) -> None:
    for frame in log.frames:
        frame["timestamp_us"] //= 1000


def change(item: dict[str, Any], **values: Callable[[Any], Any]) -> None:
    item.update({name: value(item[name]) for name, value in values.items()})


def infinite(log: made.Log) -> None:
    log.frames[3]["lasers"][0]["returns"][0][0, 0, 0] = np.inf


def each_box(spoil: Callable[[dict[str, Any]], object]) -> Callable[[made.Log], object]:
    return lambda log: [spoil(box) for frame in log.frames for box in frame["boxes"]]


def swap_sides(box: dict[str, Any]) -> None:
    """What a reader makes of boxes if it takes the field of the width for that of the length."""
    length, width, height = box["size"]
    box["size"] = (width, length, height)


def lacks_an_image(log: made.Log) -> None:
    log.frames[2]["images"].pop(1)


MIRROR, DOUBLE = np.diag([1, -1, 1, 1.0]), np.array([[2.0], [2], [2], [1]])
BOTH: dict[str, tuple[Callable[[made.Log], object], str]] = {
    "scale": (lambda log: change(log.cameras[0], extrinsic=lambda pose: pose * DOUBLE), "pose is scaled"),
    "hand": (lambda log: change(log.lasers[0], extrinsic=lambda pose: pose @ MIRROR), "left-handed"),
    "unit": (milliseconds, "not of one time"),
    "image clock": (lambda log: change(log.frames[2]["images"][1], pose_time=lambda t: t * 1e3), "not of one time"),
    "box": (lambda log: log.frames[1]["boxes"][0].update(size=(4.0, -2.0, 1.5)), "size makes no sense"),
    "rows": (lambda log: change(log.lasers[0], inclinations=lambda beams: beams[:-1]), "row for every beam"),
    "numbers": (infinite, "not finite"),
    "camera": (lacks_an_image, "do not pair up"),
    "laser": (lambda log: log.frames[2]["lasers"].pop(0), "do not pair up"),
    "calibration": (lambda log: log.cameras.pop(1), "no calibration"),
    "heading": (lambda log: log.frames[1]["boxes"][0].update(heading=np.nan), "not finite"),
    "two boxes": (lambda log: change(log.frames[1], boxes=lambda boxes: boxes[:1] * 2), "two boxes at one moment"),
    "sides": (each_box(swap_sides), "length and width of boxes are swapped"),
    "long id": (each_box(lambda box: box.update(id="n" * 201)), "name is too long"),
    "laser calibration": (lambda log: log.lasers[0].update(number=9), "no calibration"),
    "pixel poses": (lambda log: change(log.frames[2]["lasers"][0], poses=lambda p: p[:, ::2]), "differ in size"),
    "exposure": (lambda log: log.frames[0]["images"][0].update(shutter=0.5), "exposure times contradict"),
    "intrinsics": (lambda log: log.cameras[0]["intrinsic"].__setitem__(2, np.nan), "intrinsics"),
    "two scans": (lambda log: change(log.frames[1], lasers=lambda lasers: lasers[:1] * 2), "two scans of one LiDAR"),
    "two images": (lambda log: log.frames[1]["images"][1].update(number=1), "two images of one camera"),
}


FIELDS = ("scale", "box", "rows", "camera", "laser", "exposure", "intrinsics", "two scans", "two images", "long id")


@pytest.mark.parametrize("form, case", [*(("v1", case) for case in BOTH), *(("v2", case) for case in FIELDS)])
def test_what_makes_no_sense_is_refused(form: str, case: str, drive: made.Log, tmp_path: Path) -> None:
    spoil, words = BOTH[case]
    spoil(drive)
    log = write(drive, form, tmp_path / "log")
    assert str(tmp_path) in refused(words, ingest, log, tmp_path / "scene").where
    assert list(tmp_path.iterdir()) == [tmp_path / "log"]


def test_frames_out_of_order_are_refused_in_one_file_and_sorted_in_tables(drive: made.Log, tmp_path: Path) -> None:
    drive.frames[1], drive.frames[2] = drive.frames[2], drive.frames[1]
    refused("timestamps do not increase", ingest, write(drive, "v1", tmp_path / "one"), tmp_path / "a")
    scene = ingest(write(drive, "v2", tmp_path / "two"), tmp_path / "b")
    assert [sweep.time_s for sweep in scene.sweeps] == pytest.approx(0.05 + np.arange(5) * 0.1, abs=1e-6)
    drive.frames[3]["timestamp_us"] = drive.frames[2]["timestamp_us"]
    refused("a frame twice", ingest, write(drive, "v2", tmp_path / "three"), tmp_path / "c")


@pytest.mark.parametrize("form", ["v1", "v2"])
def test_empty_scans_unknown_sensors_and_classes_are_taken_as_they_are(
    form: str, drive: made.Log, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for image in drive.frames[1]["lasers"][0]["returns"]:
        image[..., 0] = -1
    drive.frames[0]["boxes"][0]["id"] = "_odd"
    drive.frames[0]["boxes"][0]["type"] = 9
    odd = dict(drive.frames[0]["images"][0], number=7)
    drive.frames[0]["images"].append(odd)
    drive.frames[0]["lasers"].append({"number": 8, "returns": drive.frames[0]["lasers"][0]["returns"], "poses": None})
    scene = ingest(write(drive, form, tmp_path / "log"), tmp_path / "scene")
    assert len(read_points(scene, scene.sweeps[1]).xyz) == 0
    assert "has no points" in capsys.readouterr().err
    assert scene.track("t_odd").label == "type_9"
    assert len(scene.frames) == 10
    assert len(scene.sweeps) == 5


def test_damaged_files_are_named_with_record_and_byte(drive: made.Log, tmp_path: Path) -> None:
    path = write(drive, "v1", tmp_path / "log")
    content = path.read_bytes()
    third = list(logs.record_places(path))[2][1] - 12

    def flipped(at: int) -> bytes:
        return content[:at] + bytes([content[at] ^ 1]) + content[at + 1 :]

    huge = struct.pack("<Q", 1 << 50)
    cases = (
        (content[: third + 500], "cut off"),
        (content[: third + 5], "cut off"),
        (flipped(third + 100), "do not fit their checksum"),
        (flipped(third), "header is damaged"),
        (content[:third] + huge + struct.pack("<I", made.masked(huge)) + content[third + 12 :], "no frame has"),
    )
    for spoilt, word in cases:
        path.write_bytes(spoilt)
        assert f"record 2 at byte {third}" in refused(word, ingest, path, tmp_path / "scene").where
    path.write_bytes(cases[2][0])
    assert len(ingest(path, tmp_path / "scene", frames=(0, 2)).sweeps) == 2  # what is not asked for need not be whole


def test_files_of_another_kind_are_refused(drive: made.Log, tmp_path: Path) -> None:
    path = tmp_path / "a.tfrecord"
    for content, word in (
        (b"<html>not here</html>", "not a TFRecord"),
        (b"\x1f\x8b" + bytes(40), "compressed"),
        (b"", "no frames"),
        (made.record(b"\x0a\x05ab"), "cannot be decoded"),
        (made.record(b""), "transform is incomplete"),
    ):
        path.write_bytes(content)
        refused(word, ingest, path, tmp_path / "scene")
    path.write_bytes(b"".join(made.record(made.frame_message(drive, drive.frames[n])) for n in (0, 1)))
    drive.name = "another"
    path.write_bytes(path.read_bytes() + made.record(made.frame_message(drive, drive.frames[2])))
    refused("mixes two logs", ingest, path, tmp_path / "scene")
    refused("no frames", ingest, path, tmp_path / "scene", frames=(7, 9))


def test_range_images_are_unpacked_within_bounds(monkeypatch: pytest.MonkeyPatch) -> None:
    range_image = logs.range_image
    whole = made.matrix_float(np.ones((2, 3, 4), np.float32))
    assert range_image(whole, 4, "x").shape == (2, 3, 4)
    refused("wrong shape", range_image, whole, 6, "x")
    refused("cut off", range_image, whole[:-6], 4, "x")
    refused("is damaged", range_image, b"nonsense", 4, "x")
    monkeypatch.setattr(logs, "MAX_UNPACKED_BYTES", 1 << 20)
    bomb = zlib.compress(bytes(2 << 20), 1)
    refused("unpacks to too much", range_image, bomb, 4, "x")
    lying = made.text(1, bytes(16)) + made.text(2, b"".join(made.number(1, n) for n in (1 << 20, 1 << 20, 4)))
    refused("wrong shape", range_image, zlib.compress(lying), 4, "x")


def test_tables_that_are_missing_or_damaged(drive: made.Log, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    root = write(drive, "v2", tmp_path / "log")
    table = root / "lidar" / f"{drive.name}.parquet"
    whole = table.read_bytes()
    table.write_bytes(whole[: len(whole) // 2])
    refused("table cannot be read", ingest, root, tmp_path / "scene")
    (root / "lidar_box" / f"{drive.name}.parquet").rename(table)
    refused("lacks columns", ingest, root, tmp_path / "scene")
    table.write_bytes(whole)
    pose = root / "lidar_pose" / f"{drive.name}.parquet"
    pose.rename(root / "away")
    refused("a component of the log is missing", ingest, root, tmp_path / "scene")
    (root / "away").rename(pose)
    (root / "camera_calibration" / f"{drive.name}.parquet").unlink()
    refused("a component of the log is missing", ingest, root, tmp_path / "scene")
    pyarrow = pytest.importorskip("pyarrow")
    holes = pyarrow.table({"key.camera_name": [1, None, 3]})
    pytest.importorskip("pyarrow.parquet").write_table(holes, tmp_path / "holes.parquet")
    table = ParquetTable(tmp_path / "holes.parquet", "lidar")
    assert refused("empty value", lambda: list(table.records(("key.camera_name",), ()))).where.endswith("row 1")
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    assert "mudg[data]" in refused("pyarrow", ParquetTable, pose, "lidar_pose", raises=ResourceError).remedy
