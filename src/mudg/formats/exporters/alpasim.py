"""A scene as NVIDIA's AlpaSim reads it: a USDZ package with more files (docs/reference/export.md). Microseconds, the
first record at 1 s; the rig is the vehicle, x forward, y left, z up. Source: the layouts of AlpaSim's reader, of
NuRec's writer, and of Autoware's 3dgs_io.
"""

from __future__ import annotations

import hashlib
import math
import uuid
from collections.abc import Callable, Mapping
from typing import Any, Final
from xml.etree import ElementTree

import numpy as np
import yaml
from numpy.typing import NDArray

from mudg.base import geometry, store
from mudg.base.errors import InputError
from mudg.base.types import Camera, Scene
from mudg.core.edit import HeightMap
from mudg.formats.exporters.ncore import MICRO, PoseKeys, intrinsics_of
from mudg.formats.splats import ply
from mudg.formats.splats.cloud import SplatScene
from mudg.formats.splats.usd import to_package
from mudg.scene.motion import Road

MOVES_M: Final = 1.0
"""Objects that go no farther stand."""
NVIDIA_CLASSES: Final[Mapping[str, str]] = {
    "car": "automobile",
    "van": "automobile",
    "vehicle": "other_vehicle",
    "truck": "heavy_truck",
    "tram": "train_or_tram_car",
    "train": "train_or_tram_car",
    "pedestrian": "person",
    "cyclist": "rider",
}
"""Classes of objects as NVIDIA's recordings call them; others keep their names."""
Spans = Mapping[str, list[list[int]]]
"""Camera -> begin and end of each of its images."""


def to_alpasim(
    scene: SplatScene, log: Scene | None, ground: HeightMap | None, surface: NDArray[np.floating] | None = None
) -> bytes:
    """A scene with its motion, the recorded drive and the ground. ``ground``, ``surface``: its height, and points
    f[N, 3] of the road, in our axes. Raises InputError: no drive or no ground is known, or a camera has no place on the
    vehicle."""
    if log is None or not len(log.ego.times_s):
        what = "AlpaSim replays a drive, and none is known here"
        raise InputError(what, where=scene.name, remedy="give --scene SCENE, or a folder made by `mudg run`")
    if ground is None:
        what = "AlpaSim needs the ground, and none is known here"
        raise InputError(what, where=scene.name, remedy="export a folder made by `mudg run`, whose points have classes")
    times_s = [frame.view.time_s for frame in log.frames] + log.ego.times_s.tolist()
    times_s += [float(node.times_s[0]) for node in scene.nodes if node.moves]
    zero_us = MICRO - round(min(times_s) * MICRO)
    us = lambda time_s: round(float(time_s) * MICRO) + zero_us
    spans = {}
    for camera in log.cameras.values():  # the end of an image is later by a microsecond at least
        half = round(camera.readout_s * MICRO / 2)
        middles = sorted(us(frame.view.time_s) for frame in log.frames_of(camera.name))
        spans[camera.name] = [[at - max(half, 1), at + half] for at in middles]
    keys_us = np.array([us(time_s) for time_s in log.ego.times_s], np.int64)
    kept = np.r_[True, np.diff(keys_us) > 0]
    path = PoseKeys(keys_us[kept], scene.file_from_world @ log.ego.world_from_ego[kept])
    if all_spans := [span for own in spans.values() for span in own]:
        path = path.covering(min(begin for begin, _ in all_spans), max(end for _, end in all_spans))
    rig = store.json_text(_rig(log, path, spans)).encode()
    files = {
        "metadata.yaml": yaml.safe_dump(_metadata(log, scene, path, rig), sort_keys=False).encode(),
        "rig_trajectories.json": rig,
        "sequence_tracks.json": store.json_text(_tracks(scene, us)).encode(),
        "mesh_ground.ply": ground_mesh(ground, scene.file_from_world),
    }
    if np.ptp(log.ego.world_from_ego[:, :2, 3], axis=0).max() > 2:  # a vehicle that stands tells no road
        points = np.zeros((0, 3)) if surface is None else geometry.transform_points(scene.file_from_world, surface)
        files["map.xodr"] = opendrive(Road(scene.file_from_world @ log.ego.world_from_ego), points, log.id)
    return to_package(scene, None, log, files)


def _metadata(log: Scene, scene: SplatScene, path: PoseKeys, rig: bytes) -> dict[str, Any]:
    content = hashlib.sha256(rig)
    digest = content.hexdigest()
    for node in scene.nodes:
        content.update(node.cloud.means.tobytes() + node.cloud.sh.tobytes() + node.world_from_node.tobytes())
    return {
        "scene_id": log.id,
        "version_string": str(scene.facts.get("generator", "mudg")),
        "training_date": "1970-01-01",  # the same scene gives the same bytes
        "dataset_hash": digest,
        "uuid": str(uuid.uuid5(uuid.NAMESPACE_URL, f"mudg:{content.hexdigest()}")),
        "is_resumable": False,
        "sensors": {"camera_ids": list(log.cameras), "lidar_ids": sorted({sweep.sensor for sweep in log.sweeps})},
        "logger": {"name": "mudg", "run_id": None, "run_url": None},
        "time_range": {"start": int(path.times_us[0]), "end": int(path.times_us[-1])},
        "training_step_outputs": {},
    }


def _rig(log: Scene, path: PoseKeys, spans: Spans) -> dict[str, Any]:
    trajectory = {
        "sequence_id": log.id,
        "rig_bbox": None,
        "T_rig_world_timestamps_us": path.times_us.tolist(),
        "T_rig_worlds": path.poses.tolist(),
        "cameras_frame_timestamps_us": {f"{name}@{log.id}": own for name, own in spans.items()},
        "lidars_frame_timestamps_us": {},
    }
    calibrations = {
        f"{camera.name}@{log.id}": {
            "sequence_id": log.id,
            "logical_sensor_name": camera.name,
            "unique_sensor_idx": index,
            "T_sensor_rig": _mount(log, camera).tolist(),
            "camera_model": {"type": "opencv-pinhole", "parameters": intrinsics_of(camera)},
        }
        for index, camera in enumerate(log.cameras.values())
    }
    return {
        "world_to_nre": {"matrix": np.eye(4).tolist()},
        "T_world_base": np.eye(4).tolist(),
        "rig_trajectories": [trajectory],
        "camera_calibrations": calibrations,
        "lidar_calibrations": {},
    }


def _mount(log: Scene, camera: Camera) -> NDArray[np.float64]:
    """Rig-from-camera f64[4, 4], as at the camera's middle image."""
    frames = log.frames_of(camera.name)
    for frame in sorted(frames, key=lambda one: abs(one.view.time_s - frames[len(frames) // 2].view.time_s)):
        ego = log.ego.pose_at(frame.view.time_s)
        if ego is not None:
            return geometry.invert(ego) @ frame.view.world_from_cam
    raise InputError("the vehicle's path covers no image of a camera", where=f"{log.id}: camera {camera.name}")


def _tracks(scene: SplatScene, us: Callable[[float], int]) -> dict[str, Any]:
    """Paths of the objects; one with a single key is there for no time, and is left out."""
    tracks = [node for node in scene.nodes if node.moves and len(node.times_s) > 1]
    poses = [scene.file_from_world @ node.world_from_node for node in tracks]
    moved_m = [np.linalg.norm(np.ptp(node.world_from_node[:, :3, 3], axis=0)) for node in tracks]
    place_and_turn = lambda pose: [*pose[:3, 3].tolist(), *geometry.quaternion_from_matrix(pose)[[1, 2, 3, 0]].tolist()]
    data = {
        "tracks_id": [node.name for node in tracks],
        "tracks_label_class": [NVIDIA_CLASSES.get(node.label, node.label) for node in tracks],
        "tracks_flags": ["CONTROLLABLE" if metres > MOVES_M else "NONE" for metres in moved_m],
        "tracks_timestamps_us": [[us(time_s) for time_s in node.times_s] for node in tracks],
        "tracks_poses": [[place_and_turn(pose) for pose in keys] for keys in poses],
    }
    sizes = {"cuboids_dims": [list(map(float, node.size_m)) for node in tracks]}
    return {scene.name: {"tracks_data": data, "cuboidtracks_data": sizes}}


def ground_mesh(ground: HeightMap, file_from_world: NDArray[np.float64]) -> bytes:
    """The cells of a height map as triangles of a PLY file, facing up; unknown cells are holes."""
    known = np.isfinite(ground.heights)
    rows, columns = np.nonzero(known)
    xyz = np.column_stack([ground.origin + np.column_stack([rows, columns]) * ground.cell_m, ground.heights[known]])
    number = np.full(known.shape, -1, np.int64)
    number[known] = np.arange(len(xyz))
    corners = np.stack([number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:]], -1).reshape(-1, 4)
    corners = corners[(corners >= 0).all(1)]
    faces = np.concatenate([corners[:, [0, 1, 2]], corners[:, [0, 2, 3]]])
    table = np.empty(len(faces), [("count", "u1"), ("corner", "<i4", 3)])
    table["count"], table["corner"] = 3, faces
    corners_of = ("face", len(faces), [("list uchar int", "vertex_indices")])
    head = ply.header([("vertex", len(xyz), [("float", axis) for axis in "xyz"]), corners_of])
    return head + geometry.transform_points(file_from_world, xyz).astype("<f4").tobytes() + table.tobytes()


# OpenDRIVE ----------------------------------------------------------------------------------------
# The driven corridor as a minimal map of version 1.6: one road along the recorded path in cubic pieces, the driven lane
# centred on it, and as many lanes of one width beside it as its surface is wide.


LANE_M: Final = 3.5
PIECE_M: Final = 5.0
"""Length of the pieces of the reference line."""
WIDEST_M: Final = 15.0
"""Surface farther from the path belongs to other roads."""
STRIP_M: Final = 4.0
"""Length of the strips whose widths are compared: their median is that of the road."""
FEWEST: Final = 20
"""Points in a strip that tell a width."""


def opendrive(road: Road, surface: NDArray[np.floating], name: str) -> bytes:
    """The map as XML. ``road``: the path, metres, z up. ``surface``: f[N, 3] points of the road's surface in the same
    frame; none: one lane. ``name``: of the map."""
    count = max(1, round(road.length_m / PIECE_M))
    stations = np.linspace(0.0, road.length_m, count + 1)
    poses = np.stack([road.recorded(float(station)) for station in stations])
    pieces = [_piece(before, after) for before, after in zip(poses[:-1], poses[1:], strict=True)]
    starts = np.concatenate([[0.0], np.cumsum([length for length, _ in pieces])])
    root = ElementTree.Element("OpenDRIVE")
    low, high = poses[:, :2, 3].min(0) - WIDEST_M, poses[:, :2, 3].max(0) + WIDEST_M
    header = {"revMajor": "1", "revMinor": "6", "name": name, "version": "1.00", "date": "1970-01-01T00:00:00"}
    header |= _numbers(north=high[1], south=low[1], east=high[0], west=low[0])
    ElementTree.SubElement(root, "header", {**header, "vendor": "mudg"})
    whole = {"name": name, **_numbers(length=starts[-1]), "id": "1", "junction": "-1", "rule": "RHT"}
    element = ElementTree.SubElement(root, "road", whole)
    kind = ElementTree.SubElement(element, "type", {"s": "0", "type": "town"})
    ElementTree.SubElement(kind, "speed", {"max": "50", "unit": "km/h"})
    line, heights = ElementTree.SubElement(element, "planView"), ElementTree.SubElement(element, "elevationProfile")
    for start, pose, after, (length, numbers) in zip(starts, poses, poses[1:], pieces, strict=False):
        heading = math.atan2(pose[1, 0], pose[0, 0])
        at = _numbers(s=start, x=pose[0, 3], y=pose[1, 3], hdg=heading, length=length)
        piece = ElementTree.SubElement(line, "geometry", at)
        ElementTree.SubElement(piece, "paramPoly3", {**numbers, "pRange": "normalized"})
        rise = [one[2, 0] / math.hypot(one[0, 0], one[1, 0]) * length for one in (pose, after)]
        climb = after[2, 3] - pose[2, 3]
        c, d = (3 * climb - 2 * rise[0] - rise[1]) / length**2, (rise[0] + rise[1] - 2 * climb) / length**3
        terms = _numbers(s=start, a=pose[2, 3], b=rise[0] / length, c=c, d=d)
        ElementTree.SubElement(heights, "elevation", terms)
    _lanes(element, *lanes_beside(road, surface))
    ElementTree.indent(root, " ")
    return b'<?xml version="1.0" encoding="UTF-8"?>\n' + ElementTree.tostring(root) + b"\n"


def _piece(before: NDArray[np.float64], after: NDArray[np.float64]) -> tuple[float, dict[str, str]]:
    """Length and coefficients of the cubic from pose to pose f64[4, 4], which keeps both headings."""
    heading = math.atan2(before[1, 0], before[0, 0])
    turn = math.atan2(after[1, 0], after[0, 0]) - heading
    dx, dy = after[:2, 3] - before[:2, 3]
    u, v = math.cos(heading) * dx + math.sin(heading) * dy, math.cos(heading) * dy - math.sin(heading) * dx
    chord = math.hypot(u, v)
    end = chord * np.array([math.cos(turn), math.sin(turn)])
    c = 3 * np.array([u, v]) - np.array([2 * chord, 0.0]) - end
    d = np.array([chord, 0.0]) + end - 2 * np.array([u, v])
    p = np.linspace(0, 1, 201)[:, None]
    speed = np.linalg.norm(np.array([chord, 0.0]) + 2 * c * p + 3 * d * p**2, axis=1)
    numbers = _numbers(aU=0.0, bU=chord, cU=c[0], dU=d[0], aV=0.0, bV=0.0, cV=c[1], dV=d[1])
    return float(np.trapezoid(speed, p[:, 0])), numbers


def lanes_beside(road: Road, surface: NDArray[np.floating]) -> tuple[int, int]:
    """Number of lanes to the left and to the right of the driven one, by the width of the road's surface."""
    near = np.array([road.locate(point) for point in surface[:: max(1, len(surface) // 20_000), :2]]).reshape(-1, 2)
    near = near[(abs(near[:, 1]) < WIDEST_M) & (near[:, 0] >= 0) & (near[:, 0] <= road.length_m)]
    strips = [near[(near[:, 0] // STRIP_M) == n, 1] for n in range(int(road.length_m // STRIP_M) + 1)]
    wide = [np.quantile(strip, (0.98, 0.02)) for strip in strips if len(strip) >= FEWEST]
    left, right = np.median(wide, axis=0) if wide else (0.0, 0.0)
    beside = lambda reach: max(0, math.floor((reach - LANE_M / 2) / LANE_M + 0.25))
    return beside(float(left)), beside(-float(right))


def _lanes(element: ElementTree.Element, left: int, right: int) -> None:
    lanes = ElementTree.SubElement(element, "lanes")
    ElementTree.SubElement(lanes, "laneOffset", _numbers(s=0, a=LANE_M / 2, b=0, c=0, d=0))
    section = ElementTree.SubElement(lanes, "laneSection", {"s": "0"})
    sides = {"left": range(left, 0, -1), "center": (0,), "right": range(-1, -right - 2, -1)}
    for side, ids in sides.items():
        if not ids:
            continue
        group = ElementTree.SubElement(section, side)
        for number in ids:
            kind = "driving" if number else "none"
            lane = ElementTree.SubElement(group, "lane", {"id": str(number), "type": kind, "level": "false"})
            if number:
                ElementTree.SubElement(lane, "width", _numbers(sOffset=0, a=LANE_M, b=0, c=0, d=0))


def _numbers(**values: float) -> dict[str, str]:
    return {name: f"{value:.9g}" if abs(value) > 1e-12 else "0" for name, value in values.items()}
