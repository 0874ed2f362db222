"""Configuration of the procedural city. Torch-free."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass

CameraName = Literal["front", "front_left", "front_right"]
LightName = Literal["auto", "day", "dusk", "overcast"]


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class CityConfig:
    """A driving log through a generated city. The same configuration gives the same world, bit for bit.

    Args:
        seed: everything is drawn from it.
        n_frames: frames per camera.
        rate_hz: frames and LiDAR sweeps per second.
        width, height: image size in pixels.
        cameras: which of the three cameras to record.
        hfov_deg: horizontal field of view of every camera.
        rig_variation: 0 = the standard rig; 1 = field of view, mounting height and pitch vary from seed to seed.
        lidar_beams: rows of the spinning LiDAR.
        lidar_azimuth_step_deg: angle between two columns.
        lidar_lower_deg, lidar_upper_deg: elevation of the lowest and highest beam.
        lidar_range_m: largest range.
        lidar_noise_m: standard deviation of the range.
        lidar_dropout: share of returns that are lost at random; glass and weak returns lose more.
        light: time of day and weather; ``auto`` draws one.
        style: kind of quarter; ``auto`` draws one.
        crossing: whether a street crosses ahead; ``auto`` draws it.
        traffic: density of moving and parked vehicles and of people, 0 = none, 1 = standard, 2 = busy.
        shift_margin_m: cameras moved sideways by up to this distance, to either side, meet no object at any frame.
        supersample: rays per pixel and axis of the recorded images.
        sensor_noise: add camera noise to the recorded images.
    """

    seed: int = 0
    n_frames: Annotated[int, Field(ge=1, le=2000)] = 40
    rate_hz: Annotated[float, Field(ge=1, le=50)] = 10.0
    width: Annotated[int, Field(ge=16, le=4096)] = 480
    height: Annotated[int, Field(ge=16, le=4096)] = 320
    cameras: Annotated[tuple[CameraName, ...], Field(min_length=1)] = ("front", "front_left", "front_right")
    hfov_deg: Annotated[float, Field(ge=20, le=120)] = 60.0
    rig_variation: Annotated[float, Field(ge=0, le=1)] = 0.0
    lidar_beams: Annotated[int, Field(ge=1, le=256)] = 64
    lidar_azimuth_step_deg: Annotated[float, Field(ge=0.02, le=10)] = 0.2
    lidar_lower_deg: Annotated[float, Field(ge=-60, le=0)] = -25.0
    lidar_upper_deg: Annotated[float, Field(ge=-10, le=60)] = 15.0
    lidar_range_m: Annotated[float, Field(ge=5, le=400)] = 120.0
    lidar_noise_m: Annotated[float, Field(ge=0, le=1)] = 0.02
    lidar_dropout: Annotated[float, Field(ge=0, le=0.9)] = 0.03
    light: LightName = "auto"
    style: Literal["auto", "urban", "suburban"] = "auto"
    crossing: Literal["auto", "yes", "no"] = "auto"
    traffic: Annotated[float, Field(ge=0, le=2)] = 1.0
    shift_margin_m: Annotated[float, Field(ge=0, le=5)] = 4.0
    supersample: Annotated[int, Field(ge=1, le=4)] = 2
    sensor_noise: bool = True
