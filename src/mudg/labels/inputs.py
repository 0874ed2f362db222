"""Input and output of every labeller and depth network, and where tracked boxes lie in an image."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from mudg.base import geometry
from mudg.base.palette import ID
from mudg.base.types import Track, View
from mudg.core.depth import Space
from mudg.core.fusion import points_in_box

TRAIN_ID_OF: Final[Mapping[str, int]] = {
    **{name: ID[name] for name in ("car", "truck", "bus", "train", "person", "rider", "motorcycle", "bicycle")},
    **dict.fromkeys(("van", "vehicle", "misc"), ID["car"]),
    **dict.fromkeys(("pedestrian", "person_sitting"), ID["person"]),
    **dict.fromkeys(("cyclist", "motorcyclist"), ID["rider"]),
    "tram": ID["train"],
}
"""Class of a tracked box by its label; labels not listed here are not painted."""
GAP_DEG: Final = 0.6
"""Beams of a turning LiDAR are at most this far apart; between two returns closer than this the surface goes on."""
FLOOR_M: Final = 0.1
"""Boxes begin this far above their floor."""
GROWTH_M: Final = 0.15
"""Boxes are enlarged by this on each side: annotations are not exact."""


@dataclass(frozen=True, slots=True, eq=False)
class LabelInput:
    """Input of a labeller for one image.

    Args:
        view: camera and pose.
        rgb: u8[H, W, 3].
        xyz_world: f32[N, 3] metres: LiDAR returns of the static scene, and of dynamic objects where they are at the
            image's time.
        tracks: tracked boxes.
        path_world: f64[M, 3], places of the vehicle (``ground.driven_path``).
        beam_gap_deg: largest angle between neighbouring beams of the LiDAR.
        highest_rad: elevation of its highest beam above the horizontal.
        moving: numbers of the tracks of dynamic objects: those that move at some time of the log.
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
    """``semantics`` u8[H, W] train ids, 255 = cannot tell; ``confidence`` f32[H, W] in 0..1; ``sky`` and ``dynamic``
    bool[H, W]; ``depth`` f32[H, W] metres, the sky at ``core.depth.SKY_M``, NaN = unknown; ``depth_confidence``
    f32[H, W] in 0..1."""

    semantics: NDArray[np.uint8]
    confidence: NDArray[np.float32]
    sky: NDArray[np.bool_]
    dynamic: NDArray[np.bool_]
    depth: NDArray[np.float32]
    depth_confidence: NDArray[np.float32]


Labeller = Callable[[LabelInput], Labels]


def surface_points(view: View, depth: NDArray[np.float32]) -> NDArray[np.float32]:
    """Points f32[H, W, 3] in the world, metres, of the pixels of dense depth f32[H, W]; NaN where depth is."""
    rows, columns = np.indices(depth.shape)
    uv = np.stack([columns.ravel() + 0.5, rows.ravel() + 0.5], 1)
    xyz = geometry.unproject(view, uv, depth.ravel().astype(np.float64))
    return xyz.reshape(*depth.shape, 3).astype(np.float32)


@dataclass(frozen=True, slots=True, eq=False)
class PlacedBox:
    """A tracked box at the time of an image: its number among the tracks, and its pose ``world_from_box`` f64[4, 4]."""

    number: int
    track: Track
    world_from_box: NDArray[np.float64]

    @property
    def train_id(self) -> int:
        """Class of the box."""
        return TRAIN_ID_OF[self.track.label]

    def depth_m(self, view: View) -> float:
        """Camera z of the middle of the box."""
        return float((view.cam_from_world @ self.world_from_box)[2, 3])

    def outline(self, view: View, growth_m: float = GROWTH_M) -> NDArray[np.bool_] | None:
        """``box_outline`` of the box, enlarged by ``growth_m`` on each side."""
        return box_outline(view, self.world_from_box, self.track.size_m + 2 * growth_m)

    def contains(self, xyz_world: NDArray[np.floating]) -> NDArray[np.bool_]:
        """Which points ``[N, 3]`` lie in the enlarged box, above its floor, bool[N]."""
        local = geometry.transform_points(geometry.invert(self.world_from_box), xyz_world.astype(np.float64))
        return points_in_box(local, self.track.size_m, GROWTH_M, FLOOR_M)


def far_to_near(inputs: LabelInput) -> list[PlacedBox]:
    """Boxes that have a class and are present, the farthest first."""
    poses = (track.pose_at(inputs.view.time_s) if track.label in TRAIN_ID_OF else None for track in inputs.tracks)
    placed = [
        PlacedBox(n, track, pose) for n, (track, pose) in enumerate(zip(inputs.tracks, poses)) if pose is not None
    ]
    here = inputs.view.center_world
    return sorted(placed, key=lambda box: -float(np.linalg.norm(box.world_from_box[:3, 3] - here)))


def box_outline(
    view: View, world_from_box: NDArray[np.float64], size_m: NDArray[np.float64]
) -> NDArray[np.bool_] | None:
    """Convex outline of a projected box bool[H, W], cut at the near plane; None if it lies outside the image."""
    camera, hull = view.camera, geometry.box_hull(view, world_from_box, size_m)
    if hull is None:
        return None
    u, v = np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5
    mask = np.ones((camera.height, camera.width), bool)
    for a, b, c in hull.equations:
        mask &= a * u[None] + b * v[:, None] + c <= 0
    return mask if mask.any() else None


# depth networks -----------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, eq=False)
class DepthInput:
    """Input of a depth network for one image.

    Args:
        rgb: u8[H, W, 3].
        measured: f32[H, W] metres, visible LiDAR returns, NaN where there is none.
        filled: f32[H, W] metres, the returns filled along the image (``core.complete``); NaN where unknown.
        sky: bool[H, W].
    """

    rgb: NDArray[np.uint8]
    measured: NDArray[np.float32]
    filled: NDArray[np.float32]
    sky: NDArray[np.bool_]


@dataclass(frozen=True, slots=True, eq=False)
class Prediction:
    """``values`` f32[H, W]: depth or inverse depth (``space``) up to scale and shift."""

    values: NDArray[np.float32]
    space: Space

    @classmethod
    def resized(cls, values: Tensor, inputs: DepthInput, space: Space, least: float | None = None) -> Prediction:
        """From a network's values f32[1, 1, h, w], at the size of the image and at least ``least``."""
        found = functional.interpolate(values, size=inputs.rgb.shape[:2], mode="bilinear", align_corners=False)
        return cls((found if least is None else found.clamp(min=least))[0, 0].cpu().numpy(), space)


DepthNetwork = Callable[[DepthInput], Prediction]
