"""Renders of a fitted scene: as an observation, and as what a generator may start from, with the certainty of every pixel."""

from __future__ import annotations

from dataclasses import asdict, dataclass, fields, replace
from typing import Any, Final, TypeVar

import torch
from torch import Tensor

from mudg.base import palette
from mudg.base.errors import UsageError
from mudg.base.types import Observation, Render, View
from mudg.core.raster.rasterize import Backend, RasterConfig, rasterize, refuse_settings
from mudg.models.scene.model import SceneModel, compose, composite_semantics, composite_sky
from mudg.stages.config.fit import DrawingConfig, FitConfig

NEAR_M = 0.2
DRAWING: Final = "drawing"
"""Fact of a fitted scene: settings of ``RasterConfig`` that it was fitted with and that change its pictures; not there: the usual ones."""
Rendered = TypeVar("Rendered")

_ROWS: Final = 128
"""Rows of an image whose classes are found together."""


@dataclass(frozen=True, slots=True, eq=False)
class RenderedCondition:
    """One rendered view.

    Args:
        rgb: f32[3, H, W] in [0, 1], over the sky.
        depth: f32[H, W], camera z in metres; NaN in the sky and where the scene is empty.
        alpha: f32[H, W] in [0, 1], how much of the pixel Gaussians cover; the rest is sky.
        semantics: u8[H, W] train ids, 255 = unknown.
        certainty: f32[H, W] in [0, 1], how well photographs and LiDAR constrain what the pixel shows; at most alpha, so 0 in the sky.
            None: unknown, for a scene fitted by a version that did not measure it.
    """

    rgb: Tensor
    depth: Tensor
    alpha: Tensor
    semantics: Tensor
    certainty: Tensor | None


def raster_of(model: SceneModel, backend: Backend = "auto", packed: bool = False) -> RasterConfig:
    """How a fitted scene is drawn: as it was while it was fitted."""
    return RasterConfig(backend=backend, near_m=NEAR_M, packed=packed, **model.facts.get(DRAWING, {}))


def drawing_facts(config: DrawingConfig) -> dict[str, Any]:
    """What a model notes of these settings: nothing if they are the usual ones."""
    chosen, usual = asdict(config), asdict(DrawingConfig())
    changed = {name: value for name, value in chosen.items() if name != "packed" and value != usual[name]}
    return {DRAWING: changed} if changed else {}


def check_drawing(config: FitConfig, device: torch.device) -> None:
    """Refuse before the work what no step could draw.

    Raises:
        UsageError: settings that exclude each other, that the backend of this device lacks, or that give no gradients for what is to
            be learnt.
    """
    wanted = config.drawing
    backend = config.raster if config.raster != "auto" else "gsplat" if device.type == "cuda" else "cpu"
    refuse_settings(backend, RasterConfig(backend=config.raster, near_m=NEAR_M, **asdict(wanted)))
    if (wanted.projection, wanted.primitive) != ("linear", "ellipsoid") and config.densify.kind == "gradient":
        raise UsageError("this way of drawing has no gradients of projected means, by which Gaussians are added",
                         where="--drawing", got=f"{wanted.projection}, {wanted.primitive}", remedy="add --densify.kind mcmc")  # fmt: skip
    if wanted.projection == "unscented" and config.appearance.cameras:
        raise UsageError("unscented projection has no gradients of camera poses", where="--appearance.cameras",
                         remedy="leave it out, or set --drawing.projection linear")  # fmt: skip

COVERED = 0.5
"""Opacity from which on a pixel is no sky."""


@torch.no_grad()
def render_view(
    model: SceneModel, view: View, raster: RasterConfig, source: str = ""
) -> Observation:
    """Render one view of a fitted scene as an observation of kind "virtual", on the CPU.

    Where coverage is below ``COVERED``: no depth (NaN), and semantics sky if the scene has a sky; what is classed as
    sky has no depth. Confidence is the coverage (1 where the sky is a valid answer).
    """
    return _brought_back(_observed(model, rasterize(compose(model, view.time_s), view, raster), view, source))


@torch.no_grad()
def render_condition(
    model: SceneModel, view: View, raster: RasterConfig | None = None
) -> RenderedCondition:
    """Render one view of a fitted scene with the certainty of its pixels, on the CPU; see ``render_view``."""
    gaussians, certainty = compose(model, view.time_s), model.certainty
    if certainty is not None:
        known = certainty.float()[:, None]
        gaussians = replace(
            gaussians, extra=known if gaussians.extra is None else torch.cat([gaussians.extra, known], 1)
        )
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
    tensors = {f.name: value for f in fields(made) if isinstance(value := getattr(made, f.name), Tensor)}
    if all(value.device.type == "cpu" for value in tensors.values()):
        return result
    return replace(made, **{name: value.cpu() for name, value in tensors.items()})


def _observed(model: SceneModel, render: Render, view: View, source: str = "") -> Observation:
    rgb = composite_sky(model, view, render.rgb, render.alpha).clamp(0, 1)
    covered = render.alpha >= COVERED
    depth = torch.where(covered, render.depth, torch.nan)
    semantics = None
    if render.extra is not None:
        rows = zip(render.extra.split(_ROWS, 1), render.alpha.split(_ROWS, 1), strict=True)  # no copy of all classes at once
        channel = torch.cat([composite_semantics(model, extra, alpha).max(0).indices for extra, alpha in rows])
        semantics = torch.tensor(model.classes).to(channel.device, non_blocking=True)[channel]
        if model.sky is not None:
            semantics = torch.where(covered[0], semantics, palette.ID["sky"])
            depth = torch.where(semantics[None] == palette.ID["sky"], torch.nan, depth)
    confidence = render.alpha if model.sky is None else torch.where(covered, render.alpha, 1 - render.alpha)
    source = source or str(model.facts.get("method", "fit"))
    return Observation(view, rgb, depth, semantics, confidence.clamp(0, 1), torch.ones_like(covered), "virtual", source)
