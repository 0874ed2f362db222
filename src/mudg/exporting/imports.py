"""asset import: a file of Gaussians from another program -> an asset that edit scripts can insert, or a scene in which
nothing moves."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch

from mudg.base import geometry, log, store
from mudg.base.errors import InputError, UsageError
from mudg.base.palette import CLASSES, ID
from mudg.base.run_folder import ResultFile, RunDir
from mudg.editing.apply import write_asset
from mudg.editing.model import Asset
from mudg.exporting.export import model_of_cloud
from mudg.exporting.settings import ImportConfig
from mudg.formats.splats import cloud as axes
from mudg.formats.splats.binary import MAX_BYTES
from mudg.formats.splats.cloud import SplatCloud, spacing_m
from mudg.formats.splats.formats import COARSE_M, read_cloud
from mudg.gaussians.storage import save_model

TRAIN_IDS: Final = {
    "pedestrian": ID["person"],
    "adult": ID["person"],
    "child": ID["person"],
    "cyclist": ID["rider"],
    "van": ID["car"],
    "tram": ID["train"],
    "tree": ID["vegetation"],
    "sign": ID["traffic sign"],
}
"""Classes of labels that are not named as their class."""
SOLID: Final = 0.3
"""Opacity from which Gaussians count for the size of an object."""
OUTSIDE: Final = 0.5
"""Percent of the solid Gaussians at either end of an axis that may stand out of the box."""


def write_object(config: ImportConfig, file: Path, result: ResultFile) -> dict[str, Any]:
    """Write the asset of a file; returns what it is."""
    cloud, found = read_file(file, config)
    asset = asset_of_cloud(cloud, config, f"{file.name} ({found})")
    write_asset(result.path, asset)
    length, width, height = asset.size_m
    log.info(f"asset: {len(asset)} Gaussians of a {found} file, {length:.2f} x {width:.2f} x {height:.2f} m")
    if cloud.degree:
        log.info("asset: colours that depend on the direction of view are not kept")
    return {"format": found}


def write_scene(config: ImportConfig, file: Path, cloud: SplatCloud, found: str, work: RunDir) -> dict[str, Any]:
    """The folder of a fit in which nothing moves, of Gaussians and their format; returns a summary."""
    origin = _origin(cloud, config, file)
    begin = geometry.yaw_matrix(np.radians(config.yaw_deg)) @ geometry.yaw_matrix(0.0, [-value for value in origin])
    model = model_of_cloud(cloud.moved(begin), file.name)
    save_model(replace(model, facts={**model.facts, "format": found}), work.path)
    log.info(f"asset: a scene of {len(cloud)} Gaussians of a {found} file")
    return {"gaussians": len(cloud), "format": found, "origin_m": origin}


def refuse_other_settings(config: ImportConfig) -> None:
    """UsageError for settings that belong to the other kind."""
    usual = ImportConfig()
    if config.kind == "scene" and (config.label, config.length_m) != (usual.label, usual.length_m):
        raise UsageError("a scene takes no settings of objects", where="--label, --length-m", remedy="leave them out")
    if len(config.axes) == 3 and not axes.known(config.axes):
        raise UsageError(
            "these letters name no three axes",
            where="--axes",
            expected="one of L and R, one of U and D, one of F and B",
            got=config.axes,
        )
    if config.kind == "object" and config.origin_m is not None:
        raise UsageError(
            "an object is centred in its box", where="--origin-m", remedy="leave it out, or add --kind scene"
        )


def read_file(file: Path, config: ImportConfig) -> tuple[SplatCloud, str]:
    """The Gaussians of a file in the axes of this program, and its format."""
    return read_cloud(store.read_bytes(bounded(file)), str(file), config.axes)


def bounded(file: Path) -> Path:
    """The file; InputError for one that is too large to be read."""
    size = store.regular(file).stat().st_size
    if size > MAX_BYTES:
        raise InputError("the file is too large", where=str(file), expected=f"at most {MAX_BYTES} bytes", got=str(size))
    return file


def asset_of_cloud(cloud: SplatCloud, config: ImportConfig, origin: str) -> Asset:
    """Gaussians as an object: turned, centred in their box, scaled to its length."""
    cloud = cloud.moved(geometry.yaw_matrix(np.radians(config.yaw_deg)))
    solid = cloud.means[cloud.opacity > SOLID]
    if len(solid) < 2:
        expected = f"opacities above {SOLID}"
        raise InputError(
            "the file holds no solid Gaussians", where=origin, expected=expected, got=f"{len(solid)} of them"
        )
    low, high = np.percentile(solid.astype(np.float64), [OUTSIDE, 100 - OUTSIDE], 0)
    size = np.maximum(high - low, 1e-3)
    scale = 1.0 if config.length_m is None else config.length_m / float(size[0])
    means = ((cloud.means - (low + high) / 2) * scale).astype(np.float32)
    if cloud.antialias:
        log.warn(
            f"{origin}: its Gaussians are meant to be drawn antialiased; an object is drawn as the scene that it"
            " stands in"
        )
    logs = (cloud.log_scales + np.log(scale)).astype(np.float32)
    columns = {
        "means": means,
        "quats": cloud.quats,
        "log_scales": logs,
        "logits": cloud.logits,
        "sh_dc": cloud.sh[:, :1],
    }
    label = config.label.strip().lower()
    ids = np.full(len(cloud), TRAIN_IDS.get(label, ID.get(label, -1)), np.int64)
    if cloud.class_ids is not None:
        ids = np.where(cloud.class_ids < len(CLASSES), cloud.class_ids.astype(np.int64), ids)
    length, width, height = (float(value) for value in size * scale)
    tensors = {key: torch.from_numpy(np.ascontiguousarray(value, np.float32)) for key, value in columns.items()}
    return Asset(tensors, ids, None, config.label, (length, width, height), None, (), origin)


def _origin(cloud: SplatCloud, config: ImportConfig, file: Path) -> list[float]:
    """What is taken away from the places, in f64: as set, or the middle of Gaussians so far away that f32 would be too
    coarse for them."""
    origin = [0.0, 0.0, 0.0] if config.origin_m is None else list(config.origin_m)
    if config.origin_m is None and spacing_m(cloud.means) > COARSE_M:
        origin = [float(value) for value in np.round(np.median(cloud.means, 0))]
        log.warn(
            f"{file}: its Gaussians lie far from the origin of the file: {origin} becomes the origin; --origin-m sets"
            " another"
        )
    if (step := spacing_m(cloud.means - np.array(origin))) > COARSE_M:
        log.warn(
            f"{file}: its Gaussians lie so far from the origin that their places are rounded to {step * 1000:.3g} mm; "
            "--origin-m takes an offset away before"
        )
    return origin
