"""Folders of observations, which synthesize and render write, and fit, score and the report read; and of simulated
sweeps.

observations.json    schema, trajectory, source, kind; one record per view (camera, pose, time, file names)
rgb/000000.png       8-bit colour, for people and programs
data/000000.npz      depth f32 (NaN = none), semantics u8 (255 = unlabelled), confidence f16, mask u8: compressed to
                     a third or half, without loss
"""

from __future__ import annotations

import io
import zipfile
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch
from numpy.typing import NDArray

from mudg.base import geometry, store
from mudg.base.errors import InputError
from mudg.base.records import understood
from mudg.base.types import Observation, ObservationKind, View
from mudg.core.pictures import to_bytes
from mudg.scene.read import decode_image
from mudg.scene.schema import camera_to_json, parse_camera

_INDEX = "observations.json"
_SCHEMA = 2
_NAMES = ("confidence", "mask", "depth", "semantics")
_TYPES = {name: np.dtype(kind) for name, kind in zip(_NAMES, ("f2", "u1", "f4", "u1"), strict=True)}
_HEADER_BYTES = 4096
"""More than the header of an array takes."""


class ObservationWriter:
    """Write observations of one trajectory, in order, resumably. Those written by an interrupted run are kept: ``done``
    says how many. The index appears when the writer is closed without an exception, so an unfinished folder is not
    readable as a finished one."""

    def __init__(self, out: Path, trajectory: str, source: str, kind: ObservationKind = "virtual") -> None:
        self._out, self._trajectory, self._source, self._kind = Path(out), trajectory, source, kind
        self._records: list[dict[str, Any]] = []
        self.done = 0
        while data_path(self._out, self.done).is_file():
            self.done += 1

    def __enter__(self) -> ObservationWriter:
        return self

    def skip(self, view: View) -> None:
        """Record a view whose files an earlier run has written."""
        path, camera = data_path(self._out, len(self._records)), view.camera
        arrays = _unpacked(store.read_bytes(path), path, (camera.height, camera.width), ())
        self._record(view, "depth" in arrays, "semantics" in arrays)

    def add(self, observation: Observation) -> None:
        """Write one observation and record its view."""
        name = f"{len(self._records):06d}"
        if not bool(torch.isfinite(observation.rgb).all()):
            count = int((~torch.isfinite(observation.rgb)).sum())
            what = "colours of an observation are not finite"
            raise InputError(what, where=f"{self._out}, view {name}", got=f"{count} values")
        store.write_image(self._out / "rgb" / f"{name}.png", to_bytes(observation.rgb), compress_level=1)
        given = {"confidence": observation.confidence[0], "mask": observation.mask[0]}
        if observation.depth is not None:
            given["depth"] = observation.depth[0]
        if observation.semantics is not None:
            given["semantics"] = observation.semantics
        arrays = {name: values.detach().cpu().numpy().astype(_TYPES[name]) for name, values in given.items()}
        store.atomic_write(data_path(self._out, len(self._records)), _packed(arrays))
        self._record(observation.view, "depth" in given, "semantics" in given)

    def _record(self, view: View, has_depth: bool, has_semantics: bool) -> None:
        camera = {"name": view.camera.name, **camera_to_json(view.camera)}
        place = {"camera": camera, "world_from_cam": view.world_from_cam.tolist(), "time_s": view.time_s}
        self._records.append({**place, "depth": has_depth, "semantics": has_semantics})

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if kind is None:
            head = {"schema": _SCHEMA, "trajectory": self._trajectory, "source": self._source, "kind": self._kind}
            store.write_json(self._out / _INDEX, {**head, "observations": self._records})


def data_path(folder: Path, index: int) -> Path:
    """Where the arrays of one observation lie."""
    return folder / "data" / f"{index:06d}.npz"


def _packed(arrays: Mapping[str, NDArray[Any]]) -> bytes:
    """Arrays as a compressed .npz file; equal arrays give equal bytes."""
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w") as archive:
        for name, array in arrays.items():
            content = io.BytesIO()
            np.lib.format.write_array(content, array, allow_pickle=False)
            archive.writestr(zipfile.ZipInfo(f"{name}.npy"), content.getvalue(), zipfile.ZIP_DEFLATED, compresslevel=1)
    return out.getvalue()


def _unpacked(content: bytes, path: Path, shape: tuple[int, int], wanted: Sequence[str]) -> dict[str, NDArray[Any]]:
    """The arrays of an .npz file that are known here; InputError where one is missing, of another type or size, or
    larger than its view."""
    arrays = {}
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            there = {info.filename: info for info in archive.infolist()}
            for name, kind in _TYPES.items():
                info = there.get(f"{name}.npy")
                if info is not None and info.file_size <= kind.itemsize * shape[0] * shape[1] + _HEADER_BYTES:
                    arrays[name] = np.lib.format.read_array(io.BytesIO(archive.read(info)), allow_pickle=False)
    except (zipfile.BadZipFile, zlib.error, ValueError, EOFError, NotImplementedError, RuntimeError) as error:
        raise InputError("not a valid .npz file", where=str(path), got=str(error)) from error
    for name in (*wanted, *arrays):
        array = arrays.get(name)
        if array is None or array.shape != shape or array.dtype != _TYPES[name]:
            what, got = "an observation file does not fit its view", "missing, or too large"
            got = got if array is None else f"{array.dtype}{list(array.shape)}"
            raise InputError(what, where=f"{path}: {name}", expected=f"{_TYPES[name]}{list(shape)}", got=got)
    return arrays


@dataclass(frozen=True)
class ObservationSet:
    """Observations of one trajectory on disk; indexing loads one."""

    path: Path
    trajectory: str
    source: str
    kind: ObservationKind
    views: tuple[View, ...]
    has_depth: tuple[bool, ...]
    has_semantics: tuple[bool, ...]

    def __len__(self) -> int:
        return len(self.views)

    def rgb_u8(self, index: int) -> NDArray[np.uint8]:
        """Colour u8[H, W, 3] of one observation."""
        path = self.path / "rgb" / f"{index:06d}.png"
        return decode_image(store.read_bytes(path), str(path), self.views[index].camera)

    def arrays(self, index: int) -> dict[str, NDArray[Any]]:
        """What the data file of one observation holds, as stored: confidence f16, mask u8, and where there are any
        depth f32 and semantics u8, [H, W] each; InputError where an array is missing or of another size."""
        if not 0 <= index < len(self):
            raise IndexError(index)
        camera = self.views[index].camera
        path, shape = data_path(self.path, index), (camera.height, camera.width)
        wanted = ["confidence", "mask"] + ["depth"] * self.has_depth[index] + ["semantics"] * self.has_semantics[index]
        arrays = _unpacked(store.read_bytes(path), path, shape, wanted)
        return {name: arrays[name] for name in wanted}

    def __getitem__(self, index: int) -> Observation:
        arrays, view = self.arrays(index), self.views[index]
        return Observation(
            view=view,
            rgb=torch.from_numpy(self.rgb_u8(index).copy()).permute(2, 0, 1).float() / 255,
            depth=torch.from_numpy(arrays["depth"].copy())[None] if self.has_depth[index] else None,
            semantics=torch.from_numpy(arrays["semantics"].astype(np.int64)) if self.has_semantics[index] else None,
            confidence=torch.from_numpy(arrays["confidence"].astype(np.float32))[None],
            mask=torch.from_numpy(arrays["mask"].astype(bool))[None],
            kind=self.kind,
            source=self.source,
        )


def read_observations(path: Path) -> ObservationSet:
    """Open a folder of observations; nothing but the index is read. InputError: the folder has no index (unfinished or
    not an observation folder) or a record is malformed."""
    index = Path(path) / _INDEX
    if not index.is_file():
        raise InputError("not a finished folder of observations", where=str(path), expected=f"a file {_INDEX}")
    content = store.read_json(index)
    try:
        if content["schema"] != _SCHEMA:
            what = "unknown schema version"
            raise InputError(what, where=str(index), expected=str(_SCHEMA), got=str(content["schema"]))
        records = content["observations"]
        if not records:
            raise InputError("no views are listed", where=str(index))
        cameras = [
            parse_camera(str(r["camera"].pop("name")), r["camera"], f"{index}: observations[{i}].camera")
            for i, r in enumerate(records)
        ]
        poses = [np.asarray(r["world_from_cam"], np.float64) for r in records]
        views = tuple(View(c, p, float(r["time_s"])) for c, p, r in zip(cameras, poses, records, strict=True))
        has_depth, has_semantics = (tuple(bool(r[key]) for r in records) for key in ("depth", "semantics"))
        kind: ObservationKind = "recorded" if content["kind"] == "recorded" else "virtual"
        trajectory, source = str(content["trajectory"]), str(content["source"])
        return ObservationSet(Path(path), trajectory, source, kind, views, has_depth, has_semantics)
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise InputError("a record of the index is malformed", where=str(index), got=repr(error)) from error


def list_observation_sets(path: Path) -> dict[str, Path]:
    """Trajectory folders below ``path``, by name; ``path`` itself if it is one."""
    path = Path(path)
    places = [path] if (path / _INDEX).is_file() else sorted(path.iterdir()) if path.is_dir() else []
    return {p.name: p for p in places if (p / _INDEX).is_file()}


# simulated sweeps: what ``mudg render --lidar`` writes and ``mudg score`` reads -------------------------
# sweeps.json          schema, trajectory, sensor, shift in metres; one record per sweep: id of the recorded sweep, if
#                      its own beams are fired, times and world-from-sensor poses of start and end, file
# 000000.safetensors   xyz f32[N, 3], intensity f32[N], dt_s f32[N], classes u8[N] as a scene stores sweeps, in the
#                      frame of the sweep's end; of every return ring u16[N], beam i64[N]; of all beams in firing order
#                      directions f32[B, 3] in the frame of their moment, share f32[B], range_m f32[B] of the surface
#                      that is met (NaN: none), facing f32[B]

SWEEPS_INDEX: Final = "sweeps.json"
_SWEEPS_SCHEMA: Final = 1
_BEAM_COLUMNS: Final = {"directions": (3,), "share": (), "range_m": (), "facing": ()}
_RETURN_COLUMNS: Final = {"xyz": (3,), "intensity": (), "dt_s": (), "beam": ()}


@dataclass(frozen=True, slots=True, eq=False)
class SimulatedSweep:
    """A sweep of a set. ``id``: of the recorded sweep at whose time it is taken. ``own_beams``: it fires that sweep's
    beams. ``start``, ``end``: world-from-sensor f64[4, 4]. ``start_s``, ``end_s``: on the scene's clock. ``file``: name
    in the folder."""

    id: str
    own_beams: bool
    start: NDArray[np.float64]
    end: NDArray[np.float64]
    start_s: float
    end_s: float
    file: str


@dataclass(frozen=True, slots=True, eq=False)
class SweepSet:
    """Simulated sweeps of one trajectory."""

    folder: Path
    trajectory: str
    sensor: str
    shift_m: float
    sweeps: tuple[SimulatedSweep, ...]

    def arrays(self, sweep: SimulatedSweep) -> dict[str, NDArray[Any]]:
        """What the file of a sweep holds. InputError: arrays that are missing or do not fit each other."""
        path = self.folder / sweep.file
        arrays = store.read_safetensors(path)
        for columns, first in ((_BEAM_COLUMNS, "share"), (_RETURN_COLUMNS, "beam")):
            for name, inner in columns.items():
                expected = (len(arrays.get(first, ())), *inner)
                if name not in arrays or arrays[name].shape != expected:
                    got = "missing" if name not in arrays else str(arrays[name].shape)
                    what = "a simulated sweep does not fit together"
                    raise InputError(what, where=f"{path}: {name}", expected=str(expected), got=got)
        if len(arrays["beam"]) and not 0 <= arrays["beam"].min() <= arrays["beam"].max() < len(arrays["share"]):
            raise InputError("a return belongs to no beam", where=str(path), got=str(arrays["beam"].max()))
        return arrays


def write_index(sweeps: SweepSet) -> None:
    """Write ``sweeps.json``; without it the folder is not a finished set."""
    fields = ("trajectory", "sensor", "shift_m")
    head = {"schema": _SWEEPS_SCHEMA, **{name: getattr(sweeps, name) for name in fields}}
    store.write_json(sweeps.folder / SWEEPS_INDEX, {**head, "sweeps": list(map(asdict, sweeps.sweeps))})


def read_sweep_sets(folder: Path) -> dict[str, SweepSet]:
    """The sets below ``folder/lidar``, by trajectory; none where that folder is not there. InputError: a malformed
    index."""
    found = {}
    for index in sorted((Path(folder) / "lidar").glob(f"*/{SWEEPS_INDEX}")):
        with understood("simulated sweeps", str(index)):
            content, place = store.read_json(index), index.parent
            if content["schema"] != _SWEEPS_SCHEMA:
                what, got = "unknown schema of simulated sweeps", str(content["schema"])
                raise InputError(what, where=str(index), expected=str(_SWEEPS_SCHEMA), got=got)
            sweeps = tuple(_sweep(record, str(index)) for record in content["sweeps"])
            sensor, shift_m = str(content["sensor"]), float(content["shift_m"])
            found[place.name] = SweepSet(place, place.name, sensor, shift_m, sweeps)
    return found


def _sweep(record: Mapping[str, Any], where: str) -> SimulatedSweep:
    start, end = (np.array(record[name], np.float64) for name in ("start", "end"))
    for pose in (start, end):
        if problem := geometry.rigid_problem(pose):
            raise InputError(f"a pose of a simulated sweep is not rigid: {problem}", where=where)
    name = str(record["file"])
    if "/" in name or not name.endswith(".safetensors") or name.startswith("."):
        raise InputError("a simulated sweep lies elsewhere", where=where, got=name[:80])
    times = float(record["start_s"]), float(record["end_s"])
    return SimulatedSweep(str(record["id"]), bool(record["own_beams"]), start, end, *times, name)
