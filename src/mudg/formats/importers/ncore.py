"""NCore importer: recordings of version 4 (NVIDIA), read with the vendor's package.

A recording is one or more stores ``NAME.ncore4[-GROUP].zarr.itar`` (or folders ``.zarr``) that belong together by NAME;
a ``.json`` beside them lists them. Read are cameras with their lenses, LiDARs with all returns and the time of every
ray, poses, boxes, and masks of the own vehicle; not radars, loose point clouds and labels of images.

Every image is taken to be seen at the middle of its exposure, and every sweep is brought to the middle of its turn (or
to the moment that is noted with it). Lenses are the package's own projections. Boxes hold at their own times, whichever
frame they are told in.
"""

from __future__ import annotations

import lzma
import math
import re
import struct
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from fnmatch import fnmatchcase
from functools import partial
from pathlib import Path
from typing import Any, Final, get_args

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from mudg.base import log, memory, store
from mudg.base.errors import InputError, MudgError
from mudg.base.geometry import all_rigid, from_rotation_translation
from mudg.base.records import understood
from mudg.base.types import Camera, EgoPath, Scene, Shutter, Source, SweepPoints, Track
from mudg.formats.exporters.ncore import (
    ABOUT,
    EGO_MASK,
    EULER,
    INSTANCE,
    MARK,
    MICRO,
    RIG,
    SWEEP_TIME,
    WORLD,
    Matrix,
    Times,
    close,
    package,
)
from mudg.formats.importers import common
from mudg.formats.importers.common import ImportOptions, LogFiles, name_table
from mudg.formats.importers.drive_log import BoxTracks, CameraOptics, DriveLog, ImageRecord, SweepRecord, write_log
from mudg.formats.importers.images import Lens
from mudg.formats.unknown_fields import known, note_unknown, note_unknown_within

# container ----------------------------------------------------------------------------------------
#
# The files of an NCore recording, checked before NVIDIA's package reads them: nothing is larger in memory than its file
# can hold, and nothing is run.
#
# A store is a zarr hierarchy in one tar file (``.zarr.itar``: members, then an index, then a block that says where the
# index is) or in a folder (``.zarr``). All metadata stand once more in one compressed member, which is what the package
# reads. The package trusts sizes and codecs; here every size is held against the bytes that are there, and codecs other
# than the format's own (pickle is one) are refused.
METADATA: Final = ".zmetadata.cbor.xz"
_BLOCK: Final = 512
_HEADER: Final = struct.Struct("<4sIQI")
_XZ_MEMORY: Final = 256 << 20
_LEAST_UNPACKED: Final = 1 << 20
_MOST_GROWTH: Final = 40
"""Metadata unpack to no more than this times their compressed size (poses and boxes: some 5 to 20)."""
_CONTAINERS: Final = bytes(range(0x80, 0xC0))
"""Bytes that begin a list or a map in CBOR."""
_CONTAINER_BYTES: Final = 72
_MOST_LZ4: Final = 256
_BLOSC_HEADER: Final = struct.Struct("<4B3I")
_KINDS: Final = "biufS"
COMPONENTS: Final = frozenset("poses intrinsics masks cameras lidars radars cuboids point_clouds camera_labels".split())
"""Components of the format, read or not."""
_CAMERA: Final = known(
    "camera_model_type external_distortion_type",
    camera_model_parameters=known(
        "resolution shutter_type external_distortion_type external_distortion_parameters principal_point focal_length "
        "radial_coeffs tangential_coeffs thin_prism_coeffs max_angle reference_poly pixeldist_to_angle_poly "
        "angle_to_pixeldist_poly linear_cde"
    ),
)
_BOX: Final = known(
    "track_id class_id timestamp_us reference_frame_id reference_frame_timestamp_us source source_version",
    bbox3=known("centroid dim rot"),
)
_FIELDS: Final = {
    "intrinsics/*/cameras/*/.zattrs": ("the camera models", _CAMERA),
    "masks/*/cameras/*/.zattrs": ("the masks", known("mask_names format")),
    "cuboids/*/cuboids/.zattrs": ("the boxes", known("", cuboid_track_observations=_BOX)),
    "cameras/*/frames/.zattrs": ("the camera components", known("frames_timestamps_us")),
    "lidars/*/frames/.zattrs": ("the LiDAR components", known("frames_timestamps_us")),
    "cameras/*/image/.zattrs": ("the images", known("format")),
}
"""Attributes inside components that are read: pattern of their names -> what holds them, fields of the format."""


@dataclass(frozen=True, slots=True)
class _StoredMember:
    """Where a member's bytes are."""

    path: Path
    offset: int
    size: int

    def read(self, most: int | None = None) -> bytes:
        """Its bytes, or the first of them."""
        with store.open_file(self.path) as handle:
            handle.seek(self.offset)
            return handle.read(self.size if most is None else min(most, self.size))


@contextmanager
def foreign_reader(where: str) -> Iterator[None]:
    """Code of the package that reads a file: whatever it raises becomes an InputError. It reports damage by errors of
    every kind."""
    try:
        yield
    except MudgError:
        raise
    except Exception as error:
        what = "NCore recording cannot be read"
        remedy = "is a file of it damaged, missing, or of another version? copy it again"
        raise InputError(what, where=where, got=f"{type(error).__name__}: {error}"[:300], remedy=remedy) from error


def check_store(path: Path) -> None:
    """Refuse a store that is cut off, that contradicts itself, or that would take more memory than its files can need:
    nothing of the size that was promised is allocated."""
    if path.is_dir():
        files = [store.regular(file) for file in sorted(path.rglob("*")) if not file.is_dir()]
        members = {file.relative_to(path).as_posix(): _StoredMember(file, 0, file.stat().st_size) for file in files}
    else:
        members = _members_of_tar(path)
    chunks: dict[str, dict[str, _StoredMember]] = {}
    for name, member in members.items():
        folder, _, last = name.rpartition("/")
        if not last.startswith("."):
            chunks.setdefault(folder, {})[last] = member
    where = f"{path}: {METADATA}"
    if METADATA not in members:
        what, expected = "NCore store has no metadata", "a store that was finished"
        raise InputError(what, where=where, expected=expected, remedy="was the program that wrote it stopped?")
    with understood("NCore metadata: groups and arrays of zarr 2", where):
        metadata = _cbor(_unpacked(members[METADATA].read(), where), where)["metadata"]
        groups = dict.fromkeys(name.partition("/")[0] for name in metadata if "/" in name)
        note_unknown("the stores of the recording", groups, COMPONENTS)
        for name, about in metadata.items():
            if name.endswith(".zarray"):
                place = name.removesuffix(".zarray").rstrip("/")
                _check_array(about, chunks.get(place, {}), f"{path}: {place}")
            for pattern, (kind, fields) in _FIELDS.items():
                if fnmatchcase(name, pattern):
                    note_unknown_within(f"{kind} of the recording", about, fields)


# --- containers -----------------------------------------------------------------------------------


def _members_of_tar(path: Path) -> dict[str, _StoredMember]:
    size = store.regular(path).stat().st_size
    where = f"{path}: index"
    last = _StoredMember(path, max(0, size - _BLOCK), _BLOCK).read()
    magic, kind, offset, length = _HEADER.unpack(last[: _HEADER.size].ljust(_HEADER.size, b"\0"))
    if magic != b"itar" or kind != 1 or size % _BLOCK:
        what, expected = "not an indexed tar file, or cut off", "an index in the last 512 bytes"
        got = f"{size} bytes, the last block begins with {last[:8]!r}"
        raise InputError(what, where=str(path), expected=expected, got=got, remedy="copy the file again")
    if offset + length > size - _BLOCK:
        what, got, remedy = "index lies outside of the file", f"{length} bytes from {offset} on", "copy the file again"
        raise InputError(what, where=where, expected=f"at most {size - _BLOCK} bytes", got=got, remedy=remedy)
    with understood("an index: names, offsets and sizes of members", where):
        table = _cbor(_unpacked(_StoredMember(path, offset, length).read(), where), where)
        names, offsets, sizes = table["items"], table["offset_datas"], table["sizes"]
        if not len(names) == len(offsets) == len(sizes):
            what = "index contradicts itself"
            raise InputError(what, where=where, got=f"{len(names)}, {len(offsets)}, {len(sizes)} entries")
        for name, begin, count in zip(names, offsets, sizes, strict=True):
            if not (isinstance(name, str) and _whole(begin) and _whole(count) and begin + count <= size):
                what, where = "member lies outside of the file", f"{path}: {str(name)[:80]}"
                expected, got = f"at most {size} bytes", f"{count} bytes from {begin} on"[:120]
                raise InputError(what, where=where, expected=expected, got=got, remedy="copy the file again")
        return {name: _StoredMember(path, *place) for name, *place in zip(names, offsets, sizes, strict=True)}


def _whole(value: Any) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and value >= 0


def _unpacked(packed: bytes, where: str) -> bytes:
    """An xz file that is not larger than such metadata can be."""
    most = max(_LEAST_UNPACKED, _MOST_GROWTH * len(packed))
    unpacker = lzma.LZMADecompressor(lzma.FORMAT_XZ, memlimit=_XZ_MEMORY)
    return common.unpacked(unpacker, packed, most, "compressed metadata", where)


def _cbor(content: bytes, where: str) -> Any:
    import cbor2

    # as many lists and maps at most: a byte makes an object
    heads = len(content) - len(content.translate(None, _CONTAINERS))
    memory.require(_CONTAINER_BYTES * heads + 8 * len(content), f"reading {where}", "a machine with more memory")
    damage = cbor2.CBORError, ValueError, TypeError, OverflowError, RecursionError, MemoryError
    try:
        found = cbor2.loads(content)
    except damage as error:
        what = "metadata are damaged"
        raise InputError(what, where=where, got=str(error)[:120], remedy="copy the file again") from error
    if not isinstance(found, dict):
        raise InputError("metadata are of another kind", where=where, expected="a map", got=type(found).__name__)
    return found


# --- arrays ---------------------------------------------------------------------------------------


def _check_array(about: Mapping[str, Any], chunks: Mapping[str, _StoredMember], where: str) -> None:
    """Refuse an array that its chunks cannot fill, that is not of plain numbers or bytes, or that is packed in another
    way."""
    codec, nested = about["compressor"], about.get("dimension_separator", ".") != "."
    if nested or about.get("filters") or not (codec is None or codec["id"] == "blosc"):
        what = "array is packed in a way that is not read"
        got = str(about.get("filters") or (about["dimension_separator"] if nested else codec))[:120]
        raise InputError(what, where=where, expected="blosc or nothing, chunks named 0.0", got=got)
    kind = np.dtype(about["dtype"])
    if kind.hasobject or kind.kind not in _KINDS:
        raise InputError("array is not of plain numbers or bytes", where=where, got=str(about["dtype"])[:80])
    shape, pieces = about["shape"], about["chunks"]
    if len(shape) != len(pieces) or not all(map(_whole, (*shape, *pieces))) or 0 in pieces:
        what = "array has a shape that makes no sense"
        raise InputError(what, where=where, got=f"{shape} in chunks of {pieces}"[:120])
    grid = [-(-side // piece) for side, piece in zip(shape, pieces, strict=True)]
    names = (".".join(map(str, place)) or "0" for place in (_places(grid) if math.prod(shape) else ()))
    # the package would fill it with a constant
    if (lost := next((name for name in names if name not in chunks), None)) is not None:
        what, expected = "chunk of an array is missing", f"chunks of {pieces} for {shape}"[:120]
        got = f"{len(chunks)} chunks"
        raise InputError(what, where=f"{where}/{lost}", expected=expected, got=got, remedy="copy the recording again")
    stored, growth = sum(chunk.size for chunk in chunks.values()), 1 if codec is None else _MOST_LZ4
    piece = math.prod(pieces) * kind.itemsize
    if max(math.prod(shape) * kind.itemsize, piece if math.prod(shape) else 0) > growth * stored:
        got = f"{shape} of {kind} in {stored} bytes"[:120]
        raise InputError("array is larger than its file can hold", where=where, got=got, remedy="is the file cut off?")
    for name, chunk in chunks.items():
        size = chunk.size if codec is None else _blosc_size(chunk, f"{where}/{name}")
        if size != piece:
            what, where = "chunk of an array is of another size", f"{where}/{name}"
            raise InputError(what, where=where, expected=f"{piece} bytes", got=f"{size}", remedy="copy the file again")


def _places(grid: Sequence[int]) -> Iterator[tuple[int, ...]]:
    """Indices of a grid of chunks one by one: a file may promise more of them than memory holds."""
    for first in range(grid[0]) if grid else ():
        yield from ((first, *rest) for rest in _places(grid[1:]))
    if not grid:
        yield ()


def _blosc_size(chunk: _StoredMember, where: str) -> int:
    """Bytes that a chunk unpacks to."""
    head = chunk.read(_BLOSC_HEADER.size)
    if len(head) < _BLOSC_HEADER.size:
        raise InputError("chunk of an array is cut off", where=where, got=f"{len(head)} bytes")
    *_, unpacked, block, packed = _BLOSC_HEADER.unpack(head)
    if packed != chunk.size or block > max(unpacked, 1):
        raise InputError("chunk of an array is damaged", where=where, got=f"{chunk.size} bytes", expected=f"{packed}")
    return unpacked


# importer -----------------------------------------------------------------------------------------
_WITH_FRAMES: Final = frozenset({SWEEP_TIME, "train_ids"})
"""What this program stores, or did, with a frame."""
_LIST: Final = known(
    "sequence_id sequence_timestamp_interval_us generic_meta_data version",
    component_stores=known("path md5 components"),
)
"""Fields of the list of a recording's stores."""
UNKNOWN_LICENCE: Final = "not stated in the recording: see where it comes from"
LABELS: Final[Mapping[str, str]] = name_table(
    """car: automobile, car; truck: heavy_truck, truck; tram: train_or_tram_car, tram; vehicle: other_vehicle, vehicle;
    pedestrian: person, pedestrian; van: van; bus: bus; trailer: trailer; train: train; cyclist: cyclist; rider: rider;
    bicycle: bicycle; motorcycle: motorcycle; stroller: stroller; animal: animal;
    protruding_object: protruding_object"""
)
"""Classes of NVIDIA's recordings and of this program -> labels."""
_EXACT: Final = 1e-7
"""Errors of rotations that are left as they are."""
_LOOKED_AT: Final = 1 << 20
_MOST_SPAN_US: Final = 4 * 3600 * MICRO
_MOST_EXPOSURE_US: Final = MICRO


def looks_like_ncore(source: Path) -> bool:
    """Whether a file or folder is a recording, or a folder holds some."""
    return bool(_recordings(source))


def files_of_ncore(source: Path, options: ImportOptions) -> LogFiles:
    """The stores of the chosen recording."""
    return LogFiles(_choose(source, options))


def import_ncore(source: Path, out: Path, options: ImportOptions) -> Scene:
    """Import a recording: a folder of stores, one of them, or the ``.json`` that lists them. ``options.sequence``: its
    name, or the beginning of it. ResourceError: the package is not installed."""
    common.refuse_options(options, "NCore", "poses", "boxes")
    package()
    stores = _choose(source, options)
    for path in stores:
        check_store(path)
    with _opened(stores, str(stores[0].parent)) as recording:
        return write_log(_drive(recording, options), out, options)


# --- files ----------------------------------------------------------------------------------------


def _recordings(source: Path) -> dict[str, list[Path]]:
    """Name of a recording -> its stores."""
    if source.suffix == ".json" and source.is_file():
        with store.open_file(source) as handle:
            listed = b'"component_stores"' in handle.read(_LOOKED_AT)
        return {_name(source): _listed(source)} if listed else {}
    folder, found = source.parent if _is_store(source) else source, dict[str, list[Path]]()
    for path in sorted(folder.iterdir()) if folder.is_dir() else ():
        if _is_store(path) and (folder == source or _name(path) == _name(source)):
            found.setdefault(_name(path), []).append(path)
    return found


def _name(path: Path) -> str:
    return path.name.partition(MARK)[0]


def _is_store(path: Path) -> bool:
    if MARK not in path.name:
        return False
    return (path.name.endswith(".zarr.itar") and path.is_file()) or (path.name.endswith(".zarr") and path.is_dir())


def _listed(path: Path) -> list[Path]:
    """The stores that a ``.json`` names."""
    with understood("a list of stores: component_stores with a path each", str(path)):
        content = store.read_json(path)
        note_unknown_within(path.name, content, _LIST)
        names = [one["path"] for one in content["component_stores"]]
        return [common.path_inside(path.parent, name, f"{path}: component_stores[{n}]") for n, name in enumerate(names)]


def _choose(source: Path, options: ImportOptions) -> tuple[Path, ...]:
    expected = f"files NAME{MARK}.zarr.itar, or folders NAME{MARK}.zarr"
    found = {name: stores for name, stores in _recordings(source).items() if stores}
    begins = lambda name: name.startswith(options.sequence)
    chosen = tuple(common.the_only(found, options, source, "NCore recording", expected, begins))
    for path in chosen:
        if not path.exists():
            what = "a store of the recording is missing"
            raise InputError(what, where=str(path), expected="all stores that its list names")
    return chosen


# --- a recording ----------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, eq=False)
class _OpenRecording:
    """An open recording: the package's readers, and its tree of frames. ``where``: its folder. ``file``: one of its
    files."""

    reader: Any
    poses: Any
    intrinsics: Any
    masks: Any
    cuboids: Any
    cameras: Mapping[str, Any]
    lidars: Mapping[str, Any]
    graph: Any
    where: str
    file: Path

    def world_from(self, frame: str, times_us: Times, where: str) -> Matrix:
        """Poses f64[N, 4, 4] of a frame in the world; recordings may hold them in single precision."""
        if frame == WORLD or not len(times_us):
            return np.tile(np.eye(4), (len(times_us), 1, 1))
        with foreign_reader(f"{where}: pose of {frame}"):
            found = np.asarray(self.graph.evaluate_poses(frame, WORLD, times_us), np.float64)
        return _rigid(found, _EXACT, f"{where}: pose of {frame}")


def _rigid(poses: Matrix, tolerance: float, where: str) -> Matrix:
    """Poses f64[N, 4, 4], cleaned of rounding beyond the tolerance. The package would make rotations of any others."""
    if poses.ndim == 3 and all_rigid(poses, tolerance):
        return poses
    return np.stack([common.rigid_pose(pose, f"{where}: key {index}") for index, pose in enumerate(poses)])


@contextmanager
def _opened(stores: tuple[Path, ...], where: str) -> Iterator[_OpenRecording]:
    v4 = package().v4
    with foreign_reader(where):
        reader = v4.SequenceComponentGroupsReader(list(stores))
    try:
        with foreign_reader(where):
            of = {
                name: reader.open_component_readers(getattr(v4, f"{name}Component").Reader)
                for name in "Poses Intrinsics Masks Cuboids CameraSensor LidarSensor".split()
            }
            poses = _single(of["Poses"], "poses", where)
            fixed, moving = list(poses.get_static_poses()), list(poses.get_dynamic_poses())
        for (source, target), found in (*((pair, pose[None]) for pair, pose in fixed), *((p, k[0]) for p, k in moving)):
            _rigid(np.asarray(found, np.float64), common.POSE_TOLERANCE, f"{where}: pose of {source} in {target}")
        with foreign_reader(where):
            edge = package().transformations.PoseGraphInterpolator.Edge
            edges = [edge(source, target, pose, None) for (source, target), pose in fixed]
            edges += [edge(source, target, *keys) for (source, target), keys in moving]
            graph = package().transformations.PoseGraphInterpolator(edges)
        file = stores[0] if stores[0].is_file() else stores[0] / METADATA
        yield _OpenRecording(
            reader=reader,
            poses=poses,
            intrinsics=_single(of["Intrinsics"], "intrinsics", where),
            masks=_perhaps(of["Masks"]),
            cuboids=_perhaps(of["Cuboids"]),
            cameras=of["CameraSensor"],
            lidars=of["LidarSensor"],
            graph=graph,
            where=where,
            file=file,
        )
    finally:
        close(reader)


def _perhaps(found: Mapping[str, Any]) -> Any:
    """The component of which a recording has one at most: by its usual name, or the only one."""
    return found.get(INSTANCE) or (next(iter(found.values())) if len(found) == 1 else None)


def _single(found: Mapping[str, Any], kind: str, where: str) -> Any:
    one = _perhaps(found)
    if one is None:
        what, expected = f"recording has no {kind}", f"a component {INSTANCE}, or one of another name"
        got = ", ".join(found) or "none"
        raise InputError(what, where=where, expected=expected, got=got, remedy="are all of its stores there?")
    return one


def _drive(recording: _OpenRecording, options: ImportOptions) -> DriveLog:
    """What the metadata tell; no image or sweep is opened."""
    where = recording.where
    log.info(f"ncore: {recording.reader.sequence_id} in {where}")
    names = _scene_names(recording.cameras)
    chosen = common.chosen_cameras(names, options, where, list(names))
    spans = {camera: _spans(recording.cameras[camera], f"{where}: camera {camera}") for camera in chosen}
    turns = {lidar: _spans(reader, f"{where}: LiDAR {lidar}") for lidar, reader in recording.lidars.items()}
    zero_us = min(int(found.min()) for found in (*spans.values(), *turns.values()) if len(found))
    notes: list[str] = []
    optics = {names[camera]: _optics(recording, camera, names[camera], spans[camera], notes) for camera in chosen}
    images = [one for camera in chosen for one in _images(recording, camera, names[camera], spans[camera], zero_us)]
    lidars = _scene_names(turns, set(names.values()))
    sweeps = [one for lidar, found in turns.items() for one in _sweeps(recording, lidar, lidars[lidar], found, zero_us)]
    ego = _ego(recording, zero_us, np.concatenate([found.reshape(-1) for found in (*spans.values(), *turns.values())]))
    tracks, track_notes = _tracks(recording, zero_us)
    noted = recording.reader.generic_meta_data.get(ABOUT)  # of this program, when it wrote the recording
    noted = noted if isinstance(noted, dict) else {}
    about = {key: value for key, value in noted.items() if isinstance(value, str)}
    notes += [*([] if sweeps else ["no LiDAR sweeps in the recording"]), *track_notes]
    source = Source(about.get("dataset", "ncore"), about.get("licence", UNKNOWN_LICENCE), None, tuple(notes))
    cameras, name = {name: one.recorded for name, one in optics.items()}, str(recording.reader.sequence_id)
    return DriveLog(name, cameras, images, sweeps, tracks, ego, source, where, optics, box_times="own")


def _scene_names(sensors: Iterable[str], taken: Collection[str] = ()) -> dict[str, str]:
    """A sensor's name -> its name in the scene, which is the same where a folder can have it; each once."""
    names: dict[str, str] = {}
    for sensor in sensors:
        plain = re.sub(r"[^A-Za-z0-9_+.-]", "_", sensor).strip("._+-")[:48] or "sensor"
        chosen, count = plain, 1
        while chosen in {*names.values(), *taken}:
            count += 1
            chosen = f"{plain}_{count}"
        names[sensor] = chosen
    return names


def _spans(reader: Any, where: str) -> Times:
    """First and last microsecond of every frame of a sensor, i64[N, 2]."""
    with understood("times of frames: begin and end of each", where):
        spans = np.asarray(reader.frames_timestamps_us, np.uint64).reshape(-1, 2)
        if (spans > 2**62).any():
            raise InputError("time stamp is no time in microseconds", where=where, got=str(int(spans.max())))
        spans = spans.astype(np.int64)
    if (spans[:, 1] < spans[:, 0]).any() or (len(spans) and spans.max() - spans.min() > _MOST_SPAN_US):
        what, expected = "times of frames make no sense", "microseconds of one recording, begin before end"
        raise InputError(what, where=where, expected=expected, got=f"{spans.min()} to {spans.max()}")
    common.seconds(spans[:, 1], "us", where)
    return spans


# --- cameras --------------------------------------------------------------------------------------


def _optics(recording: _OpenRecording, camera: str, name: str, spans: Times, notes: list[str]) -> CameraOptics:
    """Intrinsics, lens and mask of a camera; ``notes`` are added to."""
    where = f"{recording.where}: camera {camera}"
    with foreign_reader(where):
        model = recording.intrinsics.get_camera_model_parameters(camera)
        like = model.paraxial_pinhole_geometry()
        width, height = (int(side) for side in model.resolution)
        fx, fy, cx, cy = (float(value) for value in (*like.focal_length, *like.principal_point))
        rolling = model.shutter_type != package().data.ShutterType.GLOBAL
        plain = model.type() == "ideal-pinhole" or getattr(model, "is_distortion_free", False)
    exposure_us = float(np.median(spans[:, 1] - spans[:, 0])) if rolling and len(spans) else 0.0
    if exposure_us > _MOST_EXPOSURE_US:
        what = "images take longer than a shutter can"
        raise InputError(what, where=where, got=f"{exposure_us:g} us", expected="at most a second")
    shutter = model.shutter_type.name.lower().removeprefix("rolling_")
    rolls = {"readout_s": exposure_us / MICRO, "shutter": shutter if shutter in get_args(Shutter) else "global"}
    recorded = Camera(name, width, height, fx, fy, cx, cy, **rolls)
    if exposure_us:
        words = model.shutter_type.name.lower().replace("_", " ")
        notes.append(f"camera {name}: {words} shutter; a view is that of the middle")
    return CameraOptics(recorded, None if plain else _lens(model, recorded), _mask(recording, camera, recorded))


def _lens(model: Any, camera: Camera) -> Lens:
    """The package's projection of a camera as a lens."""
    import torch

    with foreign_reader(f"camera {camera.name}"):
        projection = package().sensors.CameraModel.from_parameters(model, device="cpu", dtype=torch.float64)

    def lens(xy: NDArray[np.float64]) -> NDArray[np.float64]:
        rays = np.column_stack([xy, np.ones(len(xy))])
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        with foreign_reader(f"camera {camera.name}"):
            points = projection.camera_rays_to_image_points(rays).image_points
        return (np.asarray(points, np.float64) - [camera.cx, camera.cy]) / [camera.fx, camera.fy]

    return lens


def _mask(recording: _OpenRecording, camera: str, recorded: Camera) -> NDArray[np.bool_] | None:
    """Where the own vehicle is seen, bool[H, W], or None."""
    where = f"{recording.where}: mask of camera {camera}"
    if recording.masks is None:
        return None
    with foreign_reader(where):
        if EGO_MASK not in recording.masks.get_camera_mask_names(camera):
            return None
        image = recording.masks.get_camera_mask_image(camera, EGO_MASK)
        if image.size != (recorded.width, recorded.height):
            what = "mask does not have its camera's size"
            raise InputError(what, where=where, got=f"{image.size}", expected=f"{recorded.width}x{recorded.height}")
        return np.asarray(image.convert("L")) != 0


def _images(recording: _OpenRecording, camera: str, name: str, spans: Times, zero_us: int) -> list[ImageRecord]:
    where = f"{recording.where}: camera {camera}"
    poses = recording.world_from(camera, spans.sum(1) // 2, where)
    records = []
    for (begin, end), pose in zip(spans.tolist(), poses, strict=True):
        time_s, place = (begin + end - 2 * zero_us) / (2 * MICRO), f"{where}: frame {end}"
        read = partial(_picture, recording.cameras[camera], end, place)
        records.append(ImageRecord(name, time_s, pose, recording.file, read, place))
    return records


def _picture(reader: Any, frame: int, where: str) -> bytes:
    """The encoded image of a frame."""
    with foreign_reader(where):
        content = bytes(reader.get_frame_data(frame).get_encoded_image_data())
        _note_frame(reader, frame, "camera")
    if content[:4] != b"\x89PNG" and content[:2] != b"\xff\xd8":
        what = "image is of a kind that is not read"
        raise InputError(what, where=where, expected="PNG or JPEG", got=repr(content[:8]))
    return content


# --- LiDAR ----------------------------------------------------------------------------------------


def _sweeps(recording: _OpenRecording, lidar: str, name: str, spans: Times, zero_us: int) -> list[SweepRecord]:
    reader, where = recording.lidars[lidar], f"{recording.where}: LiDAR {lidar}"
    at = spans.sum(1) // 2
    for index, (begin, end) in enumerate(spans.tolist()):
        with foreign_reader(f"{where}: frame {end}"):
            noted = reader.get_frame_generic_meta_data(end).get(SWEEP_TIME)
        if isinstance(noted, int) and begin <= noted <= end:
            at[index] = noted
    poses, records = recording.world_from(lidar, at, where), []
    for end, moment, pose in zip(spans[:, 1].tolist(), at.tolist(), poses, strict=True):
        place = f"{where}: frame {end}"
        read = partial(_points, recording, lidar, end, moment, pose, place)
        records.append(SweepRecord(name, (moment - zero_us) / MICRO, pose, recording.file, read, place))
    return records


def _points(
    recording: _OpenRecording, lidar: str, frame: int, at: int, world_from_lidar: Matrix, where: str
) -> SweepPoints:
    """All returns of a sweep, in the sensor's frame at its moment."""
    reader = recording.lidars[lidar]
    with foreign_reader(where):
        ray = np.asarray(reader.get_frame_ray_bundle_data(frame, "direction"), np.float64)
        times = np.asarray(reader.get_frame_ray_bundle_data(frame, "timestamp_us")).astype(np.int64)
        distance, intensity = (
            np.asarray(reader.get_frame_ray_bundle_return_data(frame, name, None), np.float32)
            for name in ("distance_m", "intensity")
        )
        begin, end = (int(time) for time in reader.get_frame_timestamps_us(frame))
        _note_frame(reader, frame, "LiDAR")
    pairs = ray.shape == (len(times), 3) and distance.ndim == 2 and distance.shape[1] == len(ray)
    if not pairs or intensity.shape != distance.shape:
        what = "rays and returns of a sweep do not pair up"
        raise InputError(what, where=where, got=f"{ray.shape}, {times.shape}, {distance.shape}, {intensity.shape}")
    if len(times) and not begin <= times.min() <= times.max() <= end:
        what = "points were measured outside of their sweep"
        raise InputError(what, where=where, expected=f"{begin} to {end} us", got=f"{times.min()} to {times.max()}")
    # NaN is how the format says that nothing came back
    _, which = there = np.nonzero(np.isfinite(distance) & (distance != 0))
    xyz, times, seen = ray[which] * distance[there][:, None], times[which], intensity[there]
    length = np.linalg.norm(ray, axis=1)
    if not np.isfinite(xyz).all() or (np.abs(length - 1) > 1e-3).any() or (distance[there] < 0).any():
        what = "rays of a sweep make no sense"
        raise InputError(what, where=where, expected="directions of length 1, distances that are not negative")
    if not ((seen >= 0) & (seen <= 1)).all():
        raise InputError("intensity is not in 0 to 1", where=where, got=f"{np.nanmin(seen):g} to {np.nanmax(seen):g}")
    moments, index = np.unique(times, return_inverse=True)
    moved = np.linalg.inv(world_from_lidar) @ recording.world_from(lidar, moments, where)
    xyz = np.einsum("nij,nj->ni", moved[index, :3, :3], xyz) + moved[index, :3, 3]
    dt_s = ((times - at) / MICRO).astype(np.float32)
    return SweepPoints(xyz.astype(np.float32), seen, dt_s, no_returns=int((distance == 0).sum()))


def _note_frame(reader: Any, frame: int, sensor: str) -> None:
    """Note what else is stored with a frame."""
    names = [*reader.get_frame_generic_data_names(frame), *reader.get_frame_generic_meta_data(frame)]
    note_unknown(f"the {sensor} frames of the recording", names, _WITH_FRAMES)


# --- vehicle and objects --------------------------------------------------------------------------


def _ego(recording: _OpenRecording, zero_us: int, moments: Times) -> EgoPath:
    """The path of the rig: its keys, or, where its poses are composed of others, its poses at the times of the
    frames."""
    where = f"{recording.where}: poses of {RIG}"
    with foreign_reader(where):
        moving = dict(recording.poses.get_dynamic_poses())
    keys = [moving[pair][1].astype(np.int64) for pair in moving if {*pair} == {RIG, WORLD}]
    times = np.concatenate(keys) if keys else np.unique(moments)
    poses = recording.world_from(RIG, times, where)
    return common.ego_path([(int(at) - zero_us) / MICRO for at in times], list(poses))


def _tracks(recording: _OpenRecording, zero_us: int) -> tuple[list[Track], list[str]]:
    """Boxes as tracks in the world."""
    where = f"{recording.where}: boxes"
    tracks = BoxTracks(where, LABELS)
    if recording.cuboids is None:
        return [], ["no boxes in the recording: everything counts as static"]
    with foreign_reader(where):
        found = list(recording.cuboids.get_observations())
    by_frame: dict[str, list[Any]] = {}
    for one in found:
        by_frame.setdefault(one.reference_frame_id, []).append(one)
    for frame, boxes in by_frame.items():
        times = np.array([box.reference_frame_timestamp_us for box in boxes], np.int64)
        moments, index = np.unique(times, return_inverse=True)
        poses = recording.world_from(frame, moments, where)
        for box, which in zip(boxes, index, strict=True):
            here = f"{where}: object {box.track_id} at {box.timestamp_us} us"
            turn = Rotation.from_euler(EULER, box.bbox3.rot).as_matrix() if np.isfinite(box.bbox3.rot).all() else np.nan
            local = common.rigid_pose(from_rotation_translation(turn, box.bbox3.centroid), here)
            label, time_s = tracks.label_of(box.class_id), (box.timestamp_us - zero_us) / MICRO
            tracks.add(box.track_id, label, time_s, box.bbox3.dim, poses[which] @ local, where=here)
    return tracks.tracks()
