"""Settings of ``mudg ingest``, ``mudg annotate`` and ``mudg fuse``."""

from __future__ import annotations

from typing import ClassVar, Literal

from pydantic import Field
from pydantic.dataclasses import dataclass

from mudg.base.config import STRICT
from mudg.data.city.config import CityConfig


@dataclass(frozen=True, kw_only=True, config=STRICT)
class IngestConfig:
    """Turn a dataset log, or the built-in procedural city, into a scene directory."""

    resolution: str = ""
    """Size of the scene's images: longest side, e.g. 960, or WIDTHxHEIGHT (empty = as recorded). Images are never enlarged."""
    workers: int = Field(default=0, ge=0)
    """Threads that convert frames (0 = one per processor). The result does not depend on it."""
    contact_sheet: bool = True
    """Draw contact_sheet.jpg: frames with LiDAR and boxes, and the scene from above."""
    test_every: int = Field(default=4, ge=0)
    """Hold out every n-th frame of all cameras for scoring (0 = hold out none)."""
    format: str = "auto"
    """Format of the log: kitti, kitti360, waymo, nuscenes, argoverse2, pandaset, nuplan, dgp or custom (auto = look)."""
    frames: str = ""
    """Frames to take, FIRST:END with END left out, e.g. 0:40 (empty = all). KITTI: numbers of its files; else counted from 0."""
    cameras: tuple[str, ...] = ()
    """Cameras to take, by their names in the scene or in the data set (empty = the format's usual ones)."""
    sequence: str = ""
    """Which log, sequence, scene or frame, where a folder holds several."""
    poses: str = ""
    """File (or folder of GPS/IMU packets) with vehicle poses, instead of the one found by looking."""
    boxes: str = ""
    """File with tracked boxes, instead of the one found by looking."""
    skip_missing: bool = False
    """Leave out frames of which an image or scan is missing, instead of refusing."""
    untwist: Literal["auto", "yes", "no"] = "auto"
    """Undo the distortion of LiDAR scans by the vehicle's motion (auto = where the dataset says they are distorted)."""
    city: CityConfig = Field(default_factory=CityConfig)


@dataclass(frozen=True, kw_only=True, config=STRICT)
class AnnotateConfig:
    """Make the labels that a scene lacks: dense depth, classes, sky, movers, each with a confidence."""

    labeller: Literal["embedded", "geometry", "network"] = "embedded"
    """What tells classes and sky. embedded: the small network that comes with the package, from image, heights and boxes; geometry: rules
    for these, without a network; network: a segmentation network from `weights`."""
    weights: str = ""
    """labeller network: folder of a SegFormer, Mask2Former or EoMT with Cityscapes classes, as transformers writes it, or its name in the
    Hugging Face cache (owner/name or owner/name@revision). labeller embedded: folder of a network trained with
    tools/train_segmenter.py (empty = the one that comes with the package)."""
    depth: bool = True
    """Write dense depth: LiDAR of several sweeps, filled along the image."""
    depth_network: str = ""
    """Take dense depth from a network, aligned to LiDAR: folder, or name in the Hugging Face cache, of a PromptDepthAnything, Depth
    Anything (transformers) or Marigold (diffusers), or folder of a DepthLab (mudg convert)."""
    depth_guided: bool = True
    """Marigold: LiDAR steers every denoising step (slower); else the result is only aligned to it."""
    depth_steps: int = Field(default=0, ge=0)
    """Marigold and DepthLab: denoising steps (0 = what the folder says, or 50 with LiDAR steering)."""
    device: Literal["cpu", "cuda"] = "cpu"
    """Where the networks of labeller and `depth_network` compute."""
    precision: Literal["auto", "float32", "bfloat16"] = "auto"
    """Of these networks. auto is float32: bfloat16 is faster on some devices, and rounds depth to 0.4 percent."""
    sweeps: int = Field(default=6, ge=1, le=100)
    """Sweeps of each LiDAR, the nearest in time, whose points are put together."""
    dynamic: bool = True
    """Write where tracked things are seen that move."""
    ego: bool = False
    """Write where the own vehicle is seen: pixels at the bottom that stay the same while it moves."""
    processes: int = Field(default=0, ge=0)
    """Frames labelled at the same time (0 = one per core)."""


@dataclass(frozen=True, kw_only=True, config=STRICT)
class FuseConfig:
    """Fuse sweeps and images into a static coloured cloud and one cloud per dynamic object."""

    MOVED: ClassVar[dict[str, str | None]] = {"colour_from_held_out": "color_from_held_out"}

    voxel_m: float = Field(default=0.0, ge=0)
    """Keep one point per voxel of this size (0 = keep all)."""
    occlusion_test: bool = True
    """Give no colour to points behind a nearer surface."""
    max_image_gap_s: float = Field(default=0.06, ge=0)
    """Images at most this far in time from a sweep colour its points."""
    color_from_held_out: bool = False
    """Also take colours from held-out images (scores at held-out frames then mean little)."""
    box_growth_m: float = Field(default=0.1, ge=0, le=2)
    """Moving boxes are grown by this on each side."""
    floor_margin_m: float = Field(default=0.1, ge=0, le=1)
    """Points this close above a moving box's floor stay with the road."""
    moving_distance_m: float = Field(default=0.5, gt=0)
    """A tracked box that gets or travels farther than this moves."""
    min_object_points: int = Field(default=100, ge=1)
    """Moving objects with fewer coloured points are left out."""
