"""``labels.html`` of an annotated scene: pictures of some frames beside what was made of them.

Columns: image; depth (near warm, far cold, darker where unsure); classes over the image, movers outlined in red; confidence of the
classes. What to look for: edges of the depth lie on edges of the image, the road has no steps, sky ends at the roofs.
"""

from __future__ import annotations

from html import escape
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from scipy import ndimage

from mudg.base import palette, store
from mudg.base.types import Frame, Scene
from mudg.data.scene import read_image, read_label
from mudg.report.contact_sheet import depth_colours

NAME: Final = "labels.html"
_FRAMES: Final = 6
_WIDTH_PX: Final = 480
_MOVER: Final = np.array([255, 40, 40], np.uint8)
_STYLE: Final = (
    "body{font:15px/1.45 system-ui,sans-serif;margin:2rem auto;max-width:1960px;padding:0 1rem;background:#14161a;color:#e6e6e6}"
    "img{width:100%;display:block}figure{margin:0 0 1.5rem}figcaption{padding:.3rem 0;color:#a9b0ba}"
    "span.key{display:inline-block;width:.9em;height:.9em;margin:0 .35em 0 1em;vertical-align:-.1em}"
)


def write_page(scene: Scene, made: set[str], out: Path) -> Path:
    """Write ``labels.html`` and ``pictures/``: some frames of every camera; ``made``: ids of frames that got labels."""
    rows: list[str] = []
    for camera in scene.cameras:
        frames = [frame for frame in scene.frames_of(camera) if frame.id in made] or list(scene.frames_of(camera))
        for index in np.unique(np.linspace(0, len(frames) - 1, _FRAMES).astype(int)) if frames else ():
            frame = frames[index]
            name = f"pictures/{frame.id.replace('/', '_')}.jpg"
            with store.atomic_path(out / name) as temporary:
                picture(scene, frame).save(temporary, "JPEG", quality=88)
            rows.append(
                f'<figure><figcaption>{escape(_caption(scene, frame))}</figcaption><img src="{name}" alt=""></figure>'
            )
    notes = "".join(f"<li>{escape(note)}</li>" for note in scene.source.notes)
    key = "".join(
        f'<span class="key" style="background:rgb({r},{g},{b})"></span>{escape(name)}'
        for name, (r, g, b) in zip(palette.CLASSES, palette.DISPLAY_COLORS.tolist(), strict=False)
    )
    title = escape(f"Labels of {scene.id}")
    store.write_text(
        out / NAME,
        f'<!doctype html><html lang="en"><meta charset="utf-8"><title>{title}</title><style>{_STYLE}</style><h1>{title}</h1>'
        f"<p>Image; depth (near warm, far cold, darker where unsure); classes, movers in red; confidence of the classes.</p>"
        f"<ul>{notes}</ul><p>{key}</p>{''.join(rows)}</html>\n",
    )
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
        colours = palette.encode(read_label(scene, frame, "semantics"), palette.DISPLAY_COLORS)
        panels[2] = (0.45 * rgb + 0.55 * colours).astype(np.uint8)
    if "dynamic" in frame.labels:
        mask = read_label(scene, frame, "dynamic").astype(bool)
        panels[2][mask & ~ndimage.binary_erosion(mask, iterations=max(1, rgb.shape[1] // 500))] = _MOVER
    if "semantics_confidence" in frame.labels:
        grey = (255 * read_label(scene, frame, "semantics_confidence")).astype(np.uint8)
        panels[3] = np.repeat(grey[..., None], 3, 2)
    height = max(1, round(rgb.shape[0] * _WIDTH_PX / rgb.shape[1]))
    small = [np.asarray(Image.fromarray(panel).resize((_WIDTH_PX, height), Image.Resampling.BOX)) for panel in panels]
    return Image.fromarray(np.concatenate(small, 1))


def _depth_picture(scene: Scene, frame: Frame) -> NDArray[np.uint8]:
    depth = read_label(scene, frame, "depth")
    known = np.isfinite(depth)
    colours = np.zeros((*depth.shape, 3), np.uint8)
    colours[known] = depth_colours(depth[known].astype(np.float64))
    if "depth_confidence" in frame.labels:
        sure = read_label(scene, frame, "depth_confidence")
        colours = (colours * (0.35 + 0.65 * sure[..., None])).astype(np.uint8)
    return colours
