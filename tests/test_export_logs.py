"""Logs as messages of ROS 2 and recordings of rerun: read by a reader that was written from the standards, and put back
together."""

from __future__ import annotations

import hashlib
import struct
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from test_edit import toy
from test_export import records, text_of
from toy_scene import ToyStreet

from mudg import app
from mudg.base import geometry
from mudg.base.errors import InputError, MudgError, ResourceError
from mudg.base.types import PointCloud, Scene
from mudg.exporting import export
from mudg.exporting.settings import ExportConfig
from mudg.formats.exporters import mcap, ros2
from mudg.formats.exporters import ros2 as cdr
from mudg.formats.exporters.log_records import LogRecords
from mudg.gaussians.storage import save_model
from mudg.scene.files import open_files
from mudg.scene.read import read_points
from mudg.steps.export import Export


class CdrReader:
    """Reads values by the text of a schema, as it stands in the file: OMG's rules, nothing of the writer."""

    SIZES = {"bool": "?", "uint8": "B", "int32": "i", "uint32": "I", "float32": "f", "float64": "d"}

    def __init__(self, schema: str) -> None:
        first, *others = schema.split("=" * 80 + "\n")
        self.types = {"": self.lines(first)}
        for other in others:
            head, _, body = other.partition("\n")
            self.types[head.removeprefix("MSG: ")] = self.lines(body)

    @staticmethod
    def lines(text: str) -> list[tuple[str, str]]:
        return [tuple(line.split()) for line in text.strip().splitlines()]

    def read(self, content: bytes) -> dict[str, Any]:
        assert content[:4] == b"\x00\x01\x00\x00"
        self.content, self.at = content[4:], 0
        value = self.record("")
        assert self.at == len(self.content)
        return value

    def number(self, code: str) -> Any:
        size = struct.calcsize(code)
        self.at = -(-self.at // size) * size
        self.at += size
        return struct.unpack_from("<" + code, self.content, self.at - size)[0]

    def record(self, name: str) -> dict[str, Any]:
        return {field: self.field(kind) for kind, field in self.types[name]}

    def field(self, kind: str) -> Any:
        if not kind.endswith("]"):
            return self.one(kind)
        base, _, count = kind[:-1].partition("[")
        several = int(count) if count else self.number("I")
        if base == "uint8":
            self.at += several
            return self.content[self.at - several : self.at]
        return [self.one(base) for _ in range(several)]

    def one(self, kind: str) -> Any:
        if kind == "string":
            size = self.number("I")
            self.at += size
            assert self.content[self.at - 1] == 0
            return self.content[self.at - size : self.at - 1].decode()
        return self.number(self.SIZES[kind]) if kind in self.SIZES else self.record(kind)


def bag(folder: Path) -> tuple[dict[str, list[tuple[int, dict[str, Any]]]], dict[str, Any]]:
    """Topic -> times and values of its messages, in the order of the file; and what metadata.yaml says."""
    about = yaml.safe_load((folder / "metadata.yaml").read_text())["rosbag2_bagfile_information"]
    content = (folder / about["relative_file_paths"][0]).read_bytes()
    summary = struct.unpack_from("<Q", content, len(content) - 8 - 20)[0]
    schemas: dict[int, CdrReader] = {}
    channels: dict[int, tuple[str, CdrReader]] = {}
    found: dict[str, list[tuple[int, dict[str, Any]]]] = {}
    for _, code, body in records(content, 8, summary):
        if code == 1:
            assert text_of(body, 0)[0] == "ros2"
        if code != 6:
            continue
        for _, inner, record in records(body, 40, len(body)):
            if inner == 3:
                kind, at = text_of(record, 2)
                encoding, at = text_of(record, at)
                assert encoding == "ros2msg" and kind.count("/msg/") == 1
                schemas[struct.unpack_from("<H", record)[0]] = CdrReader(text_of(record, at)[0])
            elif inner == 4:
                topic, at = text_of(record, 4)
                encoding, at = text_of(record, at)
                assert encoding == "cdr" and text_of(record, at + 4)[0] == "offered_qos_profiles"
                channels[struct.unpack_from("<H", record)[0]] = (topic, schemas[struct.unpack_from("<H", record, 2)[0]])
            elif inner == 5:
                channel, _, moment, _ = struct.unpack_from("<HIQQ", record)
                topic, reader = channels[channel]
                found.setdefault(topic, []).append((moment, reader.read(record[22:])))
    return found, about


def street(folder: Path) -> Scene:
    made = ToyStreet(times=[0.5, 0.6, 0.7], car_start=(8.0, 1.0), car_velocity=(3.0, 0.0))
    return made.write(folder, width=24, height=12)


def matrix(transform: dict[str, Any]) -> np.ndarray:
    turn, place = transform["rotation"], transform["translation"]
    rotation = geometry.matrix_from_quaternion([turn[k] for k in "wxyz"])
    return geometry.from_rotation_translation(rotation, [place[k] for k in "xyz"])


@pytest.fixture(scope="module")
def exported(tmp_path_factory: pytest.TempPathFactory) -> tuple[Scene, Path]:
    folder = tmp_path_factory.mktemp("bag")
    scene = street(folder / "scene")
    assert app.main(["export", "ros2", str(folder / "scene"), "--out", str(folder / "out")]) == 0
    return scene, folder


def test_a_bag_holds_the_log(exported: tuple[Scene, Path]) -> None:
    scene, folder = exported
    found, about = bag(folder / "out")
    listed = {t["topic_metadata"]["name"]: t["message_count"] for t in about["topics_with_message_count"]}
    assert listed == {topic: len(messages) for topic, messages in found.items()}
    assert about["message_count"] == sum(listed.values()) and about["duration"] == {"nanoseconds": 200_000_000}
    assert about["starting_time"] == {"nanoseconds_since_epoch": 10**9} and about["version"] == 5
    for frame, (moment, image) in zip(scene.frames, found["/camera/front/image/compressed"], strict=True):
        assert image["data"] == (folder / "scene" / frame.image.path).read_bytes() and image["format"] == "png"
        stamp = image["header"]["stamp"]
        assert stamp["sec"] * 10**9 + stamp["nanosec"] == moment == 10**9 + round((frame.view.time_s - 0.5) * 1e9)
    for sweep, (_, cloud) in zip(scene.sweeps, found["/lidar/lidar/points"], strict=True):
        points = np.frombuffer(cloud["data"], "<f4").reshape(cloud["width"], 4)
        truth = read_points(scene, sweep)
        assert np.array_equal(points[:, :3], truth.xyz) and np.array_equal(points[:, 3], truth.intensity)
        assert [(f["name"], f["offset"]) for f in cloud["fields"]] == [("x", 0), ("y", 4), ("z", 8), ("intensity", 12)]
    (_, path), *more = found["/ego/path"]
    assert not more and len(path["poses"]) == len(scene.ego.times_s)
    _, boxes = found["/objects/detections"][1]
    box = boxes["detections"][0]
    assert box["id"] == "car-1" and box["results"][0]["hypothesis"] == {"class_id": "car", "score": 1.0}
    assert box["bbox"]["size"] == {"x": 4.0, "y": 2.0, "z": 1.6} and box["bbox"]["center"]["position"][
        "x"
    ] == pytest.approx(9.8)
    cube, name = found["/objects/markers"][1][1]["markers"]
    assert (cube["type"], name["type"], name["text"]) == (1, 9, "car-1 (car)") and cube["scale"]["x"] == 4.0


def test_points_of_the_world_fall_on_their_pixels_through_frames_and_calibration(exported: tuple[Scene, Path]) -> None:
    """As ROS computes it: map <- base_link <- camera by /tf and /tf_static, then OpenCV's pixels, whose centres are
    whole numbers."""
    scene, folder = exported
    found, _ = bag(folder / "out")
    fixed = {t["child_frame_id"]: t for t in found["/tf_static"][0][1]["transforms"]}
    assert {t["header"]["frame_id"] for t in fixed.values()} == {"base_link"}
    for frame, (moment, info) in zip(scene.frames, found["/camera/front/camera_info"], strict=True):
        (now,) = [m["transforms"][0] for t, m in found["/tf"] if t == moment]
        assert (now["header"]["frame_id"], now["child_frame_id"]) == ("map", "base_link")
        camera = matrix(now["transform"]) @ matrix(fixed[info["header"]["frame_id"]]["transform"])
        point = frame.view.world_from_cam @ [0.4, 0.3, 5.0, 1.0]
        u, v, w = np.reshape(info["k"], (3, 3)) @ (np.linalg.inv(camera) @ point)[:3]
        assert np.allclose([u / w + 0.5, v / w + 0.5], geometry.project(frame.view, point[None, :3])[0][0])
        assert info["distortion_model"] == "plumb_bob" and (info["width"], info["height"]) == (24, 12)


def log_of(scene: Scene, fused: PointCloud | None = None) -> LogRecords:
    files = open_files(scene.root)
    return LogRecords(scene, lambda f: files.read(f.image.path), lambda s: read_points(scene, s), fused)


def test_transforms_come_first_and_sensors_that_move_hang_on_the_map(tmp_path: Path) -> None:
    scene = street(tmp_path / "scene")
    late = replace(scene.frames[2].view, world_from_cam=scene.frames[2].view.world_from_cam @ geometry.yaw_matrix(0.1))
    moved = replace(scene, frames=(*scene.frames[:2], replace(scene.frames[2], view=late)))
    fused = PointCloud(np.ones((1, 3), np.float32), np.array([[1, 2, 3]], np.uint8), "world")
    messages = list(ros2.Ros2Messages(log_of(moved, fused)))
    order = [(m.nanoseconds, not m.topic.startswith("/tf")) for m in messages]
    assert order == sorted(order)
    read = CdrReader(ros2.DEFINITIONS.schema("tf2_msgs/TFMessage")).read
    static = next(read(m.content()) for m in messages if m.topic == "/tf_static")
    assert [t["child_frame_id"] for t in static["transforms"]] == ["lidar_lidar"]
    free = [
        t
        for m in messages
        if m.topic == "/tf"
        for t in read(m.content())["transforms"]
        if "camera" in t["child_frame_id"]
    ]
    assert len(free) == 3 and np.allclose(matrix(free[2]["transform"]), late.world_from_cam)
    points = next(m for m in messages if m.topic == "/points")
    cloud = CdrReader(ros2.DEFINITIONS.schema("sensor_msgs/PointCloud2")).read(points.content())
    assert np.frombuffer(cloud["data"], "<u4")[3] == 0x010203


def test_golden_bytes_of_a_transform() -> None:
    value = {
        "transforms": [
            {
                "header": {"stamp": {"sec": 1, "nanosec": 2}, "frame_id": "map"},
                "child_frame_id": "a",
                "transform": {"translation": {"x": 1.5}, "rotation": {"w": 1.0}},
            }
        ]
    }
    golden = (
        "00010000 01000000 01000000 02000000 04000000 6d617000 02000000 61000000 00000000"
        "000000000000f83f 0000000000000000 0000000000000000"
        "0000000000000000 0000000000000000 0000000000000000 000000000000f03f"
    )
    assert ros2.DEFINITIONS.content("tf2_msgs/TFMessage", value) == bytes.fromhex(golden)


def test_wrong_values_are_refused() -> None:
    types = cdr.Definitions({"a/B": "uint8 x\nfloat64[2] y\nstring z"})
    assert types.content("a/B", {"x": 1, "y": [1.0, 2.0], "z": "ä"})[4:12] == b"\x01" + bytes(7)
    for value in ({"w": 1}, {"y": [1.0]}, {"x": 256}):
        with pytest.raises((KeyError, ValueError, struct.error)):
            types.content("a/B", value)
    with pytest.raises(InputError, match="zero byte"):
        types.content("a/B", {"z": "a\0b"})
    with pytest.raises(ValueError, match="not a field"):
        cdr.Definitions({"a/B": "float32"})


def test_names_are_those_that_ros_accepts() -> None:
    names = ros2.ros_names(["front", "CAM__front-left", "cam front left", "02", "", "ä"])
    assert list(names.values()) == ["front", "CAM_front_left", "cam_front_left", "n02", "sensor", "sensor_2"]


def test_the_same_log_gives_the_same_bag_in_bounded_memory(
    exported: tuple[Scene, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    scene, folder = exported
    first = hashlib.sha256((folder / "out" / "log_0.mcap").read_bytes()).hexdigest()
    blocks = mcap.McapBlocks(ros2.Ros2Messages(log_of(scene)), f"mudg {export.version()}", ros2.dialect())
    assert hashlib.sha256(b"".join(blocks)).hexdigest() == first
    assert app.main(["export", "ros2", str(folder / "scene"), "--out", str(folder / "out")]) == 0  # verified and reused
    assert hashlib.sha256((folder / "out" / "log_0.mcap").read_bytes()).hexdigest() == first
    read: list[str] = []
    log = log_of(scene)
    log.picture = lambda frame: read.append(frame.id) or b"x" * 1000
    monkeypatch.setattr(mcap, "CHUNK_BYTES", 1)
    for block in mcap.McapBlocks(ros2.Ros2Messages(log), "x", ros2.dialect()):
        assert b"x" * 1000 not in block or len(read) == 1  # one picture at a time, written before the next is read
        read.clear()


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


# -- rerun -----------------------------------------------------------------------------------------


def test_rerun_names_its_extra_where_it_is_missing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "rerun", None)
    save_model(toy(), tmp_path / "fit")
    with pytest.raises(ResourceError, match=r"mudg\[rerun\]"):
        Export(format="rerun", source=tmp_path / "fit", out=tmp_path / "a.rrd", settings=ExportConfig()).run()
    assert not (tmp_path / "a.rrd").exists()
    assert app.main(["export", "rerun", str(tmp_path / "fit"), "--out", str(tmp_path / "a.mcap")]) != 0


def test_a_recording_of_rerun_holds_log_and_gaussians(tmp_path: Path) -> None:
    pytest.importorskip("rerun")
    from rerun.chunk import RrdReader

    scene = street(tmp_path / "scene")
    save_model(toy(), tmp_path / "fit")
    Export(
        format="rerun",
        source=tmp_path / "fit",
        scene=tmp_path / "scene",
        out=tmp_path / "a.rrd",
        settings=ExportConfig(),
    ).run()
    columns: dict[tuple[str, str], list[Any]] = {}
    for chunk in RrdReader(tmp_path / "a.rrd").stream().to_chunks():
        batch = chunk.to_record_batch()
        for name in batch.schema.names:
            columns.setdefault((chunk.entity_path, name), []).extend(batch.column(name).to_pylist())
    pictures = columns["/world/camera/front", "EncodedImage:blob"]
    assert [bytes(p[0]) for p in pictures] == [(tmp_path / "scene" / f.image.path).read_bytes() for f in scene.frames]
    assert columns["/world/camera/front", "Pinhole:resolution"] == [[[24.0, 12.0]]]
    mounted = columns["/world/camera/front", "Transform3D:translation"]
    assert np.allclose(np.squeeze(mounted), [f.view.center_world for f in scene.frames])
    assert len(columns["/world/gaussians/background", "Points3D:positions"][0]) == 640
    assert len(columns["/world/gaussians/background", "Points3D:radii"][0]) == 640
    car = columns[
        (
            "/world/gaussians/car\\-1"
            if ("/world/gaussians/car\\-1", "Points3D:positions") in columns
            else "/world/gaussians/car-1"
        ),
        "Points3D:positions",
    ]
    assert len(car[0]) == 50 and len(columns["/world/objects/car-1", "Boxes3D:half_sizes"]) == 1
    assert len(columns["/world/lidar/lidar", "Points3D:positions"]) == 3
