"""How well vehicles are where they should be: NTA-IoU from a detector's boxes, and agent IoU from class maps and exact truth.

``NTA-IoU`` (DriveDreamer4D) asks a detector for boxes in the generated image and compares each with the nearest projected 3-D box, which
ignores what hides it. ``agent IoU`` is this package's own measure: the class map of an image against what is really visible.
A box in an image is f64[4]: left, top, right, bottom in pixels.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from mudg.base import geometry, palette
from mudg.base.types import Track, View

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
    """Outline of what lies ahead of a view's near plane (0.3 m) of a 3-D box, not cut at the image's edges; None outside the image."""
    hull = geometry.box_hull(view, world_from_box, size_m)
    if hull is None:
        return None
    return np.concatenate([hull.points.min(0), hull.points.max(0)])


def published_box(view: View, world_from_box: NDArray[np.float64], size_m: NDArray[np.float64]) -> ImageBox | None:
    """The same as published scores compute it: all eight corners are divided by their depth, also those behind the camera, so that a
    box beside the camera becomes one that means nothing. None if no corner lies ahead."""
    corners = geometry.transform_points(view.cam_from_world @ world_from_box, geometry.box_corners(size_m))
    if not (corners[:, 2] > 0).any():
        return None
    with np.errstate(divide="ignore", invalid="ignore"):
        uv = np.stack(geometry.pinhole(view.camera.intrinsics, *corners.T), 1)
    return np.concatenate([uv.min(0), uv.max(0)]) if np.isfinite(uv).all() else None


def nta_truths(view: View, tracks: Sequence[Track], as_published: bool = False) -> list[tuple[Track, ImageBox]]:
    """Boxes of the vehicles that a view shows, in whole pixels of an image of 480 x 320; only those that lie inside it whole.

    Args:
        tracks: candidates; those without a pose at the view's time or that are no vehicles are left out. Nothing is asked about what
            hides them.
        as_published: boxes of corners behind the camera, too (``published_box``).
    """
    box_of = published_box if as_published else clipped_box
    scale = np.array([NTA_WIDTH_PX / view.camera.width, NTA_HEIGHT_PX / view.camera.height] * 2)
    limit = np.array([NTA_WIDTH_PX, NTA_HEIGHT_PX])
    found = []
    for track in tracks:
        pose = track.pose_at(view.time_s) if track.label in VEHICLE_LABELS else None
        box = None if pose is None else box_of(view, pose, track.size_m)
        if box is None:
            continue
        whole = np.trunc(box * scale)
        if (whole[:2] >= 0).all() and (whole[2:] <= limit).all():
            found.append((track, whole))
    return found


def nta_iou(truths: Sequence[ImageBox], detections: Sequence[ImageBox]) -> list[float]:
    """For each true box the IoU with the detection whose centre is nearest, or 0 if that is more than 10 pixels away or there is none.

    One detection may serve several true boxes. All in pixels of 480 x 320.
    """
    return [_matched(true, detections, NTA_REACH_PX) for true in truths]


def _matched(true: ImageBox, found: Sequence[ImageBox], reach_px: float) -> float:
    if not len(found):
        return 0.0
    centres = [(box[:2] + box[2:]) / 2 for box in found]
    away = [float(np.linalg.norm(centre - (true[:2] + true[2:]) / 2)) for centre in centres]
    nearest = int(np.argmin(away))
    return iou(true, found[nearest]) if away[nearest] <= reach_px else 0.0


# ---- what is really visible ----------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, eq=False)
class VisibleAgent:
    """A vehicle that a view shows: ``outline``, the box of its whole 3-D box cut at the image's edges, and ``visible``, that of its
    visible pixels."""

    outline: ImageBox
    visible: ImageBox


def tight_box(mask: NDArray[np.bool_]) -> ImageBox | None:
    """Left, top, right, bottom edges of the pixels that are set in bool[H, W]; None if there are none."""
    rows, columns = np.flatnonzero(mask.any(1)), np.flatnonzero(mask.any(0))
    return np.array([columns[0], rows[0], columns[-1] + 1, rows[-1] + 1], np.float64) if len(rows) else None


def visible_agents(
    view: View, tracks: Sequence[tuple[int, Track]], instance: NDArray[np.integer]
) -> tuple[VisibleAgent, ...]:
    """The vehicles that count: at least 100 visible pixels, which are at least 30 % of their outline in the image.

    Args:
        tracks: number in ``instance`` and track. instance: i32[H, W], what each pixel shows.
    """
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
    """For each vehicle the IoU of its visible box with that of the largest connected region of vehicle pixels near it; 0 if there is
    none or its centre is off by more than 10 pixels in an image 480 pixels wide.

    Near means: inside the outline of the true 3-D box, made 1.2 times as large.

    Args:
        classes: train ids ``[H, W]`` of the image that is judged.
    """
    vehicle = np.isin(classes, VEHICLE_IDS)
    height, width = vehicle.shape
    reach_px = NTA_REACH_PX * width / NTA_WIDTH_PX
    values = []
    for agent in agents:
        half = AGENT_GROWTH * (agent.outline[2:] - agent.outline[:2]) / 2
        centre = (agent.outline[2:] + agent.outline[:2]) / 2
        left, top = np.maximum(np.floor(centre - half), 0).astype(int)
        right, bottom = np.minimum(np.ceil(centre + half), (width, height)).astype(int)
        labelled: Any = ndimage.label(vehicle[top:bottom, left:right])
        regions, count = labelled
        if not count:
            values.append(0.0)
            continue
        largest = int(np.bincount(regions.ravel())[1:].argmax()) + 1
        box = tight_box(regions == largest)
        found = [] if box is None else [box + np.array([left, top, left, top], np.float64)]
        values.append(_matched(agent.visible, found, reach_px))
    return values
