"""Argoverse 2 importer: one log of the sensor data set. What is read, and how: docs/formats/argoverse2.md,
docs/reference/formats.md. Images are rectified by the publisher: the coefficients k1 to k3 describe the original
lens and are kept for the record only."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from mudg.base import log
from mudg.base.errors import InputError
from mudg.base.geometry import invert, transform_points
from mudg.base.types import Camera, EgoPath, Scene, Source, SweepPoints, Track
from mudg.formats.importers import common, drive_log
from mudg.formats.importers.common import ImportOptions, LogFiles, name_table
from mudg.formats.importers.drive_log import BoxTracks, DriveLog, ImageRecord, SweepRecord
from mudg.formats.unknown_fields import note_unknown

Matrix = NDArray[np.float64]

LICENCE: Final = "CC BY-NC-SA 4.0 (Argoverse 2: Wilson et al.; attribution, non-commercial, share-alike)"
CAMERAS: Final[Mapping[str, str]] = name_table(
    """front: ring_front_center; front_left: ring_front_left; front_right: ring_front_right;
    side_left: ring_side_left; side_right: ring_side_right; rear_left: ring_rear_left;
    rear_right: ring_rear_right; stereo_left: stereo_front_left; stereo_right: stereo_front_right"""
)
RING_CAMERAS: Final = tuple(name for name in CAMERAS if name.startswith("ring"))
SENSOR: Final = "lidar"
_UPPER, _LOWER = "up_lidar", "down_lidar"
NANOSECONDS: Final = 10**9
_POSE_SLACK_S: Final = 0.02
_MAX_OFFSET_NS: Final = 500_000_000
_POSE: Final = ("qw", "qx", "qy", "qz", "tx_m", "ty_m", "tz_m")
_SIZE: Final = ("length_m", "width_m", "height_m")
SWEEPS: Final = "sensors/lidar/*.feather"
OFFICIAL: Final[Mapping[str, frozenset[str]]] = {
    "city_SE3_egovehicle.feather": frozenset({"timestamp_ns", *_POSE}),
    "egovehicle_SE3_sensor.feather": frozenset({"sensor_name", *_POSE}),
    "intrinsics.feather": frozenset("sensor_name fx_px fy_px cx_px cy_px k1 k2 k3 width_px height_px".split()),
    "annotations.feather": frozenset("timestamp_ns track_uuid category num_interior_pts log_id".split()).union(
        _SIZE, _POSE
    ),
    SWEEPS: frozenset({"x", "y", "z", "intensity", "laser_number", "offset_ns"}),
}
"""Tables -> their columns."""

LABELS: Final[Mapping[str, str]] = name_table(
    """car: REGULAR_VEHICLE; pedestrian: PEDESTRIAN, OFFICIAL_SIGNALER; bicycle: BICYCLE;
    rider: BICYCLIST, MOTORCYCLIST, WHEELED_RIDER; motorcycle: MOTORCYCLE; wheeled_device: WHEELED_DEVICE;
    bus: BUS, SCHOOL_BUS, ARTICULATED_BUS; truck: LARGE_VEHICLE, BOX_TRUCK, TRUCK, TRUCK_CAB;
    trailer: VEHICULAR_TRAILER; tram: RAILED_VEHICLE; stroller: STROLLER; wheelchair: WHEELCHAIR;
    animal: DOG, ANIMAL; bollard: BOLLARD; traffic_cone: CONSTRUCTION_CONE;
    construction_barrel: CONSTRUCTION_BARREL;
    traffic_sign: STOP_SIGN, SIGN, MOBILE_PEDESTRIAN_CROSSING_SIGN, MOBILE_PEDESTRIAN_SIGN;
    message_board_trailer: MESSAGE_BOARD_TRAILER; traffic_light_trailer: TRAFFIC_LIGHT_TRAILER"""
)
"""The data set's categories -> labels."""


def looks_like_argoverse2(source: Path) -> bool:
    """Whether a folder is an Argoverse 2 log, or holds some."""
    return bool(_logs(source))


def import_argoverse2(source: Path, out: Path, options: ImportOptions) -> Scene:
    """Import a log's folder, or one of a folder of logs. ``options.sequence``: a log's name, or its beginning;
    ``cameras`` by either name, the seven ring cameras by default. ResourceError: pyarrow is not installed."""
    folder = _choose_log(source, options)
    common.refuse_untwist(options, "Argoverse 2", str(source))
    return drive_log.write_log(read_log(folder, options), out, options)


def _logs(source: Path) -> dict[str, Path]:
    """Log folders by name: ``source`` itself, or its sub-folders."""
    here = (source / "city_SE3_egovehicle.feather").is_file()
    folders = [source] if here else sorted(path.parent for path in source.glob("*/city_SE3_egovehicle.feather"))
    return {folder.resolve().name: folder for folder in folders}


def _choose_log(source: Path, options: ImportOptions) -> Path:
    expected = "city_SE3_egovehicle.feather, calibration and sensors, here or in sub-folders"
    begins = lambda name: name.startswith(options.sequence)
    return common.the_only(_logs(source), options, source, "Argoverse 2 log", expected, begins)


def files_of_argoverse2(source: Path, options: ImportOptions) -> LogFiles:
    """The chosen log's folder."""
    return LogFiles((_choose_log(source, options),))


def read_log(folder: Path, options: ImportOptions) -> DriveLog:
    """What the log's tables and file names tell; no image or sweep is opened."""
    where = str(folder)
    log.info(f"argoverse2: {folder}")
    image_folder, sweep_folder = folder / "sensors" / "cameras", folder / "sensors" / "lidar"
    there = {raw: name for raw, name in CAMERAS.items() if (image_folder / raw).is_dir()}
    if not there:
        expected = "folders ring_front_center, ring_front_left, ... with images named by nanoseconds"
        remedy = "download the sensor data set's camera archives, too; a scene is made of images"
        raise InputError("the log has no images", where=str(image_folder), expected=expected, remedy=remedy)
    common.refuse_missing_cameras(there.values(), (CAMERAS[raw] for raw in RING_CAMERAS), options, image_folder)
    chosen = {there[raw]: raw for raw in common.chosen_cameras(there, options, where, RING_CAMERAS)}
    files = {name: _files_by_time(image_folder / raw, (".jpg", ".jpeg", ".png")) for name, raw in chosen.items()}
    scans = _files_by_time(sweep_folder, (".feather",))
    stamps = [stamp for found in (*files.values(), scans) for stamp in found]
    if not stamps:
        raise InputError("the log has no images", where=str(image_folder))
    zero_ns = min(stamps)

    def seconds(stamp: int) -> float:
        return (stamp - zero_ns) / NANOSECONDS

    ego_file, mount_file = folder / "city_SE3_egovehicle.feather", folder / "calibration/egovehicle_SE3_sensor.feather"
    notes: list[str] = []
    mounts, ego = read_mounts(mount_file), common.mended_path(read_ego(ego_file, zero_ns), notes)
    if options.skip_missing:
        for name, found in {**files, SENSOR: scans}.items():
            lost = [t for t in found if not common.has_pose(ego, seconds(t), _POSE_SLACK_S)]
            for stamp in lost:
                del found[stamp]
            if lost:
                log.warn(f"argoverse2: left out {len(lost)} files of {name} without a vehicle pose")

    def map_from_ego(stamp: int) -> Matrix:
        return common.pose_near(ego, seconds(stamp), _POSE_SLACK_S, str(ego_file))

    images = []
    for name, found in files.items():
        mount = _of_sensor(mounts, chosen[name], mount_file)
        images += [ImageRecord(name, seconds(t), map_from_ego(t) @ mount, path) for t, path in found.items()]
    upper = _of_sensor(mounts, _UPPER, mount_file) if scans else np.eye(4)
    places = [pose[:3, 3] for name, pose in mounts.items() if name in (_UPPER, _LOWER)]
    sweeps = [
        SweepRecord(SENSOR, seconds(t), map_from_ego(t) @ upper, path, partial(read_sweep, path, upper, places))
        for t, path in scans.items()
    ]
    notes += [] if sweeps else ["no LiDAR sweeps in the log"]
    tracks, track_notes = read_tracks(folder / "annotations.feather", ego, zero_ns, skip_missing=options.skip_missing)
    cameras = read_cameras(folder / "calibration" / "intrinsics.feather", chosen)
    source = Source("argoverse2", LICENCE, None, (*notes, *track_notes))
    name = folder.resolve().name
    return DriveLog(name, cameras, images, sweeps, tracks, ego, source, where)


def _files_by_time(folder: Path, suffixes: Sequence[str]) -> dict[int, Path]:
    """Files called by nanoseconds, in order of time."""
    found = common.numbered_files(folder, suffixes)
    common.check_epoch(np.array(list(found), np.int64), NANOSECONDS, f"{folder}: file names")
    return found


# --- tables ---------------------------------------------------------------------------------------


def read_feather(path: Path, columns: Sequence[str]) -> common.Columns:
    """Named columns of a Feather (Arrow IPC) file as arrays of one length. Raises ResourceError: pyarrow is not
    installed. InputError: missing, cut off, without one of the columns, or with empty values."""
    with common.arrow_files(path):
        import pyarrow.feather

        if not path.is_file():
            raise InputError("file not found", where=str(path), remedy="is the log complete?")
        table = pyarrow.feather.read_table(str(path), memory_map=False)
        common.require_columns(columns, table.schema.names, path)
        kind = path.name if path.name in OFFICIAL else SWEEPS
        note_unknown(kind, table.schema.names, OFFICIAL[kind])
        empty = [name for name in columns if table.column(name).null_count]
        if empty:
            raise InputError("table has rows without a value", where=f"{path}: {', '.join(empty)}")
        return {name: table.column(name).to_numpy() for name in columns}


def _stamps(columns: common.Columns, where: str) -> NDArray[np.int64]:
    stamps = columns["timestamp_ns"]
    if stamps.dtype.kind not in "iu":
        raise InputError("time stamps are not whole numbers", where=f"{where}: timestamp_ns", got=str(stamps.dtype))
    stamps = stamps.astype(np.int64)
    common.check_epoch(stamps, NANOSECONDS, f"{where}: timestamp_ns")
    return stamps


def _poses(columns: common.Columns, where: str) -> list[Matrix]:
    rows = common.finite_columns(columns, _POSE, where)
    return [common.pose_from_quaternion(row[:4], row[4:], f"{where}: row {index}") for index, row in enumerate(rows)]


def read_ego(path: Path, zero_ns: int) -> EgoPath:
    """Vehicle poses in the city's frame; times in seconds since ``zero_ns``."""
    columns = read_feather(path, ("timestamp_ns", *_POSE))
    stamps = _stamps(columns, str(path))
    if len(stamps) == 0:
        raise InputError("table of vehicle poses is empty", where=str(path))
    return common.ego_path([(int(t) - zero_ns) / NANOSECONDS for t in stamps], _poses(columns, str(path)))


def read_mounts(path: Path) -> dict[str, Matrix]:
    """Sensor name -> ego-from-sensor f64[4, 4]."""
    columns = read_feather(path, ("sensor_name", *_POSE))
    return dict(zip(map(str, columns["sensor_name"]), _poses(columns, str(path)), strict=True))


def _of_sensor(calibration: Mapping[str, Any], sensor: str, where: object) -> Any:
    if sensor not in calibration:
        raise InputError("calibration lacks a sensor", where=str(where), expected=sensor, got=", ".join(calibration))
    return calibration[sensor]


def read_cameras(path: Path, chosen: Mapping[str, str]) -> dict[str, Camera]:
    """Cameras by scene name. Pixel centres are whole numbers in the data set: half a pixel is added here.
    ``distortion`` is the original lens in OpenCV's order (k1, k2, p1, p2, k3); the images are rectified."""
    names = ("fx_px", "fy_px", "cx_px", "cy_px", "k1", "k2", "k3", "width_px", "height_px")
    columns = read_feather(path, ("sensor_name", *names))
    numbers = common.finite_columns(columns, names, path).tolist()
    rows = dict(zip(map(str, columns["sensor_name"]), numbers, strict=True))
    cameras = {}
    for name, raw in chosen.items():
        fx, fy, cx, cy, k1, k2, k3, width, height = _of_sensor(rows, raw, path)
        lens = (k1, k2, 0.0, 0.0, k3)
        cameras[name] = Camera(name, int(width), int(height), fx, fy, cx + 0.5, cy + 0.5, distortion=lens)
    return cameras


def read_tracks(path: Path, ego: EgoPath, zero_ns: int, *, skip_missing: bool = False) -> tuple[list[Track], list[str]]:
    """Tracks in the city's frame, and notes; no file is no tracks. ``skip_missing`` leaves out boxes without a vehicle
    pose."""
    where = str(path)
    if not path.is_file():
        return [], ["no annotations in this log: everything counts as static"]
    columns = read_feather(path, ("timestamp_ns", "track_uuid", "category", *_SIZE, *_POSE))
    stamps, poses = _stamps(columns, where), _poses(columns, where)
    sizes = common.finite_columns(columns, _SIZE, where)
    times_s = [(stamp - zero_ns) / NANOSECONDS for stamp in stamps.tolist()]
    map_from_ego = {
        time_s: common.pose_near(ego, time_s, _POSE_SLACK_S, where)
        for time_s in set(times_s)
        if not skip_missing or common.has_pose(ego, time_s, _POSE_SLACK_S)
    }
    tracks = BoxTracks(where, LABELS)
    for row, (time_s, pose) in enumerate(zip(times_s, poses, strict=True)):
        if time_s not in map_from_ego:
            continue
        label, track = tracks.label_of(str(columns["category"][row])), str(columns["track_uuid"][row])
        size, pose = tuple(sizes[row].tolist()), map_from_ego[time_s] @ pose
        tracks.add(track, label, time_s, size, pose, where=f"{where}: row {row}")
    return tracks.tracks()


def read_sweep(path: Path, ego_from_lidar: Matrix, places: Sequence[Matrix] = ()) -> SweepPoints:
    """A sweep in the frame of the upper LiDAR: xyz, intensity 0..1, seconds since the sweep's time. Beams without a
    return are left out: zeros of the vehicle's frame, and points at the LiDARs' ``places`` in it, f64[3] each. Raises
    InputError: missing, cut off, not finite, or with point times that are no nanoseconds of one turn."""
    where = str(path)
    columns = read_feather(path, ("x", "y", "z", "intensity", "offset_ns"))
    returns = common.returns_of(columns, where, places)
    columns = {name: values[returns] for name, values in columns.items()}
    xyz_ego = common.finite_columns(columns, ("x", "y", "z"), where)
    intensity = common.unit_intensity(common.finite_columns(columns, ("intensity",), where)[:, 0], 255, where)
    offset_ns = columns["offset_ns"]
    if offset_ns.dtype.kind not in "iu" or (np.abs(offset_ns.astype(np.int64)) > _MAX_OFFSET_NS).any():
        what, where = "point times are no nanoseconds of one turn", f"{where}: offset_ns"
        expected = "whole nanoseconds since the sweep's time, under half a second"
        raise InputError(what, where=where, expected=expected, got=f"{offset_ns.dtype}, up to {offset_ns.max():g}")
    xyz = transform_points(invert(ego_from_lidar), xyz_ego).astype(np.float32)
    dt_s = (offset_ns.astype(np.float64) / NANOSECONDS).astype(np.float32)
    return SweepPoints(xyz, intensity, dt_s, no_returns=int((~returns).sum()))
