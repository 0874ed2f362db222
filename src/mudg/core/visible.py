"""Which LiDAR points a camera sees: one z-buffer, one rule, and its settings for each use by name.

A scanner stands elsewhere than the camera and sees past things that hide what lies behind them. A point is hidden if something clearly
nearer lies around it in the image:

    depth > nearer * (1 + ratio) + slack_m

``nearer`` is the depth of what may hide it. Points are sparse, so it is looked for around the point as well, within ``reach``:

* ``sides="any"``: the nearest depth within reach. For surfaces that fill the space between their points.
* ``sides="opposite"``: nearer depths on two opposite sides, above and below or left and right; of the two the farther. A surface seen
  through a gap is hidden, what lies beside an edge is not.

``RULES`` holds the settings; the sizes are in pixels, or follow from the angle between the scanner's beams.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from mudg.base.errors import InputError
from mudg.base.types import Camera, View
from mudg.core.zbuffer import DrawLimits, PointLayer, draw_points


@dataclass(frozen=True, kw_only=True)
class HidingRule:
    """When a point counts as hidden.

    Args:
        ratio, slack_m: a point is hidden if farther than ``nearer * (1 + ratio) + slack_m``.
        sides: "any" or "opposite"; see the module text.
        reach_px: (horizontal, vertical) distance within which nearer points are looked for; those of an image when the angle between
            beams is not given, and at least this far when it is.
        reach_beams: (horizontal degrees, vertical share of the angle between beams): reach that follows from the scanner; 0 = none.
        inside: the reach that follows from the scanner ends a pixel short of the next beam.
        widen: "opposite": how far across its direction a side is looked at, as a share of the other direction's reach, at least a
            pixel; 0 = not at all.
    """

    ratio: float
    slack_m: float
    sides: Literal["any", "opposite"] = "any"
    reach_px: tuple[int, int] = (0, 0)
    reach_beams: tuple[float, float] = (0.0, 0.0)
    inside: bool = False
    widen: tuple[float, float] = (0.0, 0.0)

    def reach(self, camera: Camera, gap_deg: float) -> tuple[int, int]:
        """Horizontal and vertical reach in pixels, for an angle ``gap_deg`` between beams (0 = unknown)."""
        across = round(float(np.deg2rad(self.reach_beams[0])) * camera.fx)
        along = round(float(np.deg2rad(self.reach_beams[1] * gap_deg)) * camera.fy)
        return max(self.reach_px[0], across - self.inside), max(self.reach_px[1], along - self.inside)

    def hides(self, nearer: NDArray[np.floating], depth: NDArray[np.floating]) -> NDArray[np.bool_]:
        """Whether depths ``nearer`` hide depths ``depth`` (metres, any one shape)."""
        return depth > nearer * (1 + self.ratio) + self.slack_m


RULES: Final[Mapping[str, HidingRule]] = {
    "sweep": HidingRule(
        ratio=0.075,
        slack_m=0.32,
        sides="opposite",
        reach_px=(1, 1),
        reach_beams=(0.23, 1.0),
        inside=True,
        widen=(0.5, 0.15),
    ),
    "condition": HidingRule(ratio=0.176, slack_m=0.59, sides="opposite", reach_px=(3, 3)),
    "colour": HidingRule(ratio=0.053, slack_m=0.21, reach_beams=(0.1, 0.6)),
    "drawn": HidingRule(ratio=0.1, slack_m=0.3),
}
"""sweep: returns beside an image: for labels, dense depth, the depth a fit learns from, and that renders are scored against. condition:
fused clouds drawn for the diffusion model. colour: standing things that keep an image from colouring a point.
drawn: points drawn as squares of a size in metres, which then need no reach (``core.project``)."""


def visible_depth(
    view: View, xyz_world: NDArray[np.floating], rule: HidingRule, *,
    gap_deg: float = 0.0, near_m: float = 0.5, far_m: float = 200.0,
) -> NDArray[np.float32]:  # fmt: skip
    """The nearest point of every pixel, without the hidden ones; f32[H, W] metres, NaN = none.

    Args:
        xyz_world: [N, 3] metres; points that are not finite are left out.
        gap_deg: largest angle between neighbouring beams, for rules whose reach follows from it.

    Raises:
        InputError: points have the wrong shape.
    """
    if xyz_world.ndim != 2 or xyz_world.shape[1] != 3:
        raise InputError(
            "points have the wrong shape", where="visible_depth", expected="[N, 3]", got=str(xyz_world.shape)
        )
    layer = PointLayer(np.ascontiguousarray(xyz_world, np.float32), np.eye(4))
    depth, index = draw_points([layer], view, DrawLimits(near_m, far_m))
    depth[index < 0] = np.inf
    hidden = hidden_pixels(depth, rule, rule.reach(view.camera, gap_deg))
    return np.where((index >= 0) & ~hidden, depth, np.float32(np.nan))


def hidden_pixels(depth: NDArray[np.float32], rule: HidingRule, reach: tuple[int, int]) -> NDArray[np.bool_]:
    """Which measured pixels of a depth map f32[H, W] (infinite = none) others of it hide, bool[H, W]; ``reach`` in pixels."""
    known = np.isfinite(depth)
    nearer = nearer_depth(depth, rule, reach)
    hidden = np.zeros(depth.shape, bool)
    hidden[known] = rule.hides(nearer[known], depth[known])
    return hidden


def seen_pixels(depth: NDArray[np.float32], valid: NDArray[np.bool_], rule: HidingRule) -> NDArray[np.bool_]:
    """Valid pixels of a depth map f32[H, W] that others of it do not hide by a rule whose reach is in pixels, bool[H, W]."""
    return valid & ~hidden_pixels(np.where(valid, depth, np.float32(np.inf)), rule, rule.reach_px)


def nearer_depth(nearest: NDArray[np.float32], rule: HidingRule, reach: tuple[int, int]) -> NDArray[np.float32]:
    """Depth that may hide each cell, f32[h, w], infinite = none; ``nearest`` f32[h, w], and ``reach`` in its cells."""
    if rule.sides == "any":
        found = nearest
        for axis, cells in ((0, reach[1]), (1, reach[0])):
            if cells:
                found = _minimum(found, 2 * cells + 1, axis, 0)
        return found
    found = np.full(nearest.shape, np.inf, np.float32)
    for axis, cells, share, other in ((0, reach[1], rule.widen[0], reach[0]), (1, reach[0], rule.widen[1], reach[1])):
        if cells == 0:
            continue
        across = max(1, int(share * other)) if share else 0
        wide = _minimum(nearest, 2 * across + 1, 1 - axis, 0) if across else nearest
        before, after = (_minimum(wide, cells + 1, axis, shift) for shift in (cells // 2, -((cells + 1) // 2)))
        found = np.minimum(found, np.maximum(before, after))
    return found


def _minimum(values: NDArray[np.float32], size: int, axis: int, shift: int) -> NDArray[np.float32]:
    """Running minimum over ``size`` cells along an axis, the window moved by ``shift``; nothing lies beyond the edge."""
    found = ndimage.minimum_filter1d(values, size, axis=axis, origin=shift, mode="constant", cval=np.inf)
    return np.asarray(found, np.float32)
