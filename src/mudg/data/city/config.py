"""Configuration of the procedural city. Torch-free."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field
from pydantic.dataclasses import dataclass

from mudg.base.config import STRICT

CameraName = Literal["front", "front_left", "front_right"]
LightName = Literal["auto", "day", "dusk", "overcast"]


@dataclass(frozen=True, config=STRICT)
class CityConfig:
    """A driving log through a generated city. The same configuration gives the same world, bit for bit."""

    seed: int = 0
    """Everything is drawn from it."""
    n_frames: Annotated[int, Field(ge=1, le=2000)] = 40
    """Frames per camera."""
    rate_hz: Annotated[float, Field(ge=1, le=50)] = 10.0
    """Frames and LiDAR sweeps per second."""
    width: Annotated[int, Field(ge=16, le=4096)] = 480
    """Width of the images, pixels."""
    height: Annotated[int, Field(ge=16, le=4096)] = 320
    """Height of the images, pixels."""
    cameras: Annotated[tuple[CameraName, ...], Field(min_length=1)] = ("front", "front_left", "front_right")
    """Which of the three cameras to record."""
    hfov_deg: Annotated[float, Field(ge=20, le=120)] = 60.0
    """Horizontal field of view of every camera."""
    rig_variation: Annotated[float, Field(ge=0, le=1)] = 0.0
    """0 = the standard rig; 1 = field of view, mounting height and pitch vary from seed to seed."""
    lidar_beams: Annotated[int, Field(ge=1, le=256)] = 64
    """Rows of the spinning LiDAR."""
    lidar_azimuth_step_deg: Annotated[float, Field(ge=0.02, le=10)] = 0.2
    """Angle between two columns."""
    lidar_lower_deg: Annotated[float, Field(ge=-60, le=0)] = -25.0
    """Elevation of the lowest beam."""
    lidar_upper_deg: Annotated[float, Field(ge=-10, le=60)] = 15.0
    """Elevation of the highest beam."""
    lidar_range_m: Annotated[float, Field(ge=5, le=400)] = 120.0
    """Largest range."""
    lidar_noise_m: Annotated[float, Field(ge=0, le=1)] = 0.02
    """Standard deviation of the range."""
    lidar_dropout: Annotated[float, Field(ge=0, le=0.9)] = 0.03
    """Share of returns that are lost at random; glass and weak returns lose more."""
    light: LightName = "auto"
    """Time of day and weather; auto draws one."""
    style: Literal["auto", "urban", "suburban"] = "auto"
    """Kind of quarter; auto draws one."""
    crossing: Literal["auto", "yes", "no"] = "auto"
    """Whether a street crosses ahead; auto draws it."""
    traffic: Annotated[float, Field(ge=0, le=2)] = 1.0
    """Density of moving and parked vehicles and of people, 0 = none, 1 = standard, 2 = busy."""
    shift_margin_m: Annotated[float, Field(ge=0, le=5)] = 4.0
    """Cameras moved sideways by up to this distance, to either side, meet no object at any frame."""
    supersample: Annotated[int, Field(ge=1, le=4)] = 2
    """Rays per pixel and axis of the recorded images."""
    sensor_noise: bool = True
    """Add camera noise to the recorded images."""
