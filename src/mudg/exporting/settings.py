"""Settings of ``mudg export`` and ``mudg asset import``."""

from __future__ import annotations

from typing import Literal

from mudg.base.config import setting, settings


@settings
class ExportConfig:
    """Write a fitted scene, or the cameras of its log, for other programs."""

    time_s: float | None = None
    """Moment at which moving objects are taken, on the scene's clock (not given: formats with motion hold all of it,
    others the middle of the log)."""
    nodes: tuple[str, ...] = ()
    """Track ids of the objects to write, and background for what stands (not given: everything)."""
    axes: Literal["viewer", "world"] = "viewer"
    """viewer: axes that programs expect of the format. world: x forward, y left, z up in every format."""
    sky: Literal["keep", "none", "sphere"] = "keep"
    """keep: a panorama, in formats that hold one. none: no sky. sphere: 6000 flat Gaussians 300 m away, in every
    format."""


@settings
class ImportConfig:
    """Read a file of Gaussians as an object that edit scripts can insert, or as a scene."""

    kind: Literal["object", "scene"] = "object"
    """object: an asset file. scene: the folder of a fit in which nothing moves."""
    label: str = "object"
    """Class of the object, e.g. car or pedestrian."""
    length_m: float | None = setting(default=None, gt=0)
    """Scale the object so that its box has this length (not given: the file is in metres)."""
    yaw_deg: float = 0.0
    """Turn what the file holds by this angle about the vertical, counter-clockwise from above, so that an object looks,
    or a street leads, along x."""
    origin_m: tuple[float, float, float] | None = None
    """With --kind scene: the place in the file that becomes the origin, after --axes and before --yaw-deg (not given:
    the file's own origin, or the middle of Gaussians that lie more than 16 km away)."""
    axes: str = setting(default="file", pattern="^(file|viewer|world|[LRUDFB]{3})$")
    """Where x, y and z of the file point. file: as the file says, else as viewer. viewer: as programs expect of its
    format. world: x forward, y left, z up, as of export --axes world. Or three letters of L, R, U, D, F, B: RDF is x
    right, y down, z forward."""
