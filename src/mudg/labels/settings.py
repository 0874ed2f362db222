"""Settings of ``mudg annotate``."""

from __future__ import annotations

from typing import Literal

from mudg.base.config import setting, settings
from mudg.base.devices import DeviceName


@settings
class AnnotateConfig:
    """Add the labels that a scene lacks: dense depth, semantic classes, sky and masks of dynamic objects, each with a
    confidence."""

    labeller: Literal["embedded", "network"] = "embedded"
    """Source of classes and sky. embedded: the small shipped network, from image, heights and boxes. network: a
    segmentation network from `weights`."""
    weights: str = ""
    """labeller network: folder of a SegFormer or Mask2Former with Cityscapes classes in the transformers format.
    labeller embedded: folder of a network trained with tools/train_segmenter.py (empty = the shipped network)."""
    depth: bool = True
    """Write dense depth, by default from the LiDAR points of several sweeps, filled with the image as guide."""
    depth_network: str = ""
    """Take dense depth from a network and align it to LiDAR: folder of a PromptDepthAnything or Depth Anything
    model (transformers), or of a DepthLab written by mudg convert."""
    depth_steps: int = setting(default=0, ge=0)
    """DepthLab: denoising steps (0 = as in the model folder)."""
    device: DeviceName = "auto"
    """Device of the networks of labeller and `depth_network`: auto (CUDA if there is one), cpu, cuda, cuda:N, mps."""
    sweeps: int = setting(default=6, ge=1, le=100)
    """Number of sweeps per LiDAR, nearest in time, whose points are merged for dense depth."""
    dynamic: bool = True
    """Write masks of dynamic objects, from the tracked boxes."""
    ego: bool = False
    """Write masks of the own vehicle: pixels at the bottom of the image that stay the same while it drives. Use it if
    the bonnet is visible."""
    processes: int = setting(default=0, ge=0)
    """Number of frames labelled at the same time (0 = one per core; one if a pretrained network computes on another
    device)."""
