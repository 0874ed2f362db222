"""How well road markings are where they should be: NTL-IoU from a detector's masks, and lane IoU and lane gradients from the images.

``NTL-IoU`` (DriveDreamer4D) compares the mask of a lane detector with lane lines of a map drawn into the view; nothing hides them.
``lane IoU`` is this package's own measure: a fixed rule finds bright stripes on the road, and they are compared with the exact markings.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw
from scipy import ndimage

from mudg.base import geometry
from mudg.base.types import View

NTL_WIDTH_PX: Final = 640
NTL_HEIGHT_PX: Final = 360
NTL_DRAWN: Final = (1920, 1280)
"""Width and height of the image that map lines are drawn in."""
NTL_LINE_PX: Final = 20
NTL_FAR_M: Final = 75.0
NTL_BESIDE_M: Final = 10.0
NTL_NEAREST_M: Final = 1e-3
TOLERANCE_PX: Final = 2
LANE_FAR_M: Final = 40.0
"""Markings farther ahead are thinner than a pixel of a small image; they do not count."""
BAND_PX: Final = 8.0
"""Half width of the band around markings, in an image 1920 pixels wide."""
CONTRAST: Final = 0.08
"""A marking is brighter by this, of 1, than the road beside it."""
STRIPE_SHARE: Final = 1 / 8
"""Stripes wider than this share of the image are no markings."""
SMOOTH_PX: Final = 0.8
SMOOTH_REACH_PX: Final = 4
"""Pixels beyond which the blur sees nothing (4 standard deviations, rounded)."""
FEWEST_PX: Final = 8
"""Connected regions of fewer pixels are specks."""

Mask = NDArray[np.bool_]


def lane_truth(view: View, lines: Sequence[NDArray[np.float64]]) -> Mask:
    """Lane lines of a map as the published score draws them, bool[360, 640].

    Points of a line within 75 m and at most 10 m beside the camera are kept, lines are cut where points are not; what is left is
    drawn 20 pixels thick at 1920 x 1280 and reduced bilinearly; every touched pixel counts.

    Args:
        lines: places f64[N, 3] in the world, metres, of each line.
    """
    width, height = NTL_DRAWN
    large = view.resized(width, height)
    picture = Image.new("L", (width, height))
    draw = ImageDraw.Draw(picture)
    for line in lines:
        local = geometry.transform_points(large.cam_from_world, np.asarray(line, np.float64))
        kept = (
            (np.linalg.norm(local, axis=1) < NTL_FAR_M)
            & (np.abs(local[:, 0]) < NTL_BESIDE_M)
            & (local[:, 2] > NTL_NEAREST_M)
        )
        for run in np.split(np.arange(len(local)), np.flatnonzero(np.diff(kept.astype(np.int8))) + 1):
            if len(run) and kept[run[0]]:
                uv = np.stack(geometry.pinhole(large.camera.intrinsics, *local[run].T), 1)
                _draw_line(draw, uv, width, height)
    return _reduced(np.asarray(picture))


def _draw_line(draw: ImageDraw.ImageDraw, uv: NDArray[np.float64], width: int, height: int) -> None:
    """A polyline with round ends; parts far outside are left out."""
    half = NTL_LINE_PX / 2
    low, high = np.array([-half, -half]), np.array([width + half, height + half])
    for begin, end in zip(uv[:-1], uv[1:], strict=True):
        cut = _cut(begin, end, low, high)
        if cut is None:
            continue
        draw.line([tuple(cut[0]), tuple(cut[1])], fill=255, width=NTL_LINE_PX)
        for x, y in cut:
            draw.ellipse([x - half, y - half, x + half, y + half], fill=255)


def _cut(
    begin: NDArray[np.float64], end: NDArray[np.float64], low: NDArray[np.float64], high: NDArray[np.float64]
) -> list[tuple[float, float]] | None:
    """The part of a segment inside a rectangle."""
    first, last, step = 0.0, 1.0, end - begin
    for axis in (0, 1):
        if step[axis] == 0:
            if not low[axis] <= begin[axis] <= high[axis]:
                return None
            continue
        near, far = sorted(((low[axis] - begin[axis]) / step[axis], (high[axis] - begin[axis]) / step[axis]))
        first, last = max(first, near), min(last, far)
    if first > last:
        return None
    a, b = begin + first * step, begin + last * step
    return [(float(a[0]), float(a[1])), (float(b[0]), float(b[1]))]


def _reduced(drawn: NDArray[np.uint8]) -> Mask:
    """Bilinear without antialiasing, pixel centres kept, rounded to 8 bits; bool[360, 640], True from 1 on."""
    values = drawn.astype(np.float64)
    for axis, size in ((0, NTL_HEIGHT_PX), (1, NTL_WIDTH_PX)):
        place = (np.arange(size) + 0.5) * values.shape[axis] / size - 0.5
        lower = np.clip(np.floor(place).astype(int), 0, values.shape[axis] - 1)
        upper = np.minimum(lower + 1, values.shape[axis] - 1)
        share = np.clip(place - lower, 0, 1).reshape((-1, 1) if axis == 0 else (1, -1))
        values = values.take(lower, axis) * (1 - share) + values.take(upper, axis) * share
    return np.rint(values) >= 1


def at_lane_size(mask: NDArray[np.generic]) -> Mask:
    """A detector's mask ``[h, w]`` of any size as bool[360, 640], by the nearest pixel; what is not 0 is a lane."""
    rows = ((np.arange(NTL_HEIGHT_PX) + 0.5) * mask.shape[0] / NTL_HEIGHT_PX).astype(int)
    columns = ((np.arange(NTL_WIDTH_PX) + 0.5) * mask.shape[1] / NTL_WIDTH_PX).astype(int)
    return np.asarray(mask)[rows][:, columns] != 0


def ntl_iou(found: Mask, true: Mask) -> float:
    """(IoU of the background + IoU of lanes) / 2 of one frame, times 100; a class that neither has counts as 0.

    An image without any lane found scores 47 to 50, because nearly everything is background: read differences of single points.
    """
    return 50.0 * (_iou(~found, ~true) + _iou(found, true))


def _iou(a: Mask, b: Mask) -> float:
    union = int((a | b).sum())
    return float((a & b).sum() / union) if union else 0.0


# ---- markings of the image itself -----------------------------------------------------------------------------------------


def gray_of(rgb: NDArray[np.floating]) -> NDArray[np.float64]:
    """Luminance f64[H, W] of colours ``[3, H, W]`` in [0, 1]."""
    red, green, blue = (np.clip(channel.astype(np.float64), 0, 1) for channel in np.asarray(rgb))
    return 0.299 * red + 0.587 * green + 0.114 * blue


def bright_stripes(rgb: NDArray[np.floating], road: Mask) -> Mask:
    """Road markings of an image by a fixed rule, bool[H, W].

    The image is blurred a little; a pixel of the road is a marking if it is brighter by ``CONTRAST`` than what an opening along its
    row, an eighth of the image wide, leaves of it; specks are left out. Only pixels of the road are looked at: beside a dark car it is no
    marking.

    Args:
        rgb: colours ``[3, H, W]`` in [0, 1]. road: pixels where markings are looked for.
    """
    rows = rows_of(road, SMOOTH_REACH_PX)
    if rows.stop - rows.start < len(road):  # what lies above and below the road changes nothing on it
        whole = np.zeros_like(road)
        whole[rows] = bright_stripes(rgb[:, rows], road[rows])
        return whole
    share = np.asarray(ndimage.gaussian_filter(road.astype(np.float64), SMOOTH_PX, mode="nearest"))
    gray = np.asarray(ndimage.gaussian_filter(gray_of(rgb) * road, SMOOTH_PX, mode="nearest")) / np.maximum(share, 1e-6)
    size = (1, max(5, round(gray.shape[1] * STRIPE_SHARE) | 1))
    lowest = ndimage.grey_erosion(np.where(road, gray, np.inf), size, mode="constant", cval=np.inf)
    flat = gray - ndimage.grey_dilation(np.where(road, lowest, -np.inf), size, mode="constant", cval=-np.inf)
    found = (flat > CONTRAST) & road
    labelled: Any = ndimage.label(found, np.ones((3, 3)))
    regions, count = labelled
    return found & (np.bincount(regions.ravel(), minlength=count + 1) >= FEWEST_PX)[regions]


def tolerant_iou(found: Mask, true: Mask, tolerance_px: int = TOLERANCE_PX) -> tuple[float, float]:
    """(Hits, hits + misses + false alarms) of thin structures: pixels count as hit if the other mask has one within ``tolerance_px``.

    Hits are the mean of those of either mask. Both numbers add up over frames; their ratio is the IoU.
    """
    near_true, near_found = _grown(true, tolerance_px), _grown(found, tolerance_px)
    right, covered = int((found & near_true).sum()), int((true & near_found).sum())
    hits = (right + covered) / 2
    return hits, hits + (int(found.sum()) - right) + (int(true.sum()) - covered)


def rows_of(mask: Mask, margin: int) -> slice:
    """Rows in which a mask has pixels, and ``margin`` more on both sides where the image has them; none for an empty mask."""
    rows = np.flatnonzero(mask.any(1))
    return slice(max(0, int(rows[0]) - margin), min(len(mask), int(rows[-1]) + 1 + margin)) if len(rows) else slice(0, 0)


def _grown(mask: Mask, pixels: int) -> Mask:
    if not mask.any():
        return mask
    grown, rows = np.zeros_like(mask), rows_of(mask, pixels)
    grown[rows] = np.asarray(ndimage.distance_transform_edt(~mask[rows])) <= pixels
    return grown


def lane_band(marking: Mask) -> Mask:
    """The band around markings in which gradients are compared: 8 pixels to each side in an image 1920 pixels wide, at least 2."""
    return _grown(marking, max(2, round(BAND_PX * marking.shape[1] / NTL_DRAWN[0])))


def edges_of(gray: NDArray[np.float64]) -> NDArray[np.float64]:
    """Magnitude of Sobel gradients, f64[H, W]."""
    return np.hypot(ndimage.sobel(gray, 0, mode="nearest"), ndimage.sobel(gray, 1, mode="nearest"))


def edge_correlation(a: NDArray[np.float64], b: NDArray[np.float64], band: Mask) -> float:
    """Pearson correlation of two maps of gradients in a band, [-1, 1]; NaN if one of them is flat there."""
    x, y = a[band] - a[band].mean() if band.any() else a[band], b[band] - b[band].mean() if band.any() else b[band]
    scale = float(np.sqrt((x @ x) * (y @ y)))
    return float(x @ y) / scale if scale > 0 else float("nan")


# ---- the recorded image on the road, seen from beside ---------------------------------------------------------------------


def plane_points(view: View, plane: NDArray[np.float64], far_m: float = LANE_FAR_M) -> NDArray[np.float64]:
    """Where pixels' rays meet the ground plane z = a x + b y + c, f64[H, W, 3] in the world; NaN above it and beyond ``far_m``."""
    camera = view.camera
    x, y = geometry.pixel_rays(camera)
    rays = np.stack(np.broadcast_arrays(x[None], y[:, None], np.ones((camera.height, camera.width))), -1)
    rays = rays @ view.world_from_cam[:3, :3].T
    origin = view.center_world
    normal = np.array([-plane[0], -plane[1], 1.0])
    down = rays @ normal
    with np.errstate(divide="ignore", invalid="ignore"):
        away = (plane[2] - origin @ normal) / down
    good = (down < -1e-6) & (away > 0) & (away < far_m)
    return np.where(good[..., None], origin + away[..., None] * rays, np.nan)


def seen_from(
    view: View, rgb: NDArray[np.floating], xyz_world: NDArray[np.float64]
) -> tuple[NDArray[np.float64], Mask]:
    """Values f64[C, h, w] that an image ``[C, H, W]`` has where it shows places f64[h, w, 3] (bilinear), and where it shows them."""
    shape = xyz_world.shape[:2]
    uv, z = geometry.project(view, xyz_world.reshape(-1, 3))
    width, height = view.camera.width, view.camera.height
    with np.errstate(invalid="ignore"):
        inside = (z > 0.5) & (uv >= 0.5).all(1) & (uv[:, 0] <= width - 0.5) & (uv[:, 1] <= height - 0.5)
    places = np.where(inside[:, None], uv - 0.5, 0).T[::-1]
    colors = [ndimage.map_coordinates(np.asarray(plane, np.float64), places, order=1, mode="nearest") for plane in rgb]
    return np.stack(colors).reshape(len(rgb), *shape), inside.reshape(shape)
