"""nuScenes importer: one scene of a release (``v1.0-mini``, ``v1.0-trainval``, ``v1.0-test``), or one annotated key
frame. What is read, and how times are understood: docs/formats/nuscenes.md, docs/reference/formats.md. Returns from
the recording vehicle itself, a quarter of all, are dropped."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from mudg.base import log, store
from mudg.base.errors import InputError
from mudg.base.types import Camera, Scene, Source, SweepPoints, Track
from mudg.formats.importers import common, drive_log
from mudg.formats.importers.clouds import read_float_rows
from mudg.formats.importers.common import ImportOptions, LogFiles, name_table, unit_intensity
from mudg.formats.importers.drive_log import BoxTracks, DriveLog, ImageRecord, SweepRecord
from mudg.formats.unknown_fields import note_unknown

# nuScenes sensors: cameras from their intrinsics, and ``LIDAR_TOP`` files with the time of every point ----------------
LICENCE: Final = "CC BY-NC-SA 4.0 and the nuScenes terms of use (Motional; attribution, non-commercial, share-alike)"
CAMERAS: Final[Mapping[str, str]] = name_table(
    """front: CAM_FRONT; front_left: CAM_FRONT_LEFT; front_right: CAM_FRONT_RIGHT; back: CAM_BACK;
    back_left: CAM_BACK_LEFT; back_right: CAM_BACK_RIGHT"""
)
SENSOR: Final = "lidar_top"
TURN_PERIOD_S: Final = 0.05
BEAMS: Final = 32
_FIRST_AZIMUTH_RAD: Final = np.deg2rad(-177.0)
"""Where a turn begins, in the LiDAR's axes (x right, y forward)."""
_OWN_VEHICLE_M: Final = ((-1.05, 1.05), (-2.2, 3.1), (-2.2, 0.5))
"""The recording car in the LiDAR's axes: x right, y forward, z up."""


def read_scan(path: Path) -> SweepPoints:
    """A ``LIDAR_TOP`` file: float32 rows x, y, z, intensity (0..255), ring; LiDAR axes x right, y forward, z up.
    Returns of the recording vehicle are dropped, and beams without a return, which are counted; intensity becomes 0..1.
    Raises InputError: cut off, not finite, or rings that no 32-beam sensor has."""
    rows, returns = read_float_rows(path, 5, "sweep")
    rings = rows[returns, 4]
    if len(rings) and ((rings < 0) | (rings >= BEAMS) | (rings != np.round(rings))).any():
        what, got = "fifth value of the points is no ring number", f"{rings.min():g} to {rings.max():g}"
        remedy = "is this a file of another sensor or format?"
        raise InputError(what, where=str(path), expected=f"whole numbers 0 to {BEAMS - 1}", got=got, remedy=remedy)
    dt_s = point_times(rows[:, :3], rows[:, 4])
    own = np.ones(len(rows), bool)
    for axis, (low, high) in enumerate(_OWN_VEHICLE_M):
        own &= (rows[:, axis] > low) & (rows[:, axis] < high)
    chosen = returns & ~own
    xyz, intensity = np.ascontiguousarray(rows[chosen, :3]), unit_intensity(rows[chosen, 3], 255, path)
    return SweepPoints(xyz, intensity, dt_s[chosen], no_returns=int((~returns).sum()))


def point_times(xyz: NDArray[np.float32], rings: NDArray[np.float32]) -> NDArray[np.float32]:
    """When each point was measured, f32[N] seconds relative to the end of the turn (-0.05..0).

    By column where all 32 returns of every column are there in firing order, else by azimuth."""
    columns = len(rings) // BEAMS
    if columns > 1 and len(rings) == columns * BEAMS and (rings.reshape(-1, BEAMS) == np.arange(BEAMS)).all():
        fraction = (np.arange(len(rings)) // BEAMS + 1) / columns
    else:
        azimuth = np.arctan2(xyz[:, 1].astype(np.float64), xyz[:, 0].astype(np.float64))
        fraction = np.mod(_FIRST_AZIMUTH_RAD - azimuth, 2 * np.pi) / (2 * np.pi)
    return ((fraction - 1) * TURN_PERIOD_S).astype(np.float32)


# tables -------------------------------------------------------------------------------------------
#
# JSON arrays of flat records. Two tables of the full release are large (``sample_data.json`` and ``ego_pose.json`` hold
# 2.6 million records each). What an import needs of them is one scene, so their records are found by the value of one
# field while the file passes through a buffer of a few megabytes; only matching records become Python objects.
_BUFFER_BYTES: Final = 1 << 22
_MAX_RECORD_BYTES: Final = 1 << 20
_TOKEN: Final = re.compile(r"[A-Za-z0-9_\-]{1,128}")

OFFICIAL: Final[Mapping[str, frozenset[str]]] = {
    f"{name}.json": frozenset(f"token {fields}".split())
    for name, fields in {
        "attribute": "name description",
        "calibrated_sensor": "sensor_token translation rotation camera_intrinsic",
        "category": "name description index",
        "ego_pose": "timestamp translation rotation",
        "instance": "category_token nbr_annotations first_annotation_token last_annotation_token",
        "sample": "timestamp scene_token next prev",
        "sample_annotation": "sample_token instance_token attribute_tokens visibility_token translation size rotation "
        "num_lidar_pts num_radar_pts next prev",
        "sample_data": "sample_token ego_pose_token calibrated_sensor_token filename fileformat width height timestamp "
        "is_key_frame next prev",
        "scene": "name description log_token nbr_samples first_sample_token last_sample_token",
        "sensor": "channel modality",
    }.items()
}
"""Tables that are read -> their fields. Source: the release's published schema; ``index`` came with
nuScenes-lidarseg."""

Row = dict[str, Any]


def read_table(path: Path) -> list[Row]:
    """All records of a table. Raises InputError: missing, no JSON, or not an array of objects."""
    rows = store.read_json(_there(path))
    if not isinstance(rows, list) or not all(isinstance(row, dict) for row in rows):
        raise InputError("table is not an array of records", where=str(path), expected="[ {...}, ... ]")
    for row in rows:
        _note_fields(row, path)
    return rows


def find_records(path: Path, name: str, values: Collection[str], *, buffer_bytes: int = _BUFFER_BYTES) -> Iterator[Row]:
    """Records whose text field ``name`` is one of ``values``, in file order.

    Records that do not match are not parsed: the field is looked for in the bytes, and the record around a hit, from
    brace to brace, is cut out and parsed strictly. The file's first and last character are checked, so that a cut-off
    table is noticed. ``values`` are tokens: texts without escapes. Raises InputError: no JSON array, a matching record
    that is malformed or holds braces, or the file is cut off."""
    wanted = {value.encode() for value in values}
    hit = re.compile(rb'"' + re.escape(name.encode()) + rb'"\s*:\s*"([^"\\]*)"')
    with store.open_file(_there(path)) as file:
        buffer, offset, piece = file.read(buffer_bytes), 0, b" "
        if buffer.lstrip()[:1] != b"[":
            what, got = "table does not start as a JSON array", repr(buffer[:20]) if buffer else "an empty file"
            raise InputError(what, where=str(path), expected="[ {...}, ... ]", got=got, remedy="copy the table again")
        while piece:
            piece = file.read(buffer_bytes)
            buffer += piece
            # what follows the last closing brace may be half a record: it waits for the next piece
            end = buffer.rfind(b"}") + 1
            for match in hit.finditer(buffer, 0, end):
                if match[1] in wanted:
                    start = max(0, buffer.rfind(b"{", 0, match.start()))
                    record = buffer[start : buffer.find(b"}", match.end()) + 1]
                    row = store.parse_json(record, f"{path}: byte {offset + start}")
                    _note_fields(row, path)
                    yield row
            if not piece and not buffer.rstrip().endswith(b"]"):
                expected, remedy = "a JSON array closed by ]", "copy the table again"
                raise InputError("table is cut off", where=str(path), expected=expected, remedy=remedy)
            if len(buffer) - end > _MAX_RECORD_BYTES + buffer_bytes:
                what, expected = "table is not an array of records", "flat records {...} of less than 1 MiB"
                where, got = f"{path}: byte {offset + end}", repr(buffer[end : end + 20])
                raise InputError(what, where=where, got=got, expected=expected)
            buffer, offset = buffer[end:], offset + end


def _note_fields(row: Row, path: Path) -> None:
    if path.name in OFFICIAL:
        note_unknown(path.name, row, OFFICIAL[path.name])


def _there(path: Path) -> Path:
    if not path.exists():
        what = "table is missing"
        raise InputError(what, where=str(path), remedy="unpack the release's metadata archive, which holds all tables")
    return path


# --- rows -----------------------------------------------------------------------------------------


def field(row: Row, key: str, where: str, kind: type, count: int = 0) -> Any:
    """A field of a kind (float: any number), or a list of ``count`` such."""
    found, kinds = row.get(key), (int, float) if kind is float else kind
    items = found if count and isinstance(found, list) else [found]
    if len(items) != (count or 1) or not all(isinstance(one, kinds) and not isinstance(one, bool) for one in items):
        what, where = f"field {key!r} is missing or malformed", f"{where}: record {row.get('token', '?')!r}"
        expected = f"{count} numbers" if count else {str: "a text", int: "an integer"}[kind]
        raise InputError(what, where=where, expected=expected, got=repr(found))
    return found


class TokenTable:
    """Records of one table by their token; asking for one that is not there names who refers to it."""

    def __init__(self, path: Path, records: Iterable[Row]) -> None:
        self.where = str(path)
        self.rows: dict[str, Row] = {}
        for row in records:
            token = row.get("token")
            if not isinstance(token, str) or not _TOKEN.fullmatch(token):
                raise InputError("record has no token", where=self.where, got=repr(token)[:80])
            if self.rows.setdefault(token, row) is not row:
                raise InputError("two records have one token", where=self.where, got=token)

    def record(self, token: Any, where: str) -> Row:
        """The record of a token; ``where`` says who refers to it."""
        if not isinstance(token, str) or token not in self.rows:
            what, remedy = "a token points nowhere", "are the tables of one release, and complete?"
            raise InputError(what, where=where, got=repr(token), expected=f"a record of {self.where}", remedy=remedy)
        return self.rows[token]

    def get(self, row: Row, key: str, where: str) -> Row:
        """The record that field ``key`` of ``row`` (in table ``where``) refers to."""
        return self.record(row.get(key), f"{where}: record {row.get('token', '?')!r}: {key}")


# importer -----------------------------------------------------------------------------------------
Matrix = NDArray[np.float64]

LIDAR: Final = "LIDAR_TOP"
MAX_GAP_S: Final = 1.1
"""Boxes are annotated every 0.5 s; across one that is missing a track goes on, across two it does not."""
MICROSECONDS: Final = 10**6
_MAX_BEFORE_SCENE_S: Final = 1.0

LABELS: Final[Mapping[str, str]] = name_table(
    """animal: animal;
    pedestrian: human.pedestrian.adult, human.pedestrian.child, human.pedestrian.construction_worker,
        human.pedestrian.personal_mobility, human.pedestrian.police_officer;
    stroller: human.pedestrian.stroller; wheelchair: human.pedestrian.wheelchair;
    barrier: movable_object.barrier; debris: movable_object.debris;
    pushable: movable_object.pushable_pullable; traffic_cone: movable_object.trafficcone;
    bicycle_rack: static_object.bicycle_rack; bicycle: vehicle.bicycle;
    bus: vehicle.bus.bendy, vehicle.bus.rigid; car: vehicle.car, vehicle.emergency.police;
    construction_vehicle: vehicle.construction; van: vehicle.emergency.ambulance;
    motorcycle: vehicle.motorcycle; trailer: vehicle.trailer; truck: vehicle.truck"""
)
"""The release's categories -> labels."""
_RIDDEN: Final[Mapping[str, str]] = {"bicycle": "cyclist", "motorcycle": "motorcyclist"}
_WITH_RIDER: Final = "cycle.with_rider"


def looks_like_nuscenes(source: Path) -> bool:
    """Whether a folder holds nuScenes tables, or is a table folder."""
    return bool(_releases(source))


def import_nuscenes(source: Path, out: Path, options: ImportOptions) -> Scene:
    """Import one scene of a release: its root, or its table folder. ``options.sequence``: the scene (``scene-0061``, or
    ``v1.0-mini/scene-0061`` where several releases lie side by side); ``cameras`` by either name, all six by
    default."""
    common.refuse_untwist(options, "nuScenes", str(source))
    return drive_log.write_log(read_log(source, options), out, options)


def _releases(source: Path) -> list[Path]:
    """Table folders: ``source`` itself, or those called ``v1.0-...`` in it; smallest first."""
    folders = [source, *sorted(source.glob("v1.0-*"))] if source.is_dir() else []
    found = [f for f in folders if (f / "scene.json").is_file() and (f / "sample_data.json").is_file()]
    return sorted(found, key=lambda folder: (folder / "scene.json").stat().st_size)


def files_of_nuscenes(source: Path, _options: ImportOptions) -> LogFiles:
    """The tables, and which files there are beside them: which of those belong to a scene only the large tables
    know."""
    tables_of = tuple(table for folder in _releases(source) for table in sorted(folder.glob("*.json")))
    if not tables_of:
        return LogFiles((source,))
    root = tables_of[0].parent.parent
    sensors = [path for name in ("samples", "sweeps") for path in sorted(root.glob(f"{name}/*")) if path.is_dir()]
    return LogFiles(tables_of, tuple(sensors))


# --- one scene ------------------------------------------------------------------------------------


def _all_of(folder: Path, name: str) -> TokenTable:
    """A small table, complete."""
    path = folder / f"{name}.json"
    return TokenTable(path, read_table(path))


def _those(folder: Path, name: str, key: str, values: set[str]) -> TokenTable:
    """The records of a large table whose field ``key`` is one of ``values``."""
    path = folder / f"{name}.json"
    return TokenTable(path, find_records(path, key, values))


def read_log(source: Path, options: ImportOptions) -> DriveLog:
    """What the tables tell about the chosen scene; no image or sweep is opened."""
    folder, scene = _choose_scene(source, options)
    where = f"{folder}: {scene['name']}"
    log.info(f"nuscenes: {where}")
    samples = _samples_in_order(folder, scene)
    data = _those(folder, "sample_data", "sample_token", set(samples))
    sensors, calibrations = _all_of(folder, "sensor"), _all_of(folder, "calibrated_sensor")
    channel_of: dict[str, str] = {}
    for row in data.rows.values():
        calibration = calibrations.get(row, "calibrated_sensor_token", data.where)
        sensor = sensors.get(calibration, "sensor_token", calibrations.where)
        channel_of[row["token"]] = field(sensor, "channel", sensors.where, str)
    there = {raw: name for raw, name in CAMERAS.items() if raw in channel_of.values()}
    chosen = {there[raw]: raw for raw in common.chosen_cameras(there, options, where, tuple(CAMERAS))}
    common.refuse_missing_cameras(there.values(), CAMERAS.values(), options, where)
    used = [row for row in data.rows.values() if channel_of[row["token"]] in (*chosen.values(), LIDAR)]
    _check_times(used, samples, data.where)
    used.sort(key=lambda row: row["timestamp"])
    ego_poses = _those(folder, "ego_pose", "token", {field(r, "ego_pose_token", data.where, str) for r in used})
    zero_us = int(used[0]["timestamp"])

    def time_s(row: Row) -> float:
        return (int(row["timestamp"]) - zero_us) / MICROSECONDS

    def map_from_ego(row: Row) -> Matrix:
        return _pose(ego_poses.get(row, "ego_pose_token", data.where), ego_poses.where)

    scene_name_of = {raw: name for name, raw in chosen.items()}
    images, sweeps, cameras = [], [], dict[str, Camera]()
    for row in used:
        calibration = calibrations.get(row, "calibrated_sensor_token", data.where)
        pose = map_from_ego(row) @ _pose(calibration, calibrations.where)
        path = common.path_inside(folder.parent, row.get("filename"), f"{data.where}: record {row['token']!r}")
        if channel_of[row["token"]] == LIDAR:
            sweeps.append(SweepRecord(SENSOR, time_s(row), pose, path, partial(read_scan, path)))
            continue
        name = scene_name_of[channel_of[row["token"]]]
        images.append(ImageRecord(name, time_s(row), pose, path))
        if name not in cameras:
            here = f"{calibrations.where}: record {calibration['token']!r}"
            size = field(row, "width", data.where, int), field(row, "height", data.where, int)
            cameras[name] = common.pinhole_camera(name, size, calibration.get("camera_intrinsic"), here)
    cameras = {name: cameras[name] for name in chosen if name in cameras}
    tracks, notes = _read_tracks(folder, samples, zero_us)
    if not sweeps:
        notes.append("no LiDAR sweeps in the tables")
    ego = common.ego_path(list(map(time_s, used)), list(map(map_from_ego, used)))
    source = Source("nuscenes", LICENCE, None, (f"release {folder.name}, {scene['name']}", *notes))
    return DriveLog(str(scene["name"]), cameras, images, sweeps, tracks, ego, source, where)


def _choose_scene(source: Path, options: ImportOptions) -> tuple[Path, Row]:
    """Table folder and record of the scene; of one that lies in two releases that of the smaller, which is quicker."""
    wanted_release, _, wanted = options.sequence.rpartition("/")
    releases, scenes = _releases(source), dict[str, tuple[Path, Row]]()
    for folder in releases:
        for row in read_table(folder / "scene.json"):
            name = field(row, "name", str(folder / "scene.json"), str)
            if wanted in (name, row.get("token")) and wanted_release in ("", folder.name):
                return folder, row
            scenes[f"{folder.name}/{name}" if len(releases) > 1 else name] = folder, row
    expected = "v1.0-mini, v1.0-trainval or v1.0-test with scene.json and sample_data.json"
    return common.the_only(scenes, options, source, "nuScenes scene", expected)


def _samples_in_order(folder: Path, scene: Row) -> dict[str, int]:
    """Key frames of a scene: token -> time stamp in microseconds, in the order of the chain."""
    where = str(folder / "scene.json")
    token = field(scene, "token", where, str)
    samples = _those(folder, "sample", "scene_token", {token})
    at = field(scene, "first_sample_token", where, str)
    stamps: dict[str, int] = {}
    while at:
        if at in stamps:
            raise InputError("the chain of key frames runs in a circle", where=samples.where, got=f"back at {at!r}")
        stamps[at] = field(samples.record(at, samples.where), "timestamp", samples.where, int)
        at = field(samples.rows[at], "next", samples.where, str)
    values = np.array(list(stamps.values()), np.int64)
    common.check_epoch(values, MICROSECONDS, f"{samples.where}: timestamp")
    if (np.diff(values) <= 0).any():
        late = list(stamps)[int(np.flatnonzero(np.diff(values) <= 0)[0]) + 1]
        what, where = "time stamps of key frames do not increase along the scene", f"{samples.where}: record {late!r}"
        got, expected = f"{stamps[late]} after a later one", "microseconds, increasing from one key frame to the next"
        raise InputError(what, where=where, got=got, expected=expected, remedy="copy the table again")
    return stamps


def _check_times(rows: Sequence[Row], samples: Mapping[str, int], where: str) -> None:
    """Stamps of images and sweeps are microseconds near their scene."""
    stamps = np.array([field(row, "timestamp", where, int) for row in rows], np.int64)
    common.check_epoch(stamps, MICROSECONDS, f"{where}: timestamp")
    first, last = min(samples.values()), max(samples.values())
    beside = np.maximum(first - stamps, stamps - last) / MICROSECONDS
    if len(beside) and beside.max() > _MAX_BEFORE_SCENE_S:
        where = f"{where}: record {rows[int(beside.argmax())]['token']!r}"
        got, expected = f"{beside.max():.3f} s away from the key frames", "microseconds since 1970, within the scene"
        raise InputError("an image or sweep lies outside its scene's time", where=where, got=got, expected=expected)


def _pose(row: Row, where: str) -> Matrix:
    """Rigid f64[4, 4] of a record with ``rotation`` (w, x, y, z) and ``translation``."""
    rotation, translation = field(row, "rotation", where, float, 4), field(row, "translation", where, float, 3)
    return common.pose_from_quaternion(rotation, translation, f"{where}: record {row.get('token', '?')!r}")


# --- boxes ----------------------------------------------------------------------------------------


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
        label = tracks.label_of(field(category, "name", categories.where, str))
        if attributes is not None and label in _RIDDEN:
            tokens = row.get("attribute_tokens")
            known = [attributes.rows.get(str(one), {}) for one in tokens] if isinstance(tokens, list) else []
            label = _RIDDEN[label] if any(one.get("name") == _WITH_RIDER for one in known) else label
        width, length, height = field(row, "size", annotations.where, float, 3)  # in this order in the tables
        where = f"{annotations.where}: record {row['token']!r}"
        time_s = (samples[row["sample_token"]] - zero_us) / MICROSECONDS
        pose = _pose(row, annotations.where)
        tracks.add(instance["token"], label, time_s, (length, width, height), pose, where=where)
    return tracks.tracks()
