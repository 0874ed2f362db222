"""The street where an object of the recording is gone: what nobody saw goes, its shadow is brightened, gaps of the
ground are closed.

Five things, for the places at which the recording has the object's box:

* Gaussians of the background that views show only because the object is gone were never held against a photograph: they
  go. How much a view shows of a Gaussian is the sum of its blending weights, in pixels; `noted` keeps that of the scene
  as it was.
* A road user drove there, so nothing stands there: Gaussians of the background in the space that its box swept are no
  surfaces. Around it, those of road users are its own, which a box too small left over.
* The ground that it darkened becomes as bright as what lies around (`street.py`).
* The sky that only shows now continues the sky that was seen.
* Where the ground has gaps behind and below the box, flat Gaussians that continue the colours of the seen ground close
  it.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
import torch
from numpy.typing import NDArray
from scipy import ndimage
from scipy.spatial import KDTree

from mudg.base import geometry
from mudg.base.palette import DYNAMIC_IDS
from mudg.base.types import View
from mudg.core import native_ops
from mudg.core.edit import Motion
from mudg.core.lidar import met_box
from mudg.core.raster.rasterize import RasterConfig, rasterize
from mudg.core.table import Table
from mudg.core.weather.light import LUMINANCE
from mudg.editing.model import GROUND_CLASSES, SOLID_OPACITY, classes_of_rows, display_of, linear_of
from mudg.gaussians.model import CERTAINTY, SceneModel, compose
from mudg.gaussians.nodes import SYMMETRIC_LABELS, RigidNode, SkyNode
from mudg.gaussians.start import SH_C0

Array = NDArray[np.float64]
Rows = NDArray[np.bool_]

# -- shadows ---------------------------------------------------------------------------------------
#
# On a grid of the ground, a cell is dark that has clearly less light than lit ground of its class about it. Dark cells
# are the object's shadow if they lie behind it in one direction, that of the light, with no lit cell between. They get
# the colours of the lit ground around, continued, and keep a little of their texture.

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


def colors_of(model: SceneModel) -> Array:
    """Display values f64[N, 3] of every Gaussian, without what depends on the direction of view."""
    return 0.5 + SH_C0 * model.table["sh_dc"].detach().cpu().numpy()[:, 0].astype(np.float64)


def continued(xy: Array, places: Array, colors: Array, weights: Array) -> tuple[Array, NDArray[np.int64]]:
    """Colours of ground continued smoothly to other places.

    Args:
        xy: f64[C, 2] where colours are asked for. places: f64[M, 2]; colors: f64[M, 3] of the ground that is known;
            weights: how much of it is seen, f64[M].

    Returns:
        Colours f64[C, 3], and the nearest known place i64[C].
    """
    _, owner = np.unique(np.floor(places / SOURCE_M).astype(np.int64), axis=0, return_inverse=True)
    owner = owner.ravel()
    total = np.bincount(owner, weights)
    mean = lambda values: np.bincount(owner, weights * values) / total
    centres = np.column_stack([mean(places[:, axis]) for axis in (0, 1)])
    middles = np.column_stack([mean(colors[:, channel]) for channel in (0, 1, 2)])
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


@dataclass(frozen=True, slots=True, eq=False)
class _Cells:
    """A grid of square cells of `CELL_M` on the ground: the place f64[2] of its first corner, and how many cells it
    has."""

    low: Array
    shape: tuple[int, int]

    @classmethod
    def around(cls, poses: Array, reach_m: float) -> _Cells:
        low = np.floor((poses[:, :2, 3].min(0) - reach_m) / SHADOW_CELL_M) * SHADOW_CELL_M
        count = np.ceil((poses[:, :2, 3].max(0) + reach_m - low) / SHADOW_CELL_M).astype(int)
        return cls(low, (int(count[0]), int(count[1])))

    def centres(self) -> Array:
        """Places f64[X * Y, 2]."""
        cells = np.stack(np.meshgrid(*map(np.arange, self.shape), indexing="ij"), -1).reshape(-1, 2)
        return self.low + (cells + 0.5) * SHADOW_CELL_M

    def below(self, size_m: tuple[float, float, float], poses: Array) -> Rows:
        """Cells bool[X, Y] below boxes."""
        centres, half = self.centres(), np.array(size_m[:2]) / 2
        found = np.zeros(len(centres), bool)
        for pose in poses:
            yaw = geometry.yaw_of(pose)
            turn = np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
            found |= (np.abs((centres - pose[:2, 3]) @ turn) <= half).all(1)
        return found.reshape(self.shape)

    def at(self, xy: Array, cells: Rows) -> Rows:
        """Which places f64[N, 2] lie in chosen cells."""
        index = np.floor((xy - self.low) / SHADOW_CELL_M).astype(np.int64)
        inside = ((index >= 0) & (index < self.shape)).all(1)
        found = np.zeros(len(xy), bool)
        found[inside] = cells[tuple(index[inside].T)]
        return found

    def of(self, values: Array, xy: Array) -> Array:
        """Values f64[X, Y] of the cells in which places f64[N, 2] lie."""
        return values[tuple(np.floor((xy - self.low) / SHADOW_CELL_M).astype(np.int64).T)]

    def light(self, xy: Array, luminance: Array, weights: Array) -> Array:
        """Weighted mean luminance f64[X, Y] of the places near each cell; NaN where there are none."""
        index = np.floor((xy - self.low) / SHADOW_CELL_M).astype(np.int64)
        flat = np.ravel_multi_index(tuple(index.T), self.shape)
        count, both = int(np.prod(self.shape)), (weights, weights * luminance)
        sums = [np.bincount(flat, values, count).reshape(self.shape) for values in both]
        total, shown = (ndimage.gaussian_filter(values, 0.7, truncate=2.0) for values in sums)
        return np.where(total > LEAST_PX, shown / np.maximum(total, 1e-12), np.nan)


def shaded_cells(light: Array, below: Rows, reach_m: float) -> Rows:
    """Cells bool[X, Y] of the shadow of what stood on some: those darker than lit ground about them that lie behind it,
    and behind each other, in one direction: the one in which there are most. ``light``: luminance f64[X, Y] in linear
    light, NaN = not known. ``below``: where it stood, bool[X, Y]."""
    known = np.isfinite(light)
    size = 2 * round(AROUND_M / SHADOW_CELL_M) + 1
    lit = ndimage.generic_filter(np.where(known, light, np.nan), _upper, size=size, mode="constant", cval=np.nan)
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


def _upper(values: Array) -> float:
    values = values[np.isfinite(values)]
    return float(np.quantile(values, LIT_QUANTILE)) if len(values) else np.nan


def brightened(
    model: SceneModel, size_m: tuple[float, float, float], poses: Array, ground: Mapping[int, Rows], weights: Array
) -> SceneModel:
    """A copy without the shadow of what stood in boxes; the model itself where none is found. ``poses``: world_from_box
    f64[V, 4, 4]. ``ground``: rows bool[N] of each class of ground. ``weights``: pixels that views show of each,
    f64[N]."""
    means = model.table["means"].detach().cpu().numpy().astype(np.float64)[:, :2]
    shown = colors_of(model)
    luminance = linear_of(shown) @ LUMINANCE
    reach = REACH * size_m[2]
    cells = _Cells.around(poses, reach + AROUND_M + float(np.linalg.norm(size_m[:2])) / 2)
    below = cells.below(size_m, poses)
    here = cells.at(means, np.ones(cells.shape, bool))
    changed = model.table["sh_dc"].detach().clone()
    for rows in ground.values():
        near = rows & here & (weights > 0)
        if near.sum() < LEAST_ROWS:
            continue
        light = cells.light(means[near], luminance[near], weights[near])
        found = shaded_cells(light, below, reach)
        wide: Rows = np.asarray(ndimage.binary_dilation(found, iterations=EDGE_CELLS), np.bool_)
        shaded = np.flatnonzero(rows & cells.at(means, wide))
        lit = near & ~cells.at(means, wide | below)
        if not len(shaded) or lit.sum() < LEAST_ROWS:
            continue
        target = linear_of(continued(means[shaded], means[lit], shown[lit], weights[lit])[0])
        usual = cells.of(light, means[shaded])
        usual = np.where(np.isfinite(usual), usual, luminance[shaded])  # what no view shows has no texture
        texture = (luminance[shaded] / np.maximum(usual, 1e-4)).clip(1 / TEXTURE, TEXTURE)
        darker = luminance[shaded] < target @ LUMINANCE / TEXTURE
        values = ((display_of(target * texture[:, None]) - 0.5) / SH_C0)[darker]
        changed[torch.from_numpy(shaded[darker]).to(model.device), 0] = torch.from_numpy(values).to(changed)
    columns = {name: value.detach() for name, value in model.table.columns.items()}
    return replace(model, table=Table({**columns, "sh_dc": changed}, dict(model.table.labels)), facts=dict(model.facts))


# -- what nobody saw -------------------------------------------------------------------------------
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
FILL_OPACITY: Final = 0.95
BELOW_M: Final = 0.02
"""Made-up ground lies this far below the ground beside it, which so shows first."""


@dataclass(frozen=True, slots=True, eq=False)
class Hidden:
    """An object of the recording and the views of it. ``size_m``: of its box. ``motion``: of its box. ``moves``:
    whether it leaves its place. ``views``: at whose times it is there."""

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
        """Whether it gets no farther than its own length, so that views show the ground about it with its shadow
        alone."""
        poses = self.poses
        return bool(np.linalg.norm(poses[:, :2, 3] - poses[0, :2, 3], axis=1).max() <= self.size_m[0])


def shown_by(
    model: SceneModel, view: View, raster: RasterConfig, absent: Collection[str] = ()
) -> tuple[torch.Tensor, torch.Tensor | None]:
    """What a view shows when some objects are absent: blending weights summed over pixels, of every Gaussian f32[N] and
    of every texel of the sky f32[Hs, 2 Hs] (None without one)."""
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


def _sky_continued(
    model: SceneModel, views: Sequence[View], raster: RasterConfig, absent: Collection[str]
) -> SkyNode | None:
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
    table = Table(columns, {key: value[kept] for key, value in model.table.labels.items()})
    return replace(model, table=table, facts=dict(model.facts))


def _without_unseen(
    model: SceneModel, views: Sequence[View], raster: RasterConfig, absent: Collection[str]
) -> tuple[SceneModel, Array]:
    """Without the Gaussians of the background that only show because objects are absent; and the places f64[L, 3] of
    the ground's."""
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
    """Rows of the background within the space that a moving box swept, above the ground, and of road users around the
    box."""
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
        met = met_box(toward / distance[:, None], from_eye, np.array(one.size_m) + BOX_GROWTH_M)
        hides[rows] = inside & (met < distance)
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
    if not len(xy):
        return np.zeros((0, 3))
    return np.column_stack([xy, np.median(seen_ground[tree.query(xy, NEAREST)[1], 2], 1)])


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
    changed = _flat(cells - [0, 0, BELOW_M], [0.75 * CELL_M, 0.75 * CELL_M, 0.02], FILL_OPACITY, colors)
    return with_copies(model, seen[near], changed)


def _flat(places: Array, scales_m: Sequence[float], opacity: float, colors: Array) -> dict[str, Array]:
    """Columns of Gaussians at places f64[C, 3], not turned, of colours f64[C, 3]."""
    count = len(places)
    return {
        "means": places,
        "quats": np.tile([1.0, 0, 0, 0], (count, 1)),
        "log_scales": np.tile(np.log(scales_m), (count, 1)),
        "logits": np.full(count, np.log(opacity / (1 - opacity))),
        "sh_dc": ((colors - 0.5) / SH_C0)[:, None],
    }


def with_copies(model: SceneModel, likeness: NDArray[np.int64], changed: Mapping[str, Array]) -> SceneModel:
    """With copies of some rows, appended, that differ from them in some columns; nobody saw what they show.
    ``likeness``: rows i64[M]. ``changed``: columns f64[M, ...] by name."""
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
OPACITY: Final = 0.95
SHOWN_PX: Final = 0.01
"""What a recorded view shows more of than this is not hidden."""


def with_closed_sides(
    model: SceneModel, names: Collection[str], views: Sequence[View], raster: RasterConfig
) -> SceneModel:
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
    made = torch.arange(len(model.table), device=model.device) >= first
    seen = made & (_most_shown(model, views, raster) > SHOWN_PX)
    model = without_rows(model, seen.cpu().numpy())
    model.sort_rows()
    return model


def _most_shown(model: SceneModel, views: Sequence[View], raster: RasterConfig) -> torch.Tensor:
    """As `most_shown`, of rows that need not be sorted by node yet: f32[N]."""
    order = torch.argsort(model.table.labels["node"], stable=True)
    ordered = without_rows(model, np.zeros(len(model.table), bool))
    ordered.sort_rows()
    shown = torch.zeros(len(order), device=model.device)
    shown[order] = most_shown(ordered, views, raster)[0]
    return shown


def _with_flanks(model: SceneModel, node: RigidNode) -> SceneModel:
    """With rows more, the last ones, where the flanks of a vehicle have gaps."""
    length, width, height = node.size_m
    half = np.array([length, width, height]) / 2
    rows = np.flatnonzero((model.table.labels["node"] == model.nodes.index(node)).cpu().numpy())
    there = torch.from_numpy(rows).to(model.device)
    places = model.table["means"].detach()[there].cpu().numpy().astype(np.float64)
    own = torch.sigmoid(model.table["logits"].detach()[there]).cpu().numpy() > SOLID_OPACITY
    own &= (np.abs(places) <= half + SIDE_AROUND_M).all(1) & ~np.isin(classes_of_rows(model)[rows], GROUND_CLASSES)
    if own.sum() < SIDE_LEAST_ROWS:
        return model
    rows, places = rows[own], places[own]
    flanks = _flanks(places, half, node.label in CABIN_LABELS)
    flanks = flanks[KDTree(places).query(flanks)[0] > SIDE_GAP_M] if len(flanks) else flanks
    if not len(flanks):
        return model
    both = np.concatenate([places, places * [1, -1, 1]]) * ALIKE
    near = KDTree(both).query(flanks * ALIKE, min(LIKE, len(both)))[1] % len(rows)
    color = np.median(colors_of(model)[rows][near], 1)
    changed = _flat(flanks, [SPREAD * STEP_M, 0.02, SPREAD * STEP_M], OPACITY, color)
    return with_copies(model, rows[near[:, 0]], changed)


def _flanks(places: Array, half: Array, cabin: bool) -> Array:
    """Places f64[M, 3] on a grid over both flanks of a vehicle, in the frame of its box. ``places``: f64[N, 3] of its
    Gaussians, which say how wide it is at each height. ``half``: of the size of its box. ``cabin``: a car, of the usual
    shape; else a box."""
    found = []
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
    return np.concatenate(found) if found else np.zeros((0, 3))
