"""A tiny analytic street for tests of fitting and rendering: textured boxes on a plane, one car that drives.

Everything is exact at any view and time, a frame of 96x64 pixels takes about 10 ms, and nothing here uses the renderer
under test.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from mudg.base import geometry
from mudg.base.palette import ID
from mudg.base.types import (
    Camera,
    EgoPath,
    FusedCloud,
    Observation,
    PointCloud,
    Scene,
    Source,
    SweepPoints,
    Track,
    View,
)
from mudg.scene.write import SceneWriter

CAR_SIZE = np.array([4.2, 1.8, 1.5])
CAM_FROM_EGO = geometry.CAM_FROM_EGO_AXES


@dataclass(frozen=True)
class Box:
    """Axis-aligned in its own frame."""

    center: tuple[float, float, float]
    size: tuple[float, float, float]
    train_id: int
    rgb: tuple[float, float, float]
    texture_m: float


STATIC = (
    Box((14, 8.5, 3.5), (16, 3, 7), ID["building"], (0.62, 0.42, 0.33), 1.6),
    Box((34, 9.0, 4.5), (18, 3, 9), ID["building"], (0.75, 0.70, 0.58), 2.2),
    Box((18, -8.5, 4.0), (22, 3, 8), ID["building"], (0.50, 0.52, 0.60), 1.9),
    Box((42, -9.0, 3.0), (16, 3, 6), ID["building"], (0.70, 0.50, 0.45), 1.4),
    Box((11, -5.2, 1.4), (1.2, 1.2, 2.8), ID["vegetation"], (0.25, 0.45, 0.18), 0.35),
    Box((24, 5.4, 1.6), (1.4, 1.4, 3.2), ID["vegetation"], (0.30, 0.50, 0.20), 0.35),
    Box((17, 4.2, 0.75), (4.2, 1.8, 1.5), ID["car"], (0.15, 0.25, 0.60), 0.7),
)
CAR = Box((0, 0, 0), tuple(CAR_SIZE), ID["car"], (0.75, 0.12, 0.10), 0.7)


def ego_pose(time_s: float) -> np.ndarray:
    """6 m/s along a gentle left bend."""
    x = 6.0 * time_s
    return geometry.yaw_matrix(0.012 * x, (x, 0.006 * x * x, 0.0))


def car_pose(time_s: float) -> np.ndarray:
    """Ahead on the right half of the road, slowly pulling away and changing lane."""
    return geometry.yaw_matrix(0.05 + 0.02 * time_s, (9.0 + 7.5 * time_s, -1.9 + 0.6 * time_s, CAR_SIZE[2] / 2))


def camera(name: str = "front", width: int = 96, height: int = 64) -> Camera:
    """About 75 degrees wide."""
    focal = width / 1.55
    return Camera(name, width, height, focal, focal, width / 2, height * 0.47)


def view_at(time_s: float, cam: Camera, yaw_rad: float = 0.0, left_m: float = 0.0) -> View:
    """Camera 1.5 m above the ego origin, turned left by ``yaw_rad``, the vehicle moved ``left_m`` sideways."""
    mount = geometry.yaw_matrix(yaw_rad, (0.0, 0.0, 1.5)) @ geometry.invert(CAM_FROM_EGO)
    return View(cam, ego_pose(time_s) @ geometry.yaw_matrix(0.0, (0.0, left_m, 0.0)) @ mount, time_s)


def cast(origin: np.ndarray, rays: np.ndarray, time_s: float) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Rays ``[N, 3]`` from one origin: distance factor (inf = sky), rgb ``[N, 3]``, train id, is-moving-car."""
    count = len(rays)
    best = np.full(count, np.inf)
    rgb = np.zeros((count, 3))
    train_id = np.full(count, ID["sky"], np.uint8)
    moving = np.zeros(count, bool)
    down = rays[:, 2] < -1e-6
    t = np.where(down, -origin[2] / np.where(down, rays[:, 2], -1.0), np.inf)
    t = np.where(t < 120.0, t, np.inf)
    ground = np.isfinite(t)
    best[ground] = t[ground]
    point = origin + np.where(ground, t, 0.0)[:, None] * rays
    road = np.abs(point[:, 1] - 0.003 * point[:, 0] ** 2) < 4.5
    tone = 0.30 + 0.05 * np.sin(point[:, 0] * 1.3) * np.sin(point[:, 1] * 1.7)
    mark = (np.abs(point[:, 1] - 0.003 * point[:, 0] ** 2) < 0.15) & (point[:, 0] % 4.0 < 2.0)
    tone = np.where(mark, 0.85, tone)
    pave = 0.55 + 0.06 * np.sign(np.sin(point[:, 0] * 3.0) * np.sin(point[:, 1] * 3.0))
    asphalt, stone = tone[:, None] * np.array([1.0, 1.0, 1.02]), pave[:, None] * np.array([1.0, 0.96, 0.9])
    color = np.where(road[:, None], asphalt, stone)
    rgb[ground] = color[ground]
    train_id[ground] = np.where(road, ID["road"], ID["sidewalk"])[ground]
    for box in STATIC:
        _hit_box(box, np.eye(4), origin, rays, best, rgb, train_id, moving, False)
    _hit_box(CAR, car_pose(time_s), origin, rays, best, rgb, train_id, moving, True)
    sky = ~np.isfinite(best)
    lift = (rays[:, 2] / np.linalg.norm(rays, axis=1))[sky, None].clip(0, 1)
    rgb[sky] = (1 - lift) * np.array([0.80, 0.86, 0.92]) + lift * np.array([0.35, 0.55, 0.85])
    return best, rgb, train_id, moving


def _hit_box(box, world_from_box, origin, rays, best, rgb, train_id, moving, is_car) -> None:
    local = geometry.invert(world_from_box)
    o = local[:3, :3] @ origin + local[:3, 3] - np.array(box.center)
    d = rays @ local[:3, :3].T
    d = np.where(np.abs(d) < 1e-9, 1e-9, d)
    half = np.array(box.size) / 2
    t0, t1 = (-half - o) / d, (half - o) / d
    near, far = np.minimum(t0, t1), np.maximum(t0, t1)
    enter, leave = near.max(1), far.min(1)
    hit = (enter < leave) & (enter > 0.05) & (enter < best)
    axis = near.argmax(1)
    point = o + enter[:, None] * d
    u = np.where(axis == 0, point[:, 1], point[:, 0])
    v = np.where(axis == 2, point[:, 1], point[:, 2])
    wave = np.sin(2 * math.pi * u / box.texture_m) * np.sin(2 * math.pi * v / box.texture_m)
    shade = np.array([0.8, 1.0, 1.1])[axis] * (1 + 0.18 * np.tanh(3 * wave))
    best[hit] = enter[hit]
    rgb[hit] = (np.array(box.rgb) * shade[:, None]).clip(0, 1)[hit]
    train_id[hit] = box.train_id
    moving[hit] = is_car


def truth(view: View) -> Observation:
    """The exact observation of a view, as a generated one of full confidence."""
    cam = view.camera
    u, v = np.meshgrid(np.arange(cam.width) + 0.5, np.arange(cam.height) + 0.5)
    rays = np.stack([(u - cam.cx) / cam.fx, (v - cam.cy) / cam.fy, np.ones_like(u)], -1).reshape(-1, 3)
    depth, rgb, train_id, _ = cast(view.center_world, rays @ view.world_from_cam[:3, :3].T, view.time_s)
    shape = (cam.height, cam.width)
    depth = np.where(np.isfinite(depth), depth, np.nan).reshape(shape).astype(np.float32)
    colors = torch.from_numpy(rgb.reshape(*shape, 3).transpose(2, 0, 1).astype(np.float32).copy())
    classes, mask = torch.from_numpy(train_id.reshape(shape).astype(np.int64)), torch.ones(1, *shape, dtype=torch.bool)
    return Observation(view, colors, torch.from_numpy(depth)[None], classes, mask.float(), mask, "virtual", "truth")


def sweep_points(
    time_s: float, beams: int = 24, columns: int = 240
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """One turn of a LiDAR 1.8 m above the ego origin: world points, colours, train ids, on-the-moving-car."""
    azimuth = np.linspace(-math.pi, math.pi, columns, endpoint=False)
    elevation = np.radians(np.linspace(-18, 6, beams))[:, None]
    level, up = np.cos(elevation), np.sin(elevation) * np.ones(columns)
    rays = np.stack([level * np.cos(azimuth), level * np.sin(azimuth), up], -1).reshape(-1, 3)
    pose = ego_pose(time_s)
    origin = pose[:3, 3] + np.array([0, 0, 1.8])
    rays = rays @ pose[:3, :3].T
    t, rgb, train_id, moving = cast(origin, rays, time_s)
    hit = t < 70.0
    return (origin + t[hit, None] * rays[hit]), rgb[hit], train_id[hit], moving[hit]


def write_scene(
    root: Path,
    *,
    frames: int = 8,
    cameras: tuple[str, ...] = ("front",),
    width: int = 96,
    height: int = 64,
    labels: bool = True,
    tracks: bool = True,
    garbled: bool = False,
    dark: tuple[str, ...] = (),
) -> Scene:
    """A scene directory of ``frames`` time steps, 0.3 s apart; frame 3, 7, ... of each camera are test frames.
    ``garbled``: the car's track is larger and elsewhere, across the houses on the left. ``dark``: cameras whose images
    are darker than those of others."""
    times = np.arange(frames) * 0.3
    yaws = {"front": 0.0, "left": 0.9, "right": -0.9}
    split = {}
    with SceneWriter(root, "toy", Source("toy", "Apache-2.0")) as writer:
        for name in cameras:
            cam = camera(name, width, height)
            writer.add_camera(cam)
            for index, time_s in enumerate(times):
                seen = truth(view_at(float(time_s), cam, yaws[name]))
                rgb = (seen.rgb * (140 if name in dark else 255)).round().byte().permute(1, 2, 0).numpy()
                semantics = seen.semantics.numpy().astype(np.uint8)
                given = {"semantics": semantics, "sky": semantics == ID["sky"]} if labels else {}
                writer.add_frame(f"{name}/{index:06d}", seen.view, rgb, labels=given)
                if index % 4 == 3:
                    split[f"{name}/{index:06d}"] = "test"
        for index, time_s in enumerate(times):
            world_from_lidar = ego_pose(float(time_s)) @ geometry.yaw_matrix(0.0, (0.0, 0.0, 1.8))
            xyz = sweep_points(float(time_s))[0]
            local = geometry.transform_points(geometry.invert(world_from_lidar), xyz).astype(np.float32)
            points = SweepPoints(local, np.full(len(local), 0.5, np.float32), np.zeros(len(local), np.float32))
            writer.add_sweep(f"lidar/{index:06d}", "lidar", float(time_s), world_from_lidar, points)
        if garbled:
            keys = np.stack([geometry.yaw_matrix(0.0, (10.0 + 4 * t, 7.0, 2.0)) for t in times])
            writer.add_track(Track("car", "truck", np.array([9.0, 5.0, 4.0]), times, keys))
        elif tracks:
            writer.add_track(Track("car", "car", CAR_SIZE, times, np.stack([car_pose(float(t)) for t in times])))
        writer.set_ego(EgoPath(times, np.stack([ego_pose(float(t)) for t in times])))
        writer.set_split(split)
        return writer.finish()


def fused_cloud(frames: int = 8, semantics: bool = True) -> FusedCloud:
    """What fusing the sweeps would give: exact colours, the moving car in its box frame."""
    static, car = [], []
    for index in range(frames):
        time_s = 0.3 * index
        xyz, rgb, train_id, moving = sweep_points(time_s)
        static.append((xyz[~moving], rgb[~moving], train_id[~moving]))
        own = geometry.transform_points(geometry.invert(car_pose(time_s)), xyz[moving])
        car.append((own, rgb[moving], train_id[moving]))

    def cloud(parts, frame) -> PointCloud:
        xyz, rgb, train_id = (np.concatenate(column) for column in zip(*parts))
        ids = train_id.astype(np.uint8) if semantics else None
        return PointCloud(xyz.astype(np.float32), (rgb * 255).round().astype(np.uint8), frame, ids)

    return FusedCloud(cloud(static, "world"), {"car": cloud(car, "object")})
