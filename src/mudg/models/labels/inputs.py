"""What every labeller is given and gives, and where tracked boxes lie in an image."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from mudg.base import geometry
from mudg.base.palette import ID
from mudg.base.types import Track, View

TRAIN_ID_OF: Final[Mapping[str, int]] = {
    "car": ID["car"], "van": ID["car"], "vehicle": ID["car"], "misc": ID["car"], "truck": ID["truck"], "bus": ID["bus"],
    "tram": ID["train"], "train": ID["train"], "person": ID["person"], "pedestrian": ID["person"],
    "person_sitting": ID["person"], "cyclist": ID["rider"], "rider": ID["rider"], "motorcycle": ID["motorcycle"],
    "motorcyclist": ID["rider"], "bicycle": ID["bicycle"],
}  # fmt: skip
"""Class of a tracked box by its label; labels not listed here are not painted."""


GAP_DEG: Final = 0.6
"""Beams of a turning LiDAR are at most this far apart; between two returns closer than this the surface goes on."""


FLOOR_M: Final = 0.1


GROWTH_M: Final = 0.15
"""Boxes begin this far above their floor and are grown by this on each side: annotations are not exact."""


@dataclass(frozen=True, slots=True, eq=False)
class LabelInput:
    """What a labeller is given for one image.

    Args:
        view: camera and pose.
        rgb: u8[H, W, 3].
        xyz_world: f32[N, 3] metres: LiDAR returns of static things and of things as they stand at the image's time.
        tracks: tracked boxes.
        path_world: f64[M, 3], places of the vehicle (``ground.driven_path``).
        beam_gap_deg: largest angle between neighbouring beams of the LiDAR.
        highest_rad: elevation of its highest beam above the horizontal.
        moving: numbers of the tracks that move at some time of the log.
    """

    view: View
    rgb: NDArray[np.uint8]
    xyz_world: NDArray[np.float32]
    tracks: Sequence[Track]
    path_world: NDArray[np.float64]
    beam_gap_deg: float = GAP_DEG
    highest_rad: float = 0.0
    moving: frozenset[int] = frozenset()


@dataclass(frozen=True, slots=True, eq=False)
class Labels:
    """``semantics`` u8[H, W] train ids, 255 = cannot tell; ``confidence`` f32[H, W] in 0..1; ``sky`` and ``dynamic`` bool[H, W];
    ``depth`` f32[H, W] metres, the sky at ``CompletionRules.sky_m``, NaN = unknown; ``depth_confidence`` f32[H, W] in 0..1."""

    semantics: NDArray[np.uint8]
    confidence: NDArray[np.float32]
    sky: NDArray[np.bool_]
    dynamic: NDArray[np.bool_]
    depth: NDArray[np.float32]
    depth_confidence: NDArray[np.float32]


Labeller = Callable[[LabelInput], Labels]


def far_to_near(given: LabelInput) -> list[tuple[int, Track]]:
    """Tracks with a class that are present, the farthest first, and their numbers."""
    here = given.view.center_world
    placed: list[tuple[float, int, Track]] = []
    for number, track in enumerate(given.tracks):
        pose = track.pose_at(given.view.time_s) if track.label in TRAIN_ID_OF else None
        if pose is not None:
            placed.append((float(np.linalg.norm(pose[:3, 3] - here)), number, track))
    return [(number, track) for _, number, track in sorted(placed, key=lambda item: -item[0])]


def box_outline(
    view: View, world_from_box: NDArray[np.float64], size_m: NDArray[np.float64]
) -> NDArray[np.bool_] | None:
    """Convex outline of a projected box bool[H, W], cut at the camera's near plane; None if it lies outside the image."""
    camera, hull = view.camera, geometry.box_hull(view, world_from_box, size_m)
    if hull is None:
        return None
    u, v = np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5
    mask = np.ones((camera.height, camera.width), bool)
    for a, b, c in hull.equations:
        mask &= a * u[None] + b * v[:, None] + c <= 0
    return mask if mask.any() else None
