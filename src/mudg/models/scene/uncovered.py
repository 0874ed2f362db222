"""The street where an object of the recording is gone: what nobody saw goes, its shadow is brightened, gaps of the ground are closed.

Five things, for the places at which the recording has the object's box:

* Gaussians of the background that views show only because the object is gone were never held against a photograph: they go. How much a
  view shows of a Gaussian is the sum of its blending weights, in pixels; `noted` keeps that of the scene as it was.
* A road user drove there, so nothing stands there: Gaussians of the background in the space that its box swept are no surfaces. Around
  it, those of road users are its own, which a box too small left over.
* The ground that it darkened becomes as bright as what lies around (`shadows.py`).
* The sky that only shows now continues the sky that was seen.
* Where the ground has gaps behind and below the box, flat Gaussians that continue the colours of the seen ground close it.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import KDTree

from mudg.base import geometry
from mudg.base.palette import DYNAMIC_IDS
from mudg.base.types import View
from mudg.core import native_ops
from mudg.core.beams import met_box
from mudg.core.edit import Motion
from mudg.core.raster.rasterize import RasterConfig, rasterize
from mudg.core.table import Table
from mudg.models.scene.edited import GROUND_CLASSES, SOLID_OPACITY, classes_of_rows
from mudg.models.scene.initial import SH_C0
from mudg.models.scene.model import CERTAINTY, SceneModel, compose
from mudg.models.scene.nodes import RigidNode
from mudg.models.scene.shadows import brightened, colors_of, continued
from mudg.models.scene.sky import SkyNode

Array = NDArray[np.float64]
Rows = NDArray[np.bool_]
SHOWN: Final = "shown"
"""Label column, f32[N]: what that recorded view shows of a Gaussian that shows most of it, in pixels of views `WEIGHED_PX` wide."""
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
"""Gaussians of road users this far beside the box are parts of the object, and so are static points this high above its bottom."""
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
FILL_OPACITY: Final = 0.95
BELOW_M: Final = 0.02
"""Made-up ground lies this far below the ground beside it, which so shows first."""


@dataclass(frozen=True, slots=True, eq=False)
class Hidden:
    """An object of the recording and the views of it.

    Args:
        size_m: of its box. motion: of its box. moves: whether it leaves its place. views: at whose times it is there.
    """

    size_m: tuple[float, float, float]
    motion: Motion
    moves: bool
    views: tuple[View, ...]

    @property
    def poses(self) -> Array:
        """world_from_box f64[V, 4, 4] at the times of the views."""
        found = [pose for view in self.views if (pose := self.motion.pose_at(view.time_s)) is not None]
        return np.array(found).reshape(-1, 4, 4)

    @property
    def stays(self) -> bool:
        """Whether it gets no farther than its own length, so that views show the ground about it with its shadow alone."""
        poses = self.poses
        return bool(np.linalg.norm(poses[:, :2, 3] - poses[0, :2, 3], axis=1).max() <= self.size_m[0])


def shown_by(
    model: SceneModel, view: View, raster: RasterConfig, absent: Collection[str] = ()
) -> tuple[torch.Tensor, torch.Tensor | None]:
    """What a view shows when some objects are absent: blending weights summed over pixels, of every Gaussian f32[N] and of every texel of
    the sky f32[Hs, 2 Hs] (None without one)."""
    nodes = [index for index, node in enumerate(model.nodes) if isinstance(node, RigidNode) and node.name in absent]
    there = ~torch.isin(model.table.labels["node"], torch.tensor(nodes, dtype=torch.int32, device=model.device))
    camera, width = view.camera, min(WEIGHED_PX, view.camera.width)
    small = view.resized(width, max(1, round(camera.height * width / camera.width)))
    with torch.no_grad():
        gaussians = compose(model, view.time_s, semantics=False)
    mark = torch.zeros(len(model.table), 1, device=model.device, requires_grad=True)
    drawn = rasterize(replace(gaussians, opacity=gaussians.opacity * there, extra=mark), small, raster)
    if drawn.extra is None:
        raise ValueError("the renderer returned no features")
    weights = torch.autograd.grad(drawn.extra.sum(), [mark])[0][:, 0]
    if model.sky is None:
        return weights, None
    blank = SkyNode(Table({"panorama": torch.zeros_like(model.sky.table["panorama"].detach())}))
    above = native_ops.over(torch.zeros_like(drawn.rgb).detach(), drawn.alpha.detach(), blank.coarse_picture(small))
    return weights, torch.autograd.grad(above[0].sum(), [blank.table["panorama"]])[0][0, 0]


def most_shown(
    model: SceneModel, views: Sequence[View], raster: RasterConfig, absent: Collection[str] = ()
) -> tuple[torch.Tensor, torch.Tensor | None]:
    """`shown_by`, of every Gaussian and texel by the view that shows most of it."""
    most = torch.zeros(len(model.table), device=model.device)
    above = None if model.sky is None else torch.zeros(model.sky.rows, 2 * model.sky.rows, device=model.device)
    for view in views:
        weights, texels = shown_by(model, view, raster, absent)
        most = torch.maximum(most, weights)
        above = above if above is None or texels is None else torch.maximum(above, texels)
    return most, above


def noted(model: SceneModel, views: Sequence[View], raster: RasterConfig) -> SceneModel:
    """The scene with a note of what views show of each Gaussian, and of each texel of the sky (`SHOWN`)."""
    most, above = most_shown(model, views, raster)
    columns = {name: value.detach() for name, value in model.table.columns.items()}
    sky = model.sky
    if sky is not None and above is not None:
        sky = SkyNode(Table({"panorama": sky.table["panorama"]}, {SHOWN: above[None]}))
    return replace(model, table=Table(columns, {**model.table.labels, SHOWN: most}), sky=sky, facts=dict(model.facts))


def without_traces(
    model: SceneModel, hidden: Mapping[str, Hidden], views: Sequence[View], raster: RasterConfig
) -> SceneModel:
    """A copy in which the street shows no traces of objects that are gone from their places, without the note.

    A background that changes with time, and a scene that knows no ground, stay as they are.

    Args:
        model: `noted` when all objects were there. Those that are gone from their places may still be in it.
        views: those of the note.
    """
    absent, gone = tuple(hidden), [one for one in hidden.values() if one.views]
    ground = _ground(model)
    if model.nodes[0].kind == "static" and gone and ground.sum() >= LEAST_GROUND:
        model, lost = _without_unseen(model, views, raster, absent)
        for one in gone:
            model = without_rows(model, _left_over(one, model))
        for one in gone:
            model = _shadow_gone(model, one)
        for one in gone:
            model = _closed(model, one, lost)
        model.sort_rows()
        model = replace(model, sky=_sky_continued(model, views, raster, absent), facts=dict(model.facts))
    labels = {name: value for name, value in model.table.labels.items() if name != SHOWN}
    columns = {name: value.detach() for name, value in model.table.columns.items()}
    sky = None if model.sky is None else SkyNode(Table({"panorama": model.sky.table["panorama"]}))
    return replace(model, table=Table(columns, labels), sky=sky, facts=dict(model.facts))


def _sky_continued(model: SceneModel, views: Sequence[View], raster: RasterConfig, absent: Collection[str]) -> SkyNode | None:
    """The sky with directions that only show because objects are absent in the colour of the nearest that was seen."""
    shows = most_shown(model, views, raster, absent)[1]
    if model.sky is None or shows is None:
        return model.sky
    shown = model.sky.table.labels[SHOWN][0]
    unknown, seen = shown < SEEN_SHARE * shows, shown > SKY_SHARE * shown.max()
    return model.sky.continued(unknown.cpu().numpy(), seen.cpu().numpy())


def _means(model: SceneModel) -> Array:
    return model.table["means"].detach().cpu().numpy().astype(np.float64)


def _still(model: SceneModel) -> Rows:
    return (model.table.labels["node"] == 0).cpu().numpy()


def _shown(model: SceneModel) -> Array:
    return model.table.labels[SHOWN].cpu().numpy().astype(np.float64)


def _ground(model: SceneModel) -> Rows:
    """Rows of the background that are ground."""
    return _still(model) & np.isin(classes_of_rows(model), GROUND_CLASSES)


def _solid(model: SceneModel) -> Rows:
    return torch.sigmoid(model.table["logits"].detach()).cpu().numpy() > SOLID_OPACITY


def without_rows(model: SceneModel, gone: Rows) -> SceneModel:
    """A copy without some rows, bool[N]."""
    kept = torch.from_numpy(np.flatnonzero(~gone)).to(model.device)
    columns = {name: value.detach()[kept] for name, value in model.table.columns.items()}
    return replace(model, table=Table(columns, {key: value[kept] for key, value in model.table.labels.items()}), facts=dict(model.facts))


def _without_unseen(
    model: SceneModel, views: Sequence[View], raster: RasterConfig, absent: Collection[str]
) -> tuple[SceneModel, Array]:
    """Without the Gaussians of the background that only show because objects are absent; and the places f64[L, 3] of the ground's."""
    lost = [np.zeros((0, 3))]
    for _ in range(ROUNDS):
        shows, shown = most_shown(model, views, raster, absent)[0], model.table.labels[SHOWN]
        unseen = ((model.table.labels["node"] == 0) & (shown < SEEN_SHARE * shows)).cpu().numpy()
        if not unseen.any():
            break
        lost.append(_means(model)[unseen & _ground(model)])
        model = without_rows(model, unseen)
    return model, np.concatenate(lost)


def _left_over(one: Hidden, model: SceneModel) -> Rows:
    """Rows of the background within the space that a moving box swept, above the ground, and of road users around the box."""
    means, half = _means(model), np.array(one.size_m) / 2
    users = np.isin(classes_of_rows(model), DYNAMIC_IDS)
    rows = np.flatnonzero(_still(model) & _near(one, means[:, :2], STRAY_M))
    inside = np.zeros(len(rows), bool)
    for pose in one.poses:
        local = geometry.transform_points(geometry.invert(pose), means[rows])
        high = local[:, 2] > FLOOR_M - half[2]
        if one.moves:
            inside |= (np.abs(local) <= half).all(1) & high
        inside |= (np.abs(local) <= half + STRAY_M).all(1) & users[rows]
    found = np.zeros(len(means), bool)
    found[rows[inside]] = True
    return found


def _near(one: Hidden, xy: Array, margin_m: float) -> Rows:
    """Which places may lie within a distance of one of an object's boxes."""
    reach, at = float(np.linalg.norm(one.size_m)) / 2 + margin_m, one.poses[:, :2, 3]
    return ((xy >= at.min(0) - reach) & (xy <= at.max(0) + reach)).all(1)


def _shadow_gone(model: SceneModel, one: Hidden) -> SceneModel:
    """Without its shadow on the ground, where it hardly moved; where it drove, views show the ground without it."""
    if not one.stays:
        return model
    ids, still = classes_of_rows(model), _still(model)
    ground = {number: still & (ids == number) for number in GROUND_CLASSES}
    return brightened(model, one.size_m, one.poses, ground, _shown(model))


def _hidden(one: Hidden, places: Array) -> Rows:
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
        hides[rows] = inside & (met_box(toward / distance[:, None], from_eye, np.array(one.size_m) + BOX_GROWTH_M) < distance)
    return hides


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
    return np.column_stack([xy, np.median(seen_ground[tree.query(xy, NEAREST)[1], 2], 1)]) if len(xy) else np.zeros((0, 3))


def _gaps(cells: Array, kept: Array, lost: Array) -> Rows:
    """Which cells have no ground near, or ground nearer that was lost than ground that was kept."""
    apart = KDTree(kept[:, :2]).query(cells[:, :2])[0]
    nearest_lost = KDTree(lost[:, :2]).query(cells[:, :2])[0] if len(lost) else np.full(len(cells), np.inf)
    return apart > np.minimum(nearest_lost, GAP_M)


def _closed(model: SceneModel, one: Hidden, lost: Array) -> SceneModel:
    """With flat Gaussians where the object hid ground and none is left."""
    ground = _ground(model)
    rows = np.flatnonzero(ground & _solid(model))
    means = _means(model)
    if len(rows) < LEAST_GROUND:
        return model
    cells = _cells_around(one, means[rows])
    cells = cells[_hidden(one, cells)]
    cells = cells[_gaps(cells, means[ground], lost)] if len(cells) else cells
    count, weights = len(cells), _shown(model)
    seen = np.flatnonzero(ground & (weights > 0))
    if not count or len(seen) < LEAST_GROUND:
        return model
    colors, near = continued(cells[:, :2], means[seen, :2], colors_of(model)[seen], weights[seen])
    changed = {
        "means": cells - [0, 0, BELOW_M], "quats": np.tile([1.0, 0, 0, 0], (count, 1)),
        "log_scales": np.tile(np.log([0.75 * CELL_M, 0.75 * CELL_M, 0.02]), (count, 1)),
        "logits": np.full(count, np.log(FILL_OPACITY / (1 - FILL_OPACITY))), "sh_dc": ((colors - 0.5) / SH_C0)[:, None],
    }  # fmt: skip
    return with_copies(model, seen[near], changed)


def with_copies(model: SceneModel, likeness: NDArray[np.int64], changed: Mapping[str, Array]) -> SceneModel:
    """With copies of some rows, appended, that differ from them in some columns; nobody saw what they show.

    Args:
        likeness: rows i64[M]. changed: columns f64[M, ...] by name.
    """
    rows = torch.from_numpy(likeness).to(model.device)
    columns = {name: value.detach()[rows].clone() for name, value in model.table.columns.items()}
    for name, values in changed.items():
        columns[name] = torch.from_numpy(values).to(columns[name])
    if "sh_rest" in columns:
        columns["sh_rest"] = torch.zeros_like(columns["sh_rest"])
    labels = {key: value[rows].clone() for key, value in model.table.labels.items()}
    for key in (CERTAINTY, SHOWN):
        if key in labels:
            labels[key] = torch.zeros_like(labels[key])
    made = Table(
        {name: torch.cat([value.detach(), columns[name]]) for name, value in model.table.columns.items()},
        {key: torch.cat([value, labels[key]]) for key, value in model.table.labels.items()},
    )
    return replace(model, table=made, facts=dict(model.facts))

