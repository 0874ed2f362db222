"""Moving objects by themselves: their Gaussians alone, and where their boxes lie in a view."""

from __future__ import annotations

from dataclasses import replace
from itertools import product

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image, ImageDraw
from torch import Tensor

from mudg.base import geometry
from mudg.base.types import Gaussians, View
from mudg.models.scene.model import SceneModel
from mudg.models.scene.nodes import RigidNode

BOX_GROWTH = 1.05
NEAREST_CORNER_M = 0.3


def objects_only(gaussians: Gaussians) -> Gaussians:
    """The rows of moving objects (node above 0), without class channels."""
    if gaussians.node is None:
        raise ValueError("the Gaussians do not say which node they belong to")
    rows = gaussians.node > 0
    return replace(
        gaussians, means=gaussians.means[rows], quats=gaussians.quats[rows], scales=gaussians.scales[rows],
        opacity=gaussians.opacity[rows], sh=gaussians.sh[rows],
        sh_rest=None if gaussians.sh_rest is None else gaussians.sh_rest[rows], extra=None, node=gaussians.node[rows],
    )  # fmt: skip


def boxes_in_view(model: SceneModel, view: View) -> Tensor:
    """Bool[1, H, W]: inside the outline of some object's box (slightly grown)."""
    inside = np.zeros((view.camera.height, view.camera.width), bool)
    for node in model.nodes:
        pose = node.pose_matrix(view.time_s) if isinstance(node, RigidNode) else None
        if pose is not None and isinstance(node, RigidNode):
            mask = outline_mask(view, pose, node.size_m)
            inside = inside if mask is None else inside | mask
    return torch.from_numpy(inside)[None]


def outline_mask(
    view: View, world_from_object: NDArray[np.float64], size_m: tuple[float, ...]
) -> NDArray[np.bool_] | None:
    """Bool[H, W]: inside the outline of a box, slightly grown. None: nothing of it is in view. A box that reaches behind the camera
    covers everything."""
    camera = view.camera
    uv, z = geometry.project(view, geometry.transform_points(world_from_object, _corners(size_m)))
    if z.max() < NEAREST_CORNER_M:
        return None
    if z.min() < NEAREST_CORNER_M:
        return np.ones((camera.height, camera.width), bool)
    if uv[:, 0].max() < 0 or uv[:, 1].max() < 0 or uv[:, 0].min() > camera.width or uv[:, 1].min() > camera.height:
        return None
    canvas = Image.new("1", (camera.width, camera.height))
    outline = [tuple(point) for point in convex_outline(uv - 0.5).tolist()]
    ImageDraw.Draw(canvas).polygon(outline, fill=1, outline=1)
    return np.array(canvas, bool)


def _corners(size_m: tuple[float, ...]) -> NDArray[np.float64]:
    return np.array(list(product((-0.5, 0.5), repeat=3))) * np.asarray(size_m) * BOX_GROWTH


def convex_outline(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Corners f64[M, 2] of the convex hull of points f64[N, 2], in order (Andrew's monotone chain)."""
    ordered = points[np.lexsort((points[:, 1], points[:, 0]))]

    def chain(sequence: NDArray[np.float64]) -> list[NDArray[np.float64]]:
        kept: list[NDArray[np.float64]] = []
        for point in sequence:
            while len(kept) > 1:
                (ax, ay), (bx, by) = kept[-1] - kept[-2], point - kept[-2]
                if ax * by - ay * bx > 0:
                    break
                kept.pop()
            kept.append(point)
        return kept[:-1]

    return np.array(chain(ordered) + chain(ordered[::-1]))
