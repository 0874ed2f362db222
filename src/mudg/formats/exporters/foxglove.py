"""A driving log as messages that Foxglove shows: JSON with the names of Foxglove's schemas; pictures and points are
base64 inside.

    /tf  /ego  /objects  /camera/NAME/image  /camera/NAME/calibration  /lidar/NAME  /points (fused, once)
"""

from __future__ import annotations

import base64
import json
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from mudg.base import geometry
from mudg.base.types import Frame, Sweep, View
from mudg.formats.exporters.log_records import (
    BOX_LIFE_S,
    NANO,
    LogMessage,
    LogMessages,
    above,
    box_color,
    picture_format,
)

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
_LABEL: Final = _record(
    pose=_POSE,
    billboard={"type": "boolean"},
    font_size=_NUMBER,
    scale_invariant={"type": "boolean"},
    color=_COLOR,
    text=_TEXT,
)
_ENTITY: Final = _record(
    **_STAMPED,
    id=_TEXT,
    lifetime=_TIME,
    frame_locked={"type": "boolean"},
    metadata=_list(_record(key=_TEXT, value=_TEXT)),
    cubes=_list(_CUBE),
    texts=_list(_LABEL),
)

SCHEMAS: Final[Mapping[str, dict[str, Any]]] = {
    "foxglove.FrameTransforms": _record(
        transforms=_list(
            _record(timestamp=_TIME, parent_frame_id=_TEXT, child_frame_id=_TEXT, translation=_VECTOR, rotation=_TURN)
        )
    ),
    "foxglove.PoseInFrame": _record(**_STAMPED, pose=_POSE),
    "foxglove.CompressedImage": _record(**_STAMPED, data=_BYTES, format=_TEXT),
    "foxglove.CameraCalibration": _record(
        **_STAMPED,
        width={"type": "integer"},
        height={"type": "integer"},
        distortion_model=_TEXT,
        D=_list(_NUMBER),
        K=_list(_NUMBER),
        R=_list(_NUMBER),
        P=_list(_NUMBER),
    ),
    "foxglove.PointCloud": _record(
        **_STAMPED,
        pose=_POSE,
        point_stride={"type": "integer"},
        fields=_list(_record(name=_TEXT, offset={"type": "integer"}, type={"type": "integer"})),
        data=_BYTES,
    ),
    "foxglove.SceneUpdate": _record(deletions=_list(_record(timestamp=_TIME, id=_TEXT)), entities=_list(_ENTITY)),
}


class FoxgloveMessages(LogMessages):
    """The messages of a log for Foxglove."""

    schema_encoding, message_encoding = "jsonschema", "json"

    def __iter__(self) -> Iterator[LogMessage]:
        messages = [*self._of_cameras(), *self._of_sweeps(), *self._of_objects()]
        if self._log.fused is not None:
            messages.append(LogMessage("/points", "foxglove.PointCloud", self._log.start_s, self._fused_points))
        return iter(sorted(messages, key=lambda message: (message.time_s, message.topic)))

    def schema(self, name: str) -> str:
        """The text of a schema."""
        return json.dumps({"title": name, **SCHEMAS[name]})

    def content(self, message: LogMessage) -> bytes:
        """The bytes of a message."""
        return json.dumps(message.value(), separators=(",", ":"), allow_nan=False).encode()

    def _stamp(self, time_s: float) -> dict[str, int]:
        nanoseconds = self.nanoseconds(time_s)
        return {"sec": nanoseconds // NANO, "nsec": nanoseconds % NANO}

    def _of_cameras(self) -> Iterator[LogMessage]:
        for frame in self._scene.frames:
            name, view = frame.view.camera.name, frame.view
            yield LogMessage(
                "/tf",
                "foxglove.FrameTransforms",
                view.time_s,
                lambda v=view: self._transforms(v.time_s, [(f"camera/{v.camera.name}", v.world_from_cam)]),
            )
            yield LogMessage(
                f"/camera/{name}/calibration",
                "foxglove.CameraCalibration",
                view.time_s,
                lambda v=view: self._calibration(v),
            )
            yield LogMessage(
                f"/camera/{name}/image", "foxglove.CompressedImage", view.time_s, lambda f=frame: self._image(f)
            )

    def _of_sweeps(self) -> Iterator[LogMessage]:
        for sweep in self._scene.sweeps:
            place = [(f"lidar/{sweep.sensor}", sweep.world_from_lidar)]
            yield LogMessage(
                "/tf", "foxglove.FrameTransforms", sweep.time_s, lambda s=sweep, p=place: self._transforms(s.time_s, p)
            )
            yield LogMessage(
                f"/lidar/{sweep.sensor}", "foxglove.PointCloud", sweep.time_s, lambda s=sweep: self._sweep(s)
            )

    def _of_objects(self) -> Iterator[LogMessage]:
        for moment in self._log.moments():
            yield LogMessage("/objects", "foxglove.SceneUpdate", moment, lambda t=moment: self._boxes(t))
            pose = self._scene.ego.pose_at(moment)
            if pose is not None:
                yield LogMessage(
                    "/ego",
                    "foxglove.PoseInFrame",
                    moment,
                    lambda t=moment, p=pose: {"timestamp": self._stamp(t), "frame_id": "world", "pose": _pose(p)},
                )
                yield LogMessage(
                    "/tf",
                    "foxglove.FrameTransforms",
                    moment,
                    lambda t=moment, p=pose: self._transforms(t, [("ego", p)]),
                )

    def _transforms(self, time_s: float, frames: Sequence[tuple[str, NDArray[np.float64]]]) -> dict[str, Any]:
        return {
            "transforms": [
                {
                    "timestamp": self._stamp(time_s),
                    "parent_frame_id": "world",
                    "child_frame_id": name,
                    "translation": _pose(pose)["position"],
                    "rotation": _pose(pose)["orientation"],
                }
                for name, pose in frames
            ]
        }

    def _calibration(self, view: View) -> dict[str, Any]:
        camera = view.camera
        k = camera.matrix
        return {
            "timestamp": self._stamp(view.time_s),
            "frame_id": f"camera/{camera.name}",
            "width": camera.width,
            "height": camera.height,
            "distortion_model": "",
            "D": [],
            "K": k.reshape(-1).tolist(),
            "R": np.eye(3).reshape(-1).tolist(),
            "P": np.column_stack([k, np.zeros(3)]).reshape(-1).tolist(),
        }

    def _image(self, frame: Frame) -> dict[str, Any]:
        return {
            "timestamp": self._stamp(frame.view.time_s),
            "frame_id": f"camera/{frame.view.camera.name}",
            "format": picture_format(frame),
            "data": _base64(self._log.picture(frame)),
        }

    def _sweep(self, sweep: Sweep) -> dict[str, Any]:
        points = self._log.points(sweep)
        rows = np.zeros(len(points.xyz), [("xyz", "<f4", 3), ("intensity", "<f4")])
        rows["xyz"], rows["intensity"] = points.xyz, points.intensity
        return self._cloud(sweep.time_s, f"lidar/{sweep.sensor}", rows, [("intensity", 12, 7)])

    def _fused_points(self) -> dict[str, Any]:
        cloud = self._log.fused
        count = 0 if cloud is None else len(cloud)
        rows = np.zeros(count, [("xyz", "<f4", 3), ("rgba", "u1", 4)])
        if cloud is not None:
            rows["xyz"], rows["rgba"] = cloud.xyz, np.column_stack([cloud.rgb, np.full(count, 255)])
        channels = [(name, 12 + index, 1) for index, name in enumerate(("red", "green", "blue", "alpha"))]
        return self._cloud(self._log.start_s, "world", rows, channels)

    def _cloud(self, time_s: float, frame: str, rows: NDArray[Any], more: list[tuple[str, int, int]]) -> dict[str, Any]:
        fields = [("x", 0, 7), ("y", 4, 7), ("z", 8, 7), *more]
        return {
            "timestamp": self._stamp(time_s),
            "frame_id": frame,
            "pose": _pose(np.eye(4)),
            "point_stride": rows.dtype.itemsize,
            "fields": [{"name": name, "offset": offset, "type": kind} for name, offset, kind in fields],
            "data": _base64(rows.tobytes()),
        }

    def _boxes(self, time_s: float) -> dict[str, Any]:
        entities = []
        for track, pose in self._log.boxes(time_s):
            red, green, blue = box_color(track.label)
            entities.append(
                {
                    "timestamp": self._stamp(time_s),
                    "frame_id": "world",
                    "id": track.id,
                    "frame_locked": False,
                    "lifetime": {"sec": 0, "nsec": round(BOX_LIFE_S * NANO)},
                    "metadata": [{"key": "class", "value": track.label}],
                    "cubes": [
                        {
                            "pose": _pose(pose),
                            "size": _vector(track.size_m),
                            "color": {"r": red, "g": green, "b": blue, "a": 0.4},
                        }
                    ],
                    "texts": [
                        {
                            "pose": _pose(above(pose, track)),
                            "billboard": True,
                            "font_size": 0.5,
                            "scale_invariant": False,
                            "color": {"r": 1.0, "g": 1.0, "b": 1.0, "a": 1.0},
                            "text": f"{track.id} ({track.label})",
                        }
                    ],
                }
            )
        return {"deletions": [], "entities": entities}


def _vector(values: NDArray[np.floating]) -> dict[str, float]:
    return {"x": float(values[0]), "y": float(values[1]), "z": float(values[2])}


def _pose(matrix: NDArray[np.float64]) -> dict[str, Any]:
    w, x, y, z = geometry.quaternion_from_matrix(matrix).tolist()
    return {"position": _vector(matrix[:3, 3]), "orientation": {"x": x, "y": y, "z": z, "w": w}}


def _base64(content: bytes) -> str:
    return base64.b64encode(content).decode("ascii")
