"""A driving log as records over time, and as messages of ROS 2 in an MCAP file or a bag (docs/reference/export.md)."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from functools import partial
from pathlib import Path, PurePosixPath
from types import SimpleNamespace
from typing import Any, Final, NamedTuple

import numpy as np
import yaml
from numpy.typing import NDArray

from mudg.base import geometry, store
from mudg.base.errors import InputError, ResourceError
from mudg.base.palette import CLASSES, DISPLAY_COLORS, ID
from mudg.base.types import Frame, PointCloud, Scene, Sweep, SweepPoints, Track, View
from mudg.base.versions import version
from mudg.formats.splats.cloud import each_once
from mudg.scene.read import open_files, read_points

NANO: Final = 1_000_000_000
CHUNK_BYTES: Final = 4 << 20
"""Bytes of messages that an MCAP file holds together, and that are in memory at once."""
BOX_LIFE_S: Final = 0.15
"""Boxes vanish if no message follows for this long."""
MOUNT_M: Final = 1e-4
"""Metres (and entries of rotations) by which the place of a fixed sensor on the vehicle may vary."""

Matrix = NDArray[np.float64]


class LogRecords:
    """The records of a log; pictures and points are read when they are asked for. ``fused``: a cloud that is sent
    once, or None."""

    def __init__(self, scene: Scene, fused: PointCloud | None = None) -> None:
        self.scene, self.fused = scene, fused if fused is not None and len(fused) else None
        times = [f.view.time_s for f in scene.frames] + [s.time_s for s in scene.sweeps] + scene.ego.times_s.tolist()
        self.start_s = min(times, default=0.0)

    def __str__(self) -> str:
        return f"{len(self.scene.frames)} pictures, {len(self.scene.sweeps)} sweeps"

    def picture(self, frame: Frame) -> bytes:
        """The file of an image."""
        return open_files(self.scene.root).read(frame.image.path)

    def points(self, sweep: Sweep) -> SweepPoints:
        """The points of a sweep."""
        return read_points(self.scene, sweep)

    def nanoseconds(self, time_s: float) -> int:
        """Since the first record."""
        return max(0, round((time_s - self.start_s) * NANO))

    def moments(self) -> list[float]:
        """Seconds of all pictures and sweeps, each once, in order."""
        return sorted({f.view.time_s for f in self.scene.frames} | {s.time_s for s in self.scene.sweeps})

    def boxes(self, time_s: float) -> list[tuple[Track, Matrix]]:
        """The objects that are there at a time, and their poses."""
        found = [(track, track.pose_at(time_s)) for track in self.scene.tracks]
        return [(track, pose) for track, pose in found if pose is not None]

    def mounts(self, tolerance_m: float = MOUNT_M) -> dict[str, Matrix]:
        """Ego-from-sensor f64[4, 4] of the sensors that do not move on the vehicle (``camera/NAME``, ``lidar/NAME``).
        One whose recorded poses the vehicle's path does not explain to ``tolerance_m`` is left out."""
        first: dict[str, Matrix] = {}
        moving: set[str] = set()
        for name, time_s, pose in self.sensor_poses():
            ego = self.scene.ego.pose_at(time_s)
            mount = None if ego is None else geometry.invert(ego) @ pose
            if mount is None or np.abs(first.setdefault(name, mount) - mount).max() > tolerance_m:
                moving.add(name)
        return {name: mount for name, mount in first.items() if name not in moving}

    def sensor_poses(self) -> list[tuple[str, float, Matrix]]:
        """``camera/NAME`` or ``lidar/NAME``, seconds, and world-from-sensor of every picture and sweep."""
        return [
            *((f"camera/{f.view.camera.name}", f.view.time_s, f.view.world_from_cam) for f in self.scene.frames),
            *((f"lidar/{s.sensor}", s.time_s, s.world_from_lidar) for s in self.scene.sweeps),
        ]


def picture_format(frame: Frame) -> str:
    """``jpeg``, ``png``, ..., by the name of the file."""
    ending = PurePosixPath(frame.image.path).suffix.lower().lstrip(".")
    return {"jpg": "jpeg"}.get(ending, ending)


def box_color(label: str) -> tuple[float, float, float]:
    """Red, green, blue in [0, 1] of a class name."""
    name = {"pedestrian": "person", "cyclist": "rider", "van": "car"}.get(label.lower(), label.lower())
    red, green, blue = DISPLAY_COLORS[ID[name]].tolist() if name in CLASSES else (160, 160, 160)
    return red / 255, green / 255, blue / 255


# MCAP files ---------------------------------------------------------------------------------------


class LogMessage(NamedTuple):
    """One message: its topic, the name of its schema, seconds on the log's clock, and what makes its value when it is
    written."""

    topic: str
    schema: str
    time_s: float
    value: Callable[[], Any]


def mcap_writer() -> Any:
    """The module ``mcap.writer``; ResourceError if the packages of messages are not installed."""
    try:
        import mcap.writer
        import rosbags.typesys  # noqa: F401
    except ImportError as error:
        what = "MCAP files and bags are written with the packages mcap and rosbags, which are not installed"
        raise ResourceError(what, got=str(error), remedy="pip install 'mudg[ros]'") from error
    return mcap.writer


class McapStream(list[bytes]):
    """What a writer wrote and nobody took yet; ``tell`` counts all of it."""

    size = 0

    def write(self, content: bytes) -> None:
        """Keep a block."""
        self.append(bytes(content))
        self.size += len(content)

    def tell(self) -> int:
        """Bytes written so far."""
        return self.size


def write_mcap(path: Path, messages: Ros2Messages) -> tuple[dict[str, tuple[str, int]], tuple[int, int]]:
    """Write an MCAP file, completely or not at all; no more than one chunk is in memory. Returns schema and number of
    messages of every topic, and the nanoseconds of the first and the last message."""
    package, schemas, channels, stream = mcap_writer(), dict[str, int](), dict[str, int](), McapStream()
    topics, stamps = dict[str, tuple[str, int]](), [0]
    writer = package.Writer(stream, CHUNK_BYTES, package.CompressionType.NONE)

    def blocks() -> Iterator[bytes]:
        writer.start("ros2", f"mudg {version()}")
        for message in messages:
            topic, name, stamp = message.topic, message.schema, messages.stamp(message.time_s)
            if name not in schemas:
                schemas[name] = writer.register_schema(name, "ros2msg", messages.schema(name).encode())
            if topic not in channels:
                about = {"offered_qos_profiles": _qos(topic)}
                channels[topic] = writer.register_channel(topic, "cdr", schemas[name], about)
            number = topics.get(topic, (name, 0))[1]
            writer.add_message(channels[topic], stamp, messages.content(message), stamp, number)
            stamps[:] = [stamps[0] if topics else stamp, stamp]
            topics[topic] = (name, number + 1)
            yield from stream
            stream.clear()
        writer.finish()
        yield from stream

    store.write_blocks(path, blocks())
    return topics, (stamps[0], stamps[-1])


# ros2 ----------------------------------------------------------------------------------------------
# Frames (REP 103, REP 105): ``map``, ``base_link`` (the vehicle), ``camera_NAME_optical`` (x right, y down, z forward),
# ``lidar_NAME``. Principal points count from the centre of the first pixel: half a pixel less than in this program.
# rosbags' own writer begins with bags of version 8, which Humble does not read.


START_S: Final = 1
"""Stamp of the first record: ROS reads the stamp 0 as 'the latest'."""
BAG_FILE: Final = "log_0.mcap"
BAG_METADATA: Final = "metadata.yaml"
MAP: Final = "map"
VEHICLE: Final = "base_link"
FLOAT32: Final = 7
CUBE: Final = 1
WORDS: Final = 9
VISION: Final = {
    "ObjectHypothesis": "string class_id\nfloat64 score",
    "ObjectHypothesisWithPose": "vision_msgs/ObjectHypothesis hypothesis\ngeometry_msgs/PoseWithCovariance pose",
    "BoundingBox3D": "geometry_msgs/Pose center\ngeometry_msgs/Vector3 size",
    "Detection3D": (
        "std_msgs/Header header\nvision_msgs/ObjectHypothesisWithPose[] results\nvision_msgs/BoundingBox3D bbox\n"
        "string id"
    ),
    "Detection3DArray": "std_msgs/Header header\nvision_msgs/Detection3D[] detections",
}
"""Messages of the package vision_msgs, which rosbags does not have."""
ONCE: Final = frozenset({"/tf_static", "/ego/path", "/points"})
"""Topics whose one message is kept for those who join later."""


def bag_metadata(topics: Mapping[str, tuple[str, int]], span: tuple[int, int]) -> bytes:
    """``metadata.yaml`` of a bag, version 5 (Humble; read by all later ones). ``topics``: type and number of messages
    of every topic. ``span``: nanoseconds of the first and the last message."""
    start, length = {"nanoseconds_since_epoch": span[0]}, {"nanoseconds": span[1] - span[0]}
    total = sum(count for _, count in topics.values())
    listed = []
    for topic, (kind, count) in topics.items():
        about = {"name": topic, "type": kind, "serialization_format": "cdr", "offered_qos_profiles": _qos(topic)}
        listed.append({"topic_metadata": about, "message_count": count})
    about = {"version": 5, "storage_identifier": "mcap", "duration": length, "starting_time": start}
    about |= {"message_count": total, "topics_with_message_count": listed}
    about |= {"compression_format": "", "compression_mode": "", "relative_file_paths": [BAG_FILE]}
    file = {"path": BAG_FILE, "starting_time": dict(start), "duration": dict(length), "message_count": total}
    return yaml.safe_dump({"rosbag2_bagfile_information": {**about, "files": [file]}}, sort_keys=False).encode()


def _qos(topic: str) -> str:
    """Quality of service as rosbag2 writes it: reliable; kept for those who join later where one message is all."""
    once, never = topic in ONCE, {"sec": 9223372036, "nsec": 854775807}
    profile = {"history": 1, "depth": 1 if once else 10, "reliability": 1, "durability": 1 if once else 2}
    profile |= {"deadline": dict(never), "lifespan": dict(never), "liveliness": 1}
    profile |= {"liveliness_lease_duration": dict(never), "avoid_ros_namespace_conventions": False}
    return yaml.safe_dump([profile], sort_keys=False)


def ros_names(names: Iterable[str]) -> dict[str, str]:
    """Names that ROS accepts as a part of topics (letters, digits, single underscores, a letter first), each once."""
    names = list(names)
    plain = (re.sub(r"[^A-Za-z0-9]+", "_", name).strip("_") or "sensor" for name in names)
    return dict(zip(names, each_once(f"n{name}" if name[0].isdigit() else name for name in plain)))


class Ros2Messages:
    """The messages (of Humble and later) of a log in order of time; of one moment, transforms first. InputError: an
    object's id or class holds a zero byte. ResourceError: rosbags is not installed."""

    def __init__(self, records: LogRecords) -> None:
        mcap_writer()
        from rosbags.typesys import Stores, get_types_from_msg, get_typestore

        self._log, self._scene, self._types = records, records.scene, get_typestore(Stores.ROS2_HUMBLE)
        for name, text in VISION.items():
            self._types.register(get_types_from_msg(text, f"vision_msgs/msg/{name}"))
        packages = {"builtin_interfaces", "std_msgs", "geometry_msgs", "sensor_msgs", "nav_msgs", "tf2_msgs"}
        packages |= {"visualization_msgs", "vision_msgs"}
        kinds = {kind: made for kind, made in self._types.types.items() if kind.split("/")[0] in packages}
        self._ros: Any = SimpleNamespace(**{kind.split("/")[-1]: made for kind, made in kinds.items()})
        lidars = dict.fromkeys(sweep.sensor for sweep in self._scene.sweeps)
        self._names = {f"camera/{name}": plain for name, plain in ros_names(self._scene.cameras).items()}
        self._names |= {f"lidar/{name}": plain for name, plain in ros_names(lidars).items()}
        self._mounts = records.mounts()
        for track in self._scene.tracks:
            if "\0" in track.id + track.label:
                raise InputError("a name holds a zero byte, which ROS cannot carry", got=repr(track.id + track.label))

    def __iter__(self) -> Iterator[LogMessage]:
        messages = [*self._once(), *self._transforms(), *self._of_sensors(), *self._of_objects()]
        return iter(sorted(messages, key=lambda one: (one.time_s, not one.topic.startswith("/tf"), one.topic)))

    def stamp(self, time_s: float) -> int:
        """The stamp of a message in nanoseconds."""
        return self._log.nanoseconds(time_s) + START_S * NANO

    def schema(self, name: str) -> str:
        """The text of a schema."""
        return self._types.generate_msgdef(name, ros_version=2)[0]

    def content(self, message: LogMessage) -> bytes:
        """The bytes of a message."""
        return bytes(self._types.serialize_cdr(message.value(), message.schema, little_endian=True))

    def _header(self, time_s: float, frame: str) -> Any:
        return self._ros.Header(self._ros.Time(*divmod(self.stamp(time_s), NANO)), frame)

    def _frame(self, sensor: str) -> str:
        return f"{sensor.partition('/')[0]}_{self._names[sensor]}" + "_optical" * sensor.startswith("camera/")

    def _turn(self, pose: Matrix) -> Any:
        w, x, y, z = (geometry.quaternion_from_matrix(pose) + 0.0).tolist()  # no negative zeros
        return self._ros.Quaternion(x, y, z, w)

    def _pose(self, pose: Matrix) -> Any:
        return self._ros.Pose(self._ros.Point(*pose[:3, 3].tolist()), self._turn(pose))

    def _once(self) -> Iterator[LogMessage]:
        start = self._log.start_s
        if self._mounts:
            yield self._tf("/tf_static", start, VEHICLE, {self._frame(name): m for name, m in self._mounts.items()})
        yield LogMessage("/ego/path", "nav_msgs/msg/Path", start, self._path)
        if self._log.fused is not None:
            yield LogMessage("/points", "sensor_msgs/msg/PointCloud2", start, partial(self._fused, self._log.fused))

    def _path(self) -> Any:
        ego = self._scene.ego
        poses = [self._posed(float(t), pose) for t, pose in zip(ego.times_s, ego.world_from_ego)]
        return self._ros.Path(self._header(self._log.start_s, MAP), poses)

    def _posed(self, time_s: float, pose: Matrix) -> Any:
        return self._ros.PoseStamped(self._header(time_s, MAP), self._pose(pose))

    def _transforms(self) -> Iterator[LogMessage]:
        """The vehicle at every moment at which something was recorded, and sensors that are not fixed to it."""
        for moment in self._log.moments():
            pose = self._scene.ego.pose_at(moment)
            if pose is not None:
                yield self._tf("/tf", moment, MAP, {VEHICLE: pose})
                ego = partial(self._posed, moment, pose)
                yield LogMessage("/ego/pose", "geometry_msgs/msg/PoseStamped", moment, ego)
        for sensor, time_s, pose in self._log.sensor_poses():
            if sensor not in self._mounts:
                yield self._tf("/tf", time_s, MAP, {self._frame(sensor): pose})

    def _tf(self, topic: str, time_s: float, parent: str, poses: Mapping[str, Matrix]) -> LogMessage:
        """Parent-from-child poses by the name of the child."""
        ros = self._ros

        def transforms() -> Any:
            header, made = self._header(time_s, parent), []
            for child, pose in poses.items():
                transform = ros.Transform(ros.Vector3(*pose[:3, 3].tolist()), self._turn(pose))
                made.append(ros.TransformStamped(header, child, transform))
            return ros.TFMessage(made)

        return LogMessage(topic, "tf2_msgs/msg/TFMessage", time_s, transforms)

    def _of_sensors(self) -> Iterator[LogMessage]:
        for frame in self._scene.frames:
            view, image = frame.view, partial(self._image, frame)
            topic, info = f"/camera/{self._names[f'camera/{view.camera.name}']}", partial(self._camera_info, view)
            yield LogMessage(f"{topic}/camera_info", "sensor_msgs/msg/CameraInfo", view.time_s, info)
            yield LogMessage(f"{topic}/image/compressed", "sensor_msgs/msg/CompressedImage", view.time_s, image)
        for sweep in self._scene.sweeps:
            topic = f"/lidar/{self._names[f'lidar/{sweep.sensor}']}/points"
            yield LogMessage(topic, "sensor_msgs/msg/PointCloud2", sweep.time_s, partial(self._sweep, sweep))

    def _camera_info(self, view: View) -> Any:
        camera, k = view.camera, view.camera.matrix
        k[:2, 2] -= 0.5
        lens = {"d": np.zeros(5), "k": k.reshape(-1), "r": np.eye(3).reshape(-1)}
        lens |= {"p": np.column_stack([k, np.zeros(3)]).reshape(-1), "binning_x": 0, "binning_y": 0}
        header, whole = self._header(view.time_s, self._frame(f"camera/{camera.name}")), (0, 0, 0, 0, False)
        roi = self._ros.RegionOfInterest(*whole)
        return self._ros.CameraInfo(header, camera.height, camera.width, "plumb_bob", **lens, roi=roi)

    def _image(self, frame: Frame) -> Any:
        header = self._header(frame.view.time_s, self._frame(f"camera/{frame.view.camera.name}"))
        picture = np.frombuffer(self._log.picture(frame), np.uint8)
        return self._ros.CompressedImage(header, picture_format(frame), picture)

    def _sweep(self, sweep: Sweep) -> Any:
        points = self._log.points(sweep)
        return self._cloud(sweep.time_s, self._frame(f"lidar/{sweep.sensor}"), points.xyz, intensity=points.intensity)

    def _fused(self, cloud: PointCloud) -> Any:
        """Fused points; colours as programs of ROS expect them: 0x00RRGGBB in the bits of a float."""
        red, green, blue = cloud.rgb.T.astype("<u4")
        colors = (red << 16 | green << 8 | blue).astype("<u4").view("<f4")
        return self._cloud(self._log.start_s, MAP, cloud.xyz, rgb=colors)

    def _cloud(self, time_s: float, frame: str, xyz: NDArray[np.float32], **more: NDArray[np.float32]) -> Any:
        fields = [self._ros.PointField(name, 4 * at, FLOAT32, 1) for at, name in enumerate(("x", "y", "z", *more))]
        rows = np.frombuffer(np.column_stack([xyz, *more.values()]).astype("<f4").tobytes(), np.uint8)
        sizes = 4 * len(fields), len(rows)
        header = self._header(time_s, frame)
        return self._ros.PointCloud2(header, 1, len(xyz), fields, False, *sizes, rows, is_dense=True)

    def _of_objects(self) -> Iterator[LogMessage]:
        for time_s in self._log.moments():
            markers, boxes = partial(self._markers, time_s), partial(self._detections, time_s)
            yield LogMessage("/objects/markers", "visualization_msgs/msg/MarkerArray", time_s, markers)
            yield LogMessage("/objects/detections", "vision_msgs/msg/Detection3DArray", time_s, boxes)

    def _markers(self, time_s: float) -> Any:
        ros, header = self._ros, self._header(time_s, MAP)
        numbers = {track.id: number for number, track in enumerate(self._scene.tracks)}
        picture = ros.CompressedImage(ros.Header(ros.Time(0, 0), ""), "", np.zeros(0, np.uint8))
        rest = {"action": 0, "lifetime": ros.Duration(0, round(BOX_LIFE_S * NANO)), "frame_locked": False}
        rest |= {"points": [], "colors": [], "texture_resource": "", "texture": picture, "uv_coordinates": []}
        mesh = ros.MeshFile("", np.zeros(0, np.uint8))
        rest |= {"mesh_resource": "", "mesh_file": mesh, "mesh_use_embedded_materials": False}
        markers = []
        for track, pose in self._log.boxes(time_s):
            color, name = ros.ColorRGBA(*box_color(track.label), 0.4), f"{track.id} ({track.label})"
            size, white = ros.Vector3(*track.size_m.tolist()), ros.ColorRGBA(1.0, 1.0, 1.0, 1.0)
            above = pose @ geometry.yaw_matrix(0.0, (0, 0, float(track.size_m[2]) / 2 + 0.4))
            box = {"ns": "boxes", "type": CUBE, "pose": self._pose(pose), "scale": size, "color": color, "text": ""}
            label = {"ns": "names", "type": WORDS, "pose": self._pose(above), "color": white, "text": name}
            label["scale"] = ros.Vector3(0.0, 0.0, 0.5)
            markers += [ros.Marker(header=header, id=numbers[track.id], **rest, **one) for one in (box, label)]
        return ros.MarkerArray(markers)

    def _detections(self, time_s: float) -> Any:
        ros, header, detections = self._ros, self._header(time_s, MAP), []
        for track, pose in self._log.boxes(time_s):
            center, size = self._pose(pose), ros.Vector3(*track.size_m.tolist())
            hypothesis = ros.ObjectHypothesis(track.label, 1.0)
            result = ros.ObjectHypothesisWithPose(hypothesis, ros.PoseWithCovariance(center, np.zeros(36)))
            detections.append(ros.Detection3D(header, [result], ros.BoundingBox3D(center, size), track.id))
        return ros.Detection3DArray(header, detections)
