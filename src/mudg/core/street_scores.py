"""How well vehicles and road markings are where they should be, by published scores and our own. A box in an image is
f64[4]: left, top, right, bottom in pixels."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw
from scipy import ndimage

from mudg.base import geometry, palette
from mudg.base.types import Track, View
from mudg.core.pictures import resize_nearest

# lane scores --------------------------------------------------------------------------------------
# ``NTL-IoU`` (DriveDreamer4D) compares the mask of a lane detector with lane lines of a map drawn into the view;
# nothing hides them. ``lane IoU`` is this package's own: a fixed rule finds bright stripes on the road, and they are
# compared with the exact markings.


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

    Points of a line within 75 m and at most 10 m beside the camera are kept, lines are cut where points are not; what
    is left is drawn 20 pixels thick at 1920 x 1280 and reduced bilinearly; every touched pixel counts. ``lines``:
    places f64[N, 3] in the world, metres, of each line.
    """
    (width, height), half = NTL_DRAWN, NTL_LINE_PX / 2
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
            if not len(run) or not kept[run[0]]:
                continue
            uv = np.stack(geometry.pinhole(large.camera.intrinsics, *local[run].T), 1)
            for begin, end in zip(uv[:-1], uv[1:], strict=True):
                cut = _cut(begin, end, np.full(2, -half), np.array([width, height]) + half)
                if cut is not None:
                    draw.line(cut, fill=255, width=NTL_LINE_PX)
                    for x, y in cut:  # round ends
                        draw.ellipse([x - half, y - half, x + half, y + half], fill=255)
    return _reduced(np.asarray(picture))


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
    return resize_nearest(np.asarray(mask), NTL_HEIGHT_PX, NTL_WIDTH_PX) != 0


def ntl_iou(detected: Mask, true: Mask) -> float:
    """(IoU of the background + IoU of lanes) / 2 of one frame, times 100; a class that neither has counts as 0.

    An image without any lane found scores 47 to 50, because nearly everything is background: read differences of single
    points.
    """
    return 50.0 * (_iou(~detected, ~true) + _iou(detected, true))


def _iou(a: Mask, b: Mask) -> float:
    union = int((a | b).sum())
    return float((a & b).sum() / union) if union else 0.0


# ---- markings of the image itself ----------------------------------------------------------------


def gray_of(rgb: NDArray[np.floating]) -> NDArray[np.float64]:
    """Luminance f64[H, W] of colours ``[3, H, W]`` in [0, 1]."""
    red, green, blue = (np.clip(channel.astype(np.float64), 0, 1) for channel in np.asarray(rgb))
    return 0.299 * red + 0.587 * green + 0.114 * blue


def bright_stripes(rgb: NDArray[np.floating], road: Mask) -> Mask:
    """Road markings of an image by a fixed rule, bool[H, W].

    The image is blurred a little; a pixel of the road is a marking if it is brighter by ``CONTRAST`` than what an
    opening along its row, an eighth of the image wide, leaves of it; specks are left out. Only pixels of the road are
    looked at: beside a dark car it is no marking. ``rgb``: colours ``[3, H, W]`` in [0, 1].
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


def tolerant_iou(detected: Mask, true: Mask, tolerance_px: int = TOLERANCE_PX) -> tuple[float, float]:
    """(Hits, hits + misses + false alarms) of thin structures: pixels count as hit if the other mask has one within
    ``tolerance_px``.

    Hits are the mean of those of either mask. Both numbers add up over frames; their ratio is the IoU.
    """
    near_true, near_found = _grown(true, tolerance_px), _grown(detected, tolerance_px)
    right, covered = int((detected & near_true).sum()), int((true & near_found).sum())
    hits = (right + covered) / 2
    return hits, hits + (int(detected.sum()) - right) + (int(true.sum()) - covered)


def rows_of(mask: Mask, margin: int) -> slice:
    """Rows in which a mask has pixels, and ``margin`` more on both sides where the image has them; none for an empty
    mask."""
    rows = np.flatnonzero(mask.any(1))
    if not len(rows):
        return slice(0, 0)
    return slice(max(0, int(rows[0]) - margin), min(len(mask), int(rows[-1]) + 1 + margin))


def _grown(mask: Mask, pixels: int) -> Mask:
    if not mask.any():
        return mask
    grown, rows = np.zeros_like(mask), rows_of(mask, pixels)
    grown[rows] = np.asarray(ndimage.distance_transform_edt(~mask[rows])) <= pixels
    return grown


def lane_band(marking: Mask) -> Mask:
    """The band around markings in which gradients are compared: 8 pixels to each side in an image 1920 pixels wide, at
    least 2."""
    return _grown(marking, max(2, round(BAND_PX * marking.shape[1] / NTL_DRAWN[0])))


def edges_of(gray: NDArray[np.float64]) -> NDArray[np.float64]:
    """Magnitude of Sobel gradients, f64[H, W]."""
    return np.hypot(ndimage.sobel(gray, 0, mode="nearest"), ndimage.sobel(gray, 1, mode="nearest"))


def edge_correlation(a: NDArray[np.float64], b: NDArray[np.float64], band: Mask) -> float:
    """Pearson correlation of two maps of gradients in a band, [-1, 1]; NaN if one of them is flat there."""
    x, y = a[band] - a[band].mean() if band.any() else a[band], b[band] - b[band].mean() if band.any() else b[band]
    scale = float(np.sqrt((x @ x) * (y @ y)))
    return float(x @ y) / scale if scale > 0 else float("nan")


# ---- the recorded image on the road, seen from beside --------------------------------------------


def plane_points(view: View, plane: NDArray[np.float64], far_m: float = LANE_FAR_M) -> NDArray[np.float64]:
    """Where pixels' rays meet the ground plane z = a x + b y + c, f64[H, W, 3] in the world; NaN above it and beyond
    ``far_m``."""
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
    """Values f64[C, h, w] that an image ``[C, H, W]`` has where it shows places f64[h, w, 3] (bilinear), and where it
    shows them."""
    shape = xyz_world.shape[:2]
    uv, z = geometry.project(view, xyz_world.reshape(-1, 3))
    width, height = view.camera.width, view.camera.height
    with np.errstate(invalid="ignore"):
        inside = (z > 0.5) & (uv >= 0.5).all(1) & (uv[:, 0] <= width - 0.5) & (uv[:, 1] <= height - 0.5)
    places = np.where(inside[:, None], uv - 0.5, 0).T[::-1]
    colors = [ndimage.map_coordinates(np.asarray(plane, np.float64), places, order=1, mode="nearest") for plane in rgb]
    return np.stack(colors).reshape(len(rgb), *shape), inside.reshape(shape)


# box scores ---------------------------------------------------------------------------------------
# ``NTA-IoU`` (DriveDreamer4D) asks a detector for boxes in the generated image and compares each with the nearest
# projected 3-D box, which ignores what hides it. ``agent IoU`` is this package's own: the class map of an image against
# what is really visible.


ImageBox = NDArray[np.float64]

NTA_WIDTH_PX: Final = 480
NTA_HEIGHT_PX: Final = 320
NTA_REACH_PX: Final = 10.0
NTA_CONFIDENCE: Final = 0.5
NTA_FEWEST_POINTS: Final = 10
VEHICLE_LABELS: Final = frozenset({"car", "van", "vehicle", "truck", "bus", "tram", "train"})
"""Labels of tracked boxes that count as vehicles."""
VEHICLE_IDS: Final = tuple(palette.ID[name] for name in ("car", "truck", "bus", "train"))
AGENT_GROWTH: Final = 1.2
AGENT_FEWEST_PX: Final = 100
AGENT_SHARE: Final = 0.3


def iou(a: ImageBox, b: ImageBox) -> float:
    """Intersection over union of two boxes, [0, 1]; 0 where both are empty."""
    common = np.maximum(np.minimum(a[2:], b[2:]) - np.maximum(a[:2], b[:2]), 0).prod()
    union = (a[2:] - a[:2]).prod() + (b[2:] - b[:2]).prod() - common
    return float(common / union) if union > 0 else 0.0


def clipped_box(view: View, world_from_box: NDArray[np.float64], size_m: NDArray[np.float64]) -> ImageBox | None:
    """Outline of what lies ahead of a view's near plane (0.3 m) of a 3-D box, not cut at the image's edges; None
    outside the image."""
    hull = geometry.box_hull(view, world_from_box, size_m)
    return None if hull is None else np.concatenate([hull.points.min(0), hull.points.max(0)])


def nta_truths(view: View, tracks: Sequence[Track]) -> list[tuple[Track, ImageBox]]:
    """Boxes of the vehicles that a view shows, in whole pixels of an image of 480 x 320; only those that lie inside it
    whole. Tracks without a pose at the view's time or that are no vehicles are left out; nothing is asked about what
    hides them."""
    scale = np.array([NTA_WIDTH_PX / view.camera.width, NTA_HEIGHT_PX / view.camera.height] * 2)
    limit = np.array([NTA_WIDTH_PX, NTA_HEIGHT_PX])
    found = []
    for track in tracks:
        pose = track.pose_at(view.time_s) if track.label in VEHICLE_LABELS else None
        box = None if pose is None else clipped_box(view, pose, track.size_m)
        if box is None:
            continue
        whole = np.trunc(box * scale)
        if (whole[:2] >= 0).all() and (whole[2:] <= limit).all():
            found.append((track, whole))
    return found


def nta_iou(truths: Sequence[ImageBox], detections: Sequence[ImageBox]) -> list[float]:
    """For each true box the IoU with the detection whose centre is nearest, or 0 if that is more than 10 pixels away or
    there is none.

    One detection may serve several true boxes. All in pixels of 480 x 320.
    """
    return [_matched(true, detections, NTA_REACH_PX) for true in truths]


def _matched(true: ImageBox, detected: Sequence[ImageBox], reach_px: float) -> float:
    if not len(detected):
        return 0.0
    centres = [(box[:2] + box[2:]) / 2 for box in detected]
    away = [float(np.linalg.norm(centre - (true[:2] + true[2:]) / 2)) for centre in centres]
    nearest = int(np.argmin(away))
    return iou(true, detected[nearest]) if away[nearest] <= reach_px else 0.0


# ---- what is really visible ----------------------------------------------------------------------


@dataclass(frozen=True, slots=True, eq=False)
class VisibleAgent:
    """A vehicle that a view shows: ``outline``, the box of its whole 3-D box cut at the image's edges, and ``visible``,
    that of its visible pixels."""

    outline: ImageBox
    visible: ImageBox

    def iou(self, vehicle: Mask) -> float:
        """IoU of the visible box with that of the largest connected region of vehicle pixels bool[H, W] near it; 0 if
        there is none or its centre is off by more than 10 pixels in an image 480 pixels wide.

        Near means: inside the outline of the true 3-D box, made 1.2 times as large.
        """
        height, width = vehicle.shape
        half, centre = (
            AGENT_GROWTH * (self.outline[2:] - self.outline[:2]) / 2,
            (self.outline[2:] + self.outline[:2]) / 2,
        )
        left, top = np.maximum(np.floor(centre - half), 0).astype(int)
        right, bottom = np.minimum(np.ceil(centre + half), (width, height)).astype(int)
        labelled: Any = ndimage.label(vehicle[top:bottom, left:right])
        regions, count = labelled
        box = tight_box(regions == np.bincount(regions.ravel())[1:].argmax() + 1) if count else None
        found = [] if box is None else [box + np.array([left, top, left, top], np.float64)]
        return _matched(self.visible, found, NTA_REACH_PX * width / NTA_WIDTH_PX)


def tight_box(mask: NDArray[np.bool_]) -> ImageBox | None:
    """Left, top, right, bottom edges of the pixels that are set in bool[H, W]; None if there are none."""
    rows, columns = np.flatnonzero(mask.any(1)), np.flatnonzero(mask.any(0))
    return np.array([columns[0], rows[0], columns[-1] + 1, rows[-1] + 1], np.float64) if len(rows) else None


def visible_agents(
    view: View, tracks: Sequence[tuple[int, Track]], instance: NDArray[np.integer]
) -> tuple[VisibleAgent, ...]:
    """The vehicles that count: at least 100 visible pixels, which are at least 30 % of their outline in the image.
    ``tracks``: number in ``instance`` i32[H, W], what each pixel shows, and track."""
    camera = view.camera
    edge = np.array([camera.width, camera.height], np.float64)
    counts = dict(zip(*(part.tolist() for part in np.unique(instance, return_counts=True)), strict=True))
    found = []
    for number, track in tracks:
        pose = track.pose_at(view.time_s) if track.label in VEHICLE_LABELS else None
        if pose is None or counts.get(number, 0) < AGENT_FEWEST_PX:
            continue
        outline, visible = clipped_box(view, pose, track.size_m), tight_box(instance == number)
        if outline is None or visible is None:
            continue
        outline = np.concatenate([np.clip(outline[:2], 0, edge), np.clip(outline[2:], 0, edge)])
        if counts[number] >= AGENT_SHARE * (outline[2:] - outline[:2]).prod():
            found.append(VisibleAgent(outline, visible))
    return tuple(found)


def agent_ious(agents: Sequence[VisibleAgent], classes: NDArray[np.integer]) -> list[float]:
    """``VisibleAgent.iou`` of each vehicle, in an image of train ids ``[H, W]``."""
    vehicle = np.isin(classes, VEHICLE_IDS)
    return [agent.iou(vehicle) for agent in agents]
