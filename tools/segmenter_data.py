"""Training and scoring images for the shipped segmentation network: generated cities with LiDAR evidence and exact
classes.

A city is a function of (seed, number). It is looked at four times, forwards or to any side, with its sweeps put
together as `mudg annotate` does. Field of view, mounting, number and elevations of beams, number of sweeps, and errors
of boxes vary from city to city.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mudg.base import geometry, seeds, store
from mudg.base.types import Track, View
from mudg.city import logs as city_logs
from mudg.city.config import CityConfig
from mudg.city.world import CityWorld
from mudg.core.fusion import STATIC, FusionRules, SweepShots, judge_track, measure_beam_gap, separate
from mudg.labels.evidence import Evidence, gather
from mudg.labels.inputs import LabelInput

FRAMES = 14
VIEWS = 4
GAP_SPREAD = 1.4
"""Beams lie unevenly: the largest gap beside the median one."""


@dataclass(frozen=True)
class Sample:
    """An image u8[H, W, 3], what was measured, and its true classes u8[H, W]."""

    rgb: NDArray[np.uint8]
    evidence: Evidence
    truth: NDArray[np.uint8]


def city_config(seed: int, city: int, width: int, height: int) -> CityConfig:
    """The configuration of a training city."""
    rng = seeds.numpy_rng(seed, city, "segmenter city configuration")
    lower, upper = (float(x) for x in ((-25, 3), (-30, 10), (-18, 3), (-25, 15), (-25, 15))[rng.integers(5)])
    return CityConfig(
        seed=seeds.key(seed, city, "segmenter city") & 0x7FFFFFFF,
        n_frames=FRAMES,
        width=width,
        height=height,
        cameras=("front",),
        rate_hz=float(rng.choice([10.0, 10.0, 5.0])),
        hfov_deg=float(rng.uniform(50, 85)),
        rig_variation=1.0,
        lidar_beams=int(rng.choice([128, 64, 64, 64, 40, 32, 32, 16])),
        lidar_azimuth_step_deg=float(rng.choice([0.2, 0.2, 0.35])),
        lidar_lower_deg=lower,
        lidar_upper_deg=upper,
        lidar_range_m=float(rng.choice([70, 90, 120])),
        lidar_dropout=float(rng.uniform(0.02, 0.15)),
        lidar_noise_m=float(rng.uniform(0.01, 0.03)),
        traffic=float(rng.uniform(0.6, 2.0)),
    )


def samples(seed: int, city: int, width: int, height: int) -> Iterator[Sample]:
    """The images of a training city."""
    config = city_config(seed, city, width, height)
    if config.seed in {s for listed in city_logs.LISTS.values() for s in listed}:
        return
    rng = seeds.numpy_rng(seed, city, "segmenter views")
    world = CityWorld(config)
    recorded = world.frame_views("front")
    for _ in range(VIEWS):
        frame = int(rng.integers(FRAMES))
        count = int(rng.choice([6, 6, 6, 6, 3, 1, 1]))
        yaw = 0.0 if rng.random() < 0.5 else float(rng.uniform(-np.pi, np.pi))
        view = _turned(recorded[frame], yaw, float(np.deg2rad(rng.normal(0, 1))), float(np.deg2rad(rng.normal(0, 2))))
        tracks = [_misplaced(track, rng) for track in world.tracks()]
        given, truth = shot(world, view, frame, count, tracks)
        yield Sample(given.rgb, gather(given), truth)


def shot(
    world: CityWorld, view: View, frame: int, sweeps: int, tracks: Sequence[Track]
) -> tuple[LabelInput, NDArray[np.uint8]]:
    """One image of a city as a labeller gets it, with the ``sweeps`` sweeps around it, and its true classes u8[H,
    W]."""
    truth = world.render(view, sensor_noise=True)
    xyz, gap_deg = points_at(world, view, frame, sweeps)
    path = world.ego_path().world_from_ego[:, :3, 3]
    highest_rad = float(np.deg2rad(world.config.lidar_upper_deg))
    return LabelInput(view, truth.rgb_u8, xyz, tracks, path, gap_deg, highest_rad), truth.semantics


def points_at(world: CityWorld, view: View, frame: int, sweeps: int) -> tuple[NDArray[np.float32], float]:
    """Points f32[N, 3] of the sweeps around a frame, dynamic objects where they are at the view's time; and the largest
    beam gap, deg."""
    rules = FusionRules()
    dynamic = [track for track in world.tracks() if judge_track(track, rules).moving]
    total = world.config.n_frames
    first = min(max(0, frame - sweeps // 2), max(0, total - sweeps))
    parts, gap_deg = [np.zeros((0, 3))], 0.6
    for index in range(first, min(total, first + sweeps)):
        sweep = world.lidar_sweep(index)
        owner, owned = separate(SweepShots(sweep.time_s, sweep.world_from_lidar, sweep.points, ()), dynamic, rules)
        parts.append(geometry.transform_points(sweep.world_from_lidar, sweep.points.xyz)[owner == STATIC])
        gap_deg = GAP_SPREAD * measure_beam_gap(sweep.points.xyz)
        for number, local in owned.items():
            pose = dynamic[number].pose_at(view.time_s)
            if pose is not None:
                parts.append(geometry.transform_points(pose, local))
    return np.concatenate(parts).astype(np.float32), gap_deg


def log_shots(seed: int, sweeps: int = 6) -> Iterator[tuple[LabelInput, NDArray[np.uint8]]]:
    """Three images of a city log of ``city_logs``, one by each camera, with true boxes, and their true classes."""
    config = city_logs.log_config(seed)
    world = CityWorld(config)
    for name, frame in zip(config.cameras, (7, 16, 12), strict=True):
        yield shot(world, world.frame_views(name)[frame], frame, sweeps, world.tracks())


def _turned(view: View, yaw: float, roll: float, pitch: float) -> View:
    """A view from the same place, turned about the vertical, about its own axis, and up or down; radians."""
    pose = np.array(view.world_from_cam)
    pose[:3, :3] = geometry.yaw_matrix(yaw, (0, 0, 0))[:3, :3] @ pose[:3, :3]
    c, s, d, t = np.cos(roll), np.sin(roll), np.cos(pitch), np.sin(pitch)
    pose[:3, :3] = pose[:3, :3] @ [[c, -s, 0], [s, c, 0], [0, 0, 1]] @ [[1, 0, 0], [0, d, -t], [0, t, d]]
    return View(view.camera, pose, view.time_s)


def _misplaced(track: Track, rng: np.random.Generator) -> Track:
    """A box as people draw it: a little off in size, place and heading."""
    error = geometry.yaw_matrix(float(rng.normal(0, 0.03)), rng.normal(0, 0.08, 3))
    return dataclasses.replace(
        track, size_m=track.size_m * rng.uniform(0.93, 1.1, 3), world_from_object=track.world_from_object @ error
    )


def save(path: Path, made: Sample) -> None:
    """Write a sample: measured planes in half precision."""
    arrays = {"rgb": made.rgb, "truth": made.truth}
    for name, value in dataclasses.asdict(made.evidence).items():
        arrays[name] = value.astype(np.float16) if value.dtype == np.float32 else value
    store.write_safetensors(path, arrays)


def load(path: Path) -> Sample:
    """Read what ``save`` wrote."""
    arrays = store.read_safetensors(path)
    evidence = {f.name: arrays[f.name] for f in dataclasses.fields(Evidence)}
    arrays_f32 = {n: v.astype(np.float32) if v.dtype == np.float16 else v for n, v in evidence.items()}
    return Sample(arrays["rgb"], Evidence(**arrays_f32), arrays["truth"])
