"""A scene from above: points, the recorded path, boxes and their courses."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from mudg.base import geometry
from mudg.base.types import Scene
from mudg.data.scene.motion import VEHICLES

GROUND_COLOR: Final = (18, 18, 18)
TEXT_COLOR: Final = (235, 235, 235)
VEHICLE_COLOR: Final = (80, 255, 120)
PEOPLE_COLOR: Final = (235, 130, 255)
OTHER_COLOR: Final = (150, 205, 255)
FRONT_COLOR: Final = (255, 80, 80)
PATH_COLOR: Final = (60, 200, 255)
_COURSE_COLOR: Final = (150, 110, 60)
_MARGIN_M: Final = 8.0

PEOPLE: Final = frozenset(
    ("pedestrian", "person", "person_sitting", "person (sitting)", "cyclist", "rider", "motorcyclist", "bicyclist", "stroller",
     "wheelchair")
)  # fmt: skip

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class TopView:
    """What a view from above shows.

    Args:
        xyz: points f64[N, 3] in the world. rgb: their colours u8[N, 3]; higher points lie over lower ones.
        boxes: id of a track -> ``world_from_object`` of its box, or None for its course alone. caption: upper left.
        dot_px: side of a point, pixels. outer_percent: of the points on each side that need not fit into the picture.
    """

    xyz: Floats
    rgb: NDArray[np.uint8]
    boxes: Mapping[str, Floats | None]
    caption: str
    dot_px: int = 1
    outer_percent: float = 4.0


def draw_top_view(scene: Scene, content: TopView, width: int, height: int) -> Image.Image:
    """Draw a scene from above into a picture of this size, x to the right, y up."""
    path = scene.ego.world_from_ego[:, :3, 3]
    tracks = [track for track in scene.tracks if track.id in content.boxes]
    places = [content.xyz] if len(content.xyz) else [track.world_from_object[:, :3, 3] for track in tracks]
    around = np.concatenate([path[:, :2], *(xyz[:, :2] for xyz in places)])
    low, high = np.percentile(around, [content.outer_percent, 100 - content.outer_percent], axis=0)
    low, high = np.minimum(low, path[:, :2].min(0)) - _MARGIN_M, np.maximum(high, path[:, :2].max(0)) + _MARGIN_M
    scale = float(min(width / (high[0] - low[0]), height / (high[1] - low[1])))
    middle = (low + high) / 2

    def pixels(xyz: Floats) -> Floats:
        return (xyz[:, :2] - middle) * [scale, -scale] + [width / 2, height / 2]

    image = Image.fromarray(_points(pixels(content.xyz), content, width, height))
    draw = ImageDraw.Draw(image)
    for track in tracks:
        draw.line(pairs(pixels(track.world_from_object[:, :3, 3])), fill=_COURSE_COLOR)
        pose = content.boxes[track.id]
        if pose is not None:
            corners = pixels(geometry.transform_points(pose, geometry.box_corners(track.size_m)[[0, 2, 6, 4]]))
            draw.polygon(pairs(corners), outline=box_color(track.label))
            draw.line(pairs(corners[[2, 3]]), fill=FRONT_COLOR, width=2)
    if len(path) > 1:
        draw.line(pairs(pixels(path)), fill=PATH_COLOR, width=2)
    start = pixels(path[:1])[0]
    draw.ellipse((start[0] - 4, start[1] - 4, start[0] + 4, start[1] + 4), outline=PATH_COLOR)
    draw.line((10, height - 12, 10 + 10 * scale, height - 12), fill=TEXT_COLOR, width=2)
    draw.text((10, height - 28), "10 m", fill=TEXT_COLOR)
    _legend(draw, width, height)
    draw_caption(draw, content.caption)
    return image


def _points(uv: Floats, content: TopView, width: int, height: int) -> NDArray[np.uint8]:
    canvas = np.full((height, width, 3), GROUND_COLOR, np.uint8)
    order = np.argsort(content.xyz[:, 2], kind="stable")
    order = order[((uv[order] >= 0) & (uv[order] < [width, height])).all(1)]
    for down, right in np.ndindex(content.dot_px, content.dot_px):
        rows, columns = uv[order, 1].astype(int) + down, uv[order, 0].astype(int) + right
        canvas[rows.clip(0, height - 1), columns.clip(0, width - 1)] = content.rgb[order]
    return canvas


def _legend(draw: ImageDraw.ImageDraw, width: int, height: int) -> None:
    """What the colours mean, at the lower right."""
    entries = (
        ("vehicles", VEHICLE_COLOR), ("people", PEOPLE_COLOR), ("other boxes", OTHER_COLOR), ("fronts", FRONT_COLOR),
        ("path", PATH_COLOR),
    )  # fmt: skip
    left = width - 12 - sum(draw.textlength(text) + 14 for text, _ in entries)
    draw.rectangle((left - 6, height - 32, width - 6, height - 8), fill=GROUND_COLOR)
    for text, color in entries:
        draw.text((left, height - 28), text, fill=color)
        left += draw.textlength(text) + 14


def draw_caption(draw: ImageDraw.ImageDraw, text: str) -> None:
    """A line of text on a dark ground in the upper left corner."""
    left, top, right, bottom = draw.textbbox((4, 3), text)
    draw.rectangle((left - 3, top - 2, right + 3, bottom + 2), fill=GROUND_COLOR)
    draw.text((4, 3), text, fill=TEXT_COLOR)


def box_color(label: str) -> tuple[int, int, int]:
    """Colour of a class of boxes."""
    return VEHICLE_COLOR if label in VEHICLES else PEOPLE_COLOR if label in PEOPLE else OTHER_COLOR


def pairs(points: Floats) -> list[tuple[float, float]]:
    """Points f64[N, 2] as Pillow takes them."""
    return [(float(x), float(y)) for x, y in points]
