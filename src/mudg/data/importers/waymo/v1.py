"""Waymo logs of format 1: one TFRecord file with a ``Frame`` message per record."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mudg.base import log
from mudg.base.errors import InputError
from mudg.data.importers.waymo.proto import CONTEXT, FRAME, parse_message
from mudg.data.importers.waymo.records import (
    CAMERAS,
    LABELS,
    LASERS,
    TOP,
    VELOCITY,
    CameraCalibration,
    CameraShot,
    FrameContent,
    FrameRecord,
    LaserCalibration,
    LaserScan,
    Panoptic,
    WaymoBox,
    checked_box,
    checked_shot,
    checked_transform,
    float_image,
    int_image,
)
from mudg.data.importers.waymo.tfrecord import RecordPlace, read_record, record_places


class TfrecordLog:
    """A TFRecord file. Opening it reads the wanted records once, compares all their checksums and keeps what is small.

    Args:
        path: the file.
        wanted: record numbers (first, end) to keep, or None.

    Raises:
        InputError: the file or a wanted record is damaged, or no Waymo frame.
    """

    form = "v1 TFRecord"

    def __init__(self, path: Path, wanted: tuple[int, int] | None = None) -> None:
        self._path = path
        self._places: dict[int, RecordPlace] = {}
        first, end = wanted or (0, None)
        places = list(islice(record_places(path), first, end))
        if not places:
            raise InputError(
                "no frames to import",
                where=str(path),
                expected="records" + (f" {first} to {end - 1}" if end is not None else ""),
                got="none",
            )
        frames: list[FrameRecord] = []
        context = b""
        with path.open("rb") as file, log.task("checking records", len(places)) as bar:
            for place in places:
                where = f"{path}: record {place.number} at byte {place.offset}"
                message = parse_message(read_record(file, path, place), FRAME, where)
                if not frames:
                    context = bytes(message.get("context", b""))
                    self._read_context(context, where)
                elif bytes(message.get("context", b"")) != context:
                    self._compare_context(bytes(message.get("context", b"")), where)
                frames.append(_frame_record(message, place.number, where))
                self._places[place.number] = place
                bar.advance()
        self.frames: Sequence[FrameRecord] = frames

    def _read_context(self, content: bytes, where: str) -> None:
        context = parse_message(content, CONTEXT, where)
        self.name = str(context.get("name", "")) or self._path.stem
        self.cameras: Mapping[str, CameraCalibration] = {
            CAMERAS[item["name"]]: _camera(item, where) for item in context["cameras"] if item.get("name", 0) in CAMERAS
        }
        self.lasers: Mapping[str, LaserCalibration] = {
            LASERS[item["name"]]: _laser(item, where) for item in context["lasers"] if item.get("name", 0) in LASERS
        }
        stats = context.get("stats", {})
        self.conditions = ", ".join(stats[key] for key in ("time_of_day", "weather", "location") if stats.get(key))

    def _compare_context(self, content: bytes, where: str) -> None:
        """Statistics may differ from frame to frame; the log and its calibrations may not."""
        context = parse_message(content, CONTEXT, where)
        if str(context.get("name", "")) not in ("", self.name):
            raise InputError("the file mixes two logs", where=where, expected=self.name, got=context["name"])
        for item in context["cameras"]:
            name = CAMERAS.get(item.get("name", 0))
            if name is not None and _camera(item, where) != self.cameras.get(name):
                raise InputError("a camera's calibration changes within the log", where=f"{where}: camera {name}")

    def read(self, frame: FrameRecord, cameras: Sequence[str], *, projections: bool = False) -> FrameContent:
        """The bulky parts of a frame; see ``WaymoLog``."""
        message = self._message(frame)
        images: dict[str, bytes] = {}
        panoptic: dict[str, Panoptic] = {}
        for item in message["images"]:
            name = CAMERAS.get(item.get("name", 0))
            if name not in cameras or name is None:
                continue
            images[name] = bytes(item.get("image", b""))
            label = item.get("panoptic", {})
            if label.get("png"):
                panoptic[name] = Panoptic(label.get("divisor", 0), bytes(label["png"]))
        scans = {
            LASERS[item["name"]]: _scan(item, f"{frame.where}: LiDAR {LASERS[item['name']]}", projections)
            for item in message["lasers"]
            if item.get("name", 0) in LASERS and _has_ranges(item)
        }
        return FrameContent(images, panoptic, scans)

    def pixel_poses(self, frame: FrameRecord) -> NDArray[np.float32] | None:
        """Poses of the top LiDAR's pixels f32[H, W, 6]; see ``WaymoLog``."""
        for item in self._message(frame)["lasers"]:
            if LASERS.get(item.get("name", 0)) == TOP and item.get("return1", {}).get("poses"):
                return float_image(item["return1"]["poses"], 6, f"{frame.where}: pixel poses")
        return None

    def _message(self, frame: FrameRecord) -> dict[str, Any]:
        with self._path.open("rb") as file:
            return parse_message(read_record(file, self._path, self._places[frame.number]), FRAME, frame.where)


def _has_ranges(laser: dict[str, Any]) -> bool:
    return bool(laser.get("return1", {}).get("ranges"))


def _transform(message: dict[str, Any], key: str, where: str) -> NDArray[np.float64]:
    return checked_transform(message.get(key, {}).get("values", np.zeros(0)), f"{where}: {key}")


def _camera(item: dict[str, Any], where: str) -> CameraCalibration:
    name = CAMERAS[item["name"]]
    where = f"{where}: calibration of camera {name}"
    intrinsic = tuple(float(v) for v in item["intrinsic"])
    if len(intrinsic) != 9 or not np.isfinite(intrinsic).all():
        raise InputError("intrinsics are incomplete", where=where, expected="9 finite numbers", got=str(intrinsic))
    return CameraCalibration(
        name,
        intrinsic,
        _transform(item, "extrinsic", where),
        item.get("width", 0),
        item.get("height", 0),
        item.get("direction", 0),
    )


def _laser(item: dict[str, Any], where: str) -> LaserCalibration:
    name = LASERS[item["name"]]
    where = f"{where}: calibration of LiDAR {name}"
    limits = (item.get("inclination_min", np.nan), item.get("inclination_max", np.nan))
    beams = tuple(float(v) for v in item["inclinations"])
    if not np.isfinite(beams or limits).all() or not (beams or limits[0] < limits[1]):
        raise InputError("beam inclinations make no sense", where=where, expected="radians", got=str(beams or limits))
    return LaserCalibration(name, beams, *limits, _transform(item, "extrinsic", where))


def _frame_record(message: dict[str, Any], number: int, where: str) -> FrameRecord:
    timestamp_us = message.get("timestamp_us", 0)
    shots: dict[str, CameraShot] = {}
    for item in message["images"]:
        name = CAMERAS.get(item.get("name", 0))
        if name is None or not item.get("image"):
            continue
        here = f"{where}: image of camera {name}"
        if name in shots:
            raise InputError("frame has two images of one camera", where=here)
        velocity = item.get("velocity")
        shot = CameraShot(
            _transform(item, "pose", here),
            item.get("pose_time_s", 0.0),
            None if velocity is None else np.array([velocity.get(key, 0.0) for key in VELOCITY]),
            item.get("shutter_s", 0.0),
            item.get("trigger_s", 0.0),
            item.get("done_s", 0.0),
        )
        shots[name] = checked_shot(shot, timestamp_us, here)
    lasers = tuple(
        LASERS[item["name"]] for item in message["lasers"] if item.get("name", 0) in LASERS and _has_ranges(item)
    )
    if len(set(lasers)) < len(lasers):
        raise InputError("frame has two scans of one LiDAR", where=where, got=", ".join(lasers))
    boxes = tuple(_box(item, where) for item in message["labels"])
    return FrameRecord(number, timestamp_us, _transform(message, "pose", where), shots, lasers, boxes, where)


def _box(item: dict[str, Any], where: str) -> WaymoBox:
    box = item.get("box", {})
    values = [box.get(key, np.nan) for key in ("x", "y", "z", "length", "width", "height")]
    found = WaymoBox(
        item.get("id", ""),
        LABELS.get(item.get("type", 0), "unknown"),
        (values[0], values[1], values[2]),
        (values[3], values[4], values[5]),
        box.get("heading", 0.0),
    )
    return checked_box(found, where)


def _scan(item: dict[str, Any], where: str, projections: bool) -> LaserScan:
    parts = [item[key] for key in ("return1", "return2") if item.get(key, {}).get("ranges")]
    returns = [float_image(part["ranges"], 4, where) for part in parts]
    packed = item["return1"].get("poses")
    poses = float_image(packed, 6, f"{where}: pixel poses") if packed else None
    found: list[NDArray[np.int64]] = []
    if projections and all(part.get("projections") for part in parts):
        found = [int_image(part["projections"], 6, f"{where}: camera projections") for part in parts]
    return LaserScan(returns, poses, found)
