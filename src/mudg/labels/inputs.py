"""Input and output of every labeller and depth network, where tracked boxes lie in an image, and what rules find beside
given classes: dense depth, sky and dynamic objects, each pixel with a confidence."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from torch import Tensor
from torch.nn import functional

from mudg.base import geometry
from mudg.base.palette import ID
from mudg.base.types import Track, View
from mudg.core.depth import SKY_M, DenseDepth, Space, beyond_reach, complete_depth
from mudg.core.fusion import points_in_box
from mudg.core.project import RULES as HIDING_RULES
from mudg.core.project import visible_depth

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
    """Input of a labeller for one image: ``rgb`` u8[H, W, 3]; LiDAR returns ``xyz_world`` f32[N, 3] of the static
    scene, and of dynamic objects where they are at the image's time; places of the vehicle ``path_world`` f64[M, 3]
    (``evidence.driven_path``); largest angle between neighbouring beams of the LiDAR, and elevation of its highest beam
    above the horizontal; numbers of the tracks that are ``moving`` at some time of the log."""

    view: View
    rgb: NDArray[np.uint8]
    xyz_world: NDArray[np.float32]
    tracks: Sequence[Track]
    path_world: NDArray[np.float64]
    beam_gap_deg: float = GAP_DEG
    highest_rad: float = 0.0
    moving: frozenset[int] = frozenset()

    def measured(self) -> NDArray[np.float32]:
        """Visible returns f32[H, W], metres, NaN where there is none."""
        return visible_depth(self.view, self.xyz_world, HIDING_RULES["sweep"], gap_deg=self.beam_gap_deg)

    def beyond(self, measured: NDArray[np.float32]) -> NDArray[np.bool_]:
        """Pixels bool[H, W] that are beyond the reach of the LiDAR (``core.depth.beyond_reach``)."""
        return beyond_reach(self.view, measured, self.highest_rad, gap_deg=self.beam_gap_deg)

    def far_to_near(self) -> list[PlacedBox]:
        """Boxes that have a class and are present, the farthest first."""
        poses = (track.pose_at(self.view.time_s) if track.label in TRAIN_ID_OF else None for track in self.tracks)
        both = enumerate(zip(self.tracks, poses))
        placed = [PlacedBox(number, track, pose) for number, (track, pose) in both if pose is not None]
        here = self.view.center_world
        return sorted(placed, key=lambda box: -float(np.linalg.norm(box.world_from_box[:3, 3] - here)))


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

    def arrays(self, depth: bool, dynamic: bool) -> dict[str, NDArray[Any]]:
        """Under the names that a scene has for them; ``depth``, ``dynamic``: whether these were asked for."""
        arrays = {"semantics": self.semantics, "sky": self.sky, "semantics_confidence": self.confidence}
        arrays |= {"depth": self.depth, "depth_confidence": self.depth_confidence} if depth else {}
        return arrays | ({"dynamic": self.dynamic} if dynamic else {})


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
    """Input of a depth network for one image: ``rgb`` u8[H, W, 3]; ``measured`` f32[H, W] metres, visible LiDAR
    returns, NaN where there is none; ``filled`` f32[H, W] metres, these filled along the image
    (``core.depth.complete_depth``), NaN where unknown; ``sky`` bool[H, W]."""

    rgb: NDArray[np.uint8]
    measured: NDArray[np.float32]
    filled: NDArray[np.float32]
    sky: NDArray[np.bool_]

    @property
    def known(self) -> NDArray[np.bool_]:
        """Pixels bool[H, W] with a return, but those in the sky."""
        return np.isfinite(self.measured) & ~self.sky


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


# what rules find beside given classes --------------------------------------------------------------
#
# Sky is bright or blue, smooth, above the horizon, connected to the top of the image, and without LiDAR returns. Dense
# depth is filled from the returns (``core.depth.complete_depth``). Nothing here is learnt.

Bytes = NDArray[np.uint8]
Floats = NDArray[np.float32]
Mask = NDArray[np.bool_]

GROUND_M: Final = 0.2
"""Height above the ground plane up to which a pixel is ground (and a little more far away)."""
GRASS: Final = 6.0
"""Ground greener than this (``greenness_of``) is terrain."""


def label_by_network(inputs: LabelInput, semantics: Bytes, confidence: Floats) -> Labels:
    """Labels around given classes u8[H, W] and their confidence f32[H, W]: sky from the classes, the rest by rules.
    Works, with less, without LiDAR or boxes."""
    measured = inputs.measured()
    sky = (semantics == ID["sky"]) & ~np.isfinite(measured)
    beyond = inputs.beyond(measured)
    for box in inputs.far_to_near():  # the windows of vehicles return nothing, although they are near
        outline = box.outline(inputs.view, 0.0)
        if outline is not None:
            beyond &= ~outline
    surface = complete_depth(inputs.rgb, measured, sky, beyond)
    depth, depth_confidence = surface.depth.copy(), surface.confidence.copy()
    depth[sky] = SKY_M
    painted_over = ~sky & (depth == SKY_M)  # a box before the sky that nothing measured
    depth_confidence[painted_over] = 0
    return Labels(semantics, confidence, sky, find_dynamic(inputs, semantics, surface), depth, depth_confidence)


def find_dynamic(inputs: LabelInput, semantics: Bytes, surface: DenseDepth) -> Mask:
    """Pixels of dynamic objects, bool[H, W]: the surface lies in their box, or is uncertain and has their class."""
    dynamic, xyz_world = np.zeros(semantics.shape, bool), surface_points(inputs.view, surface.depth)
    for box in inputs.far_to_near():
        outline = box.outline(inputs.view) if box.number in inputs.moving else None
        if outline is None:
            continue
        rows, columns = map(np.flatnonzero, (outline.any(1), outline.any(0)))
        window = tuple(slice(max(0, int(at[0]) - 1), int(at[-1]) + 2) for at in (rows, columns))
        outline = outline[window]
        known = outline & np.isfinite(surface.depth[window])
        inside = np.zeros(outline.shape, bool)
        inside[known] = box.contains(xyz_world[window][known])
        uncertain = outline & ~(surface.confidence[window] > 0.3)
        dynamic[window] |= inside | (uncertain & (semantics[window] == box.train_id))
    return dynamic


def greenness_of(rgb: Bytes) -> Floats:
    """Positive where a smoothed pixel is rather green, or the dark mottled colour of leaves; f32[H, W]."""
    smooth = ndimage.uniform_filter(rgb.astype(np.float32), (5, 5, 1))
    red, green, blue = smooth[..., 0], smooth[..., 1], smooth[..., 2]
    return green - np.maximum(red * 0.97, blue * 1.04) - 1.5


def find_sky(rgb: Bytes, elevation: Floats, away_px: Floats, gap_px: float) -> Mask:
    """Sky mask bool[H, W] of an image u8[H, W, 3]: above the horizon (``elevation`` of the rays, radians f32[H, W]),
    without returns, bright or blue, smooth, connected to the top of the image. Sky is found farther than ``gap_px``
    from returns (``away_px``: distance to the nearest, f32[H, W]), and then extended up to them where the image looks
    the same."""
    candidates = (elevation > 0) & (away_px > gap_px)
    if not candidates.any():
        return candidates
    smooth = ndimage.uniform_filter(rgb.astype(np.float32), (3, 3, 1))
    blueness = smooth[..., 2] - smooth[..., 0]
    score = smooth.max(2) + 1.5 * np.clip(blueness, 0, 60)
    threshold = _two_group_threshold(score[candidates])
    rough = ndimage.gaussian_gradient_magnitude(smooth.mean(2), 1.0) > 20
    sky_like = (score > threshold) & (blueness > -25) & ~rough
    sky = _morphology(ndimage.binary_opening, candidates & sky_like)
    pieces, _ = ndimage.label(sky)
    top = np.flatnonzero(candidates.any(1))[0]
    connected = np.unique(pieces[top : top + 3])
    large = np.flatnonzero(np.bincount(pieces.ravel()) > 0.002 * sky.size)
    keep = np.union1d(connected, large)
    sky = np.isin(pieces, keep[keep > 0])
    if not sky.any():
        return sky
    sky = _morphology(ndimage.binary_closing, sky) & candidates
    free = (elevation > 0) & (away_px > 1.5)
    return ndimage.binary_dilation(sky, iterations=int(np.ceil(gap_px)) + 1, mask=free & (sky_like | sky))


def _morphology(operation: Callable[..., Mask], mask: Mask) -> Mask:
    """Opening or closing by 3x3 pixels; beyond its edges the mask continues with its last row and column."""
    return operation(np.pad(mask, 2, mode="edge"), np.ones((3, 3), bool))[2:-2, 2:-2]


def _two_group_threshold(values: Floats) -> float:
    """The level that splits values into two groups of least inner variance; at least a modest brightness of 90."""
    counts, edges = np.histogram(values, 128)
    centers = (edges[:-1] + edges[1:]) / 2
    below = np.cumsum(counts)[:-1].astype(np.float64)
    above = counts.sum() - below
    sum_below = np.cumsum(counts * centers)[:-1]
    mean_below = sum_below / np.maximum(below, 1)
    mean_above = ((counts * centers).sum() - sum_below) / np.maximum(above, 1)
    between = below * above * (mean_above - mean_below) ** 2
    best = int(between.argmax())
    if mean_above[best] - mean_below[best] < 40:  # one group only: all sky if bright, none if dark
        return 90.0 if centers[int(counts.argmax())] > 150 else float("inf")
    return max(float(edges[best + 1]), 90.0)
