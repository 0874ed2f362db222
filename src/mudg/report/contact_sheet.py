"""A picture of a whole scene for a first look: some frames of each camera with LiDAR and boxes drawn in, and a view from above.

What to look for: points lie on the surfaces they belong to (edges of posts and cars), boxes sit on their objects, and
standing things stay single lines from above. Near points are warm, far ones cold; boxes of vehicles are green, of people violet, of
all else light blue, and the edges of their fronts red.
"""

from __future__ import annotations

from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from mudg.base import geometry, store
from mudg.base.types import Frame, Scene, Track, View
from mudg.data.scene import read_image, read_points
from mudg.data.scene.alignment import sweeps_beside
from mudg.data.scene.check import VEHICLES

NAME: Final = "contact_sheet.jpg"
TILE_WIDTH_PX: Final = 480
FRAMES_PER_CAMERA: Final = 3
WIDTH_PX: Final = TILE_WIDTH_PX * FRAMES_PER_CAMERA
TOP_HEIGHT_PX: Final = 720
MAX_GAP_S: Final = 0.15
NEAR_M: Final = 0.3
_NEAREST_M, _FARTHEST_M = 3.0, 80.0
_TOP_SWEEPS: Final = 24
_TOP_POINTS: Final = 20_000
_SPARSE: Final = 0.08
"""Points on a smaller share of a tile's pixels are drawn as dots of 2x2."""
_BOX_COLOUR: Final = (80, 255, 120)
_PEOPLE_COLOUR: Final = (235, 130, 255)
_OTHER_COLOUR: Final = (150, 205, 255)
_SHADE: Final = (10, 10, 10)
_SHADED_FROM_PX: Final = 24.0
_THICKER_FROM_PX: Final = 700
_FRONT_COLOUR: Final = (255, 80, 80)
_PATH_COLOUR: Final = (60, 200, 255)
_TEXT_COLOUR: Final = (235, 235, 235)
_GROUND: Final = (18, 18, 18)
_COLD_TO_WARM: Final = np.array(
    [[70, 40, 160], [50, 110, 230], [40, 190, 200], [90, 220, 90], [230, 210, 50], [250, 120, 30], [220, 30, 30]],
    np.float64,
)

_EDGES: Final = ((0, 1), (1, 3), (3, 2), (2, 0), (4, 5), (5, 7), (7, 6), (6, 4), (0, 4), (1, 5), (2, 6), (3, 7))
"""Pairs of corners (``geometry.box_corners``)."""

PEOPLE: Final = frozenset(
    ("pedestrian", "person", "person_sitting", "person (sitting)", "cyclist", "rider", "motorcyclist", "bicyclist", "stroller",
     "wheelchair")
)  # fmt: skip

Floats = NDArray[np.float64]


def write_contact_sheet(scene: Scene, path: Path) -> Path:
    """Draw the scene's contact sheet as a JPEG at ``path``."""
    sheet = contact_sheet(scene)
    with store.atomic_path(path) as temporary:
        sheet.save(temporary, "JPEG", quality=88)
    return path


def contact_sheet(scene: Scene) -> Image.Image:
    """The cameras, the view from above below.

    A camera has a row of its first, middle and last image. Where no camera has more than one, they share rows.
    """
    chosen = []
    for name in scene.cameras:
        frames = scene.frames_of(name)
        at = np.unique(np.linspace(0, len(frames) - 1, FRAMES_PER_CAMERA).astype(int)) if frames else []
        chosen.append([frames[index] for index in at])
    columns = max([1, *(len(frames) for frames in chosen)])
    if columns == 1:
        single = [frame for frames in chosen for frame in frames]
        columns = max(1, min(FRAMES_PER_CAMERA, len(single)))
        chosen = [single[first : first + columns] for first in range(0, len(single), columns)]
    rows = [_beside([frame_tile(scene, f, WIDTH_PX // columns) for f in frames]) for frames in chosen if frames]
    rows.append(top_view(scene, WIDTH_PX, TOP_HEIGHT_PX))
    sheet = Image.new("RGB", (WIDTH_PX, sum(row.height for row in rows)), _GROUND)
    top = 0
    for row in rows:
        sheet.paste(row, (0, top))
        top += row.height
    return sheet


def _beside(tiles: list[Image.Image]) -> Image.Image:
    row = Image.new("RGB", (sum(tile.width for tile in tiles), max(tile.height for tile in tiles)), _GROUND)
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
    tile = Image.fromarray(read_image(scene, frame)).resize((width, height), Image.Resampling.BOX)
    view = frame.view.resized(width, height)
    pixels = np.array(tile)
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
    _caption(draw, f"{frame.id}  {frame.view.time_s:.2f} s{gap}{split}")
    return tile



def depth_colours(depth_m: Floats) -> NDArray[np.uint8]:
    """u8[N, 3]: logarithm of the depth, 3 m warm to 80 m cold."""
    place = np.log(np.clip(depth_m, _NEAREST_M, _FARTHEST_M) / _NEAREST_M) / np.log(_FARTHEST_M / _NEAREST_M)
    scale = (1 - place) * (len(_COLD_TO_WARM) - 1)
    low = np.minimum(scale.astype(int), len(_COLD_TO_WARM) - 2)
    share = (scale - low)[:, None]
    return np.rint(_COLD_TO_WARM[low] * (1 - share) + _COLD_TO_WARM[low + 1] * share).astype(np.uint8)


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
    pixels[rows, columns] = depth_colours(z[order])[:, None]


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
            draw.line(_pairs(uv), fill=_SHADE, width=line + 2)
    for number, uv in edges:
        front = all(corner & 4 for corner in _EDGES[number])
        draw.line(_pairs(uv), fill=_FRONT_COLOUR if front else box_colour(track.label), width=line)


def box_colour(label: str) -> tuple[int, int, int]:
    """Colour of a class of boxes."""
    return _BOX_COLOUR if label in VEHICLES else _PEOPLE_COLOUR if label in PEOPLE else _OTHER_COLOUR


def _caption(draw: ImageDraw.ImageDraw, text: str) -> None:
    left, top, right, bottom = draw.textbbox((4, 3), text)
    draw.rectangle((left - 3, top - 2, right + 3, bottom + 2), fill=_GROUND)
    draw.text((4, 3), text, fill=_TEXT_COLOUR)


# --- from above ---------------------------------------------------------------------------------------------------------


def top_view(scene: Scene, width: int, height: int) -> Image.Image:
    """Points of up to 24 sweeps by height above the vehicle's path, the path, boxes at the middle of the log and their courses."""
    path = scene.ego.world_from_ego[:, :3, 3]
    xyz = _sample(scene)
    boxes = np.concatenate([np.zeros((0, 3)), *(track.world_from_object[:, :3, 3] for track in scene.tracks)])
    seen = xyz if len(xyz) else boxes
    around = np.concatenate([path[:, :2], seen[:, :2]])
    low, high = np.percentile(around, 4, axis=0), np.percentile(around, 96, axis=0)
    low, high = np.minimum(low, path[:, :2].min(0)) - 8, np.maximum(high, path[:, :2].max(0)) + 8
    scale = float(min(width / (high[0] - low[0]), height / (high[1] - low[1])))
    middle = (low + high) / 2

    def at(places: Floats) -> Floats:
        return (places[:, :2] - middle) * [scale, -scale] + [width / 2, height / 2]

    canvas = np.full((height, width, 3), _GROUND, np.uint8)
    order = np.argsort(xyz[:, 2], kind="stable")
    uv = at(xyz)[order]
    inside = ((uv >= 0) & (uv < [width, height])).all(1)
    above = (xyz[order, 2][inside] - np.median(path[:, 2])).clip(-2.5, 4.0)
    grey = (60 + 170 * (above + 2.5) / 6.5).astype(np.uint8)
    canvas[uv[inside, 1].astype(int), uv[inside, 0].astype(int)] = grey[:, None]
    image = Image.fromarray(canvas)
    draw = ImageDraw.Draw(image)
    middle_s = float(np.median(scene.ego.times_s))
    for track in scene.tracks:
        draw.line(_pairs(at(track.world_from_object[:, :3, 3])), fill=(150, 110, 60))
        pose = track.pose_at(middle_s)
        if pose is not None:
            corners = at(geometry.transform_points(pose, geometry.box_corners(track.size_m)[[0, 2, 6, 4]]))
            draw.polygon(_pairs(corners), outline=box_colour(track.label))
            draw.line(_pairs(corners[[2, 3]]), fill=_FRONT_COLOUR, width=2)
    if len(path) > 1:
        draw.line(_pairs(at(path)), fill=_PATH_COLOUR, width=2)
    start = at(path[:1])[0]
    draw.ellipse((start[0] - 4, start[1] - 4, start[0] + 4, start[1] + 4), outline=_PATH_COLOUR)
    draw.line((10, height - 12, 10 + 10 * scale, height - 12), fill=_TEXT_COLOUR, width=2)
    draw.text((10, height - 28), "10 m", fill=_TEXT_COLOUR)
    _legend(draw, width, height)
    _caption(draw, f"{scene.id}: {len(scene.sweeps)} sweeps, {len(scene.tracks)} tracked boxes (at {middle_s:.1f} s)")
    return image


def _legend(draw: ImageDraw.ImageDraw, width: int, height: int) -> None:
    """What the colours mean, at the lower right."""
    words = (
        ("vehicles", _BOX_COLOUR), ("people", _PEOPLE_COLOUR), ("other boxes", _OTHER_COLOUR), ("fronts", _FRONT_COLOUR),
        ("path", _PATH_COLOUR),
    )  # fmt: skip
    left = width - 12 - sum(draw.textlength(word) + 14 for word, _ in words)
    draw.rectangle((left - 6, height - 32, width - 6, height - 8), fill=_GROUND)
    for word, colour in words:
        draw.text((left, height - 28), word, fill=colour)
        left += draw.textlength(word) + 14


def _pairs(points: Floats) -> list[tuple[float, float]]:
    return [(float(x), float(y)) for x, y in points]


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
