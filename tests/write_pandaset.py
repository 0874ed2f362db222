"""A log as a PandaSet sequence, written after the data set's published description; independent of the importer."""

from __future__ import annotations

import copyreg
import gzip
import io
import json
import pickle
from collections.abc import Mapping
from pathlib import Path
from types import FunctionType
from typing import Any

import numpy as np
from PIL import Image
from scipy.spatial.transform import Rotation

from mudg.base.geometry import invert, transform_points, yaw_matrix, yaw_of
from mudg.base.types import EgoPath, Scene
from mudg.formats.importers.common import pose_near
from mudg.scene.read import read_image, read_points

EPOCH_S = 1_557_539_924.0
SOURCE_FROM_WORLD = yaw_matrix(0.8, (12.0, -34.0, 1.5))
"""The data set's world is not the scene's."""
STAMPED_LATE_S = 0.01
"""Images carry a time stamp this long after they were taken."""
POSED_AHEAD_S = 0.02
"""Where cameras are said to be is where they truly are, this long ahead on the vehicle's path."""
CAMERA_OF = {"front": "front_camera", "front_left": "front_left_camera"}


def write_pandaset(
    truth: Scene,
    folder: Path,
    *,
    point_times: bool = False,
    new: bool = False,
    cameras: Mapping[str, str] | None = None,
    suffix: str = ".png",
) -> Path:
    """``folder`` as one sequence; every fifth point is the solid-state LiDAR's. Returns ``folder``. ``point_times``:
    write the points' own times; else all have the frame's, and boxes stay where they are. ``new``: tables as pandas 2
    writes them. ``cameras``: the data set's camera -> camera of the log; None = ``CAMERA_OF``. ``suffix``: of the
    images; ``.jpg`` is what the data set has, ``.png`` loses nothing."""
    path = EgoPath(
        np.array([sweep.time_s for sweep in truth.sweeps]),
        np.stack([pose_near(truth.ego, sweep.time_s) for sweep in truth.sweeps]),
    )
    for theirs, name in (cameras or {theirs: name for name, theirs in CAMERA_OF.items()}).items():
        here = folder / "camera" / theirs
        here.mkdir(parents=True)
        frames = truth.frames_of(name)
        at = lambda time_s: pose_near(path, time_s + STAMPED_LATE_S, 1.0)
        moved = [
            at(v.time_s) @ invert(at(v.time_s - POSED_AHEAD_S)) @ v.world_from_cam for v in (f.view for f in frames)
        ]
        for index, frame in enumerate(frames):
            Image.fromarray(read_image(truth, frame)).save(here / f"{index:02d}{suffix}", quality=95)
        camera = truth.cameras[name]
        _dump(
            here / "intrinsics.json", {"fx": camera.fx, "fy": camera.fy, "cx": camera.cx - 0.5, "cy": camera.cy - 0.5}
        )
        _dump(here / "poses.json", [pose_entry(SOURCE_FROM_WORLD @ pose) for pose in moved])
        _dump(here / "timestamps.json", [EPOCH_S + frame.view.time_s + STAMPED_LATE_S for frame in frames])
    poses = []
    for index, sweep in enumerate(truth.sweeps):
        ego = truth.ego.pose_at(sweep.time_s)
        assert ego is not None
        poses.append(pose_entry(SOURCE_FROM_WORLD @ ego @ yaw_matrix(-np.pi / 2)))  # x right, y forward
        points = read_points(truth, sweep)
        xyz = transform_points(SOURCE_FROM_WORLD @ sweep.world_from_lidar, points.xyz.astype(np.float64))
        late = points.dt_s.astype(np.float64) if point_times else np.zeros(len(xyz))
        table = {"x": xyz[:, 0], "y": xyz[:, 1], "z": xyz[:, 2], "i": points.intensity.astype(np.float64) * 255}
        table |= {"t": EPOCH_S + sweep.time_s + late, "d": (np.arange(len(xyz)) % 5 == 0).astype(np.int64)}
        write_frame(folder / "lidar" / f"{index:02d}.pkl.gz", table, new=new)
        write_frame(folder / "annotations" / "cuboids" / f"{index:02d}.pkl.gz", cuboids(truth, sweep.time_s), new=new)
    _dump(folder / "lidar" / "poses.json", poses)
    _dump(folder / "lidar" / "timestamps.json", [EPOCH_S + sweep.time_s for sweep in truth.sweeps])
    return folder


def cuboids(truth: Scene, time_s: float, places: Mapping[str, np.ndarray] | None = None) -> dict[str, object]:
    """One table of boxes: yaw counts from the y axis, x is the width. ``places``: poses of some boxes, by their
    tracks."""
    rows = []
    for track in truth.tracks:
        pose = (places or {}).get(track.id, track.pose_at(time_s))
        assert pose is not None
        rows.append((track, SOURCE_FROM_WORLD @ pose))
    size = np.array([track.size_m for track, _ in rows])
    place = np.array([pose[:3, 3] for _, pose in rows])
    return {
        "uuid": [track.id for track, _ in rows],
        "label": ["Car" for _ in rows],
        "yaw": np.array([yaw_of(pose) - np.pi / 2 for _, pose in rows]),
        "stationary": np.array([bool(np.ptp(track.world_from_object[:, 0, 3]) == 0) for track, _ in rows]),
        "camera_used": np.full(len(rows), -1),
        **{f"position.{axis}": place[:, k] for k, axis in enumerate("xyz")},
        **{f"dimensions.{axis}": size[:, k] for axis, k in (("x", 1), ("y", 0), ("z", 2))},
        "cuboids.sibling_id": ["-" for _ in rows],
        "cuboids.sensor_id": np.full(len(rows), -1),
    }


def pose_entry(pose: np.ndarray) -> dict[str, dict[str, float]]:
    """A pose as the data set's JSON has it."""
    x, y, z, w = Rotation.from_matrix(pose[:3, :3]).as_quat()
    place = dict(zip("xyz", pose[:3, 3].tolist(), strict=True))
    return {"position": place, "heading": {"w": w, "x": x, "y": y, "z": z}}


def _dump(path: Path, value: object) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(value))


# --- pickled data frames without pandas -----------------------------------------------------------
#
# Classes that pickle under pandas' names, as pandas 1.0 and 2.2 do. Files that pandas itself wrote lie in
# ``golden/pandas_*.pkl.gz``; these here make tables of any content.


class DataFrame:
    """A frame whose state holds a manager."""

    __module__ = "pandas.core.frame"
    state: dict[str, Any]

    def __reduce__(self) -> tuple[Any, ...]:
        return copyreg.__newobj__, (DataFrame,), self.state


class BlockManager:
    """Pandas 1.0: state in a tuple. Pandas 2: blocks and axes as arguments."""

    __module__ = "pandas.core.internals.managers"
    state: Any
    blocks: Any

    def __reduce__(self) -> tuple[Any, ...]:
        if self.state is not None:
            return copyreg.__newobj__, (BlockManager,), self.state
        return BlockManager, self.blocks


class Index:
    """A plain index: ``data``. As ``RangeIndex``: ``start``, ``stop`` and ``step`` of row numbers."""

    __module__ = "pandas.core.indexes.base"

    def __init__(self, **parts: Any) -> None:
        self.parts = parts

    def __reduce__(self) -> tuple[Any, ...]:
        return _new_Index, (type(self), {**self.parts, "name": None})


class RangeIndex(Index):
    """Row numbers."""

    __module__ = "pandas.core.indexes.range"


class Block:
    """Several columns of one type."""

    def __init__(self, values: np.ndarray, places: slice) -> None:
        self.values, self.places = values, places

    def __reduce__(self) -> tuple[Any, ...]:
        return _unpickle_block, (self.values, self.places, 2)


def _new_Index(*_: Any) -> None: ...


def _unpickle_block(*_: Any) -> None: ...


_new_Index.__module__, _unpickle_block.__module__ = Index.__module__, "pandas._libs.internals"


class _Pickler(pickle._Pickler):
    """Writes classes and functions by their names without looking whether they are there."""

    def save_global(self, thing: Any, name: str | None = None) -> None:
        self.save(thing.__module__)
        self.save(name or thing.__qualname__)
        self.write(pickle.STACK_GLOBAL)
        self.memoize(thing)

    dispatch = {**pickle._Pickler.dispatch, FunctionType: save_global}


def frame_bytes(columns: Mapping[str, Any], *, new: bool = False) -> bytes:
    """A pickled frame, as pandas 1.0 (or 2.2 if ``new``) writes it: one block per type."""
    arrays = {name: _column(values) for name, values in columns.items()}
    names = sorted(arrays, key=lambda name: arrays[name].dtype.kind)
    rows = len(next(iter(arrays.values())))
    blocks, first = [], 0
    for kind in dict.fromkeys(arrays[name].dtype for name in names):
        mine = [name for name in names if arrays[name].dtype == kind]
        values = np.empty((len(mine), rows), kind)
        for row, name in enumerate(mine):
            values[row] = arrays[name]
        blocks.append(Block(values, slice(first, first + len(mine), 1)))
        first += len(mine)
    axes = [Index(data=np.array(names, object)), RangeIndex(start=0, stop=rows, step=1)]
    manager, frame = BlockManager(), DataFrame()
    manager.state, manager.blocks = None, (tuple(blocks), axes)
    if not new:
        parts = [{"values": block.values, "mgr_locs": block.places} for block in blocks]
        manager.state = (axes, [b.values for b in blocks], axes[:1], {"0.14.1": {"axes": axes, "blocks": parts}})
    frame.state = {"_mgr" if new else "_data": manager, "_typ": "dataframe", "_metadata": []}
    buffer = io.BytesIO()
    _Pickler(buffer, 5 if new else 4).dump(frame)
    return buffer.getvalue()


def _column(values: Any) -> np.ndarray:
    array = np.asarray(values)
    return array.astype(object) if array.dtype.kind == "U" else array


def write_frame(path: Path, columns: Mapping[str, Any], *, new: bool = False) -> None:
    """A ``.pkl.gz`` file."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(gzip.compress(frame_bytes(columns, new=new), compresslevel=1))
