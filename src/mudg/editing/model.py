"""Edits of a fitted scene: its objects on other paths, taken away, put in, cut out of the background, with contact
shadows; and the street and the sides that only show because of it. Everything returns a changed copy and shares what
stays; how a path changes is the business of ``core/edit.py``."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
import torch
from numpy.typing import NDArray
from scipy import ndimage
from scipy.spatial import KDTree
from torch import Tensor

from mudg.base import geometry
from mudg.base.errors import InputError, UsageError
from mudg.base.palette import DYNAMIC_IDS, ID
from mudg.base.types import Track, View
from mudg.baselines.bezier import BezierNode
from mudg.baselines.omnire import DeformedNode
from mudg.core import harmonics, native_ops
from mudg.core.edit import Motion
from mudg.core.fusion import points_in_box
from mudg.core.harmonics import left_product_matrix
from mudg.core.lidar import met_box
from mudg.core.raster.rasterize import rasterize
from mudg.core.table import Table
from mudg.core.weather.light import LUMINANCE
from mudg.gaussians.model import CERTAINTY, COLUMNS, SceneModel, compose
from mudg.gaussians.nodes import SYMMETRIC_LABELS, NodeRows, RigidNode, SkyNode
from mudg.gaussians.rendering import raster_of
from mudg.gaussians.start import SH_C0
from mudg.gaussians.views import resized_view

Array = NDArray[np.float64]
Rows = NDArray[np.bool_]

GROUND_CLASSES: Final = tuple(ID[name] for name in ("road", "sidewalk", "terrain"))
CUT_MARGIN_M: Final = 0.1
"""A box that is cut out of the background takes what lies this far beside it, too."""
CUT_FLOOR_M: Final = 0.12
"""What lies this low above the bottom of a box belongs to the ground, unless its class says otherwise."""
LIGHT_EXPONENT: Final = 0.75
SOLID_OPACITY: Final = 0.3
ABSENT_LOGIT: Final = -10.0
"""Class logit of an inserted object for classes that only the other scene knows."""

# -- rows ------------------------------------------------------------------------------------------


def changed(
    model: SceneModel,
    columns: Mapping[str, Tensor] | None = None,
    labels: Mapping[str, Tensor] | None = None,
    **parts: Any,
) -> SceneModel:
    """A copy with some columns and labels of its table, and other parts, exchanged; without moments."""
    table = Table({**model.table.columns, **(columns or {})}, {**model.table.labels, **(labels or {})})
    return replace(model, table=table, facts=dict(model.facts), **parts)


def with_rows(
    model: SceneModel, columns: Mapping[str, Tensor], labels: Mapping[str, Tensor], **parts: Any
) -> SceneModel:
    """A copy with rows more, the last ones: all columns and labels of them."""
    joined = lambda own, new: {key: torch.cat([value.detach(), new[key].to(value)]) for key, value in own.items()}
    return changed(model, joined(model.table.columns, columns), joined(model.table.labels, labels), **parts)


def without_rows(model: SceneModel, gone: Rows) -> SceneModel:
    """A copy without some rows, bool[N]."""
    kept = torch.from_numpy(np.flatnonzero(~gone)).to(model.device)
    some = lambda own: {key: value.detach()[kept] for key, value in own.items()}
    return changed(model, some(model.table.columns), some(model.table.labels))


def zeros_like(own: Mapping[str, Tensor], count: int) -> dict[str, Tensor]:
    """So many rows of zeros for columns or labels."""
    return {key: torch.zeros(count, *value.shape[1:], dtype=value.dtype) for key, value in own.items()}


def means_of(model: SceneModel) -> Array:
    """Centres f64[N, 3] of all Gaussians, in the frames of their nodes."""
    return model.table["means"].detach().cpu().numpy().astype(np.float64)


def still_rows(model: SceneModel) -> Rows:
    """Rows of the background."""
    return (model.table.labels["node"] == 0).cpu().numpy()


def solid_rows(model: SceneModel) -> Rows:
    """Rows that are more opaque than `SOLID_OPACITY`."""
    return torch.sigmoid(model.table["logits"].detach()).cpu().numpy() > SOLID_OPACITY


def classes_of_rows(model: SceneModel) -> NDArray[np.int64]:
    """Train id of every Gaussian, i64[N]; -1 without classes."""
    if not model.classes:
        return np.full(len(model.table), -1)
    channel = model.table["semantics"].detach().argmax(1).cpu().numpy()
    return np.asarray(model.classes)[channel]


def ground_rows(model: SceneModel) -> Rows:
    """Rows of the background that are ground."""
    return still_rows(model) & np.isin(classes_of_rows(model), GROUND_CLASSES)


def ground_points(model: SceneModel) -> NDArray[np.float32]:
    """Centres f32[M, 3] of the solid Gaussians of the background that are ground."""
    return model.table["means"].detach().cpu().numpy()[ground_rows(model) & solid_rows(model)]


def lowest_points(model: SceneModel) -> NDArray[np.float32]:
    """Centres f32[M, 3] of the solid Gaussians of the background that are the lowest fifth of their square metre: the
    ground, where no class says what it is."""
    means = model.table["means"].detach().cpu().numpy()[still_rows(model) & solid_rows(model)]
    cells = np.floor(means[:, :2]).astype(np.int64)
    order = np.lexsort((means[:, 2], cells[:, 1], cells[:, 0]))
    _, begins, counts = np.unique(cells[order], axis=0, return_index=True, return_counts=True)
    rank = np.arange(len(order)) - np.repeat(begins, counts)
    return means[order[rank < np.repeat(np.ceil(counts / 5), counts)]]


def colors_of(model: SceneModel) -> Array:
    """Display values f64[N, 3] of every Gaussian, without what depends on the direction of view."""
    return 0.5 + SH_C0 * model.table["sh_dc"].detach().cpu().numpy()[:, 0].astype(np.float64)


def linear_of(display: Array) -> Array:
    """sRGB display values to linear light; negative values become 0."""
    v = np.maximum(display, 0.0)
    return np.where(v <= 0.04045, v / 12.92, ((v + 0.055) / 1.055) ** 2.4)


def display_of(linear: Array) -> Array:
    """Inverse of ``linear_of``."""
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * np.maximum(linear, 1e-9) ** (1 / 2.4) - 0.055)


# -- objects ---------------------------------------------------------------------------------------


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
    before = torch.from_numpy(np.floor(shown).astype(np.int64)).to(node.offsets.device)
    share = torch.from_numpy((shown - np.floor(shown)).astype(np.float32)).to(node.offsets.device)

    def at_keys(values: Tensor) -> Tensor:
        after = (before + 1).clamp(max=len(values) - 1)
        return torch.lerp(values[before], values[after], share.view(-1, *[1] * (values.dim() - 1)))

    columns = {key: at_keys(own.detach()) for key, own in node.offsets.columns.items() if key not in ("shift", "yaw")}
    zero = torch.zeros_like(share)
    offsets = Table({"shift": zero[:, None].repeat(1, 3), "yaw": zero, **columns})
    made = type(node)(node.name, node.label, node.size_m, motion.times_s, motion.poses, offsets, node.learn_pose)
    if isinstance(made, DeformedNode) and isinstance(node, DeformedNode):
        made.instance, made.field = node.instance, node.field
    return made


def cut_out(model: SceneModel, track: Track) -> SceneModel:
    """A copy in which what stands in a box of the background is an object of its own, which can be moved or taken away.
    ``track``: a box that stands; its middle pose counts. UsageError: nothing of the background lies in the box, or the
    background changes with time."""
    if model.nodes[0].kind != "static":
        what, where = "nothing can be cut out of a background that changes with time", f"track {track.id!r}"
        got = f"a background of kind {model.nodes[0].kind}"
        raise UsageError(what, where=where, expected="a fit of mudg_s or street_gaussians", got=got)
    pose, table, ids = track.world_from_object[len(track.times_s) // 2], model.table, classes_of_rows(model)
    local = geometry.transform_points(geometry.invert(pose), means_of(model))
    low = local[:, 2] < -track.size_m[2] / 2 + CUT_FLOOR_M
    inside = points_in_box(local, track.size_m, CUT_MARGIN_M, 0.0) & still_rows(model)
    inside &= ~np.isin(ids, GROUND_CLASSES) & ~(low & (ids < 0))
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
    made = changed(model, columns, {"node": owner}, nodes=(*model.nodes, node.to(model.device)))
    made.sort_rows()
    return made


@dataclass(frozen=True, slots=True, eq=False)
class Asset:
    """One object of a fitted scene by itself. ``columns``: raw ones as in ``SceneModel``, in the frame of the box,
    without ``semantics``; colours of degree 0 alone. ``class_ids``: train id of every Gaussian, i64[n]; -1 = unknown.
    ``certainty``: f32[n] in [0, 1] or None. ``label``, ``size_m``: of its box. ``light_rgb``: mean light f64[3] of the
    surfaces of its scene, linear, or None. ``seen_rad``: from which sides it was recorded: angles from its front,
    counter-clockwise. ``origin``: where it comes from, for people."""

    columns: Mapping[str, Tensor]
    class_ids: NDArray[np.int64]
    certainty: NDArray[np.float32] | None
    label: str
    size_m: tuple[float, float, float]
    light_rgb: Array | None
    seen_rad: tuple[float, ...]
    origin: str

    def __len__(self) -> int:
        return len(self.class_ids)


def asset_of(model: SceneModel, name: str, seen_rad: Sequence[float] = (), light_rgb: Array | None = None) -> Asset:
    """An object of a fitted scene. What deforms is taken as it is in the middle of its track. UsageError: no such
    object."""
    node = model.dynamic_object(name)
    rows = (model.table.labels["node"] == model.nodes.index(node)).nonzero()[:, 0]
    own = {key: value.detach()[rows] for key, value in model.table.columns.items()}
    columns = {key: own[key].cpu() for key in ("means", "quats", "log_scales", "logits", "sh_dc")}
    if type(node) is not RigidNode:
        time_s = float(node.times_s[len(node.times_s) // 2])
        further = {key: value for key, value in own.items() if key not in COLUMNS}
        given = NodeRows(own["means"], own["quats"], torch.sigmoid(own["logits"]), own["sh_dc"], further)
        with torch.no_grad():
            now, pose = node.at_time(given, time_s), node.pose_matrix(time_s)
        if now is not None and pose is not None:
            box_from_world = geometry.invert(pose)
            turn = torch.from_numpy(geometry.quaternion_from_matrix(box_from_world)).float()
            columns["means"] = torch.from_numpy(geometry.transform_points(box_from_world, now.means.cpu().numpy()))
            columns["quats"] = now.quats.cpu() @ left_product_matrix(turn).T
    known, (length, width, height) = model.certainty, node.size_m
    return Asset(
        columns,
        classes_of_rows(model)[rows.cpu().numpy()],
        None if known is None else known[rows].float().cpu().numpy(),
        node.label,
        (length, width, height),
        light_rgb,
        tuple(float(a) for a in seen_rad),
        f"{model.facts.get('scene', 'a scene')}: {name}",
    )


def with_asset(model: SceneModel, asset: Asset, name: str, motion: Motion, label: str = "") -> SceneModel:
    """A copy with an object more, on a path. UsageError: the scene has an object of that name."""
    if name in model.node_names():
        what, remedy = "there is an object of this name already", "give the inserted object another id"
        raise UsageError(what, got=name, remedy=remedy)
    count = len(asset)
    # harmonics of the view's direction, and what other kinds of node know, are zero
    columns, labels = (zeros_like(own, count) for own in (model.table.columns, model.table.labels))
    columns |= asset.columns
    if "semantics" in columns:
        channels = torch.full((count, len(model.classes)), ABSENT_LOGIT)
        for channel, train_id in enumerate(model.classes):
            channels[torch.from_numpy(asset.class_ids == train_id), channel] = -ABSENT_LOGIT
        columns["semantics"] = channels
    labels["node"] += len(model.nodes)
    if CERTAINTY in labels and asset.certainty is not None:
        labels[CERTAINTY] = torch.from_numpy(asset.certainty).to(labels[CERTAINTY])
    node = RigidNode(name, label or asset.label, asset.size_m, motion.times_s, motion.poses)
    return with_rows(model, columns, labels, nodes=(*model.nodes, node.to(model.device)))


def matched_light(asset: Asset, there: Array | None) -> Asset:
    """The asset in the light of a scene, of whose surfaces ``there`` f64[3] is the mean light (``light_gain``)."""
    gain = light_gain(asset.light_rgb, there)
    shown = 0.5 + SH_C0 * asset.columns["sh_dc"].double().numpy()
    lit = np.where(shown > 0, display_of(linear_of(shown) * gain), shown)  # what is below black stays
    relit = torch.from_numpy((lit - 0.5) / SH_C0).to(asset.columns["sh_dc"])
    return replace(asset, columns={**asset.columns, "sh_dc": relit})


def light_gain(here: Array | None, there: Array | None) -> Array:
    """Factor f64[3] from the light of one scene to that of another, in linear light.

    The surfaces of two streets are taken to reflect alike on the whole (the assumption of a grey world), so that the
    ratio of their mean light is that of illumination and exposure, but for what the streets are made of: hence the
    exponent, which is the slope of the true factor over the ratio, both as logarithms, for vehicles in 17 generated
    cities. Kept within 1/4 to 4; 1 where either is not known. ``here``, ``there``: mean light of surfaces f64[3],
    linear."""
    if here is None or there is None:
        return np.ones(3)
    return ((there / np.maximum(here, 1e-4)) ** LIGHT_EXPONENT).clip(0.25, 4.0)


# -- contact shadows -------------------------------------------------------------------------------

SHADOW_STEP_M: Final = 0.35
SHADOW_LIFT_M: Final = 0.04
SHADOW_BLUR: Final = 0.15
"""Width of a contact shadow's edge, as a share of the height of what casts it."""


def with_shadow(model: SceneModel, name: str, strength: float) -> SceneModel:
    """A copy in which an object darkens the ground that it stands on.

    Under an overcast sky the ground below a box loses the share of light that the box covers. Black flat Gaussians at
    the bottom of the box, in its frame and so with it at all times, take away ``strength`` of the light below it, less
    towards the edge, which is as wide as `SHADOW_BLUR` of the box's height. They carry no class and hardly any depth of
    their own. ``strength``: share of the (linear) light that is missing below the middle of the box."""
    node = model.dynamic_object(name)
    size = np.array(node.size_m)
    counts, blur = np.maximum(2, np.ceil(size[:2] / SHADOW_STEP_M).astype(int) + 1), SHADOW_BLUR * size[2]
    axes = [(np.arange(count, dtype=np.float64) - (count - 1) / 2) * SHADOW_STEP_M for count in counts]
    xy = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 2)
    edge = np.minimum(size[:2] / 2 - np.abs(xy) + blur, 2 * blur + 1e-6)
    share = (edge / (2 * blur + 1e-6)).clip(0, 1).prod(1)
    # Overlapping Gaussians of opacity a on a grid of step s and spread s pass exp(-2 pi a) of the light, nearly.
    dark = 1 - (1 - strength) ** (1 / 2.2)  # in display values
    opacity = (-np.log(np.maximum(1 - dark * share, 1e-3)) / (2 * np.pi)).clip(1e-4, 0.95)
    count = len(xy)
    columns, labels = (zeros_like(own, count) for own in (model.table.columns, model.table.labels))
    flat = np.column_stack([xy, np.full(count, SHADOW_LIFT_M - size[2] / 2)]).astype(np.float32)
    columns["means"], columns["quats"][:, 0] = torch.from_numpy(flat), 1.0
    columns["log_scales"] = torch.log(torch.tensor([SHADOW_STEP_M, SHADOW_STEP_M, 0.01])).repeat(count, 1)
    columns["logits"] = torch.from_numpy(np.log(opacity / (1 - opacity))).float()
    columns["sh_dc"] += -0.5 / SH_C0
    labels["node"] += model.nodes.index(node)
    made = with_rows(model, columns, labels)
    made.sort_rows()
    return made


# -- the street where an object of the recording is gone --------------------------------------------
#
# Five things, for the places at which the recording has the object's box:
#
# * Gaussians of the background that views show only because the object is gone were never held against a photograph:
#   they go. How much a view shows of a Gaussian is the sum of its blending weights, in pixels; `noted` keeps that of
#   the scene as it was.
# * A road user drove there, so nothing stands there: Gaussians of the background in the space that its box swept are no
#   surfaces. Around it, those of road users are its own, which a box too small left over.
# * The ground that it darkened becomes as bright as what lies around. On a grid of the ground, a cell is dark that has
#   clearly less light than lit ground of its class about it. Dark cells are the object's shadow if they lie behind it
#   in one direction, that of the light, with no lit cell between. They get the colours of the lit ground around,
#   continued, and keep a little of their texture.
# * The sky that only shows now continues the sky that was seen.
# * Gaps of the ground behind and below the box are closed by flat Gaussians that continue the colours of seen ground.

SHOWN: Final = "shown"
"""Label column, f32[N]: what that recorded view shows of a Gaussian that shows most of it, in pixels of views
`WEIGHED_PX` wide."""
WEIGHED_PX: Final = 320
MOST_VIEWS: Final = 96
SEEN_SHARE: Final = 0.15
"""A Gaussian was not seen if no view showed this share of what one shows of it now that the object is gone."""
SKY_SHARE: Final = 0.25
"""The sky is continued from texels of which a view shows this share of what one shows of the one that is seen best."""
ROUNDS: Final = 4
"""What goes may have hidden more that nobody saw."""
FLOOR_M: Final = 0.15
STRAY_M: Final = 0.4
"""Gaussians of road users this far beside the box are parts of the object, and so are static points this high above its
bottom."""
LEAST_GROUND: Final = 48
CELL_M: Final = 0.3
BEHIND_M: Final = 80.0
BESIDE_M: Final = 6.0
"""How far behind an object, and beside it, hidden ground is closed."""
BOX_GROWTH_M: Final = 0.3
KNOWN_WITHIN_M: Final = 8.0
"""Ground is taken to go on this far from ground that was seen."""
NEAREST: Final = 32
GAP_M: Final = 0.6
"""Ground that has no Gaussian within this distance has a gap."""
MADE_OPACITY: Final = 0.95
"""Of ground and sides that are made up."""
BELOW_M: Final = 0.02
"""Made-up ground lies this far below the ground beside it, which so shows first."""


@dataclass(frozen=True, slots=True, eq=False)
class Hidden:
    """An object of the recording and the views of it. ``size_m``, ``motion``: of its box. ``moves``: whether it leaves
    its place. ``views``: at whose times it is there."""

    size_m: tuple[float, float, float]
    motion: Motion
    moves: bool
    views: tuple[View, ...]

    @property
    def poses(self) -> Array:
        """world_from_box f64[V, 4, 4] at the times of the views."""
        found = [pose for view in self.views if (pose := self.motion.pose_at(view.time_s)) is not None]
        return np.array(found).reshape(-1, 4, 4)


def most_shown(model: SceneModel, views: Sequence[View], absent: Collection[str] = ()) -> tuple[Tensor, Tensor | None]:
    """What the view that shows most of it shows of every Gaussian f32[N], and of every texel of the sky f32[Hs, 2 Hs]
    (None without one), when some objects are absent: blending weights summed over pixels."""
    nodes = [index for index, node in enumerate(model.nodes) if isinstance(node, RigidNode) and node.name in absent]
    there = ~torch.isin(model.table.labels["node"], torch.tensor(nodes, dtype=torch.int32, device=model.device))
    most = torch.zeros(len(model.table), device=model.device)
    above = None if model.sky is None else torch.zeros(model.sky.rows, 2 * model.sky.rows, device=model.device)
    for view in views:
        small = resized_view(view, min(WEIGHED_PX, view.camera.width))
        with torch.no_grad():
            gaussians = compose(model, view.time_s, semantics=False)
        mark = torch.zeros(len(model.table), 1, device=model.device, requires_grad=True)
        drawn = rasterize(replace(gaussians, opacity=gaussians.opacity * there, extra=mark), small, raster_of(model))
        if drawn.extra is None:
            raise ValueError("the renderer returned no features")
        most = torch.maximum(most, torch.autograd.grad(drawn.extra.sum(), [mark])[0][:, 0])
        if model.sky is not None and above is not None:
            blank = SkyNode(Table({"panorama": torch.zeros_like(model.sky.table["panorama"].detach())}))
            black = torch.zeros_like(drawn.rgb).detach()
            over = native_ops.over(black, drawn.alpha.detach(), blank.coarse_picture(small))
            above = torch.maximum(above, torch.autograd.grad(over[0].sum(), [blank.table["panorama"]])[0][0, 0])
    return most, above


def noted(model: SceneModel, views: Sequence[View]) -> SceneModel:
    """The scene with a note of what views show of each Gaussian, and of each texel of the sky (`SHOWN`)."""
    (most, above), sky = most_shown(model, views), model.sky
    if sky is not None and above is not None:
        sky = SkyNode(Table({"panorama": sky.table["panorama"]}, {SHOWN: above[None]}))
    return changed(model, labels={SHOWN: most}, sky=sky)


def without_traces(model: SceneModel, hidden: Mapping[str, Hidden], views: Sequence[View]) -> SceneModel:
    """A copy in which the street shows no traces of objects that are gone from their places, without the note.

    A background that changes with time, and a scene that knows no ground, stay as they are. ``model``: `noted` when all
    objects were there. Those that are gone from their places may still be in it. ``views``: those of the note."""
    absent, gone = tuple(hidden), [one for one in hidden.values() if one.views]
    sky = model.sky
    if model.nodes[0].kind == "static" and gone and ground_rows(model).sum() >= LEAST_GROUND:
        lost = [np.zeros((0, 3))]  # places of the ground that only shows because objects are absent
        for _ in range(ROUNDS):
            shows, shown = most_shown(model, views, absent)[0], model.table.labels[SHOWN]
            unseen = ((model.table.labels["node"] == 0) & (shown < SEEN_SHARE * shows)).cpu().numpy()
            if not unseen.any():
                break
            lost.append(means_of(model)[unseen & ground_rows(model)])
            model = without_rows(model, unseen)
        for one in gone:
            model = without_rows(model, _left_over(one, model))
        for one in gone:
            model = _brightened(model, one)
        for one in gone:
            model = _closed(model, one, np.concatenate(lost))
        model.sort_rows()
        shows = most_shown(model, views, absent)[1]
        if sky is not None and shows is not None:  # its new directions take the colour of the nearest that was seen
            shown = sky.table.labels[SHOWN][0]
            unknown, seen = shown < SEEN_SHARE * shows, shown > SKY_SHARE * shown.max()
            sky = sky.continued(unknown.cpu().numpy(), seen.cpu().numpy())
    labels = {name: value for name, value in model.table.labels.items() if name != SHOWN}
    sky = None if sky is None else SkyNode(Table({"panorama": sky.table["panorama"]}))
    return replace(model, table=Table(model.table.columns, labels), sky=sky, facts=dict(model.facts))


def _left_over(one: Hidden, model: SceneModel) -> Rows:
    """Rows of the background within the space that a moving box swept, above the ground, and of road users around the
    box."""
    means, poses = means_of(model), one.poses
    users = np.isin(classes_of_rows(model), DYNAMIC_IDS)
    reach, at = float(np.linalg.norm(one.size_m)) / 2 + STRAY_M, poses[:, :2, 3]
    near = ((means[:, :2] >= at.min(0) - reach) & (means[:, :2] <= at.max(0) + reach)).all(1)
    rows = np.flatnonzero(still_rows(model) & near)
    inside = np.zeros(len(rows), bool)
    for pose in poses:
        local = geometry.transform_points(geometry.invert(pose), means[rows])
        if one.moves:
            inside |= points_in_box(local, one.size_m, 0.0, FLOOR_M)
        inside |= points_in_box(local, one.size_m, STRAY_M, -STRAY_M) & users[rows]
    found = np.zeros(len(means), bool)
    found[rows[inside]] = True
    return found


def _closed(model: SceneModel, one: Hidden, lost: Array) -> SceneModel:
    """With flat Gaussians where the object hid ground and none is left."""
    ground, means, weights = ground_rows(model), means_of(model), model.table.labels[SHOWN].cpu().numpy().astype(float)
    rows, seen = np.flatnonzero(ground & solid_rows(model)), np.flatnonzero(ground & (weights > 0))
    if min(len(rows), len(seen)) < LEAST_GROUND:
        return model
    cells = _cells_around(one, means[rows])
    cells = cells[_hides(one, cells)]
    if not len(cells):
        return model
    # no ground near, or ground nearer that was lost than ground that was kept
    apart = KDTree(means[ground, :2]).query(cells[:, :2])[0]
    to_lost = KDTree(lost[:, :2]).query(cells[:, :2])[0] if len(lost) else np.full(len(cells), np.inf)
    cells = cells[apart > np.minimum(to_lost, GAP_M)]
    if not len(cells):
        return model
    colors, near = continued(cells[:, :2], means[seen, :2], colors_of(model)[seen], weights[seen])
    return _with_flat(model, seen[near], cells - [0, 0, BELOW_M], [0.75 * CELL_M, 0.75 * CELL_M, 0.02], colors)


def _cells_around(one: Hidden, seen_ground: Array) -> Array:
    """Places f64[C, 3] on a grid of the ground behind and below an object, where ground was seen near."""
    at = one.poses[:, :2, 3]
    away = at - np.array([view.center_world[:2] for view in one.views])
    away /= np.maximum(np.linalg.norm(away, axis=1, keepdims=True), 1e-6)
    ends = np.concatenate([at, at + away * BEHIND_M])
    low, high = ends.min(0) - BESIDE_M, ends.max(0) + BESIDE_M
    axes = [np.arange(a, b, CELL_M) for a, b in zip(low, high, strict=True)]
    xy = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 2)
    tree = KDTree(seen_ground[:, :2])
    xy = xy[tree.query(xy)[0] < KNOWN_WITHIN_M]
    if not len(xy):
        return np.zeros((0, 3))
    return np.column_stack([xy, np.median(seen_ground[tree.query(xy, NEAREST)[1], 2], 1)])


def _hides(one: Hidden, places: Array) -> Rows:
    """Which places f64[N, 3] the object's box hides in some view."""
    hides = np.zeros(len(places), bool)
    for view, pose in zip(one.views, one.poses, strict=True):
        rows = np.flatnonzero(~hides)
        camera, local = view.camera, geometry.transform_points(view.cam_from_world, places[rows])
        half = np.array([camera.width / (2 * camera.fx), camera.height / (2 * camera.fy)])
        inside = (local[:, 2] > 0.5) & (np.abs(local[:, :2]) <= half * np.maximum(local[:, 2:], 1e-6)).all(1)
        toward = places[rows] - view.center_world
        distance = np.maximum(np.linalg.norm(toward, axis=1), 1e-6)
        from_eye = pose.copy()
        from_eye[:3, 3] -= view.center_world
        met = met_box(toward / distance[:, None], from_eye, np.array(one.size_m) + BOX_GROWTH_M)
        hides[rows] = inside & (met < distance)
    return hides


def _with_flat(
    model: SceneModel, likeness: NDArray[np.int64], places: Array, scales_m: Sequence[float], colors: Array
) -> SceneModel:
    """With rows more, the last ones: flat Gaussians at places f64[M, 3], not turned, of colours f64[M, 3], in all else
    like the rows ``likeness`` i64[M]. Nobody saw what they show."""
    rows, count = torch.from_numpy(likeness).to(model.device), len(places)
    columns, labels = (
        {key: own.detach()[rows].clone() for key, own in of.items()} for of in (model.table.columns, model.table.labels)
    )
    made = {
        "means": places,
        "quats": np.tile([1.0, 0, 0, 0], (count, 1)),
        "log_scales": np.tile(np.log(scales_m), (count, 1)),
        "logits": np.full(count, np.log(MADE_OPACITY / (1 - MADE_OPACITY))),
        "sh_dc": ((colors - 0.5) / SH_C0)[:, None],
    }
    columns |= {name: torch.from_numpy(values).to(columns[name]) for name, values in made.items()}
    for own, name in ((columns, "sh_rest"), (labels, CERTAINTY), (labels, SHOWN)):
        if name in own:
            own[name] = torch.zeros_like(own[name])
    return with_rows(model, columns, labels)


# -- recorded shadows ------------------------------------------------------------------------------

SHADOW_CELL_M: Final = 0.25
REACH: Final = 2.0
"""How far from the box its shadow is looked for, as a share of its height."""
DIRECTIONS: Final = 24
AROUND_M: Final = 2.5
LIT_QUANTILE: Final = 0.7
"""Of the ground around, this share is at most as bright as lit ground is."""
DARK: Final = 0.65
"""A cell in shadow has less than this share of the light of lit ground within `AROUND_M`."""
EDGE_CELLS: Final = 2
TEXTURE: Final = 1.3
"""Within a shadow, a Gaussian becomes at most this much brighter or darker than those around it."""
LEAST_ROWS: Final = 24
LEAST_PX: Final = 0.05
"""A cell of which views show less than this is not known."""
SOURCE_M: Final = 0.6
"""Colours are continued from cells of this side,"""
SOURCES: Final = 160
"""from this many of them,"""
BRIGHT: Final = 1.25
"""but not from those that are brighter than the `AROUND` about them by this factor, which are markings, nor from
shadows."""
AROUND: Final = 40


def continued(xy: Array, places: Array, colors: Array, weights: Array) -> tuple[Array, NDArray[np.int64]]:
    """Colours f64[C, 3] of ground continued smoothly to other places ``xy`` f64[C, 2], and the nearest known place
    i64[C] of each. ``places`` f64[M, 2], ``colors`` f64[M, 3]: of the ground that is known. ``weights``: how much of it
    is seen, f64[M]."""
    _, owner = np.unique(np.floor(places / SOURCE_M).astype(np.int64), axis=0, return_inverse=True)
    owner = owner.ravel()
    total = np.bincount(owner, weights)
    means = lambda values: np.column_stack([np.bincount(owner, weights * column) / total for column in values.T])
    centres, middles = means(places), means(colors)
    bright = middles @ LUMINANCE
    near = KDTree(centres).query(centres, min(AROUND, len(centres)))[1].reshape(len(centres), -1)
    usual, lit = np.quantile(bright[near], [0.5, LIT_QUANTILE], axis=1)
    plain = (bright <= BRIGHT * np.maximum(usual, lit / BRIGHT)) & (bright >= lit / BRIGHT)
    plain |= not plain.any()
    centres, middles = centres[plain], middles[plain]
    apart, near = KDTree(centres).query(xy, min(SOURCES, len(centres)))
    apart, near = apart.reshape(len(xy), -1), near.reshape(len(xy), -1)
    weight = 1 / (apart**2 + SOURCE_M**2) ** 1.5
    found = (weight[..., None] * middles[near]).sum(1) / weight.sum(1)[:, None]
    return found, np.asarray(KDTree(places).query(xy)[1], np.int64)


def shaded_cells(light: Array, below: Rows, reach_m: float) -> Rows:
    """Cells bool[X, Y] of the shadow of what stood on some: those darker than lit ground about them that lie behind it,
    and behind each other, in one direction: the one in which there are most. ``light``: luminance f64[X, Y] in linear
    light, NaN = not known. ``below``: where it stood, bool[X, Y]."""

    def upper(values: Array) -> float:
        values = values[np.isfinite(values)]
        return float(np.quantile(values, LIT_QUANTILE)) if len(values) else np.nan

    known = np.isfinite(light)
    size = 2 * round(AROUND_M / SHADOW_CELL_M) + 1
    lit = ndimage.generic_filter(np.where(known, light, np.nan), upper, size=size, mode="constant", cval=np.nan)
    dark = known & (light < DARK * lit)
    best = below & dark
    for angle in np.arange(DIRECTIONS) * 2 * np.pi / DIRECTIONS:
        away = np.array([np.cos(angle), np.sin(angle)])
        found, front = below & dark, below
        for step in range(1, round(reach_m / SHADOW_CELL_M) + 1):
            by = np.round(away * step).astype(int) - np.round(away * (step - 1)).astype(int)
            front = np.roll(front, by, (0, 1)) & (dark | below)  # the border is farther away than any shadow reaches
            found = found | (front & dark)
        best = found if found.sum() > best.sum() else best
    return best


def _brightened(model: SceneModel, one: Hidden) -> SceneModel:
    """Without the shadow of an object on the ground, if it got no farther than its own length; where it drove, views
    show the ground without it."""
    poses, size_m = one.poses, one.size_m
    if np.linalg.norm(poses[:, :2, 3] - poses[0, :2, 3], axis=1).max() > size_m[0]:
        return model
    means, shown, ids = means_of(model)[:, :2], colors_of(model), classes_of_rows(model)
    weights, luminance = model.table.labels[SHOWN].cpu().numpy().astype(np.float64), linear_of(shown) @ LUMINANCE
    reach = REACH * size_m[2]
    around = reach + AROUND_M + float(np.linalg.norm(size_m[:2])) / 2
    low = np.floor((poses[:, :2, 3].min(0) - around) / SHADOW_CELL_M) * SHADOW_CELL_M
    shape = tuple(np.ceil((poses[:, :2, 3].max(0) + around - low) / SHADOW_CELL_M).astype(int))
    below = _below(size_m, poses, low, shape)
    index = np.floor((means - low) / SHADOW_CELL_M).astype(np.int64)
    here = still_rows(model) & ((index >= 0) & (index < shape)).all(1)
    cell = np.ravel_multi_index(tuple(index.T), shape, mode="clip")
    colors = model.table["sh_dc"].detach().clone()
    for number in GROUND_CLASSES:
        rows = here & (ids == number)
        near = rows & (weights > 0)
        if near.sum() < LEAST_ROWS:
            continue
        sums = [np.bincount(cell[near], values[near], below.size) for values in (weights, weights * luminance)]
        total, seen = (ndimage.gaussian_filter(values.reshape(shape), 0.7, truncate=2.0) for values in sums)
        light = np.where(total > LEAST_PX, seen / np.maximum(total, 1e-12), np.nan)
        wide = np.asarray(ndimage.binary_dilation(shaded_cells(light, below, reach), iterations=EDGE_CELLS), np.bool_)
        shaded, lit = np.flatnonzero(rows & wide.ravel()[cell]), near & ~(wide | below).ravel()[cell]
        if not len(shaded) or lit.sum() < LEAST_ROWS:
            continue
        target = linear_of(continued(means[shaded], means[lit], shown[lit], weights[lit])[0])
        usual = light.ravel()[cell[shaded]]
        usual = np.where(np.isfinite(usual), usual, luminance[shaded])  # what no view shows has no texture
        texture = (luminance[shaded] / np.maximum(usual, 1e-4)).clip(1 / TEXTURE, TEXTURE)
        darker = luminance[shaded] < target @ LUMINANCE / TEXTURE
        values = ((display_of(target * texture[:, None]) - 0.5) / SH_C0)[darker]
        colors[torch.from_numpy(shaded[darker]).to(model.device), 0] = torch.from_numpy(values).to(colors)
    return changed(model, {"sh_dc": colors})


def _below(size_m: Sequence[float], poses: Array, low: Array, shape: tuple[int, ...]) -> Rows:
    """Cells bool[X, Y] of `SHADOW_CELL_M` below boxes; ``low``: the place f64[2] of their first corner."""
    cells = np.stack(np.indices(shape), -1).reshape(-1, 2)
    centres, half = low + (cells + 0.5) * SHADOW_CELL_M, np.array(size_m[:2]) / 2
    found = np.zeros(len(centres), bool)
    for pose in poses:
        yaw = geometry.yaw_of(pose)
        turn = np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
        found |= (np.abs((centres - pose[:2, 3]) @ turn) <= half).all(1)
    return found.reshape(shape)


# -- sides -----------------------------------------------------------------------------------------
#
# Who follows a car records its rear. Turned, or seen from another lane, its flanks are holes through which the street
# shows. So the two flanks of a vehicle are covered with flat Gaussians wherever it has none: as far out as it reaches
# at that height, in the colours that it, or its mirror image, has at that height. What recorded views would show of
# them is taken away again: there the recording knows better.

CLOSED_LABELS: Final = SYMMETRIC_LABELS - {"motorcycle"}
CABIN_LABELS: Final = frozenset({"car", "vehicle"})
"""Labels of vehicles whose upper part is shorter than the lower: the others are boxes."""
CABIN_FROM: Final = 0.55
"""The upper part begins at this share of the height."""
STEP_M: Final = 0.12
SPREAD: Final = 0.6
"""Standard deviation of a Gaussian, in steps."""
SIDE_FLOOR_M: Final = 0.2
"""So far up a vehicle is open to the road."""
SIDE_GAP_M: Final = 0.25
"""A side has a gap where no Gaussian is within this distance."""
SIDE_AROUND_M: Final = 0.1
SAME_HEIGHT_M: Final = 0.15
INSET_M: Final = 0.05
WIDTH_QUANTILE: Final = 0.9
SIDE_LEAST_ROWS: Final = 8
LIKE: Final = 32
"""A colour is the median of those of this many Gaussians, the nearest,"""
ALIKE: Final = (0.3, 0.3, 3.0)
"""where a metre along, across and up counts so much."""
SHOWN_PX: Final = 0.01
"""What a recorded view shows more of than this is not hidden."""


def with_closed_sides(model: SceneModel, names: Collection[str], views: Sequence[View]) -> SceneModel:
    """A copy in which some vehicles have flanks where the recording showed none; other objects stay as they are.
    ``model``: with the objects on their recorded paths. ``names``: of objects. ``views``: recorded ones, from which
    nothing new is to be seen."""
    first = len(model.table)
    for name in names:
        node = model.dynamic_object(name)
        if type(node) is RigidNode and node.label in CLOSED_LABELS:
            model = _with_flanks(model, node)
    if len(model.table) == first:
        return model
    order, ordered = torch.argsort(model.table.labels["node"], stable=True), changed(model)
    ordered.sort_rows()  # as the renderer wants them
    shown = torch.zeros(len(order), device=model.device)
    shown[order] = most_shown(ordered, views)[0]
    seen = (torch.arange(len(order), device=model.device) >= first) & (shown > SHOWN_PX)
    model = without_rows(model, seen.cpu().numpy())
    model.sort_rows()
    return model


def _with_flanks(model: SceneModel, node: RigidNode) -> SceneModel:
    """With rows more, the last ones, where the flanks of a vehicle have gaps."""
    half = np.array(node.size_m) / 2
    own = (model.table.labels["node"] == model.nodes.index(node)).cpu().numpy() & solid_rows(model)
    own &= ~np.isin(classes_of_rows(model), GROUND_CLASSES)
    own &= points_in_box(means_of(model), node.size_m, SIDE_AROUND_M, -SIDE_AROUND_M)
    if own.sum() < SIDE_LEAST_ROWS:
        return model
    rows, places = np.flatnonzero(own), means_of(model)[own]
    flanks = _flanks(places, half, node.label in CABIN_LABELS)
    flanks = flanks[KDTree(places).query(flanks)[0] > SIDE_GAP_M] if len(flanks) else flanks
    if not len(flanks):
        return model
    both = np.concatenate([places, places * [1, -1, 1]]) * ALIKE
    near = KDTree(both).query(flanks * ALIKE, min(LIKE, len(both)))[1] % len(rows)
    colors = np.median(colors_of(model)[rows][near], 1)
    return _with_flat(model, rows[near[:, 0]], flanks, [SPREAD * STEP_M, 0.02, SPREAD * STEP_M], colors)


def _flanks(places: Array, half: Array, cabin: bool) -> Array:
    """Places f64[M, 3] on a grid over both flanks of a vehicle, in the frame of its box. ``places``: f64[N, 3] of its
    Gaussians, which say how wide it is at each height. ``half``: of the size of its box. ``cabin``: a car, of the usual
    shape; else a box."""
    found = [np.zeros((0, 3))]
    for z in np.arange(SIDE_FLOOR_M + STEP_M / 2, 2 * half[2] - 0.02, STEP_M) - half[2]:
        level = np.abs(places[np.abs(places[:, 2] - z) < SAME_HEIGHT_M, 1])
        wide = float(np.quantile(level, WIDTH_QUANTILE)) if len(level) > SIDE_LEAST_ROWS else 0.9 * half[1]
        up = (z / half[2] + 1) / 2 - CABIN_FROM
        rear, front = -half[0], half[0]
        if cabin and up >= 0:
            rear, front = half[0] * (0.5 * up - 0.8), half[0] * (0.4 - 0.7 * up)
        along = np.arange(rear + STEP_M / 2, front, STEP_M)
        side = np.full(len(along), min(wide, half[1]) - INSET_M)
        found += [np.column_stack([along, sign * side, np.full(len(along), z)]) for sign in (-1, 1)]
    return np.concatenate(found)
