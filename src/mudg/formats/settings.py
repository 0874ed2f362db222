"""Settings of ``mudg ingest``."""

from __future__ import annotations

from typing import Literal

from mudg.base.config import setting, settings
from mudg.city.config import CitySettings


@settings
class IngestConfig:
    """Convert a dataset log, or the built-in procedural city, to a scene directory."""

    resolution: str = ""
    """Image size of the scene: the longest side in pixels, e.g. 960, or WIDTHxHEIGHT (empty = as recorded). Images are
    never enlarged."""
    workers: int = setting(default=0, ge=0)
    """Threads that convert frames (0 = one per processor). The result does not depend on it."""
    contact_sheet: bool = True
    """Write contact_sheet.jpg: frames with LiDAR points and boxes, and the scene from above. Check it after every
    import."""
    test_every: int = setting(default=4, ge=0)
    """Hold out every n-th frame of all cameras for scoring (0 = none)."""
    format: str = "auto"
    """Format of the log: kitti, kitti360, waymo, nuscenes, argoverse2, pandaset, nuplan, ncore or custom (auto =
    recognise it)."""
    frames: str = ""
    """Frames to import, FIRST:END without END itself, e.g. 0:40 (empty = all). kitti, kitti360, pandaset: the numbers
    of their files; other formats: counted from 0."""
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
    untwist: Literal["auto", "yes", "no"] = "auto"
    """Compensate LiDAR scans for the vehicle's motion during a sweep (auto = if the dataset's scans need it)."""
    city: CitySettings = setting(default_factory=CitySettings)
