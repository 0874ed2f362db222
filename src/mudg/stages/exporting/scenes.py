"""A fitted scene as files hold it: plain arrays by object, its motion as keys, its sky as a picture; and a file's Gaussians as a scene."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Final

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from mudg.base import geometry
from mudg.base.errors import UsageError
from mudg.base.palette import UNLABELLED
from mudg.core import sh as harmonics
from mudg.core.table import Table
from mudg.data.splats.cloud import SplatCloud, SplatNode, SplatScene, logit, unit
from mudg.models.scene.edited import classes_of_rows
from mudg.models.scene.model import COLUMNS, SceneModel
from mudg.models.scene.nodes import DeformableNode, NodeRows, RigidNode, StaticNode
from mudg.models.scene.sky import SkyNode
from mudg.stages.editing.carried import IMPORTED
from mudg.stages.fitting.rendering import DRAWING

SKY_COUNT: Final = 6000
SKY_M: Final = 300.0
CLASS_LOGIT: Final = 5.0


@torch.no_grad()
def splat_scene(model: SceneModel, time_s: float, names: Sequence[str] = ()) -> SplatScene:
    """A fitted scene in world axes.

    Args:
        time_s: at which a background that changes with time, which no file holds, is taken. names: of nodes to keep (none: all).

    Raises:
        UsageError: a node that the scene does not have.
    """
    there = [node.name for node in model.nodes]
    unknown = [name for name in names if name not in there]
    if unknown:
        raise UsageError(f"the fitted scene has no node {unknown[0]!r}", where="--nodes", expected=", ".join(there))
    classes, made = classes_of_rows(model), list[SplatNode]()
    for index, node in enumerate(model.nodes):
        rows = (model.table.labels["node"] == index).nonzero()[:, 0]
        if (names and node.name not in names) or (index and not len(rows)):
            continue
        ids = classes[rows.cpu().numpy()]
        known = None if not model.classes else np.where(ids < 0, UNLABELLED, ids).astype(np.uint8)
        made.append(_node(node, _given(model, rows), _sh(model, rows), known, time_s))
    facts = {key: model.facts[key] for key in ("method", "scene", "drawing") if key in model.facts}
    name = str(model.facts.get("scene", "scene"))
    return SplatScene(name, tuple(made), sky=None if model.sky is None else sky_picture(model.sky), facts=facts)


def _given(model: SceneModel, rows: Tensor) -> tuple[NodeRows, Tensor]:
    """Rows of a node as ``at_time`` takes them, and their sizes."""
    own = {name: value.detach()[rows] for name, value in model.table.columns.items()}
    further = {name: value for name, value in own.items() if name not in COLUMNS}
    return NodeRows(own["means"], own["quats"], torch.sigmoid(own["logits"]), own["sh_dc"], further), own["log_scales"]


def _sh(model: SceneModel, rows: Tensor) -> NDArray[np.float32]:
    parts = [model.table[name].detach()[rows] for name in ("sh_dc", "sh_rest") if name in model.table.columns]
    return torch.cat(parts, 1)[:, : (model.sh_degree + 1) ** 2].cpu().numpy()


def _node(
    node: StaticNode | RigidNode, given: tuple[NodeRows, Tensor], sh: NDArray[np.float32],
    classes: NDArray[np.uint8] | None, time_s: float,
) -> SplatNode:  # fmt: skip
    rows, log_scales = given
    if not isinstance(node, RigidNode):
        now = rows if type(node) is StaticNode else node.at_time(rows, time_s)
        return SplatNode(
            node.name, _cloud(replace(rows, opacity=rows.opacity * 0) if now is None else now, log_scales, sh, classes)
        )
    cloud, displacement = _cloud(rows, log_scales, sh, classes), None
    keys = node.corrected_keys()
    if type(node) is DeformableNode:
        displacement = np.stack([node.displacement(rows.means, float(t)).cpu().numpy() for t in node.times_s])
    elif type(node) is not RigidNode:  # what only the program itself can move: places at the keys, straight between
        cloud, displacement = _sampled(node, rows, keys, cloud)
    size = (node.size_m[0], node.size_m[1], node.size_m[2])
    return SplatNode(node.name, cloud, node.label, size, node.times_s, keys, displacement)


def _cloud(
    rows: NodeRows, log_scales: Tensor, sh: NDArray[np.float32], classes: NDArray[np.uint8] | None
) -> SplatCloud:
    columns = [values.detach().cpu().numpy() for values in (rows.means, rows.quats, log_scales, rows.opacity)]
    means, quats, logs, opacity = columns
    full = np.concatenate([rows.sh_dc.detach().cpu().numpy(), sh[:, 1:]], 1)
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
            turn = SplatCloud(
                cloud.means, unit(now.quats.cpu().numpy(), node.name), cloud.log_scales, cloud.logits, cloud.sh[:, :1]
            )
            cloud = replace(cloud, quats=turn.moved(box_from_world).quats)
    base = places[middle].astype(np.float32)
    return replace(cloud, means=base), (np.stack(places) - base).astype(np.float32)


# -- sky -----------------------------------------------------------------------------------------------------------------


def sky_picture(sky: SkyNode) -> NDArray[np.uint8]:
    """The panorama u8[H, 2 H, 3] of a sky."""
    values = sky.table["panorama"].detach()[0].clamp(0, 1).cpu().numpy()
    return np.round(values.transpose(1, 2, 0) * 255).astype(np.uint8)


def with_sky_sphere(scene: SplatScene) -> SplatScene:
    """The scene with its sky as flat Gaussians far away, for files that hold Gaussians alone; unchanged without a sky."""
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


# -- from files ----------------------------------------------------------------------------------------------------------


def model_of_cloud(cloud: SplatCloud, name: str) -> SceneModel:
    """The Gaussians of a file as a fitted scene in which nothing moves; classes where the file holds them."""
    columns = {
        "means": cloud.means, "quats": cloud.quats, "log_scales": cloud.log_scales, "logits": cloud.logits, "sh_dc": cloud.sh[:, :1],
    }  # fmt: skip
    if cloud.degree:
        columns["sh_rest"] = cloud.sh[:, 1:]
    known: tuple[int, ...] = ()
    if cloud.class_ids is not None:
        known = tuple(int(value) for value in np.unique(cloud.class_ids) if value < 19)
    if known and cloud.class_ids is not None:
        columns["semantics"] = np.where(cloud.class_ids[:, None] == np.array(known), CLASS_LOGIT, -CLASS_LOGIT).astype(
            np.float32
        )
    tensors = {key: torch.from_numpy(np.ascontiguousarray(value, np.float32)) for key, value in columns.items()}
    table = Table(tensors, {"node": torch.zeros(len(cloud), dtype=torch.int32)})
    drawing = {DRAWING: {"antialias": True}} if cloud.antialias else {}
    return SceneModel(table, (StaticNode(),), None, known, cloud.degree, {"method": IMPORTED, "source": name, **drawing})
