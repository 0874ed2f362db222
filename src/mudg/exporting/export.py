"""export: a fitted scene, or the cameras of its log -> a file or folder for other programs.

Gaussians:  OUT and OUT.json (format, moment, axes, what the file does not hold, sha256)
cameras:    OUT/transforms.json ... (nerfstudio), OUT/sparse/0 (COLMAP), OUT/images
messages:   OUT.mcap (ROS 2, Foxglove), OUT/metadata.yaml and OUT/log_0.mcap (a bag of ROS 2),
            OUT/NAME.ncore4.zarr.itar (NCore)
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from mudg.base import geometry, log, store
from mudg.base.errors import InputError, UsageError
from mudg.base.layout import below
from mudg.base.palette import CLASSES, ID, UNLABELLED
from mudg.base.processes import one_torch_thread
from mudg.base.run_folder import ResultFile, RunDir
from mudg.base.types import PointCloud, Scene
from mudg.base.versions import version
from mudg.core import harmonics
from mudg.core.edit import HeightMap
from mudg.core.harmonics import C0
from mudg.core.table import Table
from mudg.editing.apply import carry_out, ground_of, write_asset
from mudg.editing.model import Asset, classes_of_rows, lowest_points
from mudg.editing.runs import RunParts, find_run
from mudg.editing.script import EditScript
from mudg.exporting.settings import ExportConfig, ImportConfig
from mudg.formats.exporters import messages, ncore
from mudg.formats.exporters.cameras import colmap_files, nerfstudio_files, picture_names, pictures
from mudg.formats.splats.binary import MAX_BYTES
from mudg.formats.splats.cloud import SplatCloud, SplatNode, SplatScene, logit, spacing_m, turned, unit
from mudg.formats.splats.cloud import known as known_axes
from mudg.formats.splats.formats import COARSE_M, FORMATS, WriteRequest, file_from_world, losses, read_cloud
from mudg.gaussians.model import COLUMNS, SceneModel
from mudg.gaussians.nodes import DeformableNode, NodeRows, RigidNode, StaticNode
from mudg.gaussians.rendering import DRAWING
from mudg.gaussians.storage import load_model, model_of_scene, save_model
from mudg.scene.clouds import read_fused
from mudg.scene.read import read_scene

# scenes -------------------------------------------------------------------------------------------
# A fitted scene as files hold it: plain arrays by object, its motion as keys, its sky as a picture; and a file's
# Gaussians as a scene.

SKY_COUNT: Final = 6000
SKY_M: Final = 300.0
CLASS_LOGIT: Final = 5.0


@torch.no_grad()
def splat_scene(model: SceneModel, time_s: float, names: Sequence[str] = ()) -> SplatScene:
    """A fitted scene in world axes. ``time_s``: at which a background that changes with time, which no file holds, is
    taken. ``names``: of nodes to keep (none: all). UsageError: a node that the scene does not have."""
    there = [node.name for node in model.nodes]
    if unknown := [name for name in names if name not in there]:
        raise UsageError(f"the fitted scene has no node {unknown[0]!r}", where="--nodes", expected=", ".join(there))
    classes, nodes = classes_of_rows(model), list[SplatNode]()
    for index, node in enumerate(model.nodes):
        rows = (model.table.labels["node"] == index).nonzero()[:, 0]
        if (names and node.name not in names) or (index and not len(rows)):
            continue
        ids = classes[rows.cpu().numpy()]
        known = None if not model.classes else np.where(ids < 0, UNLABELLED, ids).astype(np.uint8)
        own = {name: value.detach()[rows] for name, value in model.table.columns.items()}
        further = {name: value for name, value in own.items() if name not in COLUMNS}
        parts = NodeRows(own["means"], own["quats"], torch.sigmoid(own["logits"]), own["sh_dc"], further)
        bands = torch.cat([own[name] for name in ("sh_dc", "sh_rest") if name in own], 1)
        sh = bands[:, : (model.sh_degree + 1) ** 2].cpu().numpy()
        nodes.append(_node(node, parts, partial(_cloud, own["log_scales"], sh, known), time_s))
    facts = {key: model.facts[key] for key in ("method", "scene", "drawing") if key in model.facts}
    name, sky = str(model.facts.get("scene", "scene")), None
    if model.sky is not None:
        panorama = model.sky.table["panorama"].detach()[0].clamp(0, 1).cpu().numpy()
        sky = np.round(panorama.transpose(1, 2, 0) * 255).astype(np.uint8)
    return SplatScene(name, tuple(nodes), sky=sky, facts=facts)


def _node(
    node: StaticNode | RigidNode, rows: NodeRows, cloud_of: Callable[[NodeRows], SplatCloud], time_s: float
) -> SplatNode:
    if not isinstance(node, RigidNode):
        now = rows if type(node) is StaticNode else node.at_time(rows, time_s)
        return SplatNode(node.name, cloud_of(replace(rows, opacity=rows.opacity * 0) if now is None else now))
    cloud, displacement, keys = cloud_of(rows), None, node.corrected_keys()
    if type(node) is DeformableNode:
        displacement = np.stack([node.displacement(rows.means, float(t)).cpu().numpy() for t in node.times_s])
    elif type(node) is not RigidNode:  # what only the program itself can move: places at the keys, straight between
        cloud, displacement = _sampled(node, rows, keys, cloud)
    size = (node.size_m[0], node.size_m[1], node.size_m[2])
    return SplatNode(node.name, cloud, node.label, size, node.times_s, keys, displacement)


def _cloud(
    log_scales: Tensor, sh: NDArray[np.float32], classes: NDArray[np.uint8] | None, rows: NodeRows
) -> SplatCloud:
    parts = (rows.means, rows.quats, log_scales, rows.opacity, rows.sh_dc)
    means, quats, logs, opacity, first = (values.detach().cpu().numpy() for values in parts)
    full = np.concatenate([first, sh[:, 1:]], 1)
    return SplatCloud(means, unit(quats, "the fitted scene"), logs, logit(opacity), full, classes)


def _sampled(
    node: RigidNode, rows: NodeRows, keys: NDArray[np.float64], cloud: SplatCloud
) -> tuple[SplatCloud, NDArray[np.float32]]:
    """Gaussians in the frame of the box as they are in the middle of the track, and their displacements at its keys."""
    middle, places = len(node.times_s) // 2, []
    for index, moment in enumerate(node.times_s.tolist()):
        now = node.at_time(rows, moment)
        if now is None:  # a key lies within the span
            continue
        box_from_world = geometry.invert(keys[index])
        places.append(geometry.transform_points(box_from_world, now.means.cpu().numpy().astype(np.float64)))
        if index == middle:
            turns = unit(now.quats.cpu().numpy(), node.name)
            cloud = replace(cloud, quats=turned(geometry.quaternion_from_matrix(box_from_world), turns))
    base = places[middle].astype(np.float32)
    return replace(cloud, means=base), (np.stack(places) - base).astype(np.float32)


# -- sky -------------------------------------------------------------------------------------------


def with_sky_sphere(scene: SplatScene) -> SplatScene:
    """The scene with its sky as flat Gaussians far away, for files that hold Gaussians alone; unchanged without a
    sky."""
    if scene.sky is None:
        return scene
    directions = harmonics.spiral(SKY_COUNT)
    rows, columns = scene.sky.shape[:2]
    row = ((0.5 - np.arcsin(directions[:, 2].clip(-1, 1)) / np.pi) * rows).astype(int).clip(0, rows - 1)
    column = ((np.arctan2(directions[:, 1], directions[:, 0]) / (2 * np.pi) + 0.5) * columns).astype(int) % columns
    color = scene.sky[row, column] / 255
    apart = SKY_M * np.sqrt(4 * np.pi / SKY_COUNT)
    axis = np.cross([0.0, 0.0, 1.0], directions)  # turns z, the flat side, outwards
    quats = unit(np.column_stack([1 + directions[:, 2], axis]) + np.array([1e-9, 0, 0, 0]), "sky")
    solid = scene.nodes[0].cloud
    center = np.median(solid.means, 0) if len(solid) else np.zeros(3)
    count = len(directions)
    flat = np.log(np.tile([0.7 * apart, 0.7 * apart, 0.5], (count, 1)))
    columns = [values.astype(np.float32) for values in (directions * SKY_M + center, quats, flat, np.full(count, 6.0))]
    cloud = SplatCloud(*columns, ((color - 0.5) / harmonics.C0)[:, None].astype(np.float32))
    return replace(scene, nodes=(*scene.nodes, SplatNode("sky", cloud)), sky=None)


# -- from files ------------------------------------------------------------------------------------


def model_of_cloud(cloud: SplatCloud, name: str) -> SceneModel:
    """The Gaussians of a file as a fitted scene in which nothing moves; classes where the file holds them."""
    known: tuple[int, ...] = ()
    if cloud.class_ids is not None:
        known = tuple(int(value) for value in np.unique(cloud.class_ids) if value < 19)
    table = Table(_tensors(cloud, known), {"node": torch.zeros(len(cloud), dtype=torch.int32)})
    drawing = {DRAWING: {"antialias": True}} if cloud.antialias else {}
    facts = {"method": "imported", "source": name, **drawing}
    return SceneModel(table, (StaticNode(),), None, known, cloud.degree, facts)


def _tensors(cloud: SplatCloud, known: Sequence[int] = ()) -> dict[str, Tensor]:
    """The columns of a table; with scores of the ``known`` classes."""
    columns = {name: getattr(cloud, name) for name in ("means", "quats", "log_scales", "logits")}
    columns["sh_dc"] = cloud.sh[:, :1]
    if cloud.degree:
        columns["sh_rest"] = cloud.sh[:, 1:]
    if known and cloud.class_ids is not None:
        columns["semantics"] = np.where(cloud.class_ids[:, None] == np.array(known), CLASS_LOGIT, -CLASS_LOGIT)
    return {key: torch.from_numpy(np.ascontiguousarray(value, np.float32)) for key, value in columns.items()}


# export -------------------------------------------------------------------------------------------

CAMERAS: Final[Mapping[str, Callable[[Scene, PointCloud | None], dict[str, bytes]]]] = {
    "nerfstudio": nerfstudio_files,
    "colmap": colmap_files,
}
"""Formats of cameras: files beside the pictures."""
SUFFIXES: Final = {"mcap": ".mcap", "ros2": "", "ncore": ""}
"""Formats of a log over time, and the suffix of their file; none: a folder."""
_PACKAGES: Final = {"ncore": ncore.package, "mcap": messages.mcap_writer, "ros2": messages.mcap_writer}
"""Formats that need a package -> what loads it."""
MOST_POINTS: Final = 500_000
_CAMERA_FILES: Final = ("transforms.json", "points.ply", *below("sparse/0", ("*.bin",)), "images/")
FOLDERS: Final = {
    **dict.fromkeys(CAMERAS, (1, _CAMERA_FILES)),
    "ros2": (1, (messages.BAG_METADATA, messages.BAG_FILE)),
    "ncore": (1, ncore.FILES),
}
"""Formats that are folders: version and files of each."""


@dataclass(frozen=True, slots=True, eq=False)
class Exported:
    """What is exported. ``parts``: where it lies. ``model``: the fit, edited; None if cameras alone are asked for.
    ``log``: the recorded scene, edited, or None. ``edited``: whether an edit script was carried out."""

    parts: RunParts
    model: SceneModel | None
    log: Scene | None
    edited: bool = False

    @classmethod
    @one_torch_thread()
    def of(cls, parts: RunParts, script: EditScript | None) -> Exported:
        """The parts of a source, with an edit script carried out."""
        recorded = None if parts.scene is None else read_scene(parts.scene)
        if not parts.fits and script is not None:
            what = "an edit script is carried out on a fit"
            raise UsageError(what, where="--edits", got=str(parts.scene), remedy="give the folder of a run")
        if not parts.fits:
            return cls(parts, None, recorded)
        model = load_model(parts.model) if recorded is None else model_of_scene(parts.model, recorded)
        if script is None:
            return cls(parts, model, recorded)
        drive = carry_out(script, model, recorded)
        return cls(parts, drive.model(model), drive.scene or recorded, edited=True)


def parts_of(name: str, source: Path, scene: Path | None) -> RunParts:
    """Where the parts of a source lie: of a fit, a run, or, for formats without Gaussians, a scene."""
    alone = name not in FORMATS and (source / "scene.json").is_file()
    return RunParts({}, scene or source, None, False) if alone else find_run(source, scene)


def check(config: ExportConfig, name: str, out: Path) -> None:
    """UsageError for an unknown format, a setting that it does not have, or a file whose name does not fit it;
    ResourceError for a package that is missing."""
    if name not in FORMATS and name not in CAMERAS and name not in SUFFIXES:
        known = ", ".join((*FORMATS, *CAMERAS, *SUFFIXES))
        raise UsageError(f"there is no export format {name!r}", expected=f"one of {known}", remedy="see docs/export.md")
    if name == "alpasim" and config.time_s is not None:
        what = "a file of this format holds all moments"
        raise UsageError(what, where="--time-s", got=name, remedy="leave it out, or export ply")
    for flag, given in (("--time-s", config.time_s is not None), ("--nodes", config.nodes)):
        if given and name not in FORMATS:
            raise UsageError("the format does not have this setting", where=flag, got=name, remedy="leave it out")
    if name in _PACKAGES:
        _PACKAGES[name]()
    suffixes = (SUFFIXES[name],) if name in SUFFIXES else FORMATS[name].suffixes if name in FORMATS else ()
    if name not in FOLDERS and not Path(out).name.lower().endswith(suffixes):
        expected = f"a name that ends in {' or '.join(suffixes)}"
        raise UsageError("the name of the file does not fit its format", where="--out", expected=expected, got=str(out))


@one_torch_thread()
def write_folder(name: str, exported: Exported, recorded: Scene, work: RunDir) -> dict[str, Any]:
    """Write cameras, or a log over time, to the work folder; returns a summary."""
    out = work.path
    if name not in CAMERAS:
        return _write_messages(name, messages.LogRecords(recorded, _points(exported)), out)
    names = picture_names(recorded)
    with log.task("export", len(names)) as bar:
        for place, content in pictures(recorded):
            if not (out / place).is_file():
                store.atomic_write(out / place, content)
            bar.advance()
    for place, content in CAMERAS[name](recorded, _points(exported)).items():
        store.atomic_write(out / place, content)
    return {"format": name, "images": len(names)}


@one_torch_thread()
def write_file(config: ExportConfig, name: str, exported: Exported, file: ResultFile) -> dict[str, Any]:
    """Write Gaussians, or a log over time, as one file; returns what the file is."""
    about = _log(exported, file.path) if name in SUFFIXES else _gaussians(config, name, exported, file.path)
    return {"format": name, "mudg": version(), **about}


# -- Gaussians -------------------------------------------------------------------------------------


def requested(config: ExportConfig, name: str, exported: Exported) -> WriteRequest:
    """The scene in the axes of the format, and the moment."""
    if exported.model is None:
        what = "there is no fitted scene"
        raise InputError(what, where=str(exported.parts.scene), expected="a folder made by `mudg fit` or `mudg run`")
    moment = config.time_s if config.time_s is not None else middle_s(exported.model, exported.log)
    scene = splat_scene(exported.model, moment, config.nodes)
    whole = "motion" in FORMATS[name].carries and config.time_s is None
    if not scene.nodes or not (whole or any(node.at(moment) is not None and len(node.cloud) for node in scene.nodes)):
        asked = ", ".join(config.nodes) or "everything"
        what, got = "there is nothing to export", f"{asked} at {moment:g} s"
        raise UsageError(what, where="--nodes, --time-s", got=got, remedy="choose a time at which the object is there")
    if config.sky == "sphere":
        scene = with_sky_sphere(scene)
    elif config.sky == "none":
        scene = replace(scene, sky=None)
    facts = {**scene.facts, "generator": f"mudg {version()}"}
    scene = replace(scene, file_from_world=file_from_world(name, config.axes), facts=facts)
    ground = road = None
    if name == "alpasim":  # whose road and ground come from classes of points, the ground else from the Gaussians
        cloud = None if exported.parts.fused is None else read_fused(exported.parts.fused)
        if cloud is not None and cloud.static.semantics is not None:
            road = cloud.static.xyz[cloud.static.semantics == ID["road"]]
        ground = ground_of(cloud, exported.model)
        if ground is None and len(lowest := lowest_points(exported.model)):
            ground = HeightMap.from_points(np.asarray(lowest))
    return WriteRequest(scene, None if whole else moment, exported.log, ground, road)


def middle_s(model: SceneModel, recorded: Scene | None) -> float:
    """The time of the log's middle image; without a log, the middle of what moves; 0 if nothing does."""
    if recorded is not None and recorded.frames:
        return float(np.sort([frame.view.time_s for frame in recorded.frames])[len(recorded.frames) // 2])
    keys = [times for node in model.nodes if len(times := getattr(node, "times_s", ()))]
    return 0.0 if not keys else (min(float(k[0]) for k in keys) + max(float(k[-1]) for k in keys)) / 2


def _gaussians(config: ExportConfig, name: str, exported: Exported, out: Path) -> dict[str, Any]:
    """Write the Gaussians; returns what the file is."""
    request = requested(config, name, exported)
    content, lost = FORMATS[name].write(request), losses(name, request)
    whole = request.time_s is None
    count = sum(len(node.cloud) for node in request.scene.nodes) if whole else len(request.cloud)
    store.atomic_write(out, content)
    when = "all of the motion" if request.time_s is None else f"at {request.time_s:g} s"
    log.info(f"export: {count} Gaussians, {when}, {len(content) / 1e6:.2f} MB")
    for sentence in lost:
        log.warn(f"export: {name} does not hold {sentence}")
    return {
        "bytes": len(content),
        "gaussians": count,
        "degree": request.scene.degree,
        "time_s": request.time_s,
        "axes": config.axes,
        "file_from_world": request.scene.file_from_world,
        "nodes": [node.name for node in request.scene.nodes],
        "not_in_the_file": lost,
    }


# -- cameras and messages --------------------------------------------------------------------------


def _log(exported: Exported, out: Path) -> dict[str, Any]:
    """Write the log as one MCAP file; returns its size."""
    records = messages.LogRecords(recorded_scene(exported), _points(exported))
    messages.write_mcap(out, messages.Ros2Messages(records))
    size = out.stat().st_size
    log.info(f"export: {records}, {size / 1e6:.2f} MB")
    return {"bytes": size}


def _write_messages(name: str, records: messages.LogRecords, out: Path) -> dict[str, Any]:
    """Write the log as a folder, ``ros2`` or ``ncore``; returns a summary."""
    if name == "ros2":
        largest = out / messages.BAG_FILE
        topics, span = messages.write_mcap(largest, messages.Ros2Messages(records))
        store.atomic_write(out / messages.BAG_METADATA, messages.bag_metadata(topics, span))
        what, count = "messages", sum(number for _, number in topics.values())
    else:
        cameras = records.scene.cameras.items()
        if rolling := ", ".join(name for name, camera in cameras if ncore.unknown_shutter(camera)):
            log.warn(f"export: the scene does not say which way the shutters of {rolling} roll; ncore says downwards")
        largest, what, count = ncore.write_ncore(out, records)[0], "boxes", len(records.scene.tracks)
    log.info(f"export: {records}, {count} {what}, {largest.stat().st_size / 1e6:.2f} MB in {out}")
    return {"format": name, what: count}


def recorded_scene(exported: Exported) -> Scene:
    """The recorded scene of what is exported; InputError if none is known."""
    if exported.log is None:
        what, where = "cameras belong to a scene, and none is known here", str(exported.parts.model)
        raise InputError(what, where=where, remedy="give --scene SCENE, or a folder made by `mudg run`")
    if exported.edited:
        changes = "an edit script changes boxes and the vehicle's path here"
        log.warn(f"export: {changes}; pictures and sweeps stay as recorded")
    return exported.log


def _points(exported: Exported) -> PointCloud | None:
    """Starting points: fused ones, else the centres of the solid Gaussians of the background."""
    if exported.parts.fused is not None:
        static = read_fused(exported.parts.fused).static
        step = -(-len(static) // MOST_POINTS) or 1
        return PointCloud(static.xyz[::step].copy(), static.rgb[::step].copy(), "world")
    if exported.model is None:
        return None
    cloud = splat_scene(exported.model, 0.0, (exported.model.nodes[0].name,)).nodes[0].cloud
    solid = cloud.take(cloud.opacity > 0.5)
    rgb = np.round((solid.sh[:, 0] * C0 + 0.5).clip(0, 1) * 255).astype(np.uint8)
    return PointCloud(np.ascontiguousarray(solid.means, np.float32), rgb, "world")


# imports -------------------------------------------------------------------------------------------
# asset import: a file of Gaussians from another program -> an asset that edit scripts can insert, or a scene in which
# nothing moves.

TRAIN_IDS: Final = {
    **dict.fromkeys(("pedestrian", "adult", "child"), ID["person"]),
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
    if len(config.axes) == 3 and not known_axes(config.axes):
        expected = "one of L and R, one of U and D, one of F and B"
        raise UsageError("these letters name no three axes", where="--axes", expected=expected, got=config.axes)
    if config.kind == "object" and config.origin_m is not None:
        what = "an object is centred in its box"
        raise UsageError(what, where="--origin-m", remedy="leave it out, or add --kind scene")


def bounded(file: Path) -> Path:
    """The file; InputError for one that is too large to be read."""
    size = store.regular(file).stat().st_size
    if size > MAX_BYTES:
        raise InputError("the file is too large", where=str(file), expected=f"at most {MAX_BYTES} bytes", got=str(size))
    return file


def read_file(file: Path, config: ImportConfig) -> tuple[SplatCloud, str]:
    """The Gaussians of a file in the axes of this program, and its format."""
    return read_cloud(store.read_bytes(bounded(file)), str(file), config.axes)


def asset_of_cloud(cloud: SplatCloud, config: ImportConfig, origin: str) -> Asset:
    """Gaussians as an object: turned, centred in their box, scaled to its length."""
    cloud = cloud.moved(geometry.yaw_matrix(np.radians(config.yaw_deg)))
    solid = cloud.means[cloud.opacity > SOLID]
    if len(solid) < 2:
        expected = f"opacities above {SOLID}"
        what = "the file holds no solid Gaussians"
        raise InputError(what, where=origin, expected=expected, got=f"{len(solid)} of them")
    low, high = np.percentile(solid.astype(np.float64), [OUTSIDE, 100 - OUTSIDE], 0)
    size = np.maximum(high - low, 1e-3)
    scale = 1.0 if config.length_m is None else config.length_m / float(size[0])
    means = ((cloud.means - (low + high) / 2) * scale).astype(np.float32)
    if cloud.antialias:
        meant = "its Gaussians are meant to be drawn antialiased"
        log.warn(f"{origin}: {meant}; an object is drawn as the scene that it stands in")
    logs = (cloud.log_scales + np.log(scale)).astype(np.float32)
    tensors = _tensors(replace(cloud, means=means, log_scales=logs, sh=cloud.sh[:, :1]))
    label = config.label.strip().lower()
    ids = np.full(len(cloud), TRAIN_IDS.get(label, ID.get(label, -1)), np.int64)
    if cloud.class_ids is not None:
        ids = np.where(cloud.class_ids < len(CLASSES), cloud.class_ids.astype(np.int64), ids)
    length, width, height = (float(value) for value in size * scale)
    return Asset(tensors, ids, None, config.label, (length, width, height), None, (), origin)


def _origin(cloud: SplatCloud, config: ImportConfig, file: Path) -> list[float]:
    """What is taken away from the places, in f64: as set, or the middle of Gaussians so far away that f32 would be too
    coarse for them."""
    origin = [0.0, 0.0, 0.0] if config.origin_m is None else list(config.origin_m)
    if config.origin_m is None and spacing_m(cloud.means) > COARSE_M:
        origin = [float(value) for value in np.round(np.median(cloud.means, 0))]
        far = f"{file}: its Gaussians lie far from the origin of the file"
        log.warn(f"{far}: {origin} becomes the origin; --origin-m sets another")
    if (step := spacing_m(cloud.means - np.array(origin))) > COARSE_M:
        far = f"{file}: its Gaussians lie so far from the origin that their places are rounded to {step * 1000:.3g} mm"
        log.warn(f"{far}; --origin-m takes an offset away before")
    return origin
