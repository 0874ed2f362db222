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
from mudg.models.nodes import RigidNode, SceneModel

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
    """Bool[1, H, W]: inside the outline of some object's box (slightly grown). A box that reaches behind the camera covers all."""
    camera = view.camera
    canvas = Image.new("1", (camera.width, camera.height))
    draw = ImageDraw.Draw(canvas)
    for node in model.nodes:
        if not isinstance(node, RigidNode):
            continue
        pose = node.pose_matrix(view.time_s)
        if pose is None:
            continue
        uv, z = geometry.project(view, geometry.transform_points(pose, _corners(node.size_m)))
        if z.max() < NEAREST_CORNER_M:
            continue
        if z.min() < NEAREST_CORNER_M:
            draw.rectangle([0, 0, camera.width, camera.height], fill=1)
            break
        outline = [tuple(point) for point in convex_outline(uv - 0.5).tolist()]
        draw.polygon(outline, fill=1, outline=1)
    return torch.from_numpy(np.array(canvas, bool))[None]


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
