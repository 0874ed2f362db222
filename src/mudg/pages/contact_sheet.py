"""A picture of a whole scene for a first look: some frames of each camera with LiDAR and boxes drawn in, and a view from above.

What to look for: points lie on the surfaces they belong to (edges of posts and cars), boxes sit on their objects, and
standing things stay single lines from above. Near points are warm, far ones cold; boxes of vehicles are green, of people violet, of
all else light blue, and the edges of their fronts red.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from mudg.base import geometry, store
from mudg.base.types import Frame, Scene, Track, View
from mudg.core.pictures import depth_colors, resize_area
from mudg.data.scene import read_image, read_points
from mudg.data.scene.alignment import sweeps_beside
from mudg.pages import top_view as drawing
from mudg.pages.top_view import FRONT_COLOR, GROUND_COLOR, TopView

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

Floats = NDArray[np.float64]


def write_contact_sheet(scene: Scene, path: Path) -> Path:
    """Draw the scene's contact sheet as a JPEG at ``path``."""
    store.write_image(path, contact_sheet(scene), quality=88)
    return path


def contact_sheet(scene: Scene) -> Image.Image:
    """The cameras, the view from above below.

    A camera has a row of its first, middle and last image. Where no camera has more than one, they share rows.
    """
    chosen = []
    for name in scene.cameras:
        frames = scene.frames_of(name)
        chosen.append(spread(frames, FRAMES_PER_CAMERA))
    columns = max([1, *(len(frames) for frames in chosen)])
    if columns == 1:
        single = [frame for frames in chosen for frame in frames]
        columns = max(1, min(FRAMES_PER_CAMERA, len(single)))
        chosen = [single[first : first + columns] for first in range(0, len(single), columns)]
    rows = [_beside([frame_tile(scene, f, WIDTH_PX // columns) for f in frames]) for frames in chosen if frames]
    rows.append(top_view(scene, WIDTH_PX, TOP_HEIGHT_PX))
    sheet = Image.new("RGB", (WIDTH_PX, sum(row.height for row in rows)), GROUND_COLOR)
    top = 0
    for row in rows:
        sheet.paste(row, (0, top))
        top += row.height
    return sheet


def spread(frames: Sequence[Frame], count: int) -> list[Frame]:
    """At most ``count`` of the frames, evenly spread, first and last among them."""
    return [frames[i] for i in np.unique(np.linspace(0, len(frames) - 1, count).astype(int))] if frames else []


def _beside(tiles: list[Image.Image]) -> Image.Image:
    row = Image.new("RGB", (sum(tile.width for tile in tiles), max(tile.height for tile in tiles)), GROUND_COLOR)
    left = 0
    for tile in tiles:
        row.paste(tile, (left, 0))
        left += tile.width
    return row


# --- from the cameras -------------------------------------------------------------------------------------------------


def frame_tile(scene: Scene, frame: Frame, width: int = TILE_WIDTH_PX) -> Image.Image:
    """One image with the points of the sweeps of its moment and the boxes of its time."""
    camera = frame.view.camera
    height = max(1, round(camera.height * width / camera.width))
    view = frame.view.resized(width, height)
    pixels = np.array(resize_area(read_image(scene, frame), width, height))
    sweeps = sweeps_beside(scene, frame, MAX_GAP_S)
    points = [
        geometry.transform_points(s.world_from_lidar, read_points(scene, s).xyz.astype(np.float64)) for s in sweeps
    ]
    draw_points(pixels, view, np.concatenate(points) if points else np.zeros((0, 3)))
    tile = Image.fromarray(pixels)
    draw = ImageDraw.Draw(tile)
    for track in scene.tracks:
        pose = track.pose_at(frame.view.time_s)
        if pose is not None:
            draw_box(draw, view, pose, track)
    gap = f", LiDAR {1e3 * (sweeps[0].time_s - frame.view.time_s):+.0f} ms" if sweeps else ", no sweep at this time"
    split = " held out" if scene.split.get(frame.id) == "test" else ""
    drawing.draw_caption(draw, f"{frame.id}  {frame.view.time_s:.2f} s{gap}{split}")
    return tile


def draw_points(pixels: NDArray[np.uint8], view: View, xyz_world: Floats) -> None:
    """Colour the pixels u8[H, W, 3] that points fall on, nearer ones over farther ones; few points become dots of 2x2."""
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
    """Edges of a box as the camera sees them: number of the edge and its ends f64[2, 2] in pixels.

    What lies nearer than ``NEAR_M``, or behind the camera, is cut off before projection. Edges that lie far outside the
    image are left out.
    """
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
    """A box as lines in its class' colour, those of its front red; on a dark edge where it is large enough, so that points do not
    hide it."""
    edges = visible_edges(view, geometry.transform_points(world_from_object, geometry.box_corners(track.size_m)))
    if not edges:
        return
    line = 1 + view.camera.width // _THICKER_FROM_PX
    ends = np.concatenate([uv for _, uv in edges])
    if np.ptp(ends, axis=0).max() > _SHADED_FROM_PX:
        for _, uv in edges:
            draw.line(drawing.pairs(uv), fill=_SHADE, width=line + 2)
    for number, uv in edges:
        front = all(corner & 4 for corner in _EDGES[number])
        draw.line(drawing.pairs(uv), fill=FRONT_COLOR if front else drawing.box_color(track.label), width=line)


# --- from above ---------------------------------------------------------------------------------------------------------


def top_view(scene: Scene, width: int, height: int) -> Image.Image:
    """Points of up to 24 sweeps by height above the vehicle's path, the path, boxes at the middle of the log and their courses."""
    xyz = _sample(scene)
    height_m = (xyz[:, 2] - np.median(scene.ego.world_from_ego[:, 2, 3])).clip(-2.5, 4.0)
    grey = np.repeat((60 + 170 * (height_m + 2.5) / 6.5).astype(np.uint8)[:, None], 3, 1)
    middle_s = float(np.median(scene.ego.times_s))
    caption = f"{scene.id}: {len(scene.sweeps)} sweeps, {len(scene.tracks)} tracked boxes (at {middle_s:.1f} s)"
    boxes = {track.id: track.pose_at(middle_s) for track in scene.tracks}
    return drawing.draw_top_view(scene, TopView(xyz, grey, boxes, caption), width, height)


def _sample(scene: Scene) -> Floats:
    """Points of some sweeps in the world, f64[N, 3]."""
    count = len(scene.sweeps)
    chosen = np.unique(np.linspace(0, count - 1, min(count, _TOP_SWEEPS)).astype(int)) if count else []
    parts = [np.zeros((0, 3))]
    for index in chosen:
        sweep = scene.sweeps[index]
        xyz = read_points(scene, sweep).xyz
        step = max(1, len(xyz) // _TOP_POINTS)
        parts.append(geometry.transform_points(sweep.world_from_lidar, xyz[::step].astype(np.float64)))
    return np.concatenate(parts)
