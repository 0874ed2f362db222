"""Exact frames for the viewer page: what a browser asks for, checked, and drawn by the rasterizer."""

from __future__ import annotations

import io
import threading
from collections.abc import Callable, Sequence
from typing import Annotated, Any, Final, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image
from pydantic import Field

from mudg.base.records import Number, StrictRecord
from mudg.base.types import Camera, View
from mudg.core.pictures import class_colors, depth_colors, to_bytes
from mudg.models.scene.model import SceneModel
from mudg.report.page import FAR_M, NEAR_M
from mudg.stages.fitting.rendering import raster_of, render_view

LAYERS: Final = ("color", "depth", "class")
Vector = Annotated[list[Number], Field(min_length=3, max_length=3)]


class FrameRequest(StrictRecord):
    """One frame, as ``assets/viewer/exact.js`` asks for it. ``axes``: the camera's right, down and ahead in the world. ``edits``: a
    script."""

    scene: Annotated[int, Field(ge=0)]
    layer: Literal["color", "depth", "class"]
    time_s: Number
    hidden: Annotated[list[str], Field(max_length=100_000)]
    edits: Annotated[str, Field(max_length=1_000_000)] = ""
    camera: str
    width: Annotated[int, Field(ge=1, le=8192)]
    height: Annotated[int, Field(ge=1, le=8192)]
    fx: Annotated[Number, Field(gt=0)]
    fy: Annotated[Number, Field(gt=0)]
    cx: Number
    cy: Number
    eye: Vector
    axes: Annotated[list[Vector], Field(min_length=3, max_length=3)]


class FrameSource:
    """Draws frames of one or two fitted scenes, one at a time.

    Args:
        edited: the scenes with a script carried out; "" = as they are.
    """

    def __init__(self, edited: Callable[[str], Sequence[SceneModel]], widest: int, device: torch.device) -> None:
        self._edited = edited
        self._device = device
        self._shown: tuple[str, list[SceneModel]] | None = None
        self._widest = widest
        self._lock = threading.Lock()

    def png(self, asked: FrameRequest) -> bytes:
        """A frame as PNG bytes.

        Raises:
            InputError: a camera that is none, or edits that cannot be carried out.
        """
        with self._lock, torch.no_grad():
            if self._shown is None or self._shown[0] != asked.edits:
                self._shown = asked.edits, [model.to(self._device) for model in self._edited(asked.edits)]
            models = self._shown[1]
            model = models[min(asked.scene, len(models) - 1)]
            gone = [name for name in asked.hidden if name in model.node_names()]
            shown = model.without_nodes(gone) if gone else model
            seen = render_view(shown, self._view(asked), raster_of(model))
        content = io.BytesIO()
        Image.fromarray(_picture(seen, asked.layer)).save(content, "PNG", compress_level=1)
        return content.getvalue()

    def _view(self, asked: FrameRequest) -> View:
        """The camera, not wider than allowed."""
        camera = Camera(asked.camera or "free", asked.width, asked.height, asked.fx, asked.fy, asked.cx, asked.cy)
        if asked.width > self._widest:
            camera = camera.resized(self._widest, max(1, round(asked.height * self._widest / asked.width)))
        pose = np.eye(4)
        pose[:3, :3] = orthonormal(np.array(asked.axes, np.float64).T)
        pose[:3, 3] = asked.eye
        return View(camera, pose, float(asked.time_s))


def orthonormal(axes: NDArray[np.float64]) -> NDArray[np.float64]:
    """The nearest rotation: axes come with the rounding of a browser's sums."""
    left, _, right = np.linalg.svd(axes)
    return left @ right


def _picture(seen: Any, layer: str) -> NDArray[np.uint8]:
    if layer == "depth" and seen.depth is not None:
        return depth_colors(seen.depth[0].numpy(), NEAR_M, FAR_M)
    if layer == "class" and seen.semantics is not None:
        return class_colors(seen.semantics.numpy())
    return to_bytes(seen.rgb)
