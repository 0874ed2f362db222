"""What rules find beside given classes: dense depth, sky and dynamic objects, each pixel with a confidence.

Sky is bright or blue, smooth, above the horizon, connected to the top of the image, and without LiDAR returns. Dense
depth is filled from the returns (``core.depth.complete_depth``). Nothing here is learnt.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from mudg.base.palette import ID
from mudg.core.depth import SKY_M, DenseDepth, beyond_reach, complete_depth
from mudg.core.project import RULES as HIDING_RULES
from mudg.core.project import visible_depth
from mudg.labels.inputs import LabelInput, Labels, far_to_near, surface_points

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
    measured = visible_depth(inputs.view, inputs.xyz_world, HIDING_RULES["sweep"], gap_deg=inputs.beam_gap_deg)
    sky = (semantics == ID["sky"]) & ~np.isfinite(measured)
    surface = _complete(inputs, measured, sky)
    depth, depth_confidence = surface.depth.copy(), surface.confidence.copy()
    depth[sky] = SKY_M
    painted_over = ~sky & (depth == SKY_M)  # a box before the sky that nothing measured
    depth_confidence[painted_over] = 0
    return Labels(semantics, confidence, sky, find_dynamic(inputs, semantics, surface), depth, depth_confidence)


def _complete(inputs: LabelInput, measured: Floats, sky: Mask) -> DenseDepth:
    """Dense depth of what is not sky."""
    beyond = beyond_reach(inputs.view, measured, inputs.highest_rad, gap_deg=inputs.beam_gap_deg)
    for box in far_to_near(inputs):  # the windows of vehicles return nothing, although they are near
        outline = box.outline(inputs.view, 0.0)
        if outline is not None:
            beyond &= ~outline
    return complete_depth(inputs.rgb, measured, sky, beyond)


def find_dynamic(inputs: LabelInput, semantics: Bytes, surface: DenseDepth) -> Mask:
    """Pixels of dynamic objects, bool[H, W]: the surface lies in their box, or is uncertain and has their class."""
    dynamic, xyz_world = np.zeros(semantics.shape, bool), surface_points(inputs.view, surface.depth)
    for box in far_to_near(inputs):
        outline = box.outline(inputs.view) if box.number in inputs.moving else None
        if outline is None:
            continue
        window = (_span(outline.any(1), 1), _span(outline.any(0), 1))
        outline = outline[window]
        known = outline & np.isfinite(surface.depth[window])
        inside = np.zeros(outline.shape, bool)
        inside[known] = box.contains(xyz_world[window][known])
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
