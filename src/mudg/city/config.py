"""Configuration of the procedural city. Torch-free."""

from __future__ import annotations

from typing import Annotated, Literal

from mudg.base.config import Limits, settings

CameraName = Literal["front", "front_left", "front_right"]
LightName = Literal["auto", "day", "dusk", "overcast", "night"]


@settings
class CitySettings:
    """What ``mudg ingest city`` can be told."""

    seed: int = 0
    """Seed of the city; every seed gives another one."""
    n_frames: Annotated[int, Limits(ge=1, le=2000)] = 40
    """Frames per camera."""
    width: Annotated[int, Limits(ge=16, le=4096)] = 480
    """Width of the images, pixels."""
    height: Annotated[int, Limits(ge=16, le=4096)] = 320
    """Height of the images, pixels."""
    cameras: Annotated[tuple[CameraName, ...], Limits(min_length=1)] = ("front", "front_left", "front_right")
    """Cameras to record, out of these three."""
    lidar_beams: Annotated[int, Limits(ge=1, le=256)] = 64
    """Number of beams (rows) of the spinning LiDAR."""
    lidar_azimuth_step_deg: Annotated[float, Limits(ge=0.02, le=10)] = 0.2
    """Angle between two LiDAR columns, degrees."""
    light: LightName = "auto"
    """Time of day and weather; auto picks one of day, dusk and overcast by seed. night has street lamps and no moon."""
    wet: Annotated[float, Limits(ge=0, le=1)] = 0.0
    """Wetness of road and sidewalk: darker, and they mirror."""
    puddles: Annotated[float, Limits(ge=0, le=1)] = 0.0
    """Share of the wet ground under standing water."""
    snow_cover: Annotated[float, Limits(ge=0, le=1)] = 0.0
    """Share of open level surfaces under snow."""
    fog_visibility_m: Annotated[float, Limits(ge=0, le=100_000)] = 0.0
    """Visibility in fog, metres; 0 = the haze that belongs to the light."""
    traffic: Annotated[float, Limits(ge=0, le=2)] = 1.0
    """Density of moving and parked vehicles and of people, 0 = none, 1 = standard, 2 = busy."""
    overhead: Annotated[float, Limits(ge=0, le=1)] = 0.0
    """Amount of what stands above the LiDAR, 0 = as little as ever, 1 = much: wide tree crowns, bare trees, bridges,
    gantries, wires, arms with lamps and signals, tall vehicles, taller buildings."""
    skies: Literal["plain", "varied"] = "plain"
    """varied = more kinds of sky: white and near saturation, hazy, deep blue, scattered clouds, sunset, before a
    storm."""
    textures: str = ""
    """Folder with photographs of surfaces (textures/*.jpg, *.png) and panoramas of skies (sky/*.hdr) to use; empty =
    none. A scene made with it can only be rebuilt while the folder is there."""
    supersample: Annotated[int, Limits(ge=1, le=4)] = 2
    """Rays per pixel along each axis of the recorded images; more gives smoother edges and takes longer."""


@settings
class CityConfig(CitySettings):
    """A driving log through a generated city. The same configuration gives the same world, bit for bit."""

    rate_hz: Annotated[float, Limits(ge=1, le=50)] = 10.0
    """Frames and LiDAR sweeps per second."""
    hfov_deg: Annotated[float, Limits(ge=20, le=120)] = 60.0
    """Horizontal field of view of every camera, degrees."""
    rig_variation: Annotated[float, Limits(ge=0, le=1)] = 0.0
    """0 = the standard rig; 1 = field of view, mounting height and pitch vary from seed to seed."""
    lidar_lower_deg: Annotated[float, Limits(ge=-60, le=0)] = -25.0
    """Elevation of the lowest beam, degrees."""
    lidar_upper_deg: Annotated[float, Limits(ge=-10, le=60)] = 15.0
    """Elevation of the highest beam, degrees."""
    lidar_range_m: Annotated[float, Limits(ge=5, le=400)] = 120.0
    """Largest range of the LiDAR, metres."""
    lidar_noise_m: Annotated[float, Limits(ge=0, le=1)] = 0.02
    """Standard deviation of the range, metres."""
    lidar_dropout: Annotated[float, Limits(ge=0, le=0.9)] = 0.03
    """Share of LiDAR returns lost at random, 0 to 0.9; glass and weak returns lose more."""
    style: Literal["auto", "urban", "suburban"] = "auto"
    """Kind of neighbourhood; auto picks one by seed."""
    crossing: Literal["auto", "yes", "no"] = "auto"
    """Whether a street crosses ahead; auto picks by seed."""
    shift_margin_m: Annotated[float, Limits(ge=0, le=5)] = 4.0
    """Free space beside the recorded path, metres: a camera shifted laterally by up to this distance never enters an
    object."""
    sensor_noise: bool = True
    """Add camera noise to the recorded images."""
