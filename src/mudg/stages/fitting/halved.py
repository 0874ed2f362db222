"""Virtual views at half their size, for the steps of a fit that need no more.

Their finest structure is blurred by the diffusion model and teaches a scene little (docs/supervision.md), and a step costs about as much
per pixel as it costs per Gaussian.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Final

import numpy as np

from mudg.core.pictures import resize_area, resize_nearest
from mudg.models.featnets import WHOLE_PIXELS
from mudg.stages.fitting.views import LidarPixels, StoredView

LEAST_PX: Final = 96
"""No side of a halved view is shorter: smaller views stay as they are."""


class HalvedViews:
    """Gives the steps up to ``until`` virtual views at half their size; of views above ``WHOLE_PIXELS`` all steps, for want of memory.

    Args:
        until: 0 leaves every view as it is.
        keep: halved views stay in memory, a quarter of what the views themselves take.
    """

    def __init__(self, until: float, keep: bool) -> None:
        self._until = until
        self._kept: dict[str, StoredView] | None = {} if keep else None

    def sized(self, view: StoredView, step: int) -> StoredView:
        """The view as a step is to see it."""
        height, width = view.rgb.shape[:2]
        until = math.inf if self._until and height * width > WHOLE_PIXELS else self._until
        if view.kind == "recorded" or step > until:
            return view
        if self._kept is None:
            return halved(view)
        if view.name not in self._kept:
            self._kept[view.name] = halved(view)
        return self._kept[view.name]


def halved(view: StoredView) -> StoredView:
    """The view at half its size: colours and confidence are means, labels and depth those of the nearest pixel. A pixel is masked where
    any of those that it is made of is."""
    height, width = (side // 2 for side in view.rgb.shape[:2])
    if min(height, width) < LEAST_PX:
        return view
    nearest = {name: getattr(view, name) for name in ("channels", "sky", "depth")}
    return replace(
        view, view=view.view.resized(width, height), rgb=resize_area(view.rgb, width, height), lidar=_lidar(view, width, height),
        mask=None if view.mask is None else resize_area(view.mask.astype(np.uint8) * 255, width, height) == 255,
        confidence=None if view.confidence is None else resize_area(view.confidence, width, height),
        **{name: None if plane is None else resize_nearest(plane, height, width) for name, plane in nearest.items()},
    )  # fmt: skip


def _lidar(view: StoredView, width: int, height: int) -> LidarPixels | None:
    """Every measurement, in the pixel that it falls into."""
    if view.lidar is None:
        return None
    tall, wide = view.rgb.shape[:2]
    row, column = view.lidar.pixel // wide, view.lidar.pixel % wide
    row, column = ((2 * place + 1) * new // (2 * old) for place, new, old in ((row, height, tall), (column, width, wide)))
    return LidarPixels(row * width + column, view.lidar.depth_m)
