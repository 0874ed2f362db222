"""A picture of a whole scene for a first look: some frames of each camera with LiDAR and boxes drawn in, and a view
from above.

What to look for: points lie on the surfaces they belong to (edges of posts and cars), boxes sit on their objects, and
standing things stay single lines from above. Near points are warm, far ones cold; boxes of vehicles are green, of
people violet, of all else light blue, and the edges of their fronts red.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Final

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from mudg.base import geometry
from mudg.base.types import Frame, Scene, Sweep, Track, View
from mudg.core.pictures import depth_colors, resize_area
from mudg.scene.motion import VEHICLES
from mudg.scene.read import read_image, read_points, spread, sweeps_beside

Floats = NDArray[np.float64]

# a scene from above: points, the recorded path, boxes and their courses ---------------------------

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
    "pedestrian person person_sitting cyclist rider motorcyclist bicyclist stroller wheelchair".split()
) | {"person (sitting)"}


def draw_top_view(
    scene: Scene,
    size: tuple[int, int],
    xyz: Floats,
    rgb: NDArray[np.uint8],
    boxes: Mapping[str, Floats | None],
    caption: str,
    *,
    dot_px: int = 1,
    outer_percent: float = 4.0,
) -> Image.Image:
    """Draw a scene from above, x to the right, y up. ``size``: width and height of the picture. ``xyz``: points
    f64[N, 3] in the world. ``rgb``: their colours u8[N, 3]; higher points lie over lower ones. ``boxes``: id of a track
    -> ``world_from_object`` of its box, or None for its course alone. ``caption``: upper left. ``dot_px``: side of a
    point, pixels. ``outer_percent``: of the points on each side that need not fit into the picture."""
    path, (width, height) = scene.ego.world_from_ego[:, :3, 3], size
    tracks = [track for track in scene.tracks if track.id in boxes]
    places = [xyz] if len(xyz) else [track.world_from_object[:, :3, 3] for track in tracks]
    around = np.concatenate([path[:, :2], *(one[:, :2] for one in places)])
    low, high = np.percentile(around, [outer_percent, 100 - outer_percent], axis=0)
    low, high = np.minimum(low, path[:, :2].min(0)) - _MARGIN_M, np.maximum(high, path[:, :2].max(0)) + _MARGIN_M
    scale = float(min(width / (high[0] - low[0]), height / (high[1] - low[1])))
    middle = (low + high) / 2
    pixels = lambda xyz: (xyz[:, :2] - middle) * [scale, -scale] + [width / 2, height / 2]
    canvas, uv = np.full((height, width, 3), GROUND_COLOR, np.uint8), pixels(xyz)
    order = np.argsort(xyz[:, 2], kind="stable")
    order = order[((uv[order] >= 0) & (uv[order] < [width, height])).all(1)]
    for down, right in np.ndindex(dot_px, dot_px):
        rows, columns = uv[order, 1].astype(int) + down, uv[order, 0].astype(int) + right
        canvas[rows.clip(0, height - 1), columns.clip(0, width - 1)] = rgb[order]
    image = Image.fromarray(canvas)
    draw = ImageDraw.Draw(image)
    for track in tracks:
        draw.line(pairs(pixels(track.world_from_object[:, :3, 3])), fill=_COURSE_COLOR)
        pose = boxes[track.id]
        if pose is not None:
            corners = pixels(geometry.transform_points(pose, geometry.box_corners(track.size_m)[[0, 2, 6, 4]]))
            draw.polygon(pairs(corners), outline=box_color(track.label))
            draw.line(pairs(corners[[2, 3]]), fill=FRONT_COLOR, width=2)
    if len(path) > 1:
        draw.line(pairs(pixels(path)), fill=PATH_COLOR, width=2)
    x, y = pixels(path[:1])[0]
    draw.ellipse((x - 4, y - 4, x + 4, y + 4), outline=PATH_COLOR)
    draw.line((10, height - 12, 10 + 10 * scale, height - 12), fill=TEXT_COLOR, width=2)
    draw.text((10, height - 28), "10 m", fill=TEXT_COLOR)
    _legend(draw, width, height)
    draw_caption(draw, caption)
    return image


def _legend(draw: ImageDraw.ImageDraw, width: int, height: int) -> None:
    """What the colours mean, at the lower right."""
    colors = VEHICLE_COLOR, PEOPLE_COLOR, OTHER_COLOR, FRONT_COLOR, PATH_COLOR
    entries = list(zip(("vehicles", "people", "other boxes", "fronts", "path"), colors, strict=True))
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


# contact sheet ------------------------------------------------------------------------------------

NAME: Final = "contact_sheet.jpg"
TILE_WIDTH_PX: Final = 480
FRAMES_PER_CAMERA: Final = 3
WIDTH_PX: Final = TILE_WIDTH_PX * FRAMES_PER_CAMERA
TOP_HEIGHT_PX: Final = 720
MAX_GAP_S: Final = 0.15
NEAR_M: Final = 0.3
_NEAREST_M, _FARTHEST_M = 3.0, 80.0
"""Depths at the ends of the colour map."""
_TOP_SWEEPS: Final = 24
_TOP_POINTS: Final = 20_000
_SPARSE: Final = 0.08
"""Points on a smaller share of a tile's pixels are drawn as dots of 2x2."""
_SHADE: Final = (10, 10, 10)
_SHADED_FROM_PX: Final = 24.0
_THICKER_FROM_PX: Final = 700
_EDGES: Final = ((0, 1), (1, 3), (3, 2), (2, 0), (4, 5), (5, 7), (7, 6), (6, 4), (0, 4), (1, 5), (2, 6), (3, 7))
"""Pairs of corners (``geometry.box_corners``)."""


def contact_sheet(scene: Scene) -> Image.Image:
    """The first, middle and last image of each camera in rows of three, the view from above below."""
    chosen = [frame for name in scene.cameras for frame in spread(scene.frames_of(name), FRAMES_PER_CAMERA)]
    tiles = [frame_tile(scene, frame) for frame in chosen]
    rows = [tiles[first : first + FRAMES_PER_CAMERA] for first in range(0, len(tiles), FRAMES_PER_CAMERA)]
    heights = [max(tile.height for tile in row) for row in rows]
    sheet = Image.new("RGB", (WIDTH_PX, sum(heights) + TOP_HEIGHT_PX), GROUND_COLOR)
    top = 0
    for row, height in zip(rows, heights, strict=True):
        for column, tile in enumerate(row):
            sheet.paste(tile, (column * TILE_WIDTH_PX, top))
        top += height
    sheet.paste(top_view(scene, WIDTH_PX, TOP_HEIGHT_PX), (0, top))
    return sheet


def frame_tile(scene: Scene, frame: Frame) -> Image.Image:
    """One image with the points of the sweeps of its moment and the boxes of its time."""
    camera, width = frame.view.camera, TILE_WIDTH_PX
    height = max(1, round(camera.height * width / camera.width))
    view = frame.view.resized(width, height)
    pixels = np.array(resize_area(read_image(scene, frame), width, height))
    sweeps = sweeps_beside(scene, frame, MAX_GAP_S)
    draw_points(pixels, view, points_of(scene, sweeps))
    tile = Image.fromarray(pixels)
    draw = ImageDraw.Draw(tile)
    for track in scene.tracks:
        pose = track.pose_at(frame.view.time_s)
        if pose is not None:
            draw_box(draw, view, pose, track)
    gap = f", LiDAR {1e3 * (sweeps[0].time_s - frame.view.time_s):+.0f} ms" if sweeps else ", no sweep at this time"
    split = " held out" if scene.split.get(frame.id) == "test" else ""
    draw_caption(draw, f"{frame.id}  {frame.view.time_s:.2f} s{gap}{split}")
    return tile


def points_of(scene: Scene, sweeps: Iterable[Sweep], most: int | None = None) -> Floats:
    """Points f64[N, 3] of sweeps in the world; of each about ``most``."""
    parts = [np.zeros((0, 3))]
    for sweep in sweeps:
        points = read_points(scene, sweep).xyz
        points = points[:: max(1, len(points) // (most or len(points) or 1))].astype(np.float64)
        parts.append(geometry.transform_points(sweep.world_from_lidar, points))
    return np.concatenate(parts)


def draw_points(pixels: NDArray[np.uint8], view: View, xyz_world: Floats) -> None:
    """Colour the pixels u8[H, W, 3] that points fall on, nearer ones over farther ones; few points become dots of
    2x2."""
    uv, z = geometry.project(view, xyz_world)
    with np.errstate(invalid="ignore"):
        inside = (z > NEAR_M) & (uv >= 0).all(1) & (uv[:, 0] < view.camera.width) & (uv[:, 1] < view.camera.height)
    uv, z = uv[inside].astype(int), z[inside]
    order = np.argsort(-z, kind="stable")
    height, width = pixels.shape[:2]
    reach = 2 if len(z) < _SPARSE * height * width and width >= TILE_WIDTH_PX else 1
    down, right = (grid.ravel() for grid in np.mgrid[:reach, :reach])
    rows = np.minimum(uv[order, 1, None] + down, height - 1)
    columns = np.minimum(uv[order, 0, None] + right, width - 1)
    pixels[rows, columns] = depth_colors(z[order], _NEAREST_M, _FARTHEST_M)[:, None]


def visible_edges(view: View, corners_world: Floats) -> list[tuple[int, Floats]]:
    """Edges of a box as the camera sees them: number of the edge and its ends f64[2, 2] in pixels. What lies nearer
    than ``NEAR_M``, or behind the camera, is cut off before projection. Edges that lie far outside the image are left
    out."""
    camera = view.camera
    xyz = geometry.transform_points(view.cam_from_world, corners_world)
    found = []
    for number, (a, b) in enumerate(_EDGES):
        ends = cut_near(xyz[[a, b]])
        if ends is None:
            continue
        uv = ends[:, :2] / ends[:, 2:] * [camera.fx, camera.fy] + [camera.cx, camera.cy]
        low, high = uv.min(0), uv.max(0)
        if (high >= 0).all() and low[0] <= camera.width and low[1] <= camera.height and np.abs(uv).max() < 30_000:
            found.append((number, uv))
    return found


def cut_near(ends: Floats) -> Floats | None:
    """The part f64[2, 3] of a segment in camera coordinates that is farther than ``NEAR_M``; None if nothing is."""
    z = ends[:, 2]
    if (z < NEAR_M).all():
        return None
    if (z < NEAR_M).any():
        share = (NEAR_M - z[0]) / (z[1] - z[0])
        cut = ends[0] + share * (ends[1] - ends[0])
        ends = np.stack([cut, ends[1]]) if z[0] < NEAR_M else np.stack([ends[0], cut])
    return ends


def draw_box(draw: ImageDraw.ImageDraw, view: View, world_from_object: Floats, track: Track) -> None:
    """A box as lines in its class' colour, those of its front red; on a dark edge where it is large enough, so that
    points do not hide it."""
    edges = visible_edges(view, geometry.transform_points(world_from_object, geometry.box_corners(track.size_m)))
    if not edges:
        return
    line = 1 + view.camera.width // _THICKER_FROM_PX
    ends = np.concatenate([uv for _, uv in edges])
    if np.ptp(ends, axis=0).max() > _SHADED_FROM_PX:
        for _, uv in edges:
            draw.line(pairs(uv), fill=_SHADE, width=line + 2)
    for number, uv in edges:
        front = all(corner & 4 for corner in _EDGES[number])
        draw.line(pairs(uv), fill=FRONT_COLOR if front else box_color(track.label), width=line)


def top_view(scene: Scene, width: int, height: int) -> Image.Image:
    """Points of up to 24 sweeps by height above the vehicle's path, the path, boxes at the middle of the log and their
    courses."""
    xyz = points_of(scene, spread(scene.sweeps, _TOP_SWEEPS), _TOP_POINTS)
    height_m = (xyz[:, 2] - np.median(scene.ego.world_from_ego[:, 2, 3])).clip(-2.5, 4.0)
    grey = np.repeat((60 + 170 * (height_m + 2.5) / 6.5).astype(np.uint8)[:, None], 3, 1)
    middle_s = float(np.median(scene.ego.times_s))
    caption = f"{scene.id}: {len(scene.sweeps)} sweeps, {len(scene.tracks)} tracked boxes (at {middle_s:.1f} s)"
    boxes = {track.id: track.pose_at(middle_s) for track in scene.tracks}
    return draw_top_view(scene, (width, height), xyz, grey, boxes, caption)
