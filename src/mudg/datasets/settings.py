"""Settings of ``mudg dataset``."""

from __future__ import annotations

from mudg.base.config import setting, settings
from mudg.base.devices import DeviceName


@settings
class DatasetConfig:
    """Which views of a reconstruction become labelled data."""

    cameras: tuple[str, ...] = ()
    """Cameras of the log (empty = all)."""
    shifts_m: tuple[float, ...] = (0.0,)
    """Lateral shifts in metres, positive to the left of the direction of travel; 0 = the recorded path. Several make
    one data set."""
    every: int = setting(default=1, ge=1)
    """Take every n-th frame."""
    width_px: int = setting(default=0, ge=0)
    """Image width in pixels (0 = as recorded); the height follows."""
    fov_deg: float = setting(default=0.0, ge=0, lt=170)
    """Horizontal field of view in degrees (0 = as recorded)."""
    lidar: str = ""
    """Give every view a sweep of this LiDAR, taken at the moment of its image: a sensor of the scene, pandar128, at128,
    hdl64, vlp16, or a JSON file of beams (docs/simulator.md). Empty: none."""
    least_pixels: int = setting(default=25, ge=0)
    """Leave out objects of which fewer pixels are visible."""
    farthest_seen_deg: float = setting(default=180.0, ge=0, le=180)
    """Leave out objects that are seen from this many degrees or more beside every direction from which the log recorded
    them: that side of them is guesswork. 60 is strict."""
    device: DeviceName = "auto"
    """Device: auto (CUDA if there is one), cpu, cuda, cuda:N."""
