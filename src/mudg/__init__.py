"""mudg: from a driving log to lane-shifted RGB, depth and semantic video and a dynamic 3D Gaussian scene.

Every verb of the command is a function: inputs as arguments, the output folder as ``out``, settings by name.

    mudg.fuse("scenes/a", out="runs/fused", voxel_m=0.08)
    mudg.fit("scenes/a", "runs/fused", out="runs/fit", method="street_gaussians", loss={"lidar_weight": 0.2})

``help(mudg.fit)`` shows all settings of a verb. A group of settings is a dictionary; ``config`` names a YAML file that
is read before the settings, as ``--config`` does. What the command refuses is refused here, with the errors of
``mudg.base.errors``. A finished result of the same settings and inputs is verified and reused; an interrupted one is
resumed. Where a scene, clouds, a fit or views are read, the folder of a finished ``run`` will do.

The names below are what the package promises to keep. They are looked up on first use, so that ``import mudg`` is
fast and loads no torch.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from mudg.base.errors import MudgError
    from mudg.base.log import set_quiet
    from mudg.base.types import Camera, Gaussians, Observation, PointCloud, Render, Scene, Track, Trajectory, View
    from mudg.core.raster.rasterize import rasterize
    from mudg.datasets.tensors import as_dataset, collate
    from mudg.scene.labels import read_label
    from mudg.scene.observations import read_observations
    from mudg.scene.read import read_image, read_points
    from mudg.steps.fitted import FittedScene, Picture, camera_path, read_scene
    from mudg.steps.functions import (
        annotate,
        bench,
        convert,
        dataset,
        demo,
        doctor,
        edit,
        export,
        export_asset,
        fit,
        fuse,
        import_asset,
        ingest,
        learn,
        page,
        render,
        report,
        run,
        score,
        synthesize,
    )

__version__ = "0.2.0"

_FUNCTIONS = "mudg.steps.functions"
_HOMES = {
    "Camera": "mudg.base.types",
    "FittedScene": "mudg.steps.fitted",
    "Gaussians": "mudg.base.types",
    "MudgError": "mudg.base.errors",
    "Observation": "mudg.base.types",
    "Picture": "mudg.steps.fitted",
    "PointCloud": "mudg.base.types",
    "Render": "mudg.base.types",
    "Scene": "mudg.base.types",
    "Track": "mudg.base.types",
    "Trajectory": "mudg.base.types",
    "View": "mudg.base.types",
    "as_dataset": "mudg.datasets.tensors",
    "camera_path": "mudg.steps.fitted",
    "collate": "mudg.datasets.tensors",
    "rasterize": "mudg.core.raster.rasterize",
    "read_image": "mudg.scene.read",
    "read_label": "mudg.scene.labels",
    "read_observations": "mudg.scene.observations",
    "read_points": "mudg.scene.read",
    "read_scene": "mudg.steps.fitted",
    "annotate": _FUNCTIONS,
    "bench": _FUNCTIONS,
    "convert": _FUNCTIONS,
    "dataset": _FUNCTIONS,
    "demo": _FUNCTIONS,
    "doctor": _FUNCTIONS,
    "edit": _FUNCTIONS,
    "export": _FUNCTIONS,
    "export_asset": _FUNCTIONS,
    "fit": _FUNCTIONS,
    "fuse": _FUNCTIONS,
    "import_asset": _FUNCTIONS,
    "ingest": _FUNCTIONS,
    "learn": _FUNCTIONS,
    "page": _FUNCTIONS,
    "set_quiet": "mudg.base.log",
    "render": _FUNCTIONS,
    "report": _FUNCTIONS,
    "run": _FUNCTIONS,
    "score": _FUNCTIONS,
    "synthesize": _FUNCTIONS,
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
    "annotate",
    "as_dataset",
    "bench",
    "camera_path",
    "collate",
    "convert",
    "dataset",
    "demo",
    "doctor",
    "edit",
    "export",
    "export_asset",
    "fit",
    "fuse",
    "import_asset",
    "ingest",
    "learn",
    "page",
    "rasterize",
    "read_image",
    "read_label",
    "read_observations",
    "read_points",
    "read_scene",
    "render",
    "report",
    "run",
    "score",
    "set_quiet",
    "synthesize",
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
