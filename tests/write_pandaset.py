"""A log as a PandaSet sequence, written after the data set's published description; independent of the importer."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from pandas_pickles import write_frame
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
    """``folder`` as one sequence; every fifth point is the solid-state LiDAR's. Returns ``folder``.

    Args:
        point_times: write the points' own times; else all have the frame's, and boxes stay where they are.
        new: tables as pandas 2 writes them.
        cameras: the data set's camera -> camera of the log; None = ``CAMERA_OF``.
        suffix: of the images; ``.jpg`` is what the data set has, ``.png`` loses nothing.
    """
    path = EgoPath(
        np.array([sweep.time_s for sweep in truth.sweeps]),
        np.stack([pose_near(truth.ego, sweep.time_s) for sweep in truth.sweeps]),
    )
    for theirs, name in (cameras or {theirs: name for name, theirs in CAMERA_OF.items()}).items():
        here = folder / "camera" / theirs
        here.mkdir(parents=True)
        frames = truth.frames_of(name)
        moved = [
            pose_near(path, f.view.time_s + STAMPED_LATE_S, 1.0)
            @ invert(pose_near(path, f.view.time_s + STAMPED_LATE_S - POSED_AHEAD_S, 1.0))
            @ f.view.world_from_cam
            for f in frames
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
