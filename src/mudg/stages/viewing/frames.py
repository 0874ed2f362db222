"""Exact frames and videos for the viewer page: what a browser asks for, checked, and drawn by the rasterizer."""

from __future__ import annotations

import io
import threading
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Annotated, Final, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image
from pydantic import Field

from mudg.base import store
from mudg.base.errors import InputError, ResourceError
from mudg.base.records import Number, StrictRecord
from mudg.base.types import Camera, Observation, Scene, View
from mudg.core.pictures import class_colors, depth_colors, to_bytes
from mudg.data.clips.weathered import InWeather
from mudg.data.exporters.video import mp4_bytes
from mudg.models.scene.model import SceneModel
from mudg.pages.page import FAR_M, NEAR_M
from mudg.stages.editing.carried import FACT
from mudg.stages.editing.weathered import Drawer, conditions_of, in_weather, weather_of
from mudg.stages.fitting.rendering import raster_of, render_view

LAYERS: Final = ("color", "depth", "class")
VIDEO_CRF: Final = 18
"""x264's quality of videos; lower is better."""
MOST_FRAMES: Final = 3000
MOST_PIXELS: Final = 2**31
"""Of all frames of a video together: it is held in memory until it is sent, in about a tenth as many bytes."""
Vector = Annotated[list[Number], Field(min_length=3, max_length=3)]


class Wanted(StrictRecord):
    """What all frames of a question have in common. ``edits``: a script."""

    scene: Annotated[int, Field(ge=0)]
    layer: Literal["color", "depth", "class"]
    hidden: Annotated[list[str], Field(max_length=100_000)]
    edits: Annotated[str, Field(max_length=1_000_000)] = ""
    camera: str
    width: Annotated[int, Field(ge=1, le=8192)]
    height: Annotated[int, Field(ge=1, le=8192)]
    fx: Annotated[Number, Field(gt=0)]
    fy: Annotated[Number, Field(gt=0)]
    cx: Number
    cy: Number


class Moment(StrictRecord):
    """When and from where. ``axes``: the camera's right, down and ahead in the world."""

    time_s: Number
    eye: Vector
    axes: Annotated[list[Vector], Field(min_length=3, max_length=3)]


class FrameRequest(Wanted, Moment):
    """One frame, as ``assets/viewer/exact.js`` asks for it."""


class VideoRequest(Wanted):
    """A video, as ``assets/viewer/exact.js`` asks for it: a frame per moment."""

    fps: Annotated[Number, Field(ge=1, le=60)]
    moments: Annotated[list[Moment], Field(min_length=1, max_length=MOST_FRAMES)]


@dataclass(frozen=True, slots=True)
class _Shown:
    """The scenes with a script carried out, on the device, and the weather of those that were asked for in colour, by their number."""

    edits: str
    models: list[SceneModel]
    weather: dict[int, InWeather]


def _drawer_of(model: SceneModel) -> Drawer:
    raster = raster_of(model)
    return lambda view: render_view(model, view, raster)


class FrameSource:
    """Draws frames of one or two fitted scenes, one at a time.

    Args:
        edited: the scenes with a script carried out; "" = as they are. scene: the log; its recorded views tell the light of the drive,
            where a script asks for other weather or light.
        widest: pixels of the widest frame.
    """

    def __init__(self, edited: Callable[[str], Sequence[SceneModel]], scene: Scene, widest: int, device: torch.device) -> None:
        self._edited = edited
        self._scene = scene
        self._device = device
        self._shown: _Shown | None = None
        self._widest = widest
        self._lock = threading.Lock()
        self._filming = threading.Lock()

    def png(self, asked: FrameRequest) -> bytes:
        """A frame as PNG bytes.

        Raises:
            InputError: a camera that is none, or edits that cannot be carried out.
        """
        content = io.BytesIO()
        picture = self._picture(asked.layer, self._drawer(asked), View(self._camera(asked), _pose(asked), float(asked.time_s)))
        Image.fromarray(picture).save(content, "PNG", compress_level=1)
        return content.getvalue()

    def film(self, asked: VideoRequest, send: Callable[[bytes], None]) -> None:
        """Make a video and send it: after each frame a line of JSON with its number, then one with the number of bytes, then the MP4
        file. Frames that are asked for meanwhile are drawn in between.

        Raises:
            InputError: as ``png``, or too many pixels. ResourceError: another video is being made. OSError: of ``send``; nothing is left.
        """
        camera, count = self._camera(asked), len(asked.moments)
        if camera.width * camera.height * count > MOST_PIXELS:
            raise InputError(
                "the video is too large",
                where="video",
                expected=f"at most {MOST_PIXELS:,} pixels in all frames together",
                got=f"{count} frames of {camera.width} x {camera.height}",
                remedy="start mudg view with a smaller --width-px, or use mudg render",
            )
        if not self._filming.acquire(blocking=False):
            raise ResourceError("another video is being made", remedy="wait for it, or cancel it where it was asked for")
        try:
            content = mp4_bytes(self._pictures(asked, camera, send), asked.fps, crf=VIDEO_CRF)
        finally:
            self._filming.release()
        send(_line(bytes=len(content)))
        send(content)

    def _pictures(self, asked: VideoRequest, camera: Camera, send: Callable[[bytes], None]) -> Iterator[NDArray[np.uint8]]:
        draw = self._drawer(asked)
        for number, moment in enumerate(asked.moments, 1):
            yield self._picture(asked.layer, draw, View(camera, _pose(moment), float(moment.time_s)))
            send(_line(frame=number, frames=len(asked.moments)))

    def _drawer(self, asked: Wanted) -> Drawer:
        """What draws the scene that is asked for, without what is hidden, in the weather and light of the script."""
        with self._lock:
            if self._shown is None or self._shown.edits != asked.edits:
                self._shown = _Shown(asked.edits, [model.to(self._device) for model in self._edited(asked.edits)], {})
            index = min(asked.scene, len(self._shown.models) - 1)
            model = self._shown.models[index]
            gone = [name for name in asked.hidden if name in model.node_names()]
            draw = _drawer_of(model.without_nodes(gone) if gone else model)
            conditions = conditions_of(model.facts.get(FACT, {}).get("script", ()))
            if conditions is None or asked.layer != "color":
                return draw
            if index not in self._shown.weather:
                self._shown.weather[index] = weather_of(_drawer_of(model), conditions, self._scene)
            return in_weather(draw, self._shown.weather[index])

    def _picture(self, layer: str, draw: Drawer, view: View) -> NDArray[np.uint8]:
        with self._lock:
            return _colors(draw(view), layer)

    def _camera(self, asked: Wanted) -> Camera:
        """The camera, not wider than allowed."""
        camera = Camera(asked.camera or "free", asked.width, asked.height, asked.fx, asked.fy, asked.cx, asked.cy)
        if asked.width > self._widest:
            camera = camera.resized(self._widest, max(1, round(asked.height * self._widest / asked.width)))
        return camera


def _pose(asked: Moment) -> NDArray[np.float64]:
    """World from camera, f64[4, 4]."""
    pose = np.eye(4)
    pose[:3, :3] = orthonormal(np.array(asked.axes, np.float64).T)
    pose[:3, 3] = asked.eye
    return pose


def _line(**values: int) -> bytes:
    return store.json_text(values, indent=None).encode() + b"\n"


def orthonormal(axes: NDArray[np.float64]) -> NDArray[np.float64]:
    """The nearest rotation: axes come with the rounding of a browser's sums."""
    left, _, right = np.linalg.svd(axes)
    return left @ right


def _colors(seen: Observation, layer: str) -> NDArray[np.uint8]:
    if layer == "depth" and seen.depth is not None:
        return depth_colors(seen.depth[0].numpy(), NEAR_M, FAR_M)
    if layer == "class" and seen.semantics is not None:
        return class_colors(seen.semantics.numpy())
    return to_bytes(seen.rgb)
