"""Dynamic objects by themselves: their Gaussians alone, and where their boxes lie in a view."""

from __future__ import annotations

from dataclasses import replace

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
    """The rows of dynamic objects (node above 0), without class channels."""
    if gaussians.node is None:
        raise ValueError("the Gaussians have no node index")
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
    camera, grown_m = view.camera, BOX_GROWTH * np.asarray(size_m)
    corners = geometry.transform_points(view.cam_from_world @ world_from_object, geometry.box_corners(grown_m))
    if corners[:, 2].max() >= NEAREST_CORNER_M > corners[:, 2].min():
        return np.ones((camera.height, camera.width), bool)
    hull = geometry.box_hull(view, world_from_object, grown_m, NEAREST_CORNER_M)
    if hull is None:
        return None
    canvas = Image.new("1", (camera.width, camera.height))
    outline = [tuple(point) for point in (hull.points[hull.vertices] - 0.5).tolist()]
    ImageDraw.Draw(canvas).polygon(outline, fill=1, outline=1)
    return np.array(canvas, bool)
