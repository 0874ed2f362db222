"""Logs as messages of ROS 2: read by other readers, and put back together."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from mcap.reader import make_reader
from rosbags.rosbag2 import Reader
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from test_edit import toy
from toy_scene import ToyStreet

from mudg import app
from mudg.base import geometry
from mudg.base.errors import InputError, MudgError, ResourceError
from mudg.base.types import PointCloud, Scene
from mudg.exporting.settings import ExportConfig
from mudg.formats.exporters import messages as ros2
from mudg.formats.exporters.messages import LogRecords, write_mcap
from mudg.gaussians.storage import save_model
from mudg.scene.read import open_files, read_points
from mudg.steps.export import Export


def read_bag(folder: Path) -> tuple[dict[str, list[tuple[int, Any]]], dict[str, Any]]:
    """Topic -> times and values of its messages, by the definitions in the file; and what metadata.yaml says."""
    messages: dict[str, list[tuple[int, Any]]] = {}
    with Reader(folder) as reader:
        types = get_typestore(Stores.EMPTY)
        for connection in reader.connections:
            types.register(get_types_from_msg(connection.msgdef.data, connection.msgtype))
        for connection, stamp, content in reader.messages():
            value = types.deserialize_cdr(content, connection.msgtype)
            messages.setdefault(connection.topic, []).append((stamp, value))
    return messages, yaml.safe_load((folder / "metadata.yaml").read_text())["rosbag2_bagfile_information"]


def street(folder: Path) -> Scene:
    toy_street = ToyStreet(times=[0.5, 0.6, 0.7], car_start=(8.0, 1.0), car_velocity=(3.0, 0.0))
    return toy_street.write(folder, width=24, height=12)


def matrix(transform: Any) -> np.ndarray:
    turn, shift = transform.rotation, transform.translation
    rotation = geometry.matrix_from_quaternion([turn.w, turn.x, turn.y, turn.z])
    return geometry.from_rotation_translation(rotation, [shift.x, shift.y, shift.z])


@pytest.fixture(scope="module")
def exported(tmp_path_factory: pytest.TempPathFactory) -> tuple[Scene, Path]:
    folder = tmp_path_factory.mktemp("bag")
    scene = street(folder / "scene")
    assert app.main(["export", "ros2", str(folder / "scene"), "--out", str(folder / "out")]) == 0
    return scene, folder


def test_a_bag_holds_the_log(exported: tuple[Scene, Path]) -> None:
    scene, folder = exported
    bag, about = read_bag(folder / "out")
    listed = {t["topic_metadata"]["name"]: t["message_count"] for t in about["topics_with_message_count"]}
    assert listed == {topic: len(messages) for topic, messages in bag.items()}
    assert about["message_count"] == sum(listed.values()) and about["duration"] == {"nanoseconds": 200_000_000}
    assert about["starting_time"] == {"nanoseconds_since_epoch": 10**9} and about["version"] == 5
    for frame, (moment, image) in zip(scene.frames, bag["/camera/front/image/compressed"], strict=True):
        assert image.data.tobytes() == (folder / "scene" / frame.image.path).read_bytes() and image.format == "png"
        stamp = image.header.stamp
        assert stamp.sec * 10**9 + stamp.nanosec == moment == 10**9 + round((frame.view.time_s - 0.5) * 1e9)
    for sweep, (_, cloud) in zip(scene.sweeps, bag["/lidar/lidar/points"], strict=True):
        points = cloud.data.view("<f4").reshape(cloud.width, 4)
        truth = read_points(scene, sweep)
        assert np.array_equal(points[:, :3], truth.xyz) and np.array_equal(points[:, 3], truth.intensity)
        assert [(f.name, f.offset) for f in cloud.fields] == [("x", 0), ("y", 4), ("z", 8), ("intensity", 12)]
    (_, path), *more = bag["/ego/path"]
    assert not more and len(path.poses) == len(scene.ego.times_s)
    box = bag["/objects/detections"][1][1].detections[0]
    (result,), size = box.results, box.bbox.size
    assert (box.id, result.hypothesis.class_id, result.hypothesis.score) == ("car-1", "car", 1.0)
    assert (size.x, size.y, size.z) == (4.0, 2.0, 1.6) and box.bbox.center.position.x == pytest.approx(9.8)
    cube, name = bag["/objects/markers"][1][1].markers
    assert (cube.type, name.type, name.text) == (1, 9, "car-1 (car)") and cube.scale.x == 4.0


def test_one_file_holds_the_messages_of_the_bag(
    exported: tuple[Scene, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scene, folder = exported
    assert app.main(["export", "mcap", str(folder / "scene"), "--out", str(tmp_path / "a.mcap")]) == 0
    assert (tmp_path / "a.mcap").read_bytes() == (folder / "out" / "log_0.mcap").read_bytes()
    monkeypatch.setattr(ros2, "CHUNK_BYTES", 20_000)
    write_mcap(tmp_path / "b.mcap", ros2.Ros2Messages(log_of(scene)))
    with (tmp_path / "b.mcap").open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        times = [message.log_time for _, _, message in reader.iter_messages(log_time_order=False)]
        summary = reader.get_summary()
    assert summary is not None and summary.statistics is not None and len(summary.chunk_indexes) > 2
    assert summary.statistics.message_count == len(times) and times == sorted(times)


def test_points_of_the_world_fall_on_their_pixels_through_frames_and_calibration(exported: tuple[Scene, Path]) -> None:
    """As ROS computes it: map <- base_link <- camera by /tf and /tf_static, then OpenCV's pixels, whose centres are
    whole numbers."""
    scene, folder = exported
    bag, _ = read_bag(folder / "out")
    fixed = {t.child_frame_id: t for t in bag["/tf_static"][0][1].transforms}
    assert {t.header.frame_id for t in fixed.values()} == {"base_link"}
    for frame, (moment, info) in zip(scene.frames, bag["/camera/front/camera_info"], strict=True):
        (now,) = [m.transforms[0] for t, m in bag["/tf"] if t == moment]
        assert (now.header.frame_id, now.child_frame_id) == ("map", "base_link")
        camera = matrix(now.transform) @ matrix(fixed[info.header.frame_id].transform)
        point = frame.view.world_from_cam @ [0.4, 0.3, 5.0, 1.0]
        u, v, w = np.reshape(info.k, (3, 3)) @ (np.linalg.inv(camera) @ point)[:3]
        assert np.allclose([u / w + 0.5, v / w + 0.5], geometry.project(frame.view, point[None, :3])[0][0])
        assert info.distortion_model == "plumb_bob" and (info.width, info.height) == (24, 12)


def log_of(scene: Scene, fused: PointCloud | None = None) -> LogRecords:
    files = open_files(scene.root)
    return LogRecords(scene, lambda f: files.read(f.image.path), lambda s: read_points(scene, s), fused)


def test_transforms_come_first_and_sensors_that_move_hang_on_the_map(tmp_path: Path) -> None:
    scene = street(tmp_path / "scene")
    late = replace(scene.frames[2].view, world_from_cam=scene.frames[2].view.world_from_cam @ geometry.yaw_matrix(0.1))
    moved = replace(scene, frames=(*scene.frames[:2], replace(scene.frames[2], view=late)))
    fused = PointCloud(np.ones((1, 3), np.float32), np.array([[1, 2, 3]], np.uint8), "world")
    messages = list(ros2.Ros2Messages(log_of(moved, fused)))
    order = [(m.time_s, not m.topic.startswith("/tf")) for m in messages]
    assert order == sorted(order)
    static = next(m.value() for m in messages if m.topic == "/tf_static")
    assert [t.child_frame_id for t in static.transforms] == ["lidar_lidar"]
    transforms = [t for m in messages if m.topic == "/tf" for t in m.value().transforms]
    free = [t for t in transforms if "camera" in t.child_frame_id]
    assert len(free) == 3 and np.allclose(matrix(free[2].transform), late.world_from_cam)
    points = next(m for m in messages if m.topic == "/points")
    assert points.value().data.view("<u4")[3] == 0x010203


def test_names_are_those_that_ros_accepts(exported: tuple[Scene, Path]) -> None:
    names = ros2.ros_names(["front", "CAM__front-left", "cam front left", "02", "", "ä"])
    assert list(names.values()) == ["front", "CAM_front_left", "cam_front_left", "n02", "sensor", "sensor_2"]
    scene = replace(exported[0], tracks=(replace(exported[0].tracks[0], label="a\0b"),))
    with pytest.raises(InputError, match="zero byte"):
        ros2.Ros2Messages(log_of(scene))


def test_the_same_log_gives_the_same_bag_in_bounded_memory(exported: tuple[Scene, Path], tmp_path: Path) -> None:
    scene, folder = exported
    first, read, log = (folder / "out" / "log_0.mcap").read_bytes(), [], log_of(scene)
    picture = log.picture
    log.picture = lambda frame: read.append(frame.id) or picture(frame)
    messages = ros2.Ros2Messages(log)
    assert list(messages) and not read  # a picture is read when its message is written
    write_mcap(tmp_path / "a.mcap", messages)
    assert (tmp_path / "a.mcap").read_bytes() == first and len(read) == 3
    assert app.main(["export", "ros2", str(folder / "scene"), "--out", str(folder / "out")]) == 0  # verified and reused
    assert (folder / "out" / "log_0.mcap").read_bytes() == first


@pytest.mark.parametrize(("name", "out", "package"), [("mcap", "a.mcap", "mcap"), ("ros2", "bag", "rosbags")])
def test_a_missing_package_is_named_with_its_extra(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, out: str, package: str
) -> None:
    monkeypatch.setitem(sys.modules, package, None)
    for module in [key for key in sys.modules if key.startswith(f"{package}.")]:
        monkeypatch.delitem(sys.modules, module)
    street(tmp_path / "scene")
    with pytest.raises(ResourceError, match=r"mudg\[ros\]"):
        Export(format=name, source=tmp_path / "scene", out=tmp_path / out, settings=ExportConfig()).run()
    assert not (tmp_path / out).exists()
    assert app.main(["export", name, str(tmp_path / "scene"), "--out", str(tmp_path / "a.txt")]) != 0


def test_what_has_no_log_or_is_damaged_is_refused(tmp_path: Path) -> None:
    save_model(toy(), tmp_path / "fit")
    for name, out in (("ros2", "bag"), ("mcap", "a.mcap")):
        with pytest.raises(MudgError, match="none is known here"):
            Export(format=name, source=tmp_path / "fit", out=tmp_path / out, settings=ExportConfig()).run()
        assert not (tmp_path / out).exists()
    scene = street(tmp_path / "scene")
    (tmp_path / "scene" / scene.frames[1].image.path).unlink()
    with pytest.raises(MudgError):
        Export(format="ros2", source=tmp_path / "scene", out=tmp_path / "bag", settings=ExportConfig()).run()
    assert not (tmp_path / "bag" / "metadata.yaml").exists() and not (tmp_path / "bag" / "log_0.mcap").exists()
