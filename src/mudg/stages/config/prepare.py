"""Settings of ``mudg ingest``, ``mudg annotate`` and ``mudg fuse``."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar, Literal

from pydantic import Field
from pydantic.dataclasses import dataclass

from mudg.base.config import STRICT
from mudg.base.devices import DeviceName
from mudg.data.city.config import CityConfig


@dataclass(frozen=True, kw_only=True, config=STRICT)
class IngestConfig:
    """Convert a dataset log, or the built-in procedural city, to a scene directory."""

    FIXED: ClassVar[Mapping[str, tuple[str, ...]]] = {
        "city": (
            "rate_hz", "hfov_deg", "rig_variation", "lidar_lower_deg", "lidar_upper_deg", "lidar_range_m", "lidar_noise_m", "lidar_dropout",
            "style", "crossing", "shift_margin_m", "sensor_noise",
        )
    }  # fmt: skip

    resolution: str = ""
    """Image size of the scene: the longest side in pixels, e.g. 960, or WIDTHxHEIGHT (empty = as recorded). Images are never
    enlarged."""
    workers: int = Field(default=0, ge=0)
    """Threads that convert frames (0 = one per processor). The result does not depend on it."""
    contact_sheet: bool = True
    """Write contact_sheet.jpg: frames with LiDAR points and boxes, and the scene from above. Check it after every import."""
    test_every: int = Field(default=4, ge=0)
    """Hold out every n-th frame of all cameras for scoring (0 = none)."""
    format: str = "auto"
    """Format of the log: kitti, kitti360, waymo, nuscenes, argoverse2, pandaset, nuplan, dgp, ncore or custom (auto = recognise it)."""
    frames: str = ""
    """Frames to import, FIRST:END without END itself, e.g. 0:40 (empty = all). kitti, kitti360, pandaset: the numbers of
    their files; other formats: counted from 0."""
    cameras: tuple[str, ...] = ()
    """Cameras to import, by their names in the scene or in the dataset (empty = the format's default cameras)."""
    sequence: str = ""
    """Log, sequence, scene or frame to import, if the folder holds several."""
    poses: str = ""
    """File (or folder of GPS/IMU packets) with vehicle poses (empty = search in the log)."""
    boxes: str = ""
    """File with tracked boxes (empty = search in the log)."""
    skip_missing: bool = False
    """Skip frames with a missing image, scan or vehicle pose instead of refusing the log."""
    bridge_gaps: bool = False
    """Bridge gaps between vehicle poses with curves instead of refusing the frames in them."""
    untwist: Literal["auto", "yes", "no"] = "auto"
    """Compensate LiDAR scans for the vehicle's motion during a sweep (auto = if the dataset's scans need it)."""
    city: CityConfig = Field(default_factory=CityConfig)


@dataclass(frozen=True, kw_only=True, config=STRICT)
class AnnotateConfig:
    """Add the labels that a scene lacks: dense depth, semantic classes, sky and masks of dynamic objects, each with a
    confidence."""

    labeller: Literal["embedded", "geometry", "network"] = "embedded"
    """Source of classes and sky. embedded: the small shipped network, from image, heights and boxes. geometry: rules on heights
    and boxes, without a network. network: a segmentation network from `weights`."""
    weights: str = ""
    """labeller network: folder of a SegFormer, Mask2Former or EoMT with Cityscapes classes in the transformers format, or its
    name in the Hugging Face cache (owner/name or owner/name@revision). labeller embedded: folder of a network trained with
    tools/train_segmenter.py (empty = the shipped network)."""
    depth: bool = True
    """Write dense depth, by default from the LiDAR points of several sweeps, filled with the image as guide."""
    depth_network: str = ""
    """Take dense depth from a network and align it to LiDAR: folder, or name in the Hugging Face cache, of a PromptDepthAnything,
    Depth Anything (transformers) or Marigold (diffusers) model; or folder of a DepthLab written by mudg convert."""
    depth_guided: bool = True
    """Marigold: use LiDAR in every denoising step (slower). Off: only align the result to LiDAR."""
    depth_steps: int = Field(default=0, ge=0)
    """Marigold and DepthLab: denoising steps (0 = as in the model folder, or 50 for Marigold guided by LiDAR)."""
    device: DeviceName = "auto"
    """Device of the networks of labeller and `depth_network`: auto (CUDA if there is one), cpu, cuda, cuda:N, mps."""
    precision: Literal["auto", "float32", "bfloat16"] = "auto"
    """Number format of these networks. auto is float32; bfloat16 is faster on some devices and rounds depth to 0.4 percent."""
    sweeps: int = Field(default=6, ge=1, le=100)
    """Number of sweeps per LiDAR, nearest in time, whose points are merged for dense depth."""
    dynamic: bool = True
    """Write masks of dynamic objects, from the tracked boxes."""
    ego: bool = False
    """Write masks of the own vehicle: pixels at the bottom of the image that stay the same while it drives. Use it if the bonnet
    is visible."""
    processes: int = Field(default=0, ge=0)
    """Number of frames labelled at the same time (0 = one per core; one if a pretrained network computes on another device)."""


@dataclass(frozen=True, kw_only=True, config=STRICT)
class FuseConfig:
    """Fuse sweeps and images into a static coloured point cloud and one cloud per dynamic object."""

    RETIRED: ClassVar[Mapping[str, tuple[str, Any]]] = {
        "max_image_gap_s": ("match_colors", 0.06), "color_from_held_out": ("box_growth_m", False),
    }  # fmt: skip

    voxel_m: float = Field(default=0.0, ge=0)
    """Keep one point per voxel of this size, in metres (0 = keep all)."""
    occlusion_test: bool = True
    """Do not colour points that lie behind a nearer surface."""
    match_colors: bool = True
    """Find how exposure and white balance differ between cameras, from points that several of them saw, and correct it in clouds, fits and
    generated views. A camera's own views keep its colours."""
    box_growth_m: float = Field(default=0.1, ge=0, le=2)
    """Boxes of dynamic objects are enlarged by this distance on each side, in metres. Raise it if objects leave points behind."""
    floor_margin_m: float = Field(default=0.1, ge=0, le=1)
    """Points up to this height, in metres, above the bottom of a dynamic object's box stay with the road."""
    moving_distance_m: float = Field(default=0.5, gt=0)
    """A tracked box is dynamic if its displacement or its path is longer than this, in metres."""
    min_object_points: int = Field(default=100, ge=1)
    """Dynamic objects with fewer coloured points than this are left out."""
