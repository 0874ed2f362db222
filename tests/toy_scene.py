"""A made-up street whose images, sweeps and labels are exact: a ground plane, a striped wall, a panel, a car that
moves.

Everything is a rectangle or a box, so every ray has a closed answer. World: z up, ground at z = 0, driving along x.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mudg.base.geometry import CAM_FROM_EGO_AXES, from_rotation_translation, invert, yaw_matrix
from mudg.base.palette import ID
from mudg.base.types import Camera, EgoPath, Scene, Source, SweepPoints, Track, View
from mudg.scene.write import SceneWriter

Matrix = NDArray[np.float64]
GROUND, WALL_LOW, WALL_HIGH, PANEL, CAR, SKY = range(6)
COLORS = np.array(
    [[90, 90, 90], [200, 40, 40], [170, 120, 60], [40, 200, 40], [220, 220, 40], [150, 190, 255]], np.uint8
)
TRAIN_IDS = np.array([ID["road"], ID["building"], ID["building"], ID["wall"], ID["car"], ID["sky"]], np.uint8)
CAR_SIZE_M = np.array([4.0, 2.0, 1.6])
EGO_FROM_CAM = from_rotation_translation(np.eye(3), [0.5, 0, 1.2]) @ invert(CAM_FROM_EGO_AXES)
EGO_FROM_LIDAR = from_rotation_translation(np.eye(3), [0.0, 0, 2.6])


@dataclass(frozen=True)
class ToyStreet:
    """What stands in the street.

    Args:
        wall_x: a wall across the street; its lower half (z < 2) has another colour than the upper.
        panel_x: a low panel (z < 1.6, |y| < 1.5) before the wall; the LiDAR looks over it, the camera does not. None =
            none.
        car: centre of a car by time, or None.
        speed_m_s: of the recording vehicle.
    """

    wall_x: float = 25.0
    panel_x: float | None = None
    car_start: tuple[float, float] | None = None
    car_velocity: tuple[float, float] = (0.0, 0.0)
    speed_m_s: float = 2.0
    times: Sequence[float] = field(default_factory=lambda: [0.1 * n for n in range(5)])

    def world_from_ego(self, time_s: float) -> Matrix:
        """Pose of the vehicle on the ground below its LiDAR."""
        return yaw_matrix(0.0, (self.speed_m_s * time_s, 0.0, 0.0))

    def world_from_car(self, time_s: float) -> Matrix:
        """Pose of the car's box centre; it looks along x."""
        assert self.car_start is not None
        x, y = (s + v * time_s for s, v in zip(self.car_start, self.car_velocity, strict=True))
        return yaw_matrix(0.0, (x, y, CAR_SIZE_M[2] / 2))

    def cast(self, origin: Matrix, directions: Matrix, time_s: float) -> tuple[Matrix, NDArray[np.intp]]:
        """Distance along rays [N, 3] from one origin (inf = sky) and what they meet, [N]."""
        with np.errstate(divide="ignore", invalid="ignore"):
            hits = [_plane(origin, directions, 2, 0.0), _plane(origin, directions, 0, self.wall_x)]
            z_wall = origin[2] + hits[1] * directions[:, 2]
            hits[1][(z_wall < 0) | (z_wall > 4)] = np.inf
            kinds = [np.full(len(directions), GROUND), np.where(z_wall < 2, WALL_LOW, WALL_HIGH)]
            if self.panel_x is not None:
                t = _plane(origin, directions, 0, self.panel_x)
                place = origin + t[:, None] * directions
                t[(place[:, 2] < 0) | (place[:, 2] > 1.6) | (np.abs(place[:, 1]) > 1.5)] = np.inf
                hits.append(t)
                kinds.append(np.full(len(directions), PANEL))
            if self.car_start is not None:
                hits.append(_box(origin, directions, self.world_from_car(time_s)))
                kinds.append(np.full(len(directions), CAR))
        stacked = np.stack(hits)
        first = stacked.argmin(0)
        distance = stacked.min(0)
        kind = np.stack(kinds)[first, np.arange(len(directions))]
        return distance, np.where(np.isfinite(distance), kind, SKY)

    def image(self, view: View) -> tuple[NDArray[np.uint8], NDArray[np.uint8], Matrix]:
        """rgb u8[H, W, 3], train ids u8[H, W], depth f64[H, W] (inf = sky)."""
        camera = view.camera
        u, v = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
        rays = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones_like(u)], -1).reshape(-1, 3)
        depth, kind = self.cast(view.center_world, rays @ view.world_from_cam[:3, :3].T, view.time_s)
        shape = (camera.height, camera.width)
        return COLORS[kind].reshape(*shape, 3), TRAIN_IDS[kind].reshape(shape), depth.reshape(shape)

    def sweep(self, time_s: float) -> tuple[Matrix, SweepPoints, NDArray[np.intp]]:
        """world_from_lidar, points, and what each point lies on."""
        pose = self.world_from_ego(time_s) @ EGO_FROM_LIDAR
        elevation, azimuth = np.meshgrid(np.deg2rad(np.arange(-25, 4, 0.4)), np.deg2rad(np.arange(-60, 60, 0.2)))
        directions = np.stack(
            [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)], -1
        ).reshape(-1, 3)
        distance, kind = self.cast(pose[:3, 3], directions, time_s)
        seen = np.isfinite(distance) & (distance < 80)
        xyz = (directions[seen] * distance[seen, None]).astype(np.float32)
        none = np.zeros(len(xyz), np.float32)
        return pose, SweepPoints(xyz, none + 0.5, none), kind[seen]

    def track(self, times: Sequence[float] | None = None) -> Track:
        """The car's boxes."""
        keys = np.array(self.times if times is None else times)
        return Track("car-1", "car", CAR_SIZE_M, keys, np.stack([self.world_from_car(t) for t in keys]))

    def view(self, time_s: float, width: int = 240, height: int = 120) -> View:
        """The front camera at a time."""
        camera = Camera("front", width, height, width * 0.9, width * 0.9, width / 2, height / 2)
        return View(camera, self.world_from_ego(time_s) @ EGO_FROM_CAM, time_s)

    def write(self, root: Path, *, labels: bool = True, width: int = 240, height: int = 120) -> Scene:
        """The street as a scene directory."""
        with SceneWriter(root, "toy-street", Source("toy", "none")) as writer:
            writer.add_camera(self.view(0.0, width, height).camera)
            for index, time_s in enumerate(self.times):
                view = self.view(time_s, width, height)
                rgb, ids, depth = self.image(view)
                given = {"semantics": ids, "depth": depth, "sky": ~np.isfinite(depth)} if labels else None
                writer.add_frame(f"front/{index:06d}", view, rgb, given)
                pose, points, _ = self.sweep(time_s)
                writer.add_sweep(f"lidar/{index:06d}", "lidar", time_s, pose, points)
            if self.car_start is not None:
                writer.add_track(self.track())
            times = np.array(self.times)
            writer.set_ego(EgoPath(times, np.stack([self.world_from_ego(t) for t in times])))
            writer.set_split({"front/000004": "test"} if len(times) > 4 else {})
            return writer.finish()


def _plane(origin: Matrix, directions: Matrix, axis: int, value: float) -> Matrix:
    t = (value - origin[axis]) / directions[:, axis]
    return np.where((t > 1e-6) & np.isfinite(t), t, np.inf)


def _box(origin: Matrix, directions: Matrix, world_from_box: Matrix) -> Matrix:
    inverse = invert(world_from_box)
    start, rays = inverse[:3, :3] @ origin + inverse[:3, 3], directions @ inverse[:3, :3].T
    a, b = (-CAR_SIZE_M / 2 - start) / rays, (CAR_SIZE_M / 2 - start) / rays
    enter, leave = np.minimum(a, b).max(1), np.maximum(a, b).min(1)
    return np.where((leave >= enter) & (enter > 1e-6), enter, np.inf)
