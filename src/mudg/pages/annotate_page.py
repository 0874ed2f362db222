"""``labels.html`` of an annotated scene: pictures of some frames beside what was made of them.

Columns: image; depth (near warm, far cold, darker where unsure); classes over the image, dynamic objects outlined in red; confidence
of the classes. What to look for: edges of the depth lie on edges of the image, the road has no steps, sky ends at the roofs.
"""

from __future__ import annotations

from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from scipy import ndimage

from mudg.base import palette, store
from mudg.base.types import Frame, Scene
from mudg.core.pictures import class_colors, depth_colors, gray, resize_area
from mudg.data.scene import read_image, read_label
from mudg.pages import html
from mudg.pages.contact_sheet import spread

NAME: Final = "labels.html"
_FRAMES: Final = 6
_WIDTH_PX: Final = 480
_OUTLINE: Final = np.array([255, 40, 40], np.uint8)


def write_page(scene: Scene, made: set[str], out: Path) -> Path:
    """Write ``labels.html`` and ``pictures/``: some frames of every camera; ``made``: ids of frames that got labels."""
    pictures: list[dict[str, str]] = []
    for camera in scene.cameras:
        labelled = [frame for frame in scene.frames_of(camera) if frame.id in made]
        for frame in spread(labelled or scene.frames_of(camera), _FRAMES):
            name = f"pictures/{frame.id.replace('/', '_')}.jpg"
            store.write_image(out / name, picture(scene, frame), quality=88)
            pictures.append({"file": name, "caption": _caption(scene, frame)})
    text = html.render(
        "labels.html.j2", title=f"Labels of {scene.id}", kicker="mudg annotate", notes=scene.source.notes, pictures=pictures,
        lead="Image; depth (near warm, far cold, darker where unsure); classes, with dynamic objects outlined in red; "
        "confidence of the classes.",
        class_legend=html.class_legend(),
    )  # fmt: skip
    store.write_text(out / NAME, text)
    return out / NAME


def _caption(scene: Scene, frame: Frame) -> str:
    parts = [frame.id, f"{frame.view.time_s:.2f} s"]
    if "depth" in frame.labels:
        depth = read_label(scene, frame, "depth")
        parts.append(f"depth known {100 * np.isfinite(depth).mean():.0f} %")
    if "semantics" in frame.labels:
        parts.append(
            f"classes known {100 * (read_label(scene, frame, 'semantics') != palette.UNLABELLED).mean():.0f} %"
        )
    return ", ".join(parts)


def picture(scene: Scene, frame: Frame) -> Image.Image:
    """Image, depth, classes and confidence beside each other; what a frame lacks is black."""
    rgb = read_image(scene, frame)
    panels = [rgb, np.zeros_like(rgb), np.zeros_like(rgb), np.zeros_like(rgb)]
    if "depth" in frame.labels:
        panels[1] = _depth_picture(scene, frame)
    if "semantics" in frame.labels:
        colors = class_colors(read_label(scene, frame, "semantics"))
        panels[2] = (0.45 * rgb + 0.55 * colors).astype(np.uint8)
    if "dynamic" in frame.labels:
        mask = read_label(scene, frame, "dynamic").astype(bool)
        panels[2][mask & ~ndimage.binary_erosion(mask, iterations=max(1, rgb.shape[1] // 500))] = _OUTLINE
    if "semantics_confidence" in frame.labels:
        panels[3] = gray(read_label(scene, frame, "semantics_confidence"))
    height = max(1, round(rgb.shape[0] * _WIDTH_PX / rgb.shape[1]))
    return Image.fromarray(np.concatenate([resize_area(panel, _WIDTH_PX, height) for panel in panels], 1))


def _depth_picture(scene: Scene, frame: Frame) -> NDArray[np.uint8]:
    colors = depth_colors(read_label(scene, frame, "depth"))
    if "depth_confidence" in frame.labels:
        sure = read_label(scene, frame, "depth_confidence")
        colors = (colors * (0.35 + 0.65 * sure[..., None])).astype(np.uint8)
    return colors
