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

__version__ = "0.2.0"

HOMES = {
    "mudg.base.errors": "MudgError",
    "mudg.base.log": "set_quiet",
    "mudg.base.types": "Camera Gaussians Observation PointCloud Render Scene Track Trajectory View",
    "mudg.core.raster.rasterize": "rasterize",
    "mudg.datasets.tensors": "as_dataset collate",
    "mudg.scene.labels": "read_label",
    "mudg.scene.observations": "read_observations",
    "mudg.scene.read": "read_image read_points",
    "mudg.steps.fitted": "FittedScene Picture camera_path read_scene",
    "mudg.steps.functions": (
        "annotate bench convert dataset demo doctor edit export export_asset fit fuse import_asset ingest learn page "
        "render report run score synthesize"
    ),
}
"""Modules, and the names that they hold; ``__init__.pyi`` is made of it."""
_MODULES = {name: module for module, names in HOMES.items() for name in names.split()}
__all__ = ["__version__", *_MODULES]


def __getattr__(name: str) -> object:
    """Import the module that holds ``name`` the first time it is asked for."""
    if name not in _MODULES:
        raise AttributeError(f"module 'mudg' has no attribute {name!r}")
    import importlib

    globals()[name] = value = getattr(importlib.import_module(_MODULES[name]), name)
    return value


def __dir__() -> list[str]:
    return sorted(__all__)
