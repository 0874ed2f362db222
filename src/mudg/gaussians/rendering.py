"""Renders of a fitted scene: as an observation, and as what a generator may start from, with the certainty of every
pixel."""

from __future__ import annotations

from dataclasses import asdict, dataclass, fields, replace
from typing import Any, Final, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image, ImageDraw
from torch import Tensor

from mudg.base import geometry, palette
from mudg.base.types import Gaussians, Observation, Render, RenderPlanes, View
from mudg.core.raster.rasterize import Backend, RasterConfig, rasterize
from mudg.core.trajectory import Readout
from mudg.gaussians.model import SceneModel, compose, compose_as_read, composite_semantics, composite_sky
from mudg.gaussians.nodes import RigidNode
from mudg.gaussians.settings import DrawingConfig

# dynamic objects by themselves: their Gaussians alone, and where their boxes lie in a view --------

BOX_GROWTH = 1.05
NEAREST_CORNER_M = 0.3


def objects_only(gaussians: Gaussians) -> Gaussians:
    """The rows of dynamic objects (node above 0), without class channels."""
    return rows_of(gaussians, gaussians.node > 0)


def rows_of(gaussians: Gaussians, rows: Tensor) -> Gaussians:
    """Some rows bool[N], without class channels."""
    columns = {field.name: getattr(gaussians, field.name) for field in fields(gaussians)}
    chosen = {name: None if value is None else value[rows] for name, value in columns.items() if name != "extra"}
    return replace(gaussians, **chosen, extra=None)


def boxes_in_view(model: SceneModel, view: View) -> Tensor:
    """Bool[1, H, W]: inside the outline of some object's box (slightly grown)."""
    inside = np.zeros((view.camera.height, view.camera.width), bool)
    for node in model.nodes:
        if isinstance(node, RigidNode) and (pose := node.pose_matrix(view.time_s)) is not None:
            mask = outline_mask(view, pose, node.size_m)
            inside = inside if mask is None else inside | mask
    return torch.from_numpy(inside)[None]


def outline_mask(
    view: View, world_from_object: NDArray[np.float64], size_m: tuple[float, ...]
) -> NDArray[np.bool_] | None:
    """Bool[H, W]: inside the outline of a box, slightly grown. None: nothing of it is in view. A box that reaches
    behind the camera covers everything."""
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


# rendering ----------------------------------------------------------------------------------------

NEAR_M = 0.2
DRAWING: Final = "drawing"
"""Fact of a fitted scene: settings of ``RasterConfig`` that it was fitted with and that change its pictures; not there:
the usual ones."""
Rendered = TypeVar("Rendered")

_ROWS: Final = 128
"""Rows of an image whose classes are found together."""


@dataclass(frozen=True, slots=True, eq=False)
class RenderedCondition:
    """One rendered view. ``rgb``: f32[3, H, W] in [0, 1], over the sky. ``depth``: f32[H, W], camera z in metres; NaN
    in the sky and where the scene is empty. ``alpha``: f32[H, W] in [0, 1], how much of the pixel Gaussians cover; the
    rest is sky. ``semantics``: u8[H, W] train ids, 255 = unknown. ``certainty``: f32[H, W] in [0, 1], how well
    photographs and LiDAR constrain what the pixel shows; at most alpha, so 0 in the sky. None: unknown, for a scene
    fitted by a version that did not measure it."""

    rgb: Tensor
    depth: Tensor
    alpha: Tensor
    semantics: Tensor
    certainty: Tensor | None

    def sure(self) -> Tensor:
        """The certainty f32[H, W]; half of what is covered where none was measured, 0 without depth."""
        known = 0.5 * self.alpha if self.certainty is None else self.certainty
        return torch.where(torch.isfinite(self.depth), known, 0.0)


def raster_of(model: SceneModel, backend: Backend = "auto") -> RasterConfig:
    """How a fitted scene is drawn: as it was while it was fitted."""
    return RasterConfig(backend=backend, near_m=NEAR_M, **model.facts.get(DRAWING, {}))


def drawing_facts(config: DrawingConfig) -> dict[str, Any]:
    """What a model notes of these settings: nothing if they are the usual ones."""
    return {DRAWING: asdict(config)} if config != DrawingConfig() else {}


COVERED = 0.5
"""Opacity from which on a pixel is no sky."""


@torch.no_grad()
def render_view(
    model: SceneModel, view: View, raster: RasterConfig, source: str = "", readout: Readout | None = None
) -> Observation:
    """Render one view of a fitted scene as an observation of kind "virtual", on the CPU. ``readout``: as the view's
    rolling shutter shows it; None: as a global one does.

    Where coverage is below ``COVERED``: no depth (NaN), and semantics sky if the scene has a sky; what is classed as
    sky has no depth. Confidence is the coverage (1 where the sky is a valid answer).
    """
    drawn = rasterize(compose_as_read(model, view, readout), view, raster)
    return _brought_back(_observed(model, drawn, view, source))


@torch.no_grad()
def render_condition(
    model: SceneModel, view: View, raster: RasterConfig | None = None, composed: Gaussians | None = None
) -> RenderedCondition:
    """Render one view of a fitted scene with the certainty of its pixels, on the CPU; see ``render_view``.
    ``composed``: what ``compose`` made of the model at the view's time, if it is at hand."""
    gaussians, certainty = compose(model, view.time_s) if composed is None else composed, model.certainty
    if certainty is not None:
        known = [gaussians.extra, certainty.float()[:, None]]
        gaussians = replace(gaussians, extra=torch.cat([part for part in known if part is not None], 1))
    render = rasterize(gaussians, view, raster or raster_of(model))
    blended = None
    if certainty is not None and render.extra is not None:
        blended = torch.minimum(render.extra[-1].clamp_min(0), render.alpha[0])
        render = replace(render, extra=render.extra[:-1] if len(render.extra) > 1 else None)
    seen = _observed(model, render, view)
    shape = render.alpha.shape[1:]
    depth = render.alpha.new_full(shape, torch.nan) if seen.depth is None else seen.depth[0]
    unknown = render.alpha.new_full(shape, palette.UNLABELLED, dtype=torch.uint8)
    semantics = unknown if seen.semantics is None else seen.semantics.to(torch.uint8)
    return _brought_back(RenderedCondition(seen.rgb, depth, render.alpha[0], semantics, blended))


def _brought_back(result: Rendered) -> Rendered:
    """The same with its tensors on the CPU: the one place where pictures leave the device."""
    made: Any = result
    tensors = {f.name: value.cpu() for f in fields(made) if isinstance(value := getattr(made, f.name), Tensor)}
    return replace(made, **tensors)


def _observed(model: SceneModel, render: Render, view: View, source: str = "") -> Observation:
    rgb = composite_sky(model, view, render.rgb, render.alpha).clamp(0, 1)
    covered = render.alpha >= COVERED
    depth = torch.where(covered, render.depth, torch.nan)
    semantics = None
    if render.extra is not None:
        # no copy of all classes at once
        rows = zip(render.extra.split(_ROWS, 1), render.alpha.split(_ROWS, 1), strict=True)
        channel = torch.cat([composite_semantics(model, extra, alpha).max(0).indices for extra, alpha in rows])
        semantics = torch.tensor(model.classes).to(channel.device, non_blocking=True)[channel]
        if model.sky is not None:
            semantics = torch.where(covered[0], semantics, palette.ID["sky"])
            depth = torch.where(semantics[None] == palette.ID["sky"], torch.nan, depth)
    confidence = render.alpha if model.sky is None else torch.where(covered, render.alpha, 1 - render.alpha)
    source = source or str(model.facts.get("method", "fit"))
    return Observation(view, rgb, depth, semantics, confidence.clamp(0, 1), torch.ones_like(covered), "virtual", source)


# renders of a fitted scene as the diffusion model's condition holds them --------------------------

FAR_M = 1000.0
"""Depth of the sky and of what the scene does not cover."""


def render_planes(model: SceneModel, view: View) -> RenderPlanes:
    """What a fitted scene, on any device, shows at a view: on the CPU, without the leading dimension. In the sky
    coverage and certainty are 0."""
    seen = render_condition(model, view)
    alpha = torch.where(torch.isfinite(seen.depth), seen.alpha, 0.0)
    depth = seen.depth.nan_to_num(FAR_M).clamp(max=FAR_M)
    return RenderPlanes(seen.rgb, *(x.clamp(min=0)[None] for x in (depth, alpha, seen.sure())), seen.semantics[None])
