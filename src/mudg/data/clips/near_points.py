"""The condition of FreeVS: coloured LiDAR points of a few frames around each view, and nothing else.

Points of the sweeps within two frames of a view's time; those of moving objects are gathered in their boxes and put where the boxes are
at the view's time. One pixel per point, the nearest wins, black elsewhere. No depth, no recorded image, no classes, no renders. Unlike
FreeVS we do not reserve a margin around objects, and do not crop rows that LiDAR never covers.

Its training simulates another view on the recorded path: half of the clips there are made of points that are four frames off.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Final

import numpy as np
import torch

from mudg.base import palette
from mudg.base.camera_colors import SAME_COLORS, CameraColors
from mudg.base.types import Condition, FusedCloud, Track, View
from mudg.core.fusion import FusionRules, SweepShots, fuse_sweeps
from mudg.data.clips.condition import ConditionRules

NEAR_FRAMES: Final = 2
"""Points of so many frames before and after a view are shown."""
OTHER_FRAMES: Final = 4
"""How many frames off the points of a simulated view are."""
OTHER_SHARE: Final = 0.5
_RULES: Final = FusionRules(min_object_points=1)


@dataclass(frozen=True, slots=True)
class NearSweeps:
    """The sweeps of a log, fused a few at a time.

    Args:
        times_s: of the sweeps. read: a sweep by its number. tracks: all boxes. period_s: time from frame to frame.
        colors: how the cameras of the log show common colours.
    """

    times_s: tuple[float, ...]
    read: Callable[[int], SweepShots]
    tracks: Sequence[Track]
    period_s: float
    colors: CameraColors = SAME_COLORS
    clouds: dict[tuple[int, ...], FusedCloud] = field(default_factory=dict)
    """Clouds that were made already, by the numbers of their sweeps."""

    def numbers_at(self, time_s: float) -> tuple[int, ...]:
        """The sweeps within two frames of the one nearest to a time."""
        if not self.times_s:
            return ()
        nearest = min(self.times_s, key=lambda t: abs(t - time_s))
        reach = (NEAR_FRAMES + 0.5) * self.period_s
        return tuple(n for n, t in enumerate(self.times_s) if abs(t - nearest) <= reach)

    def cloud_at(self, time_s: float) -> FusedCloud:
        """Their points: static ones in the world, others in their boxes."""
        numbers = self.numbers_at(time_s)
        if numbers not in self.clouds:
            self.clouds[numbers] = fuse_sweeps(map(self.read, numbers), self.tracks, _RULES, self.colors)[0]
        return self.clouds[numbers]


def near_condition(sweeps: NearSweeps, views: Sequence[View], rules: ConditionRules, late_s: float = 0.0) -> Condition:
    """The model's condition for ``views``, resized to the rules' size.

    Args:
        rules: size and distance limits; nothing else counts. late_s: how much later than its view the points of a view were measured.
    """
    small = tuple(view.resized(rules.width, rules.height) for view in views)
    bare = replace(rules, published=True, point_px=1.0)
    seen = [bare.project(sweeps.cloud_at(view.time_s + late_s), sweeps.tracks, view) for view in small]
    valid = torch.stack([s.valid for s in seen])[:, None]
    shown = [sweeps.colors.image_of(v.camera.name, s.rgb).clamp(0, 1) if sweeps.colors.to_common else s.rgb for v, s in zip(small, seen)]
    color = torch.stack(shown) * valid
    unknown = torch.full_like(valid, palette.UNLABELLED, dtype=torch.uint8)
    depth = torch.full(valid.shape, float(rules.far_m))
    return Condition(small, color, depth, valid, torch.zeros_like(color[0]), torch.zeros_like(valid), color, unknown, unknown)


def simulated_lateness_s(sweeps: NearSweeps, rng: np.random.Generator) -> float:
    """How late the points of a training clip on the recorded path are: half of them four frames, to either side."""
    return 0.0 if rng.random() >= OTHER_SHARE else float(rng.choice([-1.0, 1.0])) * OTHER_FRAMES * sweeps.period_s
