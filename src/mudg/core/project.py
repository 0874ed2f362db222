"""Points into views: z-buffered sparse colour, depth and validity.

Used for LiDAR depth targets and for the diffusion model's condition. The pinhole model and the pixel grid are those of
``base.geometry.project``; tests hold the two together.

The published system paints objects over the background in a second pass; here both are composed by depth, so a car
behind a wall stays behind it. A far point that shines through the gaps of a sparsely sampled near surface is removed by
a second z-buffer in which every point is a square of ``occluder_m`` metres (``ProjectConfig.occluder_m``).
"""

from __future__ import annotations

import ctypes
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from mudg import native
from mudg.base.errors import InputError, UsageError
from mudg.base.palette import UNLABELLED
from mudg.base.types import FusedCloud, PointCloud, Track, View
from mudg.core.visible import RULES, seen_pixels
from mudg.core.zbuffer import DrawLimits, PointLayer, draw_points, pointer

_MAX_POINTS: Final = 2**31 - 1


@dataclass(frozen=True, kw_only=True)
class ProjectConfig:
    """How a fused cloud is drawn."""

    static_splat_px: float = 1.0
    """Side of the square that a static point covers, pixels (published: 2.5)."""
    object_splat_px: float = 1.0
    """The same for points of moving objects (published: 4)."""
    near_m: float = 0.1
    """Nearest depth drawn, metres."""
    far_m: float = 200.0
    """Farthest depth drawn, metres."""
    occluder_m: float = 0.0
    """Side of the square, metres, with which points hide what lies behind them; 0 switches the test off."""
    occluder_max_px: float = 9.0
    """Upper limit of that square, pixels."""

    def __post_init__(self) -> None:
        if not 0 < self.near_m < self.far_m:
            raise UsageError(
                "depth limits are out of order", expected="0 < near_m < far_m", got=f"{self.near_m}, {self.far_m}"
            )
        for name in ("static_splat_px", "object_splat_px", "occluder_max_px"):
            if not 0 < getattr(self, name) <= 1000:
                raise UsageError(f"{name} is out of range", expected="> 0 and <= 1000 px", got=str(getattr(self, name)))


@dataclass(frozen=True, slots=True, eq=False)
class SparseView:
    """A projected cloud.

    Args:
        color: f32[3, H, W] in [0, 1], 0 where not valid.
        depth: f32[1, H, W] camera z in metres, 0 where not valid.
        valid: bool[1, H, W].
        index: i32[H, W] number of the point seen (static points first, then the objects in order), -1 = none.
    """

    color: Tensor
    depth: Tensor
    valid: Tensor
    index: Tensor


def project_points(
    xyz: NDArray[np.float32],
    rgb: NDArray[np.uint8] | None,
    view: View,
    *,
    splat_px: float = 1.0,
    near_m: float = 0.1,
    far_m: float = 200.0,
) -> SparseView:
    """Draw world points into a view; the nearest wins, equal depths go to the lower index.

    Args:
        xyz: f32[N, 3] world metres; points that are not finite are not drawn.
        rgb: u8[N, 3], or None: colour stays 0.
        splat_px: side of the square of pixels that a point covers.
    """
    if xyz.ndim != 2 or xyz.shape[1] != 3:
        raise InputError("points have the wrong shape", expected="[N, 3]", got=str(xyz.shape))
    config = ProjectConfig(static_splat_px=splat_px, near_m=near_m, far_m=far_m)
    return _draw([PointLayer(xyz, np.eye(4), splat_px)], None if rgb is None else [rgb], view, config)


def project_cloud(
    cloud: FusedCloud,
    world_from_object: Mapping[str, NDArray[np.float64]],
    view: View,
    config: ProjectConfig | None = None,
) -> SparseView:
    """Draw a fused cloud, its objects placed at the given poses, composed by depth, in the colours of the view's camera.

    Args:
        cloud: the static world and one cloud per object in its box frame.
        world_from_object: track id -> f64[4, 4] at the view's time; objects without a pose are absent.
    """
    config = config or ProjectConfig()
    layers = [PointLayer(cloud.static.xyz, np.eye(4), config.static_splat_px)]
    colors: list[NDArray[np.uint8]] = [cloud.static.rgb]
    for name, points in drawn_objects(cloud, world_from_object):
        layers.append(PointLayer(points.xyz, world_from_object[name], config.object_splat_px))
        colors.append(points.rgb)
    drawn = _draw(layers, colors, view, config)
    shown = cloud.colors.image_of(view.camera.name, drawn.color)
    return drawn if shown is drawn.color else replace(drawn, color=shown.clamp(0, 1) * drawn.valid)


def drawn_objects(
    cloud: FusedCloud, world_from_object: Mapping[str, NDArray[np.float64]]
) -> list[tuple[str, PointCloud]]:
    """The object clouds that have a pose, in the order in which ``SparseView.index`` counts them."""
    return [(name, points) for name, points in cloud.objects.items() if name in world_from_object]


def _draw(
    layers: Sequence[PointLayer], colors: Sequence[NDArray[np.uint8]] | None, view: View, config: ProjectConfig
) -> SparseView:
    camera = view.camera
    total = sum(len(layer.xyz) for layer in layers)
    if total > _MAX_POINTS:
        raise InputError("too many points for one view", expected=f"<= {_MAX_POINTS}", got=str(total))
    depth, index = draw_points(layers, view, DrawLimits(config.near_m, config.far_m))
    if config.occluder_m > 0:
        nearest, _ = draw_points(layers, view, DrawLimits(config.near_m, config.far_m, config.occluder_m, config.occluder_max_px))
        hidden = RULES["drawn"].hides(nearest, depth)
        depth[hidden], index[hidden] = 0.0, -1
    color = np.zeros((3, camera.height, camera.width), np.float32)
    first = 0
    for rgb in colors or ():
        _paint(index, rgb, first, color)
        first += len(rgb)
    return SparseView(
        torch.from_numpy(color),
        torch.from_numpy(depth)[None],
        torch.from_numpy(index >= 0)[None],
        torch.from_numpy(index),
    )


def _paint(index: NDArray[np.int32], rgb: NDArray[np.uint8], first: int, color: NDArray[np.float32]) -> None:
    """Write the colours of points first .. first + len(rgb) into ``color`` f32[3, H, W] where they are seen."""
    library = native.library()
    if library is not None:
        table = np.ascontiguousarray(rgb)
        library.mudg_zbuffer_color(
            pointer(index),
            ctypes.c_int64(index.size),
            pointer(table),
            ctypes.c_int64(first),
            ctypes.c_int64(len(table)),
            pointer(color),
        )
        return
    mine = (index >= first) & (index < first + len(rgb))
    color[:, mine] = (rgb[index[mine] - first].astype(np.float32) / np.float32(255)).T


@dataclass(frozen=True, slots=True, eq=False)
class ProjectedPoints:
    """A projected cloud: rgb f32[3,H,W] in [0,1], depth f32[H,W] m, valid bool[H,W], moving bool[H,W] (points of objects),
    semantics u8[H,W] (255 = unknown)."""

    rgb: Tensor
    depth: Tensor
    valid: Tensor
    moving: Tensor
    semantics: Tensor


def project_sparse(cloud: FusedCloud, tracks: Sequence[Track], view: View, config: ProjectConfig, *, hide: bool) -> ProjectedPoints:
    """Project a fused cloud into a view, its objects where they are at that time.

    Args:
        hide: leave points out that shine through gaps between nearer ones (`core.visible`, rule `condition`).
    """
    poses = {track.id: track.pose_at(view.time_s) for track in tracks if track.id in cloud.objects}
    placed = {name: pose for name, pose in poses.items() if pose is not None}
    seen = project_cloud(cloud, placed, view, config)
    valid = seen.valid[0]
    if hide:
        valid = torch.from_numpy(seen_pixels(seen.depth[0].numpy(), valid.numpy(), RULES["condition"]))
    clouds = [cloud.static, *(points for _, points in drawn_objects(cloud, placed))]
    unknown = np.uint8(UNLABELLED)
    ids = [np.full(len(c), unknown) if c.semantics is None else c.semantics for c in clouds]
    table = torch.from_numpy(np.append(np.concatenate(ids), unknown))  # index -1 finds the appended one
    moving = (seen.index >= len(cloud.static)) & valid
    return ProjectedPoints(seen.color, seen.depth[0], valid, moving, table[seen.index.long()])
