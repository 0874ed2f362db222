"""DGP importer: one scene of a data set in the layout of the Dataset Governance Policy (DDAD and others).

============================== =========================================================================================
``scene_<hash>.json``          samples, and every image and cloud with its time and pose (map from sensor)
``calibration/<hash>.json``    intrinsics, and where the sensors sit
``rgb/<camera>/*``             images
``point_cloud/<lidar>/*.npz``  clouds: array ``data``, columns by ``point_format``, in the sensor's frame
``bounding_box_3d/<lidar>/*``  boxes in the LiDAR's frame, with instance ids; classes in ``ontology/<hash>.json``
============================== =========================================================================================

Poses are those of the sensors at their own times; nothing is interpolated. Images project without distortion. Clouds
carry no point times, so ``dt_s`` is 0.

Some published scenes carry times in tenths of a microsecond that were written out as microseconds: dates in the 25th
century, a clock that runs ten times too fast. Times after 2099 are read as such, and it is said.
"""

from __future__ import annotations

import datetime
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from mudg.base import log, store
from mudg.base.errors import InputError
from mudg.base.geometry import invert
from mudg.base.types import Camera, Scene, Source, SweepPoints, Track
from mudg.formats.importers import common, drive_log
from mudg.formats.importers.clouds import npz_arrays
from mudg.formats.importers.common import ImportOptions, LogFiles, name_table
from mudg.formats.importers.drive_log import BoxTracks, DriveLog, ImageRecord, SweepRecord
from mudg.formats.unknown_fields import Known, known, note_unknown, note_unknown_within
from mudg.scene.clouds import is_return

Matrix = NDArray[np.float64]

LICENCE: Final = "the data set's own (DDAD: CC BY-NC-SA 4.0, Toyota Research Institute); see the folder's licence file"
MICROSECONDS: Final = 10**6
_YEAR_2100_US: Final = 4_102_444_800 * MICROSECONDS
_EPOCH: Final = datetime.datetime(1970, 1, 1, tzinfo=datetime.UTC)
_BOXES_3D: Final = "1"
_POSE: Final = known("", translation=known("x y z"), rotation=known("qw qx qy qz"))
_ID: Final = known("log name timestamp index")
_LENS: Final = known(
    "fx fy cx cy skew fov fisheye k1 k2 k3 k4 k5 k6 p1 p2 s1 s2 s3 s4 taux tauy alpha beta w xi equirectangular"
)
_DATUM: Final = known(
    "file_datum radar_point_cloud",
    image=known("filename height width channels annotations metadata", pose=_POSE),
    point_cloud=known("filename annotations metadata point_format point_fields", pose=_POSE),
)
_CHANNELS: Final = frozenset(
    "X Y Z INTENSITY R G B RING NORMAL_X NORMAL_Y NORMAL_Z CLASS_ID INSTANCE_ID TIMESTAMP".split()
)
OFFICIAL: Final[Mapping[str, Known]] = {
    "scene_*.json": known(
        "name description log metadata creation_date ontologies agent_ontologies statistics",
        samples=known("datum_keys calibration_key metadata", id=_ID),
        data=known("key next_key prev_key", id=_ID, datum=_DATUM),
    ),
    "calibration/*.json": known("names", intrinsics=_LENS, extrinsics=_POSE),
    "ontology/*.json": known("", items=known("name id color isthing supercategory")),
    "bounding_box_3d/*.json": known(
        "",
        annotations=known(
            "class_id instance_id attributes num_points",
            box=known("width length height occlusion truncation", pose=_POSE),
        ),
    ),
}
"""Kinds of files -> their fields, read or not; what is in metadata and attributes is free. Source: the format's
published messages."""
LABELS: Final[Mapping[str, str]] = name_table(
    """car: Car; truck: Truck; bus: Bus/RV/Caravan, Bus; motorcycle: Motorcycle;
    rider: Motorcyclist, Bicyclist; bicycle: Bicycle; pedestrian: Person, Pedestrian; train: Train;
    trailer: Trailer; towed_object: Towed Object; wheeled_slow: Wheeled Slow"""
)
"""Class names of common ontologies -> the labels of this package."""


def looks_like_dgp(source: Path) -> bool:
    """Whether a folder is a DGP scene, or holds some."""
    return bool(_scenes(source))


def import_dgp(source: Path, out: Path, options: ImportOptions) -> Scene:
    """Import a scene's folder, or one of a folder of scenes. ``options.sequence``: a scene's folder; ``cameras`` by
    either name (``CAMERA_01`` or ``camera_01``), all by default."""
    scene = _choose_scene(source, options)
    common.refuse_untwist(options, "DGP", str(source))
    return drive_log.write_log(read_log(scene, options), out, options)


def _scenes(source: Path) -> list[Path]:
    """Scene files of folders with calibrations: in ``source`` itself, or in its sub-folders."""
    if not source.is_dir():
        return []
    here = sorted(path for path in source.glob("scene_*.json") if (source / "calibration").is_dir())
    return here or sorted(p for p in source.glob("*/scene_*.json") if (p.parent / "calibration").is_dir())


def _choose_scene(source: Path, options: ImportOptions) -> Path:
    common.require_folder(source, "DGP")
    scenes = _scenes(source)
    if not scenes:
        expected = "scene_<hash>.json beside a calibration folder, here or in sub-folders"
        raise InputError("no DGP scene found", where=str(source), got=common.folder_contents(source), expected=expected)
    matching = [p for p in scenes if options.sequence in ("", p.parent.resolve().name, p.stem, p.name)]
    names = [f"{p.parent.resolve().name} ({p.name[:14]}...)" for p in scenes]
    return common.the_only(matching, names, options, source, "scene")


def files_of_dgp(source: Path, options: ImportOptions) -> LogFiles:
    """The chosen scene's folder."""
    return LogFiles((_choose_scene(source, options).parent,))


# --- one scene ------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, eq=False)
class _Datum:
    """One image or cloud; ``kind``: ``image`` or ``point_cloud``."""

    kind: str
    sensor: str
    calibration: str
    stamp_us: int
    record: Mapping[str, Any]
    map_from_sensor: Matrix
    where: str


def read_log(scene_file: Path, options: ImportOptions) -> DriveLog:
    """What the scene file, calibrations and box files tell; no image or cloud is opened."""
    folder, where = scene_file.parent, str(scene_file)
    log.info(f"dgp: {scene_file}")
    scene = _json(scene_file, "scene_*.json")
    with common.record_fields("scene record is incomplete", where, "the fields of a DGP scene"):
        data = _read_data(scene, where)
        calibrations = {key: _read_calibration(folder, key) for key in sorted({d.calibration for d in data})}
        names = {d.sensor: d.sensor.lower() for d in sorted(data, key=lambda d: d.sensor) if d.kind == "image"}
        chosen = {names[raw]: raw for raw in common.chosen_cameras(names, options, where, tuple(names))}
        clouds = [d for d in data if d.kind == "point_cloud"]
        used = [d for d in data if d.kind == "image" and d.sensor in chosen.values()] + clouds
        ticks_per_second, notes = _clock(used, where)
        zero = min(d.stamp_us for d in used)

        def seconds(datum: _Datum) -> float:
            return (datum.stamp_us - zero) / ticks_per_second

        images, sweeps = [], []
        cameras: dict[str, Camera] = {}
        for datum in used:
            path = common.path_inside(folder, datum.record.get("filename"), datum.where)
            if datum.kind == "image":
                name = names[datum.sensor]
                _add_camera(cameras, calibrations[datum.calibration], name, datum)
                images.append(ImageRecord(name, seconds(datum), datum.map_from_sensor, path))
            else:
                read = partial(read_cloud, path, tuple(datum.record.get("point_format", ())))
                sweeps.append(SweepRecord(datum.sensor.lower(), seconds(datum), datum.map_from_sensor, path, read))
        anchors = clouds or [d for d in used if d.sensor == next(iter(chosen.values()))]
        mounts = [calibrations[d.calibration].mount(d.sensor, d.where) for d in anchors]
        ego = common.ego_path(
            [seconds(d) for d in anchors], [d.map_from_sensor @ invert(m) for d, m in zip(anchors, mounts, strict=True)]
        )
        tracks, track_notes = _read_tracks(folder, scene, clouds, [seconds(d) for d in clouds])
    ordered = {name: cameras[name] for name in chosen}
    source = Source("dgp", LICENCE, None, (*notes, *track_notes))
    name = folder.resolve().name
    return DriveLog(name, ordered, images, sweeps, tracks, ego, source, where)


def _json(path: Path, kind: str) -> Any:
    """A file of the scene; fields that are not official are noted."""
    content = store.read_json(path)
    note_unknown_within(kind, content, OFFICIAL[kind])
    return content


def _read_data(scene: Mapping[str, Any], where: str) -> list[_Datum]:
    """All images and clouds that samples name."""
    by_key = {item["key"]: item for item in scene["data"]}
    data = []
    for index, sample in enumerate(scene["samples"]):
        for key in sample["datum_keys"]:
            here = f"{where}: samples[{index}]"
            if key not in by_key:
                raise InputError("a datum key points nowhere", where=here, got=repr(key), expected="a key of data")
            item = by_key[key]
            here = f"{where}: datum {key}"
            kind = next(iter(item["datum"]))
            if kind not in ("image", "point_cloud"):
                continue
            record = item["datum"][kind]
            pose = _pose(record["pose"], here)
            text = item["id"]["timestamp"]
            try:
                moment = datetime.datetime.fromisoformat(text)
            except (TypeError, ValueError) as error:
                what, expected = "time stamp is no date", "ISO 8601, UTC"
                raise InputError(what, where=here, got=repr(text), expected=expected) from error
            since = (moment if moment.tzinfo else moment.replace(tzinfo=datetime.UTC)) - _EPOCH
            stamp, sensor = since // datetime.timedelta(microseconds=1), str(item["id"]["name"])
            data.append(_Datum(kind, sensor, str(sample["calibration_key"]), stamp, record, pose, here))
    if not any(datum.kind == "image" for datum in data):
        raise InputError("the scene has no images", where=where)
    return data


def _clock(data: Sequence[_Datum], where: str) -> tuple[int, list[str]]:
    """Ticks of ``stamp_us`` per second, and notes."""
    stamps = np.array([datum.stamp_us for datum in data], np.int64)
    if (stamps > _YEAR_2100_US).all():
        common.check_epoch(stamps // 10, MICROSECONDS, where)
        return 10 * MICROSECONDS, ["dates after 2099: times are read as tenths of a microsecond"]
    common.check_epoch(stamps, MICROSECONDS, where)
    return MICROSECONDS, []


def _pose(value: Mapping[str, Any], where: str) -> Matrix:
    q, t = value["rotation"], value["translation"]
    return common.pose_from_quaternion([q["qw"], q["qx"], q["qy"], q["qz"]], [t["x"], t["y"], t["z"]], f"{where}: pose")


# --- calibration ----------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, eq=False)
class _DgpCalibration:
    """One calibration file: intrinsics records and vehicle-from-sensor f64[4, 4] by sensor."""

    intrinsics: Mapping[str, Mapping[str, Any]]
    mounts: Mapping[str, Matrix]
    where: str

    def mount(self, sensor: str, where: str) -> Matrix:
        if sensor not in self.mounts:
            what = "calibration lacks a sensor"
            raise InputError(what, where=self.where, expected=f"{sensor} ({where})", got=", ".join(self.mounts))
        return self.mounts[sensor]


def _read_calibration(folder: Path, key: str) -> _DgpCalibration:
    path = common.path_inside(folder, f"calibration/{key}.json", f"{folder}: calibration key")
    record = _json(path, "calibration/*.json")
    names = [str(name) for name in record["names"]]
    if not len(names) == len(record["extrinsics"]) == len(record["intrinsics"]):
        what = "calibration lists differ in length"
        raise InputError(what, where=str(path), expected="names, extrinsics, intrinsics")
    mounts = {n: _pose(value, f"{path}: {n}") for n, value in zip(names, record["extrinsics"], strict=True)}
    return _DgpCalibration(dict(zip(names, record["intrinsics"], strict=True)), mounts, str(path))


def _add_camera(cameras: dict[str, Camera], calibration: _DgpCalibration, name: str, datum: _Datum) -> None:
    """The datum's camera; all images of a scene must share it. Half a pixel is added: pixel centres are whole numbers
    here."""
    calibration.mount(datum.sensor, datum.where)
    k = {key: float(calibration.intrinsics[datum.sensor].get(key, 0.0)) for key in ("fx", "fy", "cx", "cy", "skew")}
    where = f"{calibration.where}: {datum.sensor}"
    if not np.isfinite(list(k.values())).all() or abs(k["skew"]) > 1e-6:
        raise InputError("intrinsics are not those of a camera without skew", where=where, got=str(k))
    width, height = int(datum.record["width"]), int(datum.record["height"])
    camera = Camera(name, width, height, k["fx"], k["fy"], k["cx"] + 0.5, k["cy"] + 0.5)
    if cameras.setdefault(name, camera) != camera:
        what = "images of one camera differ in size or calibration"
        raise InputError(what, where=datum.where, expected=str(cameras[name]), got=str(camera))


# --- boxes and clouds -----------------------------------------------------------------------------


def _read_tracks(
    folder: Path, scene: Mapping[str, Any], clouds: Sequence[_Datum], times_s: Sequence[float]
) -> tuple[list[Track], list[str]]:
    """Tracks in the map's frame from the boxes of the clouds, and notes."""
    files = [datum.record.get("annotations", {}).get(_BOXES_3D) for datum in clouds]
    if not any(files):
        return [], ["no 3-D boxes in this scene: everything counts as static"]
    key = scene["ontologies"].get(_BOXES_3D)
    ontology = common.path_inside(folder, f"ontology/{key}.json", f"{folder}: ontologies")
    names = {int(item["id"]): str(item["name"]) for item in _json(ontology, "ontology/*.json")["items"]}
    tracks = BoxTracks(str(folder / "bounding_box_3d"), LABELS)
    for datum, time_s, name in zip(clouds, times_s, files, strict=True):
        if not name:
            continue
        path = common.path_inside(folder, name, datum.where)
        for index, item in enumerate(_json(path, "bounding_box_3d/*.json")["annotations"]):
            where = f"{path}: annotations[{index}]"
            if item["class_id"] not in names:
                what, got = "box has a class that the ontology lacks", str(item["class_id"])
                raise InputError(what, where=where, got=got, expected=", ".join(str(number) for number in names))
            box, label = item["box"], tracks.label_of(names[item["class_id"]])
            size, pose = (box["length"], box["width"], box["height"]), datum.map_from_sensor @ _pose(box["pose"], where)
            tracks.add(str(item["instance_id"]), label, time_s, size, pose, where=where)
    return tracks.tracks()


def read_cloud(path: Path, point_format: Sequence[str]) -> SweepPoints:
    """A cloud: array ``data`` of an npz file, columns named by ``point_format`` (empty = X, Y, Z, INTENSITY). Raises
    InputError: cut off, damaged, of another size than it declares, without coordinates, or not finite."""
    where = str(path)
    arrays = npz_arrays(store.read_bytes(path), where)
    note_unknown("point_cloud/*.npz", arrays, frozenset({"data"}))
    data = arrays.get("data", np.zeros(0))
    columns = [str(name).upper() for name in point_format] or ["X", "Y", "Z", "INTENSITY"]
    note_unknown("point_format", columns, _CHANNELS)
    fits = data.ndim == 2 and data.shape[1] == len(columns) and data.dtype.kind in "fiu"
    if not fits or not {*"XYZ"} <= {*columns}:
        what, expected = "cloud does not have its columns", f"[N, {len(columns)}] numbers: {', '.join(columns)}"
        raise InputError(what, where=f"{where}: data", got=f"{data.dtype} {data.shape}", expected=expected)
    axes = [columns.index(axis) for axis in "XYZ"]
    returns = is_return(data[:, axes])
    no_returns, data = int((~returns).sum()), data[returns].astype(np.float32)
    if not np.isfinite(data).all():
        what = "cloud holds values that are not finite"
        raise InputError(what, where=where, got=f"{int((~np.isfinite(data).all(1)).sum())} of {len(data)} points")
    xyz = np.ascontiguousarray(data[:, axes])
    intensity = data[:, columns.index("INTENSITY")] if "INTENSITY" in columns else np.zeros(len(data), np.float32)
    # the format states no range
    if len(intensity) and not (-1e-3 < float(intensity.min()) <= float(intensity.max()) < 1.001):
        log.info_once("dgp: intensities outside of 0 to 1 are taken as 0 and 1: divide them by their largest value")
    return SweepPoints(xyz, np.clip(intensity, 0, 1), np.zeros(len(data), np.float32), no_returns=no_returns)
