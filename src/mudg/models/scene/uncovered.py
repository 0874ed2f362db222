"""The street where an object of the recording is gone: what nobody saw is filled in, what its shadow darkened is brightened.

Three things, for the places at which the recording has the object's box:

* A road user drove there, so nothing stands there: Gaussians of the background in the space that its box swept are no surfaces.
* Ground that the box hides in every view that would show it was never seen. What the fit left there is taken away, and flat Gaussians
  of the colours of the nearest ground that was seen close it.
* Ground around the box of what stands holds its shadow (that of a road user on the move was recorded without it, too).
  Its smooth luminance is raised to that of the ground farther away, never lowered.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from mudg.base import geometry
from mudg.core.beams import met_box
from mudg.core.table import Table
from mudg.models.scene.edited import GROUND_CLASSES, SOLID_OPACITY, classes_of_rows, display_of, linear_of
from mudg.models.scene.initial import SH_C0
from mudg.models.scene.model import CERTAINTY, SceneModel

Array = NDArray[np.float64]
Rows = NDArray[np.bool_]
CELL_M: Final = 0.3
BEHIND_M: Final = 30.0
"""How far behind an object hidden ground is filled in."""
KNOWN_WITHIN_M: Final = 4.0
"""Ground is taken to go on this far from ground that was seen, sideways and ahead."""
FLOOR_M: Final = 0.15
SHADOW_M: Final = 1.2
"""How far beside its box the ground may hold an object's shadow."""
AROUND_M: Final = 5.0
"""Ground up to this far from the shadow says how bright it is in the light."""
NEAREST: Final = 24
LEAST_GAIN, MOST_GAIN = 1.05, 3.0
FILL_OPACITY: Final = 0.95
MOST_VIEWS: Final = 48


@dataclass(frozen=True, slots=True, eq=False)
class Hidden:
    """An object of the recording, as its views saw it.

    Args:
        size_m: of its box. poses: world_from_box f64[V, 4, 4] at the times of the views. eyes: their centres f64[V, 3].
        shows: cam_from_world f64[V, 4, 4]; slopes: half the image's width and height over the focal length, f64[V, 2].
        moves: whether it leaves its place.
    """

    size_m: tuple[float, float, float]
    poses: Array
    eyes: Array
    shows: Array
    slopes: Array
    moves: bool


def without_traces(model: SceneModel, hidden: Sequence[Hidden]) -> SceneModel:
    """A copy in which the street shows no traces of objects that are gone from their places; the model itself where it knows no ground.

    A background that changes with time stays as it is.
    """
    if model.nodes[0].kind != "static" or not model.classes:
        return model
    for one in hidden:
        if len(one.poses):
            model = _repaired(model, one)
    return model


def _repaired(model: SceneModel, one: Hidden) -> SceneModel:
    means = model.table["means"].detach().cpu().numpy().astype(np.float64)
    still = (model.table.labels["node"] == 0).cpu().numpy()
    solid = torch.sigmoid(model.table["logits"].detach()).cpu().numpy() > SOLID_OPACITY
    ground = still & np.isin(classes_of_rows(model), GROUND_CLASSES)
    if (ground & solid).sum() < 2 * NEAREST:
        return model
    cells = _unseen_ground(one, means[ground & solid])
    tree = cKDTree(cells[:, :2]) if len(cells) else None

    def on_cells(rows: Rows) -> Rows:
        found = np.zeros(len(rows), bool)
        if tree is not None:
            found[rows] = tree.query(means[rows, :2])[0] < CELL_M
        return found

    gone = on_cells(ground) | (_swept(one, means, still) if one.moves else np.zeros(len(means), bool))
    beside = _beside(one, means[:, :2])
    lit = ground & solid & ~gone & (beside > SHADOW_M)
    if lit.sum() < NEAREST:
        return model
    shaded = ground & ~gone & (beside <= SHADOW_M)
    made = model if one.moves else _brightened(model, means, shaded, lit & (beside <= SHADOW_M + AROUND_M))
    return _filled(made, gone, cells, np.flatnonzero(lit), means)


def _cells_around(one: Hidden, seen_ground: Array) -> Array:
    """Places f64[C, 3] on a grid of the ground behind and below an object, where ground was seen near."""
    at = one.poses[:, :3, 3]
    away = at[:, :2] - one.eyes[:, :2]
    away /= np.maximum(np.linalg.norm(away, axis=1, keepdims=True), 1e-6)
    ends = np.concatenate([at[:, :2], at[:, :2] + away * BEHIND_M])
    low, high = ends.min(0) - 3.0, ends.max(0) + 3.0
    axes = [np.arange(a, b, CELL_M) for a, b in zip(low, high, strict=True)]
    xy = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 2)
    tree = cKDTree(seen_ground[:, :2])
    apart, near = tree.query(xy, 8)
    known = apart[:, 0] < KNOWN_WITHIN_M
    return np.column_stack([xy, np.median(seen_ground[near, 2], 1)])[known]


def _unseen_ground(one: Hidden, seen_ground: Array) -> Array:
    """Places f64[C, 3] of ground that the object hides in every view that would show it."""
    cells = _cells_around(one, seen_ground)
    hides, shows = np.zeros(len(cells), bool), np.zeros(len(cells), bool)
    size = np.array(one.size_m) + 0.3
    for pose, eye, cam, slope in zip(one.poses, one.eyes, one.shows, one.slopes, strict=True):
        toward = cells - eye
        distance = np.linalg.norm(toward, axis=1)
        local = cells @ cam[:3, :3].T + cam[:3, 3]
        inside = (local[:, 2] > 0.5) & (np.abs(local[:, :2]) <= slope * np.maximum(local[:, 2:], 1e-6)).all(1)
        from_eye = pose.copy()
        from_eye[:3, 3] -= eye
        behind = inside & (met_box(toward / distance[:, None], from_eye, size) < distance)
        hides |= behind
        shows |= inside & ~behind
    return cells[hides & ~shows]


def _swept(one: Hidden, means: Array, still: Rows) -> Rows:
    """Rows of the background within the space that a moving box swept, above the ground."""
    half = np.array(one.size_m) / 2
    rows = np.flatnonzero(still & _near(one, means[:, :2], 0.0))
    inside = np.zeros(len(rows), bool)
    for pose in one.poses:
        local = geometry.transform_points(geometry.invert(pose), means[rows])
        inside |= (np.abs(local) <= half).all(1) & (local[:, 2] > FLOOR_M - half[2])
    found = np.zeros(len(means), bool)
    found[rows[inside]] = True
    return found


def _near(one: Hidden, xy: Array, margin_m: float) -> Rows:
    """Which places may lie within a distance of one of an object's boxes."""
    reach, at = float(np.linalg.norm(one.size_m)) / 2 + margin_m, one.poses[:, :2, 3]
    return ((xy >= at.min(0) - reach) & (xy <= at.max(0) + reach)).all(1)


def _beside(one: Hidden, xy: Array) -> Array:
    """Horizontal distance f64[N] of places from the nearest of an object's boxes; 0 below them, infinite far away."""
    rows = np.flatnonzero(_near(one, xy, SHADOW_M + AROUND_M))
    nearest, near = np.full(len(xy), np.inf), xy[rows]
    apart = np.full(len(rows), np.inf)
    half = np.array(one.size_m[:2]) / 2
    for pose in one.poses:
        yaw = geometry.yaw_of(pose)
        turn = np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
        apart = np.minimum(apart, np.linalg.norm(np.maximum(np.abs((near - pose[:2, 3]) @ turn) - half, 0), axis=1))
    nearest[rows] = apart
    return nearest


def _brightened(model: SceneModel, means: Array, shaded: Rows, lit: Rows) -> SceneModel:
    """Ground whose smooth luminance is at least that of the lit ground around it."""
    if shaded.sum() < NEAREST or lit.sum() < NEAREST:
        return model
    light = linear_of(0.5 + SH_C0 * model.table["sh_dc"].detach().cpu().numpy()[:, 0].astype(np.float64))
    luminance = light @ np.array([0.2126, 0.7152, 0.0722])

    def smooth(rows: Rows) -> Array:
        near = cKDTree(means[rows, :2]).query(means[shaded, :2], NEAREST)[1]
        return np.median(luminance[rows][near], 1)

    gain = (smooth(lit) / np.maximum(smooth(shaded), 1e-4)).clip(1.0, MOST_GAIN)
    gain = np.where(gain < LEAST_GAIN, 1.0, gain)
    columns = {name: value.detach() for name, value in model.table.columns.items()}
    changed = columns["sh_dc"].clone()
    rows = torch.from_numpy(np.flatnonzero(shaded)).to(model.device)
    values = (display_of(light[shaded] * gain[:, None]) - 0.5) / SH_C0
    changed[rows, 0] = torch.from_numpy(values).to(changed)
    return replace(model, table=Table({**columns, "sh_dc": changed}, dict(model.table.labels)), facts=dict(model.facts))


def _filled(model: SceneModel, gone: Rows, cells: Array, lit: NDArray[np.int64], means: Array) -> SceneModel:
    """Without some rows, and with flat Gaussians on cells of the ground that look like the nearest of the lit rows."""
    table, there = model.table, model.device
    kept = torch.from_numpy(np.flatnonzero(~gone)).to(there)
    count = len(cells)
    near = cKDTree(means[lit, :2]).query(cells[:, :2], 8)[1] if count else np.zeros((0, 8), np.int64)
    likeness = torch.from_numpy(lit[near[:, 0]]).to(there)
    columns = {name: value.detach()[likeness].clone() for name, value in table.columns.items()}
    columns["means"] = torch.from_numpy(cells.astype(np.float32)).to(there)
    columns["quats"] = torch.tensor([1.0, 0, 0, 0]).repeat(count, 1).to(there)
    columns["log_scales"] = torch.log(torch.tensor([0.75 * CELL_M, 0.75 * CELL_M, 0.02])).repeat(count, 1).to(there)
    columns["logits"] = torch.full((count,), float(np.log(FILL_OPACITY / (1 - FILL_OPACITY)))).to(there)
    columns["sh_dc"] = table["sh_dc"].detach()[torch.from_numpy(lit[near]).to(there)].median(1).values
    if "sh_rest" in columns:
        columns["sh_rest"] = torch.zeros_like(columns["sh_rest"])
    labels = {key: value[likeness].clone() for key, value in table.labels.items()}
    if CERTAINTY in labels:
        labels[CERTAINTY] = torch.zeros_like(labels[CERTAINTY])  # nobody saw it
    made = Table(
        {name: torch.cat([value.detach()[kept], columns[name]]) for name, value in table.columns.items()},
        {key: torch.cat([value[kept], labels[key]]) for key, value in table.labels.items()},
    )
    result = replace(model, table=made, facts=dict(model.facts))
    result.sort_rows()
    return result
