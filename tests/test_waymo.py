"""Waymo importer: round trips of both formats, and the real frame."""

from __future__ import annotations

import io
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import roundtrip
import waymo_logs
import write_waymo as made
from PIL import Image
from refusals import refused
from waymo_logs import COLUMNS, ingest, write

from mudg.base import geometry
from mudg.base.errors import UsageError
from mudg.base.geometry import invert, transform_points, yaw_matrix
from mudg.base.types import Scene, Track
from mudg.city import sensors as rig
from mudg.formats.importers.waymo import importer as sensors
from mudg.formats.importers.waymo import logs as tfrecord
from mudg.formats.importers.waymo import records
from mudg.formats.importers.waymo import records as messages
from mudg.formats.importers.waymo.logs import ParquetTable, TfrecordLog
from mudg.formats.importers.waymo.records import WaymoBox
from mudg.scene.labels import read_label
from mudg.scene.read import read_image, read_points

pytestmark = roundtrip.needs_native


@pytest.fixture
def city(tmp_path_factory: pytest.TempPathFactory) -> tuple[Scene, tuple[Track, ...]]:
    return waymo_logs.city(tmp_path_factory)


@pytest.fixture
def log(tmp_path_factory: pytest.TempPathFactory) -> made.Log:
    return waymo_logs.whole(tmp_path_factory)


@pytest.fixture
def bare(tmp_path_factory: pytest.TempPathFactory) -> made.Log:
    return waymo_logs.bare(tmp_path_factory)


@pytest.mark.parametrize("form, workers", [("v1", 1), ("v2", 2)])
def test_round_trip(
    form: str, workers: int, city: tuple[Scene, tuple[Track, ...]], log: made.Log, tmp_path: Path
) -> None:
    truth, own = city
    scene = ingest(write(log, form, tmp_path / "log"), tmp_path / "scene", workers=workers)
    roundtrip.assert_same_log(scene, truth, labels=made.LABELS, cloud_m=2e-4, dt_s=1e-6, box_pose=0.03, intensity=1e-4)
    assert scene.ego.world_from_ego[0] == pytest.approx(np.eye(4), abs=1e-12)
    assert scene.frames[0].view.camera.readout_s == pytest.approx(made.READOUT_S, abs=1e-6)
    assert scene.frames[0].view.camera.shutter == "left_to_right"
    assert any("points fall where the log says" in note and "front 0." in note for note in scene.source.notes)
    assert any(form in note and "Day, sunny, location_sf" in note for note in scene.source.notes)
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
        for frame, pose in zip(log.frames, track.world_from_object, strict=True):
            (box,) = (box for box in frame["boxes"] if box["id"] == track.id)
            shown = transform_points(invert(made.GLOBAL_FROM_WORLD) @ frame["pose"], box["centre"][None])[0]
            uncarried_m = max(uncarried_m, float(np.linalg.norm(shown - pose[:3, 3])))
    assert uncarried_m > 0.2  # what boxes would be off without their times


@pytest.mark.parametrize("hold, words", [("start", "at the timestamp"), ("pose", "at the frame's pose")])
def test_the_moment_of_the_boxes_is_found(
    hold: str, words: str, city: tuple[Scene, tuple[Track, ...]], tmp_path: Path
) -> None:
    log = made.log_of(*city, beams=rig.lidar_elevations(roundtrip.SMALL), columns=COLUMNS, boxes_hold=hold)
    for frame in log.frames:
        frame["lasers"][0]["projections"] = None
    scene = ingest(write(log, "v1", tmp_path / "log"), tmp_path / "scene")
    assert any(note.startswith(f"boxes hold {words} (") for note in scene.source.notes)
    roundtrip.assert_same_log(scene, city[0], labels=made.LABELS, box_pose=0.04, cloud_m=2e-4)


def test_points_count_for_the_moment_that_puts_them_inside() -> None:
    box = WaymoBox("a", "vehicle", (10.0, 4.0, 1.0), (4.0, 2.0, 1.5), 0.3)
    forward = yaw_matrix(0.3)[:3, 0]
    along, across = np.meshgrid(np.linspace(-1.99, 1.99, 20), np.linspace(-0.99, 0.99, 9))
    grid = np.stack([along.ravel(), across.ravel(), np.full(along.size, 0.1)], 1)
    on_box = transform_points(yaw_matrix(0.3, box.centre), grid)
    seen = np.linspace(0.03, 0.04, len(grid))
    for index, held in enumerate((0.035, 0.0, 0.05)):
        points = on_box + (seen - held)[:, None] * 20.0 * forward
        counts = records.points_inside(box, 20.0 * forward, points, seen, 0.035, 0.05)
        assert counts[index] == len(grid)
        assert counts.argmax() == index
        assert np.delete(counts, index).max() < 0.95 * len(grid)
        assert records.choose_moment(counts) == records.MOMENTS[index]
    low = on_box - [0, 0, 0.75]
    assert records.points_inside(box, np.zeros(3), low, seen, 0.0, 0.0).tolist() == [0, 0, 0]  # the road
    assert records.choose_moment(np.array([100, 104, 90])) == "seen"


def test_both_formats_and_any_number_of_workers_give_the_same_scene(bare: made.Log, tmp_path: Path) -> None:
    one = ingest(write(bare, "v1", tmp_path / "one"), tmp_path / "a", workers=3)
    two = ingest(write(bare, "v2", tmp_path / "two"), tmp_path / "b", workers=1)
    for name in ("tracks.json", "lidar/lidar_top/000002.safetensors", "images/front_left/000003.png"):
        assert (Path(one.root) / name).read_bytes() == (Path(two.root) / name).read_bytes()
    for a, b in zip(one.frames, two.frames, strict=True):
        assert a.view.time_s == b.view.time_s
        assert np.array_equal(a.view.world_from_cam, b.view.world_from_cam)


@pytest.mark.parametrize("form", ["v1", "v2"])
def test_chosen_frames_and_cameras_far_from_the_origin(
    form: str, city: tuple[Scene, tuple[Track, ...]], tmp_path: Path
) -> None:
    far = yaw_matrix(2.0, (-25211.25, 42391.08, -160.6))
    log = made.log_of(*city, beams=rig.lidar_elevations(roundtrip.SMALL), columns=COLUMNS, global_from_world=far)
    source, truth = write(log, form, tmp_path / "log"), city[0]
    scene = ingest(source, tmp_path / "scene", frames=(1, 4), cameras=("front_left",))
    assert [frame.id for frame in scene.frames] == [f"front_left/{n:06d}" for n in range(3)]
    shift = scene.frames[0].view.world_from_cam @ invert(truth.frames_of("front_left")[1].view.world_from_cam)
    for index, sweep in enumerate(scene.sweeps):
        original = truth.sweeps[index + 1]
        assert np.abs(sweep.world_from_lidar - shift @ original.world_from_lidar).max() < 1e-6
        assert len(read_points(scene, sweep).xyz) == len(read_points(truth, original).xyz)
    assert any(f"({far[0, 3]:.0f}" in note.replace(".", "")[:60] or "-25" in note for note in scene.source.notes)
    with pytest.raises(UsageError, match="no such camera"):
        ingest(source, tmp_path / "c", cameras=("rear",))


def test_images_are_rectified_and_other_lidars_read(bare: made.Log, tmp_path: Path) -> None:
    lens = [60.0, 60.0, 47.0, 33.0, 0.05, -0.3, 0.002, -0.001, 0.0]
    width, height = bare.cameras[0]["width"], bare.cameras[0]["height"]
    bare.cameras[0]["intrinsic"] = lens
    point = np.array([0.25, -0.2, 1.0])  # in the camera, z forward
    x, y = point[:2]
    r2 = x * x + y * y
    radial = 1 + r2 * (lens[4] + r2 * lens[5])
    u = lens[0] * (x * radial + 2 * lens[6] * x * y + lens[7] * (r2 + 2 * x * x)) + lens[2]
    v = lens[1] * (y * radial + lens[6] * (r2 + 2 * y * y) + 2 * lens[7] * x * y) + lens[3]
    rows, columns = np.mgrid[:height, :width] + 0.5
    blob = 255 * np.exp(-((rows - v) ** 2 + (columns - u) ** 2) / 8)
    buffer = io.BytesIO()
    Image.fromarray(np.repeat(blob.round().astype(np.uint8)[..., None], 3, 2)).save(buffer, "PNG")
    image = np.full((4, 30, 4), -1, np.float32)
    image[1, 7, :2] = 12.0, 0.5
    for frame in bare.frames:
        frame["images"][0]["image"] = buffer.getvalue()
        frame["lasers"].append({"number": 3, "returns": [image], "poses": None})
    side = {"number": 3, "inclinations": (), "min": -1.0, "max": 0.2}
    bare.lasers.append(side | {"extrinsic": yaw_matrix(1.5, (3.2, 1.0, 0.9))})
    scene = ingest(write(bare, "v1", tmp_path / "log"), tmp_path / "scene")
    camera = scene.cameras["front"]
    assert camera.distortion == tuple(lens[4:])
    pixels = read_image(scene, scene.frames_of("front")[0])[..., 0].astype(float)
    centre = np.array([(pixels * columns).sum(), (pixels * rows).sum()]) / pixels.sum()
    expected = np.array([camera.fx * x + camera.cx, camera.fy * y + camera.cy])
    assert np.abs(centre - expected).max() < 0.1
    assert np.abs(expected - [u, v]).max() > 0.5  # the lens does move it
    sweep = next(sweep for sweep in scene.sweeps if sweep.sensor == "lidar_side_left")
    points = read_points(scene, sweep)
    azimuth, pitch = np.pi * (1 - 15 / 30) - 1.5, 0.2 - 1.5 / 4 * 1.2
    local = 12 * np.array([np.cos(azimuth) * np.cos(pitch), np.sin(azimuth) * np.cos(pitch), np.sin(pitch)])
    assert np.abs(points.xyz - local).max() < 1e-5
    assert (points.dt_s == 0).all()
    assert points.intensity[0] == pytest.approx(np.tanh(0.5), abs=1e-6)
    assert len(scene.sweeps) == 10


@pytest.mark.parametrize("form", ["v1", "v2"])
def test_panoptic_labels(form: str, bare: made.Log, tmp_path: Path) -> None:
    width, height = bare.cameras[0]["width"], bare.cameras[0]["height"]
    ids = np.zeros((height, width), int)
    ids[:10] = 25 * made.DIVISOR
    ids[10:20] = 10 * made.DIVISOR + 4
    ids[20:30, ::2] = 1 * made.DIVISOR
    ids[30:] = 22 * made.DIVISOR
    bare.frames[1]["images"][0]["panoptic"] = made.panoptic_png(ids)
    scene = ingest(write(bare, form, tmp_path / "log"), tmp_path / "scene", workers=2)
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
    label = messages.Message("Label", {**messages.FRAME.fields[6].message.fields})
    fields = {1: messages.Field("name", "int"), 2: messages.Field("labels", "messages", label)}
    per_camera = messages.Message("CameraLabels", fields)
    message = messages.Message("Frame", {9: messages.Field("projected", "messages", per_camera)})
    (place,) = tfrecord.record_places(path)
    with path.open("rb") as file:
        projected = messages.parse_message(tfrecord.read_record(file, path, place), message, "real")["projected"]
    log = TfrecordLog(path)
    frame = log.frames[0]
    boxes = {box.id: box for box in frame.boxes}
    names = {number: name for name, number in made.CAMERA_NUMBERS.items()}
    errors = []
    for camera in projected:
        name = names[camera["name"]]
        calibration = log.cameras[name]
        pose, _ = sensors.middle_of_exposure(frame.shots[name])
        cam_from_vehicle = invert(pose @ sensors.vehicle_from_cam(calibration)) @ frame.global_from_vehicle
        fx, fy, cx, cy, *lens = calibration.intrinsic
        for item in camera["labels"]:
            box = next(box for key, box in boxes.items() if item["id"].startswith(key))
            corners = np.stack(np.meshgrid(*[[-0.5, 0.5]] * 3), -1).reshape(-1, 3) * box.size_m
            corners = transform_points(cam_from_vehicle @ yaw_matrix(box.heading, box.centre), corners)
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
    refused("no images", ingest, shared_data("waymo_frame") / "labels_only_one_frame.tfrecord", tmp_path / "scene")


def test_the_real_table_of_poses(shared_data: Callable[[str], Path]) -> None:
    pytest.importorskip("pyarrow")
    table = ParquetTable(shared_data("waymo_frame") / "v2_vehicle_pose.parquet")
    column = "[VehiclePoseComponent].world_from_vehicle.transform"
    found = table.columns(("key.segment_context_name", "key.frame_timestamp_micros", column))
    assert len(found[column]) == 199
    assert all(geometry.rigid_problem(np.array(values).reshape(4, 4), 1e-6) is None for values in found[column])
    steps = np.diff(np.array(found["key.frame_timestamp_micros"], np.int64))
    assert ((steps > 90_000) & (steps < 110_000)).all()
    assert np.allclose(table.value(57, column), found[column][57])
    assert np.allclose(table.value(3, column), found[column][3])
