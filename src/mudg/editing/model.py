"""Edits of a fitted scene: its objects on other paths, taken away, put in, cut out of the background; their contact
shadows.

Everything returns a changed copy and shares what stays. How a path changes is the business of ``core/edit.py``.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from mudg.base import geometry
from mudg.base.errors import InputError, UsageError
from mudg.base.palette import ID
from mudg.base.types import Track
from mudg.baselines.bezier import BezierNode
from mudg.baselines.omnire import DeformedNode
from mudg.core import harmonics
from mudg.core.edit import Motion
from mudg.core.harmonics import left_product_matrix
from mudg.core.lidar import met_box
from mudg.core.table import Table
from mudg.gaussians.model import CERTAINTY, COLUMNS, SceneModel
from mudg.gaussians.nodes import NodeRows, RigidNode
from mudg.gaussians.start import SH_C0

GROUND_CLASSES: Final = tuple(ID[name] for name in ("road", "sidewalk", "terrain"))
CUT_MARGIN_M: Final = 0.1
"""A box that is cut out of the background takes what lies this far beside it, too."""
CUT_FLOOR_M: Final = 0.12
"""What lies this low above the bottom of a box belongs to the ground, unless its class says otherwise."""
LIGHT_EXPONENT: Final = 0.75
SOLID_OPACITY: Final = 0.3
ABSENT_LOGIT: Final = -10.0
"""Class logit of an inserted object for classes that only the other scene knows."""
SHADOW_STEP_M: Final = 0.35
SHADOW_LIFT_M: Final = 0.04
SHADOW_BLUR: Final = 0.15
"""Width of a contact shadow's edge, as a share of the height of what casts it."""


# -- paths -----------------------------------------------------------------------------------------


def motion_of(node: RigidNode) -> Motion:
    """The path of a dynamic object, with what the fit corrected."""
    return Motion.recorded(node.times_s, node.corrected_keys())


def node_along(node: RigidNode, motion: Motion) -> RigidNode:
    """The same object on another path; what its rows do inside the box is that of the moments that the path shows (a
    ``DeformedNode``: of the time itself). InputError: an object on curves, whose Gaussians have places along the
    recorded path."""
    if isinstance(node, BezierNode):
        what = "an object that was fitted on curves cannot take another path"
        remedy = "remove or replace it, or use a fit with boxes (mudg_s, street_gaussians)"
        raise InputError(what, got=node.name, remedy=remedy)
    shown = np.interp(motion.source_s, node.times_s, np.arange(len(node.times_s), dtype=np.float64))
    names = [name for name in node.offsets.columns if name not in ("shift", "yaw")]
    columns = {name: _at_keys(node.offsets[name].detach(), shown) for name in names}
    zero = torch.zeros(len(shown), device=node.offsets.device)
    offsets = Table({"shift": zero[:, None].repeat(1, 3), "yaw": zero, **columns})
    made = type(node)(node.name, node.label, node.size_m, motion.times_s, motion.poses, offsets, node.learn_pose)
    if isinstance(made, DeformedNode) and isinstance(node, DeformedNode):
        made.instance, made.field = node.instance, node.field
    return made


def _at_keys(values: Tensor, shown: NDArray[np.float64]) -> Tensor:
    """Rows of ``values`` [K, ...] at fractional indices."""
    before = torch.from_numpy(np.floor(shown).astype(np.int64)).to(values.device)
    after = (before + 1).clamp(max=len(values) - 1)
    u = torch.from_numpy((shown - np.floor(shown)).astype(np.float32)).to(values.device)
    return torch.lerp(values[before], values[after], u.view(-1, *[1] * (values.dim() - 1)))


def with_motions(model: SceneModel, motions: Mapping[str, Motion]) -> SceneModel:
    """A copy with some objects on other paths; it shares the table of Gaussians. UsageError: an object that the scene
    has no node for."""
    wanted = {model.dynamic_object(name).name for name in motions}
    other = lambda node: isinstance(node, RigidNode) and node.name in wanted
    nodes = tuple(node_along(node, motions[node.name]) if other(node) else node for node in model.nodes)
    return replace(model, nodes=nodes, facts=dict(model.facts))


# -- what belongs to an object ---------------------------------------------------------------------


def classes_of_rows(model: SceneModel) -> NDArray[np.int64]:
    """Train id of every Gaussian, i64[N]; -1 without classes."""
    if not model.classes:
        return np.full(len(model.table), -1)
    channel = model.table["semantics"].detach().argmax(1).cpu().numpy()
    return np.asarray(model.classes)[channel]


def ground_points(model: SceneModel) -> NDArray[np.float32]:
    """Centres f32[M, 3] of the solid Gaussians of the background that are ground."""
    still = (model.table.labels["node"] == 0).cpu().numpy()
    solid = torch.sigmoid(model.table["logits"].detach()).cpu().numpy() > SOLID_OPACITY
    rows = still & solid & np.isin(classes_of_rows(model), GROUND_CLASSES)
    return model.table["means"].detach().cpu().numpy()[rows]


def lowest_points(model: SceneModel) -> NDArray[np.float32]:
    """Centres f32[M, 3] of the solid Gaussians of the background that are the lowest fifth of their square metre: the
    ground, where no class says what it is."""
    solid = torch.sigmoid(model.table["logits"].detach()).cpu().numpy() > SOLID_OPACITY
    rows = (model.table.labels["node"] == 0).cpu().numpy() & solid
    means = model.table["means"].detach().cpu().numpy()[rows]
    cells = np.floor(means[:, :2]).astype(np.int64)
    order = np.lexsort((means[:, 2], cells[:, 1], cells[:, 0]))
    _, begins, counts = np.unique(cells[order], axis=0, return_index=True, return_counts=True)
    rank = np.arange(len(order)) - np.repeat(begins, counts)
    return means[order[rank < np.repeat(np.ceil(counts / 5), counts)]]


def cut_out(model: SceneModel, track: Track) -> SceneModel:
    """A copy in which what stands in a box of the background is an object of its own, which can be moved or taken away.
    ``track``: a box that stands; its middle pose counts. UsageError: nothing of the background lies in the box, or the
    background changes with time."""
    if model.nodes[0].kind != "static":
        what, where = "nothing can be cut out of a background that changes with time", f"track {track.id!r}"
        got = f"a background of kind {model.nodes[0].kind}"
        raise UsageError(what, where=where, expected="a fit of mudg_s or street_gaussians", got=got)
    pose = track.world_from_object[len(track.times_s) // 2]
    table = model.table
    local = geometry.transform_points(geometry.invert(pose), table["means"].detach().cpu().numpy().astype(np.float64))
    half, floor = track.size_m / 2 + CUT_MARGIN_M, -track.size_m[2] / 2
    inside = (np.abs(local[:, :2]) <= half[:2]).all(1) & (local[:, 2] <= half[2]) & (local[:, 2] >= floor)
    low, ids = local[:, 2] < floor + CUT_FLOOR_M, classes_of_rows(model)
    inside &= ~np.isin(ids, GROUND_CLASSES) & ~(low & (ids < 0)) & (table.labels["node"] == 0).cpu().numpy()
    if not inside.any():
        what, remedy = "nothing of the fitted background lies in this box", "leave it out of the script"
        raise UsageError(what, where=f"track {track.id!r}", remedy=f"the fit did not see it; {remedy}")
    rows = torch.from_numpy(np.flatnonzero(inside)).to(model.device)
    columns = {name: value.detach().clone() for name, value in table.columns.items()}
    turn = torch.from_numpy(geometry.quaternion_from_matrix(geometry.invert(pose))).float().to(model.device)
    columns["means"][rows] = torch.from_numpy(local[inside].astype(np.float32)).to(model.device)
    columns["quats"][rows] = columns["quats"][rows] @ left_product_matrix(turn).T
    if model.sh_degree > 0:
        box_from_world = harmonics.mixing(torch.from_numpy(pose[:3, :3].T.copy()), model.sh_degree).to(model.device)
        columns["sh_rest"][rows] = harmonics.turned(columns["sh_rest"][rows], box_from_world)
    owner = table.labels["node"].clone()
    owner[rows] = len(model.nodes)
    node = RigidNode(track.id, track.label, track.size_m.tolist(), track.times_s, track.world_from_object)
    nodes = (*model.nodes, node.to(model.device))
    made = replace(model, table=Table(columns, {**table.labels, "node": owner}), nodes=nodes, facts=dict(model.facts))
    made.sort_rows()
    return made


# -- backgrounds -----------------------------------------------------------------------------------


def with_background(model: SceneModel, other: SceneModel, world_from_other: NDArray[np.float64]) -> SceneModel:
    """A copy whose background and sky are those of another scene; its objects stay.

    Classes are taken over by name, colours of degree 1 and more dropped: they hold the other scene's directions.

    Args:
        world_from_other: rigid 4x4, a turn about z and a translation.

    Raises:
        UsageError: a background that changes with time.
    """
    for scene in (model, other):
        if scene.nodes[0].kind != "static":
            what = "a background that changes with time cannot be exchanged"
            raise UsageError(what, got=f"kind {scene.nodes[0].kind}")
    there, mine = model.device, (model.table.labels["node"] > 0).nonzero()[:, 0]
    rows = (other.table.labels["node"] == 0).nonzero()[:, 0]
    given = {name: value.detach()[rows].cpu() for name, value in other.table.columns.items()}
    means = geometry.transform_points(world_from_other, given["means"].numpy())
    turn = torch.from_numpy(geometry.quaternion_from_matrix(world_from_other)).float()
    columns = {"means": torch.from_numpy(means), "quats": given["quats"] @ left_product_matrix(turn).T}
    columns |= {name: given[name] for name in ("log_scales", "logits", "sh_dc")}
    if "semantics" in model.table.columns:
        channels = torch.full((len(rows), len(model.classes)), ABSENT_LOGIT)
        for channel, train_id in enumerate(model.classes):
            if train_id in other.classes:
                channels[:, channel] = given["semantics"][:, other.classes.index(train_id)]
        columns["semantics"] = channels
    blank = lambda value, **kind: torch.zeros(len(rows), *value.shape[1:], **kind)
    labels = {key: blank(value, dtype=value.dtype) for key, value in model.table.labels.items()}
    if CERTAINTY in labels and other.certainty is not None:
        labels[CERTAINTY] = other.certainty[rows].cpu().to(labels[CERTAINTY].dtype)
    joined = {}
    for name, value in model.table.columns.items():
        street = columns[name] if name in columns else blank(value)
        joined[name] = torch.cat([street.to(there), value.detach()[mine]])
    joined_labels = {key: torch.cat([labels[key].to(there), v[mine]]) for key, v in model.table.labels.items()}
    table = Table(joined, joined_labels)
    sky = None
    if other.sky is not None:
        shift = round(geometry.yaw_of(world_from_other) / np.pi * other.sky.rows)
        turned = torch.roll(other.sky.table["panorama"].detach(), shift, dims=3)
        sky = type(other.sky)(Table({"panorama": turned})).to(there)
    return replace(model, table=table, sky=sky, facts=dict(model.facts))


# -- assets ----------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, eq=False)
class Asset:
    """One object of a fitted scene by itself.

    Args:
        columns: raw columns as in ``SceneModel``, in the frame of the box, without ``semantics``; colours of degree 0
            alone.
        class_ids: train id of every Gaussian, i64[n]; -1 = unknown.
        certainty: f32[n] in [0, 1] or None.
        label, size_m: of its box.
        light_rgb: mean light of the surfaces of its scene, linear, or None.
        seen_rad: from which sides it was recorded: angles from its front, counter-clockwise.
        origin: where it comes from, for people.
    """

    columns: Mapping[str, Tensor]
    class_ids: NDArray[np.int64]
    certainty: NDArray[np.float32] | None
    label: str
    size_m: tuple[float, float, float]
    light_rgb: tuple[float, float, float] | None
    seen_rad: tuple[float, ...]
    origin: str

    def __len__(self) -> int:
        return len(self.class_ids)


def asset_of(
    model: SceneModel,
    name: str,
    seen_rad: Sequence[float] = (),
    origin: str = "",
    light_rgb: NDArray[np.float64] | None = None,
) -> Asset:
    """An object of a fitted scene. What deforms is taken as it is in the middle of its track. UsageError: no such
    object."""
    node = model.dynamic_object(name)
    index = model.nodes.index(node)
    rows = (model.table.labels["node"] == index).nonzero()[:, 0]
    names = ("means", "quats", "log_scales", "logits", "sh_dc")
    columns = {key: model.table[key].detach()[rows].cpu() for key in names}
    if type(node) is not RigidNode:
        columns |= _shape_at_middle(model, node, rows)
    known = model.certainty
    size = (node.size_m[0], node.size_m[1], node.size_m[2])
    return Asset(
        columns,
        classes_of_rows(model)[rows.cpu().numpy()],
        None if known is None else known[rows].float().cpu().numpy(),
        node.label,
        size,
        None if light_rgb is None else (float(light_rgb[0]), float(light_rgb[1]), float(light_rgb[2])),
        tuple(float(a) for a in seen_rad),
        origin or f"{model.facts.get('scene', 'a scene')}: {name}",
    )


@torch.no_grad()
def _shape_at_middle(model: SceneModel, node: RigidNode, rows: Tensor) -> dict[str, Tensor]:
    """Places and rotations of an object's Gaussians in the middle of its track, in the frame of its box, on the CPU."""
    own = {name: value.detach()[rows] for name, value in model.table.columns.items()}
    time_s = float(node.times_s[len(node.times_s) // 2])
    further = {name: value for name, value in own.items() if name not in COLUMNS}
    given = NodeRows(own["means"], own["quats"], torch.sigmoid(own["logits"]), own["sh_dc"], further)
    now, pose = node.at_time(given, time_s), node.pose_matrix(time_s)
    if now is None or pose is None:
        return {}
    box_from_world = geometry.invert(pose)
    means = geometry.transform_points(box_from_world, now.means.cpu().numpy())
    turn = torch.from_numpy(geometry.quaternion_from_matrix(box_from_world)).float()
    return {"means": torch.from_numpy(means), "quats": now.quats.cpu() @ left_product_matrix(turn).T}


def matched_light(asset: Asset, there: NDArray[np.float64] | None) -> tuple[Asset, NDArray[np.float64]]:
    """The asset in the light of a scene (mean light f64[3] of its surfaces), and the gain f64[3] of its linear light
    (``light_gain``)."""
    gain = light_gain(None if asset.light_rgb is None else np.asarray(asset.light_rgb), there)
    return replace(asset, columns={**asset.columns, "sh_dc": relit(asset.columns["sh_dc"], gain)}), gain


def light_gain(here: NDArray[np.float64] | None, there: NDArray[np.float64] | None) -> NDArray[np.float64]:
    """Factor f64[3] from the light of one scene to that of another, in linear light.

    The surfaces of two streets are taken to reflect alike on the whole (the assumption of a grey world), so that the
    ratio of their mean light is that of illumination and exposure, but for what the streets are made of: hence the
    exponent, which is the slope of the true factor over the ratio, both as logarithms, for vehicles in 17 generated
    cities. Kept within 1/4 to 4; 1 where either is not known.

    Args:
        here, there: mean light of surfaces f64[3], linear.
    """
    if here is None or there is None:
        return np.ones(3)
    return ((there / np.maximum(here, 1e-4)) ** LIGHT_EXPONENT).clip(0.25, 4.0)


def relit(sh_dc: Tensor, gain: NDArray[np.float64]) -> Tensor:
    """Colours of degree 0 f32[n, 1, 3] with their linear light multiplied by a gain f64[3]; what is below black
    stays."""
    shown = 0.5 + SH_C0 * sh_dc.detach().cpu().double().numpy()
    lit = np.where(shown > 0, display_of(linear_of(shown) * gain), shown)
    return torch.from_numpy((lit - 0.5) / SH_C0).to(sh_dc)


def linear_of(display: NDArray[np.float64]) -> NDArray[np.float64]:
    """sRGB display values to linear light; negative values become 0."""
    v = np.maximum(display, 0.0)
    return np.where(v <= 0.04045, v / 12.92, ((v + 0.055) / 1.055) ** 2.4)


def display_of(linear: NDArray[np.float64]) -> NDArray[np.float64]:
    """Inverse of ``linear_of``."""
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * np.maximum(linear, 1e-9) ** (1 / 2.4) - 0.055)


def with_relit_objects(model: SceneModel, gain: NDArray[np.float64]) -> SceneModel:
    """A copy whose objects give off their linear light times a gain f64[3]; what their colours add with direction grows
    with them."""
    table, mine = model.table, model.table.labels["node"] > 0
    old = table["sh_dc"].detach()
    new = torch.where(mine[:, None, None], relit(old, gain), old)
    columns = {**{name: value.detach() for name, value in table.columns.items()}, "sh_dc": new}
    if "sh_rest" in columns:
        shown, rest = [(0.5 + SH_C0 * value).clamp(min=1 / 255) for value in (old, new)], columns["sh_rest"]
        columns["sh_rest"] = torch.where(mine[:, None, None], rest * (shown[1] / shown[0]), rest)
    return replace(model, table=Table(columns, dict(table.labels)), facts=dict(model.facts))


def with_asset(model: SceneModel, asset: Asset, name: str, motion: Motion, label: str = "") -> SceneModel:
    """A copy with an object more, on a path. UsageError: the scene has an object of that name."""
    if name in model.node_names():
        what, remedy = "there is an object of this name already", "give the inserted object another id"
        raise UsageError(what, got=name, remedy=remedy)
    table, count = model.table, len(asset)
    columns: dict[str, Tensor] = dict(asset.columns)
    if "semantics" in table.columns:
        channels = torch.full((count, len(model.classes)), ABSENT_LOGIT)
        for channel, train_id in enumerate(model.classes):
            channels[torch.from_numpy(asset.class_ids == train_id), channel] = -ABSENT_LOGIT
        columns["semantics"] = channels
    for column in table.columns:
        if column not in columns:  # harmonics of the view's direction, and what other kinds of node know
            columns[column] = torch.zeros(count, *table[column].shape[1:])
    labels = {"node": torch.full((count,), len(model.nodes), dtype=torch.int32)}
    for key, value in table.labels.items():
        if key == CERTAINTY:
            known = torch.zeros(count) if asset.certainty is None else torch.from_numpy(asset.certainty)
            labels[key] = known.to(value.dtype)
        elif key != "node":
            labels[key] = torch.zeros(count, *value.shape[1:], dtype=value.dtype)
    node = RigidNode(name, label or asset.label, asset.size_m, motion.times_s, motion.poses)
    return _with_rows(model, node.to(model.device), columns, labels)


def _with_rows(
    model: SceneModel, node: RigidNode, columns: Mapping[str, Tensor], labels: Mapping[str, Tensor]
) -> SceneModel:
    table, there = model.table, model.device
    grown = Table(
        {key: torch.cat([value.detach(), columns[key].to(there)]) for key, value in table.columns.items()},
        {key: torch.cat([value, labels[key].to(there)]) for key, value in table.labels.items()},
    )
    return replace(model, table=grown, nodes=(*model.nodes, node), facts=dict(model.facts))


# -- contact shadows -------------------------------------------------------------------------------


def with_shadow(model: SceneModel, name: str, strength: float, sun: NDArray[np.float64] | None = None) -> SceneModel:
    """A copy in which an object darkens the ground that it stands on.

    Under an overcast sky the ground below a box loses the share of light that the box covers. Black flat Gaussians at
    the bottom of the box, in its frame and so with it at all times, take away ``strength`` of the light below it, less
    towards the edge, which is as wide as `SHADOW_BLUR` of the box's height. Where the sun shines, so does the ground
    from which the box hides it. They carry no class and hardly any depth of their own.

    Args:
        strength: share of the (linear) light that is missing below the middle of the box.
        sun: direction f64[3] of the world towards the sun, above the ground; None = none. The shadow turns with the
            object: it is right for the heading in the middle of its path.
    """
    node = model.dynamic_object(name)
    index, (length, width, height) = model.nodes.index(node), node.size_m
    toward, middle = None, len(node.times_s) // 2
    if sun is not None:
        toward = node.corrected_keys(slice(middle, middle + 1))[0, :3, :3].T @ sun
    xy, share = _covered(np.array([length, width, height]), toward)
    spread = SHADOW_STEP_M
    # Overlapping Gaussians of opacity a on a grid of step s and spread s pass exp(-2 pi a) of the light, nearly.
    dark = 1 - (1 - strength) ** (1 / 2.2)  # in display values
    opacity = (-np.log(np.maximum(1 - dark * share, 1e-3)) / (2 * np.pi)).clip(1e-4, 0.95)
    count = len(xy)
    flat = np.column_stack([xy, np.full(count, -height / 2 + SHADOW_LIFT_M)]).astype(np.float32)
    columns = {name: torch.zeros(count, *value.shape[1:]) for name, value in model.table.columns.items()}
    columns["means"], columns["quats"][:, 0] = torch.from_numpy(flat), 1.0
    columns["log_scales"] = torch.log(torch.tensor([spread, spread, 0.01])).repeat(count, 1)
    columns["logits"] = torch.from_numpy(np.log(opacity / (1 - opacity))).float()
    columns["sh_dc"] += -0.5 / SH_C0
    labels = {key: torch.zeros(count, *value.shape[1:], dtype=value.dtype) for key, value in model.table.labels.items()}
    labels["node"] += index
    made = _with_rows(model, node, columns, labels)
    made = replace(made, nodes=model.nodes)
    made.sort_rows()
    return made


def _covered(
    size: NDArray[np.float64], sun: NDArray[np.float64] | None
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Places f64[n, 2] of the ground around a box, in its frame, and how much of their light it takes f64[n]; with the
    direction towards the sun there, the larger of what it takes of the sky's and of the sun's."""
    length, width, height = size
    blur = SHADOW_BLUR * height
    if sun is None:
        axes = [_centres(side) for side in (length, width)]
    else:
        reach = np.abs(sun[:2]) * height / sun[2]
        axes = [_centres(2 * side) for side in size[:2] / 2 + reach + blur]
    xy = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 2)
    edge = np.minimum(np.array([length, width]) / 2 - np.abs(xy) + blur, 2 * blur + 1e-6)
    share = (edge / (2 * blur + 1e-6)).clip(0, 1).prod(1)
    if sun is None:
        return xy, share
    around = [[0.0, 0], [1, 0], [-1, 0], [0, 1], [0, -1], [0.7, 0.7], [-0.7, 0.7], [0.7, -0.7], [-0.7, -0.7]]
    hidden = np.zeros(len(xy))
    beam = (sun / np.linalg.norm(sun))[None]
    for x, y in np.array(around) * blur:
        places = np.column_stack([xy + [x, y], np.full(len(xy), -height / 2)])
        poses = (geometry.from_rotation_translation(np.eye(3), -place) for place in places)
        hidden += [np.isfinite(met_box(beam, pose, size)[0]) for pose in poses]
    share = np.maximum(share, hidden / len(around))
    return xy[share > 0], share[share > 0]


def _centres(side_m: float) -> NDArray[np.float64]:
    """Places along one side of a box, `SHADOW_STEP_M` apart, centred."""
    count = max(2, int(np.ceil(side_m / SHADOW_STEP_M)) + 1)
    return (np.arange(count, dtype=np.float64) - (count - 1) / 2) * SHADOW_STEP_M
