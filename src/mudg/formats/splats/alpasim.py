"""A scene as NVIDIA's AlpaSim reads it: a USDZ package (see ``usd``) with four more files, found by their names.

    metadata.yaml          names, sensors, first and last microsecond
    rig_trajectories.json  path of the vehicle, calibration of the cameras, begin and end of every image
    sequence_tracks.json   paths, classes and sizes of the objects
    mesh_ground.ply        the ground as triangles, facing up

Times are microseconds, the first record at 1 s. World, and what NuRec calls its own frame, are the world of the file: z
up, metres. The rig is the vehicle, x forward, y left, z up. Source: the layouts of AlpaSim's reader, of NuRec's writer,
and of Autoware's 3dgs_io.
"""

from __future__ import annotations

import hashlib
import uuid
from collections.abc import Mapping
from typing import Any, Final

import numpy as np
import yaml
from numpy.typing import NDArray

from mudg.base import geometry, store
from mudg.base.errors import InputError
from mudg.base.types import Camera, Scene
from mudg.core.edit import HeightMap
from mudg.formats.ncore import MICRO, PoseKeys
from mudg.formats.splats import ply, usd
from mudg.formats.splats.cloud import SplatNode, SplatScene

START_US: Final = MICRO
CONTROLLABLE: Final = "CONTROLLABLE"
STANDING: Final = "NONE"
MOVES_M: Final = 1.0
"""Objects that go no farther stand."""
CLASSES: Final[Mapping[str, str]] = {
    "car": "automobile",
    "van": "automobile",
    "vehicle": "other_vehicle",
    "truck": "heavy_truck",
    "bus": "bus",
    "tram": "train_or_tram_car",
    "train": "train_or_tram_car",
    "pedestrian": "person",
    "person": "person",
    "cyclist": "rider",
    "rider": "rider",
    "bicycle": "bicycle",
    "motorcycle": "motorcycle",
    "trailer": "trailer",
    "stroller": "stroller",
    "animal": "animal",
}
"""Classes of objects as NVIDIA's recordings call them; others keep their names."""
_NO_DATE: Final = "1970-01-01"
"""The hour of writing is not noted: the same scene gives the same bytes."""


def to_package(scene: SplatScene, log: Scene | None, ground: HeightMap | None) -> bytes:
    """A scene with its motion, the drive and the ground.

    Args:
        log: the recorded drive. ground: in the axes of this program.

    Raises:
        InputError: no drive or no ground is known, or a camera has no place on the vehicle.
    """
    if log is None or not len(log.ego.times_s):
        what = "AlpaSim replays a drive, and none is known here"
        raise InputError(what, where=scene.name, remedy="give --scene SCENE, or a folder made by `mudg run`")
    if ground is None:
        what = "AlpaSim needs the ground, and none is known here"
        raise InputError(what, where=scene.name, remedy="export a folder made by `mudg run`, whose points have classes")
    clock = _PackageClock(log, scene)
    rig = store.json_text(_rig(log, scene, clock)).encode()
    files = {
        "metadata.yaml": yaml.safe_dump(_metadata(log, scene, clock, rig), sort_keys=False).encode(),
        "rig_trajectories.json": rig,
        "sequence_tracks.json": store.json_text(_tracks(scene, clock)).encode(),
        "mesh_ground.ply": ground_mesh(ground, scene.file_from_world),
    }
    return usd.to_package(scene, None, log, files)


class _PackageClock:
    """Whole microseconds from the first record on, which is at ``START_US``."""

    def __init__(self, log: Scene, scene: SplatScene) -> None:
        times = [frame.view.time_s for frame in log.frames] + log.ego.times_s.tolist()
        times += [float(node.times_s[0]) for node in scene.nodes if node.moves]
        self._zero_us = START_US - round(min(times) * MICRO)

    def us(self, time_s: float) -> int:
        return round(float(time_s) * MICRO) + self._zero_us


def _spans(log: Scene, camera: Camera, clock: _PackageClock) -> list[list[int]]:
    """Begin and end of every image of a camera, in order of time; the end is later by a microsecond at least."""
    half = round(camera.readout_s * MICRO / 2)
    middles = sorted(clock.us(frame.view.time_s) for frame in log.frames_of(camera.name))
    return [[at - max(half, 1), at + half] for at in middles]


def _metadata(log: Scene, scene: SplatScene, clock: _PackageClock, rig: bytes) -> dict[str, Any]:
    digest = hashlib.sha256(rig).hexdigest()
    content = hashlib.sha256(rig)
    for node in scene.nodes:
        content.update(node.cloud.means.tobytes() + node.cloud.sh.tobytes() + node.world_from_node.tobytes())
    path = _path(log, scene, clock)
    return {
        "scene_id": log.id,
        "version_string": str(scene.facts.get("generator", "mudg")),
        "training_date": _NO_DATE,
        "dataset_hash": digest,
        "uuid": str(uuid.uuid5(uuid.NAMESPACE_URL, f"mudg:{content.hexdigest()}")),
        "is_resumable": False,
        "sensors": {"camera_ids": list(log.cameras), "lidar_ids": sorted({sweep.sensor for sweep in log.sweeps})},
        "logger": {"name": "mudg", "run_id": None, "run_url": None},
        "time_range": {"start": int(path.times_us[0]), "end": int(path.times_us[-1])},
        "training_step_outputs": {},
    }


def _path(log: Scene, scene: SplatScene, clock: _PackageClock) -> PoseKeys:
    """The vehicle in the axes of the file, over the time of all images."""
    times = np.array([clock.us(time_s) for time_s in log.ego.times_s], np.int64)
    kept = np.r_[True, np.diff(times) > 0]
    spans = [span for camera in log.cameras.values() for span in _spans(log, camera, clock)]
    poses = PoseKeys(times[kept], scene.file_from_world @ log.ego.world_from_ego[kept])
    return poses.covering(min(begin for begin, _ in spans), max(end for _, end in spans)) if spans else poses


def _rig(log: Scene, scene: SplatScene, clock: _PackageClock) -> dict[str, Any]:
    path = _path(log, scene, clock)
    cameras = {f"{name}@{log.id}": camera for name, camera in log.cameras.items()}
    trajectory = {
        "sequence_id": log.id,
        "rig_bbox": None,
        "T_rig_world_timestamps_us": path.times_us.tolist(),
        "T_rig_worlds": path.poses.tolist(),
        "cameras_frame_timestamps_us": {unique: _spans(log, camera, clock) for unique, camera in cameras.items()},
        "lidars_frame_timestamps_us": {},
    }
    calibrations = {
        unique: {
            "sequence_id": log.id,
            "logical_sensor_name": camera.name,
            "unique_sensor_idx": index,
            "T_sensor_rig": _mount(log, camera).tolist(),
            "camera_model": {"type": "opencv-pinhole", "parameters": intrinsics(camera)},
        }
        for index, (unique, camera) in enumerate(cameras.items())
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


def intrinsics(camera: Camera) -> dict[str, Any]:
    """A pinhole camera as NCore tells it: principal point from the corner of the image."""
    return {
        "resolution": [camera.width, camera.height],
        "shutter_type": "ROLLING_TOP_TO_BOTTOM" if camera.readout_s > 0 else "GLOBAL",
        "external_distortion_parameters": None,
        "principal_point": [camera.cx, camera.cy],
        "focal_length": [camera.fx, camera.fy],
        "radial_coeffs": [0.0] * 6,
        "tangential_coeffs": [0.0] * 2,
        "thin_prism_coeffs": [0.0] * 4,
    }


def _tracks(scene: SplatScene, clock: _PackageClock) -> dict[str, Any]:
    """Paths of the objects; one with a single key is there for no time, and is left out."""
    tracks = [node for node in scene.nodes if node.moves and len(node.times_s) > 1]
    poses = [scene.file_from_world @ node.world_from_node for node in tracks]
    told = {
        "tracks_id": [node.name for node in tracks],
        "tracks_label_class": [CLASSES.get(node.label, node.label) for node in tracks],
        "tracks_flags": [_flag(node) for node in tracks],
        "tracks_timestamps_us": [[clock.us(time_s) for time_s in node.times_s] for node in tracks],
        "tracks_poses": [[_seven(pose) for pose in keys] for keys in poses],
    }
    return {
        scene.name: {
            "tracks_data": told,
            "cuboidtracks_data": {"cuboids_dims": [list(map(float, node.size_m)) for node in tracks]},
        }
    }


def _flag(node: SplatNode) -> str:
    places = node.world_from_node[:, :3, 3]
    return CONTROLLABLE if np.linalg.norm(np.ptp(places, axis=0)) > MOVES_M else STANDING


def _seven(pose: NDArray[np.float64]) -> list[float]:
    """x y z qx qy qz qw."""
    return [*pose[:3, 3].tolist(), *geometry.quaternion_from_matrix(pose)[[1, 2, 3, 0]].tolist()]


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
    head = ply.header(
        [
            ("vertex", len(xyz), [("float", axis) for axis in "xyz"]),
            ("face", len(faces), [("list uchar int", "vertex_indices")]),
        ]
    )
    return head + geometry.transform_points(file_from_world, xyz).astype("<f4").tobytes() + table.tobytes()
