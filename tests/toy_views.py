"""A tiny scene and rendered views with known errors, for the tests of score and report."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch

from mudg.base.types import Camera, EgoPath, Observation, Source, SweepPoints, View
from mudg.core import trajectory
from mudg.scene.observations import ObservationWriter
from mudg.scene.read import read_scene
from mudg.scene.write import SceneWriter

WIDTH, HEIGHT, FRAMES = 48, 32, 4
CAMERA = Camera("front", WIDTH, HEIGHT, 40.0, 40.0, WIDTH / 2, HEIGHT / 2)
# Camera axes (x right, y down, z forward) in vehicle axes (x forward, y left, z up).
EGO_FROM_CAM = np.array([[0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 1.5], [0, 0, 0, 1]], np.float64)


def colors(index: int) -> np.ndarray:
    """A smooth picture u8[H, W, 3] that differs from frame to frame and stays within 40..200."""
    y, x = np.mgrid[0:HEIGHT, 0:WIDTH].astype(np.float64)
    waves = [np.sin(x / (7 + c) + 0.4 * index + c) + np.cos(y / (5 + c) - 0.3 * index) for c in range(3)]
    return (120 + 40 * np.stack(waves, -1)).round().astype(np.uint8)


def depths() -> np.ndarray:
    """Depth f32[H, W]: 4 m at the bottom to 60 m in the middle, none (sky) above."""
    rows = np.linspace(-1, 1, HEIGHT)[:, None].repeat(WIDTH, 1)
    return np.where(rows > 0.05, 4.0 / np.maximum(rows, 0.0667), np.nan).astype(np.float32)


def classes() -> np.ndarray:
    """Class ids u8[H, W]: sky (10) above, road (0) below, a car (13) in the middle."""
    ids = np.where(np.isnan(depths()), 10, 0).astype(np.uint8)
    ids[HEIGHT // 2 : HEIGHT // 2 + 8, 20:30] = 13
    return ids


def write_scene(root: Path, *, labels: bool = True, test_every: int = 2, lidar: bool = False) -> Path:
    """A scene of one camera and four frames, every second one held out; ``lidar``: a wall 10 m ahead in every sweep."""
    poses = np.stack([np.eye(4) for _ in range(FRAMES)])
    poses[:, 0, 3] = np.arange(FRAMES)
    times = np.arange(FRAMES) * 0.1
    with SceneWriter(root, "toy", Source("toy", "public domain", None, ("times are made up",))) as writer:
        writer.add_camera(CAMERA)
        for i in range(FRAMES):
            extra = {"depth": depths(), "semantics": classes()} if labels else {}
            writer.add_frame(f"front/{i:06d}", View(CAMERA, poses[i] @ EGO_FROM_CAM, times[i]), colors(i), extra)
            if lidar:
                y, z = np.meshgrid(np.linspace(-4, 4, 60), np.linspace(-1, 3, 30))
                wall = np.stack([np.full(y.size, 10.0), y.ravel(), z.ravel()], -1).astype(np.float32)
                zeros = np.zeros(len(wall), np.float32)
                writer.add_sweep(f"top/{i:06d}", "top", times[i], poses[i], SweepPoints(wall, zeros, zeros))
        writer.set_ego(EgoPath(times, poses))
        held = {f"front/{i:06d}": "test" if test_every and i % test_every else "train" for i in range(FRAMES)}
        writer.set_split(held)
        writer.finish()
    return root


def write_views(
    scene: Path,
    out: Path,
    source: str,
    shifts_m: tuple[float, ...],
    change: Callable[[int, Observation], Observation] | None = None,
) -> Path:
    """Views equal to the recorded pictures, or what ``change(index, observation)`` makes of them."""
    loaded = read_scene(scene)
    for shift_m in shifts_m:
        path = trajectory.shifted(loaded, "front", shift_m) if shift_m else trajectory.recorded(loaded, "front")
        with ObservationWriter(out / path.name, path.name, source) as writer:
            for index, view in enumerate(path.views):
                rgb = torch.from_numpy(colors(index)).permute(2, 0, 1).float() / 255
                depth, ids = torch.from_numpy(depths())[None], torch.from_numpy(classes().astype(np.int64))
                mask = torch.ones(1, HEIGHT, WIDTH, dtype=torch.bool)
                seen = Observation(view, rgb, depth, ids, mask.float(), mask, "virtual", source)
                writer.add(seen if change is None else change(index, seen))
    return out
