"""Labels from rules on LiDAR, tracked boxes and colour, with a confidence, for images that came without labels.

The rules hold no parameters and need no download. They start from dense depth (``core.complete``), know few classes and
give 255 (unlabelled) where they cannot tell:

* **road**: what lies near a ground plane fitted to the LiDAR. Green ground is **terrain**; other ground that the path
  does not reach without a step or a detour (``ground.map_ground``) is **sidewalk**. Far beside the path all of it has
  less confidence.
* **car, truck, bus, train, person, rider, ...**: tracked boxes, where the dense surface lies in them.
* **sky**: bright or blue, smooth, above the horizon, connected to the top of the image, and without LiDAR returns.
* **vegetation**: what rises from the ground, or stands above the horizon, and is green.
* **building**: any other such thing. It means "something static that stands", not architecture.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from mudg.base.palette import ID, UNLABELLED
from mudg.base.types import View
from mudg.core.depth import SKY_M, beyond_reach, complete_depth, ray_elevation
from mudg.core.project import RULES as HIDING_RULES
from mudg.core.project import visible_depth
from mudg.labels.ground import above_plane, beside_path, map_ground
from mudg.labels.inputs import LabelInput, Labels, PlacedBox, far_to_near, surface_points

Bytes = NDArray[np.uint8]
Floats = NDArray[np.float32]
Mask = NDArray[np.bool_]

GROUND_M: Final = 0.2
"""Height above the ground plane up to which a pixel is ground (and a little more far away)."""
LANE_M: Final = 2.5
"""Nearer to the path than this, ground beyond a step is still road: the step is an error."""
NEAR_ROAD_M: Final = 4.0
"""Nearer to the path than this, flat ground is almost surely road."""
GRASS: Final = 6.0
"""Ground greener than this (``greenness_of``) is terrain."""
_THIN: Final = (ID["person"], ID["rider"], ID["bicycle"], ID["motorcycle"])


@dataclass(frozen=True, slots=True, eq=False)
class _Measured:
    """Visible returns: ``depth_m`` f32[H, W], NaN = none, and ``away_px`` f32[H, W], distance to the nearest."""

    depth_m: Floats
    away_px: Floats
    gap_px: float

    @property
    def any(self) -> bool:
        return bool(np.isfinite(self.away_px[0, 0]))


@dataclass(frozen=True, slots=True, eq=False)
class _Surface:
    """Dense depth: ``xyz_world`` f32[H, W, 3] (NaN = unknown), ``depth`` f32[H, W] metres, ``confidence`` f32[H, W]."""

    xyz_world: Floats
    depth: Floats
    confidence: Floats


def label_by_geometry(inputs: LabelInput) -> Labels:
    """Label one image from LiDAR, boxes and colour; see the module text. Works, with less, without LiDAR or boxes."""
    measured = _measure(inputs)
    elevation = ray_elevation(inputs.view)
    sky = find_sky(inputs.rgb, elevation, measured.away_px, measured.gap_px)
    surface = _complete(inputs, measured, sky)
    semantics = np.full(sky.shape, UNLABELLED, np.uint8)
    confidence = np.zeros(sky.shape, np.float32)
    greenness = greenness_of(inputs.rgb)
    if measured.any:
        _paint_surface(semantics, confidence, inputs, surface, greenness)
    standing = (semantics == UNLABELLED) & (elevation > 0) & ~sky
    semantics[standing] = np.where(greenness[standing] > 0, ID["vegetation"], ID["building"])
    confidence[standing] = 0.3
    semantics[sky], confidence[sky] = ID["sky"], 0.8
    for box in far_to_near(inputs):
        _paint_box(semantics, confidence, box, inputs.view, measured, surface)
    sky &= semantics == ID["sky"]
    return _with_surface(inputs, semantics, confidence, sky, surface)


def label_by_network(inputs: LabelInput, semantics: Bytes, confidence: Floats) -> Labels:
    """Labels around given classes u8[H, W] and their confidence f32[H, W]: sky from the classes, the rest by rules."""
    measured = _measure(inputs)
    sky = (semantics == ID["sky"]) & ~np.isfinite(measured.depth_m)
    return _with_surface(inputs, semantics, confidence, sky, _complete(inputs, measured, sky))


def _with_surface(inputs: LabelInput, semantics: Bytes, confidence: Floats, sky: Mask, surface: _Surface) -> Labels:
    depth, depth_confidence = surface.depth.copy(), surface.confidence.copy()
    depth[sky] = SKY_M
    painted_over = ~sky & (depth == SKY_M)  # a box before the sky that nothing measured
    depth_confidence[painted_over] = 0
    return Labels(semantics, confidence, sky, find_dynamic(inputs, semantics, surface), depth, depth_confidence)


def _measure(inputs: LabelInput) -> _Measured:
    gap_px = max(1.5, float(np.deg2rad(inputs.beam_gap_deg)) * inputs.view.camera.fy)
    depth = visible_depth(inputs.view, inputs.xyz_world, HIDING_RULES["sweep"], gap_deg=inputs.beam_gap_deg)
    known = np.isfinite(depth)
    away = ndimage.distance_transform_edt(~known) if known.any() else np.full(depth.shape, np.inf)
    return _Measured(depth, np.asarray(away, np.float32), gap_px)


def _complete(inputs: LabelInput, measured: _Measured, sky: Mask) -> _Surface:
    """Dense depth of what is not sky, and its points."""
    beyond = beyond_reach(inputs.view, measured.depth_m, inputs.highest_rad, gap_deg=inputs.beam_gap_deg)
    for box in far_to_near(inputs):  # the windows of vehicles return nothing, although they are near
        outline = box.outline(inputs.view, 0.0)
        if outline is not None:
            beyond &= ~outline
    dense = complete_depth(inputs.rgb, measured.depth_m, sky, beyond)
    return _Surface(surface_points(inputs.view, dense.depth), dense.depth, dense.confidence)


def _paint_surface(
    semantics: Bytes, confidence: Floats, inputs: LabelInput, surface: _Surface, greenness: Floats
) -> None:
    """Each pixel of known depth by its height above the ground, its place beside the path, and its colour."""
    known = np.isfinite(surface.depth)
    height = np.full(known.shape, np.inf, np.float32)
    direct = np.zeros(known.shape, bool)
    ground = map_ground(inputs.xyz_world, inputs.path_world, inputs.view.center_world)
    if ground is not None:
        height = above_plane(ground.plane, surface.xyz_world)
        _, direct, _ = ground.under(surface.xyz_world)
    flat = known & (np.abs(height) < GROUND_M + 0.005 * surface.depth)
    beside = beside_path(surface.xyz_world, inputs.path_world, 4)
    green = greenness > GRASS
    semantics[flat] = np.where(green[flat], ID["terrain"], ID["road"])
    sure = np.where(beside < NEAR_ROAD_M, 0.9, np.where(direct, 0.7, 0.5))
    confidence[flat] = sure[flat] * (0.3 + 0.7 * surface.confidence[flat])
    kerbed = flat & ~green & ~direct & (beside > LANE_M)
    semantics[kerbed], confidence[kerbed] = ID["sidewalk"], 0.4
    standing = known & ~flat & (height > 0)
    semantics[standing] = np.where(greenness[standing] > 0, ID["vegetation"], ID["building"])
    confidence[standing] = 0.3 + 0.2 * surface.confidence[standing]


def _box_pixels(box: PlacedBox, view: View, surface: _Surface) -> tuple[tuple[slice, slice], Mask, Mask] | None:
    """Of a box: the part of the image around it; there its outline, and where the surface lies in it, bool[h, w]."""
    outline = box.outline(view)
    if outline is None:
        return None
    window = (_span(outline.any(1), 1), _span(outline.any(0), 1))
    outline = outline[window]
    known = outline & np.isfinite(surface.depth[window])
    inside = np.zeros(outline.shape, bool)
    inside[known] = box.contains(surface.xyz_world[window][known])
    return window, outline, inside


def _paint_box(
    semantics: Bytes, confidence: Floats, box: PlacedBox, view: View, measured: _Measured, surface: _Surface
) -> None:
    """Paint a tracked box: surely where the surface lies in it, less surely in its outline; not behind what is near."""
    pixels = _box_pixels(box, view, surface)
    if pixels is None:
        return
    window, outline, inside = pixels
    semantics, confidence, depth = (m[window] for m in (semantics, confidence, surface.depth))
    certain = surface.confidence[window]
    if measured.any and not (inside & np.isfinite(measured.depth_m[window])).any():
        return  # the LiDAR sees around there and nothing is in the box: it is hidden, or empty
    if not (measured.any and box.train_id in _THIN):  # people and bicycles fill little of their boxes
        far_side_m = box.depth_m(view) + float(np.linalg.norm(box.track.size_m)) / 2
        guessed = outline & ~inside & ~(depth < far_side_m) & (certain < 0.15)
        semantics[guessed], confidence[guessed] = box.train_id, 0.4
    semantics[inside], confidence[inside] = box.train_id, (0.5 + 0.4 * certain)[inside]


def find_dynamic(inputs: LabelInput, semantics: Bytes, surface: _Surface) -> Mask:
    """Pixels of dynamic objects, bool[H, W]: the surface lies in their box, or is uncertain and has their class."""
    dynamic = np.zeros(semantics.shape, bool)
    for box in far_to_near(inputs):
        pixels = _box_pixels(box, inputs.view, surface) if box.number in inputs.moving else None
        if pixels is not None:
            window, outline, inside = pixels
            uncertain = outline & ~(surface.confidence[window] > 0.3)
            dynamic[window] |= inside | (uncertain & (semantics[window] == box.train_id))
    return dynamic


def _span(present: Mask, margin: int) -> slice:
    """From the first to the last true entry, and ``margin`` more on either side."""
    at = np.flatnonzero(present)
    return slice(max(0, int(at[0]) - margin), int(at[-1]) + margin + 1)


def greenness_of(rgb: Bytes) -> Floats:
    """Positive where a smoothed pixel is rather green, or the dark mottled colour of leaves; f32[H, W]."""
    smooth = ndimage.uniform_filter(rgb.astype(np.float32), (5, 5, 1))
    red, green, blue = smooth[..., 0], smooth[..., 1], smooth[..., 2]
    return green - np.maximum(red * 0.97, blue * 1.04) - 1.5


def find_sky(rgb: Bytes, elevation: Floats, away_px: Floats, gap_px: float) -> Mask:
    """Sky mask bool[H, W]: above the horizon, without returns, bright or blue, smooth, connected to the top of the
    image.

    Args:
        rgb: u8[H, W, 3].
        elevation: of the rays, radians, f32[H, W].
        away_px: distance to the nearest LiDAR return f32[H, W].
        gap_px: sky is found farther from returns than this, and then extended up to them where the image looks the
            same.
    """
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
