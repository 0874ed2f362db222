"""Settings of ``mudg fuse``."""

from __future__ import annotations

from mudg.base.config import setting, settings


@settings
class FuseConfig:
    """Fuse sweeps and images into a static coloured point cloud and one cloud per dynamic object."""

    voxel_m: float = setting(default=0.0, ge=0)
    """Keep one point per voxel of this size, in metres (0 = keep all)."""
    occlusion_test: bool = True
    """Do not colour points that lie behind a nearer surface."""
    match_colors: bool = True
    """Find how exposure and white balance differ between cameras, from points that several of them saw, and correct it
    in clouds, fits and generated views. A camera's own views keep its colours."""
    box_growth_m: float = setting(default=0.1, ge=0, le=2)
    """Boxes of dynamic objects are enlarged by this distance on each side, in metres. Raise it if objects leave points
    behind."""
    floor_margin_m: float = setting(default=0.1, ge=0, le=1)
    """Points up to this height, in metres, above the bottom of a dynamic object's box stay with the road."""
    moving_distance_m: float = setting(default=0.5, gt=0)
    """A tracked box is dynamic if its displacement or its path is longer than this, in metres."""
    min_object_points: int = setting(default=100, ge=1)
    """Dynamic objects with fewer coloured points than this are left out."""
