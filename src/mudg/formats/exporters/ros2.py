"""A driving log as a bag of ROS 2 (rosbag2 with MCAP storage), written without ROS.

    /tf  /tf_static  /ego/path (once)  /ego/pose  /camera/NAME/image/compressed  /camera/NAME/camera_info
    /lidar/NAME/points
    /objects/markers  /objects/detections  /points (fused, once)

Frames (REP 103, REP 105): ``map``, ``base_link`` (the vehicle), ``camera_NAME_optical`` (x right, y down, z forward),
``lidar_NAME``. A sensor whose place on the vehicle is fixed hangs on ``base_link`` by /tf_static, any other on ``map``
by /tf. Principal points count from the centre of the first pixel, as OpenCV's do: half a pixel less than in this
program.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import yaml
from numpy.typing import NDArray

from mudg.base import geometry
from mudg.base.errors import InputError
from mudg.base.types import Frame, Sweep, View
from mudg.formats.exporters.log_records import BOX_LIFE_S, NANO, LogRecords, above, box_color, picture_format
from mudg.formats.exporters.mcap import McapDialect, McapMessage

# cdr ----------------------------------------------------------------------------------------------
#
# Messages of ROS 2 as bytes: definitions as ``.msg`` files state them, and values as CDR (OMG's XCDR version 1, little
# endian).
#
# A definition is lines of ``type name``. Every value is aligned to its size, counted after the four bytes of the
# header; texts and lists begin with their length.


HEADER: Final = b"\0\1\0\0"
LINE: Final = "=" * 80
PRIMITIVES: Final = {
    "bool": "?",
    "byte": "B",
    "char": "B",
    "int8": "b",
    "uint8": "B",
    "int16": "h",
    "uint16": "H",
    "int32": "i",
    "uint32": "I",
    "int64": "q",
    "uint64": "Q",
    "float32": "f",
    "float64": "d",
}
_FIELD: Final = re.compile(r"([A-Za-z][\w/]*)(\[(\d*)\])? ([a-z]\w*)")


@dataclass(frozen=True, slots=True)
class CdrField:
    """One field: its type, its name, and how often it stands there (None: once; -1: any number, stated before; else
    fixed)."""

    kind: str
    name: str
    count: int | None


class Definitions:
    """Types of messages by name, ``package/Type``.

    Args:
        texts: name -> the lines of its definition.
    """

    def __init__(self, texts: Mapping[str, str]) -> None:
        self._texts = {name: text.strip() + "\n" for name, text in texts.items()}
        self._fields = {name: [_field(line, name) for line in text.splitlines()] for name, text in self._texts.items()}

    def schema(self, name: str) -> str:
        """The definition of a type, followed by those of all types that it uses."""
        parts, waiting, seen = [self._texts[name]], [name], {name}
        while waiting:
            for field in self._fields[waiting.pop(0)]:
                if field.kind not in PRIMITIVES and field.kind != "string" and field.kind not in seen:
                    seen.add(field.kind)
                    waiting.append(field.kind)
                    parts.append(f"{LINE}\nMSG: {field.kind}\n{self._texts[field.kind]}")
        return "".join(parts)

    def content(self, name: str, value: Mapping[str, Any]) -> bytes:
        """The bytes of a message.

        Args:
            value: its fields; those that are left out are zero or empty. ``uint8[]`` takes bytes.

        Raises:
            KeyError: a field that the type does not have.
        """
        out = bytearray(HEADER)
        self._record(out, name, value)
        return bytes(out)

    def _record(self, out: bytearray, name: str, value: Mapping[str, Any]) -> None:
        fields = self._fields[name]
        unknown = set(value) - {field.name for field in fields}
        if unknown:
            raise KeyError(f"{name} has no field {sorted(unknown)[0]}")
        for field in fields:
            self._value(out, field, value.get(field.name))

    def _value(self, out: bytearray, field: CdrField, value: Any) -> None:
        if field.count is None:
            self._one(out, field.kind, value)
            return
        items: Sequence[Any] = value if value is not None else [None] * max(field.count, 0)
        if field.count < 0:
            _number(out, "I", len(items))
        elif len(items) != field.count:
            raise ValueError(f"{field.name} takes {field.count} values, not {len(items)}")
        if field.kind == "uint8" and isinstance(items, bytes):
            out += items
            return
        for item in items:
            self._one(out, field.kind, item)

    def _one(self, out: bytearray, kind: str, value: Any) -> None:
        if kind == "string":
            text = str(value or "").encode()
            if b"\0" in text:
                raise InputError("a name holds a zero byte, which ROS cannot carry", got=repr(value))
            _number(out, "I", len(text) + 1)
            out += text + b"\0"
        elif kind in PRIMITIVES:
            _number(out, PRIMITIVES[kind], value or 0)
        else:
            self._record(out, kind, value or {})


def _field(line: str, where: str) -> CdrField:
    found = _FIELD.fullmatch(line.strip())
    if found is None:
        raise ValueError(f"{where}: not a field: {line!r}")
    kind, several, count, name = found.groups()
    return CdrField(kind, name, None if several is None else int(count) if count else -1)


def _number(out: bytearray, code: str, value: float) -> None:
    size = struct.calcsize(f"<{code}")
    out += b"\0" * (-(len(out) - len(HEADER)) % size)
    out += struct.pack(f"<{code}", value)


# ros2 ---------------------------------------------------------------------------------------------


START_S: Final = 1
"""Stamp of the first record: ROS reads the stamp 0 as 'the latest'."""
FILE: Final = "log_0.mcap"
METADATA: Final = "metadata.yaml"
MAP: Final = "map"
VEHICLE: Final = "base_link"
FLOAT32: Final = 7
CUBE: Final = 1
WORDS: Final = 9

DEFINITIONS: Final = Definitions(
    {
        "builtin_interfaces/Time": "int32 sec\nuint32 nanosec",
        "builtin_interfaces/Duration": "int32 sec\nuint32 nanosec",
        "std_msgs/Header": "builtin_interfaces/Time stamp\nstring frame_id",
        "std_msgs/ColorRGBA": "float32 r\nfloat32 g\nfloat32 b\nfloat32 a",
        "geometry_msgs/Point": "float64 x\nfloat64 y\nfloat64 z",
        "geometry_msgs/Vector3": "float64 x\nfloat64 y\nfloat64 z",
        "geometry_msgs/Quaternion": "float64 x\nfloat64 y\nfloat64 z\nfloat64 w",
        "geometry_msgs/Pose": "geometry_msgs/Point position\ngeometry_msgs/Quaternion orientation",
        "geometry_msgs/PoseStamped": "std_msgs/Header header\ngeometry_msgs/Pose pose",
        "geometry_msgs/PoseWithCovariance": "geometry_msgs/Pose pose\nfloat64[36] covariance",
        "geometry_msgs/Transform": "geometry_msgs/Vector3 translation\ngeometry_msgs/Quaternion rotation",
        "geometry_msgs/TransformStamped": (
            "std_msgs/Header header\nstring child_frame_id\ngeometry_msgs/Transform transform"
        ),
        "tf2_msgs/TFMessage": "geometry_msgs/TransformStamped[] transforms",
        "nav_msgs/Path": "std_msgs/Header header\ngeometry_msgs/PoseStamped[] poses",
        "sensor_msgs/CompressedImage": "std_msgs/Header header\nstring format\nuint8[] data",
        "sensor_msgs/RegionOfInterest": (
            "uint32 x_offset\nuint32 y_offset\nuint32 height\nuint32 width\nbool do_rectify"
        ),
        "sensor_msgs/CameraInfo": (
            "std_msgs/Header header\nuint32 height\nuint32 width\nstring distortion_model\nfloat64[] d\nfloat64[9] k\n"
            "float64[9] r\nfloat64[12] p\nuint32 binning_x\nuint32 binning_y\nsensor_msgs/RegionOfInterest roi"
        ),
        "sensor_msgs/PointField": "string name\nuint32 offset\nuint8 datatype\nuint32 count",
        "sensor_msgs/PointCloud2": (
            "std_msgs/Header header\nuint32 height\nuint32 width\nsensor_msgs/PointField[] fields\nbool is_bigendian\n"
            "uint32 point_step\nuint32 row_step\nuint8[] data\nbool is_dense"
        ),
        "visualization_msgs/UVCoordinate": "float32 u\nfloat32 v",
        "visualization_msgs/MeshFile": "string filename\nuint8[] data",
        "visualization_msgs/Marker": (
            "std_msgs/Header header\nstring ns\nint32 id\nint32 type\nint32 action\ngeometry_msgs/Pose"
            " pose\ngeometry_msgs/Vector3 scale\nstd_msgs/ColorRGBA color\nbuiltin_interfaces/Duration lifetime\nbool"
            " frame_locked\ngeometry_msgs/Point[] points\nstd_msgs/ColorRGBA[] colors\nstring"
            " texture_resource\nsensor_msgs/CompressedImage texture\nvisualization_msgs/UVCoordinate[]"
            " uv_coordinates\nstring text\nstring mesh_resource\nvisualization_msgs/MeshFile mesh_file\nbool"
            " mesh_use_embedded_materials"
        ),
        "visualization_msgs/MarkerArray": "visualization_msgs/Marker[] markers",
        "vision_msgs/ObjectHypothesis": "string class_id\nfloat64 score",
        "vision_msgs/ObjectHypothesisWithPose": (
            "vision_msgs/ObjectHypothesis hypothesis\ngeometry_msgs/PoseWithCovariance pose"
        ),
        "vision_msgs/BoundingBox3D": "geometry_msgs/Pose center\ngeometry_msgs/Vector3 size",
        "vision_msgs/Detection3D": (
            "std_msgs/Header header\nvision_msgs/ObjectHypothesisWithPose[] results\nvision_msgs/BoundingBox3D bbox\n"
            "string id"
        ),
        "vision_msgs/Detection3DArray": "std_msgs/Header header\nvision_msgs/Detection3D[] detections",
    }
)
"""Messages of Humble and later."""
SENT: Final = (
    "tf2_msgs/TFMessage",
    "nav_msgs/Path",
    "geometry_msgs/PoseStamped",
    "sensor_msgs/CompressedImage",
    "sensor_msgs/CameraInfo",
    "sensor_msgs/PointCloud2",
    "visualization_msgs/MarkerArray",
    "vision_msgs/Detection3DArray",
)
ONCE: Final = frozenset({"/tf_static", "/ego/path", "/points"})
"""Topics whose one message is kept for those who join later."""


def dialect() -> McapDialect:
    """How these messages stand in a file."""
    schemas = {_type(name): DEFINITIONS.schema(name) for name in SENT}
    return McapDialect("ros2", "ros2msg", "cdr", schemas, lambda topic: {"offered_qos_profiles": _qos(topic)})


def metadata(topics: Mapping[str, tuple[str, int]], span: tuple[int, int]) -> bytes:
    """``metadata.yaml`` of a bag, version 5 (Humble; read by all later ones).

    Args:
        topics: type and number of messages of every topic. span: nanoseconds of the first and the last message.
    """
    start, length = {"nanoseconds_since_epoch": span[0]}, {"nanoseconds": span[1] - span[0]}
    total = sum(count for _, count in topics.values())
    listed = [
        {
            "topic_metadata": {
                "name": topic,
                "type": kind,
                "serialization_format": "cdr",
                "offered_qos_profiles": _qos(topic),
            },
            "message_count": count,
        }
        for topic, (kind, count) in topics.items()
    ]
    about = {
        "version": 5,
        "storage_identifier": "mcap",
        "duration": length,
        "starting_time": start,
        "message_count": total,
        "topics_with_message_count": listed,
        "compression_format": "",
        "compression_mode": "",
        "relative_file_paths": [FILE],
        "files": [{"path": FILE, "starting_time": dict(start), "duration": dict(length), "message_count": total}],
    }
    return yaml.safe_dump({"rosbag2_bagfile_information": about}, sort_keys=False).encode()


def _type(name: str) -> str:
    package, _, kind = name.partition("/")
    return f"{package}/msg/{kind}"


def _qos(topic: str) -> str:
    """Quality of service as rosbag2 writes it: reliable; kept for those who join later where one message is all."""
    never = {"sec": 9223372036, "nsec": 854775807}
    once = topic in ONCE
    profile = {
        "history": 1,
        "depth": 1 if once else 10,
        "reliability": 1,
        "durability": 1 if once else 2,
        "deadline": dict(never),
        "lifespan": dict(never),
        "liveliness": 1,
        "liveliness_lease_duration": dict(never),
        "avoid_ros_namespace_conventions": False,
    }
    return yaml.safe_dump([profile], sort_keys=False)


def ros_names(names: Iterable[str]) -> dict[str, str]:
    """Names that ROS accepts as a part of topics (letters, digits, single underscores, a letter first), each once."""
    made: dict[str, str] = {}
    for name in names:
        plain = re.sub(r"[^A-Za-z0-9]+", "_", name).strip("_") or "sensor"
        plain = f"n{plain}" if plain[0].isdigit() else plain
        chosen, count = plain, 1
        while chosen in made.values():
            count += 1
            chosen = f"{plain}_{count}"
        made[name] = chosen
    return made


# -- messages --------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class _CdrMessage:
    """One message before it is made: topic, type, seconds on the log's clock, and what makes its value."""

    topic: str
    kind: str
    time_s: float
    value: Callable[[], dict[str, Any]]

    def content(self) -> bytes:
        """The bytes of the message."""
        return DEFINITIONS.content(self.kind, self.value())


class Ros2Messages:
    """The messages of a log in order of time; of one moment, transforms first."""

    def __init__(self, records: LogRecords) -> None:
        self._log, self._scene = records, records.scene
        cameras, lidars = (
            ros_names(names) for names in (self._scene.cameras, {s.sensor: 0 for s in self._scene.sweeps})
        )
        self._names = {**{f"camera/{k}": v for k, v in cameras.items()}, **{f"lidar/{k}": v for k, v in lidars.items()}}
        self._mounts = records.mounts()

    def __iter__(self) -> Iterator[McapMessage]:
        found = [*self._once(), *self._transforms(), *self._of_sensors(), *self._of_objects()]
        for one in sorted(
            found, key=lambda message: (message.time_s, not message.topic.startswith("/tf"), message.topic)
        ):
            yield McapMessage(one.topic, _type(one.kind), self._nanoseconds(one.time_s), one.content)

    def _nanoseconds(self, time_s: float) -> int:
        return self._log.nanoseconds(time_s) + START_S * NANO

    def _header(self, time_s: float, frame: str) -> dict[str, Any]:
        nanoseconds = self._nanoseconds(time_s)
        return {"stamp": {"sec": nanoseconds // NANO, "nanosec": nanoseconds % NANO}, "frame_id": frame}

    def _frame(self, sensor: str) -> str:
        kind, name = sensor.partition("/")[0], self._names[sensor]
        return f"camera_{name}_optical" if kind == "camera" else f"lidar_{name}"

    def _once(self) -> Iterator[_CdrMessage]:
        start = self._log.start_s
        if self._mounts:
            yield _CdrMessage(
                "/tf_static",
                "tf2_msgs/TFMessage",
                start,
                lambda: {
                    "transforms": [
                        self._transform(start, VEHICLE, self._frame(name), mount)
                        for name, mount in self._mounts.items()
                    ]
                },
            )
        ego = self._scene.ego
        yield _CdrMessage(
            "/ego/path",
            "nav_msgs/Path",
            start,
            lambda: {
                "header": self._header(start, MAP),
                "poses": [
                    {"header": self._header(float(t), MAP), "pose": _pose(pose)}
                    for t, pose in zip(ego.times_s, ego.world_from_ego)
                ],
            },
        )
        if self._log.fused is not None:
            yield _CdrMessage("/points", "sensor_msgs/PointCloud2", start, self._fused)

    def _transforms(self) -> Iterator[_CdrMessage]:
        """The vehicle at every moment at which something was recorded, and sensors that are not fixed to it."""
        for moment in self._log.moments():
            pose = self._scene.ego.pose_at(moment)
            if pose is not None:
                yield self._tf(moment, VEHICLE, pose)
                yield _CdrMessage(
                    "/ego/pose",
                    "geometry_msgs/PoseStamped",
                    moment,
                    lambda t=moment, p=pose: {"header": self._header(t, MAP), "pose": _pose(p)},
                )
        for sensor, time_s, pose in self._log.sensor_poses():
            if sensor not in self._mounts:
                yield self._tf(time_s, self._frame(sensor), pose)

    def _tf(self, time_s: float, frame: str, pose: NDArray[np.float64]) -> _CdrMessage:
        return _CdrMessage(
            "/tf", "tf2_msgs/TFMessage", time_s, lambda: {"transforms": [self._transform(time_s, MAP, frame, pose)]}
        )

    def _transform(self, time_s: float, parent: str, child: str, pose: NDArray[np.float64]) -> dict[str, Any]:
        told = _pose(pose)
        return {
            "header": self._header(time_s, parent),
            "child_frame_id": child,
            "transform": {"translation": told["position"], "rotation": told["orientation"]},
        }

    def _of_sensors(self) -> Iterator[_CdrMessage]:
        for frame in self._scene.frames:
            topic, view = f"/camera/{self._names[f'camera/{frame.view.camera.name}']}", frame.view
            yield _CdrMessage(
                f"{topic}/camera_info", "sensor_msgs/CameraInfo", view.time_s, lambda v=view: self._camera_info(v)
            )
            yield _CdrMessage(
                f"{topic}/image/compressed", "sensor_msgs/CompressedImage", view.time_s, lambda f=frame: self._image(f)
            )
        for sweep in self._scene.sweeps:
            topic = f"/lidar/{self._names[f'lidar/{sweep.sensor}']}/points"
            yield _CdrMessage(topic, "sensor_msgs/PointCloud2", sweep.time_s, lambda s=sweep: self._sweep(s))

    def _camera_info(self, view: View) -> dict[str, Any]:
        camera = view.camera
        k = camera.matrix
        k[:2, 2] -= 0.5
        return {
            "header": self._header(view.time_s, self._frame(f"camera/{camera.name}")),
            "height": camera.height,
            "width": camera.width,
            "distortion_model": "plumb_bob",
            "d": [0.0] * 5,
            "k": k.reshape(-1).tolist(),
            "r": np.eye(3).reshape(-1).tolist(),
            "p": np.column_stack([k, np.zeros(3)]).reshape(-1).tolist(),
        }

    def _image(self, frame: Frame) -> dict[str, Any]:
        header = self._header(frame.view.time_s, self._frame(f"camera/{frame.view.camera.name}"))
        return {"header": header, "format": picture_format(frame), "data": self._log.picture(frame)}

    def _sweep(self, sweep: Sweep) -> dict[str, Any]:
        points = self._log.points(sweep)
        rows = np.zeros(len(points.xyz), [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("intensity", "<f4")])
        rows["x"], rows["y"], rows["z"], rows["intensity"] = *points.xyz.T, points.intensity
        return self._cloud(sweep.time_s, self._frame(f"lidar/{sweep.sensor}"), rows)

    def _fused(self) -> dict[str, Any]:
        """Fused points; colours as programs of ROS expect them: 0x00RRGGBB in the bits of a float."""
        cloud = self._log.fused
        rows = np.zeros(0 if cloud is None else len(cloud), [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("rgb", "<f4")])
        if cloud is not None:
            red, green, blue = cloud.rgb.T.astype("<u4")
            rows["x"], rows["y"], rows["z"] = cloud.xyz.T
            rows["rgb"] = (red << 16 | green << 8 | blue).astype("<u4").view("<f4")
        return self._cloud(self._log.start_s, MAP, rows)

    def _cloud(self, time_s: float, frame: str, rows: NDArray[Any]) -> dict[str, Any]:
        fields = [
            {"name": name, "offset": 4 * index, "datatype": FLOAT32, "count": 1}
            for index, name in enumerate(rows.dtype.names or ())
        ]
        content = rows.tobytes()
        return {
            "header": self._header(time_s, frame),
            "height": 1,
            "width": len(rows),
            "fields": fields,
            "point_step": rows.dtype.itemsize,
            "row_step": len(content),
            "data": content,
            "is_dense": True,
        }

    def _of_objects(self) -> Iterator[_CdrMessage]:
        for moment in self._log.moments():
            yield _CdrMessage(
                "/objects/markers", "visualization_msgs/MarkerArray", moment, lambda t=moment: self._markers(t)
            )
            yield _CdrMessage(
                "/objects/detections", "vision_msgs/Detection3DArray", moment, lambda t=moment: self._detections(t)
            )

    def _markers(self, time_s: float) -> dict[str, Any]:
        numbers = {track.id: number for number, track in enumerate(self._scene.tracks)}
        markers = []
        for track, pose in self._log.boxes(time_s):
            red, green, blue = box_color(track.label)
            shared = {
                "header": self._header(time_s, MAP),
                "id": numbers[track.id],
                "lifetime": {"nanosec": round(BOX_LIFE_S * NANO)},
            }
            markers.append(
                {
                    **shared,
                    "ns": "boxes",
                    "type": CUBE,
                    "pose": _pose(pose),
                    "scale": _vector(track.size_m),
                    "color": {"r": red, "g": green, "b": blue, "a": 0.4},
                }
            )
            markers.append(
                {
                    **shared,
                    "ns": "names",
                    "type": WORDS,
                    "pose": _pose(above(pose, track)),
                    "scale": {"z": 0.5},
                    "color": {"r": 1, "g": 1, "b": 1, "a": 1},
                    "text": f"{track.id} ({track.label})",
                }
            )
        return {"markers": markers}

    def _detections(self, time_s: float) -> dict[str, Any]:
        header = self._header(time_s, MAP)
        return {
            "header": header,
            "detections": [
                {
                    "header": header,
                    "id": track.id,
                    "bbox": {"center": _pose(pose), "size": _vector(track.size_m)},
                    "results": [{"hypothesis": {"class_id": track.label, "score": 1.0}, "pose": {"pose": _pose(pose)}}],
                }
                for track, pose in self._log.boxes(time_s)
            ],
        }


def _vector(values: NDArray[np.floating]) -> dict[str, float]:
    return {"x": float(values[0]), "y": float(values[1]), "z": float(values[2])}


def _pose(matrix: NDArray[np.float64]) -> dict[str, Any]:
    w, x, y, z = geometry.quaternion_from_matrix(matrix).tolist()
    return {"position": _vector(matrix[:3, 3]), "orientation": {"x": x, "y": y, "z": z, "w": w}}
