"""nuScenes importer: one scene of a release (``v1.0-mini``, ``v1.0-trainval``, ``v1.0-test``), or one annotated key frame.

What is read, below the release's root:

============== ==========================================================================================
``v1.0-*``     the tables: scene, log, sample, sample_data, ego_pose, calibrated_sensor, sensor; and, where
               there are annotations, sample_annotation, instance, category, attribute
``samples``    images and sweeps of the key frames (2 Hz)
``sweeps``     those between: six cameras at 12 Hz, ``LIDAR_TOP`` at 20 Hz
============== ==========================================================================================

Each image and sweep has a vehicle pose of its own, at its own time; nothing is interpolated but the boxes between their
2 Hz key frames. Images are rectified by the publisher. Sweeps are compensated for the vehicle's motion inside the sensor, to the
end of the turn, which is the sweep's time stamp.

A sweep file has no point times. It holds columns of 32 returns in firing order, so the time of a point follows from its
column; where the columns are not complete, from its azimuth: the sensor turns clockwise in 50 ms and begins 93 degrees to the
left of forward. ``dt_s`` is therefore between -0.05 and 0. Returns from the recording vehicle itself, a quarter of all, are dropped.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from mudg.base import log
from mudg.base.errors import InputError
from mudg.base.types import Camera, Scene, Source, Track
from mudg.data.importers import common, drive_log, layout
from mudg.data.importers.box_tracks import BoxTracks
from mudg.data.importers.drive_log import DriveLog, ImageRecord, SweepRecord
from mudg.data.importers.layout import LogFiles
from mudg.data.importers.nuscenes import tables
from mudg.data.importers.nuscenes.sensors import CAMERAS, LICENCE, SENSOR, camera_from_intrinsics, read_scan
from mudg.data.importers.options import ImportOptions

Matrix = NDArray[np.float64]

LIDAR: Final = "LIDAR_TOP"
MAX_GAP_S: Final = 1.1
"""Boxes are annotated every 0.5 s; across one that is missing a track goes on, across two it does not."""
MICROSECONDS: Final = 10**6
_MAX_BEFORE_SCENE_S: Final = 1.0

LABELS: Final[Mapping[str, str]] = {
    "animal": "animal", "human.pedestrian.adult": "pedestrian", "human.pedestrian.child": "pedestrian",
    "human.pedestrian.construction_worker": "pedestrian", "human.pedestrian.personal_mobility": "pedestrian",
    "human.pedestrian.police_officer": "pedestrian", "human.pedestrian.stroller": "stroller",
    "human.pedestrian.wheelchair": "wheelchair", "movable_object.barrier": "barrier",
    "movable_object.debris": "debris", "movable_object.pushable_pullable": "pushable",
    "movable_object.trafficcone": "traffic_cone", "static_object.bicycle_rack": "bicycle_rack",
    "vehicle.bicycle": "bicycle", "vehicle.bus.bendy": "bus", "vehicle.bus.rigid": "bus", "vehicle.car": "car",
    "vehicle.construction": "construction_vehicle", "vehicle.emergency.ambulance": "van",
    "vehicle.emergency.police": "car", "vehicle.motorcycle": "motorcycle", "vehicle.trailer": "trailer",
    "vehicle.truck": "truck",
}  # fmt: skip
"""The release's categories -> labels."""
_RIDDEN: Final[Mapping[str, str]] = {"bicycle": "cyclist", "motorcycle": "motorcyclist"}
_WITH_RIDER: Final = "cycle.with_rider"


def looks_like_nuscenes(source: Path) -> bool:
    """Whether a folder holds nuScenes tables, or is a table folder."""
    return bool(_releases(source))


def import_nuscenes(source: Path, out: Path, options: ImportOptions) -> Scene:
    """Import one scene of a nuScenes release into the scene directory ``out``; see the module text for what is read.

    Args:
        source: the release's root, or its table folder.
        options: ``sequence`` names the scene (``scene-0061``, or ``v1.0-mini/scene-0061`` where several releases lie side
            by side); ``frames`` counts images of the first chosen camera; ``cameras`` by either name, all six by default.

    Raises:
        UsageError: the release holds several scenes and none was chosen, or there is no such scene or camera.
        InputError: something is missing, malformed or contradictory; nothing is left at ``out``.
    """
    if not source.is_dir():
        raise InputError("nuScenes folder does not exist", where=str(source), expected="a folder")
    layout.refuse_untwist(options, "nuScenes", str(source))
    releases = _releases(source)
    if not releases:
        raise InputError("no nuScenes tables found", where=str(source), got=layout.folder_contents(source),
            expected="v1.0-mini, v1.0-trainval or v1.0-test with scene.json and sample_data.json",
            remedy="give the folder that holds v1.0-*, samples and sweeps")  # fmt: skip
    return drive_log.write_log(read_log(releases, options), out, options)


def _releases(source: Path) -> list[Path]:
    """Table folders: ``source`` itself, or those called ``v1.0-...`` in it; smallest first."""
    folders = [source, *sorted(source.glob("v1.0-*"))] if source.is_dir() else []
    found = [f for f in folders if (f / "scene.json").is_file() and (f / "sample_data.json").is_file()]
    return sorted(found, key=lambda folder: (folder / "scene.json").stat().st_size)


def files_of_nuscenes(source: Path, _options: ImportOptions) -> LogFiles:
    """The tables, and which files there are beside them: which of those belong to a scene only the large tables know."""
    tables_of = tuple(table for folder in _releases(source) for table in sorted(folder.glob("*.json")))
    if not tables_of:
        return LogFiles((source,))
    root = tables_of[0].parent.parent
    sensors = [path for name in ("samples", "sweeps") for path in sorted(root.glob(f"{name}/*")) if path.is_dir()]
    return LogFiles(tables_of, tuple(sensors))


# --- one scene ------------------------------------------------------------------------------------------------------


def _all_of(folder: Path, name: str) -> tables.TokenTable:
    """A small table, complete."""
    path = folder / f"{name}.json"
    return tables.TokenTable(path, tables.iter_records(path))


def _those(folder: Path, name: str, field: str, values: set[str]) -> tables.TokenTable:
    """The records of a large table whose ``field`` is one of ``values``."""
    path = folder / f"{name}.json"
    return tables.TokenTable(path, tables.find_records(path, field, values))


def read_log(releases: Sequence[Path], options: ImportOptions) -> DriveLog:
    """What the tables tell about the chosen scene; no image or sweep is opened."""
    folder, scene = _choose_scene(releases, options)
    where = f"{folder}: {scene['name']}"
    log.info(f"nuscenes: {where}")
    samples = _samples_in_order(folder, scene)
    data = _those(folder, "sample_data", "sample_token", set(samples))
    sensors, calibrations = _all_of(folder, "sensor"), _all_of(folder, "calibrated_sensor")
    channel_of: dict[str, str] = {}
    for row in data.rows.values():
        calibration = calibrations.get(row, "calibrated_sensor_token", data.where)
        sensor = sensors.get(calibration, "sensor_token", calibrations.where)
        channel_of[row["token"]] = tables.text(sensor, "channel", sensors.where)
    there = {raw: name for raw, name in CAMERAS.items() if raw in channel_of.values()}
    chosen = {there[raw]: raw for raw in layout.chosen_cameras(there, options, where, tuple(CAMERAS))}
    layout.refuse_missing_cameras(there.values(), CAMERAS.values(), options, where)
    used = [row for row in data.rows.values() if channel_of[row["token"]] in (*chosen.values(), LIDAR)]
    _check_times(used, samples, data.where)
    used.sort(key=lambda row: row["timestamp"])
    ego_poses = _those(folder, "ego_pose", "token", {tables.text(r, "ego_pose_token", data.where) for r in used})
    zero_us = int(used[0]["timestamp"])
    reader = _RowReader(folder.parent, data.where, calibrations, ego_poses, zero_us)
    scene_name_of = {raw: name for name, raw in chosen.items()}
    images, sweeps = [], []
    rows_of: dict[str, tables.Row] = {}
    for row in used:
        channel = channel_of[row["token"]]
        if channel == LIDAR:
            sweeps.append(reader.sweep(row))
        else:
            images.append(reader.image(row, scene_name_of[channel]))
            rows_of.setdefault(channel, row)
    cameras = {name: reader.camera(rows_of[raw], name) for name, raw in chosen.items() if raw in rows_of}
    tracks, notes = _read_tracks(folder, samples, zero_us)
    if not sweeps:
        notes.append("no LiDAR sweeps in the tables")
    ego = common.ego_path([reader.time_s(r) for r in used], [reader.map_from_ego(r) for r in used])
    source = Source("nuscenes", LICENCE, None, (f"release {folder.name}, {scene['name']}", *notes))
    return DriveLog(str(scene["name"]), cameras, next(iter(chosen)), images, sweeps, tracks, ego, source, where)


def _choose_scene(releases: Sequence[Path], options: ImportOptions) -> tuple[Path, tables.Row]:
    wanted_release, _, wanted = options.sequence.rpartition("/")
    found: list[tuple[Path, tables.Row]] = []
    names: list[str] = []
    for folder in releases:
        if wanted_release and folder.name != wanted_release:
            continue
        for row in tables.iter_records(folder / "scene.json"):
            name = tables.text(row, "name", str(folder / "scene.json"))
            names.append(f"{folder.name}/{name}" if len(releases) > 1 else name)
            if wanted in ("", name, row.get("token")):
                found.append((folder, row))
    # the same scene may lie in two releases: the smaller one is quicker
    return layout.the_only(found[:1] if wanted else found, names, options, releases[0].parent, "scene")


def _samples_in_order(folder: Path, scene: tables.Row) -> dict[str, int]:
    """Key frames of a scene: token -> time stamp in microseconds, in the order of the chain."""
    where = str(folder / "scene.json")
    token = tables.text(scene, "token", where)
    samples = _those(folder, "sample", "scene_token", {token})
    at = tables.text(scene, "first_sample_token", where)
    stamps: dict[str, int] = {}
    while at:
        if at in stamps:
            raise InputError("the chain of key frames runs in a circle", where=samples.where, got=f"back at {at!r}")
        stamps[at] = tables.integer(samples.record(at, samples.where), "timestamp", samples.where)
        at = tables.text(samples.rows[at], "next", samples.where)
    values = np.array(list(stamps.values()), np.int64)
    common.check_epoch(values, MICROSECONDS, f"{samples.where}: timestamp")
    if (np.diff(values) <= 0).any():
        late = list(stamps)[int(np.flatnonzero(np.diff(values) <= 0)[0]) + 1]
        raise InputError("time stamps of key frames do not increase along the scene",
            where=f"{samples.where}: record {late!r}", got=f"{stamps[late]} after a later one",
            expected="microseconds, increasing from one key frame to the next", remedy="copy the table again")  # fmt: skip
    return stamps


def _check_times(rows: Sequence[tables.Row], samples: Mapping[str, int], where: str) -> None:
    """Stamps of images and sweeps are microseconds near their scene."""
    stamps = np.array([tables.integer(row, "timestamp", where) for row in rows], np.int64)
    common.check_epoch(stamps, MICROSECONDS, f"{where}: timestamp")
    first, last = min(samples.values()), max(samples.values())
    beside = np.maximum(first - stamps, stamps - last) / MICROSECONDS
    if len(beside) and beside.max() > _MAX_BEFORE_SCENE_S:
        raise InputError("an image or sweep lies outside its scene's time",
            where=f"{where}: record {rows[int(beside.argmax())]['token']!r}",
            got=f"{beside.max():.3f} s away from the key frames", expected="microseconds since 1970, within the scene")  # fmt: skip


@dataclass(frozen=True, slots=True, eq=False)
class _RowReader:
    """Records of ``sample_data`` to images and sweeps with their poses."""

    root: Path
    where: str
    calibrations: tables.TokenTable
    ego_poses: tables.TokenTable
    zero_us: int

    def time_s(self, row: tables.Row) -> float:
        return (int(row["timestamp"]) - self.zero_us) / MICROSECONDS

    def map_from_ego(self, row: tables.Row) -> Matrix:
        return _pose(self.ego_poses.get(row, "ego_pose_token", self.where), self.ego_poses.where)

    def map_from_sensor(self, row: tables.Row) -> Matrix:
        calibration = self.calibrations.get(row, "calibrated_sensor_token", self.where)
        return self.map_from_ego(row) @ _pose(calibration, self.calibrations.where)

    def file(self, row: tables.Row) -> Path:
        return layout.path_inside(self.root, row.get("filename"), f"{self.where}: record {row['token']!r}")

    def image(self, row: tables.Row, camera: str) -> ImageRecord:
        return ImageRecord(camera, self.time_s(row), self.map_from_sensor(row), self.file(row))

    def sweep(self, row: tables.Row) -> SweepRecord:
        path = self.file(row)
        return SweepRecord(SENSOR, self.time_s(row), self.map_from_sensor(row), path, partial(read_scan, path))

    def camera(self, row: tables.Row, name: str) -> Camera:
        calibration = self.calibrations.get(row, "calibrated_sensor_token", self.where)
        where = f"{self.calibrations.where}: record {calibration['token']!r}"
        size = tables.integer(row, "width", self.where), tables.integer(row, "height", self.where)
        return camera_from_intrinsics(name, size, calibration.get("camera_intrinsic"), where)


def _pose(row: tables.Row, where: str) -> Matrix:
    """Rigid f64[4, 4] of a record with ``rotation`` (w, x, y, z) and ``translation``."""
    rotation, translation = tables.numbers(row, "rotation", 4, where), tables.numbers(row, "translation", 3, where)
    return common.pose_from_quaternion(rotation, translation, f"{where}: record {row.get('token', '?')!r}")


# --- boxes ----------------------------------------------------------------------------------------------------------


def _read_tracks(folder: Path, samples: Mapping[str, int], zero_us: int) -> tuple[list[Track], list[str]]:
    """Tracks of the whole scene in the map's frame, and notes; a release without annotations has none."""
    if not (folder / "sample_annotation.json").is_file():
        return [], ["no annotations in this release: everything counts as static"]
    annotations = _those(folder, "sample_annotation", "sample_token", set(samples))
    instances = _those(folder, "instance", "token", {str(r.get("instance_token")) for r in annotations.rows.values()})
    categories = _all_of(folder, "category")
    attributes = _all_of(folder, "attribute") if (folder / "attribute.json").is_file() else None
    tracks = BoxTracks(annotations.where, LABELS, MAX_GAP_S)
    for row in annotations.rows.values():
        instance = instances.get(row, "instance_token", annotations.where)
        category = categories.get(instance, "category_token", instances.where)
        label = tracks.label_of(tables.text(category, "name", categories.where))
        if attributes is not None and label in _RIDDEN and _is_ridden(row, attributes):
            label = _RIDDEN[label]
        width, length, height = tables.numbers(row, "size", 3, annotations.where)  # in this order in the tables
        where = f"{annotations.where}: record {row['token']!r}"
        time_s = (samples[row["sample_token"]] - zero_us) / MICROSECONDS
        tracks.add(
            instance["token"], label, time_s, (length, width, height), _pose(row, annotations.where), where=where
        )
    return tracks.tracks()


def _is_ridden(row: tables.Row, attributes: tables.TokenTable) -> bool:
    tokens = row.get("attribute_tokens")
    return isinstance(tokens, list) and any(
        attributes.rows.get(token, {}).get("name") == _WITH_RIDER for token in tokens if isinstance(token, str)
    )
