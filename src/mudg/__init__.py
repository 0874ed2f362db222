"""mudg: from a driving log to lane-shifted RGB, depth and semantic video and a dynamic 3D Gaussian scene.

The names below are what the package promises to keep. They are looked up on first use, so that ``import mudg`` is
fast and loads no torch.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from mudg.base.errors import MudgError
    from mudg.base.types import Camera, Gaussians, Observation, PointCloud, Render, Scene, Track, Trajectory, View
    from mudg.core.raster.rasterize import rasterize
    from mudg.data.observations import read_observations
    from mudg.data.scene import read_scene
    from mudg.fitted import FittedScene, Picture
    from mudg.stages.run import run_chain

__version__ = "0.1.0"

_HOMES = {
    "Camera": "mudg.base.types",
    "FittedScene": "mudg.fitted",
    "Gaussians": "mudg.base.types",
    "MudgError": "mudg.base.errors",
    "Observation": "mudg.base.types",
    "Picture": "mudg.fitted",
    "PointCloud": "mudg.base.types",
    "Render": "mudg.base.types",
    "Scene": "mudg.base.types",
    "Track": "mudg.base.types",
    "Trajectory": "mudg.base.types",
    "View": "mudg.base.types",
    "rasterize": "mudg.core.raster.rasterize",
    "read_observations": "mudg.data.observations",
    "read_scene": "mudg.data.scene",
    "run_chain": "mudg.stages.run",
}

__all__ = [
    "Camera",
    "FittedScene",
    "Gaussians",
    "MudgError",
    "Observation",
    "Picture",
    "PointCloud",
    "Render",
    "Scene",
    "Track",
    "Trajectory",
    "View",
    "__version__",
    "rasterize",
    "read_observations",
    "read_scene",
    "run_chain",
]


def __getattr__(name: str) -> object:
    """Import the module that holds ``name`` the first time it is asked for."""
    if name in _HOMES:
        import importlib

        value = getattr(importlib.import_module(_HOMES[name]), name)
        globals()[name] = value
        return value
    raise AttributeError(f"module 'mudg' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted(__all__)
