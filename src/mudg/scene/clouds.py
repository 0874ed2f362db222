"""Fused clouds on disk.

static.safetensors       xyz f32[N, 3] metres (world), rgb u8[N, 3], semantics u8[N] if there were labels
objects/000.safetensors  the same in the frame of one tracked box; fuse.json says which
fuse.json                counts, rules, a verdict per track; how the cameras show the points' colours
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from mudg.base import store
from mudg.base.errors import InputError, IntegrityError
from mudg.base.geometry import invert
from mudg.base.types import SAME_COLORS, CameraColors, EgoPath, FusedCloud, PointCloud, SweepPoints

# returns ------------------------------------------------------------------------------------------
# Sensors and drivers write beams without a return among the points: as (0, 0, 0), as NaN, or with a range of zero. In a
# file of points in the sensor's own frame such rows are told by their numbers (``is_return``). Once a format or an
# importer has moved points (to the vehicle's frame, to one moment), the zeros lie at the sensor's own place
# (``at_sensor``), where no real return can be.

LEAST_RANGE_M: Final = 0.05
"""Nearer than this lies the sensor's own housing."""
_MOMENTS: Final = 17
FLOAT32_SPACING_M: Final = 1e-3


def is_return(xyz: NDArray[Any]) -> NDArray[np.bool_]:
    """Rows of coordinates [N, k] that are a return, bool[N]: not all zero, and not all NaN or infinite."""
    return np.any(xyz != 0, axis=1) & np.isfinite(xyz).any(axis=1)


def near_places(xyz: NDArray[Any], places: Iterable[NDArray[np.float64]]) -> NDArray[np.bool_]:
    """Points [N, 3] within 0.05 m of one of some places f64[3], bool[N]."""
    near = np.zeros(len(xyz), bool)
    for place in places:
        near |= ((xyz - place) ** 2).sum(1) < LEAST_RANGE_M**2
    return near


def at_sensor(
    points: SweepPoints, time_s: float, world_from_lidar: NDArray[np.float64], ego: EgoPath
) -> NDArray[np.bool_]:
    """Points within 0.05 m of where the sensor was at the sweep's time or at the point's own, bool[N]. ``points``: in
    the LiDAR's frame at ``time_s``, that of the sweep. ``ego``: the vehicle, which carries the sensor."""
    near = near_places(points.xyz, [np.zeros(3, np.float32)])
    mount = ego.pose_at(time_s)
    if mount is None or not len(points.dt_s) or not points.dt_s.any():
        return near
    first, last = float(ego.times_s[0]), float(ego.times_s[-1])
    moments = np.linspace(float(points.dt_s.min()), float(points.dt_s.max()), _MOMENTS)
    lidar_from_world, ego_from_lidar = invert(world_from_lidar), invert(mount) @ world_from_lidar
    poses = [ego.pose_at(min(max(time_s + float(moment), first), last)) for moment in moments]
    moved = [np.eye(4) if pose is None else lidar_from_world @ pose @ ego_from_lidar for pose in poses]
    places = np.stack(moved)[:, :3, 3]
    reach = float(np.linalg.norm(places, axis=1).max()) + LEAST_RANGE_M
    close = np.flatnonzero((np.abs(points.xyz) < reach).all(1))  # the rest is farther than the sensor ever was
    place = np.stack([np.interp(points.dt_s[close], moments, places[:, axis]) for axis in range(3)], 1)
    near[close] |= np.linalg.norm(points.xyz[close] - place, axis=1) < LEAST_RANGE_M
    return near


def float32_spacing_m(places: NDArray[Any]) -> float:
    """Distance of neighbouring float32 numbers at the farthest of some finite coordinates, metres."""
    return float(np.spacing(np.float32(np.abs(places).max(initial=0.0))))


# cloudfile ----------------------------------------------------------------------------------------


def write_fused(folder: Path | str, cloud: FusedCloud, report: Mapping[str, Any]) -> None:
    """Write a fused cloud and its report; ``fuse.json`` comes last, without it the folder is not a fused cloud."""
    folder = Path(folder)
    static = _write_cloud(folder, "static.safetensors", cloud.static)
    files = {
        track_id: _write_cloud(folder, f"objects/{index:03d}.safetensors", points)
        for index, (track_id, points) in enumerate(cloud.objects.items())
    }
    head = {"format": "mudg-fused", "schema_version": 1, "static": static, "objects": files}
    if cloud.colors.to_common:
        head["camera_colors"] = cloud.colors.record()
    store.write_json(folder / "fuse.json", {**head, **report})


def _write_cloud(folder: Path, name: str, cloud: PointCloud) -> dict[str, Any]:
    """Write a cloud; returns its entry in ``fuse.json``."""
    arrays = {"xyz": cloud.xyz, "rgb": cloud.rgb}
    if cloud.semantics is not None:
        arrays["semantics"] = cloud.semantics
    store.write_safetensors(folder / name, arrays)
    return {"file": name, "sha256": store.sha256_file(folder / name), "points": len(cloud)}


def read_fused(folder: Path | str) -> FusedCloud:
    """Read a fused cloud. InputError: not the output folder of ``fuse``. IntegrityError: a cloud differs from what was
    written."""
    folder = Path(folder)
    index = store.read_json(folder / "fuse.json")
    if not isinstance(index, dict) or index.get("format") != "mudg-fused" or index.get("schema_version") != 1:
        raise InputError("not a fused cloud", where=str(folder / "fuse.json"), remedy="make one with `mudg fuse`")
    try:
        static = _read_cloud(folder, index["static"], "world")
        objects = {str(track_id): _read_cloud(folder, entry, "object") for track_id, entry in index["objects"].items()}
        colors = CameraColors.of_record(index["camera_colors"]) if "camera_colors" in index else SAME_COLORS
    except (KeyError, TypeError, AttributeError, ValueError) as error:
        raise InputError("fuse.json is malformed", where=str(folder / "fuse.json"), got=repr(error)) from error
    return FusedCloud(static, objects, colors)


def _read_cloud(folder: Path, entry: Mapping[str, Any], frame: str) -> PointCloud:
    name = str(entry["file"])
    parts = name.split("/")
    if name != "static.safetensors" and not (len(parts) == 2 and parts[0] == "objects" and parts[1][:-12].isdigit()):
        raise InputError("fuse.json names a file that is not a cloud", where=str(folder / "fuse.json"), got=name)
    path = folder / name
    if not path.is_file():
        raise IntegrityError("a cloud is missing", where=str(path), remedy="run `mudg fuse` again")
    if store.sha256_file(path) != entry["sha256"]:
        what = "a cloud was altered after it was written"
        raise IntegrityError(what, where=str(path), remedy="run `mudg fuse` again")
    arrays = store.read_safetensors(path)
    if not np.isfinite(arrays["xyz"]).all():
        raise InputError("a cloud holds coordinates that are not finite", where=str(path))
    return PointCloud(arrays["xyz"], arrays["rgb"], frame, arrays.get("semantics"))
