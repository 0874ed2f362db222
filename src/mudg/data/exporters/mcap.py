"""A driving log as an MCAP file that Foxglove shows: pictures, calibration, LiDAR, boxes and poses over time.

Messages are JSON with the names of Foxglove's schemas, so neither protobuf nor another package is needed; pictures and points are base64
inside. The container (https://mcap.dev/spec): a header, chunks of messages in order of time with an index each, and a summary.
Times are nanoseconds from the first record on.

    /tf  /ego  /objects  /camera/NAME/image  /camera/NAME/calibration  /lidar/NAME  /points (fused, once)
"""

from __future__ import annotations

import base64
import json
import struct
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from mudg.base import geometry
from mudg.base.palette import CLASSES, DISPLAY_COLORS, ID
from mudg.base.types import Frame, PointCloud, Scene, Sweep, SweepPoints, View

MAGIC: Final = b"\x89MCAP0\r\n"
CHUNK_BYTES: Final = 4 << 20
NANO: Final = 1_000_000_000
BOX_LIFE_S: Final = 0.15
_HEADER, _FOOTER, _SCHEMA, _CHANNEL, _MESSAGE, _CHUNK, _INDEX, _CHUNK_INDEX, _STATISTICS, _OFFSET, _END = (
    1, 2, 3, 4, 5, 6, 7, 8, 0x0B, 0x0E, 0x0F,
)  # fmt: skip

_NUMBER: Final = {"type": "number"}
_TEXT: Final = {"type": "string"}
_BYTES: Final = {"type": "string", "contentEncoding": "base64"}
_TIME: Final = {
    "type": "object",
    "title": "time",
    "properties": {"sec": {"type": "integer"}, "nsec": {"type": "integer"}},
}


def _record(**properties: Any) -> dict[str, Any]:
    return {"type": "object", "properties": properties}


def _list(items: Mapping[str, Any]) -> dict[str, Any]:
    return {"type": "array", "items": dict(items)}


_VECTOR: Final = _record(x=_NUMBER, y=_NUMBER, z=_NUMBER)
_TURN: Final = _record(x=_NUMBER, y=_NUMBER, z=_NUMBER, w=_NUMBER)
_POSE: Final = _record(position=_VECTOR, orientation=_TURN)
_COLOR: Final = _record(r=_NUMBER, g=_NUMBER, b=_NUMBER, a=_NUMBER)
_STAMPED: Final = {"timestamp": _TIME, "frame_id": _TEXT}
_CUBE: Final = _record(pose=_POSE, size=_VECTOR, color=_COLOR)
_LABEL: Final = _record(pose=_POSE, billboard={"type": "boolean"}, font_size=_NUMBER, scale_invariant={"type": "boolean"},
                        color=_COLOR, text=_TEXT)  # fmt: skip
_ENTITY: Final = _record(**_STAMPED, id=_TEXT, lifetime=_TIME, frame_locked={"type": "boolean"},
                         metadata=_list(_record(key=_TEXT, value=_TEXT)), cubes=_list(_CUBE), texts=_list(_LABEL))  # fmt: skip

SCHEMAS: Final[Mapping[str, dict[str, Any]]] = {
    "foxglove.FrameTransforms": _record(transforms=_list(_record(
        timestamp=_TIME, parent_frame_id=_TEXT, child_frame_id=_TEXT, translation=_VECTOR, rotation=_TURN))),
    "foxglove.PoseInFrame": _record(**_STAMPED, pose=_POSE),
    "foxglove.CompressedImage": _record(**_STAMPED, data=_BYTES, format=_TEXT),
    "foxglove.CameraCalibration": _record(**_STAMPED, width={"type": "integer"}, height={"type": "integer"}, distortion_model=_TEXT,
                                          D=_list(_NUMBER), K=_list(_NUMBER), R=_list(_NUMBER), P=_list(_NUMBER)),
    "foxglove.PointCloud": _record(**_STAMPED, pose=_POSE, point_stride={"type": "integer"},
                                   fields=_list(_record(name=_TEXT, offset={"type": "integer"}, type={"type": "integer"})), data=_BYTES),
    "foxglove.SceneUpdate": _record(deletions=_list(_record(timestamp=_TIME, id=_TEXT)), entities=_list(_ENTITY)),
}  # fmt: skip


# -- messages ------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class McapMessage:
    """One message: its topic, the name of its schema, seconds on the log's clock, and what makes its JSON value when it is written."""

    topic: str
    schema: str
    time_s: float
    value: Callable[[], dict[str, Any]]


class LogMessages:
    """The messages of a log in order of time.

    Args:
        picture: bytes of a frame's image. points: of a sweep. fused: a cloud that is sent once, or None.
    """

    def __init__(
        self,
        scene: Scene,
        picture: Callable[[Frame], bytes],
        points: Callable[[Sweep], SweepPoints],
        fused: PointCloud | None = None,
    ) -> None:
        self._scene, self._picture, self._points, self._fused = scene, picture, points, fused
        times = [f.view.time_s for f in scene.frames] + [s.time_s for s in scene.sweeps] + scene.ego.times_s.tolist()
        self.start_s = min(times, default=0.0)

    def stamp(self, time_s: float) -> dict[str, int]:
        """Seconds and nanoseconds since the first record."""
        nanoseconds = self.nanoseconds(time_s)
        return {"sec": nanoseconds // NANO, "nsec": nanoseconds % NANO}

    def nanoseconds(self, time_s: float) -> int:
        """Since the first record."""
        return max(0, round((time_s - self.start_s) * NANO))

    def __iter__(self) -> Iterator[McapMessage]:
        found = [*self._of_cameras(), *self._of_sweeps(), *self._of_objects()]
        if self._fused is not None and len(self._fused):
            found.append(McapMessage("/points", "foxglove.PointCloud", self.start_s, self._fused_points))
        yield from sorted(found, key=lambda message: (message.time_s, message.topic))

    def _of_cameras(self) -> Iterator[McapMessage]:
        for frame in self._scene.frames:
            name, view = frame.view.camera.name, frame.view
            yield McapMessage("/tf", "foxglove.FrameTransforms", view.time_s, lambda v=view: self._transforms(v.time_s, [
                (f"camera/{v.camera.name}", v.world_from_cam)]))  # fmt: skip
            yield McapMessage(
                f"/camera/{name}/calibration",
                "foxglove.CameraCalibration",
                view.time_s,
                lambda v=view: self._calibration(v),
            )
            yield McapMessage(
                f"/camera/{name}/image", "foxglove.CompressedImage", view.time_s, lambda f=frame: self._image(f)
            )

    def _of_sweeps(self) -> Iterator[McapMessage]:
        for sweep in self._scene.sweeps:
            place = [(f"lidar/{sweep.sensor}", sweep.world_from_lidar)]
            yield McapMessage(
                "/tf", "foxglove.FrameTransforms", sweep.time_s, lambda s=sweep, p=place: self._transforms(s.time_s, p)
            )
            yield McapMessage(
                f"/lidar/{sweep.sensor}", "foxglove.PointCloud", sweep.time_s, lambda s=sweep: self._sweep(s)
            )

    def _of_objects(self) -> Iterator[McapMessage]:
        moments = sorted(
            {frame.view.time_s for frame in self._scene.frames} | {sweep.time_s for sweep in self._scene.sweeps}
        )
        for moment in moments:
            yield McapMessage("/objects", "foxglove.SceneUpdate", moment, lambda t=moment: self._boxes(t))
            pose = self._scene.ego.pose_at(moment)
            if pose is not None:
                yield McapMessage("/ego", "foxglove.PoseInFrame", moment, lambda t=moment, p=pose: {
                    "timestamp": self.stamp(t), "frame_id": "world", "pose": _pose(p)})  # fmt: skip
                yield McapMessage(
                    "/tf",
                    "foxglove.FrameTransforms",
                    moment,
                    lambda t=moment, p=pose: self._transforms(t, [("ego", p)]),
                )

    def _transforms(self, time_s: float, frames: Sequence[tuple[str, NDArray[np.float64]]]) -> dict[str, Any]:
        return {"transforms": [
            {"timestamp": self.stamp(time_s), "parent_frame_id": "world", "child_frame_id": name, "translation": _pose(pose)["position"],
             "rotation": _pose(pose)["orientation"]} for name, pose in frames
        ]}  # fmt: skip

    def _calibration(self, view: View) -> dict[str, Any]:
        camera = view.camera
        k = camera.matrix
        return {
            "timestamp": self.stamp(view.time_s), "frame_id": f"camera/{camera.name}", "width": camera.width, "height": camera.height,
            "distortion_model": "", "D": [], "K": k.reshape(-1).tolist(), "R": np.eye(3).reshape(-1).tolist(),
            "P": np.column_stack([k, np.zeros(3)]).reshape(-1).tolist(),
        }  # fmt: skip

    def _image(self, frame: Frame) -> dict[str, Any]:
        ending = frame.image.path.rpartition(".")[2].lower()
        return {"timestamp": self.stamp(frame.view.time_s), "frame_id": f"camera/{frame.view.camera.name}",
                "format": {"jpg": "jpeg"}.get(ending, ending), "data": _base64(self._picture(frame))}  # fmt: skip

    def _sweep(self, sweep: Sweep) -> dict[str, Any]:
        points = self._points(sweep)
        rows = np.zeros(len(points.xyz), [("xyz", "<f4", 3), ("intensity", "<f4")])
        rows["xyz"], rows["intensity"] = points.xyz, points.intensity
        return self._cloud(sweep.time_s, f"lidar/{sweep.sensor}", rows, [("intensity", 12, 7)])

    def _fused_points(self) -> dict[str, Any]:
        cloud = self._fused
        count = 0 if cloud is None else len(cloud)
        rows = np.zeros(count, [("xyz", "<f4", 3), ("rgba", "u1", 4)])
        if cloud is not None:
            rows["xyz"], rows["rgba"] = cloud.xyz, np.column_stack([cloud.rgb, np.full(count, 255)])
        channels = [(name, 12 + index, 1) for index, name in enumerate(("red", "green", "blue", "alpha"))]
        return self._cloud(self.start_s, "world", rows, channels)

    def _cloud(self, time_s: float, frame: str, rows: NDArray[Any], more: list[tuple[str, int, int]]) -> dict[str, Any]:
        fields = [("x", 0, 7), ("y", 4, 7), ("z", 8, 7), *more]
        return {
            "timestamp": self.stamp(time_s), "frame_id": frame, "pose": _pose(np.eye(4)), "point_stride": rows.dtype.itemsize,
            "fields": [{"name": name, "offset": offset, "type": kind} for name, offset, kind in fields], "data": _base64(rows.tobytes()),
        }  # fmt: skip

    def _boxes(self, time_s: float) -> dict[str, Any]:
        entities = []
        for track in self._scene.tracks:
            pose = track.pose_at(time_s)
            if pose is None:
                continue
            color, above = (
                _color(track.label),
                pose @ geometry.yaw_matrix(0.0, (0, 0, float(track.size_m[2]) / 2 + 0.4)),
            )
            entities.append({
                "timestamp": self.stamp(time_s), "frame_id": "world", "id": track.id, "frame_locked": False,
                "lifetime": {"sec": 0, "nsec": round(BOX_LIFE_S * NANO)}, "metadata": [{"key": "class", "value": track.label}],
                "cubes": [{"pose": _pose(pose), "size": _vector(track.size_m), "color": {**color, "a": 0.4}}],
                "texts": [{"pose": _pose(above), "billboard": True, "font_size": 0.5, "scale_invariant": False,
                           "color": {"r": 1.0, "g": 1.0, "b": 1.0, "a": 1.0}, "text": f"{track.id} ({track.label})"}],
            })  # fmt: skip
        return {"deletions": [], "entities": entities}


def _vector(values: NDArray[np.floating]) -> dict[str, float]:
    return {"x": float(values[0]), "y": float(values[1]), "z": float(values[2])}


def _pose(matrix: NDArray[np.float64]) -> dict[str, Any]:
    w, x, y, z = geometry.quaternion_from_matrix(matrix).tolist()
    return {"position": _vector(matrix[:3, 3]), "orientation": {"x": x, "y": y, "z": z, "w": w}}


def _color(label: str) -> dict[str, float]:
    name = {"pedestrian": "person", "cyclist": "rider", "van": "car"}.get(label.lower(), label.lower())
    red, green, blue = DISPLAY_COLORS[ID[name]].tolist() if name in CLASSES else (160, 160, 160)
    return {"r": red / 255, "g": green / 255, "b": blue / 255}


def _base64(content: bytes) -> str:
    return base64.b64encode(content).decode("ascii")


# -- the container -------------------------------------------------------------------------------------------------------


def _text(value: str) -> bytes:
    return struct.pack("<I", len(value.encode())) + value.encode()


def _op(code: int, content: bytes) -> bytes:
    return struct.pack("<BQ", code, len(content)) + content


@dataclass
class _Chunk:
    """Messages that are written together."""

    records: list[bytes] = field(default_factory=list)
    size: int = 0
    index: dict[int, list[tuple[int, int]]] = field(default_factory=dict)

    def add(self, channel: int, moment: int, record: bytes) -> None:
        self.index.setdefault(channel, []).append((moment, self.size))
        self.records.append(record)
        self.size += len(record)


class McapBlocks:
    """The bytes of a file, block by block; no more than one chunk is in memory.

    Args:
        messages: in order of time. library: name of the program.
    """

    def __init__(self, messages: LogMessages, library: str) -> None:
        self._messages, self._library = messages, library
        self._place = 0
        self._channels: dict[str, tuple[int, str]] = {}
        self._counts: dict[int, int] = {}
        self._indexes: list[bytes] = []
        self._span = (0, 0)

    def __iter__(self) -> Iterator[bytes]:
        yield self._at(MAGIC + _op(_HEADER, _text("") + _text(self._library)))
        chunk = _Chunk()
        for message in self._messages:
            channel = self._channel(message)
            moment = self._messages.nanoseconds(message.time_s)
            text = json.dumps(message.value(), separators=(",", ":"), allow_nan=False).encode()
            number = self._counts[channel] = self._counts.get(channel, 0) + 1
            chunk.add(channel, moment, _op(_MESSAGE, struct.pack("<HIQQ", channel, number - 1, moment, moment) + text))
            if chunk.size >= CHUNK_BYTES:
                yield self._chunk(chunk)
                chunk = _Chunk()
        if chunk.records:
            yield self._chunk(chunk)
        yield self._at(_op(_END, struct.pack("<I", 0)))
        yield self._summary()

    def _at(self, content: bytes) -> bytes:
        self._place += len(content)
        return content

    def _channel(self, message: McapMessage) -> int:
        if message.topic not in self._channels:
            self._channels[message.topic] = (len(self._channels) + 1, message.schema)
        return self._channels[message.topic][0]

    def _definitions(self) -> tuple[bytes, bytes]:
        """Schema and channel records of all that occurred so far."""
        names = list(SCHEMAS)
        used = {schema for _, schema in self._channels.values()}
        schemas = b"".join(_op(_SCHEMA, struct.pack("<H", names.index(name) + 1) + _text(name) + _text("jsonschema")
                               + _text(json.dumps({"title": name, **SCHEMAS[name]}))) for name in names if name in used)  # fmt: skip
        channels = b"".join(
            _op(_CHANNEL, struct.pack("<HH", number, names.index(schema) + 1) + _text(topic) + _text("json") + struct.pack("<I", 0))
            for topic, (number, schema) in self._channels.items()
        )  # fmt: skip
        return schemas, channels

    def _chunk(self, chunk: _Chunk) -> bytes:
        """A chunk, with the definitions of its channels before its messages, and the index of each channel."""
        head = b"".join(self._definitions())
        records = head + b"".join(chunk.records)
        moments = [moment for entries in chunk.index.values() for moment, _ in entries]
        first, last = min(moments), max(moments)
        start = self._place
        self._span = (first if not self._indexes else min(self._span[0], first), max(self._span[1], last))
        body = _op(_CHUNK, struct.pack("<QQQI", first, last, len(records), zlib.crc32(records)) + _text("")
                   + struct.pack("<Q", len(records)) + records)  # fmt: skip
        offsets, index = b"", b""
        for channel, entries in chunk.index.items():
            offsets += struct.pack("<HQ", channel, start + len(body) + len(index))
            rows = b"".join(struct.pack("<QQ", moment, len(head) + offset) for moment, offset in entries)
            index += _op(_INDEX, struct.pack("<HI", channel, len(rows)) + rows)
        self._indexes.append(_op(_CHUNK_INDEX, struct.pack("<QQQQI", first, last, start, len(body), len(offsets)) + offsets
                                 + struct.pack("<Q", len(index)) + _text("") + struct.pack("<QQ", len(records), len(records))))  # fmt: skip
        return self._at(body + index)

    def _summary(self) -> bytes:
        schemas, channels = self._definitions()
        counts = b"".join(struct.pack("<HQ", channel, count) for channel, count in sorted(self._counts.items()))
        used = len({schema for _, schema in self._channels.values()})
        statistics = _op(_STATISTICS, struct.pack("<QHIIIIQQI", sum(self._counts.values()), used, len(self._channels), 0, 0,
                                                  len(self._indexes), *self._span, len(counts)) + counts)  # fmt: skip
        parts = (
            (_SCHEMA, schemas),
            (_CHANNEL, channels),
            (_STATISTICS, statistics),
            (_CHUNK_INDEX, b"".join(self._indexes)),
        )
        groups, place = b"", self._place
        for code, content in parts:
            if content:
                groups += _op(_OFFSET, struct.pack("<BQQ", code, place, len(content)))
                place += len(content)
        body = b"".join(content for _, content in parts) + groups
        footer = struct.pack("<BQQQ", _FOOTER, 20, self._place, place)
        checksum = zlib.crc32(body + footer)
        return self._at(body + footer + struct.pack("<I", checksum) + MAGIC)
