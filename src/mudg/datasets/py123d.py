"""123D: one Arrow log per path, written by the package ``py123d`` itself.

Points are in the frame of its IMU, which is the vehicle's here. Size and wheel base of the vehicle are nominal.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from mudg.base import geometry, store
from mudg.base.errors import ResourceError
from mudg.datasets import nuscenes
from mudg.datasets.samples import LabelledView

FILES: Final = ("logs/*/*/*.arrow", "provenance.jsonl")
CAMERAS: Final = {
    "CAM_FRONT": "PCAM_F0",
    "CAM_BACK": "PCAM_B0",
    "CAM_FRONT_LEFT": "PCAM_L0",
    "CAM_LEFT": "PCAM_L1",
    "CAM_BACK_LEFT": "PCAM_L2",
    "CAM_FRONT_RIGHT": "PCAM_R0",
    "CAM_RIGHT": "PCAM_R1",
    "CAM_BACK_RIGHT": "PCAM_R2",
}
"""Channel -> its name for a camera; others get what is left, in the order of their names."""
LABELS: Final = {
    **dict.fromkeys(("car", "van", "vehicle", "truck", "bus", "trailer"), "VEHICLE"),
    **dict.fromkeys(("train", "tram"), "TRAIN"),
    **dict.fromkeys(("motorcycle", "bicycle", "cyclist", "rider", "bicyclist", "motorcyclist"), "TWO_WHEELER"),
    **dict.fromkeys(("person", "pedestrian", "adult", "child", "person_sitting"), "PERSON"),
}
"""Label -> its class of objects; all others are ``OTHER``."""
VEHICLE: Final = {"width": 1.9, "length": 4.8, "height": 1.6, "wheel_base": 2.8}
Row = Mapping[str, Any]


def library() -> Any:
    """The package. ResourceError: it is not installed."""
    try:
        import py123d
    except ImportError as error:
        what = "the format py123d needs the package of that name"
        raise ResourceError(what, expected="py123d 0.7", got=str(error), remedy="pip install 'mudg[py123d]'") from error
    return py123d


def write_view(folder: Path, view: LabelledView) -> dict[str, Any]:
    """Image, sweep and facts of a view as of nuScenes, until ``write_whole`` takes them into the log."""
    return {**nuscenes.write_view(folder, view), "camera": nuscenes.pose_row(view.view.world_from_cam)}


def write_whole(folder: Path, records: Sequence[Row]) -> None:
    """The logs, ``logs/mudg_<split>/<drive>-<path>/*.arrow``."""
    from py123d.api.scene.arrow.arrow_log_writer import ArrowLogWriter, LogMetadata
    from py123d.api.scene.arrow.utils.log_writer_config import LogWriterConfig
    from py123d.parser.base_dataset_parser import ModalitiesSync

    stored = LogWriterConfig(
        force_log_conversion=True, camera_store_option="png_binary", lidar_store_option="binary", lidar_codec="ipc_zstd"
    )
    writer = ArrowLogWriter(stored, folder / "logs", folder / "logs")
    for scene in dict.fromkeys(record["scene"] for record in records):
        own = [record for record in records if record["scene"] == scene]
        writer.reset(LogMetadata("mudg", f"mudg_{own[0]['split']}", scene, None))
        for index in sorted({record["index"] for record in own}):
            views = [record for record in own if record["index"] == index]
            writer.write_sync(ModalitiesSync(_time(views[0]), list(_modalities(folder, views))))
        writer.close()


def _modalities(folder: Path, views: Sequence[Row]) -> Iterator[Any]:
    """All that belongs to a moment: the vehicle, boxes, images, and the sweep."""
    from py123d.datatypes import sensors
    from py123d.datatypes.vehicle_state.ego_state import EgoStateSE3
    from py123d.datatypes.vehicle_state.ego_state_metadata import EgoStateSE3Metadata
    from py123d.geometry import PoseSE3
    from py123d.parser.base_dataset_parser import ParsedCamera

    now, nowhere = _time(views[0]), PoseSE3.identity()
    middle = PoseSE3(VEHICLE["wheel_base"] / 2, 0.0, VEHICLE["height"] / 2, 1.0, 0.0, 0.0, 0.0)
    about = EgoStateSE3Metadata("mudg", **VEHICLE, center_to_imu_se3=middle, rear_axle_to_imu_se3=nowhere)
    yield EgoStateSE3.from_imu(_pose(views[0]["ego"]), about, now)
    yield _boxes(views)
    names = cameras_of({view["channel"] for view in views})
    for view in views:
        (fx, _, cx), (_, fy, cy), _ = view["mount"]["camera_intrinsic"]
        about = {"camera_name": view["channel"], "camera_id": sensors.CameraID[names[view["channel"]]]}
        about |= {"width": view["width"], "height": view["height"], "camera_to_imu_se3": _pose(view["mount"])}
        lens = sensors.PinholeIntrinsics(fx=fx, fy=fy, cx=cx, cy=cy)
        camera = sensors.PinholeCameraMetadata(**about, intrinsics=lens, distortion=None, is_undistorted=True)
        image = store.read_bytes(folder / view["filename"])
        yield ParsedCamera(camera, _time(view), _pose(view["camera"]), byte_string=image)
        if "sweep" in view:
            yield _lidar(folder, view, now)


def _lidar(folder: Path, view: Row, now: Any) -> Any:
    from py123d.datatypes import sensors
    from py123d.datatypes.sensors.lidar import LidarFeature

    about = sensors.LidarMetadata("LIDAR_TOP", sensors.LidarID.LIDAR_TOP, _pose(view["lidar"]))
    rows = np.frombuffer(store.read_bytes(folder / view["sweep"]), "<f4").reshape(-1, 5)
    points = geometry.transform_points(_matrix(view["lidar"]), rows[:, :3]).astype(np.float32)
    columns = {LidarFeature.INTENSITY: rows[:, 3], LidarFeature.CHANNEL: rows[:, 4].clip(0, 255)}
    features = {name.serialize(): column.round().astype(np.uint8) for name, column in columns.items()}
    return sensors.Lidar(now, now, about, points, features)


def _boxes(views: Sequence[Row]) -> Any:
    """The objects of a moment, each as the first camera sees it."""
    from py123d.datatypes import detections
    from py123d.geometry import BoundingBoxSE3

    label_class = detections.DefaultBoxDetectionLabel
    about = detections.BoxDetectionsSE3Metadata(box_detection_label_class=label_class)
    found = {}
    for box in (box for view in views for box in view["boxes"]):
        width, length, height = box["size"]
        label = label_class[LABELS.get(box["label"], "OTHER")]
        attributes = detections.BoxDetectionAttributes(label, box["id"], box["returns"])
        bounds = BoundingBoxSE3(_pose(box), length=length, width=width, height=height)
        found.setdefault(box["id"], detections.BoxDetectionSE3(attributes, bounds, None))
    return detections.BoxDetectionsSE3(list(found.values()), _time(views[0]), about)


def cameras_of(channels: set[str]) -> dict[str, str]:
    """Name of a camera by channel; UsageError where a rig has more than the format knows."""
    free = [name for name in CAMERAS.values() if name not in {CAMERAS.get(channel) for channel in channels}]
    others = sorted(channels - CAMERAS.keys())
    if len(others) > len(free):
        what = "more cameras than the format py123d has names for"
        raise ResourceError(what, expected=f"at most {len(CAMERAS)}", got=str(len(channels)), remedy="--cameras")
    return {**CAMERAS, **dict(zip(others, free, strict=False))}


def _time(view: Row) -> Any:
    from py123d.datatypes.time.timestamp import Timestamp

    return Timestamp.from_us(view["time_us"])


def _matrix(row: Row) -> NDArray[np.float64]:
    turn = geometry.matrix_from_quaternion(np.array(row["rotation"]))
    return geometry.from_rotation_translation(turn, row["translation"])


def _pose(row: Row) -> Any:
    from py123d.geometry import PoseSE3

    return PoseSE3(*row["translation"], *row["rotation"])
