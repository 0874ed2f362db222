"""export: a fitted scene, or the cameras of its log -> a file or folder for other programs.

Gaussians:  OUT and OUT.json (format, moment, axes, what the file does not hold, sha256)
cameras:    OUT/transforms.json ... (nerfstudio), OUT/sparse/0 (COLMAP), OUT/images
messages:   OUT.mcap (Foxglove), OUT.rrd (rerun), OUT/metadata.yaml and OUT/log_0.mcap (ROS 2),
            OUT/NAME.ncore4.zarr.itar (NCore)
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np

from mudg.base import log, store
from mudg.base.errors import InputError, UsageError
from mudg.base.layout import below
from mudg.base.types import PointCloud, Scene
from mudg.base.versions import version
from mudg.core.ground import HeightMap
from mudg.core.sh import C0
from mudg.data.cloudfile import read_fused
from mudg.data.edits import EditScript
from mudg.data.exporters.colmap import colmap_files
from mudg.data.exporters.nerfstudio import nerfstudio_files
from mudg.data.exporters.pictures import picture_names, pictures
from mudg.data.scene import read_scene
from mudg.data.splats.cloud import SplatScene
from mudg.data.splats.formats import FORMATS, WriteRequest, file_from_world, losses
from mudg.models.scene.edited import lowest_points
from mudg.models.scene.model import SceneModel
from mudg.stages.config import ExportConfig
from mudg.stages.editing.apply import ground_of
from mudg.stages.editing.carried import carry_out
from mudg.stages.editing.runs import RunParts, find_run
from mudg.stages.exporting.messages import FOLDERS as LOG_FOLDERS
from mudg.stages.exporting.messages import SUFFIXES as MESSAGES
from mudg.stages.exporting.messages import Told, records_of, refuse_missing, write_log, write_messages
from mudg.stages.exporting.scenes import splat_scene, with_sky_sphere
from mudg.stages.fitting.storage import load_model, model_of_scene

CAMERAS: Final[Mapping[str, Callable[[Scene, PointCloud | None], dict[str, bytes]]]] = {
    "nerfstudio": nerfstudio_files, "colmap": colmap_files,
    "colmap-text": lambda scene, points: colmap_files(scene, points, text=True),
}  # fmt: skip
"""Formats of cameras: files beside the pictures."""
_ALL_MOMENTS: Final = ("bundle", "alpasim")
MOST_POINTS: Final = 500_000
FOLDERS: Final = {
    **{name: (1, ("transforms.json", "points.ply", *below("sparse/0", ("*.bin", "*.txt")), "images/")) for name in CAMERAS}, **LOG_FOLDERS
}
"""Formats that are folders: version and files of each."""


@dataclass(frozen=True, slots=True, eq=False)
class Exported:
    """What is exported.

    Args:
        parts: where it lies. model: the fit, edited; None if cameras alone are asked for. log: the recorded scene, edited, or None.
        edited: whether an edit script was carried out.
    """

    parts: RunParts
    model: SceneModel | None
    log: Scene | None
    edited: bool = False

    @classmethod
    def of(cls, parts: RunParts, script: EditScript | None) -> Exported:
        """The parts of a source, with an edit script carried out."""
        recorded = None if parts.scene is None else read_scene(parts.scene)
        if not parts.fits and script is not None:
            raise UsageError("an edit script is carried out on a fit", where="--edits", got=str(parts.scene),
                remedy="give the folder of a run")  # fmt: skip
        if not parts.fits:
            return cls(parts, None, recorded)
        model = load_model(parts.model) if recorded is None else model_of_scene(parts.model, recorded)
        if script is None:
            return cls(parts, model, recorded)
        drive = carry_out(script, model, recorded)
        return cls(parts, drive.model(model), drive.scene or recorded, edited=True)


def parts_of(name: str, source: Path, scene: Path | None) -> RunParts:
    """Where the parts of a source lie: of a fit, a run, or, for formats without Gaussians, a scene."""
    alone = name not in FORMATS and ((source / "scene.json").is_file() or source.suffix == ".zip")
    parts = RunParts({}, source, None, False) if alone else find_run(source)
    return replace(parts, scene=scene or parts.scene)


def check(config: ExportConfig, name: str, out: Path) -> None:
    """UsageError for an unknown format, a setting that it does not have, or a file whose name does not fit it; ResourceError for a package
    that is missing."""
    if name not in FORMATS and name not in CAMERAS and name not in MESSAGES:
        known = ", ".join((*FORMATS, *CAMERAS, *MESSAGES))
        raise UsageError(f"there is no export format {name!r}", expected=f"one of {known}", remedy="see docs/export.md")
    _refuse_settings(config, name)
    refuse_missing(name)
    if name not in FOLDERS:
        _refuse_name(out, name)


def write_folder(name: str, given: Exported, out: Path) -> dict[str, Any]:
    """Write cameras, or a log over time, to the work folder; returns a summary."""
    recorded = _known(given)
    if name not in CAMERAS:
        return write_messages(name, records_of(recorded, _points(given)), out)
    names = picture_names(recorded)
    with log.task("export", len(names)) as bar:
        for place, content in pictures(recorded):
            if not (out / place).is_file():
                store.atomic_write(out / place, content)
            bar.advance()
    for place, content in CAMERAS[name](recorded, _points(given)).items():
        store.atomic_write(out / place, content)
    return {"format": name, "images": len(names)}


def write_file(config: ExportConfig, name: str, given: Exported, out: Path) -> dict[str, Any]:
    """Write Gaussians, or a log over time, as one file; returns what the file is."""
    about = (_messages if name in MESSAGES else _gaussians)(config, name, given, out)
    return {"format": name, "mudg": version(), **about}


def _refuse_settings(config: ExportConfig, name: str) -> None:
    moves = name in FORMATS and "motion" in FORMATS[name].carries
    if config.animated and config.time_s is not None:
        raise UsageError(
            "a file holds one moment or the motion", where="--animated, --time-s", remedy="leave one of them out"
        )
    if config.animated and not moves:
        able = ", ".join(key for key, one in FORMATS.items() if "motion" in one.carries)
        raise UsageError(
            "this format cannot hold motion", where="--animated", got=name, expected=able, remedy="or give --time-s"
        )
    if name in _ALL_MOMENTS and config.time_s is not None:
        raise UsageError("a file of this format holds all moments", where="--time-s", got=name, remedy="leave it out, or export ply")
    set_here = [
        key for key in ("time_s", "nodes", "spz_version") if getattr(config, key) != getattr(ExportConfig(), key)
    ]
    refused = set_here if name not in FORMATS else [key for key in set_here if key == "spz_version" and name != "spz"]
    if refused:
        flag = refused[0].replace("_", "-")
        raise UsageError("the format does not have this setting", where=f"--{flag}", got=name, remedy="leave it out")


def _refuse_name(out: Path, name: str) -> None:
    suffixes = (MESSAGES[name],) if name in MESSAGES else FORMATS[name].suffixes
    if not Path(out).name.lower().endswith(suffixes):
        expected = f"a name that ends in {' or '.join(suffixes)}"
        raise UsageError("the name of the file does not fit its format", where="--out", expected=expected, got=str(out))


# -- Gaussians -----------------------------------------------------------------------------------------------------------


def requested(config: ExportConfig, name: str, given: Exported) -> WriteRequest:
    """The scene in the axes of the format, and the moment."""
    if given.model is None:
        raise InputError(
            "there is no fitted scene",
            where=str(given.parts.scene),
            expected="a folder made by `mudg fit` or `mudg run`",
        )
    moment = config.time_s if config.time_s is not None else middle_s(given.model, given.log)
    scene = splat_scene(given.model, moment, config.nodes)
    whole = "motion" in FORMATS[name].carries and config.time_s is None
    if not scene.nodes or not (whole or any(node.at(moment) is not None and len(node.cloud) for node in scene.nodes)):
        asked = ", ".join(config.nodes) or "everything"
        raise UsageError("there is nothing to export", where="--nodes, --time-s", got=f"{asked} at {moment:g} s",
            remedy="choose a time at which the object is there")  # fmt: skip
    if config.sky == "sphere":
        scene = with_sky_sphere(scene)
    elif config.sky == "none":
        scene = replace(scene, sky=None)
    facts = {**scene.facts, "generator": f"mudg {version()}"}
    scene = replace(scene, file_from_world=file_from_world(name, config.axes), facts=facts)
    ground = _ground(given) if name == "alpasim" else None
    return WriteRequest(scene, None if whole else moment, config.spz_version, given.log, ground)


def _ground(given: Exported) -> HeightMap | None:
    """The height of the ground, by classes of points or Gaussians, else by the lowest Gaussians."""
    if given.model is None:
        return None
    cloud = None if given.parts.fused is None else read_fused(given.parts.fused)
    found = ground_of(cloud, given.model)
    lowest = lowest_points(given.model) if found is None else ()
    return HeightMap.from_points(np.asarray(lowest)) if len(lowest) else found


def middle_s(model: SceneModel, recorded: Scene | None) -> float:
    """The time of the log's middle image; without a log, the middle of what moves; 0 if nothing does."""
    if recorded is not None and recorded.frames:
        return float(np.sort([frame.view.time_s for frame in recorded.frames])[len(recorded.frames) // 2])
    keys = [times for node in model.nodes if len(times := getattr(node, "times_s", ()))]
    return 0.0 if not keys else (min(float(k[0]) for k in keys) + max(float(k[-1]) for k in keys)) / 2


def _gaussians(config: ExportConfig, name: str, given: Exported, out: Path) -> dict[str, Any]:
    """Write the Gaussians; returns what the file is."""
    request = requested(config, name, given)
    content, lost = FORMATS[name].write(request), losses(name, request)
    count = _count(request.scene) if request.time_s is None else len(request.cloud)
    store.atomic_write(out, content)
    when = "all of the motion" if request.time_s is None else f"at {request.time_s:g} s"
    log.info(f"export: {count} Gaussians, {when}, {len(content) / 1e6:.2f} MB")
    for sentence in lost:
        log.warn(f"export: {name} does not hold {sentence}")
    return {
        "bytes": len(content), "gaussians": count, "degree": request.scene.degree, "time_s": request.time_s, "axes": config.axes,
        "file_from_world": request.scene.file_from_world, "nodes": [node.name for node in request.scene.nodes], "not_in_the_file": lost,
    }  # fmt: skip


def _count(scene: SplatScene) -> int:
    return sum(len(node.cloud) for node in scene.nodes)


# -- cameras and messages -----------------------------------------------------------------------------------------------


def _messages(_config: ExportConfig, name: str, given: Exported, out: Path) -> dict[str, Any]:
    """Write the log as messages over time; returns what the file is."""
    splats, records = None, None
    if name == "rerun" and given.model is not None:
        splats = splat_scene(given.model, middle_s(given.model, given.log))
    if name != "rerun" or given.log is not None:
        records = records_of(_known(given), _points(given) if splats is None else None)
    return write_log(name, Told(records, splats), out)


def _known(given: Exported) -> Scene:
    """The recorded scene; InputError if none is known."""
    if given.log is None:
        raise InputError("cameras belong to a scene, and none is known here", where=str(given.parts.model),
            remedy="give --scene SCENE, or a folder made by `mudg run`")  # fmt: skip
    if given.edited:
        log.warn(
            "export: an edit script changes boxes and the vehicle's path here; pictures and sweeps stay as recorded"
        )
    return given.log


def _points(given: Exported) -> PointCloud | None:
    """Starting points: fused ones, else the centres of the solid Gaussians of the background."""
    if given.parts.fused is not None:
        static = read_fused(given.parts.fused).static
        step = -(-len(static) // MOST_POINTS) or 1
        return PointCloud(static.xyz[::step].copy(), static.rgb[::step].copy(), "world")
    if given.model is None:
        return None
    cloud = splat_scene(given.model, 0.0, (given.model.nodes[0].name,)).nodes[0].cloud
    solid = cloud.take(cloud.opacity > 0.5)
    rgb = np.round((solid.sh[:, 0] * C0 + 0.5).clip(0, 1) * 255).astype(np.uint8)
    return PointCloud(np.ascontiguousarray(solid.means, np.float32), rgb, "world")
