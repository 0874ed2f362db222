"""Waymo logs of format 2: a folder per component (``camera_image``, ``lidar``, ...) with one Parquet file per log.

Rows are read one at a time and in the order of the file, so that memory stays at one page of a column; the keys of all rows are
read first and tell which row belongs to which frame.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from types import ModuleType
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from mudg.base.errors import InputError, ResourceError
from mudg.data.importers.waymo.records import (
    CAMERAS,
    LABELS,
    LASERS,
    TOP,
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
    shaped,
)

_SEGMENT: Final = "key.segment_context_name"
_TIME: Final = "key.frame_timestamp_micros"
_CAMERA: Final = "key.camera_name"
_LASER: Final = "key.laser_name"
_OBJECT: Final = "key.laser_object_id"
_INTRINSIC: Final = ("f_u", "f_v", "c_u", "c_v", "k1", "k2", "p1", "p2", "k3")
_STREAM_BYTES: Final = 1 << 20

REQUIRED: Final = ("camera_image", "camera_calibration", "vehicle_pose")
"""Components without which there is no scene."""


class ParquetLog:
    """One log of a format-2 folder. Opening it reads all small tables and the keys of the large ones.

    Args:
        root: folder with the component folders.
        segment: name of the log, that of its files.
        wanted: frames (first, end) in the order of time, or None.

    Raises:
        InputError: a component is missing, or a table is damaged or contradictory.
        ResourceError: pyarrow is not installed.
    """

    form = "v2 Parquet"

    def __init__(self, root: Path, segment: str, wanted: tuple[int, int] | None = None) -> None:
        self._root, self.name = root, segment
        for component in REQUIRED:
            if self._path(component) is None:
                raise InputError(
                    "a component of the log is missing", where=str(root), expected=f"{component}/{segment}.parquet",
                    remedy="download it beside the others",
                )  # fmt: skip
        self.cameras: Mapping[str, CameraCalibration] = dict(_cameras(self._need("camera_calibration")))
        lidar, calibration = self._table("lidar"), self._table("lidar_calibration")
        if lidar is not None and calibration is None:
            raise InputError(
                "LiDAR has no calibration", where=str(root), expected=f"lidar_calibration/{segment}.parquet"
            )
        self.lasers: Mapping[str, LaserCalibration] = {} if calibration is None else dict(_lasers(calibration))
        self._images, self._lidar = self._need("camera_image"), lidar
        self._poses, self._labels = self._table("lidar_pose"), self._table("camera_segmentation")
        self._projections = self._table("lidar_camera_projection")
        if lidar is not None and self._poses is None:
            raise InputError(
                "the top LiDAR's pixel poses are missing", where=str(root), expected=f"lidar_pose/{segment}.parquet",
                remedy="download the component: without it the scans of a moving vehicle are twisted",
            )  # fmt: skip
        self.frames: Sequence[FrameRecord] = self._frames(wanted)
        self.conditions = self._conditions()

    def read(self, frame: FrameRecord, cameras: Sequence[str], *, projections: bool = False) -> FrameContent:
        """The bulky parts of a frame; see ``WaymoLog``. Reading frames in the order of time is fastest."""
        time = frame.timestamp_us
        images = {
            name: bytes(self._images.value(row, "[CameraImageComponent].image"))
            for name, row in self._images.rows(time, _CAMERA, CAMERAS)
            if name in cameras
        }
        panoptic: dict[str, Panoptic] = {}
        if self._labels is not None:
            for name, row in self._labels.rows(time, _CAMERA, CAMERAS):
                if name in cameras:
                    prefix = "[CameraSegmentationLabelComponent].panoptic_label"
                    png = self._labels.value(row, prefix)
                    panoptic[name] = Panoptic(int(self._labels.value(row, f"{prefix}_divisor")), bytes(png))
        scans: dict[str, LaserScan] = {}
        if self._lidar is not None:
            for name, row in self._lidar.rows(time, _LASER, LASERS):
                if name in frame.lasers:
                    scans[name] = self._scan(frame, name, row, projections)
        return FrameContent(images, panoptic, scans)

    def pixel_poses(self, frame: FrameRecord) -> NDArray[np.float32] | None:
        """Poses of the top LiDAR's pixels f32[H, W, 6]; see ``WaymoLog``."""
        if self._poses is not None:
            for name, row in self._poses.rows(frame.timestamp_us, _LASER, LASERS):
                if name == TOP:
                    return self._poses.image(row, "[LiDARPoseComponent].range_image_return1", 6)
        return None

    def _scan(self, frame: FrameRecord, name: str, row: int, projections: bool) -> LaserScan:
        if self._lidar is None:
            raise InputError("the log has no LiDAR", where=frame.where)
        found = [self._lidar.image(row, f"[LiDARComponent].range_image_return{n}", 4) for n in (1, 2)]
        returns = [image for image in found if image is not None]
        poses = self.pixel_poses(frame) if name == TOP else None
        if name == TOP and poses is None:
            raise InputError(
                "frame has no pixel poses", where=f"{frame.where}: lidar_pose", expected="a row for the top LiDAR"
            )
        places: list[NDArray[np.int64]] = []
        if projections and self._projections is not None:
            for other, place in self._projections.rows(frame.timestamp_us, _LASER, LASERS):
                if other == name:
                    columns = (
                        f"[LiDARCameraProjectionComponent].range_image_return{n + 1}" for n in range(len(returns))
                    )
                    images = (self._projections.image(place, column, 6) for column in columns)
                    places = [image.astype(np.int64) for image in images if image is not None]
        return LaserScan(returns, poses, places if len(places) == len(returns) else ())

    # --- facts ------------------------------------------------------------------------------------------------------

    def _frames(self, wanted: tuple[int, int] | None) -> list[FrameRecord]:
        poses = self._need("vehicle_pose").columns(
            (_SEGMENT, _TIME, "[VehiclePoseComponent].world_from_vehicle.transform")
        )
        where = str(self._path("vehicle_pose"))
        others = {str(name) for name in poses[_SEGMENT]} - {self.name}
        if others:
            raise InputError(
                "the file holds other logs", where=where, expected=self.name, got=", ".join(sorted(others)[:4])
            )
        times = [int(time) for time in poses[_TIME]]
        if len(set(times)) != len(times):
            raise InputError(
                "the table has a frame twice", where=f"{where}: {_TIME}", got=f"{len(times) - len(set(times))} times"
            )
        order = sorted(range(len(times)), key=times.__getitem__)
        chosen = list(enumerate(order))[slice(*wanted) if wanted else slice(None)]
        if not chosen:
            raise InputError(
                "no frames to import", where=where, got=f"{len(times)} frames", expected=f"frames {wanted}"
            )
        shots, boxes = self._shots(), self._boxes()
        lidar = self._lidar_frames()
        frames = []
        for number, row in chosen:
            here = f"{self._root}: {self.name}, frame {number}"
            pose = checked_transform(np.array(poses["[VehiclePoseComponent].world_from_vehicle.transform"][row]), here)
            time = times[row]
            found = {
                name: checked_shot(s, time, f"{here}: image of camera {name}")
                for name, s in shots.get(time, {}).items()
            }
            frames.append(FrameRecord(number, time, pose, found, lidar.get(time, ()), tuple(boxes.get(time, ())), here))
        return frames

    def _shots(self) -> dict[int, dict[str, CameraShot]]:
        prefix = "[CameraImageComponent]."
        params = f"{prefix}rolling_shutter_params."
        velocity = [f"{prefix}velocity.{kind}_velocity.{axis}" for kind in ("linear", "angular") for axis in "xyz"]
        names = (
            _TIME, _CAMERA, f"{prefix}pose.transform", f"{prefix}pose_timestamp", f"{params}shutter",
            f"{params}camera_trigger_time", f"{params}camera_readout_done_time", *velocity,
        )  # fmt: skip
        table = self._images.columns(names[:4], optional=names[4:])
        shots: dict[int, dict[str, CameraShot]] = {}
        for row, (time, number) in enumerate(zip(table[_TIME], table[_CAMERA], strict=True)):
            name = CAMERAS.get(number)
            if name is None:
                continue
            where = f"{self._images.path}: row {row}"
            if name in shots.setdefault(int(time), {}):
                raise InputError("frame has two images of one camera", where=where, got=name)
            speeds = [table[column][row] for column in velocity]
            shots[int(time)][name] = CameraShot(
                checked_transform(np.array(table[names[2]][row]), where),
                float(table[names[3]][row]),
                None if any(v is None for v in speeds) else np.array(speeds, np.float64),
                *(float(table[column][row] or 0.0) for column in names[4:7]),
            )
        return shots

    def _boxes(self) -> dict[int, list[WaymoBox]]:
        table = self._table("lidar_box")
        if table is None:
            return {}
        prefix = "[LiDARBoxComponent]."
        numbers = [f"{prefix}box.{part}.{axis}" for part in ("center", "size") for axis in "xyz"]
        found = table.columns((_TIME, _OBJECT, f"{prefix}type", f"{prefix}box.heading", *numbers))
        boxes: dict[int, list[WaymoBox]] = {}
        for row, time in enumerate(found[_TIME]):
            x, y, z, length, width, height = (float(found[name][row]) for name in numbers)
            box = WaymoBox(
                str(found[_OBJECT][row]), LABELS.get(found[f"{prefix}type"][row], "unknown"), (x, y, z),
                (length, width, height), float(found[f"{prefix}box.heading"][row]),
            )  # fmt: skip
            boxes.setdefault(int(time), []).append(checked_box(box, f"{table.path}: row {row}"))
        return boxes

    def _lidar_frames(self) -> dict[int, tuple[str, ...]]:
        if self._lidar is None:
            return {}
        keys = self._lidar.columns((_TIME, _LASER))
        found: dict[int, tuple[str, ...]] = {}
        for time, number in zip(keys[_TIME], keys[_LASER], strict=True):
            if number not in LASERS:
                continue
            others = found.get(int(time), ())
            if LASERS[number] in others:
                raise InputError("frame has two scans of one LiDAR", where=str(self._lidar.path), got=LASERS[number])
            found[int(time)] = (*others, LASERS[number])
        return found

    def _conditions(self) -> str:
        table = self._table("stats")
        if table is None:
            return ""
        names = tuple(f"[StatsComponent].{name}" for name in ("time_of_day", "weather", "location"))
        found = table.columns((), optional=names)
        return ", ".join(str(found[name][0]) for name in names if found[name] and found[name][0])

    def _path(self, component: str) -> Path | None:
        path = self._root / component / f"{self.name}.parquet"
        return path if path.is_file() else None

    def _table(self, component: str) -> Table | None:
        path = self._path(component)
        return None if path is None else Table(path)

    def _need(self, component: str) -> Table:
        return Table(self._root / component / f"{self.name}.parquet")


def _cameras(table: Table) -> Iterator[tuple[str, CameraCalibration]]:
    prefix = "[CameraCalibrationComponent]."
    intrinsic = [f"{prefix}intrinsic.{name}" for name in _INTRINSIC]
    rest = [f"{prefix}{name}" for name in ("extrinsic.transform", "width", "height", "rolling_shutter_direction")]
    found = table.columns((_CAMERA, *intrinsic, *rest[:3]), optional=rest[3:])
    for row, number in enumerate(found[_CAMERA]):
        name = CAMERAS.get(number)
        if name is None:
            continue
        where = f"{table.path}: camera {name}"
        values = tuple(float(found[column][row]) for column in intrinsic)
        if not np.isfinite(values).all():
            raise InputError("intrinsics are not finite", where=where, got=str(values))
        width, height, direction = (int(found[column][row] or 0) for column in rest[1:])
        transform = checked_transform(np.array(found[rest[0]][row]), where)
        yield name, CameraCalibration(name, values, transform, width, height, direction)


def _lasers(table: Table) -> Iterator[tuple[str, LaserCalibration]]:
    prefix = "[LiDARCalibrationComponent]."
    names = [
        f"{prefix}{name}"
        for name in ("extrinsic.transform", "beam_inclination.min", "beam_inclination.max", "beam_inclination.values")
    ]
    found = table.columns((_LASER, *names[:3]), optional=names[3:])
    for row, number in enumerate(found[_LASER]):
        name = LASERS.get(number)
        if name is None:
            continue
        where = f"{table.path}: LiDAR {name}"
        limits = (float(found[names[1]][row]), float(found[names[2]][row]))
        beams = tuple(float(value) for value in found[names[3]][row] or ())
        if not np.isfinite(beams or limits).all() or not (beams or limits[0] < limits[1]):
            raise InputError(
                "beam inclinations make no sense", where=where, expected="radians", got=str(beams or limits)
            )
        yield name, LaserCalibration(name, beams, *limits, checked_transform(np.array(found[names[0]][row]), where))


# --- tables ---------------------------------------------------------------------------------------------------------


class Table:
    """A Parquet file: whole columns of small values, or single large values row by row.

    Raises:
        InputError: not a Parquet file, damaged, or a column is missing.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._arrow, parquet = _pyarrow()
        with _reading(path, self._arrow):
            self._file = parquet.ParquetFile(
                path, buffer_size=_STREAM_BYTES, pre_buffer=False, page_checksum_verification=True
            )
        self._names = set(self._file.schema_arrow.names)
        counts = [self._file.metadata.row_group(n).num_rows for n in range(self._file.num_row_groups)]
        self._starts = np.concatenate([[0], np.cumsum(counts, dtype=np.int64)])
        self._by_time: dict[str, dict[int, list[tuple[str, int]]]] = {}
        self._streams: dict[tuple[str, ...], tuple[int, Iterator[Any]]] = {}

    def columns(self, names: Sequence[str], optional: Sequence[str] = ()) -> dict[str, list[Any]]:
        """Whole columns as lists of plain values; None may stand in the ``optional`` ones only."""
        self._check((*names, *optional))
        with _reading(self.path, self._arrow):
            found = self._file.read(columns=[*names, *optional])
            empty = [name for name in names if found.column(name).null_count]
            values = {name: found.column(name).to_pylist() for name in (*names, *optional)}
        if empty:
            row = values[empty[0]].index(None)
            raise InputError("table has an empty value", where=f"{self.path}: row {row}", got=", ".join(empty))
        return values

    def rows(self, timestamp_us: int, sensor: str, names: Mapping[int, str]) -> list[tuple[str, int]]:
        """Sensor names and rows of one frame, in the order of the file."""
        if sensor not in self._by_time:
            keys = self.columns((_TIME, sensor))
            by_time: dict[int, list[tuple[str, int]]] = {}
            for row, (time, number) in enumerate(zip(keys[_TIME], keys[sensor], strict=True)):
                if number in names:
                    by_time.setdefault(int(time), []).append((names[number], row))
            self._by_time[sensor] = by_time
        return self._by_time[sensor].get(timestamp_us, [])

    def value(self, row: int, column: str) -> Any:
        """One value as a plain one (bytes, number, list)."""
        value = self._row(row, (column,)).column(0)[0].as_py()
        if value is None:
            raise InputError("table has an empty value", where=f"{self.path}: row {row}", got=column)
        return value

    def image(self, row: int, prefix: str, channels: int) -> NDArray[np.float32] | None:
        """A range image [H, W, channels] kept as values and shape; None where it is not recorded."""
        found = self._row(row, (f"{prefix}.values", f"{prefix}.shape"))
        values, shape = found.column(0)[0], found.column(1)[0]
        if not values.is_valid or not shape.is_valid or len(values) == 0:
            return None
        data = values.values.to_numpy(zero_copy_only=False)
        return shaped(data, shape.as_py(), channels, f"{self.path}: row {row}, {prefix}")

    def _row(self, row: int, names: tuple[str, ...]) -> Any:
        """One row of some columns. Going forward goes on where the last call stopped; going back starts a row group anew."""
        self._check(names)
        next_row, stream = self._streams.get(names, (-1, iter(())))
        group = int(np.searchsorted(self._starts, row, side="right")) - 1
        with _reading(self.path, self._arrow):
            if next_row > row or next_row < self._starts[group]:
                groups = list(range(group, self._file.num_row_groups))
                stream = self._file.iter_batches(
                    batch_size=1, row_groups=groups, columns=list(names), use_threads=False
                )
                next_row = int(self._starts[group])
            batch = None
            while next_row <= row:
                batch = next(stream)
                next_row += 1
        self._streams[names] = (next_row, stream)
        if batch is None or batch.num_rows != 1:
            raise InputError("table has fewer rows than it declares", where=f"{self.path}: row {row}")
        return batch.select(list(names))

    def _check(self, names: Sequence[str]) -> None:
        missing = [name for name in names if name not in self._names]
        if missing:
            raise InputError(
                "table lacks columns", where=str(self.path), expected=", ".join(missing),
                got=", ".join(sorted(self._names)[:12]), remedy="is it this component, of version 2 of the data set?",
            )  # fmt: skip


def _pyarrow() -> tuple[ModuleType, ModuleType]:
    try:
        import pyarrow
        from pyarrow import parquet
    except ImportError as error:
        raise ResourceError(
            "Parquet files need the pyarrow package", got=str(error), remedy="pip install 'mudg[data]'"
        ) from error
    return pyarrow, parquet


class _reading:
    """Turns what pyarrow raises into an InputError that names the file."""

    def __init__(self, path: Path, arrow: ModuleType) -> None:
        self._path, self._kinds = path, (arrow.ArrowException, OSError, StopIteration)

    def __enter__(self) -> None:
        return None

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: object) -> None:
        if error is not None and isinstance(error, self._kinds):
            raise InputError(
                "Parquet file cannot be read", where=str(self._path), got=str(error)[:200] or "it ends early",
                remedy="copy the file again",
            ) from error  # fmt: skip
