"""Writes a scene as a Waymo log, format 1 or 2: what the importer reads, made the other way round.

``log_of`` turns a scene with one spinning LiDAR into a ``Log`` of plain values, which tests may change before
``write_tfrecord`` or ``write_parquet`` encodes it. The checksum is computed bit by bit and messages are built by hand,
so nothing here shares code with the reader.
"""

from __future__ import annotations

import io
import struct
import zlib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image
from roundtrip import mounts

from mudg.base.geometry import CAM_FROM_EGO_AXES, invert, transform_points, yaw_matrix, yaw_of
from mudg.base.types import Scene, Track
from mudg.scene.read import open_files, read_points

Matrix = NDArray[np.float64]
EPOCH_US = 1_553_735_853_462_203
GLOBAL_FROM_WORLD = yaw_matrix(0.7, (300.0, -200.0, 10.0))
CAMERA_NUMBERS = {"front": 1, "front_left": 2, "front_right": 3, "side_left": 4, "side_right": 5}
TYPE_NUMBERS = {"car": 1, "truck": 1, "bus": 1, "pedestrian": 2, "cyclist": 4}
LABELS = {"car": "vehicle", "truck": "vehicle", "bus": "vehicle", "pedestrian": "pedestrian", "cyclist": "cyclist"}
SHUTTER_S, READOUT_S = 0.002, 0.04
DIVISOR = 1000


@dataclass
class Log:
    """A log as plain values; frames hold ``timestamp_us, pose, images, lasers, boxes``."""

    name: str = "1024360143612057520_3580_000_3600_000"
    cameras: list[dict[str, Any]] = field(default_factory=list)
    lasers: list[dict[str, Any]] = field(default_factory=list)
    frames: list[dict[str, Any]] = field(default_factory=list)


def log_of(
    truth: Scene,
    moving: Sequence[Track],
    *,
    beams: NDArray[np.float64],
    columns: int,
    global_from_world: Matrix = GLOBAL_FROM_WORLD,
) -> Log:
    """The scene, cameras and one LiDAR that turns clockwise from behind in 0.1 s around each sweep's time, as a Waymo
    log. ``moving``: where the objects are at any time; a box stands where its object is when the LiDAR looks at it.
    ``beams``: elevations f64[H], radians, upwards; ``columns``: of the range images."""
    log, placed = Log(), mounts(truth)
    mount = placed[truth.sweeps[0].sensor]
    log.lasers.append(
        {"number": 1, "inclinations": beams, "min": float(beams[0]), "max": float(beams[-1]), "extrinsic": mount}
    )
    for name, camera in truth.cameras.items():
        intrinsic = [camera.fx, camera.fy, camera.cx, camera.cy, 0, 0, 0, 0, 0]
        facts = CAMERA_NUMBERS[name], camera.width, camera.height, intrinsic, placed[name] @ CAM_FROM_EGO_AXES
        log.cameras.append(named("number width height intrinsic extrinsic", *facts))
    for index, sweep in enumerate(truth.sweeps):
        pose = global_from_world @ truth.ego.pose_at(sweep.time_s)
        frame: dict[str, Any] = {"timestamp_us": EPOCH_US + round((sweep.time_s - 0.05) * 1e6), "pose": pose}
        frame["images"] = [_image(truth, name, index, global_from_world) for name in truth.cameras]
        frame["lasers"] = [_scan(truth, index, mount, beams, columns, global_from_world)]
        frame["boxes"] = _boxes(truth, moving, sweep.time_s)
        log.frames.append(frame)
    return log


def _image(truth: Scene, name: str, index: int, global_from_world: Matrix) -> dict[str, Any]:
    frame = truth.frames_of(name)[index]
    time = EPOCH_US / 1e6 + frame.view.time_s
    half, pose = (READOUT_S + SHUTTER_S) / 2, global_from_world @ truth.ego.pose_at(frame.view.time_s)
    facts = CAMERA_NUMBERS[name], open_files(truth.root).read(frame.image.path), pose, np.zeros(6), None
    times = named("pose_time shutter trigger done", time, SHUTTER_S, time - half, time + half)
    return named("number image pose velocity panoptic", *facts) | times


def _scan(
    truth: Scene, index: int, mount: Matrix, beams: NDArray[np.float64], columns: int, global_from_world: Matrix
) -> dict[str, Any]:
    """Range images by inverting the geometry: from where the LiDAR was when it measured a point, to beam, column and
    range."""
    sweep = truth.sweeps[index]
    points = read_points(truth, sweep)
    world = transform_points(sweep.world_from_lidar, points.xyz.astype(np.float64))
    column = np.round((points.dt_s + 0.05) / 0.1 * columns - 0.5).astype(int)
    vehicle = [truth.ego.pose_at(sweep.time_s - 0.05 + (c + 0.5) / columns * 0.1) for c in range(columns)]
    local = np.stack([invert(vehicle[c] @ mount)[:3] @ np.r_[p, 1] for c, p in zip(column, world, strict=True)])
    reach = np.linalg.norm(local, axis=1)
    row = len(beams) - 1 - np.abs(np.arcsin(local[:, 2] / reach)[:, None] - beams).argmin(1)
    returns = np.full((2, len(beams), columns, 4), -1, np.float32)
    second = (column % 5 == 0).astype(int)  # some points are second returns
    returns[second, row, column, 0] = reach
    returns[second, row, column, 1] = np.arctanh(np.minimum(points.intensity.astype(np.float64), 0.9999))
    poses = np.zeros((len(beams), columns, 6), np.float32)
    for c, pose in enumerate(vehicle):
        poses[:, c] = _roll_pitch_yaw(global_from_world @ pose)
    return {"number": 1, "returns": list(returns), "poses": poses}


def _roll_pitch_yaw(pose: Matrix) -> list[float]:
    roll = np.arctan2(pose[2, 1], pose[2, 2])
    pitch = np.arctan2(-pose[2, 0], np.hypot(pose[2, 1], pose[2, 2]))
    return [roll, pitch, np.arctan2(pose[1, 0], pose[0, 0]), *pose[:3, 3]]


def _boxes(truth: Scene, moving: Sequence[Track], time_s: float) -> list[dict[str, Any]]:
    vehicle = truth.ego.pose_at(time_s)
    own = {track.id: track for track in moving}
    boxes = []
    for track in truth.tracks:
        now = invert(vehicle) @ track.pose_at(time_s)
        late = ((0.5 - np.arctan2(now[1, 3], now[0, 3]) / (2 * np.pi)) % 1.0 - 0.5) * 0.1
        seen = own[track.id].pose_at(time_s + late)
        shown = now if seen is None else invert(vehicle) @ seen
        facts = track.id, TYPE_NUMBERS[track.label], shown[:3, 3], track.size_m, yaw_of(now)
        boxes.append(named("id type centre size heading", *facts))
    return boxes


def panoptic_png(ids: NDArray[np.integer]) -> bytes:
    """A 16-bit PNG."""
    buffer = io.BytesIO()
    Image.fromarray(ids.astype(np.uint16)).save(buffer, "PNG")
    return buffer.getvalue()


# --- format 1 -------------------------------------------------------------------------------------


def crc32c_bitwise(data: bytes) -> int:
    """CRC-32C by its definition, one bit after the other."""
    table = list(range(256))
    for _ in range(8):
        table = [(value >> 1) ^ (0x82F63B78 if value & 1 else 0) for value in table]
    crc = 0xFFFFFFFF
    for byte in data:
        crc = table[(crc ^ byte) & 0xFF] ^ (crc >> 8)
    return crc ^ 0xFFFFFFFF


def masked(data: bytes) -> int:
    """The checksum as stored."""
    crc = crc32c_bitwise(data)
    return ((crc >> 15 | crc << 17) + 0xA282EAD8) & 0xFFFFFFFF


def record(payload: bytes) -> bytes:
    """One TFRecord."""
    length = struct.pack("<Q", len(payload))
    return length + struct.pack("<I", masked(length)) + payload + struct.pack("<I", masked(payload))


def varint(value: int) -> bytes:
    """Base-128 number; negative ones as 64-bit two's complement."""
    value &= (1 << 64) - 1
    out = b""
    while value >= 0x80:
        out += bytes([value & 0x7F | 0x80])
        value >>= 7
    return out + bytes([value])


def number(tag: int, value: int) -> bytes:
    """An integer field."""
    return varint(tag << 3) + varint(value)


def double(tag: int, value: float) -> bytes:
    """A double field."""
    return varint(tag << 3 | 1) + struct.pack("<d", value)


def single(tag: int, value: float) -> bytes:
    """A float field."""
    return varint(tag << 3 | 5) + struct.pack("<f", value)


def text(tag: int, value: bytes) -> bytes:
    """A field of bytes, or a message."""
    return varint(tag << 3 | 2) + varint(len(value)) + value


def doubles(tag: int, values: Iterable[float]) -> bytes:
    """A repeated field of doubles, one key each."""
    return b"".join(double(tag, float(value)) for value in values)


def transform(tag: int, matrix: Matrix) -> bytes:
    """A Transform message."""
    return text(tag, doubles(1, np.asarray(matrix).ravel()))


def matrix_float(array: NDArray[np.float32]) -> bytes:
    """A packed and compressed MatrixFloat."""
    shape = b"".join(number(1, n) for n in array.shape)
    return zlib.compress(text(1, array.astype("<f4").tobytes()) + text(2, shape), 1)


def context_message(log: Log) -> bytes:
    """The Context message."""
    out = text(1, log.name.encode())
    for camera in log.cameras:
        lens = number(1, camera["number"]) + doubles(2, camera["intrinsic"]) + transform(3, camera["extrinsic"])
        out += text(2, lens + number(4, camera["width"]) + number(5, camera["height"]) + number(6, 2))
    for laser in log.lasers:
        beams = doubles(2, laser["inclinations"]) + double(3, laser["min"]) + double(4, laser["max"])
        out += text(3, number(1, laser["number"]) + beams + transform(5, laser["extrinsic"]))
    return out + text(4, text(2, b"Day"))  # statistics, which the importer does not read


def frame_message(log: Log, frame: dict[str, Any]) -> bytes:
    """The Frame message."""
    out = text(1, context_message(log)) + number(2, frame["timestamp_us"]) + transform(3, frame["pose"])
    for image in frame["images"]:
        velocity = b"".join(single(n + 1, v) for n, v in enumerate(image["velocity"][:3]))
        velocity += b"".join(double(n + 4, v) for n, v in enumerate(image["velocity"][3:]))
        message = number(1, image["number"]) + text(2, image["image"]) + transform(3, image["pose"]) + text(4, velocity)
        message += double(5, image["pose_time"]) + double(6, image["shutter"])
        message += double(7, image["trigger"]) + double(8, image["done"])
        if image["panoptic"] is not None:
            message += text(10, number(1, DIVISOR) + text(2, image["panoptic"]))
        out += text(4, message)
    for laser in frame["lasers"]:
        message = number(1, laser["number"])
        for index, image in enumerate(laser["returns"]):
            part = text(2, matrix_float(image))
            if index == 0 and laser.get("poses") is not None:
                part += text(4, matrix_float(laser["poses"]))
            message += text(2 + index, part)
        out += text(5, message)
    for box in frame["boxes"]:
        length, width, height = box["size"]
        fields = [*box["centre"], width, length, height, box["heading"]]
        message = text(1, b"".join(double(n + 1, v) for n, v in enumerate(fields)))
        message += text(2, double(1, 3.0)) + number(3, box["type"]) + text(4, box["id"].encode()) + number(7, 12)
        out += text(6, message)
    return out + text(9, number(1, 1))  # a field that the importer does not read


def write_tfrecord(log: Log, path: Path) -> Path:
    """The log as one TFRecord file."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(b"".join(record(frame_message(log, frame)) for frame in log.frames))
    return path


def write(log: Log, form: str, folder: Path) -> Path:
    """The log in format ``v1`` or ``v2``."""
    if form == "v1":
        return write_tfrecord(log, folder / f"segment-{log.name}_with_camera_labels.tfrecord")
    pytest.importorskip("pyarrow")
    return write_parquet(log, folder)


# --- format 2 -------------------------------------------------------------------------------------


def named(names: str, *values: Any) -> dict[str, Any]:
    """Values by their names."""
    return dict(zip(names.split(), values, strict=True))


CUBOID = [*(f"box.{part}.{axis}" for part in ("center", "size") for axis in "xyz"), "box.heading", "type"]
SPEEDS = [f"velocity.{kind}_velocity.{axis}" for kind in ("linear", "angular") for axis in "xyz"]
EXPOSURE = {"shutter": "shutter", "camera_trigger_time": "trigger", "camera_readout_done_time": "done"}
LENS = [f"intrinsic.{name}" for name in "f_u f_v c_u c_v k1 k2 p1 p2 k3".split()]


def write_parquet(log: Log, root: Path) -> Path:
    """The log as a folder of components; small row groups, so that reading crosses them."""
    import pyarrow as pa
    from pyarrow import parquet

    types = {"beam_inclination.values": pa.list_(pa.float64()), "type": pa.int8()}
    types |= {f"{name}.transform": pa.list_(pa.float64(), 16) for name in ("world_from_vehicle", "extrinsic", "pose")}
    types |= {f"range_image_return{n}.values": pa.list_(pa.float32()) for n in (1, 2)}
    types |= {f"range_image_return{n}.shape": pa.list_(pa.int32(), 3) for n in (1, 2)}
    tables: dict[str, list[dict[str, Any]]] = {}

    def add(
        component: str, title: str, values: dict[str, Any], frame: dict[str, Any] | None = None, **keys: Any
    ) -> None:
        """A row: keys, and values by their names within the component."""
        keys |= {} if frame is None else {"frame_timestamp_micros": frame["timestamp_us"]}
        row = {f"key.{name}": value for name, value in {"segment_context_name": log.name, **keys}.items()}
        row |= {f"[{title}Component].{name}": value for name, value in values.items()}
        tables.setdefault(component, []).append(row)

    def flat(number: int, array: Any) -> dict[str, Any]:
        parts = (None, None) if array is None else (array.astype(np.float32).ravel(), list(array.shape))
        return named(f"range_image_return{number}.values range_image_return{number}.shape", *parts)

    for camera in log.cameras:
        values = dict(zip(LENS, map(float, camera["intrinsic"]), strict=True)) | {"rolling_shutter_direction": 2}
        values |= {"width": camera["width"], "height": camera["height"]}
        values["extrinsic.transform"] = camera["extrinsic"].ravel()
        add("camera_calibration", "CameraCalibration", values, camera_name=camera["number"])
    for laser in log.lasers:
        names = "beam_inclination.min beam_inclination.max beam_inclination.values extrinsic.transform"
        beams = laser["min"], laser["max"], list(laser["inclinations"]) or None
        values = named(names, *beams, laser["extrinsic"].ravel())
        add("lidar_calibration", "LiDARCalibration", values, laser_name=laser["number"])
    for frame in log.frames:
        add("vehicle_pose", "VehiclePose", {"world_from_vehicle.transform": frame["pose"].ravel()}, frame)
        for image in frame["images"]:
            values = {"image": image["image"], "pose_timestamp": image["pose_time"]}
            values |= {f"rolling_shutter_params.{name}": image[ours] for name, ours in EXPOSURE.items()}
            values |= dict(zip(SPEEDS, image["velocity"], strict=True)) | {"pose.transform": image["pose"].ravel()}
            add("camera_image", "CameraImage", values, frame, camera_name=image["number"])
            if image["panoptic"] is not None:
                values = {"panoptic_label_divisor": DIVISOR, "panoptic_label": image["panoptic"]}
                add("camera_segmentation", "CameraSegmentationLabel", values, frame, camera_name=image["number"])
        for laser in frame["lasers"]:
            one, two = [*laser["returns"], None][:2]
            add("lidar", "LiDAR", flat(1, one) | flat(2, two), frame, laser_name=laser["number"])
            if laser.get("poses") is not None:
                add("lidar_pose", "LiDARPose", flat(1, laser["poses"]), frame, laser_name=laser["number"])
        for box in frame["boxes"]:
            values = *map(float, (*box["centre"], *box["size"], box["heading"])), box["type"]
            add("lidar_box", "LiDARBox", dict(zip(CUBOID, values, strict=True)), frame, laser_object_id=box["id"])
    for component, rows in tables.items():
        (root / component).mkdir(parents=True, exist_ok=True)
        arrays = {name: pa.array([row[name] for row in rows], types.get(name.split("].")[-1])) for name in rows[0]}
        parquet.write_table(pa.table(arrays), root / component / f"{log.name}.parquet", row_group_size=4)
    return root
