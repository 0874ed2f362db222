"""Sensors of the recording vehicle: three cameras and a spinning LiDAR on the roof."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mudg.base import geometry, seeds
from mudg.base.types import Camera
from mudg.data.city.config import CityConfig

SIDE_YAW_DEG = 50.0


def cameras(config: CityConfig) -> dict[str, Camera]:
    """All three cameras, whether recorded or not."""
    rng = seeds.numpy_rng(config.seed, 0, "city rig")
    hfov = config.hfov_deg + config.rig_variation * rng.uniform(-12, 18)
    focal = config.width / 2 / math.tan(math.radians(min(hfov, 120.0)) / 2)
    names = ("front", "front_left", "front_right")
    return {n: Camera(n, config.width, config.height, focal, focal, config.width / 2, config.height / 2) for n in names}


def ego_from_camera(config: CityConfig) -> dict[str, NDArray[np.float64]]:
    """Mounting poses f64[4, 4]; the ego frame lies on the ground below the vehicle."""
    rng = seeds.numpy_rng(config.seed, 1, "city rig")
    height = 1.6 + config.rig_variation * rng.uniform(-0.25, 0.45)
    pitch = math.radians(0.5 + config.rig_variation * rng.uniform(-2.0, 3.0))
    x = 1.4
    places = {"front": (0.0, 0.0), "front_left": (SIDE_YAW_DEG, 0.35), "front_right": (-SIDE_YAW_DEG, -0.35)}
    # camera axes in a body frame that looks along x: right = -y, down = -z, forward = x
    body_from_camera = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])
    poses = {}
    for name, (yaw_deg, y) in places.items():
        pose = geometry.yaw_matrix(math.radians(yaw_deg), (x - (0.15 if y else 0.0), y, height))
        pose[:3, :3] = pose[:3, :3] @ pitch_rotation(pitch) @ body_from_camera
        poses[name] = pose
    return poses


def pitch_rotation(angle_rad: float) -> NDArray[np.float64]:
    """Rotation f64[3, 3] about y; a positive angle looks down."""
    c, s = math.cos(angle_rad), math.sin(angle_rad)
    return np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])


def ego_from_lidar() -> NDArray[np.float64]:
    """The LiDAR sits on the roof, its x axis forward."""
    pose = np.eye(4)
    pose[:3, 3] = (0.9, 0.0, 1.95)
    return pose


@dataclass(frozen=True, slots=True, eq=False)
class LidarScan:
    """How one sweep is taken, other than by the configuration's own LiDAR.

    Args:
        ego_from_lidar: mounting pose f64[4, 4].
        elevations_rad: of every beam.
        delay_s: the sweep is taken this much later than the frame's time; its points are given as if it were not.
        name: tells the random numbers of several LiDARs apart.
    """

    ego_from_lidar: NDArray[np.float64]
    elevations_rad: NDArray[np.float64]
    delay_s: float = 0.0
    name: str = ""


def lidar_elevations(config: CityConfig) -> NDArray[np.float64]:
    """Elevation of every beam in radians, denser around the horizon as in common 64-beam sensors."""
    return beam_elevations(config.lidar_beams, config.lidar_lower_deg, config.lidar_upper_deg)


def beam_elevations(beams: int, lower_deg: float, upper_deg: float) -> NDArray[np.float64]:
    """Elevations f64[beams] in radians from the lowest to the highest beam, denser in the middle."""
    u = np.linspace(-1.0, 1.0, beams)
    middle = 0.5 * (lower_deg + upper_deg)
    half = 0.5 * (upper_deg - lower_deg)
    return np.deg2rad(middle + half * (0.75 * u + 0.25 * u**3))


def lidar_azimuths(config: CityConfig) -> NDArray[np.float64]:
    """Azimuth of every column in radians, in firing order: clockwise, backwards to backwards, forwards at half time."""
    columns = max(4, round(360.0 / config.lidar_azimuth_step_deg))
    return np.pi - (np.arange(columns) + 0.5) * (2 * np.pi / columns)
