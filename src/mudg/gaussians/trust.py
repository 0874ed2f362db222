"""How well photographs constrain every Gaussian; which part of a virtual view no recorded camera ever saw, and
Gaussians to start there."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from functools import cache

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from mudg.base import geometry, log, seeds
from mudg.base.types import Render, View
from mudg.core.raster.rasterize import RasterConfig, rasterize
from mudg.gaussians.corrections import UNCORRECTED, Appearance
from mudg.gaussians.model import SceneModel, compose, compose_as_read, composite_sky
from mudg.gaussians.nodes import RigidNode
from mudg.gaussians.start import StartPoints, voxel_filter
from mudg.gaussians.views import StoredView, TrainView, resized_view

# certainty ----------------------------------------------------------------------------------------
#
# A render beside the recorded path is right where several photographs saw the same surface and agree about it, and
# where LiDAR agrees with its depth. Three sums per Gaussian say so, over recorded views and their pixels, with the
# blending weight w of the Gaussian:
#
#     views     of each view W / (W + 1), W the sum of w in pixels: the number of photographs that show it
#     colour    w |render - photograph| / w, the mean difference of the pixels that it is part of
#     depth     w |render - LiDAR| / (LiDAR w), the mean relative difference at the pixels that LiDAR measured
#
#     certainty = views / (views + 1) * c / (c + colour) * d / (d + depth)
#
# The sums are exact: w is the derivative of a rendered feature by the Gaussian's feature, so that one backward pass per
# view, with an image in place of the loss's gradient, sums over all pixels at once.

COLOR_ERROR = 0.02
"""Mean difference of colour, of [0, 1], that halves the certainty."""
DEPTH_ERROR = 0.1
"""Mean relative difference of depth that halves it. Taken for a Gaussian that LiDAR never met."""
ASSUMED_PIXELS = 0.1
"""Weight of that assumption, in pixels with LiDAR."""


def certainty(views: Tensor, pixels: Tensor, color: Tensor, lidar: Tensor, depth: Tensor) -> Tensor:
    """Certainty of every Gaussian f32[N] in [0, 1], 0 where no view shows it, from sums of blending weights f32[N] over
    views and pixels. ``views``: number of views that show it. ``pixels``: weight, in pixels. ``color``: the same, each
    pixel times the mean difference of its three colours. ``lidar``: weight, in pixels with LiDAR. ``depth``: the same,
    each times its relative difference of depth."""
    color = color / pixels.clamp_min(1e-12)
    depth = (depth + ASSUMED_PIXELS * DEPTH_ERROR) / (lidar + ASSUMED_PIXELS)
    return views / (views + 1) * COLOR_ERROR / (COLOR_ERROR + color) * DEPTH_ERROR / (DEPTH_ERROR + depth)


def spread(views: Sequence[StoredView], most: int) -> list[StoredView]:
    """At most so many of the views, evenly chosen."""
    chosen = np.linspace(0, len(views) - 1, min(most, len(views))).round().astype(int)
    return [views[index] for index in np.unique(chosen).tolist()]


def certainty_of(
    model: SceneModel,
    views: Sequence[StoredView],
    raster: RasterConfig,
    appearance: Appearance = UNCORRECTED,
    most: int = 0,
) -> Tensor:
    """Certainty of every Gaussian of a model, f16[N], from recorded views, evenly chosen if there are more than
    ``most`` (0 = all); those that are left out count like the others."""
    chosen = spread(views, most or len(views))
    total = torch.zeros(5, len(model.table), device=model.device)
    for stored in chosen:
        sums = weight_sums(model, TrainView.of(stored, model.device), raster, appearance)
        total += torch.cat([(sums[:1] / (sums[:1] + 1)), sums])
    total *= len(views) / len(chosen)
    return certainty(*total).half()


def weight_sums(
    model: SceneModel, view: TrainView, raster: RasterConfig, appearance: Appearance = UNCORRECTED
) -> Tensor:
    """``[4, N]``: over the pixels of one view, the blending weights of every Gaussian times each of
    ``difference_images``."""
    with torch.no_grad():
        gaussians = compose_as_read(model, view.view, view.readout, semantics=False)
        pose = appearance.world_from_cam(view.view, view.name)
    features = torch.zeros(len(gaussians), 4, device=model.device, requires_grad=True)
    render = rasterize(replace(gaussians, extra=features), view.view, raster, world_from_cam=pose)
    images = difference_images(model, render, view, appearance)
    return torch.autograd.grad(render.extra, [features], images)[0].T


@torch.no_grad()
def difference_images(model: SceneModel, render: Render, view: TrainView, appearance: Appearance) -> Tensor:
    """``[4, H, W]``: 1 where the photograph counts, and its difference from the render; 1 where LiDAR measured, and the
    relative difference (at most 1)."""
    rgb = appearance.colored(composite_sky(model, view.view, render.rgb, render.alpha), view.name, view.kind)
    used = view.mask[0].float()
    color = (rgb - view.rgb).abs().mean(0) * used
    lidar, depth = torch.zeros_like(used), torch.zeros_like(used)
    if view.lidar is not None:
        pixel, measured = view.lidar.pixel, view.lidar.depth_m
        lidar.view(-1)[pixel] = 1.0
        depth.view(-1)[pixel] = ((render.depth.reshape(-1)[pixel] - measured).abs() / measured).clamp(max=1)
    return torch.stack([used, color, lidar, depth])


# unseen surfaces ----------------------------------------------------------------------------------
#
# Behind a parked bus a generated view is the best there is; nothing was measured, so no Gaussian could start there.
# For every pixel of a virtual view, its point (at the view's own depth) is carried to a number of recorded views, with
# its dynamic object if it lies in one's box, and compared with the depth that the model renders there. If a recorded
# view shows that point, or something behind it, the pixel is seen. Others are unseen: ``unseen_rows`` makes Gaussians
# of them.

WITNESSES = 36
"""Number of recorded views that are compared, spread evenly over cameras and time."""
STRIDE_PX = 2
TOLERANCE = 0.15
SKY_AT_M = 1000.0
WITNESS_WIDTH_PX = 160
SEED_STRIDE_PX = 3
SEED_NEAREST_M, SEED_FARTHEST_M = 2.0, 80.0
SEED_CONFIDENCE = 0.2
"""Least confidence of a virtual pixel that may become a Gaussian."""
SPREAD_ROUNDS = 12
MOST_SEEDS = 8_000_000
"""Points held at once; thinning them takes about 150 bytes each."""


_Witness = tuple[View, NDArray[np.float32]]
"""A recorded view and what it sees: depth f32[H, W], infinite in the sky."""
_Placed = tuple[tuple[float, ...], Callable[[float], NDArray[np.float64] | None]]
"""Size of an object's box, and its poses, which do not change meanwhile: each is worked out once."""


def _placed(model: SceneModel) -> dict[int, _Placed]:
    rigid = {index: node for index, node in enumerate(model.nodes) if isinstance(node, RigidNode)}
    return {index: (node.size_m, cache(node.pose_matrix)) for index, node in rigid.items()}


@torch.no_grad()
def unseen_maps(
    model: SceneModel, recorded: Sequence[StoredView], virtual: Sequence[StoredView], raster: RasterConfig
) -> Iterator[tuple[StoredView, NDArray[np.bool_]]]:
    """Every virtual view with bool[H, W], True where no recorded view saw the surface it shows, by the geometry that
    the model has by now; one at a time. Pixels without depth count as sky, far away."""
    witnesses = []
    for view in (stored.view for stored in spread(recorded, WITNESSES)):
        small = resized_view(view, min(WITNESS_WIDTH_PX, view.camera.width))
        render = rasterize(compose(model, view.time_s, semantics=False), small, raster)
        witnesses.append((small, torch.where(render.alpha > 0.5, render.depth, torch.inf)[0].cpu().numpy()))
    objects = list(_placed(model).values())
    for stored in log.progress(virtual, len(virtual), "finding unseen surfaces"):
        yield stored, _unseen(stored, witnesses, objects)


def block_centres(size_px: int) -> NDArray[np.intp]:
    """The pixel that stands for each block of ``STRIDE_PX``; the last block may be cut, so that any size is covered."""
    return np.minimum(np.arange(0, size_px, STRIDE_PX) + STRIDE_PX // 2, size_px - 1)


def _unseen(stored: StoredView, witnesses: Sequence[_Witness], objects: Sequence[_Placed]) -> NDArray[np.bool_]:
    (height, width), time_s = stored.rgb.shape[:2], stored.view.time_s
    row, column = np.meshgrid(block_centres(height), block_centres(width), indexing="ij")
    shape = row.shape
    row, column = row.ravel(), column.ravel()
    depth = np.full(len(row), SKY_AT_M) if stored.depth is None else stored.depth[row, column].astype(np.float64)
    depth = np.where(np.isfinite(depth) & (depth > 0), depth, SKY_AT_M)
    points = geometry.unproject(stored.view, np.stack([column + 0.5, row + 0.5], 1), depth)
    inside_of = [(pose_at, _in_box(size_m, pose_at(time_s), points)) for size_m, pose_at in objects]
    carried = [(pose_at, found) for pose_at, found in inside_of if found is not None]
    seen = np.zeros(len(points), bool)
    # who sees most comes first
    for other, known in sorted(witnesses, key=lambda one: abs(one[0].time_s - time_s)):
        left = np.flatnonzero(~seen)
        place = np.full(len(points), -1)
        place[left] = np.arange(len(left))
        moved, exists = points[left], np.ones(len(left), bool)
        for pose_at, (inside, local) in carried:
            pose, waiting = pose_at(other.time_s), place[inside] >= 0
            here = place[inside][waiting]
            exists[here] = pose is not None
            if pose is not None:
                moved[here] = geometry.transform_points(pose, local[waiting])
        (uv, z), camera = geometry.project(other, moved), other.camera
        with np.errstate(invalid="ignore"):
            shown = ((uv >= 0) & (uv < (camera.width, camera.height))).all(1) & (z > 0.2)
        x, y = (np.where(shown, np.nan_to_num(uv[:, axis]), 0).astype(int) for axis in (0, 1))
        far = known[y.clip(0, camera.height - 1), x.clip(0, camera.width - 1)]
        seen[left] = exists & shown & (far >= z * (1 - TOLERANCE))  # it shows the point, or something behind it
    coarse = ~seen.reshape(shape)
    return np.repeat(np.repeat(coarse, STRIDE_PX, 0), STRIDE_PX, 1)[:height, :width]


def unseen_rows(
    model: SceneModel, unseen: Iterable[tuple[StoredView, NDArray[np.bool_]]], most: int, run_seed: int
) -> tuple[dict[str, torch.Tensor], dict[str, torch.Tensor], float]:
    """Table rows (columns, labels; on the CPU) at the surfaces that only virtual views show, thinned to one per place,
    at most ``most``; and the mean share of pixels that show them. A point in the box of a dynamic object belongs to it.
    Above ``MOST_SEEDS`` points, every second one goes on."""
    objects = _placed(model)
    found: dict[int, list[StartPoints]] = {index: [] for index in range(len(model.nodes))}
    shares, stride, total = [], 1, 0
    for stored, unseen_here in unseen:
        shares.append(unseen_here.mean())
        for index, seeds_here in _seeds_of(stored, unseen_here, objects, model):
            found[index].append(seeds_here[::stride])
            total += len(found[index][-1])
        while total > MOST_SEEDS:
            found, stride = {index: [part[::2] for part in parts] for index, parts in found.items()}, 2 * stride
            total = sum(len(part) for parts in found.values() for part in parts)
    columns, owners = [], []
    for index, parts in found.items():
        if not parts:
            continue
        points = StartPoints.joined(parts)
        share = max(1, most * len(points) // total)
        kept = _spread(points, share, seeds.numpy_rng(run_seed, index, "unseen rows"))
        columns.append(kept.columns(model.classes, model.sh_degree))
        owners.append(torch.full((len(kept),), index, dtype=torch.int32))
    names = model.table.columns
    joined = {name: torch.cat([names[name].detach()[:0].cpu(), *(c[name] for c in columns)]) for name in names}
    return joined, {"node": torch.cat([torch.zeros(0, dtype=torch.int32), *owners])}, float(np.mean(shares))


def _spread(points: StartPoints, most: int, rng: np.random.Generator) -> StartPoints:
    """At most ``most`` of the points, one per cube; the cubes, and the scales of what stands for them, grow until that
    suffices, so that few points still leave no holes between them."""
    size = np.maximum(2.0 * points.scale_m, 0.08)
    rows = voxel_filter(points.xyz, size)
    for _ in range(SPREAD_ROUNDS):
        if len(rows) <= most:
            break
        size = size * np.clip((len(rows) / most) ** 0.5, 1.05, 2.0)
        rows = voxel_filter(points.xyz, size)
    rows = rows[np.sort(rng.permutation(len(rows))[:most])]
    kept = points[rows]
    return replace(kept, scale_m=np.maximum(kept.scale_m, size[rows] / 2).astype(np.float32))


def _seeds_of(
    stored: StoredView, unseen: NDArray[np.bool_], objects: dict[int, _Placed], model: SceneModel
) -> list[tuple[int, StartPoints]]:
    """Points of one virtual view's unseen pixels, by node index."""
    if stored.depth is None:
        return []
    height, width = stored.rgb.shape[:2]
    row, column = np.mgrid[SEED_STRIDE_PX // 2 : height : SEED_STRIDE_PX, SEED_STRIDE_PX // 2 : width : SEED_STRIDE_PX]
    row, column = row.ravel(), column.ravel()
    z = stored.depth[row, column]
    with np.errstate(invalid="ignore"):
        kept = unseen[row, column] & (z > SEED_NEAREST_M) & (z < SEED_FARTHEST_M)
    if stored.mask is not None:
        kept &= stored.mask[row, column]
    if stored.confidence is not None:
        kept &= stored.confidence[row, column] >= SEED_CONFIDENCE * 255
    row, column, z = row[kept], column[kept], z[kept].astype(np.float64)
    points = geometry.unproject(stored.view, np.stack([column + 0.5, row + 0.5], 1), z)
    train_id = stored.train_ids(row, column, model.classes)
    scale = (0.6 * SEED_STRIDE_PX * z / stored.view.camera.fx).astype(np.float32)
    rgb = model.colors.bytes_to_common(stored.view.camera.name, stored.rgb[row, column])
    owner = np.zeros(len(row), np.int64)
    local = points.copy()
    for index, (size_m, pose_at) in objects.items():
        inside = _in_box(size_m, pose_at(stored.view.time_s), points)
        if inside is not None:
            owner[inside[0]], local[inside[0]] = index, inside[1]
    every = StartPoints(local.astype(np.float32), rgb, train_id, scale)
    return [(int(index), every[np.flatnonzero(owner == index)]) for index in np.unique(owner)]


def _in_box(
    size_m: Sequence[float], pose: NDArray[np.float64] | None, points: NDArray[np.float64]
) -> tuple[NDArray[np.int64], NDArray[np.float64]] | None:
    """Indices of points in a box at a pose (grown by a tenth) and their coordinates in it; None if there are none."""
    if pose is None:
        return None
    local = geometry.transform_points(geometry.invert(pose), points)
    inside = np.flatnonzero((np.abs(local) < np.array(size_m) * 0.55 + 0.1).all(1))
    return (inside, local[inside]) if len(inside) else None
